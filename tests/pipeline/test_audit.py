"""Audits of maps whose mistakes are known: each is found, nothing else, and the file is put right there alone."""

from __future__ import annotations

import functools
import json
import subprocess
import sys
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from space.corridors import World, tagged_corridor

from evermap.errors import DataError
from evermap.io import read_recording
from evermap.io.map_formats import MAP_FORMATS, SurveyFile, correct_map, read_landmarks, read_map_file, write_map
from evermap.pipeline import run_slam
from evermap.runs.audit import run as audit_module
from evermap.runs.audit.drives import in_order
from evermap.runs.audit.entries import join_drives, with_exchanges
from evermap.runs.audit.report import audit_dict, conclude, entry_row, list_rows, quiet_lines, write_audit
from evermap.runs.audit.result import Audit, AuditEntry, EntryState
from evermap.runs.audit.run import audit_map
from evermap.runs.summary import RunInfo
from evermap.types import (
    Cause,
    ChangeKind,
    Clock,
    Landmarks,
    MapChange,
    Recording,
    SensorKind,
    SlamResult,
    SpatialRecording,
    Verdict,
    VerdictKind,
    rows_of,
)
from evermap_studies.worlds.edited import later
from evermap_studies.worlds.robots import Robot, simulate_robot

STATES = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0])
ROBOT = Robot(
    SensorKind.LASER, STATES, 0.0, 8.0, 5.0, 2.0, 0.9, 0.02, 0.002, 0.004, 0.0, 1.0, 0.0, 0.01, 0.005, 0.01, 16.0, 24,
    120.0, 0.8,
)  # fmt: skip
FORMATS = {kind.name: kind for kind in MAP_FORMATS}


@functools.cache
def corridor(seed: int) -> World:
    return tagged_corridor(seed, n_tags=16, n_frames=300, drift=0.02)


def surveyed(world: World, *, sigma_m: float = 0.005, seed: int = 0) -> Landmarks:
    """Return the map as somebody measured it."""
    rng, tags = np.random.default_rng(seed), world.tags
    return replace(tags, position_m=np.round(tags.position_m + rng.normal(0.0, sigma_m, tags.position_m.shape), 4))


def without(recording: SpatialRecording, *ids: int) -> SpatialRecording:
    """Return the drive as if some tags were not there."""
    seen = recording.detections
    return replace(recording, detections=rows_of(seen, ~np.isin(seen.landmark_id, ids)))


def as_file(tags: Landmarks, path: Path, name: str = "wpilib") -> SurveyFile:
    return read_map_file(write_map(tags, path, FORMATS[name]), sigma_m=0.01)


def told(audit: Audit, *states: EntryState) -> dict[str, EntryState]:
    """Return what is told of entries, but for those that are right and not asked for."""
    wanted = states or tuple(state for state in EntryState if state is not EntryState.RIGHT)
    return {entry.label: entry.state for entry in audit.entries if entry.state in wanted}


def turned(tags: Landmarks, row: int, degrees: float) -> Landmarks:
    rotation = tags.rotation.copy()
    rotation[row] = (Rotation.from_quat(rotation[row]) * Rotation.from_euler("z", degrees, degrees=True)).as_quat()
    return replace(tags, rotation=rotation)


def shifted(tags: Landmarks, row: int, by: list[float]) -> Landmarks:
    position = tags.position_m.copy()
    position[row] += by
    return replace(tags, position_m=position)


def exchanged(tags: Landmarks, one: int, other: int) -> Landmarks:
    order = np.arange(len(tags))
    order[[one, other]] = other, one
    return replace(tags, position_m=tags.position_m[order], rotation=tags.rotation[order])


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_a_right_map_is_called_right_and_stays_as_it_is(seed: int, tmp_path: Path) -> None:
    world = corridor(seed)
    file = as_file(surveyed(world), tmp_path / "field.json")
    found = audit_map(file.landmarks, [world.recording])
    assert told(found) == {}
    assert conclude(found)[0] == "right"
    assert correct_map(file, found.corrections()) == file.path.read_bytes()


