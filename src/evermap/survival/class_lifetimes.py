"""Lifetimes of several classes learned together, so that one or two stays of a class suffice.

    T of class c      Weibull with mean and shape of its own
    log mean_c        normal about a level that all classes share, level and spread unknown
    log shape_c       normal about 0: constant hazard, unless the data differ

Every unknown is on a grid, so posteriors are sums: nothing is searched, nothing can fail to converge, and results are
reproducible. The curve of a class is the mean of its posterior, which forecasts need. A class without stays gets what
the classes have in common; without any data that is a constant hazard of unknown size, as the general-purpose prior
(Rosen 2016, eq. 26).

The likelihood of a stay is that of `censored`, with the arrival marginalised between the look before and the first
sighting. A stay without a look before began any time before: then the same sum over arrivals is the law of the residual
life of a stationary renewal process, `int_r^inf S / mean`.

Many sites add a level between: mean and shape of a class are the company's, those of a site are normal about them, with
spreads that all classes share and that are on a grid as well (`SitesPosterior`).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from evermap.show import Shown
from evermap.survival.hazards import PiecewiseConstantHazard
from evermap.types import FloatArray

LOG_MEAN = np.arange(math.log(1200.0), math.log(1.5e9), 0.25)
"""Logarithms of mean durations in seconds, 20 minutes to 45 years."""
LOG_SHAPE = np.arange(-1.0, 1.3, 0.25)
"""Logarithms of Weibull shapes, 0.37 to 3.5."""
LOGIT_RETURN = np.arange(-4.5, 4.6, 1.0)
"""Logits of the probability that a landmark that left ever returns."""
FINE = 4
"""Likelihoods are smooth: they are computed on the grids above and interpolated to ones this many times finer."""
SHAPE_SPREAD = 0.5
"""Standard deviation of the logarithms of shapes."""
_LEVELS = np.linspace(math.log(3600.0), math.log(3650.0 * 86400.0), 12)
_SPREADS = np.array([0.5, 1.0, 2.0, 4.0])
"""Between classes: means of log mean durations (an hour to ten years), and standard deviations about them."""
SITE_SPREADS = {
    False: ((0.0, 0.25, 0.5, 1.0, 2.0), (0.0, 0.25, 0.5)),
    True: ((0.0, 0.25, 0.5, 1.0, 2.0), (0.0, 0.5, 1.0, 2.0)),
}
"""Standard deviations between the sites of a company: of log means, from sites that are alike to a factor of seven; and
of log shapes, or logits of the probability of return (`improper`). All pairs are equally probable before."""
_EDGES_S = np.concatenate([[0.0], np.geomspace(1800.0, 1e9, 23)])
"""Curves have constant hazards between these ages."""
INSTANTS = 0.5 + np.array([-0.5, 0.5]) / math.sqrt(3.0)
"""Gauss-Legendre nodes of the arrival between two looks, as shares of the gap."""
_LEAST = 1e-300


@dataclass(frozen=True, slots=True, eq=False)
class ClassPosterior(Shown):
    """Posterior of the durations of C classes, and of a class without data.

    Attributes:
        weight: (C + 1, M, A) posterior probabilities of `mean_s` and `second`; the last row for a new class.
        mean_s: (M,) mean durations of stays or absences that end.
        second: (A,) Weibull shapes of stays, probabilities of return of absences.
        improper: whether `second` are probabilities of return.
    """

    weight: FloatArray
    mean_s: FloatArray
    second: FloatArray
    improper: bool

    @classmethod
    def of(cls, log_likelihood: FloatArray, said: FloatArray | float = 0.0, *, improper: bool = False) -> Self:
        """Compute it from log likelihoods (C, M, A) on `LOG_MEAN` and `LOG_SHAPE`, or `LOGIT_RETURN` of absences.

        Args:
            log_likelihood: of what was seen; it is interpolated to a finer grid.
            said: (C, M', A') log likelihoods on that grid, `finer` of both, of what else is known; none where it is 0.
            improper: whether they are of absences.
        """
        fine = _fine(log_likelihood) + said
        weight, _ = _classes(fine, improper)
        weight[:-1] *= np.exp(fine - fine.max(axis=(1, 2), keepdims=True, initial=-np.inf))
        return cls._normalise_weights(weight, improper)

    @classmethod
    def _normalise_weights(cls, weight: FloatArray, improper: bool) -> Self:
        weight = weight / weight.sum(axis=(1, 2), keepdims=True)
        return cls(weight, np.exp(finer(LOG_MEAN)), _second(improper), improper)

    def curve(self, row: int) -> PiecewiseConstantHazard:
        """Return the posterior mean of the survival function of a class; -1 for one without data."""
        survival = _survival_table(self.improper) @ self.weight[row].ravel()
        known = survival > 1e-9
        log_s = np.log(survival[known])
        rates = np.maximum((log_s[:-1] - log_s[1:]) / np.diff(_EDGES_S[known]), 0.0)
        last = 0.0 if self.improper else rates[-1]
        return PiecewiseConstantHazard(tuple(_EDGES_S[known]), (*rates, last))

    def band(self, row: int, ages_s: ArrayLike, confidence: float = 0.95) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the posterior mean of `P(T > age)` at each age (N,), and the bounds of its credible interval."""
        survival = _survival(np.asarray(ages_s, dtype=np.float64), self.mean_s, self.second, self.improper)
        weight = self.weight[row].ravel()
        order = np.argsort(survival, axis=1)
        ordered = np.take_along_axis(survival, order, axis=1)
        below = np.cumsum(weight[order], axis=1)
        tail = 0.5 * (1.0 - confidence)
        lower, upper = (
            ordered[np.arange(len(ordered)), np.minimum(np.sum(below < level, axis=1), ordered.shape[1] - 1)]
            for level in (tail, 1.0 - tail)
        )
        return survival @ weight, lower, upper


