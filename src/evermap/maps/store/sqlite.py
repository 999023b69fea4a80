"""A map store in one SQLite file.

A rollback journal instead of a write-ahead log: between two commits there is one file, which can be copied and mailed.
`synchronous = EXTRA` has a commit return only after the map, the journal and the folder are on the disk.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import Connection, Engine, NullPool, create_engine, event

from evermap.errors import InputError
from evermap.maps.living import LivingMap
from evermap.maps.store import content
from evermap.maps.store.anchor import is_anchor
from evermap.maps.store.content import NAME_BYTES, DamagedError, is_chunk
from evermap.maps.store.history import Record, ranges, read_pruned
from evermap.maps.store.measured import looks_of
from evermap.maps.store.packs import with_members
from evermap.maps.store.protocol import DamagedMapError, Provenance
from evermap.maps.store.sql import SqlStore

_PATIENCE_S = 20.0
"""So long one waits for another process to finish its commit."""


def open_sqlite(path: Path, *, create: bool) -> SqlStore:
    """See `open_store`."""
    if path.is_dir():
        raise InputError("is a folder; a map is one file", path=path, hint=str(path / "map.evermap"))
    if not path.exists() and not create:
        raise InputError("no such map", path=path, hint=f"evermap map enter {path} INPUT starts one")
    if not path.parent.is_dir():
        raise InputError(f"the folder {path.parent} does not exist", path=path, hint=f"mkdir -p {path.parent}")
    if path.is_file() and path.stat().st_size == 1:  # SQLite would take it for an empty one
        raise InputError("is not an evermap map", path=path, hint="another file")
    engine = engine_of(path, writable=os.access(path if path.exists() else path.parent, os.W_OK))

    def explain(problem: str) -> InputError | None:
        found = survey(path)
        return None if found is None else found.error(path, problem)

    return SqlStore(engine, str(path), create=create, tidy=lambda: _compact(engine), explain=explain)


def _compact(engine: Engine) -> None:
    """Give back the pages that a migration or pruning has left; without room to do that they stay."""
    connection = engine.raw_connection()
    with suppress(sqlite3.DatabaseError):
        connection.cursor().execute("VACUUM")
    connection.close()


def engine_of(path: Path, *, writable: bool) -> Engine:
    """Return an engine whose transactions lock the file at once where they have `execution_options(writes=True)`."""
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


_PAGE = 4096
"""Bytes of a page where the header does not say."""
_TABLE_LEAF = 0x0D
_INTEGER_BYTES = (0, 1, 2, 3, 4, 6, 8)


@dataclass(frozen=True, slots=True)
class Verification:
    """Intact and damaged parts of a map file.

    Attributes:
        head: the newest revision that is known of.
        intact: the revisions of which every byte is what was written.
        damaged: what is wrong with the others.
        lost: revisions that earlier damage has destroyed, as the map says itself.
        problems: of the file as a whole: its pages, its lists.
        n_chunks, n_bytes: pieces that were checked, and the size of the file.
        pruned: revisions of which only the history is there, and whole.
    """

    head: int
    intact: tuple[int, ...]
    damaged: Mapping[int, str]
    lost: tuple[int, ...]
    problems: tuple[str, ...]
    n_chunks: int
    n_bytes: int
    pruned: tuple[int, ...] = ()

    @property
    def sound(self) -> bool:
        """Whether nothing is damaged."""
        return not self.damaged and not self.problems

    def error(self, path: Path | str, problem: str = "") -> DamagedMapError:
        """Return one line that names the damage, the intact revisions, and how to revert to them."""
        told = [problem] if problem else list(self.problems[:1])
        if self.damaged and not problem:
            number = min(self.damaged)
            others = f", and {len(self.damaged) - 1} more revisions" if len(self.damaged) > 1 else ""
            told.append(f"revision {number}: {self.damaged[number]}{others}")
        whole, hint = "no revision is", "a copy of the file"
        if self.intact:
            listed, hint = ranges(self.intact), f"evermap map revert {path} {self.intact[-1]}"
            whole = f"revisions {listed} are" if len(self.intact) > 1 else f"revision {listed} is"
        error = DamagedMapError(f"damaged: {'; '.join(told)}; {whole} intact", path=path, hint=hint)
        error.intact = self.intact
        return error


def verify(path: Path) -> Verification:
    """Check every byte of a map file that means something.

    Raises:
        InputError: the file cannot be read.
    """
    return _Found.of_file(path).verified(_problems(path), path.stat().st_size)


def verify_rows(store: SqlStore) -> Verification:
    """Check every byte of a map in a database that keeps no file."""
    rows = store.rows()
    n_bytes = sum(len(value) for row in rows for value in row if isinstance(value, bytes))
    return _Found._of_rows(rows).verified(_unread(store), n_bytes)


def survey(path: Path) -> Verification | None:
    """Return the same without asking the database; None where there is no trace of a map."""
    try:
        found = _Found.of_file(path)
    except InputError:
        return None
    if not found.records and found.anchor is None:
        return None
    return found.verified(deep=False)


def snapshot(store: SqlStore, path: Path, revision: int) -> None:
    """Write a map of any store, up to a revision, as a file that does not exist; of equal maps the files are equal.

    Raises:
        DamagedMapError: the store is damaged.
        InputError: it has no such revision.
    """
    rows = store.rows()
    found = _Found._of_rows(rows)
    numbers = [number for number in sorted(found.records) if number <= revision]
    if revision not in numbers or revision in found.pruned:
        raise InputError(f"no revision {revision} with its content", path=store.where, hint="a newer one")
    made = next((row[1], row[2]) for row in rows if len(row) > 2)
    with open_sqlite(path, create=True) as fresh:
        try:
            found.copy_to(fresh, numbers, revision, made)
        except DamagedError as error:
            raise DamagedMapError(f"damaged: {error}", path=store.where, hint="evermap map verify") from None


def rescue(path: Path, revision: int, provenance: Provenance | None = None) -> tuple[int, Path]:
    """Go back to an intact revision of a damaged file, 0 for the empty map: every intact one is kept, the damaged file
    is set aside. Returns the number of the new revision, and where the damaged file is.

    Raises:
        DamagedMapError: that revision is not intact.
    """
    _finish_transactions(path)
    found = _Found.of_file(path)
    checked = found.verified()
    pruned, damaged = checked.pruned, checked.damaged
    if revision != 0 and revision not in checked.intact:
        why = "its content is pruned" if revision in pruned else damaged.get(revision, "there is no such revision")
        raise checked.error(path, f"revision {revision}: {why}")
    records = {number: found.records[number] for number in (*checked.intact, *pruned)}
    next_ids = [max((record.next_ids[k] for record in found.records.values()), default=0) for k in (0, 1)]
    before = {number: found.names.get(number - 1) if number - 1 in records else None for number in damaged}
    lost = {**{number: name if number - 1 in records else None for number, name in found.lost.items()}, **before}
    fresh = path.with_name(f".{path.name}.{os.getpid()}.rescue")
    fresh.unlink(missing_ok=True)
    try:
        with open_sqlite(fresh, create=True) as store:
            found.copy_to(store, records, found.head)
            old = content.unpack(records[revision].content, found.fetch) if revision else LivingMap()
            number = store.restore(old, revision, found.head, (next_ids[0], next_ids[1]), provenance, lost)
        aside = _set_aside(path)
        fresh.replace(path)
    finally:
        fresh.unlink(missing_ok=True)
    return number, aside


@dataclass(frozen=True, slots=True)
class _Found:
    """Records and chunks found in a file.

    Attributes:
        chunks: stored bytes of pieces that are what was written, by name.
        anchor: number and record of the newest revision; None where the row that names them is damaged.
        records, names: of revisions whose record is whole, and the names of the records.
        lost: as `Record.lost`, of all records.
        pruned: revisions without content, and since when; '' where that is not known.
    """

    chunks: Mapping[bytes, bytes]
    anchor: tuple[int, bytes | None] | None
    records: Mapping[int, Record]
    names: Mapping[int, bytes]
    lost: Mapping[int, bytes | None]
    pruned: Mapping[int, str]

    def copy_to(
        self, store: SqlStore, numbers: Collection[int], head: int, made: tuple[str, str] | None = None
    ) -> None:
        """Put revisions into an empty store, up to the newest, `head`; `made` as `SqlStore.fill`."""
        kept: set[bytes] = set()
        for number in numbers:
            kept |= {self.names[number], *self.closure(self.records[number])}
        names = {number: self.names[number] for number in numbers}
        since = {number: self.pruned[number] for number in numbers if number in self.pruned}
        store.fill({name: self.chunks[name] for name in sorted(kept)}, names, head, since, made)

    def verified(self, problems: Iterable[str] = (), n_bytes: int = 0, *, deep: bool = True) -> Verification:
        """Return the verification; `deep` includes the maps themselves."""
        intact, pruned, damaged = self.verdicts(deep=deep)
        lost = tuple(sorted(self.lost))
        return Verification(self.head, intact, damaged, lost, tuple(problems), len(self.chunks), n_bytes, pruned)

    @property
    def head(self) -> int:
        """The newest revision that is known of."""
        return max([*self.records, *self.lost, self.anchor[0] if self.anchor else 0])

    @classmethod
    def of_file(cls, path: Path) -> _Found:
        try:
            data = path.read_bytes()
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror}", path=path) from None
        sizes = [_PAGE]
        if len(data) >= 18:
            told = int.from_bytes(data[16:18], "big")
            told = 65536 if told == 1 else told
            if told >= 512 and told & (told - 1) == 0 and told != _PAGE:
                sizes.insert(0, told)
        for size in sizes:
            found = cls._of_rows(_rows(data, size))
            if found.records or found.anchor:
                break
        return found

    @classmethod
    def _of_rows(cls, rows: Iterable[list[Any]]) -> _Found:
        chunks: dict[bytes, bytes] = {}
        listed: set[bytes] = set()
        anchor: tuple[int, bytes | None] | None = None
        pruned: dict[int, str] = {}
        candidates: dict[int, dict[bytes, Record]] = {}
        for row in with_members(rows):
            if is_anchor(row) and (anchor is None or row[3] > anchor[0]):
                anchor, pruned = (row[3], row[4]), read_pruned((*row, None)[6])
            if len(row) != 2 or not isinstance(row[1], bytes):
                continue
            name, data = row
            if name is None or isinstance(name, int):
                listed.add(data)
            elif isinstance(name, bytes) and len(name) == NAME_BYTES and name not in chunks and is_chunk(name, data):
                chunks[name] = data
                with suppress(DamagedError):
                    record = Record.of_text(content.read_text(name, data))
                    candidates.setdefault(record.number, {})[name] = record
        records: dict[int, Record] = {}
        names: dict[int, bytes] = {}
        lost: dict[int, bytes | None] = {}
        expected = None if anchor is None else anchor[1]
        for number in range(max([*candidates, anchor[0] if anchor else 0]), 0, -1):
            if number in lost:
                expected = lost[number]
                continue
            these = candidates.get(number, {})
            # the one that its successor names; where that is not known the one that is listed
            name = expected
            if expected is None:
                name = min(these, key=lambda other: (other not in listed, other), default=None)
            if name is None or name not in these:
                expected = None
                continue
            records[number], names[number] = these[name], name
            lost |= records[number].lost
            expected = records[number].parent
        found = cls(chunks, anchor, records, names, lost, pruned)
        if anchor is None and records:  # the list is lost: what has its history only may have been pruned
            guess = replace(found, pruned=dict.fromkeys(found.verdicts(deep=False)[2], ""))
            found = replace(found, pruned=dict.fromkeys(guess.verdicts(deep=False)[1], ""))
        return found

    def verdicts(self, *, deep: bool) -> tuple[tuple[int, ...], tuple[int, ...], dict[int, str]]:
        """Return the revisions that are whole, those that are pruned and otherwise whole, and what is wrong with the
        others; `deep` builds their maps, too.
        """
        whole, damaged = [], {}
        for number in range(1, self.head + 1):
            if number in self.lost:
                continue
            if number not in self.records:
                damaged[number] = "its record is missing or damaged"
                continue
            try:
                self.closure(self.records[number])
                if deep and number not in self.pruned:
                    content.unpack(self.records[number].content, self.fetch)
            except DamagedError as error:
                damaged[number] = str(error)
            else:
                whole.append(number)
        pruned = tuple(number for number in whole if number in self.pruned)
        return tuple(number for number in whole if number not in self.pruned), pruned, damaged

    def closure(self, record: Record) -> set[bytes]:
        """Return names of all chunks of a revision but its record; `DamagedError` if one is not there."""
        content.text_of(record.config, self.fetch)
        names = record.chunks(self.fetch, content.MEMBERS if record.number in self.pruned else "")
        for row in record.looks(self.fetch):
            looks_of(row.clique_id, self.fetch([row.name])[row.name], row.name)
        self.fetch(names)
        return names

    def fetch(self, names: Iterable[bytes]) -> dict[bytes, bytes]:
        """Return `content.Fetch`."""
        try:
            return {name: self.chunks[name] for name in names}
        except KeyError:
            raise DamagedError("a part of it is missing or damaged") from None


def _problems(path: Path) -> Iterator[str]:
    """Return problems found by the database itself, and by reading its lists."""
    try:
        with open_sqlite(path, create=False) as store:
            unread = list(_unread(store))
    except DamagedMapError as error:
        unread = [_plain(error)]
    if unread:
        yield from unread
        return
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
            found = [str(row[0]) for row in database.execute("PRAGMA integrity_check(3)")]
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        found = [str(error)]
    if found != ["ok"]:
        yield "SQLite: " + "; ".join(" ".join(line.replace("*** in database main ***", "").split()) for line in found)


def _unread(store: SqlStore) -> Iterator[str]:
    """Return problems found by reading the lists of a map."""
    try:
        store.log()
        store.head()
    except DamagedMapError as error:
        yield _plain(error)


def _plain(error: DamagedMapError) -> str:
    return error.problem.removeprefix("damaged: ").partition("; ")[0]


def _finish_transactions(path: Path) -> None:
    """Let the database roll back uncommitted changes, if it still can."""
    with suppress(sqlite3.DatabaseError, UnicodeDecodeError), closing(sqlite3.connect(path)) as database:
        database.execute("SELECT count(*) FROM sqlite_master").fetchone()


def _set_aside(path: Path) -> Path:
    """Give a damaged file a second name that is free, and what its journal is called with it."""
    k = 1
    while (aside := path.with_name(f"{path.name}.damaged{'' if k == 1 else f'-{k}'}")).exists():
        k += 1
    try:
        os.link(path, aside)
    except OSError:  # a file system without links
        shutil.copy2(path, aside)
    for tail in ("-journal", "-wal", "-shm"):
        with suppress(FileNotFoundError):
            Path(f"{path}{tail}").replace(f"{aside}{tail}")
    return aside


def _rows(data: bytes, page_size: int) -> Iterator[list[Any]]:
    """Every row of every table whose page can still be read, without the database (sqlite.org/fileformat2.html)."""
    usable = page_size - (data[20] if len(data) > 20 and data[:15] == b"SQLite format 3" else 0)
    if usable < 480:
        usable = page_size
    for start in range(0, len(data) - 8, page_size):
        head = start + (100 if start == 0 else 0)
        if head + 8 > len(data) or data[head] != _TABLE_LEAF:
            continue
        (count,) = struct.unpack_from(">H", data, head + 3)
        for k in range(min(count, page_size // 4)):
            with suppress(IndexError, struct.error, ValueError):
                (at,) = struct.unpack_from(">H", data, head + 8 + 2 * k)
                yield _values(_payload(data, start, at, page_size, usable))


def _payload(data: bytes, start: int, at: int, page_size: int, usable: int) -> bytes:
    """The bytes of a row, those on overflow pages included."""
    size, at = _varint(data, start + at)
    _, at = _varint(data, at)
    if size > len(data):
        raise ValueError
    most = usable - 35
    if size <= most:
        return data[at : at + size]
    least = (usable - 12) * 32 // 255 - 23
    own = least + (size - least) % (usable - 4)
    own = own if own <= most else least
    parts = [data[at : at + own]]
    (page,) = struct.unpack_from(">I", data, at + own)
    left = size - own
    while left > 0:
        if page == 0:
            raise ValueError
        base = (page - 1) * page_size
        (page,) = struct.unpack_from(">I", data, base)
        parts.append(data[base + 4 : base + 4 + min(left, usable - 4)])
        left -= usable - 4
    return b"".join(parts)


def _values(payload: bytes) -> list[Any]:
    """The columns of a row; `ValueError` or `IndexError` if these bytes are none."""
    end, at = _varint(payload, 0)
    body = end
    values: list[Any] = []
    while at < end:
        kind, at = _varint(payload, at)
        if kind in (0, 8, 9):
            values.append(None if kind == 0 else kind - 8)
            continue
        size = _INTEGER_BYTES[kind] if kind <= 6 else 8 if kind == 7 else (kind - 12) // 2
        part = payload[body : body + size]
        if len(part) != size or kind in (10, 11):
            raise ValueError
        if kind <= 6:
            values.append(int.from_bytes(part, "big", signed=True))
        elif kind == 7:
            values.append(struct.unpack(">d", part)[0])
        else:
            values.append(part if kind % 2 == 0 else part.decode())
        body += size
    return values


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of SQLite, and where the next one begins."""
    value = 0
    for k in range(8):
        byte = data[at + k]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + k + 1
    return value << 8 | data[at + 8], at + 9
