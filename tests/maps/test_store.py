"""What every map store must do, and what comes back is what went in."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from random_maps import assert_same, random_changes, random_evidence, random_map

from evermap.errors import ConfigError, InputError, NumericalError
from evermap.maps.living import LivingMap
from evermap.maps.store import (
    DamagedMapError,
    MapStore,
    Provenance,
    PrunedRevisionError,
    RevisionKind,
    StaleRevisionError,
    content,
    open_store,
    revert_store,
    verify_store,
)
from evermap.maps.store.postgres import engine_of
from evermap.maps.store.sql import SqlStore
from evermap.types import UNKNOWN, ChangeKind

SESSION = Provenance(
    recording="robot 1",
    source="/data/one.zip",
    command="evermap slam one.zip --map m",
    config="[slam]\nseed = 3\n",
    seed=3,
    stamp_from_s=10.0,
    stamp_to_s=20.5,
    wall_s=1.25,
)


@pytest.fixture(params=["sqlite", "postgresql"])
def where(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Where a store of every kind would be."""
    return str(tmp_path / "m.evermap") if request.param == "sqlite" else request.getfixturevalue("site_address")


@pytest.fixture
def store(where: str) -> Iterator[MapStore]:
    """An empty store of every kind."""
    with open_store(where, create=True) as empty:
        yield empty


def test_revision_zero_is_the_empty_map(store: MapStore) -> None:
    assert store.head() == 0
    assert store.log() == ()
    assert store.lineage() == ()
    assert_same(store.load(), LivingMap())
    assert_same(store.load(0), LivingMap())


in_plane_and_space = pytest.mark.parametrize("dim", [2, 3])


@in_plane_and_space
def test_every_revision_reads_back_bit_by_bit(store: MapStore, dim: int) -> None:
    maps = [random_map(seed, cliques=1 + 2 * seed, dim=dim) for seed in range(8)]
    for number, living in enumerate(maps):
        assert store.commit(living, SESSION, parent=number) == number + 1
    for number, living in enumerate(maps):
        assert_same(store.load(number + 1), living)
    assert_same(store.load(), maps[-1])


def test_what_was_checked_long_ago_is_forgotten(store: MapStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evermap.maps.store.sql._MOST_CHECKED", 100)
    assert isinstance(store, SqlStore)
    maps = [random_map(seed, cliques=3) for seed in range(12)]
    for number, living in enumerate(maps):
        store.commit(living, SESSION, parent=number)
        assert len(store._checked) <= 100
    for number, living in enumerate(maps):
        assert_same(store.load(number + 1), living)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_any_numbers_read_back_bit_by_bit(data: st.DataObject, store: MapStore) -> None:
    """Minus zero, subnormal numbers, and infinite stamps too; matrices that are not quite symmetric too."""
    dim = data.draw(st.sampled_from([2, 3]))
    living = random_map(data.draw(st.integers(0, 5)), cliques=2, dim=dim)
    anything = st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=True)
    count, size = len(living.places), len(living.covariance_m2)
    finite = st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=True)
    matrix = data.draw(hnp.arrays(np.float64, (size, size), elements=finite))
    matrix[np.diag_indices(size)] = np.abs(matrix.diagonal())
    symmetric = np.where(np.tri(size, dtype=bool), matrix, matrix.T)
    living = replace(
        living,
        stamp_s=data.draw(anything.filter(lambda x: x == x)),
        covariance_m2=data.draw(st.sampled_from([matrix, symmetric])),
        places=replace(living.places, position_m=data.draw(hnp.arrays(np.float64, (count, dim), elements=finite))),
        members=replace(
            living.members,
            class_id=data.draw(hnp.arrays(np.int64, len(living.members), elements=st.integers(UNKNOWN, 2**63 - 1))),
        ),
        class_names=tuple(data.draw(st.lists(st.text(), max_size=3))),
    )
    number = store.commit(living, SESSION, parent=store.head())
    assert_same(store.load(number), living)


