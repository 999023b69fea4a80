"""What studies have in common: the head of their tables (machine, time, settings), and how figures are written."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evermap import __version__, compiled
from evermap.errors import ConfigError
from evermap_studies.rows import commit_of_code

if TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from matplotlib.figure import Figure

THREAD_LIMITS = (*compiled.THREAD_LIMITS, "NUMBA_NUM_THREADS")
"""Environment variables that must be 1 before numpy is loaded for timings on one core; the command sets them."""


def check_least(settings: DataclassInstance, **least: int) -> None:
    """Raise `ConfigError` for the first setting that is smaller than it must be."""
    for name, value in least.items():
        if getattr(settings, name) < value:
            raise ConfigError(f"must be {value} at least, not {getattr(settings, name)}", field=name)


class Stopwatch:
    """Wall and processor time since it was made."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def head(self, experiment: str, schema_version: str, scoring: str, settings: DataclassInstance) -> dict[str, Any]:
        """Return the first keys of a study's table, its time taken by now.

        Args:
            experiment: name of the study.
            schema_version: of the table.
            scoring: how scores are computed, in words.
            settings: what was run.
        """
        wall, cpu = time.perf_counter() - self._wall, time.process_time() - self._cpu
        return {
            "schema_version": schema_version,
            "evermap": __version__,
            "experiment": experiment,
            "commit": commit_of_code(),
            "scoring": scoring,
            "settings": json.loads(json.dumps(asdict(settings))),
            "machine": machine(cpu / wall),
            "processing_s": wall,
        }


def machine(cores_used: float) -> dict[str, Any]:
    """Return where the timings come from; `cores_used` is processor time over wall time, 1 at most on one core."""
    from evermap.runs.summary import versions

    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "cores_used": cores_used,
        "thread_limits": {name: os.environ.get(name) for name in THREAD_LIMITS},
        "system": f"{platform.system()} {platform.machine()}",
        "versions": versions(),
    }


def _processor() -> str:
    """Name of the processor where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def save_all(figures: Mapping[str, Figure], path: Callable[[str], Path]) -> None:
    """Write every figure as PNG and SVG, to where `path` puts a file of its name."""
    from evermap.viz.style import save_png, save_svg

    for name, figure in figures.items():
        save_png(figure, path(f"{name}.png"), dpi=130)
        save_svg(figure, path(f"{name}.svg"))
