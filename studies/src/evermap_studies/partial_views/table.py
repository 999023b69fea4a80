"""The tables of `evermap reproduce partial-views`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from evermap_studies.markdown import markdown_table, number

Row = Mapping[str, Any]
PLAIN = "all but hard"
EDGES = np.linspace(0.0, 1.0, 11)


def patrol_name(patrol_s: int) -> str:
    """'60 s', or 'hard' for the harder world."""
    return f"{patrol_s} s" if patrol_s else "hard"


def by_patrol(content: Mapping[str, Any], part: str = "worlds") -> dict[str, list[Row]]:
    """Worlds by the length of their patrols, and all of them together."""
    groups: dict[str, list[Row]] = {}
    for world in content[part]:
        groups.setdefault(patrol_name(world["patrol_s"]), []).append(world)
    plain = [world for world in content[part] if world["patrol_s"]]
    return groups | ({PLAIN: plain} if len(plain) > 0 else {})


def summary(worlds: Sequence[Row]) -> dict[str, Any]:
    """Numbers of some worlds; None where nothing was counted."""
    told = [row for world in worlds for row in world["told"]]
    after = [row for world in worlds for row in world["after"]]
    changes = [row for world in worlds for row in world["changes"]]
    forecasts = np.array([pair for world in worlds for pair in world["forecasts"]], dtype=np.float64).reshape(-1, 2)
    p, true = (np.array([row[key] for row in told], dtype=np.float64) for key in ("p", "true"))
    n_errors = sum(row["n_errors"] for row in after)
    happened = forecasts[:, 1].mean() if len(forecasts) else np.nan
    return {
        "told": len(told),
        "false": int(np.sum(true == 0.0)),
        "never": sum(row["never"] for row in told),
        "never_sure": sum(row["never"] and row["p"] > 0.99 for row in told),
        "unseen": sum(row["looks"] == 0 for row in told),
        "brier": _mean(np.square(p - true)),
        "recall": _mean([row["told"] for row in changes]),
        "recall_at_once": _mean([row["at_once"] for row in changes]),
        "n_changes": len(changes),
        "precision": _ratio(sum(row["n_sure_right"] for row in after), sum(row["n_sure"] for row in after)),
        "forecast_brier": _mean(np.square(forecasts[:, 0] - forecasts[:, 1])),
        "constant_brier": happened * (1.0 - happened) if len(forecasts) else None,
        "nees": _ratio(sum(row["nees"] for row in after), 2.0 * n_errors),
        "landmark_rmse_m": _root(_ratio(sum(row["squared_error_m2"] for row in after), n_errors)),
        "shape_rmse_m": _root(_ratio(sum(row["squared_shape_error_m2"] for row in after), n_errors)),
        "lost": sum(not row["found"] for row in after),
        "sessions": len(after),
    }


def reliability(told: Iterable[Row]) -> list[tuple[float, float, int]]:
    """Mean probability, share of true ones, and number, of the changes told, in ten bins of probability."""
    rows = list(told)
    p, true = (np.array([row[key] for row in rows], dtype=np.float64) for key in ("p", "true"))
    which = np.clip(np.digitize(p, EDGES) - 1, 0, 9)
    return [
        (float(p[which == k].mean()), float(true[which == k].mean()), int(np.sum(which == k)))
        for k in range(10)
        if np.any(which == k)
    ]


def calibration(told: Iterable[Row]) -> list[list[str]]:
    """Changes told by kind: number, mean probability, share true, and of those above .99 the number and the share."""
    rows, lines = list(told), []
    for kind in sorted({row["kind"] for row in rows}):
        of_kind = [row for row in rows if row["kind"] == kind]
        sure = [row for row in of_kind if row["p"] > 0.99]
        means = (_mean([row["p"] for row in of_kind]), _mean([row["true"] for row in of_kind]))
        sure_true = number("{:.3f}", _mean([row["true"] for row in sure]))
        lines.append([kind, f"{len(of_kind)}", *(number("{:.3f}", m) for m in means), f"{len(sure)}", sure_true])
    return lines


def beliefs(worlds: Iterable[Row]) -> list[list[str]]:
    """P(exists) of what the newest session saw and of what it did not, in ten bins: mean, share that stands, number."""
    pairs = np.array([row for world in worlds for row in world.get("beliefs", ())], dtype=np.float64).reshape(-1, 3)
    lines = []
    for seen, word in ((1.0, "seen"), (0.0, "not seen")):
        for p, share, count in reliability({"p": p, "true": t} for p, t, s in pairs.tolist() if s == seen):
            lines.append([word, f"{p:.3f}", f"{share:.3f}", f"{count}"])
    return lines


SIZES_M = (0.0, 0.05, 0.15, 0.3, 1.0, np.inf)


def displacements(worlds: Iterable[Row]) -> list[list[str]]:
    """Displacements told of single landmarks, by how far they moved: number, RMSE [m], NEES over its expectation."""
    rows = [row for world in worlds for row in world["told"] if "squared" in row]
    lines = []
    for low, high in pairwise(SIZES_M):
        some = [row for row in rows if low <= row["moved_m"] < high]
        if some:
            error = _root(_mean([row["error_m"] ** 2 for row in some]))
            nees = [row["squared"] / 2.0 for row in some]
            name = f"{low:g} to {high:g} m" if np.isfinite(high) else f"from {low:g} m"
            lines.append(
                [name, f"{len(some)}", number("{:.3f}", error), f"{np.mean(nees):.2f}", f"{np.median(nees):.2f}"]
            )
    return lines


def as_markdown(table: Mapping[str, Any]) -> str:
    """All tables."""
    lines = []
    for name, worlds in by_patrol(table).items():
        s = summary(worlds)
        share = 100.0 / max(s["told"], 1)
        lines.append([
            name, f"{s['sessions']}", f"{s['lost']}", f"{s['told']}", f"{share * s['never']:.2f} %",
            f"{share * s['never_sure']:.2f} %", f"{share * s['false']:.2f} %", f"{s['unseen']}",
            number("{:.3f}", s["brier"]), number("{:.3f}", s["recall"]), number("{:.3f}", s["recall_at_once"]),
            number("{:.3f}", s["precision"]), number("{:.3f}", s["forecast_brier"]),
            number("{:.3f}", s["constant_brier"]), number("{:.2f}", s["nees"]),
            number("{:.3f}", s["landmark_rmse_m"]), number("{:.3f}", s["shape_rmse_m"]),
        ])  # fmt: skip
    header = (
        "patrols", "sessions", "not found", "told", "never changed", "with p > .99", "false", "without looks", "Brier",
        "recall", "at once", "precision, p >= .9", "forecast Brier", "constant", "NEES / 2", "landmarks [m]",
        "shape [m]",
    )  # fmt: skip
    bins = []
    for name, worlds in by_patrol(table).items():
        if name in (patrol_name(0), PLAIN):
            for p, share_true, count in reliability(row for world in worlds for row in world["told"]):
                bins.append([name, f"{p:.3f}", f"{share_true:.3f}", f"{count}"])
    still = [_still_line(name, summary(worlds), worlds) for name, worlds in by_patrol(table, "still").items()]
    plain = by_patrol(table).get(PLAIN, [])
    parts = (
        (header, lines),
        (("patrols", "mean p told", "share true", "changes"), bins),
        (
            ("kind", "told", "mean p told", "share true", "with p > .99", "of these true"),
            calibration(row for world in plain for row in world["told"]),
        ),
        (("by the newest session", "mean P(exists)", "share that stands", "landmarks"), beliefs(plain)),
        (("moved by", "told", "error [m]", "NEES / 2", "median"), displacements(plain)),
        (("nothing changes; patrols", "sessions", "not found", "told", "highest p", "precision, p >= .9"), still),
    )
    return "\n\n".join(markdown_table(head, rows) for head, rows in parts if rows)


def _still_line(name: str, s: Mapping[str, Any], worlds: Sequence[Row]) -> list[str]:
    p = [row["p"] for world in worlds for row in world["told"]]
    highest = f"{max(p):.2f}" if p else "–"
    return [name, f"{s['sessions']}", f"{s['lost']}", f"{s['told']}", highest, number("{:.3f}", s["precision"])]


def _mean(values: Any) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _root(value: float | None) -> float | None:
    return None if value is None else float(np.sqrt(value))
