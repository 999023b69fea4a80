"""From one schema to the next. A store is brought up to date when it is opened, in one transaction."""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import Connection, update

from evermap.maps.store import schema

Migration = Callable[[Connection], None]

MIGRATIONS: tuple[Migration, ...] = ()
"""Number k leads from schema k + 1 to k + 2. Never changed once released: they speak SQL, not the tables of today."""


def migrate(connection: Connection, version: int) -> None:
    """Bring the tables from `version` to `SCHEMA_VERSION`."""
    for step in MIGRATIONS[version - 1 :]:
        step(connection)
    connection.execute(update(schema.store).values(schema_version=schema.SCHEMA_VERSION))
