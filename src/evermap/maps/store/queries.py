"""Questions to the database behind a map store, each in an open transaction."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from sqlalchemy import ColumnElement, Connection, and_, bindparam, func, select

from evermap.maps.store import content, schema
from evermap.maps.store.content import DamagedError
from evermap.maps.store.history import change_from_row
from evermap.types import MapChange

_AT_ONCE = 500
"""Names in one question to the database."""


def head(connection: Connection) -> int:
    """The newest revision, 0 if there is none."""
    return int(connection.execute(select(func.coalesce(func.max(schema.revision.c.number), 0))).scalar_one())


def content_of(connection: Connection, number: int) -> bytes:
    """Name of the map of a revision."""
    wanted = select(schema.revision.c.content).where(schema.revision.c.number == number)
    return _bytes(connection.execute(wanted).scalar())


def fetched(connection: Connection, names: Iterable[bytes]) -> Mapping[bytes, bytes]:
    """`content.Fetch` from the database."""
    wanted = list(names)
    question = select(schema.chunk).where(schema.chunk.c.name.in_(bindparam("names", expanding=True)))
    found: dict[bytes, bytes] = {}
    for at in range(0, len(wanted), _AT_ONCE):
        rows = connection.execute(question, {"names": wanted[at : at + _AT_ONCE]})
        found.update((_bytes(name), _bytes(data)) for name, data in rows)
    if found.keys() != set(wanted):
        raise DamagedError("a part of the map is missing")
    return found


def present(connection: Connection, names: Iterable[bytes]) -> set[bytes]:
    """Those that are in the store already."""
    wanted = list(names)
    question = select(schema.chunk.c.name).where(schema.chunk.c.name.in_(bindparam("names", expanding=True)))
    found: set[bytes] = set()
    for at in range(0, len(wanted), _AT_ONCE):
        found |= {_bytes(row[0]) for row in connection.execute(question, {"names": wanted[at : at + _AT_ONCE]})}
    return found


def cliques_of(connection: Connection, landmark_id: int, numbers: Iterable[int]) -> dict[int, int]:
    """The clique that a landmark belonged to, by revision."""
    cliques: dict[int, int] = {}
    for number in numbers:
        columns = content.unpack_columns(
            content_of(connection, number),
            ("members.landmark_id", "members.clique_id"),
            lambda names: fetched(connection, names),
        )
        row = np.flatnonzero(columns["members.landmark_id"] == landmark_id)
        if len(row):
            cliques[number] = int(columns["members.clique_id"][row[0]])
    return cliques


def changes_where(connection: Connection, wanted: ColumnElement[bool]) -> list[tuple[int, MapChange]]:
    """Changes that meet a condition on `schema.change`, each with its revision, in order."""
    change, named = schema.change, schema.change_landmark
    same = and_(named.c.revision == change.c.revision, named.c.position == change.c.position)
    groups: dict[tuple[int, int], list[int]] = {}
    listed = select(named).join(change, same).where(wanted).order_by(named.c.revision, named.c.position, named.c.rank)
    for row in connection.execute(listed):
        groups.setdefault((row.revision, row.position), []).append(row.landmark_id)
    rows = connection.execute(select(change).where(wanted).order_by(change.c.revision, change.c.position)).mappings()
    return [
        (row["revision"], change_from_row(dict(row), groups.get((row["revision"], row["position"]), [])))
        for row in rows
    ]


def _bytes(value: Any) -> bytes:
    """Of a column of bytes, in which a damaged file may have anything."""
    if not isinstance(value, bytes | memoryview):
        raise DamagedError("a part of the map is missing")
    return bytes(value)
