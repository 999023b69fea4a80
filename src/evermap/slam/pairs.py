"""Pairs of sightings of one landmark, and what the odometry between them says.

Two readings of one landmark, a few seconds apart, and the odometry between them say the same thing twice: where the
landmark is the second time. The difference is taken in the logarithm of the range and in the bearing, in space in the
direction, which no unit of length can make small by itself.
"""

from __future__ import annotations

from copy import copy
from typing import Self, TypeAlias

import numpy as np

from evermap.config import CheckConfig
from evermap.geometry import se2, se3
from evermap.geometry.group import accumulate
from evermap.slam.kernels import pair_residuals, reckon_motions
from evermap.slam.mistakes import (
    ANGLES,
    AXES,
    CONVENTIONS,
    DRIVES,
    HONEST,
    MIRRORS,
    POSES,
    UNITS,
    UNITS_IN_SPACE,
    Mistake,
)
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    FloatArray,
    IntArray,
    Odometry,
    Recording,
    SpatialRecording,
    is_in_space,
)

USUAL = CheckConfig()
MOVED = 0.1
"""Difference of two sightings from which the robot moved."""


def pairs_of(recording: AnyRecording, settings: CheckConfig = USUAL) -> Pairs | None:
    """Return pairs of sightings; None if hardly any landmark is seen twice during the odometry."""
    first, second = sighting_pairs(recording, settings)
    return make_pairs(recording, first, second) if len(first) >= settings.fewest else None


def make_pairs(recording: AnyRecording, first: IntArray, second: IntArray) -> Pairs:
    """Return pairs of sightings by their rows, as `sighting_pairs` finds them."""
    return (SpatialPairs if is_in_space(recording) else PlanarPairs)(recording, first, second)  # type: ignore[arg-type]


def sighting_pairs(
    recording: AnyRecording, settings: CheckConfig, *, with_bearing: bool = True
) -> tuple[IntArray, IntArray]:
    """Return pairs of rows of detections of one landmark, within a few seconds and during the odometry.

    Those in the plane need a bearing, unless it is said that they do not.
    """
    detections = recording.detections
    stamp_s = recording.frames.stamp_s[detections.frame]
    known = detections.landmark_id != UNKNOWN
    if is_in_space(recording):
        from evermap.slam.space.intake import positions_of, without_range

        known &= ~without_range(recording) & np.isfinite(positions_of(recording)).all(axis=1)
    elif with_bearing:
        known &= np.isfinite(recording.detections.bearing_rad)
    if not known.any() or recording.odometry is None or len(recording.odometry) < 2:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    odometry_s = recording.odometry.stamp_s
    known &= (stamp_s >= odometry_s[0]) & (stamp_s <= odometry_s[-1])
    rows = np.flatnonzero(known)
    rows = rows[np.lexsort((stamp_s[rows], detections.landmark_id[rows]))]
    landmark = np.unique(detections.landmark_id[rows], return_inverse=True)[1]
    time_s = stamp_s[rows]
    earliest_s, latest_s = (time_s.min(), time_s.max()) if len(rows) else (0.0, 0.0)
    place = landmark * (latest_s - earliest_s + 4.0 * settings.lags_s[-1]) + time_s - earliest_s
    chosen = []
    for lag_s in settings.lags_s:
        later = np.searchsorted(place, place + lag_s)
        found = np.flatnonzero(later < len(rows))
        found = found[place[later[found]] - place[found] <= 2.0 * lag_s]
        found = found[np.linspace(0, len(found) - 1, min(len(found), settings.most_pairs)).astype(np.int64)]
        chosen.append(np.stack([rows[found], rows[later[found]]]))
    first, second = np.concatenate(chosen, axis=1)
    return first, second


