"""Association by particles: whole histories are drawn, and weighted by how well they predict the remaining detections.

FastSLAM (Montemerlo and Thrun 2003: FastSLAM 2.0 and its association for each particle): a particle is a path; given
it, landmarks are independent, so each has its own. A detection is assigned to a landmark, a new one or none, drawn by
likelihood, and corrects the path before the next is weighed. A wrong choice dies out when later detections contradict
it. A filter with one Gaussian cannot recover from it, nor can a batch solution if a whole group of landmarks was
mistaken for its neighbours. Particles forget their past and assume independent errors, so their result is only an
initial value for the batch solution, which decides (`identify`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from evermap.config import SlamConfig
from evermap.slam.association.assignment import NOBODY, Assignment
from evermap.slam.association.features import Likeness, Traits, Variances, same_nats
from evermap.slam.association.jcbb import gates
from evermap.slam.batch import USUAL
from evermap.slam.calibration import seat_sensor
from evermap.slam.filter_kernels import vectorised
from evermap.slam.kernels import N_STATES, composed, kernel, wrapped
from evermap.slam.problem import Estimate
from evermap.types import UNKNOWN, FloatArray, IntArray

MOST_PARTICLES, FEWEST_PARTICLES = 300, 30
"""Bounds of the number of particles: more do not find more, fewer degenerate."""
WORK = 1e8
"""Maximum number of compared pairs of detections and landmarks per run, given enough particles."""
GATE = float(gates(1, 1.0 - 1e-4)[1])
"""Squared distance beyond which a landmark is no candidate: its likelihood is negligible."""
WIDE_GATE = GATE * (1.0 + 1e-6)
"""The same for tests of a part of it: wider by more than rounding."""
ROOM = 2, 64
"""Maximum number of landmarks of a particle: a multiple of the known ones, and a constant."""
EFFECTIVE_SHARE = 0.5
"""Effective share of particles below which they are resampled: usual in particle filters."""


class _Rules(NamedTuple):
    """Settings: sightings of a landmark, time after which it is forgotten without them, log odds of a common name, of
    clutter and of a new landmark against a perfect match, and readings that a visit counts as.
    """

    fewest_sightings: int
    forget_s: float
    name_nats: float
    none_nats: float
    new_nats: float
    most_readings: int

    @classmethod
    def of(cls, settings: SlamConfig) -> _Rules:
        rules, none_nats = settings.association, settings.outlier_log_odds
        return cls(
            settings.fewest_sightings, rules.forget_s, rules.name_nats, none_nats,
            none_nats + rules.particles.new_nats, rules.readings.most_readings,
        )  # fmt: skip


class _Seen(NamedTuple):
    """Detections: rows of each frame (N + 1,), readings, variances and labels (M, 2), stamps of frames (N,); their
    traits (M, C), variances of these by number of readings (K, C), and those between landmarks; and settings.
    """

    first: IntArray
    reading: FloatArray
    variance: FloatArray
    label: IntArray
    stamp_s: FloatArray
    like: FloatArray
    errors: FloatArray
    spread: Variances
    rules: _Rules


class _Sensor(NamedTuple):
    """Mount (3,) and calibration states (11,)."""

    mount: FloatArray
    states: FloatArray


class _Cloud(NamedTuple):
    """P particles with room for L landmarks each: place (P, 2, L) and spread (P, 3, L), in columns for fast comparison;
    `of` is the landmark of a slot, -1 for none; `like` (P, L, C) its traits, from `read` readings.
    """

    pose: FloatArray
    place: FloatArray
    spread: FloatArray
    label: IntArray
    sightings: IntArray
    last_s: FloatArray
    of: IntArray
    slots: IntArray
    met: IntArray
    like: FloatArray
    read: FloatArray


class _Options(NamedTuple):
    """Candidate landmarks of a detection: slots, log likelihoods, innovations, their covariances and derivatives; and
    buffers for those that are taken, or out of reach.
    """

    slot: IntArray
    score: FloatArray
    innovation: FloatArray
    covariance: FloatArray
    by_pose: FloatArray
    taken_at: IntArray
    beyond: FloatArray


def drawn(
    assignment: Assignment, odometry: FloatArray, seed: int, *, wider: float | None = None
) -> tuple[Assignment, float]:
    """Draw an assignment: that of the best particle, with the log evidence of all particles up to a constant.

    Args:
        assignment: at its optimum, with the noise of sightings; its landmarks are the prior.
        odometry: (5,) noise levels of the odometry.
        seed: of the draws.
        wider: factor on the noise of sightings; None for the first of `slam.association.particles.wider`.
    """
    settings = assignment.settings
    wider = settings.association.particles.wider[0] if wider is None else wider
    problem, states = assignment.measured, assignment.estimate.states
    count = np.clip(WORK / (len(problem.reading) * max(assignment.n_landmarks, 1)), FEWEST_PARTICLES, MOST_PARTICLES)
    motion = problem.drive.between(problem.stamp_s, states)
    spread = np.tensordot(motion.noise, odometry**2, (1, 0)) + motion.floor
    noise = np.concatenate([np.eye(3)[None] / problem.start_information, spread])
    steps = np.vstack([problem.start_pose, motion.increment])
    first = np.searchsorted(problem.pose_row, np.arange(len(problem.stamp_s) + 1))
    variance = (wider * problem.sigma_given) ** 2
    traits, like = assignment.traits, assignment.like()
    seen = _Seen(
        first, problem.reading, variance, assignment.kind, problem.stamp_s, traits.value, traits.errors, traits.spread,
        _Rules.of(settings),
    )  # fmt: skip
    cloud = _begin_particles(assignment.estimate.landmark, assignment.of_kind, like, int(count), settings)
    row, pose, evidence = _run(seen, _Sensor(seat_sensor(problem.mount, states), states), steps, noise, cloud, seed)
    met, row[row >= 0] = np.unique(row[row >= 0], return_inverse=True)
    estimate = Estimate(pose, np.zeros((len(met), 2)), states.copy())
    found = replace(assignment, landmark_row=row, estimate=estimate)
    order = np.argsort(row, kind="stable")[np.count_nonzero(row == NOBODY) :]
    of_each = np.split(found.points()[order], np.flatnonzero(np.diff(row[order])) + 1)[: len(met)]
    place = np.array([np.median(points, axis=0) for points in of_each]).reshape(-1, 2)
    return replace(found, estimate=replace(found.estimate, landmark=place)), evidence


def warm_up() -> None:
    """Compile the kernels of `drawn`."""
    one, two = np.zeros((1, 2)), np.ones((2, 2))
    traits = Traits.none(2)
    seen = _Seen(
        np.arange(3), two, two, np.full((2, 2), UNKNOWN), np.arange(2.0), traits.value, traits.errors, traits.spread,
        _Rules.of(USUAL),
    )  # fmt: skip
    cloud = _begin_particles(one, np.full((1, 2), UNKNOWN), traits.nothing(1), 2, USUAL)
    _run(seen, _Sensor(np.zeros(3), np.zeros(N_STATES)), np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), cloud, 0)


def _begin_particles(place: FloatArray, label: IntArray, like: Likeness, count: int, settings: SlamConfig) -> _Cloud:
    """Particles with a prior of landmarks (L, 2)."""
    bent, most = settings.association.particles.bent, settings.association.readings.most_readings
    n = len(place)
    room = ROOM[0] * n + ROOM[1]
    cloud = _Cloud(
        np.zeros((count, 3)), np.zeros((count, 2, room)), np.zeros((count, 3, room)),
        np.full((count, room, 2), UNKNOWN), np.zeros((count, room), dtype=np.int64), np.zeros((count, room)),
        np.full((count, room), NOBODY), np.full(count, n), np.full(count, n),
        np.full((count, room, like.value.shape[1]), np.nan), np.zeros((count, room)),
    )  # fmt: skip
    if n:
        away = np.ravel(KDTree(place).query(place, [2])[0]) if n > 1 else np.ones(1)
        cloud.place[:, :, :n], cloud.label[:, :n], cloud.of[:, :n] = place.T, label, np.arange(n)
        cloud.spread[:, 0, :n] = cloud.spread[:, 2, :n] = (bent * away) ** 2
        cloud.sightings[:, :n] = settings.fewest_sightings
        cloud.like[:, :n], cloud.read[:, :n] = like.value, np.minimum(like.readings, most)
    return cloud


@kernel
def _run(
    seen: Any, sensor: Any, steps: FloatArray, noise: FloatArray, cloud: Any, seed: int
) -> tuple[IntArray, FloatArray, float]:
    """Process all particles frame by frame, then go back along the ancestors of the best."""
    np.random.seed(seed)  # noqa: NPY002 - of the compiled code, in this thread
    frames, count, room = len(steps), len(cloud.pose), cloud.of.shape[1]
    path, parent = np.zeros((frames, count, 3)), np.zeros((frames, count), dtype=np.int32)
    row = np.full((len(seen.reading), count), NOBODY, dtype=np.int32)
    weight, evidence = np.zeros(count), 0.0
    options = _Options(
        np.zeros(room, dtype=np.int64), np.zeros(room + 2), np.zeros((room, 2)), np.zeros((room, 3)),
        np.zeros((room, 2, 3)), np.full(room, -1), np.zeros(room),
    )  # fmt: skip
    most = 1
    for t in range(frames):
        most = max(most, seen.first[t + 1] - seen.first[t])
    chosen, covariance = np.zeros(most, dtype=np.int64), np.zeros((3, 3))
    across, gain, step = np.zeros((3, 2)), np.zeros((3, 2)), np.zeros(3)
    for t in range(frames):
        start, end = seen.first[t], seen.first[t + 1]
        for i in range(count):
            pose, covariance[:] = cloud.pose[i], noise[t]
            _move(pose, steps[t])
            for d in range(start, end):
                n = _weigh(seen, d, sensor, pose, covariance, cloud, i, t * count + i, options)
                k, gained = _draw(options.score, n, seen.variance[d], seen.rules)
                weight[i] += gained
                if k < n:
                    _correct(pose, covariance, options, k, across, gain, step)
                    options.taken_at[options.slot[k]] = t * count + i
                    chosen[d - start] = options.slot[k]
                else:
                    chosen[d - start] = n - 1 - k  # -1 none, -2 new
            _sample(pose, covariance, step)
            for d in range(start, end):
                row[d, i] = _place(seen, d, seen.stamp_s[t], sensor, cloud, i, chosen[d - start])
            path[t, i], parent[t, i] = cloud.pose[i], i
        top = weight.max()
        share = np.exp(weight - top)
        if t < frames - 1 and share.sum() ** 2 < EFFECTIVE_SHARE * count * (share * share).sum():
            evidence += top + np.log(share.mean())
            weight[:] = 0.0
            _resample(cloud, share / share.sum(), parent[t])
    best = np.argmax(weight)
    evidence += weight.max() + np.log(np.exp(weight - weight.max()).mean())
    found, poses = np.full(len(seen.reading), NOBODY), np.zeros((frames, 3))
    for t in range(frames - 1, -1, -1):
        if t < frames - 1:
            best = parent[t, best]
        poses[t] = path[t, best]
        for d in range(seen.first[t], seen.first[t + 1]):
            found[d] = row[d, best]
    return found, poses, evidence


@kernel
def _weigh(
    seen: Any, d: int, sensor: Any, pose: FloatArray, covariance: FloatArray, cloud: Any, i: int, now: int, options: Any
) -> int:
    """Fill `options` with the candidate landmarks of detection `d` in particle `i`; return their number."""
    mount, states, label = sensor.mount, sensor.states, seen.label[d]
    c, s, cm, sm = math.cos(pose[2]), math.sin(pose[2]), math.cos(mount[2]), math.sin(mount[2])
    bearing = seen.reading[d, 1] - states[4]
    cb, sb = math.cos(bearing), math.sin(bearing)
    range_m = (seen.reading[d, 0] - states[0]) / (1.0 + states[1] + states[2] * bearing + states[3] * bearing**2)
    own = seen.variance[d, 0] + covariance[0, 0] + covariance[1, 1] + (mount[0] ** 2 + mount[1] ** 2) * covariance[2, 2]
    x, y, n = pose[0] + c * mount[0] - s * mount[1], pose[1] + s * mount[0] + c * mount[1], 0
    place, spreads, beyond = cloud.place[i], cloud.spread[i], options.beyond
    _in_gate(place, spreads, cloud.slots[i], x, y, range_m, own, beyond)
    for k in range(cloud.slots[i]):
        if beyond[k] > 0.0 or options.taken_at[k] == now:
            continue
        dx, dy = place[0, k] - x, place[1, k] - y
        r = math.sqrt(dx * dx + dy * dy) + 1e-9
        s0, s1, s2 = spreads[0, k], spreads[1, k], spreads[2, k]
        if (r - range_m) ** 2 > 2.0 * GATE * (own + s0 + s2):
            continue
        known = cloud.label[i, k]
        differs, named = False, label[1] != UNKNOWN and label[1] == known[1]
        for q in range(2):
            differs |= label[q] != UNKNOWN and known[q] != UNKNOWN and label[q] != known[q]
        if differs:
            continue
        ax, ay = c * dx + s * dy, -s * dx + c * dy  # from the sensor, in the robot's axes
        rx, ry = mount[0] + ax, mount[1] + ay
        ux, uy = (cm * ax + sm * ay) / r, (-sm * ax + cm * ay) / r
        g = options.by_pose[n]
        b0, b1 = -ay / (r * r), ax / (r * r)
        g[1, 0], g[1, 1], g[1, 2] = -b0, -b1, b0 * ry - b1 * rx
        b0, b1 = c * b0 - s * b1, s * b0 + c * b1
        v11 = b0 * b0 * s0 + 2.0 * b0 * b1 * s1 + b1 * b1 * s2 + seen.variance[d, 1]
        for p in range(3):
            for q in range(3):
                v11 += g[1, p] * covariance[p, q] * g[1, q]
        if (sb * ux - cb * uy) ** 2 > WIDE_GATE * v11:
            continue  # an angle is not less than its sine
        expected = math.atan2(uy, ux)
        gain = 1.0 + states[1] + states[2] * expected + states[3] * expected**2
        e0, e1 = seen.reading[d, 0] - states[0] - gain * r, wrapped(bearing - expected)
        a0, a1 = gain * ax / r, gain * ay / r
        g[0, 0], g[0, 1], g[0, 2] = -a0, -a1, a0 * ry - a1 * rx
        a0, a1 = c * a0 - s * a1, s * a0 + c * a1
        v00 = a0 * a0 * s0 + 2.0 * a0 * a1 * s1 + a1 * a1 * s2 + seen.variance[d, 0]
        v01 = a0 * b0 * s0 + (a0 * b1 + a1 * b0) * s1 + a1 * b1 * s2
        for p in range(3):
            for q in range(3):
                v00 += g[0, p] * covariance[p, q] * g[0, q]
                v01 += g[0, p] * covariance[p, q] * g[1, q]
        det = v00 * v11 - v01 * v01
        distance = (v11 * e0 * e0 - 2.0 * v01 * e0 * e1 + v00 * e1 * e1) / det
        if distance > GATE:
            continue
        sightings = cloud.sightings[i, k]
        score = math.log(sightings / (sightings + 1.0)) - 0.5 * (distance + math.log(det))
        if seen.like.shape[1] > 0:
            read = min(int(cloud.read[i, k]), seen.rules.most_readings)
            known_by = min(1.0, cloud.read[i, k])
            score += same_nats(seen.like[d], seen.errors[1], cloud.like[i, k], seen.errors[read], known_by, seen.spread)
        options.slot[n], options.score[n] = k, score + (seen.rules.name_nats if named else 0.0)
        options.innovation[n, 0], options.innovation[n, 1] = e0, e1
        options.covariance[n, 0], options.covariance[n, 1], options.covariance[n, 2] = v00, v01, v11
        n += 1
    return n


@vectorised
def _in_gate(
    place: FloatArray, spread: FloatArray, count: int, x: float, y: float, range_m: float, own: float, out: FloatArray
) -> None:
    """Positive for landmarks whose distance contradicts the measured one: the gate of `_weigh`, a millionth wider."""
    squared, width = range_m * range_m, 2.0 * WIDE_GATE
    for k in range(count):
        dx, dy = place[0, k] - x, place[1, k] - y
        away = dx * dx + dy * dy
        gap = away + squared - width * (own + spread[0, k] + spread[2, k]) - 1e-6
        out[k] = min(gap, gap * gap - 4.0 * squared * away)


@kernel
def _draw(score: FloatArray, n: int, variance: FloatArray, rules: Any) -> tuple[int, float]:
    """Draw one of `n` landmarks, none (n) or a new one (n + 1), by likelihood; and the log of the sum of these."""
    perfect = -0.5 * math.log(variance[0] * variance[1])
    score[n], score[n + 1] = perfect - rules.none_nats, perfect - rules.new_nats
    top, total = score[: n + 2].max(), 0.0
    for k in range(n + 2):
        total += math.exp(score[k] - top)
    left, k = np.random.random() * total, 0  # noqa: NPY002
    while k < n + 1:
        left -= math.exp(score[k] - top)
        if left <= 0.0:
            break
        k += 1
    return k, top + math.log(total) - perfect


@kernel
def _correct(
    pose: FloatArray, covariance: FloatArray, options: Any, k: int, across: FloatArray, gain: FloatArray,
    step: FloatArray,
) -> None:  # fmt: skip
    """Update the pose, with its error in its own frame, by option `k`, the landmark marginalised; with buffers."""
    h, e, v = options.by_pose[k], options.innovation[k], options.covariance[k]
    det = v[0] * v[2] - v[1] * v[1]
    for p in range(3):
        for a in range(2):
            across[p, a] = covariance[p, 0] * h[a, 0] + covariance[p, 1] * h[a, 1] + covariance[p, 2] * h[a, 2]
        gain[p, 0] = (across[p, 0] * v[2] - across[p, 1] * v[1]) / det
        gain[p, 1] = (across[p, 1] * v[0] - across[p, 0] * v[1]) / det
        step[p] = gain[p, 0] * e[0] + gain[p, 1] * e[1]
    for p in range(3):
        for q in range(3):
            covariance[p, q] -= gain[p, 0] * across[q, 0] + gain[p, 1] * across[q, 1]
    _move(pose, step)


@kernel
def _move(pose: FloatArray, step: FloatArray) -> None:
    """Compose a pose with a step, in place."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    pose[0] += c * step[0] - s * step[1]
    pose[1] += s * step[0] + c * step[1]
    pose[2] += step[2]


