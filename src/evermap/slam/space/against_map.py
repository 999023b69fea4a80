"""Test of the places of a given map: each against a robot located by all the others.

A landmark stands where the map has it, to within the map's own accuracy, or it was moved somewhere. With all other
places and the session fixed, its position is Gaussian in both cases, so the odds follow from two densities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from evermap.config import MapInSpaceConfig
from evermap.estimate.sparse.elimination import numbers_of
from evermap.geometry import se2, se3
from evermap.slam.changes.evidence import WindowEvidence
from evermap.slam.changes.explain import GivenMap
from evermap.slam.changes.gain import PLACES, POINTS
from evermap.slam.space.estimate import SpatialOptimum, as_seen, converge, with_worth
from evermap.slam.space.problem import ANY_RAD, LEAST_WEIGHT, SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.slam.space.range_errors import consider_range_errors, find_range_errors, shows_errors
from evermap.slam.space.smoother import SpatialSmoother
from evermap.types import BoolArray, FloatArray, IntArray

ROUNDS = 12
FARTHEST = 0.25
"""Squared distances, as a share of the largest one, of places that are let go together."""
SETTLED = 0.01
"""Change of all probabilities that ends it."""
SETTLED_ERROR = 0.05
"""Change of the errors that all ranges of a sensor have in common, in their standard deviations, that ends it."""
FACTORS, ALIKE = (1.0, 1.4, 2.0), (0.0, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8)
"""Factors on what a map states, and errors that all detections of a place have in common, over those of one."""
LOOSE = 1.0 / 20.0**2
"""Information of a session by itself in directions of which it says nothing [1/m^2, 1/rad^2]."""
LOG_2PI = math.log(2.0 * math.pi)
FEWEST = 3.0
"""Sightings from which a place may hold frames that nothing else ties."""
LEAST_INFORMATION = 1.0 / 25.0
"""Of a place by the others alone: it is somewhere within 5 m, or 5 rad."""


class MovedTogether(NamedTuple):
    """Places of a map that moved as one, before the session.

    Attributes:
        members: (k,) rows of the prior.
        turns: whether they also turned.
        motion: (6,) displacement of the centroid [m] and rotation vector [rad], in the axes of the map.
        probability: of this very group, over all sets of changes that were weighed.
    """

    members: IntArray
    turns: bool
    motion: FloatArray
    probability: float


class Accuracy(NamedTuple):
    """How far places that stand are from where the map has them.

    Attributes:
        factor: on the standard deviations that the map states.
        alike: errors that all detections of a place have in common, over those of one detection.
    """

    factor: float
    alike: float

    def between(self, other: Accuracy) -> Accuracy:
        """Return the accuracy halfway to another one."""
        return Accuracy(float(np.sqrt(self.factor * other.factor)), 0.5 * (self.alike + other.alike))


AS_STATED = Accuracy(1.0, 0.0)
"""That of a map that is as accurate as it says, by detections that err by themselves."""


@dataclass(frozen=True, slots=True)
class MapComparison:
    """Comparison of the map's places with those of the session.

    Attributes:
        p_stands: (K,) probability that each is where the map has it.
        off: (K, 6) twist from where the map has it to where it is, by the session and the other places.
        covariance: (K, 6, 6) of that.
        accuracy: how far places that stand are from there.
        groups: places that moved together, by the joint search.
        misread: (K,) log density of all detections of each being of something else.
    """

    p_stands: FloatArray
    off: FloatArray
    covariance: FloatArray
    accuracy: Accuracy
    groups: tuple[MovedTogether, ...] = ()
    misread: FloatArray = field(default_factory=lambda: np.zeros(0))


def compared(
    optimum: SpatialOptimum, stated: FloatArray, groups: tuple[MovedTogether, ...] = ()
) -> tuple[SpatialOptimum, MapComparison]:
    """Return the optimum with every place of the map weighted by the probability that it stands, and these.

    Args:
        optimum: of a problem with a prior map.
        stated: (K, 6) standard deviations of the map's places.
        groups: places that are known to have moved.
    """
    shared = measure_shared_errors(optimum, optimum.smoother.problem.prior.place)
    optimum, found = _settle_places(optimum, stated, shared, groups)
    return optimum, _with_groups(found, groups)


def compared_without_rare(
    begun: SpatialOptimum, best: tuple[SpatialOptimum, MapComparison], stated: FloatArray
) -> tuple[SpatialOptimum, MapComparison]:
    """Return what `compared` found, or what is better and begins without places that were hardly seen; and
    probabilities over both.

    Where nothing ties frames but what they see, a place that was seen once may hold those by which others stand.

    Args:
        begun: the optimum that was compared.
        best: what `compared` found.
        stated: (K, 6) standard deviations of the map's places.
    """
    problem, found = best[0].smoother.problem, best[1]
    hits = np.bincount(problem.place, best[0].now.weight, minlength=len(problem.oriented))[problem.prior.place]
    rare = (hits > 0.0) & (hits < FEWEST) & (found.p_stands >= 0.5)
    if problem.driven or not rare.any() or (found.p_stands >= 0.5).all():
        return best
    gone = found.p_stands < 0.5
    shared = measure_shared_errors(begun, begun.smoother.problem.prior.place)
    other = _settle_places(begun, stated, shared, found.groups, hold=~rare)
    if (other[1].p_stands[gone] >= 0.5).any():  # which they drove out
        other = _settle_places(other[0], stated, shared, found.groups)
    if not (other[1].p_stands[gone] >= 0.5).any():
        return best
    spread = square(np.maximum(stated, problem.settings.map.loose_m))
    costs = np.array([cost_in_map(one, spread, begun.noise) for one, _ in (best, other)])
    share = np.exp(costs.min() - costs)
    share /= share.sum()
    optimum, taken = (best, other)[int(np.argmin(costs))]
    p_stands = share @ np.array([found.p_stands, other[1].p_stands])
    return optimum, _with_groups(replace(taken, p_stands=p_stands), found.groups)


def _with_groups(found: MapComparison, groups: tuple[MovedTogether, ...]) -> MapComparison:
    """Return the comparison with places that are known to have moved."""
    p_stands = found.p_stands.copy()
    for group in groups:
        p_stands[group.members] = 1.0 - group.probability
    return replace(found, p_stands=p_stands, groups=groups)


def _settle_places(
    optimum: SpatialOptimum,
    stated: FloatArray,
    shared: FloatArray,
    groups: tuple[MovedTogether, ...],
    hold: BoolArray | None = None,
) -> tuple[SpatialOptimum, MapComparison]:
    """Return the optimum with every place of the map weighted by the probability that it stands, and these: in turns,
    each by the others. `hold` (K,) are those that may hold poses; all where None.
    """
    problem, begun = optimum.smoother.problem, optimum.noise

    def judge(found: MapComparison, accuracy: Accuracy) -> MapComparison:
        found = _judge_places(problem, found, accuracy.factor * stated, accuracy.alike**2 * shared)
        for group in groups:  # other sets of changes are worlds of their own, not this one with half a map
            found.p_stands[group.members] = 0.0
        return replace(found, accuracy=accuracy)

    found = judge(_predict_places(optimum), AS_STATED)
    best, tried, is_held = (optimum, found), list[Accuracy](), False
    for _ in range(ROUNDS):
        accuracy = tried[-1] if is_held else _accuracy(found, stated, shared, problem)
        if accuracy in tried[:-1] and accuracy != tried[-1]:  # each of two makes the other the more probable
            accuracy, is_held = accuracy.between(tried[-1]), True
        tried.append(accuracy)
        sigma = accuracy.factor * stated
        if shared.any():  # else the factor follows from what stands, and settles with it
            found = judge(found, accuracy)
        weight = _weigh_places(found, sigma, problem.prior.weight)
        let_go = weight < 0.5
        if hold is not None:
            weight[~hold], let_go[~hold] = LEAST_WEIGHT, False
        back = bool(np.any((weight >= 0.5) & (problem.prior.weight < 0.5)))
        held = bool(np.any((found.p_stands < 0.5) & (weight >= 0.5)))
        ignored = _find_ignored(optimum) & (weight >= 0.5)
        weight[ignored] = LEAST_WEIGHT
        problem = replace(problem, prior=replace(problem.prior, sigma=sigma, weight=weight))
        optimum = converge(problem, _place_as_seen(optimum, ignored), begun, heavy_rounds=int(back))
        error = find_range_errors(optimum)
        held |= bool(np.any(np.abs(error - problem.range_error) > SETTLED_ERROR))
        problem = problem.with_range_error(error)
        before, found = found, judge(_predict_places(optimum), accuracy)
        spread = square(sigma) + accuracy.alike**2 * shared
        now, was = (cost_in_map(one, spread, begun) for one in (optimum, best[0]))
        # places are judged by each other as they are: a few that are wrong may drive out many that are right; and of
        # places that are let go all is so uncertain that they seem to stand
        seems_to_stand = let_go & (found.p_stands >= 0.5)
        if not seems_to_stand.any() and now < was + problem.settings.repair.gain_nats:
            best = optimum, found
        decided = is_held and np.array_equal(found.p_stands < 0.5, before.p_stands < 0.5)
        if not held and (decided or np.abs(found.p_stands - before.p_stands).max(initial=0.0) < SETTLED):
            break
    return best


def _find_ignored(optimum: SpatialOptimum) -> BoolArray:
    """Return which places of the map (K,) are not where most of their detections see them: these are outliers there,
    and give no evidence on the place.
    """
    problem, place = optimum.smoother.problem, optimum.smoother.problem.prior.place
    count = np.bincount(problem.place, minlength=len(problem.oriented))[place]
    used = np.bincount(problem.place, optimum.now.weight, minlength=len(problem.oriented))[place]
    return np.asarray((count >= FEWEST) & (used < 0.5 * count))


def _place_as_seen(optimum: SpatialOptimum, some: BoolArray) -> SpatialEstimate:
    """Return the values with places of the map, `some` (K,), in the middle of where their detections see them."""
    problem, estimate = optimum.smoother.problem, optimum.estimate
    if not some.any():
        return estimate
    seen, place = as_seen(problem, estimate, problem.measured), estimate.place.copy()
    for row in problem.prior.place[some].tolist():
        mine = seen[problem.place == row]
        middle = np.median(mine[:, :3], axis=0)
        numbers = slice(None) if problem.oriented[row] else slice(3)
        place[row, numbers] = mine[int(np.argmin(np.linalg.norm(mine[:, :3] - middle, axis=1))), numbers]
    return replace(estimate, place=place)


def has_contradictions(optimum: SpatialOptimum) -> bool:
    """Tell whether any place of the map seems to be elsewhere."""
    problem = optimum.smoother.problem
    shared = np.zeros((len(problem.prior.place), 6, 6))
    return bool((_judge_places(problem, _predict_places(optimum), problem.prior.sigma, shared).p_stands < 0.5).any())


def _weigh_places(found: MapComparison, sigma: FloatArray, before: FloatArray) -> FloatArray:
    """Return (K,) weights of the map's places: the farthest moved ones, which may distort others, go first."""
    spread = found.covariance + square(sigma)
    far = np.einsum("ki,kij,kj->k", found.off, np.linalg.inv(spread), found.off)
    moved = (found.p_stands < 0.5) & (before >= 0.5)
    waits = moved & (far < FARTHEST * far[moved].max(initial=0.0))
    return np.where(waits, before, np.maximum(found.p_stands, LEAST_WEIGHT))


