"""Causes as values: what each undoes of a recording and of a given map, what it costs, and the words for it.

A cause is undone on trial by a pure transformation of the inputs; the solution of what comes out is compared with that
of the inputs as given (`competition`). A *continuous* cause has a state of one number, 0 where all is as stated, with a
Gaussian prior; a *discrete* one has none. Mistakes that show in pairs of sightings alone (`slam.mistakes`) are causes,
too: the same values serve `check` and the competition.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from evermap.geometry import se2, se3
from evermap.geometry.group import accumulate
from evermap.geometry.square import CORNERS as SQUARE
from evermap.geometry.square import with_square_poses
from evermap.geometry.symmetry import Symmetry
from evermap.slam import mistakes
from evermap.slam.check import CLOCKWISE, CORNERS, SIGHTED, find_corner_mistake, is_clockwise, read_corners
from evermap.slam.orientations import MIRRORED, MIRRORED_TURNS, find_convention
from evermap.slam.space.intake import without_range
from evermap.types import (
    ANY_BEARING_RAD,
    UNKNOWN,
    AnyRecording,
    BoolArray,
    FloatArray,
    Landmarks,
    Recording,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    is_in_space,
)

USUAL_P, RARE_P, UNIT_P = 1e-3, 1e-4, 1e-3
"""Probabilities beforehand of a cause that is met every day in bug reports, of one that is not, and of a unit."""
SCALE, ONE_TAG, TURN, MAP_SCALE = 0.15, 0.3, 0.15, 0.1
"""Standard deviations of logarithms: of all ranges or speeds, of the size of one tag, of turns, of a map."""
CENTRE_PX, COEFFICIENT = 30.0, 0.05
"""Standard deviations of the centre of an image, and of a coefficient of distortion that is stated."""
RESOLUTIONS = 0.5, 2.0, 2.0 / 3.0, 1.5
"""Sizes of images, over those that a camera was calibrated for, that are met: binned by two, or 720 rows for 1080."""
SIDEWAYS = 0.1
"""Way to the side over that ahead from which a robot drives sideways: less is the noise of its odometry."""
WITH_BEARINGS = 0.5
"""Share of the detections without a bearing from which ranges alone must say what is wrong."""
DELAY_S, MOUNT_M, MOUNT_RAD, FOCAL, DISTORTION = 0.5, 0.2, 0.3, 0.1, 0.2
"""Standard deviations of a delay, of a mount's position and turn, of the logarithm of a focal length, and of k1."""
CLOCK_RATE = 0.005
"""Standard deviation of how much faster one clock runs than another, where they do at all; a tenth of it is as fast as
a clock is slewed that is set by another over a network. Crystals differ by less."""
LITTLE = 0.1
"""Standard deviations beforehand within which a state is as is usual of sensors: 2 cm of a mount, 50 ms of a clock."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """What a session is solved from.

    Attributes:
        recording: with identities, as it is estimated.
        prior_map: that was given; None without.
        stretched: (M,) logarithm of the volume by which each detection's numbers were stretched since they were read.
        stretched_place: the same of a place of the map.
        left_out: places of a map that was left out, of landmarks that were seen.
    """

    recording: AnyRecording
    prior_map: Landmarks | None
    stretched: FloatArray
    stretched_place: float
    left_out: int = 0

    @classmethod
    def of(cls, recording: AnyRecording, prior_map: Landmarks | None) -> Inputs:
        """Return the inputs as given."""
        return cls(recording, prior_map, np.zeros(len(recording.detections)), 0.0)

    @property
    def n_common(self) -> int:
        """Return the number of landmarks of the map whose identities were seen."""
        given = self.prior_map
        return 0 if given is None else int(np.isin(given.landmark_id, self.recording.detections.landmark_id).sum())


Undo = Callable[[Inputs, float], Inputs]


@dataclass(frozen=True, slots=True)
class Suspect:
    """A cause that may be: what it undoes, what it costs, and its words.

    Attributes:
        code: stable name of the kind of cause.
        subject: what it is of: a sensor, a class, an identity, 'odometry', 'map'.
        p: probability beforehand.
        undo: inputs, and the state, to the inputs without it.
        say: the state to one line for the user.
        fix: the state to the line of `sensor.toml`, or the option, that mends it.
        sigma: standard deviation of the state beforehand; 0 of a discrete cause.
        shown: the state as a user reads it: a ratio, seconds, metres, radians.
        of_map: whether it is of the given map.
        pairs: whether it shows in pairs of sightings of one landmark and the odometry between them.
        rows: which detections it is of: those of an 'id', a 'class' or a 'size', or by a 'sensor'; None of all.
        shows: whether the readings alone say so, or nothing else than a solution can.
    """

    code: str
    subject: str
    p: float
    undo: Undo
    say: Callable[[float], str]
    fix: Callable[[float], str]
    sigma: float = 0.0
    shown: Callable[[float], float] = float
    of_map: bool = False
    pairs: bool = True
    rows: tuple[str, float] | None = None
    shows: bool = False

    @property
    def is_continuous(self) -> bool:
        """Return whether it has a state."""
        return self.sigma > 0.0

    @property
    def is_of_landmark(self) -> bool:
        """Whether it is of a single landmark."""
        return self.rows is not None and self.rows[0] == "id"

    @property
    def log_p(self) -> float:
        """Return its price [nats], negative."""
        return math.log(self.p)


def list_suspects(inputs: Inputs, *, calibrations: bool = False) -> tuple[Suspect, ...]:
    """Return all causes that may be asked of a recording, and of the map that is given with it.

    Args:
        inputs: the recording and the map.
        calibrations: only those with a state that is one for the sensor, the odometry or the map as a whole. Of the
            others there is one for each landmark, and some are first sought in the readings.
    """
    recording, found = inputs.recording, list[Suspect]()
    if is_in_space(recording):
        has_metre = bool(recording.odometry is not None or inputs.prior_map is not None or recording.measurements)
        has_metre = has_metre and not without_range(recording).all()
        found += _in_space(recording, calibrations=calibrations, has_metre=has_metre)
    else:
        found += _in_plane(recording, calibrations=calibrations)
    if inputs.prior_map is not None:
        found += _of_map(inputs.prior_map, recording)
    return tuple(one for one in found if not calibrations or (one.is_continuous and not one.is_of_landmark))


def _constant(text: str) -> Callable[[float], str]:
    return lambda _: text


def _times(state: float) -> float:
    return math.exp(state)


# ---- in the plane and in space


def _odometry_scale() -> Suspect:
    return Suspect(
        "odometry-scale", "odometry", USUAL_P, _stretch_speeds,
        lambda s: f"the robot drives {math.exp(s):.4g} times what its odometry says: wheel radius",
        lambda s: f"[odometry] sigma_odometer_scale = {_round_up(abs(s))}", SCALE, _times,
    )  # fmt: skip


def _turn_scale() -> Suspect:
    return Suspect(
        "turn-scale", "odometry", USUAL_P, _stretch_turns,
        lambda s: f"the robot turns {math.exp(s):.4g} times what its odometry says: wheel base, or gyroscope",
        _constant("odometry.csv: angular_radps"), TURN, _times,
    )  # fmt: skip


def _late_stamps(subject: str) -> Suspect:
    return Suspect(
        "clock", subject, USUAL_P, _shift_stamps,
        lambda s: f"stamps of the detections are {abs(s):.3g} s {'late' if s > 0 else 'early'}",
        lambda s: f"detections.csv, frames.csv: stamp_s {'-' if s > 0 else '+'} {abs(s):.3g}", DELAY_S,
    )  # fmt: skip


# ---- in the plane


def _in_plane(recording: Recording, *, calibrations: bool) -> Iterable[Suspect]:
    names = recording.landmark_names
    yield Suspect(
        "range-scale", "sensor", USUAL_P, partial(_stretch_ranges, of=None),
        lambda s: f"true distances are {math.exp(s):.4g} times the ranges: another scale, or another size of tags",
        lambda s: f"[sensor] sigma_scale = {_round_up(abs(s))}", SCALE, _times,
    )  # fmt: skip
    yield _odometry_scale()
    yield _turn_scale()
    yield _late_stamps("sensor")
    for axis, key in enumerate(("x_m", "y_m", "theta_rad")):
        unit, sigma = ("rad", MOUNT_RAD) if axis == 2 else ("m", MOUNT_M)
        yield Suspect(
            "mount", f"sensor {key}", USUAL_P, partial(_move_planar_mount, axis=axis),
            lambda s, key=key, unit=unit: f"the sensor's mount is {s:.3g} {unit} off in {key}",  # type: ignore[misc]
            lambda s, key=key, axis=axis: f"[mount] {key} = {recording.sensor.mount_robot_sensor[axis] + s:.4g}",  # type: ignore[misc]
            sigma,
        )  # fmt: skip
    bearings = np.mean(recording.detections.sigma_bearing_rad == ANY_BEARING_RAD) < WITH_BEARINGS
    for mistake in (*mistakes.UNITS, *(mistakes.ANGLES if bearings else ())):
        yield Suspect(
            mistake.code, mistake.field, UNIT_P if mistake.code == "length-unit" else USUAL_P,
            partial(_undo_in_plane, mistake=mistake), _constant(mistake.message), _constant(_fix_of(mistake)),
        )  # fmt: skip
    for mistake in (MIRRORED,) if bearings else (*mistakes.RANGED, MIRRORED_TURNS):
        yield Suspect(
            mistake.code, mistake.field, USUAL_P, partial(_undo_in_plane, mistake=mistake), _constant(mistake.message),
            _constant(_fix_of(mistake)), pairs=False, shows=not bearings,
        )  # fmt: skip
    for identity in () if calibrations else _seen_often(recording):
        yield _one_size(names.get(identity, str(identity)), _stretch_ranges, ("id", identity), "")
    for row, name in enumerate(recording.class_names):
        yield _kind_size(f"class {name}", _stretch_ranges, ("class", row), "")


def _one_size(subject: str, stretch: Callable[..., Inputs], of: tuple[str, float], key: str) -> Suspect:
    return Suspect(
        "tag-size", subject, RARE_P, partial(stretch, of=of),
        lambda s: f"landmark {subject} is {math.exp(s):.4g} times as large, or as far, as the sensor takes it to be",
        lambda s: f"[tags.sizes] {subject} = {float(key) * math.exp(s):.4g}" if key else "the size of this tag",
        ONE_TAG, _times, rows=of,
    )  # fmt: skip


def _kind_size(subject: str, stretch: Callable[..., Inputs], of: tuple[str, float], key: str) -> Suspect:
    return Suspect(
        "tag-size", subject, USUAL_P, partial(stretch, of=of),
        lambda s: f"landmarks of {subject} are {math.exp(s):.4g} times as large as the sensor takes them to be",
        lambda s: f"[tags] size_m = {float(key) * math.exp(s):.4g}" if key else "the size of these tags",
        ONE_TAG, _times, rows=of,
    )  # fmt: skip


def _round_up(share: float) -> str:
    """Return a standard deviation that covers an error, in one figure."""
    if share <= 0.0:
        return "0.001"
    unit = 10.0 ** math.floor(math.log10(share))
    return f"{math.ceil(share / unit) * unit:.1g}"


def _fix_of(mistake: mistakes.Mistake) -> str:
    table = "odometry.csv" if mistake.field.endswith("ps") or mistake.field == "odometry" else "detections.csv"
    return f"{table}: {mistake.field}" if mistake.field else "[mount]"


def _seen_often(recording: AnyRecording) -> list[int]:
    ids = recording.detections.landmark_id
    name, count = np.unique(ids[ids != UNKNOWN], return_counts=True)
    return [int(one) for one in name[count >= mistakes.USUAL.fewest // 4]]


def rows_of_kind(recording: AnyRecording, of: tuple[str, float] | None) -> Any:
    """Return (M,) detections of an identity, of a class, by a sensor, or of tags of a size; all for None."""
    seen = recording.detections
    if of is None:
        return np.ones(len(seen), dtype=np.bool_)
    kind, which = of
    if kind == "id":
        return seen.landmark_id == which
    if kind == "class":
        return seen.class_id == which
    if kind == "sensor":
        return seen.sensor == which  # type: ignore[union-attr]
    return np.isclose(seen.tag_size_m, which)  # type: ignore[union-attr]


def _stretch_ranges(inputs: Inputs, state: float, of: tuple[str, float] | None) -> Inputs:
    recording: Any = inputs.recording
    mine = rows_of_kind(recording, of)
    seen, factor = recording.detections, np.where(mine, math.exp(state), 1.0)
    further = replace(seen, range_m=seen.range_m * factor, sigma_range_m=seen.sigma_range_m * factor)
    return replace(
        inputs,
        recording=replace(recording, detections=further),
        stretched=inputs.stretched + state * mine,
    )


def _stretch_speeds(inputs: Inputs, state: float) -> Inputs:
    recording, factor = inputs.recording, math.exp(state)
    if is_in_space(recording):
        driven = recording.odometry
        assert driven is not None
        odometry: Any = replace(driven, pose_world_robot=se3.scaled(driven.pose_world_robot, factor))
    else:
        driven_flat = recording.odometry
        odometry = replace(
            driven_flat, forward_mps=driven_flat.forward_mps * factor, lateral_mps=driven_flat.lateral_mps * factor
        )
    return replace(inputs, recording=replace(recording, odometry=odometry))


def _stretch_turns(inputs: Inputs, state: float) -> Inputs:
    return _with_turns(inputs, lambda turn, _: turn * math.exp(state))


def turn_less(inputs: Inputs, state: float) -> Inputs:
    """Return the same with turns of the odometry less by a rate [rad/s] all the time, about z of the robot."""
    return _with_turns(inputs, lambda turn, lasted_s: turn - state * lasted_s * np.eye(turn.shape[1])[-1])


def _with_turns(inputs: Inputs, how: Callable[[FloatArray, FloatArray], FloatArray]) -> Inputs:
    """Return the same with other turns of the odometry; `how` has (N, 1 or 3) turns and (N, 1) how long each lasted."""
    recording = inputs.recording
    if not is_in_space(recording):
        driven = recording.odometry
        rate = how(driven.angular_radps[:, None], np.ones((len(driven), 1)))[:, 0]
        return replace(inputs, recording=replace(recording, odometry=replace(driven, angular_radps=rate)))
    path = recording.odometry
    assert path is not None
    step = se3.log(se3.between(path.pose_world_robot[:-1], path.pose_world_robot[1:]))
    step[:, 3:] = how(step[:, 3:], np.diff(path.stamp_s)[:, None])
    return _with_poses(inputs, np.asarray(se3.compose(path.pose_world_robot[:1], accumulate(se3.exp(step)))))


def _shift_stamps(inputs: Inputs, state: float) -> Inputs:
    """Return the same with the frames earlier by the delay of their stamps."""
    recording: Any = inputs.recording
    frames = replace(recording.frames, stamp_s=recording.frames.stamp_s - state)
    return replace(inputs, recording=replace(recording, frames=frames))


def _move_planar_mount(inputs: Inputs, state: float, axis: int) -> Inputs:
    recording: Any = inputs.recording
    mount = list(recording.sensor.mount_robot_sensor)
    mount[axis] += state
    sensor = replace(recording.sensor, mount_robot_sensor=tuple(mount))
    return replace(inputs, recording=replace(recording, sensor=sensor))


def _undo_in_plane(inputs: Inputs, _: float, mistake: mistakes.Mistake) -> Inputs:
    """Return the same without a mistake of the readings."""
    recording: Any = inputs.recording
    if mistake.lengths != 1.0:
        state = math.log(mistake.lengths)
        if mistake.field == "forward_mps":
            return _stretch_speeds(inputs, -state)
        return _stretch_ranges(inputs, state, None)
    seen, driven = recording.detections, recording.odometry
    bearing = se2.wrap(mistake.bearing * seen.bearing_rad + mistake.offset_rad)
    stretch = math.log(abs(mistake.bearing))
    sigma = seen.sigma_bearing_rad * abs(mistake.bearing)
    ahead, aside = (
        (driven.lateral_mps, driven.forward_mps) if mistake.exchanged else (driven.forward_mps, driven.lateral_mps)
    )
    odometry = replace(
        driven,
        forward_mps=ahead * mistake.forward,
        lateral_mps=aside * mistake.lateral,
        angular_radps=driven.angular_radps * mistake.turn,
    )
    detections = replace(seen, bearing_rad=bearing, sigma_bearing_rad=sigma)
    if (mistake.bearing, mistake.offset_rad) == (1.0, 0.0):
        detections = seen
    return replace(
        inputs,
        recording=replace(recording, detections=detections, odometry=odometry),
        stretched=inputs.stretched + stretch,
    )


# ---- in space


def _in_space(recording: SpatialRecording, *, calibrations: bool, has_metre: bool) -> Iterable[Suspect]:
    """Yield what may be wrong with a recording in space; no scale of all that was seen where nothing else has a metre.

    A smaller world fits as well then, and better with what is supposed of how fast a camera is carried. Nor of
    directions: what is as far as they meet has no scale of its own.
    """
    seen, sensors = recording.detections, recording.sensors
    sizes = np.unique(np.round(seen.tag_size_m[np.isfinite(seen.tag_size_m)], 6))
    one = f"{sizes[0]:.12g}" if len(sizes) == 1 else ""
    corners = bool(np.isfinite(seen.corner_px[:, 0, 0]).any())
    many = len(sensors) > 1
    if has_metre and (one or corners):
        yield _all_tags(one)
    elif has_metre:
        yield Suspect(
            "range-scale", "sensor", USUAL_P, partial(_stretch_positions, of=None),
            lambda s: f"true distances are {math.exp(s):.4g} times those of the detections: the detector has another "
            "size of tags, or the sensor another scale",
            lambda s: f"tag size of the detector x {math.exp(s):.4g}, or sigma_scale = {_round_up(abs(s))}",
            SCALE, _times,
        )  # fmt: skip
    for row in np.flatnonzero(has_scale(recording)).tolist() if many else ():
        yield _scale_of_sensor(row, sensors[row].name)
    if len(sizes) > 1:
        for size in sizes.tolist():
            yield _kind_size(f"size {size:g} m", _stretch_positions, ("size", size), f"{size:.12g}")
    for row, name in enumerate(recording.class_names if len(recording.class_names) > 1 else ()):
        yield _kind_size(f"class {name}", _stretch_positions, ("class", row), "")
    for identity in () if calibrations else _seen_often(recording):
        own = seen.tag_size_m[seen.landmark_id == identity]
        size = f"{np.nanmedian(own):.12g}" if np.isfinite(own).any() else ""
        name = recording.landmark_names.get(identity, str(identity))
        yield _one_size(name, _stretch_positions, ("id", identity), size)
    if not calibrations:
        yield from _read_otherwise(recording)
    if recording.odometry is not None:
        yield _odometry_scale()
        yield _turn_scale()
        yield _late_stamps(sensors[0].name if len(sensors) == 1 else "all sensors")
        aside = _drives_sideways(recording.odometry)
        for mistake in mistakes.DRIVES:
            if mistake.lateral == 1.0 or aside:  # else only its turns can be mirrored
                yield Suspect(
                    mistake.code, "odometry", USUAL_P if "sign" in mistake.code else RARE_P,
                    partial(_read_drive, mistake=mistake), _constant(mistake.message), _constant(_fix_of(mistake)),
                )  # fmt: skip
        for mistake in mistakes.POSES:
            yield Suspect(
                mistake.code, mistake.field, USUAL_P, partial(_read_poses, convention=mistake.poses),
                _constant(mistake.message), _constant(_fix_of(mistake)),
            )  # fmt: skip
    for mistake in () if corners else mistakes.MIRRORS:
        yield Suspect(
            mistake.code, mistake.field, RARE_P, partial(_mirror_positions, signs=mistake.mirrored),
            _constant(mistake.message), _constant("detections.csv: the sign of x_m or y_m"),
        )  # fmt: skip
    for mistake in mistakes.UNITS_IN_SPACE:
        state = math.log(mistake.lengths)
        if mistake.field == "odometry" and recording.odometry is None:
            continue
        undo = (
            (lambda inputs, _, state=state: _stretch_speeds(inputs, -state))
            if mistake.field == "odometry"
            else (lambda inputs, _, state=state: _stretch_positions(inputs, state, None))
        )
        yield Suspect(
            mistake.code, mistake.field, UNIT_P, undo, _constant(mistake.message), _constant(_fix_of(mistake))
        )
    for row, sensor in enumerate(sensors):
        yield from _of_mount(row, sensor, many=many, driven=recording.odometry is not None)
    if many:
        yield from _of_all_mounts(sensors, driven=recording.odometry is not None)
    cameras = [row for row, sensor in enumerate(sensors) if sensor.intrinsics is not None]
    if not corners:
        return
    for same in {sensors[row].intrinsics: None for row in cameras}:
        yield from _of_lens([row for row in cameras if sensors[row].intrinsics == same], sensors)


def _read_otherwise(recording: SpatialRecording) -> Iterable[Suspect]:
    """Yield conventions of corners and of poses by which detections agree with each other, if others than expected."""
    for how in [find_corner_mistake(recording) or CLOCKWISE] if is_clockwise(recording).any() else []:
        yield Suspect(
            "corner-order", "corners", USUAL_P, partial(_read_corners, how=how), _constant(CORNERS[how].message),
            _constant(CORNERS[how].fix), shows=True,
        )  # fmt: skip
    for convention in filter(None, [find_convention(recording, mistakes.USUAL)]):
        yield Suspect(
            "detection-poses", "detections", USUAL_P, partial(_read_detections, convention=convention),
            _constant(SIGHTED[convention]), _constant("detections.csv: x_m, y_m, z_m, qx, qy, qz, qw"), shows=True,
        )  # fmt: skip


def _all_tags(size: str) -> Suspect:
    return Suspect(
        "tag-size", "all tags", USUAL_P, partial(_stretch_positions, of=None),
        lambda s: (f"tags are {float(size) * math.exp(s):.4g} m large, not {float(size):.4g} m" if size
                   else f"tags are {math.exp(s):.4g} times as large as stated"),
        lambda s: (f"[tags] size_m = {float(size) * math.exp(s):.4g}" if size
                   else f"[tags] sizes x {math.exp(s):.4g}"),
        SCALE, _times,
    )  # fmt: skip


def has_scale(recording: SpatialRecording) -> BoolArray:
    """Return (S,) sensors whose detections may have another scale; that of a camera that reads corners is its lens."""
    seen, cameras = recording.detections, np.array([one.intrinsics is not None for one in recording.sensors])
    corners = cameras[seen.sensor] & np.isfinite(seen.corner_px[:, 0, 0])
    found = np.bincount(seen.sensor[~(corners | without_range(recording))], minlength=len(cameras)) > 0
    return np.asarray(found & ~np.isin(np.arange(len(cameras)), seen.sensor[corners]))


def _scale_of_sensor(row: int, name: str) -> Suspect:
    """Return that one of several sensors measures in another scale than the others."""
    return Suspect(
        "sensor-scale", name, USUAL_P, partial(_stretch_positions, of=("sensor", row)),
        lambda s: f"{name} measures {math.exp(-s):.4g} times too {'long' if s < 0.0 else 'short'}: true distances are "
        f"{math.exp(s):.4g} times those of its detections",
        lambda s: f"detections.csv of {name}: x_m, y_m, z_m x {math.exp(s):.4g}",
        SCALE, _times, rows=("sensor", row),
    )  # fmt: skip


def _stretch_positions(inputs: Inputs, state: float, of: tuple[str, float] | None) -> Inputs:
    recording: Any = inputs.recording
    mine, seen = rows_of_kind(recording, of), recording.detections
    factor = np.where(mine, math.exp(state), 1.0)
    further = replace(
        seen,
        position_sensor_m=seen.position_sensor_m * factor[:, None],
        covariance_sensor_m2=seen.covariance_sensor_m2 * factor[:, None, None] ** 2,
        tag_size_m=seen.tag_size_m * factor,
    )
    cameras = np.array([sensor.intrinsics is not None for sensor in recording.sensors])[seen.sensor]
    read = ~(cameras & np.isfinite(seen.corner_px[:, 0, 0]))  # of others the position was measured
    return replace(
        inputs,
        recording=replace(recording, detections=further),
        stretched=inputs.stretched + 3.0 * state * (mine & read),
    )


def _read_corners(inputs: Inputs, _: float, how: str) -> Inputs:
    """Return the same with the corners read in another way."""
    recording: Any = inputs.recording
    return replace(inputs, recording=read_corners(recording, how))


def _read_detections(inputs: Inputs, _: float, convention: str) -> Inputs:
    """Return the same with the poses of the detections read in another convention."""
    recording: Any = inputs.recording
    seen = recording.detections
    pose = mistakes.CONVENTIONS[convention](np.concatenate([seen.position_sensor_m, seen.rotation], axis=1))
    seen = replace(seen, position_sensor_m=pose[:, :3], rotation=pose[:, 3:])
    return replace(inputs, recording=replace(recording, detections=seen))


def _mirror_positions(inputs: Inputs, _: float, signs: tuple[float, float, float]) -> Inputs:
    """Return the same with other signs of coordinates of the detections; orientations stay."""
    recording: Any = inputs.recording
    seen, by = recording.detections, np.array(signs)
    seen = replace(
        seen,
        position_sensor_m=seen.position_sensor_m * by,
        covariance_sensor_m2=seen.covariance_sensor_m2 * by[:, None] * by,
    )
    return replace(inputs, recording=replace(recording, detections=seen))


def _drives_sideways(odometry: SpatialOdometry) -> bool:
    step = np.abs(se3.between(odometry.pose_world_robot[:-1], odometry.pose_world_robot[1:])[:, :2]).sum(axis=0)
    return bool(step[1] > SIDEWAYS * step[0])


def _read_drive(inputs: Inputs, _: float, mistake: mistakes.Mistake) -> Inputs:
    """Return the same with the odometry's signs and axes read in another way."""
    recording: Any = inputs.recording
    return _with_poses(inputs, mistakes.read_drive(recording.odometry.pose_world_robot, *mistake.drive))


