"""The filters of cliques against the sum over all times of death, and their laws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.errors import InputError, NumericalError
from evermap.existence import single
from evermap.survival import Exponential, LifetimePrior, Uniform
from evermap_studies.bateman2020 import joint
from evermap_studies.bateman2020.clique_range import nearest_per_clique, range_degraded_miss

from .cliques import PRIORS, Looks, looks, summed

every_prior = pytest.mark.parametrize(("prior", "survival"), PRIORS.values(), ids=PRIORS)
CLIQUES = 3


def cliques_after(prior: LifetimePrior, seen: Looks) -> single.Belief:
    state = single.init(CLIQUES, prior, evidence=True)
    for n in range(len(seen)):
        state = joint.jcf(state, *seen.step(n), seen.clique)
    return state


def landmarks_after(prior: LifetimePrior, seen: Looks) -> single.Belief:
    state = single.init(len(seen.clique), prior, evidence=True)
    for n in range(len(seen)):
        state = joint.iff(state, *seen.step(n))
    return state


def assert_same(one: single.Belief, other: single.Belief, rtol: float = 1e-11) -> None:
    np.testing.assert_allclose(one.inverse_odds, other.inverse_odds, rtol=rtol)
    np.testing.assert_array_equal(one.stamp_s, other.stamp_s)
    assert one.log_evidence is not None
    assert other.log_evidence is not None
    np.testing.assert_allclose(one.log_evidence, other.log_evidence, rtol=rtol, atol=1e-12)


@every_prior
@given(seen=looks(cliques=CLIQUES), ahead=st.floats(0.0, 5.0))
def test_a_clique_is_the_sum_over_all_times_of_its_death(
    prior: LifetimePrior, survival: Callable[[Any], Any], seen: Looks, ahead: float
) -> None:
    state = cliques_after(prior, seen)
    assert state.log_evidence is not None
    query = float(seen.stamp_s[-1]) + ahead
    for c, belief in enumerate(state.predict(query)):
        expected, evidence = summed(survival, seen, np.flatnonzero(seen.clique == c), query)
        assert belief == pytest.approx(expected, rel=1e-9, abs=1e-14)
        assert state.log_evidence[c] == pytest.approx(evidence, rel=1e-10, abs=1e-12)


@every_prior
@given(seen=looks(), ahead=st.floats(0.0, 5.0))
def test_a_landmark_alone_is_the_sum_over_all_times_of_its_death(
    prior: LifetimePrior, survival: Callable[[Any], Any], seen: Looks, ahead: float
) -> None:
    state = landmarks_after(prior, seen)
    assert state.log_evidence is not None
    query = float(seen.stamp_s[-1]) + ahead
    for k, belief in enumerate(state.predict(query)):
        expected, evidence = summed(survival, seen, [k], query)
        assert belief == pytest.approx(expected, rel=1e-9, abs=1e-14)
        assert state.log_evidence[k] == pytest.approx(evidence, rel=1e-10, abs=1e-12)


@given(seen=looks())
def test_cliques_of_one_are_landmarks_alone(seen: Looks) -> None:
    prior = PRIORS["general purpose"][0]
    each = np.arange(len(seen.clique))
    state = single.init(len(each), prior, evidence=True)
    for n in range(len(seen)):
        state = joint.jcf(state, *seen.step(n), each)
    assert_same(state, landmarks_after(prior, seen))


@given(seen=looks(cliques=CLIQUES), data=st.data())
def test_the_order_of_landmarks_does_not_matter(seen: Looks, data: st.DataObject) -> None:
    order = np.array(data.draw(st.permutations(range(len(seen.clique)))), dtype=np.int64)
    columns = {name: getattr(seen, name)[:, order] for name in ("detected", "p_miss", "p_false", "expected")}
    shuffled = replace(seen, clique=seen.clique[order], **columns)
    prior = PRIORS["weibull"][0]
    assert_same(cliques_after(prior, shuffled), cliques_after(prior, seen))


@given(seen=looks(cliques=CLIQUES), seed=st.integers(0, 1000))
def test_a_look_may_come_in_two_halves(seen: Looks, seed: int) -> None:
    """Some landmarks of an instant now, the others right after: what a clique's likelihood is a product of."""
    prior = PRIORS["exponential"][0]
    state = single.init(CLIQUES, prior, evidence=True)
    for n, half in enumerate(np.random.default_rng(seed).random(seen.expected.shape) < 0.5):
        *look, expected = seen.step(n)
        state = joint.jcf(state, *look, expected & half, seen.clique)
        state = joint.jcf(state, *look, expected & ~half, seen.clique)
    assert_same(state, cliques_after(prior, seen))


