"""The table of detections: frames as they were, whatever the order of the rows; one line for every mistake."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evermap.errors import EvermapError
from evermap.tracking.detections import read_detections
from evermap.types import UNKNOWN

HEAD = "stamp_s,x_m,y_m,z_m"


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "detections.csv"
    path.write_text(text)
    return path


def test_rows_of_a_stamp_are_a_frame_and_empty_ones_stay(tmp_path: Path) -> None:
    table = read_detections(
        write(tmp_path, f"{HEAD},class_id\n2,5,0,0,car\n1,1,0,0,\n3,,,,\n2,6,0,0,bus\n1,2,0,0,car\n")
    )
    assert table.stamp_s.tolist() == [1.0, 2.0, 3.0]
    assert table.first.tolist() == [0, 2, 4, 4]
    assert table.position_m[:, 0].tolist() == [1.0, 2.0, 5.0, 6.0]
    assert table.class_names == ("bus", "car")
    assert table.class_id.tolist() == [UNKNOWN, 1, 1, 0]
    assert table.line.tolist() == [3, 6, 2, 5]


def test_low_scores_are_left_out_but_their_frames_stay(tmp_path: Path) -> None:
    path = write(tmp_path, f"{HEAD},score\n1,1,0,0,0.9\n2,1,0,0,0.2\n3,1,0,0,\n")
    table = read_detections(path, min_score=0.5)
    assert table.first.tolist() == [0, 1, 1, 2]
    assert table.n_weak == 1


def test_covariance_by_entries_and_by_sigma(tmp_path: Path) -> None:
    entries = ",".join(f"cov_{axes}_m2" for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
    table = read_detections(write(tmp_path, f"{HEAD},{entries}\n1,0,0,0,4,1,0.5,3,0.25,2\n1,1,0,0,,,,,,\n"))
    assert table.covariance_m2 is not None
    np.testing.assert_array_equal(table.covariance_m2[0], [[4, 1, 0.5], [1, 3, 0.25], [0.5, 0.25, 2]])
    assert np.isnan(table.covariance_m2[1]).all()
    table = read_detections(write(tmp_path, f"{HEAD},sigma_m\n1,0,0,0,2\n"))
    assert table.covariance_m2 is not None
    np.testing.assert_array_equal(table.covariance_m2[0], 4.0 * np.eye(3))


def test_appearances_of_some(tmp_path: Path) -> None:
    table = read_detections(write(tmp_path, f"{HEAD},appearance_1,appearance_0\n1,0,0,0,4,3\n1,1,0,0,,\n"))
    assert table.appearance is not None
    assert table.appearance.tolist() == [[3.0, 4.0], [0.0, 0.0]]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (f"{HEAD}\n", "has no rows below its header"),
        (f"{HEAD}\n1,,,\n", "contains no detection"),
        (f"{HEAD}\n1,2,,0\n", ":2: field 'y_m': is empty (try: all of x_m, y_m, z_m, or none for an empty frame)"),
        (f"{HEAD}\nnoon,2,0,0\n", ":2: field 'stamp_s': 'noon' is not a number"),
        (f"{HEAD}\n1e15,2,0,0\n", "stamps in seconds, not in milli- or nanoseconds"),
        ("stamp_s,x_m,y_m\n1,2,3\n", "field 'z_m': missing column"),
        (f"{HEAD},classid\n1,2,0,0,car\n", "unknown column (try: class_id)"),
        (f"{HEAD},score\n1,2,0,0,high\n", ":2: field 'score': 'high' is not a number"),
        (f"{HEAD},length_m\n1,2,0,0,1\n", "field 'width_m': missing column"),
        (f"{HEAD},length_m,width_m,height_m,yaw_rad\n1,2,0,0,4,2,0,1\n", ":2: field 'height_m': 0 where"),
        (f"{HEAD},length_m,width_m,height_m,yaw_rad\n1,2,0,0,4,2,1,\n", ":2: field 'yaw_rad': is empty (try: all four"),
        (f"{HEAD},cov_xx_m2\n1,2,0,0,1\n", "field 'cov_xy_m2': missing column"),
        (
            f"{HEAD},cov_xx_m2,cov_xy_m2,cov_xz_m2,cov_yy_m2,cov_yz_m2,cov_zz_m2\n1,2,0,0,1,2,0,1,0,1\n",
            ":2: field 'cov_xx_m2': is not a covariance",
        ),
        (f"{HEAD},cov_xx_m2,sigma_m\n1,2,0,0,1,1\n", "duplicates sigma_m"),
        (f"{HEAD},sigma_m\n1,2,0,0,0\n", ":2: field 'sigma_m': 0 where a number greater than zero is needed"),
        (f"{HEAD},appearance_1\n1,2,0,0,1\n", "field 'appearance_0': missing column"),
        (f"{HEAD},sensor_x_m\n1,2,0,0,1\n", "field 'sensor_y_m': missing column"),
        (
            f"{HEAD},sensor_x_m,sensor_y_m,sensor_z_m\n1,2,0,0,1,1,1\n1,3,0,0,2,1,1\n",
            ":3: field 'sensor_x_m': the sensor has two positions in one frame",
        ),
    ],
)
def test_mistake_names_line_and_field(text: str, named: str, tmp_path: Path) -> None:
    with pytest.raises(EvermapError) as error:
        read_detections(write(tmp_path, text))
    assert named in error.value.one_line()
    assert "detections.csv" in error.value.one_line()


def test_a_least_score_wants_scores(tmp_path: Path) -> None:
    with pytest.raises(EvermapError, match="has no scores"):
        read_detections(write(tmp_path, f"{HEAD}\n1,2,0,0\n"), min_score=0.5)
