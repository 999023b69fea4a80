"""Where living maps are kept: every session is a revision, none is ever overwritten.

`open_store` is all that callers need; what it gives answers `MapStore`. The database library is loaded by it, not by
importing this package.
"""

from __future__ import annotations

import re
from pathlib import Path

from evermap.errors import ConfigError
from evermap.maps.store.protocol import MapStore, Provenance, Revision, RevisionKind, StaleRevisionError

__all__ = ["MapStore", "Provenance", "Revision", "RevisionKind", "StaleRevisionError", "open_store"]


def open_store(where: str | Path, *, create: bool = False) -> MapStore:
    """The store at a path, or at an address such as `sqlite:///maps/ward.evermap`.

    A store of an older schema is brought up to date. A file that may not be written to can still be read.

    Args:
        where: a file, or an address with the name of a database in front.
        create: make a store without revisions where there is none.

    Raises:
        ConfigError: no store is made for such an address.
        InputError: there is none, it is no map, damaged, or of a newer evermap.
    """
    address = re.fullmatch(r"([a-z][a-z0-9+.-]+)://(.*)", str(where), flags=re.DOTALL)
    if address is not None and address[1] != "sqlite":
        raise ConfigError(f"no map store for '{address[1]}'", field="map", hint="the path of a file")
    from evermap.maps.store.sqlite import open_sqlite

    return open_sqlite(Path(where if address is None else address[2].removeprefix("/")), create=create)
