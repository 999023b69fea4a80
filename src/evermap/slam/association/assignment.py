"""Who is who so far: detections with their landmarks, and where everything is. Values that are never changed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from evermap.slam.problem import Estimate, Problem
from evermap.types import BoolArray, FloatArray, IntArray

NOBODY = -1
"""Landmark row of a detection that belongs to none."""

SHARED_M, SHARED_SHARE = 0.02, 0.5
"""Error [m] that no landmark's sightings average out, and the share of a typical sighting's range noise beside it."""


@dataclass(frozen=True, slots=True)
class Assignment:
    """Detections, each of one landmark or of nobody, and an estimate of poses, landmarks and states.

    Attributes:
        measured: the measurements so far; its landmark rows and landmark priors mean nothing.
        landmark_row: (M,) landmark of every detection, `NOBODY` for none; landmarks in the order they were met.
        estimate: where everything is; every landmark has a position.
    """

    measured: Problem
    landmark_row: IntArray
    estimate: Estimate

    @property
    def n_landmarks(self) -> int:
        """How many landmarks there are."""
        return len(self.estimate.landmark)

    @property
    def sightings(self) -> IntArray:
        """(L,) detections of every landmark."""
        return np.bincount(self.landmark_row[self.landmark_row >= 0], minlength=self.n_landmarks)

    @property
    def last_seen_s(self) -> FloatArray:
        """(L,) stamp of the last detection; -inf where there is none."""
        last = np.full(self.n_landmarks, -np.inf)
        seen = self.landmark_row >= 0
        np.maximum.at(last, self.landmark_row[seen], self.measured.stamp_s[self.measured.pose_row[seen]])
        return last

    @property
    def apart(self) -> BoolArray:
        """(L, L) landmarks that were seen in one frame, and so are two."""
        seen = self.landmark_row >= 0
        at = np.zeros((len(self.measured.stamp_s), self.n_landmarks), dtype=np.float32)
        at[self.measured.pose_row[seen], self.landmark_row[seen]] = 1.0
        together: BoolArray = at.T @ at > 0.0
        return together

    def with_shared_errors(self, joint: FloatArray) -> FloatArray:
        """Return the covariance (G, G) of landmarks and states with what sightings from one place have in common.

        A robot that stands still makes the same error a hundred times, and the smoother believes it was a hundredth.
        """
        seen = self.landmark_row >= 0
        sigma_range = self.measured.sigma_given[seen, 0]
        variance = np.full(self.n_landmarks, SHARED_M**2)
        for j in range(self.n_landmarks):
            mine = sigma_range[self.landmark_row[seen] == j]
            variance[j] += (SHARED_SHARE * np.median(mine)) ** 2 if len(mine) else 0.0
        out = joint.copy()
        rows = np.arange(2 * self.n_landmarks)
        out[rows, rows] += np.repeat(variance, 2)
        return out

    def problem(self) -> Problem:
        """Return the least-squares problem of the detections that belong to a landmark."""
        used = np.flatnonzero(self.landmark_row >= 0)
        count = self.n_landmarks
        return replace(
            self.measured,
            pose_row=self.measured.pose_row[used],
            landmark_row=self.landmark_row[used],
            reading=self.measured.reading[used],
            sigma_given=self.measured.sigma_given[used],
            landmark_mean=np.zeros((count, 2)),
            landmark_information=sparse.csr_array((2 * count, 2 * count)),
        )

    def without(self, landmarks: BoolArray) -> Assignment:
        """Return the assignment without some landmarks (L,), their detections unassigned."""
        rank = np.where(landmarks, NOBODY, np.cumsum(~landmarks) - 1)
        return self._renumbered(rank, ~landmarks)

    def merged(self, pairs: list[tuple[int, int]]) -> Assignment:
        """Return the assignment with pairs (younger, older) merged: the older's place, the detections of both."""
        becomes = np.arange(self.n_landmarks)
        for younger, older in sorted(pairs, key=lambda pair: pair[0]):
            becomes[younger] = becomes[older]  # the older one may have been merged itself, with a still older
        kept = becomes == np.arange(self.n_landmarks)
        rank = np.cumsum(kept) - 1
        return self._renumbered(rank[becomes], kept)

    def _renumbered(self, rank: IntArray, kept: BoolArray) -> Assignment:
        row = np.full_like(self.landmark_row, NOBODY)
        seen = self.landmark_row >= 0
        row[seen] = rank[self.landmark_row[seen]]
        estimate = Estimate(self.estimate.pose, self.estimate.landmark[kept], self.estimate.states)
        return Assignment(self.measured, row, estimate)
