"""Noise levels in space, learned frame by frame from innovations: scores of their likelihood over its information.

An innovation r of covariance `S = H P H' + R`, with `V = S^-1` and `p = V r`, has for the logarithm of a standard
deviation the score `(p' S_i p - tr(V S_i)) / 2` and the information `tr(V S_i V S_i) / 2`, where S_i is the derivative
of S: twice the rows of the detections of a level, or twice what the odometry since the last frame added. Steps by the
score over the information so far are asymptotically as good as maximum likelihood (Fisher scoring); how P follows from
earlier levels is left out.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from evermap.config import SpaceConfig
from evermap.geometry import se3
from evermap.slam.local_filter import FrameInnovations
from evermap.slam.space.linearise import ACROSS, ALONG, CORNERS, ORIENTATION, PIXEL, ROTATION, TRANSLATION
from evermap.slam.space.problem import SpatialNoise
from evermap.types import FloatArray, IntArray

LARGEST_STEP = 0.5
"""Of the logarithm of a level, in one frame."""
MOST_NUMBERS = 5e3
"""What levels were learned from counts for so many numbers at most: they may change."""
LARGEST_SQUARE = 4.0
"""Of innovations over their variance, a number: beyond, a wrong identity or a jump of the odometry counts no more."""
OF_ROW = np.array([ACROSS, ACROSS, ALONG, ORIENTATION, ORIENTATION, ORIENTATION, PIXEL, PIXEL])


class OnlineNoise:
    """Noise levels as they are known now; without odometry, `driven` False, only those of detections are learned."""

    def __init__(self, start: SpatialNoise, settings: SpaceConfig, *, driven: bool) -> None:
        self.now, self._driven, self._least = start, driven, np.array(settings.least_noise)
        self._information = np.full(len(start.levels), 2.0 * settings.pseudo_count)
        self._since = np.zeros((2, 6, 6))

    def drive(self, increment: FloatArray, covariance: FloatArray) -> None:
        """Add what the odometry of a motion (7,) adds to the covariance of the pose: (6, 6), diagonal."""
        carry = se3.adjoint(se3.inverse(increment))
        self._since = carry @ self._since @ carry.T
        self._since[0, :3, :3] += covariance[:3, :3]
        self._since[1, 3:, 3:] += covariance[3:, 3:]

    def forget_motion(self) -> None:
        """Begin anew: the pose came from elsewhere."""
        self._since = np.zeros((2, 6, 6))

    def learn(self, before: FrameInnovations, weight: FloatArray, kind: IntArray) -> None:
        """Learn from the innovations of a frame.

        Args:
            before: of M detections.
            weight: (M,) of them; outliers are left out, unless most are.
            kind: (M,) of them.
        """
        spread, residual, by_pose, n_rows = before
        used = weight > 0.5
        if 2 * np.count_nonzero(used) < len(used):
            used[:] = True
        column = np.arange(residual.shape[1])
        at = np.flatnonzero((used[:, None] & (column < n_rows[:, None])).ravel())
        covariance, innovation = spread[np.ix_(at, at)] + np.eye(len(at)), residual.ravel()[at]
        inverse = cho_solve(cho_factor(covariance, lower=True), np.eye(len(at)))
        pull = inverse @ innovation
        square = np.bincount(at // len(column), pull * innovation, minlength=len(weight))
        share = np.minimum(1.0, LARGEST_SQUARE * n_rows / np.maximum(np.abs(square), 1e-12))[at // len(column)]
        of_row = np.where(kind[:, None] == CORNERS, PIXEL, OF_ROW[: len(column)]).ravel()[at]
        step = np.zeros(len(self._information))
        for level in np.unique(of_row).tolist():
            mine = of_row == level
            score = float((share * pull**2 - np.diag(inverse))[mine].sum())
            step[level] = self._scale_levels(level, score, 2.0 * float((inverse[np.ix_(mine, mine)] ** 2).sum()))
        if self._driven:
            by = by_pose.reshape(-1, 6)[at]
            told, known = by.T @ (np.sqrt(share) * pull), by.T @ inverse @ by
            motion = float(told @ np.linalg.pinv(known, hermitian=True) @ told)
            told *= np.sqrt(min(1.0, 6.0 * LARGEST_SQUARE / max(motion, 1e-12)))
            for level, since in zip((TRANSLATION, ROTATION), self._since, strict=True):
                score = float(told @ since @ told - np.trace(known @ since))
                step[level] = self._scale_levels(level, score, 2.0 * float(np.trace(known @ since @ known @ since)))
        self.now = SpatialNoise(*np.maximum(self.now.levels * np.exp(step), self._least).tolist())

    def _scale_levels(self, level: int, score: float, information: float) -> float:
        self._information[level] = min(self._information[level], 2.0 * MOST_NUMBERS) + information
        return float(np.clip(score / self._information[level], -LARGEST_STEP, LARGEST_STEP))
