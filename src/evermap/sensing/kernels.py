"""One look at all cliques, compiled: expected detections, evidence on each clique, and learning.

The cost of a landmark is the rotation into the sensor's frame, two table look-ups and two divisions; logarithms are
taken of products of many ratios at a time.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from evermap.compiled import kept
from evermap.types import BoolArray, FloatArray, IntArray

HIGHEST = 0.98
"""No landmark is detected with more than this: a model that is certain cannot learn that it is wrong."""
OUT_OF_FIELD = 0.01
"""Probability of being in the field below which a look says nothing."""
FAR_OUT = 5.0
"""Standard deviations from an edge beyond which it is not looked at."""
EXPONENT = 600.0
"""Cut of log likelihood ratios: far from what a double holds, and certain either way."""

kernel = kept(error_model="numpy", fastmath={"contract"})
exact = kept(error_model="numpy")
"""Without contractions: the same probability whichever kernel asks."""
inlined = kept(error_model="numpy", fastmath={"contract"}, forceinline=True)


@inlined
def normal_cdf(z: float) -> float:
    """Return `P(x < z)` of a standard normal."""
    if z > FAR_OUT:
        return 1.0
    if z < -FAR_OUT:
        return 0.0
    return 0.5 * math.erfc(-z * 0.7071067811865476)


@inlined
def edge_distance(along: float, across: float, sine: float, cosine: float) -> float:
    """Return how far inside the edge of half an angle a point lies; behind the apex it is the apex that is nearest."""
    distance = along * sine - across * cosine
    if along * cosine + across * sine < 0.0:
        return math.copysign(math.sqrt(along * along + across * across), distance)
    return distance


@inlined
def in_field(x: float, y: float, z: float, range_m: float, limits: tuple[float, ...]) -> float:
    """Return the probability that a point of the sensor's frame is in the field; `limits` as `learned` packs them."""
    range_max, sin_az, cos_az, sin_el, cos_el, spherical, all_around, sigma_m, sigma_rad = limits
    inside = normal_cdf((range_max - range_m) / sigma_m)
    if inside < OUT_OF_FIELD:
        return 0.0
    ahead = math.sqrt(x * x + y * y) if spherical > 0.0 else x
    spread = math.sqrt(sigma_m * sigma_m + range_m * range_m * sigma_rad * sigma_rad)
    inside *= normal_cdf(edge_distance(ahead, abs(z), sin_el, cos_el) / spread)
    if all_around == 0.0:
        inside *= normal_cdf(edge_distance(x, abs(y), sin_az, cos_az) / spread)
    return inside


@inlined
def face_of(x: float, y: float, z: float) -> int:
    """Return which of the six faces of a cube a direction goes through."""
    a, b, c = abs(x), abs(y), abs(z)
    if a >= b and a >= c:
        return 0 if x > 0.0 else 1
    if b >= c:
        return 2 if y > 0.0 else 3
    return 4 if z > 0.0 else 5


@inlined
def between(value: float, count: int) -> tuple[int, float]:
    """Return the middle below `value`, in units of bins from the first one's lower edge, and how far it is to the
    next.
    """
    shifted = value - 0.5
    if shifted <= 0.0:
        return 0, 0.0
    low = int(shifted)
    if low >= count - 1:
        return count - 2, 1.0
    return low, shifted - low


@inlined
def interpolated(rate: Any, low: Any, part: Any) -> Any:
    """Return a rate between the middles of two bins."""
    return rate[low] + part * (rate[low + 1] - rate[low])


class SensorFrame(NamedTuple):
    """A pose of the sensor: position and rotation to the world, by rows, as numbers; limits as `learned` packs them.

    Numbers, not arrays: those a compiler would load again for every landmark, since others are written to meanwhile.
    """

    position_m: tuple[float, ...]
    rotation: tuple[float, ...]
    limits: tuple[float, ...]


class SensorLaw(NamedTuple):
    """Profile data of the kernels; names as in `profile.Profile` and `profile.Occlusion`."""

    range_rate: FloatArray
    facing_rate: FloatArray
    p_false: float
    come_hz: FloatArray
    go_hz: FloatArray
    log_weight: FloatArray


class LandmarkRows(NamedTuple):
    """Landmarks, names as in `learned.LearnedDetection`; hits and expected hits are changed in place."""

    landmark_m: FloatArray
    outward: FloatArray
    hits: Any
    expected: Any