def test_what_was_not_expected_is_neither_used_nor_checked() -> None:
    before = joint.jcf(single.init(3, Exponential(0.1)), 2.0, 1, 0.3, 0.1, True, np.array([0, 1, 2]))
    clique = np.array([2, 0, 0, 1])
    expected = np.array([False, True, False, True])
    detected = np.array([np.nan, 0.0, 7.0, 1.0])
    p_miss = np.array([np.nan, 0.4, -1.0, 2.0])
    after = joint.jcf(before, [5.0, np.nan, 5.0], detected, p_miss, 0.1, expected, clique)
    np.testing.assert_array_equal(after.inverse_odds[1:], before.inverse_odds[1:])  # no look; none expected
    np.testing.assert_array_equal(after.stamp_s, [5.0, 2.0, 2.0])
    one = before.update(5.0, 0, 0.4, 0.1, rows=[0])
    assert after.inverse_odds[0] == pytest.approx(one.inverse_odds[0], rel=1e-13)
    alone = joint.iff(single.init(4, Exponential(0.1)), [5.0, 5.0, 5.0, np.nan], detected, p_miss, 0.1, expected)
    np.testing.assert_array_equal(alone.stamp_s, [0.0, 5.0, 0.0, 0.0])


@given(seen=looks(cliques=1, landmarks=1, longest=12))
@every_prior
def test_observe_is_update(prior: LifetimePrior, survival: Callable[[Any], Any], seen: Looks) -> None:
    """By both likelihoods; by their ratio alone, with the evidence relative to a world without the feature."""
    by_logs = by_ratio = by_detector = single.init(1, prior, evidence=True)
    total_gone = 0.0
    for n in range(len(seen)):
        time, detected, p_miss, p_false, _ = seen.step(n)
        there, gone = np.where(detected, 1 - p_miss, p_miss), np.where(detected, p_false, 1 - p_false)
        by_detector = by_detector.update(time, detected, p_miss, p_false)
        by_logs = by_logs.observe(time, np.log(there), np.log(gone))
        by_ratio = by_ratio.observe(time, np.log(there / gone))
        total_gone += float(np.log(gone)[0])
    assert_same(by_logs, by_detector)
    assert by_ratio.log_evidence is not None
    assert_same(replace(by_ratio, log_evidence=by_ratio.log_evidence + total_gone), by_detector, rtol=1e-10)


CERTAIN = [(detected, miss, false) for detected in (0, 1) for miss in (0.0, 0.3, 1.0) for false in (0.0, 0.2, 1.0)]


@pytest.mark.parametrize(("detected", "miss", "false"), CERTAIN)
@pytest.mark.parametrize("before", ["born", "doubtful", "gone"])
def test_certainties_are_those_of_the_single_filter(before: str, detected: int, miss: float, false: float) -> None:
    """Error rates of 0 and 1, on features that are certainly there, probably there, and certainly gone."""
    state = single.init(1, Exponential(0.1), evidence=True)
    if before != "born":
        state = state.update(1.0, int(before == "doubtful"), 0.1 if before == "doubtful" else 0.0, 0.2)
    time = state.stamp_s  # at once, so that who was just born is certainly there
    one = (detected, miss, false)
    try:
        expected = state.update(time, *one)
    except NumericalError:
        with pytest.raises(NumericalError, match=r"row 0.*impossible"):
            joint.jcf(state, time, *one, True, np.array([0]))
    else:
        assert_same(joint.jcf(state, time, *one, True, np.array([0])), expected)


def test_members_that_prove_opposite_things() -> None:
    state = single.init(1, Exponential(0.1)).update(1.0, 1, 0.1, 0.1)
    with pytest.raises(NumericalError, match=r"row 0.*impossible"):
        joint.jcf(state, 2.0, [1, 0], [0.1, 0.0], [0.0, 0.1], True, np.array([0, 0]))


def test_a_thousand_members_leave_a_doubt() -> None:
    """Beyond what a double can hold the clamp keeps a doubt, and evidence is still exact."""
    members = np.zeros(5_000, dtype=np.int64)
    state = joint.jcf(single.init(1, Exponential(0.1), evidence=True), 1.0, 1, 0.1, 0.01, True, members)
    assert state.inverse_odds[0] == 1e-300
    state = joint.jcf(state, 2.0, 0, 0.1, 0.01, True, members)
    assert state.inverse_odds[0] == 1e300
    # All hits while it is there, all misses after it died: between the looks, which is what the evidence must say.
    hits, misses = 5_000 * np.log(0.9), 5_000 * np.log(0.99)
    expected = -0.1 + hits + np.log(-np.expm1(-0.1)) + misses
    assert state.log_evidence is not None
    assert state.log_evidence[0] == pytest.approx(expected, rel=1e-12)
    state = joint.jcf(state, 2.0, 1, 0.1, 0.01, True, members[:200])
    assert state.probability[0] > 0.99


