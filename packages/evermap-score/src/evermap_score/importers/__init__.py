"""Importers: files of others as tables of episodes; `read_any` finds out which one is meant."""

from __future__ import annotations

import re
from pathlib import Path

from evermap_score.episodes import NEEDED, Episodes, episodes_from_rows, read_rows
from evermap_score.errors import ScoreError
from evermap_score.importers.evermap import read_map, read_run, read_runs
from evermap_score.importers.khronos import read_khronos
from evermap_score.importers.kitti import read_kitti
from evermap_score.importers.rescans import read_rescans
from evermap_score.importers.surveys import read_survey, read_surveys

__all__ = [
    "read_any",
    "read_khronos",
    "read_kitti",
    "read_map",
    "read_rescans",
    "read_run",
    "read_runs",
    "read_survey",
    "read_surveys",
]

_PAIR = re.compile(r"(?P<before>[^,]+),(?P<after>[^,@]+)(?:@(?P<stamp_s>[-+.\deE]+))?")


def read_any(source: str | Path) -> Episodes:
    """Read a table of episodes, or what an importer knows, by what is in the file.

    Args:
        source: a file, a folder of a run or of runs, or two surveys as BEFORE,AFTER or BEFORE,AFTER@SECONDS.

    Raises:
        ScoreError: it is missing, or nothing that is known.
    """
    path = Path(source)
    if path.is_dir():
        return read_run(path) if (path / "map.parquet").is_file() else read_runs(path)
    if not path.is_file():
        pair = _PAIR.fullmatch(str(source))
        if pair is None:
            raise ScoreError("no such file or folder", path=path)
        try:
            stamp_s = float(pair["stamp_s"] or 0.0)
        except ValueError:
            raise ScoreError(f"not a number after @: {pair['stamp_s']}", path=path) from None
        return read_surveys(pair["before"], pair["after"], stamp_s)
    if path.suffix in (".csv", ".parquet"):
        rows = read_rows(path)
        names = set(rows[0]) if rows else set(NEEDED)
        if {"node_id", "first_absent", "last_absent"} <= names:
            return read_khronos(path)
        if set(NEEDED) <= names or "t_from_s" in names:
            return episodes_from_rows(rows, path)
        if "p_exists" in names:
            return read_map(path)
        return read_survey(path)
    if path.suffix == ".geojson":
        return read_map(path)
    if path.suffix == ".txt":
        return read_kitti(path)
    if path.suffix == ".json" and path.read_text(encoding="utf-8", errors="replace").lstrip()[:1] == "[":
        return read_rescans(path)
    return read_survey(path)