def _read_poses(inputs: Inputs, _: float, convention: str) -> Inputs:
    """Return the same with the poses of the odometry read in another convention."""
    recording: Any = inputs.recording
    return _with_poses(inputs, mistakes.CONVENTIONS[convention](recording.odometry.pose_world_robot))


def _with_poses(inputs: Inputs, pose: FloatArray) -> Inputs:
    """Return the same with other poses (N, 7) of the odometry."""
    recording: Any = inputs.recording
    return replace(inputs, recording=replace(recording, odometry=replace(recording.odometry, pose_world_robot=pose)))


def _of_mount(row: int, sensor: SpatialSensor, *, many: bool, driven: bool) -> Iterable[Suspect]:
    """Return what may be wrong with where a sensor sits; of one sensor without odometry nothing shows."""
    if not (many or driven):
        return
    name, told = sensor.name, _constant(f"[camera.{sensor.name}.mount]")
    yield from _of_axes((row,), name, f"the mount of {name} is", told)
    for mistake in mistakes.AXES:
        by = se3.turn(mistake.turned)
        yield Suspect(
            mistake.code, name, USUAL_P, partial(_change_mount, sensor=row, how=partial(_turn_within, by=by)),
            _constant(f"{name}: {mistake.message}"), told,
        )  # fmt: skip
    for words, how in _FLIPS:
        yield Suspect(
            "mount-flip", name, USUAL_P if words in _OFTEN else RARE_P,
            partial(_change_mount, sensor=row, how=how), _constant(f"{name} seems {words}"), told,
        )  # fmt: skip


