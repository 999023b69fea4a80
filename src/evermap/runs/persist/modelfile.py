"""Learned models in a file: one for all features, or several by the name of a class or a feature."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evermap.errors import InputError
from evermap.existence import models as storage
from evermap.io.text import quote
from evermap.runs.persist.models import ModelOfEach
from evermap.runs.persist.table import LookTable
from evermap.types import UNKNOWN, IntArray


def save_models(models: ModelOfEach, per: str, path: str | Path) -> Path:
    """Write models to a JSON file and return its path.

    Args:
        models: the models and their names.
        per: 'all', 'class' or 'feature': what the names are of.
        path: the file.
    """
    named = dict(zip(models.names, models.models, strict=True)) if per != "all" else {"": models.models[0]}
    return storage.save_models(storage.NamedModels(named, per), path)


def load_models(path: str | Path, table: LookTable) -> ModelOfEach:
    """Read what `save_models` wrote, for the features of a table.

    Raises:
        InputError: a file that cannot be read, or that has no model for a feature of the table.
    """
    models, per = storage.load_models(path)
    names = tuple(models)
    if per == "all":
        return ModelOfEach(tuple(models.values()), names, np.zeros(table.n_features, dtype=np.int64))
    return ModelOfEach(tuple(models.values()), names, _of_feature(path, names, per, table))


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
