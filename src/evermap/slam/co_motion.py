"""Landmarks that move while the robot drives, and those that move together, by where the odometry has them.

Within seconds an odometry is good, and most landmarks stand: how far these seem to move is the measure of its errors
and of the sensor's. What moves far beyond, for seconds, moves; two that do, in view together and always at one
distance, are on one body: two bodies would have to go the same way by chance, which is the less probable the longer the
way over the error of a distance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.config import Config, SpaceConfig, StillConfig
from evermap.geometry import se2, se3
from evermap.slam.pairs import reckon_drive
from evermap.tracking.frame import mounts_of
from evermap.tracking.standing import log_factor_of_rest
from evermap.types import UNKNOWN, AnyRecording, BoolArray, FloatArray, IntArray, is_in_space

LAG_S = 1.5
"""Time between two looks at a landmark by which it is suspected to move."""
SIGMA_M, SIGMA_SHARE = 0.03, 0.01
"""Error of a detection's position, at no range [m] and as a share of it, at least."""
USUAL = 1.18
"""Median length of what has two normal components, over their standard deviation."""
SUSPECT, FEWEST = 3.0, 5
"""Standard deviations that it moves in the time, and looks that show it."""
MOVES = 3.0
"""Nats by which a window must say that a landmark moves."""
OFTEN = 0.15
"""Share of the looks at a landmark in which it moves, at least: wrong identities move for a moment."""
MOST_MOVE = 0.5
"""Share of the landmarks in view that may move, of those that are seen to move or to stand: where more seem to, the
odometry is wrong.
"""
LEAST_M = 0.02
"""Error of a position that says what it is, at least [m]."""
APART, FEWEST_COMMON = 0.15, 5
"""Share of the looks at two landmarks that show another distance between them, from which they are on no one body; and
looks that it takes.
"""
TURN_RAD, MOST_NATS = 0.05, 20.0
"""Error of the axes of a landmark, and nats by which it may stand, at most."""
BODY_M = 3.0
"""Distance of landmarks on one body, standard deviation."""
SURELY = 3.0
"""Standard deviations of another distance."""


class Reckoned(NamedTuple):
    """Detections (N,) of landmarks with identities, in order of landmark and time.

    Attributes:
        landmark_id, stamp_s: of each.
        frame: of the recording.
        row: of its detections.
        at: (N, D) in the frame of the odometry.
        sigma_m: (N,) error of that over `LAG_S`.
        own: (N, D) on the robot.
        noise_m: (N,) error of that.
        turn: (N, D, D) axes of the landmark on the robot; nan where they are not seen.
    """

    landmark_id: IntArray
    stamp_s: FloatArray
    frame: IntArray
    row: IntArray
    at: FloatArray
    sigma_m: FloatArray
    own: FloatArray
    noise_m: FloatArray
    turn: FloatArray


class Movers(NamedTuple):
    """Landmarks that are seen to move.

    Attributes:
        landmark_id: (K,) in order.
        nats: (K,) by which looks say so.
        seen: sightings of all landmarks.
        factor: (N,) nats for that a landmark stands then, over that it moves.
        moves: (N,) whether it does.
    """

    landmark_id: IntArray
    nats: FloatArray
    seen: Reckoned
    factor: FloatArray
    moves: BoolArray


