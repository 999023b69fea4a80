"""Stores of living maps: every session is a revision, none is ever overwritten.

`open_store` is all that callers need; what it gives answers `MapStore`. The database library is loaded by it, not by
importing this package.
"""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from evermap.errors import ConfigError
from evermap.maps.store.protocol import (
    Attachment,
    DamagedMapError,
    MapStore,
    Provenance,
    PrunedRevisionError,
    Pruning,
    Revision,
    RevisionKind,
    StaleRevisionError,
    StoreUnavailableError,
)

if TYPE_CHECKING:
    from evermap.maps.store.sql import SqlStore
    from evermap.maps.store.sqlite import Verification

__all__ = [
    "Attachment",
    "DamagedMapError",
    "MapStore",
    "Provenance",
    "PrunedRevisionError",
    "Pruning",
    "Revision",
    "RevisionKind",
    "StaleRevisionError",
    "StoreUnavailableError",
    "is_address",
    "open_store",
    "revert_store",
    "verify_store",
]


def open_store(where: str | Path, *, create: bool = False) -> MapStore:
    """Return the store at a path, or at an address: `sqlite:///maps/ward.evermap`, or with `evermap[server]`
    `postgresql://user@host/fleet/ward-3`, which is the site ward-3 in the database fleet.

    A store of an older schema is brought up to date. A file that may not be written to can still be read.

    Args:
        where: a file, or an address with the name of a database in front.
        create: make a store without revisions where there is none.

    Raises:
        ConfigError: no store is made for such an address.
        InputError: there is none, it is no map, damaged, or of a newer evermap; a database cannot be used.
        MissingExtraError: the driver of the database is not installed.
    """
    return _open(where, create=create)


def is_address(where: str | Path) -> bool:
    """Return whether a map is in a server's database, and not in a file."""
    return str(where).startswith("postgresql:")


def _open(where: str | Path, *, create: bool) -> SqlStore:
    if is_address(where):
        from evermap.maps.store.postgres import open_postgres

        return open_postgres(str(where), create=create)
    from evermap.maps.store.sqlite import open_sqlite

    return open_sqlite(_path(where), create=create)


def verify_store(where: str | Path) -> Verification:
    """Check every revision of a map, and its file.

    Raises:
        ConfigError, InputError: as `open_store`, but not for damage: that is what the answer tells.
    """
    from evermap.maps.store.sqlite import verify, verify_rows

    if is_address(where):
        with _open(where, create=False) as store:
            return verify_rows(store)
    path = _path(where)
    with suppress(DamagedMapError):
        open_store(where).close()  # is a map, of this schema
    return verify(path)


def revert_store(where: str | Path, revision: int, provenance: Provenance | None = None) -> tuple[int, Path | None]:
    """Go back to an older revision, whether or not the file is damaged.

    A damaged file is replaced by one with all that is intact, and kept beside it; a database is not.

    Returns:
        The number of the new revision; where the damaged file is now, None if it was sound.

    Raises:
        DamagedMapError: the revision itself is damaged.
        ConfigError, InputError: as `open_store` and `MapStore.revert`.
    """
    from evermap.maps.store.sqlite import rescue

    if is_address(where) or verify_store(where).sound:
        with open_store(where) as store:
            return store.revert(revision, provenance), None
    return rescue(_path(where), revision, provenance)


def _path(where: str | Path) -> Path:
    """The file of a path or an address.

    Raises:
        ConfigError: no store is made for such an address.
    """
    address = re.fullmatch(r"([a-z][a-z0-9+.-]+)://(.*)", str(where), flags=re.DOTALL)
    if address is not None and address[1] != "sqlite":
        raise ConfigError(f"no map store for '{address[1]}'", field="map", hint="the path of a file, or postgresql://")
    return Path(where if address is None else address[2].removeprefix("/"))
