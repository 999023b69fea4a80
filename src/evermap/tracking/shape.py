"""Filters of a box's size and heading, and their likelihoods for the assignment.

A box in the state is nine numbers: length, width, height [m], heading [rad], their four variances, and the log odds
that the heading is right rather than opposite, which detectors confuse. Every number has a filter of its own: sizes are
constant but for what a changing view does to them, headings turn at random, the faster the shorter the box.
"""

from __future__ import annotations

import math

import numpy as np

from evermap.tracking.kalman import inlined, kernel
from evermap.tracking.tracklets import FORWARD, N_DETECTED, VARIANCE, YAW, Rules
from evermap.types import FloatArray


@inlined
def wrapped(angle: float, period: float) -> float:
    """Return an angle within half a period of zero."""
    return angle - period * math.floor(angle / period + 0.5)


@inlined
def shape_log_ratio(
    box: FloatArray, detected: FloatArray, noise: FloatArray, other_size: float, p_misshapen: float
) -> float:
    """Return the log-likelihood ratio of a detected size and heading for this box, over those of any other object."""
    total = 0.0
    for k in range(3):
        v = box[VARIANCE + k] + noise[k]
        d, other = detected[k] - box[k], (other_size * box[k]) ** 2 + v
        total += 0.5 * (math.log(other / v) - d * d / v + d * d / other)
    v = box[VARIANCE + YAW] + noise[YAW]
    e = wrapped(detected[YAW] - box[YAW], math.pi)
    total += -0.5 * (e * e / v + math.log(2.0 * math.pi * v)) + math.log(math.pi)
    return math.log((1.0 - p_misshapen) * math.exp(min(total, 50.0)) + p_misshapen)


@inlined
def begin_shape(box: FloatArray, detected: FloatArray, noise: FloatArray, forward_nats: float) -> None:
    """Set a box to a detection."""
    for k in range(N_DETECTED):
        box[k], box[VARIANCE + k] = detected[k], noise[k]
    box[FORWARD] = forward_nats


@kernel
def predict_shapes(box: FloatArray, n: int, gap_s: float, turning: float, resizing: float) -> None:
    """Move sizes and headings of the first `n` boxes (N, 9) on, in place."""
    for i in range(n):
        for k in range(3):
            box[i, VARIANCE + k] += (resizing * box[i, k]) ** 2 * gap_s
        turn = turning / max(box[i, 0], 0.1)
        box[i, VARIANCE + YAW] = min(box[i, VARIANCE + YAW] + turn * turn * gap_s, math.pi**2 / 3.0)


@inlined
def update_shape(
    box: FloatArray, detected: FloatArray, noise: FloatArray, mean: FloatArray, covariance: FloatArray, rules: Rules
) -> None:
    """Update a box by a detection, and distinguish front and back by its direction of motion."""
    for k in range(3):
        gain = box[VARIANCE + k] / (box[VARIANCE + k] + noise[k])
        box[k] += gain * (detected[k] - box[k])
        box[VARIANCE + k] *= 1.0 - gain
    off = wrapped(detected[YAW] - box[YAW], 2.0 * math.pi)
    around = abs(off) > 0.5 * math.pi
    gain = box[VARIANCE + YAW] / (box[VARIANCE + YAW] + noise[YAW])
    box[YAW] += gain * wrapped(off, math.pi)
    box[VARIANCE + YAW] *= 1.0 - gain
    step, most = rules.forward_nats, rules.most_forward_nats
    box[FORWARD] = min(box[FORWARD] + (-step if around else step), most)
    c, s = math.cos(box[YAW]), math.sin(box[YAW])
    along = c * mean[3] + s * mean[4]
    v = c * c * covariance[3, 3] + 2.0 * c * s * covariance[3, 4] + s * s * covariance[4, 4]
    if along * along > rules.sure_of_way * v and abs(along) > box[0] / 4.0:
        box[FORWARD] = most if along > 0.0 else -most
    if box[FORWARD] < 0.0:
        box[YAW] += math.pi
        box[FORWARD] = -box[FORWARD]
    box[YAW] = wrapped(box[YAW], 2.0 * math.pi)


def noise_of_shapes(box: FloatArray, face_m: FloatArray) -> FloatArray:
    """Return (M, 4) variances of detected sizes and headings.

    A size is the difference of two faces, a heading the angle between two ends.

    Args:
        box: (M, 4).
        face_m: (M, 3) standard deviations of where faces are, along, across, and up.
    """
    size = 2.0 * face_m**2
    return np.column_stack([size, size[:, 0] / np.maximum(box[:, 0], 1e-3) ** 2])


def noise_of_centres(box: FloatArray, face_m: FloatArray) -> FloatArray:
    """Return (M, 3, 3) covariances of detected centres, the mean of two faces each."""
    c, s = np.cos(box[:, YAW]), np.sin(box[:, YAW])
    v = 0.5 * face_m**2
    found = np.zeros((len(box), 3, 3))
    found[:, 0, 0] = c * c * v[:, 0] + s * s * v[:, 1]
    found[:, 1, 1] = s * s * v[:, 0] + c * c * v[:, 1]
    found[:, 0, 1] = found[:, 1, 0] = c * s * (v[:, 0] - v[:, 1])
    found[:, 2, 2] = v[:, 2]
    return found
