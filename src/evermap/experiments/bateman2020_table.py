"""The experiment as Markdown: Table 5.1, its orderings, harsher worlds, and what the hidden parameters do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from evermap.experiments.bateman2020_published import LIMIT, THESIS, TRIAL
from evermap.experiments.bateman2020_scores import COMPARED, Row
from evermap.experiments.bateman2020_settings import IN_THE_TABLE, LEARNED, OTHER_READINGS, READINGS, SUPPRESSION
from evermap.experiments.markdown import markdown_table, number

Rows = Sequence[Row]

NAMES = {
    "accuracy": "accuracy",
    "survival_ratio": "MES/S",
    "brier": "Brier score",
    "delay_mean": "mean delay [looks]",
}
_FORMS = {"brier": "{:.4f}", "delay_mean": "{:.1f}"}


def as_markdown(table: Mapping[str, Any]) -> str:
    """The whole table as Markdown; no trailing line end."""
    rows = table["rows"]
    read = [row for row in rows if row["world"] in READINGS]
    parts = []
    if any(row["filter"] == LEARNED for row in rows):
        parts += [_expected(table["expected"])]
    parts += [_made(table)]
    if read:
        parts += ["### Table 5.1", *(_published(read, sensor) for sensor in _distinct(read, "sensor"))]
    if table["orderings"]:
        parts += ["### Orderings of the thesis", _orderings(table["orderings"])]
    for sensor in _distinct(rows, "sensor"):
        parts += [f"### All worlds, {sensor}", _worlds([row for row in rows if row["sensor"] == sensor])]
    if table["sweep"]:
        parts += ["### What the parameters do that the thesis does not tell", _sweep(table)]
    return "\n\n".join(parts)


def _distinct(rows: Rows, key: str) -> list[Any]:
    return list(dict.fromkeys(row[key] for row in rows))


def _expected(rows: Rows) -> str:
    lines = []
    for row in rows:
        form = _FORMS.get(row["metric"], "{:.3f}")
        bound = f"≤ {row['at_most']:g}" if "at_most" in row else f"≥ {row['at_least']:g}"
        met = "–" if row["met"] is None else "yes" if row["met"] else "**no**"
        what = f"`{LEARNED}`, {row['world']}, {row['sensor']}: {NAMES[row['metric']]}"
        lines.append((what, bound, number(form, row["measured"]), met))
    return markdown_table(("", "expected", "measured", "met"), lines)


def _made(table: Mapping[str, Any]) -> str:
    settings = table["settings"]
    missed = ", ".join(f"{value:.3f} ({sensor})" for sensor, value in table["tuned_p_miss"].items())
    return (
        f"{settings['runs']} runs a world and sensor, seed {settings['seed']}, in {table['processing_s']:.0f} s. Cells "
        f"are *value ± standard error*, of {settings['bootstrap_draws']} resamplings of the runs. P_M of `jcf-tuned`, "
        f"from {settings['tuning_runs']} other runs: {missed}."
    )


def _published(rows: Rows, sensor: str) -> str:
    """Both readings of the thesis' world, the paper's numbers and the trial's, filter by filter."""
    own = {(row["world"], row["filter"]): row for row in rows if row["sensor"] == sensor}
    worlds = _distinct(rows, "world")
    lines = []
    for name in (name for name in (*IN_THE_TABLE, *OTHER_READINGS) if (worlds[0], name) in own):
        cells = []
        for metric in COMPARED:
            cells += [_value(own[world, name], metric) for world in worlds]
            cells += [number("{:.3f}", table.get((sensor, name, metric))) for table in (THESIS, TRIAL)]
        lines.append((f"`{name}`", *cells))
    header = [cell for metric in COMPARED for cell in (*(f"{NAMES[metric]}, {w}" for w in worlds), "thesis", "trial")]
    return markdown_table((sensor, *header), lines)


def _value(row: Row, metric: str, form: str = "{:.3f}") -> str:
    error = row[f"{metric}_se"]
    return number(form, row[metric]) + ("" if error is None else f" ± {form.format(error)}")


