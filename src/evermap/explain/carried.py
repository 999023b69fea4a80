"""Landmarks that are carried about while one drives: a tag on a cart, on another robot, in the hands of a person.

One that moved once is at two places, and so is an identity that two landmarks carry. What is carried about is at many,
from one look to the next hardly elsewhere. Its sightings say nothing of where the robot is: they bend the poses, or a
map has it moved to where it happened to be last. Where a map has it is one of its places, if it moves while it is in
view: else it may have moved before the drive, and once within it. Wrong identities are elsewhere for a look, and a
landmark of another size than stated is at one place once it is as far as its size says.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from evermap.explain.expectations import compare_detections, find_instants, find_poses_at, locate_detections
from evermap.geometry import se2, se3
from evermap.types import UNKNOWN, AnyRecording, BoolArray, Cause, FloatArray, IntArray, Landmarks, SlamResult

CARRIED = "carried-about"
"""Code of the cause."""
APART_M, SCATTERS = 0.3, 5.0
"""Radius of a place, at least [m], and over what detections are usually off by at such a range."""
FEWEST, MOST = 12, 400
"""Sightings of a landmark from which it is asked, and that are compared, at most."""
AT_TWO, ELSEWHERE = 0.85, 5
"""Share of the sightings at the two places with most of them, at most, and how many are elsewhere, at least."""
NEXT_S, JOINED = 1.0, 0.8
"""Time between sightings that follow each other, and the share of those elsewhere that must be near such a one."""
IN_ROW = 3
"""Sightings in a row at one place, and then at another, between which a landmark has moved in view."""
WALKING_MPS = 1.0
"""How fast things are carried: from one look to the next they come so far."""
SURELY = 3.0
"""Standard deviations of the positions of poses within which a landmark is at one place."""
SHARE = 0.2
"""Share of the landmarks that may be carried about: where more seem to be, the poses are wrong."""
SIZES = np.exp(np.arange(-0.7, 0.75, 0.1))
"""Sizes of a landmark over what is stated, under which it may be at one place."""


class Carried(NamedTuple):
    """A landmark that is carried about: its identity, at how many places it was seen, how far these are apart [m]."""

    landmark_id: int
    places: int
    apart_m: float


def find_carried(result: SlamResult, recording: AnyRecording, given: Landmarks | None = None) -> tuple[Carried, ...]:
    """Return landmarks on no stated body that are carried about, by where detections put them along a trajectory.

    Args:
        result: of the recording, or of one without some of its identities.
        recording: as it was read.
        given: the map that the result was found in; None without.
    """
    compared = compare_detections(recording, result) if len(result.innovations) else None
    if compared is None or np.count_nonzero(compared.used) < FEWEST:
        return ()
    usual, dim = float(np.median(compared.misfit[compared.used])), recording.dim
    variance = np.trace(result.trajectory.covariance[:, :dim, :dim], axis1=1, axis2=2)
    least_m = max(APART_M, SURELY * float(np.sqrt(np.median(variance))))
    taken_s, point_m = find_instants(recording, result), locate_detections(recording, result.parameters)
    pose, near = find_poses_at(result.trajectory, taken_s)
    group: Any = se2 if pose.shape[1] == 3 else se3
    usable = near & np.isfinite(point_m).all(axis=1) & (recording.detections.landmark_id != UNKNOWN)
    name, count = np.unique(recording.detections.landmark_id[usable], return_counts=True)
    alone = ~np.isin(name, recording.objects[:, 0])  # a stated body is asked as a whole whether it moves
    often, found = name[(count >= FEWEST) & alone], list[Carried]()
    for identity in often.tolist():
        rows = np.flatnonzero(usable & (recording.detections.landmark_id == identity))
        rows = rows[np.argsort(taken_s[rows], kind="stable")]
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MOST)).astype(np.int64))]

        def put(size: float, rows: IntArray = rows) -> tuple[FloatArray, FloatArray]:
            far = size * np.linalg.norm(point_m[rows], axis=1)
            return group.transform(pose[rows], size * point_m[rows]), np.maximum(least_m, SCATTERS * usual * far)

        at, radius_m = put(1.0)
        shares, elsewhere = _fill_places(at, radius_m)
        before_m = _find_given(result, given, identity, dim)
        if before_m is not None and _moves_in_view(at, radius_m, taken_s[rows]):
            at_first = np.linalg.norm(at - before_m, axis=1) < radius_m
            shares, elsewhere = _fill_places(at, radius_m, at_first)
        if sum(shares[:2]) > AT_TWO or np.count_nonzero(elsewhere) < ELSEWHERE:
            continue
        if np.mean(_follow(at, radius_m, taken_s[rows])[elsewhere]) < JOINED:
            continue
        if max(_fill_places(*put(size))[0][0] for size in SIZES.tolist()) > AT_TWO:
            continue
        apart_m = float(np.linalg.norm(np.ptp(at, axis=0)))
        found.append(Carried(identity, len(shares), apart_m))
    return tuple(found) if len(found) <= SHARE * len(often) else ()


def _find_given(result: SlamResult, given: Landmarks | None, identity: int, dim: int) -> FloatArray | None:
    """Return (D,) where the map that a result is in has a landmark; None where it has not."""
    if given is None or result.trajectory.frame != "prior_map":
        return None
    rows = np.flatnonzero(given.landmark_id == identity)
    return given.position_m[rows[0], :dim] if len(rows) else None


def _fill_places(
    at: FloatArray, radius_m: FloatArray, at_first: BoolArray | None = None
) -> tuple[list[float], BoolArray]:
    """Return shares of sightings (N, D) at places of radii (N,), the fullest first, each without those before it; and
    which are at neither of the first two. Before them all is the place of `at_first` (N,), if there is one.
    """
    near = np.linalg.norm(at[:, None] - at, axis=2) < radius_m[:, None]
    left, shares = np.ones(len(at), dtype=np.bool_), list[float]()
    if at_first is not None:
        left = ~at_first
        shares.append(float(np.mean(at_first)))
    elsewhere = left
    while left.any():
        count = (near & left).sum(axis=1)
        fullest = int(np.argmax(count))
        shares.append(float(count[fullest]) / len(at))
        left = left & ~near[fullest]
        elsewhere = left if len(shares) <= 2 else elsewhere
    return shares, elsewhere


def _moves_in_view(at: FloatArray, radius_m: FloatArray, taken_s: FloatArray) -> bool:
    """Return whether sightings (N, D), in order of time, are at one place in a row, and then, within a moment, in a row
    at another.
    """
    for row in np.flatnonzero(np.diff(taken_s[IN_ROW - 1 : len(at) - IN_ROW + 1]) <= NEXT_S) + IN_ROW:
        before, after = (np.median(some, axis=0) for some in (at[row - IN_ROW : row], at[row : row + IN_ROW]))
        some = slice(row - IN_ROW, row + IN_ROW)
        own = np.repeat([before, after], IN_ROW, axis=0)
        other = np.repeat([after, before], IN_ROW, axis=0)
        is_near = np.linalg.norm(at[some] - own, axis=1) < 0.5 * radius_m[some]
        if is_near.all() and (np.linalg.norm(at[some] - other, axis=1) > radius_m[some]).all():
            return True
    return False


def _follow(at: FloatArray, radius_m: FloatArray, taken_s: FloatArray) -> BoolArray:
    """Return which sightings (N, D), in order of time, are near the one before or the one after, within a moment."""
    passed_s = np.diff(taken_s)
    within_m = np.maximum(0.5 * radius_m[:-1], WALKING_MPS * passed_s)
    near = (np.linalg.norm(np.diff(at, axis=0), axis=1) < within_m) & (passed_s <= NEXT_S)
    return np.asarray(np.append(near, False) | np.append(False, near))


def name_carried(carried: Carried, recording: AnyRecording) -> Cause:
    """Return that a landmark is carried about, as a cause that is put right: its detections are not used."""
    name = str(recording.landmark_names.get(carried.landmark_id, carried.landmark_id))
    message = (
        f"landmark {name} is carried about: it was seen at {carried.places} places, up to {carried.apart_m:.3g} m "
        "apart; its detections are not used"
    )
    return Cause(
        CARRIED, name, message, carried.apart_m, math.nan, 1.0, "detections.csv: none of what moves about, on its own"
    )
