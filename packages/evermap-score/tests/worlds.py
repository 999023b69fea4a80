"""Tiny worlds, and the ways to write them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from evermap_score import Episodes, LookTable, Rules, episodes_from_rows
from evermap_score.matching import World
from evermap_score.metric import Metric
from evermap_score.score import make_world, measure


def table(*rows: tuple[Any, ...], **more: Any) -> Episodes:
    """Episodes from (id, from, to, x, y[, p]); None is open. `more` are columns for all rows."""
    names = ("landmark_id", "t_from_s", "t_to_s", "x_m", "y_m", "p")
    return episodes_from_rows(dict(zip(names, row, strict=False)) | more for row in rows)


def looks_at(ends_s: Sequence[float], looks: dict[str, Sequence[float]]) -> LookTable:
    """A look table whose sessions end at given stamps; each session has a look at something else at its end."""
    stamps = [(stamp_s, name) for name, at in looks.items() for stamp_s in at] + [(end, "-") for end in ends_s]
    session = [str(int(np.searchsorted(ends_s, stamp_s))) for stamp_s, _ in stamps]
    return LookTable(
        np.array([stamp_s for stamp_s, _ in stamps]), np.array([name for _, name in stamps]), np.array(session)
    )


def world_of(truth: Episodes, estimate: Episodes, looks: LookTable | None = None, **rules: Any) -> World:
    return make_world(truth, {"estimate": estimate}, looks, rules=Rules(**rules) if rules else None)


def values(truth: Episodes, estimate: Episodes, looks: LookTable | None = None, **rules: Any) -> dict[str, float]:
    """All metrics without alignment."""
    return {each.name: each.value() for each in metrics(truth, estimate, looks, **rules)}


def metrics(truth: Episodes, estimate: Episodes, looks: LookTable | None = None, **rules: Any) -> list[Metric]:
    return measure(world_of(truth, estimate, looks, **rules), estimate)
