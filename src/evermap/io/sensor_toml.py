"""`sensor.toml` of a native recording: the sensor's limits, noise and mounting, and what the stamps count."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import inf, pi
from pathlib import Path
from typing import Any, TypeVar

from evermap.errors import InputError, suggestion
from evermap.io.text import decode_text, reason
from evermap.types import Clock, Sensor, SensorKind, SpatialSensor

FORMAT_VERSION = 1
UNKNOWN_KIND = "unknown kind of sensor"
_Choice = TypeVar("_Choice", bound=StrEnum)

# sections and keys with their limits; those of all but the mount are fields of `Sensor`
_LIMITS: dict[str, dict[str, tuple[float, float]]] = {
    "limits": {
        "range_min_m": (0.0, 1e6),
        "range_max_m": (0.0, inf),
        "bearing_min_rad": (-2 * pi, 2 * pi),
        "bearing_max_rad": (-2 * pi, 2 * pi),
    },
    "noise": {"sigma_range_m": (1e-9, 1e6), "sigma_bearing_rad": (1e-9, 1e3)},
    "mount": {"x_m": (-1e3, 1e3), "y_m": (-1e3, 1e3), "theta_rad": (-2 * pi, 2 * pi)},
    "detection": {"p_detect": (0.0, 1.0), "p_false": (0.0, 1.0)},
    "sensor": {
        "sigma_scale": (0.0, 1.0),
        "sigma_offset_m": (0.0, 1e3),
        "sigma_angle_rad": (0.0, 2 * pi),
        "sigma_position_m": (0.0, 1e3),
    },
    "odometry": {"sigma_odometer_scale": (0.0, 1.0), "sigma_askew_rad": (0.0, 2 * pi)},
}
_OTHERS = {"sensor": ("kind",), "odometry": ("measured",)}
"""Keys that are no numbers."""
_RECORDING = ("format_version", "name", "robot", "clock", "frames_complete", "class_names")


@dataclass(frozen=True, slots=True)
class Settings:
    """Content of `sensor.toml`; None where the file says nothing."""

    name: str | None = None
    robot: str = ""
    clock: Clock = Clock.RECORDING
    frames_complete: bool | None = None
    class_names: tuple[str, ...] | None = None
    sensor: Sensor = field(default_factory=Sensor)
    is_measured: bool | None = None


def parse_sensor_toml(data: bytes, path: Path) -> Settings:
    """Return settings of a recording; every section and key may be left out.

    Raises:
        InputError: not TOML, an unknown section or key, a value of the wrong type or out of its limits.
    """
    reader = TomlReader(data, path)
    reader.expect(("recording", *_LIMITS), reader.document, section=None)
    values: dict[str, dict[str, float]] = {}
    for section, keys in _LIMITS.items():
        content = reader.section(section, (*_OTHERS.get(section, ()), *keys))
        values[section] = reader.limited(section, content, keys)
    measured = reader.document.get("odometry", {}).get("measured")
    if not isinstance(measured, bool | None):
        raise reader.error("odometry", "measured", f"must be a bool, not {type(measured).__name__}")
    return replace(reader.recording(_sensor(values, reader)), is_measured=measured)


def sensor_toml(settings: Settings) -> str:
    """Return the text of a `sensor.toml` that reads back as `settings`."""
    sensor = settings.sensor
    sections: dict[str, dict[str, Any]] = {
        "recording": recording_section(settings),
        **{name: {key: getattr(sensor, key, None) for key in keys} for name, keys in _LIMITS.items()},
        "sensor": {key: getattr(sensor, key) for key in ("kind", *_LIMITS["sensor"])},
        "mount": dict(zip(_LIMITS["mount"], sensor.mount_robot_sensor, strict=True)),
    }
    sections["odometry"]["measured"] = settings.is_measured
    return toml_text(sections)


def recording_section(settings: Settings) -> dict[str, Any]:
    """Return the section `[recording]`."""
    return {
        "format_version": FORMAT_VERSION,
        "name": settings.name,
        "robot": settings.robot or None,
        "clock": settings.clock.value,
        "frames_complete": settings.frames_complete,
        "class_names": settings.class_names or None,
    }


def toml_text(sections: dict[str, dict[str, Any]]) -> str:
    """Return the sections of a TOML file without values of None and without empty sections."""
    blocks = []
    for name, content in sections.items():
        lines = [f"{key} = {_toml_value(value)}" for key, value in content.items() if value is not None]
        if lines:
            blocks.append("\n".join([f"[{name}]", *lines]) + "\n")
    return "\n".join(blocks)


def _sensor(values: dict[str, dict[str, float]], reader: TomlReader) -> Sensor:
    mount = values.pop("mount")
    x_m, y_m, theta_rad = (mount.get(key, 0.0) for key in _LIMITS["mount"])
    numbers: dict[str, Any] = {k: v for part in values.values() for k, v in part.items()}
    kind = reader.choice("sensor", "kind", SensorKind, UNKNOWN_KIND)
    sensor = Sensor(**numbers, kind=kind, mount_robot_sensor=(x_m, y_m, theta_rad))
    reader.check_order("limits", sensor, "range_min_m", "range_max_m")
    reader.check_order("limits", sensor, "bearing_min_rad", "bearing_max_rad")
    return sensor


class TomlReader:
    """Checked access to a parsed document, with line numbers for the messages."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.path, self.text = path, decode_text(data, path)
        try:
            self.document: dict[str, Any] = tomllib.loads(self.text)
        except (ValueError, RecursionError) as error:
            line = getattr(error, "lineno", None)  # of Python 3.14; before, only the message tells
            raise InputError(f"not valid TOML: {reason(error)}", path=path, line=line) from None

    def error(self, section: str | None, key: str, problem: str, hint: str | None = None) -> InputError:
        name = f"{section}.{key}" if section else key
        return InputError(problem, path=self.path, line=self._line(section, key), field=name, hint=hint)

    def expect(self, known: tuple[str, ...], content: dict[str, Any], section: str | None) -> None:
        for key in content:
            if key not in known:
                problem = "unknown key" if section else "unknown section or key"
                raise self.error(section, key, problem, suggestion(key, known))

    def section(self, name: str, known: tuple[str, ...]) -> dict[str, Any]:
        return self.checked(name, self.document.get(name, {}), known)

    def checked(self, name: str, content: Any, known: tuple[str, ...]) -> dict[str, Any]:
        if not isinstance(content, dict):
            raise self.error(None, name, "must be a section", hint=f"[{name}]")
        self.expect(known, content, name)
        return content

    def number(self, section: str, key: str, value: Any, low: float, high: float) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(section, key, f"must be a number, not {type(value).__name__}")
        try:
            number = float(value)
        except OverflowError:
            number = inf
        if not low <= number <= high:  # also refuses nan
            hint = "angles in radians" if key.endswith("_rad") else None
            raise self.error(section, key, f"{number:g} is outside [{low:g}, {high:g}]", hint)
        return number

    def limited(
        self, section: str, content: Mapping[str, Any], limits: Mapping[str, tuple[float, float]]
    ) -> dict[str, float]:
        """Return the keys of a section that have limits, as far as it has them."""
        return {key: self.number(section, key, content[key], *limits[key]) for key in limits if key in content}

    def check_order(self, section: str, sensor: Sensor | SpatialSensor, low: str, high: str) -> None:
        """Raise InputError unless one limit of a sensor is below another."""
        if getattr(sensor, low) >= getattr(sensor, high):
            raise self.error(section, high, f"must be greater than {low}")

    def numbers(self, section: str, key: str, value: Any, counts: tuple[int, ...]) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) not in counts:
            wanted = " or ".join(map(str, counts))
            raise self.error(section, key, f"must be a list of {wanted} numbers")
        return tuple(self.number(section, key, item, -1e9, 1e9) for item in value)

    def choice(
        self, section: str, key: str, among: type[_Choice], problem: str, content: dict[str, Any] | None = None
    ) -> _Choice | None:
        value = (self.document.get(section, {}) if content is None else content).get(key)
        if value is None:
            return None
        if value not in list(among):
            hint = suggestion(str(value), list(among)) or "one of " + ", ".join(among)
            raise self.error(section, key, f"{problem} '{value}'", hint)
        return among(value)

    def recording(self, sensor: Sensor) -> Settings:
        content = self.section("recording", _RECORDING)
        types: dict[str, type] = {
            "format_version": int, "name": str, "robot": str, "clock": str, "frames_complete": bool,
            "class_names": list,
        }  # fmt: skip
        for key, value in content.items():
            if not isinstance(value, types[key]):
                raise self.error("recording", key, f"must be a {types[key].__name__}, not {type(value).__name__}")
        if content.get("format_version", FORMAT_VERSION) != FORMAT_VERSION:
            problem = f"{content['format_version']} is not the version that this evermap reads, {FORMAT_VERSION}"
            raise self.error("recording", "format_version", problem, hint="a newer evermap")
        names = content.get("class_names")
        if names is not None and not all(isinstance(name, str) and name.strip() == name and name for name in names):
            raise self.error("recording", "class_names", "must be a list of names")
        if names is not None and len(set(names)) != len(names):
            raise self.error("recording", "class_names", "a name appears twice")
        return Settings(
            name=content.get("name"),
            robot=content.get("robot", ""),
            clock=self.choice("recording", "clock", Clock, "unknown clock") or Clock.RECORDING,
            frames_complete=content.get("frames_complete"),
            class_names=None if names is None else tuple(names),
            sensor=sensor,
        )

    def _line(self, section: str | None, key: str) -> int | None:
        """Line of `key = ...` or `[key]`; None where the document is written in another style."""
        current: str | None = None
        for number, line in enumerate(self.text.split("\n"), 1):
            if match := re.match(r"\s*\[\s*([\w.-]+)\s*\]", line):
                current = match[1]
                if section is None and current == key:
                    return number
            elif current == section and re.match(rf"\s*\"?{re.escape(key)}\"?\s*=", line):
                return number
        return None


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return toml_string(value)
    if isinstance(value, tuple):
        return f"[{', '.join(_toml_value(item) for item in value)}]"
    return repr(float(value)) if isinstance(value, float) else repr(int(value))


def toml_string(value: str) -> str:
    """Return a text as TOML has it, in quotation marks."""
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    printable = "".join(c if c.isprintable() else f"\\u{ord(c):04x}" if ord(c) < 0x10000 else "?" for c in escaped)
    return f'"{printable}"'
