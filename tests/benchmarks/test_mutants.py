"""Mutants: one change each, in code that runs, and the tests that call it decide."""

from __future__ import annotations

import ast
import json
import random
from pathlib import Path

import pytest

from benchmarks import mutants

CODE = '''
"""A module."""


def clipped(value: float, most: float = 3.0) -> float:
    """Return a value, at most so much."""
    if value > most:
        return most
    return value + 0


def unused(value: int) -> int:
    return value * 2
'''
TESTS = """
from evermap.maps.toy import clipped


def test_clipped():
    assert clipped(5.0) == 3.0
    assert clipped(1.0) == 1.0
"""


def test_a_mutant_is_the_file_with_one_change() -> None:
    files = sorted((mutants.ROOT / "src" / "evermap" / "explain").glob("*.py"))
    every = [one for path in files for one in mutants.mutants_of(path)]
    for one in random.Random(0).sample(every, 60):
        before = (mutants.ROOT / "src" / one.path).read_text(encoding="utf-8")
        after = mutants.source_of(one)
        assert ast.dump(ast.parse(after)) != ast.dump(ast.parse(before)), one
        changed = [k for k, (a, b) in enumerate(zip(before.splitlines(), after.splitlines(), strict=False)) if a != b]
        assert changed, one
        assert changed[0] + 1 >= one.first_line, one


@pytest.mark.slow
def test_what_no_test_notices_survives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a comparison, a default, a negated condition, and a sum: `>` to `>=` and `+ 0` to `- 0` have no effect."""
    for path, text in (("src/evermap/maps/toy.py", CODE), ("tests/maps/test_toy.py", TESTS)):
        (tmp_path / path).parent.mkdir(parents=True)
        (tmp_path / path).write_text(text, encoding="utf-8")
    (tmp_path / "src/evermap/__init__.py").touch()
    (tmp_path / "pytest.ini").write_text("[pytest]\n", encoding="utf-8")
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    out = tmp_path / "rows.jsonl"
    assert mutants.main(["maps", "--out", str(out)]) == 4
    fate = {(row["function"], row["what"]): row["fate"] for row in map(json.loads, out.read_text().splitlines())}
    assert fate == {
        ("clipped", "3.0 to 6.0"): "noticed",
        ("clipped", "Gt to GtE"): "survived",
        ("clipped", "condition negated"): "noticed",
        ("clipped", "Add to Sub"): "survived",
        ("clipped", "0 to 1"): "noticed",
        ("unused", "Mult to Div"): "unreached",
        ("unused", "2 to 4"): "unreached",
    }
    told = capsys.readouterr().out
    assert "survived: src/evermap/maps/toy.py:7 clipped: Gt to GtE" in told
    assert mutants.main(["maps", "--out", str(out)]) == 0, "rows that are there are not run again"
    assert len(out.read_text().splitlines()) == len(fate)


def test_whether_lengths_are_compared_is_not_mutated() -> None:
    (function,) = [
        one for _, one in mutants.functions_of(ast.parse("def f(a, b): return dict(zip(a, b, strict=True))"))
    ]
    assert [what for node in mutants.nodes_of(function) for what, _ in mutants.changes_of(node)] == []


@pytest.mark.parametrize("name", ["kernel", "inlined", "vectorised", "njit(cache=True)"])
def test_what_is_compiled_is_not_mutated(name: str) -> None:
    assert list(mutants.functions_of(ast.parse(f"@{name}\ndef f(a):\n    return a + 1"))) == []
