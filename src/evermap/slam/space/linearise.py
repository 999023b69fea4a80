"""Odometry and detections in space, linearised and whitened, in the layout of `estimate.sparse`; compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from evermap.compiled import kept
from evermap.estimate.robust import HEAVY_TAIL, weigh
from evermap.slam.kernels3d import (
    axis_residual,
    matrix_of,
    nearest_turn,
    odometry_residual,
    point_residual,
    pose_residual,
    retract,
    turn_vector,
    turn_vector_back,
)
from evermap.types import BoolArray, FloatArray, IntArray

POINT, POSE, CORNERS = 0, 1, 2
"""What a detection gives: a position, a position and an orientation, or the corners of a tag in an image."""
ROWS = np.array([3, 6, 8])
"""Residuals of each."""
MOUNT, STATES = 6, 7
"""Numbers of a sensor's calibration: a twist of its mount; and by how much its stamps are late."""
OF_SIGHTING = 14
"""Numbers of a row of a detection beside those by its place: by its pose, its sensor, and the right side."""
OF_STEP = 14
"""Numbers of a row of an odometry factor: by two poses, its scale and the right side."""
TRANSLATION, ROTATION, ACROSS, ALONG, ORIENTATION, PIXEL = range(6)
"""Rows of the noise levels."""
BEHIND = 0.02
"""A corner must be this far ahead of the camera [m]; of one that is not nothing can be said."""
JUMP_SHARE = 1e-4
"""Information of odometry that jumped, as a share of what it has else: it may be wrong by a hundred times as much."""

kernel = kept(effort=3, error_model="numpy")


class SpatialSightings(NamedTuple):
    """M detections as the kernel reads them; see `SpatialProblem` for those of its attributes.

    Attributes:
        oriented: (M,) 1 where the place has an orientation, 0 of points.
        root: (M, 3, 3) whitens the position but for the noise levels: rows across the line of sight, then along it.
        corner: (M, 4, 2) corners at depth 1.
        corner_root: (M, 4, 2, 2) pixels by these.
        half_m: (M,) half of the tag's edge.
        first: (M + 1,) where the values of each begin, counted from the first detection.
        log_odds: (3,) of each kind, beyond which half of the squared residual makes an outlier.
        symmetry: (M,) row of the turns after which the place looks the same; 0 without any.
        axis: (K,) axes about which any turn does, of these; -1 without.
        first_turn: (K + 1,) rows of `turns` of each.
        turns: (T, 4) quaternions.
    """

    pose_row: IntArray
    place: IntArray
    sensor: IntArray
    kind: IntArray
    oriented: IntArray
    measured: FloatArray
    root: FloatArray
    sigma_rad: FloatArray
    corner: FloatArray
    corner_root: FloatArray
    half_m: FloatArray
    first: IntArray
    share: FloatArray
    log_odds: FloatArray
    symmetry: IntArray
    axis: IntArray
    first_turn: IntArray
    turns: FloatArray
    ray: BoolArray


