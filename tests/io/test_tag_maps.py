"""Maps of tags of other projects: the same tags, where they are and how they are turned."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap.errors import InputError
from evermap.geometry import se3
from evermap.io import read_prior_map
from evermap.types import Landmarks

TAGSLAM = """\
bodies:
 - floor:
     is_static: true
     default_tag_size: 0.15
     pose:
       position: {pose}
       rotation:
         x: 0.0
         y: 0.0
         z: 1.5707963267948966
     tags:
       - id: 4
         size: 0.3
         pose:
           position:
             x: 1.0
             y: 0.0
             z: 0.5
           rotation:
             x: 0.0
             y: 0.0
             z: 0.0
       - id: 9
         pose:
           position:
             x: 0.0
             y: 2.0
             z: 0.5
           rotation:
             x: 0.0
             y: 0.5
             z: 0.0
       - id: 11
 - rig:
     is_static: false
     tags:
       - id: 5
"""
XYZ = "\n         x: 10.0\n         y: 20.0\n         z: 0.0"
WPILIB = {
    "field": {"length": 16.5, "width": 8.2},
    "tags": [
        {"ID": 7, "pose": {"translation": {"x": 1.0, "y": 2.0, "z": 3.0}, "rotation": {"quaternion": {}}}},
        {"ID": 2, "pose": {"translation": {"x": 0.0, "y": 5.0, "z": 1.0}, "rotation": {"quaternion": {}}}},
    ],
}


def axes(landmarks: Landmarks) -> np.ndarray:
    """(L, 3, 3) axes of the tags in the map, as columns."""
    assert landmarks.rotation is not None
    return Rotation.from_quat(landmarks.rotation).as_matrix()


def test_tags_of_tagslam(tmp_path: Path) -> None:
    path = tmp_path / "tagslam.yaml"
    path.write_text(TAGSLAM.replace("{pose}", XYZ))
    found = read_prior_map(path)
    assert found.landmark_id.tolist() == [4, 9]  # of the others nothing is known
    # the body stands at (10, 20), turned by a quarter to the left
    assert found.position_m == pytest.approx(np.array([[10.0, 21.0, 0.5], [8.0, 20.0, 0.5]]))
    assert found.size_m is not None
    assert found.size_m[:, 0] == pytest.approx([0.3, 0.15])
    turned = Rotation.from_rotvec([0.0, 0.0, np.pi / 2.0]) * Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]])
    assert axes(found) == pytest.approx(turned.as_matrix())


@pytest.mark.data
def test_tagslam_states_what_its_authors_surveyed(shared_data: Path) -> None:
    folder = shared_data / "tagslam" / "test_11"
    stated, surveyed = read_prior_map(folder / "tagslam.yaml"), read_prior_map(folder / "survey.csv.gz")
    np.testing.assert_array_equal(stated.landmark_id, surveyed.landmark_id)
    assert stated.position_m == pytest.approx(surveyed.position_m, abs=1e-4)
    assert axes(stated) == pytest.approx(axes(surveyed), abs=1e-4)
    assert stated.size_m == pytest.approx(surveyed.size_m)


def test_tags_of_wpilib_look_along_x(tmp_path: Path) -> None:
    """The first faces the far end of the field, the second the wall to its left."""
    layout = json.loads(json.dumps(WPILIB))
    half = np.sqrt(0.5)
    for tag, (w, z) in zip(layout["tags"], ((1.0, 0.0), (half, half)), strict=True):
        tag["pose"]["rotation"]["quaternion"] = {"W": w, "X": 0.0, "Y": 0.0, "Z": z}
    path = tmp_path / "field.json"
    path.write_text(json.dumps(layout))
    found = read_prior_map(path)
    assert found.landmark_id.tolist() == [2, 7]
    assert found.position_m == pytest.approx(np.array([[0.0, 5.0, 1.0], [1.0, 2.0, 3.0]]))
    right, up, to_viewer = np.moveaxis(axes(found), -1, 0)
    assert to_viewer == pytest.approx(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]), abs=1e-9)
    assert up == pytest.approx(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]), abs=1e-9)
    # seen from in front of a tag, its x points to the right
    assert right == pytest.approx(np.cross(up, to_viewer))


def test_tags_of_fiducial_slam(tmp_path: Path) -> None:
    path = tmp_path / "map.txt"
    path.write_text("301 0.0 0.0 0.0 180.0 -0.0 0.0 0.0 1\n\n7 1.5 -2.0 0.25 90 20 -30 0.01 12 301 9\n")
    found = read_prior_map(path)
    assert found.landmark_id.tolist() == [7, 301]
    assert found.position_m == pytest.approx(np.array([[1.5, -2.0, 0.25], [0.0, 0.0, 0.0]]))
    # roll, pitch and yaw are about fixed axes
    turned = Rotation.from_euler("xyz", [[90.0, 20.0, -30.0], [180.0, 0.0, 0.0]], degrees=True)
    assert axes(found) == pytest.approx(turned.as_matrix(), abs=1e-9)
    assert np.abs(se3.log(np.hstack([np.zeros((2, 3)), found.rotation]))).max() <= np.pi + 1e-9


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("a.yaml", "cameras: 3\n", r"a\.yaml: field 'bodies': contains no bodies"),
        ("a.yaml", TAGSLAM.replace("{pose}", " 3"), r"field 'floor\.pose': needs position and rotation"),
        ("a.yaml", TAGSLAM.replace("{pose}", XYZ).replace("id: 4", "id: four"), r"'floor\.tags': must be numbers"),
        ("a.json", json.dumps(WPILIB), r"field 'tags\[0\]': has no ID, translation"),
        ("a.json", json.dumps({"tags": [3], "field": {}}), r"field 'tags\[0\]': has no ID"),
        ("a.txt", "301 0 0 0 180 0 0 0 1\n302 0 0 zero 180 0 0 0 1\n", r"a\.txt:2: is not a tag of fiducial_slam"),
        ("a.txt", "1.5 0 0 0 180 0 0 0 1\n", r"a\.txt:1: is not a tag"),
        ("a.txt", "3 0 0 0 180 0 0 0 1\n3 0 0 0 180 0 0 0 1\n", r"a\.txt:2: field 'landmark_id': landmark 3 is listed"),
        ("a.doc", "", r"unknown map format '\.doc'.*TagSLAM"),
    ],
)
def test_what_is_no_map_of_tags(name: str, text: str, match: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=match):
        read_prior_map(tmp_path / name)
