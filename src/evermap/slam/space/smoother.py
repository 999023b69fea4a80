"""Batch smoothing in space: a `SpatialProblem` as a graph of poses, places and sensors, and the covariances there.

The border of the elimination tree are the mounts of the sensors and the delays of their stamps, which all detections
share, and the scale of the odometry.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np

from evermap.estimate.gauss_newton import Steps, minimised
from evermap.estimate.graph import (
    Border,
    FactorBlock,
    Graph,
    GraphStructure,
    Layout,
    Linear,
    build_structure,
    grouped,
)
from evermap.estimate.innovations import find_left_out_nis
from evermap.estimate.measurement import MeasurementFactors, Tied
from evermap.estimate.sparse.elimination import Spread
from evermap.estimate.sparse.system import Factorised, exhausted
from evermap.geometry import se3
from evermap.slam.correlation import Lasting, lasting_errors
from evermap.slam.space.drift import STRETCHES
from evermap.slam.space.factors import MapFactors, SightingFactors, SpatialOdometryFactors, SpatialStartFactor
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
        n, count = len(problem.stamp_s), len(problem.oriented)
        dim = np.concatenate(
            [np.full(n, 6), np.where(problem.oriented, 6, 3), np.full(len(problem.mount), STATES), [1]]
        )
        leaf = grouped(n, POSES_A_LEAF)
        layout = Layout(
            dim, n + count + np.arange(len(problem.mount) + 1), leaf, np.column_stack([leaf, around[:, :3]])
        )
        if structure is None:
            structure = exhausted(build_structure(layout, self._blocks(SpatialNoise(), heavy=False)))
        self.structure = structure
        begin = self.structure.system.tree.begin
        self._held = np.zeros(begin[-1])
        self._held[6 * n : -len(sigma)] = HELD
        self.hold(self._held, begin)

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
        solution = exhausted(minimised(self.graph(noise, heavy=heavy), start, steps))
        return solution.state, SpatialLinear(solution.now, self, solution.factorised)

    def linearised(self, estimate: SpatialEstimate, noise: SpatialNoise, *, heavy: bool) -> SpatialLinear:
        """Return the problem linearised at `estimate`."""
        return SpatialLinear(exhausted(self.graph(noise, heavy=heavy).linearised(estimate)), self)

    def factorised(self, now: SpatialLinear) -> Factorised:
        """Eliminate everything but the sensors' states and the scale of the odometry."""
        return exhausted(self.graph(SpatialNoise(), heavy=False).factorised(now.now))

    def spread(self, now: SpatialLinear, *, nearly: bool = False) -> Spread:
        """Return covariances of all variables and of what each factor ties; `nearly`: a step before will do."""
        factorised = now.before if nearly and now.before is not None else self.factorised(now)
        return exhausted(factorised.spread(len(self.problem.increment)))

    def find_nis(self, now: SpatialLinear, spread: Spread) -> FloatArray:
        """Return (M,) NIS of all detections, each as if it had not been used."""
        problem, nis = self.problem, np.zeros(len(self.problem.kind))
        first = spread.of_factors_first[len(problem.increment) :]
        for kind in range(3):
            some, rows = np.flatnonzero(problem.kind == kind), int(ROWS[kind])
            if not len(some):
                continue
            at = first[some][:, None] + np.arange(rows * rows)
            used = spread.of_factors[at].reshape(-1, rows, rows)
            left = (1.0 + 1e-9) * np.eye(rows) - used
            weight = (now.weight * problem.share)[some]
            nis[some] = find_left_out_nis(now.residual[some, :rows], used, left, weight)
        return nis

    def residual_of(self, now: Linear) -> FloatArray:
        """Return (M, 8) whitened residuals of detections, by the right sides of their factors."""
        seen, values = self._seen, now.values[self.structure.values_of(SIGHTINGS)]
        scale = np.sqrt(now.weights[SIGHTINGS] * seen.share)
        found = np.zeros((len(seen.kind), 8))
        rows, width = ROWS[seen.kind], np.diff(seen.first) // ROWS[seen.kind]
        for k in range(int(rows.max(initial=0))):
            some = np.flatnonzero(rows > k)
            found[some, k] = -values[seen.first[some] + (k + 1) * width[some] - 1] / scale[some]
        return found

    def with_residuals(self, now: SpatialLinear, more: FloatArray) -> SpatialLinear:
        """Return the linearised problem with more residuals of detections (M, r), whitened and not weighted."""
        seen, values = self._seen, now.values.copy()
        own = values[self.structure.values_of(SIGHTINGS)]
        scale, width = np.sqrt(now.weight * seen.share), np.diff(seen.first) // ROWS[seen.kind]
        for k in range(more.shape[1]):
            own[seen.first[:-1] + (k + 1) * width - 1] -= scale * more[:, k]
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
        seen, dims = self._seen, np.where(self.problem.oriented, 6, 3)
        values, found = now.values[self.structure.values_of(SIGHTINGS)], np.zeros((len(dims), 6, 6))
        for kind, n_rows in enumerate(ROWS.tolist()):
            for dim in (3, 6):
                some = np.flatnonzero((seen.kind == kind) & (dims[seen.place] == dim))
                at = seen.first[some][:, None] + np.arange(n_rows * (OF_SIGHTING + dim))
                rows = values[at].reshape(len(some), n_rows, OF_SIGHTING + dim)[..., 6 : 6 + dim]
                np.add.at(found[:, :dim, :dim], seen.place[some], np.swapaxes(rows, 1, 2) @ rows)
        return [one[:dim, :dim] for one, dim in zip(found, dims.tolist(), strict=True)]

    def lasting(self, now: SpatialLinear) -> Lasting:
        """Return how long errors of detections last, by their residuals there."""
        problem = self.problem
        residual = np.where(np.arange(8) < ROWS[problem.kind][:, None], now.residual, np.nan)
        return lasting_errors(residual, now.weight, problem.stamp_s[problem.pose_row], problem.place)

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
            share = lasting.information(problem.stamp_s[problem.pose_row], problem.place)
        return self if share is None else SpatialSmoother(replace(problem, share=share), estimate.pose)

    def worth_by_stretches(self, now: SpatialLinear, state: int) -> tuple[float, float]:
        """Return the variance of one of the border's numbers, and what one with correlated residuals has over it, at
        least 1.

        As of the states in the plane (`slam.smoother.Smoother.worth`): what each stretch of the drive adds is summed
        before it is squared.
        """
        problem = self.problem
        with_it = self.spread(now).with_border[:, state]
        share = problem.stamp_s / max(problem.stamp_s[-1], 1e-9)
        stretch = np.minimum((STRETCHES * share).astype(np.int64), STRETCHES - 1)
        pull, independent, influence = np.zeros(STRETCHES), 0.0, np.zeros((len(self._seen.kind), 8, 1))
        for pose_row, rows, _, told, some in self._told(now.values, with_it):
            pull += np.bincount(stretch[pose_row], (told * rows[..., -1]).sum(axis=1), STRETCHES)
            independent += float((told**2).sum())
            influence[some, : told.shape[1], 0] = told[: len(some)]
        found = (pull**2).sum() * STRETCHES / (STRETCHES - 1.0)
        alike = self.lasting(now).variance_beside(influence, problem.stamp_s[problem.pose_row], problem.place)
        found = max(found, independent + float(alike[0]))
        own = with_it[len(with_it) - len(self.states_information) :]
        return float(own[state]), max(float(found / max(independent, 1e-300)), 1.0)

    def after(self, now: SpatialLinear, step: FloatArray) -> SpatialLinear:
        """Return the problem with the residuals of odometry and detections as they are after a step, by what is linear
        in it.
        """
        values = now.values.copy()
        for _, _, at, told, _ in self._told(now.values, step):
            values[at[..., -1]] -= told
        return SpatialLinear(replace(now.now, values=values), self)

    def _told(
        self, values: FloatArray, numbers: FloatArray
    ) -> Iterator[tuple[IntArray, FloatArray, IntArray, FloatArray, IntArray]]:
        """Yield odometry, and detections of each kind, times numbers of all variables.

        That is their poses (m,), rows (m, r, width), where these are among the values, rows times numbers (m, r), and
        which detections they are: none of odometry.
        """
        problem, structure, seen = self.problem, self.structure, self._seen
        n, begin, odometry = len(problem.stamp_s), structure.system.tree.begin, structure.values_of(ODOMETRY).stop
        pose, scale = numbers[: 6 * n].reshape(n, 6), numbers[-1:]
        by, at = np.hstack([pose[:-1], pose[1:], np.tile(scale, (n - 1, 1))]), np.arange(odometry)
        parts = [(np.arange(n - 1), at.reshape(n - 1, 6, OF_STEP), by, np.zeros(0, dtype=np.int64))]
        for kind, n_rows in enumerate(ROWS.tolist()):
            for dim in (3, 6):
                some = np.flatnonzero((seen.kind == kind) & (seen.oriented == (dim == 6)))
                at = odometry + seen.first[some][:, None] + np.arange(n_rows * (OF_SIGHTING + dim))
                place = begin[n + seen.place[some]][:, None] + np.arange(dim)
                sensor = begin[n + len(problem.oriented) + seen.sensor[some]][:, None] + np.arange(STATES)
                by = np.hstack([pose[seen.pose_row[some]], numbers[place], numbers[sensor]])
                parts.append((seen.pose_row[some], at.reshape(len(some), n_rows, OF_SIGHTING + dim), by, some))
        for pose_row, at, by, some in parts:
            rows = values[at]
            yield pose_row, rows, at, np.einsum("mra,ma->mr", rows[..., :-1], by), some

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
        prior = problem.prior.place
        return (
            SpatialOdometryFactors(problem.increment, problem.swing, sigma, jump, heavy, sensor + len(problem.mount)),
            SightingFactors(problem, self._seen, noise.levels, heavy, n, sensor),
            SpatialStartFactor(self._start, problem.start_sigma),
            MapFactors(problem, n + prior, first_seen[prior]),
            *(self._measured(tied, heavy) for tied in problem.measurements),
        )

    def _measured(self, tied: Tied, heavy: bool) -> MeasurementFactors[SpatialEstimate]:
        problem, other = self.problem, tied.others
        if tied.kind.ties == "pose_place":
            other = len(problem.stamp_s) + other
        log_odds = problem.settings.outlier_log_odds[POINT]
        return MeasurementFactors(tied, SpatialView(problem.oriented), other, log_odds, heavy)

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
