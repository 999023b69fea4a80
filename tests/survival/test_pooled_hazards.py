"""Hazards by age that classes share, against differences, laws that samples are drawn from, and what was stated."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.maps.lives import general_purpose
from evermap.survival import (
    Exponential,
    LifetimePrior,
    LogNormal,
    Mixture,
    PiecewiseConstantHazard,
    Weibull,
    hazard_grid,
    never_leaves,
)
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.hazard_grid import DRAWS, LEAST_DRAWS
from evermap.survival.hazard_posterior import HazardPosterior
from evermap.survival.pooled_hazards import EDGES_S, Statement, _learn_once, learn_hazards
from evermap.survival.stay_likelihood import StayAges, StayLikelihood
from evermap.types import IntArray

HOUR_S, DAY_S = 3600.0, 86_400.0
USUAL = general_purpose()
TWO_KINDS = Mixture.of([Exponential.from_mean(2.0 * HOUR_S), Exponential.from_mean(30.0 * DAY_S)], [0.5, 0.5])


def followed(prior: LifetimePrior, n: int, until_s: float, seed: int, entry_s: float = 0.0) -> CensoredLifetimes:
    """Lifetimes that were seen to end, or to outlast a watch; of those that lived to be met."""
    lifetime = prior.sample(np.random.default_rng(seed), 20 * n)
    lifetime = lifetime[lifetime > entry_s][:n]
    gone = lifetime < until_s
    return CensoredLifetimes.of(np.minimum(lifetime, until_s), np.where(gone, lifetime, np.inf), entry_s)


def learned(data: CensoredLifetimes, said: Statement | None = None) -> HazardPosterior:
    return learn_hazards(StayAges.of_samples(data), [said], USUAL)[0]


def test_derivatives_of_the_likelihood_are_those_of_differences() -> None:
    """With two instants of arrival, ends and none, and returns between looks that nobody saw."""
    rng = np.random.default_rng(1)
    first = np.abs(rng.normal(2e4, 1e4, (7, 2)))
    last = first + np.abs(rng.normal(1e5, 3e4, (7, 1)))
    gone = last + 4e4
    gone[:3] = np.inf
    back, rate = np.array([0.0, 0.3, 0.3, 0.0, 0.2, 0.1, 0.0]), np.array([0.0, 0.0, 1e-5, 0.0, 1e-5, 0.0, 1e-5])
    stays = StayAges(first, last, gone, rng.uniform(0.5, 2.0, 7), np.zeros(7, int), np.full((7, 2), 3e4), back, rate)
    likelihood = StayLikelihood(stays, EDGES_S)
    hazard = 1e-5 * np.exp(rng.normal(0.0, 0.3, len(EDGES_S)))
    _, gradient, curvature = likelihood(hazard)
    for k in range(16, 23):
        step = np.where(np.arange(len(hazard)) == k, 1e-5, 0.0)
        (above, slope, _), (below, slope_below, _) = (likelihood(hazard * np.exp(s)) for s in (step, -step))
        assert gradient[k] == pytest.approx((above - below) / 2e-5, abs=1e-8)
        np.testing.assert_allclose(curvature[k], (slope - slope_below) / 2e-5, atol=1e-8)


def test_the_likelihood_of_a_stay_is_that_of_its_law() -> None:
    """Of a constant hazard: entry, a bounded end, one that was observed, and none."""
    data = CensoredLifetimes.of([5.0, 9.0, 20.0, 7.0], [8.0, 9.0, np.inf, 30.0], [2.0, 0.0, 0.0, 7.0])
    value, _, _ = StayLikelihood(StayAges.of_samples(data), EDGES_S)(np.full(len(EDGES_S), 0.1))
    parts = [
        -0.3 + np.log(-np.expm1(-0.3)), -0.9 + np.log(0.1) + np.log(9e-9), -2.0, np.log(-np.expm1(-2.3)),
    ]  # fmt: skip
    assert value == pytest.approx(sum(parts), rel=1e-6)


def test_two_kinds_of_things_are_told_by_their_hazard() -> None:
    """Half leave within hours, half within months: no family of one hump has this curve."""
    found, ages_s = learned(followed(TWO_KINDS, 400, 20.0 * DAY_S, seed=2)), np.array([1.0, 6.0, 24.0, 72.0]) * HOUR_S
    _, lower, upper = found.survival(ages_s)
    truth = np.exp(TWO_KINDS.log_survival(ages_s))
    assert ((lower < truth) & (truth < upper)).all()
    assert (upper - lower < 0.15).all()
    next_day = np.exp(found.prior().log_conditional_survival(DAY_S, 2.0 * DAY_S))
    assert next_day == pytest.approx(np.exp(TWO_KINDS.log_conditional_survival(DAY_S, 2.0 * DAY_S)), abs=0.02)


def test_what_lived_to_be_met_says_nothing_of_ages_before() -> None:
    """Everything is met at two days: the ages before keep their prior, wide as it is, and this is told."""
    law = Weibull(3.0 * DAY_S, 1.6)
    found = learned(followed(law, 200, 20.0 * DAY_S, seed=3, entry_s=2.0 * DAY_S))
    below_s, _ = found.seen_s
    assert 0.3 * DAY_S < below_s <= 2.0 * DAY_S
    _, lower, upper = found.survival(2.0 * DAY_S)
    assert upper - lower > 0.6
    later = np.exp(found.prior().log_conditional_survival(2.0 * DAY_S, 4.0 * DAY_S))
    assert later == pytest.approx(np.exp(law.log_conditional_survival(2.0 * DAY_S, 4.0 * DAY_S)), abs=0.08)


def test_the_end_of_a_shift_is_within_the_bands() -> None:
    """All leave after about eight hours and are met earlier, at any age: a process that is not steep enough for that
    end raises hazards long before it, and is too sure that one in twenty has left by then.
    """
    law = LogNormal.from_half_life(8.0 * HOUR_S, 0.1)
    ages_s = np.asarray(law.quantile(np.array([0.05, 0.1, 0.5, 0.9])))
    truth, inside, widths = np.exp(law.log_survival(ages_s)), [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        lifetime, entry = law.sample(rng, 2000), rng.uniform(0.0, 8.0 * HOUR_S, 2000)
        met = np.flatnonzero(lifetime > entry)[:100]
        gap = 0.8 * HOUR_S * rng.gamma(2.0, 0.5, 100)
        left = entry[met] + np.floor((lifetime - entry)[met] / gap) * gap
        found = learned(CensoredLifetimes.of(left, left + gap, entry[met]))
        _, lower, upper = found.survival(ages_s)
        inside.append((lower <= truth) & (truth <= upper))
        widths.append(upper[0] - lower[0])
    assert np.mean(inside) > 0.85
    assert np.mean(inside, axis=0)[0] > 0.8
    assert np.mean(widths) < 0.18


def test_a_short_stop_shortens_no_parked_life() -> None:
    """Of 42 cars that stand while somebody passes, one goes on after four seconds: the others are there an hour on."""
    rng = np.random.default_rng(0)
    watched = np.append(rng.uniform(8.0, 40.0, 41), 4.0)
    found = learned(CensoredLifetimes.of(watched, np.append(np.full(41, np.inf), 5.0)))
    hour_later = np.exp(found.prior().log_conditional_survival(20.0, HOUR_S))
    assert hour_later >= 0.9
    assert found.prior().log_survival(60.0) < 4.5 * USUAL.log_survival(60.0)  # that cars stop is learned


@pytest.mark.parametrize("leaving", [0, 2, 4, 6])
def test_vans_that_leave_in_view_leave_the_others_standing(leaving: int) -> None:
    """A class of twelve beside one of 24, both watched for a minute: nobody saw an age between a minute and a day, so
    it cannot be certain that what stays is gone by then (a Weibull law says .0005).
    """
    rng = np.random.default_rng(1)
    watched, gone = rng.uniform(10.0, 60.0, 36), np.full(36, np.inf)
    gone[:leaving] = watched[:leaving] + 0.5
    stays = StayAges.of_samples(CensoredLifetimes.of(watched, gone), np.repeat([0, 1], [12, 24]))
    van, car, _ = learn_hazards(stays, [None, None], USUAL)
    there = [float(np.exp(of.prior().log_conditional_survival(60.0, DAY_S))) for of in (van, car)]
    assert there[0] > 0.25
    assert there[1] >= there[0] - 1e-3  # where none left they are alike, but for the draws


def test_the_same_evidence_is_learned_from_once_and_in_any_order() -> None:
    """Equal stays and statements give the very posterior that is there; the order of stays is nothing."""
    rng, n = np.random.default_rng(4), 60
    lasting, group = rng.weibull(0.8, n) * DAY_S, rng.integers(0, 3, n)
    left, gone = np.minimum(lasting, 2.0 * DAY_S), np.where(lasting < 2.0 * DAY_S, 1.2 * lasting, np.inf)

    def taught(order: IntArray, worth: float = 20.0) -> list[HazardPosterior]:
        said = [Statement(Exponential.from_mean(DAY_S), worth), None, None]
        return learn_hazards(
            StayAges.of_samples(CensoredLifetimes.of(left[order], gone[order]), group[order]), said, USUAL
        )

    once = taught(np.arange(n))
    assert all(one is other for one, other in zip(once, taught(np.arange(n)), strict=True))
    assert taught(np.arange(n), 21.0)[0] is not once[0]
    ages_s, other = np.array([0.01, 0.3, 1.0, 3.0]) * DAY_S, taught(rng.permutation(n))
    for kind in range(4):
        assert other[kind] is not once[kind]
        np.testing.assert_allclose(other[kind].survival(ages_s), once[kind].survival(ages_s), atol=1e-9)


def test_likely_members_of_the_grid_have_most_draws() -> None:
    """An unlikely one has few, and its probability all the same: what is expected is what many draws tell."""
    data, ages_s = followed(Exponential.from_mean(DAY_S), 60, 5.0 * DAY_S, seed=6), np.array([0.1, 1.0, 3.0]) * DAY_S
    few = learned(data)
    assert len(few.weight) < 3 * DRAWS
    assert few.weight[-LEAST_DRAWS:].sum() < 0.06
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hazard_grid, "LEAST_DRAWS", 16 * DRAWS)
        patch.setattr(hazard_grid, "NEGLIGIBLE", 0.0)
        _learn_once.cache_clear()
        many = learned(data)
        _learn_once.cache_clear()
    assert len(many.weight) == 8 * 16 * DRAWS
    for one, other, within in zip(few.survival(ages_s), many.survival(ages_s), (0.01, 0.03, 0.03), strict=True):
        np.testing.assert_allclose(one, other, atol=within)


def test_classes_lean_on_each_other_and_a_new_one_on_all() -> None:
    """Five classes of which all leave within a day or two; the sixth was seen twice."""
    law = Exponential.from_mean(DAY_S)
    data = [followed(law, n, 9.0 * DAY_S, seed) for seed, n in enumerate([40, 40, 40, 40, 40, 2])]
    samples = CensoredLifetimes.of(*(np.concatenate([getattr(d, k) for d in data]) for k in ("left_s", "right_s")))
    of_all = StayAges.of_samples(samples, np.repeat(np.arange(6), [40, 40, 40, 40, 40, 2]))
    found = learn_hazards(of_all, [None] * 6, USUAL)
    alone = learn_hazards(StayAges.of_samples(data[-1]), [None], USUAL)[0]
    two_days = [np.asarray(of.survival(2.0 * DAY_S)) for of in (found[0], found[5], found[6], alone)]
    widths = [float(upper - lower) for _, lower, upper in two_days]
    assert widths[0] < widths[1] < widths[2]
    assert widths[1] < 0.9 * widths[3]
    assert float(two_days[2][0]) < 0.4


def two_looks(seen_again: list[int], gone: list[int], back: float) -> StayAges:
    """Stays of some classes at two looks, a day apart: how many were there at both, and how many at the first alone;
    what had left between them may have been back.
    """
    rows = [(DAY_S, np.inf, DAY_S, n, k) for k, n in enumerate(seen_again)]
    rows += [(100.0, DAY_S, 100.0, n, k) for k, n in enumerate(gone) if n]
    last, end, gap, weight, group = (np.array(column) for column in zip(*rows, strict=True))
    some, column = len(rows), np.ones((len(rows), 1))
    return StayAges(
        0.0 * column, last[:, None], end[:, None], weight.astype(float), group, gap[:, None] * np.ones((1, 2)),
        np.full(some, back), np.zeros(some),
    )  # fmt: skip


@pytest.mark.parametrize("back", [0.3, 0.5])
def test_what_all_were_seen_again_of_lasts_though_any_may_have_been_away(back: float) -> None:
    """Likelihoods with unseen returns are convex far out, of many classes at once: together they lose no prior."""
    seen_again, gone = [12, 5, 6, 6, 8, 3], [0, 3, 0, 2, 2, 2]
    found = learn_hazards(two_looks(seen_again, gone, back), [None] * 6, USUAL)
    day, two_days = (np.array([float(one.survival(age_s)[0]) for one in found]) for age_s in (DAY_S, 2.0 * DAY_S))
    assert (day[[0, 2]] > 0.88).all(), "of 12 and of 6 none had gone"
    assert (two_days[[0, 2]] / day[[0, 2]] > 0.92).all()
    share = np.array(seen_again) / (np.array(seen_again) + np.array(gone))
    assert (np.abs(day[:6] - share) < 0.16).all()  # classes lean on each other
    of_class = [
        StayLikelihood(two_looks(seen_again, gone, back).of_group(k), one.edges_s) for k, one in enumerate(found[:6])
    ]
    expected = [float(one.weight @ each.values(one.rates)) for one, each in zip(found, of_class, strict=False)]
    usual = learn_hazards(StayAges.empty(), [], USUAL, found[0].edges_s)[0]
    before = [float(usual.weight @ each.values(usual.rates)) for each in of_class]
    assert sum(expected) > sum(before), "what was seen is more probable by what was learned from it (Gibbs)"


STATED = {
    "steps": PiecewiseConstantHazard((0.0, 2.0 * DAY_S), (0.0, 10.0 / DAY_S)),
    "two kinds": TWO_KINDS,
    "some stay": Mixture.of([Weibull(DAY_S, 1.5), never_leaves()], [0.9, 0.1]),
    "never": never_leaves(),
}


@pytest.mark.parametrize("name", STATED)
def test_what_is_stated_comes_back_where_nothing_was_seen(name: str) -> None:
    ages_s = np.array([0.02, 0.3, 1.0, 1.9, 3.0, 20.0]) * DAY_S
    found = learned(CensoredLifetimes.of([0.01], [np.inf]), Statement(STATED[name], 20.0)).prior()
    np.testing.assert_allclose(np.exp(found.log_survival(ages_s)), np.exp(STATED[name].log_survival(ages_s)), atol=1e-9)


def test_a_statement_is_worth_as_many_stays_as_it_says() -> None:
    """A constant hazard, and as many stays that end as it is worth, after a fifth of its mean: between both."""
    said, n = Exponential.from_mean(10.0 * DAY_S), 40
    shorter = followed(Exponential.from_mean(2.0 * DAY_S), n, 50.0 * DAY_S, seed=5)
    at_s = 2.0 * DAY_S
    found = [
        float(np.exp(learned(shorter, Statement(said, worth)).prior().log_survival(at_s))) for worth in (2, n, 4000)
    ]
    assert found[0] < found[1] < found[2]
    assert found[0] < 0.45
    assert 0.5 < found[1] < 0.7
    assert found[2] == pytest.approx(np.exp(-0.2), abs=0.02)


def test_an_end_where_none_was_stated_is_possible() -> None:
    """Nothing leaves within two days, it was said; thirty of thirty left within an hour."""
    data = CensoredLifetimes.of(np.full(30, 1800.0), np.full(30, HOUR_S))
    found = learned(data, Statement(STATED["steps"], 5.0))
    assert np.isfinite(found.rates).all()
    assert np.exp(found.survival(HOUR_S)[0]) < np.e * 0.9