@dataclass(frozen=True, slots=True, eq=False)
class SitesPosterior(Shown):
    """Joint posterior of many sites on the durations of C classes, and of an unseen class.

    For each pair of spreads, of log mean and of second parameter, the posterior of the company's own; a site's are
    normal about them. Given the spreads all sums are exact on the grid, and the spreads are summed over: nothing is set
    to its most probable value (Gelman et al. 2013, section 5.3).

    Attributes:
        log_weight: (H, C + 1, M, A) log posterior probabilities of the company's mean and second parameter, with those
            of the H pairs; the last row for a new class.
        spreads: (H, 2) the pairs.
        kernels: of each, matrices (M, M) and (A, A) of a site's given the company's.
        improper: as of `ClassPosterior`.
    """

    log_weight: FloatArray
    spreads: FloatArray
    kernels: tuple[tuple[FloatArray, FloatArray], ...]
    improper: bool

    @classmethod
    def of(
        cls,
        log_likelihood: FloatArray,
        *,
        improper: bool = False,
        spreads: tuple[tuple[float, ...], tuple[float, ...]] | None = None,
    ) -> Self:
        """Compute it from log likelihoods (S, C, M, A) of S sites, as of `ClassPosterior`, 0 without data.

        Args:
            log_likelihood: of what was seen at each site; of absences where `improper`.
            improper: whether the second parameter is the probability of return.
            spreads: between sites, of log means and of second parameters; inf for sites that tell nothing of each
                other.
        """
        axes = finer(LOG_MEAN), finer(LOGIT_RETURN if improper else LOG_SHAPE)
        each = np.array(list(itertools.product(*(spreads or SITE_SPREADS[improper]))))
        pairs = tuple((_about(axes[0], mean_spread), _about(axes[1], spread)) for mean_spread, spread in each.tolist())
        log_weight = np.zeros((len(pairs), log_likelihood.shape[1], len(axes[0]), len(axes[1])))
        for site in log_likelihood:
            fine = _fine(site)
            for row, pair in enumerate(pairs):
                log_weight[row] += _log_evidence(fine, pair)
        priors, log_evidence = zip(*(_classes(of_pair, improper) for of_pair in log_weight), strict=True)
        said = np.concatenate([log_weight, np.zeros_like(log_weight[:, :1])], axis=1)
        with np.errstate(divide="ignore"):
            log_weight = said + np.log(np.stack(priors))
        log_weight -= _log_sums(log_weight)
        log_pair = np.array(log_evidence)
        log_weight += (log_pair - np.logaddexp.reduce(log_pair))[:, None, None, None]
        return cls(log_weight, each, pairs, improper)

    @property
    def p_pair(self) -> FloatArray:
        """(H,) posterior probabilities of the pairs of spreads."""
        return np.asarray(np.exp(_log_sums(self.log_weight)[:, -1, 0, 0]))

    def site(self, log_likelihood: FloatArray | None = None) -> ClassPosterior:
        """Return the posterior of a site's classes.

        Args:
            log_likelihood: (C, M, A) of the site, one of those that this was computed from; None for another site.
        """
        log_weight = self.log_weight.copy()
        fine = None if log_likelihood is None else _fine(log_likelihood)
        if fine is not None:  # what the other sites say of the company
            for row, pair in enumerate(self.kernels):
                log_weight[row, :-1] -= _log_evidence(fine, pair)
        weight = np.exp(log_weight - log_weight.max(axis=(0, 2, 3), keepdims=True))
        of_pairs = (mean.T @ part @ second for part, (mean, second) in zip(weight, self.kernels, strict=True))
        of_site = np.sum(list(of_pairs), axis=0)
        if fine is not None:
            of_site[:-1] *= np.exp(fine - fine.max(axis=(1, 2), keepdims=True, initial=-np.inf))
        return ClassPosterior._normalise_weights(of_site, self.improper)


