"""Initial poses and places from constellations: three points in view locate a robot among points that are known.

So does one tag, or object with an orientation, but less well, and its view may have two explanations. Frame by frame
in the order of time, an error of one pose is in all that follow. Here the frame that is determined best by the places
known by then comes next, from a frame that shares most with others; what its pose is uncertain by is in the places that
it adds. Every pose is asked from each triplet of points in view (rigid alignment, random sample consensus), from each
orientation in both ways, and from its neighbours in time. An orientation counts once the views of its place leave no
other.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from evermap.geometry import se3
from evermap.geometry.group import accumulate
from evermap.geometry.rigid import rigid
from evermap.slam.space.estimate import locate_unseen
from evermap.slam.space.linearise import CORNERS, POINT, STATES
from evermap.slam.space.problem import SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.types import BoolArray, FloatArray, IntArray

TRIPLETS = 16
"""Triplets of points in one frame that are tried, the widest of them."""
MOST_FRAMES, MOST_GROWN = 1000, 300
"""Frames of which those to begin with are chosen, and frames that are located one by one, at most."""
OUTLIER = 16.0
"""Squared normalised distance of an outlier, at which a point costs no more."""
REFINED, FEW, SETTLED = 6, 4, 1e-4
"""Gauss-Newton steps of a pose, at most; poses that more than one is worth; step (m or rad) that is the last."""
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
SLACK_RAD = 0.02
"""And of known orientations [rad]."""
LEAD = 3.0
"""Nats by which an orientation must be ahead of any other to be known."""
UNLIKELY = 1e-6
"""Likelihood of an orientation that neither explanation has."""
LOST_M = 0.5
"""A pose that is more uncertain than this adds no places while others are left [m]."""
FEWEST_LOST = 2
NEAR_S = 1.0
"""Outliers in a frame, which outnumber the rest, that make it lost, and what is lost together lies this close [s]."""


@dataclass(slots=True)
class _Turns:
    """Orientations that detections have, and places by now.

    Attributes:
        gives: (M,) detections of an orientation, none of whose turns looks the same.
        seen: (2, M, 7) poses of their places in the robot's frame, by both explanations.
        log_share: (2, M) logarithms of the probability of each explanation, by itself.
        variance: (M,) of the orientation about every axis [rad^2].
        known: (P,) places with an orientation.
        place: (P, 4) these.
        spread: (P,) and their variances [rad^2].
        other_rad: orientations that are further apart are two explanations [rad].
    """

    gives: BoolArray
    seen: FloatArray
    log_share: FloatArray
    variance: FloatArray
    known: BoolArray
    place: FloatArray
    spread: FloatArray
    other_rad: float

    @classmethod
    def of(cls, problem: SpatialProblem, noise: SpatialNoise, mount: FloatArray) -> _Turns:
        """Begin with the orientations of a map that still stand."""
        count, by_corners = len(problem.oriented), problem.kind == CORNERS
        whole = problem.symmetries.of[problem.place] == 0
        gives = problem.oriented[problem.place] & (problem.kind != POINT) & whole
        other = np.exp(-np.clip(problem.other_log_odds / noise.pixel**2, 0.0, 30.0))
        other = np.where(np.isfinite(problem.other[:, 3]), other, 0.0)
        log_share = np.log(np.stack([np.ones_like(other), other + 1e-12]) / (1.0 + other))
        sigma = problem.sigma_rad * np.where(by_corners, noise.pixel, noise.orientation)
        known, place, spread = np.zeros(count, dtype=np.bool_), np.tile(se3.NO_TURN, (count, 1)), np.zeros(count)
        prior, stands = problem.prior, problem.prior.weight > problem.settings.inlier
        place[prior.place], spread[prior.place] = prior.pose[:, 3:], prior.sigma[:, 3:].max(axis=1) ** 2
        known[prior.place[stands]] = problem.oriented[prior.place[stands]]
        other_rad = problem.settings.repair.other_rad
        known &= spread < other_rad**2
        seen = se3.compose(mount, np.where(gives[:, None], problem.either, se3.identity()))
        return cls(
            gives, seen, log_share, np.where(gives, sigma, 1.0) ** 2 + SLACK_RAD**2, known, place, spread, other_rad
        )

    def surely(self, place: IntArray) -> BoolArray:
        """Return (M,) detections of one orientation, of places (M,) whose orientation is known."""
        return np.asarray(self.gives & self.known[place] & (self.log_share[1] < -LEAD))

    def suggest(self, mine: IntArray, at: FloatArray, place: IntArray) -> FloatArray:
        """Return poses (C, 7) of the robot by each orientation that it sees, of places at (K, 3), rows (K,)."""
        some = self.gives[mine] & self.known[place]
        there = np.hstack([at[some], self.place[place[some]]])
        found = se3.compose(there, se3.inverse(self.seen[:, mine[some]]))
        return found.reshape(-1, 7)

    def agree(self, place: int, mine: IntArray, pose: FloatArray, spread: FloatArray) -> None:
        """Give a place the orientation that most of its detections (K,) agree on, from poses (K, 7).

        It stays unknown while another one is nearly as probable.

        Args:
            place: its row.
            mine: the detections.
            pose: of the robot there.
            spread: (K,) variances of the orientations of these [rad^2].
        """
        some = self.gives[mine]
        if not some.any():
            return
        mine, variance = mine[some], self.variance[mine[some]] + spread[some]
        seen, share = se3.compose(pose[some], self.seen[:, mine]), np.exp(self.log_share[:, mine])
        candidate = seen.reshape(-1, 7)
        angle = se3.angle_between(candidate[:, None, None], seen[None])
        each = (share * np.exp(-0.5 * angle**2 / variance)).sum(axis=1)
        score = np.log(each + UNLIKELY).sum(axis=1)
        best = int(np.argmax(score))
        away = se3.angle_between(candidate, candidate[best]) > self.other_rad
        self.known[place] = bool(score[best] - score[away].max(initial=-np.inf) > LEAD)
        nearest = np.argmin(angle[best], axis=0)
        near = angle[best][nearest, np.arange(len(mine))] ** 2 < OUTLIER * variance
        weight = near / variance
        off = se3.local(candidate[best], seen[nearest, np.arange(len(mine))])[:, 3:]
        mean = np.append(np.zeros(3), weight @ off / weight.sum())
        self.place[place] = se3.retract(se3.turn(candidate[best, 3:]), mean)[3:]
        self.spread[place] = 1.0 / weight.sum() + SLACK_RAD**2


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
        turn: orientations, where detections have them.
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
    turn: _Turns

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
            _Turns.of(problem, noise, mount),
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
        turn, turned = self.turn, np.flatnonzero(self.turn.surely(problem.place))
        by_turns = 1.0 / (turn.variance[turned] + turn.spread[problem.place[turned]])
        total[:, 3:, 3:] += np.bincount(problem.pose_row[turned], by_turns, len(total))[:, None, None] * np.eye(3)
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
        candidate += [*self.turn.suggest(mine, self.place[where], where)]
        if not candidate:
            return False
        pose, cost, information, squared = _refine_poses(
            np.array(candidate), self.point[mine], self.covariance[mine], self.place[where], self.place_spread[where],
            mean, told, _SeenTurns.of(self.turn, mine, where),
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
            self.place[place], self.place_spread[place] = _find_agreed_point(at[mine], spread[mine])
            self.known[place] = True
            rows = problem.pose_row[some[mine]]
            variance = np.trace(self.spread[rows, 3:, 3:], axis1=1, axis2=2) / 3.0
            self.turn.agree(place, some[mine], self.pose[rows], variance)

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
    common = seen @ seen.T
    shares = common >= 3.0
    if problem.oriented.any() and not (shares & ~np.eye(len(rows), dtype=np.bool_)).any():
        shares = common >= 1.0  # an orientation is enough
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
    place = np.hstack([growth.place, growth.turn.place])
    place[problem.prior.place] = problem.prior.pose
    pose = growth.pose
    if seed is not None:
        back = se3.inverse(pose[0])
        pose, place = se3.compose(back, pose), se3.compose(back, place)
    place[~problem.oriented, 3:] = se3.NO_TURN
    known = np.zeros(len(place), dtype=np.bool_)
    known[problem.prior.place] = True
    return locate_unseen(problem, SpatialEstimate(pose, place, np.zeros((len(problem.mount), STATES))), known)


def locate_again(
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
    good, bad = weight > problem.settings.inlier, find_lost_frames(problem, weight)
    if not bad.any() or bad.all():
        return None
    bad = _widen_bad(bad, problem.stamp_s)
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


def find_lost_frames(problem: SpatialProblem, weight: FloatArray) -> BoolArray:
    """Return (N,) frames in which most detections, and at least two, are outliers by their weights (M,)."""
    seen = np.bincount(problem.pose_row, minlength=len(problem.stamp_s))
    good = weight > problem.settings.inlier
    agrees = np.bincount(problem.pose_row[good], minlength=len(seen))
    return np.asarray((seen - agrees >= FEWEST_LOST) & (2 * agrees < seen))


def _widen_bad(bad: BoolArray, stamp_s: FloatArray) -> BoolArray:
    """(N,) frames that are bad, or within `NEAR_S` of such ones on both sides."""
    at = np.concatenate([[-np.inf], stamp_s[bad], [np.inf]])
    after = np.searchsorted(at, stamp_s)
    return np.asarray((stamp_s - at[after - 1] < NEAR_S) & (at[after] - stamp_s < NEAR_S) | bad)


def _grow(growth: _Growth) -> None:
    """Locate all frames, the best determined ones first, and the places that they see.

    Of very many frames some are located, and the others by the motion from the nearest of these.
    """
    left_out = ~_choose_frames(growth)
    surely, failed = True, np.zeros(len(growth.located), dtype=np.bool_)
    while not (growth.located | left_out).all():
        unsure = np.where(failed | left_out, np.inf, growth.uncertainty(growth.information()))
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
    rest = np.flatnonzero(left_out & ~growth.located)
    if len(rest):
        (before, after), there = growth.neighbours()
        stamp_s = growth.problem.stamp_s
        nearer = stamp_s[after[rest]] - stamp_s[rest] < stamp_s[rest] - stamp_s[before[rest]]
        nearest = np.where((nearer & there[1, rest]) | ~there[0, rest], after[rest], before[rest])
        growth.pose[rest] = growth.motion(rest, nearest)[0]
        missing = np.setdiff1d(growth.problem.place, np.flatnonzero(growth.known))
        growth.located[rest[np.isin(rest, growth.problem.pose_row[np.isin(growth.problem.place, missing)])]] = True
        growth.place_seen(rest[growth.located[rest]])


def _choose_frames(growth: _Growth) -> BoolArray:
    """Return (N,) frames to locate: all, or of each stretch of very many the one that sees most; and those located."""
    n = len(growth.located)
    if n - np.count_nonzero(growth.located) <= MOST_GROWN:
        return np.ones(n, dtype=np.bool_)
    seen, stretch = np.diff(growth.first), np.arange(n) * MOST_GROWN // n
    order = np.lexsort((-seen, stretch))
    taken = order[np.append(True, np.diff(stretch[order]) > 0)]
    return np.asarray(np.isin(np.arange(n), taken) | growth.located)


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


@dataclass(frozen=True, slots=True)
class _SeenTurns:
    """Orientations in one frame, of places whose orientation is known.

    Attributes:
        seen: (2, T, 7) turns of the places in the robot's frame, by both explanations.
        cost: (2, T) nats that each explanation costs by itself.
        place: (T, 7) turns of the places in the world.
        information: (T,) of the difference [1/rad^2].
    """

    seen: FloatArray
    cost: FloatArray
    place: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, turn: _Turns, mine: IntArray, place: IntArray) -> _SeenTurns:
        """Take those of some detections (K,), of places in rows (K,)."""
        some = turn.gives[mine] & turn.known[place]
        mine, place = mine[some], place[some]
        information = 1.0 / (turn.variance[mine] + turn.spread[place])
        seen = se3.turn(turn.seen[:, mine, 3:])
        return cls(seen, -turn.log_share[:, mine], se3.turn(turn.place[place]), information)

    def pull(self, pose: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what poses (C, 7) cost (C,), information (C,) about each axis, and right sides (C, 3)."""
        there = se3.compose(se3.inverse(se3.turn(pose[:, 3:]))[:, None], self.place)
        off = se3.local(there[:, None], self.seen)[..., 3:]
        squared = (off**2).sum(axis=-1) * self.information
        each = self.cost + 0.5 * OUTLIER * squared / (OUTLIER + squared)
        nearer = np.argmin(each, axis=1)[:, None]
        squared = np.take_along_axis(squared, nearer, axis=1)[:, 0]
        off = np.take_along_axis(off, nearer[..., None], axis=1)[:, 0]
        weight = self.information * (OUTLIER / (OUTLIER + squared)) ** 2
        off = (se3.rotation_of(there) @ off[..., None])[..., 0]
        return each.min(axis=1).sum(axis=1), weight.sum(axis=1), (weight[..., None] * off).sum(axis=1)


