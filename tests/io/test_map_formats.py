"""All formats of maps: recognised by content, read back as written, corrected without another byte changed."""

from __future__ import annotations

import difflib
import gzip
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap.errors import InputError
from evermap.geometry import se3
from evermap.io.map_entries import Correction, number_like
from evermap.io.map_formats import (
    MAP_FORMATS,
    SurveyFile,
    correct_map,
    format_called,
    format_of,
    read_landmarks,
    read_map_file,
    write_corrected,
    write_map,
    write_map_bytes,
)
from evermap.types import Landmarks, landmark_id_of

WITH_POSES = [kind for kind in MAP_FORMATS if kind.has_poses]
FORMATS = pytest.mark.parametrize("kind", MAP_FORMATS, ids=lambda kind: kind.name)

WPILIB = """{
  "tags": [
    {
      "ID": 3,
      "pose": {
        "translation": {"x": 11.56081, "y": 8.05561, "z": 1.30175},
        "rotation": {"quaternion": {"W": -0.7071067811865475, "X": -0.0, "Y": 0.0, "Z": 0.7071067811865476}}
      }
    },
    {
      "ID": 1,
      "pose": {
        "translation": {"x": 16.697198, "y": 0.65532, "z": 1.4859},
        "rotation": {"quaternion": {"W": 0.4539904997395468, "X": 0.0, "Y": 0.0, "Z": 0.8910065241883678}}
      }
    }
  ],
  "field": {"length": 17.548, "width": 8.052}
}"""
TAGSLAM = """\
# surveyed on a Monday
bodies:
 - hall:   # the static one
     is_static: true
     default_tag_size: 0.15
     pose:
       position:
         x: 10.0
         y: 20.0
         z: 0.0
       rotation:
         x: 0.0
         y: 0.0
         z: 1.5707963267948966
     tags:
       - id: 4
         size: 0.3
         pose:
           position:
             x: 1.0      # from the door
             y:  0.25
             z: 0.5
           rotation:
             x: 1.57079633
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
"""
FIDUCIALS = """\
301 46.603565 18.899853 2.412726 -179.117159 -0.132923 179.338569 0.000036 388 303 425
303 46.580077 20.120282 2.361060 -179.312076 1.208103 -178.939786 0.000078 174 305 301
"""
RTABMAP = "1 0 0 1 0 0 0|2 1.25 0 1 0 0 1.57"
SETTINGS = f"[Core]\nVersion=0.21\nMarker\\Priors={RTABMAP}\nMarker\\Length=0.1\n"
IN_PLANE = "# my poles\nname,Y [m],X [m],note\nnorth,2.50,1.00,by the gate\nsouth,-3.25,0.50,\n"
IN_SPACE = "id,x,y,z,yaw_deg,size\n7,1.0,2.0,3.0,90,0.2\n8,4.0,2.0,3.0,-45,0.2\n"
WPILIB_CSV = "\ufeffID,X,Y,Z,Z-Rotation,X-Rotation\r\n1,657.37,25.8,58.5,126,0\r\n4,365.2,241.64,73.54,0,30\r\n"
SURVEY = "tag_id,size_m,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad\n0,0.15,0.5890,19.2600,2.2890,-2.2214,-2.2214,-0.0000\n"
TEXTS = {
    "wpilib": WPILIB,
    "wpilib-2027": WPILIB.replace('"tags"', '"field-tags"').replace('"field":', '"field-dimensions":'),
    "tagslam": TAGSLAM,
    "fiducials": FIDUCIALS,
    "rtabmap": RTABMAP,
    "columns": IN_SPACE,
    "wpilib-csv": WPILIB_CSV,
    "csv": SURVEY,
}


def made(seed: int = 3, count: int = 6) -> Landmarks:
    """Return tags on walls, turned as WPILib's tables can say it, too."""
    rng = np.random.default_rng(seed)
    facing, tilt = rng.uniform(-math.pi, math.pi, count), rng.uniform(-0.4, 0.4, count)
    walls = se3.from_angles(np.column_stack([np.zeros(count), tilt, facing]))
    rotation = se3.compose(walls, np.array([0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5]))[:, 3:]
    at = np.round(rng.uniform(0.5, 9.0, (count, 3)), 6)
    flat = Landmarks.in_space(10 + np.arange(count), at, rotation=rotation)
    return replace(flat, covariance_m2=np.broadcast_to(0.02**2 * np.eye(3), (count, 3, 3)).copy())


