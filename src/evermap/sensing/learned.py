"""A detection model that is learned online, and explains misses instead of suppressing them.

A landmark that is there is detected with `P_D = P(in the field) R(range) V(incidence) G(landmark, direction)`, or by
mistake with `P_F`; somebody may stand before its whole clique, and then only false alarms remain (MATH.md section 3,
the lines beyond the thesis). `R`, `V`, `P_F` and how often and how long somebody stands there are the sensor's
`Profile`, shared by all it sees. `G` is each landmark's own, for each of six directions: hits over expected hits,
which start equal.

What a look teaches of a clique's own landmarks is exact in one respect that matters: the hypothesis 'still there' says
that it has been there all the time, so its numbers count every look, whatever is believed of it now. What is shared
must not learn from things that have gone, so a clique's share pends until the clique is seen again.

Use, a frame:

    model, seen = learned.look(model, stamp_s, position_m, rotation, detected)
    belief = belief.observe(seen.stamp_s, seen.log_there, seen.log_gone)
    model = learned.confirm(model, seen, belief.probability)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evermap.errors import DataError, InputError
from evermap.sensing.profile import FACING_BINS, RANGE_BINS, Assumed, Profile, Projection
from evermap.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from evermap.sensing.kernels import SensorFrame, SensorLaw

FACES = 6
"""Directions that a landmark's own detectability is learned for: the faces of a cube around it."""
SUMS = ("range_hits", "range_expected", "facing_hits", "facing_expected", "false_hits", "false_looks")
"""What the profile sums up, in the order of the kernels."""


@dataclass(frozen=True, slots=True)
class LearnedDetection:
    """Learned state of the sensor, and of K landmarks on C cliques.

    Attributes:
        profile: of the sensor.
        first: (C + 1,) landmarks `first[c]` to `first[c + 1]` are those of clique c.
        landmark_m: (K, 3) in the world.
        outward: (K, 3) unit vectors away from the middle of each clique; the prior of its landmarks' normals.
        hits, expected: (K, 6) float32 sums by direction; their ratio is a landmark's own factor.
        stamp_s: (C,) when each clique was last in the field; nan before.
        occluded: (C, J) probability of being occluded then, under each chain.
        log_chain: (C, J) log evidence for each chain that pends.
        pending: (C, P) sums for the profile that pend, in its order, and then for false alarms if the clique is gone.
    """

    profile: Profile
    first: IntArray
    landmark_m: FloatArray
    outward: FloatArray
    hits: NDArray[np.float32]
    expected: NDArray[np.float32]
    stamp_s: FloatArray
    occluded: FloatArray
    log_chain: FloatArray
    pending: FloatArray

    def __len__(self) -> int:
        return len(self.stamp_s)

    def p_detect(self, pose: FloatArray, position_m: FloatArray) -> FloatArray:
        """Return (F, K) probabilities to detect the landmarks, where they are and by no mistake.

        A clique is taken to be occluded for its usual share of the time: `P_D = P(field) R V G (1 - share)`.

        Args:
            pose: (F, 4, 4) from the sensor's frame to the world's.
            position_m: (K, 3) positions of the landmarks of this model, which may have moved a little.

        Raises:
            InputError: another number of landmarks than the model knows, or poses of another shape.
        """
        from evermap.sensing import kernels

        if np.shape(position_m) != self.landmark_m.shape:
            problem = f"shape {np.shape(position_m)} instead of {self.landmark_m.shape}"
            raise InputError(problem, field="position_m")
        if np.ndim(pose) != 3 or np.shape(pose)[1:] != (4, 4):
            raise InputError(f"shape {np.shape(pose)} instead of (F, 4, 4)", field="pose")
        law = _law(self.profile)
        rows = kernels.LandmarkRows(np.asarray(position_m, np.float64), self.outward, self.hits, self.expected)
        p = np.empty((len(pose), len(self.landmark_m)))
        for out, one in zip(p, np.asarray(pose, dtype=np.float64), strict=True):
            kernels.p_detect(_frame(self.profile, one[:3, 3], one[:3, :3]), law, rows, out)
        return p * (1.0 - self.profile.occlusion.share)


