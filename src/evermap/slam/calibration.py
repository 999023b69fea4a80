"""Calibration states: systematic errors of the sensors, and their priors.

The range law is `z_r = a0 + r (1 + a1 + a2 b + a3 b^2)` with true range `r` and bearing `b`; `a3 = -1/2` is a camera
that reports depth. A bearing reads `z_b = b + b0`. Both are seen from where the sensor sits, `(m_x, m_y)` off its
stated mount, along the robot's axes. Between two instants the robot moves by the odometry between the two instants
shifted by `tau`, with velocities `k_v v - k_s |w|` and `k_w w`; of the turn rate `w` the scale acts on what is no
jitter of its report (`problem.beyond_jitter`).

All eleven states form one vector, in the order of `SPECS`. Priors say what a decent camera, laser or wheel encoder does
out of the box; a kind of sensor (`kinds`) or its data sheet (`Sensor`) makes those of the sensor narrower. None was
fitted to a recording.

Not all sensors have errors. Each state has a spike at 'as stated' beside its slab, the prior; which of the two holds is
decided by their evidence (`needed`), under the number of observations that the data are worth: errors of one landmark
are alike for seconds, and a thousand readings of it are no thousand observations.

Two things only show together, and none of them alone: range slope and odometer scale without a map (`without_scale`),
and a sensor turned in its mount and a robot that drives askew. They stay as the sensor states them, unless its data
sheet says how far off it may be.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.special import logsumexp

from evermap.config import CalibrationConfig, CheckConfig
from evermap.errors import ConfigError
from evermap.geometry import se2
from evermap.slam.kernels import N_STATES
from evermap.types import BoolArray, FloatArray, ParameterEstimate, Sensor, SensorKind


@dataclass(frozen=True, slots=True)
class Spec:
    """Name, usual value and meaning of one calibration state."""

    name: str
    mean: float
    unit: str
    meaning: str


SPECS: tuple[Spec, ...] = (
    Spec("range_bias_m", 0.0, "m", "constant added to every range"),
    Spec("range_slope", 0.0, "1", "relative error of ranges"),
    Spec("range_skew_per_rad", 0.0, "1/rad", "range error that grows to one side of the field of view"),
    Spec("range_curvature_per_rad2", 0.0, "1/rad^2", "-0.5: the sensor reports depth, not distance"),
    Spec("bearing_bias_rad", 0.0, "rad", "constant added to every bearing"),
    Spec("mount_forward_m", 0.0, "m", "the sensor sits this much farther ahead than stated"),
    Spec("mount_left_m", 0.0, "m", "and this much farther to the left"),
    Spec("odometry_delay_s", 0.0, "s", "odometry stamps minus the stamps of the motion they describe"),
    Spec("odometry_forward_scale", 1.0, "1", "true over reported forward speed"),
    Spec("odometry_turn_scale", 1.0, "1", "true over reported turn rate"),
    Spec("odometry_turn_slip_m", 0.0, "m", "forward speed lost per turn rate"),
)
USUAL = CalibrationConfig()
NAMES = tuple(spec.name for spec in SPECS)
BIAS, SLOPE, SKEW, CURVATURE, BEARING, AHEAD, ASIDE, DELAY, FORWARD, SLIP = 0, 1, 2, 3, 4, 5, 6, 7, 8, 10
OF_SCALE = ("[sensor] sigma_scale", "[odometry] sigma_odometer_scale")
OF_ANGLE = ("[sensor] sigma_angle_rad", "[odometry] sigma_askew_rad")
"""Keys of `sensor.toml` that divide what two errors only show together."""
LEAST_SIGMA = 1e-6
"""Standard deviation for a data sheet without errors, to avoid division by zero."""


@dataclass(frozen=True, slots=True)
class CalibrationPrior:
    """Independent Gaussians on the calibration states; those that are not `free` stay at their mean.

    Attributes:
        mean, sigma: (11,) in the order of `SPECS`.
        free: (11,) which states are estimated.
        slope_share: of what range slope and odometer scale show together, that is the sensor's; None: by their sigmas.
        angle_share: of what bearing bias and driving askew show together, that is the sensor's.
        askew_sigma: standard deviation of the latter [rad].
        p_sensor: probability of each of the first five states to be another than stated, of the bearing bias at least
            that of a state of the robot.
        settings: that it is of.
    """

    mean: FloatArray
    sigma: FloatArray
    free: BoolArray
    slope_share: float | None = None
    angle_share: float = 1.0
    askew_sigma: float = 0.0
    p_sensor: float = USUAL.p_needed
    settings: CalibrationConfig = USUAL

    @classmethod
    def from_settings(
        cls, settings: CalibrationConfig = USUAL, *, calibrated: bool, sensor: Sensor | None = None
    ) -> CalibrationPrior:
        """Return the priors, all states free unless `calibrated` is False, and some fixed by name.

        Args:
            settings: standard deviations, and values of states that are fixed, by their names.
            calibrated: whether any is estimated.
            sensor: its kind and data sheet, by which its errors are smaller, and are told from those of the odometry;
                None: whatever only shows together is the sensor's as much as the odometry's.

        Raises:
            ConfigError: `fix` names an unknown state.
        """
        mean, free = np.array([spec.mean for spec in SPECS]), np.full(N_STATES, calibrated)
        for name, value in settings.fix.items():
            if name not in NAMES:
                problem = f"unknown calibration state '{name}'"
                raise ConfigError(problem, field="slam.calibration.fix", hint=", ".join(NAMES))
            mean[NAMES.index(name)] = value
            free[NAMES.index(name)] = False
        sigma = np.array([settings.sigma[name] for name in NAMES])
        prior = cls(mean, sigma, free, settings=settings)
        return prior if sensor is None else prior._as_stated(sensor)

    def _as_stated(self, sensor: Sensor) -> CalibrationPrior:
        """Return the prior narrowed by the stated sensor, and the division of jointly observable errors."""
        sheet = {
            BIAS: sensor.sigma_offset_m,
            SLOPE: sensor.sigma_scale,
            BEARING: sensor.sigma_angle_rad,
            AHEAD: sensor.sigma_position_m,
            ASIDE: sensor.sigma_position_m,
            FORWARD: sensor.sigma_odometer_scale,
        }
        sigma = self.sigma.copy()
        if sensor.kind is not None:
            sigma[: BEARING + 1] = self.settings.kinds[sensor.kind]
        for state, value in sheet.items():
            if value is not None:
                sigma[state] = max(value, LEAST_SIGMA)
        stated = sensor.sigma_askew_rad
        askew = self.settings.sigma_askew_rad if stated is None else max(stated, LEAST_SIGMA)
        angle_share = 0.0
        if sensor.sigma_angle_rad is not None or stated is not None:
            angle_share = sigma[BEARING] ** 2 / (sigma[BEARING] ** 2 + askew**2)
        sigma[BEARING] = np.hypot(sigma[BEARING], askew)
        known = sensor.kind not in (None, SensorKind.LASER)
        p_needed = self.settings.p_needed_known if known else self.settings.p_needed_sensor
        return replace(
            self,
            sigma=sigma,
            slope_share=None if sensor.states_scale else 0.0,
            angle_share=angle_share,
            askew_sigma=askew,
            p_sensor=p_needed,
        )

    def averaged(
        self, p_needed: FloatArray, states: FloatArray, variance: FloatArray, worth: FloatArray
    ) -> tuple[CalibrationPrior, FloatArray]:
        """Return the prior under which each estimate is the mean over 'as stated' and 'drawn from this prior', and
        these means (11,), as far as the readings are linear in each state.

        Such a mean lies nearer to what is stated, by the probability of the latter, and the more so the less the
        readings are worth; that of a Gaussian does where its prior is narrower. So nothing jumps where the evidence is
        in doubt. The optimum is sought from these means: a step to a delay far away would leave what is linear.

        `p_needed` and `worth` (11,) are those of `needed`; states (11,) and their variance are as under this prior.
        """
        asked = self.free & ~np.isnan(p_needed)
        p, before = np.where(asked, np.clip(p_needed, self.settings.p_spare, 1.0), 1.0), 1.0 / self.sigma**2
        data = np.maximum(1.0 / np.where(self.free, variance, self.sigma**2) - before, 1e-9 * before)
        information = np.where(asked, narrow(p, before, data, data / worth), before)
        prior = replace(self.spared(p_needed), sigma=1.0 / np.sqrt(information))
        share = np.where(prior.free, (data + before) / (data + information), 0.0)
        return prior, self.mean + share * (states - self.mean)

    def spared(self, p_needed: FloatArray) -> CalibrationPrior:
        """Return the prior with those states held as stated that hardly need to be free, by `p_needed` (11,)."""
        return replace(self, free=self.free & ~(p_needed < self.settings.p_spare))

    def doubt(self, p_needed: FloatArray, states: FloatArray, *, averaged: bool = True) -> FloatArray:
        """Return (11,) variances between 'as stated' and 'drawn from the prior'.

        Of estimates (11,) that are the mean over both (`averaged`), or that are under the latter.
        """
        p = np.maximum(p_needed, self.settings.p_spare)
        odds = np.where(p_needed >= self.settings.p_spare, 1.0 / p - 1.0 if averaged else 1.0 - p, 0.0)
        return odds * (states - self.mean) ** 2

    def without_scale(self) -> CalibrationPrior:
        """Return the prior of the states that are observable without a prior map, in the scale of the range sensor.

        Range slope, forward scale and the size of the whole map trade off exactly: `1 + a1` times the map with
        `k_v / (1 + a1)` explains every reading as well. So the graph holds `a1` at its mean, lets the forward scale
        carry the uncertainty of both, and `split_scale` divides what it found between them afterwards.
        """
        return self.relative(0.0) if self.shares_scale else self

    def relative(self, slope_sigma: float) -> CalibrationPrior:
        """Return the prior of the states in the metres of a range sensor whose slope is known as well as this one's.

        Args:
            slope_sigma: of the range slope against that sensor's: 0 where it is this one.
        """
        sigma, free = self.sigma.copy(), self.free.copy()
        sigma[FORWARD] = np.hypot(sigma[FORWARD], sigma[SLOPE])
        sigma[SLOPE], free[SLOPE] = max(slope_sigma, LEAST_SIGMA), slope_sigma > 0.0
        return replace(self, sigma=sigma, free=free)

    def mount_as_stated(self) -> CalibrationPrior:
        """Return the prior with the sensor where it is stated to sit."""
        free = self.free.copy()
        free[AHEAD : ASIDE + 1] = False
        return replace(self, free=free)

    @property
    def p_needed(self) -> FloatArray:
        """(11,) prior probability of each state to be another than stated."""
        p = np.full(N_STATES, self.settings.p_needed)
        p[:BEARING] = self.p_sensor
        p[BEARING] = max(self.p_sensor, self.settings.p_needed)  # the robot's driving askew as much as the sensor's
        return p

    def gaussian(self) -> CalibrationPrior:
        """Return the prior for an estimator that does not average over 'as stated' and 'drawn from this prior'.

        Each state has the mean and variance of that mixture.
        """
        return replace(self, sigma=self.sigma * np.sqrt(self.p_needed))

    @property
    def shares_scale(self) -> bool:
        """True where neither the range slope nor the forward scale is given, so that only their product shows."""
        return bool(self.free[SLOPE] and self.free[FORWARD])

    def metre(self, states: FloatArray, covariance: FloatArray) -> tuple[float, float, float]:
        """Return the log factor by which the graph's lengths are too long according to a robot's priors.

        Nothing but these says what a metre is in the states (11,), with a covariance (11, 11).

        Returns:
            The logarithm; the variance that it has from the estimate; and the precision that the priors give it.
        """
        precision = 1.0 / self.sigma[SLOPE] ** 2 + 1.0 / self.sigma[FORWARD] ** 2
        share = self._slope_share
        log = share * np.log(np.abs(states[FORWARD] / self.mean[FORWARD]))  # speeds with the wrong sign are negative
        log -= (1.0 - share) * np.log((1.0 + states[SLOPE]) / (1.0 + self.mean[SLOPE]))
        variance = share**2 * covariance[FORWARD, FORWARD] + (1.0 - share) ** 2 * covariance[SLOPE, SLOPE]
        return float(log), float(variance), float(precision)

    @property
    def _slope_share(self) -> float:
        """Return the sensor's share of the product of range slope and odometer scale."""
        believed = self.sigma[SLOPE] ** 2 / (self.sigma[SLOPE] ** 2 + self.sigma[FORWARD] ** 2)
        return float(believed if self.slope_share is None else self.slope_share)

    def resize(self, states: FloatArray, factor: float) -> FloatArray:
        """Return states (11,) that explain every reading as well where all lengths are so many times as long.

        Those that are held stay, but the two that are only known as a product: range slope and odometer scale.
        """
        states = states.copy()
        states[SLOPE] = (1.0 + states[SLOPE]) / factor - 1.0
        states[FORWARD] *= factor
        for state in (SLIP, AHEAD, ASIDE):
            states[state] *= factor if self.free[state] else 1.0
        for state in (SKEW, CURVATURE):
            states[state] /= factor if self.free[state] else 1.0
        return states

    def split_scale(
        self, states: FloatArray, covariance: FloatArray, others: tuple[tuple[float, float, float], ...] = ()
    ) -> tuple[FloatArray, FloatArray, float, float]:
        """Divide the product of range and odometry scale between its two factors, by their priors.

        Args:
            states: (11,) estimate made with `without_scale`.
            covariance: (11, 11) of it.
            others: what other robots say (`metre`) whose lengths are the same; their mean counts, by precision.

        Returns:
            States and covariance with the slope in them; the factor by which all lengths of trajectory and map have
            to be multiplied; and the standard deviation of its logarithm.
        """
        if not (self.shares_scale or others):
            return states, covariance, 1.0, 0.0
        covariance = covariance.copy()
        if not others:  # the slope was held
            covariance[SLOPE] = covariance[:, SLOPE] = 0.0
        told = np.array([self.metre(states, covariance), *others])
        weight, spread = told[:, 2] / told[:, 2].sum(), 1.0 / told[:, 2].sum()
        log_slope, variance = float(weight @ told[:, 0]), spread + float(weight**2 @ told[:, 1])
        states = self.resize(states, float(np.exp(-log_slope)))
        # the unobservable part keeps the prior's spread; the product has its own
        by_forward, by_slope = weight[0] * self._slope_share, weight[0] * (1.0 - self._slope_share)
        own, drives = covariance[SLOPE, SLOPE], covariance[FORWARD, FORWARD]
        covariance[SLOPE, SLOPE] = spread + by_forward**2 * drives + (1.0 - by_slope) ** 2 * own
        covariance[FORWARD, FORWARD] = spread + (1.0 - by_forward) ** 2 * drives
        return states, covariance, float(np.exp(-log_slope)), float(np.sqrt(variance))

    def split_angle(self, states: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray, float, float]:
        """Divide what the graph holds as bearing bias between the angle of the sensor and the robot's driving askew.

        Returns:
            States (11,) and covariance with the sensor's part alone; the robot's part [rad], to the left of its front
            where positive, and its standard deviation.
        """
        if not self._shares_angle:
            return states, covariance, 0.0, 0.0
        askew, variance, share = self._askew(states), covariance[BEARING, BEARING], self.angle_share
        states, covariance = states.copy(), covariance.copy()
        own = max(self.sigma[BEARING] ** 2 - self.askew_sigma**2, 0.0)
        undivided = own * self.askew_sigma**2 / self.sigma[BEARING] ** 2
        states[BEARING] *= share
        covariance[BEARING] *= share
        covariance[:, BEARING] *= share
        covariance[BEARING, BEARING] += undivided
        return states, covariance, askew, float(np.sqrt((1.0 - share) ** 2 * variance + undivided))

    @property
    def _shares_angle(self) -> bool:
        """True where neither the sensor's angle nor the robot's is given, so that only their sum shows."""
        return bool(self.free[BEARING]) and self.askew_sigma > 0.0

    def _askew(self, states: FloatArray) -> float:
        """Direction in which the robot drives, to the left of its front [rad]."""
        return float((1.0 - self.angle_share) * states[BEARING]) if self._shares_angle else 0.0

    def front(self, states: FloatArray, mount: FloatArray) -> FloatArray:
        """Return the pose (3,) of the robot's front relative to the poses of the graph, which has the states (11,).

        There the robot drives along its front and the sensor is turned by the whole bearing bias; where it is the robot
        that drives askew, its front is turned the other way. Where the sensor is, stated at `mount` (3,), stays.
        """
        askew = self._askew(states)
        if askew == 0.0:
            return np.zeros(3)
        c, s = math.cos(askew), math.sin(askew)
        x, y = seat_sensor(mount, states)[:2].tolist()
        return np.array([x - c * x - s * y, y + s * x - c * y, -askew])  # turned about the sensor


