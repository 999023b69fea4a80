"""Whether a recording of poses and detections in space is one of a robot on a floor, and the same in the plane.

**It can be in the plane** if the odometry moves at one height without roll and pitch, and landmarks keep their heights
above the floor, seen through the mounts: those of a sensor whose mount is wrong do not, nor do those of a robot whose
odometry leaves ramps out. A mount that is tilted a little is seen by heights that go with the distance.

**It is in the plane** if in addition detections are positions, with or without orientations: the calibration of wheels
that only the plane has is worth more than what orientations say (twice as exact where wheels have usual errors). Tags
by their corners, whose orientations are exact, stay in space, and so do recordings that state bodies, which may move
there, and boxes and directions, for which the plane has no room. In a map in the plane all that can be is, in a map in
space nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.config import CheckConfig, SlamConfig
from evermap.errors import ConfigError
from evermap.estimate.measurements import find_kinds
from evermap.estimate.robust import MEDIAN_TO_SIGMA
from evermap.geometry import se2, se3
from evermap.slam.clocks import are_of_several_clocks
from evermap.slam.mistake_search import unusable
from evermap.slam.orientations import find_convention, without_unmeasured
from evermap.slam.pairs import sighting_pairs
from evermap.slam.riders import find_riders, without_riders
from evermap.slam.space.intake import positions_of, without_range
from evermap.types import (
    AnyRecording,
    Detections,
    FloatArray,
    Landmarks,
    Odometry,
    Recording,
    Sensor,
    SpatialOdometry,
    SpatialRecording,
    Trajectory,
    is_in_space,
    rows_of,
)
from evermap.valid import check_type

LEVEL_M = 0.02
"""Difference in height of the odometry of a robot on a floor."""
LEVEL_RAD = 0.01
"""Roll and pitch of the odometry of a robot on a floor."""
HEIGHT_SHARE = 0.1
"""Difference between two heights of one landmark, as a share of its range, that a mount or a ramp must explain."""
MOST_OF_HEIGHTS, NOISE_OF_HEIGHTS = (0.05, 0.95), 4.0
"""Quantiles between which measured heights and tilts differ on a ramp, by more than so many standard deviations (of
Gaussian noise they are 3.3 apart): some may be wrong."""
TILT_RAD, TILT_SIGMAS = 0.05, 4.0
"""Tilt of a mount that landmarks show which rise or sink as they come nearer, beyond which it is another than stated,
and standard deviations that it must be known to: it is asked in space, and the plane has no room for it."""
CAUCHY = 2.385
"""Residual over its scale from which Cauchy's weights fall, for an efficiency of .95."""
ROUNDS = 5
"""Rounds of weighted least squares."""
FEWEST_LANDMARKS = 3
"""Landmarks whose heights must be known to show a floor."""
OVERHEAD = 0.1
"""Share of its range that a detection must be away along the floor: else it has no bearing."""
FIELD_MARGIN_RAD = 0.05
"""Margin of the field of view around the bearings that were read."""


def in_its_space(recording: AnyRecording, settings: SlamConfig, *, dim: int | None = None) -> AnyRecording:
    """Return a recording as it is estimated: in the plane where it is one of a robot on a floor; warnings say so.

    What moves with the robot is left out (`mistakes.find_riders`), as are orientations that were not measured
    (`orientations`). What was estimated in the plane has no heights.

    Args:
        recording: as read; one in the plane is returned as it is.
        settings: `plane` decides where it is set.
        dim: 2 or 3 of the map that it goes into; None for none.

    Raises:
        InputError: not a recording.
        ConfigError: `plane` is set, and the recording cannot be there.
    """
    check_type(recording)
    if not is_in_space(recording):
        if settings.plane is False:
            problem = f"{recording.name}: a recording in the plane cannot be estimated in space"
            raise ConfigError(problem, field="slam.plane", hint="leave it out")
        return recording
    riders = find_riders(recording, settings.check) if settings.unknown_ids is not True else np.zeros(0, dtype=int)
    stands: SpatialRecording = without_riders(recording, riders)
    recording = without_unmeasured(stands, settings.check)
    if settings.plane is False or (settings.plane is None and dim == 3):
        return recording
    obstacle = _obstacle(recording)
    if settings.plane:
        if obstacle:
            raise ConfigError(f"{recording.name}: {obstacle}", field="slam.plane", hint="leave it out, or false")
        return _in_plane(recording, "as slam.plane says")
    if obstacle or not is_on_floor(recording, settings.check):
        return recording
    if dim != 2 and (np.isfinite(recording.detections.corner_px[:, 0, 0]).any() or len(recording.objects)):
        return recording
    wrong = unusable(recording, settings.check)
    if wrong is not None and not wrong.usable:  # refused by its name there: velocities in mm/s are no velocities
        return recording
    if wrong is not None and len(recording.sensors) > 1:  # their mounts, which the plane has not, are asked in space
        return recording
    if len(recording.sensors) > 1 and are_of_several_clocks(recording, settings.check):  # the plane has one sensor
        return recording
    if find_convention(recording, settings.check):  # of orientations, which the plane leaves out in silence
        return recording
    why = "the odometry is planar and landmarks keep their heights (slam.plane = false: in space)"
    return _in_plane(recording, why)


