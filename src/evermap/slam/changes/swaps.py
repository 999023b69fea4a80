"""Landmarks that carry each other's identity: two moves without any freedom, so they are searched for on their own."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evermap.slam.changes.evidence import Comparison, Evidence
from evermap.slam.changes.explain import GivenMap
from evermap.slam.changes.search import item_columns
from evermap.types import FloatArray

P_SWAPPED = 1e-5
"""Prior probability that any two landmarks of a map were mixed up."""


class Swap(NamedTuple):
    """Two landmarks, and the log prior of their being mixed up."""

    first: int
    second: int
    log_prior: float


def likeliest_swap(evidence: Evidence, comparison: Comparison, given: GivenMap) -> Swap | None:
    """The two landmarks that gain most by taking each other's place; None if that gains less than it costs.

    Args:
        evidence: of the copies.
        comparison: the same, seen from the map.
        given: the map.
    """
    candidates = np.intersect1d(np.unique(evidence.landmark), np.flatnonzero(given.given))
    count = len(candidates)
    if count < 2:
        return None
    quadratic, linear = item_columns(evidence, comparison, given.mean, 1, candidates)
    precision = quadratic.reshape(count, 4, count, 4)[:, :2, :, :2]
    pull = linear.reshape(count, 4)[:, :2]
    place = given.mean[candidates]
    first, second = np.triu_indices(count, 1)
    step = place[second] - place[first]
    rows = np.arange(count)
    own = precision[rows, :, rows, :]
    stiff = own[first] + own[second] - precision[first, :, second, :] - precision[second, :, first, :]
    gain: FloatArray = (step * (pull[first] - pull[second])).sum(axis=1)
    gain -= 0.5 * np.einsum("ka,kab,kb->k", step, stiff, step)
    best = int(np.argmax(gain))
    log_prior = float(np.log(P_SWAPPED) - np.log(len(gain)))
    if gain[best] + log_prior <= 0.0:
        return None
    return Swap(int(candidates[first[best]]), int(candidates[second[best]]), log_prior)


def with_swap(given: GivenMap, first: int, second: int) -> GivenMap:
    """The map with two landmarks at each other's place."""
    order = np.arange(len(given.mean))
    order[[first, second]] = second, first
    return replace(given, mean=given.mean[order], covariance=given.covariance[order])
