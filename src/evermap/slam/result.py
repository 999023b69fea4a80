"""Results of the estimator, as plain arrays with the recording's ids and stamps, in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from evermap.estimate.innovations import find_left_out_nis
from evermap.estimate.measurement import Tied, frame_of
from evermap.geometry import se2
from evermap.slam.batch import Outcome, lay_over
from evermap.slam.bridge import bridge_poses, dead_reckoned
from evermap.slam.calibration import (
    BEARING,
    FORWARD,
    OF_ANGLE,
    OF_SCALE,
    SLOPE,
    SPECS,
    CalibrationPrior,
    far_off,
    from_front,
)
from evermap.slam.estimate import Solved
from evermap.slam.intake import most_of
from evermap.slam.kernels import NOISE_NAMES
from evermap.slam.linearise import detection_residuals
from evermap.slam.noise import START, NoiseFit
from evermap.slam.problem import Drive
from evermap.types import (
    ANY_BEARING_RAD,
    Alternative,
    BoolArray,
    FloatArray,
    Innovations,
    IntArray,
    Landmarks,
    MapChange,
    Misses,
    ParameterEstimate,
    SlamResult,
    Trajectory,
)

TRAJECTORY_STEP_S = 0.1
"""Maximum time between poses of the written trajectory."""
STRONG = 20.0
"""Bayes factor from which readings are strong evidence (Kass & Raftery 1995)."""
LONGEST_PAUSE_S = 60.0
"""Maximum pause that is subdivided: a clock set forward by a day would give a million poses."""

LEAST_LEFT = 1e-6
"""Of a residual, so much is left, or nothing contradicts it."""


def concluded(solved: Solved, scratch: str = "first_pose") -> SlamResult:
    """Return trajectory and map, changes, and alternatives; from `scratch` in the frame of that name."""
    prepared, outcome, recording = solved.prepared, solved.outcome, solved.recording
    frame, revision = (
        frame_of(outcome.problem.measurements, "prior_map") if outcome.aligned else scratch,
        outcome.revision,
    )
    path = trajectory(solved, frame)
    states = described(
        outcome.estimate.states,
        outcome.states_covariance,
        outcome.noise,
        outcome.prior,
        askew=outcome.askew,
        p_needed=outcome.p_needed,
        undivided=outcome.log_scale_sigma > 0.0,
    )
    warnings = [*prepared.warnings, *far_off(states, solved.settings.check)]
    if solved.interrupted:
        done_s, all_s = (float(np.ptp(s)) for s in (path.stamp_s, recording.frames.stamp_s))
        warnings.append(f"interrupted after {done_s:.0f} of {all_s:.0f} s of the recording")
    if prepared.prior_map is not None and frame != "prior_map":
        laid = lay_over(prepared.prior_map, outcome.estimate.landmark, solved.settings.localize)
        why = laid.reason or "too few of the detected landmarks have the relative positions of the map"
        warnings.append(f"cannot localise in the prior map: {why}; the result is in the frame of the first pose")
    place, spread = outcome.graph_estimate.landmark[revision.current], outcome.graph_marginals.landmark
    return SlamResult(
        trajectory=path,
        online=online(solved, frame),
        landmarks=_landmarks(solved, frame, place, spread[revision.current]),
        parameters=states,
        innovations=_innovations(solved),
        misses=Misses.empty(),  # the map has their classes
        step_s=solved.step_s,
        dead_reckoning=dead_reckoning(path, prepared.problem.drive, prepared.start_s),
        warnings=(*warnings, *revision.warnings),
        interrupted=solved.interrupted,
        changes=_changes(solved, revision.changes),
        alternatives=tuple(
            Alternative(
                changes=_changes(solved, rival.changes),
                probability=rival.probability,
                landmarks=_landmarks(solved, frame, rival.position, rival.covariance),
            )
            for rival in revision.rivals
        ),
    )


def trajectory(solved: Solved, frame: str) -> Trajectory:
    """Return smoothed poses at all frames, and in between so that no step is longer than `TRAJECTORY_STEP_S`."""
    stamps = _dense_stamps(solved.recording.frames.stamp_s, solved.end_s)
    pose, covariance = poses_at(solved, stamps)
    return Trajectory(stamps, pose, covariance, frame=frame, clock=solved.recording.clock)


def poses_at(solved: Solved, stamps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return smoothed poses (K, 3) at any stamps (K,), and their covariances (K, 3, 3)."""
    outcome = solved.outcome
    pose, covariance = bridge_poses(
        stamps - solved.prepared.start_s,
        outcome.problem.stamp_s,
        outcome.graph_estimate.pose,
        outcome.graph_marginals.pose,
        outcome.graph_marginals.consecutive,
        outcome.problem.drive,
        outcome.graph_estimate.states,
        outcome.noise.noise,
    )
    pose, covariance = _in_metres(pose, covariance, outcome)
    front = outcome.prior.front(outcome.graph_estimate.states, solved.prepared.problem.mount)
    pose, covariance = from_front(pose, covariance, front)
    pose[:, 2] = se2.wrap(pose[:, 2])
    return pose, covariance


