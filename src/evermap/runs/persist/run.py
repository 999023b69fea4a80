"""From a table of looks to beliefs, changes, forecasts and scores; reads as the steps of a run."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from evermap.config import PersistConfig
from evermap.errors import ConfigError, DataError, InputError, NumericalError
from evermap.existence.one_stay import OneStay
from evermap.existence.protocol import Looks
from evermap.io.columns import TableSource
from evermap.io.text import counted, quote
from evermap.metrics.belief import BeliefScores, Reliability, belief_scores, reliability
from evermap.runs.persist.changes import (
    MOST_FEATURES,
    Changes,
    Forecasts,
    find_changes,
    forecast_stamps,
    forecasts_of,
    most_changed,
)
from evermap.runs.persist.models import ModelOfEach, ask, models_for
from evermap.runs.persist.table import LookTable, Truth, are_numbers, read_looks
from evermap.show import Shown, ShownTable, data_frame, draw
from evermap.types import ChangeKind, FloatArray, IntArray, Progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evermap.runs.persist.models import LearnedModels


_CHANGE = ("stamp_s", "earliest_s", "latest_s", "decided_s", "confidence")
BELIEF = ("stamp_s", "feature_id", "p_exists")
OUTLOOK = ("median_stay_s", "mean_stay_s", "mean_absence_s")
"""Columns of beliefs, and what those of forecasts have beside them."""
MOST_ROWS = 100_000_000
"""Number of beliefs above which the step is considered a mistake."""


Part = Literal["beliefs", "changes", "forecasts"]
"""Tables of a result."""


@dataclass(frozen=True, slots=True, repr=False)
class Beliefs(ShownTable):
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
class Totals:
    """What a run counts; of a table in parts, over all of them.

    Attributes:
        rows, looks, detections: of the table.
        features_detected: features with a detection.
        beliefs, unborn: instants with a belief, and without one.
        vanished, returned: changes of each kind.
        features_back: features that returned.
        p_now: (F,) probability of presence at the latest look.
        merged_mass: largest probability that a filter of limited memory moved about within one feature.
        p_miss, p_false: least and largest of the looks.
        repeated, contradicted: looks that repeat or contradict another at the same feature and time, and when first.
    """

    rows: int
    looks: int
    detections: int
    features_detected: int
    beliefs: int
    unborn: int
    vanished: int
    returned: int
    features_back: int
    p_now: FloatArray
    merged_mass: float
    p_miss: tuple[float, float]
    p_false: tuple[float, float]
    repeated: tuple[int, float]
    contradicted: tuple[int, float]

    @classmethod
    def of(
        cls, table: LookTable, looks: Looks, beliefs: Beliefs, changes: Changes, forecasts: Forecasts, merged: float
    ) -> Totals:
        """Count."""
        born, looked = int((~np.isnan(beliefs.p_exists)).sum()), table.looked
        again = (np.diff(looks.feature) == 0) & (np.diff(looks.stamp_s) == 0.0)
        other = again & (np.diff(looks.detected) != 0.0)
        twice = [
            (int(k.sum()), float(looks.stamp_s[np.argmax(k)]) if k.any() else np.nan) for k in (again & ~other, other)
        ]
        errors = [(float(v.min(initial=np.inf)), float(v.max(initial=-np.inf)))
                  for v in (table.p_miss[looked], table.p_false[looked])]  # fmt: skip
        return cls(
            rows=len(table),
            looks=int(looked.sum()),
            detections=int((table.detected == 1.0).sum()),
            features_detected=len(np.unique(table.feature[table.detected == 1.0])),
            beliefs=born,
            unborn=len(beliefs) - born,
            vanished=int((~changes.returned).sum()),
            returned=int(changes.returned.sum()),
            features_back=len(np.unique(changes.feature[changes.returned])),
            p_now=forecasts.p_exists[:, 0],
            merged_mass=merged,
            p_miss=errors[0],
            p_false=errors[1],
            repeated=twice[0],
            contradicted=twice[1],
        )

    @classmethod
    def merged(cls, parts: Sequence[Totals]) -> Totals:
        """Return those of all parts."""
        values: dict[str, Any] = {}
        for item in fields(cls):
            each = [getattr(part, item.name) for part in parts]
            if item.name == "p_now":
                values[item.name] = np.concatenate(each)
            elif item.name in ("p_miss", "p_false"):
                values[item.name] = min(one[0] for one in each), max(one[1] for one in each)
            elif item.name in ("repeated", "contradicted"):
                values[item.name] = sum(one[0] for one in each), next((one[1] for one in each if one[0]), np.nan)
            else:
                values[item.name] = max(each) if item.name == "merged_mass" else sum(each)
        return cls(**values)


@dataclass(frozen=True, slots=True, repr=False)
class PersistResult(Shown):
    """All results of a run.

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
        totals: what is counted.
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
    totals: Totals
    step_s: dict[str, float]
    warnings: tuple[str, ...]

    def to_pandas(self, part: Part = "beliefs") -> Any:
        """Return a data frame with the ids of the features: a row a belief, a change, or an instant of a forecast.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        names = self.table.names
        ids = np.array([int(name) for name in names] if are_numbers(names) else names, dtype=object)
        return data_frame(self.columns_of(part, ids.__getitem__)).infer_objects()

    def columns_of(self, part: Part, name: Callable[[IntArray], Any]) -> dict[str, Any]:
        """Return the columns of a table, as `Beliefs`, `Changes` and `Forecasts` have them, in rows.

        What is expected from now on is in the first row of each feature's forecast. `name` makes the column
        `feature_id` of indices of features.
        """
        if part == "beliefs":
            found = self.beliefs
            return dict(zip(BELIEF, (found.stamp_s, name(found.feature), found.p_exists), strict=True))
        if part == "changes":
            changes = self.changes
            kind = np.where(changes.returned, ChangeKind.RETURNED.value, ChangeKind.VANISHED.value).astype(object)
            when = {column: getattr(changes, column) for column in _CHANGE}
            return {"feature_id": name(changes.feature), "kind": kind, **when}
        ahead = self.forecasts
        features, steps = ahead.p_exists.shape
        cells = np.tile(ahead.stamp_s, features), name(np.repeat(np.arange(features), steps)), ahead.p_exists.ravel()
        columns = dict(zip(BELIEF, cells, strict=True))
        for outlook in OUTLOOK:
            expected = np.full((features, steps), np.nan)
            expected[:, 0] = getattr(ahead, outlook)
            columns[outlook] = expected.ravel()
        return columns

    def plot(self) -> Figure:
        """Draw the beliefs over time, a row a feature, of the 60 that changed most; returns a matplotlib figure."""
        return draw("plot_persist_run", self)

    def most_changed(self, n: int = MOST_FEATURES) -> IntArray:
        """Return the indices of the `n` features that changed most, of equals those looked at more often."""
        return most_changed(self.changes.per_feature(self.table.n_features), np.diff(self.looks.first), n)

    def _facts(self) -> dict[str, Any]:
        span = self.table.span
        return {
            "source": self.table.source,
            "features": self.table.n_features,
            "looks": self.totals.looks,
            "from_s": round(span.start_s, 3),
            "to_s": round(span.stop_s, 3),
            "vanished": self.totals.vanished,
            "returned": self.totals.returned,
            "expected_present_now": round(float(np.nansum(self.totals.p_now)), 2),
            "warnings": self.warnings,
        }


def run_persist(
    looks: LookTable | TableSource,
    config: PersistConfig | None = None,
    *,
    truth: Truth | None = None,
    progress: Progress | None = None,
) -> PersistResult:
    """Compute beliefs, changes and forecasts of a table of looks.

    Args:
        looks: of `read_looks`, or what that takes: a data frame, or a file.
        config: choices; the defaults where None.
        truth: what truly was there, for scores and figures only; None takes the column `present` of the table.
        progress: told after each step.

    Raises:
        ConfigError: choices that cannot be.
        InputError: as of `read_looks`; a look that is impossible, whether the feature was there or not.
        DataError: looks from which no model can be learned.
    """
    config = config or PersistConfig()
    table = looks if isinstance(looks, LookTable) else read_looks(looks, p_miss=config.p_miss, p_false=config.p_false)
    clock = _Steps(("sort", "learn", "filter", "changes", "score"), progress)
    order = table.order()
    ordered = table.looks(order)
    clock.done("sort")
    try:
        models, learned = models_for(config, table, ordered, clock.within)
        clock.done("learn")
        beliefs, p_at_looks, forecasts, merged_mass = _filter(table, order, config, models, ordered)
    except NumericalError as error:
        raise _name_error(error, table, order) from error
    except DataError as error:
        raise DataError(error.problem, path=table.source or None, hint=error.hint) from error
    clock.done("filter")
    changes = find_changes(ordered, p_at_looks, config.confidence, config.tail)
    clock.done("changes")
    at_rows = table.present if truth is None and config.query == "times" else None
    truth = truth or table.truth(order)
    scores, bins = _score(table, beliefs, truth, at_rows)
    clock.done("score")
    totals = Totals.of(table, ordered, beliefs, changes, forecasts, merged_mass)
    return PersistResult(
        table, config, models, learned, ordered, p_at_looks, beliefs, changes, forecasts, truth, scores, bins,
        totals, clock.step_s, (*table.warnings, *remarks(config, models, totals)),
    )  # fmt: skip


def warm_up() -> None:
    """Compile the kernels of the persistence filter, or load them."""
    looks = Looks.from_rows([0, 0], [0.0, 1.0], [1, 1], 0.1, 0.1)
    OneStay.of_text(PersistConfig().prior).track(looks)


def _filter(
    table: LookTable, order: IntArray, config: PersistConfig, models: ModelOfEach, looks: Looks
) -> tuple[Beliefs, FloatArray, Forecasts, float]:
    """Return beliefs at the requested instants and at the looks, forecasts, and the merged mass."""
    at_rows = config.query == "times"
    feature, stamp_s = (table.feature, table.stamp_s) if at_rows else _grid(table, config)
    later_s = forecast_stamps(table.span, config)
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
    start_s, stop_s = table.span[:2]
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
        problem = "no belief lies within the time of the truth"
        raise InputError(problem, path=table.source or None, field="present", hint="the same clock in both tables")
    belief, there = beliefs.p_exists[both], present[both]
    return belief_scores(belief, there), reliability(belief, there)


def remarks(config: PersistConfig, models: ModelOfEach, totals: Totals) -> list[str]:
    """Return what is odd about a table or a run."""
    told = _odd_looks(totals)
    if config.learns and totals.looks > config.learn_from:
        told.append(f"the model learned from at most {config.learn_from:,} of {totals.looks:,} looks (`learn_from`)")
    for name, stay in models.never_leave().items():
        if stay > 0.0:
            whose = f"class {quote(name)}: " if name else ""
            told.append(f"{whose}{100.0 * stay:.3g} % of the features never leave, by the prior")
    if totals.unborn and config.stays_once:
        empty = counted(totals.unborn, "belief")
        told.append(f"{empty} left empty: a feature has no belief before its first detection")
    if totals.features_back and config.stays_once:
        back = counted(totals.features_back, "feature")
        told.append(f"{back} returned, which lifetimes of one stay rule out: try `recurrent`")
    return told


def _odd_looks(totals: Totals) -> list[str]:
    """Return warnings on implausible looks: no miss or no hit at all, and repeated looks."""
    told = []
    several = totals.looks > len(totals.p_now)
    if totals.detections == totals.looks and several:
        told.append(
            f"none of {totals.looks:,} looks is a miss, so nothing can vanish: add a row with detected 0 "
            "wherever a feature was looked at and not detected"
        )
    elif totals.detections == 0 and several:
        told.append(f"none of {totals.looks:,} looks is a detection: is the column 'detected' inverted?")
    for what, (count, first_s) in (("repeat", totals.repeated), ("contradict", totals.contradicted)):
        if count:
            told.append(
                f"{counted(count, 'look')} that {what} another at the same feature and time, each counted as "
                f"independent evidence (first at {first_s:.15g} s): write one row per look"
            )
    return told


def _name_error(error: NumericalError, table: LookTable, order: IntArray) -> Exception:
    """Return the error of a model, which counts looks, with the feature's name and the line in the file."""
    if error.row is None:
        return error
    row = order[table.looked[order]][error.row]
    look = f"feature {quote(table.names[table.feature[row]])} at {table.stamp_s[row]:.15g} s"
    problem = f"{look}: this observation is impossible, whether the feature is there or gone"
    line = int(table.line[row])
    return InputError(problem, path=table.source or None, line=line, field="detected", hint=error.hint)


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
