"""A floor of six rooms and a corridor, and what stands where: tagged walls, shelves and pallets, forklifts, signs.

Everything follows from one seed. Things stand at spots; they are moved within a spot, to another one, taken away and
brought back, at random times. Geometry is scipy's.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from evermap.types import BoolArray, FloatArray, IntArray

LENGTH_M, ROOM_M, CORRIDOR_M = 24.0, (8.0, 6.0), (6.0, 8.4)
DOOR_M = 1.6
ROOM_CENTRES = np.array([(x, y) for y in (3.0, 11.4) for x in (4.0, 12.0, 20.0)])
"""Three rooms on each side of the corridor."""
NUDGE_M = (0.45, 0.55)
BEFORE_DAYS = 10.0
"""The building lives on for so long before the first session."""


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of thing.

    Attributes:
        name: class in recordings.
        count, later: things on the first day, and things that come on a later one.
        size_m: length, width and height of what blocks sight; zeros of what does not.
        tags: (x, y, z, direction it faces) in the thing's frame; empty for an object that has a pose itself.
        stay_days: mean of the exponential time at one place; inf for ever.
        away_days: mean of the exponential time away.
        p_leave, p_return, p_same, p_nudge: at the end of a stay it is taken away, and is brought back at all, and to
            where it stood; a move is within its spot.
    """

    name: str
    count: int
    later: int = 0
    size_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tags: tuple[tuple[float, float, float, float], ...] = ()
    stay_days: float = np.inf
    away_days: float = 2.0
    p_leave: float = 0.5
    p_return: float = 0.7
    p_same: float = 0.5
    p_nudge: float = 0.4


_QUARTER = np.pi / 2.0
KINDS = (
    Kind("wall", 26, tags=((0.0, 0.0, 0.0, 0.0),)),
    Kind("sign", 6),
    Kind("shelf", 10, 0, (1.4, 0.4, 2.0), ((-0.5, -0.2, 0.9, -_QUARTER), (0.5, -0.2, 1.4, -_QUARTER)), 40.0, 2.0, 0.3),
    Kind(
        "pallet", 8, 4, (1.2, 0.8, 1.0),
        ((0.6, 0.0, 0.5, 0.0), (0.0, 0.4, 0.5, _QUARTER), (-0.6, 0.0, 0.5, np.pi), (0.0, -0.4, 0.5, -_QUARTER)),
        6.0,
    ),
    Kind("forklift", 5, 0, (1.2, 0.8, 2.0), (), 2.0, 1.0, p_leave=0.5, p_return=0.95),
)  # fmt: skip
FIXED = ("wall", "sign")


