"""`evermap reproduce`: the tables of the documents, computed again."""

from __future__ import annotations

import os
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from evermap.cli.terminal import print_json, progress_bar, say, warn
from evermap.errors import ConfigError


class Experiment(StrEnum):
    """What can be reproduced."""

    MRCLAM = "mrclam"
    ROSEN2016 = "rosen2016"
    PRESENCE = "presence"
    NIELSEN2024 = "nielsen2024"
    BATEMAN2020 = "bateman2020"
    LIFETIMES = "lifetimes"
    LIFELONG = "lifelong"
    PARTIAL_VIEWS = "partial-views"


DATA = {
    Experiment.MRCLAM: Path("../shared/data/mrclam"),
    Experiment.ROSEN2016: Path("../shared/golden"),
    Experiment.PRESENCE: Path("../shared/data/presence"),
    Experiment.NIELSEN2024: Path("../shared/data/mrclam"),
    Experiment.LIFETIMES: Path("../shared/data/presence"),
    Experiment.LIFELONG: Path("../shared/data/mrclam"),
}
"""Where the data of each experiment are looked for; bateman2020 and partial-views have none."""
COUNTED = (Experiment.PRESENCE, Experiment.LIFELONG, Experiment.PARTIAL_VIEWS)
"""Experiments whose progress is not counted in seconds of recordings."""


def reproduce(
    experiment: Annotated[Experiment, typer.Argument(help="Which table.")],
    data: Annotated[
        Path | None,
        typer.Option(
            help="Folder with the recordings; for rosen2016 with rosen2016.json, the numbers to compare with.",
            show_default="../shared/data/mrclam, ../shared/data/presence or ../shared/golden",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results.", show_default="evermap-out/<experiment>")
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="mrclam: also the recordings of which only a part of the truth is known.")
    ] = False,
    seed: Annotated[int | None, typer.Option(help="All but mrclam: same seed, same numbers.", show_default="0")] = None,
    sequences: Annotated[
        int | None, typer.Option(help="rosen2016: sequences drawn for every setting.", show_default="10000")
    ] = None,
    part: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this part, repeatable; nielsen2024: simulation, recordings, during, search; lifelong: five, "
            "fifty, ablation-recorded, ablation-simulated (rows of an older run of other parts in --out stay); "
            "partial-views: changing, still.",
            show_default=False,
        ),
    ] = None,
    dataset: Annotated[
        list[int] | None, typer.Option(help="nielsen2024: only this data set; repeatable.", show_default=False)
    ] = None,
    method: Annotated[
        list[str] | None, typer.Option(help="nielsen2024: only this method; repeatable.", show_default=False)
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="nielsen2024, lifelong, partial-views: a little of everything, minutes instead of hours."
        ),
    ] = False,
    jobs: Annotated[
        int | None,
        typer.Option(help="nielsen2024, partial-views: runs at a time; 1 for timings that mean something.", min=1),
    ] = None,
    runs: Annotated[
        int | None,
        typer.Option(
            help="bateman2020: simulated for every world and sensor. lifetimes: months of patrols that are simulated. "
            "lifelong: scripts of changes. partial-views: buildings.",
            show_default="100; lifetimes 10; lifelong 5; partial-views 20",
        ),
    ] = None,
    world: Annotated[
        list[str] | None,
        typer.Option(
            help="bateman2020: only this world (nominal, uniform-lifetimes, angle60, range04, occlusion, "
            "false-alarms, pose-noise); repeatable.",
            show_default=False,
        ),
    ] = None,
    filters: Annotated[
        str | None,
        typer.Option(
            help="bateman2020: only these filters, by commas, in all worlds; e.g. jcf,jcfr+suppression.",
            show_default=False,
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the table as JSON.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Write into --out even if it holds other files; they stay.")
    ] = False,
) -> None:
    """Compute a table of the documents again.

    mrclam: all robots of the UTIAS recordings against the truth. rosen2016: figures 1 to 4 of the persistence filter's
    paper against reference numbers. presence: models of things that come and go against simple and published ones, in
    a room and at a door. nielsen2024: landmarks that moved, by all methods, in simulation and in the UTIAS recordings.
    bateman2020: landmarks on rigid bodies seen in space, by filters of single landmarks and of whole bodies. lifetimes:
    how long things stay, learned from tracks, from months of patrols and from looks at rooms, against the truth.
    lifelong: sessions of the UTIAS robots into one map, while landmarks move, leave and come back between them.
    partial-views: what is told as changed where patrols see only part of a building, against the truth.
    Runs follow one another on one core, so that the timings mean something.

    \b
    Example:
      evermap reproduce mrclam --data ~/recordings/mrclam
      evermap reproduce rosen2016 --seed 1
      evermap reproduce presence --out out/presence
      evermap reproduce nielsen2024 --part recordings --dataset 6 --method joint
      evermap reproduce lifetimes --runs 3
      evermap reproduce lifelong --part five
      evermap reproduce partial-views --quick
      evermap reproduce bateman2020 --runs 20 --world nominal --world occlusion --filters jcf+suppression,oracle
    """
    _one_core()
    from evermap.runfolder import check_replaceable

    given = {
        "--data": data is not None,
        "--all": everything,
        "--seed": seed is not None,
        "--sequences": sequences is not None,
        "--part": part is not None,
        "--dataset": dataset is not None,
        "--method": method is not None,
        "--quick": quick,
        "--jobs": jobs is not None,
        "--runs": runs is not None,
        "--world": world is not None,
        "--filters": filters is not None,
    }
    _refuse_options(experiment, given)
    target = out or Path("evermap-out") / experiment.value
    check_replaceable(target, force=force, inputs=[data or DATA.get(experiment)])
    with progress_bar(experiment.value, speed=experiment not in COUNTED) as progress:
        if experiment is Experiment.MRCLAM:
            from evermap.experiments import mrclam

            folder = data or DATA[experiment]
            table = mrclam.reproduce(folder, target, progress=progress, everything=everything, force=force)
            as_text = mrclam.as_markdown
        elif experiment is Experiment.PRESENCE:
            from evermap.experiments import presence

            table = presence.reproduce(data or DATA[experiment], target, seed=seed or 0, progress=progress, force=force)
            as_text = presence.as_markdown
        elif experiment is Experiment.NIELSEN2024:
            from evermap.experiments import nielsen2024

            lists = {"parts": part, "datasets": dataset, "methods": method}
            chosen: dict[str, Any] = {name: tuple(values) for name, values in lists.items() if values}
            default = nielsen2024.QUICK if quick else nielsen2024.Settings()
            wanted = replace(default, seed=seed or 0, processes=jobs or 1, **chosen)
            folder = data or DATA[experiment]
            table = nielsen2024.reproduce(folder, target, wanted, progress=progress, force=force)
            as_text = nielsen2024.as_markdown
        elif experiment is Experiment.BATEMAN2020:
            from evermap.experiments import bateman2020

            asked: dict[str, Any] = {
                "runs": runs,
                "seed": seed,
                "worlds": world and tuple(world),
                "chosen": filters and tuple(name.strip() for name in filters.split(",")),
            }
            plan = bateman2020.default_settings(**{name: value for name, value in asked.items() if value is not None})
            table = bateman2020.reproduce(target, plan, progress=progress, force=force)
            as_text = bateman2020.as_markdown
        elif experiment is Experiment.LIFETIMES:
            from evermap.experiments import lifetimes

            usual = lifetimes.Settings()
            simulated = replace(usual, seed=seed or 0, repetitions=runs or usual.repetitions)
            rooms = _reference(experiment, data, lifetimes.ROOMS, "nothing is said about rooms")
            table = lifetimes.reproduce(target, simulated, data=rooms, progress=progress, force=force)
            as_text = lifetimes.as_markdown
        elif experiment is Experiment.LIFELONG:
            from evermap.experiments import lifelong

            base = lifelong.QUICK if quick else lifelong.Settings()
            these: dict[str, Any] = {"parts": part and tuple(part), "seed": seed, "seeds": runs}
            lives = replace(base, **{name: value for name, value in these.items() if value is not None})
            table = lifelong.reproduce(data or DATA[experiment], target, lives, progress=progress, force=force)
            as_text = lifelong.as_markdown
        elif experiment is Experiment.PARTIAL_VIEWS:
            from evermap.experiments import partial_views

            first = partial_views.QUICK if quick else partial_views.Settings()
            views: dict[str, Any] = {"seed": seed, "buildings": runs, "processes": jobs, "parts": part and tuple(part)}
            seen = replace(first, **{name: value for name, value in views.items() if value is not None})
            table = partial_views.reproduce(target, seen, progress=progress, force=force)
            as_text = partial_views.as_markdown
        else:
            from evermap.experiments import rosen2016

            paper = rosen2016.Settings()
            settings = replace(
                paper,
                seed=paper.seed if seed is None else seed,
                sequences=paper.sequences if sequences is None else sequences,
            )
            without = "the numbers are computed, and compared with nothing"
            reference = _reference(experiment, data, "rosen2016.json", without)
            table = rosen2016.reproduce(target, settings, data=reference, progress=progress, force=force)
            as_text = rosen2016.as_markdown
    if as_json:
        print_json(table)
    else:
        typer.echo(as_text(table))
        say(f"what is behind it is in {target}")


