"""The tables of a map store, in the words of any SQL database. `docs/maps.md` says what is in them."""

from __future__ import annotations

from sqlalchemy import (
    BigInteger,
    Column,
    Double,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Table,
    Text,
)

SCHEMA_VERSION = 2

metadata = MetaData()

store = Table(
    "store",
    metadata,
    Column("schema_version", Integer, nullable=False),
    Column("created_at", Text, nullable=False),
    Column("evermap_version", Text, nullable=False),
)

chunk = Table(
    "chunk",
    metadata,
    Column("name", LargeBinary, primary_key=True),
    Column("data", LargeBinary, nullable=False),
)

revision = Table(
    "revision",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("parent", Integer, nullable=False),
    Column("restores", Integer),
    Column("created_at", Text, nullable=False),
    Column("evermap_version", Text, nullable=False),
    Column("kind", Text, nullable=False),
    Column("recording", Text, nullable=False),
    Column("source", Text, nullable=False),
    Column("command", Text, nullable=False),
    Column("config", LargeBinary, ForeignKey("chunk.name"), nullable=False),
    Column("seed", Integer),
    Column("stamp_from_s", Double),
    Column("stamp_to_s", Double),
    Column("wall_s", Double),
    Column("note", Text, nullable=False),
    Column("n_landmarks", Integer, nullable=False),
    Column("n_existing", Integer, nullable=False),
    Column("content", LargeBinary, ForeignKey("chunk.name"), nullable=False),
)

change = Table(
    "change",
    metadata,
    Column("revision", Integer, ForeignKey("revision.number"), primary_key=True),
    Column("position", Integer, primary_key=True),
    Column("kind", Text, nullable=False),
    Column("stamp_from_s", Double),
    Column("stamp_to_s", Double),
    Column("dx_m", Double),
    Column("dy_m", Double),
    Column("rotation_rad", Double),
    Column("probability", Double),
    Column("n_hits", Integer, nullable=False),
    Column("n_misses", Integer, nullable=False),
)

change_landmark = Table(
    "change_landmark",
    metadata,
    Column("revision", Integer, primary_key=True),
    Column("position", Integer, primary_key=True),
    Column("rank", Integer, primary_key=True),
    Column("landmark_id", BigInteger, nullable=False),
    ForeignKeyConstraint(["revision", "position"], ["change.revision", "change.position"]),
    Index("changes_of_landmark", "landmark_id"),
)

evidence = Table(
    "evidence",
    metadata,
    Column("revision", Integer, ForeignKey("revision.number"), primary_key=True),
    Column("clique_id", BigInteger, primary_key=True),
    Column("first_s", Double),
    Column("last_s", Double),
    Column("looks", LargeBinary, nullable=False),
    Index("evidence_of_clique", "clique_id", "revision"),
)