def _of_axes(rows: Sequence[int], name: str, what_is: str, fix: Callable[[float], str]) -> Iterable[Suspect]:
    """Return offsets and turns of mounts, together, along and about each axis of the robot."""
    for axis, part in enumerate(("x", "y", "z", "roll", "pitch", "yaw")):
        unit, sigma = ("rad", MOUNT_RAD) if axis > 2 else ("m", MOUNT_M)
        yield Suspect(
            "mount", f"{name} {part}", USUAL_P, partial(_move_mounts, sensors=rows, axis=axis),
            lambda s, part=part, unit=unit: f"{what_is} {s:.3g} {unit} off in {part} of the robot",  # type: ignore[misc]
            fix, sigma,
        )  # fmt: skip


def _of_all_mounts(sensors: Sequence[SpatialSensor], *, driven: bool) -> Iterable[Suspect]:
    """Return what may be wrong with all mounts at once: one driver for all is likelier than as many mistakes."""
    rows = range(len(sensors))
    for one, other in combinations(rows, 2):
        names = f"{sensors[one].name}, {sensors[other].name}"
        yield Suspect(
            "mount", names, USUAL_P, partial(_exchange_mounts, one=one, other=other),
            _constant(f"the mounts of {sensors[one].name} and {sensors[other].name} seem to be exchanged"),
            _constant(f"[camera.{sensors[one].name}.mount], [camera.{sensors[other].name}.mount]"),
        )  # fmt: skip
    if not driven:  # nothing says which way the robot looks
        return
    yield from _of_axes(rows, "all sensors", "mounts of all sensors are", _constant("[camera.*.mount]"))
    turned: list[tuple[str, str, Callable[[FloatArray], FloatArray], float]] = [
        (each.code, each.message, partial(_turn_within, by=se3.turn(each.turned)), USUAL_P) for each in mistakes.AXES
    ]
    flipped = [
        ("mount-flip", f"all sensors seem {words}", how, USUAL_P if words in _OFTEN else RARE_P)
        for words, how in _FLIPS
    ]
    for code, words, how, p in (*turned, *flipped):
        yield Suspect(
            code, "all sensors", p, partial(_change_mounts, sensors=rows, how=how), _constant(words),
            _constant("[camera.*.mount]"),
        )  # fmt: skip


