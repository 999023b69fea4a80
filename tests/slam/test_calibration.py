"""Calibration states: what is fixed stays, and scale is divided as the closed-form posterior says."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from problems import default_prior, make_world
from scipy.stats import chi2, multivariate_normal

from evermap.config import Config, OdometryConfig
from evermap.errors import ConfigError
from evermap.geometry import se2
from evermap.metrics.summary import compare_with_truth
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.pipeline import run_slam
from evermap.slam.calibration import BEARING, FORWARD, NAMES, SLOPE, SPECS, USUAL, CalibrationPrior, needed
from evermap.slam.problem import SPANS, Drive, beyond_jitter
from evermap.slam.smoother import Smoother
from evermap.types import (
    UNKNOWN,
    Detections,
    Frames,
    Odometry,
    ParameterEstimate,
    Recording,
    Sensor,
    SensorKind,
)
from evermap_studies.worlds.robots import draw_robot, simulate_robot


def test_default_prior_is_the_table():
    prior = default_prior()
    assert [spec.name for spec in SPECS] == list(NAMES)
    assert prior.mean.tolist() == [spec.mean for spec in SPECS]
    assert prior.sigma.tolist() == [USUAL.sigma[name] for name in NAMES]
    assert prior.free.all()
    assert not CalibrationPrior.from_settings(calibrated=False).free.any()


def test_unknown_state_is_an_error_that_names_the_known_ones():
    with pytest.raises(ConfigError, match=r"odometry_dealy_s.*odometry_delay_s"):
        default_prior(odometry_dealy_s=0.1)


def posterior_of_product(
    prior: CalibrationPrior, product: float, sigma_product: float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of (log slope, log forward scale) when their sum is measured: a Kalman update."""
    spread = np.diag([prior.sigma[SLOPE] ** 2, prior.sigma[FORWARD] ** 2])
    h = np.ones((1, 2))
    wide = np.log(product / prior.mean[FORWARD])
    # 'measured' is what the likelihood says, without the prior that the graph's own estimate holds already
    total = spread.sum()
    variance = 1.0 / (1.0 / sigma_product**2 - 1.0 / total)
    measured = wide * variance / sigma_product**2
    gain = spread @ h.T / (total + variance)
    return (gain * measured).ravel(), spread - gain @ h @ spread


@pytest.mark.parametrize("product", [0.93, 1.0, 1.06])
@pytest.mark.parametrize("sigma", [1e-4, 0.004, 0.03])
def test_scale_is_divided_by_the_closed_form_posterior(product, sigma):
    prior = default_prior()
    states, covariance = prior.mean.copy(), np.diag(np.full(11, 1e-4))
    states[FORWARD], covariance[FORWARD, FORWARD] = product, sigma**2
    mean, spread = posterior_of_product(prior, product, sigma)
    divided, after, factor, log_sigma = prior.split_scale(states, covariance)
    assert np.log1p(divided[SLOPE]) == pytest.approx(mean[0], abs=1e-12)
    assert np.log(divided[FORWARD]) == pytest.approx(mean[1], abs=1e-12)
    assert factor == pytest.approx(np.exp(-mean[0]))
    assert log_sigma == pytest.approx(np.sqrt(spread[0, 0]), rel=1e-9)
    assert after[SLOPE, SLOPE] == pytest.approx(spread[0, 0], rel=1e-9)
    assert after[FORWARD, FORWARD] == pytest.approx(spread[1, 1], rel=1e-9)


