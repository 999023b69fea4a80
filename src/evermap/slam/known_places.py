"""A fixed map: known places of landmarks, found by identity and by neighbourhood."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, NamedTuple, Self, TypeVar

import numpy as np

from evermap.align.acceptance import SIGMA_M, accept_alignment
from evermap.align.candidates import Matches, score_motions
from evermap.config import LocalizeConfig
from evermap.geometry import se2
from evermap.geometry.chunked import ChunkedCovariance, JointCovariance, blocks, of_places
from evermap.geometry.group import PLANE, Group
from evermap.slam.batch import sight_at
from evermap.types import BoolArray, FloatArray, IntArray

LEAST_VARIANCE = 1e-6
"""Of a place, m^2: a survey is good to a millimetre."""


class FrameSightings(NamedTuple):
    """Detections of one frame: (M,) landmark_id, (M, 2) range [m] and bearing [rad], (M, 2) sigmas, nan where none."""

    landmark_id: IntArray
    reading: FloatArray
    sigma_given: FloatArray

    @property
    def readable(self) -> BoolArray:
        """(M,) detections with a range and a bearing."""
        return np.asarray(np.all(np.isfinite(self.reading), axis=1))


@dataclass(frozen=True, slots=True)
class KnownPlaces:
    """Places: (P,) rows, sorted by `landmark_id`. A landmark that is known at several sites has one row for each.

    Attributes:
        landmark_id: of each place.
        position_m: (P, 2) in the map's frame.
        covariance_m2: (P, 2, 2) of each by itself.
        p_here: probability that the landmark stands there now; of one landmark they sum to 1 at most.
        joint_m2: covariance of all together; None where they are independent. A map that is bent as a whole is better
            than each of its places alone.
        joint_row: (P,) rows of the places in that.
    """

    landmark_id: IntArray
    position_m: FloatArray
    covariance_m2: FloatArray
    p_here: FloatArray
    joint_m2: JointCovariance | None = None
    joint_row: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __len__(self) -> int:
        return len(self.landmark_id)

    @property
    def value(self) -> FloatArray:
        """(P, 2) the places, as the filter has them."""
        return self.position_m

    @classmethod
    def of(
        cls, landmark_id: IntArray, position_m: FloatArray, covariance_m2: JointCovariance, p_here: FloatArray
    ) -> KnownPlaces:
        """Return the places in any order; the covariance as blocks (P, 2, 2), joint (2 P, 2 P), or in chunks."""
        order = np.argsort(landmark_id, kind="stable")
        dim = position_m.shape[1]
        own = np.ascontiguousarray(blocks(covariance_m2, dim)[order] + LEAST_VARIANCE * np.eye(dim))
        independent = not isinstance(covariance_m2, ChunkedCovariance) and covariance_m2.ndim == 3
        joint = None if independent else covariance_m2
        return cls(landmark_id[order], position_m[order], own, p_here[order], joint, order)

    def existing(self) -> Self:
        """Return those of a probability above 0."""
        rows = np.flatnonzero(self.p_here > 0.0)
        return replace(
            self,
            landmark_id=self.landmark_id[rows],
            position_m=self.position_m[rows],
            covariance_m2=self.covariance_m2[rows],
            p_here=self.p_here[rows],
            joint_row=self.joint_row[rows],
        )

    def joint_of(self, rows: IntArray) -> FloatArray:
        """Return (2 K, 2 K) covariance of some places together."""
        dim = self.position_m.shape[1]
        if self.joint_m2 is None:
            apart, at = np.zeros((len(rows), dim, len(rows), dim)), np.arange(len(rows))
            apart[at, :, at, :] = self.covariance_m2[rows]
            return apart.reshape(dim * len(rows), -1)
        return of_places(self.joint_m2, self.joint_row[rows], dim) + LEAST_VARIANCE * np.eye(dim * len(rows))

    def errors_at(self, rows: IntArray) -> FloatArray:
        """Return (D K, D K) covariance of how far landmarks that stand may lie off places (K,) for a known motion."""
        dim = self.position_m.shape[1]
        spread = np.zeros((0, 0)) if not len(rows) else KnownPlaces.joint_of(self, rows)
        return spread + SIGMA_M**2 * np.eye(dim * len(rows))

    def rows_of(self, landmark_id: IntArray) -> tuple[IntArray, IntArray]:
        """Return the first row of (M,) landmarks, and the one after the last; both equal where the map lacks one."""
        return (
            np.searchsorted(self.landmark_id, landmark_id, side="left"),
            np.searchsorted(self.landmark_id, landmark_id, side="right"),
        )

    def most_probable(self) -> IntArray:
        """Return (L,) row of the most probable place of every landmark, by id."""
        order = np.lexsort((self.p_here, self.landmark_id))
        last = np.append(self.landmark_id[1:] != self.landmark_id[:-1], True)[: len(order)]
        return np.asarray(order[last])


class Neighbourhood:
    """Points (P, 2), and which of them are within reach of a place; all where the reach is inf."""

    def __init__(self, position_m: FloatArray, reach_m: float) -> None:
        from scipy.spatial import cKDTree  # takes a tenth of a second

        self._everything, self._reach = np.arange(len(position_m)), reach_m
        self._tree = cKDTree(position_m) if math.isfinite(reach_m) and len(position_m) else None

    def __call__(self, centre_m: FloatArray) -> IntArray:
        """Rows of all points within reach of (2,), sorted."""
        if self._tree is None:
            return self._everything
        near = self._tree.query_ball_point(centre_m, self._reach, return_sorted=True)
        return np.array(near, dtype=np.int64)


MOST_LANDMARKS = 40
"""That are kept, the newest: more make no surer."""
RETRY_S = 1.0
"""Between two attempts where no other landmark has come into view."""


class Placed(NamedTuple):
    """A pose in the map.

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