def measure_shared_errors(optimum: SpatialOptimum, places: IntArray) -> FloatArray:
    """Return the covariances (K, 6, 6) of errors that all detections of a place have in common, if these are as large
    as those of one detection. With odometry, what lasts is part of what detections are worth.

    Args:
        optimum: the solution.
        places: (K,) rows of the places.
    """
    problem, now = optimum.smoother.problem, optimum.now
    found = np.zeros((len(places), 6, 6))
    if not shows_errors(problem):
        return found
    count = np.bincount(problem.place, now.weight * problem.share, minlength=len(problem.oriented))
    information = optimum.smoother.information_of_places(now)
    for k, place in enumerate(places.tolist()):
        own = information[place] / max(count[place], 1e-9)
        found[k, : len(own), : len(own)] = np.linalg.inv(own + LEAST_INFORMATION * np.eye(len(own)))
    return found


def _predict_places(optimum: SpatialOptimum) -> MapComparison:
    """Predict every place of the map from the others and the session; none is judged yet."""
    problem, prior = optimum.smoother.problem, optimum.smoother.problem.prior
    optimum = with_worth(optimum)
    spread = optimum.smoother.spread(optimum.now)
    misread = _log_misread(optimum)
    count, n = len(prior.place), len(problem.stamp_s)
    off, covariance = np.zeros((count, 6)), np.zeros((count, 6, 6))
    for k, place in enumerate(prior.place):
        own_place = optimum.estimate.place[place][None]
        mean = problem.off_map(np.array([k]), own_place, oriented=bool(problem.oriented[place]))[0]
        dim = len(mean)
        own = np.linalg.inv(spread.of(n + np.array([place]), dim)[0])
        # the map's own information on it is removed; the rest may be weak, but is positive
        values, vectors = np.linalg.eigh(own - np.diag(prior.weight[k] / prior.sigma[k, :dim] ** 2))
        alone = np.linalg.inv((vectors * np.maximum(values, LEAST_INFORMATION)) @ vectors.T)
        off[k, :dim], covariance[k, :dim, :dim] = alone @ (own @ mean), alone
    return MapComparison(np.ones(count), off, covariance, AS_STATED, misread=misread[prior.place])


