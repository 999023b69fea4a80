"""Native recordings in space: every form of every table, against numbers worked out in another way; and the errors."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from evermap import run_slam
from evermap.errors import DataError, EvermapError, InputError
from evermap.io import (
    read_landmarks,
    read_planar,
    read_prior_map,
    read_recording,
    read_tum,
    write_map_geojson,
    write_map_parquet,
    write_native,
    write_template,
    write_tum,
)
from evermap.io.landmarks import write_map_csv
from evermap.io.native_write import write_session
from evermap.maps.store.measured import pack_recording, unpack_recording
from evermap.types import (
    ANY_RANGE_M2,
    UNKNOWN,
    Detections,
    Frames,
    Landmarks,
    Odometry,
    Recording,
    SpatialRecording,
    landmark_id_of,
)
from evermap.valid import validate

Files = dict[str, str]

POSES = "stamp_s,x_m,y_m,z_m,qx,qy,qz,qw\n"
CAMERA = """\
[camera.left]
model = "pinhole"
intrinsics = [400.0, 410.0, 320.0, 240.0]
resolution_px = [640, 480]
baseline_m = 0.2
sigma_px = 0.5
[camera.left.mount]
x_m = 0.1
yaw_rad = 1.5707963267948966
[camera.lidar]
range_max_m = 50.0
[tags]
size_m = 0.2
[tags.sizes]
9 = 0.4
door = 0.3
"""


def read(lay_out: Callable, files: Files, **changed: str | None) -> SpatialRecording:
    """The recording of files, some of them changed (`name__csv=text`) or left out (None)."""
    given = {name: text for name, text in files.items() if changed.get(name.replace(".", "__"), text) is not None}
    given |= {name.replace("__", "."): text for name, text in changed.items() if text is not None}
    recording = read_recording(lay_out(given))
    assert isinstance(recording, SpatialRecording)
    return recording


def assert_equal(a: Any, b: Any, where: str = "recording") -> None:
    """Every array the same, bit by bit, but for where it was read from."""
    if isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b, err_msg=where)
    elif is_dataclass(a):
        for item in fields(a):
            if item.name not in ("source", "warnings", "source_line"):
                assert_equal(getattr(a, item.name), getattr(b, item.name), f"{where}.{item.name}")
    elif isinstance(a, tuple) and a and is_dataclass(a[0]):
        for number, (one, other) in enumerate(zip(a, b, strict=True)):
            assert_equal(one, other, f"{where}[{number}]")
    else:
        assert a == b, where


def test_every_column_arrives(lay_out: Callable, space: Files) -> None:
    recording = read(lay_out, space)
    assert recording.name == "hall"
    assert recording.robot == "lift 2"
    assert recording.clock == "unix"
    assert recording.warnings == ()
    turn = np.sqrt(0.5)
    assert recording.odometry is not None
    np.testing.assert_allclose(recording.odometry.pose_world_robot[2], [0.4, 0, 0.02, 0, 0, turn, turn], atol=1e-15)
    np.testing.assert_array_equal(recording.odometry.variance[0], [0.01, *[np.nan] * 4, 1e-4])
    assert np.isnan(recording.odometry.variance[1, 5])
    seen = recording.detections
    np.testing.assert_array_equal(seen.frame, [1, 1, 2])
    np.testing.assert_array_equal(seen.landmark_id, [7, landmark_id_of("door"), UNKNOWN])
    np.testing.assert_array_equal(seen.position_sensor_m, [[1, 2, 3], [0, 0, 4], [5, 1, 0.5]])
    np.testing.assert_array_equal(seen.rotation, [[np.nan] * 4, [0, 0, 0, 1], [0, 0, 1, 0]])
    np.testing.assert_allclose(seen.covariance_sensor_m2[0], 0.01 * np.eye(3))
    assert np.isnan(seen.covariance_sensor_m2[1:]).all()
    np.testing.assert_array_equal(seen.sigma_rad, [np.nan, 0.02, np.nan])
    np.testing.assert_array_equal(seen.size_m[2], [4.5, 1.8, 1.5])
    np.testing.assert_array_equal(seen.score, [np.nan, 0.9, -1.5])
    assert [recording.class_names[k] for k in seen.class_id] == ["pole", "tag", "car"]
    (sensor,) = recording.sensors
    assert sensor.mount_robot_sensor == (0.0, 0.0, 0.5, 0.0, 0.0, 1.0, 0.0)
    assert (sensor.range_max_m, sensor.sigma_m, sensor.p_detect) == (20.0, 0.05, 0.8)
    assert recording.truth is not None
    np.testing.assert_array_equal(recording.truth.pose_world_robot[1], [0.4, 0, 0, 0, 0, 0, 1])
    known = recording.true_landmarks
    assert known is not None
    assert known.rotation is not None
    assert known.rotation_covariance is not None
    assert known.size_m is not None
    np.testing.assert_array_equal(known.landmark_id, [7, landmark_id_of("door")])
    np.testing.assert_array_equal(known.position_m, [[4, 5, 6], [1, 2, 3]])
    np.testing.assert_allclose(known.covariance_m2[1], 0.01 * np.eye(3))
    np.testing.assert_allclose(known.rotation, [[np.nan] * 4, [0, turn, 0, turn]])
    np.testing.assert_allclose(known.rotation_covariance, [np.full((3, 3), np.nan), 0.04 * np.eye(3)])
    np.testing.assert_array_equal(known.size_m, [[np.nan] * 3, [0.3, 0.3, 0.0]])


def test_velocities_are_integrated(lay_out: Callable, space: Files) -> None:
    """Against the exponential of 4 x 4 matrices; a missing axis is at rest."""
    random = np.random.default_rng(5)
    stamps, twist = np.cumsum(random.uniform(0.1, 0.6, 8)).round(3), random.normal(size=(8, 5)).round(3)
    table = "stamp_s,vx_mps,vy_mps,wx_radps,wy_radps,wz_radps\n" + "".join(
        f"{stamp},{','.join(map(str, row))}\n" for stamp, row in zip(stamps, twist.tolist(), strict=True)
    )
    odometry = read(lay_out, space, odometry__csv=table).odometry
    assert odometry is not None
    pose = np.eye(4)
    for row in range(8):
        expected = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)]
        np.testing.assert_allclose(odometry.pose_world_robot[row], expected, atol=1e-12)
        if row < 7:
            (x, y, a, b, c), step = twist[row], stamps[row + 1] - stamps[row]
            pose = pose @ expm(step * np.array([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, 0], [0, 0, 0, 0]]))
    assert np.isnan(odometry.variance).all()


def test_planar_odometry_carries_a_sensor_in_space(lay_out: Callable, space: Files) -> None:
    """A wheeled robot whose camera sees tags in space."""
    table = "stamp_s,forward_mps,lateral_mps,angular_radps\n0,1,0.1,0.5\n1,1,0,0\n2,0,0,0\n"
    odometry = read(lay_out, space, odometry__csv=table).odometry
    assert odometry is not None
    step = expm(np.array([[0, -0.5, 1], [0.5, 0, 0.1], [0, 0, 0]]))
    pose = odometry.pose_world_robot[1]
    np.testing.assert_allclose(pose, [step[0, 2], step[1, 2], 0, 0, 0, np.sin(0.25), np.cos(0.25)], atol=1e-12)
    table = "stamp_s,dx_m,dy_m,dtheta_rad\n0,0,0,0\n1,0.5,0.2,0.3\n2,0,0,0\n"
    odometry = read(lay_out, space, odometry__csv=table).odometry
    assert odometry is not None
    expected = [0.5, 0.2, 0, 0, 0, np.sin(0.15), np.cos(0.15)]
    np.testing.assert_allclose(odometry.pose_world_robot[1], expected, atol=1e-12)


def test_a_camera_in_the_hand_has_no_odometry(lay_out: Callable, space: Files) -> None:
    recording = read(lay_out, space, odometry__csv=None)
    assert recording.odometry is None
    assert len(recording.detections) == 3


def test_a_box_has_a_yaw_and_no_identity(lay_out: Callable, space: Files) -> None:
    table = (
        "stamp_s,class_id,score,x_m,y_m,z_m,yaw_rad,length_m,width_m,height_m,left_px,top_px,right_px,bottom_px\n"
        "0.5,Car,8.3,13.5,4.6,-0.9,0.5417,4.7,1.8,1.9,298.3,165.2,458.2,293.4\n"
        "0.5,Cyclist,1.3,18.4,-13.7,-0.9,-2.9,1.8,0.8,1.7,,,,\n"
    )
    seen = read(lay_out, space, detections__csv=table, landmarks__csv=None).detections
    np.testing.assert_array_equal(seen.landmark_id, [UNKNOWN, UNKNOWN])
    expected = Rotation.from_euler("z", [[0.5417], [-2.9]]).as_quat(canonical=True)
    np.testing.assert_allclose(seen.rotation, expected, atol=1e-15)


def test_cameras_and_tags(lay_out: Callable, space: Files) -> None:
    """A tag of each size head on, at depth focal length x size / edge in pixels."""

    def row(stamp: float, name: str, half: float) -> str:
        ahead = [(-1, 1), (1, 1), (1, -1), (-1, -1)]  # in the image v is down: lower left, lower right, ...
        corners = ",".join(f"{320 + half * a},{240 + half * b * 1.025}" for a, b in ahead)
        return f"{stamp},left,{name},{corners}\n"

    table = "stamp_s,camera,landmark_id," + ",".join(f"{axis}{k}_px" for k in range(4) for axis in "uv") + "\n"
    table += row(0.5, "7", 20.0) + row(0.5, "9", 20.0) + row(1.0, "door", 20.0)
    given = {
        "detections__csv": table,
        "camera__toml": CAMERA,
        "frames__csv": "stamp_s,camera\n0.5,left\n0.5,lidar\n1,left\n",
    }
    recording = read(lay_out, space, **given)
    assert recording.warnings == ()
    assert [sensor.name for sensor in recording.sensors] == ["left", "lidar"]
    left, lidar = recording.sensors
    np.testing.assert_allclose(left.mount_robot_sensor, [0.1, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-15)
    assert left.resolution_px == (640, 480)
    assert (left.sigma_px, left.range_max_m) == (0.5, 20.0)  # the latter of sensor.toml
    assert lidar.intrinsics is None
    assert lidar.range_max_m == 50.0
    seen = recording.detections
    np.testing.assert_array_equal(seen.tag_size_m, [0.2, 0.4, 0.3])
    np.testing.assert_allclose(seen.position_sensor_m, [[0, 0, 2], [0, 0, 4], [0, 0, 3]], atol=1e-6)
    np.testing.assert_allclose(np.abs(seen.rotation), [[1, 0, 0, 0]] * 3, atol=1e-4)  # its z towards the camera
    np.testing.assert_array_equal(seen.corner_px[0, 0], [300.0, 260.5])
    np.testing.assert_array_equal(recording.frames.stamp_s, [0.5, 1.0])


def test_points_of_a_stereo_pair_have_a_depth_and_its_covariance(lay_out: Callable, space: Files) -> None:
    """Against the covariance of noisy pixels."""
    at = np.array([1.0, -0.5, 5.0])
    u, v = 400 * at[0] / at[2] + 320, 410 * at[1] / at[2] + 240
    far = u - 400 * 0.2 / at[2]
    table = f"stamp_s,landmark_id,sensor,u_px,v_px,u_right_px\n0.5,7,left,{u},{v},{far}\n0.5,8,left,300,200,301\n"
    recording = read(lay_out, space, detections__csv=table, camera__toml=CAMERA)
    assert len(recording.detections) == 1
    assert any("1 detection left out: no disparity" in remark for remark in recording.warnings)
    np.testing.assert_allclose(recording.detections.position_sensor_m[0], at, atol=1e-12)
    noise = 1e-3 * np.random.default_rng(6).standard_normal((20_000, 3))
    depth = 400 * 0.2 / (u + noise[:, 0] - far - noise[:, 2])
    cloud = np.column_stack([(u + noise[:, 0] - 320) / 400 * depth, (v + noise[:, 1] - 240) / 410 * depth, depth])
    expected = np.cov(cloud.T) * (0.5 / 1e-3) ** 2
    np.testing.assert_allclose(recording.detections.covariance_sensor_m2[0], expected, rtol=0.05, atol=1e-5)


def test_what_landmarks_are_like(lay_out: Callable, space: Files, tmp_path: Path, assert_same: Callable) -> None:
    head, *rows = space["detections.csv"].splitlines()
    more = [",radius_m,mask_id,descriptor_0", ",0.25,4,-1.5", ",,-1,3", ",,,"]
    space["detections.csv"] = "".join(f"{a}{b}\n" for a, b in zip([head, *rows], more, strict=True))
    recording = read_recording(lay_out(space))
    seen = recording.detections
    assert seen.feature_names == ("radius_m", "mask_id", "descriptor_0")
    np.testing.assert_array_equal(seen.features, [[0.25, 4.0, -1.5], [np.nan, -1.0, 3.0], [np.nan] * 3])
    again = read_recording(write_native(recording, tmp_path / "again"))
    np.testing.assert_array_equal(again.detections.features, seen.features)
    assert_same(unpack_recording(pack_recording(recording)).detections, seen)


def test_full_covariances(lay_out: Callable, space: Files) -> None:
    names = "cov_xx_m2,cov_xy_m2,cov_xz_m2,cov_yy_m2,cov_yz_m2,cov_zz_m2"
    table = f"stamp_s,landmark_id,x_m,y_m,z_m,{names}\n0.5,7,1,2,3,4,1,-0.5,3,0.2,2\n0.5,8,1,2,3,,,,,,\n"
    covariance = read(lay_out, space, detections__csv=table).detections.covariance_sensor_m2
    np.testing.assert_array_equal(covariance[0], [[4, 1, -0.5], [1, 3, 0.2], [-0.5, 0.2, 2]])
    assert np.isnan(covariance[1]).all()


def test_a_pixel_alone_is_a_direction(lay_out: Callable, space: Files) -> None:
    table = "stamp_s,landmark_id,sensor,u_px,v_px\n0.5,7,left,620,240\n"
    recording = read_recording(lay_out({**space, "detections.csv": table, "camera.toml": CAMERA}))
    assert isinstance(recording, SpatialRecording)
    ray, covariance = recording.detections.position_sensor_m[0], recording.detections.covariance_sensor_m2[0]
    focal, _, centre_u, centre_v = recording.sensors[0].intrinsics or (1.0, 1.0, 0.0, 0.0)
    plane = np.array([(620.0 - centre_u) / focal, (240.0 - centre_v) / focal, 1.0])
    np.testing.assert_allclose(ray, plane / np.linalg.norm(plane), atol=1e-9)
    assert ray @ covariance @ ray > ANY_RANGE_M2
    across = np.cross(ray, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    sigma_px = recording.sensors[0].sigma_px or 1.0
    np.testing.assert_allclose(np.sqrt(across @ covariance @ across), sigma_px / focal, rtol=0.02)


def test_gzipped_tables_are_read_as_they_are(lay_out: Callable, space: Files, native: Files, tmp_path: Path) -> None:
    for files in (space, native):
        packed = {
            f"{name}.gz" if name.endswith(".csv") else name: gzip.compress(text.encode())
            if name.endswith(".csv")
            else text.encode()
            for name, text in files.items()
        }
        folder, other = tmp_path / str(len(files)), tmp_path / f"{len(files)}gz"
        for where, content in ((folder, {name: text.encode() for name, text in files.items()}), (other, packed)):
            where.mkdir()
            for name, data in content.items():
                (where / name).write_bytes(data)
        assert_equal(read_recording(folder), read_recording(other))
    (other / "odometry.csv.gz").write_bytes(packed["odometry.csv.gz"][:40])
    with pytest.raises(InputError, match=r"odometry\.csv\.gz: damaged gzip file"):
        read_recording(other)
    (other / "odometry.csv").write_text(native["odometry.csv"])
    with pytest.raises(InputError, match=r"odometry\.csv: exists together with odometry\.csv\.gz"):
        read_recording(other)


def test_the_columns_decide(lay_out: Callable, native: Files) -> None:
    assert isinstance(read_recording(lay_out(native)), Recording)


def test_what_works_in_the_plane_refuses_space(lay_out: Callable, space: Files) -> None:
    with pytest.raises(InputError, match="the recording is in space"):
        read_planar(lay_out(space))


DETECTIONS = "stamp_s,landmark_id,x_m,y_m,z_m"
CORNERED = "stamp_s,landmark_id,sensor," + ",".join(f"{axis}{k}_px" for k in range(4) for axis in "uv") + "\n"
BAD: dict[str, tuple[Files, str]] = {
    "zero": ({"detections.csv": f"{DETECTIONS}\n0.5,7,0,0,0\n"}, r"detections\.csv:2: field 'x_m, y_m, z_m': 0 where"),
    "nan": (
        {"detections.csv": f"{DETECTIONS}\n0.5,7,0,nan,0\n"},
        r"detections\.csv:2: field 'y_m': nan where a finite",
    ),
    "no z": (
        {"detections.csv": "stamp_s,landmark_id,x_m,y_m\n0.5,7,1,1\n"},
        r"detections\.csv:1: field 'z_m': missing",
    ),
    "quaternion": (
        {"detections.csv": f"{DETECTIONS},qx,qy,qz,qw\n0.5,7,1,1,1,1,1,0,0\n"},
        r"detections\.csv:2: field 'qx, qy, qz, qw': is not a unit quaternion, its length is 1.41",
    ),
    "half a quaternion": (
        {"detections.csv": f"{DETECTIONS},qx,qy,qz,qw\n0.5,7,1,1,1,0,,0,1\n"},
        r"detections\.csv:2: field 'qx, qy, qz, qw': is incomplete",
    ),
    "no qw": ({"detections.csv": f"{DETECTIONS},qx,qy,qz\n0.5,7,1,1,1,0,0,0\n"}, r"field 'qw': missing column"),
    "yaw and quaternion": (
        {"detections.csv": f"{DETECTIONS},qx,qy,qz,qw,yaw_rad\n0.5,7,1,1,1,0,0,0,1,0\n"},
        r"mixes qx, qy, qz, qw with yaw_rad",
    ),
    "covariance": (
        {
            "detections.csv": f"{DETECTIONS},cov_xx_m2,cov_xy_m2,cov_xz_m2,cov_yy_m2,cov_yz_m2,cov_zz_m2\n"
            "0.5,7,1,1,1,1,2,0,1,0,1\n"
        },
        r"detections\.csv:2: field 'cov_xx_m2': is not a covariance",
    ),
    "sigma twice": (
        {"detections.csv": f"{DETECTIONS},sigma_m,cov_xx_m2,cov_xy_m2,cov_xz_m2,cov_yy_m2,cov_yz_m2,cov_zz_m2\n"},
        r"both sigma_m and cov_",
    ),
    "misspelt": ({"detections.csv": f"{DETECTIONS},sigma_mm\n0.5,7,1,1,1,1\n"}, r"field 'sigma_mm': unknown column"),
    "box": ({"detections.csv": f"{DETECTIONS},length_m\n0.5,7,1,1,1,1\n"}, r"field 'width_m': missing column"),
    "flat box": (
        {"detections.csv": f"{DETECTIONS},length_m,width_m,height_m\n0.5,7,1,1,1,4,0,1\n"},
        r"detections\.csv:2: field 'width_m': 0 where a number greater than zero",
    ),
    "unknown sensor": (
        {"detections.csv": f"{DETECTIONS},sensor\n0.5,7,1,1,1,right\n", "camera.toml": CAMERA},
        r"detections\.csv:2: field 'sensor': no sensor 'right'.*one of left, lidar",
    ),
    "name its sensor": (
        {"detections.csv": f"{DETECTIONS}\n0.5,7,1,1,1\n", "camera.toml": CAMERA},
        r"detections\.csv:1: field 'sensor': does not name its sensor",
    ),
    "sensor and camera": (
        {"detections.csv": f"{DETECTIONS},sensor,camera\n0.5,7,1,1,1,a,b\n", "camera.toml": CAMERA},
        r"sensor and camera are both given",
    ),
    "pixels of a lidar": (
        {
            "detections.csv": "stamp_s,landmark_id,sensor,u_px,v_px,u_right_px\n0.5,7,lidar,1,1,0\n",
            "camera.toml": CAMERA,
        },
        r"detections\.csv:2: field 'u_px': pixels of a sensor without intrinsics \(lidar\)",
    ),
    "no baseline": (
        {
            "detections.csv": "stamp_s,landmark_id,sensor,u_px,v_px,u_right_px\n0.5,7,left,1,1,0\n",
            "camera.toml": CAMERA.replace("baseline_m = 0.2\n", ""),
        },
        r"detections\.csv:2: field 'u_right_px': the baseline is unknown.*baseline_m",
    ),
    "seven corners": (
        {"detections.csv": f"{CORNERED}0.5,7,left,1,1,2,1,2,2,1,\n", "camera.toml": CAMERA},
        r"detections\.csv:2: field 'u0_px': a tag has four corners",
    ),
    "corners without a camera": (
        {"detections.csv": f"{CORNERED}0.5,7,sensor,1,1,2,1,2,2,1,2\n"},
        r"detections\.csv:2: field 'u0_px': pixels of a sensor without intrinsics.*camera\.toml",
    ),
    "unknown size": (
        {
            "detections.csv": f"{CORNERED}0.5,7,left,1,2,2,2,2,1,1,1\n",
            "camera.toml": CAMERA.split("[tags]", maxsplit=1)[0],
        },
        r"detections\.csv:2: field 'tag_size_m': the size of this tag is unknown.*\[tags\]",
    ),
    "odometry": ({"odometry.csv": POSES + "0,0,0,0,0,0,0,0\n"}, r"odometry\.csv:2: .*not a unit quaternion"),
    "two odometries": (
        {"odometry.csv": POSES.replace("\n", ",vx_mps\n") + "0,0,0,0,0,0,0,1,1\n"},
        r"odometry\.csv:1: mixes",
    ),
    "negative variance": (
        {"odometry.csv": POSES.replace("\n", ",var_x_m2\n") + "0,0,0,0,0,0,0,1,-1\n"},
        r"odometry\.csv:2: field 'var_x_m2': -1 is outside",
    ),
    "flat truth": ({"truth.csv": "stamp_s,x_m,y_m,theta_rad\n0,0,0,0\n"}, r"truth\.csv:1: field 'theta_rad': unknown"),
    "flat landmarks": (
        {"landmarks.csv": "landmark_id,x_m,y_m\n7,1,1\n"},
        r"landmarks\.csv:1: field 'z_m': missing column",
    ),
    "backwards": ({"frames.csv": "stamp_s\n1\n0.5\n"}, r"frames\.csv:3: .*time runs backwards"),
    "no frame": ({"frames.csv": "stamp_s\n0\n"}, r"detections\.csv:2: .*have no row in frames\.csv"),
    "model": (
        {"camera.toml": CAMERA.replace("pinhole", "fisheye")},
        r"camera\.toml:2: field 'camera\.left\.model': unknown camera model 'fisheye'",
    ),
    "coefficients": (
        {"camera.toml": CAMERA.replace('"pinhole"', '"equidistant"\ndistortion = [0.1]')},
        r"camera\.toml:3: field 'camera\.left\.distortion': must be a list of 0 or 4 numbers",
    ),
    "focal length": (
        {"camera.toml": CAMERA.replace("400.0", "0.0")},
        r"camera\.toml:3: field 'camera\.left\.intrinsics': focal lengths must be positive",
    ),
    "distortion without a lens": (
        {"camera.toml": CAMERA.replace("[camera.lidar]", "[camera.lidar]\ndistortion = [0.1]")},
        r"field 'camera\.lidar\.distortion': needs intrinsics",
    ),
    "no camera": ({"camera.toml": "[tags]\nsize_m = 0.2\n"}, r"field 'camera': there is no camera"),
    "misspelt key": (
        {"camera.toml": CAMERA.replace("sigma_px", "sigma_pix")},
        r"camera\.toml:6: field 'camera\.left\.sigma_pix': unknown key \(try: sigma_px\)",
    ),
    "mount": (
        {"camera.toml": CAMERA.replace("yaw_rad", "qz")},
        r"field 'camera\.left\.mount\.qx': an orientation is all of",
    ),
    "tag size": ({"camera.toml": CAMERA.replace("9 = 0.4", "9 = -1")}, r"field 'tags\.sizes\.9': -1 is outside"),
    "planar sensor": (
        {"sensor.toml": "[limits]\nbearing_max_rad = 1.0\n"},
        r"sensor\.toml:2: field 'limits\.bearing_max_rad': is not used in space \(try: the field of view",
    ),
    "symmetry": (
        {"sensor.toml": '[symmetries]\ncan = "axis:z"\nbox = ["180:z", "50:x"]\n'},
        r"sensor\.toml:3: field 'symmetries\.box': '50:x': 50 degrees are not an integer fraction .*\(try: axis:z",
    ),
    "kind of symmetry": (
        {"sensor.toml": "[symmetries]\ncan = 180\n"},
        r"sensor\.toml:2: field 'symmetries\.can': must be a text, or a list of texts \(try: axis:z",
    ),
    "symmetry of no class": (
        {"sensor.toml": '[recording]\nclass_names = ["can", "box"]\n\n[symmetries]\ncna = "axis:z"\n'},
        r"sensor\.toml:5: field 'symmetries\.cna': not one of class_names \(try: can\)",
    ),
    "symmetries": ({"sensor.toml": "symmetries = 3\n"}, r"field 'symmetries': must be a section"),
    "not toml": ({"camera.toml": "[camera.left\n"}, r"camera\.toml: not valid TOML"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_recordings_are_refused(name: str, lay_out: Callable, space: Files) -> None:
    files, message = BAD[name]
    with pytest.raises(EvermapError, match=message):
        read_recording(lay_out({**space, **files}))


def test_nothing_seen(lay_out: Callable, space: Files) -> None:
    with pytest.raises(DataError, match="no landmark was seen"):
        read_recording(lay_out({**space, "detections.csv": f"{DETECTIONS}\n"}))


@pytest.mark.parametrize("kind", ["csv", "parquet"])
@pytest.mark.parametrize("made", ["space", "template", "tagslam", "ycbv"])
def test_written_and_read_again(
    kind: Any, made: str, request: pytest.FixtureRequest, lay_out: Callable, tmp_path: Path
) -> None:
    if made == "template":
        first = read_recording(write_template(tmp_path / "template", in_space=True))
    else:
        first = read_recording(lay_out(request.getfixturevalue(made)))
    again = read_recording(write_native(first, tmp_path / "again", kind))
    assert_equal(first, again)


def test_a_condensed_session_has_the_poses_around_frames(tmp_path: Path) -> None:
    first = read_recording(write_template(tmp_path / "template", in_space=True))
    again = read_recording(write_session(first, tmp_path / "session.zip"))
    assert isinstance(first, SpatialRecording)
    assert isinstance(again, SpatialRecording)
    assert first.odometry is not None
    assert again.odometry is not None
    rows = np.searchsorted(first.odometry.stamp_s, again.odometry.stamp_s)
    np.testing.assert_allclose(again.odometry.pose_world_robot, first.odometry.pose_world_robot[rows], atol=1e-6)
    after = np.searchsorted(first.odometry.stamp_s, first.frames.stamp_s, side="right")
    assert np.isin([*(after - 1), *np.minimum(after, len(first.odometry) - 1)], rows).all()
    np.testing.assert_allclose(again.detections.corner_px, first.detections.corner_px, atol=1e-3)
    assert again.truth is None


def test_symmetries_of_classes(lay_out: Callable, space: Files, tmp_path: Path) -> None:
    table = f"{DETECTIONS},class_id\n0.5,7,1,1,1,can\n1,8,1,1,1,the box\n"
    said = '[symmetries]\ncan = "axis:z"\n"the box" = ["180:z", "180:x"]\nspoon = "any"\n'
    recording = read(lay_out, space, detections__csv=table, sensor__toml=said)
    expected = {"can": ("axis:z",), "the box": ("180:z", "180:x"), "spoon": ("any",)}
    assert recording.symmetries == expected
    assert any("symmetries of unused classes: spoon" in warning for warning in recording.warnings)
    write_native(recording, tmp_path / "again")
    del expected["spoon"]
    assert read_recording(tmp_path / "again").symmetries == expected


def test_sensors_with_odd_names_and_mounts(lay_out: Callable, space: Files, tmp_path: Path) -> None:
    """Roll, pitch and yaw are turned about the axes of the robot, one after the other, as scipy's 'xyz'."""
    camera = '[camera."on the left"]\nintrinsics = [1, 1, 0, 0]\n[camera."on the left".mount]\nroll_rad = 0.1\n'
    camera += "pitch_rad = 0.2\nyaw_rad = 0.3\n"
    first = read(lay_out, space, camera__toml=camera)
    expected = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_quat(canonical=True)
    np.testing.assert_allclose(first.sensors[0].mount_robot_sensor[3:], expected, atol=1e-15)
    again = read_recording(write_native(first, tmp_path / "again"))
    assert_equal(first, again)