def test_the_log_says_where_a_revision_comes_from(store: MapStore) -> None:
    living = random_map(1)
    changes = random_changes(1, living)
    store.commit(living, SESSION, (*changes, changes[0]), parent=0)
    edit = replace(SESSION, kind=RevisionKind.EDIT, note="pinned landmark 7", seed=None, wall_s=float("nan"))
    store.commit(living, edit, parent=1)
    first, second = store.log()
    assert (first.number, first.parent, first.restores) == (1, 0, None)
    assert first.provenance == SESSION
    assert first.n_changes == {ChangeKind.MOVED: 2, ChangeKind.APPEARED: 1}
    assert first.n_landmarks == len(living.members)
    assert first.n_existing == len(living.landmarks(p_least=0.5))
    assert second.provenance.note == "pinned landmark 7"
    assert second.provenance.seed is None
    assert np.isnan(second.provenance.wall_s)
    assert second.n_changes == {}
    assert first.created_at <= second.created_at


@in_plane_and_space
def test_changes_read_back(store: MapStore, dim: int) -> None:
    living = random_map(4, dim=dim)
    changes = random_changes(4, living)
    store.commit(living, SESSION, changes, parent=0)
    store.commit(living, SESSION, parent=1)
    for mine, theirs in zip(store.changes(1), changes, strict=True):
        assert_same(mine, theirs)
    assert store.changes() == ()
    store.commit(living, SESSION, changes[::-1], parent=2)
    moved, appeared = changes
    for name, wanted in ((moved.landmark_ids[1], moved), (appeared.landmark_ids[0], appeared)):
        (first, one), (second, other) = store.changes_of(name)
        assert (first, second) == (1, 3)
        assert_same(one, wanted)
        assert_same(other, wanted)
    assert store.changes_of(-5) == ()


def test_a_writer_that_comes_late_is_refused(store: MapStore) -> None:
    store.commit(random_map(1), SESSION, parent=0)
    with pytest.raises(StaleRevisionError, match="revision 1 was committed after revision 0 was read"):
        store.commit(random_map(2), SESSION, parent=0)
    with pytest.raises(StaleRevisionError):
        store.commit(random_map(2), SESSION, parent=5)
    assert store.head() == 1
    assert_same(store.load(), random_map(1))


