"""Reassignment of every detection with the smoothed map, and landmarks that were overlooked.

Given all poses, the errors of detections are almost independent, so each is compared by itself. The part of a residual
that the uncertainty of the estimate explains is known from the factorisation (`Marginals.explained_detections`); it is
also used for neighbouring landmarks. A landmark takes one detection per frame. Clusters of remaining detections, from
enough frames, are overlooked landmarks.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.special import gammainc

from evermap.slam.association.assignment import NOBODY, Assignment, alike, same_name
from evermap.slam.association.jcbb import gates
from evermap.slam.association.merging import in_reach
from evermap.slam.kernels import kernel
from evermap.slam.linearise import detection_residuals
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray

LAST_ROUNDS = 5
"""Maximum number of comparisons of every detection with the whole map at the end."""
LOOK_BINS = 12
"""Number of bins of range, with equal numbers of detections, in which the usual rate of sightings is estimated."""
ROUNDS = 20
"""Maximum number of rounds of rates and landmarks; they converge within a few."""
HIDDEN = np.geomspace(0.01, 0.8, 12)
"""Grid of the probability of a landmark in view to be hidden for a while; the least is that of a hit out of view."""


def reassign(assignment: Assignment, explained: FloatArray, *, density: float) -> Assignment:
    """Return the assignment with every detection assigned to its most probable landmark, or to none.

    Args:
        assignment: at its optimum.
        explained: (M, 2, 2) whitened part of the residuals of assigned detections that the uncertainty of the estimate
            explains, in the order of `assignment.problem()`.
        density: expected landmarks per square metre, mapped or not.
    """
    settings = assignment.settings.association
    problem, estimate = assignment.measured, assignment.estimate
    sigma = problem.sigma_given
    if assignment.n_landmarks == 0:
        return assignment
    spread = np.full(len(sigma), np.nan)
    used = assignment.landmark_row >= 0
    spread[used] = np.clip(np.trace(explained, axis1=1, axis2=2) / 2.0, 0.0, 1.0)
    spread = np.where(np.isfinite(spread), spread, np.nanmedian(spread) if used.any() else 1.0)
    at = assignment.points()
    wide = assignment.wide_m * np.sqrt(1.0 + spread)
    gate = gates(1, settings.gate_confidence)[1]
    seen, row = in_reach(estimate.landmark, at, float(np.sqrt(gate) * np.quantile(wide, 0.99)))
    same = may_be_of(assignment.kind[seen], assignment.of_kind[row])
    seen, row = seen[same], row[same]
    compared = replace(problem, pose_row=problem.pose_row[seen], landmark_row=row, reading=problem.reading[seen])
    residual = detection_residuals(compared, estimate)
    variance = sigma[seen] ** 2 * (1.0 + spread[seen])[:, None]
    squared = (residual**2 / variance).sum(axis=1)
    # area element r dr db
    new = np.log(density * np.maximum(problem.reading[seen, 0], 0.1))
    score = -0.5 * (squared + np.log(variance).sum(axis=1)) - np.log(2.0 * np.pi) - new
    score += assignment.traits.same(assignment.traits.singly(seen), assignment.like().part(row))
    inside = (squared < gate) & (score > 0.0)
    seen, row, score = seen[inside], row[inside], score[inside]
    found = most_probable(seen, row, score, problem.pose_row, assignment.n_landmarks, settings.p_own)
    named = assignment.kind[:, -1] != UNKNOWN  # a name closes a loop at any distance
    return replace(assignment, landmark_row=np.where((found == NOBODY) & named, assignment.landmark_row, found))


def may_be_of(detection: IntArray, landmark: IntArray) -> BoolArray:
    """Return which pairs are compatible by labels (K, P) of both; a detection with a name needs a landmark with it."""
    named = detection[:, -1] != UNKNOWN
    return np.asarray(alike(detection, landmark) & (~named | same_name(detection, landmark)))


def most_probable(
    seen: IntArray, row: IntArray, score: FloatArray, frame: IntArray, n_landmarks: int, p_own: float
) -> IntArray:
    """Return (M,) the most probable landmark of each detection, `NOBODY` for none; one per landmark and frame.

    Args:
        seen: (K,) detections.
        row: (K,) candidate landmarks.
        score: (K,) log odds of each over a new landmark.
        frame: (M,) of all detections.
        n_landmarks: number of landmarks.
        p_own: least probability.
    """
    weight = np.exp(np.minimum(score, 500.0))
    share = weight / (1.0 + np.bincount(seen, weight, len(frame))[seen])
    order = np.lexsort((-score, frame[seen]))
    return _assign_candidates(seen[order], row[order], frame, share[order] > p_own, len(frame), n_landmarks)


@kernel
def _assign_candidates(
    seen: IntArray, row: IntArray, pose_row: IntArray, sure: BoolArray, n_detections: int, n_landmarks: int
) -> IntArray:
    """(M,) landmark of every detection: candidates in order of frame and score, one per landmark and frame."""
    taken = np.full(n_detections, -1)
    last = np.full(n_landmarks, -1)
    for k in range(len(seen)):
        if sure[k] and taken[seen[k]] < 0 and last[row[k]] != pose_row[seen[k]]:
            taken[seen[k]] = row[k]
            last[row[k]] = pose_row[seen[k]]
    return taken


def with_overlooked(assignment: Assignment) -> Assignment:
    """Return the assignment with a new landmark per cluster of unassigned detections from enough frames."""
    problem, fewest = assignment.measured, assignment.settings.fewest_sightings
    left = np.flatnonzero(assignment.landmark_row == NOBODY)
    if len(left) < fewest:
        return assignment
    at, wide = assignment.points()[left], assignment.wide_m[left]
    row, places = assignment.landmark_row.copy(), [assignment.estimate.landmark]
    for mine in lying_together(at, wide, assignment.kind[left], problem.pose_row[left], fewest):
        row[left[mine]] = assignment.n_landmarks + len(places) - 1
        places.append(_middle(at[mine], wide[mine])[None])
    estimate = replace(assignment.estimate, landmark=np.concatenate(places))
    return replace(assignment, landmark_row=row, estimate=estimate)


def lying_together(at: FloatArray, wide: FloatArray, kind: IntArray, frame: IntArray, fewest: int) -> list[IntArray]:
    """Return clusters of detections from at least `fewest` frames, one detection per frame.

    Args:
        at: (M, D) positions in the world.
        wide: (M,) their standard deviations.
        kind: (M, P) classes and names.
        frame: (M,) frames.
        fewest: frames of a cluster, at least.
    """
    free, found = np.ones(len(at), dtype=bool), []
    tree = KDTree(at)
    found_near: Any = tree.query_ball_point(at, 3.0 * wide, return_sorted=False)
    near = [np.array(each, dtype=np.int64) for each in found_near]
    for k in np.argsort([-len(each) for each in near], kind="stable").tolist():
        if not free[k] or np.count_nonzero(free[near[k]]) < fewest:
            continue
        mine = near[k][free[near[k]] & alike(kind[near[k]], kind[k])]
        mine = mine[alike(kind[mine], _most_frequent(kind[mine]))]
        mine = mine[np.unique(frame[mine], return_index=True)[1]]
        if len(mine) < fewest:
            continue
        off = np.linalg.norm(at[mine] - _middle(at[mine], wide[mine]), axis=1)
        mine = mine[off < 3.0 * wide[mine]]
        if len(mine) < fewest:
            continue
        free[mine] = False
        found.append(mine)
    return found


def _most_frequent(kind: IntArray) -> IntArray:
    """(P,) the most frequent label of detections (M, P) in each column, `UNKNOWN` for none."""
    found = np.full(kind.shape[1], UNKNOWN)
    for column, values in enumerate(kind.T):
        known, count = np.unique(values[values != UNKNOWN], return_counts=True)
        if len(known):
            found[column] = known[np.argmax(count)]
    return found


def _middle(at: FloatArray, wide: FloatArray) -> FloatArray:
    """Weighted mean of positions."""
    weight = 1.0 / wide**2
    return np.asarray((weight[:, None] * at).sum(axis=0) / weight.sum())


def likely_real(assignment: Assignment) -> BoolArray:
    """Return (L,) whether a landmark is detected often enough; ghosts and corners of cars are detected too seldom.

    The number of sightings of a landmark is Poisson, with its own share of the expected number as the mean: the frames
    with its place in view, times the usual rate of sightings at that range. It is no landmark if its share is probably
    below `slam.association.least_seen` (posterior with a flat prior; the usual rate is that of the landmarks only).
    """
    if not (assignment.landmark_row >= 0).any():
        return np.ones(assignment.n_landmarks, dtype=bool)
    return _count_views(assignment).real


def unseen_nats(assignment: Assignment) -> float:
    """Return the negative log likelihood [nats] of hits and misses, given where all landmarks are.

    Misses in a row are correlated, so what counts is whether a landmark was seen at all in each interval of
    `slam.association.forget_s`: its sightings are Poisson, with those expected from range and view as the mean, unless
    it is hidden. How often that is follows by likelihood. If the map is there twice, each copy is missed half of the
    time.
    """
    used = assignment.landmark_row >= 0
    if not used.any():
        return 0.0
    rules, measured, estimate = assignment.settings.association, assignment.measured, assignment.estimate
    look = _count_views(assignment)
    when = ((measured.stamp_s - measured.stamp_s[0]) // rules.forget_s).astype(np.int64)
    expected = _expect_sightings(estimate.pose, estimate.landmark, look.edges, look.view, look.rate, when)
    seen = np.zeros(expected.shape, dtype=np.bool_)
    seen[assignment.landmark_row[used], when[measured.pose_row[used]]] = True
    p_seen = -np.expm1(-expected)
    hit, miss = np.maximum(p_seen[seen], HIDDEN[0]), p_seen[~seen]
    return -max(float(np.log(p * hit).sum() + np.log1p(-p * miss).sum()) for p in 1.0 - HIDDEN)


class _Visible(NamedTuple):
    """Landmarks that are real (L,), sightings per look by range (B,) with edges (B + 1,), and bearings in view (2,)."""

    real: BoolArray
    rate: FloatArray
    edges: FloatArray
    view: FloatArray


def _count_views(assignment: Assignment) -> _Visible:
    """Which landmarks are seen often enough in view, and how often these are."""
    real, used = np.ones(assignment.n_landmarks, dtype=bool), assignment.landmark_row >= 0
    measured, estimate, least = assignment.measured, assignment.estimate, assignment.settings.association.least_seen
    reach, bearing = measured.reading[used].T
    edges = np.quantile(reach, np.linspace(0.0, 1.0, LOOK_BINS + 1))
    view = np.array([bearing.min(), bearing.max()])
    looks = _looks(estimate.pose, estimate.landmark, edges, view)
    which = np.clip(np.searchsorted(edges, reach) - 1, 0, LOOK_BINS - 1)
    hits = np.zeros(looks.shape)
    np.add.at(hits, (assignment.landmark_row[used], which), 1.0)
    for _ in range(ROUNDS):
        rate = hits[real].sum(axis=0) / np.maximum(looks[real].sum(axis=0), 1.0)
        before, real = real, gammainc(hits.sum(axis=1) + 1.0, least * (looks @ rate)) <= 0.5
        if np.array_equal(before, real):
            break
    return _Visible(real, rate, edges, view)


@kernel
def _range_bin(pose: FloatArray, place: FloatArray, edges: FloatArray, view: FloatArray) -> int:
    """The range bin of a place from a pose; -1 if it is not in view."""
    x, y = place[0] - pose[0], place[1] - pose[1]
    away = np.hypot(x, y)
    turned = np.arctan2(y, x) - pose[2]
    turned -= 2.0 * np.pi * np.round(turned / (2.0 * np.pi))
    if away <= edges[-1] and view[0] <= turned <= view[1]:
        return int(max(np.searchsorted(edges, away) - 1, 0))
    return -1


@kernel
def _looks(pose: FloatArray, place: FloatArray, edges: FloatArray, view: FloatArray) -> FloatArray:
    """(L, B) number of poses with a place in view, by range."""
    looks = np.zeros((len(place), len(edges) - 1))
    for k in range(len(place)):
        for n in range(len(pose)):
            which = _range_bin(pose[n], place[k], edges, view)
            if which >= 0:
                looks[k, which] += 1.0
    return looks


@kernel
def _expect_sightings(
    pose: FloatArray, place: FloatArray, edges: FloatArray, view: FloatArray, rate: FloatArray, when: IntArray
) -> FloatArray:
    """(L, W) expected sightings of places, in the window `when` (N,) of each pose."""
    expected = np.zeros((len(place), when[-1] + 1))
    for k in range(len(place)):
        for n in range(len(pose)):
            which = _range_bin(pose[n], place[k], edges, view)
            if which >= 0:
                expected[k, when[n]] += rate[which]
    return expected
