"""One of two cameras is late: by pairs of sightings, and by the solution, in which each sensor has its own delay."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evermap.config import Config
from evermap.metrics.summary import compare_with_truth
from evermap.pipeline import run_slam
from evermap.slam.clocks import are_of_several_clocks
from evermap.slam.plane import in_its_space
from evermap.types import Landmarks, SpatialRecording, VerdictKind, is_in_space
from evermap_studies.causes.drives import MAKES, as_recording, simulate
from evermap_studies.causes.mistakes import late

CONFIG = Config()


def two_cameras(seed: int, late_s: float, *, in_map: bool = False) -> tuple[SpatialRecording, Landmarks | None]:
    """A robot on a field sees tags as poses with two cameras, of which the one that looks back is late."""
    drive = late(late_s, 1)(simulate(MAKES["poses"], seed, in_map=in_map), np.random.default_rng(0))
    recording: Any = as_recording(drive)
    return recording, drive.places


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
@pytest.mark.parametrize("late_s", [0.0, 0.08, -0.15, 0.4])
def test_sensors_of_several_clocks_are_estimated_in_space(seed: int, late_s: float) -> None:
    """In the plane all detections are one sensor's."""
    recording, _ = two_cameras(seed, late_s)
    assert are_of_several_clocks(recording, CONFIG.slam.check) == (late_s != 0.0)
    assert is_in_space(in_its_space(recording, CONFIG.slam)) == (late_s != 0.0)


@pytest.mark.parametrize(
    ("seed", "late_s", "in_map"),
    [
        (2, 0.15, False),  # in the plane: .161 m, by odometry alone .118, sound
        # what is late errs for long: the odometry was held for exact, .105 m, NEES 27, sound
        pytest.param(1, 0.15, True, marks=pytest.mark.slow),
        pytest.param(1, 0.4, True, marks=pytest.mark.slow),  # the same
        # a delay that was held seemed to be all jitter, and both were given up: .149 m
        pytest.param(3, 0.15, True, marks=pytest.mark.slow),
    ],
)
def test_a_late_camera_of_two_is_named_and_poses_are_right(seed: int, late_s: float, in_map: bool) -> None:
    recording, places = two_cameras(seed, late_s, in_map=in_map)
    result = run_slam(recording, prior_map=places)
    assert [(cause.code, cause.subject) for cause in result.causes] == [("clock", "back")]
    assert result.causes[0].value == pytest.approx(late_s, abs=0.01)
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SOUND
    poses = compare_with_truth(recording, result, rate_hz=20.0).poses
    assert poses is not None
    assert poses.rmse_m < 0.015
    assert np.median(poses.nees) < 4.0 * poses.dof
