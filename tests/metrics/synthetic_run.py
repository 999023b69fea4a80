"""A made-up recording with truth and a made-up estimate of it, whose errors are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from evermap.geometry import se2, se3
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
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
    rows_of,
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


def spatial_trajectory(stamp_s, poses, sigma=(0.0,) * 6, frame="first_pose"):
    covariance = np.broadcast_to(np.diag(np.square(sigma)), (len(stamp_s), 6, 6))
    return Trajectory(np.asarray(stamp_s, float), np.asarray(poses, float), covariance.copy(), frame)


def spiral_stair(stamp_s, width_m=4.0, period_s=40.0, climb_mps=0.06):
    """Poses (N, 7) on a stair around a square shaft, swaying a little, looking ahead."""
    phase = 2 * np.pi * stamp_s / period_s
    xyz = np.stack([width_m * np.cos(phase), 0.7 * width_m * np.sin(phase), climb_mps * stamp_s + 1.5], axis=1)
    yaw = np.unwrap(np.arctan2(0.7 * np.cos(phase), -np.sin(phase)))
    sway = np.stack([0.1 * np.sin(5 * phase), 0.08 * np.cos(7 * phase)], axis=1)
    quaternion = Rotation.from_euler("ZYX", np.column_stack([yaw, sway])).as_quat()
    return se3.normalise_poses(np.column_stack([xyz, quaternion]))


LOOKING_AHEAD = (0.1, 0.0, 0.2, -0.5, 0.5, -0.5, 0.5)
"""A camera on the robot: x right, y down, z ahead."""


def walls_with_tags(rng, count, height_m):
    """Poses (count, 7) of tags on four walls, z into the wall, and of three boxes that stand on the floor."""
    side = np.arange(count) % 4
    along, height = rng.uniform(-4.0, 4.0, count), rng.uniform(0.5, height_m, count)
    at = np.select(
        [(side == k)[:, None] for k in range(4)],
        [
            np.column_stack([np.full(count, 6.0), along, height]),
            np.column_stack([along, np.full(count, 4.5), height]),
            np.column_stack([np.full(count, -6.0), along, height]),
            np.column_stack([along, np.full(count, -4.5), height]),
        ],
    )
    turn = Rotation.from_euler("z", side[:, None] * np.pi / 2) * Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])
    boxes = np.column_stack([[1.0, -1.5, 0.2], [0.5, -1.0, 1.6], np.full(3, 0.4)])
    yaw = Rotation.from_euler("z", [[0.3], [1.2], [-0.7]]).as_quat()
    tags = se3.normalise_poses(np.column_stack([at, turn.as_quat()]))
    return np.concatenate([tags, se3.normalise_poses(np.column_stack([boxes, yaw]))])


def make_spatial_run(seed=0, duration_s=80.0, n_tags=16, sigma=(0.03, 0.03, 0.03, 0.01, 0.01, 0.01)):
    """(recording, result) in space: a stair, tags on walls, boxes and a lamp, with errors of `sigma`."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(0.0, duration_s, 0.1)
    true = spiral_stair(stamps)
    truth = spatial_trajectory(stamps, true, frame="truth")
    first = true[0]
    noise = rng.normal(size=(len(stamps), 6)) * sigma
    noise[0] = 0
    smoothed = spatial_trajectory(stamps, se3.retract(se3.between(first, true), noise), sigma)
    smoothed.covariance[0] = 0
    wilder = se3.retract(smoothed.pose_world_robot, rng.normal(size=noise.shape) * sigma)
    online = spatial_trajectory(stamps, wilder, 1.4 * np.array(sigma))
    drifting = [se3.identity()]
    for step in se3.between(true[:-1], true[1:]):
        drifting.append(se3.compose(drifting[-1], se3.compose(step, se3.exp([0.002, 0, 0.001, 0, 0.0002, 0.0006]))))
    places = np.concatenate([walls_with_tags(rng, n_tags, 5.5), [[*(0.0, 0.0, 6.0), *(np.nan,) * 4]]])
    count = len(places)
    ids = np.arange(1, count + 1) * 5
    size = np.full((count, 3), np.nan)
    size[n_tags : n_tags + 3] = [[1.2, 0.5, 0.8], [0.8, 0.8, 0.8], [1.0, 0.6, 0.5]]
    kind = np.repeat([0, 1, 2], [n_tags, 3, 1])
    detections = _spatial_detections(rng, ids, places, size, kind, se3.compose(true, LOOKING_AHEAD))
    hits = np.bincount(np.searchsorted(ids, detections.landmark_id), minlength=count)
    table = {
        "landmark_id": ids, "class_id": kind, "p_exists": np.ones(count), "n_hits": hits,
        "n_misses": np.zeros(count, int), "first_seen_s": rng.uniform(0, 9, count), "last_seen_s": np.full(count, 70.0),
        "class_names": ("tag", "crate", "lamp"), "size_m": size,
    }  # fmt: skip
    spread = np.array([0.04, 0.02, 0.03])
    surveyed = Landmarks(
        position_m=places[:, :3], covariance_m2=np.zeros((count, 3, 3)), rotation=places[:, 3:],
        rotation_covariance=np.zeros((count, 3, 3)), frame="truth", **table,
    )  # fmt: skip
    local = se3.between(first, np.nan_to_num(places) + np.where(np.isnan(places), [0, 0, 0, 0, 0, 0, 1.0], 0.0))
    local = se3.retract(local, rng.normal(size=(count, 6)) * [0, 0, 0, 0.01, 0.01, 0.01])
    local[:, :3] += rng.normal(size=(count, 3)) * spread
    landmarks = Landmarks(
        position_m=local[:, :3], covariance_m2=np.tile(np.diag(spread**2), (count, 1, 1)),
        rotation=np.where(np.isnan(places[:, 3:]), np.nan, local[:, 3:]),
        rotation_covariance=np.tile(1e-4 * np.eye(3), (count, 1, 1)), **table,
    )  # fmt: skip
    dof = np.where(detections.landmark_id == ids[-1], 3, 6)
    innovations = Innovations(
        stamps[detections.frame], np.arange(len(dof)), detections.landmark_id, rng.chisquare(dof),
        (rng.random(len(dof)) > 0.02).astype(float), dof,
    )  # fmt: skip
    recording = SpatialRecording(
        name="stair",
        odometry=SpatialOdometry(stamps, np.array(drifting), np.full((len(stamps), 6), np.nan)),
        frames=Frames(stamps),
        detections=detections,
        sensors=(SpatialSensor("camera", LOOKING_AHEAD),),
        truth=truth,
        true_landmarks=surveyed,
        class_names=("tag", "crate", "lamp"),
        source="/data/stair",
    )
    parameters = (
        ParameterEstimate("camera_delay_s", 0.021, 0.001, 0.0, 0.1, "s", meaning="images are older than their stamps"),
        ParameterEstimate("mount_roll_rad", -0.012, 0.002, 0.0, 0.05, "rad", meaning="camera turned on the robot"),
        ParameterEstimate("sigma_px", 0.41, 0.01, 1.0, float("nan"), "px", meaning="noise of a corner"),
    )
    result = SlamResult(
        trajectory=smoothed,
        online=online,
        landmarks=landmarks,
        parameters=parameters,
        innovations=innovations,
        misses=Misses.empty(),
        step_s=rng.lognormal(np.log(2e-3), 0.4, len(stamps)),
        dead_reckoning=spatial_trajectory(stamps, drifting),
    )
    return recording, result


