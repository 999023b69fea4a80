"""A camera of which only the range is stated misses nothing that it doesn't look at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import TrackConfig
from evermap.tracking.field_of_view import find_field_of_view, smallest_sector
from evermap.tracking.frame import DetectionTable
from evermap.tracking.run import TrackResult, run_track
from evermap.tracking.tracklets import EventKind
from evermap.types import FloatArray

RANGE_M = 15.0
TAKEN_S = 60.0


def table_of(
    objects_m: FloatArray, heading_rad: FloatArray, fov_rad: float, *, yaw: bool, seed: int = 0, taken: int = -1
) -> DetectionTable:
    """Ten frames a second by a sensor at the origin; object `taken` is carried away after a minute."""
    random = np.random.default_rng(seed)
    stamp_s = 0.1 * np.arange(len(heading_rad))
    frames = []
    for now, ahead in zip(stamp_s, heading_rad, strict=True):
        off = np.remainder(np.arctan2(objects_m[:, 1], objects_m[:, 0]) - ahead + np.pi, 2.0 * np.pi) - np.pi
        seen = (np.abs(off) < 0.5 * fov_rad) & (random.random(len(objects_m)) < 0.9)
        if taken >= 0 and now > TAKEN_S:
            seen[taken] = False
        frames.append(objects_m[seen] + 0.05 * random.standard_normal((seen.sum(), 3)))
    counts = [len(frame) for frame in frames]
    n = sum(counts)
    return DetectionTable(
        stamp_s=stamp_s,
        first=np.concatenate([[0], np.cumsum(counts)]),
        position_m=np.concatenate(frames),
        class_names=("",),
        class_id=np.zeros(n, dtype=np.int64),
        covariance_m2=None,
        appearance=None,
        sensor_m=np.zeros((len(frames), 3)),
        line=np.arange(n),
        source="",
        sensor_yaw_rad=heading_rad if yaw else None,
    )


RING = np.column_stack(
    [
        np.tile([6.0, 9.0, 12.0], 4) * np.cos(0.52 * np.arange(12)),
        np.tile([6.0, 9.0, 12.0], 4) * np.sin(0.52 * np.arange(12)),
        np.full(12, 0.5),
    ]
)
TURNING = 0.25 * 0.1 * np.arange(2400)
"""A turn in 25 s, for four minutes."""
CONFIG = TrackConfig(range_m=RANGE_M, sigma_position_m=0.05)


def died(result: TrackResult) -> int:
    return sum(event.kind == EventKind.DIED for event in result.events)


@pytest.mark.parametrize("yaw", [True, False])
@pytest.mark.parametrize("fov_deg", [60.0, 100.0])
def test_a_camera_that_turns_sees_twelve_objects_and_none_dies(yaw: bool, fov_deg: float) -> None:
    result = run_track(table_of(RING, TURNING, np.radians(fov_deg), yaw=yaw), CONFIG)
    assert len(result.first_rows()) == len(RING)
    assert died(result) == 0
    said = [remark for remark in result.warnings if "field of view" in remark or "turns" in remark]
    assert len(said) == 1
    told = float(said[0].split(" deg")[0].split()[-1])
    assert fov_deg - 31.0 < told < fov_deg + 3.0  # as far as objects 30 deg apart let it be known


@pytest.mark.parametrize("yaw", [True, False])
def test_what_is_taken_away_is_gone_once_it_is_looked_at(yaw: bool) -> None:
    """Also without a heading: sooner or later its place is between others that are seen."""
    result = run_track(table_of(RING, TURNING, np.radians(100.0), yaw=yaw, taken=4), CONFIG)
    assert len(result.first_rows()) == len(RING)
    gone = [event for event in result.events if event.kind == EventKind.DIED]
    assert len(gone) == 1
    assert TAKEN_S < gone[0].stamp_s < TAKEN_S + 60.0
    ended = result.spells[np.isfinite(result.spells.gone_s)]
    np.testing.assert_allclose(ended.position_m, RING[4:5], atol=0.05)


def test_a_camera_that_looks_aside_sees_what_is_there() -> None:
    """Its x axis is the robot's: it looks to the left of that."""
    table = replace(table_of(RING, TURNING, np.radians(80.0), yaw=True, taken=4), sensor_yaw_rad=TURNING - 0.5 * np.pi)
    result = run_track(table, CONFIG)
    assert len(result.first_rows()) == len(RING)
    assert died(result) == 1


@pytest.mark.parametrize(("fov_deg", "narrow"), [(200.0, True), (260.0, False)])
def test_a_view_of_more_than_half_a_turn_is_one_up_to_what_is_stated(fov_deg: float, narrow: bool) -> None:
    sees = find_field_of_view(table_of(RING, TURNING, np.radians(fov_deg), yaw=False), CONFIG)
    assert (sees is not None) == narrow