@pytest.mark.parametrize(
    "name", ["wpilib", *(pytest.param(one, marks=pytest.mark.slow) for one in ("tagslam", "fiducials", "csv"))]
)
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_every_mistake_is_found_and_put_right_and_nothing_else(name: str, seed: int, tmp_path: Path) -> None:
    """One moved by .3 m, one turned by 90 degrees, two exchanged, one taken away, one never looked at, one missing."""
    world = corridor(seed)
    true = surveyed(world)
    wrong = exchanged(turned(shifted(true, 3, [0.3, 0.0, 0.0]), 5, 90.0), 8, 9)
    far = Landmarks.in_space([51], [[7.5, -30.0, 0.5]], rotation=true.rotation[[6]])
    keep = true.landmark_id != 13
    wrong = Landmarks.in_space(
        np.append(wrong.landmark_id[keep], far.landmark_id),
        np.vstack([wrong.position_m[keep], far.position_m]),
        rotation=np.vstack([wrong.rotation[keep], far.rotation]),
    )
    file = as_file(wrong, tmp_path / "map", name)
    found = audit_map(file.landmarks, [without(world.recording, 11)])
    assert told(found) == {
        "3": EntryState.WRONG, "5": EntryState.WRONG, "8": EntryState.EXCHANGED, "9": EntryState.EXCHANGED,
        "11": EntryState.GONE, "13": EntryState.MISSING, "51": EntryState.UNSEEN,
    }  # fmt: skip
    by_label = {entry.label: entry for entry in found.entries}
    moved, quarter = by_label["3"], by_label["5"]
    assert (moved.moved, moved.turned) == (True, False)
    assert (quarter.moved, quarter.turned) == (False, True)
    assert np.degrees(quarter.turn_rad) == pytest.approx(90.0, abs=3.0 * np.degrees(quarter.turn_sigma_rad))
    assert all(entry.probability > 0.9 for entry in found.faults)
    (tmp_path / "corrected").write_bytes(correct_map(file, found.corrections()))
    before, after = read_landmarks(file.path), read_landmarks(tmp_path / "corrected")
    rows = {identity: row for row, identity in enumerate(before.landmark_id.tolist())}
    same = [rows[k] for k in rows if k not in (3, 5, 8, 9)]
    np.testing.assert_array_equal(after.position_m[same], before.position_m[same])
    np.testing.assert_array_equal(after.rotation[same], before.rotation[same])
    for k in (8, 9):  # as the survey had them, to the last digit
        np.testing.assert_allclose(after.position_m[rows[k]], before.position_m[rows[17 - k]], atol=1e-12)
    off = after.position_m[rows[3]] - world.tags.position_m[3]
    assert np.linalg.norm(off) < 3.5 * np.sqrt(3.0) * moved.sigma_m
    np.testing.assert_array_equal(after.position_m[rows[5]], before.position_m[rows[5]])
    turn = Rotation.from_quat(after.rotation[rows[5]]).inv() * Rotation.from_quat(world.tags.rotation[5])
    assert turn.magnitude() < 3.5 * np.sqrt(3.0) * quarter.turn_sigma_rad


@pytest.mark.slow
def test_what_moved_between_two_drives_is_stale_and_what_was_wrong_before_is_wrong() -> None:
    world = corridor(1)
    given = shifted(surveyed(world), 3, [0.0, 0.0, 0.4])
    given = given.as_prior(0.01)
    first, second = world.recording, corridor(1).recording
    # overnight somebody exchanged the tags 7 and 12
    names = second.detections.landmark_id
    swapped = np.where(names == 7, 12, np.where(names == 12, 7, names))
    second = replace(second, detections=replace(second.detections, landmark_id=swapped))
    found = audit_map(given, [first, second])
    assert told(found) == {"3": EntryState.WRONG, "7": EntryState.EXCHANGED, "12": EntryState.EXCHANGED}
    by_label = {entry.label: entry for entry in found.entries}
    assert by_label["3"].n_drives == 2
    assert np.isnan(by_label["3"].from_s)
    stale = by_label["7"]
    assert found.drives[0].from_s < stale.from_s <= found.drives[0].to_s < found.drives[1].from_s <= stale.to_s


def entry_at(name: int, place: list[float], state: EntryState, p: float = 0.999, hits: int = 6) -> AuditEntry:
    """A point that was seen at a place of the plane."""
    at, no = np.array(place), float("nan")
    return AuditEntry(name, str(name), state, p, at, no, no, no, no, 1.0, hits, 0, 1, at, 1e-4 * np.eye(2))