def _landmarks(solved: Solved, frame: str, position: FloatArray, covariance: FloatArray) -> Landmarks:
    """Map records, with how often and when each was seen, from the graph's positions (L, 2) and covariances."""
    prepared, outcome, recording = solved.prepared, solved.outcome, solved.recording
    known = np.isfinite(position[:, 0])
    position = position * outcome.scale
    covariance = add_scale_error(covariance * outcome.scale**2, position, outcome.log_scale_sigma)
    count, done = len(prepared.landmark_id), prepared.problem.landmark_row[: len(outcome.inlier)]
    stamp_s = recording.frames.stamp_s[prepared.pose_frame]
    seen_s = recording.frames.stamp_s[recording.detections.frame[prepared.used]][: len(done)]
    hits, first, last = count_sightings(count, done, seen_s, outcome.problem.measurements, stamp_s)
    classes = most_of(prepared.problem.landmark_row, recording.detections.class_id[prepared.used], count)
    return Landmarks(
        landmark_id=prepared.landmark_id[known],
        position_m=position[known],
        covariance_m2=covariance[known],
        class_id=classes[known],
        p_exists=np.ones(int(known.sum())),
        n_hits=hits[known],
        n_misses=np.zeros(int(known.sum()), dtype=np.int64),
        first_seen_s=first[known],
        last_seen_s=last[known],
        class_names=recording.class_names,
        frame=frame,
        clock=recording.clock,
        names=recording.landmark_names,
    )


def count_sightings(
    count: int, place: IntArray, seen_s: FloatArray, measurements: Sequence[Tied], stamp_s: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return how often each of so many places was seen (P,), when first and when last; infinite where never.

    Args:
        count: P.
        place: (M,) places of detections.
        seen_s: (M,) their stamps.
        measurements: of other kinds; those of places count, too.
        stamp_s: (N,) stamps of the poses.
    """
    tied = [of for of in measurements if of.kind.ties == "pose_place"]
    row = np.concatenate([place, *(of.other for of in tied)])
    at_s = np.concatenate([seen_s, *(stamp_s[of.row] for of in tied)])
    first, last = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(first, row, at_s)
    np.maximum.at(last, row, at_s)
    return np.bincount(row, minlength=count).astype(np.int64), first, last


def add_scale_error(covariance: FloatArray, position: FloatArray, log_sigma: float) -> FloatArray:
    """Return covariances (K, n, n) with what is not known of the metre.

    Args:
        covariance: (K, n, n), of positions first.
        position: (K, D) seen from the origin, in the axes of the covariances.
        log_sigma: standard deviation of the logarithm of all lengths.
    """
    found, dim = covariance.copy(), position.shape[1]
    found[:, :dim, :dim] += log_sigma**2 * position[:, :, None] * position[:, None, :]
    return found


def _changes(solved: Solved, moved: tuple[MapChange, ...]) -> tuple[MapChange, ...]:
    """The changes, with the recording's ids and stamps, in metres."""
    prepared, scale = solved.prepared, solved.outcome.scale
    return tuple(
        replace(
            change,
            landmark_ids=tuple(sorted(int(prepared.landmark_id[row]) for row in change.landmark_ids)),
            stamp_from_s=change.stamp_from_s + prepared.start_s,
            stamp_to_s=change.stamp_to_s + prepared.start_s,
            displacement_m=(change.displacement_m[0] * scale, change.displacement_m[1] * scale),
        ).named(solved.recording.landmark_names)
        for change in moved
    )


def online(solved: Solved, frame: str) -> Trajectory:
    """Return what the robot knew at the time: the newest pose after every processed frame; nothing if not asked for."""
    slam, recording = solved.slam, solved.recording
    if slam is None:
        return Trajectory(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)), frame=frame, clock=recording.clock)
    done = np.isfinite(slam.online_pose[:, 0])
    pose = slam.online_pose[done].copy()
    pose[:, 2] = se2.wrap(pose[:, 2])
    stamps = recording.frames.stamp_s[solved.prepared.pose_frame[done]]
    return Trajectory(stamps, pose, slam.online_covariance[done], frame=frame, clock=recording.clock)