@dataclass(frozen=True, slots=True)
class Sightings(Shown):
    """K stays by their sightings, with possible interruptions between looks.

    Attributes:
        elsewhere_s, first_s, last_s, gone_s: (K,) as of `censored.lifetimes_of_sightings`.
        gap_s: (K, 2) two positive lengths of the gaps between the looks at a stay; half of the gaps have each.
        back_by_stay: (K,) probability that a landmark that leaves is elsewhere for one more stay, and then back.
        back_rate: (K,) rate in 1/s at which other landmarks return.
    """

    elsewhere_s: FloatArray
    first_s: FloatArray
    last_s: FloatArray
    gone_s: FloatArray
    gap_s: FloatArray
    back_by_stay: FloatArray
    back_rate: FloatArray


def stay_log_likelihood(seen: Sightings) -> FloatArray:
    """Return log probabilities (K, M, A) of the sightings of K stays, on `LOG_MEAN` and `LOG_SHAPE`."""
    result = np.empty((len(seen.first_s), len(LOG_MEAN), len(LOG_SHAPE)))
    came, ended = np.isfinite(seen.elsewhere_s), np.isfinite(seen.gone_s)
    watched_s, both_gaps_s = seen.last_s - seen.first_s, seen.gap_s.sum(axis=1)
    share = seen.gap_s / both_gaps_s[:, None]
    pairs = np.maximum(watched_s / both_gaps_s, 0.5)
    back, rate = seen.back_by_stay[:, None, None], seen.back_rate
    left_s = seen.gone_s[ended] - seen.last_s[ended]
    begin_s = seen.elsewhere_s[came, None] + INSTANTS * (seen.first_s - seen.elsewhere_s)[came, None]
    stamps = np.stack([seen.first_s, seen.last_s, np.where(ended, seen.gone_s, seen.last_s)])
    ages = stamps[:, came, None] - begin_s
    found = [(row, rows, stamps[row, rows] - seen.first_s[rows]) for row, rows in ((1, ~came), (2, ~came & ended))]
    hazard = np.zeros((3, len(result), len(INSTANTS), len(LOG_MEAN)))
    for a, shape in enumerate(np.exp(LOG_SHAPE)):
        per_scale = np.exp(-shape * (LOG_MEAN - math.lgamma(1.0 + 1.0 / shape)))
        hazard[:, came] = (ages**shape)[..., None] * per_scale
        for row, rows, since_s in found:
            hazard[row, rows] = _of_found((since_s**shape)[:, None] * per_scale, shape)[:, None]
        first, last, gone = hazard
        log_seen = -first
        for part in (0, 1):
            each = (share[:, part] / pairs)[:, None, None]
            leave = np.maximum((last - first) * each, _LEAST)
            come = back * leave + (rate * watched_s)[:, None, None] * each
            both = leave + come
            log_there_again = np.log(np.maximum((come + leave * np.exp(-both)) / both, _LEAST))
            log_seen += pairs[:, None, None] * log_there_again
        leave = np.maximum((gone - last)[ended], _LEAST)
        change = (1.0 + back[ended]) * leave + (rate[ended] * left_s)[:, None, None]
        log_seen[ended] += np.log(leave / change * -np.expm1(-change))
        # given presence at the first look, relative to which both instants are taken
        result[:, :, a] = _log_sum(log_seen) - _log_sum(-first)
    return result


