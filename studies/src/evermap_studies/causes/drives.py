"""Drives: what a robot did, what it read, and what is stated of its sensors; as evermap is given them.

A `Drive` keeps readings as a sensor makes them (pixels, ranges, poses) apart from what is stated about the sensor
(mount, lens, size of tags, baseline), so that a wrong statement is a change of the statement alone, and the same
readings with the right one are what an oracle solves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np

from evermap.geometry import se2, se3
from evermap.geometry.camera import project, unproject
from evermap.io.spatial import directions, integrated, spatial_detections, with_tag_poses
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    Clock,
    Detections,
    FloatArray,
    Frames,
    IntArray,
    Landmarks,
    Odometry,
    Recording,
    Sensor,
    SensorKind,
    SpatialOdometry,
    SpatialSensor,
    Trajectory,
)
from evermap_studies.causes.sites import SITES, Site

MAP_SIGMA_M = 0.01
"""Standard deviation of a survey; that of `--prior-map` unless another is given."""
OPTICAL = se3.turn([-0.5, 0.5, -0.5, 0.5])
"""Axes of a camera (x right, y down, z ahead) in those of a robot (x ahead, y left, z up)."""
NEXT = 1000
"""Added to the identity of a landmark, in what the oracle is given, each time that it moves while the robot drives."""


class Reading(StrEnum):
    """What a sensor reads of a landmark."""

    RANGE_BEARING = "range and bearing"
    RANGE = "range"
    CORNERS = "corners of tags"
    POSES = "poses of tags"
    PIXELS = "pixels"
    STEREO = "stereo"


PLANAR = (Reading.RANGE_BEARING, Reading.RANGE)


@dataclass(frozen=True, slots=True)
class Event:
    """A landmark that moves: row of the site, instant (-inf: before the session), where it is then, None for gone."""

    row: int
    at_s: float
    pose: FloatArray | None


@dataclass(frozen=True, slots=True)
class Make:
    """How a robot is made and driven.

    Attributes:
        site, reading: where it drives, what it reads.
        range_max_m, half_view_rad: what it sees.
        noise: of a reading: range [m] and bearing [rad]; of poses along and across as shares of the range, and [rad];
            of pixels [px].
        odometry_sigma: (forward, lateral, turn) white noise of velocities [m/s, m/s, rad/s]; None without odometry.
        usual_scale: standard deviation of the scale of the odometer that every robot has.
        speed_mps, duration_s, odometry_hz, frame_hz: of the drive.
        sideways: the robot turns as it likes, whichever way it drives.
        carried: it rises, rolls and pitches, and its odometry is visual.
        named: landmarks have identities.
        distortion: of the cameras, radial and tangential.
    """

    site: str
    reading: Reading
    range_max_m: float
    half_view_rad: float = math.pi
    noise: tuple[float, ...] = ()
    odometry_sigma: tuple[float, float, float] | None = (0.03, 0.004, 0.02)
    usual_scale: float = 0.005
    speed_mps: float = 1.2
    duration_s: float = 57.0
    odometry_hz: float = 20.0
    frame_hz: float = 5.0
    sideways: bool = False
    carried: bool = False
    named: bool = True
    distortion: tuple[float, ...] = ()


MAKES = {
    "laser": Make("warehouse", Reading.RANGE_BEARING, 10.0, 2.2, (0.02, 0.005), duration_s=80.0),
    "uwb": Make("anchors", Reading.RANGE, 40.0, noise=(0.1,), speed_mps=0.8, duration_s=150.0, frame_hz=2.0),
    "orchard": Make(
        "orchard", Reading.RANGE_BEARING, 6.0, 1.22, (0.03, 0.01), speed_mps=0.8, duration_s=100.0, frame_hz=2.0,
        odometry_sigma=(0.03, 0.0, 0.005), usual_scale=0.02, named=False,
    ),
    "poses": Make(
        "field", Reading.POSES, 6.0, 0.6, (0.011, 0.005, 0.03), (0.03, 0.03, 0.03), speed_mps=1.5, sideways=True
    ),
    "corners": Make("field", Reading.CORNERS, 6.0, 0.6, (0.3,), (0.03, 0.03, 0.03), speed_mps=1.5, sideways=True,
                    distortion=(-0.24, 0.06, 0.0004, -0.0003)),
    "two kinds": Make("two kinds", Reading.CORNERS, 6.0, 0.6, (0.3,), (0.03, 0.03, 0.03), speed_mps=1.5, sideways=True),
    "visual": Make(
        "field", Reading.CORNERS, 6.0, 0.6, (0.3,), (0.02, 0.02, 0.01), speed_mps=1.2, frame_hz=10.0, carried=True
    ),
    "carried": Make(
        "tagged room", Reading.CORNERS, 7.0, 0.6, (0.3,), None, speed_mps=0.5, frame_hz=10.0, carried=True
    ),
    "stereo": Make("lounge", Reading.STEREO, 8.0, 0.5, (0.4,), (0.02, 0.02, 0.01), speed_mps=0.5, carried=True),
    "beacons": Make("field", Reading.PIXELS, 7.0, 0.6, (0.5,), (0.03, 0.03, 0.01), speed_mps=1.5, sideways=True),
}  # fmt: skip
"""Robots by name."""
BASELINE_M = 0.12
INTRINSICS, RESOLUTION_PX = (900.0, 900.0, 640.0, 400.0), (1280, 800)
WIDE = (700.0, 760.0, 652.0, 391.0)
"""Intrinsics of the camera of a carried rig and of a robot whose pixels are not square."""


@dataclass(frozen=True, slots=True)
class Drive:
    """What was driven and read, and what is stated.

    Attributes:
        name, reading: label, and what `value` holds.
        odometry_s: (N,) stamps; twist: (N, 6) velocities until the next one; odometry_pose: (N, 7) instead of what
            these add up to.
        frame_s: (F,) stamps of frames; frame_sensor: (F,) whose.
        frame: (M,) of every reading; landmark: (M,) identity; value: (M, K) what was read.
        sensors: as stated; tag_size_m: stated edges by identity; baseline_m: stated.
        places: the map that is given, None without.
        truth_s, truth: (T,) and (T, 7) where the robot was.
        true_places: where landmarks are, under the identities that they have in the readings.
        named: identities are given.
        kind: of the sensor, as stated.
        moved_frame: the map given is in another frame than the truth.
    """

    name: str
    reading: Reading
    odometry_s: FloatArray
    twist: FloatArray
    frame_s: FloatArray
    frame_sensor: IntArray
    frame: IntArray
    landmark: IntArray
    value: FloatArray
    sensors: tuple[SpatialSensor, ...]
    tag_size_m: Mapping[int, float]
    truth_s: FloatArray
    truth: FloatArray
    true_places: Landmarks
    places: Landmarks | None = None
    odometry_pose: FloatArray | None = None
    has_odometry: bool = True
    baseline_m: float = BASELINE_M
    named: bool = True
    kind: SensorKind | None = None
    moved_frame: bool = False
    site: Site | None = field(default=None, repr=False)

    @property
    def is_planar(self) -> bool:
        """Whether the recording is one in the plane."""
        return self.reading in PLANAR

    @property
    def stamp_s(self) -> FloatArray:
        """(M,) of every reading."""
        return self.frame_s[self.frame]

    def kept(self, rows: Any) -> Drive:
        """Return some of the readings."""
        return replace(self, frame=self.frame[rows], landmark=self.landmark[rows], value=self.value[rows])

    def stated(self, **changes: Any) -> Drive:
        """Return the same with every sensor stated otherwise."""
        return replace(self, sensors=tuple(replace(one, **changes) for one in self.sensors))


def simulate(make: Make, seed: int, events: Sequence[Event] = (), *, in_map: bool) -> Drive:
    """Return a drive in which everything is as stated, and landmarks that move get new identities.

    Args:
        make: the robot.
        seed: of layout, way and noise, each its own stream.
        events: which landmarks move.
        in_map: give the map of what is there, with new identities.
    """
    of_site, of_way, of_wheels, of_readings, of_map = np.random.default_rng([seed, 48]).spawn(5)
    site = SITES[make.site](of_site)
    step_s = 1.0 / make.odometry_hz
    stamp_s = np.arange(0.0, make.duration_s, step_s)
    truth = _way(make, site, stamp_s, of_way)
    twist = np.zeros((len(stamp_s), 6))
    twist[:-1] = se3.log(se3.between(truth[:-1], truth[1:])) / step_s
    sensors = _sensors(make)
    every = round(make.odometry_hz / make.frame_hz)
    at = [np.arange(number * (every // max(len(sensors), 1)), len(stamp_s), every) for number in range(len(sensors))]
    tick, of_sensor = np.concatenate(at), np.repeat(np.arange(len(sensors)), [len(one) for one in at])
    order = np.lexsort((of_sensor, tick))
    tick, of_sensor = tick[order], of_sensor[order]
    frame, landmark, value = _readings(make, site, events, sensors, truth[tick], stamp_s[tick], of_sensor, of_readings)
    ids = np.unique(np.concatenate([site.landmark_id, landmark]))
    drive = Drive(
        name=make.site,
        reading=make.reading,
        odometry_s=stamp_s,
        twist=_driven(make, twist, of_wheels),
        frame_s=stamp_s[tick],
        frame_sensor=of_sensor,
        frame=frame,
        landmark=landmark,
        value=value,
        sensors=sensors,
        tag_size_m={int(one): float(site.size_m[one % NEXT - 1]) for one in ids},
        truth_s=stamp_s[::every],
        truth=truth[::every],
        true_places=_places(site, events, make.reading in PLANAR, last=False),
        has_odometry=make.odometry_sigma is not None,
        named=make.named,
        kind=SensorKind.LASER if make.reading is Reading.RANGE_BEARING else None,
        site=site,
    )
    if make.reading is Reading.RANGE:
        drive = replace(drive, kind=SensorKind.UWB)
    if not in_map:
        return drive
    surveyed = _places(site, events, drive.is_planar, last=False)
    return replace(drive, places=as_survey(surveyed, of_map))


def old_map(drive: Drive, seed: int) -> Landmarks:
    """Return the map that was surveyed before anything moved."""
    assert drive.site is not None
    rng = np.random.default_rng([seed, 48]).spawn(5)[4]
    return as_survey(_places(drive.site, (), drive.is_planar, last=True), rng)


def last_places(drive: Drive, events: Sequence[Event]) -> Landmarks:
    """Return where landmarks are in the end, under the identities that they began with."""
    assert drive.site is not None
    return _places(drive.site, events, drive.is_planar, last=True)


def as_survey(places: Landmarks, rng: np.random.Generator) -> Landmarks:
    """Return places as somebody measured them, in the frame of the truth."""
    known = replace(places, frame="prior_map")
    off_m = rng.normal(0.0, MAP_SIGMA_M / 2, (NEXT, 3))[places.landmark_id % NEXT]
    known = replace(known, position_m=known.position_m + off_m[:, : known.position_m.shape[1]])
    if known.position_m.shape[1] == 3:
        return known.as_prior(MAP_SIGMA_M)
    return replace(known, covariance_m2=np.broadcast_to(MAP_SIGMA_M**2 * np.eye(2), (len(known), 2, 2)).copy())


def _places(site: Site, events: Sequence[Event], planar: bool, *, last: bool) -> Landmarks:
    """Where landmarks are: all places that they have in the session, or the last one each under its first identity."""
    ids, poses = [], []
    for row, identity in enumerate(site.landmark_id.tolist()):
        stays = [site.pose[row]]
        mine = sorted((one for one in events if one.row == row), key=lambda one: one.at_s)
        for event in mine:
            if event.at_s == -math.inf:
                stays = []
            if event.pose is not None:
                stays.append(event.pose)
            elif last:
                stays = []
        for count, pose in enumerate(stays[-1:] if last else stays):
            ids.append(identity + NEXT * count)
            poses.append(pose)
    pose = np.array(poses)
    if planar:
        return Landmarks.at(ids, pose[:, :2], frame="truth")
    oriented = not np.isnan(site.size_m).any()
    return replace(Landmarks.in_space(ids, pose[:, :3], rotation=pose[:, 3:] if oriented else None), frame="truth")


def _way(make: Make, site: Site, stamp_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(N, 7) poses along a closed curve through the waypoints, at a speed that varies."""
    from scipy.interpolate import CubicSpline

    corner = np.concatenate([site.waypoint, site.waypoint[:1]])
    knot = np.concatenate([[0.0], np.cumsum(np.sqrt(np.linalg.norm(np.diff(corner, axis=0), axis=1)))])
    curve = CubicSpline(knot, corner, bc_type="periodic")
    fine = np.linspace(0.0, knot[-1], 4001)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve(fine), axis=0), axis=1))])
    phase, period = rng.uniform(0.0, 2 * math.pi, 4), rng.uniform([7.0, 11.0, 9.0, 5.0], [10.0, 16.0, 14.0, 8.0])
    wave = np.sin(2 * math.pi * stamp_s[:, None] / period + phase)
    speed = make.speed_mps * (1.0 + 0.35 * wave[:, 0] + 0.2 * wave[:, 1])
    along = np.concatenate([[0.0], np.cumsum(speed[:-1] * np.diff(stamp_s))])
    at = np.interp(along % length[-1], length, fine)
    place, tangent = curve(at), curve(at, 1)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    if make.sideways:
        heading = 0.5 * heading + 1.2 * wave[:, 2] + phase[3]
    pose = np.concatenate([place, np.zeros((len(place), 5))], axis=1)
    angles = np.column_stack([np.zeros((len(place), 2)), heading])
    if make.carried:
        pose[:, 2] = 1.2 + 0.15 * wave[:, 3]
        angles[:, :2] = 0.12 * wave[:, :2]
        angles[:, 2] += 0.6 * wave[:, 2]
    pose[:, 3:] = se3.from_angles(angles)[:, 3:]
    return se3.normalise_poses(pose)


