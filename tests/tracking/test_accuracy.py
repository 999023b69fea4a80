"""How well objects are followed, on scenes that nothing was set for: the numbers that the tracker has to reach.

What is not reached says so, with what was measured.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import ModuleType

import numpy as np
import pytest

from evermap.cli.bench import load_benchmarks
from evermap.config import TrackerConfig
from evermap.tracking.record import StaticSpells
from evermap.tracking.tracker import Tracker
from evermap.tracking.views import View
from evermap.types import UNKNOWN, FloatArray, IntArray

pytestmark = pytest.mark.slow

P_DETECT, SIGMA_M = 0.9, 0.3
Scores = Callable[[str, int], dict[str, float]]


@pytest.fixture(scope="module")
def race() -> ModuleType:
    """Scenes, peer and judge of the benchmark."""
    module: ModuleType = load_benchmarks().tracking
    return module


@pytest.fixture(scope="module")
def ours(race: ModuleType) -> Scores:
    @cache
    def scores(name: str, seed: int) -> dict[str, float]:
        recording = race.draw(race.SCENES[name], seed)
        found: dict[str, float] = race.judge(recording, race.tracks_of(race.SCENES[name], recording))
        return found

    return scores


def missed(*case: object, measured: str) -> object:
    """A case that is not reached."""
    return pytest.param(*case, marks=pytest.mark.xfail(strict=True, reason=f"measured {measured}"))


@pytest.mark.parametrize(
    ("name", "seed", "score", "at_least"),
    [
        ("1000", 11, "mota", 0.998),
        ("1000", 11, "idf1", 0.999),
        ("1000", 12, "mota", 0.998),
        missed("1000", 12, "idf1", 0.999, measured="0.99848; 0.99898 on average over six scenes"),
        ("dense", 11, "mota", 0.980),
        ("dense", 11, "idf1", 0.983),
        ("dense", 12, "mota", 0.980),
        ("dense", 12, "idf1", 0.983),
    ],
)
def test_scores(ours: Scores, name: str, seed: int, score: str, at_least: float) -> None:
    assert ours(name, seed)[score] >= at_least


@pytest.mark.parametrize(
    ("name", "seed", "at_most"),
    [
        ("1000", 11, 3),
        missed("1000", 12, 3, measured="4; 1.3 on average over six scenes"),
        missed("dense", 11, 5, measured="8; 3.8 on average over ten scenes"),
        ("dense", 12, 5),
    ],
)
def test_identity_switches(ours: Scores, name: str, seed: int, at_most: int) -> None:
    assert ours(name, seed)["switches"] <= at_most


@pytest.mark.parametrize(("name", "n_scenes"), [("100", 20), ("dense", 10), ("1000", 2)])
def test_no_worse_than_the_peer_on_the_same_frames(race: ModuleType, ours: Scores, name: str, n_scenes: int) -> None:
    """On average: two objects that meet are sometimes exchanged by one of them, and sometimes by the other."""
    seeds = range(11, 11 + n_scenes)
    theirs = []
    for seed in seeds:
        recording = race.draw(race.SCENES[name], seed)
        theirs.append(race.judge(recording, race.by_sort(recording).afterwards))
    for score in ("mota", "idf1"):
        assert np.mean([ours(name, seed)[score] for seed in seeds]) >= np.mean([row[score] for row in theirs])


def grid(side: tuple[int, int, int], spacing_m: float) -> FloatArray:
    return spacing_m * np.stack(np.meshgrid(*map(np.arange, side), indexing="ij"), axis=-1).reshape(-1, 3).astype(float)


def detections(
    rng: np.random.Generator, position: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Noisy, with misses and one false in twenty, in random order; and whose they are, `UNKNOWN` for nobody's."""
    seen = np.flatnonzero(rng.random(len(position)) < P_DETECT)
    false = rng.uniform(low, high, (rng.poisson(0.05 * len(position)), 3))
    order = rng.permutation(len(seen) + len(false))
    points = np.vstack([position[seen] + rng.normal(0.0, SIGMA_M, (len(seen), 3)), false])
    return points[order], np.r_[seen, np.full(len(false), UNKNOWN)][order]


