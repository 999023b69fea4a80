"""What readings and one solution show to be wrong without a comparison: jumps and silences of the odometry, corners of
tags that are listed clockwise, stamps that jitter, and identities on two landmarks; and whether the solution has put it
right.

The estimator bridges both by what is seen: a step that no robot drives is an outlier of the odometry, and within a gap
it may go anywhere. Where the poses are as well known for all that, the cause is told, and nothing is wrong with the
run; where they are not, the odometry is suspect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import degrees, isnan, nan

import numpy as np

from evermap.explain.expectations import PER_LANDMARK, USED, compare_detections, find_poses_at
from evermap.explain.jitter import find_jitter
from evermap.explain.motions import find_motions, find_turns_between
from evermap.geometry import se2, se3
from evermap.slam.check import CLOCKWISE, CORNERS, RIDER, SILENCE, is_clockwise
from evermap.slam.gaps import find_gaps, is_outside
from evermap.slam.mistakes import Finding
from evermap.types import (
    AnyRecording,
    Cause,
    FloatArray,
    IntArray,
    Landmarks,
    ParameterEstimate,
    SlamResult,
    Trajectory,
    is_in_space,
)

JUMP_M, JUMP_RAD = 0.2, 0.2
"""Difference of odometry and trajectory within a step that is no noise of it [m, rad]."""
TIMES = 10.0
"""That over what all but a hundredth of the steps differ by."""
BESIDE = 2
"""Steps on both sides to which the estimator may have shared out a jump."""
SAME_S = 1e-6
"""Difference of the stamps of a frame and of its detections."""
POORLY, LEAST_M = 5.0, 0.02
"""Standard deviation of positions during a silence, over the usual one, from which they are not known, and the least
[m]."""

APART_M, SCATTERS = 0.3, 5.0
"""Distance of two landmarks of one identity, at least [m], and over what sightings of a landmark scatter by."""
TURNS, AT_ONCE, OFTEN = 3, 2, 0.3
"""Times that an identity is seen at the one place, then at the other: what was carried off and brought back makes two.
Or frames that show both, which a wrong reading may do once. And share of the sightings that are of the second: outliers
of a real sensor lie together, too, but are fewer."""


def find_faults(
    result: SlamResult,
    recording: AnyRecording,
    findings: Sequence[Finding],
    prior_map: Landmarks | None,
    doubled: Sequence[int] | IntArray = (),
) -> tuple[tuple[Cause, ...], tuple[Cause, ...]]:
    """Return causes that leave poses unknown or a new map wrong, and those that the solution has put right.

    Args:
        result: of the run.
        recording: as it was estimated, without rows of the odometry that say nothing.
        findings: what `slam.check` found of it.
        prior_map: that was given, or what a living map expected; it tells in which order corners are.
        doubled: identities that were read at two places at once, and are not used.
    """
    order = (*_order_of_corners(result, recording, prior_map), *find_jitter(result, recording))
    names = [(recording.landmark_names.get(int(one), str(one)), nan) for one in doubled]
    riders = (_rider(finding) for finding in findings if finding.code == RIDER)
    mended = (*riders, *(_double(*each) for each in [*names, *find_doubles(result, recording)]))
    silent = [finding for finding in findings if finding.code == SILENCE]
    if recording.odometry is None or len(result.trajectory) < 3:
        return order, mended
    gaps_s = find_gaps(recording.odometry)
    start_s = float(recording.odometry.stamp_s[0])
    jumps = find_jumps(result, gaps_s)
    told = [*mended, *(_jump(*jump, start_s, len(jumps)) for jump in jumps[:1])]
    if not jumps and (unseen := find_unseen_jumps(result, gaps_s)):
        order = (*order, _jump(*unseen[0], start_s, len(unseen), "while nothing was seen, so that nobody knows when"))
    if not silent or not len(gaps_s):
        return order, tuple(told)
    long_s = float(np.diff(gaps_s, axis=1).sum())
    fix = "odometry: its driver, or its connection"
    silence = Cause(SILENCE, "odometry", silent[0].message, long_s, nan, 1.0, fix)
    if _is_poor(result.trajectory, gaps_s):
        return (*order, silence), tuple(told)
    return order, (silence, *told)


def _order_of_corners(result: SlamResult, recording: AnyRecording, prior_map: Landmarks | None) -> tuple[Cause, ...]:
    """Return that corners of tags are listed clockwise: the normals of all tags point into their walls.

    Poses are as good for all that, and so is a map whose tags are alike.
    """
    known = prior_map is not None and prior_map.rotation is not None and np.isfinite(prior_map.rotation).any()
    if known or not is_in_space(recording) or any(cause.code == "corner-order" for cause in result.causes):
        return ()
    if not is_clockwise(recording).any():
        return ()
    how = CORNERS[CLOCKWISE]
    return (Cause("corner-order", "corners", how.message, probability=1.0, fix=how.fix),)


def _rider(finding: Finding) -> Cause:
    return Cause(RIDER, "detections", finding.message, probability=1.0, fix="detections.csv: none of what rides along")


def find_doubles(result: SlamResult, recording: AnyRecording) -> list[tuple[str, float]]:
    """Return names of identities that are on two landmarks, and how far these are apart [m].

    Both are seen at once, or in turns, so that it is no landmark that moved, and none with another identity stands
    there, which was misread. The estimator keeps them apart, or leaves out the sightings of the second.
    """
    compared = compare_detections(recording, result)
    pose = find_poses_at(result.trajectory, compared.taken_s)[0]
    at = (se2 if pose.shape[1] == 3 else se3).transform(pose, compared.point_m)
    read, places = recording.detections.landmark_id[compared.detection], result.landmarks
    usable = np.isfinite(at).all(axis=1) & ~np.isin(read, [one for each in result.changes for one in each.landmark_ids])
    found = list[tuple[str, float]]()
    for identity in np.unique(read[usable & ~(compared.used & (compared.landmark_id == read))]).tolist():
        mine = np.flatnonzero(usable & (read == identity))
        own = mine[compared.used[mine] & (compared.landmark_id[mine] == identity)]
        if len(own) < PER_LANDMARK:
            continue
        first = np.median(at[own], axis=0)
        radius_m = max(APART_M, SCATTERS * float(np.median(np.linalg.norm(at[own] - first, axis=1))))
        others = mine[np.linalg.norm(at[mine] - first, axis=1) > radius_m]
        near = np.linalg.norm(at[others, None] - at[others], axis=2) < radius_m
        if not len(others) or (count := near.sum(axis=1)).max() < PER_LANDMARK:
            continue
        others = others[near[int(np.argmax(count))]]
        second = np.median(at[others], axis=0)
        names = np.isin(places.landmark_id, [identity, *compared.landmark_id[mine].tolist()], invert=True)
        if (np.linalg.norm(places.position_m[names] - second, axis=1) < radius_m).any():
            continue
        taken_s = np.concatenate([compared.taken_s[own], compared.taken_s[others]])
        is_second = np.repeat([False, True], [len(own), len(others)])[np.argsort(taken_s, kind="stable")]
        at_once = np.intersect1d(compared.taken_s[own], compared.taken_s[others])
        is_double = len(at_once) >= AT_ONCE or np.count_nonzero(np.diff(is_second)) >= TURNS
        if is_double and len(others) > OFTEN * len(taken_s):
            name = str(recording.landmark_names.get(identity, identity))
            found.append((name, float(np.linalg.norm(second - first))))
    return found


def _double(name: str, apart_m: float) -> Cause:
    where = "at once, and not used" if isnan(apart_m) else f"in turns, {apart_m:.3g} m apart"
    message = f"two landmarks carry the identity {name}: it is read at two places {where}"
    return Cause("double-identity", name, message, apart_m, nan, 1.0, "another identity for one of the two")


def with_mended(result: SlamResult, mended: tuple[Cause, ...]) -> SlamResult:
    """Return the result, and its verdict, with causes that the solution has put right: they do not change it."""
    if not mended:
        return result
    verdict = result.verdict
    if verdict is not None:
        verdict = replace(verdict, causes=(*verdict.causes, *mended))
    return replace(result, causes=(*result.causes, *mended), verdict=verdict)


def find_jumps(result: SlamResult, gaps_s: FloatArray) -> list[tuple[float, float, float]]:
    """Return the stamps [s], lengths [m] and turns [rad] of steps that odometry and trajectory differ by, the largest
    first; a step in gaps (K, 2) of the odometry is none.
    """
    path, other = result.trajectory, result.dead_reckoning
    if len(other) != len(path) or not np.array_equal(path.stamp_s, other.stamp_s):
        return []
    last = np.arange(1, len(path))
    shift_m, turn_rad = _differ(path.pose_world_robot, other.pose_world_robot, last - 1, last)
    beyond = np.zeros(len(last), dtype=np.bool_)
    for size, least in ((shift_m, JUMP_M), (turn_rad, JUMP_RAD)):
        beyond |= size > max(least, TIMES * float(np.quantile(size, 0.99)))
    beyond &= is_outside(gaps_s, path.stamp_s[:-1], path.stamp_s[1:])
    rows = np.flatnonzero(beyond)
    rows = rows[np.argsort(-shift_m[rows])]
    around = np.clip([rows - BESIDE, rows + 1 + BESIDE], 0, len(path) - 1)
    shift_m, turn_rad = _differ(path.pose_world_robot, other.pose_world_robot, *around)
    return list(zip(path.stamp_s[rows + 1].tolist(), shift_m.tolist(), turn_rad.tolist(), strict=True))


def find_unseen_jumps(result: SlamResult, gaps_s: FloatArray) -> list[tuple[float, float, float]]:
    """Return as `find_jumps` what odometry and trajectory differ by between two poses that saw something, with others
    between these that did not: where among them the jump was is not known, nor are they.
    """
    path, other = result.trajectory, result.dead_reckoning
    if len(other) != len(path) or not np.array_equal(path.stamp_s, other.stamp_s):
        return []
    poses = path.pose_world_robot, other.pose_world_robot
    steps = np.arange(1, len(path))
    usual_m = float(np.median(_differ(*poses, steps - 1, steps)[0]))
    seen_s = np.unique(result.innovations.stamp_s[result.innovations.p_inlier >= USED])
    seen = np.unique(np.searchsorted(path.stamp_s, seen_s - SAME_S).clip(0, len(path) - 1))
    first, last = seen[:-1], seen[1:]
    blind = (last - first > 1) & is_outside(gaps_s, path.stamp_s[first], path.stamp_s[last])
    first, last = first[blind], last[blind]
    shift_m, turn_rad = _differ(*poses, first, last)
    went_m = np.min([np.linalg.norm(find_motions(each, first, last), axis=1) for each in poses], axis=0)
    # more than the robot went at all, and goes until the later clock says so: clocks that differ are no jump
    went_m += _find_longest_delay_s(result.parameters) * _find_top_speed(path)
    beyond = shift_m > np.maximum(np.maximum(JUMP_M, went_m), TIMES * usual_m * (last - first))
    rows = np.flatnonzero(beyond)
    rows = rows[np.argsort(-shift_m[rows])]
    found = path.stamp_s[first[rows]], shift_m[rows], turn_rad[rows]
    return list(zip(*(each.tolist() for each in found), strict=True))


def _find_longest_delay_s(parameters: tuple[ParameterEstimate, ...]) -> float:
    """Return by how much two clocks differ at most, as was estimated."""
    return max((abs(one.value) for one in parameters if one.name.endswith("_delay_s") and not one.fixed), default=0.0)


def _find_top_speed(path: Trajectory) -> float:
    """Return how fast the robot goes where it goes fast [m/s]: all but a hundredth of the steps are slower."""
    steps = np.arange(1, len(path))
    went_m = np.linalg.norm(find_motions(path.pose_world_robot, steps - 1, steps), axis=1)
    return float(np.quantile(went_m / np.diff(path.stamp_s), 0.99)) if len(steps) else 0.0


def _differ(pose: FloatArray, other: FloatArray, first: IntArray, last: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return by how much motions of two paths differ [m, rad]."""
    one, two = (find_motions(each, first, last) for each in (pose, other))
    return np.linalg.norm(one - two, axis=1), np.abs(find_turns_between(pose, other, first, last))


