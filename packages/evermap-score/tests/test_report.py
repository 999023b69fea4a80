"""Tables: the same numbers in text, Markdown, LaTeX and JSON; figures; the command."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from evermap_score import ScoreError, score, to_json, to_latex, to_markdown, to_text, write_episodes
from evermap_score.cli import main
from evermap_score.figures import write_figures

from .worlds import table

TRUTH = table(("a", None, None, 0, 0), ("b", None, 15, 5, 0), ("b", 15, None, 6, 0), ("c", None, None, 0, 5))
ESTIMATE = table(("a", None, None, 0, 0, 0.9), ("b", None, None, 5, 0, 0.8), ("c", None, None, 0, 5.1, 0.7))
NAMES = {"our_map": ESTIMATE, "50%": TRUTH}


def test_all_formats_have_the_same_numbers() -> None:
    report = score(TRUTH, NAMES, draws=20)
    values = json.loads(to_json(report))
    metrics = values["estimates"][0]["metrics"]
    lines = to_text(report).splitlines()
    assert lines[0].split() == ["metric", "unit", "our_map", "50%", "50%", "-", "our_map"]
    for name, number in metrics.items():
        shown = [line for line in lines if line.startswith(name + " ")]
        if number["value"] is None and values["estimates"][1]["metrics"][name]["value"] is None:
            assert not shown  # nobody has it
            continue
        cell = "-" if number["value"] is None else f"{number['value']:.4g}"
        if number["low"] is not None:
            cell += f" [{number['low']:.3g}, {number['high']:.3g}]"
        assert cell in shown[0]
        assert f" {cell} |" in next(line for line in to_markdown(report).splitlines() if line.startswith(f"| {name} |"))
        latex = next(line for line in to_latex(report).splitlines() if line.startswith(name.replace("_", r"\_") + " &"))
        assert f" {cell} &" in latex
    assert values["bootstrap"] == {"over": "landmarks", "draws": 20, "seed": 0, "level": 0.95}
    assert values["schema_version"] == 1


def test_latex_is_escaped_and_markdown_rectangular() -> None:
    report = score(TRUTH, NAMES, draws=0)
    latex = to_latex(report)
    assert r"our\_map" in latex
    assert r"50\%" in latex
    assert latex.count(r"\begin{tabular}{llrrr}") == latex.count(r"\end{tabular}") == 1
    rows = [line for line in to_markdown(report).splitlines() if line.startswith("|")]
    assert {line.count("|") for line in rows} == {6}


def test_the_report_says_how_frames_were_aligned() -> None:
    aligned = to_text(score(TRUTH, ESTIMATE, draws=0))
    assert "estimate: aligned by 2 landmarks that are static in both (shift" in aligned
    other = table(("x", None, None, 0, 0))
    assert "estimate: not aligned; its frame is taken to be that of the truth." in to_text(score(TRUTH, other, draws=0))


def test_the_command_prints_and_writes_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_episodes(TRUTH, tmp_path / "truth.parquet")
    write_episodes(ESTIMATE, tmp_path / "ours.csv")
    paths = [str(tmp_path / name) for name in ("truth.parquet", "ours.csv")]
    main([*paths, "--json", "--draws", "10", "--seed", "3", "--figures", str(tmp_path / "figures")])
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads(to_json(score(paths[0], {"ours": paths[1]}, draws=10, seed=3)))
    for name in ("reliability", "scores"):
        assert (tmp_path / "figures" / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        assert (tmp_path / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["reliability.pdf", "scores.png"])
def test_a_file_of_another_is_not_replaced_by_a_figure(tmp_path: Path, name: str) -> None:
    report = score(TRUTH, ESTIMATE, draws=0)
    for _ in range(2):  # its own are
        write_figures(report, tmp_path)
    (tmp_path / name).write_bytes(b"mine")
    with pytest.raises(ScoreError, match="is there already"):
        write_figures(report, tmp_path)
    assert (tmp_path / name).read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["truth.csv"], "required: ESTIMATE"),
        (["truth.csv", "none.csv"], "none.csv: no such file or folder"),
        (["truth.csv", "truth.csv", "--json", "--latex"], "exclude each other"),
        (["truth.csv", "truth.csv", "--draws", "-1"], "must not be negative"),
        (["truth.csv", "truth.csv", "--match", "luck"], "invalid choice: 'luck'"),
        (["truth.csv", "truth.csv", "truth.csv"], "given twice"),
        (["truth.csv", "truth.csv", "--looks", "truth.csv"], "no column stamp_s"),
    ],
)
def test_a_mistake_is_one_line(words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_episodes(TRUTH, tmp_path / "truth.csv")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ScoreError, match=re.escape(message)) as error:
        main(words)
    assert "\n" not in str(error.value)


def test_the_package_imports_nothing_of_evermap_and_no_plots() -> None:
    code = "import evermap_score, sys; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"evermap", "matplotlib", "pyarrow", "scipy", "pandas"} & set(loaded)
    for path in (Path(__file__).parents[1] / "src").rglob("*.py"):
        assert not re.search(r"^\s*(import|from) evermap\b", path.read_text(encoding="utf-8"), re.MULTILINE), path
