"""Figures 5.1 and 5.2 of the thesis with our own runs, and a recording of one to look at in space."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evermap.errors import MissingExtraError
from evermap.viz.style import house_style, new_figure, settle
from evermap_studies.bateman2020.clique_belief_figure import draw_clique_beliefs
from evermap_studies.bateman2020.clique_recording import log_clique_run
from evermap_studies.bateman2020.clique_scene_figure import draw_clique_scene
from evermap_studies.bateman2020.filters import beliefs
from evermap_studies.bateman2020.runs import Stack, simulate, stack
from evermap_studies.bateman2020.settings import LEARNED, NOMINAL, SUPPRESSION, TUNED, Settings
from evermap_studies.worlds.sensors import outline

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evermap_studies.worlds.cliques import CliqueRun

SENSOR = "lidar"
GONE_STEP = 350
"""Stated under figure 5.2: when the survival time is over. The clique that vanishes nearest to it is shown."""
SHOWN = ("iff", "jcf", "jcfr" + SUPPRESSION, TUNED, LEARNED)
FIELD_M = 6.0
"""Length to which the sensor's field is drawn."""


def draw_examples(settings: Settings, p_miss: float) -> dict[str, Figure]:
    """Figures 5.1, of the first run, and 5.2."""
    runs = simulate(settings.world_of(NOMINAL, SENSOR), settings.runs, settings.seed)
    return {"scene": _draw_scene(runs.runs[0]), "beliefs": _draw_beliefs(runs, settings, p_miss)}


def record_example(settings: Settings, path: Callable[[str], Path]) -> None:
    """The first run as `scene.rrd`, with the beliefs of `learned`; nothing where rerun is not installed."""
    one = simulate(settings.world_of(NOMINAL, SENSOR), 1, settings.seed)
    run = one.runs[0]
    belief, _ = beliefs(LEARNED, one, settings.filters, None)
    with suppress(MissingExtraError):
        log_clique_run(
            path("scene.rrd"),
            position_m=run.position_m,
            rotation=run.rotation,
            landmark_m=run.landmark_m,
            clique=run.clique,
            detected=run.detected,
            belief=_from_birth(belief, run),
            there=run.there(),
            field_outline_m=outline(run.world.field, FIELD_M),
        )


def _from_birth(belief: np.ndarray, run: CliqueRun) -> np.ndarray:
    return np.where(np.arange(len(belief))[:, None] >= run.first, belief, np.nan)


def _draw_scene(run: CliqueRun) -> Figure:
    """One lap, at the step in which most cliques are detected."""
    lap = slice(0, min(run.world.period, run.world.steps))
    seen = np.array(
        [[run.detected[step, run.clique == c].any() for c in range(len(run.first))] for step in range(lap.stop)]
    )
    step = int(np.argmax(seen.sum(axis=1)))
    with house_style():
        figure = new_figure(6.4, 4.8)
        draw_clique_scene(
            figure,
            run.position_m[lap],
            run.rotation[lap],
            run.landmark_m,
            run.normal,
            run.clique,
            step=step,
            detected=run.detected[step],
            field_outline_m=outline(run.world.field, FIELD_M),
        )
        settle(figure)
    return figure


def _draw_beliefs(runs: Stack, settings: Settings, p_miss: float) -> Figure:
    vanishes = runs.first + runs.survival_steps
    chosen = int(np.argmin(np.abs(vanishes - GONE_STEP)))
    one = stack([runs.runs[runs.run[chosen]]])
    clique = chosen - int(np.flatnonzero(runs.run == runs.run[chosen])[0])
    curves = {}
    for name in SHOWN:
        belief, _ = beliefs(name, one, settings.filters, p_miss)
        curves[name] = _from_birth(belief, one.runs[0])[:, clique]
    with house_style():
        figure = new_figure(7.2, 7.0)
        draw_clique_beliefs(
            figure,
            np.arange(len(one.in_view)),
            curves,
            survival_step=float(vanishes[chosen]),
            in_view=one.in_view[:, clique],
            detected=np.asarray(one.detected[:, one.clique == clique].any(axis=1)),
            rho_high=settings.filters.rho_high,
            rho_low=settings.filters.rho_low,
        )
        settle(figure)
    return figure