def parsed(text: str, path: Path) -> SurveyFile:
    path.write_bytes(text.encode())
    return read_map_file(path)


def changed_lines(before: bytes, after: bytes) -> list[str]:
    pairs = zip(before.decode().splitlines(), after.decode().splitlines(), strict=True)
    return [new for old, new in pairs if old != new]


@FORMATS
def test_what_is_written_is_recognised_and_read_back(kind, tmp_path: Path) -> None:
    """Whatever the file is called."""
    given = made()
    path = write_map(given, tmp_path / "some.where", kind)
    found = read_map_file(path)
    assert found.format.name == kind.name
    assert found.landmarks.landmark_id.tolist() == given.landmark_id.tolist()
    coarse = 2e-5 if kind.name == "wpilib-csv" else 1e-6
    assert found.landmarks.position_m == pytest.approx(given.position_m, abs=coarse)
    for mine, theirs in zip(found.landmarks.rotation, given.rotation, strict=True):
        apart = Rotation.from_quat(mine).inv() * Rotation.from_quat(theirs)
        assert apart.magnitude() < 2e-5


@FORMATS
def test_nothing_to_correct_leaves_every_byte(kind, tmp_path: Path) -> None:
    path = write_map(made(), tmp_path / "map", kind)
    assert correct_map(read_map_file(path), []) == path.read_bytes()


@FORMATS
def test_only_what_is_corrected_changes(kind, tmp_path: Path) -> None:
    given = made()
    path = write_map(given, tmp_path / "map", kind)
    turn = Rotation.from_euler("z", 0.5)
    at = given.position_m[2] + [0.3, -0.2, 0.1]
    rotation = (turn * Rotation.from_quat(given.rotation[2])).as_quat()
    one = Correction(12, position_m=at, rotation=rotation)
    data = correct_map(read_map_file(path), [one])
    other = write_map_bytes(data, tmp_path / "corrected")
    before, after = read_landmarks(path), read_landmarks(other)
    rest = np.arange(6) != 2
    np.testing.assert_array_equal(after.position_m[rest], before.position_m[rest])
    np.testing.assert_array_equal(after.rotation[rest], before.rotation[rest])
    assert after.position_m[2] == pytest.approx(at, abs=2e-5)
    assert (Rotation.from_quat(after.rotation[2]).inv() * Rotation.from_quat(rotation)).magnitude() < 1e-4
    if kind.locate is not None and kind.name != "rtabmap":  # all of whose entries are one line
        lines = len(changed_lines(path.read_bytes(), data))
        entry = {"wpilib": 7, "wpilib-2027": 7, "tagslam": 6, "geojson": 2}.get(kind.name, 1)
        assert 1 <= lines <= entry


def test_a_map_in_braces_is_the_same_map_and_is_corrected_in_them(tmp_path: Path) -> None:
    """TagSLAM's maps are YAML, which people also write as `position: {x: 1, y: 2, z: 3}`."""
    plain = parsed(TAGSLAM, tmp_path / "plain.yaml")
    indented = r"(position|rotation):\n +x: (\S+)\n +y: (\S+)\n +z: (\S+)(?=\n)"
    text, count = re.subn(indented, r"\1: {x: \2, y: \3, z: \4}", TAGSLAM)
    assert count >= 2
    braced = parsed(text, tmp_path / "braced.yaml")
    assert braced.format.name == "tagslam"
    np.testing.assert_array_equal(braced.landmarks.position_m, plain.landmarks.position_m)
    np.testing.assert_array_equal(braced.landmarks.rotation, plain.landmarks.rotation)
    at = plain.landmarks.position_m[0] + [0.25, 0.0, 0.0]
    one = Correction(int(plain.landmarks.landmark_id[0]), position_m=at)
    after = correct_map(braced, [one])
    assert len(changed_lines(text.encode(), after)) == 1
    expected = re.sub(indented, r"\1: {x: \2, y: \3, z: \4}", correct_map(plain, [one]).decode())
    assert after.decode() == expected