class CliqueRows(NamedTuple):
    """Cliques, names as in `learned.LearnedDetection`; all but the first are changed in place."""

    first: IntArray
    occluded: FloatArray
    log_chain: FloatArray
    pending: FloatArray


class FrameSeen(NamedTuple):
    """Detections of a frame.

    Attributes:
        detected: (K,) which landmarks were detected.
        active: (C,) which cliques are looked at.
        elapsed_s: (C,) since each was last in the field.
    """

    detected: BoolArray
    active: BoolArray
    elapsed_s: FloatArray


class LookRows(NamedTuple):
    """Output rows of a frame, names as in `learned.CliqueLook`."""

    log_there: FloatArray
    log_gone: FloatArray
    p_occluded: FloatArray
    looked: IntArray


@inlined
def sighted(frame: Any, point: Any) -> Any:
    """Return the probability that a point is in the field (0 for none), its range, and the way to the sensor."""
    position_m, rotation, limits = frame
    dx, dy, dz = position_m[0] - point[0], position_m[1] - point[1], position_m[2] - point[2]
    reach = limits[0] + FAR_OUT * limits[7]
    squared = dx * dx + dy * dy + dz * dz
    range_m = max(math.sqrt(squared), 1e-9)
    inside = 0.0
    if squared <= reach * reach:
        x = -(rotation[0] * dx + rotation[3] * dy + rotation[6] * dz)
        y = -(rotation[1] * dx + rotation[4] * dy + rotation[7] * dz)
        z = -(rotation[2] * dx + rotation[5] * dy + rotation[8] * dz)
        inside = in_field(x, y, z, range_m, limits)
    return inside if inside >= OUT_OF_FIELD else 0.0, range_m, (dx, dy, dz)


@inlined
def cosine_between(way: Any, normal: Any, range_m: Any) -> Any:
    """Return the cosine of incidence."""
    return (way[0] * normal[0] + way[1] * normal[1] + way[2] * normal[2]) / range_m


@kernel
def p_detect(frame: SensorFrame, law: SensorLaw, rows: LandmarkRows, out: FloatArray) -> None:
    """Fill `out` (K,) with the probabilities to detect landmarks that nothing hides."""
    landmark_m, outward, hits, expected = rows
    ranges, facings = len(law.range_rate), len(law.facing_rate)
    for k in range(out.size):
        seen, range_m, way = sighted(frame, (landmark_m[k, 0], landmark_m[k, 1], landmark_m[k, 2]))
        out[k] = 0.0
        if seen > 0.0:
            cosine = cosine_between(way, (outward[k, 0], outward[k, 1], outward[k, 2]), range_m)
            by_range = interpolated(law.range_rate, *between(range_m / frame.limits[0] * ranges, ranges))
            by_facing = interpolated(law.facing_rate, *between(0.5 * (cosine + 1.0) * facings, facings))
            side = face_of(way[0], way[1], way[2])
            out[k] = seen * min(by_range * by_facing * (hits[k, side] / expected[k, side]), HIGHEST)


