"""A map that is not estimated: where landmarks are known to stand, found by name and by neighbourhood."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evermap.geometry import se2
from evermap.types import FloatArray, IntArray, Landmarks

LEAST_VARIANCE = 1e-6
"""Of a place, m^2: a survey is good to a millimetre."""


@dataclass(frozen=True, slots=True)
class KnownPlaces:
    """Places: (P,) rows, sorted by `landmark_id`. A landmark that is known at several sites has one row for each.

    Attributes:
        landmark_id: whose place.
        position_m: (P, 2) in the map's frame.
        covariance_m2: (P, 2, 2) of each by itself.
        p_here: probability that the landmark stands there now; of one landmark they sum to 1 at most.
        joint_m2: (2 P, 2 P) covariance of all together, x and y by turns; None where the places are independent. A map
            that is bent as a whole is better than each of its places alone.
    """

    landmark_id: IntArray
    position_m: FloatArray
    covariance_m2: FloatArray
    p_here: FloatArray
    joint_m2: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.landmark_id)

    @classmethod
    def of(
        cls, landmark_id: IntArray, position_m: FloatArray, covariance_m2: FloatArray, p_here: FloatArray
    ) -> KnownPlaces:
        """Places in any order; the covariance as blocks (P, 2, 2) or joint (2 P, 2 P)."""
        order = np.argsort(landmark_id, kind="stable")
        joint = None
        if covariance_m2.ndim == 2:
            corner = se2.xy_rows(order)
            joint = covariance_m2[np.ix_(corner, corner)] + LEAST_VARIANCE * np.eye(len(corner))
            rows = np.arange(len(order))
            blocks = joint.reshape(len(rows), 2, len(rows), 2)[rows, :, rows, :]
        else:
            blocks = covariance_m2[order] + LEAST_VARIANCE * np.eye(2)
        return cls(landmark_id[order], position_m[order], np.ascontiguousarray(blocks), p_here[order], joint)

    @classmethod
    def from_landmarks(cls, landmarks: Landmarks) -> KnownPlaces:
        """Records of a map; here, other than elsewhere, a landmark may have several."""
        return cls.of(landmarks.landmark_id, landmarks.position_m, landmarks.covariance_m2, landmarks.p_exists)

    def rows_of(self, landmark_id: IntArray) -> tuple[IntArray, IntArray]:
        """First row of each of (M,) landmarks, and the one after its last; both equal where the map lacks it."""
        return (
            np.searchsorted(self.landmark_id, landmark_id, side="left"),
            np.searchsorted(self.landmark_id, landmark_id, side="right"),
        )

    def most_probable(self) -> IntArray:
        """(L,) row of the most probable place of every landmark, by id."""
        order = np.lexsort((self.p_here, self.landmark_id))
        last = np.append(self.landmark_id[1:] != self.landmark_id[:-1], True)[: len(order)]
        rows: IntArray = order[last]
        return rows


class Neighbourhood:
    """Points by cells of the floor, so that those near a position cost what is near it and not what there is.

    Args:
        position_m: (P, 2).
        reach_m: how far 'near' is; inf for everywhere.
    """

    def __init__(self, position_m: FloatArray, reach_m: float) -> None:
        self._position, self._reach = position_m, reach_m
        self._everything = np.arange(len(position_m))
        if not math.isfinite(reach_m) or not len(position_m):
            return
        self._side = max(0.5 * reach_m, 0.1)
        self._low = position_m.min(axis=0)
        cell = np.floor((position_m - self._low) / self._side).astype(np.int64)
        self._columns, self._height = cell.max(axis=0) + 1
        key = cell[:, 0] * self._height + cell[:, 1]
        self._order = np.argsort(key, kind="stable")
        self._key = key[self._order]

    def __call__(self, centre_m: FloatArray) -> IntArray:
        """Rows of all points within reach of (2,), sorted."""
        if not math.isfinite(self._reach) or not len(self._position):
            return self._everything
        first = np.floor((centre_m - self._reach - self._low) / self._side)
        last = np.floor((centre_m + self._reach - self._low) / self._side)
        left, right = max(int(first[0]), 0), min(int(last[0]), int(self._columns) - 1)
        below, above = max(int(first[1]), 0), min(int(last[1]), int(self._height) - 1)
        if left > right or below > above:
            return self._everything[:0]
        column = np.arange(left, right + 1) * self._height
        begin = np.searchsorted(self._key, column + below, side="left")
        end = np.searchsorted(self._key, column + above, side="right")
        rows = np.sort(np.concatenate([self._order[a:b] for a, b in zip(begin, end, strict=True)]))
        away = self._position[rows] - centre_m
        near: IntArray = rows[(away * away).sum(axis=1) <= self._reach**2]
        return near