def _judge_places(
    problem: SpatialProblem, found: MapComparison, sigma: FloatArray, shared: FloatArray
) -> MapComparison:
    """Return predicted places with the probabilities that they stand.

    Args:
        problem: with a prior map.
        found: the predictions.
        sigma: (K, 6) standard deviations of the map's places.
        shared: (K, 6, 6) covariances of errors that all detections of a place have in common.
    """
    settings, p_stands = problem.settings.map, np.ones(len(found.off))
    for k, dim in enumerate(np.where(problem.oriented[problem.prior.place], 6, 3).tolist()):
        mean, alone = found.off[k, :dim], found.covariance[k, :dim, :dim]
        wide = np.asarray(alone + np.diag(sigma[k, :dim] ** 2) + shared[k, :dim, :dim], dtype=np.float64)
        p_stands[k] = find_p_stands(mean, wide, settings, found.misread[k])
    return replace(found, p_stands=p_stands)


def find_p_stands(
    off: FloatArray, covariance: FloatArray, settings: MapInSpaceConfig, log_misread: float = -np.inf
) -> float:
    """Return the probability that a place stands which is `off` (D,) by a covariance (D, D), over that it moved.

    Args:
        off: how far it is from where it was [m], and by which rotation vector it is turned [rad].
        covariance: of that.
        settings: how far things move, and how often.
        log_misread: log density of all of its detections being of something else, as of `_log_density`.
    """
    stands, moved = np.logaddexp(_log_density(off, covariance), log_misread), _log_moved(off, covariance, settings)
    odds = moved - stands + np.log(settings.p_moved / (1.0 - settings.p_moved))
    return float(1.0 / (1.0 + np.exp(np.clip(odds, -500.0, 500.0))))


