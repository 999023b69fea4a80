"""Common mistakes of recordings: changes of the readings that make landmarks static.

Two readings of one landmark, a few seconds apart, and the odometry between them say the same thing twice: where the
landmark is the second time. The difference is taken in the logarithm of the range and in the bearing, in space in the
direction, which no unit of length can make small by itself. A mistake (ranges in millimetres, bearings clockwise, a
clock that is three seconds late) is undone on trial; it is likely where almost all pairs that can tell the two apart
come nearer by it, and nearer than if the robot stood: where it does, any change that shrinks readings shrinks their
noise, which tells nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, log, pi
from typing import Any, Self, TypeAlias

import numpy as np

from evermap.config import CheckConfig
from evermap.geometry import se2, se3
from evermap.geometry.group import accumulate
from evermap.slam.gaps import SILENT_S, find_gaps
from evermap.slam.kernels import pair_residuals, reckoned_motions
from evermap.slam.ranges import has_range_changed
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    FloatArray,
    IntArray,
    Odometry,
    Recording,
    SpatialRecording,
    is_in_space,
    rows_of,
)

USUAL = CheckConfig()


@dataclass(frozen=True, slots=True)
class Mistake:
    """A mistake: the change of the readings that undoes it, and its name.

    Attributes:
        code, message: as in `Finding`.
        lengths: factor on all ranges, or its inverse on all speeds, which is the same.
        bearing, offset_rad: a bearing becomes `bearing * b + offset_rad`.
        turn, forward, lateral: factors on the turn rate, and on the speeds ahead and to the left.
        exchanged: whether these two speeds are each other's.
        delay_s: odometry stamps are so much later than the motion.
        turned: quaternion that turns positions in the sensor's frame.
        mirrored: signs of their coordinates, before that.
        poses: how poses of the odometry were written, a key of `CONVENTIONS`; '' as they are read.
        field: column, or table, that is wrong.
    """

    code: str
    message: str
    lengths: float = 1.0
    bearing: float = 1.0
    offset_rad: float = 0.0
    turn: float = 1.0
    forward: float = 1.0
    lateral: float = 1.0
    exchanged: bool = False
    delay_s: float = 0.0
    turned: tuple[float, ...] = tuple(se3.NO_TURN)
    mirrored: tuple[float, float, float] = (1.0, 1.0, 1.0)
    poses: str = ""
    field: str = ""

    def after(self, other: Mistake) -> Mistake:
        """Return both, the other one undone first."""
        if other is HONEST:
            return self
        turned = self.turned
        if other.turned != HONEST.turned:
            turned = tuple(se3.compose(se3.turn(self.turned), se3.turn(other.turned))[3:].tolist())
        ahead, aside = (other.lateral, other.forward) if self.exchanged else (other.forward, other.lateral)
        return replace(
            self,
            lengths=self.lengths * other.lengths,
            bearing=self.bearing * other.bearing,
            offset_rad=self.bearing * other.offset_rad + self.offset_rad,
            turn=self.turn * other.turn,
            forward=self.forward * ahead,
            lateral=self.lateral * aside,
            exchanged=self.exchanged != other.exchanged,
            delay_s=self.delay_s + other.delay_s,
            turned=turned,
            mirrored=self.mirrored if self.mirrored != HONEST.mirrored else other.mirrored,
            poses=self.poses or other.poses,
        )

    @property
    def drive(self) -> tuple[float, float, float, bool]:
        """Return what it changes of the speeds."""
        return self.forward, self.lateral, self.turn, self.exchanged


HONEST = Mistake("", "")
_LENGTHS = (
    ("range_m", "ranges", "millimetres", 1e-3), ("range_m", "ranges", "centimetres", 1e-2),
    ("range_m", "ranges", "feet", 0.3048), ("range_m", "ranges", "inches", 0.0254),
    ("forward_mps", "speeds", "km/h", 3.6), ("forward_mps", "speeds", "millimetres per second", 1e3),
    ("forward_mps", "speeds", "centimetres per second", 1e2), ("forward_mps", "speeds", "miles an hour", 1 / 0.44704),
    ("forward_mps", "speeds", "feet per second", 1 / 0.3048),
)  # fmt: skip
"""Common units first: with odometer errors of some per cent, km/h and feet per second are indistinguishable."""
_LENGTHS_IN_SPACE = tuple(
    (field, what, unit, factor ** (-1 if field == "odometry" else 1))
    for unit, factor in (("millimetres", 1e-3), ("centimetres", 1e-2), ("feet", 0.3048), ("inches", 0.0254))
    for field, what in (("detections", "positions"), ("odometry", "poses of the robot"))
)
UNITS, UNITS_IN_SPACE = (
    tuple(
        Mistake("length-unit", f"{what} seem to be in {unit}, not in metres ({field})", lengths=factor, field=field)
        for field, what, unit, factor in lengths
    )
    for lengths in (_LENGTHS, _LENGTHS_IN_SPACE)
)
ANGLES = (
    Mistake(
        "bearing-unit",
        "bearings seem to be in degrees, not in radians (bearing_rad)",
        bearing=pi / 180,
        field="bearing_rad",
    ),
    Mistake(
        "turn-unit",
        "turn rates seem to be in degrees, not in radians a second (angular_radps)",
        turn=pi / 180,
        field="angular_radps",
    ),
    Mistake(
        "bearing-sign",
        "bearings, or turn rates, seem to have the wrong sign: counter-clockwise is positive, from x ahead to y on the "
        "left (bearing_rad, angular_radps)",
        bearing=-1.0,
        field="bearing_rad",
    ),
    Mistake(
        "turn-sign",
        "turn rates, or bearings, seem to have the wrong sign: counter-clockwise is positive (angular_radps, "
        "bearing_rad)",
        turn=-1.0,
        field="angular_radps",
    ),
    Mistake(
        "forward-sign",
        "the robot seems to drive in the opposite direction: forward speeds have the wrong sign (forward_mps), or the "
        "sensor looks backwards ([mount] theta_rad)",
        forward=-1.0,
        field="forward_mps",
    ),
    Mistake(
        "forward-sign",
        "the robot seems to drive in the opposite direction: forward and lateral speeds have the wrong sign "
        "(forward_mps, lateral_mps), or the sensor looks backwards ([mount] theta_rad)",
        forward=-1.0,
        lateral=-1.0,
        field="forward_mps",
    ),
    Mistake(
        "odometry-axes",
        "lateral speeds seem to have the wrong sign: y is to the left (lateral_mps)",
        lateral=-1.0,
        field="lateral_mps",
    ),
    Mistake(
        "odometry-axes",
        "forward and lateral speeds seem to be exchanged: x is ahead, y to the left (forward_mps, lateral_mps)",
        exchanged=True,
        field="forward_mps",
    ),
    *(
        Mistake(
            "bearing-axis",
            "bearings seem to be 90 degrees off, from another axis: they are measured from x ahead (bearing_rad, x_m "
            "and y_m, or [mount] theta_rad)",
            bearing=sign,
            offset_rad=offset,
            field="bearing_rad",
        )
        for sign in (1.0, -1.0)
        for offset in (pi / 2, -pi / 2)
    ),
)
RANGED = (
    Mistake(
        "forward-sign",
        "the robot seems to drive in the opposite direction: forward speeds have the wrong sign (forward_mps), or the "
        "sensor's mount is turned by 180 degrees ([mount])",
        offset_rad=pi,
        forward=-1.0,
        lateral=-1.0,
        field="forward_mps",
    ),
)
"""Mistakes of robots whose sensor measures ranges alone: the first bearings, which are guessed, follow the odometry."""
AXES = tuple(
    Mistake(
        "mount-axes",
        f"detections seem to be in a frame with {seen}, but the mount is for one with {stated}: "
        "[mount], or the frame_id of their messages",
        turned=turned,
    )
    for seen, stated, turned in (
        ("x ahead and z up", "z ahead and y down", (0.5, -0.5, 0.5, 0.5)),
        ("z ahead and y down", "x ahead and z up", (-0.5, 0.5, -0.5, 0.5)),
    )
)
MIRRORS = tuple(
    Mistake(
        "detection-axes",
        f"{axis} of the detections' positions seems to have the wrong sign, {why} (detections)",
        mirrored=signs,
        field="detections",
    )
    for axis, why, signs in (
        ("x", "as in a mirrored image", (-1.0, 1.0, 1.0)),
        ("y", "as of y upwards; or the sensor is tilted the other way ([mount])", (1.0, -1.0, 1.0)),
    )
)
"""Axes of a camera, one of which points the other way: no rotation of it brings them about."""
CONVENTIONS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "": lambda pose: pose,
    "w first": lambda pose: pose[..., [0, 1, 2, 4, 5, 6, 3]],
    "inverse": lambda pose: np.asarray(se3.inverse(pose)),
}
"""Ways to write poses (..., 7), and how each is read: position and quaternion x, y, z, w of the robot in the world."""
POSES = (
    Mistake(
        "odometry-poses",
        "quaternions of the odometry seem to be in the order w, x, y, z: x, y, z, w is expected (odometry)",
        poses="w first",
        field="odometry",
    ),
    Mistake(
        "odometry-poses",
        "poses of the odometry seem to be those of the world in the robot's frame, not of the robot in the world "
        "(odometry)",
        poses="inverse",
        field="odometry",
    ),
)
DRIVES = (
    Mistake(
        "turn-sign",
        "turns of the odometry seem to have the wrong sign: counter-clockwise is positive (angular_radps)",
        turn=-1.0,
        field="angular_radps",
    ),
    Mistake(
        "forward-sign",
        "the robot seems to drive in the opposite direction: forward speeds have the wrong sign (forward_mps)",
        forward=-1.0,
        field="forward_mps",
    ),
    Mistake(
        "forward-sign",
        "the robot seems to drive in the opposite direction: forward and lateral speeds have the wrong sign "
        "(forward_mps, lateral_mps), or the sensors look backwards ([mount])",
        forward=-1.0,
        lateral=-1.0,
        field="forward_mps",
    ),
    Mistake(
        "odometry-axes",
        "lateral motion of the odometry seems to have the wrong sign: y is to the left (lateral_mps)",
        lateral=-1.0,
        field="lateral_mps",
    ),
    Mistake(
        "odometry-axes",
        "forward and lateral motion of the odometry seem to be exchanged: x is ahead, y to the left (forward_mps, "
        "lateral_mps)",
        exchanged=True,
        field="forward_mps",
    ),
    Mistake(
        "odometry-mirrored",
        "the odometry seems mirrored: y is to the left, turns are counter-clockwise (lateral_mps, angular_radps)",
        lateral=-1.0,
        turn=-1.0,
        field="lateral_mps",
    ),
)
"""Signs and axes of an odometry in space, those that are met more often first."""
_DELAYS_S = (*np.arange(1.0, 10.0, 0.5).tolist(), *np.arange(10.0, 61.0, 1.0).tolist())
LEAST_WAY_M, HEAD_ON, FASTER = 0.5, 0.9, 2.0
"""Of ranges alone: the way between two from which their difference is compared with it, the quantile of the ratio at
which the robot drives straight to a landmark or away from it, and what that is at least in another unit."""
AT_ONCE = 32
"""Number of corrections that are tried together: arrays of a megabyte."""
SHARES = (slice(0, None, 64), *(slice(step // 2, None, step) for step in (64, 32, 16, 8, 4)))
"""Parts of the pairs, half of which may rule out candidates one after the other: few show most of them to be wrong."""
LIKELIEST_BY = 250
"""Pairs that show which delay is the likeliest for a whole recording."""
LEAST_STEP_S = 0.4
"""Minimum clock difference that is reported; smaller ones are estimated by the calibration."""
_FACTORS = tuple(10.0**power for power in np.arange(-4.0, 4.01, 0.1) if abs(power) > 0.25)


NO_ODOMETRY = "no-odometry"
"""Code of the finding that the odometry never moves, although the robot drove."""
STANDS, MOVED = 1e-3, 0.1
"""Speed up to which the odometry says so [m/s, rad/s], and difference of two sightings from which the robot moved."""
RIDES, NEARLY = 0.2, 0.9
"""What moves with the robot changes in view by less than this, over what the odometry says, in more of its pairs."""


def _late(delay_s: float) -> Mistake:
    side = "later" if delay_s > 0 else "earlier"
    message = (
        f"odometry stamps seem to be {abs(delay_s):.1f} s {side} than those of the detections: two clocks, or one of "
        "them stamped on arrival"
    )
    return Mistake("clock", message, delay_s=delay_s)


def _longer(factor: float, why: str) -> Mistake:
    told = 1.0 / factor
    how = f"{told:.3g} times too long" if told > 1 else f"{factor:.3g} times too short"
    return Mistake("length-unit", f"ranges seem to be {how} for the distance driven: {why}", lengths=factor)


def likeliest(pairs: Pairs, undone: Mistake, told: Container[str], settings: CheckConfig) -> Mistake | None:
    """Return the mistake that explains most of the rest, if it certainly explains anything.

    Those found so far are `undone`; codes in `told` are not looked for.
    """
    before = pairs.residual(undone)[0]
    candidates = [*pairs.units, *pairs.angles, *(_longer(factor, pairs.why_longer) for factor in _FACTORS)]
    candidates += [_late(side * delay_s) for delay_s in _DELAYS_S for side in (1.0, -1.0)]
    candidates = [mistake for mistake in candidates if mistake.code not in told]

    def after(mistakes: list[Mistake]) -> FloatArray:
        return pairs.residual(*(mistake.after(undone) for mistake in mistakes))

    def standing(mistakes: list[Mistake]) -> FloatArray:
        return pairs.residual(*(mistake.after(undone) for mistake in mistakes), stands=True)

    candidates = _possible(pairs, candidates, undone, before, settings)
    if not candidates:
        return None
    parts = [candidates[row : row + AT_ONCE] for row in range(0, len(candidates), AT_ONCE)]
    losses = np.concatenate([_nearer(pairs, before, after(part), standing(part), settings) for part in parts])
    best, least = candidates[int(np.argmin(losses))], losses.min()
    if least == inf:
        return None
    if best.code == "clock":
        near = [_late(best.delay_s + 0.1 * step) for step in range(-5, 6)]
    elif best.code == "length-unit":  # a unit that has a name is likelier than a factor that has none
        gain = _loss(before, settings) - least
        for mistake, loss in zip(candidates, losses.tolist(), strict=True):
            alike = mistake in pairs.units and abs(log(mistake.lengths / best.lengths)) < 0.3
            if alike and loss < least + 0.1 * gain:
                return mistake
        near = [_longer(best.lengths * 10.0 ** (0.01 * step), pairs.why_longer) for step in range(-10, 11)]
    else:
        return best
    return near[int(np.argmin(_loss(after(near), settings)))]


def _possible(
    pairs: Pairs, candidates: list[Mistake], undone: Mistake, before: FloatArray, settings: CheckConfig
) -> list[Mistake]:
    """Return the candidates but for those that a share of the pairs shows to gain too little: `_nearer` gives them inf.

    Losses are no less than 0, so that of some pairs bounds the gain over all.
    """
    most = len(before[0]) * float(_loss(before, settings)) - settings.gain
    spent = np.zeros(len(candidates))
    for share in SHARES:
        if share.start >= len(before[0]):
            continue
        part, at_once = pairs.among(share), share.step * AT_ONCE
        for row in range(0, len(candidates), at_once):
            tried = slice(row, row + at_once)
            after = part.residual(*(mistake.after(undone) for mistake in candidates[tried]))
            spent[tried] += after.shape[-1] * _loss(after, settings)
        possible = np.flatnonzero(spent < most).tolist()
        candidates, spent = [candidates[row] for row in possible], spent[possible]
        if not candidates:
            break
    return candidates


def _nearer(
    pairs: Pairs, before: FloatArray, after: FloatArray, standing: FloatArray, settings: CheckConfig
) -> FloatArray:
    """(M,) loss of the residuals (M, K, P) after undoing a mistake each; inf unless almost all pairs that tell come
    nearer by it, and nearer than if the robot were `standing`.
    """
    was, now = off(before), off(after)
    apart = off(pairs.difference(after, before))
    usual = np.fmin(np.median(was), np.median(now, axis=1))
    telling = apart > np.fmax(settings.fits, settings.apart * usual)[:, None]
    n_telling = telling.sum(axis=1)
    agreed = (telling & (now < was)).sum(axis=1) >= settings.agreed * n_telling
    loss = _loss(after, settings)
    rivals = np.minimum(_loss(before, settings), _loss(standing, settings))
    gain = len(was) * (rivals - loss)
    return np.where((n_telling >= settings.fewest) & agreed & (gain > settings.gain), loss, inf)


def _loss(residual: FloatArray, settings: CheckConfig) -> FloatArray:
    """Mean Cauchy loss of residuals (..., K, P): one wrong identity costs little."""
    return np.asarray(np.log1p((np.minimum(off(residual), 10.0) / settings.fits) ** 2).mean(axis=-1))


def off(residual: FloatArray) -> FloatArray:
    """Return (..., P) by how much the two readings of pairs differ, of residuals (..., K, P)."""
    return np.asarray(np.linalg.norm(residual, axis=-2))


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
                self._tracks[drive] = _dead_reckoned(self._odometry, *drive)
            track = self._tracks[drive]
            reckoned_motions(*self._stamp_s, delay_s, self._odometry.stamp_s, track, self._mount, motion[row])
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


def clock_steps(recording: Recording, longest_s: float = inf) -> tuple[FloatArray, FloatArray]:
    """Return from when on the odometry's clock is ahead of the detections', and by how much.

    Piecewise constant, by dynamic programming (Viterbi 1967): in every second a pair of sightings has a Cauchy loss, on
    the scale of the usual residual, at each delay, and a step costs `CheckConfig.gain`.

    Args:
        recording: in the plane.
        longest_s: by how much a step may be at most; delays that are further from the likeliest one are not tried.

    Returns:
        (K,) stamps of frames, the first -inf, and (K,) delays that hold from then on [s].
    """
    settings = USUAL
    first, second = sighting_pairs(recording, settings)
    if len(first) < settings.fewest:
        return np.array([-inf]), np.zeros(1)
    pairs = PlanarPairs(recording, first, second)
    delays_s = np.concatenate([[0.0, 0.5, -0.5], _DELAYS_S, np.negative(_DELAYS_S)])
    if longest_s < np.ptp(delays_s):  # a share of the pairs shows which is likeliest
        part = pairs.among(slice(None, None, max(1, len(first) // LIKELIEST_BY)))
        usual_s = delays_s[np.argmin(_loss(part.residual(*map(_late, delays_s)), settings))]
        delays_s = delays_s[np.abs(delays_s - usual_s) <= longest_s + 0.5]
    far = np.minimum(off(pairs.residual(*map(_late, delays_s))), 10.0)
    until_s = recording.frames.stamp_s[recording.detections.frame[second]]
    begin_s, second_of = np.unique(np.floor(until_s), return_inverse=True)
    usual, path = settings.fits, np.zeros(len(begin_s), dtype=np.int64)
    for _ in range(2):  # the usual difference is only visible at the right delays
        usual = max(settings.fits, float(np.median(far[path[second_of], np.arange(len(first))])))
        # a sighting is in two pairs
        loss = 0.5 * np.log1p((far / usual) ** 2)
        path = _cheapest(np.stack([np.bincount(second_of, row, len(path)) for row in loss], axis=1), settings.gain)
    begin = np.flatnonzero(np.diff(path, prepend=-1))
    since_s, delay_s = [-inf], [0.0]
    for row, (start, stop) in enumerate(pairwise([*begin.tolist(), len(path)])):
        mine = (second_of >= start) & (second_of < stop)
        near_s = delays_s[path[start]] + 0.1 * np.arange(-5, 6)
        left = _loss(pairs.residual(*map(_late, near_s))[..., mine], settings)
        found = float(near_s[int(np.argmin(left))])
        if row == 0:
            delay_s[0] = found
        elif abs(found - delay_s[-1]) > LEAST_STEP_S:
            since_s.append(float(begin_s[start]))
            delay_s.append(found)
    return np.array(since_s), np.array(delay_s)


def _cheapest(loss: FloatArray, step: float) -> IntArray:
    """(T,) options, one for each row of a table of losses (T, D), of which each change costs `step`."""
    total, came = loss[0].copy(), np.zeros(loss.shape, dtype=np.int64)
    every = np.arange(loss.shape[1])
    for row in range(1, len(loss)):
        best = int(np.argmin(total))
        changed = total > total[best] + step
        came[row] = np.where(changed, best, every)
        total = np.where(changed, total[best] + step, total) + loss[row]
    path = np.full(len(loss), np.argmin(total), dtype=np.int64)
    for row in range(len(loss) - 1, 0, -1):
        path[row - 1] = came[row, path[row]]
    return path


def read_drive(pose: FloatArray, forward: float, lateral: float, turn: float, exchanged: bool) -> FloatArray:
    """Return poses (N, 7) of a robot, from the first on, whose speeds were written in another way (`Mistake`)."""
    if (forward, lateral, turn, exchanged) == HONEST.drive:
        return pose
    step = se3.log(se3.between(pose[:-1], pose[1:]))
    if exchanged:
        step[:, :2] = step[:, 1::-1]
    step *= [forward, lateral, 1.0, 1.0, 1.0, turn]
    return np.asarray(se3.compose(pose[:1], accumulate(se3.exp(step))))


def _dead_reckoned(odometry: Odometry, forward: float, lateral: float, turn: float, exchanged: bool) -> FloatArray:
    """(N, 3) x, y and unwrapped heading at the odometry's stamps, of speeds that were written in another way."""
    step_s = np.diff(odometry.stamp_s)
    turned = np.append(0.0, np.cumsum(turn * odometry.angular_radps[:-1] * step_s))
    heading = turned[:-1] + 0.5 * np.diff(turned)
    speeds = (odometry.lateral_mps, odometry.forward_mps) if exchanged else (odometry.forward_mps, odometry.lateral_mps)
    ahead, aside = forward * speeds[0][:-1] * step_s, lateral * speeds[1][:-1] * step_s
    x = np.append(0.0, np.cumsum(ahead * np.cos(heading) - aside * np.sin(heading)))
    y = np.append(0.0, np.cumsum(ahead * np.sin(heading) + aside * np.cos(heading)))
    return np.column_stack([x, y, turned])


