"""Kinds of measurements, a file each: what is in this package is read from tables and bags, and solved."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Mapping

from evermap.estimate.kind import Kind


@functools.cache
def find_kinds() -> Mapping[str, Kind]:
    """Return all kinds of measurements by their names."""
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    kinds = [importlib.import_module(f"{__name__}.{name}").KIND for name in names]
    return {kind.name: kind for kind in kinds}
