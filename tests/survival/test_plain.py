"""Priors as plain values: JSON and back gives the same prior; what cannot be is refused."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from evermap.errors import ConfigError
from evermap.survival import (
    LifetimePrior,
    Mixture,
    ScaledHazard,
    StepLifetime,
    Uniform,
    Weibull,
    never_leaves,
    parse_prior,
)
from evermap.survival.text import CLASSES, FORMS, prior_from_dict, prior_to_dict
from evermap_studies.rosen2016.callable_hazard import CallableHazard

PRIORS: list[LifetimePrior] = [
    *(parse_prior(form.example) for form in FORMS.values()),
    ScaledHazard(Weibull(300.0, 0.7), (0.0, 30.0), (0.5, 3.0)),
    parse_prior("0.3*weibull:scale=0.1s,shape=1e-3+0.7*never-leaves"),
    Mixture((Mixture((Uniform(1 / 3), Uniform(0.1)), (0.5, 0.5)), never_leaves()), (1 / 3, 2 / 3)),
    StepLifetime((0.0, 2.0, 5.0), (1.0, 2.0, math.inf), (0.25, 0.25, 0.5)),
]


@pytest.mark.parametrize("prior", PRIORS, ids=str)
def test_json_and_back_is_the_same_prior(prior: LifetimePrior) -> None:
    assert prior_from_dict(json.loads(json.dumps(prior_to_dict(prior), allow_nan=False))) == prior


def test_every_kind_that_is_made_of_numbers_was_tried() -> None:
    assert {type(prior).__name__ for prior in PRIORS} == set(CLASSES)


def test_a_function_cannot_be_written_down() -> None:
    with pytest.raises(ConfigError, match="CallableHazard cannot be written down"):
        prior_to_dict(Mixture((CallableHazard(lambda t: 1.0 + 0.0 * t, 1.0), never_leaves()), (0.5, 0.5)))


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ({}, "unknown lifetime None"),
        ({"lifetime": "Weibul"}, "unknown lifetime 'Weibul'"),
        ({"lifetime": "Uniform"}, "'limit_s': is missing"),
        ({"lifetime": "Uniform", "limit_s": 3.0, "x": 1}, "'x': unknown field of Uniform"),
        ({"lifetime": "Uniform", "limit_s": -3.0}, "limit_s"),
        ({"lifetime": "Uniform", "limit_s": "three"}, "not what is expected"),
        ({"lifetime": "Uniform", "limit_s": [3.0]}, "not what is expected"),
        ({"lifetime": "Mixture", "components": [{"lifetime": "Uniform"}], "weights": [1.0]}, "limit_s"),
    ],
)
def test_what_cannot_be_is_refused(content: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        prior_from_dict(content)