def test_a_sensor_that_sees_all_around_has_its_misses() -> None:
    """Nothing is taken for a view that is narrow; an object that goes is gone at once."""
    table = table_of(RING, np.zeros(900), 2.0 * np.pi, yaw=False, taken=4)
    assert find_field_of_view(table, CONFIG) is None
    (gone,) = [event for event in run_track(table, CONFIG).events if event.kind == EventKind.DIED]
    assert TAKEN_S < gone.stamp_s < TAKEN_S + 2.0


def test_a_sensor_that_stands_beside_a_yard_sees_what_goes_at_its_edge() -> None:
    side = RING + [20.0, 0.0, 0.0]
    config = CONFIG.model_copy(update={"range_m": 40.0})
    edge = int(np.argmax(np.arctan2(side[:, 1], side[:, 0])))
    result = run_track(table_of(side, np.zeros(1200), 2.0 * np.pi, yaw=False, taken=edge), config)
    (gone,) = [event for event in result.events if event.kind == EventKind.DIED]
    assert TAKEN_S < gone.stamp_s < TAKEN_S + 2.0


def test_few_detections_a_frame_say_nothing_of_the_view() -> None:
    """Two in a frame are always within half a turn."""
    pair = RING[[0, 5]]
    table = table_of(pair, np.zeros(400), 2.0 * np.pi, yaw=False)
    sees = find_field_of_view(table, CONFIG)
    assert sees is not None
    assert np.ptp(sees.yaw_rad) == 0.0  # the sector of both, which does not turn
    around = table_of(RING[::3], np.zeros(400), 2.0 * np.pi, yaw=False)
    random = np.random.default_rng(1)
    kept = [random.permutation(np.arange(a, b))[:2] for a, b in zip(around.first[:-1], around.first[1:], strict=True)]
    rows = np.sort(np.concatenate(kept))
    few = replace(
        around,
        first=np.concatenate([[0], np.cumsum([len(some) for some in kept])]),
        position_m=around.position_m[rows],
        class_id=around.class_id[rows],
        line=around.line[rows],
    )
    assert find_field_of_view(few, CONFIG) is None


def test_misses_that_come_together_are_told() -> None:
    """A camera said to see all around; one that misses one in ten, each by itself, is as it should be."""
    wrong = CONFIG.model_copy(update={"fov_deg": 360.0})
    turning = table_of(RING, TURNING, np.radians(100.0), yaw=True)
    assert any("misses come together" in remark for remark in run_track(turning, wrong).warnings)
    for right in (run_track(turning, CONFIG), run_track(table_of(RING, TURNING, 2.0 * np.pi, yaw=True), CONFIG)):
        assert not any("come together" in remark for remark in right.warnings)


@pytest.mark.parametrize("objects_m", [RING[::3], RING[:2]], ids=["four around", "two ahead"])
def test_misses_of_what_is_seen_too_briefly_to_rest_are_told(objects_m: FloatArray) -> None:
    """A camera that turns fast over few objects, of which nothing but the range is stated: each is seen for a second a
    turn, dies, and is another one. Who walks by leaves nothing in the place.
    """
    fast = table_of(objects_m, 0.6 * 0.1 * np.arange(1800), np.radians(40.0), yaw=False)
    result = run_track(fast, CONFIG)
    assert died(result) > 30
    assert len(result.spells) == 0
    (remark,) = [remark for remark in result.warnings if "misses come together" in remark]
    again, left = (int(word) for word in remark.split() if word.isdigit())
    assert 0.9 * died(result) < again <= left == died(result)
    passed = run_track(walk_by(), CONFIG)
    assert died(passed) > 15
    assert not any("come together" in remark for remark in passed.warnings)


def walk_by() -> DetectionTable:
    """Twenty people, one after the other, past a sensor that sees all around; each begins where the last one ended."""
    table = table_of(np.array([[3.0, 0.0, 0.0]]), np.zeros(1200), 2.0 * np.pi, yaw=False)
    frame = np.repeat(np.arange(table.n_frames), np.diff(table.first))
    away = frame % 60 > 35
    there = (0.15 * (frame % 60) - 2.6) * np.where(frame // 60 % 2, -1.0, 1.0)
    at = table.position_m + np.column_stack([np.zeros(len(frame)), there, np.zeros(len(frame))])
    counts = np.bincount(frame[~away], minlength=table.n_frames)
    return replace(
        table,
        first=np.concatenate([[0], np.cumsum(counts)]),
        position_m=at[~away],
        class_id=table.class_id[~away],
        line=table.line[~away],
    )


def test_the_smallest_sector_holds_all() -> None:
    random = np.random.default_rng(3)
    for n in (1, 2, 7):
        bearing = random.uniform(-np.pi, np.pi) + random.uniform(0.0, 2.0, n) + 2.0 * np.pi * random.integers(-2, 3, n)
        middle, width = smallest_sector(bearing)
        off = np.abs(np.remainder(bearing - middle + np.pi, 2.0 * np.pi) - np.pi)
        assert off.max() == pytest.approx(0.5 * width, abs=1e-9)
        assert width <= 2.0
    assert smallest_sector(np.zeros(0)) == (0.0, 0.0)
