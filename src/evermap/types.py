"""The nouns of evermap: frozen dataclasses of arrays, one row an item, which show themselves briefly.

Poses, landmarks and results are in the plane or in space; what a robot drives and sees has a form for each.

Conventions that hold everywhere:

* units are seconds, metres and radians, and stand in the name (`stamp_s`, `range_m`, `bearing_rad`);
* frames stand in the name: `pose_world_robot` maps robot coordinates to world coordinates and is `(x, y, theta)`;
* covariances of poses are in the robot's own frame (right perturbation `pose * exp(xi)`, `xi = (forward, left, turn)`);
* every stamp says its clock; arrays are C-contiguous float64 or int64; unknown ids are `UNKNOWN` (-1);
* columns that are given as lists, or as other kinds of numbers, become such arrays; lengths that differ are refused;
  what the numbers may be is in `valid`;
* what was *not* seen is data: `Frames` lists every instant at which the sensor looked, `Misses` what it missed.
"""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from enum import StrEnum
from functools import lru_cache
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypeVar

from evermap.errors import InputError
from evermap.show import Shown, ShownTable, draw, extent, span

if TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from matplotlib.figure import Figure
    from typing_extensions import TypeIs

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Progress = Callable[[float, float], None]
"""Called with what is done and the total: seconds of recordings, or steps."""

UNKNOWN: int = -1
"""Id of a landmark or class that is not known."""


class Tabular(ShownTable):
    """Mixin of tables whose rows are taken and joined: all arrays have as many as the first; what is no array stays."""

    __slots__ = ()

    def __len__(self) -> int:
        return len(getattr(self, next(iter(self.__dataclass_fields__))))

    def __getitem__(self, rows: IntArray | BoolArray) -> Self:
        """Some of the rows, by number or by a mask."""
        return rows_of(self, rows)

    def joined(self, *others: Self) -> Self:
        """Return these rows, then those of others."""
        names = [name for name in self.__dataclass_fields__ if isinstance(getattr(self, name), np.ndarray)]
        every: dict[str, Any] = {name: [getattr(one, name) for one in (self, *others)] for name in names}
        return replace(self, **{name: np.concatenate(columns) for name, columns in every.items()})