def with_prior(
    recording: AnyRecording, prior_map: Landmarks | None, settings: SlamConfig
) -> tuple[AnyRecording, Landmarks | None, tuple[str, ...]]:
    """Return a recording and a prior map as they are estimated (`in_its_space`), and remarks on it."""
    dim = None if prior_map is None else int(prior_map.position_m.shape[1])
    found = in_its_space(recording, settings, dim=dim)
    remarks = () if found is recording else found.warnings[len(recording.warnings) :]
    if prior_map is not None and dim == 3 and not is_in_space(found) and settings.plane:
        prior_map = landmarks_in_plane(prior_map)
    return found, prior_map, remarks


def _obstacle(recording: SpatialRecording) -> str:
    """Return why a recording cannot be estimated in the plane; '' if it can."""
    seen = recording.detections
    if recording.odometry is None or len(recording.odometry) < 2:
        return "without odometry it cannot be estimated in the plane"
    if np.isfinite(seen.size_m).all(axis=1).any():
        return "boxes cannot be estimated in the plane"
    if not len(seen) or without_range(recording).any():
        return "detections without a range cannot be estimated in the plane"
    return ""


def is_on_floor(recording: SpatialRecording, settings: CheckConfig) -> bool:
    """Return whether odometry and heights of landmarks are those of a robot on a level floor."""
    odometry = recording.odometry
    if odometry is None or not is_level(odometry.pose_world_robot):
        return False
    if np.ptp(odometry.pose_world_robot, axis=0).max() < 1e-9:  # stands still, or nobody measured its motion
        return False
    if not _is_level_by_measurements(recording):
        return False
    at, range_m = _on_floor(recording), np.linalg.norm(positions_of(recording), axis=1)
    sensor = recording.detections.sensor
    first, second = sighting_pairs(recording, settings)
    if len(first) < settings.fewest or len(np.unique(recording.detections.landmark_id[first])) < FEWEST_LANDMARKS:
        return False
    apart = at[second] - at[first]
    apart /= np.maximum(range_m[first], range_m[second])[:, None]
    if not np.median(np.abs(apart[:, 2])) < HEIGHT_SHARE:
        return False
    same = sensor[first] == sensor[second]
    return not any(is_tilted(apart[same & (sensor[first] == row)]) for row in np.unique(sensor))


def is_tilted(apart: FloatArray) -> bool:
    """Return whether a mount is tilted against what is stated, by how landmarks seem to move in the robot's frame.

    Heights of landmarks stay. Seen through a mount that is tilted they rise or sink with the way to the front and to
    the side: two slopes, by weighted least squares of which outliers are let go (Cauchy).

    Args:
        apart: (K, 3) between two sightings of a landmark each, by one sensor, over the range.
    """
    if len(apart) <= 2 or np.linalg.matrix_rank(apart[:, :2]) < 2:
        return False
    along, weight = apart[:, :2], np.ones(len(apart))
    for _ in range(ROUNDS):
        information = along.T @ (weight[:, None] * along)
        tilt = np.linalg.solve(information, along.T @ (weight * apart[:, 2]))
        left = apart[:, 2] - along @ tilt
        scale = max(MEDIAN_TO_SIGMA * float(np.median(np.abs(left))), 1e-9)
        weight = 1.0 / (1.0 + (left / (CAUCHY * scale)) ** 2)
    sigma = scale * np.sqrt(np.diag(np.linalg.inv(information)))
    return bool((np.abs(tilt) > np.maximum(TILT_RAD, TILT_SIGMAS * sigma)).any())


