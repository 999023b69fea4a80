"""Bringing an estimate into the frame of the truth, for evaluation only.

A map made from an unknown start lives in the frame of its first pose. Comparing it with surveyed coordinates needs
one planar motion, `pose_truth_estimate`, without scale. Nothing of it flows back into the estimate.
"""

from __future__ import annotations

import numpy as np

from evermap.errors import DataError
from evermap.geometry import se2
from evermap.types import FloatArray, Trajectory


def align_points(source_m: FloatArray, target_m: FloatArray) -> FloatArray:
    """The motion (x, y, theta) that brings `source_m` onto `target_m` with least squared distance.

    Umeyama (PAMI 1991) without scale, by evo. Points that all coincide say nothing about the rotation.

    Args:
        source_m: (N, 2) points, N >= 2.
        target_m: (N, 2) where they should come to lie.

    Raises:
        DataError: fewer than two distinct points.
    """
    from evo.core import geometry

    if len(source_m) < 2:
        raise DataError("an SE(2) alignment needs at least two points", hint="evaluate over a longer stretch")
    try:
        rotation, shift, _ = geometry.umeyama_alignment(
            np.ascontiguousarray(source_m.T), np.ascontiguousarray(target_m.T), with_scale=False
        )
    except geometry.GeometryException as error:
        raise DataError("all points coincide: their alignment has no rotation", hint="evaluate while moving") from error
    return np.array([shift[0], shift[1], np.arctan2(rotation[1, 0], rotation[0, 0])])


def align_poses(source: FloatArray, target: FloatArray) -> tuple[FloatArray, str]:
    """As `align_points` on the positions of poses (N, 3); where the robot stands still the headings decide.

    Returns:
        the motion (x, y, theta) and how it was found: 'umeyama_se2' or 'mean_heading'.
    """
    try:
        return align_points(source[:, :2], target[:, :2]), "umeyama_se2"
    except DataError:
        turns = target[:, 2] - source[:, 2]
        turn = float(np.arctan2(np.sin(turns).sum(), np.cos(turns).sum()))
        shift = np.mean(target[:, :2] - source[:, :2] @ se2.rotation(turn).T, axis=0)
        return np.array([shift[0], shift[1], turn]), "mean_heading"


def rotate_covariance(covariance: FloatArray, angle_rad: FloatArray | float) -> FloatArray:
    """Covariances (..., 2, 2) as seen after turning the axes' content by `angle_rad` (broadcast)."""
    turn = se2.rotation(angle_rad)
    return np.asarray(turn @ covariance @ np.swapaxes(turn, -1, -2), dtype=np.float64)


def moved(trajectory: Trajectory, pose_target_world: FloatArray, frame: str = "truth") -> Trajectory:
    """The trajectory in another frame. Covariances are in the robot's own frame and stay as they are."""
    return Trajectory(
        stamp_s=trajectory.stamp_s,
        pose_world_robot=se2.compose(pose_target_world, trajectory.pose_world_robot),
        covariance=trajectory.covariance,
        frame=frame,
        clock=trajectory.clock,
    )


def interpolate(trajectory: Trajectory, stamp_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses at other stamps, on the SE(2) geodesic between the two neighbours; exact at the stamps themselves.

    Args:
        trajectory: at least one pose.
        stamp_s: (K,) within the trajectory's span.

    Returns:
        poses (K, 3); covariances (K, 3, 3), mixed linearly, which is fair only where the neighbours are close; and
        the distance in time of the two neighbours (K,) [s], 0 at the stamps themselves.
    """
    knots = trajectory.stamp_s
    after = np.clip(np.searchsorted(knots, stamp_s, side="left"), 0, len(knots) - 1)
    before = np.where(knots[after] <= stamp_s, after, np.maximum(after - 1, 0))
    gap_s = knots[after] - knots[before]
    share = np.where(gap_s > 0, (stamp_s - knots[before]) / np.where(gap_s > 0, gap_s, 1.0), 0.0)
    start = trajectory.pose_world_robot[before]
    twist = se2.log(se2.between(start, trajectory.pose_world_robot[after]))
    poses = se2.compose(start, se2.exp(share[:, None] * twist))
    mix = share[:, None, None]
    covariance = (1.0 - mix) * trajectory.covariance[before] + mix * trajectory.covariance[after]
    return poses, covariance, gap_s