@pytest.mark.parametrize("share", [None, 0.0])
def test_the_metre_of_several_robots_is_their_mean(share):
    """In lengths that are too long by a logarithm, by least squares over all slopes and scales."""
    prior = replace(default_prior(), slope_share=share)
    slope, forward = np.array([0.0, 0.013, -0.02]), np.array([1.04, 1.02, 0.99])
    states, nothing = np.tile(prior.mean, (3, 1)), np.zeros((11, 11))
    states[:, SLOPE], states[:, FORWARD] = slope, forward
    told = [prior.metre(own, nothing) for own in states]
    weight = np.array([1.0 / prior.sigma[SLOPE] ** 2, 1.0 / prior.sigma[FORWARD] ** 2 if share is None else 0.0])
    best = (weight[1] * np.log(forward) - weight[0] * np.log1p(slope)).sum() / (3 * weight.sum())
    for r in range(3):
        divided, after, factor, sigma = prior.split_scale(states[r], nothing, (*told[:r], *told[r + 1 :]))
        assert factor == pytest.approx(np.exp(-best))
        assert sigma == pytest.approx(1.0 / np.sqrt(3 * (prior.sigma[[SLOPE, FORWARD]] ** -2.0).sum()))
        assert divided[SLOPE] == pytest.approx((1.0 + slope[r]) / factor - 1.0)
        assert divided[FORWARD] == pytest.approx(forward[r] * factor)
        assert after[SLOPE, SLOPE] == pytest.approx(sigma**2)


def test_division_explains_every_reading_as_well():
    """Graph and divided solution predict the same ranges and the same motion, in their own metres."""
    prior = default_prior()
    states = np.array([0.03, 0.0, 0.05, -0.4, 0.02, 0.05, -0.04, 0.1, 0.94, 1.05, 0.03])
    divided, _, factor, _ = prior.split_scale(states, np.eye(11) * 1e-6)
    r, b, v, w = 3.7, 0.4, 0.8, -0.6

    def reading(s, r):
        return s[0] + r * (1 + s[1] + s[2] * b + s[3] * b * b)

    def speed(s):
        return s[6] * v - s[8] * abs(w)

    assert reading(divided, factor * r) == pytest.approx(reading(states, r), abs=1e-12)
    assert speed(divided) == pytest.approx(factor * speed(states), abs=1e-12)


def test_where_the_slope_is_fixed_nothing_is_divided():
    prior = default_prior(range_slope=0.01)
    assert prior.without_scale() is prior
    states, covariance = prior.mean + 0.01, np.eye(11) * 1e-4
    divided, after, factor, log_sigma = prior.split_scale(states, covariance)
    assert divided.tolist() == states.tolist()
    assert np.array_equal(after, covariance)
    assert (factor, log_sigma) == (1.0, 0.0)


def test_the_graph_never_sees_the_slope_but_its_uncertainty():
    prior = default_prior()
    graph = prior.without_scale()
    assert not graph.free[SLOPE]
    assert graph.free.sum() == 10
    assert graph.sigma[FORWARD] == pytest.approx(np.hypot(0.05, 0.02))
    assert prior.free.all()  # not changed in place


@pytest.mark.parametrize("name", [n for n in NAMES if n != "range_slope"])
def test_fixed_states_are_left_alone_by_the_division(name):
    prior = default_prior(**{name: 1.01 if name.endswith("scale") else 0.017})
    k = NAMES.index(name)
    graph = prior.without_scale()
    states = graph.mean.copy()
    if graph.free[FORWARD]:
        states[FORWARD] = 0.96
    divided, *_ = prior.split_scale(states, np.diag(np.where(graph.free, 1e-6, prior.sigma**2)))
    assert divided[k] == prior.mean[k]


def test_with_the_odometers_scale_given_the_recording_tells_the_slope():
    """Forward scale fixed and true: the range slope is observable, the map in metres."""
    states = default_prior().mean.copy()
    states[SLOPE] = 0.03
    prior = default_prior(odometry_forward_scale=1.0, range_skew_per_rad=0.0, range_curvature_per_rad2=0.0)
    world = make_world(31, noisy=0.0, states=states, prior=prior, n_poses=200)
    problem = replace(world.problem, prior=prior.without_scale())
    smoother = Smoother(problem, world.noise, robust=False)
    found = smoother.optimum(world.near_truth(np.random.default_rng(0)))
    divided, covariance, factor, _ = prior.split_scale(found.states, smoother.marginals(found).states)
    assert abs(divided[SLOPE] - 0.03) < 3 * np.sqrt(covariance[SLOPE, SLOPE])
    assert divided[SLOPE] == pytest.approx(0.03, abs=0.01)
    assert factor * found.landmark == pytest.approx(world.truth.landmark, rel=0.01, abs=0.05)


