"""One model of lifetimes: a stated hazard times a smooth factor by age, learned from the stays of all classes together.

    log h_c(age) = log b_c(age) + v_c(age),     v_c = s + own_c

`b_c` is what the user states of class c, else the general-purpose prior; `s` is what all classes share and `own_c` what
a class has of its own, both Gaussian processes over log age: a slow one, which tells little of days from seconds, and a
fast one. Hazards are constant over stretches of age, so the likelihood of a stay is exact: entry, arrival between two
looks, the end between two looks, or none (MATH.md sections 6 and 9). Scales and the share of the variance that classes
have in common are on a grid, each weighed by its evidence, so nothing is searched that could fail to be found. Draws
are normal about the most probable hazards (Laplace), with exact densities along axes, and weights for the rest. The
hour of the week is in the clock by which ages are counted (`existence.hours`).

**What is stated is worth w stays**: in every stretch it has seen `d_k = w P(T in k)` ends at the hazard that it states
(a power prior, Ibrahim and Chen 2000), to which `v_c = 0` is most probable. The level of `b_c` is chosen such that the
expected survival without any stay is the stated one, to rounding. Where no stay was at risk, and ages are far from all
at which one was, the statement is what is left; `seen_s` tells these ages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Self

import numpy as np

from evermap.survival.base import LifetimePrior
from evermap.survival.hazard_grid import (
    COMMON,
    HazardScale,
    count_draws,
    draw_normals,
    find_shares,
    make_scales,
    weigh_draws,
)
from evermap.survival.hazard_posterior import HazardPosterior, integrate_expected
from evermap.survival.logmath import TINY, log_sum_exp
from evermap.survival.newton import LONGEST, MOST_STEPS, climb, drop_negative, log_determinant
from evermap.survival.stay_likelihood import StayAges, StayLikelihood
from evermap.types import FloatArray, IntArray

EDGES_S = np.concatenate([[0.0], np.geomspace(1.0, 1e9, 37)])
"""Stretches of constant hazard: four to a factor of ten."""
LEAST_STRETCHES = 14
"""Stretches between the ages of the first and the last ends that were seen."""
LEAST_SURVIVAL, TRUSTED = 1e-9, 0.02
"""Survival down to which the expected one is that of the usual prior, and of a stated one: what is left of a stated
hazard later is its ratio to the expected one, the less, the more was seen at that age."""
LINE = np.linspace(-6.0, 6.0, 17)
FINE_LINE, FAR = np.linspace(-6.0, 6.0, 241), [5, 11]
"""Standard deviations at which exact densities are computed, and those between; the two which tell whether to."""
STRAIGHT, HEAVIEST = 0.1, 16.0
"""Difference of log densities there up to which the normal one is kept; and the largest weight, in mean ones."""
NO_LESS = 1e-6
"""Share of the prior's information below zero that is rounding. That of no class may be less: what each of many loses
of the prior would be lost to all of them together, which leaves a posterior that is none."""
_SETTLED = 1e-4
_EXACT = 1e-12
"""Relative error of a stated hazard."""


@dataclass(frozen=True, slots=True)
class Statement:
    """What a user states of a class, worth some stays; on stretches.

    Attributes:
        prior: as stated.
        worth: number of stays.
    """

    prior: LifetimePrior
    worth: float


def stretches(stays: StayAges) -> FloatArray:
    """Return edges (K,) in seconds: `EDGES_S`, and finer ones where most ends of a class were seen within few."""
    edges = EDGES_S
    for group in np.unique(stays.group[stays.ended]).tolist():
        of = stays.of_group(group)
        middle, ended = np.full(len(of.weight), np.nan), of.ended
        middle[ended] = 0.5 * (of.last_s + of.gone_s)[ended].mean(axis=1)
        low, high = np.quantile(middle[ended], [0.02, 0.98])
        finer = np.geomspace(0.9 * max(low, 1.0), 1.1 * max(high, 2.0), LEAST_STRETCHES)
        near = np.abs(np.log(np.maximum(edges, 1e-3) / finer[:, None])).min(axis=1)
        edges = np.sort(np.append(edges, finer[near > 0.5 * np.log(finer[1] / finer[0])]))
    return edges


def learn_hazards(
    stays: StayAges,
    said: Sequence[Statement | None],
    usual: LifetimePrior,
    edges_s: FloatArray | None = None,
) -> list[HazardPosterior]:
    """Learn the hazards of C classes, and of one that was never seen, from the stays of all of them.

    Args:
        stays: of all classes; `group` counts them.
        said: (C,) what a user states of each; None where nothing.
        usual: the lifetime of a class of which nothing is known.
        edges_s: (K,) starts of stretches of constant hazard, the first 0; as `stretches` where None.

    Returns:
        (C + 1,) posteriors, the last one of a class without stays.
    """
    evidence = _Evidence(stays, tuple(said), usual, stretches(stays) if edges_s is None else np.asarray(edges_s))
    try:
        hash(evidence)
    except TypeError:  # a lifetime of another package may not be comparable
        return _learn(evidence)
    return list(_learn_once(evidence))


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """What hazards are learned from, as the arguments of `learn_hazards`; two of the same content are equal."""

    stays: StayAges
    said: tuple[Statement | None, ...]
    usual: LifetimePrior
    edges_s: FloatArray

    @property
    def content(self) -> tuple[Any, ...]:
        """Return what makes it equal to another one."""
        columns = (getattr(self.stays, name) for name in StayAges.__slots__)
        arrays = [np.asarray(column, dtype=np.float64) for column in (*columns, self.edges_s)]
        return (self.said, self.usual, *((one.shape, one.tobytes()) for one in arrays))

    def __hash__(self) -> int:
        return hash(self.content)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Evidence) and self.content == other.content


@lru_cache(maxsize=8)
def _learn_once(evidence: _Evidence) -> tuple[HazardPosterior, ...]:
    """Return what was learned from the same evidence: sessions that change nothing, and who asks again."""
    return tuple(_learn(evidence))


def _learn(evidence: _Evidence) -> list[HazardPosterior]:
    stays, said, edges_s = evidence.stays, evidence.said, evidence.edges_s
    edges = tuple(edges_s.tolist())
    free = [row for row, one in enumerate(said) if one is None]
    likelihoods = [StayLikelihood(stays.of_group(row), edges_s) for row in range(len(said))]
    risk = [_at_risk(one) for one in likelihoods]
    found: list[HazardPosterior] = [None] * (len(said) + 1)  # type: ignore[list-item]
    base, scales = _usual_base(evidence.usual, edges), make_scales(edges)
    together = _Together.of([likelihoods[row] for row in free], stays, free, edges_s)
    modes = list[_Mode]()
    for scale in scales:
        near = modes[-1] if modes and modes[-1].scale.columns is scale.columns else modes[0] if modes else None
        modes.append(together.mode(scale, base, near))
    counts = count_draws(find_shares(scales, [mode.evidence for mode in modes]))
    drawn = [(mode, together.draw(mode, base, n)) for mode, n in zip(modes, counts, strict=True) if n]
    share = find_shares([mode.scale for mode, _ in drawn], [mode.evidence + each.gain for mode, each in drawn])
    for at, row in enumerate([*free, len(said)]):
        rates = base * np.exp(np.concatenate([each.v[at] for _, each in drawn]))
        weight = np.concatenate([p * each.weight[at] for p, (_, each) in zip(share, drawn, strict=True)])
        of = np.zeros(len(edges)) if row == len(said) else risk[row]
        found[row] = HazardPosterior(edges_s, rates, weight, None, np.zeros(len(edges)), of)
    for row, one in enumerate(said):
        if one is not None:
            found[row] = _fit_stated(likelihoods[row], one, edges, risk[row])
    return found


def _at_risk(likelihood: StayLikelihood) -> FloatArray:
    """(K,) stays that were at risk in each stretch, between first sighting and the last bound."""
    during, after = (spent[:, 0] for spent in likelihood.spent[1:])
    return np.asarray(likelihood.stays.weight @ ((during + after) > 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class _Mode:
    """The most probable hazards of all classes under one member of the grid.

    Attributes:
        scale: the member.
        shared, own: (R,) numbers that all classes share, (C, R) those of each class, with the shared ones.
        slopes, hessian: (C, R), (C, R, R) gradients of the log likelihoods there, and informations with the prior's.
        inverse, of_shared: (C, R, R) inverse of these, (R, R) covariance of the shared numbers.
        evidence: log evidence of the member, by a normal posterior.
    """

    scale: HazardScale
    shared: FloatArray
    own: FloatArray
    slopes: FloatArray
    hessian: FloatArray
    inverse: FloatArray
    of_shared: FloatArray
    evidence: float


@dataclass(frozen=True, slots=True, eq=False)
class _Draws:
    """Draws under one member of the grid, of each class and of a new one.

    Attributes:
        v: (C + 1,) of them (S, K), logarithms of hazards.
        weight: (C + 1,) of them (S,) of sum 1.
        gain: log evidence over that of a normal posterior.
    """

    v: list[FloatArray]
    weight: list[FloatArray]
    gain: float


@dataclass(frozen=True, slots=True, eq=False)
class _Together:
    """The stays of C classes that lean on each other.

    The numbers of a class are those that all share, of variance `common`, plus its own. Own ones are eliminated first.

    Attributes:
        each: likelihoods of the classes.
        every: of the stays of all, in their order.
        row: (N,) class of each of these.
    """

    each: list[StayLikelihood]
    every: StayLikelihood
    row: IntArray

    @classmethod
    def of(cls, each: list[StayLikelihood], stays: StayAges, classes: list[int], edges_s: FloatArray) -> Self:
        order = np.argsort(stays.group, kind="stable")
        order = order[np.isin(stays.group[order], classes)]
        mine = StayAges(*(getattr(stays, name)[order] for name in StayAges.__slots__))
        return cls(each, StayLikelihood(mine, edges_s), np.searchsorted(classes, mine.group))

    def mode(self, scale: HazardScale, base: FloatArray, near: _Mode | None = None) -> _Mode:
        """Return the most probable numbers, by Newton's method from those of another member, else from none."""
        columns, n, r = scale.columns, len(self.each), scale.columns.shape[1]
        of_shared, of_own = 1.0 / scale.common, 1.0 / (1.0 - scale.common)
        shared, own = np.zeros(r), np.zeros((n, r))

        def bent(s: FloatArray, v: FloatArray) -> tuple[float, FloatArray, FloatArray]:
            with np.errstate(over="ignore", invalid="ignore"):
                value, gradients, curvatures = self.every.by_class(base * np.exp(v @ columns.T), self.row)
            value -= 0.5 * of_shared * float(s @ s) + 0.5 * of_own * float(np.square(v - s).sum())
            informations = np.array(
                [drop_negative(one, NO_LESS * of_own * np.eye(r)) for one in -columns.T @ curvatures @ columns]
            )
            informations = informations.reshape(n, r, r)
            return value if np.isfinite(value) else -np.inf, gradients @ columns, informations

        best, slopes, informations = bent(shared, own)
        if near is not None:
            onto = np.eye(r) if near.scale.columns is columns else near.scale.columns.T @ np.linalg.pinv(columns).T
            start = near.shared @ onto, near.own @ onto
            if (there := bent(*start))[0] > best:
                (shared, own), (best, slopes, informations) = start, there
        for _ in range(MOST_STEPS):
            pull = slopes - of_own * (own - shared)
            inverse = np.linalg.inv(informations + of_own * np.eye(r))
            matrix = (of_shared + n * of_own) * np.eye(r) - of_own**2 * inverse.sum(axis=0)
            solved = np.einsum("gij,gj->gi", inverse, pull)
            slope = -of_shared * shared + of_own * ((own - shared) + solved).sum(axis=0)
            step = np.linalg.solve(matrix, slope)
            steps = solved + of_own * inverse @ step
            factor = min(1.0, LONGEST / max(float(np.abs(steps @ columns.T).max(initial=0.0)), 1e-300))
            while (after := bent(shared + factor * step, own + factor * steps))[0] < best and factor > 1e-4:
                factor *= 0.5
            gain = after[0] - best
            if gain > 0.0:
                shared, own = shared + factor * step, own + factor * steps
                best, slopes, informations = after
            if gain < _SETTLED:
                break
        hessian = informations + of_own * np.eye(r)
        inverse = np.linalg.inv(hessian)
        matrix = (of_shared + n * of_own) * np.eye(r) - of_own**2 * inverse.sum(axis=0)
        evidence = best + 0.5 * r * (np.log(of_shared) + n * np.log(of_own)) - 0.5 * log_determinant(matrix)
        evidence -= 0.5 * sum(log_determinant(one) for one in hessian)
        of_each, of_both = (np.asarray(np.linalg.inv(one), dtype=np.float64) for one in (hessian, matrix))
        return _Mode(scale, shared, own, slopes, hessian, of_each, of_both, float(evidence))

    def draw(self, mode: _Mode, base: FloatArray, count: int) -> _Draws:
        """Return draws about the most probable numbers."""
        scale, columns, n = mode.scale, mode.scale.columns, len(self.each)
        of_shared, of_own = 1.0 / scale.common, 1.0 / (1.0 - scale.common)
        one, other = draw_normals(columns.shape[1], count)
        common = one @ _root(mode.of_shared)
        draws, weights, moved, gain = [], [], np.zeros_like(common), 0.0
        for row, covariance in enumerate(mode.inverse):
            spread = of_own * common @ covariance + other @ _root(covariance)
            information = mode.hessian[row] - of_own * np.eye(len(covariance))
            value = float(self.each[row].values(base * np.exp(columns @ mode.own[row])[None])[0])
            line = _Line(self.each[row], base, columns, mode.own[row], mode.slopes[row], information, value)
            whole = covariance + of_own**2 * covariance @ mode.of_shared @ covariance
            found, weight, more = line.draw(spread, whole)
            gain += more
            moved += found - spread
            draws.append((mode.own[row] + found) @ columns.T)
            weights.append(weight)
        common = common + of_own / (of_shared + n * of_own) * moved
        draws.append((mode.shared + common + np.sqrt(1.0 / of_own) * other) @ columns.T)
        weights.append(np.full(count, 1.0 / count))
        return _Draws(draws, weights, gain)


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """The likelihood of a class along lines through the most probable numbers.

    Attributes:
        likelihood: of its stays.
        base: (K,) hazards that are 1.
        columns: (K, R) of the scale.
        mode, slope, information: (R,), (R,), (R, R) most probable numbers, gradient and information there.
        value: log likelihood there.
    """

    likelihood: StayLikelihood
    base: FloatArray
    columns: FloatArray
    mode: FloatArray
    slope: FloatArray
    information: FloatArray
    value: float

    def excess(self, deviations: FloatArray) -> FloatArray:
        """Return by how much (...) the log likelihood is over its parabola, at deviations (..., R) from the mode."""
        with np.errstate(over="ignore", invalid="ignore"):
            hazards = self.base * np.exp((self.mode + deviations) @ self.columns.T)
            values = self.likelihood.values(hazards.reshape(-1, len(self.base))).reshape(deviations.shape[:-1])
            bend = 0.5 * ((deviations @ self.information) * deviations).sum(axis=-1)
            found = values - self.value - deviations @ self.slope + bend
        return np.asarray(np.where(np.isfinite(found), found, -1.0 / TINY))

    def draw(self, spread: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return deviations (S, R) from the mode, their weights (S,), and the log evidence gained over normal ones.

        A normal posterior has too many high hazards where few ends were seen: the density falls slowly towards low
        ones, and steeply towards high ones. Along axes on which likelihood and prior are independent the draws have
        their exact densities; what is left is made up for by weights (importance sampling, of at most `HEAVIEST`).
        """
        from scipy.special import ndtr

        root = _root(covariance)  # which Cholesky's is not where the likelihood is convex
        _, turned = np.linalg.eigh(root @ self.information @ root)
        axes = root @ turned
        bent = np.flatnonzero(np.abs(self.excess(LINE[FAR, None] * axes.T[:, None])).max(axis=1) > STRAIGHT)
        if not len(bent):
            return spread, np.full(len(spread), 1.0 / len(spread)), 0.0
        normal = spread @ np.linalg.solve(covariance, axes)
        exact, gain, proposed = normal.copy(), 0.0, np.zeros(len(spread))
        for axis, over in zip(bent.tolist(), self.excess(LINE[:, None] * axes.T[bent, None]), strict=True):
            log_p = np.interp(FINE_LINE, LINE, over) - 0.5 * FINE_LINE**2
            p = np.exp(log_p - log_p.max())
            gain += log_p.max() + np.log(p.sum() * (FINE_LINE[1] - FINE_LINE[0]) / np.sqrt(2.0 * np.pi))
            below = (np.cumsum(p) - 0.5 * p) / p.sum()
            exact[:, axis] = np.interp(ndtr(normal[:, axis]), below, FINE_LINE)
            proposed += np.interp(exact[:, axis], LINE, over)
        found = spread + (exact - normal) @ axes.T
        log_weight = self.excess(found) - proposed
        weight = np.exp(log_weight - log_weight.max())
        gain += log_weight.max() + np.log(weight.mean())
        weight = np.minimum(weight, HEAVIEST * weight.mean())
        return found, weight / weight.sum(), float(gain)


def _root(covariance: Any) -> FloatArray:
    """Return the symmetric R with `R R = covariance`."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _fit_stated(
    likelihood: StayLikelihood, said: Statement, edges: tuple[float, ...], risk: FloatArray
) -> HazardPosterior:
    """Return the posterior of a class of which a user states a lifetime."""
    edges_s = np.asarray(edges)
    ends_s = np.append(edges_s[1:], 2.0 * edges_s[-1])
    alive = np.exp(np.asarray(said.prior.log_survival(np.append(edges_s, ends_s[-1]))))
    ends = said.worth * np.maximum(alive[:-1] - alive[1:], 0.0)
    scales = [scale for scale in make_scales(edges) if scale.common == COMMON[0]]  # it leans on no other class
    of_scales = []
    for scale in scales:
        one, _ = draw_normals(scale.columns.shape[1])
        root: FloatArray = _root(np.linalg.inv(_precision(scale, ends)))
        of_scales.append(one @ root @ scale.columns.T)
    without = np.concatenate(of_scales)
    even = weigh_draws(scales)
    base = _match_survival(said.prior, edges_s, without, even, TRUSTED)
    expected = integrate_expected(base * np.exp(without), even, edges_s)
    base = _not_impossible(base, likelihood, said, edges_s)
    log_evidence, draws = [], []
    for scale in scales:
        evidence, mode, covariance = _fit_alone(likelihood, scale, ends, base)
        log_evidence.append(evidence)
        one, _ = draw_normals(len(mode))
        draws.append((mode + one @ _root(covariance)) @ scale.columns.T)
    v, weight = np.concatenate(draws), weigh_draws(scales, log_evidence)
    kept = weight @ np.square(v - weight @ v) / (even @ np.square(without - even @ without))
    stated = 0.0 - np.asarray(said.prior.log_conditional_survival(edges_s, ends_s))
    known = (stated > 0.0) & np.isfinite(stated) & (expected > 0.0)
    before = np.log(np.where(known, stated, 1.0) / np.where(known, expected, 1.0)) * np.minimum(kept, 1.0)
    return HazardPosterior(edges_s, base * np.exp(v), weight, said.prior, before, risk)


