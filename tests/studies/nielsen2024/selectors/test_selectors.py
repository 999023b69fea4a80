"""Every selector by one protocol: laws that all obey, and the tree search against the exact optimum."""

from __future__ import annotations

import numpy as np
import pytest
from brute_force import CHAINS, every_sequence, looks, of_landmark, random_looks
from hypothesis import given, settings
from hypothesis import strategies as st

from evermap.errors import ConfigError, NumericalError
from evermap_studies.nielsen2024.selectors.chain import ModeChain, ModeLooks, log_joint
from evermap_studies.nielsen2024.selectors.protocol import NAMES, Selector, selector_by_name
from evermap_studies.nielsen2024.selectors.tree_search import TreeSearch

chains = st.sampled_from(sorted(CHAINS))
names = st.sampled_from(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_selectors_follow_the_protocol(name):
    assert isinstance(selector_by_name(name), Selector)


def test_unknown_names_are_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"no selector 'joint'.*viterbi"):
        selector_by_name("joint")


@given(looks(), chains, names, st.integers(0, 1000))
def test_same_seed_same_selection_of_modes_that_exist(looks, chain, name, seed):
    selector = selector_by_name(name, mcts_budget=20)
    first, second = (selector.select(looks, CHAINS[chain], np.random.default_rng(seed)) for _ in range(2))
    np.testing.assert_array_equal(first.indicator, second.indicator)
    assert first.indicator.dtype == np.int64
    rows = np.arange(len(looks.stamp_s))
    assert np.isfinite(looks.log_likelihood[rows, first.indicator]).all()
    np.testing.assert_array_equal(first.log_joint, log_joint(looks, CHAINS[chain], first.indicator))


