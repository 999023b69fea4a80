"""How long the filters of cliques take, beside each landmark by itself and beside whole arrays, on one core.

`evermap bench --only cliques` measures. All of them watch the same detections, a frame a turn, and count with the best
turn. The learned model takes three steps for a frame: look at it, filter, confirm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from itertools import count
from typing import Any

import numpy as np

from benchmarks import persistence, rosen
from evermap.existence import single
from evermap.existence.single import Belief
from evermap.sensing import learned
from evermap.sensing.learned import CliqueLook, LearnedDetection
from evermap.sensing.profile import Assumed
from evermap.survival import Exponential
from evermap.types import BoolArray, FloatArray, IntArray
from evermap_studies.bateman2020 import joint
from evermap_studies.worlds.sensors import LIDAR

N_CLIQUES = 50_000
LANDMARKS = 20
"""On each clique."""
ONE_BY_ONE = 20_000
"""Landmarks of the peer in Python: all of them would take a second a turn, and the same time each."""
RATE_HZ = 1.0 / 300.0
P_MISS, P_FALSE = 0.5, 0.005
LIMITS = {"learned_ns": 250.0, "bytes": 200.0}
"""What a landmark and frame may take."""

METRICS: dict[str, tuple[str, float, str]] = {
    "learned_rosen_speed_ratio": (
        "higher",
        0.35,
        "speed of cliques with learned detection over Rosen's algorithm in Python, landmark by landmark",
    ),
    "learned_arrays_ratio": (
        "lower",
        0.35,
        "time of the same over a clique filter in whole arrays that learns nothing",
    ),
    "jcf_arrays_ratio": ("lower", 0.35, "time of `persistence.joint.jcf` over that clique filter in whole arrays"),
    "learned_bytes": ("lower", 0.02, "bytes of memory for a landmark with all that is learned of it"),
}
"""Metric: which direction is better, relative tolerance, meaning."""


@dataclass(frozen=True, slots=True)
class World:
    """Cliques around a lidar, all of them in its field and there: no frame takes longer.

    Attributes:
        landmark_m: (K, 3) in the world.
        clique: (K,) sorted.
        detected: (F, K) in frames that come again and again, a second apart.
    """

    landmark_m: FloatArray
    clique: IntArray
    detected: BoolArray


def world(n_cliques: int, n_frames: int = 8, seed: int = 0) -> World:
    random = np.random.default_rng(seed)
    bearing, range_m = random.uniform(-math.pi, math.pi, n_cliques), random.uniform(3.0, 13.0, n_cliques)
    middle = np.column_stack([range_m * np.cos(bearing), range_m * np.sin(bearing), np.zeros(n_cliques)])
    clique = np.repeat(np.arange(n_cliques), LANDMARKS)
    landmark = middle[clique] + random.normal(0.0, 0.4, (len(clique), 3))
    return World(landmark, clique, random.random((n_frames, len(clique))) < 1.0 - P_MISS)


class WithLearning:
    """Cliques whose detection model learns as it goes."""

    def __init__(self, scene: World) -> None:
        self.model: LearnedDetection = learned.init(scene.landmark_m, scene.clique, Assumed(LIDAR))
        self.belief: Belief = single.init(len(self.model), Exponential(RATE_HZ))
        self._frames = _frames(scene)
        self._seen: CliqueLook

    def look(self) -> None:
        stamp_s, detected = next(self._frames)
        self.model, self._seen = learned.look(self.model, stamp_s, np.zeros(3), np.eye(3), detected)

    def filter(self) -> None:
        seen = self._seen
        self.belief = self.belief.observe(seen.stamp_s, seen.log_there, seen.log_gone)

    def confirm(self) -> None:
        self.model = learned.confirm(self.model, self._seen, self.belief.probability)

    @property
    def bytes_used(self) -> int:
        """Of all arrays that are kept from frame to frame."""
        kept = [getattr(part, f.name) for part in (self.model, self.model.profile, self.belief) for f in fields(part)]
        return sum(array.nbytes for array in kept if isinstance(array, np.ndarray))


def by_jcf(scene: World) -> Callable[[], FloatArray]:
    """The clique filter with one miss rate for all."""
    belief, frames = single.init(len(scene.clique) // LANDMARKS, Exponential(RATE_HZ)), _frames(scene)

    def work() -> FloatArray:
        nonlocal belief
        stamp_s, detected = next(frames)
        belief = joint.jcf(belief, stamp_s, detected, P_MISS, P_FALSE, True, scene.clique)
        return belief.log_odds

    return work


def by_arrays(scene: World) -> Callable[[], FloatArray]:
    """The same, plainly: log-odds of all cliques, and nothing is checked."""
    first = np.flatnonzero(np.diff(scene.clique, prepend=-1))
    log_odds, before_s, frames = np.full(len(first), np.inf), 0.0, _frames(scene)
    if_detected, if_missed = math.log((1.0 - P_MISS) / P_FALSE), math.log(P_MISS / (1.0 - P_FALSE))

    def work() -> FloatArray:
        nonlocal log_odds, before_s
        stamp_s, detected = next(frames)
        log_survival = -RATE_HZ * (stamp_s - before_s)
        # logit of q / (1 + exp(-l)), from the odds against
        log_odds = log_survival - np.log(np.exp(-log_odds) - math.expm1(log_survival))
        log_odds = log_odds + np.add.reduceat(np.where(detected, if_detected, if_missed), first)
        before_s = stamp_s
        return log_odds

    return work


def by_rosen(scene: World) -> Callable[[], FloatArray]:
    """Every landmark by itself, in Python's own floats; the first `ONE_BY_ONE`."""
    features = [rosen.OneFeature(lambda t: -RATE_HZ * t) for _ in scene.clique[:ONE_BY_ONE]]
    frames = _frames(scene)

    def work() -> FloatArray:
        stamp_s, detected = next(frames)
        hits = detected[: len(features)].tolist()
        return np.array(
            [feature.update(stamp_s, hit, P_MISS, P_FALSE) for feature, hit in zip(features, hits, strict=True)]
        )

    return work


