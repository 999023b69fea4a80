"""Models of presence in files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from evermap.errors import InputError
from evermap.existence.models import NamedModels, load_models, model_of, save_models
from evermap.existence.one_stay import OneStay
from evermap.existence.phase_type import PhaseType
from evermap.existence.protocol import Instants, Looks, PresenceModel
from evermap.existence.rhythm import BINS, Rhythm
from evermap.survival import Exponential, Mixture

RHYTHM = Rhythm(np.round(np.sin(np.arange(BINS) / 23.0), 5))
MODELS: dict[str, PresenceModel] = {
    "two states": PhaseType.two_state(0.01, 0.03),
    "with a start": PhaseType.two_state(0.01, 0.0, p_present=0.7),
    "three phases": PhaseType.from_mixtures(
        Exponential(0.01), Mixture.of([Exponential(0.1), Exponential(1e-4)], [1, 3])
    ),
    "rhythm": PhaseType(
        np.array([False, True]), np.array([[0.0, 1e-4], [2e-4, 0.0]]), None, (RHYTHM,), np.array([[-1, 0], [-1, -1]])
    ),
    "one stay": OneStay.of_text("exponential:half-life=1h"),
}


@pytest.mark.parametrize("name", MODELS)
def test_what_is_read_answers_as_what_was_written(name: str, tmp_path: Path) -> None:
    path = save_models(NamedModels({"": MODELS[name]}), tmp_path / "model.json")
    again = load_models(path).models[""]
    looks = Looks.from_rows([0, 0, 0], [0.0, 50.0, 9000.0], [1, 0, 1], 0.1, 0.2)
    asked = Instants.same_for_all(1, [0.0, 20.0, 9000.0, 1e6])
    np.testing.assert_array_equal(again.track(looks, asked).p_present, MODELS[name].track(looks, asked).p_present)
    assert again.to_dict() == MODELS[name].to_dict()
    assert json.loads(path.read_text())["schema_version"] == 1


def damaged(**fields: object) -> str:
    """A file of two states, some fields of it replaced."""
    return json.dumps({"schema_version": 1, **MODELS["two states"].to_dict(), **fields})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("no json", "is not JSON"),
        ("[1]", "contains no model"),
        ('{"schema_version": 99}', "version 99"),
        ('{"schema_version": 1, "kind": "crystal ball"}', "unknown kind of model 'crystal ball'"),
        ('{"schema_version": 1, "kind": "phase-type", "present": [true, false]}', "'rates_hz': is missing"),
        (damaged(rates_hz=[[0, -1], [1, 0]]), "rates are finite, not negative"),
        (damaged(present=3), "not what a phase-type model holds"),
    ],
)
def test_a_damaged_file_is_one_line(content: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        load_models(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_models(tmp_path / "none.json")


def test_plain_numbers_are_enough() -> None:
    model = model_of(MODELS["two states"].to_dict())
    assert isinstance(model, PhaseType)
    np.testing.assert_array_equal(model.rates_hz, [[0.0, 0.03], [0.01, 0.0]])
