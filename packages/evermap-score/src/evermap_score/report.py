"""A report as text, Markdown, LaTeX and JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from evermap_score.score import EstimateScore, Interval, Report

SCHEMA_VERSION = 1


def _cell(value: Interval) -> str:
    if not math.isfinite(value.value):
        return "-"
    text = f"{value.value:.4g}"
    return f"{text} [{value.low:.3g}, {value.high:.3g}]" if math.isfinite(value.low) else text


def table_of(report: Report) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows: metric, unit, each estimate, and the others minus the first.

    Metrics that no estimate has are left out.
    """
    others = report.estimates[1:]
    header = ["metric", "unit", *(each.name for each in report.estimates)]
    header += [f"{each.name} - {report.estimates[0].name}" for each in others]
    rows = []
    for name, unit in report.units.items():
        if any(math.isfinite(each.values[name].value) for each in report.estimates):
            cells = [_cell(each.values[name]) for each in report.estimates]
            rows.append([name, unit, *cells, *(_cell(each.minus_first[name]) for each in others)])
    return header, rows


def describe(report: Report) -> list[str]:
    """Return what the numbers rest on, a sentence each."""
    rules = report.rules
    space = "in space" if rules.in_space else "in the plane"
    lines = [
        f"Matched by {rules.match}, {space}, within {rules.match_m:g} m, at {len(report.instants_s)} instants.",
        f"Intervals: 95 %, bootstrap over {report.resampled}, {report.draws} draws, seed {report.seed}.",
        *(_describe_alignment(each) for each in report.estimates),
    ]
    for found in report.contradictions:
        away = ", ".join(f"{name} {distance:.3g} m" for name, distance in found.distance_m.items())
        lines.append(
            f"Truth, row {found.row + 1}, landmark {found.landmark_id}: contradicted by every estimate ({away} away)."
        )
    return lines


def _describe_alignment(each: EstimateScore) -> str:
    alignment = each.alignment
    if alignment.n_static == 0:
        return f"{each.name}: not aligned; its frame is taken to be that of the truth."
    shift = math.dist(alignment.translation_m.tolist(), (0.0, 0.0, 0.0))
    return (
        f"{each.name}: aligned by {alignment.n_static} landmarks that are static in both (shift {shift:.3g} m, "
        f"rms {alignment.rms_m:.3g} m afterwards)."
    )


def to_text(report: Report) -> str:
    """Return the report as a table of text."""
    header, rows = table_of(report)
    widths = [max(len(row[column]) for row in (header, *rows)) for column in range(len(header))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in (header, *rows)]
    return "\n".join([*(line.rstrip() for line in lines), "", *describe(report)]) + "\n"


def to_markdown(report: Report) -> str:
    """Return the report as a table of Markdown."""
    header, rows = table_of(report)

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    parts = [line(header), "|" + "---|" * len(header), *(line(row) for row in rows), ""]
    return "\n".join(parts + [f"- {sentence}" for sentence in describe(report)]) + "\n"


_SPECIAL = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_SPECIAL |= {each: "\\" + each for each in "&%$#_{}"}


def _escape(text: str) -> str:
    return "".join(_SPECIAL.get(each, each) for each in text)


def to_latex(report: Report) -> str:
    """Return the report as a `tabular` with the rules of booktabs."""
    header, rows = table_of(report)
    lines = [" & ".join(_escape(cell) for cell in row) + r" \\" for row in (header, *rows)]
    notes = [f"% {sentence}" for sentence in describe(report)]
    columns = "ll" + "r" * (len(header) - 2)
    return "\n".join(
        [*notes, rf"\begin{{tabular}}{{{columns}}}", r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule",
         r"\end{tabular}"]
    ) + "\n"  # fmt: skip


def to_values(report: Report) -> dict[str, Any]:
    """Return the report as values for JSON; what is unknown is None."""

    def values_of(numbers: dict[str, Interval]) -> dict[str, Any]:
        return {name: {key: _finite(one) for key, one in asdict(number).items()} for name, number in numbers.items()}

    return {
        "schema_version": SCHEMA_VERSION,
        "rules": asdict(report.rules),
        "instants_s": list(report.instants_s),
        "bootstrap": {"over": report.resampled, "draws": report.draws, "seed": report.seed, "level": 0.95},
        "units": report.units,
        "estimates": [
            {
                "name": each.name,
                "alignment": {
                    "rotation": each.alignment.rotation.tolist(),
                    "translation_m": each.alignment.translation_m.tolist(),
                    "n_static": each.alignment.n_static,
                    "rms_m": _finite(each.alignment.rms_m),
                },
                "metrics": values_of(each.values),
                "minus_first": values_of(each.minus_first),
            }
            for each in report.estimates
        ],
        "contradicted_by_all": [
            {
                "row": found.row,
                "landmark_id": found.landmark_id,
                "distance_m": {name: _finite(distance) for name, distance in found.distance_m.items()},
            }
            for found in report.contradictions
        ],
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def to_json(report: Report) -> str:
    """Return the report as JSON."""
    return json.dumps(to_values(report), indent=2, ensure_ascii=False) + "\n"
