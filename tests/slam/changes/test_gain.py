"""The gain of a hypothesis against Gaussian integrals that scipy evaluates."""

from __future__ import annotations

from math import log

import numpy as np
import pytest
from references import (
    comparison_of,
    log_group_prior,
    log_normal,
    membership,
    random_covariance,
    slam_like_covariance,
    static_evidence,
)
from scipy.integrate import quad

from evermap.config import ChangesConfig
from evermap.estimate.sparse.system import exhaust
from evermap.geometry import se2
from evermap.slam.changes.evidence import Comparison, WindowEvidence, compare
from evermap.slam.changes.explain import GivenMap, MovedGroup, explained
from evermap.slam.changes.gain import (
    PLANE,
    Tables,
    hypothesis_gain,
    log_onset,
    log_prior,
    spread_of,
    turning_columns,
)
from evermap.slam.changes.gain import gain_of as gain_alone
from evermap.slam.changes.search import item_columns
from evermap.slam.problem import Estimate

PRIOR = ChangesConfig()


def gain_of(
    evidence: WindowEvidence,
    comparison: Comparison,
    position: np.ndarray,
    n_windows: int,
    label: list[int],
    onset: list[int],
    turns: list[bool],
    prior: ChangesConfig = PRIOR,
) -> tuple[float, np.ndarray]:
    count = len(position)
    quadratic, linear = exhaust(item_columns(evidence, comparison, position, n_windows, np.arange(count)))
    return hypothesis_gain(
        np.array(label),
        np.array([0, *onset]),
        np.array([False, *turns]),
        Tables(
            quadratic,
            linear,
            position,
            turning_columns(2),
            prior.spread,
            log_prior(prior, count, count),
            log_onset(n_windows),
        ),
    )


@pytest.mark.parametrize(
    "label", [[0] * 7, [0, 0, 1, 0, 0, 0, 0], [1, 0, 1, 0, 0, 1, 0], [0, 3, 0, 3, 0, 0, 0], [1] * 7]
)
@pytest.mark.parametrize("onset", [0, 2])
@pytest.mark.parametrize("pull", [1.0, 300.0])
def test_one_group_that_only_moves_gains_in_closed_form_what_any_do(label: list[int], onset: int, pull: float) -> None:
    random = np.random.default_rng(len(label) + onset)
    count, windows, columns = 7, 3, PLANE + len(turning_columns(PLANE))
    root = random.normal(size=(columns * windows * count, columns * windows * count))
    tables = Tables(
        root @ root.T,
        random.normal(size=len(root)),
        random.normal(size=(count, PLANE)),
        turning_columns(PLANE),
        PRIOR.spread,
        log_prior(PRIOR, 9, count),
        log_onset(windows),
    )
    tables = tables._replace(linear=pull * tables.linear)
    for other in (label, [2 if i == 6 and g == 0 else g for i, g in enumerate(label)]):  # two groups: as any
        of = np.array(other), np.array([0, onset, 1, onset]), np.zeros(4, dtype=np.bool_)
        assert gain_alone(*of, tables) == pytest.approx(hypothesis_gain(*of, tables)[0], rel=1e-10, abs=1e-10)


@pytest.mark.parametrize(
    ("n_windows", "label", "onset"),
    [
        (1, [0, 0, 0, 0, 0, 0], [0, 0]),
        (1, [0, 1, 1, 0, 1, 0], [0, 0]),
        (1, [1, 2, 1, 0, 2, 0], [0, 0]),
        (3, [0, 1, 1, 0, 0, 0], [1, 0]),
        (3, [2, 1, 1, 2, 0, 2], [2, 0]),
    ],
)
def test_gain_is_the_difference_of_log_marginal_likelihoods(n_windows: int, label: list[int], onset: list[int]) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        position = rng.uniform(-5.0, 5.0, (6, 2))
        evidence = static_evidence(position, n_windows)
        covariance = random_covariance(rng, len(evidence.pull))
        e = 0.3 * rng.normal(size=len(evidence.pull))
        gain, motion = gain_of(evidence, comparison_of(e, covariance), position, n_windows, label, onset, [False] * 2)
        moved, expected = covariance.copy(), 0.0
        for g in range(1, max(label) + 1):
            members = np.flatnonzero(np.array(label) == g)
            columns = membership(evidence, members, onset[g - 1])
            moved += PRIOR.move_sigma_m**2 * columns @ columns.T
            before_or_within = 1.0 if n_windows == 1 else (0.5 if onset[g - 1] == 0 else 0.5 / (n_windows - 1))
            expected += log_group_prior(PRIOR, 6, len(members)) + log(before_or_within)
        expected += log_normal(e, moved) - log_normal(e, covariance)
        assert gain == pytest.approx(expected, rel=1e-9, abs=1e-7)
        for g in range(1, max(label) + 1):  # the posterior mean of a displacement, by conditioning
            columns = membership(evidence, np.flatnonzero(np.array(label) == g), onset[g - 1])
            mean = PRIOR.move_sigma_m**2 * columns.T @ np.linalg.solve(moved, e)
            np.testing.assert_allclose(motion[g - 1, :2], mean, atol=1e-9)


