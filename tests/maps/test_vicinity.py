"""Sessions in a large map: what is near them is worked out as on a small one, and put back."""

from __future__ import annotations

import functools
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import evermap as em
from evermap.errors import InputError
from evermap.geometry.chunked import ChunkedCovariance, of_places
from evermap.maps.living import Dated, LivingMap
from evermap.maps.shelves import ROWS, Shelves, columns, splice
from evermap.maps.store import Provenance, RevisionKind, open_store
from evermap.maps.vicinity import Vicinity, in_chunks, predict_sites
from evermap.sensing.sightlines import SightLines
from evermap.types import Recording
from evermap_studies.sim import BuildingConfig, simulate_building

SMALL = {"whole_places": 8, "near_m": 1.5}


def config(**living: float) -> em.Config:
    whole = em.Config()
    return whole.model_copy(update={"living": whole.living.model_copy(update=living)})


@functools.cache
def recordings() -> tuple[Recording, ...]:
    building = simulate_building(BuildingConfig(days=4, patrol_s=100.0, change_rate=1.0), seed=5)
    return tuple(replace(session, truth=None) for session in building.sessions)


@functools.cache
def live_days(*, large: bool, days: int = 2) -> tuple[em.Session, ...]:
    sessions: list[em.Session] = []
    settings = config(**SMALL) if large else config()
    for recording in recordings()[:days]:
        before = sessions[-1].living if sessions else None
        sessions.append(em.run_session(recording, before, settings))
    return tuple(sessions)


@pytest.mark.slow
def test_the_same_changes_are_told_of_a_large_map() -> None:
    n_dated = 0
    for small, large in zip(live_days(large=False, days=4), live_days(large=True, days=4), strict=True):
        assert isinstance(large.living.covariance_m2, ChunkedCovariance)
        assert [(c.kind, c.landmark_ids) for c in large.changes] == [(c.kind, c.landmark_ids) for c in small.changes]
        for own, other in zip(large.changes, small.changes, strict=True):
            assert own.probability == pytest.approx(other.probability, abs=0.02)
        np.testing.assert_array_equal(large.living.members.landmark_id, small.living.members.landmark_id)
        np.testing.assert_allclose(large.living.p_exists(), small.living.p_exists(), atol=0.02)
        n_dated += len(large.living.dated)
    assert sum(len(session.changes) for session in live_days(large=False, days=4)) >= 8
    assert n_dated > 0  # some sites were too far from a patrol to be touched


def test_a_part_that_nothing_happened_to_is_put_back_as_it_was() -> None:
    living = live_days(large=True)[-1].living
    some = np.unique(living.members.clique_id)[::3]
    vicinity = Vicinity.of(living, some, em.Config().living, np.array([0.0, 0.0, 8.0, 8.0]))
    assert 0 < len(vicinity.part.places) < len(living.places)
    again = vicinity.put_back(vicinity.part)
    assert again.covariance_m2 is living.covariance_m2
    for table in ("members", "sites", "places", "stays"):
        for column in fields(getattr(living, table)):
            if column.name in ("p_here", "p_kept"):
                continue  # those of the part are of the map's instant now
            before, after = (getattr(getattr(one, table), column.name) for one in (living, again))
            np.testing.assert_array_equal(after, before, err_msg=f"{table}.{column.name}")
    assert living.sight is not None
    assert again.sight is not None
    for old, new in ((living.sight.lines, again.sight.lines), (living.sight.views, again.sight.views)):
        assert len(old) > 100
        for column in columns(old.like):
            np.testing.assert_array_equal(getattr(new.table(), column), getattr(old.table(), column))
    np.testing.assert_allclose(again.p_exists(), living.p_exists(), atol=1e-6)
    assert isinstance(again.covariance_m2, ChunkedCovariance)
    assert isinstance(living.covariance_m2, ChunkedCovariance)
    np.testing.assert_allclose(again.covariance_m2.each_m2, living.covariance_m2.each_m2, atol=1e-9)


def test_a_part_of_which_looks_alone_are_told_keeps_the_covariance_of_the_map() -> None:
    living = live_days(large=True)[-1].living
    some = np.unique(living.members.clique_id)[::3]
    vicinity = Vicinity.of(living, some, em.Config().living, jointly=False)
    assert not isinstance(vicinity.part.covariance_m2, ChunkedCovariance)
    assert vicinity.part.covariance_m2.shape == (len(vicinity.place), 2, 2)
    assert vicinity.put_back(vicinity.part).covariance_m2 is living.covariance_m2
    gone = vicinity.part.places.landmark_id[:1]
    again, rest = vicinity.put_back(vicinity.part.without(gone)), living.without(gone)
    np.testing.assert_array_equal(again.places.landmark_id, rest.places.landmark_id)
    every = np.arange(len(rest.places))
    now, then = of_places(again.covariance_m2, every), of_places(rest.covariance_m2, every)
    np.testing.assert_array_equal(now, then)


