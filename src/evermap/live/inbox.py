"""Incoming readings: validated, sorted by stamps, kept for the map.

A reading may come late by a window of time. A frame is given out when nothing that may still come is earlier than it,
and when the odometry is known up to it: what is later than that would change a pose that was told already.
"""

from __future__ import annotations

import threading
from bisect import bisect_left, insort
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from evermap.config import Config
from evermap.errors import InputError
from evermap.io.spatial import spatial_detections
from evermap.slam.ranges import RANGE_ONLY
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    Clock,
    Detections,
    FloatArray,
    Frames,
    IntArray,
    Odometry,
    Recording,
    Sensor,
    SpatialOdometry,
    SpatialSensor,
    landmark_id_of,
)
from evermap.valid import (
    ANGULAR_RADPS,
    BEARING_RAD,
    FORWARD_MPS,
    LATERAL_MPS,
    RANGE_M,
    SIGMA_BEARING_RAD,
    SIGMA_RANGE_M,
    STAMP_S,
)

BURST_S = 10.0
"""Time over which readings are counted against the maximum rate."""
ROOM = 1_000
"""Initial capacity for odometry rows."""


class LiveFrame(NamedTuple):
    """A look of the sensor.

    Attributes:
        stamp_s: when.
        rows: (M, 6) id, range, bearing, class, and both sigmas, nan where none is given.
    """

    stamp_s: float
    rows: FloatArray

    @property
    def landmark_id(self) -> IntArray:
        """(M,) detected landmarks."""
        return self.rows[:, 0].astype(np.int64)


