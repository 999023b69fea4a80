"""Importers: each format in its smallest file, with the right episodes, and one line for what is not such a file."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from evermap_score import Episodes, ScoreError, episodes_from_rows, score, write_episodes
from evermap_score.episodes import rows_of
from evermap_score.importers import read_any


def spans(table: Episodes) -> list[tuple[Any, ...]]:
    """(id, from, to, x, y, z, p) of each row, sorted."""
    names = ("landmark_id", "t_from_s", "t_to_s", "x_m", "y_m", "z_m", "p")
    rows = [tuple(None if row[n] is None else round(row[n], 6) if isinstance(row[n], float) else row[n] for n in names)
            for row in rows_of(table)]  # fmt: skip
    return sorted(rows, key=repr)


def write(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


CHANGES = """\
node_id,merged_id,first_absent,last_absent,first_persistent,last_persistent,change,kind,place,name,class,x_m,y_m,z_m,from_s,to_s,first_seen_s,last_seen_s,probability,p_exists,hits,misses
"""


def write_run(folder: Path, landmarks: list[dict[str, Any]], changes: str, end_s: float) -> Path:
    """What a run of evermap writes, as far as it is read."""
    import pyarrow as pa
    from pyarrow.parquet import write_table

    write(folder / "object_changes.csv", CHANGES + changes)
    write(folder / "trajectory.tum", f"0 0 0 0 0 0 0 1\n{end_s} 1 0 0 0 0 0 1\n")
    write_table(pa.Table.from_pylist(landmarks), folder / "map.parquet")
    return folder


def landmark(name: int, x: float, y: float, p: float) -> dict[str, Any]:
    cov = {"cov_xx_m2": 0.01, "cov_xy_m2": 0.0, "cov_yy_m2": 0.04}
    return {"landmark_id": name, "x_m": x, "y_m": y, **cov, "class_id": "tag", "p_exists": p}


MONDAY = [landmark(1, 0, 0, 0.99), landmark(2, 5, 0, 0.98), landmark(3, 0, 5, 0.97)]
TUESDAY = [landmark(1, 0, 0, 0.99), landmark(2, 6, 0, 0.96), landmark(3, 0, 5, 0.02), landmark(4, 9, 9, 0.9)]
OF_TUESDAY = """\
2,0,0,20,0,10,1,moved,before,2,tag,5,0,,100,200,,,0.99,,9,9
2,0,10,0,20,0,1,moved,after,2,tag,6,0,,100,200,,,0.99,0.96,9,9
3,0,0,20,0,10,2,vanished,before,3,tag,0,5,,100,180,,,0.98,0.02,9,9
4,0,10,0,20,0,3,appeared,after,4,tag,9,9,,,160,,,0.9,0.9,9,9
"""
AFTER_TUESDAY = [
    ("1", None, None, 0.0, 0.0, None, 0.99),
    ("2", None, 150.0, 5.0, 0.0, None, 1.0), ("2", 150.0, None, 6.0, 0.0, None, 0.96),
    ("3", None, 140.0, 0.0, 5.0, None, 1.0), ("3", 140.0, None, 0.0, 5.0, None, 0.02),
    ("4", 160.0, None, 9.0, 9.0, None, 0.9),
]  # fmt: skip


def test_a_run_of_evermap(tmp_path: Path) -> None:
    table = read_any(write_run(tmp_path / "tue", TUESDAY, OF_TUESDAY, 210.0))
    assert spans(table) == sorted(AFTER_TUESDAY, key=repr)
    last = table[(table.landmark_id == "2") & (table.t_to_s == math.inf)]
    assert last.covariance_m2[0, :2, :2].tolist() == [[0.01, 0.0], [0.0, 0.04]]


def test_runs_that_follow_each_other_are_maps_by_robot_time(tmp_path: Path) -> None:
    write_run(tmp_path / "a", MONDAY, "", 90.0)
    write_run(tmp_path / "b", TUESDAY, OF_TUESDAY, 210.0)
    third = (
        "2,0,0,20,0,10,1,moved,before,2,tag,6,0,,210,300,,,0.99,,9,9\n"
        "2,0,10,0,20,0,1,moved,after,2,tag,7,0,,210,300,,,0.99,0.96,9,9\n"
    )
    write_run(tmp_path / "c", [landmark(2, 7, 0, 0.95)], third, 310.0)
    table = read_any(tmp_path)
    assert table.robot_times_s().tolist() == [90.0, 210.0, 310.0]
    assert [row[1:3] for row in spans(table.select_map(90.0))] == [(None, None)] * 3
    assert spans(table.select_map(210.0)) == sorted(AFTER_TUESDAY, key=repr)
    # the place before has the covariance of the map before
    gone = table.latest()
    gone = gone[(gone.landmark_id == "2") & (gone.t_to_s == 255.0)]
    assert gone.covariance_m2[0, :2, :2].tolist() == [[0.01, 0.0], [0.0, 0.04]]
    of_two = [row for row in spans(table.latest()) if row[0] == "2"]
    assert {row[1:4] for row in of_two} == {(None, 150.0, 5.0), (150.0, 255.0, 6.0), (255.0, None, 7.0)}


def test_such_runs_score_perfectly_against_themselves(tmp_path: Path) -> None:
    write_run(tmp_path / "a", MONDAY, "", 90.0)
    write_run(tmp_path / "b", TUESDAY, OF_TUESDAY, 210.0)
    found = score(tmp_path / "b", tmp_path, draws=0)
    # the moved one has covariances at both places, the one that vanished that of Monday, the new one its own
    assert found["changes/all/any_looks/f1_within_3_sigma"].value == 1.0
    assert found["presence/f1"].value == 1.0
    assert found["changes/moved/any_looks/f1"].value == found["changes/vanished/any_looks/f1"].value == 1.0
    # Monday's map was right about Monday; of Tuesday's map all is right, too
    assert found["changes/delay"].value == pytest.approx((60 + 70 + 50) / 3)


def test_maps_of_evermap(tmp_path: Path) -> None:
    write_run(tmp_path / "run", MONDAY, "", 90.0)
    expected = [(str(row["landmark_id"]), None, None, row["x_m"], row["y_m"], None, row["p_exists"]) for row in MONDAY]
    assert spans(read_any(tmp_path / "run" / "map.parquet")) == expected
    features = [
        {"properties": {k: v for k, v in row.items() if k[1:] != "_m"} | {"kind": "landmark"},
         "geometry": {"type": "Point", "coordinates": [row["x_m"], row["y_m"]]}}
        for row in MONDAY
    ]  # fmt: skip
    features.append({"properties": {"kind": "ellipse_2sigma"}, "geometry": {"type": "Polygon", "coordinates": []}})
    assert spans(read_any(write(tmp_path / "map.geojson", {"features": features}))) == expected


def test_changes_of_khronos(tmp_path: Path) -> None:
    # O(1) is ord('O') * 2^56 + 1; absent until 2 s, there from 4 s on; O(2) there until 6 s, absent at 10 s; O(3) was
    # never absent; O(4) absent before 3 s, without evidence of its presence
    nodes = [(ord("O") << 56) + n for n in (1, 2, 3, 4)]
    s = 1_000_000_000
    stamps = [(2 * s, 0, 4 * s, 0), (0, 10 * s, 0, 6 * s), (0, 0, 0, 0), (3 * s, 0, 0, 0)]
    header = "node_id,merged_id,first_absent,last_absent,first_persistent,last_persistent\n"
    lines = [f"{node},0,{','.join(map(str, row))}\n" for node, row in zip(nodes, stamps, strict=True)]
    path = write(tmp_path / "object_changes.csv", header + "".join(lines))
    with pytest.raises(ScoreError, match=r"object_changes.csv:2: no place of object \d+ \(try: objects.csv"):
        read_any(path)
    places = "".join(f"m,0,0,O({n}),chair,{n},{2 * n},.5\n" for n in (1, 2, 3, 4)) + "m,0,1,O(1),chair,9,9,9\n"
    write(tmp_path / "objects.csv", "MapName,QueryTime,IsGT,ID,Label,CentroidX,CentroidY,CentroidZ\n" + places)
    table = read_any(path)
    assert [row[1:6] for row in spans(table)] == [
        (3.0, None, 1.0, 2.0, 0.5), (None, 8.0, 2.0, 4.0, 0.5), (None, None, 3.0, 6.0, 0.5), (3.0, None, 4.0, 8.0, 0.5),
    ]  # fmt: skip
    assert set(table.class_id.tolist()) == {"chair"}


def tag(name: int, x: float) -> dict[str, Any]:
    turn = {"W": 1.0, "X": 0.0, "Y": 0.0, "Z": 0.0}
    return {"ID": name, "pose": {"translation": {"x": x, "y": 1.0, "z": 2.0}, "rotation": {"quaternion": turn}}}


@pytest.mark.parametrize("key", ["tags", "field-tags"])
def test_field_layouts_before_and_after(key: str, tmp_path: Path) -> None:
    before = write(tmp_path / "before.json", {key: [tag(1, 0.0), tag(2, 5.0), tag(3, 8.0)]})
    after = write(tmp_path / "after.json", {key: [tag(1, 0.0), tag(2, 5.5), tag(4, 9.0)]})
    table = read_any(f"{before},{after}@100")
    assert [row[:4] for row in spans(table)] == [
        ("1", None, None, 0.0), ("2", 100.0, None, 5.5), ("2", None, 100.0, 5.0), ("3", None, 100.0, 8.0),
        ("4", 100.0, None, 9.0),
    ]  # fmt: skip
    assert table.in_space
    assert table.quaternion[0].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert [row[1:3] for row in spans(read_any(before))] == [(None, None)] * 3


TAGSLAM = """\
tagslam_parameters:
  pixel_noise: 1.0   # of a corner