class _Columns(Tabular):
    """Mixin of dataclasses whose arrays are columns of N rows each, N being those of the first one.

    Raises:
        InputError: no numbers, fractions where whole numbers are needed, or another length.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        first, count = "", -1
        for name, item in self.__dataclass_fields__.items():
            if item.type not in _KINDS:
                continue
            given, owner, kind = getattr(self, name), type(self).__name__, _KINDS[item.type]
            rest = _WIDE.get(name, ((),))
            array = given if isinstance(given, np.ndarray) else np.asarray(_numbers(given, owner, name))
            if array.dtype != kind:
                array = _as_kind(array, owner, name, whole=kind is np.int64)
            if not first:
                first, count = name, len(array) if array.ndim else -1
            if array.ndim == 0 or array.shape[0] != count or array.shape[1:] not in rest:
                more = " or ".join(f"({count}, {', '.join(map(str, shape))})" for shape in rest if shape)
                wanted = more or f"({max(count, 0)},), as {first}"
                raise InputError(f"{owner} of shape {array.shape} instead of {wanted}", field=name)
            if array is not given:
                object.__setattr__(self, name, array)


_KINDS: dict[Any, Any] = {"FloatArray": np.float64, "IntArray": np.int64}
_WIDE: dict[str, tuple[tuple[int, ...], ...]] = {
    "pose_world_robot": ((3,), (7,)),
    "covariance": ((3, 3), (6, 6)),
    "position_m": ((2,), (3,)),
    "covariance_m2": ((2, 2), (3, 3)),
    "position_sensor_m": ((3,),),
    "rotation": ((4,),),
    "covariance_sensor_m2": ((3, 3),),
    "corner_px": ((4, 2),),
    "size_m": ((3,),),
    "variance": ((6,),),
}
"""Columns that hold more than a number a row, and what of their shape may follow the first axis: in the plane, in
space."""


def _numbers(given: Any, owner: str, name: str) -> Any:
    try:
        return np.asarray(given) if len(given) else np.zeros(0)
    except (TypeError, ValueError):
        raise InputError(f"{owner}: {type(given).__name__} is not an array of numbers", field=name) from None


def _as_kind(array: Any, owner: str, name: str, *, whole: bool) -> Any:
    if array.dtype.kind not in "biuf":
        raise InputError(f"{owner}: an array of {array.dtype} holds no numbers", field=name)
    if whole and array.dtype.kind == "f" and not np.all(array == np.floor(array)):
        raise InputError(f"{owner}: fractions where whole numbers are needed", field=name, hint="-1 for unknown")
    return array.astype(np.int64 if whole else np.float64)


@lru_cache(maxsize=2**14)
def landmark_id_of(name: str) -> int:
    """Return the identity of a landmark that is called by a text, the same on every machine and in every session.

    52 bits of a hash (BLAKE2b of the text in UTF-8, normal form C), above all ids that people count with and below
    2^53, so that it passes through float64 and JSON unharmed. Two of 100,000 names meet with probability 1e-6.
    """
    text = unicodedata.normalize("NFC", name.strip()).encode()
    return _TEXT_IDS + int.from_bytes(blake2b(text, digest_size=8).digest(), "big") % _TEXT_IDS


_TEXT_IDS = 2**52
_LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ"  # no I and O, which are read as 1 and 0
CODE_DIGITS = 12
"""Of a whole `landmark_code`."""


def landmark_code(landmark_id: int, digits: int = 3) -> str:
    """Return a letter and digits, as 'K381', for an identity that nobody can say; the same wherever it is asked.

    More digits, up to `CODE_DIGITS`, go on from fewer. Multiplicative hashing (Knuth 1973, 6.4) of 64 bits.
    """
    number = (landmark_id * 0x9E3779B97F4A7C15) % 2**64 >> 16
    rest, letter = divmod(number, len(_LETTERS))
    return _LETTERS[letter] + f"{rest:0{CODE_DIGITS}d}"[-CODE_DIGITS:][:digits]


def landmark_label(landmark_id: int, names: Mapping[int, str]) -> str:
    """Return what a person calls a landmark: its name, else the number that its user gave it, else its code."""
    name = names.get(landmark_id)
    if name is not None:
        return name
    return str(landmark_id) if is_number(landmark_id) else landmark_code(landmark_id)


def is_number(landmark_id: int) -> bool:
    """Return whether an identity is a number that people count with, rather than that of a text."""
    return landmark_id < _TEXT_IDS


def is_text_of(name: str, landmark_id: int) -> bool:
    """Return whether the identity of a landmark is this text (`landmark_id_of`), which then names it in tables."""
    return not is_number(landmark_id) and landmark_id_of(name) == landmark_id


def identity_text(landmark_id: int, names: Mapping[int, str]) -> str:
    """Return an identity as tables have it, by which it is read again: its text if it is one, else its number."""
    name = names.get(landmark_id)
    return name if name is not None and is_text_of(name, landmark_id) else str(landmark_id)


class Clock(StrEnum):
    """Clock of stamps. Stamps of different clocks are never compared."""

    UNIX = "unix"
    """Seconds since 1970-01-01 UTC."""
    RECORDING = "recording"
    """Seconds since an arbitrary start, monotonic within one recording."""
    LOCAL_WALL = "local_wall"
    """Seconds since 1970-01-01 as the clocks on the wall show them (for daily rhythms)."""


@dataclass(frozen=True, slots=True)
class Odometry(_Columns):
    """Body velocities; row `i` holds from `stamp_s[i]` until `stamp_s[i + 1]` (zero-order hold).

    Attributes:
        stamp_s: (N,) strictly increasing.
        forward_mps: (N,) velocity along the robot's x axis.
        lateral_mps: (N,) velocity along its y axis (zeros for a differential drive).
        angular_radps: (N,) turn rate, counter-clockwise positive.
        is_measured: whether they are the motions that were measured, as of increments and poses, which nothing stamps
            before they were; velocities may be commanded, which the robot follows late.
    """

    stamp_s: FloatArray
    forward_mps: FloatArray
    lateral_mps: FloatArray
    angular_radps: FloatArray
    clock: Clock = Clock.RECORDING
    is_measured: bool = False

    def _facts(self) -> dict[str, Any]:
        return {"rows": len(self), **span(self.stamp_s), "clock": self.clock.value}


@dataclass(frozen=True, slots=True)
class Frames(_Columns):
    """Frames of the sensor, with or without detections.

    Attributes:
        stamp_s: (F,) strictly increasing.
        complete: False where the recording does not log empty frames (then absence of a frame is no evidence).
    """

    stamp_s: FloatArray
    complete: bool = True
    clock: Clock = Clock.RECORDING

    def _facts(self) -> dict[str, Any]:
        return {"rows": len(self), **span(self.stamp_s), "complete": self.complete, "clock": self.clock.value}


@dataclass(frozen=True, slots=True)
class Detections(_Columns):
    """Hits: one row a detection, sorted by frame.

    Attributes:
        frame: (M,) row of `Frames`.
        landmark_id: (M,) identity given by the front end, or `UNKNOWN`.
        range_m: (M,) distance from the sensor, as reported (uncalibrated).
        bearing_rad: (M,) counter-clockwise from the sensor's x axis, as reported; nan where only the range is known.
        class_id: (M,) row of `Recording.class_names`, or `UNKNOWN`.
        sigma_range_m, sigma_bearing_rad: (M,) standard deviations given for this very detection, nan where none is.
        source_line: (M,) line in the input file, for messages; 0 where there is none.
        features: (M, D) what was measured of the landmark itself, as its radius or colour, nan where it was not; None
            where nothing ever was.
        feature_names: (D,) what the columns of `features` are called.
    """

    frame: IntArray
    landmark_id: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray
    class_id: IntArray
    sigma_range_m: FloatArray
    sigma_bearing_rad: FloatArray
    source_line: IntArray
    features: FloatArray | None = None
    feature_names: tuple[str, ...] = ()

    def _facts(self) -> dict[str, Any]:
        known = self.landmark_id[self.landmark_id != UNKNOWN]
        return {"rows": len(self), "landmarks": len(np.unique(known)), "range_m": extent(self.range_m)}


@dataclass(frozen=True, slots=True)
class Misses(_Columns):
    """Misses: landmarks that were expected in a frame and not detected; one row a (frame, landmark).

    Attributes:
        frame: (K,) row of `Frames`.
        landmark_id: (K,) the landmark that was expected.
        p_detect: (K,) probability with which it would have been detected, were it there.
    """

    frame: IntArray
    landmark_id: IntArray
    p_detect: FloatArray

    def _facts(self) -> dict[str, Any]:
        return {"rows": len(self), "landmarks": len(np.unique(self.landmark_id))}

    @classmethod
    def empty(cls) -> Misses:
        """Return no misses."""
        none = np.zeros(0, dtype=np.int64)
        return cls(none, none, np.zeros(0))


class SensorKind(StrEnum):
    """Kind of sensor, which sets the priors of its errors."""

    LASER = "laser"
    CAMERA = "camera"
    TAG = "tag"
    STEREO = "stereo"
    UWB = "uwb"


NOT_IN_SPACE = {
    "sigma_offset_m": "no offset of ranges is estimated there: subtract it from the ranges",
    "sigma_askew_rad": "the robot may move in any direction there: sigma_angle_rad is that of the sensor's mount",
    "bearing_min_rad": "the field of view is that of the detections",
    "bearing_max_rad": "the field of view is that of the detections",
    "sigma_range_m": "[noise] sigma_m in sensor.toml",
    "sigma_bearing_rad": "[noise] sigma_m or sigma_px in sensor.toml",
    "mount_robot_sensor": "[mount] in sensor.toml or camera.toml",
}
"""Keys of a sensor in the plane that mean nothing in space, and what to try instead."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """Limits and nominal noise of a range-bearing sensor.

    Attributes:
        range_min_m, range_max_m: limits of the range.
        bearing_min_rad, bearing_max_rad: limits of the field of view.
        sigma_range_m, sigma_bearing_rad: nominal noise, a starting value where noise is estimated; None = unknown.
        p_detect: probability of detecting a landmark in view; p_false: probability of a false detection a frame.
        mount_robot_sensor: pose (x, y, theta) of the sensor in the robot's frame.
        kind: what it is; None = unknown.
        sigma_scale: standard deviation of the scale of its ranges, as a share; sigma_offset_m: of what is added to all;
            sigma_angle_rad: of its angle in the mount; sigma_position_m: of its position there, along each axis. None:
            as usual for the kind.
        sigma_odometer_scale: standard deviation of the scale of the odometer; sigma_askew_rad: of the direction in
            which the robot drives, from its front. None: unknown.
        measures_positions: whether ranges and bearings are those of positions, of whatever sensor in space.
    """

    range_min_m: float = 0.0
    range_max_m: float = float("inf")
    bearing_min_rad: float = -float(np.pi)
    bearing_max_rad: float = float(np.pi)
    sigma_range_m: float | None = None
    sigma_bearing_rad: float | None = None
    p_detect: float = 0.9
    p_false: float = 0.01
    mount_robot_sensor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    kind: SensorKind | None = None
    sigma_scale: float | None = None
    sigma_offset_m: float | None = None
    sigma_angle_rad: float | None = None
    sigma_position_m: float | None = None
    sigma_odometer_scale: float | None = None
    sigma_askew_rad: float | None = None
    measures_positions: bool = False

    @property
    def states_scale(self) -> bool:
        """Whether its kind or data sheet says how well ranges or odometer measure lengths: else ranges do as stated."""
        return self.kind is not None or self.sigma_scale is not None or self.sigma_odometer_scale is not None


@dataclass(frozen=True, slots=True)
class RobotSightings(_Columns):
    """Sightings of other robots, used where these are solved together. One row a sighting."""

    stamp_s: FloatArray
    robot_id: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray
    clock: Clock = Clock.RECORDING

    def _facts(self) -> dict[str, Any]:
        return {"rows": len(self), "robots": len(np.unique(self.robot_id)), **span(self.stamp_s)}


@dataclass(frozen=True, slots=True)
class Trajectory(_Columns):
    """Stamped poses, in the plane or in space.

    Attributes:
        stamp_s: (N,) strictly increasing.
        pose_world_robot: (N, 3) x [m], y [m], theta [rad, wrapped to (-pi, pi]]; in space (N, 7) x, y, z [m] and a unit
            quaternion qx, qy, qz, qw.
        covariance: (N, 3, 3) or (N, 6, 6) in the robot's frame (right perturbation); zeros where the poses are exact.
        frame: what 'world' is: 'first_pose', of robots solved together 'first_robot' (its first pose), 'prior_map' or
            'truth'.
    """

    stamp_s: FloatArray
    pose_world_robot: FloatArray
    covariance: FloatArray
    frame: str = "first_pose"
    clock: Clock = Clock.RECORDING

    @property
    def length_m(self) -> float:
        """Return the length of the path between the poses [m]."""
        at = self.pose_world_robot[:, : 3 if self.pose_world_robot.shape[1] == 7 else 2]
        return float(np.linalg.norm(np.diff(at, axis=0), axis=1).sum())

    def _facts(self) -> dict[str, Any]:
        stamps = span(self.stamp_s)
        return {"poses": len(self), **stamps, "length_m": round(self.length_m, 3), "frame": self.frame}

    def plot(self) -> Figure:
        """Draw the path; returns a matplotlib figure."""
        return draw("plot_trajectory", self)


MOST_TILT_RAD = math.radians(10.0)
"""Greatest standard deviation of an up that is known. At 10 degrees what is 3 m high is half a metre off in a figure
from above or a mask of a floor, about the radius of a robot; beyond it such a figure is a section."""
PLANE = "plane"
"""Source of up in the plane: by definition."""


@dataclass(frozen=True, slots=True)
class Up(Shown):
    """Where up is in the frame of a map.

    Attributes:
        direction: (3,) unit vector, nan where nothing tells.
        sigma_rad: standard deviation of its tilt, about each of two horizontal axes; infinite where nothing tells.
        source: what tells: 'imu', 'tf', 'odometry', 'plane of motion', 'stated', or several of them with commas;
            'plane' of a map in the plane; '' where nothing does.
    """

    direction: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    sigma_rad: float = math.inf
    source: str = ""

    @classmethod
    def of_plane(cls) -> Up:
        """Return that of a map in the plane."""
        return cls(np.array([0.0, 0.0, 1.0]), 0.0, PLANE)

    @property
    def is_known(self) -> bool:
        """Whether it is known well enough to say what is above what."""
        return bool(np.isfinite(self.direction).all()) and self.sigma_rad <= MOST_TILT_RAD

    @property
    def text(self) -> str:
        """One line: the direction, its uncertainty and its source; or that it is unknown."""
        if self.source == PLANE:
            return "z, in the plane"
        axes = ", ".join(f"{part:.3f}" for part in (self.direction + 0.0).tolist())
        within = f"({axes}) within {math.degrees(self.sigma_rad):.1f} deg (1 sigma), by {self.source}"
        if self.is_known:
            return within
        return f"unknown: only {within}" if np.isfinite(self.direction).all() else "unknown"


@dataclass(frozen=True, slots=True)
class Landmarks(_Columns):
    """Map records, one row a landmark, sorted by id. Estimates, a prior map and surveyed truth share this form.

    Attributes:
        landmark_id: (L,) unique.
        position_m: (L, 2) in the map's frame, in space (L, 3).
        covariance_m2: (L, 2, 2) or (L, 3, 3); zeros where exact.
        class_id: (L,) row of `class_names`, or `UNKNOWN`.
        p_exists: (L,) probability that it is there now.
        n_hits, n_misses: (L,) detections used, and expected detections that did not come.
        first_seen_s, last_seen_s: (L,) stamps, nan where never seen.
        frame: what the coordinates refer to, as in `Trajectory.frame`.
        names: texts behind ids that were given as such (`landmark_id_of`), perhaps of other landmarks too.
        rotation: (L, 4) in space, quaternions of landmarks that have an orientation, nan of points; None of points.
        rotation_covariance: (L, 3, 3) [rad^2] in the landmark's own frame; None of points.
        size_m: (L, 3) length, width and height of boxes, nan of others; None where nothing has a size.
        up: where up is in the map's frame; in the plane it is known.
    """

    landmark_id: IntArray
    position_m: FloatArray
    covariance_m2: FloatArray
    class_id: IntArray
    p_exists: FloatArray
    n_hits: IntArray
    n_misses: IntArray
    first_seen_s: FloatArray
    last_seen_s: FloatArray
    class_names: tuple[str, ...] = ()
    frame: str = "first_pose"
    clock: Clock = Clock.RECORDING
    names: Mapping[int, str] = field(default_factory=dict)
    rotation: FloatArray | None = None
    rotation_covariance: FloatArray | None = None
    size_m: FloatArray | None = None
    up: Up = field(default_factory=Up)

    def __post_init__(self) -> None:
        _Columns.__post_init__(self)
        flat = self.position_m.shape[1:] == (2,)
        if flat != (self.up.source == PLANE):
            object.__setattr__(self, "up", Up.of_plane() if flat else Up())

    def _facts(self) -> dict[str, Any]:
        return {
            "rows": len(self),
            **{f"{axis}_m": extent(place) for axis, place in zip("xyz", self.position_m.T, strict=False)},
            "p_exists": extent(self.p_exists),
            "classes": self.class_names,
            "frame": self.frame,
            **({} if self.up.source == PLANE else {"up": self.up.text}),
        }

    def _columns(self) -> dict[str, Any]:
        """Return the columns, with names and classes in words where there are any."""
        found = ShownTable._columns(self)
        if self.names:
            found["name"] = [self.names.get(identity, "") for identity in self.landmark_id.tolist()]
        if self.class_names:
            found["class"] = [self.class_names[k] if k >= 0 else "" for k in self.class_id.tolist()]
        return found

    @property
    def labels(self) -> list[str]:
        """What each landmark is called, (L,)."""
        return [landmark_label(identity, self.names) for identity in self.landmark_id.tolist()]

    def plot(self) -> Figure:
        """Draw the map with 2-sigma ellipses; returns a matplotlib figure."""
        return draw("plot_landmarks", self)

    @classmethod
    def at(
        cls,
        landmark_id: Any,
        position_m: Any,
        *,
        sigma_m: Any = 0.0,
        class_id: Any = None,
        class_names: tuple[str, ...] = (),
        frame: str = "truth",
    ) -> Landmarks:
        """Return known positions with one standard deviation each (scalar, (L,) or (L, 2) metres), e.g. a surveyed
        map.
        """
        ids = np.asarray(landmark_id, dtype=np.int64)
        order = np.argsort(ids, kind="stable")
        count = len(ids)
        sigma = np.asarray(sigma_m, dtype=np.float64)
        sigma = np.broadcast_to(sigma[:, None] if sigma.ndim == 1 else sigma, (count, 2))[order]
        covariance = np.zeros((count, 2, 2))
        covariance[:, [0, 1], [0, 1]] = sigma**2
        classes = np.full(count, UNKNOWN) if class_id is None else np.asarray(class_id, dtype=np.int64)
        return cls(
            landmark_id=ids[order],
            position_m=np.asarray(position_m, dtype=np.float64).reshape(count, 2)[order],
            covariance_m2=covariance,
            class_id=classes[order],
            p_exists=np.ones(count),
            n_hits=np.zeros(count, dtype=np.int64),
            n_misses=np.zeros(count, dtype=np.int64),
            first_seen_s=np.full(count, np.nan),
            last_seen_s=np.full(count, np.nan),
            class_names=class_names,
            frame=frame,
        )

    def as_prior(self, sigma_m: float) -> Landmarks:
        """Return landmarks in space as a map to localise in, with one standard deviation in all directions [m, rad]."""
        known = np.broadcast_to(sigma_m**2 * np.eye(3), (len(self), 3, 3)).copy()
        turned = None if self.rotation is None else known.copy()
        return replace(self, covariance_m2=known, rotation_covariance=turned, frame="prior_map")

    @classmethod
    def in_space(
        cls,
        landmark_id: Any,
        position_m: Any,
        *,
        rotation: Any = None,
        size_m: Any = None,
        class_id: Any = None,
        class_names: tuple[str, ...] = (),
        names: Mapping[int, str] | None = None,
        clock: Clock = Clock.RECORDING,
    ) -> Landmarks:
        """Return landmarks that are known exactly, at (L, 3) metres, perhaps with orientations (L, 4) and sizes
        (L, 3).
        """
        ids = np.asarray(landmark_id, dtype=np.int64)
        order, count = np.argsort(ids, kind="stable"), len(ids)
        flat = cls.at(ids, np.zeros((count, 2)), class_id=class_id, class_names=class_names)
        return replace(
            flat,
            position_m=np.asarray(position_m, dtype=np.float64).reshape(count, 3)[order],
            covariance_m2=np.zeros((count, 3, 3)),
            rotation=None if rotation is None else np.asarray(rotation, dtype=np.float64)[order],
            rotation_covariance=None if rotation is None else np.zeros((count, 3, 3)),
            size_m=None if size_m is None else np.asarray(size_m, dtype=np.float64)[order],
            names=names or {},
            clock=clock,
        )


@dataclass(frozen=True, slots=True)
class Measurements(Shown):
    """Measurements of one kind beside odometry and detections, one row each.

    Attributes:
        kind: its name, one of `evermap.estimate.measurements`, such as 'gnss'.
        stamp_s: (K,) instants.
        columns: (K,) numbers by the names of that kind's columns; nan where a row does not measure one.
        landmark_id: (K,) what was measured; `UNKNOWN` where the kind is not of a landmark.
    """

    kind: str
    stamp_s: FloatArray
    columns: Mapping[str, FloatArray]
    landmark_id: IntArray

    def __len__(self) -> int:
        return len(self.stamp_s)

    def _facts(self) -> dict[str, Any]:
        return {"kind": self.kind, "rows": len(self), **span(self.stamp_s)}


@dataclass(frozen=True, slots=True)
class SpatialOdometry(_Columns):
    """Poses of the robot in a frame that drifts, as visual-inertial odometry gives them.

    Attributes:
        stamp_s: (N,) strictly increasing.
        pose_world_robot: (N, 7) x, y, z [m], quaternion qx, qy, qz, qw.
        variance: (N, 6) of each pose as the source states it, along and about x, y, z of the robot, [m^2], [rad^2]; nan
            where it does not.
        z_up: whether the source states that the z axis of that frame is up, as ROS does (REP 103).
    """

    stamp_s: FloatArray
    pose_world_robot: FloatArray
    variance: FloatArray
    clock: Clock = Clock.RECORDING
    z_up: bool = False

    def _facts(self) -> dict[str, Any]:
        return {"rows": len(self), **span(self.stamp_s), "clock": self.clock.value}


ANY_BEARING_RAD = 100.0
"""Standard deviation of a bearing that was not measured: its value is a start for the estimator, and worth nothing."""
ANY_RANGE_M2 = 1e6
"""Variance beyond which the range of a detection is not known."""


@dataclass(frozen=True, slots=True)
class SpatialDetections(_Columns):
    """Hits in space: one row a detection, sorted by frame; values that a detector does not give are nan.

    Attributes:
        frame: (M,) row of `Frames`.
        sensor: (M,) row of `SpatialRecording.sensors`.
        landmark_id: (M,) identity given by the front end, or `UNKNOWN`.
        position_sensor_m: (M, 3) in the sensor's frame; of a camera x is right, y down, z ahead.
        rotation: (M, 4) quaternion of the landmark in the sensor's frame.
        covariance_sensor_m2: (M, 3, 3) of the position; a variance of more than `ANY_RANGE_M2` along it says that only
            the direction was seen.
        sigma_rad: (M,) standard deviation of the orientation about every axis.
        corner_px: (M, 4, 2) corners of a square tag in the image (u right, v down), in the order (-1, -1), (1, -1),
            (1, 1), (-1, 1) times half of the tag's size in the tag's own x and y.
        tag_size_m: (M,) edge of a square tag.
        size_m: (M, 3) length, width and height of a box, whose frame has x along its length and z up.
        class_id: (M,) row of `SpatialRecording.class_names`, or `UNKNOWN`.
        score: (M,) as the detector gives it.
        source_line: (M,) line in the input file, for messages; 0 where there is none.
        features, feature_names: as of `Detections`.
    """

    frame: IntArray
    sensor: IntArray
    landmark_id: IntArray
    position_sensor_m: FloatArray
    rotation: FloatArray
    covariance_sensor_m2: FloatArray
    sigma_rad: FloatArray
    corner_px: FloatArray
    tag_size_m: FloatArray
    size_m: FloatArray
    class_id: IntArray
    score: FloatArray
    source_line: IntArray
    features: FloatArray | None = None
    feature_names: tuple[str, ...] = ()

    def _facts(self) -> dict[str, Any]:
        known = self.landmark_id[self.landmark_id != UNKNOWN]
        return {"rows": len(self), "landmarks": len(np.unique(known))}


@dataclass(frozen=True, slots=True)
class SpatialSensor(Shown):
    """A sensor in space: where it is on the robot, how it projects, how far it sees.

    Attributes:
        name: as detections call it.
        mount_robot_sensor: (x, y, z, qx, qy, qz, qw), the sensor's pose in the robot's frame.
        intrinsics: (fx, fy, cx, cy) of a camera [px]; None of other sensors.
        distortion: coefficients: none for a pinhole, (k1, k2, p1, p2) or with k3 of 'radtan' (Brown 1966), (k1 .. k4)
            of 'equidistant' (Kannala and Brandt 2006).
        distortion_model: 'pinhole', 'radtan' or 'equidistant'.
        resolution_px: (width, height) of the image; None where it is not known.
        range_min_m, range_max_m: limits of the range.
        sigma_m, sigma_rad, sigma_px: nominal noise of positions, orientations and corners, where noise is estimated a
            starting value; None = unknown.
        p_detect: probability of detecting a landmark in view; p_false: probability of a false detection a frame.
        kind: what it is; None = unknown.
        sigma_scale: standard deviation of the scale of its ranges, as a share; sigma_angle_rad: of its orientation in
            the mount, about each axis; sigma_position_m: of its position there, along each. None: as usual.
        sigma_odometer_scale: standard deviation of the scale of the odometry; the same for all sensors.
    """

    name: str = "sensor"
    mount_robot_sensor: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    intrinsics: tuple[float, float, float, float] | None = None
    distortion: tuple[float, ...] = ()
    distortion_model: str = "pinhole"
    resolution_px: tuple[int, int] | None = None
    range_min_m: float = 0.0
    range_max_m: float = float("inf")
    sigma_m: float | None = None
    sigma_rad: float | None = None
    sigma_px: float | None = None
    p_detect: float = 0.9
    p_false: float = 0.01
    kind: SensorKind | None = None
    sigma_scale: float | None = None
    sigma_angle_rad: float | None = None
    sigma_position_m: float | None = None
    sigma_odometer_scale: float | None = None

    def _facts(self) -> dict[str, Any]:
        return {"name": self.name, "camera": self.intrinsics is not None, "mount": self.mount_robot_sensor}


OdometryT_co = TypeVar("OdometryT_co", bound="Odometry | SpatialOdometry | None", covariant=True, default=Odometry)
DetectionsT_co = TypeVar("DetectionsT_co", bound="Detections | SpatialDetections", covariant=True, default=Detections)


@dataclass(frozen=True, slots=True)
class Recording(Shown, Generic[OdometryT_co, DetectionsT_co]):
    """One robot's session: what a reader returns and the pipeline consumes, in the plane or in space (`dim`).

    Attributes:
        name: short label, e.g. 'MRCLAM_Dataset6 robot 1'.
        odometry: velocities in the plane; poses in space, None for a sensor that is carried by hand.
        detections: ranges and bearings of one `sensor`, or positions in the frames of several `sensors`.
        sensor: of a recording in the plane.
        truth: reference trajectory, for evaluation only; None where unknown, may cover a part of the recording.
        true_landmarks: surveyed landmarks, for evaluation or as a prior map; None where unknown.
        robot_sightings: sightings of other robots, for `run_together`; in the plane.
        objects: (K, 2) landmark ids and the objects that they are on, as an object detector says; empty where there is
            none. Objects are numbered within the recording.
        warnings: counted, human-readable remarks of the reader ('3 detections of unknown barcodes dropped').
        source: where it was read from.
        landmark_names: texts behind the ids of landmarks that were given as such (`landmark_id_of`).
        robot: whose session it is; '' where nobody said. A map keeps it with the revision, not with what was measured.
        measurements: of other kinds, each kind once.
        sensors: of a recording in space, at least one.
        symmetries: turns after which objects look the same, by the names of their classes; as
            `geometry.symmetry.Symmetry.generated` reads them.
    """

    name: str
    odometry: OdometryT_co
    frames: Frames
    detections: DetectionsT_co
    sensor: Sensor = field(default_factory=Sensor)
    truth: Trajectory | None = None
    true_landmarks: Landmarks | None = None
    robot_sightings: RobotSightings | None = None
    objects: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    class_names: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    source: str = ""
    clock: Clock = Clock.RECORDING
    landmark_names: Mapping[int, str] = field(default_factory=dict)
    robot: str = ""
    measurements: tuple[Measurements, ...] = ()
    sensors: tuple[SpatialSensor, ...] = ()
    symmetries: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def dim(self) -> int:
        """Return 2 of a recording in the plane, 3 of one in space."""
        return 3 if isinstance(self.detections, SpatialDetections) else 2

    def _facts(self) -> dict[str, Any]:
        return {
            "name": self.name,
            **span(self.frames.stamp_s),
            "odometry": 0 if self.odometry is None else len(self.odometry),
            "frames": len(self.frames),
            "detections": len(self.detections),
            "landmarks": self.detections._facts()["landmarks"],
            "truth": self.truth is not None,
            "true_landmarks": 0 if self.true_landmarks is None else len(self.true_landmarks),
            "warnings": len(self.warnings),
            "source": self.source,
        }

    def plot(self) -> Figure:
        """Draw detections over time and range, and the truth where there is one; returns a matplotlib figure."""
        return draw("plot_recording", self)


def is_in_space(recording: AnyRecording) -> TypeIs[SpatialRecording]:
    """Return whether poses and detections of a recording are in space, not in the plane."""
    return recording.dim == 3


class _InSpace(type):
    """Instances of `SpatialRecording` are recordings in space."""

    def __instancecheck__(cls, one: Any) -> bool:
        return isinstance(one, Recording) and one.dim == 3


if TYPE_CHECKING:
    SpatialRecording: TypeAlias = Recording[SpatialOdometry | None, SpatialDetections]
    """A recording in space; one in the plane is a `Recording`."""
else:

    class SpatialRecording(metaclass=_InSpace):
        """Old name of a `Recording` in space, for code that makes or recognises one by it."""

        def __new__(cls, *args: Any, **given: Any) -> Recording:
            """Return a `Recording`; arguments by position as they were."""
            names = (
                "name", "odometry", "frames", "detections", "sensors", "truth", "true_landmarks", "class_names",
                "warnings", "source", "clock", "landmark_names", "symmetries", "robot", "measurements",
            )  # fmt: skip
            return Recording(**dict(zip(names, args, strict=False)), **given)


AnyRecording = Recording | SpatialRecording
"""A session in the plane or in space."""
AnyRecordingT = TypeVar("AnyRecordingT", Recording, SpatialRecording)
"""What comes back as it was given."""


@dataclass(frozen=True, slots=True)
class ParameterEstimate(Shown):
    """One calibration state or noise level with prior and estimate.

    Attributes:
        name: e.g. 'odometry_delay_s', 'range_bias_m', 'sigma_range_m'.
        value, sigma: estimate and standard deviation (0 where fixed).
        prior_mean, prior_sigma: the weak prior; nan where there is none.
        unit: 's', 'm', 'rad', '1' ...
        fixed: True where it was held: by the configuration, or because it is not needed.
        meaning: half a sentence for the report.
        p_needed: probability that it is another than stated, by which it is estimated; nan where that is not asked.
        alone: value if it were the only one of two errors that only show together; nan of others.
        shown_with: name of the other one; '' without.
        decided_by: keys of `sensor.toml` that divide what both show.
        evident: whether the readings say that one of the two is another than stated.
    """

    name: str
    value: float
    sigma: float
    prior_mean: float
    prior_sigma: float
    unit: str
    fixed: bool = False
    meaning: str = ""
    p_needed: float = float("nan")
    alone: float = float("nan")
    shown_with: str = ""
    decided_by: tuple[str, ...] = ()
    evident: bool = False


class Undecided(NamedTuple):
    """Two errors of which a recording only shows what they are together."""

    one: ParameterEstimate
    other: ParameterEstimate

    @property
    def text(self) -> str:
        """Return both readings in one line, with what decides between them."""
        alone = " or ".join(f"{each.name} = {each.alone:.4g}" for each in self)
        assumed = ", ".join(f"{each.name} = {each.value:.4g}" for each in self)
        decide = " or ".join(self.one.decided_by)
        return f"either {alone}, which this recording cannot tell (assumed: {assumed}); state {decide} in sensor.toml"


@dataclass(frozen=True, slots=True)
class Innovations(_Columns):
    """Innovations of detections before their use: one row per detection with a prediction.

    Attributes:
        stamp_s: (K,) frame stamps.
        detection: (K,) row of `Recording.detections`.
        landmark_id: (K,) landmark it was compared with.
        nis: (K,) squared Mahalanobis distance of the innovation, chi-square with `dof` degrees of freedom if honest.
        p_inlier: (K,) final probability that it is not an outlier, after smoothing.
        dof: (K,) numbers that each detection measured; None where all measured two, as in the plane.
    """

    stamp_s: FloatArray
    detection: IntArray
    landmark_id: IntArray
    nis: FloatArray
    p_inlier: FloatArray
    dof: IntArray | None = None


@dataclass(frozen=True, slots=True)
class AssociationEvidence(Shown):
    """What speaks for the landmarks that detections without identities were given; it needs no truth.

    Attributes:
        dropped: share of the detections that are of no landmark.
        n_landmarks: landmarks that were kept.
        n_alone: landmarks by odometry alone, each visit counted; -1 where it was not asked, as in space.
        n_closures: visits of landmarks that had been visited before; -1 where it was not asked.
        closure_nats: by how much these raise the negative log likelihood of the optimum: by one each, on average, if
            all are right.
        lead_nats: log evidence over odometry alone, where no landmark is met again; negative if that explains more.
    """

    dropped: float
    n_landmarks: int
    n_alone: int = -1
    n_closures: int = -1
    closure_nats: float = math.nan
    lead_nats: float = math.nan

    @property
    def nats_per_closure(self) -> float:
        """Return the rise of the negative log likelihood by each landmark that was met again; nan if none was."""
        return self.closure_nats / self.n_closures if self.n_closures > 0 else math.nan


class ChangeKind(StrEnum):
    """Kind of a change of a group of landmarks."""

    MOVED = "moved"
    """All members by the same displacement."""
    ROTATED = "rotated"
    """Like a rigid body: turned about their centroid, and moved."""
    SWAPPED = "swapped"
    """Two landmarks carry each other's identity."""
    APPEARED = "appeared"
    """Never seen before, in a place that had been looked at."""
    VANISHED = "vanished"
    """Not where the map has it, and nowhere else."""
    RETURNED = "returned"
    """It had vanished before; its displacement says whether to the place it had left."""
    REPLACED = "replaced"
    """Without identities: another one stands where one stood; or, with the rest of the probability, it is the same."""


