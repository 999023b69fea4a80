"""A few bad rows are left out and counted; many are an error that says so."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import evermap as em
from evermap.errors import InputError
from evermap.io import read_recording

ROWS = 400
Files = dict[str, str]


def plane() -> dict[str, list[list[str]]]:
    """Lines of cells of a drive along a line past four landmarks."""
    at = np.array([[3.0, 2.0], [8.0, -2.0], [12.0, 2.5], [18.0, -1.0]])
    odometry = [[f"{0.05 * k:.2f}", "1.0", "0.0"] for k in range(ROWS)]
    seen = []
    for k in range(ROWS):
        here = at[k % 4] - [0.05 * k, 0.0]
        seen.append([f"{0.05 * k:.2f}", str(k % 4), f"{np.hypot(*here):.4f}", f"{np.arctan2(here[1], here[0]):.4f}"])
    return {"odometry": odometry, "detections": seen}


HEADS = {
    "odometry": "stamp_s,forward_mps,angular_radps",
    "detections": "stamp_s,landmark_id,range_m,bearing_rad",
}


def text_of(name: str, rows: list[list[str]]) -> str:
    return "\n".join([HEADS[name], *map(",".join, rows)]) + "\n"


def written(folder: Path, tables: dict[str, list[list[str]]]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, rows in tables.items():
        (folder / f"{name}.csv").write_text(text_of(name, rows))
    return folder


@pytest.mark.parametrize(
    ("table", "column", "cell", "said"),
    [
        ("detections", 2, "-2", r"detections\.csv: 1 of 400 rows left out: range_m: -2 where a number greater than"),
        ("detections", 2, "0", "1 of 400 rows left out: range_m: 0 where"),
        ("detections", 2, "inf", "1 of 400 rows left out: range_m: inf where a finite number"),
        ("detections", 2, "", r"1 of 400 rows left out: range_m: is empty \(line 42\)"),
        ("detections", 2, "N/A", "1 of 400 rows left out: range_m: 'N/A' is not a number"),
        ("detections", 3, "400", r"1 of 400 rows left out: bearing_rad: 400 is outside"),
        ("detections", 0, "nan", "1 of 400 rows left out: stamp_s: nan"),
        ("detections", 0, "17.123", r"1 of 400 rows out of order sorted \(time runs backwards at line 43\)"),
        ("odometry", 1, "nan", r"odometry\.csv: 1 of 400 rows left out: forward_mps: nan"),
        ("odometry", 0, "1.95", r"odometry\.csv: 1 row with the stamp of the next row left out"),
    ],
)
def test_one_bad_row_is_left_out_and_counted(table: str, column: int, cell: str, said: str, tmp_path: Path) -> None:
    tables = plane()
    whole = read_recording(written(tmp_path / "whole", plane()))
    tables[table][40][column] = cell
    if cell == "1.95":
        tables[table][40][column] = tables[table][41][column]
    found = read_recording(written(tmp_path / "drive", tables))
    assert any(re.search(said, remark) for remark in found.warnings), found.warnings
    lost = len(whole.detections) - len(found.detections), len(whole.odometry) - len(found.odometry)
    sorted_only = "sorted" in said
    assert lost == ((0, 0) if sorted_only else (1, 0) if table == "detections" else (0, 1))
    assert any(remark in em.check_recording(found).warnings for remark in found.warnings)


def test_ragged_lines_and_bad_cells_are_counted_apart(tmp_path: Path) -> None:
    tables = plane()
    tables["detections"][10].append("7")
    tables["detections"][11].pop()
    tables["detections"][12][2] = "-1"
    tables["detections"][13][3] = "x"
    found = read_recording(written(tmp_path / "drive", tables))
    assert len(found.detections) == ROWS - 4
    remarks = " ".join(found.warnings)
    assert "2 of 400 rows left out: 5 cells instead of 4" in remarks
    assert "2 of 398 rows left out: range_m: -1 where" in remarks
    assert "bearing_rad: 'x' is not a number (line 15)" in remarks
    assert set(found.detections.source_line.tolist()) == set(range(2, ROWS + 2)) - {12, 13, 14, 15}


@pytest.mark.parametrize(("bad", "refused"), [(20, False), (21, True)])
def test_beyond_one_in_twenty_the_file_is_refused(bad: int, refused: bool, tmp_path: Path) -> None:
    tables = plane()
    for row in range(bad):
        tables["detections"][3 * row][2] = "-1"
    folder = written(tmp_path / "drive", tables)
    if not refused:
        assert len(read_recording(folder).detections) == ROWS - bad
        return
    with pytest.raises(InputError, match=r"csv:2: field 'range_m': -1 where .*, and 20 more of 400 rows are bad"):
        read_recording(folder)


def test_a_clock_that_was_set_back_is_no_stray_row(tmp_path: Path) -> None:
    tables = plane()
    for row in range(200, ROWS):
        tables["detections"][row][0] = f"{0.05 * (row - 190):.2f}"
    with pytest.raises(InputError, match="time runs backwards by"):
        read_recording(written(tmp_path / "drive", tables))


def test_texts_that_say_unknown_are_no_landmark(tmp_path: Path) -> None:
    tables = plane()
    for row, word in enumerate(("None", "unknown", "NULL", "?", "door")):
        tables["detections"][row][1] = word
    found = read_recording(written(tmp_path / "drive", tables))
    assert (found.detections.landmark_id < 0).sum() == 4
    assert set(found.landmark_names.values()) == {"door"}


def test_bad_rows_in_space(space: Files, lay_out: Callable) -> None:
    """Quaternions of zeros in detections are none; in odometry they are bad rows; a pixel far outside the image is."""
    steps = [f"{0.1 * k:.1f},{0.1 * k:.1f},0,0,0,0,0,1,," for k in range(100)]
    steps[30] = "3.0,3.0,0,0,0,0,0,0,,"
    steps[31] = "3.1,nan,0,0,0,0,0,1,,"
    seen = [f"{0.1 * k:.1f},7,1,2,3,0,0,0,1" for k in range(100)]
    seen[20] = "2.0,7,1,2,3,0,0,0,0"
    seen[21] = "2.1,7,1,2,inf,0,0,0,1"
    seen[22] = "2.2,7,0,0,0,0,0,0,1"
    seen[23] = "2.3,7,1,2,3,0,0,0.5,0.5"
    files = {
        "odometry.csv": "\n".join([space["odometry.csv"].split("\n")[0], *steps]) + "\n",
        "detections.csv": "\n".join(["stamp_s,landmark_id,x_m,y_m,z_m,qx,qy,qz,qw", *seen]) + "\n",
    }
    found = read_recording(lay_out(files))
    assert len(found.odometry) == 98
    assert len(found.detections) == 97
    assert np.isnan(found.detections.rotation).all(axis=1).sum() == 1
    remarks = " ".join(found.warnings)
    assert "1 orientation of four zeros taken as unknown" in remarks
    assert "1 of 100 rows left out: z_m: inf" in remarks
    assert "2 of 99 rows left out: qx, qy, qz, qw: is not a unit quaternion, its length is 0.707107" in remarks
    assert "odometry.csv: 1 of 99 rows left out: qx, qy, qz, qw: is not a unit quaternion, its length is 0" in remarks


def test_corners_outside_the_image(lay_out: Callable) -> None:
    camera = (
        "[camera.front]\nintrinsics = [400.0, 400.0, 320.0, 240.0]\nresolution_px = [640, 480]\n[tags]\nsize_m = 0.2\n"
    )
    corner = "300,260,340,260,340,220,300,220"
    seen = [f"{0.1 * k:.1f},7,{corner}" for k in range(100)]
    seen[5] = "0.5,7,3000,260,3040,260,3040,220,3000,220"
    files = {
        "camera.toml": camera,
        "odometry.csv": "stamp_s,x_m,y_m,z_m,qx,qy,qz,qw\n"
        + "".join(f"{0.1 * k:.1f},0,0,0,0,0,0,1\n" for k in range(100)),
        "detections.csv": "stamp_s,landmark_id,u0_px,v0_px,u1_px,v1_px,u2_px,v2_px,u3_px,v3_px\n"
        + "\n".join(seen)
        + "\n",
    }
    found = read_recording(lay_out(files))
    assert len(found.detections) == 99
    assert any("lies outside the image" in remark for remark in found.warnings)
    files["camera.toml"] = camera.replace("640, 480", "200, 150")
    found = read_recording(lay_out(files))
    assert any("100 tags of 100 lie outside the image (front 200 x 150)" in remark for remark in found.warnings)
