"""Which clock is late: motions that were measured are never stamped before they were; commands are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap import run_slam
from evermap.explain.faults import find_unseen_jumps
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.types import Recording, SlamResult

from .worlds import World


def record(late_s: float, *, is_measured: bool = True) -> Recording:
    """A robot that turns and changes its speed, and a sensor that stamps its frames late."""
    recording = World(seed=3, late_s=late_s).plane()
    return replace(recording, odometry=replace(recording.odometry, is_measured=is_measured))


def error_m(result: SlamResult, recording: Recording) -> float:
    assert recording.truth is not None
    found = evaluate_trajectory(result.trajectory, recording.truth)
    assert found is not None
    return float(found.rmse_m)


@pytest.mark.parametrize("late_s", [0.05, 0.2])
def test_poses_are_where_the_robot_was_though_the_sensor_is_late(late_s: float) -> None:
    right, late = record(0.0), record(late_s)
    result = run_slam(late)
    assert error_m(result, late) < 1.5 * error_m(run_slam(right), right) + 0.002
    (cause,) = result.causes
    assert (cause.code, cause.subject, cause.fix[:28]) == ("clock", "sensor", "detections.csv, frames.csv: ")
    assert cause.value == pytest.approx(late_s, abs=0.01)
    assert result.verdict is not None
    assert result.verdict.kind == "sound"
    # the state is that of the stamps that were given
    delay = next(one for one in result.parameters if one.name == "odometry_delay_s")
    assert delay.value == pytest.approx(-late_s, abs=0.01)
    assert delay.p_needed == 1.0
    assert 0.0 < delay.sigma < 0.02


@pytest.mark.parametrize("late_s", [0.0, 0.01])
def test_a_clock_that_is_right_is_left_as_it_is(late_s: float) -> None:
    result = run_slam(record(late_s))
    assert not result.causes
    assert result.trajectory.stamp_s[0] == record(late_s).frames.stamp_s[0]


def test_velocities_may_be_commands_which_are_early() -> None:
    """As on recordings whose robots follow their commands late: poses are at the stamps of what was seen."""
    commanded = record(0.2, is_measured=False)
    result = run_slam(commanded)
    assert error_m(result, commanded) > 0.05  # here the sensor is late after all: nothing says so
    assert [(one.code, one.subject) for one in result.causes] == [("clock", "odometry")]
    assert result.trajectory.stamp_s[0] == commanded.frames.stamp_s[0]


def test_no_robot_follows_its_commands_a_second_late() -> None:
    """The clock is told all the same: what is so far off is not as stated."""
    right, late = record(0.0, is_measured=False), record(1.3, is_measured=False)
    result = run_slam(late)
    assert error_m(result, late) < 1.5 * error_m(run_slam(right), right) + 0.002
    assert [(one.code, one.subject) for one in result.causes] == [("clock", "sensor")]
    assert result.causes[0].value == pytest.approx(1.3, abs=0.02)
    assert result.verdict is not None
    assert result.verdict.kind == "sensor suspect"
    slow = record(0.8, is_measured=False)
    assert [(one.code, one.subject) for one in run_slam(slow).causes] != [("clock", "sensor")]


def test_an_odometry_that_is_late_is_no_sensor_that_is_early() -> None:
    recording = record(-0.12)
    result = run_slam(recording)
    assert [(one.code, one.subject) for one in result.causes] == [("clock", "odometry")]
    assert result.trajectory.stamp_s[0] == recording.frames.stamp_s[0]


def test_clocks_that_differ_are_no_jump_while_nothing_is_seen() -> None:
    """A robot that stands, and drives off between two frames that saw something: the clock says when."""
    seen = run_slam(record(0.2, is_measured=False))
    path, count = seen.trajectory, 12
    step = np.arange(count)
    x_m = np.where(step < 6, 0.0, step - 5.62)  # two metres a second, from 0.2 s before the sixth pose on
    pose = np.column_stack([x_m, np.zeros((count, 2))])
    early = np.column_stack([np.maximum(x_m - 0.38, 0.0), np.zeros((count, 2))])
    few = replace(
        path, stamp_s=0.5 * step, pose_world_robot=pose, covariance=path.covariance[:count],
    )  # fmt: skip
    rows = np.isin(np.arange(len(seen.innovations)), [0, 1])
    innovations = replace(seen.innovations[rows], stamp_s=np.array([2.0, 3.0]), p_inlier=np.ones(2))
    result = replace(seen, trajectory=few, dead_reckoning=replace(few, pose_world_robot=early), innovations=innovations)
    assert not find_unseen_jumps(result, np.zeros((0, 2)))
    known = tuple(replace(one, value=0.0) if one.name == "odometry_delay_s" else one for one in seen.parameters)
    assert len(find_unseen_jumps(replace(result, parameters=known), np.zeros((0, 2)))) == 1
