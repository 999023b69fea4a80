"""Boxes in the frame of a sensor that drives: the same tracks as of the same boxes in the world."""

from __future__ import annotations

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from evermap.config import TrackConfig
from evermap.errors import EvermapError
from evermap.runs.track.write import write_track
from evermap.tracking.detections import read_input, read_poses
from evermap.tracking.run import run_track

BOX = "length_m,width_m,height_m,yaw_rad"
POSE = "stamp_s,x_m,y_m,z_m,qx,qy,qz,qw"
N = 30


def pose_at(k: float) -> tuple[np.ndarray, Rotation]:
    return np.array([0.8 * k, 0.02 * k * k, 0.1]), Rotation.from_euler("zyx", [0.05 * k, 0.02, -0.01])


def write(path: Path, header: str, rows: list[list[object]]) -> None:
    text = "\n".join([header, *(",".join(str(cell) for cell in row) for row in rows)]) + "\n"
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A car that drives ahead, one that parks, and frames 10 to 12 without any detection."""
    rng, sensed, world, poses = np.random.default_rng(4), [], [], []
    for k in range(N):
        place, turn = pose_at(k)
        poses.append([round(0.1 * k, 1), *place, *turn.as_quat()])
        for name, centre, yaw in (("car", [10.0 + k, 1.0, 0.8], 0.0), ("van", [15.0, -4.0, 0.9], 1.2)):
            if 10 <= k <= 12:
                continue
            at = np.array(centre) + rng.normal(0.0, 0.03, 3)
            ahead = np.arctan2(*turn.as_matrix()[1::-1, 0])
            shape = [4.0, 1.7, 1.5]
            sensed.append([round(0.1 * k, 1), name, 6.0, *turn.inv().apply(at - place), *shape, yaw - ahead])
            world.append([round(0.1 * k, 1), name, 6.0, *at, *shape, yaw])
    world += [[round(0.1 * k, 1), "", "", "", "", "", "", "", "", ""] for k in range(10, 13)]
    head = f"stamp_s,class_id,score,x_m,y_m,z_m,{BOX}"
    write(tmp_path / "detections.csv.gz", head, sensed)
    write(tmp_path / "odometry.csv.gz", POSE, poses)
    write(tmp_path / "world.csv", head, world)
    return tmp_path


def test_a_folder_in_the_sensors_frame_is_the_table_in_the_world(drive: Path) -> None:
    ours, world = read_input(drive), read_input(drive / "world.csv")
    np.testing.assert_allclose(ours.stamp_s, world.stamp_s, atol=1e-9)
    np.testing.assert_array_equal(ours.first, world.first)
    np.testing.assert_allclose(ours.position_m, world.position_m, atol=1e-9)
    assert ours.box is not None
    assert world.box is not None
    np.testing.assert_allclose(np.cos(ours.box[:, 3] - world.box[:, 3]), 1.0, atol=1e-9)
    assert ours.sensor_m is not None
    np.testing.assert_allclose(ours.sensor_m, [pose_at(k)[0] for k in range(N)], atol=1e-9)
    a, b = run_track(ours).tracks, run_track(world).tracks
    np.testing.assert_array_equal(a.track_id, b.track_id)
    np.testing.assert_allclose(a.position_m, b.position_m, atol=1e-6)
    assert len(np.unique(a.track_id)) == 2


def test_poses_between_two_are_interpolated(drive: Path) -> None:
    poses, at = read_poses(drive / "odometry.csv.gz"), np.array([0.43, 1.77])
    turn = Slerp(0.1 * np.arange(N), Rotation.concatenate([pose_at(k)[1] for k in range(N)]))
    found = poses.at(at)
    np.testing.assert_allclose((Rotation.from_quat(found[:, 3:]) * turn(at).inv()).magnitude(), 0.0, atol=1e-9)
    np.testing.assert_allclose(found[:, :3], [pose_at(10 * s)[0] for s in at], atol=0.01)


def test_fast_poses_are_no_frames(drive: Path) -> None:
    """At 100 Hz they are between the frames."""
    rows = [[0.01 * k, *pose_at(k / 10)[0], *pose_at(k / 10)[1].as_quat()] for k in range(10 * N)]
    write(drive / "odometry.csv.gz", POSE, rows)
    table = read_input(drive)
    assert table.n_frames == N - 3


def test_tracks_are_written_with_boxes_covariances_and_scores(drive: Path, tmp_path: Path) -> None:
    result = run_track(read_input(drive), TrackConfig(range_m=60.0, fov_deg=120.0))
    summary = write_track(tmp_path / "run", result)
    assert summary["counts"]["objects"] == 2
    with (tmp_path / "run" / "tracks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {"score", "length_m", "yaw_rad", "sigma_yaw_rad", "cov_xx_m2", "cov_yz_m2"} <= rows[0].keys()
    p = np.array([float(row["p_exists"]) for row in rows])
    np.testing.assert_allclose([float(row["score"]) for row in rows], np.log(p / (1.0 - p)), rtol=1e-3, atol=1e-3)
    # both are told in every frame, those too in which nothing was detected
    assert {row["stamp_s"] for row in rows} == {f"{0.1 * k:g}" for k in range(N)}
    assert len(rows) == 2 * N


def test_what_is_said_at_once_does_not_change_later(drive: Path) -> None:
    whole = run_track(read_input(drive)).tracks
    table = [row.split(",") for row in gzip.decompress((drive / "detections.csv.gz").read_bytes()).decode().split()]
    write(drive / "detections.csv.gz", ",".join(table[0]), [row for row in table[1:] if float(row[0]) <= 1.95])
    odometry = [row.split(",") for row in gzip.decompress((drive / "odometry.csv.gz").read_bytes()).decode().split()]
    write(drive / "odometry.csv.gz", POSE, [row for row in odometry[1:] if float(row[0]) <= 1.95])
    part, early = run_track(read_input(drive)).tracks, whole[whole.stamp_s <= 1.95]
    np.testing.assert_array_equal(part.track_id, early.track_id)
    np.testing.assert_allclose(part.position_m, early.position_m, rtol=1e-12)  # of the last pose the rounding differs
    np.testing.assert_allclose(part.p_exists, early.p_exists, rtol=1e-12)


@pytest.mark.parametrize(
    ("file", "text", "named"),
    [
        ("odometry.csv", None, "has no table 'odometry'"),
        ("odometry.csv", f"{POSE}\n", "has no rows below its header"),
        ("odometry.csv", f"{POSE}\n0,0,0,0,0,0,0,2\n", "is not of length one (try: a unit quaternion)"),
        ("odometry.csv", f"{POSE}\n0,0,0,0,0,0,0,1\n0,0,0,0,0,0,0,1\n", ":3: field 'stamp_s': a second pose at 0 s"),
        ("odometry.csv", f"{POSE}\n0,0,0,0,0,0,0,1\n0.1,0,0,0,0,0,0,1\n", "has no pose at 0.2 s"),
        ("odometry.csv", "stamp_s,x_m,y_m,z_m\n0,0,0,0\n", "field 'qx': missing column"),
    ],
)
def test_mistakes_in_a_folder_are_named(drive: Path, file: str, text: str | None, named: str) -> None:
    (drive / "odometry.csv.gz").unlink()
    if text is not None:
        (drive / file).write_text(text)
    with pytest.raises(EvermapError) as error:
        read_input(drive)
    assert named in error.value.one_line()


def test_a_field_of_view_wants_poses(drive: Path) -> None:
    with pytest.raises(EvermapError, match="the field of view is unknown"):
        run_track(read_input(drive), TrackConfig(fov_deg=90.0))
