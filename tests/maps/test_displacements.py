"""The uncertainty of displacements: by the joint Gaussian of both places, against Monte Carlo, and in made worlds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_maps import random_map

from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.maps.diff import net
from evermap.maps.living import LivingMap
from evermap.maps.sessions.decide import motion_covariance
from evermap.maps.store import Provenance, open_store
from evermap.maps.store.history import Chapter, pack_story, read_story
from evermap.pipeline import run_session
from evermap.runs.summary import change_dict, change_of
from evermap.types import ChangeKind, FloatArray, IntArray, MapChange
from evermap.viz.change_words import what
from evermap_studies.sim import BuildingConfig, simulate_building

MOVE = MapChange((4, 7), ChangeKind.MOVED, 0.0, 1.0, (3.0, 4.0), 0.0, 0.9, 3, 2, (), ((0.02, 0.01), (0.01, 0.04)))


def map_of_two_sites(seed: int) -> LivingMap:
    """Body 0 has two landmarks with a place at each of two sites."""
    living = random_map(seed, cliques=8)
    site = living.places.site_id
    for clique in np.unique(living.sites.clique_id):
        own = living.sites.site_id[living.sites.clique_id == clique]
        if len(own) == 2 and np.sum(site == own[0]) >= 2:
            return replace(living, log_size_variance=1e-3)
    return map_of_two_sites(seed + 1)


def two_sites(living: LivingMap) -> tuple[IntArray, IntArray]:
    """Rows of the sites of the first body that has two with two places each, and of its places."""
    for clique in np.unique(living.sites.clique_id):
        own = np.flatnonzero(living.sites.clique_id == clique)
        rows = [np.flatnonzero(living.places.site_id == living.sites.site_id[k]) for k in own]
        if len(own) == 2 and len(rows[0]) >= 2:
            return own, np.array(rows)
    raise AssertionError("there is none")


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_the_covariance_is_that_of_drawn_maps(seed: int) -> None:
    """The whole map is drawn, with its metre; a shift of all of it, however uncertain, changes nothing."""
    living = map_of_two_sites(seed)
    (old, new), rows = two_sites(living)
    found = np.array(motion_covariance(living, int(old), int(new)))
    random = np.random.default_rng(seed)
    n, joint = 40_000, np.asarray(living.covariance_m2)
    drawn = living.places.position_m.ravel() + random.multivariate_normal(np.zeros(len(joint)), joint, n)
    place = drawn.reshape(n, -1, 2) * np.exp(np.sqrt(living.log_size_variance) * random.normal(size=n))[:, None, None]
    moved = place[:, rows[1]].mean(axis=1) - place[:, rows[0]].mean(axis=1)
    np.testing.assert_allclose(found, np.cov(moved.T), rtol=0.05, atol=0.02 * np.trace(found))
    shift = np.tile(np.eye(2), (len(joint) // 2, 1))
    lost = replace(living, covariance_m2=joint + 25.0 * shift @ shift.T)
    np.testing.assert_allclose(motion_covariance(lost, int(old), int(new)), found, atol=1e-9)


def test_the_covariance_is_kept_in_files_and_told(tmp_path: Path) -> None:
    bare = replace(MOVE, displacement_covariance_m2=())
    gone = MapChange((5,), ChangeKind.VANISHED, 0.0, 1.0, (np.nan, np.nan), 0.0, 0.8)
    with open_store(tmp_path / "site.evermap", create=True) as store:
        store.commit(random_map(0), Provenance(), (MOVE, bare), parent=0)
        assert store.changes(1) == (MOVE, bare)
    chapters = (Chapter(1, 0.0, (bare, MOVE), frozenset()), Chapter(2, 1.0, (), frozenset()),
                Chapter(3, 2.0, (MOVE, bare), frozenset({4})))  # fmt: skip
    assert read_story(pack_story(7, chapters), 9) == (7, chapters)
    assert b"spreads" not in pack_story(7, (replace(chapters[0], changes=(bare,)),))
    for change in (MOVE, bare):
        assert change_of(change_dict(change)) == change
    assert change_dict(gone)["displacement_covariance_m2"] is None
    assert what(MOVE) == f"landmarks 4, 7 moved by (+3.00, +4.00) +- {np.sqrt(0.03):.2f} m"
    assert what(bare) == "landmarks 4, 7 moved by (+3.00, +4.00) m"


def test_of_steps_the_metre_counts_once() -> None:
    """3 m on and 3 m on are 6 m, of which the metre's error is not that of two independent moves; there and on."""
    size, step = 1e-3, np.array([3.0, 4.0])
    own = 0.01 * np.eye(2)
    one = replace(MOVE, displacement_covariance_m2=tuple(map(tuple, (own + size * np.outer(step, step)).tolist())))
    living = replace(random_map(0, cliques=1), log_size_variance=size)
    living = replace(living, members=replace(living.members, landmark_id=np.array([4, 7])[: len(living.members)]))
    maps = replace(living, members=living.members), living
    for back, total in ((1.0, 2.0 * step), (-0.5, 0.5 * step)):
        shift = tuple((back * step).tolist())
        spread = own + size * back**2 * np.outer(step, step)
        other = replace(one, displacement_m=shift, displacement_covariance_m2=tuple(map(tuple, spread.tolist())))
        (change,) = net([((one,), False), ((other,), False)], *maps)
        np.testing.assert_allclose(change.displacement_m, total)
        np.testing.assert_allclose(change.displacement_covariance_m2, 2.0 * own + size * np.outer(total, total))
    unknown = replace(one, displacement_covariance_m2=())
    (change,) = net([((one,), False), ((unknown,), False)], *maps)
    assert change.displacement_covariance_m2 == ()


def displacement_nees(seed: int, *, patrol_s: float) -> list[float]:
    """Normalised squared errors, over two, of the moves that three sessions of a building tell."""
    living: LivingMap | None = None
    seen, found = dict[int, FloatArray](), list[float]()
    for recording in simulate_building(BuildingConfig(days=3, patrol_s=patrol_s), seed).sessions:
        session = run_session(recording, living)
        living = session.living
        truth = recording.true_landmarks
        assert truth is not None
        place = dict(zip(truth.landmark_id.tolist(), truth.position_m, strict=True))
        now = {one: place[one] for one in np.unique(recording.detections.landmark_id).tolist() if one in place}
        mapped = living.landmarks(p_least=0.9)
        same = [(at, now[one]) for one, at in zip(mapped.landmark_id.tolist(), mapped.position_m, strict=True)
                if one in now and one in seen and np.array_equal(now[one], seen[one])]  # fmt: skip
        for change in session.changes if len(same) > 5 else ():
            ids = change.landmark_ids
            if change.kind is ChangeKind.MOVED and all(one in now and one in seen for one in ids):
                turn = rigid(*map(np.array, zip(*same, strict=True)))[2]
                moved = np.mean([now[one] - seen[one] for one in ids], axis=0)
                off = change.displacement_m - se2.transform(np.array([0.0, 0.0, -turn]), moved[None])[0]
                found.append(float(off @ np.linalg.solve(change.displacement_covariance_m2, off) / 2.0))
        seen |= now
    return found


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_displacements_are_as_uncertain_as_they_are_told(seed: int) -> None:
    found = displacement_nees(seed, patrol_s=100.0)
    assert len(found) >= 6
    assert 0.2 < np.mean(found) < 2.0
    assert np.max(found) < 8.0
