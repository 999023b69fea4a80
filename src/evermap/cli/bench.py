"""`evermap bench`: the benchmarks of the source checkout against their committed baseline."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer

from evermap.cli.terminal import print_json
from evermap.errors import InputError


def bench(
    as_json: Annotated[bool, typer.Option("--json", help="Print the measurements as JSON.")] = False,
    update_baseline: Annotated[
        bool, typer.Option("--update-baseline", help="Make these measurements the new baseline.")
    ] = False,
) -> None:
    """Compare speed and memory with the baseline.

    Both are measured as ratios, so that they hold on any machine.

    \b
    Example:
      evermap bench
    """
    runner = _runner(Path(__file__).resolve().parents[3] / "benchmarks" / "run.py")
    measured = runner.run(update_baseline=update_baseline)
    if as_json:
        print_json(measured)
    else:
        typer.echo(runner.as_text(measured))


def _runner(path: Path) -> ModuleType:
    """The benchmarks are no part of the installed package: they compare with libraries that users need not have."""
    spec = importlib.util.spec_from_file_location("evermap_benchmarks", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise InputError("no benchmarks here", path=path, hint="run it from a clone of the repository: make bench")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
