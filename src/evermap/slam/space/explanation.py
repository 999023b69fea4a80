"""What the places of a solved session are: landmarks that stand, moved, or share an identity; alone and in a map.

First without a landmark that moved while the robot drove. Where that leaves a symptom, one such landmark is added as
long as everything is more probable with it, all else being decided anew (`moved_within`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from evermap.config import ChangesConfig
from evermap.geometry import se3
from evermap.slam.correlation import Lasting
from evermap.slam.space.against_map import (
    MapComparison,
    MovedTogether,
    compared,
    compared_without_rare,
    find_p_stands,
    log_map_density,
    measure_shared_errors,
)
from evermap.slam.space.estimate import SpatialOptimum, converge, with_worth
from evermap.slam.space.marginal import log_marginal_likelihood
from evermap.slam.space.moved_groups import find_moved_groups
from evermap.slam.space.moved_within import ROUNDS, MovedWithin, find_two_places, list_movers
from evermap.slam.space.problem import SpatialNoise
from evermap.slam.space.repair import rejoined, repaired, split, undo_jumps
from evermap.types import BoolArray, FloatArray, IntArray

SPLITS = 2
"""Times that landmarks are split."""
STANDS, MOST_OFF_MAP = 0.5, 0.5
"""Probability that a place of a map stands, and share of those that do not, from which the map is in doubt."""
MOST_PLACES = 2
"""Places of one landmark that a move explains."""


@dataclass(frozen=True, slots=True)
class SpatialExplanation:
    """What the places of a session are.

    Attributes:
        optimum: the solution under it.
        identity: (P,) rows of landmarks that the places are of.
        moves: landmarks that moved during the session.
        from_map: what of the given map stands; None without a map.
        begun: the solution before places of the map were compared.
    """

    optimum: SpatialOptimum
    identity: IntArray
    moves: tuple[MovedWithin, ...]
    from_map: MapComparison | None
    begun: SpatialOptimum


def explain_places(
    optimum: SpatialOptimum, identity: IntArray, whole: BoolArray, stated: FloatArray, changes: ChangesConfig | None
) -> SpatialExplanation:
    """Return the most probable explanation of the places of a session.

    Args:
        optimum: one place for each landmark, in its row, and more for those that are on bodies that moved.
        identity: (P,) rows of landmarks that the places are of.
        whole: (L,) landmarks that were followed, and are one each.
        stated: (K, 6) standard deviations of the places of a map; none without.
        changes: settings of the search for landmarks of the map that moved together; None asks each by itself.
    """
    begun, of_bodies = optimum, len(identity)
    found = _explain_with(begun, identity, (), whole, stated, changes, of_bodies)
    asked, interval = ~whole, (changes or ChangesConfig()).interval
    gain_nats, single = optimum.smoother.problem.settings.repair.gain_nats, frozenset[int]()
    for _ in range(ROUNDS):
        if _contradicts_map(found):
            break
        suspects = list_movers(found.optimum, found.identity, asked, _off_map(found))
        two, single = find_two_places(begun, suspects, interval, single)
        if two is None:
            break
        landmark, larger = int(identity[two.before]), np.append(identity, identity[two.before])
        asked = asked & (np.arange(len(asked)) != landmark)
        is_one = two.nats > gain_nats  # else there are two with one identity
        move = MovedWithin(two.before, two.after, two.since_s, two.between_s, 1.0)
        trial = _explain_with(
            two.optimum, larger, (*found.moves, move) if is_one else found.moves, whole, stated, changes, of_bodies
        )
        if (
            np.count_nonzero(_find_seen_places(trial) & (trial.identity == landmark)) > MOST_PLACES
        ):  # seen there in turns
            continue
        lasting = trial.optimum.smoother.lasting(trial.optimum.now)
        after, before = (_log_evidence(one, found.optimum.noise, lasting) for one in (trial, found))
        nats = after - before + (two.nats if is_one else 0.0)
        if nats > gain_nats:
            if is_one:
                probability = 1.0 / (1.0 + math.exp(-min(nats, two.nats)))
                trial = replace(trial, moves=(*found.moves, move._replace(probability=probability)))
            found, begun, identity, single = trial, two.optimum, larger, frozenset()
    alike = 0.0 if found.from_map is None else found.from_map.accuracy.alike
    p_moved = [find_p_apart(found.optimum, move, alike) for move in found.moves]
    told = [p >= begun.smoother.problem.settings.map.p_told for p in p_moved]
    moves = tuple(
        move._replace(probability=min(move.probability, p))
        for move, p, is_told in zip(found.moves, p_moved, told, strict=True)
        if is_told
    )
    if all(told):
        found = replace(found, moves=moves)
    else:
        found = _explain_with(found.optimum, found.identity, moves, whole, stated, changes, of_bodies)
    if found.from_map is None:
        return found
    optimum, from_map = compared_without_rare(found.begun, (found.optimum, found.from_map), stated)
    return replace(found, optimum=optimum, from_map=from_map)


def find_p_apart(optimum: SpatialOptimum, move: MovedWithin, alike: float = 0.0) -> float:
    """Return the probability that the two places of a landmark are still apart, with all that was found after it.

    What moved first bends the poses beside it, until all of it is found: what stands there seems to have moved, too.
    Both places are as uncertain as detections of a view that err alike leave them: else what stands has moved wherever
    it is seen from two sides.

    Args:
        optimum: with both places.
        move: from one to the other.
        alike: errors that all detections of a place have in common, over those of one (`Accuracy`).
    """
    optimum = with_worth(optimum)
    problem, both = optimum.smoother.problem, np.array([move.before, move.after])
    before, after = optimum.estimate.place[both[:, None]]
    off = (after - before)[0, :3]
    if problem.oriented[move.after]:
        off = se3.local(problem.symmetries[both[:1]].nearest(before, after), after)[0]
    dim = len(off)
    spread = optimum.smoother.spread(optimum.now).of(len(problem.stamp_s) + both, dim).sum(axis=0)
    spread += alike**2 * measure_shared_errors(optimum, both)[:, :dim, :dim].sum(axis=0)
    return 1.0 - find_p_stands(off, spread, problem.settings.map)


def _explain_with(
    optimum: SpatialOptimum,
    identity: IntArray,
    moves: tuple[MovedWithin, ...],
    whole: BoolArray,
    stated: FloatArray,
    changes: ChangesConfig | None,
    given: int,
) -> SpatialExplanation:
    """The explanation with these moves: what moved before the session, and identities of several landmarks. The first
    `given` places are what they are.
    """
    problem = optimum.smoother.problem
    if problem.driven and len(problem.prior.place):
        optimum = undo_jumps(optimum)
    for _ in range(SPLITS):
        parts = split(optimum, identity, whole)
        if parts is None:
            break
        problem, estimate, identity = parts
        optimum = repaired(converge(problem, estimate, optimum.noise, heavy_rounds=0))
    apart = np.isin(np.arange(len(identity)), [row for move in moves for row in (move.before, move.after)])
    apart[:given] = True
    if (together := rejoined(optimum, identity, apart)) is not None:
        optimum = converge(*together, optimum.noise, heavy_rounds=0)
    if not len(stated):
        return SpatialExplanation(optimum, identity, moves, None, optimum)
    groups: tuple[MovedTogether, ...] = ()
    if changes is not None:
        optimum, groups = find_moved_groups(optimum, stated, changes)
    compared_optimum, from_map = compared(optimum, stated, groups)
    return SpatialExplanation(compared_optimum, identity, moves, from_map, optimum)


def _log_evidence(explanation: SpatialExplanation, begun: SpatialNoise, lasting: Lasting) -> float:
    """The log evidence of an explanation, up to a constant of the measurements.

    Args:
        explanation: the explanation.
        begun: noise by which outliers are compared.
        lasting: how long errors of detections last.
    """
    optimum, identity = explanation.optimum, explanation.identity
    problem, seen = optimum.smoother.problem, _find_seen_places(explanation)
    found = log_marginal_likelihood(optimum, begun, lasting, of_places=True)
    if len(problem.prior.place):
        found += sum(log_map_density(problem, explanation.from_map, optimum.estimate.place))
    twice = np.count_nonzero(seen) - len(np.unique(identity[seen]))
    return found + twice * math.log(problem.settings.map.p_moved)


def _contradicts_map(explanation: SpatialExplanation) -> bool:
    """Return whether most of a map is not where it should be: then it is the map that is in doubt, and a landmark that
    moved while the robot drove can't be told from one that the map has elsewhere.
    """
    found = explanation.from_map
    return found is not None and bool(len(found.p_stands)) and float(np.mean(found.p_stands < STANDS)) > MOST_OFF_MAP


def _off_map(explanation: SpatialExplanation) -> IntArray:
    """Rows of landmarks that are not where the map has them."""
    if explanation.from_map is None:
        return np.zeros(0, dtype=np.int64)
    problem = explanation.optimum.smoother.problem
    return problem.prior.place[explanation.from_map.p_stands < 1.0 - problem.settings.map.p_told]


def _find_seen_places(explanation: SpatialExplanation) -> BoolArray:
    """(P,) places of which there are detections."""
    return np.bincount(explanation.optimum.smoother.problem.place, minlength=len(explanation.identity)) > 0
