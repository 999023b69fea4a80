"""Whether covariances are honest, on recordings with a truth and in worlds whose errors are known.

python -m benchmarks.consistency [PART ...]

Normalised squared errors over what is expected, so 1 where covariances are right: of poses and of landmarks, as they
stand from the first pose on, relative to which covariances are (aligned, poses near it have errors that they cannot
have); of detections (NIS). And the correlation of the NIS from one sighting of a
landmark to the next, 0 where errors are independent. Parts: see `PARTS`.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import evermap as em
from evermap.config import Config
from evermap.io import read_recording
from evermap.io.mrclam import read_mrclam
from evermap.metrics.summary import compare_with_truth
from evermap.types import AnyRecording, SensorKind
from evermap_studies.worlds.lasers import LaserWorld, simulate_laser
from evermap_studies.worlds.robots import draw_robot, simulate_robot

FOLDER = Path(__file__).resolve().parents[1].parent / "shared" / "data"
ANGLE = math.radians(0.25)
LASERS: dict[str, LaserWorld] = {
    "clean": LaserWorld(),
    "odometry 3 % wrong": LaserWorld(scale=0.97, turn_scale=1.03),
    "visits err alike": LaserWorld(lasting_m=0.02, lasting_rad=ANGLE),
    "correlated for 3 s": LaserWorld(lasting_m=0.03, lasting_rad=ANGLE, lasting_s=3.0),
    "half view, visits err alike": LaserWorld(view_rad=math.pi, inside=0.0, lasting_m=0.02, lasting_rad=ANGLE),
    "thick poles": LaserWorld(radius_m=0.06, radius_spread_m=0.03),
    "late": LaserWorld(delay_s=0.1),
    "scans of 0.1 s": LaserWorld(scan_s=0.1),
    "rounded to 5 cm": LaserWorld(quantum_m=0.05),
    "slips": LaserWorld(slips=100.0, noise=0.03),
    "ranges bend": LaserWorld(incidence_m=0.03),
    "wrong ids": LaserWorld(p_wrong=0.02),
    "long, all of it": LaserWorld(duration_s=900.0, lasting_m=0.02, lasting_rad=ANGLE, scan_s=0.1, scale=0.98),
}
"""Worlds of an accurate sensor; what is wrong in each."""
SEEDS = (0, 1)


def recordings(part: str) -> Iterator[tuple[str, AnyRecording]]:
    """Yield the recordings of a part and their names."""
    if part == "lasers":
        for name, world in LASERS.items():
            for seed in SEEDS:
                yield f"{name}, {seed}", simulate_laser(world, seed)
    elif part == "robots":
        for seed in range(8):
            yield f"robot {seed}", simulate_robot(draw_robot(seed), seed)
    elif part == "mrclam":
        for robot in range(1, 6):
            yield f"mrclam 6, robot {robot}", read_mrclam(FOLDER / "mrclam" / "MRCLAM_Dataset6.zip", robot)
    elif part == "starloc":
        convert = FOLDER / "starloc" / "starloc_to_plain.py"
        for session in sorted(path.name for path in (FOLDER / "starloc").iterdir() if path.name[-3:] in ("_s1", "_s2")):
            with tempfile.TemporaryDirectory() as plain:
                command = [sys.executable, str(convert), str(FOLDER / "starloc"), session, plain, "--truth"]
                subprocess.run(command, check=True)
                yield f"starloc {session}", read_recording(plain)
    elif part == "ycbv":
        for path in sorted((FOLDER / "ycbv").glob("0*")):
            yield f"ycbv {path.name}", read_recording(path)
    elif part == "tagslam":
        yield "tagslam test_11", read_recording(FOLDER / "tagslam" / "test_11")


PARTS = ("lasers", "robots", "mrclam", "starloc", "ycbv", "tagslam")


def score(recording: AnyRecording, config: Config) -> dict[str, float]:
    """Return errors and what is printed of them, by names of columns."""
    result = em.run_slam(recording, config)
    found = compare_with_truth(recording, result)
    row = dict.fromkeys(COLUMNS, math.nan)
    if found.poses is not None:
        row["pose [m]"] = found.poses.rmse_m
        row["aligned"] = float(np.nanmean(found.poses.nees)) / found.poses.dof
        if found.poses.anchored_nees is not None:
            row["poses"] = float(np.nanmean(found.poses.anchored_nees)) / found.poses.dof
    if found.landmarks is not None and found.landmarks.scored.any():
        row["landmark [m]"] = found.landmarks.rmse_m or math.nan
        some = found.landmarks_anchored or found.landmarks
        row["landmarks"] = float(np.nanmean(some.nees[some.scored])) / some.dof
    if found.nis.mean is not None:
        row["nis"] = found.nis.mean / 2.0
    if found.nis.lag1 is not None:
        row["lag 1"] = found.nis.lag1
    bias = [one for one in result.parameters if one.name == "range_bias_m"]
    if bias and not bias[0].fixed:
        row["bias [m]"], row["+-"] = bias[0].value, bias[0].sigma
    return row


COLUMNS = ("pose [m]", "landmark [m]", "poses", "landmarks", "aligned", "nis", "lag 1", "bias [m]", "+-")


def variants(part: str, recording: AnyRecording) -> dict[str, tuple[AnyRecording, Config]]:
    """Return how a recording is run: calibrated; lasers plain, too, and with their kind stated."""
    usual = Config()
    if part != "lasers" or recording.dim == 3:
        return {"": (recording, usual)}
    laser = replace(recording, sensor=replace(recording.sensor, kind=SensorKind.LASER))
    plain = Config.model_validate({"slam": {"sensor_model": "plain"}})
    return {" plain": (recording, plain), "": (recording, usual), " kind": (laser, usual)}


def run(parts: tuple[str, ...] = PARTS, say: Callable[[str], Any] = print) -> dict[str, dict[str, float]]:
    """Score all recordings of some parts; a line of each is given to `say`."""
    rows: dict[str, dict[str, float]] = {}
    say("| recording | " + " | ".join(COLUMNS) + " |\n|---|" + "---:|" * len(COLUMNS))
    for part in parts:
        for name, recording in recordings(part):
            for variant, (own, config) in variants(part, recording).items():
                row = rows[name + variant] = score(own, config)
                cells = ["–" if math.isnan(row[key]) else f"{row[key]:.4f}" for key in COLUMNS]
                say(f"| {name}{variant} | " + " | ".join(cells) + " |")
    for part, some in _by_part(rows).items():
        medians = {key: float(np.nanmedian([row[key] for row in some])) for key in ("poses", "landmarks", "aligned")}
        say(f"{part}: median of recordings " + ", ".join(f"{key} {value:.2f}" for key, value in medians.items()))
    return rows


def _by_part(rows: dict[str, dict[str, float]]) -> dict[str, list[dict[str, float]]]:
    """Rows by the kind of recording, which its name begins with."""
    kinds: dict[str, list[dict[str, float]]] = {"mrclam": [], "starloc": [], "ycbv": [], "tagslam": [], "robot": []}
    for name, row in rows.items():
        if name.split()[0] in kinds:
            kinds[name.split()[0]].append(row)
    lasers = {name: row for name, row in rows.items() if name.split()[0] not in kinds}
    ends = {"plain": " plain", "kind stated": " kind"}
    for called, end in ends.items():
        kinds[f"lasers, {called}"] = [row for name, row in lasers.items() if name.endswith(end)]
    kinds["lasers"] = [row for name, row in lasers.items() if not name.endswith(tuple(ends.values()))]
    return {name: some for name, some in kinds.items() if some}


if __name__ == "__main__":
    run(tuple(sys.argv[1:]) or PARTS, lambda line: print(line, flush=True))
