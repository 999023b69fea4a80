"""Parts that other packages bring: studies, methods and readers, found by their entry points."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from evermap.errors import MissingExtraError

HINT = "from a clone: pip install ./studies"


@cache
def found(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by their names, sorted; nothing is imported.

    Args:
        group: 'evermap.verbs', 'evermap.studies', 'evermap.methods' or 'evermap.readers'.
    """
    return {point.name: point for point in sorted(entry_points(group=group), key=lambda point: point.name)}


def load(group: str, name: str) -> Any:
    """Import what a package brings under a name.

    Raises:
        MissingExtraError: no installed package brings it.
    """
    points = found(group)
    if name not in points:
        raise MissingExtraError(f"'{name}' is part of the package evermap-studies, which is not installed", hint=HINT)
    return points[name].load()
