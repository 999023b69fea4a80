"""`evermap map enter` and `evermap localize`: recordings that were made in a living map."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evermap.cli.options import (
    AsJson,
    ConfigFile,
    Force,
    Robot,
    Settings,
    Topics,
    argument,
    default_out,
    option,
    priors_by_class,
    refuse_given,
)
from evermap.cli.recordings import (
    OfflineSession,
    Out,
    PriorMap,
    Realtime,
    Recordings,
    RunRequest,
    Shifts,
    Start,
    ask,
    read_inputs,
    refuse_unread,
    write_results,
)
from evermap.cli.terminal import EXIT_UNTRUSTWORTHY, command_line, fail, progress_bar, say, warm_up, warn
from evermap.errors import ConfigError, DataError, EvermapError
from evermap.interrupts import held, kept

if TYPE_CHECKING:
    from evermap.config import Config
    from evermap.maps.store import MapStore
    from evermap.runs.sessions import Entered
    from evermap.types import AnyRecording, Landmarks

TOLD_M, MOST_TOLD = 0.1, 12
"""Distance from which an entry of a survey that a session has put elsewhere is told, and how many at most."""

Continued = Annotated[
    str,
    argument("The map, which is begun if there is none: a file, or postgresql://user@host/database/SITE.",
             metavar="MAP", default=False),
]  # fmt: skip
Existing = Annotated[
    str, argument("The map: a file, or postgresql://user@host/database/SITE.", metavar="MAP", default=False)
]
MapPriors = Annotated[
    list[str] | None,
    option(
        "Lifetimes, as 'cart=weibull:scale=3d,shape=1.5', or a file of survival fit, survival learn or map export "
        "--lifetimes; worth living.prior_stays stays; repeatable.",
        metavar="[CLASS=]PRIOR|FILE.json",
    ),
]

ENTER = """\
Enter recordings into a living map.

Each is localised in the map, what changed is found, and the map is extended: a revision. One whose verdict is not sound
leaves the map as it is.

\b
Examples:
  evermap map enter building.evermap monday
  evermap map enter building.evermap tuesday wednesday --out out/week
  evermap map enter building.evermap wednesday.bag --start 2026-11-29T09:30Z
  evermap map enter building.evermap monday --prior "cart=exponential:half-life=2d" --prior wall=never-leaves
  evermap map enter field.evermap monday --prior-map field.json
"""
LOCALIZE = """\
Localise recordings in a living map, which is not changed.

At a fixed cost per frame, as on the robot.

\b
Examples:
  evermap localize building.evermap tuesday
  evermap localize building.evermap tuesday --realtime --out out/where