def find_silences(recording: AnyRecording, settings: CheckConfig) -> FloatArray:
    """Return (K, 2) from when to when the odometry has no rows, or says that the robot stands, although it drives [s].

    It drives if most pairs of sightings of several landmarks within such a time have moved in the sensor's view. Where
    the odometry never says anything, all of it is wrong, and nothing is silent.
    """
    odometry = recording.odometry
    if odometry is None or len(odometry) < 2:
        return np.zeros((0, 2))
    quiet_s = np.concatenate([find_gaps(odometry), _find_standstills(recording)])
    if not len(quiet_s):
        return quiet_s
    blind = not is_in_space(recording) and bool(np.isnan(recording.detections.bearing_rad).mean() > 0.5)
    first, second = sighting_pairs(recording, settings, with_bearing=not blind)
    if blind:
        moves = has_range_changed(recording, first, second)  # type: ignore[arg-type]
    elif len(first) >= settings.fewest:
        moves = off(make_pairs(recording, first, second).residual(HONEST, stands=True)[0]) > MOVED
    else:
        return np.zeros((0, 2))
    seen_s, landmark = recording.frames.stamp_s[recording.detections.frame], recording.detections.landmark_id[first]
    driven = np.zeros(len(quiet_s), dtype=np.bool_)
    for row, (start_s, stop_s) in enumerate(quiet_s.tolist()):
        own = (seen_s[first] >= start_s) & (seen_s[second] <= stop_s)
        several = len(np.unique(landmark[own & moves])) > 1
        driven[row] = np.count_nonzero(own) >= settings.fewest and several and np.mean(moves[own]) > 0.5
    return quiet_s[driven][np.argsort(quiet_s[driven, 0])]


