"""`evermap live`: a robot that drives, in a living map."""

from __future__ import annotations

import gc
import json
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evermap.cli.options import (
    ConfigFile,
    ResultAsJson,
    Robot,
    Settings,
    Topics,
    argument,
    configure,
    option,
    refuse_given,
)
from evermap.cli.terminal import echo, print_json, print_table, say, warm_up, warn
from evermap.errors import ConfigError
from evermap.interrupts import kept, watched

if TYPE_CHECKING:
    from evermap.config import Config
    from evermap.live.engine import Engine, Now
    from evermap.live.feed import Reading
    from evermap.live.ros import Listener
    from evermap.live.wires import Mailbox, Wire
    from evermap.types import AnyRecording, MapChange

EVERY_S = 0.5
"""Time between two progress lines."""
OBJECTS = 20_000
"""Allocations between garbage collections: one message of a hundred detections exceeds the usual 700."""
MMAP_THRESHOLD, LARGE = -3, 2**18
"""A parameter of glibc's `mallopt`, and the size [bytes] above which freed blocks are returned to the system."""


LocalMap = Annotated[
    str, argument("The living map, a file; created if it does not exist.", metavar="MAP", default=False)
]
Replay = Annotated[
    Path | None,
    argument("A recording or bag to replay in place of a robot.", metavar="[INPUT]", default=False),
]
SensorFile = Annotated[Path | None, option("Sensor description, as the sensor.toml of a recording.", metavar="FILE")]
ZenohEndpoint = Annotated[
    str | None,
    option("ROS 2 over Zenoh: tcp/localhost:7447, listen=tcp/0.0.0.0:7447, or FILE.json5.", metavar="ENDPOINT"),
]
FoxglovePort = Annotated[str | None, option("Serve Foxglove's WebSocket at this port, as 8765.", metavar="[HOST:]PORT")]
OnlyLocalize = Annotated[bool, option("--localize", "Only localise; the map is not changed.")]
Paced = Annotated[bool, option("--realtime", "Replay at the pace of the recording.")]
Lines = Annotated[bool, option("--json", "Print poses and changes at once, one JSON object per line.")]


def live(
    map_file: LocalMap,
    replay: Replay = None,
    sensor: SensorFile = None,
    zenoh: ZenohEndpoint = None,
    foxglove: FoxglovePort = None,
    topics: Topics = None,
    robot: Robot = None,
    config: ConfigFile = None,
    settings: Settings = None,
    localize: OnlyLocalize = False,
    realtime: Paced = False,
    as_json: Lines = False,
) -> None:
    """Localise and map while the robot drives.

    Changes are reported as they become certain; pose, frames, map and changes are sent to all connected clients.

    The drive enters the map every few minutes (live.revision_s) and at the end, also by Ctrl-C; after a crash,
    when the map is fed again.

    \b
    Examples:
      evermap live building.evermap tuesday
      evermap live building.evermap tuesday --localize --realtime --json
      evermap live building.evermap --sensor sensor.toml --zenoh tcp/localhost:7447 --foxglove 8765
    """
    from evermap.io import read_recording
    from evermap.live.wires import Mailbox
    from evermap.maps.store import is_address
    from evermap.slam.plane import in_its_space

    chosen = configure(config, settings, within="live", also=["slam", "living", "sensor", "output"])
    if is_address(map_file):
        hint = "a file, and send its recordings to the server"
        raise ConfigError("must be a local file: readings are stored next to it", field="MAP", hint=hint)
    connected = zenoh is not None or foxglove is not None
    if replay is None:
        refuse_given("is for a replay", "evermap live MAP INPUT", robot=robot, realtime=realtime or None)
    _check_source(replay, sensor, connected=connected)
    recording = None if replay is None else read_recording(replay, robot=robot)
    if recording is not None and sensor is None and topics is None:
        recording = in_its_space(recording, chosen.slam, dim=_dimension_of(Path(map_file)))
    _check_needed(recording, chosen, sensor, topics, connected=connected)
    mailbox = Mailbox() if replay is None else None
    drive = _Drive(Path(map_file), chosen, sensor, topics, mailbox, recording)
    with _connect(zenoh, foxglove, mailbox) as wires:
        drive.run(wires, localize=localize, realtime=realtime, as_json=as_json)