def majority(ids: list[list[int]]) -> IntArray:
    """(N,) which id each object was given most."""
    return np.array([np.bincount(mine).argmax() for mine in ids])


@pytest.mark.parametrize("seed", [11, pytest.param(12, marks=pytest.mark.slow)])
def test_who_leaves_view_and_comes_back_static_keeps_its_identity(seed: int) -> None:
    """Five hundred objects swing about their places, come to rest there, and are not in view for an hour."""
    rng = np.random.default_rng(seed)
    place = grid((10, 10, 5), 10.0)
    n, low, high = len(place), place.min(axis=0) - 5.0, place.max(axis=0) + 5.0
    tracker = Tracker(TrackerConfig(clutter_per_m3=0.05 / 10.0**3))
    here = View(place.mean(axis=0), 100.0, lambda p: np.full(len(p), P_DETECT))
    away = View(place.mean(axis=0) + 1e4, 100.0, lambda p: np.zeros(len(p)))
    swing = rng.normal(size=(n, 3))
    ids: dict[str, list[list[int]]] = {when: [[] for _ in range(n)] for when in ("before", "after")}

    def watch(start_s: float, n_frames: int, kept: list[list[int]]) -> None:
        for k in range(n_frames):
            left = max(0.0, 1.0 - (start_s + 0.1 * k) / 6.0) ** 2
            position = place + left * swing * np.sin(0.1 * k)
            points, source = detections(rng, position, low, high)
            track, _ = tracker.step(start_s + 0.1 * k, points, view=here)
            for object_id, track_id in zip(source.tolist(), track.tolist(), strict=True):
                if object_id != UNKNOWN:
                    kept[object_id].append(track_id)

    watch(0.0, 100, [[] for _ in range(n)])
    watch(10.0, 20, ids["before"])
    for k in range(20):
        tracker.step(12.0 + 0.1 * k, np.empty((0, 3)), view=away)
    assert len(tracker.working_set) >= 0.99 * n
    watch(3600.0, 30, ids["after"])
    assert np.mean(majority(ids["before"]) == majority(ids["after"])) >= 0.99


@pytest.mark.parametrize("seed", [11, pytest.param(12, marks=pytest.mark.slow)])
@pytest.mark.parametrize("with_appearance", [True, False])
def test_exchanged_objects_are_told_apart_by_what_they_look_like(seed: int, with_appearance: bool) -> None:
    """In a ring of a hundred everyone moves on by one place; cosines of two views of the same are about 0.9."""
    rng = np.random.default_rng(seed)
    n, length = 100, 32
    place = grid((10, 10, 1), 8.0)
    low, high = place.min(axis=0) - [4.0, 4.0, 1.0], place.max(axis=0) + [4.0, 4.0, 1.0]
    looks = rng.normal(size=(n, length)) / np.sqrt(length)
    tracker = Tracker(TrackerConfig(clutter_per_m3=1e-4), n_appearance=length if with_appearance else 0)

    def watch(start_s: float, who: IntArray) -> list[list[int]]:
        kept: list[list[int]] = [[] for _ in range(n)]
        for k in range(40):
            points, at = detections(rng, place, low, high)
            seen = rng.normal(size=(len(at), length)) / np.sqrt(length)  # nothing looks like anything
            seen[at >= 0] = looks[who[at[at >= 0]]] + 0.33 * seen[at >= 0]
            track, _ = tracker.step(start_s + 0.1 * k, points, appearance=seen if with_appearance else None)
            for place_id, track_id in zip(at.tolist(), track.tolist(), strict=True):
                if place_id != UNKNOWN and k >= 5:
                    kept[who[place_id]].append(track_id)
        return kept

    before = majority(watch(0.0, np.arange(n)))
    for k in range(12):
        tracker.step(4.0 + 0.1 * k, np.empty((0, 3)))
    who = np.roll(np.arange(n), 1)
    after = majority(watch(1000.0, who))
    confused = np.mean(after[who] == before)  # has the id of whoever was in its place
    assert confused == 0.0 if with_appearance else confused > 0.9


