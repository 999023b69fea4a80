"""One noun, one meaning, one class; and a class name means one thing in the library."""

from __future__ import annotations

import ast
import importlib
import re
from collections import defaultdict
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
ROW = re.compile(r"^\| (?P<noun>[a-z ]+) \| (?P<meaning>[^|]+) \| `(?P<path>[\w.]+)` \|", re.MULTILINE)
TERMS = list(ROW.finditer((REPOSITORY / "docs" / "glossary.md").read_text(encoding="utf-8")))


def test_there_are_at_most_thirty_nouns_each_with_a_class_of_its_own() -> None:
    assert 20 <= len(TERMS) <= 30
    assert len({term["noun"] for term in TERMS}) == len(TERMS)
    assert len({term["path"] for term in TERMS}) == len(TERMS)


@pytest.mark.parametrize("term", TERMS, ids=lambda term: term["noun"])
def test_the_class_of_a_noun_exists(term: re.Match[str]) -> None:
    module, _, name = term["path"].rpartition(".")
    found = getattr(importlib.import_module(module), name)  # moved? renew the row of docs/glossary.md
    assert isinstance(found, type)
    assert f"{found.__module__}.".startswith(f"{module}."), f"{name} is defined in {found.__module__}"


def test_a_class_name_is_used_once_in_the_library() -> None:
    homes = defaultdict(list)
    for path in sorted((REPOSITORY / "src" / "evermap").rglob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(path.relative_to(REPOSITORY).as_posix())
    several = {name: paths for name, paths in homes.items() if len(paths) > 1}
    assert not several, "a class of this name exists already"
