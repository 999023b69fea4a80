"""The places in a joint covariance with a pose, in the plane or in space: which stand in it, and what ties the others.

Only the places that were used last stand in the covariance, so that a step costs the same whatever the size of the
world (compare the compressed filter of Guivant and Nebot 2001, whose far places wait, too). A place that leaves is kept
with what ties it to its nearest neighbours; where it comes back it is where these take it. Those that a batch solution
or a map knows are tied as that says, exactly.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from evermap.geometry.group import Group
from evermap.types import UNKNOWN, FloatArray, IntArray

UNKNOWN_VARIANCE = 1e4
"""Of a place before its first sighting, m^2: where nothing is known, but not so wide that digits are lost."""
LEAST_VARIANCE = 1e-12
"""Of neighbours, m^2: two that are known exactly, or as one, say no more than one of them."""
MOST_ACTIVE = 64
"""Places in the covariance: those of several views around the robot."""
FEWEST_SLOTS = 16
"""Places that there is room for at first."""
NEIGHBOURS = 8
"""Places, the nearest, to which a place is tied while it is not in the covariance."""
NO_PLACES = np.arange(0)


@dataclass(frozen=True, slots=True)
class Ties:
    """A place when it left the covariance, together with its neighbours.

    Attributes:
        rows: (k,) neighbours.
        place: (W,) of the place itself; neighbours: (k, W) of these.
        joint: (D + D k, D + D k) covariance of it and them.
    """

    rows: IntArray
    place: FloatArray
    neighbours: FloatArray
    joint: FloatArray


class NearbyPlaces:
    """A pose, calibration states and places around; the slots of their joint covariance for places.

    Nothing is known of the pose before `hold`. At `most` so many places stand in the covariance, unless a single frame
    sees more. If `considered`, no detection moves a place.

    Args:
        group: of the pose.
        states: (C,) calibration states, and `variance` (C,) of them.
        dim: numbers of a place in the covariance, D, stored in `width` numbers, W. The first are its position.
        most, considered: see above.
    """

    def __init__(
        self,
        group: Group,
        states: FloatArray,
        variance: FloatArray,
        dim: int,
        width: int,
        *,
        most: int,
        considered: bool,
    ) -> None:
        self.group, self.dim, self._most, self._considered = group, dim, most, considered
        self.own = group.dim + len(states)
        """Numbers of pose and calibration."""
        self.pose = np.full(group.size, np.nan)
        """The newest pose."""
        self.states = states
        """(C,) calibration states."""
        self.covariance = np.diag(np.append(np.zeros(group.dim), variance))
        """(own + D K, own + D K) of pose, in its own frame, calibration, and places in K slots, zero in free ones."""
        self.position = np.zeros((0, width))
        """(L, W) all places, those that wait as they were when they left; nan where one was never met."""
        self._row: IntArray = np.zeros(0, dtype=np.int64)
        self._used_at: IntArray = np.zeros(0, dtype=np.int64)
        self._slot: IntArray = np.zeros(0, dtype=np.int64)
        self._now = 0
        self._left: dict[int, Ties] = {}
        self._given_position, self._neighbours = np.zeros((0, width)), NEIGHBOURS
        self._given_joint: Callable[[IntArray], FloatArray] | None = None

    def copied(self) -> Self:
        """Return a copy: what is done with it leaves this one as it is."""
        other = copy.copy(self)
        for name in ("pose", "states", "covariance", "position", "_row", "_used_at", "_slot", "_left"):
            setattr(other, name, getattr(self, name).copy())
        return other

    @property
    def active(self) -> IntArray:
        """Rows of the places in the covariance."""
        return np.asarray(self._row[self._row != UNKNOWN])

    def columns(self, slots: IntArray) -> IntArray:
        """Return the columns of places in the covariance, D each."""
        return np.asarray(self.own + (self.dim * slots[:, None] + np.arange(self.dim)).ravel(), dtype=np.int64)

    def lean_on(self, position: FloatArray, joint: Callable[[IntArray], FloatArray], *, tied: bool = True) -> None:
        """Take places (L, W), nan where not known, from a solution or a map.

        `joint(rows)` returns the covariance (D k, D k) of some of them; where all are independent they are not `tied`.
        """
        self._given_position, self._given_joint = position, joint
        self._neighbours = NEIGHBOURS if tied else 0

    def spread(self, rows: IntArray) -> FloatArray:
        """Return (k, D, D) covariance of places (k,) that are in the covariance."""
        at = self.own + self.dim * self._slot[rows][:, None] + np.arange(self.dim)
        return np.asarray(self.covariance[at[:, :, None], at[:, None, :]])

    def bring(self, rows: IntArray) -> IntArray:
        """Bring known places (k,) into the covariance, in place of those used longest ago, and return their slots."""
        slots = self._slot[rows]
        here = slots >= 0
        if np.count_nonzero(here) == len(here):
            self._used_at[slots] = self._now
            return slots
        self._used_at[slots[here]] = self._now
        waiting = list(dict.fromkeys(rows[~here].tolist()))
        self._make_room(len(waiting))
        for row, ties in zip(waiting, self._tie_places(waiting), strict=True):
            self._return(row, ties)
        return self._slot[rows]

    def know_of(self, count: int) -> None:
        """Make room for so many places in all; nothing is known of new ones."""
        self.position = grown(self.position, count)
        self._slot = grown(self._slot, count, -1)

    def hold(
        self, pose: FloatArray, states: FloatArray, covariance: FloatArray, rows: IntArray, position: FloatArray
    ) -> None:
        """Begin anew at a joint Gaussian of pose, states and different places `rows` of all places (L, W)."""
        self.pose, self.states, self.position = np.array(pose, dtype=np.float64), states.copy(), position
        if len(self._slot) == len(position):
            self._slot[self.active] = -1
        else:
            self._slot = np.full(len(position), -1)
        room = max(FEWEST_SLOTS, len(rows))
        self._row, self._used_at = np.full(room, UNKNOWN), np.full(room, self._now)
        self._row[: len(rows)] = rows
        self._slot[rows] = np.arange(len(rows))
        size = self.own + self.dim * room
        self.covariance = np.zeros((size, size))
        self.covariance[: len(covariance), : len(covariance)] = covariance
        self._left.clear()

    def meet(
        self,
        row: int,
        place: FloatArray,
        spread: FloatArray | None = None,
        given: IntArray = NO_PLACES,
        gain: FloatArray | None = None,
    ) -> None:
        """Put a new place, of all places `row`, at `place` (W,).

        Its covariance is `spread` (D, D), None for anywhere, `given` others (k,), in the covariance, which it follows
        by `gain` (D, D k).
        """
        self.know_of(row + 1)
        self._make_room(1)
        own = UNKNOWN_VARIANCE * np.eye(self.dim) if spread is None else spread
        self._enter(row, given, np.zeros((self.dim, 0)) if gain is None else gain, own)
        self.position[row] = place

    def sight(self, row: int, place: FloatArray, by_own: FloatArray, spread: FloatArray) -> None:
        """Initialise a place from a sighting at the newest pose, in a map whose places are only considered.

        It is as wrong as the pose is now, and stays there: the pose is held by it, but gets no better than it was.
        `by_own` (D, own) are its derivatives by the pose and the calibration states, `spread` (D, D) is of the reading.
        """
        self.meet(row, place, spread)
        at = self.columns(self._slot[[row]])
        across = by_own @ self.covariance[: self.own]
        self.covariance[at], self.covariance[:, at] = across, across.T
        self.covariance[np.ix_(at, at)] = across[:, : self.own] @ by_own.T + spread

    def _apart(self, places: FloatArray, others: FloatArray) -> FloatArray:
        """Return (k, D) by which places (k, W) differ from others, as the covariance counts it."""
        return places - others

    def _move_place(self, place: FloatArray, by: FloatArray) -> FloatArray:
        """Return a place (W,) that differs from another by (D,)."""
        return np.asarray(place + by)

    def _make_room(self, count: int) -> None:
        """Have so many free slots: new ones as long as there are few, else those that were not used for longest."""
        free, have = int(np.count_nonzero(self._row == UNKNOWN)), len(self._row)
        room = max(FEWEST_SLOTS, have)
        while room < min(self._most, have - free + count):
            room *= 2
        room = min(room, max(self._most, have))
        excess = have - free + count - room
        if excess > 0:
            order = np.argsort(np.where(self._row == UNKNOWN, self._now, self._used_at), kind="stable")[:excess]
            leaving = order[self._used_at[order] < self._now]
            self._leave(leaving[self._row[leaving] != UNKNOWN])
            room += excess - len(leaving)  # a frame of more places than there is room for
        if room > have:
            self._row = np.append(self._row, np.full(room - have, UNKNOWN))
            self._used_at = np.append(self._used_at, np.full(room - have, self._now))
            self.covariance = np.pad(self.covariance, (0, self.dim * (room - have)))

    def _leave(self, leaving: IntArray) -> None:
        """Free slots; what ties their places to others is kept, if it is not known anyway."""
        stays = self._row != UNKNOWN
        stays[leaving] = False
        kept = np.flatnonzero(stays)
        position = self.position[self._row[kept]]
        for slot in leaving.tolist():
            row = int(self._row[slot])
            if self._considered and row < len(self._given_position):
                continue
            near = kept[self._nearest(position, self.position[row], 0 if self._considered else NEIGHBOURS)]
            at = self.columns(np.append(slot, near))
            rows = self._row[near]
            self._left[row] = Ties(
                rows, self.position[row].copy(), self.position[rows], self.covariance[np.ix_(at, at)]
            )
        self._slot[self._row[leaving]], self._row[leaving] = -1, UNKNOWN
        at = self.columns(leaving)
        self.covariance[at], self.covariance[:, at] = 0.0, 0.0

    def _tie_places(self, waiting: list[int]) -> list[Ties]:
        """Return the ties of places to others: as stored, or from the solution or the map if most neighbours left."""
        solved, here = np.isfinite(self._given_position[:, 0]), self._slot >= 0
        of = self.active if self._neighbours else NO_PLACES
        of = of[of < len(solved)]
        of = of[solved[of]]
        ties: dict[int, Ties] = {}
        near: dict[int, IntArray] = {}
        for row in waiting:
            left, is_solved = self._left.pop(row, None), row < len(solved) and bool(solved[row])
            if left is not None and not (is_solved and 2 * np.count_nonzero(here[left.rows]) < len(left.rows)):
                ties[row] = left
            elif not self._neighbours:
                near[row] = NO_PLACES
            else:
                near[row] = of[self._nearest(self._given_position[of], self._given_position[row], self._neighbours)]
            here[row] = True
            if is_solved and self._neighbours:
                of = np.append(of, row)
        if near:
            assert self._given_joint is not None
            every = np.unique(np.concatenate([[row, *others] for row, others in near.items()]))
            joint = self._given_joint(every)
            for row, others in near.items():
                at = self._columns_of(np.searchsorted(every, np.append(row, others)))
                there = self._given_position[row], self._given_position[others]
                ties[row] = Ties(others, *there, joint[np.ix_(at, at)])
        return [ties[row] for row in waiting]

    def _return(self, row: int, ties: Ties) -> None:
        """Put a known place back where those of its neighbours that are in the covariance take it."""
        dim = self.dim
        if not len(ties.rows):
            self._enter(row, NO_PLACES, np.zeros((dim, 0)), ties.joint[:dim, :dim])
            if not self._considered:
                self.position[row] = self._move_place(ties.place, np.zeros(dim))
            return
        there = np.flatnonzero(self._slot[ties.rows] >= 0)
        given, own = ties.rows[there], ties.joint[:dim, :dim]
        gain: FloatArray = np.zeros((dim, 0))
        at = self._columns_of(1 + there)
        if len(there):
            known = ties.joint[np.ix_(at, at)] + LEAST_VARIANCE * np.eye(len(at))
            gain = np.asarray(np.linalg.solve(known, ties.joint[at, :dim]).T, dtype=np.float64)
        self._enter(row, given, gain, own - gain @ ties.joint[at, :dim])
        if self._considered:  # whatever its neighbours are held to be
            slot = self.columns(self._slot[[row]])
            self.covariance[np.ix_(slot, slot)] = own
        else:
            moved = self._apart(self.position[given], ties.neighbours[there])
            self.position[row] = self._move_place(ties.place, gain @ moved.ravel())

    def _enter(self, row: int, given: IntArray, gain: FloatArray, spread: FloatArray) -> None:
        """Put a place in a free slot."""
        slot = int(np.argmax(self._row == UNKNOWN))
        first = self.own + self.dim * slot
        own, alone = slice(first, first + self.dim), 0.5 * (spread + spread.T)
        if len(given):
            others = self.columns(self._slot[given])
            across = gain @ self.covariance[others]
            self.covariance[own], self.covariance[:, own] = across, across.T
            alone = across[:, others] @ gain.T + alone
        else:
            self.covariance[own], self.covariance[:, own] = 0.0, 0.0
        self.covariance[own, own] = alone
        self._row[slot], self._slot[row], self._used_at[slot] = row, slot, self._now

    def _columns_of(self, rows: IntArray) -> IntArray:
        """Return the columns of some places in a covariance of places alone."""
        return np.asarray((self.dim * rows[:, None] + np.arange(self.dim)).ravel(), dtype=np.int64)

    def _nearest(self, places: FloatArray, to: FloatArray, count: int) -> IntArray:
        """Return rows of the nearest places, the nearest first."""
        axes = self.group.point_dim
        away = ((places[:, :axes] - to[:axes]) ** 2).sum(axis=1)
        return np.asarray(np.argsort(away, kind="stable")[:count])


def grown(rows: Any, count: int, missing: float = np.nan) -> Any:
    """Return rows, so many at least: those that are missing have a value for that; the same array where none is."""
    more = count - len(rows)
    if more <= 0:
        return rows
    return np.pad(rows, [(0, more), *[(0, 0)] * (rows.ndim - 1)], constant_values=missing)
