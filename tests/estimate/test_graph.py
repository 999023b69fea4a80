"""A graph's layout, and the factors of a block by their shapes, against dense matrices."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.estimate.graph import Layout, build_structure
from evermap.estimate.sparse.system import exhaust
from evermap.types import IntArray


class Block(NamedTuple):
    """Factors of any shape."""

    ties: IntArray
    rows: IntArray
    pose: IntArray

    def linearise(self, state, out):
        """It has no values of its own."""
        raise AssertionError


def make_structure():
    """Five poses, places with and without an orientation, a border of two variables."""
    layout = Layout.of(np.arange(10.0).reshape(5, 2), 6, [6, 3, 6], [7, 1], 2)
    steps = Block(np.column_stack([np.arange(4), np.arange(1, 5), np.full(4, 9)]), np.full(4, 6), np.arange(4))
    place, pose = np.array([5, 6, 7, 6, 5, 7]), np.array([0, 1, 1, 2, 4, 4])
    seen = Block(np.column_stack([pose, place, np.full(6, 8)]), np.array([6, 3, 8, 3, 8, 6]), pose)
    none = Block(np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    return (steps, seen, none), exhaust(build_structure(layout, (steps, seen, none)))


def test_a_layout_has_poses_then_places_then_the_border():
    layout = make_structure()[1].layout
    assert layout.dim.tolist() == [6] * 5 + [6, 3, 6, 7, 1]
    assert layout.border.tolist() == [8, 9]
    assert layout.leaf_of_pose.tolist() == [0, 0, 1, 1, 1]
    assert np.array_equal(layout.coordinate[:, 1:], np.arange(10.0).reshape(5, 2))


def test_places_alone_are_held():
    held = make_structure()[1].hold_places(0.5)
    assert held.tolist() == [0.0] * 30 + [0.5] * 15 + [0.0] * 8


def test_alike_factors_times_numbers_are_those_of_the_dense_jacobian():
    blocks, structure = make_structure()
    random, tree = np.random.default_rng(0), structure.system.tree
    values, numbers = random.normal(size=tree.value_first[-1]), random.normal(size=(tree.begin[-1], 2))
    for k, block in enumerate(blocks):
        alike = structure.alike(k)
        assert sorted(row for one in alike for row in one.factor.tolist()) == list(range(len(block.rows)))
        for one in alike:
            found = one.multiply(values, numbers)
            for at, factor in enumerate(one.factor.tolist()):
                own = tree.value_first[structure.first[k] + factor + np.arange(2)]
                dense = values[own[0] : own[1]].reshape(block.rows[factor], -1)
                columns = np.concatenate([np.arange(*tree.begin[[v, v + 1]]) for v in block.ties[factor]])
                np.testing.assert_allclose(found[at], dense[:, :-1] @ numbers[columns], atol=1e-12)
                np.testing.assert_array_equal(values[one.right[at]], dense[:, -1])
    assert sorted(one.factor.tolist() for one in structure.alike(1)) == [[0, 5], [1, 3], [2, 4]]
    assert structure.alike(2) == []
