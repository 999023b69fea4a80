"""Rows of a study that are done, kept beside its folder of results, and of which commit the code is that made them.

A study that is ended, in whatever way, goes on from them when it is started again.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from os import SEEK_END
from pathlib import Path
from typing import Any, TypeVar

Row = dict[str, Any]
Key = TypeVar("Key")

ROWS = ".rows.jsonl"
"""End of the name of the file with a line a run, beside the folder of results."""
SOURCES = (":/src", ":/studies", ":/benchmarks")
"""Folders of the code, from the top of the clone."""
CHANGED = "+"
"""Behind a commit: the code differed from it."""


class RowsFile:
    """Lines of JSON, added one by one, and removed once the results are there.

    Args:
        path: of the file, which need not exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def beside(cls, out: str | Path) -> RowsFile:
        """Return the file beside a folder of results."""
        return cls(Path(f"{Path(out)}{ROWS}"))

    def read(self) -> list[Row]:
        """Return the rows of runs that are done; nothing where there is no file."""
        return read_rows(self.path)

    def write(self, rows: list[Row]) -> None:
        """Write all rows anew, also to be rid of a line that was not written whole."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text("".join(f"{json.dumps(row)}\n" for row in rows), encoding="utf-8")

    def add(self, row: Mapping[str, Any]) -> None:
        """Add a row, on a line of its own also where the last one was not written whole."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab+") as lines:
            size = lines.seek(0, SEEK_END)
            lines.seek(max(size - 1, 0))
            before = "" if lines.read(1) in (b"", b"\n") else "\n"
            lines.write(f"{before}{json.dumps(row)}\n".encode())

    def remove(self) -> None:
        """Remove the file: what is in it is in the results."""
        self.path.unlink(missing_ok=True)


def run_missing(file: RowsFile, keys: Sequence[Key], run_all: Callable[[list[Key]], Iterable[Row]]) -> Iterator[Row]:
    """Yield a row for each key, those in the file as they are and the others as they are run and added to it.

    Rows in the file count if the code was of the same commit, so that a table is of one.

    Args:
        file: is read, and added to.
        keys: plain JSON values that distinguish runs, with all settings that they depend on.
        run_all: runs keys, in their order.
    """
    done = {_as_key(line["key"]): line["row"] for line in file.read() if line["commit"] == commit_of_code()}
    found = iter(run_all([key for key in keys if _as_key(key) not in done]))
    for key in keys:
        if _as_key(key) not in done:
            done[_as_key(key)] = row = next(found)
            file.add({"key": key, "commit": commit_of_code(), "row": row})
        yield done[_as_key(key)]


def _as_key(key: Any) -> str:
    return json.dumps(key)


def read_rows(path: Path) -> list[Row]:
    """Return the rows of runs that are done; a last line that was not written whole is none."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
        try:
            rows.append(json.loads(line))
        except ValueError:
            continue
    return rows


@lru_cache(maxsize=1)
def commit_of_code() -> str | None:
    """Return commit and date of the code that runs, as '1a2b3c4d, 2026-01-31'; None outside of a clone.

    A `CHANGED` behind the commit says that sources differed from it.
    """
    here = ["git", "-C", str(Path(__file__).resolve().parent)]
    try:
        asked = (["show", "-s", "--abbrev=8", "--format=%h %cs", "HEAD"], ["status", "--porcelain", *SOURCES])
        head, changed = (
            subprocess.run([*here, *one], capture_output=True, text=True, check=True).stdout  # noqa: S603  (git)
            for one in asked
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    commit, date = head.split()
    return f"{commit}{CHANGED if changed.strip() else ''}, {date}"


def sources(rows: list[Row]) -> str:
    """Return a line that says of which commits rows are, and how many of each; '' where no row knows its own."""
    count: dict[str, int] = {}
    for row in rows:
        if row.get("commit"):
            count[row["commit"]] = count.get(row["commit"], 0) + 1
    if not count:
        return ""
    said = [f"`{one.split(',')[0]}`,{one.split(',')[1]}" for one in count]
    if len(said) == 1:
        return f"Rows of commit {said[0]}."
    return f"Rows of commits {'; '.join(f'{one} ({n})' for one, n in zip(said, count.values(), strict=True))}."