@dataclass(frozen=True, slots=True)
class MapChange(Shown):
    """A difference between world and map: a change of a group of landmarks.

    Attributes:
        landmark_ids: the group, sorted; of a replacement those that stood there, then those that took their place.
        kind: kind of the change.
        stamp_from_s, stamp_to_s: it happened between these two; nan and the first stamp for 'before the session'.
        displacement_m: (x, y), in space (x, y, z), of the group's centroid, in the map's frame; nan where it was not,
            or is not, there.
        rotation_rad: about the centroid, counter-clockwise, in space about any axis; 0 where it did not turn.
        probability: of this very group at this time, over all hypotheses that were weighed.
        n_hits, n_misses: detections at the new place, and expected detections at the old one that did not come: in a
            living map misses count by how probably their lines of sight were clear.
        names: what the landmarks are called, if that is not their numbers; see `labels`.
        displacement_covariance_m2: in a living map rows of the covariance of `displacement_m`, by the joint Gaussian of
            both places, with that of the map's metre; () where it is not known.
    """

    landmark_ids: tuple[int, ...]
    kind: ChangeKind
    stamp_from_s: float
    stamp_to_s: float
    displacement_m: tuple[float, ...]
    rotation_rad: float
    probability: float
    n_hits: int = 0
    n_misses: int = 0
    names: tuple[str, ...] = field(default=(), compare=False)
    displacement_covariance_m2: tuple[tuple[float, ...], ...] = ()

    @property
    def displacement_sigma_m(self) -> float:
        """Standard deviation of its displacement along an axis, the root of their mean variance; nan if unknown."""
        spread = self.displacement_covariance_m2
        return math.sqrt(sum(row[k] for k, row in enumerate(spread)) / len(spread)) if spread else math.nan

    def named(self, names: Mapping[int, str]) -> MapChange:
        """Return the same with what its landmarks are called, where that is not their numbers."""
        labels = tuple(landmark_label(identity, names) for identity in self.landmark_ids)
        return self if labels == tuple(map(str, self.landmark_ids)) else replace(self, names=labels)

    @property
    def labels(self) -> tuple[str, ...]:
        """Return what its landmarks are called: their names, or their numbers."""
        return self.names or tuple(landmark_label(identity, {}) for identity in self.landmark_ids)


