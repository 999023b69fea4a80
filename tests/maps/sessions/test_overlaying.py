"""Sessions of which a part is turned, and landmarks that were hardly seen: where they lie in the map."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from evermap.config import LivingConfig
from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.maps.living import LivingMap
from evermap.maps.sessions.overlay import ELSEWHERE
from evermap.maps.sessions.placing import USUAL, Laid, unbent, with_glimpsed
from evermap.types import FloatArray, IntArray

from .scenes import begun, found

NAMES = np.arange(3, 33, 3)
seeds = st.integers(0, 10**6)


def a_map(rng: np.random.Generator) -> LivingMap:
    """Ten bodies of one landmark, anywhere in a building."""
    return begun(found(NAMES.tolist(), rng.uniform(-15.0, 15.0, (10, 2))), LivingConfig(cliques=False)).living


def at_home(living: LivingMap) -> tuple[IntArray, FloatArray]:
    """Rows of the landmarks' places, and where these are."""
    row = living.place_row(NAMES, living.site_of())
    return row, living.places.position_m[row]


def laid(living: LivingMap, moved: IntArray) -> Laid:
    place = at_home(living)[0].copy()
    place[moved] = ELSEWHERE
    return Laid(NAMES, np.zeros(3), place, np.full(len(NAMES), 0.9), 0.01, np.zeros(len(NAMES), bool))


def alone(count: int) -> sparse.csr_array:
    """Each landmark seen in five frames of its own."""
    return sparse.csr_array(5.0 * np.eye(count))


@pytest.mark.parametrize("in_the_midst", [True, False])
def test_what_moved_alike_in_the_midst_of_what_stands_has_moved(*, in_the_midst: bool) -> None:
    """Three reflectors of one shelf, each a body of its own for all that the map knows."""
    rng = np.random.default_rng(3)
    living = a_map(rng)
    shelf, rest = np.array([2, 5, 6]), np.array([0, 1, 3, 4, 7, 8, 9])
    row, home = at_home(living)
    at = home.copy()
    at[shelf] = se2.transform(np.array([1.0, 0.5, 0.1]), at[shelf])
    together = 10.0 * np.eye(10)
    together[np.ix_(shelf, shelf)] = 10.0
    if in_the_midst:
        together[np.ix_(shelf, rest)] = together[np.ix_(rest, shelf)] = 4.0
    where = unbent(living, living.sites.p_here, laid(living, shelf), at, sparse.csr_array(together))
    np.testing.assert_array_equal(where.place, laid(living, shelf).place if in_the_midst else row)


