"""Where a local map lies in a large one: right, or not said at all."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.geometry import se2, se3
from evermap.slam.association.constellation import LocalMap, list_agreed_pairs
from evermap.slam.association.place_index import PlaceIndex
from evermap_studies.sim.warehouse import WarehouseConfig, warehouse_landmarks

SIGMA_M, DENSITY, P = 0.03, 0.01, 0.97


def index_of(rng: np.random.Generator, true: np.ndarray, p_gone: float = 0.1) -> tuple[PlaceIndex, np.ndarray]:
    """Index of a survey that lacks some, and the landmarks it has."""
    there = np.flatnonzero(rng.random(len(true)) >= p_gone)
    position = true[there] + SIGMA_M * rng.normal(size=(len(there), 2))
    return PlaceIndex(position, np.tile(SIGMA_M**2 * np.eye(2), (len(there), 1, 1))), there


def local_map(
    rng: np.random.Generator, true: np.ndarray, count: int, p_new: float = 0.1
) -> tuple[LocalMap, np.ndarray]:
    """The landmarks around one of them in a frame of their own, some of them new; and which they are, -1 for new."""
    rows = np.argsort(np.hypot(*(true - true[rng.integers(len(true))]).T))[:count]
    place, name = true[rows].copy(), rows.copy()
    new = rng.random(count) < p_new
    place[new] = rng.uniform(place.min(axis=0), place.max(axis=0), (int(new.sum()), 2))
    name[new] = -1
    order = rng.permutation(count)
    anywhere = np.append(rng.uniform(-50.0, 50.0, 2), rng.uniform(-np.pi, np.pi))
    place = se2.transform(anywhere, place[order]) + SIGMA_M * rng.normal(size=(count, 2))
    return LocalMap(place, SIGMA_M**2 * np.eye(2 * count)), name[order]


def answers(index: PlaceIndex, there: np.ndarray, rng: np.random.Generator, world: np.ndarray, **local) -> np.ndarray:
    """(20, 2) pairs that were told, and those that are right, of local maps of a world."""
    told = []
    for _ in range(20):
        source, name = local_map(rng, world, **local)
        pairs = index.pairs(source, density=DENSITY, probability=P)
        told.append([len(pairs), sum(name[k] == there[m] for k, m in pairs)])
    return np.array(told)


@pytest.mark.parametrize("size", [300, 3000])
def test_a_local_map_is_found_or_it_is_said_that_it_was_not(size):
    rng = np.random.default_rng(size)
    true = warehouse_landmarks(WarehouseConfig(n_landmarks=size))
    index, there = index_of(rng, true)
    told = answers(index, there, rng, true, count=15)
    assert np.mean(told[:, 0] > 8) >= 0.9
    assert np.mean(told[told[:, 0] > 0, 1] == told[told[:, 0] > 0, 0]) >= 0.9
    assert np.all(told[:, 1] >= 0.8 * told[:, 0])


def test_a_place_that_the_map_lacks_is_not_found():
    rng = np.random.default_rng(1)
    index, there = index_of(rng, warehouse_landmarks(WarehouseConfig(n_landmarks=3000)))
    elsewhere = warehouse_landmarks(WarehouseConfig(n_landmarks=3000), seed=1)
    for count in (6, 10, 20):
        assert not answers(index, there, rng, elsewhere, count=count)[:, 0].any()


def test_where_the_map_repeats_itself_nothing_is_said():
    """Forty halls that are copies of each other, but for one landmark in each that stands anywhere."""
    rng = np.random.default_rng(2)
    hall = warehouse_landmarks(WarehouseConfig(n_landmarks=40))
    halls = np.concatenate([np.vstack([hall, rng.uniform(0, 20, (1, 2))]) + [60.0 * k, 0.0] for k in range(40)])
    index, there = index_of(rng, halls, p_gone=0.0)
    assert not answers(index, there, rng, halls, count=15)[:, 0].any()


def test_a_whole_session_is_laid_over_the_map_patch_by_patch():
    rng = np.random.default_rng(3)
    true = warehouse_landmarks(WarehouseConfig(n_landmarks=1000))
    index, there = index_of(rng, true)
    source, name = local_map(rng, true, count=150)
    pairs = index.pairs(source, density=DENSITY, probability=P)
    right = [name[k] == there[m] for k, m in pairs]
    known = np.isin(name, there).sum()
    assert np.mean(right) > 0.97
    assert sum(right) > 0.9 * known
    assert len({k for k, _ in pairs}) == len({m for _, m in pairs}) == len(pairs)


def test_it_agrees_with_trying_all():
    rng = np.random.default_rng(4)
    true = warehouse_landmarks(WarehouseConfig(n_landmarks=60))
    index, there = index_of(rng, true)
    everything = LocalMap(true[there], SIGMA_M**2 * np.eye(2 * len(there)))
    for _ in range(4):
        source, _ = local_map(rng, true, count=12)
        allowed = np.ones((len(source.place), len(there)), dtype=bool)
        tried = dict(list_agreed_pairs(source, everything, allowed, density=DENSITY, probability=P))
        mine = dict(index.pairs(source, density=DENSITY, probability=P))
        assert mine.items() >= {k: m for k, m in tried.items() if k in mine}.items()
        assert len(mine) >= len(tried) - 1


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_landmarks_say_nothing(count):
    rng = np.random.default_rng(5)
    index, _ = index_of(rng, warehouse_landmarks(WarehouseConfig(n_landmarks=200)))
    source = LocalMap(rng.uniform(0, 5, (count, 2)), np.eye(2 * count))
    assert index.pairs(source, density=DENSITY, probability=P) == []
    small = PlaceIndex(rng.uniform(0, 5, (count, 2)), np.tile(np.eye(2), (count, 1, 1)))
    assert small.pairs(local_map(rng, np.arange(20.0).reshape(10, 2), 8)[0], density=DENSITY, probability=P) == []


@pytest.mark.parametrize("seed", range(5))
def test_a_part_of_a_map_in_space_is_found_in_it(seed):
    """However it is turned; three of its landmarks are new."""
    rng = np.random.default_rng(seed)
    true, count = rng.uniform(0.0, 1.0, (80, 3)) * [25.0, 15.0, 4.0], 15
    rows = np.argsort(np.linalg.norm(true - true[seed], axis=1))[:count]
    place, anywhere = true[rows].copy(), se3.exp(rng.normal(0.0, [9.0, 9.0, 9.0, 1.0, 1.0, 1.0]))
    place[-3:] = rng.uniform(place.min(axis=0), place.max(axis=0), (3, 3))
    source = LocalMap(se3.transform(anywhere, place) + SIGMA_M * rng.normal(size=(count, 3)), 1e-3 * np.eye(3 * count))
    index = PlaceIndex(true, np.tile(SIGMA_M**2 * np.eye(3), (len(true), 1, 1)))
    motions = list(index.motions(source.place, source.beside_m))
    target = LocalMap(true, SIGMA_M**2 * np.eye(3 * len(true)))
    allowed = np.ones((count, len(true)), dtype=bool)
    pairs = list_agreed_pairs(source, target, allowed, density=DENSITY, probability=P, motions=motions)
    assert len(pairs) >= 9
    assert all(rows[k] == m for k, m in pairs if k < count - 3)
    assert all(k < count - 3 for k, _ in pairs)


def test_orientations_decide_between_the_two_sides_of_a_wall():
    """Points of a wall that are symmetric about its middle look the same after half a turn; tags on it do not."""
    at = np.array([[-3.0, 0.0, 0.5], [-1.8, 0.0, -0.4], [-0.7, 0.0, 0.9], [1.0, 0.0, -0.7], [2.2, 0.0, 0.3]])
    wall = np.vstack([at, at * [-1.0, 1.0, 1.0]])
    facing = np.tile([0.5, -0.5, 0.5, -0.5], (len(wall), 1))
    index = PlaceIndex(wall, np.tile(SIGMA_M**2 * np.eye(3), (len(wall), 1, 1)))
    motions = list(index.motions(wall, SIGMA_M))
    allowed = np.ones((len(wall), len(wall)), dtype=bool)
    found = []
    for rotation in (None, facing):
        target = LocalMap(wall, SIGMA_M**2 * np.eye(3 * len(wall)), rotation)
        found.append(list_agreed_pairs(target, target, allowed, density=DENSITY, probability=P, motions=motions))
    assert found[0] == []
    assert sorted(found[1]) == [(k, k) for k in range(len(wall))]
