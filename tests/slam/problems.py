"""Small made-up SLAM problems, and the same cost written down a second time, slowly and without the kernels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from evermap.config import CalibrationConfig
from evermap.geometry import se2
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.kernels import N_STATES, integrate_odometry
from evermap.slam.problem import Drive, Estimate, Noise, Problem, independent

QUIET = Noise(
    detection=np.array([0.05, 0.02]),
    odometry=np.array([0.03, 0.03, 0.02, 0.02, 0.04]),
    outlier_log_odds=7.0,
)


def default_prior(**fix: float) -> CalibrationPrior:
    return CalibrationPrior.from_settings(CalibrationConfig(fix=fix), calibrated=True)


def mounted(prior: CalibrationPrior, sigma_m: float) -> CalibrationPrior:
    """With a mount that is known well enough for steps in a small world to be linear."""
    sigma = prior.sigma.copy()
    sigma[5:7] = sigma_m
    return replace(prior, sigma=sigma)


def hat(twist: np.ndarray) -> np.ndarray:
    forward, left, turn = twist
    return np.array([[0.0, -turn, forward], [turn, 0.0, left], [0.0, 0.0, 0.0]])


def true_velocity(reported: np.ndarray, states: np.ndarray) -> np.ndarray:
    """What the calibration states make of a reported (forward, lateral, turn, turn beyond jitter), as the docs say."""
    forward, lateral, turn, scaled = reported
    jitter = turn - scaled
    return np.array([states[8] * forward - states[10] * abs(turn), states[8] * lateral, states[9] * scaled + jitter])


def stretches(drive: Drive, start: float, stop: float, delay: float) -> list[tuple[int, float]]:
    """(row, duration) of every stretch of constant velocity in the shifted window."""
    begin, end = start + delay, stop + delay
    low = np.concatenate([[-np.inf], drive.stamp_s[1:]])  # before the first row as in it
    high = np.concatenate([drive.stamp_s[1:], [np.inf]])
    passed = np.minimum(end, high) - np.maximum(begin, low)
    return [(int(row), float(passed[row])) for row in np.flatnonzero(passed > 0.0)]


def slow_increment(drive: Drive, start: float, stop: float, states: np.ndarray) -> np.ndarray:
    """The motion between two instants as a product of matrix exponentials, as (x, y, theta not wrapped)."""
    matrix, theta = np.eye(3), 0.0
    for row, passed in stretches(drive, start, stop, states[7]):
        twist = true_velocity(drive.velocity[row], states)
        matrix = matrix @ scipy.linalg.expm(hat(twist) * passed)
        theta += twist[2] * passed
    return np.array([matrix[0, 2], matrix[1, 2], theta])


def closed_increments(drive: Drive, stamp_s: np.ndarray, states: np.ndarray) -> np.ndarray:
    """(N - 1, 3), the same from each instant to the next, with the closed form of the exponential: quicker, for where
    this is not what is tested.
    """
    at = stamp_s + states[7]
    low = np.concatenate([[-np.inf], drive.stamp_s[1:]])
    high = np.concatenate([drive.stamp_s[1:], [np.inf]])
    passed = np.minimum(at[1:, None], high) - np.maximum(at[:-1, None], low)
    first, count = (passed > 0.0).argmax(axis=1), (passed > 0.0).sum(axis=1)
    twist = true_velocity(drive.velocity.T, states).T
    pose = np.zeros((len(passed), 3))
    for k in range(count.max()):
        row = np.minimum(first + k, len(twist) - 1)
        spent = np.where(k < count, passed[np.arange(len(passed)), row], 0.0)
        pose = se2.compose(pose, se2.exp(twist[row] * spent[:, None]))
    return pose


@dataclass
class Integrated:
    increment: np.ndarray
    jacobian: np.ndarray
    noise: np.ndarray
    floor: np.ndarray

    def covariance(self, variance: np.ndarray) -> np.ndarray:
        return self.floor + np.tensordot(variance, self.noise, 1)


def integrated(drive: Drive, start: float, stop: float, states: np.ndarray) -> Integrated:
    """The kernel's answer, with buffers that were dirty before."""
    out = Integrated(np.full(3, 7.0), np.full((3, 4), 7.0), np.full((5, 3, 3), 7.0), np.full((3, 3), 7.0))
    integrate_odometry(
        drive.stamp_s, drive.velocity, drive.unknown, start, stop, states,
        out.increment, out.jacobian, out.noise, out.floor,
    )  # fmt: skip
    return out


def slow_detection(pose: np.ndarray, landmark: np.ndarray, states: np.ndarray, mount: np.ndarray) -> np.ndarray:
    """Predicted (range, bearing) by the range law of the docstring."""
    sits = [mount[0] + states[5], mount[1] + states[6], mount[2]]
    seen = se2.transform(se2.inverse(se2.compose(pose, np.array(sits))), landmark)
    r, b = np.hypot(seen[..., 0], seen[..., 1]), np.arctan2(seen[..., 1], seen[..., 0])
    return np.stack([states[0] + r * (1 + states[1] + states[2] * b + states[3] * b * b), b + states[4]], axis=-1)