@kernel
def look(
    frame: SensorFrame, law: SensorLaw, rows: LandmarkRows, cliques: CliqueRows, seen_now: FrameSeen, out: LookRows
) -> None:
    """Fill `out`, and update what changes of `rows` and `cliques` in place."""
    range_rate, facing_rate, p_false, come_hz, go_hz, log_weight = law
    landmark_m, outward, hits, expected = rows
    first, occluded, log_chain, pending = cliques
    detected, active, elapsed_s = seen_now
    log_there, log_gone, p_occluded, looked = out
    chains, ranges, facings = len(come_hz), len(range_rate), len(facing_rate)
    largest = np.diff(first).max()
    row, face, low_r, low_f = np.empty((4, largest), np.int64)
    # by range and incidence, the landmark's own factor by direction, and parts of the next bins
    inside, by_range, by_facing, own, part_r, part_f = np.empty((6, largest))
    weight = np.empty(chains)
    at_facing, at_false = 2 * ranges, 2 * ranges + 2 * facings

    for c in range(len(first) - 1):
        looked[c] = 0
        log_there[c] = log_gone[c] = p_occluded[c] = np.nan
        if not active[c]:
            continue

        # expected detections, by landmark
        n = 0
        log_ratio, log_absent, ratio, absent = 0.0, 0.0, 1.0, 1.0
        for k in range(first[c], first[c + 1]):
            seen, range_m, way = sighted(frame, (landmark_m[k, 0], landmark_m[k, 1], landmark_m[k, 2]))
            if seen == 0.0:
                continue
            cosine = cosine_between(way, (outward[k, 0], outward[k, 1], outward[k, 2]), range_m)
            low_r[n], part_r[n] = between(range_m / frame.limits[0] * ranges, ranges)
            low_f[n], part_f[n] = between(0.5 * (cosine + 1.0) * facings, facings)
            by_range[n] = interpolated(range_rate, low_r[n], part_r[n])
            by_facing[n] = interpolated(facing_rate, low_f[n], part_f[n])
            side = face_of(way[0], way[1], way[2])
            row[n], inside[n], face[n] = k, seen, side
            own[n] = hits[k, side] / expected[k, side]
            p = seen * min(by_range[n] * by_facing[n] * own[n], HIGHEST)
            p_alarm = seen * p_false
            p_either = p_alarm + (1.0 - p_alarm) * p
            if detected[k]:
                ratio *= p_either / p_alarm
                absent *= p_alarm
            else:
                ratio *= (1.0 - p_either) / (1.0 - p_alarm)
                absent *= 1.0 - p_alarm
            if ratio > 1e100 or ratio < 1e-100 or absent < 1e-100:
                log_ratio += math.log(ratio)
                log_absent += math.log(absent)
                ratio = absent = 1.0
            n += 1
        if n == 0:
            continue
        log_ratio += math.log(ratio)
        log_absent += math.log(absent)

        # occlusion under every chain, and the evidence of the look on the clique
        free = math.exp(min(max(log_ratio, -EXPONENT), EXPONENT))
        top = -np.inf
        for j in range(chains):
            rate = come_hz[j] + go_hz[j]
            share = come_hz[j] / rate
            occluded[c, j] = share + (occluded[c, j] - share) * math.exp(-rate * elapsed_s[c])
            weight[j] = log_weight[j] + log_chain[c, j]
            top = max(top, weight[j])
        total = 0.0
        for j in range(chains):
            weight[j] = math.exp(weight[j] - top)
            total += weight[j]
        mixed = 0.0
        for j in range(chains):
            weight[j] /= total
            mixed += weight[j] * ((1.0 - occluded[c, j]) * free + occluded[c, j])
        hidden = 0.0
        for j in range(chains):
            under = (1.0 - occluded[c, j]) * free + occluded[c, j]
            occluded[c, j] /= under
            hidden += weight[j] * under / mixed * occluded[c, j]
            log_chain[c, j] += math.log(under / mixed)
        log_gone[c] = log_absent
        log_there[c] = log_absent + math.log(mixed)
        p_occluded[c] = hidden
        looked[c] = n

        # learning, if the clique is there: hits and expected hits, each factor given the others
        clear = 1.0 - hidden
        for i in range(n):
            k, seen = row[i], inside[i]
            low_range, low_facing = low_r[i], low_f[i]
            p = min(by_range[i] * by_facing[i] * own[i], HIGHEST)
            hit = 0.0
            if detected[k]:
                true = clear * p / (p + (1.0 - p) * p_false)
                hit = true
                pending[c, at_false] += 1.0 - true
                pending[c, at_false + 2] += 1.0
                hits[k, face[i]] += true
            view = clear * seen
            pending[c, at_false + 1] += seen * (1.0 - clear * p)
            pending[c, at_false + 3] += seen
            expected[k, face[i]] += view * (by_range[i] * by_facing[i])
            for_range, for_facing = view * by_facing[i] * own[i], view * by_range[i] * own[i]
            part = part_r[i]
            pending[c, low_range] += hit * (1.0 - part)
            pending[c, low_range + 1] += hit * part
            pending[c, ranges + low_range] += for_range * (1.0 - part)
            pending[c, ranges + low_range + 1] += for_range * part
            part = part_f[i]
            pending[c, at_facing + low_facing] += hit * (1.0 - part)
            pending[c, at_facing + low_facing + 1] += hit * part
            pending[c, at_facing + facings + low_facing] += for_facing * (1.0 - part)
            pending[c, at_facing + facings + low_facing + 1] += for_facing * part


