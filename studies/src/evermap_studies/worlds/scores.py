"""Scores of a map in a world whose whole truth is known: what it claims to be where, and how sure it is.

Claims and statements are all counted, without exceptions for what the robot could not know. Counts of sessions add up;
ratios are taken of the sums. The statements do not depend on the map, so that maps can be compared by their Brier
score: 'landmark i stands where it stood last', for every landmark that was ever detected, true or not.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from evermap.geometry import se2
from evermap.types import BoolArray, FloatArray, IntArray, Landmarks

NEAR_M = 0.25
"""A landmark stands where the map has it up to this distance, which is less than the smallest move."""


@dataclass(frozen=True, slots=True)
class Existence:
    """Counts of one map at one instant, or sums of many.

    Attributes:
        n_claims, n_right: landmarks that the map believes in, and those of them that stand where it has them.
        n_there: landmarks that stand somewhere, known to the map or not.
        n_statements, squared_error: statements about existence, and sum of (probability - truth)^2 over them.
    """

    n_claims: int = 0
    n_right: int = 0
    n_there: int = 0
    n_statements: int = 0
    squared_error: float = 0.0

    def __add__(self, other: Existence) -> Existence:
        return Existence(*(getattr(self, item.name) + getattr(other, item.name) for item in fields(self)))

    @property
    def precision(self) -> float | None:
        """Return the share of the claims that are right; None without a claim."""
        return self.n_right / self.n_claims if self.n_claims else None

    @property
    def recall(self) -> float | None:
        """Return the share of what is there that is rightly claimed; None where nothing is there."""
        return self.n_right / self.n_there if self.n_there else None

    @property
    def brier(self) -> float | None:
        """Return the mean squared error of the probabilities (Brier 1950); None without a statement."""
        return self.squared_error / self.n_statements if self.n_statements else None


def existence_score(
    claimed: Landmarks,
    truth: Landmarks,
    *,
    pose_truth_map: FloatArray | None = None,
    within_m: float = NEAR_M,
    p_least: float = 0.5,
) -> Existence:
    """Count the claims of a map against what is there; no statements.

    Args:
        claimed: the map; every landmark at its most probable place.
        truth: all landmarks that are there at that instant.
        pose_truth_map: (3,) pose of the map in the frame of the truth; None where they share one.
        within_m: how far off a right claim may be.
        p_least: a landmark is claimed from this `p_exists` on.
    """
    is_claimed = claimed.p_exists >= p_least
    right = is_claimed & stands_at(claimed, truth, pose_truth_map, within_m)
    return Existence(n_claims=int(is_claimed.sum()), n_right=int(right.sum()), n_there=len(truth))


def stands_at(
    claimed: Landmarks, truth: Landmarks, pose_truth_map: FloatArray | None = None, within_m: float = NEAR_M
) -> BoolArray:
    """Return (C,) whether the landmarks of a map stand where it has them; False for those that are absent."""
    position_m = _in_truth(claimed.position_m, pose_truth_map)
    _, mine, theirs = np.intersect1d(claimed.landmark_id, truth.landmark_id, return_indices=True)
    right = np.zeros(len(claimed), dtype=np.bool_)
    right[mine] = np.linalg.norm(position_m[mine] - truth.position_m[theirs], axis=1) <= within_m
    return right


def statement_score(
    asked: Landmarks,
    truth: Landmarks,
    place_id: IntArray,
    place_m: FloatArray,
    p_here: FloatArray,
    *,
    pose_truth_map: FloatArray | None = None,
    within_m: float = NEAR_M,
) -> Existence:
    """Score the statements 'landmark i stands at q' with the probabilities that a map has for them; no claims.

    Args:
        asked: the statements: one landmark each, and where it stood last.
        truth: all landmarks that are there at the instant that the statements are about.
        place_id: (P,) landmark of every place that the map knows.
        place_m: (P, 2) position of each place.
        p_here: (P,) probability that the landmark stands there at that instant.
        pose_truth_map: (3,) pose of the map in the frame of the truth; None where they share one.
        within_m: how far off 'there' may be.
    """
    p = p_near(asked, place_id, _in_truth(place_m, pose_truth_map), p_here, within_m)
    error = p - stands_at(asked, truth, within_m=within_m)
    return Existence(n_statements=len(asked), squared_error=float(error @ error))


def p_near(
    asked: Landmarks, place_id: IntArray, place_m: FloatArray, p_here: FloatArray, within_m: float = NEAR_M
) -> FloatArray:
    """Return (A,) probability that each landmark stands near where it is asked for, summed over its places there."""
    row = np.searchsorted(asked.landmark_id, place_id)
    known = row < len(asked)
    known[known] = asked.landmark_id[row[known]] == place_id[known]
    row = row[known]
    near = np.linalg.norm(place_m[known] - asked.position_m[row], axis=1) <= within_m
    return np.minimum(np.bincount(row[near], p_here[known][near], minlength=len(asked)), 1.0)


def _in_truth(position_m: FloatArray, pose_truth_map: FloatArray | None) -> FloatArray:
    return position_m if pose_truth_map is None else se2.transform(pose_truth_map, position_m)
