"""The protocol of presence models, their tables (looks, instants, tracks), and the validation of these.

Errors name the row and what to try.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from evermap.errors import DataError, InputError, NumericalError
from evermap.existence.lifetimes import Lifetimes
from evermap.show import Shown
from evermap.survival.base import LifetimePrior
from evermap.types import BoolArray, FloatArray, IntArray


def as_prior(prior: LifetimePrior | str) -> LifetimePrior:
    """Return a lifetime prior, or the one that a text such as `exponential:half-life=30d` describes.

    Raises:
        ConfigError: a text that describes none.
        InputError: something else.
    """
    if isinstance(prior, str):
        from evermap.survival.text import parse_prior

        return parse_prior(prior)
    if isinstance(prior, type) or not hasattr(prior, "log_conditional_survival"):
        name = prior.__name__ if isinstance(prior, type) else type(prior).__name__
        hint = "'exponential:half-life=30d', or a distribution of evermap.survival"
        raise InputError(f"a lifetime prior is needed, not {name}", field="prior", hint=hint)
    return prior


def as_rows(values: Any, n: int, field: str) -> FloatArray:
    """Return `values` as float64 of shape (n,): a scalar serves all rows.

    Raises:
        InputError: not numbers, or a shape that does not fit.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError("not numbers", field=field) from error
    if array.shape == (n,):
        return np.ascontiguousarray(array)
    if array.ndim:
        raise InputError(f"shape {array.shape} instead of ({n},)", field=field)
    return np.full(n, float(array))


def as_instants(stamp_s: Any, last_s: float = -np.inf) -> FloatArray:
    """Return (T,) instants, finite, in order, and none before `last_s`.

    Raises:
        InputError: others.
    """
    time = np.array(stamp_s, dtype=np.float64).reshape(-1)
    if (np.diff(time) < 0.0).any():
        raise InputError("the instants asked for are not in order of time", field="stamp_s", hint="sort them")
    check_times(time, np.full(len(time), last_s), noun="instant")
    return time


def _first(wrong: BoolArray, rows: IntArray | None) -> tuple[int, int] | None:
    """Return the position of the first invalid value in the arrays, and its row."""
    where = np.flatnonzero(wrong)
    if not where.size:
        return None
    position = int(where[0])
    return position, position if rows is None else int(rows[position])


def check_probability(values: FloatArray, field: str, rows: IntArray | None = None, noun: str = "row") -> None:
    """Raise `InputError` unless all of `values` lie in [0, 1]."""
    if first := _first(~((values >= 0.0) & (values <= 1.0)), rows):
        position, row = first
        raise InputError(
            f"{noun} {row}: {values[position]} is not a probability", field=field, hint="a number between 0 and 1"
        )


def check_log_likelihood(values: FloatArray, field: str, rows: IntArray | None = None) -> None:
    """Raise `InputError` unless all of `values` are numbers; an infinity is a certainty."""
    if first := _first(np.isnan(values), rows):
        raise InputError(f"row {first[1]}: nan is not a log-likelihood", field=field, hint="a number, or an infinity")


def check_detected(values: FloatArray, rows: IntArray | None = None, noun: str = "row") -> None:
    """Raise `InputError` unless all of `values` are 0 or 1."""
    if first := _first(~((values == 0.0) | (values == 1.0)), rows):
        position, row = first
        raise InputError(
            f"{noun} {row}: {values[position]} is neither a detection nor a miss", field="detected", hint="1 or 0"
        )


def check_times(time_s: FloatArray, last_s: FloatArray, rows: IntArray | None = None, noun: str = "row") -> None:
    """Raise `InputError` unless every time is finite and not before the row's last observation."""
    if first := _first(~np.isfinite(time_s), rows):
        position, row = first
        raise InputError(f"{noun} {row}: time {time_s[position]} is not finite", field="stamp_s", hint="a finite time")
    if first := _first(time_s < last_s, rows):
        position, row = first
        past = "its birth" if last_s[position] == 0.0 else f"its last observation at {last_s[position]} s"
        raise InputError(
            f"{noun} {row}: time {time_s[position]} s lies before {past}",
            field="stamp_s",
            hint="sort by time, count from the feature's birth",
        )


def check_possible(inverse_odds: FloatArray, rows: IntArray | None = None, noun: str = "row") -> None:
    """Raise `NumericalError` where an update came out as 0 / 0: impossible under both states."""
    if first := _first(np.isnan(inverse_odds), rows):
        _, row = first
        raise NumericalError(impossible(f"{noun} {row}"), hint="P_M and P_F strictly between 0 and 1")


def check_looks(
    time_s: FloatArray,
    detected: FloatArray,
    p_miss: FloatArray,
    p_false: FloatArray,
    last_s: FloatArray,
    rows: IntArray | None = None,
) -> None:
    """Raise `InputError` unless times do not run back, detections are 0 or 1, and error rates are probabilities."""
    check_times(time_s, last_s, rows)
    check_detected(detected, rows)
    check_probability(p_miss, "p_miss", rows)
    check_probability(p_false, "p_false", rows)