def _is_level_by_measurements(recording: SpatialRecording) -> bool:
    """Return whether heights and tilts that were measured beside (kind `floor`) are constant, to within their noise.

    Wheels tell neither: their odometry is as level on a ramp as on a floor.
    """
    for table in recording.measurements:
        if table.kind != "floor":
            continue
        columns = find_kinds()["floor"].fill_in(table.columns, len(table))
        for name, sigma, least in (
            ("z_m", "sigma_z_m", LEVEL_M),
            *((f"up_{axis}", "sigma_tilt", LEVEL_RAD) for axis in "xy"),
        ):
            low, high = np.nanquantile(columns[name], MOST_OF_HEIGHTS)
            if high - low > least + NOISE_OF_HEIGHTS * np.nanmedian(columns[sigma]):
                return False
    return True


def is_level(pose: FloatArray) -> bool:
    """Return whether poses (N, 7) are at one height, and upright."""
    upright = se3.rotation_of(pose)[:, 2, 2]
    return bool(np.ptp(pose[:, 2]) < LEVEL_M and upright.min(initial=1.0) > np.cos(LEVEL_RAD))


def _on_floor(recording: SpatialRecording) -> FloatArray:
    """(M, 3) positions of detections in the robot's frame."""
    mount = np.array([sensor.mount_robot_sensor for sensor in recording.sensors])
    return se3.transform(mount[recording.detections.sensor], positions_of(recording))


def _in_plane(recording: SpatialRecording, why: str) -> Recording:
    """Return a recording in the plane: positions along the floor, as one sensor would read them.

    That is where the only sensor is, or the robot's centre. Its x axis is the axis of the sensor that is level and
    along which it sees most.
    """
    assert recording.odometry is not None
    seen, at = recording.detections, _on_floor(recording)
    mount = _floor_mount(recording, at)
    local = se2.transform(se2.inverse(mount), at[:, :2])
    range_m, bearing = np.hypot(*local.T), np.arctan2(local[:, 1], local[:, 0])
    kept = range_m > OVERHEAD * np.maximum(np.linalg.norm(at, axis=1), 1e-9)
    sigma = _sigma(recording, local, mount)
    detections = Detections(
        seen.frame, seen.landmark_id, range_m, bearing, seen.class_id, sigma[:, 0].copy(), sigma[:, 1].copy(),
        seen.source_line, seen.features, seen.feature_names,
    )  # fmt: skip
    warnings = [*recording.warnings, f"estimated in the plane: {why}"]
    if not kept.all():
        warnings.append(f"{int((~kept).sum())} detections above or below the sensor left out")
    truth, landmarks = recording.truth, recording.true_landmarks
    return Recording(
        name=recording.name,
        odometry=velocities_of(recording.odometry),
        frames=recording.frames,
        detections=rows_of(detections, kept),
        sensor=_floor_sensor(recording, mount, bearing[kept]),
        truth=None if truth is None else trajectory_in_plane(truth),
        true_landmarks=None if landmarks is None else landmarks_in_plane(landmarks),
        class_names=recording.class_names,
        warnings=tuple(warnings),
        source=recording.source,
        clock=recording.clock,
        landmark_names=recording.landmark_names,
        robot=recording.robot,
        measurements=recording.measurements,
    )


def _floor_mount(recording: SpatialRecording, at: FloatArray) -> FloatArray:
    """(3,) pose on the robot of the sensor in the plane that stands for all; `at` (M, 3) are all detections."""
    sensor = np.unique(recording.detections.sensor)
    if len(sensor) != 1:
        return se2.identity()
    pose = np.array(recording.sensors[int(sensor[0])].mount_robot_sensor)
    axes = se3.rotation_of(pose)[:2]  # along the floor, of x, y, z of the sensor
    ahead = np.median(at[:, :2] - pose[:2], axis=0)
    length = np.hypot(*axes)
    axis = axes[:, int(np.argmax(np.where(length > 0.5, ahead @ axes / np.maximum(length, 1e-9), -np.inf)))]
    if length[0] > 0.5 and np.hypot(*ahead) < 0.5 * np.median(np.hypot(*(at[:, :2] - pose[:2]).T)):
        axis = axes[:, 0]  # it sees all around
    return np.array([pose[0], pose[1], np.arctan2(axis[1], axis[0])])


