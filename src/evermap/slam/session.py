"""Between recordings and estimators: what goes into a session's problem, and what comes out as plain arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from evermap.errors import DataError
from evermap.geometry import se2
from evermap.slam.bridge import bridged, dead_reckoned
from evermap.slam.calibration import SPECS, CalibrationPrior
from evermap.slam.changes.explain import GivenMap
from evermap.slam.kernels import NOISE_NAMES
from evermap.slam.noise import START, NoiseFit
from evermap.slam.problem import Drive, Problem, independent
from evermap.slam.streaming import Outcome, PriorMap, StreamingSlam
from evermap.types import (
    UNKNOWN,
    Alternative,
    FloatArray,
    Innovations,
    IntArray,
    Landmarks,
    MapChange,
    Misses,
    ParameterEstimate,
    Recording,
    Trajectory,
)

FIRST_POSE_INFORMATION = 1e8
"""The first pose is the origin, to 0.1 mm."""
TRAJECTORY_STEP_S = 0.1
"""Longest step between poses of the trajectory that is written."""
LONGEST_PAUSE_S = 60.0
"""Longer pauses are divided no further: a clock that was set forward by a day would make a million poses of it."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """A recording as the estimator wants it.

    Attributes:
        problem: stamps count from `start_s`.
        start_s: stamp of the first odometry row.
        pose_frame: (N,) rows of `Recording.frames` that get a pose: those with a usable detection.
        used: (M,) rows of `Recording.detections` that are used.
        landmark_id: (L,) ids behind the problem's landmark rows.
        prior_map: the map to localise in, in those rows.
        warnings: what was left out, counted.
        names: texts behind landmark ids.
    """

    problem: Problem
    start_s: float
    pose_frame: IntArray
    used: IntArray
    landmark_id: IntArray
    prior_map: PriorMap | None
    warnings: tuple[str, ...]
    names: Mapping[int, str] = field(default_factory=dict)

    def given_map(self) -> GivenMap | None:
        """The prior map as the joint search compares with it: landmark by landmark, with covariances."""
        if self.prior_map is None:
            return None
        given, rows = self.prior_map.given, np.arange(len(self.landmark_id))
        blocks = self.prior_map.information.reshape(len(rows), 2, len(rows), 2)[rows, :, rows, :]
        covariance = np.linalg.inv(np.where(given[:, None, None], blocks, np.eye(2)))
        return GivenMap(self.prior_map.mean, covariance, given)


def prepare(recording: Recording, prior_map: Landmarks | None = None, remarks: tuple[str, ...] = ()) -> Prepared:
    """Sort out what can be used: detections of known identity, while there is odometry.

    `remarks` on the recording come before those on what was left out.

    Raises:
        DataError: fewer than two frames with a landmark of known identity.
    """
    odometry, detections = recording.odometry, recording.detections
    if len(odometry) == 0:
        raise DataError(f"{recording.name}: no odometry", hint="velocities or increments in odometry.csv")
    stamps = recording.frames.stamp_s
    warnings = list(remarks)
    anonymous = detections.landmark_id == UNKNOWN
    if anonymous.any():
        warnings.append(f"{int(anonymous.sum())} detections without identity not used")
    moving = (stamps >= odometry.stamp_s[0]) & (stamps <= odometry.stamp_s[-1])
    outside = ~anonymous & ~moving[detections.frame]
    if outside.any():
        warnings.append(f"{int(outside.sum())} detections before the first or after the last odometry not used")
    used = np.flatnonzero(~anonymous & ~outside)
    pose_frame, pose_row = np.unique(detections.frame[used], return_inverse=True)
    if len(pose_frame) < 2:
        raise DataError(
            f"{recording.name}: landmarks of known identity were seen in {len(pose_frame)} frames, at least 2 needed",
            hint="check landmark ids, and that detections and odometry share one clock",
        )
    landmark_id, landmark_row = np.unique(detections.landmark_id[used], return_inverse=True)
    start_s = float(odometry.stamp_s[0])
    velocity = np.column_stack([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps])
    problem = Problem(
        stamp_s=stamps[pose_frame] - start_s,
        drive=Drive.from_rows(odometry.stamp_s - start_s, velocity),
        pose_row=pose_row.astype(np.int64),
        landmark_row=landmark_row.astype(np.int64),
        reading=np.column_stack([detections.range_m[used], detections.bearing_rad[used]]),
        sigma_given=np.column_stack([detections.sigma_range_m[used], detections.sigma_bearing_rad[used]]),
        mount=np.array(recording.sensor.mount_robot_sensor, dtype=np.float64),
        prior=CalibrationPrior.from_settings(calibrated=False, fix={}),
        start_pose=np.zeros(3),
        start_information=FIRST_POSE_INFORMATION,
        landmark_mean=np.zeros((len(landmark_id), 2)),
        landmark_information=np.zeros((2 * len(landmark_id), 2 * len(landmark_id))),
    )
    in_map = None if prior_map is None else _in_rows(prior_map, landmark_id)
    return Prepared(problem, start_s, pose_frame, used, landmark_id, in_map, tuple(warnings), recording.landmark_names)


def trajectory(prepared: Prepared, outcome: Outcome, recording: Recording, frame: str) -> Trajectory:
    """Smoothed poses at all frames, and in between so that no step is longer than `TRAJECTORY_STEP_S`."""
    stamps = _dense_stamps(recording, outcome, prepared.start_s)
    pose, covariance = bridged(
        stamps - prepared.start_s,
        outcome.problem.stamp_s,
        outcome.graph_estimate.pose,
        outcome.graph_marginals.pose,
        outcome.graph_marginals.consecutive,
        outcome.problem.drive,
        outcome.graph_estimate.states,
        outcome.noise.noise,
    )
    pose, covariance = _in_metres(pose, covariance, outcome)
    pose[:, 2] = se2.wrap(pose[:, 2])
    return Trajectory(stamps, pose, covariance, frame=frame, clock=recording.clock)


def rows_at(trajectory: Trajectory, recording: Recording, rows: IntArray) -> IntArray:
    """Rows of a trajectory that holds all frames, at some of the frames."""
    found = np.searchsorted(trajectory.stamp_s, recording.frames.stamp_s[rows] - 1e-9)
    return np.minimum(found, len(trajectory) - 1)


def landmarks(prepared: Prepared, outcome: Outcome, recording: Recording, frame: str) -> Landmarks:
    """The map of a session: positions with covariance, and how often and when each landmark was seen."""
    current = outcome.revision.current
    return _records(
        prepared, outcome, recording, frame, outcome.graph_estimate.landmark[current],
        outcome.graph_marginals.landmark[current],
    )  # fmt: skip


def alternatives(prepared: Prepared, outcome: Outcome, recording: Recording, frame: str) -> tuple[Alternative, ...]:
    """Other explanations of the session, each with its map."""
    return tuple(
        Alternative(
            changes=changes(prepared, outcome, rival.changes),
            probability=rival.probability,
            landmarks=_records(prepared, outcome, recording, frame, rival.position, rival.covariance),
        )
        for rival in outcome.revision.rivals
    )


def _records(
    prepared: Prepared,
    outcome: Outcome,
    recording: Recording,
    frame: str,
    position: FloatArray,
    covariance: FloatArray,
) -> Landmarks:
    """Map records from positions (L, 2) and covariances (L, 2, 2) in the graph's metres."""
    known = np.isfinite(position[:, 0])
    position = position * outcome.scale
    covariance = covariance * outcome.scale**2
    covariance = covariance + outcome.log_scale_sigma**2 * position[:, :, None] * position[:, None, :]
    stamps = recording.frames.stamp_s[recording.detections.frame[prepared.used]]
    count = len(prepared.landmark_id)
    done = prepared.problem.landmark_row[: len(outcome.inlier)]
    first, last = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(first, done, stamps[: len(done)])
    np.maximum.at(last, done, stamps[: len(done)])
    classes = np.full(count, UNKNOWN, dtype=np.int64)
    classes[prepared.problem.landmark_row] = recording.detections.class_id[prepared.used]
    return Landmarks(
        landmark_id=prepared.landmark_id[known],
        position_m=position[known],
        covariance_m2=covariance[known],
        class_id=classes[known],
        p_exists=np.ones(int(known.sum())),
        n_hits=np.bincount(done, minlength=count)[known].astype(np.int64),
        n_misses=np.zeros(int(known.sum()), dtype=np.int64),
        first_seen_s=first[known],
        last_seen_s=last[known],
        class_names=recording.class_names,
        frame=frame,
        clock=recording.clock,
        names=recording.landmark_names,
    )


