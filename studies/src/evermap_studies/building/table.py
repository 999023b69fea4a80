"""The tables of `evermap reproduce building`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from evermap_studies.markdown import markdown_table, number

Row = Mapping[str, Any]
EDGES = np.linspace(0.0, 1.0, 11)
UNCHANGED = "nothing changes"
"""Name of a run of evermap in the same building, where all stays as it is on the first day."""
FLOOR = 1e-4
"""Probabilities are taken to be this far from 0 and 1 at least in the log loss."""


def of_method(content: Mapping[str, Any], method: str) -> list[Row]:
    """Runs of one method."""
    return [run for run in content["runs"] if run["method"] == method]


def summary(runs: Sequence[Row]) -> dict[str, Any]:
    """Numbers of some runs; None where nothing was counted."""
    told, changes, sessions, stated, forecast = (
        [row for run in runs for row in run[key]] for key in ("told", "changes", "sessions", "statements", "forecasts")
    )
    sure = [right for p, right in stated if p >= 0.9]
    located = [row for row in sessions if row["found"]]
    errors = [row["error_m"] for row in told if row["error_m"] is not None and row["true"]]
    n_errors = max(sum(row["n_errors"] for row in sessions), 1)
    happened = _mean([right for _, right in forecast])
    ratio = [row["pose_m"] / row["oracle_pose_m"] for row in located if "oracle_pose_m" in row]
    return {
        "sessions": len(sessions),
        "lost": len(sessions) - len(located),
        "told": len(told),
        "false": sum(not row["true"] for row in told),
        "never": sum(row["never"] for row in told),
        "never_sure": sum(row["never"] and row["p"] > 0.99 for row in told),
        "unseen": sum(row["looks"] == 0 for row in told),
        "told_brier": _mean([(row["p"] - row["true"]) ** 2 for row in told]),
        "precision": _mean([row["true"] for row in told]),
        "recall": _mean([row["told"] for row in changes]),
        "at_once": _mean([row["at_once"] for row in changes]),
        "n_changes": len(changes),
        "brier": _mean([(p - right) ** 2 for p, right in stated]),
        "log_loss": _log_loss(stated),
        "sure_right": _mean(sure),
        "forecast_brier": _mean([(p - right) ** 2 for p, right in forecast]),
        "constant_brier": None if happened is None else happened * (1.0 - happened),
        "displacement_m": float(np.median(errors)) if errors else None,
        "landmark_m": float(np.sqrt(sum(row["squared_m2"] for row in sessions) / n_errors)),
        "nees": sum(row["nees"] for row in sessions) / (3.0 * n_errors),
        "pose_m": _root([row["pose_m"] for row in located]),
        "oracle_m": _root([row["oracle_pose_m"] for row in located if "oracle_pose_m" in row]),
        "pose_ratio": float(np.median(ratio)) if ratio else None,
    }


def reliability(pairs: Iterable[tuple[float, bool]]) -> list[tuple[float, float, int]]:
    """Mean probability, share of what is so, and number, in ten bins of probability."""
    table = np.array(list(pairs), dtype=np.float64).reshape(-1, 2)
    which = np.clip(np.digitize(table[:, 0], EDGES) - 1, 0, 9)
    return [
        (*table[which == k].mean(axis=0).tolist(), int(np.sum(which == k))) for k in range(10) if np.any(which == k)
    ]


def as_markdown(content: Mapping[str, Any]) -> str:
    """All tables."""
    methods = list(dict.fromkeys(run["method"] for run in content["runs"]))
    first = of_method(content, methods[0])
    groups = [(f"{methods[0]}, building {run['seed']}", [run]) for run in first]
    if len(first) > 1:
        groups.append((f"{methods[0]}, all", first))
    groups += [(f"{name}, building {run['seed']}", [run]) for name in methods[1:] for run in of_method(content, name)]
    return "\n\n".join(
        (_existence(groups), _changes(groups), _poses(groups), _by_kind(first), _bins(first), _lifetimes(first))
    )


def _existence(groups: list[tuple[str, list[Row]]]) -> str:
    head = ("existence", "statements", "Brier", "log loss", "right, p >= .9", "a day ahead, Brier", "constant")
    lines = []
    for name, runs in groups:
        s, count = summary(runs), sum(len(run["statements"]) for run in runs)
        keys = ("brier", "log_loss", "sure_right", "forecast_brier", "constant_brier")
        lines.append([name, f"{count}", *(number("{:.3f}", s[key]) for key in keys)])
    return markdown_table(head, lines)


def _changes(groups: list[tuple[str, list[Row]]]) -> str:
    head = (
        "changes, by landmark", "told", "false", "false a session", "never changed", "with p > .99", "without looks",
        "Brier", "can be known", "recall", "at once", "displacement error [m]",
    )  # fmt: skip
    lines = []
    for name, runs in groups:
        s = summary(runs)
        counts = [f"{s['told']}", f"{s['false']}", f"{s['false'] / max(s['sessions'], 1):.2f}"]
        counts += [
            f"{s['never']}",
            f"{s['never_sure']}",
            f"{s['unseen']}",
            number("{:.3f}", s["told_brier"]),
            f"{s['n_changes']}",
        ]
        keys = ("recall", "at_once", "displacement_m")
        lines.append([name, *counts, *(number("{:.3f}", s[key]) for key in keys)])
    return markdown_table(head, lines)


def _poses(groups: list[tuple[str, list[Row]]]) -> str:
    head = (
        "poses", "sessions", "not found", "rms [m]", "oracle [m]", "median ratio", "by hand, rms [m]", "oracle [m]",
        "median ratio", "landmarks, rms [m]", "NEES / 3",
    )  # fmt: skip
    lines = []
    for name, runs in groups:
        parts = [
            summary([{**run, "sessions": [row for row in run["sessions"] if row["by_hand"] == hand]} for run in runs])
            for hand in (False, True)
        ]
        counts = [f"{sum(p['sessions'] for p in parts)}", f"{sum(p['lost'] for p in parts)}"]
        keys = ("pose_m", "oracle_m", "pose_ratio")
        s, errors = summary(runs), (number("{:.3f}", p[key]) for p in parts for key in keys)
        lines.append([name, *counts, *errors, f"{s['landmark_m']:.3f}", f"{s['nees']:.2f}"])
    return markdown_table(head, lines)


def _by_kind(runs: Sequence[Row]) -> str:
    told, changes = ([row for run in runs for row in run[key]] for key in ("told", "changes"))
    lines = []
    for kind in dict.fromkeys(row["kind"] for row in told):
        mine = [row for row in told if row["kind"] == kind]
        lines.append([f"told: {kind}", f"{len(mine)}", number("{:.3f}", _mean([row["true"] for row in mine])), "–"])
    for kind in ("is elsewhere or again", "is gone", "is new"):
        mine = [row for row in changes if row["kind"] == kind]
        lines.append([f"it {kind}", f"{len(mine)}", "–", number("{:.3f}", _mean([row["told"] for row in mine]))])
    return markdown_table(("kind", "landmarks", "precision", "recall"), lines)


def _bins(runs: Sequence[Row]) -> str:
    lines = []
    for name, key in (("existence", "statements"), ("a day ahead", "forecasts")):
        for p, share, count in reliability(pair for run in runs for pair in run[key]):
            lines.append([name, f"{p:.3f}", f"{share:.3f}", f"{count}"])
    for p, share, count in reliability((row["p"], row["true"]) for run in runs for row in run["told"]):
        lines.append(["changes", f"{p:.3f}", f"{share:.3f}", f"{count}"])
    return markdown_table(("calibration", "mean p", "share so", "statements"), lines)


def _lifetimes(runs: Sequence[Row]) -> str:
    lines = []
    for name, life in runs[0]["lifetimes"].items():
        told = [run["lifetimes"][name]["median_days"] for run in runs]
        median, true = float(np.median(told)), life["true_days"]
        stays, ended = (sum(run["lifetimes"][name][key] for run in runs) for key in ("n_stays", "n_ended"))
        ratio = None if true is None else median / true
        lines.append([name, f"{stays}", f"{ended}", f"{median:.1f}", number("{:.1f}", true), number("{:.2f}", ratio)])
    return markdown_table(("lifetimes", "stays", "ended", "median [days]", "true [days]", "ratio"), lines)


def _log_loss(pairs: Sequence[tuple[float, bool]]) -> float | None:
    return _mean([-np.log(np.clip(p if right else 1.0 - p, FLOOR, 1.0)) for p, right in pairs])


def _mean(values: Sequence[Any]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _root(values: Sequence[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None
