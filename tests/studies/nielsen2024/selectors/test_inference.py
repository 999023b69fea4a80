"""Exact inference over chains of modes, against the enumeration of all sequences and the persistence filter."""

from __future__ import annotations

import numpy as np
import pytest
from brute_force import CHAINS, every_sequence, log_sum, looks, of_landmark, random_looks
from hypothesis import given, settings
from hypothesis import strategies as st

from evermap.errors import InputError, NumericalError
from evermap.existence import single
from evermap.survival import Exponential, GeneralPurpose, Weibull
from evermap_studies.nielsen2024.selectors import inference
from evermap_studies.nielsen2024.selectors.chain import ModeChain, ModeLooks, log_joint
from evermap_studies.nielsen2024.selectors.inference import most_probable, smoothed

chains = st.sampled_from(sorted(CHAINS))


@given(looks(), chains)
def test_decoding_finds_the_largest_joint_probability_of_all_sequences(looks, name):
    chain = CHAINS[name]
    found = most_probable(looks, chain)
    value = log_joint(looks, chain, found)
    for row in range(looks.n_landmarks):
        rows, stamp_s, likelihood = of_landmark(looks, row)
        sequences, joint = every_sequence(chain, stamp_s, likelihood)
        mine = np.flatnonzero((sequences == found[rows]).all(axis=1))
        assert value[row] == pytest.approx(joint.max(), abs=1e-9)
        assert joint[mine[0]] == pytest.approx(joint.max(), abs=1e-9)


@given(looks(longest=5), chains)
def test_joint_probability_is_that_of_the_definition_for_every_sequence(looks, name):
    chain = CHAINS[name]
    _, stamp_s, likelihood = of_landmark(looks, 0)
    one = ModeLooks(np.array([0, len(stamp_s)]), stamp_s, likelihood)
    sequences, joint = every_sequence(chain, stamp_s, likelihood)
    found = [log_joint(one, chain, sequence)[0] for sequence in sequences]
    np.testing.assert_allclose(found, joint, atol=1e-9)


