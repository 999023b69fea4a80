"""Hazards whose logarithm is a sum of Gaussian terms, learned from censored lifetimes by Laplace's approximation.

The hazard of sample i in stretch k of time is `h_ik = baseline_k exp(f_ik)`, and `f = sum_j X_j u_j` with
`u_j ~ N(0, scale_j^2 inv(Q_j))`. With exposures `E` from entry to the last sighting and `W` from there to the right
bound (MATH.md section 6; Rasmussen and Williams 2006, section 3.4, for the approximation),

    log p(sample i) = -sum_k E_ik h_ik + log(1 - exp(-sum_k W_ik h_ik))

without the second term where the right bound is infinite, and with `log h` at the end instead where that was observed.
Scales are found by MacKay's (1992) fixed point, which ascends the marginal likelihood: `scale^2 = u'Qu / gamma`, where
gamma is the number of directions of `u` that the data determine.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import NumericalError
from evermap.show import Shown
from evermap.survival.base import SurvivalEstimate, check_open_share, check_times
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.hazards import PiecewiseConstantHazard
from evermap.survival.logmath import log_one_minus_exp
from evermap.types import BoolArray, FloatArray, IntArray

STRETCHES = 24
DRAWS = 2000
"""Number of draws from the posterior, half of them mirror images of the other half."""
TAIL = 10
"""Stretches of a prior beyond the hazard's last, each as long as all before: uncertainty makes hazards fall there."""
GUESS, GUESS_COUNTS = 1.0, 1.0
"""Prior guess of a scale, and its weight in directions; it keeps scales of few directions away from 0."""
_ROUNDS, _SETTLED = 60, 0.02
_NEWTON, _STEP = 30, 3.0
_MOSTLY_EMPTY = 0.05
"""Below this share of nonzero entries a sparse matrix is faster."""


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """One term of the log hazard: `curves @ u` for all samples of a group, or `levels @ u` at all times.

    Attributes:
        curves: (G, K, d) for G groups and K stretches; or None.
        levels: (N, d), a sparse matrix or an array; or None.
        precision: (d, d) of `u` at scale 1.
        scale: of `u`; None where it is learned.
    """

    curves: FloatArray | None = None
    levels: Any = None
    precision: FloatArray | None = None
    scale: float | None = None

    @property
    def size(self) -> int:
        """Return the length d of `u`."""
        columns = self.curves if self.curves is not None else self.levels
        return int(columns.shape[-1])