def locate_by_odometry(recording: AnyRecording, settings: SpaceConfig) -> Reckoned | None:
    """Return where the odometry has detections of landmarks; None without one."""
    odometry, seen = recording.odometry, recording.detections
    if odometry is None or len(odometry) < 2:
        return None
    stamp_s = recording.frames.stamp_s[seen.frame]
    usable = (seen.landmark_id != UNKNOWN) & (stamp_s >= odometry.stamp_s[0]) & (stamp_s <= odometry.stamp_s[-1])
    if is_in_space(recording):
        from evermap.slam.space.intake import without_range

        usable &= np.isfinite(recording.detections.position_sensor_m).all(axis=1) & ~without_range(recording)
        usable &= ~np.isfinite(recording.detections.size_m).all(axis=1)
    else:
        usable &= np.isfinite(recording.detections.range_m) & np.isfinite(recording.detections.bearing_rad)
    rows = np.flatnonzero(usable)
    rows = rows[np.lexsort((stamp_s[rows], seen.landmark_id[rows]))]
    if is_in_space(recording):
        assert recording.odometry is not None
        pose = se3.interpolate(recording.odometry.stamp_s, recording.odometry.pose_world_robot, stamp_s[rows])
        own = se3.transform(mounts_of(recording)[rows], recording.detections.position_sensor_m[rows])
        at = se3.transform(pose, own)
    else:
        track = reckon_drive(recording.odometry, 1.0, 1.0, 1.0, exchanged=False)
        pose = np.column_stack([np.interp(stamp_s[rows], odometry.stamp_s, column) for column in track.T])
        range_m, bearing = recording.detections.range_m[rows], recording.detections.bearing_rad[rows]
        local = range_m[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
        own = se2.transform(np.array(recording.sensor.mount_robot_sensor), local)
        at = se2.transform(pose, own)
    range_m = np.linalg.norm(own, axis=1)
    drift_m = np.sqrt(LAG_S) * np.hypot(settings.drift_m, settings.drift_rad * range_m)
    noise_m, turn = SIGMA_M + SIGMA_SHARE * range_m, np.full((len(rows), at.shape[1], at.shape[1]), np.nan)
    if is_in_space(recording):
        stated = np.sqrt(np.trace(recording.detections.covariance_sensor_m2[rows], axis1=1, axis2=2) / 3.0)
        noise_m = np.where(np.isfinite(stated), np.maximum(stated, LEAST_M), noise_m)
        pose = np.hstack([np.zeros((len(rows), 3)), recording.detections.rotation[rows]])
        known = np.isfinite(pose).all(axis=1)
        turn[known] = se3.rotation_of(se3.compose(mounts_of(recording)[rows[known]], pose[known]))
    sigma_m = np.hypot(noise_m, drift_m)
    return Reckoned(seen.landmark_id[rows], stamp_s[rows], seen.frame[rows], rows, at, sigma_m, own, noise_m, turn)


def find_movers(found: Reckoned, config: Config) -> Movers | None:
    """Return landmarks that move in view, by all sightings of a recording; None where there are none."""
    still = config.track.still
    if not len(found.stamp_s):
        return None
    earlier, later = _pair_looks(found)
    if not len(earlier):
        return None
    moved = np.linalg.norm(found.at[later, :2] - found.at[earlier, :2], axis=1) / found.sigma_m[earlier]
    found = found._replace(sigma_m=max(1.0, float(np.median(moved)) / USUAL) * found.sigma_m)
    moved /= max(1.0, float(np.median(moved)) / USUAL)
    names, count = np.unique(found.landmark_id[earlier[moved > SUSPECT]], return_counts=True)
    suspects = names[count >= FEWEST]
    known = np.unique(found.landmark_id)
    if not len(suspects) or len(suspects) > MOST_MOVE * len(known):
        return None
    factor, limit_mps = np.zeros(len(found.stamp_s)), config.slam.space.bodies.limit_mps
    beside = np.unique(found.landmark_id[_is_near(found, np.isin(found.landmark_id, suspects), still.window_s)])
    for one in beside.tolist():
        mine = slice(*np.searchsorted(found.landmark_id, [one, one + 1]))
        factor[mine] = _weigh_windows(found.stamp_s[mine], found.at[mine, :2], found.sigma_m[mine], limit_mps, still)
    moves = (factor < -MOVES) & ~_is_in_doubt(found, factor, still.window_s)
    names, count = np.unique(found.landmark_id[moves], return_counts=True)
    looks = np.searchsorted(found.landmark_id, names, "right") - np.searchsorted(found.landmark_id, names)
    names = names[np.isin(names, suspects) & (count >= np.maximum(FEWEST, OFTEN * looks))]
    if not len(names):
        return None
    moves &= np.isin(found.landmark_id, names)
    row = np.searchsorted(names, found.landmark_id[moves])
    nats = np.array(
        [-_add_windows(found.stamp_s[moves][row == k], factor[moves][row == k], still) for k in range(len(names))]
    )
    return Movers(names, nats, found, factor, moves)


def _add_windows(stamp_s: FloatArray, factor: FloatArray, settings: StillConfig) -> float:
    """Return the sum of log Bayes factors (K,) of windows that do not overlap."""
    window = np.floor(stamp_s / settings.window_s)
    return sum(float(np.median(factor[window == one])) for one in np.unique(window))


def _pair_looks(found: Reckoned) -> tuple[IntArray, IntArray]:
    """Rows of looks at a landmark, and of those at it about `LAG_S` later."""
    _, row = np.unique(found.landmark_id, return_inverse=True)
    since_s = found.stamp_s - found.stamp_s.min()
    key = row * (since_s.max() + 4.0 * LAG_S) + since_s
    later = np.searchsorted(key, key + LAG_S)
    earlier = np.flatnonzero(later < len(key))
    earlier = earlier[key[later[earlier]] - key[earlier] <= 2.0 * LAG_S]
    return earlier, later[earlier]


def _weigh_windows(
    stamp_s: FloatArray, at: FloatArray, sigma_m: FloatArray, limit_mps: float, settings: StillConfig
) -> FloatArray:
    """(K,) log Bayes factors that a landmark stands, over that it moves, in the window around each look."""
    half_s = 0.5 * settings.window_s
    first = np.searchsorted(stamp_s, stamp_s - half_s - 1e-6)
    last = np.searchsorted(stamp_s, stamp_s + half_s + 1e-6)
    return np.array(
        [
            log_factor_of_rest(stamp_s[i:j], at[i:j], sigma_m[i:j], limit_mps, settings)
            for i, j in zip(first.tolist(), last.tolist(), strict=True)
        ]
    )


def _is_near(found: Reckoned, some: BoolArray, window_s: float) -> BoolArray:
    """(N,) looks within half a window of some."""
    at_s = np.sort(found.stamp_s[some])
    first = np.searchsorted(at_s, found.stamp_s - 0.5 * window_s)
    return np.searchsorted(at_s, found.stamp_s + 0.5 * window_s, "right") > first


def _is_in_doubt(found: Reckoned, factor: FloatArray, window_s: float) -> BoolArray:
    """(N,) looks around which so many landmarks seem to move, of those that are seen to move or to stand, that the
    odometry may be wrong: without any that stands, it is as probable as a motion.

    What is seen to stand until then, or from then on, says nothing of the odometry between.
    """
    moves, stands = factor < -MOVES, factor > 0.0
    doubt = np.zeros(len(moves), dtype=np.bool_)
    order = np.argsort(found.stamp_s, kind="stable")
    stamp_s = found.stamp_s[order]
    for row in np.flatnonzero(moves).tolist():
        at_s = found.stamp_s[row]
        first, since, until, last = np.searchsorted(
            stamp_s, [at_s - 0.5 * window_s, at_s, np.nextafter(at_s, np.inf), at_s + 0.5 * window_s]
        )
        moving = np.unique(found.landmark_id[order[first:last]][moves[order[first:last]]])
        before, after = order[first:until], order[since:last]
        standing = np.intersect1d(found.landmark_id[before[stands[before]]], found.landmark_id[after[stands[after]]])
        standing = np.setdiff1d(standing, moving)
        doubt[row] = len(moving) > MOST_MOVE * (len(moving) + len(standing))
    return doubt


def pair_movers(movers: Movers, prior: float, settings: StillConfig) -> tuple[IntArray, FloatArray]:
    """Return pairs (P, 2) of landmarks that move together, and the probability of each that they are on one body.

    Args:
        movers: of the recording; the second of a pair need not be one by itself.
        prior: probability of two in view at once.
        settings: of windows.
    """
    seen, pairs, probability = movers.seen, list[tuple[int, int]](), list[float]()
    names = np.unique(seen.landmark_id)
    span = {one: slice(*np.searchsorted(seen.landmark_id, [one, one + 1])) for one in names.tolist()}
    for one in movers.landmark_id.tolist():
        first = np.arange(span[one].start, span[one].stop)[movers.moves[span[one]]]
        for other, rows in span.items():
            _, a, b = np.intersect1d(seen.frame[first], seen.frame[rows], return_indices=True)
            if other == one or len(a) < FEWEST_COMMON:
                continue
            i, j = first[a], rows.start + b
            error_m, off_m, known = compare_rigidly(seen, i, j)
            if np.mean(off_m > SURELY * error_m) > APART:
                continue
            way_m = float(np.linalg.norm(np.ptp(seen.at[i], axis=0)))
            by_chance = known * np.log(max(way_m / (SURELY * float(np.median(error_m))), 1.0))
            near = -0.5 * (np.median(np.linalg.norm(seen.own[j] - seen.own[i], axis=1)) / BODY_M) ** 2
            moves = np.clip(-_add_windows(seen.stamp_s[j], movers.factor[j], settings), -MOST_NATS, MOVES)
            pairs.append((one, other))
            probability.append(1.0 / (1.0 + (1.0 - prior) / prior * np.exp(-by_chance - near - moves)))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2), np.array(probability)


def compare_rigidly(seen: Reckoned, one: IntArray, other: IntArray) -> tuple[FloatArray, FloatArray, int]:
    """Return (K,) errors of, and (K,) deviations of the second landmark's position from its usual one by the first's
    axes, of sightings (K,) at the same instants; and how many coordinates along the floor that fixes.

    Without axes it is the distance that is compared.
    """
    error_m, apart = np.hypot(seen.noise_m[one], seen.noise_m[other]), seen.own[other] - seen.own[one]
    axes, known = seen.turn[one], 2
    away_m = np.linalg.norm(apart, axis=1)
    if np.isfinite(axes).all():
        apart = np.einsum("nji,nj->ni", axes, apart)
        error_m = np.hypot(error_m, TURN_RAD * away_m)
    else:
        apart, known = away_m[:, None], 1
    return error_m, np.linalg.norm(apart - np.median(apart, axis=0), axis=1), known
