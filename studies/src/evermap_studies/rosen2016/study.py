"""Figures 1 to 4 of Rosen, Mason, Leonard: Towards Lifelong Feature-Based Mapping in Semi-Static Environments (2016).

The paper's numbers are only in its plots. They are compared with a rerun of its first author's implementation
(`rosen2016.json`), whose definitions are followed to the letter; both sides have standard errors.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from evermap import __version__
from evermap.errors import ConfigError
from evermap.survival import GeneralPurpose, Uniform
from evermap.types import FloatArray, Progress
from evermap_studies.rosen2016.figures import draw_all
from evermap_studies.rosen2016.reference import compare, read_reference
from evermap_studies.rosen2016.scores import Estimate, Stretches, empirical, filtered, l1_error, removal
from evermap_studies.rosen2016.table import as_markdown, verdict
from evermap_studies.worlds.revisits import RevisitConfig, simulate_revisits

Value = dict[str, Any]
"""One number: figure, metric, estimator, its settings, n, value, se, and later what it is compared with."""

SCHEMA_VERSION = "1"
DEFINITIONS = (
    "a feature exists at t <= T; beliefs every 0.1 s from 0 to 999.9 s, after an observation at that very time; "
    "L1 error by the trapezoidal rule; removal where belief < P_V; precision and recall a sequence, then averaged "
    "over the sequences that have one"
)


@dataclass(frozen=True, slots=True)
class Settings:
    """What the paper states in section VII and under its figures 3 and 4.

    Attributes:
        base: the generative model; L, lambda_R, lambda_O, P_N and, for figures 3d and 4, P_M = P_F = 0.1.
        detector_errors: values of P_M and of P_F in figure 3a to c.
        revisit_rates_hz: values of lambda_R in figure 3d.
        thresholds: values of P_V in figure 4.
        low_hz, high_hz: limits of the general-purpose prior.
        query_step_s: distance of the times at which beliefs are asked.
        sequences: drawn for every setting; the paper drew 100.
        seed: of everything random; every setting has a stream of its own.
    """

    base: RevisitConfig = field(default_factory=RevisitConfig)
    detector_errors: tuple[float, ...] = (0.01, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
    revisit_rates_hz: tuple[float, ...] = (1 / 100, 1 / 50, 1 / 25, 1 / 10, 1 / 5)
    thresholds: tuple[float, ...] = (0.01, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)
    low_hz: float = 0.001
    high_hz: float = 1.0
    query_step_s: float = 0.1
    sequences: int = 10_000
    seed: int = 0

    def __post_init__(self) -> None:
        if self.sequences < 2:
            raise ConfigError(f"{self.sequences} sequences have no standard error", field="sequences", hint="10000")
        if self.seed < 0:
            raise ConfigError(f"must not be negative, not {self.seed}", field="seed")

    @property
    def grid_s(self) -> FloatArray:
        """Times at which beliefs are asked: 0, 0.1, ..., 999.9 s."""
        return np.asarray(np.arange(round(self.base.horizon_s / self.query_step_s)) * self.query_step_s)

    def cells(self) -> Iterator[tuple[str, RevisitConfig]]:
        """All settings, each with the figure that shows it; their order is that of their random streams."""
        for p_miss in self.detector_errors:
            for p_false in self.detector_errors:
                yield "3abc", replace(self.base, p_miss=p_miss, p_false=p_false)
        for rate_hz in self.revisit_rates_hz:
            yield "3d", replace(self.base, revisit_rate_hz=rate_hz)
        yield "4", self.base


def reproduce(
    out: str | Path,
    settings: Settings | None = None,
    *,
    data: str | Path | None = None,
    progress: Progress | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Compute all values, compare them, and write `summary.json`, `table.md` and the figures as PNG and SVG.

    Args:
        out: folder; replaced if it holds an older reproduction, untouched if this one fails.
        settings: those of the paper where None.
        data: folder with `rosen2016.json`, the reference numbers; None compares with nothing.
        progress: told as the settings are done.
        force: write into a folder that holds other files, too; they stay.

    Returns:
        `values` (a dictionary each), `verdict` (None without reference), `settings`, `processing_s`; plain JSON values.

    Raises:
        InputError: the reference is missing or malformed.
        ConfigError: `out` must not be replaced.
    """
    from evermap.runs.folder import RunFolder
    from evermap.runs.summary import versions

    settings = settings or Settings()
    reference = None if data is None else read_reference(Path(data))
    with RunFolder(out, force=force, inputs=[data]) as folder:
        start = time.perf_counter()
        values = compute(settings, progress)
        elapsed_s = time.perf_counter() - start
        if reference is not None:
            compare(values, reference)
        table: dict[str, Any] = {
            "schema_version": SCHEMA_VERSION,
            "evermap": __version__,
            "experiment": "rosen2016",
            "definitions": DEFINITIONS,
            "settings": asdict(settings),
            "versions": versions(),
            "processing_s": elapsed_s,
            "verdict": None if reference is None else verdict(values, len(reference)),
            "values": values,
        }
        draw_all(settings, values, folder.path)
        folder.path("table.md").write_text(as_markdown(table) + "\n", encoding="utf-8")
        return folder.finish(table)