class Inbox:
    """Readings fed so far. Every method may be called from any thread.

    `about` has name, sensors, clock and classes of the recording that is made of the readings; a row of odometry is a
    stamp and what is known from then on, `width` numbers.
    """

    def __init__(self, about: AnyRecording, config: Config, *, width: int = 4) -> None:
        live = config.live
        self._before_s, self._silent_s = live.clocks_s, config.slam.odometry.silence_s
        self._stray_s = config.slam.cleaning.stray_s
        self._lock = threading.Lock()
        self._about: Any = about
        self._reorder_s, self._readings_hz = live.reorder_s, live.readings_hz
        self._odometry, self._n_odometry = np.empty((width, ROOM)), 0
        self._pending: list[LiveFrame] = []
        self._kept: list[LiveFrame] = []
        self._room = live.readings_hz * BURST_S
        self.newest_s = self.odometry_s = self.settled_s = -np.inf
        """Newest stamp of all readings, of the odometry, and of the returned frames."""
        self.first_s = np.inf
        """First stamp of the odometry."""
        self._stray: tuple[float, Callable[[], None]] | None = None
        self.n_late = 0
        """Readings that came too late."""
        self._classes: list[str] = list(about.class_names)
        self._texts: dict[int, str] = dict(about.landmark_names)
        self._n_kept = self._n_written = 0

    def odometry(self, stamp_s: float, velocity: tuple[float, float, float], until_s: float = -np.inf) -> None:
        """Add velocities, forward, lateral and turn, which hold from a stamp on, until another one where that is known.

        Raises:
            InputError: no finite numbers, or the stamp is before frames that were processed.
        """
        quantities = STAMP_S, FORWARD_MPS, LATERAL_MPS, ANGULAR_RADPS
        for quantity, value in zip(quantities, (stamp_s, *velocity), strict=True):
            check_number(quantity, value)
        forward_mps, lateral_mps, angular_radps = (float(part) for part in velocity)
        row = float(stamp_s), forward_mps, lateral_mps, angular_radps
        with self._lock:
            self._refuse_late(row[0], "odometry")
            self._in_time(row[0], partial(self._put_odometry, row, float(until_s)))

    def detections(self, stamp_s: float, columns: Sequence[Any]) -> None:
        """Add a look: ids (or texts), ranges, bearings, classes by name, and both sigmas; None where not given.

        Raises:
            InputError: values that cannot be, or the stamp is before frames that were processed.
        """
        check_number(STAMP_S, stamp_s)
        frame = LiveFrame(float(stamp_s), self._rows(*columns))
        with self._lock:
            self._refuse_late(frame.stamp_s, "detections")
            self._in_time(frame.stamp_s, partial(self._put_frame, frame))

    def ready(self, delay_s: float, *, everything: bool = False) -> list[tuple[LiveFrame, FloatArray, bool]]:
        """Take out the frames before which nothing can come any more, or everything.

        Odometry is needed up to `delay_s` after a frame.

        Returns:
            LiveFrame, odometry (n, 4) from some seconds before it until the newest, and whether it is kept for the map.
        """
        found = []
        with self._lock:
            hold_s = max(self._reorder_s, delay_s)
            while self._pending:
                stamp_s = self._pending[0].stamp_s
                silent = self.newest_s >= stamp_s + hold_s + self._silent_s
                if not (everything or silent or self.odometry_s >= stamp_s + hold_s):
                    break
                frame = self._pending.pop(0)
                before_s, self.settled_s = self.settled_s, stamp_s
                window = self._window(min(stamp_s, max(before_s, self.first_s)))
                found.append((frame, window, self._keep(frame, before_s)))
        return found

    def window(self) -> FloatArray:
        """Return odometry (n, 4) of the last seconds."""
        with self._lock:
            return self._window(self.settled_s)

    def written(self, *, last: bool = False) -> Any:
        """Return what is kept, as far as nothing can come in between, the `last` time all odometry that there is; what
        was returned is kept no more.
        """
        with self._lock:
            until = self._n_odometry if last else self._odometry_until(self.settled_s, "right")
            odometry = self._odometry[:, self._n_written : until].T.copy()
            frames, self._kept, self._n_written = self._kept, [], until
            self._forget()
            classes, texts = tuple(self._classes), dict(self._texts)
        return self._record(odometry, frames, classes, texts)

    def cut(self, name: str) -> None:
        """Begin another recording after the last frame that was given out; its odometry begins some seconds before."""
        with self._lock:
            self._n_written = self._n_odometry
            self._forget()
            self._kept, self._n_kept, self._n_written = [], 0, 0
            self._about = replace(self._about, name=name)

    @property
    def class_names(self) -> tuple[str, ...]:
        """Classes so far."""
        with self._lock:
            return tuple(self._classes)

    @property
    def name(self) -> str:
        """Name of the recording."""
        return str(self._about.name)

    def __len__(self) -> int:
        """Frames of the recording so far, those that were written included."""
        return self._n_kept

    @property
    def n_bytes(self) -> int:
        """Memory of the readings, about."""
        with self._lock:
            frames = sum(one.rows.nbytes + 200 for one in (*self._kept, *self._pending))
            return frames + self._odometry.nbytes

    def _in_time(self, stamp_s: float, put: Callable[[], None]) -> None:
        """Insert a reading; one with a stamp far later than all others only after the next one confirms it."""
        before, self._stray = self._stray, None
        if stamp_s > self.newest_s + self._stray_s:  # the first one, too
            if before is None or abs(before[0] - stamp_s) > self._stray_s:
                self._stray = stamp_s, put
                return
            before[1]()
        put()
        self.newest_s = max(self.newest_s, stamp_s)

    def _put_odometry(self, row: tuple[float, ...], until_s: float) -> None:
        at, count = self._odometry_until(row[0]), self._n_odometry
        if at < count and self._odometry[0, at] == row[0]:
            return
        if count == self._odometry.shape[1]:
            self._odometry = np.hstack([self._odometry, np.empty_like(self._odometry)])
        self._odometry[:, at + 1 : count + 1] = self._odometry[:, at:count]
        self._odometry[:, at] = row
        self._n_odometry += 1
        self.first_s, self.odometry_s = min(self.first_s, row[0]), max(self.odometry_s, row[0], until_s)

    def _put_frame(self, frame: LiveFrame) -> None:
        at = bisect_left(self._pending, frame.stamp_s, key=lambda one: one.stamp_s)
        if at < len(self._pending) and self._pending[at].stamp_s == frame.stamp_s:  # two messages of one look
            frame = LiveFrame(frame.stamp_s, np.vstack([self._pending.pop(at).rows, frame.rows]))
        insort(self._pending, frame, key=lambda one: one.stamp_s)

    def _odometry_until(self, stamp_s: float, side: Literal["left", "right"] = "left") -> int:
        return int(np.searchsorted(self._odometry[0, : self._n_odometry], stamp_s, side))

    def _window(self, stamp_s: float) -> FloatArray:
        first = max(self._odometry_until(stamp_s - self._before_s) - 1, 0)
        return self._odometry[:, first : self._n_odometry].T.copy()

    def _forget(self) -> None:
        """Drop the odometry that was written and that no frame will be given out with."""
        first = min(max(self._odometry_until(self.settled_s - self._before_s) - 1, 0), self._n_written)
        kept = self._odometry[:, first : self._n_odometry]
        self._odometry = np.hstack([kept, np.empty((len(kept), ROOM))])
        self._n_odometry, self._n_written = kept.shape[1], self._n_written - first

    def _keep(self, frame: LiveFrame, before_s: float) -> bool:
        """Return whether a frame's readings fit the maximum rate: a token bucket."""
        since_s = min(frame.stamp_s - before_s, BURST_S)
        self._room = min(self._room + self._readings_hz * since_s, self._readings_hz * BURST_S)
        if self._room < 0.0:
            return False
        self._room -= len(frame.rows)
        self._kept.append(frame)
        self._n_kept += 1
        return True

    def _refuse_late(self, stamp_s: float, what: str) -> None:
        if stamp_s > self.settled_s:
            return
        self.n_late += 1
        problem = (
            f"{what} of {stamp_s:.3f} s came too late: frames until {self.settled_s:.3f} s are processed, the newest "
            f"reading is of {self.newest_s:.3f} s"
        )
        raise InputError(problem, field="stamp_s", hint="one clock for all readings, or a larger live.reorder_s")

    def _record(
        self, odometry: FloatArray, frames: list[LiveFrame], classes: tuple[str, ...], texts: dict[int, str]
    ) -> Any:
        """Return a recording of some readings."""
        return _record(self._about, odometry, frames, classes, texts)

    def _rows(self, *columns: Any) -> FloatArray:
        """(M, 6) rows of the detections of a frame."""
        ids, ranges, bearings, classes, *sigmas = columns
        names = [ids] if isinstance(ids, str) else list(ids)
        rows = np.full((len(names), 6), np.nan)
        rows[:, 0], rows[:, 3] = [self._number(name) for name in names], UNKNOWN
        if classes is not None:
            rows[:, 3] = [self._class(name) for name in _column(list(classes), len(names), "class_name")]
        given = zip((1, 2, 4, 5), (RANGE_M, BEARING_RAD, SIGMA_RANGE_M, SIGMA_BEARING_RAD), strict=True)
        for (column, quantity), values in zip(given, (ranges, bearings, *sigmas), strict=True):
            if values is None and column > 2:
                continue
            told = np.asarray(_column([] if values is None else values, len(names), quantity.name), dtype=np.float64)
            if column == 2 and np.isnan(told).any():
                raise InputError(RANGE_ONLY, field=quantity.name, hint="a recording: evermap map enter")
            quantity.check_array(told, quantity.name)
            rows[:, column] = told
        return rows

    def _number(self, name: Any) -> int:
        if isinstance(name, str):
            number = landmark_id_of(name)
            self._texts[number] = name
            return number
        if isinstance(name, float) and not name.is_integer():
            raise InputError(f"{name} is not an identity", field="landmark_id", hint="whole numbers, or texts")
        if not UNKNOWN <= int(name) <= 2**53:
            raise InputError(f"{name} is not an identity", field="landmark_id", hint="from 0; -1: unknown")
        return int(name)

    def _class(self, name: str | None) -> int:
        if not name:
            return UNKNOWN
        if name not in self._classes:
            self._classes.append(str(name))
        return self._classes.index(name)


