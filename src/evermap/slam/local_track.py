"""Where in the map is the robot? What it saw during a short drive, laid over the map as one piece."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.geometry import se2
from evermap.geometry.rigid import AGREE_M, consensus
from evermap.slam.known_places import KnownPlaces
from evermap.slam.triangulate import sighted_at
from evermap.types import FloatArray, IntArray

MEMORY_S = 30.0
"""Sightings that are older have drifted too far from the newest."""
MOST_LANDMARKS = 40
"""That are kept, the newest: more make no surer."""
RETRY_S = 1.0
"""Between two attempts where no other landmark has come into view."""
AGREEING = 3
ALONE_S = 10.0
"""Landmarks that must stand to each other as in the map; where no third one comes into view for a while, two do."""
ENOUGH = 5
"""So many agree by no accident, even if they are fewer than half."""
MIN_SPREAD_M = 2.0
"""Farther apart than what stands on one body, which moves as one."""
SIGMA_M = 0.5 * AGREE_M
"""Of one landmark of the drive, laid over the map."""
LEAST_BELIEF = 0.05
"""What stands where it is known to have stood is there, whatever was believed."""


class Placed(NamedTuple):
    """A place in the map.

    Attributes:
        pose: (3,) of the robot.
        covariance: (3, 3) of it, in the robot's frame, if the map were right.
        rows: (n,) places of the map at which landmarks of the drive stand then.
        by_places: (3, 2 n) how far the pose, in its own frame, follows these places.
    """

    pose: FloatArray
    covariance: FloatArray
    rows: IntArray
    by_places: FloatArray


class LocalTrack:
    """A drive by odometry alone, and where landmarks were seen during it, in the frame of its first pose.

    Args:
        mount: (3,) pose of the sensor on the robot.
    """

    def __init__(self, mount: FloatArray) -> None:
        self._mount = mount
        self._pose = np.zeros(3)
        self._began_s = np.nan
        self._seen: dict[int, tuple[float, FloatArray]] = {}
        self._tried: tuple[float, frozenset[int]] = (-np.inf, frozenset())

    def drive(self, increment: FloatArray) -> None:
        """On by (3,)."""
        self._pose = se2.compose(self._pose, increment)

    def see(self, stamp_s: float, landmark_id: IntArray, reading: FloatArray, states: FloatArray) -> None:
        """Landmarks of the map in range and bearing (M, 2); what was seen too long ago is forgotten."""
        if np.isnan(self._began_s):
            self._began_s = stamp_s
        at = sighted_at(self._pose, reading, states, self._mount)
        for name, position in zip(landmark_id.tolist(), at, strict=True):
            self._seen.pop(name, None)
            self._seen[name] = (stamp_s, position)
        old = [name for name, (seen_s, _) in self._seen.items() if seen_s < stamp_s - MEMORY_S]
        for name in [*old, *list(self._seen)[: max(len(self._seen) - len(old) - MOST_LANDMARKS, 0)]]:
            self._seen.pop(name, None)

    def placed(self, stamp_s: float, places: KnownPlaces) -> Placed | None:
        """Lay the drive over the map; None where that is not sure, or was tried before with the same landmarks."""
        names = frozenset(self._seen)
        alone = stamp_s - self._began_s >= ALONE_S
        least = 2 if alone and len(names) == 2 else AGREEING
        if len(names) < least or (names <= self._tried[1] and stamp_s < self._tried[0] + RETRY_S):
            return None
        self._tried = (stamp_s, names)
        local, row = self._candidates(places)
        landmark = places.landmark_id[row]
        belief = np.maximum(places.p_here[row], LEAST_BELIEF)
        motion, agree = consensus(local, places.position_m[row], landmark=landmark, weight=belief)
        count = int(agree.sum())
        if count < least or not (2 * count > len(names) or count >= ENOUGH):
            return None
        if np.ptp(local[agree], axis=0).max() < MIN_SPREAD_M:
            return None
        return Placed(se2.compose(motion, self._pose), *self._uncertainty(motion[2], local[agree], row[agree]))

    def agreement(self, pose_map_robot: FloatArray, places: KnownPlaces) -> float:
        """How well its landmarks fit the map if the robot is at a pose (3,): 1 for each that is exactly at a place."""
        local, row = self._candidates(places)
        motion = se2.compose(pose_map_robot, se2.inverse(self._pose))
        gap = np.linalg.norm(se2.transform(motion, local) - places.position_m[row], axis=1)
        fit = np.zeros(len(self._seen))
        _, name = np.unique(places.landmark_id[row], return_inverse=True)
        np.maximum.at(fit, name, 1.0 - (gap / AGREE_M) ** 2)
        return float(fit.sum())

    def _candidates(self, places: KnownPlaces) -> tuple[FloatArray, IntArray]:
        """(K, 2) positions in the track and (K,) rows of the map, one pair for every place a landmark may be at."""
        first, last = places.rows_of(np.fromiter(self._seen, dtype=np.int64))
        count = last - first
        local = np.array([position for _, position in self._seen.values()]).reshape(-1, 2)
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return np.repeat(local, count, axis=0), np.repeat(first, count) + within

    def _uncertainty(
        self, turn_rad: float, local: FloatArray, rows: IntArray
    ) -> tuple[FloatArray, IntArray, FloatArray]:
        """Of the pose, the drive having been turned into the map, where landmarks (n, 2) agree; see `Placed`."""
        arm = local - local.mean(axis=0)
        size = max((arm**2).sum(), MIN_SPREAD_M**2)
        away = se2.rotation(self._pose[2]).T @ (self._pose[:2] - local.mean(axis=0))
        by = np.array([[1.0, 0.0, -away[1]], [0.0, 1.0, away[0]], [0.0, 0.0, 1.0]])
        share = np.full(len(local), 1.0 / len(local))
        by_turned = np.array([[share, 0.0 * share], [0.0 * share, share], [-arm[:, 1] / size, arm[:, 0] / size]])
        # shares are told in the drive's frame for translations in the robot's: first from the map's to the drive's
        to_robot, to_drive = se2.rotation(-self._pose[2]), se2.rotation(-turn_rad)
        by_turned[:2] = np.einsum("ab,bcn->acn", to_robot, by_turned[:2])
        by_places = np.einsum("ab,bcn,cd->and", by, by_turned, to_drive).reshape(3, -1)
        own = SIGMA_M**2 * np.array([1.0 / len(local), 1.0 / len(local), 1.0 / size])
        return by @ np.diag(own) @ by.T, rows, by_places
