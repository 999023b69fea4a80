"""The persistence filter (Rosen 2016, Algorithm 1) in inverse odds: `init`, `predict`, `update`, `observe`, and `run`.

All functions are pure. Rows are independent; every row has its own clock (seconds since its birth), its own prior and,
at every observation, its own `P_M` (miss although there) and `P_F` (detection although gone). A feature exists at
`t <= T`. With `r = (1 - p) / p` a gap of conditional survival `q` gives `r <- r + (1 + r) (1 - q) / q`, and an
observation multiplies `r` by its likelihood when gone over its likelihood when there (MATH.md section 2).
`update` takes a detector's yes or no, `observe` the likelihoods of any model of detection, `run` a stream.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evermap.errors import ConfigError, NumericalError
from evermap.existence import protocol as checks
from evermap.existence.lifetimes import log_death_odds
from evermap.show import Shown
from evermap.survival.base import LifetimePrior
from evermap.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Belief(Shown):
    """Persistence of `N` features, one row each.

    Attributes:
        inverse_odds: (N,) `(1 - p) / p` right after the last observation; 0 is certainly there, inf gone.
        stamp_s: (N,) time of the last observation, seconds since the feature's birth; 0 before the first.
        priors: the lifetimes in use.
        prior_of_row: (N,) which of `priors` each row has.
        log_evidence: (N,) `log p(y_1:n)` summed so far, or None where nobody asked for it.
    """

    inverse_odds: FloatArray
    stamp_s: FloatArray
    priors: tuple[LifetimePrior, ...]
    prior_of_row: IntArray
    log_evidence: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.inverse_odds)

    @property
    def probability(self) -> FloatArray:
        """(N,) probability that each feature existed at its own last observation."""
        return np.asarray(1.0 / (1.0 + self.inverse_odds), dtype=np.float64)

    @property
    def log_odds(self) -> FloatArray:
        """(N,) the same as log-odds, with infinities for the two certainties."""
        with np.errstate(divide="ignore"):
            return np.asarray(-np.log(self.inverse_odds), dtype=np.float64)


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


def predict(state: Belief, stamp_s: Any, *, rows: Any = None) -> FloatArray:
    """Return the probability that each feature exists at `stamp_s`; the state stays as it is.

    Args:
        state: beliefs of N features.
        stamp_s: scalar, (N,) or (len(rows),) times since birth, none before the row's last observation.
        rows: row numbers asked about; all where None.

    Returns:
        (N,) or (len(rows),) probabilities.

    Raises:
        InputError: a time that is not finite or lies before the last observation.
    """
    index = np.arange(len(state)) if rows is None else checks.check_rows(rows, len(state), twice=True)
    time = checks.as_rows(stamp_s, len(index), "stamp_s")
    checks.check_times(time, state.stamp_s[index], index)
    from evermap.existence.kernels import predict_rows

    predicted = np.empty(len(index))
    predict_rows(state.inverse_odds[index], _gaps(state, index, time), predicted)
    return 1.0 / (1.0 + predicted)


def update(state: Belief, stamp_s: Any, detected: Any, p_miss: Any, p_false: Any, *, rows: Any = None) -> Belief:
    """Return beliefs after one look at each feature.

    Args:
        state: beliefs of N features.
        stamp_s: scalar, (N,) or (len(rows),) times of the looks since birth; a row whose time is NaN was not looked at.
        detected: 1 or 0, of the same shape.
        p_miss: `P(no detection | there)`, of the same shape.
        p_false: `P(detection | gone)`, of the same shape.
        rows: the rows looked at, each once; all where None.

    Raises:
        InputError: a probability outside [0, 1], time running back, or a row that does not exist.
        DataError: a row twice (use `run`).
        NumericalError: an observation that is impossible under both states.
    """
    columns = {"stamp_s": stamp_s, "detected": detected, "p_miss": p_miss, "p_false": p_false}
    index, (time, hit, miss, false) = _looked_at(state, rows, columns)
    checks.check_looks(time, hit, miss, false, state.stamp_s[index], index)
    return _settle(state, index, time, *checks.likelihoods(hit, miss, false))


def observe(state: Belief, stamp_s: Any, log_there: Any, log_gone: Any = 0.0, *, rows: Any = None) -> Belief:
    """Return beliefs after one look at each feature, whatever model of detection says how likely its outcome was.

    With `log p(y | there) - log p(y | gone)` in the place of `log_there` the beliefs are the same; the evidence is then
    relative to that of a world without the features.

    Args:
        state: beliefs of N features.
        stamp_s: scalar, (N,) or (len(rows),) times of the looks since birth; a row whose time is NaN was not looked at.
        log_there: `log p(y | there)`, of the same shape; -inf where the outcome proves that the feature is gone.
        log_gone: `log p(y | gone)`, of the same shape.
        rows: the rows looked at, each once; all where None.

    Raises:
        InputError: a likelihood that is no number, time running back, or a row that does not exist.
        DataError: a row twice.
        NumericalError: an observation that is impossible under both states.
    """
    columns = {"stamp_s": stamp_s, "log_there": log_there, "log_gone": log_gone}
    index, (time, there, gone) = _looked_at(state, rows, columns)
    checks.check_times(time, state.stamp_s[index], index)
    checks.check_log_likelihood(there, "log_there", index)
    checks.check_log_likelihood(gone, "log_gone", index)
    return _settle(state, index, time, there, gone, logs=True)


def run(
    state: Belief, feature: Any, stamp_s: Any, detected: Any, p_miss: Any, p_false: Any
) -> tuple[Belief, FloatArray]:
    """Apply a stream of observations in one call, in whatever order its rows come.

    Rows are taken by feature and time; those of one feature at one time keep their order. The prior is asked once for
    all gaps, then one compiled pass does the recursion.

    Args:
        state: beliefs of N features.
        feature: (M,) row of `state` that each observation is of.
        stamp_s: (M,) time since that feature's birth.
        detected: (M,) 1 or 0.
        p_miss: scalar or (M,), `P(no detection | there)`.
        p_false: scalar or (M,), `P(detection | gone)`.

    Returns:
        The beliefs after the stream, and (M,) the probability right after each observation, in the order given.

    Raises:
        InputError, NumericalError: as `update`; messages count the stream's rows from 0.
    """
    from evermap.existence.kernels import Stream, stream

    entry = checks.check_rows(feature, len(state), twice=True, field="feature")
    m = len(entry)
    time, there, gone = checks.as_looks(stamp_s, detected, p_miss, p_false, state.stamp_s[entry])

    order = np.lexsort((time, entry))
    entry, time = entry[order], time[order]
    before = np.empty(m)
    before[1:] = time[:-1]
    first = np.ones(m, dtype=np.bool_)
    first[1:] = entry[1:] != entry[:-1]
    before[first] = state.stamp_s[entry[first]]
    odds = log_death_odds(state.priors, state.prior_of_row[entry], before, time)

    inverse_odds, stamps = state.inverse_odds.copy(), state.stamp_s.copy()
    evidence = np.zeros(len(state)) if state.log_evidence is None else state.log_evidence.copy()
    posterior = np.empty(m)
    bad = int(stream(Stream(entry, odds, there[order], gone[order]), inverse_odds, evidence, posterior))
    if bad >= 0:
        row = int(order[bad])
        raise NumericalError(
            checks.impossible(f"row {row} (feature {entry[bad]} at {time[bad]} s)"),
            hint="P_M and P_F strictly between 0 and 1",
        )
    stamps[entry] = time  # sorted by time, and the last assignment holds
    unsorted = np.empty(m)
    unsorted[order] = posterior
    kept = None if state.log_evidence is None else evidence
    return replace(state, inverse_odds=inverse_odds, stamp_s=stamps, log_evidence=kept), unsorted


def _gaps(state: Belief, index: IntArray, time: FloatArray) -> FloatArray:
    """Log-odds of dying before `time`."""
    return log_death_odds(state.priors, state.prior_of_row[index], state.stamp_s[index], time)


def _looked_at(state: Belief, rows: Any, columns: dict[str, Any]) -> tuple[IntArray, list[FloatArray]]:
    """The rows looked at, and their part of each column; the first column is the times."""
    index = np.arange(len(state)) if rows is None else checks.check_rows(rows, len(state))
    values = [checks.as_rows(column, len(index), field) for field, column in columns.items()]
    looked = ~np.isnan(values[0])
    if looked.all():
        return index, values
    return index[looked], [column[looked] for column in values]


def _settle(
    state: Belief, index: IntArray, time: FloatArray, there: FloatArray, gone: FloatArray, *, logs: bool = False
) -> Belief:
    """The state after looks at some rows, of these likelihoods or their logarithms."""
    from evermap.existence import kernels

    inverse_odds, stamps = state.inverse_odds.copy(), state.stamp_s.copy()
    evidence = np.zeros(len(state)) if state.log_evidence is None else state.log_evidence.copy()
    looks = kernels.Stream(index, _gaps(state, index, time), there, gone)
    if logs:
        bad = kernels.stream_of_logs(looks, inverse_odds, evidence)
    else:
        bad = kernels.stream(looks, inverse_odds, evidence, np.empty(len(index)))
    if bad >= 0:
        raise NumericalError(checks.impossible(f"row {index[bad]}"), hint="P_M and P_F strictly between 0 and 1")
    stamps[index] = time
    kept = None if state.log_evidence is None else evidence
    return replace(state, inverse_odds=inverse_odds, stamp_s=stamps, log_evidence=kept)
