"""Robots of many makes, good and bad, with and without a map: calibrated against plain.

Half of the robots have a map. Each recording is estimated three times: all readings believed ('plain'), calibrated with
nothing stated of the sensor, and calibrated with its kind stated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.slam.calibration import NAMES
from evermap.types import Progress, Recording
from evermap_studies.frame import Stopwatch, check_least
from evermap_studies.markdown import markdown_table, number
from evermap_studies.rows import RowsFile, run_missing
from evermap_studies.worlds.robots import Robot, draw_robot, simulate_robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = dict[str, Any]
SCHEMA_VERSION = "1"
EXPERIMENT = "robots"
METHODS = ("plain", "calibrated", "kind stated")
ERRORS = {"pose_rmse_m": "position", "heading_rmse_deg": "heading", "landmark_rmse_m": "landmarks"}
WITHIN = 1.05
"""A calibrated estimate may be this much worse than a plain one, by the luck of the draw."""
SCORING = (
    "root mean square errors of poses and landmarks, aligned where there is no map; ratios of calibrated to plain, "
    "robot by robot; states: share of the truths within 1.96 standard deviations, of states that were estimated"
)


@dataclass(frozen=True, slots=True)
class Settings:
    """What is run; the defaults are everything.

    Attributes:
        robots: how many, counted up from the seed; those with odd numbers have a map.
        seed: of the first robot.
    """

    robots: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        check_least(self, robots=2, seed=0)


QUICK = Settings(robots=12)
"""A minute."""


def reproduce(
    out: str | Path, settings: Settings | None = None, *, progress: Progress | None = None, force: bool = False
) -> dict[str, Any]:
    """Run everything, and write `summary.json`, `table.md` and the figure.

    Args:
        out: folder for the results; untouched if this run fails, but for the rows beside it, from which it goes on.
        settings: what to run; None for everything.
        progress: told after every robot.
        force: write into a folder that holds other files, too; they stay.

    Returns:
        `robots` (a dictionary each), `settings`, `machine`; plain JSON values.

    Raises:
        ConfigError: `out` must not be replaced.
    """
    from evermap.runs.folder import RunFolder
    from evermap_studies.frame import save_all

    settings, kept = settings or Settings(), RowsFile.beside(out)
    with RunFolder(out, force=force) as folder:
        stopwatch, robots = Stopwatch(), []
        seeds = range(settings.seed, settings.seed + settings.robots)
        for row in run_missing(kept, seeds, lambda missing: map(run, missing)):
            robots.append(row)
            if progress is not None:
                progress(float(len(robots)), float(settings.robots))
        content = {**stopwatch.head(EXPERIMENT, SCHEMA_VERSION, SCORING, settings), "robots": robots}
        save_all({"errors": draw(content)}, folder.path)
        folder.path("table.md").write_text(as_markdown(content) + "\n", encoding="utf-8")
        content = folder.finish(content)
    kept.remove()
    return content


def run(seed: int) -> Row:
    """Estimate the recording of one robot by each method."""
    from evermap.config import Config
    from evermap.metrics.summary import compare_with_truth, metrics_dict
    from evermap.pipeline import run_slam

    robot = draw_robot(seed)
    recording = simulate_robot(robot, seed)
    in_map = recording.true_landmarks if seed % 2 else None
    found: Row = {}
    for method in METHODS:
        config = Config.model_validate({"slam": {"sensor_model": "plain"}}) if method == "plain" else Config()
        result = run_slam(_known(recording, robot) if method == "kind stated" else recording, config, prior_map=in_map)
        metrics = metrics_dict(compare_with_truth(recording, result))
        truth = dict(zip(NAMES, robot.states.tolist(), strict=True))
        states = {
            one.name: {"value": one.value, "sigma": one.sigma, "true": truth[one.name]}
            for one in result.parameters
            if one.name in truth
        }
        found[method] = {**{key: metrics[key] for key in ERRORS}, "states": states}
    return {
        "seed": seed,
        "kind": str(robot.kind),
        "in_map": in_map is not None,
        "as_stated": bool(np.all(robot.states[:5] == 0.0)),
        **found,
    }


def _known(recording: Recording, robot: Robot) -> Recording:
    return replace(recording, sensor=replace(recording.sensor, kind=robot.kind))


def ratios(robots: Sequence[Mapping[str, Any]], method: str, error: str) -> Any:
    """(R,) errors of a method over those of plain ones."""
    return np.array([one[method][error] / max(one["plain"][error], 1e-3) for one in robots])


def covered(robots: Sequence[Mapping[str, Any]], method: str) -> dict[str, tuple[float, int]]:
    """Share of the truths within 1.96 sigmas and how many, by state, of those that were estimated."""
    share = {}
    for name in NAMES:
        states = [one[method]["states"][name] for one in robots]
        inside = [abs(s["value"] - s["true"]) < 1.96 * s["sigma"] for s in states if s["sigma"] > 0.0]
        share[name] = (float(np.mean(inside)) if inside else float("nan"), len(inside))
    return share


def as_markdown(content: Mapping[str, Any]) -> str:
    """Write the tables: claims, ratios by group, states."""
    robots = content["robots"]
    parts = [_claims(robots)]
    header = ["calibrated over plain", "robots", *(f"{name}: mean, 95 %, worst" for name in ERRORS.values())]
    lines = []
    for method in METHODS[1:]:
        for in_map in (False, True):
            for as_stated in (True, False):
                some = [one for one in robots if one["in_map"] == in_map and one["as_stated"] == as_stated]
                if some:
                    where = "in a map" if in_map else "without a map"
                    sensor = "sensor as stated" if as_stated else "sensor with errors"
                    lines.append([f"{method}, {where}, {sensor}", str(len(some)), *_spreads(some, method)])
    parts.append(markdown_table(header, lines))
    header = ["state", *(f"{method}: truths within 1.96 sigmas" for method in METHODS[1:]), "estimated of"]
    shares = [covered(robots, method) for method in METHODS[1:]]
    lines = [
        [name, *(number("{:.0%}", s[name][0] if s[name][1] else None) for s in shares), f"{shares[0][name][1]}"]
        for name in NAMES
    ]
    parts.append(markdown_table(header, lines))
    return "\n\n".join(parts)


def _spreads(robots: Sequence[Mapping[str, Any]], method: str) -> list[str]:
    every = [ratios(robots, method, error) for error in ERRORS]
    return [f"{np.exp(np.log(r).mean()):.2f}, {np.quantile(r, 0.95):.2f}, {r.max():.2f}" for r in every]


def _claims(robots: Sequence[Mapping[str, Any]]) -> str:
    good = [one for one in robots if one["as_stated"]]
    bad = [one for one in robots if not one["as_stated"]]
    lines = []
    for name, some in (("sensor as stated", good), ("sensor with errors", bad)):
        if some:
            r = ratios(some, "calibrated", "pose_rmse_m")
            mean, share = float(np.exp(np.log(r).mean())), float((r > WITHIN).mean())
            lines.append([f"position, calibrated over plain, {name}", "≤ 1.05", f"{mean:.2f}", _met(mean <= WITHIN)])
            lines.append([f"robots more than 1.05 times as wrong, {name}", "0 %", f"{share:.0%}", _met(share == 0.0)])
    inside = [share * count for share, count in covered(robots, "calibrated").values() if count]
    total = sum(count for _, count in covered(robots, "calibrated").values())
    whole = sum(inside) / max(total, 1)
    lines.append(["truths of states within 1.96 sigmas", "93 to 97 %", f"{whole:.0%}", _met(0.93 <= whole <= 0.97)])
    return markdown_table([f"default settings, {len(robots)} robots", "expected", "measured", "met"], lines)


def _met(met: bool) -> str:
    return "yes" if met else "**no**"


def draw(content: Mapping[str, Any]) -> Figure:
    """Draw the errors of every robot, calibrated against plain."""
    from evermap.viz.style import ALERT, ESTIMATE, MUTED, house_style, new_figure, settle

    robots = content["robots"]
    units = {"pose_rmse_m": "m", "heading_rmse_deg": "degrees", "landmark_rmse_m": "m"}
    with house_style():
        figure = new_figure(9.0, 3.2)
        for axes, (error, name) in zip(figure.subplots(1, 3), ERRORS.items(), strict=True):
            for as_stated, colour, marker, label in (
                (True, ESTIMATE, "o", "sensor as stated"),
                (False, ALERT, "^", "sensor with errors"),
            ):
                some = [one for one in robots if one["as_stated"] == as_stated]
                plain, calibrated = ([max(one[m][error], 1e-4) for one in some] for m in METHODS[:2])
                axes.scatter(plain, calibrated, s=12, color=colour, marker=marker, alpha=0.7, label=label)
            low, high = min(axes.get_xlim()[0], axes.get_ylim()[0]), max(axes.get_xlim()[1], axes.get_ylim()[1])
            low = max(low, min(max(one[m][error], 1e-4) for one in robots for m in METHODS[:2]) * 0.7)
            axes.plot([low, high], [low, high], color=MUTED, lw=0.9, ls="--")
            axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high), title=name)
            axes.set_xlabel(f"plain [{units[error]}]")
        figure.axes[0].set_ylabel("calibrated")
        figure.axes[0].legend(loc="upper left", markerscale=1.2)
        settle(figure)
    return figure