"""


def enter(
    map_file: Continued,
    input: Recordings,
    robot: Robot = None,
    topics: Topics = None,
    out: Out = None,
    prior: MapPriors = None,
    prior_map: PriorMap = None,
    start: Start = None,
    config: ConfigFile = None,
    settings: Settings = None,
    as_json: AsJson = False,
    force: Force = False,
    offline_session: OfflineSession = None,
    shift: Shifts = None,
) -> None:
    """Enter recordings into a living map and write the folder of each run."""
    asked = ask(
        input,
        config,
        settings,
        prior_map=prior_map,
        shift=shift,
        robot=robot,
        topics=topics,
        as_json=as_json,
        force=force,
        start=start,
        offline_session=offline_session,
        map_file=map_file,
        priors=prior or [],
    )
    _run_all(input, out, asked)


def localize(
    map_file: Existing,
    input: Recordings,
    robot: Robot = None,
    topics: Topics = None,
    out: Out = None,
    start: Start = None,
    realtime: Realtime = False,
    config: ConfigFile = None,
    settings: Settings = None,
    as_json: AsJson = False,
    force: Force = False,
    offline_session: OfflineSession = None,
) -> None:
    """Localise recordings in a living map and write the folder of each run."""
    asked = ask(
        input,
        config,
        settings,
        robot=robot,
        topics=topics,
        as_json=as_json,
        force=force,
        start=start,
        realtime=realtime,
        offline_session=offline_session,
        map_file=map_file,
        localize=True,
    )
    _run_all(input, out, asked)


def _run_all(paths: Sequence[Path], out: Path | None, asked: RunRequest) -> None:
    """Run one recording, or several, one after the other."""
    if len(paths) > 1:
        hint = "a file for each, one after the other"
        refuse_given("is for one recording", hint, offline_session=asked.offline_session)
        hint = "a command for each, or --set living.clock_gap_s=SECONDS"
        refuse_given("is for one recording", hint, start=asked.start)
        trustworthy = _run_each(paths, out, asked)
    else:
        trustworthy = _run_in_map(*read_inputs(paths[0], out, asked), asked)
    if not trustworthy:
        raise typer.Exit(EXIT_UNTRUSTWORTHY)


def _run_each(paths: Sequence[Path], out: Path | None, asked: RunRequest) -> bool:
    """Work on several sessions of a map; one that is refused stops none of the others.

    Returns whether all can be trusted.

    Raises:
        DataError: any was refused.
    """
    refused, trustworthy = [], True
    for number, path in enumerate(paths):
        say(f"session {number + 1} of {len(paths)}: {path}")
        folder = None if out is None else out / default_out(path.resolve().name).name
        try:
            trustworthy &= _run_in_map(*read_inputs(path, folder, asked), asked, later=number > 0)
        except EvermapError as error:
            refused.append(str(path))
            fail(error.one_line())
    if refused:
        raise DataError(f"{len(refused)} of {len(paths)} sessions were refused: {', '.join(refused)}")
    return trustworthy


def _run_in_map(
    recording: AnyRecording, survey: Landmarks | None, out: Path, asked: RunRequest, *, later: bool = False
) -> bool:
    """Run, write the folder, then commit the map, so that every session in the map has its folder.

    One whose verdict is not sound leaves the map as it is (`living.accept`). Returns whether it can be trusted.

    `later`: of several sessions it is not the first, and needs the survey only if none before it began the map.
    """
    from evermap.cli.warmup import warm_up as compile_kernels
    from evermap.existence.models import priors_of
    from evermap.maps.sessions.admission import in_its_space
    from evermap.maps.store import open_store
    from evermap.pipeline import refuse_localization, run_localization
    from evermap.runs.sessions import at_time, begin_map, enter_session
    from evermap.slam.check import odd, valid
    from evermap.slam.space.moving import has_traffic
    from evermap.types import VerdictKind, is_in_space
    from evermap.valid import strangers

    config, localize, map_file = asked.config, asked.localize, asked.map_file
    assert map_file is not None
    common, by_class = priors_by_class(asked.priors)
    said = priors_of(common, by_class)
    others = [name for name in said if name not in (by_class or {})]  # a file tells of classes of other sites, too
    unknown = config.slam.unknown_ids
    if survey is not None and not later and not unknown and (apart := strangers(survey, [recording])):
        raise DataError(apart, field="prior_map", hint="the map of this site; without one the session begins a map")
    with held():  # a map without its tables is none
        opened = open_store(map_file, create=not localize)
    kept(map_file, f"the map {map_file} is unchanged")
    with opened as store:
        start = time.perf_counter()
        entered: Entered | None = None
        begun_from: Landmarks | None = None
        if survey is not None and not (later and len(store.load().places)):
            begin_map(store, survey, recording, command_line())
            begun_from = survey
        if is_in_space(recording):
            recording = in_its_space(recording, store.load(), config)
        in_space = is_in_space(recording)
        refuse_unread(asked, in_space=in_space, boxes=has_traffic(recording))
        if asked.realtime and in_space:
            raise ConfigError("a session is solved when it ends", field="realtime", hint="leave it out")
        stamps = recording.frames.stamp_s
        living = at_time(store, float(stamps[0]) if len(stamps) else 0.0) if localize else None
        if living is not None:  # before anything is compiled
            refuse_localization(living, config)
        warm_up(
            lambda: compile_kernels(unknown_ids=unknown, sessions=not localize, localize=localize, in_space=in_space)
        )
        try:
            with progress_bar(recording.name) as progress:
                if living is not None:
                    result = run_localization(recording, living, config, realtime=asked.realtime, progress=progress)
                else:
                    entered = enter_session(store, recording, config, priors=said, later=others, progress=progress)
                    result = replace(entered.session.slam, changes=entered.changes)
                    recording = entered.session.recording
        except DataError:  # as without a map, where the verdict says what was read wrongly
            read: AnyRecording = valid(recording, config.sensor)  # type: ignore[type-var]
            wrong = [finding.message for finding in odd(read, config.slam) if not finding.usable]
            if not wrong:
                raise
            problem = f"the session was set aside: {VerdictKind.SENSOR_SUSPECT}: {'; '.join(wrong)}"
            fail(DataError(problem, path=map_file).one_line())
            return False
        elapsed_s = time.perf_counter() - start
        write_results(out, recording, result, asked, elapsed_s, entered)
        if result.interrupted:
            raise KeyboardInterrupt(f"the part of the recording that was processed is in {out}; the map is unchanged")
        if entered is not None:
            _commit(entered, store, map_file, config, elapsed_s)
            if begun_from is not None:
                _tell_corrected(begun_from, entered.living.landmarks())
        return result.is_trustworthy


def _tell_corrected(survey: Landmarks, mapped: Landmarks) -> None:
    """Say which entries of the survey that began a map its first session has put elsewhere."""
    import numpy as np

    from evermap.types import rows_of

    _, row, at = np.intersect1d(survey.landmark_id, mapped.landmark_id, return_indices=True)
    row, at = row[mapped.n_hits[at] > 0], at[mapped.n_hits[at] > 0]
    far_m = np.linalg.norm(mapped.position_m[at] - survey.position_m[row], axis=1)
    sigma_m = np.sqrt(np.trace(mapped.covariance_m2[at] + survey.covariance_m2[row], axis1=1, axis2=2))
    moved = np.flatnonzero(far_m > np.maximum(TOLD_M, 3.0 * sigma_m))
    if len(moved):
        far = zip(rows_of(survey, row[moved]).labels, far_m[moved].tolist(), strict=True)
        labels = [f"{name} ({metres:.2f} m)" for name, metres in far]
        more = f" and {len(labels) - MOST_TOLD} more" if len(labels) > MOST_TOLD else ""
        warn(
            f"this session is not where the survey has {', '.join(labels[:MOST_TOLD])}{more}: the map follows the "
            "session; evermap audit says which entries of the survey are wrong, and how probably"
        )


def _commit(entered: Entered, store: MapStore, map_file: str, config: Config, elapsed_s: float) -> None:
    """Make a session the newest revision of a map, unless its verdict or its place in the map forbids it."""
    from evermap.runs.sessions import ACCEPT

    if refusal := entered.refusal(config):
        hint = (entered.session.set_aside or ("", ACCEPT))[1]
        problem = f"the session was set aside, the map is unchanged: {refusal}"
        fail(ConfigError(problem, path=map_file, hint=hint).one_line())
        return
    with held():
        revision = entered.commit(store, config, command=command_line(), wall_s=elapsed_s)
        kept(map_file, f"the session is revision {revision} of {map_file}")
    if entered.replayed:
        again = ", ".join(entered.replayed)
        say(f"a late session: entered at its time, and {len(entered.replayed)} later ones replayed ({again})")