@pytest.mark.parametrize(
    ("p", "hits", "state", "is_exchanged"),
    [
        (0.999, 6, EntryState.UNDECIDED, True), (0.999, 3, EntryState.UNDECIDED, True),
        (0.999, 2, EntryState.UNDECIDED, False), (0.8, 6, EntryState.UNDECIDED, False),
        (0.999, 6, EntryState.RIGHT, False), (0.999, 6, EntryState.STALE, True),
    ],
)  # fmt: skip
def test_one_that_few_readings_put_at_the_place_of_another_was_exchanged_with_it(
    p: float, hits: int, state: EntryState, is_exchanged: bool
) -> None:
    """Where 1 should be stands 2 for certain, so that 1 is not there, whatever most readings of its number are."""
    given = Landmarks.at(np.array([1, 2, 3]), np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]]), sigma_m=0.01)
    few, sure = entry_at(1, [5.0, 0.0], state, p, hits), entry_at(2, [0.0, 0.0], EntryState.WRONG)
    found = with_exchanges([few, sure, entry_at(3, [0.0, 5.0], EntryState.RIGHT, 0.001)], given)
    wanted = [EntryState.EXCHANGED, EntryState.EXCHANGED] if is_exchanged else [state, EntryState.WRONG]
    assert [one.state for one in found] == [*wanted, EntryState.RIGHT]
    assert [one.like_id for one in found] == ([2, 1, -1] if is_exchanged else [-1, -1, -1])


def test_of_two_that_are_not_decided_none_decides_the_other() -> None:
    given = Landmarks.at(np.array([1, 2]), np.array([[0.0, 0.0], [5.0, 0.0]]), sigma_m=0.01)
    both = [entry_at(1, [5.0, 0.0], EntryState.UNDECIDED), entry_at(2, [0.0, 0.0], EntryState.UNDECIDED)]
    assert [one.state for one in with_exchanges(both, given)] == [EntryState.UNDECIDED] * 2