def in_space() -> Landmarks:
    random = np.random.default_rng(8)
    root = random.normal(size=(2, 3, 3, 3))
    position, turn = root @ np.swapaxes(root, 2, 3)
    turn[1] = np.nan
    rotation = Rotation.random(3, random_state=1).as_quat(canonical=True)
    rotation[1] = np.nan
    landmarks = Landmarks.in_space(
        [3, 5, landmark_id_of("door")],
        random.normal(size=(3, 3)),
        rotation=rotation,
        size_m=[[1, 2, 3], [np.nan] * 3, [0.2, 0.2, 0]],
        names={landmark_id_of("door"): "door"},
    )
    landmarks.covariance_m2[:] = (position + np.swapaxes(position, 1, 2)) / 2
    assert landmarks.rotation_covariance is not None
    landmarks.rotation_covariance[:] = (turn + np.swapaxes(turn, 1, 2)) / 2
    return landmarks


@pytest.mark.parametrize("write", [write_map_parquet, write_map_geojson, write_map_csv])
def test_maps_in_space_are_read_as_written(write: Callable, tmp_path: Path) -> None:
    ending = write.__name__.rpartition("_")[2]
    landmarks = in_space()
    path = write(landmarks, tmp_path / f"map.{ending}")
    assert_equal(landmarks, read_landmarks(path))
    prior = read_prior_map(path)
    assert prior.frame == "prior_map"
    np.testing.assert_array_equal(prior.covariance_m2, landmarks.covariance_m2)


