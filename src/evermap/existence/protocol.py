"""The protocol of presence models and of beliefs, their tables (looks, instants, tracks), and the validation of these.

Errors name the row and what to try. A table of beliefs is immutable: `update` returns another one. It knows how its
rows go on over a gap and what a look says to them; row numbers, times and probabilities are checked here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

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
    """Return `values` as float64 of shape (n,), a scalar for all rows; InputError for others."""
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
    """Return (T,) instants, finite, in order, and none before `last_s`; InputError for others."""
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


def check_possible(inverse_odds: FloatArray, rows: IntArray | None = None) -> None:
    """Raise `NumericalError` where an update came out as 0 / 0: impossible under both states."""
    if first := _first(np.isnan(inverse_odds), rows):
        raise impossible(f"row {first[1]}")


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


def impossible(who: str, row: int | None = None) -> NumericalError:
    """Return the error of an observation that neither state of the feature can have caused."""
    problem = f"{who}: this observation is impossible, whether the feature is there or gone"
    return NumericalError(problem, hint="P_M and P_F strictly between 0 and 1", row=row)


def check_rows(rows: Any, n: int, *, twice: bool = False, field: str = "rows") -> IntArray:
    """Return row numbers as int64; InputError for a row that does not exist, DataError for one `twice` if forbidden."""
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


class LookColumns(NamedTuple):
    """M looks in order of time, and their likelihoods if the feature is there and if it is not."""

    stamp_s: FloatArray
    there: FloatArray
    gone: FloatArray


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
        """Return the median time above 0 between successive looks at a feature; DataError if there is none."""
        gaps = np.diff(self.stamp_s)[np.diff(self.feature) == 0]
        if not (gaps > 0.0).any():
            raise DataError("no feature has looks at two instants", hint="there is nothing to learn from")
        return float(np.median(gaps[gaps > 0.0]))

    def ends_s(self, otherwise: FloatArray | float) -> FloatArray:
        """Return (2, F) stamps of the first and the last look at each feature; `otherwise` where there is none."""
        looked = np.diff(self.first) > 0
        ends = np.empty((2, self.n_features))
        ends[:] = otherwise
        ends[:, looked] = self.stamp_s[self.first[:-1][looked]], self.stamp_s[self.first[1:][looked] - 1]
        return ends

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

    def columns(self) -> LookColumns:
        """Return the looks as the kernels take them."""
        return LookColumns(self.stamp_s, *likelihoods(self.detected, self.p_miss, self.p_false))

    def impossible(self, row: int) -> NumericalError:
        """Return the error of a look that is impossible, whether the feature is there or not."""
        feature = int(np.searchsorted(self.first, row, side="right")) - 1
        return impossible(f"feature {feature} at {self.stamp_s[row]} s", row)

    @classmethod
    def from_rows(
        cls, feature: Any, stamp_s: Any, detected: Any, p_miss: Any, p_false: Any, *, n_features: int | None = None
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
        index = np.asarray(feature)
        if index.ndim != 1 or (index.size and index.dtype.kind not in "iu"):
            raise InputError("features are row numbers", field="feature", hint="whole numbers from 0")
        index = index.astype(np.int64)
        count = int(index.max(initial=-1)) + 1 if n_features is None else n_features
        if wrong := _first((index < 0) | (index >= count), index):
            raise InputError(f"row {wrong[0]}: feature {wrong[1]} of {count} does not exist", field="feature")
        columns = {"stamp_s": stamp_s, "detected": detected, "p_miss": p_miss, "p_false": p_false}
        time, hit, miss, false = (as_rows(values, len(index), name) for name, values in columns.items())
        check_looks(time, hit, miss, false, np.full(len(index), -np.inf))
        order = np.lexsort((time, index))
        return cls(
            firsts_of(index, count), *(np.ascontiguousarray(column[order]) for column in (time, hit, miss, false))
        )


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


class BeliefTable(Shown, ABC):
    """Presence of N features, one row each, and the time of each row's last look."""

    __slots__ = ()
    stamp_s: FloatArray

    def __len__(self) -> int:
        return len(self.stamp_s)

    @abstractmethod
    def _presence(self, index: IntArray, time: FloatArray) -> FloatArray:
        """Return (K,) probability of presence of some rows at later times."""

    @abstractmethod
    def _look(self, index: IntArray, time: FloatArray, there: FloatArray, gone: FloatArray) -> Self:
        """Return beliefs after a look at each of some rows, of these likelihoods if it is there and if it is not."""

    def predict(self, stamp_s: Any, *, rows: Any = None) -> FloatArray:
        """Return the probability that each feature is there at `stamp_s`.

        Args:
            stamp_s: scalar, (N,) or (len(rows),) times, none before the row's last look.
            rows: row numbers asked about; all where None.

        Raises:
            InputError: a time that is not finite or lies before the last look.
        """
        index = np.arange(len(self)) if rows is None else check_rows(rows, len(self), twice=True)
        time = as_rows(stamp_s, len(index), "stamp_s")
        check_times(time, self.stamp_s[index], index)
        return self._presence(index, time)

    def update(self, stamp_s: Any, detected: Any, p_miss: Any, p_false: Any, *, rows: Any = None) -> Self:
        """Return beliefs after one look at each feature.

        Args:
            stamp_s: scalar, (N,) or (len(rows),) times of the looks, none before the row's last look.
            detected: 1 or 0, of the same shape.
            p_miss: `P(no detection | there)`, of the same shape.
            p_false: `P(detection | not there)`, of the same shape.
            rows: the rows looked at, each once; all where None.

        Raises:
            InputError: a probability outside [0, 1], time running back, or a row that does not exist.
            DataError: a row twice.
            NumericalError: a look that is impossible, whether the feature is there or not.
        """
        columns = {"stamp_s": stamp_s, "detected": detected, "p_miss": p_miss, "p_false": p_false}
        index, (time, hit, miss, false) = self._choose_rows(rows, columns)
        check_looks(time, hit, miss, false, self.stamp_s[index], index)
        return self._look(index, time, *likelihoods(hit, miss, false))

    def _choose_rows(self, rows: Any, columns: dict[str, Any]) -> tuple[IntArray, list[FloatArray]]:
        """The rows looked at, and their part of each column; the first column is the times."""
        index = np.arange(len(self)) if rows is None else check_rows(rows, len(self))
        return index, [as_rows(column, len(index), field) for field, column in columns.items()]


