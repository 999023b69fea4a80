"""Pruning deletes what only old revisions hold, and nothing else."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from pathlib import Path

import pytest
from random_maps import assert_same, random_changes, random_evidence, random_map

from evermap.errors import ConfigError, EvermapError, InputError
from evermap.maps.living import LivingMap
from evermap.maps.store import (
    DamagedMapError,
    MapStore,
    Provenance,
    PrunedRevisionError,
    RevisionKind,
    open_store,
    revert_store,
    verify_store,
)
from evermap.maps.store.sql import SqlStore
from evermap.maps.store.sqlite import snapshot
from evermap.maps.why import why

COUNT = 8


def the_map(number: int) -> LivingMap:
    """What revision `number` holds in these tests: all landmarks of all of them are other ones."""
    return random_map(number, cliques=12, stamp_s=1000.0 * number)


def commit(store: MapStore, number: int) -> None:
    living = the_map(number)
    changes, evidence = random_changes(number, living), random_evidence(number, living)
    origin = Provenance(recording=f"session {number}", config=f"x = {number}", stamp_from_s=900.0 * number)
    attached = {"session": bytes([number]) * 100}
    store.commit(living, origin, changes, evidence, parent=number - 1, attachments=attached)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "m.evermap"
    with open_store(path, create=True) as store:
        for number in range(1, COUNT + 1):
            commit(store, number)
    return path


def history(store: MapStore, revisions: int = COUNT) -> tuple[object, ...]:
    """All that a store tells of its revisions without loading them."""
    told: list[object] = [store.log()[:revisions], store.lineage()[:revisions]]
    for number in range(1, revisions + 1):
        landmark = int(the_map(number).members.landmark_id[0])
        told += [store.changes(number), store.changes_of(landmark), store.members(number)]
        told += [store.evidence(revisions=[number]), store.evidence(landmark_id=landmark, revisions=[number])]
    return (*told, *(store.attached(item) for item in store.attachments(range(1, revisions + 1))))


def stored(path: Path) -> tuple[int, int]:
    """Pieces in the file, and their bytes."""
    with sqlite3.connect(path) as database:
        found = database.execute("SELECT count(*), sum(length(data)) FROM chunk").fetchone()
    database.close()
    return found  # type: ignore[no-any-return]


def kept(path: Path) -> list[int]:
    """Revisions that can be loaded, each as it was written; the others say that they are pruned."""
    found = []
    with open_store(path) as store:
        for number in range(1, store.head() + 1):
            try:
                living = store.load(number)
            except PrunedRevisionError:
                continue
            assert_same(living, the_map(number))
            found.append(number)
    return found


def test_the_newest_stay_whole_and_the_history_of_all_stays(path: Path) -> None:
    size, (parts, n_bytes) = path.stat().st_size, stored(path)
    with open_store(path) as store:
        before = history(store)
        landmark = int(the_map(COUNT).members.landmark_id[0])
        answer = why(store, landmark)
        plan = store.prune(3, dry_run=True)
        assert kept(path) == list(range(1, COUNT + 1))
        found = store.prune(3)
        assert found == plan
        assert (found.revisions, found.kept) == ((1, 2, 3, 4, 5), (6, 7, 8))
        assert_same(history(store), before)
        assert_same(why(store, landmark), answer)
    assert kept(path) == [6, 7, 8]
    assert stored(path) == (parts - found.n_chunks, n_bytes - found.n_bytes)
    assert found.n_bytes > 0.4 * sum(the_map(number).covariance_m2.nbytes for number in found.revisions)  # symmetric
    assert size - path.stat().st_size == pytest.approx(found.n_bytes, rel=0.3)
    checked = verify_store(path)
    assert checked.sound
    assert (checked.intact, checked.pruned, checked.head) == ((6, 7, 8), (1, 2, 3, 4, 5), 8)
    with sqlite3.connect(path) as database:
        assert database.execute("PRAGMA freelist_count").fetchone() == (0,)
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    database.close()


def test_what_is_shared_with_a_kept_revision_stays(tmp_path: Path) -> None:
    """An edit shares nearly everything with the session before it."""
    path = tmp_path / "m.evermap"
    with open_store(path, create=True) as store:
        commit(store, 1)
        living = store.load().edited(int(the_map(1).members.landmark_id[0]), pinned=True)
        store.commit(living, Provenance(kind=RevisionKind.EDIT), parent=1)
        found = store.prune(1)
        assert found.revisions == (1,)
        assert found.n_chunks == 0  # the columns that the edit changed say what an operator said
        assert_same(store.load(), living)
        landmark = int(living.members.landmark_id[0])
        assert [(number, word) for number, _, word in why(store, landmark).edits] == [(2, "pinned")]
    assert verify_store(path).sound


@pytest.mark.parametrize("again", [3, 2, 8])
def test_pruning_again_and_in_between(path: Path, again: int) -> None:
    with open_store(path) as store:
        store.prune(3)
        commit(store, 9)
        before = history(store, 9)
        found = store.prune(again)
        assert found.kept == tuple(range(10 - min(again, 4), 10))
        assert set(found.revisions) == {6, 7, 8, 9} - set(found.kept)
        assert_same(history(store, 9), before)
    assert kept(path) == list(found.kept)
    assert verify_store(path).sound


def test_a_pruned_revision_is_one_line(path: Path) -> None:
    with open_store(path) as store:
        store.prune(3)
        line = (
            r"the content of revision 2 is pruned since \d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC; kept: 6 to 8 \(try: one of"
        )
        for use in (lambda: store.load(2), lambda: store.revert(2), lambda: revert_store(path, 2)):
            with pytest.raises(PrunedRevisionError, match=line) as caught:
                use()
            assert "\n" not in caught.value.one_line()
        with pytest.raises(InputError, match="no revision 9"):
            store.load(9)
        assert_same(store.load(0), LivingMap())
        assert store.head() == COUNT
        with pytest.raises(ConfigError, match="0 is less than 1"):
            store.prune(0)


def test_after_a_revert_its_lineage_stays_too(path: Path) -> None:
    """Late sessions start from revisions that the newest one was made from."""
    with open_store(path) as store:
        store.revert(3)
        assert store.lineage() == (1, 2, 3, 9)
        found = store.prune(2)
        assert (found.kept, found.revisions) == ((3, 8, 9), (1, 2, 4, 5, 6, 7))
        assert_same(store.load(3), the_map(3))
        assert store.revert(8) == 10
        assert store.load().places.position_m.tobytes() == the_map(8).places.position_m.tobytes()


def test_the_map_goes_on_as_if_nothing_was_pruned(path: Path, tmp_path: Path) -> None:
    whole = tmp_path / "whole.evermap"
    whole.write_bytes(path.read_bytes())
    with open_store(path) as store, open_store(whole) as other:
        store.prune(1)
        commit(store, 9)
        commit(other, 9)
        assert_same(history(store), history(other))
        assert_same(store.load(), other.load())
        assert [item.n_grown for item in store.log()] == [item.n_grown for item in other.log()]
        assert_same(store.evidence(), other.evidence())


def test_from_a_damaged_map_nothing_is_deleted(path: Path) -> None:
    with open_store(path) as store, store._transaction() as connection:  # type: ignore[attr-defined]
        content = store._chain.record_of(connection, 7).content  # type: ignore[attr-defined]
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM chunk WHERE name = ?", (content,))
    database.close()
    data = path.read_bytes()
    with open_store(path) as store:
        for keep in (1, 3):  # in what goes, and in what stays
            with pytest.raises(DamagedMapError, match=r"intact \(try: evermap map revert .* 8\)"):
                store.prune(keep)
    assert path.read_bytes() == data


def the_row_is_damaged(database: sqlite3.Connection) -> None:
    database.execute("UPDATE store SET pruned = NULL")


def a_pruned_record_is_damaged(database: sqlite3.Connection) -> None:
    database.execute("UPDATE chunk SET data = zeroblob(9) WHERE name = (SELECT record FROM revision WHERE number = 2)")


@pytest.mark.parametrize(("change", "lost"), [(the_row_is_damaged, ()), (a_pruned_record_is_damaged, (2,))])
def test_a_damaged_file_keeps_the_history_of_what_was_pruned(path: Path, change: object, lost: tuple[int, ...]) -> None:
    with open_store(path) as store:
        store.prune(3)
        log = store.log()
    with sqlite3.connect(path) as database:
        change(database)  # type: ignore[operator]
    database.close()
    found = verify_store(path)
    assert not found.sound
    assert found.intact == (6, 7, 8)
    assert found.pruned == tuple(number for number in (1, 2, 3, 4, 5) if number not in lost)
    with pytest.raises(DamagedMapError, match="revision 1: its content is pruned; revisions 6 to 8 are intact"):
        revert_store(path, 1)
    number, _ = revert_store(path, 7)
    assert number == 9
    again = verify_store(path)
    assert again.sound
    assert (again.intact, again.pruned, again.lost) == ((6, 7, 8, 9), found.pruned, lost)
    with open_store(path) as store:
        assert store.log()[:-1] == tuple(item for item in log if item.number not in lost)
        assert len(store.evidence(revisions=[1])) == len(random_evidence(1, the_map(1)))
        with pytest.raises(PrunedRevisionError, match=r"revision 1 (is pruned since|was pruned or lost)"):
            store.load(1)


def to_schema_3(path: Path) -> None:
    """The same as schema 3 had it; the checksum as docs say it: of the values of the row as JSON."""
    with sqlite3.connect(path) as database:
        database.execute("ALTER TABLE store DROP COLUMN pruned")
        created, writer, head, record = database.execute(
            "SELECT created_at, evermap_version, head, record FROM store"
        ).fetchone()
        sealed = hashlib.sha256(json.dumps([3, created, writer, head, record.hex()]).encode()).digest()
        database.execute("UPDATE store SET schema_version = 3, checksum = ?", (sealed,))
    database.close()


def test_a_map_of_schema_3_is_brought_up_to_date(path: Path) -> None:
    to_schema_3(path)
    with open_store(path) as store:
        assert_same(store.load(1), the_map(1))
        store.prune(2)
    assert kept(path) == [7, 8]


def test_a_damaged_row_of_schema_3_is_not_sealed_anew(path: Path) -> None:
    to_schema_3(path)
    with sqlite3.connect(path) as database:
        database.execute("UPDATE store SET record = (SELECT record FROM revision WHERE number = 7), head = 7")
    database.close()
    with pytest.raises(DamagedMapError, match="a checksum does not match"):
        open_store(path)
    assert verify_store(path).intact == tuple(range(1, 9))


@pytest.mark.parametrize("version", [3, 5, 6])
def test_a_schema_that_is_called_another_is_found(path: Path, version: int) -> None:
    with sqlite3.connect(path) as database:
        database.execute("UPDATE store SET schema_version = ?", (version,))
    database.close()
    with pytest.raises(EvermapError, match=r"its tables are of another|knows up to 5|of the row that names"):
        open_store(path).log()


def test_a_snapshot_is_the_map_up_to_its_revision_and_refused_where_there_is_none(path: Path, tmp_path: Path) -> None:
    with open_store(path) as store:
        assert isinstance(store, SqlStore)
        store.prune(4)
        copy = tmp_path / "copy.evermap"
        snapshot(store, copy, 6)
        for missing in (4, COUNT + 1):
            with pytest.raises(InputError, match=f"no revision {missing} with its content"):
                snapshot(store, tmp_path / "none.evermap", missing)
        assert not (tmp_path / "none.evermap").exists()
        wanted = history(store, 6)
    assert kept(copy) == [5, 6]
    with open_store(copy) as store:
        assert store.head() == 6
        assert repr(history(store, 6)) == repr(wanted)
