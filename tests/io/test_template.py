"""The template is a recording as it is, and one that a robot can be localised with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from evermap.errors import InputError
from evermap.io import read_landmarks, read_recording, write_template
from evermap.types import Recording, SpatialRecording


def test_the_template_reads_without_remarks(tmp_path: Path, check_recording: Callable) -> None:
    recording = read_recording(write_template(tmp_path / "mine"))
    check_recording(recording)
    assert recording.warnings == ()
    assert recording.sensor.mount_robot_sensor == (0.2, 0.0, 0.0)
    assert recording.class_names == ("cart", "door", "pillar")
    assert 59.9 < recording.odometry.stamp_s[-1] < 60.1
    assert len(np.unique(recording.detections.landmark_id)) == 6


def test_the_template_is_the_same_every_time_and_commented(tmp_path: Path) -> None:
    one, other = write_template(tmp_path / "one"), write_template(tmp_path / "other")
    names = sorted(path.name for path in one.iterdir())
    tables = ["detections.csv", "frames.csv", "landmarks.csv", "odometry.csv", "survey.csv", "truth.csv"]
    assert names == sorted([*tables, "sensor.toml"])
    for name in names:
        assert (one / name).read_bytes() == (other / name).read_bytes()
        assert (one / name).read_text().startswith("# ")
    with pytest.raises(InputError, match="not empty"):
        write_template(one)


def wrapped(angle: np.ndarray) -> np.ndarray:
    return np.angle(np.exp(1j * angle))


def dead_reckoning(recording: Recording) -> np.ndarray:
    """Odometry in steps of 1 ms; poses at the frames."""
    odometry, frames = recording.odometry, recording.frames.stamp_s
    fine = np.arange(0.0, frames[-1], 0.001)
    row = np.searchsorted(odometry.stamp_s, fine + 1e-9) - 1
    heading = np.concatenate([[0.0], np.cumsum(odometry.angular_radps[row] * 0.001)])
    step = odometry.forward_mps[row] * 0.001
    x = np.concatenate([[0.0], np.cumsum(step * np.cos(heading[:-1]))])
    y = np.concatenate([[0.0], np.cumsum(step * np.sin(heading[:-1]))])
    at = np.round(frames / 0.001).astype(int)
    return np.stack([x[at], y[at], heading[at]], axis=1)


def test_the_template_localises(tmp_path: Path) -> None:
    """A least squares solution without any code of ours is closer to the truth than odometry, and so is its map.

    The odometry is off by a scale of its speed and one of its turn rate, as those of robots are: it alone is lost.
    """
    recording = read_recording(write_template(tmp_path / "mine"))
    seen, start = recording.detections, dead_reckoning(recording)
    count, landmark = len(start), seen.landmark_id - 1
    mount_x = recording.sensor.mount_robot_sensor[0]
    turn = np.diff(start[:, 2])
    cos, sin = np.cos(start[:-1, 2]), np.sin(start[:-1, 2])
    dx, dy = np.diff(start[:, 0]), np.diff(start[:, 1])
    ahead, left = cos * dx + sin * dy, -sin * dx + cos * dy

    def residuals(state: np.ndarray) -> np.ndarray:
        pose = np.vstack([np.zeros(3), state[: 3 * count - 3].reshape(-1, 3)])
        position, (of_speed, of_turn) = state[3 * count - 3 : -2].reshape(-1, 2), state[-2:]
        cos, sin = np.cos(pose[:-1, 2]), np.sin(pose[:-1, 2])
        dx, dy = np.diff(pose[:, 0]), np.diff(pose[:, 1])
        motion = [
            cos * dx + sin * dy - of_speed * ahead,
            -sin * dx + cos * dy - of_speed * left,
            wrapped(np.diff(pose[:, 2]) - of_turn * turn),
        ]
        at = pose[seen.frame]
        offset = position[landmark] - at[:, :2] - mount_x * np.stack([np.cos(at[:, 2]), np.sin(at[:, 2])], axis=1)
        range_error = np.hypot(offset[:, 0], offset[:, 1]) - seen.range_m
        bearing_error = wrapped(np.arctan2(offset[:, 1], offset[:, 0]) - at[:, 2] - seen.bearing_rad)
        return np.concatenate([np.concatenate(motion) / 0.02, range_error / 0.03, bearing_error / 0.02])

    first = [int(np.argmax(landmark == number)) for number in range(6)]
    at, angle = start[seen.frame[first]], start[seen.frame[first], 2] + seen.bearing_rad[first]
    guess = at[:, :2] + seen.range_m[first, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    solution = least_squares(residuals, np.concatenate([start[1:].ravel(), guess.ravel(), [1.0, 1.0]]), method="lm").x
    pose = np.vstack([np.zeros(3), solution[: 3 * count - 3].reshape(-1, 3)])

    assert recording.truth is not None
    assert recording.true_landmarks is not None
    rows = np.searchsorted(recording.frames.stamp_s, recording.truth.stamp_s)
    truth = recording.truth.pose_world_robot[:, :2]
    error = np.sqrt(np.mean(np.sum((pose[rows, :2] - truth) ** 2, axis=1)))
    odometry_error = np.sqrt(np.mean(np.sum((start[rows, :2] - truth) ** 2, axis=1)))
    map_error = np.abs(solution[3 * count - 3 : -2].reshape(-1, 2) - recording.true_landmarks.position_m).max()
    assert error < 0.05
    assert odometry_error > 10.0 * error
    assert solution[-2:] == pytest.approx([1.0 / 1.02, 1.0 / 0.97], abs=0.01)
    assert map_error < 0.1


def test_in_the_survey_of_the_template_a_cart_is_not_where_it_was(tmp_path: Path) -> None:
    folder = write_template(tmp_path / "mine")
    before, now = read_landmarks(folder / "survey.csv"), read_recording(folder).true_landmarks
    assert now is not None
    away = np.hypot(*(now.position_m - before.position_m).T)
    assert away == pytest.approx([0.0, 0.0, 0.0, np.hypot(0.3, 1.1), 0.0, 0.0])


def test_the_template_in_space_is_commented_and_reads_without_remarks(tmp_path: Path) -> None:
    one, other = (write_template(tmp_path / name, in_space=True) for name in ("one", "other"))
    names = sorted(path.name for path in one.iterdir())
    tables = ["detections.csv", "frames.csv", "landmarks.csv", "odometry.csv", "truth.csv"]
    assert names == sorted([*tables, "camera.toml", "sensor.toml"])
    for name in names:
        assert (one / name).read_bytes() == (other / name).read_bytes()
        assert (one / name).read_text().startswith("# ")
    recording = read_recording(one)
    assert isinstance(recording, SpatialRecording)
    assert recording.warnings == ()
    assert recording.odometry is not None
    assert recording.frames.stamp_s[-1] == 20.0
    assert len(np.unique(recording.detections.landmark_id)) == 12


def test_tags_of_the_template_in_space_are_where_the_truth_says(tmp_path: Path) -> None:
    """Rotations by scipy: the first pose is the origin, tags are seen within centimetres, odometry drifts."""
    recording = read_recording(write_template(tmp_path / "mine", in_space=True))
    assert isinstance(recording, SpatialRecording)
    seen, truth, known = recording.detections, recording.truth, recording.true_landmarks
    assert truth is not None
    assert known is not None
    assert known.rotation is not None
    assert recording.odometry is not None
    np.testing.assert_array_equal(truth.pose_world_robot[0], [0, 0, 0, 0, 0, 0, 1])
    stamp_s = recording.frames.stamp_s[seen.frame]
    both = np.isin(stamp_s, truth.stamp_s)
    robot = truth.pose_world_robot[np.searchsorted(truth.stamp_s, stamp_s[both])]
    turn, mount = Rotation.from_quat(robot[:, 3:]), recording.sensors[0].mount_robot_sensor
    camera = turn * Rotation.from_quat(mount[3:])
    at = robot[:, :3] + turn.apply(mount[:3]) + camera.apply(seen.position_sensor_m[both])
    tag = seen.landmark_id[both]
    assert np.median(np.linalg.norm(at - known.position_m[tag], axis=1)) < 0.03
    facing = camera * Rotation.from_quat(seen.rotation[both])
    assert np.median((Rotation.from_quat(known.rotation[tag]).inv() * facing).magnitude()) < 0.08
    end = recording.odometry.pose_world_robot[-1] - truth.pose_world_robot[-1]
    assert 0.05 < np.linalg.norm(end[:3]) < 1.0


@pytest.mark.parametrize("in_space", [False, True])
def test_the_commented_kind_and_data_sheet_can_be_uncommented(in_space: bool, tmp_path: Path) -> None:
    path = write_template(tmp_path / "made", in_space=in_space) / "sensor.toml"
    text = path.read_text("utf-8")
    sheet = text[text.index("# [sensor]") :].split("# [symmetries]")[0]
    path.write_text(text.replace(sheet, sheet.replace("# ", "", 1).replace("\n# ", "\n")), encoding="utf-8")
    recording = read_recording(path.parent)
    sensor = recording.sensors[0] if isinstance(recording, SpatialRecording) else recording.sensor
    assert sensor.kind is not None
    assert sensor.sigma_odometer_scale == 0.01
    assert [name for name in ("sigma_scale", "sigma_angle_rad", "sigma_position_m") if not getattr(sensor, name)] == []
