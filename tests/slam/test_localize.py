"""In a map that is not estimated: where the robot is, how sure it is, and what it does when the map is wrong."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
import scipy.stats
from drives import (
    NOISE,
    SENSOR,
    World,
    driven,
    errors,
    nees,
    place_randomly,
    run,
    surveyed,
)

from evermap.geometry import se2
from evermap.sensing.visibility import NominalField
from evermap.slam import localize
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.known_places import KnownPlaces, Neighbourhood
from evermap.slam.localize import FrameSightings, Localizer
from evermap.slam.planar_filter import PlanarMotion
from evermap.slam.problem import Drive

COUNT, SIDE_M = 40, 14.0


@cache
def _world(seed: int, n_frames: int) -> tuple[np.random.Generator, World]:
    rng = np.random.default_rng(seed)
    return rng, driven(rng, place_randomly(rng, COUNT, SIDE_M), n_frames=n_frames)


def world(seed: int, n_frames: int = 150) -> tuple[np.random.Generator, World]:
    """A world of the test's own, and the generator as it is after drawing it; each world is drawn once."""
    rng, drawn = deepcopy(_world(seed, n_frames))
    return rng, drawn


def within_chance(total: float, degrees: int) -> bool:
    """A sum of squared normalised errors that a consistent filter has in all but one of 10,000 cases."""
    low, high = scipy.stats.chi2.ppf([0.5e-4, 1.0 - 0.5e-4], degrees)
    return bool(low < total < high)


@pytest.mark.parametrize(
    ("sigma_m", "runs"),
    [(0.003, 10), *(pytest.param(sigma_m, 40, marks=pytest.mark.slow) for sigma_m in (0.003, 0.05, 0.15))],
)
def test_pose_and_calibration_are_as_uncertain_as_the_filter_says(sigma_m, runs):
    """Also where the map is three times worse than the sensor and 150 frames look at the same places of it."""
    of_pose, of_states = 0.0, 0.0
    for seed in range(runs):
        rng, true = world(seed)
        localizer, located = run(true, surveyed(rng, true.landmark, sigma_m))
        last = located[-1]
        of_pose += nees(errors(true, located)[-1:], last.covariance[None])[0]
        wrong = localizer.states - true.states
        of_states += wrong @ np.linalg.solve(localizer.states_covariance, wrong)
    assert within_chance(of_pose, 3 * runs)
    assert within_chance(of_states, 11 * runs)


@pytest.mark.parametrize("runs", [2, pytest.param(6, marks=pytest.mark.slow)])
def test_a_long_stay_among_the_same_landmarks_makes_nobody_too_sure(runs):
    """Their errors are the same in every frame: a filter that takes them for fresh noise would be sure of anything."""
    of_pose, of_states = 0.0, 0.0
    for seed in range(runs):
        rng, true = world(seed, n_frames=1000)
        localizer, located = run(true, surveyed(rng, true.landmark, 0.05))
        of_pose += nees(errors(true, located)[-1:], located[-1].covariance[None])[0]
        wrong = localizer.states - true.states
        of_states += wrong @ np.linalg.solve(localizer.states_covariance, wrong)
        assert not any(one.lost for one in located[5:])
    assert within_chance(of_pose, 3 * runs)
    assert within_chance(of_states, 11 * runs)


@pytest.mark.parametrize("runs", [8, pytest.param(40, marks=pytest.mark.slow)])
def test_landmarks_that_the_map_lacks_tell_nothing_of_where_in_it_the_robot_is(runs):
    """Behind six seconds in which it saw nothing all it sees is new, and its heading stays as unknown as it was."""
    of_pose, of_heading = 0.0, 0.0
    for seed in range(runs):
        rng, true = world(seed, n_frames=200)
        places = surveyed(rng, true.landmark, 0.05)
        for k, seen in enumerate(true.sightings[50:], start=50):
            kept = slice(None if k >= 80 else 0)
            true.sightings[k] = FrameSightings(seen.landmark_id[kept] + COUNT, *(part[kept] for part in seen[1:]))
        _, located = run(true, places, learn=True)
        error, covariance = errors(true, located)[-1], located[-1].covariance
        of_pose += nees(error[None], covariance[None])[0]
        of_heading += error[2] ** 2 / covariance[2, 2]
    assert within_chance(of_pose, 3 * runs)
    assert within_chance(of_heading, runs)