def _exchange_mounts(inputs: Inputs, _: float, one: int, other: int) -> Inputs:
    recording: Any = inputs.recording
    changed = list(recording.sensors)
    for row, by in ((one, other), (other, one)):
        changed[row] = replace(changed[row], mount_robot_sensor=recording.sensors[by].mount_robot_sensor)
    return replace(inputs, recording=replace(recording, sensors=tuple(changed)))


def _turn_within(pose: FloatArray, by: FloatArray) -> FloatArray:
    """Return the mount of a sensor, or the poses of tags (K, 7), with their axes turned."""
    return np.asarray(se3.compose(pose, by))


def _make_turn(axis: int, angle_rad: float, *, of_robot: bool) -> Callable[[FloatArray], FloatArray]:
    quaternion = np.zeros(4)
    quaternion[axis], quaternion[3] = math.sin(0.5 * angle_rad), math.cos(0.5 * angle_rad)
    by = se3.turn(quaternion)

    def how(mount: FloatArray) -> FloatArray:
        if of_robot:
            turned = se3.compose(by, mount)
            return np.concatenate([mount[:3], turned[3:]])
        return np.asarray(se3.compose(mount, by))

    return how


def _tilt_back(mount: FloatArray) -> FloatArray:
    """Return a mount that looks down as far as it looked up, or the reverse; ahead is z of a camera, else x."""
    axes = se3.rotation_of(mount)
    ahead = axes[:, 2] if abs(axes[2, 2]) < UPRIGHT else axes[:, 0]
    up_rad = math.asin(float(np.clip(ahead[2], -1.0, 1.0)))
    across = np.array([-ahead[1], ahead[0], 0.0]) / max(math.hypot(ahead[0], ahead[1]), 1e-9)
    by = se3.exp(np.concatenate([np.zeros(3), 2.0 * up_rad * across]))
    return np.concatenate([mount[:3], se3.compose(by, se3.turn(mount[3:]))[3:]])