@kernel
def linearise_odometry(
    pose: FloatArray, increment: FloatArray, log_scale: float, steps: IntArray, lever: FloatArray, axes: FloatArray,
    sigma: FloatArray, log_odds: float, heavy: bool, values: FloatArray, weight: FloatArray,
) -> float:  # fmt: skip
    """Linearise the odometry between consecutive poses.

    Args:
        pose: (N, 7) poses.
        increment: (N - 1, 7) measured motions.
        log_scale: logarithm of true over measured distances. It divides the true ones: multiplied by it, those that are
            measured would be found too long by their noise (errors in variables).
        steps: (N - 1,) of each; this, `lever` and `axes` are those of `Swing`.
        lever: (N - 1, 3) of the rotation's noise.
        axes: (N - 1, 3, 3) along which the translation's noise is independent.
        sigma: (N - 1, 6) their standard deviations: of translations along the axes, given the rotation, and of this.
        log_odds: beyond which half of the squared residual makes a jump of the odometry.
        heavy: tails that never let go, while the estimate may be far off.
        values: filled in: 6 rows by two poses, the scale and the right side each.
        weight: (N - 1,) filled in.

    Returns:
        Negative log likelihood, up to a constant.
    """
    e, j1, j2, ahead = np.zeros(6), np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(3)
    cost, at, shrunk, measured = 0.0, 0, math.exp(-log_scale), pose.copy()
    measured[:, :3] *= shrunk
    for i in range(len(increment)):
        odometry_residual(measured[i], measured[i + 1], increment[i], e, j1, j2)
        r = matrix_of(pose[i])
        for a in range(3):
            ahead[a] = 0.0
            for b in range(3):
                ahead[a] += r[3 * b + a] * (pose[i + 1, b] - pose[i, b])
        for a in range(6):
            for b in range(3):
                j1[a, b] *= shrunk
                j2[a, b] *= shrunk
        if steps[i] > 1:
            _swung(lever[i], axes[i], e, j1, j2)
        squared = 0.0
        for a in range(6):
            squared += (e[a] / sigma[i, a]) ** 2
        weight[i], loss = weigh(squared, log_odds, 6.0 * HEAVY_TAIL if heavy else 0.0, JUMP_SHARE)
        cost += loss
        for a in range(6):
            scale = math.sqrt(weight[i]) / sigma[i, a]
            for b in range(6):
                values[at + b] = scale * j1[a, b]
                values[at + 6 + b] = scale * j2[a, b]
            # a shorter motion leaves what its first pose leaves that is so much farther ahead
            values[at + 12] = scale * (j1[a, 0] * ahead[0] + j1[a, 1] * ahead[1] + j1[a, 2] * ahead[2])
            values[at + 13] = -scale * e[a]
            at += 14
    return cost


@kernel
def _swung(lever: FloatArray, axes: FloatArray, e: FloatArray, j1: FloatArray, j2: FloatArray) -> None:
    """Replace translations of a residual (6,) and its Jacobians by what the rotation leaves of them, along axes."""
    left = np.zeros(3)
    for column in range(13):
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            if column < 6:
                left[a] = j1[a, column] - lever[b] * j1[3 + c, column] + lever[c] * j1[3 + b, column]
            elif column < 12:
                left[a] = j2[a, column - 6] - lever[b] * j2[3 + c, column - 6] + lever[c] * j2[3 + b, column - 6]
            else:
                left[a] = e[a] - lever[b] * e[3 + c] + lever[c] * e[3 + b]
        for a in range(3):
            along = axes[0, a] * left[0] + axes[1, a] * left[1] + axes[2, a] * left[2]
            if column < 6:
                j1[a, column] = along
            elif column < 12:
                j2[a, column - 6] = along
            else:
                e[a] = along


@kernel
def linearise_sightings(
    pose: FloatArray, place: FloatArray, mount: FloatArray, back: FloatArray, by_delay: FloatArray, level: FloatArray,
    seen: SpatialSightings, heavy: bool, values: FloatArray, weight: FloatArray, residual: FloatArray,
) -> float:  # fmt: skip
    """Linearise the detections.

    Args:
        pose: (N, 7) poses.
        place: (P, 7) places; of points the orientation is not looked at.
        mount: (S, 7) poses of the sensors on the robot.
        back: (S, N, 6) twist from each pose to that at which a detection was made, before its stamp.
        by_delay: (S, N, 6) derivative of the latter, a twist there, by how late the stamp is.
        level: (6,) noise levels.
        seen: the detections.
        heavy: tails that never let go, while the estimate may be far off.
        values: filled in: rows of each by its pose, place, sensor and the right side.
        weight: (M,) filled in.
        residual: (M, 8) filled in, whitened, but not weighted.

    Returns:
        Negative log likelihood, up to a constant.
    """
    e, jx, jl, jm = np.zeros(8), np.zeros((8, 6)), np.zeros((8, 6)), np.zeros((8, 6))
    cost, here, moved, still = 0.0, np.zeros(7), np.zeros(7), np.zeros(7)
    still[6] = 1.0
    for m in range(len(seen.kind)):
        kind, i, p, s = seen.kind[m], seen.pose_row[m], seen.place[m], seen.sensor[m]
        dim = 6 if seen.oriented[m] else 3
        here[:] = pose[i]
        late = np.any(back[s, i] != 0.0)
        if late:
            retract(pose[i], back[s, i], here)
            retract(still, back[s, i], moved)
        if kind == CORNERS:
            rows = 8
            _corners(here, place[p], mount[s], seen, m, level[PIXEL], e, jx, jl, jm)
        else:
            rows = 6 if kind == POSE else 3
            _position_or_pose(here, place[p], mount[s], seen, m, level, e, jx, jl, jm)
        squared = 0.0
        for a in range(rows):
            squared += e[a] * e[a]
            residual[m, a] = e[a]
        weight[m], loss = weigh(squared, seen.log_odds[kind], rows * HEAVY_TAIL if heavy else 0.0, 0.0)
        cost += seen.share[m] * loss
        scale, at = math.sqrt(weight[m] * seen.share[m]), seen.first[m]
        for a in range(rows):
            of_delay = 0.0
            for b in range(6):
                of_delay += jx[a, b] * by_delay[s, i, b]
            if late:
                _before_moving(jx[a], moved)
            for b in range(6):
                values[at + b] = scale * jx[a, b]
                values[at + 6 + dim + b] = scale * jm[a, b]
            for b in range(dim):
                values[at + 6 + b] = scale * jl[a, b]
            values[at + 12 + dim] = scale * of_delay
            values[at + 13 + dim] = -scale * e[a]
            at += 14 + dim
    return cost