@dataclass(frozen=True, slots=True)
class CliqueLook:
    """Evidence of one frame on C cliques; nan for those outside of the field.

    Attributes:
        stamp_s: (C,) time of the look.
        log_there, log_gone: (C,) log likelihood of the detections and misses if the clique is there, and if not.
        p_occluded: (C,) probability that it was occluded, if there.
        expected: (C,) number of landmarks in the field.
    """

    stamp_s: FloatArray
    log_there: FloatArray
    log_gone: FloatArray
    p_occluded: FloatArray
    expected: IntArray


def init(landmark_m: FloatArray, clique: IntArray, profile: Profile | Assumed) -> LearnedDetection:
    """Return a model of landmarks with known positions only.

    Args:
        landmark_m: (K, 3) in the world, sorted by clique.
        clique: (K,) which clique each is of; all of 0 to C - 1 occur.
        profile: of the sensor, from earlier sessions or robots, or what is assumed of one that has seen nothing.

    Raises:
        InputError: shapes that differ, places that are not finite, or cliques that are not sorted or lack landmarks.
    """
    point = np.ascontiguousarray(landmark_m, dtype=np.float64)
    member = np.asarray(clique)
    if point.ndim != 2 or point.shape[1] != 3 or member.shape != (len(point),):
        raise InputError(f"shapes {point.shape} and {member.shape} instead of (K, 3) and (K,)", field="landmark_m")
    wrong = np.flatnonzero(~np.isfinite(point).all(axis=1))
    if wrong.size:
        problem = f"row {wrong[0]}: not a position: {point[wrong[0]]}"
        raise InputError(problem, field="landmark_m", hint="finite metres")
    if member.dtype.kind not in "iu":
        raise InputError(f"{member.dtype} instead of whole numbers", field="clique", hint="cliques numbered from 0")
    step = np.diff(member.astype(np.int64), prepend=-1)
    wrong = np.flatnonzero((step < 0) | (step > 1))
    if len(member) == 0 or wrong.size or member[0] != 0:
        where = f"row {wrong[0]}: clique {member[wrong[0]]}" if wrong.size else "the first clique is not 0"
        raise InputError(f"{where}", field="clique", hint="landmarks sorted by clique, cliques numbered from 0")
    first = np.append(np.flatnonzero(step), len(member)).astype(np.int64)
    count = np.diff(first)
    middle = np.add.reduceat(point, first[:-1], axis=0) / count[:, None]
    away = point - np.repeat(middle, count, axis=0)
    length = np.linalg.norm(away, axis=1, keepdims=True)
    start = profile if isinstance(profile, Profile) else Profile.of(profile)
    chain = start.occlusion
    c, prior = len(count), start.assumed.hits
    return LearnedDetection(
        profile=start,
        first=first,
        landmark_m=point,
        outward=np.where(length > 1e-9, away / np.maximum(length, 1e-9), 0.0),
        hits=np.full((len(point), FACES), prior, dtype=np.float32),
        expected=np.full((len(point), FACES), prior, dtype=np.float32),
        stamp_s=np.full(c, np.nan),
        occluded=np.tile(chain.come_hz / (chain.come_hz + chain.go_hz), (c, 1)),
        log_chain=np.zeros((c, len(chain.weight))),
        pending=np.zeros((c, 2 * RANGE_BINS + 2 * FACING_BINS + 4)),
    )


def look(
    model: LearnedDetection,
    stamp_s: float,
    position_m: FloatArray,
    rotation: FloatArray,
    detected: BoolArray,
    *,
    active: BoolArray | None = None,
) -> tuple[LearnedDetection, CliqueLook]:
    """Process one frame: return the updated model, and its evidence on each clique.

    Args:
        model: so far.
        stamp_s: time of the frame, on one clock for all.
        position_m: (3,) of the sensor in the world.
        rotation: (3, 3) from the sensor's frame to the world's.
        detected: (K,) which landmarks were detected; those that are not in the field don't count.
        active: (C,) which cliques are looked at; all where None.

    Returns:
        The model after the frame, and what the frame says of each clique.

    Raises:
        InputError: wrong shapes, an invalid pose, or time running backwards.
    """
    from evermap.sensing import kernels

    c = len(model)
    place, turn = _sensor(position_m, rotation)
    hit = _flags(detected, len(model.landmark_m), "detected")
    chosen = np.ones(c, dtype=np.bool_) if active is None else _flags(active, c, "active")
    if not math.isfinite(stamp_s):
        raise InputError(f"not a finite time: {stamp_s}", field="stamp_s", hint="seconds")
    late = np.flatnonzero(model.stamp_s > stamp_s)
    if late.size:
        problem = f"time {stamp_s} s lies before the last look at clique {late[0]} at {model.stamp_s[late[0]]} s"
        raise InputError(problem, field="stamp_s", hint="sort by time")

    changed = ("hits", "expected", "occluded", "log_chain", "pending")
    after = replace(model, **{name: getattr(model, name).copy() for name in changed})
    stamp, log_there, log_gone, p_occluded = np.empty((4, c))
    seen = CliqueLook(stamp, log_there, log_gone, p_occluded, np.empty(c, dtype=np.int64))
    kernels.look(
        _frame(model.profile, place, turn),
        _law(model.profile),
        kernels.LandmarkRows(model.landmark_m, model.outward, after.hits, after.expected),
        kernels.CliqueRows(model.first, after.occluded, after.log_chain, after.pending),
        kernels.FrameSeen(hit, chosen, np.nan_to_num(stamp_s - model.stamp_s)),
        kernels.LookRows(seen.log_there, seen.log_gone, seen.p_occluded, seen.expected),
    )
    in_view = seen.expected > 0
    return (
        replace(after, stamp_s=np.where(in_view, stamp_s, model.stamp_s)),
        replace(seen, stamp_s=np.where(in_view, stamp_s, np.nan)),
    )


