"""`evermap convert`: any recording that we can read, in the native format."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

from evermap.cli.options import Robot, Topics, argument, option
from evermap.cli.recordings import Start, check_session, write_condensed
from evermap.cli.terminal import print_json, say, warn


class TableFormat(StrEnum):
    """How tables are stored; SESSION: condensed, with what a map needs of the recording."""

    CSV = "csv"
    PARQUET = "parquet"
    SESSION = "session"


def convert(
    recording_path: Annotated[Path, argument("Recording in any format that can be read.", metavar="INPUT")],
    out: Annotated[Path, argument("Folder to write; with --format session a zip.", metavar="OUT")],
    robot: Robot = None,
    topics: Topics = None,
    table_format: Annotated[
        TableFormat, option("--format", "Format of the tables; session: condensed for a map.")
    ] = TableFormat.CSV,
    start: Start = None,
    as_json: Annotated[bool, option("--json", "Print the result as JSON.")] = False,
    force: Annotated[bool, option("--force", "Write into OUT even if it is not empty; other files are kept.")] = False,
) -> None:
    """Write any readable recording in the native format.

    \b
    Examples:
      evermap convert MRCLAM_Dataset6.zip robot1 --robot 1
      evermap convert monday.mcap monday.zip --format session
    """
    from evermap.io import read_recording, write_native
    from evermap.runs.folder import RunFolder
    from evermap.runs.session_clock import start_at

    condensed = table_format is TableFormat.SESSION
    folder = None if condensed else RunFolder(out, force=force, inputs=[recording_path], renew=False)
    if condensed:
        check_session(out, force=force, inputs=[recording_path])
    recording = read_recording(recording_path, robot=robot, topics=topics)
    if start is not None:
        recording = start_at(recording, start)
    if folder is None:
        write_condensed(recording, out)
    else:
        with folder:
            write_native(recording, folder.path("."), "parquet" if table_format is TableFormat.PARQUET else "csv")
    for remark in recording.warnings:
        warn(remark)
    odometry, frames, detections = recording.odometry or (), recording.frames, recording.detections
    counts = {"odometry": len(odometry), "frames": len(frames), "detections": len(detections)}
    if as_json:
        warnings = list(recording.warnings)
        print_json({"name": recording.name, "out": str(out), **counts, "warnings": warnings})
    elif not condensed:
        say(f"wrote {out}: {len(odometry)} odometry rows, {len(frames)} frames, {len(detections)} detections")