def joined(parts: Sequence[AnyRecording]) -> AnyRecording:
    """Return one recording of consecutive parts."""
    begin, *rest = parts
    first = np.cumsum([0, *(len(part.frames) for part in parts[:-1])])
    frame = np.concatenate([part.detections.frame + k for part, k in zip(parts, first, strict=True)])
    last: Any = parts[-1]
    odometry: Any = [part.odometry for part in (begin, *rest)]
    detections: Any = [part.detections for part in (begin, *rest)]
    joined_up: AnyRecording = replace(
        last,
        odometry=odometry[0].joined(*odometry[1:]),
        frames=begin.frames.joined(*(part.frames for part in rest)),
        detections=replace(detections[0].joined(*detections[1:]), frame=frame.astype(np.int64)),
    )
    return joined_up


def _record(
    about: Recording, odometry: FloatArray, frames: list[LiveFrame], classes: tuple[str, ...], texts: dict[int, str]
) -> Recording:
    stamp_s, forward_mps, lateral_mps, angular_radps = _columns(odometry)
    rows = np.concatenate([np.zeros((0, 6)), *(one.rows for one in frames)])
    count = [len(one.rows) for one in frames]
    name, range_m, bearing_rad, kind, sigma_range, sigma_bearing = _columns(rows)
    return replace(
        about,
        odometry=Odometry(stamp_s, forward_mps, lateral_mps, angular_radps, about.clock),
        frames=Frames(np.array([one.stamp_s for one in frames]), clock=about.clock),
        detections=Detections(
            np.repeat(np.arange(len(frames)), count),
            name.astype(np.int64),
            range_m,
            bearing_rad,
            kind.astype(np.int64),
            sigma_range,
            sigma_bearing,
            np.zeros(len(rows), dtype=np.int64),
        ),
        class_names=classes,
        landmark_names=texts,
    )