def _spatial_detections(rng, ids, places, size, kind, camera):
    """What a camera (F, 7) sees of landmarks (L, 7) within 7 m and 50 degrees of its axis, every third time."""
    frame, which, seen = [], [], []
    for row, pose in enumerate(camera):
        at = se3.transform(se3.inverse(pose), places[:, :3])
        near = (np.linalg.norm(at, axis=1) < 7.0) & (at[:, 2] > 0.6 * np.linalg.norm(at, axis=1))
        for k in np.flatnonzero(near & (rng.random(len(ids)) < 0.3)):
            frame.append(row)
            which.append(k)
            turned = se3.between(pose, places[k])[3:] if np.isfinite(places[k]).all() else np.full(4, np.nan)
            seen.append([*(at[k] + rng.normal(0, 0.02, 3)), *turned])
    count, seen, which = len(frame), np.array(seen), np.array(which)
    return SpatialDetections(
        np.array(frame), np.zeros(count, int), ids[which], seen[:, :3], seen[:, 3:],
        np.tile(4e-4 * np.eye(3), (count, 1, 1)), np.full(count, 0.02), np.full((count, 4, 2), np.nan),
        np.where(kind[which] == 0, 0.16, np.nan), size[which], kind[which], np.full(count, np.nan),
        np.zeros(count, int),
    )  # fmt: skip


def with_spatial_changes(result):
    """The result with a tag that moved up its wall, a crate that was turned, and two landmarks that are gone."""
    ids, start_s = result.landmarks.landmark_id, float(result.trajectory.stamp_s[0])
    nan = float("nan")
    changes = (
        MapChange((int(ids[0]),), ChangeKind.MOVED, nan, start_s, (0.2, 0.1, 0.9), 0.0, 0.98),
        MapChange((int(ids[16]), int(ids[17])), ChangeKind.ROTATED, 20.0, 31.0, (0.7, -0.4, 0.0), 0.5, 0.9),
        MapChange((int(ids[3]),), ChangeKind.VANISHED, nan, start_s, (nan, nan, nan), 0.0, 0.93),
    )
    rows = np.arange(len(ids))
    kept, gone = (rows_of(result.landmarks, rows[mask]) for mask in (rows != 3, rows == 3))
    return replace(result, landmarks=kept, gone=gone, changes=changes)
