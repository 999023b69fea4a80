"""Copies that are somewhere else in one window only: wrong identities for a while, or something in the way.

What moved stays moved; what is seen elsewhere in one window and back at its place in the next did not move. Whether a
copy is such a transient is weighed against everything else that could have happened: it is left out where that, and the
best set of changes then, explain more than the best set of changes with it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from evermap.slam.changes.evidence import Comparison, Evidence
from evermap.slam.changes.prior import ChangePrior
from evermap.slam.changes.search import Hypotheses
from evermap.types import BoolArray, FloatArray, IntArray

LOG_ODDS = 7.0
"""Prior log odds against a copy being displaced alone."""

Search = Callable[[Evidence, Hypotheses | None], tuple[Comparison, Hypotheses]]
"""Compares an evidence with the map and finds changes, from a start."""


def without_transients(evidence: Evidence, position: FloatArray, prior: ChangePrior, search: Search) -> Evidence:
    """The evidence without copies that are displaced alone.

    Args:
        evidence: of all copies.
        position: (L, 2) mapped positions.
        prior: how changes are distributed.
        search: how changes are looked for.
    """
    comparison, found = search(evidence, None)
    for _ in range(len(evidence.landmark)):
        spared = _only_copies(evidence)
        alone = np.where(spared, 0.0, _gains(comparison, prior.move_sigma_m))
        after = _explained_away(evidence, comparison, found, position, prior)
        still = np.where(spared, 0.0, _gains(after, prior.move_sigma_m))
        candidates: list[tuple[int, float]] = []  # a copy, and what leaving it out gains over keeping it
        worst = int(np.argmax(still))
        if still[worst] > LOG_ODDS:
            candidates.append((worst, still[worst] - LOG_ODDS))
        worst = int(np.argmax(alone))
        if alone[worst] > LOG_ODDS and all(worst != other for other, _ in candidates):
            _, others = search(_dropped(evidence, worst), found)
            candidates.append((worst, alone[worst] - LOG_ODDS + float(others.gain[0] - found.gain[0])))
        best, gain = max(candidates, key=lambda candidate: candidate[1], default=(0, 0.0))
        if gain <= 0.0:
            break
        evidence = _dropped(evidence, best)
        comparison, found = search(evidence, found)
    return evidence


def _dropped(evidence: Evidence, copy: int) -> Evidence:
    out = np.zeros(len(evidence.landmark), dtype=bool)
    out[copy] = True
    return evidence.without(out)


def _only_copies(evidence: Evidence) -> BoolArray:
    """(R,) copies of landmarks that have no other."""
    only: BoolArray = np.bincount(evidence.landmark)[evidence.landmark] < 2
    return only


def _gains(comparison: Comparison, sigma_m: float) -> FloatArray:
    """(R,) what every copy gains by a displacement of its own [nats]."""
    count = len(comparison.pull) // 2
    rows = np.arange(count)
    precision = comparison.precision.reshape(count, 2, count, 2)[rows, :, rows, :]
    pull = comparison.pull.reshape(count, 2)
    inner = precision + np.eye(2) / sigma_m**2
    solved = np.linalg.solve(inner, pull[:, :, None])[:, :, 0]
    gains: FloatArray = 0.5 * (pull * solved).sum(axis=1) - 0.5 * np.linalg.slogdet(sigma_m**2 * inner)[1]
    return gains


def _explained_away(
    evidence: Evidence, comparison: Comparison, found: Hypotheses, position: FloatArray, prior: ChangePrior
) -> Comparison:
    """The comparison with the motions of the best hypothesis integrated out."""
    columns: list[FloatArray] = []
    shift = np.zeros_like(evidence.position)
    label = found.label[0]
    for g in range(1, int(label.max()) + 1):
        members: IntArray = np.flatnonzero(label == g)
        moved = np.isin(evidence.landmark, members) & (evidence.window >= found.onset[0, g])
        angle = found.motion[0, g - 1, 2] if found.turns[0, g] else 0.0
        arm = position[evidence.landmark] - position[members].mean(axis=0)
        turned = np.column_stack(
            [
                np.cos(angle) * arm[:, 0] - np.sin(angle) * arm[:, 1],
                np.sin(angle) * arm[:, 0] + np.cos(angle) * arm[:, 1],
            ]
        )
        tangent = np.column_stack([-turned[:, 1], turned[:, 0]])
        shift += moved[:, None] * (turned - arm - angle * tangent)
        parts = [np.tile([1.0, 0.0], (len(moved), 1)), np.tile([0.0, 1.0], (len(moved), 1)), tangent]
        for column, sigma in zip(parts[: 3 if found.turns[0, g] else 2], prior.spread, strict=False):
            columns.append((sigma * moved[:, None] * column).ravel())
    if not columns:
        return comparison
    matrix = np.column_stack(columns)
    pull = comparison.pull - comparison.precision @ shift.ravel()
    weighted = comparison.precision @ matrix
    inner = np.eye(matrix.shape[1]) + matrix.T @ weighted
    return comparison._replace(
        precision=comparison.precision - weighted @ np.linalg.solve(inner, weighted.T),
        pull=pull - weighted @ np.linalg.solve(inner, matrix.T @ pull),
    )