def wandering_drive(
    rng: np.random.Generator, duration_s: float, period_s: float = 0.1, turn_radps: float = 0.0
) -> Drive:
    """Velocities of a robot that drives on and turns this way and that, about `turn_radps`."""
    stamps = np.arange(-1.0, duration_s + 1.0, period_s)
    count = len(stamps)
    turn = np.convolve(rng.normal(size=count + 40), np.hanning(41) / 5.0, mode="valid")[:count]
    velocity = np.column_stack([0.6 + 0.3 * np.sin(stamps), 0.05 * np.cos(stamps), turn_radps + turn])
    return Drive.from_rows(stamps, velocity)


@dataclass
class World:
    """A problem with the truth behind it."""

    problem: Problem
    noise: Noise
    truth: Estimate

    def near_truth(self, rng: np.random.Generator, by: float = 0.02) -> Estimate:
        """A place from which to start."""
        pose = self.truth.pose + by * rng.normal(size=self.truth.pose.shape)
        pose[0] = self.truth.pose[0]
        landmark = self.truth.landmark + by * rng.normal(size=self.truth.landmark.shape)
        return Estimate(pose, landmark, self.problem.prior.mean.copy())


def make_world(
    seed: int,
    *,
    n_poses: int = 20,
    n_landmarks: int = 5,
    step_s: float = 0.8,
    noise: Noise = QUIET,
    prior: CalibrationPrior | None = None,
    states: np.ndarray | None = None,
    p_seen: float = 0.7,
    p_outlier: float = 0.0,
    noisy: float = 1.0,
    start_information: float = 1e8,
    n_mapped: int = 0,
    sigma_map_m: float = 0.1,
    turn_radps: float = 0.0,
    reach: float = 1.0,
) -> World:
    """A robot in the middle of some landmarks, in the frame of its first pose; measured exactly with `noisy=0`.

    The motion from pose to pose is drawn from the odometry's own model; the first `n_mapped` landmarks have priors.
    They stand in a ring, farther out than the trajectory's extent times `reach`.
    """
    rng = np.random.default_rng(seed)
    prior = mounted(default_prior(), 0.03) if prior is None else prior
    if states is None:
        off = np.insert(rng.normal(size=N_STATES - 2), 5, np.random.default_rng([seed, 1]).normal(size=2))
        states = prior.mean + 0.3 * prior.sigma * off * prior.free
    stamps = 0.5 + step_s * np.arange(n_poses) + 0.1 * step_s * rng.random(n_poses)
    drive = wandering_drive(rng, stamps[-1], turn_radps=turn_radps)
    mount = np.array([0.2, -0.1, 0.3])
    pose = np.zeros((n_poses, 3))
    for i in range(n_poses - 1):
        step = integrated(drive, stamps[i], stamps[i + 1], states)
        slip = noisy * rng.multivariate_normal(np.zeros(3), step.covariance(noise.odometry**2))
        pose[i + 1] = se2.compose(se2.compose(pose[i], step.increment), se2.exp(slip))
    middle = pose[:, :2].mean(axis=0)
    angle = 2 * np.pi * (np.arange(n_landmarks) + 0.3 * rng.random(n_landmarks)) / n_landmarks
    radius = (2.0 + 2.0 * rng.random(n_landmarks))[:, None] + reach * np.ptp(pose[:, :2])
    landmark = middle + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    seen = rng.random((n_poses, n_landmarks)) < p_seen
    seen[0, :2] = True
    seen[1:, 0] |= ~seen[1:].any(axis=1)
    seen[-1] = True
    pose_row, landmark_row = map(np.ascontiguousarray, np.nonzero(seen))
    reading = slow_detection(pose[pose_row], landmark[landmark_row], states, mount)
    reading += noisy * noise.detection * rng.normal(size=reading.shape)
    wrong = rng.random(len(reading)) < p_outlier
    reading[wrong, 0] += rng.uniform(1.0, 3.0, int(wrong.sum()))
    reading[:, 1] = se2.wrap(reading[:, 1])
    information = np.zeros((n_landmarks, 2, 2))
    information[:n_mapped] = np.eye(2) / sigma_map_m**2
    information[:n_mapped, 0, 1] = information[:n_mapped, 1, 0] = 0.3 / sigma_map_m**2
    problem = Problem(
        stamp_s=stamps,
        drive=drive,
        pose_row=pose_row,
        landmark_row=landmark_row,
        reading=reading,
        sigma_given=np.full((len(reading), 2), np.nan),
        mount=mount,
        prior=prior,
        start_pose=np.zeros(3),
        start_information=start_information,
        landmark_mean=landmark + noisy * sigma_map_m * rng.normal(size=landmark.shape),
        landmark_information=independent(information),
    )
    problem = replace(problem, landmark_mean=np.where(information.any(axis=(1, 2))[:, None], problem.landmark_mean, 0))
    return World(problem, noise, Estimate(pose, landmark, states))
