"""What a simulated building, the objects in it, its robot and its sensor are like; every field with a default.

Each `check` raises `ConfigError` naming the field; `simulate_building` calls it before anything else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np

from evermap.errors import ConfigError
from evermap.types import FloatArray, Sensor

DAY_S: float = 86_400.0


@dataclass(frozen=True, slots=True)
class Duration:
    """A gamma distributed duration; `shape` 1 is exponential, larger is more regular.

    Attributes:
        mean_days: mean.
        shape: shape of the gamma distribution; the standard deviation is `mean_days / sqrt(shape)`.
    """

    mean_days: float
    shape: float = 1.0

    def sample_s(self, rng: np.random.Generator) -> float:
        """Draw one duration in seconds."""
        return float(rng.gamma(self.shape, self.mean_days * DAY_S / self.shape))

    def check(self, where: str) -> None:
        """Raise `ConfigError` if a field is out of range."""
        require_within(self.mean_days, f"{where}.mean_days", 0.01, 1e6)
        require_within(self.shape, f"{where}.shape", 0.1, 1e3)


@dataclass(frozen=True, slots=True)
class ObjectClass:
    """One kind of object: how many, how it looks to the sensor, and how it comes, moves and goes.

    At the end of a stay an object on the floor vanishes with `p_vanish`, else it is moved at once. A vanished one
    comes back after `absence` with `p_return`, then to the very place it left with `p_same_place`.

    Attributes:
        name: class name in recordings.
        mount: 'floor' (stands anywhere clear of the robot's route), 'wall' (marker, never moves) or 'hinge'
            (leaf of an exterior door, swings between two positions).
        count: number present on day 0.
        landmarks: smallest and largest number of landmarks on one object, within 1 to 4.
        size_m: length and width of the footprint; for a hinge the length of the leaf.
        against_wall: floor objects only: stands along a wall instead of freely in the room.
        stay: time at one place (floor) or in one position (hinge); None = for ever.
        absence: time away after vanishing.
        p_vanish, p_return, p_same_place: probabilities, see above.
        p_nudge: probability that a move is a shift by 0.3 to 1.5 m instead of a new place.
        p_other_room: probability that a move, or a return to another place, leads to another room.
        arrivals_per_day: mean number of new objects a day.
    """

    name: str
    mount: Literal["floor", "wall", "hinge"] = "floor"
    count: int = 4
    landmarks: tuple[int, int] = (1, 4)
    size_m: tuple[float, float] = (0.8, 0.6)
    against_wall: bool = False
    stay: Duration | None = None
    absence: Duration = Duration(1.0)
    p_vanish: float = 0.3
    p_return: float = 0.7
    p_same_place: float = 0.5
    p_nudge: float = 0.4
    p_other_room: float = 0.3
    arrivals_per_day: float = 0.0

    def check(self, where: str) -> None:
        """Raise `ConfigError` if a field is out of range."""
        if not self.name:
            raise ConfigError("a class needs a name", field=f"{where}.name")
        if self.mount not in ("floor", "wall", "hinge"):
            raise ConfigError(f"unknown mount '{self.mount}'", field=f"{where}.mount", hint="floor, wall or hinge")
        require_within(self.count, f"{where}.count", 0, 1000)
        fewest, most = self.landmarks
        if not 1 <= fewest <= most <= 4:
            raise ConfigError(f"is {self.landmarks}", field=f"{where}.landmarks", hint="two integers from 1 to 4")
        for size in self.size_m:
            require_within(size, f"{where}.size_m", 0.05, 3.0)
        for label, duration in (("stay", self.stay), ("absence", self.absence)):
            if duration is not None:
                duration.check(f"{where}.{label}")
        for name in ("p_vanish", "p_return", "p_same_place", "p_nudge", "p_other_room"):
            require_within(getattr(self, name), f"{where}.{name}", 0.0, 1.0)
        if self.p_nudge + self.p_other_room > 1.0 + 1e-12:
            raise ConfigError("p_nudge + p_other_room exceeds 1", field=f"{where}.p_nudge", hint="a smaller value")
        require_within(self.arrivals_per_day, f"{where}.arrivals_per_day", 0.0, 100.0)
        if self.arrivals_per_day > 0 and self.mount != "floor":
            raise ConfigError("only floor objects arrive", field=f"{where}.arrivals_per_day", hint="0")


DEFAULT_CLASSES: tuple[ObjectClass, ...] = (
    ObjectClass("fixture", "wall", count=14, landmarks=(1, 1)),
    ObjectClass("door", "hinge", count=5, landmarks=(2, 2), size_m=(0.95, 0.05), stay=Duration(0.8)),
    ObjectClass(
        "shelf", count=5, landmarks=(3, 4), size_m=(1.6, 0.5), against_wall=True, stay=Duration(20.0, 3.0),
        absence=Duration(3.0), p_vanish=0.2, p_nudge=0.5, p_other_room=0.2,
    ),
    ObjectClass(
        "pallet", count=6, landmarks=(2, 3), size_m=(1.2, 0.8), stay=Duration(4.0, 1.5),
        absence=Duration(1.5), p_vanish=0.7, p_return=0.5, p_same_place=0.5, p_nudge=0.4, arrivals_per_day=0.6,
    ),
    ObjectClass(
        "chair", count=8, landmarks=(1, 2), size_m=(0.5, 0.5), stay=Duration(2.0),
        absence=Duration(1.0), p_vanish=0.15, p_return=0.9, p_nudge=0.8, p_other_room=0.1,
    ),
    ObjectClass(
        "cart", count=4, landmarks=(2, 2), size_m=(0.9, 0.6), stay=Duration(1.5),
        absence=Duration(0.7), p_vanish=0.5, p_return=0.9, p_same_place=0.6, p_nudge=0.2, p_other_room=0.5,
        arrivals_per_day=0.1,
    ),
)  # fmt: skip
"""A warehouse with offices: 14 wall markers, 5 exterior doors and 23 objects that come and go."""

CLUTTER: ObjectClass = ObjectClass(
    "crate", count=16, landmarks=(1, 1), size_m=(0.4, 0.4), stay=Duration(0.3), absence=Duration(0.4),
    p_vanish=0.9, p_return=0.8, p_same_place=0.1, p_nudge=0.2, p_other_room=0.5, arrivals_per_day=4.0,
)  # fmt: skip
"""Crates that are put down for a few hours, taken away and reused: rarely in one place on two patrols."""

ROOM_DOORS: tuple[Duration, Duration] = (Duration(2.0), Duration(0.4))
"""How long the door to a room stays open, and then shut."""


@dataclass(frozen=True, slots=True)
class DriveConfig:
    """The robot's motion.

    Attributes:
        truth_hz: rate of the control loop and of the true trajectory.
        speed_mps, turn_radps: largest forward and angular speed.
        acceleration_mps2, turn_acceleration_radps2: bounds of their changes.
        lateral_acceleration_mps2: bound in curves, slows the robot there.
        lookahead_m: distance of the point on the route that is steered to, at least 0.35 s of driving.
        slip_m: white sideways slip, metres per square root of a second; odometry does not see it.
    """

    truth_hz: float = 50.0
    speed_mps: float = 1.3
    turn_radps: float = 1.6
    acceleration_mps2: float = 0.8
    turn_acceleration_radps2: float = 5.0
    lateral_acceleration_mps2: float = 0.9
    lookahead_m: float = 0.45
    slip_m: float = 0.004

    def check(self, where: str) -> None:
        """Raise `ConfigError` if a field is out of range."""
        bounds = {
            "truth_hz": (20.0, 500.0), "speed_mps": (0.1, 2.0), "turn_radps": (0.5, 6.0),
            "acceleration_mps2": (0.2, 5.0), "turn_acceleration_radps2": (3.0, 50.0),
            "lateral_acceleration_mps2": (0.1, 2.0), "lookahead_m": (0.3, 0.8), "slip_m": (0.0, 0.02),
        }  # fmt: skip
        _all_within(self, where, bounds)


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    """What the wheel encoders get wrong; the defaults resemble small real robots.

    Reported at `t` is the mean true velocity over one period, `delay_s` ago, times the scale, plus white noise.

    Attributes:
        rate_hz: rows a second.
        delay_s: lag of the report behind the motion.
        forward_scale, angular_scale: reported divided by true.
        forward_noise_m, angular_noise_rad: noise of the integrated report per square root of a second.
    """

    rate_hz: float = 25.0
    delay_s: float = 0.12
    forward_scale: float = 1.03
    angular_scale: float = 1.04
    forward_noise_m: float = 0.012
    angular_noise_rad: float = 0.015

    def check(self, where: str) -> None:
        """Raise `ConfigError` if a field is out of range."""
        bounds = {
            "rate_hz": (5.0, 500.0), "delay_s": (0.0, 2.0), "forward_scale": (0.5, 2.0), "angular_scale": (0.5, 2.0),
            "forward_noise_m": (0.0, 0.5), "angular_noise_rad": (0.0, 0.5),
        }  # fmt: skip
        _all_within(self, where, bounds)


@dataclass(frozen=True, slots=True)
class SimulatedSensor:
    """A range-bearing sensor that reads identities, and its faults.

    Reported are `range_bias_m + r (1 + range_slope + range_bearing b + range_bearing2 b^2)` and `b + bearing_bias_rad`
    plus white noise, of the true range `r` and bearing `b` from the sensor.

    Attributes:
        rate_hz: frames a second.
        range_min_m, range_max_m: limits of the true range.
        field_of_view_rad: full opening angle, symmetric about the sensor's axis.
        mount_robot_sensor: pose of the sensor on the robot (x, y, theta), known to the estimator.
        sigma_range_m, sigma_bearing_rad: standard deviations of the noise.
        range_bias_m, range_slope, range_bearing, range_bearing2, bearing_bias_rad: calibration errors.
        p_detect_near, p_detect_far: detection probability of a landmark in view at range zero and at the largest
            range; in between `near + (far - near) (r / range_max_m)^2`.
        stickiness: probability that the fate of a landmark (hit or miss) in a frame is decided by the same draw as
            in the frame before; 0 = independent frames. It leaves the detection probability as it is.
        p_wrong_identity: probability that a detection carries the identity of another landmark.
        p_no_identity: probability that a detection carries no identity (`UNKNOWN`), nor a class.
        p_false: probability of one detection of nothing, with a random identity, in a frame.
    """

    rate_hz: float = 5.0
    range_min_m: float = 0.4
    range_max_m: float = 6.5
    field_of_view_rad: float = 2.4
    mount_robot_sensor: tuple[float, float, float] = (0.15, 0.0, 0.0)
    sigma_range_m: float = 0.03
    sigma_bearing_rad: float = 0.01
    range_bias_m: float = 0.03
    range_slope: float = 0.01
    range_bearing: float = 0.0
    range_bearing2: float = 0.0
    bearing_bias_rad: float = 0.01
    p_detect_near: float = 0.9
    p_detect_far: float = 0.5
    stickiness: float = 0.3
    p_wrong_identity: float = 0.003
    p_no_identity: float = 0.0
    p_false: float = 0.005

    def check(self, where: str) -> None:
        """Raise `ConfigError` if a field is out of range."""
        bounds = {
            "rate_hz": (0.1, 50.0), "range_min_m": (0.05, 5.0), "range_max_m": (1.0, 100.0),
            "field_of_view_rad": (0.1, 2.0 * math.pi + 1e-9), "sigma_range_m": (0.0, 1.0),
            "sigma_bearing_rad": (0.0, 0.5), "range_bias_m": (-1.0, 1.0), "range_slope": (-0.5, 0.5),
            "range_bearing": (-0.5, 0.5), "range_bearing2": (-0.6, 0.6), "bearing_bias_rad": (-0.5, 0.5),
            "p_detect_near": (0.0, 1.0), "p_detect_far": (0.0, 1.0), "stickiness": (0.0, 0.999),
            "p_wrong_identity": (0.0, 1.0), "p_no_identity": (0.0, 1.0), "p_false": (0.0, 1.0),
        }  # fmt: skip
        _all_within(self, where, bounds)
        if self.range_min_m >= self.range_max_m:
            raise ConfigError("is not below range_max_m", field=f"{where}.range_min_m", hint="a smaller value")
        if len(self.mount_robot_sensor) != 3:
            raise ConfigError("is not (x, y, theta)", field=f"{where}.mount_robot_sensor")
        for value in self.mount_robot_sensor:
            # farther out, the sensor would poke through the walls that the robot passes
            require_within(value, f"{where}.mount_robot_sensor", -math.pi, math.pi)
        if math.hypot(*self.mount_robot_sensor[:2]) > 0.3:
            raise ConfigError("is outside the robot", field=f"{where}.mount_robot_sensor", hint="at most 0.3 m away")

    def detection_probability(self, range_m: FloatArray) -> FloatArray:
        """Return P(detected | in view) at the true ranges, any shape."""
        share = (range_m / self.range_max_m) ** 2
        return self.p_detect_near + (self.p_detect_far - self.p_detect_near) * share

    def reported_range(self, range_m: FloatArray, bearing_rad: FloatArray) -> FloatArray:
        """Apply the range law, without noise."""
        factor = 1.0 + self.range_slope + self.range_bearing * bearing_rad + self.range_bearing2 * bearing_rad**2
        return self.range_bias_m + range_m * factor

    def nominal(self) -> Sensor:
        """Return what the robot's user would state: limits, noise, mounting, but no calibration errors."""
        return Sensor(
            range_min_m=self.range_min_m,
            range_max_m=self.range_max_m,
            bearing_min_rad=-self.field_of_view_rad / 2,
            bearing_max_rad=self.field_of_view_rad / 2,
            sigma_range_m=self.sigma_range_m or None,
            sigma_bearing_rad=self.sigma_bearing_rad or None,
            p_detect=(self.p_detect_near + self.p_detect_far) / 2,
            p_false=self.p_false,
            mount_robot_sensor=self.mount_robot_sensor,
        )


@dataclass(frozen=True, slots=True)
class BuildingConfig:
    """Everything about a simulated building and the robot that patrols it.

    Attributes:
        days: days that the recordings span.
        sessions_per_day: patrols a day, spread over the working hours (8 to 18 h).
        patrol_s: length of one patrol. The robot repeats its lap; the default is about one lap of the default
            building, a shorter patrol leaves the last rooms unvisited.
        change_rate: factor on how often things move, come and go. 0 is a static world that is otherwise the same:
            same building, same drive, same noise.
        length_m, depth_m, corridor_m: outer size of the building, and width of the corridor that runs along it.
        rooms_per_side: rooms on either side of the corridor.
        first_day_unix_s: midnight of day 0, seconds since 1970 UTC (default: Monday, 1 January 2024).
        classes: what stands in the building.
        drive, odometry, sensor: the robot.
        patrol_lengths_s: where given, every patrol draws its length from these instead of `patrol_s`, and its own
            route: a random subset of the rooms, a random direction, starting anywhere along it. The first one is the
            longest, from the dock, through all rooms that are open. Empty: every patrol is the lap from the dock.
        doors: how long the door to a room stays open, and then shut; None leaves all doorways open. The sensor does
            not see through a shut door and the robot does not enter. Independent of `change_rate`.
        wing_opens_day: before this day a partition closes the eastern wing (the last room on either side and the
            corridor between them). Its objects live on unseen. 0: no closed wing.
    """

    days: int = 6
    sessions_per_day: int = 1
    patrol_s: float = 165.0
    change_rate: float = 1.0
    length_m: float = 28.0
    depth_m: float = 15.0
    corridor_m: float = 2.6
    rooms_per_side: int = 3
    first_day_unix_s: float = 1_704_067_200.0
    classes: tuple[ObjectClass, ...] = DEFAULT_CLASSES
    drive: DriveConfig = field(default_factory=DriveConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    sensor: SimulatedSensor = field(default_factory=SimulatedSensor)
    patrol_lengths_s: tuple[float, ...] = ()
    doors: tuple[Duration, Duration] | None = None
    wing_opens_day: int = 0

    @property
    def longest_patrol_s(self) -> float:
        """Return the length of the longest patrol."""
        return max(self.patrol_lengths_s, default=self.patrol_s)

    def check(self) -> None:
        """Raise `ConfigError` if a field is out of range or contradicts another."""
        bounds = {
            "days": (1, 3660), "sessions_per_day": (1, 48), "patrol_s": (5.0, 7200.0), "change_rate": (0.0, 100.0),
            "length_m": (12.0, 500.0), "depth_m": (13.0, 60.0), "corridor_m": (2.4, 6.0), "rooms_per_side": (1, 20),
            "first_day_unix_s": (0.0, 1e10), "wing_opens_day": (0, 3660),
        }  # fmt: skip
        _all_within(self, "", bounds)
        for row, length_s in enumerate(self.patrol_lengths_s):
            require_within(length_s, f"patrol_lengths_s[{row}]", 5.0, 7200.0)
        for name, duration in zip(("open", "shut"), self.doors or (), strict=False):
            duration.check(f"doors.{name}")
        for name in ("days", "sessions_per_day", "rooms_per_side", "wing_opens_day"):
            if int(getattr(self, name)) != getattr(self, name):
                raise ConfigError(f"is {getattr(self, name)}, not a whole number", field=name)
        if self.longest_patrol_s * self.sessions_per_day > 0.5 * 10 * 3600.0:
            raise ConfigError(
                "the patrols of one day fill more than half of the 10 working hours",
                field="patrol_s",
                hint="shorter patrols or fewer sessions_per_day",
            )
        if self.length_m / self.rooms_per_side < 7.0:
            raise ConfigError(
                f"{self.rooms_per_side} rooms along {self.length_m} m are too narrow",
                field="rooms_per_side",
                hint="at least 7 m a room",
            )
        if self.wing_opens_day and self.rooms_per_side < 2:
            raise ConfigError("a closed wing leaves no room", field="rooms_per_side", hint="at least 2")
        if (self.depth_m - self.corridor_m) / 2 < 5.0:
            raise ConfigError("leaves rooms of less than 5 m", field="corridor_m", hint="a narrower corridor")
        if not self.classes:
            raise ConfigError("is empty", field="classes", hint="at least one object class")
        names = [kind.name for kind in self.classes]
        if len(set(names)) != len(names):
            raise ConfigError("two classes share a name", field="classes", hint="unique names")
        for row, kind in enumerate(self.classes):
            kind.check(f"classes[{row}]")
        if not any(kind.count for kind in self.classes):
            raise ConfigError("no object in any class", field="classes", hint="a count above 0")
        busy_days = self.days * self.change_rate
        arrivals = sum(kind.arrivals_per_day * busy_days for kind in self.classes)
        stays = sum(kind.count * busy_days / kind.stay.mean_days for kind in self.classes if kind.stay is not None)
        if arrivals + stays > 20_000:
            raise ConfigError(
                f"about {arrivals + stays:.0f} changes would happen",
                field="change_rate",
                hint="a smaller one, fewer days",
            )
        self.drive.check("drive")
        self.odometry.check("odometry")
        self.sensor.check("sensor")


def require_within(value: object, name: str, low: float, high: float) -> None:
    """Raise `ConfigError` naming the field unless the value is a number within the bounds."""
    if (
        not isinstance(value, int | float | np.integer | np.floating) or not low <= value <= high
    ):  # nan fails the comparison
        raise ConfigError(f"is {value}, outside [{low:g}, {high:g}]", field=name, hint="a value in that range")


def _all_within(config: BuildingConfig | DriveConfig | OdometryConfig | SimulatedSensor, where: str,
                bounds: dict[str, tuple[float, float]]) -> None:  # fmt: skip
    known = {item.name for item in fields(config)}
    for name, (low, high) in bounds.items():
        assert name in known
        require_within(getattr(config, name), f"{where}.{name}" if where else name, low, high)
