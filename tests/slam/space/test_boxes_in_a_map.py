"""Boxes without identity over the days of a living map: a made street on which cars park and leave."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from typer.testing import CliRunner

from evermap.cli.main import app
from evermap.config import Config, LivingConfig
from evermap.errors import InputError
from evermap.geometry import se3
from evermap.maps.living import LivingMap
from evermap.maps.sessions.session import Session
from evermap.maps.store import open_store
from evermap.pipeline import run_session
from evermap.runs.sessions import enter_session
from evermap.sensing.sightlines import Glimpses
from evermap.types import ChangeKind, IntArray, MapChange, SpatialRecording, landmark_code, rows_of
from evermap_studies.worlds.parking import CAR, DAY_S, SPEED_MPS, STEP_S, VAN, Faults, Parking, Spell

COMES = (ChangeKind.APPEARED, ChangeKind.RETURNED)
PARTS = ((0.0, 1.0), (0.2, 1.0), (0.0, 0.85))
"""What of the street is driven each day."""


class Week(NamedTuple):
    """A street, and what happened in view: day, seconds from its start, slot, and whether a car came."""

    street: Parking
    in_view: list[tuple[int, float, int, bool]]


def week(seed: int) -> Week:
    """Cars that stay, came before the second day, left before the second or third, or were away on the second; and one
    that leaves in view each day, one that parks.
    """
    rng, street = np.random.default_rng(seed), Parking.of(seed)
    n = len(street.path)
    events: list[tuple[int, float, int, bool]] = []
    for day, at_s, comes in ((0, 12.0, False), (1, 20.0, True), (1, 9.0, False), (2, 26.0, False)):
        ahead = min(int((PARTS[day][0] * n) + (at_s + 24.0 / SPEED_MPS) / STEP_S), n - 1)
        away = np.linalg.norm(street.slot[:, :2] - street.path[ahead, :2], axis=1)
        away[[event[2] for event in events]] = np.inf
        events.append((day, at_s, int(np.argmin(away)), comes))
    for slot in range(len(street.slot)):
        event = next((event for event in events if event[2] == slot), None)
        if event is not None:
            when = event[0] * DAY_S + event[1]
            street.park(rng, slot, *((when, 1e6) if event[3] else (-1e6, when)))
            continue
        kind = rng.choice(["stays", "stays", "until 1", "from 1", "until 2", "away on 1", "empty"])
        spans = {
            "stays": [(-1e6, 1e6)],
            "until 1": [(-1e6, 0.5 * DAY_S)],
            "from 1": [(0.5 * DAY_S, 1e6)],
            "until 2": [(-1e6, 1.5 * DAY_S)],
            "away on 1": [(-1e6, 0.5 * DAY_S), (1.2 * DAY_S, 1e6)],
            "empty": [],
        }[str(kind)]
        for span in spans:
            street.park(rng, slot, *span)
    return Week(street, events)


def recordings(made: Week, seed: int, *, back: bool = False) -> list[SpatialRecording]:
    """The drives of three days; on the last one back, if so."""
    return [
        made.street.drive(100 * seed + day, day * DAY_S, part, back=back and day == 2) for day, part in enumerate(PARTS)
    ]


def in_street(living: LivingMap, street: Parking) -> tuple[IntArray, IntArray]:
    """Ids of landmarks and the slots that they are at, -1 for none; the first drive begins where the street does, and
    its odometry has drifted: aligned as a whole.
    """
    known = living.landmarks()
    return known.landmark_id, street.find_slots(known.position_m[:, :2])


def hidden(street: Parking, part: tuple[float, float]) -> set[int]:
    """Slots of which a drive saw a little, or nothing: nothing is asked of them."""
    n = len(street.path)
    beside = street.beside
    return set(np.flatnonzero((beside > part[1] * n - 3) & (beside < part[1] * n + 60)).tolist()) | set(
        np.flatnonzero((beside < part[0] * n + 12) & (beside > part[0] * n - 3)).tolist()
    )


class Count(NamedTuple):
    """Changes that were told rightly, that were told, and that happened."""

    right: int
    told: int
    true: int


def spell_at(street: Parking, slot: int, stamp_s: float) -> Spell | None:
    return next((one for one in street.spells if one.slot == slot and one.from_s <= stamp_s < one.until_s), None)


def counted(made: Week, told: list[tuple[MapChange, ...]], slots: dict[int, int]) -> Count:
    """Changes beside what happened between the times at which a slot was passed."""
    right = total = true = 0
    last: dict[int, Spell | None] = {}
    for day, (changes, part) in enumerate(zip(told, PARTS, strict=True)):
        end_s = day * DAY_S + 40.0
        comes = {slots[name] for one in changes if one.kind in COMES for name in one.landmark_ids}
        goes = {slots[name] for one in changes if one.kind is ChangeKind.VANISHED for name in one.landmark_ids}
        doubtful = hidden(made.street, part) if day else set()
        for slot in made.street.find_passed(part) - doubtful:
            now, before = spell_at(made.street, slot, end_s), last.get(slot)
            known = slot in last or any(event[:1] == (day,) and event[2] == slot for event in made.in_view)
            if slot not in last:
                before = spell_at(made.street, slot, day * DAY_S)
            last[slot] = now
            if not known or (now and before and now != before):
                continue  # one left and another came, unseen
            for happened, said in (
                (now is not None and now != before, comes),
                (before is not None and now != before, goes),
            ):
                right, true = right + (happened and slot in said), true + happened
                total += slot in said
    return Count(right, total, true)


Days = tuple[Week, list[Session]]


@functools.cache
def drive_days(seed: int, back: bool) -> Days:
    """Three days of a street."""
    made, living, sessions = week(seed), None, list[Session]()
    for recording in recordings(made, seed, back=back):
        sessions.append(run_session(recording, living))
        living = sessions[-1].living
    return made, sessions


@pytest.fixture
def days() -> Days:
    return drive_days(1, False)


STREETS = [(1, False), *(pytest.param(*one, marks=pytest.mark.slow) for one in ((2, False), (3, True)))]


@pytest.mark.parametrize(("seed", "back"), STREETS)
def test_what_stands_is_known_once_and_what_changed_is_told(seed: int, back: bool) -> None:
    made, sessions = drive_days(seed, back)
    street = made.street
    assert all(session.found for session in sessions)
    slots = dict(zip(*(column.tolist() for column in in_street(sessions[-1].living, street)), strict=True))
    for day, session in enumerate(sessions):
        names, at = in_street(session.living, street)
        exists = session.living.landmarks().p_exists >= 0.5
        here, sure = at[exists], street.find_passed(PARTS[day]) - hidden(street, PARTS[day])
        assert len(np.unique(here)) == len(here), day  # no duplicates
        standing = street.standing(day * DAY_S + 40.0)
        stands = {slot for slot in here.tolist() if slot in sure}
        if back and day == 2:  # nobody knew that these places can be seen from there
            assert stands >= standing & sure
        else:
            assert stands == standing & sure
        slots |= dict(zip(names.tolist(), at.tolist(), strict=True))
    assert -1 not in slots.values()  # wrong boxes are no landmarks
    if not back:
        right, told, true = counted(made, [session.changes for session in sessions], slots)
        assert true >= 15, (right, told, true)
        assert right >= 0.9 * true
        assert right >= 0.9 * told


@pytest.mark.parametrize("given", [True, pytest.param("empty", marks=pytest.mark.slow)])
def test_boxes_are_as_they_are_where_ids_are_ignored(days: Days, given: bool | str) -> None:
    """They have none anyway; nothing else is there to be associated."""
    made, sessions = days
    session = run_session(recordings(made, 1)[0], None, Config(slam={"unknown_ids": given}))
    np.testing.assert_array_equal(session.living.places.position_m, sessions[0].living.places.position_m)
    assert session.living.landmark_texts == sessions[0].living.landmark_texts


@pytest.mark.parametrize(("seed", "back"), STREETS[:2])
def test_what_comes_and_leaves_in_view_is_told_with_its_instant(seed: int, back: bool) -> None:
    made, sessions = drive_days(seed, back)
    slots = dict(zip(*(column.tolist() for column in in_street(sessions[-1].living, made.street)), strict=True))
    seen = 0
    for day, at_s, slot, comes in made.in_view:
        kinds = COMES if comes else (ChangeKind.VANISHED,)
        mine = [one for one in sessions[day].changes if slots.get(one.landmark_ids[0]) == slot and one.kind in kinds]
        when = day * DAY_S + at_s
        seen += len(mine) == 1 and when - 2.0 < mine[0].stamp_from_s <= mine[0].stamp_to_s < when + 2.5
    assert seen >= 3  # of four; one may be behind another car then


def test_a_van_where_a_car_had_stood_came_after_it() -> None:
    """It was not seen to come, and lifetimes alone do not tell: but two bodies are never in one spot."""
    rng, street, slot = np.random.default_rng(1), Parking.of(1, class_names=(CAR, VAN)), 27
    for one in range(len(street.slot)):
        street.park(rng, one, -1e6, 0.5 * DAY_S if one == slot else 1e6, 0)
    street.park(rng, slot, 1.5 * DAY_S, 1e6, 1)
    living, slots = None, dict[int, int]()
    for day in range(3):
        session = run_session(street.drive(100 + day, day * DAY_S), living)
        living = session.living
        slots |= dict(zip(*(column.tolist() for column in in_street(living, street)), strict=True))
    (told,) = session.changes
    assert told.kind is ChangeKind.REPLACED
    assert [slots[one] for one in told.landmark_ids] == [slot, slot]
    assert told.probability > 0.9
    assert 0.0 < told.stamp_from_s < 40.0  # when the car was seen last


@pytest.mark.parametrize(("seed", "back"), STREETS)
def test_stays_are_the_spells_and_what_lifetimes_are_learned_from(seed: int, back: bool) -> None:
    made, sessions = drive_days(seed, back)
    living = sessions[-1].living
    street, stays = made.street, living.stays
    clique = dict(zip(living.members.landmark_id.tolist(), living.members.clique_id.tolist(), strict=True))
    slots = {clique[name]: at for name, at in zip(*(c.tolist() for c in in_street(living, street)), strict=True)}
    found: dict[Spell, int] = {}
    for row in range(len(stays)):
        slot = slots[int(stays.clique_id[row])]
        if slot not in street.find_passed(PARTS[1]) - hidden(street, PARTS[1]):
            continue  # one may have left and another come, unseen
        inside = [
            one
            for one in street.spells
            if one.slot == slot and one.from_s < stays.first_s[row] + 1.0 and one.until_s > stays.last_s[row] - 1.0
        ]
        assert len(inside) == 1, (slot, stays.first_s[row], stays.last_s[row])
        spell = inside[0]
        assert stays.elsewhere_s[row] - 1.0 < spell.from_s
        if np.isfinite(stays.gone_s[row]):
            assert stays.gone_s[row] + 1.0 > spell.until_s
        found[spell] = found.get(spell, 0) + 1
    assert set(found.values()) == {1}  # each counts once
    kind = living.class_names.index("Car")
    life = living.lives.of(kind)
    assert life.n_stays == len(stays)
    assert life.n_ended == np.isfinite(stays.gone_s).sum()


def test_sizes_and_names_are_kept(days: Days, tmp_path: Path) -> None:
    made, sessions = days
    first, third = sessions[0].living, sessions[2].living
    kept = np.isin(first.members.landmark_id, third.members.landmark_id)
    assert kept.mean() > 0.9  # the same ids
    known = third.landmarks()
    assert known.size_m is not None
    names, at = in_street(third, made.street)
    size = {one.slot: one.size_m for one in made.street.spells if one.from_s <= 2 * DAY_S + 40.0 < one.until_s}
    for row in np.flatnonzero(known.p_exists >= 0.5).tolist():
        np.testing.assert_allclose(known.size_m[row], size[int(at[row])], atol=0.7)
    heading = 2.0 * np.arctan2(known.rotation[:, 2], known.rotation[:, 3])  # type: ignore[index]
    off = np.remainder(heading - made.street.slot[at, 2] + 0.5 * np.pi, np.pi) - 0.5 * np.pi
    assert np.median(np.abs(off)) < 0.15
    assert all(known.names[name] == f"Car {landmark_code(name)}" for name in names.tolist())
    assert all(text.startswith("Car-") for text in third.landmark_texts)


@pytest.mark.parametrize("seed", [21, pytest.param(22, marks=pytest.mark.slow)])
def test_a_drive_elsewhere_is_not_placed(days: Days, seed: int) -> None:
    _, sessions = days
    before = sessions[0].living
    session = run_session(week(seed).street.drive(5, DAY_S, (0.1, 0.9)), before)
    assert not session.found
    assert session.living is not before or session.living == before
    assert len(session.living.members) == len(before.members)
    assert any("set aside" in warning for warning in session.slam.warnings)


@pytest.mark.slow
def test_rows_that_look_alike_are_not_taken_for_each_other() -> None:
    """All slots of a car park are 6 m apart, and all cars of a size: from elsewhere in it, nothing tells where."""
    street = Parking.of(7, n_slots=40, metres=140.0)
    straight = np.zeros_like(street.path)
    straight[:, 0] = np.arange(len(straight)) * SPEED_MPS * STEP_S
    slot = np.array([[20.0 + 6.0 * k, side, 0.0] for k in range(16) for side in (-5.0, 5.0)])
    street = Parking(straight, slot, [])
    for k in range(len(slot)):
        street.spells.append(Spell(k, -1e6, 1e6, (4.2, 1.7, 1.5)))
    faults = Faults(bend=0.0, scale=1.0)
    first = run_session(street.drive(1, 0.0, (0.0, 0.9), faults))
    session = run_session(street.drive(2, DAY_S, (0.35, 0.7), faults), first.living)
    assert not session.found


def test_the_frame_of_an_odometry_may_be_that_of_the_map() -> None:
    """A few cars are enough then, and positions are those of the odometry."""
    rng = np.random.default_rng(5)
    street = Parking.of(5)
    for slot in (2, 9, 20, 26):
        street.park(rng, slot, -1e6, 1e6)
    half = 0.5 * np.radians(100.0)
    origin = np.array([500.0, -200.0, 3.0, 0.0, 0.0, np.sin(half), np.cos(half)])
    first = run_session(street.drive(1, 0.0, (0.0, 0.6), Faults(bend=0.0, scale=1.0), origin))
    second = run_session(street.drive(2, DAY_S, (0.1, 1.0), Faults(bend=0.0, scale=1.0), origin), first.living)
    assert second.found
    assert second.changes == ()
    known = second.living.landmarks(p_least=0.5)
    true = se3.transform(origin, np.column_stack([street.slot[[2, 9, 20, 26], :2], np.zeros(4)]))
    away = np.linalg.norm(known.position_m[:, None] - true, axis=2)
    assert len(known) == 4
    assert away.min(axis=0).max() < 1.0


@pytest.mark.slow
def test_deleted_boxes_stay_away_and_large_maps_are_the_same(days: Days) -> None:
    made, sessions = days
    first = sessions[0].living
    name = int(first.members.landmark_id[3])
    at = first.landmarks().position_m[first.landmarks().landmark_id == name][0]
    recording = recordings(made, 1)[1]
    edited = run_session(recording, first.edited(name, deleted=True))
    away = np.linalg.norm(edited.living.landmarks().position_m[:, :2] - at[:2], axis=1)
    assert away.min() > 1.5
    parts = run_session(recording, first, Config(living=LivingConfig(whole_places=10)))
    told = [[(one.kind, one.landmark_ids) for one in session.changes] for session in (sessions[1], parts)]
    assert sorted(told[0]) == sorted(told[1])
    np.testing.assert_array_equal(parts.living.members.landmark_id, sessions[1].living.members.landmark_id)
    np.testing.assert_allclose(parts.living.p_exists(), sessions[1].living.p_exists(), atol=0.05)
    np.testing.assert_allclose(parts.living.landmarks().size_m, sessions[1].living.landmarks().size_m, atol=1e-6)


@pytest.mark.slow
def test_a_store_takes_each_session_once_and_late_ones_in_order(days: Days, tmp_path: Path) -> None:
    made, sessions = days
    drives = recordings(made, 1)
    path = tmp_path / "street.evermap"
    with open_store(path, create=True) as store:
        for day in (0, 2):
            enter_session(store, drives[day]).commit(store)
        with pytest.raises(InputError, match="is in the map already"):
            enter_session(store, drives[2])
        late = enter_session(store, drives[1])
        late.commit(store)
        assert late.replayed == (drives[2].name,)
        living, ordered = store.load(), sessions[-1].living
    known, right = living.landmarks(), ordered.landmarks()
    np.testing.assert_allclose(np.sort(known.p_exists), np.sort(right.p_exists), atol=1e-6)
    np.testing.assert_array_equal(np.sort(known.landmark_id), np.sort(right.landmark_id))
    assert known.size_m is not None
    np.testing.assert_allclose(known.size_m, right.size_m, atol=1e-9)
    assert len(living.stays) == len(ordered.stays)
    run = CliRunner()
    label = known.names[int(known.landmark_id[0])]
    for words in (
        ["show"],
        ["log"],
        ["why", label],
        ["diff", "1", "2"],
        ["export", "--out", str(tmp_path / "out.csv")],
    ):
        verb, *rest = words
        found = run.invoke(app, ["map", verb, str(path), *rest])
        assert found.exit_code == 0, (words, found.output)


def test_a_map_may_have_named_landmarks_beside_boxes() -> None:
    """Two cars that are known by name place a drive on which all others have changed."""
    rng, street = np.random.default_rng(3), Parking.of(11)
    for slot in (1, 5, 11, 24, 30):
        street.park(rng, slot, -1e6, 1e6)
    street.park(rng, 3, -1e6, 0.5 * DAY_S)

    def named(recording: SpatialRecording) -> SpatialRecording:
        given, pose = recording.detections, recording.odometry
        assert pose is not None
        return recording if given is None else replace(recording, detections=_named(recording, street))

    first = run_session(named(street.drive(1, 0.0, faults=Faults(bend=0.0, scale=1.0))))
    second = run_session(named(street.drive(2, DAY_S, (0.1, 1.0), Faults(bend=0.0, scale=1.0))), first.living)
    assert second.found
    assert {7001, 7002} <= set(second.living.members.landmark_id.tolist())
    assert [one.kind for one in second.changes] == [ChangeKind.VANISHED]


def _named(recording: SpatialRecording, street: Parking):  # type: ignore[no-untyped-def]
    """Detections of two slots, by where the robot truly is, with identities."""
    given, odometry = recording.detections, recording.odometry
    assert odometry is not None
    start = street.path[0] if recording.name == "drive 0" else street.path[int(0.1 * len(street.path))]
    half = 0.5 * start[2]
    origin = np.array([start[0], start[1], 0.0, 0.0, 0.0, np.sin(half), np.cos(half)])
    pose = se3.compose(origin, odometry.pose_world_robot)[given.frame]
    at = se3.transform(pose, given.position_sensor_m)[:, :2]
    name = given.landmark_id.copy()
    for slot, one in ((5, 7001), (24, 7002)):
        name[np.linalg.norm(at - street.slot[slot, :2], axis=1) < 2.0] = one
    return replace(given, landmark_id=name)


def test_what_was_glimpsed_and_is_found_later_has_not_appeared() -> None:
    """A car that something hides on the first day but for three frames: too few for a landmark, but its place was not
    empty. Others leave until it is seen, so that it might as well have come.
    """
    seed, slot, later_s = 4, 10, 5.0 * DAY_S
    rng, street = np.random.default_rng(seed), Parking.of(seed)
    for each in range(len(street.slot)):
        street.park(rng, each, -1e6, 1e6 if each < 28 else 0.5 * later_s)
    first = street.drive(100 * seed, 0.0)
    seen = first.detections
    assert first.truth is not None
    at_m = se3.transform(first.truth.pose_world_robot[seen.frame], seen.position_sensor_m)
    mine = np.flatnonzero(np.linalg.norm(at_m[:, :2] - street.slot[slot, :2], axis=1) < 2.0)
    assert len(mine) > 20
    hidden = np.isin(np.arange(len(seen)), np.delete(mine, np.arange(len(mine) - 4, len(mine) - 1)))
    living = run_session(replace(first, detections=rows_of(seen, ~hidden))).living
    names, slots = in_street(living, street)
    assert slot not in slots
    glimpses, landmarks = living.glimpses.position_m, living.landmarks().position_m[:, :2]
    assert slot in street.find_slots(np.concatenate([landmarks, glimpses]))[len(names) :]
    assert np.linalg.norm(glimpses[:, None] - landmarks, axis=2).min() > 1.0  # of landmarks there are none
    second, came = street.drive(100 * seed + 1, later_s), list[int]()
    for before in (living, replace(living, glimpses=Glimpses.empty())):
        session = run_session(second, before)
        names, slots = in_street(session.living, street)
        assert slot in slots
        came.append(sum(change.kind in COMES for change in session.changes))
    assert came == [0, 1]


def test_what_is_seen_to_leave_or_to_move_is_no_glimpse() -> None:
    """It leaves an empty place."""
    rng, street = np.random.default_rng(4), Parking.of(4)
    for each in range(len(street.slot)):
        street.park(rng, each, -1e6, 20.9 if each == 10 else 1e6)
    living = run_session(street.drive(400, 0.0, faults=Faults(p_false=0.0), moving=0)).living
    assert 10 not in in_street(living, street)[1]
    assert not len(living.glimpses)
