"""The building: rooms on both sides of a corridor, what can be seen through their doorways, and what stands in them.

Objects carry landmarks. They stand clear of walls, of the robot's route and of each other, and do not block the
sensor's view; walls do.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from evermap.errors import ConfigError
from evermap.geometry import se2
from evermap.types import BoolArray, FloatArray
from evermap_studies.sim.config import BuildingConfig, ObjectClass

DOORWAY_M: float = 1.5
ROOM_INSET_M: float = 2.0
"""The robot's loop through a room keeps this distance from its side walls."""
ROUTE_CLEARANCE_M: float = 0.6
"""Robot radius, scatter of the route and margin: footprints stay this far from the nominal route."""
WALL_GAP_M: float = 0.06
CELL_M: float = 0.1
CANDIDATES: int = 200


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
        """Return (...,) whether points (..., 2) are inside."""
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
        """Return the rows of the rooms in the eastern wing."""
        return tuple(row for row, room in enumerate(self.rooms) if room.low_m[0] >= self.wing_x_m)

    def shut(self, rooms: Iterable[int], *, wing: bool) -> Self:
        """Add walls in the doorways of these rooms (rows), and across the corridor where the wing begins."""
        south_y, north_y = self.corridor_y_m
        walls = [self.walls_m]
        for room in (self.rooms[row] for row in rooms):
            y, half = north_y if room.north else south_y, DOORWAY_M / 2
            walls.append(np.array([[[room.doorway_x_m - half, y], [room.doorway_x_m + half, y]]]))
        if wing:
            walls.append(np.array([[[self.wing_x_m, south_y], [self.wing_x_m, north_y]]]))
        return replace(self, walls_m=np.concatenate(walls))

    def room_of(self, point_m: FloatArray) -> int:
        """Return the row of the room that holds the point (2,), -1 in the corridor and outside."""
        for row, room in enumerate(self.rooms):
            if room.contains(point_m):
                return row
        return -1

    def line_of_sight(self, start_m: FloatArray, end_m: FloatArray) -> BoolArray:
        """Return (P,) whether no wall crosses the straight line from `start_m` to `end_m`, both (P, 2)."""
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
    """Draw a building of the configured size; where walls and doorways stand within it is random."""
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


@dataclass(frozen=True, slots=True)
class SceneObject:
    """A rigid body with landmarks: a clique.

    Attributes:
        object_id: unique, from 0.
        kind: its class.
        class_id: row of the class in the configuration.
        landmark_ids: one to four ids, unique over the building and stable over time.
        offset_m: (k, 2) their positions in the object's frame.
        home: pose (x, y, theta) in the world on day 0 (or on arrival); of a door, closed.
        open_turn_rad: how far a door turns from closed to open; 0 for all others.
    """

    object_id: int
    kind: ObjectClass
    class_id: int
    landmark_ids: tuple[int, ...]
    offset_m: FloatArray
    home: tuple[float, float, float]
    open_turn_rad: float = 0.0

    @property
    def radius_m(self) -> float:
        """Return the radius of the circle about the origin that holds the footprint (a door's leaf swings)."""
        if self.kind.mount == "hinge":
            return self.kind.size_m[0]
        return math.hypot(*self.kind.size_m) / 2

    def landmarks_at(self, pose: tuple[float, float, float]) -> FloatArray:
        """Return the positions (k, 2) of its landmarks when it stands at a pose."""
        return se2.transform(np.array(pose), self.offset_m)


class Circles:
    """Circles on the floor that are taken."""

    def __init__(self) -> None:
        self._position: list[tuple[float, float]] = []
        self._radius: list[float] = []

    def add(self, pose: tuple[float, float, float], radius_m: float) -> None:
        """Take the circle around a pose."""
        self._position.append(pose[:2])
        self._radius.append(radius_m)

    def __call__(self, position_m: FloatArray, radius_m: float) -> BoolArray:
        """(P,) whether a circle around each position (P, 2) overlaps one that is taken."""
        if not self._position:
            return np.zeros(len(position_m), dtype=np.bool_)
        gap = np.linalg.norm(position_m[:, None] - np.array(self._position)[None], axis=-1)
        return np.asarray((gap < radius_m + np.array(self._radius)).any(axis=1))


