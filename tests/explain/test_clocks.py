"""Which clock is late: motions that were measured are never stamped before they were; commands are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evermap import run_slam
from evermap.config import SlamConfig
from evermap.explain.faults import find_unseen_jumps
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.slam.calibration import DELAY
from evermap.slam.estimate import Solved, solve
from evermap.slam.method import Rival
from evermap.slam.result import concluded
from evermap.types import UNKNOWN, ChangeKind, MapChange, Measurements, Recording, SlamResult

from .worlds import World


def record(late_s: float, *, is_measured: bool = True) -> Recording:
    """A robot that turns and changes its speed, and a sensor that stamps its frames late."""
    recording = World(seed=3, seconds=40.0, late_s=late_s).plane()
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


def solved_late() -> tuple[Solved, Recording, float]:
    """The solution of a recording whose sensor is late, and the recording at the stamps that it should have had."""
    late = record(0.2)
    solved = solve(late, SlamConfig())
    late_s = -float(solved.outcome.estimate.states[DELAY])
    right = replace(late, frames=replace(late.frames, stamp_s=late.frames.stamp_s - late_s))
    return solved, right, late_s


def test_a_solution_at_earlier_frames_is_that_of_a_recording_with_these() -> None:
    solved, right, late_s = solved_late()
    moved = solved.with_earlier_frames(right, late_s)
    assert moved is not None
    again, result = concluded(solve(right, SlamConfig())), concluded(moved)
    np.testing.assert_array_equal(result.trajectory.stamp_s, again.trajectory.stamp_s)
    path, other = result.trajectory, again.trajectory
    sigma = np.sqrt(np.diagonal(other.covariance, axis1=1, axis2=2))
    sigma[0] = np.inf  # the first is where it is
    assert np.abs((path.pose_world_robot - other.pose_world_robot) / sigma).max() < 0.1
    np.testing.assert_allclose(np.diagonal(path.covariance, axis1=1, axis2=2)[1:], sigma[1:] ** 2, rtol=0.15)
    for stamp_s in ("first_seen_s", "last_seen_s"):
        np.testing.assert_allclose(getattr(result.landmarks, stamp_s), getattr(again.landmarks, stamp_s))
    np.testing.assert_allclose(result.innovations.stamp_s, again.innovations.stamp_s)
    assert moved.outcome.estimate.states[DELAY] == 0.0
    # motions between frames are those of the same odometry, so residuals are the same to rounding
    before, after = (one.outcome.problem for one in (solved, moved))
    motion = before.drive.between(before.stamp_s, solved.outcome.graph_estimate.states)
    same = after.drive.between(after.stamp_s, moved.outcome.graph_estimate.states)
    np.testing.assert_allclose(same.increment, motion.increment, atol=1e-9)


def test_what_changed_within_a_session_was_earlier_too() -> None:
    solved, right, late_s = solved_late()
    change = MapChange((0,), ChangeKind.MOVED, 10.0, 20.0, (0.5, 0.0), 0.0, 0.9)
    rival = Rival((change,), 0.1, np.zeros((1, 2)), np.zeros((1, 2, 2)))
    revision = replace(solved.outcome.revision, changes=(change,), rivals=(rival,))
    solved = replace(solved, outcome=replace(solved.outcome, revision=revision))
    moved = solved.with_earlier_frames(right, late_s)
    assert moved is not None
    for one in (*moved.outcome.revision.changes, *moved.outcome.revision.rivals[0].changes):
        assert (one.stamp_from_s, one.stamp_to_s) == pytest.approx((10.0 - late_s, 20.0 - late_s))


def test_a_solution_is_not_taken_over_where_frames_come_before_the_odometry() -> None:
    solved, right, late_s = solved_late()
    assert right.odometry is not None
    since_s = 0.5 * (right.frames.stamp_s[0] + solved.recording.frames.stamp_s[0])
    odometry = right.odometry[right.odometry.stamp_s >= since_s]
    assert solved.with_earlier_frames(replace(right, odometry=odometry), late_s) is None
    fixes = solve(replace(right, odometry=odometry), SlamConfig())  # but solved again
    assert len(fixes.prepared.used) < len(solved.prepared.used)


def test_a_solution_is_not_taken_over_where_other_measurements_tie_frames_to_their_own_stamps() -> None:
    solved, right, late_s = solved_late()
    place = np.full(1, UNKNOWN)
    tied = Measurements("loop", np.array([5.0]), {"to_stamp_s": np.array([6.0])}, place)
    assert solved.with_earlier_frames(replace(right, measurements=(tied,)), late_s) is None


def test_a_late_sensor_costs_no_second_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    made = list[Recording]()

    def counted(recording: Recording, *args: Any, **more: Any) -> Solved:
        made.append(recording)
        return solve(recording, *args, **more)

    monkeypatch.setattr("evermap.maps.sessions.solve.solve", counted)
    result = run_slam(record(0.2))
    assert [(one.code, one.subject) for one in result.causes] == [("clock", "sensor")]
    assert len(made) == 1


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