def test_two_that_are_far_apart_are_hardly_a_body_that_turned() -> None:
    rng = np.random.default_rng(1)
    position = rng.uniform(-5.0, 5.0, (6, 2))
    evidence, comparison = static_evidence(position), comparison_of(0.02 * rng.normal(size=12), 0.02**2 * np.eye(12))
    near, far = position.copy(), position.copy()
    near[4], far[4] = near[1] + [0.6, 0.8], far[1] + [3.6, 4.8]
    gains = [
        gain_of(evidence, comparison, at, 1, [0, 1, 0, 0, 1, 0], [0], [turns])[0]
        for at in (near, far)
        for turns in (False, True)
    ]
    assert gains[0] == gains[2]
    moment = 0.5 * 1.0**2, 0.5 * 6.0**2  # of two about their middle
    width = [0.5 * log(1.0 + (PRIOR.turn_sigma_rad / 0.02) ** 2 * each) for each in moment]
    apart = (gains[1] - gains[0] + width[0]) - (gains[3] - gains[2] + width[1])
    assert apart == pytest.approx((6.0 - 1.0) / PRIOR.body_m, abs=1.5)


@pytest.mark.parametrize("far_m", [0.5, 2.0, 3.0, 12.0])
def test_what_went_far_is_of_a_wider_prior_where_that_is_more_probable(far_m: float) -> None:
    rng = np.random.default_rng(3)
    position = rng.uniform(-5.0, 5.0, (6, 2))
    evidence, covariance = static_evidence(position), 0.02**2 * np.eye(12)
    e = 0.02 * rng.normal(size=12)
    e[4:6] += far_m * np.array([0.6, -0.8])
    columns = membership(evidence, np.array([2]))
    near, far = (
        log_normal(e, covariance + (scale * PRIOR.move_sigma_m) ** 2 * columns @ columns.T)
        for scale in (1.0, PRIOR.far)
    )
    expected = max(near, far + log(PRIOR.p_far)) - log_normal(e, covariance) + log_group_prior(PRIOR, 6, 1)
    gain, motion = gain_of(evidence, comparison_of(e, covariance), position, 1, [0, 0, 1, 0, 0, 0], [0], [False])
    assert gain == pytest.approx(expected, abs=1e-6)
    np.testing.assert_allclose(motion[0, :2], e[4:6], rtol=2e-3)
    wide = far + log(PRIOR.p_far) > near
    assert wide == (far_m > 2.6)
    np.testing.assert_array_equal(spread_of(motion[0], PRIOR), PRIOR.spread * [*2 * [PRIOR.far if wide else 1.0], 1.0])


