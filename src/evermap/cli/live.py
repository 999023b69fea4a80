"""`evermap live`: a robot that drives, in a living map."""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evermap.cli.options import ConfigFile, Robot, Settings, configured
from evermap.cli.terminal import echo, print_table, say, warm_up, warn
from evermap.errors import ConfigError

if TYPE_CHECKING:
    from evermap.live.now import Now
    from evermap.types import MapChange

EVERY_S = 0.5
"""Time between two lines of progress."""


def live(
    map_file: Annotated[Path, typer.Option("--map", metavar="FILE", help="Living map, made where there is none.")],
    replay: Annotated[Path, typer.Option(metavar="INPUT", help="A recording, as a robot that is not there.")],
    robot: Robot = None,
    config: ConfigFile = None,
    settings: Settings = None,
    localize: Annotated[bool, typer.Option("--localize", help="Only localise; the map stays as it is.")] = False,
    realtime: Annotated[bool, typer.Option("--realtime", help="At the pace of the recording.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print poses and changes as they come, one JSON object a line.")
    ] = False,
) -> None:
    """Localise and map while the robot drives.

    What has changed is told as it becomes certain.

    What was driven enters the map every few minutes (live.revision_s) and at the end; after a crash, when the map is
    fed again.

    \b
    Examples:
      evermap live --replay tuesday --map building.evermap
      evermap live --replay tuesday --map building.evermap --localize --realtime --json
    """
    from evermap.io import read_recording
    from evermap.live.engine import Engine
    from evermap.live.feed import replayed, run_live
    from evermap.types import Recording

    chosen = configured(config, settings, within="live")
    recording = read_recording(replay, robot=robot)
    if not isinstance(recording, Recording):
        raise ConfigError(
            "is in space, where a session is solved when it ends", field="replay", hint="evermap slam --map"
        )
    about: dict[str, Any] = {
        "clock": recording.clock,
        "class_names": recording.class_names,
        "name": recording.name,
    }
    # what is replayed faster than it was driven cannot wait for what is done beside it
    engine = Engine(map_file, recording.sensor, chosen, mapping=not localize, beside=realtime, **about)
    warm_up(engine.warm_up)
    shown = _Shown(float(recording.frames.stamp_s[0]), as_json=as_json)
    with engine:
        run_live(engine, replayed(recording, paced=realtime), shown.tell, warn)
        if not localize:
            engine.save()
        shown.tell(engine.step())
    shown.finish(map_file)


class _Shown:
    """What is told: a line of progress on the terminal, poses and changes as JSON lines."""

    def __init__(self, start_s: float, *, as_json: bool) -> None:
        self._json, self._last_s, self._n_changes, self._n_frames = as_json, 0.0, 0, 0
        self._start_s = start_s
        self._before: tuple[float, float, float] | None = None
        self._now: Now | None = None

    def tell(self, now: Now) -> None:
        """Show what is known."""
        from evermap.viz.change_words import describe

        for text in now.warnings:
            warn(text)
        self._now = now
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

    def finish(self, map_file: Path) -> None:
        """Show what came of it."""
        if sys.stderr.isatty():
            typer.echo(err=True)
        if self._now is None or self._json:
            return
        rows = [
            ("frames with a pose", str(self._n_frames)),
            ("changes", str(self._n_changes)),
            ("map", f"{map_file}, revision {self._now.revision}"),
        ]
        print_table("live", rows)
        if self._now.lost:
            say("where the robot is was not known at the end")

    def _line(self, now: Now) -> str:
        """Pose, speed, landmarks, changes."""
        x, y, theta = now.pose_world_robot.tolist()
        before, self._before = self._before, (now.stamp_s, x, y)
        speed = math.nan
        if before is not None and now.stamp_s > before[0]:
            speed = math.hypot(x - before[1], y - before[2]) / (now.stamp_s - before[0])
        place = "searching" if now.lost else f"x {x:.2f} m  y {y:.2f} m  heading {math.degrees(theta):.0f} deg"
        return f"{place}  {speed:.1f} m/s  {len(now.in_view)} landmarks in view  {self._n_changes} changes"


def _pose(now: Now) -> dict[str, Any]:
    from evermap.types import json_number

    x, y, theta = (json_number(value) for value in now.pose_world_robot.tolist())
    names = [now.in_view.names.get(one, one) for one in now.in_view.landmark_id.tolist()]
    return {
        "stamp_s": json_number(now.stamp_s),
        "x_m": x,
        "y_m": y,
        "theta_rad": theta,
        "covariance": [[json_number(value) for value in row] for row in now.covariance.tolist()],
        "frame": now.frame,
        "lost": now.lost,
        "revision": now.revision,
        "in_view": dict(zip(map(str, names), now.in_view.p_exists.tolist(), strict=True)),
    }


def _numbers(change: MapChange) -> dict[str, Any]:
    from evermap.types import json_number

    return {
        "from_s": json_number(change.stamp_from_s),
        "to_s": json_number(change.stamp_to_s),
        "displacement_m": [json_number(value) for value in change.displacement_m],
        "probability": change.probability,
    }


def _print(told: dict[str, Any]) -> None:
    typer.echo(json.dumps(told, allow_nan=False))