UPRIGHT = 0.7
"""Share by which the z axis of a sensor points upwards from which it is none of a camera that looks ahead."""
_FLIPS: tuple[tuple[str, Callable[[FloatArray], FloatArray]], ...] = (
    ("mounted looking the other way: the yaw is 180 degrees off", _make_turn(2, math.pi, of_robot=True)),
    ("mounted upside down: the image is turned by 180 degrees", _make_turn(2, math.pi, of_robot=False)),
    ("turned by 90 degrees to the left of the stated mount", _make_turn(2, 0.5 * math.pi, of_robot=True)),
    ("turned by 90 degrees to the right of the stated mount", _make_turn(2, -0.5 * math.pi, of_robot=True)),
    ("mounted inversely: the pose stated is that of the robot in the sensor's frame", mistakes.CONVENTIONS["inverse"]),
    ("mounted by a quaternion in the order w, x, y, z", mistakes.CONVENTIONS["w first"]),
    ("tilted the other way: the sign of the pitch", _tilt_back),
    ("mounted on the other side: the sign of y", lambda m: m * np.array([1.0, -1.0, 1.0, 1.0, 1.0, 1.0, 1.0])),
)  # fmt: skip
_OFTEN = frozenset(_FLIPS[row][0] for row in (0, 1, 4, 6))


