"""The alternation of selector and least squares, against the same problem with all modes told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moving import FAR, MovingWorld, make_moving_world, model_of
from problems import make_world

from evermap.slam.problem import Estimate, padded
from evermap.slam.smoother import Smoother
from evermap_studies.nielsen2024.modes.alternation import Explanation, explain_with_modes
from evermap_studies.nielsen2024.modes.changes import switches
from evermap_studies.nielsen2024.modes.places import FREE, Modes
from evermap_studies.nielsen2024.selectors.chain import ModeChain, ModeLooks, log_joint
from evermap_studies.nielsen2024.selectors.protocol import Selection

SEED = 5
TRIED = [SEED, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(SEED + 1, SEED + 6))]
"""Seeds, of which the quick tests try two."""
CHAINED = ("em", "mcts", "viterbi")


def explain(moving: MovingWorld, method: str, *, seed: int = 0, **settings: object) -> Explanation:
    """As a session does it: first with the kernel that never lets go, then with the mixture."""
    model, rng = model_of(method, **settings), np.random.default_rng(seed)
    modes = Modes.one_each(len(moving.problem.landmark_mean))
    start = moving.static_optimum()
    near = explain_with_modes(moving.problem, start, moving.world.noise, modes, model, rng, heavy=True)
    estimate = Smoother(near.problem, moving.world.noise).optimum(near.estimate)
    found = explain_with_modes(near.problem, estimate, moving.world.noise, near.modes, model, rng)
    return replace(found, estimate=Smoother(found.problem, moving.world.noise).optimum(found.estimate))


def pose_rmse_m(estimate: Estimate, moving: MovingWorld) -> float:
    off = estimate.pose[:, :2] - moving.world.truth.pose[:, :2]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def same_partition(a: np.ndarray, b: np.ndarray) -> bool:
    """Two assignments that differ by the names of the places only."""
    pairs = set(zip(a.tolist(), b.tolist(), strict=True))
    return len(pairs) == len(set(a.tolist())) == len(set(b.tolist()))


@pytest.mark.parametrize("seed", TRIED)
@pytest.mark.parametrize("method", ["em", pytest.param("viterbi", marks=pytest.mark.slow)])
def test_a_landmark_that_moved_far_is_found_as_if_told(method: str, seed: int):
    moving = make_moving_world(seed)
    found = explain(moving, method)
    told = moving.told_optimum()
    assert same_partition(found.problem.landmark_row, moving.told.landmark_row)
    (second,) = np.flatnonzero(found.modes.landmark == moving.moved)[1:]
    np.testing.assert_allclose(found.estimate.landmark[second], told.landmark[-1], atol=0.02)
    np.testing.assert_allclose(found.estimate.landmark[: len(told.landmark) - 1], told.landmark[:-1], atol=0.02)
    assert pose_rmse_m(found.estimate, moving) < 1.05 * pose_rmse_m(told, moving)


@pytest.mark.parametrize("seed", TRIED)
@pytest.mark.parametrize(
    "method", ["nn", *(pytest.param(name, marks=pytest.mark.slow) for name in ("max-mixture", "mcts"))]
)
def test_selectors_that_err_at_single_looks_find_both_places_too(method: str, seed: int):
    moving = make_moving_world(seed)
    found = explain(moving, method)
    told = moving.told_optimum()
    mine = moving.problem.landmark_row == moving.moved
    off = found.estimate.landmark[found.problem.landmark_row] - told.landmark[moving.told.landmark_row]
    assert (np.linalg.norm(off[mine], axis=1) < 1.0).mean() > 0.9
    assert pose_rmse_m(found.estimate, moving) < pose_rmse_m(told, moving) + 0.04


@pytest.mark.parametrize("method", CHAINED)
def test_in_a_static_world_nothing_moves(method: str):
    world = make_world(3, n_poses=80, n_landmarks=6, n_mapped=6)
    smoother = Smoother(world.problem, world.noise)
    estimate = smoother.optimum(world.near_truth(np.random.default_rng(0)))
    found = explain_with_modes(
        world.problem, estimate, world.noise, Modes.one_each(6), model_of(method), np.random.default_rng(0)
    )
    np.testing.assert_array_equal(found.problem.landmark_row, world.problem.landmark_row)
    assert set(found.modes.landmark[6:].tolist()) <= {FREE}
    assert switches(found, ModeChain()) == ()


@pytest.mark.parametrize("method", ["mcts", "nn", "viterbi"])
def test_same_seed_same_numbers(method: str):
    moving = make_moving_world(SEED, by=(0.25, 0.1))  # so near that the tree search has to guess
    one, other = explain(moving, method, seed=3), explain(moving, method, seed=3)
    np.testing.assert_array_equal(one.problem.landmark_row, other.problem.landmark_row)
    np.testing.assert_array_equal(one.estimate.pose, other.estimate.pose)


def test_the_change_is_dated_between_the_last_look_at_the_old_and_the_first_at_the_new():
    moving = make_moving_world(SEED)
    found = explain(moving, "viterbi")
    change, *others = switches(found, ModeChain())
    problem = moving.problem
    looks = problem.stamp_s[problem.pose_row[problem.landmark_row == moving.moved]]
    turn = problem.stamp_s[moving.since]
    assert others == []
    assert change.landmark_ids == (moving.moved,)
    assert change.stamp_from_s == looks[looks < turn].max()
    assert change.stamp_to_s == looks[looks >= turn].min()
    np.testing.assert_allclose(change.displacement_m, FAR, atol=0.3)
    assert change.probability > 0.99


def test_a_landmark_that_was_never_seen_where_the_map_has_it_moved_before_the_session():
    moving = make_moving_world(SEED)
    problem = moving.problem
    late = problem.pose_row >= moving.since
    problem = replace(
        problem,
        **{
            name: getattr(problem, name)[late | (problem.landmark_row != moving.moved)]
            for name in ("pose_row", "landmark_row", "reading", "sigma_given")
        },
    )
    moving = replace(moving, problem=problem)
    (change,) = switches(explain(moving, "viterbi"), ModeChain())
    assert np.isnan(change.stamp_from_s)
    assert change.stamp_to_s == problem.stamp_s[problem.pose_row[problem.landmark_row == moving.moved]].min()
    np.testing.assert_allclose(change.displacement_m, FAR, atol=0.4)


def test_a_false_birth_is_undone_by_merging():
    world = make_world(4, n_poses=60, n_landmarks=5)
    problem = world.problem
    optimum = Smoother(problem, world.noise).optimum(world.near_truth(np.random.default_rng(0)))
    half = (problem.landmark_row == 1) & (problem.pose_row > 25)
    torn = replace(
        problem,
        landmark_row=np.where(half, 5, problem.landmark_row),
        landmark_mean=np.vstack([problem.landmark_mean, np.zeros(2)]),
        landmark_information=padded(problem.landmark_information, 1),
    )
    start = replace(optimum, landmark=np.vstack([optimum.landmark, optimum.landmark[1]]))
    start = Smoother(torn, world.noise).optimum(start)
    assert np.linalg.norm(start.landmark[5] - start.landmark[1]) > 1e-3
    modes = Modes(np.array([0, 1, 2, 3, 4, 1]), 5)
    # a gate that nothing fails and switches that cost next to nothing: whatever unites the two, it is the merging
    model = replace(model_of("viterbi", gate_probability=1.0), chain=ModeChain(switch_probability=0.4))
    found = explain_with_modes(torn, start, world.noise, modes, model, np.random.default_rng(0))
    np.testing.assert_array_equal(found.problem.landmark_row, problem.landmark_row)
    assert len(found.modes.landmark) == len(found.estimate.landmark) == len(found.problem.landmark_mean) == 5
    np.testing.assert_allclose(found.estimate.pose, optimum.pose, atol=1e-3)


def test_one_outlier_is_no_mode():
    moving = make_moving_world(SEED, by=(0.0, 0.0))
    problem = moving.problem
    m = int(np.flatnonzero(problem.landmark_row == moving.moved)[7])
    reading = problem.reading.copy()
    reading[m, 0] += 2.0
    moving = replace(moving, problem=replace(problem, reading=reading))
    for method in CHAINED:
        found = explain(moving, method)
        assert np.bincount(found.problem.landmark_row)[len(problem.landmark_mean) :].sum() == 0


class Flipping:
    """Never content: every other look in the first mode and the rest in the second, then the other way round."""

    def __init__(self) -> None:
        self.asked: list[ModeLooks] = []

    def select(self, looks: ModeLooks, chain: ModeChain, rng: np.random.Generator, *, previous: object = None):
        del rng, previous
        self.asked.append(looks)
        indicator = (np.arange(len(looks.stamp_s)) + len(self.asked)) % 2
        return Selection(indicator, log_joint(looks, chain, indicator))


@pytest.mark.parametrize("rounds", [2, 10, 50])
def test_a_cycle_ends(rounds: int):
    moving = make_moving_world(SEED)
    modes = Modes(np.array([0, 1, 2, 3, 4, 5, 2]), 6)
    model = model_of("viterbi", gate_probability=1.0, births="gate")
    model = replace(model, selector=Flipping(), rounds=rounds)
    start = replace(moving.told_optimum(), pose=moving.static_optimum().pose)
    found = explain_with_modes(moving.told, start, moving.world.noise, modes, model, np.random.default_rng(0))
    assert not found.settled
    assert len(model.selector.asked) <= 3 * rounds


def test_max_mixture_selects_once_and_takes_no_notice_of_misses():
    moving = make_moving_world(SEED)
    once, often = Flipping(), Flipping()
    for method, selector in (("max-mixture", once), ("nn", often)):
        modes = Modes(np.array([0, 1, 2, 3, 4, 5, 2]), 6)
        model = replace(model_of(method, gate_probability=1.0), selector=selector)
        explain_with_modes(
            moving.told, moving.told_optimum(), moving.world.noise, modes, model, np.random.default_rng(0)
        )
    detections = int(np.isin(moving.told.landmark_row, [2, 6]).sum())
    assert len(once.asked[0].stamp_s) == detections
    assert len(often.asked[0].stamp_s) > detections
