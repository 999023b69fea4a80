"""Map stores in a PostgreSQL database: one database schema per site, with the tables of any other store.

An address names the database and the site, `postgresql://user@host:5432/fleet/ward-3`; all else, passwords and TLS
too, is as libpq reads it (`PGPASSWORD`, `~/.pgpass`, `?sslmode=verify-full`). Readers see one snapshot of the database;
writers of one site wait for one another. Tables are brought up to date by `schema.migrate`, as those of a file: the
version and its checksum are in each site's own row, which alembic's one table for a whole database is not made for.
"""

from __future__ import annotations

import functools
import math
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from sqlalchemy import Connection, Engine, create_engine, event, inspect
from sqlalchemy.engine import URL, make_url
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.exc import ArgumentError, DisconnectionError, NoSuchModuleError
from sqlalchemy.pool import ConnectionPoolEntry

from evermap.errors import ConfigError, InputError, MissingExtraError
from evermap.maps.store.anchor import CHANNEL
from evermap.maps.store.protocol import DamagedMapError
from evermap.maps.store.sql import SqlStore

SITE = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,47}")
"""Names of sites, which are parts of the names of database schemas (63 bytes) and files."""
PREFIX = "map_"
"""Of the schemas of sites."""


def open_postgres(address: str, *, create: bool) -> SqlStore:
    """Return the store of a site, see `open_store`.

    Raises:
        ConfigError: the address names no site.
        InputError: there is no such map, or the database cannot be used.
        MissingExtraError: the driver is not installed.
    """
    url, site = split_address(address)
    where = url.set(database=f"{url.database}/{site}").render_as_string(hide_password=True)
    engine = engine_of(url.render_as_string(hide_password=False), PREFIX + site)

    def explain(problem: str) -> InputError:
        return DamagedMapError(f"damaged: {problem}", path=where, hint="restore a backup")

    return SqlStore(engine, where, create=create, explain=explain)


def split_address(address: str) -> tuple[URL, str]:
    """Return the address of the database, and the name of the site.

    Raises:
        ConfigError: either is missing or not valid.
    """
    try:
        url = make_url(address)
    except ArgumentError:
        raise ConfigError("is not the address of a database", field="map", hint=_FORM) from None
    database, _, site = (url.database or "").rpartition("/")
    if not database or "/" in database or not SITE.fullmatch(site):
        problem = f"'{url.render_as_string(hide_password=True)}' names no site"
        raise ConfigError(problem, field="map", hint=f"{_FORM}; a site has letters, digits, - and _, at most 48")
    return url.set(database=database), site


def address_of(database: str, site: str) -> str:
    """Return the address of a site from that of its database."""
    url = make_url(database)
    return url.set(database=f"{url.database}/{site}").render_as_string(hide_password=False)


def sites_in(database: str) -> list[str]:
    """Return the names of all sites in a database."""
    with engine_of(database, "public").connect() as connection:
        schemas = inspect(connection).get_schema_names()
    return sorted(name.removeprefix(PREFIX) for name in schemas if name.startswith(PREFIX))


def has_site(database: str, site: str) -> bool:
    """Return whether a site is in a database, without a look at the others."""
    with engine_of(database, "public").connect() as connection:
        return inspect(connection).has_schema(PREFIX + site)


def engine_of(database: str, schema: str) -> Engine:
    """Return an engine whose transactions see one schema of a database; all share the connections of this process.

    Transactions of `execution_options(writes=True)` exclude one another within the schema; others only read, and see
    one snapshot, unless they have `shared=True`.
    """
    return _engine(database).execution_options(schema=schema)


@functools.lru_cache(maxsize=8)
def _engine(database: str) -> Engine:
    url = make_url(database)
    try:
        # the driver begins nothing by itself: a transaction begins below, with all that belongs to it, in one message
        engine = create_engine(url.set(drivername="postgresql+psycopg"), isolation_level="AUTOCOMMIT")
    except (ImportError, NoSuchModuleError):
        problem = "PostgreSQL needs the package psycopg, which is not installed"
        raise MissingExtraError(problem, hint="pip install 'evermap[server]'") from None

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        options = connection.get_execution_options()
        name, writes, shared = options["schema"], options.get("writes", False), options.get("shared", False)
        how = "" if writes or shared else " ISOLATION LEVEL REPEATABLE READ READ ONLY"
        # for this transaction only, so that a pool of connections in front of the database may share them
        quoted = engine.dialect.identifier_preparer.quote_identifier(name)
        connection.exec_driver_sql(f"BEGIN{how}; SET LOCAL search_path TO {quoted}")
        if writes:
            connection.exec_driver_sql("SELECT pg_advisory_xact_lock(hashtextextended(%s, 0))", (name,))

    @event.listens_for(engine, "checkin")
    def _rests(_: object, record: ConnectionPoolEntry) -> None:
        record.info["since_s"] = time.monotonic()

    @event.listens_for(engine, "checkout")
    def _wakes(raw: DBAPIConnection, record: ConnectionPoolEntry, _: object) -> None:
        """One that has rested for a while may be broken: then the pool takes another."""
        if time.monotonic() - record.info.get("since_s", math.inf) > _FRESH_S:
            try:
                engine.dialect.do_ping(raw)
            except engine.dialect.loaded_dbapi.Error:
                raise DisconnectionError from None

    return engine


class Announcements:
    """What commits to a database announce, heard by one thread for all who follow as long as there are any.

    A pool of connections in front of the database may keep announcements from arriving; so the thread announces itself
    first, and `arrive` tells whether it has heard that. All are told of that, too, as something may have come before.

    Args:
        database: its address; None where nothing is announced.
    """

    def __init__(self, database: str | None) -> None:
        self._database = database
        self._told: list[Callable[[str], None]] = []
        self._lock = threading.Lock()
        self._thread = 0
        self.arrive = False

    @contextmanager
    def followed(self, tell: Callable[[str], None]) -> Iterator[None]:
        """Tell what is announced, by the schema of a site or '' for all, as long as the block runs."""
        with self._lock:
            self._told.append(tell)
            if len(self._told) == 1 and self._database is not None:
                threading.Thread(target=self._listen, args=(self._database,), daemon=True).start()
        try:
            yield
        finally:
            with self._lock:
                self._told.remove(tell)

    def _listen(self, database: str) -> None:
        import psycopg

        myself = threading.get_ident()
        with self._lock:
            self._thread = myself
        while self._goes_on(myself):
            try:
                with psycopg.connect(database, autocommit=True) as connection:
                    connection.execute(f"LISTEN {CHANNEL}; NOTIFY {CHANNEL}".encode())
                    while self._goes_on(myself):
                        for heard in connection.notifies(timeout=_FRESH_S, stop_after=1):
                            self.arrive = True
                            for tell in list(self._told):
                                tell(heard.payload)
            except psycopg.Error:  # it may be back later
                self.arrive = False
                time.sleep(_FRESH_S)

    def _goes_on(self, thread: int) -> bool:
        """Whether anybody follows, and no later thread listens."""
        with self._lock:
            if self._told and self._thread == thread:
                return True
            self.arrive = self.arrive and self._thread != thread
            return False


_FRESH_S = 1.0
"""A connection that was used so recently is taken to be whole."""
_FORM = "postgresql://user@host:5432/database/SITE"
