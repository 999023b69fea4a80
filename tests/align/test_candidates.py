"""A robot finds its place in a map of which a part is no longer true."""

import itertools

import numpy as np
import pytest

from evermap.align import candidates
from evermap.align.candidates import AGREE_M, Matches, find_consensus, rank_motions, score_motions
from evermap.geometry import se2, se3
from evermap.geometry.rigid import rigid


@pytest.mark.parametrize("seed", range(8))
def test_the_motion_of_the_majority_is_found_whatever_the_others_do(seed):
    rng = np.random.default_rng(seed)
    target = rng.uniform(-8, 8, (11, 2))
    pose = np.array([*rng.uniform(-5, 5, 2), rng.uniform(-np.pi, np.pi)])
    source = se2.transform(se2.inverse(pose), target)
    moved = rng.permutation(11)[:5]
    source[moved] += rng.uniform(2, 9, (5, 1)) * np.array([1.0, -1.0])
    found, agree = find_consensus(Matches.of(source, target))
    assert np.flatnonzero(~agree).tolist() == sorted(moved)
    assert se2.log(se2.between(pose, found)) == pytest.approx(np.zeros(3), abs=1e-9)


@pytest.mark.parametrize("seed", range(30))
def test_the_answer_is_that_of_one_pair_after_the_other(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 14))
    target = rng.uniform(-4, 4, (count, 2))
    source = se2.transform(rng.uniform(-3, 3, 3), target + rng.normal(0, 0.25, (count, 2)))
    source[rng.random(count) < 0.4] += rng.normal(0, 1, 2)
    best, best_score = np.zeros(count, dtype=np.bool_), 0.0
    for pair in itertools.combinations(range(count), 2):
        a, b = source[list(pair)], target[list(pair)]
        span = np.linalg.norm(b[0] - b[1])
        if span >= AGREE_M and abs(span - np.linalg.norm(a[0] - a[1])) <= AGREE_M:
            gap = np.linalg.norm(se2.transform(rigid(a, b), source) - target, axis=1)
            score = np.maximum(1.0 - (gap / AGREE_M) ** 2, 0.0).sum()
            if score > best_score:
                best, best_score = gap < AGREE_M, score
    found, agree = find_consensus(Matches.of(source, target))
    assert agree.tolist() == best.tolist()
    assert found == pytest.approx(rigid(source[best], target[best]) if best.any() else np.zeros(3), abs=1e-9)


def test_noise_is_averaged_over_all_that_agree():
    rng = np.random.default_rng(0)
    target = rng.uniform(-8, 8, (30, 2))
    found, agree = find_consensus(Matches.of(target + rng.normal(0, 0.05, target.shape), target))
    assert agree.all()
    assert np.abs(found[:2]).max() < 4 * 0.05 / np.sqrt(30)


def test_nothing_agrees_where_no_two_distances_match():
    source = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
    _, agree = find_consensus(Matches.of(source, 5 * source))
    assert not agree.any()