def test_of_many_writers_at_once_one_wins(store: MapStore) -> None:
    maps = [random_map(seed) for seed in range(8)]
    for head in range(3):
        won, gate = [], threading.Barrier(len(maps))

        def write(seed: int, parent: int = head, won: list[int] = won, gate: threading.Barrier = gate) -> None:
            gate.wait()
            try:
                store.commit(maps[seed], SESSION, parent=parent)
            except StaleRevisionError:
                return
            won.append(seed)

        threads = [threading.Thread(target=write, args=(seed,)) for seed in range(len(maps))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(won) == 1
        assert store.head() == head + 1
        assert_same(store.load(), maps[won[0]])


def test_a_revert_is_a_revision_and_can_be_reverted(store: MapStore) -> None:
    old, new = random_map(1), random_map(2)
    new = replace(new, n_cliques_ever=50, n_sites_ever=70)
    store.commit(old, SESSION, parent=0)
    store.commit(new, SESSION, parent=1)
    assert store.revert(1) == 3
    # what was given an id since then keeps it: the same id never means two things
    assert_same(store.load(), replace(old, n_cliques_ever=50, n_sites_ever=70))
    assert store.revert(2, Provenance(note="that was wrong")) == 4
    assert_same(store.load(), new)
    assert [(r.restores, r.provenance.kind, r.provenance.note) for r in store.log()[2:]] == [
        (1, RevisionKind.REVERT, "back to revision 1"),
        (2, RevisionKind.REVERT, "that was wrong"),
    ]
    assert [store.lineage(number) for number in range(5)] == [(), (1,), (1, 2), (1, 3), (1, 2, 4)]
    store.revert(0)
    assert len(store.load().members) == 0
    assert store.lineage() == (5,)


def test_evidence_by_clique_by_landmark_and_by_time(store: MapStore) -> None:
    first, second = random_map(1, stamp_s=1000.0), random_map(1, stamp_s=2000.0)
    # in the second session landmark 0's clique has another number
    renamed = replace(second.members, clique_id=np.where(second.members.clique_id == 0, 99, second.members.clique_id))
    second = replace(second, members=renamed, n_cliques_ever=100)
    early, late = random_evidence(5, first), random_evidence(6, second)
    store.commit(first, SESSION, (), early, parent=0)
    store.commit(second, SESSION, (), late, parent=1)
    landmark = int(first.members.landmark_id[0])

    found = store.evidence(landmark_id=landmark)
    wanted = early[early.clique_id == 0].joined(late[late.clique_id == 99])
    for name in ("clique_id", "stamp_s", "n_hits", "n_misses"):
        assert_same(getattr(found, name), getattr(wanted, name))
    for name in ("expected", "log_odds", "p_exists"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=1e-6)

    assert_same(store.evidence(clique_id=0).stamp_s, early[early.clique_id == 0].stamp_s)
    assert len(store.evidence()) == len(early) + len(late)
    middle = float(early.stamp_s[10])
    assert len(store.evidence(clique_id=0, since_s=middle)) == 30
    assert len(store.evidence(landmark_id=landmark, revisions=[1])) == 40
    store.revert(1)  # what a session saw that was taken back says nothing any more
    assert_same(store.evidence(landmark_id=landmark).stamp_s, early[early.clique_id == 0].stamp_s)
    assert len(store.evidence(landmark_id=-5)) == 0


def test_attachments_are_kept_once_and_read_on_demand(store: MapStore) -> None:
    session, scan = b"\0\1\2" * 70_000, np.random.default_rng(0).bytes(50_000)
    living = random_map(1)
    store.commit(living, SESSION, parent=0, attachments={"session": session, "scan": scan})
    store.commit(living, SESSION, parent=1)
    assert [(item.revision, item.name, item.n_bytes) for item in store.attachments()] == [
        (1, "scan", 50_000),
        (1, "session", 210_000),
    ]
    (first,) = (item for item in store.attachments([1]) if item.name == "scan")
    assert store.attached(first) == scan
    size = n_bytes(store)
    store.commit(living, SESSION, parent=2, attachments={"again": first, "too": session})
    assert n_bytes(store) < size + 20_000
    assert {item.name: store.attached(item) for item in store.attachments([3])} == {"again": scan, "too": session}
    store.revert(1)
    assert [item.name for item in store.attachments()] == ["scan", "session"]  # of 1 and 4
    unknown = replace(first, digest="00" * 32)
    with pytest.raises(InputError, match="a part of the map is missing"):
        store.commit(living, SESSION, parent=4, attachments={"x": unknown})
    assert store.head() == 4


def n_bytes(store: MapStore) -> int:
    assert isinstance(store, SqlStore)
    return sum(len(value) for row in store.rows() for value in row if isinstance(value, bytes))


def test_a_map_that_contradicts_itself_is_not_committed(store: MapStore) -> None:
    living = random_map(1)
    store.commit(living, SESSION, parent=0)
    lame = replace(living, places=replace(living.places, position_m=living.places.position_m * np.nan))
    with pytest.raises(NumericalError, match=r"'places.position_m' is not finite"):
        store.commit(lame, SESSION, parent=1)
    assert store.head() == 1


def test_an_unknown_revision_is_one_line(store: MapStore) -> None:
    store.commit(random_map(1), SESSION, parent=0)
    for ask in (store.load, store.revert, store.changes, store.lineage):
        with pytest.raises(InputError, match=r"no revision 7; it has 1 of them \(try: evermap map log"):
            ask(7)
    with pytest.raises(InputError, match="no revision -1"):
        store.load(-1)
    with pytest.raises(InputError, match="is the newest already"):
        store.revert(1)


def test_what_did_not_change_is_kept_once(tmp_path: Path) -> None:
    """An edit of a large map, and a session that only adds stays, cost little."""
    path = tmp_path / "m.evermap"
    living = random_map(3, cliques=80)
    with open_store(path, create=True) as store:
        store.commit(living, SESSION, parent=0)
        before = path.stat().st_size
        for number in range(1, 11):
            pinned = living.members.pinned.copy()
            pinned[number] = ~pinned[number]
            living = replace(living, members=replace(living.members, pinned=pinned))
            store.commit(living, SESSION, parent=number)
        assert (path.stat().st_size - before) / 10 < before / 50


def test_the_cost_of_a_revision_does_not_grow_with_the_history(tmp_path: Path) -> None:
    """Sessions that add some 150 stays each: the last thirty cost what the first thirty did."""
    path = tmp_path / "m.evermap"
    stays, sizes = random_map(0).stays, []
    with open_store(path, create=True) as store:
        for number in range(91):
            stays = stays.joined(random_map(number, cliques=100).stays)
            living = replace(random_map(number, cliques=4), stays=stays, n_cliques_ever=200, n_sites_ever=400)
            store.commit(living, SESSION, parent=number)
            sizes.append(path.stat().st_size)
    assert len(stays) > 3 * 4096
    grown = np.diff(sizes)
    # the last chunk of every column is rewritten each time, until it is full: that is the bound
    assert grown[60:].sum() < 1.5 * grown[:30].sum()


def test_a_history_of_stays_is_written_again_at_its_ends_only() -> None:
    """Sessions that add five stays each, the newest 1,000 of which are kept."""
    living, random = random_map(2, cliques=8), np.random.default_rng(0)
    rows = np.arange(5) % len(living.stays)
    stays, known, cost, whole = living.stays[rows[:0]], set[bytes](), [], []
    for number in range(260):
        first_s = 1e4 * (number + random.random(5))
        position_m = random.normal(size=(5, 2))
        new = replace(living.stays[rows], first_s=first_s, last_s=first_s + 1e4, position_m=position_m)
        stays = stays.joined(new)
        stays = stays[np.arange(max(0, len(stays) - 1000), len(stays))]
        _, chunks = content.pack(replace(living, stays=stays))
        whole.append(sum(len(chunk.stored()) for chunk in chunks.values()))
        cost.append(sum(len(chunk.stored()) for name, chunk in chunks.items() if name not in known))
        known |= chunks.keys()
    assert np.mean(cost[-50:]) < 0.6 * np.mean(whole[-50:])
    assert np.mean(cost[150:200]) < 0.3 * np.mean(whole[150:200])  # before the oldest ones go


def rewritten(living: LivingMap, change: Callable[[dict[str, Any]], None]) -> LivingMap:
    """A map as it is read when its manifest was another."""
    name, chunks = content.pack(living)
    manifest = json.loads(chunks[name].raw)
    change(manifest)
    other = content.text_chunk(json.dumps(manifest))
    stored = {key: chunk.stored() for key, chunk in {**chunks, other.name: other}.items()}
    return content.unpack(other.name, lambda names: {key: stored[key] for key in names})


def test_what_an_older_evermap_did_not_write_has_its_default() -> None:
    living = random_map(2)
    read = rewritten(replace(living, log_size_variance=0.5), lambda m: m["values"].pop("log_size_variance"))
    assert_same(read, living)
    read = rewritten(living, lambda m: m["columns"].pop("lives.looks_s"))
    assert_same(read, living)


def to_format_1(manifest: dict[str, Any]) -> None:
    """As format 1 would have had the map: lines of sight between cells of the floor, and nothing that came later."""
    columns, values = manifest["columns"], manifest["values"]
    manifest["format"] = 1
    for name in [*columns]:
        newer = name.startswith(("sightlines.", "views.", "glimpses.", "metres."))
        if newer or name in ("sites.p_kept", "stays.p_gone"):
            del columns[name]
    for name in [*values]:
        if name.startswith(("sightlines.", "views.")) or name in ("log_size_information", "session_start_s"):
            del values[name]
    columns |= {"sightlines.key": columns["stays.clique_id"], "sightlines.hits": columns["stays.first_s"]}
    columns |= {"sightlines.looks": columns["stays.first_s"]}
    values["sightlines.cell_m"] = 1.0


@pytest.mark.parametrize(("variance", "information"), [(0.0, np.inf), (0.25, 4.0)])
def test_format_1_is_read_with_lines_of_sight_to_be_learned_again(variance: float, information: float) -> None:
    living = replace(random_map(4), log_size_variance=variance, log_size_information=7.0)
    read = rewritten(living, to_format_1)
    wanted = replace(random_map(4, format_1=True), log_size_variance=variance, log_size_information=information)
    assert_same(read, wanted)
    assert len(read.sightlines) == len(read.views) == 0
    np.testing.assert_array_equal(read.sites.p_kept, read.sites.p_here)
    np.testing.assert_array_equal(read.stays.p_gone, np.isfinite(read.stays.gone_s))
    # and is written as format 2 from then on
    assert_same(rewritten(read, lambda manifest: None), read)


def test_lines_of_sight_and_views_read_back() -> None:
    living = replace(random_map(5), log_size_variance=0.01, log_size_information=250.0)
    assert len(living.sightlines) > 10
    assert len(living.views) == 30
    assert living.sightlines.hidden.min() > 0.0
    assert living.sightlines.open_space.min() > 0.0
    seen = []
    assert_same(rewritten(living, lambda manifest: seen.append(manifest["format"])), living)
    assert seen == [2]


@pytest.mark.parametrize(
    ("part", "change", "line"),
    [
        ("sites", {"p_kept": 1.5}, "'sites.p_kept' is not a probability"),
        ("stays", {"p_gone": -0.1}, "'stays.p_gone' is not a probability"),
        ("stays", {"p_gone": np.nan}, "'stays.p_gone' is not a probability"),
        ("sightlines", {"hits": -1.0}, "a negative count"),
        ("sightlines", {"shown": np.inf}, "'sightlines.shown' is not finite"),
        ("sightlines", {"open_space": np.nan}, "'sightlines.open_space' is not finite"),
        ("sightlines", {"open_space": -1.0}, "a negative count"),
        ("views", {"frames": -3.0}, "a negative count"),
        ("views", {"stamp_s": np.nan}, "'views.stamp_s' is not finite"),
        ("views", {"cell_m": 0.0}, "a cell without size"),
        ("glimpses", {"stamp_s": np.inf}, "'glimpses.stamp_s' is not finite"),
    ],
)
def test_what_format_2_brought_is_checked(part: str, change: dict[str, float], line: str) -> None:
    living = random_map(6)
    table = getattr(living, part)
    ((name, value),) = change.items()
    wrong = value if isinstance(getattr(table, name), float) else np.append(getattr(table, name)[:-1], value)
    assert content.flaw(living) == ""
    assert line in content.flaw(replace(living, **{part: replace(table, **{name: wrong})}))


def test_a_map_in_space_has_columns_that_a_planar_one_does_not_have() -> None:
    planar, spatial = (json.loads(chunks[name].raw) for name, chunks in map(content.pack, (random_map(2), SPATIAL)))
    assert (planar["format"], spatial["format"]) == (2, 3)  # an older evermap reads planar maps
    assert spatial["columns"].keys() - planar["columns"].keys() == {"places.rotation", "places.rotation_covariance"}
    assert planar["values"].keys() == spatial["values"].keys()
    assert_same(rewritten(LivingMap.in_space(), lambda manifest: None), LivingMap.in_space())
    for change in (lambda m: m.update(format=2), lambda m: m["columns"].pop("stays.position_m")):
        with pytest.raises(content.DamagedError):
            rewritten(SPATIAL, change)


SPATIAL = random_map(6, dim=3)


@pytest.mark.parametrize(
    ("table", "column", "change", "line"),
    [
        ("places", "rotation", lambda a: 1.1 * a, "a quaternion that is not of length 1"),
        ("places", "rotation", lambda a: np.where([True, False, False, False], np.nan, a), "not of length 1"),
        ("places", "rotation", lambda a: a[:, :3], r"'places.rotation' has rows of shape \(3,\), not \(4,\)"),
        ("places", "rotation_covariance", lambda a: -a, "'places.rotation_covariance' is not a covariance"),
        ("places", "rotation_covariance", lambda a: np.nan * a, "'places.rotation_covariance' is not a covariance"),
        ("places", "rotation_covariance", lambda a: a[:-1], "columns of different lengths in 'places'"),
        ("stays", "position_m", lambda a: a[:, :2], "'stays.position_m' has rows of shape"),
    ],
)
def test_what_maps_in_space_brought_is_checked(
    table: str, column: str, change: Callable[[np.ndarray], np.ndarray], line: str
) -> None:
    part = getattr(SPATIAL, table)
    other = replace(SPATIAL, **{table: replace(part, **{column: change(getattr(part, column))})})
    assert content.flaw(SPATIAL) == ""
    assert re.search(line, content.flaw(other))
    size = len(SPATIAL.covariance_m2)
    assert "a covariance of shape" in content.flaw(replace(SPATIAL, covariance_m2=np.eye(size // 3 * 2)))


def test_a_map_that_learned_nothing_of_new_lines_has_no_column_of_it() -> None:
    """So an older evermap reads it, and what such a one wrote has learned nothing."""
    living = random_map(5)
    living = replace(living, sightlines=replace(living.sightlines, open_space=np.zeros(0)))
    seen: list[str] = []
    read = rewritten(living, lambda manifest: seen.extend(manifest["columns"]))
    assert "sightlines.hidden" in seen
    assert not [name for name in seen if name.endswith("open_space")]
    assert len(read.sightlines.open_space) == 0


@pytest.mark.parametrize(
    "column", ["sightlines.cell", "views.heading", "stays.p_gone", "sightlines.hidden", "sightlines.open_space"]
)
def test_columns_of_other_lengths_are_a_flaw(column: str) -> None:
    living = random_map(6)
    part, name = column.split(".")
    table = getattr(living, part)
    short = replace(table, **{name: getattr(table, name)[:-1]})
    assert "length" in content.flaw(replace(living, **{part: short}))


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda m: m["columns"].pop("members.pinned"), "columns of different lengths in 'members'"),
        (
            lambda m: m["values"].update(colour="red"),
            "it contains 'colour', which this evermap does not know",
        ),
        (lambda m: m.update(format=4), "columns of format 4, this evermap reads 1 to 3"),
    ],
)
def test_what_this_evermap_does_not_know_is_not_dropped(change: Callable[[dict[str, Any]], None], line: str) -> None:
    with pytest.raises(content.DamagedError, match=line):
        rewritten(random_map(2), change)


def test_other_databases_are_named() -> None:
    with pytest.raises(ConfigError, match=r"no map store for 'mysql\+driver'"):
        open_store("mysql+driver://x")


@pytest.mark.parametrize("tail", ["db", "db/", "db/ward 3", "db/../x", "db/-x", 'db/a"b', "db/" + 49 * "x", ""])
def test_an_address_names_a_database_and_a_site(tail: str) -> None:
    with pytest.raises(ConfigError, match="names no site") as caught:
        open_store(f"postgresql://me:secret@host/{tail}", create=True)
    assert "secret" not in caught.value.one_line()


def test_a_database_that_cannot_be_reached_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^postgresql://me:\*\*\*@/db/site\?host=.*PostgreSQL: .*check the address"):
        open_store(f"postgresql://me:secret@/db/site?host={tmp_path}")


def test_sites_of_a_database_do_not_see_one_another(postgres: str, site_address: str) -> None:
    from evermap.maps.store.postgres import sites_in

    with pytest.raises(InputError, match="contains no map"):
        open_store(site_address)
    other = site_address.replace("/site-", "/Other-")
    with open_store(site_address, create=True) as one, open_store(other, create=True) as two:
        one.commit(random_map(1), SESSION, parent=0)
        assert (one.head(), two.head()) == (1, 0)
    assert {name.partition("?")[0].rpartition("/")[2] for name in (site_address, other)} <= set(sites_in(postgres))


def test_a_map_in_a_database_is_verified_and_reverted(site_address: str) -> None:
    with open_store(site_address, create=True) as store:
        for seed in range(2):
            store.commit(random_map(seed), SESSION, parent=seed)
    found = verify_store(site_address)
    assert found.sound
    assert found.intact == (1, 2)
    assert revert_store(site_address, 1) == (3, None)
    with open_store(site_address) as store:
        assert store.prune(2).revisions == ()
        assert store.prune(1).revisions == (1, 2)
        with pytest.raises(PrunedRevisionError):
            store.load(2)
        assert_same(store.load(3).places, random_map(0).places)
    assert verify_store(site_address).pruned == (1, 2)
    engine = engine_of(site_address.replace(site_name(site_address), ""), f"map_{site_name(site_address)[1:]}")
    with engine.execution_options(writes=True).begin() as connection:
        connection.exec_driver_sql("UPDATE chunk SET data = '\\x00' WHERE name = (SELECT record FROM revision LIMIT 1)")
    damaged = verify_store(site_address)
    assert not damaged.sound
    with open_store(site_address) as store, pytest.raises(DamagedMapError, match="restore a backup"):
        store.log()


def site_name(address: str) -> str:
    found = re.search(r"/site-\w+", address)
    assert found
    return found[0]


def test_readers_see_one_revision_while_others_write(where: str) -> None:
    """And two writers who take turns lose nothing: who was late tries again from the newest."""
    open_store(where, create=True).close()
    maps = [random_map(seed, cliques=3) for seed in range(6)]
    done = threading.Event()
    seen: list[str] = []

    def write(mine: list[int]) -> None:
        with open_store(where) as store:
            for seed in mine:
                while True:
                    with suppress(StaleRevisionError):
                        store.commit(maps[seed], replace(SESSION, recording=str(seed)), parent=store.head())
                        break

    def read() -> None:
        with open_store(where) as store:
            while not done.is_set():
                for item in store.log():
                    try:
                        assert_same(store.load(item.number), maps[int(item.provenance.recording)])
                    except BaseException as error:
                        seen.append(repr(error))
                        raise

    reader = threading.Thread(target=read)
    writers = [threading.Thread(target=write, args=(mine,)) for mine in ([0, 1, 2], [3, 4, 5])]
    for thread in (reader, *writers):
        thread.start()
    for thread in writers:
        thread.join()
    done.set()
    reader.join()
    assert not seen
    with open_store(where) as store:
        assert sorted(int(item.provenance.recording) for item in store.log()) == list(range(6))


def test_an_address_is_a_path_with_a_name_in_front(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_store(tmp_path / "m.evermap", create=True).commit(random_map(1), SESSION, parent=0)
    assert open_store(f"sqlite:///{tmp_path}/m.evermap").head() == 1
    monkeypatch.chdir(tmp_path)
    assert open_store("sqlite:///m.evermap").head() == 1
    assert open_store("m.evermap").head() == 1


def test_the_database_library_is_loaded_by_opening_only() -> None:
    code = "import evermap.maps.store, sys; print('sqlalchemy' in sys.modules, 'numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_evidence_by_revision_is_that_of_each(tmp_path: Path) -> None:
    """Of all, of a clique, and of a landmark that belonged to another clique in each revision."""
    first = random_map(3)
    clique = int(first.members.clique_id[0])
    renumbered = np.where(first.members.clique_id == clique, 99, first.members.clique_id)
    second = replace(first, members=replace(first.members, clique_id=renumbered), n_cliques_ever=100)
    landmark = int(first.members.landmark_id[0])
    looks = random_evidence(1, first), random_evidence(2, first)
    other = replace(looks[1], clique_id=np.where(looks[1].clique_id == clique, 99, looks[1].clique_id))
    with open_store(tmp_path / "map.evermap", create=True) as store:
        for number, (living, seen) in enumerate(((first, looks[0]), (second, other), (second, None))):
            store.commit(living, Provenance(), (), seen, parent=number)
        for asked in ({}, {"clique_id": clique}, {"landmark_id": landmark}, {"since_s": float(looks[0].stamp_s[9])}):
            found = store.evidence_by_revision(**asked)
            assert list(found) == [1, 2, 3]
            assert len(found[3]) == 0
            for number in (1, 2):
                assert_same(found[number], store.evidence(**asked, revisions=[number]))
        of_landmark = store.evidence_by_revision(landmark_id=landmark)
        assert set(of_landmark[1].clique_id.tolist()) == {clique}
        assert set(of_landmark[2].clique_id.tolist()) == {99}
        assert len(store.evidence(landmark_id=landmark)) == len(of_landmark[1]) + len(of_landmark[2])