@kernel
def collect(
    surely_there: BoolArray,
    surely_gone: BoolArray,
    pending: FloatArray,
    log_chain: FloatArray,
    learned: FloatArray,
    log_weight: FloatArray,
) -> None:
    """Move pending sums of certain cliques into the sums `learned` (P,) and `log_weight` (J,), in place."""
    last = pending.shape[1]
    for c in range(len(surely_there)):
        if surely_there[c]:
            for i in range(last - 2):
                learned[i] += pending[c, i]
            for j in range(len(log_weight)):
                log_weight[j] += log_chain[c, j]
                log_chain[c, j] = 0.0
            pending[c, :] = 0.0
        elif surely_gone[c]:
            learned[last - 4] += pending[c, last - 2]
            learned[last - 3] += pending[c, last - 1]
            pending[c, :] = 0.0


@kernel
def witnessed(
    pose: Any, landmark: Any, hit: Any, body: Any, eye: FloatArray, position: FloatArray,
    limits: tuple[float, float, float],
) -> tuple[BoolArray, BoolArray]:  # fmt: skip
    """Find looks in whose frame another body was seen near or behind the place, and those along the same line.

    Args:
        pose: (N,) from which is looked, in order.
        landmark: (N,) that is looked at.
        hit: (N,) whether it was detected.
        body: (L,) what each landmark belongs to.
        eye: (F, 2) where the sensor is in each pose [m].
        position: (L, 2) where landmarks are looked for [m].
        limits: distance [m] and angle [rad] that are beside, and distance [m] from the line that is along it.
    """
    beside_m, beside_rad, along_m = limits
    beside, along = np.zeros(len(pose), np.bool_), np.zeros(len(pose), np.bool_)
    begin, hits, away, bearing = 0, np.empty(len(body), np.int64), np.empty(len(body)), np.empty(len(body))
    while begin < len(pose):
        end, n_hits, i = begin, 0, pose[begin]
        while end < len(pose) and pose[end] == i:
            if hit[end]:
                j = landmark[end]
                x, y = position[j, 0] - eye[i, 0], position[j, 1] - eye[i, 1]
                hits[n_hits], away[n_hits], bearing[n_hits] = j, math.hypot(x, y), math.atan2(y, x)
                n_hits += 1
            end += 1
        for k in range(begin, end if n_hits > 0 else begin):
            j = landmark[k]
            x, y = position[j, 0] - eye[i, 0], position[j, 1] - eye[i, 1]
            range_m, direction = math.hypot(x, y), math.atan2(y, x)
            for h in range(n_hits):
                other = hits[h]
                if body[j] == body[other]:
                    continue
                dx, dy = position[j, 0] - position[other, 0], position[j, 1] - position[other, 1]
                angle = abs(direction - bearing[h])
                angle = min(angle, 2.0 * math.pi - angle)
                if dx * dx + dy * dy < beside_m * beside_m or (
                    angle < beside_rad and away[h] > range_m - 0.5 * beside_m
                ):
                    beside[k] = True
                if angle * range_m < along_m and angle < 0.25 * math.pi and away[h] > range_m + along_m:
                    along[k] = True
        begin = end
    return beside, along