@dataclass(frozen=True, slots=True)
class Alternative(Shown):
    """Another explanation that the recording cannot rule out.

    Attributes:
        changes: what would have happened instead.
        probability: its weight among all hypotheses.
        landmarks: the map as it would be then.
    """

    changes: tuple[MapChange, ...]
    probability: float
    landmarks: Landmarks


class VerdictKind(StrEnum):
    """What a run ends with; it needs no truth."""

    SOUND = "sound"
    """Poses and landmarks are as certain as their covariances say."""
    WEAK = "weak"
    """Right as far as it goes, but something that matters can't be known from this recording."""
    LOST = "lost"
    """Poses or landmarks can't be trusted, and no cause was found."""
    MAP_OUTDATED = "map outdated"
    """Too much of the given map is wrong to localise in, or it is the map of another site, frame or edition."""
    SENSOR_SUSPECT = "sensor suspect"
    """A sensor, or the odometry, is not as stated: units, scale, size, clock, mount, axes, lens."""

    @property
    def is_trustworthy(self) -> bool:
        """Whether a run that ends so may be used as it is: exit code 0, else 3."""
        return self in (VerdictKind.SOUND, VerdictKind.WEAK)


@dataclass(frozen=True, slots=True)
class Symptom(Shown):
    """A sign, which needs no truth, of how far a run can be trusted.

    Attributes:
        code: stable name, such as `innovations`.
        message: one line, with numbers and units.
        value: what was measured.
        least, most: between which it is where all is well.
    """

    code: str
    message: str
    value: float
    least: float = -math.inf
    most: float = math.inf

    @property
    def is_alarming(self) -> bool:
        """Whether the value is where it should not be."""
        return not self.least <= self.value <= self.most