class Placer:
    """Finds places for objects in a building.

    Args:
        plan: walls and rooms.
        route_m: (N, 2) nominal route of the robot, kept clear.
    """

    def __init__(self, plan: FloorPlan, route_m: FloatArray) -> None:
        self.plan = plan
        # cells of the floor that the route's clearance touches: painted once, looked up for every candidate
        span = np.arange(-math.ceil(ROUTE_CLEARANCE_M / CELL_M) - 1, math.ceil(ROUTE_CLEARANCE_M / CELL_M) + 2)
        disc = np.stack(np.meshgrid(span, span), axis=-1).reshape(-1, 2)
        disc = disc[np.hypot(disc[:, 0], disc[:, 1]) * CELL_M <= ROUTE_CLEARANCE_M + CELL_M]
        passed = np.unique((route_m / CELL_M).astype(np.int64), axis=0)
        cells = (passed[:, None] + disc).reshape(-1, 2)
        self._route = np.zeros((math.ceil(plan.length_m / CELL_M) + 1, math.ceil(plan.depth_m / CELL_M) + 1), np.bool_)
        inside = np.all((cells >= 0) & (cells < self._route.shape), axis=1)
        self._route[tuple(cells[inside].T)] = True
        self._low = np.array([room.low_m for room in plan.rooms])
        self._high = np.array([room.high_m for room in plan.rooms])

    def anywhere(
        self, kind: ObjectClass, rooms: list[int], taken: Circles, rng: np.random.Generator
    ) -> tuple[float, float, float] | None:
        """Draw a free pose in one of the rooms (rows of the plan), or None if no candidate is free."""
        chosen = rng.choice(np.asarray(rooms), CANDIDATES)
        draws = rng.random((CANDIDATES, 3))
        poses = np.array([_candidate(self.plan.rooms[r], kind, draw) for r, draw in zip(chosen, draws, strict=True)])
        return self._first_free(kind, poses, taken)

    def nearby(
        self, kind: ObjectClass, pose: tuple[float, float, float], taken: Circles, rng: np.random.Generator
    ) -> tuple[float, float, float] | None:
        """Draw a free pose in the same room, shifted by 0.3 to 1.5 m (along the wall for what stands against one)."""
        distance = rng.uniform(0.3, 1.5, CANDIDATES)
        direction = rng.uniform(-np.pi, np.pi, CANDIDATES)
        turn = rng.normal(0.0, 0.4, CANDIDATES)
        if kind.against_wall:
            direction = pose[2] + np.where(direction > 0.0, 0.0, np.pi)
            turn = np.zeros(CANDIDATES)
        shift = np.stack([distance * np.cos(direction), distance * np.sin(direction)], axis=1)
        poses = np.column_stack([np.array(pose[:2]) + shift, se2.wrap(pose[2] + turn)])
        room = self.plan.rooms[self.plan.room_of(np.array(pose[:2]))]
        return self._first_free(kind, poses[room.contains(poses[:, :2])], taken)

    def _first_free(self, kind: ObjectClass, poses: FloatArray, taken: Circles) -> tuple[float, float, float] | None:
        if not len(poses):
            return None
        length, width = kind.size_m
        outline = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 0], [-1, 0], [0, 1], [0, -1]]) * [length, width] / 2
        points = se2.transform(poses[:, None, :], outline[None])  # (P, 8, 2)
        in_room = np.zeros(len(poses), dtype=np.bool_)
        for low, high in zip(self._low + WALL_GAP_M, self._high - WALL_GAP_M, strict=True):
            in_room |= np.all((points > low) & (points < high), axis=(1, 2))
        free = np.flatnonzero(in_room & ~taken(poses[:, :2], math.hypot(length, width) / 2))
        cell = (points[free] / CELL_M).astype(np.int64)
        free = free[~self._route[cell[..., 0], cell[..., 1]].any(axis=1)]
        if not len(free):
            return None
        x, y, theta = poses[free[0]]
        return float(x), float(y), float(theta)


def _candidate(room: Room, kind: ObjectClass, draw: FloatArray) -> tuple[float, float, float]:
    """A pose in a room from three numbers in [0, 1)."""
    (x0, y0), (x1, y1) = room.low_m, room.high_m
    u, v, turn = draw.tolist()
    x, y = x0 + u * (x1 - x0), y0 + v * (y1 - y0)
    if not kind.against_wall:
        return x, y, (2 * turn - 1) * math.pi
    back = kind.size_m[1] / 2 + WALL_GAP_M + 0.02
    return [(x, y0 + back, 0.0), (x1 - back, y, math.pi / 2), (x, y1 - back, math.pi), (x0 + back, y, -math.pi / 2)][
        int(turn * 4)
    ]


def attach_landmarks(kind: ObjectClass, rng: np.random.Generator) -> FloatArray:
    """Place landmarks (k, 2) on a new object of the class: corners of its footprint, or along a door's leaf."""
    count = int(rng.integers(kind.landmarks[0], kind.landmarks[1] + 1))
    length, width = kind.size_m
    if kind.mount == "hinge":
        return np.column_stack([np.linspace(length, 0.4 * length, count), np.zeros(count)])
    if kind.mount == "wall":
        return np.column_stack([(np.arange(count) - (count - 1) / 2) * 0.2, np.zeros(count)])
    corners = np.array([[1, 1], [-1, -1], [1, -1], [-1, 1]]) * [length, width] / 2
    # not quite on the corners, so that no two objects of a class are the same shape
    return np.asarray(rng.permutation(corners)[:count] * rng.uniform(0.75, 1.0, (count, 2)))


