"""`evermap demo`: the whole engine on a simulated building, without data and without a display."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evermap.cli.terminal import command_line, print_json, print_table, progress_bar, say, warn

if TYPE_CHECKING:
    from evermap.types import Progress

PATIENCE_S = 12.0
"""The first day takes a few seconds, unless its kernels have to be compiled."""


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("evermap-out/demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulation; same seed, same numbers.")] = 0,
    days: Annotated[int, typer.Option(min=1, max=366, help="Days that are simulated, two sessions each.")] = 28,
    processes: Annotated[int, typer.Option(min=1, help="Methods that are run at a time.")] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Write into --out even if it holds other files; they stay.")
    ] = False,
) -> None:
    """Live for four weeks in a building that changes.

    A robot patrols the building twice a day and sees a part of it each time: doors block its sight, a wing is closed
    at first. The same 56 recordings go into one map each of static SLAM, of three papers' methods alone, of evermap,
    and of an oracle that is told every change. Open report.html in the folder for the story, and look into evermap's
    map with 'evermap map log'.

    \b
    Example:
      evermap demo --out out/demo
    """
    from evermap.runs.folder import check_replaceable

    check_replaceable(out, force=force)
    from evermap_studies.demo.run import run_demo
    from evermap_studies.demo.scenario import Scenario

    with progress_bar("simulated building") as bar, _patience(bar) as progress:
        summary = run_demo(
            out,
            seed=seed,
            progress=progress,
            scenario=Scenario(days=days),
            processes=min(processes, os.cpu_count() or 1),
            command=command_line(),
            force=force,
        )
    for remark in summary["warnings"]:
        warn(remark)
    _show(summary, out, as_json=as_json)


@contextmanager
def _patience(bar: Progress | None) -> Iterator[Progress]:
    """Say why it takes so long, if it does: a fresh installation compiles before it runs."""
    note = "the first run on a machine compiles its kernels; that takes about a minute, once"
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
    """Every method over all sessions and what was expected, or everything as JSON."""
    if as_json:
        print_json(summary)
        return
    from evermap_studies.demo.story import HEAD, cells_of, median_ms

    demo, cost = summary["demo"], summary["timing"]["demo"]
    table = {
        method["label"]: (*cells_of(method), f"{median_ms(cost['cpu_s_per_minute'][name]):.0f} ms")
        for name, method in demo["methods"].items()
    }
    widths = [max(map(len, column)) for column in zip(HEAD, *table.values(), strict=True)]
    rows = [
        (label, "  ".join(f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True)))
        for label, cells in {"method": HEAD, **table}.items()
    ]
    short = [item["what"] for item in (*demo["expected"].values(), *cost["expected"].values()) if not item["holds"]]
    rows += [("falls short", what) for what in short]
    rows += [("report", str(out / "report.html")), ("map", str(out / "map.evermap"))]
    print_table(f"{demo['scenario']['days']} days; time is for a minute of recording", rows)
