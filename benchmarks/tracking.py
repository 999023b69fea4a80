"""How fast and how well objects are followed, beside a SORT in whole arrays.

`evermap bench --only tracking` measures: CPU time on one core, and scores by py-motmetrics. Both trackers see the same
frames and know the same about them. Each turn is another scene: scores are means over
scenes, and speeds medians.
"""

from __future__ import annotations

import statistics
import time
import tracemalloc
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from benchmarks.sort import Sort
from evermap.config import TrackerConfig
from evermap.survival import GeneralPurpose
from evermap.tracking.record import Followed, Recorder
from evermap.tracking.tracker import Tracker
from evermap.tracking.tracklets import TrackState
from evermap.tracking.views import View
from evermap.tracking.working_set import Stored, WorkingSet, empty_rows
from evermap.types import FloatArray, IntArray

FRAME_S = 0.1
SIGMA_M = 0.3
P_DETECT = 0.9
CLUTTER = 0.05
"""False detections a frame, as a share of the number of objects."""
MATCH_M = 1.5
"""Farther from an object nothing is that object, for the judge."""
MAX_AGE = 5
"""Frames in a row that the peer waits: with 3 it loses more identities, with 10 it follows more that are gone."""
N_FRAMES = 100
N_STORED = 1_000_000
N_QUERIES = 300
REACH_M = 2.0
SEEDS = (11, 12, 13)


class Scene(NamedTuple):
    """Number of objects, distance between their starts, and length in multiples of `N_FRAMES`."""

    n: int
    spacing_m: float
    length: int


SCENES = {
    "20": Scene(20, 10.0, 1),
    "100": Scene(100, 10.0, 1),
    "500": Scene(500, 10.0, 1),
    "1000": Scene(1000, 10.0, 1),
    "dense": Scene(100, 3.0, 2),
}

METRICS: dict[str, tuple[str, float, str]] = {
    **{
        f"tracking_{name}_speed_ratio": (
            "higher",
            0.35,
            f"{scene.n} objects, {scene.spacing_m:g} m apart: frames a second over a SORT in whole arrays",
        )
        for name, scene in SCENES.items()
    },
    "tracking_1000_mota_lost": ("lower", 0.3, "100 (1 - MOTA) of 1000 objects 10 m apart, afterwards"),
    "tracking_1000_idf1_lost": ("lower", 0.3, "100 (1 - IDF1) of the same"),
    "tracking_dense_mota_lost": ("lower", 0.3, "100 (1 - MOTA) of 100 objects 3 m apart, afterwards"),
    "tracking_dense_idf1_lost": ("lower", 0.3, "100 (1 - IDF1) of the same"),
    "working_set_query_ratio": ("lower", 0.5, "time to find the neighbours of a place over scipy's k-d tree"),
    "working_set_bytes": ("lower", 0.02, "bytes of memory for an object in the working set"),
}
"""Metric: which direction is better, relative tolerance, meaning."""

Reported = tuple[IntArray, FloatArray]
"""Tracks of a frame: (N,) ids and (N, 3) positions [m]."""


@dataclass(frozen=True, slots=True)
class Recording:
    """What happened, and what was detected: F frames.

    Attributes:
        truth_m: (F, N, 3).
        detected_m: F of (M, 3), in no order.
    """

    truth_m: FloatArray
    detected_m: list[FloatArray]


def draw(scene: Scene, seed: int, n_frames: int = N_FRAMES) -> Recording:
    """Objects start on a cubic grid with up to 2 m/s; half of them keep their velocity, the others accelerate.

    Accelerations are Ornstein-Uhlenbeck processes of 0.2 m/s^2 and 2 s, each axis. Nobody becomes faster than 2 m/s.
    """
    rng = np.random.default_rng(seed)
    n, spacing = scene.n, scene.spacing_m
    side = range(int(np.ceil(n ** (1 / 3) - 1e-9)))
    position = spacing * np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)[:n]
    low, high = position.min(axis=0) - 0.5 * spacing, position.max(axis=0) + 0.5 * spacing
    velocity = rng.normal(size=(n, 3))
    velocity *= rng.uniform(0.0, 2.0, (n, 1)) / np.linalg.norm(velocity, axis=1, keepdims=True)
    driven = rng.random((n, 1)) < 0.5
    acceleration = rng.normal(0.0, 0.2, (n, 3))
    decay = np.exp(-FRAME_S / 2.0)
    truth, detected = [], []
    for _ in range(scene.length * n_frames):
        seen = position[rng.random(n) < P_DETECT]
        false = rng.uniform(low, high, (rng.poisson(CLUTTER * n), 3))
        truth.append(position)
        detected.append(rng.permutation(np.vstack([seen + rng.normal(0.0, SIGMA_M, seen.shape), false])))
        acceleration = acceleration * decay + rng.normal(0.0, 0.2 * np.sqrt(1.0 - decay**2), (n, 3))
        velocity = velocity + driven * acceleration * FRAME_S
        velocity = velocity * np.minimum(1.0, 2.0 / np.linalg.norm(velocity, axis=1, keepdims=True))
        position = position + velocity * FRAME_S
    return Recording(np.array(truth), detected)


