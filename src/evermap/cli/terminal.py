"""Terminal output of the verbs: lines, tables and progress. Results go to stdout, everything else to stderr."""

from __future__ import annotations

import io
import json
import os
import re
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import typer

from evermap.errors import ConfigError, printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

    from evermap.config import Config
    from evermap.types import AnyRecording, Progress

SUFFIXES = (".png", ".svg")
"""Of pictures."""

remark_as: ContextVar[Callable[[str], str]] = ContextVar("remark_as", default=lambda line: line)
"""Translates a remark of the core for the running command: options instead of arguments."""
_MOST = 2000
"""Maximum characters of an error; parts of a message have lower limits, so this cuts only other texts."""


EXIT_USER = 2
"""Of a mistake of the user, or a recording that nothing can be estimated from."""
EXIT_UNTRUSTWORTHY = 3
"""Of a run whose verdict is none of 'sound' and 'weak'."""


def echo(line: str) -> None:
    """Print a line of the result, with unchanged names, without control characters."""
    typer.echo(printable(line))


def say(line: str) -> None:
    """Print one line for the person at the terminal."""
    typer.echo(f"evermap: {printable(line)}", err=True)


def warn(line: str) -> None:
    """Print a remark that does not stop the run."""
    typer.secho(
        f"evermap: warning: {printable(remark_as.get()(line))}", err=True, fg="yellow", color=_colour(sys.stderr)
    )


def fail(line: str) -> None:
    """Print the line with which a run ends; the caller chooses the exit code."""
    typer.secho(f"evermap: error: {printable(line, _MOST)}", err=True, fg="red", color=_colour(sys.stderr))


def print_json(summary: Mapping[str, Any]) -> None:
    """Print the summary for machines; strict JSON, so nan and infinity must have become null before."""
    typer.echo(json.dumps(summary, indent=2, allow_nan=False))


def print_table(
    title: str, rows: Sequence[Sequence[str]], head: Sequence[str] = (), *, numbers: Sequence[int] = ()
) -> None:
    """Print a table: framed on a terminal, aligned text when piped.

    Args:
        title: above it.
        rows: cells.
        head: names of the columns; none for self-explanatory lines.
        numbers: columns to align right.
    """
    cells = [[printable(cell) for cell in line] for line in rows]
    if not sys.stdout.isatty():
        lines = [list(head), *cells] if head else cells
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        echo(title)
        for line in lines:
            aligned = (
                c.rjust(w) if k in numbers else c.ljust(w) for k, (c, w) in enumerate(zip(line, widths, strict=True))
            )
            typer.echo("  " + "  ".join(aligned).rstrip())
        return
    from rich.table import Table

    table = Table(title=printable(title), title_justify="left", show_header=bool(head))
    for k, name in enumerate(head):
        table.add_column(name, justify="right" if k in numbers else "left", no_wrap=k in numbers)
    for line in cells:
        table.add_row(*line)
    _console().print(table)


def warm_up(compile_kernels: Callable[[], None] | None = None) -> None:
    """Compile the kernels (of the pipeline by default), or load them; prints a line where one has to be compiled."""
    from evermap.compiled import at_first_missing

    if compile_kernels is None:
        from evermap.slam.warmup import warm_up as of_the_pipeline

        compile_kernels = of_the_pipeline
    note = "compiling the kernels, once on this machine; this takes up to a minute"
    with at_first_missing(lambda: say(note)):
        compile_kernels()


def warm_up_for(recording: AnyRecording, config: Config, *, in_map: bool = False) -> None:
    """Compile what `pipeline.run_slam` needs for a recording, in the plane or in space as it is solved."""
    from evermap.cli.warmup import warm_up as compile_kernels
    from evermap.slam.changes.joint import may_search
    from evermap.slam.space.moving import has_traffic
    from evermap.types import is_in_space

    needs: dict[str, Any] = {"unknown_ids": config.slam.unknown_ids}
    if is_in_space(recording):
        needs |= {"in_space": True, "traffic": has_traffic(recording)}
    else:
        needs |= {"search": may_search(len(recording.frames.stamp_s), in_map=in_map)}
    warm_up(lambda: compile_kernels(**needs))


@contextmanager
def progress_bar(label: str, *, speed: bool = True) -> Iterator[Progress | None]:
    """Yield a progress bar on stderr; None, and silence, where stderr is no terminal.

    Args:
        label: in front of the bar.
        speed: show the real-time factor; off where progress is not counted in seconds of a recording.
    """
    if not sys.stderr.isatty():
        yield None
        return
    from rich import progress
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[speed]}"),
    )
    start = time.perf_counter()
    with progress.Progress(*columns, console=_console(stderr=True), transient=True) as bars:
        task = bars.add_task(printable(label), total=None, speed="")

        def advance(done: float, total: float) -> None:
            elapsed = time.perf_counter() - start
            shown = f"{done / elapsed:.0f} x real time" if speed and elapsed > 0.5 else ""
            bars.update(task, completed=done, total=total, speed=shown)

        yield advance


def command_line() -> str:
    """Return the command line, for the summary, without passwords in addresses."""
    return hide_passwords(shlex.join(["evermap", *sys.argv[1:]]))


def hide_passwords(text: str) -> str:
    """Return a text without the passwords of addresses in it."""
    return re.sub(r"(://[^/\s:@]*):[^/\s@]*@", r"\1:***@", text)


def _console(*, stderr: bool = False) -> Console:
    """The terminal, on which text is text: no markup, no emoji names, no guessed highlights."""
    from rich.console import Console

    return Console(stderr=stderr, markup=False, emoji=False, highlight=False)


def _colour(stream: TextIO) -> bool:
    return stream.isatty() and "NO_COLOR" not in os.environ


def check_picture(path: Path, field: str, *, inputs: Sequence[str | Path] = ()) -> None:
    """Refuse a file that cannot be drawn, before the work that it shows is done.

    Args:
        path: the file.
        field: the argument that named it.
        inputs: files that are read.

    Raises:
        ConfigError: a suffix that is neither .png nor .svg, or the file is an input.
    """
    from evermap.runs.folder import check_output_file

    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"cannot draw a '{path.suffix}' file", path=path, field=field, hint="a name ending in .png")
    check_output_file(path, inputs=inputs)


def write_picture(path: Path, figure: Figure) -> None:
    """Write a figure, whole or not at all."""
    from evermap.io.files import write_atomic
    from evermap.viz.style import save_png, save_svg

    content = io.BytesIO()
    (save_svg if path.suffix.lower() == ".svg" else save_png)(figure, content)
    write_atomic(path, content.getvalue())