@kernel
def unseen_length(
    eye: FloatArray, place: FloatArray, body: Any, ray_eye: FloatArray, ray_end: FloatArray, ray_body: Any,
    limits: tuple[float, float, float],
) -> FloatArray:  # fmt: skip
    """Return (K,) lengths of lines, from eyes (K, 2) to places (K, 2), on which no ray passed [m].

    A ray is as wide as the eyes are uncertain where it begins, and comes to a point where it ends: space along a wall
    is not seen through to what is behind it. A line is not asked by the rays to what it leads to itself.

    Args:
        eye: (K, 2) where the lines begin [m].
        place: (K, 2) where they end [m].
        body: (K,) what each leads to.
        ray_eye: (R, 2) where the rays begin along which something was seen [m].
        ray_end: (R, 2) where they end [m].
        ray_body: (R,) what was seen.
        limits: half widths where a ray begins and ends [m], and the step along a line [m].
    """
    wide_m, narrow_m, step_m = limits
    length, far, near = np.zeros(len(eye)), np.empty(len(ray_eye)), np.empty(len(ray_eye), np.int64)
    for r in range(len(ray_eye)):
        far[r] = math.hypot(ray_end[r, 0] - ray_eye[r, 0], ray_end[r, 1] - ray_eye[r, 1])
    for k in range(len(eye)):
        whole = math.hypot(place[k, 0] - eye[k, 0], place[k, 1] - eye[k, 1])
        x, y, count = 0.5 * (eye[k, 0] + place[k, 0]), 0.5 * (eye[k, 1] + place[k, 1]), 0
        for r in range(len(ray_eye)):  # those that may come near
            between = math.hypot(x - 0.5 * (ray_eye[r, 0] + ray_end[r, 0]), y - 0.5 * (ray_eye[r, 1] + ray_end[r, 1]))
            if ray_body[r] != body[k] and far[r] > 0.0 and between <= 0.5 * (whole + far[r]) + wide_m:
                near[count] = r
                count += 1
        steps, last = max(1, math.ceil(whole / step_m)), 0
        for i in range(steps):
            part, passed = (i + 0.5) / steps, False
            x, y = eye[k, 0] + part * (place[k, 0] - eye[k, 0]), eye[k, 1] + part * (place[k, 1] - eye[k, 1])
            for n in range(count):  # from the one that passed before: it mostly does again
                r = near[(last + n) % count]
                ux, uy = (ray_end[r, 0] - ray_eye[r, 0]) / far[r], (ray_end[r, 1] - ray_eye[r, 1]) / far[r]
                dx, dy = x - ray_eye[r, 0], y - ray_eye[r, 1]
                along = dx * ux + dy * uy
                if along < 0.0 or along > far[r]:
                    continue
                if abs(dx * uy - dy * ux) <= narrow_m + (wide_m - narrow_m) * (1.0 - along / far[r]):
                    passed, last = True, (last + n) % count
                    break
            if not passed:
                length[k] += whole / steps
    return length


@exact
def within_reach(pose: Any, landmark: Any, eye: FloatArray, position: FloatArray, reach_m: float) -> BoolArray:
    """Return (N,) looks from poses at landmarks that are nearer along both axes."""
    near = np.zeros(len(pose), np.bool_)
    for k in range(len(pose)):
        i, j = pose[k], landmark[k]
        near[k] = abs(position[j, 0] - eye[i, 0]) < reach_m and abs(position[j, 1] - eye[i, 1]) < reach_m
    return near


@exact
def add_around(
    key: IntArray, counted: FloatArray, wanted: IntArray, shift: IntArray, weight: FloatArray, out: FloatArray
) -> None:
    """Add to `out` (N, C) what is counted (K, C) at the keys `wanted` (N,), each shifted by all (S,), times a weight.

    Keys (K,) are sorted and different; it is fastest where those that are wanted are sorted, too.
    """
    for s in range(len(shift)):
        at, before = 0, wanted[0] + shift[s] if len(wanted) else 0
        for n in range(len(wanted)):
            one, steps = wanted[n] + shift[s], 0
            if one < before:
                at = np.searchsorted(key, one)
            while at < len(key) and key[at] < one:
                at, steps = at + 1, steps + 1
                if steps == 8:
                    at = np.searchsorted(key, one)
            before = one
            if at < len(key) and key[at] == one:
                for c in range(counted.shape[1]):
                    out[n, c] += weight[s] * counted[at, c]


@kernel
def grouped(group: Any, n_groups: int) -> Any:
    """Return (N,) rows sorted by their group, 0 to `n_groups` - 1, in their order within each."""
    first = np.zeros(n_groups + 1, np.int64)
    for k in range(len(group)):
        first[group[k] + 1] += 1
    for k in range(n_groups):
        first[k + 1] += first[k]
    order = np.empty(len(group), np.int64)
    for k in range(len(group)):
        order[first[group[k]]] = k
        first[group[k]] += 1
    return order


@kernel
def close_to_hits(stamp: FloatArray, site: Any, hit: Any, n_sites: int, within_s: float) -> BoolArray:
    """Return (N,) looks, those at a site in order of time, with a hit of the same site so shortly before or after."""
    close, last = np.zeros(len(stamp), np.bool_), np.empty(n_sites)
    for back in (False, True):
        last[:] = np.nan
        for each in range(len(stamp)):
            k = len(stamp) - 1 - each if back else each
            if hit[k]:
                last[site[k]] = stamp[k]
            if abs(stamp[k] - last[site[k]]) <= within_s:
                close[k] = True
    return close


