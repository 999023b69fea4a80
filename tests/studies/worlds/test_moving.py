"""Objects that park, cross, orbit and leave, against the laws of motion and scipy's distributions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest, chisquare, kstest, poisson, weibull_min

from evermap.errors import ConfigError
from evermap.survival import Exponential, Weibull
from evermap.types import UNKNOWN
from evermap_studies.worlds.moving import CLASSES, Behaviour, MovingClass, MovingRun, MovingWorld, simulate_moving

WORLD = MovingWorld()


@pytest.fixture(scope="module")
def run() -> MovingRun:
    return simulate_moving(WORLD, 0)


def of(run: MovingRun, behaviour: Behaviour) -> np.ndarray:
    """Rows of the objects that behave so."""
    return np.flatnonzero([run.world.classes[c].behaviour is behaviour for c in run.class_id])


def velocity(run: MovingRun) -> np.ndarray:
    """(F - 1, N, 3) by differences."""
    return np.diff(run.position_m, axis=0) / run.world.frame_s


def test_same_seed_same_run() -> None:
    small = replace(WORLD, duration_s=20.0)
    one, same, other = (simulate_moving(small, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.detected_m, same.detected_m)
    np.testing.assert_array_equal(one.position_m, same.position_m)
    assert not np.array_equal(one.position_m, other.position_m)


def test_parked_ones_never_move(run: MovingRun) -> None:
    rows = of(run, Behaviour.PARKED)
    assert np.ptp(run.position_m[:, rows], axis=0).max() == 0.0
    assert run.static[:, rows].all()
    assert run.present[:, rows].all()


def test_crossing_ones_keep_their_velocity_and_never_rest(run: MovingRun) -> None:
    rows = of(run, Behaviour.CROSSING)
    v = velocity(run)[:, rows]
    np.testing.assert_allclose(v, np.broadcast_to(v[0], v.shape), atol=1e-9)
    speed = np.linalg.norm(v[0], axis=1)
    assert speed.min() >= 0.8 - 1e-9
    assert speed.max() <= 1.8 + 1e-9
    assert not run.static[:, rows].any()


def test_orbiting_ones_keep_their_speed_and_their_radius(run: MovingRun) -> None:
    rows = of(run, Behaviour.ORBITING)
    speed = np.linalg.norm(velocity(run)[:, rows], axis=2)
    np.testing.assert_allclose(speed, np.broadcast_to(speed[0], speed.shape), rtol=1e-9)
    for row in rows:  # the circle through all points, by linear least squares
        x, y = run.position_m[:, row, :2].T
        a, b, c = np.linalg.lstsq(np.column_stack([2 * x, 2 * y, np.ones(len(x))]), x**2 + y**2, rcond=None)[0]
        np.testing.assert_allclose(np.hypot(x - a, y - b), np.sqrt(c + a**2 + b**2), rtol=1e-6)
        assert WORLD.orbit_m[0] <= np.sqrt(c + a**2 + b**2) <= WORLD.orbit_m[1]


def test_leaving_ones_stand_for_their_lifetime_and_accelerate_as_they_should(run: MovingRun) -> None:
    rows = of(run, Behaviour.LEAVING)
    v = velocity(run)[:, rows]
    speed = np.linalg.norm(v, axis=2)
    early, late = run.stamp_s[:-1, None], run.stamp_s[1:, None]
    resting = (early >= run.rest_from_s[rows]) & (late <= run.rest_until_s[rows])
    driving = (late < run.rest_from_s[rows]) | (early > run.rest_until_s[rows])
    assert speed[resting].max() == 0.0
    assert speed[driving].min() > 0.0
    most = np.array([WORLD.classes[c].speed_mps[1] for c in run.class_id[rows]])
    assert (speed <= most + 1e-9).all()
    change = np.linalg.norm(np.diff(v, axis=0), axis=2) / WORLD.frame_s
    assert change.max() <= WORLD.acceleration_mps2 * (1.0 + 1e-9)


def test_lifetimes_are_those_of_the_class() -> None:
    life = MovingClass("van", Behaviour.LEAVING, 500, (1.0, 2.0), Weibull(scale_s=50.0, shape=2.0))
    run = simulate_moving(MovingWorld(classes=(life,), duration_s=10.0, spacing_m=0.0), 1)
    stay = run.rest_until_s - run.rest_from_s
    assert kstest(stay, weibull_min(2.0, scale=50.0).cdf).pvalue > 1e-3


def test_places_keep_their_distance() -> None:
    run = simulate_moving(replace(WORLD, classes=CLASSES[:1], duration_s=1.0), 2)
    apart = np.linalg.norm(run.position_m[0][:, None] - run.position_m[0][None], axis=2)
    assert apart[~np.eye(len(apart), dtype=bool)].min() >= WORLD.spacing_m


def test_only_what_is_in_reach_is_detected_as_often_as_it_should(run: MovingRun) -> None:
    frame = np.repeat(np.arange(len(run.stamp_s)), np.diff(run.first))
    true = run.detected_of != UNKNOWN
    reach = run.in_reach()
    assert reach[frame[true], run.detected_of[true]].all()
    assert len(np.unique(np.column_stack([frame[true], run.detected_of[true]]), axis=0)) == true.sum()
    assert binomtest(int(true.sum()), int(reach.sum()), WORLD.p_detect).pvalue > 1e-3
    away = np.linalg.norm(run.position_m - run.sensor_m[:, None], axis=2)
    np.testing.assert_array_equal(reach, (away <= WORLD.reach_m) & run.present)


def test_noise_classes_and_false_alarms(run: MovingRun) -> None:
    frame = np.repeat(np.arange(len(run.stamp_s)), np.diff(run.first))
    true = run.detected_of != UNKNOWN
    off = (run.detected_m[true] - run.position_m[frame[true], run.detected_of[true]]) / WORLD.sigma_m
    assert kstest(off[::7].ravel(), "norm").pvalue > 1e-3
    wrong = run.detected_class[true] != run.class_id[run.detected_of[true]]
    assert binomtest(int(wrong.sum()), len(wrong), WORLD.p_off_class).pvalue > 1e-3
    of_parked = run.class_id[run.detected_of[true]] == 0
    others = np.bincount(run.detected_class[true][wrong & of_parked], minlength=5)
    assert others[0] == 0
    assert chisquare(others[1:]).pvalue > 1e-3

    false = np.bincount(frame[~true], minlength=len(run.stamp_s))
    expected = poisson(WORLD.false_per_frame).pmf([0, 1]) * len(false)
    seen = np.bincount(false)[:2]
    rest = len(false) - seen.sum(), len(false) - expected.sum()
    assert chisquare([*seen, rest[0]], [*expected, rest[1]]).pvalue > 1e-3
    away = np.linalg.norm(run.detected_m[~true, :2] - run.sensor_m[frame[~true], :2], axis=1)
    assert kstest((away / WORLD.reach_m) ** 2, "uniform").pvalue > 1e-3


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: MovingWorld(reach_m=0.0), "reach_m"),
        (lambda: MovingWorld(p_detect=1.5), "p_detect"),
        (lambda: MovingWorld(orbit_m=(2.0, 1.0)), "orbit_m"),
        (lambda: MovingWorld(classes=()), "classes"),
        (lambda: MovingClass("x", Behaviour.PARKED, 0), "count"),
        (lambda: MovingClass("x", Behaviour.LEAVING, 1), "lifetime"),
        (lambda: MovingClass("x", Behaviour.PARKED, 1, lifetime=Exponential(1.0)), "lifetime"),
        (lambda: simulate_moving(MovingWorld(half_extent_m=5.0), 0), "spacing_m"),
    ],
)
def test_what_cannot_be_is_refused(make, field) -> None:
    with pytest.raises(ConfigError) as caught:
        make()
    assert caught.value.field == field
