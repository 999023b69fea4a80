"""Small recordings made here, so that the tests need nobody's data."""

from __future__ import annotations

import sys
import zipfile
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evermap.types import Recording

sys.path.insert(0, str(Path(__file__).parent))

Files = dict[str, str]

_COMMENT = "# UTIAS Multi-Robot Cooperative Localization and Mapping Dataset\n# made up for a test\n"


@pytest.fixture
def mrclam() -> Files:
    """Two robots, three landmarks, a stranger's barcode, two landmarks in one frame, a sighting of the other robot."""
    odometry = "".join(f"{1000 + 0.1 * i:.3f} \t  0.100 \t {0.01 * (i % 5):6.3f} \n" for i in range(50))
    truth = "".join(f"{1001 + 0.01 * i:.3f} \t {0.01 * i:.8f} \t -0.50000000 \t 3.10000000 \n" for i in range(100))
    return {
        "Barcodes.dat": _COMMENT + "  1 \t  5 \n  2 \t 14 \n  6 \t 63 \n  7 \t 25 \n  8 \t  7 \n",
        "Landmark_Groundtruth.dat": _COMMENT
        + "  6 \t 1.0 \t -2.0 \t 0.0001 \t 0.0002 \n  7 \t 3.0 \t 0.5 \t 0.0003 \t 0.0004 \n"
        + "  8 \t -1.0 \t 2.5 \t 0.0005 \t 0.0006 \n",
        "Robot1_Odometry.dat": _COMMENT + odometry,
        "Robot1_Measurement.dat": _COMMENT
        + "1000.500 \t 63 \t 2.100 \t -0.250 \n1000.500 \t 25 \t 3.000 \t 0.100 \n"
        + "1001.250 \t 14 \t 1.500 \t 0.300 \n1002.000 \t 99 \t 4.000 \t 0.000 \n"
        + "1002.000 \t  7 \t 4.200 \t 0.010 \n1003.125 \t 63 \t 1.900 \t -0.400 \n",
        "Robot1_Groundtruth.dat": _COMMENT + truth,
        "Robot2_Odometry.dat": _COMMENT + odometry,
        "Robot2_Measurement.dat": _COMMENT + "1001.000 \t 7 \t 2.000 \t 0.000 \n",
        "Robot3_Measurement.dat": _COMMENT + "1001.000 \t 7 \t 2.000 \t 0.000 \n",
    }


@pytest.fixture
def native() -> Files:
    """Every native file, with every optional column of the polar form."""
    return {
        "odometry.csv": "stamp_s,forward_mps,lateral_mps,angular_radps\n"
        + "".join(f"{0.1 * i:.1f},0.5,0.01,{0.02 * (i % 3)}\n" for i in range(40)),
        "detections.csv": "# seen by a laser\n"
        "stamp_s,landmark_id,range_m,bearing_rad,class_id,sigma_range_m,sigma_bearing_rad\n"
        "0.5,7,2.5,-0.3,door,0.02,0.01\n0.5,8,3.5,0.3,,,\n1.0,,1.5,0.2,pillar,,\n2.0,7,1.9,-0.5,door,0.03,\n",
        "frames.csv": "stamp_s\n0.0\n0.5\n1.0\n1.5\n2.0\n2.5\n",
        "truth.csv": "stamp_s,x_m,y_m,theta_rad\n0,0,0,0\n1,0.5,0,0.02\n2,1,0.02,7\n",
        "landmarks.csv": "landmark_id,x_m,y_m,sigma_m,class_id\n8,3.3,1.0,0.01,\n7,2.4,-0.7,,door\n",
        "robot_sightings.csv": "stamp_s,robot_id,range_m,bearing_rad\n1.5,2,3.0,0.1\n",
        "sensor.toml": '[recording]\nname = "hall"\nclock = "unix"\n\n[limits]\nrange_min_m = 0.1\nrange_max_m = 8\n'
        "bearing_min_rad = -2.0\nbearing_max_rad = 2.0\n\n[noise]\nsigma_range_m = 0.02\nsigma_bearing_rad = 0.01\n\n"
        "[mount]\nx_m = 0.2\ny_m = -0.05\ntheta_rad = 0.1\n\n[detection]\np_detect = 0.8\np_false = 0.002\n",
    }


