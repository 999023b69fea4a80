"""The tables of a map store, in the words of any SQL database. `docs/maps.md` says what is in them."""

from __future__ import annotations

import hashlib
import json

from sqlalchemy import Column, Integer, LargeBinary, MetaData, Table, Text

SCHEMA_VERSION = 3

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


def checksum(schema_version: int, created_at: str, evermap_version: str, head: int, record: bytes | None) -> bytes:
    """Of the row of `store`, which names the newest revision and so anchors the checksums of all of them."""
    values = [schema_version, created_at, evermap_version, head, None if record is None else record.hex()]
    return hashlib.sha256(json.dumps(values).encode()).digest()
