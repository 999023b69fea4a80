"""Boxes without identity around a robot that moves: what stands still holds its poses, what moves is followed.

The tracker gives the boxes identities where the odometry has the robot; what stands by them shows the errors that
odometry and detector repeat (`gauge`); with these taken off, the tracker is asked again, until nothing changes. What
stands is then a landmark for as long as it does, and the rest is the solver's.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from evermap.config import SpaceConfig, TrackConfig
from evermap.errors import ConfigError, DataError
from evermap.geometry import se3
from evermap.slam.space.gauge import Gauge, gauge_of
from evermap.slam.space.intake import prepare_space
from evermap.slam.space.result import concluded_in_space
from evermap.slam.space.solve import solve_space
from evermap.slam.space.stays import Traffic, with_stays
from evermap.tracking.run import TrackResult, run_track
from evermap.tracking.standing import Standing, long_enough, standing
from evermap.tracking.table import DetectionTable, Poses, heading_of, in_world, with_empty_frames
from evermap.types import (
    UNKNOWN,
    FloatArray,
    Frames,
    IntArray,
    Landmarks,
    Progress,
    SlamResult,
    SpatialRecording,
    rows_of,
)

ROUNDS = 4
SETTLED = 0.2
"""Standard deviations by which the gauge changes in the last round, at most."""


def has_traffic(recording: SpatialRecording) -> bool:
    """Return whether there are boxes without identity, and odometry."""
    return recording.odometry is not None and len(recording.odometry) > 1 and len(_boxes(recording)) > 0


def run_in_traffic(
    recording: SpatialRecording,
    space: SpaceConfig,
    track: TrackConfig,
    prior_map: Landmarks | None = None,
    progress: Progress | None = None,
) -> SlamResult:
    """Estimate poses, what stands as landmarks, and the ways of what moves.

    Args:
        recording: with odometry and boxes without identities; landmarks with identities may be there, too.
        space: settings of the estimator.
        track: settings of the tracker.
        prior_map: must be None: boxes have no identities in a map.
        progress: told after every frame.

    Raises:
        ConfigError: a map is given.
        NumericalError: no finite optimum.
    """
    if prior_map is not None:
        problem = "boxes without identity cannot be found in a map"
        raise ConfigError(problem, field="prior_map", hint="leave it out: what stands becomes a map")
    recording, rows = _whole(recording)
    driven = _driven(recording)
    traffic = _settled(recording, driven, space, track)
    identity = _identity(recording, traffic.standing)
    standing_only = _standing_only(recording, driven, traffic, identity)
    intake = prepare_space(standing_only, space, fewest=0)
    result = concluded_in_space(standing_only, intake, solve_space(intake, None, progress=progress))
    followed = _followed(recording, result.trajectory.pose_world_robot, traffic.gauge, track)
    rows = rows[identity != UNKNOWN]
    return with_stays(_beside(result, driven), traffic, followed, _known(recording), rows)


def _boxes(recording: SpatialRecording) -> IntArray:
    """Rows of boxes without identity."""
    given = recording.detections
    return np.flatnonzero((given.landmark_id == UNKNOWN) & np.isfinite(given.size_m).all(axis=1))


def _known(recording: SpatialRecording) -> int:
    """Return the first id that no landmark of the recording has."""
    return int(recording.detections.landmark_id.max(initial=UNKNOWN)) + 1


def _whole(recording: SpatialRecording) -> tuple[SpatialRecording, IntArray]:
    """The frames while there is odometry, with those of which only a pose tells: nothing was seen in them; and rows of
    the detections in these.
    """
    assert recording.odometry is not None
    driven_s, given, stamps = recording.odometry.stamp_s, recording.detections, recording.frames.stamp_s
    inside = (stamps >= driven_s[0] - 1e-3) & (stamps <= driven_s[-1] + 1e-3)
    kept = inside[given.frame]
    counts = np.bincount(given.frame, minlength=len(stamps))
    stamp_s, counts = with_empty_frames(stamps[inside], counts[inside], driven_s)
    seen = replace(rows_of(given, kept), frame=np.repeat(np.arange(len(stamp_s)), counts))
    whole = replace(recording, frames=Frames(stamp_s), detections=seen)
    return whole, np.flatnonzero(kept)


def _driven(recording: SpatialRecording) -> FloatArray:
    """(F, 7) poses by the odometry."""
    assert recording.odometry is not None
    found = se3.interpolate(recording.odometry.stamp_s, recording.odometry.pose_world_robot, recording.frames.stamp_s)
    return se3.between(found[0], found)


def _settled(recording: SpatialRecording, driven: FloatArray, space: SpaceConfig, track: TrackConfig) -> Traffic:
    """Identities, what stands, and the errors that repeat themselves: in turns, until the errors are the same."""
    rows, stamps, gauge = _boxes(recording), recording.frames.stamp_s, Gauge(space.range_scale)
    mount, frame = _mounts(recording)[rows], recording.detections.frame[rows]
    seen = se3.transform(mount, recording.detections.position_sensor_m[rows])
    followed, stands = None, _stands(recording, None)
    for _ in range(ROUNDS):
        followed = _followed(recording, gauge.applied(driven), gauge, track)
        stands = _stands(recording, followed)
        if followed is None:
            break
        # nothing is known in the first round: every track may stand
        thing = stands.stay if gauge.things else long_enough(stamps[frame], followed.track_of_detection)
        on = np.flatnonzero(thing != UNKNOWN)
        found = gauge_of(driven, stamps[frame[on]], frame[on], seen[on], mount[on, :3], thing[on], space.range_scale)
        change = abs(found.scale - gauge.scale) / found.scale_sigma + abs(found.bend - gauge.bend) / found.bend_sigma
        gauge = found
        if change < SETTLED:
            break
    return Traffic(followed, stands, gauge)


def _mounts(recording: SpatialRecording) -> FloatArray:
    """(M, 7) of the sensor of each detection."""
    return np.array([sensor.mount_robot_sensor for sensor in recording.sensors])[recording.detections.sensor]


def _followed(recording: SpatialRecording, pose: FloatArray, gauge: Gauge, track: TrackConfig) -> TrackResult | None:
    """What the tracker says of the boxes, with the robot at poses (F, 7)."""
    given, rows, stamps = recording.detections, _boxes(recording), recording.frames.stamp_s
    mount = _mounts(recording)[rows]
    local = np.column_stack([gauge.range_scale * given.position_sensor_m[rows], given.rotation[rows]])
    local[:, 3:] = np.where(np.isfinite(local[:, 3:]), local[:, 3:], [0.0, 0.0, 0.0, 1.0])
    local = se3.compose(mount, local)
    names = recording.class_names or ("",)
    turn = se3.rotation_of(mount)
    covariance = turn @ given.covariance_sensor_m2[rows] @ turn.transpose(0, 2, 1)
    table = DetectionTable(
        stamp_s=stamps,
        first=np.searchsorted(given.frame[rows], np.arange(len(stamps) + 1)),
        position_m=local[:, :3].copy(),
        class_names=names,
        class_id=given.class_id[rows],
        covariance_m2=covariance if np.isfinite(covariance).any() else None,
        appearance=None,
        sensor_m=None,
        line=given.source_line[rows],
        source=recording.source,
        box=np.column_stack([given.size_m[rows], heading_of(local)]),
        score=given.score[rows] if np.isfinite(given.score[rows]).any() else None,
        warnings=(),
    )
    try:
        return run_track(in_world(table, Poses(stamps, pose, Path(recording.source))), track)
    except DataError:  # nothing was seen often enough to be an object
        return None


def _stands(recording: SpatialRecording, followed: TrackResult | None) -> Standing:
    """What of the boxes stands."""
    rows = _boxes(recording)
    stamp_s = recording.frames.stamp_s[recording.detections.frame[rows]]
    if followed is None:
        nobody = np.full(len(rows), UNKNOWN)
        return standing(stamp_s, np.zeros((len(rows), 3)), np.ones(len(rows)), nobody, np.ones(len(rows)))
    limit = followed.speeds_mps()[recording.detections.class_id[rows]]
    range_m = np.linalg.norm(recording.detections.position_sensor_m[rows], axis=1)
    return standing(stamp_s, followed.table.position_m, range_m, followed.track_of_detection, limit)


def _identity(recording: SpatialRecording, stands: Standing) -> IntArray:
    """(M,) identities of the solver: of boxes their stay, where they stand."""
    identity = recording.detections.landmark_id.copy()
    identity[_boxes(recording)] = np.where(stands.stay == UNKNOWN, UNKNOWN, _known(recording) + stands.stay)
    return identity


def _standing_only(
    recording: SpatialRecording, driven: FloatArray, traffic: Traffic, identity: IntArray
) -> SpatialRecording:
    """The recording as the solver takes it: with what has an identity (M,), and without repeated errors."""
    assert recording.odometry is not None
    rows, given = _boxes(recording), recording.detections
    rotation, position = given.rotation.copy(), given.position_sensor_m.copy()
    rotation[rows] = np.nan  # the heading of a box is no better than a few degrees, and the wrong way now and then
    position[rows] *= traffic.gauge.range_scale
    told = replace(given, landmark_id=identity, rotation=rotation, position_sensor_m=position)
    path = replace(
        recording.odometry,
        stamp_s=recording.frames.stamp_s,
        pose_world_robot=traffic.gauge.applied(driven),
        variance=np.full((len(driven), 6), np.nan),
    )
    return replace(recording, odometry=path, detections=rows_of(told, identity != UNKNOWN), warnings=())


def _beside(result: SlamResult, driven: FloatArray) -> SlamResult:
    """The result beside the odometry as it was given."""
    alone = replace(result.dead_reckoning, pose_world_robot=se3.compose(result.trajectory.pose_world_robot[0], driven))
    return replace(result, dead_reckoning=alone)