def _driven(make: Make, twist: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(N, 6) velocities as the odometry tells them, with the noise and the small errors of every robot."""
    sigma = make.odometry_sigma or (0.0, 0.0, 0.0)
    noise = rng.normal(size=twist.shape) * (
        [sigma[0], sigma[1], sigma[1], sigma[2], sigma[2], sigma[2]]
        if make.carried
        else [sigma[0], sigma[1], 0.0, 0.0, 0.0, sigma[2]]
    )
    scale = np.ones(6)
    scale[:3] += make.usual_scale * rng.normal()
    scale[5] += 0.5 * make.usual_scale * rng.normal()
    return scale * twist + noise


def _sensors(make: Make) -> tuple[SpatialSensor, ...]:
    """Stated as they are: one, or two cameras that look ahead and back and a little up."""
    if make.reading in PLANAR:
        x_m = 0.15 if make.reading is Reading.RANGE_BEARING else 0.1
        mount = se3.from_plane([x_m, 0.05, 0.0])
        return (SpatialSensor("sensor", tuple(mount.tolist()), range_max_m=make.range_max_m),)
    heads = [(0.25, 0.1, 0.4, 0.15)] if make.carried else [(0.3, 0.2, 0.0, 0.2), (-0.3, -0.15, 2.9, 0.25)]
    found = []
    for name, (x_m, y_m, yaw, up) in zip(("front", "back"), heads, strict=False):
        mount = se3.compose(se3.from_angles([0.0, -up, yaw]), OPTICAL)
        mount[:3] = (x_m, y_m, 0.0 if make.carried else 0.5)
        camera: dict[str, Any] = {}
        if make.reading is not Reading.POSES:
            camera = {
                "intrinsics": WIDE if make.carried else INTRINSICS,
                "distortion": make.distortion,
                "distortion_model": "radtan" if make.distortion else "pinhole",
                "resolution_px": RESOLUTION_PX,
            }
        found.append(SpatialSensor(name, tuple(mount.tolist()), range_max_m=make.range_max_m, **camera))
    return tuple(found)


def _readings(
    make: Make,
    site: Site,
    events: Sequence[Event],
    sensors: tuple[SpatialSensor, ...],
    robot: FloatArray,
    stamp_s: FloatArray,
    of_sensor: IntArray,
    rng: np.random.Generator,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Frames (M,), identities (M,) and values (M, K) of what the sensors read from poses (F, 7) of the robot."""
    mount = np.array([one.mount_robot_sensor for one in sensors])[of_sensor]
    count, total = len(stamp_s), len(site.pose)
    pose = np.broadcast_to(site.pose, (count, total, 7)).copy()
    identity = np.broadcast_to(site.landmark_id, (count, total)).copy()
    there = np.ones((count, total), dtype=np.bool_)
    for event in sorted(events, key=lambda one: one.at_s):
        later = stamp_s >= event.at_s
        there[later, event.row] = event.pose is not None
        if event.pose is not None:
            pose[later, event.row] = event.pose
            identity[later, event.row] += NEXT if event.at_s > -math.inf else 0
    seen = se3.between(se3.compose(robot, mount)[:, None], pose)
    visible = there & (rng.random((count, total)) < 0.9) & _in_view(make, seen)
    frame, row = np.nonzero(visible)
    value = _read(make, sensors, of_sensor[frame], seen[frame, row], site.size_m[row], rng)
    good = np.isfinite(value).all(axis=1)
    return frame[good], identity[frame, row][good], value[good]


def _in_view(make: Make, seen: FloatArray) -> Any:
    """(...,) whether landmarks at poses (..., 7) in the sensor's frame are within reach and view, and face it."""
    at = seen[..., :3]
    reach = np.linalg.norm(at, axis=-1)
    near = (reach < make.range_max_m) & (reach > 0.4)
    if make.reading in PLANAR:
        return near & (np.abs(np.arctan2(at[..., 1], at[..., 0])) < make.half_view_rad)
    ahead = at[..., 2] > 0.3
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = (np.abs(at[..., 0] / at[..., 2]) < math.tan(make.half_view_rad)) & (
            np.abs(at[..., 1] / at[..., 2]) < 0.42
        )
    facing = np.ones_like(ahead)
    if make.reading in (Reading.CORNERS, Reading.POSES):
        outward = se3.rotation_of(seen)[..., :, 2]
        facing = -np.sum(outward * at, axis=-1) / np.maximum(reach, 1e-9) > 0.35
    return near & ahead & inside & facing


def _read(
    make: Make,
    sensors: tuple[SpatialSensor, ...],
    of_sensor: IntArray,
    seen: FloatArray,
    size_m: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """(M, K) values of landmarks at (M, 7) in their sensors' frames; nan where nothing is read."""
    at, count = seen[:, :3], len(seen)
    reach = np.linalg.norm(at, axis=1)
    if make.reading is Reading.RANGE:
        return np.asarray(reach + make.noise[0] * rng.normal(size=count))[:, None]
    if make.reading is Reading.RANGE_BEARING:
        bearing = np.arctan2(at[:, 1], at[:, 0]) + make.noise[1] * rng.normal(size=count)
        return np.column_stack([reach + make.noise[0] * rng.normal(size=count), se2.wrap(bearing)])
    if make.reading is Reading.POSES:
        ray = at / reach[:, None]
        along, across, turn = make.noise
        noise = across * rng.normal(size=(count, 3))
        noise += ((along * rng.normal(size=count)) - np.sum(noise * ray, axis=1))[:, None] * ray
        turned = se3.compose(seen, se3.exp(np.column_stack([np.zeros((count, 3)), turn * rng.normal(size=(count, 3))])))
        return np.column_stack([at + reach[:, None] * noise, turned[:, 3:]])
    value = np.full((count, {Reading.CORNERS: 8, Reading.PIXELS: 2, Reading.STEREO: 3}[make.reading]), np.nan)
    for number, sensor in enumerate(sensors):
        rows = np.flatnonzero(of_sensor == number)
        if make.reading is Reading.CORNERS:
            point = se3.transform(seen[rows, None], corners(size_m[rows]))
        else:
            point = at[rows, None]
        pixel: FloatArray = project(point, sensor)[0]
        if make.reading is Reading.STEREO:
            right = project(point - [BASELINE_M, 0.0, 0.0], sensor)[0][..., :1]
            pixel = np.concatenate([pixel, right], axis=-1)
        pixel = pixel + make.noise[0] * rng.normal(size=pixel.shape)
        wide, high = RESOLUTION_PX
        u_px, v_px = pixel[..., 0], pixel[..., 1]
        seen_px = np.asarray((u_px > 0) & (u_px < wide) & (v_px > 0) & (v_px < high))
        in_image = np.asarray(seen_px.all(axis=1))
        value[rows] = np.where(in_image[:, None], pixel.reshape(len(rows), -1), np.nan)
    return value


def corners(size_m: FloatArray) -> FloatArray:
    """Return (M, 4, 3) corners of tags in their own frames, of edges (M,)."""
    unit = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], dtype=np.float64)
    return 0.5 * np.asarray(size_m)[:, None, None] * unit


