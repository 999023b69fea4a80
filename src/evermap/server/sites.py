"""The maps behind a server, by the names of their sites."""

from __future__ import annotations

import hashlib
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from evermap.errors import ConfigError, InputError, printable
from evermap.maps.living import LivingMap
from evermap.maps.store import is_address, open_store
from evermap.maps.store.postgres import SITE, address_of, has_site, sites_in
from evermap.maps.store.sql import SqlStore
from evermap.maps.store.sqlite import snapshot

_Kept = TypeVar("_Kept")

ENDING = ".evermap"
_MOST_OPEN = 200
_MOST_FILES, _MOST_MAPS, _MOST_ANSWERS = 8, 16, 500
_LONGEST_ANSWER = 500_000
"""Maximum bytes of a cached answer."""


def store_place(where: str | Path) -> str | Path:
    """Return the folder or the address of a server's store.

    Raises:
        ConfigError: an address of something else.
    """
    scheme, mark, rest = str(where).partition("://")
    if not mark:
        return where
    if scheme not in ("postgres", "postgresql"):
        hint = "a folder, or postgresql://user@host/database"
        raise ConfigError(f"no store for '{printable(scheme, 40)}://'", field="store", hint=hint)
    return f"postgresql://{rest}"


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
        self._where = store_place(where)
        self._open: dict[str, list[SqlStore]] = {}
        self._files: dict[tuple[str, str], MapFile] = {}
        self._maps: dict[tuple[str, str], LivingMap] = {}
        self._answers: dict[tuple[str, str], tuple[str, bytes]] = {}
        self._lock = threading.Lock()

    def address(self, site: str) -> str:
        """Return the file or the address of a site.

        Raises:
            ConfigError: not a name that a site can have.
        """
        if not SITE.fullmatch(site):
            hint = "up to 48 letters, digits, - and _, a letter or digit first"
            raise ConfigError("is not a valid site name", field="site", hint=hint)
        return address_of(str(self._where), site) if is_address(self._where) else str(Path(self._where, site + ENDING))

    def names(self) -> list[str]:
        """Return all sites."""
        if is_address(self._where):
            return sites_in(str(self._where))
        return sorted(path.stem for path in Path(self._where).glob(f"*{ENDING}") if SITE.fullmatch(path.stem))

    def _has(self, site: str) -> bool:
        return has_site(str(self._where), site) if is_address(self._where) else Path(self.address(site)).is_file()

    @contextmanager
    def store(self, site: str, *, create: bool = False) -> Iterator[SqlStore]:
        """Yield a store for exclusive use; its cached history is kept for the next user.

        Raises:
            NoSuchSiteError: there is none, and none is made.
        """
        address = self.address(site)
        with self._lock:
            idle = self._open.get(site)
            store = idle.pop() if idle else None
        if store is None:
            if not create and not self._has(site):
                raise NoSuchSiteError("there is no such map", field="site", hint="GET /sites lists them")
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
            number, tag = store.named(revision)
            found = self._files.get((site, tag))
            if found is None:
                with tempfile.TemporaryDirectory(prefix="evermap-file-") as folder:
                    path = Path(folder) / "map.evermap"
                    snapshot(store, path, number)
                    data = path.read_bytes()
                found = MapFile(data, tag, hashlib.sha256(data).hexdigest())
                self._keep(self._files, (site, tag), found, _MOST_FILES)
        return found

    def living(self, store: SqlStore, revision: int | None = None) -> tuple[int, LivingMap]:
        """Return a revision's number and its map; the last few are kept.

        Raises:
            InputError: there is no such revision.
        """
        number, tag = store.named(revision)
        found = self._maps.get((store.where, tag))
        if found is None:
            found = store.load(number)
            self._keep(self._maps, (store.where, tag), found, _MOST_MAPS)
        return number, found

    def answer(self, site: str, asked: str, make: Callable[[SqlStore], bytes]) -> tuple[str, bytes]:
        """Return the newest revision's name and the answer to a query; cached until there is a newer one.

        Args:
            site: its name.
            asked: the question; equal ones have equal answers as long as the revision is the newest.
            make: works it out.

        Raises:
            InputError: there is no such map.
        """
        with self.store(site) as store:
            tag = store.named()[1]
            kept = self._answers.get((site, asked))
            if kept is not None and kept[0] == tag:
                return kept
            found = make(store)
        if len(found) <= _LONGEST_ANSWER:
            self._keep(self._answers, (site, asked), (tag, found), _MOST_ANSWERS)
        return tag, found

    def _keep(self, kept: dict[tuple[str, str], _Kept], key: tuple[str, str], value: _Kept, most: int) -> None:
        """Keep a value, and forget the oldest of too many."""
        with self._lock:
            while len(kept) >= most:
                kept.pop(next(iter(kept)))
            kept[key] = value
