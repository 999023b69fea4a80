"""`evermap persist`: whether features of any other SLAM are still there, from a table of looks."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from evermap.cli.options import (
    AsJson,
    ConfigFile,
    Force,
    Priors,
    Settings,
    ShowConfig,
    TableOut,
    Workers,
    argument,
    configure,
    default_out,
    option,
    priors_by_class,
    workers_of,
)
from evermap.cli.terminal import command_line, print_json, print_table, progress_bar, warm_up, warn
from evermap.errors import ConfigError

if TYPE_CHECKING:
    from evermap.config import PersistConfig
    from evermap.types import Clock


class StampsCount(StrEnum):
    """Clock of stamps, as `types.Clock`, which would load numpy for `--help`."""

    UNIX = "unix"
    RECORDING = "recording"
    LOCAL_WALL = "local_wall"


Looks = Annotated[
    Path | None,
    argument("Table of looks: .csv, .csv.gz or .parquet, or a folder of .parquet.", metavar="INPUT", default=False),
]
TruthTable = Annotated[
    Path | None, option("Table with stamp_s, feature_id, present, to score the beliefs.", metavar="FILE")
]
ShownClock = Annotated[StampsCount | None, option("Clock of the stamps, for the figures.", default="by their size")]

HELP = """\
Estimate which features still exist, from detections and misses.

\b
The table has one row per look: stamp_s, feature_id, and detected (1, 0, or empty without a look); optionally
p_miss, p_false, class_id, and the truth as present. The folder gets beliefs.csv, changes.jsonl, forecasts.csv,
summary.json, figures and report.html.

\b
Features that return need --set recurrent=KIND:
  two-state                               stays and absences without typical duration
  phase-type, phase-type-rhythm           brief and long ones; with the hours of the local week
  run-length, run-length-rhythm           any typical duration; with the hours of the local week
  auto                                    the one that predicts held-out looks best

\b
Most useful with --set:
  per=class               which features share a learned model: all, class, feature
  model=model.json        a model of `evermap survival learn` or `fit` in place of learning one
  p_miss=0.1              P(no detection | there) if the table has no p_miss; p_false=0.1 is P(detection | not there)
  confidence=0.9          belief above which a change is reported
  query=grid              beliefs at regular times, step_s=60 apart [s], not at those of the rows
  horizon_s=259200        how far to forecast [s]; by default a quarter of the looks' span
  figures=12              number of features with an individual figure

\b
Examples:
  evermap init looks looks.csv
  evermap persist looks.csv --out out/looks
  evermap persist looks.csv --prior unknown:1h..1y --prior cart=exponential:half-life=1d --set horizon_s=172800
  evermap persist looks.csv --set recurrent=auto
  evermap persist a-year-of-looks/ --workers 4
"""


def persist(
    input: Looks = None,
    out: TableOut = None,
    prior: Priors = None,
    truth: TruthTable = None,
    clock: ShownClock = None,
    workers: Workers = None,
    config: ConfigFile = None,
    settings: Settings = None,
    show_config: ShowConfig = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Filter a table of looks and write the folder of the run."""
    common, by_class = priors_by_class(prior)
    given = {"prior": common, "class_priors": by_class}
    chosen = configure(config, settings, given, within="persist", show=show_config).persist
    if prior and not chosen.stays_once:
        hint = "without --set recurrent and model"
        raise ConfigError("a lifetime prior is for features that stay once", field="prior", hint=hint)
    if input is None:
        raise ConfigError("a table is needed", field="input", hint="evermap init looks looks.csv writes an example")
    from evermap.types import Clock

    out = out or default_out(input.name)
    inputs: list[str | Path | None] = [input, chosen.model, truth, config]
    counts = None if clock is None else Clock(clock.value)
    count, cluster = workers_of(workers)
    spread: dict[str, Any] = {"workers": count or 1, "cluster": cluster}
    summary = _run(input, truth, chosen, out, clock=counts, force=force, inputs=inputs, spread=spread)
    if as_json:
        print_json(summary)
    else:
        _show(summary, out)


def _run(
    path: Path,
    truth_path: Path | None,
    config: PersistConfig,
    out: Path,
    *,
    clock: Clock | None,
    force: bool,
    inputs: Sequence[str | Path | None],
    spread: Mapping[str, Any],
) -> dict[str, Any]:
    """Read, run, write; return the summary."""
    from evermap.io.columns import is_parted
    from evermap.runs.folder import RunFolder, check_replaceable
    from evermap.runs.persist.run import run_persist
    from evermap.runs.persist.run import warm_up as compile_kernels
    from evermap.runs.persist.table import read_looks, read_truth
    from evermap.runs.persist.write import persist_in_parts, write_persist
    from evermap.runs.summary import RunInfo

    check_replaceable(out, force=force, inputs=inputs)  # better now than after the run
    if truth_path is None and is_parted(path, config.rows_at_once, but="present"):  # that is scored in one piece
        path, out = (path.absolute(), out.absolute()) if spread["cluster"] else (path, out)
        warm_up(compile_kernels)
        info = RunInfo(command=command_line())
        with (
            RunFolder(out, force=force, inputs=inputs) as folder,
            progress_bar(f"{path.name}: filtering parts", speed=False) as progress,
        ):
            summary = persist_in_parts(folder, path, config, clock=clock, info=info, progress=progress, **spread)
        for remark in summary["warnings"]:
            warn(remark)
        return summary
    start = time.perf_counter()
    table = read_looks(path, p_miss=config.p_miss, p_false=config.p_false)
    truth, remarks = (None, ()) if truth_path is None else read_truth(truth_path, table)
    read_s = time.perf_counter() - start
    warm_up(compile_kernels)
    with progress_bar(f"{path.name}: filtering", speed=False) as progress:
        result = run_persist(table, config, truth=truth, progress=progress)
    info = RunInfo(command=command_line(), read_s=read_s)
    with progress_bar(f"{path.name}: drawing", speed=False) as progress:
        summary = write_persist(out, result, clock=clock, info=info, force=force, inputs=inputs, progress=progress)
    for remark in [*remarks, *summary["warnings"]]:
        warn(remark)
    return summary


def _show(summary: Mapping[str, Any], out: Path) -> None:
    """Print the main numbers as a table with the files to look at."""
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
