"""Objects with landmarks all over them, passed again and again by a sensor in space (Bateman 2020, section 5.1.1).

The thesis' world: a periodic trajectory, objects whose landmarks face away from their centre, detection that fades with
range as `exp(-d / lambda)` and stops at a viewing angle, false alarms, and objects that vanish at a survival time. What
reality adds is here too, and off by default: somebody who passes hides a whole object for some frames, and the pose
that the filters are given is not the true one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from evermap.errors import ConfigError
from evermap.sensing.profile import Field
from evermap.types import BoolArray, FloatArray, IntArray
from evermap_studies.worlds.sensors import LIDAR, contains

HARMONICS = 3
"""Of the trajectory: enough to come by from several sides, few enough to be a path that something could drive."""
TRIES = 1000
"""Before a world is given up for which no place for an object can be found."""


@dataclass(frozen=True, slots=True)
class CliqueWorld:
    """The generative model; what the thesis states, and what it leaves open.

    Attributes:
        field: of the sensor.
        fading_m: detection probability of a landmark in view is `exp(-d / fading_m)` (lambda).
        viewing_angle_rad: largest angle between a landmark's normal and the direction to the sensor.
        p_false: probability that a landmark in the field that cannot be seen, or is gone, is reported all the same.
        objects: cliques in the world.
        semi_axis_m: smallest and largest semi-axis of the ellipsoids.
        landmarks: least and most on each.
        steps: length of a run.
        period: steps after which the trajectory repeats.
        mean_survival_steps: of the exponential survival time, from the first step in which the object is in the field.
        uniform_survival: draw it evenly from 0 to `steps` instead, as Rosen 2016 does (whom the thesis names).
        extent_m: root mean square distance of the trajectory from its middle, in the plane.
        distance_m: least and most distance of an object, as the sphere around it, from the trajectory; raising or
            lowering it by some 0.5 m comes on top.
        share_in_field: least share of a period in which an object's centre is in the field.
        occluded_share: share of the time that an object in the world is hidden.
        occluded_steps: mean number of steps for which it then stays hidden.
        pose_noise_m, pose_noise_rad: standard deviations of the pose that the filters get, per axis and step.
    """

    field: Field = LIDAR
    fading_m: float = 11.2
    viewing_angle_rad: float = math.radians(85.0)
    p_false: float = 0.005
    objects: int = 4
    semi_axis_m: tuple[float, float] = (0.5, 2.0)
    landmarks: tuple[int, int] = (15, 25)
    steps: int = 1000
    period: int = 200
    mean_survival_steps: float = 300.0
    uniform_survival: bool = False
    extent_m: float = 4.0
    distance_m: tuple[float, float] = (3.0, 5.0)
    share_in_field: float = 0.1
    occluded_share: float = 0.0
    occluded_steps: float = 5.0
    pose_noise_m: float = 0.0
    pose_noise_rad: float = 0.0

    def __post_init__(self) -> None:
        for name in ("fading_m", "viewing_angle_rad", "mean_survival_steps", "extent_m"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ConfigError(f"must be positive and finite, not {getattr(self, name)!r}", field=name)
        for name in ("pose_noise_m", "pose_noise_rad"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"must be finite and not negative, not {getattr(self, name)!r}", field=name)
        if self.viewing_angle_rad > math.pi:
            raise ConfigError(f"must be at most pi, not {self.viewing_angle_rad!r}", field="viewing_angle_rad")
        for name in ("p_false", "share_in_field"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ConfigError(f"must lie in [0, 1], not {getattr(self, name)!r}", field=name)
        if not 0.0 <= self.occluded_share < 1.0:
            raise ConfigError(f"must lie in [0, 1), not {self.occluded_share!r}", field="occluded_share")
        shortest = max(1.0, self.occluded_share / (1.0 - self.occluded_share))
        if not self.occluded_steps >= shortest:
            raise ConfigError(
                f"too short for that share: {self.occluded_steps!r}",
                field="occluded_steps",
                hint=f"at least {shortest:.3g}",
            )
        for name in ("objects", "steps", "period"):
            if getattr(self, name) < 1:
                raise ConfigError(f"must be positive, not {getattr(self, name)!r}", field=name)
        for name in ("semi_axis_m", "landmarks", "distance_m"):
            least, most = getattr(self, name)
            if not 0 < least <= most < math.inf:
                raise ConfigError(f"must be two positive numbers in order, not {(least, most)}", field=name)


@dataclass(frozen=True, slots=True)
class CliqueRun:
    """One run of F steps past C objects with K landmarks in all; the truth, and what filters may know.

    Attributes:
        world: what it was drawn from.
        position_m: (F, 3) of the sensor, true.
        rotation: (F, 3, 3) from the sensor's frame to the world's, true.
        pose_position_m, pose_rotation: the same, as the filters get them.
        landmark_m: (K, 3) in the world, sorted by clique.
        normal: (K, 3) unit vectors; filters don't get them.
        clique: (K,) which object each landmark is on.
        centre_m: (C, 3) of the objects.
        first: (C,) step at which each comes into the field for the first time: its birth.
        survival_steps: (C,) how long it stays after that; it is there up to and with `first + survival_steps`.
        hidden: (F, C) whether somebody stands before it.
        detected: (F, K).
    """

    world: CliqueWorld
    position_m: FloatArray
    rotation: FloatArray
    pose_position_m: FloatArray
    pose_rotation: FloatArray
    landmark_m: FloatArray
    normal: FloatArray
    clique: IntArray
    centre_m: FloatArray
    first: IntArray
    survival_steps: FloatArray
    hidden: BoolArray
    detected: BoolArray

    def there(self) -> BoolArray:
        """(F, C) whether each object exists."""
        step = np.arange(len(self.position_m))[:, None]
        return step <= self.first + self.survival_steps

    def expected(self) -> BoolArray:
        """(F, K) whether each landmark is in the field of the sensor, seen from the pose that the filters get."""
        seen = in_sensor_frame(self.landmark_m, self.pose_position_m, self.pose_rotation)
        return contains(self.world.field, seen)

    def p_detect(self) -> FloatArray:
        """(F, K) true probability that each landmark is detected while its object is there and nobody hides it."""
        in_field = contains(self.world.field, in_sensor_frame(self.landmark_m, self.position_m, self.rotation))
        return _chance_there(self.world, self.position_m, self.landmark_m, self.normal, in_field)


def in_sensor_frame(point_m: FloatArray, position_m: FloatArray, rotation: FloatArray) -> FloatArray:
    """(F, K, 3) points (K, 3) of the world in the frames of F sensor poses."""
    return np.asarray((point_m[None, :, :] - position_m[:, None, :]) @ rotation)


def simulate_cliques(world: CliqueWorld, seed: int | np.random.SeedSequence) -> CliqueRun:
    """Draw one run; the same seed gives the same run.

    Raises:
        ConfigError: no place for the objects can be found that the sensor passes by, or one never comes into the field.
    """
    rng = np.random.default_rng(seed)
    position, rotation = _trajectory(world, rng)
    centre, axes = _place(world, position, rotation, rng)
    count = rng.integers(world.landmarks[0], world.landmarks[1] + 1, world.objects)
    clique = np.repeat(np.arange(world.objects), count)
    direction = rng.normal(size=(len(clique), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    offset = direction * axes[clique]
    normal = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    landmark = centre[clique] + offset

    in_field = contains(world.field, in_sensor_frame(landmark, position, rotation))
    seen_at_all = np.stack([in_field[:, clique == c].any(axis=1) for c in range(world.objects)], axis=1)
    if not seen_at_all.any(axis=0).all():
        raise ConfigError(
            "an object never comes into the field", field="share_in_field", hint="a larger share, or more steps"
        )
    first = np.argmax(seen_at_all, axis=0)
    if world.uniform_survival:
        survival = rng.uniform(0.0, world.steps, world.objects)
    else:
        survival = rng.exponential(world.mean_survival_steps, world.objects)
    hidden = _occlusions(world, rng)

    there = np.arange(world.steps)[:, None] <= first + survival
    chance_there = _chance_there(world, position, landmark, normal, in_field)
    chance = np.where((there & ~hidden)[:, clique], chance_there, world.p_false * in_field)
    detected = rng.random(chance.shape) < chance

    given_position = position + world.pose_noise_m * rng.normal(size=position.shape)
    given_rotation = rotation @ _rotation(*(world.pose_noise_rad * rng.normal(size=(3, world.steps))))
    return CliqueRun(
        world=world,
        position_m=position,
        rotation=rotation,
        pose_position_m=given_position,
        pose_rotation=given_rotation,
        landmark_m=landmark,
        normal=normal,
        clique=clique,
        centre_m=centre,
        first=first,
        survival_steps=survival,
        hidden=hidden,
        detected=detected,
    )


def _chance_there(
    world: CliqueWorld, position: FloatArray, landmark: FloatArray, normal: FloatArray, in_field: BoolArray
) -> FloatArray:
    """(F, K) probability of a detection: fading with range where the landmark faces the sensor, 0 outside the field."""
    to_sensor = position[:, None, :] - landmark[None, :, :]
    distance = np.linalg.norm(to_sensor, axis=2)
    facing = np.einsum("fki,ki->fk", to_sensor, normal) >= math.cos(world.viewing_angle_rad) * distance
    return np.where(facing, np.exp(-distance / world.fading_m), world.p_false) * in_field


def _trajectory(world: CliqueWorld, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """(F, 3) positions and (F, 3, 3) rotations on a closed curve; the sensor looks where its own harmonics turn it."""
    phase = 2.0 * math.pi * np.arange(world.steps) / world.period
    position = np.stack([_harmonics(phase, rng) for _ in range(3)], axis=1)
    position *= world.extent_m / math.sqrt(2.0) * np.array([1.0, 1.0, 0.15])
    yaw = rng.uniform(-math.pi, math.pi) + rng.choice([-1.0, 1.0]) * phase + 0.7 * _harmonics(phase, rng)
    pitch, roll = (math.radians(6.0) * _harmonics(phase, rng) for _ in range(2))
    return position, _rotation(yaw, pitch, roll)


def _harmonics(phase: FloatArray, rng: np.random.Generator) -> FloatArray:
    """A periodic curve of unit variance, the higher harmonics weaker."""
    order = np.arange(1, HARMONICS + 1)
    a, b = rng.normal(size=(2, HARMONICS)) / order
    curve = np.sin(np.outer(phase, order)) @ a + np.cos(np.outer(phase, order)) @ b
    return np.asarray(curve / math.sqrt(0.5 * float(a @ a + b @ b)))


def _rotation(yaw: FloatArray, pitch: FloatArray, roll: FloatArray) -> FloatArray:
    """(F, 3, 3) rotation about z, then y, then x."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(angle), np.sin(angle)) for angle in (yaw, pitch, roll))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _place(
    world: CliqueWorld, position: FloatArray, rotation: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Centres and semi-axes of objects beside the trajectory, apart from each other, each in the field for a while."""
    lap = slice(0, min(world.period, world.steps))
    centres: list[FloatArray] = []
    sizes: list[FloatArray] = []
    for _ in range(TRIES):
        axes = rng.uniform(*world.semi_axis_m, 3)
        radius = float(axes.max())
        anchor = position[lap][rng.integers(len(position[lap]))]
        bearing = rng.uniform(-math.pi, math.pi)
        away = radius + rng.uniform(*world.distance_m)
        centre = anchor + away * np.array([math.cos(bearing), math.sin(bearing), 0.0])
        centre[2] += rng.normal() * 0.5
        if np.linalg.norm(position[lap] - centre, axis=1).min() < radius + world.distance_m[0]:
            continue
        others = zip(centres, sizes, strict=True)
        if any(np.linalg.norm(centre - other) < radius + float(size.max()) for other, size in others):
            continue
        seen = contains(world.field, in_sensor_frame(centre[None], position[lap], rotation[lap]))
        if seen.mean() < world.share_in_field:
            continue
        centres.append(centre)
        sizes.append(axes)
        if len(centres) == world.objects:
            return np.array(centres), np.array(sizes)
    raise ConfigError(
        f"only {len(centres)} of {world.objects} objects find a place beside the trajectory",
        field="objects",
        hint="fewer or smaller objects, or a larger extent_m",
    )


def _occlusions(world: CliqueWorld, rng: np.random.Generator) -> BoolArray:
    """(F, C) a two-state Markov chain for each object, in its long-run distribution from the first step on."""
    hidden = np.zeros((world.steps, world.objects), dtype=np.bool_)
    draw = rng.random((world.steps, world.objects))
    if world.occluded_share == 0.0:
        return hidden
    leave = 1.0 / world.occluded_steps
    enter = leave * world.occluded_share / (1.0 - world.occluded_share)
    hidden[0] = draw[0] < world.occluded_share
    for step in range(1, world.steps):
        hidden[step] = np.where(hidden[step - 1], draw[step] >= leave, draw[step] < enter)
    return hidden


def named_world(name: str, field: Field) -> CliqueWorld:
    """The thesis' world (`nominal`), the same with other lifetimes, or one that is harsher than the filters assume.

    Raises:
        ConfigError: no such world.
    """
    nominal = CliqueWorld(field=field)
    known = {
        "nominal": nominal,
        "uniform-lifetimes": replace(nominal, uniform_survival=True),
        "angle60": replace(nominal, viewing_angle_rad=math.radians(60.0)),
        "range04": replace(nominal, fading_m=0.4 * field.range_max_m),
        "occlusion": replace(nominal, occluded_share=0.15, occluded_steps=5.0),
        "false-alarms": replace(nominal, p_false=0.03),
        "pose-noise": replace(nominal, pose_noise_m=0.1, pose_noise_rad=math.radians(2.0)),
    }
    if name not in known:
        raise ConfigError(f"there is no world {name!r}", field="world", hint=", ".join(known))
    return known[name]
