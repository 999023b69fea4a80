"""`evermap audit`: which entries of a surveyed map are wrong, and the corrected file."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evermap.cli.options import ConfigFile, Force, Settings, argument, configure, default_out, option
from evermap.cli.terminal import command_line, echo, print_json, print_table, progress_bar, say, warm_up, warn

if TYPE_CHECKING:
    from evermap.types import AnyRecording, Progress

EXIT_WRONG = 4
"""Entries of the map are wrong."""
EXIT_UNTESTED = 3
"""No drive can be trusted, so nothing is said of the map."""

HELP = """\
Find wrong entries of a surveyed map, and correct its file.

Reads any map (WPILib, TagSLAM, fiducial_slam, rtabmap, GeoJSON, Parquet, tables with id, x, y) and one or more drives
in it. Says of every entry where it is, since when, and how probably; what was never seen; what cannot be decided, and
what would decide it. Exit code 0: nothing is wrong; 4: entries, or all the map, are wrong; 3: no drive can be trusted.

\b
Examples:
  evermap audit field.json monday.mcap
  evermap audit tagslam.yaml monday tuesday --write tagslam-corrected.yaml
  evermap audit poles.csv monday --json
"""


def audit(
    map_file: Annotated[
        Path, argument("The map, in any format that is read, or a folder with one.", metavar="MAP", default=False)
    ],
    input: Annotated[
        list[Path],
        argument("Drives: folders in the native format, zips or ROS bags.", metavar="RECORDING...", default=False),
    ],
    write: Annotated[
        Path | None,
        option(
            "Write the corrected map, in the format of the map; all that is right stays as it is, byte by byte.",
            metavar="FILE",
            default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None, option("Folder for report, plan and corrected map.", default="evermap-out/audit-<map>")
    ] = None,
    prior_sigma: Annotated[
        float | None,
        option("Standard deviation of entries for which the map states none [m].", default="0.02", min=1e-6),
    ] = None,
    config: ConfigFile = None,
    settings: Settings = None,
    as_json: Annotated[bool, option("--json", "Print all as JSON.")] = False,
    force: Force = False,
) -> None:
    """Compare a map with drives, print what is wrong, and write the report."""
    chosen = configure(config, settings, {}, within="slam", also=("living", "sensor", "track"))
    from evermap.cli.warmup import warm_up as compile_kernels
    from evermap.io import read_recording
    from evermap.io.map_formats import read_map_file, write_corrected
    from evermap.runs.audit.report import (
        HEAD,
        conclude,
        drive_line,
        list_rows,
        quiet_lines,
        sensor_lines,
        write_audit,
    )
    from evermap.runs.audit.run import audit_map
    from evermap.runs.folder import check_output_file, check_replaceable
    from evermap.runs.summary import RunInfo
    from evermap.types import is_in_space

    inputs = [map_file, *input, config]
    folder = out or default_out(f"audit-{map_file.name}")
    check_replaceable(folder, force=force, inputs=inputs)
    if write is not None:
        check_output_file(write, inputs=inputs, force=force)
    file = read_map_file(map_file, sigma_m=prior_sigma or 0.02)
    drives = [read_recording(path) for path in input]
    in_space = any(map(is_in_space, drives))
    warm_up(lambda: compile_kernels(search=not in_space, in_space=in_space))
    start = time.perf_counter()
    with ExitStack() as bars:

        def progress(drive: AnyRecording) -> Progress | None:
            bars.pop_all().close()
            return bars.enter_context(progress_bar(drive.name))

        found = audit_map(file.landmarks, drives, chosen, progress=progress)
    if write is not None:
        write_corrected(file, found.corrections(), write)
    info = RunInfo(command=command_line(), total_s=time.perf_counter() - start)
    summary = write_audit(folder, found, file, info, force=force, inputs=inputs)
    verdict, message = conclude(found)
    if as_json:
        print_json(summary if write is None else {**summary, "written": str(write)})
    else:
        rows = list_rows(found)
        if rows:
            print_table(file.path.name, rows, HEAD)
        for line in [message, *quiet_lines(found)]:
            echo(line)
        for line in sensor_lines(found):
            warn(line)
        for drive in found.drives:
            (echo if drive.is_heard else warn)(drive_line(drive, found.clock))
        corrected = folder / "corrected" / file.path.name if write is None else write
        say(f"report in {folder / 'report.html'}, corrected map in {corrected}")
    if verdict != "right":
        raise typer.Exit(EXIT_WRONG if verdict == "wrong" else EXIT_UNTESTED)