def _find_standstills(recording: AnyRecording) -> FloatArray:
    """(K, 2) from when to when the odometry says for long that the robot stands [s]; none if it never says else."""
    odometry = recording.odometry
    assert odometry is not None
    step_s = np.diff(odometry.stamp_s)
    if is_in_space(recording):
        pose = recording.odometry.pose_world_robot  # type: ignore[union-attr]
        step = np.abs(se3.local(pose[:-1], pose[1:])).max(axis=1)
    else:
        driven = recording.odometry
        speeds = driven.forward_mps[:-1], driven.lateral_mps[:-1], driven.angular_radps[:-1]
        step = np.abs(speeds).max(axis=0) * step_s
    stands = step <= STANDS * step_s
    if stands.all():
        return np.zeros((0, 2))
    bounds = np.diff(np.concatenate([[False], stands, [False]]).astype(np.int64))
    span_s = odometry.stamp_s[np.column_stack([np.flatnonzero(bounds == 1), np.flatnonzero(bounds == -1)])]
    return span_s[span_s[:, 1] - span_s[:, 0] > SILENT_S]


def without_silences(recording: Any, silence_s: FloatArray) -> Any:
    """Return a recording without the odometry's rows within silences (K, 2): estimators know what a gap says."""
    if not len(silence_s):
        return recording
    stamp_s, silent = recording.odometry.stamp_s, np.zeros(len(recording.odometry), dtype=np.bool_)
    for start_s, stop_s in silence_s.tolist():  # poses hold at both ends, velocities from the first of them on
        silent |= ((stamp_s > start_s) if is_in_space(recording) else (stamp_s >= start_s)) & (stamp_s < stop_s)
    silent[0] = False
    return replace(recording, odometry=rows_of(recording.odometry, ~silent))


