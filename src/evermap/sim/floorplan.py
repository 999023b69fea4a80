"""The building's walls: rooms on both sides of a corridor, a doorway in each, and what can be seen through them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from evermap.sim.config import BuildingConfig
from evermap.types import BoolArray, FloatArray

DOORWAY_M: float = 1.5
ROOM_INSET_M: float = 2.0
"""The robot's loop through a room keeps this distance from its side walls."""


@dataclass(frozen=True, slots=True)
class Room:
    """An axis-aligned room.

    Attributes:
        name: e.g. 'south 1'.
        low_m, high_m: corners (x, y) of smallest and largest coordinates.
        doorway_x_m: middle of its doorway, in the wall to the corridor.
        north: whether it lies north of the corridor.
    """

    name: str
    low_m: tuple[float, float]
    high_m: tuple[float, float]
    doorway_x_m: float
    north: bool

    def contains(self, point_m: FloatArray) -> BoolArray:
        """(...,) whether points (..., 2) are inside."""
        inside = (point_m >= np.asarray(self.low_m)) & (point_m <= np.asarray(self.high_m))
        return np.asarray(np.all(inside, axis=-1))


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Walls and rooms, in metres, origin at the building's south-west corner.

    Attributes:
        walls_m: (W, 2, 2) wall segments, from point to point; opaque to the sensor.
        rooms: south rooms from west to east, then north rooms from west to east.
        length_m, depth_m: outer size.
        corridor_y_m: southern and northern wall of the corridor.
        wing_x_m: where the eastern wing begins, inf where there is none.
    """

    walls_m: FloatArray
    rooms: tuple[Room, ...]
    length_m: float
    depth_m: float
    corridor_y_m: tuple[float, float]
    wing_x_m: float = math.inf

    @property
    def wing(self) -> tuple[int, ...]:
        """Rows of the rooms in the eastern wing."""
        return tuple(row for row, room in enumerate(self.rooms) if room.low_m[0] >= self.wing_x_m)

    def shut(self, rooms: Iterable[int], *, wing: bool) -> Self:
        """The plan with walls in the doorways of these rooms (rows), and across the corridor where the wing begins."""
        south_y, north_y = self.corridor_y_m
        walls = [self.walls_m]
        for room in (self.rooms[row] for row in rooms):
            y, half = north_y if room.north else south_y, DOORWAY_M / 2
            walls.append(np.array([[[room.doorway_x_m - half, y], [room.doorway_x_m + half, y]]]))
        if wing:
            walls.append(np.array([[[self.wing_x_m, south_y], [self.wing_x_m, north_y]]]))
        return replace(self, walls_m=np.concatenate(walls))

    def room_of(self, point_m: FloatArray) -> int:
        """Row of the room that holds the point (2,), -1 in the corridor and outside."""
        for row, room in enumerate(self.rooms):
            if room.contains(point_m):
                return row
        return -1

    def line_of_sight(self, start_m: FloatArray, end_m: FloatArray) -> BoolArray:
        """(P,) whether no wall crosses the straight line from `start_m` to `end_m`, both (P, 2)."""
        ray = (end_m - start_m)[:, None, :]  # (P, 1, 2)
        origin = self.walls_m[None, :, 0]  # (1, W, 2)
        wall = self.walls_m[None, :, 1] - origin
        offset = origin - start_m[:, None, :]
        # start + s ray = origin + u wall; both parameters in [0, 1] where they cross. Parallel lines never do here:
        # nothing stands inside a wall.
        cross = _cross(ray, wall)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = _cross(offset, wall) / cross
            u = _cross(offset, ray) / cross
        hit = (s >= 0.0) & (s <= 1.0) & (u >= 0.0) & (u <= 1.0)
        return np.asarray(~hit.any(axis=1))


def draw_floor_plan(config: BuildingConfig, rng: np.random.Generator) -> FloorPlan:
    """A building of the configured size; where walls and doorways stand within it is random."""
    south_y = (config.depth_m - config.corridor_m) / 2
    north_y = south_y + config.corridor_m
    length, depth, count = config.length_m, config.depth_m, config.rooms_per_side
    rooms: list[Room] = []
    walls: list[tuple[tuple[float, float], tuple[float, float]]] = [
        ((0.0, 0.0), (length, 0.0)),
        ((length, 0.0), (length, depth)),
        ((length, depth), (0.0, depth)),
        ((0.0, depth), (0.0, 0.0)),
    ]
    spare_m = length / count - 6.5  # rooms stay at least 6.5 m wide
    wing_x = math.inf
    for north in (False, True):
        y_low, y_high = (north_y, depth) if north else (0.0, south_y)
        corridor_y = north_y if north else south_y
        edges = np.linspace(0.0, length, count + 1)
        edges[1:-1] += rng.uniform(-0.35, 0.35, count - 1) * spare_m
        if config.wing_opens_day:  # the partition stands where the last rooms of both sides begin
            wing_x = edges[-2] = wing_x if north else float(edges[-2])
        wall_start = 0.0
        for row in range(count):
            x_low, x_high = float(edges[row]), float(edges[row + 1])
            margin = ROOM_INSET_M + 0.3 * (x_high - x_low - 2 * ROOM_INSET_M)
            doorway = float(rng.uniform(x_low + margin, x_high - margin))
            name = f"{'north' if north else 'south'} {row + 1}"
            rooms.append(Room(name, (x_low, y_low), (x_high, y_high), doorway, north))
            walls.append(((wall_start, corridor_y), (doorway - DOORWAY_M / 2, corridor_y)))
            wall_start = doorway + DOORWAY_M / 2
            if row:
                walls.append(((x_low, y_low), (x_low, y_high)))
        walls.append(((wall_start, corridor_y), (length, corridor_y)))
    return FloorPlan(
        walls_m=np.array(walls, dtype=np.float64),
        rooms=tuple(rooms),
        length_m=length,
        depth_m=depth,
        corridor_y_m=(south_y, north_y),
        wing_x_m=wing_x,
    )


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
