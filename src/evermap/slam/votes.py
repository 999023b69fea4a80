"""Detection of wrong identities, by votes of detections within seconds.

Carried to one pose by odometry, which is good for some seconds, detections of one landmark lie together. Several with
one id, and none or hardly any with its own anywhere near, say that an id was read wrongly. How far detections of one
landmark lie apart is told by those with one id, of which most are right. An id that is read at two places in one frame,
time and again, is on two landmarks, and says nothing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evermap.config import SlamConfig, VotesConfig
from evermap.errors import DataError
from evermap.geometry import se3
from evermap.slam.batch import sighted_at
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
    at = sighted_at(pose[problem.pose_row], problem.reading, problem.prior.mean, problem.mount)
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
    pose = se3.compose(intake.driven_pose[row], problem.mount[sensor])
    at = se3.transform(pose, problem.measured[voting, :3])
    variance = (np.linalg.inv(problem.measured_root[voting]) ** 2).sum(axis=(1, 2)) / 3.0
    view = row * len(problem.mount) + sensor
    return intake.used[voting], Read(at, variance, problem.stamp_s[row], view, problem.place[voting])


def contradicted(read: Read, settings: VotesConfig) -> tuple[BoolArray, BoolArray]:
    """Return which of M detections those of the seconds around contradict, and which of N names are at two places."""
    at, variance, stamp_s, view, name = read
    near = np.column_stack([np.searchsorted(stamp_s, stamp_s + sign * settings.window_s) for sign in (-1.0, 1.0)])
    apart = _apart(at, variance, name, near)
    apart = apart[np.isfinite(apart)]
    if len(apart) >= FEWEST_PAIRS:
        variance = variance * np.maximum(np.quantile(apart, 0.25) / FIRST_QUARTILE[at.shape[1]], LEAST_SHARE)
    own, others = _votes(at, variance, view, name, near, settings.gate)
    wrong = (others >= settings.fewest) & (others > settings.times * own)
    doubles = _doubles(at, variance, stamp_s, name, ~wrong & (own > 0), settings.gate)
    return wrong, doubles >= settings.fewest_doubles


@kernel
def _squared(at: FloatArray, variance: FloatArray, j: int, k: int) -> float:
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
                found[k] = _squared(at, variance, j, k)
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
            squared = _squared(at, variance, j, k)
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
                count[name[k]] += _squared(at, variance, j, k) > 4.0 * gate * gate
            j += 1
    return count
