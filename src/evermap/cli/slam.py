"""`evermap slam`: trajectory and landmark map of one recording."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from evermap.cli.options import (
    AsJson,
    ConfigFile,
    EmptyIds,
    Force,
    Robot,
    Settings,
    ShowConfig,
    Topics,
    UnknownIds,
    argument,
    associated,
    configured,
    default_out,
    option,
    priors_by_class,
    refuse_given,
)
from evermap.cli.terminal import (
    EXIT_UNTRUSTWORTHY,
    command_line,
    echo,
    fail,
    print_json,
    print_table,
    progress_bar,
    say,
    warm_up,
    warm_up_for,
    warn,
)
from evermap.errors import ConfigError, DataError, EvermapError
from evermap.interrupts import held, kept

if TYPE_CHECKING:
    from evermap.config import Config
    from evermap.maps.store import MapStore
    from evermap.runs.sessions import Entered
    from evermap.types import AnyRecording, Landmarks, SlamResult

# (section, key, label, format); a number that the run does not have is left out
_ROWS = (
    ("metrics", "pose_rmse_m", "position error, RMSE", "{:.3f} m"),
    ("metrics", "heading_rmse_deg", "heading error, RMSE", "{:.2f} deg"),
    ("metrics", "heading_rmse_in_view_deg", "  while landmarks were in view", "{:.2f} deg"),
    ("metrics", "orientation_rmse_deg", "orientation error, RMSE", "{:.2f} deg"),
    ("metrics", "landmark_rmse_m", "landmark error, RMSE", "{:.3f} m"),
    ("metrics", "landmark_median_m", "landmark error, median", "{:.3f} m"),
    ("metrics", "landmark_orientation_rmse_deg", "landmark orientation, RMSE", "{:.2f} deg"),
    ("metrics", "dead_reckoning_rmse_m", "odometry alone, RMSE", "{:.3f} m"),
    ("metrics", "nis_mean", "innovations (2 expected)", "{:.2f}"),
    ("timing", "real_time_factor", "speed", "{:.0f} x real time"),
    ("timing", "step_p99_ms", "99 % of the frames within", "{:.1f} ms"),
)

SURVEY_SIGMA_M = 0.02
"""Standard deviation of the landmarks of a surveyed map, unless it is stated: a default."""
TOLD_M, MOST_TOLD = 0.1, 12
"""Distance from which an entry of a survey that a session has put elsewhere is told, and how many at most."""
_SECTIONS = ("living", "sensor", "output", "track")
"""Sections of the configuration that are read beside `slam`."""

Recorded = Annotated[
    list[Path] | None,
    argument(
        "Folder in the native format, zip or ROS bag; with --map also several, in the order of their sessions, "
        "and with --together one per robot.",
        metavar="INPUT...",
        default=False,
    ),
]
Out = Annotated[
    Path | None,
    option("Folder for the results; for several recordings, one subfolder each.", default="evermap-out/<recording>"),
]
SensorModel = Annotated[
    str | None,
    option(
        "Estimate sensor and odometry errors, or trust the readings.", metavar="calibrated|plain", default="calibrated"
    ),
]
HowMoved = Annotated[
    str | None,
    option(
        "Method that finds moved landmarks; nohyp: the world is static.",
        metavar="joint|nohyp|max-mixture|nn|em|mcts|viterbi",
        default="joint",
    ),
]
PriorMap = Annotated[
    str | None, option("Start from this landmark map, or from the recording's surveyed one.", metavar="FILE|truth")
]
PriorSigma = Annotated[
    float | None,
    option(
        "Standard deviation of the surveyed map, or of a map without sigmas [m].",
        default=f"{SURVEY_SIGMA_M:g}",
        min=1e-6,
    ),
]
LivingMapFile = Annotated[
    str | None,
    option(
        "--map",
        "Continue or begin this living map: localise in it, find what changed, extend it. A file, or "
        "postgresql://user@host/database/SITE.",
        metavar="FILE",
        default=False,
    ),
]
MapPriors = Annotated[
    list[str] | None,
    option(
        "With --map: lifetimes, as 'cart=weibull:scale=3d,shape=1.5', or a file of survival fit, "
        "survival learn or map export --lifetimes; worth living.prior_stays stays; repeatable.",
        metavar="[CLASS=]PRIOR|FILE.json",
    ),
]
Start = Annotated[
    str | None,
    option(
        "When the recording began, where its clock starts anew each time: with a zone (Z is UTC), or as the clocks on "
        "the wall show it.",
        metavar="DATE",
        default=False,
    ),
]
Localize = Annotated[
    bool, option("--localize", "With --map: only localise, at a fixed cost per frame; the map is not changed.")
]
Shifts = Annotated[
    list[str] | None,
    option(
        "Move landmarks of the prior map, e.g. 11,12,13:+1.0 [m, m, degrees]; for experiments; repeatable.",
        metavar="IDS:DX[,DY[,TURN]]",
    ),
]
Together = Annotated[
    bool,
    option(
        "--together",
        "The inputs are simultaneous recordings of robots 1, 2, ..., or one input has several robots: solve them "
        "as one problem.",
    ),
]
Realtime = Annotated[bool, option("--realtime", "Process at the pace of the recording.")]
OfflineSession = Annotated[
    Path | None,
    option(
        "Also write what a map needs of the recording, condensed, for a later upload to a server.",
        metavar="FILE.zip",
        default=False,
    ),
]
Template = Annotated[
    Path | None, option("Write a commented template of a recording and exit.", metavar="DIR", default=False)
]

InitBag = Annotated[
    Path | None,
    option(
        "Write the topics that are read from a ROS bag, and how, to BAG.toml for editing, and exit.",
        metavar="BAG",
        default=False,
    ),
]
InSpace = Annotated[bool, option("--3d", "With --init: a recording in space, of a camera that sees tags.")]

HELP = """\
Estimate the trajectory and the map of landmarks.

