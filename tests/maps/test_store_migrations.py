"""Stores of an older schema become ones of today, whole or not at all; ones of tomorrow are left alone."""

from __future__ import annotations

import hashlib
import json
import re
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_maps import assert_same, random_changes, random_evidence, random_map
from sqlalchemy import create_engine, inspect

from evermap.errors import InputError
from evermap.maps.living import LivingMap
from evermap.maps.store import Provenance, open_store, schema
from evermap.maps.store import schema as migrations

# as a database told of itself when schema 1 was that of the day
CHANGE_OF_SCHEMA_1 = """
CREATE TABLE change (
    revision INTEGER NOT NULL, position INTEGER NOT NULL, kind TEXT NOT NULL, landmark_ids TEXT NOT NULL,
    stamp_from_s DOUBLE, stamp_to_s DOUBLE, dx_m DOUBLE, dy_m DOUBLE, rotation_rad DOUBLE, probability DOUBLE,
    n_hits INTEGER NOT NULL, n_misses INTEGER NOT NULL,
    PRIMARY KEY (revision, position), FOREIGN KEY(revision) REFERENCES revision (number)
)"""


def write(path: Path, revisions: int = 3) -> None:
    with open_store(path, create=True) as store:
        for seed in range(revisions):
            living = random_map(seed)
            store.commit(living, Provenance(), random_changes(seed, living), random_evidence(seed, living), parent=seed)


def copy_of_schema_2(path: Path) -> None:
    """The store that evermap wrote when schema 2 was that of the day: three sessions, then back to the first one."""
    path.write_bytes((Path(__file__).parent / "data" / "schema_2.evermap").read_bytes())


def make_schema_1(path: Path) -> None:
    """The same as schema 1 had it."""
    copy_of_schema_2(path)
    with sqlite3.connect(path) as database:
        rows = database.execute("SELECT * FROM change ORDER BY revision, position").fetchall()
        named: dict[tuple[int, int], list[int]] = {}
        for revision, position, landmark in database.execute(
            "SELECT revision, position, landmark_id FROM change_landmark ORDER BY rank"
        ):
            named.setdefault((revision, position), []).append(landmark)
        database.execute("DROP TABLE change_landmark")
        database.execute("DROP TABLE change")
        database.execute(CHANGE_OF_SCHEMA_1)
        database.executemany(
            f"INSERT INTO change VALUES ({', '.join('?' * 12)})",
            [(*row[:3], json.dumps(named[row[:2]]), *row[3:]) for row in rows],
        )
        database.execute("UPDATE store SET schema_version = 1")
    database.close()


WRITTEN = ("67faf724b60acced", "b5d2a52cd37fca8e", "e8e8f19deaf1ff65")
"""SHA-256 of the covariances of the old store, of which each bit is kept; another processor makes other last bits."""


def assert_written_elsewhere(loaded: LivingMap, seed: int) -> None:
    """As it was written, by bits, and what would be written here, to rounding in the product that is its covariance."""
    made = random_map(seed, cliques=3, format_1=True)
    assert hashlib.sha256(loaded.covariance_m2.tobytes()).hexdigest()[:16] == WRITTEN[seed]
    np.testing.assert_allclose(loaded.covariance_m2, made.covariance_m2, rtol=1e-12, atol=1e-16)
    assert_same(replace(loaded, covariance_m2=made.covariance_m2), made)


def tables(path: Path) -> object:
    """Columns, keys and indices of every table."""
    look = inspect(create_engine(f"sqlite:///{path}"))
    return {
        name: (
            [(c["name"], str(c["type"]), c["nullable"]) for c in look.get_columns(name)],
            look.get_pk_constraint(name)["constrained_columns"],
            [(k["constrained_columns"], k["referred_table"]) for k in look.get_foreign_keys(name)],
            [(i["name"], i["column_names"]) for i in look.get_indexes(name)],
        )
        for name in sorted(look.get_table_names())
    }


@pytest.mark.parametrize("make", [make_schema_1, copy_of_schema_2])
def test_an_old_schema_becomes_that_of_today(tmp_path: Path, make: Callable[[Path], None]) -> None:
    today, old = tmp_path / "today.evermap", tmp_path / "old.evermap"
    write(today)
    make(old)
    assert tables(old) != tables(today)
    with open_store(old) as store:
        assert store.head() == 4
        seen = 0
        for seed in range(3):
            living = random_map(seed, cliques=3, format_1=True)
            assert_written_elsewhere(store.load(seed + 1), seed)
            for mine, theirs in zip(store.changes(seed + 1), random_changes(seed, living), strict=True):
                assert_same(mine, theirs)
            evidence = random_evidence(seed, living, looks=9)
            found = store.evidence(revisions=[seed + 1])
            order = np.argsort(evidence.stamp_s, kind="stable")
            for name in ("clique_id", "stamp_s", "n_hits", "n_misses"):
                assert_same(getattr(found, name), getattr(evidence[order], name))
            seen += len(found)
        assert seen == len(store.evidence(revisions=[1, 2, 3]))
        log = store.log()
        assert [item.provenance.recording for item in log] == ["session 0", "session 1", "session 2", ""]
        assert [item.provenance.config for item in log] == ["x = 1"] * 3 + [""]
        assert store.lineage() == (1, 4)
        living = random_map(9)
        store.commit(living, Provenance(), random_changes(9, living), parent=4)
    assert tables(old) == tables(today)


def test_a_migration_that_fails_leaves_the_old_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "m.evermap"
    make_schema_1(path)
    before = tables(path)

    def fail(connection: object) -> None:
        migrations.MIGRATIONS[0](connection)  # type: ignore[arg-type]
        raise RuntimeError("half way")

    with monkeypatch.context() as patch:
        patch.setattr(migrations, "migrate", None)
        patch.setattr("evermap.maps.store.sql.migrate", lambda connection, version: fail(connection))
        with pytest.raises(RuntimeError, match="half way"):
            open_store(path)
    assert tables(path) == before
    with open_store(path) as store:
        assert_written_elsewhere(store.load(3), 2)


def test_there_is_a_step_from_every_schema_to_the_next() -> None:
    assert len(migrations.MIGRATIONS) == schema.SCHEMA_VERSION - 1


def test_a_newer_schema_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "m.evermap"
    write(path, 1)
    with sqlite3.connect(path) as database:
        database.execute("UPDATE store SET schema_version = 99")
    database.close()
    content = path.read_bytes()
    with pytest.raises(InputError) as caught:
        open_store(path, create=True)
    line = caught.value.one_line()
    assert line.startswith(f"{path}: a map of schema version 99; this evermap, ")
    assert f"knows up to {schema.PACKED_VERSION}" in line
    assert "a newer evermap)" in line
    assert path.read_bytes() == content


def test_the_page_lists_every_table_and_column(repository: Path) -> None:
    page = (repository / "docs" / "map-store.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1:4] for line in page.splitlines() if line.startswith("| `") and line.count("|") == 4]
    shown = {name.strip(" `"): set(re.findall(r"`(\w+)`", columns)) for name, _, columns in rows}
    told_in_words = {"store": {"created_at", "evermap_version"}}
    assert shown.keys() == schema.metadata.tables.keys()
    for name, table in schema.metadata.tables.items():
        assert shown[name] | told_in_words.get(name, set()) == {column.name for column in table.columns}
