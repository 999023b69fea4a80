"""Common mistakes of recordings as values: what changes of the readings undo each, and its words.

`pairs` of sightings show them, `mistake_search` finds which, and `explain.causes` weighs them against other causes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi

import numpy as np

from evermap.geometry import se3
from evermap.types import FloatArray


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


NO_ODOMETRY = "no-odometry"
"""Code of the finding that the odometry never moves, although the robot drove."""


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
DELAYS_S = (*np.arange(1.0, 10.0, 0.5).tolist(), *np.arange(10.0, 61.0, 1.0).tolist())
"""Delays of clocks that are tried, of either sign [s]."""


def make_late(delay_s: float) -> Mistake:
    """Return the mistake of an odometry whose stamps are so much later than those of the detections [s]."""
    side = "later" if delay_s > 0 else "earlier"
    message = (
        f"odometry stamps seem to be {abs(delay_s):.1f} s {side} than those of the detections: two clocks, or one of "
        "them stamped on arrival"
    )
    return Mistake("clock", message, delay_s=delay_s)


def make_longer(factor: float, why: str) -> Mistake:
    """Return the mistake that all ranges times a factor undo; `why` names what may have caused it."""
    told = 1.0 / factor
    how = f"{told:.3g} times too long" if told > 1 else f"{factor:.3g} times too short"
    return Mistake("length-unit", f"ranges seem to be {how} for the distance driven: {why}", lengths=factor)