@pytest.mark.parametrize(("slope", "forward"), [(0.0, 1.0), (0.02, 0.95), (-0.015, 1.04)])
def test_metres_are_right_when_the_priors_are_told_the_truth(slope, forward):
    """Exact measurements of a sensor with a wrong scale by an odometer with another."""
    truth = np.array([0.05, slope, 0.0, -0.2, 0.01, 0.03, -0.02, 0.2, forward, 1.05, 0.02])
    prior = replace(default_prior(), mean=truth)
    world = make_world(32, noisy=0.0, states=truth, prior=prior)
    problem = replace(world.problem, prior=prior.without_scale())
    smoother = Smoother(problem, world.noise, robust=False)
    found = smoother.optimum(world.near_truth(np.random.default_rng(0)), tolerance=1e-9)
    divided, _, factor, _ = prior.split_scale(found.states, smoother.marginals(found).states)
    assert divided == pytest.approx(truth, abs=1e-6)
    assert factor * found.landmark == pytest.approx(world.truth.landmark, abs=1e-5)
    assert factor * found.pose[:, :2] == pytest.approx(world.truth.pose[:, :2], abs=1e-5)


def test_evidence_of_states_is_that_of_a_gaussian_by_brute_force():
    """Every subset's marginal likelihood as the density of the readings themselves."""
    rng = np.random.default_rng(0)
    prior = replace(default_prior(range_slope=0.0, odometry_delay_s=0.0), p_sensor=0.8)
    free = np.flatnonzero(prior.free)
    design = rng.normal(size=(12, 11)) / prior.sigma * [0.3, 1, 3, 0.5, 2, 1, 4, 1, 0.1, 4, 1]
    truth = np.where(rng.random(11) < 0.5, prior.sigma * rng.normal(size=11), 0.0) * prior.free
    reading = design @ truth + rng.normal(size=12)
    odds, inside = [], []
    for some in product((False, True), repeat=len(free)):
        on = free[np.array(some)]
        covariance = np.eye(12) + (design[:, on] * prior.sigma[on] ** 2) @ design[:, on].T
        p = np.where(free < 5, 0.8, 0.5)
        odds.append(
            multivariate_normal(np.zeros(12), covariance).logpdf(reading) + np.log(np.where(some, p, 1 - p)).sum()
        )
        inside.append(some)
    weight = np.exp(np.array(odds) - np.max(odds))
    expected = weight @ np.array(inside) / weight.sum()
    information = np.diag(1.0 / prior.sigma[free] ** 2) + design[:, free].T @ design[:, free]
    covariance, states = np.zeros((11, 11)), prior.mean.copy()
    covariance[np.ix_(free, free)] = np.linalg.inv(information)
    states[free] += covariance[np.ix_(free, free)] @ design[:, free].T @ reading
    found = needed(prior, states, covariance, np.ones(11))
    assert found[free] == pytest.approx(expected, abs=1e-7)
    assert np.isnan(found[~prior.free]).all()
    # readings that are worth a hundredth tell less
    before = np.where(free < 5, 0.8, 0.5)
    assert np.all(np.abs(needed(prior, states, covariance, np.full(11, 1e6))[free] - before) < 0.05)


def test_the_gaussian_of_the_prior_has_the_variance_of_the_mixture():
    prior = stated(kind=SensorKind.CAMERA)
    rng = np.random.default_rng(0)
    drawn = rng.normal(0.0, prior.sigma, (200_000, len(NAMES))) * (rng.random((200_000, len(NAMES))) < prior.p_needed)
    assert prior.gaussian().sigma == pytest.approx(drawn.std(axis=0), rel=0.02)
    assert prior.p_needed[NAMES.index("mount_left_m")] == 0.5


def test_readings_that_repeat_themselves_are_worth_one():
    """Each detection four times over: the states look four times better known than they are."""
    world = make_world(41, n_poses=400, n_landmarks=12, prior=default_prior(range_slope=0.0))
    problem, noise = world.problem, world.noise

    def worth(problem):
        smoother = Smoother(problem, noise, robust=False)
        found = smoother.optimum(world.near_truth(np.random.default_rng(0)))
        return smoother.worth(found, smoother.marginals(found))

    once = worth(problem)
    again = {name: np.repeat(getattr(problem, name), 4, axis=0) for name in (
        "pose_row", "landmark_row", "reading", "sigma_given"
    )}  # fmt: skip
    repeated = worth(replace(problem, **again))
    assert np.all(once >= 1.0)
    assert np.median(once) < 1.6
    # of the range law only detections speak
    assert np.all(repeated[[0, 3]] > 2.5 * once[[0, 3]])


