"""Simulated recordings for the estimator, and helpers to cut real ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache
from typing import Any

import numpy as np

from evermap.types import Frames, Recording
from evermap_studies.sim import BuildingConfig, BuildingSimulation, SimulatedSensor, simulate_building


@cache
def building(seed: int = 0, *, patrol_s: float = 60.0, faults: float = 0.0, **sensor: float) -> BuildingSimulation:
    """A static building patrolled once; `faults` is the probability of a wrong identity."""
    sensor_config = SimulatedSensor(**{"p_wrong_identity": faults, "p_false": faults / 3, **sensor})
    return simulate_building(
        BuildingConfig(days=1, patrol_s=patrol_s, change_rate=0.0, sensor=sensor_config), seed=seed
    )


def first_seconds(recording: Recording, seconds: float) -> Recording:
    """The beginning of a recording, counted from its first frame with detections."""
    stop = recording.frames.stamp_s[recording.detections.frame[0]] + seconds
    frames = int(np.searchsorted(recording.frames.stamp_s, stop))
    cut = with_detections(recording, recording.detections.frame < frames)
    cut = with_odometry(cut, cut.odometry.stamp_s < stop)
    return replace(
        cut, frames=Frames(recording.frames.stamp_s[:frames], recording.frames.complete, recording.frames.clock)
    )


def with_detections(recording: Recording, keep: np.ndarray) -> Recording:
    """Some of the detections only, by mask or rows."""
    return replace(recording, detections=some_rows(recording.detections, keep))


def with_odometry(recording: Recording, keep: np.ndarray) -> Recording:
    """Some of the odometry only, by mask or rows."""
    return replace(recording, odometry=some_rows(recording.odometry, keep))


def some_rows(table: Any, keep: np.ndarray | slice) -> Any:
    """A dataclass of columns with some of its rows; what is not a column stays."""
    columns = {field.name: getattr(table, field.name) for field in fields(table)}
    return replace(table, **{name: column[keep] for name, column in columns.items() if isinstance(column, np.ndarray)})


def with_ids(recording: Recording, rename: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """The same with other names of landmarks."""
    return replace(
        recording, detections=replace(recording.detections, landmark_id=rename(recording.detections.landmark_id))
    )


def without_odometry_between(recording: Recording, start_s: float, stop_s: float) -> Recording:
    """Silent odometry between two times since its start."""
    passed = recording.odometry.stamp_s - recording.odometry.stamp_s[0]
    return with_odometry(recording, (passed < start_s) | (passed > stop_s))
