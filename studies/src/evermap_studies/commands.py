"""The commands of the studies, found by `evermap` through the entry points 'evermap.studies' and 'evermap.verbs'.

Importing this module loads no study: each command imports its own when it runs.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evermap.cli.moved import Moved
from evermap.cli.terminal import print_json, progress_bar, say, warn
from evermap.errors import ConfigError
from evermap_studies.demo.command import demo

if TYPE_CHECKING:
    from evermap.types import Progress

    AsText = Callable[[Mapping[str, Any]], str]
    """Write a table as Markdown."""
    Compute = Callable[[Path, Progress | None], tuple[dict[str, Any], Callable[..., str]]]
    """Compute a study into a folder; returns its table, and what writes it as text."""

__all__ = [
    "association",
    "bateman2020",
    "building",
    "causes",
    "demo",
    "liars",
    "lifelong",
    "lifetimes",
    "mrclam",
    "nielsen2024",
    "occupancy",
    "partial_views",
    "presence",
    "robots",
    "rosen2016",
    "soak",
]

MRCLAM = Path("../shared/data/mrclam")
PRESENCE = Path("../shared/data/presence")
GOLDEN = Path("../shared/golden")

Out = Annotated[Path | None, typer.Option(help="Folder for the results.", show_default="evermap-out/<study>")]
Data = Annotated[Path, typer.Option(help="Folder with the recordings.")]
Seed = Annotated[int, typer.Option(help="Same seed, same numbers.")]
Jobs = Annotated[int, typer.Option(min=1, help="Runs at a time; 1 for timings that mean something.")]
Quick = Annotated[bool, typer.Option("--quick", help="A little of everything, minutes instead of hours.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the table as JSON.")]
Force = Annotated[bool, typer.Option("--force", help="Write into --out even if it holds other files; they stay.")]


def association(
    what: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[space|harsh|columns|mixed|wrong|exchanged|sessions] [NAME...]",
            help="Which part, then beginnings of the names of recordings.",
            show_default="recordings in the plane",
        ),
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="Folder with the recordings.", show_default="../shared/data")
    ] = None,
) -> None:
    """Associate landmarks without identities, and compare with the same recordings with identities.

    \b
    Examples:
      evermap reproduce association MRCLAM DLR
      evermap reproduce association sessions
    """
    _benchmark("association").main(what or (), **_given(folder=data))


def soak(hours: Annotated[float, typer.Option(min=0.05, help="Hours of driving.")] = 24.0, seed: Seed = 0) -> None:
    """Drive for a day with all faults of sensors, logs and clocks, and without, into one living map each.

    \b
    Example:
      evermap reproduce soak --hours 1
    """
    _benchmark("soak").main(["--hours", str(hours), "--seed", str(seed)])


def occupancy(
    table: Annotated[Path, typer.Argument(help="Looks: stamp_s, feature_id, detected.")],
    season_d: Annotated[float, typer.Option(min=1e-3, help="Days between the beginnings of two seasons.")] = 365.0,
    as_json: AsJson = False,
) -> None:
    """Estimate the dynamic occupancy model of ecology (MacKenzie 2003): sites taken and left between seasons.

    \b
    Example:
      evermap reproduce occupancy ../shared/data/crossbill/looks.csv.gz
    """
    _benchmark("occupancy").main([str(table), "--season-d", str(season_d), *(["--json"] if as_json else [])])


def liars(
    lie: Annotated[list[str] | None, typer.Option(help="Only this one; repeatable.", show_default="all")] = None,
    seed: Annotated[list[int] | None, typer.Option(help="Repeatable.", show_default="0, 1")] = None,
) -> None:
    """Falsify the readings of one of five robots that share a living map, and score that map.

    \b
    Example:
      evermap reproduce liars --seed 0 --lie "ranges 10 %"
    """
    lies = ["--lies", *lie] if lie else []
    _benchmark("liars").main([*lies, *(["--seeds", *map(str, seed)] if seed else [])])


def _benchmark(name: str) -> Any:
    """Return a module of the folder `benchmarks`, which is not installed: the commands need a clone.

    Raises:
        InputError: there is none.
    """
    from evermap.cli.bench import load_benchmarks

    _limit_threads()
    load_benchmarks()
    return importlib.import_module(f"benchmarks.{name}")


def _limit_threads() -> None:
    """Limit libraries to one thread: they read it when they are loaded, which they are not yet."""
    from evermap.compiled import THREAD_LIMITS

    for name in THREAD_LIMITS:
        os.environ.setdefault(name, "1")


def mrclam(
    data: Data = MRCLAM,
    out: Out = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Also the recordings of which only a part of the truth is known.")
    ] = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Localise all robots of the UTIAS recordings and compare them with the truth.

    \b
    Example:
      evermap reproduce mrclam --data ~/recordings/mrclam
    """

    def compute(target: Path, progress: Progress | None) -> tuple[dict[str, Any], AsText]:
        from evermap_studies.mrclam import study

        return study.reproduce(data, target, progress=progress, everything=everything, force=force), study.as_markdown

    _run("mrclam", compute, out, inputs=[data], as_json=as_json, force=force)