def _columns(rows: FloatArray) -> list[FloatArray]:
    return [np.ascontiguousarray(column) for column in rows.T]


def recording_of(sensor: object, name: str, clock: Clock, class_names: tuple[str, ...]) -> AnyRecording:
    """Return a recording without readings, of a sensor or a `sensor.toml`; in space of one sensor or several.

    Raises:
        InputError: neither.
    """
    given = (sensor,) if isinstance(sensor, SpatialSensor) else sensor
    none, no = np.zeros(0), np.zeros(0, dtype=np.int64)
    if isinstance(given, tuple | list) and given and all(isinstance(one, SpatialSensor) for one in given):
        odometry = SpatialOdometry(none, np.zeros((0, 7)), np.zeros((0, 6)), clock)
        seen = spatial_detections(no)
        frames = Frames(none, clock=clock)
        return Recording(name, odometry, frames, seen, sensors=tuple(given), class_names=class_names, clock=clock)
    if isinstance(sensor, str | Path):
        from evermap.io.sensor_toml import parse_sensor_toml

        path = Path(sensor)
        try:
            said = parse_sensor_toml(path.read_bytes(), path)
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror}", path=path, hint="a sensor.toml") from None
        name, sensor, clock = said.name or name, said.sensor, said.clock
        class_names = said.class_names or class_names
    if not isinstance(sensor, Sensor):
        hint = "evermap.Sensor(range_max_m=8.0), evermap.types.SpatialSensor(), or the path of a sensor.toml"
        raise InputError(f"a Sensor is needed, not {type(sensor).__name__}", field="sensor", hint=hint)
    nothing = Detections(no, no, none, none, no, none, none, no)
    return Recording(
        name, Odometry(none, none, none, none, clock), Frames(none, clock=clock), nothing, sensor, clock=clock,
        class_names=class_names,
    )  # fmt: skip


def check_number(quantity: Any, value: Any) -> None:
    """Raise InputError for what is no number, or none that can be."""
    try:
        told = np.array([value], dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{value!r} is not a number", field=quantity.name, hint=quantity.hint) from None
    try:
        quantity.check_array(told, quantity.name)
    except InputError as error:
        raise InputError(error.problem.removeprefix("row 0: "), field=quantity.name, hint=error.hint) from None


def _column(values: Any, count: int, field: str) -> Any:
    if len(values) != count:
        raise InputError(f"{len(values)} values for {count} detections", field=field, hint="one per detection")
    return values
