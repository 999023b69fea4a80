"""How far to trust a sighting: range noise that grows with range.

A gate needs the noise of this very detection, and a camera that tells distance by the size of what it sees is ten times
less precise at 7 m than at 1 m (one pixel more or less). The law is `sigma_r^2 = a^2 + (k r^2)^2`; `k = 0` is a laser.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.slam.kernels import detection_residual
from evermap.slam.problem import Estimate, Problem
from evermap.types import FloatArray

PSEUDO_SIGHTINGS = 100.0
"""Imaginary sightings with the start's noise: what was associated first is little, and only what agreed."""
CLIPPED_AT = 9.0
"""Squared normalised residual beyond which a sighting tells nothing more about the noise."""
ROUNDS = 10


@dataclass(frozen=True, slots=True)
class SightingNoise:
    """Variances: of range at no distance [m^2], its growth with r^4 [1/m^2], of bearing [rad^2]."""

    range_variance: float
    range_growth: float
    bearing_variance: float

    @classmethod
    def constant(cls, sigma: FloatArray) -> SightingNoise:
        """The same at all ranges: sigma (2,) of range [m] and bearing [rad]."""
        return cls(float(sigma[0] ** 2), 0.0, float(sigma[1] ** 2))

    def of_detections(self, problem: Problem) -> FloatArray:
        """(M, 2) standard deviation of every detection: its own where it came with one."""
        fourth = problem.reading[:, 0] ** 4
        modelled = np.column_stack(
            [self.range_variance + self.range_growth * fourth, np.full(len(fourth), self.bearing_variance)]
        )
        return np.where(np.isfinite(problem.sigma_given), problem.sigma_given, np.sqrt(modelled))


def fit_sighting_noise(problem: Problem, estimate: Estimate, start: FloatArray) -> SightingNoise:
    """Noise by the residuals of associated detections, which came without their own.

    Args:
        problem: detections with their landmarks.
        estimate: the optimum.
        start: (2,) standard deviations that `PSEUDO_SIGHTINGS` imaginary sightings vouch for.
    """
    free = ~np.isfinite(problem.sigma_given)
    squared = residuals(problem, estimate) ** 2
    fourth = problem.reading[free[:, 0], 0] ** 4
    middle = float(np.median(fourth)) if len(fourth) else 1.0
    in_range, in_bearing = squared[free[:, 0], 0], squared[free[:, 1], 1]
    variance, growth, bearing = start[0] ** 2, 0.0, start[1] ** 2
    for _ in range(ROUNDS):
        expected = variance + growth * fourth
        clipped = np.minimum(in_range, CLIPPED_AT * expected)
        # Fisher scoring of a Gaussian whose variance is linear in two numbers, neither negative
        weight = np.append(1.0 / expected**2, PSEUDO_SIGHTINGS / (variance + growth * middle) ** 2)
        column = np.append(fourth, middle)
        value = np.append(clipped, start[0] ** 2)
        variance, growth = _line_not_negative(column, value, weight)
        total = np.minimum(in_bearing, CLIPPED_AT * bearing).sum() + PSEUDO_SIGHTINGS * start[1] ** 2
        bearing = total / (len(in_bearing) + PSEUDO_SIGHTINGS)
    return SightingNoise(variance, growth, float(bearing))


def residuals(problem: Problem, estimate: Estimate) -> FloatArray:
    """(M, 2) measured minus predicted range [m] and bearing [rad]."""
    out = np.empty((len(problem.pose_row), 2))
    jx, jl, jc = np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, 5))
    for m, (i, j) in enumerate(zip(problem.pose_row, problem.landmark_row, strict=True)):
        range_m, bearing_rad = problem.reading[m]
        detection_residual(
            estimate.pose[i], estimate.landmark[j], estimate.states, problem.mount, range_m, bearing_rad,
            out[m], jx, jl, jc,
        )  # fmt: skip
    return out


def _line_not_negative(x: FloatArray, y: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Weighted least squares of `y = a + b x` with `a` at least a thousandth of the mean, `b` not negative."""
    total = weight.sum()
    mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
    spread = (weight * (x - mean_x) ** 2).sum()
    slope = (weight * (x - mean_x) * (y - mean_y)).sum() / spread if spread > 0.0 else 0.0
    slope = float(np.clip(slope, 0.0, 0.999 * mean_y / mean_x))
    return float(mean_y - slope * mean_x), slope
