"""The world of cliques: every claim of its docstrings, from the arrays of a run and what scipy expects of them."""

from __future__ import annotations

import itertools
import math
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from evermap.errors import ConfigError
from evermap.sensing.profile import Field, Projection
from evermap_studies.worlds.cliques import CliqueRun, CliqueWorld, named_world, simulate_cliques
from evermap_studies.worlds.sensors import CAMERA, LIDAR

SENSORS = {"lidar": LIDAR, "camera": CAMERA}
WORLDS = ("nominal", "angle60", "range04", "occlusion", "false-alarms", "pose-noise")
UNLIKELY = 1e-3
"""Of a test's p-value: seeds are fixed, so a fault is what lies below."""


def in_field(run: CliqueRun, position, rotation):
    """(F, K) by scipy's rotations and the plain geometry of annulus and pyramid."""
    turned = Rotation.from_matrix(rotation)
    seen = np.stack([turned.inv().apply(point - position) for point in run.landmark_m], axis=1)
    distance = np.linalg.norm(seen, axis=2)
    sensor = run.world.field
    if sensor.projection is Projection.SPHERICAL:
        inside = np.abs(np.arcsin(seen[..., 2] / distance)) <= sensor.half_elevation_rad
    else:
        image = np.abs(seen[..., 1:]) / seen[..., :1]
        half = np.tan([sensor.half_azimuth_rad, sensor.half_elevation_rad])
        inside = (seen[..., 0] > 0.0) & (image <= half).all(axis=-1)
    return inside & (distance <= sensor.range_max_m)


def sight(run: CliqueRun):
    """(F, K) distances and angles between the normals and the directions to the sensor."""
    to_sensor = run.position_m[:, None] - run.landmark_m
    distance = np.sqrt((to_sensor**2).sum(axis=2))
    cosine = (to_sensor * run.normal).sum(axis=2) / distance
    return distance, np.arccos(np.clip(cosine, -1.0, 1.0))


def exists(run: CliqueRun):
    """(F, K) whether a landmark's object is there."""
    end = (run.first + run.survival_steps)[run.clique]
    return np.arange(run.world.steps)[:, None] <= end


@pytest.fixture(scope="module", params=list(itertools.product(SENSORS, WORLDS)), ids="-".join)
def run(request) -> CliqueRun:
    sensor, world = request.param
    return simulate_cliques(named_world(world, SENSORS[sensor]), 11)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("sensor", SENSORS)
def test_detections_fade_with_range_as_the_thesis_says(sensor, world):
    """Of objects that stay: enough detections for a length 5 % off to be found in nearly every world."""
    lasting = replace(named_world(world, SENSORS[sensor]), mean_survival_steps=1e6)
    seen_m, detected = [], []
    for seed in range(3):
        run = simulate_cliques(lasting, seed)
        distance, angle = sight(run)
        seen = in_field(run, run.position_m, run.rotation) & exists(run) & ~run.hidden[:, run.clique]
        seen &= angle <= lasting.viewing_angle_rad
        seen_m.append(distance[seen])
        detected.append(run.detected[seen])
    distance, hit = np.concatenate(seen_m), np.concatenate(detected)
    of_bin = np.digitize(distance, np.quantile(distance, np.linspace(0.0, 1.0, 13))[1:-1])
    chance = np.exp(-distance / lasting.fading_m)
    surprise = np.bincount(of_bin, hit - chance) / np.sqrt(np.bincount(of_bin, chance * (1.0 - chance)))
    assert stats.chi2.sf(np.square(surprise).sum(), 12) > UNLIKELY


def test_what_cannot_be_seen_is_reported_by_false_alarms_alone(run):
    _, angle = sight(run)
    inside = in_field(run, run.position_m, run.rotation)
    reasons = {
        "turned away": exists(run) & ~run.hidden[:, run.clique] & (angle > run.world.viewing_angle_rad),
        "gone": ~exists(run),
        "hidden": exists(run) & run.hidden[:, run.clique],
    }
    for why, unseen in reasons.items():
        alarms = run.detected[inside & unseen]
        if len(alarms):
            assert stats.binomtest(int(alarms.sum()), len(alarms), run.world.p_false).pvalue > UNLIKELY, why
    assert reasons["gone"].any()
    assert reasons["hidden"].any() == (run.world.occluded_share > 0.0)
    assert not run.detected[~inside].any()


