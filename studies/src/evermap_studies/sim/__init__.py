"""Simulated worlds with the whole truth: a building patrolled by a robot while things move, come and go, and a
warehouse of any size.
"""

from __future__ import annotations

from evermap_studies.sim.building import FloorPlan, Room
from evermap_studies.sim.changes import ChangeEvent, EventKind, Stay
from evermap_studies.sim.config import (
    CLUTTER,
    DEFAULT_CLASSES,
    ROOM_DOORS,
    BuildingConfig,
    DriveConfig,
    Duration,
    ObjectClass,
    OdometryConfig,
    SimulatedSensor,
)
from evermap_studies.sim.looked import LookedAt, looked_at
from evermap_studies.sim.warehouse import WarehouseConfig, simulate_warehouse
from evermap_studies.sim.world import BuildingSimulation, SessionTruth, simulate_building

__all__ = [
    "CLUTTER",
    "DEFAULT_CLASSES",
    "ROOM_DOORS",
    "BuildingConfig",
    "BuildingSimulation",
    "ChangeEvent",
    "DriveConfig",
    "Duration",
    "EventKind",
    "FloorPlan",
    "LookedAt",
    "ObjectClass",
    "OdometryConfig",
    "Room",
    "SessionTruth",
    "SimulatedSensor",
    "Stay",
    "WarehouseConfig",
    "looked_at",
    "simulate_building",
    "simulate_warehouse",
]