@kernel
def _sample(pose: FloatArray, covariance: FloatArray, step: FloatArray) -> None:
    """Draw a pose from a Gaussian in its own frame, in place; overwrites the covariance with its Cholesky factor."""
    for p in range(3):
        for q in range(p + 1):
            value = covariance[p, q]
            for m in range(q):
                value -= covariance[p, m] * covariance[q, m]
            covariance[p, q] = math.sqrt(max(value, 1e-16)) if p == q else value / covariance[q, q]
    step[:] = 0.0
    for q in range(3):
        drawn_now = np.random.standard_normal()  # noqa: NPY002
        for p in range(q, 3):
            step[p] += covariance[p, q] * drawn_now
    _move(pose, step)


@kernel
def _place(seen: Any, d: int, stamp_s: float, sensor: Any, cloud: Any, i: int, slot: int) -> int:
    """Update the landmark in a slot with a detection, or start one (-2); return the landmark, -1 for none."""
    if slot == -1:
        return -1
    pose, mount, states, variance = cloud.pose[i], sensor.mount, sensor.states, seen.variance[d]
    at = composed(pose, mount)
    bearing = seen.reading[d, 1] - states[4]
    gain = 1.0 + states[1] + states[2] * bearing + states[3] * bearing**2
    if slot == -2:
        slot = _free_slot(cloud, i, stamp_s, seen.rules)
        if slot < 0:
            return -1
        r, angle = (seen.reading[d, 0] - states[0]) / gain, bearing + at[2]
        c, s = math.cos(angle), math.sin(angle)
        along, aside = variance[0] / gain**2, variance[1] * r * r
        cloud.place[i, 0, slot], cloud.place[i, 1, slot] = at[0] + r * c, at[1] + r * s
        spread = cloud.spread[i, :, slot]
        spread[0], spread[1] = c * c * along + s * s * aside, c * s * (along - aside)
        spread[2] = s * s * along + c * c * aside
        cloud.of[i, slot], cloud.sightings[i, slot], cloud.label[i, slot] = cloud.met[i], 0, seen.label[d]
        cloud.like[i, slot], cloud.read[i, slot] = np.nan, 0.0
        cloud.met[i] += 1
    else:
        place, spread = cloud.place[i, :, slot], cloud.spread[i, :, slot]
        dx, dy = place[0] - at[0], place[1] - at[1]
        r = math.sqrt(dx * dx + dy * dy) + 1e-9
        expected = wrapped(math.atan2(dy, dx) - at[2])
        gain = 1.0 + states[1] + states[2] * expected + states[3] * expected**2
        e0, e1 = seen.reading[d, 0] - states[0] - gain * r, wrapped(bearing - expected)
        a0, a1, b0, b1 = gain * dx / r, gain * dy / r, -dy / (r * r), dx / (r * r)
        p00, p01 = spread[0] * a0 + spread[1] * a1, spread[1] * a0 + spread[2] * a1
        p10, p11 = spread[0] * b0 + spread[1] * b1, spread[1] * b0 + spread[2] * b1
        v00, v01, v11 = a0 * p00 + a1 * p01 + variance[0], b0 * p00 + b1 * p01, b0 * p10 + b1 * p11 + variance[1]
        det = v00 * v11 - v01 * v01
        k00, k01 = (p00 * v11 - p10 * v01) / det, (p10 * v00 - p00 * v01) / det
        k10, k11 = (p01 * v11 - p11 * v01) / det, (p11 * v00 - p01 * v01) / det
        place[0] += k00 * e0 + k01 * e1
        place[1] += k10 * e0 + k11 * e1
        spread[0] -= k00 * p00 + k01 * p10
        spread[1] -= k00 * p01 + k01 * p11
        spread[2] -= k10 * p01 + k11 * p11
        for q in range(2):
            cloud.label[i, slot, q] = max(cloud.label[i, slot, q], seen.label[d, q])
    if seen.like.shape[1] > 0:
        read = False
        for c in range(seen.like.shape[1]):
            value = seen.like[d, c]
            if np.isfinite(value):
                known, read = cloud.like[i, slot, c], True
                away = (value - known) / (1.0 + cloud.read[i, slot])
                cloud.like[i, slot, c] = known + away if np.isfinite(known) else value
        cloud.read[i, slot] += 1.0 if read else 0.0
    cloud.sightings[i, slot] += 1
    cloud.last_s[i, slot] = stamp_s
    return int(cloud.of[i, slot])