@settings(max_examples=settings.default.max_examples // 5)
@given(looks(longest=12), chains, st.integers(0, 1000))
def test_no_selector_exceeds_viterbi(looks, chain, seed):
    best = selector_by_name("viterbi").select(looks, CHAINS[chain], np.random.default_rng(0)).log_joint
    for name in NAMES:
        found = selector_by_name(name, mcts_budget=50).select(looks, CHAINS[chain], np.random.default_rng(seed))
        assert (found.log_joint <= best + 1e-9).all()


@given(looks(), chains)
def test_em_is_wrong_about_the_fewest_looks_to_be_expected(looks, name):
    """Against every sequence: none has a smaller expected number of wrong modes under the posterior."""
    chain = CHAINS[name]
    found = selector_by_name("em").select(looks, chain, np.random.default_rng(0)).indicator
    for row in range(looks.n_landmarks):
        rows, stamp_s, likelihood = of_landmark(looks, row)
        sequences, joint = every_sequence(chain, stamp_s, likelihood)
        share = np.exp(joint - joint.max())
        wrong = (sequences[:, None, :] != sequences[None, :, :]).sum(axis=2) @ (share / share.sum())
        mine = (sequences != found[rows]).sum(axis=1) @ (share / share.sum())
        assert mine == pytest.approx(wrong.min(), abs=1e-9)


def test_nearest_takes_the_likeliest_and_ties_at_random():
    likelihood = np.tile([[-1.0, -3.0, -np.inf], [-2.0, -2.0, -np.inf]], (500, 1))
    looks = ModeLooks(np.array([0, 1000]), np.arange(1000.0), likelihood)
    found = selector_by_name("nn").select(looks, ModeChain(), np.random.default_rng(0)).indicator
    assert (found[::2] == 0).all()
    assert 200 < found[1::2].sum() < 300  # a fair coin: five standard deviations on either side


def test_looks_without_any_mode_are_an_error_of_every_selector():
    likelihood = np.zeros((4, 2))
    likelihood[2] = -np.inf
    looks = ModeLooks(np.array([0, 1, 4]), np.arange(4.0), likelihood)
    for name in NAMES:
        with pytest.raises(NumericalError, match="landmark 1"):
            selector_by_name(name).select(looks, ModeChain(), np.random.default_rng(0))


def share_of_optima(looks, chain, budget, seed=0):
    best = selector_by_name("viterbi").select(looks, chain, np.random.default_rng(0)).log_joint
    found = TreeSearch(budget=budget, window_s=None, threads=1).select(looks, chain, np.random.default_rng(seed))
    return (found.log_joint >= best - 1e-9).mean()


@pytest.mark.parametrize("name", sorted(CHAINS.keys() - {"uniform"}))  # that one hardly ever changes
def test_tree_search_converges_to_viterbi_as_its_budget_grows(name):
    looks = random_looks(np.random.default_rng(4), [6] * 30, 3, born_late=True, scale=1.0)
    shares = [share_of_optima(looks, CHAINS[name], budget) for budget in (3, 100, 7_000)]
    assert shares[0] < shares[1] <= shares[2] == 1.0


def test_tree_search_is_the_same_whatever_the_number_of_threads():
    looks = random_looks(np.random.default_rng(1), [30, 5, 80, 1, 40, 12], 3, scale=1.0)
    for chain in (ModeChain(0.05), CHAINS["ageing, gone"]):
        found = [
            TreeSearch(budget=40, rollouts=3, threads=threads).select(looks, chain, np.random.default_rng(9)).indicator
            for threads in (1, 2, 7, None)
        ]
        for other in found[1:]:
            np.testing.assert_array_equal(found[0], other)


def test_looks_before_the_window_keep_their_modes():
    rng = np.random.default_rng(6)
    looks = random_looks(rng, [60, 60], 3, scale=1.0)
    looks.stamp_s[:] = np.tile(2.0 * np.arange(60), 2)
    previous = rng.integers(0, 3, 120)
    previous[100:] = -1
    for chain in (ModeChain(0.1), CHAINS["ageing"]):
        window = TreeSearch(budget=30, window_s=50.0)
        found = window.select(looks, chain, np.random.default_rng(0), previous=previous).indicator
        old = looks.stamp_s < looks.stamp_s.max() - 50.0
        kept = old & (previous >= 0)
        np.testing.assert_array_equal(found[kept], previous[kept])
        assert (found[~kept & (previous >= 0)] != previous[~kept & (previous >= 0)]).any()
        everything = TreeSearch(budget=30, window_s=None).select(
            looks, chain, np.random.default_rng(0), previous=previous
        )
        assert (everything.indicator[kept] != previous[kept]).any()


@pytest.mark.parametrize("name", ["constant", "ageing", "general purpose"])
def test_what_follows_kept_looks_is_the_best_continuation(name):
    """With a large budget: the largest joint probability of all sequences that begin as they were kept."""
    rng = np.random.default_rng(8)
    chain = CHAINS[name]
    for _ in range(8):
        looks = random_looks(rng, [7], 2, gap_s=3.0)
        looks.stamp_s[:] = looks.stamp_s[0] + np.array([0.0, 1.0, 3.0, 20.0, 22.0, 25.0, 26.0])
        previous = np.array([0, 1, 1, -1, -1, -1, -1])
        found = TreeSearch(budget=3000, window_s=10.0).select(looks, chain, np.random.default_rng(0), previous=previous)
        sequences, joint = every_sequence(chain, looks.stamp_s, looks.log_likelihood)
        begins = (sequences[:, :3] == previous[:3]).all(axis=1)
        assert found.indicator[:3].tolist() == [0, 1, 1]
        assert found.log_joint[0] == pytest.approx(joint[begins].max(), abs=1e-9)


def test_a_kept_mode_that_exists_no_more_is_decided_anew():
    likelihood = np.zeros((6, 2))
    likelihood[1, 1] = -np.inf
    looks = ModeLooks(np.array([0, 6]), 100.0 * np.arange(6), likelihood)
    found = TreeSearch(window_s=50.0).select(
        looks, ModeChain(1e-3), np.random.default_rng(0), previous=np.array([0, 1, 1, 0, 1, -1])
    )
    assert found.indicator[0] == 0
    assert np.isfinite(found.log_joint[0])
    assert found.indicator[1] == 0


def test_a_tree_without_room_to_grow_still_finds_the_optimum():
    looks = random_looks(np.random.default_rng(4), [6] * 20, 3, scale=1.0)
    best = selector_by_name("viterbi").select(looks, CHAINS["constant"], np.random.default_rng(0)).log_joint
    for max_nodes in (1, 6_000):  # anew at every decision, and now and then
        search = TreeSearch(budget=5_000, max_nodes=max_nodes)
        found = search.select(looks, CHAINS["constant"], np.random.default_rng(0))
        np.testing.assert_allclose(found.log_joint, best, atol=1e-9)


def test_a_decision_that_rules_out_what_follows_is_owned_up_to():
    """At one instant nothing changes: who takes the likelier mode at first has none at the second look."""
    looks = ModeLooks(np.array([0, 2]), np.zeros(2), np.array([[5.0, 0.0], [-np.inf, 0.0]]))
    chain = CHAINS["exponential"]
    nearest = selector_by_name("nn").select(looks, chain, np.random.default_rng(0))
    assert nearest.indicator.tolist() == [0, 1]
    assert nearest.log_joint[0] == -np.inf
    for seed in range(20):
        hasty = TreeSearch(budget=1).select(looks, chain, np.random.default_rng(seed))
        possible = hasty.indicator.tolist() == [1, 1]
        assert possible or hasty.indicator.tolist() == [0, 1]
        assert np.isfinite(hasty.log_joint[0]) == possible
        patient = TreeSearch(budget=50).select(looks, chain, np.random.default_rng(seed))
        assert patient.indicator.tolist() == [1, 1]


@pytest.mark.parametrize("name", NAMES)
def test_nothing_to_look_at_is_no_error(name):
    for shape, landmarks in (((0, 2), 3), ((0, 0), 0)):
        looks = ModeLooks(np.zeros(landmarks + 1, dtype=np.int64), np.empty(0), np.empty(shape))
        found = selector_by_name(name).select(looks, ModeChain(), np.random.default_rng(0))
        assert len(found.indicator) == 0
        np.testing.assert_array_equal(found.log_joint, np.zeros(landmarks))


def test_settings_of_the_tree_search_have_bounds():
    for setting in ({"budget": 0}, {"rollouts": 0}, {"threads": 0}, {"max_nodes": 0}):
        with pytest.raises(ConfigError, match="1 or more"):
            TreeSearch(**setting)
