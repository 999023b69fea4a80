"""The experiment for people: promises, figures 6 to 11 as tables, changes during a run, and all kinds of changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from evermap.metrics.belief import belief_scores
from evermap_studies.markdown import markdown_table, number
from evermap_studies.nielsen2024.expected import Row, Rows, chosen, complete, distinct, mean, verdicts, weights
from evermap_studies.nielsen2024.plan import GROUP, MANY_DATASET, MANY_SCENARIO, WINDOW_DATASET, WINDOW_SCENARIO
from evermap_studies.rows import sources

SELECTORS = ("nn", "em", "mcts", "viterbi")
PARTLY_TRUE = 3
"""Data set of whose true poses a part is known."""
SENSOR_TITLES = {"ours": "our sensor model", "paper": "the paper's sensor model and limits"}


def as_markdown(table: Mapping[str, Any]) -> str:
    """The whole table as Markdown; no trailing line end."""
    simulation, runs = table["simulation"], table["runs"]
    parts = [_expected(table["expected"]), _machine(table)]
    if simulation:
        parts += ["### Simulation (figures 6 and 7)", sources(simulation)]
        parts += [_wrong_modes(simulation), _errors(simulation), _costs(simulation), _budgets(simulation)]
    compared = chosen(runs, part="recordings", scenario="group")
    for dataset in distinct(compared, "dataset"):
        of_dataset = chosen(compared, dataset=dataset)
        parts += [f"### Dataset {dataset}: the map's group displaced (figure 9)", sources(of_dataset)]
        for sensor, title in SENSOR_TITLES.items():
            rows = chosen(of_dataset, sensor=sensor)
            if rows:
                parts += [f"Position / landmark error [m], mean of {_robots(rows)}, {title}:"]
                parts += [_by_delta(rows, "method", _both)]
        own = chosen(of_dataset, sensor="ours")
        if own:
            parts += ["Position error while landmarks were in view [m], our sensor model:"]
            parts += [_by_delta(own, "method", _mean_of("pose_seen_rmse_m"))]
        if own and dataset == PARTLY_TRUE:
            parts += ["Position error against the true poses of the last 466 s [m], our sensor model:"]
            parts += [_by_delta(own, "method", _mean_of("pose_true_rmse_m"))]
        joint = chosen(own, method="joint")
        if joint:
            parts += ["Joint search, what was found:", _by_delta(joint, "method", _exact_of)]
    many = complete(chosen(runs, part="recordings", scenario=MANY_SCENARIO))
    if many:
        parts += [f"### Dataset {MANY_DATASET}, many modes (figures 10 and 11)", sources(many), *_many_modes(many)]
    whole = complete(chosen(runs, part="recordings", scenario=WINDOW_SCENARIO))
    if whole:
        parts += [f"### Dataset {WINDOW_DATASET}, tree search with and without the window of 40 s (section 8.3)"]
        parts += [sources(whole), *_windows(whole, compared)]
    if compared:
        parts += ["### Execution time", sources(compared), _times(compared)]
    during = chosen(runs, part="during")
    if during:
        parts += ["### The group moves at half time", sources(during), _during(during)]
    search = chosen(runs, part="search")
    if search:
        parts += ["### Changes of other kinds, joint search", sources(search), _search(search), _reliability(runs)]
    return "\n\n".join(part for part in parts if part)


def _many_modes(rows: Rows) -> list[str]:
    """Errors, times and places by method, figures 10 and 11."""
    moved = set(GROUP[MANY_DATASET])

    def places(of_moved: bool) -> Callable[[Rows], str]:
        return lambda own: number("{:.1f}", _mean_places(own, moved, of_moved))

    return [
        f"Position / landmark error [m], mean of {_robots(rows)}:",
        _by_delta(rows, "method", _both),
        "Seconds a recording:",
        _by_delta(rows, "method", _mean_of("cpu_s", "{:.1f}")),
        "Landmarks that did not move, places made for them, mean of a recording (right: 0):",
        _by_delta(rows, "method", places(False)),
        f"The {len(moved)} landmarks that moved, places beside the first (right: {len(moved)} from 0.1 m on):",
        _by_delta(rows, "method", places(True)),
    ]


def _mean_places(rows: Rows, moved: set[int], of_moved: bool) -> float | None:
    """Return how many places beside one each landmark was given, in sum, mean of the runs; None of no runs."""
    extra = 0
    for row in rows:
        own = [place["landmark"] for place in row["places"] if (place["landmark"] in moved) == of_moved]
        extra += len(own) - len(set(own))
    return extra / len(rows) if rows else None


def _windows(whole: Rows, compared: Rows) -> list[str]:
    """Errors and times of the tree search with its window and without, the same recordings and displacements."""
    pairs = {(row["robot"], row["delta_m"]) for row in whole}
    windowed = [
        row
        for row in chosen(compared, dataset=WINDOW_DATASET, sensor="paper", method="mcts")
        if (row["robot"], row["delta_m"]) in pairs
    ]
    rows = [{**row, "method": name} for name, some in (("40 s", windowed), ("none", whole)) for row in some]
    return [
        f"Position / landmark error [m], mean of {_robots(rows)}, the paper's sensor model and limits:",
        _by_delta(rows, "method", _both),
        "Seconds a recording:",
        _by_delta(rows, "method", _mean_of("cpu_s", "{:.1f}")),
    ]


def _expected(rows: Sequence[Row]) -> str:
    lines = []
    for row in rows:
        bound = f"≤ {row['at_most']:g}" if "at_most" in row else f"≥ {row['at_least']:g}"
        form = {"m": "{:.3f}", "share": "{:.2f}", "1": "{:.3g}"}.get(row["unit"], "{:.0f}")
        unit = "" if row["unit"] in {"1", "share"} else f" {row['unit'].replace('x', '×')}"
        met = "–" if row["met"] is None else "yes" if row["met"] else "**no**"
        lines.append((row["what"], f"{bound}{unit}", f"{number(form, row['measured'])}{unit}", met))
    return markdown_table(("", "expected", "measured", "met"), lines)


def _machine(table: Mapping[str, Any]) -> str:
    machine, settings = table["machine"], table["settings"]
    return (
        f"evermap {table['evermap']}, Python {machine['versions']['python']}, {machine['processor']}, seed "
        f"{settings['seed']}; times are processor times, runs {settings['processes']} at a time."
    )


def _wrong_modes(simulation: Rows) -> str:
    rows = chosen(simulation, figure="6")
    lines = []
    for noise in distinct(rows, "noise_m2"):
        cells = [_with_error(_one(rows, noise, name), "wrong_share", "{:.4f}") for name in SELECTORS]
        lines.append((f"{noise:g}", *cells))
    head = ("r [m²]", *(f"{name}, wrong modes" for name in SELECTORS))
    return markdown_table(head, lines)


def _errors(simulation: Rows) -> str:
    rows = chosen(simulation, figure="7")
    lines = []
    for noise in distinct(rows, "noise_m2"):
        cells = [_with_error(_one(rows, noise, name), "rmse_m", "{:.3f}") for name in SELECTORS]
        lines.append((f"{noise:g}", *cells))
    return markdown_table(("r [m²]", *(f"{name}, error [m]" for name in SELECTORS)), lines)


def _costs(simulation: Rows) -> str:
    rows = chosen(simulation, figure="6")
    lines = []
    for name in SELECTORS:
        own = chosen(rows, selector=name)
        total = sum(row["runs"] for row in own)
        times = mean(own, "us_a_sequence")
        lines.append(
            (
                name,
                number("{:.1f}", times),
                f"{sum(row['above_viterbi'] for row in own)} of {total}",
                f"{sum(row['same_as_viterbi'] for row in own)} of {total}",
            )
        )
    return markdown_table(("selector", "µs a sequence", "objective above viterbi's", "equal to viterbi's"), lines)


def _budgets(simulation: Rows) -> str:
    rows = chosen(simulation, figure="budget")
    lines = [
        (
            row["selector"] if row["budget"] is None else f"{row['selector']}, {row['budget']} iterations a decision",
            number("{:.1f}", row["us_a_sequence"]),
            f"{row['same_as_viterbi']} of {row['runs']}",
            _with_error(row, "below_viterbi", "{:.3f}"),
            _with_error(row, "wrong_share", "{:.4f}"),
        )
        for row in rows
    ]
    head = ("r = 0.2 m²", "µs a sequence", "equal to viterbi's", "objective below viterbi's [nats]", "wrong modes")
    return markdown_table(head, lines)


def _by_delta(rows: Rows, key: str, cell: Callable[[Rows], str]) -> str:
    deltas = distinct(rows, "delta_m")
    lines = [
        (str(value), *(cell(chosen(rows, delta_m=delta, **{key: value})) for delta in deltas))
        for value in distinct(rows, key)
    ]
    return markdown_table((key, *(f"{delta:g} m" for delta in deltas)), lines)


def _both(rows: Rows) -> str:
    """`0.043 / 0.011`, and of how many robots if not of all."""
    placed = chosen(rows, placed=True)
    text = f"{number('{:.3f}', mean(placed, 'pose_rmse_m'))} / {number('{:.3f}', mean(placed, 'landmark_rmse_m'))}"
    return text if len(placed) == len(rows) else f"{text} ({len(placed)} of {len(rows)})"


def _mean_of(key: str, form: str = "{:.3f}") -> Callable[[Rows], str]:
    return lambda rows: number(form, mean(rows, key))


def _exact_of(rows: Rows) -> str:
    ambiguous = sum(not row["exact"] and row["truth_rank"] is not None for row in rows)
    more = f", {ambiguous} ambiguous" if ambiguous else ""
    return f"{sum(row['exact'] for row in rows)} of {len(rows)}{more}"


def _times(rows: Rows) -> str:
    lines = []
    for method in distinct(rows, "method"):
        for sensor in SENSOR_TITLES:
            cells = [_time_of(chosen(rows, method=method, sensor=sensor, dataset=dataset)) for dataset in (1, 2, 3, 6)]
            lines.append((method, sensor, *cells))
    return "Seconds a recording (frames a second, times real time), means:\n\n" + markdown_table(
        ("method", "sensor", *(f"dataset {dataset}" for dataset in (1, 2, 3, 6))), lines
    )


def _time_of(rows: Rows) -> str:
    rows = [row for row in rows if row["cpu_s"] is not None]
    if not rows:
        return "–"
    seconds = sum(row["cpu_s"] for row in rows)
    fps, factor = (sum(row[key] for row in rows) / seconds for key in ("frames", "recording_s"))
    return f"{seconds / len(rows):.1f} ({fps:.0f}, {factor:.0f}×)"


def _during(rows: Rows) -> str:
    lines = []
    for dataset in distinct(rows, "dataset"):
        for delta in distinct(rows, "delta_m"):
            for method in distinct(rows, "method"):
                own = chosen(rows, dataset=dataset, delta_m=delta, method=method)
                joint = method == "joint"
                lines.append(
                    (
                        f"{dataset}",
                        f"{delta:g}",
                        method,
                        _both(own),
                        _exact_of(own) if joint else "–",
                        number("{:.1f}", mean(own, "time_off_window_s")) if joint else "–",
                        number("{:.1f}", mean(own, "time_off_interval_s")) if joint else "–",
                    )
                )
    head = ("dataset", "δ [m]", "method", "position / landmark error [m]", "exact set",
            "middle outside of the open window [s]", "true time outside of the interval [s]")  # fmt: skip
    return markdown_table(head, lines)


def _search(rows: Rows) -> str:
    lines = []
    for scenario in distinct([{**row, "scenario": _scenario(row)} for row in rows], "scenario"):
        for dataset in distinct(rows, "dataset"):
            own = [row for row in rows if _scenario(row) == scenario and row["dataset"] == dataset]
            if own:
                name = f"{dataset}" if dataset else "building"
                lines.append(
                    (
                        scenario,
                        name,
                        _exact_of(own),
                        _both(own),
                        number("{:.3f}", mean(own, "displacement_error_m")),
                    )
                )
    return markdown_table(
        ("scenario", "dataset", "exact", "position / landmark error [m]", "displacement error [m]"), lines
    )


def _scenario(row: Row) -> str:
    return "random" if row["scenario"].startswith("random") else str(row["scenario"])


def _reliability(runs: Rows) -> str:
    said, right = weights(runs)
    if not said:
        return "No change was reported of a random draw."
    scores = belief_scores(said, [float(value) for value in right])
    return (
        f"Probabilities of {len(said)} reported changes: {sum(right)} right; Brier {scores.brier:.3f}, log loss "
        f"{scores.log_loss:.3f}, calibration error {scores.calibration_error:.3f}."
    )


def _with_error(row: Row, key: str, form: str) -> str:
    return f"{form.format(row[key])} ± {form.format(row[f'{key}_se'])}"


def _one(rows: Rows, noise: float, selector: str) -> Row:
    (row,) = chosen(rows, noise_m2=noise, selector=selector)
    return row


def _robots(rows: Rows) -> str:
    count = len(distinct(rows, "robot"))
    return f"{count} robots" if count > 1 else "one robot"


__all__ = ["as_markdown", "verdicts"]
