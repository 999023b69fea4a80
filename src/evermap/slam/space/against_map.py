"""Test of the places of a given map: each against a robot located by all the others.

A landmark stands where the map has it, to within the map's own accuracy, or it was moved somewhere. With all other
places and the session fixed, its position is Gaussian in both cases, so the odds follow from two densities.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from evermap.geometry import se2, se3
from evermap.slam.space.estimate import SpatialOptimum, converged
from evermap.slam.space.problem import ANY_RAD, LEAST_WEIGHT, SpatialProblem
from evermap.types import FloatArray

ROUNDS = 12
FARTHEST = 0.25
"""Squared distances, as a share of the largest one, of places that are let go together."""
SETTLED = 0.01
"""Change of all probabilities that ends it."""
LOOSE = 1.0 / 20.0**2
"""Information of a session by itself in directions of which it says nothing [1/m^2, 1/rad^2]."""
LEAST_INFORMATION = 1.0 / 25.0
"""Of a place by the others alone: it is somewhere within 5 m, or 5 rad."""


@dataclass(frozen=True, slots=True)
class MapComparison:
    """Comparison of the map's places with those of the session.

    Attributes:
        p_stands: (K,) probability that each is where the map has it.
        off: (K, 6) twist from where the map has it to where it is, by the session and the other places.
        covariance: (K, 6, 6) of that.
        factor: by which the map's stated standard deviations were multiplied.
    """

    p_stands: FloatArray
    off: FloatArray
    covariance: FloatArray
    factor: float


def compared(optimum: SpatialOptimum, stated: FloatArray) -> tuple[SpatialOptimum, MapComparison]:
    """Return the optimum with every place of the map weighted by the probability that it stands, and these.

    Args:
        optimum: of a problem with a prior map.
        stated: (K, 6) standard deviations of the map's places.
    """
    problem = optimum.smoother.problem
    found = _asked(optimum, stated)
    for _ in range(ROUNDS):
        factor = _accuracy(found, stated, problem)
        weight = _believed(found, factor * stated, problem.prior.weight)
        held = bool(np.any((found.p_stands < 0.5) & (weight >= 0.5)))
        problem = replace(problem, prior=replace(problem.prior, sigma=factor * stated, weight=weight))
        optimum = converged(problem, optimum.estimate, optimum.noise, heavy_rounds=0)
        before, found = found, replace(_asked(optimum, factor * stated), factor=factor)
        if not held and np.abs(found.p_stands - before.p_stands).max(initial=0.0) < SETTLED:
            break
    return optimum, found


def _believed(found: MapComparison, sigma: FloatArray, before: FloatArray) -> FloatArray:
    """Return (K,) weights of the map's places: the farthest moved ones, which may distort others, go first."""
    spread = found.covariance + sigma[:, :, None] ** 2 * np.eye(6)
    far = np.einsum("ki,kij,kj->k", found.off, np.linalg.inv(spread), found.off)
    moved = (found.p_stands < 0.5) & (before >= 0.5)
    waits = moved & (far < FARTHEST * far[moved].max(initial=0.0))
    return np.where(waits, before, np.maximum(found.p_stands, LEAST_WEIGHT))


def _asked(optimum: SpatialOptimum, sigma: FloatArray) -> MapComparison:
    """Predict every place from the others and the session."""
    problem, prior = optimum.smoother.problem, optimum.smoother.problem.prior
    settings = problem.settings.map
    spread = optimum.smoother.spread(optimum.now)
    count, n = len(prior.place), len(problem.stamp_s)
    p_stands, off, covariance = np.ones(count), np.zeros((count, 6)), np.zeros((count, 6, 6))
    for k, place in enumerate(prior.place):
        own_place = optimum.estimate.place[place][None]
        mean = problem.off_map(np.array([k]), own_place, oriented=bool(problem.oriented[place]))[0]
        dim, at = len(mean), spread.own_first[n + place]
        own = np.linalg.inv(spread.own[at : at + dim * dim].reshape(dim, dim))
        # the map's own information on it is removed; the rest may be weak, but is positive
        values, vectors = np.linalg.eigh(own - np.diag(prior.weight[k] / prior.sigma[k, :dim] ** 2))
        alone = np.linalg.inv((vectors * np.maximum(values, LEAST_INFORMATION)) @ vectors.T)
        mean = alone @ (own @ mean)
        stands = _log_density(mean, alone + np.diag(sigma[k, :dim] ** 2))
        scales = [(m, rad) for m in settings.moved_m for rad in settings.moved_rad[: None if dim == 6 else 1]]
        wide = [np.diag(sigma[k, :dim] ** 2 + np.array([m] * 3 + [rad] * (dim - 3)) ** 2) for m, rad in scales]
        moved = np.logaddexp.reduce([_log_density(mean, alone + extra) for extra in wide]) - np.log(len(scales))
        odds = moved - stands + np.log(settings.p_moved / (1.0 - settings.p_moved))
        p_stands[k] = 1.0 / (1.0 + np.exp(np.clip(odds, -500.0, 500.0)))
        off[k, :dim], covariance[k, :dim, :dim] = mean, alone
    return MapComparison(p_stands, off, covariance, 1.0)


