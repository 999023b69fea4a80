"""The landmark with three places against scipy's densities and a second way to write the same geometry."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binomtest, multivariate_normal

from evermap.errors import ConfigError
from evermap.geometry import se2
from evermap_studies.worlds.moved import ModeConfig, in_robot, log_likelihoods, simulate_modes

CONFIG = ModeConfig()


def test_scenario_is_that_of_the_paper() -> None:
    data = simulate_modes(100, 0.2, CONFIG, 0)
    assert data.measured_m.shape == (100, 30, 2)
    assert data.map_m.shape == (100, 3, 2)
    assert not data.pose.any()
    np.testing.assert_array_equal(data.map_m, np.broadcast_to(np.array(CONFIG.mode_m), (100, 3, 2)))
    assert CONFIG.walk_sigma == (0.01, 0.01, 0.001)


def test_noise_is_white_with_the_variance_asked_for() -> None:
    data = simulate_modes(400, 0.3, CONFIG, 1)
    noise = (data.measured_m - np.array(CONFIG.mode_m)[data.mode]).reshape(-1, 2)
    cov = np.cov(noise.T)
    np.testing.assert_allclose(cov, 0.3 * np.eye(2), atol=4 * 0.3 * np.sqrt(2 / len(noise)))


def test_modes_follow_their_chain() -> None:
    data = simulate_modes(500, 0.1, CONFIG, 2)
    before, after = data.mode[:, :-1].ravel(), data.mode[:, 1:].ravel()
    for start in range(3):
        for to in range(3):
            at = before == start
            hits = int(np.sum(after[at] == to))
            assert binomtest(hits, int(at.sum()), CONFIG.transition[start, to]).pvalue > 1e-4
    np.testing.assert_allclose(CONFIG.transition.sum(axis=1), 1.0)


def test_one_seed_gives_one_story_at_every_noise() -> None:
    few, many = (simulate_modes(7, noise, CONFIG, 5, walks=True) for noise in (0.01, 0.25))
    np.testing.assert_array_equal(few.mode, many.mode)
    np.testing.assert_array_equal(few.pose, many.pose)
    exact = in_robot(few.pose, np.array(CONFIG.mode_m)[few.mode])
    np.testing.assert_allclose(many.measured_m - exact, 5.0 * (few.measured_m - exact), atol=1e-12)
    assert not np.array_equal(simulate_modes(7, 0.01, CONFIG, 6).mode, few.mode)


def test_walk_starts_at_the_origin_and_grows() -> None:
    data = simulate_modes(2000, 0.1, CONFIG, 3, walks=True)
    assert not data.pose[:, 0].any()
    expected = np.sqrt(CONFIG.steps - 1) * np.array(CONFIG.walk_sigma)
    np.testing.assert_allclose(data.pose[:, -1].std(axis=0), expected, rtol=0.08)


def test_likelihoods_are_normal_densities() -> None:
    data = simulate_modes(2, 0.2, CONFIG, 4, walks=True)
    found = log_likelihoods(data.pose, data.map_m, data.measured_m, 0.2)
    for run in range(2):
        for step in (0, 13, 29):
            for mode in range(3):
                at = se2.transform(se2.inverse(data.pose[run, step]), data.map_m[run, mode])
                density = multivariate_normal(at, 0.2 * np.eye(2)).logpdf(data.measured_m[run, step])
                assert found[run, step, mode] == pytest.approx(density)


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"mode_m": ((0.0, 1.0),)}, {"switch_probability": 1.5}])
def test_impossible_scenarios_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        ModeConfig(**wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigError):
        simulate_modes(1, 0.0, CONFIG, 0)
