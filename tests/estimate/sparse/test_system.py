"""The sparse solver against dense algebra: any variables, any factors, any tree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evermap.errors import DataError, NumericalError
from evermap.estimate.sparse import system as sparse_system
from evermap.estimate.sparse.system import Factorised, System, exhaust
from evermap.estimate.sparse.tree import Factors

PLANE, SPACE = (3, 2, 9), (6, 3, 12)
"""Numbers of a pose, of a place, and of the calibration."""


class World:
    """A chain of poses that see places of a grid, all of them sharing calibration states, with random numbers."""

    def __init__(
        self, seed: int, n_poses: int, n_places: int, dims: tuple[int, int, int], leaf: int = 3, *, known: bool = False
    ) -> None:
        random = np.random.default_rng(seed)
        pose, place, shared = dims
        at_shared = n_poses + n_places
        ties = [[i, i + 1, at_shared] for i in range(n_poses - 1)]
        leaves = [i // leaf for i in range(n_poses - 1)]
        rows = [pose] * (n_poses - 1)
        for i in range(n_poses):
            # there and back again: places are seen by poses that are far from each other in time
            middle = n_places * (1 - abs(2 * i / max(n_poses - 1, 1) - 1))
            for j in sorted({int(np.clip(middle + by, 0, n_places - 1)) for by in random.integers(-2, 3, 3)}):
                ties.append([i, n_poses + j, at_shared])
                rows.append(place)
                leaves.append(min(i, max(n_poses - 2, 0)) // leaf)
        ties += [[0], *([n_poses + j] for j in range(n_places)), [at_shared]]
        rows += [pose, *[place] * n_places, shared]
        first_seen = {tie[1]: leaf for tie, leaf in reversed(list(zip(ties, leaves, strict=False)))}
        leaves += [0, *(first_seen.get(n_poses + j, 0) for j in range(n_places)), 0]
        if known:  # from a map, in which all places depend on each other
            ties.append(list(range(n_poses, n_poses + n_places)))
            rows.append(place * n_places)
            leaves.append(max(leaves) // 2)
        self.dim = np.array([pose] * n_poses + [place] * n_places + [shared])
        self.factors = Factors(
            np.append(0, np.cumsum([len(tie) for tie in ties])),
            np.concatenate(ties),
            np.array(rows),
            np.array(leaves),
        )
        n_leaves = max(leaves) + 1
        turn = np.abs(np.linspace(-1.0, 1.0, n_leaves))
        self.coordinate = np.column_stack([np.arange(n_leaves), turn])
        self.n_poses, self.n_places = n_poses, n_places
        self.begin = np.append(0, np.cumsum(self.dim))
        width = [sum(self.dim[tie]) for tie in ties]
        self.values = random.normal(size=sum(r * (w + 1) for r, w in zip(rows, width, strict=True)))
        self.extra = np.full(self.begin[-1], 0.1)

    def numbers(self, variables: np.ndarray) -> np.ndarray:
        return np.concatenate([np.arange(self.begin[v], self.begin[v + 1]) for v in variables])

    def dense(self) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Information, right side, and the Jacobian of every factor by all numbers."""
        size = self.begin[-1]
        information, right, jacobians = np.diag(self.extra), np.zeros(size), []
        at = 0
        for f, rows in enumerate(self.factors.rows):
            columns = self.numbers(self.factors.variable[self.factors.first[f] : self.factors.first[f + 1]])
            block = self.values[at : at + rows * (len(columns) + 1)].reshape(rows, -1)
            at += block.size
            jacobian = np.zeros((rows, size))
            jacobian[:, columns] = block[:, :-1]
            information += jacobian.T @ jacobian
            right += jacobian.T @ block[:, -1]
            jacobians.append(jacobian)
        return information, right, jacobians

    def solved(self, border: np.ndarray) -> Factorised:
        system = System(self.dim, self.factors, self.coordinate, border)
        return exhaust(system.factorised(self.values, extra=self.extra))


def close(found: np.ndarray, expected: np.ndarray) -> bool:
    return bool(np.abs(found - expected).max() <= 1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("large", [0.0, sparse_system.LARGE], ids=["all fronts by BLAS", "none"])
@pytest.mark.parametrize("dims", [PLANE, SPACE], ids=["plane", "space"])
@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10**6), n_poses=st.integers(1, 40), n_places=st.integers(1, 12), leaf=st.integers(1, 7))
def test_solution_and_covariances_are_those_of_dense_algebra(large, dims, seed, n_poses, n_places, leaf):
    world = World(seed, n_poses, n_places, dims, leaf)
    information, right, jacobians = world.dense()
    covariance = np.linalg.inv(information)
    shared = len(world.dim) - 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sparse_system, "LARGE", large)
        solved = world.solved(np.array([shared]))
    assert close(exhaust(solved.solution()), covariance @ right)
    assert solved.log_determinant == pytest.approx(np.linalg.slogdet(information)[1], rel=1e-9, abs=1e-9)
    spread = exhaust(solved.spread(n_poses - 1))
    for v, (first, last) in enumerate(zip(spread.own_first[:-1], spread.own_first[1:], strict=True)):
        mine = world.numbers([v])
        assert close(spread.own[first:last].reshape(len(mine), -1), covariance[np.ix_(mine, mine)])
    assert close(spread.with_border, covariance[:, world.numbers([shared])])
    for f, jacobian in enumerate(jacobians):
        first, last = spread.of_factors_first[f : f + 2]
        assert close(spread.of_factors[first:last].reshape(len(jacobian), -1), jacobian @ covariance @ jacobian.T)
    for i in range(n_poses - 1):
        assert close(spread.pairs[i], covariance[np.ix_(world.numbers([i]), world.numbers([i + 1]))])
    random = np.random.default_rng(seed)
    some = random.permutation(len(world.dim))[: random.integers(1, 6)]
    at = world.numbers(some)
    assert close(solved.joint(some), covariance[np.ix_(at, at)])
    by = random.normal(size=(3, 2, len(at)))
    assert close(solved.each(some, by), by @ covariance[np.ix_(at, at)] @ by.transpose(0, 2, 1))
    assert close(solved.columns(some), covariance[:, at])