bodies:
 - hall:
     is_static: true
     ignore_tags: [20, 24]
     pose:
       position: &ref
         x: 1
         y: 0
         z: 0
       rotation:
         x: 0
         y: 0
         z: 1.5707963267948966
     tags:
       - id: 3
         size: 0.15
         pose:
           position:
             x: 2.0
             y: 0
             z: .5
           rotation: {zeros}
       - id: 4
         size: 0.15
 - cart:
     is_static: false
     tags:
     - id: 9
"""


def test_tagslam(tmp_path: Path) -> None:
    zeros = "\n             x: 0\n             y: 0\n             z: 0"
    text = TAGSLAM.replace(" {zeros}", zeros).replace(" &ref", "")
    table = read_any(write(tmp_path / "tagslam.yaml", text))
    # the hall is turned by a quarter: (2, 0, .5) goes to (0, 2, .5), and one metre on
    assert spans(table) == [("3", None, None, 1.0, 2.0, 0.5, 1.0)]
    assert table.size_m[0].tolist() == [0.15, 0.15, 0.0]


def test_tables_with_an_id(tmp_path: Path) -> None:
    path = write(tmp_path / "survey.csv", "ID,x,y\n1,1.5,2\n2,3,4\n")
    assert [row[3:6] for row in spans(read_any(path))] == [(1.5, 2.0, None), (3.0, 4.0, None)]
    path = write(tmp_path / "wpilib.csv", "ID,X,Y,Z,Z-Rotation,X-Rotation\n1,100,10,50,0,0\n")
    assert spans(read_any(path))[0][3:6] == (2.54, 0.254, 1.27)


def test_kitti_tracks(tmp_path: Path) -> None:
    text = (
        "0 7 Car 0 0 -1.5 1 2 3 4 1.5 1.6 4.0 2.0 1.65 10.0 -1.57\n"
        "1 7 Car 0 0 -1.5 1 2 3 4 1.5 1.6 4.0 2.0 1.65 9.0 -1.57 0.75\n"
        "1 -1 DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\n"
    )
    table = read_any(write(tmp_path / "0000.txt", text))
    # 2 m to the right, the floor 1.65 m below the camera, 1.5 m high; 10 m ahead
    assert spans(table) == [("7", 0.0, 0.1, 10.0, -2.0, -0.9, 1.0), ("7", 0.1, 0.2, 9.0, -2.0, -0.9, 0.75)]
    assert table.size_m[0].tolist() == [4.0, 1.6, 1.5]


def test_rescans(tmp_path: Path) -> None:
    # by columns: a quarter about z and 2 m along x takes the chair (1, 0, 0) to (2, 1, 0) in the rescan, whose frame is
    # 10 m below that of the reference; the lamp is removed in the second rescan; the plant bends
    turn = [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 2, 0, 0, 1]
    lower = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 10, 1]
    same = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    move = {"instance_reference": 1, "instance_rescan": 1, "symmetry": 0, "transform": turn}
    scans = [
        {"reference": "s1", "transform": lower, "rigid": [move], "removed": [], "nonrigid": [3]},
        {"reference": "s2", "transform": same, "rigid": [], "removed": [2], "nonrigid": []},
    ]
    path = write(tmp_path / "3RScan.json", [{"reference": "r", "type": "train", "scans": scans}])
    with pytest.raises(ScoreError, match="no scene has its boxes"):
        read_any(path)
    boxes = ((1, "chair", [1, 0, 0]), (2, "lamp", [4, 4, 1]), (3, "plant", [5, 5, 0]))
    groups = [{"objectId": n, "label": name, "obb": {"centroid": at}} for n, name, at in boxes]
    write(tmp_path / "r" / "semseg.v2.json", {"segGroups": groups})
    assert spans(read_any(path)) == sorted(
        [
            ("r/1", 0.0, 1.0, 1.0, 0.0, 0.0, 1.0), ("r/1", 1.0, 2.0, 2.0, 1.0, 10.0, 1.0),
            ("r/1", 2.0, None, 1.0, 0.0, 0.0, 1.0), ("r/2", 0.0, 2.0, 4.0, 4.0, 1.0, 1.0),
        ],
        key=repr,
    )  # fmt: skip
    scans[0]["rigid"] = [17]  # as in the test split
    with pytest.raises(ScoreError, match="withheld"):
        read_any(write(path, [{"reference": "r", "scans": scans}]))


def test_a_table_of_episodes_is_read_as_such(tmp_path: Path) -> None:
    table = episodes_from_rows([{"landmark_id": "a", "t_from_s": 1, "t_to_s": None, "x_m": 0, "y_m": 0}])
    write_episodes(table, tmp_path / "a.csv")
    assert rows_of(read_any(tmp_path / "a.csv")) == rows_of(table)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("bad.json", "{}", "not a field layout, tagslam.yaml, or table"),
        ("bad.json", "{", "not a field layout, tagslam.yaml, or table"),
        ("bad.json", '{"tags": []}', "without landmarks"),
        ("bad.yaml", "bodies: 3\n", "not a field layout, tagslam.yaml, or table"),
        ("bad.yaml", "just words\n", "not a field layout, tagslam.yaml, or table"),
        ("bad.csv", "id,u,v\n1,2,3\n", "not a field layout, tagslam.yaml, or table"),
        ("bad.txt", "1 2 3\n", "bad.txt:1: not a label of KITTI tracking"),
        ("bad.geojson", "[]", "not a map in GeoJSON"),
        ("[].json", "[1]", "not 3RScan.json"),
        ("bad.csv", "node_id,first_absent,last_absent\n1,2,3\n", "bad.csv:2: not a row of object_changes.csv"),
        ("bad.csv", "landmark_id,p_exists\n1,1\n", "x_m or y_m is missing"),
        ("folder/bad.csv", "", "neither a run of evermap nor a folder of runs"),
    ],
)
def test_what_is_none_is_one_line(name: str, text: str, message: str, tmp_path: Path) -> None:
    path = write(tmp_path / name, text)
    with pytest.raises(ScoreError) as error:
        read_any(path.parent if "folder" in name else path)
    assert message in str(error.value)
    assert str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)
