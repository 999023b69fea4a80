"""Sensors of a recording in space: `sensor.toml`, and `camera.toml` where there are cameras or several sensors."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf, nan, pi
from typing import Any

import numpy as np

from evermap.errors import suggestion
from evermap.geometry import se3
from evermap.geometry.symmetry import HINT, Symmetry
from evermap.io.files import FileSet
from evermap.io.sensor_toml import UNKNOWN_KIND, Settings, TomlReader, recording_section, toml_string, toml_text
from evermap.io.spatial import AT, QUATERNION
from evermap.types import NOT_IN_SPACE, FloatArray, IntArray, Sensor, SensorKind, SpatialSensor, landmark_id_of
from evermap.valid import CAMERA_MODELS

SENSOR_FILE = "sensor.toml"
CAMERA_FILE = "camera.toml"

_LIMITS: dict[str, dict[str, tuple[float, float]]] = {
    "limits": {"range_min_m": (0.0, 1e6), "range_max_m": (0.0, inf)},
    "noise": {"sigma_m": (1e-9, 1e6), "sigma_rad": (1e-9, 1e3), "sigma_px": (1e-6, 1e4)},
    "detection": {"p_detect": (0.0, 1.0), "p_false": (0.0, 1.0)},
    "sensor": {"sigma_scale": (0.0, 1.0), "sigma_angle_rad": (0.0, 2 * pi), "sigma_position_m": (0.0, 1e3)},
    "odometry": {"sigma_odometer_scale": (0.0, 1.0)},
}
"""Sections of `sensor.toml`; their keys are valid for a camera, too, but for that of the odometry."""
_OF_CAMERA = {key: limits for name, keys in _LIMITS.items() if name != "odometry" for key, limits in keys.items()}
_LENGTH = (1e-4, 1e3)
_ANGLES = ("roll_rad", "pitch_rad", "yaw_rad")
_BARE = re.compile(r"[A-Za-z0-9_-]+")
"""Names that need no quotation marks in TOML."""
_MOUNT = (*AT, *QUATERNION, *_ANGLES)
_CAMERA = ("model", "intrinsics", "distortion", "resolution_px", "baseline_m", "mount", "kind", *_OF_CAMERA)


@dataclass(frozen=True, slots=True)
class Rig:
    """The sensors of a recording in space, and the sizes of its tags.

    Attributes:
        settings: name, clock and the like.
        sensors: at least one.
        baseline_m: of each sensor that is the left camera of a rectified stereo pair, else nan.
        tag_size_m: edge of tags whose size is not listed; nan where it is not known.
        tag_sizes: edges of single tags, by id.
        symmetries: turns after which objects look the same, by class; as of `SpatialRecording`.
    """

    settings: Settings = field(default_factory=Settings)
    sensors: tuple[SpatialSensor, ...] = (SpatialSensor(),)
    baseline_m: tuple[float, ...] = (nan,)
    tag_size_m: float = nan
    tag_sizes: Mapping[int, float] = field(default_factory=dict)
    symmetries: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def size_of(self, landmark_id: IntArray) -> FloatArray:
        """Return the edge of each tag (M,), nan where it is not known."""
        sizes = [self.tag_sizes.get(identity, self.tag_size_m) for identity in landmark_id.tolist()]
        return np.array(sizes, dtype=np.float64)


def read_rig(files: FileSet, warnings: list[str]) -> Rig:
    """Return the sensors that the files of a recording describe; without any, one at the robot's centre.

    Raises:
        InputError: not TOML, an unknown section or key, a value of the wrong type or out of its limits.
    """
    settings, common, symmetries = Settings(), SpatialSensor(), dict[str, tuple[str, ...]]()
    if SENSOR_FILE in files:
        reader = TomlReader(files.read(SENSOR_FILE), files.path_of(SENSOR_FILE))
        reader.expect(("recording", "mount", "symmetries", *_LIMITS), reader.document, section=None)
        settings = reader.recording(Sensor())
        symmetries = _symmetries(reader, settings.class_names)
        values: dict[str, Any] = {}
        for section, keys in _LIMITS.items():
            known = ("kind", *keys) if section == "sensor" else tuple(keys)
            content = _check_keys(reader, section, reader.document.get(section, {}), known)
            values |= reader.limited(section, content, keys)
        values["kind"] = reader.choice("sensor", "kind", SensorKind, UNKNOWN_KIND)
        mount = _mount(reader, "mount", reader.section("mount", _MOUNT))
        common = replace(common, mount_robot_sensor=mount, **values)
        reader.check_order("limits", common, "range_min_m", "range_max_m")
    if CAMERA_FILE not in files:
        if SENSOR_FILE not in files:
            warnings.append(
                f"no {SENSOR_FILE}: the sensor is assumed to see in all directions, from the robot's centre"
            )
        return Rig(settings, (common,), symmetries=symmetries)
    reader = TomlReader(files.read(CAMERA_FILE), files.path_of(CAMERA_FILE))
    reader.expect(("camera", "tags"), reader.document, section=None)
    rig = cameras(reader, settings, common)
    return replace(rig, symmetries=symmetries)


def rig_toml(
    sensors: Sequence[SpatialSensor], settings: Settings, symmetries: Mapping[str, tuple[str, ...]]
) -> dict[str, str]:
    """Return the texts of the files, by name, from which `read_rig` makes sensors, settings and symmetries again."""
    about = recording_section(settings)
    sections: dict[str, dict[str, Any]] = {}
    for sensor in sensors:
        is_camera = sensor.intrinsics is not None
        section = f"camera.{_key(sensor.name)}"
        sections[section] = {
            "model": sensor.distortion_model if is_camera else None,
            "intrinsics": None if sensor.intrinsics is None else tuple(map(float, sensor.intrinsics)),
            "distortion": tuple(map(float, sensor.distortion)) or None,
            "resolution_px": sensor.resolution_px,
            **{key: getattr(sensor, key) for key in ("kind", *_OF_CAMERA)},
        }
        pose = map(float, sensor.mount_robot_sensor)
        sections[f"{section}.mount"] = dict(zip((*AT, *QUATERNION), pose, strict=True))
    odometer = {"sigma_odometer_scale": sensors[0].sigma_odometer_scale}
    alike = {_key(name): texts for name, texts in symmetries.items()}
    common = {"recording": about, "odometry": odometer, "symmetries": alike}
    return {SENSOR_FILE: toml_text(common), CAMERA_FILE: toml_text(sections)}


def _key(name: str) -> str:
    """A name as a key of TOML."""
    return name if _BARE.fullmatch(name) else toml_string(name)


def cameras(reader: TomlReader, settings: Settings, common: SpatialSensor, also: tuple[str, ...] = ()) -> Rig:
    """Return the sensors in the sections `[camera.NAME]` of a document, and what its section `[tags]` says.

    `common` holds for all sensors; `also` are further keys that a section may have.

    Raises:
        InputError: a key is unknown, or its value of the wrong type or out of its limits.
    """
    listed = reader.document.get("camera", {})
    if not isinstance(listed, dict) or not listed or not all(isinstance(c, dict) for c in listed.values()):
        raise reader.error(None, "camera", "there is no camera", hint="[camera.NAME] with model and intrinsics")
    sensors, baselines = [], []
    for name, content in listed.items():
        section = f"camera.{name}"
        _check_keys(reader, section, content, (*_CAMERA, *also))
        values: dict[str, Any] = reader.limited(section, content, _OF_CAMERA)
        if "mount" in content:
            inner = f"{section}.mount"
            values["mount_robot_sensor"] = _mount(reader, inner, reader.checked(inner, content["mount"], _MOUNT))
        if "kind" in content:
            values["kind"] = reader.choice(section, "kind", SensorKind, UNKNOWN_KIND, content)
        values |= _lens(reader, section, content)
        sensor = replace(common, name=name, **values)
        reader.check_order(section, sensor, "range_min_m", "range_max_m")
        sensors.append(sensor)
        baselines.append(reader.limited(section, content, {"baseline_m": _LENGTH}).get("baseline_m", nan))
    size_m, sizes = _tags(reader)
    return Rig(settings, tuple(sensors), tuple(baselines), size_m, sizes)


def _check_keys(reader: TomlReader, section: str, content: Any, known: tuple[str, ...]) -> dict[str, Any]:
    """Return a section without unknown keys; one that is known in the plane only gets its own hint."""
    for key in content if isinstance(content, dict) else ():
        if key in NOT_IN_SPACE and key not in known:
            raise reader.error(section, key, "is not used in space", NOT_IN_SPACE[key])
    return reader.checked(section, content, known)


def _lens(reader: TomlReader, section: str, content: dict[str, Any]) -> dict[str, Any]:
    """How a camera projects; nothing for a sensor that is no camera."""
    if "intrinsics" not in content:
        hint = "intrinsics = [fx, fy, cx, cy] in pixels"
        for key in ("model", "distortion", "baseline_m"):
            if key in content:
                raise reader.error(section, key, "needs intrinsics, too", hint)
        return {}
    intrinsics = reader.numbers(section, "intrinsics", content["intrinsics"], (4,))
    if min(intrinsics[:2]) <= 0.0:
        raise reader.error(section, "intrinsics", "focal lengths must be positive", hint="[fx, fy, cx, cy] in pixels")
    model = content.get("model", "pinhole")
    if model not in CAMERA_MODELS:
        hint = "one of " + ", ".join(CAMERA_MODELS)
        raise reader.error(section, "model", f"unknown camera model '{model}'", hint)
    distortion = reader.numbers(section, "distortion", content.get("distortion", []), (0, *CAMERA_MODELS[model]))
    found: dict[str, Any] = {"intrinsics": intrinsics, "distortion": distortion, "distortion_model": model}
    if "resolution_px" in content:
        width, height = reader.numbers(section, "resolution_px", content["resolution_px"], (2,))
        found["resolution_px"] = (int(width), int(height))
    return found


def _mount(reader: TomlReader, section: str, content: dict[str, Any]) -> tuple[float, ...]:
    """A pose from x, y, z and a quaternion, or roll, pitch and yaw (about x, then y, then z, of the robot)."""
    at = [reader.number(section, key, content.get(key, 0.0), -1e3, 1e3) for key in AT]
    if any(key in content for key in QUATERNION):
        for key in QUATERNION:
            if key not in content or any(angle in content for angle in _ANGLES):
                raise reader.error(section, key, "an orientation is all of qx, qy, qz, qw, or roll, pitch and yaw")
        quaternion = np.array([reader.number(section, key, content[key], -2.0, 2.0) for key in QUATERNION])
        if abs(np.linalg.norm(quaternion) - 1.0) > 1e-2:
            raise reader.error(section, "qw", "qx, qy, qz, qw are not a unit quaternion", hint="scalar last")
        return tuple(se3.normalise_poses(np.concatenate([at, quaternion])).tolist())
    turns = [reader.number(section, key, content.get(key, 0.0), -2 * pi, 2 * pi) for key in _ANGLES]
    return (*at, *se3.from_angles(turns)[3:].tolist())


def _tags(reader: TomlReader) -> tuple[float, dict[int, float]]:
    content = reader.section("tags", ("size_m", "sizes"))
    size_m = reader.limited("tags", content, {"size_m": _LENGTH}).get("size_m", nan)
    sizes = content.get("sizes", {})
    if not isinstance(sizes, dict):
        raise reader.error("tags", "sizes", "must be a section", hint="[tags.sizes] with lines such as 17 = 0.2")
    return size_m, {
        int(name) if name.isdecimal() else landmark_id_of(name): reader.number("tags.sizes", name, size, *_LENGTH)
        for name, size in sizes.items()
    }


def _symmetries(reader: TomlReader, class_names: tuple[str, ...] | None) -> dict[str, tuple[str, ...]]:
    content, found = reader.document.get("symmetries", {}), {}
    if not isinstance(content, dict):
        raise reader.error(None, "symmetries", "must be a section", hint="[symmetries]")
    for name, said in content.items():
        if class_names is not None and name not in class_names:
            raise reader.error("symmetries", name, "not one of class_names", hint=suggestion(name, class_names))
        texts = tuple(said) if isinstance(said, list) else (said,)
        if not texts or not all(isinstance(text, str) for text in texts):
            raise reader.error("symmetries", name, "must be a text, or a list of texts", hint=HINT)
        try:
            Symmetry.generate_group(texts)
        except ValueError as error:
            raise reader.error("symmetries", name, str(error), hint=HINT) from None
        found[name] = texts
    return found
