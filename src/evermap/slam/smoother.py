"""Batch smoothing: damped Gauss-Newton on the sparse normal equations of poses, places and calibration.

Calibration states, which all measurements share, are the border of the elimination tree; the rest is `slam.sparse`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from evermap.errors import NumericalError
from evermap.geometry import se2
from evermap.slam.calibration import DELAY
from evermap.slam.kernels import N_MOTION, N_SENSOR, N_STATES
from evermap.slam.linearise import DETECTION, ODOMETRY, OF_DETECTION, OF_INTERVAL, Readings, linearise
from evermap.slam.problem import Estimate, Marginals, Noise, Problem, between_rows
from evermap.slam.sparse.elimination import curvature
from evermap.slam.sparse.system import Factorised, Slices, System, exhausted
from evermap.slam.sparse.tree import MS, Factors, tree_of
from evermap.types import BoolArray, FloatArray, IntArray

COST_SLACK = 0.5
"""Nats by which the cost may rise in a step: weights change with calibration states and residuals, which is no harm."""
HELD = 1e-9
"""Information that keeps a landmark whose every sighting is an outlier from going anywhere."""
POSES_A_SLICE = 500
"""Poses that are linearised, with their detections, in about a millisecond."""
STRETCHES = 40
"""Stretches of a recording, which are taken to err independently of each other."""
LEAST_CHANGE = 1e-3
"""Share of the changes of velocity that is no jitter, at least."""
POSES_A_LEAF = 8
"""Consecutive poses that are eliminated in one front: fewer make more fronts, more make larger ones."""


@dataclass(frozen=True, slots=True)
class Linearised:
    """A problem at some values.

    Attributes:
        values: Jacobians and right sides of all factors.
        weights: (M,) inlier probability of every detection.
        cost: negative log posterior up to a constant.
        states_right: (11,) pull of the prior of the calibration.
    """

    values: FloatArray
    weights: FloatArray
    cost: float
    states_right: FloatArray


@dataclass(frozen=True, slots=True)
class Equations:
    """The structure of the equations, which is independent of values and noise for the same known landmarks.

    Attributes:
        known: (L,) landmarks with a position.
        rank: (L,) their numbers.
        system: poses, then known landmarks, then sensor and motion states.
        coordinate: of its leaves.
        prior_roots: square roots (r, 2 k) of the information of landmarks that the prior ties.
        prior_rows: (k,) these landmarks.
    """

    known: BoolArray
    rank: IntArray
    system: System
    coordinate: FloatArray
    prior_roots: tuple[FloatArray, ...]
    prior_rows: tuple[IntArray, ...]


class Smoother:
    """Optimum and covariances of one `Problem` at given noise.

    If `heavy`, outliers have the Cauchy's tails, as while the estimate may still be far off; if `robust`, outliers are
    explained, instead of every identity believed.
    """

    def __init__(self, problem: Problem, noise: Noise, *, heavy: bool = False, robust: bool = True) -> None:
        self.problem = problem
        self.noise = noise
        self.heavy = heavy
        self.robust = robust
        self._structure: Equations | None = None
        self._last: tuple[Estimate, Linearised] | None = None

    @property
    def states_sigma(self) -> FloatArray:
        """(11,) standard deviations of the prior of the calibration states."""
        return self.problem.prior.sigma

    def under(self, noise: Noise, *, heavy: bool, problem: Problem | None = None) -> Smoother:
        """Return the smoother at other noise; its structure is kept.

        Another `problem` may differ only in its start and in the prior of the calibration states.
        """
        other = Smoother(self.problem if problem is None else problem, noise, heavy=heavy, robust=self.robust)
        other._structure = self._structure
        return other

    def optimum(self, start: Estimate, *, iterations: int = 30, tolerance: float = 1e-6) -> Estimate:
        """Return the values at which `solved_in_slices` ends.

        Raises:
            NumericalError: no finite optimum.
        """
        return exhausted(self.solved_in_slices(start, iterations=iterations, tolerance=tolerance))[0]

    def solved_in_slices(
        self, start: Estimate, *, iterations: int = 30, tolerance: float = 1e-6, settled: float = 0.0
    ) -> Slices[tuple[Estimate, Marginals]]:
        """Run damped Gauss-Newton in slices; return the optimum and the covariances that its last step was made with.

        It ends after so many iterations, or with a step that moves nothing by `tolerance` (m or rad) or gains less than
        `settled` nats.
        """
        estimate = start
        now = yield from self.linearised_in_slices(estimate)
        damping = 0.0
        undamped: Factorised | None = None
        for _ in range(iterations):
            solved = yield from self._eliminated(estimate, now, damping)
            step = yield from solved.solution()
            trial = self._moved(estimate, step)
            following = yield from self.linearised_in_slices(trial)
            if damping == 0.0:
                undamped = solved
            if np.isfinite(following.cost) and following.cost <= now.cost + COST_SLACK:
                gain = now.cost - following.cost
                estimate, now = trial, following
                if damping > 0.0:
                    undamped = None
                if np.abs(step).max() < tolerance or (damping == 0.0 and abs(gain) < settled):
                    break
                damping = 0.0 if damping < 1e-6 else damping / 10.0
            else:
                damping = max(1e-6, 10.0 * damping)
                if damping > 1e6:
                    break
        if not np.isfinite(now.cost):
            raise NumericalError("the smoother found no finite optimum", hint="check units and time stamps")
        self._last = (estimate, now)  # the last trial need not be the best
        if undamped is None:
            undamped = yield from self._eliminated(estimate, now, 0.0)
        return estimate, self._marginals(estimate, undamped)

    def cost(self, estimate: Estimate) -> float:
        """Return the negative log posterior up to a constant."""
        return self.linearised(estimate).cost

    def inlier_probability(self, estimate: Estimate) -> FloatArray:
        """Return (M,) probability of every detection to be no outlier, given the estimate."""
        return self.linearised(estimate).weights

    def marginals(self, estimate: Estimate) -> Marginals:
        """Return covariances of the Gaussian approximation at `estimate`; rows of unknown landmarks are zero.

        Raises:
            NumericalError: the measurements do not determine a solution.
        """
        return exhausted(self.marginals_in_slices(estimate))

    def marginals_in_slices(self, estimate: Estimate) -> Slices[Marginals]:
        """Return what `marginals` does, in slices."""
        now = yield from self.linearised_in_slices(estimate)
        solved = yield from self._eliminated(estimate, now, 0.0)
        return self._marginals(estimate, solved)

    def _marginals(self, estimate: Estimate, solved: Factorised) -> Marginals:
        return Marginals(solved, len(estimate.pose), len(self.problem.pose_row), estimate.known)

    def worth(self, estimate: Estimate, marginals: Marginals) -> FloatArray:
        """Return (11,) variances of the states with correlated residuals, relative to those of independent ones.

        What each stretch of the recording adds to the states is summed before it is squared, which makes no assumption
        on how errors hang together within it: White's covariance (1980), with stretches as clusters (Liang and Zeger
        1986). 1 for states that are not free, and at least.
        """
        problem, n = self.problem, len(estimate.pose)
        if not problem.prior.free.any():
            return np.ones(N_STATES)
        now, structure, with_states = self.linearised(estimate), self._structure_of(estimate), marginals.with_states
        pose, states = with_states[: 3 * n].reshape(n, 3, N_STATES), with_states[-N_STATES:]
        place = with_states[3 * n : -N_STATES].reshape(-1, 2, N_STATES)
        driven, seen = now.values[: ODOMETRY * (n - 1)].reshape(-1, 3, OF_INTERVAL), self.detections(estimate)
        of_driven = (
            np.einsum("nra,nas->nrs", driven[..., :3], pose[:-1])
            + np.einsum("nra,nas->nrs", driven[..., 3:6], pose[1:])
            + driven[..., 6:-1] @ states[N_SENSOR:]
        )
        of_seen = (
            np.einsum("nra,nas->nrs", seen[..., :3], pose[problem.pose_row])
            + np.einsum("nra,nas->nrs", seen[..., 3:5], place[structure.rank[problem.landmark_row]])
            + seen[..., 5:-1] @ states[:N_SENSOR]
        )
        stamp = problem.stamp_s - problem.stamp_s[0]
        stretch = np.minimum((stamp / max(stamp[-1], 1e-9) * STRETCHES).astype(np.int64), STRETCHES - 1)
        pull = np.zeros((STRETCHES, N_STATES))
        np.add.at(pull, stretch[:-1], np.einsum("nrs,nr->ns", of_driven, driven[..., -1]))
        np.add.at(pull, stretch[problem.pose_row], np.einsum("nrs,nr->ns", of_seen, seen[..., -1]))
        independent = (of_driven**2).sum(axis=(0, 1)) + (of_seen**2).sum(axis=(0, 1))
        found = (pull**2).sum(axis=0) * STRETCHES / (STRETCHES - 1.0)
        free = problem.prior.free & (independent > 0.0)
        worth = np.where(free, np.maximum(found / np.where(free, independent, 1.0), 1.0), 1.0)
        # the delay shows where the velocity changes; where it only jitters, no delay explains it
        jitter = 2.0 * (driven[..., 3:6] ** 2).sum(axis=(0, 1)) @ problem.drive.jitter
        changes = max(float((driven[..., 6] ** 2).sum()), 1e-300)
        worth[DELAY] /= max(1.0 - jitter / changes, LEAST_CHANGE)
        return worth

    def detections(self, estimate: Estimate) -> FloatArray:
        """Return (M, 2, 13) detections, linearised and whitened: by pose, place, sensor states; and the right side."""
        begin = ODOMETRY * (len(estimate.pose) - 1)
        values = self.linearised(estimate).values[begin : begin + DETECTION * len(self.problem.pose_row)]
        return values.reshape(-1, 2, OF_DETECTION)

    def information(self, estimate: Estimate, poses: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the information on some poses, the known landmarks and the states, with all other poses marginalised.

        Returns:
            (n, n) and (n,), n = 3 poses + 2 known landmarks + 11: information and right side of a step from `estimate`.
        """
        now, structure = self.linearised(estimate), self._structure_of(estimate)
        system, n = structure.system, len(estimate.pose)
        kept = np.concatenate([poses, np.arange(n, len(system.tree.dim))])
        above = System(system.tree.dim, system.factors, structure.coordinate, kept)
        solved = exhausted(above.factorised(now.values, extra=self._extra(above, n)))
        information, right = solved.information, solved.right
        information[-N_STATES:, -N_STATES:] += np.diag(1.0 / self.problem.prior.sigma**2)
        right[-N_STATES:] += now.states_right
        return information, right

    def linearised(self, estimate: Estimate) -> Linearised:
        """Return the problem linearised at `estimate`; landmarks without position are left out."""
        return exhausted(self.linearised_in_slices(estimate))

    def linearised_in_slices(self, estimate: Estimate) -> Slices[Linearised]:
        """Return what `linearised` does, in slices."""
        if self._last is not None and self._last[0] is estimate:
            return self._last[1]
        problem, noise, structure = self.problem, self.noise, (yield from self._structured(estimate))
        values, weights = np.zeros(structure.system.tree.value_first[-1]), np.zeros(len(problem.pose_row))
        driven = yield from problem.drive.in_slices(problem.stamp_s, estimate.states)
        place, variance, cost = estimate.landmark[structure.known], noise.odometry**2, 0.0
        seen = Readings(
            problem.pose_row,
            structure.rank[problem.landmark_row],
            problem.reading,
            noise.of_detections(problem.sigma_given),
            problem.mount,
            problem.prior.free,
            noise.outlier_log_odds if self.robust else np.inf,
            self.heavy and self.robust,
        )
        bounds = [*range(0, len(estimate.pose), POSES_A_SLICE), len(estimate.pose)]
        rows = np.searchsorted(problem.pose_row, bounds).tolist()
        for (begin, end), (first, last) in zip(pairwise(bounds), pairwise(rows), strict=True):
            cost += linearise(
                estimate.pose, place, estimate.states, driven, variance, seen, values, weights,
                begin, min(end, len(estimate.pose) - 1), first, last,
            )  # fmt: skip
            yield (end - begin) / POSES_A_SLICE
        at = ODOMETRY * (len(estimate.pose) - 1) + DETECTION * len(problem.pose_row)
        held = np.sqrt(problem.start_information) * np.eye(3, 4)
        off = np.array(se2.between(problem.start_pose, estimate.pose[0]))
        off[:2] = se2.rotation(-estimate.pose[0, 2]) @ (estimate.pose[0, :2] - problem.start_pose[:2])
        held[:, 3] = -np.sqrt(problem.start_information) * off
        values[at : at + 12] = held.ravel()
        at += 12
        cost += 0.5 * float(held[:, 3] @ held[:, 3])
        for rows, root in zip(structure.prior_rows, structure.prior_roots, strict=True):
            pull = -root @ (estimate.landmark[rows] - problem.landmark_mean[rows]).ravel()
            values[at : at + root.size + len(root)] = np.column_stack([root, pull]).ravel()
            at += root.size + len(root)
            cost += 0.5 * float(pull @ pull)
        off_mean = estimate.states - problem.prior.mean
        states_right = -off_mean / problem.prior.sigma**2
        cost -= 0.5 * float(off_mean @ states_right)
        now = Linearised(values, weights, float(cost), states_right)
        self._last = (estimate, now)
        return now

    def _eliminated(self, estimate: Estimate, now: Linearised, damping: float) -> Slices[Factorised]:
        system, n = self._structure_of(estimate).system, len(estimate.pose)
        extra, states = self._extra(system, n), 1.0 / self.states_sigma**2
        if damping > 0.0:
            own = extra + curvature(system.tree, system.factors, now.values)
            own[-len(states) :] += states
            extra = extra + damping * own
        return system.factorised(
            now.values, extra=extra, border_information=np.diag(states), border_right=now.states_right
        )

    def _extra(self, system: System, n_poses: int) -> FloatArray:
        extra = np.zeros(system.tree.begin[-1])
        extra[3 * n_poses : -len(self.states_sigma)] = HELD
        return extra

    def _structure_of(self, estimate: Estimate) -> Equations:
        return exhausted(self._structured(estimate))

    def _structured(self, estimate: Estimate) -> Slices[Equations]:
        known, kept = estimate.known, self._structure
        if kept is not None and np.array_equal(kept.known, known):
            return kept
        problem, n = self.problem, len(estimate.pose)
        rank, count = np.cumsum(known) - 1, int(known.sum())
        sensor, motion = n + count, n + count + 1
        roots, rows = _roots(problem.prior_information(known), np.flatnonzero(known))
        place = rank[problem.landmark_row]
        steps, detections = np.arange(n - 1), np.arange(len(place))
        tied = [
            np.column_stack([steps, steps + 1, np.full(n - 1, motion)]),
            np.column_stack([problem.pose_row, n + place, np.full(len(detections), sensor)]),
            np.zeros((1, 1), dtype=np.int64),
            *(n + rank[row][None] for row in rows),
        ]
        yield MS * len(place)
        leaf_of_pose = np.minimum(np.arange(n), max(n - 2, 0)) // POSES_A_LEAF
        first_seen = np.full(count, -1)
        first_seen[place[::-1]] = leaf_of_pose[problem.pose_row[::-1]]
        n_leaves = int(leaf_of_pose[-1]) + 1
        prior_leaf = []
        for row in rows:
            seen = first_seen[rank[row[0]]] if len(row) == 1 else -1
            prior_leaf.append(seen if seen >= 0 else n_leaves)
            n_leaves += seen < 0
        width = [np.full(len(part), part.shape[1]) for part in tied]
        factors = Factors(
            np.append(0, np.cumsum(np.concatenate(width))).astype(np.int64),
            np.concatenate([part.ravel() for part in tied]).astype(np.int64),
            np.append(np.repeat([3, 2, 3], [n - 1, len(place), 1]), [len(root) for root in roots]).astype(np.int64),
            np.concatenate([leaf_of_pose[steps], leaf_of_pose[problem.pose_row], [0], prior_leaf]).astype(np.int64),
        )
        yield MS * len(place)
        dim = np.concatenate([np.full(n, 3), np.full(count, 2), [N_SENSOR, N_MOTION]])
        at = np.zeros((n_leaves, 3))
        at[:, 0] = np.arange(n_leaves)
        weight = np.bincount(leaf_of_pose, minlength=n_leaves)
        for axis in range(2):
            total = np.bincount(leaf_of_pose, estimate.pose[:, axis], minlength=n_leaves)
            at[:, 1 + axis] = total / np.maximum(weight, 1)
        for leaf, row in zip(prior_leaf, rows, strict=True):
            if weight[leaf] == 0:
                at[leaf, 0] = 0.5 * n_leaves
                at[leaf, 1:] = estimate.landmark[row].mean(axis=0)
        yield MS * n
        border = np.array([sensor, motion])
        tree = yield from tree_of(dim, factors, at, border)
        self._structure = Equations(known, rank, System(dim, factors, at, border, tree), at, roots, rows)
        return self._structure

    def _moved(self, estimate: Estimate, step: FloatArray) -> Estimate:
        """The estimate after a step: poses on the right, the rest added."""
        n = len(estimate.pose)
        by = step[: 3 * n].reshape(n, 3)
        c, s = np.cos(estimate.pose[:, 2]), np.sin(estimate.pose[:, 2])
        pose = estimate.pose.copy()
        pose[:, 0] += c * by[:, 0] - s * by[:, 1]
        pose[:, 1] += s * by[:, 0] + c * by[:, 1]
        pose[:, 2] += by[:, 2]
        landmark = estimate.landmark.copy()
        states = len(estimate.states)
        landmark[estimate.known] += step[3 * n : -states].reshape(-1, 2)
        return Estimate(pose, landmark, estimate.states + step[-states:])


def _roots(information: sparse.csr_array, rows: IntArray) -> tuple[tuple[FloatArray, ...], tuple[IntArray, ...]]:
    """Square roots of a joint prior (2 K, 2 K) of landmarks `rows`, one for those that it ties, and these."""
    at, to = information.nonzero()
    given = np.unique(at // 2)
    if not len(given):
        return (), ()
    ties = sparse.csr_array((np.ones(len(at)), (at // 2, to // 2)), shape=(len(rows), len(rows)))
    _, group = connected_components(ties, directed=False)
    given = given[np.argsort(group[given], kind="stable")]
    roots, members = [], []
    for mine in np.split(given, 1 + np.flatnonzero(np.diff(group[given]))):
        own = se2.xy_rows(mine)
        size, direction = np.linalg.eigh(between_rows(information, own).toarray())
        kept = size > 1e-12 * size[-1]
        roots.append(np.sqrt(size[kept])[:, None] * direction[:, kept].T)
        members.append(rows[mine])
    return tuple(roots), tuple(members)
