"""Confusion of classes: read by name whatever the order, and used as the probability that it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evermap.errors import EvermapError
from evermap.tracking.detections import read_confusion, read_detections
from evermap.tracking.run import run_track

CLASSES = ("bus", "car")


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "confusion.csv"
    path.write_text(text)
    return path


def test_rows_and_columns_in_any_order(tmp_path: Path) -> None:
    matrix = read_confusion(write(tmp_path, "car,class_id,bus\n0.7,car,0.3\n0.1,bus,0.9\n"), CLASSES)
    np.testing.assert_array_equal(matrix, [[0.9, 0.1], [0.3, 0.7]])


def test_class_of_an_object_is_bayes_theorem(tmp_path: Path) -> None:
    """Twelve detections in one place, four of them as a bus."""
    rows = "".join(f"{0.1 * k:.1f},0,0,0,{'bus' if k % 3 == 0 else 'car'}\n" for k in range(12))
    path = tmp_path / "d.csv"
    path.write_text(f"stamp_s,x_m,y_m,z_m,class_id\n{rows}")
    matrix = np.array([[0.6, 0.4], [0.3, 0.7]])
    result = run_track(read_detections(path), confusion=matrix)
    likelihood = matrix[:, 0] ** 4 * matrix[:, 1] ** 8
    np.testing.assert_allclose(result.tracks.class_p[-1], likelihood / likelihood.sum(), rtol=1e-9)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("class_id,bus,car\nbus,0.9,0.1\n", "field 'class_id': has no row for class 'car'"),
        ("class_id,bus,car\nbus,0.9,0.1\nbus,0.9,0.1\n", ":3: field 'class_id': class 'bus' appears twice"),
        ("class_id,bus,car\nbus,0.9,0.2\ncar,0,1\n", ":2: the row sums to 1.1"),
        ("class_id,bus,car\nbus,90,10\n", ":2: field 'bus': 90 is outside [0, 1]"),
        ("class_id,bus,car\nvan,0.9,0.1\n", ":2: field 'class_id': no detection is of class 'van'"),
        ("class_id,bus\nbus,1\n", "field 'car': missing column"),
    ],
)
def test_mistake_names_line_and_field(text: str, named: str, tmp_path: Path) -> None:
    with pytest.raises(EvermapError) as error:
        read_confusion(write(tmp_path, text), CLASSES)
    assert named in error.value.one_line()
