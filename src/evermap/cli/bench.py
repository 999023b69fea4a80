"""`evermap bench`: the benchmarks of the source checkout against their committed baseline."""

from __future__ import annotations

import importlib
import os
import sys
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
    only: Annotated[
        str | None,
        typer.Option(help="Measure one part: slam, persistence, selectors, cliques, npmle, tracking or localize."),
    ] = None,
) -> None:
    """Compare speed and memory with the baseline.

    Both are measured as ratios, so that they hold on any machine. Exits with 1 if one is out of its tolerance.

    \b
    Example:
      evermap bench --only persistence
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # read when the libraries are loaded, below
    runner = load_benchmarks()
    measured = runner.run(update_baseline=update_baseline, only=only)
    if as_json:
        print_json(measured)
    else:
        typer.echo(runner.as_text(measured))
    if measured["regressions"]:
        raise typer.Exit(1)


def load_benchmarks(root: Path = Path(__file__).resolve().parents[3]) -> ModuleType:
    """Return the module `benchmarks.run` of a source checkout.

    It is no part of the installed package: it compares with libraries that users need not have.

    Raises:
        InputError: `root` is no source checkout.
    """
    path = root / "benchmarks" / "run.py"
    if not path.is_file():
        raise InputError("no benchmarks here", path=path, hint="run it from a clone of the repository: make bench")
    if str(root) not in sys.path:
        sys.path.append(str(root))
    return importlib.import_module("benchmarks.run")
