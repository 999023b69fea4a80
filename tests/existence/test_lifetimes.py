"""Lifetimes of stays and absences, asked of any model of presence, of a text and of a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from evermap.errors import ConfigError, EvermapError, InputError
from evermap.existence.lifetimes import Lifetimes
from evermap.existence.models import NamedModels, lifetimes_of, load_models, save_models
from evermap.existence.one_stay import OneStay
from evermap.existence.phase_type import PhaseType
from evermap.existence.rhythm import BINS, Rhythm
from evermap.existence.run_length import RunLength
from evermap.survival import (
    Exponential,
    Gamma,
    LogNormal,
    Mixture,
    PiecewiseConstantHazard,
    Weibull,
    never_leaves,
)
from evermap_studies.rosen2016.callable_hazard import CallableHazard

AGES = np.array([0.0, 1.0, 30.0, 400.0, 5000.0])
MIXED = Mixture.of([Exponential(0.1), Exponential(1e-3)], [0.3, 0.7])


def test_one_stay_never_returns() -> None:
    found = OneStay(Weibull(60.0, 1.7)).lifetimes
    assert found.stay == Weibull(60.0, 1.7)
    np.testing.assert_array_equal(found.p_return(AGES, 1e9), 0.0)
    np.testing.assert_allclose(found.p_leave(50.0, 20.0), -np.expm1((50 / 60) ** 1.7 - (70 / 60) ** 1.7), rtol=1e-12)


def test_run_lengths_are_what_they_were_made_of() -> None:
    assert RunLength(LogNormal(4.0, 0.5), Gamma(2.0, 30.0), 1.0).lifetimes == (LogNormal(4.0, 0.5), Gamma(2.0, 30.0))


@pytest.mark.parametrize(
    "stay", [Exponential(0.01), PiecewiseConstantHazard((0.0, 10.0), (0.02, 0.005)), LogNormal(4.0, 0.7)]
)
def test_a_rhythm_counts_with_its_mean(stay) -> None:
    """Over many weeks the integral of a rhythm times a hazard is the mean of the rhythm times that of the hazard."""
    rhythm = Rhythm(np.sin(np.arange(BINS) / 50.0))
    found = RunLength(stay, Exponential(1.0), 1.0, rhythm).lifetimes
    mean = np.exp(np.sin(np.arange(BINS) / 50.0)).mean()
    # exact at the edges of the bins, powers of two among them
    age = 2.0 ** np.arange(0, 9)
    np.testing.assert_allclose(found.stay.log_survival(age), mean * stay.log_survival(age), rtol=1e-9)
    assert found.absence == Exponential(1.0)


def test_from_lifetimes_and_back() -> None:
    given = Lifetimes(Weibull(300.0, 2.0), never_leaves())
    model = RunLength.from_lifetimes(given)
    assert model.lifetimes == given
    assert model.step_s == pytest.approx(3.0 * np.log(2.0) ** 0.5)


def test_phases_made_of_mixtures_give_them_back() -> None:
    found = PhaseType.from_mixtures(MIXED, Exponential(0.02)).lifetimes
    np.testing.assert_allclose(found.stay.log_survival(AGES), MIXED.log_survival(AGES), rtol=1e-12)
    assert found.absence.mean() == pytest.approx(50.0, rel=1e-12)


def test_phases_in_a_row_are_a_sum_of_exponentials() -> None:
    """Stays of two phases passed one after another: an Erlang lifetime, at every edge of the table and between."""
    rates = np.array([[0.0, 0.05, 0.0], [0.0, 0.0, 0.01], [0.01, 0.0, 0.0]])
    found = PhaseType(np.array([False, True, True]), rates).lifetimes
    erlang = Gamma(100.0, 2.0)
    np.testing.assert_allclose(found.stay.log_survival(AGES), erlang.log_survival(AGES), rtol=2e-3, atol=2e-6)
    assert found.absence == Exponential(0.05)


def test_phases_are_entered_as_in_the_long_run() -> None:
    """Against the flow into the phases of presence after a long time, by matrix exponentials."""
    rng = np.random.default_rng(3)
    present = np.array([False, True, False, True, True])
    rates = rng.uniform(0.1, 1.0, (5, 5)) * (present[:, None] != present[None, :])
    long_run = expm((rates - np.diag(rates.sum(1))) * 1e3)[0]
    for inside, prior in zip((present, ~present), PhaseType(present, rates).lifetimes, strict=True):
        entered = (long_run * ~inside @ rates)[inside]
        generator = -np.diag(rates.sum(1)[inside])
        expected = [entered @ expm(generator * t) @ np.ones(inside.sum()) / entered.sum() for t in (0.3, 1.0, 4.0)]
        np.testing.assert_allclose(np.exp(prior.log_survival([0.3, 1.0, 4.0])), expected, rtol=1e-10)


def test_phases_that_never_return_and_those_that_nothing_leaves() -> None:
    once = PhaseType.two_state(0.01, 0.0, p_present=0.7).lifetimes
    assert once.stay == Exponential(0.01)
    assert once.absence.p_never_leaves == 1.0
    wall = PhaseType.two_state(0.0, 0.02, p_present=0.7).lifetimes
    assert (wall.stay.p_never_leaves, wall.absence) == (1.0, Exponential(0.02))


def test_with_a_rhythm_phases_have_their_mean_rates() -> None:
    rhythm = Rhythm(np.cos(np.arange(BINS) / 9.0))
    rates, which = np.array([[0.0, 1e-4], [2e-4, 0.0]]), np.array([[-1, 0], [-1, -1]])
    found = PhaseType(np.array([False, True]), rates, None, (rhythm,), which).lifetimes
    assert found.stay.mean() == pytest.approx(5e3, rel=1e-12)
    assert found.absence.mean() == pytest.approx(1e4 / rhythm.factor.mean(), rel=1e-12)


def test_lifetimes_of_a_text_and_of_files(tmp_path: Path) -> None:
    assert lifetimes_of("weibull:scale=60s,shape=1.7")[""].stay == Weibull(60.0, 1.7)
    models = {"cart": RunLength(MIXED, LogNormal(2.0, 0.3), 1.0), "": OneStay(Exponential(0.5))}
    path = save_models(NamedModels(models, "class"), tmp_path / "model.json")
    assert lifetimes_of(path) == {name: model.lifetimes for name, model in models.items()}
    assert load_models(path).per == "class"
    one = save_models(NamedModels({"": models["cart"]}), tmp_path / "one.json")
    assert lifetimes_of(str(one))[""].absence == LogNormal(2.0, 0.3)


def test_what_says_nothing_about_classes_is_refused(tmp_path: Path) -> None:
    path = save_models(NamedModels({"door 1": OneStay(Exponential(0.5))}, "feature"), tmp_path / "model.json")
    with pytest.raises(InputError, match="of features, not of classes"):
        lifetimes_of(path)
    with pytest.raises(InputError, match="cannot be read"):
        lifetimes_of(tmp_path / "none.json")
    with pytest.raises(EvermapError):
        lifetimes_of("webull:scale=60s")
    with pytest.raises(ConfigError, match="cannot be written"):
        save_models(NamedModels({"": OneStay(CallableHazard(lambda t: t, 10.0))}), tmp_path / "model.json")
