"""The loop around an engine: readings come from an iterator, outputs go to a callback.

A recording that is replayed is such an iterator; a transport of a robot's middleware is another one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from evermap.errors import InputError
from evermap.live.engine import Engine, Now, Numbers
from evermap.types import FloatArray, IntArray, Recording, SpatialRecording


class Velocity(NamedTuple):
    """Odometry, as `Engine.odometry` takes it."""

    stamp_s: float
    forward_mps: float
    lateral_mps: float
    angular_radps: float
    until_s: float = -math.inf


class SensorLook(NamedTuple):
    """A frame, as `Engine.detections` takes it."""

    stamp_s: float
    landmark_id: Sequence[int | str] = ()
    range_m: Numbers = ()
    bearing_rad: Numbers = ()
    class_name: Sequence[str | None] | None = None
    sigma_range_m: Numbers | None = None
    sigma_bearing_rad: Numbers | None = None


class SpatialPose(NamedTuple):
    """Odometry in space, as `Engine.odometry_in_space` takes it."""

    stamp_s: float
    pose: FloatArray


class SpatialLook(NamedTuple):
    """A frame in space, as `Engine.detections_in_space` takes it."""

    stamp_s: float
    landmark_id: Sequence[int | str]
    position_sensor_m: FloatArray
    rotation: FloatArray
    corner_px: FloatArray
    tag_size_m: FloatArray
    covariance_sensor_m2: FloatArray
    sigma_rad: FloatArray
    sensor: IntArray
    class_name: Sequence[str | None]


Reading = Velocity | SensorLook | SpatialPose | SpatialLook
_Stamped = TypeVar("_Stamped", bound=tuple[Any, ...])


def replayed(recording: Recording, *, paced: bool = False) -> Iterator[Reading | None]:
    """Yield the readings of a recording in the plane in the order of their stamps, and None after every frame.

    If `paced`, as fast as they came, not at once.
    """
    odometry, seen = recording.odometry, recording.detections
    first = np.searchsorted(seen.frame, np.arange(len(recording.frames) + 1))
    velocity = np.column_stack([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps])
    stamps = np.concatenate([odometry.stamp_s, recording.frames.stamp_s])
    order = np.argsort(stamps, kind="stable").tolist()
    for _, k in in_time(zip(stamps[order].tolist(), order, strict=True), paced=paced):
        if k < len(odometry):
            yield Velocity(float(stamps[k]), *velocity[k].tolist())
            continue
        rows = slice(*first[k - len(odometry) : k - len(odometry) + 2])
        names = [recording.class_names[row] if row >= 0 else None for row in seen.class_id[rows].tolist()]
        ids = [recording.landmark_names.get(name, name) for name in seen.landmark_id[rows].tolist()]
        sigmas = seen.sigma_range_m[rows], seen.sigma_bearing_rad[rows]
        yield SensorLook(float(stamps[k]), ids, seen.range_m[rows], seen.bearing_rad[rows], names, *sigmas)
        yield None


def replay_in_space(recording: SpatialRecording, *, paced: bool = False) -> Iterator[Reading | None]:
    """Yield the readings of a recording in space, as `replayed`."""
    odometry, seen = recording.odometry, recording.detections
    count = 0 if odometry is None else len(odometry)
    first = np.searchsorted(seen.frame, np.arange(len(recording.frames) + 1))
    stamps = np.concatenate([[] if odometry is None else odometry.stamp_s, recording.frames.stamp_s])
    order = np.argsort(stamps, kind="stable").tolist()
    for _, k in in_time(zip(stamps[order].tolist(), order, strict=True), paced=paced):
        if odometry is not None and k < count:
            yield SpatialPose(float(stamps[k]), odometry.pose_world_robot[k])
            continue
        rows = slice(*first[k - count : k - count + 2])
        names = [recording.class_names[row] if row >= 0 else None for row in seen.class_id[rows].tolist()]
        ids = [recording.landmark_names.get(name, name) for name in seen.landmark_id[rows].tolist()]
        yield SpatialLook(
            float(stamps[k]), ids, seen.position_sensor_m[rows], seen.rotation[rows], seen.corner_px[rows],
            seen.tag_size_m[rows], seen.covariance_sensor_m2[rows], seen.sigma_rad[rows], seen.sensor[rows], names,
        )  # fmt: skip
        yield None


def in_time(stamped: Iterable[_Stamped], *, paced: bool, speed: float = 1.0) -> Iterator[_Stamped]:
    """Yield what begins with a stamp [s], by their stamps, at once, or if `paced` `speed` times as fast as it came."""
    began_s, first_s = time.monotonic(), None
    for one in stamped:
        if paced:
            first_s = one[0] if first_s is None else first_s
            time.sleep(max((one[0] - first_s) / speed - (time.monotonic() - began_s), 0.0))
        yield one


def run_live(
    engine: Engine, readings: Iterable[Reading | None], tell: Callable[[Now], None], refused: Callable[[str], None]
) -> None:
    """Feed an engine until the readings end, with a step for every None among them: no other waits.

    `tell` is called with what is known after every step, `refused` with one line for a reading that is not taken.
    """
    for reading in readings:
        try:
            if reading is None:
                tell(engine.step())
            elif isinstance(reading, Velocity):
                engine.odometry(*reading)
            elif isinstance(reading, SpatialPose):
                engine.odometry_in_space(*reading)
            else:
                values = reading._asdict()
                take = engine.detections_in_space if isinstance(reading, SpatialLook) else engine.detections
                take(values.pop("stamp_s"), **values)
        except InputError as error:
            refused(error.one_line())