def test_a_thousand_members_do_not_shake_a_certainty() -> None:
    """Who was just born is there, and who outlived nothing is gone, however many members say otherwise."""
    members = np.zeros(5_000, dtype=np.int64)
    born = joint.jcf(single.init(1, Exponential(0.1)), 0.0, 0, 0.1, 0.01, True, members)
    assert born.inverse_odds[0] == 0.0
    gone = joint.jcf(single.init(1, Uniform(10.0)), 11.0, 1, 0.1, 0.01, True, members)
    assert np.isposinf(gone.inverse_odds[0])


@pytest.mark.parametrize(
    ("detected", "p_miss", "p_false", "doubt"), [(1, 0.1, 1e-200, 1e-300), (0, 1e-200, 0.1, 1e300)]
)
def test_a_doubt_stays_finite_by_every_road(detected: int, p_miss: float, p_false: float, doubt: float) -> None:
    state = single.init(1, Exponential(0.1)).update(1.0, 1, 0.1, 0.1)
    look = (2.0, detected, p_miss, p_false)
    assert state.update(*look).update(*look).inverse_odds[0] == doubt
    assert joint.jcf(state, *look, True, np.array([0, 0])).inverse_odds[0] == doubt


def test_the_range_degraded_filter_by_hand() -> None:
    """Two cliques: the near one's misses count, the far one's hardly do."""
    clique = np.array([0, 0, 1, 1])
    miss = range_degraded_miss(nearest_per_clique(np.array([2.0, 5.0, 30.0, 20.0]), clique, 2), 9.0, most=0.98)
    np.testing.assert_allclose(miss, [1.0 - np.exp(-2.0 / 9.0), 1.0 - np.exp(-20.0 / 9.0)])
    state = joint.jcf(single.init(2, Exponential(0.01)), 1.0, 0, miss[clique], 0.001, True, clique)
    dead = np.expm1(0.01)
    np.testing.assert_allclose(state.inverse_odds, dead * (0.999 / miss) ** 2, rtol=1e-12)


GOOD: dict[str, Any] = {
    "stamp_s": 6.0,
    "detected": np.ones(3),
    "p_miss": 0.1,
    "p_false": 0.1,
    "expected": np.array([True, False, True]),
}
BAD = {
    "miss": ({"p_miss": [0.1, 0.1, 1.5]}, "field 'p_miss': landmark 2: 1.5 is not a probability"),
    "false": ({"p_false": [0.1, 0.1, np.nan]}, "field 'p_false': landmark 2: nan is not a probability"),
    "detected": ({"detected": [1, 1, 0.5]}, "field 'detected': landmark 2: 0.5 is neither"),
    "length": ({"detected": [1, 1]}, r"field 'detected': shape \(2,\) instead of \(3,\)"),
    "expected": ({"expected": np.ones(3)}, r"field 'expected': float64 of shape \(3,\) instead of bool of \(3,\)"),
    "clique": ({"clique": np.array([0, 2, 0])}, "field 'clique': entry 1: row 2 of 2 does not exist"),
    "stamp": ({"stamp_s": [6.0, 6.0, 6.0]}, r"field 'stamp_s': shape \(3,\) instead of \(2,\)"),
    "back": ({"stamp_s": [6.0, 4.0]}, "field 'stamp_s': row 1: time 4.0 s lies before its last observation"),
}


@pytest.mark.parametrize(("change", "words"), BAD.values(), ids=BAD)
def test_bad_input_is_named(change: dict[str, Any], words: str) -> None:
    state = joint.jcf(single.init(2, Exponential(0.1)), 5.0, 1, 0.1, 0.1, True, np.array([0, 1]))
    with pytest.raises(InputError, match=words) as caught:
        joint.jcf(state, **{**GOOD, "clique": np.array([0, 0, 1]), **change})
    assert "\n" not in str(caught.value)


def test_bad_input_of_observe_and_iff() -> None:
    state = single.init(2, Exponential(0.1))
    with pytest.raises(InputError, match="field 'log_there': row 1: nan is not a log-likelihood"):
        state.observe(1.0, [0.0, np.nan])
    with pytest.raises(InputError, match="field 'log_gone': row 1: nan is not a log-likelihood"):
        state.observe([np.nan, 1.0], 0.0, [np.nan, np.nan])
    with pytest.raises(InputError, match=r"row 0: time -1\.0 s lies before its birth"):
        state.observe(-1.0, 0.0)
    with pytest.raises(InputError, match=r"field 'p_miss': row 1: 2\.0 is not a probability"):
        joint.iff(state, 1.0, 1, [2.0, 2.0], 0.1, np.array([False, True]))
    with pytest.raises(InputError, match="field 'expected': float64"):
        joint.iff(state, 1.0, 1, 0.1, 0.1, 1.0)
