"""The row of a store that names its newest revision and anchors all checksums; its version, and news of commits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Connection, func, inspect, select, update

from evermap import __version__
from evermap.errors import InputError
from evermap.maps.store import schema
from evermap.maps.store.content import DamagedError
from evermap.maps.store.history import pruned_to_text, read_pruned

CHANNEL = "evermap"
"""On which commits are announced."""
STORE_COLUMNS = ("schema_version", "created_at", "evermap_version", "head", "record")
"""Columns of the row of which the checksum is made."""


def is_anchor(values: Sequence[Any]) -> bool:
    """Return whether these are the values of the row of `store`, as it was written."""
    if len(values) not in (6, 7):  # six before schema 4
        return False
    version, created_at, writer, head, record, checksum, pruned = (*values, None)[:7]
    return (
        type(version) is int
        and type(head) is int
        and isinstance(created_at, str)
        and isinstance(writer, str)
        and (record is None or isinstance(record, bytes))
        and (pruned is None or isinstance(pruned, str))
        and checksum == schema.checksum(version, created_at, writer, head, record, pruned)
    )


def read_anchor(connection: Connection) -> tuple[int, bytes | None]:
    """Return the newest revision, and the name of its record: of these all others are checked.

    Raises:
        DamagedError: the row that names them is not as it was written.
    """
    listed = select(func.max(schema.revision.c.number)).scalar_subquery()
    rows = connection.execute(select(schema.store, listed)).all()
    if len(rows) != 1:
        raise DamagedError(f"{len(rows)} rows say which revision is the newest")
    *values, newest = rows[0]
    if not is_anchor(values):
        raise DamagedError("a checksum does not match: of the row that names the newest revision")
    if (newest or 0) != values[3]:
        raise DamagedError(f"the newest revision is {values[3]}, but the last one listed is {newest}")
    return values[3], values[4]


def list_pruned(connection: Connection) -> dict[int, str]:
    """Return revisions without content, and since when."""
    return read_pruned(connection.execute(select(schema.store.c.pruned)).scalar())


def move_anchor(
    connection: Connection,
    head: int,
    record: bytes | None,
    pruned: Mapping[int, str] | None = None,
    version: int | None = None,
) -> None:
    """Seal the row of `store` with other values; `pruned` and `version` are None to leave those as they are."""
    row = connection.execute(select(schema.store)).one()
    listed = row.pruned if pruned is None else pruned_to_text(pruned)
    version = row.schema_version if version is None else version
    sealed = schema.checksum(version, row.created_at, row.evermap_version, head, record, listed)
    values = {"schema_version": version, "head": head, "record": record, "pruned": listed, "checksum": sealed}
    connection.execute(update(schema.store).values(values))
    announce(connection, connection.get_execution_options().get("schema", ""))


def read_schema_version(connection: Connection, where: str) -> int:
    """Return the version of a store at a path or address, 0 where there are no tables at all.

    Raises:
        InputError: tables of something else, or of a newer evermap.
    """
    tables = inspect(connection).get_table_names()
    if not tables:
        return 0
    if "store" not in tables or "revision" not in tables:
        raise InputError("is a database, but not an evermap map", path=where, hint="another file")
    version = connection.execute(select(schema.store.c.schema_version)).scalar()
    if not isinstance(version, int) or version < 1:
        raise DamagedError(f"its schema version is {version!r}")
    if version > schema.PACKED_VERSION:
        problem = f"a map of schema version {version}; this evermap, {__version__}, knows up to {schema.PACKED_VERSION}"
        raise InputError(problem, path=where, hint="open it with a newer evermap")
    columns = {column["name"] for column in inspect(connection).get_columns("store")}
    today = set(tables) == schema.metadata.tables.keys() and columns == set(schema.store.columns.keys())
    if (version < schema.SCHEMA_VERSION) == today:
        raise DamagedError(f"its schema version is {version}, but its tables are of another")
    return version


def announce(connection: Connection, what: str) -> None:
    """Tell all who listen (`postgres.Announcements`) the schema of a site, '' for all, once the transaction is
    committed; nothing in SQLite.
    """
    if connection.dialect.name == "postgresql":
        connection.execute(select(func.pg_notify(CHANNEL, what)))


def now_utc() -> str:
    """Return ISO 8601, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")
