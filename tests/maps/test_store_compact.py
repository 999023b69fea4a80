"""Compacting makes a file smaller, and changes no answer."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from random_maps import assert_same, random_changes, random_evidence, random_map
from test_store_crash import die_at, killed

from evermap.errors import InputError
from evermap.maps.diff import diff, read_log, story_of
from evermap.maps.living import LivingMap
from evermap.maps.store import (
    DamagedMapError,
    MapStore,
    Provenance,
    PrunedRevisionError,
    RevisionKind,
    open_store,
    revert_store,
    schema,
    sqlite,
    verify_store,
)
from evermap.maps.store.anchor import read_anchor
from evermap.maps.store.chunk_table import fetch_chunks, list_packs
from evermap.maps.store.content import PLAIN, DamagedError, deflate, inflate
from evermap.maps.store.packs import make_pack, open_members, place_of
from evermap.maps.store.sql import SqlStore
from evermap.maps.why import why
from evermap.runs.sessions import enter_session
from evermap_studies.sim import BuildingConfig, simulate_building

SESSIONS = 9


def the_map(number: int) -> LivingMap:
    """What session `number` leaves: the same landmarks, each a little elsewhere, and some more stays."""
    living, random = random_map(3, cliques=14, stamp_s=1e4), np.random.default_rng(number)
    moved = living.places.position_m + 0.01 * random.normal(size=living.places.position_m.shape)
    covariance = np.asarray(living.covariance_m2).copy()
    covariance[:6, :6] *= 1.0 + 0.1 * number
    return replace(living, places=replace(living.places, position_m=moved), covariance_m2=covariance)


def commit(store: MapStore) -> None:
    head = store.head()
    living = the_map(head + 1)
    origin = Provenance(recording=f"session {head}", config="x = 1\n" * 40, stamp_from_s=100.0 * head)
    attached = {"recording": os.urandom(3000)}
    evidence = random_evidence(head, living)
    store.commit(living, origin, random_changes(head, living), evidence, parent=head, attachments=attached)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A map of sessions, an edit and a revert."""
    path = tmp_path / "m.evermap"
    with open_store(path, create=True) as store:
        for _ in range(SESSIONS):
            commit(store)
        living = store.load().edited(int(store.load().members.landmark_id[0]), pinned=True)
        store.commit(living, Provenance(kind=RevisionKind.EDIT, note="surveyed"), parent=SESSIONS)
        store.revert(5)
        commit(store)
    return path


def or_error(ask: Callable[[], Any]) -> Any:
    try:
        return ask()
    except PrunedRevisionError as error:
        return error.one_line()


def answers(where: Path) -> tuple[Any, ...]:
    """Whatever may be asked, of all revisions."""
    with open_store(where) as store:
        every = range(store.head() + 1)
        found: list[Any] = [store.log(), read_log(store), store.to_pandas().to_csv()]  # type: ignore[attr-defined]
        found += [store.lineage(number) for number in every]
        landmarks = store.members().landmark_id.tolist()
        for number in every:
            load, members = partial(store.load, number), partial(store.members, number)
            found += [
                or_error(load),
                or_error(members),
                store.changes(number),
                or_error(partial(story_of, store, number)),
            ]
            found += [or_error(partial(diff, store, number, other)) for other in every if (number + other) % 7 == 0]
            found += [or_error(partial(why, store, name, number)) for name in landmarks[:1] if number]
        for name in landmarks:
            found += [why(store, name), store.changes_of(name), store.evidence(landmark_id=name)]
        found += [(item, store.attached(item)) for item in store.attachments(every[1:])]
        return tuple(found)


def compact(path: Path) -> None:
    with open_store(path) as store:
        store.compact()


def members_of_packs(path: Path) -> int:
    with sqlite3.connect(path) as database:
        found = sum(place_of(data) is not None for (data,) in database.execute("SELECT data FROM chunk"))
    database.close()
    return found


