"""What the experiment was to show, beside what came out: a list of promises, each with how it is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Row = dict[str, Any]
Rows = Sequence[Row]

MAIN, OTHERS = (6,), (1, 2, 3)
"""Data set 6 has true poses; the others are compared with a reference."""
OTHERS_NAME = "data sets 1 to 3 (poses against our own run with the true map)"
SURE = 0.9
"""Changes reported with more than this are to be right about as often as they say."""
KINDS = ("two groups", "three scattered", "rotated")
"""Changes other than one group that is displaced."""
_NOISE_M = 0.001
"""By how much a joint run may be worse than a static one and count as not worse."""


@dataclass(frozen=True, slots=True)
class Promise:
    """A ceiling, or a floor, for a number.

    Attributes:
        what: in words.
        limit, unit, floor: at most `limit`, or at least.
        measure: the number from the rows of the simulation and of the runs; None where nothing was run.
    """

    what: str
    limit: float
    unit: str
    measure: Callable[[Rows, Rows], float | None]
    floor: bool = False


def verdicts(simulation: Rows, runs: Rows) -> list[Row]:
    """Every promise with what was measured; `met` is None where nothing was."""
    out = []
    for promise in PROMISES:
        value = promise.measure(simulation, runs)
        met = None if value is None else value >= promise.limit if promise.floor else value <= promise.limit
        out.append(
            {
                "what": promise.what,
                "at_least" if promise.floor else "at_most": promise.limit,
                "unit": promise.unit,
                "measured": value,
                "met": met,
            }
        )
    return out


def chosen(rows: Rows, **wanted: Any) -> list[Row]:
    """Rows whose values are those wanted, or among them where a tuple is."""
    return [
        row
        for row in rows
        if all(row[name] in value if isinstance(value, tuple) else row[name] == value for name, value in wanted.items())
    ]


def mean(rows: Iterable[Row], key: str) -> float | None:
    """Arithmetic mean of what is known."""
    values = [float(row[key]) for row in rows if row.get(key) is not None]
    return sum(values) / len(values) if values else None


def distinct(rows: Rows, key: str) -> list[Any]:
    """Values that there are, in their order."""
    return list(dict.fromkeys(row[key] for row in rows))


def complete(rows: Rows) -> list[Row]:
    """Return the rows of robots and displacements that have all methods: of a study that goes on, what is done."""
    robots = {robot: sum(row["robot"] == robot for row in rows) for robot in distinct(rows, "robot")}
    whole = [row for row in rows if robots[row["robot"]] == max(robots.values())]
    deltas = {delta: sum(row["delta_m"] == delta for row in whole) for delta in distinct(whole, "delta_m")}
    return [row for row in whole if deltas[row["delta_m"]] == max(deltas.values())]


def weights(runs: Rows) -> tuple[list[float], list[bool]]:
    """Probability of every change that random draws made the joint search report, and whether it was right."""
    drawn = [change for row in runs if row["scenario"].startswith("random") for change in row["changes"]]
    return [change["probability"] for change in drawn], [change["right"] for change in drawn]


def _joint(runs: Rows, datasets: tuple[int, ...], deltas: tuple[float, float] = (0.0, 9.0), **also: Any) -> list[Row]:
    """Runs of the joint search on the named groups, displaced by an amount between two."""
    where = {"part": "recordings", "scenario": "group", "sensor": "ours", "method": "joint", "dataset": datasets}
    return [row for row in chosen(runs, **(where | also)) if deltas[0] <= row["delta_m"] <= deltas[1]]


def _worst_mean(rows: list[Row], key: str) -> float | None:
    """Largest mean over the robots of a data set at one displacement; a robot that was not placed is infinitely off."""
    cells: dict[tuple[int, float], list[float]] = {}
    for row in rows:
        value = row[key]
        cells.setdefault((row["dataset"], row["delta_m"]), []).append(99.0 if value is None else value)
    return max((sum(values) / len(values) for values in cells.values()), default=None)


def _pose(datasets: tuple[int, ...], low: float, high: float) -> Callable[[Rows, Rows], float | None]:
    return lambda _, runs: _worst_mean(_joint(runs, datasets, (low, high)), "pose_rmse_m")


def _landmarks(datasets: tuple[int, ...]) -> Callable[[Rows, Rows], float | None]:
    """At the displacements at which the set is to be found."""
    return lambda _, runs: _worst_mean(
        [row for row in _joint(runs, datasets) if not 0.0 < row["delta_m"] < 0.2], "landmark_rmse_m"
    )


def _exact(datasets: tuple[int, ...], low: float, high: float) -> Callable[[Rows, Rows], float | None]:
    return lambda _, runs: mean(_joint(runs, datasets, (low, high)), "exact")


def _still_or_far(datasets: tuple[int, ...]) -> Callable[[Rows, Rows], float | None]:
    """Share of exact sets where nothing moved, or by 0.3 m or more."""
    return lambda _, runs: mean(_joint(runs, datasets, (0.0, 0.0)) + _joint(runs, datasets, (0.3, 9.0)), "exact")


def _found(datasets: tuple[int, ...]) -> Callable[[Rows, Rows], float | None]:
    """The least of the kinds of changes."""

    def least(_: Rows, runs: Rows) -> float | None:
        exact = [mean(chosen(runs, part="search", scenario=kind, dataset=datasets), "exact") for kind in KINDS]
        return min((share for share in exact if share is not None), default=None)

    return least


def _gauge(_: Rows, runs: Rows) -> float | None:
    rows = chosen(runs, part="search", scenario="gauge")
    return sum(row["truth_rank"] is not None for row in rows) / len(rows) if rows else None


def _no_worse(datasets: tuple[int, ...]) -> Callable[[Rows, Rows], float | None]:
    """Share of the runs in which the joint search is as good as the static map."""

    def share(_: Rows, runs: Rows) -> float | None:
        static = {
            (row["dataset"], row["robot"], row["delta_m"]): row["pose_rmse_m"]
            for row in _joint(runs, datasets, method="nohyp")
        }
        pairs = [
            (row["pose_rmse_m"], static[key])
            for row in _joint(runs, datasets)
            if (key := (row["dataset"], row["robot"], row["delta_m"])) in static
        ]
        known = [(a, b) for a, b in pairs if b is not None]
        return sum(a is not None and a <= b + _NOISE_M for a, b in known) / len(known) if known else None

    return share


def _during(key: str, datasets: tuple[int, ...]) -> Callable[[Rows, Rows], float | None]:
    def measure(_: Rows, runs: Rows) -> float | None:
        rows = chosen(runs, part="during", method="joint", dataset=datasets)
        if key == "found":
            in_time = [row["time_off_interval_s"] is not None and row["time_off_interval_s"] <= 10.0 for row in rows]
            return sum(in_time) / len(rows) if rows else None
        return _worst_mean(rows, key)

    return measure


def _slowest(method: str | tuple[str, ...]) -> Callable[[Rows, Rows], float | None]:
    def factor(_: Rows, runs: Rows) -> float | None:
        rows = chosen(runs, part="recordings", scenario="group", sensor="ours", method=method)
        return min((row["recording_s"] / row["cpu_s"] for row in rows if row["cpu_s"]), default=None)

    return factor


def _latency(_: Rows, runs: Rows) -> float | None:
    return max((row["step_p99_ms"] for row in _joint(runs, MAIN) if row["cpu_s"]), default=None)


def _calibration(_: Rows, runs: Rows) -> float | None:
    """How far the share of the right ones is below the probability said, of the sure ones."""
    said, right = map(np.array, weights(runs))
    sure = said >= SURE if len(said) else np.zeros(0, dtype=bool)
    return float(said[sure].mean() - right[sure].mean()) if sure.any() else None


def _above(simulation: Rows, _: Rows) -> float | None:
    rows = chosen(simulation, figure="6")
    return float(sum(row["above_viterbi"] for row in rows)) if rows else None


def _speed_ratio(simulation: Rows, _: Rows) -> float | None:
    """Smallest over the noise levels."""
    times = {(row["selector"], row["noise_m2"]): row["us_a_sequence"] for row in chosen(simulation, figure="6")}
    return min((us / times["viterbi", noise] for (name, noise), us in times.items() if name == "mcts"), default=None)


def _em_excess(simulation: Rows, _: Rows) -> float | None:
    """Share of wrong modes of EM, less that of the best other selector, all noise levels together."""
    rows = chosen(simulation, figure="6")
    others = dict.fromkeys(row["selector"] for row in rows if row["selector"] != "em")
    less = [mean(chosen(rows, selector=name), "wrong_more_than_em") for name in others]
    return max((-value for value in less if value is not None), default=None)


PROMISES = (
    Promise("simulation: sequences of which mcts' objective is above viterbi's", 0, "1", _above),
    Promise("simulation: mcts over viterbi, time", 1000, "x", _speed_ratio, floor=True),
    Promise("simulation: share of wrong modes, em more than any other", 0, "1", _em_excess),
    *(
        promise
        for name, where in (("data set 6", MAIN), (OTHERS_NAME, OTHERS))
        for promise in (
            Promise(f"{name}, joint: position error, nothing moved", 0.045, "m", _pose(where, 0.0, 0.0)),
            Promise(f"{name}, joint: position error from 0.2 m on", 0.052, "m", _pose(where, 0.2, 9.0)),
            Promise(f"{name}, joint: landmark error", 0.02, "m", _landmarks(where)),
            Promise(f"{name}, joint: exact set where nothing moved, and from 0.3 m on", 1.0, "share",
                    _still_or_far(where), floor=True),
            Promise(f"{name}, joint: exact set at 0.2 m", 0.8, "share", _exact(where, 0.2, 0.2), floor=True),
            Promise(f"{name}, joint: no worse than the static map", 1.0, "share",
                    _no_worse(where), floor=True),
            Promise(f"{name}, joint: {', '.join(KINDS)}: exact set, the least", 0.9, "share",
                    _found(where), floor=True),
            Promise(f"{name}, change during the run: found, time within 10 s", 1.0, "share",
                    _during("found", where), floor=True),
            Promise(f"{name}, change during the run: position error", 0.06, "m",
                    _during("pose_rmse_m", where)),
        )
    ),
    Promise("data set 6, group {14, 15, 19, 20}: exact, or reported as ambiguous", 0.9, "share", _gauge, floor=True),
    Promise(f"changes reported with {SURE:.0%} or more: probability above share of right ones", 0.05, "1",
            _calibration),
    *(
        Promise(f"{name}, slowest recording", limit, "x real time", _slowest(method), floor=True)
        for name, method, limit in (("viterbi and joint", ("viterbi", "joint"), 200), ("mcts", "mcts", 20))
    ),
    Promise("joint, data set 6: 99th percentile of a step", 20, "ms", _latency),
)  # fmt: skip
