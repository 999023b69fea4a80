"""A map store in an SQL database, whichever it is."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from datetime import UTC, datetime
from typing import Any, Self

import numpy as np
from sqlalchemy import Connection, Engine, and_, exists, func, insert, inspect, select
from sqlalchemy.exc import DBAPIError, IntegrityError

from evermap import __version__
from evermap.errors import InputError
from evermap.maps.living import Evidence, LivingMap
from evermap.maps.store import content, queries, schema
from evermap.maps.store.content import DamagedError
from evermap.maps.store.history import change_to_row, lineage, revision_from_row
from evermap.maps.store.looks import looks_from_bytes, looks_to_bytes
from evermap.maps.store.migrations import migrate
from evermap.maps.store.protocol import Provenance, Revision, RevisionKind, StaleRevisionError
from evermap.types import MapChange


class SqlStore:
    """`MapStore` over an engine of SQLAlchemy, see there. Made by `opened`."""

    def __init__(self, engine: Engine, where: str) -> None:
        self._engine = engine
        self._where = where

    @classmethod
    def opened(cls, engine: Engine, where: str, *, create: bool) -> SqlStore:
        """The store behind an engine; its tables are made or brought up to date. Errors as `open_store`."""
        store = cls(engine, where)
        with store._reading() as connection:
            version = store._schema_version(connection)
        if version == 0 and not create:
            raise InputError("holds no map", path=where, hint="evermap slam INPUT --map FILE writes one")
        if version < schema.SCHEMA_VERSION:
            with store._writing() as connection:
                version = store._schema_version(connection)  # somebody may have been faster
                if version == 0:
                    schema.metadata.create_all(connection)
                    connection.execute(insert(schema.store).values(
                        schema_version=schema.SCHEMA_VERSION, created_at=_now(), evermap_version=__version__
                    ))  # fmt: skip
                elif version < schema.SCHEMA_VERSION:
                    migrate(connection, version)
        return store

    @property
    def where(self) -> str:
        """Path or address."""
        return self._where

    def close(self) -> None:
        """Let go of all connections."""
        self._engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def head(self) -> int:
        """The newest revision."""
        with self._reading() as connection:
            return queries.head(connection)

    def log(self) -> tuple[Revision, ...]:
        """All revisions."""
        with self._reading() as connection:
            rows = connection.execute(select(schema.revision).order_by(schema.revision.c.number)).mappings().all()
            stored = queries.fetched(connection, {row["config"] for row in rows})
            configs = {name: content.read_text(name, data) for name, data in stored.items()}
            counts: dict[int, dict[str, int]] = {}
            by = schema.change.c.revision, schema.change.c.kind
            for number, kind, count in connection.execute(select(*by, func.count()).group_by(*by)):
                counts.setdefault(number, {})[kind] = count
            return tuple(
                revision_from_row(dict(row), configs[row["config"]], counts.get(row["number"], {})) for row in rows
            )

    def lineage(self, revision: int | None = None) -> tuple[int, ...]:
        """The revisions that are in one."""
        with self._reading() as connection:
            return self._lineage(connection, revision)

    def load(self, revision: int | None = None) -> LivingMap:
        """The map as it was committed."""
        with self._reading() as connection:
            number = self._known(connection, revision)
            if number == 0:
                return LivingMap()
            name = queries.content_of(connection, number)
            return content.unpack(name, lambda names: queries.fetched(connection, names))

    def commit(
        self,
        living: LivingMap,
        provenance: Provenance,
        changes: Sequence[MapChange] = (),
        evidence: Evidence | None = None,
        *,
        parent: int,
    ) -> int:
        """A new revision."""
        return self._commit(living, provenance, changes, evidence, parent=parent, restores=None)

    def revert(self, revision: int, provenance: Provenance | None = None) -> int:
        """A new revision with the content of an older one."""
        head = self.head()
        newest, old = self.load(head), self.load(revision)
        if revision == head:
            raise InputError(f"revision {revision} is the newest already", path=self._where, hint="an older one")
        restored = replace(
            old,
            n_cliques_ever=max(old.n_cliques_ever, newest.n_cliques_ever),
            n_sites_ever=max(old.n_sites_ever, newest.n_sites_ever),
        )
        origin = Provenance() if provenance is None else provenance
        origin = replace(origin, kind=RevisionKind.REVERT, note=origin.note or f"back to revision {revision}")
        return self._commit(restored, origin, (), None, parent=head, restores=revision)

    def changes(self, revision: int | None = None) -> tuple[MapChange, ...]:
        """Changes of one revision."""
        with self._reading() as connection:
            number = self._known(connection, revision)
            found = queries.changes_where(connection, schema.change.c.revision == number)
        return tuple(change for _, change in found)

    def changes_of(self, landmark_id: int) -> tuple[tuple[int, MapChange], ...]:
        """Changes of a landmark."""
        change, named = schema.change, schema.change_landmark.alias()
        mine = and_(
            named.c.revision == change.c.revision,
            named.c.position == change.c.position,
            named.c.landmark_id == landmark_id,
        )
        with self._reading() as connection:
            return tuple(queries.changes_where(connection, exists().where(mine)))

    def evidence(
        self,
        *,
        clique_id: int | None = None,
        landmark_id: int | None = None,
        since_s: float = -np.inf,
        revisions: Collection[int] | None = None,
    ) -> Evidence:
        """What sessions saw."""
        table = schema.evidence
        with self._reading() as connection:
            numbers = self._lineage(connection, None) if revisions is None else revisions
            wanted = select(table).where(table.c.last_s >= since_s).order_by(table.c.revision, table.c.first_s)
            wanted = wanted.where(table.c.revision.in_(list(numbers)))
            if clique_id is not None:
                wanted = wanted.where(table.c.clique_id == clique_id)
            cliques = None if landmark_id is None else queries.cliques_of(connection, landmark_id, numbers)
            kept = [Evidence.empty()]
            for row in connection.execute(wanted).mappings():
                mine = cliques is None or cliques.get(row["revision"]) == row["clique_id"]
                if mine:
                    kept.append(looks_from_bytes(row["clique_id"], row["looks"]))
        found = Evidence(*(np.concatenate([getattr(part, item.name) for part in kept]) for item in fields(Evidence)))
        found = found[found.stamp_s >= since_s]
        return found[np.argsort(found.stamp_s, kind="stable")]

    def _commit(
        self,
        living: LivingMap,
        provenance: Provenance,
        changes: Sequence[MapChange],
        evidence: Evidence | None,
        *,
        parent: int,
        restores: int | None,
    ) -> int:
        """Whole or not at all; what takes time is done before the store is locked."""
        name, chunks = content.pack(living)
        config = content.text_chunk(provenance.config)
        chunks[config.name] = config
        number = parent + 1
        row = {
            "number": number,
            "parent": parent,
            "restores": restores,
            "created_at": _now(),
            "evermap_version": __version__,
            "kind": provenance.kind.value,
            "recording": provenance.recording,
            "source": provenance.source,
            "command": provenance.command,
            "config": config.name,
            "seed": provenance.seed,
            "stamp_from_s": _no_nan(provenance.stamp_from_s),
            "stamp_to_s": _no_nan(provenance.stamp_to_s),
            "wall_s": _no_nan(provenance.wall_s),
            "note": provenance.note,
            "n_landmarks": len(living.members),
            "n_existing": int(np.sum((living.p_exists() >= 0.5) & ~living.members.deleted)),
            "content": name,
        }
        change_rows = [change_to_row(number, position, change) for position, change in enumerate(changes)]
        named_rows = [
            {"revision": number, "position": position, "rank": rank, "landmark_id": int(landmark)}
            for position, change in enumerate(changes)
            for rank, landmark in enumerate(change.landmark_ids)
        ]
        evidence_rows = [] if evidence is None else list(_evidence_rows(number, evidence))
        with self._writing() as connection:
            head = queries.head(connection)
            if head != parent:
                raise self._stale(parent, head)
            new = chunks.keys() - queries.present(connection, chunks)
            rows: list[dict[str, Any]] = [{"name": key, "data": chunks[key].stored()} for key in sorted(new)]
            for table, content_rows in (
                (schema.chunk, rows),
                (schema.revision, [row]),
                (schema.change, change_rows),
                (schema.change_landmark, named_rows),
                (schema.evidence, evidence_rows),
            ):
                if content_rows:
                    connection.execute(insert(table), content_rows)
        return number

    def _stale(self, parent: int, head: int) -> StaleRevisionError:
        problem = f"revision {head} came in after revision {parent} was read; nothing was written"
        return StaleRevisionError(problem, path=self._where, hint="the same again, which continues from the newest")

    def _schema_version(self, connection: Connection) -> int:
        """0 where there are no tables at all.

        Raises:
            InputError: tables of something else, or of a newer evermap.
        """
        tables = inspect(connection).get_table_names()
        if not tables:
            return 0
        if "store" not in tables or "revision" not in tables:
            raise InputError("is a database, but no evermap map", path=self._where, hint="another file")
        version = connection.execute(select(schema.store.c.schema_version)).scalar()
        if not isinstance(version, int) or version < 1:
            raise DamagedError(f"its schema version is {version!r}")
        if version > schema.SCHEMA_VERSION:
            problem = (
                f"a map of schema version {version}; this evermap, {__version__}, knows up to {schema.SCHEMA_VERSION}"
            )
            raise InputError(problem, path=self._where, hint="a newer evermap: pip install --upgrade evermap")
        return version

    def _known(self, connection: Connection, revision: int | None) -> int:
        """The number of a revision that exists."""
        head = queries.head(connection)
        number = head if revision is None else revision
        if not 0 <= number <= head:
            there = f"it has {head} of them" if head else "it has none yet"
            raise InputError(f"no revision {number}; {there}", path=self._where, hint=f"evermap map log {self._where}")
        return number

    def _lineage(self, connection: Connection, revision: int | None) -> tuple[int, ...]:
        number = self._known(connection, revision)
        table = schema.revision.c
        rows = connection.execute(select(table.number, table.parent, table.restores)).all()
        return lineage({row.number: row.parent if row.restores is None else row.restores for row in rows}, number)

    @contextmanager
    def _reading(self) -> Iterator[Connection]:
        with self._plainly(), self._engine.connect() as connection, connection.begin():
            yield connection

    @contextmanager
    def _writing(self) -> Iterator[Connection]:
        with self._plainly(), self._engine.execution_options(writes=True).connect() as connection, connection.begin():
            yield connection

    @contextmanager
    def _plainly(self) -> Iterator[None]:
        """What went wrong in the database, in one line."""
        try:
            yield
        except (DamagedError, UnicodeDecodeError) as error:  # the latter even from the driver's own messages
            hint = "evermap map log, then load an older --revision, or a copy of the file"
            raise InputError(f"damaged: {error}", path=self._where, hint=hint) from error
        except IntegrityError as error:
            raise StaleRevisionError(
                f"somebody else committed at the same time: {error.orig}", path=self._where, hint="the same again"
            ) from error
        except DBAPIError as error:
            raise _in_words(str(error.orig), self._where) from error


def _in_words(message: str, where: str) -> InputError:
    """The common failures of a database with what to do about them."""
    for part, problem, hint in (
        ("readonly", "cannot be written: it is read-only", "chmod u+w, or a copy of it"),
        ("locked", "another process keeps it locked", "wait for that one to end"),
        ("is not a database", "is no evermap map", "another file"),
        ("malformed", f"damaged: {message}", "a copy of the file"),
        ("full", "cannot be written: the disk is full", "make room"),
        ("unable to open", "cannot be opened or written", "check the rights of the file and of its folder"),
    ):
        if part in message:
            return InputError(problem, path=where, hint=hint)
    return InputError(f"damaged or not reachable: {message}", path=where, hint="a copy of the file")


def _evidence_rows(number: int, evidence: Evidence) -> Iterator[dict[str, Any]]:
    """A row for each clique."""
    for clique in np.unique(evidence.clique_id):
        mine = evidence[evidence.clique_id == clique]
        yield {
            "revision": number,
            "clique_id": int(clique),
            "first_s": float(mine.stamp_s.min()),
            "last_s": float(mine.stamp_s.max()),
            "looks": looks_to_bytes(mine),
        }


def _no_nan(value: float) -> float | None:
    """Databases differ in what they do with nan; they agree about nothing."""
    return None if math.isnan(value) else float(value)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
