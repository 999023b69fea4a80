"""A map store in one SQLite file.

A rollback journal instead of a write-ahead log: between two commits there is one file, which can be copied and mailed.
`synchronous = EXTRA` has a commit return only after the map, the journal and the folder are on the disk.
"""

from __future__ import annotations

import os
import sqlite3
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

from sqlalchemy import Connection, Engine, NullPool, create_engine, event

from evermap.errors import InputError
from evermap.maps.store.content import DamagedError
from evermap.maps.store.salvage import survey
from evermap.maps.store.sql import SqlStore

_PATIENCE_S = 20.0
"""So long one waits for another process to finish its commit."""


def open_sqlite(path: Path, *, create: bool) -> SqlStore:
    """See `open_store`."""
    if path.is_dir():
        raise InputError("is a folder; a map is one file", path=path, hint=str(path / "map.evermap"))
    if not path.exists() and not create:
        raise InputError("no such map", path=path, hint=f"evermap slam INPUT --map {path} starts one")
    if not path.parent.is_dir():
        raise InputError(f"the folder {path.parent} does not exist", path=path, hint=f"mkdir -p {path.parent}")
    engine = _engine(path, writable=os.access(path if path.exists() else path.parent, os.W_OK))

    def explain(problem: str) -> InputError | None:
        found = survey(path)
        return None if found is None else found.error(path, problem)

    return SqlStore.opened(engine, str(path), create=create, tidy=lambda: _compact(engine), explain=explain)


def _compact(engine: Engine) -> None:
    """Give back the pages that a migration has left; without room to do that they stay."""
    connection = engine.raw_connection()
    with suppress(sqlite3.DatabaseError):
        connection.cursor().execute("VACUUM")
    connection.close()


def _engine(path: Path, *, writable: bool) -> Engine:
    mode = "rwc" if writable else "ro"
    address = f"file:{quote(str(path.absolute()))}?mode={mode}"

    def connect() -> sqlite3.Connection:
        # transactions are begun below and not by the driver, which begins none before it changes tables
        return sqlite3.connect(address, uri=True, timeout=_PATIENCE_S, isolation_level=None, check_same_thread=False)

    # a connection for each transaction: nothing is kept open that a fork or a thread could share
    engine = create_engine("sqlite://", creator=connect, poolclass=NullPool)

    @event.listens_for(engine, "connect")
    def _prepare(connection: sqlite3.Connection, _: object) -> None:
        connection.execute("PRAGMA synchronous = EXTRA")

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        # who is going to write locks at once, so that what was read at the beginning still holds at the end
        writes = connection.get_execution_options().get("writes", False)
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
        # pages that are listed as free are written to: if they are not free, older revisions would be overwritten
        if writes and connection.exec_driver_sql("PRAGMA freelist_count").scalar():
            found = connection.exec_driver_sql("PRAGMA integrity_check(1)").scalar()
            if found != "ok":
                raise DamagedError(f"SQLite: {' '.join(str(found).split())}")

    return engine
