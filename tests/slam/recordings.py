"""Simulated recordings for the estimator, and helpers to cut real ones."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from evermap.sim import BuildingConfig, BuildingSimulation, SensorConfig, simulate_building
from evermap.types import Frames, Recording


@cache
def building(seed: int = 0, *, patrol_s: float = 60.0, faults: float = 0.0, **sensor: float) -> BuildingSimulation:
    """A static building patrolled once; `faults` is the probability of a wrong identity."""
    sensor_config = SensorConfig(**{"p_wrong_identity": faults, "p_false": faults / 3, **sensor})
    return simulate_building(
        BuildingConfig(days=1, patrol_s=patrol_s, change_rate=0.0, sensor=sensor_config), seed=seed
    )


def first_seconds(recording: Recording, seconds: float) -> Recording:
    """The beginning of a recording, counted from its first frame with detections."""
    stop = recording.frames.stamp_s[recording.detections.frame[0]] + seconds
    frames = int(np.searchsorted(recording.frames.stamp_s, stop))
    rows = int(np.searchsorted(recording.odometry.stamp_s, stop))
    odometry, detections = recording.odometry, recording.detections
    keep = detections.frame < frames
    columns = {name: getattr(detections, name)[keep] for name in detections.__slots__}
    return replace(
        recording,
        odometry=replace(
            odometry,
            stamp_s=odometry.stamp_s[:rows],
            forward_mps=odometry.forward_mps[:rows],
            lateral_mps=odometry.lateral_mps[:rows],
            angular_radps=odometry.angular_radps[:rows],
        ),
        frames=Frames(recording.frames.stamp_s[:frames], recording.frames.complete, recording.frames.clock),
        detections=type(detections)(**columns),
    )