def _move_mounts(inputs: Inputs, state: float, sensors: Iterable[int], axis: int) -> Inputs:
    """Return the same with mounts moved along, or turned about, an axis of the robot."""
    by = np.zeros(6)
    by[axis] = state
    turn = se3.from_angles(by[3:])

    def how(mount: FloatArray) -> FloatArray:
        return np.concatenate([mount[:3] + by[:3], se3.compose(turn, se3.turn(mount[3:]))[3:]])

    return _change_mounts(inputs, 0.0, sensors, how)


def _change_mount(inputs: Inputs, state: float, sensor: int, how: Callable[[FloatArray], FloatArray]) -> Inputs:
    return _change_mounts(inputs, state, (sensor,), how)


def _change_mounts(inputs: Inputs, _: float, sensors: Iterable[int], how: Callable[[FloatArray], FloatArray]) -> Inputs:
    recording: Any = inputs.recording
    changed = list(recording.sensors)
    for row in sensors:
        mount = how(np.array(changed[row].mount_robot_sensor))
        changed[row] = replace(changed[row], mount_robot_sensor=tuple(mount.tolist()))
    return replace(inputs, recording=replace(recording, sensors=tuple(changed)))


def _of_lens(row: list[int], sensors: Sequence[SpatialSensor]) -> Iterable[Suspect]:
    """Return what may be wrong with the calibration that some cameras share."""
    sensor = sensors[row[0]]
    assert sensor.intrinsics is not None
    fx, fy, cx, cy = sensor.intrinsics
    name = sensor.name if len(row) == 1 else ", ".join(sensors[one].name for one in row)

    def lens(code: str, words: str, fix: str, p: float, **changed: Any) -> Suspect:
        undo = partial(_change_lens, rows=row, how=lambda _, __: changed)
        return Suspect(code, name, p, undo, _constant(f"{name}: {words}"), _constant(fix), pairs=False)

    yield Suspect(
        "focal-length", name, USUAL_P, partial(_change_lens, rows=row, how=_zoomed),
        lambda s: f"{name}: the focal length is {fx * math.exp(s):.4g} px, not {fx:.4g} px",
        lambda s: f"[camera.{name}] intrinsics = [{fx * math.exp(s):.5g}, {fy * math.exp(s):.5g}, {cx:g}, {cy:g}]",
        FOCAL, lambda s: fx * math.exp(s), pairs=False,
    )  # fmt: skip
    for factor in RESOLUTIONS:
        listed = ", ".join(f"{factor * each:g}" for each in sensor.intrinsics)
        yield Suspect(
            "resolution", name, USUAL_P, partial(_change_resolution, rows=row, factor=factor),
            _constant(f"{name}: corners are of images {factor:.3g} times as large as those of the calibration"),
            _constant(f"[camera.{name}] intrinsics = [{listed}]"),
        )  # fmt: skip
    for place, key in ((2, "cx"), (3, "cy")):
        stated = sensor.intrinsics[place]
        yield Suspect(
            "intrinsics", f"{name} {key}", RARE_P,
            partial(_change_lens, rows=row, how=partial(_with_number_off, field="intrinsics", place=place)),
            lambda s, key=key, stated=stated: f"{name}: {key} is {stated + s:.4g} px, not {stated:.4g} px",  # type: ignore[misc]
            lambda s, key=key, stated=stated: f"[camera.{name}] intrinsics: {key} = {stated + s:.5g}",  # type: ignore[misc]
            CENTRE_PX, pairs=False,
        )  # fmt: skip
    if abs(fx - fy) > 1e-3 * fx or abs(cx - cy) > 1e-3 * cx:
        for words, swapped in (
            ("fx and fy seem to be swapped", (fy, fx, cx, cy)), ("cx and cy seem to be swapped", (fx, fy, cy, cx)),
            ("fx, fy and cx, cy seem to be swapped", (fy, fx, cy, cx)),
            ("intrinsics seem to be stated as fx, cx, fy, cy", (fx, cx, fy, cy)),
        ):  # fmt: skip
            listed = ", ".join(f"{each:g}" for each in swapped)
            yield lens("intrinsics", words, f"[camera.{name}] intrinsics = [{listed}]", USUAL_P, intrinsics=swapped)
    if not any(sensor.distortion):
        yield Suspect(
            "distortion", name, USUAL_P, partial(_change_lens, rows=row, how=_bent),
            lambda s: f"{name}: the lens distorts, but no distortion is stated: k1 is about {s:.3g}",
            lambda s: f'[camera.{name}] model = "radtan", distortion = [{s:.3g}, {s * s:.3g}, 0, 0], or calibrate',
            DISTORTION, pairs=False,
        )  # fmt: skip
        return
    yield lens(
        "distortion", "the sign of k1 seems wrong", f"[camera.{name}] distortion = [{-sensor.distortion[0]:g}, ...]",
        RARE_P, distortion=(-sensor.distortion[0], *sensor.distortion[1:]),
    )  # fmt: skip
    yield lens(
        "distortion", "corners seem to be undistorted already", f'[camera.{name}] model = "pinhole"', USUAL_P,
        distortion=(), distortion_model="pinhole",
    )  # fmt: skip
    for place in range(2):
        key, stated = f"k{place + 1}", sensor.distortion[place]
        yield Suspect(
            "distortion", f"{name} {key}", RARE_P,
            partial(_change_lens, rows=row, how=partial(_with_number_off, field="distortion", place=place)),
            lambda s, key=key, stated=stated: f"{name}: {key} is about {stated + s:.3g}, not {stated:.3g}",  # type: ignore[misc]
            lambda s, key=key, stated=stated: f"[camera.{name}] distortion: {key} = {stated + s:.3g}",  # type: ignore[misc]
            COEFFICIENT, pairs=False,
        )  # fmt: skip
    if len(sensor.distortion) >= 4:
        other = "equidistant" if sensor.distortion_model == "radtan" else "radtan"
        yield lens(
            "lens", f"the lens seems to be of the model '{other}'", f'[camera.{name}] model = "{other}"', USUAL_P,
            distortion=sensor.distortion[:4], distortion_model=other,
        )  # fmt: skip