def test_landmarks_face_away_from_their_objects_centre(run):
    offset = run.landmark_m - run.centre_m[run.clique]
    np.testing.assert_allclose(np.linalg.norm(run.normal, axis=1), 1.0)
    np.testing.assert_allclose(run.normal * np.linalg.norm(offset, axis=1)[:, None], offset, atol=1e-12)
    assert np.all(np.diff(run.clique) >= 0)
    count = np.bincount(run.clique)
    assert len(count) == run.world.objects
    assert count.min() >= 15
    assert count.max() <= 25


def test_landmarks_lie_on_ellipsoids_of_the_sizes_that_were_asked_for():
    run = simulate_cliques(CliqueWorld(landmarks=(60, 60), steps=10, period=10), 5)
    for c in range(run.world.objects):
        square = (run.landmark_m[run.clique == c] - run.centre_m[c]) ** 2
        # three unknown axes, sixty equations x^2/a^2 + y^2/b^2 + z^2/c^2 = 1: they hold only on an ellipsoid
        inverse, *_ = np.linalg.lstsq(square, np.ones(60), rcond=None)
        np.testing.assert_allclose(square @ inverse, 1.0, atol=1e-9)
        assert np.all(inverse**-0.5 >= 0.5)
        assert np.all(inverse**-0.5 <= 2.0)


@pytest.mark.parametrize("sensor", SENSORS)
def test_objects_keep_clear_of_each_other_and_of_the_path(sensor):
    world = CliqueWorld(field=SENSORS[sensor], landmarks=(40, 40), steps=200)
    for seed in range(10):
        run = simulate_cliques(world, seed)
        offset = np.linalg.norm(run.landmark_m - run.centre_m[run.clique], axis=1)
        reach = np.array([offset[run.clique == c].max() for c in range(4)])  # at most the largest semi-axis
        apart = np.linalg.norm(run.centre_m[:, None] - run.centre_m, axis=2)[np.triu_indices(4, 1)]
        assert np.all(apart >= (reach[:, None] + reach)[np.triu_indices(4, 1)])
        gap = np.linalg.norm(run.position_m[:, None] - run.landmark_m, axis=2).min(axis=0)
        assert np.all(gap >= world.distance_m[0])
        to_centre = np.linalg.norm(run.position_m[:, None] - run.centre_m, axis=2).min(axis=0)
        # the nearest point is no farther than the one beside which it was placed, give or take 0.5 m of height
        assert np.all(to_centre <= np.hypot(2.0 + world.distance_m[1], 2.0))


@pytest.mark.parametrize("sensor", SENSORS)
def test_each_object_is_in_the_field_for_its_share_of_a_period_and_born_at_its_first_sight(sensor):
    for seed in range(5):
        run = simulate_cliques(CliqueWorld(field=SENSORS[sensor], steps=200), seed)
        inside = in_field(run, run.position_m, run.rotation)
        for c in range(4):
            some = inside[:, run.clique == c].any(axis=1)
            assert run.first[c] == np.flatnonzero(some)[0]
            assert some.mean() >= run.world.share_in_field


def test_existence_ends_after_the_survival_time():
    run = simulate_cliques(named_world("nominal", CAMERA), 4)
    there = run.there()
    for c in range(4):
        expected = [step - run.first[c] <= run.survival_steps[c] for step in range(1000)]
        np.testing.assert_array_equal(there[:, c], expected)
    assert not there[-1].all()


def test_survival_times_are_exponential():
    world = CliqueWorld(steps=20, period=20, landmarks=(1, 2), mean_survival_steps=300.0)
    lifetimes = np.concatenate([simulate_cliques(world, seed).survival_steps for seed in range(300)])
    assert stats.kstest(lifetimes, stats.expon(scale=300.0).cdf).pvalue > UNLIKELY


def spells(hidden):
    """Lengths of the whole stretches of one state, per state; the first and last of each column are cut off."""
    lengths: dict[bool, list[int]] = {False: [], True: []}
    for column in hidden.T:
        runs = [(state, len(list(group))) for state, group in itertools.groupby(column.tolist())]
        for state, length in runs[1:-1]:
            lengths[state].append(length)
    return lengths


