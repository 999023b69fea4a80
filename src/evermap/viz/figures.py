"""The figures of a run, as one would print them in a paper."""

from __future__ import annotations

from evermap.metrics.summary import Evaluation
from evermap.types import Recording, SlamResult
from evermap.viz.calibration_figure import draw_calibration
from evermap.viz.map_figure import draw_map
from evermap.viz.style import NamedFigure, house_style, settle
from evermap.viz.time_figures import draw_consistency, draw_errors, draw_latency


def draw_figures(
    recording: Recording, result: SlamResult, evaluation: Evaluation, *, real_time_factor: float | None = None
) -> tuple[NamedFigure, ...]:
    """All figures that this run has something to show in, in the order of the report.

    Args:
        recording: what was processed.
        result: what came out.
        evaluation: `compare_with_truth(recording, result)`.
        real_time_factor: duration of the recording over processing time, for the latency figure.
    """
    with house_style():
        drawn = (
            draw_map(recording, result, evaluation),
            draw_errors(recording, result, evaluation),
            draw_consistency(result),
            draw_latency(recording, result, real_time_factor),
            draw_calibration(result),
        )
        figures = tuple(figure for figure in drawn if figure is not None)
        for named in figures:
            settle(named.figure)
    return figures
