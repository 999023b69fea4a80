"""The tables of a map store in portable SQL, and the migrations from one schema to the next.

`docs/map-store.md` says what is in the tables. A store is brought up to date when it is opened, in one transaction.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Callable
from typing import Any

from sqlalchemy import Column, Connection, Integer, LargeBinary, MetaData, Table, Text, text

from evermap.maps.store.content import DamagedError

SCHEMA_VERSION = 4
PACKED_VERSION = 5
"""Of a store with packs (`packs`), which an older evermap would take for damage; its tables are those of version 4."""

metadata = MetaData()

store = Table(
    "store",
    metadata,
    Column("schema_version", Integer, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("evermap_version", Text, nullable=False),
    Column("head", Integer, nullable=False),
    Column("record", LargeBinary),
    Column("checksum", LargeBinary, nullable=False),
    Column("pruned", Text),
)

revision = Table(
    "revision",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("record", LargeBinary),
)

chunk = Table(
    "chunk",
    metadata,
    Column("name", LargeBinary, primary_key=True),
    Column("data", LargeBinary, nullable=False),
)


def checksum(version: int, created_at: str, writer: str, head: int, record: bytes | None, *pruned: str | None) -> bytes:
    """Return the checksum of the row of `store`: it names the newest revision and anchors all checksums."""
    values = [version, created_at, writer, head, None if record is None else record.hex()]
    values += [text for text in pruned if text is not None]  # without pruned revisions as schema 3 had it
    return hashlib.sha256(json.dumps(values).encode()).digest()


def migrate(connection: Connection, version: int) -> None:
    """Bring the tables from `version` to `SCHEMA_VERSION`.

    Raises:
        DamagedError: they hold what no evermap wrote.
    """
    for step in MIGRATIONS[version - 1 :]:
        step(connection)
    row = connection.execute(text("SELECT created_at, evermap_version, head, record FROM store")).one()
    if not (isinstance(row[0], str) and isinstance(row[1], str)):
        raise DamagedError("the row of 'store' is not valid")
    connection.execute(
        text("UPDATE store SET schema_version = :version, checksum = :checksum"),
        {"version": SCHEMA_VERSION, "checksum": checksum(SCHEMA_VERSION, *row)},
    )


def _landmarks_of_changes(connection: Connection) -> None:
    """1 to 2: landmarks of a change in rows of their own, where they can be looked up, instead of one text."""
    connection.execute(text(
        "CREATE TABLE change_landmark (revision INTEGER NOT NULL, position INTEGER NOT NULL, rank INTEGER NOT NULL, "
        "landmark_id BIGINT NOT NULL, PRIMARY KEY (revision, position, rank), "
        "FOREIGN KEY (revision, position) REFERENCES change (revision, position))"
    ))  # fmt: skip
    connection.execute(text("CREATE INDEX changes_of_landmark ON change_landmark (landmark_id)"))
    rows = [
        {"revision": revision, "position": position, "rank": rank, "landmark_id": landmark}
        for revision, position, listed in connection.execute(
            text("SELECT revision, position, landmark_ids FROM change")
        )
        for rank, landmark in enumerate(json.loads(listed))
    ]
    if rows:
        connection.execute(text("INSERT INTO change_landmark VALUES (:revision, :position, :rank, :landmark_id)"), rows)
    connection.execute(text("ALTER TABLE change DROP COLUMN landmark_ids"))


def _records(connection: Connection) -> None:
    """2 to 3: what a revision is, tells and saw becomes chunks, named by their checksums and chained by records."""
    for statement in (
        "ALTER TABLE store ADD COLUMN head INTEGER NOT NULL DEFAULT 0",
        "ALTER TABLE store ADD COLUMN record BLOB",
        "ALTER TABLE store ADD COLUMN checksum BLOB NOT NULL DEFAULT x''",
        "ALTER TABLE revision RENAME TO old_revision",
        "CREATE TABLE revision (number INTEGER NOT NULL, record BLOB, PRIMARY KEY (number))",
    ):
        connection.execute(text(statement))
    parent: bytes | None = None
    head = 0
    for row in connection.execute(text("SELECT * FROM old_revision ORDER BY number")).mappings().all():
        number = row["number"]
        if number != head + 1 or not isinstance(row["content"], bytes) or not isinstance(row["config"], bytes):
            raise DamagedError(f"revision {head + 1} is missing or is not valid")
        ever = _single_values(connection, row["content"])
        record = {
            "evermap": "revision",
            "format": 1,
            **{name: value for name, value in row.items() if name not in ("content", "config")},
            "parent_record": None if parent is None else parent.hex(),
            "content": row["content"].hex(),
            "config": row["config"].hex(),
            "evidence": _evidence_index(connection, number),
            "changes": _changes(connection, number),
            "attachments": {},
            "n_cliques_ever": ever[0],
            "n_sites_ever": ever[1],
            "lost": {},
        }
        parent = _put(connection, _json(record))
        insert = text("INSERT INTO revision (number, record) VALUES (:number, :record)")
        connection.execute(insert, {"number": number, "record": parent})
        head = number
    connection.execute(text("UPDATE store SET head = :head, record = :record"), {"head": head, "record": parent})
    for table in ("change_landmark", "change", "evidence", "old_revision"):
        connection.execute(text(f"DROP TABLE {table}"))


def _list_pruned(connection: Connection) -> None:
    """3 to 4: which revisions are pruned; the row of `store` is sealed anew, so it must be what was written."""
    columns = "schema_version, created_at, evermap_version, head, record, checksum"
    for *values, sealed in connection.execute(text(f"SELECT {columns} FROM store")).all():  # noqa: S608  (ours)
        if values[0] == 3 and sealed != checksum(*values):
            raise DamagedError("a checksum does not match: of the row that names the newest revision")
    connection.execute(text("ALTER TABLE store ADD COLUMN pruned TEXT"))


def _changes(connection: Connection, number: int) -> list[Any]:
    """Return the changes of a revision of schema 2, as lists."""
    named: dict[int, list[int]] = {}
    listed = text("SELECT position, landmark_id FROM change_landmark WHERE revision = :number ORDER BY position, rank")
    for position, landmark in connection.execute(listed, {"number": number}):
        named.setdefault(position, []).append(landmark)
    columns = "kind, stamp_from_s, stamp_to_s, dx_m, dy_m, rotation_rad, probability, n_hits, n_misses"
    sql = f"SELECT position, {columns} FROM change WHERE revision = :number ORDER BY position"  # noqa: S608  (ours)
    told = text(sql)
    rows = connection.execute(told, {"number": number})
    return [[kind, named.get(position, []), *numbers] for position, kind, *numbers in rows]


def _evidence_index(connection: Connection, number: int) -> str | None:
    """Looks of schema 2 as chunks, and the name of their index."""
    listed = []
    rows = text("SELECT clique_id, first_s, last_s, looks FROM evidence WHERE revision = :number ORDER BY clique_id")
    for clique, first_s, last_s, looks in connection.execute(rows, {"number": number}).all():
        try:
            raw = zlib.decompress(looks)
        except (zlib.error, TypeError) as error:
            raise DamagedError(f"what revision {number} saw cannot be unpacked: {error}") from None
        listed.append([clique, first_s, last_s, _put(connection, raw).hex()])
    return _put(connection, _json(listed)).hex() if listed else None


def _single_values(connection: Connection, name: bytes) -> tuple[int, int]:
    """The next free ids in a manifest; 0 where it cannot be read, which reading it will tell."""
    data = connection.execute(text("SELECT data FROM chunk WHERE name = :name"), {"name": name}).scalar()
    try:
        values = json.loads(zlib.decompress(data or b""))["values"]
        return int(values["n_cliques_ever"]), int(values["n_sites_ever"])
    except (zlib.error, ValueError, TypeError, KeyError, RecursionError):
        return 0, 0


def _json(value: Any) -> bytes:
    try:
        return json.dumps(value).encode()
    except (TypeError, ValueError) as error:
        raise DamagedError(f"a row is not valid: {error}") from None


def _put(connection: Connection, raw: bytes) -> bytes:
    """Store bytes as a chunk; its name."""
    name = hashlib.sha256(b"|u1" + raw).digest()
    fresh = (
        "INSERT INTO chunk (name, data) SELECT :name, :data WHERE NOT EXISTS (SELECT 1 FROM chunk WHERE name = :name)"
    )
    connection.execute(text(fresh), {"name": name, "data": zlib.compress(raw, level=1)})
    return name


MIGRATIONS: tuple[Callable[[Connection], None], ...] = (_landmarks_of_changes, _records, _list_pruned)
"""Number k leads from schema k + 1 to k + 2. Never changed once released: they speak SQL, not the tables of today."""
