"""Trajectories beside the tables, in the TUM format, and their error after the one alignment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evermap_score.episodes import FloatArray
from evermap_score.errors import ScoreError
from evermap_score.matching import Alignment, World
from evermap_score.metric import Metric, metric_of_rows, root_of_ratio


@dataclass(frozen=True)
class StampedPositions:
    """Positions of a robot.

    Attributes:
        stamp_s: increasing (n,).
        position_m: (n, 3).
    """

    stamp_s: FloatArray
    position_m: FloatArray


def read_tum(path: str | Path) -> StampedPositions:
    """Read the positions of a trajectory, `stamp x y z qx qy qz qw` a line; lines with '#' are comments.

    Raises:
        ScoreError: the file is missing, a line is not such a one, or stamps do not increase.
    """
    rows: list[list[float]] = []
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise ScoreError(f"cannot be read: {error.strerror}", path=path) from None
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            values = [float(word) for word in line.split()]
        except ValueError:
            values = []
        if len(values) != 8:
            raise ScoreError("not 'stamp x y z qx qy qz qw'", path=path, line=number)
        if rows and values[0] <= rows[-1][0]:
            raise ScoreError("stamps must increase", path=path, line=number)
        rows.append(values[:4])
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return StampedPositions(table[:, 0], table[:, 1:])


def find_trajectory(path: str | Path) -> Path | None:
    """Return the trajectory beside a table: `NAME.tum` beside `NAME.csv`, or `trajectory.tum` in a folder."""
    path = Path(path)
    beside = path / "trajectory.tum" if path.is_dir() else path.with_suffix(".tum")
    return beside if beside.is_file() else None


def trajectory_metrics(
    world: World, truth: StampedPositions | None, estimate: StampedPositions | None, alignment: Alignment
) -> list[Metric]:
    """Return the absolute trajectory error, the RMSE of positions, after the alignment by static landmarks.

    The estimate is interpolated linearly to the stamps of the truth where both are known. NaN without both.
    """
    rows: list[tuple[int, str, tuple[float, float]]] = []
    if truth is not None and estimate is not None and len(estimate.stamp_s):
        inside = (truth.stamp_s >= estimate.stamp_s[0]) & (truth.stamp_s <= estimate.stamp_s[-1])
        at_s = truth.stamp_s[inside]
        there = np.stack([np.interp(at_s, estimate.stamp_s, axis) for axis in estimate.position_m.T], axis=1)
        there = there @ alignment.rotation.T + alignment.translation_m
        error_m = (there - truth.position_m[inside])[:, : world.rules.dim]
        for stamp_s, squared in zip(at_s.tolist(), (error_m**2).sum(axis=1).tolist(), strict=True):
            rows.append((world.session_of(stamp_s), "", (squared, 1.0)))
    return [metric_of_rows("localisation/ate", "m", rows, 2, of_sums=root_of_ratio(0, 1))]