@pytest.fixture
def space() -> Files:
    """Poses as odometry, a point, a tag with an orientation and a box, truth and landmarks."""
    turn = np.sqrt(0.5)
    return {
        "odometry.csv": "stamp_s,x_m,y_m,z_m,qx,qy,qz,qw,var_x_m2,var_rz_rad2\n"
        + "".join(
            f"{0.5 * i},{0.2 * i},0,{0.01 * i},0,0,{-turn},{-turn},0.01,{'' if i else '1e-4'}\n" for i in range(5)
        ),
        "detections.csv": "stamp_s,landmark_id,x_m,y_m,z_m,qx,qy,qz,qw,sigma_m,sigma_rad,class_id,score,"
        "length_m,width_m,height_m\n"
        "0.5,7,1,2,3,,,,,0.1,,pole,,,,\n0.5,door,0,0,4,0,0,0,2.001e0,,0.02,tag,0.9,,,\n".replace("2.001e0", "1.001")
        + "1.0,,5,1,0.5,0,0,1,0,,,car,-1.5,4.5,1.8,1.5\n",
        "frames.csv": "stamp_s\n0\n0.5\n1\n1.5\n",
        "truth.csv": "stamp_s,x_m,y_m,z_m,qx,qy,qz,qw\n" + "0,0,0,0,0,0,0,1\n1,0.4,0,0,0,0,0,-1\n",
        "landmarks.csv": "landmark_id,x_m,y_m,z_m,qx,qy,qz,qw,sigma_m,sigma_rad,tag_size_m,class_id\n"
        f"door,1,2,3,0,{turn},0,{turn},0.1,0.2,0.3,tag\n7,4,5,6,,,,,,,,pole\n",
        "sensor.toml": '[recording]\nname = "hall"\nrobot = "lift 2"\nclock = "unix"\n[limits]\nrange_max_m = 20\n'
        "[noise]\nsigma_m = 0.05\n[mount]\nz_m = 0.5\nqx = 0.0\nqy = 0.0\nqz = 1.0\nqw = 0.0\n"
        "[detection]\np_detect = 0.8\n",
    }


@pytest.fixture
def tagslam() -> Files:
    """Two cameras side by side, which see a tag head on, 2 m ahead; odometry, reference and survey."""
    pose = "1.0,2.0,0.5,0,0,0,1"
    corners = {"cam0": "370,290,430,290,430,230,370,230", "cam1": "330,290,390,290,390,230,330,230"}
    mount = (
        "{0}:\n  pose:\n    position: # in the rig\n      x: {1}\n      y: 0\n      z: 0\n"
        "    rotation:\n      x: 0.0\n      y: 0.0\n      z: 0.0\n"
    )
    camera = (
        "{0}:\n  camera_model: pinhole\n  intrinsics: [400.0, 400.0, 320, 240]\n  distortion_model: radtan\n"
        "  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n  resolution: [640, 480]\n  tagtopic: /{0}/tags\n"
    )
    return {
        "cameras.yaml": "".join(camera.format(name) for name in corners),
        "camera_poses.yaml": mount.format("cam0", "0.1") + mount.format("cam1", "0.3"),
        "tagslam.yaml": "default_body: hall\nbodies:\n - hall:\n     is_static: true\n     default_tag_size: 0.3\n"
        '     tags:\n       - id: 7\n         size: 0.30\n - rig:\n     odom_topic: "/odom"\n     T_body_odom:\n'
        "       position:\n         x: 0.5\n         y: 0.0\n         z: 0.0\n       rotation:\n         x: 0.0\n"
        "         y: 0.0\n         z: 1.5707963267948966\n",
        "detections.csv": "stamp_s,camera,tag_id,hamming,u0_px,v0_px,u1_px,v1_px,u2_px,v2_px,u3_px,v3_px\n"
        f"0.5,cam0,7,0,{corners['cam0']}\n0.5,cam1,7,1,{corners['cam1']}\n1.0,cam0,7,2,{corners['cam0']}\n"
        f"1.0,cam1,99,3,{corners['cam1']}\n",
        "frames.csv": "stamp_s,camera,n_tags\n0,cam0,0\n0,cam1,0\n0.5,cam0,1\n0.5,cam1,1\n1.0,cam0,1\n1.0,cam1,1\n",
        "odometry.csv": "stamp_s,x_m,y_m,z_m,qx,qy,qz,qw,cxx,cyy,czz,crr,cpp,cww\n"
        + "".join(f"{0.25 * i},{0.1 * i},0,0,0,0,0,1,0.01,0.02,0.03,1e-4,2e-4,3e-4\n" for i in range(5)),
        "reference.csv": f"stamp_s,x_m,y_m,z_m,qx,qy,qz,qw\n0,{pose}\n0.5,{pose}\n",
        "survey.csv": "tag_id,size_m,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad\n7,0.3,3,2,0.5,0,0,1.5707963267948966\n",
    }


@pytest.fixture
def ycbv() -> Files:
    """A camera that moves along x past two objects; one is missed twice and has no truth."""
    stamps = [0.1 * i for i in range(6)]
    here, gone = "0.5 0.1 1 0.6 0 0 0.8", "0 0 0 0 0 0 0"
    seen = "".join(f"{s:.1f} {1 - s:.1f} 0 2 0 0 0 1\n" for s in stamps)
    path = "".join(f"{s:.6f} {s:.1f} 0 0 0 0 0 1\n" for s in stamps)
    return {
        "odometry.tum": path,
        "detections_002_can.tum": seen,
        "detections_001_box.tum": "".join(f"{s:.1f} {gone if i in (1, 4) else here}\n" for i, s in enumerate(stamps)),
        "camera_truth.tum": path,
        "object_truth_002_can.tum": seen,
    }


