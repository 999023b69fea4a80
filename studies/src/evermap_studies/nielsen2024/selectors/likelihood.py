"""`log psi`: what a look at a landmark says about each of its modes (Nielsen 2024 section 6, MATH.md section 5)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr

from evermap.errors import InputError
from evermap.sensing.visibility import USUAL
from evermap.types import BoolArray, FloatArray, IntArray, Sensor

MOST_CERTAIN = 1.0 - 1e-6
"""No sensor detects more reliably than this: a miss is always possible."""


@dataclass(frozen=True, slots=True)
class Readings:
    """What R looks at landmarks read, and the modes that these landmarks may be at.

    Attributes:
        pose_world_robot: (R, 3) pose at every look.
        landmark: (R,) row of `mode_position_m` that each look is at.
        mode_position_m: (L, K, 2) modes of every landmark, nan for one that it does not have.
        reading: (R, 2) range [m] and bearing [rad] as reported; nan for an expected detection that did not come.
        sigma: (R, 2) their standard deviations.
        states: (9,) calibration states of `slam.calibration`; None for a sensor that reads true.
        pose_covariance: (R, 3, 3) in the robot's frame; None where poses count as exact.
        mode_covariance_m2: (L, K, 2, 2); None where positions count as exact.
    """

    pose_world_robot: FloatArray
    landmark: IntArray
    mode_position_m: FloatArray
    reading: FloatArray
    sigma: FloatArray
    states: FloatArray | None = None
    pose_covariance: FloatArray | None = None
    mode_covariance_m2: FloatArray | None = None

    @property
    def missed(self) -> BoolArray:
        """(R,) which looks are expected detections that did not come."""
        missed: BoolArray = np.isnan(self.reading[:, 0])
        return missed

    @property
    def has_mode(self) -> BoolArray:
        """(R, K) which modes the landmark of each look has."""
        has_mode: BoolArray = np.isfinite(self.mode_position_m[self.landmark, :, 0])
        return has_mode


def log_psi(
    readings: Readings, sensor: Sensor, *, miss_weight: float = 1.0, outlier_density: float = 0.0, gone: bool = False
) -> FloatArray:
    """Log likelihood of every look under every mode of the landmark that it looks at.

    A detection has `log [P_D(x, m) N(z; h(x, m), S) + outlier_density]`, an expected miss `miss_weight log(1 - P_D)`,
    `P_D(x, m) = P_D0 P(r_min < r < r_max) P(b in view)`, range and bearing Gaussian with the innovation covariance
    `S = H P H' + R`. Poses and modes count as independent in `P`.

    Args:
        readings: the looks, and the modes.
        sensor: limits, mounting and `P_D0`.
        miss_weight: share of a miss that is news, from `miss_weight_from`.
        outlier_density: of detections that come from elsewhere (wrong identities), per metre and radian: a floor, so
            that no single detection can force a switch. 0 is the paper's.
        gone: append a column for 'gone': nothing but outliers is seen, nothing is missed.

    Returns:
        (R, K) or (R, K + 1) log likelihoods; -inf for modes that the landmark does not have, and for a detection of
        what is gone where there are no outliers.
    """
    predicted, has_mode, missed = predict(readings, sensor), readings.has_mode, readings.missed
    in_view = log_in_view(
        np.where(has_mode, predicted.range_m, 0.0),
        np.where(has_mode, predicted.bearing_rad, 0.0),
        sensor,
        range_margin_m=np.where(has_mode, predicted.range_sigma_m, 1.0),
        bearing_margin_rad=np.where(has_mode, predicted.bearing_sigma_rad, 1.0),
    )
    with np.errstate(divide="ignore"):
        log_outlier = np.log(outlier_density)
        log_p_detect = np.log(sensor.p_detect) + in_view
    seen = np.logaddexp(log_p_detect + np.nan_to_num(predicted.log_density), log_outlier)
    unseen = miss_weight * np.log1p(-np.minimum(np.exp(log_p_detect), MOST_CERTAIN))
    value = np.where(has_mode, np.where(missed[:, None], unseen, seen), -np.inf)
    if gone:
        value = np.column_stack([value, np.where(missed, 0.0, log_outlier)])
    return value


class Predicted(NamedTuple):
    """What every look would read under every mode; all (R, K), nan where the landmark has no such mode.

    Attributes:
        range_m, bearing_rad: the reading that is expected.
        range_sigma_m, bearing_sigma_rad: its standard deviations, measurement noise included.
        squared_distance: squared Mahalanobis distance of the reading, nan for misses.
        log_density: `log N(z; h(x, m), S)`, nan for misses.
    """

    range_m: FloatArray
    bearing_rad: FloatArray
    range_sigma_m: FloatArray
    bearing_sigma_rad: FloatArray
    squared_distance: FloatArray
    log_density: FloatArray


def predict(readings: Readings, sensor: Sensor) -> Predicted:
    """Expected readings and how the actual ones compare."""
    from evermap_studies.nielsen2024.selectors.likelihood_kernels import predict_rows

    rows, modes = len(readings.landmark), readings.mode_position_m.shape[1]
    out = Predicted(*(np.full((rows, modes), np.nan) for _ in Predicted._fields))
    predict_rows(
        _contiguous(readings.pose_world_robot),
        np.asarray(readings.landmark, dtype=np.int64),
        _contiguous(readings.mode_position_m),
        _contiguous(readings.reading),
        _contiguous(readings.sigma),
        np.asarray(sensor.mount_robot_sensor, dtype=np.float64),
        _contiguous(readings.states, 9),
        _contiguous(readings.pose_covariance, rows, 3, 3),
        _contiguous(readings.mode_covariance_m2, *readings.mode_position_m.shape, 2),
        *out,
    )
    return out


def _contiguous(values: FloatArray | None, *shape: int) -> FloatArray:
    """As the kernel wants it; zeros of this shape where nothing is given."""
    return np.zeros(shape) if values is None else np.ascontiguousarray(values, dtype=np.float64)


def miss_weight_from(detected: FloatArray, first: IntArray, p_detect: float) -> float:
    """Share of a miss that is news, from a session's own looks at landmarks that were in view.

    A detector that has just missed a landmark (it is turned away, hidden, blurred) misses it again at the next look
    more often than its rate `P_D` says: on real recordings it hits with 0.7 after a hit and with 0.2 after a miss.
    Taken as independent, a landmark that is hidden for five seconds would be gone beyond all doubt. In the two-state
    Markov chain of the detector a further miss of a landmark that is there has probability `1 - P(hit | miss)`, so it
    tells against its presence by the log of that and not by `log(1 - P_D)`; the weight is the ratio of the two. It is
    used for the first miss of a series too, where it is too small: that errs on the side of what stands in the map.

    The transition probabilities are posterior means under a uniform prior, so that a short session gives a usable
    number. A detector whose misses come singly (`P(hit | miss) >= P_D`) has weight 1: no miss counts more than alone.

    Args:
        detected: (R,) 1 for a hit, 0 for a miss; sequences of looks at one landmark while it was in view.
        first: (S + 1,) row bounds of the sequences; none spans a time out of view.
        p_detect: `P_D0` that the weight will be used with, between 0 and 1.

    Raises:
        InputError: a detection that is neither 0 nor 1, or a probability outside (0, 1).
    """
    _, after_miss = hit_probabilities(detected, first)
    if not 0.0 < p_detect < 1.0:
        raise InputError(f"{p_detect} is not a probability", field="p_detect", hint="between 0 and 1")
    return float(min(1.0, np.log1p(-after_miss) / np.log1p(-p_detect)))


def hit_probabilities(detected: FloatArray, first: IntArray) -> tuple[float, float]:
    """`P(hit | hit before)` and `P(hit | miss before)`, posterior means under a uniform prior; arguments as above."""
    values = np.asarray(detected, dtype=np.float64)
    wrong = np.flatnonzero((values != 0.0) & (values != 1.0))
    if wrong.size:
        problem = f"row {wrong[0]}: {values[wrong[0]]} is neither a detection nor a miss"
        raise InputError(problem, field="detected", hint="1 or 0")
    follows = np.ones(len(values), dtype=np.bool_)
    follows[first[:-1][first[:-1] < len(values)]] = False
    after = np.flatnonzero(follows)
    before = values[after - 1] == 1.0
    hits = values[after]
    after_hit, after_miss = ((hits[state].sum() + 1.0) / (state.sum() + 2.0) for state in (before, ~before))
    return float(after_hit), float(after_miss)


def log_in_view(
    range_m: FloatArray,
    bearing_rad: FloatArray,
    sensor: Sensor,
    *,
    range_margin_m: FloatArray | float = USUAL.range_margin_m,
    bearing_margin_rad: FloatArray | float = USUAL.bearing_margin_rad,
) -> FloatArray:
    """Return `log P(inside the limits of the sensor)` of landmarks whose range and bearing are known to some margin.

    Args:
        range_m: from the sensor, of any shape.
        bearing_rad: from the sensor's x axis, in [-pi, pi), of the same shape.
        sensor: limits.
        range_margin_m: standard deviation of the range, of the same shape or a number.
        bearing_margin_rad: standard deviation of the bearing, likewise.
    """
    inside = _log_within(range_m, sensor.range_min_m, sensor.range_max_m, range_margin_m)
    if sensor.bearing_max_rad - sensor.bearing_min_rad < 2 * math.pi - 1e-6:
        inside += _log_within(bearing_rad, sensor.bearing_min_rad, sensor.bearing_max_rad, bearing_margin_rad)
    return inside


def _log_within(value: FloatArray, low: float, high: float, margin: FloatArray | float) -> FloatArray:
    """Return `log P(low < x) + log P(x < high)` of a value known to `margin`."""
    inside = np.zeros_like(value)
    if low > -math.inf:
        inside += log_ndtr((value - low) / margin)
    if high < math.inf:
        inside += log_ndtr((high - value) / margin)
    return inside
