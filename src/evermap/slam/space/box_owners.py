"""Looks at landmarks with boxes around them: which are within the box of a thing that is followed.

What is on a thing is within its box wherever it goes; what is not is within it at one of its places at most, by chance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.config import Config
from evermap.geometry import se3
from evermap.slam.space.drift import Gauge
from evermap.slam.space.moving import follow_boxes
from evermap.tracking.frame import boxes_of, heading_of, mounts_of
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray, SpatialRecording

MARGIN = 2.0
"""Standard deviations of an edge of a box up to which a landmark is within it; beyond twice of it, it is not."""


class Sights(NamedTuple):
    """Looks (N,) at landmarks while a thing is seen that they may be on.

    Attributes:
        landmark_id: of the landmark.
        thing: what is followed.
        place: number of the place where that is, along its way.
        stamp_s: when.
        within: whether the landmark is seen on it.
    """

    landmark_id: IntArray
    thing: IntArray
    place: IntArray
    stamp_s: FloatArray
    within: BoolArray


def see_boxes(recording: SpatialRecording, config: Config) -> Sights:
    """Return looks at landmarks with boxes in the same frame, which are followed along the odometry."""
    rows, still, seen = boxes_of(recording), config.track.still, recording.detections
    named = (seen.landmark_id != UNKNOWN) & ~np.isfinite(seen.size_m).all(axis=1)
    if not named.any():
        none = np.zeros(0, dtype=np.int64)
        return Sights(none, none, none, np.zeros(0), none == 1)
    assert recording.odometry is not None
    stamp_s = recording.frames.stamp_s
    driven = se3.interpolate(recording.odometry.stamp_s, recording.odometry.pose_world_robot, stamp_s)
    followed = follow_boxes(recording, driven, Gauge.before(config.slam.space), config.track)
    track = np.full(len(rows), UNKNOWN) if followed is None else followed.track_of_detection
    rows, track = rows[track != UNKNOWN], track[track != UNKNOWN]
    known = np.flatnonzero(named & np.isfinite(seen.position_sensor_m).all(axis=1))
    eye = se3.compose(driven[seen.frame], mounts_of(recording))
    at = se3.transform(eye, seen.position_sensor_m)
    turn = np.hstack([np.zeros((len(rows), 3)), seen.rotation[rows]])
    turn[:, 3:] = np.where(np.isfinite(turn[:, 3:]), turn[:, 3:], se3.NO_TURN)
    heading = heading_of(se3.compose(eye[rows], turn))
    thing, place = _divide(
        track, stamp_s[seen.frame[rows]], at[rows], seen.size_m[rows], config.slam.space.bodies.lost_s, still.same_m
    )
    first, last = (np.searchsorted(seen.frame[rows], seen.frame[known], side=side) for side in ("left", "right"))
    a = np.repeat(np.arange(len(known)), last - first)
    b = np.arange(len(a)) - np.repeat(np.cumsum(last - first) - (last - first), last - first) + first[a]
    beyond_m, away_m = _measure_off(at[known[a]], at[rows[b]], heading[b], seen.size_m[rows[b]])
    range_m = np.linalg.norm(seen.position_sensor_m[rows[b]], axis=1)
    margin_m = MARGIN * (still.sigma_m + still.sigma_share * range_m)
    nearest = np.full(len(known), np.inf)
    np.minimum.at(nearest, a[beyond_m < margin_m], away_m[beyond_m < margin_m])
    within = (beyond_m < margin_m) & (away_m == nearest[a])
    says = within | (beyond_m > 2.0 * margin_m)
    a, b, within = a[says], b[says], within[says]
    return Sights(seen.landmark_id[known[a]], thing[b], place[b], stamp_s[seen.frame[known[a]]], within)


def _measure_off(
    at: FloatArray, middle: FloatArray, heading: FloatArray, size_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return by how much points (N, 3) are outside of boxes (N,), negative within; and how far from their middles."""
    off, cos, sin = at - middle, np.cos(heading), np.sin(heading)
    own = np.column_stack([cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0], off[:, 2]])
    return (np.abs(own) - 0.5 * size_m).max(axis=1, initial=-np.inf), np.linalg.norm(off, axis=1)


def _divide(
    track: IntArray, stamp_s: FloatArray, at: FloatArray, size_m: FloatArray, lost_s: float, same_m: float
) -> tuple[IntArray, IntArray]:
    """Return (N,) what is followed without a gap, and numbers of its places: a new one once it has moved by its length.

    What comes back from out of view elsewhere may be another one.
    """
    thing, place, count = np.zeros(len(track), dtype=np.int64), np.zeros(len(track), dtype=np.int64), 0
    for one in np.unique(track):
        mine = np.flatnonzero(track == one)
        away_m = np.linalg.norm(np.diff(at[mine, :2], axis=0), axis=1)
        lost = (np.diff(stamp_s[mine]) > lost_s) & (away_m > same_m)
        thing[mine] = count + np.append(0, np.cumsum(lost))
        place[mine] = count_places(at[mine, :2], float(np.median(size_m[mine, 0])))
        count = int(thing[mine[-1]]) + 1
    return thing, place


def count_places(at: FloatArray, apart_m: float) -> IntArray:
    """Return (N,) numbers of places along a way (N, D): a new one once it is so far from where the last began."""
    found, here, number = np.zeros(len(at), dtype=np.int64), at[0], 0
    for row, place in enumerate(at):
        if np.linalg.norm(place - here) > apart_m:
            here, number = place, number + 1
        found[row] = number
    return found
