"""`evermap convert`: any recording that we can read, in the native format."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

from evermap.cli.options import Robot, Topics, argument, option
from evermap.cli.terminal import print_json, say, warn


class TableFormat(StrEnum):
    """How tables are stored."""

    CSV = "csv"
    PARQUET = "parquet"


def convert(
    recording_path: Annotated[Path, argument("Recording in any format that can be read.", metavar="INPUT")],
    out: Annotated[Path, argument("Folder to write.", metavar="OUT")],
    robot: Robot = None,
    topics: Topics = None,
    table_format: Annotated[TableFormat, option("--format", "Format of the tables.")] = TableFormat.CSV,
    as_json: Annotated[bool, option("--json", "Print the result as JSON.")] = False,
    force: Annotated[bool, option("--force", "Write into OUT even if it is not empty; other files are kept.")] = False,
) -> None:
    """Write any readable recording in the native format.

    \b
    Example:
      evermap convert MRCLAM_Dataset6.zip robot1 --robot 1
    """
    from evermap.io import read_recording, write_native
    from evermap.runs.folder import RunFolder

    folder = RunFolder(out, force=force, inputs=[recording_path], renew=False)
    recording = read_recording(recording_path, robot=robot, topics=topics)
    with folder:
        write_native(recording, folder.path("."), table_format.value)
    for remark in recording.warnings:
        warn(remark)
    odometry, frames, detections = recording.odometry or (), recording.frames, recording.detections
    counts = {"odometry": len(odometry), "frames": len(frames), "detections": len(detections)}
    if as_json:
        warnings = list(recording.warnings)
        print_json({"name": recording.name, "out": str(out), **counts, "warnings": warnings})
    else:
        say(f"wrote {out}: {len(odometry)} odometry rows, {len(frames)} frames, {len(detections)} detections")
