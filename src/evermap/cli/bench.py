"""`evermap bench`: the benchmarks of the source checkout against their committed baseline."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer

from evermap.cli.options import option
from evermap.cli.terminal import print_json
from evermap.errors import InputError


def bench(
    as_json: Annotated[bool, option("--json", "Print the measurements as JSON.")] = False,
    update_baseline: Annotated[bool, option("--update-baseline", "Make these measurements the new baseline.")] = False,
    only: Annotated[
        str | None,
        option(
            "Measure one part: slam, persistence, selectors, cliques, npmle, tracking, kitti, localize, scale, "
            "space, association, fleet."
        ),
    ] = None,
    sizes: Annotated[
        str | None, option("Numbers of landmarks for 'scale', separated by commas; also measures DLR and maps.")
    ] = None,
    out: Annotated[Path | None, option("Folder for the tables and figures of 'scale', 'kitti' or 'space'.")] = None,
) -> None:
    """Compare speed and memory with the baseline.

    Both are measured as ratios, so that they hold on any machine. Exits with 1 if one is out of its tolerance.

    \b
    Example:
      evermap bench --only persistence
      evermap bench --only scale --sizes 400,1000,4000 --out out/scale
    """
    from evermap.compiled import THREAD_LIMITS

    landmarks = None if sizes is None else _numbers(sizes)
    if landmarks is not None and only not in (None, "scale"):
        raise InputError("--sizes belongs to 'scale'", field="--only", hint="--only scale")
    if out is not None and only not in (None, "scale", "kitti", "space"):
        raise InputError("--out belongs to one part", field="--only", hint="--only scale, --only kitti or --only space")
    for name in (*THREAD_LIMITS, "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # read when the libraries are loaded, below
    runner = load_benchmarks()
    measured = runner.run(update_baseline=update_baseline, only=only, sizes=landmarks)
    if out is not None:
        {"scale": runner.scale_report, "kitti": runner.kitti, "space": runner.space}[only or "scale"].write(
            measured["shown"][only or "scale"], out
        )
    if as_json:
        print_json(measured)
    else:
        typer.echo(runner.as_text(measured))
    if measured["regressions"]:
        raise typer.Exit(1)


def _numbers(text: str) -> tuple[int, ...]:
    """Read '400,1000' as numbers of landmarks."""
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and int(part) >= 2 for part in parts):
        raise InputError(f"'{text}' is not a list of numbers from 2", field="--sizes", hint="--sizes 400,1000,4000")
    return tuple(map(int, parts))


def load_benchmarks(root: Path = Path(__file__).resolve().parents[3]) -> ModuleType:
    """Return the module `benchmarks.run` of a source checkout.

    It is not part of the installed package: it compares with libraries that users need not have.

    Raises:
        InputError: `root` is not a source checkout.
    """
    path = root / "benchmarks" / "run.py"
    if not path.is_file():
        raise InputError("no benchmarks here", path=path, hint="run it from a clone of the repository: make bench")
    if str(root) not in sys.path:
        sys.path.append(str(root))
    return importlib.import_module("benchmarks.run")