def _change_resolution(inputs: Inputs, _: float, rows: Sequence[int], factor: float) -> Inputs:
    """Return the same with the calibration of some cameras for images of another size, and the poses of their tags."""
    recording: Any = inputs.recording
    seen, sensors = recording.detections, list(recording.sensors)
    for row in rows:
        size = sensors[row].resolution_px
        sensors[row] = replace(
            sensors[row],
            intrinsics=tuple(factor * each for each in sensors[row].intrinsics),
            resolution_px=None if size is None else (round(factor * size[0]), round(factor * size[1])),
        )
    seen = with_square_poses(seen, sensors, np.isin(seen.sensor, rows) & np.isfinite(seen.corner_px[:, 0, 0]))
    return replace(inputs, recording=replace(recording, detections=seen, sensors=tuple(sensors)))


def _zoomed(sensor: SpatialSensor, state: float) -> dict[str, Any]:
    assert sensor.intrinsics is not None
    fx, fy, cx, cy = sensor.intrinsics
    return {"intrinsics": (fx * math.exp(state), fy * math.exp(state), cx, cy)}


def _with_number_off(sensor: SpatialSensor, state: float, field: str, place: int) -> dict[str, Any]:
    """Return intrinsics or distortion with one number another than stated."""
    numbers = list(getattr(sensor, field))
    numbers[place] += state
    return {field: tuple(numbers)}


def _bent(_: SpatialSensor, state: float) -> dict[str, Any]:
    """Return the distortion of a lens with this k1: of those that bend lines much, k2 is about its square."""
    return {"distortion": (state, state**2, 0.0, 0.0), "distortion_model": "radtan"}


def _change_lens(
    inputs: Inputs, state: float, rows: Iterable[int], how: Callable[[Any, float], dict[str, Any]]
) -> Inputs:
    recording: Any = inputs.recording
    sensors = list(recording.sensors)
    for row in rows:
        sensors[row] = replace(sensors[row], **how(sensors[row], state))
    return replace(inputs, recording=replace(recording, sensors=tuple(sensors)))


# ---- of a given map


