"""Bateman 2020, section 5.2: objects of several behaviours, a tracker, and the lifetimes that it learns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.config import TrackerConfig
from evermap.survival.censored import lifetimes_of_sightings
from evermap.survival.parametric_fit import ParametricFit
from evermap.tracking.record import Followed, StaticSpells
from evermap.tracking.tracker import Tracker
from evermap.tracking.tracklets import TrackState
from evermap.tracking.views import View
from evermap.types import FloatArray
from evermap_studies.lifetimes.sightings import fit_sightings
from evermap_studies.lifetimes.tracking_scores import TrackingScores, score_tracks
from evermap_studies.lifetimes.truth import Value
from evermap_studies.worlds.moving import MovingRun, MovingWorld, simulate_moving

GATE_M = 1.0
"""Within which a track and an object can be the same."""


@dataclass(frozen=True, slots=True)
class TrackedRun:
    """A simulated run and what the tracker made of it.

    Attributes:
        run: the truth.
        followed: (F) active tracklets after each frame.
        resting_m: (F) places (K, 3) of the objects in the working set after each frame.
        spells: static spells.
    """

    run: MovingRun
    followed: list[Followed]
    resting_m: list[FloatArray]
    spells: StaticSpells

    def scores(self) -> TrackingScores:
        """Confirmed tracks in the sensor's reach against the objects there."""
        reach = self.run.in_reach()
        truth = [(np.flatnonzero(row), self.run.position_m[k, row]) for k, row in enumerate(reach)]
        tracks = []
        for sensor, now in zip(self.run.sensor_m, self.followed, strict=True):
            away = np.linalg.norm(now.position_m - sensor, axis=1)
            shown = (now.state != TrackState.BIRTH) & (away <= self.run.world.reach_m)
            tracks.append((now.track_id[shown], now.position_m[shown]))
        return score_tracks(truth, tracks, GATE_M)


def settings_for(world: MovingWorld) -> TrackerConfig:
    """What a user would tell the tracker about this sensor."""
    volume_m3 = np.pi * world.reach_m**2  # 1 m high
    return TrackerConfig(
        sigma_position_m=world.sigma_m,
        p_detect=min(world.p_detect, 0.999),
        clutter_per_m3=max(world.false_per_frame, 1e-3) / volume_m3,
        p_off_class=max(world.p_off_class, 1e-3),
    )


def track(run: MovingRun) -> TrackedRun:
    """Follow all objects of a run."""
    world = run.world
    tracker = Tracker(settings_for(world), n_classes=len(world.classes))
    followed, resting = [], []
    for k, stamp_s in enumerate(run.stamp_s):
        frame = run.detections(k)
        view = View.ball(run.sensor_m[k], world.reach_m, world.p_detect)
        tracker.step(stamp_s, run.detected_m[frame], run.detected_class[frame], view=view)
        followed.append(tracker.followed())
        resting.append(tracker.working_set.stored.position[tracker.working_set.rows].copy())
    return TrackedRun(run, followed, resting, tracker.static_spells())


def learn(spells: list[StaticSpells], class_id: int, least_stay_s: float) -> tuple[ParametricFit, int]:
    """A Weibull model of how long a class parks, and how many stays it is learned from."""
    columns = [
        np.concatenate([getattr(one, name)[one.class_id == class_id] for one in spells])
        for name in ("elsewhere_s", "first_s", "last_s", "gone_s")
    ]

    samples, stay = lifetimes_of_sightings(*columns, least_stay_s=least_stay_s)
    return fit_sightings("weibull", samples, stay), len(np.unique(stay))


def study(
    world: MovingWorld, runs: int, seed: int, progress: Callable[[float], None]
) -> tuple[TrackedRun, list[Value], dict[str, ParametricFit]]:
    """Track some runs; the first of them, scores of all, and what is learned about each class that leaves."""
    values: list[Value] = []
    spells: list[StaticSpells] = []
    shown: TrackedRun | None = None
    for done, stream in enumerate(np.random.SeedSequence(seed).spawn(runs), start=1):
        tracked = track(simulate_moving(world, stream))
        shown = shown or tracked
        spells.append(tracked.spells)
        values.append({"run": done, **_as_value(tracked.scores())})
        progress(done)
    assert shown is not None
    learned: dict[str, ParametricFit] = {}
    least_stay_s = settings_for(world).rest_for_s
    for class_id, one in enumerate(world.classes):
        if one.lifetime is not None:
            found, stays = learn(spells, class_id, least_stay_s)
            learned[one.name] = found
            t = np.asarray(one.lifetime.quantile(np.array([0.1, 0.25, 0.5, 0.75, 0.9])))
            lower, upper = found.band(t)
            true = np.exp(one.lifetime.log_survival(t))
            values.append(
                {
                    "class": one.name,
                    "stays": stays,
                    "mean_s": found.prior.mean(),
                    "true_mean_s": one.lifetime.mean(),
                    "largest_error": float(np.abs(np.exp(found.prior.log_survival(t)) - true).max()),
                    "coverage": float(((lower <= true) & (true <= upper)).mean()),
                }
            )
    return shown, values, learned


def _as_value(scores: TrackingScores) -> dict[str, Any]:
    return {
        "mota": scores.mota,
        "idf1": scores.idf1,
        "motp_m": scores.motp_m,
        "switches": scores.switches,
        "fragmentations": scores.fragmentations,
    }
