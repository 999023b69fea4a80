"""Figures 6 to 10 of Nielsen 2024 with our own runs, and how far the probabilities of changes can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.metrics.belief import belief_scores, reliability
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    INK,
    LANDMARK,
    MUTED,
    ODOMETRY,
    ONLINE,
    house_style,
    new_figure,
    settle,
)
from evermap_studies.frame import save_all
from evermap_studies.nielsen2024.expected import Row, Rows, chosen, complete, mean, weights
from evermap_studies.nielsen2024.plan import GROUP, GROUP_SCENARIO, MANY_DATASET, MANY_METHODS, MANY_SCENARIO

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STYLE: dict[str, tuple[str, str]] = {
    "nohyp": (MUTED, "s"),
    "max-mixture": (INK, "v"),
    "nn": (LANDMARK, "^"),
    "em": (ODOMETRY, "D"),
    "mcts": (ALERT, "o"),
    "viterbi": (ONLINE, "P"),
    "joint": (ESTIMATE, "o"),
}
_SENSORS = ("ours", "paper")
_DRAWN_METHODS = ("max-mixture", "mcts", "joint")


def draw_all(simulation: Rows, runs: Rows, paths: Mapping[str, Row], path: Callable[[str], Path]) -> None:
    """Write all figures for which there are runs, as PNG and SVG.

    Args:
        simulation: rows of figures 6 and 7.
        runs: rows of the runs on recordings.
        paths: trajectories to draw, by name.
        path: where to write the file of a name.
    """
    figures: dict[str, Figure] = {}
    if simulation:
        figures["fig6-7-selectors"] = _draw_selectors(simulation)
    for sensor in _SENSORS:
        drawn = {key: value for key, value in paths.items() if key.startswith(f"{GROUP_SCENARIO} {sensor} ")}
        if drawn:
            figures[f"fig8-trajectories-{sensor}"] = _draw_paths(drawn)
    compared = chosen(runs, part="recordings", scenario=GROUP_SCENARIO)
    if compared:
        figures["fig9-displacement"] = _draw_displacements(compared)
    many = complete(chosen(runs, part="recordings", scenario=MANY_SCENARIO))
    if many:
        figures["fig10-many-modes"] = _draw_many(many)
        made = {key: value for key, value in paths.items() if key.startswith(MANY_SCENARIO)}
        if made:
            figures["fig11-many-places"] = _draw_places(made, many)
    said, right = weights(runs)
    if said:
        figures["reliability"] = _draw_reliability(said, right)
    save_all(figures, path)


def _draw_selectors(simulation: Rows) -> Figure:
    """Wrong modes, and the error of complete SLAM, over the noise; bars are standard errors."""
    with house_style():
        figure = new_figure(7.2, 3.0)
        panels = figure.subplots(1, 2, sharex=True)
        shown = (("6", "wrong_share", 100.0, "wrong modes [%]"), ("7", "rmse_m", 1.0, "pose and landmark error [m]"))
        for axes, (number, key, factor, label) in zip(panels, shown, strict=True):
            rows = chosen(simulation, figure=number)
            for name in dict.fromkeys(row["selector"] for row in rows):
                own = chosen(rows, selector=name)
                colour, marker = _STYLE[name]
                axes.errorbar(
                    [row["noise_m2"] for row in own],
                    [factor * row[key] for row in own],
                    yerr=[factor * row[f"{key}_se"] for row in own],
                    color=colour,
                    marker=marker,
                    ms=4,
                    lw=1.2,
                    label=name,
                )
            axes.set(xscale="log", xlabel="variance of the noise, r [m²]", ylabel=label, ylim=(0.0, None))
        panels[0].set_title("modes and poses known (figure 6)")
        panels[1].set_title("complete SLAM (figure 7)")
        panels[0].legend(loc="upper left")
        settle(figure)
    return figure


def _draw_displacements(rows: Rows) -> Figure:
    """A column a data set, a row a sensor model: position (lines) and landmarks (dashed) over the displacement."""
    datasets = list(dict.fromkeys(row["dataset"] for row in rows))
    sensors = [name for name in _SENSORS if chosen(rows, sensor=name)]
    with house_style():
        figure = new_figure(2.4 * len(datasets) + 1.0, 2.5 * len(sensors) + 0.5)
        panels = figure.subplots(len(sensors), len(datasets), sharex=True, squeeze=False)
        for across, sensor in zip(panels, sensors, strict=True):
            for axes, dataset in zip(across, datasets, strict=True):
                own = chosen(rows, dataset=dataset, sensor=sensor)
                axes.set_visible(bool(own))
                _draw_over_delta(axes, own)
                model = "our sensor model" if sensor == "ours" else "the paper's"
                axes.set_title(f"data set {dataset}, {model}")
        for axes in panels[-1]:
            axes.set_xlabel("displacement [m]")
        for axes in panels[:, 0]:
            axes.set_ylabel("RMSE [m]")
        _legend(figure, panels.ravel().tolist())
        settle(figure)
    return figure


def _draw_many(rows: Rows) -> Figure:
    with house_style():
        figure = new_figure(4.6, 3.2)
        axes = figure.subplots()
        _draw_over_delta(axes, rows)
        axes.set(xlabel="displacement [m]", ylabel="RMSE [m]", title="data set 1, settings that make many modes")
        _legend(figure, [axes])
        settle(figure)
    return figure


def _draw_over_delta(axes: Axes, rows: Rows) -> None:
    for method in dict.fromkeys(row["method"] for row in rows):
        own = chosen(rows, method=method)
        deltas = list(dict.fromkeys(row["delta_m"] for row in own))
        colour, marker = _STYLE[method]
        for key, dashes in (("pose_rmse_m", "-"), ("landmark_rmse_m", "--")):
            values = [mean(chosen(own, delta_m=delta), key) for delta in deltas]
            known = [np.nan if value is None else value for value in values]
            label = method if dashes == "-" else None
            axes.plot(deltas, known, dashes, color=colour, marker=marker, ms=3, lw=1.2, label=label)
    axes.set_ylim(0.0, None)


def _legend(figure: Figure, panels: list[Axes]) -> None:
    """Methods by colour, and what dashes mean, once for all panels."""
    known: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            known.setdefault(label, handle)
    (dashed,) = panels[0].plot([], [], "--", color=INK)
    known["landmarks"] = dashed
    figure.legend(known.values(), known.keys(), loc="outside lower center", ncols=5)


def _draw_paths(paths: Mapping[str, Row]) -> Figure:
    """One robot of every data set, the group displaced: reference, and what three methods make of it."""
    datasets = sorted({key.partition(" dataset ")[2] for key in paths})
    first = [min((name for name in datasets if name.startswith(number)), default="") for number in "1236"]
    first = [name for name in first if name]
    with house_style():
        figure = new_figure(2.4 * len(first) + 0.4, 3.6)
        panels = figure.subplots(1, len(first), squeeze=False)[0]
        for axes, name in zip(panels, first, strict=True):
            own = {key.split()[2]: value for key, value in paths.items() if key.endswith(f" dataset {name}")}
            axes.plot(
                *np.array(next(iter(own.values()))["reference_m"]).T, color=INK, lw=2.0, alpha=0.3, label="reference"
            )
            for method in (method for method in _DRAWN_METHODS if method in own):
                axes.plot(*np.array(own[method]["estimate_m"]).T, color=_STYLE[method][0], lw=0.7, label=method)
            _draw_landmarks(axes, int(name.split()[0]), next(iter(own.values())))
            axes.set(aspect="equal", xlabel="x [m]", title=f"data set {name}")
        panels[0].set_ylabel("y [m]")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
        settle(figure)
    return figure


def _draw_landmarks(axes: Axes, dataset: int, path: Row) -> None:
    """True places; those of the group that the map has displaced in colour."""
    true = path.get("true_landmarks", {})
    for colour, label, moved in ((MUTED, "landmarks", False), (ODOMETRY, "displaced in the map", True)):
        at = [place for identity, place in true.items() if (int(identity) in GROUP[dataset]) == moved]
        if at:
            axes.plot(*np.array(at).T, "o", color=colour, ms=3, label=label, zorder=0)


def _draw_places(paths: Mapping[str, Row], rows: Rows) -> Figure:
    """Figure 11: trajectory, and every place of every landmark, of the first robot by each method."""
    robot = min(key.rpartition(" robot ")[2] for key in paths)
    own = {
        key.removeprefix(MANY_SCENARIO).split()[1]: value
        for key, value in paths.items()
        if key.endswith(f" robot {robot}")
    }
    methods = [method for method in MANY_METHODS if method in own]
    with house_style():
        figure = new_figure(7.2, 2.6 * ((len(methods) + 2) // 3) + 0.6)
        panels = figure.subplots((len(methods) + 2) // 3, 3, squeeze=False, sharex=True, sharey=True).ravel()
        for axes in panels[len(methods) :]:
            axes.set_visible(False)
        for axes, method in zip(panels, methods, strict=False):
            path = own[method]
            axes.plot(*np.array(path["reference_m"]).T, color=INK, lw=2.0, alpha=0.2, label="reference")
            axes.plot(*np.array(path["estimate_m"]).T, color=_STYLE[method][0], lw=0.6, label="estimate")
            _draw_landmarks(axes, MANY_DATASET, path)
            run = next(
                row for row in rows
                if (row["method"], str(row["robot"])) == (method, robot) and row["delta_m"] == path["delta_m"]
            )  # fmt: skip
            if run["places"]:
                at = np.array([place["at_m"] for place in run["places"]])
                axes.plot(*at.T, "*", color=ALERT, ms=4, label="places of landmarks with several")
            axes.set(aspect="equal", title=f"{method}")
        handles: dict[str, Any] = {}
        for axes in panels[: len(methods)]:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                handles.setdefault(label, handle)
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3)
        settle(figure)
    return figure


def _draw_reliability(said: list[float], right: list[bool]) -> Figure:
    from evermap.viz.presence_figures import plot_reliability

    truth = [float(value) for value in right]
    figure = plot_reliability(reliability(said, truth), belief_scores(said, truth), title="changes reported by 'joint'")
    above, below = figure.axes
    above.set_ylabel("the very group [1]")
    below.set(xlabel="probability said [1]", ylabel="changes")
    return figure
