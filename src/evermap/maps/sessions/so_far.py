"""Beliefs and changes during a drive, from the causal poses.

The looks of a session, its beliefs and its decisions, by the code that judges a session at its end. What that adds:
smoothed poses, places that the map does not have yet, and bodies.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.config import LivingConfig
from evermap.maps.learning import ClassLives
from evermap.maps.living import LivingMap
from evermap.maps.sessions import believe, decide
from evermap.maps.sessions.extend import Extended
from evermap.maps.sessions.looks import Arrivals, Sighting, Watch, looked_at
from evermap.maps.sessions.session import believed
from evermap.types import MapChange, Sensor


def judged_so_far(
    living: LivingMap, sighting: Sighting, sensor: Sensor, config: LivingConfig, classes: ClassLives | None = None
) -> tuple[LivingMap, tuple[MapChange, ...]]:
    """Return the map with beliefs after a part of a drive, and the changes since the last report.

    Args:
        living: the map before it.
        sighting: what was seen of its places.
        sensor: of the robot.
        config: which parts of the engine are on.
        classes: how long things stay, as `lives_of` tells; None where nothing is known of it.
    """
    start_s, end_s = (max(float(stamp_s), living.stamp_s) for stamp_s in sighting.stamp_s[[0, -1]])
    living = replace(living, sightlines=replace(living.sightlines, rules=config.sight))
    aged = believe.aged(living, config, start_s)
    living = replace(living, sites=replace(living.sites, p_kept=aged.p_kept))
    looks = config.looks.model_copy(update={"settled_s": min(config.looks.settled_online_s, config.looks.settled_s)})
    config = config.model_copy(update={"looks": looks})
    seen = looked_at(living, aged.p_here, Watch.of(sighting, living.places.position_m, sensor, looks), config)
    none = np.zeros(0, dtype=np.int64)
    entry = Extended(living, living, none, none, aged.p_here, np.zeros(len(living.sites), dtype=np.bool_))
    now = believed(entry, seen, sensor, (start_s, end_s), config)
    nowhere = Arrivals(none, np.zeros(0), np.zeros(0))
    settings = config.decisions
    after, changes = decide.decided(
        living, now.living, seen, now.log_evidence, nowhere, start_s, classes, settings=settings
    )
    return after, tuple(change.named(after.landmark_names) for change in changes)


def lives_of(living: LivingMap, config: LivingConfig) -> ClassLives | None:
    """Return the lifetimes from the history of a map; None if nothing is learned or given."""
    if not (config.learn_lifetimes and len(living.stays) and len(living.lives.looks_s)):
        return None
    return ClassLives.of(living.stays, living.lives, None, config.lifetimes)
