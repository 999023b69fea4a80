"""Which detections may be of which tracklet, and what each pair costs.

The cost of a pair is the negative log of how much better 'this detection is of this object' explains it than 'the
object was missed, and the detection is of nobody known': half the squared Mahalanobis distance, half the log
determinant of the innovation's covariance (without it young tracklets, whose gates are wide, steal detections), the
class and the appearance, against the density of everything else. Pairs that cost more than nothing cannot be part of
a best assignment, and are not listed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from evermap.tracking.grid import bucket_of, cell_of, fill
from evermap.tracking.kernels import distance_and_log_det, inlined, kernel
from evermap.types import FloatArray, IntArray


class Evidence(NamedTuple):
    """What a detection says, whoever asks: numbers of the settings.

    Attributes:
        confusion: (C, C) `P(detected class | true class)`, a row a true class.
        class_prior: (C,) of objects that are not known.
        log_clutter: log of the density of detections that are of nobody known, 1/m^3.
        gate: largest squared Mahalanobis distance.
        appearance_nats, appearance_neutral: see `TrackerConfig`.
        moved_reach_m: objects may be found this far from where they are expected, 0 if not ...
        log_moved: ... with this log density, 1/m^3.
    """

    confusion: FloatArray
    class_prior: FloatArray
    log_clutter: float
    gate: float
    appearance_nats: float
    appearance_neutral: float
    moved_reach_m: float
    log_moved: float


class Pairs(NamedTuple):
    """Candidate pairs, sparse: those of row i are `start[i]` to `start[i + 1]`.

    Attributes:
        start: (N + 1,) first pair of every row.
        column: (E,) the detection.
        cost: (E,) below 0: against missing the object and leaving the detection to nobody.
        log_ratio: (E,) log-likelihood of the detection if it is of the object, over that if of nobody.
    """

    start: IntArray
    column: IntArray
    cost: FloatArray
    log_ratio: FloatArray


NEVER_SURE = 1e-3
"""Least probability to detect an object: what a sensing model rules out is unlikely, but its geometry is not exact."""
LOG_TWO_PI = math.log(2.0 * math.pi)


@inlined
def class_log_ratio(class_p: FloatArray, confusion: FloatArray, prior: FloatArray, detected: int) -> float:
    """How much likelier a detected class is for an object of these probabilities than for any object; 0 if unknown."""
    if detected < 0:
        return 0.0
    its, anyone = 0.0, 0.0
    for c in range(class_p.shape[0]):
        its += class_p[c] * confusion[c, detected]
        anyone += prior[c] * confusion[c, detected]
    return math.log(max(its, 1e-300) / max(anyone, 1e-300))


@inlined
def appearance_log_ratio(mine: FloatArray, theirs: FloatArray, nats: float, neutral: float) -> float:
    """Log-likelihood ratio of two unit vectors, linear in their cosine; 0 where either is zero."""
    cosine, mine_is, theirs_is = 0.0, False, False
    for k in range(mine.shape[0]):
        cosine += mine[k] * theirs[k]
        mine_is |= mine[k] != 0.0
        theirs_is |= theirs[k] != 0.0
    return nats * (cosine - neutral) / (1.0 - neutral) if mine_is and theirs_is else 0.0


@kernel
def candidates(
    mean: FloatArray,
    covariance: FloatArray,
    class_p: FloatArray,
    appearance: FloatArray,
    inverse_odds: FloatArray,
    p_detect: FloatArray,
    n: int,
    position: FloatArray,
    noise: FloatArray,
    detected_class: IntArray,
    detected_appearance: FloatArray,
    evidence: Evidence,
) -> Pairs:
    """List all pairs inside their gate that are worth being matched.

    Args:
        mean: (N, D) as in `Tracklets`; the first three states are the position.
        covariance: (N, D, D).
        class_p: (N, C).
        appearance: (N, A).
        inverse_odds: (N,).
        p_detect: (N,) probability to detect each object, if it is there.
        n: rows in use.
        position: (M, 3) detections.
        noise: (M, 3, 3) their covariances, or (1, 3, 3) for all.
        detected_class: (M,) or `UNKNOWN`.
        detected_appearance: (M, A) unit vectors or zeros.
        evidence: numbers of the settings.
    """
    m = position.shape[0]
    start = np.zeros(n + 1, dtype=np.int64)
    room = 4 * (n + m) + 16
    column, cost, log_ratio = np.empty(room, dtype=np.int64), np.empty(room), np.empty(room)
    if m == 0 or n == 0:
        return Pairs(start, column[:0], cost[:0], log_ratio[:0])
    shared = noise.shape[0] == 1
    widest = np.zeros(3)  # of the detections' noise: bounds every gate from outside
    for j in range(noise.shape[0]):
        for a in range(3):
            widest[a] = max(widest[a], noise[j, a, a])
    reach = np.empty((n, 3))
    total = 0.0
    for i in range(n):
        for a in range(3):
            reach[i, a] = math.sqrt(evidence.gate * max(covariance[i, a, a] + widest[a], 0.0))
            reach[i, a] = max(reach[i, a], evidence.moved_reach_m)
            total += reach[i, a]
    cell_m = max(2.0 * total / (3 * n), 1e-9)
    bucket_start, member, cell = fill(position, cell_m)
    mask = bucket_start.shape[0] - 2
    low, high = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    found = np.empty(m, dtype=np.int64)
    e = 0
    for i in range(n):
        n_cells = 1.0
        for a in range(3):
            low[a] = cell_of(mean[i, a] - reach[i, a], cell_m)
            high[a] = cell_of(mean[i, a] + reach[i, a], cell_m)
            n_cells *= high[a] - low[a] + 1.0
        n_found = 0
        if n_cells > m:  # a gate as wide as that is looked through one by one
            for j in range(m):
                found[j] = j
            n_found = m
        else:
            for x in range(low[0], high[0] + 1):
                for y in range(low[1], high[1] + 1):
                    for z in range(low[2], high[2] + 1):
                        b = bucket_of(x, y, z, mask)
                        for k in range(bucket_start[b], bucket_start[b + 1]):
                            j = member[k]
                            if cell[j, 0] == x and cell[j, 1] == y and cell[j, 2] == z:
                                found[n_found] = j
                                n_found += 1
        p_hit = max(p_detect[i], NEVER_SURE) / (1.0 + inverse_odds[i])
        if p_hit > 0.0:
            missed_over_hit = math.log((1.0 - p_hit) / p_hit) if p_hit < 1.0 else -700.0
            for k in range(n_found):
                j = found[k]
                r = 0 if shared else j
                dx, dy, dz = position[j, 0] - mean[i, 0], position[j, 1] - mean[i, 1], position[j, 2] - mean[i, 2]
                squared, log_det = distance_and_log_det(
                    dx,
                    dy,
                    dz,
                    covariance[i, 0, 0] + noise[r, 0, 0],
                    covariance[i, 0, 1] + noise[r, 0, 1],
                    covariance[i, 0, 2] + noise[r, 0, 2],
                    covariance[i, 1, 1] + noise[r, 1, 1],
                    covariance[i, 1, 2] + noise[r, 1, 2],
                    covariance[i, 2, 2] + noise[r, 2, 2],
                )
                log_density = -0.5 * (squared + log_det + 3.0 * LOG_TWO_PI) if squared <= evidence.gate else -math.inf
                if dx * dx + dy * dy + dz * dz <= evidence.moved_reach_m * evidence.moved_reach_m:
                    log_density = max(log_density, evidence.log_moved)
                if log_density == -math.inf:
                    continue
                ratio = log_density - evidence.log_clutter
                ratio += class_log_ratio(class_p[i], evidence.confusion, evidence.class_prior, detected_class[j])
                ratio += appearance_log_ratio(
                    appearance[i], detected_appearance[j], evidence.appearance_nats, evidence.appearance_neutral
                )
                if missed_over_hit - ratio >= 0.0:
                    continue
                if e == room:
                    room *= 2
                    column = np.concatenate((column, np.empty(e, dtype=np.int64)))
                    cost = np.concatenate((cost, np.empty(e)))
                    log_ratio = np.concatenate((log_ratio, np.empty(e)))
                column[e], cost[e], log_ratio[e] = j, missed_over_hit - ratio, ratio
                e += 1
        start[i + 1] = e
    return Pairs(start, column[:e], cost[:e], log_ratio[:e])
