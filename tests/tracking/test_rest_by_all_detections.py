"""Rest by all detections of a recording: what a robot that drives past says of parked boxes, and of who creeps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evermap.config import TrackConfig
from evermap.io import write_native
from evermap.pipeline import run_slam
from evermap.tracking.detections import read_input
from evermap.tracking.frame import DetectionTable
from evermap.tracking.record import Event, SpellLog, StaticSpells
from evermap.tracking.run import find_misses, make_tracker, run_track
from evermap.tracking.standing import Stood, join_stood
from evermap.tracking.tracker import Tracker
from evermap.tracking.tracklets import EventKind
from evermap.tracking.views import View
from evermap.types import UNKNOWN, FloatArray
from evermap_studies.worlds.parking import StreetConfig, StreetRun, simulate_street

COLUMNS = ("track_id", "class_id", "position_m", "elsewhere_s", "first_s", "last_s", "gone_s")
SEEN = TrackConfig(range_m=30.0, fov_deg=110.0)
PARKED_M = 3.0
"""Farthest that a spell is from its slot, at the odometry's drift."""


@pytest.fixture(scope="module")
def days() -> StreetRun:
    """Two days on a street on which cars and vans park and leave."""
    return simulate_street(StreetConfig(days=2), 5)


@pytest.fixture(scope="module")
def tables(days: StreetRun, tmp_path_factory: pytest.TempPathFactory) -> list[DetectionTable]:
    """Each day as `evermap track` reads it."""
    root = tmp_path_factory.mktemp("street")
    found = []
    for k, drive in enumerate(days.drives):
        write_native(drive, root / str(k))
        found.append(read_input(root / str(k)))
    return found


def join_tables(tables: list[DetectionTable]) -> DetectionTable:
    """Return one table of successive ones."""
    first = [np.zeros(1, dtype=np.int64)]
    for table in tables:
        first.append(first[-1][-1] + table.first[1:])
    names = ("stamp_s", "position_m", "class_id", "box", "score", "sensor_m", "sensor_yaw_rad", "line")
    columns: dict[str, Any] = {name: np.concatenate([getattr(table, name) for table in tables]) for name in names}
    return replace(tables[0], first=np.concatenate(first), **columns)


def test_track_finds_what_slam_finds(days: StreetRun, tables: list[DetectionTable]) -> None:
    """A car is in view for two to five seconds: the same objects, the same spells, and all that stand on the street."""
    for drive, table in zip(days.drives, tables, strict=True):
        ours, theirs = run_track(table, TrackConfig()), run_slam(drive)
        assert theirs.followed is not None
        other = theirs.followed.spells
        assert len(ours.spells) == len(other) == len(theirs.landmarks) > 20
        np.testing.assert_array_equal(np.sort(ours.spells.track_id), np.sort(theirs.landmarks.landmark_id.astype(int)))
        np.testing.assert_allclose(ours.spells.first_s, other.first_s, atol=0.31)
        np.testing.assert_allclose(ours.spells.last_s, other.last_s, atol=0.31)
        at_s = float(table.stamp_s[0]) + 20.0
        assert abs(len(days.street.standing(at_s) & days.street.find_passed()) - len(ours.spells)) <= 2


def test_two_days_by_a_saved_state_are_two_days_in_one_table(tables: list[DetectionTable], tmp_path: Path) -> None:
    """Also of those that were seen for too short to enter the tracker's own spells, and had left the next day."""
    whole = run_track(join_tables(tables), SEEN).spells
    for k, table in enumerate(tables):
        tracker = make_tracker(table, SEEN, state=tmp_path / "state" if k else None)
        spells = run_track(table, SEEN, tracker=tracker).spells
        tracker.save(tmp_path / "state")
    assert np.isfinite(whole.gone_s).sum() >= 5
    for name in ("track_id", "class_id", "elsewhere_s", "first_s", "last_s", "gone_s"):
        np.testing.assert_array_equal(getattr(spells, name), getattr(whole, name), err_msg=name)
    np.testing.assert_allclose(spells.position_m, whole.position_m, atol=1e-6)  # the working set is of float32


