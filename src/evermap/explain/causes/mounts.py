"""What may be wrong with where sensors sit, and which way they look."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from evermap.explain.causes.suspect import RARE_P, USUAL_P, Inputs, Suspect, say_always
from evermap.geometry import se3
from evermap.slam import mistakes
from evermap.types import FloatArray, Sensor, SpatialSensor

MOUNT_M, MOUNT_RAD = 0.2, 0.3
"""Standard deviations of a mount's position and turn."""


def suspect_planar_mount(sensor: Sensor) -> Iterable[Suspect]:
    """Yield offsets and the turn of the mount of a sensor in the plane."""
    for axis, key in enumerate(("x_m", "y_m", "theta_rad")):
        unit, sigma = ("rad", MOUNT_RAD) if axis == 2 else ("m", MOUNT_M)
        yield Suspect(
            "mount", f"sensor {key}", USUAL_P, partial(_move_planar_mount, axis=axis),
            lambda s, key=key, unit=unit: f"the sensor's mount is {s:.3g} {unit} off in {key}",  # type: ignore[misc]
            lambda s, key=key, axis=axis: f"[mount] {key} = {sensor.mount_robot_sensor[axis] + s:.4g}",  # type: ignore[misc]
            sigma,
        )  # fmt: skip


def _move_planar_mount(inputs: Inputs, state: float, axis: int) -> Inputs:
    recording: Any = inputs.recording
    mount = list(recording.sensor.mount_robot_sensor)
    mount[axis] += state
    sensor = replace(recording.sensor, mount_robot_sensor=tuple(mount))
    return replace(inputs, recording=replace(recording, sensor=sensor))


def suspect_mount(row: int, sensor: SpatialSensor, *, many: bool, driven: bool) -> Iterable[Suspect]:
    """Return what may be wrong with where a sensor sits; of one sensor without odometry nothing shows."""
    if not (many or driven):
        return
    name, told = sensor.name, say_always(f"[camera.{sensor.name}.mount]")
    yield from _suspect_offsets((row,), name, f"the mount of {name} is", told)
    for mistake in mistakes.AXES:
        by = se3.turn(mistake.turned)
        yield Suspect(
            mistake.code, name, USUAL_P, partial(_change_mount, sensor=row, how=partial(turn_within, by=by)),
            say_always(f"{name}: {mistake.message}"), told,
        )  # fmt: skip
    for words, how in _FLIPS:
        yield Suspect(
            "mount-flip", name, USUAL_P if words in _OFTEN else RARE_P,
            partial(_change_mount, sensor=row, how=how), say_always(f"{name} seems {words}"), told,
        )  # fmt: skip


def suspect_all_mounts(sensors: Sequence[SpatialSensor], *, driven: bool) -> Iterable[Suspect]:
    """Return what may be wrong with all mounts at once: one driver for all is likelier than as many mistakes."""
    rows = range(len(sensors))
    for one, other in combinations(rows, 2):
        names = f"{sensors[one].name}, {sensors[other].name}"
        yield Suspect(
            "mount", names, USUAL_P, partial(_exchange_mounts, one=one, other=other),
            say_always(f"the mounts of {sensors[one].name} and {sensors[other].name} seem to be exchanged"),
            say_always(f"[camera.{sensors[one].name}.mount], [camera.{sensors[other].name}.mount]"),
        )  # fmt: skip
    if not driven:  # nothing says which way the robot looks
        return
    yield from _suspect_offsets(rows, "all sensors", "mounts of all sensors are", say_always("[camera.*.mount]"))
    turned: list[tuple[str, str, Callable[[FloatArray], FloatArray], float]] = [
        (each.code, each.message, partial(turn_within, by=se3.turn(each.turned)), USUAL_P) for each in mistakes.AXES
    ]
    flipped = [
        ("mount-flip", f"all sensors seem {words}", how, USUAL_P if words in _OFTEN else RARE_P)
        for words, how in _FLIPS
    ]
    for code, words, how, p in (*turned, *flipped):
        yield Suspect(
            code, "all sensors", p, partial(_change_mounts, sensors=rows, how=how), say_always(words),
            say_always("[camera.*.mount]"),
        )  # fmt: skip


def _suspect_offsets(rows: Sequence[int], name: str, what_is: str, fix: Callable[[float], str]) -> Iterable[Suspect]:
    """Return offsets and turns of mounts, together, along and about each axis of the robot."""
    for axis, part in enumerate(("x", "y", "z", "roll", "pitch", "yaw")):
        unit, sigma = ("rad", MOUNT_RAD) if axis > 2 else ("m", MOUNT_M)
        yield Suspect(
            "mount", f"{name} {part}", USUAL_P, partial(_move_mounts, sensors=rows, axis=axis),
            lambda s, part=part, unit=unit: f"{what_is} {s:.3g} {unit} off in {part} of the robot",  # type: ignore[misc]
            fix, sigma,
        )  # fmt: skip


def _exchange_mounts(inputs: Inputs, _: float, one: int, other: int) -> Inputs:
    recording: Any = inputs.recording
    changed = list(recording.sensors)
    for row, by in ((one, other), (other, one)):
        changed[row] = replace(changed[row], mount_robot_sensor=recording.sensors[by].mount_robot_sensor)
    return replace(inputs, recording=replace(recording, sensors=tuple(changed)))


def turn_within(pose: FloatArray, by: FloatArray) -> FloatArray:
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
