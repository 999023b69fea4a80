"""A planar robot's bags against the tables of the same days: ratio of their errors, points and tags.

`python -m benchmarks.floor [--days N]` prints, for each day of a made building, the error of the trajectory by tables
[m], and that by bags of points (`Detection3DArray`) and of tags (`ArucoMarkers`, with orientations) as shares of it;
then the ratios of the root mean squares. The bags are written by the tests' writer from the tables' own readings.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

import evermap as em
from evermap.geometry import se3
from evermap.io import read_recording
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.types import AnyRecording, FloatArray, Recording
from evermap_studies.sim import BuildingConfig, simulate_building

SEED = 11
PATROL_S = 60.0
SIGMA_RAD = 0.05
"""Standard deviation of the orientations of tags."""


def error_m(recording: AnyRecording, day: Recording) -> float:
    """Return the root mean square error of the trajectory of a day."""
    assert day.truth is not None
    errors = evaluate_trajectory(em.run_slam(recording).trajectory, day.truth)
    assert errors is not None
    return errors.rmse_m


class Orientations:
    """Orientations of tags that stand still, as a tilted camera measures them."""

    def __init__(self, day: Recording, eye: FloatArray) -> None:
        assert day.truth is not None
        x, y, heading = day.truth.pose_world_robot.T
        columns = (x, y, np.unwrap(heading))
        at = np.column_stack([np.interp(day.frames.stamp_s, day.truth.stamp_s, column) for column in columns])
        self.random = np.random.default_rng(SEED)
        self.eye = se3.compose(se3.from_plane(at), eye)
        self.landmark_id = day.detections.landmark_id

    def __call__(self, frame: int, row: int) -> FloatArray:
        """Return the quaternion (4,) of the tag of a detection in its frame."""
        heading = np.random.default_rng(int(self.landmark_id[row])).uniform(-3.0, 3.0)
        tag = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, heading]))
        seen = se3.compose(se3.inverse(self.eye[frame]), tag)
        noise = np.append(np.zeros(3), self.random.normal(0.0, SIGMA_RAD, 3))
        return np.asarray(se3.compose(seen, se3.exp(noise))[3:])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--days", type=int, default=20)
    n_days = parser.parse_args().days
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "io"))
    from bags import TILTED, write_floor  # type: ignore[import-not-found, unused-ignore]

    errors = []
    print("day  tables [m]  points  tags")
    with tempfile.TemporaryDirectory() as folder:
        for number, day in enumerate(
            simulate_building(BuildingConfig(days=n_days, patrol_s=PATROL_S), seed=SEED).sessions
        ):
            points = write_floor(Path(folder) / f"points{number}", day)
            tags = write_floor(Path(folder) / f"tags{number}", day, kind="tags", rotation=Orientations(day, TILTED))
            row = [error_m(recording, day) for recording in (day, read_recording(points), read_recording(tags))]
            errors.append(row)
            print(f"{number:3d}  {row[0]:10.4f}  {row[1] / row[0]:6.3f}  {row[2] / row[0]:5.3f}", flush=True)
    whole = np.sqrt(np.mean(np.square(errors), axis=0))
    print(f"all  {whole[0]:10.4f}  {whole[1] / whole[0]:6.3f}  {whole[2] / whole[0]:5.3f}")


if __name__ == "__main__":
    main()