@pytest.mark.parametrize("name", TEXTS)
def test_texts_of_others_keep_their_form(name: str, tmp_path: Path) -> None:
    """Comments, order, line ends and decimals stay; numbers are written as those beside them."""
    file = parsed(TEXTS[name], tmp_path / "a.file")
    assert file.format.name == name
    identity = int(file.landmarks.landmark_id[0])
    at = file.landmarks.position_m[0] + [0.123456789, 0.0, 0.0]
    data = correct_map(file, [Correction(identity, position_m=at)])
    (tmp_path / "b.file").write_bytes(data)
    after = read_landmarks(tmp_path / "b.file")
    assert after.position_m[0] == pytest.approx(at, abs=1e-3)
    np.testing.assert_array_equal(after.position_m[1:], file.landmarks.position_m[1:])
    before = TEXTS[name].encode()
    assert data.count(b"\r\n") == before.count(b"\r\n")
    assert data[:3] == before[:3]
    matcher = difflib.SequenceMatcher(None, before.decode(), data.decode(), autojunk=False)
    touched = sum(max(j2 - j1, i2 - i1) for tag, i1, i2, j1, j2 in matcher.get_opcodes() if tag != "equal")
    assert touched <= 12  # digits of one number, or of two where the body is turned


@pytest.mark.parametrize("before", ["\ufeff", "# surveyed on 3.5.2026\r\n", "\ufeff# 301 1 2 3 4 5 6 7 8\r\n\r\n"])
def test_a_mark_and_comments_before_tags_stay(before: str, tmp_path: Path) -> None:
    file = parsed(before + FIDUCIALS, tmp_path / "somewhere.dat")
    assert (file.format.name, file.landmarks.landmark_id.tolist()) == ("fiducials", [301, 303])
    data = correct_map(file, [Correction(303, position_m=file.landmarks.position_m[1] + [0.25, 0.0, 0.0])])
    assert data.decode() == (before + FIDUCIALS).replace("46.580077", "46.830077")


def test_numbers_are_written_as_others_of_the_file() -> None:
    assert number_like(["35", "58.5", "657.37"], 12.34567, (2, 3)) == "12.35"
    assert number_like(["35", "58.5"], 12.0, (2, 3)) == "12"
    assert number_like(["0.0", "0.8017726517951"], 0.123456789012, (6, 9)) == "0.123456789"
    assert number_like(["46.603565", "-1.500000"], 2.5, (3, 6)) == "2.500000"
    assert number_like(["16.697198", "7.3964799999999995", "1.0"], 8.0, (3, 6)) == "8.0"
    assert number_like(["0", "1.25"], -0.00001, (3, 6)) == "0"
    assert number_like(["7.578928199999999"], 1.23456789, (3, 6)) == "1.234568"


def test_exchanged_entries_get_each_others_numbers_as_they_are(tmp_path: Path) -> None:
    file = parsed(WPILIB, tmp_path / "a.json")
    data = correct_map(file, [Correction(1, like_id=3), Correction(3, like_id=1)])
    before, after = json.loads(WPILIB)["tags"], json.loads(data)["tags"]
    assert [tag["ID"] for tag in after] == [3, 1]
    assert [tag["pose"] for tag in after] == [before[1]["pose"], before[0]["pose"]]
    again = correct_map(replace(file, data=data), [Correction(1, like_id=3), Correction(3, like_id=1)])
    assert again == WPILIB.encode()


def test_a_rotation_is_written_as_the_file_has_it(tmp_path: Path) -> None:
    """The sign of a quaternion, the turn of an angle and the length of a rotation vector stay near those before."""
    quarter = Rotation.from_euler("z", 90, degrees=True)
    for name, text in TEXTS.items():
        file = parsed(text, tmp_path / "a.map")
        identity, rotation = int(file.landmarks.landmark_id[0]), Rotation.from_quat(file.landmarks.rotation[0])
        wanted = quarter * rotation
        data = correct_map(file, [Correction(identity, rotation=wanted.as_quat())])
        (tmp_path / "b.map").write_bytes(data)
        found = read_landmarks(tmp_path / "b.map")
        assert (Rotation.from_quat(found.rotation[0]).inv() * wanted).magnitude() < 2e-3, name
        np.testing.assert_allclose(found.position_m, file.landmarks.position_m, atol=1e-9)
    assert (
        json.loads(correct_map(parsed(WPILIB, tmp_path / "c"), []))["tags"][0]["pose"]["rotation"]["quaternion"]["W"]
        < 0
    )