def as_recording(drive: Drive) -> AnyRecording:
    """Return what a reader would make of the readings with what is stated."""
    stamp_s, frame = np.unique(drive.frame_s, return_inverse=True)
    order = np.argsort(frame[drive.frame], kind="stable")
    of_frame = frame[drive.frame][order].astype(np.int64)
    landmark = drive.landmark[order] if drive.named else np.full(len(order), UNKNOWN)
    value = drive.value[order]
    if drive.is_planar:
        return _in_plane(drive, stamp_s, of_frame, landmark, value)
    sensor = drive.frame_sensor[drive.frame][order]
    columns: dict[str, Any] = {}
    if drive.reading is Reading.POSES:
        columns = {"position_sensor_m": value[:, :3], "rotation": value[:, 3:]}
    elif drive.reading is Reading.CORNERS:
        size = np.array([drive.tag_size_m.get(int(one), np.nan) for one in landmark])
        columns = {"corner_px": value.reshape(-1, 4, 2), "tag_size_m": size}
    elif drive.reading is Reading.PIXELS:
        position, covariance = directions(value, sensor, drive.sensors)
        columns = {"position_sensor_m": position, "covariance_sensor_m2": covariance}
    else:
        position, covariance = _triangulated(drive, value)
        columns = {"position_sensor_m": position, "covariance_sensor_m2": covariance}
    warnings: list[str] = []
    detections = spatial_detections(of_frame, sensor=sensor, landmark_id=landmark, **columns)
    detections = with_tag_poses(detections, drive.sensors, warnings)
    detections = detections[np.asarray(np.isfinite(detections.position_sensor_m).all(axis=1))]
    odometry = None
    if drive.has_odometry:
        odometry = replace(integrated(drive.odometry_s, drive.twist, Clock.RECORDING), z_up=True)
        if drive.odometry_pose is not None:
            unknown = np.full((len(drive.odometry_s), 6), np.nan)
            odometry = SpatialOdometry(drive.odometry_s, drive.odometry_pose, unknown, z_up=True)
    return Recording(
        name=drive.name,
        odometry=odometry,
        frames=Frames(stamp_s),
        detections=detections,
        sensors=tuple(replace(one, kind=drive.kind) for one in drive.sensors),
        truth=Trajectory(drive.truth_s, drive.truth, np.zeros((len(drive.truth), 6, 6)), frame="truth"),
        true_landmarks=drive.true_places,
        warnings=tuple(warnings),
        source="studies",
    )


