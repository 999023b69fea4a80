"""From a table of looks to beliefs, changes, forecasts and scores; reads as the steps of a run."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from evermap.config import PersistConfig
from evermap.errors import ConfigError, DataError, InputError, NumericalError
from evermap.existence.one_stay import OneStay
from evermap.existence.protocol import Looks
from evermap.io.text import counted, quote
from evermap.metrics.belief import BeliefScores, Reliability, belief_scores, reliability
from evermap.runs.persist.changes import Changes, Forecasts, find_changes, forecast_stamps, forecasts_of
from evermap.runs.persist.models import ModelOfEach, ask, models_for
from evermap.runs.persist.table import LookTable, Truth
from evermap.types import FloatArray, IntArray, Progress

if TYPE_CHECKING:
    from evermap.runs.persist.models import LearnedModels


MOST_ROWS = 100_000_000
"""More beliefs than this are a mistake in the step, not a wish."""


@dataclass(frozen=True, slots=True)
class Beliefs:
    """B beliefs: in the order of the table, or by feature and time on a grid.

    Attributes:
        stamp_s: (B,) when.
        feature: (B,) index of the feature.
        p_exists: (B,) probability that it was there, from the looks up to and including that time; nan before the
            first detection of a feature that stays once.
    """

    stamp_s: FloatArray
    feature: IntArray
    p_exists: FloatArray

    def __len__(self) -> int:
        return len(self.stamp_s)


@dataclass(frozen=True, slots=True)
class PersistResult:
    """Everything a run found.

    Attributes:
        table: what was read.
        config: what was chosen.
        models: the model of every feature.
        learned: how they were learned; None where they were not.
        looks: the looks by feature and time.
        p_at_looks: (M,) belief right after each look.
        beliefs: at the instants asked for.
        changes: what vanished and returned.
        forecasts: presence after the latest look.
        truth: None where unknown.
        scores, reliability: beliefs against truth; None where unknown.
        merged_mass: largest probability that a filter of limited memory moved about within one feature.
        step_s: wall time of each step by name.
        warnings: remarks.
    """

    table: LookTable
    config: PersistConfig
    models: ModelOfEach
    learned: LearnedModels | None
    looks: Looks
    p_at_looks: FloatArray
    beliefs: Beliefs
    changes: Changes
    forecasts: Forecasts
    truth: Truth | None
    scores: BeliefScores | None
    reliability: Reliability | None
    merged_mass: float
    step_s: dict[str, float]
    warnings: tuple[str, ...]


def run_persist(
    table: LookTable,
    config: PersistConfig | None = None,
    *,
    truth: Truth | None = None,
    progress: Progress | None = None,
) -> PersistResult:
    """Compute beliefs, changes and forecasts of a table of looks.

    Args:
        table: `read_looks(path)`.
        config: choices; the defaults where None.
        truth: what truly was there, for scores and figures only; None takes the column `present` of the table.
        progress: told after each step.

    Raises:
        ConfigError: choices that cannot be.
        InputError: a look that is impossible, whether the feature was there or not.
        DataError: looks from which no model can be learned.
    """
    config = config or PersistConfig()
    clock = _Steps(("sort", "learn", "filter", "changes", "score"), progress)
    order = table.order()
    looks = table.looks(order)
    clock.done("sort")
    try:
        models, learned = models_for(config, table, looks, clock.within)
        clock.done("learn")
        beliefs, p_at_looks, forecasts, merged_mass = _filter(table, order, config, models, looks)
    except NumericalError as error:
        raise _named(error, table, order) from error
    except DataError as error:
        raise DataError(error.problem, path=table.source or None, hint=error.hint) from error
    clock.done("filter")
    changes = find_changes(looks, p_at_looks, config.confidence, config.tail)
    clock.done("changes")
    at_rows = table.present if truth is None and config.query == "times" else None
    truth = truth or table.truth(order)
    scores, bins = _score(table, beliefs, truth, at_rows)
    clock.done("score")
    warnings = (*table.warnings, *_remarks(config, models, looks, beliefs, changes))
    return PersistResult(
        table, config, models, learned, looks, p_at_looks, beliefs, changes, forecasts, truth, scores, bins,
        merged_mass, clock.step_s, warnings,
    )  # fmt: skip


def warm_up() -> None:
    """Compile the kernels of the persistence filter, or load them."""
    looks = Looks.from_rows([0, 0], [0.0, 1.0], [1, 1], 0.1, 0.1)
    OneStay.of_text(PersistConfig().prior).track(looks)


def _filter(
    table: LookTable, order: IntArray, config: PersistConfig, models: ModelOfEach, looks: Looks
) -> tuple[Beliefs, FloatArray, Forecasts, float]:
    """Beliefs at the instants asked for and at the looks, forecasts, and the mass that was moved about."""
    at_rows = config.query == "times"
    feature, stamp_s = (table.feature, table.stamp_s) if at_rows else _grid(table, config)
    later_s = forecast_stamps(looks, table.now_s, config)
    ahead = np.repeat(np.arange(looks.n_features), len(later_s)), np.tile(later_s, looks.n_features)
    if at_rows:
        (p_ahead, p_exists), track = ask(models, looks, ahead, (feature, stamp_s))
        p_at_looks = p_exists[order[table.looked[order]]]
    else:
        at_looks = looks.feature, looks.stamp_s
        (p_ahead, p_exists, p_at_looks), track = ask(models, looks, ahead, (feature, stamp_s), at_looks)
    forecasts = forecasts_of(models, looks, later_s, p_ahead.reshape(looks.n_features, len(later_s)))
    return Beliefs(stamp_s, feature, p_exists), p_at_looks, forecasts, float(track.merged_mass.max())


def _grid(table: LookTable, config: PersistConfig) -> tuple[IntArray, FloatArray]:
    """Regular instants from the first to the last row of the table, the same for all features.

    Raises:
        ConfigError: so many that the step must be wrong.
    """
    start_s, stop_s = float(table.stamp_s.min()), float(table.stamp_s.max())
    step_s = config.step_s or nice_step((stop_s - start_s) / config.grid_steps)
    count = int(np.floor((stop_s - start_s) / step_s * (1.0 + 1e-12))) + 1
    if count * table.n_features > MOST_ROWS:
        problem = f"{step_s:g} s make {count} instants of {table.n_features} features"
        raise ConfigError(problem, field="step_s", hint="a longer step, or `query` times")
    instants = start_s + step_s * np.arange(count)
    return np.repeat(np.arange(table.n_features), count), np.tile(instants, table.n_features)


def nice_step(at_least_s: float) -> float:
    """Return the next longer one of 1, 2, 5, 10, ... s or parts of it; 1 s for no span at all."""
    if at_least_s <= 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(at_least_s))
    return float(next(power * f for f in (1.0, 2.0, 5.0, 10.0) if power * f >= at_least_s * (1.0 - 1e-9)))


def _score(
    table: LookTable, beliefs: Beliefs, truth: Truth | None, at_rows: FloatArray | None
) -> tuple[BeliefScores | None, Reliability | None]:
    """Beliefs against truth wherever there are both; `at_rows` is the truth where it stands beside the beliefs."""
    if truth is None:
        return None, None
    present = truth.at(beliefs.feature, beliefs.stamp_s) if at_rows is None else at_rows
    both = ~np.isnan(present) & ~np.isnan(beliefs.p_exists)
    if not both.any():
        problem = "no belief falls into the time of which the truth is known"
        raise InputError(problem, path=table.source or None, field="present", hint="the same clock in both tables")
    belief, there = beliefs.p_exists[both], present[both]
    return belief_scores(belief, there), reliability(belief, there)


def _remarks(config: PersistConfig, models: ModelOfEach, looks: Looks, beliefs: Beliefs, changes: Changes) -> list[str]:
    remarks = _odd_looks(looks)
    if config.learns and len(looks.stamp_s) > config.learn_from:
        remarks.append(
            f"the model learned from at most {config.learn_from:,} of {len(looks.stamp_s):,} looks (`learn_from`)"
        )
    for name, model in zip(models.names, models.models, strict=True):
        stay = getattr(getattr(model, "prior", None), "p_never_leaves", 0.0)
        if stay > 0.0:
            whose = f"class {quote(name)}: " if name else ""
            remarks.append(f"{whose}{100.0 * stay:.3g} % of the features never leave, by the prior")
    unborn = int(np.isnan(beliefs.p_exists).sum())
    if unborn and config.stays_once:
        remarks.append(f"{counted(unborn, 'belief')} left empty: a feature has no belief before its first detection")
    back = len(np.unique(changes.feature[changes.returned]))
    if back and config.stays_once:
        remarks.append(f"{counted(back, 'feature')} came back, which lifetimes of one stay rule out: try `recurrent`")
    return remarks


def _odd_looks(looks: Looks) -> list[str]:
    """What makes beliefs wrong without being impossible: no miss or no hit at all, and looks that came twice."""
    remarks = []
    count = len(looks.stamp_s)
    hits = int(looks.detected.sum())
    if hits == count and count > looks.n_features:
        remarks.append(
            f"not one of {count:,} looks is a miss, so nothing can vanish: a row with detected 0 is needed wherever a "
            "feature was looked at and not detected"
        )
    elif hits == 0 and count > looks.n_features:
        remarks.append(f"not one of {count:,} looks is a detection: is the column 'detected' inverted?")
    of_look = looks.feature
    again = (np.diff(of_look) == 0) & (np.diff(looks.stamp_s) == 0.0)
    other = again & (np.diff(looks.detected) != 0.0)
    for what, many in (("repeat", again & ~other), ("contradict", other)):
        if many.any():
            row = int(np.argmax(many))
            remarks.append(
                f"{counted(int(many.sum()), 'look')} that {what} another at the same feature and time, each taken as "
                f"evidence of its own (first at {looks.stamp_s[row]:.15g} s): one row a look is meant"
            )
    return remarks


def _named(error: NumericalError, table: LookTable, order: IntArray) -> Exception:
    """Return the error of a model, which counts looks, with the feature's name and the line in the file."""
    if error.row is None:
        return error
    row = order[table.looked[order]][error.row]
    return InputError(
        f"feature {quote(table.names[table.feature[row]])} at {table.stamp_s[row]:.15g} s: this observation is "
        "impossible, whether the feature is there or gone",
        path=table.source or None,
        line=int(table.line[row]),
        field="detected",
        hint=error.hint,
    )


class _Steps:
    """Wall time by step, and the progress of the whole."""

    def __init__(self, names: tuple[str, ...], progress: Progress | None) -> None:
        self._names, self._progress, self._start = names, progress, time.perf_counter()
        self.step_s: dict[str, float] = {}

    def within(self, part: float) -> None:
        """Note that a part of the present step is done."""
        if self._progress:
            self._progress(len(self.step_s) + part, len(self._names))

    def done(self, name: str) -> None:
        now = time.perf_counter()
        self.step_s[name] = now - self._start
        self._start = now
        self.within(0.0)
