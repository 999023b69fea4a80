"""Where up is: several opinions combined, and maps turned so that up is their z axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.geometry import se3
from evermap.geometry.group import group_of
from evermap.types import FloatArray, Landmarks, Up

LEAST_RAD = {"stated": 0.0, "imu": 0.01, "tf": 0.03, "odometry": 0.03, "plane of motion": 0.03}
"""Standard deviation of up by each source however often it was measured: errors that last. Of accelerometers their
bias (1 % of gravity); of all that moves on a floor the slope of that floor, which is not measured:
3 % is that of a drained floor or a road (ramps have 5 to 12)."""
STATED_RAD = 0.01
"""Standard deviation of an up that a user states."""
SIGMAS = 3.0
"""Standard deviations beyond which two opinions contradict each other."""
_LEVEL_SIGMAS = 2.0
"""Standard deviations within which z counts as up, and a map keeps its axes."""


def angle_between_ups(one: Up, other: Up) -> float:
    """Return the angle between two directions [rad]."""
    across = float(np.linalg.norm(np.cross(one.direction, other.direction)))
    return float(np.arctan2(across, one.direction @ other.direction))


def is_contradiction(one: Up, other: Up) -> bool:
    """Judge whether two that say something cannot both be right."""
    if not (np.isfinite(one.direction).all() and np.isfinite(other.direction).all()):
        return False
    return angle_between_ups(one, other) > SIGMAS * float(np.hypot(one.sigma_rad, other.sigma_rad))


def combine_ups(one: Up, other: Up) -> Up:
    """Return what two opinions say together, weighted by their information; of a contradiction the more certain one.

    What is stated is what it is. Errors that last (`LEAST_RAD`) are not averaged away.
    """
    certain, doubtful = (one, other) if one.sigma_rad <= other.sigma_rad else (other, one)
    if "stated" in (one.source, other.source):
        return other if other.source == "stated" else one
    if not np.isfinite(doubtful.direction).all() or is_contradiction(one, other):
        return certain
    weight = np.array([certain.sigma_rad, doubtful.sigma_rad]) ** -2.0
    direction = weight[0] * certain.direction + weight[1] * doubtful.direction
    sources = dict.fromkeys([*certain.source.split(", "), *doubtful.source.split(", ")])
    least = min(LEAST_RAD.get(source, 0.0) for source in sources)
    sigma_rad = max(float(weight.sum() ** -0.5), min(least, certain.sigma_rad))
    return Up(direction / np.linalg.norm(direction), sigma_rad, ", ".join(sources))


def level_pose(up: Up) -> FloatArray:
    """Return the pose (7,) of a map's frame in one whose z axis is up, by the shortest turn about the origin.

    It is the identity where z is up within the uncertainty, or up is unknown.
    """
    if not up.is_known or is_level(up):
        return se3.identity()
    x, y, _ = up.direction.tolist()
    axis = np.array([y, -x, 0.0]) if np.hypot(x, y) > 1e-9 else np.array([1.0, 0.0, 0.0])
    return se3.exp(np.concatenate([np.zeros(3), _tilt(up) * axis / np.linalg.norm(axis)]))


def is_level(up: Up) -> bool:
    """Return whether the z axis is known to be up, within the uncertainty of that."""
    return up.is_known and _tilt(up) <= _LEVEL_SIGMAS * up.sigma_rad


def _tilt(up: Up) -> float:
    x, y, z = up.direction.tolist()
    return float(np.arctan2(np.hypot(x, y), z))


def move_map(landmarks: Landmarks, pose: FloatArray) -> Landmarks:
    """Return a map in the frame in which `pose` (3,) or (7,) is that of its own frame."""
    group = group_of(pose)
    turn = group.rotation_of(pose)
    up = landmarks.up
    if group.point_dim == 3 and np.isfinite(up.direction).all():
        up = replace(up, direction=turn @ up.direction)
    if not len(landmarks):
        return replace(landmarks, up=up)
    rotation = landmarks.rotation
    if rotation is not None:
        oriented = np.isfinite(rotation).all(axis=1)
        rotation = rotation.copy()
        at = np.hstack([np.zeros((int(oriented.sum()), 3)), rotation[oriented]])
        rotation[oriented] = se3.compose(pose, at)[:, 3:]
    return replace(
        landmarks,
        position_m=group.transform(pose, landmarks.position_m),
        covariance_m2=turn @ landmarks.covariance_m2 @ np.swapaxes(turn, -1, -2),
        rotation=rotation,
        up=up,
    )


def level_map(landmarks: Landmarks) -> Landmarks:
    """Return a map in space with up along z, as far as that is known (`level_pose`); one in the plane as it is."""
    if landmarks.position_m.shape[1] == 2:
        return landmarks
    return move_map(landmarks, level_pose(landmarks.up))
