"""`evermap check`: a summary of a recording and its problems, before anything is estimated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from evermap.cli.options import (
    AsJson,
    ConfigFile,
    EmptyIds,
    Robot,
    Settings,
    ShowConfig,
    UnknownIds,
    argument,
    associated,
    configured,
)
from evermap.cli.terminal import EXIT_UNTRUSTWORTHY, fail, print_json, print_table, remark_as, say, warn


def check(
    input: Annotated[Path, argument("Folder in the native format, zip or ROS bag.", metavar="INPUT")],
    robot: Robot = None,
    config: ConfigFile = None,
    settings: Settings = None,
    unknown_ids: UnknownIds = False,
    empty_ids: EmptyIds = False,
    show_config: ShowConfig = False,
    as_json: AsJson = False,
) -> None:
    """Check whether a recording is usable, and report problems.

    Checks units, signs, clocks, gaps, jumps, rates, identities, limits and coverage. Exit code 0: usable, possibly with
    warnings; 3: unusable, each reason in one line, as `evermap slam` ends with; 2: it cannot be read.

    \b
    Examples:
      evermap check my-recording
      evermap check MRCLAM_Dataset6.zip --robot 1 --json
      evermap check my-recording --unknown-ids
      evermap check monday.mcap
    """
    given = {"slam.unknown_ids": associated(unknown_ids, empty_ids)}
    chosen = configured(config, settings, given, within="slam.check", also=["sensor"], show=show_config)
    from evermap.config import SlamConfig, refuse_unread
    from evermap.io import read_recording
    from evermap.slam.check import check_recording

    reads = ("check", "cleaning", "space", "plane", "unknown_ids")
    unread = [f"slam.{name}" for name in SlamConfig.model_fields if name not in reads]
    refuse_unread(settings or [], {"by this command": unread}, within="slam.check")
    found = check_recording(read_recording(input, robot=robot), chosen)
    if as_json:
        print_json(found.as_dict())
    else:
        print_table(found.name, content_rows(found.contents))
    for remark in found.warnings:
        warn(remark)
    for finding in found.findings:
        (warn if finding.usable else fail)(remark_as.get()(finding.message))
    if not found.usable:
        raise typer.Exit(EXIT_UNTRUSTWORTHY)
    if not found.warnings and not found.findings:
        say("no problems found")


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
