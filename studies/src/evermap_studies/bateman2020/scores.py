"""Scores of one filter on one stack of runs, and of a parameter at several values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from evermap.metrics.belief import Reliability, reliability
from evermap.survival import Exponential
from evermap.types import FloatArray, IntArray
from evermap_studies.bateman2020.filters import beliefs
from evermap_studies.bateman2020.learned import learned_profile
from evermap_studies.bateman2020.removal import RemovalScores, bootstrap, removal_scores, removal_tally, standard_errors
from evermap_studies.bateman2020.runs import TUNING, Stack, miss_rate, simulate
from evermap_studies.bateman2020.settings import (
    IN_THE_TABLE,
    NOMINAL,
    REMOVING,
    SUPPRESSION,
    WARM,
    FilterSettings,
    Settings,
)

Row = dict[str, Any]

METRICS = tuple(f.name for f in fields(RemovalScores))
COMPARED = ("accuracy", "survival_ratio")
"""The two that the thesis tells."""
OWN = "own_"
"""Before the name of a score by the decisions `own_rho_high` and `own_rho_low`."""
REMOVALS = (0.5, 0.35, 0.2, 0.1, 0.05, 0.02, 0.01)
"""Values of `rho_low` for the curve of MES/S over delay."""


@dataclass(frozen=True, slots=True)
class Scored:
    """What came of one filter in one world.

    Attributes:
        row: world, sensor, filter, and every score with its standard error.
        draws: (B,) those of `COMPARED`, of resampled runs: the same runs for all filters of a stack.
        reliability: of the beliefs in possible detections.
        removal: (B, 3) `rho_low`, mean delay and MES/S of those of `REMOVING`: what is paid for what.
    """

    row: Row
    draws: dict[str, FloatArray]
    reliability: Reliability
    removal: FloatArray


def score(
    belief: FloatArray, clique: IntArray, stack: Stack, assumed: FilterSettings, *, draws: int, seed: int
) -> tuple[Row, dict[str, FloatArray]]:
    """Scores of beliefs (F, N) with their standard errors; landmarks of a clique share its weight.

    Returns:
        Every score and `<score>_se`, None where unknown; and (B,) draws of those of `COMPARED`.
    """
    weight = _share_of_clique(clique, stack)
    tally = removal_tally(
        belief,
        stack.in_view[:, clique],
        stack.first[clique],
        stack.survival_steps[clique],
        rho_high=assumed.rho_high,
        rho_low=assumed.rho_low,
    )
    drawn = bootstrap(tally, stack.run[clique], weight=weight, draws=draws, seed=seed)
    values, errors = asdict(removal_scores(tally, weight)), asdict(standard_errors(drawn))
    row = {name: _known(values[name]) for name in METRICS} | {f"{name}_se": _known(errors[name]) for name in METRICS}
    return row, {name: np.array([getattr(scores, name) for scores in drawn]) for name in COMPARED}


def _share_of_clique(clique: IntArray, stack: Stack) -> FloatArray:
    """(N,) weight of each column: one for all of a clique."""
    return np.asarray(1.0 / np.bincount(clique, minlength=stack.cliques)[clique])


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def tuned_p_miss(settings: Settings, sensor: str) -> float:
    """Miss rate of the nominal world, on runs that are scored nowhere."""
    return miss_rate(simulate(settings.world_of(NOMINAL, sensor), settings.tuning_runs, settings.seed, TUNING))


def score_world(
    settings: Settings, world: str, sensor: str, p_miss: float, done: Callable[[], None]
) -> Iterator[Scored]:
    """All filters that are asked for in one world, on the same runs."""
    drawn_from = settings.world_of(world, sensor)
    stack = simulate(drawn_from, settings.runs, settings.seed)
    there = stack.there()
    known_sensor = None
    if WARM in settings.filters_in(world):
        yesterday = simulate(drawn_from, settings.known_runs, settings.seed, TUNING)
        known_sensor = learned_profile(yesterday.runs, Exponential.from_mean(settings.filters.prior_mean_steps))
    for name in settings.filters_in(world):
        belief, clique = beliefs(name, stack, settings.filters, p_miss, known_sensor)
        row, drawn = score(belief, clique, stack, settings.filters, draws=settings.bootstrap_draws, seed=settings.seed)
        in_view = stack.in_view[:, clique]
        bins = reliability(belief[in_view], there[:, clique][in_view])
        done()
        at = {"world": world, "sensor": sensor, "filter": name}
        own = _own_decisions(belief, clique, stack, settings)
        curve = _removal_curve(belief, clique, stack) if name in REMOVING else np.empty((0, 3))
        yield Scored(at | row | own | {"calibration_error": _known(bins.error)}, drawn, bins, curve)


def _own_decisions(belief: FloatArray, clique: IntArray, stack: Stack, settings: Settings) -> Row:
    """Every score and standard error of who takes beliefs for what they say."""
    assumed = replace(settings.filters, rho_high=settings.filters.own_rho_high, rho_low=settings.filters.own_rho_low)
    row, _ = score(belief, clique, stack, assumed, draws=settings.bootstrap_draws, seed=settings.seed)
    return {f"{OWN}{name}": value for name, value in row.items()}


def _removal_curve(belief: FloatArray, clique: IntArray, stack: Stack) -> FloatArray:
    weight = _share_of_clique(clique, stack)
    in_view, first, survival = stack.in_view[:, clique], stack.first[clique], stack.survival_steps[clique]
    rows = []
    for rho_low in REMOVALS:
        scores = removal_scores(removal_tally(belief, in_view, first, survival, rho_low=rho_low), weight)
        rows.append((rho_low, scores.delay_mean, scores.survival_ratio))
    return np.array(rows)


def sweep(settings: Settings, sensor: str, done: Callable[[], None]) -> Iterator[Row]:
    """The filters of the thesis' table, with one parameter at a time at other values; without standard errors."""
    runs = min(settings.sweep_runs, settings.runs)
    plain = simulate(settings.world_of(NOMINAL, sensor), runs, settings.seed)
    known = {name: beliefs(name, plain, settings.filters, None) for name in IN_THE_TABLE}
    for section, parameter, value in sweep_points(settings):
        varied = settings.varied(section, parameter, value)
        stack = simulate(varied.world_of(NOMINAL, sensor), runs, settings.seed) if section == "world" else plain
        for name in IN_THE_TABLE:
            found = known[name]
            if varied != settings and (section == "world" or _depends(name, parameter)):
                found = beliefs(name, stack, varied.filters, None)
            row, _ = score(*found, stack, varied.filters, draws=2, seed=settings.seed)
            at = {"sensor": sensor, "section": section, "parameter": parameter, "value": value, "filter": name}
            yield at | {metric: row[metric] for metric in METRICS}
        done()


def sweep_points(settings: Settings) -> list[tuple[str, str, float]]:
    """Section, parameter and value of all points, in the order of the file."""
    return [
        (section, name, value)
        for section, table in settings.sweep.items()
        for name, values in table.items()
        for value in values
    ]


def _depends(name: str, parameter: str) -> bool:
    """Whether the beliefs of a filter of the thesis depend on a parameter of the filters."""
    suppresses, degrades = name.endswith(SUPPRESSION), name.startswith("jcfr")
    return {
        "rho_high": False,
        "rho_low": False,
        "suppression_share": suppresses,
        "observed_m": suppresses or degrades,
        "p_miss": not degrades,
    }.get(parameter, True)