def box_track(speed_mps: float, frames: int, *, then: int = 0) -> StaticSpells:
    """A box at ten frames a second from 5 s on, where nothing was for 5 s, and nothing for some frames thereafter."""
    here = View.ball(np.zeros(3), 20.0, 0.9)
    stamps: FloatArray = np.arange(50 + frames + then) / 10.0
    seen = (np.arange(len(stamps)) >= 50) & (np.arange(len(stamps)) < 50 + frames)
    rng = np.random.default_rng(0)
    n = int(seen.sum())
    position = np.column_stack([5.0 + speed_mps * 0.1 * np.arange(n), np.zeros(n), np.full(n, 0.75)])
    position += rng.normal(0.0, 0.05, position.shape)
    table = DetectionTable(
        source="made", class_names=("",), stamp_s=stamps, first=np.append(0, np.cumsum(seen)),
        position_m=position, class_id=np.zeros(n, dtype=np.int64), covariance_m2=None, appearance=None,
        sensor_m=np.tile(here.centre_m, (len(stamps), 1)), line=np.arange(n) + 2,
        box=np.tile([4.2, 1.7, 1.5, 0.0], (n, 1)),
    )  # fmt: skip
    return run_track(table, TrackConfig(range_m=20.0)).spells


def test_a_parked_box_needs_no_four_seconds() -> None:
    spells = box_track(0.0, 15)
    assert len(spells) == 1
    assert (spells.first_s[0], spells.last_s[0]) == (pytest.approx(5.0), pytest.approx(6.4))
    assert 4.0 < spells.elsewhere_s[0] < 5.0
    assert spells.gone_s[0] == np.inf


def test_one_that_leaves_its_place_while_it_is_watched_is_missed_there() -> None:
    spells = box_track(0.0, 60, then=40)
    assert len(spells) == 1
    assert 10.8 < spells.last_s[0] < spells.gone_s[0] < 12.5


def test_who_creeps_does_not_rest() -> None:
    """Its speed is above that of its class, though the first seconds do not show it."""
    assert len(box_track(1.5, 60)) == 0


def stood_of(*ways: FloatArray, seed: int = 0) -> Stood:
    """Which stood of boxes of a class each, along ways (F, 2) ten frames a second, nan where they are hidden."""
    at, noise = np.array(ways), np.random.default_rng(seed)
    seen = np.isfinite(at[..., 0])
    frame, of = np.nonzero(seen.T)
    count = len(frame)
    position = np.column_stack([at[of, frame], np.full(count, 1.0)]) + noise.normal(0.0, 0.05, (count, 3))
    table = DetectionTable(
        source="made", class_names=("van", "car")[: len(at)], stamp_s=np.arange(at.shape[1]) / 10.0,
        first=np.append(0, np.cumsum(seen.sum(axis=0))), position_m=position, class_id=of,
        covariance_m2=None, appearance=None, sensor_m=np.tile([0.0, -8.0, 1.0], (at.shape[1], 1)),
        line=np.arange(count) + 2, box=np.tile([5.4, 2.0, 2.3, 0.0], (count, 1)),
    )  # fmt: skip
    stood = run_track(table, TrackConfig()).stood
    assert stood is not None
    return stood


def way_of(frames: int, *, leaves_s: float = np.inf, hidden_s: tuple[float, float] = (9.0, 9.0)) -> FloatArray:
    """A van that stands in one place, accelerates along x from some instant on, and is hidden for some time."""
    stamp_s = np.arange(frames) / 10.0
    way = np.column_stack([0.75 * np.maximum(stamp_s - leaves_s, 0.0) ** 2, np.zeros(frames)])
    way[(stamp_s > hidden_s[0]) & (stamp_s < hidden_s[1])] = np.nan
    return way


def test_a_van_that_something_hides_as_it_leaves_has_left() -> None:
    """It gets another track 2.5 m ahead of its place, where its own body would still be if it stood there."""
    stood = stood_of(way_of(60, leaves_s=3.0, hidden_s=(3.5, 4.8)))
    assert stood.until_s.tolist() == [pytest.approx(4.15, abs=0.06)]  # half way between 3.5 and 4.8 s
    assert np.isnan(stood.since_s).all()
    back = stood_of(way_of(60, leaves_s=3.0, hidden_s=(3.5, 4.8))[::-1])
    assert back.since_s.tolist() == [pytest.approx(1.75, abs=0.06)]
    assert np.isnan(back.until_s).all()