@pytest.mark.parametrize(("share", "mean_steps"), [(0.15, 5.0), (0.6, 2.0)])
def test_occlusions_have_their_share_and_their_length(share, mean_steps):
    world = CliqueWorld(occluded_share=share, occluded_steps=mean_steps, steps=8000, landmarks=(1, 1))
    hidden = simulate_cliques(world, 2).hidden
    lengths = spells(hidden)
    leave = 1.0 / mean_steps
    enter = leave * share / (1.0 - share)
    for state, chance in ((True, leave), (False, enter)):
        found = np.array(lengths[state])
        assert found.mean() == pytest.approx(1.0 / chance, abs=4.0 * found.std() / math.sqrt(len(found)))
        # as many spells of each length as a geometric distribution has, in bins of at least twenty
        edges = np.unique(stats.geom.ppf(np.linspace(0.0, 1.0, 7), chance))
        mass = np.diff(stats.geom.cdf(edges, chance))
        counts = np.histogram(found, edges + 0.5)[0]
        keep = mass * len(found) > 20
        rest = len(found) - counts[keep].sum()
        observed, expected = np.append(counts[keep], rest), np.append(mass[keep], 1.0 - mass[keep].sum()) * len(found)
        filled = expected > 1e-6
        assert stats.chisquare(observed[filled], expected[filled]).pvalue > UNLIKELY
    # a chain forgets with 1 - leave - enter per step, which is what the mean of a share is uncertain by
    memory = 1.0 - leave - enter
    sigma = math.sqrt(share * (1.0 - share) * (1.0 + memory) / (1.0 - memory) / hidden.size)
    assert hidden.mean() == pytest.approx(share, abs=4.0 * sigma)


def test_objects_are_hidden_from_the_first_step_on_and_independently():
    world = CliqueWorld(occluded_share=0.3, occluded_steps=5.0, steps=3, period=3)
    first = np.array([simulate_cliques(world, seed).hidden[0] for seed in range(400)])
    assert stats.binomtest(int(first.sum()), first.size, 0.3).pvalue > UNLIKELY
    pairs = np.bincount(first.sum(axis=1), minlength=5)
    assert stats.chisquare(pairs, 400 * stats.binom.pmf(np.arange(5), 4, 0.3)).pvalue > UNLIKELY


def test_trajectory_is_periodic_smooth_and_as_wide_as_asked():
    world = CliqueWorld(steps=600, period=200, extent_m=4.0)
    for seed in range(5):
        run = simulate_cliques(world, seed)
        np.testing.assert_allclose(run.position_m[:400], run.position_m[200:], atol=1e-9)
        np.testing.assert_allclose(run.rotation[:400], run.rotation[200:], atol=1e-9)
        lap = run.position_m[:200]
        spread = lap - lap.mean(axis=0)
        assert math.sqrt((spread[:, :2] ** 2).sum(axis=1).mean()) == pytest.approx(4.0)
        # three harmonics: no step is longer than thrice the fastest that the spread allows of a single one
        assert (
            np.linalg.norm(np.diff(run.position_m, axis=0), axis=1).max() < 3 * 4.0 * math.sqrt(2) * 2 * math.pi / 200
        )


def test_sensor_is_level_but_for_a_sway_and_turns_once_a_period():
    for seed in range(5):
        run = simulate_cliques(CliqueWorld(steps=201, period=200), seed)
        yaw, pitch, roll = Rotation.from_matrix(run.rotation).as_euler("ZYX").T
        sway = np.degrees(np.sqrt([np.mean(pitch[:200] ** 2), np.mean(roll[:200] ** 2)]))
        np.testing.assert_allclose(sway, 6.0, rtol=1e-6)
        assert abs(np.unwrap(yaw)[-1] - yaw[0]) == pytest.approx(2.0 * math.pi)


