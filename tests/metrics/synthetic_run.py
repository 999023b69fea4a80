"""A made-up recording with truth and a made-up estimate of it, whose errors are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.geometry import se2
from evermap.types import (
    Alternative,
    ChangeKind,
    Detections,
    Frames,
    Innovations,
    Landmarks,
    MapChange,
    Misses,
    Odometry,
    ParameterEstimate,
    Recording,
    RobotSightings,
    SlamResult,
    Trajectory,
)


def trajectory(stamp_s, poses, sigma=(0.0, 0.0, 0.0), frame="first_pose"):
    covariance = np.zeros((len(stamp_s), 3, 3))
    covariance[:, range(3), range(3)] = np.square(sigma)
    return Trajectory(np.asarray(stamp_s, float), np.asarray(poses, float), covariance, frame)


def figure_eight(stamp_s, width_m=6.0, period_s=120.0):
    phase = 2 * np.pi * stamp_s / period_s
    x, y = width_m * np.sin(phase), 0.5 * width_m * np.sin(2 * phase)
    dx, dy = np.cos(phase), np.cos(2 * phase)
    return np.stack([x, y, np.arctan2(dy, dx)], axis=1)


def make_run(seed=0, duration_s=300.0, frame_rate_hz=5.0, n_landmarks=14, sigma=(0.03, 0.03, 0.01)):
    """(recording, result): truth plus independent Gaussian errors of `sigma`, in the frame of the first pose."""
    rng = np.random.default_rng(seed)
    dense = np.arange(0.0, duration_s, 0.05)
    truth_poses = figure_eight(dense)
    truth = trajectory(dense, truth_poses, frame="truth")

    stamps = np.arange(0.0, duration_s, 1.0 / frame_rate_hz)
    stamps = stamps[~((stamps > 100.0) & (stamps < 130.0))] + rng.uniform(0, 0.01)  # a blind stretch
    with_gap = np.unique(np.concatenate([stamps, np.arange(100.0, 130.0, 0.5)]))
    world_first = se2.compose(figure_eight(with_gap[:1])[0], [0.0, 0.0, 0.0])
    blind = np.interp(with_gap, [100.0, 115.0, 130.0], [0.0, 4.0, 0.0])
    scale = np.clip(1 + blind, 1, None)[:, None] * np.asarray(sigma)
    noise = rng.normal(size=(len(with_gap), 3)) * scale
    noise[0] = 0
    local = se2.compose(se2.between(world_first, figure_eight(with_gap)), se2.exp(noise))
    covariance = np.zeros((len(with_gap), 3, 3))
    covariance[:, range(3), range(3)] = scale**2
    smoothed = Trajectory(with_gap, local, covariance, "first_pose")
    at_frames = np.isin(with_gap, stamps)
    online = Trajectory(
        with_gap[at_frames],
        se2.compose(local[at_frames], se2.exp(rng.normal(size=(at_frames.sum(), 3)) * np.asarray(sigma))),
        2 * covariance[at_frames],
    )
    turn_error = 0.004 * (with_gap - with_gap[0])
    steps = se2.between(local[:-1], local[1:])
    drifting = [np.zeros(3)]
    for step, extra in zip(steps, np.diff(turn_error), strict=True):
        drifting.append(se2.compose(drifting[-1], step + np.array([0.02 * step[0], 0, extra])))
    dead_reckoning = trajectory(with_gap, np.array(drifting))

    ids = np.arange(1, n_landmarks + 1) * 3
    surveyed = rng.uniform([-8, -5], [8, 5], (n_landmarks, 2))
    true_landmarks = Landmarks.at(ids, surveyed)
    frame, which = np.nonzero(rng.random((len(stamps), n_landmarks)) < 0.12)
    robot = figure_eight(stamps)[frame]
    seen = se2.transform(se2.inverse(robot), surveyed[which])
    range_m, bearing = np.hypot(*seen.T), np.arctan2(seen[:, 1], seen[:, 0])
    visible = (range_m < 6) & (np.abs(bearing) < 0.9)
    frame, which, range_m, bearing = frame[visible], which[visible], range_m[visible], bearing[visible]
    count = len(frame)
    blank = np.full(count, np.nan)
    detections = Detections(
        frame,
        ids[which],
        range_m + rng.normal(0, 0.03, count),
        bearing + rng.normal(0, 0.01, count),
        np.full(count, -1),
        blank,
        blank,
        np.zeros(count, int),
    )
    hits = np.bincount(which, minlength=n_landmarks)
    first = np.array([stamps[frame[which == k]].min(initial=np.inf) for k in range(n_landmarks)])
    last = np.array([stamps[frame[which == k]].max(initial=-np.inf) for k in range(n_landmarks)])
    mapped = hits > 0
    landmark_sigma = 0.25 / np.sqrt(np.maximum(hits, 1))
    local_landmarks = se2.transform(se2.inverse(world_first), surveyed)
    local_landmarks = local_landmarks + rng.normal(size=(n_landmarks, 2)) * landmark_sigma[:, None]
    base = Landmarks.at(ids[mapped], local_landmarks[mapped], sigma_m=landmark_sigma[mapped], frame="first_pose")
    landmarks = Landmarks(
        base.landmark_id,
        base.position_m,
        base.covariance_m2,
        base.class_id,
        base.p_exists,
        hits[mapped],
        np.full(mapped.sum(), 3),
        first[mapped],
        last[mapped],
    )
    nis = rng.chisquare(2, count)
    p_inlier = np.ones(count)
    outlier = rng.random(count) < 0.02
    nis[outlier] *= 30
    p_inlier[outlier] = 0.03
    innovations = Innovations(stamps[frame], np.arange(count), ids[which], nis, p_inlier)
    odometry = Odometry(
        dense,
        np.full(len(dense), 0.3),
        np.zeros(len(dense)),
        np.gradient(np.unwrap(truth_poses[:, 2]), dense),
    )
    parameters = (
        ParameterEstimate("odometry_delay_s", 0.21, 0.004, 0.0, 0.3, "s", meaning="odometry lags the true motion"),
        ParameterEstimate("forward_scale", 0.957, 0.003, 1.0, 0.1, "1", meaning="true over reported forward speed"),
        ParameterEstimate("angular_scale", 0.982, 0.002, 1.0, 0.1, "1", meaning="true over reported turn rate"),
        ParameterEstimate("bearing_bias_rad", 0.0011, 0.0006, 0.0, 0.05, "rad", meaning="camera turned in its mount"),
        ParameterEstimate("range_bias_m", 0.061, 0.002, 0.0, 0.2, "m", meaning="added to every range"),
        ParameterEstimate("range_slope", 0.012, 0.002, 0.0, 0.05, "1", fixed=False, meaning="range grows too fast"),
        ParameterEstimate("range_bearing", -0.49, 0.01, 0.0, 0.5, "1/rad^2", meaning="depth rather than distance"),
        ParameterEstimate("mount_x_m", 0.0, 0.0, np.nan, np.nan, "m", fixed=True, meaning="sensor ahead of the axle"),
        ParameterEstimate("sigma_range_m", 0.019, 0.0004, np.nan, np.nan, "m", meaning="noise of one range"),
        ParameterEstimate("sigma_bearing_rad", 0.0083, 0.0002, np.nan, np.nan, "rad", meaning="noise of one bearing"),
    )
    recording = Recording(
        name="figure of eight",
        odometry=odometry,
        frames=Frames(stamps),
        detections=detections,
        truth=truth,
        true_landmarks=true_landmarks,
        robot_sightings=RobotSightings(np.arange(5.0), np.ones(5, int), np.ones(5), np.zeros(5)),
        warnings=("3 detections of unknown barcodes dropped",),
        source="/data/figure_of_eight <raw>",
    )
    result = SlamResult(
        trajectory=smoothed,
        online=online,
        landmarks=landmarks,
        parameters=parameters,
        innovations=innovations,
        misses=Misses(np.zeros(4, int), ids[:4], np.full(4, 0.5)),
        step_s=rng.lognormal(np.log(1.5e-3), 0.4, len(stamps)),
        dead_reckoning=dead_reckoning,
        warnings=("12 detections treated as outliers",),
    )
    return recording, result


def with_changes(result):
    """The result with three changes (moved before the session, turned within it, exchanged) and two alternatives."""
    ids = result.landmarks.landmark_id.tolist()
    start_s = float(result.trajectory.stamp_s[0])
    nan = float("nan")
    changes = (
        MapChange(tuple(ids[:3]), ChangeKind.MOVED, nan, start_s, (-1.0, 0.0), 0.0, 0.97),
        MapChange(tuple(ids[3:6]), ChangeKind.ROTATED, 150.0, 158.0, (0.3, -0.5), 0.35, 0.8),
        MapChange(tuple(ids[6:8]), ChangeKind.SWAPPED, nan, start_s, (0.0, 0.0), 0.0, 0.999),
    )
    moved = result.landmarks.position_m + [1.0, 0.0]  # the map as it is if the first three stayed where they were
    complement = MapChange(tuple(ids[3:]), ChangeKind.MOVED, nan, start_s, (1.0, 0.0), 0.0, 0.12)
    alternatives = (
        Alternative((complement,), 0.12, replace(result.landmarks, position_m=moved)),
        Alternative((), 0.001, result.landmarks),
    )
    return replace(result, changes=changes, alternatives=alternatives)