@pytest.mark.parametrize("dims", [PLANE, SPACE])
@pytest.mark.parametrize("border", [[18], [0, 5, 11]], ids=["calibration", "poses"])
def test_another_right_side_is_solved_as_if_factorised_with_it(dims, border):
    world = World(7, 12, 6, dims)
    solved = world.solved(np.array(border))
    right = np.random.default_rng(1).normal(size=world.factors.rows.sum())
    before, (information, _, jacobians) = solved.own_right.copy(), world.dense()
    expected = np.linalg.solve(information, np.concatenate(jacobians).T @ right)
    other = solved.with_right(right)
    assert close(exhaust(other.solution()), expected)
    world.values = world.values.copy()
    world.values[solved.system.right_at] = right
    again = world.solved(np.array(border))
    assert close(other.own_right, again.own_right)
    assert close(other.right, again.right)
    assert close(other.information, again.information)
    assert np.array_equal(solved.own_right, before)


def test_places_that_all_depend_on_each_other_are_solved_as_by_dense_algebra():
    world = World(5, 30, 150, PLANE, known=True)
    information, right, _ = world.dense()
    covariance = np.linalg.inv(information)
    solved = world.solved(np.array([len(world.dim) - 1]))
    assert np.count_nonzero(solved.system._large) >= 2
    assert close(exhaust(solved.solution()), covariance @ right)
    spread = exhaust(solved.spread())
    own = [covariance[np.ix_(at, at)].ravel() for at in map(world.numbers, np.arange(len(world.dim))[:, None])]
    assert close(spread.own, np.concatenate(own))


@pytest.mark.parametrize("large", [0.0, sparse_system.LARGE], ids=["all fronts by BLAS", "none"])
def test_a_direction_that_rounding_alone_determines_ends_in_no_error_before_the_border(large, monkeypatch):
    """Both ways give the pivots that rounding made the same least size."""
    monkeypatch.setattr(sparse_system, "LARGE", large)
    world = World(7, 12, 4, PLANE)
    world.values[:] = 0.0
    world.extra[:] = 0.0
    solved = world.solved(np.array([len(world.dim) - 1]))
    with pytest.raises(NumericalError, match="do not determine"):
        exhaust(solved.solution())


@pytest.mark.parametrize("dims", [PLANE, SPACE], ids=["plane", "space"])
def test_a_border_of_places_is_what_is_left_when_poses_are_marginalised(dims):
    world = World(3, 20, 6, dims)
    information, right, _ = world.dense()
    border = np.arange(20, len(world.dim))
    kept, gone = world.numbers(border), world.numbers(np.arange(20))
    gain = np.linalg.solve(information[np.ix_(gone, gone)], information[np.ix_(gone, kept)]).T
    solved = world.solved(border)
    assert close(solved.information, information[np.ix_(kept, kept)] - gain @ information[np.ix_(gone, kept)])
    assert close(solved.right, right[kept] - gain @ right[gone])
    assert close(solved.border_covariance(), np.linalg.inv(information)[np.ix_(kept, kept)])


def test_work_in_slices_is_the_work_at_once(monkeypatch):
    world = World(5, 60, 10, PLANE)
    border = np.array([len(world.dim) - 1])
    at_once = world.solved(border)
    monkeypatch.setattr(sparse_system, "SLICE", 2e3)
    system = System(world.dim, world.factors, world.coordinate, border)
    slices = system.factorised(world.values, extra=world.extra)
    assert len(list(system.cuts(system.tree.own * system.tree.size**2))) > 20
    solved = exhaust(slices)
    assert np.array_equal(exhaust(solved.solution()), exhaust(at_once.solution()))
    assert np.array_equal(exhaust(solved.spread()).own, exhaust(at_once.spread()).own)


def test_fronts_stay_small_where_little_is_shared():
    """A corridor there and back: cut in time it would share every place, cut in space but two."""
    world = World(1, 400, 100, PLANE, leaf=5)
    tree = System(world.dim, world.factors, world.coordinate, np.array([500])).tree
    assert tree.size.max() < 80


def test_what_does_not_fit_into_memory_is_refused(monkeypatch):
    monkeypatch.setattr(sparse_system, "MEMORY_LIMIT_GB", 1e-6)
    with pytest.raises(DataError, match="need"):
        World(1, 20, 5, PLANE).solved(np.array([25]))


def test_a_border_that_nothing_determines_is_named():
    world = World(1, 5, 2, PLANE)
    world.values[:] = 0.0
    world.extra[world.numbers([7])] = 0.0
    with pytest.raises(NumericalError, match="do not determine"):
        exhaust(world.solved(np.array([7])).solution())
