"""`evermap track`: objects over time, from detections; and how long they stay."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from evermap.cli.persist import default_out
from evermap.cli.terminal import command_line, print_json, print_table, progress_bar, say, warm_up, warn
from evermap.errors import ConfigError


def track(
    table_path: Annotated[
        Path | None,
        typer.Argument(metavar="INPUT", help="Table of detections: .csv, .csv.gz or .parquet.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results.", show_default="evermap-out/<input>")
    ] = None,
    range_m: Annotated[
        float | None,
        typer.Option(help="The sensor's reach [m]: what is missed within it may be gone.", show_default="unknown"),
    ] = None,
    priors: Annotated[
        list[str] | None,
        typer.Option(
            "--prior",
            metavar="[CLASS=]PRIOR",
            help="How long objects rest, as in `evermap survival plot --help`; repeatable for classes.",
            show_default="unknown:1min..10y",
        ),
    ] = None,
    speeds: Annotated[
        list[str] | None,
        typer.Option(
            "--speed",
            metavar="CLASS=MPS",
            help="Speed above which a class counts as moving [m/s]; repeatable.",
            show_default="0.5 for all",
        ),
    ] = None,
    confusion_path: Annotated[
        Path | None,
        typer.Option(
            "--confusion",
            metavar="FILE",
            help="Table of P(detected class | true class): class_id, and a column a class.",
            show_default="5 % mistakes",
        ),
    ] = None,
    min_score: Annotated[float, typer.Option(help="Leave out detections of a lower score.")] = 0.0,
    gap_s: Annotated[
        float | None,
        typer.Option(
            help="A longer time between two frames is one at which nobody looked [s].",
            show_default="ten times the usual",
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Set one of the numbers below; repeatable."),
    ] = None,
    scene: Annotated[bool, typer.Option("--scene/--no-scene", help="Write scene.rrd for rerun, if installed.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Write into --out even if it holds other files; they stay.")
    ] = False,
    init: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a commented example table and exit.", show_default=False),
    ] = None,
) -> None:
    """Follow objects in space, and learn how long they stay.

    \b
    The table has a row a detection: stamp_s, x_m, y_m, z_m in the world; it may have class_id, a covariance
    (cov_xx_m2 ... or sigma_m), score, appearance_0 ..., and sensor_x_m, sensor_y_m, sensor_z_m. A row without a
    position is a frame in which nothing was detected. The folder gets tracks.csv and tracks.parquet, detections.csv,
    events.jsonl, spells.csv, lifetimes.csv (for `evermap survival fit`), summary.json, figures and scene.rrd.

    \b
    Most useful with --set:
      sigma_position_m=0.3    noise of a detection where the table does not say [m]
      p_detect=0.9            share of objects in view that are detected
      clutter_per_m3=1e-4     false and first detections, a frame and cubic metre
      motion=acceleration     or velocity: what is constant while nothing is seen
      warm_up=3               detections before an object is believed
      max_missed=10           frames without a detection until it is kept in mind, or given up if it moved
      rest_for_s=2            time without motion before an object counts as resting [s]
      place_sigma_m=0.2       how exactly a resting object is found again in its place, beside the noise [m]
      moved_reach_m=0         how far objects may be moved while nobody looks; wants appearances [m]

    \b
    Examples:
      evermap track --init detections.csv
      evermap track detections.csv --range-m 12 --out out/yard
      evermap survival fit out/yard/lifetimes.csv --by class --estimator best
    """
    if init is not None:
        from evermap.runs.track.example import RANGE_M, write_example

        write_example(init)
        say(f"wrote an example to {init}; try: evermap track {init} --range-m {RANGE_M:g}")
        return
    if table_path is None:
        raise ConfigError("a table is needed", field="INPUT", hint="--init detections.csv writes an example")
    from evermap.runs.folder import check_replaceable
    from evermap.runs.persist.config import split_priors
    from evermap.runs.track.config import DEFAULT_PRIOR, TrackConfig, parse_settings, parse_speeds
    from evermap.runs.track.confusion import read_confusion
    from evermap.runs.track.detections import read_detections
    from evermap.runs.track.run import run_track
    from evermap.runs.track.run import warm_up as compile_kernels
    from evermap.runs.track.write import write_track

    out = out or default_out(table_path)
    inputs = [table_path, confusion_path]
    check_replaceable(out, force=force, inputs=inputs)  # better now than after the run
    common, by_class = split_priors(priors or [])
    config = TrackConfig(
        settings=parse_settings(settings or []),
        class_speed_mps=parse_speeds(speeds or []),
        prior=common or DEFAULT_PRIOR,
        class_priors=by_class,
        range_m=range_m,
        min_score=min_score,
        gap_s=gap_s,
    )
    start = time.perf_counter()
    table = read_detections(table_path, min_score=min_score)
    confusion = None if confusion_path is None else read_confusion(confusion_path, table.class_names)
    read_s = time.perf_counter() - start
    warm_up(compile_kernels)
    with progress_bar(f"{table_path.name}: tracking", speed=False) as progress:
        result = run_track(table, config, confusion=confusion, progress=progress)
    with progress_bar(f"{table_path.name}: writing", speed=False) as progress:
        summary = write_track(
            out,
            result,
            command=command_line(),
            read_s=read_s,
            scene=scene,
            force=force,
            inputs=inputs,
            progress=progress,
        )
    for remark in summary["warnings"]:
        warn(remark)
    _show(summary, out, as_json=as_json)


def _show(summary: Mapping[str, Any], out: Path, *, as_json: bool) -> None:
    """The summary as JSON, or its main numbers as a table with the files to look at."""
    if as_json:
        print_json(summary)
        return
    counts, events = summary["counts"], summary["counts"]["events"]
    rows = [
        ("frames", f"{counts['frames']:,}, {counts['empty_frames']:,} of them empty"),
        ("detections", f"{counts['detections']:,}, {counts['detections_of_objects']:,} of them of objects"),
        ("objects", f"{counts['objects']:,}"),
        ("found again, died", f"{events['reidentified']:,}, {events['died']:,}"),
    ]
    for name, numbers in summary["classes"].items():
        spells = f"{numbers['objects']:,} objects, {numbers['spells']:,} spells at rest"
        rows.append((name, f"{spells}, {numbers['spells_with_lifetimes']:,} with a lifetime"))
    rows += [
        (name.partition(".")[0], str(out / name)) for name in ("tracks.csv", "lifetimes.csv", "figures/objects.png")
    ]
    print_table(Path(summary["source"]).name, rows)
