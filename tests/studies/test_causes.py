"""Worlds with causes: what is right is right, what is wrong is wrong, and answers are scored as they should be."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evermap.errors import ConfigError
from evermap.geometry import se2, se3
from evermap.geometry.rigid import rigid
from evermap.io.spatial import integrated
from evermap.types import ChangeKind, Clock, FloatArray, MapChange, SpatialDetections, SpatialOdometry
from evermap_studies.causes import mistakes, study
from evermap_studies.causes.answers import ANSWERS
from evermap_studies.causes.catalogue import World, catalogue
from evermap_studies.causes.drives import MAKES, NEXT, Drive, Reading, as_recording, simulate
from evermap_studies.causes.judge import (
    compare_changes,
    conclude,
    errors,
    find_answer,
    judge,
    make_case,
    solve,
    true_changes,
)
from evermap_studies.rows import ROWS

pytestmark = pytest.mark.slow

WORLDS = catalogue()
WRONG = [world for world in WORLDS if world.cause and world.cause != "noise"]
MOST = 20.0
"""Most that a reading counts, in units of what is usual."""


def by_name(name: str) -> World:
    return next(world for world in WORLDS if world.name == name)


def reading_errors(drive: Drive) -> float:
    """Mean error of positions and orientations that evermap is given, from the true poses to its map or the truth."""
    recording = as_recording(drive)
    known = drive.true_places if drive.places is None or drive.moved_frame else drive.places
    seen, stamp_s = recording.detections, recording.frames.stamp_s[recording.detections.frame]
    robot = se3.interpolate(drive.truth_s, drive.truth, np.clip(stamp_s, drive.truth_s[0], drive.truth_s[-1]))
    mount = np.array([one.mount_robot_sensor for one in drive.sensors])
    ids = seen.landmark_id if drive.named else drive.landmark
    row = np.minimum(np.searchsorted(known.landmark_id, ids), len(known) - 1)
    found = known.landmark_id[row] == ids
    at = known.position_m[row]
    if isinstance(seen, SpatialDetections):
        expected = se3.transform(se3.inverse(se3.compose(robot, mount[seen.sensor])), at)
        given = seen.position_sensor_m
        if drive.reading is Reading.PIXELS:
            expected = expected / np.linalg.norm(expected, axis=1, keepdims=True)
    else:
        at = np.column_stack([at, np.zeros(len(at))])
        expected = se3.transform(se3.inverse(se3.compose(robot, mount[0])), at)
        given = np.column_stack([seen.range_m * np.cos(seen.bearing_rad), seen.range_m * np.sin(seen.bearing_rad)])
        given = np.column_stack([given, np.zeros(len(given))])
        if drive.reading is Reading.RANGE:
            expected = np.linalg.norm(expected, axis=1, keepdims=True)
            given = seen.range_m[:, None]
    usual = 0.02 + 0.02 * np.linalg.norm(expected, axis=1)
    off = np.linalg.norm(given - expected, axis=1) / usual
    if isinstance(seen, SpatialDetections) and known.rotation is not None and np.isfinite(seen.rotation).all():
        turned = se3.compose(se3.compose(robot, mount[seen.sensor]), se3.turn(seen.rotation))
        off += se3.angle_between(turned, se3.turn(known.rotation[row])) / 0.1
    return float(np.minimum(np.where(found, off, MOST), MOST).mean())


def odometry_errors(drive: Drive) -> FloatArray:
    """Mean and largest error of the motion that the odometry reports within two seconds."""
    if not drive.has_odometry:
        return np.zeros(2)
    recording = as_recording(drive)
    odometry = recording.odometry
    if not isinstance(odometry, SpatialOdometry):
        odometry = integrated(drive.odometry_s, drive.twist, Clock.RECORDING)
    stamp_s = np.arange(0.0, drive.truth_s[-1], 2.0)
    told, true = (
        se3.interpolate(at_s, pose, stamp_s)
        for at_s, pose in ((odometry.stamp_s, odometry.pose_world_robot), (drive.truth_s, drive.truth))
    )
    off = se3.between(se3.between(true[:-1], true[1:]), se3.between(told[:-1], told[1:]))
    size = np.linalg.norm(off[:, :3], axis=1) + se3.angle_between(off, se3.identity())
    return np.array([size.mean(), size.max()])


def map_error(drive: Drive) -> float:
    """Largest error of the map that is given, laid over the truth as well as it can be, by 2 cm; ids that nobody has
    count as well.
    """
    if drive.places is None:
        return 0.0
    common, mine, theirs = np.intersect1d(
        drive.places.landmark_id % NEXT, drive.true_places.landmark_id, return_indices=True
    )
    strangers = len(drive.places) - len(common)
    if len(common) < 3:
        return MOST
    given, true = drive.places.position_m[mine], drive.true_places.position_m[theirs]
    transform = se2.transform if given.shape[1] == 2 else se3.transform
    off = transform(rigid(given, true), given) - true
    return strangers + float(np.linalg.norm(off, axis=1).max()) / 0.02


def is_contradicted(given: Drive, right: Drive) -> bool:
    """Whether something of what evermap is given is further from the truth than in the right drive."""
    wheels, usual = odometry_errors(given), odometry_errors(right)
    return bool(
        reading_errors(given) > reading_errors(right) + 0.15
        or wheels[0] > 1.5 * usual[0]
        or wheels[1] > 2.5 * usual[1]
        or map_error(given) > map_error(right) + 1.0
    )


USUAL = {
    Reading.RANGE_BEARING: 0.6,
    Reading.RANGE: 0.6,
    Reading.POSES: 1.2,
    Reading.CORNERS: 3.0,
    Reading.STEREO: 1.3,
    Reading.PIXELS: 0.2,
}
"""Mean error of readings that are right; the orientation of a tag that is far away is one of two."""


@pytest.mark.parametrize("name", MAKES)
def test_a_right_drive_agrees_with_the_truth(name: str) -> None:
    drive = simulate(MAKES[name], 3, in_map=True)
    assert reading_errors(drive) < USUAL[drive.reading]
    assert odometry_errors(drive)[1] < 0.2
    assert map_error(drive) < 2.0


def test_what_moves_gets_a_new_identity_in_what_the_oracle_is_given() -> None:
    case = make_case(by_name("laser in a map: one moved at half time"), 2)
    (event,) = case.events
    identity = event.row + 1
    late = case.right.stamp_s[case.right.landmark == identity + NEXT]
    early = case.right.stamp_s[case.right.landmark == identity]
    assert early.max() < event.at_s <= late.min()
    assert reading_errors(case.right) < 0.6
    assert np.array_equal(case.given.landmark, case.right.landmark % NEXT)
    assert case.given.places is not None
    assert case.given.places.landmark_id.max() < NEXT


def test_same_seed_same_world() -> None:
    world = by_name("corners alone: 5 % of identities misread")
    first, again, other = make_case(world, 1), make_case(world, 1), make_case(world, 2)
    assert np.array_equal(first.given.value, again.given.value)
    assert np.array_equal(first.given.landmark, again.given.landmark)
    assert not np.array_equal(first.given.value[:50], other.given.value[:50])


def test_the_catalogue_holds_what_was_promised() -> None:
    groups = [world.group for world in WORLDS]
    assert groups.count("causes") >= 120
    assert groups.count("mistakes") >= 70
    assert {world.cause for world in WORLDS} == set(ANSWERS)
    assert 25 <= sum(world.quick for world in WORLDS) <= 50


@pytest.mark.parametrize("world", [one for one in WRONG if one.quick], ids=lambda world: world.name)
def test_a_mistake_contradicts_the_truth(world: World) -> None:
    case = make_case(world, 0)
    assert is_contradicted(case.given, case.right)


@pytest.mark.slow
@pytest.mark.parametrize("world", [one for one in WRONG if not one.quick], ids=lambda world: world.name)
def test_every_mistake_contradicts_the_truth(world: World) -> None:
    case = make_case(world, 0)
    assert is_contradicted(case.given, case.right)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, make in MAKES.items() if make.odometry_sigma is not None])
def test_an_oracle_is_as_exact_as_its_readings(name: str) -> None:
    drive = simulate(MAKES[name], 1, in_map=True)
    found = errors(solve(drive), drive)
    assert found["error_m"] < {"uwb": 0.05, "poses": 0.03, "orchard": 0.03}.get(name, 0.015)
    assert found["nees"] < 4.0


def _told(kind: ChangeKind, ids: tuple[int, ...], by_m: FloatArray, from_s: float, to_s: float) -> MapChange:
    return MapChange(ids, kind, from_s, to_s, tuple(by_m.tolist()), 0.0, 0.999)


def test_changes_are_compared_with_those_that_happened() -> None:
    case = make_case(by_name("laser in a map: one moved at half time"), 2)
    truth = true_changes(case)
    ((identity, true),) = truth.items()
    right = _told(ChangeKind.MOVED, (identity,), true.displacement_m[:2], true.at_s - 1.0, true.at_s + 0.5)
    assert compare_changes([right], truth, case) == ([], 0, True)
    early = replace(right, stamp_from_s=true.at_s - 9.0, stamp_to_s=true.at_s - 5.0)
    assert compare_changes([early], truth, case) == ([], 0, False)
    elsewhere = replace(right, displacement_m=(-right.displacement_m[0], -right.displacement_m[1]))
    assert compare_changes([elsewhere], truth, case) == ([elsewhere], 1, None)
    another = replace(right, landmark_ids=(identity, identity % 20 + 1))
    assert compare_changes([another], truth, case)[:2] == ([another], 1)
    assert compare_changes([], truth, case) == ([], 1, None)


def test_a_landmark_that_left_is_known_to_be_gone() -> None:
    case = make_case(by_name("laser in a map: two vanished before"), 0)
    truth = true_changes(case)
    assert len(truth) == 2
    assert compare_changes([], truth, case, tuple(truth)) == ([], 0, None)
    moved = _told(ChangeKind.MOVED, tuple(truth)[:1], np.ones(2), math.nan, 0.0)
    assert compare_changes([moved], truth, case)[0] == [moved]


def _row(**changes: object) -> dict[str, object]:
    return {
        "verdict": None, "exit": 0, "error_m": 0.01, "aligned_m": 0.01, "odometry_m": 0.1, "nees": 1.0, "bound_m": 0.02,
        "named_by": "cause", "false_changes": 0, "false_causes": 0, "certain_false_changes": 0, "missed_changes": 0,
        **changes,
    }  # fmt: skip


def test_a_run_is_right_or_wrong_or_wrong_in_silence() -> None:
    def of(name: str, **changes: object) -> tuple[bool, bool]:
        world = by_name(name)
        found = conclude(world, ANSWERS[world.cause], _row(**changes))
        return found["right"], found["silent"]

    size = "corners in a map: tags printed in another size"
    assert of(size) == (True, False)
    assert of(size, named_by="") == (False, False)
    assert of(size, error_m=0.05) == (False, False)
    assert of(size, error_m=0.3, aligned_m=0.3) == (False, True)
    assert of(size, certain_false_changes=1, false_changes=1) == (False, True)
    assert of(size, error_m=0.3, aligned_m=0.3, exit=3, verdict="sensor suspect") == (True, False)
    assert of(size, exit=3, verdict="map outdated") == (False, False)
    mirrored = "laser in a map: map mirrored"
    assert of(mirrored, named_by="") == (False, True)
    assert of(mirrored, exit=3, verdict="map outdated") == (True, False)
    unit = "laser alone: ranges in mm"
    assert of(unit, exit=2, error_m=None, aligned_m=None, named_by="refusal") == (True, False)
    assert of(unit, exit=1, error_m=None, aligned_m=None, named_by="refusal") == (False, False)
    assert of(unit) == (False, False)
    sound = "laser in a map: nothing wrong"
    assert of(sound, named_by="", bound_m=None) == (True, False)
    assert of(sound, named_by="", bound_m=None, exit=3, verdict="lost") == (False, False)
    assert of(sound, named_by="", bound_m=None, nees=5.0) == (False, True)


def test_of_two_causes_both_are_true_and_both_have_to_be_named() -> None:
    world = by_name("corners in a map: late, and one moved before")
    answer = find_answer(world)
    assert answer.codes == ANSWERS["delay"].codes
    assert answer.verdicts == ANSWERS["change"].verdicts | ANSWERS["delay"].verdicts
    row = judge(make_case(world, 0), None)
    assert (row["named_by"], row["false_causes"], row["right"]) == ("change", 0, True)
    assert judge(make_case(replace(world, also="mount"), 0), None)["named_by"] == ""
    one = by_name("laser in a map: map mirrored")
    assert find_answer(one) is ANSWERS[one.cause]


def test_what_is_stated_changes_what_is_given_and_not_what_was_read() -> None:
    right = simulate(MAKES["corners"], 0, in_map=False)
    wrong = mistakes.sized(1.2)(right, np.random.default_rng(0))
    assert np.array_equal(wrong.value, right.value)
    seen = [as_recording(one).detections for one in (wrong, right)]
    far, near = (np.linalg.norm(one.position_sensor_m, axis=1) for one in seen if isinstance(one, SpatialDetections))
    assert far / near == pytest.approx(1.2, rel=0.01)


def test_nothing_chosen_is_an_error() -> None:
    with pytest.raises(ConfigError, match="no part of this study: lies"):
        study.planned(study.Settings(groups=("lies",)))
    with pytest.raises(ConfigError, match="no world of this name: mars"):
        study.planned(study.Settings(worlds=("mars",)))


@pytest.mark.slow
def test_a_study_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = study.Settings(worlds=("laser alone: odometer +10%", "laser alone: sign of turning"), runs=1)
    table = study.reproduce(tmp_path / "out", settings)
    assert [row["world"] for row in table["runs"]] == [world.name for world, _ in study.planned(settings)]
    rows = tmp_path / f"out{ROWS}"
    kept = [json.loads(line) for line in rows.read_text().splitlines()]
    assert kept == table["runs"]
    rows.write_text(rows.read_text() + '{"world": "half a l')
    monkeypatch.setattr(study, "run", lambda *_: pytest.fail("it was done"))
    again = study.reproduce(tmp_path / "out", settings)
    assert again["runs"] == table["runs"]
    assert "laser alone: odometer +10%" in (tmp_path / "out" / "table.md").read_text()


def test_two_runs_are_compared(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from benchmarks import causes

    row = {
        **_row(seed=0, right=True, silent=False, causes=[], findings=[], changes=[], refusal="", cpu_s=1.0),
        "world": "a", "group": "causes", "cause": "change", "space": False, "in_map": True,
    }  # fmt: skip
    silent = {**row, "world": "b", "right": False, "silent": True}
    files = []
    for name, rows in (("before", [row, silent]), ("after", [{**row, "error_m": 0.5}, {**silent, "silent": False}])):
        files.append(str(tmp_path / name))
        Path(files[-1]).write_text("".join(f"{json.dumps(one)}\n" for one in rows))
    assert causes.main(["--compare", *files]) == 1
    said = capsys.readouterr().out
    assert "better: wrong  b, seed 0" in said
    assert "worse: right  a, seed 0: exit 0, named by cause, 0 false and 0 missing changes, 0.5 m" in said
    assert causes.main(["--compare", files[0], files[0]]) == 0
