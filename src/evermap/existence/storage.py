"""Models of presence in files: JSON with a schema version, written whole or not at all.

A file holds one model, or several by the name of a class or a feature (`NamedModels`). `lifetimes_of` is the way from
what a user writes on a command line, a prior or such a file, to the lifetimes that a map or a tracker takes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, cast

from evermap.errors import EvermapError, InputError
from evermap.existence.lifetimes import Lifetimes
from evermap.existence.protocol import PresenceModel
from evermap.io.atomic import write_atomic
from evermap.survival import never_leaves

SCHEMA_VERSION = 1
KINDS = {
    "phase-type": ("evermap.existence.phase_type", "PhaseType"),
    "run-length": ("evermap.existence.run_length", "RunLength"),
    "one-stay": ("evermap.existence.one_stay", "OneStay"),
}
"""Where the class of each kind of model is; it is imported when a file asks for it."""


SEVERAL = "several"


class NamedModels(NamedTuple):
    """Models of presence by name.

    Attributes:
        models: by the name of a class or a feature; '' is for everything without a name of its own.
        per: 'all', 'class' or 'feature': what the names are of.
    """

    models: Mapping[str, PresenceModel]
    per: str = "all"

    @property
    def lifetimes(self) -> dict[str, Lifetimes]:
        """Lifetimes of stays and absences by name."""
        return {name: model.lifetimes for name, model in self.models.items()}


def save_models(models: NamedModels, path: str | Path) -> Path:
    """Write models to a JSON file and return its path.

    Raises:
        ConfigError: a lifetime that cannot be written, as a hazard that is a function.
        InputError: the file cannot be written.
    """
    if models.per == "all":
        content: dict[str, Any] = models.models[""].to_dict()
    else:
        named = {name: model.to_dict() for name, model in models.models.items()}
        content = {"kind": SEVERAL, "per": models.per, "models": named}
    content = {"schema_version": SCHEMA_VERSION, **content}
    return write_atomic(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def load_models(path: str | Path) -> NamedModels:
    """Read what `save_models` wrote: the model under '', or one for every name.

    Raises:
        InputError: no such file, no JSON, another schema, an unknown kind, or numbers that cannot be.
    """
    data = read_model_file(path)
    try:
        if data.get("kind") != SEVERAL:
            return NamedModels({"": model_of(data)})
        if not isinstance(data["models"], dict):
            raise InputError("is not a table of models", field="models")
        return NamedModels({name: model_of(model) for name, model in data["models"].items()}, str(data.get("per")))
    except KeyError as error:
        raise InputError("is missing", path=path, field=str(error.args[0])) from error
    except EvermapError as error:
        raise InputError(error.problem, path=path, field=error.field, hint=error.hint) from error


def save_model(model: PresenceModel, path: str | Path) -> Path:
    """Write one model to a JSON file and return its path; errors as `save_models`."""
    return save_models(NamedModels({"": model}), path)


def load_model(path: str | Path) -> PresenceModel:
    """Read the one model of a file.

    Raises:
        InputError: as `load_models`, or a file of several models.
    """
    models = load_models(path).models
    if set(models) != {""}:
        raise InputError("holds several models, not one", path=path, hint="load_models(), which reads all")
    return models[""]


def lifetimes_of(source: str | Path) -> dict[str, Lifetimes]:
    """Return the lifetimes that a user means, by class; '' is for every other class.

    Args:
        source: the text of a prior as `weibull:scale=3d,shape=1.5` (absences then never end), or the path of a file of
            models, as `evermap survival learn` and `evermap survival fit` write them.

    Raises:
        ConfigError: neither an existing file nor the text of a prior.
        InputError: a file that cannot be read, or one of models by feature, which say nothing about classes.
    """
    if Path(source).suffix != ".json":
        from evermap.survival.text import parse_prior

        return {"": Lifetimes(parse_prior(str(source)), never_leaves())}
    models = load_models(source)
    if models.per == "feature":
        raise InputError("has models of features, not of classes", path=source, hint="learn with --per class or all")
    return models.lifetimes


def read_model_file(path: str | Path) -> dict[str, Any]:
    """The content of a model file of a version that we know.

    Raises:
        InputError: no such file, no JSON, or a newer schema.
    """
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", path=path) from error
    except UnicodeDecodeError as error:
        raise InputError("is no text", path=path) from error
    except json.JSONDecodeError as error:
        raise InputError(f"is no JSON: {error.msg}", path=path, line=error.lineno) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"is no JSON of a model: {error}", path=path) from error
    if not isinstance(data, dict):
        raise InputError("holds no model of presence", path=path)
    version = data.get("schema_version")
    if version != SCHEMA_VERSION:
        raise InputError(
            f"version {version!r}; this evermap reads version {SCHEMA_VERSION}",
            path=path,
            field="schema_version",
            hint="the evermap that wrote it",
        )
    return data


def model_of(data: Any) -> PresenceModel:
    """The model of which `to_dict` gave these plain numbers and words.

    Raises:
        InputError: an unknown kind, or a field that is missing or malformed.
        ConfigError: numbers that cannot be.
    """
    kind = data.get("kind") if isinstance(data, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise InputError(f"{kind!r} is no kind of model", field="kind", hint=", ".join(sorted(KINDS)))
    module, name = KINDS[kind]
    try:
        return cast("PresenceModel", getattr(import_module(module), name).from_dict(data))
    except KeyError as error:
        raise InputError("is missing", field=str(error.args[0])) from error
    except (TypeError, ValueError, AttributeError, IndexError, OverflowError, RecursionError) as error:
        raise InputError(f"is not what a {kind} model holds: {error}") from error
