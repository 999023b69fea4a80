"""What problems in the plane and in space share: instants of poses, detections of places, further measurements."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from evermap.estimate.measurement import Tied
from evermap.slam.correlation import Lasting, Pull, lasting_errors, sum_by_stretches, variance_of_clusters
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseProblem(ABC):
    """All measurements and priors; a subclass says what a detection is, and what is believed.

    Attributes:
        COLUMNS: names of what has a row for each detection.
        stamp_s: (N,) instants of the poses.
        pose_row: (M,) which pose made each detection; sorted.
        measurements: of other kinds than odometry and detections.
    """

    COLUMNS: ClassVar[tuple[str, ...]]

    stamp_s: FloatArray
    pose_row: IntArray
    measurements: tuple[Tied, ...] = ()

    @property
    @abstractmethod
    def seen_place(self) -> IntArray:
        """(M,) which place each detection is of."""

    @property
    def seen_s(self) -> FloatArray:
        """(M,) when each detection was made."""
        return self.stamp_s[self.pose_row]

    def detections_of(self, pose: int) -> IntArray:
        """Return the rows of the detections of a pose."""
        first, last = self.pose_row.searchsorted((pose, pose + 1)).tolist()
        return np.arange(first, last)

    def seeing(self, rows: IntArray | BoolArray | slice) -> Self:
        """Return the problem with some of its detections only."""
        some: dict[str, Any] = {}
        for name in self.COLUMNS:
            column: FloatArray | None = getattr(self, name)
            some[name] = None if column is None else column[rows]
        return replace(self, **some)

    def stretches(self, count: int) -> IntArray:
        """Return (N,) which of so many stretches of the recording, equally long, each pose is in."""
        since_s = self.stamp_s - self.stamp_s[0]
        return np.asarray(np.minimum((since_s / max(since_s[-1], 1e-9) * count).astype(np.int64), count - 1))

    def lasting(self, residual: FloatArray, weight: FloatArray) -> Lasting:
        """Return how long errors of detections last, by whitened residuals (M, D) and inlier weights (M,)."""
        return lasting_errors(residual, weight, self.seen_s, self.seen_place)

    def correlated_variance(
        self, odometry: Pull, detections: Pull, lasting: Lasting, stretches: int, clusters: float | None = None
    ) -> FloatArray:
        """Return (S,) variances of estimates under errors that are correlated, the larger of two.

        By `stretches` of the recording, which err independently of each other, as `variance_of_clusters` counts them;
        and by errors of detections that are known to last.
        """
        by_stretch = sum_by_stretches((odometry, detections), self.stretches(stretches), stretches)
        alike = lasting.variance_beside(detections.influence, self.seen_s, self.seen_place)
        independent = odometry.variance + detections.variance
        return np.asarray(np.maximum(variance_of_clusters(by_stretch, clusters), independent + alike))

    def new_information(self, lasting: Lasting) -> FloatArray:
        """Return (M,) shares of the information of detections that are new, beside others of their places."""
        return lasting.information(self.seen_s, self.seen_place)
