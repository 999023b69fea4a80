"""What is learned of the sensors, against what the simulator made them."""

from __future__ import annotations

import numpy as np
from judged import SEEDS, judged

from evermap.slam.calibration import SPECS

TRUE_STATES = {
    "range_bias_m": 0.03,
    "range_slope": 0.01,
    "range_skew_per_rad": 0.0,
    "range_curvature_per_rad2": 0.0,
    "bearing_bias_rad": 0.01,
    "odometry_delay_s": 0.12,
    "odometry_forward_scale": 1 / 1.03,
    "odometry_turn_scale": 1 / 1.04,
    "odometry_turn_slip_m": 0.0,
}
"""What the simulator's defaults do to the truth."""


def test_calibration_is_found():
    for seed in SEEDS:
        for name, truth in TRUE_STATES.items():
            found = judged(seed).parameter(name)
            # what is as stated may be held there, and nothing else
            assert abs(found.value - truth) < (1e-12 if found.fixed else 4 * found.sigma), f"{name} of seed {seed}"
        # of the angle only the sum with the robot's driving askew is known
        angle = judged(seed).parameter("bearing_bias_rad").value + judged(seed).parameter("odometry_askew_rad").value
        assert abs(angle - TRUE_STATES["bearing_bias_rad"]) < 0.006
    # and more is known than before
    for name in ("odometry_delay_s", "odometry_turn_scale", "range_bias_m"):
        found = judged(0).parameter(name)
        assert found.sigma < 0.3 * found.prior_sigma


def test_noise_of_the_sensor_is_found():
    for seed in SEEDS:
        for name, truth in (("sigma_range_m", 0.03), ("sigma_bearing_rad", 0.01)):
            found = judged(seed).parameter(name)
            assert abs(found.value - truth) < 4 * found.sigma


def test_a_fixed_state_is_fixed():
    run = judged(0, "slam.calibration.fix.odometry_delay_s=0.12")
    delay = run.parameter("odometry_delay_s")
    assert (delay.value, delay.sigma, delay.fixed) == (0.12, 0.0, True)
    assert not run.parameter("odometry_turn_scale").fixed


def test_a_plain_sensor_model_fixes_everything_and_is_worse():
    plain = judged(0, "slam.sensor_model=plain", with_map=True)
    for spec in SPECS:
        found = plain.parameter(spec.name)
        assert (found.value, found.sigma, found.fixed) == (spec.mean, 0.0, True)
    error = np.linalg.norm(plain.pose_error[:, :2], axis=1).mean()
    assert error > 1.5 * np.linalg.norm(judged(0, with_map=True).pose_error[:, :2], axis=1).mean()


def test_kept_noise_is_the_nominal_one():
    run = judged(0, "slam.estimate_noise=false", "sensor.sigma_range_m=0.05")
    assert run.parameter("sigma_range_m").value == 0.05
    assert run.parameter("sigma_bearing_rad").value == 0.01
