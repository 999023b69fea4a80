"""The experiment as Markdown: Table 5.1, its orderings, harsher worlds, and what the hidden parameters do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from evermap_studies.bateman2020.published import LIMIT, THESIS, TRIAL
from evermap_studies.bateman2020.scores import COMPARED, OWN, Row
from evermap_studies.bateman2020.settings import IN_THE_TABLE, LEARNED, OTHER_READINGS, READINGS, SUPPRESSION
from evermap_studies.markdown import markdown_table, number

Rows = Sequence[Row]

NAMES = {
    "accuracy": "accuracy",
    "survival_ratio": "MES/S",
    "brier": "Brier score",
    "delay_mean": "mean delay [looks]",
}
_FORMS_OF_PROMISES = {"accuracy": "{:.4f}", "brier": "{:.4f}", "delay_mean": "{:.1f}"}


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
        own = [row for row in rows if row["sensor"] == sensor]
        parts += [f"### All worlds, {sensor}", _worlds(own), _decisions(table), _worlds(own, OWN)]
    if table["sweep"]:
        parts += ["### What the parameters do that the thesis does not tell", _sweep(table)]
    return "\n\n".join(parts)


def _distinct(rows: Rows, key: str) -> list[Any]:
    return list(dict.fromkeys(row[key] for row in rows))


def _expected(rows: Rows) -> str:
    columns = list(rows[0]["measured"])
    lines = []
    for row in rows:
        form = _FORMS_OF_PROMISES.get(row["metric"], "{:.3f}")
        bound = f"≤ {row['at_most']:g}" if "at_most" in row else f"≥ {row['at_least']:g}"
        cells = [
            number(form, row["measured"][column]) + (" **no**" if row["met"][column] is False else "")
            for column in columns
        ]
        lines.append((f"{row['world']}, {row['sensor']}: {NAMES[row['metric']]}", bound, *cells))
    return markdown_table(("", "expected", *columns), lines)


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


def _decisions(table: Mapping[str, Any]) -> str:
    assumed = table["settings"]["filters"]
    high, low = assumed["own_rho_high"], assumed["own_rho_low"]
    return f"The same beliefs taken for what they say: used from {high:g} on, removed below {low:g}."


_FORM_OF_SCORE = {
    "accuracy": ("accuracy", "{:.3f}"),
    "survival_ratio": ("MES/S", "{:.3f}"),
    "brier": ("Brier score", "{:.4f}"),
    "precision": ("precision", "{:.3f}"),
    "recall": ("recall", "{:.3f}"),
    "delay_mean": ("delay, mean [looks]", "{:.1f}"),
    "delay_p95": ("delay, 95 % [looks]", "{:.0f}"),
}
_WITH_ERROR = ("accuracy", "survival_ratio", "brier", "delay_mean")


def _worlds(rows: Rows, decisions: str = "") -> str:
    """All scores by the thesis' decisions, or those that depend on them by the own ones."""
    scores = {name: form for name, form in _FORM_OF_SCORE.items() if not decisions or name != "brier"}
    lines = []
    for row in rows:
        cells = []
        for name, (_, form) in scores.items():
            cells.append((_value if name in _WITH_ERROR else _plain)(row, decisions + name, form))
        cells.append(f"{row[f'{decisions}never_removed']:.0f} of {row[f'{decisions}vanished']:.0f}")
        if not decisions:
            cells.append(number("{:.3f}", row["calibration_error"]))
        lines.append((row["world"], f"`{row['filter']}`", *cells))
    header = ["world", "filter", *(title for title, _ in scores.values()), "never removed"]
    return markdown_table((*header, *([] if decisions else ["calibration error"])), lines, words=(0, 1))


def _plain(row: Row, metric: str, form: str) -> str:
    return number(form, row[metric])


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
