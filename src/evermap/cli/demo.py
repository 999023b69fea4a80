"""`evermap demo`: the whole pipeline on a simulated building, without data and without a display."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from evermap.cli.summary import show_run
from evermap.cli.terminal import progress_bar


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("evermap-out/demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulation; same seed, same numbers.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace --out even if it holds other things than a run.")
    ] = False,
) -> None:
    """Map a simulated building in which things come and go.

    \b
    Example:
      evermap demo --out out/demo
    """
    from evermap.runfolder import check_replaceable

    check_replaceable(out, force=force)
    from evermap.demo import run_demo

    with progress_bar("simulated building") as progress:
        summary = run_demo(out, seed=seed, progress=progress)
    show_run(summary, out, as_json=as_json)