def test_beliefs_age_from_when_somebody_was_near() -> None:
    living = live_days(large=False)[-1].living
    later_s = living.stamp_s + 86_400.0
    aged = living.p_exists(later_s)
    sites = living.sites.site_id
    dated = replace(living, stamp_s=later_s, dated=Dated(sites, np.full(len(sites), living.stamp_s)))
    np.testing.assert_allclose(dated.p_exists(), aged, rtol=1e-9)
    named = living.members.landmark_id[:10]
    p_here = predict_sites(dated, named, config(whole_places=1).living, later_s)
    touched = np.isin(sites, living.sites.site_id[np.isin(living.sites.clique_id, living.members.clique_id[:10])])
    assert np.any(p_here[touched] != living.sites.p_here[touched])
    np.testing.assert_array_equal(p_here[~touched], living.sites.p_here[~touched])


def test_localisation_in_chunks_is_as_in_the_dense_map() -> None:
    living = live_days(large=False)[-1].living
    recording = recordings()[-1]
    dense = em.run_localization(recording, living)
    chunked = em.run_localization(recording, in_chunks(living, config(**SMALL).living))
    gap = np.linalg.norm(chunked.online.pose_world_robot[:, :2] - dense.online.pose_world_robot[:, :2], axis=1)
    assert np.median(gap) < 0.005
    assert chunked.landmarks.n_hits.tolist() == pytest.approx(dense.landmarks.n_hits.tolist(), abs=2)


def large_map(side: int) -> LivingMap:
    """A map of `side`^2 places 3 m apart."""
    from benchmarks.scale_maps import living_map

    from evermap_studies.sim import WarehouseConfig

    return living_map(WarehouseConfig(n_landmarks=side * side, landmarks_per_aisle=20, aisles_driven=1))


def test_a_store_keeps_what_changed_of_a_large_map(tmp_path: Path) -> None:
    living = large_map(40)
    covariance = living.covariance_m2
    assert isinstance(covariance, ChunkedCovariance)
    near = np.flatnonzero(covariance.chunk < 6)
    vicinity = Vicinity.of(living, np.unique(living.sites.clique_id[near]), em.Config().living)
    part = vicinity.part
    part = replace(part, covariance_m2=0.5 * of_places(part.covariance_m2, np.arange(len(part.places))))
    after = vicinity.put_back(part)
    path = tmp_path / "map.evermap"
    said = Provenance(RevisionKind.EDIT, note="made")
    with open_store(path, create=True) as store:
        store.commit(living, said, parent=0)
        n_first = path.stat().st_size
        store.commit(after, said, parent=1)
    grown = path.stat().st_size - n_first
    assert grown < 0.35 * n_first
    with open_store(path) as store:
        for revision, expected in ((1, living), (2, after)):
            found = store.load(revision).covariance_m2
            assert isinstance(found, ChunkedCovariance)
            assert isinstance(expected.covariance_m2, ChunkedCovariance)
            assert not any(part.is_read for part in found.parts)
            np.testing.assert_array_equal(found.each_m2, expected.covariance_m2.each_m2)
            np.testing.assert_array_equal(found.of(near), expected.covariance_m2.of(near))
            assert any(part.is_read for part in found.parts)
            assert not all(part.is_read for part in found.parts)


def test_damage_of_a_covariance_is_told_where_it_is_read(tmp_path: Path) -> None:
    import sqlite3

    living = large_map(30)
    assert isinstance(living.covariance_m2, ChunkedCovariance)
    path = tmp_path / "map.evermap"
    with open_store(path, create=True) as store:
        store.commit(living, Provenance(RevisionKind.EDIT, note="made"), parent=0)
    name = living.covariance_m2.parts[0].name
    with sqlite3.connect(path) as connection:
        data = connection.execute("select data from chunk where name = ?", (name,)).fetchone()[0]
        connection.execute("update chunk set data = ? where name = ?", (data[:-9] + b"\0" * 9, name))
    with open_store(path) as store:
        loaded = store.load()
        assert isinstance(loaded.covariance_m2, ChunkedCovariance)
        with pytest.raises(InputError, match="of the data of its places is damaged"):
            loaded.covariance_m2.of(np.flatnonzero(loaded.covariance_m2.chunk == 0))


@given(st.integers(0, 2**16))
def test_shelves_are_the_table_that_is_on_them(seed: int) -> None:
    """Whatever comes and goes, against one table that is sorted again."""
    rng = np.random.default_rng(seed)

    def lines(site: np.ndarray) -> SightLines:
        site = np.sort(site)
        count = len(site)
        return SightLines(site, site % 7, np.arange(count), rng.random(count), rng.random(count))

    table = lines(rng.integers(0, 300, int(rng.integers(0, 12_000))))
    shelves = Shelves.of(table)
    for _ in range(3):
        gone = np.unique(rng.integers(0, 300, int(rng.integers(0, 20))))
        new = lines(rng.choice(np.append(gone, [400, 401]), int(rng.integers(0, 200))))
        table = splice(table, np.append(gone, [400, 401]), new)
        shelves = shelves.replaced(np.append(gone, [400, 401]), new)
        for column in columns(table):
            np.testing.assert_array_equal(getattr(shelves.table(), column), getattr(table, column))
        some = np.unique(rng.integers(0, 402, 5))
        near = shelves.near(some)
        np.testing.assert_array_equal(near.hits[np.isin(near.site_id, some)], table.hits[np.isin(table.site_id, some)])
        assert shelves.count.max(initial=0) <= 2 * ROWS
