"""Batch smoothing in space: a `SpatialProblem` as a graph of poses, places and sensors, and the covariances there.

The border of the elimination tree are the mounts of the sensors and the delays of their stamps, which all detections
share, and the scale of the odometry.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from evermap.estimate.gauss_newton import Steps, minimise
from evermap.estimate.graph import (
    AlikeFactors,
    Border,
    FactorBlock,
    Graph,
    GraphStructure,
    Layout,
    Linear,
    build_structure,
)
from evermap.estimate.innovations import find_left_out_nis
from evermap.estimate.measurement import MeasurementFactors
from evermap.estimate.sparse.elimination import Spread
from evermap.estimate.sparse.system import Factorised, exhaust
from evermap.estimate.start import StartFactor
from evermap.geometry import se3
from evermap.slam.correlation import Lasting, Pull
from evermap.slam.space.drift import STRETCHES
from evermap.slam.space.factors import MapFactors, SightingFactors, SpatialOdometryFactors, deviate
from evermap.slam.space.linearise import MOUNT, OF_SIGHTING, OF_STEP, POINT, ROWS, STATES
from evermap.slam.space.problem import NO_JUMP_LOG_ODDS, SpatialEstimate, SpatialNoise, SpatialProblem, SpatialView
from evermap.types import BoolArray, FloatArray, IntArray

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
"""Share of the cost by which it may rise in a step."""
SETTLED = 0.02
"""Nats that a step must gain, or it was the last."""
FIRST_DAMPING = 1e-4
ODOMETRY, SIGHTINGS = 0, 1
"""Blocks; behind them are the start and what a map says."""


class SpatialLinear:
    """A problem at some values: the linearised graph, what its blocks say, and its normal equations a step before.

    There are none of a step that was damped, or where no step was made.
    """

    def __init__(self, now: Linear, smoother: SpatialSmoother, before: Factorised | None = None) -> None:
        self.now, self.before, self._smoother = now, before, smoother

    @property
    def values(self) -> FloatArray:
        """Whitened Jacobians and right sides of all factors."""
        return self.now.values

    @property
    def cost(self) -> float:
        """Negative log posterior, up to a constant."""
        return self.now.cost

    @property
    def weight(self) -> FloatArray:
        """(M,) weights of detections."""
        return self.now.weights[SIGHTINGS]

    @property
    def odometry_weight(self) -> FloatArray:
        """(N - 1,) weights of odometry."""
        return self.now.weights[ODOMETRY]

    @cached_property
    def residual(self) -> FloatArray:
        """(M, 8) whitened residuals of detections, not weighted; zeros behind those of a detection's kind."""
        return self._smoother.residual_of(self.now)


