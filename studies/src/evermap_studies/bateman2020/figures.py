"""Scores over the parameters that the thesis hides, and whether beliefs mean what they say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.sensing.profile import Profile, facing_middles, range_middles
from evermap.survival import Exponential
from evermap.viz.style import ESTIMATE, INK, LANDMARK, MUTED, ODOMETRY, house_style, new_figure, settle
from evermap_studies.bateman2020.learned import learned_beliefs
from evermap_studies.bateman2020.profile_figure import RateCurve, draw_profile
from evermap_studies.bateman2020.runs import simulate
from evermap_studies.bateman2020.scores import COMPARED, Row, Scored
from evermap_studies.bateman2020.settings import LEARNED, NOMINAL, ORACLE, REMOVING, SUPPRESSION, TUNED
from evermap_studies.bateman2020.table import NAMES, title

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from evermap_studies.bateman2020.settings import Settings

_COLUMNS = 4
_COLOURS = {"iff": ODOMETRY, "jff": MUTED, "jcf": LANDMARK, "jcfr": ESTIMATE}
_CALIBRATED = {"jcf" + SUPPRESSION: MUTED, TUNED: ODOMETRY, ORACLE: INK, LEARNED: ESTIMATE}
_REMOVING = dict(
    zip(REMOVING, ((MUTED, "-"), (ODOMETRY, "-"), (INK, "-"), (ESTIMATE, "-"), (ESTIMATE, "--")), strict=True)
)
_REMOVED_IN = {NOMINAL, "angle60", "occlusion"}
_DELAYS = (2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
_FEWEST = 30
"""Beliefs in a bin below which its share says nothing."""
_LOGARITHMIC = {"prior_mean_steps", "p_false", "rho_low"}


def draw_sweeps(rows: Sequence[Row], settings: Settings) -> dict[str, Figure]:
    """A figure for each sensor: accuracy above MES/S, a column a parameter."""
    sensors = dict.fromkeys(row["sensor"] for row in rows)
    return {
        f"sensitivity-{sensor}": _sweep([row for row in rows if row["sensor"] == sensor], settings)
        for sensor in sensors
    }


def _sweep(rows: Sequence[Row], settings: Settings) -> Figure:
    least = min(row["accuracy"] for row in rows if row["accuracy"] is not None)
    floors = {"accuracy": math.floor(20.0 * least) / 20.0, "survival_ratio": 0.0}
    parameters = list(dict.fromkeys((row["section"], row["parameter"]) for row in rows))
    bands = -(-len(parameters) // _COLUMNS)
    with house_style():
        figure = new_figure(7.4, 2.75 * bands + 0.5)
        panels = figure.subplots(2 * bands, _COLUMNS, sharey="row", squeeze=False)
        for axes in panels.flat:
            axes.set_visible(False)
        for k, (section, parameter) in enumerate(parameters):
            own = [row for row in rows if (row["section"], row["parameter"]) == (section, parameter)]
            band, column = divmod(k, _COLUMNS)
            for line, metric in enumerate(COMPARED):
                axes = panels[2 * band + line, column]
                axes.set_visible(True)
                _draw_over_values(axes, own, metric)
                axes.set_ylim(floors[metric] - 0.01, 1.02)
                axes.axvline(settings.value_of(section, parameter), color=MUTED, lw=0.7, ls=":", zorder=1)
                if parameter in _LOGARITHMIC:
                    axes.set_xscale("log")
                if column == 0:
                    axes.set_ylabel(NAMES[metric])
            panels[2 * band, column].tick_params(labelbottom=False)
            panels[2 * band + 1, column].set_xlabel(title(section, parameter))
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
        settle(figure)
    return figure


def _draw_over_values(axes: Axes, rows: Sequence[Row], metric: str) -> None:
    for name in dict.fromkeys(row["filter"] for row in rows):
        own = [row for row in rows if row["filter"] == name]
        known = [np.nan if row[metric] is None else row[metric] for row in own]
        style: dict[str, Any] = {"color": _COLOURS[name.removesuffix(SUPPRESSION)], "marker": "o", "ms": 2.5, "lw": 1.1}
        dashes = "-" if name.endswith(SUPPRESSION) else "--"
        axes.plot([row["value"] for row in own], known, dashes, label=name, **style)


def draw_removals(scored: Sequence[Scored], settings: Settings) -> Figure | None:
    """MES/S over the delay, a point a `rho_low`, a panel a sensor and world; None where nothing of it was run."""
    shown = [one for one in scored if one.row["filter"] in _REMOVING and one.row["world"] in _REMOVED_IN]
    if not shown:
        return None
    panels_of = list(dict.fromkeys((one.row["sensor"], one.row["world"]) for one in shown))
    across = min(3, len(panels_of))
    down = -(-len(panels_of) // across)
    with house_style():
        figure = new_figure(2.4 * across + 0.3, 2.3 * down + 0.5)
        panels = figure.subplots(down, across, sharey=True, squeeze=False)
        for axes in panels.flat:
            axes.set_visible(False)
        for axes, where in zip(panels.flat, panels_of, strict=False):
            axes.set_visible(True)
            axes.set(title=", ".join(where), xscale="log", xlim=(1.5, 120.0), ylim=(-0.03, 1.04))
            axes.set_xticks(_DELAYS, [f"{delay:g}" for delay in _DELAYS])
            axes.minorticks_off()
            for one in shown:
                if (one.row["sensor"], one.row["world"]) == where:
                    colour, dashes = _REMOVING[one.row["filter"]]
                    rho_low, delay, kept = one.removal.T
                    axes.plot(delay, kept, dashes, color=colour, lw=1.1, label=one.row["filter"])
                    marked = np.isin(rho_low, [settings.filters.rho_low])
                    axes.plot(delay[marked], kept[marked], "o", color=colour, ms=4)
        for axes in panels[:, 0]:
            axes.set_ylabel("MES/S [1]")
        for axes in panels[-1]:
            axes.set_xlabel("mean delay of removal [looks]")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
        settle(figure)
    return figure


def draw_learned_sensor(settings: Settings) -> Figure:
    """Detection by range and incidence as one run teaches it, in a world that is harsher in both than assumed."""
    world = replace(
        settings.world_of("range04", "lidar"),
        viewing_angle_rad=settings.world_of("angle60", "lidar").viewing_angle_rad,
    )
    run = simulate(world, 1, settings.seed).runs[0]
    _, after = learned_beliefs(run, Exponential.from_mean(settings.filters.prior_mean_steps))
    before = Profile.of(after.assumed)
    range_m, facing = np.linspace(0.0, world.field.range_max_m, 200), np.linspace(-1.0, 1.0, 801)
    curves = [
        RateCurve(
            range_middles(world.field.range_max_m),
            before.range_rate,
            after.range_rate,
            after.range_hits,
            range_m,
            np.exp(-range_m / world.fading_m),
            "range [m]",
        ),
        RateCurve(
            facing_middles(),
            before.facing_rate,
            after.facing_rate,
            after.facing_hits,
            facing,
            np.where(facing >= np.cos(world.viewing_angle_rad), 1.0, 0.0),
            "cosine of incidence [1]",
        ),
    ]
    with house_style():
        figure = new_figure(6.4, 2.9)
        draw_profile(figure, curves)
        settle(figure)
    return figure


def draw_calibration(scored: Sequence[Scored]) -> Figure | None:
    """A panel for each sensor and world; None where no such filter was run."""
    shown = [one for one in scored if one.row["filter"] in _CALIBRATED]
    if not shown:
        return None
    sensors = list(dict.fromkeys(one.row["sensor"] for one in shown))
    worlds = list(dict.fromkeys(one.row["world"] for one in shown))
    across = min(4, len(worlds))
    down = -(-len(worlds) // across)
    with house_style():
        figure = new_figure(1.85 * across + 0.3, 1.95 * down * len(sensors) + 0.5)
        panels = figure.subplots(down * len(sensors), across, sharex=True, sharey=True, squeeze=False)
        for axes in panels.flat:
            axes.set_visible(False)
        for i, sensor in enumerate(sensors):
            for j, world in enumerate(worlds):
                axes = panels[i * down + j // across, j % across]
                axes.set_visible(True)
                axes.plot([0.0, 1.0], [0.0, 1.0], color=MUTED, lw=0.8, ls="--", label="calibrated")
                for one in shown:
                    if (one.row["sensor"], one.row["world"]) == (sensor, world):
                        _draw_bins(axes, one)
                axes.tick_params(labelbottom=True)
                axes.set(xlim=(-0.03, 1.03), ylim=(-0.04, 1.04), title=world, aspect="equal")
        for row, axes in enumerate(panels[:, 0]):
            axes.set_ylabel(f"{sensors[row // down]}: truly there [1]")
        for axes in panels[-1]:
            axes.set_xlabel("P(there) [1]")
        known: dict[str, Any] = {}
        for axes in panels.flat:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                known.setdefault(label, handle)
        figure.legend(known.values(), known.keys(), loc="outside lower center", ncols=len(known))
        settle(figure)
    return figure


def _draw_bins(axes: Axes, one: Scored) -> None:
    name, bins = one.row["filter"], one.reliability
    filled = bins.count >= _FEWEST
    axes.plot(bins.belief[filled], bins.present[filled], color=_CALIBRATED[name], marker="o", ms=3, lw=1.1, label=name)