@pytest.mark.parametrize("runs", [8, pytest.param(25, marks=pytest.mark.slow)])
def test_a_map_that_is_turned_as_a_whole_is_as_good_as_its_parts_fit_together(runs):
    of_pose, gated_moved, gated_others = 0.0, [], []
    for seed in range(runs):
        rng, true = world(seed)
        by = np.zeros((2 * COUNT, 3))
        by[0::2, 0] = by[1::2, 1] = 1.0
        by[0::2, 2], by[1::2, 2] = -true.landmark[:, 1], true.landmark[:, 0]
        joint = by @ np.diag([0.3, 0.3, 0.03]) ** 2 @ by.T + 0.02**2 * np.eye(2 * COUNT)
        position = true.landmark + rng.multivariate_normal(np.zeros(2 * COUNT), joint).reshape(COUNT, 2)
        right = KnownPlaces.of(np.arange(COUNT), position, joint, np.ones(COUNT))
        _, located = run(true, right)
        of_pose += nees(errors(true, located)[-1:], located[-1].covariance[None])[0]
        position = position.copy()
        position[:4] += [0.5, 0.0]  # as far as the whole map may be off, but on their own
        _, located = run(true, KnownPlaces.of(np.arange(COUNT), position, joint, np.ones(COUNT)))
        place = np.concatenate([one.place for one in located])
        gated = np.concatenate([one.p_inlier for one in located]) < 0.5
        gated_moved.append(gated[place < 4].mean())
        gated_others.append(gated[place >= 4].mean())
    assert within_chance(of_pose, 3 * runs)
    assert np.mean(gated_moved) > 0.9
    assert np.mean(gated_others) < 0.02


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 5))])
def test_the_last_pose_is_that_of_a_batch_solution_by_gtsam(seed):
    """Of a map without errors to learn, and odometry and sensor without any: smoothing tells the last pose no more."""
    rng, true = world(seed, n_frames=60)
    plain = CalibrationPrior(true.states, np.ones(11), np.zeros(11, dtype=np.bool_))
    true = plainly_seen(rng, true)
    places = surveyed(rng, true.landmark, 0.001)
    start = true.pose[0], np.diag([0.05, 0.05, 0.03]) ** 2
    localizer = Localizer(places, SENSOR, plain, replace(NOISE, outlier_log_odds=50.0), start=start)
    frames = zip(true.stamp_s, true.sightings, strict=True)
    last = [localizer.step(stamp, true.drive, seen) for stamp, seen in frames][-1]

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*start[0]), gtsam.noiseModel.Gaussian.Covariance(start[1])))
    sigmas = gtsam.noiseModel.Diagonal.Sigmas(NOISE.detection[::-1])
    for j in range(COUNT):
        values.insert(1000 + j, places.position_m[j])
        graph.add(
            gtsam.PriorFactorPoint2(
                1000 + j, places.position_m[j], gtsam.noiseModel.Gaussian.Covariance(places.covariance_m2[j])
            )
        )
    for i, seen in enumerate(true.sightings):
        values.insert(i, gtsam.Pose2(*true.pose[i]))
        if i > 0:
            motion = PlanarMotion.over(true.drive, *true.stamp_s[i - 1 : i + 1], true.states, plain.free, NOISE)
            model = gtsam.noiseModel.Gaussian.Covariance(motion.covariance)
            graph.add(gtsam.BetweenFactorPose2(i - 1, i, gtsam.Pose2(*motion.increment), model))
        for j, (range_m, bearing_rad) in zip(seen.landmark_id.tolist(), seen.reading, strict=True):
            graph.add(gtsam.BearingRangeFactor2D(i, 1000 + j, gtsam.Rot2(bearing_rad), range_m, sigmas))
    best = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    pose = best.atPose2(len(true.pose) - 1)
    covariance = gtsam.Marginals(graph, best).marginalCovariance(len(true.pose) - 1)
    away = se2.log(se2.between([pose.x(), pose.y(), pose.theta()], last.pose))
    assert nees(away[None], covariance[None])[0] < 0.1  # far less than what either knows
    assert np.sqrt(np.diag(last.covariance)) == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.1)


def plainly_seen(rng: np.random.Generator, true: World) -> World:
    """The same drive, seen by a sensor without errors of calibration; the odometry's are known."""
    states = true.states.copy()
    states[:7] = 0.0
    sightings = []
    for pose, seen in zip(true.pose, true.sightings, strict=True):
        away = se2.transform(se2.inverse(pose), true.landmark[seen.landmark_id])
        reading = np.column_stack([np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0])])
        sightings.append(seen._replace(reading=reading + NOISE.detection * rng.normal(size=reading.shape)))
    true.states[:] = states
    return replace(true, states=states, sightings=sightings)


