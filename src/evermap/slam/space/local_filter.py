"""The local filter in space: detections of points, tags and objects, and what a turn does to these.

Detections are linearised by the kernel of the smoother (`linearise_sightings`), so the measurement equations are
written once. Points have three numbers in the covariance beside which three are zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.estimate.robust import HEAVY_TAIL
from evermap.geometry import se3
from evermap.geometry.group import SPACE
from evermap.geometry.symmetry import Symmetry
from evermap.slam.kernels import kernel
from evermap.slam.local_filter import LocalFilter, Motion
from evermap.slam.nearby_places import MOST_ACTIVE
from evermap.slam.space.linearise import (
    ACROSS,
    ALONG,
    MOUNT,
    OF_SIGHTING,
    POINT,
    ROWS,
    SpatialSightings,
    linearise_sightings,
)
from evermap.slam.space.problem import OdometryPath, SpatialNoise
from evermap.types import BoolArray, FloatArray, IntArray

OF_PLACE = 6
"""Columns of a place in the covariance; of a point the last three are zero."""
BY_PLACE, WIDTH = 6 + MOUNT, 6 + MOUNT + OF_PLACE
"""In what a detection depends on, pose, mount of its sensor and place: where the latter begins, and all."""
STILL = np.append(np.zeros(3), se3.NO_TURN)
NEVER = 1e9
"""Log odds of an outlier for the kernel: the filter weighs by itself."""


class SpatialFrame(NamedTuple):
    """Detections of one frame in space: (M,) rows; see `SpatialProblem` for those of its attributes.

    Attributes:
        landmark_id: identities.
        readable: from which a position follows.
        either: (2, M, 7) both explanations; the first twice where there is one only.
        symmetry: (M,) row of the turns after which the landmark looks the same, by its class; 0 without any.
    """

    landmark_id: IntArray
    readable: BoolArray
    sensor: IntArray
    kind: IntArray
    either: FloatArray
    other_log_odds: FloatArray
    root: FloatArray
    sigma_rad: FloatArray
    corner: FloatArray
    corner_root: FloatArray
    half_m: FloatArray
    symmetry: IntArray

    def rows(self, which: IntArray) -> SpatialFrame:
        """Return some of the detections."""
        return SpatialFrame(
            *(part[:, which] if name == "either" else part[which] for name, part in self._asdict().items())
        )


class SpatialMotion(Motion):
    """Odometry between two poses in space, with derivatives (6, 1) by the logarithm of its scale."""

    __slots__ = ()

    @classmethod
    def over(
        cls, path: OdometryPath | None, start_s: float, stop_s: float, log_scale: float, noise: SpatialNoise
    ) -> SpatialMotion:
        """Return between two instants; without odometry a robot stands, and may be anywhere that it can have gone."""
        lasted_s = max(stop_s - start_s, 0.0)
        if path is None:
            root, increment = lasted_s, se3.identity()
        else:
            ends = se3.interpolate(*path, np.array([start_s, stop_s]))
            root, increment = np.sqrt(lasted_s), se3.scaled(se3.between(ends[0], ends[1]), np.exp(log_scale))
        sigma = np.repeat([noise.translation * root, noise.rotation * root], 3)
        by_scale = np.append(se3.rotation_of(increment).T @ increment[:3], np.zeros(3))
        return cls(increment, by_scale[:, None], np.diag(sigma**2))


class SpatialFilter(LocalFilter):
    """The newest pose (7,), the states of the sensors' mounts with the odometry's scale, and the places (7,) around.

    Points have no orientation: nan.

    Args:
        mount: (S, 7) nominal poses of the sensors on the robot.
        sigma: (6 S + 1,) of the twists of these, and of the logarithm of the odometry's scale; 0 where exact.
        noise: standard deviations of detections.
        symmetries: turns after which places look the same, the first without any.
        most, considered: as `NearbyPlaces`.
    """

    def __init__(
        self,
        mount: FloatArray,
        sigma: FloatArray,
        noise: SpatialNoise,
        symmetries: tuple[Symmetry, ...] = (Symmetry(),),
        *,
        most: int = MOST_ACTIVE,
        considered: bool = False,
    ) -> None:
        super().__init__(SPACE, np.zeros(len(sigma)), sigma**2, OF_PLACE, 7, most=most, considered=considered)
        self._mount, self.levels = mount, noise.levels
        """(6,) noise levels."""
        self._back = np.zeros((len(mount), 1, 6))
        self._axis = np.array([kind.axis for kind in symmetries])
        self._first_turn = np.append(0, np.cumsum([len(kind.turns) for kind in symmetries]))
        self._turns = np.vstack([kind.turns for kind in symmetries])

    @property
    def mount(self) -> FloatArray:
        """(S, 7) poses of the sensors on the robot."""
        return self._mount_at(self.states)

    @property
    def log_scale(self) -> float:
        """Logarithm of true distances over those of the odometry."""
        return float(self.states[-1])

    def place_of(self, seen: SpatialFrame, which: int, *, oriented: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return where a detection puts its landmark (7,), its derivatives (6, own) by pose and states, and (6, 6) the
        covariance of the detection there.
        """
        sensor, seen_at = int(seen.sensor[which]), seen.either[0, which]
        mount = self.mount[sensor]
        eye = se3.compose(self.pose, mount)
        place, by_own = se3.compose(eye, seen_at), np.zeros((OF_PLACE, self.own))
        inverse = np.linalg.inv(seen.root[which]) * self.levels[[ACROSS, ACROSS, ALONG]]
        spread, of_sensor = np.zeros((6, 6)), slice(6 + MOUNT * sensor, 6 + MOUNT * (sensor + 1))
        if oriented:
            onto = se3.rotation_of(seen_at).T
            by_own[:, :6] = se3.adjoint(se3.inverse(se3.compose(mount, seen_at)))
            by_own[:, of_sensor] = se3.adjoint(se3.inverse(seen_at))
            spread[3:, 3:] = np.eye(3) * seen.sigma_rad[which] ** 2
        else:
            onto, place[3:] = se3.rotation_of(eye), np.nan
            at = np.append(seen_at[:3], se3.NO_TURN)
            by_own[:3, :6] = se3.rotation_of(eye) @ se3.adjoint(se3.inverse(se3.compose(mount, at)))[:3].reshape(3, 6)
            by_own[:3, of_sensor] = se3.rotation_of(eye) @ se3.adjoint(se3.inverse(at))[:3]
        spread[:3, :3] = onto @ inverse @ inverse.T @ onto.T
        return place, by_own, spread

    def _mount_at(self, states: FloatArray) -> FloatArray:
        return se3.retract(self._mount, states[:-1].reshape(-1, MOUNT))

    def _move_pose(self, motion: Motion) -> tuple[FloatArray, FloatArray]:
        return se3.compose(self.pose, motion.increment), se3.adjoint(se3.inverse(motion.increment))

    def _sight_frame(self, rows: IntArray, seen: SpatialFrame) -> _SpatialFrame:
        return _SpatialFrame(self, rows, seen)

    def _carry(self, step: FloatArray) -> None:
        if not self._considered:
            self._carry_places(step)
        self.pose = se3.retract(self.pose, step[:6])
        back = se3.adjoint(se3.exp(-step[:6]))
        self.covariance[:6] = back @ self.covariance[:6]
        self.covariance[:, :6] = self.covariance[:, :6] @ back.T

    def _carry_places(self, step: FloatArray) -> None:
        """Move all places in the covariance, and re-express it there; the pose's own error comes later."""
        slots = np.flatnonzero(self._row >= 0)
        if not len(slots):
            return
        at, rows = self.columns(slots).reshape(-1, OF_PLACE), self._row[slots]
        turn, turned = se3.rotation_of(self.pose), np.isfinite(self.position[rows, 3])
        before = self.position[rows]
        after = _carry_by_steps(before, step[at], turn @ step[3:6], turned)
        covariance, heading = self.covariance, self.covariance[3:6].copy()
        by_turn = -_crossing(after[~turned, :3] - before[~turned, :3]) @ turn
        points, twists = at[~turned, :3], at[turned]
        carry = se3.adjoint(se3.exp(-step[twists]))
        covariance[points] += by_turn @ heading
        covariance[twists] = carry @ covariance[twists]
        heading = covariance[:, 3:6].copy()
        covariance[:, points] += np.einsum("na,kba->nkb", heading, by_turn)
        covariance[:, twists] = np.einsum("nka,kba->nkb", covariance[:, twists], carry)
        self.position[rows] = after

    def _apart(self, places: FloatArray, others: FloatArray) -> FloatArray:
        """Return (k, 6) twists of places with an orientation, shifts of points."""
        turned = np.isfinite(places[:, 3])
        found = np.zeros((len(places), OF_PLACE))
        found[:, :3] = places[:, :3] - others[:, :3]
        found[turned] = se3.local(others[turned], places[turned])
        return found

    def _move_place(self, place: FloatArray, by: FloatArray) -> FloatArray:
        """Return a place (7,) that differs from another by (6,)."""
        if np.isfinite(place[3]):
            return se3.retract(place, by)
        return np.append(place[:3] + by[:3], place[3:])


class _SpatialFrame:
    """Detections of places (M,) in space: a `SightedFrame`."""

    def __init__(self, of: SpatialFilter, rows: IntArray, seen: SpatialFrame) -> None:
        count, self._of = len(rows), of
        self._pose, self._states, self._place = of.pose, of.states, of.position[rows]
        self._turned = turned = np.isfinite(self._place[:, 3])
        self._place_or_still = np.where(turned[:, None] | (np.arange(7) < 3), self._place, STILL)
        kind, dim = np.where(turned, seen.kind, POINT), np.where(turned, 6, 3)
        self.n_rows = ROWS[kind]
        self.tail = HEAVY_TAIL * self.n_rows
        first = np.append(0, np.cumsum(self.n_rows * (OF_SIGHTING + dim)))
        self._seen = SpatialSightings(
            np.zeros(count, dtype=np.int64), np.arange(count), seen.sensor, kind, turned.astype(np.int64),
            np.ascontiguousarray(seen.either[0]), seen.root, seen.sigma_rad, seen.corner, seen.corner_root,
            seen.half_m, first, np.ones(count), np.full(3, NEVER), seen.symmetry, of._axis, of._first_turn, of._turns,
            np.zeros(count, dtype=np.bool_),
        )  # fmt: skip
        most = int(self.n_rows.max(initial=0))
        self._residual, self._values, self._weight = np.zeros((count, 8)), np.zeros(int(first[-1])), np.zeros(count)
        self.residual, self.jacobian = np.zeros((count, most)), np.zeros((count, most, WIDTH))
        self.column = np.empty((count, WIDTH), dtype=np.int64)
        self.column[:, :6] = np.arange(6)
        self.column[:, 6:BY_PLACE] = 6 + MOUNT * seen.sensor[:, None] + np.arange(MOUNT)
        self.column[:, BY_PLACE:] = of.own + np.arange(OF_PLACE * count).reshape(count, OF_PLACE)

    def linearise(self, step: FloatArray) -> None:
        """Fill in residuals and derivatives at a step (own + 6 M,)."""
        of, start, own = self._of, self._pose, self._of.own
        by_place, turn = step[own:].reshape(-1, OF_PLACE), se3.rotation_of(start)
        place = self._place_or_still
        if by_place.any():
            place = _carry_by_steps(place, by_place, turn @ step[3:6], self._turned)
        linearise_sightings(
            se3.retract(start, step[:6])[None], place, of._mount_at(self._states + step[6:own]), of._back, of._back,
            of.levels, self._seen, False, self._values, self._weight, self._residual,
        )  # fmt: skip
        self.residual[:] = self._residual[:, : self.residual.shape[1]]
        _unpack(self._values, self._seen.first, self.n_rows, self._turned, self.jacobian)
        if not step[:6].any():
            return
        # from errors at the step to those before it
        jacobian, turned = self.jacobian, self._turned
        jacobian[..., :6] = jacobian[..., :6] @ se3.adjoint(se3.exp(-step[:6]))
        if place is self._place_or_still:
            return
        by_turn = -_crossing(place[~turned, :3] - self._place[~turned, :3]) @ turn
        jacobian[~turned, :, 3:6] += jacobian[~turned, :, BY_PLACE : BY_PLACE + 3] @ by_turn
        carry = se3.adjoint(se3.exp(-by_place[turned]))
        jacobian[turned, :, BY_PLACE:] = jacobian[turned, :, BY_PLACE:] @ carry