def _log_sum(log_values: FloatArray) -> FloatArray:
    """Return the log of the sum (K, M) over two instants."""
    one, other = log_values[:, 0], log_values[:, 1]
    return np.asarray(np.maximum(one, other) + np.log1p(np.exp(-np.abs(one - other))))


def _of_found(hazard: FloatArray, shape: float) -> FloatArray:
    """Return the cumulative hazard of a residual life: `-log R(r)`, `R(r) = int_r^inf S / mean`."""
    from scipy.special import gammaincc, gammaln

    order = 1.0 / shape
    left = gammaincc(order, hazard)
    late = hazard - (order - 1.0) * np.log(np.maximum(hazard, _LEAST)) + gammaln(order)
    return np.asarray(np.where(left > 1e-290, -np.log(np.maximum(left, _LEAST)), late))


def absence_log_likelihood(
    there_s: FloatArray, first_s: FloatArray, last_s: FloatArray, back_s: FloatArray
) -> FloatArray:
    """Return log probabilities (K, M, A) of K absences on `LOG_MEAN` and `LOGIT_RETURN`.

    Args:
        there_s: (K,) last sighting before.
        first_s: (K,) first look at which it was away.
        last_s: (K,) last look at which it was away.
        back_s: (K,) next sighting; inf if there was none.
    """
    share = 1.0 / (1.0 + np.exp(-LOGIT_RETURN))
    begin_s = there_s[:, None] + INSTANTS * (first_s - there_s)[:, None]
    first, last, back = (  # (K, 2, M) probabilities that one that returns is still away
        np.exp(-(stamp_s[:, None] - begin_s)[..., None] * np.exp(-LOG_MEAN)) for stamp_s in (first_s, last_s, back_s)
    )
    ended = np.isfinite(back_s)
    seen = last[..., None] * share + (1.0 - share)
    seen[ended] = np.maximum(last[ended] - back[ended], _LEAST)[..., None] * share
    return np.asarray(np.log(seen.mean(axis=1)) - np.log((first[..., None] * share + (1.0 - share)).mean(axis=1)))


def _classes(fine: FloatArray, improper: bool) -> tuple[FloatArray, float]:
    """Sum over level and spread of the classes, given log likelihoods (C, M, A) on the finer grid.

    Returns:
        The prior (C + 1, M, A) of each class given the data of all others; and the log evidence of all, up to a
        constant.
    """
    if improper:
        share = _second(improper)
        second = share * (1.0 - share)  # even over probabilities
    else:
        second = np.exp(-0.5 * np.square(finer(LOG_SHAPE) / SHAPE_SPREAD))
    second /= second.sum()
    most = fine.max(axis=(1, 2), keepdims=True, initial=-np.inf)
    means = finer(LOG_MEAN)
    common = np.exp(-0.5 * np.square((means - _LEVELS[:, None, None]) / _SPREADS[:, None])).reshape(-1, len(means))
    common /= common.sum(axis=1, keepdims=True)  # (H, M)
    evidence = np.maximum((np.exp(fine - most) @ second) @ common.T, _LEAST)  # (C, H)
    log_hyper = np.log(evidence).sum(axis=0)
    hyper = np.exp(log_hyper - log_hyper.max())
    log_evidence = float(log_hyper.max() + np.log(hyper.sum()) + most.sum())
    hyper /= hyper.sum()
    of_means = np.concatenate([(hyper / evidence) @ common, (hyper @ common)[None]])
    return of_means[:, :, None] * second, log_evidence