def confirm(
    model: LearnedDetection,
    seen: CliqueLook,
    probability: FloatArray,
    *,
    sure: tuple[float, float] = (0.001, 0.99),
    p_occluded: float = 0.1,
) -> LearnedDetection:
    """Learn the profile from the cliques whose presence the last look has made certain.

    Args:
        model: after `look`.
        seen: what `look` returned with it.
        probability: (C,) that each clique exists, after that look.
        sure: beliefs up to which, and from which on, what pends of a clique is taken for what it is.
        p_occluded: of being occluded, above which a clique has not been seen again.

    Raises:
        InputError: probabilities of another shape.
        DataError: an invalid probability of a clique that was looked at.
    """
    belief = np.asarray(probability, dtype=np.float64)
    if belief.shape != (len(model),):
        raise InputError(f"shape {belief.shape} instead of ({len(model)},)", field="probability")
    in_view = seen.expected > 0
    wrong = np.flatnonzero(in_view & ~((belief >= 0.0) & (belief <= 1.0)))
    if wrong.size:
        problem = f"row {wrong[0]}: not a probability: {belief[wrong[0]]}"
        raise DataError(problem, field="probability", hint="0 to 1")
    there = in_view & (belief > sure[1]) & (seen.p_occluded < p_occluded)
    gone = in_view & (belief < sure[0])
    pending, log_chain = model.pending.copy(), model.log_chain.copy()
    learned = _collect_pending(model.profile, there, gone, pending, log_chain)
    return replace(model, profile=learned, pending=pending, log_chain=log_chain)


def _collect_pending(
    profile: Profile, there: BoolArray, gone: BoolArray, pending: FloatArray, log_chain: FloatArray
) -> Profile:
    """Return the profile with what pends of certain cliques, which is taken from there in place."""
    from evermap.sensing import kernels

    sums, log_weight = _sums_of(profile), profile.log_weight.copy()
    kernels.collect(there, gone, pending, log_chain, sums, log_weight)
    return _with_sums(profile, sums, log_weight - log_weight.max())


def _sums_of(profile: Profile) -> FloatArray:
    """Return what a profile sums up as the kernels take it, and room behind it."""
    return np.concatenate([*(np.atleast_1d(getattr(profile, name)) for name in SUMS), np.zeros(2)])


def _with_sums(profile: Profile, sums: FloatArray, log_weight: FloatArray) -> Profile:
    """Return a profile with other sums (`_sums_of`) and weights of its chains."""
    count = [np.size(getattr(profile, name)) for name in SUMS]
    parts = np.split(sums[: sum(count)], np.cumsum(count)[:-1])
    after: dict[str, Any] = {
        name: part if len(part) > 1 else float(part[0]) for name, part in zip(SUMS, parts, strict=True)
    }
    return replace(profile, **after, log_weight=log_weight)