@dataclass(frozen=True, slots=True)
class Cause(Shown):
    """A cause other than a change of a landmark by which a recording contradicts what was stated.

    Attributes:
        code: stable name of the kind of cause, such as `tag-size` or `clock`.
        subject: what it is of: a sensor, a class, an identity, the odometry, the map; '' where there is one only.
        message: one line that a user understands, with value and unit.
        value, sigma: of the state that it frees, in the unit that `message` names; nan where there is none.
        probability: among all that was weighed.
        fix: the line of `sensor.toml`, or the option, that mends it; '' where there is none.
        nats: by how much it raises the log evidence of the recording, its price paid.
        instead: messages of the most probable explanation without it; '' where that is nothing.
    """

    code: str
    subject: str
    message: str
    value: float = math.nan
    sigma: float = math.nan
    probability: float = math.nan
    fix: str = ""
    nats: float = math.nan
    instead: str = ""


@dataclass(frozen=True, slots=True)
class Verdict(Shown):
    """What a run ends with: how far it can be trusted, and why.

    Attributes:
        kind: one of five words.
        message: one line: the reason, and what would decide it or mend it.
        symptoms: all that was asked, the alarming ones first.
        causes: those that were found, the most probable first.
    """

    kind: VerdictKind
    message: str
    symptoms: tuple[Symptom, ...] = ()
    causes: tuple[Cause, ...] = ()

    @property
    def text(self) -> str:
        """Return it in one line: 'lost: ...'."""
        return f"{self.kind}: {self.message}"


