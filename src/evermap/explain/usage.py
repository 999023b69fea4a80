"""Which detections a solution used: shares of them, landmarks that are contradicted, and times without any."""

from __future__ import annotations

from math import nan

import numpy as np

from evermap.explain.expectations import FEWEST, PER_LANDMARK, USED, find_poses_at
from evermap.types import UNKNOWN, AnyRecording, Innovations, SlamResult

LEAST_STREAK = 0.2
"""Share of its detections that a landmark is contradicted by in a row: fewer may be one bad look."""
STRETCHES = 10
"""Parts of a drive of which the worst is looked for."""


def count_shares_used(innovations: Innovations) -> tuple[float, float]:
    """Return the share of detections with a prediction that were used, and the least of a part of the drive."""
    stamp_s, inlier = innovations.stamp_s, innovations.p_inlier >= USED
    if len(inlier) < FEWEST:
        return nan, nan
    order = np.argsort(stamp_s, kind="stable")
    parts = np.array_split(inlier[order], min(STRETCHES, len(inlier) // FEWEST))
    return float(inlier.mean()), min(float(part.mean()) for part in parts)


def find_share_named(innovations: Innovations, recording: AnyRecording) -> float:
    """Return the share of the detections with an identity that were used; nan where hardly any has one."""
    named = int(np.count_nonzero(recording.detections.landmark_id != UNKNOWN))
    used = innovations.detection[innovations.p_inlier >= USED]
    if named < max(FEWEST, len(used)):  # identities were found, not read
        return nan
    return len(used) / named


def find_share_contradicted(result: SlamResult) -> float:
    """Return the share of landmarks that were seen often, most of whose detections were not used."""
    _, row, count = np.unique(result.innovations.landmark_id, return_inverse=True, return_counts=True)
    used = np.bincount(row, result.innovations.p_inlier >= USED, minlength=len(count))
    often = count >= PER_LANDMARK
    return float(np.mean(used[often] < 0.5 * count[often])) if often.any() else nan


def count_unexplained(result: SlamResult) -> int:
    """Return landmarks of which many detections in a row were not used, where the robot was located, without a change
    of them that is reported.
    """
    located = find_poses_at(result.trajectory, result.innovations.stamp_s)[1]
    innovations = result.innovations[np.flatnonzero(located)]
    name, row, count = np.unique(innovations.landmark_id, return_inverse=True, return_counts=True)
    order = np.lexsort((innovations.stamp_s, row))
    first = np.cumsum(count) - count
    # before the first of each landmark, and after its last, it is as if one was used
    used = np.flatnonzero(innovations.p_inlier[order] >= USED)
    of_used = row[order[used]]
    edges = np.concatenate([first - 1, used, first + count])
    of_edge = np.concatenate([np.arange(len(name)), of_used, np.arange(len(name))])
    by_landmark = np.lexsort((edges, of_edge))
    streak, of_streak = np.diff(edges[by_landmark]) - 1, of_edge[by_landmark]
    longest = np.zeros(len(name), dtype=np.int64)
    same = of_streak[1:] == of_streak[:-1]
    np.maximum.at(longest, of_streak[1:][same], streak[same])
    known = np.isin(name, [one for change in result.changes for one in change.landmark_ids])
    return int(np.count_nonzero(~known & (longest >= np.maximum(PER_LANDMARK, LEAST_STREAK * count))))


def find_blind_time(result: SlamResult) -> tuple[float, float]:
    """Return the longest time without a used detection, in seconds and as a share of the drive."""
    path, innovations = result.trajectory, result.innovations
    if not len(path):
        return nan, nan
    used_s = innovations.stamp_s[innovations.p_inlier >= USED]
    edges = np.sort(np.concatenate([path.stamp_s[[0, -1]], used_s]))  # some poses may not have been found
    longest, lasted = float(np.diff(edges).max()), float(edges[-1] - edges[0])
    return longest, longest / lasted if lasted > 0.0 else nan