@settings(max_examples=settings.default.max_examples * 2 // 5)
@given(looks(), chains)
def test_posteriors_and_evidence_are_sums_over_all_sequences(looks, name):
    chain = CHAINS[name]
    beliefs = smoothed(looks, chain)
    for row in range(looks.n_landmarks):
        rows, stamp_s, likelihood = of_landmark(looks, row)
        sequences, joint = every_sequence(chain, stamp_s, likelihood)
        assert beliefs.log_evidence[row] == pytest.approx(log_sum(joint), abs=1e-9)
        share = np.exp(joint - log_sum(joint))
        for k in range(likelihood.shape[1]):
            expected = (share[:, None] * (sequences == k)).sum(axis=0)
            np.testing.assert_allclose(np.exp(beliefs.log_smoothed[rows, k]), expected, atol=1e-10)
        exists = np.isfinite(likelihood).any(axis=0).sum()
        for n in range(len(stamp_s)):  # a filter is the smoother of the looks so far, with all the modes there are
            padded = likelihood[: n + 1].copy()
            padded[:, :exists] = np.maximum(padded[:, :exists], -1e6)
            so_far, joint = every_sequence(chain, stamp_s[: n + 1], padded)
            share = np.exp(joint - log_sum(joint))
            expected = [share[so_far[:, n] == k].sum() for k in range(likelihood.shape[1])]
            np.testing.assert_allclose(np.exp(beliefs.log_filtered[rows][n]), expected, atol=1e-10)


@pytest.mark.parametrize("prior", [Exponential(0.02), GeneralPurpose(1e-4, 2.0), Weibull(60.0, 1.7)])
def test_one_mode_and_gone_are_the_persistence_filter(prior):
    rng = np.random.default_rng(5)
    counts = [1, 40, 150]
    features = np.repeat(np.arange(3), counts)
    gap = [rng.exponential(3.0, count) * (rng.random(count) > 0.1) for count in counts]
    since_s = np.concatenate([np.cumsum(g) - g[0] for g in gap])
    rows = len(features)
    detected = (rng.random(rows) < np.where(since_s < 60.0, 0.8, 0.1)).astype(float)
    p_miss, p_false = rng.uniform(0.05, 0.6, rows), rng.uniform(0.01, 0.3, rows)
    there = np.where(detected == 1.0, 1.0 - p_miss, p_miss)
    gone = np.where(detected == 1.0, p_false, 1.0 - p_false)
    offset = np.array([0.0, 1e4, 50.0])[features]
    looks = ModeLooks(np.cumsum([0, *counts]), since_s + offset, np.log(np.column_stack([there, gone])))

    beliefs = smoothed(looks, ModeChain(lifetime=prior, gone=True))
    after, probability = single.init(3, prior, evidence=True).run(features, since_s, detected, p_miss, p_false)
    np.testing.assert_allclose(np.exp(beliefs.log_filtered[:, 0]), probability, rtol=1e-9)
    np.testing.assert_allclose(np.exp(beliefs.log_filtered[:, 1]), 1.0 - probability, atol=1e-9)
    np.testing.assert_allclose(beliefs.log_evidence, after.log_evidence, rtol=1e-9)


@pytest.mark.parametrize("gone", [False, True])
def test_both_roads_agree_on_long_sequences(monkeypatch, gone):
    looks = random_looks(np.random.default_rng(2), [300, 17, 129], 3, born_late=True, scale=1.0)
    chain = ModeChain(lifetime=Exponential(0.01), gone=gone)
    short, path = smoothed(looks, chain), most_probable(looks, chain)
    monkeypatch.setattr(inference.Stretch, "memoryless", False)
    long = smoothed(looks, chain)
    np.testing.assert_allclose(long.log_evidence, short.log_evidence, rtol=1e-9)
    np.testing.assert_allclose(long.log_filtered, short.log_filtered, atol=1e-7)
    np.testing.assert_allclose(np.exp(long.log_smoothed), np.exp(short.log_smoothed), atol=1e-9)
    again = most_probable(looks, chain)
    np.testing.assert_allclose(log_joint(looks, chain, again), log_joint(looks, chain, path), atol=1e-6)


def test_dropping_hopeless_stays_changes_nothing(monkeypatch):
    rng = np.random.default_rng(3)
    for scale in (0.1, 1.0, 5.0):
        looks = random_looks(rng, [400], 3, scale=scale)
        chain = ModeChain(lifetime=Weibull(100.0, 0.5))
        pruned = most_probable(looks, chain)
        with monkeypatch.context() as patch:
            patch.setattr(inference, "SLACK", np.inf)
            full = most_probable(looks, chain)
        np.testing.assert_array_equal(pruned, full)


def test_landmarks_do_not_know_of_each_other():
    looks = random_looks(np.random.default_rng(7), [5, 0, 9, 3], 3, born_late=True)
    for chain in CHAINS.values():
        together, path = smoothed(looks, chain), most_probable(looks, chain)
        assert together.log_evidence[1] == 0.0
        for row in (0, 2, 3):
            rows, stamp_s, likelihood = of_landmark(looks, row)
            alone = ModeLooks(np.array([0, len(stamp_s)]), stamp_s, likelihood)
            assert smoothed(alone, chain).log_evidence[0] == together.log_evidence[row]
            np.testing.assert_array_equal(most_probable(alone, chain), path[rows])


def test_a_landmark_of_one_mode_stays_in_it_whatever_the_chain():
    looks = ModeLooks(np.array([0, 4]), np.arange(4.0), np.column_stack([np.full(4, -50.0), np.full(4, -np.inf)]))
    for chain in (ModeChain(0.3), ModeChain(lifetime=Weibull(1.0, 2.0))):
        assert most_probable(looks, chain).tolist() == [0] * 4
        assert log_joint(looks, chain, np.zeros(4, dtype=np.int64))[0] == -200.0
        assert smoothed(looks, chain).log_evidence[0] == -200.0


def test_looks_that_nothing_explains_are_an_error_that_names_the_landmark():
    likelihood = np.zeros((5, 2))
    likelihood[3] = -np.inf
    looks = ModeLooks(np.array([0, 2, 5]), np.arange(5.0), likelihood)
    for chain in (ModeChain(0.1), ModeChain(lifetime=Weibull(5.0, 2.0))):
        with pytest.raises(NumericalError, match="landmark 1"):
            smoothed(looks, chain)
        with pytest.raises(NumericalError, match="landmark 1"):
            most_probable(looks, chain)


def test_malformed_looks_are_refused():
    with pytest.raises(InputError, match="row 2: earlier"):
        ModeLooks(np.array([0, 3]), np.array([0.0, 2.0, 1.0]), np.zeros((3, 2)))
    with pytest.raises(InputError, match="row 1: not a log likelihood"):
        ModeLooks(np.array([0, 2]), np.array([0.0, 1.0]), np.array([[0.0, 0.0], [np.nan, 0.0]]))
    with pytest.raises(InputError, match="bounds"):
        ModeLooks(np.array([0, 3]), np.array([0.0, 1.0]), np.zeros((2, 2)))
    with pytest.raises(InputError, match="shape"):
        ModeLooks(np.array([0, 2]), np.array([0.0, 1.0]), np.zeros(2))
    ModeLooks(np.array([0, 1, 2]), np.array([5.0, 1.0]), np.zeros((2, 1)))  # another landmark's clock may be behind
