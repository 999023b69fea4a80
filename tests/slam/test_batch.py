"""A recording solved as a whole, from its odometry, against the same frame after frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import Config, LocalizeConfig, SlamConfig
from evermap.geometry import se2
from evermap.pipeline import run_slam
from evermap.slam.batch import Batch, Estimate, PriorMap, _at_states, lay_over_in_metre, middles
from evermap.slam.calibration import FORWARD, SLOPE, CalibrationPrior
from evermap.slam.intake import beliefs, prepare
from evermap.slam.method import Static
from evermap.slam.smoother import Smoother
from evermap.types import Recording, rows_of
from evermap_studies.sim import WarehouseConfig, simulate_warehouse

ONLINE = Config(slam=SlamConfig(online=True))
WAREHOUSE = WarehouseConfig(n_landmarks=60, rate_hz=2.0)


def batch_of(recording: Recording) -> Batch:
    settings = SlamConfig()
    prior, noise = beliefs(recording.sensor, settings)
    return Batch(prior, noise, Static(len(prepare(recording).landmark_id)), settings)


def drifting(recording: Recording, from_s: float, until_s: float, radps: float) -> Recording:
    """The odometry turns more than the robot, for a while."""
    odometry = recording.odometry
    passed = odometry.stamp_s - odometry.stamp_s[0]
    turned = odometry.angular_radps + np.where((passed > from_s) & (passed < until_s), radps, 0.0)
    return replace(recording, odometry=replace(odometry, angular_radps=turned))


def test_the_optimum_is_that_which_the_stream_leads_to() -> None:
    recording = simulate_warehouse(WAREHOUSE)
    whole, stream = run_slam(recording), run_slam(recording, ONLINE)
    gap = se2.between(whole.trajectory.pose_world_robot, stream.trajectory.pose_world_robot)
    sigma = np.sqrt(np.einsum("nii->ni", stream.trajectory.covariance))
    assert np.abs(gap[1:] / sigma[1:]).max() < 0.3
    assert whole.landmarks.position_m == pytest.approx(stream.landmarks.position_m, abs=0.01)
    for mine, theirs in zip(whole.parameters, stream.parameters, strict=True):
        assert abs(mine.value - theirs.value) <= max(mine.sigma, 1e-6), mine.name
    np.testing.assert_allclose(whole.innovations.nis, stream.innovations.nis, rtol=0.2, atol=0.2)


def test_what_was_known_at_the_time_is_computed_where_asked_for() -> None:
    recording = simulate_warehouse(WAREHOUSE)
    whole, stream = run_slam(recording), run_slam(recording, ONLINE)
    assert len(whole.online) == 0
    assert len(stream.online) == len(stream.step_s) == len(whole.step_s)


def test_fewer_poses_are_added_where_the_odometry_leads_astray() -> None:
    """By 2.4 rad in a minute: from all poses at once the optimum is not found again, from some more it is."""
    recording = simulate_warehouse(WAREHOUSE)
    astray = drifting(recording, 100.0, 160.0, 0.04)
    straight, found = (list(batch_of(one).parts(prepare(one).problem)) for one in (recording, astray))
    assert [len(part.problem.stamp_s) for part in straight] == [78, 156, 312]
    assert [len(part.problem.stamp_s) for part in found] == [78, 156, 234, 312]
    assert all(part.fits for part in (*straight, *found))


def test_the_stream_leads_on_where_the_odometry_is_useless() -> None:
    """It turns by 3 rad in 20 s, or is silent: solved frame after frame, and said in what comes out."""
    recording = simulate_warehouse(WAREHOUSE)
    passed = recording.odometry.stamp_s - recording.odometry.stamp_s[0]
    silent = replace(recording, odometry=rows_of(recording.odometry, (passed < 80.0) | (passed > 100.0)))
    for one in (drifting(recording, 110.0, 130.0, 0.15), silent):
        result = run_slam(one)
        assert len(result.online) == len(result.step_s)


def test_an_interrupt_leaves_the_poses_that_were_solved() -> None:
    recording, told = simulate_warehouse(WAREHOUSE), list[float]()

    def stop(done_s: float, _: float) -> None:
        told.append(done_s)
        if len(told) == 4:
            raise KeyboardInterrupt

    result = run_slam(recording, progress=stop)
    assert result.interrupted
    assert told[0] == 0.0
    assert np.all(np.diff(told) > 0.0)
    assert np.ptp(result.trajectory.stamp_s) == pytest.approx(told[-1], abs=1e-6)


def test_all_else_moves_with_the_calibration_states() -> None:
    """To where the measurements expect it: what is left of the cost is that of the states alone."""
    recording = simulate_warehouse(WAREHOUSE)
    prior, noise = beliefs(recording.sensor, SlamConfig())
    problem = replace(prepare(recording).problem, prior=prior.without_scale())
    *_, part = batch_of(recording).parts(problem)
    smoother = Smoother(problem, noise)
    best = smoother.optimum(part.estimate)
    marginals = smoother.marginals(best)
    sigma = np.sqrt(np.diag(marginals.states))
    states = best.states + np.where(problem.prior.free, sigma, 0.0)
    cost = smoother.cost(best)
    together, alone = (
        smoother.cost(other) - cost
        for other in (_at_states(best, marginals, states), Estimate(best.pose, best.landmark, states))
    )
    off = states - best.states
    expected = 0.5 * off @ np.linalg.pinv(marginals.states, hermitian=True) @ off
    assert together == pytest.approx(expected, rel=0.2)
    assert alone > 2.0 * together


def test_medians_are_those_of_numpy() -> None:
    rng = np.random.default_rng(0)
    row, at = rng.choice([0, 1, 3, 4], 61), rng.normal(size=(61, 2))
    found = middles(row, at, 6)
    assert np.isnan(found[[2, 5]]).all()
    for j in (0, 1, 3, 4):
        np.testing.assert_allclose(found[j], np.median(at[row == j], axis=0))


def test_distances_of_a_map_say_what_a_metre_is() -> None:
    place = np.random.default_rng(4).uniform(0.0, 40.0, (6, 2))
    given = PriorMap(place, np.tile(1e4 * np.eye(2), (6, 1, 1)), np.ones(6, dtype=np.bool_))
    prior = CalibrationPrior.from_settings(calibrated=True)

    def lay_stretched(longer: float) -> tuple[Estimate, CalibrationPrior, bool]:
        estimate = Estimate(np.array([[longer, 0.0, 0.0]]), place * longer, prior.mean)
        found, inside, laid = lay_over_in_metre(given, estimate, prior, LocalizeConfig())
        return found, inside, bool(laid)

    found, inside, laid = lay_stretched(1.07)
    assert laid
    np.testing.assert_allclose(found.landmark, place, atol=1e-9)
    assert found.pose[0, 0] == pytest.approx(1.0)
    assert found.states[SLOPE] == pytest.approx(0.07)
    assert found.states[FORWARD] == pytest.approx(1.0 / 1.07)
    assert inside.sigma[SLOPE] == pytest.approx(0.07)  # else the usual one would pull it back
    assert not lay_stretched(1.3)[2]  # no sensor is off by so much: it is another map
    assert lay_stretched(1.0)[1] is prior
