"""A session solved with the map as prior: one that was bent before comes out as one that was not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import Config
from evermap.geometry import se2
from evermap.maps.living import LivingMap
from evermap.maps.sessions.gaussian import own_landmarks
from evermap.maps.sessions.placing import Held, refitted
from evermap.pipeline import solve_alone
from evermap.slam.batch import Outcome
from evermap.slam.estimate import Solved
from evermap.slam.problem import Estimate
from evermap.types import FloatArray, IntArray
from evermap_studies.sim import BuildingConfig, DriveConfig, OdometryConfig, SimulatedSensor, simulate_building


@pytest.fixture(scope="module")
def alone() -> Solved:
    """One lap of a small building."""
    config = BuildingConfig(
        days=1,
        patrol_s=80.0,
        length_m=12.0,
        rooms_per_side=1,
        drive=DriveConfig(truth_hz=20.0),
        odometry=OdometryConfig(rate_hz=10.0),
        sensor=SimulatedSensor(rate_hz=2.0),
    )
    return solve_alone(simulate_building(config, seed=1).sessions[0], LivingMap(), Config())


def in_map(alone: Solved, outcome: Outcome, row: IntArray, place_m: FloatArray) -> tuple[Outcome, bool]:
    """Solved with places that are known to a centimetre, in the frame of the session."""
    covariance = 1e-4 * np.eye(2 * len(row))
    return refitted(outcome, alone.prior, np.zeros(3), 1.0, Held(row, place_m, covariance), robust=True)


@pytest.mark.parametrize("bend", [(0.0, 0.0, 0.6), (4.0, -3.0, 0.0), (-6.0, 5.0, 2.5)])
def test_a_bent_session_is_straightened(alone: Solved, bend: tuple[float, float, float]) -> None:
    """From its middle on everything is turned and shifted, as after a blind stretch; most landmarks are in the map."""
    outcome = alone.outcome
    row = own_landmarks(outcome).row[::2]
    place_m = outcome.graph_estimate.landmark[row]
    straight, was_bent = in_map(alone, outcome, row, place_m)
    assert not was_bent

    estimate = outcome.graph_estimate
    pose, landmark = estimate.pose.copy(), estimate.landmark.copy()
    half = len(pose) // 2
    pose[half:] = se2.compose(np.array(bend), pose[half:])
    seen_after = np.setdiff1d(outcome.problem.landmark_row[outcome.problem.pose_row >= half], row)
    landmark[seen_after] = se2.transform(np.array(bend), landmark[seen_after])
    bent = replace(outcome, graph_estimate=Estimate(pose, landmark, estimate.states))
    again, _ = in_map(alone, bent, row, place_m)
    assert again.inlier.mean() == pytest.approx(straight.inlier.mean(), abs=1e-3)
    apart = se2.between(again.estimate.pose, straight.estimate.pose)
    np.testing.assert_allclose(np.column_stack([apart[:, :2], se2.wrap(apart[:, 2])]), 0.0, atol=2e-3)


def test_the_map_says_whether_a_state_is_needed(alone: Solved) -> None:
    """Shelves that the map has 12 cm further away than they were seen show an offset of ranges: it is certain then.

    Whatever the session alone made of it; and an offset that it doubts is no further off than it is large.
    """
    outcome = alone.outcome
    row = own_landmarks(outcome).row
    place_m = outcome.graph_estimate.landmark[row]
    doubted = replace(outcome, p_needed=np.where(np.isnan(outcome.p_needed), np.nan, 0.02))
    same, _ = in_map(alone, doubted, row, place_m)
    variance = np.diag(same.states_covariance)
    spread = np.diag(same.fit_marginals.states) * same.problem.prior.free
    off = same.estimate.states - same.problem.prior.mean
    assert np.all(variance[2:4] <= 4.0 * spread[2:4] + off[2:4] ** 2 + 1e-6)
    reading = doubted.problem.reading - [0.12, 0.0]
    problem, noise = replace(doubted.problem, reading=reading), doubted.smoother.noise
    nearer = replace(doubted, smoother=doubted.smoother.under(noise, heavy=doubted.smoother.heavy, problem=problem))
    moved, _ = in_map(alone, nearer, row, place_m)
    assert moved.p_needed[0] > 0.99
    assert moved.estimate.states[0] == pytest.approx(same.estimate.states[0] - 0.12, abs=0.02)
    assert np.sqrt(moved.states_covariance[0, 0]) < 0.02
