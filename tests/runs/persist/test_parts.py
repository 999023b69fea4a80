"""A table that is larger than memory: in parts the same comes out as in one piece."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.config import PersistConfig
from evermap.io.columns import is_parted
from evermap.runs.persist.table import PartedLooks

FILES = ("beliefs.csv", "changes.jsonl", "forecasts.csv")


def looks(seed: int = 0, rows: int = 4000, features: int = 70, *, classes: bool = False) -> dict[str, Any]:
    """Rows in random order; features leave, some return; questions, and looks at the same time, among them."""
    rng = np.random.default_rng(seed)
    who = (features * rng.beta(1.0, 2.5, rows)).astype(int)  # some are looked at far more often than others
    stamp_s = np.round(rng.uniform(1e9, 1e9 + 4000.0, rows), 1)
    there = np.sin(stamp_s / (100.0 + 20.0 * who) + who) > -0.4
    detected = (rng.random(rows) < np.where(there, 0.9, 0.08)).astype(float)
    detected[rng.random(rows) < 0.1] = np.nan
    names = [f"cart, {k}" if k % 9 == 0 else str(k) for k in range(features)]  # sorted as text, and quoted
    table: dict[str, Any] = {"stamp_s": stamp_s, "feature_id": [names[k] for k in who], "detected": detected}
    table["p_miss"] = np.round(rng.uniform(0.05, 0.2, rows), 3)
    if classes:
        table["class_id"] = [None if k % 5 == 0 else f"kind {k % 3}" for k in who]
    return table


def write(table: dict[str, Any], path: Path, files: int = 1) -> Path:
    import pyarrow as pa
    import pyarrow.parquet as pq

    whole = pa.table({name: pa.array(values, from_pandas=True) for name, values in table.items()})
    if files == 1:
        pq.write_table(whole, path)
        return path
    edges = np.linspace(0, whole.num_rows, files + 1).astype(int)
    for number, (a, b) in enumerate(itertools.pairwise(edges)):
        part = path / f"month={number}" / "looks.parquet"
        part.parent.mkdir(parents=True)
        pq.write_table(whole.slice(a, b - a), part)
    return path


def run(path: Path, out: Path, *more: str, figures: int = 0) -> Result:
    return CliRunner().invoke(app, ["persist", str(path), "--out", str(out), "--set", f"figures={figures}", *more])


def same(path: Path, folder: Path, *more: str, rows: int = 300, figures: int = 0) -> dict[str, Any]:
    """Run in one piece and in parts; every file must be the same, byte by byte; returns the summary."""
    names = (*FILES, "model.json") if "recurrent=two-state" in more else FILES
    for out, at_once in (("one", 10**6), ("parts", rows)):
        assert is_parted(path, at_once) == (out == "parts")
        result = run(path, folder / out, *more, "--set", f"persist.rows_at_once={at_once}", figures=figures)
        assert result.exit_code == 0, result.output
    for name in names:
        assert (folder / "one" / name).read_bytes() == (folder / "parts" / name).read_bytes(), name
    one, parts = (json.loads((folder / out / "summary.json").read_text()) for out in ("one", "parts"))
    assert one["outputs"] == parts["outputs"]
    assert one["config"]["persist"].pop("rows_at_once") != parts["config"]["persist"].pop("rows_at_once")
    for key in one.keys() - {"timing", "command", "created_at", "versions"}:
        assert one[key] == parts[key], key
    pages = [(folder / out / "report.html").read_text().partition("<h2>Source")[0] for out in ("one", "parts")]
    for a, b in zip(*(page.split("<h2>") for page in pages), strict=True):
        assert a == b or "<svg" in a or "base64" in a
    figures = sorted(item.name for item in (folder / "one" / "figures").glob("*.png"))
    for name in figures:
        assert (folder / "one" / "figures" / name).read_bytes() == (folder / "parts" / "figures" / name).read_bytes()
    return parts


@pytest.mark.parametrize("query", [pytest.param("times", marks=pytest.mark.slow), "grid"])
def test_in_parts_the_files_are_those_of_one_piece(tmp_path: Path, query: str) -> None:
    told = same(write(looks(), tmp_path / "looks.parquet"), tmp_path, "--set", f"query={query}", figures=2)
    assert told["counts"]["rows"] == 4000
    assert told["counts"]["vanished"] > 70
    assert any("returned" in remark for remark in told["warnings"])


def test_a_folder_of_files_is_one_table(tmp_path: Path) -> None:
    table = looks(1, classes=True)
    one = write(table, tmp_path / "looks.parquet")
    many = write(table, tmp_path / "looks", files=3)
    same(many, tmp_path / "many", "--prior", "unknown:1min..1y", "--prior", "kind 1=exponential:half-life=5min")
    run(one, tmp_path / "single", "--prior", "unknown:1min..1y", "--prior", "kind 1=exponential:half-life=5min")
    for name in FILES:
        assert (tmp_path / "single" / name).read_bytes() == (tmp_path / "many" / "parts" / name).read_bytes(), name


@pytest.mark.parametrize("per", [pytest.param("all", marks=pytest.mark.slow), "auto"])
def test_models_are_learned_from_the_same_looks(tmp_path: Path, per: str) -> None:
    path = write(looks(2, classes=per == "auto"), tmp_path / "looks.parquet")
    more = ("--set", "recurrent=two-state", "--set", f"per={per}", "--set", "learn_from=900")
    told = same(path, tmp_path, *more)
    assert told["learning"]["per"] == ("class" if per == "auto" else "all")
    assert any("learned from at most 900" in remark for remark in told["warnings"])


def test_processes_give_the_same(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    same(write(looks(3), tmp_path / "looks.parquet"), tmp_path, "--workers", "2", rows=1200)


def test_a_part_has_all_rows_of_its_features_and_no_more_than_fit(tmp_path: Path) -> None:
    table = looks(4, classes=True)
    path = write(table, tmp_path / "looks.parquet")
    parted = PartedLooks.split(path, tmp_path, PersistConfig(rows_at_once=500))
    rows = []
    for number in range(len(parted.files)):
        part, row = parted.alone().part(number)
        assert [part.names[k] for k in part.feature] == [table["feature_id"][k] for k in row]
        kinds = [table["class_id"][k] for k in row]
        told = [(*part.class_names, None)[part.class_of_feature[k]] for k in part.feature]
        assert told == kinds
        assert len(part) <= 500 or part.n_features == 1
        rows.append(row)
    np.testing.assert_array_equal(np.sort(np.concatenate(rows)), np.arange(4000))
    assert len(rows) > 4


def test_mistakes_are_one_line_with_the_row_of_the_whole_table(tmp_path: Path) -> None:
    table = looks(5)
    table["p_miss"] = table["p_miss"].copy()
    table["p_miss"][3210] = 1.5
    path = write(table, tmp_path / "looks.parquet")
    small = ("--set", "persist.rows_at_once=300")
    few = write(looks(6, features=4), tmp_path / "few.parquet")
    empty = tmp_path / "none"
    empty.mkdir()
    for words, arguments in {
        (":3211:", "p_miss", "looks.parquet"): (path, *small),
        ("per", "one piece"): (few, "--set", "recurrent=two-state", "--set", "per=feature", *small),
        ("is a folder",): (empty,),
    }.items():
        result = run(arguments[0], tmp_path / "out", *arguments[1:])  # type: ignore[arg-type]
        assert result.exit_code == 2, result.output
        assert result.stderr.count("\n") == 1, result.stderr
        assert all(word in result.stderr for word in words), result.stderr
        assert not (tmp_path / "out").exists()
