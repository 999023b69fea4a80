"""The page of claims is what the pages of the studies say, and says how each number is computed."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"


def load(name: str) -> ModuleType:
    """Return a script of `docs/gen` as a module; the folder is no package."""
    spec = importlib.util.spec_from_file_location(name, DOCS / "gen" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


results = load("results")


def test_the_page_of_claims_is_the_one_that_is_generated() -> None:
    page = (DOCS / "results.md").read_text(encoding="utf-8")
    assert page == results.claims_page(), "run: python docs/gen/results.py"
    assert len(page.splitlines()) <= 150


def test_every_page_of_a_study_is_listed() -> None:
    assert {path.stem for path in (DOCS / "results").glob("*.md")} == set(results.STUDIES)


@pytest.mark.parametrize("study", results.STUDIES)
def test_a_study_names_its_command_and_has_claims(study: str) -> None:
    text = results.page_of(study).read_text(encoding="utf-8")
    made = results.PROVENANCE.search(text)
    assert made is not None
    assert made["command"].startswith(("evermap ", "python -m benchmarks."))
    assert results.claims(text)


def test_a_page_without_expectations_is_refused() -> None:
    with pytest.raises(ValueError, match="expected"):
        results.claims("| a | b |\n| --- | --- |\n| 1 | 2 |\n")


def test_claims_of_a_table_by_contender_are_those_of_the_first_one() -> None:
    text = "|  | expected [ns] | ours | theirs |\n| --- | --- | --- | --- |\n| x | ≤ 2 | 3 | 1 |\n| y | – | 3 | 1 |\n"
    assert results.claims(text) == [results.Claim("x", "≤ 2 ns", "3 ns", "**no**")]


def test_tables_of_a_run_replace_those_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "results").mkdir()
    (tmp_path / "images").mkdir()
    page = tmp_path / "results" / "mrclam.md"
    page.write_text(
        "Computed by `evermap reproduce mrclam`. Tables of commit `abc1234`, 2020-01-01.\n"
        "![a](../images/mrclam-a.png)\n<!-- mrclam:begin -->\nold\n<!-- mrclam:end -->\nthe end\n",
        encoding="utf-8",
    )
    run = tmp_path / "run"
    run.mkdir()
    (run / "table.md").write_text("new\n", encoding="utf-8")
    (run / "a.png").write_bytes(b"picture")
    monkeypatch.setattr(results, "DOCS", tmp_path)
    monkeypatch.setattr(
        results.subprocess,
        "run",
        lambda *_, **__: type("Done", (), {"stdout": "def5678 2026-01-02\n"})(),
    )
    results.renew("mrclam", run)
    text = page.read_text(encoding="utf-8")
    assert "old" not in text
    assert "<!-- mrclam:begin -->\nnew\n<!-- mrclam:end -->\nthe end" in text
    assert "Tables of commit `def5678`, 2026-01-02." in text
    assert (tmp_path / "images" / "mrclam-a.png").read_bytes() == b"picture"