def find_riders(recording: AnyRecording, settings: CheckConfig) -> IntArray:
    """Return identities of what moves with the robot: a tag on the robot itself, or on what it tows or follows.

    By pairs of sightings between which the odometry says that a landmark must have moved in the sensor's view: nearly
    all of a rider show it where it was, while the others, seen then, have moved as the odometry says.
    """
    none = np.zeros(0, dtype=np.int64)
    first, second = sighting_pairs(recording, settings)
    if len(first) < settings.fewest or (pairs := make_pairs(recording, first, second)).still:
        return none
    frame, identity = recording.detections.frame[first], recording.detections.landmark_id[first]
    in_view, against_odometry = (off(pairs.residual(HONEST, stands=stands)[0]) for stands in (True, False))
    shows = against_odometry > MOVED
    if is_in_space(recording):  # a box may keep its distance: the tracker follows it
        shows &= ~np.isfinite(recording.detections.size_m[first]).all(axis=1)
    found = list[int]()
    for one in np.unique(identity[shows]).tolist():
        mine = np.flatnonzero(shows & (identity == one))
        others = np.flatnonzero((identity != one) & np.isin(frame, frame[mine]))
        if min(len(mine), len(others)) < settings.fewest:
            continue
        rests = in_view[mine] < RIDES * against_odometry[mine]
        is_right = np.median(against_odometry[others]) < np.median(in_view[others])  # or all else rides as well
        if np.mean(rests) > NEARLY and is_right:
            found.append(one)
    return np.array(found, dtype=np.int64)


