"""What the clique filter with the learned detection model was to reach, beside what it did."""

from __future__ import annotations

from collections.abc import Sequence

from evermap_studies.bateman2020.scores import OWN, Row
from evermap_studies.bateman2020.settings import LEARNED, NOMINAL, ORACLE, WARM

CEILINGS = ("brier", "delay_mean")
PROMISED: dict[tuple[str, str], dict[str, float]] = {
    (NOMINAL, "lidar"): {"accuracy": 0.997, "survival_ratio": 0.98, "brier": 0.002, "delay_mean": 2.0},
    (NOMINAL, "camera"): {"accuracy": 0.993, "survival_ratio": 0.98, "brier": 0.005, "delay_mean": 2.0},
    ("angle60", "lidar"): {"accuracy": 0.990, "survival_ratio": 0.95},
    ("range04", "lidar"): {"accuracy": 0.987, "survival_ratio": 0.93},
    ("occlusion", "lidar"): {"accuracy": 0.982, "survival_ratio": 0.93},
    ("false-alarms", "lidar"): {"accuracy": 0.990, "survival_ratio": 0.95},
    ("pose-noise", "lidar"): {"accuracy": 0.995, "survival_ratio": 0.96},
}
"""By world and sensor, one configuration for all: at most for `CEILINGS`, else at least."""


JUDGED: dict[str, tuple[str, str]] = {
    "learned": (LEARNED, ""),
    "learned, own decisions": (LEARNED, OWN),
    "learned-warm, own decisions": (WARM, OWN),
    "oracle": (ORACLE, ""),
    "oracle, own decisions": (ORACLE, OWN),
}
"""By column of the table: the filter, and what stands before the names of its scores."""


def verdicts(rows: Sequence[Row]) -> list[Row]:
    """Every promise with what was measured; None where a filter was not run.

    The oracle knows all probabilities of its world: where it fails, the promise cannot be kept there.
    """
    found = {(row["world"], row["sensor"], row["filter"]): row for row in rows}
    out = []
    for where, promises in PROMISED.items():
        for metric, limit in promises.items():
            ceiling = metric in CEILINGS
            measured, met = {}, {}
            for column, (name, decisions) in JUDGED.items():
                row = found.get((*where, name))
                value = None if row is None else row[decisions + metric]
                measured[column] = value
                met[column] = None if value is None else value <= limit if ceiling else value >= limit
            bound = "at_most" if ceiling else "at_least"
            world, sensor = where
            out.append(
                {"world": world, "sensor": sensor, "metric": metric, bound: limit, "measured": measured, "met": met}
            )
    return out