def changes(prepared: Prepared, outcome: Outcome, moved: tuple[MapChange, ...]) -> tuple[MapChange, ...]:
    """What moved, with the recording's ids and stamps, in metres."""
    return tuple(
        replace(
            change,
            landmark_ids=tuple(sorted(int(prepared.landmark_id[row]) for row in change.landmark_ids)),
            stamp_from_s=change.stamp_from_s + prepared.start_s,
            stamp_to_s=change.stamp_to_s + prepared.start_s,
            displacement_m=(change.displacement_m[0] * outcome.scale, change.displacement_m[1] * outcome.scale),
        ).named(prepared.names)
        for change in moved
    )


def with_misses(landmarks: Landmarks, misses: Misses) -> Landmarks:
    """The map with its misses counted."""
    columns = np.searchsorted(landmarks.landmark_id, misses.landmark_id)
    return replace(landmarks, n_misses=np.bincount(columns, minlength=len(landmarks)).astype(np.int64))


def online(prepared: Prepared, slam: StreamingSlam, recording: Recording, frame: str) -> Trajectory:
    """What the robot knew at the time: the newest pose after every processed frame."""
    done = np.isfinite(slam.online_pose[:, 0])
    pose = slam.online_pose[done].copy()
    pose[:, 2] = se2.wrap(pose[:, 2])
    stamps = recording.frames.stamp_s[prepared.pose_frame[done]]
    return Trajectory(stamps, pose, slam.online_covariance[done], frame=frame, clock=recording.clock)