def rosen2016(
    data: Annotated[Path | None, typer.Option(help="Folder with rosen2016.json.", show_default=str(GOLDEN))] = None,
    out: Out = None,
    seed: Seed = 0,
    sequences: Annotated[int, typer.Option(min=1, help="Sequences drawn for every setting.")] = 10_000,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Compute figures 1 to 4 of the persistence filter's paper and compare them with reference numbers.

    \b
    Example:
      evermap reproduce rosen2016 --seed 1
    """
    reference = _if_there(data, GOLDEN / "rosen2016.json", "the numbers are computed, and compared with nothing")

    def compute(target: Path, progress: Progress | None) -> tuple[dict[str, Any], AsText]:
        from evermap_studies.rosen2016 import study

        settings = replace(study.Settings(), seed=seed, sequences=sequences)
        table = study.reproduce(target, settings, data=reference, progress=progress, force=force)
        return table, study.as_markdown

    _run("rosen2016", compute, out, inputs=[reference], as_json=as_json, force=force)


def presence(
    data: Data = PRESENCE, out: Out = None, seed: Seed = 0, as_json: AsJson = False, force: Force = False
) -> None:
    """Compare models of things that come and go with simple and published ones, in a room and at a door.

    \b
    Example:
      evermap reproduce presence --out out/presence
    """

    def compute(target: Path, progress: Progress | None) -> tuple[dict[str, Any], AsText]:
        from evermap_studies.presence import study

        return study.reproduce(data, target, seed=seed, progress=progress, force=force), study.as_markdown

    _run("presence", compute, out, inputs=[data], as_json=as_json, force=force, in_seconds=False)


def nielsen2024(
    data: Data = MRCLAM,
    out: Out = None,
    part: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this part: simulation, recordings, during or search; repeatable. Rows of an older run of "
            "other parts in --out stay.",
            show_default=False,
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="dataset|robot|method|sensor=VALUE",
            help="Only these data sets, robots, methods, or settings of sensor and modes (ours, paper, many-modes, "
            "paper-no-window); repeatable.",
            show_default=False,
        ),
    ] = None,
    seed: Seed = 0,
    quick: Quick = False,
    jobs: Jobs = 1,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Find landmarks that moved by all methods, in simulation and in the UTIAS recordings; goes on where it was ended.

    \b
    Example:
      evermap reproduce nielsen2024 --part recordings --only dataset=6 --only method=joint
    """
    rows = _rows_of(only or [])

    def compute(target: Path, progress: Progress | None) -> tuple[dict[str, Any], AsText]:
        from evermap_studies.nielsen2024 import study

        chosen = _given(parts=part, **rows)
        wanted = replace(study.QUICK if quick else study.Settings(), seed=seed, processes=jobs, **chosen)
        return study.reproduce(data, target, wanted, progress=progress, force=force), study.as_markdown

    _run("nielsen2024", compute, out, inputs=[data], as_json=as_json, force=force)


ROWS = ("dataset", "robot", "method", "sensor")
"""What rows of the tables of Nielsen 2024 are chosen by."""
nielsen2024.moved = {  # type: ignore[attr-defined]
    f"--{name}": Moved(key=name, write=str, option="--only") for name in ROWS
}


def _rows_of(only: list[str]) -> dict[str, list[Any]]:
    """Return the chosen data sets, robots, methods and sensors.

    Raises:
        ConfigError: none of them, or a number is none.
    """
    rows: dict[str, list[Any]] = {}
    for text in only:
        name, _, value = text.partition("=")
        if name not in ROWS or (name in ROWS[:2] and not value.isdecimal()):
            raise ConfigError(f"'{text}' names no rows", field="--only", hint="dataset=6, method=joint")
        rows.setdefault(f"{name}s", []).append(int(value) if name in ROWS[:2] else value)
    return rows


def bateman2020(
    out: Out = None,
    runs: Annotated[int, typer.Option(min=1, help="Simulated for every world and sensor.")] = 100,
    world: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this world (nominal, uniform-lifetimes, angle60, range04, occlusion, false-alarms, "
            "pose-noise); repeatable.",
            show_default=False,
        ),
    ] = None,
    filters: Annotated[
        str | None,
        typer.Option(
            help="Only these filters, by commas, in all worlds; e.g. jcf,jcfr+suppression.", show_default=False
        ),
    ] = None,
    seed: Seed = 0,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Filter landmarks on rigid bodies seen in space, one by one and as whole bodies.

    \b
    Example:
      evermap reproduce bateman2020 --runs 20 --world nominal --world occlusion --filters jcf+suppression,oracle
    """

    def compute(target: Path, progress: Progress | None) -> tuple[dict[str, Any], AsText]:
        from evermap_studies.bateman2020 import study

        names = [name.strip() for name in filters.split(",")] if filters else None
        settings = study.default_settings(runs=runs, seed=seed, **_given(worlds=world, chosen=names))
        return study.reproduce(target, settings, progress=progress, force=force), study.as_markdown

    _run("bateman2020", compute, out, as_json=as_json, force=force)


def lifetimes(
    data: Annotated[
        Path | None, typer.Option(help="Folder with the looks at rooms.", show_default=str(PRESENCE))
    ] = None,
    out: Out = None,
    runs: Annotated[int, typer.Option(min=1, help="Months of patrols that are simulated.")] = 10,
    seed: Seed = 0,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Learn how long things stay from tracks, from months of patrols and from looks at rooms, against the truth.

    \b
    Example:
      evermap reproduce lifetimes --runs 3
    """
    rooms = _if_there(data, PRESENCE / "room_train.csv.gz", "nothing is said about rooms")

    def compute(target: Path, progress: Progress | None) -> tuple[dict[str, Any], AsText]:
        from evermap_studies.lifetimes import study

        simulated = replace(study.Settings(), seed=seed, repetitions=runs)
        table = study.reproduce(target, simulated, data=rooms, progress=progress, force=force)
        return table, study.as_markdown

    _run("lifetimes", compute, out, inputs=[rooms], as_json=as_json, force=force)


def lifelong(
    data: Data = MRCLAM,
    out: Out = None,
    part: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this part: five, fifty, ablation-recorded or ablation-simulated; repeatable. Rows of an older "
            "run of other parts in --out stay.",
            show_default=False,
        ),
    ] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Scripts of changes.", show_default="5")] = None,
    seed: Seed = 0,
    quick: Quick = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Enter sessions of the UTIAS robots into one map, while landmarks move, leave and come back between them.

    \b
    Example:
      evermap reproduce lifelong --part five
    """

    def compute(target: Path, progress: Progress | None) -> tuple[dict[str, Any], AsText]:
        from evermap_studies.lifelong import study

        settings = replace(study.QUICK if quick else study.Settings(), seed=seed, **_given(parts=part, seeds=runs))
        return study.reproduce(data, target, settings, progress=progress, force=force), study.as_markdown

    _run("lifelong", compute, out, inputs=[data], as_json=as_json, force=force, in_seconds=False)


def partial_views(
    out: Out = None,
    part: Annotated[
        list[str] | None,
        typer.Option(help="Only this part: changing or still; repeatable.", show_default=False),
    ] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Buildings.", show_default="20")] = None,
    seed: Seed = 1000,
    quick: Quick = False,
    jobs: Jobs = 1,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Check what is told as changed where patrols see only part of a building, against the truth.

    \b
    Example:
      evermap reproduce partial-views --quick
    """

    def compute(target: Path, progress: Progress | None) -> tuple[dict[str, Any], AsText]:
        from evermap_studies.partial_views import study

        first = study.QUICK if quick else study.Settings()
        settings = replace(first, seed=seed, processes=jobs, **_given(parts=part, buildings=runs))
        return study.reproduce(target, settings, progress=progress, force=force), study.as_markdown

    _run("partial-views", compute, out, as_json=as_json, force=force, in_seconds=False)


