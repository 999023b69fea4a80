"""One map laid over another by its shape: which landmarks of a local map are which of a larger one.

After a long blind stretch, or in a given map, the local map may be turned far beyond what a linear gate can follow. Two
of its landmarks with the right distance from each other fix a motion; around every such motion the difference of the
maps is linear again, and joint compatibility tells how many landmarks agree. Motions are weighed by the evidence of
what they explain, so that a chance agreement of two does not beat the right one of five.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.slam.association.assignment import FEWEST_TO_PAIR, Assignment, alike, same_name
from evermap.slam.association.features import MISREAD_NATS
from evermap.slam.association.jcbb import CONFIDENCE, LOOSE_GATE, Pairings, most_pairings
from evermap.types import BoolArray, FloatArray, IntArray

MIN_SPAN_M = 0.5
"""Two landmarks fix a motion if they are this far apart."""
MAX_SEEDS = 12
"""Landmarks of the local map that seeds are made of, the best known."""
MAX_MOTIONS = 20
"""Motions, those under which most landmarks come near one of the map, that are weighed exactly."""
NEAR_M = 0.5
CERTAIN_NATS = 7.0
"""By how much an overlay must beat 'all new' and its best rival: 1000 to 1."""
MOTION_SIGMA = np.array([5.0, 5.0, 2.0])
"""Prior of the motion around a seed [m, m, rad]: as good as none."""
SPAN_SLACK_M = 0.2
"""Distances within both maps are compared to this, beside what is unknown of them."""


@dataclass(frozen=True, slots=True)
class LocalMap:
    """Landmarks and how well they are known: place (n, 2), covariance (2 n, 2 n)."""

    place: FloatArray
    covariance: FloatArray

    def part(self, rows: IntArray) -> LocalMap:
        """Return some of the landmarks, in that order."""
        at = se2.xy_rows(rows)
        return LocalMap(self.place[rows], self.covariance[np.ix_(at, at)])

    @property
    def beside_m(self) -> float:
        """Standard deviation of a landmark beside its neighbours [m]: of the differences to the nearest."""
        n = len(self.place)
        near: IntArray = np.asarray(KDTree(self.place).query(self.place, k=2)[1])[:, 1]
        by = np.zeros((2 * n, 2 * n))
        for k in range(n):
            by[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = np.eye(2)
            by[2 * k : 2 * k + 2, 2 * near[k] : 2 * near[k] + 2] = -np.eye(2)
        spread = np.diag(by @ self.covariance @ by.T).reshape(n, 2).sum(axis=1)
        return math.sqrt(0.5 * max(float(np.median(spread)), 0.0))


@dataclass(frozen=True, slots=True)
class Alignment:
    """A motion and what it explains.

    Attributes:
        motion: (3,) from the source's frame to the target's.
        pairs: (source, target) of landmarks that agree.
        log_evidence: of the pairs being the same, over being different.
    """

    motion: FloatArray
    pairs: tuple[tuple[int, int], ...]
    log_evidence: float


def overlays(
    source: LocalMap,
    target: LocalMap,
    allowed: BoolArray,
    *,
    density: float,
    motions: Sequence[FloatArray] | None = None,
) -> list[Alignment]:
    """Return ways to lay `source` over `target`, the one with most evidence first; each set of pairs once.

    Args:
        source: the local map, its landmarks in order of trust.
        target: the map.
        allowed: (n, m) which pairs may be the same at all.
        density: landmarks a square metre that one expects where they are not the same.
        motions: those that are weighed; None tries all pairs.
    """
    found: dict[tuple[tuple[int, int], ...], Alignment] = {}
    for motion in _motions(source, target, allowed) if motions is None else motions:
        overlay = _weighed(motion, source, target, allowed, density)
        known = found.get(overlay.pairs)
        if known is None or known.log_evidence < overlay.log_evidence:
            found[overlay.pairs] = overlay
    return sorted(found.values(), key=lambda overlay: -overlay.log_evidence)


def agreed_pairs(
    source: LocalMap,
    target: LocalMap,
    allowed: BoolArray,
    *,
    density: float,
    probability: float,
    motions: Sequence[FloatArray] | None = None,
    least_nats: float = CERTAIN_NATS,
    lead_nats: float = CERTAIN_NATS,
) -> list[tuple[int, int]]:
    """Return pairs (source, target) that are certain: of an overlay far better than any other, without doubt in it.

    Empty where the maps can be laid over each other in several ways, or in none.

    Args:
        source: the local map, its landmarks in order of trust.
        target: the map.
        allowed: (n, m) which pairs may be the same at all.
        density: landmarks a square metre that one expects where they are not the same.
        probability: least probability of a pair beside all overlays that differ in it alone.
        motions: those that are weighed; None tries all pairs.
        least_nats: evidence of an overlay, over 'all new', from which it may be meant at all.
        lead_nats: by how much it must beat its best rival.
    """
    every = overlays(source, target, allowed, density=density, motions=motions)
    found = [overlay for overlay in every if len(overlay.pairs) > 1]
    if not found or found[0].log_evidence < least_nats:
        return []
    best = found[0]
    rivals = [other for other in found[1:] if not set(other.pairs) & set(best.pairs)]
    if rivals and best.log_evidence - rivals[0].log_evidence < lead_nats:
        return []
    sure = _without_doubt(best, source, target, allowed, density, math.log(probability / (1.0 - probability)))
    return sure if len(sure) > 1 else []


def _without_doubt(
    best: Alignment, source: LocalMap, target: LocalMap, allowed: BoolArray, density: float, margin: float
) -> list[tuple[int, int]]:
    """Pairs that are better by `margin` nats than any change of the overlay by one: none, another, or exchanged."""
    pairings = _pairings(best.motion, source, target, allowed, density)
    row_of = {(int(a), int(b)): k for k, (a, b) in enumerate(zip(pairings.source, pairings.target, strict=True))}
    chosen = dict(best.pairs)
    whole = _evidence(pairings, [row_of[pair] for pair in chosen.items()], density)
    sure = []
    for mine, place in best.pairs:
        others = {a: b for a, b in chosen.items() if a != mine}
        changes = [others]
        for other in pairings.target[pairings.source == mine]:
            if other == place:
                continue
            evicted = next((a for a, b in others.items() if b == other), None)
            kept = {a: b for a, b in others.items() if a != evicted} | {mine: int(other)}
            changes.append(kept)
            if evicted is not None and (evicted, place) in row_of:
                changes.append(kept | {evicted: place})
        evidence = [_evidence(pairings, [row_of[pair] for pair in change.items()], density) for change in changes]
        if whole - max(evidence) > margin:
            sure.append((mine, place))
    return sure


def _evidence(pairings: Pairings, rows: list[int], density: float) -> float:
    """Of some pairs (rows) being the same, over being different [nats]."""
    if not rows:
        return 0.0
    columns = np.array([[2 * k, 2 * k + 1] for k in rows]).ravel()
    covariance, innovation = pairings.covariance[np.ix_(columns, columns)], pairings.innovation[rows].ravel()
    log_det = np.linalg.slogdet(2.0 * np.pi * covariance)[1]
    distance = innovation @ np.linalg.solve(covariance, innovation)
    return float(-0.5 * (distance + log_det) - len(rows) * np.log(density))


def _motions(source: LocalMap, target: LocalMap, allowed: BoolArray) -> list[FloatArray]:
    """Motions by two landmarks each, those that bring most landmarks near some other first; alike ones once."""
    between = np.linalg.norm(target.place[:, None] - target.place[None], axis=2)
    scored: list[tuple[int, float, FloatArray]] = []
    seen: set[tuple[tuple[int, int], ...]] = set()
    for i in range(min(len(source.place), MAX_SEEDS)):
        for j in range(i):
            span = float(np.linalg.norm(source.place[i] - source.place[j]))
            if span < MIN_SPAN_M:
                continue
            fits = np.abs(between - span) < 3.0 * _sigma_of_span(source, i, j) + SPAN_SLACK_M
            fits &= allowed[i][:, None] & allowed[j][None, :]
            motions = rigid(source.place[[i, j]], target.place[np.argwhere(fits & (between > 0.0))])
            gap = np.linalg.norm(se2.transform(motions[:, None], source.place)[:, :, None] - target.place, axis=3)
            gap[:, ~allowed] = np.inf
            for motion, nearest, at in zip(motions, gap.argmin(axis=2), gap.min(axis=2), strict=True):
                near = np.flatnonzero(at < NEAR_M)
                key = tuple(zip(near.tolist(), nearest[near].tolist(), strict=True))
                if key not in seen:
                    seen.add(key)
                    scored.append((-len(np.unique(nearest[near])), float(at[near].sum()), motion))
    scored.sort(key=lambda item: item[:2])
    return [motion for *_, motion in scored[:MAX_MOTIONS]]


def _sigma_of_span(source: LocalMap, i: int, j: int) -> float:
    along = source.place[i] - source.place[j]
    along = along / np.linalg.norm(along)
    row = np.zeros(len(source.covariance))
    row[2 * i : 2 * i + 2], row[2 * j : 2 * j + 2] = along, -along
    return math.sqrt(max(float(row @ source.covariance @ row), 0.0))


def _weighed(motion: FloatArray, source: LocalMap, target: LocalMap, allowed: BoolArray, density: float) -> Alignment:
    """The largest jointly compatible set of pairs around a motion, and its evidence."""
    pairings = _pairings(motion, source, target, allowed, density)
    found = most_pairings(pairings, confidence=CONFIDENCE)
    rows = found.pairing[found.pairing >= 0]
    if len(rows) == 0:
        return Alignment(motion, (), 0.0)
    pairs = tuple((int(pairings.source[k]), int(pairings.target[k])) for k in rows)
    return Alignment(motion, pairs, _evidence(pairings, rows.tolist(), density))


def _pairings(motion: FloatArray, source: LocalMap, target: LocalMap, allowed: BoolArray, density: float) -> Pairings:
    """Pairs that come near each other under the motion, with the covariance of their differences around it."""
    place = se2.transform(motion, source.place)
    gap = place[:, None] - target.place[None]
    s, t = np.nonzero(allowed & (np.linalg.norm(gap, axis=2) < NEAR_M))
    turn, n = se2.rotation(motion[2]), len(s)
    blocks = source.covariance.reshape(len(place), 2, len(place), 2)
    of_source = np.einsum("ij,kjml,nl->kimn", turn, blocks, turn)
    covariance = _blocks(target.covariance, t) + of_source[s][:, :, s]
    lever = (place - place.mean(axis=0))[s]
    by_motion = np.zeros((n, 2, 3))
    by_motion[:, :, :2], by_motion[:, 0, 2], by_motion[:, 1, 2] = np.eye(2), -lever[:, 1], lever[:, 0]
    around = (by_motion * MOTION_SIGMA**2).reshape(2 * n, 3) @ by_motion.reshape(2 * n, 3).T
    return Pairings(
        s.astype(np.int64), t.astype(np.int64), gap[s, t], covariance.reshape(2 * n, 2 * n) + around,
        np.full(n, np.log(density)), len(source.place),
    )  # fmt: skip


def _blocks(covariance: FloatArray, rows: IntArray) -> FloatArray:
    """(n, 2, n, 2) of some places, of a covariance (2 P, 2 P)."""
    count = len(covariance) // 2
    return covariance.reshape(count, 2, count, 2)[rows][:, :, rows]


STIFF_M = 0.2
"""Landmarks belong to one stiff part if they are known against each other to this."""
MOST_LAID = 120
"""Landmarks of a map up to which a loose part of it is laid over the rest."""


def propose_constellation(
    assignment: Assignment,
    joint: FloatArray,
    *,
    density: float,
    probability: float,
    refused: set[tuple[int, int]],
) -> list[tuple[int, int]]:
    """Return pairs (younger, older) by which a part of the map that is loose lies on the rest in one way only."""
    place, sightings = assignment.estimate.landmark, assignment.sightings
    apart = assignment.together.toarray() > 0.0
    root, loose = stiff_and_loose(sightings, joint)
    if len(loose) < 2:
        return []
    loose = loose[np.argsort(-sightings[loose], kind="stable")]
    allowed = ~apart[np.ix_(loose, root)]
    gap = place[loose][:, None] - place[root][None]
    spread = _spreads(joint, loose, root)
    near = np.einsum("ijk,ijk->ij", gap, np.linalg.solve(spread, gap[..., None])[..., 0]) < LOOSE_GATE
    one, other = assignment.of_kind[loose][:, None], assignment.of_kind[root][None]
    allowed &= (near | same_name(one, other)) & alike(one, other)
    like = assignment.like()
    if assignment.traits is not None and like is not None:
        k, m = np.nonzero(allowed)
        allowed[k, m] = assignment.traits.same(like.part(loose[k]), like.part(root[m])) >= -MISREAD_NATS
    for k, m in np.argwhere(allowed):
        allowed[k, m] = _ordered(loose[k], root[m]) not in refused
    source, target = _local(place, joint, loose), _local(place, joint, root)
    pairs = agreed_pairs(source, target, allowed, density=density, probability=probability)
    return [_ordered(loose[k], root[m]) for k, m in pairs]


def stiff_and_loose(sightings: IntArray, joint: FloatArray) -> tuple[IntArray, IntArray]:
    """Return landmarks that hang together with the oldest, each well known against the next; and all others.

    Args:
        sightings: (L,) detections of each.
        joint: (G, G) covariance, that of the landmarks first.
    """
    seen = np.flatnonzero(sightings >= FEWEST_TO_PAIR)
    if not len(seen):
        return seen, seen
    within = np.linalg.eigvalsh(_spreads(joint, seen, seen))[..., 1] < STIFF_M**2
    _, part = connected_components(within, directed=False)
    return seen[part == part[0]], seen[part != part[0]]


def _ordered(u: int, o: int) -> tuple[int, int]:
    """(younger, older)."""
    return int(max(u, o)), int(min(u, o))


def _local(place: FloatArray, joint: FloatArray, rows: IntArray) -> LocalMap:
    columns = np.column_stack([2 * rows, 2 * rows + 1]).ravel()
    return LocalMap(place[rows], joint[np.ix_(columns, columns)])


def _spreads(joint: FloatArray, some: IntArray, others: IntArray) -> FloatArray:
    """(n, m, 2, 2) covariances of the differences of landmarks."""
    count = len(joint) // 2
    blocks = joint[: 2 * count, : 2 * count].reshape(count, 2, count, 2).transpose(0, 2, 1, 3)
    cross = blocks[np.ix_(some, others)]
    spread: FloatArray = (
        blocks[some, some][:, None] + blocks[others, others][None] - cross - cross.transpose(0, 1, 3, 2)
    )
    return spread
