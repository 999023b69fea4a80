"""The persistence filter (Rosen 2016, Algorithm 1) in inverse odds, of many features: `init`, then methods of `Belief`.

Rows are independent; every row has its own clock (seconds since its birth), its own prior and, at every observation,
its own `P_M` (miss although there) and `P_F` (detection although gone). A feature exists at `t <= T`. With
`r = (1 - p) / p` a gap of conditional survival `q` gives `r <- r + (1 + r) (1 - q) / q`, and an observation multiplies
`r` by its likelihood when gone over its likelihood when there (MATH.md section 2).
`update` takes a detector's yes or no, `observe` the likelihoods of any model of detection, `run` a stream.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from evermap.errors import ConfigError
from evermap.existence import protocol as checks
from evermap.existence.lifetimes import log_death_odds
from evermap.existence.protocol import BeliefTable
from evermap.survival.base import LifetimePrior
from evermap.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Belief(BeliefTable):
    """Persistence of `N` features, one row each.

    Attributes:
        inverse_odds: (N,) `(1 - p) / p` right after the last observation; 0 is certainly there, inf gone.
        stamp_s: (N,) time of the last observation, seconds since the feature's birth; 0 before the first.
        priors: the lifetimes in use.
        prior_of_row: (N,) which of `priors` each row has.
        log_evidence: (N,) `log p(y_1:n)` summed so far, or None where it was not asked for.
    """

    inverse_odds: FloatArray
    stamp_s: FloatArray
    priors: tuple[LifetimePrior, ...]
    prior_of_row: IntArray
    log_evidence: FloatArray | None = None

    @property
    def probability(self) -> FloatArray:
        """(N,) probability that each feature existed at its own last observation."""
        return np.asarray(1.0 / (1.0 + self.inverse_odds), dtype=np.float64)

    @property
    def log_odds(self) -> FloatArray:
        """(N,) the same as log-odds, with infinities for the two certainties."""
        with np.errstate(divide="ignore"):
            return np.asarray(-np.log(self.inverse_odds), dtype=np.float64)

    def _choose_rows(self, rows: Any, columns: dict[str, Any]) -> tuple[IntArray, list[FloatArray]]:
        """A row whose time is NaN was not looked at."""
        index, values = super(Belief, self)._choose_rows(rows, columns)
        looked = ~np.isnan(values[0])
        return (index, values) if looked.all() else (index[looked], [column[looked] for column in values])

    def observe(self, stamp_s: Any, log_there: Any, log_gone: Any = 0.0, *, rows: Any = None) -> Self:
        """Return beliefs after a look at each feature, with likelihoods of any detection model.

        With `log p(y | there) - log p(y | gone)` in the place of `log_there` the beliefs are the same; the evidence is
        then relative to that of a world without the features.

        Args:
            stamp_s: as of `update`; a row whose time is NaN was not looked at, there too.
            log_there: `log p(y | there)`, of the same shape; -inf where the outcome proves that the feature is gone.
            log_gone: `log p(y | gone)`, of the same shape.
            rows: the rows looked at, each once; all where None.

        Raises:
            InputError: a likelihood that is not a number, time running back, or a row that does not exist.
            DataError: a row twice.
            NumericalError: an observation that is impossible under both states.
        """
        columns = {"stamp_s": stamp_s, "log_there": log_there, "log_gone": log_gone}
        index, (time, there, gone) = self._choose_rows(rows, columns)
        checks.check_times(time, self.stamp_s[index], index)
        checks.check_log_likelihood(there, "log_there", index)
        checks.check_log_likelihood(gone, "log_gone", index)
        return self._look(index, time, there, gone, logs=True)

    def run(self, feature: Any, stamp_s: Any, detected: Any, p_miss: Any, p_false: Any) -> tuple[Self, FloatArray]:
        """Apply a stream of observations in one call, in any order of rows.

        Rows are taken by feature and time; those of one feature at one time keep their order. The prior is asked once
        for all gaps, then one compiled pass does the recursion.

        Args:
            feature: (M,) row that each observation is of.
            stamp_s: (M,) time since that feature's birth.
            detected: (M,) 1 or 0.
            p_miss: scalar or (M,), `P(no detection | there)`.
            p_false: scalar or (M,), `P(detection | gone)`.

        Returns:
            The beliefs after the stream, and (M,) the probability right after each observation, in the order given.

        Raises:
            InputError, NumericalError: as `update`; messages count the stream's rows from 0.
        """
        entry = checks.check_rows(feature, len(self), twice=True, field="feature")
        columns = {"stamp_s": stamp_s, "detected": detected, "p_miss": p_miss, "p_false": p_false}
        time, hit, miss, false = (checks.as_rows(column, len(entry), name) for name, column in columns.items())
        checks.check_looks(time, hit, miss, false, self.stamp_s[entry])
        order = np.lexsort((time, entry))
        there, gone = (side[order] for side in checks.likelihoods(hit, miss, false))
        entry, time = entry[order], time[order]
        same = np.append(False, entry[1:] == entry[:-1])[: len(entry)]
        before = np.where(same, np.append(0.0, time[:-1])[: len(entry)], self.stamp_s[entry])
        after, posterior, bad = self._stream_looks(entry, before, time, there, gone, logs=False)
        if bad >= 0:
            raise checks.impossible(f"row {int(order[bad])} (feature {entry[bad]} at {time[bad]} s)")
        unsorted = np.empty(len(entry))
        unsorted[order] = posterior
        return after, unsorted

    def _presence(self, index: IntArray, time: FloatArray) -> FloatArray:
        from evermap.existence.kernels import predict_rows

        predicted = np.empty(len(index))
        odds = log_death_odds(self.priors, self.prior_of_row[index], self.stamp_s[index], time)
        predict_rows(self.inverse_odds[index], odds, predicted)
        return 1.0 / (1.0 + predicted)

    def _look(
        self, index: IntArray, time: FloatArray, there: FloatArray, gone: FloatArray, *, logs: bool = False
    ) -> Self:
        """Return beliefs after looks at some rows, of these likelihoods or their logarithms."""
        after, _, bad = self._stream_looks(index, self.stamp_s[index], time, there, gone, logs=logs)
        if bad >= 0:
            raise checks.impossible(f"row {index[bad]}")
        return after

    def _stream_looks(
        self, row: IntArray, before_s: FloatArray, time: FloatArray, there: FloatArray, gone: FloatArray, logs: bool
    ) -> tuple[Self, FloatArray, int]:
        """Return beliefs after M looks, (M,) probabilities unless `logs`, and the first impossible look or -1."""
        from evermap.existence.kernels import Stream, stream, stream_of_logs

        inverse_odds, stamps, posterior = self.inverse_odds.copy(), self.stamp_s.copy(), np.empty(len(row))
        evidence = np.zeros(len(self)) if self.log_evidence is None else self.log_evidence.copy()
        looks = Stream(row, log_death_odds(self.priors, self.prior_of_row[row], before_s, time), there, gone)
        if logs:
            bad = stream_of_logs(looks, inverse_odds, evidence)
        else:
            bad = stream(looks, inverse_odds, evidence, posterior)
        stamps[row] = time  # in order of time, and the last assignment holds
        kept = None if self.log_evidence is None else evidence
        return replace(self, inverse_odds=inverse_odds, stamp_s=stamps, log_evidence=kept), posterior, int(bad)


def init(
    n: int,
    prior: LifetimePrior | str | Sequence[LifetimePrior | str],
    *,
    prior_of_row: IntArray | Sequence[int] | None = None,
    evidence: bool = False,
) -> Belief:
    """Return beliefs at birth: `n` features that are certainly there, at time 0 of their own clocks.

    Args:
        n: number of features.
        prior: one lifetime prior for all rows, or several; each may be a text, as `exponential:half-life=30d`.
        prior_of_row: (n,) index into `prior`, needed as soon as there is more than one.
        evidence: keep the running log evidence too (for model choice and for learning priors).

    Raises:
        ConfigError: a negative `n`, no prior, a text that describes none, or an index that points at none.
        InputError: something else in place of a prior.
    """
    if n < 0:
        raise ConfigError(f"{n} features cannot be filtered", field="n", hint="a number of rows >= 0")
    given: Sequence[LifetimePrior | str]
    given = (prior,) if isinstance(prior, str) or not isinstance(prior, Sequence) else prior
    priors = tuple(checks.as_prior(one) for one in given)
    if not priors:
        raise ConfigError("no lifetime prior was given", field="prior")
    if prior_of_row is None:
        if len(priors) > 1:
            raise ConfigError(
                f"{len(priors)} priors but nothing says which row has which",
                field="prior_of_row",
                hint="an index per row",
            )
        index = np.zeros(n, dtype=np.int64)
    else:
        index = np.array(prior_of_row, dtype=np.int64)
        if index.shape != (n,):
            raise ConfigError(f"shape {index.shape} instead of ({n},)", field="prior_of_row")
        wrong = np.flatnonzero((index < 0) | (index >= len(priors)))
        if wrong.size:
            row = int(wrong[0])
            raise ConfigError(f"row {row} asks for prior {index[row]} of {len(priors)}", field="prior_of_row")
    return Belief(np.zeros(n), np.zeros(n), priors, index, np.zeros(n) if evidence else None)
