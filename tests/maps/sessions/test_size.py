"""How long a map's metre is: the filter against dense conditioning, the similarity against an optimiser."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize

from evermap.config import MetreConfig
from evermap.geometry import se2
from evermap.maps.living import LivingMap, Metres
from evermap.maps.sessions.gaussian import (
    AS_GOOD,
    agreed,
    log_ratio,
    settle_scales,
    settled,
)
from evermap.types import FloatArray, landmark_id_of

METRE = MetreConfig()


def _by_all_sessions(ratio: list[float], shown: list[float], sigma: list[float]) -> FloatArray:
    """(n,) metres of the map over the true one, as weights of the sessions' own errors, by hand.

    Session 0 begins the map. A later one is weighed by the inverse variance of what it says of the map's metre; what
    the map knows already fades by the walk.
    """
    information = 1.0 / sigma[0] ** 2
    weight = np.zeros(len(sigma))
    weight[0] = 1.0
    for k in range(1, len(sigma)):
        before, after = 1.0 / (1.0 / information + METRE.walk**2), 1.0 / (sigma[k] ** 2 + shown[k] ** 2)
        weight *= before / (before + after)
        weight[k] = after / (before + after)
        information = before + after
    return weight


@given(
    st.lists(
        st.tuples(st.floats(-0.1, 0.1), st.floats(1e-4, 0.05), st.floats(1e-3, 0.1), st.floats(-0.05, 0.05)),
        min_size=2,
        max_size=7,
    )
)
def test_the_metre_of_a_map_is_the_weighted_mean_of_those_of_its_sessions(
    sessions: list[tuple[float, float, float, float]],
) -> None:
    """Sessions whose metres are `true` too long: what the map's is, and how unsure, by weights of all of them at once.

    What one robot gets wrong of the metre it gets wrong in all sessions: standard deviations add up, not variances.
    Errors of single comparisons are independent.
    """
    true, shown, sigma, own = (list(column) for column in zip(*sessions, strict=True))
    metre = true[0]  # log of the map's metre over the true one, which nobody knows
    variance, information = sigma[0] ** 2, 1.0 / sigma[0] ** 2
    noise = 0.0
    for k in range(1, len(sessions)):
        # the session says by its priors that its metre is `own` short of the true one
        found = settled(metre - true[k], shown[k] ** 2, (own[k], sigma[k]), variance, information)
        innovation = metre - true[k] - own[k]
        total = sigma[k] ** 2 + shown[k] ** 2 + 1.0 / information + METRE.walk**2
        assert found.off == pytest.approx(abs(innovation) / np.sqrt(total))
        assume(found.off <= METRE.contradicts)
        weight = _by_all_sessions(true[: k + 1], shown[: k + 1], sigma[: k + 1])
        metre += np.log(found.map_factor)
        ours = np.array([true[0], *(true[j] + own[j] for j in range(1, k + 1))])
        assert metre == pytest.approx(float(weight @ ours), abs=1e-12)
        # the session's factor leads to the map's new metre, up to its share of what the comparison got wrong
        misread = innovation * shown[k] ** 2 / total
        assert np.log(found.session_factor) == pytest.approx(metre - true[k] - misread, abs=1e-12)
        noise = noise * (1.0 - weight[k]) ** 2 + weight[k] ** 2 * shown[k] ** 2
        common = float(weight @ np.array(sigma[: k + 1])) ** 2
        assert common - 1e-15 <= found.variance <= (np.sqrt(common) + np.sqrt(noise)) ** 2 + 1e-15
        variance, information = found.variance, found.information


@given(sigma=st.floats(1e-3, 0.1), sessions=st.integers(1, 40))
def test_sessions_of_one_robot_do_not_make_the_metre_surer(sigma: float, sessions: int) -> None:
    variance, information = sigma**2, 1.0 / sigma**2
    gain = 1.0
    for _ in range(sessions):
        found = settled(2.0 * sigma, 1e-12, (0.0, sigma), variance, information)
        assert found.variance == pytest.approx(sigma**2, rel=1e-6)
        # but what one of them says counts less and less, down to what the walk leaves
        assert 0.0 < -np.log(found.map_factor) / (2.0 * sigma) <= gain + 1e-12
        gain = -np.log(found.map_factor) / (2.0 * sigma)
        variance, information = found.variance, found.information
    assert gain >= METRE.walk / (sigma + METRE.walk) * 0.5


@pytest.mark.parametrize("liar", [0, 2])
@pytest.mark.parametrize("lie", [8.0, 12.0])
def test_a_robot_whose_metre_contradicts_the_others_does_not_make_the_map_longer(liar: int, lie: float) -> None:
    """Five robots in turn, one of them many standard deviations off; a map that begins with its metre comes round."""
    sigma, rng = 0.02, np.random.default_rng(2)
    robots = np.where(np.arange(5) == liar, lie * sigma, 0.2 * sigma * rng.standard_normal(5))
    metre, variance, information = robots[0], sigma**2, 1.0 / sigma**2
    contradicted = []
    for turn in range(1, 40):
        own = robots[turn % 5]
        found = settled(metre - own, 1e-6, (0.0, sigma), variance, information)
        metre += np.log(found.map_factor)
        variance, information = found.variance, found.information
        contradicted.append(turn % 5 if found.off > METRE.contradicts else -1)
        if found.off > METRE.contradicts:
            assert np.log(found.session_factor) == pytest.approx(metre - own)
    assert abs(metre) < sigma
    assert set(contradicted[10:]) == {-1, liar}


def _by_all_assignments(log_metre: FloatArray, sigma: FloatArray) -> tuple[float, FloatArray]:
    """What `agreed` says, by each way in which some robots have drifted: products of Gaussians, integrated by hand."""
    mass, mean, drifted = [], [], []
    for share in AS_GOOD:
        for has in product([False, True], repeat=len(sigma)):
            which = np.array(has)
            variance = np.where(which, (METRE.drifted * sigma) ** 2, (share * sigma) ** 2 + METRE.walk**2)
            weight = 1.0 / variance
            middle = float(weight @ log_metre / weight.sum())
            chi2 = float(weight @ (log_metre - middle) ** 2)
            likelihood = np.exp(-0.5 * chi2) / np.sqrt(np.prod(variance) * weight.sum())
            mass.append(likelihood * np.prod(np.where(which, METRE.p_drifted, 1.0 - METRE.p_drifted)))
            mean.append(middle)
            drifted.append(which)
    share_of = np.array(mass) / np.sum(mass)
    return float(share_of @ np.array(mean)), np.asarray(share_of @ np.array(drifted, dtype=np.float64))


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))])
def test_what_robots_agree_on_is_the_mean_over_all_ways_in_which_some_have_drifted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sigma = rng.uniform(0.01, 0.03, 5)
    log_metre = 0.3 * sigma * rng.standard_normal(5)
    log_metre[0] += 0.06 * (seed % 2)
    middle, p_drifted = agreed(log_metre, sigma)
    wanted, p_wanted = _by_all_assignments(log_metre, sigma)
    assert middle == pytest.approx(wanted, abs=0.01 * sigma.min())
    np.testing.assert_allclose(p_drifted, p_wanted, atol=0.005)


@given(st.lists(st.floats(-0.1, 0.1), min_size=1, max_size=6), st.floats(-0.2, 0.2))
def test_what_robots_agree_on_lies_between_them_and_moves_with_them(said: list[float], by: float) -> None:
    log_metre, sigma = np.array(said), np.full(len(said), 0.02)
    middle, _ = agreed(log_metre, sigma)
    assert log_metre.min() - 1e-12 <= middle <= log_metre.max() + 1e-12
    assert agreed(log_metre + by, sigma)[0] == pytest.approx(middle + by, abs=1e-9)
    assert agreed(-log_metre, sigma)[0] == pytest.approx(-middle, abs=1e-9)
    if len(said) == 2:  # nobody knows which of them is right
        assert middle == pytest.approx(log_metre.mean(), abs=1e-9)


def _fleet(robots: FloatArray, sigma: float, turns: int) -> tuple[float, LivingMap, set[int]]:
    """Robots in turn, whose metres are `robots` too long: the log of the map's metre, and who is told in the end."""
    metre = robots[0]
    living = LivingMap(log_size_variance=sigma**2, log_size_information=1.0 / sigma**2)
    names = ("", "one", "two", "three", "four")
    told: set[int] = set()
    for turn in range(1, turns):
        k = turn % len(robots)
        found, metres = settle_scales((metre - robots[k], 1e-6), (0.0, sigma), living, names[k])
        metre += np.log(found.map_factor)
        assert np.log(found.session_factor) == pytest.approx(metre - robots[k], abs=1e-3)
        living = replace(
            living, log_size_variance=found.variance, log_size_information=found.information, metres=metres
        )
        if found.apart and turn >= turns - len(robots):
            told.add(k)
    return float(metre), living, told