\b
Examples:
  evermap slam --init my-recording
  evermap slam --init my-flight --3d
  evermap slam my-recording --out out/mine
  evermap slam monday.mcap
  evermap slam monday --offline-session monday.zip
  evermap slam MRCLAM_Dataset6.zip --robot 1 --out out/robot1
  evermap slam MRCLAM_Dataset6.zip --together --out out/all
  evermap slam MRCLAM_Dataset6.zip --prior-map truth --shift "11,12,13:+1.0" --method viterbi
  evermap slam monday --map building.evermap
  evermap slam tuesday wednesday --map building.evermap --out out/week
  evermap slam tuesday --map building.evermap --localize
  evermap slam wednesday.bag --map building.evermap --start 2026-11-29T09:30Z
  evermap slam monday --map building.evermap --prior "cart=exponential:half-life=2d" --prior wall=never-leaves
"""


def slam(
    input: Recorded = None,
    robot: Robot = None,
    topics: Topics = None,
    out: Out = None,
    config: ConfigFile = None,
    settings: Settings = None,
    sensor_model: SensorModel = None,
    method: HowMoved = None,
    unknown_ids: UnknownIds = False,
    empty_ids: EmptyIds = False,
    prior_map: PriorMap = None,
    prior_sigma: PriorSigma = None,
    map_file: LivingMapFile = None,
    prior: MapPriors = None,
    localize: Localize = False,
    start: Start = None,
    shift: Shifts = None,
    together: Together = False,
    realtime: Realtime = False,
    offline_session: OfflineSession = None,
    as_json: AsJson = False,
    force: Force = False,
    init: Template = None,
    in_space: InSpace = False,
    init_bag: InitBag = None,
    show_config: ShowConfig = False,
) -> None:
    """Estimate trajectory and landmarks of a recording and write the folder of the run."""
    if init is not None or init_bag is not None or in_space:
        refuse_given("is for a run", "omit it, or --init and --init-bag", input=input, out=out, map_file=map_file)
        _write_what_is_to_edit(init, init_bag, in_space=in_space)
        return
    given = {"sensor_model": sensor_model, "method": method, "unknown_ids": associated(unknown_ids, empty_ids)}
    chosen = configured(config, settings, given, within="slam", also=_SECTIONS, show=show_config)
    of_prior_map = {"shift": shift, "prior_sigma": prior_sigma}
    set_here = [*(settings or []), *(f"slam.{name}=" for name, value in given.items() if value is not None)]
    paths = _recordings(input, one=offline_session is not None)
    inputs = [*paths, config, topics, None if prior_map == "truth" else prior_map, map_file]
    asked = _Asked(chosen, set_here, inputs, as_json, force, realtime, robot, topics, offline_session)
    if together:
        single = {"realtime": realtime or None, "topics": topics, "offline_session": offline_session, "robot": robot}
        in_a_map = {"map_file": map_file, "prior": prior, "localize": localize or None, "prior_map": prior_map}
        of_one = {**single, **in_a_map, **of_prior_map, "start": start}
        refuse_given("is for one robot at a time", "omit it or --together", **of_one)
        _refuse_unread(asked, in_space=False)
        if not _each_together(paths, out, asked):
            raise typer.Exit(EXIT_UNTRUSTWORTHY)
        return
    if prior_map is None:
        refuse_given("there is no prior map", "--prior-map truth, or --prior-map FILE", **of_prior_map)
    _check_map_options(map_file, localize=localize, prior_map=prior_map, method=method, prior=prior, inputs=paths)
    from evermap.io import parse_shift

    shifts = [parse_shift(text) for text in shift or []]
    asked = asked._replace(prior_map=prior_map, prior_sigma_m=prior_sigma or SURVEY_SIGMA_M, shifts=shifts)
    asked = asked._replace(map_file=map_file, priors=prior or [], localize=localize, start=start)
    if len(paths) > 1:
        refuse_given("is for one recording", "a command for each, or --set living.clock_gap_s=SECONDS", start=start)
        trustworthy = _each(paths, out, asked)
    elif asked.map_file is None:
        trustworthy = _run_alone(*_read_inputs(paths[0], out, asked), asked)
    else:
        trustworthy = _run_in_map(*_read_inputs(paths[0], out, asked), asked)
    if not trustworthy:
        raise typer.Exit(EXIT_UNTRUSTWORTHY)


class _Asked(NamedTuple):
    """What the command line asks for, of every recording; the arguments of `slam`.

    Attributes:
        set_here: keys that were set on the command line, as `slam.seed=3`.
        inputs: what is read, and therefore not overwritten.
        shifts: of landmarks of the prior map.
    """

    config: Config
    set_here: Sequence[str]
    inputs: Sequence[str | Path | None]
    as_json: bool
    force: bool
    realtime: bool
    robot: int | None
    topics: Path | None
    offline_session: Path | None
    prior_map: str | None = None
    prior_sigma_m: float = SURVEY_SIGMA_M
    shifts: Sequence[Any] = ()
    map_file: str | None = None
    priors: Sequence[str] = ()
    localize: bool = False
    start: str | None = None


def _each(paths: Sequence[Path], out: Path | None, asked: _Asked) -> bool:
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
            trustworthy &= _run_in_map(*_read_inputs(path, folder, asked), asked, later=number > 0)
        except EvermapError as error:
            refused.append(str(path))
            fail(error.one_line())
    if refused:
        raise DataError(f"{len(refused)} of {len(paths)} sessions were refused: {', '.join(refused)}")
    return trustworthy


def _read_inputs(path: Path, out: Path | None, asked: _Asked) -> tuple[AnyRecording, Landmarks | None, Path]:
    """Return the recording, the landmarks to start from, and the folder of the run, which may be written to.

    The recording is written condensed where that is asked for: repaired first, as before it enters a map.
    """
    from evermap.io import read_recording, shifted
    from evermap.runs.folder import check_replaceable
    from evermap.runs.session_clock import start_at

    if out is not None:  # better now than after the run
        check_replaceable(out, force=asked.force, inputs=asked.inputs)
    session = asked.offline_session
    if session is not None and session.exists() and not asked.force:
        raise ConfigError(f"{session} is there already", field="offline_session", hint="another name, or --force")
    recording = read_recording(path, robot=asked.robot, topics=asked.topics)
    if asked.start is not None:
        recording = start_at(recording, asked.start)
    if session is not None:
        from evermap.io.native_write import write_session
        from evermap.maps.sessions.session import repaired

        write_session(repaired(recording), session)
        say(f"wrote the session for a map to {session} ({session.stat().st_size / 1e3:.0f} kB)")
    if out is None:
        out = default_out(recording.name)
        check_replaceable(out, force=asked.force, inputs=asked.inputs)
    survey = None if asked.prior_map is None else _prior_landmarks(asked.prior_map, asked.prior_sigma_m, recording)
    return recording, None if survey is None else shifted(survey, asked.shifts), out


def _run_alone(recording: AnyRecording, prior: Landmarks | None, out: Path, asked: _Asked) -> bool:
    """Run, write the folder, show the results; returns whether they can be trusted.

    A run interrupted by Ctrl-C is written as far as it got.
    """
    from evermap.pipeline import run_slam
    from evermap.slam.plane import with_prior
    from evermap.slam.space.moving import has_traffic
    from evermap.types import is_in_space

    recording, prior, _ = with_prior(recording, prior, asked.config.slam)
    in_space = is_in_space(recording)
    _refuse_unread(asked, in_space=in_space, boxes=has_traffic(recording))
    if in_space and asked.realtime:
        problem = "all frames of a recording in space are solved together"
        raise ConfigError(problem, field="realtime", hint="leave it out")
    warm_up_for(recording, asked.config, in_map=prior is not None)
    start = time.perf_counter()
    with progress_bar(recording.name) as progress:
        result = run_slam(recording, asked.config, prior_map=prior, realtime=asked.realtime, progress=progress)
    _write(out, recording, result, asked, time.perf_counter() - start)
    if result.interrupted:
        raise KeyboardInterrupt(f"the part of the recording that was processed is in {out}")
    return _is_trustworthy(result)


def _is_trustworthy(result: SlamResult) -> bool:
    return result.verdict is None or result.verdict.kind.is_trustworthy


def _each_together(paths: Sequence[Path], out: Path | None, asked: _Asked) -> bool:
    """Read several robots, run them as one problem, and write a folder for each; returns whether all can be trusted.

    Raises:
        ConfigError: there is one robot.
    """
    from evermap.cli.warmup import warm_up as compile_kernels
    from evermap.io import list_robots, read_recording
    from evermap.pipeline import run_together
    from evermap.runs.folder import check_replaceable

    if len(paths) > 1:
        recordings = {number: read_recording(path) for number, path in enumerate(paths, start=1)}
    else:
        recordings = {number: read_recording(paths[0], robot=number) for number in list_robots(paths[0])}
    if len(recordings) < 2:
        raise ConfigError("there is one robot", field="together", hint="give the recordings of the other robots, too")
    folders = {number: default_out(recording.name) for number, recording in recordings.items()}
    if len(set(folders.values())) < len(folders):
        folders = {number: Path(f"{folder}-{number}") for number, folder in folders.items()}
    if out is not None:
        folders = {number: out / folder.name for number, folder in folders.items()}
    for folder in folders.values():  # better now than after the run
        check_replaceable(folder, force=asked.force, inputs=asked.inputs)
    warm_up(lambda: compile_kernels(search=True))
    start = time.perf_counter()
    with progress_bar(f"{len(recordings)} robots") as progress:
        results = run_together(recordings, asked.config, progress=progress)
    elapsed_s = time.perf_counter() - start
    for number, result in results.items():
        _write(folders[number], recordings[number], result, asked, elapsed_s)
    return all(map(_is_trustworthy, results.values()))


def _write(
    out: Path,
    recording: AnyRecording,
    result: SlamResult,
    asked: _Asked,
    elapsed_s: float,
    entered: Entered | None = None,
) -> None:
    """Write the folder; print its summary as JSON, or the main numbers, the main files and the changes."""
    from evermap.runs.folder import write_run
    from evermap.runs.summary import RunInfo
    from evermap.viz.change_words import explanations, grew
    from evermap.viz.verdict_words import cause_text, further_causes

    info = RunInfo(
        command=command_line(),
        seeds={"slam": asked.config.slam.seed},
        processing_s=None if asked.realtime else elapsed_s,  # at the recording's pace most of it is waiting
        total_s=elapsed_s,
        grown=None if entered is None else len(entered.grown),
        accepted=None if entered is None else not entered.refusal(asked.config),
    )
    summary = write_run(out, recording, result, asked.config, info=info, force=asked.force, inputs=asked.inputs)
    for remark in summary["warnings"]:
        warn(remark)
    if asked.as_json:
        print_json(summary)
        return
    rows = main_numbers(summary)
    files = (out / name for name in ("report.html", "summary.json"))
    rows += [("up", summary["up"]["text"])] if result.landmarks.position_m.shape[1] == 3 else []
    rows += [(file.stem, str(file)) for file in files if file.is_file()]
    print_table(recording.name or "run", rows)
    both_readings = [pair.text for pair in result.undecided]
    for finding in [*both_readings, *explanations(result), *grew(info.grown)]:
        echo(finding)
    if result.verdict is not None:
        for cause in further_causes(result.verdict):
            echo(f"cause: {cause_text(cause)}")
        echo(f"verdict: {result.verdict.text}")


def main_numbers(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the main numbers of a run's summary, with their names; innovations with what they say."""
    from evermap.viz.verdict_words import innovations_text

    plane = summary["metrics"].get("heading_rmse_deg") is not None
    found = {
        key: (label, form.format(summary[section][key]))
        for section, key, label, form in _ROWS
        if summary[section].get(key) is not None and not (plane and key == "orientation_rmse_deg")
    }
    if "nis_mean" in found:
        label, number = found["nis_mean"]
        found["nis_mean"] = label, f"{number}: {innovations_text(summary['metrics']['nis_mean'])}"
    return list(found.values())


