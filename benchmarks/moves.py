"""Moves of 5, 10 and 20 cm among landmarks that a sensor of 3 cm sees: how many are told, and what is told falsely.

    python -m benchmarks.moves                    # 8 buildings, 64 moves of each size
    python -m benchmarks.moves --worlds 1 --seed 9

A robot patrols a building in which nothing moves by itself, three sessions each; some landmarks are moved between them,
by one of the sizes in any direction, and stay. The readings of the others are left as they are, to the last bit. Only
what every session saw three times or more is moved. A move is found where its session or a later one tells of the
landmark, within an interval that holds the move; at once, where its own does. What is told of another landmark, or in
another interval, is false. The curve is of recall by the number of sightings, on the side of the move with fewer.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import evermap as em
from evermap.types import Landmarks, MapChange, Recording
from evermap_studies.nielsen2024.runs import poses_at
from evermap_studies.sim import BuildingConfig, ObjectClass, simulate_building
from evermap_studies.worlds.edited import edited

SIZES_M = (0.05, 0.10, 0.20)
SESSIONS, EACH = 3, 4
"""Sessions of a world, and moves of each size between two of them."""
FEWEST = 3
CLASSES = (ObjectClass("fixture", "wall", count=14, landmarks=(1, 1)), ObjectClass("post", count=46, landmarks=(1, 1)))
"""Everything is a landmark by itself: nothing else tells that it moved."""
CURVE = (FEWEST, 10, 30, 100, 1_000_000)
"""Bounds of bins of sightings."""


@dataclass(frozen=True, slots=True)
class Move:
    """A move that we made.

    Attributes:
        landmark_id, session: what moved, and which session was the first after it.
        by_m: (x, y).
        sightings: the fewer of those before and after, in the sessions on either side.
    """

    landmark_id: int
    session: int
    by_m: tuple[float, float]
    sightings: int

    @property
    def size_m(self) -> float:
        """Return how far."""
        return round(math.hypot(*self.by_m), 3)


def move_landmarks(
    seed: int, sessions: int = SESSIONS, each: int = EACH, sizes_m: Sequence[float] = SIZES_M
) -> tuple[list[Recording], list[Move]]:
    """Simulate a building, and move landmarks between its sessions; each at most once."""
    config = BuildingConfig(days=sessions, change_rate=0.0, classes=CLASSES)
    made, random = simulate_building(config, seed).sessions, np.random.default_rng([seed, 5])
    law = (config.sensor.range_slope, config.sensor.range_bearing, config.sensor.range_bearing2)
    true = made[0].true_landmarks
    assert true is not None
    position, moves = np.repeat(true.position_m[None], sessions, axis=0), list[Move]()
    seen = np.array([[np.count_nonzero(one.detections.landmark_id == k) for k in true.landmark_id] for one in made])
    left = random.permutation(np.flatnonzero((seen >= FEWEST).all(axis=0)))
    for session in range(1, sessions):
        some, left = left[: each * len(sizes_m)], left[each * len(sizes_m) :]
        for row, size_m, turn in zip(some, itertools.cycle(sizes_m), random.uniform(-np.pi, np.pi, len(some))):
            by_m = (float(size_m * np.cos(turn)), float(size_m * np.sin(turn)))
            position[session:, row] += by_m
            moves.append(
                Move(int(true.landmark_id[row]), session, by_m, int(seen[session - 1 : session + 1, row].min()))
            )
    recordings = []
    for one, now in zip(made, position, strict=True):
        assert one.truth is not None
        pose, after = poses_at(one.truth, one.frames.stamp_s), Landmarks.at(true.landmark_id, now)
        recordings.append(replace(edited(one, pose, true, after, -math.inf, law), truth=None, true_landmarks=None))
    return recordings, moves


def live(recordings: Sequence[Recording], moves: Sequence[Move]) -> dict[str, Any]:
    """Enter all sessions, and score what is told.

    Returns:
        `moves`, a row each; `false`, what is told though it did not happen: landmark, session, kind, probability;
        `found`, sessions that were; `sigma_m`, median of the standard deviations of the map's landmarks; `cpu_s`.
    """
    living, began, found = None, time.process_time(), 0
    told: dict[tuple[int, int], tuple[float, float]] = {}
    false = list[tuple[int, int, str, float]]()
    for number, recording in enumerate(recordings):
        session = em.run_session(recording, living, em.Config(living={"accept": "any"}))
        living, found = session.living, found + session.found
        for change in session.changes:
            for name in change.landmark_ids:
                move = next((one for one in moves if one.landmark_id == name and one.session <= number), None)
                if move is None or recordings[move.session].frames.stamp_s[-1] < change.stamp_from_s:
                    false.append((name, number, change.kind.value, round(change.probability, 3)))
                else:
                    off_m, squared = _off(change, move)
                    told.setdefault((name, number), (off_m, squared))
    assert living is not None
    rows = []
    for move in moves:
        when = [number for name, number in told if name == move.landmark_id]
        off_m, squared = told[move.landmark_id, when[0]] if when else (math.nan, math.nan)
        rows.append(
            {"size_m": move.size_m, "sightings": move.sightings, "found": bool(when),
             "at_once": move.session in when, "off_m": off_m, "squared": squared}
        )  # fmt: skip
    sigma = np.sqrt(np.trace(living.landmarks().covariance_m2, axis1=1, axis2=2) / 2.0)
    return {"moves": rows, "false": false, "found": found, "sigma_m": float(np.median(sigma)),
            "cpu_s": time.process_time() - began}  # fmt: skip


def _off(change: MapChange, move: Move) -> tuple[float, float]:
    """How far a told displacement is off [m], and in squared standard deviations; the map lies nearly as the truth."""
    told = np.array(change.displacement_m)
    if not change.displacement_covariance_m2 or not np.isfinite(told).all():
        return math.nan, math.nan
    error = float(np.hypot(*told)) - move.size_m  # of the length: the map is turned
    along = told / max(float(np.hypot(*told)), 1e-9)
    return abs(error), error**2 / float(along @ np.array(change.displacement_covariance_m2) @ along)


def summary(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return lines of recall by size and by sightings, and of what is false."""
    moves = [move for row in rows for move in row["moves"]]
    lines = ["| move [m] | moves | found | at once | " + " | ".join(f"{a}+ sightings" for a in CURVE[:-1])]
    lines[0] += " | length off [m], median | squared sigmas, median (expected .45) |"
    lines.append("|---|" + "---:|" * (len(CURVE) + 4))
    for size_m in sorted({move["size_m"] for move in moves}):
        mine = [move for move in moves if move["size_m"] == size_m]
        bins = [[one["found"] for one in mine if a <= one["sightings"] < b] for a, b in itertools.pairwise(CURVE)]
        share = [f"{np.mean(one):.2f} of {len(one)}" if one else "-" for one in bins]
        off, squared = (np.array([one[key] for one in mine]) for key in ("off_m", "squared"))
        known = np.isfinite(off)
        errors = [f"{np.median(off[known]):.3f}", f"{np.median(squared[known]):.2f}"] if known.any() else ["-", "-"]
        means = [f"{np.mean([one[key] for one in mine]):.2f}" for key in ("found", "at_once")]
        lines.append("| " + " | ".join([f"{size_m:.2f}", str(len(mine)), *means, *share, *errors]) + " |")
    false = [one for row in rows for one in row["false"]]
    sigma, cpu_s = (float(np.mean([row[key] for row in rows])) for key in ("sigma_m", "cpu_s"))
    return [*lines, f"false: {len(false)}; landmarks known to {sigma:.3f} m; {cpu_s:.1f} CPU s a world"]


def main() -> None:
    """Print a line of each world, and the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=8)
    parser.add_argument("--seed", type=int, default=500)
    parser.add_argument("--each", type=int, default=EACH, help="moves of each size between two sessions")
    said, rows = parser.parse_args(), list[dict[str, Any]]()
    for seed in range(said.seed, said.seed + said.worlds):
        rows.append(live(*move_landmarks(seed, each=said.each)))
        found = [sum(one["found"] for one in rows[-1]["moves"] if one["size_m"] == size) for size in SIZES_M]
        print(json.dumps({"seed": seed, "found": found, "sessions": rows[-1]["found"], "false": rows[-1]["false"]}),
              flush=True)  # fmt: skip
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main()
