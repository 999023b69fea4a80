"""Orientations that were not measured, as defaults of messages and those that turn with the robot; other conventions.

A point detector fills the orientation of its message with ROS's default (0, 0, 0, 1), or with a constant. Taken for
measurements they say that landmarks turn as the robot does: dead reckoning is better. An orientation that was measured
is the same in the world whichever way the robot looks, up to its noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.config import CheckConfig
from evermap.geometry import se3
from evermap.slam.mistakes import CONVENTIONS, Mistake
from evermap.slam.pairs import sighting_pairs
from evermap.types import AnyRecordingT, BoolArray, FloatArray, SpatialRecording, is_in_space

SAME = 1e-6
"""Difference between the numbers of two quaternions that are equal."""
TURNED_RAD = 0.3
"""Turn of the robot between two sightings from which on they say whether an orientation turns with it."""
WITH_ROBOT = 0.3
"""Share of the robot's turn by which orientations in the sensor's frame change that do not see it; it must be the
median, as must the rest of the turn in the world."""
TELLS_RAD, SHARE_LEFT = 0.05, 0.7
"""Difference between two conventions, in the turn of a landmark from one sighting to another, from which these two say
which is right; and share of the usual turn that is left at most where the other one is."""

MIRRORED = Mistake(
    "bearing-sign",
    "bearings and turn rates seem to be clockwise, both: counter-clockwise is positive, from x ahead to y on the left "
    "(bearing_rad, angular_radps)",
    bearing=-1.0,
    turn=-1.0,
    lateral=-1.0,
    field="bearing_rad, angular_radps",
)
"""What mirrors all that is measured in the plane: no pair of sightings shows it."""
MIRRORED_TURNS = replace(
    MIRRORED,
    code="turn-sign",
    message="turn rates seem to have the wrong sign: counter-clockwise is positive, from x ahead to y on the left "
    "(angular_radps)",
    field="angular_radps",
)
"""The same of ranges alone: their first bearings, which are guessed, follow the odometry."""


def without_unmeasured(recording: AnyRecordingT, settings: CheckConfig) -> AnyRecordingT:
    """Return a recording without orientations that were not measured, with a warning for each sensor that gave them.

    Those of a sensor are left out if all are the default (0, 0, 0, 1); if all are another constant although the robot
    turned; or if those of one landmark, seconds apart, turn with the robot. Boxes, tags with corners, and classes with
    symmetries are not asked.
    """
    if not is_in_space(recording):
        return recording
    seen = recording.detections
    warnings: list[str] = []
    asked = _has_orientation(recording)
    drop = np.zeros(len(seen), dtype=np.bool_)
    for row, sensor in enumerate(recording.sensors):
        mine = asked & (seen.sensor == row)
        why = _why_unmeasured(recording, mine, settings) if mine.any() else ""
        if why:
            drop |= mine
            warnings.append(f"orientations of '{sensor.name}' are not measured and not used: {why}")
    if not warnings:
        return recording
    left = replace(
        seen,
        rotation=np.where(drop[:, None], np.nan, seen.rotation),
        sigma_rad=np.where(drop, np.nan, seen.sigma_rad),
    )
    return replace(recording, detections=left, warnings=(*recording.warnings, *warnings))


def find_convention(recording: SpatialRecording, settings: CheckConfig) -> str:
    """Return the convention (`mistakes.CONVENTIONS`) of detections by which landmarks do not turn.

    Nearly all pairs of sightings that can tell it from the one in which they are read must say so, and their positions
    must not contradict it. It is '' if that is the one in which they are read, if none is, or if it is that of the
    odometry.
    """
    odometry, seen = recording.odometry, recording.detections
    if odometry is None:
        return ""
    asked = _has_orientation(recording)
    first, second = sighting_pairs(recording, settings)
    some = asked[first] & asked[second]
    first, second = first[some], second[some]
    stamp_s = recording.frames.stamp_s[seen.frame]
    mount = np.array([sensor.mount_robot_sensor for sensor in recording.sensors])[seen.sensor]
    robot = se3.interpolate(odometry.stamp_s, odometry.pose_world_robot, stamp_s)
    much = se3.angle_between(robot[first], robot[second]) > TURNED_RAD
    first, second = first[much], second[much]
    if len(first) < settings.fewest:
        return ""
    pose = np.concatenate([seen.position_sensor_m, seen.rotation], axis=1)
    turned, apart_m = dict[tuple[str, str], FloatArray](), dict[tuple[str, str], FloatArray]()
    for way in [
        ("", ""),
        *(("", name) for name in CONVENTIONS if name),
        *((name, "") for name in CONVENTIONS),
    ]:
        track = se3.compose(CONVENTIONS[way[0]](robot), mount)
        one, other = (se3.compose(track[rows], CONVENTIONS[way[1]](pose[rows])) for rows in (first, second))
        turned[way] = se3.angle_between(one, other)
        apart_m[way] = np.linalg.norm(one[:, :3] - other[:, :3], axis=1)
    best, given = min(turned, key=lambda way: float(np.median(turned[way]))), ("", "")
    nearer = turned[given] - turned[best]
    telling = np.abs(nearer) > TELLS_RAD
    if np.count_nonzero(telling) < settings.fewest or np.mean(nearer[telling] > 0.0) < settings.agreed:
        return ""
    stays = np.median(apart_m[best]) <= np.median(apart_m[given]) * (1.0 + SAME)
    return best[1] if stays and np.median(turned[best]) < SHARE_LEFT * np.median(turned[given]) else ""


def _has_orientation(recording: SpatialRecording) -> BoolArray:
    """Return (M,) which detections have an orientation of their own: no boxes, and no tags by their corners."""
    seen = recording.detections
    asked = np.isfinite(seen.rotation).all(axis=1) & ~np.isfinite(seen.corner_px[:, 0, 0])
    asked &= ~np.isfinite(seen.size_m).all(axis=1)
    symmetric = [row for row, name in enumerate(recording.class_names) if name in recording.symmetries]
    return np.asarray(asked & ~np.isin(seen.class_id, symmetric))


def _why_unmeasured(recording: SpatialRecording, mine: BoolArray, settings: CheckConfig) -> str:
    """Return what shows that orientations of detections (M,) of a sensor were not measured; '' if nothing does."""
    seen, odometry = recording.detections, recording.odometry
    rotation = seen.rotation[mine]
    if np.abs(np.abs(rotation) - se3.NO_TURN).max() < SAME:
        return f"all {len(rotation)} are the default (0, 0, 0, 1)"
    if odometry is None:
        return ""
    stamp_s = recording.frames.stamp_s[seen.frame]
    robot = se3.interpolate(odometry.stamp_s, odometry.pose_world_robot, stamp_s)
    turned = se3.angle_between(robot[mine][0], robot[mine]).max() > TURNED_RAD
    if turned and len(rotation) >= settings.fewest and np.abs(rotation - rotation[0]).max() < SAME:
        return f"all {len(rotation)} are the same"
    first, second = sighting_pairs(recording, settings)
    some = mine[first] & mine[second]
    first, second = first[some], second[some]
    mount = recording.sensors[int(seen.sensor[mine][0])].mount_robot_sensor
    eye, own = se3.compose(robot, np.array(mount)), se3.turn(seen.rotation)
    angle = se3.angle_between(eye[first], eye[second])
    much = angle > TURNED_RAD
    if np.count_nonzero(much) < settings.fewest:
        return ""
    first, second, angle = first[much], second[much], angle[much]
    in_sensor = se3.angle_between(own[first], own[second])
    in_world = se3.angle_between(se3.compose(eye[first], own[first]), se3.compose(eye[second], own[second]))
    if np.median(in_sensor / angle) < WITH_ROBOT and np.median(in_world / angle) > 1.0 - WITH_ROBOT:
        return "they turn with the robot"
    return ""
