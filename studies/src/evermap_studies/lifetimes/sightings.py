"""Lifetimes of stays of which only sightings are known: by their own likelihood, or by samples that are weighted.

The arrival of a stay is unknown: see `evermap.survival.censored`. With an estimate of lifetimes the instants of
arrival share the weight of their stay in proportion to `S(last - b) - S(gone - b)`, and the estimate can be made again
of these samples. At the fixed point the score of the likelihood has mean 0 at the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from evermap.errors import DataError
from evermap.survival.base import LifetimePrior
from evermap.survival.censored import CensoredLifetimes, lifetimes_of_sightings
from evermap.survival.parametric_fit import Kind, ParametricFit, fit_likelihood
from evermap.types import FloatArray, IntArray


def weighted_sightings(columns: Any, given: LifetimePrior | None, instants: int = 5) -> CensoredLifetimes:
    """Make censored samples of stays, whose instants of arrival are weighted by an estimate of lifetimes.

    Args:
        columns: elsewhere, first, last and gone of K stays, as of `lifetimes_of_sightings`.
        given: the estimate; None for equal weights.
        instants: number of instants of arrival for each stay.
    """
    samples, _ = lifetimes_of_sightings(*columns, instants=instants)
    if given is None:
        return samples
    table = _log_sighting(given, samples.left_s, samples.right_s).reshape(-1, instants)
    most = table.max(axis=1, keepdims=True)
    share = np.exp(table - np.where(np.isfinite(most), most, 0.0))
    total = share.sum(axis=1, keepdims=True)
    weight = np.where(total > 0.0, share / np.where(total > 0.0, total, 1.0), 1.0 / instants)
    return replace(samples, weight=weight.ravel())


def settled_samples(
    estimate: Callable[[CensoredLifetimes], LifetimePrior],
    samples_given: Callable[[LifetimePrior | None], CensoredLifetimes],
    rounds: int = 4,
) -> CensoredLifetimes:
    """Iterate samples and estimate until the weights agree with the lifetimes estimated from them.

    Args:
        estimate: lifetimes from samples; a rough one is enough, since it only weights the instants of arrival.
        samples_given: samples with weights by an estimate, or None: `weighted_sightings` of some stays.
        rounds: number of iterations.
    """
    samples = samples_given(None)
    for _ in range(rounds):
        samples = samples_given(estimate(samples))
    return samples


def fit_sightings(kind: str | Kind, samples: CensoredLifetimes, stay: IntArray) -> ParametricFit:
    """Fit one family to stays of unknown arrival; its bands account for that.

    Args:
        kind: as of `parametric_fit.fit`.
        samples: of `lifetimes_of_sightings`; their weights are ignored.
        stay: (N,) stay of each sample, as it returns them.

    Raises:
        ConfigError: an unknown family.
        DataError: no stay has an end.
        NumericalError: the likelihood has no clear maximum in this family.
    """
    ended = np.isfinite(samples.right_s)
    if not ended.any():
        raise DataError("no stay has an end", field="gone_s", hint="look again later, or state a prior")
    instants = int(np.argmax(np.append(stay, -1) != stay[0]))
    n_stays = stay.size // instants

    def of_stays(prior: LifetimePrior) -> float:
        seen = _log_sighting(prior, samples.left_s, samples.right_s)
        known = np.asarray(prior.log_survival(samples.entry_s))
        return float(_log_sums(seen, instants).sum() - _log_sums(known, instants).sum())

    watched_s = float((samples.left_s - samples.entry_s).sum() / instants)
    n_ended = float(ended.sum() / instants)
    return fit_likelihood(kind, of_stays, max(watched_s / n_ended, float(np.median(samples.left_s))), float(n_stays))


def _log_sighting(prior: LifetimePrior, left: FloatArray, right: FloatArray) -> FloatArray:
    """Return `log(S(left) - S(right))` (N,)."""
    ended = np.isfinite(right)
    value = np.asarray(prior.log_survival(left)).copy()
    value[ended] += prior.log_conditional_death(left[ended], right[ended])
    return value


def _log_sums(log_values: FloatArray, instants: int) -> FloatArray:
    """Return the logarithms (K,) of sums over the instants of each stay."""
    return np.asarray(np.logaddexp.reduce(log_values.reshape(-1, instants), axis=1))
