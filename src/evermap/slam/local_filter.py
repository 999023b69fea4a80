"""One Gaussian of the newest pose, the calibration states and the nearby places, step by step.

Given the newest pose the older ones say nothing more about the next detection. So a step predicts the newest pose by
its odometry, marginalises the one before, and updates with the detections of the frame: an iterated extended Kalman
filter (Bell and Cathey 1993) whose measurement noise is re-weighted like the smoother's.

Only the places that were used last stand in the covariance (`nearby_places`).

The stream (`SessionFilter`), the association of detections without identities and the localisation in a fixed map all
drive this filter. In a fixed map places are only considered (Schmidt 1966): they are wrong, by what their covariance
says, and wrong in the same way in every frame. A filter that takes that for fresh noise of each detection believes
after a hundred frames in its pose to a tenth of the map's error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.geometry.group import PLANE
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.filter_kernels import BELIEVED, HEAVY, drive_on, driven, innovations, update
from evermap.slam.kernels import AT_PLACES, N_STATES
from evermap.slam.nearby_places import MOST_ACTIVE, NO_PLACES, NearbyPlaces, grown
from evermap.slam.problem import Drive, Estimate, Marginals, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.types import BoolArray, FloatArray, IntArray

ROOM_SHARE = 0.75
"""Of the places that there is room for, those that a restart brings in at most."""
NO_ODDS, NOWHERE = np.zeros(0), np.zeros((0, 2, 2))


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


class LocalFilter(NearbyPlaces):
    """The newest pose (3,), the 11 calibration states and the places (2,) around."""

    def __init__(
        self, mount: FloatArray, prior: CalibrationPrior, *, most: int = MOST_ACTIVE, considered: bool = False
    ) -> None:
        variance = (prior.sigma * prior.free) ** 2
        super().__init__(PLANE, prior.mean.copy(), variance, 2, 2, most=most, considered=considered)
        self._mount, self._free = mount, prior.free

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