def moved(rng: np.random.Generator, places: KnownPlaces, share: float) -> tuple[KnownPlaces, np.ndarray]:
    """A part of the map is wrong, by 0.3 to 2 m each."""
    rows = rng.permutation(len(places))[: round(share * len(places))]
    away, turn = rng.uniform(0.3, 2.0, len(rows)), rng.uniform(-np.pi, np.pi, len(rows))
    position = places.position_m.copy()
    position[rows] += np.column_stack([away * np.cos(turn), away * np.sin(turn)])
    return replace(places, position_m=position), rows


@pytest.mark.parametrize("runs", [4, pytest.param(15, marks=pytest.mark.slow)])
def test_a_map_of_which_a_third_is_wrong_is_nearly_as_good(runs):
    off, off_right, gated, ungated = [], [], [], []
    for seed in range(runs):
        rng, true = world(seed)
        places = surveyed(rng, true.landmark, 0.03)
        wrong, rows = moved(rng, places, 0.3)
        for which, where in ((places, off_right), (wrong, off)):
            _, located = run(true, which)
            assert not np.isnan(located[20].pose).any()
            where.append(np.sqrt((errors(true, located)[20:, :2] ** 2).sum(axis=1).mean()))
        place = np.concatenate([one.place for one in located])
        p_inlier = np.concatenate([one.p_inlier for one in located])
        gated.append(np.mean(p_inlier[np.isin(place, rows)] < 0.5))
        ungated.append(np.mean(p_inlier[~np.isin(place, rows)] > 0.5))
    assert np.mean(gated) > 0.97
    assert np.mean(ungated) > 0.97
    assert np.median(off) < 1.4 * np.median(off_right)
    assert max(off) < 0.1


def test_wrong_identities_are_gated():
    rng, true = world(0)
    places = surveyed(rng, true.landmark, 0.03)
    swapped, sightings = [], []
    for seen in true.sightings:
        names = seen.landmark_id.copy()
        wrong = rng.random(len(names)) < 0.1
        names[wrong] = (names[wrong] + rng.integers(1, COUNT, wrong.sum())) % COUNT
        swapped.append(wrong)
        sightings.append(seen._replace(landmark_id=names))
    _, located = run(replace(true, sightings=sightings), places)
    p_inlier, wrong = np.concatenate([one.p_inlier for one in located]), np.concatenate(swapped)
    assert np.mean(p_inlier[wrong] < 0.5) > 0.95
    assert np.mean(p_inlier[~wrong] > 0.5) > 0.97
    assert np.nanmax(np.abs(errors(true, located)[20:, :2])) < 0.15


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))])
def test_who_is_carried_away_finds_out(seed):
    rng, before = world(seed, n_frames=80)
    after = driven(rng, before.landmark, n_frames=80, start=np.array([-4.0, 4.0, 2.0]), states=before.states)
    localizer, located = run(before, surveyed(rng, before.landmark, 0.03))
    assert np.abs(errors(before, located)[-1, :2]).max() < 0.15
    late = before.stamp_s[-1] + 0.2
    drive = Drive(after.drive.stamp_s + late, after.drive.velocity, after.drive.unknown)
    frames = zip(after.stamp_s + late, after.sightings, strict=True)
    located = [localizer.step(stamp, drive, seen) for stamp, seen in frames]
    assert np.linalg.norm(errors(after, located)[15:, :2], axis=1).max() < 0.3
    assert not any(one.lost for one in located[15:])


def test_where_a_landmark_has_several_places_the_right_one_is_chosen():
    rng, true = world(3)
    others = true.landmark[:, None, :] + np.where(rng.random((COUNT, 2, 2)) < 0.5, -1, 1) * rng.uniform(
        0.4, 2.0, (COUNT, 2, 2)
    )
    sites = np.concatenate([true.landmark[:, None], others], axis=1) + rng.normal(0, 0.02, (COUNT, 3, 2))
    stands = rng.permuted(np.tile([0, 1, 2], (COUNT, 1)), axis=1)  # column of the site that each row is
    ordered = np.take_along_axis(sites, stands[..., None], axis=1)
    p_here = np.where(rng.random((COUNT, 1)) < 0.7, np.where(stands == 0, 0.8, 0.1), np.where(stands == 1, 0.8, 0.1))
    places = KnownPlaces.of(
        np.repeat(np.arange(COUNT), 3),
        ordered.reshape(-1, 2),
        np.tile(0.02**2 * np.eye(2), (3 * COUNT, 1, 1)),
        p_here.ravel(),
    )
    _, located = run(true, places)
    place = np.concatenate([one.place for one in located[5:]])
    assert np.mean(stands.ravel()[place[place >= 0]] == 0) > 0.99
    assert np.nanmax(np.abs(errors(true, located)[20:, :2])) < 0.15
    # a miss is one of the most probable place alone, and of a landmark that was not detected at another one either
    best = np.zeros(3 * COUNT, dtype=bool)
    best[places.most_probable()] = True
    for one, seen in zip(located, true.sightings, strict=True):
        assert best[one.expected[one.missed]].all()
        assert (places.p_here[one.expected[one.missed]] >= 0.5).all()
        assert not np.isin(places.landmark_id[one.expected[one.missed]], seen.landmark_id).any()