def play(
    input: Annotated[Path, argument("A recording or bag.", metavar="INPUT", default=False)],
    zenoh: ZenohEndpoint = None,
    foxglove: FoxglovePort = None,
    robot: Robot = None,
    as_json: ResultAsJson = False,
) -> None:
    """Send a recording as a robot would, at its pace.

    The messages are those that `evermap live` listens to: /odom, /detections, /tf_static.

    \b
    Example:
      evermap play tuesday --zenoh listen=tcp/localhost:7447
    """
    from evermap.io import read_recording

    if zenoh is None and foxglove is None:
        raise ConfigError("no connection", field="zenoh", hint="--zenoh tcp/localhost:7447, or --foxglove 8765")
    recording = read_recording(input, robot=robot)
    _check_ranges(recording, configure(None, None))
    with _connect(zenoh, foxglove, None) as wires:
        _be_the_robot(recording, wires, as_json=as_json)


@contextmanager
def _connect(zenoh: str | None, foxglove: str | None, mailbox: Mailbox | None) -> Iterator[Sequence[Wire]]:
    """Open connections, and close them in the end."""
    from evermap.live.wires import wires_of

    wires = wires_of(zenoh, foxglove, mailbox)
    try:
        yield wires
    finally:
        for wire in wires:
            wire.close()


def _dimension_of(map_file: Path) -> int | None:
    """Return whether a map is in the plane (2) or in space (3); None where there is none yet, or nothing in it."""
    from evermap.maps.store import open_store

    if not map_file.exists():
        return None
    with open_store(map_file) as store:
        living = store.load(store.head())
    return living.dim if len(living.places) else None


def _check_source(replay: Path | None, sensor: Path | None, *, connected: bool) -> None:
    """Refuse a drive without readings, or a sensor."""
    if replay is None and not connected:
        hint = "--zenoh tcp/localhost:7447, --foxglove 8765, or evermap live MAP INPUT"
        raise ConfigError("no robot", field="zenoh", hint=hint)
    if replay is None and sensor is None:
        raise ConfigError("the sensor is not described", field="sensor", hint="--sensor sensor.toml")


def _check_needed(
    recording: AnyRecording | None, config: Config, sensor: Path | None, topics: Path | None, *, connected: bool
) -> None:
    """Refuse a recording of ranges only, and files that would say what a recording in the plane says itself."""
    from evermap.types import is_in_space

    if recording is None:
        return
    _check_ranges(recording, config)
    if is_in_space(recording) and sensor is None:
        if connected:
            problem = f"'{recording.name}' is in space, and connections take poses in the plane"
            raise ConfigError(problem, field="INPUT", hint="--sensor FILE: in the plane; or without connections")
        if recording.odometry is None:
            problem = f"'{recording.name}' has no odometry; it is solved when it ends"
            raise ConfigError(problem, field="INPUT", hint="evermap map enter")
    for name, path in (("sensor", sensor), ("topics", topics)):
        if path is not None and not is_in_space(recording):
            problem = f"'{recording.name}' describes its topics and sensors itself"
            raise ConfigError(problem, field=name, hint=f"omit --{name}; it is for messages and bags")


def _check_ranges(recording: AnyRecording, config: Config) -> None:
    """Refuse a recording of ranges only."""
    from evermap.slam.cleaning import of_ranges_only
    from evermap.types import is_in_space

    if not is_in_space(recording) and of_ranges_only(recording.detections, config.slam.cleaning):
        problem = f"'{recording.name}' has ranges without bearings, which are located by what is seen later"
        raise ConfigError(problem, field="INPUT", hint="evermap map enter")


def _be_the_robot(recording: AnyRecording, wires: Sequence[Wire], *, as_json: bool) -> None:
    """Send the messages of a robot that drives as in a recording, at its pace."""
    from evermap.live.ros import play

    with watched(signal.SIGTERM) as watch:
        say(f"{recording.name}: /odom, /detections and /tf_static as recorded; Ctrl-C ends it")
        try:
            count = play(recording, wires, watch.stop_if_asked)
        except KeyboardInterrupt:
            say("stopped before the recording ended")
            return
        if as_json:
            print_json({"recording": recording.name, "messages": count})
        else:
            say(f"sent {count} messages")


def _give_memory_back() -> None:
    """Have large blocks returned to the system when they are freed.

    As arrays come and go, glibc raises the size from which it does so to 32 MB; what is asked of the map every few
    seconds then leaves the heap full of holes for good.
    """
    import ctypes

    with suppress(OSError, TypeError, AttributeError):  # another C library
        ctypes.CDLL(None).mallopt(MMAP_THRESHOLD, LARGE)


