"""The building of the demonstration, and the same building in which nothing ever changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from evermap.sim import BuildingConfig, BuildingSimulation, SensorConfig, simulate_building

if TYPE_CHECKING:
    from evermap.config import Config


@dataclass(frozen=True, slots=True)
class Scenario:
    """How much is simulated.

    Attributes:
        sessions: patrols, one a day; the first makes the map that all later ones use.
        patrol_s: length of a patrol; the default is one lap through all rooms.
        change_rate: factor on how often things move, come and go in the changing building.
        sensor_hz: how often the robot looks.
    """

    sessions: int = 6
    patrol_s: float = 165.0
    change_rate: float = 1.0
    sensor_hz: float = 3.0

    def simulate(self, seed: int) -> tuple[BuildingSimulation, BuildingSimulation]:
        """The changing building, and the one where all stays as it is at first; robot and noise are the same.

        Raises:
            ConfigError: a value is out of range.
        """
        return self._world(self.change_rate, seed), self._world(0.0, seed)

    def estimator(self) -> Config:
        """Default settings, but for a map that is believed for ever and the simulated sensor's true metre."""
        from evermap.config import CalibrationConfig, Config, SlamConfig

        return Config(slam=SlamConfig(method="nohyp", calibration=CalibrationConfig(fix={"range_slope": 0.0})))

    def _world(self, change_rate: float, seed: int) -> BuildingSimulation:
        # without a length standard no estimator can tell the size of a building: 1 % of slope would put 0.1 m of
        # error into every map and hide what is to be shown
        sensor = SensorConfig(range_slope=0.0, rate_hz=self.sensor_hz)
        config = BuildingConfig(days=self.sessions, patrol_s=self.patrol_s, change_rate=change_rate, sensor=sensor)
        return simulate_building(config, seed=seed)

    def as_dict(self) -> dict[str, Any]:
        """For the summary."""
        return {
            "sessions": self.sessions,
            "patrol_s": self.patrol_s,
            "change_rate": self.change_rate,
            "sensor_hz": self.sensor_hz,
        }
