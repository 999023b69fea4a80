"""From one schema to the next. A store is brought up to date when it is opened, in one transaction."""

from __future__ import annotations

import json
from collections.abc import Callable

from sqlalchemy import Connection, text, update

from evermap.maps.store import schema

Migration = Callable[[Connection], None]


def migrate(connection: Connection, version: int) -> None:
    """Bring the tables from `version` to `SCHEMA_VERSION`."""
    for step in MIGRATIONS[version - 1 :]:
        step(connection)
    connection.execute(update(schema.store).values(schema_version=schema.SCHEMA_VERSION))


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


MIGRATIONS: tuple[Migration, ...] = (_landmarks_of_changes,)
"""Number k leads from schema k + 1 to k + 2. Never changed once released: they speak SQL, not the tables of today."""