def narrow(
    p_needed: FloatArray | float, before: FloatArray | float, data: FloatArray | float, told: FloatArray | float
) -> FloatArray:
    """Return the information of a prior whose estimate is the mean over 'as stated' and 'drawn from a wider prior'.

    Args:
        p_needed: probability of the latter.
        before: information of that prior.
        data: of the readings, as the estimator has it.
        told: of the readings, as far as their errors are independent.
    """
    return np.asarray(data * ((told + before) / (p_needed * told) - 1.0))


def price(value: float, variance: float, worth: float, sigma: float, p_needed: float = 0.5) -> tuple[float, float]:
    """Return the probability that a state is drawn from its prior, not as stated, and the `narrow` information.

    Args:
        value: the estimate under the prior, less what is stated.
        variance: of the estimate under the prior, by independent errors.
        worth: variance by the errors as they were found in that of independent ones, at least 1.
        sigma: standard deviation of the prior.
        p_needed: that probability beforehand.
    """
    before = sigma**-2
    data = max(1.0 / variance - before, 1e-9 * before)
    told, best = data / worth, value / (data * variance)
    log_odds = 0.5 * (told * best) ** 2 / (told + before) - 0.5 * np.log1p(told / before)
    log_odds += np.log(p_needed / (1.0 - p_needed))
    p = float(1.0 / (1.0 + np.exp(-log_odds)))
    return p, float(narrow(p, before, data, told))