def test_influence_of_each_residual_on_the_states_is_the_dense_one():
    world = make_world(42, n_poses=60, prior=default_prior(range_slope=0.0))
    smoother = Smoother(world.problem, world.noise, robust=False)
    found = smoother.optimum(world.near_truth(np.random.default_rng(0)), tolerance=1e-9)
    with_states = smoother.marginals(found).with_states
    dense = smoother.marginals(found)
    assert with_states[-11:] == pytest.approx(dense.states, abs=1e-12)
    assert with_states[: 3 * 60].reshape(60, 3, 11) == pytest.approx(dense.pose_shared[:, :, -11:], abs=1e-12)
    assert with_states[3 * 60 : -11] == pytest.approx(dense.shared[:-11, -11:], abs=1e-12)


def stated(**what) -> CalibrationPrior:
    return CalibrationPrior.from_settings(calibrated=True, sensor=Sensor(**what))


def test_kind_and_data_sheet_narrow_the_priors():
    unknown, laser = stated(), stated(kind=SensorKind.LASER)
    assert laser.sigma[:4].tolist() == list(USUAL.kinds[SensorKind.LASER][:4])
    assert (unknown.slope_share, laser.slope_share) == (0.0, None)
    exact = stated(kind=SensorKind.CAMERA, sigma_scale=0.001, sigma_offset_m=0.02, sigma_odometer_scale=0.1)
    assert exact.sigma[[0, 1, FORWARD]].tolist() == [0.02, 0.001, 0.1]
    states, covariance = exact.mean.copy(), np.eye(11) * 1e-6
    states[FORWARD] = 1.05
    assert exact.split_scale(states, covariance)[0][SLOPE] == pytest.approx(0.05 * 0.001**2 / 0.1**2, rel=0.05)
    assert unknown.split_scale(states, covariance)[0][SLOPE] == 0.0


@pytest.mark.parametrize(
    ("what", "share"),
    [
        ({}, 0.0),
        ({"kind": SensorKind.CAMERA}, 0.0),
        ({"sigma_angle_rad": 0.04, "sigma_askew_rad": 0.03}, 0.64),
        ({"sigma_angle_rad": 0.05, "sigma_askew_rad": 0.0}, 1.0),
    ],
)
def test_angle_is_the_robots_unless_the_data_sheet_says_otherwise(what, share):
    prior = stated(**what)
    states, covariance = prior.mean.copy(), np.diag(np.full(11, 1e-6))
    states[BEARING] = 0.08
    after, _, askew, sigma = prior.split_angle(states, covariance)
    assert after[BEARING] == pytest.approx(0.08 * share, abs=1e-6)
    assert askew == pytest.approx(0.08 * (1 - share), abs=1e-6)
    assert sigma > 0.0
    # where the sensor is and how it is turned against what it saw stays
    pose, mount = np.array([3.0, -2.0, 2.5]), np.array([0.4, 0.1, 0.3])
    eye, before = (se2.compose(p, mount) for p in (se2.compose(pose, prior.front(states, mount)), pose))
    assert eye[:2] == pytest.approx(before[:2])
    assert se2.wrap(eye[2] - before[2]) == pytest.approx(-askew)


def robot(kind: SensorKind, seed: int, **states: float) -> Recording:
    """A robot as good as its kind gets, but for some states."""
    drawn = draw_robot(seed)
    values = np.array([spec.mean for spec in SPECS])
    for name, value in states.items():
        values[NAMES.index(name)] = value
    made = replace(
        drawn, kind=kind, states=values, askew_rad=0.0, sigma_range_m=0.01, sigma_range_share=0.0, n_landmarks=20,
        sigma_bearing_rad=0.004, lasting_share=0.5, lasting_s=2.0, range_max_m=12.0, field_of_view_rad=3.0, size_m=15.0,
        rate_hz=3.0, p_detect=0.8, duration_s=200.0,
    )  # fmt: skip
    return simulate_robot(made, seed)