def test_tables_of_others_are_read_by_their_columns(tmp_path: Path) -> None:
    plane = parsed(IN_PLANE, tmp_path / "poles.txt").landmarks
    at = {plane.names[k]: place for k, place in zip(plane.landmark_id.tolist(), plane.position_m.tolist(), strict=True)}
    assert at == {"north": [1.0, 2.5], "south": [0.5, -3.25]}
    space = parsed(IN_SPACE, tmp_path / "tags.csv").landmarks
    assert space.size_m[:, 0] == pytest.approx(0.2)
    looks = Rotation.from_quat(space.rotation).apply([0.0, 0.0, 1.0])
    assert looks == pytest.approx(np.array([[0.0, 1.0, 0.0], [0.5**0.5, -(0.5**0.5), 0.0]]), abs=1e-9)
    inches = parsed("marker_id,x_in,y_in\n1,100,200\n", tmp_path / "inches.csv").landmarks
    assert inches.position_m[0] == pytest.approx([2.54, 5.08])
    ids = parsed("id,x,y,z,april_id\n1,0.5,1.5,2.5,50\n2,0,0,0,25\n", tmp_path / "starloc.csv").landmarks
    assert ids.landmark_id.tolist() == [25, 50]
    with pytest.raises(InputError, match="yaw_deg"):
        parsed(IN_SPACE.replace("yaw_deg", "yaw"), tmp_path / "wrong.csv")
    with pytest.raises(InputError, match="several units"):
        parsed("id,x_mm,y\n1,100,2\n", tmp_path / "wrong.csv")


def test_settings_of_rtabmap_keep_all_else(tmp_path: Path) -> None:
    file = parsed(SETTINGS, tmp_path / "config.ini")
    data = correct_map(file, [Correction(2, position_m=np.array([1.5, 0.0, 1.0]))]).decode()
    assert data == SETTINGS.replace("2 1.25 0 1", "2 1.5 0 1")


def test_a_covariance_in_the_file_is_that_of_what_is_written(tmp_path: Path) -> None:
    text = "landmark_id,x_m,y_m,sigma_m\n1,1.000,2.000,0.002\n2,3.000,4.000,0.002\n"
    file = parsed(text, tmp_path / "a.csv")
    one = Correction(2, position_m=np.array([3.5, 4.0]), covariance_m2=0.03**2 * np.eye(2))
    assert correct_map(file, [one]).decode() == text.replace("3.000,4.000,0.002", "3.500,4.000,0.03")


def test_outlines_of_geojson_move_along(tmp_path: Path) -> None:
    kind = next(kind for kind in MAP_FORMATS if kind.name == "geojson")
    path = write_map(made(), tmp_path / "map.geojson", kind)
    one = Correction(12, position_m=np.array([1.0, 2.0, 3.0]))
    features = json.loads(correct_map(read_map_file(path), [one]))["features"]
    point, ring = [feature for feature in features if feature["properties"]["landmark_id"] == 12]
    assert point["geometry"]["coordinates"] == [1.0, 2.0, 3.0]
    assert np.mean(ring["geometry"]["coordinates"][0][:-1], axis=0) == pytest.approx([1.0, 2.0], abs=1e-3)


def test_a_map_of_a_newer_layout_is_gzipped_where_its_name_says_so(tmp_path: Path) -> None:
    path = tmp_path / "survey.csv.gz"
    path.write_bytes(gzip.compress(SURVEY.encode()))
    data = correct_map(read_map_file(path), [Correction(0, position_m=np.array([0.6, 19.26, 2.289]))])
    assert data.decode() == SURVEY.replace("0.5890", "0.6000")
    other = write_map_bytes(data, tmp_path / "new.csv.gz")
    assert gzip.decompress(other.read_bytes()) == data