def without_riders(recording: Any, riders: IntArray) -> Any:
    """Return a recording without the detections of some identities."""
    if not len(riders):
        return recording
    stays = ~np.isin(recording.detections.landmark_id, riders)
    return replace(recording, detections=rows_of(recording.detections, stays))


@dataclass(frozen=True, slots=True)
class Finding:
    """One problem of a recording.

    Attributes:
        code: short and stable, for programs.
        message: the problem, its size, and the likely cause.
        usable: False if estimates would be meaningless.
        is_refused: whether nothing can be estimated: `run_slam` raises `DataError`. It is not usable, then.
    """

    code: str
    message: str
    usable: bool = True
    is_refused: bool = False


def find_motion(recording: AnyRecording, settings: CheckConfig) -> list[Finding]:
    """Return mistakes that make static landmarks appear to move."""
    pairs = pairs_of(recording, settings)
    if pairs is None:
        return [] if is_in_space(recording) else _find_unit_of_ranges(recording, settings)
    if pairs.still:
        moved = off(pairs.residual(HONEST)) > 0.1
        if np.sum(moved) < settings.fewest or np.mean(moved) < 0.1:
            return []
        message = (
            f"the odometry is zero throughout, but {np.mean(moved):.0%} of the landmarks seen again within seconds "
            f"have moved in the sensor's view: the robot drove ({pairs.speeds})"
        )
        return [Finding(NO_ODOMETRY, message, usable=False)]
    undone = HONEST
    found: list[Finding] = []
    for _ in range(3):
        mistake = likeliest(pairs, undone, {finding.code for finding in found}, settings)
        if mistake is None:
            break
        found.append(Finding(mistake.code, mistake.message, usable=False))
        undone = mistake.after(undone)
    usual = float(np.median(off(pairs.residual(undone))))
    if usual > settings.off and not pairs.turns:
        message = (
            "turn rates are zero throughout, but the landmarks turn in the sensor's view: the odometry's turning seems "
            "to be missing (angular_radps)"
        )
        return [Finding("no-turning", message, usable=False)]
    if usual > settings.off:
        message = (
            f"landmarks are not static: seen again within seconds, half of them are over {usual:.2g} rad or "
            f"{usual:.0%} of their range from the prediction by odometry; mixed identities, or "
            "mistakes in several units, signs or frames at once"
        )
        return [Finding("landmarks-move", message)]
    return found


