"""The filter of an unmapped place: as uncertain as it says, also where a heading was lost that nothing shows again."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import scipy.stats
from drives import FRAME_S, NOISE, SENSOR, World, driven, nees, place_randomly, prior

from evermap.config import SlamConfig
from evermap.geometry import se2
from evermap.slam.calibration import SLOPE, CalibrationPrior
from evermap.slam.local_filter import Motion
from evermap.slam.localize import FrameSightings
from evermap.slam.mapper import Mapper
from evermap.slam.planar_filter import FrameReadings, PlanarFilter

TURN_SCALE, SETTINGS = 7, SlamConfig(robust=False, estimate_noise=False)
BLIND = range(50, 80)


def beliefs(turn_scale: float) -> CalibrationPrior:
    """Slope as stated: without a map it only shows together with the forward scale."""
    default = prior()
    sigma, free = default.sigma.copy(), default.free.copy()
    sigma[TURN_SCALE], free[SLOPE] = turn_scale, False
    return CalibrationPrior(default.mean, sigma, free)


@cache
def drawn(seed: int, turn_scale: float) -> World:
    rng, believed = np.random.default_rng(seed), beliefs(turn_scale)
    states = believed.mean + believed.sigma * believed.free * rng.normal(size=11)
    return driven(rng, place_randomly(rng, 40, 14.0), n_frames=120, states=states)


def told(seed: int, turn_scale: float, *, blind: bool, view_rad: float = np.pi) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3) errors and (F, 3, 3) covariances of the poses; behind a blind interval all landmarks are new ones."""
    world, believed = drawn(seed, turn_scale), beliefs(turn_scale)
    odometry = np.column_stack([world.drive.stamp_s, world.drive.velocity[:, :3]])[:-1]
    mapper, found = Mapper(SENSOR, believed, NOISE, SETTINGS), []
    for k, seen in enumerate(world.sightings):
        kept = (np.abs(seen.reading[:, 1]) < view_rad) & (not (blind and k in BLIND))
        names = seen.landmark_id[kept] + 1000 * (blind and k >= BLIND.stop)
        found.append(
            mapper.step(k * FRAME_S, odometry, FrameSightings(names, seen.reading[kept], seen.sigma_given[kept]))
        )
    first = next(k for k, one in enumerate(found) if np.isfinite(one.pose[0]))
    true = se2.compose(se2.inverse(world.pose[first]), world.pose)
    error = se2.log(se2.between(np.array([one.pose for one in found]), true))
    return error, np.array([one.covariance for one in found])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("turn_scale", "blind", "view_rad"), [(0.05, False, np.pi), (0.1, True, np.pi), (0.1, True, 0.6)]
)
def test_poses_are_as_uncertain_as_the_filter_says(turn_scale, blind, view_rad):
    runs = 40
    low, high = scipy.stats.chi2.ppf([0.5e-4, 1.0 - 0.5e-4], [3 * runs, 3 * runs])
    heading_low, heading_high = scipy.stats.chi2.ppf([0.5e-4, 1.0 - 0.5e-4], [runs, runs])
    error, covariance = zip(
        *(told(seed, turn_scale, blind=blind, view_rad=view_rad) for seed in range(runs)), strict=True
    )
    for frame in (100, 119):
        wrong, spread = np.array([one[frame] for one in error]), np.array([one[frame] for one in covariance])
        assert low < nees(wrong, spread).sum() < high
        assert heading_low < (wrong[:, 2] ** 2 / spread[:, 2, 2]).sum() < heading_high


def test_new_landmarks_tell_nothing_of_a_heading_that_was_lost():
    """Not by however many updates at however wrong a heading: they only show where the robot is among them."""
    rng, believed = np.random.default_rng(0), prior()
    landmark, still = rng.uniform(-5.0, 5.0, (6, 2)), np.zeros((3, 4))
    local = PlanarFilter(np.zeros(3), CalibrationPrior(believed.mean, believed.sigma, np.zeros(11, dtype=np.bool_)))
    lost = np.zeros((12, 12))
    lost[:3, :3] = np.diag([0.1, 0.1, 0.3]) ** 2
    local.hold(np.zeros(3), believed.mean, lost, np.arange(0), np.full((6, 2), np.nan))
    pose, sigma = np.zeros(3), np.tile([0.05, 0.02], (6, 1))
    for frame in range(60):
        if frame:
            step = np.array([0.2, 0.0, 0.1])
            pose = se2.compose(pose, se2.compose(step, se2.exp([0.05, 0.05, 0.05] * rng.normal(size=3))))
            local.drive(Motion(step, still, 0.05**2 * np.eye(3)))
        away = se2.transform(se2.inverse(pose), landmark)
        reading = np.column_stack([np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0])]) + sigma * rng.normal(
            size=(6, 2)
        )
        for row in range(0 if frame else 6):
            local.meet(row, landmark[row])
        local.update(np.arange(6), FrameReadings(reading, sigma))
    assert np.sqrt(local.covariance[2, 2]) == pytest.approx(0.3, rel=0.02)