def test_a_van_that_is_hidden_soon_after_it_left_has_left() -> None:
    """It is seen 1.8 m off its place, in the median of its last ones: more than errors explain, since it moves."""
    stood = stood_of(way_of(60, leaves_s=2.6, hidden_s=(4.3, 9.0)))
    assert stood.until_s.tolist() == [pytest.approx(3.0, abs=0.4)]


def test_what_drives_past_ends_no_stay() -> None:
    """Half a metre beside it, or so near that errors explain it, nor through its place, where the two are boxes that
    were seen together, or much later.
    """
    stands, passes = way_of(60, hidden_s=(2.0, 9.0)), np.column_stack([3.0 * np.arange(-30, 30) / 10.0, np.zeros(60)])
    for off_m in (2.5, -2.5, 1.85):
        stood = stood_of(stands, passes + np.array([0.0, off_m]))
        assert np.isnan(stood.until_s).tolist() == [True]
    assert np.isnan(stood_of(stands, passes).until_s).tolist() == [True]  # it was elsewhere while the van stood
    behind = way_of(60, leaves_s=2.5) - np.array([6.0, 0.0])  # it stood when the van was seen last
    until_s = stood_of(stands, behind).until_s
    assert np.sort(until_s).tolist() == [pytest.approx(2.85, abs=0.4), pytest.approx(np.nan, nan_ok=True)]
    late = np.full((120, 2), np.nan)
    late[60:] = passes
    assert np.isnan(stood_of(way_of(120, hidden_s=(2.0, 20.0)), late).until_s).tolist() == [True]


def test_a_box_that_wanders_about_its_place_has_not_left() -> None:
    """It has a second track that seems to move, but where errors may put what stands there."""
    wanders = np.full((60, 2), np.nan)
    wanders[17:27] = np.column_stack([np.linspace(-0.7, 0.7, 10), np.zeros(10)])
    stood = stood_of(way_of(60, hidden_s=(2.0, 9.0)), wanders)
    assert (stood.p_static[-6:] < 0.5).all()  # these are later than its last one
    assert np.isnan(stood.until_s).tolist() == [True]


def test_what_the_tracker_took_for_rest_is_forgotten_unless_it_was_long() -> None:
    """Of this recording; what earlier ones say stays."""
    tracker = Tracker(boxes=True)
    for k in range(45):
        tracker.step(0.1 * k, np.zeros((1, 3)), box=np.ones((1, 4)))
    assert len(tracker.static_spells()) == 1  # from 2 s on
    nothing = tracker.static_spells()[np.zeros(0, dtype=np.int64)]
    tracker.confirm_rest(nothing, 10.0)
    assert len(tracker.static_spells()) == 1
    short = Tracker(boxes=True)
    for k in range(35):
        short.step(0.1 * k, np.zeros((1, 3)), box=np.ones((1, 4)))
    assert len(short.static_spells()) == 1
    short.confirm_rest(nothing, 0.0)
    assert len(short.static_spells()) == 0
    tracker.confirm_rest(nothing, 0.0)
    assert len(tracker.static_spells()) == 1  # 2.4 s


def spells_of(*rows: tuple[int, float, float, float, float]) -> StaticSpells:
    """Spells by track, elsewhere, first, last, gone."""
    columns = np.array(rows, dtype=np.float64).reshape(-1, 5).T
    whole = columns[0].astype(np.int64)
    return StaticSpells(whole, np.zeros_like(whole), np.zeros((len(whole), 3)), *columns[1:])


