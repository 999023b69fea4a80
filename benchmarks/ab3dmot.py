"""The peer of the tracker on boxes: AB3DMOT (Weng, Wang, Held, Kitani, IROS 2020), from its paper.

A Kalman filter of constant velocity on the box `x, y, z, heading, length, width, height` and the velocity of the
centre; an assignment of least total cost by the generalised overlap of boxes or the distance of their centres; births
after a few detections in a row, and death after a few frames without. Numbers of the method are those that its authors
use for PointRCNN on KITTI. Boxes are in the world: the odometry is given to both trackers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmarks.overlap import corners, overlap
from evermap.types import FloatArray, IntArray

_TRANSITION = np.eye(10)
_TRANSITION[:3, 7:] = np.eye(3)
_SEEN = np.eye(7, 10)
_NOISE = np.eye(7)
_FIRST = np.diag([10.0] * 7 + [10000.0] * 3)
_DRIFT = np.diag([1.0] * 7 + [0.01] * 3)


class Peer(NamedTuple):
    """How a class is associated: by `giou` or `distance` above or below a threshold, greedily or jointly."""

    metric: str
    threshold: float
    greedy: bool
    min_hits: int
    max_age: int
    least_score: float


CLASSES = {
    "Car": Peer("giou", -0.2, greedy=False, min_hits=3, max_age=2, least_score=3.240738),
    "Pedestrian": Peer("giou", -0.4, greedy=True, min_hits=1, max_age=4, least_score=2.683133),
    "Cyclist": Peer("distance", 2.0, greedy=False, min_hits=3, max_age=4, least_score=3.645319),
}
"""By class; `least_score` is the mean score from which a track counts where one answer is asked for."""


@dataclass(slots=True)
class _Track:
    track_id: int
    mean: FloatArray
    covariance: FloatArray
    score: float
    hits: int = 1
    missed: int = 0


def generalised_overlap(a: FloatArray, b: FloatArray) -> FloatArray:
    """(N, M) generalised intersection over union of boxes (Rezatofighi 2019), the hull upright around both."""
    from scipy.spatial import ConvexHull

    iou = overlap(a, b)
    found = np.full(iou.shape, -1.0)
    volume_a, volume_b = a[:, 3:6].prod(axis=1), b[:, 3:6].prod(axis=1)
    near = np.hypot(*(a[:, None, :2] - b[None, :, :2]).transpose(2, 0, 1)) < 20.0
    for i, j in zip(*np.nonzero(near), strict=True):
        points = np.empty((8, 2))
        corners(a[i], points[:4])
        corners(b[j], points[4:])
        tall = max(a[i, 2] + a[i, 5] / 2, b[j, 2] + b[j, 5] / 2) - min(a[i, 2] - a[i, 5] / 2, b[j, 2] - b[j, 5] / 2)
        hull = ConvexHull(points).volume * tall
        both = (volume_a[i] + volume_b[j]) / (1.0 + iou[i, j])
        found[i, j] = iou[i, j] - (hull - both) / hull
    return found


class Ab3dmot:
    """Tracks of one class.

    Args:
        settings: of the class.
    """

    def __init__(self, settings: Peer) -> None:
        self._settings = settings
        self._tracks: list[_Track] = []
        self._next, self._n_frames = 0, 0

    def step(self, box: FloatArray, score: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Take in boxes (M, 7) and scores of a frame; return ids, boxes and scores of what is reported."""
        self._n_frames += 1
        for t in self._tracks:
            t.mean = _TRANSITION @ t.mean
            t.covariance = _TRANSITION @ t.covariance @ _TRANSITION.T + _DRIFT
            t.missed += 1
        expected = np.array([t.mean[_TO_BOX] for t in self._tracks]).reshape(-1, 7)
        pairs = self._match(box, expected)
        for j, i in pairs:
            self._update(self._tracks[i], box[j], float(score[j]))
        for j in sorted(set(range(len(box))) - {j for j, _ in pairs}):
            mean = np.concatenate([box[j][_FROM_BOX], np.zeros(3)])
            self._tracks.append(_Track(self._next, mean, _FIRST.copy(), float(score[j])))
            self._next += 1
        s = self._settings
        told = [
            t for t in self._tracks if t.missed < s.max_age and (t.hits >= s.min_hits or self._n_frames <= s.min_hits)
        ]
        self._tracks = [t for t in self._tracks if t.missed < s.max_age]
        return (
            np.array([t.track_id for t in told], dtype=np.int64),
            np.array([t.mean[_TO_BOX] for t in told]).reshape(-1, 7),
            np.array([t.score for t in told]),
        )

    def _match(self, box: FloatArray, expected: FloatArray) -> list[tuple[int, int]]:
        s = self._settings
        if len(box) == 0 or len(expected) == 0:
            return []
        if s.metric == "giou":
            gain, least = generalised_overlap(box, expected), s.threshold
        else:
            gain = -np.linalg.norm(box[:, None, :3] - expected[None, :, :3], axis=2)
            least = -s.threshold
        if not s.greedy:
            rows, columns = linear_sum_assignment(-gain)
            return [(i, j) for i, j in zip(rows.tolist(), columns.tolist(), strict=True) if gain[i, j] >= least]
        found: list[tuple[int, int]] = []
        for flat in np.argsort(-gain, axis=None).tolist():
            i, j = divmod(flat, gain.shape[1])
            if gain[i, j] >= least and all(i != p and j != q for p, q in found):
                found.append((i, j))
        return found

    @staticmethod
    def _update(t: _Track, box: FloatArray, score: float) -> None:
        """Turn the filter's heading to the detection's where they are opposite, then update."""
        seen = box[_FROM_BOX].copy()
        seen[3], t.mean[3] = _wrapped(seen[3]), _wrapped(t.mean[3])
        if np.pi / 2 < abs(seen[3] - t.mean[3]) < 1.5 * np.pi:
            t.mean[3] = _wrapped(t.mean[3] + np.pi)
        if abs(seen[3] - t.mean[3]) >= 1.5 * np.pi:
            t.mean[3] += 2 * np.pi if seen[3] > 0 else -2 * np.pi
        gain = t.covariance @ _SEEN.T @ np.linalg.inv(_SEEN @ t.covariance @ _SEEN.T + _NOISE)
        t.mean = t.mean + gain @ (seen - _SEEN @ t.mean)
        t.covariance = t.covariance - gain @ _SEEN @ t.covariance
        t.score, t.hits, t.missed = score, t.hits + 1, 0


_FROM_BOX = [0, 1, 2, 6, 3, 4, 5]
_TO_BOX = [0, 1, 2, 4, 5, 6, 3]


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
