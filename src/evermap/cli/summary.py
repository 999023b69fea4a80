"""The few numbers of `summary.json` that a person wants to see at the end of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from evermap.cli.terminal import echo, print_json, print_table

# (section, key, label, format); a number that the run does not have is left out
_ROWS = (
    ("metrics", "pose_rmse_m", "position error, RMSE", "{:.3f} m"),
    ("metrics", "heading_rmse_deg", "heading error, RMSE", "{:.2f} deg"),
    ("metrics", "heading_rmse_in_view_deg", "  while landmarks were in view", "{:.2f} deg"),
    ("metrics", "landmark_rmse_m", "landmark error, RMSE", "{:.3f} m"),
    ("metrics", "dead_reckoning_rmse_m", "odometry alone, RMSE", "{:.3f} m"),
    ("metrics", "nis_mean", "innovations (2 is consistent)", "{:.2f}"),
    ("timing", "real_time_factor", "speed", "{:.0f} x real time"),
    ("timing", "step_p99_ms", "99 % of the steps within", "{:.1f} ms"),
)


def show_run(summary: Mapping[str, Any], out: Path, *, as_json: bool, findings: Sequence[str] = ()) -> None:
    """The summary as JSON, or its main numbers as a table with the files to look at, and what was found, in words."""
    if as_json:
        print_json(summary)
        return
    rows = [
        (label, form.format(summary[section][key]))
        for section, key, label, form in _ROWS
        if summary.get(section, {}).get(key) is not None
    ]
    files = (out / name for name in ("report.html", "summary.json"))
    rows += [(file.stem, str(file)) for file in files if file.is_file()]
    print_table(str(summary.get("recording", {}).get("name", "run")), rows)
    for finding in findings:
        echo(finding)