@kernel
def _free_slot(cloud: Any, i: int, stamp_s: float, rules: Any) -> int:
    """A free slot, or that of a landmark with too few sightings; -1 if there is none."""
    for k in range(cloud.slots[i]):
        if cloud.sightings[i, k] < rules.fewest_sightings and stamp_s - cloud.last_s[i, k] > rules.forget_s:
            return k
    if cloud.slots[i] == cloud.of.shape[1]:
        return -1
    cloud.slots[i] += 1
    return int(cloud.slots[i] - 1)


@kernel
def _resample(cloud: Any, share: FloatArray, parent: IntArray) -> None:
    """Resample particles by their shares (P,), with one random number (systematic), in place."""
    count = len(share)
    copies, drawn_to, free, j = np.zeros(count, dtype=np.int64), share[0], 0, 0
    at = np.random.random() / count  # noqa: NPY002
    for _ in range(count):
        while drawn_to < at and j < count - 1:
            j += 1
            drawn_to += share[j]
        copies[j] += 1
        at += 1.0 / count
    for j in range(count):
        for _ in range(1, copies[j]):
            while copies[free] > 0:
                free += 1
            copies[free], parent[free], n = 1, j, cloud.slots[j]
            cloud.pose[free], cloud.slots[free], cloud.met[free] = cloud.pose[j], n, cloud.met[j]
            cloud.place[free, :, :n], cloud.spread[free, :, :n] = cloud.place[j, :, :n], cloud.spread[j, :, :n]
            cloud.label[free, :n], cloud.sightings[free, :n] = cloud.label[j, :n], cloud.sightings[j, :n]
            cloud.last_s[free, :n], cloud.of[free, :n] = cloud.last_s[j, :n], cloud.of[j, :n]
            cloud.like[free, :n], cloud.read[free, :n] = cloud.like[j, :n], cloud.read[j, :n]