class RecurrentBeliefTable(BeliefTable):
    """Presence of N features that leave and return."""

    __slots__ = ()

    @classmethod
    @abstractmethod
    def _first(cls, model: Any, time: FloatArray) -> Self:
        """Return beliefs before the first look."""

    @classmethod
    @abstractmethod
    def _after(cls, model: Any, looks: Looks, ends_s: FloatArray) -> Self:
        """Return beliefs after all looks; `ends_s` (2, F) are the first and last of each feature."""

    @abstractmethod
    def _mean_time(self, present: bool) -> FloatArray:
        """Return (N,) the mean time that the present state lasts, given that it is presence, or absence."""

    @classmethod
    def first(cls, model: PresenceModel, stamp_s: Any) -> Self:
        """Return beliefs about features that are heard of for the first time.

        Args:
            model: how they come and go.
            stamp_s: (N,) when, on one clock.

        Raises:
            InputError: a time that is not finite.
        """
        time = np.array(stamp_s, dtype=np.float64).reshape(-1)
        check_times(time, np.full(len(time), -np.inf))
        return cls._first(model, time)

    @classmethod
    def after(cls, model: PresenceModel, looks: Looks) -> Self:
        """Return beliefs after all looks, one row a feature.

        A feature that was never looked at is heard of at the last look of all.

        Args:
            model: how features come and go.
            looks: at F features.

        Raises:
            InputError: no look at all.
            NumericalError: a look that is impossible, whether the feature is there or not.
        """
        if not len(looks.stamp_s):
            raise InputError("there is no look", field="looks", hint="first(), which needs none")
        return cls._after(model, looks, looks.ends_s(looks.stamp_s.max()))

    def time_to_leave(self) -> FloatArray:
        """Return the expected time until each feature leaves, if it is there.

        Returns:
            (N,) seconds from `stamp_s` on; `inf` if some never leave, NaN if the feature is certainly away.
        """
        return self._mean_time(True)

    def time_to_return(self) -> FloatArray:
        """Return the expected time until each feature returns, if it is away.

        Returns:
            (N,) seconds from `stamp_s` on; `inf` where some never return, NaN where the feature is certainly there.
        """
        return self._mean_time(False)
