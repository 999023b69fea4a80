"""The page of claims is what the pages of the studies say, and says how each number is computed."""

from __future__ import annotations

import importlib.util
import re
import shutil
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


def test_every_table_and_every_known_failure_is_on_the_page_of_claims() -> None:
    """Counted here by other means: lines of tables of all documents, and the word that marks a test to fail."""
    page = (DOCS / "results.md").read_text(encoding="utf-8")
    for path in DOCS.rglob("*.md"):
        text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        if path == DOCS / "results.md":
            continue
        for before, block in re.findall(r"(?:^(.*)\n)?((?:^\|.*\n?)+)", text, flags=re.MULTILINE):
            head, _, *rows = ([cell.strip() for cell in row.strip("|\n").split("|")] for row in block.splitlines())
            is_plain = not any(re.match(r"[^\w`]*\d", cell) for row in rows for cell in row[1:])
            if is_plain or before.startswith("<!-- not measured: "):
                continue
            name = path.relative_to(DOCS).as_posix()
            assert f"({name})" in page
            claimed = re.match("expected|asked for", head[1])
            if not claimed:
                first = next(cell for cell in head if cell)
                assert re.search(
                    rf"^\| \[{name}\].*{re.escape(first)}.* \| {len(rows)} \| `", page, flags=re.MULTILINE
                ), (name, head)
                continue
            for row in rows:
                if row[1] != "–" and not row[2].startswith("–"):
                    assert f"| {row[0]} | {row[1]}" in page, (name, row)
    for path in (DOCS.parent / "tests").rglob("test_*.py"):
        if path != Path(__file__) and re.search(r"mark\.xfail\(", path.read_text(encoding="utf-8")):
            assert f"| `{path.relative_to(DOCS.parent)}::" in page
    assert "0.88 on average, 0.76 is right" in page


def test_every_number_says_of_which_code_it_is() -> None:
    page = (DOCS / "results.md").read_text(encoding="utf-8")
    rows = [row for table in results.tables(page) if table.head[-1] == "code" for row in table.rows]
    assert len(rows) > 200
    codes = [code for row in rows for code in row[-1].split("; ")]
    assert all(re.fullmatch(r"`[0-9a-f]{7,10}\+?` \d{4}-\d\d-\d\d", code) for code in codes)


@pytest.mark.parametrize("head", ["expected", "expected [ns]", "asked for"])
def test_claims_are_found_however_a_table_heads_them(head: str) -> None:
    (found,) = results.claims(f"| x | {head} | reached | met |\n| --- | --- | --- | --- |\n| a | ≥ 2 | 1 | **no** |\n")
    assert (found.name, found.met) == ("a", "**no**")


def test_reasons_of_failures_are_those_of_each_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_a.py").write_text(
        "WHY = 'by .3'\n"
        "def short(*case, measured):\n"
        "    return pytest.param(*case, marks=pytest.mark.xfail(reason=f'is {measured}'))\n"
        "@pytest.mark.parametrize('a', [short(1, measured='.1'), short(2, measured='.2')])\n"
        "def test_one(a): pass\n"
        "@pytest.mark.xfail(reason=WHY)\ndef test_two(): pass\n"
        "def test_three(request):\n    why = 'by .4'\n    request.applymarker(pytest.mark.xfail(reason=why))\n",
        encoding="utf-8",
    )
    monkeypatch.setattr(results, "TESTS", tmp_path / "tests")
    found = {one.test.partition("::")[2]: one.why for one in results.failures()}
    assert found == {"test_one[1]": "is .1", "test_one[2]": "is .2", "test_two": "by .3", "test_three": "by .4"}


def test_numbers_on_a_page_that_do_not_say_what_they_are_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = "| a | b |\n| --- | --- |\n| x | 1 |\n"
    monkeypatch.setattr(results, "DOCS", tmp_path)
    monkeypatch.setattr(results, "STUDIES", ())
    page = tmp_path / "page.md"
    page.write_text(table, encoding="utf-8")
    with pytest.raises(ValueError, match="no <!-- measured"):
        list(results.others())
    page.write_text(f"<!-- not measured: settings -->\n{table}", encoding="utf-8")
    assert not list(results.others())
    page.write_text(f"<!-- measured: abc1234, 2020-01-01 -->\n{table}", encoding="utf-8")
    ((_, found),) = results.others()
    assert found.code == "`abc1234` 2020-01-01"


