"""Objects that park, cross, orbit and drive off, seen by a sensor of limited radius (Bateman 2020, section 5.2).

The thesis' simulation: classes of objects follow acceleration curves of their own, and what comes within some radius of
the sensor is observed with Gaussian noise. There the sensor is the mouse; here it drives a closed curve. What reality
adds is here too: objects are missed, things are reported where nothing is, and classes are confused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from evermap.errors import ConfigError
from evermap.survival import LifetimePrior, Weibull
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray

TRIES = 1000
"""Before a place for an object is given up."""


class Behaviour(StrEnum):
    """What the objects of a class do."""

    PARKED = "parked"
    """They stay where they are from beginning to end."""
    CROSSING = "crossing"
    """They cross the world in a straight line at constant velocity, each at its own time."""
    ORBITING = "orbiting"
    """They go round in circles at constant speed: what a filter of constant acceleration does not foresee."""
    LEAVING = "leaving"
    """They drive in, park for a lifetime, and drive off, with constant acceleration up to their speed."""


@dataclass(frozen=True, slots=True)
class MovingClass:
    """A class of objects.

    Attributes:
        name: of the class.
        behaviour: of all its objects.
        count: how many there are in a run.
        speed_mps: least and most speed while they move.
        lifetime: for how long they park, if they leave.
    """

    name: str
    behaviour: Behaviour
    count: int
    speed_mps: tuple[float, float] = (1.0, 3.0)
    lifetime: LifetimePrior | None = None

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ConfigError(f"class '{self.name}' needs objects, not {self.count}", field="count")
        if not 0.0 < self.speed_mps[0] <= self.speed_mps[1] < math.inf:
            raise ConfigError(f"must be two positive numbers in order, not {self.speed_mps}", field="speed_mps")
        if (self.behaviour is Behaviour.LEAVING) != (self.lifetime is not None):
            problem = f"class '{self.name}' is {self.behaviour.value}"
            raise ConfigError(problem, field="lifetime", hint="a lifetime for those that leave, and for no others")


CLASSES = (
    MovingClass("pallet", Behaviour.PARKED, 40),
    MovingClass("person", Behaviour.CROSSING, 60, (0.8, 1.8)),
    MovingClass("sweeper", Behaviour.ORBITING, 8, (0.8, 1.5)),
    MovingClass("forklift", Behaviour.LEAVING, 60, (1.5, 3.0), Weibull(scale_s=60.0, shape=2.0)),
    MovingClass("trolley", Behaviour.LEAVING, 60, (1.0, 2.0), Weibull(scale_s=200.0, shape=1.0)),
)
"""A hall with things that stay, people who pass, machines that go round, and vehicles that park for a while."""


@dataclass(frozen=True, slots=True)
class MovingWorld:
    """The generative model; what the thesis states, and what it leaves open.

    Attributes:
        classes: of objects.
        duration_s: length of a run.
        frame_s: time between two frames.
        half_extent_m: places and paths are in the square of twice this side.
        spacing_m: least distance between the places of objects that park or orbit.
        orbit_m: least and most radius of an orbit.
        acceleration_mps2: of those that drive in and off.
        reach_m: radius around the sensor in which it sees.
        sensor_period_s: after which the sensor's x and its y repeat; it keeps within 0.8 of the half extent.
        sigma_m: standard deviation of a detection, each axis.
        p_detect: probability that an object in reach is detected.
        false_per_frame: mean number of detections of nothing, evenly in the sensor's reach, 0.5 m up and down.
        p_off_class: probability that a detection has one of the other classes.
    """

    classes: tuple[MovingClass, ...] = CLASSES
    duration_s: float = 600.0
    frame_s: float = 0.1
    half_extent_m: float = 60.0
    spacing_m: float = 3.0
    orbit_m: tuple[float, float] = (2.0, 5.0)
    acceleration_mps2: float = 1.0
    reach_m: float = 25.0
    sensor_period_s: tuple[float, float] = (180.0, 127.0)
    sigma_m: float = 0.1
    p_detect: float = 0.9
    false_per_frame: float = 0.2
    p_off_class: float = 0.02

    def __post_init__(self) -> None:
        for name in ("duration_s", "frame_s", "half_extent_m", "acceleration_mps2", "reach_m", "sigma_m"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ConfigError(f"must be positive and finite, not {getattr(self, name)!r}", field=name)
        for name in ("spacing_m", "false_per_frame"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"must be finite and not negative, not {getattr(self, name)!r}", field=name)
        for name in ("p_detect", "p_off_class"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(f"must lie in [0, 1], not {getattr(self, name)!r}", field=name)
        for name in ("sensor_period_s", "orbit_m"):
            if not min(getattr(self, name)) > 0.0:
                raise ConfigError(f"must be positive, not {getattr(self, name)}", field=name)
        if not self.orbit_m[0] <= self.orbit_m[1] < math.inf:
            raise ConfigError(f"must be two numbers in order, not {self.orbit_m}", field="orbit_m")
        if not self.classes:
            raise ConfigError("no classes", field="classes", hint="at least one")


@dataclass(frozen=True, slots=True)
class MovingRun:
    """One run of F frames with N objects and M detections; the truth, and what a tracker may know.

    Attributes:
        world: what it was drawn from.
        stamp_s: (F,).
        sensor_m: (F, 3) where the sensor is.
        class_id: (N,) rows of `world.classes`.
        position_m: (F, N, 3) where each object is, or would be.
        present: (F, N) whether it is in the world.
        static: (F, N) whether it is present and stands still.
        rest_from_s, rest_until_s: (N,) when each comes to rest and when it leaves; -inf and inf for those that park
            for ever, nan for those that never rest.
        first: (F + 1,) detections `first[k]` to `first[k + 1]` are those of frame k, in random order.
        detected_m: (M, 3).
        detected_class: (M,) as the detector has it.
        detected_of: (M,) which object it is, `UNKNOWN` for none; trackers don't get it.
    """

    world: MovingWorld
    stamp_s: FloatArray
    sensor_m: FloatArray
    class_id: IntArray
    position_m: FloatArray
    present: BoolArray
    static: BoolArray
    rest_from_s: FloatArray
    rest_until_s: FloatArray
    first: IntArray
    detected_m: FloatArray
    detected_class: IntArray
    detected_of: IntArray

    def detections(self, frame: int) -> slice:
        """Which detections are those of a frame."""
        return slice(int(self.first[frame]), int(self.first[frame + 1]))

    def in_reach(self) -> BoolArray:
        """(F, N) whether each object is present and within the sensor's radius."""
        return self.present & (_distance(self.position_m, self.sensor_m) <= self.world.reach_m)


