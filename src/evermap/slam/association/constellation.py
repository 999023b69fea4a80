"""Alignment of a local map with a larger one by the constellation of their landmarks.

After a long blind stretch, or in a given map, the rotation of the local map may be too large for a linear gate. Two of
its landmarks with a matching distance determine a motion in the plane, a triangle one in space (`place_index`); around
each such motion the difference of the maps is linear, and joint compatibility counts the landmarks that agree. Motions
are compared by evidence, so that a chance agreement of two landmarks does not beat the correct one of five.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from evermap.config import AssociationConfig, ConstellationConfig, SlamConfig
from evermap.geometry import se2, se3
from evermap.geometry.group import group_of
from evermap.geometry.rigid import rigid
from evermap.slam.association.assignment import Assignment, alike, same_name
from evermap.slam.association.jcbb import Pairings, most_pairings
from evermap.slam.batch import USUAL
from evermap.slam.problem import Marginals
from evermap.types import BoolArray, FloatArray, IntArray

MAX_SEEDS = 12
"""Number of landmarks of the local map that seeds consist of, the best known: bounds the work."""
MAX_MOTIONS = 20
"""Number of motions that are weighed exactly, those with most landmarks near one of the map: bounds the work."""
MOST_LAID = 120
"""Number of landmarks up to which a loose part of a map is aligned with the rest: bounds the work."""


@dataclass(frozen=True, slots=True)
class LocalMap:
    """Landmarks with their uncertainty.

    Attributes:
        place: (n, D), in the plane or in space.
        covariance: (D n, D n).
        rotation: (n, 4) orientations in space, nan for landmarks without; None if none has one.
    """

    place: FloatArray
    covariance: FloatArray
    rotation: FloatArray | None = None

    @property
    def dim(self) -> int:
        """Coordinates of a place: 2, or 3 in space."""
        return int(self.place.shape[1])

    def part(self, rows: IntArray) -> LocalMap:
        """Return some of the landmarks, in the order of the rows."""
        at = se2.xy_rows(rows, self.dim)
        rotation = None if self.rotation is None else self.rotation[rows]
        return LocalMap(self.place[rows], self.covariance[np.ix_(at, at)], rotation)

    @property
    def beside_m(self) -> float:
        """Standard deviation of a landmark relative to its nearest neighbour [m], the median."""
        n, dim = self.place.shape
        near: IntArray = np.asarray(KDTree(self.place).query(self.place, k=2)[1])[:, 1]
        by = np.kron(np.eye(n) - np.eye(n)[near], np.eye(dim))
        spread = np.diag(by @ self.covariance @ by.T).reshape(n, dim).sum(axis=1)
        return math.sqrt(max(float(np.median(spread)), 0.0) / dim)


@dataclass(frozen=True, slots=True)
class Alignment:
    """The pairs that a motion explains.

    Attributes:
        pairs: (source, target) of landmarks that agree.
        log_evidence: of the pairs over no pairs [nats].
        pairings: all that are near each other under the motion.
    """

    pairs: tuple[tuple[int, int], ...]
    log_evidence: float
    pairings: Pairings


def overlays(
    source: LocalMap,
    target: LocalMap,
    allowed: BoolArray,
    *,
    density: float,
    motions: Sequence[FloatArray] | None = None,
    settings: SlamConfig = USUAL,
) -> list[Alignment]:
    """Return alignments of `source` with `target`, that with most evidence first; each set of pairs once.

    Args:
        source: the local map, its best known landmarks first.
        target: the map.
        allowed: (n, m) pairs that may be the same.
        density: expected landmarks per square metre, in space per cubic metre, if they are not the same.
        motions: candidates; None tries all pairs, in the plane.
        settings: of the estimator.
    """
    rules, found = settings.association, dict[tuple[tuple[int, int], ...], Alignment]()
    for motion in _motions(source, target, allowed, rules.constellation) if motions is None else motions:
        pairings = _pairings(motion, source, target, allowed, density, rules)
        chosen = most_pairings(pairings, confidence=rules.gate_confidence)
        rows = chosen[chosen >= 0]
        pairs = tuple(zip(pairings.source[rows].tolist(), pairings.target[rows].tolist(), strict=True))
        log_evidence = _evidence(pairings, rows.tolist(), density)
        if pairs not in found or found[pairs].log_evidence < log_evidence:
            found[pairs] = Alignment(pairs, log_evidence, pairings)
    return sorted(found.values(), key=lambda overlay: -overlay.log_evidence)


def list_agreed_pairs(
    source: LocalMap,
    target: LocalMap,
    allowed: BoolArray,
    *,
    density: float,
    probability: float,
    motions: Sequence[FloatArray] | None = None,
    margins_nats: tuple[float, float] | None = None,
    settings: SlamConfig = USUAL,
) -> list[tuple[int, int]]:
    """Return pairs (source, target) that are certain: of an alignment far better than any other, and certain in it.

    Empty if there are several good alignments, or none. Of an alignment, `margins_nats` are the evidence that it needs
    over no alignment, and over its best rival; None for `slam.association.constellation.certain_nats`. Of a pair,
    `probability` is the least one, against all alignments that differ in this pair only. The rest is as of `overlays`.
    """
    certain = settings.association.constellation.certain_nats
    least_nats, lead_nats = margins_nats or (certain, certain)
    every = overlays(source, target, allowed, density=density, motions=motions, settings=settings)
    found = [overlay for overlay in every if len(overlay.pairs) > 1]
    if not found or found[0].log_evidence < least_nats:
        return []
    best = found[0]
    rivals = [other for other in found[1:] if not set(other.pairs) & set(best.pairs)]
    if rivals and best.log_evidence - rivals[0].log_evidence < lead_nats:
        return []
    sure = _certain(best, density, math.log(probability / (1.0 - probability)))
    return sure if len(sure) > 1 else []


def _certain(best: Alignment, density: float, margin: float) -> list[tuple[int, int]]:
    """Pairs that exceed any change of the alignment in one pair by `margin` nats: removed, replaced, or exchanged."""
    pairings = best.pairings
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
    """Evidence of some pairs (rows) over no pairs [nats]."""
    if not rows:
        return 0.0
    columns = se2.xy_rows(np.array(rows), pairings.innovation.shape[1])
    covariance, innovation = pairings.covariance[np.ix_(columns, columns)], pairings.innovation[rows].ravel()
    log_det = np.linalg.slogdet(2.0 * np.pi * covariance)[1]
    distance = innovation @ np.linalg.solve(covariance, innovation)
    return float(-0.5 * (distance + log_det) - len(rows) * np.log(density))


def _motions(source: LocalMap, target: LocalMap, allowed: BoolArray, rules: ConstellationConfig) -> list[FloatArray]:
    """Motions from two landmarks each, those with most landmarks near one of the target first; equal ones once."""
    between = np.linalg.norm(target.place[:, None] - target.place[None], axis=2)
    scored: list[tuple[int, float, FloatArray]] = []
    seen: set[tuple[tuple[int, int], ...]] = set()
    for i in range(min(len(source.place), MAX_SEEDS)):
        for j in range(i):
            span = float(np.linalg.norm(source.place[i] - source.place[j]))
            if span < rules.least_span_m:
                continue
            fits = np.abs(between - span) < 3.0 * _sigma_of_span(source, i, j) + rules.span_slack_m
            fits &= allowed[i][:, None] & allowed[j][None, :]
            motions = rigid(source.place[[i, j]], target.place[np.argwhere(fits & (between > 0.0))])
            gap = np.linalg.norm(se2.transform(motions[:, None], source.place)[:, :, None] - target.place, axis=3)
            gap[:, ~allowed] = np.inf
            for motion, nearest, at in zip(motions, gap.argmin(axis=2), gap.min(axis=2), strict=True):
                near = np.flatnonzero(at < rules.near_m)
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


def _pairings(
    motion: FloatArray, source: LocalMap, target: LocalMap, allowed: BoolArray, density: float,
    settings: AssociationConfig,
) -> Pairings:  # fmt: skip
    """Pairs near each other under the motion, with the covariance of their differences around it."""
    rules, group = settings.constellation, group_of(motion)
    place, dim = group.transform(motion, source.place), source.dim
    gap = place[:, None] - target.place[None]
    near = allowed & (np.linalg.norm(gap, axis=2) < rules.near_m)
    if source.rotation is not None and target.rotation is not None:
        turned = se3.compose(motion, se3.turn(source.rotation))
        angle = se3.angle_between(turned[:, None], se3.turn(target.rotation))
        near &= ~(angle > settings.space.turn_sigmas * settings.space.turn_floor_rad)
    s, t = np.nonzero(near)
    turn, n = group.rotation_of(motion), len(s)
    blocks = source.covariance.reshape(len(place), dim, len(place), dim)
    of_source = np.einsum("ij,kjml,nl->kimn", turn, blocks, turn)
    of_target = target.covariance.reshape(len(target.place), dim, len(target.place), dim)[t][:, :, t]
    by_motion = group.rigid_directions((place - place.mean(axis=0))[s])
    free = np.repeat([rules.free_m, rules.free_rad], [dim, group.dim - dim])
    return Pairings(
        s.astype(np.int64), t.astype(np.int64), gap[s, t],
        (of_target + of_source[s][:, :, s]).reshape(dim * n, dim * n) + (by_motion * free**2) @ by_motion.T,
        np.full(n, np.log(density)), len(source.place),
    )  # fmt: skip


class LoosePart(NamedTuple):
    """The landmarks of a map that are not stiffly connected with the oldest, beside those that are.

    Attributes:
        loose: (n,) their rows, those with most sightings first.
        root: (m,) rows of the others.
        source, target: both, with their covariances.
        allowed: (n, m) pairs that may be the same.
    """

    loose: IntArray
    root: IntArray
    source: LocalMap
    target: LocalMap
    allowed: BoolArray

    @classmethod
    def of(
        cls, assignment: Assignment, marginals: Marginals, refused: Collection[tuple[int, int]] = ()
    ) -> LoosePart | None:
        """Return the loose part of a map at its optimum: landmarks that are not connected with the oldest, each well
        known relative to the next. None if it has no two landmarks, or the map more than `MOST_LAID`.
        """
        rules, sightings = assignment.settings.association, assignment.sightings
        seen = np.flatnonzero(sightings >= rules.fewest_to_pair)
        if not len(seen) or assignment.n_landmarks > MOST_LAID:
            return None
        place, joint = assignment.estimate.landmark, assignment.with_shared_errors(marginals.shared)
        within = np.linalg.eigvalsh(_spreads(joint, seen, seen))[..., 1] < rules.constellation.stiff_m**2
        _, group = connected_components(within, directed=False)
        root, loose = seen[group == group[0]], seen[group != group[0]]
        if len(loose) < 2:
            return None
        loose = loose[np.argsort(-sightings[loose], kind="stable")]
        allowed = assignment.together.toarray()[np.ix_(loose, root)] == 0.0
        gap = place[loose][:, None] - place[root][None]
        spread = _spreads(joint, loose, root)
        near = np.einsum("ijk,ijk->ij", gap, np.linalg.solve(spread, gap[..., None])[..., 0]) < rules.loose_gate
        one, other = assignment.of_kind[loose][:, None], assignment.of_kind[root][None]
        allowed &= (near | same_name(one, other)) & alike(one, other)
        (k, m), like = np.nonzero(allowed), assignment.like()
        by_traits = assignment.traits.same(like.part(loose[k]), like.part(root[m]))
        allowed[k, m] = by_traits >= -rules.readings.misread_nats
        for k, m in np.argwhere(allowed):
            allowed[k, m] = _order_pair(loose[k], root[m]) not in refused
        whole = LocalMap(place, joint)
        return cls(loose, root, whole.part(loose), whole.part(root), allowed)

    def rows(self, pairs: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
        """Return pairs (younger, older) of the map, from those of `source` and `target`."""
        return [_order_pair(self.loose[k], self.root[m]) for k, m in pairs]


def _order_pair(u: int, o: int) -> tuple[int, int]:
    """(younger, older)."""
    return int(max(u, o)), int(min(u, o))


def _spreads(joint: FloatArray, some: IntArray, others: IntArray) -> FloatArray:
    """(n, m, 2, 2) covariances of the differences of landmarks."""
    count = len(joint) // 2
    blocks = joint.reshape(count, 2, count, 2).transpose(0, 2, 1, 3)
    cross = blocks[np.ix_(some, others)]
    own = blocks[some, some][:, None] + blocks[others, others][None]
    return np.asarray(own - cross - cross.transpose(0, 1, 3, 2))
