"""`evermap check`: a summary of a recording, its problems, and the verdict that `evermap slam` would end with."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evermap.cli.options import (
    AsJson,
    ConfigFile,
    Robot,
    Settings,
    ShowConfig,
    UnknownIds,
    argument,
    configure,
    option,
)
from evermap.cli.terminal import (
    EXIT_UNTRUSTWORTHY,
    EXIT_USER,
    echo,
    fail,
    print_json,
    print_table,
    progress_bar,
    remark_as,
    say,
    warm_up_for,
    warn,
)

if TYPE_CHECKING:
    from evermap.config import Config
    from evermap.types import AnyRecording, Verdict

UNASKED = "not asked by --quick: mounts, scales, delays below a second, mixed identities (try: without --quick)"
"""What the readings alone cannot tell."""


def check(
    input: Annotated[Path, argument("Folder in the native format, zip or ROS bag.", metavar="INPUT")],
    robot: Robot = None,
    config: ConfigFile = None,
    settings: Settings = None,
    unknown_ids: UnknownIds = False,
    quick: Annotated[bool, option("--quick", "Look at the readings alone, without a solution.")] = False,
    show_config: ShowConfig = False,
    as_json: AsJson = False,
) -> None:
    """Check whether a recording is usable, and report problems.

    Checks units, signs, clocks, gaps, jumps, rates, identities, limits and coverage; then solves the recording, unless
    that shows it to be unusable, and ends with the verdict and the exit code of `evermap slam`; nothing is written.
    Exit code 0: usable, possibly with warnings; 3: not to be trusted, each reason in one line; 2: it cannot be read, or
    nothing can be estimated from it.

    \b
    Examples:
      evermap check my-recording
      evermap check MRCLAM_Dataset6.zip --robot 1 --json
      evermap check my-recording --unknown-ids
      evermap check monday.mcap --quick
    """
    given = {"slam.unknown_ids": unknown_ids or None}
    chosen = configure(config, settings, given, within="slam.check", also=["sensor"], show=show_config)
    from evermap.io import read_recording
    from evermap.runs.summary import verdict_dict
    from evermap.slam.check import check_recording

    if quick:
        _refuse_unread(settings)
    recording = read_recording(input, robot=robot)
    found = check_recording(recording, chosen)
    if not as_json:
        print_table(found.name, content_rows(found.contents))
    for remark in found.warnings:
        warn(remark)
    for finding in found.findings:
        (warn if finding.usable else fail)(remark_as.get()(finding.message))
    verdict = None if quick or not found.usable else find_verdict(recording, chosen)
    usable = found.usable and (verdict is None or verdict.kind.is_trustworthy)
    if as_json:
        print_json({**found.as_dict(), "usable": usable, "verdict": None if verdict is None else verdict_dict(verdict)})
    elif verdict is not None:
        echo(f"verdict: {verdict.text}")
    if usable and not found.warnings and not found.findings:
        say("no problems found")
    if quick and usable:
        say(UNASKED)
    if found.is_refused:
        raise typer.Exit(EXIT_USER)
    if not usable:
        raise typer.Exit(EXIT_UNTRUSTWORTHY)


def find_verdict(recording: AnyRecording, config: Config) -> Verdict | None:
    """Return the verdict that `evermap slam` ends with, without a map.

    Raises:
        EvermapError: nothing can be estimated.
    """
    from evermap.pipeline import run_slam
    from evermap.slam.plane import with_prior

    recording, _, _ = with_prior(recording, None, config.slam)
    warm_up_for(recording, config)
    with progress_bar(recording.name) as progress:
        result = run_slam(recording, config, progress=progress)
    if result.interrupted:
        raise KeyboardInterrupt
    return result.verdict


def _refuse_unread(settings: list[str] | None) -> None:
    from evermap.config import SlamConfig, refuse_unread

    reads = ("check", "cleaning", "space", "plane", "unknown_ids")
    unread = [f"slam.{name}" for name in SlamConfig.model_fields if name not in reads]
    refuse_unread(settings or [], {"with --quick": unread}, within="slam.check")


def content_rows(contents: dict[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """Return what a recording holds, one line a table and a little more."""
    odometry, frames = contents["odometry"], contents["frames"]
    detections, landmarks = contents["detections"], contents["landmarks"]
    rate = "" if frames["rate_hz"] is None else f" at {frames['rate_hz']:.3g} Hz"
    rows = [("odometry", "none")]
    if odometry:
        driven = f"{odometry['rows']:,} rows in {odometry['duration_s']:,.1f} s at {odometry['rate_hz']:.3g} Hz"
        way = f"{odometry['way_m']:,.1f} m, up to {odometry['fastest_mps']:.3g} m/s; {odometry['turned_rad']:.1f} rad"
        rows = [("odometry", driven), ("longest gap", f"{odometry['longest_gap_s']:.3g} s"), ("way", way)]
    unlisted = "" if frames["complete"] else "; frames without are not listed"
    rows += [
        ("frames", f"{frames['count']:,}{rate}, {frames['with_detections']:,} with detections{unlisted}"),
        ("blind for", f"at most {frames['longest_blind_s']:.3g} s"),
        ("detections", f"{detections['count']:,}, {detections['without_identity']:,} without identity"),
    ]
    if "by_sensor" in detections:
        rows += [("by sensor", ", ".join(f"{name} {count:,}" for name, count in detections["by_sensor"].items()))]
        kinds = ("with_orientation", "with_corners", "with_size", "without_range")
        rows += [("of them", ", ".join(f"{detections[kind]:,} {kind.replace('_', ' ')}" for kind in kinds))]
    for kind, unit in (("range", "m"), ("bearing", "rad")):
        if low_middle_high := detections.get(f"{kind}_{unit}"):
            low, middle, high = low_middle_high
            rows += [(f"{kind}s", f"{low:.3g} to {high:.3g} {unit}, half of them below {middle:.3g} {unit}")]
    if detections.get("without_bearing"):
        rows += [("ranges only", f"{detections['without_bearing']:,} detections without a bearing")]
    aside = "bearings" if "bearing_rad" in detections else "tags"
    beyond = f"{detections['beyond_range_max']:,} ranges, {detections['outside_view']:,} {aside}"
    further = ", ".join(f"{count:,} {kind}" for kind, count in contents["measurements"].items())
    return [
        *rows,
        ("beyond limits", beyond),
        ("landmarks", f"{landmarks['count']:,}, {landmarks['seen_once']:,} of them seen once"),
        *([("measurements", further)] if further else []),
    ]