def simulate_moving(world: MovingWorld, seed: int | np.random.SeedSequence) -> MovingRun:
    """Draw one run; the same seed gives the same run.

    Raises:
        ConfigError: there are not enough places for the objects.
    """
    rng = np.random.default_rng(seed)
    class_id = np.repeat(np.arange(len(world.classes)), [one.count for one in world.classes])
    stamp = world.frame_s * np.arange(round(world.duration_s / world.frame_s), dtype=np.float64)
    place = _places(world, class_id, rng)
    heading = rng.uniform(-math.pi, math.pi, len(class_id))
    speed = rng.uniform(*np.array([world.classes[c].speed_mps for c in class_id]).T)
    birth = rng.uniform(0.0, world.duration_s, len(class_id))
    stay = np.array([_lifetime(world.classes[c], rng) for c in class_id])
    behaviour = np.array([world.classes[c].behaviour.value for c in class_id])
    parked, leaving = behaviour == Behaviour.PARKED, behaviour == Behaviour.LEAVING
    rest_from = np.where(parked, -math.inf, np.where(leaving, birth, math.nan))
    rest_until = np.where(parked, math.inf, np.where(leaving, birth + stay, math.nan))

    position = _move(world, behaviour, stamp, place, heading, speed, birth, rest_until, rng)
    at_rest = (stamp[:, None] >= rest_from) & (stamp[:, None] <= rest_until)
    present = np.all(np.abs(position[:, :, :2]) <= world.half_extent_m, axis=2)
    sensor = _sensor_path(world, stamp)
    seen = present & (_distance(position, sensor) <= world.reach_m) & (rng.random(present.shape) < world.p_detect)
    first, detected, detected_class, of = _detect(world, sensor, class_id, position, seen, rng)
    return MovingRun(
        world=world,
        stamp_s=stamp,
        sensor_m=sensor,
        class_id=class_id,
        position_m=position,
        present=present,
        static=at_rest,
        rest_from_s=rest_from,
        rest_until_s=rest_until,
        first=first,
        detected_m=detected,
        detected_class=detected_class,
        detected_of=of,
    )


def _distance(position: FloatArray, sensor: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(position - sensor[:, None], axis=2))


def _lifetime(one: MovingClass, rng: np.random.Generator) -> float:
    return math.nan if one.lifetime is None else float(one.lifetime.sample(rng))


def _sensor_path(world: MovingWorld, stamp: FloatArray) -> FloatArray:
    """(F, 3) a curve of Lissajous: with periods that have no small common multiple it comes by everywhere."""
    phase = 2.0 * math.pi * stamp[:, None] / np.array(world.sensor_period_s)
    return np.column_stack([0.8 * world.half_extent_m * np.sin(phase), np.zeros(len(stamp))])


