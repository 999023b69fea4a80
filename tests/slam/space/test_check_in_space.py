"""What is told of recordings in space into which one mistake was put, and that honest ones raise no alarm."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from evermap import check_recording, run_localization, run_session, run_slam
from evermap.cli.main import app
from evermap.config import Config
from evermap.errors import InputError
from evermap.io import read_recording, write_native
from evermap.io.spatial import with_tag_poses
from evermap.maps.living import LivingMap
from evermap.maps.store import open_store
from evermap.types import SpatialRecording

from .corridors import tagged_corridor
from .rooms import MOUNT, Room
from .streets import street

Spoil = Callable[[SpatialRecording], SpatialRecording]


@cache
def room(seed: int = 1) -> SpatialRecording:
    return Room.of(seed).walk(seed)


@cache
def corridor(seed: int = 1) -> SpatialRecording:
    recording = tagged_corridor(seed).recording
    return replace(recording, detections=with_tag_poses(recording.detections, recording.sensors, []))


def seen(**change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    def spoil(recording: SpatialRecording) -> SpatialRecording:
        new = {name: mistake(getattr(recording.detections, name)) for name, mistake in change.items()}
        return replace(recording, detections=replace(recording.detections, **new))

    return spoil


def driven(**change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    def spoil(recording: SpatialRecording) -> SpatialRecording:
        assert recording.odometry is not None
        new = {name: mistake(getattr(recording.odometry, name)) for name, mistake in change.items()}
        return replace(recording, odometry=replace(recording.odometry, **new))

    return spoil


def scaled(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda pose: pose * np.array([factor, factor, factor, 1.0, 1.0, 1.0, 1.0])


def jumping(pose: np.ndarray) -> np.ndarray:
    """A metre, twice."""
    later = np.arange(len(pose))
    return pose + 1.0 * ((later >= 100).astype(float) + (later >= 140))[:, None] * np.eye(7)[0]


MISTAKES: dict[str, tuple[Spoil, str, str]] = {
    "positions in mm": (seen(position_sensor_m=lambda p: 1e3 * p), "length-unit", "millimetres"),
    "positions in feet": (seen(position_sensor_m=lambda p: p / 0.3048), "length-unit", "feet"),
    "tags of half their size": (
        seen(position_sensor_m=lambda p: 0.5 * p),
        "length-unit",
        r"(1\.9\d?|2(\.\d+)?) times too short",
    ),
    "odometry in mm": (driven(pose_world_robot=scaled(1e3)), "length-unit", "poses of the robot"),
    "x ahead": (seen(position_sensor_m=MOUNT.apply), "mount-axes", "x ahead and z up"),
    "zero odometry": (driven(pose_world_robot=lambda p: np.tile(p[:1], (len(p), 1))), "no-odometry", "is zero"),
    "odometry 3 s late": (driven(stamp_s=lambda t: t + 3.0), "clock", r"(2\.[6-9]|3\.[0-4]) s later"),
    "odometry 3 s early": (driven(stamp_s=lambda t: t - 3.0), "clock", r"(2\.[6-9]|3\.[0-4]) s earlier"),
}


def told(recording: SpatialRecording) -> tuple[list[str], str]:
    """Codes and messages but for what is left out."""
    found = [one for one in check_recording(recording).findings if one.code != "left-out"]
    return [one.code for one in found], " | ".join(one.message for one in found)


@pytest.mark.parametrize(("spoil", "code", "words"), MISTAKES.values(), ids=MISTAKES)
@pytest.mark.parametrize(("world", "seed"), [pytest.param(room, 1, marks=pytest.mark.slow), (corridor, 2)])
def test_one_mistake_is_told_by_its_name(
    world: Callable[[int], SpatialRecording], seed: int, spoil: Spoil, code: str, words: str
) -> None:
    codes, messages = told(spoil(world(seed)))
    assert codes == [code], messages
    assert re.search(words, messages), messages


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
def test_honest_recordings_raise_no_alarm(seed: int) -> None:
    for recording in (room(seed), corridor(seed), tagged_corridor(seed, odometry=False).recording):
        check = check_recording(recording)
        assert check.findings == ()
        assert check.usable


def test_values_that_cannot_be_are_refused_before_anything_is_estimated() -> None:
    def negative(covariance: np.ndarray) -> np.ndarray:
        return np.tile(-np.eye(3), (len(covariance), 1, 1))

    wrong = seen(covariance_sensor_m2=negative)(room())
    survey = room().true_landmarks
    assert survey is not None
    living = replace(LivingMap.begun(survey.as_prior(0.01)), clock=room().clock)
    for run in (run_slam, run_session, lambda given: run_localization(given, living)):
        with pytest.raises(InputError, match=r"'detections\.covariance_sensor_m2'"):
            run(wrong)
    twice = replace(survey.as_prior(0.01), landmark_id=np.zeros_like(survey.landmark_id))
    with pytest.raises(InputError, match=r"'prior_map\.landmark_id'"):
        run_slam(room(), prior_map=twice)


def test_localization_tells_what_a_check_tells() -> None:
    recording, living = driven(pose_world_robot=jumping)(room()), run_session(room()).living
    assert "odometry jumps 2 times" in " ".join(run_localization(recording, living).warnings)


@pytest.mark.slow
@pytest.mark.data
def test_honest_data_raise_no_alarm_and_mistakes_are_told(shared_data: Path) -> None:
    names = ["tagslam/test_11", *(f"ycbv/{name}" for name in ("0001", "0017", "0059"))]
    for name in names:
        honest = read_recording(shared_data / name)
        assert isinstance(honest, SpatialRecording)
        assert set(told(honest)[0]) <= {"odometry-jumps"}
        assert check_recording(honest).usable
    honest = read_recording(shared_data / names[0])
    assert isinstance(honest, SpatialRecording)
    for spoil, code, words in MISTAKES.values():
        codes, messages = told(spoil(honest))
        assert [one for one in codes if one != "odometry-jumps"] == [code], messages
        assert re.search(words, messages)


def test_jumps_of_the_odometry_are_told_where_they_are() -> None:
    codes, message = told(driven(pose_world_robot=jumping)(room()))
    assert codes == ["odometry-jumps"]
    assert "jumps 2 times, by up to 1" in message
    assert check_recording(driven(pose_world_robot=jumping)(room())).usable


def test_identities_that_never_come_back_are_told() -> None:
    own = seen(landmark_id=lambda ids: np.arange(len(ids)))(room())
    check = check_recording(own)
    assert [one.code for one in check.findings] == ["own-identities"]
    assert not check.usable


def test_what_cannot_be_used_is_told() -> None:
    nameless = check_recording(seen(landmark_id=lambda ids: np.where(np.arange(len(ids)) < 7, -1, ids))(room()))
    assert [one.message for one in nameless.findings] == ["7 detections without identity not used"]
    assert nameless.usable
    few = check_recording(seen(landmark_id=lambda ids: np.where(np.arange(len(ids)) < 1, ids, -1))(room()))
    assert [one.code for one in few.findings] == ["too-little"]
    assert not few.usable


def test_a_recording_without_identities_is_usable_by_geometry() -> None:
    nameless = seen(landmark_id=lambda ids: np.full_like(ids, -1))(room())
    [finding] = check_recording(nameless).findings
    assert (finding.code, finding.is_refused) == ("no-identities", True)  # `slam` asks for --unknown-ids
    assert "`unknown_ids`" in finding.message
    assert check_recording(nameless, Config(slam={"unknown_ids": True})).findings == ()


def test_cameras_and_limits_are_told() -> None:
    recording = corridor()
    blind = replace(recording, sensors=(replace(recording.sensors[0], intrinsics=None),))
    assert told(blind)[0] == ["no-calibration"]
    small = replace(recording, sensors=(replace(recording.sensors[0], resolution_px=(320, 240), range_max_m=2.0),))
    codes, messages = told(small)
    assert codes == ["beyond-range", "beyond-view"]
    assert "for another resolution" in messages


def test_boxes_without_identity_are_no_loss() -> None:
    check = check_recording(street(1).recording)
    assert check.usable
    assert "left-out" not in {one.code for one in check.findings}


def test_values_that_cannot_be_are_refused() -> None:
    with pytest.raises(InputError, match="row 5: nan"):
        check_recording(driven(stamp_s=lambda t: np.where(np.arange(len(t)) == 5, np.nan, t))(room()))


def test_the_command_tells_the_same(tmp_path: Path) -> None:
    def run(recording: SpatialRecording, *options: str) -> Any:
        write_native(recording, tmp_path / f"{len(list(tmp_path.iterdir()))}")
        return CliRunner().invoke(app, ["check", str(max(tmp_path.iterdir())), *options])

    fine = run(room())
    assert fine.exit_code == 0, fine.output
    assert "of them" in fine.stdout
    carried = run(tagged_corridor(1, odometry=False).recording, "--json", "--quick")
    assert carried.exit_code == 0
    assert json.loads(carried.stdout)["odometry"] == {}
    late = run(MISTAKES["odometry 3 s late"][0](room()))
    assert late.exit_code == 3
    assert "s later than those of the detections" in late.stderr


def test_turned_by_the_mount() -> None:
    """The rotations of `mount-axes` are those between the two conventions."""
    from evermap.slam.mistakes import AXES

    ahead = Rotation.from_quat(AXES[0].turned)
    np.testing.assert_allclose(
        ahead.apply([[1, 0, 0], [0, 1, 0], [0, 0, 1]]), [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12
    )
    np.testing.assert_allclose((ahead * Rotation.from_quat(AXES[1].turned)).magnitude(), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    "mistake",
    [
        pytest.param("x ahead", marks=pytest.mark.slow),
        "positions in mm",
        pytest.param("odometry in mm", marks=pytest.mark.slow),
    ],
)
def test_a_mistake_is_refused_by_its_name_before_anything_enters_a_map(mistake: str, tmp_path: Path) -> None:
    spoil, _, words = MISTAKES[mistake]
    write_native(spoil(room()), tmp_path / "room")
    site = tmp_path / "site.evermap"
    run = CliRunner().invoke(app, ["map", "enter", str(site), str(tmp_path / "room"), "--out", str(tmp_path / "out")])
    assert run.exit_code == 3
    assert re.search(words, run.output)
    with open_store(str(site)) as store:
        assert not len(store.load().members)
    alone = run_slam(spoil(room()))
    assert any(re.search(words, line) for line in alone.warnings)
