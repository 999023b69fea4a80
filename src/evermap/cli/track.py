"""`evermap track`: objects over time, from detections; and how long they stay."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
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
    argument,
    configure,
    default_out,
    option,
    priors_by_class,
)
from evermap.cli.terminal import command_line, print_json, print_table, progress_bar, warm_up, warn
from evermap.errors import ConfigError

if TYPE_CHECKING:
    from evermap.config import TrackConfig

Seen = Annotated[
    Path | None,
    argument(
        "Table of detections (.csv, .csv.gz, .parquet), or a folder with one and poses.", metavar="INPUT", default=False
    ),
]
Reach = Annotated[float | None, option("Range of the sensor [m]: misses within it are evidence.", default="unknown")]
Confusion = Annotated[
    Path | None,
    option(
        "Table of P(detected class | true class): class_id, and one column per class.",
        metavar="FILE",
        default="5 % mistakes",
    ),
]
State = Annotated[
    Path | None,
    option(
        "Continue where this file was written, if it exists, and write it at the end: the next day, the next robot.",
        metavar="FILE",
        default="start afresh",
    ),
]

HELP = """\
Track objects in space, and learn how long they stay.

\b
The table has one row per detection: stamp_s, x_m, y_m, z_m in the world; optionally class_id, a box (length_m,
width_m, height_m, yaw_rad), a covariance (cov_xx_m2 ... or sigma_m), score, appearance_0 ..., and sensor_x_m,
sensor_y_m, sensor_z_m. A row without a position is a frame in which nothing was detected. A folder has such a
table, detections, in the frame of a moving sensor, and its poses, odometry (stamp_s, x_m, y_m, z_m, qx, qy, qz,
qw). The folder gets tracks.csv and tracks.parquet, detections.csv,
events.jsonl, spells.csv, lifetimes.csv (for `evermap survival fit`), summary.json and figures.

\b
Most useful with --set:
  sigma_position_m=0.3    noise of a detection without a covariance [m]
  p_detect=0.9            share of objects in view that are detected
  clutter_per_m3=1e-4     false and first detections per frame and cubic metre
  motion=acceleration     or velocity: constant in the motion model
  warm_up=3               detections before a track is confirmed
  max_missed=10           frames without a detection until a track is stored, or deleted if it moved
  rest_for_s=2            time without motion before an object counts as resting [s]
  place_sigma_m=0.2       position tolerance of re-identification at rest, in addition to the noise [m]
  fov_deg=80              horizontal field of view; with --range-m and poses [deg]
  score_midpoint=3.7      score of a detection that is as likely real as false; score_scale=1.2 its slope
  speeds_mps={pallet=0.2} speed above which objects of a class count as moving [m/s]
  min_score=0.5           ignore detections with a lower score
  gap_s=60                a longer time between two frames counts as a gap without looks [s]
  output.rerun=true       write scene.rrd for the rerun viewer
  moved_reach_m=0         how far objects may be moved between looks; needs appearances [m]

\b
Examples:
  evermap init detections detections.csv
  evermap track detections.csv --range-m 12 --out out/yard
  evermap track kitti_tracking/0000 --out out/0000
  evermap track tuesday.csv --range-m 12 --state yard.state --out out/tuesday
  evermap survival fit out/yard/lifetimes.csv --by class --estimator best
"""


def track(
    input: Seen = None,
    out: TableOut = None,
    range_m: Reach = None,
    prior: Priors = None,
    confusion: Confusion = None,
    state: State = None,
    config: ConfigFile = None,
    settings: Settings = None,
    show_config: ShowConfig = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Follow the objects of a table of detections and write the folder of the run."""
    common, by_class = priors_by_class(prior)
    given = {"range_m": range_m, "prior": common, "class_priors": by_class}
    whole = configure(config, settings, given, within="track", also=("output.rerun",), show=show_config)
    if input is None:
        hint = "evermap init detections detections.csv writes an example"
        raise ConfigError("a table is needed", field="input", hint=hint)
    out = out or default_out(input.name)
    inputs = [input, confusion, config, state]
    scene = whole.output.rerun
    summary = _run(input, confusion, whole.track, out, state=state, scene=scene, force=force, inputs=inputs)
    if as_json:
        print_json(summary)
    else:
        _show(summary, out)


def _run(
    path: Path,
    confusion_path: Path | None,
    config: TrackConfig,
    out: Path,
    *,
    state: Path | None,
    scene: bool,
    force: bool,
    inputs: Sequence[str | Path | None],
) -> dict[str, Any]:
    """Read, run, write; return the summary."""
    from evermap.runs.folder import check_replaceable
    from evermap.runs.summary import RunInfo
    from evermap.runs.track.write import write_track
    from evermap.tracking.detections import read_confusion, read_input
    from evermap.tracking.run import check_choices, make_tracker, run_track
    from evermap.tracking.run import warm_up as compile_kernels

    check_replaceable(out, force=force, inputs=inputs)  # better now than after the run
    start = time.perf_counter()
    table = read_input(path, min_score=config.min_score)
    confusion = None if confusion_path is None else read_confusion(confusion_path, table.class_names)
    info = RunInfo(command=command_line(), read_s=time.perf_counter() - start)
    check_choices(config, table)  # compiling takes a while: first say what is missing
    known = state if state is not None and state.exists() else None
    tracker = make_tracker(table, config, confusion=confusion, state=known)
    warm_up(compile_kernels)
    with progress_bar(f"{path.name}: tracking", speed=False) as progress:
        result = run_track(table, config, tracker=tracker, progress=progress)
    with progress_bar(f"{path.name}: writing", speed=False) as progress:
        summary = write_track(out, result, info=info, scene=scene, force=force, inputs=inputs, progress=progress)
    if state is not None:
        tracker.save(state)
    for remark in summary["warnings"]:
        warn(remark)
    return summary


def _show(summary: Mapping[str, Any], out: Path) -> None:
    """Print the main numbers as a table with the files to look at."""
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