REST_M = 0.05
"""Nearer to where it stays an object is at rest: less cannot be told with a noise of 0.2 m."""


def way(time_s: FloatArray, acceleration: FloatArray, speed: FloatArray) -> FloatArray:
    """Metres after a start at 0, with constant acceleration up to the speed."""
    time_s = np.maximum(time_s, 0.0)
    ramp = np.minimum(time_s, speed / acceleration)
    return 0.5 * acceleration * ramp**2 + speed * (time_s - ramp)


def parked(seed: int, duration_s: float = 200.0) -> tuple[StaticSpells, FloatArray, FloatArray, FloatArray]:
    """A hundred objects come round a bend, stay, and climb off in another direction, each at its own pace.

    Frames come at irregular times, one detection in five is missing.

    Returns:
        Static spells; (100, 3) places; (100,) when each came to rest, and when it left.
    """
    rng = np.random.default_rng(seed)
    place = grid((10, 10, 1), 50.0)
    n, low, high = len(place), place.min(axis=0) - [25.0, 25.0, 3.0], place.max(axis=0) + [25.0, 25.0, 3.0]
    come = rng.uniform(10.0, 50.0, n)
    leave = come + 10.0 + rng.exponential(50.0, n)
    pace_in, pace_off = rng.uniform(0.5, 2.0, (2, n))
    speed_in, speed_off = rng.uniform(1.0, 3.0, (2, n))
    radius, heading, course = rng.uniform(5.0, 15.0, n), *rng.uniform(-np.pi, np.pi, (2, n))
    off = np.stack([np.cos(course), np.sin(course), rng.uniform(-0.3, 0.3, n)], axis=1)
    tracker = Tracker(TrackerConfig(sigma_position_m=0.2, clutter_per_m3=1e-6, p_detect=0.8))
    view = View(place.mean(axis=0), 1e4, lambda p: np.full(len(p), 0.8))
    stamp = 0.0
    while stamp < duration_s:
        angle = heading + way(come - stamp, pace_in, speed_in) / radius
        bend = np.stack([np.sin(angle) - np.sin(heading), np.cos(angle) - np.cos(heading), np.zeros(n)], axis=1)
        position = place + radius[:, None] * bend + way(stamp - leave, pace_off, speed_off)[:, None] * off
        seen = (stamp > come - 8.0) & (stamp < leave + 8.0) & (rng.random(n) < 0.8)
        false = rng.uniform(low, high, (rng.poisson(0.05 * n), 3))
        noisy = position[seen] + rng.normal(0.0, 0.2, (seen.sum(), 3))
        tracker.step(stamp, rng.permutation(np.vstack([noisy, false])), view=view)
        stamp += rng.uniform(0.05, 0.2)
    came, left = come - np.sqrt(2.0 * REST_M / pace_in), leave + np.sqrt(2.0 * REST_M / pace_off)
    return tracker.static_spells(), place, came, np.minimum(left, duration_s)


@pytest.mark.parametrize(
    "seed", [missed(11, measured="99 of 100; another tracklet took over an object that was at rest"), 12]
)
def test_static_spells_contain_the_true_length(seed: int) -> None:
    spells, place, came, left = parked(seed)
    seen_s, possible_s = spells.last_s - spells.first_s, spells.gone_s - spells.elsewhere_s
    for k in range(len(place)):
        mine = np.flatnonzero(np.linalg.norm(spells.position_m - place[k], axis=1) < 1.0)
        assert len(mine), f"object {k}"
        longest = mine[seen_s[mine].argmax()]
        assert seen_s[longest] <= left[k] - came[k] <= possible_s[longest], f"object {k}"