@dataclass(slots=True)
class Run:
    """What a tracker reported: at once, and afterwards with the first detections of what was confirmed later."""

    at_once: list[Reported]
    afterwards: list[Reported]
    cpu_s: list[float] = field(default_factory=list)


def by_evermap(scene: Scene, recording: Recording, passes: int = 1) -> Run:
    """All frames, so many times; then once more with a recorder, which is not timed."""
    cpu_s = []
    for _ in range(passes):
        tracker, view, followed = tracker_of(scene), view_of(recording), []
        began = time.process_time()
        for k, points in enumerate(recording.detected_m):
            tracker.step(FRAME_S * k, points, view=view)
            followed.append(tracker.followed())
        cpu_s.append(time.process_time() - began)
    return Run([_confirmed(f) for f in followed], tracks_of(scene, recording), cpu_s)


def tracks_of(scene: Scene, recording: Recording) -> list[Reported]:
    """What our tracker says afterwards, frame by frame."""
    tracker, recorder, view = tracker_of(scene), Recorder(), view_of(recording)
    for k, points in enumerate(recording.detected_m):
        events = tracker.step(FRAME_S * k, points, view=view)[1]
        recorder.add(tracker.followed(), events)
    tracks = recorder.tracks()
    frame = np.rint(tracks.stamp_s / FRAME_S)
    return [(tracks.track_id[frame == k], tracks.position_m[frame == k]) for k in range(len(recording.detected_m))]


def tracker_of(scene: Scene) -> Tracker:
    """All as it is by default, but for the density of false detections."""
    return Tracker(TrackerConfig(sigma_position_m=SIGMA_M, clutter_per_m3=CLUTTER / scene.spacing_m**3))


def view_of(recording: Recording) -> View:
    """Everything can be seen."""
    centre = recording.truth_m[0].mean(axis=0)
    return View(centre, 1e4, lambda position_m: np.full(len(position_m), P_DETECT))


def _confirmed(followed: Followed) -> Reported:
    rows = followed.state != TrackState.BIRTH
    return followed.track_id[rows], followed.position_m[rows]


def by_sort(recording: Recording, passes: int = 1) -> Run:
    """The same by the peer, whose tracks are improved afterwards just as ours are."""
    cpu_s = []
    for _ in range(passes):
        peer = Sort(FRAME_S, SIGMA_M, MAX_AGE)
        began = time.process_time()
        reports = [peer.step(points) for points in recording.detected_m]
        cpu_s.append(time.process_time() - began)
    good = np.unique(np.concatenate([r.track_id[r.confirmed] for r in reports]))
    afterwards: list[Reported] = []
    again = np.empty(0, dtype=np.int64)  # ids that are detected at this frame or later, and all that the last frame has
    for k, r in reversed(list(enumerate(reports))):
        again = np.union1d(again, r.track_id if k == len(reports) - 1 else r.track_id[r.n_missed == 0])
        rows = np.isin(r.track_id, np.intersect1d(good, again))
        afterwards.append((r.track_id[rows], r.position_m[rows]))
    at_once = [(r.track_id[r.confirmed], r.position_m[r.confirmed]) for r in reports]
    return Run(at_once, afterwards[::-1], cpu_s)


def judge(recording: Recording, reported: list[Reported]) -> dict[str, float]:
    """MOTA, IDF1 and identity switches by py-motmetrics."""
    import motmetrics
    from scipy.spatial.distance import cdist

    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    for there, (track_id, position) in zip(recording.truth_m, reported, strict=True):
        distance = cdist(there, position)
        distance[distance > MATCH_M] = np.nan
        accumulator.update(np.arange(len(there)), track_id, distance)
    names = {"mota": "mota", "idf1": "idf1", "num_switches": "switches"}
    row = motmetrics.metrics.create().compute(accumulator, metrics=list(names)).iloc[0]
    return {name: float(row[key]) for key, name in names.items()}


def run(
    n_frames: int = N_FRAMES, n_stored: int = N_STORED, seeds: tuple[int, ...] = SEEDS
) -> tuple[dict[str, float], dict[str, Any]]:
    """The metrics, and speeds and scores of both trackers in each scene, with what the working set takes."""
    warm_up = draw(SCENES["20"], 0, 20)
    by_evermap(SCENES["20"], warm_up)  # compiles
    by_sort(warm_up)
    ratios: dict[str, float] = {}
    shown: dict[str, Any] = {"n_turns": len(seeds), "scenes": {}}
    for name, scene in SCENES.items():
        turns = [_turn(scene, seed, n_frames) for seed in seeds]
        ratios[f"tracking_{name}_speed_ratio"] = statistics.median(
            turn["evermap"]["frames_per_s"] / turn["sort"]["frames_per_s"] for turn in turns
        )
        shown["scenes"][name] = {who: _middle([turn[who] for turn in turns]) for who in ("evermap", "sort")}
    for name in ("1000", "dense"):
        for score in ("mota", "idf1"):
            ratios[f"tracking_{name}_{score}_lost"] = 100.0 * (
                1.0 - shown["scenes"][name]["evermap"]["afterwards"][score]
            )
    shown["working_set"] = stored = _working_set(n_stored)
    ratios["working_set_query_ratio"] = stored["query_us"] / stored["tree_us"]
    ratios["working_set_bytes"] = stored["bytes"]
    return ratios, shown


