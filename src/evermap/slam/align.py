"""One map laid over another: the rigid motion that most of their landmarks agree on."""

from __future__ import annotations

import numpy as np

from evermap import se2
from evermap.types import BoolArray, FloatArray

AGREE_M = 0.5
"""Landmarks agree with a map where they lie this close to its places."""


def consensus(source: FloatArray, target: FloatArray) -> tuple[FloatArray, BoolArray]:
    """The motion (3,) that brings most points (k, 2) near their partners, and which (k,): one pair after the other."""
    best_pose, best, best_score = np.zeros(3), np.zeros(len(source), dtype=np.bool_), (0, 0.0)
    for i in range(len(source)):
        for j in range(i + 1, len(source)):
            span = np.linalg.norm(target[i] - target[j])
            if span < AGREE_M or abs(span - np.linalg.norm(source[i] - source[j])) > AGREE_M:
                continue
            pose = rigid(source[[i, j]], target[[i, j]])
            gap = np.linalg.norm(se2.transform(pose, source) - target, axis=1)
            agree = gap < AGREE_M
            score = (int(agree.sum()), -float(gap[agree].sum()))
            if score > best_score:
                best_score, best_pose, best = score, pose, agree
    return (rigid(source[best], target[best]) if best.any() else best_pose), best


def rigid(source: FloatArray, target: FloatArray) -> FloatArray:
    """(3,) rotation and translation that brings points (k, 2) onto others, least squares."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    theta = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    shift = target.mean(axis=0) - se2.rotation(theta) @ source.mean(axis=0)
    return np.array([shift[0], shift[1], theta])