def run(n_cliques: int = N_CLIQUES, seconds: float = persistence.SECONDS) -> tuple[dict[str, float], dict[str, Any]]:
    """The metrics, and nanoseconds a landmark and frame of everyone."""
    scene = world(n_cliques)
    ours = WithLearning(scene)
    contenders: dict[str, Callable[[], Any]] = {
        "look": ours.look,
        "filter": ours.filter,
        "confirm": ours.confirm,
        "jcf": by_jcf(scene),
        "arrays": by_arrays(scene),
        "rosen": by_rosen(scene),
    }
    landmarks = len(scene.clique)
    best = persistence.best_ns(contenders, seconds)
    ns = {name: took / (min(landmarks, ONE_BY_ONE) if name == "rosen" else landmarks) for name, took in best.items()}
    ns["learned"] = ns["look"] + ns["filter"] + ns["confirm"]
    shown = {
        "n_cliques": n_cliques,
        "ns": ns,
        "bytes": ours.bytes_used / landmarks,
        "frames_per_s": 1e9 / (ns["learned"] * 1e6),
    }
    return {
        "learned_rosen_speed_ratio": ns["rosen"] / ns["learned"],
        "learned_arrays_ratio": ns["learned"] / ns["arrays"],
        "jcf_arrays_ratio": ns["jcf"] / ns["arrays"],
        "learned_bytes": shown["bytes"],
    }, shown


def as_text(shown: dict[str, Any]) -> str:
    """Times and memory, for information."""
    ns = shown["ns"]
    steps = ", ".join(f"{name} {ns[name]:.1f}" for name in ("look", "filter", "confirm"))
    peers = f"jcf {ns['jcf']:.1f}, whole arrays {ns['arrays']:.1f}, Rosen's algorithm in Python {ns['rosen']:.0f}"
    pace = f"a million landmarks: {shown['frames_per_s']:.1f} frames a second"
    lines = [
        f"{shown['n_cliques']} cliques of {LANDMARKS} landmarks, nanoseconds a landmark and frame on one core:",
        f"  learned detection {ns['learned']:.1f} ({steps}; at most {LIMITS['learned_ns']:.0f})",
        f"  {peers}",
        f"  {pace}; {shown['bytes']:.0f} bytes each (at most {LIMITS['bytes']:.0f})",
    ]
    return "\n".join(lines)


def _frames(scene: World) -> Iterator[tuple[float, BoolArray]]:
    """A second apart, without end."""
    for n in count():
        yield float(n + 1), scene.detected[n % len(scene.detected)]
