"""`evermap slam`: trajectory and landmark map of one recording."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evermap.cli.options import (
    AsJson,
    ConfigFile,
    Force,
    Robot,
    Settings,
    ShowConfig,
    Topics,
    UnknownIds,
    argument,
    option,
)
from evermap.cli.recordings import (
    OfflineSession,
    Out,
    PriorMap,
    RunRequest,
    Shifts,
    ask,
    read_inputs,
    refuse_unread,
    write_results,
)
from evermap.cli.terminal import EXIT_UNTRUSTWORTHY, progress_bar, warm_up_for
from evermap.errors import ConfigError

if TYPE_CHECKING:
    from evermap.types import AnyRecording, Landmarks

Recorded = Annotated[
    list[Path] | None,
    argument("Folder in the native format, zip or ROS bag.", metavar="INPUT", default=False),
]
Start = Annotated[str | None, option("When the recording began.", metavar="DATE", hidden=True)]
Realtime = Annotated[bool, option("--realtime", "Process at the pace of the recording.", hidden=True)]

HELP = """\
Estimate the trajectory and the map of landmarks.

What was recorded in a living map is for `evermap map enter` and `evermap localize`, simultaneous recordings of several
robots are for `evermap together`, and `evermap init` writes templates.

\b
Most useful with --set:
  sensor_model=plain      trust the readings; by default errors of sensor and odometry are estimated
  unknown_ids=empty       associate detections without an id by geometry; others keep theirs
  method=nohyp            assume that nothing moves; or max-mixture, nn, em, mcts, viterbi (Nielsen 2024)

\b
Examples:
  evermap slam my-recording --out out/mine
  evermap slam monday.mcap
  evermap slam MRCLAM_Dataset6.zip --robot 1 --out out/robot1
  evermap slam MRCLAM_Dataset6.zip --robot 1 --prior-map truth,sigma=0.05 --set method=viterbi
"""


def slam(
    input: Recorded = None,
    robot: Robot = None,
    topics: Topics = None,
    out: Out = None,
    config: ConfigFile = None,
    settings: Settings = None,
    unknown_ids: UnknownIds = False,
    prior_map: PriorMap = None,
    as_json: AsJson = False,
    force: Force = False,
    show_config: ShowConfig = False,
    start: Start = None,
    realtime: Realtime = False,
    offline_session: OfflineSession = None,
    shift: Shifts = None,
) -> None:
    """Estimate trajectory and landmarks of a recording and write the folder of the run."""
    asked = ask(
        input or [],
        config,
        settings,
        unknown_ids=unknown_ids,
        show=show_config,
        prior_map=prior_map,
        shift=shift,
        robot=robot,
        topics=topics,
        as_json=as_json,
        force=force,
        start=start,
        realtime=realtime,
        offline_session=offline_session,
    )
    if not input:
        hint = "a folder, zip or ROS bag; evermap init recording DIR writes an example"
        raise ConfigError("a recording is needed", field="input", hint=hint)
    if len(input) > 1:
        hint = "evermap map enter MAP INPUT..., evermap together INPUT... if they are simultaneous, or a single input"
        raise ConfigError("several recordings need a map", field="input", hint=hint)
    if not _run_alone(*read_inputs(input[0], out, asked), asked):
        raise typer.Exit(EXIT_UNTRUSTWORTHY)


def _run_alone(recording: AnyRecording, prior: Landmarks | None, out: Path, asked: RunRequest) -> bool:
    """Run, write the folder, show the results; returns whether they can be trusted.

    A run interrupted by Ctrl-C is written as far as it got.
    """
    from evermap.pipeline import run_slam
    from evermap.slam.plane import with_prior
    from evermap.slam.space.moving import has_traffic
    from evermap.types import is_in_space

    recording, prior, _ = with_prior(recording, prior, asked.config.slam)
    in_space = is_in_space(recording)
    refuse_unread(asked, in_space=in_space, boxes=has_traffic(recording))
    if in_space and asked.realtime:
        problem = "all frames of a recording in space are solved together"
        raise ConfigError(problem, field="realtime", hint="leave it out")
    warm_up_for(recording, asked.config, in_map=prior is not None)
    start = time.perf_counter()
    with progress_bar(recording.name) as progress:
        result = run_slam(recording, asked.config, prior_map=prior, realtime=asked.realtime, progress=progress)
    write_results(out, recording, result, asked, time.perf_counter() - start)
    if result.interrupted:
        raise KeyboardInterrupt(f"the part of the recording that was processed is in {out}")
    return result.is_trustworthy
