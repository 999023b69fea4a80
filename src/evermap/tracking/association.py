"""Assignment of detections to tracklets: candidate pairs, their costs, and the optimum.

The cost of a pair is the negative log of how much better 'this detection is of this object' explains it than 'the
object was missed, and the detection is of nobody known': half the squared Mahalanobis distance, half the log
determinant of the innovation's covariance (without it young tracklets, whose gates are wide, steal detections), the
class and the appearance, against the density of everything else. Pairs that cost more than nothing cannot be part of
a best assignment, and are not listed.

The assignment is by shortest augmenting paths with dual prices (Jonker and Volgenant 1987), one row after the other. A
path never leaves the connected component that it starts in, and most components of gated tracklets are one pair,
settled by the first pass; so the work is that of the components by themselves, without searching for them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from evermap.tracking.frame import Frame
from evermap.tracking.grid import bucket_of, cell_of, fill
from evermap.tracking.kalman import Symmetric, distance_and_log_det, inlined, kernel, shape_log_ratio, sum_of
from evermap.types import FloatArray, IntArray


class Likelihood(NamedTuple):
    """Likelihood parameters of detections.

    Attributes:
        confusion: (C, C) `P(detected class | true class)`, a row a true class.
        class_prior: (C,) of unknown objects.
        log_clutter: log of the density of detections that are of nobody known, 1/m^3.
        gate: largest squared Mahalanobis distance.
        appearance_nats, appearance_neutral: see `TrackerConfig`.
        moved_reach_m: objects may be found this far from where they are expected, 0 if not ...
        log_moved: ... with this log density, 1/m^3.
        least_p_detect, displaced: see `TrackerConfig`.
        misplaced, log_p_misplaced, other_size, p_misshapen: see `ShapeConfig`.
    """

    confusion: FloatArray
    class_prior: FloatArray
    log_clutter: float
    gate: float
    appearance_nats: float
    appearance_neutral: float
    moved_reach_m: float
    log_moved: float
    least_p_detect: float
    displaced: float
    misplaced: float
    log_p_misplaced: float
    other_size: float
    p_misshapen: float


class Targets(NamedTuple):
    """Predicted states and appearances of N objects.

    Attributes:
        mean: (N, D) of a filter; the first three states are the position.
        covariance: (N, D, D).
        class_p: (N, C) posterior over classes.
        appearance: (N, A) unit vectors, or zeros.
        box: (N, 9) size and heading, or (N, 0).
        inverse_odds: (N,) `(1 - p) / p` of being there.
        p_detect: (N,) probability to detect each, if it is there.
    """

    mean: FloatArray
    covariance: FloatArray
    class_p: FloatArray
    appearance: FloatArray
    box: FloatArray
    inverse_odds: FloatArray
    p_detect: FloatArray


class Pairs(NamedTuple):
    """Candidate pairs, sparse: those of row i are `start[i]` to `start[i + 1]`.

    Attributes:
        start: (N + 1,) first pair of every row.
        column: (E,) the detection.
        cost: (E,) below 0: against missing the object and leaving the detection unassigned.
        log_ratio: (E,) log-likelihood of the detection if it is of the object, over that if of nobody.
    """

    start: IntArray
    column: IntArray
    cost: FloatArray
    log_ratio: FloatArray


LOG_TWO_PI = math.log(2.0 * math.pi)
"""Of Gaussian densities."""


@inlined
def blur(a: FloatArray, noise: FloatArray, wide: float) -> Symmetric:
    """Return the covariance of an innovation if a box is misplaced."""
    return (
        a[0, 0] + wide * noise[0, 0], a[0, 1] + wide * noise[0, 1], a[0, 2] + wide * noise[0, 2],
        a[1, 1] + wide * noise[1, 1], a[1, 2] + wide * noise[1, 2], a[2, 2] + wide * noise[2, 2],
    )  # fmt: skip


@inlined
def is_misplaced(
    mean: FloatArray, covariance: FloatArray, position: FloatArray, noise: FloatArray, likelihood: Likelihood
) -> bool:
    """Return whether a box is rather misplaced than where its noise would have it."""
    offset = position[0] - mean[0], position[1] - mean[1], position[2] - mean[2]
    near, det = distance_and_log_det(offset, sum_of(covariance, noise))
    far, wide_det = distance_and_log_det(offset, blur(covariance, noise, likelihood.misplaced))
    return -0.5 * (near + det) < likelihood.log_p_misplaced - 0.5 * (far + wide_det)


@inlined
def class_log_ratio(class_p: FloatArray, confusion: FloatArray, prior: FloatArray, detected: int) -> float:
    """Return how much likelier a detected class is for an object of these probabilities than for any object; 0 if
    unknown.
    """
    if detected < 0:
        return 0.0
    its, anyone = 0.0, 0.0
    for c in range(class_p.shape[0]):
        its += class_p[c] * confusion[c, detected]
        anyone += prior[c] * confusion[c, detected]
    return math.log(max(its, 1e-300) / max(anyone, 1e-300))


@inlined
def appearance_log_ratio(mine: FloatArray, theirs: FloatArray, nats: float, neutral: float) -> float:
    """Return the log-likelihood ratio of two unit vectors, linear in their cosine; 0 where either is zero."""
    cosine, mine_is, theirs_is = 0.0, False, False
    for k in range(mine.shape[0]):
        cosine += mine[k] * theirs[k]
        mine_is |= mine[k] != 0.0
        theirs_is |= theirs[k] != 0.0
    return nats * (cosine - neutral) / (1.0 - neutral) if mine_is and theirs_is else 0.0


@kernel
def candidates(targets: Targets, n: int, frame: Frame, likelihood: Likelihood) -> Pairs:
    """List all pairs inside their gate that are worth being matched.

    Args:
        targets: where objects are expected.
        n: rows of these in use.
        frame: M detections.
        likelihood: numbers of the settings.
    """
    mean, covariance, class_p, appearance, box, inverse_odds, p_detect = targets
    boxes = box.shape[1] > 0
    position, noise = frame.position, frame.noise
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
    wide = likelihood.misplaced if boxes else 1.0
    total = 0.0
    for i in range(n):
        for a in range(3):
            reach[i, a] = math.sqrt(likelihood.gate * max(covariance[i, a, a] + widest[a] * wide, 0.0))
            reach[i, a] = max(reach[i, a], likelihood.moved_reach_m)
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
        p_hit = max(p_detect[i], likelihood.least_p_detect) / (1.0 + inverse_odds[i])
        if p_hit > 0.0:
            missed_over_hit = math.log((1.0 - p_hit) / p_hit) if p_hit < 1.0 else -700.0
            for k in range(n_found):
                j = found[k]
                r = 0 if shared else j
                dx, dy, dz = position[j, 0] - mean[i, 0], position[j, 1] - mean[i, 1], position[j, 2] - mean[i, 2]
                squared, log_det = distance_and_log_det((dx, dy, dz), sum_of(covariance[i], noise[r]))
                log_density = -0.5 * (squared + log_det + 3.0 * LOG_TWO_PI) if squared <= likelihood.gate else -math.inf
                if boxes:
                    far, wide_det = distance_and_log_det((dx, dy, dz), blur(covariance[i], noise[r], wide))
                    if far <= likelihood.gate:
                        beside = likelihood.log_p_misplaced - 0.5 * (far + wide_det + 3.0 * LOG_TWO_PI)
                        log_density = max(log_density, beside)
                if dx * dx + dy * dy + dz * dz <= likelihood.moved_reach_m * likelihood.moved_reach_m:
                    log_density = max(log_density, likelihood.log_moved)
                if log_density == -math.inf:
                    continue
                ratio = log_density - likelihood.log_clutter
                ratio += class_log_ratio(class_p[i], likelihood.confusion, likelihood.class_prior, frame.class_id[j])
                ratio += appearance_log_ratio(
                    appearance[i], frame.appearance[j], likelihood.appearance_nats, likelihood.appearance_neutral
                )
                if boxes:
                    ratio += shape_log_ratio(
                        box[i], frame.box[j], frame.box_noise[j], likelihood.other_size, likelihood.p_misshapen
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


NOBODY = -1
"""No partner in an assignment."""


@kernel
def assign(start: IntArray, column: IntArray, cost: FloatArray, n_columns: int) -> IntArray:
    """Return the matching of least total cost; only pairs that cost less than 0 can be in it.

    Args:
        start: (N + 1,) first pair of every row.
        column: (E,) column of every pair, none twice in a row.
        cost: (E,) finite.
        n_columns: how many columns there are.

    Returns:
        (N,) pair of every row, or `NOBODY`.
    """
    n = start.shape[0] - 1
    pair_of_row = np.full(n, NOBODY, dtype=np.int64)
    row_of_column = np.full(n_columns, NOBODY, dtype=np.int64)
    price = np.zeros(n_columns)
    late = np.empty(n, dtype=np.int64)
    n_late = 0
    for i in range(n):  # a row takes its preferred column if that is free
        best, least = NOBODY, 0.0
        for e in range(start[i], start[i + 1]):
            if cost[e] < least:
                best, least = e, cost[e]
        if best == NOBODY:
            continue
        if row_of_column[column[best]] == NOBODY:
            row_of_column[column[best]] = i
            pair_of_row[i] = best
        else:
            late[n_late] = i
            n_late += 1
    if n_late == 0:
        return pair_of_row

    distance = np.full(n_columns, np.inf)
    via = np.empty(n_columns, dtype=np.int64)  # the pair that reaches a column
    via_row = np.empty(n_columns, dtype=np.int64)
    done = np.zeros(n_columns, dtype=np.bool_)
    reached = np.empty(n_columns, dtype=np.int64)
    for f in range(n_late):
        n_reached = 0
        row, so_far = late[f], 0.0
        alone_row, alone = row, 0.0  # the row for which staying alone ends the path, and that path's length
        target = NOBODY
        while True:
            for e in range(start[row], start[row + 1]):
                k = column[e]
                if done[k]:
                    continue
                length = so_far + cost[e] - price[k]
                if length < distance[k]:
                    if distance[k] == np.inf:
                        reached[n_reached] = k
                        n_reached += 1
                    distance[k], via[k], via_row[k] = length, e, row
            nearest, least = NOBODY, np.inf
            for r in range(n_reached):
                k = reached[r]
                if not done[k] and distance[k] < least:
                    nearest, least = k, distance[k]
            if alone <= least:
                least = alone
                break
            if row_of_column[nearest] == NOBODY:
                target = nearest
                break
            done[nearest] = True
            row = row_of_column[nearest]
            own = pair_of_row[row]
            so_far = least - (cost[own] - price[nearest])
            if so_far < alone:
                alone_row, alone = row, so_far
        for r in range(n_reached):
            k = reached[r]
            if done[k]:
                price[k] += distance[k] - least
        if target == NOBODY and alone_row != late[f]:
            target = column[pair_of_row[alone_row]]
            pair_of_row[alone_row] = NOBODY
        while target != NOBODY:  # back along the path: everybody moves on by one
            row = via_row[target]
            freed = NOBODY if pair_of_row[row] == NOBODY else column[pair_of_row[row]]
            pair_of_row[row] = via[target]
            row_of_column[target] = row
            target = NOBODY if row == late[f] else freed
        for r in range(n_reached):
            distance[reached[r]] = np.inf
            done[reached[r]] = False
    return pair_of_row