@dataclass(slots=True)
class _Drive:
    """A drive: an engine, its readings, and its outputs to connections and terminal."""

    map_file: Path
    config: Config
    sensor: Path | None
    topics: Path | None
    mailbox: Mailbox | None
    recording: AnyRecording | None
    listener: Listener | None = None

    def run(self, wires: Sequence[Wire], *, localize: bool, realtime: bool, as_json: bool) -> None:
        """Drive until the recording ends, or until it is stopped."""
        from evermap.live.feed import run_live

        _give_memory_back()
        # a replay faster than real time cannot wait for parallel work
        engine = self._engine(mapping=not localize, beside=realtime or self.recording is None)
        shown = _Shown(as_json=as_json, mailbox=self.mailbox)
        with engine:
            readings = self._readings(engine, shown, realtime=realtime)
            warm_up(engine.warm_up)
            gc.collect()
            gc.freeze()  # objects loaded so far are kept: collecting them again would take a tenth of a second
            gc.set_threshold(OBJECTS)
            kept(self.map_file, f"the drive enters {self.map_file} at the next start")
            with self._teller(engine, wires) as tell:

                def told(now: Now) -> None:
                    tell(now)
                    shown.tell(now)

                with watched(signal.SIGTERM) as watch:
                    try:
                        run_live(engine, _until_stopped(readings, watch), told, shown.refused)
                    except KeyboardInterrupt:
                        say("stopped" if localize else "stopped; entering the drive")
                if not localize:
                    engine.save()
                told(engine.step())
        shown.finish(self.map_file)

    def _engine(self, *, mapping: bool, beside: bool) -> Engine:
        from evermap.live.engine import Engine
        from evermap.types import is_in_space

        recording = self.recording
        about: dict[str, Any] = {"name": datetime.now(UTC).strftime("live %Y-%m-%d %H:%M:%S")}
        sensor: Any = self.sensor
        if recording is not None and not is_in_space(recording):
            about = {"clock": recording.clock, "class_names": recording.class_names, "name": recording.name}
            sensor = recording.sensor
        elif recording is not None and sensor is None:
            about = {"clock": recording.clock, "class_names": recording.class_names, "name": recording.name}
            about["symmetries"] = recording.symmetries
            sensor = recording.sensors
        return Engine(self.map_file, sensor, self.config, mapping=mapping, beside=beside, **about)

    def _readings(self, engine: Engine, shown: _Shown, *, realtime: bool) -> Iterator[Reading | None]:
        from evermap.live.feed import replay_in_space, replayed
        from evermap.live.ros import Listener, heard, spoken
        from evermap.types import Sensor, is_in_space

        if self.recording is not None and not is_in_space(self.recording):
            return replayed(self.recording, paced=realtime)
        if not isinstance(engine.sensor, Sensor):
            assert self.recording is not None
            return replay_in_space(self.recording, paced=realtime)
        self.listener = Listener(engine.sensor, self.topics, say)
        if self.recording is not None:
            return spoken(self.recording, self.listener, shown.refused, paced=realtime)
        assert self.mailbox is not None
        return heard(self.mailbox, self.listener, shown.refused)

    @contextmanager
    def _teller(self, engine: Engine, wires: Sequence[Wire]) -> Iterator[Callable[[Now], None]]:
        """Return the sender of the engine's outputs, if there are connections."""
        if not wires:
            yield lambda _: None
            return
        from evermap.live.ros import Teller

        for wire in wires:
            if wire.about:
                say(wire.about)
        teller = Teller(engine, wires)
        try:
            yield lambda now: teller.tell(now, self.listener)
        finally:
            teller.close()


def _until_stopped(readings: Iterator[Reading | None], watch: watched) -> Iterator[Reading | None]:
    for reading in readings:
        watch.stop_if_asked()
        yield reading


