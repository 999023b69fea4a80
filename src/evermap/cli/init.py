"""`evermap init`: templates and examples, to be filled with what is yours."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from evermap.cli.options import ResultAsJson, argument
from evermap.cli.terminal import print_json, say
from evermap.errors import ConfigError


class TemplateKind(StrEnum):
    """What is to be edited."""

    RECORDING = "recording"
    FLIGHT = "flight"
    BAG = "bag"
    LOOKS = "looks"
    DETECTIONS = "detections"


def init(
    kind: Annotated[TemplateKind, argument("What of, see above.", default=False)],
    path: Annotated[Path, argument("Folder or table to write, or the bag.", metavar="PATH", default=False)],
    as_json: ResultAsJson = False,
) -> None:
    """Write a commented template.

    \b
    Of one of:
      recording   a folder: a robot on a floor, in the native format
      flight      a folder: a camera that sees tags in space
      bag         BAG.toml beside a ROS bag: which topics are read from it, and how
      looks       a table for `evermap persist`
      detections  a table for `evermap track`

    \b
    Examples:
      evermap init recording my-recording
      evermap init bag monday.mcap
      evermap init looks looks.csv
    """
    written = path
    if kind is TemplateKind.BAG:
        written, text = _write_bag_settings(path)
        if not as_json:
            typer.echo(text)
        said = f"wrote this to {written}; correct it where needed, then: evermap slam {path}"
    elif kind is TemplateKind.LOOKS:
        from evermap.runs.examples import write_looks

        write_looks(path)
        said = f"wrote an example to {path}; try: evermap persist {path}"
    elif kind is TemplateKind.DETECTIONS:
        from evermap.runs.examples import RANGE_M, write_detections

        write_detections(path)
        said = f"wrote an example to {path}; try: evermap track {path} --range-m {RANGE_M:g}"
    else:
        from evermap.io import write_template

        write_template(path, in_space=kind is TemplateKind.FLIGHT)
        said = f"wrote a template to {path}; fill it with your recording, then: evermap slam {path}"
    if as_json:
        print_json({"kind": kind.value, "out": str(written)})
    else:
        say(said)


def _write_bag_settings(bag: Path) -> tuple[Path, str]:
    """Write the topics that are read from a bag, for editing; return the file and its text.

    Raises:
        ConfigError: it is there already.
    """
    from evermap.io.bag import bag_settings, settings_path
    from evermap.io.files import write_atomic

    path = settings_path(bag)
    if path.exists():
        raise ConfigError(f"{path} is there already", field="path", hint="edit it, or delete it to guess again")
    text = bag_settings(bag)
    write_atomic(path, text)
    return path, text
