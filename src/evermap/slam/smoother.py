"""Batch smoothing in the plane: a `Problem` as a graph of poses, places and calibration, and its covariances.

Calibration states, which all measurements share, are the border of the elimination tree; the rest is `estimate`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.estimate.gauss_newton import Steps
from evermap.estimate.graph import Border, FactorBlock, Graph, GraphStructure, Layout, build_structure
from evermap.estimate.measurement import MeasurementFactors
from evermap.estimate.robust import HEAVY_TAIL
from evermap.estimate.solver import Solver
from evermap.estimate.sparse.system import Factorised, Slices, System, exhaust
from evermap.estimate.sparse.tree import tree_of
from evermap.estimate.start import StartFactor
from evermap.slam.calibration import BEARING, DELAY
from evermap.slam.correlation import LEAST_WEIGHT, Lasting, Pull, variance_of_clusters
from evermap.slam.kernels import N_MOTION, N_SENSOR, N_STATES
from evermap.slam.linearise import (
    OF_DETECTION,
    OF_INTERVAL,
    DetectionFactors,
    OdometryFactors,
    PlacePriors,
    Readings,
    build_place_priors,
    detection_residuals,
    deviate,
)
from evermap.slam.misfit import build_curves, variance_by_curves
from evermap.slam.problem import Estimate, Marginals, Noise, PlanarView, Problem
from evermap.types import ANY_BEARING_RAD, BoolArray, FloatArray, IntArray

COST_SLACK = 0.5
"""Nats by which the cost may rise in a step: weights change with calibration states and residuals, which is no harm."""
HELD = 1e-9
"""Information that keeps a landmark whose every sighting is an outlier from going anywhere."""
STRETCHES = 40
"""Stretches of a recording, which are taken to err independently of each other."""
LEAST_CHANGE = 1e-3
"""Share of the changes of velocity that is no jitter, at least."""
STANDS_OUT = 2.0
"""Standard deviations by which an error of the sensor does."""
POSES_A_LEAF = 8
"""Consecutive poses that are eliminated in one front: fewer make more fronts, more make larger ones."""
ODOMETRY, DETECTIONS = 0, 1
"""Blocks of a robot; behind them are the start and what a map says."""


class Smoother(Solver[Estimate]):
    """Optimum and covariances of one `Problem` at given noise.

    If `heavy`, outliers have the Cauchy's tails, as while the estimate may still be far off; if `robust`, outliers are
    explained, instead of every identity believed.
    """

    def __init__(self, problem: Problem, noise: Noise, *, heavy: bool = False, robust: bool = True) -> None:
        super().__init__()
        self.problem = problem
        self.noise = noise
        self.heavy = heavy
        self.robust = robust
        self._structure: tuple[BoolArray, GraphStructure] | None = None
        self._priors: tuple[BoolArray, tuple[PlacePriors, ...]] | None = None
        self._blocks: tuple[BoolArray, tuple[FactorBlock[Estimate], ...]] | None = None
        self._lasting: tuple[Estimate, Lasting] | None = None

    @property
    def states_sigma(self) -> FloatArray:
        """(11,) standard deviations of the prior of the calibration states."""
        return self.problem.prior.sigma

    def under(self, noise: Noise, *, heavy: bool, problem: Problem | None = None) -> Smoother:
        """Return the smoother at other noise; its structure is kept.

        Another `problem` may differ only in its start and in the prior of the calibration states.
        """
        other = Smoother(self.problem if problem is None else problem, noise, heavy=heavy, robust=self.robust)
        other._structure, other._priors = self._structure, self._priors
        return other

    def optimum(self, start: Estimate, *, iterations: int = 30, tolerance: float = 1e-6) -> Estimate:
        """Return the values at which `solve_in_slices` ends.

        Raises:
            NumericalError: no finite optimum.
        """
        return exhaust(self.solve_in_slices(start, iterations=iterations, tolerance=tolerance))[0]

    def solve_in_slices(
        self, start: Estimate, *, iterations: int = 30, tolerance: float = 1e-6, settled: float = 0.0
    ) -> Slices[tuple[Estimate, Marginals]]:
        """Run damped Gauss-Newton in slices; return the optimum and the covariances that its last step was made with.

        It ends after so many iterations, or with a step that moves nothing by `tolerance` (m or rad) or gains less than
        `settled` nats.
        """
        steps = Steps(iterations, tolerance, settled, COST_SLACK)
        solution = yield from self.minimise_in_slices(start, steps)
        estimate, solved = solution.state, solution.factorised
        if solved is None:
            solved = yield from self.factorise_in_slices(estimate)
        return estimate, self._marginals(estimate, solved)

    def inlier_probability(self, estimate: Estimate) -> FloatArray:
        """Return (M,) probability of every detection to be no outlier, given the estimate."""
        return self.linearised(estimate).weights[DETECTIONS]

    def marginals(self, estimate: Estimate) -> Marginals:
        """Return covariances of the Gaussian approximation at `estimate`; rows of unknown landmarks are zero.

        Raises:
            NumericalError: the measurements do not determine a solution.
        """
        return exhaust(self.marginals_in_slices(estimate))

    def marginals_in_slices(self, estimate: Estimate) -> Slices[Marginals]:
        """Return what `marginals` does, in slices."""
        solved = yield from self.factorise_in_slices(estimate)
        return self._marginals(estimate, solved)

    def _marginals(self, estimate: Estimate, solved: Factorised) -> Marginals:
        return Marginals(solved, len(estimate.pose), len(self.problem.pose_row), estimate.known)

    def worth(self, estimate: Estimate, marginals: Marginals) -> FloatArray:
        """Return (11,) variances of the states with correlated residuals, relative to those of independent ones.

        What each stretch of the recording adds to the states is summed before it is squared (`correlation`), and once
        more with landmarks as clusters. Errors that are known to be `lasting` for longer are correlated by landmark.
        The largest variance holds; 1 for states that are not free, and at least. Errors that come again with a distance
        or a direction add to it (`misfit`).
        """
        problem, n = self.problem, len(estimate.pose)
        if not problem.prior.free.any():
            return np.ones(N_STATES)
        now, structure, with_states = self.linearised(estimate), self.graph(estimate).structure, marginals.with_states
        odometry, detections = (
            Pull.of(structure.alike(block), pose, now.values, with_states)
            for block, pose in ((ODOMETRY, np.arange(n - 1)), (DETECTIONS, problem.pose_row))
        )
        by_place = np.zeros((len(estimate.known), N_STATES))
        np.add.at(by_place, problem.landmark_row, detections.by)
        independent = odometry.variance + detections.variance
        correlated = problem.correlated_variance(odometry, detections, self.lasting(estimate), STRETCHES)
        found = np.maximum(correlated, odometry.variance + variance_of_clusters(by_place))
        free = problem.prior.free & (independent > 0.0)
        independent = np.where(free, independent, 1.0)
        worth = np.where(free, np.maximum(found / independent, 1.0), 1.0)
        by_curves = self._variance_by_curves(estimate, marginals, worth)
        worth += np.where(free, by_curves / np.where(free, np.diag(marginals.states), 1.0), 0.0)
        # the delay shows where the velocity changes; where it only jitters, no delay explains it
        driven = now.values[structure.values_of(ODOMETRY)].reshape(-1, 3, OF_INTERVAL)
        row = problem.drive.rows_at(problem.stamp_s + estimate.states[DELAY])
        variance = problem.drive.jitter[row]
        of_both = np.where((row[1:] > row[:-1])[:, None], variance[1:] + variance[:-1], 0.0)  # one row is no change
        jitter = float(((driven[..., 3:6] ** 2).sum(axis=1) * of_both).sum())
        changes = max(float((driven[..., 6] ** 2).sum()), 1e-300)
        worth[DELAY] /= max(1.0 - jitter / changes, LEAST_CHANGE)
        return worth

    def _variance_by_curves(self, estimate: Estimate, marginals: Marginals, worth: FloatArray) -> FloatArray:
        """Return (11,) what curves of ranges add to variances of the states.

        They are sought where an error of the sensor stands out by its `worth` (11,), though none is expected.
        """
        problem, before = self.problem, 1.0 / self.states_sigma**2
        asked, off = problem.prior.free[: BEARING + 1], self.off_mean(estimate)
        posterior = 1.0 / np.where(problem.prior.free, np.diag(marginals.states), self.states_sigma**2)
        data = np.maximum(posterior - before, 1e-9 * before) * worth
        stands_out = (off * posterior) ** 2 > STANDS_OUT**2 * data
        expected = problem.prior.p_sensor > problem.prior.settings.p_needed
        if expected or not np.any(stands_out[: BEARING + 1] & asked):
            return np.zeros(N_STATES)
        curves = build_curves(problem.reading, self.inlier_probability(estimate) > LEAST_WEIGHT)
        information, right = self.information_of_curves(estimate, curves.value)
        fewer = float(worth[: BEARING + 1][asked].max())
        return variance_by_curves(information, right, before, off, fewer, curves)

    def information_of_curves(self, estimate: Estimate, value: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (11 + K, 11 + K) information of the measurements on the states and on curves of ranges; their pull.

        Curves have values (M, K) at the detections. All else is marginalised; priors of the states do not count.
        """
        graph, now, count = self.graph(estimate), self.linearised(estimate), value.shape[1]
        system, where = graph.structure.system, graph.structure.values_of(DETECTIONS)
        seen, sigma = self.detections(estimate), self.problem.find_sigma(self.noise)
        share = 1.0 if self.problem.share is None else self.problem.share
        by_curve = np.zeros((len(seen), 2, count))
        by_curve[:, 0] = -(np.sqrt(now.weights[DETECTIONS] * share) / sigma[:, 0])[:, None] * value
        seen = np.concatenate([seen[..., :-1], by_curve, seen[..., -1:]], axis=2)
        dim = system.tree.dim.copy()
        dim[system.tree.border[0]] += count  # behind the states of the sensor
        wider = System(dim, system.factors, graph.structure.coordinate, system.tree.border)
        values = np.concatenate([now.values[: where.start], seen.ravel(), now.values[where.stop :]])
        solved = exhaust(wider.factorised(values, extra=np.append(graph.held, np.zeros(count))))
        behind = N_SENSOR + np.arange(count)
        order = np.insert(np.arange(N_SENSOR), N_SENSOR, [*(N_SENSOR + count + np.arange(N_MOTION)), *behind])
        return solved.information[np.ix_(order, order)], solved.right[order]

    def lasting(self, estimate: Estimate) -> Lasting:
        """Return how long errors of detections last, by the residuals there; the last answer is kept."""
        if self._lasting is not None and self._lasting[0] is estimate:
            return self._lasting[1]
        problem, sigma = self.problem, self.problem.find_sigma(self.noise)
        residual = detection_residuals(problem, estimate) / np.where(sigma < ANY_BEARING_RAD, sigma, np.nan)
        found = problem.lasting(residual, self.inlier_probability(estimate))
        self._lasting = estimate, found
        return found

    def counted(self, estimate: Estimate, marginals: Marginals) -> Marginals:
        """Return covariances with each detection counted as what it is worth beside others of its landmark."""
        lasting, problem = self.lasting(estimate), self.problem
        if not lasting.any:
            return marginals
        counted = replace(problem, share=problem.new_information(lasting))
        return self.under(self.noise, heavy=self.heavy, problem=counted).marginals(estimate)

    def detections(self, estimate: Estimate) -> FloatArray:
        """Return (M, 2, 13) detections, linearised and whitened: by pose, place, sensor states; and the right side."""
        where = self.graph(estimate).structure.values_of(DETECTIONS)
        return self.linearised(estimate).values[where].reshape(-1, 2, OF_DETECTION)

    def information(self, estimate: Estimate, poses: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the information on some poses, the known landmarks and the states, with all other poses marginalised.

        Returns:
            (n, n) and (n,), n = 3 poses + 2 known landmarks + 11: information and right side of a step from `estimate`.
        """
        return exhaust(self.information_in_slices(estimate, poses))

    def information_in_slices(self, estimate: Estimate, poses: IntArray) -> Slices[tuple[FloatArray, FloatArray]]:
        """Return what `information` does, in slices."""
        now, graph = (yield from self.linearise_in_slices(estimate)), (yield from self.graph_in_slices(estimate))
        structure, tree, n = graph.structure, graph.structure.system.tree, len(estimate.pose)
        kept = np.concatenate([poses, np.arange(n, len(tree.dim))])
        ordered = yield from tree_of(tree.dim, structure.system.factors, structure.coordinate, kept)
        above = System(tree.dim, structure.system.factors, structure.coordinate, kept, ordered)
        solved = yield from above.factorised(now.values, extra=graph.held)
        information, right = solved.information, solved.right
        information[-N_STATES:, -N_STATES:] += np.diag(graph.border.information)
        right[-N_STATES:] += now.border_right
        return information, right

    def graph_in_slices(self, state: Estimate) -> Slices[Graph[Estimate]]:
        """Return the problem as a graph: poses, landmarks that have a position, sensor and motion states."""
        blocks = self.blocks(state.known)
        if self._structure is None or not np.array_equal(self._structure[0], state.known):
            places = np.full(int(state.known.sum()), 2)
            layout = Layout.of(state.pose[:, :2], 3, places, [N_SENSOR, N_MOTION], POSES_A_LEAF)
            structure = yield from build_structure(layout, blocks)
            self._structure = state.known, structure
        structure = self._structure[1]
        border = Border(1.0 / self.states_sigma**2, self.off_mean)
        return Graph(blocks, structure, border, structure.hold_places(HELD), retract)

    def blocks(self, known: BoolArray) -> tuple[FactorBlock[Estimate], ...]:
        """Return the factors: `ODOMETRY`, `DETECTIONS`, the start, and priors of the `known` (L,) landmarks."""
        if self._blocks is None or not np.array_equal(self._blocks[0], known):
            self._blocks = known, self._build_blocks(known)
        return self._blocks[1]

    def _build_blocks(self, known: BoolArray) -> tuple[FactorBlock[Estimate], ...]:
        problem, noise, n = self.problem, self.noise, len(self.problem.stamp_s)
        if self._priors is None or not np.array_equal(self._priors[0], known):
            self._priors = known, build_place_priors(problem, known, n)
        rank, sensor = np.cumsum(known) - 1, n + int(known.sum())
        log_odds, heavy = noise.outlier_log_odds if self.robust else np.inf, self.heavy and self.robust
        place_variable = np.where(known, n + rank, -1)
        seen = Readings(
            problem.pose_row,
            rank[problem.landmark_row],
            problem.reading,
            problem.find_sigma(noise),
            np.ones(len(problem.pose_row)) if problem.share is None else problem.share,
            problem.mount,
            problem.prior.free,
            log_odds,
            HEAVY_TAIL if heavy else 0.0,
        )
        return (
            OdometryFactors(problem, noise.odometry**2, sensor + 1),
            DetectionFactors(seen, known, n, sensor),
            StartFactor(problem.start_pose, np.full(3, np.sqrt(problem.start_information)), deviate),
            *self._priors[1],
            *(
                MeasurementFactors.of(tied, PlanarView(), place_variable, log_odds, heavy=heavy)
                for tied in problem.measurements
            ),
        )

    def off_mean(self, state: Estimate) -> FloatArray:
        """Return (11,) calibration states less the means of their prior."""
        return state.states - self.problem.prior.mean


def retract(state: Estimate, step: FloatArray) -> tuple[Estimate, float]:
    """Return values after a step, poses on the right, the rest added; and the largest number of it."""
    n, known = len(state.pose), state.known
    by = step[: 3 * n].reshape(n, 3)
    c, s = np.cos(state.pose[:, 2]), np.sin(state.pose[:, 2])
    pose = state.pose.copy()
    pose[:, 0] += c * by[:, 0] - s * by[:, 1]
    pose[:, 1] += s * by[:, 0] + c * by[:, 1]
    pose[:, 2] += by[:, 2]
    landmark = state.landmark.copy()
    states = len(state.states)
    landmark[known] += step[3 * n : -states].reshape(-1, 2)
    return Estimate(pose, landmark, state.states + step[-states:]), float(np.abs(step).max())