def _innovations(solved: Solved) -> Innovations:
    """Return the NIS of all detections, each as if it had not been used; none of those that say all of a landmark."""
    outcome, detections, problem = solved.outcome, solved.recording.detections, solved.outcome.problem
    sigma = problem.find_sigma(outcome.noise.noise)
    used = outcome.fit_marginals.explained_detections
    left = np.eye(2) - used
    told = np.flatnonzero(np.trace(left, axis1=1, axis2=2) > LEAST_LEFT)
    residual = detection_residuals(problem, outcome.graph_estimate) / sigma
    nis = find_left_out_nis(residual[told], used[told], left[told], outcome.inlier[told])
    detection = solved.prepared.used[told]
    measured: BoolArray = ~(detections.sigma_bearing_rad[detection] >= ANY_BEARING_RAD)
    return Innovations(
        stamp_s=solved.recording.frames.stamp_s[detections.frame[detection]],
        detection=detection,
        landmark_id=detections.landmark_id[detection],
        nis=nis,
        p_inlier=outcome.inlier[told],
        dof=None if measured.all() else 1 + measured.astype(np.int64),
    )


def described(
    states: FloatArray,
    covariance: FloatArray,
    fit: NoiseFit,
    prior: CalibrationPrior,
    *,
    askew: tuple[float, float] = (0.0, 0.0),
    p_needed: FloatArray | None = None,
    undivided: bool = False,
) -> tuple[ParameterEstimate, ...]:
    """Return calibration states (11,) with their covariance (11, 11), driving askew, and noise levels, as records.

    Of errors that are only observable together each has its value if it were the only one, too. With `undivided`, the
    scale is of that kind.
    """
    needs = np.full(len(SPECS), np.nan) if p_needed is None else p_needed.copy()
    needed = float(needs[BEARING])
    meanings = {spec.name: spec.meaning for spec in SPECS}
    pairs: dict[str, dict[str, Any]] = {}
    if undivided:
        scale = states[FORWARD] * (1.0 + states[SLOPE])
        meanings["range_slope"] += f"; {scale - 1.0:.4f} if the odometer were right"
        meanings["odometry_forward_scale"] += f"; {scale:.4f} if ranges were right"
        evident = any(_evident(needs[state], prior.p_needed[state]) for state in (SLOPE, FORWARD))
        pairs |= show_together("range_slope", scale - 1.0, "odometry_forward_scale", scale, OF_SCALE, evident)
    if askew[1] > 0.0:
        angle = states[BEARING] + askew[0]
        meanings["bearing_bias_rad"] += f"; {angle:.4f} if the robot drove straight"
        meanings["odometry_askew_rad"] = (
            f"driving direction to the left of the robot's front; {angle:.4f} if the sensor were mounted as stated"
        )
        evident = _evident(needed, prior.p_needed[BEARING])
        pairs |= show_together("bearing_bias_rad", angle, "odometry_askew_rad", angle, OF_ANGLE, evident)
        needs[BEARING] = needed if prior.angle_share > 0.0 else np.nan  # what is needed is the other one
    estimates = [
        ParameterEstimate(
            name=spec.name,
            value=float(states[k]),
            sigma=float(np.sqrt(covariance[k, k])) if prior.free[k] else 0.0,
            prior_mean=float(prior.mean[k]),
            prior_sigma=float(prior.sigma[k]) if prior.free[k] else 0.0,
            unit=spec.unit,
            fixed=not prior.free[k],
            meaning=meanings[spec.name],
            p_needed=float(needs[k]),
            **pairs.get(spec.name, {}),
        )
        for k, spec in enumerate(SPECS)
    ]
    if askew[1] > 0.0:
        name = "odometry_askew_rad"
        more: dict[str, Any] = {"meaning": meanings[name], "p_needed": needed, **pairs[name]}
        estimates.append(ParameterEstimate(name, *askew, 0.0, prior.askew_sigma, "rad", **more))
    return (*estimates, *_levels(fit))


