"""Made-up worlds in which one landmark moves half-way, and the same problem for one who was told."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from problems import World, make_world, slow_detection

from evermap.config import ModesConfig
from evermap.geometry import se2
from evermap.slam.problem import Estimate, Problem, padded
from evermap.slam.smoother import Smoother
from evermap.types import Sensor
from evermap_studies.nielsen2024.modes.alternation import ModeModel

SENSOR = Sensor(p_detect=0.7, mount_robot_sensor=(0.2, -0.1, 0.3))

FAR = (4.0, -3.0)


@dataclass
class MovingWorld:
    """`problem` takes all detections of landmark `moved` for the same place; `told` has a second one, its last row."""

    world: World
    moved: int
    since: int
    at: np.ndarray
    problem: Problem
    told: Problem

    def static_optimum(self, *, heavy: bool = True) -> Estimate:
        """What somebody believes for whom nothing moves."""
        start = self.world.near_truth(np.random.default_rng(0))
        return Smoother(self.problem, self.world.noise, heavy=heavy).optimum(start)

    def told_optimum(self) -> Estimate:
        start = self.world.near_truth(np.random.default_rng(0))
        start = replace(start, landmark=np.vstack([start.landmark, self.at]))
        near = Smoother(self.told, self.world.noise, heavy=True).optimum(start)
        return Smoother(self.told, self.world.noise).optimum(near, iterations=60, tolerance=1e-9)


def make_moving_world(
    seed: int, *, by: tuple[float, float] = FAR, since: int | None = None, **options: object
) -> MovingWorld:
    """Landmark 2 is elsewhere from a pose on, by default the middle one; noise as in the static world."""
    world = make_world(seed, **{"n_poses": 60, "n_landmarks": 6, "n_mapped": 6, **options})  # type: ignore[arg-type]
    problem, truth = world.problem, world.truth
    moved, since = 2, len(problem.stamp_s) // 2 if since is None else since
    at = truth.landmark[moved] + by
    late = (problem.landmark_row == moved) & (problem.pose_row >= since)
    reading = problem.reading.copy()
    for m in np.flatnonzero(late):
        pose = truth.pose[problem.pose_row[m]]
        was, is_ = (slow_detection(pose, x, truth.states, problem.mount) for x in (truth.landmark[moved], at))
        reading[m] += is_ - was
    reading[:, 1] = se2.wrap(reading[:, 1])
    problem = replace(problem, reading=reading)
    count = len(problem.landmark_mean)
    told = replace(
        problem,
        landmark_row=np.where(late, count, problem.landmark_row),
        landmark_mean=np.vstack([problem.landmark_mean, np.zeros(2)]),
        landmark_information=padded(problem.landmark_information, 1),
    )
    return MovingWorld(world, moved, since, at, problem, told)


def model_of(method: str, **settings: object) -> ModeModel:
    return ModeModel.from_settings(method, ModesConfig(**settings), SENSOR)  # type: ignore[arg-type]