def _check_map_options(
    map_file: str | None,
    *,
    localize: bool,
    prior_map: str | None,
    method: str | None,
    prior: list[str] | None,
    inputs: Sequence[Path],
) -> None:
    if prior and (map_file is None or localize):
        raise ConfigError("is for a session of a map", field="prior", hint="--map FILE, without --localize")
    if map_file is None:
        if localize:
            raise ConfigError("needs a map", field="localize", hint="--map FILE")
        if len(inputs) > 1:
            hint = "--map FILE, --together for simultaneous recordings, or a single input"
            raise ConfigError("several recordings need a map", field="input", hint=hint)
        return
    if prior_map is not None and localize:
        raise ConfigError(
            "a living map cannot be combined with a prior map", field="prior_map", hint="either --map or --prior-map"
        )
    if method is not None:
        raise ConfigError(
            "a living map finds changes by itself", field="method", hint="--set living.search=gate, for example"
        )


def _recordings(given: list[Path] | None, *, one: bool) -> list[Path]:
    """Return the recordings that were given: `one` is for a condensed session."""
    if not given:
        hint = "a folder, zip or ROS bag; --init DIR writes an example"
        raise ConfigError("a recording is needed", field="input", hint=hint)
    if one and len(given) > 1:
        raise ConfigError("is for one recording", field="offline_session", hint="a file for each, one after the other")
    return given


