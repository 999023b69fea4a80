"""A map store in an SQL database, whichever it is."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Engine, bindparam, func, insert, select, update
from sqlalchemy.exc import DBAPIError, IntegrityError
from sqlalchemy.schema import CreateSchema

from evermap import __version__
from evermap.errors import ConfigError, InputError, NumericalError
from evermap.existence.sites import Evidence
from evermap.maps.diff import grown
from evermap.maps.living import LivingMap, Members
from evermap.maps.store import content, schema
from evermap.maps.store.anchor import STORE_COLUMNS, list_pruned, move_anchor, now_utc, read_anchor, read_schema_version
from evermap.maps.store.chain import RecordChain
from evermap.maps.store.chunk_table import LENGTH, delete_chunks, fetch_chunks, in_batches, list_packs, replace_chunks
from evermap.maps.store.content import Chunk, DamagedError, deflate, inflate, is_chunk
from evermap.maps.store.history import STORY, Record, about, ranges
from evermap.maps.store.measured import evidence_to_chunks, join_by_time, looks_of, read_index
from evermap.maps.store.packs import PACK_BYTES, make_pack
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
from evermap.maps.store.schema import migrate
from evermap.show import Shown, data_frame
from evermap.types import ChangeKind, MapChange

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_CHECKED = 2_000
"""Names of checked chunks that are remembered, a few times those of one map."""
_PACKED_AT_ONCE = 64
"""The same when packing: some 10 MB."""
_LONGEST = 900_000_000
"""Bytes of an attachment; a database takes no more in one piece."""


class SqlStore(Shown, MapStore):
    """`MapStore` over an engine of SQLAlchemy, see there. Tables are made or brought up to date.

    Args:
        engine: of the database.
        where: path or address, for messages.
        create: make the tables where there are none.
        explain: makes the error of a problem with the bytes, saying what is whole; None where there is no map.
        tidy: called once old tables have been replaced, or content deleted.

    Raises:
        InputError: as of `open_store`.
    """

    def __init__(
        self,
        engine: Engine,
        where: str,
        *,
        create: bool,
        explain: Callable[[str], InputError | None],
        tidy: Callable[[], None] = lambda: None,
    ) -> None:
        self.where = where
        self._engine, self._explain, self._tidy = engine, explain, tidy
        self._chain = RecordChain(where)
        self._checked: set[bytes] = set()  # chunks that this object has read, and found to be what was written
        with self._transaction() as connection:
            version = read_schema_version(connection, where)
        if version == 0 and not create:
            raise InputError("contains no map", path=where, hint="evermap map enter FILE INPUT writes one")
        if version < schema.SCHEMA_VERSION:
            with self._transaction(writes=True) as connection:
                version = read_schema_version(connection, where)  # somebody may have been faster
                if version == 0:
                    if own := engine.get_execution_options().get("schema"):
                        connection.execute(CreateSchema(own, if_not_exists=True))
                    schema.metadata.create_all(connection)
                    values = (schema.SCHEMA_VERSION, now_utc(), __version__, 0, None)
                    row = dict(zip(STORE_COLUMNS, values, strict=True)) | {"checksum": schema.checksum(*values)}
                    connection.execute(insert(schema.store).values(row))
                elif version < schema.SCHEMA_VERSION:
                    migrate(connection, version)
            if version > 0:
                tidy()

    def _facts(self) -> dict[str, Any]:
        try:
            log = self.log()
        except InputError as error:  # a damaged file shows itself, too
            return {"where": self.where, "damaged": error.problem}
        newest = log[-1] if log else None
        about = {"recording": newest.provenance.recording, "existing": newest.n_existing} if newest else {}
        return {"where": self.where, "revisions": len(log), "head": newest.number if newest else 0, **about}

    def to_pandas(self) -> Any:
        """Return the history as a data frame, a row a revision.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        log = self.log()
        names = ("number", "parent", "created_at", "n_landmarks", "n_existing", "n_grown")
        columns: dict[str, Any] = {name: [getattr(item, name) for item in log] for name in names}
        columns |= {name: [getattr(item.provenance, name) for item in log] for name in ("kind", "recording", "note")}
        told = [{kind.value: count for kind, count in item.n_changes.items()} for item in log]
        return data_frame({**columns, **{kind: [one.get(kind, 0) for one in told] for kind in map(str, ChangeKind)}})

    def plot(self) -> Figure:
        """Draw the newest map; returns a matplotlib figure."""
        return self.load().plot(title=f"{self.where}, revision {self.head()}")

    def close(self) -> None:
        self._engine.dispose()

    def head(self) -> int:
        with self._transaction() as connection:
            return read_anchor(connection)[0]

    def log(self) -> tuple[Revision, ...]:
        with self._transaction() as connection:
            records = self._chain.read(connection)[0]
            stored = fetch_chunks(connection, {record.config for record in records.values()})
            configs = {name: content.read_text(name, data) for name, data in stored.items()}
            return tuple(record.revision(configs[record.config]) for _, record in sorted(records.items()))

    def lineage(self, revision: int | None = None) -> tuple[int, ...]:
        with self._transaction() as connection:
            return self._chain.find_lineage(connection, revision)

    def load(self, revision: int | None = None) -> LivingMap:
        with self._transaction() as connection:
            number = self._chain.find_number(connection, revision)
            if number == 0:
                return LivingMap()
            record = self._chain.record_of(connection, number)
            pruned = list_pruned(connection)
            if number in pruned:
                raise self._report_gone(number, pruned[number], self._chain.read(connection)[0].keys() - pruned.keys())
            return self._unpacked(connection, record)

    def members(self, revision: int | None = None) -> Members:
        with self._transaction() as connection:
            number = self._chain.find_number(connection, revision)
            if number == 0:
                return LivingMap().members
            names = [item.name for item in fields(Members)]
            return Members(*self._columns(connection, self._chain.record_of(connection, number), *names))

    def commit(
        self,
        living: LivingMap,
        provenance: Provenance,
        changes: Sequence[MapChange] = (),
        evidence: Evidence | None = None,
        *,
        parent: int,
        attachments: Mapping[str, bytes | Attachment] | None = None,
        restores: int | None = None,
        lost: Mapping[int, bytes | None] | None = None,
    ) -> int:
        """Return a new revision, whole or not at all; what takes time is done before the store is locked.

        Arguments are those of `MapStore.commit`; `restores` is the revision that is brought back, and `lost` are those
        that damage has destroyed, see `Record`.
        """
        problem = content.flaw(living)
        if problem:
            raise NumericalError(f"not a map that can be kept: {problem}", path=self.where)
        name, chunks = content.pack(living)
        config, looks = content.text_chunk(provenance.config), evidence_to_chunks(evidence)
        chunks |= {chunk.name: chunk for chunk in (config, *looks)}
        attached = self._attach(attachments or {}, chunks)
        number = parent + 1
        told = about(
            provenance,
            number=number,
            parent=parent,
            restores=restores,
            created_at=now_utc(),
            evermap_version=__version__,
            n_landmarks=len(living.members),
            n_existing=int(np.sum((living.p_of_sites(living.sites.p_here) >= 0.5) & ~living.members.deleted)),
        )
        stored = {key: chunk.stored() for key, chunk in chunks.items() if key not in self._checked}
        with self._transaction(writes=True) as connection:
            head, before = read_anchor(connection)
            if head != parent:
                problem = f"revision {head} was committed after revision {parent} was read; nothing was written"
                hint = "run it again, which continues from the newest"
                raise StaleRevisionError(problem, path=self.where, hint=hint)
            record = Record(
                {**told, "n_grown": 0 if restores is not None else self._n_grown(connection, parent, living, changes)},
                before,
                name,
                config.name,
                looks[0].name if looks else None,
                tuple(changes),
                attached,
                (living.n_cliques_ever, living.n_sites_ever),
                lost or {},
            ).chunk()
            chunks[record.name] = record
            self._put(connection, chunks, {**stored, record.name: record.stored()})
            fetch_chunks(connection, {key for key, _ in attached.values()} - chunks.keys())  # those that are shared
            connection.execute(insert(schema.revision).values(number=number, record=record.name))
            move_anchor(connection, number, record.name)
        self._remember(chunks.keys())
        return number

    def revert(self, revision: int, provenance: Provenance | None = None) -> int:
        with self._transaction() as connection:
            head = self._chain.find_number(connection, None)
            number = self._chain.find_number(connection, revision)
            next_ids = self._chain.record_of(connection, head).next_ids if head else (0, 0)
        old = self.load(number)
        if number == head:
            raise InputError(f"revision {number} is the newest already", path=self.where, hint="an older one")
        return self.restore(old, number, head, next_ids, provenance)

    def restore(
        self,
        old: LivingMap,
        revision: int,
        head: int,
        next_ids: tuple[int, int],
        provenance: Provenance | None = None,
        lost: Mapping[int, bytes | None] | None = None,
    ) -> int:
        """Commit the map of an older revision again, so that no id of cliques and sites that was given since is given
        twice. `lost` are revisions that damage has destroyed, see `Record`.
        """
        restored = replace(
            old,
            n_cliques_ever=max(old.n_cliques_ever, next_ids[0]),
            n_sites_ever=max(old.n_sites_ever, next_ids[1]),
        )
        origin = Provenance() if provenance is None else provenance
        origin = replace(origin, kind=RevisionKind.REVERT, note=origin.note or f"back to revision {revision}")
        return self.commit(restored, origin, parent=head, restores=revision, lost=lost)

    def prune(self, keep: int = 10, *, also: Collection[int] = (), dry_run: bool = False) -> Pruning:
        if keep < 1:
            raise ConfigError(f"{keep} is less than 1", field="keep", hint="1 keeps the newest revision only")
        with self._transaction(writes=not dry_run) as connection:
            records, pruned = self._chain.read(connection)[0], list_pruned(connection)
            newest = {*sorted(records)[-keep:], *self._chain.find_lineage(connection, None)[-keep:]}
            kept = (newest | (records.keys() & {*also})) - pruned.keys()
            old = records.keys() - pruned.keys() - kept
            for number in kept:  # as long as one of them is damaged, an old one may be needed
                self._unpacked(connection, records[number])
            doomed = self._only_of(connection, records, old, kept)
            doomed |= {pack for pack, members in list_packs(connection).items() if members <= doomed}
            n_bytes, size = 0, select(func.sum(LENGTH))
            for some in in_batches(doomed):
                n_bytes += connection.execute(size.where(schema.chunk.c.name.in_(some))).scalar() or 0
            if not dry_run:
                delete_chunks(connection, doomed)
            if old and not dry_run:
                move_anchor(connection, *read_anchor(connection), {**pruned, **dict.fromkeys(old, now_utc())})
        if not dry_run:
            self._checked -= doomed
            self._tidy()  # also what an earlier call was killed before
        return Pruning(tuple(sorted(old)), tuple(sorted(kept)), len(doomed), n_bytes)

    def compact(self) -> None:
        with self._transaction(writes=True) as connection:
            head, anchor = read_anchor(connection)
            before = list_packs(connection)
            for names in self._alike(connection):
                some, n_bytes = dict[bytes, bytes](), 0
                for batch in in_batches(names, _PACKED_AT_ONCE):
                    stored = fetch_chunks(connection, batch)
                    for name in batch:
                        if not is_chunk(name, stored[name]):
                            raise DamagedError("a checksum does not match")
                        some[name] = stored[name]
                        n_bytes += len(inflate(stored[name]))
                        if n_bytes >= PACK_BYTES:
                            replace_chunks(connection, make_pack(some))
                            some, n_bytes = {}, 0
                replace_chunks(connection, make_pack(some))
            after = list_packs(connection)
            delete_chunks(connection, before.keys() - after.keys())
            version = schema.PACKED_VERSION if after else schema.SCHEMA_VERSION
            move_anchor(connection, head, anchor, version=version)
        self._tidy()  # also what an earlier call was killed before

    def _alike(self, connection: Connection) -> Iterator[list[bytes]]:
        """Yield the names of chunks of one kind of all revisions but the newest, oldest first; those of the newest,
        which every session reads, are taken out of their packs. Attachments are compressed already but for stories.
        """
        fetch = partial(fetch_chunks, connection)
        records, pruned = self._chain.read(connection)[0], list_pruned(connection)
        if not records:
            return
        rows = connection.execute(select(schema.revision).order_by(schema.revision.c.number))
        names = {row.number: row.record for row in rows if row.number in records}
        newest = max(records)
        apart = {names[newest], *records[newest].chunks(fetch)}
        replace_chunks(connection, {name: deflate(data) for name, data in fetch(apart).items()})
        found: dict[object, dict[bytes, None]] = {"record": dict.fromkeys(names.values())}
        for number, record in sorted(records.items()):
            for kind, parts in record.parts(fetch, content.MEMBERS if number in pruned else "").items():
                if kind[0] != "attachment" or kind[1] == STORY:
                    found.setdefault(kind, {}).update(dict.fromkeys(parts))
        seen = apart
        for alike in found.values():
            yield [name for name in alike if name not in seen]
            seen |= alike.keys()

    def changes(self, revision: int | None = None) -> tuple[MapChange, ...]:
        with self._transaction() as connection:
            number = self._chain.find_number(connection, revision)
            return self._chain.record_of(connection, number).changes if number else ()

    def changes_of(self, landmark_id: int | None = None) -> tuple[tuple[int, MapChange], ...]:
        with self._transaction() as connection:
            records = self._chain.read(connection)[0]
        told = ((number, change) for number, record in sorted(records.items()) for change in record.changes)
        return tuple((number, change) for number, change in told if landmark_id in (None, *change.landmark_ids))

    def evidence(
        self,
        *,
        clique_id: int | None = None,
        landmark_id: int | None = None,
        since_s: float = -np.inf,
        revisions: Collection[int] | None = None,
    ) -> Evidence:
        parts = self.evidence_by_revision(
            clique_id=clique_id, landmark_id=landmark_id, since_s=since_s, revisions=revisions
        )
        found = Evidence.empty().joined(*parts.values())
        return found[np.argsort(found.stamp_s, kind="stable")]

    def evidence_by_revision(
        self,
        *,
        clique_id: int | None = None,
        landmark_id: int | None = None,
        since_s: float = -np.inf,
        revisions: Collection[int] | None = None,
    ) -> dict[int, Evidence]:
        with self._transaction() as connection:
            records = self._chain.records_of(connection, revisions)
            parts: dict[int, list[Evidence]] = {record.number: [] for record in records}
            cliques = dict.fromkeys(parts, clique_id)
            if landmark_id is not None:
                cliques = self._cliques_of(connection, records, landmark_id)
            wanted: dict[bytes, dict[int | None, int]] = {}  # clique, None for every one, and the first revision
            for record in records:
                clique = cliques[record.number]
                mine = landmark_id is None or (clique is not None and clique_id in (None, clique))
                if record.evidence is not None and mine:
                    wanted.setdefault(record.evidence, {}).setdefault(clique, record.number)
            rows = [
                (wanted[name].get(row.clique_id, wanted[name].get(None, 0)), row)
                for name, data in fetch_chunks(connection, wanted).items()
                for row in read_index(content.read_text(name, data))
                if row.last_s >= since_s and not wanted[name].keys().isdisjoint({None, row.clique_id})
            ]
            stored = fetch_chunks(connection, {row.name for _, row in rows})
            for number, row in rows:
                parts[number].append(looks_of(row.clique_id, stored[row.name], row.name))
        return {number: join_by_time(some, since_s) for number, some in parts.items()}

    def attachments(self, revisions: Collection[int] | None = None) -> tuple[Attachment, ...]:
        with self._transaction() as connection:
            return tuple(item for record in self._chain.records_of(connection, revisions) for item in record.attached())

    def attached(self, attachment: Attachment) -> bytes:
        with self._transaction() as connection:
            name = content.name_of(attachment.digest)
            return Chunk.of_stored(name, "|u1", fetch_chunks(connection, [name])[name]).raw

    def named(self, revision: int | None = None) -> tuple[int, str]:
        """Return a revision's number (None for the newest) and its name, a checksum of it and all before it."""
        with self._transaction() as connection:
            number, name = read_anchor(connection)
            if revision is not None:
                number, table = self._chain.find_number(connection, revision), schema.revision.c
                name = connection.execute(select(table.record).where(table.number == number)).scalar()
            return number, name.hex() if isinstance(name, bytes) else ""

    def rows(self) -> list[list[Any]]:
        """Return all rows of all tables, as they are stored."""
        with self._transaction() as connection:
            return [list(row) for table in schema.metadata.sorted_tables for row in connection.execute(select(table))]

    def fill(
        self,
        chunks: Mapping[bytes, bytes],
        records: Mapping[int, bytes],
        head: int,
        pruned: Mapping[int, str],
        made: tuple[str, str] | None = None,
    ) -> None:
        """Put revisions from elsewhere into an empty store: stored bytes by name, and names of records by number.

        Records that are missing up to the newest, `head`, are lost. Revisions that are pruned have no content, since
        when is told; and `made` is when and by which evermap the store was made, None for now and by this one.
        """
        with self._transaction(writes=True) as connection:
            if made is not None:
                values = {"created_at": made[0], "evermap_version": made[1]}
                connection.execute(update(schema.store).values(values))
            rows = [{"name": name, "data": deflate(data)} for name, data in chunks.items()]
            if rows:
                connection.execute(insert(schema.chunk), rows)
            numbers = [{"number": number, "record": records.get(number)} for number in range(1, head + 1)]
            if numbers:
                connection.execute(insert(schema.revision), numbers)
            move_anchor(connection, head, records.get(head), pruned)

    def extend(self, other: SqlStore) -> int:
        """Take over all revisions that another store has after the newest of this one, whole or not at all; returns the
        newest.

        Raises:
            StaleRevisionError: the newest of this one is none of the other's.
        """
        with other._transaction() as theirs, self._transaction(writes=True) as connection:
            named: dict[int, Any] = {row.number: row.record for row in theirs.execute(select(schema.revision))}
            (head, anchor), (last, newest) = read_anchor(connection), read_anchor(theirs)
            if named.get(head) != anchor:
                problem = f"revision {head} is not in {other.where}; nothing was written"
                raise StaleRevisionError(problem, path=self.where, hint="run it again")
            fetch, wanted = partial(fetch_chunks, theirs), {named[number] for number in named if number > head}
            for number, record in other._chain.read(theirs, head + 1)[0].items():
                if number > head:
                    wanted |= record.chunks(fetch)
            for some in in_batches(sorted(wanted)):
                there = connection.execute(select(schema.chunk.c.name).where(schema.chunk.c.name.in_(some))).scalars()
                rows = [{"name": name, "data": deflate(data)} for name, data in fetch(set(some) - set(there)).items()]
                if rows:
                    connection.execute(insert(schema.chunk), rows)
            if new := [{"number": number, "record": name} for number, name in sorted(named.items()) if number > head]:
                connection.execute(insert(schema.revision), new)
                move_anchor(connection, last, newest)
        return last

    def _n_grown(
        self, connection: Connection, parent: int, living: LivingMap, changes: Sequence[MapChange]
    ) -> int | None:
        """Return the number of landmarks that a map has grown by; None if its parent is unknown."""
        known = np.zeros(0, dtype=np.int64)
        try:
            if parent:
                (known,) = self._columns(connection, self._chain.record_of(connection, parent), "landmark_id")
        except (DamagedError, InputError):
            return None
        return len(grown(known, living, changes))

    def _attach(
        self, attachments: Mapping[str, bytes | Attachment], chunks: dict[bytes, Chunk]
    ) -> dict[str, tuple[bytes, int]]:
        """Names and sizes of attachments; bytes that are new are added to `chunks`."""
        attached = {}
        for name, item in attachments.items():
            if isinstance(item, Attachment):
                attached[name] = content.name_of(item.digest), item.n_bytes
                continue
            if len(item) > _LONGEST:
                raise ConfigError(f"has {len(item)} bytes, more than {_LONGEST}", path=self.where, field=name)
            chunk = Chunk("|u1", bytes(item))
            chunks[chunk.name] = chunk
            attached[name] = chunk.name, len(item)
        return attached

    def _put(self, connection: Connection, chunks: Mapping[bytes, Chunk], stored: Mapping[bytes, bytes]) -> None:
        """Store the chunks that are not there yet; one that is there, but damaged, is written anew."""
        column = schema.chunk.c.name
        question = select(column).where(column.in_(bindparam("names", expanding=True)))
        answers = (connection.execute(question, {"names": some}) for some in in_batches(chunks))
        present = {bytes(row[0]) for answer in answers for row in answer}
        for key, data in fetch_chunks(connection, (present - self._checked) & chunks.keys(), missing_ok=True).items():
            try:
                Chunk.of_stored(key, chunks[key].dtype, data)
            except DamagedError:
                connection.execute(update(schema.chunk).where(column == key).values(data=chunks[key].stored()))
        new = sorted(chunks.keys() - present)
        rows = [{"name": key, "data": stored[key] if key in stored else chunks[key].stored()} for key in new]
        if rows:
            connection.execute(insert(schema.chunk), rows)

    def _only_of(
        self, connection: Connection, records: Mapping[int, Record], old: Collection[int], kept: Collection[int]
    ) -> set[bytes]:
        """Names of the chunks that are content of old revisions and nothing else."""
        fetch = partial(fetch_chunks, connection)
        found = {name for number in old for name in content.names_in(records[number].content, fetch)}
        for number, record in records.items():
            found -= record.chunks(fetch, "" if number in kept else content.MEMBERS)
        return found

    def _report_gone(self, number: int, since: str, kept: Collection[int]) -> PrunedRevisionError:
        utc = since.replace("T", " ").replace("+00:00", " UTC")
        gone = f"is pruned since {utc}" if since else "was pruned or lost to damage"
        problem = f"the content of revision {number} {gone}; kept: {ranges(kept)}"
        return PrunedRevisionError(problem, path=self.where, hint="one of these, or an older copy of the file")

    def _unpacked(self, connection: Connection, record: Record) -> LivingMap:
        read: set[bytes] = set()

        def fetch(names: Iterable[bytes]) -> Mapping[bytes, bytes]:
            found = fetch_chunks(connection, names)
            read.update(found)
            return found

        living = content.unpack(record.content, fetch, lazily=True)
        self._remember(read)
        return living

    def _remember(self, names: Collection[bytes]) -> None:
        """Note chunks as checked; those of older revisions are forgotten, so that a long history takes no memory."""
        if len(self._checked) + len(names) > _MOST_CHECKED:
            self._checked = set()
        self._checked.update(names)

    def _cliques_of(self, connection: Connection, records: Sequence[Record], landmark_id: int) -> dict[int, int | None]:
        """The clique that a landmark belonged to in each of some revisions; None where it was not known."""
        names = [f"{content.MEMBERS}{name}" for name in ("landmark_id", "clique_id")]
        every = content.unpack_columns_of(
            {record.content for record in records}, names, partial(fetch_chunks, connection)
        )
        found: dict[int, int | None] = {}
        for record in records:
            landmarks, cliques = (every[record.content][name] for name in names)
            row = np.flatnonzero(landmarks == landmark_id)
            found[record.number] = int(cliques[row[0]]) if len(row) and row[0] < len(cliques) else None
        return found

    def _columns(self, connection: Connection, record: Record, *names: str) -> list[NDArray[Any]]:
        """Columns of the landmarks of a revision, without the rest of its map."""
        listed = [content.MEMBERS + name for name in names]
        found = content.unpack_columns(record.content, listed, partial(fetch_chunks, connection))
        return [found[name] for name in listed]

    @contextmanager
    def _transaction(self, *, writes: bool = False) -> Iterator[Connection]:
        """A transaction; failures of the database are errors of one line."""
        try:
            with self._engine.execution_options(writes=writes).connect() as connection, connection.begin():
                yield connection
        except (DamagedError, UnicodeDecodeError) as error:  # the latter even from the driver's own messages
            raise self._describe_damage(str(error)) from error
        except IntegrityError as error:
            raise StaleRevisionError(
                f"another process committed at the same time: {error.orig}", path=self.where, hint="run it again"
            ) from error
        except DBAPIError as error:
            message = str(error.orig)
            for part, problem, hint in _FAILURES:
                if part in message:
                    raise InputError(problem, path=self.where, hint=hint) from error
            if self._engine.dialect.name == "postgresql":  # that checks its own pages
                hint = "check the address, the rights of the user, and that the server runs"
                raise StoreUnavailableError(f"PostgreSQL: {message}", path=self.where, hint=hint) from error
            raise self._describe_damage(message) from error

    def _describe_damage(self, problem: str) -> InputError:
        """Return one line that names the intact revisions, and how to revert to them."""
        explained = self._explain(problem)
        if explained is not None:
            return explained
        if "is not a database" in problem:
            return InputError("is not an evermap map", path=self.where, hint="another file")
        return DamagedMapError(f"damaged: {problem}", path=self.where, hint="a copy of the file")


_FAILURES = (
    ("readonly", "cannot be written: it is read-only", "chmod u+w, or a copy of it"),
    ("locked", "another process keeps it locked", "wait for that one to end"),
    ("is full", "cannot be written: the disk is full", "free some space"),
    ("unable to open", "cannot be opened or written", "check the rights of the file and of its folder"),
)
"""Common failures of a database other than damage, with hints."""