def told(recording: Recording) -> dict[str, ParameterEstimate]:
    return {parameter.name: parameter for parameter in run_slam(recording).parameters}


def test_a_perfect_sensor_is_left_as_stated():
    found = told(robot(SensorKind.LASER, 3))
    asked = [found[name] for name in NAMES if not np.isnan(found[name].p_needed)]
    assert sum(one.p_needed < 0.5 for one in asked) >= 6
    for one, spec in zip((found[name] for name in NAMES), SPECS, strict=True):
        assert one.fixed or abs(one.value - spec.mean) < 2.5 * one.sigma
        assert one.fixed == (one.p_needed < 0.01) or one.name == "range_slope"


def test_errors_are_found_where_they_are():
    truth = {
        "range_bias_m": 0.08,
        "range_curvature_per_rad2": -0.5,
        "odometry_delay_s": -0.15,
        "odometry_turn_scale": 0.93,
    }
    found = told(robot(SensorKind.CAMERA, 4, **truth))
    for name, value in truth.items():
        assert found[name].p_needed > 0.99
        assert abs(found[name].value - value) < 3.5 * found[name].sigma


def test_a_sensor_that_sits_elsewhere_is_found_there():
    """Poses and map are as good as if the mount were stated right, which they are not where it is held."""
    off = {"mount_forward_m": 0.2, "mount_left_m": -0.1}
    recording = robot(SensorKind.STEREO, 0, **off)
    result = run_slam(recording)
    found = {parameter.name: parameter for parameter in result.parameters}
    for name, value in off.items():
        assert found[name].p_needed > 0.99
        assert abs(found[name].value - value) < 3.5 * found[name].sigma
    stated = replace(recording, sensor=replace(recording.sensor, mount_robot_sensor=(0.2, -0.1, 0.0)))
    held = run_slam(recording, Config(slam={"calibration": {"fix": dict.fromkeys(off, 0.0)}}))
    as_found, as_stated, as_held = (
        evaluate_trajectory(each.trajectory, recording.truth).rmse_m for each in (result, run_slam(stated), held)
    )
    assert as_found < 1.2 * as_stated
    assert as_held > 1.5 * as_stated


def test_heading_is_that_of_the_sensor_as_stated():
    """What an estimate without calibration has; both readings are told."""
    recording = robot(SensorKind.LASER, 5, bearing_bias_rad=0.08)
    result = run_slam(recording, Config(slam={"online": True}))
    plain = run_slam(recording, Config(slam={"sensor_model": "plain"}))
    turn = se2.wrap(result.trajectory.pose_world_robot[:, 2] - plain.trajectory.pose_world_robot[:, 2])
    assert np.abs(turn).max() < np.radians(2.0)
    assert result.trajectory.pose_world_robot[0] == pytest.approx(np.zeros(3), abs=1e-4)
    assert result.online.pose_world_robot[0] == pytest.approx(np.zeros(3), abs=1e-9)
    found = {parameter.name: parameter for parameter in result.parameters}
    assert found["bearing_bias_rad"].value == 0.0
    assert found["odometry_askew_rad"].value == pytest.approx(0.08, abs=0.01)
    assert "0.08" in found["bearing_bias_rad"].meaning


