"""Reading tables of looks, and every way in which they can be wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from evermap.errors import ConfigError, InputError
from evermap.runs.persist.table import LookTable, Truth, read_looks, read_truth

HEADER = "stamp_s,feature_id,detected"


def read(tmp_path: Path, content: str, **options: float) -> LookTable:
    path = tmp_path / "looks.csv"
    path.write_text(content)
    return read_looks(path, **options)


def test_all_columns_in_any_order_of_rows(tmp_path: Path) -> None:
    table = read(
        tmp_path,
        "present,class_id,p_false,p_miss,detected,feature_id,stamp_s\n"
        "1,door,,0.2,1,b,5\n,,0.3,,0,a,1\n0,door,,,,b,3\n1,,,,true,a,0\n",
        p_miss=0.15,
        p_false=0.05,
    )
    assert table.names == ("a", "b")
    np.testing.assert_array_equal(table.feature, [1, 0, 1, 0])
    np.testing.assert_array_equal(table.detected, [1.0, 0.0, np.nan, 1.0])
    np.testing.assert_array_equal(table.p_miss, [0.2, 0.15, 0.15, 0.15])
    np.testing.assert_array_equal(table.p_false, [0.05, 0.3, 0.05, 0.05])
    np.testing.assert_array_equal(table.present, [1.0, np.nan, 0.0, 1.0])
    assert table.class_names == ("door",)
    np.testing.assert_array_equal(table.class_of_feature, [-1, 0])
    assert table.span.last_look_s == 5.0

    looks = table.looks(table.order())
    np.testing.assert_array_equal(looks.first, [0, 2, 3])
    np.testing.assert_array_equal(looks.stamp_s, [0.0, 1.0, 5.0])
    np.testing.assert_array_equal(looks.detected, [1.0, 0.0, 1.0])
    np.testing.assert_array_equal(looks.p_false, [0.05, 0.3, 0.05])
    truth = table.truth(table.order())
    assert truth is not None
    np.testing.assert_array_equal(truth.first, [0, 1, 3])
    np.testing.assert_array_equal(truth.present, [1.0, 0.0, 1.0])


def test_parquet_gives_the_same(tmp_path: Path) -> None:
    content = {"stamp_s": [1, 0], "feature_id": [7, 3], "detected": pa.array([None, True])}
    pq.write_table(pa.table(content), tmp_path / "looks.parquet")
    table = read_looks(tmp_path / "looks.parquet")
    assert table.names == ("3", "7")
    np.testing.assert_array_equal(table.feature, [1, 0])
    np.testing.assert_array_equal(table.detected, [np.nan, 1.0])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("stamp_s,detected\n1,1\n", r":1: field 'feature_id': missing column \(try: add it, .* only one feature"),
        ("stamp_s,feature_id,present\n1,a,1\n", r":1: field 'detected': missing column \(try: the detector's output"),
        ("stamp_s,feature,detected\n1,a,1\n", r":1: field 'feature': unknown column \(try: feature_id\)"),
        (f"{HEADER},p_mis\n1,a,1,0\n", r":1: field 'p_mis': unknown column \(try: p_miss\)"),
        (f"{HEADER},weight\n1,a,1,0\n", r":1: field 'weight': unknown column \(try: one of "),
        ("feature_id,detected\na,1\n", r":1: field 'stamp_s': missing column"),
        (f"{HEADER}\n", r"looks\.csv: has no rows"),
        ("", r"looks\.csv: is empty"),
        (f"{HEADER}\nnan,a,1\n", r":2: field 'stamp_s': nan where a finite number is needed \(try: stamps in seconds"),
        (f"{HEADER}\n,a,1\n", r":2: field 'stamp_s': is empty"),
        (f"{HEADER}\n1,a,1\n2024-01-01,a,1\n", r":3: field 'stamp_s': '2024-01-01' is not a number"),
        (f"{HEADER}\n1.7e18,a,1\n", r":2: field 'stamp_s': .* is outside .* not in milli- or nanoseconds"),
        (f"{HEADER}\n1,a,2\n", r":2: field 'detected': '2' is neither 1 nor 0"),
        (f"{HEADER}\n1,a,0.7\n", r":2: field 'detected': '0\.7' is neither 1 nor 0"),
        (f"{HEADER}\n1,a,\n2,a,nan\n", r"field 'detected': no row is a look"),
        (f"{HEADER}\n1,,1\n", r":2: field 'feature_id': is empty"),
        (f"{HEADER},p_miss\n1,a,1,0.1\n1,a,1,1.5\n", r":3: field 'p_miss': 1\.5 is outside \[0, 1\]"),
        (f"{HEADER},p_false\n1,a,1,-0.1\n", r":2: field 'p_false': -0\.1 is outside \[0, 1\]"),
        (f"{HEADER},present\n1,a,1,maybe\n", r":2: field 'present': 'maybe' is neither 1 nor 0"),
        (f"{HEADER},class_id\n1,a,1,x\n2,a,1,\n3,a,1,y\n", r":4: field 'class_id': feature 'a' is 'y' here and 'x'"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, content: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read(tmp_path, content)


def test_defaults_must_be_probabilities(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"field 'p_miss': 2 is not a probability"):
        read(tmp_path, f"{HEADER}\n1,a,1\n", p_miss=2)


def test_truth_holds_until_the_next_sample_and_not_beyond_the_last() -> None:
    truth = Truth(np.array([0, 3, 3, 5]), np.array([1.0, 2.0, 4.0, 0.0, 10.0]), np.array([1.0, 0.0, 1.0, 0.0, 1.0]))
    feature = np.array([2, 0, 0, 0, 0, 0, 0, 1, 2, 2, 2])
    asked = np.array([10.1, 0.9, 1.0, 1.9, 2.0, 3.9, 4.0, 2.0, 0.0, 9.9, 10.0])
    expected = [np.nan, np.nan, 1.0, 1.0, 0.0, 0.0, 1.0, np.nan, 0.0, 0.0, 1.0]
    np.testing.assert_array_equal(truth.at(feature, asked), expected)
    nothing = Truth(np.array([0, 0]), np.zeros(0), np.zeros(0))
    np.testing.assert_array_equal(nothing.at(np.array([0]), np.array([1.0])), [np.nan])


@pytest.mark.parametrize("seed", range(3))
def test_truth_equals_a_search_for_each_instant(seed: int) -> None:
    rng = np.random.default_rng(seed)
    per_feature = [np.unique(rng.integers(0, 50, rng.integers(0, 9)) / 2.0) for _ in range(6)]
    first = np.concatenate([[0], np.cumsum([len(times) for times in per_feature])])
    stamps = np.concatenate(per_feature)
    truth = Truth(first, stamps, (rng.random(len(stamps)) < 0.5).astype(float))
    feature, asked = rng.integers(0, 6, 200), rng.integers(-4, 60, 200) / 2.0
    for f, t, found in zip(feature, asked, truth.at(feature, asked), strict=True):
        times = per_feature[f]
        k = np.searchsorted(times, t, side="right") - 1
        known = len(times) > 0 and k >= 0 and t <= times[-1]
        np.testing.assert_equal(found, truth.present[first[f] + k] if known else np.nan)


def test_truth_from_a_file(tmp_path: Path) -> None:
    looks = read(tmp_path, f"{HEADER}\n1,a,1\n3,b,0\n")
    path = tmp_path / "truth.csv"
    path.write_text("stamp_s,feature_id,present\n4,b,1\n0,b,0\n0,stranger,1\n2,b,\n")
    truth, remarks = read_truth(path, looks)
    np.testing.assert_array_equal(truth.first, [0, 0, 2])
    np.testing.assert_array_equal(truth.present, [0.0, 1.0])
    assert remarks == ("truth.csv: 1 feature without looks ignored",)
    path.write_text("stamp_s,feature_id,present\n0,c,1\n")
    with pytest.raises(InputError, match=r"truth\.csv: field 'feature_id': contains none of the features of .*'a'"):
        read_truth(path, looks)