def _in_plane(
    drive: Drive, stamp_s: FloatArray, frame: IntArray, landmark: IntArray, value: FloatArray
) -> AnyRecording:
    count, sensor = len(frame), drive.sensors[0]
    unknown, none = np.full(count, np.nan), np.zeros(count, dtype=np.int64)
    range_m = value[:, 0]
    bearing = value[:, 1] if drive.reading is Reading.RANGE_BEARING else unknown
    detections = Detections(frame, landmark, range_m, bearing, none + UNKNOWN, unknown, unknown, none)
    mount = np.array(sensor.mount_robot_sensor)
    yaw = 2.0 * math.atan2(mount[5], mount[6])
    pose = np.column_stack([drive.truth[:, :2], 2.0 * np.arctan2(drive.truth[:, 5], drive.truth[:, 6])])
    pose[:, 2] = se2.wrap(pose[:, 2])
    return Recording(
        name=drive.name,
        odometry=Odometry(drive.odometry_s, drive.twist[:, 0], drive.twist[:, 1], drive.twist[:, 5], is_measured=True),
        frames=Frames(stamp_s),
        detections=detections,
        sensor=Sensor(
            range_max_m=sensor.range_max_m,
            mount_robot_sensor=(float(mount[0]), float(mount[1]), float(se2.wrap(yaw))),
            kind=drive.kind,
        ),
        truth=Trajectory(drive.truth_s, pose, np.zeros((len(pose), 3, 3)), frame="truth"),
        true_landmarks=drive.true_places,
        source="studies",
    )


def _triangulated(drive: Drive, value: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (M, 3) and covariances of pixels (u, v, u_right) of a rectified pair; nan without disparity."""
    camera = drive.sensors[0]
    assert camera.intrinsics is not None
    left, right = unproject(value[:, :2], camera), unproject(value[:, [2, 1]], camera)
    x, y = left[:, 0] / left[:, 2], left[:, 1] / left[:, 2]
    apart = x - right[:, 0] / right[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(apart > 1e-9, drive.baseline_m / apart, np.nan)
    noise = 1.0 / np.array(camera.intrinsics)[[0, 1, 0]]
    slope = np.zeros((len(x), 3, 3))
    by_shift = -depth * depth / drive.baseline_m
    slope[:, 0, 0], slope[:, 0, 2] = depth + x * by_shift, -x * by_shift
    slope[:, 1, 0], slope[:, 1, 1], slope[:, 1, 2] = y * by_shift, depth, -y * by_shift
    slope[:, 2, 0], slope[:, 2, 2] = by_shift, -by_shift
    scaled = slope * noise
    return np.stack([x * depth, y * depth, depth], axis=1), scaled @ np.swapaxes(scaled, 1, 2)
