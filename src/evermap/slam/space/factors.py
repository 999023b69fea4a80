"""Measurements in space as blocks of factors: odometry, detections, the start and what a map says."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.estimate.graph import Room
from evermap.estimate.sparse.system import Slices
from evermap.geometry import se3
from evermap.slam.space.linearise import ROWS, SpatialSightings, linearise_odometry, linearise_sightings
from evermap.slam.space.problem import SpatialEstimate, SpatialProblem, Swing
from evermap.types import FloatArray, IntArray

FACTORS_A_SLICE = 500
"""Factors that are linearised in about a millisecond."""


class SpatialOdometryFactors(NamedTuple):
    """Odometry between consecutive poses, with its scale.

    Attributes:
        increment: (N - 1, 7) measured motions.
        swing: of their noise.
        sigma: (N - 1, 6) their standard deviations; see `Swing.variance`.
        log_odds: beyond which half of the squared residual makes a jump.
        heavy: tails that never let go.
        scale: the variable of the scale.
    """

    increment: FloatArray
    swing: Swing
    sigma: FloatArray
    log_odds: float
    heavy: bool
    scale: int

    @property
    def ties(self) -> IntArray:
        """Return (N - 1, 3) two poses and the scale."""
        step = self.pose
        return np.column_stack([step, step + 1, np.full(len(step), self.scale)])

    @property
    def rows(self) -> IntArray:
        """Return (N - 1,) sixes."""
        return np.full(len(self.increment), 6)

    @property
    def pose(self) -> IntArray:
        """Return (N - 1,) the first pose of each motion."""
        return np.arange(len(self.increment))

    def linearise(self, state: SpatialEstimate, out: Room) -> Slices[float]:
        """Fill in `linearise_odometry`."""
        yield len(out.weights) / FACTORS_A_SLICE
        return float(
            linearise_odometry(
                state.pose,
                self.increment,
                state.log_scale,
                self.swing.steps,
                self.swing.lever_m,
                self.swing.axes,
                self.sigma,
                self.log_odds,
                self.heavy,
                out.values,
                out.weights,
            )
        )


class SightingFactors(NamedTuple):
    """Detections of places, with the mounts of the sensors and the delays of their stamps.

    Attributes:
        problem: the measurements.
        seen: its detections, as the kernel reads them.
        level: (6,) noise levels.
        heavy: tails that never let go.
        places, sensors: variables of the first place and of the first sensor.
    """

    problem: SpatialProblem
    seen: SpatialSightings
    level: FloatArray
    heavy: bool
    places: int
    sensors: int

    @property
    def ties(self) -> IntArray:
        """Return (M, 3) pose, place and sensor."""
        return np.column_stack([self.seen.pose_row, self.places + self.seen.place, self.sensors + self.seen.sensor])

    @property
    def rows(self) -> IntArray:
        """Return (M,) rows, by the kind of detection."""
        return ROWS[self.seen.kind]

    @property
    def pose(self) -> IntArray:
        """Return (M,) the poses that saw them."""
        return self.seen.pose_row

    def linearise(self, state: SpatialEstimate, out: Room) -> Slices[float]:
        """Fill in `linearise_sightings`."""
        mount, residual = state.mount(self.problem), np.zeros((len(out.weights), 8))
        back, by_delay = self.problem.earlier(state.delay_s)
        yield len(out.weights) / FACTORS_A_SLICE
        return float(
            linearise_sightings(
                state.pose,
                state.place,
                mount,
                back,
                by_delay,
                self.level,
                self.seen,
                self.heavy,
                out.values,
                out.weights,
                residual,
            )
        )


def deviate(mean: FloatArray, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the twist (6,) from a pose (7,) to another, and its derivative (6, 6) by a step of the latter."""
    off = se3.local(mean, pose)
    return off, se3.right_jacobian_inverse(off)


class MapFactors(NamedTuple):
    """What a given map says about its places.

    Attributes:
        problem: with the prior.
        variable: (K,) variables of its places.
        pose: (K,) the pose that saw each first, or any.
    """

    problem: SpatialProblem
    variable: IntArray
    pose: IntArray

    @property
    def ties(self) -> IntArray:
        """Return (K, 1) places."""
        return self.variable[:, None]

    @property
    def rows(self) -> IntArray:
        """Return (K,) six of places with an orientation, three of points."""
        return np.where(self.problem.oriented[self.problem.prior.place], 6, 3)

    def linearise(self, state: SpatialEstimate, out: Room) -> Slices[float]:
        """Fill in linear factors of positions, and of twists from where the map has a place."""
        problem, prior, cost = self.problem, self.problem.prior, 0.0
        turned = problem.oriented[prior.place]
        first = np.append(0, np.cumsum(np.where(turned, 42, 12)))
        for some, dim in ((np.flatnonzero(turned), 6), (np.flatnonzero(~turned), 3)):
            off = problem.off_map(some, state.place[prior.place[some]], oriented=dim == 6)
            root = (np.sqrt(prior.weight[some])[:, None] / prior.sigma[some])[:, :dim]
            jacobian = se3.right_jacobian_inverse(off) if dim == 6 else np.eye(3)
            block = np.concatenate([root[..., None] * jacobian, -(root * off)[..., None]], axis=2)
            out.values[first[some][:, None] + np.arange(dim * (dim + 1))] = block.reshape(len(some), dim * (dim + 1))
            cost += 0.5 * float(np.sum((root * off) ** 2))
        yield from ()
        return cost
