"""Tagged forklifts in the plane: what is seen of them while they drive tells nothing of a place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import Config
from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.pipeline import run_session, run_slam
from evermap.slam.moving_bodies import without_motion
from evermap.types import BoolArray, Recording, SlamResult, rows_of
from evermap_studies.worlds.yard import STEP_S, YardConfig, YardDrive, flatten, simulate_yard

CONFIG = Config()


def flat(drive: YardDrive, *, stated: bool = True) -> Recording:
    """Return a drive in the plane, with what is stated of forklifts."""
    found = flatten(drive.recording)
    return found if stated else replace(found, objects=found.objects[:0])


def yard(seed: int, *, standing: bool = False) -> YardDrive:
    """Six forklifts that drive and stop, or stand."""
    config = YardConfig(moving=6, parked=0, oriented=False, standing=standing, drive_s=40.0)
    return simulate_yard(config, seed)[0]


def error_m(result: SlamResult, drive: YardDrive) -> float:
    """Root mean square of errors of positions."""
    truth = drive.recording.truth
    assert truth is not None
    there = truth.pose_world_robot[np.searchsorted(truth.stamp_s, result.trajectory.stamp_s - 1e-6), :2]
    here = result.trajectory.pose_world_robot[:, :2]
    off = se2.transform(rigid(here, there), here) - there
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def is_moving(recording: Recording, drive: YardDrive) -> BoolArray:
    """(M,) detections of forklifts that drive at that time."""
    seen, stamps = recording.detections, recording.frames.stamp_s
    step = np.rint((stamps[seen.frame] - drive.recording.frames.stamp_s[0]) / STEP_S).astype(np.int64)
    body = drive.body_of_tag[seen.landmark_id]
    return np.asarray((body >= 0) & drive.moves[np.maximum(body, 0), step])


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_what_moves_is_left_out_and_nothing_else_much(seed: int) -> None:
    drive = yard(seed)
    recording = flat(drive)
    kept, told = without_motion(recording, CONFIG)
    before, after = is_moving(recording, drive), is_moving(kept, drive)
    assert before.sum() > 60
    assert after.sum() < 0.1 * before.sum()
    left_out = len(before) - len(after)
    assert left_out < 2.5 * before.sum()  # with margins before and after each motion
    walls = [(drive.body_of_tag[one.detections.landmark_id] < 0).sum() for one in (recording, kept)]
    assert walls[0] == walls[1]
    assert "moved meanwhile" in told[0]


def test_poses_are_those_of_the_yard_that_stands() -> None:
    """Without it they are ten times as wrong, after minutes of search."""
    moving, standing = (run_slam(flat(yard(1, standing=still))) for still in (False, True))
    errors = error_m(moving, yard(1)), error_m(standing, yard(1, standing=True))
    assert errors[0] < 1.2 * errors[1]
    assert any("moved meanwhile" in one for one in moving.warnings)
    assert not any("moved meanwhile" in one for one in standing.warnings)
    entered = run_session(flat(yard(1)))
    assert any("moved meanwhile" in one for one in entered.slam.warnings)
    assert error_m(entered.slam, yard(1)) < 1.3 * errors[1]


def test_nothing_is_left_out_of_what_stands_is_not_stated_or_cannot_be_told() -> None:
    drive = yard(1)
    assert without_motion(flat(yard(1, standing=True)), CONFIG)[1] == ()
    assert without_motion(flat(drive, stated=False), CONFIG)[1] == ()
    recording = flat(drive)
    seen = recording.detections
    two = np.unique(seen.landmark_id[drive.body_of_tag[seen.landmark_id] < 0])[:2]
    few = replace(
        recording, detections=rows_of(seen, (drive.body_of_tag[seen.landmark_id] >= 0) | np.isin(seen.landmark_id, two))
    )
    assert without_motion(few, CONFIG)[0] is few
    nameless = CONFIG.model_copy(update={"slam": CONFIG.slam.model_copy(update={"unknown_ids": True})})
    assert without_motion(recording, nameless)[0] is recording


def test_a_noisy_sensor_does_not_make_bodies_move() -> None:
    """Nothing is stated of its noise, which is learned from what is on no body."""
    recording = flat(yard(1, standing=True))
    seen, rng = recording.detections, np.random.default_rng(0)
    unsaid, some = np.full(len(seen), np.nan), np.flatnonzero(np.isfinite(seen.range_m))
    assert recording.sensor.sigma_range_m is None
    range_m, bearing_rad = seen.range_m.copy(), seen.bearing_rad.copy()
    range_m[some] = np.maximum(range_m[some] + rng.normal(0.0, 0.5, len(some)), 0.2)
    bearing_rad[some] += rng.normal(0.0, 0.1, len(some))
    noisy = replace(
        seen, range_m=range_m, bearing_rad=bearing_rad, sigma_range_m=unsaid.copy(), sigma_bearing_rad=unsaid.copy()
    )
    kept, _ = without_motion(replace(recording, detections=noisy), CONFIG)
    assert len(noisy) - len(kept.detections) < 0.02 * len(noisy)