def _refuse_options(experiment: Experiment, given: dict[str, bool]) -> None:
    """An option that would be ignored is a mistake."""
    known = {
        Experiment.MRCLAM: {"--data", "--all"},
        Experiment.ROSEN2016: {"--data", "--seed", "--sequences"},
        Experiment.PRESENCE: {"--data", "--seed"},
        Experiment.NIELSEN2024: {"--data", "--seed", "--part", "--dataset", "--method", "--quick", "--jobs"},
        Experiment.BATEMAN2020: {"--seed", "--runs", "--world", "--filters"},
        Experiment.LIFETIMES: {"--data", "--seed", "--runs"},
        Experiment.LIFELONG: {"--data", "--seed", "--part", "--quick", "--runs"},
        Experiment.PARTIAL_VIEWS: {"--seed", "--part", "--quick", "--jobs", "--runs"},
    }[experiment]
    for name in (name for name, is_given in given.items() if is_given and name not in known):
        raise ConfigError(f"{experiment.value} has no such option", field=name, hint=", ".join(sorted(known)))


def _reference(experiment: Experiment, data: Path | None, file: str, without: str) -> Path | None:
    """Where a file that can be done without is; None, and a warning, if it is not where it is looked for unasked."""
    if data is not None:
        return data
    folder = DATA[experiment]
    if (folder / file).is_file():
        return folder
    warn(f"no {folder / file}: {without} (try: --data FOLDER)")
    return None


def _one_core() -> None:
    """Libraries read these when they are loaded, which they are not yet. What the user has set stands."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
