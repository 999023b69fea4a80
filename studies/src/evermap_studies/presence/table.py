"""The comparison for people: what was expected of the default models, and every contender in Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from evermap_studies.markdown import markdown_table
from evermap_studies.presence.tasks import TASKS

Row = Mapping[str, Any]

PUBLISHED = [
    {"label": "Perpetua, exponential", "mae": 0.0148, "accuracy": 0.9919, "brier": 0.0070, "semi_mae": 0.0297,
     "semi_brier": 0.0141},
    {"label": "Perpetua, log-normal", "mae": 0.0115, "accuracy": 0.9903, "brier": 0.0084, "semi_mae": 0.0229,
     "semi_brier": 0.0169},
]  # fmt: skip
"""Of Perpetua (2025) on the same recording, by its authors' own script, scored in the same way; not computed here."""

ROOM_TARGETS = (
    ("all", "mae", "MAE", "≤", 0.0105),
    ("all", "accuracy", "accuracy", "≥", 0.9940),
    ("all", "brier", "Brier", "≤", 0.0050),
    ("semi_static", "brier", "Brier, those that leave", "≤", 0.0100),
)
DOOR_TARGETS = {"a": (0.058, 0.172), "b": (0.048, 0.150), "c": (0.055, 0.167)}
"""Brier score and log loss of each task."""
CALIBRATION_TARGET = 0.02
_SMALLEST = 5e-5
"""Errors below this would be written as 0."""


def judged(room: Sequence[Row], door: Sequence[Row]) -> list[dict[str, Any]]:
    """What was expected of the default models, what was measured, and whether that is met.

    Args:
        room: rows of the room.
        door: rows of the door.
    """
    ours = next(row for row in room if row["default"])
    asked: list[tuple[str, str, float, float | None]] = [
        (f"room: {title}", sign, limit, (ours[which] or {}).get(name))
        for which, name, title, sign, limit in ROOM_TARGETS
    ]
    for task in TASKS:
        mine = next(row for row in door if row["default"] and row["task"] == task.name)
        limits = (*DOOR_TARGETS[task.name], CALIBRATION_TARGET)
        for name, title, limit in zip(
            ("brier", "log_loss", "calibration_error"), ("Brier", "log loss", "calibration error"), limits, strict=True
        ):
            asked.append((f"door ({task.name}) {task.title}: {title}", "≤", limit, mine[name]))
    return [
        {
            "what": what,
            "sign": sign,
            "limit": limit,
            "measured": measured,
            "met": measured is not None and (measured <= limit if sign == "≤" else measured >= limit),
        }
        for what, sign, limit, measured in asked
    ]


def as_markdown(table: Mapping[str, Any]) -> str:
    """The whole table as Markdown; no trailing line end."""
    settings = table["settings"]
    made = (
        f"All of it in {table['processing_s']:.0f} s, seed {settings['seed']}. Beliefs are kept "
        f"{settings['clipped_at']:g} from 0 and 1. Tasks (b) and (c): means over {settings['noise_seeds']} drawings of "
        "the detector's errors, ± the standard error that these leave."
    )
    parts = [
        _targets(table["targets"]),
        made,
        "### Room: eight landmarks, three hours",
        _room(table["room"], table["published"]),
    ]
    for task in TASKS:
        parts.append(f"### Door, ({task.name}) {task.title}")
        parts.append(_door([row for row in table["door"] if row["task"] == task.name]))
    if table["home"]:
        parts.append("### Once more: which room a person is in")
        parts.append(_home(table["home"]))
    return "\n\n".join(parts)


def _targets(targets: Sequence[Row]) -> str:
    lines = (
        [
            row["what"],
            f"{row['sign']} {row['limit']:.4g}",
            _number(row["measured"], 5),
            "yes" if row["met"] else "**no**",
        ]
        for row in targets
    )
    return markdown_table(("default models", "expected", "measured", "met"), lines)


def _room(rows: Sequence[Row], published: Sequence[Row]) -> str:
    header = (
        "contender", "MAE", "accuracy", "F1", "balanced accuracy", "Brier", "log loss", "MAE, those that leave",
        "Brier, those that leave", "log loss, those that leave", "chosen for each landmark",
    )  # fmt: skip
    lines = []
    for row in rows:
        every, leaving = row["all"], row["semi_static"] or {}
        numbers = [every[name] for name in ("mae", "accuracy", "f1", "balanced_accuracy", "brier", "log_loss")]
        numbers += [leaving.get(name) for name in ("mae", "brier", "log_loss")]
        lines.append([_label(row), *map(_number, numbers), _chosen(row["chosen"])])
    for row in published:
        names = ("mae", "accuracy", None, None, "brier", None, "semi_mae", "semi_brier", None)
        lines.append([f"*{row['label']} (published)*", *(_number(row[n] if n else None) for n in names), "–"])
    return markdown_table(header, lines, words=(0, len(header) - 1))


def _door(rows: Sequence[Row]) -> str:
    header = (
        "contender",
        "Brier",
        "log loss",
        "calibration error",
        "MAE",
        "balanced accuracy",
        "chosen inside `train`",
    )
    lines = [
        [
            _label(row),
            _with_error(row["brier"], row["brier_se"]),
            _with_error(row["log_loss"], row["log_loss_se"]),
            *(_number(row[name]) for name in ("calibration_error", "mae", "balanced_accuracy")),
            row["chosen"],
        ]
        for row in rows
    ]
    return markdown_table(header, lines, words=(0, len(header) - 1))


def _home(rows: Sequence[Row]) -> str:
    names = ("brier", "log_loss", "calibration_error", "mae", "balanced_accuracy")
    lines = [
        [f"({row['task']})", _label(row), *(_number(row[name]) for name in names), str(len(row["rooms"]))]
        for row in rows
    ]
    header = ("task", "contender", "Brier", "log loss", "calibration error", "MAE", "balanced accuracy", "rooms")
    return markdown_table(header, sorted(lines, key=lambda line: line[0]), words=(0, 1))


def _label(row: Row) -> str:
    return f"**{row['label']}**" if row["default"] else str(row["label"])


def _chosen(said: Sequence[str]) -> str:
    """What was chosen, and for which landmarks."""
    where: dict[str, list[str]] = {}
    for landmark, choice in enumerate(said):
        where.setdefault(choice, []).append(str(landmark))
    if len(where) == 1:
        return said[0]
    return "; ".join(f"{choice} ({', '.join(landmarks)})" for choice, landmarks in where.items())


def _number(value: float | None, digits: int = 4) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _with_error(value: float | None, error: float | None) -> str:
    return f"{_number(value)} ± {error:.4f}" if error and error >= _SMALLEST else _number(value)