def _places(world: MovingWorld, class_id: IntArray, rng: np.random.Generator) -> FloatArray:
    """(N, 3) a point for each object; those at which somebody stays keep their distance from each other."""
    place = np.zeros((len(class_id), 3))
    taken: list[FloatArray] = []
    for k, c in enumerate(class_id):
        for _ in range(TRIES):
            place[k, :2] = rng.uniform(-0.9, 0.9, 2) * world.half_extent_m
            if world.classes[c].behaviour is Behaviour.CROSSING:
                break
            if not taken or np.linalg.norm(np.array(taken) - place[k], axis=1).min() >= world.spacing_m:
                taken.append(place[k].copy())
                break
        else:
            raise ConfigError(
                f"no place for object {k} of {len(class_id)}",
                field="spacing_m",
                hint="a smaller distance, fewer objects, or a larger half_extent_m",
            )
    return place


def _move(
    world: MovingWorld,
    behaviour: NDArray[np.str_],
    stamp: FloatArray,
    place: FloatArray,
    heading: FloatArray,
    speed: FloatArray,
    birth: FloatArray,
    leave: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """(F, N, 3) positions: all motions are closed forms of time."""
    along = np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(heading))])
    position = np.repeat(place[None], len(stamp), axis=0)
    crossing = behaviour == Behaviour.CROSSING
    way = speed[crossing] * (stamp[:, None] - birth[crossing])
    position[:, crossing] += way[:, :, None] * along[crossing]

    orbiting = np.flatnonzero(behaviour == Behaviour.ORBITING)
    radius = rng.uniform(*world.orbit_m, len(orbiting))
    angle = heading[orbiting] + speed[orbiting] / radius * stamp[:, None]
    position[:, orbiting] += radius[:, None] * np.stack([np.cos(angle), np.sin(angle), np.zeros(angle.shape)], axis=2)

    leaving = behaviour == Behaviour.LEAVING
    before = _run_up(birth[leaving] - stamp[:, None], speed[leaving], world.acceleration_mps2)
    after = _run_up(stamp[:, None] - leave[leaving], speed[leaving], world.acceleration_mps2)
    out_again = np.roll(along[leaving, :2], 1, axis=1) * [-1.0, 1.0]  # drives off to the left of where it came in
    position[:, leaving] -= before[:, :, None] * along[leaving]
    position[:, leaving, :2] += after[:, :, None] * out_again
    return position


def _run_up(time_s: FloatArray, speed: FloatArray, acceleration: float) -> FloatArray:
    """Way [m] after a start at 0, with constant acceleration up to the speed."""
    time_s = np.maximum(time_s, 0.0)
    ramp = np.minimum(time_s, speed / acceleration)
    return np.asarray(0.5 * acceleration * ramp**2 + speed * (time_s - ramp))


def _detect(
    world: MovingWorld,
    sensor: FloatArray,
    class_id: IntArray,
    position: FloatArray,
    seen: BoolArray,
    rng: np.random.Generator,
) -> tuple[IntArray, FloatArray, IntArray, IntArray]:
    """Detections of all frames, one after the other: where each frame's begin, positions, classes, objects."""
    frame, of = np.nonzero(seen)
    point = position[frame, of] + world.sigma_m * rng.normal(size=(len(of), 3))
    n_classes = len(world.classes)
    off = rng.integers(1, max(n_classes, 2), len(of))  # how far on in the circle of classes
    wrong = (rng.random(len(of)) < world.p_off_class) & (n_classes > 1)
    shown = np.where(wrong, (class_id[of] + off) % n_classes, class_id[of])

    false_frame = np.repeat(np.arange(len(sensor)), rng.poisson(world.false_per_frame, len(sensor)))
    bearing = rng.uniform(-math.pi, math.pi, len(false_frame))
    away = world.reach_m * np.sqrt(rng.random(len(false_frame)))
    height = rng.uniform(-0.5, 0.5, len(false_frame))
    false = sensor[false_frame] + np.column_stack([away * np.cos(bearing), away * np.sin(bearing), height])

    frame = np.concatenate([frame, false_frame])
    order = np.lexsort((rng.random(len(frame)), frame))
    point = np.concatenate([point, false])[order]
    shown = np.concatenate([shown, rng.integers(0, n_classes, len(false_frame))])[order]
    of = np.concatenate([of, np.full(len(false_frame), UNKNOWN)])[order]
    return np.searchsorted(frame[order], np.arange(len(sensor) + 1)), point, shown, of