def _refuse_unread(asked: _Asked, *, in_space: bool, boxes: bool = False) -> None:
    """Refuse settings that such a recording would silently ignore.

    Raises:
        ConfigError: names the first one.
    """
    from evermap import config

    in_map = asked.map_file is not None
    unread_in_space = [key for key in config.UNREAD_IN_SPACE if not (asked.localize and key == "slam.localize")]
    unread = {
        "for a recording in space": unread_in_space if in_space else (),
        "for a recording in the plane": () if in_space else config.UNREAD_IN_THE_PLANE,
        "for a recording without boxes without identity": () if boxes or not in_space else config.UNREAD_WITHOUT_BOXES,
        "without --map": () if in_map else config.UNREAD_WITHOUT_MAP,
        "without --unknown-ids": () if in_map or asked.config.slam.unknown_ids else ("slam.association",),
    }
    config.refuse_unread(asked.set_here, unread, within="slam")


def _write_what_is_to_edit(folder: Path | None, bag: Path | None, *, in_space: bool) -> None:
    """Write a template of a recording, or the settings of a bag."""
    from evermap.io import write_template

    if folder is not None:
        refuse_given("is for a bag", "one of --init and --init-bag", init_bag=bag)
    if folder is None:
        if bag is None or in_space:
            raise ConfigError("is for a template", field="3d", hint="--init DIR --3d")
        _write_bag_settings(bag)
        return
    if folder.name.startswith("-"):
        raise ConfigError(f"needs a folder, not {folder.name}", field="init", hint="--init DIR --3d")
    write_template(folder, in_space=in_space)
    say(f"wrote a template to {folder}; fill it with your recording, then: evermap slam {folder}")


