"""`evermap demo`: the whole pipeline on a simulated building, without data and without a display."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from evermap.cli.terminal import Progress, command_line, print_json, print_table, progress_bar, say, warn

PROCESSES = 2
PATIENCE_S = 6.0
"""The first patrol takes about a second, unless its kernels have to be compiled."""

_SERIES = (("changed", "things change"), ("unchanged", "nothing changes"), ("from_scratch", "no map kept"))


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("evermap-out/demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulation; same seed, same numbers.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace --out even if it holds other things than a run.")
    ] = False,
) -> None:
    """Map a simulated building in which things come and go.

    A robot maps the building on day 1 and patrols it on five more days, believing that map; once while things come
    and go, once while nothing changes. Open report.html in the folder for the story.

    \b
    Example:
      evermap demo --out out/demo
    """
    from evermap.runfolder import check_replaceable

    check_replaceable(out, force=force)
    from evermap.demo import run_demo

    with progress_bar("simulated building") as bar, _patience(bar) as progress:
        summary = run_demo(
            out,
            seed=seed,
            progress=progress,
            processes=min(PROCESSES, os.cpu_count() or 1),
            command=command_line(),
            force=force,
        )
    for remark in summary["warnings"]:
        warn(remark)
    _show(summary, out, as_json=as_json)


@contextmanager
def _patience(bar: Progress | None) -> Iterator[Progress]:
    """Say why it takes so long, if it does: a fresh installation compiles before it runs."""
    note = "the first run on a machine compiles its kernels; that takes about half a minute, once"
    timer = threading.Timer(PATIENCE_S, say, [note])
    timer.daemon = True

    def progress(done: float, total: float) -> None:
        timer.cancel()
        if bar is not None:
            bar(done, total)

    timer.start()
    try:
        yield progress
    finally:
        timer.cancel()


def _show(summary: Mapping[str, Any], out: Path, *, as_json: bool) -> None:
    """The error of every day in each of the three ways, or everything as JSON."""
    if as_json:
        print_json(summary)
        return
    labels = [label for _, label in _SERIES]
    rows = [("day", "  ".join([*labels, "moved or vanished"]))]
    for session in summary["demo"]["sessions"]:
        errors = [session[name]["pose_rmse_m"] for name, _ in _SERIES]
        cells = ["–" if error is None else f"{100 * error:.1f} cm" for error in errors]
        changes = session["changes"]
        cells.append(f"{changes['moved'] + changes['vanished']} of {changes['landmarks_mapped_then']}")
        widths = [*map(len, labels), len("moved or vanished")]
        rows.append((str(session["day"]), "  ".join(f"{cell:>{w}}" for cell, w in zip(cells, widths, strict=True))))
    rows.append(("report", str(out / "report.html")))
    print_table("position error with the map of day 1 (RMSE)", rows)
