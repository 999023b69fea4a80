"""Ranges without bearings, as of UWB radios: beacons that are named, noisy ranges, odometry."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from typer.testing import CliRunner

from evermap import check_recording, read_recording, run_session, run_slam
from evermap.cli.main import app
from evermap.config import Config
from evermap.errors import DataError
from evermap.geometry import se2
from evermap.io import write_native
from evermap.pipeline import run_localization
from evermap.slam.ranges import has_range_changed, with_bearings, with_bearings_anew
from evermap.slam.silences import find_silences
from evermap.types import (
    UNKNOWN,
    ChangeKind,
    Detections,
    Frames,
    Landmarks,
    Odometry,
    Recording,
    Sensor,
    SensorKind,
    SlamResult,
    Trajectory,
)

STEP_S, REACH_M, SIGMA_M = 0.1, 25.0, 0.1
SIGMA_FORWARD_MPS, SIGMA_TURN_RADPS = 0.03, 0.02


@cache
def drive(
    seed: int, *, minutes: float = 3.0, outliers: float = 0.0, bias_m: float = 0.0, day: int = 0, moved: bool = False
) -> Recording:
    """A winding drive among eight beacons; five ranges a second, of half of the beacons in reach."""
    count = round(60.0 * minutes / STEP_S)
    stamp_s = STEP_S * np.arange(count)
    turn = 0.25 * np.sin(0.11 * stamp_s) + 0.15 * np.sin(0.047 * stamp_s + 1.0 + day) + 0.08
    pose = np.zeros((count, 3))
    for row in range(count - 1):
        pose[row + 1] = se2.compose(pose[row], se2.exp(np.array([0.8 * STEP_S, 0.0, turn[row] * STEP_S])))
    place = np.random.default_rng(seed).uniform((-18.0, -18.0), (10.0, 8.0), (8, 2))
    random = np.random.default_rng([seed, day])
    if moved:
        place[3] += 3.0, -2.0
    looks = np.arange(0, count, 2)
    frame, name, range_m = [], [], []
    for row, look in enumerate(looks.tolist()):
        away = np.linalg.norm(place - pose[look, :2], axis=1)
        for beacon in np.flatnonzero((away < REACH_M) & (random.random(len(place)) < 0.5)).tolist():
            late = random.exponential(2.0) if random.random() < outliers else 0.0
            frame.append(row)
            name.append(beacon)
            range_m.append(max(away[beacon] + random.normal(bias_m, SIGMA_M) + late, 0.05))
    unsaid, unknown = np.full(len(frame), np.nan), np.full(len(frame), UNKNOWN)
    noise = random.normal(size=(2, count))
    then = stamp_s + 86_400.0 * day
    return Recording(
        f"uwb {seed}",
        Odometry(then, 0.8 + SIGMA_FORWARD_MPS * noise[0], np.zeros(count), turn + SIGMA_TURN_RADPS * noise[1]),
        Frames(then[looks]),
        Detections(
            np.array(frame), np.array(name), np.array(range_m), unsaid, unknown, unsaid.copy(), unsaid.copy(), unknown
        ),
        Sensor(range_max_m=REACH_M, kind=SensorKind.UWB),
        truth=Trajectory(then, pose, np.zeros((count, 3, 3)), frame="truth"),
        true_landmarks=Landmarks.at(np.arange(len(place)), place),
    )


def errors(recording: Recording, pose: np.ndarray, stamp_s: np.ndarray, place: np.ndarray) -> tuple[float, float]:
    """Of positions and of landmarks, after the best rigid alignment of the path."""
    assert recording.truth is not None
    assert recording.true_landmarks is not None
    true = recording.truth.pose_world_robot[np.searchsorted(recording.truth.stamp_s, stamp_s - 1e-6), :2]
    u, _, v = np.linalg.svd((pose[:, :2] - pose[:, :2].mean(axis=0)).T @ (true - true.mean(axis=0)))
    turn = u @ np.diag([1.0, np.linalg.det(u @ v)]) @ v
    of_path = (pose[:, :2] - pose[:, :2].mean(axis=0)) @ turn + true.mean(axis=0) - true
    of_map = (place - pose[:, :2].mean(axis=0)) @ turn + true.mean(axis=0) - recording.true_landmarks.position_m
    return float(np.sqrt((of_path**2).sum(axis=1).mean())), float(np.sqrt((of_map**2).sum(axis=1).mean()))


def estimated(recording: Recording, result: SlamResult) -> tuple[float, float]:
    path = result.trajectory
    return errors(recording, path.pose_world_robot, path.stamp_s, result.landmarks.position_m)


def oracle(recording: Recording) -> tuple[float, float]:
    """Least squares by scipy with the true noise, from the truth."""
    assert recording.truth is not None
    assert recording.true_landmarks is not None
    seen, driven, stamp_s = recording.detections, recording.odometry, recording.frames.stamp_s
    rows = np.searchsorted(recording.truth.stamp_s, stamp_s - 1e-6)
    true, place = recording.truth.pose_world_robot[rows], recording.true_landmarks.position_m
    n, count = len(rows), len(place)
    twist = STEP_S * np.column_stack([driven.forward_mps, np.zeros(len(driven)), driven.angular_radps])
    step = se2.compose(se2.exp(twist[rows[:-1]]), se2.exp(twist[rows[:-1] + 1]))
    sigma = np.sqrt(2.0) * STEP_S * np.array([SIGMA_FORWARD_MPS, 1e-3, SIGMA_TURN_RADPS])
    sparsity = lil_matrix((3 * (n - 1) + len(seen) + 3, 3 * n + 2 * count), dtype=np.int64)
    for row in range(n - 1):
        sparsity[3 * row : 3 * row + 3, 3 * row : 3 * row + 6] = 1
    for row, (frame, name) in enumerate(zip(seen.frame.tolist(), seen.landmark_id.tolist(), strict=True)):
        sparsity[3 * (n - 1) + row, 3 * frame : 3 * frame + 2] = 1
        sparsity[3 * (n - 1) + row, 3 * n + 2 * name : 3 * n + 2 * name + 2] = 1
    sparsity[-3:, :3] = 1

    def residual(x: np.ndarray) -> np.ndarray:
        pose, at = x[: 3 * n].reshape(-1, 3), x[3 * n :].reshape(-1, 2)
        off = se2.between(pose[:-1], pose[1:]) - step
        off[:, 2] = se2.wrap(off[:, 2])
        away = np.linalg.norm(at[seen.landmark_id] - pose[seen.frame, :2], axis=1) - seen.range_m
        return np.concatenate([(off / sigma).ravel(), away / SIGMA_M, (pose[0] - true[0]) / 1e-4])

    x = least_squares(residual, np.concatenate([true.ravel(), place.ravel()]), jac_sparsity=sparsity, max_nfev=30).x
    return errors(recording, x[: 3 * n].reshape(-1, 3), stamp_s, x[3 * n :].reshape(-1, 2))


@pytest.mark.slow
def test_the_error_is_near_that_of_an_oracle() -> None:
    found, best = [], []
    for seed in (1, 2, 3):
        recording = drive(seed)
        result = run_slam(recording)
        assert len(result.landmarks) == 8
        assert result.innovations.dof is not None
        assert set(result.innovations.dof[result.innovations.p_inlier > 0.5]) <= {1, 2}
        assert np.mean(result.innovations.dof == 1) > 0.98
        found.append(estimated(recording, result))
        best.append(oracle(recording))
    assert (np.mean(found, axis=0) < 1.3 * np.mean(best, axis=0) + 0.002).all(), (found, best)


def test_an_offset_of_all_ranges_is_found() -> None:
    recording = drive(1, bias_m=0.3)
    result = run_slam(recording)
    [bias] = [one for one in result.parameters if one.name == "range_bias_m"]
    assert abs(bias.value - 0.3) < 3.0 * bias.sigma < 0.05
    assert max(estimated(recording, result)) < 0.05


def test_ranges_around_corners_are_outliers() -> None:
    recording = drive(2, outliers=0.05)
    assert max(estimated(recording, run_slam(recording))) < 0.06


def test_sessions_with_ranges_enter_a_living_map() -> None:
    first = run_session(drive(1))
    second = run_session(drive(1, day=1, moved=True), first.living)
    assert (first.found, second.found) == (True, True)
    [change] = [one for one in second.changes if one.probability > 0.5]
    assert (change.kind, change.landmark_ids) == (ChangeKind.MOVED, (3,))
    assert np.linalg.norm(change.displacement_m[:2]) == pytest.approx(np.hypot(3.0, 2.0), abs=0.15)


def test_a_map_of_the_beacons_locates_the_robot() -> None:
    recording = drive(3)
    assert recording.true_landmarks is not None
    assert recording.truth is not None
    beacons = recording.true_landmarks
    survey = Landmarks.at(beacons.landmark_id, beacons.position_m, sigma_m=0.02, frame="prior_map")
    result = run_slam(recording, prior_map=survey)
    assert result.trajectory.frame == "prior_map"
    rows = np.searchsorted(recording.truth.stamp_s, result.trajectory.stamp_s - 1e-6)
    off = result.trajectory.pose_world_robot[:, :2] - recording.truth.pose_world_robot[rows, :2]
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.06


@pytest.mark.parametrize("seed", [4, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 5))])
def test_a_beacon_that_moved_is_told_by_a_map_of_the_beacons(seed: int) -> None:
    recording, before = drive(seed, day=1, moved=True), drive(seed).true_landmarks
    assert recording.truth is not None
    assert before is not None
    survey = Landmarks.at(before.landmark_id, before.position_m, sigma_m=0.02, frame="prior_map")
    result = run_slam(recording, prior_map=survey)
    [change] = result.changes
    assert (change.kind, change.landmark_ids) == (ChangeKind.MOVED, (3,))
    assert change.displacement_m[:2] == pytest.approx([3.0, -2.0], abs=0.12)
    rows = np.searchsorted(recording.truth.stamp_s, result.trajectory.stamp_s - 1e-6)
    off = result.trajectory.pose_world_robot[:, :2] - recording.truth.pose_world_robot[rows, :2]
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.06


def test_what_ranges_do_not_locate_is_told_and_left_out() -> None:
    """From a straight line a beacon may be on either side."""
    whole = drive(1)
    straight = replace(whole.odometry, angular_radps=np.zeros(len(whole.odometry)))
    at = 0.8 * (whole.frames.stamp_s[whole.detections.frame])
    place = np.column_stack([np.linspace(20.0, 100.0, 8), np.full(8, 5.0)])[whole.detections.landmark_id]
    range_m = np.hypot(place[:, 0] - at, place[:, 1])
    recording = replace(whole, odometry=straight, detections=replace(whole.detections, range_m=range_m))
    none = "no landmark is located by its ranges alone"
    with pytest.raises(DataError, match=none):
        run_slam(recording)
    [finding] = [one for one in check_recording(recording).findings if not one.usable]  # `check` says what `slam` says
    assert finding.code == "too-little"
    assert finding.message.startswith(none)
    some = np.zeros(len(recording.detections))
    some[recording.detections.landmark_id != 5] = np.nan  # what has a bearing is used without the ranges
    given = replace(recording, detections=replace(recording.detections, bearing_rad=some))
    found, remarks = with_bearings(given, Config().slam)
    assert (found.detections.landmark_id[recording.detections.landmark_id == 5] == 5).all()
    some[recording.detections.landmark_id == 5] = np.where(np.arange((~np.isnan(some)).sum()) % 9, 0.1, np.nan)
    found, remarks = with_bearings(
        replace(given, detections=replace(given.detections, bearing_rad=some)), Config().slam
    )
    assert remarks[1] == "landmarks that their ranges do not locate not used: 0, 1, 2, 3, 4, 6, 7"


def test_bearings_that_are_there_are_kept() -> None:
    recording = drive(1)
    some = recording.detections.bearing_rad.copy()
    some[::3] = 0.1
    given = replace(recording, detections=replace(recording.detections, bearing_rad=some))
    found, remarks = with_bearings(given, Config().slam)
    assert (found.detections.bearing_rad[::3] == 0.1).all()
    assert np.isnan(found.detections.sigma_bearing_rad[::3]).all()
    assert np.isfinite(found.detections.bearing_rad).all()
    assert remarks == (f"{int(np.isnan(some).sum())} detections without a bearing: only their ranges are used",)
    assert with_bearings(found, Config().slam) == (found, ())


@pytest.mark.parametrize("column", ["empty", "absent"])
def test_tables_without_bearings(column: str, tmp_path: Path) -> None:
    folder = write_native(drive(1, minutes=1.0), tmp_path / "uwb")
    if column == "absent":
        rows = (folder / "detections.csv").read_text("utf-8").splitlines()
        assert rows[0] == "stamp_s,landmark_id,range_m,bearing_rad"
        short = [row.rpartition(",")[0] for row in rows]
        (folder / "detections.csv").write_text("\n".join(short), encoding="utf-8")
    recording = read_recording(folder)
    assert recording.dim == 2
    assert np.isnan(recording.detections.bearing_rad).all()
    assert recording.detections.range_m == pytest.approx(drive(1, minutes=1.0).detections.range_m)
    check = check_recording(recording)
    assert check.findings == ()
    assert check.contents["detections"]["without_bearing"] == len(recording.detections)
    printed = CliRunner().invoke(app, ["check", str(folder)])
    assert printed.exit_code == 0
    assert f"{len(recording.detections):,} detections without a bearing" in printed.stdout


def test_ranges_are_converted_to_parquet_and_back(tmp_path: Path) -> None:
    write_native(drive(1), tmp_path / "csv")
    for given, to in (("csv", "parquet"), ("parquet", "csv")):
        done = CliRunner().invoke(app, ["convert", str(tmp_path / given), str(tmp_path / f"as {to}"), "--format", to])
        assert done.exit_code == 0, done.stderr
        (tmp_path / f"as {to}").rename(tmp_path / to if to == "parquet" else tmp_path / "again")
    for name in ("detections.csv", "odometry.csv", "frames.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "csv" / name).read_bytes()
    table = parquet.read_table(tmp_path / "parquet" / "detections.parquet")
    misspelt = ["bearng_rad" if name == "bearing_rad" else name for name in table.column_names]
    parquet.write_table(table.rename_columns(misspelt), tmp_path / "parquet" / "detections.parquet")
    refused = CliRunner().invoke(app, ["convert", str(tmp_path / "parquet"), str(tmp_path / "none")])
    assert refused.exit_code == 2
    assert "detections.parquet: field 'bearng_rad': unknown column (try: bearing_rad)" in refused.stderr


def test_what_ranges_cannot_do_is_told() -> None:
    recording = drive(1)
    with pytest.raises(DataError, match=r"field 'bearing_rad'.*without a bearing need a landmark_id"):
        run_slam(recording, Config(slam={"unknown_ids": True}))
    living = run_session(recording).living
    with pytest.raises(DataError, match=r"field 'bearing_rad'.*not causal \(try: enter the session"):
        run_localization(drive(1, day=1), living)


def turning_too_much(recording: Recording, by_radps: float) -> Recording:
    driven = recording.odometry
    return replace(recording, odometry=replace(driven, angular_radps=driven.angular_radps + by_radps))


def test_first_bearings_are_those_of_the_odometry_that_is_used() -> None:
    """Those by a gyroscope whose zero is off would all be turned, as a sensor in its mount."""
    settings = Config().slam
    right = drive(1)
    found, _ = with_bearings(right, settings)
    off, _ = with_bearings(turning_too_much(right, 0.02), settings)
    assert np.abs(off.detections.bearing_rad - found.detections.bearing_rad).max() > 0.5
    anew = with_bearings_anew(replace(off, odometry=right.odometry), settings)
    for name in ("bearing_rad", "sigma_bearing_rad", "range_m", "landmark_id"):
        assert np.array_equal(getattr(anew.detections, name), getattr(found.detections, name))


def test_bearings_that_were_measured_stay() -> None:
    settings = Config().slam
    right = drive(1)
    seen = right.detections
    own = seen.landmark_id == 2
    mixed = replace(seen, bearing_rad=np.where(own, 0.1, np.nan), sigma_bearing_rad=np.where(own, 0.02, np.nan))
    found, _ = with_bearings(replace(right, detections=mixed), settings)
    anew = with_bearings_anew(turning_too_much(found, 0.02), settings).detections
    assert np.array_equal(anew.bearing_rad[own], np.full(int(own.sum()), 0.1))
    assert not np.array_equal(anew.bearing_rad[~own], found.detections.bearing_rad[~own])
    measured = replace(
        right, detections=replace(seen, bearing_rad=np.zeros(len(seen)), sigma_bearing_rad=np.full(len(seen), 0.02))
    )
    assert with_bearings_anew(measured, settings) is measured
    lost = replace(found, detections=replace(found.detections, landmark_id=np.where(own, 2, UNKNOWN)))
    assert with_bearings_anew(lost, settings) is lost


def test_a_gyroscope_whose_zero_is_off_is_put_right_by_ranges_alone() -> None:
    result = run_slam(turning_too_much(drive(1), 0.02))
    (cause,) = result.causes
    assert (cause.code, cause.value) == ("turn-bias", pytest.approx(0.02, abs=0.002))
    askew = next(one for one in result.parameters if one.name == "odometry_askew_rad")
    assert abs(askew.value) < 0.03


STOP_S = (60.0, 68.0)


def stopping(recording: Recording, *, seen: bool = False) -> Recording:
    """The odometry says that the robot stands for a while; if `seen`, ranges say so, too."""
    driven, frame_s = recording.odometry, recording.frames.stamp_s
    still = (driven.stamp_s >= STOP_S[0]) & (driven.stamp_s < STOP_S[1])
    columns = {name: np.where(still, 0.0, getattr(driven, name)) for name in ("forward_mps", "angular_radps")}
    detections = recording.detections
    if seen:
        stamp_s, range_m = frame_s[detections.frame], detections.range_m.copy()
        noise = SIGMA_M * np.random.default_rng(2).normal(size=len(range_m))
        for name in np.unique(detections.landmark_id):
            rows = np.flatnonzero((detections.landmark_id == name) & (stamp_s >= STOP_S[0]) & (stamp_s < STOP_S[1]))
            range_m[rows] = range_m[rows[:1]] + noise[rows]
        detections = replace(detections, range_m=range_m)
    return replace(recording, odometry=replace(driven, **columns), detections=detections)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_ranges_say_that_a_robot_drives_that_says_it_stands(seed: int) -> None:
    rules = Config().slam.check
    (found,) = find_silences(stopping(drive(seed)), rules)
    assert found == pytest.approx(STOP_S, abs=0.11)
    assert not len(find_silences(stopping(drive(seed), seen=True), rules))
    assert not len(find_silences(drive(seed), rules))


def test_a_range_has_changed_by_more_than_its_noise_and_than_a_robot_sways() -> None:
    """By noise of 5 cm three standard deviations of a difference are 21 cm; with none, 2 % of the range count."""
    noise = 0.05 * np.random.default_rng(1).normal(size=4000)
    first, second = np.array([0, 0]), np.array([4000, 4001])
    for sigma, least_m in ((1.0, 3.0 * 2.0**0.5 * 0.05), (0.0, 0.02 * 8.0)):
        range_m = np.append(8.0 + sigma * noise, [0.0, 0.0])
        range_m[4000:] = range_m[0] + least_m * np.array([0.93, 1.07])
        one = drive(1)
        nothing = np.full(len(range_m), np.nan)
        frame = np.arange(len(range_m))
        seen = Detections(
            frame, np.zeros(len(frame), dtype=int), range_m, nothing, np.full(len(frame), UNKNOWN), nothing, nothing,
            np.full(len(frame), UNKNOWN),
        )  # fmt: skip
        recording = replace(one, detections=seen, frames=Frames(0.1 * frame))
        assert has_range_changed(recording, first, second).tolist() == [False, True]