def _precision(scale: HazardScale, ends: FloatArray) -> FloatArray:
    """Return the information (R, R) of the process and of ends (K,) in the stretches."""
    return np.asarray(np.eye(scale.columns.shape[1]) + (scale.columns.T * ends) @ scale.columns)


def _fit_alone(
    likelihood: StayLikelihood, scale: HazardScale, ends: FloatArray, base: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Return log evidence, mode (R,) and covariance of one class with pseudo-ends at the stated hazard."""
    columns = scale.columns

    def goodness(z: FloatArray) -> float:
        v = columns @ z
        with np.errstate(over="ignore", invalid="ignore"):
            value = float(likelihood.values(base * np.exp(v)[None])[0])
            value += float(ends @ (v - np.expm1(v))) - 0.5 * float(z @ z)
        return value if np.isfinite(value) else -np.inf

    def bent(z: FloatArray) -> tuple[FloatArray, FloatArray]:
        v = columns @ z
        _, slope, curvature = likelihood(base * np.exp(v))
        hessian = drop_negative(-columns.T @ curvature @ columns, np.eye(len(z))) + _precision(scale, ends * np.exp(v))
        return columns.T @ (slope - ends * np.expm1(v)) - z, hessian

    z, hessian, best = climb(goodness, bent, np.zeros(columns.shape[1]), columns, _SETTLED)
    evidence = best + 0.5 * log_determinant(_precision(scale, ends)) - 0.5 * log_determinant(hessian)
    return evidence, z, np.asarray(np.linalg.inv(hessian), dtype=np.float64)


def _not_impossible(base: FloatArray, likelihood: StayLikelihood, said: Statement, edges_s: FloatArray) -> FloatArray:
    """Return hazards under which every end that was seen is possible.

    A hazard of zero, worth w stays, is one of which w stays have seen no end: one in w in a factor e of age.
    """
    after = likelihood.spent[2][likelihood.ended]
    if not len(after):
        return base
    impossible = (after * base).sum(axis=(1, 2)) <= 0.0
    touched = (after[impossible] > 0.0).any(axis=(0, 1)) & (base <= 0.0)
    least = 1.0 / (1.0 + said.worth) / np.maximum(edges_s, 0.5 * edges_s[1])
    return np.where(touched, least, base)


def _usual_base(usual: LifetimePrior, edges: tuple[float, ...]) -> FloatArray:
    """Return hazards (K,) such that draws as those of a class without stays have the usual expected survival."""
    scales, draws, weights = make_scales(edges), [], []
    share = find_shares(scales, np.zeros(len(scales)))
    for scale, p, n in zip(scales, share.tolist(), count_draws(share), strict=True):
        one, other = draw_normals(scale.columns.shape[1], n)
        numbers = np.sqrt(scale.common) * one + np.sqrt(1.0 - scale.common) * other
        draws.append(numbers @ scale.columns.T)
        weights.append(np.full(n, p / n))
    return _match_survival(usual, np.asarray(edges), np.concatenate(draws), np.concatenate(weights))


def _match_survival(
    prior: LifetimePrior, edges_s: FloatArray, v: FloatArray, weight: FloatArray, least: float = LEAST_SURVIVAL
) -> FloatArray:
    """Return hazards (K,) such that the expected survival over draws `v` (S, K) is that of a prior at all edges.

    Beyond the age at which less than `least` survive, which few draws tell, they keep their ratio to the stated ones.
    """
    ends_s = np.append(edges_s[1:], 2.0 * edges_s[-1])
    steps = ends_s - edges_s
    wanted = np.asarray(prior.log_conditional_survival(edges_s, ends_s))
    alive = np.asarray(prior.log_survival(edges_s))
    log_weight, base = np.log(weight), np.zeros(len(edges_s))
    ratio = 1.0
    for k in range(len(edges_s)):
        if wanted[k] == 0.0:
            continue
        plain = -wanted[k] / steps[k]
        if not (alive[k] + wanted[k] > np.log(least) and np.isfinite(wanted[k])):
            base[k] = ratio * (plain if np.isfinite(plain) else 50.0 / steps[k])
            continue
        rise = steps[k] * np.exp(v[:, k])
        p = np.exp(log_weight - log_sum_exp(log_weight))
        level = np.log(plain)
        low, high = level - 30.0, level + 30.0
        for _ in range(100):  # log expected survival falls with the level
            gone = np.exp(level) * rise
            left = float(p @ np.exp(-gone))
            error = np.log(max(left, TINY)) - wanted[k]
            slope = float(p @ (gone * np.exp(-gone))) / max(left, TINY)
            if abs(error) < _EXACT * slope:
                break
            low, high = (level, high) if error > 0.0 else (low, level)
            step = error / max(slope, TINY)
            level = level + step if low < level + step < high else 0.5 * (low + high)
        base[k] = np.exp(level)
        ratio = base[k] / plain
        log_weight = log_weight - base[k] * rise
    return base