@pytest.mark.parametrize("liar", range(5))
def test_the_metre_of_one_robot_is_told_by_the_agreement_of_the_others(liar: int) -> None:
    """By 2.5 standard deviations of its priors, in each of its sessions, also where the map began with it."""
    sigma, rng = 0.02, np.random.default_rng(liar)
    robots = 0.05 * sigma * rng.standard_normal(5)
    robots[liar] += 2.5 * sigma
    metre, living, told = _fleet(robots, sigma, 40)
    assert abs(metre) < 0.2 * sigma
    assert told == {liar}
    np.testing.assert_allclose(np.sort(living.metres.log_metre)[-1], 2.5 * sigma, atol=0.4 * sigma)


def test_the_mean_of_robots_that_scatter_as_they_should_is_the_metre() -> None:
    sigma = 0.02
    metre, _, told = _fleet(sigma * np.array([-1.0, 1.0, 0.2, -0.5, 0.6]), sigma, 40)
    assert metre == pytest.approx(0.06 * sigma, abs=0.15 * sigma)
    assert not told


def test_the_metre_of_one_robot_is_that_of_its_sessions_with_and_without_a_name() -> None:
    sigma, rng = 0.02, np.random.default_rng(0)
    first = Metres(*map(np.array, ([landmark_id_of("one")], [0.0], [sigma**2], [1.0 / sigma**2])))
    named = LivingMap(log_size_variance=sigma**2, log_size_information=1.0 / sigma**2, metres=first)
    variance, information = sigma**2, 1.0 / sigma**2
    for shown in rng.normal(0.0, sigma, 8):
        found, metres = settle_scales((shown, 1e-6), (0.0, sigma), named, "one")
        wanted = settled(shown, 1e-6, (0.0, sigma), variance, information)
        assert (found.map_factor, found.session_factor) == (
            pytest.approx(wanted.map_factor, abs=1e-15),
            pytest.approx(wanted.session_factor, abs=1e-15),
        )
        assert (found.variance, found.off, found.apart) == (pytest.approx(wanted.variance), wanted.off, 0.0)
        variance, information = wanted.variance, wanted.information
        named = replace(named, log_size_variance=variance, log_size_information=information, metres=metres)


