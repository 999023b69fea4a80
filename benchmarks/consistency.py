"""Whether covariances are honest, on recordings with a truth and in worlds whose errors are known.

python -m benchmarks.consistency [PART ...]

Normalised squared errors over what is expected, so 1 where covariances are right: of poses and of landmarks, typical,
and in the frame that covariances hold in (`goldens.scores.typical_nees`); of detections (NIS). And the correlation of
the NIS from one sighting of a landmark to the next, 0 where errors are independent. Parts: see `PARTS`.

In the part `maps` a map is given that is drawn: as far off the key as it states (`SIGMA_MAP_M`). The key itself would
not do: such a map is better than it states, and so are poses in it. Keys may be off as well (`KEYS_M`).
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
from benchmarks.goldens.recordings import RATE_HZ as SPATIAL_HZ
from benchmarks.goldens.recordings import as_map, case
from benchmarks.goldens.scores import typical_nees
from benchmarks.starloc import corrected
from evermap.config import Config
from evermap.io import read_recording
from evermap.io.mrclam import read_mrclam
from evermap.metrics.summary import RATE_HZ, compare_with_truth
from evermap.types import AnyRecording, Landmarks, SensorKind, or_nan
from evermap_studies.worlds.lasers import LaserWorld, simulate_laser
from evermap_studies.worlds.robots import draw_robot, simulate_robot

SIGMA_MAP_M = 0.02
KEYS_M = {"starloc": 0.012}
"""Standard deviations of keys: root of the mean product of the errors of a landmark in two sessions of a room, in which
the key was the map (.008 to .014 by the pair, of loop-2d_s1 and s2, loop-3d_s1 and s2)."""
CASES = ("c_po", "c_latency", "c_midmove", "f_uwb_moved_far")
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
                recording = read_recording(plain)
                assert recording.true_landmarks is not None
                yield f"starloc {session}", replace(recording, true_landmarks=corrected(recording.true_landmarks))
    elif part == "ycbv":
        for path in sorted((FOLDER / "ycbv").glob("0*")):
            yield f"ycbv {path.name}", read_recording(path)
    elif part == "maps":
        for of in ("mrclam", "starloc"):
            yield from recordings(of)
        for name in CASES:
            yield f"case {name}", case(name, data=FOLDER)
    elif part == "tagslam":
        yield "tagslam test_11", read_recording(FOLDER / "tagslam" / "test_11")


PARTS = ("lasers", "robots", "mrclam", "starloc", "ycbv", "tagslam", "maps")


def draw_map(name: str, recording: AnyRecording, seed: int = 0) -> tuple[AnyRecording, Landmarks]:
    """Return a recording whose key is as uncertain as it is, and a map that is as far off it as it states."""
    key, off = recording.true_landmarks, np.random.default_rng(seed)
    assert key is not None
    own = KEYS_M.get(name.partition(" ")[0], 0.0)
    drawn = as_map(key, SIGMA_MAP_M)
    drawn = replace(drawn, position_m=drawn.position_m + SIGMA_MAP_M * off.normal(size=drawn.position_m.shape))
    unsure = replace(key, covariance_m2=key.covariance_m2 + own**2 * np.eye(key.position_m.shape[1]))
    return replace(recording, true_landmarks=unsure), drawn


def score(recording: AnyRecording, config: Config, prior: Landmarks | None = None) -> dict[str, float]:
    """Return errors and what is printed of them, by names of columns."""
    result = em.run_slam(recording, config, prior_map=prior)
    rate_hz = SPATIAL_HZ if recording.dim == 3 else RATE_HZ
    found = compare_with_truth(recording, result, rate_hz=rate_hz)
    row = dict.fromkeys(COLUMNS, math.nan)
    row["pose [m]"] = or_nan(found.poses and found.poses.rmse_m)
    row["landmark [m]"] = or_nan(found.landmarks and found.landmarks.rmse_m)
    nees = typical_nees(recording, result, rate_hz=rate_hz, in_map=prior is not None)
    row["poses"], row["landmarks"] = map(or_nan, nees)
    if found.nis.mean is not None:
        row["nis"] = found.nis.mean / 2.0
    if found.nis.lag1 is not None:
        row["lag 1"] = found.nis.lag1
    bias = [one for one in result.parameters if one.name == "range_bias_m"]
    if bias and not bias[0].fixed:
        row["bias [m]"], row["+-"] = bias[0].value, bias[0].sigma
    return row


COLUMNS = ("pose [m]", "landmark [m]", "poses", "landmarks", "nis", "lag 1", "bias [m]", "+-")


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
                known, prior = draw_map(name, own) if part == "maps" else (own, None)
                called = f"maps {name}" if part == "maps" else name + variant
                row = rows[called] = score(known, config, prior)
                cells = ["–" if math.isnan(row[key]) else f"{row[key]:.4f}" for key in COLUMNS]
                say(f"| {called} | " + " | ".join(cells) + " |")
    for part, some in _by_part(rows).items():
        medians = {key: float(np.nanmedian([row[key] for row in some])) for key in ("poses", "landmarks")}
        say(f"{part}: median of recordings " + ", ".join(f"{key} {value:.2f}" for key, value in medians.items()))
    return rows


def _by_part(rows: dict[str, dict[str, float]]) -> dict[str, list[dict[str, float]]]:
    """Rows by the kind of recording, which its name begins with."""
    kinds: dict[str, list[dict[str, float]]] = {
        name: [] for name in ("mrclam", "starloc", "ycbv", "tagslam", "robot", "maps")
    }
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