@dataclass(frozen=True, slots=True, eq=False)
class Posterior(Shown):
    """Laplace's approximation of the posterior of all `u`, concatenated.

    Attributes:
        mean: (D,) most probable values.
        covariance: (D, D) around them.
        scales: of each term.
        log_evidence: the log marginal likelihood.
    """

    mean: FloatArray
    covariance: FloatArray
    scales: FloatArray
    log_evidence: float

    def draws(self, columns: FloatArray, unknown: float = 0.0, seed: int = 0) -> FloatArray:
        """Draw (DRAWS, K) values of `columns @ u` for (K, D) columns, plus a level of variance `unknown`."""
        spread = columns @ self.covariance @ columns.T + unknown
        values, vectors = np.linalg.eigh(0.5 * (spread + spread.T))
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        noise = np.random.default_rng(seed).standard_normal((DRAWS // 2, len(columns))) @ root.T
        return np.asarray(columns @ self.mean + np.concatenate([noise, -noise]))


@dataclass(frozen=True, slots=True, eq=False)
class HazardDraws(SurvivalEstimate):
    """An uncertain piecewise constant hazard, as equally probable draws.

    Attributes:
        edges_s: (K,) starts of the stretches in seconds, the first 0; the last rate holds for ever.
        rates: (S, K) hazards in 1/s.
    """

    edges_s: FloatArray
    rates: FloatArray

    def survival(self, t: ArrayLike, confidence: float = 0.95) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the expected `P(T > t)`, and its pointwise lower and upper credible bounds.

        Raises:
            ConfigError: `confidence` is not in (0, 1), or an invalid time.
        """
        check_open_share(confidence)
        times = check_times(t)
        survives = np.exp(-overlaps(np.zeros(times.size), times.ravel(), self.edges_s) @ self.rates.T)
        tail = 0.5 - 0.5 * confidence
        lower, upper = np.quantile(survives, [tail, 1.0 - tail], axis=1)
        bounds = (survives.mean(axis=1), lower, upper)
        expected, lower, upper = (np.asarray(values.reshape(times.shape))[()] for values in bounds)
        return expected, lower, upper

    def quantile(self, p: float, confidence: float = 0.95) -> tuple[float, float, float]:
        """Return the time by which a share `p` is gone: median of the draws and credible bounds, in seconds.

        Raises:
            ConfigError: `p` or `confidence` is not in (0, 1).
        """
        check_open_share(p, "p")
        check_open_share(confidence)
        target = -np.log1p(-p)
        cumulative = np.cumsum(self.rates[:, :-1] * np.diff(self.edges_s), axis=1)
        reached = np.concatenate([np.zeros((len(self.rates), 1)), cumulative], axis=1)
        stretch = (reached < target).sum(axis=1) - 1
        rows = np.arange(len(self.rates))
        with np.errstate(divide="ignore"):
            times = self.edges_s[stretch] + (target - reached[rows, stretch]) / self.rates[rows, stretch]
        tail = 0.5 - 0.5 * confidence
        middle, lower, upper = np.quantile(times, [0.5, tail, 1.0 - tail])
        return float(middle), float(lower), float(upper)

    def prior(self) -> PiecewiseConstantHazard:
        """Return the lifetime prior whose survival is the expected one at every edge and at later times of the tail."""
        reach_s = self.edges_s[-1] if len(self.edges_s) > 1 else 1.0 / self.rates.max()
        edges_s = np.concatenate([self.edges_s, reach_s * 2.0 ** np.arange(1, TAIL + 1)])
        steps = np.diff(edges_s)
        rates = np.concatenate([self.rates, np.repeat(self.rates[:, -1:], TAIL, axis=1)], axis=1)
        cumulative = np.cumsum(np.column_stack([np.zeros(len(rates)), rates[:, :-1] * steps]), axis=1)
        lightest = cumulative.min(axis=0)
        log_expected = np.log(np.exp(lightest - cumulative).mean(axis=0)) - lightest
        weight = np.exp(lightest[-1] - cumulative[:, -1])
        last = float(weight @ rates[:, -1] / weight.sum())
        return PiecewiseConstantHazard(tuple(edges_s), (*np.maximum(-np.diff(log_expected) / steps, 0.0), last))


def overlaps(first_s: FloatArray, last_s: FloatArray, edges_s: FloatArray) -> FloatArray:
    """Return the seconds (N, K) that each interval spends in each stretch; the last stretch has no end."""
    ends = np.append(edges_s[1:], np.inf)
    spent = np.minimum(last_s[:, None], ends) - np.maximum(first_s[:, None], edges_s)
    return np.asarray(np.maximum(spent, 0.0))


def stretches_for(data: CensoredLifetimes, count: int = STRETCHES) -> FloatArray:
    """Choose edges (count,) in seconds, even in log time over all but the earliest informative times."""
    seen = data.weight > 0.0
    finite = np.where(np.isfinite(data.right_s), data.right_s, data.left_s)[seen]
    high = float(max(finite.max(), data.left_s[seen].max()))
    low = float(np.quantile(finite[finite > 0.0], 0.02))
    # The latest end lies within the last stretch: at its start it would be an end without any exposure.
    return np.concatenate([[0.0], np.geomspace(min(low, 0.1 * high), high, count)[:-1]])


@dataclass(frozen=True, slots=True, eq=False)
class Exposures:
    """The samples in the form of the likelihood, times in units of the baseline's integral.

    Attributes:
        before, within: (N, K) integrals of the baseline over each stretch, `E` and `W` above times the baseline.
        ends: (N, K) 1 in the stretch of an observed end.
        log_baseline: (N,) at that end; 0 elsewhere.
        bounded: (N,) whether the end is known to lie in an interval.
        weight: (N,) of the samples.
        group: (N,) of each sample, which has a curve.
    """

    before: FloatArray
    within: FloatArray
    ends: FloatArray
    log_baseline: FloatArray
    bounded: BoolArray
    weight: FloatArray
    group: IntArray

    @classmethod
    def of(cls, data: CensoredLifetimes, edges_s: FloatArray, baseline: FloatArray, group: IntArray) -> Exposures:
        """Prepare samples, for baseline rates (K,) in 1/s."""
        since = np.maximum(data.left_s, data.entry_s)
        bounded = np.isfinite(data.right_s) & ~data.exact
        stretch = np.searchsorted(edges_s, data.left_s, side="right") - 1
        return cls(
            before=overlaps(data.entry_s, since, edges_s) * baseline,
            within=overlaps(since, np.where(bounded, data.right_s, since), edges_s) * baseline,
            ends=np.where(data.exact[:, None], np.eye(len(edges_s))[stretch], 0.0),
            log_baseline=np.where(data.exact, np.log(baseline[stretch]), 0.0),
            bounded=bounded,
            weight=data.weight,
            group=group,
        )

    def log_likelihood(self, f: FloatArray) -> FloatArray:
        """Return it (N,) for log hazards (N, K) relative to the baseline; weights are not applied."""
        ratio = np.exp(f)
        within = np.where(self.bounded, (self.within * ratio).sum(axis=1), np.inf)
        with np.errstate(divide="ignore"):
            caught = log_one_minus_exp(within)
        return np.asarray((self.ends * f - self.before * ratio).sum(axis=1) + caught + self.log_baseline)


def learn(samples: Exposures, terms: Sequence[Term]) -> Posterior:
    """Learn the most probable terms and scales, and the covariance; NumericalError if no maximum is found."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):  # matrices of some hundreds are faster on one thread
        model = _Model(samples, terms)
        scales = np.array([GUESS if term.scale is None else term.scale for term in terms])
        mean = np.zeros(model.size)
        for _ in range(_ROUNDS):
            mean, covariance, log_evidence = model.laplace(mean, scales)
            updated = scales.copy()
            for j, (term, columns) in enumerate(zip(terms, model.columns, strict=True)):
                if term.scale is None:
                    u, precision = mean[columns], model.precisions[j]
                    left = float(np.sum(precision * covariance[columns, columns])) / scales[j] ** 2
                    determined = max(term.size - left, 0.0)
                    updated[j] = np.sqrt((u @ precision @ u + GUESS_COUNTS * GUESS**2) / (determined + GUESS_COUNTS))
            if float(np.abs(np.log(updated / scales)).max(initial=0.0)) < _SETTLED:
                break
            scales = updated
        return Posterior(mean, covariance, scales, log_evidence)


class _Model:
    """The log posterior and its derivatives by all u."""

    def __init__(self, samples: Exposures, terms: Sequence[Term]) -> None:
        from scipy import sparse

        self.samples = samples
        groups, stretches = int(samples.group.max()) + 1, samples.before.shape[1]
        starts = np.cumsum([0, *(term.size for term in terms)])
        self.size = int(starts[-1])
        self.columns = [slice(int(a), int(b)) for a, b in itertools.pairwise(starts)]
        self.precisions = [np.eye(t.size) if t.precision is None else t.precision for t in terms]
        self.curves = np.zeros((groups, stretches, self.size))
        for term, columns in zip(terms, self.columns, strict=True):
            if term.curves is not None:
                self.curves[:, :, columns] = term.curves
        n = len(samples.weight)
        levels = [sparse.csr_matrix((n, t.size) if t.levels is None else t.levels) for t in terms]
        self.levels: Any = sparse.hstack(levels, format="csr")
        if self.levels.nnz > _MOSTLY_EMPTY * n * self.size:
            self.levels = self.levels.toarray()
        self.rows = [np.flatnonzero(samples.group == g) for g in range(groups)]
        self.log_determinants = [float(np.linalg.slogdet(precision)[1]) for precision in self.precisions]

    def laplace(self, start: FloatArray, scales: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return the most probable u at given scales, its covariance and the log evidence."""
        from scipy.linalg import cho_factor, cho_solve, cholesky

        penalty = np.zeros((self.size, self.size))
        for columns, precision, scale in zip(self.columns, self.precisions, scales, strict=True):
            penalty[columns, columns] = precision / scale**2

        def goodness(u: FloatArray) -> float:
            with np.errstate(over="ignore", invalid="ignore"):
                value = float(self.samples.weight @ self.samples.log_likelihood(self.f(u)) - 0.5 * u @ penalty @ u)
            return value if np.isfinite(value) else -np.inf

        u, best = start, goodness(start)
        for _ in range(_NEWTON):
            slope, information, safe = self.derivatives(u)
            slope = slope - penalty @ u
            try:
                step = cho_solve(cho_factor(information + penalty), slope)
            except np.linalg.LinAlgError:  # within a wide interval the likelihood may be convex
                step = cho_solve(cho_factor(safe + penalty), slope)
            step *= min(1.0, _STEP / max(float(np.abs(step).max()), 1e-300))
            while (after := goodness(u + step)) < best - 1e-9 * abs(best) and np.abs(step).max() > 1e-9:
                step *= 0.5
            gain = after - best
            if gain > 0.0:
                u, best = u + step, after
            if gain < 1e-6:
                break
        _, information, _ = self.derivatives(u)
        try:
            root = cholesky(information + penalty, lower=True)
        except np.linalg.LinAlgError as error:
            raise NumericalError(
                "no maximum of the hazard's posterior was found", hint="fewer covariates, or more data"
            ) from error
        covariance = np.asarray(cho_solve((root, True), np.eye(self.size)))
        volume = sum(
            log - 2.0 * len(precision) * np.log(scale)
            for log, precision, scale in zip(self.log_determinants, self.precisions, scales, strict=True)
        )
        return u, covariance, best + 0.5 * float(volume) - float(np.log(np.diag(root)).sum())

    def f(self, u: FloatArray) -> FloatArray:
        """Return log hazards (N, K) relative to the baseline."""
        return np.asarray((self.curves @ u)[self.samples.group] + (self.levels @ u)[:, None])

    @np.errstate(over="ignore")
    def derivatives(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the gradient, minus the second derivative, and a positive definite bound of it."""
        samples, weight = self.samples, self.samples.weight[:, None]
        ratio = np.exp(self.f(u))
        before, within = samples.before * ratio, samples.within * ratio
        total = within.sum(axis=1)
        caught = np.where(samples.bounded, 1.0 / np.expm1(np.clip(total, 1e-100, 700.0)), 0.0)[:, None]
        by_sample = weight * (samples.ends - before + caught * within)
        by_group = np.stack([by_sample[rows].sum(axis=0) for rows in self.rows])
        slope = np.einsum("gkd,gk->d", self.curves, by_group) + self.levels.T @ by_sample.sum(axis=1)
        curvature = (weight * caught * (1.0 + caught))[:, 0]
        sure, maybe = weight * before, weight * caught * within
        information, safe = (self._second(diagonal, within, curvature) for diagonal in (sure - maybe, sure))
        return np.asarray(slope), information, safe

    def _second(self, diagonal: FloatArray, within: FloatArray, curvature: FloatArray) -> FloatArray:
        """Return `sum_i X_i' (diag(diagonal_i) + curvature_i within_i within_i') X_i`."""
        total = within.sum(axis=1)
        result = _gram(self.levels, diagonal.sum(axis=1) + curvature * total**2)
        mixed = diagonal + (curvature * total)[:, None] * within
        for curve, rows in zip(self.curves, self.rows, strict=True):
            mine = within[rows]
            own = np.diag(diagonal[rows].sum(axis=0)) + mine.T @ (curvature[rows, None] * mine)
            cross = curve.T @ np.asarray(self.levels[rows].T @ mixed[rows]).T
            result += curve.T @ own @ curve + cross + cross.T
        return result


def _gram(columns: Any, weight: FloatArray) -> FloatArray:
    """Return `columns' diag(weight) columns`, dense."""
    if isinstance(columns, np.ndarray):
        return np.asarray(columns.T @ (weight[:, None] * columns))
    from scipy import sparse

    return np.asarray((columns.T @ sparse.diags(weight) @ columns).toarray())