class PlanarPairs:
    """Pairs of sightings of a landmark each, and what odometry says of them."""

    units, angles = UNITS, ANGLES
    why_longer = "another unit of ranges or speeds (range_m, forward_mps)"
    speeds = "forward_mps, angular_radps"

    def __init__(self, recording: Recording, first: IntArray, second: IntArray) -> None:
        detections = recording.detections
        self._odometry, self._tracks = recording.odometry, dict[tuple[float, float, float, bool], FloatArray]()
        self._mount = np.array(recording.sensor.mount_robot_sensor, dtype=np.float64)
        stamp_s = recording.frames.stamp_s[detections.frame]
        self._stamp_s = stamp_s[first], stamp_s[second]
        self._readings: tuple[FloatArray, FloatArray] = tuple(
            np.stack([detections.range_m[rows], detections.bearing_rad[rows]]) for rows in (first, second)
        )  # type: ignore[assignment]

    def among(self, rows: slice) -> Self:
        """Return some of the pairs."""
        part = copy(self)
        part._stamp_s = self._stamp_s[0][rows].copy(), self._stamp_s[1][rows].copy()
        part._readings = self._readings[0][:, rows].copy(), self._readings[1][:, rows].copy()
        return part

    @property
    def turns(self) -> bool:
        """Whether the robot ever turns, by its odometry."""
        return bool(np.abs(self._odometry.angular_radps).max() >= 1e-9)

    @property
    def still(self) -> bool:
        """Whether the robot never moves, by its odometry."""
        driven = self._odometry
        columns = (driven.forward_mps, driven.lateral_mps, driven.angular_radps)
        return not any(np.abs(column).max() >= 1e-9 for column in columns)

    @staticmethod
    def difference(after: FloatArray, before: FloatArray) -> FloatArray:
        """Return (M, 2, P) by how much residuals differ."""
        apart = after - before
        apart[:, 1] = se2.wrap(apart[:, 1])
        return apart

    def residual(self, *mistakes: Mistake, stands: bool = False) -> FloatArray:
        """Return (M, 2, P) second reading minus what the first and the odometry predict: log range, and bearing.

        With `stands` the robot doesn't move.
        """
        ways = dict[tuple[tuple[float, float, float, bool], float], int]()
        which = np.array([ways.setdefault((each.drive, each.delay_s), len(ways)) for each in mistakes])
        motion = np.zeros((len(ways), len(self._stamp_s[0]), 3))
        for row, (drive, delay_s) in enumerate(() if stands else ways):
            if drive not in self._tracks:
                self._tracks[drive] = reckon_drive(self._odometry, *drive)
            track = self._tracks[drive]
            reckon_motions(*self._stamp_s, delay_s, self._odometry.stamp_s, track, self._mount, motion[row])
        undone = np.array([(each.lengths, each.bearing, each.offset_rad) for each in mistakes])
        found = np.empty((len(mistakes), 2, motion.shape[1]))
        pair_residuals(motion, which, undone, *self._readings, found)
        return found


