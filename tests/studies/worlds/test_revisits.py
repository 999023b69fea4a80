"""Sequences of looks follow the laws of Rosen 2016 section VII-A, checked against closed forms."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from evermap.errors import ConfigError
from evermap_studies.worlds.revisits import RevisitConfig, Revisits, simulate_revisits

BUSY = RevisitConfig(horizon_s=300.0, revisit_rate_hz=0.2, look_rate_hz=2.0, p_leave=0.3, p_miss=0.15, p_false=0.25)
N = 4000


@pytest.fixture(scope="module")
def drawn() -> Revisits:
    return simulate_revisits(N, BUSY, seed=5)


def first_of_visit(data: Revisits, visit: int) -> np.ndarray:
    """Row of the first look of the given visit in every sequence."""
    at = np.flatnonzero(data.visit == visit)
    return at[np.unique(data.sequence[at], return_index=True)[1]]


def test_lifetimes_are_uniform(drawn: Revisits) -> None:
    assert stats.kstest(drawn.survival_s, stats.uniform(0.0, 300.0).cdf).pvalue > 1e-3


def test_first_look_comes_after_an_exponential_time(drawn: Revisits) -> None:
    assert stats.kstest(drawn.stamp_s[drawn.first[:-1]], stats.expon(scale=0.5).cdf).pvalue > 1e-3


def test_looks_of_a_visit_are_geometric_with_exponential_gaps(drawn: Revisits) -> None:
    begins = first_of_visit(drawn, 0), first_of_visit(drawn, 1)
    looks = begins[1] - begins[0]
    assert len(looks) == N
    counts = np.bincount(np.minimum(looks, 12), minlength=13)[1:]
    geometric = stats.geom(0.3)
    expected = N * np.append(geometric.pmf(np.arange(1, 12)), geometric.sf(11))
    assert stats.chisquare(counts, expected).pvalue > 1e-3
    first, several = begins[0][looks > 1], looks[looks > 1]
    assert stats.kstest(drawn.stamp_s[first + 1] - drawn.stamp_s[first], stats.expon(scale=0.5).cdf).pvalue > 1e-3
    assert np.all(drawn.visit[first + several - 1] == 0)


def test_between_visits_pass_two_exponential_times(drawn: Revisits) -> None:
    """The robot is away for Exp(lambda_R); the first look of the next visit comes Exp(lambda_O) later."""
    begin = first_of_visit(drawn, 1)
    gap = drawn.stamp_s[begin] - drawn.stamp_s[begin - 1]

    def cdf(t: Any) -> Any:
        return 1.0 - (2.0 * np.exp(-0.2 * t) - 0.2 * np.exp(-2.0 * t)) / (2.0 - 0.2)

    assert stats.kstest(gap, cdf).pvalue > 1e-3


@pytest.mark.parametrize("rate_hz", [1 / 100, 1 / 50, 1 / 5])
def test_mean_number_of_looks_is_that_of_the_two_state_chain(rate_hz: float) -> None:
    """Looking becomes away at a = lambda_O P_N, away becomes looking at b = lambda_R: the integral of P(looking)."""
    config = RevisitConfig(revisit_rate_hz=rate_hz)
    looks = simulate_revisits(3000, config, seed=1).looks
    a, b, length_s = config.look_rate_hz * config.p_leave, rate_hz, config.horizon_s
    share = b * length_s / (a + b) + a / (a + b) ** 2 * -np.expm1(-(a + b) * length_s)
    expected = config.look_rate_hz * share
    assert looks.mean() == pytest.approx(expected, abs=4.0 * looks.std() / np.sqrt(len(looks)))


def test_detector_errs_as_often_as_stated(drawn: Revisits) -> None:
    there = drawn.stamp_s <= drawn.survival_s[drawn.sequence]
    for rows, chance in ((there, 0.85), (~there, 0.25)):
        hits, looks = int(drawn.detected[rows].sum()), int(rows.sum())
        assert looks > 10_000
        assert stats.binomtest(hits, looks, chance).pvalue > 1e-3
    detected = drawn.detected[there]
    assert abs(np.corrcoef(detected[:-1], detected[1:])[0, 1]) < 4.0 / np.sqrt(len(detected))


@given(
    n=st.integers(1, 30),
    horizon_s=st.floats(0.01, 200.0),
    rate_hz=st.floats(0.01, 10.0),
    p_leave=st.floats(0.01, 1.0),
    seed=st.integers(0, 99),
)
def test_columns_fit_together(n: int, horizon_s: float, rate_hz: float, p_leave: float, seed: int) -> None:
    data = simulate_revisits(n, RevisitConfig(horizon_s, rate_hz, 1.0, p_leave), seed)
    assert (len(data), data.first[0], data.first[-1]) == (n, 0, len(data.stamp_s))
    assert len(data.detected) == len(data.visit) == len(data.sequence) == len(data.stamp_s)
    assert np.all((data.stamp_s > 0.0) & (data.stamp_s <= horizon_s))
    for begin, end in zip(data.first[:-1], data.first[1:], strict=True):
        assert np.all(np.diff(data.stamp_s[begin:end]) > 0.0)
        visit = data.visit[begin:end]
        assert np.all(visit[:1] == 0)
        assert np.all((np.diff(visit) == 0) | (np.diff(visit) == 1))


def test_same_seed_gives_the_same_sequences() -> None:
    one, two, other = (simulate_revisits(20, BUSY, seed) for seed in (3, 3, 4))
    for column in fields(one):
        np.testing.assert_array_equal(getattr(one, column.name), getattr(two, column.name))
    assert not np.array_equal(one.survival_s, other.survival_s)


@pytest.mark.parametrize(
    "change",
    [{"horizon_s": 0.0}, {"revisit_rate_hz": -1.0}, {"look_rate_hz": np.inf}, {"p_leave": 1.5}, {"p_miss": np.nan}],
)
def test_settings_that_cannot_be_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(change))):
        replace(BUSY, **change)
    with pytest.raises(ConfigError, match="sequences"):
        simulate_revisits(0, BUSY, 0)
