"""Places with landmarks, and the ways that robots take through them; layouts differ from seed to seed.

A landmark is a pose in space: a tag has x to its right, y up and z out of it; points have no orientation of theirs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from evermap.geometry import se3
from evermap.types import FloatArray, IntArray

TAG_M = 0.1651
"""Edge of the tags of a field."""
LARGE_M = 0.2667
"""Edge of the second kind of tags, where there are two."""


@dataclass(frozen=True, slots=True)
class Site:
    """A place and the way through it.

    Attributes:
        landmark_id: (L,) from 1 on.
        pose: (L, 7) of the landmarks in the world.
        size_m: (L,) edges of tags.
        waypoint: (W, 2) corners of a closed way.
    """

    landmark_id: IntArray
    pose: FloatArray
    size_m: FloatArray
    waypoint: FloatArray


def standing(position: FloatArray, facing_rad: FloatArray) -> FloatArray:
    """Return poses (L, 7) of upright tags at (L, 3) whose outward directions have the headings (L,)."""
    upright = se3.turn([0.5, 0.5, 0.5, 0.5])  # z out of the tag along x of the world, y up
    turned = se3.compose(se3.from_angles(np.column_stack([np.zeros((len(facing_rad), 2)), facing_rad])), upright)
    return np.concatenate([position, turned[:, 3:]], axis=1)


def _points(position: FloatArray) -> FloatArray:
    return np.concatenate([position, np.tile(se3.NO_TURN, (len(position), 1))], axis=1)


def _ellipse(
    rng: np.random.Generator, centre: tuple[float, float], axes: tuple[float, float], count: int
) -> FloatArray:
    """(W, 2) waypoints around a centre, each somewhat off an ellipse."""
    angle = np.linspace(0.0, 2 * math.pi, count, endpoint=False) + rng.uniform(0.0, 2 * math.pi)
    reach = rng.uniform(0.6, 1.0, count)
    ring = reach[:, None] * np.array(axes) * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(np.array(centre) + ring)


def field(rng: np.random.Generator) -> Site:
    """A field of 15 x 8 m with ten to twelve tags on its walls and eight on two posts, of one size."""
    long_m, wide_m = 15.0, 8.0
    places, facing = [], []
    for wall_x, heading in ((0.0, 0.0), (long_m, math.pi)):
        for y in np.linspace(1.2, wide_m - 1.2, int(rng.integers(2, 4))):
            places.append((wall_x, y + rng.uniform(-0.4, 0.4), rng.uniform(0.6, 1.6)))
            facing.append(heading + rng.uniform(-0.3, 0.3))
    for wall_y, heading in ((0.0, math.pi / 2), (wide_m, -math.pi / 2)):
        for x in np.linspace(2.0, long_m - 2.0, 3):
            places.append((x + rng.uniform(-0.8, 0.8), wall_y, rng.uniform(0.6, 1.6)))
            facing.append(heading)
    for post_x in (4.6, long_m - 4.6):
        first = rng.uniform(0.0, math.pi / 2)
        for side in first + np.arange(4) * math.pi / 2:
            places.append((post_x + 0.4 * math.cos(side), wide_m / 2 + 0.4 * math.sin(side), rng.uniform(0.3, 1.2)))
            facing.append(side)
    pose = standing(np.array(places), np.array(facing))
    ring = _ellipse(rng, (long_m / 2, wide_m / 2), (6.6, 3.2), 9)
    return Site(np.arange(1, len(pose) + 1), pose, np.full(len(pose), TAG_M), ring)


def two_kinds(rng: np.random.Generator) -> Site:
    """A field whose tags on walls are of one size and those on posts of another."""
    site = field(rng)
    size = site.size_m.copy()
    size[-8:] = LARGE_M
    return Site(site.landmark_id, site.pose, size, site.waypoint)


def warehouse(rng: np.random.Generator) -> Site:
    """A warehouse of 30 x 20 m with reflectors at the ends of shelves and on the walls."""
    x, y = np.meshgrid(np.linspace(4.0, 26.0, 5), np.linspace(4.0, 16.0, 3))
    shelf = np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-0.9, 0.9, (x.size, 2))
    along = rng.uniform(0.0, 100.0, 11)
    wall = np.array([_on_walls(one, 30.0, 20.0) for one in along])
    place = np.concatenate([shelf, wall])
    ring = _ellipse(rng, (15.0, 10.0), (12.0, 8.0), 9)
    pose = _points(np.column_stack([place, np.zeros(len(place))]))
    return Site(np.arange(1, len(place) + 1), pose, np.full(len(place), np.nan), ring)


def _on_walls(along_m: float, long_m: float, wide_m: float) -> tuple[float, float]:
    for length, start, step in (
        (long_m, (0.0, 0.0), (1.0, 0.0)),
        (wide_m, (long_m, 0.0), (0.0, 1.0)),
        (long_m, (long_m, wide_m), (-1.0, 0.0)),
        (wide_m, (0.0, wide_m), (0.0, -1.0)),
    ):
        if along_m < length:
            return start[0] + along_m * step[0], start[1] + along_m * step[1]
        along_m -= length
    return 0.0, 0.0


def orchard(rng: np.random.Generator) -> Site:
    """Four rows of fifteen trees, 2.2 m apart along the rows; the robot drives down one lane and back the next."""
    x, y = np.meshgrid(2.2 * np.arange(15), 3.6 * np.arange(4))
    tree = np.column_stack([x.ravel(), y.ravel()]) + rng.normal(0.0, 0.08, (x.size, 2))
    far = 2.2 * 14
    lane = [(-2.0, 1.8), (far / 2, 1.8), (far + 2.0, 1.8), (far + 2.6, 5.4), (far + 2.0, 9.0), (far / 2, 9.0),
            (-2.0, 9.0), (-2.6, 5.4)]  # fmt: skip
    pose = _points(np.column_stack([tree, np.zeros(len(tree))]))
    return Site(np.arange(1, len(tree) + 1), pose, np.full(len(tree), np.nan), np.array(lane))


def anchored_room(rng: np.random.Generator) -> Site:
    """A hall of 22 x 14 m with six to eight anchors on its walls, and the way of a lawn mower."""
    count = int(rng.integers(6, 9))
    along = (np.arange(count) + rng.uniform(-0.3, 0.3, count)) * 72.0 / count
    place = np.array([_on_walls(float(one) % 72.0, 22.0, 14.0) for one in along])
    way = []
    for lane, y in enumerate(np.linspace(2.5, 11.5, 4)):
        ends = (3.0, 19.0) if lane % 2 == 0 else (19.0, 3.0)
        way += [(ends[0], y), (11.0, y + rng.uniform(-0.4, 0.4)), (ends[1], y)]
    pose = _points(np.column_stack([place, np.zeros(count)]))
    return Site(np.arange(1, count + 1), pose, np.full(count, np.nan), np.array(way))


def anchors_behind(rng: np.random.Generator) -> Site:
    """The same hall with six anchors at one end, which the robot leaves."""
    place = rng.uniform(-0.4, 0.4, (6, 2)) + [(0.0, 2.0), (0.0, 12.0), (3.0, 0.0), (3.0, 14.0), (7.0, 0.0), (7.0, 14.0)]
    pose = _points(np.column_stack([place, np.zeros(6)]))
    return Site(np.arange(1, 7), pose, np.full(6, np.nan), anchored_room(rng).waypoint)


def lounge(rng: np.random.Generator) -> Site:
    """A room of 8 x 7 m with marked points on its walls, for a rig that is carried."""
    count = 32
    place = np.array([_on_walls(float(one), 8.0, 7.0) for one in np.linspace(0.0, 29.9, count)])
    place = np.column_stack([place, rng.uniform(0.4, 2.2, count)])
    ring = _ellipse(rng, (4.0, 3.5), (2.2, 1.9), 7)
    return Site(np.arange(1, count + 1), _points(place), np.full(count, np.nan), ring)


def tagged_room(rng: np.random.Generator) -> Site:
    """A room of 8 x 7 m with 26 tags on its walls, for a camera that is carried."""
    along = (np.arange(26) + rng.uniform(-0.2, 0.2, 26)) * 30.0 / 26
    place = np.array([_on_walls(float(one) % 30.0, 8.0, 7.0) for one in along])
    facing = np.arctan2(3.5 - place[:, 1], 4.0 - place[:, 0])
    facing = np.round(facing / (math.pi / 2)) * (math.pi / 2) + rng.uniform(-0.2, 0.2, 26)
    pose = standing(np.column_stack([place, rng.uniform(0.6, 2.0, 26)]), facing)
    ring = _ellipse(rng, (4.0, 3.5), (2.0, 1.6), 7)
    return Site(np.arange(1, 27), pose, np.full(26, TAG_M), ring)


def racks(rng: np.random.Generator) -> Site:
    """A hall with five racks of 30 m, fifty tags on either side of each; the way is through two of the lanes."""
    place, facing = [], []
    for rack in range(5):
        for side in (-1.0, 1.0):
            along = 0.6 * np.arange(50) + rng.uniform(-0.15, 0.15, 50)
            across = np.full(50, 5.0 * rack + 0.4 * side)
            place.append(np.column_stack([along, across, rng.uniform(0.4, 2.2, 50)]))
            facing.append(side * math.pi / 2 + rng.uniform(-0.1, 0.1, 50))
    pose = standing(np.concatenate(place), np.concatenate(facing))
    way = [(0.0, 7.5), (10.0, 7.8), (20.0, 7.2), (30.0, 7.5), (33.0, 10.0), (30.0, 12.5), (20.0, 12.8), (10.0, 12.2),
           (0.0, 12.5), (-3.0, 10.0)]  # fmt: skip
    return Site(np.arange(1, 501), pose, np.full(500, TAG_M), np.array(way))


def reflectors(rng: np.random.Generator) -> Site:
    """The same hall with a reflector at the place of every tag, at the height of the laser."""
    site = racks(rng)
    place = site.pose[:, :3] * [1.0, 1.0, 0.0]
    return Site(site.landmark_id, _points(place), np.full(len(place), np.nan), site.waypoint)


SITES: dict[str, Callable[[np.random.Generator], Site]] = {
    "field": field,
    "two kinds": two_kinds,
    "warehouse": warehouse,
    "orchard": orchard,
    "anchors": anchored_room,
    "anchors behind": anchors_behind,
    "lounge": lounge,
    "tagged room": tagged_room,
    "racks": racks,
    "reflectors": reflectors,
}
