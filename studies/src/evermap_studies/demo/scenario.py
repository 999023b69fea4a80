"""The building of the demonstration: four weeks in which everything but its walls is moved, seen in parts."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from evermap_studies.sim import (
    CLUTTER,
    ROOM_DOORS,
    BuildingConfig,
    BuildingSimulation,
    Duration,
    ObjectClass,
    SimulatedSensor,
    simulate_building,
)

FURNITURE: tuple[ObjectClass, ...] = (
    ObjectClass("marker", "wall", count=10, landmarks=(1, 1)),
    ObjectClass("door", "hinge", count=4, landmarks=(2, 2), size_m=(0.95, 0.05), stay=Duration(1.0)),
    ObjectClass(
        "shelf", count=5, landmarks=(3, 4), size_m=(1.6, 0.5), against_wall=True, stay=Duration(30.0, 3.0),
        absence=Duration(3.0), p_vanish=0.2, p_nudge=0.5, p_other_room=0.2,
    ),
    ObjectClass(
        "pallet", count=5, landmarks=(2, 3), size_m=(1.2, 0.8), stay=Duration(6.0, 1.5),
        absence=Duration(2.0), p_vanish=0.7, p_return=0.5, p_same_place=0.5, p_nudge=0.4, arrivals_per_day=0.3,
    ),
    ObjectClass(
        "chair", count=7, landmarks=(1, 2), size_m=(0.5, 0.5), stay=Duration(4.0),
        absence=Duration(1.0), p_vanish=0.2, p_return=0.9, p_nudge=0.7, p_other_room=0.1,
    ),
    ObjectClass(
        "cart", count=4, landmarks=(2, 2), size_m=(0.9, 0.6), stay=Duration(2.0),
        absence=Duration(1.0), p_vanish=0.5, p_return=0.9, p_same_place=0.6, p_nudge=0.2, p_other_room=0.5,
    ),
)  # fmt: skip
"""Markers stay for ever, shelves for about a month, pallets a week, chairs half a week, carts two days, doors one."""
CLASSES: tuple[ObjectClass, ...] = (*FURNITURE, CLUTTER)
"""What the building of the demonstration holds: furniture, and crates that stay some hours."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """How much is simulated.

    Attributes:
        days: length of the whole.
        sessions_per_day: patrols a day, between 8 and 18 o'clock.
        patrol_lengths_s: every patrol draws one of these, and its own route through some of the rooms.
        wing_opens_day: day, from 0, on which the robot gets into the eastern wing.
        change_rate: factor on how often things move, come and go.
        sensor_hz: how often the robot looks.
    """

    days: int = 28
    sessions_per_day: int = 2
    patrol_lengths_s: tuple[float, ...] = (30.0, 60.0, 90.0, 150.0)
    wing_opens_day: int = 14
    change_rate: float = 1.0
    sensor_hz: float = 2.0

    @property
    def sessions(self) -> int:
        """Patrols in all."""
        return self.days * self.sessions_per_day

    def simulate(self, seed: int) -> BuildingSimulation:
        """The building, what happens in it, and what the robot records.

        Raises:
            ConfigError: a value is out of range.
        """
        config = BuildingConfig(
            days=self.days,
            sessions_per_day=self.sessions_per_day,
            change_rate=self.change_rate,
            length_m=25.0,
            depth_m=14.5,
            rooms_per_side=3,
            classes=CLASSES,
            patrol_lengths_s=self.patrol_lengths_s,
            doors=ROOM_DOORS,
            wing_opens_day=self.wing_opens_day,
            # without a length standard no estimator can tell the size of a building: 1 % of slope would put 0.1 m of
            # error into every map and hide what is to be shown
            sensor=SimulatedSensor(range_slope=0.0, rate_hz=self.sensor_hz),
        )
        return simulate_building(config, seed=seed)

    def as_dict(self) -> dict[str, Any]:
        """For the summary."""
        return asdict(self)
