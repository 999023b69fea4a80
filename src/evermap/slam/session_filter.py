"""The local filter of a stream: pose after pose between two relinearisations by the batch smoother."""

from __future__ import annotations

import numpy as np

from evermap.slam.filter_kernels import BELIEVED, HEAVY
from evermap.slam.local_filter import NO_PLACES, LocalFilter, Motion, grown
from evermap.slam.problem import Estimate, Marginals, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.types import FloatArray, IntArray

ROOM_SHARE = 0.75
"""Of the places that there is room for, those that a restart brings in at most."""


class SessionFilter(LocalFilter):
    """The filter of a `Problem`: its newest pose, with its places and priors; if `robust`, with the Cauchy's tails.

    Rows of the problem beyond those added are not looked at. It may be exchanged between two steps for one whose coming
    detections belong to other places, or that has more frames or places at the end; what was added before stays as it
    was until `restart`.
    """

    def __init__(self, problem: Problem, noise: Noise, *, robust: bool = True) -> None:
        super().__init__(problem.mount, problem.prior)
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