def likelihoods(detected: FloatArray, p_miss: FloatArray, p_false: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the likelihood of each look if the feature is there, and if it is not."""
    seen = detected == 1.0
    return np.where(seen, 1.0 - p_miss, p_miss), np.where(seen, p_false, 1.0 - p_false)


def impossible(who: str) -> str:
    """Return the one sentence for an observation that neither state of the feature can have caused."""
    return f"{who}: this observation is impossible, whether the feature is there or gone"


def check_rows(rows: Any, n: int, *, twice: bool = False, field: str = "rows") -> IntArray:
    """Return row numbers as int64, each in range and, unless `twice` is allowed, at most once.

    Raises:
        InputError: a row that does not exist.
        DataError: a row twice in one update.
    """
    index = np.asarray(rows)
    if index.ndim != 1 or (index.size and index.dtype.kind not in "iu"):
        raise InputError("row numbers are a list of whole numbers", field=field)
    index = index.astype(np.int64)
    if first := _first((index < 0) | (index >= n), None):
        raise InputError(f"entry {first[0]}: row {index[first[0]]} of {n} does not exist", field=field)
    if not twice and np.bincount(index, minlength=1).max() > 1:
        row = int(np.argmax(np.bincount(index)))
        raise DataError(f"row {row} is observed twice in one update", field="rows", hint="run(), which takes streams")
    return index


def feature_of(first: IntArray) -> IntArray:
    """Return the (M,) feature of every row, of which those of feature `f` are `first[f]` to `first[f + 1]`."""
    return np.repeat(np.arange(len(first) - 1), np.diff(first))


def firsts_of(feature: IntArray, n_features: int) -> IntArray:
    """Return (F + 1,) where each of F features starts in rows sorted by feature (M,): the inverse of `feature_of`."""
    return np.concatenate([[0], np.cumsum(np.bincount(feature, minlength=n_features))]).astype(np.int64)


def rows_at(first: IntArray, features: IntArray) -> tuple[IntArray, IntArray]:
    """Return where each of some features (K,) starts in its rows laid behind each other (K + 1,), and these rows."""
    length = first[features + 1] - first[features]
    begin = np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
    return begin, np.arange(begin[-1]) - np.repeat(begin[:-1] - first[features], length)


@dataclass(frozen=True, slots=True)
class Looks(Shown):
    """Looks of a detector at F features, by feature and time.

    Attributes:
        first: (F + 1,) the looks at feature `f` are rows `first[f]` to `first[f + 1]`, in order of time.
        stamp_s: (M,) when.
        detected: (M,) 1.0 where the detector fired, else 0.0.
        p_miss: (M,) `P(no detection | there)`.
        p_false: (M,) `P(detection | not there)`.
    """

    first: IntArray
    stamp_s: FloatArray
    detected: FloatArray
    p_miss: FloatArray
    p_false: FloatArray

    @property
    def n_features(self) -> int:
        """F."""
        return len(self.first) - 1

    @property
    def feature(self) -> IntArray:
        """(M,) feature of every look."""
        return feature_of(self.first)

    def median_gap_s(self) -> float:
        """Return the median time above 0 between successive looks at a feature.

        Raises:
            DataError: no feature has looks at two instants.
        """
        gaps = np.diff(self.stamp_s)[np.diff(self.feature) == 0]
        if not (gaps > 0.0).any():
            raise DataError("no feature has looks at two instants", hint="there is nothing to learn from")
        return float(np.median(gaps[gaps > 0.0]))

    def of(self, feature: int) -> Looks:
        """Return the looks at one feature alone."""
        return self.at(np.array([feature]))[0]

    def at(self, features: IntArray) -> tuple[Looks, IntArray]:
        """Return the looks at some features (K,), in that order, and the rows they are."""
        first, rows = rows_at(self.first, features)
        return self.taken(rows, first), rows

    def taken(self, rows: IntArray | BoolArray, first: IntArray | None = None) -> Looks:
        """Return some of the looks, in this order; of the same features where `first` does not say otherwise."""
        first = firsts_of(self.feature[rows], self.n_features) if first is None else first
        return Looks(first, self.stamp_s[rows], self.detected[rows], self.p_miss[rows], self.p_false[rows])

    def likelihoods(self) -> tuple[FloatArray, FloatArray]:
        """Return (M,) likelihood of each look if the feature is there, and if it is not."""
        return likelihoods(self.detected, self.p_miss, self.p_false)

    def impossible(self, row: int) -> NumericalError:
        """Return the error of a look that is impossible, whether the feature is there or not."""
        feature = int(np.searchsorted(self.first, row, side="right")) - 1
        who = f"feature {feature} at {self.stamp_s[row]} s"
        return NumericalError(impossible(who), hint="P_M and P_F strictly between 0 and 1", row=row)

    @classmethod
    def from_rows(
        cls,
        feature: Any,
        stamp_s: Any,
        detected: Any,
        p_miss: Any,
        p_false: Any,
        *,
        n_features: int | None = None,
    ) -> Looks:
        """Sort rows by feature and time; rows of one feature at one time keep their order.

        Args:
            feature: (M,) index of the feature each row is about, from 0.
            stamp_s: (M,) when.
            detected: (M,) 1 or 0.
            p_miss: scalar or (M,), `P(no detection | there)`.
            p_false: scalar or (M,), `P(detection | not there)`.
            n_features: F, if more than the rows tell.

        Raises:
            InputError: shapes, an index, a time or a probability that cannot be; the row is named, counted from 0.
        """
        index, order, first = _grouped(feature, n_features)
        columns = {"stamp_s": stamp_s, "detected": detected, "p_miss": p_miss, "p_false": p_false}
        time, hit, miss, false = (as_rows(values, len(index), name) for name, values in columns.items())
        check_looks(time, hit, miss, false, np.full(len(index), -np.inf))
        order = order[np.lexsort((time[order], index[order]))]
        return cls(first, *(np.ascontiguousarray(column[order]) for column in (time, hit, miss, false)))


@dataclass(frozen=True, slots=True)
class Instants(Shown):
    """Instants at which the presence of F features is asked for, by feature and time.

    Attributes:
        first: (F + 1,) those of feature `f` are rows `first[f]` to `first[f + 1]`, in order of time.
        stamp_s: (Q,) when.
    """

    first: IntArray
    stamp_s: FloatArray

    def at(self, features: IntArray) -> tuple[Instants, IntArray]:
        """Return the instants of some features (K,), in that order, and the rows they are."""
        first, rows = rows_at(self.first, features)
        return Instants(first, self.stamp_s[rows]), rows

    @classmethod
    def of_looks(cls, looks: Looks) -> Instants:
        """Return the instants of the looks themselves."""
        return cls(looks.first, looks.stamp_s)

    @classmethod
    def same_for_all(cls, n_features: int, stamp_s: Any) -> Instants:
        """Return the same instants for every feature.

        Raises:
            InputError: times that are not finite or not in order.
        """
        time = as_instants(stamp_s)
        return cls(np.arange(n_features + 1) * len(time), np.tile(time, n_features))


@dataclass(frozen=True, slots=True)
class Track(Shown):
    """Presence of F features given their looks.

    Attributes:
        p_present: (Q,) probability of presence at every instant asked for, given the looks up to and including it;
            beyond the last look it is the forecast. NaN where the model cannot say (before a birth that it needs).
        log_evidence: (F,) `log p(looks)` of each feature.
        merged_mass: (F,) probability that a filter of limited memory moved between hypotheses, summed over its steps;
            0 for exact filters.
    """

    p_present: FloatArray
    log_evidence: FloatArray
    merged_mass: FloatArray


class Candidate(NamedTuple):
    """A kind of model that learning has tried.

    Attributes:
        name: of the structure of phases, or of the families of stay and absence.
        log_evidence: `log p(looks)` of the best model of this kind.
        freedom: effective number of parameters.
        score: log evidence less the price of the parameters (Schwarz 1978); the greatest is chosen.
        history: objective (log evidence and log prior) of each round of EM, where it can only grow.
    """

    name: str
    log_evidence: float
    freedom: float
    score: float
    history: tuple[float, ...] = ()


class PresenceFilter(Protocol):
    """Protocol of everything that filters looks: a model, or several models of different features."""

    def track(self, looks: Looks, instants: Instants | None = None) -> Track:
        """Filter every feature's looks; asked at the looks themselves where `instants` is None.

        Raises:
            NumericalError: a look that is impossible, whether the feature is there or not.
        """
        ...


@runtime_checkable
class PresenceModel(PresenceFilter, Protocol):
    """Protocol of presence models. Immutable; one model serves any number of features."""

    @property
    def lifetimes(self) -> Lifetimes:
        """Lifetimes of a stay and of an absence; hazards with a rhythm count with their mean over the week."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain numbers and words, for JSON; `evermap.existence.models.model_of` reads it back."""
        ...


def _grouped(feature: Any, n_features: int | None) -> tuple[IntArray, IntArray, IntArray]:
    """Feature indices, rows ordered by them, and where each feature starts."""
    index = np.asarray(feature)
    if index.ndim != 1 or (index.size and index.dtype.kind not in "iu"):
        raise InputError("features are row numbers", field="feature", hint="whole numbers from 0")
    index = index.astype(np.int64)
    count = int(index.max(initial=-1)) + 1 if n_features is None else n_features
    wrong = np.flatnonzero((index < 0) | (index >= count))
    if wrong.size:
        raise InputError(f"row {wrong[0]}: feature {index[wrong[0]]} of {count} does not exist", field="feature")
    return index, np.argsort(index, kind="stable"), firsts_of(index, count)
