"""Figures of censored samples and of lifetimes by chunk of the ground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from evermap.errors import ConfigError, printable
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.hazard_regression import HazardDraws
from evermap.types import FloatArray
from evermap.viz.style import ALERT, ESTIMATE, ESTIMATE_BAND, MUTED, drawing
from evermap.viz.time_axis import DURATIONS, unit_for
from evermap_studies.lifetimes.pooling import Chunk

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_chunks(
    chunks: Sequence[Chunk], size_m: float, hazards: Sequence[HazardDraws], *, title: str | None = None
) -> Figure:
    """Draw two maps of square chunks: until when half have gone, and how uncertain that is.

    The uncertainty is the factor between the bounds of the 95 % band of the median lifetime.

    Args:
        chunks: columns and rows.
        size_m: side of a chunk.
        hazards: of each chunk, as `PooledHazard.at` gives them.
        title: above the figure.

    Raises:
        ConfigError: no chunk, or not as many hazards.
    """
    if not len(chunks) == len(hazards) > 0:
        raise ConfigError(f"{len(chunks)} chunks need as many hazards, at least one", field="hazards")
    median, lower, upper = np.array([one.quantile(0.5) for one in hazards]).T
    with drawing(7.2, 3.8, title=title) as figure:
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        _map(left, chunks, size_m, median, "half have gone after", durations=True)
        _map(right, chunks, size_m, upper / lower, "upper over lower bound [1]", durations=False)
        left.set_ylabel("y [m]")
    return figure


def _map(
    axes: Axes, chunks: Sequence[Chunk], size_m: float, values: FloatArray, label: str, *, durations: bool
) -> None:
    from matplotlib.collections import PatchCollection
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Rectangle

    squares = [Rectangle((x * size_m, y * size_m), size_m, size_m) for x, y in chunks]
    low, high = float(values.min()), float(values.max())
    # a colour bar needs some length
    norm = LogNorm(min(low, 0.9 * high), max(high, 1.1 * low))
    drawn = PatchCollection(squares, cmap="cividis", norm=norm, edgecolor="white", linewidth=0.5)
    drawn.set_array(values)
    axes.add_collection(drawn)
    axes.autoscale_view()
    axes.set(aspect="equal", xlabel="x [m]")
    axes.set_title(label)
    axes.grid(visible=False)
    ticks = _duration_ticks(low, high) if durations else _plain_ticks(low, high)
    bar = axes.figure.colorbar(drawn, ax=axes, location="bottom", shrink=0.9, aspect=30)
    bar.minorticks_off()
    bar.set_ticks([value for _, value in ticks], labels=[name for name, _ in ticks])


def _duration_ticks(low_s: float, high_s: float) -> list[tuple[str, float]]:
    """Whole durations in sight; where there is hardly one, a few numbers in the unit that suits."""
    ticks = [(name, value) for name, value in DURATIONS if low_s <= value <= high_s]
    if len(ticks) >= 3:
        return ticks
    unit = unit_for(high_s)
    return [(f"{value / unit.seconds:.2g} {unit.name}", value) for value in np.geomspace(low_s, high_s, 4).tolist()]


def _plain_ticks(low: float, high: float) -> list[tuple[str, float]]:
    return [(f"{value:.2g}", value) for value in np.geomspace(low, high, 4).tolist()]


def plot_samples(data: CensoredLifetimes, names: Sequence[str]) -> Figure:
    """Draw a bar from the first sighting, or the entry, to the last, and a pale one over where the end may be.

    Args:
        data: N samples, few enough to have a row each.
        names: N words for the rows, from the top.

    Raises:
        ConfigError: not as many names.
    """
    n = len(data.left_s)
    if len(names) != n:
        raise ConfigError(f"{n} lifetimes need as many names, not {len(names)}", field="names")
    finite = np.concatenate([data.left_s, data.right_s[np.isfinite(data.right_s)], data.entry_s])
    unit = unit_for(float(finite.max()))
    end = 1.15 * float(finite.max()) / unit.seconds
    row = np.arange(n)[::-1]
    entry, right = data.entry_s / unit.seconds, np.minimum(data.right_s / unit.seconds, end)
    since = np.maximum(data.left_s / unit.seconds, entry)
    known = np.isfinite(data.right_s)
    with drawing(6.4, 0.7 + 0.32 * n) as figure:
        axes = figure.subplots()
        axes.hlines(row, 0.0, entry, color=MUTED, lw=1.5, ls=":", label="unknown to us if it had gone by then")
        axes.barh(row, since - entry, left=entry, height=0.34, color=ESTIMATE, label="seen to be there")
        axes.barh(row, right - since, left=since, height=0.34, color=ESTIMATE_BAND, label="the end is in here")
        axes.plot(right[data.exact], row[data.exact], "o", color=ALERT, ms=5, label="the end was watched")
        axes.plot(right[~known], row[~known], ">", color=ESTIMATE, ms=5, label="never seen gone")
        axes.set_yticks(row, [printable(name) for name in names])
        axes.set(xlim=(0.0, 1.01 * end), xlabel=f"age [{unit.name}]")
        axes.grid(visible=False, axis="y")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure
