"""Worlds in which landmarks without identities are hard to tell apart, harsher than those that constants were set on.

python -m benchmarks.association harsh

And columns that say what landmarks are like, good ones and bad ones (`python -m benchmarks.association columns`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from evermap.geometry import se2
from evermap.types import (
    UNKNOWN,
    AnyRecordingT,
    Detections,
    FloatArray,
    Frames,
    IntArray,
    Landmarks,
    Odometry,
    Recording,
    Sensor,
    Trajectory,
)
from evermap_studies.sim.park import ParkConfig, simulate_park

PARKS: dict[str, tuple[dict[str, Any], tuple[int, ...]]] = {
    "odometry two to three times as wrong": (
        {"steering_bias_rad": 0.006, "steering_walk_rad": 0.0015, "speed_scale": 1.06, "steering_noise_rad": 0.02},
        (33, 34, 35, 36, 40),
    ),
    "40 cars, four times the ghosts": ({"n_cars": 40, "p_ghost": 0.2}, (1, 2, 3)),
    "half the field of view": ({"half_view_rad": math.pi / 4.0}, (1, 2)),
    "80 trees": ({"n_trees": 80}, (1, 2)),
    "300 trees": ({"n_trees": 300}, (3,)),
    "another reach": ({"reach_m": 25.0, "p_detect": 0.7}, (2, 3)),
}
AISLES, GAP_M, LENGTH_M, PER_AISLE = 8, 6.0, 40.0, 20
RATE_HZ, RANGE_M, HALF_VIEW_RAD, P_DETECT = 5.0, 10.0, 2.0, 0.7


def harsh_worlds() -> Iterator[Recording]:
    """Simulate parks of other cars and trees, then aisles that are copies of one another."""
    for name, (settings, seeds) in PARKS.items():
        for seed in seeds:
            yield replace(simulate_park(ParkConfig(**settings), seed=seed), name=f"park, {name}, seed {seed}")
    for seed in (0, 1):
        yield simulate_copied_aisles(seed)


def simulate_copied_aisles(seed: int) -> Recording:
    """Drive twice through aisles with the same pattern of landmarks in each, which only those in the aisle see."""
    rng = np.random.default_rng([seed, 5])
    side = 0.5 * GAP_M - 1.0
    pattern = np.column_stack(
        [
            rng.uniform(0.0, LENGTH_M, PER_AISLE),
            rng.choice([-side, side], PER_AISLE) + rng.normal(0.0, 0.2, PER_AISLE),
        ]
    )
    places = np.concatenate([pattern + [0.0, k * GAP_M] for k in range(AISLES)])
    aisle = np.repeat(np.arange(AISLES), PER_AISLE)
    pose, forward, turn = _drive()
    stamp_s = np.arange(len(pose)) / RATE_HZ
    white = rng.normal(size=(len(pose), 2))
    odometry = Odometry(
        stamp_s,
        forward * (1.0 + 0.01 * rng.normal() + 0.03 * white[:, 0]),
        np.zeros(len(pose)),
        turn * (1.0 + 0.01 * rng.normal()) + 1e-4 * rng.normal() + 0.01 * white[:, 1],
    )
    away = se2.transform(se2.inverse(pose)[:, None], places[None])
    range_m, bearing = np.hypot(away[..., 0], away[..., 1]), np.arctan2(away[..., 1], away[..., 0])
    row = np.round(pose[:, 1] / GAP_M)
    within = (pose[:, 0] > -1.0) & (pose[:, 0] < LENGTH_M + 1.0) & (np.abs(pose[:, 1] / GAP_M - row) < 0.2)
    seen = (range_m < RANGE_M) & (np.abs(bearing) < HALF_VIEW_RAD)
    seen &= (aisle[None] == np.where(within, row, -1)[:, None]) & (rng.random(seen.shape) < P_DETECT)
    frame, which = np.nonzero(seen)
    noise, unknown = rng.normal(size=(len(frame), 2)) * [0.03, 0.01], np.full(len(frame), np.nan)
    start = se2.inverse(pose[0])
    return Recording(
        name=f"aisles that are copies, seed {seed}",
        odometry=odometry,
        frames=Frames(stamp_s),
        detections=Detections(
            frame=frame,
            landmark_id=which,
            range_m=np.maximum(range_m[seen] + noise[:, 0], 0.2),
            bearing_rad=np.asarray(se2.wrap(bearing[seen] + noise[:, 1])),
            class_id=np.full(len(frame), UNKNOWN),
            sigma_range_m=unknown,
            sigma_bearing_rad=unknown,
            source_line=np.zeros(len(frame), dtype=np.int64),
        ),
        sensor=Sensor(range_max_m=RANGE_M, bearing_min_rad=-HALF_VIEW_RAD, bearing_max_rad=HALF_VIEW_RAD),
        truth=Trajectory(stamp_s, np.asarray(se2.compose(start, pose)), np.zeros((len(pose), 3, 3)), frame="truth"),
        true_landmarks=Landmarks.at(np.arange(len(places)), np.asarray(se2.transform(start, places))),
        source="benchmarks.harsh",
    )


def _drive() -> tuple[FloatArray, FloatArray, FloatArray]:
    """True poses (N, 3), speeds and turn rates (N,): to and fro through the aisles, and all the way back."""
    ends = (-3.0, LENGTH_M + 3.0)
    there = [(ends[(k + half) % 2], k * GAP_M) for k in range(AISLES) for half in (0, 1)]
    goals = [*there[1:], *there[::-1][1:]]
    x, y, heading, period_s = *there[0], 0.0, 1.0 / RATE_HZ
    made: list[tuple[float, float, float, float, float]] = []
    for goal in goals:
        while (away := math.hypot(goal[0] - x, goal[1] - y)) > 0.4:
            error = (math.atan2(goal[1] - y, goal[0] - x) - heading + math.pi) % (2.0 * math.pi) - math.pi
            turn = min(max(2.0 * error, -1.0), 1.0)
            speed = min(math.cos(error), max(away, 0.3)) if abs(error) < 1.0 else 0.0
            made.append((x, y, heading, speed, turn))
            half = heading + 0.5 * turn * period_s
            x, y = x + speed * period_s * math.cos(half), y + speed * period_s * math.sin(half)
            heading += turn * period_s
    found = np.array(made)
    found[:, 2] = se2.wrap(found[:, 2])
    return found[:, :3], found[:, 3], found[:, 4]


COLUMNS = {
    "none": {},
    "radius": {"spread": [0.08], "reading": [0.02], "visit": [0.01], "misread": 0.05},
    "colour": {"spread": [0.15] * 3, "reading": [0.05] * 3, "visit": [0.03] * 3, "misread": 0.05},
    "descriptor of 8": {"spread": [1.0] * 8, "reading": [0.5] * 8, "visit": [0.4] * 8, "misread": 0.05},
    "descriptor of 32": {"spread": [1.0] * 32, "reading": [0.5] * 32, "visit": [0.4] * 32, "misread": 0.05},
    "useless": {"spread": [0.0], "reading": [1.0], "visit": [0.0], "misread": 0.0},
    "radius biased by range": {"spread": [0.08], "reading": [0.02], "visit": [0.01], "by_range": 0.02, "misread": 0.05},
    "colour by the light": {"spread": [0.15] * 3, "reading": [0.05] * 3, "visit": [0.03] * 3, "light": 0.3},
}
"""What columns are like: standard deviations of landmarks, readings and visits; share of readings that are of anything;
growth of a radius with range; light that changes once a minute, the same in all three."""
LIGHT_S, PAUSE_S = 60.0, 20.0


def with_columns(
    recording: AnyRecordingT, name: str, seed: int = 0, *, names: IntArray | None = None, session: int = 0
) -> AnyRecordingT:
    """Return a recording whose detections have columns of `COLUMNS`, by their own identities; the same landmarks over
    the sessions of a world, whose identities are `names`.
    """
    kind: dict[str, Any] = COLUMNS[name]
    if not kind:
        return recording
    rng, seen = np.random.default_rng([seed, 11]), recording.detections
    stamp_s, count = recording.frames.stamp_s[seen.frame], len(kind["spread"])
    names = np.unique(seen.landmark_id) if names is None else names
    of = np.searchsorted(names, seen.landmark_id)
    order = np.lexsort((stamp_s, of))
    begins = (np.diff(of[order], prepend=-1) != 0) | (np.diff(stamp_s[order], prepend=-np.inf) > PAUSE_S)
    visit = np.empty(len(order), dtype=np.int64)
    visit[order] = np.cumsum(begins) - 1
    value = rng.normal(size=(len(names), count))[of] * kind["spread"]
    rng = np.random.default_rng([seed, 11, session]) if session else rng
    value += rng.normal(size=(visit.max() + 1, count))[visit] * kind["visit"]
    value += rng.normal(size=(len(of), count)) * kind["reading"]
    range_m = seen.range_m if isinstance(seen, Detections) else np.linalg.norm(seen.position_sensor_m, axis=1)
    value += kind.get("by_range", 0.0) * range_m[:, None]
    minute = ((stamp_s - stamp_s[0]) // LIGHT_S).astype(np.int64)
    value += kind.get("light", 0.0) * rng.normal(size=minute.max() + 1)[minute, None]
    wrong = rng.random(len(of)) < kind.get("misread", 0.0)
    value[wrong] = rng.normal(size=(int(wrong.sum()), count)) * 3.0 * np.maximum(kind["spread"], kind["reading"])
    names = tuple(f"descriptor_{k}" for k in range(count))
    return replace(recording, detections=replace(seen, features=value, feature_names=names))
