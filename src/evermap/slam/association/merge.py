"""Landmarks that are one: met again after a blind stretch or a loop, when the gate was too wide to say so at once.

A landmark in doubt was started anew. Later the map knows how well its landmarks are placed against each other, the
poses between them eliminated, and several of them together (a constellation) fit the old ones in one way only. Pairs
are proposed by joint compatibility of their differences and accepted if the cost of the whole problem agrees.
"""

from __future__ import annotations

import numpy as np

from evermap.slam.association.assignment import Assignment
from evermap.slam.association.constellation import LocalMap, agreed_pairs
from evermap.slam.association.jcbb import Pairings, gates, pairing_probability
from evermap.slam.problem import Estimate, Marginals
from evermap.types import FloatArray, IntArray

MAX_SOURCES = 8
"""Landmarks that are looked up in the rest of the map at the same time."""
MIN_SIGHTINGS = 2
CONFIDENCE = 0.999
"""Of the gates: a pair that fails is never the same landmark."""
LOOSE_GATE = 60.0
"""Squared distance up to which a pair may be meant at all, though the linearisation is far off."""
STIFF_M = 0.2
"""Landmarks belong to one stiff part if they are known against each other to this."""
RISE_NATS = 100.0
"""By how much the cost may rise for every pair that is merged. Errors of sightings from one place are alike, which the
cost does not know: it rises by some tens for one landmark, by hundreds for two."""


def propose_merges(
    assignment: Assignment, marginals: Marginals, *, density: float, probability: float
) -> list[tuple[int, int]]:
    """Pairs (younger, older) of landmarks that are one with at least `probability`, given all other such pairs.

    Args:
        assignment: at its optimum.
        marginals: covariances at it.
        density: landmarks a square metre that one expects.
        probability: least posterior probability.
    """
    candidates = pairs_in_reach(assignment, marginals)
    sightings = assignment.sightings
    merges: list[tuple[int, int]] = []
    # the landmarks with most sightings are the best placed
    sources = sorted({u for u, _ in candidates}, key=lambda u: (-sightings[u], u))
    for begin in range(0, len(sources), MAX_SOURCES):
        some = sorted(sources[begin : begin + MAX_SOURCES])
        pairs = [(u, o) for u, o in candidates if u in some]
        pairings = differences(assignment.estimate, marginals, pairs, density)
        weights, complete = pairing_probability(pairings, confidence=CONFIDENCE)
        if complete:
            merges += [pairs[k] for k in np.flatnonzero(weights >= probability)]
    return merges


def propose_constellation(
    assignment: Assignment,
    marginals: Marginals,
    *,
    density: float,
    probability: float,
    refused: set[tuple[int, int]],
) -> list[tuple[int, int]]:
    """Pairs (younger, older) by which a part of the map that is loose lies on the rest in one way only."""
    joint, place = marginals.shared, assignment.estimate.landmark
    apart, sightings = assignment.apart, assignment.sightings
    root, loose = stiff_and_loose(assignment, marginals)
    if len(loose) < 2:
        return []
    loose = loose[np.argsort(-sightings[loose], kind="stable")]
    allowed = ~apart[np.ix_(loose, root)]
    for k, m in np.argwhere(allowed):
        pair = _ordered(loose[k], root[m])
        spread = _spread(joint, *pair)
        gap = place[pair[0]] - place[pair[1]]
        allowed[k, m] = pair not in refused and gap @ np.linalg.solve(spread, gap) < LOOSE_GATE
    source, target = _local(place, joint, loose), _local(place, joint, root)
    pairs = agreed_pairs(source, target, allowed, density=density, probability=probability)
    return [_ordered(loose[k], root[m]) for k, m in pairs]


def stiff_and_loose(assignment: Assignment, marginals: Marginals) -> tuple[IntArray, IntArray]:
    """Landmarks that hang together with the oldest, each well known against the next; and all others."""
    joint = marginals.shared
    seen = np.flatnonzero(assignment.sightings >= MIN_SIGHTINGS)
    within = np.array(
        [[np.linalg.norm(_spread(joint, u, o), 2) < STIFF_M**2 for o in seen.tolist()] for u in seen.tolist()]
    )
    reached = np.zeros(len(seen), dtype=bool)
    reached[:1] = True
    while len(seen):
        further = within[reached].any(axis=0) | reached
        if further.sum() == reached.sum():
            break
        reached = further
    return seen[reached], seen[~reached]


def _ordered(u: int, o: int) -> tuple[int, int]:
    """(younger, older)."""
    return int(max(u, o)), int(min(u, o))


def _local(place: FloatArray, joint: FloatArray, rows: IntArray) -> LocalMap:
    columns = np.column_stack([2 * rows, 2 * rows + 1]).ravel()
    return LocalMap(place[rows], joint[np.ix_(columns, columns)])


def _spread(joint: FloatArray, u: int, o: int) -> FloatArray:
    """(2, 2) covariance of the difference of two landmarks."""
    a, b = slice(2 * u, 2 * u + 2), slice(2 * o, 2 * o + 2)
    cross = joint[a, b]
    spread: FloatArray = joint[a, a] + joint[b, b] - cross - cross.T
    return spread


def pairs_in_reach(assignment: Assignment, marginals: Marginals) -> list[tuple[int, int]]:
    """Pairs (younger, older) whose difference is insignificant by itself, sorted."""
    joint, gate = marginals.shared, gates(1, CONFIDENCE)[1]
    estimate, sightings, apart = assignment.estimate, assignment.sightings, assignment.apart
    found = []
    for u in range(len(sightings)):
        for o in range(u):
            if apart[u, o] or min(sightings[u], sightings[o]) < MIN_SIGHTINGS:
                continue
            gap = estimate.landmark[u] - estimate.landmark[o]
            spread = _spread(joint, u, o)
            if gap @ np.linalg.solve(spread, gap) < gate:
                found.append((u, o))
    return found


def differences(estimate: Estimate, marginals: Marginals, pairs: list[tuple[int, int]], density: float) -> Pairings:
    """Pairs (younger, older), sorted, as pairings whose innovation is their difference."""
    n = len(pairs)
    select = np.zeros((2 * n, len(marginals.shared)))
    for k, (u, o) in enumerate(pairs):
        select[2 * k : 2 * k + 2, 2 * u : 2 * u + 2] = np.eye(2)
        select[2 * k : 2 * k + 2, 2 * o : 2 * o + 2] = -np.eye(2)
    younger = np.array([u for u, _ in pairs], dtype=np.int64)
    older = np.array([o for _, o in pairs], dtype=np.int64)
    sources, source = np.unique(younger, return_inverse=True)
    return Pairings(
        source.astype(np.int64),
        older,
        estimate.landmark[younger] - estimate.landmark[older],
        select @ marginals.shared @ select.T,
        np.full(n, np.log(density)),
        len(sources),
    )
