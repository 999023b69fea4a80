"""A recording as plain factors, for peers that know neither calibration states nor noise that depends on the drive.

Written in numpy alone, apart from evermap's kernels: the objective of any estimate can be checked independently of the
estimator that found it. There is one pose for every frame with a detection of known identity, one odometry factor
between two poses that follow each other, and one factor a detection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.geometry import se2
from evermap.types import UNKNOWN, FloatArray, IntArray, Recording

FIRST_POSE_SIGMA = 1e-4
"""Standard deviation of the first pose about the origin [m, rad]: it fixes the gauge."""
LONGEST_PIECE_S = 0.1
FLOOR_FORWARD_M, FLOOR_TURN_RAD, FLOOR_VARIANCE = 0.002, 0.001, 1e-8
"""What odometry noise never falls below: per square root of a second, and once an interval."""


@dataclass(frozen=True, slots=True)
class PlainNoise:
    """Standard deviations.

    Attributes:
        detection: (2,) range [m] and bearing [rad], for detections that came without their own.
        odometry: (5,) forward by distance and by turn, sideways by distance, turn by time and by turn, each per square
            root of it.
    """

    detection: FloatArray
    odometry: FloatArray


@dataclass(frozen=True, slots=True)
class Factors:
    """Everything that enters a least squares problem over N poses and L landmarks.

    Attributes:
        stamp_s: (N,) of the poses.
        frame: (N,) their rows of `Recording.frames`.
        increment: (N - 1, 3) odometry, pose i + 1 seen from pose i.
        covariance: (N - 1, 3, 3) of it, perturbed on the right.
        pose_row, landmark_row: (M,) of the detections, sorted by pose.
        reading: (M, 2) range [m] and bearing [rad] from the robot's centre.
        sigma: (M, 2) their standard deviations.
        landmark_id: (L,) ids behind the landmark rows.
    """

    stamp_s: FloatArray
    frame: IntArray
    increment: FloatArray
    covariance: FloatArray
    pose_row: IntArray
    landmark_row: IntArray
    reading: FloatArray
    sigma: FloatArray
    landmark_id: IntArray

    @property
    def first_detection(self) -> IntArray:
        """Return (N + 1,) the first detection of every pose."""
        return np.searchsorted(self.pose_row, np.arange(len(self.stamp_s) + 1))


@dataclass(frozen=True, slots=True)
class PlainEstimate:
    """Poses (N, 3) in the frame of the first one, and landmarks (L, 2)."""

    pose: FloatArray
    landmark: FloatArray


def factors_of(recording: Recording, noise: PlainNoise) -> Factors:
    """Return the factors of a recording of a sensor at the robot's centre, all readings believed as reported.

    Detections without identity and frames without a detection are left out.
    """
    detections = recording.detections
    used = np.flatnonzero(detections.landmark_id != UNKNOWN)
    used = used[np.argsort(detections.frame[used], kind="stable")]
    frame, pose_row = np.unique(detections.frame[used], return_inverse=True)
    landmark_id, landmark_row = np.unique(detections.landmark_id[used], return_inverse=True)
    given = np.column_stack([detections.sigma_range_m[used], detections.sigma_bearing_rad[used]])
    stamp_s = recording.frames.stamp_s[frame]
    increment, covariance = integrated(recording, stamp_s, noise.odometry)
    return Factors(
        stamp_s=stamp_s,
        frame=frame,
        increment=increment,
        covariance=covariance,
        pose_row=pose_row.astype(np.int64),
        landmark_row=landmark_row.astype(np.int64),
        reading=np.column_stack([detections.range_m[used], detections.bearing_rad[used]]),
        sigma=np.where(np.isfinite(given), given, noise.detection),
        landmark_id=landmark_id,
    )


def integrated(recording: Recording, stamp_s: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the motion (N - 1, 3) between (N,) stamps, and its covariance (N - 1, 3, 3).

    Velocities hold from stamp to stamp. Every piece of at most `LONGEST_PIECE_S` adds noise to its twist, which is
    carried to the end of its interval by the right Jacobian of the exponential and the adjoint (MATH.md 1).
    """
    piece_s, velocity, interval = _pieces(recording, stamp_s)
    step = se2.exp(piece_s[:, None] * velocity)
    path = _chained(step)  # (K + 1, 3): where each piece begins, and the end
    first = np.searchsorted(interval, np.arange(len(stamp_s)))
    increment = se2.between(path[first[:-1]], path[first[1:]])
    distance = piece_s * np.hypot(velocity[:, 0], velocity[:, 1])
    turn = piece_s * np.abs(velocity[:, 2])
    by_m, by_rad, sideways, by_s, turn_by_rad = np.square(sigma)
    variance = np.column_stack([
        by_m * distance + by_rad * turn + FLOOR_FORWARD_M**2 * piece_s,
        sideways * distance + FLOOR_FORWARD_M**2 * piece_s,
        by_s * piece_s + turn_by_rad * turn + FLOOR_TURN_RAD**2 * piece_s,
    ])  # fmt: skip
    # from a perturbed twist to the end of its piece, then to the end of its interval
    onwards = se2.adjoint(se2.between(path[first[1:]][interval], path[1:]))
    carried = onwards @ _right_jacobian(piece_s[:, None] * velocity)
    each = np.einsum("kij,kj,klj->kil", carried, variance, carried)
    covariance = np.add.reduceat(each, first[:-1], axis=0) + FLOOR_VARIANCE * np.eye(3)
    return increment, covariance