def building(
    out: Out = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Buildings.", show_default="2")] = None,
    seed: Seed = 0,
    quick: Quick = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Keep a map of a building in space for four weeks of partial patrols, against the truth.

    \b
    Example:
      evermap reproduce building --quick
    """

    def compute(target: Path, progress: Progress | None) -> tuple[dict[str, Any], AsText]:
        from evermap_studies.building import study

        first = study.QUICK if quick else study.Settings()
        settings = replace(first, seed=seed, **_given(worlds=runs))
        return study.reproduce(target, settings, progress=progress, force=force), study.as_markdown

    _run("building", compute, out, as_json=as_json, force=force, in_seconds=False)


def robots(
    out: Out = None,
    runs: Annotated[int | None, typer.Option(min=2, help="Robots.", show_default="200")] = None,
    seed: Seed = 0,
    quick: Quick = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Calibrate robots of many makes, good and bad, with and without a map, beside believing all readings.

    \b
    Example:
      evermap reproduce robots --quick
    """

    def compute(target: Path, progress: Progress | None) -> tuple[dict[str, Any], AsText]:
        from evermap_studies.robots import study

        settings = replace(study.QUICK if quick else study.Settings(), seed=seed, **_given(robots=runs))
        return study.reproduce(target, settings, progress=progress, force=force), study.as_markdown

    _run("robots", compute, out, as_json=as_json, force=force, in_seconds=False)


def causes(
    out: Out = None,
    part: Annotated[
        list[str] | None,
        typer.Option(help="Only this part: table, sound, causes, mistakes or attacks; repeatable.", show_default=False),
    ] = None,
    world: Annotated[
        list[str] | None, typer.Option(help="Only worlds with this in their name; repeatable.", show_default=False)
    ] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Seeds of a world, at most.", show_default="20")] = None,
    seed: Seed = 0,
    quick: Quick = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Make recordings and maps wrong in one way each, and ask for the cause; a run that was stopped goes on.

    \b
    Examples:
      evermap reproduce causes --quick
      evermap reproduce causes --part mistakes --world "laser alone"
    """

    def compute(target: Path, progress: Progress | None) -> tuple[dict[str, Any], AsText]:
        from evermap_studies.causes import study

        settings = replace(study.Settings(quick=quick), seed=seed, **_given(groups=part, worlds=world, runs=runs))
        return study.reproduce(target, settings, progress=progress, force=force), study.as_markdown

    _run("causes", compute, out, as_json=as_json, force=force, in_seconds=False)


def _run(
    study: str,
    compute: Compute,
    out: Path | None,
    *,
    inputs: list[Path | None] | None = None,
    as_json: bool,
    force: bool,
    in_seconds: bool = True,
) -> None:
    """Run a study into its folder and print its table.

    Args:
        study: its name.
        compute: does the work.
        out: folder for the results; None for the usual one.
        inputs: what it reads, which `--force` never replaces.
        as_json: print the table as JSON.
        force: write into a folder that holds other files.
        in_seconds: its progress is counted in seconds of recordings.
    """
    from evermap.runs.folder import check_replaceable

    _limit_threads()
    target = out or Path("evermap-out") / study
    check_replaceable(target, force=force, inputs=inputs or [])
    with progress_bar(study, speed=in_seconds) as progress:
        table, as_text = compute(target, progress)
    if as_json:
        print_json(table)
    else:
        typer.echo(as_text(table))
        say(f"what is behind it is in {target}")


def _given(**options: Any) -> dict[str, Any]:
    """Return the options that were given, lists as tuples."""
    return {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in options.items()
        if value is not None and value != []
    }


def _if_there(given: Path | None, usual: Path, without: str) -> Path | None:
    """Return the folder that was given, or the usual one where it holds its file; warn and return None otherwise."""
    if given is not None:
        return given
    if usual.is_file():
        return usual.parent
    warn(f"no {usual}: {without} (try: --data FOLDER)")
    return None
