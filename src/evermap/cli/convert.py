"""`evermap convert`: any recording that we can read, in the native format."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

from evermap.cli.options import Topics, argument, option
from evermap.cli.terminal import print_json, say, warn


class TableFormat(StrEnum):
    """How tables are stored."""

    CSV = "csv"
    PARQUET = "parquet"


def convert(
    recording_path: Annotated[Path, argument("Recording in any format that can be read.", metavar="INPUT")],
    out: Annotated[Path, argument("Folder to write.", metavar="OUT")],
    robot: Annotated[int | None, option("Robot of a recording that has several.", default=False)] = None,
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
    odometry = 0 if recording.odometry is None else len(recording.odometry)
    if as_json:
        print_json(
            {
                "name": recording.name,
                "out": str(out),
                "odometry": odometry,
                "frames": len(recording.frames),
                "detections": len(recording.detections),
                "warnings": list(recording.warnings),
            }
        )
    else:
        say(
            f"wrote {out}: {odometry} odometry rows, {len(recording.frames)} frames, "
            f"{len(recording.detections)} detections"
        )