@kernel
def _before_moving(row: FloatArray, moved: FloatArray) -> None:
    """Turn derivatives (6,) by a twist after a motion (7,) into those by a twist before it, in place."""
    r, (x, y, z), (u, v, w) = matrix_of(moved), (row[0], row[1], row[2]), (row[3], row[4], row[5])
    for b in range(3):
        row[b] = x * r[3 * b] + y * r[3 * b + 1] + z * r[3 * b + 2]
        row[3 + b] = u * r[3 * b] + v * r[3 * b + 1] + w * r[3 * b + 2]
    row[3] -= row[1] * moved[2] - row[2] * moved[1]
    row[4] -= row[2] * moved[0] - row[0] * moved[2]
    row[5] -= row[0] * moved[1] - row[1] * moved[0]


@kernel
def _position_or_pose(
    pose: FloatArray, place: FloatArray, mount: FloatArray, seen: SpatialSightings, m: int, level: FloatArray,
    e: FloatArray, jx: FloatArray, jl: FloatArray, jm: FloatArray,
) -> None:  # fmt: skip
    """Whitened residuals and Jacobians of a position, or of a position and an orientation."""
    symmetry = seen.symmetry[m]
    if seen.oriented[m] and seen.kind[m] == POSE and symmetry > 0:
        axis, nearest = seen.axis[symmetry], np.empty(7)
        turns = seen.turns[seen.first_turn[symmetry] : seen.first_turn[symmetry + 1]]
        nearest_turn(pose, place, mount, seen.measured[m], axis, turns, nearest)
        if axis >= 0:
            axis_residual(pose, place, mount, nearest, axis, e, jx, jl, jm)
        else:
            pose_residual(pose, place, mount, nearest, e, jx, jl, jm)
    elif seen.oriented[m]:
        pose_residual(pose, place, mount, seen.measured[m], e, jx, jl, jm)
    else:
        point_residual(pose, place, mount, seen.measured[m], e, jx, jl, jm)
    if seen.ray[m]:
        _by_range(seen.measured[m], e, jx, jl, jm)
    _whiten_rows(seen.root[m], level, e.reshape(8, 1))
    for part in (jx, jl, jm):
        _whiten_rows(seen.root[m], level, part)
    if seen.kind[m] == POSE:
        factor = 1.0 / (level[ORIENTATION] * seen.sigma_rad[m])
        for a in range(3, 6):
            e[a] *= factor
            for b in range(6):
                jx[a, b] *= factor
                jl[a, b] *= factor
                jm[a, b] *= factor


