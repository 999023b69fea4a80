"""The benchmark's input: a robot that drives round and round among fifteen landmarks, with noisy odometry."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.geometry import se2
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.intake import prepare
from evermap.slam.kernels import integrate_odometry
from evermap.slam.noise import START
from evermap.slam.problem import Noise, Problem
from evermap.types import UNKNOWN, Detections, FloatArray, Frames, IntArray, Odometry, Recording

N_LANDMARKS = 15
FRAME_S, ODOMETRY_S = 0.5, 0.05
SPEED_MPS, RADIUS_M = 0.4, 4.0
VIEW_M, VIEW_RAD = 5.0, 0.7
SIGMA_RANGE_M, SIGMA_BEARING_RAD = 0.03, 0.01


@dataclass(frozen=True, slots=True)
class World:
    """A problem with its truth, in the frame of the first pose.

    Attributes:
        problem, noise: what every contender is given.
        pose: (N, 3) true poses; landmark: (L, 2) true positions.
        increment: (N - 1, 3) odometry between poses, and its covariance (N - 1, 3, 3), for those who cannot integrate.
    """

    problem: Problem
    noise: Noise
    pose: FloatArray
    landmark: FloatArray
    increment: FloatArray
    covariance: FloatArray


def circular_world(n_poses: int, *, calibrated: bool, seed: int = 0) -> World:
    """`n_poses` frames at 2 Hz; with `calibrated`, the calibration states are free (their true values are nominal)."""
    rng = np.random.default_rng(seed)
    steps = int(FRAME_S / ODOMETRY_S)
    stamp = ODOMETRY_S * np.arange(n_poses * steps + 1)
    turn = SPEED_MPS / RADIUS_M * (1.0 + 0.5 * np.sin(stamp / 7.0))
    velocity = np.column_stack([np.full_like(stamp, SPEED_MPS), np.zeros_like(stamp), turn])
    dense = np.zeros((len(stamp), 3))
    twist = ODOMETRY_S * velocity
    moved = se2.exp(twist)
    for k in range(len(stamp) - 1):
        dense[k + 1] = se2.compose(dense[k], moved[k])
    pose = dense[::steps][:n_poses]

    noise = Noise(
        detection=np.array([SIGMA_RANGE_M, SIGMA_BEARING_RAD]),
        odometry=np.array([0.02, 0.02, 0.01, 0.01, 0.02]),
        outlier_log_odds=START.outlier_log_odds,
    )
    centre = np.array([0.0, RADIUS_M])
    angle = rng.uniform(-np.pi, np.pi, N_LANDMARKS)
    distance = RADIUS_M * rng.uniform(0.3, 1.6, N_LANDMARKS)
    landmark = centre + distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    recording = _recording(
        stamp, _disturbed(velocity, noise, rng), stamp[::steps][:n_poses], *_seen(pose, landmark, rng)
    )
    prepared = prepare(recording)
    prior = CalibrationPrior.from_settings(calibrated=calibrated).without_scale()
    problem = replace(prepared.problem, prior=prior)
    landmark = landmark[prepared.landmark_id]
    return World(problem, noise, pose, landmark, *_increments(problem, noise))


def _recording(
    stamp: FloatArray,
    velocity: FloatArray,
    frame_stamp: FloatArray,
    pose_row: IntArray,
    landmark_row: IntArray,
    reading: FloatArray,
) -> Recording:
    count = len(pose_row)
    return Recording(
        name="circular world",
        odometry=Odometry(stamp, *np.ascontiguousarray(velocity.T)),
        frames=Frames(frame_stamp),
        detections=Detections(
            frame=pose_row,
            landmark_id=landmark_row,
            range_m=reading[:, 0],
            bearing_rad=reading[:, 1],
            class_id=np.full(count, UNKNOWN),
            sigma_range_m=np.full(count, np.nan),
            sigma_bearing_rad=np.full(count, np.nan),
            source_line=np.zeros(count, dtype=np.int64),
        ),
    )


def _seen(pose: FloatArray, landmark: FloatArray, rng: np.random.Generator) -> tuple[IntArray, IntArray, FloatArray]:
    """Rows of poses and landmarks, and readings, of what is in view and detected; every pose sees something."""
    local = se2.transform(se2.inverse(pose)[:, None, :], landmark[None, :, :])
    distance, bearing = np.hypot(local[..., 0], local[..., 1]), np.arctan2(local[..., 1], local[..., 0])
    seen = (distance < VIEW_M) & (np.abs(bearing) < VIEW_RAD) & (rng.random(distance.shape) < 0.6)
    blind = ~seen.any(axis=1)
    seen[blind, np.argmin(np.abs(bearing[blind]), axis=1)] = True
    pose_row, landmark_row = np.nonzero(seen)
    sigma = np.array([SIGMA_RANGE_M, SIGMA_BEARING_RAD])
    reading = np.column_stack([distance[seen], bearing[seen]]) + sigma * rng.normal(size=(len(pose_row), 2))
    return pose_row, landmark_row, reading


def _disturbed(velocity: FloatArray, noise: Noise, rng: np.random.Generator) -> FloatArray:
    """Velocities as reported, noisy as the noise model says."""
    per_metre, per_turn, sideways, per_second, turn_per_turn = noise.odometry
    speed, turn = np.abs(velocity[:, 0]), np.abs(velocity[:, 2])
    sigma = np.column_stack(
        [
            np.sqrt(per_metre**2 * speed + per_turn**2 * turn),
            np.sqrt(sideways**2 * speed),
            np.sqrt(per_second**2 + turn_per_turn**2 * turn),
        ]
    )
    return velocity + sigma / np.sqrt(ODOMETRY_S) * rng.normal(size=velocity.shape)


def _increments(problem: Problem, noise: Noise) -> tuple[FloatArray, FloatArray]:
    """Odometry between consecutive poses with nominal calibration."""
    count = len(problem.stamp_s) - 1
    increment, covariance = np.zeros((count, 3)), np.zeros((count, 3, 3))
    motion, kinds = np.zeros((3, 4)), np.zeros((5, 3, 3))
    drive = problem.drive
    for i in range(count):
        integrate_odometry(
            drive.stamp_s,
            drive.velocity,
            drive.unknown,
            problem.stamp_s[i],
            problem.stamp_s[i + 1],
            problem.prior.mean,
            increment[i],
            motion,
            kinds,
            covariance[i],
        )
        covariance[i] += np.tensordot(noise.odometry**2, kinds, 1)
    return increment, covariance
