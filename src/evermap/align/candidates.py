"""Candidate motions that lay landmarks over landmarks, and the one that most of them agree on.

A motion of the plane is defined by two landmarks, one of space by three, or by one with an orientation (random sample
consensus: Fischler and Bolles 1981; here all samples of equal size in both maps, or many of them, not random ones).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from evermap.geometry import se2, se3
from evermap.geometry.group import PLANE, SPACE, Group
from evermap.geometry.rigid import rigid
from evermap.types import BoolArray, FloatArray, IntArray

AGREE_M, AGREE_RAD = 0.5, 0.5
"""Landmarks agree with a map where they lie this close to its places, and are turned by no more."""
N_PAIRS = 5000
"""Pairs that are tried, about: all of them up to 70 points, else every point with those that are farthest from it."""
PARTNERS = 512
"""Landmarks with which every other one may be paired, at most: a random sample of large maps."""
SAMPLE, BEST_OF_SAMPLE = 512, 128
"""Landmarks by which motions are compared first, at most, and motions that are compared by all landmarks then."""
SEED = 0
"""Of the samples, which are the same for the same number of landmarks."""
OF_TRIPLES, MOST_TRIPLES = 14, 300
"""Landmarks whose triples are tried, and triples."""
FLAT_M = 0.3
"""A triangle has this height at least, or it leaves a turn about its long side."""
BY_EXPLANATION = 1e-3
"""Score of a nat of a candidate's log prior: it decides between motions with the same agreement."""
AT_ONCE = 200_000
"""Numbers in a table that is worked on at once."""
APART = 2.0
"""Motions that take a landmark to places this many times the tolerance apart are different ones."""


@dataclass(frozen=True, slots=True)
class Matches:
    """Pairs of a landmark in one map and a place in another at which it may be.

    Attributes:
        source: (K, 2) or (K, 3) positions of the landmarks, or (K, 7) poses in space, with nan for the orientation of
            points.
        target: the place of each, in the same form.
        landmark: (K,) which one a row is of. It may have several, one for every place or pose it may have, and agrees
            with one of them at most.
        weight: (K,) what agreement is worth, for example the probability that the landmark is there.
        log_prior: (K,) log probability of an orientation over the most probable one of the same landmark.
    """

    source: FloatArray
    target: FloatArray
    landmark: IntArray
    weight: FloatArray
    log_prior: FloatArray

    @classmethod
    def of(
        cls, source: FloatArray, target: FloatArray, *, landmark: IntArray | None = None,
        weight: FloatArray | None = None, log_prior: FloatArray | None = None,
    ) -> Matches:  # fmt: skip
        """Return matches of different landmarks, each worth 1, unless told otherwise."""
        count = len(source)
        return cls(
            source,
            target,
            np.arange(count) if landmark is None else np.asarray(landmark, dtype=np.int64),
            np.ones(count) if weight is None else np.asarray(weight, dtype=np.float64),
            np.zeros(count) if log_prior is None else log_prior,
        )

    def __len__(self) -> int:
        return len(self.landmark)

    @property
    def group(self) -> Group:
        """Of the motions between the two maps."""
        return PLANE if self.source.shape[1] == PLANE.point_dim else SPACE

    @property
    def points(self) -> tuple[FloatArray, FloatArray]:
        """Positions (K, D) of the landmarks and of their places."""
        dim = self.group.point_dim
        return self.source[:, :dim], self.target[:, :dim]

    @property
    def oriented(self) -> BoolArray:
        """(K,) rows in which both have an orientation."""
        if self.source.shape[1] != SPACE.size:
            return np.zeros(len(self), dtype=np.bool_)
        return np.isfinite(self.source[:, 3]) & np.isfinite(self.target[:, 3])

    def rows(self, which: IntArray) -> Matches:
        """Return some of them."""
        return Matches(
            self.source[which], self.target[which], self.landmark[which], self.weight[which], self.log_prior[which]
        )


def find_consensus(matches: Matches, *, agree_m: float = AGREE_M) -> tuple[FloatArray, BoolArray]:
    """Return the motion that brings most landmarks near their places.

    Args:
        matches: the landmarks and where they may be.
        agree_m: how near a landmark must come to its place to agree.

    Returns:
        (3,) the motion, in space (7,), by least squares over the positions of all that agree if these determine it;
        the identity where nothing agrees. (K,) which agree.
    """
    found = rank_motions(matches, most=1, agree_m=agree_m)
    return found[0] if found else (matches.group.identity(), np.zeros(len(matches), dtype=np.bool_))


