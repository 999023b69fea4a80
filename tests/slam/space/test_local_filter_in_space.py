"""The filter in space against a Kalman filter that is written densely, with derivatives by differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from evermap.geometry import se3
from evermap.slam.space.linearise import POINT, POSE
from evermap.slam.space.local_filter import SpatialFilter, SpatialFrame, SpatialMotion
from evermap.slam.space.problem import SpatialNoise

NOISE = SpatialNoise(translation=0.01, rotation=0.004, across=1.2, along=0.8, orientation=1.5)
MOUNT = np.stack([se3.exp([0.2, -0.1, 0.4, 0.3, -0.2, 0.5]), se3.exp([-0.3, 0.1, 0.2, 0.1, 0.2, 2.5])])
STATES = np.append(np.tile([0.004, 0.004, 0.004, 0.002, 0.002, 0.002], 2), 0.01)
SIGMA_M, SIGMA_RAD, OF_PLACES_M, OF_PLACES_RAD = 0.01, 0.01, 0.02, 0.01
OWN = 6 + len(STATES)


def _places(random: np.random.Generator, count: int) -> np.ndarray:
    """(L, 7), the even ones tags, the odd ones points."""
    place = se3.retract(se3.identity(count), random.normal(0.0, [3.0, 3.0, 1.5, 0.6, 0.6, 0.6], (count, 6)))
    place[1::2, 3:] = np.nan
    return place


def _seen(random: np.random.Generator, pose: np.ndarray, place: np.ndarray, rows: np.ndarray) -> SpatialFrame:
    """Detections of some places, each by one of the two sensors, with noise."""
    count, sensor = len(rows), np.arange(len(rows)) % 2
    known = np.where(np.isfinite(place[rows]), place[rows], np.append(np.zeros(3), se3.NO_TURN))
    at = se3.between(se3.compose(pose, MOUNT[sensor]), known)
    at[:, :3] += random.normal(0.0, SIGMA_M, (count, 3))
    at = se3.retract(at, np.hstack([np.zeros((count, 3)), random.normal(0.0, SIGMA_RAD, (count, 3))]))
    kind = np.where(np.isfinite(place[rows, 3]), POSE, POINT)
    root = np.tile(np.linalg.cholesky(np.diag([1.0, 2.0, 0.5])) / SIGMA_M, (count, 1, 1))
    return SpatialFrame(
        rows, np.ones(count, dtype=np.bool_), sensor, kind, np.stack([at, at]), np.zeros(count), root,
        np.full(count, SIGMA_RAD), np.zeros((count, 4, 2)), np.zeros((count, 4, 2, 2)), np.zeros(count),
        np.zeros(count, dtype=np.int64),
    )  # fmt: skip


class _Dense:
    """A plain extended Kalman filter of everything, or one that only considers the places (Schmidt 1966)."""

    def __init__(self, pose: np.ndarray, place: np.ndarray, covariance: np.ndarray, *, considered: bool) -> None:
        self.pose, self.states, self.place = pose, np.zeros(OWN - 6), place
        self.covariance, self._considered = covariance, considered

    def moved(self, by: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        place = self.place.copy()
        for k, step in enumerate(by[OWN:].reshape(-1, 6)):
            place[k] = se3.retract(place[k], step) if k % 2 == 0 else np.append(place[k, :3] + step[:3], place[k, 3:])
        return se3.retract(self.pose, by[:6]), self.states + by[6:OWN], place

    def derivative(self, of: Callable[..., np.ndarray]) -> np.ndarray:
        step = 1e-6 * np.eye(len(self.covariance))
        return np.stack([(of(*self.moved(one)) - of(*self.moved(-one))) / 2e-6 for one in step], axis=1)

    def drive(self, increment: np.ndarray, noise: np.ndarray) -> None:
        scaled = se3.scaled(increment, np.exp(self.states[-1]))
        ahead = se3.compose(self.pose, scaled)

        def after(pose: np.ndarray, states: np.ndarray, _: np.ndarray) -> np.ndarray:
            return se3.local(ahead, se3.compose(pose, se3.scaled(increment, np.exp(states[-1]))))

        transition = np.eye(len(self.covariance))
        transition[:6] = self.derivative(after)
        self.covariance = transition @ self.covariance @ transition.T
        self.covariance[:6, :6] += noise
        self.pose = ahead

    def update(self, seen: SpatialFrame) -> None:
        def residual(pose: np.ndarray, states: np.ndarray, place: np.ndarray) -> np.ndarray:
            mount, parts = se3.retract(MOUNT, states[:-1].reshape(-1, 6)), []
            for k, row in enumerate(seen.landmark_id.tolist()):
                eye, measured = se3.compose(pose, mount[seen.sensor[k]]), seen.either[0, k]
                level = np.array([NOISE.across, NOISE.across, NOISE.along])
                away = se3.transform(se3.inverse(eye), place[row, :3])
                parts.append(seen.root[k] @ (measured[:3] - away) / level)
                if row % 2 == 0:
                    turned = se3.rotation_of(measured) @ se3.rotation_of(se3.between(eye, place[row])).T
                    small = 0.5 * np.array(
                        [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
                    )
                    parts.append(small / (NOISE.orientation * seen.sigma_rad[k]))
            return np.concatenate(parts)

        off, by = residual(self.pose, self.states, self.place), self.derivative(residual)
        innovation = by @ self.covariance @ by.T + np.eye(len(off))
        gain = self.covariance @ by.T @ np.linalg.inv(innovation)
        if self._considered:
            gain[OWN:] = 0.0
        self.pose, self.states, self.place = self.moved(-gain @ off)
        rest = np.eye(len(self.covariance)) - gain @ by
        self.covariance = rest @ self.covariance @ rest.T + gain @ gain.T


@pytest.mark.parametrize("considered", [pytest.param(False, marks=pytest.mark.slow), True])
def test_it_is_the_kalman_filter_of_pose_mounts_scale_points_and_tags(considered: bool) -> None:
    random, count = np.random.default_rng(7), 6
    true = _places(random, count)
    of_place = np.tile(np.repeat([OF_PLACES_M, OF_PLACES_RAD], 3), count).reshape(count, 6)
    of_place[1::2, 3:] = 0.0
    start = se3.exp([0.5, -0.4, 0.2, 0.2, 0.1, -0.4])
    sigma = np.concatenate([np.full(6, 0.01), STATES, of_place.ravel()])
    covariance = np.diag(sigma**2)
    dense = _Dense(start, true, covariance, considered=considered)
    dense.pose, _, place = dense.moved(sigma * random.normal(size=len(sigma)))
    dense.place = place
    local = SpatialFilter(MOUNT, STATES, NOISE, considered=considered)
    local.hold(dense.pose, dense.states, covariance, np.arange(count), place.copy())
    pose = start
    for frame in range(8):
        step = SpatialMotion.over(None, 0.0, 0.0, 0.0, NOISE).increment
        if frame:
            step = se3.exp([0.3, 0.05, 0.0, 0.02, 0.01, 0.2])
            pose = se3.compose(pose, step)
            noise = np.diag(np.repeat([0.01, 0.004], 3) ** 2)
            dense.drive(step, noise)
            scaled = se3.scaled(step, np.exp(local.log_scale))
            by_scale = np.append(se3.rotation_of(scaled).T @ scaled[:3], np.zeros(3))[:, None]
            local.drive(SpatialMotion(scaled, by_scale, noise))
        seen = _seen(random, pose, true, np.sort(random.permutation(count)[:4]))
        dense.update(seen)
        local.update(seen.landmark_id, seen)
        spread = np.sqrt(np.diag(dense.covariance))
        assert np.abs(se3.local(dense.pose, local.pose) / spread[:6]).max() < 0.1
        assert np.abs((local.states - dense.states) / spread[6:OWN]).max() < 0.1
        off = local._apart(local.position, dense.place) / np.where(spread[OWN:] > 0, spread[OWN:], 1.0).reshape(-1, 6)
        assert np.abs(off).max() < 0.1
        some = np.flatnonzero(spread > 0.0)
        ratio = local.covariance[np.ix_(some, some)] / np.outer(spread[some], spread[some])
        np.testing.assert_allclose(
            ratio, dense.covariance[np.ix_(some, some)] / np.outer(spread[some], spread[some]), atol=0.03
        )


def test_new_landmarks_tell_nothing_of_a_heading_that_was_lost() -> None:
    """Not by however many updates at however wrong an attitude: they only show where the robot is among them."""
    random, count = np.random.default_rng(3), 8
    true, exact = _places(random, count), np.zeros(len(STATES))
    local = SpatialFilter(MOUNT, exact, NOISE)
    lost = np.zeros((OWN, OWN))
    lost[:6, :6] = np.diag(np.repeat([0.1, 0.3], 3)) ** 2
    local.hold(se3.identity(), exact, lost, np.arange(0), np.full((count, 7), np.nan))
    pose, before = se3.identity(), None
    for frame in range(40):
        if frame:
            step = se3.exp([0.2, 0.0, 0.0, 0.0, 0.0, 0.1])
            pose = se3.compose(pose, se3.retract(step, 0.03 * random.normal(size=6)))
            local.drive(SpatialMotion(step, np.zeros((6, 1)), 0.03**2 * np.eye(6)))
        seen = _seen(random, pose, true, np.arange(count))
        for row in range(0 if frame else count):
            oriented = row % 2 == 0
            place, by_own, spread = local.place_of(seen, row, oriented=oriented)
            local.sight(row, place, by_own, spread)
        local.update(seen.landmark_id, seen)
        world = se3.rotation_of(local.pose) @ local.covariance[3:6, 3:6] @ se3.rotation_of(local.pose).T
        before = world if before is None else before
        assert np.linalg.eigvalsh(world).min() > 0.95 * 0.3**2
