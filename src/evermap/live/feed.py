"""What feeds an engine and what it tells are two ends of a wire: readings come from an iterator, answers go to a call.

A recording that is replayed is such an iterator; a transport of a robot's middleware is another one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from evermap.errors import InputError
from evermap.live.engine import Engine, Numbers
from evermap.live.now import Now
from evermap.types import Recording


class Velocity(NamedTuple):
    """Odometry, as `Engine.odometry` takes it."""

    stamp_s: float
    forward_mps: float
    lateral_mps: float
    angular_radps: float


class SensorLook(NamedTuple):
    """A frame, as `Engine.detections` takes it."""

    stamp_s: float
    landmark_id: Sequence[int | str] = ()
    range_m: Numbers = ()
    bearing_rad: Numbers = ()
    class_name: Sequence[str | None] | None = None
    sigma_range_m: Numbers | None = None
    sigma_bearing_rad: Numbers | None = None


Reading = Velocity | SensorLook


def replayed(recording: Recording, *, paced: bool = False) -> Iterator[Reading]:
    """Yield the readings of a recording in the order of their stamps.

    Args:
        recording: in the plane.
        paced: as fast as they came, not at once.
    """
    odometry, seen = recording.odometry, recording.detections
    first = np.searchsorted(seen.frame, np.arange(len(recording.frames) + 1))
    velocity = np.column_stack([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps])
    stamps = np.concatenate([odometry.stamp_s, recording.frames.stamp_s])
    began_s = time.monotonic()
    for k in np.argsort(stamps, kind="stable").tolist():
        if paced:
            time.sleep(max(stamps[k] - stamps.min() - (time.monotonic() - began_s), 0.0))
        if k < len(odometry):
            yield Velocity(float(stamps[k]), *velocity[k].tolist())
            continue
        rows = slice(*first[k - len(odometry) : k - len(odometry) + 2])
        names = [recording.class_names[row] if row >= 0 else None for row in seen.class_id[rows].tolist()]
        ids = [recording.landmark_names.get(name, name) for name in seen.landmark_id[rows].tolist()]
        sigmas = seen.sigma_range_m[rows], seen.sigma_bearing_rad[rows]
        yield SensorLook(float(stamps[k]), ids, seen.range_m[rows], seen.bearing_rad[rows], names, *sigmas)


def run_live(
    engine: Engine, readings: Iterable[Reading], tell: Callable[[Now], None], refused: Callable[[str], None]
) -> None:
    """Feed an engine until the readings end, with a step after every look.

    Args:
        engine: that is fed.
        readings: as they come.
        tell: called with what is known after every look.
        refused: called with one line for a reading that is not taken; the others go on.
    """
    for reading in readings:
        try:
            if isinstance(reading, Velocity):
                engine.odometry(*reading)
                continue
            values = reading._asdict()
            engine.detections(values.pop("stamp_s"), **values)
        except InputError as error:
            refused(error.one_line())
        else:
            tell(engine.step())