def _turn(scene: Scene, seed: int, n_frames: int) -> dict[str, dict[str, Any]]:
    """Both trackers on one recording, each with the best of a few passes where they are short."""
    recording = draw(scene, seed, n_frames)
    passes = max(1, 300 // scene.n)
    return {
        who: {
            "frames_per_s": len(recording.detected_m) / min(done.cpu_s),
            "at_once": judge(recording, done.at_once),
            "afterwards": judge(recording, done.afterwards),
        }
        for who, done in (
            ("evermap", by_evermap(scene, recording, 2 * passes)),
            ("sort", by_sort(recording, passes)),
        )
    }


def _middle(turns: list[dict[str, Any]]) -> dict[str, Any]:
    """Median speed and mean scores."""
    return {
        "frames_per_s": statistics.median(turn["frames_per_s"] for turn in turns),
        **{
            when: {score: statistics.fmean(turn[when][score] for turn in turns) for score in turns[0][when]}
            for when in ("at_once", "afterwards")
        },
    }


def stored_objects(n: int, rng: np.random.Generator) -> Stored:
    """Objects at rest, one a square metre of the ground and up to 2 m high."""
    side = np.sqrt(n)
    return empty_rows(n, 0)._replace(
        track_id=np.arange(n),
        position=rng.uniform(0.0, [side, side, 2.0], (n, 3)),
        covariance=np.tile(np.array([0.01, 0.0, 0.0, 0.01, 0.0, 0.01], dtype=np.float32), (n, 1)),
        class_p=np.ones(n, dtype=np.float32),
        inverse_odds=np.full(n, 1e-6),
        n_hits=np.full(n, 9, dtype=np.int32),
        static=np.ones(n, dtype=np.int8),
    )


def empty_working_set() -> WorkingSet:
    """Of one class without appearance."""
    return WorkingSet(10.0, (GeneralPurpose(1e-8, 1e-2),), 1, 0)


def _working_set(n: int) -> dict[str, Any]:
    """Memory as Python's allocators count it; times [us] to find neighbours, and of a frame with re-identification."""
    from scipy.spatial import KDTree

    rng = np.random.default_rng(SEEDS[0])
    objects = stored_objects(n, rng)
    tracemalloc.start()
    working_set = empty_working_set()
    working_set.insert_arrays(objects)
    used = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    tree = KDTree(objects.position)
    tracker = Tracker()
    tracker.working_set = working_set
    query_us, tree_us, frame_us, right = [], [], [], 0
    for k, row in enumerate(rng.choice(n, min(N_QUERIES, n // 2), replace=False)):
        place = objects.position[row] + rng.normal(0.0, 0.1, 3)
        began = time.perf_counter()
        working_set.near(place[None], np.array([REACH_M]))
        asked = time.perf_counter()
        tree.query_ball_point(place, REACH_M)
        answered = time.perf_counter()
        track, _ = tracker.step(1000.0 + k, place[None])
        frame_us.append(1e6 * (time.perf_counter() - answered))
        tree_us.append(1e6 * (answered - asked))
        query_us.append(1e6 * (asked - began))
        right += int(track[0] == row)
    return {
        "n": n,
        "bytes": used / n,
        "query_us": statistics.median(query_us),
        "tree_us": statistics.median(tree_us),
        "frame_us": statistics.median(frame_us),
        "frame_p99_us": float(np.quantile(frame_us, 0.99)),
        "share_right": right / len(frame_us),
    }


def as_markdown(shown: dict[str, Any]) -> str:
    """A row for each scene and tracker, and a sentence about the working set."""
    lines = [
        "| objects | tracker | frames a second | MOTA | IDF1 | switches | afterwards: MOTA | IDF1 | switches |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, row in shown["scenes"].items():
        scene = SCENES[name]
        for who, label in (("evermap", "evermap"), ("sort", "SORT in numpy")):
            found = row[who]
            scores = [
                f"{s['mota']:.4f} | {s['idf1']:.4f} | {s['switches']:.1f}"
                for s in (found["at_once"], found["afterwards"])
            ]
            where = f"{scene.n}, {scene.spacing_m:g} m apart"
            lines.append(f"| {where} | {label} | {found['frames_per_s']:,.0f} | {scores[0]} | {scores[1]} |")
    w = shown["working_set"]
    near = f"neighbours of a place {w['query_us']:.0f} us (scipy's k-d tree {w['tree_us']:.0f} us)"
    frame = f"a frame with re-identification {w['frame_us']:.0f} us, 99 of 100 below {w['frame_p99_us']:.0f} us"
    lines += ["", f"Working set of {w['n']:,}: {w['bytes']:.0f} bytes an object; {near}; {frame}."]
    return "\n".join(lines)