def _orderings(rows: Rows) -> str:
    """Counts a world, sensor and metric, and by name the pairs that don't hold."""
    lines = []
    for world, sensor, metric in dict.fromkeys((row["world"], row["sensor"], row["metric"]) for row in rows):
        own = [row for row in rows if (row["world"], row["sensor"], row["metric"]) == (world, sensor, metric)]
        kinds = {kind: [row for row in own if row["verdict"] == kind] for kind in ("holds", "open", "reversed")}
        count = f"{len(kinds['holds'])} of {len(own)}"
        lines.append((world, sensor, NAMES[metric], count, *(_pairs(kinds[kind]) for kind in ("open", "reversed"))))
    header = ("world", "sensor", "score", "hold", f"within {LIMIT:g} standard errors of no difference", "reversed")
    return (
        "Pairs of filters with and of filters without suppression, and each filter with and without it; *a < b* says "
        "that the thesis has a below b.\n\n" + markdown_table(header, lines, words=(0, 1, 2, 4, 5))
    )


def _pairs(rows: Rows) -> str:
    return ", ".join(f"{_short(row['worse'])} < {_short(row['better'])}" for row in rows) or "–"


def _short(name: str) -> str:
    """`jcf+s` for `jcf+suppression`."""
    return name.replace(SUPPRESSION, "+s")


def _worlds(rows: Rows) -> str:
    header = (
        "world",
        "filter",
        "accuracy",
        "MES/S",
        "Brier score",
        "precision",
        "recall",
        "delay, mean [looks]",
        "delay, 95 % [looks]",
        "never removed",
        "calibration error",
    )
    lines = [
        (
            row["world"],
            f"`{row['filter']}`",
            _value(row, "accuracy"),
            _value(row, "survival_ratio"),
            _value(row, "brier", "{:.4f}"),
            number("{:.3f}", row["precision"]),
            number("{:.3f}", row["recall"]),
            _value(row, "delay_mean", "{:.1f}"),
            number("{:.0f}", row["delay_p95"]),
            f"{row['never_removed']:.0f} of {row['vanished']:.0f}",
            number("{:.3f}", row["calibration_error"]),
        )
        for row in rows
    ]
    return markdown_table(header, lines, words=(0, 1))


def _sweep(table: Mapping[str, Any]) -> str:
    """From the least to the largest value of each score over the values of each parameter."""
    rows, settings = table["sweep"], table["settings"]
    runs = min(settings["sweep_runs"], settings["runs"])
    parts = [f"Range of each score while one parameter takes the values listed and all else stays; {runs} runs."]
    filters = _distinct(rows, "filter")
    for sensor in _distinct(rows, "sensor"):
        for metric in COMPARED:
            lines = []
            for section, parameter in dict.fromkeys((row["section"], row["parameter"]) for row in rows):
                own = [
                    row
                    for row in rows
                    if (row["sensor"], row["section"], row["parameter"]) == (sensor, section, parameter)
                ]
                cells = [_range([row[metric] for row in own if row["filter"] == name]) for name in filters]
                values = ", ".join(f"{value:g}" for value in _distinct(own, "value"))
                lines.append((f"{title(section, parameter)}: {values}", *cells))
            parts.append(markdown_table((f"{sensor}, {NAMES[metric]}", *map(_short, filters)), lines))
    return "\n\n".join(parts)


def title(section: str, parameter: str) -> str:
    """A parameter of the sweep in the thesis' letters."""
    return {
        ("world", "viewing_angle_deg"): "viewing angle [°]",
        ("world", "fading_m"): "λ [m]",
        ("world", "p_false"): "the world's P_F",
        ("world", "mean_survival_steps"): "mean survival [steps]",
        ("filters", "p_miss"): "P_M",
        ("filters", "p_false"): "P_F",
        ("filters", "prior_mean_steps"): "prior's mean [steps]",
        ("filters", "observed_m"): "s_obs [m]",
        ("filters", "suppression_share"): "δ",
        ("filters", "rho_high"): "ρ_h",
        ("filters", "rho_low"): "ρ_l",
    }.get((section, parameter), parameter)


def _range(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "–"
    low, high = f"{min(known):.3f}", f"{max(known):.3f}"
    return low if low == high else f"{low}–{high}"
