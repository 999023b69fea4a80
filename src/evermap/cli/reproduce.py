"""`evermap reproduce`: the tables of the documents, computed again."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from evermap.cli.terminal import print_json, progress_bar, say


class Experiment(StrEnum):
    """What can be reproduced."""

    MRCLAM = "mrclam"


def reproduce(
    experiment: Annotated[Experiment, typer.Argument(help="Which table.")],
    data: Annotated[Path, typer.Option(help="Folder with the recordings as their authors distribute them.")] = Path(
        "../shared/data/mrclam"
    ),
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results.", show_default="evermap-out/<experiment>")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the table as JSON.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace --out even if it holds other things than results.")
    ] = False,
) -> None:
    """Compute a table of the documents again.

    \b
    Example:
      evermap reproduce mrclam --data ~/recordings/mrclam
    """
    from evermap.experiments import mrclam
    from evermap.runfolder import check_replaceable

    target = out or Path("evermap-out") / experiment.value
    check_replaceable(target, force=force)
    with progress_bar(experiment.value) as progress:
        table = mrclam.reproduce(data, target, progress=progress)
    if as_json:
        print_json(table)
    else:
        typer.echo(mrclam.as_markdown(table))
        say(f"the runs behind it are in {target}")
