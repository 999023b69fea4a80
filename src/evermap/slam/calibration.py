"""Calibration states: what the sensors do to the truth, and how much of it one believes beforehand.

The range law is `z_r = a0 + r (1 + a1 + a2 b + a3 b^2)` with true range `r` and bearing `b`; `a3 = -1/2` is a camera
that reports depth. A bearing reads `z_b = b + b0`. Between two instants the robot moves by the odometry between the two
instants shifted by `tau`, with velocities `k_v v - k_s |w|` and `k_w w`.

All nine states form one vector, in the order of `SPECS`. Priors are weak and the same for every robot; they say what a
decent camera, laser or wheel encoder does out of the box and were not fitted to any recording.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError
from evermap.types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Spec:
    """Name, prior and meaning of one calibration state."""

    name: str
    mean: float
    sigma: float
    unit: str
    meaning: str


SPECS: tuple[Spec, ...] = (
    Spec("range_bias_m", 0.0, 0.1, "m", "constant added to every range"),
    Spec("range_slope", 0.0, 0.02, "1", "ranges are too long by this share"),
    Spec("range_skew_per_rad", 0.0, 0.1, "1/rad", "range error that grows to one side of the view"),
    Spec("range_curvature_per_rad2", 0.0, 0.5, "1/rad^2", "-0.5: the sensor reports depth, not distance"),
    Spec("bearing_bias_rad", 0.0, 0.05, "rad", "constant added to every bearing"),
    Spec("odometry_delay_s", 0.0, 0.3, "s", "odometry stamps minus the stamps of the motion they describe"),
    Spec("odometry_forward_scale", 1.0, 0.05, "1", "true over reported forward speed"),
    Spec("odometry_turn_scale", 1.0, 0.1, "1", "true over reported turn rate"),
    Spec("odometry_turn_slip_m", 0.0, 0.05, "m", "forward speed lost per turn rate"),
)
N_STATES = len(SPECS)
NAMES = tuple(spec.name for spec in SPECS)
SLOPE, SKEW, CURVATURE, FORWARD, SLIP = 1, 2, 3, 6, 8


@dataclass(frozen=True, slots=True)
class CalibrationPrior:
    """Independent Gaussians on the calibration states; those that are not `free` stay at their mean.

    Attributes:
        mean, sigma: (9,) in the order of `SPECS`.
        free: (9,) which states are estimated.
    """

    mean: FloatArray
    sigma: FloatArray
    free: BoolArray

    @classmethod
    def from_settings(cls, *, calibrated: bool, fix: dict[str, float]) -> CalibrationPrior:
        """Return the default priors, all states free unless `calibrated` is False, and some fixed by name.

        Raises:
            ConfigError: `fix` names an unknown state.
        """
        mean = np.array([spec.mean for spec in SPECS])
        sigma = np.array([spec.sigma for spec in SPECS])
        free = np.full(N_STATES, calibrated)
        for name, value in fix.items():
            if name not in NAMES:
                raise ConfigError(
                    f"no calibration state is called '{name}'",
                    field="slam.calibration.fix",
                    hint=", ".join(NAMES),
                )
            mean[NAMES.index(name)] = value
            free[NAMES.index(name)] = False
        return cls(mean, sigma, free)

    def without_scale(self) -> CalibrationPrior:
        """Return the prior of the states that are observable without a prior map, in the metres of the range sensor.

        Range slope, forward scale and the size of the whole map trade off exactly: `1 + a1` times the map with
        `k_v / (1 + a1)` explains every reading as well. So the graph holds `a1` at its mean, lets the forward scale
        carry the uncertainty of both, and `split_scale` divides what it found between them afterwards.
        """
        if not self._shares_scale:
            return self
        sigma, free = self.sigma.copy(), self.free.copy()
        free[SLOPE] = False
        sigma[FORWARD] = np.hypot(sigma[FORWARD], sigma[SLOPE])
        return CalibrationPrior(self.mean, sigma, free)

    @property
    def _shares_scale(self) -> bool:
        """True where neither the range slope nor the forward scale is given, so that only their product shows."""
        return bool(self.free[SLOPE] and self.free[FORWARD])

    def split_scale(self, states: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray, float, float]:
        """Divide the product of range and odometry scale between its two factors, by their priors.

        Args:
            states: (9,) estimate made with `without_scale`.
            covariance: (9, 9) of it.

        Returns:
            States and covariance with the slope in them; the factor by which all lengths of trajectory and map have
            to be multiplied; and the standard deviation of its logarithm.
        """
        if not self._shares_scale:
            return states, covariance, 1.0, 0.0
        states, covariance = states.copy(), covariance.copy()
        sigma_slope, sigma_forward = self.sigma[SLOPE], self.sigma[FORWARD]
        share = sigma_slope**2 / (sigma_slope**2 + sigma_forward**2)
        surplus = np.log(states[FORWARD] / self.mean[FORWARD])
        log_slope = share * surplus
        # what the product does not tell keeps the prior's spread; what it tells has the product's
        spread = np.sqrt(share) * sigma_forward
        variance = spread**2 + share**2 * covariance[FORWARD, FORWARD]
        states[SLOPE] = (1.0 + self.mean[SLOPE]) * np.exp(log_slope) - 1.0
        states[FORWARD] *= np.exp(-log_slope)
        for state, power in ((SLIP, -1.0), (SKEW, 1.0), (CURVATURE, 1.0)):
            if self.free[state]:
                states[state] *= np.exp(power * log_slope)
        covariance[SLOPE, SLOPE] = variance
        covariance[FORWARD, FORWARD] = (1.0 - share) ** 2 * covariance[FORWARD, FORWARD] + spread**2
        return states, covariance, float(np.exp(-log_slope)), float(np.sqrt(variance))
