"""What the verbs share that solve recordings: what is asked, reading, and the folder of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from evermap.cli.options import argument, configure, default_out, option
from evermap.cli.terminal import command_line, echo, print_json, print_table, say, warn
from evermap.errors import ConfigError

if TYPE_CHECKING:
    from evermap.config import Config
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
_SECTIONS = ("living", "sensor", "output", "track")
"""Sections of the configuration that are read beside `slam`."""

Recordings = Annotated[
    list[Path],
    argument("Folders in the native format, zips or ROS bags, in the order of their sessions.", metavar="INPUT..."),
]
Out = Annotated[
    Path | None,
    option("Folder for the results; for several recordings, one subfolder each.", default="evermap-out/<recording>"),
]
PriorMap = Annotated[
    str | None,
    option(
        "Start from this landmark map, or from the recording's surveyed one; sigma is the standard deviation of the "
        f"surveyed map, or of a map without sigmas, {SURVEY_SIGMA_M:g} by default [m].",
        metavar="FILE|truth[,sigma=M]",
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
Realtime = Annotated[bool, option("--realtime", "Process at the pace of the recording.")]
Shifts = Annotated[
    list[str] | None,
    option("Move landmarks of the prior map; for experiments.", metavar="IDS:DX[,DY[,TURN]]", hidden=True),
]
OfflineSession = Annotated[
    Path | None, option("Also write the session condensed for a map.", metavar="FILE.zip", hidden=True)
]


class RunRequest(NamedTuple):
    """What the command line asks for, of every recording.

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
    realtime: bool = False
    robot: int | None = None
    topics: Path | None = None
    offline_session: Path | None = None
    prior_map: str | None = None
    prior_sigma_m: float = SURVEY_SIGMA_M
    shifts: Sequence[Any] = ()
    map_file: str | None = None
    priors: Sequence[str] = ()
    localize: bool = False
    start: str | None = None


def ask(
    paths: Sequence[Path],
    config: Path | None,
    settings: list[str] | None,
    *,
    unknown_ids: bool = False,
    show: bool = False,
    prior_map: str | None = None,
    shift: Sequence[str] | None = None,
    **given: Any,
) -> RunRequest:
    """Return what a command line asks for, with the configuration in force.

    Args:
        paths: recordings.
        config: as of `configure`.
        settings: as of `configure`.
        unknown_ids: set `slam.unknown_ids`.
        show: print the configuration and exit.
        prior_map: 'truth', or a file; with or without `,sigma=M`.
        shift: as of `evermap.io.parse_shift`.
        given: further fields.
    """
    flags = {"unknown_ids": unknown_ids or None}
    chosen = configure(config, settings, flags, within="slam", also=_SECTIONS, show=show)
    set_here = [*(settings or []), *(["slam.unknown_ids="] if unknown_ids else [])]
    shifts = []
    if shift:
        from evermap.io import parse_shift

        shifts = [parse_shift(text) for text in shift]
    survey, sigma_m = (None, SURVEY_SIGMA_M) if prior_map is None else _parse_prior_map(prior_map)
    survey_file = None if survey == "truth" else survey
    read = [*paths, config, given.get("topics"), survey_file, given.get("map_file")]
    return RunRequest(chosen, set_here, read, prior_map=survey, prior_sigma_m=sigma_m, shifts=shifts, **given)


def _parse_prior_map(text: str) -> tuple[str, float]:
    """Return the file of `FILE,sigma=0.1`, or 'truth', and the standard deviation of its landmarks [m].

    Raises:
        ConfigError: the standard deviation is not positive.
    """
    name, found, sigma = text.rpartition(",sigma=")
    if not found:
        return text, SURVEY_SIGMA_M
    try:
        sigma_m = float(sigma)
    except ValueError:
        sigma_m = 0.0
    if not 1e-6 <= sigma_m < float("inf"):
        raise ConfigError(f"'{sigma}' is no standard deviation [m]", field="prior_map", hint=f"{name},sigma=0.1")
    return name, sigma_m


def read_inputs(path: Path, out: Path | None, asked: RunRequest) -> tuple[AnyRecording, Landmarks | None, Path]:
    """Return the recording, the landmarks to start from, and the folder of the run, which may be written to.

    The recording is written condensed where that is asked for: repaired first, as before it enters a map.
    """
    from evermap.io import read_recording, shifted
    from evermap.runs.folder import check_replaceable
    from evermap.runs.session_clock import start_at

    if out is not None:  # better now than after the run
        check_replaceable(out, force=asked.force, inputs=asked.inputs)
    if asked.offline_session is not None:
        check_session(asked.offline_session, force=asked.force, inputs=asked.inputs)
    recording = read_recording(path, robot=asked.robot, topics=asked.topics)
    if asked.start is not None:
        recording = start_at(recording, asked.start)
    if asked.offline_session is not None:
        write_condensed(recording, asked.offline_session)
    if out is None:
        out = default_out(recording.name)
        check_replaceable(out, force=asked.force, inputs=asked.inputs)
    survey = None if asked.prior_map is None else _prior_landmarks(asked.prior_map, asked.prior_sigma_m, recording)
    return recording, None if survey is None else shifted(survey, asked.shifts), out


def check_session(path: Path, *, force: bool, inputs: Sequence[str | Path | None]) -> None:
    """Refuse to replace a file by a condensed session.

    Raises:
        ConfigError: it exists, or is what is read.
    """
    from evermap.runs.folder import check_output_file

    check_output_file(path, inputs=inputs, force=force)


def write_condensed(recording: AnyRecording, path: Path) -> None:
    """Write what a map needs of a recording, repaired first, as before it enters a map."""
    from evermap.io.native_write import write_session
    from evermap.maps.sessions.admission import repair

    write_session(repair(recording), path)
    say(f"wrote the session for a map to {path} ({path.stat().st_size / 1e3:.0f} kB)")


def write_results(
    out: Path,
    recording: AnyRecording,
    result: SlamResult,
    asked: RunRequest,
    elapsed_s: float,
    entered: Entered | None = None,
) -> None:
    """Write the folder; print its summary as JSON, or the main numbers, the main files and the changes."""
    from evermap.runs.folder import write_run
    from evermap.runs.summary import RunInfo
    from evermap.viz.change_words import explanations, grew
    from evermap.viz.verdict_words import cause_text, further_causes

    is_accepted = None if entered is None else not entered.refusal(asked.config)
    info = RunInfo(
        command=command_line(),
        seeds={"slam": asked.config.slam.seed},
        processing_s=None if asked.realtime else elapsed_s,  # at the recording's pace most of it is waiting
        total_s=elapsed_s,
        grown=None if entered is None else len(entered.grown) if is_accepted else 0,
        accepted=is_accepted,
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


def refuse_unread(asked: RunRequest, *, in_space: bool, boxes: bool = False) -> None:
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
        "without a map": () if in_map else config.UNREAD_WITHOUT_MAP,
        "without --unknown-ids": () if in_map or asked.config.slam.unknown_ids else ("slam.association",),
    }
    config.refuse_unread(asked.set_here, unread, within="slam")


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
