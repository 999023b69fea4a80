"""Input of the estimator: the usable part of a recording, in the plane and in space, and the priors of the plane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import sparse

from evermap.config import OdometryConfig, SlamConfig
from evermap.errors import DataError
from evermap.estimate.measurement import Tied
from evermap.estimate.tie import tie_measurements
from evermap.geometry import se3
from evermap.slam.batch import PriorMap
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.changes.explain import GivenMap
from evermap.slam.noise import start_noise
from evermap.slam.problem import USUAL, Drive, Noise, Problem
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    BoolArray,
    FloatArray,
    IntArray,
    Landmarks,
    Recording,
    Sensor,
    is_in_space,
)
from evermap.valid import WITHOUT_IDS

FIRST_POSE_INFORMATION = 1e8
"""Standard deviation of the first pose, the origin: 0.1 mm."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """A recording as input of the estimator.

    Attributes:
        problem: stamps count from `start_s`.
        start_s: stamp of the first odometry row.
        pose_frame: (N,) rows of `Recording.frames` that get a pose: those with a usable detection.
        used: (M,) rows of `Recording.detections` that are used.
        landmark_id: (L,) ids behind the problem's landmark rows.
        prior_map: the map to localise in, in those rows.
        framed: measurements with a frame of their own, such as GNSS fixes; those of the problem have none.
        warnings: what was left out, counted.
    """

    problem: Problem
    start_s: float
    pose_frame: IntArray
    used: IntArray
    landmark_id: IntArray
    prior_map: PriorMap | None
    warnings: tuple[str, ...]
    framed: tuple[Tied, ...] = ()

    def given_map(self) -> GivenMap | None:
        """Return the prior map as the joint search compares with it: landmark by landmark, with covariances."""
        if self.prior_map is None:
            return None
        given = self.prior_map.given
        covariance = np.linalg.inv(np.where(given[:, None, None], self.prior_map.information, np.eye(2)))
        return GivenMap(self.prior_map.mean, covariance, given)


def prepare(
    recording: Recording,
    prior_map: Landmarks | None = None,
    remarks: tuple[str, ...] = (),
    settings: OdometryConfig = USUAL,
) -> Prepared:
    """Select the usable part: detections of known identity, during the odometry.

    `remarks` on the recording come before those on dropped parts; `settings` has the limits of odometry.

    Raises:
        DataError: fewer than two frames with a landmark of known identity.
    """
    drive, odometry_s, detections = Drive.of(recording, settings), recording.odometry.stamp_s, recording.detections
    stamps = recording.frames.stamp_s
    usable, moving, warnings = usable_detections(recording, remarks)
    seen_in, start_s = frames_of_usable(recording, usable, fewest=2), float(odometry_s[0])
    pose_frame = frames_with_pose(recording, seen_in, moving)
    seen = connect(recording, usable, pose_frame, partial(_driven, drive, start_s))
    used, landmark_id = seen.used, seen.landmark_id
    problem = Problem(
        stamp_s=stamps[pose_frame] - start_s,
        drive=drive,
        pose_row=seen.pose_row,
        landmark_row=seen.place,
        reading=np.column_stack([detections.range_m[used], detections.bearing_rad[used]]),
        sigma_given=np.column_stack([detections.sigma_range_m[used], detections.sigma_bearing_rad[used]]),
        mount=np.array(recording.sensor.mount_robot_sensor, dtype=np.float64),
        prior=CalibrationPrior.from_settings(calibrated=False),
        start_pose=np.zeros(3),
        start_information=FIRST_POSE_INFORMATION,
        landmark_mean=np.zeros((len(landmark_id), 2)),
        landmark_information=sparse.csr_array((2 * len(landmark_id), 2 * len(landmark_id))),
        measurements=tuple(of for of in seen.measurements if of.kind.frame is None),
        noise_by_range=recording.sensor.measures_positions and recording.sensor.sigma_range_m is None,
    )
    framed = tuple(of for of in seen.measurements if of.kind.frame is not None)
    in_map = None if prior_map is None else place_map(prior_map, landmark_id)
    remarks = (*warnings, *seen.left_out)
    return Prepared(problem, start_s, pose_frame, used, landmark_id, in_map, remarks, framed)


def prepare_alike(
    prepared: Prepared, given: Recording, other: Recording, settings: OdometryConfig = USUAL
) -> Prepared | None:
    """Return another recording as input where it has the same poses and detections of the same landmarks; else None.

    What its measurements of other kinds and its map say stays as it was.

    Args:
        prepared: a recording as input.
        given: the recording.
        other: the same recording but for numbers that were measured, stamps or the mount.
        settings: limits of odometry.
    """
    usable, moving, _ = usable_detections(other, ())
    if not np.array_equal(np.flatnonzero(usable), prepared.used):
        return None
    stamps, odometry, seen, used = other.frames.stamp_s, other.odometry, other.detections, prepared.used
    if other.measurements and not np.array_equal(
        frames_with_pose(other, np.unique(seen.frame[used]), moving), prepared.pose_frame
    ):
        return None
    start_s = float(odometry.stamp_s[0])
    problem = replace(
        prepared.problem,
        stamp_s=stamps[prepared.pose_frame] - start_s,
        drive=prepared.problem.drive if odometry is given.odometry else Drive.of(other, settings),
        mount=np.array(other.sensor.mount_robot_sensor, dtype=np.float64),
    )
    if seen is not given.detections:
        problem = replace(
            problem,
            reading=np.column_stack([seen.range_m[used], seen.bearing_rad[used]]),
            sigma_given=np.column_stack([seen.sigma_range_m[used], seen.sigma_bearing_rad[used]]),
        )
    return replace(prepared, problem=problem, start_s=start_s)


class Connected(NamedTuple):
    """What ties poses to places and to each other, in the plane and in space.

    Attributes:
        used: (M,) rows of the recording's detections that are used.
        landmark_id: (P,) sorted ids of the places.
        pose_row, place: (M,) the pose and the place of each detection.
        measurements: of other kinds.
        left_out: remarks on those that could not be tied.
    """

    used: IntArray
    landmark_id: IntArray
    pose_row: IntArray
    place: IntArray
    measurements: tuple[Tied, ...]
    left_out: tuple[str, ...]


def connect(
    recording: AnyRecording,
    usable: BoolArray,
    pose_frame: IntArray,
    motion: Callable[[FloatArray, FloatArray], FloatArray],
) -> Connected:
    """Return what ties the frames that have a pose to what they saw.

    Args:
        recording: as read.
        usable: (D,) detections that are used, all of them in frames with a pose.
        pose_frame: (N,) rows of these frames.
        motion: (K, 7) by the odometry between instants (K,), for measurements between frames.
    """
    used, detections = np.flatnonzero(usable), recording.detections
    landmark_id = landmark_ids(recording, used)
    tied, left_out = tie_measurements(recording.measurements, recording.frames.stamp_s[pose_frame], motion, landmark_id)
    return Connected(
        used,
        landmark_id,
        np.searchsorted(pose_frame, detections.frame[used]),
        np.searchsorted(landmark_id, detections.landmark_id[used]),
        tied,
        tuple(left_out),
    )


def usable_detections(recording: AnyRecording, remarks: tuple[str, ...]) -> tuple[BoolArray, BoolArray, list[str]]:
    """Return detections (M,) of known identity during the odometry, frames (F,) during it, and remarks on the others.

    Without odometry every frame counts; the `remarks` come first.
    """
    detections, stamps, warnings = recording.detections, recording.frames.stamp_s, list(remarks)
    usable = detections.landmark_id != UNKNOWN
    if not usable.all():
        warnings.append(f"{int((~usable).sum())} detections without identity not used")
    moving = np.ones(len(stamps), dtype=np.bool_)
    if recording.odometry is not None:
        driven_s = recording.odometry.stamp_s
        moving = (stamps >= driven_s[0]) & (stamps <= driven_s[-1])
        outside = usable & ~moving[detections.frame]
        if outside.any():
            warnings.append(f"{int(outside.sum())} detections before the first or after the last odometry not used")
        usable &= ~outside
    return usable, moving, warnings


def frames_of_usable(recording: AnyRecording, usable: BoolArray, *, fewest: int) -> IntArray:
    """Return the frames of usable detections (M,).

    Raises:
        DataError: there are less than `fewest`.
    """
    seen_in = np.unique(recording.detections.frame[usable])
    if len(seen_in) >= fewest:
        return seen_in
    hint = "check landmark ids, and that detections and odometry share one clock"
    if (recording.detections.landmark_id == UNKNOWN).all():
        hint = WITHOUT_IDS
    if is_in_space(recording) and np.isfinite(recording.detections.size_m).any():
        hint = "boxes without identities need `odometry`"
    seen = f"landmarks of known identity were seen in {len(seen_in)} frames, at least {fewest} needed"
    raise DataError(f"{recording.name}: {seen}", hint=hint)


def landmark_ids(recording: AnyRecording, used: IntArray) -> IntArray:
    """Return the sorted ids of landmarks in the `used` detections and in further measurements."""
    measured = [table.landmark_id[table.landmark_id != UNKNOWN] for table in recording.measurements]
    return np.unique(np.concatenate([recording.detections.landmark_id[used], *measured]))


def find_bodies(landmark_id: IntArray, objects: IntArray) -> IntArray:
    """Return (K,) numbers of the bodies that landmarks (K,) are on, as `Recording.objects` (N, 2) states them;
    `UNKNOWN` of others.
    """
    found = np.full(len(landmark_id), UNKNOWN)
    _, row, stated = np.intersect1d(landmark_id, objects[:, 0], return_indices=True)
    found[row] = objects[stated, 1]
    return found


def most_of(place: IntArray, class_id: IntArray, count: int) -> IntArray:
    """Return (P,) the class that most detections (M,) of each place say, the first of several; unknown where none.

    Detections of no place (`UNKNOWN`) say nothing.
    """
    known = (class_id != UNKNOWN) & (place != UNKNOWN)
    size = int(class_id.max(initial=0)) + 1
    pair, times = np.unique(place[known] * size + class_id[known], return_counts=True)
    pair = pair[np.lexsort((pair, -times, pair // size))]
    row, first = np.unique(pair // size, return_index=True)
    found = np.full(count, UNKNOWN)
    found[row] = pair[first] % size
    return found


def frames_with_pose(recording: AnyRecording, seen_in: IntArray, moving: BoolArray) -> IntArray:
    """Return rows of the frames that get a pose: those `seen_in`, and the last before each other measurement."""
    stamps, instants = recording.frames.stamp_s, [np.zeros(0)]
    for table in recording.measurements:
        instants += [table.stamp_s, table.columns.get("to_stamp_s", table.stamp_s)]
    before = np.searchsorted(stamps, np.concatenate(instants), side="right") - 1
    return np.union1d(seen_in, before[(before >= 0) & moving[before]])


def _driven(drive: Drive, start_s: float, from_s: FloatArray, to_s: FloatArray) -> FloatArray:
    """Return (K, 7) motions by the odometry between instants (K,), as it was reported."""
    states, found = CalibrationPrior.from_settings(calibrated=False).mean, se3.identity(len(from_s))
    for k, (begin, end) in enumerate(zip(from_s - start_s, to_s - start_s, strict=True)):
        if end > begin:
            found[k] = se3.from_plane(drive.between(np.array([begin, end]), states).increment[0])
    return found


def beliefs(sensor: Sensor, settings: SlamConfig) -> tuple[CalibrationPrior, Noise]:
    """Return the prior of the calibration states and the noise levels before the first frame."""
    calibrated = settings.sensor_model == "calibrated"
    prior = CalibrationPrior.from_settings(settings.calibration, calibrated=calibrated, sensor=sensor)
    start = start_noise(settings.noise, settings.outlier_log_odds)
    nominal = np.array([sensor.sigma_range_m, sensor.sigma_bearing_rad], dtype=np.float64)  # None becomes nan
    detection = np.where(np.isnan(nominal), start.detection, nominal)
    return prior, replace(start, detection=detection, odometry=start.odometry * settings.odometry_noise_factor)


def place_map(prior_map: Landmarks, landmark_id: IntArray) -> PriorMap:
    """Return the prior map in the order of this session's landmarks; a sigma of zero means 1 mm."""
    _, own, row = np.intersect1d(landmark_id, prior_map.landmark_id, return_indices=True)
    mean, information = np.zeros((len(landmark_id), 2)), np.zeros((len(landmark_id), 2, 2))
    mean[own] = prior_map.position_m[row]
    information[own] = np.linalg.inv(prior_map.covariance_m2[row] + 1e-6 * np.eye(2))
    return PriorMap(mean, information, np.isin(np.arange(len(landmark_id)), own))
