"""Lifetimes of things of which nobody saw the coming (MATH.md section 6).

```
            elsewhere      arrival b       first ........... last       gone
  looks  ------|--------------?--------------|-------|---------|----------|------
                                left = last - b      right = gone - b
                                entry = first - b
```

What arrives and leaves between two looks is never heard of, so those that are seen are the longer ones: a stay is
known only because it lasted until the first look, `T > first - b`. To take `(last - first, gone - elsewhere]` for a
plain interval forgets that, and overestimates lifetimes, the more the rarer the looks.

When it arrived nobody knows either. Things come evenly in time, so any instant b since the look before is as good as
any other, and the likelihood of a stay is

    sum_b [ S(last - b) - S(gone - b) ]  /  sum_b S(first - b)

which `fit_sightings` maximises. Estimators that take plain samples get some rows for each stay, one an instant, whose
bounds and entries are exact, and which share its weight as `S(last - b) - S(gone - b)` says. As long as lifetimes are
not known the shares are equal; with an estimate the samples can be made again, and the estimate with them. Where that
no longer changes anything, the score of the likelihood has mean 0 at the truth, but bands don't know that instants
were guessed, and are a little too narrow.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import ConfigError, DataError
from evermap.survival.base import LifetimePrior
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.parametric_fit import Kind, ParametricFit, fit_likelihood
from evermap.types import FloatArray, IntArray


def lifetimes_of_sightings(
    elsewhere_s: ArrayLike,
    first_s: ArrayLike,
    last_s: ArrayLike,
    gone_s: ArrayLike,
    *,
    given: LifetimePrior | None = None,
    instants: int = 5,
    least_stay_s: float = 0.0,
) -> tuple[CensoredLifetimes, IntArray]:
    """Censored samples of stays of which only sightings are known.

    Those that were there at the first look of all are left out: how long they had been there cannot be known.

    Args:
        elsewhere_s: (K,) last look before the first sighting, at which it was not there; -inf if there was none.
        first_s: (K,) first sighting.
        last_s: (K,) last sighting.
        gone_s: (K,) first look after the last sighting, at which it was not there; inf if there was none.
        given: an estimate of lifetimes, by which instants of arrival are weighed; equally where None.
        instants: of arrival that are considered for each stay.
        least_stay_s: a stay is counted only if it is seen to last this long.

    Returns:
        The samples, `instants` rows for each stay, and (N,) the stay that each row belongs to.

    Raises:
        ConfigError: `instants` is not positive.
        DataError: columns of different lengths or out of order in time, no stay whose coming is bounded.
    """
    if instants < 1:
        raise ConfigError(f"must be positive, not {instants}", field="instants")
    columns = {"elsewhere_s": elsewhere_s, "first_s": first_s, "last_s": last_s, "gone_s": gone_s}
    elsewhere, first, last, gone = (np.asarray(values, dtype=np.float64) for values in columns.values())
    for name, column in zip(columns, (elsewhere, first, last, gone), strict=True):
        if column.shape != (first.size,):
            raise DataError(f"shape {column.shape} instead of ({first.size},)", field=name)
    wrong = ~((elsewhere < first) & (first <= last) & (last < gone) & np.isfinite(first) & np.isfinite(last))
    if wrong.any():
        problem = f"not in order, row {int(np.argmax(wrong))}"
        raise DataError(problem, field="first_s", hint="elsewhere_s < first_s <= last_s < gone_s")
    stay = np.flatnonzero(np.isfinite(elsewhere) & (last - first >= least_stay_s))
    if stay.size == 0:
        hint = "look at the places more than once"
        raise DataError("every stay began before the first look", field="elsewhere_s", hint=hint)
    rows = np.repeat(stay, instants)
    share = np.tile((np.arange(instants) + 0.5) / instants, stay.size)
    arrival = elsewhere[rows] + share * (first[rows] - elsewhere[rows])
    left, right = last[rows] - arrival, gone[rows] - arrival
    weight = _weights(left, right, instants, given)
    return CensoredLifetimes.of(left, right, first[rows] + least_stay_s - arrival, weight), rows


def settled_samples(
    estimate: Callable[[CensoredLifetimes], LifetimePrior],
    samples_given: Callable[[LifetimePrior | None], CensoredLifetimes],
    rounds: int = 4,
) -> CensoredLifetimes:
    """Samples whose weights agree with the lifetimes that are estimated from them.

    Args:
        estimate: lifetimes from samples; a quick one will do, for it only weighs the instants of arrival.
        samples_given: samples with weights by an estimate, or without one: `lifetimes_of_sightings` for some stays.
        rounds: times that both are done.
    """
    samples = samples_given(None)
    for _ in range(rounds):
        samples = samples_given(estimate(samples))
    return samples


def fit_sightings(kind: str | Kind, samples: CensoredLifetimes, stay: IntArray) -> ParametricFit:
    """Most probable parameters of one family, whenever things arrived; its bands know that nobody saw it.

    Args:
        kind: as of `parametric_fit.fit`.
        samples: of `lifetimes_of_sightings`; their weights are not looked at.
        stay: (N,) of each sample, as it gives them.

    Raises:
        ConfigError: no family has this name.
        DataError: no stay has an end.
        NumericalError: the likelihood has no maximum in this family, or one that a parameter makes no difference to.
    """
    ended = np.isfinite(samples.right_s)
    if not ended.any():
        raise DataError("no stay has an end", field="gone_s", hint="look again later, or state a prior in words")
    instants = int(np.argmax(np.append(stay, -1) != stay[0]))
    n_stays = stay.size // instants

    def of_stays(prior: LifetimePrior) -> float:
        log_sighting = _log_sighting(prior, samples.left_s, samples.right_s)
        log_known = np.asarray(prior.log_survival(samples.entry_s))
        return float(_log_sums(log_sighting, instants).sum() - _log_sums(log_known, instants).sum())

    watched_s = float((samples.left_s - samples.entry_s).sum() / instants)
    n_ended = float(ended.sum() / instants)
    return fit_likelihood(kind, of_stays, max(watched_s / n_ended, float(np.median(samples.left_s))), float(n_stays))


def _log_sighting(prior: LifetimePrior, left: FloatArray, right: FloatArray) -> FloatArray:
    """(N,) `log(S(left) - S(right))`."""
    ended = np.isfinite(right)
    value = np.asarray(prior.log_survival(left)).copy()
    value[ended] += prior.log_conditional_death(left[ended], right[ended])
    return value


def _log_sums(log_values: FloatArray, instants: int) -> FloatArray:
    """(K,) logarithms of sums over the instants of each stay."""
    return np.asarray(np.logaddexp.reduce(log_values.reshape(-1, instants), axis=1))


def _weights(left: FloatArray, right: FloatArray, instants: int, given: LifetimePrior | None) -> FloatArray:
    """(N,) shares of the instants of every stay: `S(left) - S(right)`, of sum 1 for each."""
    if given is None:
        return np.full(left.size, 1.0 / instants)
    log_share = _log_sighting(given, left, right)
    table = log_share.reshape(-1, instants)
    most = table.max(axis=1, keepdims=True)
    share = np.exp(table - np.where(np.isfinite(most), most, 0.0))
    total = share.sum(axis=1, keepdims=True)
    return np.asarray(np.where(total > 0.0, share / np.where(total > 0.0, total, 1.0), 1.0 / instants)).ravel()