@pytest.fixture
def pose_graph() -> Files:
    """A graph of g2o: three poses, of which the first and last see two points, and an edge between these."""
    return {
        "world.g2o": "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.1\nVERTEX_SE2 2 2 0.1 0.1\nVERTEX_XY 7 1 1\n"
        "EDGE_SE2 0 1 1.0 0.0 0.1 500 0 0 500 0 5000\nEDGE_SE2 1 2 1.0 0.0 0.0 500 0 0 500 0 5000\n"
        "EDGE_SE2 0 2 2.0 0.1 0.1 500 0 0 500 0 5000\nEDGE_SE2_XY 0 7 1.0 1.0 100 0 100\n"
        "EDGE_SE2_XY 2 7 -1.0 1.0 100 0 100\nEDGE_SE2_XY 2 8 1.0 2.0 100 0 100\n"
    }


@pytest.fixture
def bag(tmp_path: Path) -> dict[str, bytes]:
    """A bag of ROS 2 in MCAP; a robot drives past two markers."""
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    from bags import write

    return {file.name: file.read_bytes() for file in write(tmp_path / "drive", "aruco").iterdir()}


@pytest.fixture
def lay_out(tmp_path: Path) -> Callable[..., Path]:
    """`lay_out(files, zipped=..., inside=...)` writes files into a folder or zip, `inside` a folder of it."""

    def write(files: dict[str, str] | dict[str, bytes], *, zipped: bool = False, inside: str = "") -> Path:
        content = {name: text.encode() if isinstance(text, str) else text for name, text in files.items()}
        root = tmp_path / ("MRCLAM_Test.zip" if zipped else "MRCLAM_Test")
        if zipped:
            with zipfile.ZipFile(root, "w", zipfile.ZIP_DEFLATED) as archive:
                for name, data in content.items():
                    archive.writestr(f"{inside}/{name}" if inside else name, data)
        else:
            (root / inside).mkdir(parents=True, exist_ok=True)
            for name, data in content.items():
                (root / inside / name).write_bytes(data)
        return root

    return write


@pytest.fixture(scope="session")
def assert_same() -> Callable[..., None]:
    """`assert_same(a, b, but={...})`: every array and value equal, bit by bit, except fields named in `but`."""
    return _assert_same


def _assert_same(one: Any, other: Any, but: frozenset[str] = frozenset(), where: str = "") -> None:
    assert type(one) is type(other), where
    if is_dataclass(one):
        for field in fields(one):
            if field.name not in but:
                _assert_same(getattr(one, field.name), getattr(other, field.name), but, f"{where}.{field.name}")
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype, where
        np.testing.assert_array_equal(one, other, err_msg=where, strict=True)
    else:
        assert one == other, where


@pytest.fixture(scope="session")
def check_recording() -> Callable[[Recording], None]:
    """`check_recording(recording)` asserts all that `types` promises of a recording."""
    return _check_recording


def _check_recording(recording: Recording) -> None:
    odometry, frames, detections = recording.odometry, recording.frames, recording.detections
    for holder in (odometry, frames, recording.truth):
        if holder is not None:
            assert np.all(np.diff(holder.stamp_s) > 0)
            assert holder.clock == recording.clock
    for holder in (odometry, frames, detections, recording.truth, recording.true_landmarks, recording.robot_sightings):
        if holder is None:
            continue
        for field in fields(holder):
            array = getattr(holder, field.name)
            if isinstance(array, np.ndarray):
                assert array.flags.c_contiguous, field.name
                assert array.dtype in (np.float64, np.int64), field.name
                assert len(array) == len(holder), field.name
                may_be_nan = field.name in ("sigma_range_m", "sigma_bearing_rad", "first_seen_s", "last_seen_s")
                assert may_be_nan or np.all(np.isfinite(array)), field.name
    assert len(odometry) >= 2
    assert len(detections) >= 1
    assert np.all(np.diff(detections.frame) >= 0)
    assert detections.frame.min() >= 0
    assert detections.frame.max() < len(frames)
    assert np.all(detections.range_m > 0)
    assert np.all(np.abs(detections.bearing_rad) <= np.pi)
    assert np.all(detections.landmark_id >= -1)
    assert np.all((detections.class_id >= -1) & (detections.class_id < max(1, len(recording.class_names))))
    if recording.true_landmarks is not None:
        assert np.all(np.diff(recording.true_landmarks.landmark_id) > 0)
