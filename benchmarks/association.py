"""Landmarks without identities beside the same recordings with them: who is who, how many, and how far off the poses.

Precision and recall are those of pairs: of two detections that are given to one landmark, and of two that are of one.
Truth of association is the recording's own identities.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import evermap as em
from evermap.config import Config
from evermap.errors import EvermapError
from evermap.io import read_recording
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.slam.association.identify import identified
from evermap.slam.intake import beliefs
from evermap.types import UNKNOWN, IntArray, Recording, SlamResult, Trajectory
from evermap_studies.sim.park import simulate_park

FOLDER = Path(__file__).resolve().parents[1].parent / "shared" / "data"
PARKS = 3
DATASETS = (3, 6)
"""Those with true poses."""
ROBOTS = (1, 2, 3, 4, 5)
METRICS: dict[str, tuple[str, float, str]] = {
    "association_dlr_precision": ("higher", 0.01, "pairs of detections given to one landmark that are of one, DLR"),
    "association_dlr_recall": ("higher", 0.02, "pairs of detections of one landmark that are given to one, DLR"),
    "association_park_recall": ("higher", 0.1, "the same in the simulated parks, on average"),
}
RATE_HZ = 2.0


@dataclass(frozen=True, slots=True)
class Score:
    """One recording: pairs, landmarks found and true, position errors [m] without and with identities, CPU [s]."""

    name: str
    precision: float
    recall: float
    found: int
    true: int
    without_m: float
    with_m: float
    association_s: float
    all_s: float

    @property
    def ratio(self) -> float:
        """Position error without identities over that with them; nan where the latter is the reference."""
        return self.without_m / self.with_m if self.with_m > 0.0 else math.nan


def run(folder: Path = FOLDER, *, parks: int = PARKS) -> tuple[dict[str, float], dict[str, Any]]:
    """Measure all recordings."""
    rows = [score(recording) for recording in recordings(folder, parks=parks)]
    of = {kind: [row for row in rows if row.name.lower().startswith(kind)] for kind in ("dlr", "park")}
    metrics = {}
    if of["dlr"]:
        metrics["association_dlr_precision"] = of["dlr"][0].precision
        metrics["association_dlr_recall"] = of["dlr"][0].recall
    if of["park"]:
        metrics["association_park_recall"] = float(np.mean([row.recall for row in of["park"]]))
    return metrics, {"rows": [asdict(row) for row in rows]}


def recordings(folder: Path = FOLDER, *, parks: int = PARKS) -> Iterator[Recording]:
    """Read or simulate what is scored."""
    for seed in range(parks):
        yield simulate_park(seed=seed)
    if (folder / "dlr").is_dir():
        yield _planar(folder / "dlr")
    for dataset, robot in itertools.product(DATASETS, ROBOTS):
        path = folder / "mrclam" / f"MRCLAM_Dataset{dataset}.zip"
        if path.is_file():
            try:
                yield _planar(path, robot=robot)
            except EvermapError:  # one robot's odometry is missing
                continue


def score(recording: Recording, config: Config | None = None) -> Score:
    """Run a recording with and without its identities."""
    config = config or Config()
    named = em.run_slam(recording, config)
    assert isinstance(recording, Recording)
    began = time.process_time()
    found = identified(recording, *beliefs(recording.sensor, config.slam))
    associated = time.process_time()
    nameless = em.run_slam(found, config)
    ended = time.process_time()
    precision, recall = pairwise(found.detections.landmark_id, recording.detections.landmark_id)
    given = found.detections.landmark_id
    true = recording.detections.landmark_id
    truth = _truth(recording, named)
    return Score(
        recording.name,
        precision,
        recall,
        len(np.unique(given[given != UNKNOWN])),
        len(np.unique(true[true != UNKNOWN])),
        evaluate_trajectory(nameless.trajectory, truth, rate_hz=RATE_HZ).rmse_m,
        evaluate_trajectory(named.trajectory, truth, rate_hz=RATE_HZ).rmse_m,
        associated - began,
        ended - began,
    )


def pairwise(found: IntArray, true: IntArray) -> tuple[float, float]:
    """Return precision and recall over pairs of detections (M,); `UNKNOWN` is in no pair."""

    def pairs(of: IntArray) -> float:
        count = np.unique(of, return_counts=True)[1].astype(float)
        return float((count * (count - 1.0) / 2.0).sum())

    given, real = found != UNKNOWN, true != UNKNOWN
    both = given & real
    agreed = pairs(np.unique(found[both], return_inverse=True)[1] * (int(true.max()) + 1) + true[both])
    return agreed / max(pairs(found[given]), 1.0), agreed / max(pairs(true[real]), 1.0)


def as_markdown(shown: dict[str, Any]) -> str:
    """Return the table."""
    lines = [
        "| recording | precision | recall | landmarks (true) | position error without / with [m] | ratio | CPU [s] |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [_line(Score(**row)) for row in shown["rows"]]
    return "\n".join(lines)


def _line(row: Score) -> str:
    return (
        f"| {row.name} | {row.precision:.3f} | {row.recall:.3f} | {row.found} ({row.true}) "
        f"| {row.without_m:.3f} / {row.with_m:.3f} | {row.ratio:.2f} | {row.association_s:.1f} of {row.all_s:.1f} |"
    )


def _planar(path: Path, **options: Any) -> Recording:
    recording = read_recording(path, **options)
    assert isinstance(recording, Recording)
    return recording


def _truth(recording: Recording, named: SlamResult) -> Trajectory:
    """The truth of the poses, or what the identities lead to."""
    if recording.truth is not None:
        return recording.truth
    return replace(named.trajectory, frame="truth")


def main(names: Sequence[str] = ()) -> None:
    """Print one line as soon as it is known; names are beginnings of those wanted."""
    for recording in recordings():
        if not names or recording.name.startswith(tuple(names)):
            print(_line(score(recording)), flush=True)


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
