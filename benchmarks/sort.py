"""The peer of the tracker: a plain SORT (Bewley et al. 2016), in space and in whole arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.types import BoolArray, FloatArray, IntArray

GATE = 21.1
"""Squared Mahalanobis distance in three dimensions that one detection of an object in ten thousand exceeds."""
N_CONFIRM = 3


class Reports(NamedTuple):
    """What the peer follows after a frame: (N,) ids, (N, 3) positions, (N,) confirmed, (N,) frames in a row missed."""

    track_id: IntArray
    position_m: FloatArray
    confirmed: BoolArray
    n_missed: IntArray


class Sort:
    """Kalman filters of constant velocity, and a dense assignment by Mahalanobis distance.

    Its costs have `log det S`, without which young tracks steal detections. A track is confirmed by three detections.

    Args:
        frame_s: time between two frames.
        sigma_m: noise of a detection, each axis.
        max_age: frames in a row without a detection after which a track is given up.
    """

    def __init__(self, frame_s: float, sigma_m: float, max_age: int) -> None:
        self._max_age = max_age
        one = np.eye(3)
        self._transition = np.kron([[1.0, frame_s], [0.0, 1.0]], one)
        self._drift = 0.1 * np.kron([[frame_s**3 / 3.0, frame_s**2 / 2.0], [frame_s**2 / 2.0, frame_s]], one)
        self._noise = sigma_m**2 * one
        self._first = np.diag([sigma_m**2] * 3 + [1.0] * 3)
        self._mean, self._covariance = np.empty((0, 6)), np.empty((0, 6, 6))
        self._id, self._hits, self._missed = (np.empty(0, dtype=np.int64) for _ in range(3))
        self._next = 0

    def step(self, detected_m: FloatArray) -> Reports:
        """Take in a frame, and say what is followed."""
        from scipy.optimize import linear_sum_assignment

        self._mean = self._mean @ self._transition.T
        self._covariance = self._transition @ self._covariance @ self._transition.T + self._drift
        s = self._covariance[:, :3, :3] + self._noise
        inverse = np.linalg.inv(s)
        off = detected_m - self._mean[:, None, :3]
        squared = np.einsum("nmi,nmi->nm", off @ inverse, off)
        near = squared < GATE
        cost = np.where(near, squared + np.linalg.slogdet(s)[1][:, None], 1e6)
        track, detection = linear_sum_assignment(cost)
        matched = near[track, detection]
        track, detection = track[matched], detection[matched]

        gain = self._covariance[track, :, :3] @ inverse[track]
        self._mean[track] += np.einsum("nij,nj->ni", gain, off[track, detection])
        self._covariance[track] -= gain @ self._covariance[track, :3]
        self._missed += 1
        self._missed[track] = 0
        self._hits[track] += 1
        self._keep(self._missed <= np.where(self._hits >= N_CONFIRM, self._max_age, 1))
        self._begin(np.delete(detected_m, detection, axis=0))
        return Reports(self._id, self._mean[:, :3].copy(), self._hits >= N_CONFIRM, self._missed.copy())

    def _keep(self, rows: BoolArray) -> None:
        for name in ("_mean", "_covariance", "_id", "_hits", "_missed"):
            setattr(self, name, getattr(self, name)[rows])

    def _begin(self, detected_m: FloatArray) -> None:
        n = len(detected_m)
        self._mean = np.vstack([self._mean, np.hstack([detected_m, np.zeros((n, 3))])])
        self._covariance = np.concatenate([self._covariance, np.repeat(self._first[None], n, axis=0)])
        self._id = np.concatenate([self._id, self._next + np.arange(n)])
        self._hits = np.concatenate([self._hits, np.ones(n, dtype=np.int64)])
        self._missed = np.concatenate([self._missed, np.zeros(n, dtype=np.int64)])
        self._next += n
