"""Static and moving tracks, by all of their detections in successive time windows.

Over a window the velocity is a robust line through the detections, whose errors are alike for about a second: ten
detections of it are hardly more than two. That it stands is a special case, velocity zero but for what a detector
makes of a changing view; the ratio of the two densities is the Bayes factor (Dickey 1971).

A stay ended where its object was seen to move away. One that something hides as it leaves gets another track when it
is seen again: two bodies are never in one spot, so what turns up and moves within the room of a box, beside its place,
is that box.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evermap.config import StillConfig
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray

STRIDE_S = 0.3
"""From window to window, in time."""
HEAVY, ROUNDS = 2.0, 5
"""Standard deviations at which the weight of a detection falls, and reweightings of a line."""


class Stood(NamedTuple):
    """Static tracks and stays.

    Attributes:
        stay: (M,) number of the stay that each detection is of, `UNKNOWN` where its thing moves or nothing is known.
        p_static: (M,) probability that its thing stands at that time; nan where nothing is known.
        p_still: by track, probability that it stood, from its first detections to its last ones.
        track: (S,) of each stay.
        p_stay: (S,) probability of each stay.
        since_s, until_s: (S,) when it was seen to come to rest, and to leave; nan where it was not.
    """

    stay: IntArray
    p_static: FloatArray
    p_still: dict[int, float]
    track: IntArray
    p_stay: FloatArray
    since_s: FloatArray
    until_s: FloatArray


def join_stood(parts: Sequence[Stood], position_m: FloatArray, settings: StillConfig) -> Stood:
    """Return the same of successive detections (M,), at (M, 3): a track that stands where it stood goes on."""
    stay, p_still, rows, last = list[IntArray](), dict[int, float](), list[tuple[float, ...]](), dict[int, int]()
    place, begin = list[FloatArray](), 0
    for part in parts:
        new = np.full(len(part.track) + 1, UNKNOWN)  # the last is of no stay
        at = position_m[begin : begin + len(part.stay), :2]
        for k, (name, p, since_s, until_s) in enumerate(zip(*(column.tolist() for column in part[3:]), strict=True)):
            here, before = np.median(at[part.stay == k], axis=0), last.get(name, UNKNOWN)
            goes_on = before != UNKNOWN and np.isnan(since_s) and np.isnan(rows[before][3])
            if goes_on and np.linalg.norm(here - place[before]) < settings.same_m:
                rows[before] = name, max(p, rows[before][1]), rows[before][2], until_s
            else:
                last[name] = before = len(rows)
                rows.append((name, p, since_s, until_s))
                place.append(here)
            new[k] = before
        stay.append(new[part.stay])
        p_still |= {name: min(p, p_still.get(name, 1.0)) for name, p in part.p_still.items()}
        begin += len(part.stay)
    columns = np.array(rows, dtype=np.float64).reshape(-1, 4)
    p_static = np.concatenate([part.p_static for part in parts])
    return Stood(np.concatenate(stay), p_static, p_still, columns[:, 0].astype(np.int64), *columns[:, 1:].T)


def standing(
    stamp_s: FloatArray, position_m: FloatArray, range_m: FloatArray, box: FloatArray, track: IntArray,
    speed_mps: FloatArray, settings: StillConfig,
) -> Stood:  # fmt: skip
    """Return the static tracks and their stays.

    Args:
        stamp_s: (M,) of detections, in order of time.
        position_m: (M, 3) where they are in the world.
        range_m: (M,) how far away they were.
        box: (M, 4) length, width, height [m] and heading [rad].
        track: (M,) what they are of, or `UNKNOWN`.
        speed_mps: (M,) above which each moves.
        settings: of velocities, and how long a stay lasts.
    """
    stay, p_static = np.full(len(track), UNKNOWN), np.full(len(track), np.nan)
    p_still: dict[int, float] = {}
    rows: list[tuple[int, float, float, float]] = []
    sigma_m = settings.sigma_m + settings.sigma_share * range_m
    order = np.argsort(track, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(track[order])) + 1):
        if track[mine[0]] == UNKNOWN or not _enough(stamp_s[mine], settings):
            continue
        name, limit = int(track[mine[0]]), float(np.median(speed_mps[mine]))
        at, when, sigma = position_m[mine, :2], stamp_s[mine], sigma_m[mine]
        p_still[name] = _p_of(*_way(when, at, sigma, settings), limit, settings)
        p_static[mine] = _windows(when, at, sigma, limit, settings)
        parts = _stays(p_static[mine] > 0.5, when, at, settings)
        for part in parts:
            p = _p_static(when[part], at[part], sigma[part], limit, settings) if _enough(when[part], settings) else 0.0
            if p > settings.p_stands:
                stay[mine[part]] = len(rows)
                rows.append((name, p, *_ends(part, when, at, sigma, p_static[mine] < 0.5, settings)))
    columns = np.array(rows, dtype=np.float64).reshape(-1, 4)
    stood = Stood(stay, p_static, p_still, columns[:, 0].astype(np.int64), *columns[:, 1:].T)
    return _with_room_taken(stood, stamp_s, position_m[:, :2], sigma_m, box, track, settings)


def long_enough(stamp_s: FloatArray, track: IntArray, settings: StillConfig) -> IntArray:
    """Return (M,) tracks of detections (M,) in order of time, `UNKNOWN` where one is too short to have a velocity."""
    found = np.full(len(track), UNKNOWN)
    for one in np.unique(track[track != UNKNOWN]):
        mine = np.flatnonzero(track == one)
        found[mine] = one if _enough(stamp_s[mine], settings) else UNKNOWN
    return found


def _enough(stamp_s: FloatArray, settings: StillConfig) -> bool:
    return len(stamp_s) >= settings.fewest and float(stamp_s[-1] - stamp_s[0]) >= settings.least_s


def _windows(stamp_s: FloatArray, at: FloatArray, sigma: FloatArray, limit: float, settings: StillConfig) -> FloatArray:
    """Return the (K,) probability of being static, from the window around each detection."""
    half_s = 0.5 * settings.window_s
    if stamp_s[-1] - stamp_s[0] <= settings.window_s:
        return np.full(len(stamp_s), _p_static(stamp_s, at, sigma, limit, settings))
    middle = np.clip(STRIDE_S * np.round(stamp_s / STRIDE_S), stamp_s[0] + half_s, stamp_s[-1] - half_s)
    first = np.searchsorted(stamp_s, middle - half_s - 1e-6)
    last = np.searchsorted(stamp_s, middle + half_s + 1e-6)
    found: dict[tuple[int, int], float] = {}
    for ends in zip(first.tolist(), last.tolist(), strict=True):
        part = slice(*ends)
        if ends not in found:
            told = _enough(stamp_s[part], settings)
            found[ends] = 0.5 if not told else (_p_static(stamp_s[part], at[part], sigma[part], limit, settings))
    return np.array([found[ends] for ends in zip(first.tolist(), last.tolist(), strict=True)])


def _p_static(stamp_s: FloatArray, at: FloatArray, sigma: FloatArray, limit: float, settings: StillConfig) -> float:
    """Return the probability that an object seen at (K, 2) is static."""
    return _p_of(*_line(stamp_s, at, sigma, settings), limit, settings)


def _p_of(velocity: FloatArray, spread: float, limit: float, settings: StillConfig) -> float:
    """Return the probability that an object with a velocity (2,) of known variance is static; the prior is one half."""
    return float(1.0 / (1.0 + np.exp(-np.clip(_log_factor(velocity, spread, limit, settings), -700.0, 700.0))))


def _log_factor(velocity: FloatArray, spread: float, limit: float, settings: StillConfig) -> float:
    still, moving = (settings.still * limit) ** 2 + spread, (settings.moving * limit) ** 2 + spread
    return float(np.log(moving / still) - 0.5 * float(velocity @ velocity) * (1.0 / still - 1.0 / moving))


def log_factor_of_rest(
    stamp_s: FloatArray, at: FloatArray, sigma_m: FloatArray, limit_mps: float, settings: StillConfig
) -> float:
    """Return the log Bayes factor that what is detected at (K, 2) stands, over that it moves; 0 of too few."""
    if not _enough(stamp_s, settings):
        return 0.0
    return _log_factor(*_line(stamp_s, at, sigma_m, settings), limit_mps, settings)


def _way(stamp_s: FloatArray, at: FloatArray, sigma: FloatArray, settings: StillConfig) -> tuple[FloatArray, float]:
    """Return the mean velocity (2,) of a track from beginning to end, including stops, and its variance."""
    part = max(3, len(at) // 8)
    ends = slice(0, part), slice(-part, None)
    lasted_s = float(np.median(stamp_s[ends[1]]) - np.median(stamp_s[ends[0]]))
    if lasted_s <= 0.0:
        return _line(stamp_s, at, sigma, settings)
    velocity = (np.median(at[ends[1]], axis=0) - np.median(at[ends[0]], axis=0)) / lasted_s
    variance = sum(float(np.median(sigma[end])) ** 2 for end in ends)
    return velocity, variance / lasted_s**2


def _line(stamp_s: FloatArray, at: FloatArray, sigma: FloatArray, settings: StillConfig) -> tuple[FloatArray, float]:
    """Velocity (2,) of detections (K, 2), and its variance on each axis."""
    t = stamp_s - stamp_s[0]
    rate = max((len(t) - 1) / max(float(t[-1]), 1e-6), 1e-6)
    share = 1.0 / max(1.0, settings.alike_s * rate)
    weight = 1.0 / sigma**2
    velocity, curve = np.zeros(2), 1.0
    for _ in range(ROUNDS):
        mean_s, middle = weight @ t / weight.sum(), weight @ at / weight.sum()
        curve = float(weight @ (t - mean_s) ** 2)
        velocity = (weight * (t - mean_s)) @ (at - middle) / curve
        off = at - middle - (t - mean_s)[:, None] * velocity
        weight = 1.0 / (sigma**2 + (off**2).sum(axis=1) / HEAVY**2)
    return velocity, 1.0 / (share * curve)


def _stays(still: BoolArray, stamp_s: FloatArray, at: FloatArray, settings: StillConfig) -> list[IntArray]:
    """Return runs of static detections (K, 2); successive ones in one place are joined."""
    rows = np.flatnonzero(still)
    if not len(rows):
        return []
    found: list[IntArray] = []
    for part in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        if found and np.linalg.norm(np.median(at[part], axis=0) - np.median(at[found[-1]], axis=0)) < settings.same_m:
            found[-1] = np.concatenate([found[-1], part])
        elif _enough(stamp_s[part], settings):
            found.append(part)
    return found


def _with_room_taken(
    stood: Stood, stamp_s: FloatArray, at: FloatArray, sigma_m: FloatArray, box: FloatArray, track: IntArray,
    settings: StillConfig,
) -> Stood:  # fmt: skip
    """Return stays with ends that follow from what moves in their room shortly before, or after, they were seen.

    It is not the object at its place, misjudged, but beside it, and deeper in its room than errors explain. What was
    seen elsewhere meanwhile is another one.
    """
    since_s, until_s = stood.since_s.copy(), stood.until_s.copy()
    moves = np.flatnonzero(stood.p_static < 0.5)
    beyond_m = settings.sure_sigmas * sigma_m[moves]
    of = np.unique(track, return_inverse=True)[1].ravel()
    first_s, last_s = np.full(len(track), np.inf), np.full(len(track), -np.inf)
    np.minimum.at(first_s, of, stamp_s)
    np.maximum.at(last_s, of, stamp_s)
    for k in range(len(stood.track)):
        mine = np.flatnonzero(stood.stay == k)
        here, size_m = np.median(at[mine], axis=0), np.median(box[mine, :2], axis=0)
        axis = 0.5 * float(np.angle(np.exp(2j * box[mine, 3]).sum()))
        away_m = np.linalg.norm(at[moves] - here, axis=1)
        near = (away_m > settings.same_m + beyond_m) & (away_m < 0.5 * (size_m.sum() + box[moves, :2].sum(axis=1)))
        near &= track[moves] != stood.track[k]
        near[near] = _depth_m(at[moves[near]] - here, box[moves[near]], size_m, axis) > beyond_m[near]
        rows = moves[near]
        for ends, is_after in ((since_s, False), (until_s, True)):
            edge_s = float(stamp_s[mine[-1 if is_after else 0]])
            lag_s = np.abs(stamp_s[rows] - edge_s)
            apart = first_s[of[rows]] > edge_s if is_after else last_s[of[rows]] < edge_s
            within = rows[apart & (lag_s < settings.hidden_s)]
            if len(within) >= settings.fewest and np.isnan(ends[k]):
                ends[k] = 0.5 * (edge_s + float(stamp_s[within[0 if is_after else -1]]))
    return stood._replace(since_s=since_s, until_s=until_s)


def _depth_m(off_m: FloatArray, box: FloatArray, size_m: FloatArray, axis_rad: float) -> FloatArray:
    """Return by how much boxes (K, 4), off by (K, 2), overlap a rectangle of a size (2,) along an axis: the least shift
    that parts them, negative where they are apart (separating axes).
    """
    turn = box[:, 3] - axis_rad
    depth = np.full(len(box), np.inf)
    for along, own in ((np.full(len(box), axis_rad), True), (box[:, 3], False)):
        for k in (0, 1):
            way = along + 0.5 * np.pi * k
            gap = np.abs(off_m[:, 0] * np.cos(way) + off_m[:, 1] * np.sin(way))
            straight, across = (size_m[k], box[:, :2]) if own else (box[:, k], np.tile(size_m, (len(box), 1)))
            along_way, beside = across[:, k], across[:, 1 - k]
            half = 0.5 * (straight + along_way * np.abs(np.cos(turn)) + beside * np.abs(np.sin(turn)))
            depth = np.minimum(depth, half - gap)
    return depth


def _ends(
    part: IntArray, stamp_s: FloatArray, at: FloatArray, sigma: FloatArray, moves: BoolArray, settings: StillConfig
) -> tuple[float, float]:
    """Return begin and end of a stay of an object that was clearly elsewhere before and after; nan otherwise.

    What moves (K,) is elsewhere as soon as errors do not explain where it is.
    """
    here, found = np.median(at[part], axis=0), [np.nan, np.nan]
    least_m = np.where(moves, settings.same_m + settings.sure_sigmas * sigma, np.inf)
    beyond_m = np.linalg.norm(at - here, axis=1) - np.minimum(least_m, settings.elsewhere_m)
    for k, (outside, beside) in enumerate(((slice(0, part[0]), part[0] - 1), (slice(part[-1] + 1, None), part[-1]))):
        fewest, away_m = settings.fewest, beyond_m[outside]
        if len(away_m) >= fewest and float(np.median(np.sort(away_m)[-fewest:])) > 0.0:
            found[k] = 0.5 * float(stamp_s[beside] + stamp_s[beside + 1])
    return found[0], found[1]
