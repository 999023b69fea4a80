"""The table of chunks in a database: stored bytes by name, each in a row of its own or in a pack of many."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import partial

from sqlalchemy import Connection, bindparam, delete, func, insert, select

from evermap.maps.store import schema
from evermap.maps.store.content import DamagedError
from evermap.maps.store.packs import MEMBER_BYTES, open_members, place_of

_AT_ONCE = 500
"""Names in one question to the database."""
LENGTH = func.length(schema.chunk.c.data)
"""Of the stored bytes, in SQL."""


def fetch_chunks(connection: Connection, names: Iterable[bytes], *, missing_ok: bool = False) -> dict[bytes, bytes]:
    """Return the stored bytes of chunks by name, `content.Fetch` of a database.

    Raises:
        DamagedError: one is missing, unless `missing_ok`, or is not made of bytes.
    """
    question = select(schema.chunk).where(schema.chunk.c.name.in_(bindparam("names", expanding=True)))
    found: dict[bytes, bytes] = {}
    wanted = set(names)
    for some in in_batches(wanted):
        for name, data in connection.execute(question, {"names": some}):
            if not isinstance(name, bytes) or not isinstance(data, bytes):
                raise DamagedError("a part of the map is not made of bytes")
            found[name] = data
    if not missing_ok and found.keys() != wanted:
        raise DamagedError("a part of the map is missing")
    return open_members(found, partial(_fetch_pack, connection), missing_ok=missing_ok)


def _fetch_pack(connection: Connection, name: bytes) -> bytes:
    found = connection.execute(select(schema.chunk.c.data).where(schema.chunk.c.name == name)).scalar()
    if not isinstance(found, bytes):
        raise DamagedError("a pack of the map is missing")
    return found


def list_packs(connection: Connection) -> dict[bytes, set[bytes]]:
    """Return names of the packs and of the members of each."""
    found: dict[bytes, set[bytes]] = {}
    for name, data in connection.execute(select(schema.chunk).where(LENGTH == MEMBER_BYTES)):
        place = place_of(data)
        if place is not None:
            found.setdefault(place.pack, set()).add(name)
    return found


def replace_chunks(connection: Connection, rows: Mapping[bytes, bytes]) -> None:
    """Store bytes of chunks and packs in the place of those that are there."""
    delete_chunks(connection, rows)
    if rows:
        connection.execute(insert(schema.chunk), [{"name": name, "data": data} for name, data in rows.items()])


def delete_chunks(connection: Connection, names: Iterable[bytes]) -> None:
    """Delete the rows of chunks and packs."""
    for some in in_batches(names):
        connection.execute(delete(schema.chunk).where(schema.chunk.c.name.in_(some)))


def in_batches(names: Iterable[bytes], size: int = _AT_ONCE) -> Iterator[list[bytes]]:
    """Yield names, as many at a time as one question to the database may have."""
    wanted = list(names)
    for at in range(0, len(wanted), size):
        yield wanted[at : at + size]
