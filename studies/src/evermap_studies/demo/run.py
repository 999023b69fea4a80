"""From a seed to the folder of the demonstration."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from evermap.runs.folder import RunFolder, write_run
from evermap.runs.summary import RunInfo
from evermap.types import Progress
from evermap.viz.style import NamedFigure
from evermap_studies.demo.methods import method_named
from evermap_studies.demo.scenario import Scenario
from evermap_studies.demo.study import run_study
from evermap_studies.sim import ChangeEvent

TRUE_EVENTS = "true_events.jsonl"
MAP = "map.evermap"


def run_demo(
    out: str | Path,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    scenario: Scenario | None = None,
    processes: int = 1,
    command: str = "",
    force: bool = False,
) -> dict[str, Any]:
    """Live in a changing building for four weeks, with every method. Returns `summary.json`'s content.

    The folder is that of evermap's last session (see `runfolder.write_run`), with a section `demo` in the summary, the
    story at the top of the report, its figures, the map with all its revisions and the simulator's true events; and a
    week in a building in space, from eight days on.

    Args:
        out: folder to write.
        seed: of the simulation; same seed, same numbers.
        progress: told seconds of recordings done and in all.
        scenario: how much is simulated; default: 56 patrols of 30 to 150 s on 28 days.
        processes: methods at a time; above 1 the calling script needs its `__main__` guard.
        command: what was typed, for the summary.
        force: write into a folder that holds other files, too; they stay.

    Raises:
        ConfigError: `out` must not be replaced, or the scenario is out of range.
    """
    from evermap.viz.style import save_png, save_svg
    from evermap_studies.demo.claims_figure import draw_claims
    from evermap_studies.demo.hero import draw_hero
    from evermap_studies.demo.in_space import live_in_space, section_of
    from evermap_studies.demo.lifetime_figure import draw_lifetimes
    from evermap_studies.demo.lifetimes import learned_lives
    from evermap_studies.demo.numbers import cost, demo_dict, lines_of
    from evermap_studies.demo.score_figure import draw_scores
    from evermap_studies.demo.story import demo_sections
    from evermap_studies.demo.weeks_figure import draw_weeks

    scenario = scenario or Scenario()
    config = method_named("evermap").config()
    start = time.perf_counter()
    with RunFolder(out, force=force) as folder:
        study = run_study(scenario, seed, store=folder.path(MAP), processes=processes, progress=progress)
        lines, lives = lines_of(study), learned_lives(study)
        numbers, costs = demo_dict(study, lines, lives, seed), cost(study)
        figures: tuple[NamedFigure, ...] = (
            draw_weeks(study, lines),
            draw_hero(study, lines),
            draw_claims(study, lines),
            draw_scores(study, lines),
            draw_lifetimes(lives),
        )
        in_space = live_in_space(scenario.days, seed)
        info = RunInfo(
            command=command, seeds={"simulation": seed, "slam": config.slam.seed}, total_s=time.perf_counter() - start
        )
        # the run in a folder of its own first: what is added must not be half there either
        run = folder.path("run")
        sections = demo_sections(numbers, costs, figures)
        if in_space is not None:
            numbers["space"] = in_space[0]
            sections += (section_of(*in_space),)
            figures += (in_space[1],)
        summary = write_run(run, study.building.sessions[-1], study.result, config, info=info, sections=sections)
        for item in run.iterdir():
            item.rename(folder.path(item.name))
        run.rmdir()
        for figure in figures:
            save_png(figure.figure, folder.path(f"figures/{figure.name}.png"))
            save_svg(figure.figure, folder.path(f"figures/{figure.name}.svg"))
        folder.path(TRUE_EVENTS).write_text(_events_text(study.building.events), encoding="utf-8")
        summary["timing"] |= {"demo": costs}
        return folder.finish(summary | {"demo": numbers})


def _events_text(events: Iterable[ChangeEvent]) -> str:
    """One JSON object a line, in order of time, marked as what only a simulator knows."""
    return "".join(json.dumps({"truth": True, **asdict(event)}) + "\n" for event in events)