Seen = TypeVar("Seen")
"""What a track keeps of a landmark."""


class DriveTrack(ABC, Generic[Seen]):
    """A drive by odometry alone, and what was seen of landmarks during it, in the frame of its first pose.

    Args:
        group: of its poses.
        mount: pose of the sensor, or poses of the sensors, on the robot.
        settings: how long landmarks are kept, and when an alignment is certain.
    """

    def __init__(self, group: Group, mount: FloatArray, settings: LocalizeConfig) -> None:
        self._group, self._mount, self._settings = group, mount, settings
        self._pose = group.identity()
        self._began_s = np.nan
        self._seen: dict[int, tuple[float, Seen]] = {}
        self._tried: tuple[float, frozenset[int]] = (-np.inf, frozenset())

    def drive(self, increment: FloatArray) -> None:
        """Advance the pose by a motion."""
        self._pose = self._group.compose(self._pose, increment)

    def _keep(self, stamp_s: float, names: Sequence[int], seen: Sequence[Seen]) -> None:
        """Add what was seen of landmarks; forget what is too old."""
        if np.isnan(self._began_s):
            self._began_s = stamp_s
        for name, one in zip(names, seen, strict=True):
            self._seen.pop(name, None)
            self._seen[name] = (stamp_s, one)
        old = [name for name, (seen_s, _) in self._seen.items() if seen_s < stamp_s - self._settings.track_s]
        for name in [*old, *list(self._seen)[: max(len(self._seen) - len(old) - MOST_LANDMARKS, 0)]]:
            self._seen.pop(name, None)

    def _was_tried(self, stamp_s: float) -> bool:
        """Return whether no other landmarks were there at the last attempt, a moment before; else this is one."""
        names = frozenset(self._seen)
        if names <= self._tried[1] and stamp_s < self._tried[0] + RETRY_S:
            return True
        self._tried = (stamp_s, names)
        return False

    def _pair(self, places: KnownPlaces) -> tuple[IntArray, IntArray]:
        """Return (K,) which of the landmarks, and (K,) a row of the map: one for every place that each may be at."""
        first, last = places.rows_of(np.fromiter(self._seen, dtype=np.int64))
        count = last - first
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return np.repeat(np.arange(len(first)), count), np.repeat(first, count) + within

    @abstractmethod
    def _candidates(self, places: KnownPlaces) -> tuple[Matches, IntArray]:
        """Return what was seen with the places that it may be of, and rows (K,) of these; weights are beliefs."""

    def agreement(self, pose_map_robot: FloatArray, places: KnownPlaces) -> float:
        """Return how well the track fits the map with the robot at a pose: 1 per landmark exactly at a place."""
        matches = self._candidates(places)[0]
        motion = self._group.compose(pose_map_robot, self._group.inverse(self._pose))[None]
        return float(score_motions(motion, replace(matches, weight=np.ones(len(matches))))[0])


class LocalTrack(DriveTrack[FloatArray]):
    """A drive in the plane: it keeps where landmarks were seen. `mount` is the pose (3,) of the sensor on the robot."""

    def __init__(self, mount: FloatArray, settings: LocalizeConfig) -> None:
        super().__init__(PLANE, mount, settings)

    def see(self, stamp_s: float, seen: FrameSightings, used: IntArray, states: FloatArray) -> None:
        """Add sightings (M,) of landmarks of the map; forget those that are too old."""
        at = sight_at(self._pose, seen.reading[used], states, self._mount)
        self._keep(stamp_s, seen.landmark_id[used].tolist(), list(at))

    def placed(self, stamp_s: float, places: KnownPlaces) -> Placed | None:
        """Align the drive with the map; None if that is uncertain, or was tried before with the same landmarks."""
        settings, count = self._settings, len(self._seen)
        alone = stamp_s - self._began_s >= settings.alone_s
        least = 2 if alone and count == 2 else settings.fewest
        if count < least or self._was_tried(stamp_s):
            return None
        matches, row = self._candidates(places)
        spread = places.errors_at(row)
        found = accept_alignment(
            matches, settings, fewest=least, spread_m=settings.spread_online_m, covariance_m2=spread
        )
        if not found:
            return None
        motion, agree = found.motion, found.agree
        return Placed(se2.compose(motion, self._pose), *self._uncertainty(motion[2], matches.source[agree], row[agree]))

    def _candidates(self, places: KnownPlaces) -> tuple[Matches, IntArray]:
        """Return what was seen with the places that it may be of, and rows (K,) of these; weights are beliefs."""
        of, row = self._pair(places)
        local = np.array([position for _, position in self._seen.values()]).reshape(-1, 2)[of]
        weight = np.maximum(places.p_here[row], self._settings.least_belief)
        return Matches.of(local, places.position_m[row], landmark=places.landmark_id[row], weight=weight), row

    def _uncertainty(
        self, turn_rad: float, local: FloatArray, rows: IntArray
    ) -> tuple[FloatArray, IntArray, FloatArray]:
        """Return the covariance of the aligned pose, with agreeing landmarks (n, 2); see `Placed`."""
        arm = local - local.mean(axis=0)
        size = max((arm**2).sum(), self._settings.spread_online_m**2)
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