def rank_motions(matches: Matches, *, most: int = 2, agree_m: float = AGREE_M) -> list[tuple[FloatArray, BoolArray]]:
    """Return different motions and who agrees with each, as `find_consensus` does, that with most agreement first."""
    order = np.argsort(matches.landmark, kind="stable")
    table = matches.rows(order)
    motion, log_prior = propose_motions(table, agree_m)
    prior = BY_EXPLANATION * log_prior
    sample = _sample_landmarks(table)
    left = np.argsort(-_scores(motion, sample, agree_m) - prior, kind="stable")
    found = list[tuple[FloatArray, BoolArray]]()
    while len(left) and len(found) < most:
        first = left[: BEST_OF_SAMPLE if len(sample) < len(table) else 1]
        first = first[np.argmax(_scores(motion[first], table, agree_m) + prior[first])]
        some = _agreeing(motion[first], table, agree_m)
        if not _determine(table, some):
            break
        best = _refit_motion(motion[first], table, some)
        if all(are_apart(best[None], other, table, agree_m)[0] for other, _ in found):
            agree = np.zeros(len(table), dtype=np.bool_)
            agree[order[some]] = True
            found.append((best, agree))
        if len(found) < most:
            left = left[are_apart(motion[left], best, table, agree_m) & (left != first)]
    return found


def score_motions(motion: FloatArray, matches: Matches, *, agree_m: float = AGREE_M) -> FloatArray:
    """Return (C,) how well landmarks fit by motions (C, 3) or (C, 7): the weight of each that is exactly at a place."""
    return _scores(motion, matches.rows(np.argsort(matches.landmark, kind="stable")), agree_m)


def propose_motions(matches: Matches, agree_m: float = AGREE_M) -> tuple[FloatArray, FloatArray]:
    """Return motions (C, 3), in space (C, 7), by as few landmarks as define one, and their log priors (C,)."""
    source, target = matches.points
    if matches.group is PLANE:
        i, j = _pairs_of_one_length(source, target, matches.landmark, agree_m)
        return _rigid_pairs(source[i], source[j], target[i], target[j]), np.zeros(len(i))
    tag = np.flatnonzero(matches.oriented)
    by_tags = np.zeros((0, SPACE.size))
    if len(tag):
        by_tags = se3.compose(matches.target[tag], se3.inverse(matches.source[tag]))
    triple = _triples_of_one_shape(source, target, matches.landmark, agree_m)
    by_points = rigid(source[triple], target[triple]).reshape(-1, SPACE.size)
    return np.vstack([by_tags, by_points]), np.append(matches.log_prior[tag], np.zeros(len(triple)))


def are_apart(motion: FloatArray, other: FloatArray, matches: Matches, agree_m: float = AGREE_M) -> BoolArray:
    """Return (C,) which motions take an outermost landmark, or an orientation, elsewhere than another motion does."""
    source, group = matches.points[0], matches.group
    outermost = source[np.unique(np.append(source.argmin(axis=0), source.argmax(axis=0)))]
    step = group.transform(motion[:, None], outermost) - group.transform(other, outermost)
    apart = np.linalg.norm(step, axis=2).max(axis=1) > APART * agree_m
    if matches.oriented.any():
        apart |= se3.angle_between(motion, np.broadcast_to(other, motion.shape)) > AGREE_RAD
    return np.asarray(apart)


def _agreeing(motion: FloatArray, matches: Matches, agree_m: float) -> IntArray:
    """Rows that agree under a motion, one for each landmark, sorted."""
    fit = _fit(motion[None], matches, agree_m)[0] * matches.weight
    near = np.flatnonzero(fit > 0.0)
    near = near[np.lexsort((-fit[near], matches.landmark[near]))]
    return np.sort(near[np.unique(matches.landmark[near], return_index=True)[1]])


def _determine(matches: Matches, some: IntArray) -> bool:
    """Tell whether rows that agree determine a motion."""
    return len(some) >= matches.group.point_dim or bool(matches.oriented[some].any())


def _refit_motion(motion: FloatArray, matches: Matches, some: IntArray) -> FloatArray:
    """Return the motion by the positions of all that agree, if these determine one."""
    source, target = (points[some] for points in matches.points)
    if matches.group is SPACE and (len(some) < 3 or _height(source) <= FLAT_M):
        return motion
    return rigid(source, target)


def _sample_landmarks(matches: Matches) -> Matches:
    """Return the rows of a random sample of landmarks, all of them where these are few."""
    name = np.unique(matches.landmark)
    if len(name) <= SAMPLE:
        return matches
    return matches.rows(np.flatnonzero(np.isin(matches.landmark, _some_of(name, SAMPLE))))


def _some_of(rows: IntArray, most: int) -> IntArray:
    """Return a random sample of rows, sorted as they are: the same ones each time."""
    return rows[np.sort(np.random.default_rng(SEED).permutation(len(rows))[:most])]


