"""Which landmarks are on one body: at first those of a class that stand close together, then those that move together.

Proximity within a semantic class (Bateman 2020, section 7.3) is a guess: two chairs side by side look like one. What
they do next tells. A body moves as a whole, so its landmarks keep their distances; bodies move one by one. With
`E(G)` the evidence of the displacements of a set of landmarks, if one rigid motion made them all,

    log odds of 'G and H are one body' = log prior odds + log E(G + H) - log E(G) - log E(H)

and sets are joined as long as the odds are for it, the best pair first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum

import numpy as np

from evermap.geometry import se2
from evermap.types import FloatArray, IntArray

P_ONE_BODY = 0.9
"""Of two landmarks of a clique, before they are seen to move: that they are on one body."""
P_SPLIT_BEFORE = 0.05
"""Of two landmarks that are near, but of different cliques."""
P_OTHER_CLASS = 0.001
"""Of two landmarks that are near, but of different classes."""
P_MOVED = 0.1
"""Of a body, between two sessions."""
MOVE_SIGMA_M = 2.0
"""Standard deviation of displacements, each axis."""


class Fate(IntEnum):
    """What a session found of a landmark."""

    UNSEEN = 0
    """Nobody looked, or nothing is certain."""
    STAYED = 1
    MOVED = 2
    GONE = 3


def group(position_m: FloatArray, class_id: IntArray, *, reach_m: float) -> IntArray:
    """Cliques by proximity within a class; what has no class stands alone.

    Complete linkage: no two landmarks of a clique are farther apart than `reach_m`, the closest are joined first.

    Args:
        position_m: (L, 2) places.
        class_id: (L,) classes, negative for none.
        reach_m: largest extent of a clique.

    Returns:
        (L,) numbers of cliques from 0, in the order of their first landmarks.
    """
    from scipy.cluster.hierarchy import fcluster, linkage

    label = np.arange(len(class_id), dtype=np.int64)
    for kind in np.unique(class_id[class_id >= 0]):
        mine = np.flatnonzero(class_id == kind)
        if len(mine) > 1:
            number = fcluster(linkage(position_m[mine], "complete"), reach_m, "distance")
            _, first, which = np.unique(number, return_index=True, return_inverse=True)
            label[mine] = mine[first][which.ravel()]
    return np.asarray(np.unique(label, return_inverse=True)[1].ravel(), dtype=np.int64)


def regrouped(
    clique_id: IntArray,
    class_id: IntArray,
    fate: IntArray,
    before_m: FloatArray,
    after_m: FloatArray,
    covariance_m2: FloatArray,
    *,
    reach_m: float,
    next_id: int,
    p_wrong: float | FloatArray = 1e-3,
) -> IntArray:
    """Cliques after a session: split where one rigid motion does not explain it, joined where it does.

    Args:
        clique_id: (L,) cliques as they were.
        class_id: (L,) classes, negative for none.
        fate: (L,) of each landmark, as of `Fate`.
        before_m: (L, 2) its last place.
        after_m: (L, 2) its new place; looked at only where it moved.
        covariance_m2: (L, 2, 2) of the difference of the two.
        reach_m: largest extent of a body.
        next_id: first free id.
        p_wrong: probability that a fate is wrong, of all or (L,) of each.

    Returns:
        (L,) cliques. Of one that is split the largest part keeps the id, with those that were not seen.
    """
    log_wrong = np.log(np.broadcast_to(np.asarray(p_wrong, dtype=np.float64), clique_id.shape))
    moves = _Moves(before_m, after_m, covariance_m2)
    label, moved = clique_id.copy(), []
    for name in np.unique(clique_id[fate != Fate.UNSEEN]):
        of_fate = {one: np.flatnonzero((clique_id == name) & (fate == one)) for one in Fate}
        bodies = moves.joined([np.array([row]) for row in of_fate[Fate.MOVED]], _of_one_clique)
        moved += bodies
        parts = [*bodies, *(of_fate[one] for one in (Fate.STAYED, Fate.GONE) if len(of_fate[one]))]
        parts.sort(key=len, reverse=True)
        for part in parts[1:]:
            rest = np.concatenate([other for other in parts if other is not part])
            log_mistaken = max(float(log_wrong[part].sum()), float(log_wrong[rest].sum()))
            if fate[part[0]] == Fate.MOVED or _logit(P_ONE_BODY) + log_mistaken < math.log(P_MOVED):
                label[part] = next_id
                next_id += 1

    def log_prior(a: IntArray, b: IntArray) -> float:
        both = np.concatenate([a, b])
        if max(_extent(before_m[both]), _extent(after_m[both])) > reach_m:
            return -math.inf
        one_class = len(np.unique(class_id[both][class_id[both] >= 0])) <= 1
        return _logit(P_SPLIT_BEFORE if one_class else P_OTHER_CLASS)

    # what did not move with its clique is a clique of its own by now, unless it was mistaken
    whole = [body for body in moved if (fate[(label == label[body[0]]) & (fate != Fate.UNSEEN)] == Fate.MOVED).all()]
    for body in moves.joined(whole, log_prior):
        names = np.unique(label[body])
        label[np.isin(label, names)] = names[0]
    return label


def _of_one_clique(a: IntArray, b: IntArray) -> float:  # noqa: ARG001
    return _logit(P_ONE_BODY)


class _Moves:
    """Evidence of displacements for one rigid motion of a set of landmarks."""

    def __init__(self, before_m: FloatArray, after_m: FloatArray, covariance_m2: FloatArray) -> None:
        self._before, self._after, self._covariance = before_m, after_m, covariance_m2
        self._known: dict[tuple[int, ...], float] = {}

    def log_evidence(self, rows: IntArray) -> float:
        key = tuple(sorted(rows.tolist()))
        if key not in self._known:
            mine = np.array(key)
            self._known[key] = log_evidence_of_motion(self._before[mine], self._after[mine], self._covariance[mine])
        return self._known[key]

    def joined(self, sets: list[IntArray], log_prior: Callable[[IntArray, IntArray], float]) -> list[IntArray]:
        """Sets joined as long as the odds are for it, the best pair first."""
        sets = list(sets)
        while True:
            best, pair = 0.0, None
            for i, a in enumerate(sets):
                for j, b in enumerate(sets[:i]):
                    odds = log_prior(a, b)
                    if odds > -math.inf:
                        both = self.log_evidence(np.concatenate([a, b]))
                        odds += both - self.log_evidence(a) - self.log_evidence(b)
                    if odds > best:
                        best, pair = odds, (i, j)
            if pair is None:
                return sets
            i, j = pair
            sets[j] = np.sort(np.concatenate([sets[j], sets[i]]))
            del sets[i]


def log_evidence_of_motion(before_m: FloatArray, after_m: FloatArray, covariance_m2: FloatArray) -> float:
    """`log p(after | before)` if one rigid motion made it all: any turn, the middle moved by `MOVE_SIGMA_M` each axis.

    Of one landmark exact, of more by Laplace's method about the most probable motion.

    Args:
        before_m: (n, 2) old places.
        after_m: (n, 2) new places.
        covariance_m2: (n, 2, 2) of each difference.
    """
    count = len(before_m)
    if count == 1:
        spread = covariance_m2[0] + MOVE_SIGMA_M**2 * np.eye(2)
        return -0.5 * float(_square(after_m - before_m, spread[None])[0] + _log_det(2.0 * math.pi * spread))
    middle, new_middle = before_m.mean(axis=0), after_m.mean(axis=0)
    arm, new_arm = before_m - middle, after_m - new_middle
    turn = math.atan2(float(np.sum(_perpendicular(arm) * new_arm)), float(np.sum(arm * new_arm)))
    shift = new_middle - middle
    precision = np.linalg.inv(covariance_m2)
    prior = np.diag([MOVE_SIGMA_M**-2, MOVE_SIGMA_M**-2, 1e-6])  # landmarks may be at one point
    for _ in range(5):  # Gauss-Newton from the rotation that suits equal variances best
        turned = arm @ se2.rotation(turn).T
        jacobian = np.concatenate([np.tile(np.eye(2), (count, 1, 1)), _perpendicular(turned)[:, :, None]], axis=2)
        residual = after_m - middle - shift - turned
        information = np.einsum("nia,nij,njb->ab", jacobian, precision, jacobian) + prior
        slope = np.einsum("nia,nij,nj->a", jacobian, precision, residual) - prior @ np.append(shift, turn)
        step = np.linalg.solve(information, slope)
        shift, turn = shift + step[:2], turn + float(step[2])
    residual = after_m - middle - shift - arm @ se2.rotation(turn).T
    log_likelihood = -0.5 * float(np.sum(_square(residual, covariance_m2) + _log_det(2.0 * math.pi * covariance_m2)))
    log_prior = -0.5 * float(shift @ shift) / MOVE_SIGMA_M**2 - math.log(2.0 * math.pi * MOVE_SIGMA_M**2)
    log_width = 1.5 * math.log(2.0 * math.pi) - 0.5 * float(_log_det(information))
    return log_likelihood + log_prior - math.log(2.0 * math.pi) + log_width


def _square(residual: FloatArray, covariance: FloatArray) -> FloatArray:
    """(n,) squared Mahalanobis lengths."""
    return np.asarray(np.einsum("ni,ni->n", residual, np.linalg.solve(covariance, residual[..., None])[..., 0]))


def _log_det(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.slogdet(matrix)[1])


def _perpendicular(vector: FloatArray) -> FloatArray:
    """(n, 2) turned left by a right angle."""
    return np.stack([-vector[:, 1], vector[:, 0]], axis=1)


def _extent(position: FloatArray) -> float:
    return float(np.linalg.norm(position[:, None] - position[None], axis=2).max())


def _logit(p: float) -> float:
    return math.log(p / (1.0 - p))