def _sigma(recording: SpatialRecording, local: FloatArray, mount: FloatArray) -> FloatArray:
    """(M, 2) standard deviations of range and bearing by the stated covariances of positions; nan where none is."""
    turn = se3.rotation_of(np.array([sensor.mount_robot_sensor for sensor in recording.sensors]))
    turn = (se3.rotation_of(se3.inverse(se3.from_plane(mount))) @ turn)[recording.detections.sensor]
    covariance = (turn @ recording.detections.covariance_sensor_m2 @ np.swapaxes(turn, 1, 2))[:, :2, :2]
    range_m = np.maximum(np.hypot(*local.T), 1e-9)
    along = local / range_m[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    variance = [np.einsum("mi,mij,mj->m", axis, covariance, axis) for axis in (along, across)]
    sigma = np.sqrt(np.maximum(np.stack(variance, axis=1), 0.0))
    sigma[:, 1] /= range_m
    return np.where(sigma > 0.0, sigma, np.nan)


def _floor_sensor(recording: SpatialRecording, mount: FloatArray, bearing: FloatArray) -> Sensor:
    """The sensor in the plane: limits and data sheet of the one that is the least exact, field of view as read."""
    used = [recording.sensors[row] for row in np.unique(recording.detections.sensor)]
    kinds = {sensor.kind for sensor in used}
    low, high = float(bearing.min(initial=0.0)) - FIELD_MARGIN_RAD, float(bearing.max(initial=0.0)) + FIELD_MARGIN_RAD
    around = high - low > 1.5 * np.pi

    def most(name: str) -> float | None:
        said = [getattr(sensor, name) for sensor in used]
        return None if None in said else max(said)

    return Sensor(
        range_min_m=min(sensor.range_min_m for sensor in used),
        range_max_m=max(sensor.range_max_m for sensor in used),
        bearing_min_rad=-float(np.pi) if around else max(low, -float(np.pi)),
        bearing_max_rad=float(np.pi) if around else min(high, float(np.pi)),
        sigma_range_m=most("sigma_m"),
        p_detect=used[0].p_detect,
        p_false=used[0].p_false,
        mount_robot_sensor=(float(mount[0]), float(mount[1]), float(mount[2])),
        kind=kinds.pop() if len(kinds) == 1 else None,
        sigma_scale=most("sigma_scale"),
        sigma_angle_rad=most("sigma_angle_rad"),
        sigma_position_m=most("sigma_position_m"),
        sigma_odometer_scale=recording.sensors[0].sigma_odometer_scale,
        measures_positions=True,
    )


def velocities_of(odometry: SpatialOdometry) -> Odometry:
    """Return the velocities along and about the robot's axes that lead from pose to pose of a robot on a floor."""
    step_s = np.diff(odometry.stamp_s)
    pose = plane_of(odometry.pose_world_robot)
    velocity = se2.log(se2.between(pose[:-1], pose[1:])) / step_s[:, None]
    forward, lateral, angular = np.vstack([velocity, velocity[-1:]]).T
    return Odometry(
        odometry.stamp_s, forward.copy(), lateral.copy(), angular.copy(), clock=odometry.clock, is_measured=True
    )


def plane_of(pose: FloatArray) -> FloatArray:
    """Return poses (N, 3) on the floor below poses (N, 7); the heading is that of the x axis."""
    ahead = se3.rotation_of(pose)[..., :2, 0]
    return np.column_stack([pose[:, :2], np.arctan2(ahead[:, 1], ahead[:, 0])])


def trajectory_in_plane(path: Trajectory) -> Trajectory | None:
    """Return a trajectory in space on its floor; None if the robot is not upright there, as in a frame of cameras."""
    if np.median(se3.rotation_of(path.pose_world_robot)[:, 2, 2]) < np.cos(0.2):
        return None
    some = np.array([0, 1, 5])
    covariance = path.covariance[:, some[:, None], some]
    return replace(path, pose_world_robot=plane_of(path.pose_world_robot), covariance=covariance)


def landmarks_in_plane(landmarks: Landmarks) -> Landmarks:
    """Return landmarks in space without heights, orientations and sizes."""
    return replace(
        landmarks,
        position_m=np.ascontiguousarray(landmarks.position_m[:, :2]),
        covariance_m2=np.ascontiguousarray(landmarks.covariance_m2[:, :2, :2]),
        rotation=None,
        rotation_covariance=None,
        size_m=None,
    )
