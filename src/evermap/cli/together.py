"""`evermap together`: simultaneous recordings of several robots, as one problem."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from evermap.cli.options import AsJson, ConfigFile, Force, Settings, UnknownIds, argument, default_out
from evermap.cli.recordings import Out, RunRequest, ask, refuse_unread, write_results
from evermap.cli.terminal import EXIT_UNTRUSTWORTHY, progress_bar, warm_up
from evermap.errors import ConfigError

Simultaneous = Annotated[
    list[Path],
    argument("A recording of each of robots 1, 2, ..., or one that has several robots.", metavar="INPUT..."),
]

HELP = """\
Solve simultaneous recordings of several robots as one problem.

Each robot gets its folder, in the frame that all share.

\b
Examples:
  evermap together MRCLAM_Dataset6.zip --out out/all
  evermap together robot1 robot2 --out out/both
"""


def together(
    input: Simultaneous,
    out: Out = None,
    config: ConfigFile = None,
    settings: Settings = None,
    unknown_ids: UnknownIds = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Estimate the trajectories of several robots and their map, and write a folder for each."""
    asked = ask(input, config, settings, unknown_ids=unknown_ids, as_json=as_json, force=force)
    refuse_unread(asked, in_space=False)
    if not _run_together(input, out, asked):
        raise typer.Exit(EXIT_UNTRUSTWORTHY)


def _run_together(paths: Sequence[Path], out: Path | None, asked: RunRequest) -> bool:
    """Read several robots, run them as one problem, and write a folder for each; returns whether all can be trusted.

    Raises:
        ConfigError: there is one robot.
    """
    from evermap.cli.warmup import warm_up as compile_kernels
    from evermap.io import list_robots, read_recording
    from evermap.pipeline import run_together
    from evermap.runs.folder import check_replaceable

    if len(paths) > 1:
        recordings = {number: read_recording(path) for number, path in enumerate(paths, start=1)}
    else:
        recordings = {number: read_recording(paths[0], robot=number) for number in list_robots(paths[0])}
    if len(recordings) < 2:
        raise ConfigError("there is one robot", field="input", hint="give the recordings of the other robots, too")
    folders = {number: default_out(recording.name) for number, recording in recordings.items()}
    if len(set(folders.values())) < len(folders):
        folders = {number: Path(f"{folder}-{number}") for number, folder in folders.items()}
    if out is not None:
        folders = {number: out / folder.name for number, folder in folders.items()}
    for folder in folders.values():  # better now than after the run
        check_replaceable(folder, force=asked.force, inputs=asked.inputs)
    warm_up(lambda: compile_kernels(search=True))
    start = time.perf_counter()
    with progress_bar(f"{len(recordings)} robots") as progress:
        results = run_together(recordings, asked.config, progress=progress)
    elapsed_s = time.perf_counter() - start
    for number, result in results.items():
        write_results(folders[number], recordings[number], result, asked, elapsed_s)
    return all(one.is_trustworthy for one in results.values())