def test_all_answers_are_as_before_in_fewer_bytes(path: Path, tmp_path: Path) -> None:
    before, size = answers(path), path.stat().st_size
    plain = tmp_path / "plain.evermap"
    with open_store(path) as store:
        assert isinstance(store, SqlStore)
        sqlite.snapshot(store, plain, SESSIONS + 3)
    compact(path)
    small = path.stat().st_size
    assert small < 0.85 * size
    assert members_of_packs(path) > 100
    assert_same(answers(path), before)
    checked = verify_store(path)
    assert checked.sound
    assert checked.intact == tuple(range(1, SESSIONS + 4))
    with open_store(path) as store:  # of equal maps the copies are equal
        assert isinstance(store, SqlStore)
        sqlite.snapshot(store, tmp_path / "again.evermap", SESSIONS + 3)
    assert (tmp_path / "again.evermap").read_bytes() == plain.read_bytes()
    compact(path)
    assert path.stat().st_size == small
    assert_same(answers(path), before)


def test_the_newest_revision_is_in_no_pack(path: Path) -> None:
    """It is read by every session. One that was reverted to comes out of its packs by the next call."""
    for _ in range(2):
        compact(path)
        with open_store(path) as store:
            assert isinstance(store, SqlStore)
            with store._transaction() as connection:
                (number, record), fetch = read_anchor(connection), partial(fetch_chunks, connection)
                newest = {record, *store._chain.record_of(connection, number).chunks(fetch)}
                packed = set().union(*list_packs(connection).values())
            assert packed
            assert not newest & packed
            store.revert(2)
        compact(path)


@pytest.mark.slow
def test_sessions_and_pruning_go_on(path: Path, tmp_path: Path) -> None:
    other = Path(shutil.copy(path, tmp_path / "other.evermap"))
    compact(path)
    for one in (path, other):
        with open_store(one) as store:
            store.revert(7)
            store.prune(4)
    size, pruned = path.stat().st_size, answers(path)
    assert verify_store(path).pruned == verify_store(other).pruned
    assert [item for item in pruned if isinstance(item, LivingMap)]
    compact(path)
    assert path.stat().st_size < size
    assert verify_store(path).sound
    assert_same(answers(path), pruned)
    with open_store(path) as store:
        for _ in range(12):
            commit(store)
        store.prune(1)  # whatever a pack holds is gone: so is the pack
    with open_store(path) as store:
        assert isinstance(store, SqlStore)
        with store._transaction() as connection:
            packs = list_packs(connection)
            listed = [row for row in store.rows() if len(row) == 2 and row[1].startswith(b"\xfd7zXZ")]
        assert {row[0] for row in listed} == packs.keys()


@pytest.mark.slow
def test_a_late_session_enters_as_before(tmp_path: Path) -> None:
    config = BuildingConfig(days=3, patrol_s=40.0, length_m=14.0, depth_m=13.0, rooms_per_side=1, change_rate=1.0)
    sessions = simulate_building(config, seed=1).sessions
    path, other = tmp_path / "site.evermap", tmp_path / "compact.evermap"
    with open_store(path, create=True) as store:
        for k in (0, 2):
            enter_session(store, sessions[k]).commit(store)
    shutil.copy(path, other)
    compact(other)
    assert members_of_packs(other)
    for where in (path, other):
        with open_store(where) as store:
            assert enter_session(store, sessions[1]).commit(store)
        compact(other)
    with open_store(path) as plain, open_store(other) as packed:
        for number in (1, 2, 3):
            assert_same(packed.load(number), plain.load(number))
            assert_same(story_of(packed, number), story_of(plain, number))
        for a in range(4):
            assert_same(diff(packed, a), diff(plain, a))
        for name in plain.members().landmark_id.tolist():
            assert_same(why(packed, name).visits, why(plain, name).visits)
        assert [item.digest for item in packed.attachments()] == [item.digest for item in plain.attachments()]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_killed_at_any_statement_it_leaves_the_map(path: Path) -> None:
    before, data = answers(path), path.read_bytes()

    def work(fatal: int) -> None:
        die_at(fatal)
        compact(path)

    fatal, smaller = 0, False
    while killed(partial(work, fatal)):
        assert verify_store(path).sound
        smaller = members_of_packs(path) > 0
        assert smaller or path.read_bytes() == data
        fatal += 7 if fatal > 20 else 1
    assert fatal > 50
    assert_same(answers(path), before)


