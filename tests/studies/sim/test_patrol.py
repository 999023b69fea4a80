"""The drive and what odometry says about it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp

from evermap_studies.sim import BuildingConfig, DriveConfig, OdometryConfig, simulate_building

ONE_LAP = BuildingConfig(days=2, patrol_s=170.0, change_rate=0.0)
PERFECT = OdometryConfig(
    rate_hz=50.0, delay_s=0.0, forward_scale=1.0, angular_scale=1.0, forward_noise_m=0.0, angular_noise_rad=0.0
)


def integrate(stamp_s, forward, angular, pose, end_s):
    """Unicycle driven by zero-order-hold velocities, as complex numbers: chord of every arc."""
    dt = np.diff(np.append(stamp_s, end_s))
    theta = pose[2] + np.concatenate([[0.0], np.cumsum(angular * dt)])
    turn = angular * dt
    chord = forward * dt * np.sinc(turn / (2 * np.pi)) * np.exp(1j * (theta[:-1] + turn / 2))
    place = complex(pose[0], pose[1]) + np.concatenate([[0.0], np.cumsum(chord)])
    return place, theta


@pytest.mark.parametrize("rate_hz", [50.0, 25.0, 20.0])
def test_perfect_odometry_integrates_to_the_truth(rate_hz):
    config = replace(ONE_LAP, days=1, odometry=replace(PERFECT, rate_hz=rate_hz), drive=DriveConfig(slip_m=0.0))
    recording = simulate_building(config, 1).sessions[0]
    odometry, truth = recording.odometry, recording.truth
    place, theta = integrate(odometry.stamp_s, odometry.forward_mps, odometry.angular_radps,
                             truth.pose_world_robot[0], truth.stamp_s[-1])  # fmt: skip
    end = truth.pose_world_robot[-1]
    # at the control rate to the rounding of stamps; at other rates up to the shape of the arc within a period
    tolerance = 2e-4 if rate_hz == 50.0 else 1e-2
    assert abs(place[-1] - complex(*end[:2])) < tolerance
    assert abs(np.angle(np.exp(1j * (theta[-1] - end[2])))) < 1e-4


def test_truth_solves_the_equations_of_motion():
    """The true poses against an ODE solver fed with their own velocities."""
    config = replace(ONE_LAP, days=1, patrol_s=20.0, odometry=PERFECT, drive=DriveConfig(slip_m=0.0))
    recording = simulate_building(config, 2).sessions[0]
    truth, odometry = recording.truth, recording.odometry
    time = odometry.stamp_s - odometry.stamp_s[0]

    def motion(t, state):
        row = max(np.searchsorted(time, t + 1e-6, side="right") - 1, 0)
        v, w = odometry.forward_mps[row], odometry.angular_radps[row]
        return [v * np.cos(state[2]), v * np.sin(state[2]), w]

    state = truth.pose_world_robot[0]
    for row in range(len(time) - 1):
        middle = (time[row] + time[row + 1]) / 2
        solved = solve_ivp(lambda _, s, at=middle: motion(at, s), (time[row], time[row + 1]), state, rtol=1e-8)
        state = solved.y[:, -1]
    expected = truth.pose_world_robot[len(time) - 1]
    np.testing.assert_allclose(state[:2], expected[:2], atol=1e-4)


def test_odometry_errors_are_the_configured_ones():
    """Delay, scales and noise, recovered by regression on the true velocities."""
    config = replace(ONE_LAP, odometry=OdometryConfig(delay_s=0.2, forward_scale=1.05, angular_scale=0.96))
    for recording in simulate_building(config, 3).sessions:
        odometry, truth = recording.odometry, recording.truth
        pose = truth.pose_world_robot
        time = truth.stamp_s - truth.stamp_s[0]
        heading = np.unwrap(pose[:, 2])
        path = np.concatenate([[0.0], np.cumsum(np.sum(np.diff(pose[:, :2], axis=0) * np.stack(
            [np.cos(heading[:-1]), np.sin(heading[:-1])], axis=1), axis=1))])  # fmt: skip
        at = odometry.stamp_s - odometry.stamp_s[0] - 0.2
        for integral, reported, scale, noise in (
            (path, odometry.forward_mps, 1.05, 0.012),
            (heading, odometry.angular_radps, 0.96, 0.015),
        ):
            true = (np.interp(at + 0.04, time, integral) - np.interp(at, time, integral)) / 0.04
            residual = (reported - scale * true) * np.sqrt(0.04) / noise
            assert abs(stats.norm.ppf(stats.chi2(len(residual)).cdf(np.sum(residual**2)))) < 4.0
            assert abs(np.corrcoef(residual[1:], residual[:-1])[0, 1]) < 4.0 / np.sqrt(len(residual))
            fit = np.sum(reported * true) / np.sum(true**2)
            assert fit == pytest.approx(scale, abs=5 * noise / np.sqrt(0.04 * np.sum(true**2)))
        assert not odometry.lateral_mps.any()


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 4))])
def test_the_robot_visits_every_room_and_no_wall(seed):
    simulation = simulate_building(ONE_LAP, seed)
    walls = simulation.plan.walls_m
    for recording in simulation.sessions:
        pose = recording.truth.pose_world_robot
        rooms = {simulation.plan.room_of(point) for point in pose[::10, :2]}
        assert rooms == {-1, 0, 1, 2, 3, 4, 5}
        # densely sampled walls, so that this shares no geometry with the simulator
        dots = np.concatenate([np.linspace(w[0], w[1], 400) for w in walls])
        gap = np.min(np.linalg.norm(pose[::10, None, :2] - dots[None], axis=-1))
        assert gap > 0.35


def test_accelerations_are_bounded():
    config = replace(ONE_LAP, drive=DriveConfig(slip_m=0.0), odometry=PERFECT)
    for recording in simulate_building(config, 7).sessions:
        v, w = recording.odometry.forward_mps, recording.odometry.angular_radps
        bound = config.drive
        # stamps near 1.7e9 s are rounded to 0.24 microseconds, which the velocities do not feel
        assert np.abs(np.diff(v)).max() * 50.0 <= bound.acceleration_mps2 * (1 + 1e-4)
        assert np.abs(np.diff(w)).max() * 50.0 <= bound.turn_acceleration_radps2 * (1 + 1e-4)
        assert v.max() <= bound.speed_mps + 1e-9
        assert v.min() >= 0.0
        assert np.abs(w).max() <= bound.turn_radps + 1e-9
        assert v[:45].max() == 0.0


def test_slip_is_what_odometry_cannot_see():
    config = replace(ONE_LAP, days=1, odometry=PERFECT, drive=DriveConfig(slip_m=0.01))
    recording = simulate_building(config, 0).sessions[0]
    pose = recording.truth.pose_world_robot
    step = np.diff(pose[:, 0] + 1j * pose[:, 1]) * np.exp(-1j * pose[:-1, 2])
    turn = np.angle(np.exp(1j * np.diff(pose[:, 2])))
    # sideways motion that the arc does not explain
    sideways = (step.imag - step.real * np.tan(turn / 2))[60:]
    normal = sideways / (0.01 * np.sqrt(0.02))
    assert abs(stats.norm.ppf(stats.chi2(len(normal)).cdf(np.sum(normal**2)))) < 4.0