def test_nothing_is_claimed_before_the_map_fixes_the_pose():
    rng, true = world(4)
    places = surveyed(rng, true.landmark, 0.03)
    blind = [
        seen if k > 30 else seen._replace(landmark_id=seen.landmark_id + 1000) for k, seen in enumerate(true.sightings)
    ]
    _, located = run(replace(true, sightings=blind), places)
    assert all(np.isnan(one.pose).all() and one.lost and len(one.expected) == 0 for one in located[:31])
    assert np.isfinite(located[40].pose).all()
    elsewhere = replace(places, position_m=places.position_m[::-1].copy())
    _, located = run(true, elsewhere)
    assert sum(np.isfinite(one.pose[0]) for one in located) < len(located) / 10


def test_expected_is_what_is_in_view_of_the_whole_map():
    rng, true = world(5)
    places = surveyed(rng, place_randomly(rng, 2000, 60.0), 0.03)
    places = replace(places, position_m=np.vstack([true.landmark, places.position_m[COUNT:]]))
    _, located = run(true, places)
    for one in located[5::20]:
        p = NominalField(SENSOR).p_detect(one.pose[None], places.position_m)[0]
        well = np.flatnonzero(p >= 0.1)
        assert np.isin(well, one.expected).all()
        assert one.p_detect == pytest.approx(p[one.expected])


def test_the_order_of_the_map_does_not_matter():
    rng, true = world(6)
    places = surveyed(rng, true.landmark, 0.05)
    _, located = run(true, places)
    order = rng.permutation(COUNT)
    other = KnownPlaces.of(order, places.position_m[order], places.covariance_m2[order], np.ones(COUNT))
    _, again = run(true, other)
    assert np.array([one.pose for one in again]) == pytest.approx(
        np.array([one.pose for one in located]), abs=1e-4
    )  # where iterations end


@pytest.mark.parametrize("runs", [4, pytest.param(20, marks=pytest.mark.slow)])
def test_of_a_map_without_end_only_the_places_used_last_are_considered(monkeypatch, runs):
    """And forgetting the others makes it no less consistent: they are seldom seen again."""
    monkeypatch.setattr(localize, "MOST_CONSIDERED", 64)
    of_pose = 0.0
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        true = driven(rng, place_randomly(rng, 250, 22.0), n_frames=200)
        localizer, located = run(true, surveyed(rng, true.landmark, 0.05))
        assert len(localizer.considered) <= 64
        assert len(np.unique(np.concatenate([one.place for one in located]))) > 64
        of_pose += nees(errors(true, located)[-1:], located[-1].covariance[None])[0]
    assert within_chance(of_pose, 3 * runs)


@pytest.mark.parametrize("seed", range(4))
def test_neighbours_are_those_of_brute_force(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 10, (int(rng.integers(0, 500)), 2))
    for reach_m in (0.5, 4.0, 30.0, np.inf):
        near = Neighbourhood(points, reach_m)
        for centre in rng.normal(0, 15, (20, 2)):
            expected = np.flatnonzero(np.linalg.norm(points - centre, axis=1) <= reach_m)
            assert near(centre).tolist() == expected.tolist()


def test_frames_without_detections_are_driven_by_odometry():
    rng, true = world(7)
    places = surveyed(rng, true.landmark, 0.02)
    empty = true.sightings[0]._replace(
        landmark_id=np.zeros(0, np.int64), reading=np.zeros((0, 2)), sigma_given=np.zeros((0, 2))
    )
    blind = [empty if 60 < k < 110 else seen for k, seen in enumerate(true.sightings)]
    _, located = run(replace(true, sightings=blind), places)
    error = errors(true, located)
    assert within_chance(nees(error[109:110], located[109].covariance[None])[0], 3)
    assert np.linalg.det(located[109].covariance) > 10 * np.linalg.det(located[60].covariance)
    assert np.abs(error[115:, :2]).max() < 0.15


def test_readings_that_are_no_numbers_are_not_used():
    rng, true = world(8)
    places = surveyed(rng, true.landmark, 0.02)
    spoilt = [
        seen._replace(reading=np.where(rng.random((len(seen.reading), 1)) < 0.2, np.nan, seen.reading))
        for seen in true.sightings
    ]
    _, located = run(replace(true, sightings=spoilt), places)
    assert np.abs(errors(true, located)[20:, :2]).max() < 0.15
