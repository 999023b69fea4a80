"""Censored lifetimes, a row each: what was seen, and where the end may be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from evermap.errors import ConfigError, printable
from evermap.survival.censored import CensoredLifetimes
from evermap.viz.style import ALERT, ESTIMATE, ESTIMATE_BAND, MUTED, house_style, new_figure, settle
from evermap.viz.time_axis import unit_for

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_samples(data: CensoredLifetimes, names: Sequence[str]) -> Figure:
    """A bar from the first sighting, or the entry, to the last; a pale one over where the end may be, a dot at an end.

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
    with house_style():
        figure = new_figure(6.4, 0.7 + 0.32 * n)
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
        settle(figure)
    return figure