@kernel
def _unpack(values: FloatArray, first: IntArray, n_rows: IntArray, turned: BoolArray, jacobian: FloatArray) -> None:
    """Fill in derivatives (M, R, 18) by pose, mount and place from the factors of `linearise_sightings`."""
    for m in range(len(n_rows)):
        at, dim = first[m], 6 if turned[m] else 3
        for row in range(n_rows[m]):
            for a in range(6):
                jacobian[m, row, a] = values[at + a]
                jacobian[m, row, 6 + a] = values[at + 6 + dim + a]
            for a in range(dim):
                jacobian[m, row, BY_PLACE + a] = values[at + 6 + a]
            at += OF_SIGHTING + dim


def _carry_by_steps(place: FloatArray, step: FloatArray, turn: FloatArray, turned: BoolArray) -> FloatArray:
    """Return places (M, 7) after steps (M, 6), where the heading turns by a rotation vector of the world."""
    after = place.copy()
    after[turned] = se3.retract(place[turned], step[turned])
    shift = np.zeros((int(np.count_nonzero(~turned)), 6))
    shift[:, :3], shift[:, 3:] = step[~turned, :3], turn
    after[~turned, :3] += se3.exp(shift)[:, :3]
    return after


def _crossing(vector: FloatArray) -> FloatArray:
    """Matrices (M, 3, 3) of the cross product with vectors (M, 3)."""
    return -se3.rigid_directions(vector).reshape(-1, 3, 6)[..., 3:]
