"""Simulated worlds with the whole truth: a building patrolled by a robot while things move, come and go."""

from __future__ import annotations

from evermap.sim.changes import ChangeEvent, ChangeKind, Stay
from evermap.sim.classes import DEFAULT_CLASSES, Duration, ObjectClass
from evermap.sim.config import BuildingConfig, DriveConfig, OdometryConfig, SensorConfig
from evermap.sim.floorplan import FloorPlan, Room
from evermap.sim.world import BuildingSimulation, SessionTruth, simulate_building

__all__ = [
    "DEFAULT_CLASSES",
    "BuildingConfig",
    "BuildingSimulation",
    "ChangeEvent",
    "ChangeKind",
    "DriveConfig",
    "Duration",
    "FloorPlan",
    "ObjectClass",
    "OdometryConfig",
    "Room",
    "SensorConfig",
    "SessionTruth",
    "Stay",
    "simulate_building",
]
