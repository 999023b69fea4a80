"""Several robots that share landmarks and see each other, as one least-squares problem.

Each keeps its own poses, calibration and noise; an unmoved landmark is one place for all that saw it. A robot that sees
another measures range and bearing from its own pose to that of the other at the same instant: both have a pose there,
tied to their others by odometry, so nothing is interpolated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from evermap.slam.kernels import N_MOTION, N_SENSOR, N_STATES, detection_residual, inlier_weight, kernel, outlier_loss
from evermap.slam.linearise import DETECTION, ODOMETRY
from evermap.slam.problem import Block, Estimate, Marginals
from evermap.slam.smoother import POSES_A_LEAF, Equations, Linearised, Smoother
from evermap.slam.sparse.system import Factorised, Slices, System
from evermap.slam.sparse.tree import Factors
from evermap.types import BoolArray, FloatArray, IntArray

OF_ENCOUNTER = 3 + 3 + N_SENSOR + 1
ENCOUNTER = 2 * OF_ENCOUNTER
"""Numbers of a row, by two poses and the states of the sensor, and the right side; and of an encounter, of two rows."""


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


class _Eyes(NamedTuple):
    """Sensor data for the encounters.

    Of each robot (R, 11) states and which are free, (R, 3) mounts, (R, 2) standard deviations, and (R,) as for
    `kernels.inlier_weight`.
    """

    states: FloatArray
    free: BoolArray
    mount: FloatArray
    sigma: FloatArray
    log_odds: FloatArray
    heavy: BoolArray


@kernel
def linearise_encounters(pose: FloatArray, met: Encounters, eyes: Any, values: FloatArray, weight: FloatArray) -> float:
    """Linearise encounters at poses (N, 3); return their negative log likelihood, up to a constant.

    Filled in are `values`, whitened factors in the layout of `sparse`, by observer, observed and the observer's sensor
    states, and inlier weights (S,).
    """
    cost, at = 0.0, 0
    z, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    for m in range(len(met.observer)):
        r, other = met.robot[m], pose[met.observed[m]]
        detection_residual(
            pose[met.observer[m]], other[:2], eyes.states[r], eyes.mount[r], met.reading[m, 0], met.reading[m, 1],
            z, jx, jl, jc,
        )  # fmt: skip
        squared = (z[0] / eyes.sigma[r, 0]) ** 2 + (z[1] / eyes.sigma[r, 1]) ** 2
        weight[m] = inlier_weight(squared, eyes.log_odds[r], eyes.heavy[r])
        cost += outlier_loss(squared, eyes.log_odds[r], eyes.heavy[r])
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


class Together(Smoother):
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
        super().__init__(robots[0].problem, robots[0].noise)
        self.robots, self.places, self.start_s, self.met, self.sigma = tuple(robots), places, start_s, met, sigma
        self.first = np.cumsum([0, *(len(robot.problem.stamp_s) for robot in robots)])
        self._blocks: tuple[Block, ...] = ()
        self._own: tuple[Estimate, list[Estimate]] | None = None

    def of(self, robots: Sequence[Smoother], sigma: FloatArray) -> Together:
        """Return the same for robots with other noise or priors; its structure is kept."""
        other = Together(robots, self.places, self.start_s, self.met, sigma)
        other._structure, other._blocks = self._structure, self._blocks
        return other

    @property
    def states_sigma(self) -> FloatArray:
        """(11 R,) standard deviations of the priors of all calibration states."""
        return np.concatenate([robot.states_sigma for robot in self.robots])

    def estimates(self, estimate: Estimate) -> list[Estimate]:
        """Return the estimate of each robot."""
        if self._own is None or self._own[0] is not estimate:
            states = estimate.states.reshape(-1, N_STATES)
            parts = zip(pairwise(self.first), self.places, states, strict=True)
            own = [Estimate(estimate.pose[a:b], estimate.landmark[places], mine) for (a, b), places, mine in parts]
            self._own = (estimate, own)
        return self._own[1]

    def parts(self, estimate: Estimate, marginals: Marginals) -> list[Marginals]:
        """Return the marginals of each robot, for those of all."""
        return [
            marginals.of(block, len(own.pose), len(robot.problem.pose_row), own.known)
            for block, robot, own in zip(self._blocks, self.robots, self.estimates(estimate), strict=True)
        ]

    def linearised_in_slices(self, estimate: Estimate) -> Slices[Linearised]:
        """Return the factors of all robots, by kind, then the encounters, in slices; weights are of the latter."""
        if self._last is not None and self._last[0] is estimate:
            return self._last[1]
        alone, kinds = [], []
        for robot, own in zip(self.robots, self.estimates(estimate), strict=True):
            part = yield from robot.linearised_in_slices(own)
            driven = ODOMETRY * (len(own.pose) - 1)
            kinds.append(np.split(part.values, [driven, driven + DETECTION * len(robot.problem.pose_row)]))
            alone.append(part)
        eyes = _Eyes(
            estimate.states.reshape(-1, N_STATES),
            np.array([robot.problem.prior.free for robot in self.robots]),
            np.array([robot.problem.mount for robot in self.robots]),
            self.sigma,
            np.array([robot.noise.outlier_log_odds if robot.robust else np.inf for robot in self.robots]),
            np.array([robot.heavy and robot.robust for robot in self.robots]),
        )
        values, weights = np.empty(ENCOUNTER * len(self.met.robot)), np.empty(len(self.met.robot))
        cost = linearise_encounters(estimate.pose, self.met, eyes, values, weights)
        now = Linearised(
            np.concatenate([*(part for kind in zip(*kinds, strict=True) for part in kind), values]),
            weights,
            sum(part.cost for part in alone) + cost,
            np.concatenate([part.states_right for part in alone]),
        )
        self._last = (estimate, now)
        return now

    def squares(self, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
        """Return squared residuals (S, 2) of encounters, times their inlier probability, and the latter (S,)."""
        now, count = self.linearised(estimate), len(self.met.robot)
        right = now.values[len(now.values) - ENCOUNTER * count :].reshape(-1, 2, OF_ENCOUNTER)[..., -1]
        return (right * self.sigma[self.met.robot]) ** 2, now.weights

    def _marginals(self, estimate: Estimate, solved: Factorised) -> Marginals:
        n, places, met = len(estimate.pose), int(estimate.known.sum()), len(self.met.robot)
        first = len(solved.system.factors.rows) - met
        block = Block(0, n + np.arange(places), n + places, 0, first, n - len(self.robots))
        return Marginals(solved, n, met, estimate.known, block=block)

    def _structured(self, estimate: Estimate) -> Slices[Equations]:
        """The equations of all robots: variables and leaves one robot after the other, factors by kind."""
        known, n, n_robots = estimate.known, len(estimate.pose), len(self.robots)
        if self._structure is not None and np.array_equal(self._structure.known, known):
            return self._structure
        rank, border = np.cumsum(known) - 1, n + int(known.sum())
        kinds: list[list[Factors]] = [[], [], []]
        blocks, coordinates, leaves, seen = [], [], [0], n - n_robots
        for r, (robot, own) in enumerate(zip(self.robots, self.estimates(estimate), strict=True)):
            alone = yield from robot._structured(own)
            places, driven, count = n + rank[self.places[r][own.known]], len(own.pose) - 1, len(robot.problem.pose_row)
            blocks.append(Block(int(self.first[r]), places, border + 2 * r, int(self.first[r]) - r, seen, n - n_robots))
            seen += count
            states = border + 2 * r + np.arange(2)
            variable = np.concatenate([np.arange(self.first[r], self.first[r + 1]), places, states])
            factors = alone.system.factors
            cuts = pairwise([0, driven, driven + count, len(factors.rows)])
            for kind, (low, high) in zip(kinds, cuts, strict=True):
                first = factors.first[low : high + 1]
                tied = variable[factors.variable[first[0] : first[-1]]]
                kind.append(Factors(np.diff(first), tied, factors.rows[low:high], factors.leaf[low:high] + leaves[-1]))
            coordinates.append(self._laid_out(r, alone.coordinate))
            leaves.append(leaves[-1] + len(alone.coordinate))
        tied = np.column_stack([self.met.observer, self.met.observed, border + 2 * self.met.robot]).ravel()
        row, last = self.met.observer - self.first[self.met.robot], np.diff(self.first)[self.met.robot] - 2
        leaf = np.array(leaves)[self.met.robot] + np.minimum(row, last) // POSES_A_LEAF
        met = Factors(np.full(len(row), 3), tied, np.full(len(row), 2), leaf)
        width, *rest = (np.concatenate(column) for column in zip(*kinds[0], *kinds[1], *kinds[2], met, strict=True))
        dim = np.concatenate([np.full(n, 3), np.full(border - n, 2), np.tile([N_SENSOR, N_MOTION], n_robots)])
        coordinate = np.concatenate(coordinates)
        factors = Factors(np.append(0, np.cumsum(width)), *rest)
        system = System(dim, factors, coordinate, border + np.arange(2 * n_robots))
        self._blocks, self._structure = tuple(blocks), Equations(known, rank, system, coordinate, (), ())
        return self._structure

    def _laid_out(self, r: int, coordinate: FloatArray) -> FloatArray:
        """Coordinates of a robot's leaves among all: time on their clock, position, robot."""
        stamp = self.robots[r].problem.stamp_s + self.start_s[r]
        when = np.interp(coordinate[:, 0] * POSES_A_LEAF, np.arange(len(stamp)), stamp)
        return np.column_stack([when, coordinate[:, 1:], np.full(len(when), float(r))])