def innovations(prepared: Prepared, slam: StreamingSlam, outcome: Outcome, recording: Recording) -> Innovations:
    """Consistency of every detection that was predicted."""
    told = np.flatnonzero(np.isfinite(slam.nis[: len(outcome.inlier)]))
    detection = prepared.used[told]
    return Innovations(
        stamp_s=recording.frames.stamp_s[recording.detections.frame[detection]],
        detection=detection,
        landmark_id=recording.detections.landmark_id[detection],
        nis=slam.nis[told],
        p_inlier=outcome.inlier[told],
    )


def parameters(outcome: Outcome, prior: CalibrationPrior) -> tuple[ParameterEstimate, ...]:
    """Calibration states and noise levels with their uncertainty and what was believed before."""
    return described(outcome.estimate.states, outcome.states_covariance, outcome.noise, prior)


def described(
    states: FloatArray, covariance: FloatArray, fit: NoiseFit, prior: CalibrationPrior
) -> tuple[ParameterEstimate, ...]:
    """Calibration states (9,) with their covariance (9, 9), and noise levels, as records."""
    estimates = [
        ParameterEstimate(
            name=spec.name,
            value=float(states[k]),
            sigma=float(np.sqrt(covariance[k, k])) if prior.free[k] else 0.0,
            prior_mean=float(prior.mean[k]),
            prior_sigma=float(prior.sigma[k]) if prior.free[k] else 0.0,
            unit=spec.unit,
            fixed=not prior.free[k],
            meaning=spec.meaning,
        )
        for k, spec in enumerate(SPECS)
    ]
    names = ("sigma_range_m", "sigma_bearing_rad", *NOISE_NAMES)
    levels = np.concatenate([fit.noise.detection, fit.noise.odometry])
    started = np.concatenate([START.detection, START.odometry])
    relative = np.concatenate([fit.detection_relative, fit.odometry_relative])
    meanings = (
        "noise of a range",
        "noise of a bearing",
        "noise of forward motion, by distance",
        "noise of forward motion, by angle turned",
        "noise of sideways motion, by distance",
        "noise of turning, by time",
        "noise of turning, by angle turned",
    )
    units = ("m", "rad", "m/sqrt(m)", "m/sqrt(rad)", "m/sqrt(m)", "rad/sqrt(s)", "rad/sqrt(rad)")
    noise = [
        ParameterEstimate(name, float(level), float(level * r), float(s), float("nan"), unit, meaning=meaning)
        for name, level, r, s, unit, meaning in zip(names, levels, relative, started, units, meanings, strict=True)
    ]
    return (*estimates, *noise)


