"""The table of lifetimes: read as it was written, and parted into groups that are a partition."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.runs.track.lifetimes import LifetimeTable, groups_of, lifetimes_csv, parse_by, read_lifetimes
from evermap.survival.censored import CensoredLifetimes
from evermap.types import UNKNOWN, Clock

seconds = st.floats(0.0, 1e9)
places = st.floats(-1e6, 1e6)


@st.composite
def tables(draw: st.DrawFn) -> LifetimeTable:
    n = draw(st.integers(1, 8))
    column = st.lists(seconds, min_size=n, max_size=n)
    left, longer, entry = (np.array(draw(column)) for _ in range(3))
    right = np.maximum(np.where(draw(st.lists(st.booleans(), min_size=n, max_size=n)), np.inf, left + longer), 1.0)
    weight = 1.0 + np.array(draw(column))
    class_of_row = np.array(draw(st.lists(st.integers(UNKNOWN, 2), min_size=n, max_size=n)))
    xy = np.array(draw(st.lists(st.tuples(places, places), min_size=n, max_size=n)))
    data = CensoredLifetimes(left, right, np.minimum(entry, 0.5 * right), weight)
    return LifetimeTable(data, ("a", "b", "c"), class_of_row, xy, True, True, "", np.arange(n) + 2)


@given(table=tables())
def test_what_is_written_is_read(table: LifetimeTable, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("lifetimes") / "l.csv"
    names = (*table.class_names, "")
    which = np.where(table.class_of_row == UNKNOWN, 3, table.class_of_row)
    path.write_bytes(lifetimes_csv(table.data, names, which, table.position_m))
    assert read_lifetimes(path).began_s is None
    began_s = 1e9 + np.arange(len(table)) / 8.0
    for clock in (Clock.UNIX, Clock.LOCAL_WALL):
        path.write_bytes(lifetimes_csv(table.data, names, which, table.position_m, began_s, clock))
        again = read_lifetimes(path)
        np.testing.assert_array_equal(again.began_s, began_s)
        assert again.clock is clock
    for name in CensoredLifetimes.__slots__:
        np.testing.assert_array_equal(getattr(again.data, name), getattr(table.data, name))
    np.testing.assert_array_equal(again.position_m, table.position_m)
    assert [(*again.class_names, "")[k] for k in again.class_of_row] == [names[k] for k in which]


@given(table=tables(), by=st.sampled_from(["", "class", "chunk", "class,chunk"]), chunk_m=st.floats(0.1, 1e4))
def test_groups_part_the_rows(table: LifetimeTable, by: str, chunk_m: float) -> None:
    groups = groups_of(table, parse_by(by), chunk_m)
    assert sorted(row for group in groups for row in group.rows.tolist()) == list(range(len(table)))
    assert len({group.label for group in groups}) == len(groups)
    for group in groups:
        if group.class_id is not None:
            assert {(*table.class_names, "")[k] for k in table.class_of_row[group.rows]} == {group.class_id}
        if group.chunk is not None:
            corner = np.array(group.chunk) * chunk_m
            inside = table.position_m[group.rows] - corner
            assert (inside >= -1e-6 * (1.0 + abs(corner))).all()
            assert (inside <= chunk_m + 1e-6 * (1.0 + abs(corner))).all()


def test_parquet_is_read_as_csv_is(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({"left": [1.0, 2.0], "right": [3.0, None], "class_id": [7, 7]}), tmp_path / "l.parquet")
    (tmp_path / "l.csv").write_text("left,right,class_id\n1,3,7\n2,,7\n")
    a, b = read_lifetimes(tmp_path / "l.parquet"), read_lifetimes(tmp_path / "l.csv")
    assert a.class_names == b.class_names == ("7",)
    np.testing.assert_array_equal(a.data.right_s, b.data.right_s)
