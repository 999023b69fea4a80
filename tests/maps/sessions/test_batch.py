"""Session after session against one estimate of all at once: poses that are marginalised are not lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from evermap.geometry import se2
from evermap.geometry.chunked import ChunkedCovariance, blocks, of_places
from evermap.maps.living import LivingMap
from evermap.maps.sessions.gaussian import anchored, own_landmarks
from evermap.maps.sessions.planar import laid, localised
from evermap.pipeline import bring_in, solve_alone
from evermap.slam.estimate import Solved
from evermap.types import FloatArray, IntArray

from .buildings import building, settings


def own(alone: Solved) -> tuple[IntArray, FloatArray, FloatArray]:
    """What a session says by itself: ids, positions in its own frame, and their joint covariance."""
    outcome = alone.outcome
    assert outcome.log_scale_sigma == 0.0, "the metre is known here"
    found = own_landmarks(outcome)
    return alone.prepared.landmark_id[found.row], found.position_m, found.covariance_m2


def whitening(covariance_m2: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance_m2)))


def test_two_sessions_one_after_the_other_are_both_at_once() -> None:
    """In three worlds: single numbers, and the root mean square of them all."""
    compared = [compare_with_both_at_once(seed) for seed in (1, 2, 5)]
    off, ratio = (np.concatenate(part) for part in zip(*compared, strict=True))
    assert np.abs(off).max() < 0.5
    assert np.sqrt(np.mean(off**2)) < 0.13
    # the second session is linearised in the map again, with calibration states that it holds less firmly there
    assert np.abs(ratio - 1.0).max() < 0.125
    assert np.sqrt(np.mean((ratio - 1.0) ** 2)) < 0.035


def compare_with_both_at_once(seed: int) -> tuple[FloatArray, FloatArray]:
    """Least squares over all landmarks and the motion between the sessions, each by itself a joint Gaussian.

    Returns differences of the map of both sessions from it [sigma], and ratios of standard deviations.
    """
    world = building(seed, days=2, change_rate=0.0)
    config = settings()
    first, second = (solve_alone(one, LivingMap(clock=one.clock), config) for one in world.sessions)
    begun = bring_in(first, LivingMap(clock=world.sessions[0].clock), config).living
    after = bring_in(second, begun, config).living
    names_a, at_a, spread_a = own(first)
    names_b, at_b, spread_b = own(second)
    everyone = np.union1d(names_a, names_b)
    np.testing.assert_array_equal(begun.places.landmark_id[np.argsort(begun.places.landmark_id)], names_a)
    where = laid(begun, begun.sites.p_here, second, own_landmarks(second.outcome), config.living)
    assert where is not None
    both = np.intersect1d(names_a, names_b)
    assert (where.place[np.isin(where.landmark_id, both)] >= 0).all()

    # unknown: where each landmark was on the first day, how far those met again are off on the second, and the motion
    a, b = (np.searchsorted(everyone, names) for names in (names_a, names_b))
    again = np.searchsorted(everyone, both)
    gauge = np.finfo(np.float64).eps ** 0.5 * np.eye(2 * len(names_a))  # an anchored covariance has no inverse
    white_a = whitening(anchored(at_a, spread_a) + gauge**2)
    white_b = whitening(spread_b)
    start = np.zeros((len(everyone), 2))
    start[b] = se2.transform(where.pose_map_session, at_b)
    start[a] = at_a
    size = start.size

    def residuals(x: FloatArray) -> FloatArray:
        landmark, drift, motion = x[:size].reshape(-1, 2), x[size:-3].reshape(-1, 2), x[-3:]
        now = landmark.copy()
        now[again] += drift * where.drift_m
        seen = se2.transform(se2.inverse(motion), now[b])
        return np.concatenate([white_a @ (landmark[a] - at_a).ravel(), drift.ravel(), white_b @ (seen - at_b).ravel()])

    guess = np.concatenate([start.ravel(), np.zeros(2 * len(both)), where.pose_map_session])
    solution = least_squares(residuals, guess, x_scale="jac", xtol=1e-12, ftol=1e-12)
    landmark, drift = solution.x[:size].reshape(-1, 2), solution.x[size:-3].reshape(-1, 2)
    landmark[again] += drift * where.drift_m
    covariance = np.linalg.inv(solution.jac.T @ solution.jac)
    to_now = np.eye(size, len(guess))
    to_now[np.column_stack([2 * again, 2 * again + 1]).ravel(), size + np.arange(2 * len(both))] = where.drift_m
    covariance = to_now @ covariance @ to_now.T

    order = np.argsort(after.places.landmark_id)
    known = np.isin(everyone, after.places.landmark_id)
    np.testing.assert_array_equal(after.places.landmark_id[order], everyone[known])
    sigma = np.sqrt(np.diag(covariance)).reshape(-1, 2)[known]
    off = (after.places.position_m[order] - landmark[known]) / sigma
    mine = np.sqrt(np.diag(after.covariance_m2)).reshape(-1, 2)[order]
    return off.ravel(), (mine / sigma).ravel()


def test_a_large_map_begins_in_chunks_without_the_joint_covariance_of_all() -> None:
    world = building(3, days=1, change_rate=0.0)
    outcome = solve_alone(world.sessions[0], LivingMap(clock=world.sessions[0].clock), settings()).outcome
    found = own_landmarks(outcome)
    columns = np.random.default_rng(0).normal(size=(2 * len(found.row), 4))
    np.testing.assert_allclose(
        outcome.graph_marginals.product(found.row, columns) * outcome.scale**2, found.covariance_m2 @ columns, rtol=1e-9
    )
    rows = np.arange(len(found.row))[1:]
    dense, chunked = (found.begun(rows, most_dense) for most_dense in (len(rows), 0))
    assert isinstance(chunked, ChunkedCovariance)
    np.testing.assert_allclose(chunked.each_m2, blocks(dense), rtol=1e-9, atol=1e-15)
    for c in range(len(chunked.parent)):
        mine = np.flatnonzero(chunked.chunk == c)
        np.testing.assert_allclose(chunked.of(mine), of_places(dense, mine), rtol=1e-6, atol=1e-12)


def test_a_session_that_fits_a_map_in_two_ways_is_not_entered_and_says_so() -> None:
    """Half of what the map has stands elsewhere, moved as one: which half is right is less sure than is asked for."""
    world, usual = building(1, days=2, change_rate=0.0), settings()
    first, second = (solve_alone(one, LivingMap(clock=one.clock), usual) for one in world.sessions)
    begun = bring_in(first, LivingMap(clock=world.sessions[0].clock), usual).living
    position = begun.places.position_m.copy()
    position[::2] = se2.transform(np.array([30.0, 4.0, 1.0]), position[::2])
    halved = replace(begun, places=replace(begun.places, position_m=position))
    overlay = usual.living.overlay.model_copy(update={"lead_nats": 200.0})
    strict = usual.model_copy(update={"living": usual.living.model_copy(update={"overlay": overlay})})
    assert localised(second, begun, strict).where is not None
    assert localised(second, halved, usual).where is not None
    found = localised(second, halved, strict)
    assert found.where is None
    assert found.reason[0].startswith("two places in the map fit about as well")