def _scores(motion: FloatArray, matches: Matches, agree_m: float) -> FloatArray:
    """(C,) as of `score_motions`, of matches sorted by landmark."""
    if not len(matches):
        return np.zeros(len(motion))
    first = np.flatnonzero(np.append(True, np.diff(matches.landmark) > 0))
    score, step = np.empty(len(motion)), max(1, AT_ONCE // len(matches))
    for k in range(0, len(motion), step):
        fit = _fit(motion[k : k + step], matches, agree_m) * matches.weight
        score[k : k + step] = np.maximum.reduceat(fit, first, axis=1).sum(axis=1)
    return score


def _fit(motion: FloatArray, matches: Matches, agree_m: float) -> FloatArray:
    """(C, K) how well pairs agree under motions: 1 exactly at the place, 0 beyond the tolerance (M-SAC: Torr and
    Zisserman 2000). What has an orientation agrees by that, too, or not at all.
    """
    source, target = matches.points
    off = matches.group.transform(motion[:, None], source[None]) - target
    fit = np.maximum(1.0 - (off**2).sum(axis=2) / agree_m**2, 0.0)
    if len(tag := np.flatnonzero(matches.oriented)):
        turned = se3.compose(motion[:, None], matches.source[tag][None])
        fit[:, tag] *= se3.angle_between(turned, matches.target[tag][None]) <= AGREE_RAD
    return np.asarray(fit)


def _pairs_of_one_length(
    source: FloatArray, target: FloatArray, name: IntArray, agree_m: float
) -> tuple[IntArray, IntArray]:
    """Return pairs of different landmarks with about equal distance in both maps; distant ones determine a heading
    best.

    Every point has some, so that those at the far ends, if these moved, are not in all.
    """
    count = len(source)
    partners = max(2, N_PAIRS // max(count, 1))
    other = _some_of(np.arange(count), PARTNERS)
    found, step = [], max(1, AT_ONCE // max(len(other), 1))
    for first in range(0, count, step):
        rows = np.arange(first, min(first + step, count))
        span = _distances(target[rows], target[other])
        mismatch = np.abs(span - _distances(source[rows], source[other]))
        span[(span < agree_m) | (mismatch > agree_m) | (name[rows][:, None] == name[other])] = -1.0
        if partners < count:
            far = np.argsort(-span, axis=1, kind="stable")[:, :partners]
            row, rank = np.nonzero(np.take_along_axis(span, far, axis=1) > 0.0)
            found.append(np.column_stack([rows[row], other[far[row, rank]]]))
        else:
            found.append(np.argwhere(span > 0.0) + [first, 0])
    pairs = np.sort(np.vstack([np.zeros((0, 2), dtype=np.int64), *found]), axis=1)
    low, high = pairs.T
    both = np.unique(low * count + high)
    return both // max(count, 1), both % max(count, 1)


def _triples_of_one_shape(source: FloatArray, target: FloatArray, name: IntArray, agree_m: float) -> IntArray:
    """Return (T, 3) triples of different landmarks whose sides are about equal in both maps, none of them flat."""
    some = np.unique(name, return_index=True)[1]
    some = some[np.linspace(0, len(some) - 1, min(len(some), OF_TRIPLES)).astype(np.int64)]
    triple = np.array(list(combinations(some.tolist(), 3)), dtype=np.int64).reshape(-1, 3)
    mine, there = source[triple], target[triple]
    unlike = [np.abs(_side(mine, a, b) - _side(there, a, b)) for a, b in ((0, 1), (1, 2), (2, 0))]
    fits = np.flatnonzero((np.max(unlike, axis=0) < agree_m) & (_heights(there) > FLAT_M))
    return triple[fits[np.linspace(0, len(fits) - 1, min(len(fits), MOST_TRIPLES)).astype(np.int64)]]


def _side(corners: FloatArray, a: int, b: int) -> FloatArray:
    return np.asarray(np.linalg.norm(corners[:, a] - corners[:, b], axis=1))


def _heights(corners: FloatArray) -> FloatArray:
    """(T,) least heights of triangles (T, 3, 3)."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    longest = np.maximum(np.maximum(_side(corners, 0, 1), _side(corners, 1, 2)), _side(corners, 2, 0))
    return np.asarray(np.linalg.norm(across, axis=1) / np.maximum(longest, 1e-9))


def _height(points: FloatArray) -> float:
    """How far points (K, 3) lie off a line."""
    return float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1])


def _distances(a: FloatArray, b: FloatArray) -> FloatArray:
    """(m, n) from points (m, 2) to points (n, 2)."""
    x, y = a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1]
    return np.asarray(np.sqrt(x * x + y * y), dtype=np.float64)


def _rigid_pairs(a: FloatArray, b: FloatArray, to_a: FloatArray, to_b: FloatArray) -> FloatArray:
    """(m, 3) motions that bring the points `a`, `b` (m, 2) onto `to_a`, `to_b`: `rigid` of two points, m times."""
    was, now = a - b, to_a - to_b
    theta = np.arctan2(was[:, 0] * now[:, 1] - was[:, 1] * now[:, 0], (was * now).sum(axis=1))
    turned = np.column_stack([np.zeros((len(a), 2)), theta])
    return np.column_stack([0.5 * (to_a + to_b) - se2.transform(turned, 0.5 * (a + b)), theta])
