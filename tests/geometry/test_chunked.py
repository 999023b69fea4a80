"""Covariances in chunks, against dense algebra."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag

from evermap.geometry import se2, se3
from evermap.geometry.chunked import ChunkedCovariance, Update, blocks, of_places, taken
from evermap.types import FloatArray, IntArray

in_plane_and_space = pytest.mark.parametrize("dim", [2, 3])


def warehouse(count: int, dim: int = 2, seed: int = 0) -> FloatArray:
    """Racks along y; in space on three levels."""
    rng = np.random.default_rng(seed)
    rows = np.arange(count)
    racks = np.column_stack([3.0 * (rows % 20), 6.0 * (rows // 20), 1.5 * (rows % 3)])[:, :dim]
    return racks + 0.2 * rng.normal(size=(count, dim))


def walked(count: int, dim: int = 2, seed: int = 0) -> FloatArray:
    return np.asarray(np.cumsum(2.0 * np.random.default_rng(seed).normal(size=(count, dim)), axis=0))


def bent(position_m: FloatArray, own_m: float = 0.02) -> FloatArray:
    """Errors that are shared by those around, and that turn the whole."""
    apart = np.linalg.norm(position_m[:, None] - position_m[None], axis=2)
    smooth = 0.5**2 * np.exp(-((apart / 60.0) ** 2)) + 0.05**2 * np.exp(-apart / 30.0) + own_m**2 * np.eye(len(apart))
    dim = position_m.shape[1]
    turn = (se2 if dim == 2 else se3).rigid_directions(position_m - position_m.mean(axis=0))
    turn = turn.reshape(dim * len(position_m), -1)[:, dim:]
    return np.asarray(np.kron(smooth, np.eye(dim)) + 0.01**2 * turn @ turn.T)


def relative_sigma(covariance_m2: FloatArray, a: IntArray, b: IntArray, dim: int) -> FloatArray:
    """Of the difference of points, by axis."""
    total = [
        covariance_m2[dim * a + k, dim * a + k]
        + covariance_m2[dim * b + k, dim * b + k]
        - 2.0 * covariance_m2[dim * a + k, dim * b + k]
        for k in range(dim)
    ]
    return np.sqrt(np.maximum(np.concatenate(total), 0.0))


def observed(covariance_m2: FloatArray, rows: IntArray, sigma_m: float, seed: int, dim: int) -> FloatArray:
    """The covariance after points were seen beside each other: differences of those that follow each other."""
    by = np.zeros((dim * (len(rows) - 1), len(covariance_m2)))
    order = np.random.default_rng(seed).permutation(rows) if seed else rows
    for k, (a, b) in enumerate(itertools.pairwise(order)):
        for axis in range(dim):
            by[dim * k + axis, dim * a + axis], by[dim * k + axis, dim * b + axis] = -1.0, 1.0
    spread = by @ covariance_m2 @ by.T + sigma_m**2 * np.eye(len(by))
    return np.asarray(covariance_m2 - covariance_m2 @ by.T @ np.linalg.solve(spread, by @ covariance_m2))


@in_plane_and_space
@pytest.mark.parametrize("points", [warehouse, walked])
def test_near_points_are_known_beside_each_other_as_in_the_dense_covariance(points: object, dim: int) -> None:
    assert callable(points)
    position = points(600, dim)
    dense = bent(position)
    chunked = ChunkedCovariance.of_dense(position, dense)
    assert chunked.flaw(600, dim) == ""
    assert "not of 600 places" in chunked.flaw(600, 5 - dim)
    assert sum(len(part.values) for part in chunked.parts) < 50 * dim**2 * len(position)
    np.testing.assert_allclose(blocks(chunked), blocks(dense, dim), atol=1e-12)
    found = chunked.of(np.arange(600))
    np.testing.assert_allclose(blocks(found, dim), blocks(dense, dim), atol=1e-9)
    assert np.linalg.eigvalsh(found).min() > -1e-9
    apart = np.linalg.norm(position[:, None] - position[None], axis=2)
    for low, high in ((0.0, 5.0), (5.0, 15.0), (15.0, 60.0)):
        a, b = np.nonzero((apart > low) & (apart <= high))
        ratio = relative_sigma(found, a, b, dim) / relative_sigma(dense, a, b, dim)
        assert 0.95 < np.median(ratio) < 1.05
        assert np.quantile(ratio, 0.01) > 0.85  # not surer than it should be


@in_plane_and_space
def test_a_few_points_of_one_place_are_as_in_the_dense_covariance(dim: int) -> None:
    position = warehouse(300, dim)
    dense = bent(position)
    chunked = ChunkedCovariance.of_dense(position, dense)
    rows = np.flatnonzero(chunked.chunk == 7)[::-1]
    np.testing.assert_allclose(of_places(chunked, rows), of_places(dense, rows, dim), atol=1e-9)


@in_plane_and_space
def test_points_are_taken_in_another_order_and_without_some(dim: int) -> None:
    position = warehouse(300, dim)
    chunked = ChunkedCovariance.of_dense(position, bent(position))
    order = np.random.default_rng(1).permutation(300)
    other = taken(chunked, order)
    assert isinstance(other, ChunkedCovariance)
    np.testing.assert_allclose(other.of(np.arange(300)), chunked.of(order), atol=1e-9)
    fewer = taken(chunked, np.arange(20, 300))
    assert isinstance(fewer, ChunkedCovariance)
    assert fewer.flaw(280, dim) == ""
    np.testing.assert_allclose(fewer.each_m2, chunked.each_m2[20:], atol=0.0)
    assert sum(a is b for a, b in zip(fewer.parts, chunked.parts, strict=True)) > len(chunked.parts) // 2


@in_plane_and_space
def test_what_nobody_was_near_is_not_written_again(dim: int) -> None:
    position = warehouse(1000, dim)
    chunked = ChunkedCovariance.of_dense(position, bent(position))
    near = np.flatnonzero(position[:, 1] < 40.0)
    same = chunked.updated(Update(position, np.arange(1000), near, chunked.of(near)))
    np.testing.assert_array_equal(same.pair, chunked.pair)
    np.testing.assert_allclose(same.each_m2, chunked.each_m2, atol=1e-9)
    kept = sum(a is b for a, b in zip(same.parts, chunked.parts, strict=True))
    assert kept > 0.6 * len(chunked.parts)


@in_plane_and_space
def test_what_is_learned_in_one_place_is_as_if_all_had_been_learned(dim: int) -> None:
    """The middle of a large map is driven through; inside of what is near the result is that of the dense map."""
    position = warehouse(600, dim)
    dense = bent(position)
    near = np.flatnonzero((position[:, 1] > 40.0) & (position[:, 1] < 120.0))
    seen = near[(position[near, 1] > 55.0) & (position[near, 1] < 105.0)]
    exact = observed(dense, seen, 0.03, seed=0, dim=dim)
    chunked = ChunkedCovariance.of_dense(position, dense)
    local = observed(chunked.of(near), np.searchsorted(near, seen), 0.03, seed=0, dim=dim)
    after = chunked.updated(Update(position, np.arange(600), near, local))
    found = after.of(np.arange(600))
    assert np.linalg.eigvalsh(found).min() > -1e-9
    apart = np.linalg.norm(position[:, None] - position[None], axis=2)
    inside = np.zeros(600, dtype=np.bool_)
    inside[seen] = True
    a, b = np.nonzero((apart > 0.0) & (apart < 15.0) & inside[:, None] & inside[None])
    ratio = relative_sigma(found, a, b, dim) / relative_sigma(exact, a, b, dim)
    assert 0.95 < np.median(ratio) < 1.1
    assert np.quantile(ratio, 0.01) > 0.85


@in_plane_and_space
def test_new_points_join_their_neighbours_and_chunks_are_halved(dim: int) -> None:
    position = warehouse(400, dim)
    dense = bent(position)
    old, near = np.arange(360), np.arange(300, 400)
    chunked = ChunkedCovariance.of_dense(position[old], of_places(dense, old, dim))
    was = np.where(np.arange(400) < 360, np.arange(400), -1)
    after = chunked.updated(Update(position, was, near, of_places(dense, near, dim)))
    assert after.flaw(400, dim) == ""
    assert np.bincount(after.chunk).max() <= 12
    assert len(after.parent) > len(chunked.parent)
    found = after.of(np.arange(330, 400))
    exact = of_places(dense, np.arange(330, 400), dim)
    np.testing.assert_allclose(blocks(found, dim), blocks(exact, dim), atol=1e-9)
    rows = np.flatnonzero(after.chunk == after.chunk[399])
    np.testing.assert_allclose(after.of(rows), of_places(dense, rows, dim), atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**16), st.sampled_from([2, 3]))
def test_it_stays_a_covariance_whatever_is_learned(seed: int, dim: int) -> None:
    """Points come, go and are learned, time after time: every small group has a covariance that is one."""
    rng = np.random.default_rng(seed)
    position = walked(200, dim, seed)
    chunked = ChunkedCovariance.of_dense(position, bent(position))
    for _ in range(4):
        middle = position[rng.integers(len(position))]
        kept = np.sort(rng.permutation(len(position))[: len(position) - 3])
        n_new = int(rng.integers(0, 15))
        after_m = np.vstack([position[kept], middle + 3.0 * rng.normal(size=(n_new, dim))])
        was = np.append(kept, np.full(n_new, -1))
        near = np.flatnonzero((np.linalg.norm(after_m - middle, axis=1) < 12.0) | (was < 0))
        known = near[was[near] >= 0]
        joint = 0.3 * np.eye(dim * len(near))
        at = se2.xy_rows(np.searchsorted(near, known), dim)
        joint[np.ix_(at, at)] = chunked.of(was[known])
        joint = observed(joint, np.arange(len(near)), 0.05, seed=seed + 1, dim=dim) if len(near) > 1 else joint
        chunked = chunked.updated(Update(after_m, was, near, joint))
        assert chunked.flaw(len(after_m), dim) == ""
        rows = np.searchsorted(near, near)
        np.testing.assert_allclose(chunked.each_m2[near], blocks(joint, dim)[rows], atol=1e-9)
        position = after_m
        some = rng.permutation(len(position))[:40]
        assert np.linalg.eigvalsh(chunked.of(some)).min() > -1e-8


@pytest.mark.parametrize("dim", [2, 3])
def test_independent_points_are_cut_as_their_dense_covariance_is(dim: int) -> None:
    rng = np.random.default_rng(dim)
    position, root = rng.uniform(0.0, 100.0, (700, dim)), rng.normal(size=(700, dim, dim))
    each = root @ root.transpose(0, 2, 1)
    dense = ChunkedCovariance.of_dense(position, block_diag(*each))
    found = ChunkedCovariance.of_independent(position, each)
    np.testing.assert_array_equal(found.chunk, dense.chunk)
    np.testing.assert_array_equal(found.each_m2, each)
    for mine, theirs in zip(found.parts, dense.parts, strict=True):
        np.testing.assert_array_equal(mine.values, theirs.values)