class _Shown:
    """Outputs on stdout: a progress line on the terminal, poses and changes as JSON lines."""

    def __init__(self, *, as_json: bool, mailbox: Mailbox | None) -> None:
        self._json, self._last_s, self._n_changes, self._n_frames = as_json, 0.0, 0, 0
        self._mailbox, self._start_s = mailbox, math.nan
        self._n_refused, self._refused_s = 0, -math.inf
        self._before: tuple[float, float, float] | None = None
        self._now: Now | None = None

    def tell(self, now: Now) -> None:
        """Show the present state."""
        from evermap.viz.change_words import describe

        for text in now.warnings:
            warn(text)
        self._now = now
        if math.isnan(self._start_s):
            self._start_s = now.stamp_s
        self._n_frames += len(now.online)
        self._n_changes += len(now.changes)
        if self._json:
            if len(now.online):
                _print(_pose(now))
            for change in now.changes:
                _print({"change": change.kind.value, "landmarks": list(change.labels), **_numbers(change)})
        else:
            for change in now.changes:
                echo(describe(change, self._start_s))
        if sys.stderr.isatty() and time.monotonic() > self._last_s + EVERY_S:
            self._last_s = time.monotonic()
            typer.echo(f"\r\x1b[K{self._line(now)}", err=True, nl=False)

    def refused(self, line: str) -> None:
        """Say why a reading was not taken, not more often than lines of progress."""
        self._n_refused += 1
        if time.monotonic() > self._refused_s + EVERY_S:
            self._refused_s = time.monotonic()
            warn(line)

    def finish(self, map_file: Path) -> None:
        """Show the results."""
        if sys.stderr.isatty():
            typer.echo(err=True)
        if self._now is None or self._json:
            return
        rows = [
            ("frames with a pose", str(self._n_frames)),
            ("changes", str(self._n_changes)),
            ("map", f"{map_file}, revision {self._now.revision}"),
        ]
        rows += [("refused readings", str(self._n_refused))] if self._n_refused else []
        rows += [("lost messages", str(self._n_lost))] if self._n_lost else []
        print_table("live", rows)
        if self._now.lost:
            say("the pose of the robot was unknown at the end")

    @property
    def _n_lost(self) -> int:
        return 0 if self._mailbox is None else self._mailbox.n_lost

    def _line(self, now: Now) -> str:
        """Pose, speed, landmarks, changes."""
        if math.isnan(now.stamp_s):
            return "waiting for odometry and detections"
        x, y, theta = _project_pose(now)
        before, self._before = self._before, (now.stamp_s, x, y)
        speed = ""
        if before is not None and now.stamp_s > before[0] and not math.isnan(x - before[1]):
            speed = f"  {math.hypot(x - before[1], y - before[2]) / (now.stamp_s - before[0]):.1f} m/s"
        place = "searching" if now.lost else f"x {x:.2f} m  y {y:.2f} m  heading {math.degrees(theta):.0f} deg"
        lost = f"  {self._n_lost} messages lost" if self._n_lost else ""
        return f"{place}{speed}  {len(now.in_view)} landmarks in view  {self._n_changes} changes{lost}"


_PARTS = {3: ("x_m", "y_m", "theta_rad"), 7: ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")}
"""Numbers of a pose, in the plane and in space."""


def _project_pose(now: Now) -> tuple[float, float, float]:
    """Return x, y and heading."""
    if len(now.pose_world_robot) == 3:
        x, y, theta = now.pose_world_robot.tolist()
        return x, y, theta
    from evermap.geometry import se3

    ahead = se3.rotation_of(now.pose_world_robot)[:2, 0]
    x, y = now.pose_world_robot[:2].tolist()
    return x, y, math.atan2(ahead[1], ahead[0])


def _pose(now: Now) -> dict[str, Any]:
    from evermap.types import json_number

    return {
        "stamp_s": json_number(now.stamp_s),
        **dict(zip(_PARTS[len(now.pose_world_robot)], map(json_number, now.pose_world_robot.tolist()), strict=True)),
        "covariance": [[json_number(value) for value in row] for row in now.covariance.tolist()],
        "frame": now.frame,
        "lost": now.lost,
        "revision": now.revision,
        "in_view": dict(zip(now.in_view.labels, now.in_view.p_exists.tolist(), strict=True)),
    }


def _numbers(change: MapChange) -> dict[str, Any]:
    from evermap.types import json_number

    return {
        "from_s": json_number(change.stamp_from_s),
        "to_s": json_number(change.stamp_to_s),
        "displacement_m": [json_number(value) for value in change.displacement_m],
        "rotation_rad": json_number(change.rotation_rad),
        "probability": change.probability,
    }


def _print(told: dict[str, Any]) -> None:
    typer.echo(json.dumps(told, allow_nan=False))
