"""Pose graphs of g2o, TORO and PyFG: the same recording, and the same map, as from native tables."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import evermap as em
from evermap.errors import DataError, InputError
from evermap.estimate.measurements import find_kinds
from evermap.geometry import se2, se3
from evermap.io import read_recording
from evermap.types import landmark_id_of

SIGMA_M, STEPS = 0.05, 60
AT = np.array([[2.0, 4.0], [6.0, -1.0], [-3.0, 3.0], [1.0, 9.0], [8.0, 6.0]])


class World:
    """A robot drives in a circle of 3 m twice, in steps of a second, and sees points within 7 m."""

    def __init__(self, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        move = np.array([2 * np.pi * 3.0 / 30, 0.0, 2 * np.pi / 30])
        self.pose = np.zeros((STEPS, 3))
        for k in range(1, STEPS):
            self.pose[k] = se2.compose(self.pose[k - 1], se2.exp(move))
        self.step = se2.exp(np.tile(move, (STEPS - 1, 1)) + rng.normal(0, [0.02, 0.01, 0.005], (STEPS - 1, 3)))
        self.seen = []
        for k in range(STEPS):
            here = se2.transform(se2.inverse(self.pose[k]), AT)
            for landmark in np.flatnonzero(np.hypot(*here.T) < 7.0).tolist():
                self.seen.append((k, landmark, *(here[landmark] + rng.normal(0, SIGMA_M, 2)).tolist()))

    def native(self, folder: Path) -> Path:
        folder.mkdir()
        rows = [(0.0, 0.0, 0.0), *self.step.tolist()]
        (folder / "odometry.csv").write_text(
            "stamp_s,dx_m,dy_m,dtheta_rad\n" + "".join(f"{k},{x!r},{y!r},{t!r}\n" for k, (x, y, t) in enumerate(rows))
        )
        (folder / "frames.csv").write_text("stamp_s\n" + "".join(f"{k}\n" for k in range(STEPS)))
        (folder / "detections.csv").write_text(
            "stamp_s,landmark_id,x_m,y_m,sigma_m\n"
            + "".join(f"{k},{100 + n},{x!r},{y!r},{SIGMA_M}\n" for k, n, x, y in self.seen)
        )
        (folder / "sensor.toml").write_text("[recording]\nframes_complete = false\n")
        return folder

    def g2o(self, *, closure: bool = True) -> str:
        lines = [f"VERTEX_SE2 {k} {x} {y} {t}" for k, (x, y, t) in enumerate(self.pose.tolist())]
        lines += [f"VERTEX_XY {100 + n} 0 0" for n in range(len(AT))] + ["FIX 0", "# a comment", ""]
        lines += [f"EDGE_SE2 {k} {k + 1} {x!r} {y!r} {t!r} 400 0 0 400 0 1e4" for k, (x, y, t) in self.steps()]
        information = 1.0 / SIGMA_M**2
        lines += [f"EDGE_SE2_XY {k} {100 + n} {x!r} {y!r} {information} 0 {information}" for k, n, x, y in self.seen]
        if closure:
            x, y, t = se2.between(self.pose[3], self.pose[33]).tolist()
            lines += [f"EDGE_SE2 3 33 {x!r} {y!r} {t!r} 2500 0 0 2500 0 1e4"]
        return "\n".join(lines) + "\n"

    def pyfg(self) -> str:
        lines = [f"VERTEX_SE2 {k:.3f} A{k} {x} {y} {t}" for k, (x, y, t) in enumerate(self.pose.tolist())]
        lines += ["VERTEX_SE2 0.0 B0 5 5 0", "VERTEX_SE2 1.0 B1 6 5 0"]
        lines += [f"VERTEX_XY L{n} {x} {y}" for n, (x, y) in enumerate(AT.tolist())]
        lines += [
            f"EDGE_SE2 {k:.3f} A{k} A{k + 1} {x!r} {y!r} {t!r} .0025 0 .0025 0 0 1e-4" for k, (x, y, t) in self.steps()
        ]
        lines += ["EDGE_SE2 0.0 B0 B1 1 0 0 .01 0 0 .01 0 .01", "EDGE_RANGE 1.0 A1 B1 6.0 0.01"]
        variance = SIGMA_M**2
        lines += [f"EDGE_SE2_XY {k:.3f} A{k} L{n} {x!r} {y!r} {variance} 0 {variance}" for k, n, x, y in self.seen]
        return "\n".join(lines) + "\n"

    def steps(self) -> Any:
        return enumerate(self.step.tolist())


@pytest.fixture(scope="module")
def world() -> World:
    return World()


def assert_same_readings(found: Any, wanted: Any) -> None:
    np.testing.assert_allclose(found.odometry.stamp_s, wanted.odometry.stamp_s)
    for name in ("forward_mps", "lateral_mps", "angular_radps"):
        np.testing.assert_allclose(getattr(found.odometry, name), getattr(wanted.odometry, name), atol=1e-12)
    np.testing.assert_array_equal(found.detections.frame, wanted.detections.frame)
    for name in ("range_m", "bearing_rad", "sigma_range_m", "sigma_bearing_rad"):
        np.testing.assert_allclose(getattr(found.detections, name), getattr(wanted.detections, name), rtol=1e-9)


def test_a_graph_of_g2o_makes_the_map_of_the_native_tables(world: World, tmp_path: Path) -> None:
    wanted = read_recording(world.native(tmp_path / "native"))
    (tmp_path / "world.g2o").write_text(world.g2o(closure=False))
    found = read_recording(tmp_path / "world.g2o")
    assert_same_readings(found, wanted)
    np.testing.assert_array_equal(found.detections.landmark_id, wanted.detections.landmark_id)
    of_graph, of_tables = em.run_slam(found), em.run_slam(wanted)
    np.testing.assert_allclose(of_graph.landmarks.position_m, of_tables.landmarks.position_m, atol=1e-6)
    np.testing.assert_allclose(of_graph.landmarks.position_m, AT, atol=0.1)


def test_other_edges_between_poses_are_closures(world: World, tmp_path: Path) -> None:
    (tmp_path / "world.g2o").write_text(world.g2o())
    (closures,) = read_recording(tmp_path / "world.g2o").measurements
    assert closures.kind == "closures"
    assert (closures.stamp_s.tolist(), closures.columns["to_stamp_s"].tolist()) == ([3.0], [33.0])
    np.testing.assert_allclose([closures.columns["sigma_m"][0], closures.columns["sigma_rad"][0]], [0.02, 0.01])
    kind = find_kinds()["closures"]
    assert set(closures.columns) == {*kind.columns, *kind.optional}


def test_a_graph_of_pyfg_has_stamps_names_and_truth(world: World, tmp_path: Path) -> None:
    (tmp_path / "world.pyfg").write_text(world.pyfg())
    found = read_recording(tmp_path / "world.pyfg")
    assert_same_readings(found, read_recording(world.native(tmp_path / "native")))
    assert found.truth is not None
    np.testing.assert_allclose(found.truth.pose_world_robot[:, :2], world.pose[:, :2])
    assert set(found.landmark_names.values()) == {f"L{n}" for n in range(5)}
    assert found.true_landmarks is not None
    row = found.true_landmarks.landmark_id.tolist().index(landmark_id_of("L3"))
    np.testing.assert_allclose(found.true_landmarks.position_m[row], AT[3])
    with pytest.raises(DataError, match="no landmark"):
        read_recording(tmp_path / "world.pyfg", 2)
    with pytest.raises(InputError, match="robot 3"):
        read_recording(tmp_path / "world.pyfg", 3)


def test_toro_and_keys_of_gtsam(world: World, tmp_path: Path) -> None:
    symbol = {"x": ord("x") << 56, "l": ord("l") << 56}
    text = world.g2o()
    lines = []
    for words in (line.split() for line in text.splitlines() if line.startswith(("VERTEX", "EDGE"))):
        keys = 2 if words[0].startswith("EDGE") else 1
        named = [symbol["x"] + int(key) if int(key) < 100 else symbol["l"] + int(key) for key in words[1 : 1 + keys]]
        if words[0] == "EDGE_SE2":  # ff fs ss rr fr sr
            words[6:12] = words[6], words[7], words[9], words[11], words[8], words[10]
        lines.append(" ".join([words[0].replace("VERTEX_SE2", "VERTEX2").replace("EDGE_SE2", "EDGE2")
                               .replace("EDGE2_XY", "LANDMARK"), *map(str, named), *words[1 + keys :]]))  # fmt: skip
    (tmp_path / "world.graph").write_text("\n".join(lines))
    found = read_recording(tmp_path / "world.graph")
    assert_same_readings(found, read_recording(world.native(tmp_path / "native")))
    assert set(found.landmark_names.values()) == {f"l{100 + n}" for n in range(5)}
    np.testing.assert_allclose(found.measurements[0].columns["sigma_rad"], 0.01)


def test_a_graph_in_space(tmp_path: Path) -> None:
    """Every pose sees four points through a sensor that is mounted 1 m above it; the odometry is exact."""
    move = se3.exp(np.array([0.3, 0.0, 0.02, 0.02, 0.01, 0.1]))
    at = np.array([[3.0, 1.0, 2.0], [4.0, -2.0, 0.5], [1.0, 5.0, 1.0], [-2.0, 3.0, 3.0]])
    mount = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    pose, lines = [se3.identity()], ["PARAMS_SE3OFFSET 0 0 0 1 0 0 0 1"]
    for _ in range(20):
        pose.append(se3.compose(pose[-1], move))
    upper = " ".join("400" if k in (0, 6, 11) else "1e4" if k in (15, 18, 20) else "0" for k in range(21))
    for k, here in enumerate(pose):
        lines.append(f"VERTEX_SE3:QUAT {k} " + " ".join(map(repr, here.tolist())))
        if k:
            lines.append(f"EDGE_SE3:QUAT {k} {k - 1} " + " ".join(map(repr, se3.inverse(move).tolist())) + f" {upper}")
        for n, seen in enumerate(se3.transform(se3.inverse(se3.compose(here, mount)), at).tolist()):
            lines.append(f"EDGE_SE3_TRACKXYZ {k} {50 + n} 0 " + " ".join(map(repr, seen)) + " 400 0 0 400 0 400")
    lines += [f"VERTEX_TRACKXYZ {50 + n} 0 0 0" for n in range(4)]
    (tmp_path / "world.g2o").write_text("\n".join(lines) + "\n")
    found = read_recording(tmp_path / "world.g2o")
    assert found.dim == 3
    assert found.odometry is not None
    np.testing.assert_allclose(found.odometry.pose_world_robot, np.array(pose), atol=1e-9)
    np.testing.assert_allclose(found.sensors[0].mount_robot_sensor, mount)
    np.testing.assert_allclose(found.detections.covariance_sensor_m2[0], 0.0025 * np.eye(3), atol=1e-12)
    result = em.run_slam(found)
    np.testing.assert_allclose(result.landmarks.position_m, at, atol=1e-3)


def test_ranges_alone(world: World, tmp_path: Path) -> None:
    lines = [line for line in world.g2o().splitlines() if "_XY" not in line]
    lines += [f"EDGE_RANGE_SE2_XY {k} {100 + n} {math.hypot(x, y)!r} 400" for k, n, x, y in world.seen]
    (tmp_path / "ranges.g2o").write_text("\n".join(lines))
    found = read_recording(tmp_path / "ranges.g2o")
    assert np.isnan(found.detections.bearing_rad).all()
    np.testing.assert_allclose(found.detections.sigma_range_m, 0.05)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda text: text.replace("_XY 0 100 ", "_XY 0 100 x"), r"g2o:\d+: 'x[\d.-]+' is not a number"),
        (lambda text: text.replace("EDGE_SE2 5 6 ", "EDGE_SE2 5 6 nan "), "12 numbers after EDGE_SE2 instead of 11"),
        (lambda text: "".join(line for line in text.splitlines(True) if "XY" not in line), "graph of poses only"),
        (lambda text: "".join(one for one in text.splitlines(True) if " 5 6 " not in one and "_SE2 5 " not in one),
         "no edge between the successive poses 5 and 6"),
        (lambda text: text + "VERTEX_TRACKXYZ 200 1 2 3\nFIX 0\n", "mixes the plane with space"),
    ],
)  # fmt: skip
def test_mistakes_are_named(change: Any, problem: str, world: World, tmp_path: Path) -> None:
    (tmp_path / "world.g2o").write_text(change(world.g2o()))
    with pytest.raises((InputError, DataError), match=problem):
        read_recording(tmp_path / "world.g2o")


def test_remarks(world: World, tmp_path: Path) -> None:
    text = world.g2o().replace("EDGE_SE2 7 8 ", "EDGE_OTHER 7 8 ") + "EDGE_SE2 1 9 0.1"
    (tmp_path / "world.g2o").write_text(text)
    remarks = " ".join(read_recording(tmp_path / "world.g2o").warnings)
    assert "1 line of other kinds not read: 'EDGE_OTHER' (1)" in remarks
    assert "1 step without an edge of odometry taken from what the vertices say" in remarks
    assert "1 unfinished last line" in remarks
    assert "one second apart" in remarks
