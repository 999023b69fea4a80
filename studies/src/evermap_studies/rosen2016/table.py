"""The values of Rosen 2016 for people: how many agree with the reference, and all of them as Markdown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from evermap_studies.markdown import markdown_table, number

Value = Mapping[str, Any]

LIMIT = 3.0
"""Standard errors of the difference within which two numbers agree."""
P_OUTSIDE = math.erfc(LIMIT / math.sqrt(2.0))
"""Probability that a normal variable is further out: one value in 370."""

NAMES = {
    "uniform": "filter, uniform prior",
    "general_purpose": "filter, general-purpose prior",
    "empirical": "empirical estimator",
    "empirical_as_coded": "empirical estimator, as coded",
}
SETTINGS = {"p_miss": "P_M", "p_false": "P_F", "revisit_rate_hz": "λ_R [1/s]", "threshold": "P_V"}


def verdict(values: Sequence[Value], in_reference: int) -> dict[str, Any]:
    """How the values agree with the reference.

    Args:
        values: with `z` where they were compared.
        in_reference: how many numbers the reference holds.
    """
    compared = [value for value in values if "z" in value]
    known = [value["z"] for value in compared if value["z"] is not None]
    outside = [value for value in compared if value["z"] is None or abs(value["z"]) > LIMIT]
    return {
        "limit": LIMIT,
        "in_reference": in_reference,
        "compared": len(compared),
        "outside": len(outside),
        "expected_outside": P_OUTSIDE * len(compared),
        "z_rms": math.sqrt(sum(z * z for z in known) / len(known)) if known else None,
        "z_largest": max(known, key=abs) if known else None,
        "outside_values": [dict(value) for value in outside],
    }


def as_markdown(table: Mapping[str, Any]) -> str:
    """The whole table as Markdown; no trailing line end."""
    values = table["values"]
    return "\n\n".join(
        [
            _summary(table),
            "### Figure 3 (d): L1 error over the revisit rate",
            _errors([value for value in values if value["figure"] == "3d"], ("revisit_rate_hz",)),
            "### Figure 4: precision and recall of removal below P_V",
            _removal([value for value in values if value["figure"] == "4"]),
            "### Figure 3 (a) to (c): L1 error over the detector's errors",
            _errors([value for value in values if value["figure"] == "3abc"], ("p_miss", "p_false")),
        ]
    )


def _summary(table: Mapping[str, Any]) -> str:
    settings, judged = table["settings"], table["verdict"]
    made = (
        f"{len(table['values'])} values, {settings['sequences']:,} sequences a setting, seed {settings['seed']}, "
        f"in {table['processing_s']:.0f} s. "
    )
    cells = "Cells are *ours ± standard error (reference, z)*." if judged else "Cells are *ours ± standard error*."
    if judged is None:
        return made + "Compared with nothing: no reference numbers. " + cells
    z_rms, largest = number("{:.2f}", judged["z_rms"]), number("{:+.2f}", judged["z_largest"])
    agreement = (
        f"{judged['compared']} of {judged['in_reference']} reference numbers compared; "
        f"**{judged['outside']} further than {judged['limit']:g} standard errors** of the difference. "
        f"Of as many independent ones chance puts {judged['expected_outside']:.1f} there. "
        f"Root mean square of z {z_rms}, largest {largest}. "
    )
    lines = [made + agreement + cells]
    for value in judged["outside_values"]:
        where = [f"{title} {value[name]:g}" for name, title in SETTINGS.items() if value[name] is not None]
        what = f"{value['metric']} of {NAMES.get(value['estimator'], 'the simulator')}"
        lines.append(f"- outside, figure {value['figure']}: {what} at {', '.join(where)}: {_cell(value)}")
    return "\n".join(lines)


def _errors(values: Sequence[Value], settings: tuple[str, ...]) -> str:
    """One row a setting, one column an estimator, and the mean number of looks."""
    rows: dict[tuple[float, ...], dict[str | None, Value]] = {}
    for value in values:
        rows.setdefault(tuple(value[name] for name in settings), {})[value["estimator"]] = value
    header = [*(SETTINGS[name] for name in settings), *NAMES.values(), "looks"]
    lines = (
        [*(f"{number:g}" for number in where), *(_cell(row[name]) for name in NAMES), _cell(row[None], "{:.2f}")]
        for where, row in rows.items()
    )
    return markdown_table(header, lines)


def _removal(values: Sequence[Value]) -> str:
    rows: dict[tuple[str, float | None], dict[str, Value]] = {}
    for value in values:
        rows.setdefault((value["estimator"], value["threshold"]), {})[value["metric"]] = value
    header = ("estimator", "P_V", "precision", "recall", "share of sequences with a removal")
    lines = (
        [
            NAMES[name],
            number("{:g}", threshold),
            *(_cell(row[metric], "{:.4f}") for metric in ("precision", "recall", "precision_known")),
        ]
        for (name, threshold), row in rows.items()
    )
    return markdown_table(header, lines)


def _cell(value: Value, form: str = "{:.4f}") -> str:
    """`ours ± s.e. (reference, z)`."""
    ours = f"{number(form, value['value'])} ± {number(form, value['se'])}"
    if "z" not in value:
        return ours
    z = number("{:+.1f}", value["z"])
    far = value["z"] is None or abs(value["z"]) > LIMIT
    return f"{ours} ({form.format(value['reference'])}, {f'**{z}**' if far else z})"