def square(sigma: FloatArray) -> FloatArray:
    """Return the covariances (K, D, D) of independent numbers with standard deviations (K, D)."""
    return np.asarray(sigma[..., None] ** 2 * np.eye(sigma.shape[-1]))


def cost_in_map(optimum: SpatialOptimum, spread: FloatArray, noise: SpatialNoise) -> float:
    """Return the negative log posterior with places of the map that stand or moved, up to a constant.

    Args:
        optimum: values.
        spread: (K, 6, 6) covariances of how far places that stand are from where the map has them.
        noise: levels, the same for all that are compared.
    """
    problem, place = optimum.smoother.problem, optimum.estimate.place
    settings, prior = problem.settings.map, problem.prior
    nothing = replace(problem, prior=replace(prior, weight=np.zeros(len(prior.place))))
    cost = SpatialSmoother(nothing, optimum.estimate.pose).linearised(optimum.estimate, noise, heavy=False).cost
    seen = np.bincount(problem.place, minlength=len(place))[prior.place] > 0
    for k in np.flatnonzero(seen).tolist():
        row = int(prior.place[k])
        off = problem.off_map(np.array([k]), place[row][None], oriented=bool(problem.oriented[row]))[0]
        wide = spread[k, : len(off), : len(off)]
        stands, moved = _log_density(off, wide), _log_moved(off, wide, settings)
        cost -= float(np.logaddexp(np.log1p(-settings.p_moved) + stands, np.log(settings.p_moved) + moved))
    return cost


