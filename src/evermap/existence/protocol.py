"""What every model of presence answers, and the tables it is asked with: looks, instants, tracks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from evermap.errors import InputError, NumericalError
from evermap.existence import checks
from evermap.existence.lifetimes import Lifetimes
from evermap.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Looks:
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

    def of(self, feature: int) -> Looks:
        """The looks at one feature alone."""
        rows = slice(int(self.first[feature]), int(self.first[feature + 1]))
        first = np.array([0, rows.stop - rows.start])
        return Looks(first, self.stamp_s[rows], self.detected[rows], self.p_miss[rows], self.p_false[rows])

    def likelihoods(self) -> tuple[FloatArray, FloatArray]:
        """(M,) likelihood of each look if the feature is there, and if it is not."""
        return checks.likelihoods(self.detected, self.p_miss, self.p_false)

    def impossible(self, row: int) -> NumericalError:
        """The error of a look that is impossible, whether the feature is there or not."""
        feature = int(np.searchsorted(self.first, row, side="right")) - 1
        who = f"feature {feature} at {self.stamp_s[row]} s"
        return NumericalError(checks.impossible(who), hint="P_M and P_F strictly between 0 and 1", row=row)

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
        m = len(index)
        columns = []
        for name, values in (("stamp_s", stamp_s), ("detected", detected), ("p_miss", p_miss), ("p_false", p_false)):
            columns.append(_column(values, m, name))
        time, hit, miss, false = columns
        _require(np.isfinite(time), time, "stamp_s", "is no instant", "a finite time")
        _require((hit == 0.0) | (hit == 1.0), hit, "detected", "is neither a detection nor a miss", "1 or 0")
        for name, values in (("p_miss", miss), ("p_false", false)):
            _require((values >= 0.0) & (values <= 1.0), values, name, "is no probability", "a number between 0 and 1")
        order = order[np.lexsort((time[order], index[order]))]
        return cls(first, *(np.ascontiguousarray(column[order]) for column in columns))


@dataclass(frozen=True, slots=True)
class Instants:
    """Instants at which the presence of F features is asked for, by feature and time.

    Attributes:
        first: (F + 1,) those of feature `f` are rows `first[f]` to `first[f + 1]`, in order of time.
        stamp_s: (Q,) when.
    """

    first: IntArray
    stamp_s: FloatArray

    @classmethod
    def of_looks(cls, looks: Looks) -> Instants:
        """The instants of the looks themselves."""
        return cls(looks.first, looks.stamp_s)

    @classmethod
    def same_for_all(cls, n_features: int, stamp_s: Any) -> Instants:
        """The same instants for every feature.

        Raises:
            InputError: times that are not finite or not in order.
        """
        time = np.array(stamp_s, dtype=np.float64).reshape(-1)
        _require(np.isfinite(time), time, "stamp_s", "is no instant", "a finite time")
        if (np.diff(time) < 0.0).any():
            raise InputError("the instants asked for are not in order of time", field="stamp_s", hint="sort them")
        return cls(np.arange(n_features + 1) * len(time), np.tile(time, n_features))


@dataclass(frozen=True, slots=True)
class Track:
    """Presence of F features as far as their looks tell.

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


class PresenceFilter(Protocol):
    """Whatever turns looks into probabilities of presence: a model, or several models of different features."""

    def track(self, looks: Looks, instants: Instants | None = None) -> Track:
        """Filter every feature's looks; asked at the looks themselves where `instants` is None.

        Raises:
            NumericalError: a look that is impossible, whether the feature is there or not.
        """
        ...


@runtime_checkable
class PresenceModel(PresenceFilter, Protocol):
    """How features come and go. Immutable; one model serves any number of features."""

    @property
    def lifetimes(self) -> Lifetimes:
        """How long a stay lasts, and an absence; hazards that follow the hours count with their mean over the week."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """The model as plain numbers and words, for JSON; `evermap.existence.storage.model_of` reads it back."""
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
    first = np.concatenate([[0], np.cumsum(np.bincount(index, minlength=count))]).astype(np.int64)
    return index, np.argsort(index, kind="stable"), first


def _column(values: Any, m: int, name: str) -> FloatArray:
    """A column of M numbers; a scalar serves all rows."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError("not numbers", field=name) from error
    if array.ndim and array.shape != (m,):
        raise InputError(f"shape {array.shape} instead of ({m},)", field=name)
    return np.broadcast_to(array, (m,))


def _require(fine: Any, values: FloatArray, field: str, problem: str, hint: str) -> None:
    """Raise an error that names the first row which is not fine."""
    if not fine.all():
        row = int(np.argmin(fine))
        raise InputError(f"row {row}: {values[row]} {problem}", field=field, hint=hint)
