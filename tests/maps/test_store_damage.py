"""Files that are no maps, are damaged, or may not be written: one line that says so and what to try."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_maps import assert_same, random_changes, random_evidence, random_map

from evermap.errors import EvermapError, InputError
from evermap.maps.store import DamagedMapError, Provenance, content, open_store, revert_store, sqlite, verify_store


@pytest.fixture
def path(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """A map with three revisions, in the plane; in space with the parameter 3."""
    path = tmp_path / "m.evermap"
    with open_store(path, create=True) as store:
        for seed in range(3):
            living = random_map(seed, dim=getattr(request, "param", 2))
            changes, evidence = random_changes(seed, living), random_evidence(seed, living)
            store.commit(living, Provenance(config="x = 1"), changes, evidence, parent=seed)
    return path


def use_all(path: Path) -> None:
    """Everything that reads. What it gives of maps is what was written."""
    with open_store(path) as store:
        for number in range(1, store.head() + 1):
            living = store.load(number)
            assert_same(living, random_map(number - 1, dim=living.dim))
            store.changes(number)
        store.log()
        store.lineage()
        store.evidence(landmark_id=1)
        store.evidence()


def said_of(path: Path) -> str:
    """The line with which reading ended; '' where it went well."""
    try:
        use_all(path)
    except EvermapError as error:
        return error.one_line()
    return ""


@pytest.mark.parametrize(
    ("path", "seed"), [*((2, k) for k in range(60)), *((3, k) for k in range(20))], indirect=["path"]
)
def test_flipped_bytes_give_the_truth_or_a_line(path: Path, seed: int) -> None:
    random = np.random.default_rng(seed)
    content = bytearray(path.read_bytes())
    for _ in range(int(random.integers(1, 20))):
        content[random.integers(len(content))] = random.integers(256)
    path.write_bytes(content)
    line = said_of(path)
    assert not line or (line.startswith(f"{path}: ") and "(try: " in line)


@pytest.mark.parametrize("path", [2, 3], indirect=True)
@pytest.mark.parametrize("share", [0.001, 0.03, 0.3, 0.7, 0.99])
def test_a_file_that_was_cut_off_is_damaged(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=r"damaged|is not an evermap map"):
        use_all(path)


def test_a_part_that_is_missing_is_found(path: Path) -> None:
    with open_store(path) as store, store._transaction() as connection:  # type: ignore[attr-defined]
        kept = store._chain.record_of(connection, 1).content  # type: ignore[attr-defined]
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM chunk WHERE name = ?", (kept,))
    database.close()
    with open_store(path) as store:
        assert_same(store.load(3), random_map(2))
        line = r"damaged: a part of the map is missing; revisions 2, 3 are intact \(try: evermap map revert .* 3\)"
        with pytest.raises(DamagedMapError, match=line) as caught:
            store.load(1)
        assert caught.value.intact == (2, 3)


def rows_are_changed(database: sqlite3.Connection) -> None:
    database.execute("UPDATE chunk SET data = zeroblob(9) WHERE name = (SELECT record FROM revision WHERE number = 2)")


def rows_are_swapped(database: sqlite3.Connection) -> None:
    database.execute("UPDATE revision SET record = (SELECT record FROM revision WHERE number = 1) WHERE number = 2")


def the_newest_is_taken_away(database: sqlite3.Connection) -> None:
    database.execute("DELETE FROM revision WHERE number = 3")


def the_newest_is_called_older(database: sqlite3.Connection) -> None:
    database.execute("UPDATE store SET head = 2")
    database.execute("DELETE FROM revision WHERE number = 3")


def the_schema_is_called_older(database: sqlite3.Connection) -> None:
    database.execute("UPDATE store SET schema_version = 2")


@pytest.mark.parametrize(
    ("change", "intact"),
    [
        (rows_are_changed, (1, 3)),
        (rows_are_swapped, (1, 2, 3)),
        (the_newest_is_taken_away, (1, 2, 3)),
        (the_newest_is_called_older, (1, 2, 3)),
        (the_schema_is_called_older, (1, 2, 3)),
    ],
)
def test_rows_that_nobody_wrote_are_found_and_undone(
    path: Path, change: Callable[[sqlite3.Connection], None], intact: tuple[int, ...]
) -> None:
    assert verify_store(path).sound
    with sqlite3.connect(path) as database:
        change(database)
    database.close()
    with pytest.raises(DamagedMapError) as caught:
        use_all(path)
    assert caught.value.intact == intact
    found = verify_store(path)
    assert not found.sound
    assert found.intact == intact
    assert verify_store(path).error(path).one_line().endswith(f"(try: evermap map revert {path} 3)")
    damaged = path.read_bytes()
    number, aside = revert_store(path, 1)
    assert number == 4
    assert aside == path.with_name("m.evermap.damaged")
    assert aside.read_bytes() == damaged
    again = verify_store(path)
    assert again.sound
    assert again.intact == (*intact, 4)
    with open_store(path) as store:
        old, new = random_map(0), random_map(2)
        # ids that were given in what is lost are not given again
        assert_same(
            store.load(),
            replace(
                old,
                n_cliques_ever=max(random_map(k).n_cliques_ever for k in range(3) if k + 1 in intact),
                n_sites_ever=max(random_map(k).n_sites_ever for k in range(3) if k + 1 in intact),
            ),
        )
        assert_same(store.load(3), new)
        assert [item.number for item in store.log()] == [*intact, 4]
        if 2 not in intact:
            with pytest.raises(InputError, match="revision 2 was lost to damage of the file"):
                store.load(2)
        assert store.commit(new, Provenance(), parent=4) == 5
    assert revert_store(path, 3) == (6, None)  # an ordinary one


@pytest.mark.parametrize("start", [0, 16, 4096, 8192])
def test_pages_that_are_overwritten(path: Path, start: int) -> None:
    """The header, the lists of tables and the first pages: what is in the others is saved without them."""
    data = bytearray(path.read_bytes())
    size = 84 if start == 16 else 4096
    data[start : start + size] = b"\xff" * size
    path.write_bytes(data)
    intact = verify_store(path).intact
    assert 3 in intact
    with pytest.raises(DamagedMapError, match=r"are intact \(try: evermap map revert"):
        use_all(path)
    assert revert_store(path, 3)[0] == 4
    assert verify_store(path).sound
    with open_store(path) as store:
        for number in intact:
            assert_same(store.load(number), random_map(number - 1))


def test_a_damaged_part_that_is_shared_is_written_anew(path: Path) -> None:
    """A commit that has a piece in common with a damaged revision does not rely on that."""
    living = random_map(2)
    with open_store(path) as store:
        store.commit(random_map(7), Provenance(), parent=3)
    shared = [name for name in content.pack(living)[1] if name not in content.pack(random_map(7))[1]]
    with sqlite3.connect(path) as database:
        database.executemany("UPDATE chunk SET data = zeroblob(99) WHERE name = ?", [(name,) for name in shared])
    database.close()
    with open_store(path) as store:
        with pytest.raises(DamagedMapError):
            store.load(3)
        number = store.commit(living, Provenance(), parent=4)
        assert_same(store.load(number), living)
        assert_same(store.load(3), living)  # and is whole again


@pytest.mark.parametrize("content", [b"not a database, but long enough to be one" * 50, b"PK\3\4", b"\0" * 5000, b"\n"])
def test_another_file_is_no_map(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "photo.jpg"
    path.write_bytes(content)
    for create in (False, True):
        with pytest.raises(InputError, match=r"photo.jpg: is not an evermap map \(try: another file\)"):
            open_store(path, create=create)
    assert path.read_bytes() == content


def test_another_database_is_no_map(tmp_path: Path) -> None:
    path = tmp_path / "phone.db"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE store (name TEXT)")
    database.close()
    with pytest.raises(InputError, match="is a database, but not an evermap map"):
        open_store(path, create=True)


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda p: None, r"no such map \(try: evermap map enter .*m\.evermap INPUT starts one\)"),
        (lambda p: p.mkdir(), r"is a folder; a map is one file \(try: .*m\.evermap"),
        (lambda p: p.touch(), r"contains no map \(try: evermap map enter FILE INPUT writes one\)"),
    ],
)
def test_no_map_at_all(tmp_path: Path, make: Callable[[Path], None], line: str) -> None:
    path = tmp_path / "m.evermap"
    make(path)
    with pytest.raises(InputError, match=line):
        open_store(path)


def test_a_store_is_made_where_its_folder_is(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the folder .*nowhere does not exist \(try: mkdir -p .*nowhere\)"):
        open_store(tmp_path / "nowhere" / "m.evermap", create=True)
    path = tmp_path / "m.evermap"
    path.touch()  # what is left of a store whose making was cut short
    assert open_store(path, create=True).head() == 0


def test_a_read_only_file_can_be_read(path: Path) -> None:
    """As somebody without rights sees it: of root, who may do anything, a child process without them."""
    path.chmod(0o444)
    path.parent.chmod(0o555)
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        said = "nothing"
        try:
            if os.getuid() == 0:
                for folder in path.parents:
                    if folder.owner() == "root" and folder != path.parent and not folder.stat().st_mode & 0o001:
                        folder.chmod(folder.stat().st_mode | 0o011)
                os.setuid(65534)
            use_all(path)
            with open_store(path) as store:
                store.commit(random_map(3), Provenance(), parent=3)
        except InputError as error:
            said = error.one_line()
        except BaseException as error:
            said = repr(error)
        finally:
            os.write(writer, said.encode())
            os._exit(0)
    os.waitpid(child, 0)
    path.parent.chmod(0o755)
    said = os.read(reader, 10_000).decode()
    assert said == f"{path}: cannot be written: it is read-only (try: chmod u+w, or a copy of it)"
    assert open_store(path).head() == 3


def test_a_store_that_somebody_keeps_locked(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite, "_PATIENCE_S", 0.05)
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with open_store(path) as store:
        assert store.head() == 3  # readers are not in the way
        with pytest.raises(InputError, match=r"another process keeps it locked \(try: wait for that one to end\)"):
            store.commit(random_map(3), Provenance(), parent=3)
    other.execute("ROLLBACK")
    other.close()
    assert open_store(path).commit(random_map(3), Provenance(), parent=3) == 4


def test_a_full_disk_loses_nothing(path: Path) -> None:
    with open_store(path) as store:
        engine = store._engine  # type: ignore[attr-defined]
        from sqlalchemy import event

        pages = path.stat().st_size // 4096

        @event.listens_for(engine, "connect")
        def full(connection: sqlite3.Connection, _: object) -> None:
            connection.execute(f"PRAGMA max_page_count = {pages + 2}")

        with pytest.raises(InputError, match=r"cannot be written: the disk is full \(try: free some space\)"):
            store.commit(random_map(5, cliques=100), Provenance(), parent=3)
    use_all(path)


@pytest.mark.parametrize(
    ("intact", "damaged", "what", "whole"),
    [
        ((1,), {2: "gone"}, "revision 2: gone", "revision 1 is intact (try: evermap map revert m 1)"),
        ((1, 3), {2: "a", 4: "b"}, "revision 2: a, and 1 more revisions",
         "revisions 1 and 3 are intact (try: evermap map revert m 3)"),
        ((), {1: "a"}, "revision 1: a", "no revision is intact (try: a copy of the file)"),
    ],
)  # fmt: skip
def test_the_error_of_a_damaged_map_names_what_is_whole(
    intact: tuple[int, ...], damaged: dict[int, str], what: str, whole: str
) -> None:
    found = sqlite.Verification(4, intact, damaged, (), (), 9, 999)
    assert not found.sound
    assert found.error("m").one_line() == f"m: damaged: {what}; {whole}"
    assert found.error("m", "no such revision").one_line() == f"m: damaged: no such revision; {whole}"
    assert found.error("m").intact == intact
