"""From a seed to the folder of the demonstration."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from evermap.demo.scenario import Scenario
from evermap.demo.study import Progress, run_study
from evermap.runfolder import SUMMARY, RunFolder, RunInfo, check_replaceable, summary_text, write_run
from evermap.sim import ChangeEvent

TRUE_EVENTS = "true_events.jsonl"


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
    """Map a changing building once, live with the map, and show what that costs. Returns `summary.json`'s content.

    The folder is that of the last session's run (see `runfolder.write_run`), with a section `demo` in the summary,
    the story at the top of the report, `figures/demo.png` and the simulator's `true_events.jsonl`.

    Args:
        out: folder to write.
        seed: of the simulation; same seed, same numbers.
        progress: told seconds of recordings done and in all.
        scenario: how much is simulated; default: 6 patrols of 165 s on 6 days.
        processes: runs at a time; above 1 the calling script needs its `__main__` guard.
        command: what was typed, for the summary.
        force: replace `out` whatever it holds.

    Raises:
        ConfigError: `out` must not be replaced, or the scenario is out of range.
    """
    from evermap.demo.figure import draw_demo
    from evermap.demo.numbers import demo_dict
    from evermap.demo.story import demo_section
    from evermap.viz.style import save_png, save_svg

    check_replaceable(out, force=force)
    scenario = scenario or Scenario()
    config = scenario.estimator()
    start = time.perf_counter()
    study = run_study(scenario, seed, config, processes=processes, progress=progress)
    numbers = demo_dict(study, seed)
    hero = draw_demo(study)
    last = study.visits["changed"][-1]
    info = RunInfo(
        command=command, seeds={"simulation": seed, "slam": config.slam.seed}, total_s=time.perf_counter() - start
    )
    with RunFolder(out, force=force) as folder:
        # the run in a folder of its own first: what is added must not be half there either
        run = folder.path("run")
        summary = write_run(run, last.recording, last.result, config, info=info, sections=[demo_section(numbers, hero)])
        for item in run.iterdir():
            item.rename(folder.path(item.name))
        run.rmdir()
        save_png(hero.figure, folder.path("figures/demo.png"))
        save_svg(hero.figure, folder.path("figures/demo.svg"))
        folder.path(TRUE_EVENTS).write_text(_events_text(study.changed.events), encoding="utf-8")
        summary |= {"demo": numbers, "outputs": folder.files()}
        folder.path(SUMMARY).write_text(summary_text(summary), encoding="utf-8")
    return summary


def _events_text(events: Iterable[ChangeEvent]) -> str:
    """One JSON object a line, in order of time, marked as what only a simulator knows."""
    return "".join(json.dumps({"truth": True, **asdict(event)}) + "\n" for event in events)
