"""What is known of a sensor before and after it was used: by formula, and occlusions against chains that are played."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from evermap.errors import ConfigError
from evermap.sensing.profile import Assumed, Profile, facing_middles, range_middles
from evermap_studies.worlds.sensors import CAMERA, LIDAR


def test_a_sensor_that_saw_nothing_detects_as_assumed():
    assumed = Assumed(field=LIDAR, fading_m=8.0, viewing_angle_rad=math.radians(70.0), p_false=0.02, hits=5.0)
    profile = Profile.of(assumed)
    for i in range(16):
        assert range_middles(16.0)[i] == pytest.approx(i + 0.5)
        assert profile.range_rate[i] == pytest.approx(math.exp(-(i + 0.5) / 8.0))
        cosine = -1.0 + (i + 0.5) / 8.0
        assert facing_middles()[i] == pytest.approx(cosine)
        soft = 1.0 / (1.0 + math.exp(-(cosine - math.cos(math.radians(70.0))) / 0.1))
        assert profile.facing_rate[i] == pytest.approx(max(soft, 1e-3))
    assert profile.p_false == pytest.approx(0.02)
    np.testing.assert_array_equal(profile.range_expected, 5.0)
    np.testing.assert_array_equal(profile.facing_expected, 5.0)
    assert profile.false_looks == 400.0


def test_fading_goes_with_the_range_where_nothing_is_said():
    profile = Profile.of(Assumed(field=replace(CAMERA, range_max_m=40.0)))
    np.testing.assert_allclose(np.log(profile.range_rate), -range_middles(40.0) / 28.0)


def test_chains_are_all_pairs_and_the_first_never_occludes():
    assumed = Assumed(LIDAR, p_never_occluded=0.6, occlusion_rates_hz=(0.01, 0.1), occlusion_lengths_s=(2.0, 4.0, 5.0))
    chain = Profile.of(assumed).occlusion
    pairs = list(zip(chain.come_hz, chain.go_hz, strict=True))
    assert pairs[0][0] == 0.0
    assert sorted(pairs[1:]) == sorted((rate, 1.0 / length) for rate in (0.01, 0.1) for length in (2.0, 4.0, 5.0))
    np.testing.assert_allclose(chain.weight, [0.6, *[0.4 / 6] * 6])


def test_the_share_occluded_is_where_the_chains_settle():
    profile = replace(Profile.of(Assumed(LIDAR)), log_weight=np.log(np.random.default_rng(0).dirichlet(np.ones(13))))
    chain = profile.occlusion
    settled = [
        expm(1e5 * np.array([[-come, come], [go, -go]]))[0, 1]
        for come, go in zip(chain.come_hz, chain.go_hz, strict=True)
    ]
    assert chain.share == pytest.approx(float(chain.weight @ settled))
    assert chain.weight.sum() == pytest.approx(1.0)


def test_weights_of_chains_don_t_depend_on_the_constant():
    profile = Profile.of(Assumed(LIDAR))
    shifted = replace(profile, log_weight=profile.log_weight - 5000.0)
    np.testing.assert_allclose(shifted.occlusion.weight, profile.occlusion.weight, rtol=1e-9)


def learned_of(start: Profile, rng: np.random.Generator) -> Profile:
    """After some looks."""
    gain = {name: getattr(start, name) + rng.exponential(9.0, 16) for name in ("range_hits", "range_expected")}
    gain |= {name: getattr(start, name) + rng.exponential(9.0, 16) for name in ("facing_hits", "facing_expected")}
    false = {"false_hits": start.false_hits + rng.poisson(3.0), "false_looks": start.false_looks + rng.poisson(300.0)}
    return replace(start, **gain, **false, log_weight=start.log_weight + rng.normal(0.0, 2.0, 13))


def equal(one: Profile, other: Profile) -> None:
    for name in ("range_hits", "range_expected", "facing_hits", "facing_expected", "false_hits", "false_looks"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-12, err_msg=name)
    np.testing.assert_allclose(one.occlusion.weight, other.occlusion.weight, rtol=1e-9)


def test_adding_profiles_counts_the_assumptions_once():
    rng = np.random.default_rng(1)
    start = Profile.of(Assumed(LIDAR))
    a, b, c = (learned_of(start, rng) for _ in range(3))
    equal(a + start, a)  # who saw nothing has nothing to add
    equal(a + b, b + a)
    equal((a + b) + c, a + (b + c))
    np.testing.assert_allclose((a + b).range_hits, a.range_hits + b.range_hits - start.range_hits)
    # chains: the two likelihoods and the prior once
    likelihood = np.exp(a.log_weight + b.log_weight - 2.0 * start.log_weight)
    posterior = start.occlusion.weight * likelihood
    np.testing.assert_allclose((a + b).occlusion.weight, posterior / posterior.sum())


def test_profiles_of_other_assumptions_are_not_added():
    with pytest.raises(ConfigError, match="assumed"):
        _ = Profile.of(Assumed(LIDAR)) + Profile.of(Assumed(CAMERA))


@pytest.mark.parametrize(
    "wrong",
    [
        {"fading_m": 0.0},
        {"viewing_angle_rad": 4.0},
        {"p_false": 0.0},
        {"p_false": math.nan},
        {"p_never_occluded": 1.0},
        {"p_false_looks": 0.0},
        {"hits": -1.0},
        {"hits": math.inf},
        {"occlusion_rates_hz": ()},
        {"occlusion_rates_hz": (0.1, 0.0)},
        {"occlusion_lengths_s": (math.inf,)},
        {"sigma_position_m": 0.0},
        {"sigma_attitude_rad": math.nan},
    ],
)
def test_assumptions_that_cannot_be_are_said_in_one_line(wrong):
    (field,) = wrong
    with pytest.raises(ConfigError, match=field) as error:
        Assumed(LIDAR, **wrong)
    assert "\n" not in str(error.value)