def _second(improper: bool) -> FloatArray:
    """Return the second parameters (A,) on the finer grid."""
    if improper:
        return np.asarray(1.0 / (1.0 + np.exp(-finer(LOGIT_RETURN))))
    return np.asarray(np.exp(finer(LOG_SHAPE)))


def _about(nodes: FloatArray, spread: float) -> FloatArray:
    """Return probabilities (N, N) of the nodes, normal about each of them; even where the spread is infinite."""
    if spread == 0.0:
        return np.eye(len(nodes))
    near = np.exp(-0.5 * np.square((nodes - nodes[:, None]) / spread))
    return np.asarray(near / near.sum(axis=1, keepdims=True))


def _log_evidence(fine: FloatArray, pair: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Return the log evidence (C, M, A) of one site's data for each mean and second parameter of the company's."""
    most = fine.max(axis=(1, 2), keepdims=True, initial=-np.inf)
    seen = pair[0] @ np.exp(fine - most) @ pair[1].T
    return np.asarray(np.log(np.maximum(seen, _LEAST)) + most)


def _log_sums(log_weight: FloatArray) -> FloatArray:
    """Return the log of the sums over the last two axes, which are kept."""
    most = log_weight.max(axis=(-2, -1), keepdims=True)
    return np.asarray(most + np.log(np.exp(log_weight - most).sum(axis=(-2, -1), keepdims=True)))


def _fine(log_likelihood: FloatArray) -> FloatArray:
    """Return log likelihoods (C, M, A) on the finer grid."""
    return np.asarray(_cubic(len(LOG_MEAN)) @ log_likelihood @ _cubic(log_likelihood.shape[2]).T)


def finer(nodes: FloatArray) -> FloatArray:
    """Return the grid between the nodes on which posteriors live."""
    return np.asarray(np.interp(np.arange(FINE * (len(nodes) - 1) + 1) / FINE, np.arange(len(nodes)), nodes))


@lru_cache
def _cubic(n: int) -> FloatArray:
    """Return the matrix (N, n) that interpolates n nodes to N finer ones: cubic Lagrange through four nodes."""
    at = np.arange(FINE * (n - 1) + 1) / FINE
    start = np.clip(np.floor(at).astype(np.int64) - 1, 0, n - 4)
    matrix = np.zeros((len(at), n))
    for i in range(4):
        weight = np.ones(len(at))
        for j in range(4):
            if j != i:
                weight *= (at - start - j) / (i - j)
        matrix[np.arange(len(at)), start + i] = weight
    return matrix


def _survival(ages_s: FloatArray, mean_s: FloatArray, second: FloatArray, improper: bool) -> FloatArray:
    """Return the survival (N, M A) of every member of the grid at every age."""
    if improper:
        left = np.exp(-ages_s[:, None, None] / mean_s[:, None])
        return np.asarray(1.0 - second * (1.0 - left)).reshape(len(ages_s), -1)
    scale = mean_s[:, None] / np.array([math.gamma(1.0 + 1.0 / shape) for shape in second])
    return np.asarray(np.exp(-((ages_s[:, None, None] / scale) ** second))).reshape(len(ages_s), -1)


@lru_cache
def _survival_table(improper: bool) -> FloatArray:
    """Return the survival (J, M A) at the edges of curves."""
    return _survival(_EDGES_S, np.exp(finer(LOG_MEAN)), _second(improper), improper)