def test_average_of_as_stated_and_estimated_is_the_optimum_of_the_narrower_prior():
    prior = default_prior()
    p, data, seen = np.linspace(0.05, 0.95, 11), np.linspace(3.0, 900.0, 11) / prior.sigma**2, 0.7 * prior.sigma
    variance = 1.0 / (data + 1.0 / prior.sigma**2)
    estimated = variance * data * seen
    states = prior.mean + estimated
    averaged, means = prior.averaged(p, states, variance, np.ones(11))
    assert data * seen / (data + 1.0 / averaged.sigma**2) == pytest.approx(p * estimated)
    assert means - prior.mean == pytest.approx(p * estimated)
    # where ten readings are worth one, the prior counts ten times as much
    fewer, means = prior.averaged(p, states, variance, np.full(11, 10.0))
    less = 0.1 * data * seen / (0.1 * data + 1.0 / prior.sigma**2)
    assert data * seen / (data + 1.0 / fewer.sigma**2) == pytest.approx(p * less)
    assert means - prior.mean == pytest.approx(p * less)
    spared, means = prior.averaged(np.full(11, 0.001), states, variance, np.ones(11))
    assert not spared.free.any()
    assert np.array_equal(means, prior.mean)
    same, means = prior.averaged(np.ones(11), states, variance, np.ones(11))
    assert same.sigma.tolist() == pytest.approx(prior.sigma.tolist())
    assert means == pytest.approx(states)


def test_jitter_of_reported_velocities_is_told_from_their_changes():
    rng = np.random.default_rng(5)
    stamp = np.arange(0.0, 400.0, 0.05)
    velocity = np.column_stack([0.5 + 0.4 * np.sin(stamp / 3), np.zeros(len(stamp)), np.sign(np.sin(stamp / 7))])
    noise = np.array([0.05, 0.0, 0.1]) * rng.normal(size=velocity.shape)
    assert np.sqrt(Drive.from_rows(stamp, velocity).jitter.mean(axis=0)) == pytest.approx(np.zeros(3), abs=1e-3)
    assert np.sqrt(Drive.from_rows(stamp, velocity + noise).jitter.mean(axis=0)) == pytest.approx(
        [0.05, 0.0, 0.1], rel=0.05, abs=1e-9
    )


def test_what_stands_does_not_jitter():
    """Slow rows, half of which stand: a jitter of all rows would hide that starts and stops show a delay."""
    rng = np.random.default_rng(7)
    stamp = np.arange(0.0, 400.0, 0.5)
    drives = stamp % 80.0 >= 40.0
    velocity = np.where(drives, 1.0, 0.0)[:, None] * [1.0, 0.0, 0.2] + 1e-6 * stamp[:, None]
    noise = drives[:, None] * np.array([0.05, 0.0, 0.02]) * rng.normal(size=(len(stamp), 3))
    variance = Drive.from_rows(stamp, velocity + noise).jitter[: len(stamp)]
    inner = np.convolve(drives, np.ones(41), "same")
    assert variance[inner == 0.0] == pytest.approx(0.0, abs=1e-12)
    assert np.sqrt(variance[inner == 41.0].mean(axis=0)) == pytest.approx([0.05, 0.0, 0.02], rel=0.15, abs=1e-9)


