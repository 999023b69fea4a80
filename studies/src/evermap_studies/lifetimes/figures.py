"""Figures of what is learned about lifetimes: beside the truth, and where bands do not hold it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from evermap.survival.nonparametric import Npmle
from evermap.survival.parametric_fit import ParametricFit
from evermap.types import FloatArray
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    ESTIMATE_BAND,
    GROUP,
    INK,
    LANDMARK,
    MUTED,
    ODOMETRY,
    ONLINE,
    SHADE,
    house_style,
    new_figure,
    settle,
)
from evermap_studies.lifetimes.moving import TrackedRun
from evermap_studies.lifetimes.rooms import RoomStays
from evermap_studies.lifetimes.tracks_now import TracksNow, draw_tracks
from evermap_studies.lifetimes.truth import ESTIMATORS, NAIVE, Stays, Value, groups
from evermap_studies.worlds.patrol_lifetimes import DAY_S, PatrolRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = dict(zip(ESTIMATORS, (ESTIMATE, GROUP, ALERT, ODOMETRY, ONLINE, LANDMARK), strict=True))
PLACE = 2
"""Row of the place at which curves are drawn."""


def draw_scene(tracked: TrackedRun) -> Figure:
    """The thesis' Fig. 5.3: the frame with the largest working set among those with most in view."""
    run = tracked.run
    busy = np.array([len(now) for now in tracked.followed]) + np.array([len(rest) for rest in tracked.resting_m])
    frame = int(np.argmax(busy))
    now = tracked.followed[frame]
    with house_style():
        figure = new_figure(6.4, 6.6)
        axes = figure.add_subplot()
        draw_tracks(
            axes,
            TracksNow(
                now.position_m,
                now.velocity_mps,
                now.static,
                tracked.resting_m[frame],
                run.sensor_m[frame],
                run.world.reach_m,
            ),
            path_m=run.sensor_m[: frame + 1],
            detected_m=run.detected_m[run.detections(frame)],
        )
        half = run.world.half_extent_m
        axes.set(xlim=(-half, half), ylim=(-half, half), title=f"{run.stamp_s[frame]:.0f} s into the run")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        settle(figure)
    return figure


