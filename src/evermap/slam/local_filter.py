"""One Gaussian of the newest pose, the calibration states and the nearby places, step by step.

Given the newest pose the older ones say nothing more about the next detection. So a step predicts the newest pose by
its odometry, marginalises the one before, and updates with the detections of the frame: an iterated extended Kalman
filter (Bell and Cathey 1993) whose measurement noise is re-weighted like the smoother's.

Only the places that were used last stand in the covariance, so that a step costs the same whatever the size of the
world (compare the compressed filter of Guivant and Nebot 2001, whose far places wait, too). A place that leaves is kept
with what ties it to its nearest neighbours; where it comes back it is where these take it. Those that a batch solution
or a map knows are tied as that says, exactly.

The stream (`SessionFilter`), the association of detections without identities and the localisation in a fixed map all
drive this filter. In a fixed map places are only considered (Schmidt 1966): they are wrong, by what their covariance
says, and wrong in the same way in every frame. A filter that takes that for fresh noise of each detection believes
after a hundred frames in its pose to a tenth of the map's error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.slam.calibration import CalibrationPrior
from evermap.slam.filter_kernels import BELIEVED, HEAVY, drive_on, driven, innovations, update
from evermap.slam.kernels import AT_PLACES, N_STATES
from evermap.slam.problem import Drive, Estimate, Marginals, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray

UNKNOWN_VARIANCE = 1e4
"""Of a place before its first sighting, m^2: where nothing is known, but not so wide that digits are lost."""
ANYWHERE = UNKNOWN_VARIANCE * np.eye(2)
LEAST_VARIANCE = 1e-12
"""Of neighbours, m^2: two that are known exactly, or as one, say no more than one of them."""
MOST_ACTIVE = 64
"""Places in the covariance: those of several views around the robot."""
FEWEST_SLOTS = 16
"""Places that there is room for at first."""
NEIGHBOURS = 8
"""Places, the nearest, to which a place is tied while it is not in the covariance."""
ROOM_SHARE = 0.75
"""Of the places that there is room for, those that a restart brings in at most."""
NO_PLACES, NO_GAIN, NO_ODDS, NOWHERE = np.arange(0), np.zeros((2, 0)), np.zeros(0), np.zeros((0, 2, 2))


@dataclass(frozen=True, slots=True)
class Motion:
    """Odometry between two poses.

    Attributes:
        increment: (3,) the second pose seen from the first.
        by_states: (3, 4) its derivative, at its end, by delay, scales and slip; zero where these are not free.
        covariance: (3, 3) its noise.
    """

    increment: FloatArray
    by_states: FloatArray
    covariance: FloatArray

    @classmethod
    def between(cls, problem: Problem, noise: Noise, row: int, states: FloatArray) -> Motion:
        """Return from pose `row - 1` to pose `row`."""
        start_s, stop_s = problem.stamp_s[row - 1 : row + 1]
        return cls.over(problem.drive, start_s, stop_s, states, problem.prior.free, noise)

    @classmethod
    def over(
        cls, drive: Drive, start_s: float, stop_s: float, states: FloatArray, free: BoolArray, noise: Noise
    ) -> Motion:
        """Return between two instants, with (11,) calibration states of which some are `free`."""
        odometry = drive.stamp_s, drive.velocity, drive.unknown
        return cls(*driven(*odometry, start_s, stop_s, states, free, noise.odometry))


@dataclass(frozen=True, slots=True)
class Ties:
    """A place when it left the covariance, together with its neighbours.

    Attributes:
        rows: (k,) neighbours.
        place: (2,) of the place itself; neighbours: (k, 2) of these.
        joint: (2 + 2 k, 2 + 2 k) covariance of it and them.
    """

    rows: IntArray
    place: FloatArray
    neighbours: FloatArray
    joint: FloatArray


class LocalFilter:
    """The newest pose, the calibration states and the places around; nothing is known of the pose before `hold`.

    At `most` so many places stand in the covariance, unless a single frame sees more. If `considered`, no detection
    moves a place.
    """

    def __init__(
        self, mount: FloatArray, prior: CalibrationPrior, *, most: int = MOST_ACTIVE, considered: bool = False
    ) -> None:
        self._mount, self._free, self._most, self._considered = mount, prior.free, most, considered
        self.pose = np.full(3, np.nan)
        """(3,) the newest pose."""
        self.states = prior.mean.copy()
        """(11,) calibration states."""
        self.covariance = np.zeros((AT_PLACES, AT_PLACES))
        """(14 + 2 K, 14 + 2 K) of pose, in its own frame, states, and places in K slots, zero in free ones."""
        self.covariance[3:, 3:] = np.diag((prior.sigma * prior.free) ** 2)
        self.position = np.zeros((0, 2))
        """(L, 2) all places, those that wait as they were when they left; nan where one was never met."""
        self._row: IntArray = np.zeros(0, dtype=np.int64)
        self._used_at: IntArray = np.zeros(0, dtype=np.int64)
        self._slot: IntArray = np.zeros(0, dtype=np.int64)
        self._now = 0
        self._left: dict[int, Ties] = {}
        self._given_position, self._neighbours = np.zeros((0, 2)), NEIGHBOURS
        self._given_joint: Callable[[IntArray], FloatArray] | None = None

    @property
    def active(self) -> IntArray:
        """Rows of the places in the covariance."""
        return np.asarray(self._row[self._row != UNKNOWN])

    def lean_on(self, position: FloatArray, joint: Callable[[IntArray], FloatArray], *, tied: bool = True) -> None:
        """Take places (L, 2), nan where not known, from a solution or a map.

        `joint(rows)` returns the covariance (2 k, 2 k) of some of them; where all are independent they are not `tied`.
        """
        self._given_position, self._given_joint = position, joint
        self._neighbours = NEIGHBOURS if tied else 0

    def hold(
        self, pose: FloatArray, states: FloatArray, covariance: FloatArray, rows: IntArray, position: FloatArray
    ) -> None:
        """Begin anew at a joint Gaussian of pose, states and different places `rows` of all places (L, 2)."""
        self.pose, self.states, self.position = np.array(pose, dtype=np.float64), states.copy(), position
        if len(self._slot) == len(position):
            self._slot[self.active] = -1
        else:
            self._slot = np.full(len(position), -1)
        room = max(FEWEST_SLOTS, len(rows))
        self._row, self._used_at = np.full(room, UNKNOWN), np.full(room, self._now)
        self._row[: len(rows)] = rows
        self._slot[rows] = np.arange(len(rows))
        self.covariance = np.zeros((AT_PLACES + 2 * room, AT_PLACES + 2 * room))
        self.covariance[: len(covariance), : len(covariance)] = covariance
        self._left.clear()

    def begin(self, estimate: Estimate, marginals: Marginals, pose_row: int, rows: IntArray) -> None:
        """Begin anew at a pose of a batch solution, with some of its places; the others are taken from there."""
        joint = marginals.joint(rows, poses=np.array([pose_row]), states=True)
        end = 3 + 2 * len(rows)
        order = np.concatenate([np.arange(3), end + np.arange(N_STATES), np.arange(3, end)])
        covariance = joint[np.ix_(order, order)]
        self.hold(estimate.pose[pose_row], estimate.states, covariance, rows, estimate.landmark.copy())
        self.lean_on(estimate.landmark, marginals.joint)

    def drive(self, motion: Motion) -> None:
        """Advance the newest pose."""
        self._now += 1
        drive_on(self.pose, self.covariance, motion.increment, motion.by_states, motion.covariance)

    def ahead(self, motion: Motion) -> tuple[FloatArray, FloatArray]:
        """Return the pose (3,) after a motion, and its covariance (3, 3); the filter stays where it is."""
        pose, covariance = self.pose.copy(), self.covariance[:AT_PLACES, :AT_PLACES].copy()
        drive_on(pose, covariance, motion.increment, motion.by_states, motion.covariance)
        return pose, covariance[:3, :3].copy()

    def spread(self, rows: IntArray) -> FloatArray:
        """Return (k, 2, 2) covariance of places (k,) that are in the covariance."""
        at = AT_PLACES + 2 * self._slot[rows][:, None] + [0, 1]
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
        for row, ties in zip(waiting, self._tied(waiting), strict=True):
            self._return(row, ties)
        return self._slot[rows]

    def meet(
        self,
        row: int,
        place: FloatArray,
        spread: FloatArray = ANYWHERE,
        given: IntArray = NO_PLACES,
        gain: FloatArray = NO_GAIN,
    ) -> None:
        """Put a new place, of all places `row`, at `place` (2,).

        Its covariance is `spread` (2, 2), `given` others (k,), in the covariance, which it follows by `gain` (2, 2 k).
        """
        self.know_of(row + 1)
        self._make_room(1)
        self._enter(row, given, gain, spread)
        self.position[row] = place

    def sight(self, row: int, place: FloatArray, by_pose: FloatArray, spread: FloatArray) -> None:
        """Initialise a place from a sighting at the newest pose, in a map whose places are only considered.

        It is as wrong as the pose is now, and stays there: the pose is held by it, but gets no better than it was.
        `by_pose` (2, 14) are its derivatives by the pose and the calibration states, `spread` (2, 2) is of the reading.
        """
        self.meet(row, place, spread)
        own = slice(AT_PLACES + 2 * int(self._slot[row]), AT_PLACES + 2 * int(self._slot[row]) + 2)
        across = by_pose @ self.covariance[:AT_PLACES]
        self.covariance[own], self.covariance[:, own] = across, across.T
        self.covariance[own, own] = across[:, :AT_PLACES] @ by_pose.T + spread

    def compare(
        self, rows: IntArray, reading: FloatArray, sigma: FloatArray, own: FloatArray = NOWHERE
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Compare detections (k, 2) with a place each, as `filter_kernels.innovations`."""
        return innovations(
            self.pose, self.states, self.covariance, self.position[rows], self._slot[rows], own, reading, sigma,
            self._mount, self._free,
        )  # fmt: skip

    def update(
        self,
        rows: IntArray,
        reading: FloatArray,
        sigma: FloatArray,
        *,
        weighing: int = BELIEVED,
        log_odds: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Update by detections of places in the covariance, as `filter_kernels.update`."""
        odds = NO_ODDS if log_odds is None else log_odds
        return update(
            self.pose, self.states, self.covariance, self.position, self._row, self._slot[rows], reading, sigma, odds,
            self._mount, self._free, self._considered, weighing,
        )  # fmt: skip

    def know_of(self, count: int) -> None:
        """Make room for so many places in all; nothing is known of new ones."""
        self.position = grown(self.position, count)
        self._slot = grown(self._slot, count, -1)

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
            self.covariance = np.pad(self.covariance, (0, 2 * (room - have)))

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
            near = kept[_nearest(position, self.position[row], 0 if self._considered else NEIGHBOURS)]
            at = columns(np.append(slot, near))
            rows = self._row[near]
            self._left[row] = Ties(
                rows, self.position[row].copy(), self.position[rows], self.covariance[np.ix_(at, at)]
            )
        self._slot[self._row[leaving]], self._row[leaving] = -1, UNKNOWN
        at = columns(leaving)
        self.covariance[at], self.covariance[:, at] = 0.0, 0.0

    def _tied(self, waiting: list[int]) -> list[Ties]:
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
            else:
                near[row] = of[_nearest(self._given_position[of], self._given_position[row], self._neighbours)]
            here[row] = True
            if is_solved and self._neighbours:
                of = np.append(of, row)
        if near:
            assert self._given_joint is not None
            every = np.unique(np.concatenate([[row, *others] for row, others in near.items()]))
            joint = self._given_joint(every)
            for row, others in near.items():
                at = (2 * np.searchsorted(every, np.append(row, others))[:, None] + [0, 1]).ravel()
                there = self._given_position[row], self._given_position[others]
                ties[row] = Ties(others, *there, joint[np.ix_(at, at)])
        return [ties[row] for row in waiting]

    def _return(self, row: int, ties: Ties) -> None:
        """Put a known place back where those of its neighbours that are in the covariance take it."""
        there = np.flatnonzero(self._slot[ties.rows] >= 0) if len(ties.rows) else NO_PLACES
        given, own, gain = ties.rows[there], ties.joint[:2, :2], NO_GAIN
        at = 2 + (2 * there[:, None] + [0, 1]).ravel()
        if len(there):
            known = ties.joint[np.ix_(at, at)] + LEAST_VARIANCE * np.eye(len(at))
            gain = np.linalg.solve(known, ties.joint[at, :2]).T
        self._enter(row, given, gain, own - gain @ ties.joint[at, :2])
        if self._considered:  # whatever its neighbours are held to be
            slot = AT_PLACES + 2 * int(self._slot[row])
            self.covariance[slot : slot + 2, slot : slot + 2] = own
        else:
            self.position[row] = ties.place + gain @ (self.position[given] - ties.neighbours[there]).ravel()

    def _enter(self, row: int, given: IntArray, gain: FloatArray, spread: FloatArray) -> None:
        """Put a place in a free slot."""
        slot = int(np.argmax(self._row == UNKNOWN))
        others, own = columns(self._slot[given]), slice(AT_PLACES + 2 * slot, AT_PLACES + 2 * slot + 2)
        across = gain @ self.covariance[others]
        self.covariance[own], self.covariance[:, own] = across, across.T
        self.covariance[own, own] = across[:, others] @ gain.T + 0.5 * (spread + spread.T)
        self._row[slot], self._slot[row], self._used_at[slot] = row, slot, self._now


class SessionFilter(LocalFilter):
    """The filter of a `Problem`: its newest pose, with its places and priors; if `robust`, with the Cauchy's tails.

    Rows of the problem beyond those added are not looked at. It may be exchanged between two steps for one whose coming
    detections belong to other places, or that has more frames or places at the end; what was added before stays as it
    was until `restart`.
    """

    def __init__(self, problem: Problem, noise: Noise, *, robust: bool = True, most: int = MOST_ACTIVE) -> None:
        super().__init__(problem.mount, problem.prior, most=most)
        self.problem = problem
        self._robust, self._noise = robust, noise
        self.covariance[:3, :3] = np.eye(3) / problem.start_information
        self.hold(problem.start_pose, self.states, self.covariance, NO_PLACES, self.position)
        self._old_pose = np.zeros((0, 3))
        self._new_pose: list[FloatArray] = []

    def restart(self, estimate: Estimate, noise: Noise, problem: Problem, marginals: Marginals | None = None) -> None:
        """Restart at `estimate`, an optimum of the first poses and all places that they saw.

        From here on with other noise, other places or other priors; `marginals` where they are known already.
        """
        self.problem, self._noise, self._free = problem, noise, problem.prior.free
        n = len(estimate.pose)
        room = max(int(ROOM_SHARE * self._most), len(np.unique(problem.landmark_row[problem.detections_of(n - 1)])))
        if marginals is None:
            marginals = Smoother(problem.until(n), noise, heavy=True, robust=self._robust).marginals(estimate)
        recent = problem.landmark_row[: np.searchsorted(problem.pose_row, n)][::-1]
        seen, first = np.unique(recent[: 50 * self._most], return_index=True)
        rows = seen[np.argsort(first, kind="stable")][:room]
        if np.count_nonzero(estimate.known) <= room:
            rows = np.flatnonzero(estimate.known)
        self.begin(estimate, marginals, n - 1, rows[estimate.known[rows]])
        self._old_pose, self._new_pose = estimate.pose[:-1], [self.pose.copy()]

    def motion(self, row: int) -> Motion:
        """Return odometry from the previous pose to pose `row`, with the present states."""
        return Motion.between(self.problem, self._noise, row, self.states)

    def distances(self, detections: IntArray, places: IntArray) -> tuple[FloatArray, FloatArray]:
        """Compare detections (k,) of the newest pose, before they are used, with known places (k,).

        Returns:
            (k,) squared Mahalanobis distances with `S = H P H' + R`, and (k,) `log |S|`.
        """
        self.bring(places)
        return self.compare(places, *self._readings(detections))[:2]

    def add(self, row: int, landmark: FloatArray) -> None:
        """Add the detections of pose `row`, one more than the last, to which the filter was driven.

        Places that are seen for the first time are at `landmark` (L, 2).
        """
        detections = self.problem.detections_of(row)
        rows = self.problem.landmark_row[detections]
        self.know_of(len(self.problem.landmark_mean))
        new = np.isnan(self.position[rows, 0])
        if np.count_nonzero(new):
            self.bring(rows[~new])
            for j in dict.fromkeys(rows[new].tolist()):
                self._meet(j, landmark)
        else:
            self.bring(rows)
        self.update(rows, *self._readings(detections), weighing=HEAVY if self._robust else BELIEVED)
        self._new_pose.append(self.pose.copy())

    def estimate(self) -> Estimate:
        """Return values of everything so far; poses since the last restart as they were when they were added."""
        landmark = grown(self.position, len(self.problem.landmark_mean)).copy()
        return Estimate(np.vstack([self._old_pose, *self._new_pose]), landmark, self.states.copy())

    def _readings(self, detections: IntArray) -> tuple[FloatArray, FloatArray]:
        return self.problem.reading[detections], self._noise.of_detections(self.problem.sigma_given[detections])

    def _meet(self, row: int, landmark: FloatArray) -> None:
        """Put a place that is seen for the first time at its prior, given those in the covariance, or at `landmark`."""
        problem, active = self.problem, np.zeros(len(self.problem.landmark_mean), dtype=bool)
        active[self.active] = True
        prior = problem.conditional_prior(row, active)
        if prior.information.any():
            place = prior.place(self.position, problem.landmark_mean)
            self.meet(row, place, np.asarray(np.linalg.inv(prior.information)), prior.given, prior.gain)
        else:
            self.meet(row, landmark[row])


def columns(slots: IntArray) -> IntArray:
    """Return the columns of x and y of places in the covariance."""
    return np.asarray(AT_PLACES + (2 * slots[:, None] + [0, 1]).ravel(), dtype=np.int64)


def grown(rows: Any, count: int, missing: float = np.nan) -> Any:
    """Return rows, so many at least: those that are missing have a value for that; the same array where none is."""
    more = count - len(rows)
    if more <= 0:
        return rows
    return np.pad(rows, [(0, more), *[(0, 0)] * (rows.ndim - 1)], constant_values=missing)


def _nearest(position: FloatArray, to: FloatArray, count: int) -> IntArray:
    """Return rows of the nearest points, the nearest first."""
    away = ((position - to) ** 2).sum(axis=1)
    return np.asarray(np.argsort(away, kind="stable")[:count])
