"""Detection of wrong identities, by votes of detections within seconds.

Carried to one pose by odometry, which is good for some seconds, detections of one landmark lie together. Several with
one id, and none or hardly any with its own anywhere near, say that an id was read wrongly. How far detections of one
landmark lie apart is told by those with one id, of which most are right. An id that is read at two places in one frame,
time and again, is on two landmarks, and says nothing. But where one scale, turn and shift lays what one sensor sees
over what another one does, it is a sensor that is wrong, not the ids.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from evermap.config import SlamConfig, VotesConfig
from evermap.errors import DataError
from evermap.geometry import se3
from evermap.geometry.rigid import rigid
from evermap.slam.batch import sight_at
from evermap.slam.bridge import dead_reckoned
from evermap.slam.intake import prepare
from evermap.slam.kernels import kernel
from evermap.slam.noise import START
from evermap.slam.space.intake import prepare_space, without_range
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    AnyRecordingT,
    BoolArray,
    FloatArray,
    IntArray,
    Recording,
    SpatialRecording,
    is_in_space,
)

FIRST_QUARTILE = {2: 0.575, 3: 1.213}
"""First quartile of a squared standard normal vector, by its dimension: most ids are right, not all."""
FEWEST_PAIRS, LEAST_SHARE = 20, 1e-4
"""Minimum detections of one id for learning their error, and minimum of its variance as a share of the above."""
FEWEST_NAMES, STEPS = 3, 10
"""Landmarks that two sensors must have seen at once to be laid over each other, and steps of that."""


def without_contradicted_ids(recording: AnyRecordingT, settings: SlamConfig) -> AnyRecordingT:
    """Return the recording without the landmark ids that the seconds around contradict, with a remark on how many.

    In space that takes odometry; boxes, which move, and detections without a range keep their ids.
    """
    given = recording.detections
    try:
        used, read = _read(recording, settings)
    except DataError:  # too few ids: the estimator reports it, if it needs any
        return recording
    name, (wrong, doubled) = read.name, contradicted(read, settings.votes)
    left_out = wrong | doubled[name]
    if not left_out.any():
        return recording
    landmark_id, warnings = given.landmark_id.copy(), list(recording.warnings)
    landmark_id[used[left_out]] = UNKNOWN
    if wrong.any():
        warnings.append(f"{int(wrong.sum())} detections whose landmark_id contradicts the frames around")
    texts = recording.landmark_names
    twice = [texts.get(one, str(one)) for one in np.unique(given.landmark_id[used[doubled[name]]]).tolist()]
    if twice:
        warnings.append(f"landmark_id {', '.join(twice)}: on two landmarks, seen at two places at once; not used")
    return replace(recording, detections=replace(given, landmark_id=landmark_id), warnings=tuple(warnings))


def without_identities(recording: Any, landmark_id: Collection[int]) -> Any:
    """Return the recording with the detections of some identities as of no landmark."""
    seen = recording.detections
    name = np.where(np.isin(seen.landmark_id, list(landmark_id)), UNKNOWN, seen.landmark_id)
    return replace(recording, detections=replace(seen, landmark_id=name))


def with_read_identities(recording: Any, read: Any) -> Any:
    """Return a recording as it was put right (stamps, axes, signs), with the identities of the one that was read."""
    if len(recording.detections) != len(read.detections):
        return read
    return replace(recording, detections=replace(recording.detections, landmark_id=read.detections.landmark_id))


def list_doubled_ids(as_read: AnyRecording, recording: AnyRecording) -> IntArray:
    """Return ids that a recording has not any more, and that were read twice in one frame, time and again.

    Args:
        as_read: the recording with all ids.
        recording: the same `without_contradicted_ids`.
    """
    seen = as_read.detections
    lost = np.setdiff1d(seen.landmark_id, np.append(recording.detections.landmark_id, UNKNOWN))
    if not len(lost):
        return lost
    read, times = np.unique(np.column_stack([seen.landmark_id, seen.frame]), axis=0, return_counts=True)
    name, count = np.unique(read[times > 1, 0], return_counts=True)
    return np.intersect1d(name[count >= VotesConfig().fewest_doubles], lost)


class Read(NamedTuple):
    """M detections with an id, in the order of time.

    Attributes:
        at: (M, D) where they are [m], by odometry alone.
        variance: (M,) of each beside that of others.
        stamp_s: (M,).
        view: (M,) what one sensor saw at a time has one number.
        name: (M,) from 0.
    """

    at: FloatArray
    variance: FloatArray
    stamp_s: FloatArray
    view: IntArray
    name: IntArray


def _read(recording: AnyRecording, settings: SlamConfig) -> tuple[IntArray, Read]:
    return _in_space(recording, settings) if is_in_space(recording) else _in_plane(recording, settings)


def _in_plane(recording: Recording, settings: SlamConfig) -> tuple[IntArray, Read]:
    """Return rows of detections that vote, and their positions."""
    prepared = prepare(recording, settings=settings.odometry)
    problem = prepared.problem
    pose, _ = dead_reckoned(problem.stamp_s, problem.drive, problem.prior.mean, START)
    at = sight_at(pose[problem.pose_row], problem.reading, problem.prior.mean, problem.mount)
    variance = (settings.votes.sigma_m + settings.votes.sigma_share * problem.reading[:, 0]) ** 2
    return prepared.used, Read(at, variance, problem.seen_s, problem.pose_row, problem.landmark_row)


def _in_space(recording: SpatialRecording, settings: SlamConfig) -> tuple[IntArray, Read]:
    """Return those of a recording in space with odometry."""
    if recording.odometry is None:
        raise DataError(f"{recording.name}: no odometry")
    intake = prepare_space(recording, settings.space)
    problem, boxes = intake.problem, np.isfinite(recording.detections.size_m).all(axis=1)
    voting = np.flatnonzero(~(boxes | without_range(recording))[intake.used])
    row, sensor = problem.pose_row[voting], problem.sensor[voting]
    name, ahead = problem.place[voting], se3.transform(problem.mount[sensor], problem.measured[voting, :3])
    variance = (np.linalg.inv(problem.measured_root[voting]) ** 2).sum(axis=(1, 2)) / 3.0
    pose, view, stamp_s = intake.driven_pose[row], row * len(problem.mount) + sensor, problem.stamp_s[row]
    if len(problem.mount) > 1:
        by_sensor = name * len(problem.mount) + sensor
        own = Read(se3.transform(pose, ahead), variance, stamp_s, view, by_sensor)
        ahead = _lay_sensors(ahead, _learn_variance(own, settings.votes), row, sensor, name, settings.votes.gate)
    return intake.used[voting], Read(se3.transform(pose, ahead), variance, stamp_s, view, name)


def _lay_sensors(
    ahead: FloatArray, variance: FloatArray, frame: IntArray, sensor: IntArray, name: IntArray, gate: float
) -> FloatArray:
    """Return positions (M, 3) in the robot's frame, those of sensors that contradict another laid over what it saw.

    The sensor with the most detections is left where it is, and so are all of which that would mend less than half of
    what is at two places: no one motion brings ids together that are on two landmarks.

    Args:
        ahead: (M, 3) positions in the robot's frame [m].
        variance: (M,) of each.
        frame: (M,) rows of frames.
        sensor: (M,) rows of sensors.
        name: (M,) rows of landmarks.
        gate: standard deviations within which two detections are at one place.
    """
    count, ahead = np.bincount(sensor), ahead.copy()
    left = np.flatnonzero(count).tolist()
    left.sort(key=lambda one: -int(count[one]))
    laid = left[:1]
    while left := [one for one in left if one not in laid]:
        pairs = {one: _pair(np.isin(sensor, laid), sensor == one, frame, name) for one in left}
        after = max(left, key=lambda one: len(pairs[one]))
        (here, there), laid = pairs[after].T, [*laid, after]
        both = variance[here] + variance[there]

        def count_apart(moved: FloatArray, here: IntArray = here, both: FloatArray = both) -> int:
            squared = ((moved - ahead[here]) ** 2).sum(axis=1)
            return int(np.count_nonzero(squared > 4.0 * gate**2 * both))

        before = count_apart(ahead[there])
        if not before or len(here) < FEWEST_PAIRS or len(np.unique(name[here])) < FEWEST_NAMES:
            continue
        scale, motion = _fit_similarity(ahead[there], ahead[here])
        now = count_apart(se3.transform(motion, scale * ahead[there]))
        if 2 * now < min(before, len(here)):
            own = sensor == after
            ahead[own] = se3.transform(motion, scale * ahead[own])
    return ahead


def _pair(some: BoolArray, others: BoolArray, frame: IntArray, name: IntArray) -> IntArray:
    """Return (K, 2) rows of detections of one name in one frame: one of `some` (M,), and one of `others` (M,)."""
    key = frame * (int(name.max()) + 1) + name
    one, other = np.flatnonzero(some), np.flatnonzero(others)
    _, a, b = np.intersect1d(key[one], key[other], return_indices=True)
    return np.column_stack([one[a], other[b]])


def _fit_similarity(source: FloatArray, target: FloatArray) -> tuple[float, FloatArray]:
    """Return the scale, and the motion (7,) after it, that lay most of some points (K, 3) over others.

    Least squares (Umeyama 1991) with Cauchy's weights, whose scale is the median distance.
    """
    weight = np.ones(len(source))
    for _ in range(STEPS):
        share = (weight / weight.sum())[:, None]
        a, b = source - (share * source).sum(axis=0), target - (share * target).sum(axis=0)
        turned = se3.transform(se3.turn(rigid(source, target, weight)[3:]), a)
        scale = float((share * turned * b).sum() / max((share * a * a).sum(), 1e-12))
        motion = rigid(scale * source, target, weight)
        away = np.linalg.norm(se3.transform(motion, scale * source) - target, axis=1)
        weight = 1.0 / (1.0 + (away / max(float(np.median(away)), 1e-9)) ** 2)
    return scale, motion


def contradicted(read: Read, settings: VotesConfig) -> tuple[BoolArray, BoolArray]:
    """Return which of M detections those of the seconds around contradict, and which of N names are at two places."""
    at, stamp_s, view, name = read.at, read.stamp_s, read.view, read.name
    near, variance = _find_near(stamp_s, settings.window_s), _learn_variance(read, settings)
    own, others = _votes(at, variance, view, name, near, settings.gate)
    wrong = (others >= settings.fewest) & (others > settings.times * own)
    doubles = _doubles(at, variance, stamp_s, name, ~wrong & (own > 0), settings.gate)
    return wrong, doubles >= settings.fewest_doubles


def _find_near(stamp_s: FloatArray, window_s: float) -> IntArray:
    """Return (M, 2) first row within a window around each, and the one after the last."""
    return np.column_stack([np.searchsorted(stamp_s, stamp_s + sign * window_s) for sign in (-1.0, 1.0)])


def _learn_variance(read: Read, settings: VotesConfig) -> FloatArray:
    """Return variances (M,) of detections by how far those with one name are apart, most of which are right."""
    apart = _apart(read.at, read.variance, read.name, _find_near(read.stamp_s, settings.window_s))
    apart = apart[np.isfinite(apart)]
    if len(apart) < FEWEST_PAIRS:
        return read.variance
    level = np.quantile(apart, 0.25) / FIRST_QUARTILE[read.at.shape[1]]
    return np.asarray(read.variance * np.maximum(level, LEAST_SHARE))


@kernel
def _find_squared(at: FloatArray, variance: FloatArray, j: int, k: int) -> float:
    """Normalised squared distance of two detections."""
    squared = 0.0
    for axis in range(at.shape[1]):
        squared += (at[j, axis] - at[k, axis]) ** 2
    return float(squared / (variance[j] + variance[k]))


@kernel
def _apart(at: FloatArray, variance: FloatArray, name: IntArray, near: IntArray) -> FloatArray:
    """(M,) normalised squared distance of the last detection with the same name in rows `near` (M, 2)."""
    found = np.full(len(at), np.nan)
    for k in range(len(at)):
        for j in range(near[k, 1] - 1, k, -1):
            if name[j] == name[k]:
                found[k] = _find_squared(at, variance, j, k)
                break
    return found


@kernel
def _votes(
    at: FloatArray, variance: FloatArray, view: IntArray, name: IntArray, near: IntArray, gate: float
) -> tuple[IntArray, IntArray]:
    """(M,) detections in rows `near` (M, 2) where each is, with its name, and most with one other name.

    One that is read in the same view is another landmark, which this one is beside.
    """
    own, others = np.zeros(len(at), dtype=np.int64), np.zeros(len(at), dtype=np.int64)
    count = np.zeros(name.max() + 1 if len(name) else 0, dtype=np.int64)
    counted = np.empty(len(at), dtype=np.int64)
    for k in range(len(at)):
        n_counted = 0
        for j in range(near[k, 0], near[k, 1]):
            if (at[j, 0] - at[k, 0]) ** 2 >= 4.0 * gate * gate * (variance[j] + variance[k]):  # most are
                continue
            squared = _find_squared(at, variance, j, k)
            if not squared < 4.0 * gate * gate:
                continue
            if name[j] == name[k]:
                own[k] += j != k
                continue
            beside = view[j] == view[k]
            if beside or squared < gate * gate:
                count[name[j]] += -len(at) if beside else 1
                counted[n_counted] = name[j]
                n_counted += 1
        for j in counted[:n_counted]:
            others[k] = max(others[k], count[j])
            count[j] = 0
    return own, others


@kernel
def _doubles(
    at: FloatArray, variance: FloatArray, stamp_s: FloatArray, name: IntArray, sure: BoolArray, gate: float
) -> IntArray:
    """(N,) pairs of detections with each name, both sure (M,), that are at two places at one time."""
    count = np.zeros(name.max() + 1 if len(name) else 0, dtype=np.int64)
    for k in range(len(at)):
        j = k + 1
        while j < len(at) and stamp_s[j] == stamp_s[k]:
            if name[j] == name[k] and sure[j] and sure[k]:
                count[name[k]] += _find_squared(at, variance, j, k) > 4.0 * gate * gate
            j += 1
    return count