def furnish(
    classes: tuple[ObjectClass, ...], placer: Placer, rng: np.random.Generator
) -> tuple[list[SceneObject], Circles]:
    """Place all objects of day 0; return them, and the circles on the floor that they keep (homes stay theirs).

    Raises:
        ConfigError: an object does not fit.
    """
    plan = placer.plan
    rooms = list(range(len(plan.rooms)))
    objects: list[SceneObject] = []
    homes = Circles()
    next_landmark = 0
    # doors first, they can stand in the outer walls only; then what stands along walls, then the rest, large first
    order = sorted(range(len(classes)), key=lambda row: _placing_order(classes[row]))
    placed: dict[tuple[int, int], tuple[tuple[float, float, float], float]] = {}
    for row in order:
        kind = classes[row]
        for number in range(kind.count):
            turn = 0.0
            pose: tuple[float, float, float] | None
            if kind.mount == "hinge":
                pose, turn = _hinge(plan.rooms[_spread(number, kind.count, len(rooms))], kind, homes, rng)
                if pose is not None:
                    homes.add(pose, kind.size_m[0])
            elif kind.mount == "wall":
                pose = _on_wall(plan, number, kind.count, rng)
            else:
                # rooms in turn, so that none is left empty; then anywhere
                pose = placer.anywhere(kind, [rooms[(number + row) % len(rooms)]], homes, rng)
                pose = pose or placer.anywhere(kind, rooms, homes, rng) or placer.anywhere(kind, rooms, homes, rng)
                if pose is not None:
                    homes.add(pose, math.hypot(*kind.size_m) / 2)
            if pose is None:
                raise ConfigError(
                    f"{kind.name} {number + 1} of {kind.count} finds no free place in the building",
                    field=f"classes[{row}].count",
                    hint="fewer or smaller objects, or a larger building",
                )
            placed[row, number] = (pose, turn)
    for (row, _), (pose, turn) in sorted(placed.items()):
        offset = attach_landmarks(classes[row], rng)
        ids = tuple(range(next_landmark, next_landmark + len(offset)))
        next_landmark += len(offset)
        objects.append(SceneObject(len(objects), classes[row], row, ids, offset, pose, turn))
    return objects, homes


def _placing_order(kind: ObjectClass) -> tuple[int, bool, float]:
    return {"hinge": 0, "wall": 1, "floor": 2}[kind.mount], not kind.against_wall, -math.hypot(*kind.size_m)


def _spread(number: int, count: int, places: int) -> int:
    """The place of the `number`-th of `count` things spread evenly over places."""
    return number * places // count if count < places else number % places


def _hinge(
    room: Room, kind: ObjectClass, homes: Circles, rng: np.random.Generator
) -> tuple[tuple[float, float, float] | None, float]:
    """Pose of a closed exterior door in the outer wall of a room, and the turn by which it opens inwards."""
    leaf = kind.size_m[0]
    # x: clear of the robot's loop, which keeps at least 2.0 m off the outer wall, and of the corners
    y = room.high_m[1] - WALL_GAP_M if room.north else room.low_m[1] + WALL_GAP_M
    xs = rng.uniform(room.low_m[0] + leaf, max(room.high_m[0] - 2 * leaf, room.low_m[0] + leaf), 50)
    free = ~homes(np.column_stack([xs, np.full(50, y)]), leaf)
    if not free.any() or leaf > 1.2:
        return None, 0.0
    return (float(xs[int(np.argmax(free))]), y, 0.0), -math.pi / 2 if room.north else math.pi / 2


def _on_wall(plan: FloorPlan, number: int, count: int, rng: np.random.Generator) -> tuple[float, float, float]:
    """Pose of a marker: every third on a corridor wall, the others on the rooms' walls in turn."""
    u = rng.random()
    if number % 3 == 2:
        walls = [w for w in plan.walls_m if w[0, 1] in plan.corridor_y_m and abs(w[1, 0] - w[0, 0]) > 1.0]
        (x0, y), (x1, _) = walls[_spread(number // 3, max(1, count // 3), len(walls))]
        inward = 1.0 if y == plan.corridor_y_m[0] else -1.0
        return float(x0 + 0.4 + u * (x1 - x0 - 0.8)), float(y + inward * WALL_GAP_M), 0.0
    room = plan.rooms[(number - number // 3) % len(plan.rooms)]
    (x0, y0), (x1, y1) = room.low_m, room.high_m
    side = int(rng.integers(3))
    if side == 2:
        return x0 + 0.4 + u * (x1 - x0 - 0.8), y1 - WALL_GAP_M if room.north else y0 + WALL_GAP_M, 0.0
    return (x1 - WALL_GAP_M if side else x0 + WALL_GAP_M), y0 + 0.4 + u * (y1 - y0 - 0.8), math.pi / 2
