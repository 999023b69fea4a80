"""Online mapping of an unmapped place in space: the filter of the newest pose and the places nearby, frame by frame.

A session is solved as a whole when it ends; until then the robot is where the filter has it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.config import SpaceConfig
from evermap.geometry import se3
from evermap.geometry.symmetry import Symmetry
from evermap.slam.local_filter import BY_OTHERS
from evermap.slam.localize import Located
from evermap.slam.nearby_places import NO_PLACES
from evermap.slam.space.linearise import CORNERS, POINT
from evermap.slam.space.local_filter import SpatialFilter, SpatialFrame, SpatialMotion
from evermap.slam.space.problem import OdometryPath, SpatialNoise
from evermap.types import UNKNOWN, FloatArray, IntArray, Landmarks

START_M, START_RAD = 1e-4, 1e-4
"""Standard deviations of the first pose: the map begins there."""
CERTAIN_NATS = 2.0
"""By which one explanation of a single tag must be more probable than the other."""


class SpatialMapper:
    """Feed frames in order with `step`; arguments as of `SpatialLocalizer`.

    A tag whose view has two explanations is entered when one of them is clearly the better.
    """

    def __init__(
        self,
        mount: FloatArray,
        sigma: FloatArray,
        noise: SpatialNoise,
        symmetries: tuple[Symmetry, ...],
        space: SpaceConfig,
    ) -> None:
        self._local, self.noise, self._space = SpatialFilter(mount, sigma, noise, symmetries), noise, space
        self._row: dict[int, int] = {}
        self._stamp_s: float | None = None
        start = np.zeros((self._local.own, self._local.own))
        start[6:, 6:] = self._local.covariance[6:, 6:]
        start[:6, :6] = np.diag(np.repeat([START_M, START_RAD], 3) ** 2)
        self._local.hold(se3.identity(), self._local.states, start, NO_PLACES, np.zeros((0, 7)))

    @property
    def states(self) -> FloatArray:
        """(6 S + 1,) states of the mounts and of the odometry's scale."""
        return self._local.states.copy()

    def step(self, stamp_s: float, drive: OdometryPath, seen: SpatialFrame) -> Located:
        """Process a frame; one without a known landmark only predicts by odometry.

        Args:
            stamp_s: of the frame, on the clock of the odometry, later than the last one.
            drive: odometry since the last frame at least.
            seen: its detections.

        Returns:
            Without places: the map is what is estimated.
        """
        local = self._local
        if self._stamp_s is not None:
            local.drive(SpatialMotion.over(drive, self._stamp_s, stamp_s, local.log_scale, self.noise))
        self._stamp_s = stamp_s
        named = np.flatnonzero(seen.readable & (seen.landmark_id != UNKNOWN))
        known = np.array([name in self._row for name in seen.landmark_id[named].tolist()], dtype=np.bool_)
        met, new = named[known], named[~known]
        if len(met):
            rows = np.array([self._row[name] for name in seen.landmark_id[met].tolist()], dtype=np.int64)
            local.bring(rows)
            kind = np.where(np.isfinite(local.position[rows, 3]), seen.kind[met], POINT)
            odds = np.array(self._space.outlier_log_odds)[kind]
            local.update(rows, seen.rows(met), weighing=BY_OTHERS, log_odds=odds)
        for m in new.tolist():
            self._meet(m, seen)
        none, nothing = np.zeros(0, dtype=np.int64), np.full(len(seen.landmark_id), np.nan)
        place, no = np.full(len(nothing), UNKNOWN, dtype=np.int64), none.astype(np.bool_)
        pose, covariance = local.pose.copy(), local.covariance[:6, :6].copy()
        return Located(pose, covariance, place, nothing, nothing, none, np.zeros(0), no, lost=False)

    def ahead(self, stamp_s: float, drive: OdometryPath) -> tuple[FloatArray, FloatArray]:
        """Return the pose (7,) at a later instant by odometry alone, and its covariance; nan before any frame."""
        if self._stamp_s is None:
            return np.full(7, np.nan), np.full((6, 6), np.nan)
        motion = SpatialMotion.over(drive, self._stamp_s, stamp_s, self._local.log_scale, self.noise)
        return self._local.ahead(motion)

    def landmarks(self, landmark_id: IntArray, p_exists: float) -> Landmarks:
        """Return those of some landmarks of the newest frame that are known, each with a probability that it exists."""
        known = [name for name in np.unique(landmark_id).tolist() if name in self._row]
        rows = np.array([self._row[name] for name in known], dtype=np.int64)
        local, turned = self._local, np.isfinite(self._local.position[rows, 3])
        own = local.spread(rows)
        onto = np.tile(np.eye(3), (len(rows), 1, 1))
        onto[turned] = se3.rotation_of(local.position[rows[turned]])
        found = Landmarks.in_space(known, local.position[rows, :3], rotation=local.position[rows, 3:])
        covariance = onto @ own[:, :3, :3] @ onto.swapaxes(1, 2)
        return replace(found, covariance_m2=covariance, p_exists=np.full(len(known), p_exists), frame="first_pose")

    def _meet(self, which: int, seen: SpatialFrame) -> None:
        """Store the place of a landmark that is seen for the first time."""
        name = int(seen.landmark_id[which])
        by_corners = seen.kind[which] == CORNERS
        is_alone = np.array_equal(seen.either[0, which], seen.either[1, which])
        if by_corners and not is_alone and seen.other_log_odds[which] < CERTAIN_NATS * self.noise.pixel**2:
            return
        if name in self._row:  # twice in this frame
            return
        oriented = bool(seen.kind[which] != POINT and seen.symmetry[which] == 0)
        self._row[name] = len(self._row)
        self._local.sight(self._row[name], *self._local.place_of(seen, which, oriented=oriented))