def test_maps_in_space_may_say_less(tmp_path: Path) -> None:
    path = tmp_path / "map.csv"
    path.write_text("landmark_id,x_m,y_m,z_m\n7,1,2,3\n")
    prior = read_prior_map(path, sigma_m=0.1)
    np.testing.assert_allclose(prior.covariance_m2, [0.01 * np.eye(3)])
    assert prior.rotation is None
    assert prior.size_m is None
    path.write_text("landmark_id,x_m,y_m,qx,qy,qz,qw\n7,1,2,0,0,0,1\n")
    with pytest.raises(InputError, match=r"map\.csv:1: field 'qx': unknown column"):
        read_prior_map(path)


def test_maps_may_be_gzipped(lay_out: Callable, space: Files, tmp_path: Path) -> None:
    folder = lay_out(space)
    table = folder / "landmarks.csv"
    plain = read_landmarks(table)
    (folder / "landmarks.csv.gz").write_bytes(gzip.compress(table.read_bytes()))
    table.unlink()
    assert_equal(plain, read_landmarks(folder))


NOWHERE = np.full((3, 3), np.nan)
WRONG: dict[str, tuple[str, dict[str, Any], str]] = {
    "position": ("detections", {"position_sensor_m": NOWHERE}, "detections.position_sensor_m.*has no position"),
    "rotation": ("detections", {"rotation": np.ones((3, 4))}, "detections.rotation.*not a unit quaternion"),
    "sensor": ("detections", {"sensor": np.array([0, 1, 0])}, "detections.sensor.*row 1: 1 is not one of 1 sensors"),
    "frame": ("detections", {"frame": np.array([0, 1, 9])}, "detections.frame.*row 2: 9 is not a row of 4 frames"),
    "id": ("detections", {"landmark_id": np.array([0, -2, 1])}, "detections.landmark_id.*row 1: -2"),
    "covariance": ("detections", {"covariance_sensor_m2": -np.stack([np.eye(3)] * 3)}, "covariance_sensor_m2"),
    "sigma": ("detections", {"sigma_rad": np.array([0.1, 0.0, np.nan])}, "detections.sigma_rad.*row 1"),
    "tag": ("detections", {"tag_size_m": np.array([np.nan, -1.0, np.nan])}, "detections.tag_size_m.*row 1"),
    "box": ("detections", {"size_m": np.zeros((3, 3))}, "detections.size_m.*is not positive"),
    "odometry": ("odometry", {"pose_world_robot": np.zeros((5, 7))}, "odometry.pose_world_robot.*unit quaternion"),
    "variance": ("odometry", {"variance": -np.ones((5, 6))}, "odometry.variance.*is negative"),
    "stamps": ("frames", {"stamp_s": np.zeros(4)}, "frames.stamp_s.*row 1: repeats"),
    "truth": ("truth", {"pose_world_robot": np.full((2, 7), np.inf)}, "truth.pose_world_robot.*inf"),
    "landmarks": ("true_landmarks", {"covariance_m2": -np.stack([np.eye(3)] * 2)}, "true_landmarks.covariance_m2"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_arrays_are_named(name: str, lay_out: Callable, space: Files) -> None:
    part, changed, message = WRONG[name]
    recording = read(lay_out, space)
    validate(recording)
    wrong = replace(recording, **{part: replace(getattr(recording, part), **changed)})
    with pytest.raises(InputError, match=message):
        validate(wrong)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"mount_robot_sensor": (0.0, 0.0, 0.0)}, "is not a pose"),
        ({"intrinsics": (-1.0, 1.0, 0.0, 0.0)}, "are not focal lengths"),
        ({"distortion_model": "cubic"}, "no camera model 'cubic'"),
        ({"distortion_model": "radtan", "distortion": (0.1,)}, "needs 4 or 5 coefficients, not 1"),
        ({"range_min_m": 30.0}, "is not below range_max_m"),
        ({"sigma_px": 0.0}, "is not a standard deviation"),
        ({"p_detect": 1.5}, "is not a probability"),
    ],
)
def test_wrong_sensors_are_named(changed: dict[str, Any], message: str, lay_out: Callable, space: Files) -> None:
    recording = read(lay_out, space)
    wrong = replace(recording, sensors=(replace(recording.sensors[0], **changed),))
    with pytest.raises(InputError, match=message):
        validate(wrong)


