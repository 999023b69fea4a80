"""TUM trajectories against evo's reader and scipy's rotations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from evermap.errors import DataError, EvermapError, InputError
from evermap.io import read_tum, write_tum
from evermap.types import Trajectory


def a_trajectory(count: int = 50) -> Trajectory:
    random = np.random.default_rng(1)
    pose = np.column_stack([random.normal(0, 10, (count, 2)), random.uniform(-np.pi, np.pi, count)])
    stamp_s = 1248444187.156 + np.cumsum(random.uniform(0.001, 0.2, count))
    return Trajectory(stamp_s, pose, np.zeros((count, 3, 3)), frame="truth")


def test_evo_reads_what_is_written(tmp_path: Path) -> None:
    trajectory = a_trajectory()
    theirs = file_interface.read_tum_trajectory_file(str(write_tum(trajectory, tmp_path / "t.tum")))
    np.testing.assert_array_equal(theirs.timestamps, trajectory.stamp_s)
    np.testing.assert_array_equal(theirs.positions_xyz[:, :2], trajectory.pose_world_robot[:, :2])
    np.testing.assert_array_equal(theirs.positions_xyz[:, 2], 0.0)
    wxyz = theirs.orientations_quat_wxyz
    heading = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_euler("ZYX")[:, 0]
    np.testing.assert_allclose(heading, trajectory.pose_world_robot[:, 2], atol=1e-12)


def test_written_trajectories_read_back(tmp_path: Path) -> None:
    trajectory = a_trajectory()
    again = read_tum(write_tum(trajectory, tmp_path / "t.tum"))
    np.testing.assert_array_equal(again.stamp_s, trajectory.stamp_s)
    np.testing.assert_array_equal(again.pose_world_robot[:, :2], trajectory.pose_world_robot[:, :2])
    np.testing.assert_allclose(again.pose_world_robot[:, 2], trajectory.pose_world_robot[:, 2], atol=1e-14)


def test_heading_of_tilted_poses(tmp_path: Path) -> None:
    rotation = Rotation.from_euler("ZYX", [[0.7, 0.1, -0.2], [-2.0, -0.3, 0.1]])
    rows = np.column_stack([[0.0, 1.0], np.zeros((2, 3)), rotation.as_quat()])
    np.savetxt(tmp_path / "t.tum", rows, header="stamp x y z qx qy qz qw")
    np.testing.assert_allclose(read_tum(tmp_path / "t.tum").pose_world_robot[:, 2], [0.7, -2.0], atol=1e-12)


BAD = {
    "0 0 0 0 0 0 0\n1 0 0 0 0 0 0 1\n": (InputError, "t.tum:1: 7 columns"),
    "0 0 0 0 0 0 0 1\n-1 0 0 0 0 0 0 1\n": (InputError, "t.tum:2: field 'stamp_s': time runs backwards"),
    "0 0 0 0 0 0 0 0.5\n": (InputError, "t.tum:1: field 'qx qy qz qw': is not a unit quaternion"),
    "# nothing\n": (DataError, "contains no pose"),
}


@pytest.mark.parametrize("content", BAD)
def test_bad_trajectories_are_refused(content: str, tmp_path: Path) -> None:
    kind, words = BAD[content]
    (tmp_path / "t.tum").write_text(content)
    with pytest.raises(kind, match=words):
        read_tum(tmp_path / "t.tum")
    with pytest.raises(EvermapError, match="cannot be read"):
        read_tum(tmp_path / "none.tum")
    with pytest.raises(EvermapError, match="cannot be written"):
        write_tum(a_trajectory(), tmp_path / "no" / "folder.tum")