def draw_moving(tracked: TrackedRun, learned: dict[str, ParametricFit]) -> Figure:
    """Learned survival of the classes that leave, with its band, over the true one."""
    with house_style():
        figure = new_figure(6.4, 2.8)
        all_axes = figure.subplots(1, len(learned), sharey=True, squeeze=False)[0]
        truth = {one.name: one.lifetime for one in tracked.run.world.classes}
        for axes, (name, found) in zip(all_axes, learned.items(), strict=True):
            lifetime = truth[name]
            assert lifetime is not None
            t = np.linspace(0.0, float(lifetime.quantile(0.98)), 200)[1:]
            axes.fill_between(t, *found.band(t), color=ESTIMATE_BAND, lw=0, label="95 % band")
            axes.plot(t, np.exp(found.prior.log_survival(t)), color=ESTIMATE, label="learned from tracks")
            axes.plot(t, np.exp(lifetime.log_survival(t)), color=INK, ls="--", label="true")
            axes.set(title=name, xlabel="time parked [s]", ylim=(0.0, 1.02))
        all_axes[0].set_ylabel("still there")
        figure.legend(*all_axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        settle(figure)
    return figure


def draw_truth(run: PatrolRun) -> Figure:
    """All estimates of all classes at one place, over the true survival."""
    world = run.world
    with house_style():
        figure = new_figure(7.0, 5.6)
        all_axes = figure.subplots(2, 2, sharey=True).ravel()
        for class_id, axes in enumerate(all_axes[: len(world.classes)]):
            t = np.linspace(0.0, float(world.quantile(class_id, PLACE, np.array(0.95))), 150)[1:]
            stays = Stays.of(run, class_id, PLACE)
            for name, estimator in ESTIMATORS.items():
                curve, lower, upper = estimator(stays, t)
                if name not in NAIVE:
                    axes.fill_between(t / DAY_S, lower, upper, color=COLOURS[name], alpha=0.2, lw=0)
                axes.plot(t / DAY_S, curve, color=COLOURS[name], ls=":" if name in NAIVE else "-", label=name)
            axes.plot(t / DAY_S, world.survival(class_id, PLACE, t), color=INK, ls="--", label="true")
            axes.set(title=f"{world.classes[class_id].name}, {world.places[PLACE].name}", ylim=(0.0, 1.02))
            axes.set_xlabel("time there [days]")
        for axes in all_axes[::2]:
            axes.set_ylabel("still there")
        figure.legend(*all_axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        settle(figure)
    return figure


def draw_coverage(values: list[Value], run: PatrolRun) -> Figure:
    """How often 95 % bands hold the truth: a dot for every class at every place, a bar for all."""
    names = list(ESTIMATORS)
    n_groups = sum(1 for _ in groups(run.world))
    with house_style():
        figure = new_figure(6.4, 2.8)
        axes = figure.add_subplot()
        axes.axvline(0.95, color=MUTED, lw=0.8, ls="--")
        for row, name in enumerate(reversed(names)):
            each = [float(np.mean(value["coverage"])) for value in values if value["estimator"] == name]
            spread = row + np.linspace(-0.25, 0.25, n_groups)
            axes.plot(each, spread, ls="none", marker="o", ms=3.0, alpha=0.6, color=COLOURS[name])
            axes.plot([float(np.mean(each))] * 2, [row - 0.38, row + 0.38], color=INK, lw=2.0)
        axes.set_yticks(range(len(names)), list(reversed(names)))
        axes.set(xlabel="share of 95 % bands that hold the truth", xlim=(-0.02, 1.02))
        axes.grid(visible=False, axis="y")
        settle(figure)
    return figure


def draw_rooms(rooms: list[RoomStays]) -> Figure:
    """The rarest looks at every room against all minutes; a bar where they are farthest apart."""
    rarest = max(one.every_s for one in rooms)
    shown = [one for one in rooms if one.every_s == rarest]
    with house_style():
        figure = new_figure(7.2, 1.2 + 2.0 * -(-len(shown) // 3))
        all_axes = figure.subplots(-(-len(shown) // 3), 3, sharex=True, sharey=True, squeeze=False).ravel()
        for axes, one in zip(all_axes, shown, strict=False):
            _draw_room(axes, one)
        for axes in all_axes[len(shown) :]:
            axes.set_axis_off()
        for axes in all_axes[max(0, len(shown) - 3) : len(shown)]:
            axes.set_xlabel("time there [min]")
            axes.xaxis.set_tick_params(labelbottom=True)
        for axes in all_axes[::3]:
            axes.set_ylabel("still there")
        figure.legend(*all_axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        settle(figure)
    return figure


def _draw_room(axes: Axes, one: RoomStays) -> None:
    t = np.geomspace(30.0, 86400.0, 800)
    full = one.full.survival(t)
    axes.axvspan(0.5, one.every_s / 60.0, color=SHADE, lw=0, zorder=0, label="between two looks")
    axes.fill_between(t / 60.0, *one.full.band(t), color=ESTIMATE_BAND, lw=0, step="post")
    axes.plot(t / 60.0, full, color=INK, drawstyle="steps-post", label="every minute")
    for name, colour, label in (
        ("bounds", ALERT, "looks, bounds alone"),
        ("entered", ESTIMATE, "looks, and the unseen"),
    ):
        estimate = one.looks[name]
        if estimate is not None:
            lower, upper = estimate.survival(t)
            axes.fill_between(t / 60.0, lower, upper, color=colour, alpha=0.25, lw=0)
            axes.plot(t / 60.0, 0.5 * (lower + upper), color=colour, lw=1.0, label=label)
    bounds = one.looks["bounds"]
    if bounds is not None:
        at, low, high = _farthest(t, full, bounds)
        axes.plot([at / 60.0] * 2, [low, high], color=ALERT, lw=2.5, label="largest distance")
        axes.set_title(f"{one.room}: {one.distance(bounds):.2f}")
    axes.set(xscale="log", ylim=(0.0, 1.02), xlim=(0.5, 1440.0))


def _farthest(t: FloatArray, curve: FloatArray, estimate: Npmle) -> tuple[float, float, float]:
    """Where a curve is farthest from the bounds of an estimate, and from where to where."""
    lower, upper = estimate.survival(t)
    nearest = np.clip(curve, lower, upper)
    at = int(np.argmax(np.abs(nearest - curve)))
    return float(t[at]), float(curve[at]), float(nearest[at])
