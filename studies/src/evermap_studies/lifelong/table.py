"""The tables of the living map as Markdown, and what was expected beside what came out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from evermap_studies.lifelong.runs import ABLATIONS, CONTENDERS, WHOLE
from evermap_studies.lifelong.scores import KINDS, change_counts
from evermap_studies.markdown import markdown_table, number
from evermap_studies.worlds.scores import Existence

Row = dict[str, Any]

FLAT = 1.2
"""What is flat grows by less than this factor from the first fifth of a long life to the last."""
FIFTHS = 5


def as_markdown(table: Mapping[str, Any]) -> str:
    """All tables of what was run; no trailing line end."""
    rows = table["rows"]
    parts = [_expected(table["expected"])]
    if few := [row for row in rows if row["part"] == "five"]:
        parts += [
            "### Five robots, one map",
            summary(few, CONTENDER_NAMES),
            changes(few, CONTENDER_NAMES),
            by_session(few),
        ]
    if many := [row for row in rows if row["part"] == "fifty"]:
        parts += ["### Fifty sessions", fifths(many)]
    for part, title in (("recorded", "recordings"), ("simulated", "simulated building")):
        if some := [row for row in rows if row["part"] == f"ablation-{part}"]:
            parts += [f"### Without one part: {title}", summary(some, ABLATION_NAMES), differences(some)]
    return "\n\n".join(parts)


CONTENDER_NAMES = tuple(contender.name for contender in CONTENDERS)
ABLATION_NAMES = tuple(contender.name for contender in ABLATIONS)
TOLD = tuple(contender.name for contender in CONTENDERS if contender.is_told)
SAYS = {contender.name: contender.says for contender in (*CONTENDERS, *ABLATIONS)}


def rms(rows: Iterable[Row], key: str) -> float | None:
    """Root mean square over sessions; None where nothing is known."""
    values = [row[key] for row in rows if row[key] is not None]
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def existence(rows: Iterable[Row]) -> Existence:
    """Counts of many sessions together."""
    return _sum(rows, "existence")


def forecast(rows: Iterable[Row]) -> Existence:
    """Statements about the next session."""
    return _sum(rows, "forecast")


def _sum(rows: Iterable[Row], key: str) -> Existence:
    return sum((Existence(**row[key]) for row in rows if row[key] is not None), start=Existence())


MEASURES: tuple[tuple[str, str, Callable[[list[Row]], float | None]], ...] = (
    ("pose [m]", "{:.3f}", lambda rows: rms(rows, "pose_rmse_m")),
    ("pose, own alignment [m]", "{:.3f}", lambda rows: rms(rows, "pose_own_rmse_m")),
    ("landmarks [m]", "{:.3f}", lambda rows: rms(rows, "landmark_rmse_m")),
    ("precision", "{:.3f}", lambda rows: existence(rows).precision),
    ("recall", "{:.3f}", lambda rows: existence(rows).recall),
    ("Brier", "{:.4f}", lambda rows: existence(rows).brier),
    ("forecast, Brier", "{:.4f}", lambda rows: forecast(rows).brier),
    ("changes: precision", "{:.2f}", lambda rows: change_counts(rows).precision),
    ("changes: recall", "{:.2f}", lambda rows: change_counts(rows).recall),
)
"""Title, format and value of what is scored; the value is None where nothing is known."""


def measures(name: str) -> tuple[tuple[str, str, Callable[[list[Row]], float | None]], ...]:
    """`MEASURES`; nobody finds changes of which he is told."""
    return tuple(
        (title, form, (lambda _: None) if name in TOLD and title.startswith("changes") else value)
        for title, form, value in MEASURES
    )


def spread(rows: Sequence[Row], value: Callable[[list[Row]], float | None]) -> tuple[float | None, float | None]:
    """Mean over seeds, and its standard error; None where there is none."""
    each = [value([row for row in rows if row["seed"] == seed]) for seed in sorted({row["seed"] for row in rows})]
    known = [one for one in each if one is not None]
    if not known:
        return None, None
    error = float(np.std(known, ddof=1) / np.sqrt(len(known))) if len(known) > 1 else None
    return float(np.mean(known)), error


def summary(rows: list[Row], names: Sequence[str]) -> str:
    """One line a contender: means over seeds, with their standard errors."""
    lines = []
    for name in names:
        mine = _of(rows, name)
        if mine:
            lost = sum(not row["placed"] for row in mine)
            cells = [_with_error(form, *spread(mine, value)) for _, form, value in measures(name)]
            lines.append((_bold(name), SAYS[name], *cells, str(lost)))
    return markdown_table(("", "", *(title for title, _, _ in MEASURES), "not placed"), lines, words=(0, 1))


def changes(rows: list[Row], names: Sequence[str]) -> str:
    """Changes of landmarks by kind; the oracle is told them and finds none."""
    kinds = ("all", *(kind.value for kind in KINDS))
    lines = []
    for name in names:
        counts = [change_counts(_of(rows, name), kind) for kind in kinds]
        if _of(rows, name) and name not in TOLD:
            lines.append((_bold(name), *(f"{c.n_right} / {c.n_found} / {c.n_true}" for c in counts)))
    return "Landmarks that changed, right / found / true:\n\n" + markdown_table(("", *kinds), lines)


def by_session(rows: list[Row]) -> str:
    """Pose and landmark errors, session by session."""
    sessions = sorted({row["session"] for row in rows})
    lines = []
    for name in CONTENDER_NAMES:
        mine = _of(rows, name)
        if mine:
            cells = [
                " / ".join(number("{:.3f}", rms(own, key)) for key in ("pose_rmse_m", "landmark_rmse_m"))
                for own in ([row for row in mine if row["session"] == session] for session in sessions)
            ]
            lines.append((_bold(name), *cells))
    head = ("pose / landmarks [m]", *(f"session {session + 1}" for session in sessions))
    return markdown_table(head, lines)


def fifths(rows: list[Row]) -> str:
    """A long life in five parts."""
    lines = []
    for name in CONTENDER_NAMES:
        for k, part in enumerate(_parts(_of(rows, name))):
            sessions = sorted({row["session"] + 1 for row in part})
            step_ms, cpu_s, sites = (_median(part, key) for key in ("step_p99_ms", "cpu_s", "sites"))
            lines.append(
                (
                    _bold(name) if k == 0 else "",
                    f"{sessions[0]} to {sessions[-1]}",
                    *(number(form, value(part)) for _, form, value in measures(name)),
                    number("{:.0f}", sites),
                    number("{:.2f}", cpu_s),
                    number("{:.2f}", step_ms),
                    str(sum(not row["placed"] for row in part)),
                )
            )
    head = ("", "sessions", *(title for title, _, _ in MEASURES), "sites", "time a session [s]", "step, p99 [ms]",
            "not placed")  # fmt: skip
    return markdown_table(head, lines, words=(0, 1))


def differences(rows: list[Row]) -> str:
    """What each part contributes: without it minus with all, seed by seed."""
    whole = _of(rows, WHOLE.name)
    lines = []
    for name in ABLATION_NAMES[1:]:
        mine = _of(rows, name)
        if mine:
            cells = [
                _with_error(form.replace(":", ":+"), *_difference(mine, whole, value)) for _, form, value in MEASURES
            ]
            lines.append((name, *cells))
    return "Without the part minus with all, seed by seed:\n\n" + markdown_table(
        ("", *(title for title, _, _ in MEASURES)), lines
    )


def verdicts(rows: list[Row]) -> list[Row]:
    """What was expected, and what came out; `met` is None where nothing was run."""
    few = [row for row in rows if row["part"] == "five"]
    ours, told, static = (_of(few, name) for name in (WHOLE.name, CONTENDER_NAMES[-1], CONTENDER_NAMES[0]))
    mine, best, worst = (rms(some, "pose_rmse_m") for some in (ours, told, static))
    long = _parts(_of([row for row in rows if row["part"] == "fifty"], WHOLE.name))

    def growth(measure: Callable[[list[Row]], float | None], since: int = 0) -> float | None:
        return _ratio(measure(long[-1]), measure(long[since])) if long else None

    error, step_ms, time_s, places = (
        growth(lambda part: rms(part, "pose_rmse_m")),
        growth(lambda part: _median(part, "step_p99_ms")),
        growth(lambda part: _median(part, "cpu_s")),
        growth(lambda part: _median(part, "places"), since=-2),
    )
    return [
        _verdict("pose RMSE of evermap over the oracle's, five sessions", _ratio(mine, best), "≤", 1.15),
        _verdict("pose RMSE of static SLAM over that of evermap, five sessions", _ratio(worst, mine), "≥", 1.0),
        _verdict("precision of the map, five sessions", existence(ours).precision, "≥", 0.98),
        _verdict("recall of the map, five sessions", existence(ours).recall, "≥", 0.98),
        _verdict("pose RMSE, last fifth of a long life over the first", error, "≤", FLAT),
        _verdict("places in the map, last fifth over the fourth", places, "≤", FLAT),
        _verdict("time of a session, last fifth over the first", time_s, "≤", FLAT),
        _verdict("99th percentile of a step, last fifth over the first", step_ms, "≤", FLAT),
    ]


def _verdict(what: str, value: float | None, sign: str, limit: float) -> Row:
    met = None if value is None else (value <= limit if sign == "≤" else value >= limit)
    return {"what": what, "sign": sign, "limit": limit, "measured": value, "met": met}


def _expected(expected: Sequence[Row]) -> str:
    lines = [
        (
            row["what"],
            f"{row['sign']} {row['limit']:g}",
            number("{:.3f}", row["measured"]),
            {True: "yes", False: "**no**", None: "–"}[row["met"]],
        )
        for row in expected
    ]
    return markdown_table(("", "expected", "measured", "met"), lines)


def _difference(
    mine: Sequence[Row], whole: Sequence[Row], value: Callable[[list[Row]], float | None]
) -> tuple[float | None, float | None]:
    """Mean difference over seeds, and its standard error; pairs share all that is random."""
    pairs = [
        tuple(value([row for row in rows if row["seed"] == seed]) for rows in (mine, whole))
        for seed in sorted({row["seed"] for row in mine} & {row["seed"] for row in whole})
    ]
    known = [a - b for a, b in pairs if a is not None and b is not None]
    if not known:
        return None, None
    error = float(np.std(known, ddof=1) / np.sqrt(len(known))) if len(known) > 1 else None
    return float(np.mean(known)), error


def _parts(rows: list[Row]) -> list[list[Row]]:
    """A long life in five equal parts; none of nothing."""
    count = 1 + max((row["session"] for row in rows), default=-1)
    return [[row for row in rows if row["session"] * FIFTHS // count == k] for k in range(FIFTHS)] if count else []


def _of(rows: Sequence[Row], name: str) -> list[Row]:
    return [row for row in rows if row["contender"] == name]


def _median(rows: list[Row], key: str) -> float | None:
    values = [row[key] for row in rows if row[key] is not None]
    return float(np.median(values)) if values else None


def _ratio(value: float | None, by: float | None) -> float | None:
    return value / by if value is not None and by else None


def _with_error(form: str, value: float | None, error: float | None) -> str:
    if error is None:
        return number(form, value)
    return f"{number(form, value)} ± {form.replace('+', '').format(error)}"


def _bold(name: str) -> str:
    return f"**{name}**" if name == WHOLE.name else name