def test_rotations_are_rotations(run):
    for rotation in (run.rotation, run.pose_rotation):
        np.testing.assert_allclose(
            rotation @ np.swapaxes(rotation, 1, 2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-12
        )
        np.testing.assert_allclose(np.linalg.det(rotation), 1.0)


def test_filters_get_a_pose_as_noisy_as_asked():
    run = simulate_cliques(named_world("pose-noise", LIDAR), 8)
    shift = (run.pose_position_m - run.position_m) / 0.1
    turn = Rotation.from_matrix(np.swapaxes(run.rotation, 1, 2) @ run.pose_rotation).as_rotvec() / math.radians(2.0)
    for noise in (*shift.T, *turn.T):
        assert stats.kstest(noise, stats.norm.cdf).pvalue > UNLIKELY
    exact = simulate_cliques(named_world("nominal", LIDAR), 8)
    np.testing.assert_array_equal(exact.pose_position_m, exact.position_m)
    np.testing.assert_allclose(exact.pose_rotation, exact.rotation, atol=1e-15)


def test_landmarks_are_expected_where_the_given_pose_has_them_in_the_field(run):
    np.testing.assert_array_equal(run.expected(), in_field(run, run.pose_position_m, run.pose_rotation))
    true = in_field(run, run.position_m, run.rotation)
    assert np.array_equal(run.expected(), true) == (run.world.pose_noise_m == 0.0)


def test_same_seed_same_run_and_another_seed_another():
    world = named_world("occlusion", CAMERA)
    one, same, other = (simulate_cliques(world, seed) for seed in (1, np.random.SeedSequence(1), 2))
    for item in fields(CliqueRun):
        a, b, c = (getattr(r, item.name) for r in (one, same, other))
        if item.name != "world":
            np.testing.assert_array_equal(a, b, err_msg=item.name)
            assert not np.array_equal(a, c), item.name


def test_named_worlds_differ_from_the_nominal_in_what_they_are_named_after():
    names = {
        "angle60": {"viewing_angle_rad": math.radians(60.0)},
        "range04": {"fading_m": 6.4},
        "occlusion": {"occluded_share": 0.15, "occluded_steps": 5.0},
        "false-alarms": {"p_false": 0.03},
        "pose-noise": {"pose_noise_m": 0.1, "pose_noise_rad": math.radians(2.0)},
        "nominal": {},
    }
    for name, changed in names.items():
        expected = replace(CliqueWorld(field=CAMERA), **changed)
        found = named_world(name, CAMERA)
        for item in fields(CliqueWorld):
            assert getattr(found, item.name) == pytest.approx(getattr(expected, item.name)) or item.name == "field"
        assert found.field is CAMERA
    with pytest.raises(ConfigError, match="pose-noise"):
        named_world("mars", LIDAR)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("fading_m", 0.0),
        ("fading_m", math.nan),
        ("viewing_angle_rad", -1.0),
        ("viewing_angle_rad", 3.5),
        ("mean_survival_steps", math.inf),
        ("extent_m", 0.0),
        ("pose_noise_m", -0.1),
        ("pose_noise_rad", math.nan),
        ("p_false", 1.5),
        ("share_in_field", -0.1),
        ("occluded_share", 1.0),
        ("occluded_steps", 0.5),
        ("objects", 0),
        ("steps", 0),
        ("period", 0),
        ("semi_axis_m", (2.0, 1.0)),
        ("landmarks", (0, 3)),
        ("distance_m", (1.0, math.inf)),
    ],
)
def test_a_world_that_cannot_be_is_said_in_one_line(name, value):
    with pytest.raises(ConfigError, match=f"field '{name}'") as error:
        CliqueWorld(**{name: value})
    assert "\n" not in str(error.value)


def test_a_share_that_is_hidden_for_too_short_is_refused():
    with pytest.raises(ConfigError, match=r"occluded_steps.*at least 9"):
        CliqueWorld(occluded_share=0.9, occluded_steps=5.0)
    CliqueWorld(occluded_share=0.9, occluded_steps=9.1)


def test_a_crowded_world_says_how_many_objects_found_a_place():
    with pytest.raises(ConfigError, match=r"of 60 objects .*extent_m"):
        simulate_cliques(CliqueWorld(objects=60, steps=200), 0)


def test_an_object_that_is_never_passed_is_refused():
    """Its birth would be a step that never comes."""
    blinkered = Field(1.0, 0.1, 0.1, Projection.PINHOLE)
    with pytest.raises(ConfigError, match="share_in_field"):
        simulate_cliques(CliqueWorld(field=blinkered, share_in_field=0.0, steps=200), 0)


def test_true_detection_probability_is_the_thesis_model_of_what_is_there(run):
    distance, angle = sight(run)
    inside = in_field(run, run.position_m, run.rotation)
    faces = angle <= run.world.viewing_angle_rad
    expected = inside * np.where(faces, np.exp(-distance / run.world.fading_m), run.world.p_false)
    np.testing.assert_allclose(run.p_detect(), expected, atol=1e-12)
