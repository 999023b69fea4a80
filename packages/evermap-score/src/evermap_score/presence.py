"""Presence of objects over robot time and query time, by the rules of Khronos.

Source: Schmid, Abate, Chang, Carlone: Khronos, RSS 2024, section V, and `ObjectEvaluator` of their `khronos_eval`:

- An object is what was at one place, with all intervals in which it was there. What moved is another object.
- For each robot time there is a map, and it is asked for every query time until then: a cell.
- Objects of the map go to the nearest object of the truth within .5 m, of the same class, and the other way round;
  whether they are there at the query time does not matter for that, and several may go to one. Of several that go to
  the same one only the first counts, so that fragments are not counted twice.
- Of an object of the map that is there at the query time: *detected* if its partner is there, too; else, or without a
  partner, *hallucinated*. Of an object of the truth that is there: *missed* if its partner is not, or without one.
- Precision is detected / (detected + hallucinated), recall detected / (detected + missed); of each cell there is an
  F1, and the number is their mean over all cells ('4D'), or over those with the last query time of each robot time
  ('online').

So what moves by less than .5 m goes to its old place, which is the nearest object, and is hallucinated afterwards.
They associate by surfaces by default; here there are centroids only, their option `CENTROID`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from evermap_score.episodes import Episodes, FloatArray, IntArray, TextArray
from evermap_score.matching import Rules, World, agree_classes, distances_m
from evermap_score.metric import Metric, metric_of_rows

Cell = tuple[int, str, tuple[float, float, float, float, float]]
"""Session of the robot time, landmark, and detected, hallucinated, missed, index of the cell, whether it is online."""


@dataclass(frozen=True)
class PlacedObjects:
    """What was at one place: rows of a table by object.

    Attributes:
        landmark_id: text (n,).
        class_id: text (n,), empty if unknown.
        position_m: (n, d) of the first row of each.
        rows: of the table, for each object.
    """

    landmark_id: TextArray
    class_id: TextArray
    position_m: FloatArray
    rows: list[IntArray]


def find_objects(table: Episodes, rules: Rules) -> PlacedObjects:
    """Return the objects of a table: rows of one landmark within `same_place_m` are one."""
    first: list[int] = []
    rows: list[list[int]] = []
    of_landmark: dict[str, list[int]] = {}
    place = table.position_m[:, : rules.dim]
    for row, name in enumerate(table.landmark_id.tolist()):
        for number in of_landmark.setdefault(name, []):
            if np.linalg.norm(place[row] - place[first[number]]) <= rules.same_place_m:
                rows[number].append(row)
                break
        else:
            of_landmark[name].append(len(first))
            first.append(row)
            rows.append([row])
    return PlacedObjects(
        table.landmark_id[first], table.class_id[first], place[first], [np.array(each, np.int64) for each in rows]
    )


def find_nearest(of: PlacedObjects, to: PlacedObjects, match_m: float) -> IntArray:
    """Return for each object the nearest one of the other table, of its class and within `match_m`; else -1."""
    if len(of.rows) == 0 or len(to.rows) == 0:
        return np.full(len(of.rows), -1, np.int64)
    away = np.where(agree_classes(of.class_id, to.class_id), distances_m(of.position_m, to.position_m), np.inf)
    nearest = away.argmin(axis=1)
    return np.where(away[np.arange(len(nearest)), nearest] <= match_m, nearest, -1).astype(np.int64)


def presence_metrics(world: World, estimate: Episodes) -> list[Metric]:
    """Return F1, precision and recall of presence over all cells, and F1 of the online ones.

    An estimate with one map has one robot time, after all instants, and is asked for all of them; it has no online
    cells. Rows below `present_p` are left out.
    """
    rules, instants = world.rules, world.instants_s
    robot_times = estimate.robot_times_s().tolist()
    truth = find_objects(world.truth, rules)
    there = _are_present(world.truth, truth, instants)
    items: list[Cell] = []
    cell = 0
    for robot_time_s in robot_times or [np.inf]:
        known = estimate.select_map(robot_time_s)
        known = known[known.p >= rules.present_p]
        objects = find_objects(known, rules)
        stated = _are_present(known, objects, instants)
        to_truth, to_estimate = (
            find_nearest(objects, truth, rules.match_m), find_nearest(truth, objects, rules.match_m),
        )  # fmt: skip
        for k, query_s in enumerate(instants.tolist()):
            if query_s > robot_time_s:
                break
            session = world.session_of(robot_time_s) if robot_times else k
            online = float(bool(robot_times) and not (instants[k + 1 :] <= robot_time_s).any())
            for name, counts in _count(objects, truth, to_truth, to_estimate, stated[:, k], there[:, k]):
                items.append((session, name, (*counts, float(cell), online)))
            cell += 1

    def select(name: str, part: int, online_only: bool = False) -> Metric:
        return metric_of_rows(
            name,
            "",
            [item for item in items if item[2][4] or not online_only],
            5,
            of_items=partial(_mean_over_cells, part=part),
        )

    return [
        select("presence/f1", 2), select("presence/precision", 0), select("presence/recall", 1),
        select("presence/f1_online", 2, online_only=True),
    ]  # fmt: skip


def _are_present(table: Episodes, objects: PlacedObjects, instants_s: FloatArray) -> FloatArray:
    """Return of each object and instant (n, k) whether one of its rows holds it."""
    inside = (table.t_from_s[:, None] <= instants_s) & (instants_s < table.t_to_s[:, None])
    present = np.zeros((len(objects.rows), len(instants_s)))
    for number, rows in enumerate(objects.rows):
        present[number] = inside[rows].any(axis=0)
    return present


def _count(
    objects: PlacedObjects, truth: PlacedObjects, to_truth: IntArray, to_estimate: IntArray,
    stated: FloatArray, there: FloatArray,
) -> list[tuple[str, tuple[float, float, float]]]:  # fmt: skip
    """Return for each object that counts its landmark, and whether it is detected, hallucinated, missed."""
    counted: list[tuple[str, tuple[float, float, float]]] = []
    visited: set[int] = set()
    for number, partner in enumerate(to_truth.tolist()):
        if partner >= 0:
            if partner in visited:
                continue
            visited.add(partner)
        if stated[number]:
            detected = partner >= 0 and bool(there[partner])
            name = str(truth.landmark_id[partner]) if partner >= 0 else str(objects.landmark_id[number])
            counted.append((name, (float(detected), float(not detected), 0.0)))
    visited.clear()
    for number, partner in enumerate(to_estimate.tolist()):
        if partner >= 0:
            if partner in visited:
                continue
            visited.add(partner)
        if there[number] and (partner < 0 or not stated[partner]):
            counted.append((str(truth.landmark_id[number]), (0.0, 0.0, 1.0)))
    return counted


def _mean_over_cells(columns: FloatArray, weights: FloatArray, part: int) -> float:
    if len(columns) == 0:
        return float("nan")
    cells, index = np.unique(columns[:, 3], return_inverse=True)
    detected, false, missed = (
        np.bincount(index, weights * columns[:, column], minlength=len(cells)) for column in range(3)
    )
    over, below = (
        (detected, detected + false), (detected, detected + missed), (2.0 * detected, 2.0 * detected + false + missed),
    )[part]  # fmt: skip
    defined = below > 0.0
    # a session that is drawn twice brings its cells twice
    share = np.bincount(index, weights, minlength=len(cells)) / np.bincount(index, minlength=len(cells))
    if not defined.any():
        return float("nan")
    return float(np.average(over[defined] / below[defined], weights=share[defined]))
