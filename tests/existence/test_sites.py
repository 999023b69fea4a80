"""Cliques at sites or away: against the sum over all paths, and against the filters that are its special cases."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.special import betaln

from evermap.errors import InputError
from evermap.existence import single
from evermap.existence.sites import SiteBeliefs, SiteDynamics, SiteLooks
from evermap.sensing.sightlines import Lines
from evermap.survival import Exponential, GeneralPurpose, Weibull
from evermap.types import FloatArray
from evermap_studies.bateman2020 import joint

from .rows import follow_sites

SURE = 1e15
"""Pseudo counts of a rate that is known: no look changes it."""


def certain(rate: FloatArray) -> Lines:
    """Free lines of sight, along which this rate is known."""
    return Lines(np.ones(len(rate)), SURE * rate, SURE * (1.0 - rate), 0.03)


def free(hits: FloatArray, misses: FloatArray) -> Lines:
    """Free lines of sight of these counts."""
    return Lines(np.ones(len(hits)), hits, misses, 0.03)


GENERAL = GeneralPurpose(1e-7, 1e-2)


def looks(rows: list[tuple[float, int, int, int, bool]]) -> SiteLooks:
    """From rows of stamp, clique, site, key and hit."""
    stamp, clique, site, key, hit = zip(*rows, strict=True) if rows else ((),) * 5
    whole = [np.array(column, dtype=np.int64) for column in (clique, site, key)]
    return SiteLooks(np.array(stamp, dtype=np.float64), *whole, np.array(hit, dtype=np.bool_))


def dynamics(**changed: Any) -> SiteDynamics:
    """Of one clique with three sites."""
    values: dict[str, Any] = {
        "stay": (Weibull(400.0, 0.7), GENERAL, Exponential.from_half_life(150.0)),
        "since_s": np.array([-100.0, -20.0, -3.0]),
        "absence": (Exponential.from_half_life(150.0),),
        "away_since_s": np.array([-50.0]),
        "p_hop": np.array([0.4]),
        "return_share": np.array([0.5, 0.2, 0.1]),
    } | changed
    return SiteDynamics(**values)


def alone(prior: Any, since_s: FloatArray) -> SiteDynamics:
    """Of cliques with one site each, that never return: Rosen's world."""
    n = len(since_s)
    nil = np.zeros(n)
    return SiteDynamics((prior,) * n, since_s, (prior,) * n, nil, nil, nil)