class Alone(NamedTuple):
    """The Gaussian of a session's P places without the map, in the frame of the map.

    Attributes:
        shift_m: (P, 3) from where they are with the map.
        covariance_m2: (3 P, 3 P) joint covariance of the positions, wide in what only the map knows.
        rotation: (P, 3, 3) covariance of their orientations with the map, in their own axes [rad^2].
    """

    shift_m: FloatArray
    covariance_m2: FloatArray
    rotation: FloatArray


def by_itself(optimum: SpatialOptimum) -> Alone:
    """Return what a session says of its places, linearised where the map holds it, which is taken back."""
    problem, place = optimum.smoother.problem, optimum.estimate.place
    count, n = len(place), len(problem.stamp_s)
    seen = np.flatnonzero(np.bincount(problem.place, optimum.now.weight, minlength=count) > problem.settings.inlier)
    first = np.full(count + 1, -1, dtype=np.int64)
    first[seen] = np.append(0, np.cumsum(np.where(problem.oriented[seen], 6, 3)))[:-1]
    joint = optimum.smoother.factorised(optimum.now).joint(n + seen)
    rotation = np.full((count, 3, 3), np.nan)
    onto = np.zeros((3 * len(seen), len(joint)))  # positions in the axes of the map
    for k, (row, at) in enumerate(zip(seen.tolist(), first[seen].tolist(), strict=True)):
        turned = problem.oriented[row]
        onto[3 * k : 3 * k + 3, at : at + 3] = se3.rotation_of(place[row]) if turned else np.eye(3)
        if turned:
            rotation[row] = joint[at + 3 : at + 6, at + 3 : at + 6]
    rows, shift = se2.xy_rows(seen, 3), np.zeros((count, 3))
    covariance = np.eye(3 * count) / LOOSE
    if not len(problem.prior.place):
        covariance[np.ix_(rows, rows)] = onto @ joint @ onto.T
        return Alone(shift, covariance, rotation)
    information, pull = np.linalg.inv(joint), np.zeros(len(joint))
    for k in np.flatnonzero(np.isin(problem.prior.place, seen)).tolist():
        row = int(problem.prior.place[k])
        off = problem.off_map(np.array([k]), place[row][None], oriented=bool(problem.oriented[row]))[0]
        jacobian = se3.right_jacobian_inverse(off) if len(off) == 6 else np.eye(3)
        said = jacobian.T * (problem.prior.weight[k] / problem.prior.sigma[k, : len(off)] ** 2)
        own = slice(int(first[row]), int(first[row]) + len(off))
        information[own, own] -= said @ jacobian
        pull[own] = said @ off
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    told = values > LOOSE
    shift[seen] = (onto @ vectors[:, told] @ ((vectors[:, told].T @ pull) / values[told])).reshape(-1, 3)
    root = onto @ (vectors / np.sqrt(np.maximum(values, LOOSE)))
    covariance[np.ix_(rows, rows)] = root @ root.T
    return Alone(shift, covariance, rotation)


def _log_density(off: FloatArray, covariance: FloatArray) -> float:
    root = np.linalg.cholesky(covariance)
    return float(-0.5 * np.sum(np.linalg.solve(root, off) ** 2) - np.log(np.diag(root)).sum())


def _accuracy(found: MapComparison, stated: FloatArray, problem: SpatialProblem) -> float:
    """Return the factor on the map's stated deviations that fits the unmoved places, with a weak prior at 1."""
    total = count = problem.settings.map.pseudo_count
    for k, place in enumerate(problem.prior.place):
        dim = 6 if problem.oriented[place] else 3
        spread = np.diag(found.covariance[k])[:dim]
        said = stated[k, :dim] < ANY_RAD
        excess = np.maximum(found.off[k, :dim] ** 2 - spread, 0.0) / stated[k, :dim] ** 2
        total += found.p_stands[k] * float(np.minimum(excess, 16.0)[said].sum())
        count += found.p_stands[k] * float(said.sum())
    return float(np.sqrt(total / count))