def flip(path: Path, name: bytes) -> None:
    """Damage a row."""
    with sqlite3.connect(path) as database:
        (data,) = database.execute("SELECT data FROM chunk WHERE name = ?", [name]).fetchone()
        at = len(data) // 2
        changed = data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]
        database.execute("UPDATE chunk SET data = ? WHERE name = ?", [changed, name])
    database.close()


def pack_of(path: Path, column: str, number: int) -> bytes:
    """The pack that has a column of a revision."""
    with open_store(path) as store:
        assert isinstance(store, SqlStore)
        with store._transaction() as connection:
            record = store._chain.record_of(connection, number)
            name = record.parts(partial(fetch_chunks, connection))["content", column][0]
            return next(pack for pack, members in list_packs(connection).items() if name in members)


def test_damage_of_a_pack_is_found_and_what_is_intact_is_kept(path: Path) -> None:
    compact(path)
    flip(path, pack_of(path, "places.position_m", 2))
    with open_store(path) as store:
        store.load()
        with pytest.raises(DamagedMapError, match=f"revisions? .*{SESSIONS + 3} (is|are) intact"):
            store.load(2)
        with pytest.raises(DamagedMapError):
            store.compact()
    checked = verify_store(path)
    assert 2 in checked.damaged
    assert SESSIONS + 3 in checked.intact
    number, aside = revert_store(path, SESSIONS + 3)
    assert aside is not None
    assert verify_store(path).sound
    with open_store(path) as store:
        assert store.head() == number
        assert_same(store.load(), the_map(SESSIONS + 3))


def test_a_damaged_map_is_not_compacted(path: Path) -> None:
    with open_store(path) as store:
        assert isinstance(store, SqlStore)
        with store._transaction() as connection:
            record = store._chain.record_of(connection, 3)
            name = record.parts(partial(fetch_chunks, connection))["content", "places.position_m"][0]
    with sqlite3.connect(path) as database:  # it can be inflated, to other values
        (data,) = database.execute("SELECT data FROM chunk WHERE name = ?", [name]).fetchone()
        other = deflate(PLAIN + inflate(data)[::-1])
        database.execute("UPDATE chunk SET data = ? WHERE name = ?", [other, name])
    database.close()
    data = path.read_bytes()
    with pytest.raises(DamagedMapError), open_store(path) as store:
        store.compact()
    assert path.read_bytes() == data


def test_an_older_evermap_refuses_packs(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would take them for damage."""
    compact(path)
    monkeypatch.setattr(schema, "PACKED_VERSION", schema.SCHEMA_VERSION)
    with pytest.raises(InputError, match=r"a map of schema version 5.*open it with a newer"):
        open_store(path)


@pytest.mark.slow
def test_revisions_of_a_compact_map_go_into_another_one(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.evermap"
    with open_store(path) as store:
        assert isinstance(store, SqlStore)
        sqlite.snapshot(store, other, 6)
    before = answers(path)
    compact(path)
    with open_store(path) as store, open_store(other) as less:
        assert isinstance(store, SqlStore)
        assert isinstance(less, SqlStore)
        assert less.extend(store) == SESSIONS + 3
        assert all(row[1][:1] == b"\x78" for row in less.rows() if isinstance(row[0], bytes))  # as zlib begins
    assert members_of_packs(other) == 0
    assert_same(answers(other), before)
    assert verify_store(other).sound


def test_a_pack_that_gains_nothing_is_none() -> None:
    random = np.random.default_rng(1)
    rows = {bytes([k]) * 32: b"\x00" + random.bytes(100) for k in range(5)}
    assert all(data[0] == 0x78 for data in make_pack(rows).values())
    alike = {bytes([k]) * 32: b"\x00" + bytes(range(200)) for k in range(20)}
    packed = make_pack(alike)
    (pack,) = packed.keys() - alike.keys()
    assert sum(map(len, packed.values())) < 20 * 60
    members = {name: packed[name] for name in alike}
    assert open_members(dict(members), lambda _: packed[pack]) == alike
    with pytest.raises(DamagedError, match="of a pack"):
        open_members(dict(members), lambda _: next(iter(make_pack(dict(list(alike.items())[:9])).values())))