def _log_moved(off: FloatArray, covariance: FloatArray, settings: MapInSpaceConfig) -> FloatArray:
    """Return (...,) log densities of a place that moved by any of the usual distances and turns; as `_log_density`."""
    dim = len(off)
    scales = [(m, rad) for m in settings.moved_m for rad in settings.moved_rad[: None if dim == 6 else 1]]
    wide = np.array([np.diag(np.array([m] * 3 + [rad] * (dim - 3)) ** 2) for m, rad in scales])
    density = _log_density(off, covariance[..., None, :, :] + wide)
    return np.asarray(np.logaddexp.reduce(density, axis=-1) - np.log(len(scales)))


def _log_misread(optimum: SpatialOptimum) -> FloatArray:
    """Return (P,) log densities, as of `_log_density`, of all inliers of a place being of something else.

    That is what outliers cost, over the density that the sightings have at the place where they agree. It is for places
    that were seen once or twice: many wrong identities don't agree on a place.
    """
    problem, now = optimum.smoother.problem, optimum.now
    log_odds = problem.sightings.log_odds[problem.kind]
    price = np.bincount(problem.place, now.weight * log_odds, minlength=len(problem.oriented))
    peak = np.array([np.linalg.slogdet(one)[1] for one in optimum.smoother.information_of_places(now)])
    return np.asarray(0.5 * peak - price)


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
        tree = optimum.smoother.structure.system.tree
        of_ranges = consider_range_errors(optimum)[numbers_of(tree.begin[n + seen], tree.dim[n + seen])]
        covariance[np.ix_(rows, rows)] = onto @ (joint + of_ranges @ of_ranges.T) @ onto.T
        return Alone(shift, covariance, rotation)
    values, vectors, pull = _without_map(optimum, joint, seen, first)
    told = values > LOOSE
    shift[seen] = (onto @ vectors[:, told] @ ((vectors[:, told].T @ pull) / values[told])).reshape(-1, 3)
    root = onto @ (vectors / np.sqrt(np.maximum(values, LOOSE)))
    covariance[np.ix_(rows, rows)] = root @ root.T
    return Alone(shift, covariance, rotation)