@dataclass(frozen=True, slots=True)
class SlamResult(Shown):
    """All estimates of a run.

    Attributes:
        trajectory: smoothed poses at every frame that has one, and in between where the gap is long.
        online: causal poses, one per frame; none in the plane unless `slam.online` asks for them.
        landmarks: the map.
        parameters: calibration states and noise levels.
        innovations: consistency of every detection.
        misses: expected and not detected.
        step_s: (N,) processing time of every frame; of frames that were solved together, the share of each.
        dead_reckoning: odometry alone from the first pose, at the stamps of `trajectory`.
        warnings: counted remarks of the estimator.
        interrupted: True where the run was stopped before the end of the recording.
        changes: how the world differs from the map that was given, or changed during the run.
        alternatives: other explanations nearly as probable as `changes`, the most probable first.
        gone: landmarks that the map knows but does not believe to be there.
        followed: what moved while it was looked at, a `evermap.tracking.run.TrackResult`; None where nothing was
            followed.
        causes: what other than changes of landmarks the recording was found to have.
        verdict: how far all this can be trusted; None where nobody asked.
        association: what speaks for the identities that were found; None where they were given.
    """

    trajectory: Trajectory
    online: Trajectory
    landmarks: Landmarks
    parameters: tuple[ParameterEstimate, ...]
    innovations: Innovations
    misses: Misses
    step_s: FloatArray
    dead_reckoning: Trajectory
    warnings: tuple[str, ...] = ()
    interrupted: bool = False
    changes: tuple[MapChange, ...] = ()
    alternatives: tuple[Alternative, ...] = ()
    gone: Landmarks = field(default_factory=lambda: Landmarks.at([], np.zeros((0, 2))))
    followed: Any = None
    causes: tuple[Cause, ...] = ()
    verdict: Verdict | None = None
    association: AssociationEvidence | None = None

    @property
    def undecided(self) -> tuple[Undecided, ...]:
        """Return errors that only show together, where the readings say that one is another than stated."""
        by_name = {one.name: one for one in self.parameters}
        pairs = [(one, by_name[one.shown_with]) for one in self.parameters if one.shown_with in by_name]
        return tuple(Undecided(*pair) for pair in pairs if pair[0].name < pair[1].name and pair[0].evident)

    def _facts(self) -> dict[str, Any]:
        return {
            **self.trajectory._facts(),
            "landmarks": len(self.landmarks),
            "parameters": len(self.parameters),
            "innovations": len(self.innovations),
            "misses": len(self.misses),
            "changes": len(self.changes),
            "alternatives": len(self.alternatives),
            "warnings": len(self.warnings),
            "interrupted": self.interrupted,
        }

    def plot(self, recording: AnyRecording | None = None) -> Figure:
        """Draw path and map; with its recording also the truth and the detections. Returns a matplotlib figure."""
        return draw("plot_result", self, recording)