def test_a_survey_knows_the_metre_better_than_a_robot() -> None:
    found, metres = settle_scales((0.05, 1e-6), (0.0, 0.02), LivingMap(), "one")
    assert abs(np.log(found.map_factor)) < 0.1 * 0.05
    assert len(metres) == 2


@pytest.mark.parametrize("sigma", [0.005, 0.02, 0.1])
def test_a_session_that_knows_the_metre_settles_it(sigma: float) -> None:
    """Another sensor, which knows it to 0.01 %: the map's metre is its metre."""
    variance, information = sigma**2, 1.0 / sigma**2
    for _ in range(5):
        found = settled(0.0, 1e-8, (0.0, sigma), variance, information)
        variance, information = found.variance, found.information
    known = 1e-4
    found = settled(1.5 * sigma, 1e-10, (0.0, known), variance, information)
    # weight of all that was known before: a walk's worth of information at the most
    rest = known**2 / METRE.walk**2
    assert found.map_factor == pytest.approx(np.exp(-1.5 * sigma), rel=1.5 * sigma * 2.0 * rest)
    assert np.sqrt(found.variance) <= known + rest * sigma + 1e-5
    # and the next that knows little does not spoil it by more than the walk
    after = settled(0.05, 1e-10, (0.0, sigma), found.variance, found.information)
    assert abs(np.log(after.map_factor)) <= 0.05 * 2.0 * (known**2 + METRE.walk**2) / sigma**2
    assert np.sqrt(after.variance) < 0.3 * sigma