def _without_map(
    optimum: SpatialOptimum, joint: FloatArray, seen: IntArray, first: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return eigenvalues (n,) and vectors (n, n) of the information on places without what the map says, and the pull
    (n,) of the session at the optimum, where the map's holds it in balance.

    Args:
        optimum: with a map.
        joint: (n, n) covariance of the places with the map.
        seen: (S,) rows of these places.
        first: (P,) where the numbers of each begin.
    """
    problem, place = optimum.smoother.problem, optimum.estimate.place
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
    return values, vectors, pull


class AgainstMap(NamedTuple):
    """What a session says of the places of a map, for the joint search.

    Attributes:
        row: (S,) rows of the prior that were seen.
        evidence: of these, in numbers of their own: the position, and with orientations the rotation vector from where
            the map has it, in the axes of the map.
        given: the map in the same numbers.
    """

    row: IntArray
    evidence: WindowEvidence
    given: GivenMap


def evidence_against(optimum: SpatialOptimum, stated: FloatArray) -> AgainstMap:
    """Return what a session says of the places of the map, linearised where a loosened map holds it.

    Args:
        optimum: at which no place is bent by the map.
        stated: (K, 6) standard deviations of the map's places.
    """
    problem, prior, n = optimum.smoother.problem, optimum.smoother.problem.prior, len(optimum.smoother.problem.stamp_s)
    hits = np.bincount(problem.place, optimum.now.weight, minlength=len(problem.oriented))
    row = np.flatnonzero(hits[prior.place] > problem.settings.map.least_seen)
    seen, turned = prior.place[row], problem.oriented[prior.place[row]]
    place, numbers = optimum.estimate.place[seen], PLACES if turned.any() else POINTS
    dim = np.where(turned, 6, 3)
    begin = np.append(0, np.cumsum(dim))
    first = np.full(len(problem.oriented), -1, dtype=np.int64)
    first[seen] = begin[:-1]
    joint = optimum.smoother.factorised(optimum.now).joint(n + seen)
    values, vectors, pull = _without_map(optimum, joint, seen, first)
    known = problem.symmetries[seen].nearest(prior.pose[row], place)
    unknown = turned & (stated[row, 3:] >= ANY_RAD).all(axis=1)
    known[unknown, 3:] = place[unknown, 3:]  # of which the map says nothing
    some = vectors[:, values > LOOSE]
    position, told = np.zeros((len(row), numbers)), np.zeros((numbers * len(row), some.shape[1]))
    mean, covariance = np.zeros((len(row), numbers)), np.tile(np.eye(numbers), (len(row), 1, 1))
    position[:, :3], mean[:, :3] = place[:, :3], known[:, :3]
    for k, oriented in enumerate(turned.tolist()):
        at, own, to = numbers * k, int(begin[k]), se3.rotation_of(place[k]) if oriented else np.eye(3)
        told[at : at + 3] = to @ some[own : own + 3]  # forces turn as shifts do
        covariance[k, :3, :3] = np.diag(stated[row[k], :3] ** 2)
        if oriented:
            twist = se3.log(se3.compose(place[k], se3.inverse(known[k]))) * np.repeat([0.0, 1.0], 3)
            position[k, 3:] = twist[3:]
            jacobian = se3.right_jacobian_inverse(twist)[3:, 3:].T @ to  # from a turn in its own axes
            told[at + 3 : at + 6] = np.linalg.inv(jacobian).T @ some[own + 3 : own + 6]
            axes = se3.rotation_of(known[k])
            covariance[k, 3:, 3:] = (axes * stated[row[k], 3:] ** 2) @ axes.T
    evidence = WindowEvidence(
        landmark=np.arange(len(row)),
        window=np.zeros(len(row), dtype=np.int64),
        position=position,
        information=(told * values[values > LOOSE]) @ told.T,
        pull=told @ (some.T @ pull),
        log_scale_sigma=0.0,
    )
    return AgainstMap(row, evidence, GivenMap(mean, covariance, np.ones(len(row), dtype=np.bool_)))


def _log_density(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return (...,) log densities, but for a constant, of an offset (D,) under covariances (..., D, D)."""
    root = np.linalg.cholesky(covariance)
    apart = np.linalg.solve(root, np.broadcast_to(off[:, None], (*root.shape[:-1], 1)))[..., 0]
    return np.asarray(-0.5 * np.sum(apart**2, axis=-1) - np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1))