@exact
def in_view(dx: float, dy: float, heading: float, limits: tuple[float, ...]) -> float:
    """Return the probability to detect what is this far from a sensor; see `visibility.NominalField.limits`."""
    p, nearest, farthest, first, last, margin_m, margin_rad = limits
    range_m = math.sqrt(dx * dx + dy * dy)
    p *= _below((range_m - nearest) / margin_m) * _below((farthest - range_m) / margin_m)
    if first > -math.inf and p > 0.0:
        bearing = math.atan2(dy, dx) - heading
        bearing -= 2.0 * math.pi * math.floor((bearing + math.pi) / (2.0 * math.pi))
        p *= _below((bearing - first) / margin_rad) * _below((last - bearing) / margin_rad)
    return p


@exact
def _below(z: float) -> float:
    """`P(x < z)` of a standard normal, to the last digit."""
    return 1.0 if z > 9.0 else 0.5 * math.erfc(-z * 0.7071067811865476)


@exact
def _longer(rows: Any, more: int) -> Any:
    """Return the rows, and room for more."""
    longer = np.empty(len(rows) + more, rows.dtype)
    for k in range(len(rows)):
        longer[k] = rows[k]
    return longer


@exact
def looks(
    eye: FloatArray, position: FloatArray, limits: tuple[float, ...], reach: tuple[float, float, int],
    first_seen: Any, seen: Any,
) -> tuple[IntArray, IntArray, FloatArray, BoolArray]:  # fmt: skip
    """List (N,) pose, landmark, probability and whether it was detected, by pose, then by landmark.

    Args:
        eye: (F, 3) sensor poses.
        position: (L, 2) landmarks.
        limits: as for `in_view`.
        reach: least probability, largest distance, and consecutive poses that are compared at once.
        first_seen: (F + 1,) where the detections of each pose begin in `seen`.
        seen: landmarks that are detected, whether in reach or not.
    """
    least, away, at_once = reach
    pose, landmark, p, hit = np.empty(64, np.int64), np.empty(64, np.int64), np.empty(64), np.empty(64, np.bool_)
    around, marked, count = np.empty(len(position), np.int64), np.full(len(position), -1), 0
    for i in range(len(eye)):
        if i % at_once == 0:
            # consecutive poses are near each other: what none of them reaches is not worth a look of any
            end, n_around = min(i + at_once, len(eye)), 0
            for k in range(first_seen[i], first_seen[end]):
                marked[seen[k]] = len(eye)
            x, y = eye[i:end, 0], eye[i:end, 1]
            x0, x1, y0, y1 = x.min() - away, x.max() + away, y.min() - away, y.max() + away
            for j in range(len(position)):
                if marked[j] == len(eye) or (x0 <= position[j, 0] <= x1 and y0 <= position[j, 1] <= y1):
                    around[n_around] = j
                    n_around += 1
        for k in range(first_seen[i], first_seen[i + 1]):
            marked[seen[k]] = i
        if count + n_around > len(pose):
            more = count + n_around
            pose, landmark, p, hit = _longer(pose, more), _longer(landmark, more), _longer(p, more), _longer(hit, more)
        for k in range(n_around):
            j = around[k]
            p[count] = in_view(position[j, 0] - eye[i, 0], position[j, 1] - eye[i, 1], eye[i, 2], limits)
            if p[count] >= least or marked[j] == i:
                pose[count], landmark[count], hit[count] = i, j, marked[j] == i
                count += 1
    return pose[:count].copy(), landmark[:count].copy(), p[:count].copy(), hit[:count].copy()


@exact
def cells(
    sensor: FloatArray, pose: Any, place: FloatArray, landmark: Any, cell_m: float, reach: int
) -> tuple[IntArray, int]:
    """Return (N,) cells of sensors `pose` counted from places `landmark`, see `sightlines`, and the first row that has
    none, or -1.
    """
    out = np.empty(len(pose), np.int64)
    for k in range(len(pose)):
        i, j = pose[k], landmark[k]
        dx, dy = np.floor((sensor[i, 0] - place[j, 0]) / cell_m), np.floor((sensor[i, 1] - place[j, 1]) / cell_m)
        if not (abs(dx) < reach // 2 and abs(dy) < reach // 2):  # also nan
            return out, k
        out[k] = (int(dx) + reach // 2) * reach + int(dy) + reach // 2
    return out, -1
