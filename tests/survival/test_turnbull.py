"""The nonparametric maximum likelihood against reference numbers, scipy, and what must not matter."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.special import xlogy

from evermap.errors import NumericalError
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.nonparametric import Npmle, kaplan_meier, npmle

GOLDEN = Path(__file__).resolve().parents[3] / "shared" / "golden" / "npmle.json"
CASES = json.loads(GOLDEN.read_text())["cases"] if GOLDEN.is_file() else []
KKT = 1e-10


def numbers(values: list[float | None]) -> np.ndarray:
    return np.array([np.inf if value is None else value for value in values])


@pytest.mark.skipif(not CASES, reason=f"no reference numbers at {GOLDEN}")
@pytest.mark.parametrize("case", CASES, ids=[case["name"] for case in CASES])
def test_golden(case: dict[str, Any]) -> None:
    found = npmle(CensoredLifetimes.of(case["left"], numbers(case["right"]), case["entry"] or 0.0))
    assert found.loglik == pytest.approx(case["loglik"], rel=1e-11)
    assert found.kkt_violation < KKT
    np.testing.assert_array_equal(found.support_left, case["support_left"])
    np.testing.assert_array_equal(found.support_right, numbers(case["support_right"]))
    np.testing.assert_allclose(found.mass, case["mass"], atol=1e-10)


@st.composite
def samples(draw: st.DrawFn, truncated: bool = False) -> CensoredLifetimes:
    """On a coarse grid, so that all kinds of ties occur."""
    n = draw(st.integers(1, 12))
    rows = []
    for _ in range(n):
        kind = draw(st.sampled_from(("exact", "interval", "left", "right")))
        a, b = draw(st.integers(1, 8)), draw(st.integers(1, 4))
        row = {"exact": (a, a), "interval": (a, a + b), "left": (0, a), "right": (a, np.inf)}[kind]
        rows.append((*row, draw(st.integers(0, 4)), draw(st.sampled_from((1.0, 1.0, 2.0, 0.25)))))
    left, right, entry, weight = np.array(rows, dtype=float).T
    entry = np.minimum(entry, np.where(left == right, left - 1, left)).clip(0.0) if truncated else np.zeros(n)
    return CensoredLifetimes(left, right, entry, weight)


def probabilities(found: Npmle, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Mass of every `(left, right]`, or of the point where they are equal, by going through all cells."""
    return cells_inside(found, left, right) @ found.mass


