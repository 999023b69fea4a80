"""Several robots in the plane that share landmarks and see each other, as one least-squares problem.

Each robot keeps its own poses, calibration and noise; an unmoved landmark is one place for all that saw it. A robot
that sees another measures range and bearing from its own pose to that of the other at the same instant: both have a
pose there, tied to their others by odometry, so nothing is interpolated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from evermap.estimate.gauss_newton import Steps
from evermap.estimate.graph import Border, FactorBlock, Room
from evermap.estimate.robust import HEAVY_TAIL, weigh
from evermap.estimate.sparse.system import Factorised, Slices, exhaust
from evermap.slam.kernels import N_MOTION, N_SENSOR, N_STATES, detection_residual, kernel
from evermap.slam.problem import Block, Estimate, Marginals
from evermap.slam.smoother import COST_SLACK, POSES_A_LEAF, Smoother, retract
from evermap.slam.together import Together
from evermap.types import BoolArray, FloatArray, IntArray

OF_ENCOUNTER = 3 + 3 + N_SENSOR + 1
"""Numbers of a row, by two poses and the states of the sensor, and the right side."""


class Encounters(NamedTuple):
    """Robots that see each other, one row each; poses are numbered through all robots.

    Attributes:
        observer, observed: (S,) poses.
        robot: (S,) whose the former are.
        reading: (S, 2) range [m] and bearing [rad] as reported, of the other robot's origin.
    """

    observer: IntArray
    observed: IntArray
    robot: IntArray
    reading: FloatArray


class Eyes(NamedTuple):
    """What robots measure others with.

    Attributes:
        free: (R, 11) calibration states that are estimated.
        mount: (R, 3) poses of the sensors.
        sigma: (R, 2) standard deviations of range [m] and bearing [rad].
        log_odds, tail: (R,) as for `robust.weigh`.
    """

    free: BoolArray
    mount: FloatArray
    sigma: FloatArray
    log_odds: FloatArray
    tail: FloatArray


@kernel
def linearise_encounters(
    pose: FloatArray, states: FloatArray, met: Encounters, eyes: Eyes, values: FloatArray, weight: FloatArray
) -> float:
    """Linearise encounters at poses (N, 3) and states (R, 11); return their negative log likelihood, up to a constant.

    Filled in are `values`, whitened factors in the layout of `sparse`, by observer, observed and the observer's sensor
    states, and inlier weights (S,).
    """
    cost, at = 0.0, 0
    z, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    for m in range(len(met.observer)):
        r, other = met.robot[m], pose[met.observed[m]]
        detection_residual(
            pose[met.observer[m]], other[:2], states[r], eyes.mount[r], met.reading[m, 0], met.reading[m, 1],
            z, jx, jl, jc,
        )  # fmt: skip
        squared = (z[0] / eyes.sigma[r, 0]) ** 2 + (z[1] / eyes.sigma[r, 1]) ** 2
        weight[m], loss = weigh(squared, eyes.log_odds[r], eyes.tail[r], 0.0)
        cost += loss
        c, s = math.cos(other[2]), math.sin(other[2])
        for row in range(2):
            scale = math.sqrt(weight[m]) / eyes.sigma[r, row]
            for a in range(3):
                values[at + a] = scale * jx[row, a]
            # the other's origin moves with its pose, which is perturbed on the right
            values[at + 3] = scale * (jl[row, 0] * c + jl[row, 1] * s)
            values[at + 4] = scale * (jl[row, 1] * c - jl[row, 0] * s)
            values[at + 5] = 0.0
            for a in range(N_SENSOR):
                values[at + 6 + a] = scale * jc[row, a] if eyes.free[r, a] else 0.0
            values[at + OF_ENCOUNTER - 1] = -scale * z[row]
            at += OF_ENCOUNTER
    return cost


class EncounterFactors(NamedTuple):
    """Robots that see each other.

    Attributes:
        met: who saw whom, with poses numbered through all robots.
        eyes: what they measured it with.
        sensor: (R,) variables of the sensor states of each robot.
    """

    met: Encounters
    eyes: Eyes
    sensor: IntArray

    @property
    def ties(self) -> IntArray:
        """Return (S, 3) two poses and the sensor states of the observer."""
        return np.column_stack([self.met.observer, self.met.observed, self.sensor[self.met.robot]])

    @property
    def rows(self) -> IntArray:
        """Return (S,) twos."""
        return np.full(len(self.met.robot), 2)

    @property
    def pose(self) -> IntArray:
        """Return (S,) the observing poses."""
        return self.met.observer

    def linearise(self, state: Estimate, out: Room) -> Slices[float]:
        """Fill in `linearise_encounters`."""
        states = state.states.reshape(-1, N_STATES)
        yield from ()
        return float(linearise_encounters(state.pose, states, self.met, self.eyes, out.values, out.weights))


class PlanarTogether(Together[Estimate]):
    """Optimum and covariances of several problems that share places, and of encounters.

    Its estimates are those of all robots: (N, 3) poses one robot after the other, (P, 2) places, (11 R,) states. What
    its marginals explain of detections is of the encounters; `parts` has those of each robot.

    Args:
        robots: the smoother of each.
        places: (L,) of each robot, which of the P places its own are.
        start_s: (R,) beginning of each problem's clock on that of all.
        met: robots that see each other.
        sigma: (R, 2) noise of what each robot measures of others.
    """

    def __init__(
        self,
        robots: Sequence[Smoother],
        places: Sequence[IntArray],
        start_s: FloatArray,
        met: Encounters,
        sigma: FloatArray,
    ) -> None:
        n_poses, calibration = [len(robot.problem.stamp_s) for robot in robots], np.arange(2 * len(robots))
        super().__init__(n_poses, places, list(calibration.reshape(-1, 2)), poses_a_leaf=POSES_A_LEAF)
        self.robots, self.start_s, self.met, self.sigma = tuple(robots), start_s, met, sigma
        self._own: tuple[Estimate, list[Estimate]] | None = None

    def of(self, robots: Sequence[Smoother], sigma: FloatArray) -> PlanarTogether:
        """Return the same for robots with other noise or priors; its structure is kept."""
        other = PlanarTogether(robots, self.places, self.start_s, self.met, sigma)
        other._structure = self._structure
        return other

    def estimates(self, estimate: Estimate) -> list[Estimate]:
        """Return the estimate of each robot."""
        if self._own is None or self._own[0] is not estimate:
            states = estimate.states.reshape(-1, N_STATES)
            parts = zip(pairwise(self.first), self.places, states, strict=True)
            own = [Estimate(estimate.pose[a:b], estimate.landmark[places], mine) for (a, b), places, mine in parts]
            self._own = (estimate, own)
        return self._own[1]

    def optimum(self, start: Estimate, *, iterations: int = 30, tolerance: float = 1e-6) -> Estimate:
        """Return the values at which `solve_in_slices` ends.

        Raises:
            NumericalError: no finite optimum.
        """
        return exhaust(self.minimise_in_slices(start, Steps(iterations, tolerance, 0.0, COST_SLACK))).state

    def solved(self, start: Estimate, steps: Steps) -> tuple[Estimate, Marginals]:
        """Return the optimum, and the covariances that its last step was made with."""
        solution = exhaust(self.minimise_in_slices(start, steps))
        return solution.state, self.marginals(solution.state, solution.factorised)

    def marginals(self, estimate: Estimate, solved: Factorised | None = None) -> Marginals:
        """Return covariances of the Gaussian approximation at `estimate`; those of detections are of the encounters.

        `solved` are the normal equations, where they are known.
        """
        known = estimate.known
        if solved is None:
            solved = exhaust(self.factorise_in_slices(estimate))
        n, places, first = len(estimate.pose), int(known.sum()), self.graph(estimate).structure.first
        block = Block(0, n + np.arange(places), n + places, 0, first[2 * len(self.robots)], n - len(self.robots))
        return Marginals(solved, n, len(self.met.robot), known, block=block)

    def parts(self, estimate: Estimate, marginals: Marginals) -> list[Marginals]:
        """Return the marginals of each robot, for those of all."""
        n, count, found = len(estimate.pose), len(self.robots), []
        first, variable = self.graph(estimate).structure.first, self.variables(estimate.known)
        for r, (robot, own) in enumerate(zip(self.robots, self.estimates(estimate), strict=True)):
            places, border = variable[r][len(own.pose) : -2], int(variable[r][-2])
            block = Block(int(self.first[r]), places, border, first[r], first[count + r], n - count)
            found.append(marginals.of(block, len(own.pose), len(robot.problem.pose_row), own.known))
        return found

    def squares(self, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
        """Return squared residuals (S, 2) of encounters, times their inlier probability, and the latter (S,)."""
        now, k = self.linearised(estimate), 2 * len(self.robots)
        right = now.values[self.graph(estimate).structure.values_of(k)].reshape(-1, 2, OF_ENCOUNTER)[..., -1]
        return (right * self.sigma[self.met.robot]) ** 2, now.weights[k]

    def own(self, state: Estimate, robot: int) -> Estimate:
        """Return the values of a robot."""
        return self.estimates(state)[robot]

    def _find_known(self, state: Estimate) -> BoolArray:
        return state.known

    def _dims(self) -> tuple[int, IntArray, IntArray]:
        count = 1 + max(int(places.max(initial=-1)) for places in self.places)
        return 3, np.full(count, 2), np.tile([N_SENSOR, N_MOTION], len(self.robots))

    def _coordinate(self, state: Estimate) -> FloatArray:
        when = [robot.problem.stamp_s + by for robot, by in zip(self.robots, self.start_s, strict=True)]
        robot = np.repeat(np.arange(len(self.robots), dtype=np.float64), np.diff(self.first))
        return np.column_stack([np.concatenate(when), state.pose[:, :2], robot])

    def _blocks(self, state: Estimate) -> list[tuple[FactorBlock[Estimate], ...]]:
        return [robot.blocks(own.known) for robot, own in zip(self.robots, self.estimates(state), strict=True)]

    def _between(self, variable: Sequence[IntArray]) -> list[FactorBlock[Estimate]]:
        return [EncounterFactors(self.met, self._eyes(), np.array([own[-2] for own in variable]))]

    def _border(self) -> Border[Estimate]:
        return Border(1.0 / np.concatenate([robot.states_sigma for robot in self.robots]) ** 2, self._off_mean)

    def _retract(self, state: Estimate, step: FloatArray) -> tuple[Estimate, float]:
        return retract(state, step)

    def _off_mean(self, state: Estimate) -> FloatArray:
        own = zip(self.robots, self.estimates(state), strict=True)
        return np.concatenate([robot.off_mean(estimate) for robot, estimate in own])

    def _eyes(self) -> Eyes:
        robots = self.robots
        return Eyes(
            np.array([robot.problem.prior.free for robot in robots]),
            np.array([robot.problem.mount for robot in robots]),
            self.sigma,
            np.array([robot.noise.outlier_log_odds if robot.robust else np.inf for robot in robots]),
            np.array([HEAVY_TAIL if robot.heavy and robot.robust else 0.0 for robot in robots]),
        )
