"""What a recording contradicts has a cause: is the right one named, and nothing false told?

Every world has one thing that is wrong, or nothing; an oracle that knows it solves the same readings. Rows of runs that
are done are kept beside the results (`evermap_studies.rows`), so that a run that was stopped goes on where it was.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.types import Progress
from evermap_studies.causes.catalogue import GROUPS, World, catalogue
from evermap_studies.causes.judge import Row, errors, judge, make_case, solve
from evermap_studies.frame import Stopwatch, check_least
from evermap_studies.markdown import markdown_table, number
from evermap_studies.rows import RowsFile

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCHEMA_VERSION = "1"
EXPERIMENT = "causes"
MOST_WORLDS = 80
"""Worlds that have a line each in the table; of more there is a line for each cause."""
SCORING = (
    "named: a cause, a finding, a change, a calibration state near its true value, or the line of a refusal says it; "
    "near: error of poses at most 1.5 times that of an oracle that knows the cause, plus 5 mm; right: named, near or "
    "refused, no false change, no false cause, verdict as it should be; silent: enters a map although it is worse than "
    "odometry alone, certain of a false change, has squared errors beyond 4 times their expectation, or map or sensor "
    "are beyond use, and nothing names it"
)


@dataclass(frozen=True, slots=True)
class Settings:
    """What is run; the defaults are everything.

    Attributes:
        groups: of worlds.
        worlds: parts of their names; any of them, all if empty.
        runs: seeds of each world, at most.
        seed: the first.
        quick: only the worlds that stand for all, one seed each.
    """

    groups: tuple[str, ...] = GROUPS
    worlds: tuple[str, ...] = ()
    runs: int = 20
    seed: int = 0
    quick: bool = False

    def __post_init__(self) -> None:
        check_least(self, runs=1, seed=0)


def planned(settings: Settings) -> list[tuple[World, int]]:
    """Return worlds and seeds: the first seed of all worlds, then the second, so that what is stopped has seen all."""
    from evermap.errors import ConfigError

    unknown = sorted(set(settings.groups) - set(GROUPS))
    if unknown:
        raise ConfigError(f"no part of this study: {', '.join(unknown)}", field="part", hint=", ".join(GROUPS))
    worlds = [
        world
        for world in catalogue()
        if world.group in settings.groups
        and (not settings.worlds or any(part in world.name for part in settings.worlds))
        and (world.quick or not settings.quick)
    ]
    if not worlds:
        raise ConfigError(f"no world of this name: {', '.join(settings.worlds)}", field="world")
    most = 1 if settings.quick else settings.runs
    return [(world, settings.seed + k) for k in range(most) for world in worlds if k < world.seeds]


def reproduce(
    out: str | Path, settings: Settings | None = None, *, progress: Progress | None = None, force: bool = False
) -> dict[str, Any]:
    """Run everything that is not in the file of rows yet, and write `summary.json`, `table.md` and the figure.

    Args:
        out: folder for the results; untouched if this run fails, but for the rows beside it.
        settings: what to run; None for everything.
        progress: told after every run.
        force: write into a folder that holds other files, too; they stay.

    Returns:
        `runs` (a dictionary each), `settings`, `machine`; plain JSON values.

    Raises:
        ConfigError: `out` must not be replaced, or nothing is chosen.
    """
    from evermap.runs.folder import RunFolder
    from evermap_studies.frame import save_all

    settings = settings or Settings()
    jobs = planned(settings)
    path = RowsFile.beside(out).path
    with RunFolder(out, force=force) as folder:
        stopwatch = Stopwatch()
        rows = []
        for row in run_all(jobs, path):
            rows.append(row)
            if progress is not None:
                progress(float(len(rows)), float(len(jobs)))
        content = {**stopwatch.head(EXPERIMENT, SCHEMA_VERSION, SCORING, settings), "runs": rows}
        save_all({"right": draw(rows)}, folder.path)
        folder.path("table.md").write_text(as_markdown(content) + "\n", encoding="utf-8")
        return folder.finish(content)


def run_all(jobs: Sequence[tuple[World, int]], path: Path | None) -> Iterator[Row]:
    """Return the rows of worlds and seeds, one after the other; those in a file are not run again, others added."""
    file = None if path is None else RowsFile(path)
    rows = [] if file is None else file.read()
    done = {(row["world"], row["seed"]): row for row in rows}
    oracles = {row["oracle_key"]: {"error_m": row["oracle_m"]} for row in rows if row["oracle_m"] is not None}
    if file is not None:
        file.write(rows)
    for world, seed in jobs:
        if (world.name, seed) not in done:
            done[world.name, seed] = run(world, seed, oracles)
            if file is not None:
                file.add(done[world.name, seed])
        yield done[world.name, seed]


def run(world: World, seed: int, oracles: dict[str, Row]) -> Row:
    """Return the row of a world and a seed; errors of oracles are kept in `oracles`, by what they depend on."""
    case = make_case(world, seed)
    key, oracle = case.oracle_key, None
    if world.group != "mistakes" and world.cause not in ("", "anything") and world.bound_m is None:
        if key not in oracles:
            oracles[key] = errors(solve(case.right), case.right)
        oracle = oracles[key]
    return judge(case, oracle)


def as_markdown(content: Mapping[str, Any]) -> str:
    """Write the tables: claims, causes by plane and space, with and without a map, and what is wrong in silence."""
    rows = content["runs"]
    return "\n\n".join(part for part in (_claims(rows), _by_cause(rows), _silent(rows)) if part)


def _claims(rows: Sequence[Row]) -> str:
    lines = []

    def claim(name: str, some: Iterable[Row], expected: str, key: str, most: float | None = None) -> None:
        chosen = list(some)
        if not chosen:
            return
        if most is None:
            count = sum(bool(row[key]) for row in chosen)
            lines.append([name, expected, f"{count} of {len(chosen)}", _met(count == len(chosen))])
            return
        worst = max((row[key] if row[key] is not None else float("inf")) for row in chosen)
        lines.append([name, expected, f"{worst:.3g}", _met(worst <= most)])

    noise = [row for row in rows if row["cause"] == "noise"]
    for sigma, bound_m in (("0.03", 0.02), ("0.1", 0.03), ("0.3", 0.06)):
        some = [row for row in noise if row["world"].endswith(f"noise {sigma}")]
        claim(
            f"tags as poses, odometry 1 to 3 % wrong, noise {sigma}: worst error [m]",
            some,
            f"≤ {bound_m:g}",
            "error_m",
            bound_m,
        )
    table = [row for row in rows if row["group"] == "table" and row["cause"] not in ("noise", "")]
    claim("causes that reports were about: cause named", table, "all", "named_by")
    claim("causes that reports were about: most false changes", table, "0", "false_changes", 0)
    claim("causes that reports were about: all is right", table, "all", "right")
    claim(
        "orchards without identities: near, or lost", (row for row in rows if "trees" in row["world"]), "all", "right"
    )
    claim(
        "nothing is wrong, and nothing is told",
        (row for row in rows if not row["cause"] and row["group"] != "table"),
        "all",
        "right",
    )
    claim("other causes: all is right", (row for row in rows if row["group"] == "causes"), "all", "right")
    mistakes = [row for row in rows if row["group"] == "mistakes"]
    claim("mistakes of units, axes, signs, mounts, clocks: named", mistakes, "all", "named_by")
    claim("mistakes that enter a map", mistakes, "0", "enters", 0)
    claim("attacks: all is right", (row for row in rows if row["group"] == "attacks"), "all", "right")
    silent = sum(row["silent"] for row in rows)
    lines.append(
        ["wrong in silence, of all runs", "≤ 1 %", f"{silent / len(rows):.1%}", _met(silent <= 0.01 * len(rows))]
    )
    crashes = sum(row["exit"] == 1 for row in rows)
    lines.append(["tracebacks", "0", str(crashes), _met(not crashes)])
    return markdown_table([f"{len(rows)} runs", "expected", "measured", "met"], lines)


def _by_cause(rows: Sequence[Row]) -> str:
    head = [
        "what is wrong",
        "runs",
        "right",
        "named",
        "false changes",
        "error over bound: median, worst",
        "silent",
        "CPU [s]",
    ]
    worlds = dict[str, list[Row]]()
    few = len({row["world"] for row in rows}) <= MOST_WORLDS
    for row in rows:
        space = f"{'space' if row['space'] else 'plane'}, {'in a map' if row['in_map'] else 'alone'}"
        worlds.setdefault(row["world"] if few else f"{row['cause'] or 'nothing'}: {space}", []).append(row)
    lines = []
    for name, some in worlds.items():
        over = sorted(row["error_m"] / row["bound_m"] for row in some if row["error_m"] is not None and row["bound_m"])
        spread = f"{over[len(over) // 2]:.2f}, {over[-1]:.2f}" if over else "–"
        lines.append([
            name, str(len(some)), str(sum(row["right"] for row in some)), _ways(some),
            str(sum(row["false_changes"] for row in some)), spread, str(sum(row["silent"] for row in some)),
            number("{:.1f}", sum(row["cpu_s"] for row in some) / len(some)),
        ])  # fmt: skip
    return markdown_table(head, lines)


def _ways(rows: Sequence[Row]) -> str:
    """Return by what a cause was named, and how often."""
    count: dict[str, int] = {}
    for row in rows:
        if row["named_by"]:
            count[row["named_by"]] = count.get(row["named_by"], 0) + 1
    return ", ".join(f"{way} {times}" for way, times in count.items()) or "–"


def _silent(rows: Sequence[Row]) -> str:
    lines = [
        [
            row["world"], str(row["seed"]), number("{:.3f}", row["error_m"]), number("{:.3f}", row["odometry_m"]),
            number("{:.3f}", row["oracle_m"]), number("{:.1f}", row["nees"]), "; ".join(row["changes"][:2]) or "–",
        ]
        for row in rows
        if row["silent"]
    ]  # fmt: skip
    if not lines:
        return ""
    head = [
        "wrong in silence",
        "seed",
        "error [m]",
        "odometry alone [m]",
        "oracle [m]",
        "NEES over its mean",
        "changes told",
    ]
    return markdown_table(head, lines)


def _met(met: bool) -> str:
    return "yes" if met else "**no**"


def draw(rows: Sequence[Row]) -> Figure:
    """Draw the share of runs that are right, cause by cause, in the plane and in space, with a map and without."""
    from evermap.viz.style import house_style, new_figure, settle

    causes = list(dict.fromkeys(row["cause"] for row in rows))
    columns = [(False, True), (False, False), (True, True), (True, False)]
    with house_style():
        figure = new_figure(6.0, 1.2 + 0.22 * len(causes))
        axes = figure.subplots()
        share = [[_share(rows, cause, *column) for column in columns] for cause in causes]
        axes.imshow(share, cmap="RdYlGn", vmin=0.0, vmax=1.0, aspect="auto")
        for line, values in enumerate(share):
            for column, value in enumerate(values):
                said, ink = "" if np.isnan(value) else f"{value:.0%}", "black" if 0.15 < value < 0.85 else "white"
                axes.text(column, line, said, ha="center", va="center", fontsize=7, color=ink)
        axes.grid(visible=False)
        names = ["plane, map", "plane, alone", "space, map", "space, alone"]
        axes.set_xticks(range(4), names)
        axes.set_yticks(range(len(causes)), [cause or "nothing" for cause in causes])
        axes.set_title("share of runs that are right")
        settle(figure)
    return figure


def _share(rows: Sequence[Row], cause: str, space: bool, in_map: bool) -> float:
    some = [row["right"] for row in rows if (row["cause"], row["space"], row["in_map"]) == (cause, space, in_map)]
    return sum(some) / len(some) if some else float("nan")
