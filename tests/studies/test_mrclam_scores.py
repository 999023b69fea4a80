"""The share of the odometry, where it can be worked out with pencil and paper."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.metrics.summary import in_view
from evermap.slam.calibration import SPECS
from evermap.slam.kernels import NOISE_NAMES
from evermap.types import (
    Detections,
    Frames,
    Innovations,
    Landmarks,
    Misses,
    Odometry,
    ParameterEstimate,
    Recording,
    SlamResult,
    Trajectory,
)
from evermap_studies.mrclam.scores import odometry_between_true_poses

GAP_S, JOLT_RAD = 20.0, 0.2


def still_robot(seen_s: np.ndarray, jolt_s: float | None) -> Recording:
    """A robot that stands still; its odometry once claims to have turned by `JOLT_RAD` within 0.1 s."""
    stamp = np.round(np.arange(0.0, 60.01, 0.1), 6)
    turn = np.zeros(len(stamp))
    if jolt_s is not None:
        turn[np.argmin(np.abs(stamp - jolt_s))] = JOLT_RAD / 0.1
    count = len(seen_s)
    blank, zeros = np.full(count, np.nan), np.zeros(count, dtype=np.int64)
    return Recording(
        name="still",
        odometry=Odometry(stamp, np.zeros(len(stamp)), np.zeros(len(stamp)), turn),
        frames=Frames(seen_s),
        detections=Detections(np.arange(count), zeros + 7, blank * 0 + 2.0, blank * 0, zeros - 1, blank, blank, zeros),
        truth=Trajectory(stamp, np.zeros((len(stamp), 3)), np.zeros((len(stamp), 3, 3)), "truth"),
    )


def result_over(first_s: float, last_s: float) -> SlamResult:
    """A result of which only the span and the parameters are looked at: nominal calibration, noise of turning only."""
    empty, none = np.zeros(0), np.zeros(0, dtype=np.int64)
    stamps = np.array([first_s, last_s])
    trajectory = Trajectory(stamps, np.zeros((2, 3)), np.zeros((2, 3, 3)))
    noise = dict.fromkeys(("sigma_range_m", "sigma_bearing_rad", *NOISE_NAMES), 1e-6)
    noise["sigma_turn_per_sqrt_s"] = 0.1
    values = {spec.name: spec.mean for spec in SPECS} | noise
    return SlamResult(
        trajectory=trajectory,
        online=trajectory,
        landmarks=Landmarks.at([7], [[2.0, 0.0]]),
        parameters=tuple(ParameterEstimate(name, value, 0.0, 0.0, 0.0, "") for name, value in values.items()),
        innovations=Innovations(empty, none, none, empty, empty),
        misses=Misses(none, none, empty),
        step_s=empty,
        dead_reckoning=trajectory,
    )


def test_a_jolt_between_two_sightings_is_shared_out_over_the_gap() -> None:
    """With noise that grows with time alone, the closing error is spread evenly: a saw tooth around the jolt."""
    seen = np.array([0.0, 1.0, 1.0 + GAP_S, 2.0 + GAP_S])
    middle = 1.0 + GAP_S / 2
    errors = odometry_between_true_poses(still_robot(seen, middle), result_over(seen[0], seen[-1]))
    assert errors is not None
    share = (errors.stamp_s - 1.0) / GAP_S
    expected = np.where(errors.stamp_s <= middle, -JOLT_RAD * share, JOLT_RAD * (1.0 - share))
    expected[(errors.stamp_s < 1.0) | (errors.stamp_s > 1.0 + GAP_S)] = 0.0
    expected -= expected.mean()  # a robot that never moves is aligned by its mean heading
    np.testing.assert_allclose(errors.heading_error_rad, expected, atol=2e-3)
    assert errors.rmse_m < 1e-3


def test_perfect_odometry_leaves_nothing() -> None:
    seen = np.array([0.0, 1.0, 30.0, 31.0])
    errors = odometry_between_true_poses(still_robot(seen, None), result_over(seen[0], seen[-1]))
    assert errors is not None
    assert errors.rmse_m < 1e-9
    assert errors.heading_rmse_deg < 1e-6


def test_a_jolt_that_sightings_surround_closely_hardly_matters() -> None:
    seen = np.arange(0.0, 40.0, 0.25)
    errors = odometry_between_true_poses(still_robot(seen, 20.1), result_over(0.0, 39.75))
    assert errors is not None
    assert errors.heading_rmse_deg < 1.0


@pytest.mark.parametrize("truth", ["none", "short"])
def test_without_enough_truth_there_is_no_bound(truth: str) -> None:
    recording = still_robot(np.array([0.0, 1.0, 30.0]), None)
    known = recording.truth
    assert known is not None
    rows = known.stamp_s > 40.0  # begins after the last sighting
    short = replace(known, **{key: getattr(known, key)[rows] for key in ("stamp_s", "pose_world_robot", "covariance")})
    recording = replace(recording, truth=None if truth == "none" else short)
    assert odometry_between_true_poses(recording, result_over(0.0, 60.0)) is None


def test_in_view_is_within_a_second_of_a_sighting() -> None:
    rng = np.random.default_rng(3)
    seen = np.sort(rng.uniform(0.0, 60.0, 12))
    stamps = rng.uniform(-3.0, 63.0, 500)
    brute = [any(abs(stamp - one) <= 1.0 for one in seen) for stamp in stamps]
    np.testing.assert_array_equal(in_view(still_robot(seen, None), stamps), brute)