def test_a_run_of_a_part_keeps_rows_and_sections_of_an_older_one_with_their_commits() -> None:
    claims = "|  | expected | measured | met |\n| --- | ---: | ---: | ---: |\n"
    old = (
        f"{claims}| a | 1 | 1.0 | yes |\n| b | 1 | 2.0 | **no** |\n\n"
        "### One\n\nErrors:\n\n| method | 0 m |\n| --- | ---: |\n| em | 0.1 |\n| joint | 0.2 |\n\n"
        "Times:\n\n| method | 0 m |\n| --- | ---: |\n| em | 7 |\n\n### Two\n\ntext"
    )
    new = (
        f"{claims}| a | 1 | 0.9 | yes |\n| b | 1 | – | – |\n\n"
        "### One\n\nErrors:\n\n| method | 0 m |\n| --- | ---: |\n| em | 0.3 |\n| mcts | 0.4 |\n\n### Three\n\nmore"
    )
    text = results.merge_pages(old, new, "`aaaaaaa`, 2020-01-01", "`bbbbbbb`, 2021-01-01")
    assert [line for line in text.splitlines() if line.startswith("| ") and "---" not in line] == [
        "|  | expected | measured | met | code |",
        "| a | 1 | 0.9 | yes | `bbbbbbb`, 2021-01-01 |",
        "| b | 1 | 2.0 | **no** | `aaaaaaa`, 2020-01-01 |",
        "| method | 0 m | code |",
        "| em | 0.3 | `bbbbbbb`, 2021-01-01 |",
        "| mcts | 0.4 | `bbbbbbb`, 2021-01-01 |",
        "| joint | 0.2 | `aaaaaaa`, 2020-01-01 |",
        "| method | 0 m | code |",
        "| em | 7 | `aaaaaaa`, 2020-01-01 |",
    ]
    assert "\n\nTimes:\n\n| method" in text
    assert [line for line in text.splitlines() if line.startswith("###")] == ["### One", "### Three", "### Two"]
    assert "### Two\n\nRows of commit `aaaaaaa`, 2020-01-01.\n\ntext" in text
    again = results.merge_pages(text, new, "`aaaaaaa`, 2020-01-01", "`ccccccc`, 2022-01-01")
    assert "| b | 1 | 2.0 | **no** | `aaaaaaa`, 2020-01-01 |" in again
    assert "| joint | 0.2 | `aaaaaaa`, 2020-01-01 |" in again
    assert "| em | 0.3 | `ccccccc`, 2022-01-01 |" in again
    assert results.merge_pages(old, old, "a", "b") == old


def test_a_table_is_the_same_however_long_its_run_took() -> None:
    page = "### One\n\nTen runs, seed 0, in {} s.\n\n| a | b |\n| --- | ---: |\n| x | {} |"
    old, new = page.format(751, 1), page.format(350, 2)
    assert results.merge_pages(old, new, "a", "b") == new
    assert "| x | 1 | a |" in results.merge_pages(old, new.replace("seed 0", "seed 1"), "a", "b")


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


def test_rows_are_distinguished_by_as_many_cells_as_it_takes() -> None:
    """And a cell that only the older run has is kept, in a row of both commits."""
    head = "### Times\n\n| method | sensor | s |\n| --- | --- | ---: |\n"
    text = results.merge_pages(
        f"{head}| em | ours | 1 |\n| em | paper | 2 |\n", f"{head}| em | paper | 3 |\n| mcts | paper | 4 |\n", "a", "b"
    )
    assert [line for line in text.splitlines() if line.startswith(("| em", "| mcts"))] == [
        "| em | ours | 1 | a |",
        "| em | paper | 3 | b |",
        "| mcts | paper | 4 | b |",
    ]
    text = results.merge_pages(f"{head}| em | 1 | 2 |", f"{head}| em | – | 3 |", "a", "b")
    assert text.endswith("| em | 1 | 3 | a; b |")


def test_all_studies_are_computed_by_the_commands_of_their_pages_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One fails: the others are done, and only that one is run again."""
    ran: list[list[str]] = []
    broken = ["robots"]
    monkeypatch.setattr(results, "renew", lambda name, folder: None)
    monkeypatch.setattr(results, "DOCS", tmp_path / "docs")
    shutil.copytree(DOCS, tmp_path / "docs")

    def run(command: list[str], **_: object) -> object:
        ran.append(command[1:])
        return type("Done", (), {"returncode": int(any(name in command for name in broken))})()

    monkeypatch.setattr(results.subprocess, "run", run)
    out = tmp_path / "out"
    assert results.recompute(out) == ["robots"]
    assert len(ran) == len(results.STUDIES) + len(results.PARTS)
    assert ["-m", "evermap", "reproduce", "rosen2016", "--data", "../shared/golden", "--out", f"{out}/rosen2016"] in ran
    assert ["-m", "evermap", "bench", "--only", "kitti", "--out", f"{out}/kitti"] in ran
    assert ["-m", "benchmarks.kitti_stays", "../shared/data/kitti_tracking", "--out", f"{out}/kitti-stays"] in ran
    assert ["-m", "evermap", "reproduce", "soak"] in ran
    assert "nielsen2024" in ran[-1]
    broken.clear()
    ran.clear()
    assert results.recompute(out) == []
    assert [command[3] for command in ran] == ["robots"]
