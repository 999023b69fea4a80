"""What a faulty robot logged comes back valid; what was right comes back as it was."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.errors import DataError
from evermap.io import read_recording, write_template
from evermap.pipeline import run_slam
from evermap.slam.cleaning import clean
from evermap.types import Recording, rows_of
from evermap_studies.sim import BuildingConfig, SimulatedSensor, simulate_building
from evermap_studies.worlds.faults import FAULTLESS, NOTHING, FaultConfig, StreamFaults, with_faults
from evermap_studies.worlds.robots import draw_robot, simulate_robot

RATE_HZ = 5.0


@cache
def patrol(seconds: float = 60.0) -> Recording:
    config = BuildingConfig(days=1, patrol_s=seconds, sensor=SimulatedSensor(rate_hz=RATE_HZ))
    return simulate_building(config, seed=4).sessions[0]


def check_valid(recording: Recording) -> None:
    """The contract in `types`, spelled out row by row."""
    odometry, frames, detections = recording.odometry, recording.frames, recording.detections
    for table in (odometry, frames, detections):
        columns = [getattr(table, name) for name in table.__dataclass_fields__]
        assert len({len(column) for column in columns if isinstance(column, np.ndarray)}) == 1
    for stamp_s in (odometry.stamp_s, frames.stamp_s):
        assert all(np.isfinite(stamp) for stamp in stamp_s)
        assert all(later > earlier for earlier, later in pairwise(stamp_s))
    for velocity in (odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps):
        assert all(abs(value) <= 100.0 for value in velocity)
    before = 0
    for row in range(len(detections)):
        assert before <= detections.frame[row] < len(frames)
        before = detections.frame[row]
        assert 0.0 < detections.range_m[row] <= 2.0 * recording.sensor.range_max_m
        bearing_rad = detections.bearing_rad[row]  # nan, where so many have none that the sensor may measure none
        assert np.isnan(bearing_rad) or abs(bearing_rad) <= 2.0 * np.pi
        assert detections.landmark_id[row] >= -1
        assert -1 <= detections.class_id[row] < len(recording.class_names)
        for sigma in (detections.sigma_range_m[row], detections.sigma_bearing_rad[row]):
            assert np.isnan(sigma) or 0.0 < sigma < np.inf


def with_rows(recording: Recording, part: str, **columns: Any) -> Recording:
    return replace(recording, **{part: replace(getattr(recording, part), **columns)})


def reordered(recording: Recording, part: str, rows: np.ndarray) -> Recording:
    """Messages in another order, some twice; detections go with their frames."""
    table = getattr(recording, part)
    if part == "frames":
        stream = replace(recording, frames=replace(table, stamp_s=table.stamp_s[rows]))
        old = recording.detections
        pick = [np.flatnonzero(old.frame == row) for row in rows]
        take = np.concatenate(pick)
        frame = np.repeat(np.arange(len(rows)), [len(few) for few in pick])
        return replace(stream, detections=replace(rows_of(old, take), frame=frame))
    columns = {
        name: getattr(table, name)[rows]
        for name in table.__dataclass_fields__
        if isinstance(getattr(table, name), np.ndarray)
    }
    return with_rows(recording, part, **columns)


def same(one: Recording, other: Recording) -> None:
    for part in ("odometry", "frames", "detections"):
        mine, yours = getattr(one, part), getattr(other, part)
        for name in mine.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(mine, name), getattr(yours, name), err_msg=f"{part}.{name}")


def test_what_is_right_comes_back_as_it_is(tmp_path: Path) -> None:
    for seed in range(3):
        for recording in simulate_building(BuildingConfig(days=2, patrol_s=40.0), seed).sessions:
            assert clean(recording) is recording
    write_template(tmp_path / "template")
    recording = read_recording(tmp_path / "template")
    assert clean(recording) is recording


@pytest.mark.data
@pytest.mark.data
@pytest.mark.parametrize("robot", [1, 2, 3, 4, 5])
def test_recordings_of_real_robots_come_back_as_they_are(shared_data: Path, robot: int) -> None:
    """Cameras that count whole pixels, odometry of commands that jump, pauses of minutes: all of it is right."""
    path = shared_data / "mrclam" / "MRCLAM_Dataset6.zip"
    if not path.is_file():
        pytest.skip(f"no recording {path}")
    recording = read_recording(path, robot)
    assert clean(recording) is recording


rate = st.sampled_from([0.0, 0.01, 0.1, 0.5])
per_h = st.sampled_from([0.0, 60.0, 600.0])
stream_faults = st.builds(
    StreamFaults,
    p_dropped=rate, p_twice=rate, p_late=rate, p_misstamped=rate, late_s=st.sampled_from([0.1, 3.0, 30.0]),
    p_stamp_garbled=rate, outages_per_h=per_h, outage_s=st.sampled_from([1.0, 30.0]), jumps_per_h=per_h,
    jump_s=st.sampled_from([0.3, 5.0, 1e4]),
)  # fmt: skip
any_faults = st.builds(
    FaultConfig,
    frames=stream_faults, odometry=stream_faults, p_wrong_identity=rate, p_shuffled=rate,
    p_impossible=rate.map(lambda p: min(p, 0.3)),  # where half of the ranges are, they are in another unit
    freezes_per_h=per_h, p_spike=rate, p_odometry_impossible=rate, clock_jumps_per_h=per_h,
    clock_jump_s=st.sampled_from([5.0, 1e4]), p_empty=rate,
)  # fmt: skip


@given(faults=any_faults, seed=st.integers(0, 1000))
def test_whatever_goes_wrong_a_valid_recording_comes_back(faults: FaultConfig, seed: int) -> None:
    cleaned = clean(with_faults(patrol(20.0), faults, seed))
    check_valid(cleaned)
    assert all("\n" not in warning for warning in cleaned.warnings)
    again = clean(cleaned)
    check_valid(again)


def test_a_few_readings_without_a_bearing_are_damaged_and_many_are_ranges() -> None:
    whole = patrol(20.0)
    for share, left in ((10, 0), (4, len(whole.detections) // 4)):
        bearing = whole.detections.bearing_rad.copy()
        bearing[share - 1 :: share] = np.nan
        cleaned = clean(with_rows(whole, "detections", bearing_rad=bearing))
        assert np.isnan(cleaned.detections.bearing_rad).sum() == left
        broken = whole.detections.range_m.copy()
        broken[np.isnan(bearing)] = np.nan  # what has no range, either, says nothing of what the sensor measures
        cleaned = clean(with_rows(whole, "detections", bearing_rad=bearing, range_m=broken))
        assert not np.isnan(cleaned.detections.bearing_rad).any()


def test_half_of_a_handful_of_ranges_beyond_reach_is_no_mistake_in_the_unit() -> None:
    few = patrol(20.0)
    few = replace(few, detections=rows_of(few.detections, np.arange(9)))
    ranges = few.detections.range_m.copy()
    ranges[:5] = 1e5
    cleaned = clean(replace(few, detections=replace(few.detections, range_m=ranges)))
    assert len(cleaned.detections.range_m) == 4
    with pytest.raises(DataError, match="beyond"):
        clean(replace(few, detections=replace(few.detections, range_m=1e5 * np.ones(9))))


@pytest.mark.parametrize("part", ["odometry", "frames"])
def test_late_and_repeated_messages_are_put_back(part: str) -> None:
    rng = np.random.default_rng(0)
    count = len(getattr(patrol(), part))
    delay = np.where(rng.random(count) < 0.1, rng.uniform(0.0, 8.0, count), 0.0)
    rows = np.sort(np.append(np.arange(count), rng.integers(count, size=count // 10)))
    rows = rows[np.argsort(rows + delay[rows], kind="stable")]
    shuffled = reordered(patrol(), part, rows)
    cleaned = clean(shuffled)
    same(cleaned, patrol())
    assert len(cleaned.warnings) >= 2


@pytest.mark.parametrize("by_s", [-1e4, -40.0, -3.0])
@pytest.mark.parametrize("part", ["odometry", "frames"])
def test_a_clock_that_is_set_back_goes_on(part: str, by_s: float) -> None:
    stamp_s = getattr(patrol(), part).stamp_s
    half = len(stamp_s) // 2
    wrong = np.append(stamp_s[:half], stamp_s[half:] + by_s)
    cleaned = clean(with_rows(patrol(), part, stamp_s=wrong))
    assert any("set back" in warning for warning in cleaned.warnings)
    assert len(getattr(cleaned, part)) == len(stamp_s)
    np.testing.assert_allclose(getattr(cleaned, part).stamp_s, stamp_s, atol=1e-5)


@pytest.mark.parametrize("part", ["odometry", "frames"])
def test_a_clock_of_one_sensor_that_is_set_forward_goes_on(part: str) -> None:
    stamp_s = getattr(patrol(), part).stamp_s
    third = len(stamp_s) // 3
    wrong = np.append(stamp_s[:third], stamp_s[third:] + 20.0)
    cleaned = clean(with_rows(patrol(), part, stamp_s=wrong))
    assert any("set forward" in warning for warning in cleaned.warnings)
    np.testing.assert_allclose(getattr(cleaned, part).stamp_s, stamp_s, atol=1e-5)


def test_a_pause_is_no_step_of_a_clock() -> None:
    """The sensor says nothing for 20 s, or both do, or one stops early: the stamps are right."""
    frames, odometry = patrol().frames.stamp_s, patrol().odometry.stamp_s
    start = frames[0]
    for asleep in (
        reordered(patrol(), "frames", np.flatnonzero((frames < start + 20.0) | (frames > start + 40.0))),
        reordered(patrol(), "odometry", np.flatnonzero((odometry < start + 20.0) | (odometry > start + 40.0))),
        reordered(patrol(), "odometry", np.flatnonzero(odometry < start + 55.0)),
    ):
        assert clean(asleep) is asleep


def test_impossible_values_are_left_out_and_counted() -> None:
    detections = patrol().detections
    for name, wrong in (("range_m", np.nan), ("range_m", -1.0), ("range_m", 1e30), ("bearing_rad", np.inf)):
        values = getattr(detections, name).copy()
        values[[3, 17]] = wrong
        cleaned = clean(with_rows(patrol(), "detections", **{name: values}))
        kept = np.delete(np.arange(len(detections)), [3, 17])
        np.testing.assert_array_equal(cleaned.detections.range_m, detections.range_m[kept])
        assert cleaned.warnings == ("impossible readings dropped: 2",)
        check_valid(cleaned)


def test_a_sensor_without_limits_is_judged_by_its_other_readings() -> None:
    recording = replace(patrol(), sensor=replace(patrol().sensor, range_max_m=np.inf))
    assert clean(recording) is recording
    ranges = recording.detections.range_m.copy()
    ranges[5] = 1e6
    assert len(clean(with_rows(recording, "detections", range_m=ranges)).detections) == len(ranges) - 1


def test_spikes_go_and_hard_starts_stay() -> None:
    odometry = patrol().odometry
    forward = odometry.forward_mps.copy()
    forward[700:] += 8.0  # at once: more than any robot, but it stays
    assert clean(with_rows(patrol(), "odometry", forward_mps=forward)).warnings == ()
    forward[[100, 200, 201, 400]] += 25.0
    cleaned = clean(with_rows(patrol(), "odometry", forward_mps=forward))
    np.testing.assert_array_equal(cleaned.odometry.stamp_s, np.delete(odometry.stamp_s, [100, 200, 201, 400]))


def test_a_sensor_that_hangs_is_not_believed_but_a_robot_that_stands_is() -> None:
    hung = with_faults(patrol(), replace(FAULTLESS, freezes_per_h=300.0, freeze_s=2.0), seed=2)
    frozen = [k for k in range(len(hung.frames)) if _shown(hung, k) and _shown(hung, k) == _shown(hung, k - 1)]
    cleaned = clean(hung)
    assert len(frozen) > 10
    left_out = np.flatnonzero(~np.isin(hung.frames.stamp_s, cleaned.frames.stamp_s))
    assert set(left_out) <= set(frozen)
    truth = patrol().truth
    assert truth is not None
    speed = np.linalg.norm(np.diff(truth.pose_world_robot[:, :2], axis=0), axis=1)
    way = np.interp(hung.frames.stamp_s, truth.stamp_s, np.append(0.0, np.cumsum(speed)))
    for k in sorted(set(frozen) - set(left_out)):
        shown = next(row for row in range(k, -1, -1) if row not in frozen)
        assert len(_shown(hung, k)) == 1 or way[k] - way[shown] < 0.15
    still = with_rows(
        hung, "odometry", forward_mps=np.zeros(len(hung.odometry)), angular_radps=np.zeros(len(hung.odometry))
    )
    assert clean(still) is still


def _shown(recording: Recording, frame: int) -> list[tuple[float, float]]:
    rows = recording.detections.frame == frame
    return list(zip(recording.detections.range_m[rows], recording.detections.bearing_rad[rows], strict=True))


def test_names_and_deviations_that_are_none() -> None:
    detections = patrol().detections
    columns = {name: getattr(detections, name).copy() for name in ("landmark_id", "class_id", "sigma_range_m")}
    columns["landmark_id"][4], columns["class_id"][5], columns["sigma_range_m"][6] = -7, 99, -0.1
    cleaned = clean(with_rows(patrol(), "detections", **columns))
    assert (cleaned.detections.landmark_id[4], cleaned.detections.class_id[5]) == (-1, -1)
    assert np.isnan(cleaned.detections.sigma_range_m[6])
    assert len(cleaned.warnings) == 2


def test_detections_of_frames_that_do_not_exist_are_left_out() -> None:
    frame = patrol().detections.frame.copy()
    frame[-2:] = 10_000
    cleaned = clean(with_rows(patrol(), "detections", frame=frame))
    check_valid(cleaned)
    assert len(cleaned.detections) == len(frame) - 2


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))])
def test_of_nothing_nothing_is_made(seed: int) -> None:
    cleaned = clean(with_faults(patrol(), replace(FAULTLESS, p_empty=1.0), seed))
    check_valid(cleaned)
    with pytest.raises(DataError):
        run_slam(cleaned)


def test_garbled_stamps_lose_their_rows_only() -> None:
    faults = replace(NOTHING, p_stamp_garbled=0.05)
    cleaned = clean(with_faults(patrol(), replace(FAULTLESS, frames=faults, odometry=faults), seed=1))
    for part in ("frames", "odometry"):
        kept, all_s = getattr(cleaned, part).stamp_s, getattr(patrol(), part).stamp_s
        assert np.isin(kept, all_s).all()
        assert 0.9 * len(all_s) < len(kept) < len(all_s)


def test_frames_far_from_any_odometry_are_left_out() -> None:
    start, stamp_s = patrol().odometry.stamp_s[0], patrol().odometry.stamp_s
    late = reordered(patrol(), "odometry", np.flatnonzero(stamp_s > start + 25.0))
    cleaned = clean(late)
    check_valid(cleaned)
    kept = patrol().frames.stamp_s
    np.testing.assert_array_equal(cleaned.frames.stamp_s, kept[kept >= late.odometry.stamp_s[0] - 10.0])
    assert set(cleaned.detections.range_m) < set(patrol().detections.range_m)


@pytest.mark.parametrize(
    ("part", "at_s", "by_s"), [("odometry", 20.0, 7.3), ("odometry", 45.0, 1.5), ("frames", 30.0, 5.0)]
)
def test_a_clock_that_parts_is_told_by_what_was_seen(part: str, at_s: float, by_s: float) -> None:
    """One stream is stamped later from some instant on, and both end together: only readings tell."""
    recording = patrol(90.0)
    table = getattr(recording, part)
    start_s = float(recording.odometry.stamp_s[0])
    late = np.where(table.stamp_s - start_s > at_s, table.stamp_s + by_s, table.stamp_s)
    kept = late <= recording.odometry.stamp_s[-1]
    bad = with_rows(recording, part, stamp_s=np.where(kept, late, np.nan))
    mended = clean(bad)
    check_valid(mended)
    now, then = mended.odometry, recording.odometry  # rows are recognised by their values
    off = []
    for k in range(0, len(now), 7):
        same = np.flatnonzero((then.forward_mps == now.forward_mps[k]) & (then.angular_radps == now.angular_radps[k]))
        if len(same) == 1:
            seen_late = by_s if part == "frames" and then.stamp_s[same[0]] - start_s > at_s else 0.0
            off.append(abs(now.stamp_s[k] - then.stamp_s[same[0]] - seen_late))
    assert len(off) > 20
    assert np.quantile(off, 0.9) < 0.3


def test_clocks_of_many_makes_of_robots_are_left_alone() -> None:
    for seed in range(8):
        recording = simulate_robot(draw_robot(seed), seed)
        assert clean(recording).odometry is recording.odometry


def test_a_sensor_that_hangs_with_a_single_reading() -> None:
    recording = patrol(60.0)
    detections, frames = recording.detections, recording.frames
    first = int(np.flatnonzero(np.bincount(detections.frame, minlength=len(frames)) == 1)[3])
    hangs = (detections.frame < first + 1) | (detections.frame > first + 40)
    keep = np.flatnonzero(hangs)
    one = int(np.flatnonzero(detections.frame == first)[0])
    rows = np.concatenate([keep, np.full(40, one)])
    frame = np.concatenate([detections.frame[keep], np.arange(first + 1, first + 41)])
    order = np.argsort(frame, kind="stable")
    shown = replace(rows_of(detections, rows[order]), frame=frame[order])
    mended = clean(replace(recording, detections=shown))
    assert any("repeat the previous one" in warning for warning in mended.warnings)
    assert len(mended.frames) < len(frames) - 15