def show_together(
    one: str, one_alone: float, other: str, other_alone: float, decided_by: tuple[str, ...], evident: bool
) -> dict[str, dict[str, Any]]:
    """Return what `ParameterEstimate` says of two errors that only show together, by their names."""
    both: dict[str, Any] = {"decided_by": decided_by, "evident": evident}
    return {
        one: {"alone": float(one_alone), "shown_with": other, **both},
        other: {"alone": float(other_alone), "shown_with": one, **both},
    }


def _evident(p_needed: float, before: float) -> bool:
    """Return whether readings made it clearly more probable that a state is needed, and it probably is."""
    return bool(p_needed >= 0.5 and p_needed * (1.0 - before) > STRONG * before * (1.0 - p_needed))


def _levels(fit: NoiseFit) -> list[ParameterEstimate]:
    """Noise levels as records."""
    names = ("sigma_range_m", "sigma_bearing_rad", *NOISE_NAMES)
    levels, started = fit.noise.levels, START.levels
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
    return [
        ParameterEstimate(name, float(level), float(level * r), float(s), float("nan"), unit, meaning=meaning)
        for name, level, r, s, unit, meaning in zip(names, levels, relative, started, units, meanings, strict=True)
    ]


def dead_reckoning(trajectory: Trajectory, drive: Drive, start_s: float) -> Trajectory:
    """Return odometry alone, believed as reported, from the first pose on; `drive` counts from `start_s`."""
    plain = CalibrationPrior.from_settings(calibrated=False)
    pose, covariance = dead_reckoned(trajectory.stamp_s - start_s, drive, plain.mean, START)
    pose = se2.compose(trajectory.pose_world_robot[0], pose)
    return replace(trajectory, pose_world_robot=pose, covariance=covariance)


def _dense_stamps(stamps: FloatArray, last_s: float) -> FloatArray:
    """Return the stamps of all frames up to the last processed one, with long steps divided."""
    stamps = stamps[stamps <= last_s + 1e-9]
    steps = np.diff(stamps)
    pieces = np.ceil(np.minimum(steps, LONGEST_PAUSE_S) / TRAJECTORY_STEP_S - 1e-9)
    pieces = np.maximum(pieces, 1).astype(np.int64)
    offsets = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    dense = np.repeat(stamps[:-1], pieces) + offsets * np.repeat(steps / pieces, pieces)
    return np.append(dense, stamps[-1])


def _in_metres(pose: FloatArray, covariance: FloatArray, outcome: Outcome) -> tuple[FloatArray, FloatArray]:
    """Convert the graph's lengths to metres, with the uncertainty of the scale."""
    if outcome.scale == 1.0 and outcome.log_scale_sigma == 0.0:
        return pose, covariance
    pose = pose * [outcome.scale, outcome.scale, 1.0]
    stretch = np.array([outcome.scale, outcome.scale, 1.0])
    covariance = covariance * stretch[:, None] * stretch[None, :]
    # a longer world moves a pose away from the origin, along its own position seen in its own frame
    return pose, add_scale_error(covariance, -se2.inverse(pose)[:, :2], outcome.log_scale_sigma)