def test_what_else_is_no_recording(lay_out: Callable, native: Files, tmp_path: Path) -> None:
    planar, spatial = read_recording(lay_out(native)), read_recording(write_template(tmp_path / "there", in_space=True))
    assert (planar.dim, spatial.dim) == (2, 3)
    with pytest.raises(InputError, match="Odometry and SpatialDetections do not go together"):
        validate(replace(spatial, odometry=planar.odometry))
    with pytest.raises(InputError, match="NoneType and Detections do not go together"):
        validate(replace(planar, odometry=None))
    for wrong in (replace(spatial, sensors=()), replace(planar, sensors=spatial.sensors)):
        with pytest.raises(InputError, match=r"'sensors': \d sensors? in space with"):
            validate(wrong)
    with pytest.raises(InputError, match="a Recording is needed, not str"):
        run_slam("recording")  # type: ignore[arg-type]


def test_the_old_name_of_a_recording_in_space_makes_and_recognises_one(tmp_path: Path) -> None:
    given = read_recording(write_template(tmp_path / "there", in_space=True))
    parts = given.name, given.odometry, given.frames, given.detections, given.sensors, given.truth
    made = SpatialRecording(*parts, symmetries={"box": ("full z",)})
    assert isinstance(made, Recording)
    assert isinstance(made, SpatialRecording)
    names = ("name", "odometry", "frames", "detections", "sensors", "truth")
    assert all(getattr(made, name) is part for name, part in zip(names, parts, strict=True))
    assert made.symmetries == {"box": ("full z",)}
    flat = Recording("", Odometry([], [], [], []), Frames([]), Detections([], [], [], [], [], [], [], []))
    assert not isinstance(flat, SpatialRecording)


def test_trajectories_in_space(lay_out: Callable, space: Files, tmp_path: Path) -> None:
    recording = read_recording(write_template(tmp_path / "template", in_space=True))
    assert recording.truth is not None
    path = write_tum(recording.truth, tmp_path / "truth.tum")
    assert_equal(recording.truth, read_tum(path, in_space=True))
    assert len(path.read_text().splitlines()[0].split()) == 8
    flat = read_tum(path)
    heading = Rotation.from_quat(recording.truth.pose_world_robot[:, 3:]).as_euler("ZYX")[:, 0]
    np.testing.assert_allclose(flat.pose_world_robot[:, 2], heading, atol=1e-12)
