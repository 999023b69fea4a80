"""`evermap slam --map`: one session of a living map, or localisation in it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from evermap.cli.options import priors_by_class
from evermap.cli.slam import show_run
from evermap.cli.terminal import command_line, progress_bar, say, warm_up, warn
from evermap.errors import ConfigError
from evermap.interrupts import held, kept

if TYPE_CHECKING:
    from evermap.config import Config
    from evermap.types import Recording


class MapOptions(NamedTuple):
    """What the command line says of a living map.

    Attributes:
        map_file: the map.
        priors: how long things stay, `[CLASS=]PRIOR`.
        localize: only localise; the map stays.
        realtime: at the recording's pace.
    """

    map_file: Path
    priors: Sequence[str]
    localize: bool
    realtime: bool


def run_in_map(
    recording: Recording,
    config: Config,
    options: MapOptions,
    out: Path,
    *,
    as_json: bool,
    force: bool,
    inputs: Sequence[str | Path | None],
) -> None:
    """Run, write the folder, then commit the map: what is in the map has its folder, whatever happens in between."""
    from evermap.maps.store import open_store
    from evermap.pipeline import run_localization
    from evermap.runs.folder import RunInfo, write_run
    from evermap.runs.sessions import at_time, enter_session, priors_of
    from evermap.viz.change_words import explanations, grew

    map_file, priors, localize, realtime = options
    if realtime and not localize:
        raise ConfigError("a session is solved when it ends", field="realtime", hint="--localize")
    if config.slam.unknown_ids:
        raise ConfigError("a living map needs identities", field="slam.unknown_ids", hint="leave out --unknown-ids")
    said = priors_of(*priors_by_class(priors))
    warm_up()
    with held():  # a map without its tables is none
        opened = open_store(map_file, create=not localize)
    kept(map_file, f"the map {map_file} stays as it was")
    with opened as store:
        start = time.perf_counter()
        with progress_bar(recording.name) as progress:
            if localize:
                stamps = recording.frames.stamp_s
                living = at_time(store, float(stamps[0]) if len(stamps) else 0.0)
                result = run_localization(recording, living, config, realtime=realtime, progress=progress)
            else:
                entered = enter_session(store, recording, config, priors=said, progress=progress)
                session = entered.session
                result, recording = replace(session.slam, changes=entered.changes), session.recording
        elapsed_s = time.perf_counter() - start
        info = RunInfo(
            command=command_line(),
            seeds={"slam": config.slam.seed},
            processing_s=None if realtime else elapsed_s,
            total_s=elapsed_s,
            grown=None if localize else len(entered.grown),
        )
        summary = write_run(out, recording, result, config, info=info, force=force, inputs=inputs)
        for remark in summary["warnings"]:
            warn(remark)
        show_run(summary, out, as_json=as_json, findings=[*explanations(result), *grew(info.grown)])
        if result.interrupted:
            raise KeyboardInterrupt(
                f"the part of the recording that was processed is in {out}; the map stays as it was"
            )
        if localize:
            return
        if not session.found:
            raise ConfigError("the session was not found in this map, which stays as it was", path=map_file)
        with held():
            revision = entered.commit(store, config, command=command_line(), wall_s=elapsed_s)
            kept(map_file, f"the session is revision {revision} of {map_file}")
        if entered.replayed:
            again = ", ".join(entered.replayed)
            say(f"a late session: entered at its time, and {len(entered.replayed)} later brought in again ({again})")