@given(seeds, st.integers(3, 8))
def test_a_part_that_is_turned_as_a_whole_is_laid_on_its_places(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    living = a_map(rng)
    turned = np.sort(rng.permutation(10)[:n])
    row, home = at_home(living)
    at = home + 0.01 * rng.standard_normal(home.shape)
    motion = np.append(rng.uniform(-5.0, 5.0, 2), rng.uniform(-2.0, 2.0))
    at[turned] = se2.transform(motion, at[turned])
    where = unbent(living, living.sites.p_here, laid(living, turned), at, alone(10))
    np.testing.assert_array_equal(where.place, row)
    np.testing.assert_array_equal(where.probability[turned], 1.0)
    np.testing.assert_array_equal(np.where(where.assumed, ELSEWHERE, where.place), laid(living, turned).place)


@given(seeds, st.integers(0, 8), st.booleans())
def test_bodies_that_moved_each_in_its_way_have_moved(seed: int, n: int, together: bool) -> None:
    """Unless three of them fit by one rigid motion, tried in all ways; two may have been carried together."""
    rng = np.random.default_rng(seed)
    living = a_map(rng)
    moved = np.sort(rng.permutation(10)[:n])
    row, home = at_home(living)
    at = home.copy()
    at[moved] += rng.uniform(0.5, 6.0, (n, 1)) * np.column_stack([np.cos(a := rng.uniform(0, 7, n)), np.sin(a)])
    if together and n >= 2:
        at[moved[:2]] = se2.transform(np.array([2.0, 1.0, 0.7]), home[moved[:2]])
    before = laid(living, moved)
    where = unbent(living, living.sites.p_here, before, at, alone(10))
    assert not any(_fit(at[list(three)], home[list(three)]) for three in itertools.combinations(moved, 3)) or n >= 3
    if not any(_fit(at[list(three)], home[list(three)]) for three in itertools.combinations(moved, 3)):
        np.testing.assert_array_equal(where.place, before.place)
        np.testing.assert_array_equal(where.probability, before.probability)
    back = np.flatnonzero((before.place < 0) & (where.place >= 0))
    np.testing.assert_array_equal(where.place[back], row[back])  # never to another's
    assert len(back) == 0 or len(back) >= USUAL.bent_cliques


def _fit(at: FloatArray, home: FloatArray) -> bool:
    return bool(np.hypot(*(home - se2.transform(rigid(at, home), at)).T).max() < USUAL.bent_m)


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 5))])
def test_of_a_bent_session_what_really_moved_is_left_out_and_two_bends_are_straightened(seed: int) -> None:
    rng = np.random.default_rng(seed)
    living = a_map(rng)
    row, home = at_home(living)
    at = home.copy()
    at[[0, 1, 2, 3]] = se2.transform(np.array([4.0, -1.0, 0.8]), home[[0, 1, 2, 3]])
    at[[4, 5, 6]] = se2.transform(np.array([-3.0, 2.0, -0.5]), home[[4, 5, 6]])
    at[7] += (9.0, 13.0)
    where = unbent(living, living.sites.p_here, laid(living, np.arange(8)), at, alone(10))
    np.testing.assert_array_equal(where.place, np.where(np.arange(10) == 7, ELSEWHERE, row))


def test_landmarks_of_one_body_are_one_witness() -> None:
    """A shelf of four landmarks that was carried away as a whole has moved."""
    names, at = [1, 2, 3, 4, 8, 9], [[0, 0], [0.8, 0], [0, 0.8], [0.8, 0.8], [9.0, 0], [0, 9.0]]
    living = begun(found(names, at)).living
    assert len(np.unique(living.members.clique_id)) == 3
    row = living.place_row(np.array(names), living.site_of())
    place = np.where(np.arange(6) < 4, ELSEWHERE, row)
    session = np.array(at, dtype=np.float64)
    session[:4] = se2.transform(np.array([3.0, 3.0, 1.0]), session[:4])
    where = Laid(np.array(names), np.zeros(3), place, np.ones(6), 0.01, np.zeros(6, bool))
    np.testing.assert_array_equal(unbent(living, living.sites.p_here, where, session, alone(6)).place, place)


def test_new_landmarks_are_nowhere() -> None:
    living = a_map(np.random.default_rng(0))
    names = np.array([1, 4, 7])
    where = Laid(names, np.zeros(3), np.full(3, ELSEWHERE), np.ones(3), 0.01, np.zeros(3, bool))
    np.testing.assert_array_equal(
        unbent(living, living.sites.p_here, where, np.eye(3, 2), alone(3)).place, np.full(3, ELSEWHERE)
    )


def test_what_was_glimpsed_is_laid_where_the_rest_of_its_body_stands_and_nowhere_else() -> None:
    names, at = [1, 2, 8, 9, 12, 13], [[0, 0], [0.8, 0], [9.0, 0], [9.8, 0], [0, 9.0], [0.8, 9.0]]
    living = begun(found(names, at)).living
    row = dict(zip(names, living.place_row(np.array(names), living.site_of()).tolist(), strict=True))
    # 1 stands, 8 moved, nobody saw the third body well; 50 is new
    where = Laid(
        np.array([1, 8]), np.zeros(3), np.array([row[1], ELSEWHERE]), np.array([0.9, 0.8]), 0.01, np.zeros(2, bool)
    )
    after = with_glimpsed(living, where, np.array([50, 13, 9, 2]))
    assert after.landmark_id.tolist() == [1, 2, 8]
    assert after.place.tolist() == [row[1], row[2], ELSEWHERE]
    assert after.probability.tolist() == [0.9, 1.0, 0.8]