def _refine_poses(
    pose: FloatArray, point: FloatArray, covariance: FloatArray, place: FloatArray, spread: FloatArray,
    mean: FloatArray, told: FloatArray, turns: _SeenTurns,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return poses (C, 7), refined; their costs (C,), information (C, 6, 6), squared distances (C, K) of points.

    Of more than `FEW` poses those that cost the least are refined, after one step of each.
    """
    for k in range(REFINED + 1):
        information, right, cost, squared = _linearise_poses(pose, point, covariance, place, spread, mean, told, turns)
        if k == REFINED:
            break
        if k == 1 and len(pose) > FEW:
            best = np.argsort(cost, kind="stable")[:FEW]
            pose, information, right = pose[best], information[best], right[best]
        step = np.linalg.solve(information + 1e-6 * np.eye(6), -right[..., None])[..., 0]
        size = np.linalg.norm(step[:, 3:], axis=1)
        step *= np.minimum(1.0, 0.5 / np.maximum(size, 1e-9))[:, None]
        pose = se3.retract(pose, step)
        if k > 0 and np.abs(step).max() < SETTLED:
            information, right, cost, squared = _linearise_poses(
                pose, point, covariance, place, spread, mean, told, turns
            )
            break
    return pose, cost, information, squared


def _linearise_poses(
    pose: FloatArray, point: FloatArray, covariance: FloatArray, place: FloatArray, spread: FloatArray,
    mean: FloatArray, told: FloatArray, turns: _SeenTurns,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return the information (C, 6, 6) at poses (C, 7), right sides (C, 6), costs (C,), squared distances (C, K)."""
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
    if len(turns.information):
        by_turns, weight, pull = turns.pull(pose)
        information[:, 3:, 3:] += weight[:, None, None] * np.eye(3)
        right[:, 3:] += pull
        cost = cost + by_turns
    return information, right, cost, squared


def _find_agreed_point(at: FloatArray, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The point (3,) that most of some (K, 3) agree on, and its covariance."""
    off = at[:, None] - at[None]
    both = np.linalg.inv(spread[:, None] + spread[None])
    squared = np.einsum("abi,abij,abj->ab", off, both, off)
    near = squared < OUTLIER
    best = int(np.argmin(np.minimum(squared, OUTLIER).sum(axis=1)))
    information = np.linalg.inv(spread[near[best]])
    total = np.linalg.inv(information.sum(axis=0))
    return total @ (information @ at[near[best]][..., None]).sum(axis=0)[:, 0], total + SLACK_M**2 * np.eye(3)