def _jump(at_s: float, shift_m: float, turn_rad: float, start_s: float, count: int, when: str = "") -> Cause:
    more = f", the largest of {count}" if count > 1 else ""
    when = f" {when}" if when else ""
    message = (
        f"the robot was displaced by {shift_m:.2g} m and {degrees(turn_rad):.0f} deg against its odometry, "
        f"{at_s - start_s:.1f} s after its start{when}{more}: an estimate that was corrected, or begins anew, wheels "
        "that slip, or the robot was carried"
    )
    return Cause("odometry-jumps", "odometry", message, shift_m, nan, 1.0, "odometry: steps that the robot did not go")


def _is_poor(path: Trajectory, gaps_s: FloatArray) -> bool:
    """Return whether positions within gaps are far less well known than others."""
    dim = 2 if path.pose_world_robot.shape[1] == 3 else 3
    sigma_m = np.sqrt(np.trace(path.covariance[:, :dim, :dim], axis1=1, axis2=2))
    within = np.zeros(len(path), dtype=np.bool_)
    for since_s, until_s in gaps_s.tolist():
        within |= (path.stamp_s > since_s) & (path.stamp_s < until_s)
    if not within.any() or within.all():
        return False
    return bool(np.median(sigma_m[within]) > max(LEAST_M, POORLY * float(np.median(sigma_m[~within]))))
