"""Section 5.1 of Bateman: Algorithms Enabling a Semantics-Aware Class-Based Probabilistic Dynamic SLAM (2020).

Its Table 5.1 and figures with our own simulation and filters, worlds that are harsher than it, and how much of the
table is due to the parameters that the thesis does not tell. What is run stands in `settings.toml`.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from evermap import __version__
from evermap.types import Progress
from evermap_studies.bateman2020.examples import draw_examples, record_example
from evermap_studies.bateman2020.expected import verdicts
from evermap_studies.bateman2020.figures import draw_calibration, draw_learned_sensor, draw_removals, draw_sweeps
from evermap_studies.bateman2020.published import orderings
from evermap_studies.bateman2020.scores import Row, Scored, score_world, sweep, sweep_points, tuned_p_miss
from evermap_studies.bateman2020.settings import IN_THE_TABLE, NOMINAL, SENSORS, Settings, default_settings
from evermap_studies.bateman2020.table import as_markdown

SCHEMA_VERSION = "1"
EXPERIMENT = "bateman2020"


def reproduce(
    out: str | Path,
    settings: Settings | None = None,
    *,
    progress: Progress | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Run what is asked for, and write `summary.json`, `table.md`, the figures as PNG and SVG, and `scene.rrd`.

    Args:
        out: folder; replaced if it holds an older reproduction, untouched if this one fails.
        settings: `default_settings()` where None.
        progress: told after every filter in every world.
        force: write into a folder that holds other files, too; they stay.

    Returns:
        `rows` (one a world, sensor and filter), `orderings`, `expected`, `sweep`, `settings`; plain JSON values.

    Raises:
        ConfigError: `out` must not be replaced, or a filter that cannot be run.
    """
    from evermap.runs.folder import RunFolder
    from evermap.runs.summary import versions
    from evermap_studies.frame import save_all

    settings = settings or default_settings()
    with RunFolder(out, force=force) as folder:
        start = time.perf_counter()
        p_miss = {sensor: tuned_p_miss(settings, sensor) for sensor in SENSORS}
        scored, varied = compute(settings, p_miss, progress)
        elapsed_s = time.perf_counter() - start
        rows = [one.row for one in scored]
        table: dict[str, Any] = {
            "schema_version": SCHEMA_VERSION,
            "evermap": __version__,
            "experiment": EXPERIMENT,
            "settings": json.loads(json.dumps(asdict(settings))),
            "versions": versions(),
            "processing_s": elapsed_s,
            "tuned_p_miss": p_miss,
            "expected": verdicts(rows),
            "orderings": orderings(scored),
            "rows": rows,
            "sweep": varied,
        }
        figures = draw_examples(settings, p_miss["lidar"]) | draw_sweeps(varied, settings)
        figures["profile"] = draw_learned_sensor(settings)
        for name, figure in {
            "calibration": draw_calibration(scored),
            "removals": draw_removals(scored, settings),
        }.items():
            if figure is not None:
                figures[name] = figure
        save_all(figures, folder.path)
        record_example(settings, folder.path)
        folder.path("table.md").write_text(as_markdown(table) + "\n", encoding="utf-8")
        return folder.finish(table)


def compute(
    settings: Settings, p_miss: dict[str, float], progress: Progress | None = None
) -> tuple[list[Scored], list[Row]]:
    """Every filter in every world that is asked for, and the sweep unless only some filters or worlds are.

    Args:
        settings: what to run.
        p_miss: of `jcf-tuned`, by sensor.
        progress: told after every filter and every point of the sweep.
    """
    swept = settings.chosen is None and NOMINAL in settings.worlds
    length_s = settings.world["steps"]
    of_a_filter = settings.runs * length_s
    of_a_point = min(settings.runs, settings.sweep_runs) * length_s * len(IN_THE_TABLE)
    total = sum(len(settings.filters_in(world)) for world in settings.worlds) * of_a_filter
    total = len(SENSORS) * (total + swept * len(sweep_points(settings)) * of_a_point)
    finished = 0

    def done(amount: int) -> None:
        nonlocal finished
        finished += amount
        if progress is not None:
            progress(finished, total)

    scored: list[Scored] = []
    varied: list[Row] = []
    for sensor in SENSORS:
        for world in settings.worlds:
            scored += score_world(settings, world, sensor, p_miss[sensor], lambda: done(of_a_filter))
        if swept:
            varied += sweep(settings, sensor, lambda: done(of_a_point))
    return scored, varied


__all__ = ["as_markdown", "compute", "default_settings", "reproduce"]
