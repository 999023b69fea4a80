"""Kinds of measurements, a file each: what is in this package is read from tables and bags, and solved.

Other packages bring theirs by an entry point of the group `evermap.measurements`, scripts by `add_kind`.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Mapping
from importlib.metadata import entry_points

from evermap.errors import InputError
from evermap.estimate.kind import MeasurementKind

_ADDED: dict[str, MeasurementKind] = {}
"""Kinds of this process, by `add_kind`."""


def find_kinds() -> Mapping[str, MeasurementKind]:
    """Return all kinds of measurements by their names."""
    return {**_list_installed_kinds(), **_ADDED}


def add_kind(kind: MeasurementKind) -> None:
    """Make a kind known to this process, by its name: that of its table.

    Raises:
        InputError: there is another of this name.
    """
    if kind.name in find_kinds():
        raise InputError(f"there are measurements called {kind.name!r} already", hint="give it another name")
    _ADDED[kind.name] = kind


@functools.cache
def _list_installed_kinds() -> Mapping[str, MeasurementKind]:
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    kinds = [importlib.import_module(f"{__name__}.{name}").KIND for name in names]
    kinds += [point.load() for point in entry_points(group="evermap.measurements")]
    return {kind.name: kind for kind in kinds}
