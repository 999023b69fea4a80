"""Table 5.1 of Bateman 2020, an earlier trial of it, and which of its orderings hold in ours."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from evermap_studies.bateman2020.scores import Row, Scored
from evermap_studies.bateman2020.settings import IN_THE_TABLE, OF_THE_THESIS, READINGS, SUPPRESSION

LIMIT = 2.0
"""Standard errors of the difference within which ours says nothing about an ordering."""

_THESIS = {
    ("lidar", "accuracy"): (0.705, 0.616, 0.857, 0.948, 0.734, 0.612, 0.979, 0.988),
    ("lidar", "survival_ratio"): (0.185, 0.011, 0.096, 0.378, 0.259, 0.015, 0.564, 0.819),
    ("camera", "accuracy"): (0.672, 0.587, 0.793, 0.844, 0.772, 0.637, 0.935, 0.910),
    ("camera", "survival_ratio"): (0.254, 0.025, 0.179, 0.170, 0.424, 0.015, 0.410, 0.293),
}
_TRIAL = {
    ("lidar", "accuracy"): (0.703, 0.585, 0.856, 0.948, 0.711, 0.586, 0.968, 0.962),
    ("lidar", "survival_ratio"): (0.190, 0.030, 0.094, 0.335, 0.247, 0.065, 0.705, 0.620),
    ("camera", "accuracy"): (0.704, 0.577, 0.819, 0.887, 0.713, 0.581, 0.918, 0.910),
    ("camera", "survival_ratio"): (0.278, 0.032, 0.129, 0.229, 0.362, 0.081, 0.489, 0.426),
}


def _by_filter(table: Mapping[tuple[str, str], Sequence[float]]) -> dict[tuple[str, str, str], float]:
    return {
        (sensor, name, metric): value
        for (sensor, metric), values in table.items()
        for name, value in zip(IN_THE_TABLE, values, strict=True)
    }


THESIS = _by_filter(_THESIS)
"""By sensor, filter and metric."""
TRIAL = _by_filter(_TRIAL)
"""The same of an earlier trial with evermap's configuration but other code: where a rerun may be expected to land."""


def pairs() -> Iterator[tuple[str, str]]:
    """Filters that are compared: all of the same kind, and each with and without suppression."""
    for tail in ("", SUPPRESSION):
        yield from combinations((name + tail for name in OF_THE_THESIS), 2)
    yield from ((name, name + SUPPRESSION) for name in OF_THE_THESIS)


def orderings(scored: Sequence[Scored]) -> list[Row]:
    """Every pair that the thesis orders, sensor by sensor and metric by metric, with what ours says.

    The standard error is that of the difference, over the same resampled runs. The thesis tells none of its own: its
    orderings are taken at their word.
    """
    known = {(one.row["world"], one.row["sensor"], one.row["filter"]): one for one in scored}
    return [
        _ordering(world, sensor, metric, a, b, known)
        for world in READINGS
        for sensor, metric in _THESIS
        for a, b in pairs()
        if (world, sensor, a) in known and (world, sensor, b) in known
    ]


def _ordering(
    world: str, sensor: str, metric: str, a: str, b: str, known: Mapping[tuple[str, str, str], Scored]
) -> Row:
    worse, better = sorted((a, b), key=lambda name: THESIS[sensor, name, metric])
    low, high = known[world, sensor, worse], known[world, sensor, better]
    difference = high.row[metric] - low.row[metric]
    error = float(np.std(high.draws[metric] - low.draws[metric], ddof=1))
    clear = abs(difference) > LIMIT * error
    return {
        "world": world,
        "sensor": sensor,
        "metric": metric,
        "worse": worse,
        "better": better,
        "thesis": THESIS[sensor, better, metric] - THESIS[sensor, worse, metric],
        "ours": difference,
        "ours_se": error,
        "verdict": "open" if not clear else "holds" if difference > 0.0 else "reversed",
    }
