"""The kinds of objects in a building: how many, how the sensor sees them, and how long they stay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from evermap.errors import ConfigError

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
        """One duration in seconds."""
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


def require_within(value: object, name: str, low: float, high: float) -> None:
    """Raise `ConfigError` naming the field unless the value is a number within the bounds."""
    if (
        not isinstance(value, int | float | np.integer | np.floating) or not low <= value <= high
    ):  # nan fails the comparison
        raise ConfigError(f"is {value}, outside [{low:g}, {high:g}]", field=name, hint="a value in that range")
