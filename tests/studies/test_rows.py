"""Rows of a study that was ended are not run again, and say of which commit they are."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from evermap_studies import rows
from evermap_studies.rows import Row, RowsFile, commit_of_code, run_missing, sources


def test_an_ended_study_runs_only_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[int] = []

    def run_all(keys: list[int]) -> Iterator[Row]:
        for key in keys:
            if key == 3 and len(ran) < 3:
                raise SystemExit  # it was ended here
            ran.append(key)
            yield {"twice": 2 * key}

    file = RowsFile.beside(tmp_path / "out" / "study")
    with pytest.raises(SystemExit):
        list(run_missing(file, [1, 2, 3], run_all))
    assert file.path == tmp_path / "out" / "study.rows.jsonl"
    file.path.write_text(file.path.read_text(encoding="utf-8") + '{"key": 3, "ro', encoding="utf-8")
    ran.append(0)  # a third entry lets it pass
    assert list(run_missing(file, [1, 2, 3], run_all)) == [{"twice": 2}, {"twice": 4}, {"twice": 6}]
    assert ran == [1, 2, 0, 3]
    monkeypatch.setattr(rows, "commit_of_code", lambda: "0000000, 2020-01-01")
    assert [row["twice"] for row in run_missing(file, [1], run_all)] == [2]
    assert ran == [1, 2, 0, 3, 1]  # rows of another commit are none of this table
    file.remove()
    assert file.read() == []


def test_a_row_added_after_half_a_line_is_not_lost(tmp_path: Path) -> None:
    file = RowsFile(tmp_path / "rows")
    file.path.write_text('{"a": 1}\n{"a": ', encoding="utf-8")
    file.add({"a": 3})
    assert file.read() == [{"a": 1}, {"a": 3}]


def test_rows_say_of_which_commits_they_are() -> None:
    one, other = {"commit": "abc1234, 2020-01-01"}, {"commit": "def5678+, 2020-01-02"}
    assert sources([one, one]) == "Rows of commit `abc1234`, 2020-01-01."
    assert sources([other, one, other]) == "Rows of commits `def5678+`, 2020-01-02 (2); `abc1234`, 2020-01-01 (1)."
    assert sources([{"commit": None}, {}]) == ""
    commit = commit_of_code()
    assert commit is None or re.fullmatch(r"[0-9a-f]{8,}\+?, \d{4}-\d\d-\d\d", commit)