@dataclass(frozen=True, slots=True)
class World:
    """What stands where, session by session: D sessions, T things, L landmarks, numbered as their identities.

    Attributes:
        kind: (T,) row of `KINDS`.
        stamp_days: (D,) when sessions begin; nothing changes in one.
        thing: (D, T, 4) x, y, z and heading of things; nan while away.
        of: (L,) thing of each landmark.
        local_m, facing: (L, 3) and (L,) landmarks in the frames of their things.
        door_open: (D, 6) of the rooms.
    """

    kind: IntArray
    stamp_days: FloatArray
    thing: FloatArray
    of: IntArray
    local_m: FloatArray
    facing: FloatArray
    door_open: BoolArray

    @property
    def is_tag(self) -> BoolArray:
        """(L,) landmarks seen by their corners; the others have poses."""
        return np.array([bool(KINDS[k].tags) for k in self.kind[self.of]])

    @property
    def class_id(self) -> IntArray:
        """(L,) rows of `KINDS`."""
        return self.kind[self.of]

    def landmarks(self, day: int) -> tuple[FloatArray, Rotation]:
        """(L, 3) positions on a day, nan while away, and orientations: a tag's z points into what it is on."""
        thing = self.thing[day, self.of]
        heading = np.nan_to_num(thing[:, 3])
        at = thing[:, :3] + _about_up(heading).apply(self.local_m)
        turn = _about_up(heading + self.facing)
        # x is left of who faces the same way as the tag, y down, z into the wall
        tag = Rotation.from_matrix(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
        quaternion = np.where(self.is_tag[:, None], (turn * tag).as_quat(), turn.as_quat())
        return at, Rotation.from_quat(quaternion)

    def positions(self) -> FloatArray:
        """(D, L, 3) of all days."""
        return np.stack([self.landmarks(day)[0] for day in range(len(self.stamp_days))])

    def blocking(self, day: int) -> tuple[FloatArray, FloatArray, IntArray]:
        """(S, 2, 2) ends of walls, shut doors and sides of things, (S,) heights, and whose they are (-1: none)."""
        walls = _walls(self.door_open[day])
        ends, height, whose = [walls], [np.full(len(walls), 3.0)], [np.full(len(walls), -1)]
        for row in np.flatnonzero(np.isfinite(self.thing[day, :, 0])).tolist():
            length, width, top = KINDS[self.kind[row]].size_m
            if not top:
                continue
            x, y, _, heading = self.thing[day, row]
            corner = 0.5 * np.array([[length, width], [-length, width], [-length, -width], [length, -width]])
            turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
            corner = corner @ turn.T + (x, y)
            ends.append(np.stack([corner, np.roll(corner, 1, axis=0)], axis=1))
            height.append(np.full(4, top))
            whose.append(np.full(4, row))
        return np.concatenate(ends), np.concatenate(height), np.concatenate(whose)


def _about_up(angle_rad: FloatArray) -> Rotation:
    return Rotation.from_rotvec(angle_rad[:, None] * np.array([0.0, 0.0, 1.0]))


def made(seed: int, days: int, *, changes: bool = True) -> World:
    """Make a world of `days` sessions, one a day; without changes it stays as it is on the first."""
    random = np.random.default_rng([seed, 1])
    kind = np.repeat(np.arange(len(KINDS)), [k.count + k.later for k in KINDS])
    stamp_days = np.arange(days) + random.uniform(0.3, 0.7, days)
    thing = np.full((days, len(kind), 4), np.nan)
    thing[:, kind == 0], thing[:, kind == 1] = _wall_tags(random), _signs()
    for kinds, spots in (((2,), _shelf_spots()), ((3, 4), _floor_spots())):
        rows = np.flatnonzero(np.isin(kind, kinds))
        thing[:, rows] = _lives(kind[rows], spots, stamp_days, random)
    if not changes:
        thing[:] = thing[0]
    of, local, facing = [], [], []
    for row, k in enumerate(kind.tolist()):
        for x, y, z, direction in KINDS[k].tags or ((0.0, 0.0, 0.5 * KINDS[k].size_m[2], 0.0),):
            of.append(row)
            local.append((x, y, z))
            facing.append(direction)
    door_open = random.random((days, len(ROOM_CENTRES))) < 0.8
    door_open[0] = True
    return World(kind, stamp_days, thing, np.array(of), np.array(local), np.array(facing), door_open)


def _lives(kind: IntArray, spots: FloatArray, stamp_days: FloatArray, random: np.random.Generator) -> FloatArray:
    """(D, T, 4) where things that share (S, 4) spots stand."""
    now = np.full((len(kind), 4), np.nan)
    spot, home, shifted = (np.full(len(kind), -1) for _ in range(3))
    queue: list[tuple[float, int]] = []

    def placed(row: int, at: int) -> None:
        spot[row] = home[row] = at
        turn = random.normal(0.0, 0.05)
        inward = shifted[row] > 0
        step = np.where(inward, random.uniform(*NUDGE_M), 0.0) * np.array([1.0, 0.0])
        centre = ROOM_CENTRES[np.argmin(np.linalg.norm(ROOM_CENTRES - spots[at, :2], axis=1))]
        along = np.array([np.cos(spots[at, 3]), np.sin(spots[at, 3])])  # moved along itself, towards the middle
        sign = 1.0 if along @ (centre - spots[at, :2]) >= 0.0 else -1.0
        now[row] = spots[at] + np.array([*(sign * step[0] * along), 0.0, turn])

    def free() -> int:
        return int(random.choice(np.setdiff1d(np.arange(len(spots)), spot)))

    for row, k in enumerate(kind.tolist()):
        later = row - np.flatnonzero(kind == k)[0] >= KINDS[k].count
        if later:
            heapq.heappush(queue, (random.uniform(0.0, stamp_days[-1]), row))
        else:
            placed(row, free())
            heapq.heappush(queue, (random.exponential(KINDS[k].stay_days) - BEFORE_DAYS, row))
    found = np.empty((len(stamp_days), *now.shape))
    for day, stamp in enumerate(stamp_days.tolist()):
        while queue and queue[0][0] <= stamp:
            when, row = heapq.heappop(queue)
            own = KINDS[kind[row]]
            if spot[row] < 0:  # it comes
                shifted[row] = -1
                same = home[row] >= 0 and home[row] not in spot and random.random() < own.p_same
                placed(row, int(home[row]) if same else free())
            elif random.random() < own.p_leave:
                spot[row], now[row] = -1, np.nan
                if random.random() < own.p_return:
                    heapq.heappush(queue, (when + random.exponential(own.away_days), row))
                continue
            elif random.random() < own.p_nudge:
                shifted[row] *= -1
                placed(row, int(spot[row]))
            else:
                shifted[row] = -1
                placed(row, free())
            heapq.heappush(queue, (when + random.exponential(own.stay_days), row))
        found[day] = now
    return found


def _walls(door_open: BoolArray) -> FloatArray:
    """(S, 2, 2) of the floor, with the doors that are shut."""
    low, high = CORRIDOR_M
    depth = high + ROOM_M[1]
    ends = [
        ((0, 0), (LENGTH_M, 0)),
        ((0, depth), (LENGTH_M, depth)),
        ((0, 0), (0, depth)),
        ((LENGTH_M, 0), (LENGTH_M, depth)),
    ]
    ends += [((x, y), (x, y + ROOM_M[1])) for x in (8.0, 16.0) for y in (0.0, high)]
    for room, (x, _) in enumerate(ROOM_CENTRES.tolist()):
        y, half = low if room < 3 else high, 0.5 * DOOR_M
        ends += [((x - 4.0, y), (x - half, y)), ((x + half, y), (x + 4.0, y))]
        if not door_open[room]:
            ends.append(((x - half, y), (x + half, y)))
    return np.array(ends, dtype=np.float64)


def _wall_tags(random: np.random.Generator) -> FloatArray:
    """(26, 4) in the corridor and the rooms, just before the walls."""
    found = [(x, y, h) for x in (1.5, 7.0, 9.0, 15.0, 17.0, 22.5) for y, h in ((6.02, _QUARTER), (8.38, -_QUARTER))]
    found += [(0.02, 7.2, 0.0), (LENGTH_M - 0.02, 7.2, np.pi)]
    for x, y in ROOM_CENTRES.tolist():
        door = 1.0 if y < 7.0 else -1.0
        found += [(x + 3.98, y, np.pi), (x - 2.4, y + 2.98 * door, -_QUARTER * door)]
    at = np.array(found)
    return np.column_stack([at[:, :2], random.uniform(0.5, 1.5, len(at)), at[:, 2]])


def _signs() -> FloatArray:
    """(6, 4) beside the doors."""
    return np.array([(x + 2.4, y + (2.95 if y < 7.0 else -2.95), 1.5, 0.0) for x, y in ROOM_CENTRES.tolist()])


def _shelf_spots() -> FloatArray:
    """(18, 4) along walls; the front, which has the tags, faces the room."""
    found = []
    for x, y in ROOM_CENTRES.tolist():
        far = -1.0 if y < 7.0 else 1.0
        found += [(x + dx, y + 2.75 * far, 0.0, 0.0 if far > 0.0 else np.pi) for dx in (-1.6, 1.6)]
        found.append((x - 3.75, y, 0.0, _QUARTER))
    return np.array(found)


def _floor_spots() -> FloatArray:
    """(36, 4) in the corners and the middle of rooms, clear of the robot's way."""
    around = [(-1.3, 0.0), (1.3, 0.0), (-3.1, -2.2), (3.1, -2.2), (-3.1, 2.2), (3.1, 2.2)]
    return np.array([(x + dx, y + dy, 0.0, 0.0) for x, y in ROOM_CENTRES.tolist() for dx, dy in around])
