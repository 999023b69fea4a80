"""Innovations of detections of any kind on one scale, and whether they are independent."""

from __future__ import annotations

import numpy as np

from evermap.types import FloatArray, Innovations


def comparable_nis(innovations: Innovations) -> FloatArray:
    """Return the NIS (K,) on the scale of two degrees of freedom: values with the same chi-square tail probability.

    So detections of any kind have one mean (2) and one bound (5.99) if consistent. Unchanged if all have two.
    """
    nis, dof = innovations.nis, innovations.dof
    if dof is None or np.all(dof == 2):
        return nis
    from scipy.special import gammainc, gammaincc, gammaln

    half, shape = 0.5 * np.where(np.isfinite(nis), nis, 0.0), 0.5 * dof
    beyond = gammaincc(shape, half)
    safe = np.maximum(half, 1.0)
    far = -safe + (shape - 1.0) * np.log(safe) - gammaln(shape) + np.log1p(np.maximum(shape - 1.0, 0.0) / safe)
    with np.errstate(divide="ignore"):
        log_tail = np.where(beyond > 0.5, np.log1p(-gammainc(shape, half)), np.log(beyond))
    log_tail = np.where(beyond > 1e-280, log_tail, far)  # the asymptotic series, where the tail underflows
    return np.asarray(np.where(np.isfinite(nis), -2.0 * log_tail, nis))


LEAST_WEIGHT = 1e-6
"""Smallest weight of a detection that is divided by."""


def find_left_out_nis(residual: FloatArray, leverage: FloatArray, left: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the NIS (K,) of detections, each as if it had not been used.

    With H = J S J' of whitened Jacobians and the covariance S, and the weight w, of the residual r it is
    r' (1 - w H)^-1 (1 - w H + H)^-1 r.

    Args:
        residual: (K, R) whitened, not weighted.
        leverage: (K, R, R) w H.
        left: (K, R, R) 1 - w H, which must have an inverse.
        weight: (K,) w.
    """
    r = residual[..., None]
    spread = left + leverage / np.maximum(weight, LEAST_WEIGHT)[:, None, None]
    nis = (np.linalg.solve(left, r) * np.linalg.solve(spread, r)).sum(axis=(1, 2))
    return np.asarray(np.maximum(nis, 0.0))


def lag1_autocorrelation(values: FloatArray, group: FloatArray) -> float | None:
    """Correlate successive values of the same group, pooled over the groups; None with fewer than ten pairs.

    NIS values are first made normal through their chi-square law, so that a few large ones do not decide. Near 0
    where errors are independent from one detection to the next; positive where a persistent error is not modelled.

    Args:
        values: (N,) squared distances with 2 degrees of freedom, in order of time.
        group: (N,) what is compared with itself, e.g. landmark ids.
    """
    from scipy.special import ndtri

    tail = np.clip(np.exp(-0.5 * values), 1e-12, 1.0 - 1e-12)  # chi-square with 2 dof: P(X > v) = exp(-v / 2)
    score = -ndtri(tail)
    order = np.argsort(group, kind="stable")
    score, key = score[order], group[order]
    same = key[1:] == key[:-1]
    if np.count_nonzero(same) < 10:
        return None
    first, second = score[:-1][same], score[1:][same]
    first, second = first - first.mean(), second - second.mean()
    norm = float(np.sqrt(np.sum(first**2) * np.sum(second**2)))
    return float(np.sum(first * second)) / norm if norm > 0 else None
