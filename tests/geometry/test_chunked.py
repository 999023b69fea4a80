"""Covariances in chunks, against dense algebra."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evermap.geometry import se2
from evermap.geometry.chunked import ChunkedCovariance, Update, blocks, of_places, taken
from evermap.types import FloatArray, IntArray


def warehouse(count: int, seed: int = 0) -> FloatArray:
    rng = np.random.default_rng(seed)
    rows = np.arange(count)
    return np.column_stack([3.0 * (rows % 20), 6.0 * (rows // 20)]) + 0.2 * rng.normal(size=(count, 2))


def walked(count: int, seed: int = 0) -> FloatArray:
    return np.asarray(np.cumsum(2.0 * np.random.default_rng(seed).normal(size=(count, 2)), axis=0))


def bent(position_m: FloatArray, own_m: float = 0.02) -> FloatArray:
    """Errors that are shared by those around, and that turn the whole."""
    apart = np.linalg.norm(position_m[:, None] - position_m[None], axis=2)
    smooth = 0.5**2 * np.exp(-((apart / 60.0) ** 2)) + 0.05**2 * np.exp(-apart / 30.0) + own_m**2 * np.eye(len(apart))
    turn = se2.rigid_directions(position_m - position_m.mean(axis=0))[:, 2:]
    return np.asarray(np.kron(smooth, np.eye(2)) + 0.01**2 * turn @ turn.T)


def relative_sigma(covariance_m2: FloatArray, a: IntArray, b: IntArray) -> FloatArray:
    """Of the difference of points, by axis."""
    total = [
        covariance_m2[2 * a + k, 2 * a + k]
        + covariance_m2[2 * b + k, 2 * b + k]
        - 2.0 * covariance_m2[2 * a + k, 2 * b + k]
        for k in (0, 1)
    ]
    return np.sqrt(np.maximum(np.concatenate(total), 0.0))


def observed(covariance_m2: FloatArray, rows: IntArray, sigma_m: float, seed: int) -> FloatArray:
    """The covariance after points were seen beside each other: differences of those that follow each other."""
    by = np.zeros((2 * (len(rows) - 1), len(covariance_m2)))
    order = np.random.default_rng(seed).permutation(rows) if seed else rows
    for k, (a, b) in enumerate(itertools.pairwise(order)):
        for axis in (0, 1):
            by[2 * k + axis, 2 * a + axis], by[2 * k + axis, 2 * b + axis] = -1.0, 1.0
    spread = by @ covariance_m2 @ by.T + sigma_m**2 * np.eye(len(by))
    return np.asarray(covariance_m2 - covariance_m2 @ by.T @ np.linalg.solve(spread, by @ covariance_m2))


@pytest.mark.parametrize("points", [warehouse, walked])
def test_near_points_are_known_beside_each_other_as_in_the_dense_covariance(points: object) -> None:
    assert callable(points)
    position = points(600)
    dense = bent(position)
    chunked = ChunkedCovariance.of_dense(position, dense)
    assert sum(len(part.values) for part in chunked.parts) < 200 * len(position)
    np.testing.assert_allclose(blocks(chunked), blocks(dense), atol=1e-12)
    found = chunked.of(np.arange(600))
    np.testing.assert_allclose(blocks(found), blocks(dense), atol=1e-9)
    assert np.linalg.eigvalsh(found).min() > -1e-9
    apart = np.linalg.norm(position[:, None] - position[None], axis=2)
    for low, high in ((0.0, 5.0), (5.0, 15.0), (15.0, 60.0)):
        a, b = np.nonzero((apart > low) & (apart <= high))
        ratio = relative_sigma(found, a, b) / relative_sigma(dense, a, b)
        assert 0.95 < np.median(ratio) < 1.05
        assert np.quantile(ratio, 0.01) > 0.85  # not surer than it should be


def test_a_few_points_of_one_place_are_as_in_the_dense_covariance() -> None:
    position = warehouse(300)
    dense = bent(position)
    chunked = ChunkedCovariance.of_dense(position, dense)
    rows = np.flatnonzero(chunked.chunk == 7)[::-1]
    np.testing.assert_allclose(of_places(chunked, rows), of_places(dense, rows), atol=1e-9)


def test_points_are_taken_in_another_order_and_without_some() -> None:
    position = warehouse(300)
    chunked = ChunkedCovariance.of_dense(position, bent(position))
    order = np.random.default_rng(1).permutation(300)
    other = taken(chunked, order)
    assert isinstance(other, ChunkedCovariance)
    np.testing.assert_allclose(other.of(np.arange(300)), chunked.of(order), atol=1e-9)
    fewer = taken(chunked, np.arange(20, 300))
    assert isinstance(fewer, ChunkedCovariance)
    assert fewer.flaw(280) == ""
    np.testing.assert_allclose(fewer.each_m2, chunked.each_m2[20:], atol=0.0)
    assert sum(a is b for a, b in zip(fewer.parts, chunked.parts, strict=True)) > len(chunked.parts) // 2


def test_what_nobody_was_near_is_not_written_again() -> None:
    position = warehouse(1000)
    chunked = ChunkedCovariance.of_dense(position, bent(position))
    near = np.flatnonzero(position[:, 1] < 40.0)
    same = chunked.updated(Update(position, np.arange(1000), near, chunked.of(near)))
    np.testing.assert_array_equal(same.pair, chunked.pair)
    np.testing.assert_allclose(same.each_m2, chunked.each_m2, atol=1e-9)
    kept = sum(a is b for a, b in zip(same.parts, chunked.parts, strict=True))
    assert kept > 0.6 * len(chunked.parts)


def test_what_is_learned_in_one_place_is_as_if_all_had_been_learned() -> None:
    """The middle of a large map is driven through; inside of what is near the result is that of the dense map."""
    position = warehouse(600)
    dense = bent(position)
    near = np.flatnonzero((position[:, 1] > 40.0) & (position[:, 1] < 120.0))
    seen = near[(position[near, 1] > 55.0) & (position[near, 1] < 105.0)]
    exact = observed(dense, seen, 0.03, seed=0)
    chunked = ChunkedCovariance.of_dense(position, dense)
    local = observed(chunked.of(near), np.searchsorted(near, seen), 0.03, seed=0)
    after = chunked.updated(Update(position, np.arange(600), near, local))
    found = after.of(np.arange(600))
    assert np.linalg.eigvalsh(found).min() > -1e-9
    apart = np.linalg.norm(position[:, None] - position[None], axis=2)
    inside = np.zeros(600, dtype=np.bool_)
    inside[seen] = True
    a, b = np.nonzero((apart > 0.0) & (apart < 15.0) & inside[:, None] & inside[None])
    ratio = relative_sigma(found, a, b) / relative_sigma(exact, a, b)
    assert 0.95 < np.median(ratio) < 1.1
    assert np.quantile(ratio, 0.01) > 0.85


def test_new_points_join_their_neighbours_and_chunks_are_halved() -> None:
    position = warehouse(400)
    dense = bent(position)
    old, near = np.arange(360), np.arange(300, 400)
    chunked = ChunkedCovariance.of_dense(position[old], of_places(dense, old))
    was = np.where(np.arange(400) < 360, np.arange(400), -1)
    after = chunked.updated(Update(position, was, near, of_places(dense, near)))
    assert after.flaw(400) == ""
    assert np.bincount(after.chunk).max() <= 12
    assert len(after.parent) > len(chunked.parent)
    found = after.of(np.arange(330, 400))
    np.testing.assert_allclose(blocks(found), blocks(of_places(dense, np.arange(330, 400))), atol=1e-9)
    rows = np.flatnonzero(after.chunk == after.chunk[399])
    np.testing.assert_allclose(after.of(rows), of_places(dense, rows), atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**16))
def test_it_stays_a_covariance_whatever_is_learned(seed: int) -> None:
    """Points come, go and are learned, time after time: every small group has a covariance that is one."""
    rng = np.random.default_rng(seed)
    position = walked(200, seed)
    chunked = ChunkedCovariance.of_dense(position, bent(position))
    for _ in range(4):
        middle = position[rng.integers(len(position))]
        kept = np.sort(rng.permutation(len(position))[: len(position) - 3])
        n_new = int(rng.integers(0, 15))
        after_m = np.vstack([position[kept], middle + 3.0 * rng.normal(size=(n_new, 2))])
        was = np.append(kept, np.full(n_new, -1))
        near = np.flatnonzero((np.linalg.norm(after_m - middle, axis=1) < 12.0) | (was < 0))
        known = near[was[near] >= 0]
        joint = np.kron(np.eye(len(near)), 0.3 * np.eye(2))
        at = se2.xy_rows(np.searchsorted(near, known))
        joint[np.ix_(at, at)] = chunked.of(was[known])
        joint = observed(joint, np.arange(len(near)), 0.05, seed=seed + 1) if len(near) > 1 else joint
        chunked = chunked.updated(Update(after_m, was, near, joint))
        assert chunked.flaw(len(after_m)) == ""
        rows = np.searchsorted(near, near)
        np.testing.assert_allclose(chunked.each_m2[near], blocks(joint)[rows], atol=1e-9)
        position = after_m
        some = rng.permutation(len(position))[:40]
        assert np.linalg.eigvalsh(chunked.of(some)).min() > -1e-8
