"""A tracker's state as a file: arrays by part and name, in NumPy's .npz, and the choices of the tracker as JSON."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from evermap.errors import InputError
from evermap.io.files import write_atomic

VERSION = 1
"""Of the format; a file of another is refused."""
ABOUT = "about"

Parts = Mapping[str, Mapping[str, NDArray[Any]]]


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """What a tracker knew.

    Attributes:
        about: its choices, as values of JSON.
        parts: arrays, by part and name.
    """

    about: Mapping[str, Any]
    parts: Parts

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes, in the order of their numbers."""
        return tuple(self.about["class_names"])

    @property
    def kind(self) -> tuple[int, bool, bool]:
        """Length of appearances, whether detections are boxes, and whether they have scores."""
        return self.about["n_appearance"], self.about["boxes"], self.about["scored"]

    @property
    def stamp_s(self) -> float:
        """Stamp of the last frame, -inf before the first."""
        return -np.inf if self.about["stamp_s"] is None else float(self.about["stamp_s"])


def write_state(path: str | Path, about: Mapping[str, Any], parts: Parts) -> Path:
    """Write choices (values of JSON) and arrays by part and name. Returns the path.

    Raises:
        InputError: the file cannot be written; an older one is untouched.
    """
    arrays: dict[str, Any] = {f"{part}.{name}": a for part, columns in parts.items() for name, a in columns.items()}
    arrays[ABOUT] = np.frombuffer(json.dumps({"version": VERSION, **about}).encode(), dtype=np.uint8)
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return write_atomic(path, stream.getvalue())


def read_state(path: str | Path) -> State:
    """Return what `write_state` wrote.

    Raises:
        InputError: no such file, another kind of file, or one of a newer version.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            about = json.loads(bytes(file[ABOUT]))
            parts: dict[str, dict[str, NDArray[Any]]] = {}
            for key in file.files:
                part, _, name = key.partition(".")
                if name:
                    parts.setdefault(part, {})[name] = file[key]
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", path=Path(path)) from error
    except (BadZipFile, KeyError, ValueError, EOFError, TypeError, AttributeError) as error:
        raise InputError(
            "is not a tracker's state", path=Path(path), hint="a file that `evermap track --state` wrote"
        ) from error
    if about.get("version") != VERSION:
        problem = f"is of version {about.get('version')}, and this evermap reads version {VERSION}"
        raise InputError(problem, path=Path(path), hint="a newer evermap")
    return State(about, parts)
