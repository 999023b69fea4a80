"""How long objects of each class rest: from texts, and from files of models."""

from __future__ import annotations

from pathlib import Path

import pytest

from evermap.config import TrackConfig
from evermap.errors import ConfigError, InputError
from evermap.existence.models import NamedModels, save_models
from evermap.existence.one_stay import OneStay
from evermap.survival import Exponential, GeneralPurpose
from evermap.survival.text import parse_prior
from evermap.tracking.run import _priors
from evermap.types import DEFAULT_PRIOR

NAMES = ("cart", "pallet")
CART, PALLET = parse_prior("weibull:scale=1h,shape=1.5"), Exponential(1e-4)


def file_of(path: Path, **models: OneStay) -> str:
    return str(save_models(NamedModels(models, "class"), path))


def test_texts_are_for_all_or_for_one_class() -> None:
    assert _priors(TrackConfig(), NAMES) == (parse_prior(DEFAULT_PRIOR),) * 2
    config = TrackConfig(prior="exponential:mean=10000s", class_priors={"cart": "weibull:scale=1h,shape=1.5"})
    assert _priors(config, NAMES) == (CART, PALLET)


def test_a_file_names_its_classes(tmp_path: Path) -> None:
    both = file_of(tmp_path / "both.json", cart=OneStay(CART), pallet=OneStay(PALLET))
    assert _priors(TrackConfig(prior=both), NAMES) == (CART, PALLET)
    one = file_of(tmp_path / "one.json", cart=OneStay(CART))
    found = _priors(TrackConfig(prior=one), NAMES)
    assert found[0] == CART
    assert isinstance(found[1], GeneralPurpose)
    assert _priors(TrackConfig(prior=one, class_priors={"pallet": both}), NAMES) == (CART, PALLET)


def test_a_file_of_one_model_is_for_every_class(tmp_path: Path) -> None:
    path = save_models(NamedModels({"": OneStay(CART)}), tmp_path / "model.json")
    assert _priors(TrackConfig(prior=str(path)), NAMES) == (CART, CART)
    assert _priors(TrackConfig(class_priors={"cart": str(path)}), NAMES)[0] == CART


def test_what_cannot_be_is_said(tmp_path: Path) -> None:
    one = file_of(tmp_path / "one.json", cart=OneStay(CART))
    with pytest.raises(InputError, match="has no lifetime of class 'pallet'"):
        _priors(TrackConfig(class_priors={"pallet": one}), NAMES)
    with pytest.raises(ConfigError, match="no detection is of class 'door'"):
        _priors(TrackConfig(class_priors={"door": one}), NAMES)
    with pytest.raises(InputError, match="cannot be read"):
        _priors(TrackConfig(prior=str(tmp_path / "none.json")), NAMES)
    with pytest.raises(ConfigError, match="prior"):
        _priors(TrackConfig(prior="nonsense"), NAMES)