class SpatialPairs:
    """Pairs of sightings in space."""

    units = UNITS_IN_SPACE
    why_longer = "another unit of detections or odometry, or a wrong size of tags (tag_size_m)"
    speeds = "odometry"

    def __init__(self, recording: SpatialRecording, first: IntArray, second: IntArray) -> None:
        from evermap.slam.space.intake import positions_of

        assert recording.odometry is not None
        detections, self._odometry = recording.detections, recording.odometry
        self._tracks = dict[tuple[object, ...], FloatArray]()
        self._punctual = dict[tuple[object, ...], FloatArray]()
        mount = np.array([sensor.mount_robot_sensor for sensor in recording.sensors])
        stamp_s = recording.frames.stamp_s[detections.frame]
        self._stamp_s = stamp_s[first], stamp_s[second]
        self._mount = mount[detections.sensor[first]], mount[detections.sensor[second]]
        position = positions_of(recording)
        self._seen = position[first], position[second]
        by_corners = bool(np.isfinite(detections.corner_px[:, 0, 0]).any())  # of these pixels would be mirrored
        self.angles = (*AXES, *POSES, *DRIVES, *(() if by_corners else MIRRORS))

    def among(self, rows: slice) -> Self:
        """Return some of the pairs."""
        part = copy(self)
        part._punctual = {}
        part._stamp_s = self._stamp_s[0][rows], self._stamp_s[1][rows]
        part._mount = self._mount[0][rows], self._mount[1][rows]
        part._seen = self._seen[0][rows], self._seen[1][rows]
        return part

    turns = True
    """Poses hold their turns."""

    @property
    def still(self) -> bool:
        """Whether the robot never moves, by its odometry."""
        return bool(np.ptp(self._odometry.pose_world_robot, axis=0).max() < 1e-9)

    @staticmethod
    def difference(after: FloatArray, before: FloatArray) -> FloatArray:
        """Return (M, 4, P) by how much residuals differ."""
        return after - before

    def residual(self, *mistakes: Mistake, stands: bool = False) -> FloatArray:
        """Return (M, 4, P) second sighting minus what the first and the odometry predict: log range, and direction.

        With `stands` the robot doesn't move.
        """
        motion = self._motions(mistakes)
        motion = se3.identity(*motion.shape[:-1]) if stands else motion
        motion[..., :3] /= np.array([each.lengths for each in mistakes])[:, None, None]
        turned = se3.turn([each.turned for each in mistakes])[:, None]
        signs = np.array([each.mirrored for each in mistakes])[:, None]
        seen, again = (se3.transform(turned, signs * each) for each in self._seen)
        expected = se3.transform(motion, seen)
        far = [np.maximum(np.linalg.norm(each, axis=-1, keepdims=True), 1e-12) for each in (again, expected)]
        apart = [np.log(far[0]) - np.log(far[1]), again / far[0] - expected / far[1]]
        return np.concatenate(apart, axis=-1).swapaxes(1, 2)

    def _motions(self, mistakes: tuple[Mistake, ...]) -> FloatArray:
        """(M, P, 7) motions of the sensor from the second sighting to the first, by odometry."""
        stamp_s, motion = self._odometry.stamp_s, np.empty((len(mistakes), len(self._stamp_s[0]), 7))
        for way in dict.fromkeys((each.poses, each.drive) for each in mistakes):
            rows = [row for row, each in enumerate(mistakes) if (each.poses, each.drive) == way]
            if way not in self._tracks:
                poses, drive = way
                self._tracks[way] = read_drive(CONVENTIONS[poses](self._odometry.pose_world_robot), *drive)
            pose = self._tracks[way]
            delay_s, which = np.unique([mistakes[row].delay_s for row in rows], return_inverse=True)
            is_punctual = not delay_s.any()  # as most are that are asked, one after the other
            if is_punctual and way in self._punctual:
                motion[rows] = self._punctual[way]
                continue
            start, stop = (
                se3.compose(
                    se3.interpolate(stamp_s, pose, (one_s + delay_s[:, None]).ravel()).reshape(len(delay_s), -1, 7),
                    mount,
                )
                for one_s, mount in zip(self._stamp_s, self._mount, strict=True)
            )
            found = se3.between(stop, start)
            motion[rows] = found[which]
            if is_punctual:
                self._punctual[way] = found[0]
        return motion


Pairs: TypeAlias = PlanarPairs | SpatialPairs


def off(residual: FloatArray) -> FloatArray:
    """Return (..., P) by how much the two readings of pairs differ, of residuals (..., K, P)."""
    return np.asarray(np.linalg.norm(residual, axis=-2))


def measure_loss(residual: FloatArray, settings: CheckConfig) -> FloatArray:
    """Return the mean Cauchy loss of residuals (..., K, P): one wrong identity costs little."""
    return np.asarray(np.log1p((np.minimum(off(residual), 10.0) / settings.fits) ** 2).mean(axis=-1))


def read_drive(pose: FloatArray, forward: float, lateral: float, turn: float, exchanged: bool) -> FloatArray:
    """Return poses (N, 7) of a robot, from the first on, whose speeds were written in another way (`Mistake`)."""
    if (forward, lateral, turn, exchanged) == HONEST.drive:
        return pose
    step = se3.log(se3.between(pose[:-1], pose[1:]))
    if exchanged:
        step[:, :2] = step[:, 1::-1]
    step *= [forward, lateral, 1.0, 1.0, 1.0, turn]
    return np.asarray(se3.compose(pose[:1], accumulate(se3.exp(step))))


def reckon_drive(odometry: Odometry, forward: float, lateral: float, turn: float, exchanged: bool) -> FloatArray:
    """Return (N, 3) x, y and unwrapped heading at the odometry's stamps, of speeds that were written in another way."""
    step_s = np.diff(odometry.stamp_s)
    turned = np.append(0.0, np.cumsum(turn * odometry.angular_radps[:-1] * step_s))
    heading = turned[:-1] + 0.5 * np.diff(turned)
    speeds = (odometry.lateral_mps, odometry.forward_mps) if exchanged else (odometry.forward_mps, odometry.lateral_mps)
    ahead, aside = forward * speeds[0][:-1] * step_s, lateral * speeds[1][:-1] * step_s
    x = np.append(0.0, np.cumsum(ahead * np.cos(heading) - aside * np.sin(heading)))
    y = np.append(0.0, np.cumsum(ahead * np.sin(heading) + aside * np.cos(heading)))
    return np.column_stack([x, y, turned])