class SpatialSmoother:
    """Optimum and covariances of one `SpatialProblem`.

    Args:
        problem: the measurements.
        around: (N, 7) rough poses, along whose positions the elimination may be cut; the first is held where it is.
        structure: of a problem with the same variables and detections, if one is known.
    """

    def __init__(self, problem: SpatialProblem, around: FloatArray, structure: GraphStructure | None = None) -> None:
        self.problem = problem
        self._seen = problem.sightings
        sigma = np.append(np.column_stack([problem.mount_sigma, problem.delay_sigma_s]), problem.scale_sigma)
        information = np.where(sigma > 0.0, 1.0 / np.maximum(sigma, 1e-12) ** 2, FIXED)
        self._mean = np.zeros(len(sigma))
        delay = np.arange(MOUNT, len(sigma) - 1, STATES)
        information[delay] -= problem.delay_jitter
        self._mean[delay] = -problem.delay_jitter * problem.whole_s / information[delay]
        self._border = Border(information, self._off_mean)
        self._start = np.array(around[0])
        if structure is None:
            places, border = np.where(problem.oriented, 6, 3), [STATES] * len(problem.mount) + [1]
            layout = Layout.of(around[:, :3], 6, places, border, POSES_A_LEAF)
            structure = exhaust(build_structure(layout, self._blocks(SpatialNoise(), heavy=False)))
        self.structure = structure
        self._held = self.structure.hold_places(HELD)
        self.hold(self._held, self.structure.system.tree.begin)

    @property
    def states_information(self) -> FloatArray:
        """(7 S + 1,) information of the priors of mounts, delays and scale."""
        return self._border.information

    def _off_mean(self, estimate: SpatialEstimate) -> FloatArray:
        """Return the numbers of the border less their means: twists of the mounts, delays, and the scale."""
        return np.append(estimate.state, estimate.log_scale) - self._mean

    def hold(self, held: FloatArray, begin: IntArray) -> None:
        """Write what holds turns that no detection shows to the numbers of all variables, which begin there (V,)."""
        axis = self.problem.symmetries.axis
        about = np.flatnonzero(self.problem.oriented & (axis >= 0))
        held[begin[len(self.problem.stamp_s) + about] + 3 + axis[about]] = ANY_TURN

    def graph(self, noise: SpatialNoise, *, heavy: bool) -> Graph[SpatialEstimate]:
        """Return the problem as a graph at some noise levels; `heavy` as for `optimum`."""
        return Graph(self._blocks(noise, heavy=heavy), self.structure, self._border, self._held, self._retract)

    def optimum(
        self,
        start: SpatialEstimate,
        noise: SpatialNoise,
        *,
        heavy: bool,
        iterations: int = 20,
        tolerance: float = 1e-5,
        settled: float = SETTLED,
        wanted: float = np.inf,
    ) -> tuple[SpatialEstimate, SpatialLinear]:
        """Run damped Gauss-Newton from `start`, until steps are small.

        Args:
            start: values to start from.
            noise: standard deviations.
            heavy: outliers have the Cauchy's tails.
            iterations: at most.
            tolerance: largest move (m or rad) that ends it.
            settled: what a step must gain [nats], or it was the last.
            wanted: cost that is of use; see `Steps`.

        Raises:
            NumericalError: no finite optimum.
        """
        steps = Steps(iterations, tolerance, settled, 0.0, COST_SLACK, FIRST_DAMPING, wanted)
        solution = exhaust(minimise(self.graph(noise, heavy=heavy), start, steps))
        return solution.state, SpatialLinear(solution.now, self, solution.factorised)

    def linearised(self, estimate: SpatialEstimate, noise: SpatialNoise, *, heavy: bool) -> SpatialLinear:
        """Return the problem linearised at `estimate`."""
        return SpatialLinear(exhaust(self.graph(noise, heavy=heavy).linearised(estimate)), self)

    def factorised(self, now: SpatialLinear) -> Factorised:
        """Eliminate everything but the sensors' states and the scale of the odometry."""
        return exhaust(self.graph(SpatialNoise(), heavy=False).factorised(now.now))

    def spread(self, now: SpatialLinear, *, nearly: bool = False) -> Spread:
        """Return covariances of all variables and of what each factor ties; `nearly`: a step before will do."""
        factorised = now.before if nearly and now.before is not None else self.factorised(now)
        return exhaust(factorised.spread(len(self.problem.increment)))

    def find_nis(self, now: SpatialLinear, spread: Spread) -> FloatArray:
        """Return (M,) NIS of all detections, each as if it had not been used."""
        problem, nis = self.problem, np.zeros(len(self.problem.kind))
        weight, first = now.weight * problem.share, self.structure.first[SIGHTINGS]
        for kind in range(3):
            some, rows = np.flatnonzero(problem.kind == kind), int(ROWS[kind])
            if len(some):
                used = spread.explained(first + some, rows)
                left = (1.0 + 1e-9) * np.eye(rows) - used
                nis[some] = find_left_out_nis(now.residual[some, :rows], used, left, weight[some])
        return nis

    @cached_property
    def _odometry(self) -> list[AlikeFactors]:
        return self.structure.alike(ODOMETRY)

    @cached_property
    def _sightings(self) -> list[AlikeFactors]:
        return self.structure.alike(SIGHTINGS)

    def residual_of(self, now: Linear) -> FloatArray:
        """Return (M, 8) whitened residuals of detections, by the right sides of their factors."""
        scale = np.sqrt(now.weights[SIGHTINGS] * self._seen.share)
        found = np.zeros((len(scale), 8))
        for alike in self._sightings:
            found[alike.factor, : alike.rows] = -now.values[alike.right] / scale[alike.factor, None]
        return found

    def with_residuals(self, now: SpatialLinear, more: FloatArray) -> SpatialLinear:
        """Return the linearised problem with more residuals of detections (M, r), whitened and not weighted."""
        values, weighted = now.values.copy(), np.sqrt(now.weight * self._seen.share)[:, None] * more
        for alike in self._sightings:
            values[alike.right[:, : more.shape[1]]] -= weighted[alike.factor]
        return SpatialLinear(replace(now.now, values=values), self)

    @cached_property
    def sensor_of_pose(self) -> IntArray:
        """(N,) the sensor that saw something from each pose, or from the one before; the first where none did yet."""
        row, first = np.unique(self.problem.pose_row, return_index=True)
        last = np.searchsorted(row, np.arange(len(self.problem.stamp_s)), side="right") - 1
        return self.problem.sensor[first[np.maximum(last, 0)]]

    def driven(self, now: SpatialLinear) -> FloatArray:
        """Return (N - 1, 6, 14) odometry, linearised and whitened: by both poses, its scale, and the right side."""
        return now.values[self.structure.values_of(ODOMETRY)].reshape(-1, 6, OF_STEP)

    def information_of_places(self, now: SpatialLinear) -> list[FloatArray]:
        """Return for each place the (3, 3) or (6, 6) information that its detections hold on it, at fixed poses."""
        dims, found = np.where(self.problem.oriented, 6, 3), np.zeros((len(self.problem.oriented), 6, 6))
        for alike in self._sightings:
            dim = alike.number.shape[1] + 1 - OF_SIGHTING
            rows = now.values[alike.at[..., 6 : 6 + dim]]
            np.add.at(found[:, :dim, :dim], self._seen.place[alike.factor], np.swapaxes(rows, 1, 2) @ rows)
        return [one[:dim, :dim] for one, dim in zip(found, dims.tolist(), strict=True)]

    def lasting(self, now: SpatialLinear) -> Lasting:
        """Return how long errors of detections last, by their residuals there."""
        problem = self.problem
        residual = np.where(np.arange(8) < ROWS[problem.kind][:, None], now.residual, np.nan)
        return problem.lasting(residual, now.weight)

    def counted(
        self, estimate: SpatialEstimate, now: SpatialLinear, share: FloatArray | None = None
    ) -> SpatialSmoother:
        """Return the smoother that counts each detection as what it is worth beside others of its place.

        Args:
            estimate: the optimum.
            now: the problem there.
            share: (M,) of their information that is new; None or all of it: by the residuals, unless known already.
        """
        problem = self.problem
        share = None if share is None or np.all(share == 1.0) else share
        if share is None and np.all(problem.share == 1.0) and (lasting := self.lasting(now)).any:
            share = problem.new_information(lasting)
        return self if share is None else SpatialSmoother(replace(problem, share=share), estimate.pose)

    def worth_by_stretches(self, now: SpatialLinear, state: int) -> tuple[float, float]:
        """Return the variance of one of the border's numbers, and what one with correlated residuals has over it, at
        least 1.

        As of states in the plane (`slam.smoother.Smoother.worth`): by stretches of the drive, and by errors that last.
        """
        problem, with_it = self.problem, self.spread(now).with_border[:, state]
        odometry, detections = (
            Pull.of(alike, pose, now.values, with_it[:, None])
            for alike, pose in (
                (self._odometry, np.arange(len(problem.increment))),
                (self._sightings, problem.pose_row),
            )
        )
        independent = float((odometry.variance + detections.variance)[0])
        found = float(problem.correlated_variance(odometry, detections, self.lasting(now), STRETCHES, STRETCHES)[0])
        own = with_it[len(with_it) - len(self.states_information) :]
        return float(own[state]), max(found / max(independent, 1e-300), 1.0)

    def after(self, now: SpatialLinear, step: FloatArray) -> SpatialLinear:
        """Return the problem with the residuals of odometry and detections as they are after a step, by what is linear
        in it.
        """
        values = now.values.copy()
        for alike in (*self._odometry, *self._sightings):
            values[alike.right] -= alike.multiply(now.values, step[:, None])[..., 0]
        return SpatialLinear(replace(now.now, values=values), self)

    def _blocks(self, noise: SpatialNoise, *, heavy: bool) -> tuple[FactorBlock[SpatialEstimate], ...]:
        problem = self.problem
        n, count = len(problem.stamp_s), len(problem.oriented)
        sensor = n + count
        root = np.sqrt(np.maximum(problem.lasted_s, 1e-3))
        sigma = np.sqrt(problem.swing.variance(noise)) * root[:, None]
        jump = problem.settings.jump_log_odds if problem.driven and problem.robust else NO_JUMP_LOG_ODDS
        heavy = heavy and problem.robust
        first_seen = np.zeros(count, dtype=np.int64)
        first_seen[problem.place[::-1]] = problem.pose_row[::-1]
        prior, view = problem.prior.place, SpatialView(problem.oriented)
        log_odds = problem.settings.outlier_log_odds[POINT]
        return (
            SpatialOdometryFactors(problem.increment, problem.swing, sigma, jump, heavy, sensor + len(problem.mount)),
            SightingFactors(problem, self._seen, noise.levels, heavy, n, sensor),
            StartFactor(self._start, 1.0 / problem.start_sigma, deviate),
            MapFactors(problem, n + prior, first_seen[prior]),
            *(
                MeasurementFactors.of(tied, view, n + np.arange(count), log_odds, heavy=heavy)
                for tied in problem.measurements
            ),
        )

    def _retract(self, estimate: SpatialEstimate, step: FloatArray) -> tuple[SpatialEstimate, float]:
        """The estimate after a step, and how far it went."""
        problem, tree = self.problem, self.structure.system.tree
        n, count = len(problem.stamp_s), len(problem.oriented)
        by, turned, share, size = limit_turns(step, n, problem.oriented, tree.begin[n : n + count])
        place = estimate.place.copy()
        on = problem.oriented
        place[on] = se3.retract(place[on], share * turned[on])
        place[~on, :3] += share * turned[~on, :3]
        state = estimate.state + share * step[tree.begin[n + count] : -1].reshape(-1, STATES)
        log_scale = estimate.log_scale + share * float(step[-1])
        pose = self._retract_poses(estimate, share * by, state[:, MOUNT])
        return SpatialEstimate(pose, place, state, log_scale), size

    def _retract_poses(self, estimate: SpatialEstimate, by: FloatArray, delay_s: FloatArray) -> FloatArray:
        """Return poses (N, 7) after twists (N, 6), with delays (S,) after the same step.

        Where a sensor was when it saw something moves as linearised, and the robot is ahead of that by the odometry:
        else no long step of a delay is an improvement where detections are exact.
        """
        if np.array_equal(delay_s, estimate.delay_s):
            return se3.retract(estimate.pose, by)
        of, row = self.sensor_of_pose, np.arange(len(by))
        (back, by_delay), (after, _) = (self.problem.earlier(late_s) for late_s in (estimate.delay_s, delay_s))
        moved = se3.exp(-back[of, row])
        twist = np.einsum("nij,nj->ni", se3.adjoint(moved), by)
        twist += by_delay[of, row] * (delay_s - estimate.delay_s)[of, None]
        here = se3.retract(se3.retract(estimate.pose, back[of, row]), twist)
        return se3.retract(here, -after[of, row])


def limit_turns(
    step: FloatArray, n_poses: int, oriented: BoolArray, begin: IntArray
) -> tuple[FloatArray, FloatArray, float, float]:
    """Return the parts of a step: of poses (N, 6), of places (P, 6); the share of it that turns none too far; its size.

    Args:
        step: numbers of all variables.
        n_poses: N, which are the first.
        oriented: (P,) places with an orientation.
        begin: (P,) where their numbers begin.
    """
    by, turned = step[: 6 * n_poses].reshape(n_poses, 6), np.zeros((len(begin), 6))
    for k in range(6):
        some = oriented if k >= 3 else np.ones(len(begin), dtype=np.bool_)
        turned[some, k] = step[begin[some] + k]
    size = float(max(np.abs(by).max(), np.abs(turned).max(initial=0.0)))
    most = max(np.abs(by[:, 3:]).max(), np.abs(turned[:, 3:]).max(initial=0.0))
    return by, turned, min(1.0, LARGEST_TURN / max(float(most), 1e-12)), size