def _of_map(given: Landmarks, recording: AnyRecording) -> Iterable[Suspect]:
    yield Suspect(
        "map-scale", "map", USUAL_P, _stretch_map,
        lambda s: f"true distances are {math.exp(s):.4g} times those of the given map: another scale",
        lambda s: f"--prior-map: lengths x {math.exp(s):.5g}", MAP_SCALE, _times, of_map=True, pairs=False,
    )  # fmt: skip
    yield Suspect(
        "map-mirrored", "map", USUAL_P, lambda inputs, _: _mirror_map(inputs),
        _constant("the given map is mirrored: y to the right, x and y exchanged, or z downwards"),
        _constant("--prior-map: the sign of y"), of_map=True, pairs=False,
    )  # fmt: skip
    if given.rotation is not None and np.isfinite(given.rotation).any():
        yield from _of_map_axes(recording)
    for unit, factor in (
        ("millimetres", 1e-3), ("centimetres", 1e-2), ("feet", 0.3048), ("inches", 0.0254),
    ):  # fmt: skip
        yield Suspect(
            "map-unit", "map", UNIT_P, partial(_stretch_map_by, factor=factor),
            _constant(f"the given map seems to be in {unit}, not in metres"),
            _constant(f"--prior-map: lengths x {factor:g}"), of_map=True, pairs=False,
        )  # fmt: skip
    yield Suspect(
        "map-site", "map", RARE_P, lambda inputs, _: replace(inputs, prior_map=None, left_out=inputs.n_common),
        _constant("the given map is not one of what was seen: another site, or another edition"),
        _constant("--prior-map: leave it out, or give the map of this site"), of_map=True, pairs=False,
    )  # fmt: skip


def _of_map_axes(recording: AnyRecording) -> Iterable[Suspect]:
    """Return what may be wrong with the orientations of tags in a map: other axes, or another order of numbers.

    A tag whose corners are listed from another one on is turned about its normal; one whose corners are listed
    clockwise is turned over. Where corners were read, these are what is wrong.
    """
    corners = is_in_space(recording) and bool(np.isfinite(recording.detections.corner_px[:, 0, 0]).any())
    clockwise = is_in_space(recording) and corners and bool(is_clockwise(recording).any())
    for quaternion in _AXES_TURNED:
        listed = ", ".join(f"{each:g}" for each in np.round(quaternion, 6) + 0.0)
        undo = partial(_turn_map, how=partial(_turn_within, by=se3.turn(quaternion)))
        normal, over = (not np.abs(part).max() > 1e-9 for part in (quaternion[:2], quaternion[2:]))
        if corners and (over if clockwise else normal):
            which = "clockwise, as by OpenCV's ArUco, or from another one on" if clockwise else "from another one on"
            yield Suspect(
                "corner-order", "tags", USUAL_P, undo,
                _constant(
                    f"corners of tags are listed {which}: counter-clockwise from the lower left is expected (u0_px); "
                    f"or tags have other axes than in the given map: x, y, z are its {_name_axes(quaternion)}"
                ),
                _constant(f"detections.csv: corners in the order {_name_order(quaternion)}"), of_map=True, pairs=False,
            )  # fmt: skip
            continue
        yield Suspect(
            "map-axes", "map", USUAL_P if normal else RARE_P, undo,
            _constant(f"tags have other axes than in the given map: x, y, z are its {_name_axes(quaternion)}"),
            _constant(f"--prior-map: each orientation times the quaternion x, y, z, w = {listed}"),
            of_map=True, pairs=False,
        )  # fmt: skip
    for convention, words in (
        ("w first", "are in the order w, x, y, z"), ("inverse", "are those of the world in the tags' frames"),
    ):  # fmt: skip
        yield Suspect(
            "map-axes", "map", USUAL_P, partial(_turn_map, how=mistakes.CONVENTIONS[convention]),
            _constant(f"orientations of the given map {words}"), _constant("--prior-map: qx, qy, qz, qw"),
            of_map=True, pairs=False,
        )  # fmt: skip


def _name_axes(quaternion: FloatArray) -> str:
    """Return axes after a rotation in those before it, as 'y, -x, z'."""
    turned = np.round(se3.transform(se3.turn(quaternion), np.eye(3)), 6)
    return ", ".join(("-" if axis.sum() < 0.0 else "") + "xyz"[int(np.abs(axis).argmax())] for axis in turned)


def _name_order(quaternion: FloatArray) -> str:
    """Return in which order to list corners of a tag that is turned by a quaternion, as '3, 2, 1, 0'."""
    back = se3.transform(se3.inverse(se3.turn(quaternion)), SQUARE)
    return ", ".join(str(int(np.argmin(np.linalg.norm(SQUARE - each, axis=1)))) for each in back)


_AXES_TURNED = sorted(
    (each for each in Symmetry.generated(("90:x", "90:z")).turns if abs(each[3]) < 1.0 - 1e-9),
    key=lambda each: bool(each[:2].any()),
)
"""Quaternions of the 23 rotations that bring axes to axes, those about the normal of a tag first."""


def _turn_map(inputs: Inputs, _: float, how: Callable[[FloatArray], FloatArray]) -> Inputs:
    """Return the same with other orientations of the map's landmarks."""
    given = inputs.prior_map
    assert given is not None
    assert given.rotation is not None
    return replace(inputs, prior_map=replace(given, rotation=how(se3.turn(given.rotation))[:, 3:]))


def _stretch_map_by(inputs: Inputs, _: float, factor: float) -> Inputs:
    """Return the same with the map in another unit; how well it is known was not read from it, but stated in metres."""
    stretched = _stretch_map(inputs, math.log(factor))
    assert inputs.prior_map is not None
    assert stretched.prior_map is not None
    return replace(stretched, prior_map=replace(stretched.prior_map, covariance_m2=inputs.prior_map.covariance_m2))


def _stretch_map(inputs: Inputs, state: float) -> Inputs:
    given, factor = inputs.prior_map, math.exp(state)
    assert given is not None
    dim = given.position_m.shape[1]
    other = replace(given, position_m=given.position_m * factor, covariance_m2=given.covariance_m2 * factor**2)
    return replace(inputs, prior_map=other, stretched_place=inputs.stretched_place + dim * state)


def _mirror_map(inputs: Inputs) -> Inputs:
    """Return the same with the map mirrored; it knows no orientations then, of which there are several mirrors."""
    given = inputs.prior_map
    assert given is not None
    sign = np.ones(given.position_m.shape[1])
    sign[1] = -1.0
    other = replace(
        given,
        position_m=given.position_m * sign,
        covariance_m2=given.covariance_m2 * sign[:, None] * sign,
        rotation=None,
        rotation_covariance=None,
    )
    return replace(inputs, prior_map=other)
