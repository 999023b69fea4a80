"""What stands in the building: objects that carry landmarks, and where an object can stand.

Objects stand clear of walls, of the robot's route and of each other. They do not block the sensor's view; walls do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError
from evermap.geometry import se2
from evermap.sim.classes import ObjectClass
from evermap.sim.floorplan import FloorPlan, Room
from evermap.types import BoolArray, FloatArray

ROUTE_CLEARANCE_M: float = 0.6
"""Robot radius, scatter of the route and margin: footprints stay this far from the nominal route."""
WALL_GAP_M: float = 0.06
CELL_M: float = 0.1
CANDIDATES: int = 200


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
        """Of the circle about the object's origin that holds its footprint (for a door: the swing of its leaf)."""
        if self.kind.mount == "hinge":
            return self.kind.size_m[0]
        return math.hypot(*self.kind.size_m) / 2

    def landmarks_at(self, pose: tuple[float, float, float]) -> FloatArray:
        """(k, 2) positions of its landmarks when it stands at a pose."""
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
        cells = ((route_m[:, None] / CELL_M).astype(np.int64) + disc).reshape(-1, 2)
        self._route = np.zeros((math.ceil(plan.length_m / CELL_M) + 1, math.ceil(plan.depth_m / CELL_M) + 1), np.bool_)
        inside = np.all((cells >= 0) & (cells < self._route.shape), axis=1)
        self._route[tuple(cells[inside].T)] = True
        self._low = np.array([room.low_m for room in plan.rooms])
        self._high = np.array([room.high_m for room in plan.rooms])

    def anywhere(
        self, kind: ObjectClass, rooms: list[int], taken: Circles, rng: np.random.Generator
    ) -> tuple[float, float, float] | None:
        """A random free pose in one of the rooms (rows of the plan), or None if no candidate is free."""
        chosen = rng.choice(np.asarray(rooms), CANDIDATES)
        draws = rng.random((CANDIDATES, 3))
        poses = np.array([_candidate(self.plan.rooms[r], kind, draw) for r, draw in zip(chosen, draws, strict=True)])
        return self._first_free(kind, poses, taken)

    def nearby(
        self, kind: ObjectClass, pose: tuple[float, float, float], taken: Circles, rng: np.random.Generator
    ) -> tuple[float, float, float] | None:
        """A free pose in the same room, shifted by 0.3 to 1.5 m (along the wall for what stands against one)."""
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
    """(k, 2) landmark positions on a new object of the class: corners of its footprint, or along a door's leaf."""
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
    """All objects of day 0, and the circles on the floor that they keep (their homes stay theirs).

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
