"""Learned models in a file: one for all features, or several by the name of a class or a feature."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import EvermapError, InputError
from evermap.existence.storage import SCHEMA_VERSION, model_of, read_model_file
from evermap.io.atomic import write_atomic
from evermap.io.text import quote
from evermap.runs.persist.models import ModelOfEach
from evermap.runs.persist.table import LookTable
from evermap.types import UNKNOWN, IntArray

SEVERAL = "several"


def save_models(models: ModelOfEach, per: str, path: str | Path) -> Path:
    """Write models to a JSON file and return its path.

    Args:
        models: the models and their names.
        per: 'all', 'class' or 'feature': what the names are of.
        path: the file.
    """
    if per == "all":
        content: dict[str, Any] = models.models[0].to_dict()
    else:
        named = {name: model.to_dict() for name, model in zip(models.names, models.models, strict=True)}
        content = {"kind": SEVERAL, "per": per, "models": named}
    return write_atomic(
        path, json.dumps({"schema_version": SCHEMA_VERSION, **content}, indent=1, allow_nan=False) + "\n"
    )


def load_models(path: str | Path, table: LookTable) -> ModelOfEach:
    """Read what `save_models` wrote, for the features of a table.

    Raises:
        InputError: a file that cannot be read, or that has no model for a feature of the table.
    """
    data = read_model_file(path)
    try:
        if data.get("kind") != SEVERAL:
            return ModelOfEach((model_of(data),), ("",), np.zeros(table.n_features, dtype=np.int64))
        if not isinstance(data["models"], dict):
            raise InputError("is no table of models", field="models")
        names = tuple(data["models"])
        models = tuple(model_of(model) for model in data["models"].values())
    except KeyError as error:
        raise InputError("is missing", path=path, field=str(error.args[0])) from error
    except EvermapError as error:
        raise InputError(error.problem, path=path, field=error.field, hint=error.hint) from error
    return ModelOfEach(models, names, _of_feature(path, names, str(data.get("per")), table))


def _of_feature(path: str | Path, names: tuple[str, ...], per: str, table: LookTable) -> IntArray:
    """Which model each feature of the table has."""
    index = {name: number for number, name in enumerate(names)}
    if per == "feature":
        wanted = list(table.names)
    else:
        classes = (*table.class_names, "")
        wanted = [classes[number] if number != UNKNOWN else "" for number in table.class_of_feature]
    for feature, name in zip(table.names, wanted, strict=True):
        if name not in index:
            whose = f"feature {quote(feature)}" + (f" of class {quote(name)}" if per == "class" and name else "")
            raise InputError(f"has no model for {whose}", path=path, hint="learn one for all: --per all")
    return np.array([index[name] for name in wanted], dtype=np.int64)
