"""The run-length filter: presence as stays and absences of any lifetime, each with or without a rhythm of the week.

The belief about a feature is a list of hypotheses: in this state, since this instant, with this probability. For
lifetimes that forget their age use `PhaseType`, which needs no list.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from evermap.errors import ConfigError
from evermap.existence import protocol as checks
from evermap.existence.lifetimes import HazardTable, Lifetimes, bins_of, edges, proportional, tabulate
from evermap.existence.protocol import (
    Instants,
    LookColumns,
    Looks,
    RecurrentBeliefTable,
    Track,
)
from evermap.existence.rhythm import BIN_S, BINS, MONDAY_S, DayShares, Rhythm, on_other_days
from evermap.show import Shown
from evermap.survival.base import LifetimePrior
from evermap.types import FloatArray, IntArray

if TYPE_CHECKING:
    from evermap.existence.run_length_kernels import BeliefRows, First, Law

ABSENT, PRESENT = 0, 1
_MOST_HYPOTHESES = 10_000


@dataclass(frozen=True)
class RunLength(Shown):
    """Presence as an alternating renewal process (MATH.md section 4).

    A hazard at local time `t` of a stay of age `a` is that of its lifetime at `a` times its rhythm at `t`. Within one
    step of time a feature changes at most once, in the middle of it.

    With `unusual` days, each day from midnight to midnight is of a kind `k`, drawn from their shares `p_k`, and the
    rhythm is `r_k(t)` (`rhythm.on_other_days`). The filter holds `w_k(s, b) = P(k, in state s since b | looks)`: within
    a day a look multiplies all kinds by the same likelihood of `s`, so that kinds are told by how their hazards
    predicted it, and at midnight `w_k(s, b) <- p_k sum_j w_j(s, b)`.

    Attributes:
        stay: lifetime of presences.
        absence: lifetime of absences.
        step_s: longest step of time; a small part of a typical stay or absence.
        stay_rhythm: factor on the hazard of leaving, over the local week.
        absence_rhythm: factor on the hazard of returning.
        newborn: features are there, and new, when they are first heard of; otherwise they have come and gone for ever.
        hypotheses: how many are kept of each feature.
        unusual: shares of the days that do not follow the rhythm; all do where None.

    Raises:
        ConfigError: a step that is not positive, fewer than 8 hypotheses or more than 10,000, or unusual days without a
            rhythm.
    """

    stay: LifetimePrior
    absence: LifetimePrior
    step_s: float
    stay_rhythm: Rhythm | None = None
    absence_rhythm: Rhythm | None = None
    newborn: bool = False
    hypotheses: int = 64
    unusual: DayShares | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.step_s < np.inf:
            raise ConfigError(f"{self.step_s} s is not a step of time", field="step_s", hint="a positive number")
        if self.hypotheses < 8:
            raise ConfigError(f"{self.hypotheses} hypotheses are too few", field="hypotheses", hint="8 or more")
        if self.hypotheses > _MOST_HYPOTHESES:
            problem = f"{self.hypotheses} hypotheses are too many"
            raise ConfigError(problem, field="hypotheses", hint=f"at most {_MOST_HYPOTHESES}")
        if self.unusual and not (self.stay_rhythm or self.absence_rhythm):
            raise ConfigError("without a rhythm no day is unusual", field="unusual", hint="None, or a rhythm")
        if self.unusual and not (min(self.unusual) >= 0.0 and sum(self.unusual) < 1.0):
            raise ConfigError(f"{tuple(self.unusual)} are not shares of days", field="unusual", hint="a sum below 1")

    @classmethod
    def from_lifetimes(cls, lifetimes: Lifetimes, *, step_s: float | None = None) -> RunLength:
        """Return the model of two lifetimes, such as a map has learned.

        Args:
            lifetimes: of stays and absences.
            step_s: longest step of time; a hundredth of the shorter median where None.
        """
        medians = [float(prior.quantile(0.5)) for prior in lifetimes]
        shortest = min((median for median in medians if 0.0 < median < np.inf), default=100.0)
        return cls(lifetimes.stay, lifetimes.absence, step_s or 0.01 * shortest)

    @property
    def lifetimes(self) -> Lifetimes:
        """Stay and absence; a rhythm counts with its mean over the week."""
        pairs = ((self.stay, self.stay_rhythm), (self.absence, self.absence_rhythm))
        factors = [float(rhythm.factor.mean()) if rhythm else 1.0 for _, rhythm in pairs]
        _, edge_s = edges(self.step_s)
        return Lifetimes(*(proportional(prior, f, edge_s) for (prior, _), f in zip(pairs, factors, strict=True)))

    def track(self, looks: Looks, instants: Instants | None = None) -> Track:
        """Filter every feature's looks; asked at the looks themselves where `instants` is None.

        Raises:
            NumericalError: a look that is impossible, whether the feature is there or not.
        """
        from evermap.existence import run_length_kernels as kernels

        asked = instants or Instants.of_looks(looks)
        answer, evidence, moved, bad = kernels.track(
            looks.first, looks.columns(), asked.first, asked.stamp_s, self.slots, self.law, self.first
        )
        for feature in np.flatnonzero(bad >= 0)[:1]:
            raise looks.impossible(int(looks.first[feature] + bad[feature]))
        return Track(answer, evidence, moved)

    @property
    def slots(self) -> int:
        """Places of a list: those of one state, and one for the newcomer."""
        return self.hypotheses // 2 + 1

    @cached_property
    def law(self) -> Law:
        """The model as the kernels want it."""
        from evermap.existence.run_length_kernels import Law

        absence, stay = self.tables
        none = np.ones((1, 2, 1))
        if self.stay_rhythm or self.absence_rhythm:
            rhythms = (self.absence_rhythm, self.stay_rhythm)
            factor = np.stack([rhythm.factor if rhythm else np.ones(BINS) for rhythm in rhythms])[None]
        else:
            factor = none
        share = np.ones(1)
        if self.unusual:
            share, factor = np.array([1.0 - sum(self.unusual), *self.unusual]), on_other_days(factor[0])
        hazard = np.stack([absence.hazard_hz, stay.hazard_hz])
        intercept = np.stack([table.cumulative - table.hazard_hz * table.edge_s for table in self.tables])
        # a step is never longer than the rhythm is constant
        step_s = min(self.step_s, BIN_S) if factor is not none else self.step_s
        return Law(float(step_s), share, factor, absence.offset, hazard, intercept)

    @cached_property
    def tables(self) -> tuple[HazardTable, HazardTable]:
        """The lifetimes of absences and of stays as tables."""
        return tabulate(self.absence, self.step_s), tabulate(self.stay, self.step_s)

    @cached_property
    def first(self) -> First:
        """Return the belief before the first look."""
        from evermap.existence.run_length_kernels import First, RunHypotheses, week_of_beliefs

        kinds = len(self.law.share)
        age, weight = np.zeros((1, 2, self.slots)), np.zeros((1, kinds, 2, self.slots))
        if self.newborn:
            weight[0, :, PRESENT, 0] = self.law.share
            return First(age, weight, np.array([[0, 1]]))
        for state, table in enumerate(self.tables):
            age[0, state, :-1], mass = _equilibrium(table, self.slots - 1)
            weight[0, :, state, :-1] = self.law.share[:, None] * mass
        weight /= weight.sum()
        count = np.full((1, 2), self.slots - 1)
        if self.law.factor.shape[2] == 1:
            return First(age, weight, count)
        ages, weights = np.zeros((BINS, 2, self.slots)), np.zeros((BINS, kinds, 2, self.slots))
        counts = np.zeros((BINS, 2), dtype=np.int64)
        week = First(ages, weights, counts)
        week_of_beliefs(RunHypotheses(MONDAY_S - age[0], weight[0], count[0]), self.law, week)
        return week

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain numbers and words, for JSON."""
        from evermap.survival.text import prior_to_dict

        return {
            "kind": "run-length",
            "stay": prior_to_dict(self.stay),
            "absence": prior_to_dict(self.absence),
            "step_s": self.step_s,
            "stay_rhythm": self.stay_rhythm.to_dict() if self.stay_rhythm else None,
            "absence_rhythm": self.absence_rhythm.to_dict() if self.absence_rhythm else None,
            "newborn": self.newborn,
            "hypotheses": self.hypotheses,
            "unusual": list(self.unusual) if self.unusual else None,
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> RunLength:
        """Return the model that `to_dict` wrote."""
        from evermap.survival.text import prior_from_dict

        rhythms = (data["stay_rhythm"], data["absence_rhythm"])
        stay_rhythm, absence_rhythm = (Rhythm.from_dict(rhythm) if rhythm else None for rhythm in rhythms)
        return cls(
            prior_from_dict(data["stay"]),
            prior_from_dict(data["absence"]),
            float(data["step_s"]),
            stay_rhythm,
            absence_rhythm,
            bool(data["newborn"]),
            int(data["hypotheses"]),
            DayShares(*map(float, data["unusual"])) if data.get("unusual") else None,
        )


def _equilibrium(table: HazardTable, n: int) -> tuple[FloatArray, FloatArray]:
    """Return the stationary ages of a state, as `n` points of equal weight, times the mean lifetime.

    The age of what is met at random has density `S(age)`, of integral `E[T]`; ages beyond the table count as its end.
    """
    survival, width = table.survival(), np.diff(table.edge_s)
    width = np.append(width, width[-1])  # the last bin counts as wide as the one before
    drop = np.append(np.diff(table.cumulative), 0.0)
    mass = survival * width * np.where(drop > 1e-9, -np.expm1(-drop) / np.maximum(drop, 1e-300), 1.0)
    middle = table.edge_s + 0.5 * width
    total = mass.sum()
    group = np.minimum((np.cumsum(mass) / total * n).astype(np.int64), n - 1)
    weight = np.bincount(group, mass, n)
    age = np.bincount(group, mass * middle, n) / np.where(weight > 0.0, weight, 1.0)
    # older hypotheses first, as everywhere
    return np.maximum.accumulate(age)[::-1].copy(), np.array(weight[::-1], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class RunLengthBelief(RecurrentBeliefTable):
    """Beliefs about N features, one row each; state `s` is 0 absent, 1 present.

    Attributes:
        model: how they come and go.
        start_s: (N, 2, S) since when.
        weight: (N, K, 2, S) with which probability, and on which kind of day.
        count: (N, 2) number of hypotheses; places beyond it hold anything.
        stamp_s: (N,) when these held.
        log_evidence: (N,) `log p(looks)`.
        merged_mass: (N,) probability moved between hypotheses so far.
    """

    model: RunLength
    start_s: FloatArray
    weight: FloatArray
    count: IntArray
    stamp_s: FloatArray
    log_evidence: FloatArray
    merged_mass: FloatArray

    @property
    def rows(self) -> BeliefRows:
        """The same in the layout of the kernels."""
        from evermap.existence.run_length_kernels import BeliefRows, RunHypotheses

        held = RunHypotheses(self.start_s, self.weight, self.count)
        return BeliefRows(held, self.stamp_s, self.log_evidence, self.merged_mass)

    @property
    def probability(self) -> FloatArray:
        """(N,) probability of presence at `stamp_s`."""
        held = np.arange(self.weight.shape[3]) < self.count[:, PRESENT, None]
        there = self.weight[:, :, PRESENT].sum(axis=1)
        return np.asarray(there.sum(axis=1, where=held).clip(0.0, 1.0), dtype=np.float64)

    @classmethod
    def _first(cls, model: RunLength, time: FloatArray) -> Self:
        from evermap.existence.run_length_kernels import RunHypotheses, begin_rows

        n = len(time)
        start, weight = np.zeros((n, 2, model.slots)), np.zeros((n, len(model.law.share), 2, model.slots))
        count = np.zeros((n, 2), dtype=np.int64)
        begin_rows(RunHypotheses(start, weight, count), time, model.first)
        return cls(model, start, weight, count, time, np.zeros(n), np.zeros(n))

    @classmethod
    def _after(cls, model: RunLength, looks: Looks, ends_s: FloatArray) -> Self:
        from evermap.existence.run_length_kernels import look_rows

        state = cls._first(model, ends_s[0])
        bad = look_rows(looks.feature, state.rows, looks.columns(), model.law)
        if bad >= 0:
            raise looks.impossible(bad)
        return state

    def _presence(self, index: IntArray, time: FloatArray) -> FloatArray:
        from evermap.existence.run_length_kernels import predict_rows

        belief = np.empty(len(index))
        predict_rows(index, self.rows, time, self.model.law, belief)
        return belief

    def _look(self, index: IntArray, time: FloatArray, there: FloatArray, gone: FloatArray) -> Self:
        from evermap.existence.run_length_kernels import look_rows

        names = ("start_s", "weight", "count", "stamp_s", "log_evidence", "merged_mass")
        after = replace(self, **{name: getattr(self, name).copy() for name in names})
        bad = look_rows(index, after.rows, LookColumns(time, there, gone), self.model.law)
        if bad >= 0:
            raise checks.impossible(f"row {index[bad]}")
        return after

    def _mean_time(self, present: bool) -> FloatArray:
        """Return the mean residual life `int S(a + t) dt / S(a)` over the belief of the age `a`.

        With a rhythm, a numerical integral over the coming weeks.
        """
        which, law = int(present), self.model.law
        if law.factor.shape[2] > 1:
            from evermap.existence.run_length_kernels import remaining_rows

            left = np.empty(len(self))
            remaining_rows(self.rows, which, law, WEEKS, left)
            return left
        held = np.arange(self.weight.shape[3]) < self.count[:, which, None]
        weight = np.where(held, self.weight[:, 0, which], 0.0)
        age = np.where(held, self.stamp_s[:, None] - self.start_s[:, which], 0.0)
        life = residual_life(self.model.tables[which], age)
        total = weight.sum(axis=1)
        mean = (weight * np.where(weight > 0.0, life, 0.0)).sum(axis=1) / np.where(total > 0.0, total, 1.0)
        return np.where(total > 0.0, mean, np.nan)

    def p_lasts(self, stamp_s: Any, *, present: bool = True) -> FloatArray:
        """Return the probability that a present feature is still there, without a break, at instants ahead.

        Args:
            stamp_s: (T,) instants in order, none before any row's last.
            present: False: that an absent feature has not returned.

        Returns:
            (N, T) probabilities; NaN where the feature is certainly not in this state.

        Raises:
            InputError: an instant that is not finite, out of order, or before a row's last.
        """
        from evermap.existence.run_length_kernels import lasting_rows

        time = checks.as_instants(stamp_s, self.stamp_s.max(initial=-np.inf))
        out = np.empty((len(self), len(time)))
        lasting_rows(self.rows, int(present), time, self.model.law, out)
        return out


WEEKS = 8
"""How far ahead a rhythm is followed; what lasts longer goes on as in the last of these weeks."""


def residual_life(table: HazardTable, age_s: FloatArray) -> FloatArray:
    """Return the expected time that is left at an age: closed in every bin of the table, an exponential tail after the
    last.

    Args:
        table: a lifetime.
        age_s: ages of any shape.

    Returns:
        Seconds, of the same shape; `inf` where the last hazard is 0 and can be reached.
    """
    hazard, edge = table.hazard_hz, table.edge_s
    left = np.empty(len(edge) + 1)
    endless = hazard[-1] == 0.0
    left[-2:] = 0.0 if endless else 1.0 / hazard[-1]
    for k in range(len(edge) - 2, -1, -1):
        left[k] = _through_bin(hazard[k], edge[k + 1] - edge[k], left[k + 1])
    i = bins_of(age_s, table.offset, len(edge))
    width = np.append(edge[1:], np.inf)[i] - age_s
    last = i == len(edge) - 1
    inside = np.where(last, left[-1], _through_bin(hazard[i], np.where(last, 0.0, width), left[i + 1]))
    to_go = table.cumulative[-1] - (table.cumulative[i] + hazard[i] * np.where(last, 0.0, age_s - edge[i]))
    return np.asarray(np.where(endless & (np.exp(-to_go) > 0.0), np.inf, inside), dtype=np.float64)


def _through_bin(hazard: Any, width: Any, beyond: Any) -> Any:
    """Expected time left, from inside a bin of constant hazard with `width` to go to one where `beyond` is left."""
    x = hazard * width
    spent = width * np.where(x > 1e-9, -np.expm1(-x) / np.maximum(x, 1e-300), 1.0)
    return spent + np.exp(-x) * beyond