def _find_unit_of_ranges(recording: Recording, settings: CheckConfig) -> list[Finding]:
    """Return the unit of ranges without bearings, which change faster than the sensor moves in any direction."""
    first, second = sighting_pairs(recording, settings, with_bearing=False)
    seen = recording.detections
    if len(first) < settings.fewest:
        return []
    stamp_s, motion = recording.frames.stamp_s[seen.frame], np.empty((len(first), 3))
    driven, mount = recording.odometry, np.array(recording.sensor.mount_robot_sensor, dtype=np.float64)
    track = _dead_reckoned(driven, *HONEST.drive)
    reckoned_motions(stamp_s[first], stamp_s[second], 0.0, driven.stamp_s, track, mount, motion)
    way_m = np.hypot(motion[:, 0], motion[:, 1])
    moved = way_m > LEAST_WAY_M
    faster = np.abs(seen.range_m[second] - seen.range_m[first])[moved] / way_m[moved]
    landmark = seen.landmark_id[first][moved]
    fastest = [
        float(np.quantile(faster[landmark == one], HEAD_ON))
        for one in np.unique(landmark).tolist()
        if np.count_nonzero(landmark == one) >= settings.fewest
    ]
    usual = float(np.median(fastest)) if fastest else 1.0
    if usual < FASTER:  # no triangle inequality is broken, but for noise and slip
        return []
    for mistake in UNITS:
        if mistake.field == "range_m" and abs(log(mistake.lengths * usual)) < log(FASTER) / 2.0:
            return [Finding(mistake.code, mistake.message, usable=False)]
    return []


def unusable(recording: AnyRecording, settings: CheckConfig) -> Finding | None:
    """Return why static landmarks seem to move by the odometry of a recording; None if they do not."""
    return next(iter(find_motion(recording, settings)), None)
