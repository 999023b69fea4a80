"""`log psi`: what a look at a landmark says about each of its modes (Nielsen 2024 section 6, MATH.md section 5)."""

from __future__ import annotations

from evermap.types import FloatArray, IntArray, Sensor


def log_psi(
    pose_world_robot: FloatArray,
    landmark: IntArray,
    mode_position_m: FloatArray,
    reading: FloatArray,
    sigma: FloatArray,
    sensor: Sensor,
    *,
    states: FloatArray | None = None,
    pose_covariance: FloatArray | None = None,
    mode_covariance_m2: FloatArray | None = None,
    miss_weight: float = 1.0,
    outlier_density: float = 0.0,
    gone: bool = False,
) -> FloatArray:
    """Log likelihood of every look under every mode of the landmark that it looks at.

    A detection has `log [P_D(x, m) N(z; h(x, m), S) + outlier_density]`, an expected miss `miss_weight log(1 - P_D)`,
    `P_D(x, m) = P_D0 P(r_min < r < r_max) P(b in view)`, range and bearing Gaussian with the innovation covariance
    `S = H P H' + R`. Poses and modes count as independent in `P`.

    Args:
        pose_world_robot: (R, 3) pose at every look.
        landmark: (R,) row of `mode_position_m` that each look is at.
        mode_position_m: (L, K, 2) modes of every landmark, nan for one that it does not have.
        reading: (R, 2) range [m] and bearing [rad] as reported; nan for an expected detection that did not come.
        sigma: (R, 2) their standard deviations.
        sensor: limits, mounting and `P_D0`.
        states: (9,) calibration states of `slam.calibration`; None for a sensor that reads true.
        pose_covariance: (R, 3, 3) in the robot's frame; None where poses count as exact.
        mode_covariance_m2: (L, K, 2, 2); None where positions count as exact.
        miss_weight: share of a miss that is news, from `miss_weight_from`.
        outlier_density: of detections that come from elsewhere (wrong identities), per metre and radian: a floor, so
            that no single detection can force a switch. 0 is the paper's.
        gone: append a column for 'gone': nothing but outliers is seen, nothing is missed.

    Returns:
        (R, K) or (R, K + 1) log likelihoods; -inf for modes that the landmark does not have.
    """
    raise NotImplementedError


def miss_weight_from(detected: FloatArray, first: IntArray, p_detect: float) -> float:
    """Share of a miss that is news, from a session's own looks at landmarks that were in view.

    Args:
        detected: (R,) 1 for a hit, 0 for a miss; sequences of looks at one landmark while it was in view.
        first: (S + 1,) row bounds of the sequences; none spans a time out of view.
        p_detect: `P_D0` that the weight will be used with.
    """
    raise NotImplementedError
