"""Models of presence in files: JSON with a schema version, written whole or not at all."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from evermap.errors import EvermapError, InputError
from evermap.existence.protocol import PresenceModel
from evermap.io.atomic import write_atomic

SCHEMA_VERSION = 1
KINDS = {
    "phase-type": ("evermap.existence.phase_type", "PhaseType"),
    "run-length": ("evermap.existence.run_length", "RunLength"),
    "one-stay": ("evermap.existence.one_stay", "OneStay"),
}
"""Where the class of each kind of model is; it is imported when a file asks for it."""


def save_model(model: PresenceModel, path: str | Path) -> Path:
    """Write a model to a JSON file and return its path.

    Raises:
        InputError: the file cannot be written.
    """
    content = {"schema_version": SCHEMA_VERSION, **model.to_dict()}
    return write_atomic(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def load_model(path: str | Path) -> PresenceModel:
    """Read what `save_model` wrote.

    Raises:
        InputError: no such file, no JSON, a newer schema, an unknown kind, or numbers that cannot be.
    """
    data = read_model_file(path)
    try:
        return model_of(data)
    except EvermapError as error:
        raise InputError(error.problem, path=path, field=error.field, hint=error.hint) from error


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
