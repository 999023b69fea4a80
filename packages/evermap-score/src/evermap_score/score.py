"""The whole comparison: read, align, measure, resample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from evermap_score.audit import Contradiction, audit_key
from evermap_score.bootstrap import draw_weights, interval, list_units, resample
from evermap_score.calibration import calibration_items, calibration_metrics
from evermap_score.changes import change_metrics
from evermap_score.episodes import Episodes, LookTable, read_looks
from evermap_score.errors import ScoreError
from evermap_score.gospa import gospa_metrics
from evermap_score.identity import identity_metrics
from evermap_score.importers import read_any
from evermap_score.matching import (
    IDENTITY,
    MATCHES,
    Alignment,
    Rules,
    World,
    align,
    apply_alignment,
    choose_instants,
    choose_match,
)
from evermap_score.metric import Metric
from evermap_score.presence import presence_metrics
from evermap_score.trajectory import StampedPositions, find_trajectory, read_tum, trajectory_metrics

Source = Episodes | str | Path


@dataclass(frozen=True)
class Interval:
    """A number with its 95 % bootstrap interval; NaN: there is nothing to compute it from.

    Attributes:
        value: of the whole.
        low, high: bounds.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class EstimateScore:
    """The numbers of one estimate.

    Attributes:
        name: of the estimate.
        values: by the name of the metric.
        minus_first: by the name of the metric, the value minus that of the first estimate, with the same draws; empty
            for the first.
        alignment: that took it to the truth.
        claims: stated probability and outcome (n, 2), for the reliability figure.
    """

    name: str
    values: dict[str, Interval]
    minus_first: dict[str, Interval]
    alignment: Alignment
    claims: np.ndarray[tuple[int, ...], np.dtype[np.float64]]


@dataclass(frozen=True)
class Report:
    """What `score` returns.

    Attributes:
        estimates: their scores, in the order in which they were given.
        units: of the metrics, by name: 'm', 's', ... or empty.
        instants_s: when the world was compared.
        resampled: 'sessions' or 'landmarks'.
        draws: of the bootstrap.
        seed: of the draws.
        rules: of the comparison.
        contradictions: rows of the truth that all estimates contradict.
    """

    estimates: tuple[EstimateScore, ...]
    units: dict[str, str]
    instants_s: tuple[float, ...]
    resampled: str
    draws: int
    seed: int
    rules: Rules
    contradictions: tuple[Contradiction, ...]

    def __getitem__(self, name: str) -> Interval:
        """Return a metric of the first estimate by its name."""
        return self.estimates[0].values[name]


def score(
    truth: Source,
    estimate: Source | Mapping[str, Source],
    *,
    looks: LookTable | str | Path | None = None,
    match: str | None = None,
    rules: Rules | None = None,
    draws: int = 500,
    seed: int = 0,
) -> Report:
    """Score one or several estimates of a world that changes.

    Args:
        truth: a table of episodes, or a file or folder that `importers.read_any` reads; of several maps the last.
        estimate: the same, or several by name; the first is what the others are compared with.
        looks: opportunities to see landmarks, a table or its file; None: unknown, all landmarks were looked at.
        match: 'identity' or 'place'; None: by identity if an id is in the truth and in an estimate. Overrides `rules`.
        rules: distances and thresholds; None: the defaults. Heights are compared where all tables have them, whatever
            it says.
        draws: of the bootstrap; 0: no intervals.
        seed: of the draws; the same seed gives the same numbers.

    Raises:
        ScoreError: a file cannot be read, or a table is empty.
    """
    named = dict(estimate) if isinstance(estimate, Mapping) else {_name(estimate): estimate}
    if not named:
        raise ScoreError("no estimate to score")
    if match not in (None, *MATCHES):
        raise ScoreError(f"unknown way to match: {match}", hint=f"one of {', '.join(MATCHES)}")
    tables = {name: _read(source) for name, source in named.items()}
    key = _read(truth).latest()
    if len(key) == 0:
        raise ScoreError("the truth has no episode")
    seen = read_looks(looks) if isinstance(looks, str | Path) else looks
    world = make_world(key, tables, seen, match, rules)
    true_path = _trajectory_of(truth)
    alignments = {name: align(world, table) for name, table in tables.items()}
    in_frame = {name: apply_alignment(table, alignments[name]) for name, table in tables.items()}
    metrics = {
        name: measure(world, table, true_path, _trajectory_of(named[name]), alignments[name])
        for name, table in in_frame.items()
    }
    everything = [metric for each in metrics.values() for metric in each]
    over_sessions = world.are_sessions and len(world.instants_s) > 1
    units = list_units(everything, over_sessions=over_sessions)
    weights = draw_weights(max(len(units), 1), draws, seed)[:, : len(units)]
    scores: list[EstimateScore] = []
    first_draws: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float64]]] = {}
    for name, of_estimate in metrics.items():
        values, differences = {}, {}
        for metric in of_estimate:
            drawn = resample(metric, units, weights, over_sessions=over_sessions)
            values[metric.name] = Interval(metric.value(), *interval(drawn))
            if scores:
                difference = values[metric.name].value - scores[0].values[metric.name].value
                differences[metric.name] = Interval(difference, *interval(drawn - first_draws[metric.name]))
            else:
                first_draws[metric.name] = drawn
        claims = [claim for _, _, claim in calibration_items(world, in_frame[name], ahead=False)]
        scores.append(
            EstimateScore(name, values, differences, alignments[name], np.array(claims, float).reshape(-1, 2))
        )
    return Report(
        tuple(scores),
        {metric.name: metric.unit for metric in everything},
        tuple(world.instants_s.tolist()),
        "sessions" if over_sessions else "landmarks",
        draws,
        seed,
        world.rules,
        tuple(audit_key(world, in_frame)),
    )


def make_world(
    truth: Episodes,
    estimates: Mapping[str, Episodes],
    looks: LookTable | None = None,
    match: str | None = None,
    rules: Rules | None = None,
) -> World:
    """Return the truth with the instants and rules by which all estimates are compared with it.

    Rows of the truth below `present_p`, which a run of evermap has that is taken for it, are left out.
    """
    tables = [table for table in estimates.values() if len(table)]
    given = rules or Rules()
    chosen = replace(
        given,
        match=match or (given.match if rules else choose_match(truth, tables)),
        in_space=all(table.in_space for table in (truth, *tables)),
    )
    truth = truth[truth.p >= chosen.present_p]
    instants_s, are_sessions = choose_instants(truth, tables, looks)
    return World(truth, instants_s, are_sessions, looks, chosen)


def measure(
    world: World,
    estimate: Episodes,
    true_path: StampedPositions | None = None,
    path: StampedPositions | None = None,
    alignment: Alignment | None = None,
) -> list[Metric]:
    """Return all metrics of an estimate, with their items."""
    return [
        *change_metrics(world, estimate),
        *calibration_metrics(world, estimate),
        *presence_metrics(world, estimate),
        *identity_metrics(world, estimate),
        *gospa_metrics(world, estimate),
        *trajectory_metrics(world, true_path, path, alignment or IDENTITY),
    ]


def _name(source: Source) -> str:
    return "estimate" if isinstance(source, Episodes) else Path(source).stem


def _read(source: Source) -> Episodes:
    return source if isinstance(source, Episodes) else read_any(source)


def _trajectory_of(source: Source) -> StampedPositions | None:
    if isinstance(source, Episodes):
        return None
    path = find_trajectory(source)
    return None if path is None else read_tum(path)