def cells_inside(found: Npmle, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    start, end, left, right = found.support_left, found.support_right, left[:, None], right[:, None]
    inside = (start >= left) & (end <= right) & ~((start == end) & (end <= left))
    return np.where(left == right, (start == end) & (end == right), inside).astype(float)


def brute_force(data: CensoredLifetimes) -> float:
    """Log likelihood that quasi-Newton steps reach with points at and between all times; they may stop short."""
    times = np.unique(np.concatenate((data.left_s, data.right_s[np.isfinite(data.right_s)], data.entry_s)))
    spots = np.unique(np.concatenate((times, 0.5 * (times[1:] + times[:-1]), [times[-1] + 1.0])))
    exact = (data.left_s == data.right_s)[:, None]
    left, right = np.maximum(data.left_s, data.entry_s)[:, None], data.right_s[:, None]
    inside = np.where(exact, spots == right, (spots > left) & (spots <= right)).astype(float)
    seen = (spots > data.entry_s[:, None]).astype(float)

    def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        p = np.exp(x - x.max())
        p /= p.sum()
        a, b = inside @ p, seen @ p
        slope = (data.weight / a) @ inside - (data.weight / b) @ seen
        return -float(data.weight @ np.log(a / b)), -(p * (slope - p @ slope))

    found = minimize(loss, np.zeros(spots.size), jac=True, method="L-BFGS-B", options={"maxiter": 500, "ftol": 1e-15})
    return -float(found.fun)


@given(samples())
def test_no_distribution_is_more_likely(data: CensoredLifetimes) -> None:
    found = npmle(data)
    assert found.kkt_violation < KKT
    assert found.mass.sum() == pytest.approx(1.0, abs=1e-12)
    assert found.loglik >= brute_force(data) - 1e-9


@given(samples(truncated=True))
@example(CensoredLifetimes.of([3, 4, 1, 1], [3, 4, 1, 3], [1, 2, 0, 1]))  # all who were at risk at 1 may be gone
def test_no_distribution_is_more_likely_with_truncation(data: CensoredLifetimes) -> None:
    try:
        found = npmle(data)
    except NumericalError as problem:
        if "no maximum: it grows" not in str(problem):
            raise
        return
    assert found.kkt_violation < 1e-8
    assert found.loglik >= brute_force(data) - 1e-9


@given(samples(), samples(truncated=True))
def test_optimality_conditions_from_scratch(plain: CensoredLifetimes, truncated: CensoredLifetimes) -> None:
    """No place in time deserves more mass: what certifies the maximum, computed from the answer alone."""
    for every in (plain, truncated):
        try:
            found = npmle(every)
        except NumericalError:
            continue
        says = (every.left_s > every.entry_s) | (every.right_s < np.inf)  # others are sure to be as they are
        if not says.any():
            continue
        data = every[says]
        exact = data.left_s == data.right_s
        left = np.where(exact, data.left_s, np.maximum(data.left_s, data.entry_s))
        chance = probabilities(found, left, data.right_s)
        seen = probabilities(found, data.entry_s, np.full(left.size, np.inf))
        assert found.loglik == pytest.approx(float(data.weight @ np.log(chance / seen)), abs=1e-9)
        for spot in np.arange(0.25, 14.0, 0.25):
            inside = np.where(exact, left == spot, (left < spot) & (spot <= data.right_s))
            slope = (data.weight / chance) @ inside - (data.weight / seen) @ (spot > data.entry_s)
            assert slope <= 1e-7 * data.weight.sum()


@given(samples(), st.sampled_from((1e-6, 0.1, 1e7)), st.randoms(use_true_random=False))
def test_units_order_and_copies_do_not_matter(data: CensoredLifetimes, factor: float, random: Any) -> None:
    found = npmle(data)
    rows = list(range(data.left_s.size))
    random.shuffle(rows)
    twice = np.array(rows + rows[:1])  # one sample as two of half its weight
    weight = data.weight[twice]
    weight[[0, -1]] *= 0.5
    other = npmle(
        CensoredLifetimes(data.left_s[twice] * factor, data.right_s[twice] * factor, data.entry_s[twice], weight)
    )
    assert other.loglik == pytest.approx(found.loglik, rel=1e-9, abs=1e-9)
    assert other.kkt_violation < KKT
    for t in (1.5, 3.5, 6.5):
        here, there = found.survival(t), other.survival(t * factor)
        # the maximum is not always unique, the probabilities of the samples are
        if np.allclose(here[0], here[1]) and np.allclose(there[0], there[1]) and unique(data, found):
            np.testing.assert_allclose(there, here, atol=1e-6)


def unique(data: CensoredLifetimes, found: Npmle) -> bool:
    inside = cells_inside(found, data.left_s, data.right_s)
    return bool(np.linalg.matrix_rank(inside) == found.mass.size)


@given(samples(truncated=True))
def test_equals_kaplan_meier_where_that_applies(data: CensoredLifetimes) -> None:
    right = np.where(data.left_s == data.right_s, data.right_s, np.inf)
    data = CensoredLifetimes(data.left_s, right, data.entry_s, data.weight)
    try:
        found = npmle(data)
    except NumericalError:
        assert kaplan_meier(data).survival(data.entry_s.max()) < 1e-9
        return
    product = kaplan_meier(data)
    stay, go = product.at_risk - product.deaths, product.deaths
    terms = xlogy(go, go / product.at_risk) + xlogy(stay, stay / product.at_risk)
    assert found.loglik == pytest.approx(float(terms.sum()), abs=1e-9)
    ends = np.unique(np.concatenate([data.entry_s, data.left_s]))
    ends = ends[(ends >= data.entry_s.min()) & (ends <= product.time_s.max(initial=0.0))]
    at_risk = (data.entry_s <= ends[:-1, None]) & (data.left_s >= ends[1:, None])
    if not at_risk.any(axis=1).all():
        return  # while nobody is at risk, any mass does as well as none
    for t in product.time_s:
        assert found.survival(t)[0] == pytest.approx(product.survival(t), abs=1e-8)


def large(name: str, rng: np.random.Generator, n: int) -> CensoredLifetimes:
    t = rng.gamma(3.0, 0.5, n)
    width = rng.exponential(0.01 if name == "narrow" else 0.5, n)
    left, right = np.maximum(t - rng.random(n) * width, 0.0), t + rng.random(n) * width
    share = {"exact": 1.0, "some exact": 0.3, "few exact": 0.05}.get(name, 0.0)
    exact = rng.random(n) < share
    left[exact] = right[exact] = t[exact]
    gone = rng.random(n) < 0.8
    right = np.where(gone, right, np.inf)
    late = (name == "truncated") & (rng.random(n) < 0.5)  # not all, or those at risk early would be too few
    entry = np.where(late, left * rng.random(n), 0.0)
    return CensoredLifetimes(left, right, entry, np.ones(n))


@pytest.mark.parametrize("name", ["exact", "some exact", "few exact", "intervals", "narrow", "truncated"])
def test_large_data_is_solved_by_every_road(name: str) -> None:
    """Directly with a full and with a narrow band, by conjugate gradients, and with truncation."""
    found = npmle(large(name, np.random.default_rng(3), 20_000))
    assert found.kkt_violation < KKT
    assert found.iterations < 60


def test_one_sample() -> None:
    for left, right in ((2.0, 2.0), (1.0, 3.0), (0.0, 3.0), (1.0, np.inf)):
        found = npmle(CensoredLifetimes.of([left], [right]))
        assert (found.support_left, found.support_right, found.mass) == (left, right, 1.0)
        assert (found.loglik, found.kkt_violation) == (0.0, 0.0)


def test_all_right_censored_never_leave_after_the_last() -> None:
    found = npmle(CensoredLifetimes.of([1.0, 3.0, 2.0], [np.inf] * 3))
    assert (found.support_left, found.support_right) == (3.0, np.inf)
    assert found.prior().p_never_leaves == 1.0


def test_rows_of_no_weight_say_nothing() -> None:
    found = npmle(CensoredLifetimes.of([1.0, 2.0, 5.0], [2.0, 4.0, 5.0], weight=[1.0, 0.0, 2.0]))
    np.testing.assert_array_equal(found.support_right, [2.0, 5.0])
    np.testing.assert_allclose(found.mass, [1 / 3, 2 / 3])


def test_bounds_of_survival_within_and_at_the_ends_of_cells() -> None:
    found = npmle(CensoredLifetimes.of([0.0, 2.0, 2.0], [1.0, 2.0, 3.0]))
    lower, upper = found.survival([0.0, 0.5, 1.0, 1.9, 2.0, 2.5, 3.0])
    np.testing.assert_allclose(lower, [1, 2 / 3, 2 / 3, 2 / 3, 1 / 3, 0, 0], atol=1e-12)
    np.testing.assert_allclose(upper, [1, 1, 2 / 3, 2 / 3, 1 / 3, 1 / 3, 0], atol=1e-12)


def test_a_prior_has_the_survival_of_the_estimate() -> None:
    found = npmle(large("some exact", np.random.default_rng(0), 200))
    t = np.linspace(0.0, 4.0, 50)
    lower, upper = found.survival(t)
    survives = np.exp(found.prior().log_survival(t))
    assert np.all((lower - 1e-12 <= survives) & (survives <= upper + 1e-12))


def test_no_maximum_is_said() -> None:
    with pytest.raises(NumericalError, match=r"entry_s.*grows as the mass beyond"):
        npmle(CensoredLifetimes.of([1.0, 3.0], [1.0, 4.0], entry_s=[0.0, 2.0]))
