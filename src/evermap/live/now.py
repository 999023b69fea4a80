"""The output of an engine's step, and its initial recording."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evermap.errors import InputError
from evermap.live.inbox import about
from evermap.maps.living import LivingMap
from evermap.types import Clock, FloatArray, Landmarks, MapChange, Recording, Sensor, Trajectory


@dataclass(frozen=True, slots=True)
class Now:
    """Present state of the robot and its map.

    Attributes:
        stamp_s: of the newest odometry; nan before any.
        pose_world_robot: (3,) there; nan while it is not known.
        covariance: (3, 3) of it, in the robot's frame.
        frame: 'prior_map', or 'first_pose' where there is no map yet.
        lost: the pose is not known, or kept by odometry alone while it is searched for.
        online: poses of the frames that this step has processed.
        in_view: landmarks that are in view, or should be, with the probability that each exists.
        changes: what has become certain since the last step.
        revision: newest one of the map that the robot is in; 0 before any.
        warnings: what else there is to tell since the last step.
    """

    stamp_s: float
    pose_world_robot: FloatArray
    covariance: FloatArray
    frame: str
    lost: bool
    online: Trajectory
    in_view: Landmarks
    changes: tuple[MapChange, ...] = ()
    revision: int = 0
    warnings: tuple[str, ...] = ()


def trajectory_of(online: list[tuple[float, FloatArray, FloatArray]], frame: str, clock: Clock) -> Trajectory:
    """Return the poses that are known, of stamps, poses and covariances."""
    known = [one for one in online if math.isfinite(one[1][0])]
    stamps, poses, spread = zip(*known, strict=True) if known else ((), (), ())
    pose, covariance = np.array(poses).reshape(-1, 3), np.array(spread).reshape(-1, 3, 3)
    return Trajectory(np.array(stamps), pose, covariance, frame, clock)


def recording_of(sensor: object, name: str, clock: Clock, class_names: tuple[str, ...]) -> Recording:
    """Return a recording without readings, of a sensor or a `sensor.toml`.

    Raises:
        InputError: neither.
    """
    if isinstance(sensor, Sensor):
        return about(name, sensor, clock, class_names)
    if not isinstance(sensor, str | Path):
        hint = "evermap.Sensor(range_max_m=8.0), or the path of a sensor.toml"
        raise InputError(f"a Sensor is needed, not {type(sensor).__name__}", field="sensor", hint=hint)
    from evermap.io.sensor_toml import parse_sensor_toml

    path = Path(sensor)
    try:
        said = parse_sensor_toml(path.read_bytes(), path)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path, hint="a sensor.toml") from None
    return about(said.name or name, said.sensor, said.clock, said.class_names or class_names)


def check_fits(living: LivingMap, clock: Clock) -> None:
    """Raise `InputError` for a map in space, or of another clock."""
    if living.dim != 2:
        raise InputError(
            "a map in space", field="map", hint="sessions in space are solved when they end: enter_session"
        )
    if len(living.places) and living.clock != clock:
        problem = f"stamps are on the clock '{clock}', those of the map on '{living.clock}'"
        hint = f"clock = '{living.clock}' in sensor.toml, or evermap.Engine(..., clock='{living.clock}')"
        raise InputError(problem, field="clock", hint=hint)