def test_a_session_that_shows_no_size_changes_nothing() -> None:
    """One landmark: `log_ratio` says that it does not know."""
    ratio, variance = log_ratio(np.zeros((1, 2)), np.eye(2), np.ones((1, 2)), np.eye(2))
    assert (ratio, variance) == (0.0, np.inf)
    found = settled(ratio, variance, (0.02, 0.01), 0.02**2, 1.0 / 0.02**2)
    assert found.map_factor == 1.0
    assert found.session_factor == pytest.approx(np.exp(0.02))  # its own priors
    assert found.variance == pytest.approx(0.02**2)


@pytest.mark.parametrize("seed", range(4))
def test_the_similarity_is_that_of_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 8
    session = rng.uniform(-5.0, 5.0, (count, 2))
    root = 0.03 * rng.standard_normal((2 * count, 2 * count))
    spread, of_map = root @ root.T + 1e-4 * np.eye(2 * count), 1e-4 * np.eye(2 * count)
    true = np.array([3.0, -2.0, 2.5])
    mapped = se2.transform(true, 1.07 * session) + 0.02 * rng.standard_normal((count, 2))

    def cost(x: np.ndarray) -> float:
        gap = (mapped - se2.transform(x[:3], np.exp(x[3]) * session)).ravel()
        return float(gap @ np.linalg.solve(fixed, gap))

    ratio, variance = log_ratio(session, spread, mapped, of_map)
    turn = np.exp(ratio) * np.kron(np.eye(count), se2.rotation(true[2]))
    best = None
    for _ in range(3):  # the weights are those of the estimate, as of Gauss-Newton
        fixed = turn @ spread @ turn.T + of_map
        best = minimize(cost, np.append(true, ratio), method="BFGS", options={"gtol": 1e-10})
        turn = np.exp(best.x[3]) * np.kron(np.eye(count), se2.rotation(best.x[2]))
    assert best is not None
    assert ratio == pytest.approx(best.x[3], abs=1e-4)
    step, unit = 1e-4, np.eye(4)
    hessian = np.array(
        [
            [
                (cost(best.x + step * (a + b)) - cost(best.x + step * (a - b))
                 - cost(best.x - step * (a - b)) + cost(best.x - step * (a + b))) / (4 * step**2)
                for b in unit
            ]
            for a in unit
        ]
    )  # fmt: skip
    assert variance == pytest.approx(np.linalg.inv(0.5 * hessian)[3, 3], rel=0.05)


def test_a_comparison_that_shows_nothing_leaves_a_session_its_own_size() -> None:
    for shown_variance, factor in ((1e-12, np.exp(2.0)), (1e12, 1.0)):
        found = settled(2.0, shown_variance, (0.0, 0.1), 1e-12, 1e12)
        assert found.session_factor == pytest.approx(factor, rel=1e-3)


def test_a_bent_session_says_little_of_its_size() -> None:
    """Half of the landmarks stand elsewhere than the rest has them: the residuals tell that, the covariances do not."""
    rng = np.random.default_rng(0)
    session_m = rng.uniform(0.0, 20.0, (20, 2))
    map_m = session_m.copy()
    covariance = 1e-4 * np.eye(40)
    _, variance = log_ratio(session_m, covariance, map_m, covariance)
    map_m[10:] += [6.0, -8.0]
    size, bent_variance = log_ratio(session_m, covariance, map_m, covariance)
    assert np.sqrt(variance) < 1e-3
    assert abs(size) < 3.0 * np.sqrt(bent_variance)


@pytest.mark.parametrize("seed", range(20))
def test_a_session_that_has_nothing_to_do_with_the_map_says_nothing_of_its_size(seed: int) -> None:
    """Landmarks are mixed up, with the correlated errors of a long drive."""
    rng = np.random.default_rng(seed)
    session_m, map_m = rng.uniform(-10.0, 10.0, (2, 10, 2))
    walk = np.repeat(np.cumsum(rng.normal(size=(10, 20)), axis=0), 2, axis=0) * rng.normal(size=(20, 1))
    size, variance = log_ratio(session_m, walk @ walk.T + 1e-4 * np.eye(20), map_m, 1e-4 * np.eye(20))
    assert abs(size) < 10.0
    assert np.sqrt(variance) > 0.1
