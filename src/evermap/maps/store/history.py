"""Rows of the history: revisions and changes, and which revisions are in which."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from evermap.maps.store.content import DamagedError
from evermap.maps.store.protocol import Provenance, Revision, RevisionKind
from evermap.types import ChangeKind, MapChange


def lineage(origin: Mapping[int, int], number: int) -> tuple[int, ...]:
    """The revisions that one was made from, oldest first, itself included.

    Args:
        origin: the revision whose map each one started from: its parent, or what it restored.
        number: the one; 0 has none.
    """
    line = []
    while number > 0:
        line.append(number)
        earlier = origin.get(number, number)
        if earlier >= number:
            raise DamagedError(f"revision {number} comes from revision {earlier}")
        number = earlier
    return tuple(reversed(line))


@contextmanager
def _damage() -> Iterator[None]:
    """A row of words that nobody wrote."""
    try:
        yield
    except (ValueError, TypeError) as error:
        raise DamagedError(str(error)) from error


@_damage()
def revision_from_row(row: Mapping[str, Any], config: str, n_changes: Mapping[str, int]) -> Revision:
    """A row of the table `revision`, with its configuration and the number of its changes by kind."""
    return Revision(
        number=row["number"],
        parent=row["parent"],
        restores=row["restores"],
        created_at=row["created_at"],
        evermap_version=row["evermap_version"],
        provenance=Provenance(
            kind=RevisionKind(row["kind"]),
            recording=row["recording"],
            source=row["source"],
            command=row["command"],
            config=config,
            seed=row["seed"],
            stamp_from_s=_or_nan(row["stamp_from_s"]),
            stamp_to_s=_or_nan(row["stamp_to_s"]),
            wall_s=_or_nan(row["wall_s"]),
            note=row["note"],
        ),
        n_landmarks=row["n_landmarks"],
        n_existing=row["n_existing"],
        n_changes={ChangeKind(kind): count for kind, count in n_changes.items()},
    )


def change_to_row(revision: int, position: int, change: MapChange) -> dict[str, Any]:
    """A row of the table `change`; nan becomes nothing, about which databases agree."""
    numbers = {
        "stamp_from_s": change.stamp_from_s,
        "stamp_to_s": change.stamp_to_s,
        "dx_m": change.displacement_m[0],
        "dy_m": change.displacement_m[1],
        "rotation_rad": change.rotation_rad,
        "probability": change.probability,
    }
    return {
        "revision": revision,
        "position": position,
        "kind": change.kind.value,
        **{name: None if math.isnan(value) else float(value) for name, value in numbers.items()},
        "n_hits": int(change.n_hits),
        "n_misses": int(change.n_misses),
    }


@_damage()
def change_from_row(row: Mapping[str, Any], landmark_ids: Sequence[int]) -> MapChange:
    """What `change_to_row` was given, and the rows of `change_landmark`."""
    return MapChange(
        landmark_ids=tuple(landmark_ids),
        kind=ChangeKind(row["kind"]),
        stamp_from_s=_or_nan(row["stamp_from_s"]),
        stamp_to_s=_or_nan(row["stamp_to_s"]),
        displacement_m=(_or_nan(row["dx_m"]), _or_nan(row["dy_m"])),
        rotation_rad=_or_nan(row["rotation_rad"]),
        probability=_or_nan(row["probability"]),
        n_hits=row["n_hits"],
        n_misses=row["n_misses"],
    )


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
