"""Made-up sessions in which groups of landmarks moved, before them or within them, and the map from before."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from problems import World, default_prior, make_world, slow_detection

from evermap.config import ChangesConfig, SlamConfig
from evermap.geometry import se2
from evermap.slam.changes.explain import GivenMap
from evermap.slam.changes.joint import Joint
from evermap.slam.method import Explanation
from evermap.slam.problem import Estimate, Problem, independent
from evermap.slam.smoother import Smoother

ALIGNED_INFORMATION = 1e-2
"""The start is not known once a session is in a map."""


@dataclass(frozen=True)
class Move:
    """`members` move by `by` and turn about their centroid; within the session at `at_s`, else before it."""

    members: tuple[int, ...]
    by: tuple[float, float]
    turn_rad: float = 0.0
    at_s: float | None = None

    def applied(self, position: np.ndarray) -> np.ndarray:
        rows = list(self.members)
        centre = position[rows].mean(axis=0)
        moved = position.copy()
        moved[rows] = centre + self.by + (position[rows] - centre) @ se2.rotation(self.turn_rad).T
        return moved


@dataclass
class Session:
    """What the robot measured, the map it had, and what is true.

    `before` (L, 2) are the places at the start of the session, `after` those at its end.
    """

    world: World
    problem: Problem
    given: GivenMap | None
    before: np.ndarray
    after: np.ndarray

    @property
    def static(self) -> Estimate:
        """What somebody believes for whom nothing moves."""
        start = self.world.near_truth(np.random.default_rng(0))
        start = replace(start, landmark=self.before.copy())
        return Smoother(self.problem, self.world.noise, heavy=True).optimum(start, tolerance=1e-4)

    def method(self, prior: ChangesConfig | None = None) -> Joint:
        """The joint search, before it has seen anything."""
        return Joint(
            len(self.before), self.world.problem.prior, self.given, SlamConfig(changes=prior or ChangesConfig())
        )

    def revised(self, prior: ChangesConfig | None = None) -> tuple[Joint, Explanation]:
        """What the method makes of the whole session, as the estimator asks it at the end."""
        method = self.method(prior)
        problem, estimate = method.unprejudice(self.problem, self.static)
        estimate = Smoother(problem, self.world.noise, heavy=True).optimum(estimate, tolerance=1e-4)
        return method, method.revise(problem, estimate, self.world.noise, heavy=False, final=True)


def make_session(
    seed: int,
    *moves: Move,
    sigma_map_m: float = 0.02,
    map_factor: float = 1.0,
    unmapped: tuple[int, ...] = (),
    with_map: bool = True,
    n_poses: int = 240,
    n_landmarks: int = 10,
    p_seen: float = 0.3,
    **options: object,
) -> Session:
    """A robot that goes round in the middle of landmarks; the map has them where they were before all `moves`.

    Its errors are `map_factor` times what it says.
    """
    world = make_world(
        seed, n_poses=n_poses, n_landmarks=n_landmarks, p_seen=p_seen, turn_radps=0.4, reach=0.4, **options  # type: ignore[arg-type]
    )  # fmt: skip
    rng = np.random.default_rng([seed, 1])
    truth, problem = world.truth, world.problem
    old = truth.landmark.copy()  # where the map has them
    before, after = old.copy(), old.copy()
    reading = problem.reading.copy()
    stamp_s = problem.stamp_s[problem.pose_row]
    for move in moves:
        if move.at_s is None:
            before = move.applied(before)
        after = move.applied(after)
    place = before[problem.landmark_row]
    for move in moves:
        if move.at_s is not None:
            gone = np.isin(problem.landmark_row, move.members) & (stamp_s >= move.at_s)
            place[gone] = after[problem.landmark_row[gone]]
    pose = truth.pose[problem.pose_row]
    reading += slow_detection(pose, place, truth.states, problem.mount)
    reading -= slow_detection(pose, old[problem.landmark_row], truth.states, problem.mount)
    reading[:, 1] = se2.wrap(reading[:, 1])
    problem = replace(problem, reading=reading)
    given = None
    if with_map:
        held = ~np.isin(np.arange(n_landmarks), unmapped)
        mean = np.where(held[:, None], old + map_factor * sigma_map_m * rng.normal(size=old.shape), 0.0)
        given = GivenMap(mean, np.tile(sigma_map_m**2 * np.eye(2), (n_landmarks, 1, 1)), held)
        information = independent(np.where(held[:, None, None], np.eye(2) / sigma_map_m**2, 0.0))
        problem = replace(
            problem,
            start_information=ALIGNED_INFORMATION,
            landmark_mean=mean,
            landmark_information=information,
        )
    else:
        problem = replace(problem, prior=default_prior().without_scale())
    return Session(world, problem, given, before, after)


def landmark_rmse(session: Session, revision: Explanation, *, at_start: bool = False) -> float:
    """Of the places now, or of those at the start."""
    place = np.arange(len(session.before)) if at_start else revision.current
    error = revision.estimate.landmark[place] - (session.before if at_start else session.after)
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def pose_rmse(session: Session, estimate: Estimate) -> float:
    error = estimate.pose[:, :2] - session.world.truth.pose[:, :2]
    return float(np.sqrt((error**2).sum(axis=1).mean()))