def objective(factors: Factors, estimate: PlainEstimate, *, logarithm: bool = True) -> float:
    """Return half the sum of squared normalised residuals, the first pose's at the origin included.

    Args:
        factors: the measurements.
        estimate: where they are compared.
        logarithm: residuals of motions are their logarithms on SE(2), as in gtsam's factors; else (x, y, theta), as in
            evermap. Where odometry is rough the two have optima that differ.
    """
    pose = estimate.pose
    held = se2.log(pose[0]) / FIRST_POSE_SIGMA
    off = se2.between(factors.increment, se2.between(pose[:-1], pose[1:]))
    off = se2.log(off) if logarithm else off
    moved = np.einsum("ni,nij,nj->", off, np.linalg.inv(factors.covariance), off)
    seen = predicted_readings(pose[factors.pose_row], estimate.landmark[factors.landmark_row])
    miss = factors.reading - seen
    miss[:, 1] = se2.wrap(miss[:, 1])
    return 0.5 * float(held @ held + moved + np.sum(np.square(miss / factors.sigma)))


def predicted_readings(pose: FloatArray, landmark: FloatArray) -> FloatArray:
    """Return range and bearing (M, 2) of landmarks (M, 2) from poses (M, 3)."""
    offset = se2.transform(se2.inverse(pose), landmark)
    return np.column_stack([np.hypot(offset[:, 0], offset[:, 1]), np.arctan2(offset[:, 1], offset[:, 0])])


def dead_reckoned_start(factors: Factors) -> PlainEstimate:
    """Return poses by odometry alone, and every landmark where its first sighting has it from there."""
    pose = _chained(factors.increment)
    _, first = np.unique(factors.landmark_row, return_index=True)
    reading = factors.reading[first]
    offset = reading[:, :1] * np.column_stack([np.cos(reading[:, 1]), np.sin(reading[:, 1])])
    return PlainEstimate(pose, se2.transform(pose[factors.pose_row[first]], offset))


def truth_of(factors: Factors, recording: Recording) -> PlainEstimate:
    """Return the true values in the frame of the first pose; the recording has truth at all frames."""
    assert recording.truth is not None
    assert recording.true_landmarks is not None
    pose = recording.truth.pose_world_robot[factors.frame]
    rows = np.searchsorted(recording.true_landmarks.landmark_id, factors.landmark_id)
    landmark = recording.true_landmarks.position_m[rows]
    return PlainEstimate(se2.between(pose[0], pose), se2.transform(se2.inverse(pose[0]), landmark))


def near_start(factors: Factors, recording: Recording, off_m: float = 0.5, seed: int = 1) -> PlainEstimate:
    """Return the truth with normal noise of `off_m` on each coordinate of poses and landmarks, a tenth of it [rad] on
    headings; the first pose is exact.
    """
    rng, truth = np.random.default_rng(seed), truth_of(factors, recording)
    pose = truth.pose + rng.normal(size=truth.pose.shape) * [off_m, off_m, 0.1 * off_m]
    pose[0] = 0.0
    pose[:, 2] = se2.wrap(pose[:, 2])
    return PlainEstimate(pose, truth.landmark + off_m * rng.normal(size=truth.landmark.shape))


def _pieces(recording: Recording, stamp_s: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Seconds (K,), velocity (K, 3) and interval between stamps (K,) of all pieces that the drive is cut into."""
    odometry = recording.odometry
    inside = (odometry.stamp_s > stamp_s[0]) & (odometry.stamp_s < stamp_s[-1])
    cuts = np.unique(np.concatenate([stamp_s, odometry.stamp_s[inside]]))
    length_s = np.diff(cuts)
    pieces = np.ceil(length_s / LONGEST_PIECE_S - 1e-9).astype(np.int64)
    begin = np.repeat(cuts[:-1], pieces)
    row = np.maximum(np.searchsorted(odometry.stamp_s, begin, side="right") - 1, 0)
    velocity = np.column_stack([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps])[row]
    return np.repeat(length_s / pieces, pieces), velocity, np.searchsorted(stamp_s, begin, side="right") - 1


def _chained(step: FloatArray) -> FloatArray:
    """Poses (K + 1, 3) that steps (K, 3) lead to from the origin, one after the other."""
    heading = np.concatenate([[0.0], np.cumsum(step[:, 2])])
    turned = np.column_stack([np.zeros((len(step), 2)), heading[:-1]])
    moved = se2.transform(turned, step[:, :2])
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(moved, axis=0)]), se2.wrap(heading)])


def _right_jacobian(twist: FloatArray) -> FloatArray:
    """(K, 3, 3) with `exp(twist + d) = exp(twist) exp(J d)`, by its power series: pieces turn by little."""
    small = np.zeros((len(twist), 3, 3))
    small[:, 0, 1], small[:, 1, 0] = -twist[:, 2], twist[:, 2]
    small[:, 0, 2], small[:, 1, 2] = twist[:, 1], -twist[:, 0]
    jacobian = term = np.broadcast_to(np.eye(3), small.shape)
    for k in range(1, 12):
        term = -term @ small / (k + 1)
        jacobian = jacobian + term
    return jacobian
