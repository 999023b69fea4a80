"""The Joint Feature Filter: the mixture against every combination of deaths, the pairwise form against its equation."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from evermap.errors import ConfigError, InputError
from evermap.existence import single
from evermap.survival import Exponential, LifetimePrior, Weibull
from evermap.types import FloatArray, IntArray
from evermap_studies.bateman2020 import jff, joint

from .cliques import DIGITS, PRIORS, Looks, deaths, given_death, looks, summed

every_prior = pytest.mark.parametrize(("prior", "survival"), PRIORS.values(), ids=PRIORS)
few = settings(max_examples=20, deadline=None)
CLIQUES = 2


def mixture_after(prior: LifetimePrior, seen: Looks, weight: float | FloatArray) -> jff.MixtureBelief:
    state = jff.init(seen.clique, CLIQUES, prior, weight=weight)
    for n in range(len(seen)):
        state = jff.update(state, *seen.step(n))
    return state


def enumerated(survival: Callable[[Any], Any], seen: Looks, weight: float) -> tuple[list[float], float]:
    """Of one clique: the beliefs at the last look and the posterior weight, over all combinations of deaths."""
    with mp.workdps(DIGITS):
        members = range(len(seen.clique))
        death = deaths(survival, seen.stamp_s)
        likelihood = [given_death(*seen.likelihoods([k])) for k in members]
        after_all = len(seen)
        total = shared = mp.mpf(0)
        alive = [mp.mpf(0) for _ in members]
        for interval in product(range(len(death)), repeat=len(members)):
            together = death[interval[0]] if len(set(interval)) == 1 else 0
            data = mp.fprod(likelihood[k][i] for k, i in enumerate(interval))
            term = mp.mpf(weight) * together * data
            shared += term
            term += (1 - mp.mpf(weight)) * mp.fprod(death[i] for i in interval) * data
            total += term
            for k in members:
                alive[k] += term if interval[k] == after_all else 0
        return [float(a / total) for a in alive], float(shared / total)


@every_prior
@few
@given(seen=looks(cliques=1, landmarks=3, longest=3), weight=st.floats(0.01, 0.99))
def test_the_mixture_is_the_sum_over_all_deaths(
    prior: LifetimePrior, survival: Callable[[Any], Any], seen: Looks, weight: float
) -> None:
    state = mixture_after(prior, seen, weight)
    belief, p_shared = enumerated(survival, seen, weight)
    np.testing.assert_allclose(jff.predict(state, float(seen.stamp_s[-1])), belief, rtol=1e-8, atol=1e-13)
    assert state.p_shared[0] == pytest.approx(p_shared, rel=1e-9)


@few
@given(seen=looks(cliques=CLIQUES), ahead=st.floats(0.0, 5.0))
def test_the_limits_are_the_joint_and_the_independent_filter(seen: Looks, ahead: float) -> None:
    """Clique 0 certainly shares its survival time, clique 1 certainly does not."""
    prior = PRIORS["weibull"][0]
    shared, alone = single.init(CLIQUES, prior), single.init(len(seen.clique), prior)
    for n in range(len(seen)):
        shared = joint.jcf(shared, *seen.step(n), seen.clique)
        alone = joint.iff(alone, *seen.step(n))
    query = float(seen.stamp_s[-1]) + ahead
    expected = np.where(seen.clique == 0, shared.predict(query)[seen.clique], alone.predict(query))
    state = mixture_after(prior, seen, np.array([1.0, 0.0]))
    np.testing.assert_array_equal(state.p_shared, [1.0, 0.0])
    np.testing.assert_array_equal(jff.predict(state, query), expected)


@few
@given(seen=looks(cliques=CLIQUES), weight=st.floats(0.0, 1.0))
def test_cliques_do_not_hear_of_each_other(seen: Looks, weight: float) -> None:
    prior = PRIORS["exponential"][0]
    together = jff.predict(mixture_after(prior, seen, weight), float(seen.stamp_s[-1]))
    for c in range(CLIQUES):
        own = seen.clique == c
        columns = (column[:, own] for column in (seen.detected, seen.p_miss, seen.p_false, seen.expected))
        apart = mixture_after(prior, Looks(seen.stamp_s, seen.clique[own], *columns), weight)
        np.testing.assert_allclose(jff.predict(apart, float(seen.stamp_s[-1])), together[own], rtol=1e-11)


def test_ten_thousand_looks_do_not_underflow() -> None:
    """200 looks at 50 landmarks that stay; evidence far below the smallest double."""
    rng = np.random.default_rng(5)
    steps, members = 200, 50
    stamp = np.arange(1.0, steps + 1.0)
    detected = rng.random((steps, members)) < 0.6
    miss, false = np.full((steps, members), 0.4), np.full((steps, members), 0.5)
    seen = Looks(stamp, np.zeros(members, np.int64), detected, miss, false, np.ones((steps, members), np.bool_))
    rate = 2e-4
    state = mixture_after(Exponential(rate), seen, 0.3)

    def survival(t: Any) -> Any:
        return mp.exp(-mp.mpf(rate) * t)

    together, shared = summed(survival, seen, range(members), stamp[-1])
    alone = [summed(survival, seen, [k], stamp[-1]) for k in range(members)]
    assert shared < -3000.0
    odds = 0.3 / 0.7 * np.exp(shared - sum(evidence for _, evidence in alone))
    assert 0.01 < odds < 100.0  # otherwise this says nothing
    assert state.p_shared[0] == pytest.approx(odds / (1.0 + odds), rel=1e-9)
    expected = [(odds * together + belief) / (1.0 + odds) for belief, _ in alone]
    np.testing.assert_allclose(jff.predict(state, stamp[-1]), expected, rtol=1e-9)


def test_each_clique_has_its_own_prior() -> None:
    priors = (Exponential(0.05), Weibull(60.0, 1.7))
    clique = np.array([1, 0, 1])
    state = jff.init(clique, 2, priors, weight=0.5, prior_of_clique=np.array([1, 0]))
    expected = np.exp([priors[1 - c].log_survival(8.0) for c in clique])
    np.testing.assert_allclose(jff.predict(state, 8.0), expected, rtol=1e-12)


def slowly_averaged(
    point_m: FloatArray, clique: IntArray, alone: FloatArray, own: float, neighbours: int, reach_m: float
) -> FloatArray:
    """Fixed point of `p_i = w_ii q_i + sum_j w_ij p_j`, landmark by landmark, round after round."""
    mean = alone.copy()
    links: list[dict[int, float]] = []
    for i in range(len(point_m)):
        near = {j: float(np.linalg.norm(point_m[i] - point_m[j])) for j in np.flatnonzero(clique == clique[i])}
        nearest = sorted((d, j) for j, d in near.items() if j != i and d <= reach_m)[:neighbours]
        total = sum(1.0 / d for d, _ in nearest)
        links.append({j: (1.0 - own) / d / total for d, j in nearest})
    for _ in range(200):
        mean = np.array(
            [
                (own if links[i] else 1.0) * alone[i] + sum(w * mean[j] for j, w in links[i].items())
                for i in range(len(point_m))
            ]
        )
    return mean


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 14),
    own=st.sampled_from([0.3, 0.7, 1.0]),
    neighbours=st.integers(0, 5),
)
@example(seed=254, count=14, own=0.3, neighbours=1)  # elimination left a negative weight here
def test_the_pairwise_form_solves_its_equation(seed: int, count: int, own: float, neighbours: int) -> None:
    rng = np.random.default_rng(seed)
    point, clique, alone = rng.uniform(0.0, 3.0, (count, 3)), rng.integers(0, 3, count), rng.random(count)
    weights = jff.pairwise_weights(point, clique, own=own, neighbours=neighbours)
    expected = slowly_averaged(point, clique, alone, own, neighbours, 2.0)
    np.testing.assert_allclose(weights @ alone, expected, rtol=1e-12)
    dense = weights.toarray()
    assert (dense >= 0.0).all()
    np.testing.assert_allclose(dense.sum(axis=1), 1.0, rtol=1e-12)
    assert not dense[clique[:, None] != clique].any()


def test_who_has_no_neighbour_is_believed_alone() -> None:
    """Out of reach, on another body, or at the very place of a neighbour."""
    point = np.array([[0.0, 0.0, 0.0], [2.5, 0.0, 0.0], [0.1, 0.0, 0.0], [9.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    alone = np.array([0.9, 0.2, 0.4, 1.0, 0.0])
    joined = jff.pairwise_weights(point, np.array([0, 0, 1, 2, 2])) @ alone
    np.testing.assert_array_equal(joined[:3], alone[:3])
    # p = .7 q + .3 p' for both: p = (.7 q + .21 q') / .91
    np.testing.assert_allclose(joined[3:], [0.7 / 0.91, 0.21 / 0.91], rtol=1e-12)


def test_bad_input_is_named() -> None:
    clique, point = np.array([0, 1]), np.zeros((2, 3))
    with pytest.raises(InputError, match=r"field 'weight': clique 1: 1\.5 is not a probability"):
        jff.init(clique, 2, Exponential(1.0), weight=np.array([0.5, 1.5]))
    with pytest.raises(InputError, match="field 'clique': entry 1: row 1 of 1 does not exist"):
        jff.init(clique, 1, Exponential(1.0), weight=0.5)
    with pytest.raises(ConfigError, match="field 'own': must be above 0"):
        jff.pairwise_weights(point, clique, own=0.0)
    with pytest.raises(ConfigError, match="field 'neighbours': must not be negative, not -1"):
        jff.pairwise_weights(point, clique, neighbours=-1)
    with pytest.raises(ConfigError, match="field 'reach_m': must be positive, not nan"):
        jff.pairwise_weights(point, clique, reach_m=np.nan)
    with pytest.raises(InputError, match=r"field 'clique': shape \(2,\) for positions of \(3, 3\)"):
        jff.pairwise_weights(np.zeros((3, 3)), clique)
    with pytest.raises(InputError, match="field 'landmark_m': row 1: a position that is not finite"):
        jff.pairwise_weights(np.array([[0.0] * 3, [np.nan] * 3]), clique)
