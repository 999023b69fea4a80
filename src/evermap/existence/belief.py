"""Beliefs about many features, one row each: what all models of presence have in common.

A table of beliefs is immutable: `update` returns another one. A table knows how its rows go on over a gap and what a
look says to them; row numbers, times and probabilities are checked here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Self

import numpy as np

from evermap.errors import InputError
from evermap.existence import protocol as checks
from evermap.existence.protocol import Looks, PresenceModel
from evermap.show import Shown
from evermap.types import FloatArray, IntArray


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
    def _looked(self, index: IntArray, time: FloatArray, there: FloatArray, gone: FloatArray) -> Self:
        """Return beliefs after a look at each of some rows, of these likelihoods if it is there and if it is not."""

    def predict(self, stamp_s: Any, *, rows: Any = None) -> FloatArray:
        """Return the probability that each feature is there at `stamp_s`.

        Args:
            stamp_s: scalar, (N,) or (len(rows),) times, none before the row's last look.
            rows: row numbers asked about; all where None.

        Raises:
            InputError: a time that is not finite or lies before the last look.
        """
        index = np.arange(len(self)) if rows is None else checks.check_rows(rows, len(self), twice=True)
        time = checks.as_rows(stamp_s, len(index), "stamp_s")
        checks.check_times(time, self.stamp_s[index], index)
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
        index, (time, hit, miss, false) = self._looked_at(rows, columns)
        checks.check_looks(time, hit, miss, false, self.stamp_s[index], index)
        return self._looked(index, time, *checks.likelihoods(hit, miss, false))

    def _looked_at(self, rows: Any, columns: dict[str, Any]) -> tuple[IntArray, list[FloatArray]]:
        """The rows looked at, and their part of each column; the first column is the times."""
        index = np.arange(len(self)) if rows is None else checks.check_rows(rows, len(self))
        return index, [checks.as_rows(column, len(index), field) for field, column in columns.items()]


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
        checks.check_times(time, np.full(len(time), -np.inf))
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
        looked = np.diff(looks.first) > 0
        ends = np.full((2, looks.n_features), looks.stamp_s.max())
        ends[:, looked] = looks.stamp_s[looks.first[:-1][looked]], looks.stamp_s[looks.first[1:][looked] - 1]
        return cls._after(model, looks, ends)

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