def compute(settings: Settings, progress: Progress | None = None) -> list[Value]:
    """All values of figures 3 and 4, with their standard errors."""
    cells = list(settings.cells())
    streams = np.random.SeedSequence(settings.seed).spawn(len(cells))
    values: list[Value] = []
    for done, ((figure, config), stream) in enumerate(zip(cells, streams, strict=True), start=1):
        values += _compute_cell(figure, config, settings, stream)
        if progress is not None:
            simulated_s = settings.sequences * config.horizon_s
            progress(done * simulated_s, len(cells) * simulated_s)
    return values


def _compute_cell(
    figure: str, config: RevisitConfig, settings: Settings, stream: np.random.SeedSequence
) -> list[Value]:
    data = simulate_revisits(settings.sequences, config, stream)
    cut = Stretches.of(data, settings.grid_s)
    errors = config.p_miss, config.p_false
    estimates: dict[str, Estimate] = {
        "uniform": filtered(data, cut, Uniform(config.horizon_s), *errors),
        "general_purpose": filtered(data, cut, GeneralPurpose(settings.low_hz, settings.high_hz), *errors),
        "empirical": empirical(data, cut, as_coded=False),
        "empirical_as_coded": empirical(data, cut, as_coded=True),
    }
    where = {
        "figure": figure,
        "p_miss": config.p_miss,
        "p_false": config.p_false,
        "revisit_rate_hz": config.revisit_rate_hz,
    }
    if figure != "4":
        looks = _value("looks", None, None, data.looks.astype(np.float64))
        found = [_value("l1_error", name, None, l1_error(estimate, cut)) for name, estimate in estimates.items()]
        return [where | value for value in (*found, looks)]
    found = []
    for name, estimate in estimates.items():
        certain = name.startswith("empirical")  # beliefs of 0 and 1 are below all thresholds or none
        for threshold in (None,) if certain else settings.thresholds:
            for metric, scores in zip(
                ("precision", "recall"), removal(estimate, cut, threshold or settings.thresholds[0]), strict=True
            ):
                known = np.isfinite(scores)
                found.append(_value(metric, name, threshold, scores[known]))
                found.append(_value(f"{metric}_known", name, threshold, known.astype(np.float64)))
    return [where | value for value in found]


def _value(metric: str, estimator: str | None, threshold: float | None, samples: FloatArray) -> Value:
    """Mean over sequences, with its standard error."""
    n = len(samples)
    return {
        "metric": metric,
        "estimator": estimator,
        "threshold": threshold,
        "n": n,
        "value": float(np.mean(samples)) if n else None,
        "se": float(np.std(samples, ddof=1) / np.sqrt(n)) if n > 1 else None,
    }


__all__ = ["Settings", "as_markdown", "compute", "reproduce"]
