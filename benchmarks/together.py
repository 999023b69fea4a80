"""Robots that see each other, solved together: what do they gain over each alone?

The robots of MRCLAM recordings, from an unknown map: each alone; as one problem that shares landmarks; and with what
they measured of each other. Errors after the alignment of each robot's own path, landmarks after their own.

    python -m benchmarks.together shared/data/mrclam/MRCLAM_Dataset6.zip ...
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from evermap.geometry import se2
from evermap.io import list_robots, read_planar
from evermap.metrics.trajectory import align_points, evaluate_trajectory
from evermap.pipeline import run_slam, run_together
from evermap.types import FloatArray, Recording, SlamResult

HEAD = """| recording | robots | position [m] | heading [degrees] | NEES | landmarks [m] |
|---|---|---:|---:|---:|---:|"""


def scores(recording: Recording, result: SlamResult) -> list[float]:
    """Return RMSE of position [m] and heading [degrees], mean NEES, RMSE of landmarks [m]; nan without truth."""
    told, truth = [np.nan] * 3, recording.true_landmarks
    if recording.truth is not None:
        errors = evaluate_trajectory(result.trajectory, recording.truth, rate_hz=2.0)
        heading = np.degrees(np.sqrt(np.mean(errors.heading_error_rad**2)))
        told = [float(np.sqrt(np.mean(errors.position_error_m**2))), float(heading), float(np.nanmean(errors.nees))]
    if truth is None:
        return [*told, np.nan]
    _, mine, theirs = np.intersect1d(result.landmarks.landmark_id, truth.landmark_id, return_indices=True)
    at, true = result.landmarks.position_m[mine], truth.position_m[theirs]
    away = se2.transform(align_points(at, true), at) - true
    return [*told, float(np.sqrt(np.mean(np.sum(away**2, axis=1))))]


def ways(recordings: Mapping[int, Recording]) -> dict[str, FloatArray]:
    """Return (R, 4) scores of the robots in each way."""
    blind = {number: replace(recording, robot_sightings=None) for number, recording in recordings.items()}
    results = {
        "each alone": {number: run_slam(recording) for number, recording in recordings.items()},
        "one map": run_together(blind),
        "one map, and each other": run_together(recordings),
    }
    return {
        name: np.array([scores(recordings[number], result) for number, result in found.items()])
        for name, found in results.items()
    }


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", help="each with several robots")
    print(HEAD)
    for path in parser.parse_args().recordings:
        recordings = {number: read_planar(path, robot=number) for number in list_robots(path)}
        for name, found in ways(recordings).items():
            known = ~np.isnan(found).all(axis=0)
            mean = np.where(known, np.nanmean(np.where(known, found, 0.0), axis=0), np.nan)
            row = " | ".join(
                "–" if np.isnan(one) else f"{one:.{n}f}" for one, n in zip(mean, (3, 2, 1, 3), strict=True)
            )
            print(f"| {path.rsplit('/', 1)[-1]} | {name} | {row} |", flush=True)


if __name__ == "__main__":
    main()
