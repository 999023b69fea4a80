"""What the clique filter with the learned detection model was to reach, beside what it did."""

from __future__ import annotations

from collections.abc import Sequence

from evermap.experiments.bateman2020_scores import Row
from evermap.experiments.bateman2020_settings import LEARNED, NOMINAL

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


def verdicts(rows: Sequence[Row]) -> list[Row]:
    """Every promise with what was measured; `measured` and `met` are None where the filter was not run."""
    learned = {(row["world"], row["sensor"]): row for row in rows if row["filter"] == LEARNED}
    out = []
    for where, promises in PROMISED.items():
        for metric, limit in promises.items():
            value = learned[where][metric] if where in learned else None
            ceiling = metric in CEILINGS
            met = None if value is None else value <= limit if ceiling else value >= limit
            bound = "at_most" if ceiling else "at_least"
            out.append(
                {"world": where[0], "sensor": where[1], "metric": metric, bound: limit, "measured": value, "met": met}
            )
    return out