def test_ended_spells_begin_with_the_stay_and_short_ones_need_one() -> None:
    log = SpellLog()
    earlier = (0, -np.inf, 1.0, 1.5, 3.0)
    crept, confirmed = (1, -np.inf, 11.0, 12.0, 15.0), (2, 9.0, 12.0, 13.0, 15.0)
    long, arrived = (3, -np.inf, 11.0, 14.0, 15.0), (4, 11.5, 12.0, 13.0, 15.0)
    log.restore({name: getattr(spells_of(earlier, crept, confirmed, long, arrived), name) for name in COLUMNS})
    stays = spells_of(
        (2, -np.inf, 10.0, 13.0, np.inf), (4, -np.inf, 11.0, 13.0, np.inf), (5, -np.inf, 11.0, 13.0, np.inf)
    )
    assert log.confirm(stays, 10.0, 2.0).tolist() == [True, True, False]
    kept = log.columns()
    assert kept["track_id"].tolist() == [0, 2, 3, 4]
    assert kept["first_s"].tolist() == [1.0, 10.0, 11.0, 12.0]  # 4 was elsewhere later than the stay begins


def test_stays_of_who_is_neither_followed_nor_stored_have_ended() -> None:
    tracker = Tracker(boxes=True)
    tracker.step(0.0, np.zeros((1, 3)), box=np.ones((1, 4)))
    stay = spells_of((77, -np.inf, 3.0, 4.0, 9.0))
    tracker.confirm_rest(stay, 0.0)
    found = tracker.static_spells()
    assert (found.track_id.tolist(), found.first_s.tolist(), found.gone_s.tolist()) == ([77], [3.0], [9.0])


def test_rest_that_is_confirmed_begins_with_the_stay_and_earlier_days_are_not_asked() -> None:
    tracker = Tracker(boxes=True)
    for k in range(35):
        tracker.step(100.0 + 0.1 * k, np.zeros((1, 3)), box=np.ones((1, 4)))
    nothing = spells_of()
    tracker.confirm_rest(nothing, 200.0)
    before = tracker.static_spells()
    assert before.first_s.tolist() == [pytest.approx(102.0)]
    name = int(before.track_id[0])
    tracker.confirm_rest(spells_of((name, 99.7, 100.1, 103.4, np.inf)), 100.0)
    after = tracker.static_spells()
    assert (after.elsewhere_s.tolist(), after.first_s.tolist()) == ([99.7], [100.1])
    assert (after.last_s[0], after.gone_s[0]) == (before.last_s[0], np.inf)


def test_misses_are_of_those_that_were_stored_last() -> None:
    told = [
        (1, EventKind.STORED, 5.0), (1, EventKind.DIED, 9.0), (2, EventKind.DIED, 9.0), (3, EventKind.STORED, 5.0),
        (3, EventKind.REIDENTIFIED, 6.0), (3, EventKind.DIED, 9.0), (4, EventKind.STORED, 5.0),
    ]  # fmt: skip
    events = [Event(stamp_s, kind, name) for name, kind, stamp_s in told]
    np.testing.assert_array_equal(find_misses(events, np.arange(1, 5)), [9.0, np.inf, np.inf, np.inf])


@pytest.mark.parametrize(("off_m", "left_s", "stays"), [(0.2, np.nan, 1), (0.8, np.nan, 2), (0.2, 3.0, 2)])
def test_a_track_that_stands_where_it_stood_goes_on_after_a_gap(off_m: float, left_s: float, stays: int) -> None:
    """Unless it was seen to leave; one that moves in a part is as little still as it is there."""

    def part(track: int, until_s: float, p: float) -> Stood:
        stay, unseen = np.array([UNKNOWN, 0, 0]), np.array([np.nan])
        return Stood(stay, np.full(3, p), {track: p}, np.array([track]), np.array([p]), unseen, np.array([until_s]))

    parts = [part(7, left_s, 0.95), part(7, np.nan, 0.99)]
    position_m = np.zeros((6, 3))
    position_m[3:, 0] = off_m
    joined = join_stood(parts, position_m, TrackConfig().still)
    assert joined.stay.tolist() == [UNKNOWN, 0, 0, UNKNOWN, *[stays - 1] * 2]
    assert joined.track.tolist() == [7] * stays
    assert joined.p_still == {7: 0.95}
    assert joined.p_stay.tolist() == ([0.99] if stays == 1 else [0.95, 0.99])
    np.testing.assert_array_equal(joined.until_s, [np.nan] if stays == 1 else [left_s, np.nan])