def seat_sensor(mount: FloatArray, states: FloatArray) -> FloatArray:
    """Return the pose (3,) of the sensor on the robot, of a stated mount (3,) and calibration states (11,).

    The angle is as stated: that of bearings is `bearing_bias_rad`.
    """
    return np.array([mount[0] + states[AHEAD], mount[1] + states[ASIDE], mount[2]])


def from_front(pose: FloatArray, covariance: FloatArray, front: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return poses (..., 3) and covariances (..., 3, 3), in their own frames, of the front (3,) that each one sees."""
    if not front.any():
        return pose.copy(), covariance.copy()
    turned = se2.adjoint(se2.inverse(front))
    return se2.compose(pose, front), turned @ covariance @ turned.T


def needed(prior: CalibrationPrior, states: FloatArray, covariance: FloatArray, worth: FloatArray) -> FloatArray:
    """Return the (11,) probability that each free state differs from its stated value, nan for others.

    Every subset of states is weighed by its evidence against all as stated: of a Gaussian likelihood of the states,
    which the estimate (11,) under the prior holds, in closed form (Savage and Dickey's ratio). `worth` (11,) are
    variances by the errors as they were found, in those of independent errors (`Smoother.worth`).
    """
    free = np.flatnonzero(prior.free)
    probability = np.full(N_STATES, np.nan)
    if not len(free):
        return probability
    at = np.ix_(free, free)
    before, off = 1.0 / prior.sigma[free] ** 2, (states - prior.mean)[free]
    # in units of the prior, so that nothing is lost where one state is known far better than another
    posterior = np.linalg.inv(covariance[at] * np.sqrt(np.outer(before, before)))
    off = off * np.sqrt(before)
    data = posterior - np.eye(len(free))
    told = np.linalg.pinv(data, rcond=1e-10, hermitian=True) @ posterior @ off
    weaker = 1.0 / np.sqrt(worth[free])
    data = weaker[:, None] * data * weaker
    pull = data @ told
    every = np.array(list(product((False, True), repeat=len(free))))
    p = prior.p_needed[free]
    log_odds = np.log(p / (1.0 - p))
    # of those that are left out, one times one: no part of a determinant, and no pull
    whole = np.eye(len(free)) + data * (every[:, :, None] & every[:, None, :])
    pulls = np.where(every, pull, 0.0)
    gain = 0.5 * np.einsum("ka,ka->k", pulls, np.linalg.solve(whole, pulls[..., None])[..., 0])
    weight = gain - 0.5 * np.linalg.slogdet(whole)[1] + every @ log_odds
    probability[free] = np.exp(weight - logsumexp(weight)) @ every
    return probability


def far_off(parameters: Sequence[ParameterEstimate], settings: CheckConfig) -> tuple[str, ...]:
    """Return a warning for every calibration state that a run found far outside of what its prior expects."""
    told = []
    for state in parameters:
        if state.fixed or not state.prior_sigma > 0.0:
            continue
        away = abs(state.value - state.prior_mean) / state.prior_sigma
        if away > settings.far_off:
            told.append(
                f"{state.name} = {state.value:.3g} {state.unit}".removesuffix(" 1")
                + f" is {away:.0f} standard deviations from the prior of sensors: {_CAUSES.get(state.name, OTHER)}"
            )
    return tuple(told)


OTHER = "another value than stated"
_CAUSES = {
    "range_bias_m": "ranges in another unit, or from another origin than the sensor's",
    "range_slope": "ranges or speeds in another unit",
    "range_skew_per_rad": "bearings from another axis, or with the wrong sign",
    "range_curvature_per_rad2": "bearings in another unit",
    "bearing_bias_rad": "the sensor is turned otherwise than [mount] theta_rad says",
    "odometry_delay_s": "two clocks: odometry and detections are stamped differently",
    "odometry_scale": "poses of the odometry or positions in another unit, or a wrong wheel radius",
    "range_scale": "positions in another unit, or another size of tags",
    "odometry_forward_scale": "speeds or ranges in another unit, or a wrong wheel radius",
    "odometry_turn_scale": "turn rates in another unit or with the wrong sign, or a wrong wheel base",
    "odometry_askew_rad": "the sensor's angle differs from [mount] theta_rad, or the robot drives at an angle to its "
    "front",
    "mount_forward_m": "[mount] x_m is missing or wrong, or the odometry is that of another point than the base",
    "mount_left_m": "[mount] y_m is missing or wrong, or the odometry is that of another point than the base",
    "odometry_turn_slip_m": "bearings have the wrong sign, or turning costs this robot much of its speed",
}