def _write_bag_settings(bag: Path) -> None:
    from evermap.io.bag import bag_settings, settings_path
    from evermap.io.files import write_atomic

    path = settings_path(bag)
    if path.exists():
        raise ConfigError(f"{path} is there already", field="init_bag", hint="edit it, or delete it to guess again")
    text = bag_settings(bag)
    write_atomic(path, text)
    typer.echo(text)
    say(f"wrote this to {path}; correct it where needed, then: evermap slam {bag}")


def _prior_landmarks(prior_map: str, sigma_m: float, recording: AnyRecording) -> Landmarks:
    from evermap.io import read_prior_map
    from evermap.types import Landmarks

    if prior_map != "truth":
        return read_prior_map(prior_map, sigma_m=sigma_m)
    survey = recording.true_landmarks
    if survey is None:
        problem = "this recording has no surveyed landmarks"
        raise ConfigError(problem, field="prior_map", hint="a landmarks.csv of your own: --prior-map FILE")
    if survey.position_m.shape[1] == 3:
        return survey.as_prior(sigma_m)
    return Landmarks.at(
        survey.landmark_id,
        survey.position_m,
        sigma_m=sigma_m,
        class_id=survey.class_id,
        class_names=survey.class_names,
        frame="prior_map",
    )


def _run_in_map(
    recording: AnyRecording, survey: Landmarks | None, out: Path, asked: _Asked, *, later: bool = False
) -> bool:
    """Run, write the folder, then commit the map, so that every session in the map has its folder.

    One whose verdict is not sound leaves the map as it is (`living.accept`). Returns whether it can be trusted.

    `later`: of several sessions it is not the first, and needs the survey only if none before it began the map.
    """
    from evermap.cli.warmup import warm_up as compile_kernels
    from evermap.existence.models import priors_of
    from evermap.maps.sessions.session import in_its_space
    from evermap.maps.store import open_store
    from evermap.pipeline import run_localization
    from evermap.runs.sessions import at_time, begin_map, enter_session
    from evermap.slam.check import odd, valid
    from evermap.slam.space.moving import has_traffic
    from evermap.types import VerdictKind, is_in_space
    from evermap.valid import strangers

    config, localize, map_file = asked.config, asked.localize, asked.map_file
    assert map_file is not None
    if asked.realtime and not localize:
        raise ConfigError("a session is solved when it ends", field="realtime", hint="--localize")
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
        _refuse_unread(asked, in_space=in_space, boxes=has_traffic(recording))
        if asked.realtime and in_space:
            raise ConfigError("a session is solved when it ends", field="realtime", hint="--localize")
        warm_up(
            lambda: compile_kernels(unknown_ids=unknown, sessions=not localize, localize=localize, in_space=in_space)
        )
        try:
            with progress_bar(recording.name) as progress:
                if localize:
                    stamps = recording.frames.stamp_s
                    living = at_time(store, float(stamps[0]) if len(stamps) else 0.0)
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
        _write(out, recording, result, asked, elapsed_s, entered)
        if result.interrupted:
            raise KeyboardInterrupt(f"the part of the recording that was processed is in {out}; the map is unchanged")
        if entered is not None:
            _commit(entered, store, map_file, config, elapsed_s)
            if begun_from is not None:
                _tell_corrected(begun_from, entered.living.landmarks())
        return _is_trustworthy(result)


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