def dead_reckoning(prepared: Prepared, trajectory: Trajectory) -> Trajectory:
    """Odometry alone, believed as reported, from the first pose on."""
    plain = CalibrationPrior.from_settings(calibrated=False, fix={})
    pose, covariance = dead_reckoned(trajectory.stamp_s - prepared.start_s, prepared.problem.drive, plain.mean, START)
    pose = se2.compose(trajectory.pose_world_robot[0], pose)
    return Trajectory(trajectory.stamp_s, pose, covariance, frame=trajectory.frame, clock=trajectory.clock)


def _in_rows(prior_map: Landmarks, landmark_id: IntArray) -> PriorMap | None:
    """The prior map in the order of this session's landmarks; a sigma of zero means 1 mm."""
    rows = {int(identity): k for k, identity in enumerate(prior_map.landmark_id)}
    mean = np.zeros((len(landmark_id), 2))
    information = np.zeros((len(landmark_id), 2, 2))
    given = np.zeros(len(landmark_id), dtype=bool)
    for k, identity in enumerate(landmark_id):
        if int(identity) in rows:
            row = rows[int(identity)]
            given[k] = True
            mean[k] = prior_map.position_m[row]
            information[k] = np.linalg.inv(prior_map.covariance_m2[row] + 1e-6 * np.eye(2))
    return PriorMap(mean, independent(information), given)


def _dense_stamps(recording: Recording, outcome: Outcome, start_s: float) -> FloatArray:
    """All frames up to the last one processed, with long steps divided."""
    last = start_s + outcome.problem.stamp_s[-1]
    stamps = recording.frames.stamp_s
    stamps = stamps[stamps <= last + 1e-9]
    steps = np.diff(stamps)
    pieces = np.ceil(np.minimum(steps, LONGEST_PAUSE_S) / TRAJECTORY_STEP_S - 1e-9)
    pieces = np.maximum(pieces, 1).astype(np.int64)
    offsets = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    dense = np.repeat(stamps[:-1], pieces) + offsets * np.repeat(steps / pieces, pieces)
    return np.append(dense, stamps[-1])


def _in_metres(pose: FloatArray, covariance: FloatArray, outcome: Outcome) -> tuple[FloatArray, FloatArray]:
    """From the graph's metres to metres, with the uncertainty of the scale."""
    if outcome.scale == 1.0 and outcome.log_scale_sigma == 0.0:
        return pose, covariance
    pose = pose * [outcome.scale, outcome.scale, 1.0]
    stretch = np.array([outcome.scale, outcome.scale, 1.0])
    covariance = covariance * stretch[:, None] * stretch[None, :]
    # a longer world moves a pose away from the origin, along its own position seen in its own frame
    away = np.zeros((len(pose), 3))
    away[:, :2] = se2.transform(se2.inverse(pose * [0.0, 0.0, 1.0]), pose[:, :2])
    return pose, covariance + outcome.log_scale_sigma**2 * away[:, :, None] * away[:, None, :]