def _accuracy(found: MapComparison, stated: FloatArray, shared: FloatArray, problem: SpatialProblem) -> Accuracy:
    """Return what fits the unmoved places, with a weak prior at what is stated."""
    if not shared.any():
        return Accuracy(_factor(found, stated, problem), 0.0)
    settings, dims = problem.settings.map, np.where(problem.oriented[problem.prior.place], 6, 3)
    factor, alike = (each.ravel() for each in np.meshgrid(FACTORS, ALIKE, indexing="ij"))
    score = -0.5 * settings.pseudo_count * (2.0 * np.log(factor) + factor**-2) - np.log1p(alike**2)
    for k, dim in enumerate(dims.tolist()):
        off, own, said = found.off[k, :dim], found.covariance[k, :dim, :dim], np.diag(stated[k, :dim] ** 2)
        wide = own + factor[:, None, None] ** 2 * said + alike[:, None, None] ** 2 * shared[k, :dim, :dim]
        stands = np.logaddexp(_log_density(off, wide), found.misread[k]) + np.log1p(-settings.p_moved)
        score += np.logaddexp(stands, _log_moved(off, wide, settings) + np.log(settings.p_moved))
    best = int(np.argmax(score))
    return Accuracy(float(factor[best]), float(alike[best]))


def _factor(found: MapComparison, stated: FloatArray, problem: SpatialProblem) -> float:
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


def log_map_density(problem: SpatialProblem, compared: MapComparison | None, place: FloatArray) -> tuple[float, float]:
    """Return the log density of what a map says at its best, with the cost of places that do not stand put right, and
    the log prior probability of those.
    """
    prior, settings = problem.prior, problem.settings.map
    density = prices = 0.0
    groups = () if compared is None else compared.groups
    grouped = {int(row): k for k, group in enumerate(groups) for row in group.members}
    met: set[int] = set()
    for k, row in enumerate(prior.place.tolist()):
        dim = 6 if problem.oriented[row] else 3
        told = prior.sigma[k, :dim] < ANY_RAD
        off = problem.off_map(np.array([k]), place[row][None], oriented=dim == 6)[0]
        log_sigma = np.log(prior.sigma[k, :dim])
        if prior.weight[k] >= problem.settings.inlier:
            density -= float(log_sigma.sum()) + 0.5 * dim * LOG_2PI
            density += 0.5 * (prior.weight[k] - 1.0) * float(np.sum((off / prior.sigma[k, :dim]) ** 2))
            prices += math.log1p(-settings.p_moved)
            continue
        density += 0.5 * prior.weight[k] * float(np.sum((off / prior.sigma[k, :dim]) ** 2))
        group = grouped.get(k)
        if group is not None and group in met:  # it went along: at its place in the group
            density -= float(log_sigma.sum()) + 0.5 * dim * LOG_2PI
            prices -= math.log(2.0)
            continue
        if group is not None:
            met.add(group)
        prices += math.log(settings.p_moved)
        scales = [(m, rad) for m in settings.moved_m for rad in settings.moved_rad[: None if dim == 6 else 1]]
        wide = []
        for m, rad in scales:
            spread = np.where(told, np.hypot(prior.sigma[k, :dim], np.array([m] * 3 + [rad] * (dim - 3))), ANY_RAD)
            wide.append(-float(np.log(spread).sum() + 0.5 * np.sum((off / spread) ** 2)) - 0.5 * dim * LOG_2PI)
        density += float(np.logaddexp.reduce(wide)) - math.log(len(scales))
    return density, prices