def sum_over_paths(
    p_here: FloatArray, known: SiteDynamics, stamps: FloatArray, ratios: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """By enumeration: (T, K + 1) filtered and smoothed probabilities of the seats, and the log evidence.

    States are (seat, come before the start or since), one jump a gap, written down from the model's words.
    """
    n = len(p_here)
    states = [(seat, new) for seat in range(n + 1) for new in (False, True)]
    prior = [known.absence[0], *known.stay]
    since = [known.away_since_s[0], *known.since_s]
    share = known.return_share

    def step(before: tuple[int, bool], after: tuple[int, bool], t0: float, t1: float) -> float:
        seat, new = before
        began = stamps[0] if new else since[seat]
        q = np.exp(prior[seat].log_conditional_survival(t0 - began, t1 - began))
        if seat == 0:
            leaving = np.append(0.0, share * (1 - q))
            staying = 1 - leaving.sum()
        else:
            others = np.where(np.arange(n) == seat - 1, 0.0, share) / (1 - share[seat - 1])
            leaving = (1 - q) * known.p_hop[0] * np.append(0.0, others)
            staying = q
            leaving[0] = 1 - q - leaving.sum()
        return (staying if after == before else 0.0) + (leaving[after[0]] if after[1] else 0.0)

    steps = [{(a, b): step(a, b, t0, t1) for a in states for b in states} for t0, t1 in itertools.pairwise(stamps)]
    start = {(seat, new): 0.0 if new else np.append(1 - p_here.sum(), p_here)[seat] for seat, new in states}

    def weigh(count: int) -> FloatArray:
        total = np.zeros((count, n + 1))
        for path in itertools.product(states, repeat=count):
            p = start[path[0]] * ratios[0, path[0][0]]
            for k in range(1, count):
                p *= steps[k - 1][path[k - 1], path[k]] * ratios[k, path[k][0]]
            for k in range(count):
                total[k, path[k][0]] += p
        return total

    filtered = np.array([weigh(k + 1)[k] for k in range(len(stamps))])
    every = weigh(len(stamps))
    return (
        filtered / filtered.sum(axis=1, keepdims=True),
        every / every.sum(axis=1, keepdims=True),
        float(np.log(every[0].sum())),
    )


@pytest.mark.parametrize("p_hop", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("use_misses", [True, False])
def test_equals_the_sum_over_all_paths(p_hop: float, use_misses: bool) -> None:
    rng = np.random.default_rng(3)
    p_here = np.array([0.6, 0.1, 0.05])
    known = dynamics(p_hop=np.array([p_hop]))
    stamps = np.array([0.0, 4.0, 90.0, 95.0])
    rate, p_false = np.array([0.8, 0.3, 0.6]), 0.05
    hit = rng.random((4, 3, 2)) < 0.5
    rows = [(stamps[t], 0, k, k, bool(hit[t, k, i])) for t in range(4) for k in range(3) for i in range(2)]
    ratios, ratios_of_hits = np.ones((2, 4, 4))
    for t in range(4):
        for k in range(3):
            for i in range(2):
                if hit[t, k, i]:
                    ratios[t, k + 1] *= rate[k] / p_false
                    ratios_of_hits[t, k + 1] *= rate[k] / p_false
                elif use_misses:
                    ratios[t, k + 1] *= (1 - rate[k]) / (1 - p_false)
    rng.shuffle(rows)  # type: ignore[arg-type]
    found = follow_sites(
        p_here, np.zeros(3, np.int64), known, looks(rows), certain(rate),
        start_s=0.0, until_s=95.0, p_false=p_false, p_occluded=0.0, use_misses=use_misses,
    )  # fmt: skip

    filtered, _, evidence = sum_over_paths(p_here, known, stamps, ratios)
    _, smoothed, _ = sum_over_paths(p_here, known, stamps, ratios_of_hits)
    np.testing.assert_allclose(found.p_here, filtered[-1, 1:], rtol=1e-11)
    np.testing.assert_allclose(found.trace.p_exists, filtered[:, 1:].sum(axis=1), rtol=1e-11)
    np.testing.assert_allclose(found.p_before, p_here, rtol=1e-12)
    np.testing.assert_allclose(found.log_evidence, evidence, rtol=1e-11)
    at = np.searchsorted(stamps, [row[0] for row in rows])
    np.testing.assert_allclose(found.weight, smoothed[at, [row[2] + 1 for row in rows]], rtol=1e-11)
    best = filtered[:, 1:].argmax(axis=1)
    np.testing.assert_array_equal(found.trace.n_hits, hit.sum(axis=2)[np.arange(4), best])
    np.testing.assert_array_equal(found.trace.n_misses, 2 - found.trace.n_hits)
    np.testing.assert_allclose(found.trace.expected, 2 * rate[best])


@pytest.mark.parametrize("prior", [GENERAL, Exponential(1e-3), Weibull(300.0, 0.6)], ids=lambda p: type(p).__name__)
def test_one_site_and_no_return_is_the_persistence_filter(prior: Any) -> None:
    rng = np.random.default_rng(5)
    n, m, p_false = 6, 200, 0.02
    since = -rng.uniform(0.0, 50.0, n)
    clique, stamp = rng.integers(0, n, m), np.sort(rng.uniform(0.0, 5e3, m))
    hit = rng.random(m) < 0.4
    rate = rng.uniform(0.1, 0.99, m)
    state, posterior = single.init(n, prior).run(clique, stamp - since[clique], hit, 1 - rate, p_false)
    found = follow_sites(
        np.ones(n), np.arange(n), alone(prior, since),
        SiteLooks(stamp, clique, clique, np.arange(m), hit), certain(rate),
        start_s=since, until_s=6e3, p_false=p_false, p_occluded=0.0,
    )  # fmt: skip
    order = np.lexsort((stamp, clique))
    np.testing.assert_array_equal(found.trace.clique_id, clique[order])
    np.testing.assert_allclose(found.trace.p_exists, posterior[order], rtol=1e-12)
    np.testing.assert_allclose(found.p_here, state.predict(6e3 - since), rtol=1e-12)
    np.testing.assert_array_equal(found.p_stayed, found.p_here)


def test_many_landmarks_on_one_site_are_the_joint_clique_filter() -> None:
    rng = np.random.default_rng(6)
    member = np.array([0, 0, 0, 1, 1, 2])
    prior, p_false = GENERAL, 0.03
    p_miss = rng.uniform(0.05, 0.6, len(member))
    state, rows = single.init(3, prior), []
    for t in np.arange(1.0, 40.0):
        hit, expected = rng.random(6) < 0.3, rng.random(6) < 0.7
        state = joint.jcf(state, t, hit, p_miss, p_false, expected, member)
        rows += [(t, int(member[k]), int(member[k]), int(k), bool(hit[k])) for k in np.flatnonzero(expected)]
    found = follow_sites(
        np.ones(3), np.arange(3), alone(prior, np.zeros(3)), looks(rows), certain(1 - p_miss),
        start_s=0.0, until_s=39.0, p_false=p_false, p_occluded=0.0,
    )  # fmt: skip
    np.testing.assert_allclose(found.p_here, state.predict(39.0), rtol=1e-12)


def test_constant_hazard_and_hops_are_the_chain_of_modes() -> None:
    """Nielsen 2024: the next mode is any of the others, with a switching probability that no age changes."""
    from evermap_studies.nielsen2024.selectors.chain import ModeChain, ModeLooks
    from evermap_studies.nielsen2024.selectors.inference import smoothed

    rng = np.random.default_rng(7)
    t, k, p_false = 30, 3, 0.05
    stamp = np.sort(rng.uniform(0.0, 900.0, t))
    rate = rng.uniform(0.2, 0.9, (t, k))
    hit = rng.random((t, k)) < 0.5
    ratio = np.where(hit, rate / p_false, (1 - rate) / (1 - p_false))
    chain = ModeChain(lifetime=Exponential(1e-3))
    modes = smoothed(ModeLooks(np.array([0, t]), stamp, np.log(ratio)), chain)

    at, site = np.divmod(np.arange(t * k), k)
    hazard = (Exponential(1e-3),)
    known = SiteDynamics(hazard * k, np.zeros(k), hazard, np.zeros(1), np.ones(1), np.full(k, 1 / k))
    found = follow_sites(
        np.full(k, 1 / k), np.zeros(k, np.int64), known,
        SiteLooks(stamp[at], np.zeros(t * k, np.int64), site, np.arange(t * k), hit.ravel()),
        certain(rate.ravel()),
        start_s=stamp[0], until_s=stamp[-1], p_false=p_false, p_occluded=0.0,
    )  # fmt: skip
    np.testing.assert_allclose(found.p_here, np.exp(modes.log_filtered[-1]), rtol=1e-10)


@pytest.mark.parametrize("absence", [1 / 200.0, 1 / 3000.0])
def test_a_long_gap_is_that_of_a_continuous_chain(absence: float) -> None:
    """Constant hazards, over up to thirty mean lifetimes: the matrix exponential of the same jumps."""
    from scipy.linalg import expm

    stay, p_hop, share = 1 / 300.0, 0.3, np.array([0.5, 0.3])
    known = SiteDynamics(
        (Exponential(stay),) * 2, np.zeros(2), (Exponential(absence),), np.zeros(1), np.array([p_hop]), share
    )
    hop = p_hop * share[::-1] / (1 - share)
    rate = np.array([[0.0, *(absence * share)], [stay * (1 - hop[0]), 0, stay * hop[0]], [0, stay * hop[1], 0]])
    rate[2, 0] = stay * (1 - hop[1])
    rate -= np.diag(rate.sum(axis=1))
    for gap, within in ((30.0, 1e-4), (300.0, 1e-3), (2400.0, 0.01), (9000.0, 0.02)):
        found = follow_sites(
            np.array([0.9, 0.0]), np.zeros(2, np.int64), known, looks([]), certain(np.ones(0)),
            start_s=0.0, until_s=gap, p_false=0.1,
        )  # fmt: skip
        exact = np.array([0.1, 0.9, 0.0]) @ expm(rate * gap)
        np.testing.assert_allclose(found.p_here, exact[1:], atol=within)
        np.testing.assert_allclose(found.p_stayed, [0.9 * np.exp(-stay * gap), 0.0], rtol=1e-9)
        np.testing.assert_allclose(found.p_before, found.p_here, rtol=1e-12)


def one(rows: list[tuple[float, int, int, int, bool]], p_here: float = 0.9, **changed: Any) -> SiteBeliefs:
    """One clique with one site, without end, looked at along one line of sight of 4 hits in 5 looks."""
    known = alone(Exponential(1e-30), np.zeros(1))
    line = free(np.array([4.0]), np.array([1.0]))
    given_ = {"lines": line, "start_s": 0.0, "until_s": 1e3, "p_false": 0.01, "p_occluded": 0.0, "occluded_s": 0.0}
    given_ |= changed
    return follow_sites(np.array([p_here]), np.zeros(1, np.int64), known, looks(rows), **given_)


def test_looks_along_a_line_of_sight_weigh_as_exchangeable_ones() -> None:
    found = one([(float(t), 0, 0, 0, t == 3) for t in range(20)])
    log_there = betaln(4.0 + 1, 1.0 + 19) - betaln(4.0, 1.0)
    log_gone = np.log(0.01) + 19 * np.log(0.99)
    odds = np.log(0.9 / 0.1) + log_there - log_gone
    assert found.p_here[0] == pytest.approx(1 / (1 + np.exp(-odds)), rel=1e-9)
    assert found.trace.log_odds.sum() == pytest.approx(log_there - log_gone, rel=1e-9)


@pytest.mark.parametrize("pattern", ["0", "000000", "0010000", "1100000000"])
def test_occlusion_is_near_the_sum_over_who_was_occluded(pattern: str) -> None:
    p_occluded, p_false = 0.2, 0.01
    hit = np.array([c == "1" for c in pattern])
    found = one([(float(t), 0, 0, 0, bool(h)) for t, h in enumerate(hit)], p_occluded=p_occluded)
    total = 0.0
    for hidden in itertools.product([False, True], repeat=len(hit)):
        veiled = np.array(hidden)
        seen, n = hit[~veiled], int(veiled.sum())
        log_p = n * np.log(p_occluded) + (len(hit) - n) * np.log1p(-p_occluded)
        log_p += betaln(4.0 + seen.sum(), 1.0 + (~seen).sum()) - betaln(4.0, 1.0)
        total += np.exp(log_p + np.where(hit[veiled], np.log(p_false), np.log1p(-p_false)).sum())
    exact = np.log(total) - np.where(hit, np.log(p_false), np.log1p(-p_false)).sum()
    assert found.log_evidence[0] == pytest.approx(np.log(0.9 * np.exp(exact) + 0.1), abs=0.12 * len(pattern))
    assert found.trace.log_odds.sum() == pytest.approx(exact, abs=0.12 * len(pattern))


@pytest.mark.parametrize("pattern", ["0", "000000", "0010000", "1100000000", "0000000001"])
def test_somebody_who_stands_before_it_for_a_while_is_the_sum_over_his_comings_and_goings(pattern: str) -> None:
    p_occluded, occluded_s, p_false, rate = 0.1, 3.0, 0.01, 0.7
    hit = np.array([c == "1" for c in pattern])
    stamp = np.cumsum(np.random.default_rng(len(pattern)).uniform(0.3, 2.0, len(hit)))
    found = one(
        [(float(t), 0, 0, 0, bool(h)) for t, h in zip(stamp, hit, strict=True)],
        lines=free(SURE * np.array([rate]), SURE * np.array([1 - rate])),
        p_occluded=p_occluded,
        occluded_s=occluded_s,
    )
    go = 1.0 / occluded_s
    come = go * p_occluded / (1.0 - p_occluded)
    rates = np.array([[-come, come], [go, -go]])
    gone = np.where(hit, p_false, 1 - p_false)
    likelihood = np.column_stack([np.where(hit, rate, 1 - rate), gone]) / gone[:, None]
    p = np.array([1 - p_occluded, p_occluded]) * likelihood[0]
    for k in range(1, len(hit)):
        p = (p @ expm(rates * (stamp[k] - stamp[k - 1]))) * likelihood[k]
    assert found.log_evidence[0] == pytest.approx(np.log(0.9 * p.sum() + 0.1), rel=1e-6)


def test_a_blind_spell_is_one_event() -> None:
    spell = [(0.3 * t, 0, 0, 0, t < 20) for t in range(100)]
    known = {"lines": free(SURE * np.array([0.8]), SURE * np.array([0.2])), "p_occluded": 0.05}
    for_a_while = one(spell, occluded_s=20.0, **known).trace.log_odds[20:].sum()
    every_frame = one(spell, occluded_s=0.0, **known).trace.log_odds[20:].sum()
    assert -10.0 < for_a_while < -3.0  # he came, once: log 0.05, and did not leave
    assert every_frame < -80.0


@pytest.mark.parametrize("pattern", ["000000", "011000", "110001"])
def test_free_and_blocked_lines_are_the_sum_over_both_at_every_frame(pattern: str) -> None:
    """Whether a line is free follows from whether the last one was as surely as what is known of each allows."""
    rng = np.random.default_rng(len(pattern))
    hit = np.array([c == "1" for c in pattern])
    p_free, rate = rng.random(len(hit)), rng.uniform(0.4, 0.9, len(hit))
    p_free[2] = p_free[1]
    p_blocked, p_false, p_occluded = 0.04, 0.01, 0.1
    lines = Lines(p_free, SURE * rate, SURE * (1 - rate), p_blocked)
    found = one([(float(t), 0, 0, t, bool(h)) for t, h in enumerate(hit)], lines=lines, p_occluded=p_occluded)

    gone = np.where(hit, p_false, 1 - p_false)
    seen = (1 - p_occluded) * np.where(hit, rate, 1 - rate) + p_occluded * gone
    likelihood = np.column_stack([np.where(hit, p_blocked, 1 - p_blocked), seen]) / gone[:, None]
    total = 0.0
    for path in itertools.product([0, 1], repeat=len(hit)):
        p = 1.0
        for t, state in enumerate(path):
            if t == 0:
                opens = p_free[0]
            else:  # the two have the largest correlation that their probabilities allow
                both = min(p_free[t], p_free[t - 1])
                opens = both / p_free[t - 1] if path[t - 1] else (p_free[t] - both) / (1 - p_free[t - 1])
            p *= (opens if state else 1 - opens) * likelihood[t, state]
        total += p
    assert found.log_evidence[0] == pytest.approx(np.log(0.9 * total + 0.1), rel=1e-9)


def test_one_frame_says_no_more_against_a_clique_than_that_it_was_occluded() -> None:
    known = alone(Exponential(1e-30), np.zeros(1))
    rows = looks([(1.0, 0, 0, key, False) for key in range(50)])
    found = follow_sites(
        np.array([0.9]), np.zeros(1, np.int64), known, rows, free(np.full(50, 40.0), np.full(50, 1.0)),
        start_s=0.0, until_s=1.0, p_false=0.01, p_occluded=0.05,
    )  # fmt: skip
    assert found.trace.log_odds[0] == pytest.approx(np.log(0.05), rel=1e-6)


def test_misses_along_a_hidden_line_of_sight_say_little() -> None:
    """A hundred misses from where it was never seen, against ten from where it was seen a hundred times."""
    known = alone(Exponential(1e-30), np.zeros(1))

    def after(alpha: float, beta: float, n: int) -> float:
        rows = looks([(float(t), 0, 0, 0, False) for t in range(n)])
        found = follow_sites(
            np.array([0.9]), np.zeros(1, np.int64), known, rows, free(np.array([alpha]), np.array([beta])),
            start_s=0.0, until_s=1e3, p_false=0.01, occluded_s=0.0,
        )  # fmt: skip
        return float(found.p_here[0])

    assert after(0.5, 60.0, 100) > 0.8
    assert after(90.0, 10.0, 10) < 1e-4


def test_a_clique_that_is_held_is_never_away() -> None:
    rows = looks([(float(t), 0, t % 3, t % 3, False) for t in range(90)])
    lines = free(np.full(3, 50.0), np.full(3, 1.0))
    known, sites = dynamics(p_hop=np.zeros(1)), np.zeros(3, np.int64)
    loose = follow_sites(np.array([0.5, 0.1, 0.0]), sites, known, rows, lines, start_s=0.0, until_s=90.0, p_false=0.01)
    assert loose.p_here.sum() < 0.1
    for p_here in (np.array([0.5, 0.1, 0.0]), np.zeros(3)):
        firm = follow_sites(
            p_here, sites, known, rows, lines, start_s=-500.0, until_s=90.0, p_false=0.01, held=np.array([True])
        )
        assert firm.p_here.sum() == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(firm.trace.p_exists, 1.0, atol=1e-12)


def test_it_is_followed_from_one_site_to_another() -> None:
    rows = [(float(t), 0, k, k, k == (0 if t < 50 else 2)) for t in range(100) for k in range(3)]
    found = follow_sites(
        np.array([0.9, 0.0, 0.0]), np.zeros(3, np.int64), dynamics(), looks(rows),
        free(np.full(3, 16.0), np.full(3, 4.0)), start_s=0.0, until_s=100.0, p_false=0.01,
    )  # fmt: skip
    assert found.p_here[2] > 0.99
    assert found.p_stayed[2] < 1e-6
    row = looks(rows)
    np.testing.assert_allclose(found.weight[(row.site == 0) & (row.stamp_s < 47)], 1.0, atol=1e-3)
    np.testing.assert_allclose(found.weight[(row.site == 2) & (row.stamp_s > 53)], 1.0, atol=1e-3)
    np.testing.assert_allclose(found.weight[row.site == 1], 0.0, atol=1e-3)


@st.composite
def _worlds(draw: st.DrawFn) -> dict[str, Any]:
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    c = draw(st.integers(1, 4))
    clique_of_site = np.sort(rng.integers(0, c, draw(st.integers(1, 7))))
    rng.shuffle(clique_of_site)
    s, n, k = len(clique_of_site), draw(st.integers(1, 40)), 5
    total = np.bincount(clique_of_site, minlength=c)[clique_of_site]
    site = rng.integers(0, s, n)
    priors = (GENERAL, Exponential(1e-3), Weibull(1e3, 2.0))
    return {
        "p_here": rng.random(s) / total,
        "clique_of_site": clique_of_site,
        "dynamics": SiteDynamics(
            tuple(priors[i] for i in rng.integers(0, 3, s)), -rng.exponential(1e3, s),
            tuple(priors[i] for i in rng.integers(0, 3, c)), -rng.exponential(1e3, c),
            rng.choice([0.0, 0.5, 1.0], c), rng.random(s) * rng.choice([0.0, 1.0]) / total,
        ),
        "looks": SiteLooks(
            np.round(rng.uniform(0.0, 20.0, n)), clique_of_site[site], site, rng.integers(0, k, n), rng.random(n) < 0.5
        ),
        "lines": Lines(rng.choice([0.0, 0.5, 1.0, rng.random()], k), *rng.uniform(0.5, 30.0, (2, k)), 0.03),
        "start_s": -draw(st.sampled_from([0.0, 1.0, 1e4])),
        "until_s": 20.0 + draw(st.sampled_from([0.0, 1e3])),
        "p_false": 0.01,
        "p_occluded": draw(st.sampled_from([0.0, 0.05])),
    }  # fmt: skip


@given(_worlds(), st.integers(0, 1000))
def test_laws(world: dict[str, Any], which: int) -> None:
    found = follow_sites(**world)
    clique, n_cliques = world["clique_of_site"], len(world["dynamics"].p_hop)
    for p in (found.p_here, found.p_before):
        assert (p >= 0.0).all()
        assert (np.bincount(clique, p, minlength=n_cliques) <= 1.0 + 1e-9).all()
    assert (found.p_stayed <= found.p_here + 1e-12).all()
    assert ((found.weight >= 0.0) & (found.weight <= 1.0 + 1e-9)).all()
    assert ((found.trace.p_exists >= 0.0) & (found.trace.p_exists <= 1.0 + 1e-9)).all()
    assert np.isfinite(found.log_evidence).all()
    assert np.isfinite(found.trace.log_odds).all()

    # The rows of looks may come in any order, and so may the sites.
    rng = np.random.default_rng(which)
    look, site = rng.permutation(len(world["looks"])), rng.permutation(len(clique))
    renamed, given_, known = np.argsort(site), world["looks"], world["dynamics"]
    mixed = follow_sites(
        **world
        | {
            "p_here": world["p_here"][site],
            "clique_of_site": clique[site],
            "dynamics": SiteDynamics(
                tuple(known.stay[i] for i in site), known.since_s[site], known.absence, known.away_since_s, known.p_hop,
                known.return_share[site],
            ),
            "looks": SiteLooks(
                given_.stamp_s[look], given_.clique[look], renamed[given_.site[look]], given_.key[look],
                given_.hit[look],
            ),
        }
    )  # fmt: skip
    if world["p_occluded"] == 0.0:  # within one frame the order of a place's looks is of no matter then
        np.testing.assert_allclose(mixed.p_here, found.p_here[site], rtol=1e-7, atol=1e-12)
        np.testing.assert_allclose(mixed.weight, found.weight[look], rtol=1e-7, atol=1e-12)

    # A miss that becomes a hit speaks for the site.
    row = which % len(look)
    hit = given_.hit.copy()
    hit[row] = True
    better = follow_sites(**world | {"looks": SiteLooks(given_.stamp_s, given_.clique, given_.site, given_.key, hit)})
    assert better.weight[row] >= found.weight[row] - 1e-9


def test_beliefs_drawn_from_the_model_are_calibrated() -> None:
    """Of cliques that are believed to be there with 30 %, 30 % are there."""
    rng = np.random.default_rng(11)
    n, session_s = 4000, 30.0
    stay, absence = 1 / 4000.0, 1 / 3000.0
    gap = 5000.0
    there = rng.random(n) < 0.8
    clock = np.zeros(n)
    state = there.copy()
    stamps = gap + np.arange(6) * session_s / 5
    truth = np.empty((n, 6), dtype=np.bool_)
    for k, stamp in enumerate(stamps):
        moving = np.ones(n, dtype=np.bool_)
        while moving.any():  # exponential stays and absences: what is left of one is one
            until = clock + rng.exponential(np.where(state, 1 / stay, 1 / absence))
            flips = moving & (until < stamp)
            clock = np.where(moving, np.minimum(until, stamp), clock)
            state = state ^ flips
            moving = flips
        truth[:, k] = state
    rate = rng.beta(2.0, 1.0, n)
    veiled = rng.random((n, 6)) < 0.05
    hit = np.where(truth & ~veiled, rng.random((n, 6)) < rate[:, None], rng.random((n, 6)) < 0.02)
    known = SiteDynamics(
        (Exponential(stay),) * n, np.zeros(n), (Exponential(absence),) * n, np.zeros(n), np.zeros(n), np.ones(n)
    )
    clique = np.repeat(np.arange(n), 6)
    found = follow_sites(
        np.full(n, 0.8), np.arange(n), known, SiteLooks(np.tile(stamps, n), clique, clique, clique, hit.ravel()),
        free(np.full(n, 2.0), np.full(n, 1.0)), start_s=0.0, until_s=stamps[-1], p_false=0.02,
    )  # fmt: skip
    for p, fact in (
        (found.p_before, truth[:, 0]),
        (found.p_here, truth[:, -1]),
        (found.trace.p_exists.reshape(n, 6)[:, 2], truth[:, 2]),
    ):
        bins = np.digitize(p, [0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98])
        for b in np.unique(bins):
            inside = bins == b
            if inside.sum() >= 50:
                error = 3.5 * np.sqrt(max((p[inside] * (1 - p[inside])).mean(), 1e-4) / inside.sum())
                assert fact[inside].mean() == pytest.approx(p[inside].mean(), abs=error + 0.005)


def test_nothing_to_follow() -> None:
    none = np.zeros(0, dtype=np.int64)
    known = SiteDynamics((), np.zeros(0), (), np.zeros(0), np.zeros(0), np.zeros(0))
    found = follow_sites(
        np.zeros(0), none, known, looks([]), free(np.zeros(0), np.zeros(0)), start_s=0.0, until_s=1.0, p_false=0.1
    )
    assert len(found.p_here) == len(found.weight) == len(found.trace.clique_id) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"until_s": 5.0}, "until_s.*before the last look"),
        ({"start_s": 11.0}, "stamp_s.*before"),
        ({"p_false": 0.0}, "p_false"),
        ({"p_occluded": 1.0}, "p_occluded"),
        ({"lines": free(np.zeros(1), np.ones(1))}, "hits.*row 0"),
        ({"lines": Lines(np.full(1, 1.5), np.ones(1), np.ones(1), 0.1)}, "p_free.*row 0"),
        ({"lines": Lines(np.ones(1), np.ones(1), np.ones(1), 1.0)}, "p_blocked"),
        ({"p_here": np.array([0.5, 0.6, 0.0])}, "p_here.*clique 0"),
        ({"clique_of_site": np.array([0, 0, 1])}, "clique_of_site.*does not exist"),
        ({"looks": looks([(10.0, 0, 3, 0, True)])}, "site.*does not exist"),
        ({"looks": looks([(10.0, 0, 0, 1, True)])}, "key.*does not exist"),
        ({"dynamics": dynamics(since_s=np.array([0.0, np.nan, 0.0]))}, "since_s.*row 1"),
        ({"dynamics": dynamics(stay=(GENERAL, GENERAL))}, "stay.*shape"),
        ({"dynamics": dynamics(p_hop=np.array([1.5]))}, "p_hop"),
    ],
)
def test_what_cannot_be_is_refused(change: dict[str, Any], words: str) -> None:
    world = {
        "p_here": np.array([0.5, 0.1, 0.0]), "clique_of_site": np.zeros(3, np.int64), "dynamics": dynamics(),
        "looks": looks([(10.0, 0, 0, 0, True)]), "lines": free(np.ones(1), np.ones(1)), "start_s": 0.0,
        "until_s": 10.0, "p_false": 0.01,
    }  # fmt: skip
    follow_sites(**world)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=words):
        follow_sites(**world | change)  # type: ignore[arg-type]
