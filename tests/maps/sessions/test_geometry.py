"""The joint Gaussian of a map after a session, against dense conditioning of everything at once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.geometry import se2
from evermap.maps.sessions.gaussian import anchored, drifted, of_places, with_session
from evermap.types import FloatArray, IntArray

seeds = st.integers(0, 2**32 - 1)


def spread(random: np.random.Generator, places: int, sigma_m: float = 0.05) -> FloatArray:
    """A joint covariance of places, strongly correlated."""
    factor = random.normal(size=(2 * places, 2 * places)) * sigma_m
    common = np.tile(np.eye(2), (places, 1)) * 4.0 * sigma_m
    return np.asarray(factor @ factor.T + common @ common.T)


def xy(rows: IntArray) -> IntArray:
    return np.column_stack([2 * rows, 2 * rows + 1]).ravel()


@given(seeds, st.integers(1, 6), st.integers(0, 3), st.sampled_from([0.0, 0.01, 0.08]))
def test_the_map_after_a_session_is_its_prior_times_what_the_session_says(
    seed: int, places: int, new: int, drift_m: float
) -> None:
    random = np.random.default_rng(seed)
    seen = random.permutation(places)[: random.integers(0, places + 1)]
    if not len(seen) + new:
        return
    mean, covariance = random.uniform(-9, 9, (places, 2)), spread(random, places)
    # the whole: where old places are now, of which the seen ones have drifted, and new ones that nobody knew
    now = covariance.copy()
    now[xy(seen), xy(seen)] += drift_m**2
    size = 2 * (places + new)
    prior_information = np.zeros((size, size))
    prior_information[: 2 * places, : 2 * places] = np.linalg.inv(now)
    said = np.concatenate([xy(seen), np.arange(2 * places, size)])
    factor = random.normal(size=(len(said), len(said) + 2)) / 0.1
    likelihood = factor @ factor.T
    measured = random.uniform(-9, 9, len(said))
    information = prior_information.copy()
    information[np.ix_(said, said)] += likelihood
    vector = prior_information[:, : 2 * places] @ mean.ravel()
    vector[said] += likelihood @ measured
    want_covariance = np.linalg.inv(information)
    want = want_covariance @ vector
    # a session knows of the map only the seen places: that must be enough
    own_information = likelihood.copy()
    own_vector = likelihood @ measured
    if len(seen):
        k = 2 * len(seen)
        held = np.linalg.inv(drifted(of_places(covariance, seen), drift_m))
        own_information[:k, :k] += held
        own_vector[:k] += held @ mean[seen].ravel()
    own_covariance = np.linalg.inv(own_information)
    own = own_covariance @ own_vector

    position, joint = with_session(mean, covariance, seen, own.reshape(-1, 2), own_covariance, drift_m)

    np.testing.assert_allclose(position.ravel(), want, atol=1e-6)
    np.testing.assert_allclose(joint, want_covariance, atol=1e-8)


@given(seeds, st.integers(2, 6))
def test_the_order_in_which_places_are_named_does_not_matter(seed: int, places: int) -> None:
    random = np.random.default_rng(seed)
    mean, covariance = random.uniform(-9, 9, (places, 2)), spread(random, places)
    seen = np.sort(random.permutation(places)[: random.integers(1, places + 1)])
    session, session_covariance = random.uniform(-9, 9, (len(seen) + 2, 2)), spread(random, len(seen) + 2, 0.01)
    position, joint = with_session(mean, covariance, seen, session, session_covariance, 0.02)

    order = random.permutation(places)  # of the map
    turn = np.concatenate([random.permutation(len(seen)), len(seen) + random.permutation(2)])  # of the session
    renamed, rejoined = with_session(
        mean[order],
        of_places(covariance, order),
        np.argsort(order)[seen][turn[: len(seen)]],
        session[turn],
        of_places(session_covariance, turn),
        0.02,
    )
    back = np.concatenate([order, places + turn[len(seen) :] - len(seen)])
    np.testing.assert_allclose(renamed, position[back], atol=1e-9)
    np.testing.assert_allclose(rejoined, of_places(joint, back), atol=1e-9)


def test_a_map_of_nothing_is_anchored_as_it_is() -> None:
    """Of a first session that takes all it saw for mistakes."""
    assert anchored(np.zeros((0, 2)), np.zeros((0, 0))).shape == (0, 0)


@given(seeds, st.integers(2, 8))
def test_an_anchored_map_neither_moves_nor_turns_as_a_whole(seed: int, places: int) -> None:
    random = np.random.default_rng(seed)
    at, covariance = random.uniform(-9, 9, (places, 2)), spread(random, places)
    held = anchored(at, covariance)
    middle = at - at.mean(axis=0)
    turning = np.column_stack([-middle[:, 1], middle[:, 0]]).ravel()
    for whole in (np.tile([1.0, 0.0], places), np.tile([0.0, 1.0], places), turning):
        assert abs(whole @ held @ whole) < 1e-9 * (whole @ whole)
    np.testing.assert_allclose(held, held.T, atol=1e-12)
    assert np.linalg.eigvalsh(held).min() > -1e-10


@given(seeds, st.integers(3, 8))
def test_an_anchored_map_knows_distances_and_angles_as_before(seed: int, places: int) -> None:
    """Whatever does not change when all is moved and turned has the variance that it had."""
    random = np.random.default_rng(seed)
    at, covariance = random.uniform(-9, 9, (places, 2)), spread(random, places)
    weight = random.normal(size=4)

    def shape(points: FloatArray) -> float:
        """Distances and an area, mixed."""
        a, b, c = points[0], points[1], points[-1]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        gaps = [float(np.linalg.norm(p - q)) for p, q in ((a, b), (b, c), (a, c))]
        return float(weight @ [*gaps, area])

    moved = se2.transform(np.array([1.0, -2.0, 0.7]), at)
    assert shape(moved) == pytest.approx(shape(at), abs=1e-9)
    step = 1e-6
    gradient = np.array(
        [(shape(at + d) - shape(at - d)) / (2 * step) for d in step * np.eye(2 * places).reshape(-1, places, 2)]
    )
    variance = gradient @ anchored(at, covariance) @ gradient
    assert variance == pytest.approx(gradient @ covariance @ gradient, rel=1e-4)


def test_a_place_that_nobody_saw_follows_those_it_was_seen_with() -> None:
    """By hand: two places on one shelf, both unsure by 1 m together and 0.01 m against each other."""
    both = np.array([[1.0, 0.9999], [0.9999, 1.0]])
    covariance = np.kron(both, np.eye(2))
    at = np.array([[0.0, 0.0], [2.0, 0.0]])
    position, joint = with_session(at, covariance, np.array([0]), np.array([[0.3, -0.2]]), 1e-6 * np.eye(2), 0.0)
    np.testing.assert_allclose(position, [[0.3, -0.2], [2.3, -0.2]], atol=1e-4)
    assert joint[2, 2] == pytest.approx(1.0 - 0.9999**2, abs=2e-6)
