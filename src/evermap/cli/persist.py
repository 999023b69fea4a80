"""`evermap persist`: whether features of any other SLAM are still there, from a table of looks."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from evermap.cli.terminal import command_line, print_json, print_table, progress_bar, say, warm_up, warn
from evermap.errors import ConfigError


class Stamps(StrEnum):
    """What stamps count, as `types.Clock`, which would load numpy for `--help`."""

    UNIX = "unix"
    RECORDING = "recording"
    LOCAL_WALL = "local_wall"


def persist(
    table_path: Annotated[
        Path | None,
        typer.Argument(metavar="INPUT", help="Table of looks: .csv, .csv.gz or .parquet.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results.", show_default="evermap-out/<input>")
    ] = None,
    priors: Annotated[
        list[str] | None,
        typer.Option(
            "--prior",
            metavar="[CLASS=]PRIOR",
            help="How long features stay, as in `evermap survival plot --help`; repeatable for classes.",
            show_default="unknown:1min..10y",
        ),
    ] = None,
    recurrent: Annotated[
        str, typer.Option(metavar="KIND", help="How features come back: none, auto, or a kind of model to learn.")
    ] = "none",
    per: Annotated[
        str, typer.Option(metavar="all|class|feature", help="Whose looks are put together to learn.")
    ] = "auto",
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Model learned by an earlier run (its model.json).")
    ] = None,
    learn_from: Annotated[int, typer.Option(help="Most looks that --recurrent learns from.")] = 100_000,
    query: Annotated[
        str, typer.Option(metavar="times|grid", help="Beliefs at the rows' times, or regularly.")
    ] = "times",
    step_s: Annotated[
        float | None, typer.Option(help="Step of the grid and of the forecasts [s].", show_default="chosen")
    ] = None,
    horizon: Annotated[
        str | None,
        typer.Option(
            metavar="DURATION", help="How far to forecast, as 3d.", show_default="a quarter of the looks' span"
        ),
    ] = None,
    p_miss: Annotated[float, typer.Option(help="P(no detection | there) where the table does not say.")] = 0.1,
    p_false: Annotated[float, typer.Option(help="P(detection | not there) where the table does not say.")] = 0.1,
    confidence: Annotated[float, typer.Option(help="Belief from which on a change is reported.")] = 0.9,
    truth_path: Annotated[
        Path | None,
        typer.Option("--truth", metavar="FILE", help="Table with stamp_s, feature_id, present, to score the beliefs."),
    ] = None,
    figures: Annotated[int, typer.Option(min=0, help="How many features get a figure of their own.")] = 12,
    clock: Annotated[
        Stamps | None, typer.Option(help="What stamps count, for the figures.", show_default="by their size")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Write into --out even if it holds other files; they stay.")
    ] = False,
    init: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a commented example table and exit.", show_default=False),
    ] = None,
) -> None:
    """Tell what is still there, from detections and misses.

    \b
    The table has a row a look: stamp_s, feature_id, and detected (1, 0, or empty where nobody looked); it may have
    p_miss, p_false, class_id, and the truth as present. The folder gets beliefs.csv, changes.jsonl, forecasts.csv,
    summary.json, figures and report.html.

    \b
    Features that come back need --recurrent:
      two-state                               stays and absences without typical duration
      phase-type, phase-type-rhythm           brief and long ones; with the hours of the local week
      run-length, run-length-rhythm           any typical duration; with the hours of the local week
      auto                                    whichever foretells looks that were held out

    \b
    Examples:
      evermap persist --init looks.csv
      evermap persist looks.csv --out out/looks
      evermap persist looks.csv --prior unknown:1h..1y --prior cart=exponential:half-life=1d --horizon 2d
      evermap persist looks.csv --recurrent auto
    """
    if init is not None:
        from evermap.runs.persist.example import write_example

        write_example(init)
        say(f"wrote an example to {init}; try: evermap persist {init}")
        return
    if table_path is None:
        raise ConfigError("a table is needed", field="INPUT", hint="--init looks.csv writes an example")
    from evermap.runs.folder import check_replaceable
    from evermap.runs.persist.config import DEFAULT_PRIOR, PersistConfig, split_priors
    from evermap.runs.persist.run import run_persist
    from evermap.runs.persist.run import warm_up as compile_kernels
    from evermap.runs.persist.table import read_looks, read_truth
    from evermap.runs.persist.write import write_persist
    from evermap.types import Clock

    out = out or default_out(table_path)
    inputs = [table_path, model, truth_path]
    check_replaceable(out, force=force, inputs=inputs)  # better now than after the run
    common, by_class = split_priors(priors or [])
    config = PersistConfig(
        prior=common or DEFAULT_PRIOR,
        class_priors=by_class,
        recurrent=recurrent,
        model="" if model is None else str(model),
        per=per,
        learn_from=learn_from,
        query=query,
        step_s=step_s,
        horizon_s=None if horizon is None else _duration_s(horizon),
        confidence=confidence,
    )
    if priors and not config.stays_once:
        raise ConfigError("a lifetime is for features that stay once", field="--prior", hint="without --recurrent")
    start = time.perf_counter()
    table = read_looks(table_path, p_miss=p_miss, p_false=p_false)
    truth, remarks = (None, ()) if truth_path is None else read_truth(truth_path, table)
    read_s = time.perf_counter() - start
    warm_up(compile_kernels)
    with progress_bar(f"{table_path.name}: filtering", speed=False) as progress:
        result = run_persist(table, config, truth=truth, progress=progress)
    with progress_bar(f"{table_path.name}: drawing", speed=False) as progress:
        summary = write_persist(
            out,
            result,
            figures=figures,
            clock=None if clock is None else Clock(clock.value),
            command=command_line(),
            read_s=read_s,
            force=force,
            inputs=inputs,
            progress=progress,
        )
    for remark in [*remarks, *summary["warnings"]]:
        warn(remark)
    _show(summary, out, as_json=as_json)


def default_out(table_path: Path) -> Path:
    """`evermap-out/looks` for 'data/looks.csv.gz'."""
    name = re.sub(r"(\.csv|\.gz|\.parquet)+$", "", table_path.name.lower())
    return Path("evermap-out") / (re.sub(r"[^a-z0-9_.]+", "-", name).strip("-.") or "persist")


def _duration_s(text: str) -> float:
    from evermap.survival.durations import parse_duration_s

    try:
        return parse_duration_s(text)
    except ConfigError as error:
        raise ConfigError(error.problem, field="--horizon", hint=error.hint) from None


def _show(summary: Mapping[str, Any], out: Path, *, as_json: bool) -> None:
    """The summary as JSON, or its main numbers as a table with the files to look at."""
    if as_json:
        print_json(summary)
        return
    counts, metrics = summary["counts"], summary["metrics"] or {}
    rows = [
        ("looks", f"{counts['looks']:,} at {counts['features']:,} features"),
        ("there now, expected", f"{summary['expected_present_now']:.1f}"),
        ("vanished, returned", f"{counts['vanished']:,}, {counts['returned']:,}"),
    ]
    names = {"brier": "Brier score", "log_loss": "log loss", "calibration_error": "calibration error"}
    rows += [(label, f"{metrics[key]:.4f}") for key, label in names.items() if key in metrics]
    rows += [(name.partition(".")[0], str(out / name)) for name in ("report.html", "beliefs.csv")]
    if summary["learning"]:
        kinds = sorted({model["kind"] for model in summary["learning"]["models"].values()})
        rows.insert(
            1, ("learned", f"{', '.join(kinds)}, per {summary['learning']['per']}".replace("per all", "for all"))
        )
    print_table(Path(summary["source"]).name, rows)
