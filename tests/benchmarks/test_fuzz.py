"""A slice of the fuzz of all readers; `python -m benchmarks.fuzz` runs the whole of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import fuzz

FILES = 40
FEWER = 4
"""Files of kinds that take long to read, in the quick tests."""
LONG = ("bags", "models", "maps", "old-maps")
"""Beginnings of their names."""
NIGHTLY = ("bags-mcap", "bags-sqlite", "old-maps")
"""Of kinds that are read alike one is quick."""
KINDS = [
    "maps", "old-maps", "models", "config", "looks-csv", "looks-parquet", "detections-csv", "detections-parquet",
    "lifetimes-csv", "lifetimes-parquet", "landmarks-csv", "landmarks-parquet", "landmarks-geojson", "recording-zip",
    "bags-ros1", "bags-mcap", "bags-sqlite", "pose-graphs", "no-recordings", "recording-csv", "tum", "priors",
]  # fmt: skip
TOLERANT = "recording-csv"
"""Kind of which single bad rows are left out."""
NAMED = "no-recordings"
"""Kind that is named for what it is, whatever its content."""


def test_the_slice_has_every_kind(tmp_path: Path) -> None:
    assert list(fuzz.kinds(tmp_path)) == KINDS


@pytest.mark.parametrize(
    ("name", "files"),
    [(name, FEWER if name.startswith(LONG) else FILES) for name in KINDS if name not in NIGHTLY]
    + [pytest.param(name, FILES, marks=pytest.mark.slow) for name in KINDS if name.startswith(LONG)],
)
def test_mutated_files_give_a_line_or_what_was_written(name: str, files: int, tmp_path: Path) -> None:
    kind = fuzz.kinds(tmp_path)[name]()
    folder = tmp_path / "files"
    folder.mkdir()
    counts = fuzz.run(kind, files, 1, folder)
    assert sum(counts.values()) == files
    told = counts["line"] + (counts["other"] if name == TOLERANT else 0)
    assert told > files / 4 or name == NAMED
    assert not counts.keys() - {"same", "other", "line"}, counts
