"""Input of the estimator: the usable part of a recording, and the priors before its first frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from evermap.config import OdometryConfig, SlamConfig
from evermap.errors import DataError
from evermap.slam.batch import PriorMap
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.changes.explain import GivenMap
from evermap.slam.noise import start_noise
from evermap.slam.problem import USUAL, Drive, Noise, Problem
from evermap.types import UNKNOWN, IntArray, Landmarks, Recording, Sensor
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
        warnings: what was left out, counted.
    """

    problem: Problem
    start_s: float
    pose_frame: IntArray
    used: IntArray
    landmark_id: IntArray
    prior_map: PriorMap | None
    warnings: tuple[str, ...]

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
    warnings = list(remarks)
    anonymous = detections.landmark_id == UNKNOWN
    if anonymous.any():
        warnings.append(f"{int(anonymous.sum())} detections without identity not used")
    moving = (stamps >= odometry_s[0]) & (stamps <= odometry_s[-1])
    outside = ~anonymous & ~moving[detections.frame]
    if outside.any():
        warnings.append(f"{int(outside.sum())} detections before the first or after the last odometry not used")
    used = np.flatnonzero(~anonymous & ~outside)
    pose_frame, pose_row = np.unique(detections.frame[used], return_inverse=True)
    if len(pose_frame) < 2:
        seen = f"landmarks of known identity were seen in {len(pose_frame)} frames, at least 2 needed"
        hint = "check landmark ids, and that detections and odometry share one clock"
        raise DataError(f"{recording.name}: {seen}", hint=WITHOUT_IDS if anonymous.all() else hint)
    landmark_id, landmark_row = np.unique(detections.landmark_id[used], return_inverse=True)
    start_s = float(odometry_s[0])
    problem = Problem(
        stamp_s=stamps[pose_frame] - start_s,
        drive=drive,
        pose_row=pose_row.astype(np.int64),
        landmark_row=landmark_row.astype(np.int64),
        reading=np.column_stack([detections.range_m[used], detections.bearing_rad[used]]),
        sigma_given=np.column_stack([detections.sigma_range_m[used], detections.sigma_bearing_rad[used]]),
        mount=np.array(recording.sensor.mount_robot_sensor, dtype=np.float64),
        prior=CalibrationPrior.from_settings(calibrated=False),
        start_pose=np.zeros(3),
        start_information=FIRST_POSE_INFORMATION,
        landmark_mean=np.zeros((len(landmark_id), 2)),
        landmark_information=sparse.csr_array((2 * len(landmark_id), 2 * len(landmark_id))),
    )
    in_map = None if prior_map is None else _in_rows(prior_map, landmark_id)
    return Prepared(problem, start_s, pose_frame, used, landmark_id, in_map, tuple(warnings))


def beliefs(sensor: Sensor, settings: SlamConfig) -> tuple[CalibrationPrior, Noise]:
    """Return the prior of the calibration states and the noise levels before the first frame."""
    calibrated = settings.sensor_model == "calibrated"
    prior = CalibrationPrior.from_settings(settings.calibration, calibrated=calibrated, sensor=sensor)
    start = start_noise(settings.noise, settings.outlier_log_odds)
    nominal = np.array([sensor.sigma_range_m, sensor.sigma_bearing_rad], dtype=np.float64)  # None becomes nan
    detection = np.where(np.isnan(nominal), start.detection, nominal)
    return prior, replace(start, detection=detection, odometry=start.odometry * settings.odometry_noise_factor)


def _in_rows(prior_map: Landmarks, landmark_id: IntArray) -> PriorMap | None:
    """The prior map in the order of this session's landmarks; a sigma of zero means 1 mm."""
    _, own, row = np.intersect1d(landmark_id, prior_map.landmark_id, return_indices=True)
    mean, information = np.zeros((len(landmark_id), 2)), np.zeros((len(landmark_id), 2, 2))
    mean[own] = prior_map.position_m[row]
    information[own] = np.linalg.inv(prior_map.covariance_m2[row] + 1e-6 * np.eye(2))
    return PriorMap(mean, information, np.isin(np.arange(len(landmark_id)), own))
