"""One Gaussian of the newest pose in space, the mounts of the sensors, and the nearby places, step by step.

As `slam.local_filter` in the plane, with the same slots, the same iterated update and the same weights; detections are
linearised by the kernel of the smoother (`linearise_sightings`), so the measurement equations are written once.

Errors are twists of pose and of places with an orientation, each in its own frame, and shifts of points in the world.
Steps are invariant (Barrau and Bonnabel 2015): a step of the heading carries whatever stands in the world, and the
covariance is re-expressed at the new state, so that a heading that no detection shows stays as uncertain as it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.linalg.lapack import dpotri

from evermap.estimate.robust import HEAVY_TAIL, weigh
from evermap.geometry import se3
from evermap.geometry.group import SPACE
from evermap.geometry.symmetry import Symmetry
from evermap.slam.filter_kernels import (
    BELIEVED,
    BY_OTHERS,
    CONSIDERED_STEP,
    HEAVY,
    ITERATIONS,
    LEAST_WEIGHT,
    SETTLED_WEIGHT,
    SMALL_STEP,
    UNSURE,
)
from evermap.slam.nearby_places import MOST_ACTIVE, NearbyPlaces
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
from evermap.slam.space.online_noise import OnlineNoise
from evermap.slam.space.problem import OdometryPath, SpatialNoise
from evermap.types import BoolArray, FloatArray, IntArray

OF_PLACE = 6
"""Columns of a place in the covariance; of a point the last three are zero."""
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


@dataclass(frozen=True, slots=True)
class SpatialMotion:
    """Odometry between two poses in space.

    Attributes:
        increment: (7,) the second pose seen from the first.
        by_scale: (6,) its derivative, at its end, by the logarithm of the odometry's scale.
        covariance: (6, 6) its noise.
    """

    increment: FloatArray
    by_scale: FloatArray
    covariance: FloatArray

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
        return cls(increment, by_scale, np.diag(sigma**2))


class SpatialFilter(NearbyPlaces):
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

    def drive(self, motion: SpatialMotion) -> None:
        """Advance the newest pose."""
        self._now += 1
        self.pose = _drive_on(self.pose, self.covariance, self.own, motion)

    def ahead(self, motion: SpatialMotion) -> tuple[FloatArray, FloatArray]:
        """Return the pose (7,) after a motion, and its covariance (6, 6); the filter stays where it is."""
        covariance = self.covariance[: self.own, : self.own].copy()
        return _drive_on(self.pose, covariance, self.own, motion), covariance[:6, :6].copy()

    def compare(self, rows: IntArray, seen: SpatialFrame, own: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compare detections (M,) with a place each, of covariance `own` (M, 6, 6), each pair separately.

        Returns:
            (M,) squared Mahalanobis distances with `S = H P H' + R`, and (M,) `log |S|`.
        """
        frame = _Frame(self, rows, seen)
        residual, jacobian = frame.linearise(self.pose, self.states, self.position[rows])
        by_own, by_place = jacobian[..., : self.own], jacobian[..., self.own :]
        part = self.covariance[: self.own, : self.own]
        spread = by_own @ part @ by_own.swapaxes(1, 2) + by_place @ own @ by_place.swapaxes(1, 2)
        spread += np.eye(residual.shape[1])
        return _squared(spread, residual), np.linalg.slogdet(spread)[1]

    def update(
        self,
        rows: IntArray,
        seen: SpatialFrame,
        *,
        weighing: int = BELIEVED,
        log_odds: FloatArray | None = None,
        noise: OnlineNoise | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Update by detections of places (M,) in the covariance, as `filter_kernels.update`; `noise` learns from them.

        Returns:
            (M,) squared distance of each innovation by itself, before the frame was used, and (M,) weights.
        """
        count, own, slots = len(rows), self.own, self._slot[rows]
        if count == 0:
            return np.zeros(0), np.ones(0)
        frame, odds = _Frame(self, rows, seen), np.zeros(count) if log_odds is None else log_odds
        where = np.append(np.arange(own), self.columns(slots))
        part = self.covariance[np.ix_(where, where)]
        start, start_states, start_place = self.pose, self.states, self.position[rows]
        pose, states, place = start, start_states, start_place
        nis, weight, credible = np.zeros(count), np.ones(count), np.ones(count)
        moving, small = (own, CONSIDERED_STEP) if self._considered else (len(where), SMALL_STEP)
        step, is_unsure, turn = np.zeros(len(where)), False, se3.rotation_of(start)
        for iteration in range(ITERATIONS):
            residual, jacobian = frame.linearise(pose, states, place)
            self._to_start(jacobian, start, start_place, place, step, frame.turned)
            gain, spread = _gain(jacobian, part, own)
            if iteration == 0:
                innovations = spread, residual, jacobian[..., :6].copy()
            if weighing == BY_OTHERS and iteration == 0:
                nis, is_unsure = _surprises(part, jacobian, spread, residual, own, frame.n_rows)
                credible = np.maximum([weigh(*one, 0.0, 0.0)[0] for one in zip(nis, odds, strict=True)], LEAST_WEIGHT)
                weight = credible.copy()
            if weighing == HEAVY:
                # before anything is known of this frame: as surprising as its innovation is
                unknown = _blocks(spread, count) if iteration == 0 else 0.0
                squared = _squared(unknown + np.eye(residual.shape[1]), residual)
                weight = 1.0 / (1.0 + squared / (HEAVY_TAIL * frame.n_rows))
            own_noise = np.repeat(1.0 / weight, residual.shape[1])
            root = cho_factor(spread + np.diag(own_noise), lower=True)
            by = np.concatenate([np.broadcast_to(step[:own], (count, own)), step[own:].reshape(count, -1)], axis=1)
            innovation = (residual - np.einsum("mra,ma->mr", jacobian, by)).ravel()
            pull, before = cho_solve(root, innovation), step
            step = np.append(-(pull @ gain[:, :moving]), np.zeros(len(where) - moving))
            pose, states = se3.retract(start, step[:6]), start_states + step[6:own]
            if not self._considered:
                place = _carried(start_place, step[own:].reshape(count, -1), turn @ step[3:6], frame.turned)
            changed = 0.0
            if is_unsure:
                now = _weigh_by_the_others(root[0], pull, odds, iteration == 0, credible, weight, frame.n_rows)
                changed = float(np.abs(now - weight).max())
                weight = now
            if np.abs(step - before).max() < small and changed < SETTLED_WEIGHT:
                break
        across = _across(self.covariance, jacobian, own, self.columns(slots).reshape(count, -1))
        self.pose, self.states = pose, states
        if self._considered:
            told = cho_solve(root, across[:, :own])
            self.covariance[:own] -= told.T @ across
            self.covariance[:, :own] = self.covariance[:own].T
        else:
            white = solve_triangular(root[0], np.column_stack([across, innovation]), lower=True)
            self.covariance -= white[:, :-1].T @ white[:, :-1]
            self._carry(-(white[:, :-1].T @ white[:, -1]), turn)
        if noise is not None:
            noise.learn(*innovations, weight, frame.kind, frame.n_rows)
            self.levels = noise.now.levels
        back = se3.adjoint(se3.exp(-step[:6]))
        self.covariance[:6] = back @ self.covariance[:6]
        self.covariance[:, :6] = self.covariance[:, :6] @ back.T
        return nis, weight

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

    def _to_start(
        self,
        jacobian: FloatArray,
        start: FloatArray,
        start_place: FloatArray,
        place: FloatArray,
        step: FloatArray,
        turned: BoolArray,
    ) -> None:
        """Turn derivatives by errors at a state into those by errors at the start of the update, in place."""
        if not step[:6].any():
            return
        jacobian[..., :6] = jacobian[..., :6] @ se3.adjoint(se3.exp(-step[:6]))
        if self._considered:
            return
        lever = place[~turned, :3] - start_place[~turned, :3]
        own, by_turn = self.own, -_crossing(lever) @ se3.rotation_of(start)
        jacobian[~turned, :, 3:6] += jacobian[~turned, :, own : own + 3] @ by_turn
        by = step[own:].reshape(len(place), -1)[turned]
        jacobian[turned, :, own:] = jacobian[turned, :, own:] @ se3.adjoint(se3.exp(-by))

    def _carry(self, step: FloatArray, turn: FloatArray) -> None:
        """Move all places in the covariance by a step, and re-express it there; the pose's own error comes later."""
        slots = np.flatnonzero(self._row >= 0)
        if not len(slots):
            return
        at, rows = self.columns(slots).reshape(-1, OF_PLACE), self._row[slots]
        turned = np.isfinite(self.position[rows, 3])
        before = self.position[rows]
        after = _carried(before, step[at], turn @ step[3:6], turned)
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

    def _moved(self, place: FloatArray, by: FloatArray) -> FloatArray:
        """Return a place (7,) that differs from another by (6,)."""
        if np.isfinite(place[3]):
            return se3.retract(place, by)
        return np.append(place[:3] + by[:3], place[3:])


class _Frame:
    """Detections of places (M,), as the kernel reads them.

    Attributes:
        turned: (M,) places with an orientation.
        kind: (M,) what is used of each detection.
        n_rows: (M,) residuals of each.
    """

    def __init__(self, of: SpatialFilter, rows: IntArray, seen: SpatialFrame) -> None:
        count, self._of = len(rows), of
        self.turned = np.isfinite(of.position[rows, 3])
        self.kind = kind = np.where(self.turned, seen.kind, POINT)
        dim = np.where(self.turned, 6, 3)
        self.n_rows = ROWS[kind]
        self._sensor = seen.sensor
        first = np.append(0, np.cumsum(self.n_rows * (OF_SIGHTING + dim)))
        self._seen = SpatialSightings(
            np.zeros(count, dtype=np.int64), np.arange(count), seen.sensor, kind, self.turned.astype(np.int64),
            seen.either[0], seen.root, seen.sigma_rad, seen.corner, seen.corner_root, seen.half_m, first,
            np.ones(count), np.full(3, NEVER), seen.symmetry, of._axis, of._first_turn, of._turns,
            np.zeros(count, dtype=np.bool_),
        )  # fmt: skip
        self._groups = []
        for key in np.unique(100 * self.n_rows + dim).tolist():
            n_rows, width = key // 100, key % 100
            some = np.flatnonzero((self.n_rows == n_rows) & (dim == width))
            at = first[some][:, None] + np.arange(n_rows * (OF_SIGHTING + width))
            self._groups.append((some, at, n_rows, width))

    def linearise(self, pose: FloatArray, states: FloatArray, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return whitened residuals (M, R), zero behind those that a detection has, and derivatives (M, R, own + 6) by
        pose, states and its place.
        """
        of, seen, count = self._of, self._seen, len(place)
        place = np.where(self.turned[:, None] | (np.arange(7) < 3), place, np.append(np.zeros(3), se3.NO_TURN))
        values, weight, residual = np.zeros(int(seen.first[-1])), np.zeros(count), np.zeros((count, 8))
        linearise_sightings(
            pose[None], place, of._mount_at(states), of._back, of._back, of.levels, seen, False, values, weight,
            residual,
        )  # fmt: skip
        most = int(self.n_rows.max())
        jacobian = np.zeros((count, most, of.own + OF_PLACE))
        for some, at, n_rows, dim in self._groups:
            block = values[at].reshape(len(some), n_rows, OF_SIGHTING + dim)
            jacobian[some, :n_rows, :6] = block[..., :6]
            jacobian[some, :n_rows, of.own : of.own + dim] = block[..., 6 : 6 + dim]
            columns = 6 + MOUNT * self._sensor[some][:, None, None] + np.arange(MOUNT)
            jacobian[some[:, None, None], np.arange(n_rows)[:, None], columns] = block[..., 6 + dim : 12 + dim]
        return residual[:, :most], jacobian


def _drive_on(pose: FloatArray, covariance: FloatArray, own: int, motion: SpatialMotion) -> FloatArray:
    """Return the next pose; advance the joint covariance to it, in place."""
    carry = se3.adjoint(se3.inverse(motion.increment))
    rows = carry @ covariance[:6] + motion.by_scale[:, None] * covariance[own - 1]
    corner = rows[:, :6] @ carry.T + np.outer(rows[:, own - 1], motion.by_scale) + motion.covariance
    covariance[:6], covariance[:, :6] = rows, rows.T
    covariance[:6, :6] = 0.5 * (corner + corner.T)
    return se3.compose(pose, motion.increment)


def _gain(jacobian: FloatArray, part: FloatArray, own: int) -> tuple[FloatArray, FloatArray]:
    """Return `H P` (M R, n) and `H P H'` (M R, M R)."""
    count, rows, _ = jacobian.shape
    at = own + np.arange(OF_PLACE * count).reshape(count, -1)
    gain = _across(part, jacobian, own, at)
    spread = gain[:, :own] @ jacobian[..., :own].reshape(count * rows, own).T
    of_places = gain[:, own:].reshape(-1, count, OF_PLACE).swapaxes(0, 1) @ jacobian[..., own:].swapaxes(1, 2)
    spread += of_places.swapaxes(0, 1).reshape(count * rows, count * rows)
    return gain, 0.5 * (spread + spread.T)


def _across(covariance: FloatArray, jacobian: FloatArray, own: int, at: IntArray) -> FloatArray:
    """Return `H P` (M R, n), with the columns (M, 6) of the places."""
    found = jacobian[..., own:] @ covariance[at]
    found += (jacobian[..., :own].reshape(-1, own) @ covariance[:own]).reshape(found.shape)
    return np.asarray(found.reshape(-1, covariance.shape[1]))


def _blocks(matrix: FloatArray, count: int) -> FloatArray:
    """(M, R, R) blocks on the diagonal of (M R, M R)."""
    each = len(matrix) // count
    return np.asarray(np.einsum("mimj->mij", matrix.reshape(count, each, count, each)))


def _squared(spread: FloatArray, residual: FloatArray) -> FloatArray:
    """(M,) squared Mahalanobis distances of residuals (M, R) with covariances (M, R, R)."""
    return np.asarray((residual * np.linalg.solve(spread, residual[..., None])[..., 0]).sum(axis=1))


def _surprises(
    part: FloatArray, jacobian: FloatArray, spread: FloatArray, residual: FloatArray, own: int, n_rows: IntArray
) -> tuple[FloatArray, bool]:
    """Return the squared distance of every detection alone; True if the pose is too uncertain for this."""
    count, rows = residual.shape
    alone = _blocks(spread, count) + np.eye(rows)
    # their value if only the readings and the places were uncertain
    by_place = jacobian[..., own:]
    of_place = _blocks(part[own:, own:], count)
    certain = by_place @ of_place @ by_place.swapaxes(1, 2) + np.eye(rows)
    wider = np.linalg.slogdet(alone)[1] - np.linalg.slogdet(certain)[1]
    return _squared(alone, residual), bool(np.any(wider > 0.5 * n_rows * np.log(UNSURE)))


def _weigh_by_the_others(
    root: FloatArray,
    pull: FloatArray,
    log_odds: FloatArray,
    heavy: bool,
    credible: FloatArray,
    weight: FloatArray,
    n_rows: IntArray,
) -> FloatArray:
    """Return weights, at most `credible`, from each detection's innovation given all others, as `filter_kernels`."""
    count = len(weight)
    lower = np.tril(dpotri(root, lower=True)[0])
    inverse = lower + np.tril(lower, -1).T
    alone = np.linalg.inv(_blocks(inverse, count))
    off = (alone @ pull.reshape(count, -1, 1))[..., 0]
    more = 1.0 / weight - 1.0  # noise by which it was held to be an outlier
    squared = np.maximum(_squared(alone - more[:, None, None] * np.eye(alone.shape[1]), off), 0.0)
    tail = HEAVY_TAIL * n_rows if heavy else np.zeros(count)
    now = [weigh(*one, 0.0)[0] for one in zip(squared, log_odds, tail, strict=True)]
    return np.minimum(np.maximum(now, LEAST_WEIGHT), credible)


def _carried(place: FloatArray, step: FloatArray, turn: FloatArray, turned: BoolArray) -> FloatArray:
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