def test_a_packed_map_of_which_nothing_is_wrong_is_the_same_to_the_last_byte(tmp_path: Path) -> None:
    """Packed again it would be others: another level, name and time are in it."""
    path = tmp_path / "survey.csv.gz"
    path.write_bytes(gzip.compress(SURVEY.encode(), 1, mtime=7))
    file = read_map_file(path)
    assert write_corrected(file, [], tmp_path / "same.csv.gz").read_bytes() == path.read_bytes()
    assert write_corrected(file, [], tmp_path / "unpacked.csv").read_bytes() == SURVEY.encode()
    one = Correction(0, position_m=np.array([0.6, 19.26, 2.289]))
    packed = write_corrected(file, [one], tmp_path / "new.csv.gz").read_bytes()
    assert gzip.decompress(packed) == correct_map(file, [one])
    plain = tmp_path / "survey.csv"
    plain.write_bytes(SURVEY.encode())
    assert gzip.decompress(write_corrected(read_map_file(plain), [], tmp_path / "other.csv.gz").read_bytes()) == (
        SURVEY.encode()
    )


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ("VERTEX_SE2 0 1 2 3\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n", "pose graph"),
        ("1.5 0 0 0 0 0 0 1\n1.6 0 0 0 0 0 0 1\n", "a trajectory"),
        ("version https://git-lfs.github.com/spec/v1\noid sha256:4d\n", "Git LFS.*git lfs pull"),
        ("<!DOCTYPE html><html></html>", "a web page"),
        ('{"version": 3, "cameras": []}', "JSON with version, cameras"),
        ("image: map.pgm\nresolution: 0.05\n", "Nav2"),
        ("SQLite format 3\0 and so on", "living map.*map export"),
    ],
)
def test_another_file_is_called_what_it_is(content: str, match: str, tmp_path: Path) -> None:
    path = tmp_path / "map.bin"
    path.write_text(content)
    with pytest.raises(InputError, match=match):
        read_map_file(path)


def test_formats_that_need_poses_say_so(tmp_path: Path) -> None:
    flat = Landmarks.at([1, 2], [[0.0, 0.0], [1.0, 1.0]])
    ids, door = made().landmark_id, landmark_id_of("door")
    named = replace(made(), landmark_id=np.append(ids[:-1], door), names={door: "door"})
    called = replace(made(), names={int(ids[0]): "door"})  # its number stays
    for kind in WITH_POSES:
        write_map(called, tmp_path / "b", kind)
        assert str(ids[0]) in (tmp_path / "b").read_text()
        with pytest.raises(InputError, match="needs a pose in space"):
            write_map(flat, tmp_path / "a", kind)
        with pytest.raises(InputError, match="door"):
            write_map(named, tmp_path / "a", kind)
    assert format_called(None, Path("a.json")).name == "geojson"
    assert format_called("wpilib", Path("a.json")).name == "wpilib"
    with pytest.raises(InputError, match="wpilib-2027"):
        format_called("g2o", Path("a.g2o"))


@pytest.mark.data
def test_official_layouts_and_maps_of_others(shared_data: Path) -> None:
    """Table and JSON of one field say the same; without a correction every byte of every file stays."""
    field = shared_data / "field"
    for path in sorted(field.glob("*/*/*.csv")):
        table, layout = read_map_file(path), read_map_file(path.with_suffix(".json"))
        assert (table.format.name, layout.format.name) == ("wpilib-csv", "wpilib-2027")
        assert table.landmarks.position_m == pytest.approx(layout.landmarks.position_m, abs=1e-9)
        assert table.landmarks.rotation == pytest.approx(layout.landmarks.rotation, abs=1e-9)
    for path in [*sorted(field.glob("wpilib/*/*")), *sorted(field.glob("fiducials/*.txt"))]:
        file = read_map_file(path)
        assert correct_map(file, []) == path.read_bytes()
        last = int(file.landmarks.landmark_id[-1])
        same = Correction(last, position_m=file.landmarks.position_m[-1], rotation=file.landmarks.rotation[-1])
        lines = changed_lines(path.read_bytes(), correct_map(file, [same]))
        assert len(lines) <= 7, path  # at most the rounding of what a computer had printed
    assert format_of((field / "fiducials" / "jimHouse.txt").read_bytes(), Path("x")).name == "fiducials"
