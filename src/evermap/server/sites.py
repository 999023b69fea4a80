"""The maps behind a server, by the names of their sites."""

from __future__ import annotations

import hashlib
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from evermap.errors import ConfigError, InputError
from evermap.maps.living import LivingMap
from evermap.maps.store import is_address, open_store
from evermap.maps.store.postgres import SITE, address_of, sites_in
from evermap.maps.store.sql import SqlStore
from evermap.maps.store.sqlite import snapshot

_Kept = TypeVar("_Kept")

ENDING = ".evermap"
_MOST_OPEN = 200
_MOST_FILES, _MOST_MAPS = 8, 16


class NoSuchSiteError(InputError):
    """A server has no map of this name."""


@dataclass(frozen=True, slots=True)
class MapFile:
    """A map as one file.

    Attributes:
        data: the file.
        tag: name of its newest record, a checksum of all of its history.
        sha256: of the file, hexadecimal.
    """

    data: bytes
    tag: str
    sha256: str


class SiteStores:
    """The maps in a folder, one file each, or in a database.

    Args:
        where: the folder, or the address of the database.
    """

    def __init__(self, where: str | Path) -> None:
        self._where = where
        self._open: dict[str, list[SqlStore]] = {}
        self._files: dict[tuple[str, str], MapFile] = {}
        self._maps: dict[tuple[str, str], LivingMap] = {}
        self._lock = threading.Lock()

    def address(self, site: str) -> str:
        """Return the file or the address of a site.

        Raises:
            ConfigError: not a name that a site can have.
        """
        if not SITE.fullmatch(site):
            hint = "up to 48 letters, digits, - and _, a letter or digit first"
            raise ConfigError("is no name of a site", field="site", hint=hint)
        return address_of(str(self._where), site) if is_address(self._where) else str(Path(self._where, site + ENDING))

    def names(self) -> list[str]:
        """Return all sites."""
        if is_address(self._where):
            return sites_in(str(self._where))
        return sorted(path.stem for path in Path(self._where).glob(f"*{ENDING}") if SITE.fullmatch(path.stem))

    @contextmanager
    def store(self, site: str, *, create: bool = False) -> Iterator[SqlStore]:
        """Yield a store that nobody else uses meanwhile; what it has read of the history is kept for the next one.

        Raises:
            NoSuchSiteError: there is none, and none is made.
        """
        address = self.address(site)
        with self._lock:
            idle = self._open.get(site)
            store = idle.pop() if idle else None
        if store is None:
            if not create and site not in self.names():
                raise NoSuchSiteError("there is no such map", field="site", hint="GET /maps lists them")
            opened = open_store(address, create=create)
            assert isinstance(opened, SqlStore)
            store = opened
        yield store  # after an error it is not used again
        with self._lock:
            if sum(map(len, self._open.values())) < _MOST_OPEN:
                self._open.setdefault(site, []).append(store)

    def file(self, site: str, revision: int | None = None) -> MapFile:
        """Return the map up to a revision as one file; the last few are kept.

        Raises:
            InputError: there is no such map or revision.
        """
        with self.store(site) as store:
            number = store.head() if revision is None else revision
            tag = store.name_of(number)
            found = self._files.get((site, tag))
            if found is None:
                with tempfile.TemporaryDirectory(prefix="evermap-file-") as folder:
                    path = Path(folder) / "map.evermap"
                    snapshot(store, path, number)
                    data = path.read_bytes()
                found = MapFile(data, tag, hashlib.sha256(data).hexdigest())
                self._keep(self._files, (site, tag), found, _MOST_FILES)
        return found

    def living(self, site: str, revision: int | None = None) -> tuple[int, LivingMap]:
        """Return a revision's number and its map; the last few are kept.

        Raises:
            InputError: there is no such map or revision.
        """
        with self.store(site) as store:
            number = store.head() if revision is None else revision
            key = (site, store.name_of(number))
            found = self._maps.get(key)
            if found is None:
                found = store.load(number)
                self._keep(self._maps, key, found, _MOST_MAPS)
        return number, found

    def _keep(self, kept: dict[tuple[str, str], _Kept], key: tuple[str, str], value: _Kept, most: int) -> None:
        """Keep a value, and forget the oldest of too many."""
        with self._lock:
            while len(kept) >= most:
                kept.pop(next(iter(kept)))
            kept[key] = value