def _sensor(position_m: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a position (3,) and a rotation (3, 3), checked."""
    place, turn = np.asarray(position_m, dtype=np.float64), np.ascontiguousarray(rotation, dtype=np.float64)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise InputError(f"not a position: {position_m}", field="position_m", hint="three finite numbers")
    if turn.shape != (3, 3) or not np.abs(turn @ turn.T - np.eye(3)).max() < 1e-6 or np.linalg.det(turn) < 0.0:
        raise InputError("not a rotation", field="rotation", hint="an orthonormal matrix (3, 3), not mirrored")
    return place, turn


def _flags(values: BoolArray, count: int, field: str) -> BoolArray:
    """Return booleans (count,), checked."""
    flags = np.asarray(values)
    if flags.shape != (count,) or flags.dtype != np.bool_:
        raise InputError(f"{flags.dtype} of shape {flags.shape} instead of bool of ({count},)", field=field)
    return flags


def _law(profile: Profile) -> SensorLaw:
    """Return what the profile says as the kernels take it."""
    from evermap.sensing.kernels import SensorLaw

    chain = profile.occlusion
    rates = profile.range_rate, profile.facing_rate, profile.p_false
    return SensorLaw(*rates, chain.come_hz, chain.go_hz, profile.log_weight)


def _frame(profile: Profile, place: FloatArray, turn: FloatArray) -> SensorFrame:
    """Return a pose, the field and its softness as the kernels take them."""
    from evermap.sensing.kernels import SensorFrame

    field, assumed = profile.assumed.field, profile.assumed
    limits = (
        float(field.range_max_m),
        math.sin(field.half_azimuth_rad),
        math.cos(field.half_azimuth_rad),
        math.sin(field.half_elevation_rad),
        math.cos(field.half_elevation_rad),
        float(field.projection is Projection.SPHERICAL),
        float(field.half_azimuth_rad >= math.pi),
        float(assumed.sigma_position_m),
        float(assumed.sigma_attitude_rad),
    )
    return SensorFrame(tuple(place.tolist()), tuple(turn.ravel().tolist()), limits)


def watched(
    model: LearnedDetection,
    stamp_s: FloatArray,
    pose: FloatArray,
    detected: BoolArray,
    there: BoolArray,
    *,
    p_occluded: float = 0.1,
) -> LearnedDetection:
    """Return the model after a session with known presence of landmarks.

    Args:
        model: before it; every landmark is a clique by itself.
        stamp_s: (F,) of the looks, in order.
        pose: (F, 4, 4) from the sensor's frame to the world's.
        detected: (F, K) which landmarks were detected.
        there: (F, K) which of them were there; of the others nothing is learned.
        p_occluded: as of `confirm`.
    """
    from evermap.sensing import kernels

    # as `look` and `confirm`, but with one copy of the state for all frames
    changed = ("hits", "expected", "stamp_s", "occluded", "log_chain", "pending")
    after = replace(model, **{name: getattr(model, name).copy() for name in changed})
    rows = kernels.LandmarkRows(after.landmark_m, after.outward, after.hits, after.expected)
    cliques = kernels.CliqueRows(after.first, after.occluded, after.log_chain, after.pending)
    log_there, log_gone, occluded = np.empty((3, len(model)))
    out = kernels.LookRows(log_there, log_gone, occluded, np.empty(len(model), dtype=np.int64))
    nobody, law, sums = np.zeros(len(model), dtype=np.bool_), _law(after.profile), _sums_of(after.profile)
    facing, false = 2 * len(law.range_rate), 2 * len(law.range_rate) + 2 * len(law.facing_rate)
    for stamp, one, hit, active in zip(stamp_s.tolist(), pose, detected, there, strict=True):
        if not active.any():
            continue
        seen_now = kernels.FrameSeen(hit, active, np.nan_to_num(stamp - after.stamp_s))
        kernels.look(_frame(after.profile, one[:3, 3], one[:3, :3]), law, rows, cliques, seen_now, out)
        in_view = out.looked > 0
        after.stamp_s[in_view] = stamp
        again = in_view & (out.p_occluded < p_occluded)
        if again.any():
            log_weight = law.log_weight.copy()
            kernels.collect(again, nobody, after.pending, after.log_chain, sums, log_weight)
            of_range, of_facing = sums[:facing].reshape(2, -1), sums[facing:false].reshape(2, -1)
            law = law._replace(
                range_rate=of_range[0] / of_range[1],
                facing_rate=of_facing[0] / of_facing[1],
                p_false=float(sums[false] / sums[false + 1]),
                log_weight=log_weight - log_weight.max(),
            )
    return replace(after, profile=_with_sums(after.profile, sums, law.log_weight))