@kernel
def _by_range(measured: FloatArray, e: FloatArray, jx: FloatArray, jl: FloatArray, jm: FloatArray) -> None:
    """Scale the residual of a position by its measured over its predicted range, in place.

    The range of a direction is a triangulated one, from which its noise in metres was made. By that alone, everything
    would fit better the nearer it is.
    """
    x, y, z = measured[0] - e[0], measured[1] - e[1], measured[2] - e[2]
    r = max(math.sqrt(x * x + y * y + z * z), BEHIND)
    factor = math.sqrt(measured[0] ** 2 + measured[1] ** 2 + measured[2] ** 2) / r
    for part in (jx, jl, jm):
        for b in range(6):
            longer = (x * part[0, b] + y * part[1, b] + z * part[2, b]) / (r * r)
            for a in range(3):
                part[a, b] = factor * (part[a, b] + e[a] * longer)
    for a in range(3):
        e[a] *= factor


@kernel
def _whiten_rows(root: FloatArray, level: FloatArray, rows: FloatArray) -> None:
    """Whiten the first three of some rows, in place."""
    for b in range(rows.shape[1]):
        x, y, z = rows[0, b], rows[1, b], rows[2, b]
        for a in range(3):
            sigma = level[ALONG] if a == 2 else level[ACROSS]
            rows[a, b] = (root[a, 0] * x + root[a, 1] * y + root[a, 2] * z) / sigma


@kernel
def _corners(
    pose: FloatArray, place: FloatArray, mount: FloatArray, seen: SpatialSightings, m: int, sigma_px: float,
    e: FloatArray, jx: FloatArray, jl: FloatArray, jm: FloatArray,
) -> None:  # fmt: skip
    """Residuals (8,) of four corners of a tag, in standard deviations, with their Jacobians (8, 6)."""
    into, onto, r = matrix_of(pose), matrix_of(mount), matrix_of(place)
    for k in range(4):
        x, y = seen.half_m[m] * (-1.0, 1.0, 1.0, -1.0)[k], seen.half_m[m] * (-1.0, -1.0, 1.0, 1.0)[k]
        f, g, h = turn_vector(r, x, y, 0.0)
        f, g, h = turn_vector_back(into, place[0] + f - pose[0], place[1] + g - pose[1], place[2] + h - pose[2])
        px, py, pz = turn_vector_back(onto, f - mount[0], g - mount[1], h - mount[2])
        for a in range(2):
            row = 2 * k + a
            e[row] = 0.0
            for b in range(6):
                jx[row, b] = jl[row, b] = jm[row, b] = 0.0
        if pz < BEHIND:
            for a in range(2):
                e[2 * k + a] = 1e3
            continue
        u, v = px / pz, py / pz
        for a in range(2):
            row = 2 * k + a
            w0, w1 = seen.corner_root[m, k, a, 0] / sigma_px, seen.corner_root[m, k, a, 1] / sigma_px
            e[row] = w0 * (seen.corner[m, k, 0] - u) + w1 * (seen.corner[m, k, 1] - v)
            # minus the derivatives of the residual by the point, in the frames of the sensor, the robot and the tag
            d0, d1, d2 = w0 / pz, w1 / pz, -(w0 * u + w1 * v) / pz
            b0, b1, b2 = turn_vector(onto, d0, d1, d2)
            t0, t1, t2 = turn_vector_back(r, *turn_vector(into, -b0, -b1, -b2))
            jm[row, 0], jm[row, 1], jm[row, 2] = d0, d1, d2
            jm[row, 3], jm[row, 4], jm[row, 5] = d2 * py - d1 * pz, d0 * pz - d2 * px, d1 * px - d0 * py
            jx[row, 0], jx[row, 1], jx[row, 2] = b0, b1, b2
            jx[row, 3], jx[row, 4], jx[row, 5] = b2 * g - b1 * h, b0 * h - b2 * f, b1 * f - b0 * g
            jl[row, 0], jl[row, 1], jl[row, 2] = t0, t1, t2
            # a turn of the tag by w moves the corner by w x c, with c = (x, y, 0)
            jl[row, 3], jl[row, 4], jl[row, 5] = t2 * y, -t2 * x, t1 * x - t0 * y
