"""Bodies by proximity and by how landmarks move, against numerical integrals and a simulated building's objects."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.spatial.distance import pdist
from scipy.stats import multivariate_normal

from evermap.geometry import se2
from evermap.maps.bodies import USUAL, Displacements, Fate, group, log_evidence_of_motion, regroup
from evermap.types import FloatArray, IntArray
from evermap_studies.sim import BuildingConfig, BuildingSimulation, simulate_building

REACH_M = 1.6
SIGMA_M = 0.02


def after_session(
    clique: list[int], fate: list[Fate], before: FloatArray, after: FloatArray, **options: object
) -> IntArray:
    """Of one class, seen to 2 cm at either time."""
    return regroup(
        np.array(clique), np.zeros(len(clique), dtype=np.int64), np.array(fate),
        Displacements(before, after, np.tile(2.0 * SIGMA_M**2 * np.eye(2), (len(clique), 1, 1))),
        reach_m=REACH_M, next_id=100, **options,
    )  # fmt: skip


def partition(label: IntArray) -> set[frozenset[int]]:
    return {frozenset(np.flatnonzero(label == name).tolist()) for name in np.unique(label)}


def test_cliques_are_of_one_class_and_no_larger_than_the_reach() -> None:
    rng = np.random.default_rng(0)
    position, kind = rng.uniform(0.0, 8.0, (80, 2)), rng.integers(-1, 3, 80)
    label = group(position, kind, reach_m=REACH_M)
    assert label.tolist() == [sorted(set(label.tolist()), key=label.tolist().index).index(name) for name in label]
    for body in partition(label):
        rows = np.array(sorted(body))
        assert len(np.unique(kind[rows])) == 1
        assert len(rows) == 1 or (kind[rows[0]] >= 0 and pdist(position[rows]).max() <= REACH_M)


def test_a_chain_of_neighbours_is_no_body() -> None:
    position = np.column_stack([np.arange(6.0), np.zeros(6)])
    assert len(partition(group(position, np.zeros(6, dtype=np.int64), reach_m=REACH_M))) == 3


def test_nothing_makes_no_cliques() -> None:
    assert group(np.zeros((0, 2)), np.zeros(0, dtype=np.int64), reach_m=REACH_M).shape == (0,)


@pytest.mark.parametrize("turn_rad", [0.0, 2.5])
def test_evidence_of_a_motion_is_the_integral_over_all(turn_rad: float) -> None:
    rng = np.random.default_rng(1)
    before = rng.normal(0.0, 0.5, (3, 2))
    root = rng.normal(size=(3, 2, 2))
    covariance = 4e-4 * (np.eye(2) + root @ root.transpose(0, 2, 1))
    after = se2.move_together(before, np.array([1.0, -0.5]), turn_rad) + rng.normal(0.0, SIGMA_M, (3, 2))
    arm = before - before.mean(axis=0)
    # given the turn, places are jointly normal: noise of their own, and one displacement for all
    spread = np.kron(np.ones((3, 3)), USUAL.move_sigma_m**2 * np.eye(2))
    for k in range(3):
        spread[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += covariance[k]

    def density(turn: float) -> float:
        mean = (before.mean(axis=0) + arm @ se2.rotation(turn).T).ravel()
        return float(multivariate_normal.pdf(after.ravel(), mean, spread)) / (2.0 * np.pi)

    truth = quad(density, turn_rad - 0.5, turn_rad + 0.5, points=[turn_rad], limit=200)[0]
    assert log_evidence_of_motion(before, after, covariance) == pytest.approx(np.log(truth), abs=0.02)


def test_evidence_of_a_pair_in_space_is_the_integral_over_all_its_directions() -> None:
    """A pair has no turn about its own line, so all that a motion leaves free is a direction: even on the sphere."""
    before = np.array([[0.0, 0.0, 0.0], [0.7, 0.0, 0.0]])
    after = np.array([[1.0, -0.5, 0.2], [1.0, 0.21, 0.22]])
    wide = np.eye(6) * SIGMA_M**2 + np.kron(np.ones((2, 2)), USUAL.move_sigma_m**2 * np.eye(3))
    way = after[1] - after[0]
    way /= np.linalg.norm(way)
    across = np.linalg.svd(way[None])[2][1:]

    def density(a: float, b: float) -> float:
        arm = 0.35 * (way * np.sqrt(1.0 - a * a - b * b) + a * across[0] + b * across[1])
        mean = before.mean(axis=0) + np.array([-arm, arm])
        area = 1.0 / np.sqrt(1.0 - a * a - b * b)
        return float(multivariate_normal.pdf(after.ravel(), mean.ravel(), wide)) * area / (4.0 * np.pi)

    truth = dblquad(density, -0.4, 0.4, -0.4, 0.4, epsrel=1e-3)[0]
    covariance = np.tile(SIGMA_M**2 * np.eye(3), (2, 1, 1))
    assert log_evidence_of_motion(before, after, covariance) == pytest.approx(np.log(truth), abs=0.02)


def test_evidence_of_many_bodies_is_that_of_each() -> None:
    rng = np.random.default_rng(4)
    for dim in (2, 3):
        before, after = rng.normal(size=(2, 5, 3, dim))
        root = rng.normal(size=(5, 3, dim, dim))
        covariance = 0.01 * (np.eye(dim) + root @ np.swapaxes(root, -1, -2))
        each = [float(log_evidence_of_motion(*one)) for one in zip(before, after, covariance, strict=True)]
        np.testing.assert_allclose(log_evidence_of_motion(before, after, covariance), each, rtol=1e-12)


def test_evidence_of_one_landmark_is_a_normal_density() -> None:
    before, after, covariance = np.zeros((1, 2)), np.array([[0.4, -1.0]]), np.array([[[0.03, 0.01], [0.01, 0.02]]])
    truth = multivariate_normal.logpdf(after[0], before[0], covariance[0] + USUAL.move_sigma_m**2 * np.eye(2))
    assert log_evidence_of_motion(before, after, covariance) == pytest.approx(truth, rel=1e-12)


CORNERS = np.array([[0.0, 0.0], [0.5, 0.0], [0.9, 0.1], [1.3, 0.2]])
STAYED, MOVED, GONE, UNSEEN = Fate.STAYED, Fate.MOVED, Fate.GONE, Fate.UNSEEN


def test_two_bodies_side_by_side_part_when_one_moves() -> None:
    after = CORNERS.copy()
    after[2:] = se2.move_together(CORNERS[2:], np.array([0.0, 1.0]), 0.3)
    assert partition(after_session([7] * 4, [STAYED, STAYED, MOVED, MOVED], CORNERS, after)) == {
        frozenset({0, 1}), frozenset({2, 3})
    }  # fmt: skip


def test_two_bodies_side_by_side_part_when_they_move_apart() -> None:
    after = np.concatenate([CORNERS[:2] + [0.0, -0.8], CORNERS[2:] + [0.7, 0.6]])
    assert partition(after_session([7] * 4, [MOVED] * 4, CORNERS, after)) == {frozenset({0, 1}), frozenset({2, 3})}


def test_a_body_that_moves_as_one_stays_one() -> None:
    after = se2.move_together(CORNERS, np.array([3.0, -2.0]), 1.0) + np.random.default_rng(0).normal(0, SIGMA_M, (4, 2))
    assert after_session([7] * 4, [MOVED] * 4, CORNERS, after).tolist() == [7] * 4


def test_what_moves_together_becomes_one_body_with_members_that_were_not_seen() -> None:
    after = se2.move_together(CORNERS, np.array([1.0, 0.5]), 0.4)
    label = after_session([3, 3, 5, 5], [MOVED, MOVED, MOVED, UNSEEN], CORNERS, after)
    assert len(set(label.tolist())) == 1


def test_what_moves_each_its_own_way_stays_apart() -> None:
    after = np.concatenate([CORNERS[:2] + [0.0, 0.4], se2.move_together(CORNERS[2:], np.array([0.1, 0.5]), 0.4)])
    assert after_session([3, 3, 5, 5], [MOVED] * 4, CORNERS, after).tolist() == [3, 3, 5, 5]


def test_one_landmark_that_is_missed_is_doubted_before_its_body_is() -> None:
    doubted = after_session([7] * 4, [STAYED, STAYED, STAYED, GONE], CORNERS, CORNERS, p_wrong=0.1)
    believed = after_session([7] * 4, [STAYED, STAYED, STAYED, GONE], CORNERS, CORNERS, p_wrong=1e-4)
    assert doubted.tolist() == [7] * 4
    assert believed.tolist() == [7, 7, 7, 100]


def test_what_was_not_seen_stays_with_the_larger_part() -> None:
    after = CORNERS.copy()
    after[3] += [0.0, 1.0]
    label = after_session([7] * 4, [STAYED, STAYED, UNSEEN, MOVED], CORNERS, after)
    assert label.tolist() == [7, 7, 7, 100]


@pytest.mark.slow
def test_bodies_of_a_simulated_building() -> None:
    """Pairs of landmarks on one object: by proximity at first, and never worse for what moves teach in four weeks."""
    first, last, unmoved, classless = np.zeros((4, 3))
    for seed in range(3):
        counts = pairs_in_building(seed)
        first += counts[0]
        last += counts[-1]
        unmoved += pairs_in_building(seed, moves=False)[-1]
        classless += pairs_in_building(seed, classes=False)[-1]
    for both, said, true in (first, last):
        assert both / said >= 0.9
        assert both / true >= 0.9
    assert last[0] / last[1] >= unmoved[0] / unmoved[1]
    assert last[0] / last[2] >= unmoved[0] / unmoved[2]
    # without classes only what moved together is known to belong together, and that is right
    assert classless[0] / classless[1] >= 0.99
    assert classless[0] / classless[2] >= 0.4


@cache
def four_weeks(seed: int) -> BuildingSimulation:
    return simulate_building(BuildingConfig(days=28, sessions_per_day=2, patrol_s=5.0), seed)


def pairs_in_building(seed: int, *, moves: bool = True, classes: bool = True) -> FloatArray:
    """(sessions, 3) pairs of known landmarks: rightly in one clique, in one clique, on one object."""
    building = four_weeks(seed)
    owner = {name: item for item in building.objects for name in item.landmark_ids}
    count = len(owner)
    true = np.array([owner[name].object_id for name in range(count)])
    kind = np.array([owner[name].class_id if classes else -1 for name in range(count)])
    noise = np.random.default_rng(seed)
    label, last, was_there = np.full(count, -1), np.zeros((count, 2)), np.zeros(count, dtype=np.bool_)
    result, next_id = [], 0
    for session in building.truths:
        seen = np.full((count, 2), np.nan)
        for stay in building.stays:
            if stay.start_s <= session.start_s < stay.end_s:
                item = building.objects[stay.object_id]
                seen[list(item.landmark_ids)] = item.landmarks_at(stay.pose)
        seen += noise.normal(0.0, SIGMA_M, seen.shape)
        there, known = np.isfinite(seen[:, 0]), label >= 0
        moved = known & there & (np.linalg.norm(seen - last, axis=1) > 5.0 * np.sqrt(2.0) * SIGMA_M)
        fate = np.select([moved, known & there, known & was_there], [MOVED, STAYED, GONE], UNSEEN)
        old, new = np.flatnonzero(known), np.flatnonzero(there & ~known)
        if moves and len(old):
            covariance = np.tile(2.0 * SIGMA_M**2 * np.eye(2), (len(old), 1, 1))
            label[old] = regroup(
                label[old],
                kind[old],
                fate[old],
                Displacements(last[old], seen[old], covariance),
                reach_m=REACH_M,
                next_id=next_id,
            )
        next_id = int(label.max()) + 1
        label[new] = next_id + group(seen[new], kind[new], reach_m=REACH_M)
        next_id = int(label.max()) + 1
        last[there], was_there = seen[there], there
        a, b = np.triu_indices(int((label >= 0).sum()), 1)
        rows = np.flatnonzero(label >= 0)
        together, on_one = label[rows][a] == label[rows][b], true[rows][a] == true[rows][b]
        result.append([(together & on_one).sum(), together.sum(), on_one.sum()])
    return np.array(result, dtype=np.float64)
