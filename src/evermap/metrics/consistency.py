"""Consistency of estimates with their covariances: normalised squared errors against the chi-square law.

NEES compares errors with truth, NIS compares detections with predictions (Bar-Shalom, Li, Kirubarajan 2001,
section 5.4). Both are chi-square with as many degrees of freedom as components if the covariances are honest;
a larger mean says overconfident, a smaller one says too cautious.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.estimate.innovations import comparable_nis, lag1_autocorrelation
from evermap.types import FloatArray, Innovations

CONFIDENCE = 0.95


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return `e^T P^-1 e` per row; nan where the covariance is singular (an exact pose has no NEES).

    Args:
        error: (N, D), in the frame of the covariance.
        covariance: (N, D, D).
    """
    out = np.full(len(error), np.nan)
    size = error.shape[1]
    scale = np.trace(covariance, axis1=1, axis2=2) / size
    safe = np.where(scale > 0, scale, 1.0)
    regular = (scale > 0) & (np.linalg.det(covariance / safe[:, None, None]) > 1e-12)
    if np.any(regular):
        solved = np.linalg.solve(covariance[regular], error[regular][:, :, None])[:, :, 0]
        out[regular] = np.sum(error[regular] * solved, axis=1)
    return out


def chi2_quantile(p: float, dof: float) -> float:
    """Return the value below which a chi-square variable with `dof` degrees stays with probability `p`.

    Equals scipy.stats, whose import takes as long as a short recording.
    """
    from scipy.special import gammaincinv

    return float(2.0 * gammaincinv(dof / 2.0, p))


def chi2_interval(dof: float, count: int = 1, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the two-sided interval of the mean of `count` independent chi-square variables with `dof` degrees."""
    tail = (1.0 - confidence) / 2.0
    total = dof * count
    return chi2_quantile(tail, total) / count, chi2_quantile(1.0 - tail, total) / count


def share_in_band(values: FloatArray, dof: float = 2, confidence: float = CONFIDENCE) -> float | None:
    """Return the share of finite values below the chi-square quantile, `confidence` if consistent; None if no value."""
    finite = values[np.isfinite(values)]
    return float(np.mean(finite <= chi2_quantile(confidence, dof))) if len(finite) else None


def running_mean(values: FloatArray, window: int) -> FloatArray:
    """Return the mean (N,) over the last `window` values, nan until there are that many."""
    out = np.full(len(values), np.nan)
    if window < 1 or len(values) < window:
        return out
    total = np.concatenate([[0.0], np.cumsum(values)])
    out[window - 1 :] = (total[window:] - total[:-window]) / window
    return out


@dataclass(frozen=True, slots=True)
class NisSummary:
    """Innovation consistency of a run; None where there is no innovation.

    Attributes:
        count: detections that had a prediction and are more likely inliers than not (p_inlier >= 0.5).
        outlier_share: share of detections that are more likely outliers.
        mean: over the inliers, 2 expected; mean_all: over all, outliers included; median: over all, 1.386 expected.
        mean_band: where `mean` lies in 95 % of consistent runs with independent innovations.
        in_band_share: share of the inliers below the one-sided 95 % quantile (5.99), 0.95 expected.
        in_two_sided_band_share: share of the inliers in the two-sided 95 % interval (0.05 to 7.38), 0.95 expected.
        lag1: correlation between a landmark's successive values (see `lag1_autocorrelation`), 0 expected.
    """

    count: int
    outlier_share: float | None
    mean: float | None
    mean_all: float | None
    median: float | None
    mean_band: tuple[float, float] | None
    in_band_share: float | None
    in_two_sided_band_share: float | None
    lag1: float | None


def summarise_nis(innovations: Innovations) -> NisSummary:
    """Summarise the NIS, on the scale of two degrees of freedom (see `comparable_nis`).

    Leaving out the outliers trims the tail a little, so both means are given.
    """
    values = comparable_nis(innovations)
    finite = np.isfinite(values)
    inlier = finite & (innovations.p_inlier >= 0.5)
    nis = values[inlier]
    if not np.any(finite):
        return NisSummary(0, None, None, None, None, None, None, None, None)
    everything = values[finite]
    if len(nis) == 0:
        return NisSummary(0, 1.0, None, float(everything.mean()), float(np.median(everything)), None, None, None, None)
    low, high = chi2_interval(2)
    return NisSummary(
        count=len(nis),
        outlier_share=float(np.mean(innovations.p_inlier[finite] < 0.5)),
        mean=float(nis.mean()),
        mean_all=float(everything.mean()),
        median=float(np.median(everything)),
        mean_band=chi2_interval(2, len(nis)),
        in_band_share=share_in_band(nis),
        in_two_sided_band_share=float(np.mean((nis >= low) & (nis <= high))),
        lag1=lag1_autocorrelation(nis, innovations.landmark_id[inlier].astype(np.float64)),
    )
