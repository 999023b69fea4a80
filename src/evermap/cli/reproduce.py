"""`evermap reproduce`: the tables of the documents, computed again."""

from __future__ import annotations

import os
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
    everything: Annotated[
        bool, typer.Option("--all", help="Also the recordings of which only a part of the truth is known.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the table as JSON.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace --out even if it holds other things than results.")
    ] = False,
) -> None:
    """Compute a table of the documents again.

    Runs follow one another on one core, so that the timings mean something.

    \b
    Example:
      evermap reproduce mrclam --data ~/recordings/mrclam
    """
    _one_core()
    from evermap.experiments import mrclam
    from evermap.runfolder import check_replaceable

    target = out or Path("evermap-out") / experiment.value
    check_replaceable(target, force=force)
    with progress_bar(experiment.value) as progress:
        table = mrclam.reproduce(data, target, progress=progress, everything=everything, force=force)
    if as_json:
        print_json(table)
    else:
        typer.echo(mrclam.as_markdown(table))
        say(f"the runs behind it are in {target}")


def _one_core() -> None:
    """Libraries read these when they are loaded, which they are not yet. What the user has set stands."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")
