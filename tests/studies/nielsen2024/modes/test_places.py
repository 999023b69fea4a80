"""The book of places: whose they are, and what is free."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from problems import make_world

from evermap.slam.problem import Estimate
from evermap_studies.nielsen2024.modes.places import FREE, Modes, grown


@st.composite
def books(draw: st.DrawFn) -> tuple[Modes, Estimate]:
    count = draw(st.integers(1, 5))
    extra = draw(st.lists(st.integers(-1, count - 1), max_size=12))
    landmark = np.array([*range(count), *extra])
    known = np.array(draw(st.lists(st.booleans(), min_size=len(landmark), max_size=len(landmark))))
    at = np.where(known[:, None], 1.0, np.nan) * np.ones((1, 2))
    return Modes(landmark, count), Estimate(np.zeros((1, 3)), at, np.zeros(11))


@given(books())
def test_the_table_lists_every_place_with_a_position_once(book: tuple[Modes, Estimate]):
    modes, estimate = book
    table = modes.table(estimate)
    assert table.shape[0] == modes.n_landmarks
    for landmark, row in enumerate(table):
        places = row[row != FREE].tolist()
        expected = [p for p, owner in enumerate(modes.landmark) if owner == landmark and estimate.known[p]]
        assert places == expected
        assert (row[len(places) :] == FREE).all()


@given(books(), st.integers(0, 6))
def test_new_modes_take_free_rows_first_and_leave_no_gap(book: tuple[Modes, Estimate], count: int):
    modes, _ = book
    rows = modes.rows_for(count)
    more = modes.with_owner(rows, 0)
    assert len(set(rows.tolist())) == count
    assert (more.landmark[rows] == 0).all()
    others = np.setdiff1d(np.arange(len(modes.landmark)), rows)
    np.testing.assert_array_equal(more.landmark[others], modes.landmark[others])
    free = int((modes.landmark == FREE).sum())
    assert len(more.landmark) == len(modes.landmark) + max(0, count - free)


def test_grown_problems_keep_their_priors():
    world = make_world(1, n_mapped=3)
    problem, estimate = grown(world.problem, world.truth, 8)
    np.testing.assert_array_equal(problem.mapped, [True] * 3 + [False] * 5)
    np.testing.assert_array_equal(
        problem.landmark_information[:10, :10].toarray(), world.problem.landmark_information.toarray()
    )
    assert estimate.known.tolist() == [True] * 5 + [False] * 3
    assert grown(problem, estimate, 8) == (problem, estimate)