def linear_world(seed: int, n_windows: int) -> tuple[WindowEvidence, GivenMap]:
    """Well-conditioned measurements of six landmarks, and a map of them."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-5.0, 5.0, (6, 2))
    plain = static_evidence(position + 0.2 * rng.normal(size=position.shape), n_windows)
    size = len(plain.pull)
    information = np.linalg.inv(random_covariance(rng, size))
    evidence = WindowEvidence(
        plain.landmark, plain.window, plain.position, information, information @ (0.1 * rng.normal(size=size)), 0.0
    )
    root = 0.02 * (np.eye(2) + 0.3 * rng.normal(size=(6, 2, 2)))
    return evidence, GivenMap(position, root @ root.transpose(0, 2, 1), np.ones(6, bool))


def log_marginal_likelihood(
    evidence: WindowEvidence, place: np.ndarray, mean: np.ndarray, information: np.ndarray
) -> float:
    """Of the linear problem whose copies are at `place` (R,), with a Gaussian prior of the places."""
    tied = np.kron(np.eye(len(mean))[place], np.eye(2))
    covariance = np.linalg.inv(evidence.information) + tied @ np.linalg.inv(information) @ tied.T
    found = evidence.position.ravel() + np.linalg.solve(evidence.information, evidence.pull)
    return log_normal(found - mean[place].ravel(), covariance)


@pytest.mark.parametrize("onset", [0, 1])
def test_gain_is_what_the_solved_problem_gains(onset: int) -> None:
    """The problem that `explained` hands to least squares has the likelihood that the search promised."""
    from problems import make_world

    problem = make_world(0, n_poses=4, n_landmarks=6).problem
    for seed in range(3):
        evidence, given = linear_world(seed, 2)
        comparison = compare(evidence, given.mean, given.covariance, given.given)
        label, members = [0, 1, 0, 1, 1, 0], np.array([1, 3, 4])
        gain, motion = gain_of(evidence, comparison, given.mean, 2, label, [onset], [False])
        since = None if onset == 0 else float(problem.stamp_s[2])
        estimate = Estimate(np.zeros((4, 3)), given.mean.copy(), problem.prior.mean)
        likelihoods = []
        for groups in ((), (MovedGroup(members, False, motion[0], onset, since),)):
            told, _, landmark = explained(problem, estimate, given, groups, PRIOR.model_copy(update={"rigid_m": 1e-5}))
            last = np.arange(6)
            last[landmark[6:]] = np.arange(6, len(landmark))
            place = np.where(evidence.window >= 1, last[evidence.landmark], evidence.landmark)
            information = told.landmark_information.toarray()
            likelihoods.append(log_marginal_likelihood(evidence, place, told.landmark_mean, information))
        prior = log_group_prior(PRIOR, 6, 3) + log(0.5)
        assert gain - prior == pytest.approx(likelihoods[1] - likelihoods[0], abs=2e-3)


def turned(position: np.ndarray, members: np.ndarray, angle: float) -> np.ndarray:
    """(2 L,) by what the members are displaced by turning about their centroid."""
    shift = np.zeros_like(position)
    arm = position[members] - position[members].mean(axis=0)
    shift[members] = arm @ se2.rotation(angle).T - arm
    return shift.ravel()


@pytest.mark.parametrize("degrees", [20.0, -60.0])
@pytest.mark.parametrize("unknown_start", [False, True])
def test_turning_group_against_quadrature(degrees: float, unknown_start: bool) -> None:
    members, label = np.array([1, 2, 4]), [0, 1, 1, 0, 1, 0, 0]
    for seed in range(6):
        rng = np.random.default_rng(seed)
        position = rng.uniform(-5.0, 5.0, (7, 2))
        evidence = static_evidence(position)
        covariance = slam_like_covariance(rng, position) if unknown_start else random_covariance(rng, 14)
        columns = membership(evidence, members)
        shift = np.array([0.4, -0.2])
        true = turned(position, members, np.deg2rad(degrees)) + columns @ shift
        e = true + rng.multivariate_normal(np.zeros(14), covariance)
        comparison = comparison_of(e, covariance)
        gain, motion = gain_of(evidence, comparison, position, 1, label, [0], [True])
        moved = covariance + PRIOR.move_sigma_m**2 * columns @ columns.T
        factor = np.linalg.inv(moved)
        constant = -0.5 * (np.linalg.slogdet(moved)[1] - np.linalg.slogdet(covariance)[1])
        nothing = -0.5 * e @ comparison.precision @ e

        def integrand(angle: float) -> float:
            rest = e - turned(position, members, angle)  # noqa: B023
            exponent = -0.5 * rest @ factor @ rest - nothing + constant - gain  # noqa: B023
            sigma = PRIOR.turn_sigma_rad
            return float(np.exp(exponent - 0.5 * (angle / sigma) ** 2) / np.sqrt(2 * np.pi * sigma**2))

        found = float(motion[0, 2])
        near = (found - 0.3, found + 0.3)
        integral = quad(integrand, *near, points=[found], limit=500)[0]
        prior = log_group_prior(PRIOR, 7, 3, turns=True)
        assert log(integral) + prior == pytest.approx(0.0, abs=0.1)
        assert np.rad2deg(motion[0, 2]) == pytest.approx(degrees, abs=3.0)
        np.testing.assert_allclose(motion[0, :2], shift, atol=0.15)
