"""Initial poses and places from constellations: three points in view locate a robot among points that are known.

Frame by frame in the order of time, an error of one pose is in all that follow. Here the frame that is determined best
by the places known by then comes next, from a frame that shares most with others; what its pose is uncertain by is in
the places that it adds. Every pose is asked from each triplet of points in view (rigid alignment, random sample
consensus) and from its neighbours in time.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from evermap.geometry import se3
from evermap.geometry.group import accumulate
from evermap.geometry.rigid import rigid
from evermap.slam.space.linearise import STATES
from evermap.slam.space.problem import SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.types import BoolArray, FloatArray, IntArray

TRIPLETS = 16
"""Triplets of points in one frame that are tried, the widest of them."""
MOST_FRAMES = 1000
"""Frames of which those to begin with are chosen, at most."""
OUTLIER = 16.0
"""Squared normalised distance of an outlier, at which a point costs no more."""
REFINED = 6
"""Gauss-Newton steps of a pose."""
SLACK_M = 0.02
"""Standard deviation of known places, at least: what their common errors are, which are not carried along [m]."""
AT_ONCE = 4
"""A round locates as many frames as are located, divided by this."""
WORSE = 1.5
"""And no frame whose pose is more uncertain than that of the best one by this factor, unless it is below `SLACK_M`."""
OBSERVED = 24
"""Sightings of a place, the most certain ones, from which it is placed."""
ANYWHERE = 1e-8
"""Information on a pose of which nothing is known [1/m^2, 1/rad^2]."""
LOST_M = 0.5
"""A pose that is more uncertain than this adds no places while others are left [m]."""
FEWEST_LOST = 2
NEAR_S = 1.0
"""Outliers in a frame, which outnumber the rest, that make it lost, and what is lost together lies this close [s]."""


@dataclass(slots=True)
class _Growth:
    """What is located by now.

    Attributes:
        problem: the measurements.
        point: (M, 3) detections in the robot's frame.
        covariance: (M, 3, 3) of these.
        odometry: (N, 7) poses by the odometry alone; the identity without.
        located: (N,) frames that have a pose.
        pose, spread: (N, 7), (N, 6, 6) these and their covariances.
        known: (P,) places that have a position.
        place, place_spread: (P, 3), (P, 3, 3) these and their covariances.
        given: (P,) places of a map, which stay.
    """

    problem: SpatialProblem
    noise: SpatialNoise
    point: FloatArray
    covariance: FloatArray
    odometry: FloatArray
    located: BoolArray
    pose: FloatArray
    spread: FloatArray
    known: BoolArray
    place: FloatArray
    place_spread: FloatArray
    given: BoolArray
    first: IntArray
    radius_m: float

    @classmethod
    def of(cls, problem: SpatialProblem, noise: SpatialNoise, estimate: SpatialEstimate | None = None) -> _Growth:
        """Begin with nothing but the places of a map that still stand; with the mounts and the scale of an estimate."""
        n, count = len(problem.stamp_s), len(problem.oriented)
        mount = (problem.mount if estimate is None else estimate.mount(problem))[problem.sensor]
        steps = se3.scaled(problem.increment, 1.0 if estimate is None else float(np.exp(estimate.log_scale)))
        root = np.linalg.inv(problem.measured_root) * np.array([noise.across, noise.across, noise.along])
        root = se3.rotation_of(mount) @ root
        point = se3.transform(mount, problem.measured[:, :3])
        odometry = accumulate(steps) if problem.driven else se3.identity(n)
        known, place, spread = np.zeros(count, dtype=np.bool_), np.zeros((count, 3)), np.zeros((count, 3, 3))
        prior, stands = problem.prior, problem.prior.weight > problem.settings.inlier
        known[prior.place[stands]], place[prior.place] = True, prior.pose[:, :3]
        spread[prior.place] = (prior.sigma[:, :1, None] ** 2) * np.eye(3)
        return cls(
            problem, noise, point, root @ np.swapaxes(root, 1, 2), odometry, np.zeros(n, dtype=np.bool_),
            se3.identity(n), np.zeros((n, 6, 6)), known, place, spread, known.copy(),
            np.searchsorted(problem.pose_row, np.arange(n + 1)), float(np.median(np.linalg.norm(point, axis=1))),
        )  # fmt: skip

    def neighbours(self) -> tuple[IntArray, BoolArray]:
        """Return (2, N) the located frames before and after each in time, and whether there are any."""
        at, rows = np.flatnonzero(self.located), np.arange(len(self.located))
        after = np.searchsorted(at, rows)
        found = np.stack([np.maximum(after - 1, 0), np.minimum(after, len(at) - 1)])
        there = np.stack([after > 0, after < len(at)])
        return at[found] if len(at) else np.zeros_like(found), there

    def motion(self, row: IntArray, other: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return poses (K, 7) of frames (K,) and their information (K, 6, 6) by located ones (K,) near in time.

        Without odometry the robot is where it was.
        """
        lasted_s = np.abs(self.problem.stamp_s[row] - self.problem.stamp_s[other])
        squared = np.maximum(lasted_s if self.problem.driven else lasted_s**2, 1e-4)
        sigma = np.repeat([self.noise.translation, self.noise.rotation], 3)
        moved = squared[:, None, None] * np.diag(sigma**2)
        led = se3.compose(self.pose[other], se3.between(self.odometry[other], self.odometry[row]))
        return led, np.linalg.inv(self.spread[other] + moved)

    def information(self) -> FloatArray:
        """Return (N, 6, 6) of each frame's pose by the places that are known, and by located frames next to it."""
        problem = self.problem
        told = np.flatnonzero(self.known[problem.place])
        wide = np.trace(self.place_spread[problem.place[told]], axis1=1, axis2=2) / 3.0
        weight = np.linalg.inv(self.covariance[told] + wide[:, None, None] * np.eye(3))
        slope = _slopes(self.point[told])
        total = np.zeros((len(problem.stamp_s), 6, 6))
        np.add.at(total, problem.pose_row[told], np.swapaxes(slope, 1, 2) @ weight @ slope)
        for other, there in zip(*self.neighbours(), strict=True):
            some = np.flatnonzero(~self.located & there)
            total[some] += self.motion(some, other[some])[1]
        return total

    def uncertainty(self, information: FloatArray) -> FloatArray:
        """Return (N,) standard deviation [m] of each frame's pose, in its worst direction; inf of those located."""
        by = np.repeat([1.0, 1.0 / self.radius_m], 3)
        least = np.linalg.eigvalsh(by[:, None] * information * by)[:, 0]
        return np.where(self.located, np.inf, 1.0 / np.sqrt(np.maximum(least, ANYWHERE)))

    def locate(self, row: int, *, surely: bool = True) -> bool:
        """Give a frame its best pose; False, and none, where `surely` and most of what it sees contradicts it."""
        mine = np.arange(self.first[row], self.first[row + 1])
        mine = mine[self.known[self.problem.place[mine]]]
        other, there = self.neighbours()
        near = other[there[:, row], row]
        mean, told = self.motion(np.full(len(near), row), near)
        candidate = [*mean]
        where = self.problem.place[mine]
        if len(mine) >= 3:
            of = _widest(self.point[mine])
            candidate += [*rigid(self.point[mine][of], self.place[where][of])]
            candidate.append(rigid(self.point[mine], self.place[where]))
        if not candidate:
            return False
        pose, cost, information, squared = _refined(
            np.array(candidate), self.point[mine], self.covariance[mine], self.place[where], self.place_spread[where],
            mean, told,
        )  # fmt: skip
        best = int(np.argmin(cost))
        if surely and 2 * np.count_nonzero(squared[best] < OUTLIER) < len(mine):
            return False
        self.pose[row], self.located[row] = pose[best], True
        self.spread[row] = np.linalg.inv(information[best] + ANYWHERE * np.eye(6))
        return True

    def place_seen(self, rows: IntArray) -> None:
        """Place again what was seen in some frames, by what most of its sightings agree on."""
        problem = self.problem
        some = np.flatnonzero(np.isin(problem.place, problem.place[np.isin(problem.pose_row, rows)]))
        some = some[self.located[problem.pose_row[some]]]
        at, spread = self.seen(some)
        size = np.trace(spread, axis1=1, axis2=2)
        for place in np.unique(problem.place[some]).tolist():
            if self.given[place]:
                continue
            mine = np.flatnonzero(problem.place[some] == place)
            mine = mine[np.argsort(size[mine], kind="stable")[:OBSERVED]]
            self.place[place], self.place_spread[place] = _agreed(at[mine], spread[mine])
            self.known[place] = True

    def seen(self, some: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return (K, 3) where detections put their places, and the covariances (K, 3, 3) of that."""
        rows, point = self.problem.pose_row[some], self.point[some]
        turn, slope = se3.rotation_of(self.pose[rows]), _slopes(point)
        own = self.covariance[some] + slope @ self.spread[rows] @ np.swapaxes(slope, 1, 2)
        return se3.transform(self.pose[rows], point), turn @ own @ np.swapaxes(turn, 1, 2)


def seeds(problem: SpatialProblem, count: int) -> list[int]:
    """Return frames to begin with: those with three places in common with most other frames, unlike each other."""
    n = len(problem.stamp_s)
    seen = np.zeros((n, len(problem.oriented)), dtype=np.float64)
    seen[problem.pose_row, problem.place] = 1.0
    rows = np.arange(0, n, 1 + n // MOST_FRAMES)
    seen = seen[rows]
    shares = seen @ seen.T >= 3.0
    score, found = shares.sum(axis=1) + 1e-3 * seen.sum(axis=1), list[int]()
    for _ in range(count):
        best = int(np.argmax(score))
        if score[best] < 1.0:
            break
        found.append(int(rows[best]))
        score[shares[best]] = 0.0
        score[best] = 0.0
    return found


def by_constellations(problem: SpatialProblem, noise: SpatialNoise, count: int) -> list[SpatialEstimate]:
    """Return initial values, one from each of some frames to begin with; from the places of a map, if there is one.

    Args:
        problem: the measurements.
        noise: levels to start from.
        count: frames to begin with, at most.
    """
    if (problem.prior.weight > problem.settings.inlier).any():
        return [_grown(problem, noise, None)]
    return [_grown(problem, noise, seed) for seed in seeds(problem, count)]


def _grown(problem: SpatialProblem, noise: SpatialNoise, seed: int | None) -> SpatialEstimate:
    """Poses and places, from one frame at the origin or from a map."""
    growth = _Growth.of(problem, noise)
    if seed is not None:
        growth.located[seed] = True
        growth.spread[seed] = np.diag(np.repeat([1e-3, 1e-3], 3) ** 2)
        growth.place_seen(np.array([seed]))
    _grow(growth)
    place = se3.identity(len(problem.oriented))
    place[:, :3], place[problem.prior.place] = growth.place, problem.prior.pose
    pose = growth.pose
    if seed is not None:
        back = se3.inverse(pose[0])
        pose, place = se3.compose(back, pose), se3.compose(back, place)
    place[~problem.oriented, 3:] = se3.NO_TURN
    return SpatialEstimate(pose, place, np.zeros((len(problem.mount), STATES)))


def located_again(
    problem: SpatialProblem, noise: SpatialNoise, estimate: SpatialEstimate, weight: FloatArray
) -> SpatialEstimate | None:
    """Return the values with those frames located anew that see most of what they see elsewhere; None without any.

    They are located among the places that the others see, and so are the places that only they see.

    Args:
        problem: the measurements.
        noise: its levels.
        estimate: the values.
        weight: (M,) of the detections there: outliers have next to none.
    """
    good, bad = weight > problem.settings.inlier, lost_frames(problem, weight)
    if not bad.any() or bad.all():
        return None
    bad = _closed(bad, problem.stamp_s)
    growth = _Growth.of(problem, noise, estimate)
    growth.located, growth.pose = ~bad, estimate.pose.copy()
    growth.spread[:] = np.diag(np.repeat([SLACK_M, SLACK_M / growth.radius_m], 3) ** 2)
    by_others = np.bincount(problem.place[good & ~bad[problem.pose_row]], minlength=len(problem.oriented)) > 0
    growth.known[by_others], growth.place[by_others] = True, estimate.place[by_others, :3]
    growth.place_spread[by_others], growth.given = SLACK_M**2 * np.eye(3), growth.known.copy()
    _grow(growth)
    place = estimate.place.copy()
    place[~growth.given & growth.known, :3] = growth.place[~growth.given & growth.known]
    return SpatialEstimate(growth.pose, place, estimate.state, estimate.log_scale)


def lost_frames(problem: SpatialProblem, weight: FloatArray) -> BoolArray:
    """Return (N,) frames in which most detections, and at least two, are outliers by their weights (M,)."""
    seen = np.bincount(problem.pose_row, minlength=len(problem.stamp_s))
    good = weight > problem.settings.inlier
    agrees = np.bincount(problem.pose_row[good], minlength=len(seen))
    return np.asarray((seen - agrees >= FEWEST_LOST) & (2 * agrees < seen))


def _closed(bad: BoolArray, stamp_s: FloatArray) -> BoolArray:
    """(N,) frames that are bad, or within `NEAR_S` of such ones on both sides."""
    at = np.concatenate([[-np.inf], stamp_s[bad], [np.inf]])
    after = np.searchsorted(at, stamp_s)
    return np.asarray((stamp_s - at[after - 1] < NEAR_S) & (at[after] - stamp_s < NEAR_S) | bad)


def _grow(growth: _Growth) -> None:
    """Locate all frames, the best determined ones first, and the places that they see."""
    surely, failed = True, np.zeros(len(growth.located), dtype=np.bool_)
    while not growth.located.all():
        unsure = np.where(failed, np.inf, growth.uncertainty(growth.information()))
        least = float(unsure.min())
        if not np.isfinite(least) or (surely and least > LOST_M and failed.any()):
            if not surely:
                break
            surely, failed[:] = False, False
            continue
        order = np.argsort(unsure, kind="stable")
        order = order[unsure[order] <= max(WORSE * least, SLACK_M)]
        order = order[: max(1, np.count_nonzero(growth.located) // AT_ONCE)]
        done = np.array([row for row in order.tolist() if growth.locate(row, surely=surely)], dtype=np.int64)
        failed[order] = True
        if len(done):
            failed[:] = False
            failed[np.setdiff1d(order, done)] = True
            growth.place_seen(done)


def _slopes(point: FloatArray) -> FloatArray:
    """(..., 3, 6) derivatives of a point in the robot's frame, less where it should be, by a twist of the robot."""
    found = np.zeros((*point.shape, 6))
    x, y, z = np.moveaxis(point, -1, 0)
    found[..., [0, 1, 2], [0, 1, 2]] = 1.0
    found[..., 0, 4], found[..., 0, 5] = z, -y
    found[..., 1, 3], found[..., 1, 5] = -z, x
    found[..., 2, 3], found[..., 2, 4] = y, -x
    return found


def _widest(point: FloatArray) -> IntArray:
    """(T, 3) triplets of points (K, 3), those of the largest areas."""
    triplet = np.array(list(combinations(range(min(len(point), 12)), 3)))
    a, b, c = (point[triplet[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.asarray(triplet[np.argsort(-area, kind="stable")[:TRIPLETS]])


def _refined(
    pose: FloatArray, point: FloatArray, covariance: FloatArray, place: FloatArray, spread: FloatArray,
    mean: FloatArray, told: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return poses (C, 7), refined; their costs (C,), information (C, 6, 6), squared distances (C, K) of points."""
    information, squared = np.zeros((len(pose), 6, 6)), np.zeros((len(pose), len(point)))
    cost = np.zeros(len(pose))
    for k in range(REFINED + 1):
        turn = se3.rotation_of(pose)
        back = np.swapaxes(turn, 1, 2)
        at = (place - pose[:, None, :3]) @ turn
        off = point - at
        own = np.linalg.inv(covariance + back[:, None] @ spread @ turn[:, None])
        squared = np.einsum("cki,ckij,ckj->ck", off, own, off)
        weight = (OUTLIER / (OUTLIER + squared)) ** 2
        slope = _slopes(at)
        pulled = np.swapaxes(slope, -1, -2) @ own * weight[..., None, None]
        information = (pulled @ slope).sum(axis=1)
        right = (pulled @ off[..., None])[..., 0].sum(axis=1)
        cost = 0.5 * (OUTLIER * squared / (OUTLIER + squared)).sum(axis=1)
        away = se3.local(mean, pose[:, None])
        pull = (told @ away[..., None])[..., 0]
        far = (away * pull).sum(axis=2)
        weight = (OUTLIER / (OUTLIER + far)) ** 2
        information = information + np.tensordot(weight, told, 1)
        right = right + (weight[..., None] * pull).sum(axis=1)
        cost = cost + 0.5 * (OUTLIER * far / (OUTLIER + far)).sum(axis=1)
        if k == REFINED:
            break
        step = np.linalg.solve(information + 1e-6 * np.eye(6), -right[..., None])[..., 0]
        size = np.linalg.norm(step[:, 3:], axis=1)
        step *= np.minimum(1.0, 0.5 / np.maximum(size, 1e-9))[:, None]
        pose = se3.retract(pose, step)
    return pose, cost, information, squared


def _agreed(at: FloatArray, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The point (3,) that most of some (K, 3) agree on, and its covariance."""
    off = at[:, None] - at[None]
    both = np.linalg.inv(spread[:, None] + spread[None])
    squared = np.einsum("abi,abij,abj->ab", off, both, off)
    near = squared < OUTLIER
    best = int(np.argmin(np.minimum(squared, OUTLIER).sum(axis=1)))
    information = np.linalg.inv(spread[near[best]])
    total = np.linalg.inv(information.sum(axis=0))
    return total @ (information @ at[near[best]][..., None]).sum(axis=0)[:, 0], total + SLACK_M**2 * np.eye(3)