def json_number(value: Any) -> float | None:
    """Return a number as JSON has it: a finite float; None for nan, infinity and None."""
    number = or_nan(value)
    return number if math.isfinite(number) else None


def or_nan(value: Any) -> float:
    """Return a number from JSON; nan for null."""
    return math.nan if value is None else float(value)


_Table = TypeVar("_Table", bound="DataclassInstance")


def rows_of(table: _Table, rows: IntArray | BoolArray) -> _Table:
    """Return some rows of a table of columns, by number, in that order, or by a mask; other fields are kept."""
    columns = {item.name: getattr(table, item.name) for item in fields(table)}
    some: dict[str, Any] = {name: column[rows] for name, column in columns.items() if isinstance(column, np.ndarray)}
    return replace(table, **some)


_DAY_S = 86_400


def stamp_text(stamp_s: float, clock: Clock) -> str:
    """Return '2026-11-21 14:20:05', or 'day 3 04:05:06' since the start of a recording's own clock; '-' for no
    stamp.
    """
    if not math.isfinite(stamp_s):
        return "-"
    if clock is not Clock.RECORDING:
        try:
            return datetime.fromtimestamp(round(stamp_s), UTC).strftime("%Y-%m-%d %H:%M:%S")
        except (OverflowError, ValueError, OSError):  # no date of the calendar
            return f"{stamp_s:g} s"
    days, seconds = divmod(round(stamp_s), _DAY_S)
    time = f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
    return f"day {days} {time}" if days else time


def between_text(from_s: float, to_s: float, clock: Clock) -> str:
    """Return 'between A and B'; 'before B' without an earlier look."""
    late = stamp_text(to_s, clock)
    early = stamp_text(from_s, clock)
    if early == "-":
        return f"before {late}"
    if early == late:
        return f"at {late}"
    same_day = early.rpartition(" ")[0] == late.rpartition(" ")[0] and " " in late
    return f"between {early} and {late.rpartition(' ')[2] if same_day else late}"