@pytest.mark.slow
def test_what_moved_while_the_robot_drove_is_stale_from_then_on() -> None:
    """On the way back the tag 6 hangs where 14 was: its number is at two places, one after the other."""
    world = corridor(3)
    seen, stamps = world.recording.detections, world.recording.frames.stamp_s
    half_s = float(stamps[len(stamps) // 2])
    back = stamps[seen.frame] > half_s
    names = np.where(back & (seen.landmark_id == 14), 6, seen.landmark_id)
    kept = ~(back & (seen.landmark_id == 6)) & ~(~back & (seen.landmark_id == 14))
    drive = replace(world.recording, detections=rows_of(replace(seen, landmark_id=names), kept))
    given = surveyed(world).as_prior(0.01)
    found = audit_map(given[given.landmark_id != 14], [drive])
    assert told(found) == {"6": EntryState.STALE}
    entry = found.faults[0]
    assert entry.from_s <= half_s <= entry.to_s
    assert entry.position_m == pytest.approx(world.tags.position_m[14], abs=0.1)


def test_probabilities_of_drives_are_joined_by_when_it_may_have_moved() -> None:
    assert join_drives([0.5]) == (pytest.approx(0.5), 0)
    both, since = join_drives([0.5, 0.5])
    assert (both > 0.9, since) == (True, 0)
    after, since = join_drives([0.001, 0.99])
    assert (after > 0.9, since) == (True, 1)
    assert join_drives([0.005, 0.005])[0] < 0.02
    assert join_drives([0.9999, 0.9999, 0.9999])[0] <= 0.999
    once, _ = join_drives([0.9, 0.001])
    assert once < 0.5  # where it was seen last it stands


def test_drives_whose_clocks_start_anew_follow_each_other() -> None:
    drive = simulate_robot(replace(ROBOT, duration_s=20.0), 1)
    first, second = in_order([drive, drive])
    assert second.frames.stamp_s[0] > first.frames.stamp_s[-1]
    assert np.diff(second.odometry.stamp_s) == pytest.approx(np.diff(drive.odometry.stamp_s))
    dated = replace(
        later(drive, 1.7e9), clock=Clock.UNIX
    )  # a bag beside tables: the order is that in which they are given
    first, second, third = in_order([dated, drive, later(drive, 5.0)])
    assert {one.clock for one in (first, second, third)} == {Clock.RECORDING}
    spans = [(one.frames.stamp_s[0], one.frames.stamp_s[-1]) for one in (first, second, third)]
    assert 0.0 <= spans[0][0] < spans[0][1] < spans[1][0] < spans[1][1] < spans[2][0] < 400.0
    np.testing.assert_allclose(np.diff(first.frames.stamp_s), np.diff(drive.frames.stamp_s), atol=1e-5)
    ordered = in_order([later(drive, 1000.0), drive])
    assert [one.frames.stamp_s[0] for one in ordered] == sorted(one.frames.stamp_s[0] for one in ordered)


@functools.cache
def hall(seed: int) -> Recording:
    return simulate_robot(ROBOT, seed)


def poles(recording: Recording, seed: int) -> Landmarks:
    true = recording.true_landmarks
    noise = np.random.default_rng(seed).normal(0.0, 0.005, true.position_m.shape)
    return Landmarks.at(true.landmark_id, true.position_m + noise, sigma_m=0.01, frame="prior_map")


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_in_the_plane(seed: int, tmp_path: Path) -> None:
    """One pole moved by .3 m, two labels exchanged, one pole cut down; as a table of somebody's."""
    recording = hall(seed)
    names, hits = np.unique(recording.detections.landmark_id, return_counts=True)
    often = names[np.argsort(-hits)][:8]
    moved, one, other, gone = (int(often[k]) for k in (0, 2, 4, 6))
    given = poles(recording, seed)
    at = given.position_m.copy()
    row = {int(name): k for k, name in enumerate(given.landmark_id)}
    at[row[moved]] += [0.24, -0.18]
    at[[row[one], row[other]]] = at[[row[other], row[one]]]
    path = tmp_path / "poles.txt"
    lines = [
        f"{name},{x:.3f},{y:.3f},steel" for name, (x, y) in zip(given.landmark_id.tolist(), at.tolist(), strict=True)
    ]
    path.write_text("\n".join(["id,x,y,made of", *lines]) + "\n")
    file = read_map_file(path, sigma_m=0.01)
    seen = recording.detections
    recording = replace(recording, detections=rows_of(seen, seen.landmark_id != gone), true_landmarks=None, truth=None)
    found = audit_map(file.landmarks, [recording])
    assert told(found, EntryState.WRONG, EntryState.EXCHANGED, EntryState.STALE, EntryState.MISSING) == {
        str(moved): EntryState.WRONG, str(one): EntryState.EXCHANGED, str(other): EntryState.EXCHANGED,
    }  # fmt: skip
    by_label = {entry.label: entry for entry in found.entries}
    assert by_label[str(gone)].state in (EntryState.GONE, EntryState.UNDECIDED, EntryState.UNSEEN)
    data = correct_map(file, found.corrections()).decode().splitlines()
    changed = [new.split(",")[0] for old, new in zip(path.read_text().splitlines(), data, strict=True) if old != new]
    assert sorted(changed) == sorted(map(str, (moved, one, other)))
    (tmp_path / "new.txt").write_text("\n".join(data) + "\n")
    after = read_landmarks(tmp_path / "new.txt")
    off = after.position_m[row[moved]] - given.position_m[row[moved]]
    assert np.linalg.norm(off) < 3.5 * np.sqrt(2.0) * np.hypot(by_label[str(moved)].sigma_m, 0.01)


def test_a_map_of_another_site_says_so() -> None:
    recording = hall(1)
    given = poles(recording, 1)
    with pytest.raises(DataError, match=r"no landmark of the map was ever seen: the map has 1001, 1002, 1003, 1004 to"):
        audit_map(replace(given, landmark_id=given.landmark_id + 1000), [recording])


def test_a_drive_that_cannot_be_used_is_named_and_the_others_count() -> None:
    recording = hall(1)
    nothing = rows_of(recording.detections, np.zeros(len(recording.detections), dtype=np.bool_))
    blind = replace(later(recording, 1000.0), detections=nothing, name="blind")
    found = audit_map(poles(recording, 1), [recording, blind])
    assert [drive.is_heard for drive in found.drives] == [True, False]
    assert found.drives[1].reason
    assert told(found, EntryState.WRONG, EntryState.STALE, EntryState.EXCHANGED) == {}


@pytest.mark.parametrize(
    ("kind", "causes", "counts"),
    [
        (VerdictKind.LOST, 0, False),
        (VerdictKind.SENSOR_SUSPECT, 0, False),
        (VerdictKind.SENSOR_SUSPECT, 1, True),
        (VerdictKind.MAP_OUTDATED, 0, True),
        (VerdictKind.WEAK, 0, True),
    ],
)
def test_a_verdict_decides_whether_a_drive_counts(kind, causes, counts, monkeypatch) -> None:
    """What the estimator doubts is no evidence against the map; a cause that it found is listed as the sensor's."""
    cause = Cause("tag-size", "left", "tags are 3 % smaller than stated", fix="tag_size_m = 0.097")
    verdict = Verdict(kind, "what the estimator says")
    results = [replace(solved_corridor(), verdict=verdict, causes=(cause,) * causes)]
    monkeypatch.setattr(audit_module, "run_slam", lambda *_, **__: results[0])
    world = corridor(2)
    found = audit_map(surveyed(world).as_prior(0.01), [world.recording])
    assert found.drives[0].is_heard == counts
    assert conclude(found)[0] == ("right" if counts else "untested")
    assert bool(quiet_lines(found)) == counts  # of a map that no drive judges not even 'never seen' is said
    assert list_rows(found) == []
    assert {entry.state for entry in found.entries} == {EntryState.RIGHT if counts else EntryState.UNDECIDED}
    assert found.drives[0].sensor == ("tags are 3 % smaller than stated; tag_size_m = 0.097",) * causes


@pytest.mark.parametrize(
    ("factor", "fix"),
    [((3.2808, 3.2808), "0.3048"), pytest.param((1.0, -1.0), "the sign of y", marks=pytest.mark.slow)],
)
def test_a_map_that_is_wrong_as_a_whole_says_so_and_of_no_entry_anything(factor, fix) -> None:
    """In feet, mirrored: all its entries are off, and what mends them is one line."""
    recording = hall(1)
    given = poles(recording, 1)
    found = audit_map(replace(given, position_m=given.position_m * factor), [recording])
    verdict, message = conclude(found)
    assert verdict == "wrong"
    assert message.startswith("the map as a whole is wrong: ")
    assert fix in message
    assert {entry.state for entry in found.entries} == {EntryState.UNDECIDED}
    assert (list_rows(found), quiet_lines(found), found.corrections()) == ([], [], [])
    assert found.drives[0].sensor == ()


def test_a_drive_that_alone_finds_the_whole_map_wrong_does_not_count(monkeypatch) -> None:
    of_map = Cause("map-scale", "map", "true distances are 0.98 times those of the given map", fix="lengths x 0.98")
    outdated = Verdict(VerdictKind.MAP_OUTDATED, "another scale")
    sound = solved_corridor()
    scaled = replace(sound, verdict=outdated, causes=(of_map,))
    world, given = corridor(2), surveyed(corridor(2)).as_prior(0.01)

    def audit_of(*results: SlamResult) -> Audit:
        each = iter(results)
        monkeypatch.setattr(audit_module, "run_slam", lambda *_, **__: next(each))
        return audit_map(given, [world.recording] * len(results))

    one = audit_of(sound, scaled)
    assert [drive.is_heard for drive in one.drives] == [True, False]
    assert (conclude(one)[0], one.of_map) == ("right", "")
    most = audit_of(scaled, sound, scaled)
    assert (conclude(most)[0], bool(most.of_map)) == ("wrong", True)
    assert most.corrections() == []


@pytest.mark.parametrize(("hits", "state"), [(1, "undecided"), (0.4, "undecided"), (0.6, "wrong")])
def test_an_entry_is_wrong_by_most_of_the_readings_of_its_number(hits: float, state: str, monkeypatch) -> None:
    """Of a place that few of its readings fit nothing is claimed: it may be the few that are wrong."""
    result, world = solved_corridor(), corridor(2)
    seen = result.landmarks
    read = int(np.count_nonzero(world.recording.detections.landmark_id == 3))
    count = hits if isinstance(hits, int) else int(np.ceil(hits * read))
    assert read > 10
    at, n_hits = seen.position_m.copy(), seen.n_hits.copy()
    at[seen.landmark_id == 3] += [0.0, 0.0, 0.5]
    n_hits[seen.landmark_id == 3] = count
    change = MapChange((3,), ChangeKind.MOVED, np.nan, 0.0, (0.0, 0.0, 0.5), 0.0, 0.999)
    moved = replace(result, landmarks=replace(seen, position_m=at, n_hits=n_hits), changes=(change,))
    monkeypatch.setattr(audit_module, "run_slam", lambda *_, **__: moved)
    found = audit_map(surveyed(world).as_prior(0.01), [world.recording])
    assert told(found) == {"3": EntryState(state)}
    (entry,) = [one for one in found.entries if one.landmark_id == 3]
    assert (f"{count} times" in entry.reason) == (state == "undecided")
    assert len(found.corrections()) == (state == "wrong")


def test_a_number_on_two_landmarks_is_told() -> None:
    """A pole has the number of another one, which the map has; its own number is not in the map."""
    recording = hall(1)
    names, hits = np.unique(recording.detections.landmark_id, return_counts=True)
    one, other = (int(name) for name in names[np.argsort(-hits)][[0, 3]])
    seen = recording.detections
    named = np.where(seen.landmark_id == other, one, seen.landmark_id)
    drive = replace(recording, detections=replace(seen, landmark_id=named))
    given = poles(recording, 1)
    found = audit_map(given[given.landmark_id != other], [drive])
    assert not found.corrections()
    (entry,) = [each for each in found.entries if each.landmark_id == one]
    lines = [*quiet_lines(found), *(row[-1] for row in list_rows(found))]
    if entry.state is EntryState.RIGHT:
        assert any(line.startswith(f"{one}: right, but ") for line in lines)
    else:
        assert entry.state is EntryState.UNDECIDED
        assert "two landmarks" in entry.reason


def test_an_entry_whose_number_is_read_elsewhere_too_is_right_and_that_is_told(monkeypatch) -> None:
    """Where the two are not seen at once: of each its place is right, and a third of its readings fits no place."""
    result, world = solved_corridor(), corridor(2)
    monkeypatch.setattr(audit_module, "run_slam", lambda *_, **__: result)
    given, seen = surveyed(world).as_prior(0.01), world.recording.detections
    others = np.flatnonzero(seen.landmark_id == 4)
    own = int(result.landmarks.n_hits[result.landmarks.landmark_id == 3][0])
    lines = []
    for count in (own // 4, own // 2):
        named = seen.landmark_id.copy()
        named[others[:count]] = 3
        drive = replace(world.recording, detections=replace(seen, landmark_id=named))
        found = audit_map(given, [drive])
        assert told(found) == {}
        lines.append([line for line in quiet_lines(found) if line.startswith("3: ")])
    few, many = lines
    assert few == []
    read = int(np.count_nonzero(named == 3))
    assert many == [f"3: right, but {read - own} of {read} readings of its number are of something elsewhere"]


@pytest.mark.parametrize(
    ("probability", "state"), [(0.05, "right"), (0.2, "undecided"), (0.85, "undecided"), (0.95, "wrong")]
)
def test_nothing_is_claimed_that_is_not_nine_times_as_probable(probability: float, state: str, monkeypatch) -> None:
    result, world = solved_corridor(), corridor(2)
    change = MapChange((3,), ChangeKind.MOVED, np.nan, 0.0, (0.0, 0.0, 0.5), 0.0, probability)
    monkeypatch.setattr(audit_module, "run_slam", lambda *_, **__: replace(result, changes=(change,)))
    found = audit_map(surveyed(world).as_prior(0.01), [world.recording])
    (entry,) = [one for one in found.entries if one.landmark_id == 3]
    assert entry.state is EntryState(state)
    assert entry.probability == pytest.approx(probability, abs=1e-3)


def test_what_a_drive_saw_to_move_is_stale_from_then_on(monkeypatch) -> None:
    result, world = solved_corridor(), corridor(2)
    from_s, to_s = (float(world.recording.frames.stamp_s[frame]) for frame in (100, 110))
    row = int(np.flatnonzero(result.landmarks.landmark_id == 3)[0])
    change = MapChange((3,), ChangeKind.MOVED, from_s, to_s, (0.0, 0.0, 0.5), 0.0, 0.999)
    moved = replace(result, landmarks=shifted(result.landmarks, row, [0.0, 0.0, 0.5]), changes=(change,))
    monkeypatch.setattr(audit_module, "run_slam", lambda *_, **__: moved)
    found = audit_map(surveyed(world).as_prior(0.01), [world.recording])
    assert told(found) == {"3": EntryState.STALE}
    (entry,) = found.faults
    assert (entry.from_s, entry.to_s) == (from_s, to_s)
    assert entry.position_m == pytest.approx(world.tags.position_m[3] + [0.0, 0.0, 0.5], abs=0.1)


@pytest.mark.parametrize(("metres", "degrees", "what"), [(0.1, 0.0, "position"), (0.0, 5.0, "rotation")])
def test_only_what_is_off_by_more_than_the_survey_is_corrected(metres, degrees, what, monkeypatch) -> None:
    result, world = solved_corridor(), corridor(2)
    row = int(np.flatnonzero(result.landmarks.landmark_id == 3)[0])
    seen = turned(shifted(result.landmarks, row, [metres, 0.0, 0.0]), row, degrees)
    change = MapChange((3,), ChangeKind.MOVED, np.nan, 0.0, (metres, 0.0, 0.0), 0.0, 0.999)
    off = replace(result, landmarks=seen, changes=(change,))
    monkeypatch.setattr(audit_module, "run_slam", lambda *_, **__: off)
    (entry,) = audit_map(surveyed(world).as_prior(0.01), [world.recording]).faults
    assert (entry.moved, entry.turned) == (what == "position", what == "rotation")


def test_a_place_that_is_read_twice_only_is_not_called_wrong(monkeypatch) -> None:
    result, world = solved_corridor(), corridor(2)
    seen, kept = result.landmarks, world.recording.detections
    mine = np.flatnonzero(kept.landmark_id == 3)
    at, n_hits = seen.position_m.copy(), seen.n_hits.copy()
    at[seen.landmark_id == 3] += [0.0, 0.0, 0.5]
    change = MapChange((3,), ChangeKind.MOVED, np.nan, 0.0, (0.0, 0.0, 0.5), 0.0, 0.999)
    states = []
    for count in (2, 3):
        n_hits[seen.landmark_id == 3] = count
        moved = replace(result, landmarks=replace(seen, position_m=at, n_hits=n_hits.copy()), changes=(change,))
        monkeypatch.setattr(audit_module, "run_slam", lambda *_, moved=moved, **__: moved)
        drive = replace(world.recording, detections=rows_of(kept, np.delete(np.arange(len(kept)), mine[count:])))
        found = audit_map(surveyed(world).as_prior(0.01), [drive])
        states.append(told(found)["3"])
    assert states == [EntryState.UNDECIDED, EntryState.WRONG]


@functools.cache
def solved_corridor() -> SlamResult:
    return run_slam(corridor(2).recording, prior_map=surveyed(corridor(2)).as_prior(0.01))


@pytest.mark.parametrize(("sigma_m", "text"), [(0.024, "± 0.02 m"), (0.0032, "± 0.003 m"), (1e-6, "± 0.001 m")])
def test_no_deviation_is_printed_as_nothing(sigma_m: float, text: str) -> None:
    way, nan = np.array([1.0, 0.0]), np.nan
    entry = AuditEntry(3, "3", EntryState.WRONG, 1.0, way, sigma_m, nan, nan, nan, 0.0, 9, 0, 1, way, np.eye(2))
    assert text in entry_row(entry, Clock.RECORDING)[2]


def test_the_report_says_all_of_it(tmp_path: Path) -> None:
    world = tagged_corridor(2, n_tags=8, n_frames=120, drift=0.02)
    file = as_file(shifted(surveyed(world), 3, [0.3, 0.0, 0.0]), tmp_path / "field.json")
    found = audit_map(file.landmarks, [world.recording])
    summary = write_audit(tmp_path / "out", found, file, RunInfo(command="evermap audit"))
    (entry,) = [one for one in summary["entries"] if one["state"] == "wrong"]
    assert (entry["label"], entry["corrected"]) == ("3", ["position"])
    assert entry["distance_m"] == pytest.approx(0.3, abs=0.03)
    assert summary["counts"]["right"] == 7
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["entries"] == summary["entries"]
    assert audit_dict(found, file)["verdict"] == "wrong"
    row = entry_row(found.entries[0], found.clock)
    for name in ("report.md", "report.html"):
        text = (tmp_path / "out" / name).read_text()
        assert all(cell in text for cell in row[:3])
    corrected = tmp_path / "out" / "corrected" / "field.json"
    assert corrected.read_bytes() == correct_map(file, found.corrections())
    assert (tmp_path / "out" / "figures" / "audit.svg").stat().st_size > 1000


@pytest.mark.data
@pytest.mark.slow
def test_two_labels_of_a_published_survey_are_exchanged(shared_data: Path, tmp_path: Path) -> None:
    """STAR-loc: 35 and 36, by three sessions whose clocks all start at 0; nothing else."""
    folder, drives = shared_data / "starloc", []
    for name in ("loop-2d_s1", "loop-3d_s1", "zigzag_s2"):
        command = [sys.executable, folder / "starloc_to_plain.py", folder, name, tmp_path / name]
        subprocess.run(command, check=True)
        drives.append(read_recording(tmp_path / name))
    file = read_map_file(folder / "mocap" / "environment_v1.csv")
    found = audit_map(file.landmarks, drives)
    assert {entry.label for entry in found.faults} == {"35", "36"}
    assert {entry.state for entry in found.faults} == {EntryState.EXCHANGED}
    assert sum(entry.state is EntryState.RIGHT for entry in found.entries) >= 48
    before, after = file.data.decode().splitlines(), correct_map(file, found.corrections()).decode().splitlines()
    changed = [(old, new) for old, new in zip(before, after, strict=True) if old != new]
    assert [new.split(",")[1:4] for _, new in changed] == [old.split(",")[1:4] for old, _ in changed[::-1]]


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_edited_entries_of_a_real_survey_are_found_beside_those_that_are_off(shared_data: Path, seed: int) -> None:
    """A building on two days: three entries moved by .4 m are found, and nothing else changes its state."""
    folder = shared_data / "tagslam"
    drives = [read_recording(folder / name) for name in ("test_10", "test_11")]
    given = read_map_file(folder / "test_10" / "survey.csv.gz").landmarks
    before = audit_map(given, drives)
    often = [entry.landmark_id for entry in before.entries if entry.state is EntryState.RIGHT and entry.n_hits >= 10]
    rng, at = np.random.default_rng(seed), given.position_m.copy()
    chosen = rng.choice(often, 3, replace=False)
    for name in chosen:
        way = rng.normal(size=3)
        at[given.landmark_id == name] += 0.4 * way / np.linalg.norm(way)
    after = audit_map(replace(given, position_m=at), drives)
    faults = {entry.landmark_id for entry in before.faults}
    assert {entry.landmark_id for entry in after.faults} == faults | set(chosen.tolist())


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("case", ["c_latency", "c_midmove"])
def test_drives_on_an_official_field(shared_data: Path, tmp_path: Path, case: str) -> None:
    """Right layout, late camera: only the clock is wrong. Of a tag that is moved on the way its new place is told."""
    with tarfile.open(shared_data / "cases" / f"{case}.tar.gz") as packed:
        packed.extractall(tmp_path, filter="data")
    layout = shared_data / "field" / "wpilib" / "format_2022_to_2026" / "2025-reefscape-andymark.json"
    file, drive = read_map_file(layout), read_recording(tmp_path / case)
    found = audit_map(file.landmarks, [drive])
    if case == "c_latency":
        assert not found.faults
        assert any("delay" in line for line in found.drives[0].sensor)
        assert correct_map(file, found.corrections()) == layout.read_bytes()
        return
    assert {entry.label.partition("#")[0] for entry in found.faults} == {"12"}
    (entry,) = found.faults  # stale, or a second tag of its number where frames of both places are mixed
    assert entry.position_m == pytest.approx([1.66, 1.23, 1.485], abs=0.05)


def test_the_plan_of_an_audit_that_saw_nothing_shows_the_map() -> None:
    """No drive that can be trusted leaves no path and no entry seen."""
    from evermap.viz.audit_figure import PlanEntry, draw_audit

    nothing = np.full(2, np.nan)
    places = [np.array([0.0, 1.0]), np.array([4.0, 3.0])]
    unseen = [PlanEntry(str(k), "unseen", at, nothing, np.eye(2), None, None, "") for k, at in enumerate(places)]
    axes = draw_audit(unseen, [], "Audit").figure.axes[0]
    low, high = np.sort([axes.get_xlim(), axes.get_ylim()], axis=1).T
    assert all((low < at).all() and (at < high).all() for at in places)
