"""`evermap slam`: trajectory and landmark map of one recording."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evermap.cli.summary import show_run
from evermap.cli.terminal import command_line, progress_bar, say, warm_up, warn
from evermap.errors import ConfigError

if TYPE_CHECKING:
    from evermap.config import Config
    from evermap.types import Landmarks, Recording


class SensorModel(StrEnum):
    """How far readings are believed."""

    CALIBRATED = "calibrated"
    PLAIN = "plain"


class Method(StrEnum):
    """How landmarks that moved are explained; the choices of `slam.method`."""

    NOHYP = "nohyp"
    MAX_MIXTURE = "max-mixture"
    NN = "nn"
    EM = "em"
    MCTS = "mcts"
    VITERBI = "viterbi"
    JOINT = "joint"


def slam(
    recording_path: Annotated[
        Path | None,
        typer.Argument(
            metavar="INPUT", help="Folder in the native format, or MRCLAM zip or folder.", show_default=False
        ),
    ] = None,
    robot: Annotated[
        int | None, typer.Option(help="Robot of a recording that has several.", show_default=False)
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results.", show_default="evermap-out/<recording>")
    ] = None,
    config_file: Annotated[
        Path | None, typer.Option("--config", help="TOML file; see --show-config.", show_default=False)
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Override one setting, e.g. slam.robust=false; repeatable."),
    ] = None,
    sensor_model: Annotated[
        SensorModel | None,
        typer.Option(help="Estimate sensor and odometry errors, or believe the readings.", show_default="calibrated"),
    ] = None,
    method: Annotated[
        Method | None,
        typer.Option(
            help="How landmarks that moved are explained; nohyp: the world is static.", show_default=Method.JOINT.value
        ),
    ] = None,
    unknown_ids: Annotated[
        bool, typer.Option("--unknown-ids", help="Ignore the landmark ids of the detections; associate by geometry.")
    ] = False,
    prior_map: Annotated[
        str | None,
        typer.Option(metavar="FILE|truth", help="Start from this landmark map, or from the recording's surveyed one."),
    ] = None,
    prior_sigma: Annotated[
        float,
        typer.Option(min=1e-6, help="Standard deviation of the surveyed map, or of one without sigmas of its own [m]."),
    ] = 0.02,
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map",
            metavar="FILE",
            help="Continue this living map, or begin it: localise in it, find what changed, extend it.",
            show_default=False,
        ),
    ] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[CLASS=]PRIOR|FILE.json",
            help="With --map: how long things stay, as 'cart=weibull:scale=3d,shape=1.5', or a file of survival fit, "
            "survival learn or map export --lifetimes; worth living.prior_stays stays; repeatable.",
        ),
    ] = None,
    localize: Annotated[
        bool, typer.Option("--localize", help="With --map: only localise, at a fixed cost per frame; the map stays.")
    ] = False,
    shift: Annotated[
        list[str] | None,
        typer.Option(
            metavar="IDS:DX[,DY[,TURN]]",
            help="Move landmarks of the prior map, e.g. 11,12,13:+1.0 [m, m, degrees]; for experiments; repeatable.",
        ),
    ] = None,
    realtime: Annotated[bool, typer.Option("--realtime", help="Process at the pace of the recording.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Write into --out even if it holds other files; they stay.")
    ] = False,
    init: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write a commented template of a recording and exit.", show_default=False),
    ] = None,
    show_config: Annotated[
        bool, typer.Option("--show-config", help="Print the configuration in force as commented TOML and exit.")
    ] = False,
) -> None:
    """Estimate where the robot was and where the landmarks are.

    \b
    Examples:
      evermap slam --init my-recording
      evermap slam my-recording --out out/mine
      evermap slam MRCLAM_Dataset6.zip --robot 1 --out out/robot1
      evermap slam MRCLAM_Dataset6.zip --prior-map truth --shift "11,12,13:+1.0" --method viterbi
      evermap slam monday --map building.evermap
      evermap slam tuesday --map building.evermap --localize
      evermap slam monday --map building.evermap --prior "cart=exponential:half-life=2d" --prior wall=never-leaves
    """
    if init is not None:
        _write_template(init)
        return
    from evermap.config import load_config, to_toml

    shortcuts = [] if sensor_model is None else [f"slam.sensor_model={sensor_model.value}"]
    shortcuts += [] if method is None else [f"slam.method={method.value}"]
    shortcuts += ["slam.unknown_ids=true"] if unknown_ids else []
    config = load_config(config_file, [*(settings or []), *shortcuts])
    if show_config:
        typer.echo(to_toml(config), nl=False)
        return
    if recording_path is None:
        raise ConfigError(
            "a recording is needed", field="INPUT", hint="a folder or zip; --init DIR shows what to put in"
        )
    from evermap.io import parse_shift, read_recording, shifted
    from evermap.runs.folder import check_replaceable

    shifts = [parse_shift(text) for text in shift or []]
    if shifts and prior_map is None:
        raise ConfigError("there is no map to shift", field="--shift", hint="--prior-map truth, or --prior-map FILE")
    _check_map_options(map_file, localize=localize, prior_map=prior_map, method=method)
    if prior and (map_file is None or localize):
        raise ConfigError("is for a session of a map", field="--prior", hint="--map FILE, without --localize")
    inputs = [recording_path, config_file, None if prior_map == "truth" else prior_map, map_file]
    if out is not None:  # better now than after the run
        check_replaceable(out, force=force, inputs=inputs)
    recording = read_recording(recording_path, robot=robot)
    if out is None:
        out = default_out(recording.name)
        check_replaceable(out, force=force, inputs=inputs)
    if map_file is not None:
        from evermap.cli.slam_in_map import MapOptions, run_in_map

        options = MapOptions(map_file, prior or [], localize, realtime)
        run_in_map(recording, config, options, out, as_json=as_json, force=force, inputs=inputs)
        return
    start = None if prior_map is None else shifted(_prior_landmarks(prior_map, prior_sigma, recording), shifts)
    run_and_write(recording, config, out, prior=start, realtime=realtime, as_json=as_json, force=force, inputs=inputs)


def run_and_write(
    recording: Recording,
    config: Config,
    out: Path,
    *,
    prior: Landmarks | None = None,
    realtime: bool = False,
    as_json: bool = False,
    force: bool = False,
    inputs: Sequence[str | Path | None] = (),
) -> None:
    """Run, write the folder, show what came out. A run that Ctrl-C cut short is written as far as it came."""
    from evermap.pipeline import run_slam
    from evermap.runs.folder import RunInfo, write_run
    from evermap.slam.changes.joint import may_search
    from evermap.slam.warmup import warm_up as compile_kernels
    from evermap.viz.change_words import explanations

    in_map = prior is not None
    warm_up(lambda: compile_kernels(search=may_search(len(recording.frames.stamp_s), in_map=in_map)))
    start = time.perf_counter()
    with progress_bar(recording.name) as progress:
        result = run_slam(recording, config, prior_map=prior, realtime=realtime, progress=progress)
    elapsed_s = time.perf_counter() - start
    info = RunInfo(
        command=command_line(),
        seeds={"slam": config.slam.seed},
        processing_s=None if realtime else elapsed_s,  # at the recording's pace most of it is waiting
        total_s=elapsed_s,
    )
    summary = write_run(out, recording, result, config, info=info, force=force, inputs=inputs)
    for remark in summary["warnings"]:
        warn(remark)
    show_run(summary, out, as_json=as_json, findings=explanations(result))
    if result.interrupted:
        raise KeyboardInterrupt(f"the part of the recording that was processed is in {out}")


def _check_map_options(map_file: Path | None, *, localize: bool, prior_map: str | None, method: Method | None) -> None:
    if map_file is None:
        if localize:
            raise ConfigError("needs a map", field="--localize", hint="--map FILE")
        return
    if prior_map is not None:
        raise ConfigError("a living map takes no other one", field="--prior-map", hint="either --map or --prior-map")
    if method is not None:
        raise ConfigError(
            "a living map finds changes by itself", field="--method", hint="--set living.search=gate, for example"
        )


def default_out(name: str) -> Path:
    """`evermap-out/mrclam_dataset6-robot-1` for 'MRCLAM_Dataset6 robot 1'."""
    return Path("evermap-out") / (re.sub(r"[^a-z0-9_.]+", "-", name.lower()).strip("-.") or "run")


def _write_template(folder: Path) -> None:
    from evermap.io import write_template

    write_template(folder)
    say(f"wrote a template to {folder}; fill it with your recording, then: evermap slam {folder}")


def _prior_landmarks(prior_map: str, sigma_m: float, recording: Recording) -> Landmarks:
    from evermap.io import read_prior_map
    from evermap.types import Landmarks

    if prior_map != "truth":
        return read_prior_map(prior_map, sigma_m=sigma_m)
    survey = recording.true_landmarks
    if survey is None:
        problem = "this recording has no surveyed landmarks"
        raise ConfigError(problem, field="--prior-map", hint="a landmarks.csv of your own: --prior-map FILE")
    return Landmarks.at(
        survey.landmark_id,
        survey.position_m,
        sigma_m=sigma_m,
        class_id=survey.class_id,
        class_names=survey.class_names,
        frame="prior_map",
    )
