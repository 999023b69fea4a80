"""The persistence filter behind the interface of the models of presence."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evermap.errors import ConfigError, NumericalError
from evermap.existence.one_stay import OneStay, PersistenceFilter, births
from evermap.existence.protocol import Instants, Looks
from evermap.survival import (
    Exponential,
    GeneralPurpose,
    LifetimePrior,
    Mixture,
    Uniform,
    Weibull,
    never_leaves,
)
from evermap_studies.rosen2016.callable_hazard import CallableHazard

PRIORS: dict[str, LifetimePrior] = {
    "exponential": Exponential(0.02),
    "general purpose": GeneralPurpose(1e-4, 2.0),
    "weibull": Weibull(60.0, 1.7),
    "some never leave": Mixture.of([Exponential(0.1), never_leaves()], [0.6, 0.4]),
}


def random_looks(seed: int, n_features: int = 7, n: int = 90) -> Looks:
    """Looks at random times, some of them together, each with probabilities of its own."""
    rng = np.random.default_rng(seed)
    time = rng.integers(0, 60, n) * 1.5 + 1000.0
    return Looks.from_rows(
        rng.integers(0, n_features, n),
        time,
        rng.random(n) < 0.5,
        rng.uniform(0.05, 0.6, n),
        rng.uniform(0.05, 0.6, n),
        n_features=n_features + 1,  # the last one is never looked at
    )


def step_by_step(prior: LifetimePrior, looks: Looks, asked_s: Any) -> tuple[list[float], float]:
    """Beliefs of one feature at instants, and its evidence, look by look with the filter of one feature."""
    seen = np.flatnonzero(looks.detected == 1.0)
    if len(seen) == 0:
        return [np.nan] * len(asked_s), 0.0
    birth = looks.stamp_s[seen[0]]
    beliefs = []
    for instant in asked_s:
        filter_ = PersistenceFilter(prior)
        for k in range(seen[0] + 1, len(looks.stamp_s)):
            if looks.stamp_s[k] <= instant:
                args = (bool(looks.detected[k]), looks.p_miss[k], looks.p_false[k])
                filter_.update(looks.stamp_s[k] - birth, *args)
        beliefs.append(filter_.predict(instant - birth) if instant >= birth else np.nan)
    filter_ = PersistenceFilter(prior)
    for k in range(seen[0] + 1, len(looks.stamp_s)):
        filter_.update(looks.stamp_s[k] - birth, bool(looks.detected[k]), looks.p_miss[k], looks.p_false[k])
    return beliefs, filter_.log_evidence


@pytest.mark.parametrize("name", PRIORS)
def test_equals_the_filter_of_one_feature_at_looks_between_them_and_later(name: str) -> None:
    prior, looks = PRIORS[name], random_looks(3)
    rng = np.random.default_rng(4)
    asked_s = np.sort(np.concatenate([looks.stamp_s[:20], rng.uniform(990.0, 1200.0, 30)]))
    track = OneStay(prior).track(looks, Instants.same_for_all(looks.n_features, asked_s))
    for feature in range(looks.n_features):
        expected, evidence = step_by_step(prior, looks.of(feature), asked_s)
        found = track.p_present[feature * len(asked_s) : (feature + 1) * len(asked_s)]
        np.testing.assert_allclose(found, expected, rtol=1e-11)
        assert track.log_evidence[feature] == pytest.approx(evidence, rel=1e-11, abs=1e-12)
    np.testing.assert_array_equal(track.merged_mass, 0.0)


def test_without_instants_it_answers_at_the_looks() -> None:
    model, looks = OneStay(Exponential(0.02)), random_looks(5)
    at_looks = model.track(looks).p_present
    np.testing.assert_array_equal(at_looks, model.track(looks, Instants.of_looks(looks)).p_present)
    assert len(at_looks) == len(looks.stamp_s)


def test_a_feature_is_born_at_its_first_detection() -> None:
    looks = Looks.from_rows([0, 0, 0, 1], [5.0, 7.0, 7.0, 1.0], [0, 1, 0, 0], 0.1, 0.1)
    np.testing.assert_array_equal(births(looks), [7.0, np.nan])
    track = OneStay(Exponential(0.5)).track(looks, Instants.same_for_all(2, [6.9, 7.0]))
    # the miss at the very time of the birth comes after it and cannot unmake it
    np.testing.assert_array_equal(track.p_present, [np.nan, 1.0, np.nan, np.nan])


def test_a_blind_detector_proves_no_birth() -> None:
    looks = Looks.from_rows([0, 0], [1.0, 2.0], [1, 1], [1.0, 0.1], 0.1)
    np.testing.assert_array_equal(births(looks), [2.0])


def test_an_impossible_look_is_named() -> None:
    looks = Looks.from_rows([0, 1, 1], [0.0, 0.0, 50.0], [1, 1, 1], 0.1, 0.0)
    with pytest.raises(NumericalError, match=r"feature 1 at 50\.0 s: this observation is impossible"):
        OneStay(Uniform(10.0)).track(looks)


def test_the_median_of_what_remains() -> None:
    age = np.array([0.0, 10.0, 500.0])
    np.testing.assert_allclose(OneStay(Exponential(0.02)).median_remaining_s(age), np.log(2.0) / 0.02, rtol=1e-12)
    np.testing.assert_allclose(OneStay(Uniform(600.0)).median_remaining_s(age), (600.0 - age) / 2.0, rtol=1e-9)
    half_stay = Mixture.of([Exponential(0.1), never_leaves()], [0.6, 0.4])
    # of those still there at 500 s hardly any will ever leave
    found = OneStay(half_stay).median_remaining_s(np.array([0.0, 500.0]))
    assert found[0] == pytest.approx(-np.log((0.5 - 0.4) / 0.6) / 0.1, rel=1e-9)
    assert found[1] == np.inf


def test_it_is_stored_as_it_was_written() -> None:
    model = OneStay.of_text("exponential:half-life=2d")
    assert OneStay.from_dict(model.to_dict()) == model
    assert model.prior == Exponential.from_half_life(2 * 86400.0)
    with pytest.raises(ConfigError, match="cannot be written as text"):
        OneStay(CallableHazard(lambda t: t, 10.0)).to_dict()
