"""Batch smoothing in space: damped Gauss-Newton on the sparse normal equations, and the covariances there.

The border of the elimination tree are the sensors' mounts, which all detections share, and the scale of the odometry.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.errors import NumericalError
from evermap.geometry import se3
from evermap.slam.space.drift import STRETCHES
from evermap.slam.space.linearise import ODOMETRY, ROWS, STATES, linearise_odometry, linearise_sightings
from evermap.slam.space.problem import NO_JUMP_LOG_ODDS, SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.slam.sparse.elimination import Spread, curvature
from evermap.slam.sparse.system import Factorised, System, exhausted
from evermap.slam.sparse.tree import Factors
from evermap.types import FloatArray

POSES_A_LEAF = 4
HELD = 1e-9
"""Information that keeps a place whose every detection is an outlier from going anywhere."""
FIXED = 1e12
"""Information on a calibration state that is known exactly."""
ANY_TURN = 3.0 / np.pi**2
"""Information about how a place is turned about an axis of symmetry: nothing but that a turn is less than half a full
one. It holds what no detection shows, and ties it to nothing."""
LARGEST_TURN = 0.5
"""A step turns no pose by more [rad]."""
COST_SLACK = 1e-3
SETTLED = 0.02
"""Nats that a step must gain, or it was the last."""


@dataclass(frozen=True, slots=True)
class SpatialLinear:
    """A problem at some values: Jacobians and right sides, weights of detections and of odometry, residuals, cost."""

    values: FloatArray
    weight: FloatArray
    odometry_weight: FloatArray
    residual: FloatArray
    states_right: FloatArray
    cost: float


class SpatialSmoother:
    """Optimum and covariances of one `SpatialProblem`.

    Args:
        problem: the measurements.
        around: (N, 7) rough poses, along whose positions the elimination may be cut; the first is held where it is.
    """

    def __init__(self, problem: SpatialProblem, around: FloatArray) -> None:
        self.problem = problem
        self._seen, self._back = problem.sightings, problem.earlier()
        sigma = np.append(problem.mount_sigma, problem.scale_sigma)
        self._states = np.where(sigma > 0.0, 1.0 / np.maximum(sigma, 1e-12) ** 2, FIXED)
        self._start = np.array(around[0])
        self.system = self._structured(around)
        axis = problem.symmetries.axis
        about = np.flatnonzero(problem.oriented & (axis >= 0))
        self._unseen = self.system.tree.begin[len(problem.stamp_s) + about] + 3 + axis[about]

    def optimum(
        self, start: SpatialEstimate, noise: SpatialNoise, *, heavy: bool, iterations: int = 20, tolerance: float = 1e-5
    ) -> tuple[SpatialEstimate, SpatialLinear]:
        """Run damped Gauss-Newton from `start`, until steps are small.

        Args:
            start: values to start from.
            noise: standard deviations.
            heavy: outliers have the Cauchy's tails.
            iterations: at most.
            tolerance: largest move (m or rad) that ends it.

        Raises:
            NumericalError: no finite optimum.
        """
        estimate, now, damping = start, self.linearised(start, noise, heavy=heavy), 0.0
        for _ in range(iterations):
            step = exhausted(self.factorised(now, damping).solution())
            trial, size = self._moved(estimate, step)
            following = self.linearised(trial, noise, heavy=heavy)
            if np.isfinite(following.cost) and following.cost <= now.cost + COST_SLACK * (1.0 + abs(now.cost)):
                gain = now.cost - following.cost
                estimate, now = trial, following
                if size < tolerance or (damping == 0.0 and abs(gain) < SETTLED):
                    break
                damping = 0.0 if damping < 1e-5 else damping / 10.0
            else:
                damping = max(1e-4, 10.0 * damping)
                if damping > 1e6:
                    break
        if not np.isfinite(now.cost):
            raise NumericalError("the smoother found no finite optimum", hint="check units and time stamps")
        return estimate, now

    def linearised(self, estimate: SpatialEstimate, noise: SpatialNoise, *, heavy: bool) -> SpatialLinear:
        """Return the problem linearised at `estimate`."""
        problem, tree = self.problem, self.system.tree
        n, count = len(problem.stamp_s), len(problem.place)
        values = np.zeros(tree.value_first[-1])
        odometry_weight, weight, residual = np.ones(n - 1), np.ones(count), np.zeros((count, 8))
        sigma = _odometry_sigma(problem, noise)
        odometry = ODOMETRY * (n - 1)
        jump = problem.settings.jump_log_odds if problem.driven else NO_JUMP_LOG_ODDS
        cost = linearise_odometry(
            estimate.pose, problem.increment, estimate.log_scale, sigma, jump, heavy, values[:odometry],
            odometry_weight,
        )  # fmt: skip
        end = odometry + int(self._seen.first[-1])
        cost += linearise_sightings(
            estimate.pose, estimate.place, estimate.mount(problem), self._back, noise.levels,
            self._seen, heavy, values[odometry:end], weight, residual,
        )  # fmt: skip
        held = se3.local(self._start, estimate.pose[0])
        root = 1.0 / problem.start_sigma
        block = np.column_stack([root[:, None] * se3.right_jacobian_inverse(held), -root * held])
        values[end : end + 42] = block.ravel()
        cost += 0.5 * float(np.sum((root * held) ** 2)) + self._priors(estimate, values, end + 42)
        off = np.append(estimate.state, estimate.log_scale)
        cost += 0.5 * float(off @ (self._states * off))
        return SpatialLinear(values, weight, odometry_weight, residual, -self._states * off, float(cost))

    def factorised(self, now: SpatialLinear, damping: float = 0.0) -> Factorised:
        """Eliminate everything but the sensors' states and the scale of the odometry."""
        tree = self.system.tree
        extra = np.zeros(tree.begin[-1])
        extra[6 * len(self.problem.stamp_s) : -len(self._states)] = HELD
        extra[self._unseen] = ANY_TURN
        if damping > 0.0:
            own = extra + curvature(tree, self.system.factors, now.values)
            own[-len(self._states) :] += self._states
            extra = extra + damping * own
        work = self.system.factorised(
            now.values, extra=extra, border_information=np.diag(self._states), border_right=now.states_right
        )
        return exhausted(work)

    def spread(self, now: SpatialLinear) -> Spread:
        """Return covariances of all variables and of what each factor ties."""
        return exhausted(self.factorised(now).spread(len(self.problem.increment)))

    def scale_by_stretches(self, now: SpatialLinear) -> tuple[float, float]:
        """Return the variance of the odometry's scale, and what one with correlated residuals has over it, at least 1.

        As of the states in the plane (`slam.smoother.Smoother.worth`): what each stretch of the drive adds is summed
        before it is squared.
        """
        problem, tree, seen = self.problem, self.system.tree, self._seen
        n, with_scale = len(problem.stamp_s), self.spread(now).with_border[:, -1]
        begin, odometry = tree.begin, ODOMETRY * (n - 1)
        share = problem.stamp_s / max(problem.stamp_s[-1], 1e-9)
        stretch = np.minimum((STRETCHES * share).astype(np.int64), STRETCHES - 1)
        pose, scale = with_scale[: 6 * n].reshape(n, 6), with_scale[-1:]
        by = np.hstack([pose[:-1], pose[1:], np.tile(scale, (n - 1, 1))])
        parts = [(stretch[:-1], now.values[:odometry].reshape(n - 1, 6, 14), by)]
        for kind, n_rows in enumerate(ROWS.tolist()):
            for dim in (3, 6):
                some = np.flatnonzero((seen.kind == kind) & (seen.oriented == (dim == 6)))
                at = odometry + seen.first[some][:, None] + np.arange(n_rows * (13 + dim))
                place = begin[n + seen.place[some]][:, None] + np.arange(dim)
                sensor = begin[n + len(problem.oriented) + seen.sensor[some]][:, None] + np.arange(STATES)
                by = np.hstack([pose[seen.pose_row[some]], with_scale[place], with_scale[sensor]])
                rows = now.values[at].reshape(len(some), n_rows, 13 + dim)
                parts.append((stretch[seen.pose_row[some]], rows, by))
        pull, independent = np.zeros(STRETCHES), 0.0
        for of, rows, by in parts:
            told = np.einsum("mra,ma->mr", rows[..., :-1], by)
            pull += np.bincount(of, (told * rows[..., -1]).sum(axis=1), STRETCHES)
            independent += float((told**2).sum())
        found = (pull**2).sum() * STRETCHES / (STRETCHES - 1.0)
        return float(scale[0]), max(float(found / max(independent, 1e-300)), 1.0)

    def _priors(self, estimate: SpatialEstimate, values: FloatArray, at: int) -> float:
        """Fill in what the given map says; returns its cost."""
        prior, problem = self.problem.prior, self.problem
        turned = problem.oriented[prior.place]
        first = at + np.append(0, np.cumsum(np.where(turned, 42, 12)))
        cost = 0.0
        for some, dim in ((np.flatnonzero(turned), 6), (np.flatnonzero(~turned), 3)):
            off = problem.off_map(some, estimate.place[prior.place[some]], oriented=dim == 6)
            root = (np.sqrt(prior.weight[some])[:, None] / prior.sigma[some])[:, :dim]
            jacobian = se3.right_jacobian_inverse(off) if dim == 6 else np.eye(3)
            block = np.concatenate([root[..., None] * jacobian, -(root * off)[..., None]], axis=2)
            values[first[some][:, None] + np.arange(dim * (dim + 1))] = block.reshape(len(some), dim * (dim + 1))
            cost += 0.5 * float(np.sum((root * off) ** 2))
        return cost

    def _structured(self, around: FloatArray) -> System:
        problem = self.problem
        n, count = len(problem.stamp_s), len(problem.oriented)
        steps, prior = np.arange(n - 1), problem.prior.place
        dims = np.where(problem.oriented, 6, 3)
        leaf_of_pose = np.minimum(np.arange(n), max(n - 2, 0)) // POSES_A_LEAF
        tied = [
            np.column_stack([steps, steps + 1, np.full(n - 1, n + count + len(problem.mount))]),
            np.column_stack([problem.pose_row, n + problem.place, n + count + problem.sensor]),
            np.zeros((1, 1), dtype=np.int64),
            (n + prior)[:, None],
        ]
        first_seen = np.zeros(count, dtype=np.int64)
        first_seen[problem.place[::-1]] = leaf_of_pose[problem.pose_row[::-1]]
        width = np.concatenate([np.full(len(part), part.shape[1]) for part in tied])
        rows = np.concatenate([np.full(n - 1, 6), ROWS[problem.kind], [6], dims[prior]])
        leaf = np.concatenate([leaf_of_pose[steps], leaf_of_pose[problem.pose_row], [0], first_seen[prior]])
        n_leaves = int(leaf_of_pose[-1]) + 1
        factors = Factors(
            np.append(0, np.cumsum(width)).astype(np.int64),
            np.concatenate([part.ravel() for part in tied]).astype(np.int64),
            rows.astype(np.int64),
            leaf.astype(np.int64),
        )
        at = np.zeros((n_leaves, 4))
        at[:, 0] = np.arange(n_leaves)
        weight = np.bincount(leaf_of_pose, minlength=n_leaves)
        for axis in range(3):
            total = np.bincount(leaf_of_pose, around[:, axis], minlength=n_leaves)
            at[:, 1 + axis] = total / np.maximum(weight, 1)
        dim = np.concatenate([np.full(n, 6), dims, np.full(len(problem.mount), STATES), [1]])
        border = n + count + np.arange(len(problem.mount) + 1)
        return System(dim, factors, at, border)

    def _moved(self, estimate: SpatialEstimate, step: FloatArray) -> tuple[SpatialEstimate, float]:
        """The estimate after a step, and how far it went."""
        problem, tree = self.problem, self.system.tree
        n, count = len(problem.stamp_s), len(problem.oriented)
        by = step[: 6 * n].reshape(n, 6)
        begin = tree.begin[n : n + count]
        turned = np.zeros((count, 6))
        for k in range(6):
            some = problem.oriented if k >= 3 else np.ones(count, dtype=np.bool_)
            turned[some, k] = step[begin[some] + k]
        size = float(max(np.abs(by).max(), np.abs(turned).max(initial=0.0)))
        most = max(np.abs(by[:, 3:]).max(), np.abs(turned[:, 3:]).max(initial=0.0))
        share = min(1.0, LARGEST_TURN / max(float(most), 1e-12))
        place = estimate.place.copy()
        on = problem.oriented
        place[on] = se3.retract(place[on], share * turned[on])
        place[~on, :3] += share * turned[~on, :3]
        state = estimate.state + share * step[tree.begin[n + count] : -1].reshape(-1, STATES)
        log_scale = estimate.log_scale + share * float(step[-1])
        return SpatialEstimate(se3.retract(estimate.pose, share * by), place, state, log_scale), size


def _odometry_sigma(problem: SpatialProblem, noise: SpatialNoise) -> FloatArray:
    """Return (N - 1, 6) standard deviations of the odometry between consecutive poses."""
    root = np.sqrt(np.maximum(problem.lasted_s, 1e-3))
    return np.repeat(np.column_stack([noise.translation * root, noise.rotation * root]), 3, axis=1)