@pytest.mark.parametrize("count", [300, 1200])
def test_a_large_map_is_laid_over_another_of_which_half_has_moved(count):
    rng = np.random.default_rng(1)
    target = rng.uniform(-1, 1, (count, 2)) * np.sqrt(count)
    pose = np.array([20.0, -3.0, 2.0])
    source = se2.transform(se2.inverse(pose), target + rng.normal(0, 0.03, target.shape))
    moved = np.argsort(-np.linalg.norm(target, axis=1))[: count // 2]  # all the far ones
    source[moved] += rng.uniform(1.0, 3.0, (count // 2, 1)) * [1.0, 0.0]
    found, agree = find_consensus(Matches.of(source, target))
    assert agree[np.setdiff1d(np.arange(count), moved)].all()
    assert np.abs(se2.log(se2.between(pose, found))).max() < 0.05


def test_a_landmark_of_several_known_places_agrees_at_the_one_where_it_stands():
    rng = np.random.default_rng(2)
    sites = rng.uniform(-8, 8, (12, 3, 2))
    stands = rng.integers(0, 3, 12)
    pose = np.array([3.0, 1.0, -1.0])
    seen = se2.transform(se2.inverse(pose), sites[np.arange(12), stands])
    order = rng.permutation(36)
    rows = np.repeat(np.arange(12), 3)[order]
    found, agree = find_consensus(Matches.of(seen[rows], sites.reshape(-1, 2)[order], landmark=rows))
    assert np.flatnonzero(agree).tolist() == np.flatnonzero(np.tile(np.arange(3), 12)[order] == stands[rows]).tolist()
    assert found == pytest.approx(pose, abs=1e-9)


def test_a_landmark_counts_once_however_many_places_near_each_other_it_has():
    target = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0], [0.1, 0.0], [0.0, 0.1], [0.2, 0.0]])
    moved = np.array([[0.0, 0.0], [4.0, 0.0], [9.0, 9.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    moved[2] = [0.0, 3.0]
    _, agree = find_consensus(Matches.of(moved, target, landmark=np.array([7, 5, 6, 7, 7, 7])))
    assert agree.tolist() == [True, True, True, False, False, False]


def test_what_is_surely_there_outweighs_many_that_are_hardly_believed():
    rng = np.random.default_rng(3)
    target = rng.uniform(-8, 8, (20, 2))
    true, false = np.array([1.0, 2.0, 0.5]), np.array([-4.0, 0.0, 2.5])
    source = np.vstack([se2.transform(se2.inverse(true), target[:8]), se2.transform(se2.inverse(false), target[8:])])
    found, _ = find_consensus(Matches.of(source, target))
    assert found == pytest.approx(false, abs=1e-9)
    found, agree = find_consensus(Matches.of(source, target, weight=np.where(np.arange(20) < 8, 0.9, 0.1)))
    assert found == pytest.approx(true, abs=1e-9)
    assert agree.sum() >= 8
    _, agree = find_consensus(Matches.of(source, target, weight=np.zeros(20)))
    assert not agree.any()


def moved_world(seed: int, *, moved: int, count: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Landmarks (K, 3) of a session, their places in the map, the motion between them, and which were moved."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(-8.0, 8.0, (count, 3))
    motion = se3.exp(rng.normal(0.0, 1.5, 6) * [3.0, 3.0, 3.0, 1.0, 1.0, 1.0])
    source = se3.transform(se3.inverse(motion), target)
    gone = np.sort(rng.permutation(count)[:moved])
    source[gone] += rng.normal(0.0, 1.0, (moved, 3)) + rng.choice([-4.0, 4.0], (moved, 3))
    return source, target, motion, gone


@pytest.mark.parametrize("seed", range(12))
def test_in_space_the_motion_is_found_though_half_of_the_landmarks_were_moved(seed) -> None:
    source, target, motion, gone = moved_world(seed, moved=6)
    found, agree = find_consensus(Matches.of(source, target))
    assert np.flatnonzero(~agree).tolist() == gone.tolist()
    assert se3.local(motion, found) == pytest.approx(np.zeros(6), abs=1e-9)


def test_one_oriented_landmark_tells_the_motion_and_the_likelier_explanation_wins() -> None:
    motion, place = se3.exp(np.array([1.0, 2.0, 3.0, 0.3, -0.2, 0.9])), se3.exp(np.array([4.0, 1, 0, 0, 0, 1.0]))
    right = se3.compose(se3.inverse(motion), place)
    flipped = se3.compose(right, se3.exp(np.array([0, 0, 0, 1.1, 0, 0])))
    source, target, same = np.stack([flipped, right]), np.stack([place, place]), np.zeros(2, dtype=np.int64)
    found, agree = find_consensus(Matches.of(source, target, landmark=same, log_prior=np.array([-2.0, 0.0])))
    assert agree.tolist() == [False, True]
    assert se3.local(motion, found) == pytest.approx(np.zeros(6), abs=1e-9)
    point = np.append(se3.transform(se3.inverse(motion), np.array([0.0, 5.0, 1.0])), [np.nan] * 4)
    source = np.stack([flipped, right, point])
    target = np.stack([place, place, np.array([0.0, 5.0, 1.0, *[np.nan] * 4])])
    # what else is seen overrules the prior
    found, agree = find_consensus(
        Matches.of(source, target, landmark=np.array([0, 0, 1]), log_prior=np.array([0.0, -2.0, 0.0]))
    )
    assert agree.tolist() == [False, True, True]
    assert score_motions(motion[None], Matches.of(source, target, landmark=np.array([0, 0, 1]))) == pytest.approx(2.0)


def test_different_motions_are_ranked_by_who_agrees() -> None:
    """Seven stand and five were moved as one: two motions, not twelve ones of nearly the same."""
    rng = np.random.default_rng(4)
    target = rng.uniform(-8, 8, (12, 2))
    one, other = np.array([1.0, 2.0, 0.5]), np.array([-4.0, 0.0, 2.5])
    source = np.vstack([se2.transform(se2.inverse(one), target[:7]), se2.transform(se2.inverse(other), target[7:])])
    source += rng.normal(0.0, 0.03, source.shape)
    (first, stand), (second, moved) = rank_motions(Matches.of(source, target))
    assert first == pytest.approx(one, abs=0.05)
    assert second == pytest.approx(other, abs=0.05)
    assert stand.tolist() == [True] * 7 + [False] * 5
    assert moved[7:].all()


@pytest.mark.parametrize("seed", range(3))
def test_a_large_map_is_found_by_the_few_that_stand(seed) -> None:
    """One of 25 of 3,000 landmarks stands: the samples of pairs and of landmarks still have enough of them."""
    rng = np.random.default_rng(seed)
    target, motion = rng.uniform(-80, 80, (3000, 2)), np.array([30.0, -20.0, 2.0])
    source, stand = se2.transform(se2.inverse(motion), target), rng.random(3000) < 0.04
    source[~stand] = rng.uniform(-80, 80, (int((~stand).sum()), 2))
    found, agree = find_consensus(Matches.of(source, target))
    assert found == pytest.approx(motion, abs=0.05)
    assert agree[stand].mean() > 0.95


def test_the_search_for_the_motion_grows_in_proportion_to_the_map(monkeypatch) -> None:
    """Distances and comparisons for a map of four times the landmarks: four times as many, not sixteen."""
    worked = 0
    distances, fit = candidates._distances, candidates._fit

    def measured(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        nonlocal worked
        worked += len(a) * len(b)
        return distances(a, b)

    def compared(motion: np.ndarray, matches: Matches, agree_m: float) -> np.ndarray:
        nonlocal worked
        worked += len(motion) * len(matches)
        return fit(motion, matches, agree_m)

    monkeypatch.setattr(candidates, "_distances", measured)
    monkeypatch.setattr(candidates, "_fit", compared)
    work, rng = [], np.random.default_rng(0)
    for count in (2000, 8000):
        worked, target = 0, rng.uniform(-80, 80, (count, 2))
        rank_motions(Matches.of(target + rng.normal(0.0, 0.05, target.shape), target))
        work.append(worked)
    assert work[1] < 5 * work[0]
