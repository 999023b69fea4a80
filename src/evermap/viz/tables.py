"""Tables of the report, as HTML."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from evermap.metrics.summary import Evaluation
from evermap.types import UNKNOWN, ParameterEstimate, SlamResult
from evermap.viz.calibration_figure import has_prior, quantity

_MAX_LANDMARK_ROWS = 500


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: Sequence[int] = ()) -> str:
    """A table of ready markup; `numbers` are the columns to align right."""

    def row(tag: str, cells: Sequence[str]) -> str:
        kind = [' class="n"' if column in numbers else "" for column in range(len(cells))]
        return "<tr>" + "".join(f"<{tag}{k}>{cell}</{tag}>" for k, cell in zip(kind, cells, strict=True)) + "</tr>"

    body = "".join(row("td", cells) for cells in rows)
    return f'<div class="scroll"><table><thead>{row("th", head)}</thead><tbody>{body}</tbody></table></div>'


def is_noise(parameter: ParameterEstimate) -> bool:
    """Noise levels are named `sigma_...`; everything else is a calibration state."""
    return parameter.name.startswith("sigma_")


def calibration_table(result: SlamResult) -> str:
    """Calibration states with uncertainty and prior; '' if there is none."""
    return _parameters([parameter for parameter in result.parameters if not is_noise(parameter)])


def noise_table(result: SlamResult) -> str:
    """Noise levels as the recording determined them; '' if there is none."""
    return _parameters([parameter for parameter in result.parameters if is_noise(parameter)])


def _parameters(parameters: Sequence[ParameterEstimate]) -> str:
    if not parameters:
        return ""
    rows = [
        (
            f"<code>{escape(p.name)}</code>",
            escape(quantity(p.value, 0.0 if p.fixed else p.sigma, p.unit))
            + (" <small>fixed</small>" if p.fixed else ""),
            escape(quantity(p.prior_mean, p.prior_sigma, p.unit)) if has_prior(p) else "–",
            _learned(p),
            escape(p.meaning),
        )
        for p in parameters
    ]
    return table(("name", "estimate, 1σ", "prior, 1σ", "narrower", "meaning"), rows, numbers=(1, 2, 3))


def _learned(parameter: ParameterEstimate) -> str:
    """How many times narrower than its prior the estimate is."""
    if not has_prior(parameter) or not 0 < parameter.sigma < math.inf:
        return "–"
    return f"{parameter.prior_sigma / parameter.sigma:.3g} ×"


def change_table(result: SlamResult) -> str:
    """Every change with its numbers; stamps as in the recording. '' if there is none."""
    if not result.changes:
        return ""
    rows = [
        (
            ", ".join(change.labels),
            change.kind.value,
            _stamp(change.stamp_from_s),
            _stamp(change.stamp_to_s),
            f"{change.displacement_m[0]:.3f}",
            f"{change.displacement_m[1]:.3f}",
            f"{math.degrees(change.rotation_rad):.2f}",
            f"{change.probability:.4f}",
        )
        for change in result.changes
    ]
    head = ("landmarks", "kind", "not before [s]", "not after [s]", "Δx [m]", "Δy [m]", "turn [°]", "probability")
    return table(head, rows, numbers=(2, 3, 4, 5, 6, 7))


def _stamp(stamp_s: float) -> str:
    return f"{stamp_s:.1f}" if math.isfinite(stamp_s) else "–"


def landmark_table(result: SlamResult, evaluation: Evaluation) -> str:
    """The map, landmark by landmark, with its error where surveyed; '' if it is empty."""
    landmarks, errors = result.landmarks, evaluation.landmarks or evaluation.landmarks_own
    if len(landmarks) == 0:
        return ""
    error_of = {} if errors is None else dict(zip(errors.landmark_id.tolist(), errors.error_m.tolist(), strict=True))
    nees_of = {} if errors is None else dict(zip(errors.landmark_id.tolist(), errors.nees.tolist(), strict=True))
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(landmarks.covariance_m2)[:, 1], 0.0))
    rows = []
    for i, name in enumerate(landmarks.landmark_id[:_MAX_LANDMARK_ROWS].tolist()):
        kind = int(landmarks.class_id[i])
        nees = nees_of.get(name, math.nan)
        rows.append(
            (
                escape(landmarks.names.get(name, str(name))),
                escape(landmarks.class_names[kind]) if UNKNOWN < kind < len(landmarks.class_names) else "–",
                f"{landmarks.n_hits[i]:,}",
                f"{landmarks.n_misses[i]:,}",
                f"{landmarks.position_m[i, 0]:.3f}",
                f"{landmarks.position_m[i, 1]:.3f}",
                f"{2e3 * sigma[i]:.0f}",
                f"{1e3 * error_of[name]:.0f}" if name in error_of else "–",
                f"{nees:.1f}" if math.isfinite(nees) else "–",
            )
        )
    head = ("id", "class", "seen", "missed", "x [m]", "y [m]", "2σ [mm]", "error [mm]", "NEES")
    html = table(head, rows, numbers=(2, 3, 4, 5, 6, 7, 8))
    more = len(landmarks) - len(rows)
    return html + (f"<p>{more} more are in <code>map.parquet</code>.</p>" if more > 0 else "")
