"""Bodies that carry landmarks in the plane, and move while the robot drives: what is seen of them then tells nothing.

Which landmarks are on one body is stated (`Recording.objects`). Whether it moves is asked of all of its landmarks at
once, as in space (`space.bodies`), along poses by all that is on no body. In the plane what is seen of it in motion is
left out, and that it stands elsewhere afterwards is found by the search for changes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.config import Config
from evermap.errors import DataError, NumericalError
from evermap.geometry import se2
from evermap.slam.estimate import solve
from evermap.slam.intake import find_bodies
from evermap.slam.result import poses_at
from evermap.slam.space.bodies import FEWEST, NEAR_S, STILL_M, find_moving
from evermap.types import UNKNOWN, Recording, rows_of


def without_motion(recording: Recording, config: Config) -> tuple[Recording, tuple[str, ...]]:
    """Return a recording without what was seen of stated bodies while they moved, and a remark on it.

    The same where nothing is stated of bodies, or too few landmarks are on none to tell where the robot is.

    Args:
        recording: cleaned, with known identities.
        config: settings.
    """
    seen, slam = recording.detections, config.slam
    names, of_name = np.unique(seen.landmark_id, return_inverse=True)
    body = find_bodies(names, recording.objects)[of_name]
    apart, stamp_s = body == UNKNOWN, recording.frames.stamp_s[seen.frame]
    if slam.unknown_ids is True or apart.all():
        return recording, ()
    if len(np.unique(seen.landmark_id[apart & (seen.landmark_id != UNKNOWN)])) < FEWEST:
        return recording, ()
    alone = replace(recording, detections=rows_of(seen, apart), objects=recording.objects[:0])
    try:
        solved = solve(alone, slam.model_copy(update={"method": "nohyp", "unknown_ids": False}))
    except (DataError, NumericalError):
        return recording, ()
    known_s = np.unique(stamp_s[apart & (stamp_s >= solved.start_s) & (stamp_s <= solved.end_s)])
    beside = np.searchsorted(known_s, stamp_s + NEAR_S, side="right") > np.searchsorted(known_s, stamp_s - NEAR_S)
    rows = np.flatnonzero(~apart & np.isfinite(seen.range_m) & np.isfinite(seen.bearing_rad) & beside)
    stamps, of = np.unique(stamp_s[rows], return_inverse=True)
    if not len(rows):
        return recording, ()
    pose = se2.compose(poses_at(solved, stamps)[0], np.array(recording.sensor.mount_robot_sensor))[of]
    angle, range_m = pose[:, 2] + seen.bearing_rad[rows], seen.range_m[rows]
    at_m = pose[:, :2] + range_m[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    stated = np.column_stack([seen.sigma_range_m, seen.sigma_bearing_rad])[rows]
    along_m, across_rad = solved.outcome.smoother.noise.of_detections(stated).T
    sigma_m = np.sqrt(0.5 * (along_m**2 + (across_rad * range_m) ** 2) + STILL_M**2)
    moves = np.zeros(len(seen), dtype=np.bool_)
    for one in np.unique(body[rows]):
        mine = np.flatnonzero(body[rows] == one)
        moves[rows[mine]] = find_moving(
            stamp_s[rows[mine]], at_m[mine], sigma_m[mine], seen.landmark_id[rows[mine]], slam.space.bodies,
            config.track.still,
        )  # fmt: skip
    if not moves.any():
        return recording, ()
    told = f"{moves.sum()} detections on {len(np.unique(body[moves]))} stated bodies that moved meanwhile are left out"
    return replace(recording, detections=rows_of(seen, ~moves)), (told,)