def stopping(late_s: float, seed: int) -> Recording:
    """A forklift that drives around a square, turns at its corners, and stands for twenty seconds each time around.

    Its odometry has two rows a second; frames are stamped late.
    """
    rng = np.random.default_rng(seed)
    side = [(1.5, 0.0)] * 300 + [(0.8, np.pi / 6.0)] * 150  # fifty a second
    speed, turn = np.array((side * 4 + [(0.0, 0.0)] * 1000) * 3).T
    slip = np.repeat(rng.normal(1.0, 0.02, (len(speed) // 50, 2)), 50, axis=0).T
    heading = np.concatenate([[0.0], np.cumsum(turn) * 0.02])
    at = np.cumsum(
        np.vstack([[0.0, 0.0], speed[:, None] * np.array([np.cos(heading[:-1]), np.sin(heading[:-1])]).T * 0.02]), 0
    )
    place = at[rng.integers(0, 1500, 40)] + rng.choice([-1.0, 1.0], (40, 2)) * rng.uniform(2.0, 4.0, (40, 2))
    frame = np.arange(0, len(speed), 10)
    away = place[None] - at[frame, None]
    far, bearing = np.hypot(away[..., 0], away[..., 1]), np.arctan2(away[..., 1], away[..., 0]) - heading[frame, None]
    seen, row = np.nonzero((far < 8.0) & (np.cos(bearing) > 0.8) & (rng.random(far.shape) < 0.8))
    none, count = np.full(len(seen), np.nan), len(seen)
    detections = Detections(
        seen, row, far[seen, row] + rng.normal(0.0, 0.05, count),
        se2.wrap(bearing[seen, row]) + rng.normal(0.0, 0.01, count),
        np.full(count, UNKNOWN), none, none, np.zeros(count, dtype=int),
    )  # fmt: skip
    driven = (np.array([speed, turn]) * slip).reshape(2, -1, 25).mean(axis=2)
    odometry = Odometry(0.5 * np.arange(len(driven[0])), driven[0], np.zeros(len(driven[0])), driven[1])
    return Recording("stops", odometry, Frames(0.02 * frame + late_s), detections, Sensor(0.1, 8.0, -0.65, 0.65))


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_stops_show_a_delay_though_the_odometry_is_slow(seed: int):
    delay = told(stopping(0.2, seed))["odometry_delay_s"]
    assert delay.p_needed > 0.99
    assert delay.value == pytest.approx(-0.2, abs=0.03)
    assert delay.sigma < 0.02


def test_a_turn_counts_and_the_jitter_of_its_report_does_not():
    rng = np.random.default_rng(6)
    for rate_hz, sigma in ((5.0, 0.02), (100.0, 0.05)):
        stamp = np.arange(0.0, 200.0, 1.0 / rate_hz)
        turning = np.where(stamp % 50.0 < 10.0, 0.5, 0.0)
        reported = turning + sigma * rng.normal(size=len(stamp))
        beyond = beyond_jitter(stamp, reported)
        long_straight = stamp % 50.0 > 15.0
        assert (beyond[long_straight] ** 2).sum() < 0.03 * (reported[long_straight] ** 2).sum()
        assert beyond[turning > 0.0].sum() == pytest.approx(turning.sum(), rel=0.02)
        assert beyond_jitter(stamp, turning) == pytest.approx(turning, rel=0.02)
        # by what was reported until then, and not long before
        later = stamp > 60.0 - SPANS * OdometryConfig().turn_s - 1.0
        assert beyond_jitter(stamp[later], reported[later])[stamp[later] > 60.0] == pytest.approx(beyond[stamp > 60.0])
    few = np.array([0.1, -0.2, 0.3])
    for count in range(4):
        assert beyond_jitter(np.arange(count) * 0.1, few[:count]).tolist() == few[:count].tolist()


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_gyroscope_that_jitters_on_the_straight_says_nothing_of_its_scale(seed):
    """Down an aisle, round where nothing is seen, and back through another: the turn is as the odometry has it."""
    from benchmarks.harsh import simulate_copied_aisles

    recording = simulate_copied_aisles(seed)
    result = run_slam(recording)
    assert evaluate_trajectory(result.trajectory, recording.truth).rmse_m < 3.0  # the odometry alone: 1 to 2 m
    scale = next(p for p in result.parameters if p.name == "odometry_turn_scale")
    assert abs(scale.value - 1.0) < 3.0 * np.hypot(scale.sigma, 0.01)
    # and the covariance is honest
    at = np.searchsorted(recording.truth.stamp_s, result.trajectory.stamp_s - 1e-6)
    true = recording.truth.pose_world_robot[at]
    off = se2.between(se2.compose(se2.inverse(true[0]), true), result.trajectory.pose_world_robot)[:, 2]
    assert np.sqrt(np.mean(off**2)) < 2.0 * np.sqrt(result.trajectory.covariance[:, 2, 2].mean())


@pytest.mark.slow
def test_poses_in_a_map_are_known_as_well_as_the_place_of_the_sensor_on_the_robot():
    """Mounts of robots are off by 4 cm, on most axes of six in ten: poses were held to be surer than they are (2.3)."""
    nees = []
    for seed in range(4100, 4125):
        made = draw_robot(seed)
        recording = simulate_robot(replace(made, duration_s=120.0), seed)
        places = recording.true_landmarks
        known = np.broadcast_to(1e-4 * np.eye(2), (len(places), 2, 2)).copy()
        result = run_slam(recording, prior_map=replace(places, covariance_m2=known))
        found = compare_with_truth(recording, result, rate_hz=2.0).poses
        nees.append(np.median(found.nees) / chi2.median(found.dof))
    assert 0.5 < np.mean(nees) < 1.6
