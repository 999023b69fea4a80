"""Figures that one would print: reliability, and the metrics side by side."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from evermap_score.calibration import bin_by_mass
from evermap_score.errors import ScoreError
from evermap_score.score import Report

MARK = "written by evermap-score"
"""What figures say that a later run may replace."""
SHOWN = re.compile(r"changes/(\w+)/(any|1)_looks/f1|presence/f1|identity/(idf1|hota)")
"""Names of the metrics of the figure: shares, of which more is better."""


def write_figures(report: Report, folder: str | Path) -> list[Path]:
    """Write `reliability.pdf`, `scores.pdf` and the same as PNG into a folder; return their paths.

    Raises:
        ScoreError: a file of that name is there that this did not write.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    reliability = Figure(figsize=(3.4, 3.2), layout="constrained")
    FigureCanvasAgg(reliability)
    axes = reliability.subplots()
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    for each in report.estimates:
        bins = bin_by_mass(each.claims[:, 0], each.claims[:, 1], np.ones(len(each.claims)))
        axes.plot(bins.mean_p, bins.share_true, marker="o", markersize=4, linewidth=1, label=each.name)
    axes.set(xlabel="stated probability", ylabel="share that was true", xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.legend(frameon=False, fontsize=8)
    scores = Figure(figsize=(5.0, 2.8), layout="constrained")
    FigureCanvasAgg(scores)
    axes = scores.subplots()
    names = [
        name
        for name in report.units
        if SHOWN.fullmatch(name) and any(math.isfinite(each.values[name].value) for each in report.estimates)
    ]
    for number, each in enumerate(report.estimates):
        shown = [each.values[name] for name in names]
        height = np.arange(len(names)) + 0.12 * (number - 0.5 * (len(report.estimates) - 1))
        value = np.array([one.value for one in shown])
        bounds = np.array([[one.value - one.low, one.high - one.value] for one in shown]).reshape(-1, 2).T
        axes.errorbar(value, height, xerr=np.clip(np.nan_to_num(bounds), 0.0, None), fmt="o", markersize=4,
                      capsize=2, linewidth=1, label=each.name)  # fmt: skip
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.invert_yaxis()
    axes.set(xlim=(-0.02, 1.02))
    axes.legend(frameon=False, fontsize=8)
    paths = []
    for name, figure in (("reliability", reliability), ("scores", scores)):
        for ending in ("pdf", "png"):
            path = folder / f"{name}.{ending}"
            if path.exists() and MARK.encode() not in path.read_bytes():
                raise ScoreError("is there already, and not by this command", path=path, hint="another folder")
            figure.savefig(path, dpi=200, metadata={"Creator" if ending == "pdf" else "Software": MARK})
            paths.append(path)
    return paths
