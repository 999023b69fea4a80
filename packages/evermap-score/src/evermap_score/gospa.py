"""GOSPA: the distance of two sets of points, split into localisation, missed and false.

Source: Rahmathullah, García-Fernández, Svensson: Generalized optimal sub-pattern assignment metric, FUSION 2017;
proposition 1 with alpha = 2.
"""

from __future__ import annotations

import numpy as np

from evermap_score.episodes import Episodes, FloatArray, IntArray
from evermap_score.matching import World, distances_m
from evermap_score.metric import Metric, OfSums, metric_of_rows

P = 2
ALPHA = 2


def pair_points(truth_m: FloatArray, estimate_m: FloatArray, c_m: float) -> tuple[IntArray, IntArray]:
    """Return the pairs of the assignment that attains GOSPA (p = alpha = 2); pairs at `c_m` or farther are none.

    Args:
        truth_m: points (n, d).
        estimate_m: points (m, d).
        c_m: cut-off distance.
    """
    from scipy.optimize import linear_sum_assignment

    if len(truth_m) == 0 or len(estimate_m) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    away = distances_m(truth_m, estimate_m)
    rows, columns = linear_sum_assignment(np.minimum(away, c_m) ** P)
    near = away[rows, columns] < c_m
    return rows[near].astype(np.int64), columns[near].astype(np.int64)


def gospa(truth_m: FloatArray, estimate_m: FloatArray, c_m: float = 1.0) -> tuple[float, float, float, float]:
    """Return GOSPA of two sets of points, and its parts: localisation, missed, false.

    The square of the first is the sum of the others: squared distances of pairs, and c^2 / 2 for each point without
    a pair.

    Args:
        truth_m: points (n, d).
        estimate_m: points (m, d).
        c_m: cut-off distance.
    """
    rows, columns = pair_points(truth_m, estimate_m, c_m)
    localisation = float((np.linalg.norm(truth_m[rows] - estimate_m[columns], axis=1) ** P).sum()) if len(rows) else 0.0
    missed = (len(truth_m) - len(rows)) * c_m**P / ALPHA
    false = (len(estimate_m) - len(rows)) * c_m**P / ALPHA
    return (localisation + missed + false) ** (1.0 / P), localisation, missed, false


def gospa_metrics(world: World, estimate: Episodes) -> list[Metric]:
    """Return the root of the mean over the instants of squared GOSPA, and the means of its parts.

    Positions only: neither identities nor classes matter. At each instant the map of that robot time is asked.
    """
    dim, c_m = world.rules.dim, world.rules.gospa_c_m
    items: list[tuple[int, str, tuple[float, float, float, float]]] = []
    for k, stamp_s in enumerate(world.instants_s.tolist()):
        truth = world.truth.state_at(stamp_s)
        stated = estimate.select_map(stamp_s).state_at(stamp_s, world.rules.present_p)
        at, of = truth.position_m[:, :dim], stated.position_m[:, :dim]
        rows, columns = pair_points(at, of, c_m)
        items.append((k, "", (0.0, 0.0, 0.0, 1.0)))
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            squared = float(((at[row] - of[column]) ** 2).sum())
            items.append((k, str(truth.landmark_id[row]), (squared, 0.0, 0.0, 0.0)))
        missed = np.delete(truth.landmark_id, rows).tolist()
        false = np.delete(stated.landmark_id, columns).tolist()
        items += [(k, name, (0.0, c_m**P / ALPHA, 0.0, 0.0)) for name in missed]
        items += [(k, name, (0.0, 0.0, c_m**P / ALPHA, 0.0)) for name in false]
    return [
        metric_of_rows("gospa/total", "m", items, 4, of_sums=_total),
        *(
            metric_of_rows(f"gospa/{part}", "m2", items, 4, of_sums=_mean_of(column))
            for column, part in enumerate(("localisation", "missed", "false"))
        ),
    ]


def _total(sums: FloatArray) -> float:
    return float((sums[:3].sum() / sums[3]) ** (1.0 / P)) if sums[3] > 0.0 else float("nan")


def _mean_of(column: int) -> OfSums:
    def of_sums(sums: FloatArray) -> float:
        return float(sums[column] / sums[3]) if sums[3] > 0.0 else float("nan")

    return of_sums
