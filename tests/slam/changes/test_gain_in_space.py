"""The gain of a hypothesis in space against Gaussian integrals, with rotations by scipy."""

from __future__ import annotations

from math import log

import numpy as np
import pytest
from references import log_group_prior, log_normal
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from evermap.config import ChangesConfig
from evermap.estimate.sparse.system import exhaust
from evermap.slam.changes.evidence import Comparison, WindowEvidence, compare
from evermap.slam.changes.gain import (
    PLACES,
    POINTS,
    Tables,
    hypothesis_gain,
    log_onset,
    log_prior,
    motion_spread,
    turning_columns,
)
from evermap.slam.changes.search import find_changes, item_columns

PRIOR = ChangesConfig()
COUNT = 6


def space_covariance(rng: np.random.Generator, position: np.ndarray, numbers: int) -> np.ndarray:
    """Of landmarks whose errors are their own, 1 cm and .02 rad, and of the whole, which may be 1 m and .3 rad off."""
    count = len(position)
    own = np.tile([0.01] * 3 + [0.02] * (numbers - 3), count)
    arm = position - position.mean(axis=0)
    whole = np.zeros((count, numbers, 6))
    whole[:, :3, :3] = np.eye(3)
    for k in range(3):
        whole[:, :3, 3 + k] = np.cross(np.eye(3)[k], arm)
    if numbers == PLACES:
        whole[:, 3:, 3:] = np.eye(3)
    whole = whole.reshape(-1, 6) * ([1.0] * 3 + [0.3] * 3)
    mixed = 0.2 * rng.normal(size=(len(own), len(own))) * own[:, None]
    return np.diag(own**2) + mixed @ mixed.T / len(own) + whole @ whole.T


def evidence_of(position: np.ndarray, numbers: int) -> WindowEvidence:
    count = len(position)
    at = np.hstack([position, np.zeros((count, numbers - 3))])
    return WindowEvidence(
        np.arange(count),
        np.zeros(count, np.int64),
        at,
        np.zeros((numbers * count,) * 2),
        np.zeros(numbers * count),
        0.0,
    )


def comparison_of(e: np.ndarray, covariance: np.ndarray) -> Comparison:
    precision = np.linalg.inv(covariance)
    return Comparison(precision, precision @ e, 0.0, float(len(e)), precision, precision @ e)


def gain_of(comparison: Comparison, position: np.ndarray, numbers: int, label: list[int], turns: list[bool]):
    count = len(position)
    evidence = evidence_of(position, numbers)
    quadratic, linear = exhaust(item_columns(evidence, comparison, position, 1, np.arange(count)))
    tables = Tables(
        quadratic, linear, position, turning_columns(numbers), motion_spread(PRIOR, numbers),
        log_prior(PRIOR, count, count, numbers=numbers), log_onset(1),
    )  # fmt: skip
    groups = len(turns)
    return hypothesis_gain(np.array(label), np.zeros(groups + 1, np.int64), np.array([False, *turns]), tables)


def displaced(position: np.ndarray, members: np.ndarray, motion: np.ndarray, numbers: int) -> np.ndarray:
    """(n L,) displacements of members that move together, and turn about their centroid."""
    shift = np.zeros((len(position), numbers))
    arm = position[members] - position[members].mean(axis=0)
    shift[members, :3] = Rotation.from_rotvec(motion[3:]).apply(arm) - arm + motion[:3]
    shift[members, 3:] = motion[3:numbers]
    return shift.ravel()


@pytest.mark.parametrize("numbers", [POINTS, PLACES])
def test_gain_of_displacements_is_the_difference_of_log_marginal_likelihoods(numbers: int) -> None:
    label = [0, 1, 1, 2, 1, 2]
    for seed in range(4):
        rng = np.random.default_rng(seed)
        position = rng.uniform(-3.0, 3.0, (COUNT, 3))
        covariance = space_covariance(rng, position, numbers)
        e = rng.multivariate_normal(np.zeros(len(covariance)), covariance)
        moved, expected = covariance.copy(), 0.0
        for g in (1, 2):
            columns = np.zeros((COUNT, numbers, 3))
            columns[np.array(label) == g, :3] = np.eye(3)
            columns = columns.reshape(-1, 3)
            e += columns @ [0.3, -0.1, 0.2]
            moved += PRIOR.move_sigma_m**2 * columns @ columns.T
            expected += log_group_prior(PRIOR, COUNT, label.count(g))
        gain, _ = gain_of(comparison_of(e, covariance), position, numbers, label, [False, False])
        expected += log_normal(e, moved) - log_normal(e, covariance)
        assert gain == pytest.approx(expected, rel=1e-7, abs=1e-6)


@pytest.mark.parametrize(
    ("numbers", "label", "degrees", "seeds"),
    [
        (POINTS, [0, 1, 1, 0, 1, 0], 70.0, range(1)),
        pytest.param(POINTS, [0, 1, 1, 0, 1, 0], 70.0, range(1, 3), marks=pytest.mark.slow),
        pytest.param(PLACES, [0, 1, 1, 0, 1, 0], 50.0, range(3), marks=pytest.mark.slow),
        pytest.param(PLACES, [0, 0, 0, 1, 0, 0], 40.0, range(3), marks=pytest.mark.slow),
    ],
)
def test_turning_group_against_a_sampled_integral(numbers: int, label: list[int], degrees: float, seeds: range) -> None:
    """The integral over motions is sampled around its peak, which scipy finds."""
    members = np.flatnonzero(label)
    spread = motion_spread(PRIOR, numbers)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        position = rng.uniform(-3.0, 3.0, (COUNT, 3))
        covariance = space_covariance(rng, position, numbers)
        axis = rng.normal(size=3)
        true = np.append([0.4, -0.2, 0.1], np.deg2rad(degrees) * axis / np.linalg.norm(axis))
        e = displaced(position, members, true, numbers)
        e += rng.multivariate_normal(np.zeros(len(e)), covariance)
        comparison = comparison_of(e, covariance)
        gain, motion = gain_of(comparison, position, numbers, label, [True])

        def log_joint(y: np.ndarray) -> float:
            """Log likelihood and prior of a motion, over the likelihood that nothing moved."""
            shift = displaced(position, members, y, numbers)  # noqa: B023
            fit = float(shift @ comparison.pull - 0.5 * shift @ comparison.precision @ shift)  # noqa: B023
            return fit - 0.5 * float(((y / spread) ** 2).sum()) - float(np.log(spread * np.sqrt(2 * np.pi)).sum())

        found = minimize(lambda y: -log_joint(y), true, method="BFGS", options={"gtol": 1e-6})
        np.testing.assert_allclose(motion[0], found.x, atol=2e-3)
        step = 1e-4
        hessian = np.zeros((6, 6))
        for i in range(6):
            for j in range(6):
                a, b = step * np.eye(6)[i], step * np.eye(6)[j]
                hessian[i, j] = -(
                    log_joint(found.x + a + b) - log_joint(found.x + a - b)
                    - log_joint(found.x - a + b) + log_joint(found.x - a - b)
                ) / (4 * step**2)  # fmt: skip
        around = 1.5 * np.linalg.inv(0.5 * (hessian + hessian.T))
        samples = rng.multivariate_normal(found.x, around, 4000)
        weight = [log_joint(y) - log_normal(y - found.x, around) for y in samples]
        integral = np.logaddexp.reduce(weight) - log(len(weight))
        prior = log_group_prior(PRIOR, COUNT, len(members), turns=True)
        if len(members) == 1:
            prior = float(log_prior(PRIOR, COUNT, COUNT, numbers=numbers)[1, 1])
        assert gain == pytest.approx(integral + prior, abs=0.15)


@pytest.mark.parametrize("numbers", [POINTS, PLACES])
def test_search_finds_the_groups_that_moved_in_space(numbers: int) -> None:
    """Ten landmarks, of which four turn together and one moves alone; the whole is free."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        position = rng.uniform(-4.0, 4.0, (10, 3))
        covariance = space_covariance(rng, position, numbers)
        shelf, motion = np.array([1, 3, 4, 8]), np.array([0.5, 0.3, -0.1, 0.1, -0.2, 0.6])
        e = displaced(position, shelf, motion, numbers)
        e += displaced(position, np.array([6]), np.array([-0.3, 0.4, 0.2, 0.0, 0.0, 0.0]), numbers)
        e += rng.multivariate_normal(np.zeros(len(e)), covariance)
        found = exhaust(find_changes(evidence_of(position, numbers), comparison_of(e, covariance), position, 1, PRIOR))
        np.testing.assert_array_equal(found.label[0] == found.label[0, 1], np.isin(np.arange(10), shelf))
        np.testing.assert_array_equal(np.flatnonzero(found.label[0]), np.sort(np.append(shelf, 6)))
        assert found.turns[0, found.label[0, 1]]
        np.testing.assert_allclose(found.motion[0, found.label[0, 1] - 1], motion, atol=0.08)


@pytest.mark.parametrize("numbers", [POINTS, PLACES])
def test_search_finds_nothing_where_only_the_whole_is_elsewhere(numbers: int) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        position = rng.uniform(-4.0, 4.0, (10, 3))
        covariance = space_covariance(rng, position, numbers)
        e = rng.multivariate_normal(np.zeros(len(covariance)), covariance)
        found = exhaust(find_changes(evidence_of(position, numbers), comparison_of(e, covariance), position, 1, PRIOR))
        assert not found.label[0].any()


def test_comparison_with_a_map_in_space_is_a_gaussian_over_displacements() -> None:
    """Uncertain places of the map add to the errors of the session."""
    rng = np.random.default_rng(3)
    position = rng.uniform(-3.0, 3.0, (COUNT, 3))
    covariance = space_covariance(rng, position, PLACES)
    mean = np.hstack([position, np.zeros((COUNT, 3))])
    off = rng.multivariate_normal(np.zeros(len(covariance)), covariance)
    of_map = np.tile(np.diag([0.02] * 3 + [0.01] * 3) ** 2, (COUNT, 1, 1))
    plain = evidence_of(position, PLACES)
    information = np.linalg.inv(covariance)
    evidence = WindowEvidence(
        plain.landmark, plain.window, mean + off.reshape(mean.shape), information, np.zeros(len(off)), 0.0
    )
    found = compare(evidence, mean, of_map, np.ones(COUNT, np.bool_))
    expected = np.linalg.inv(covariance + np.kron(np.eye(COUNT), of_map[0]))
    np.testing.assert_allclose(found.precision, expected, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(found.pull, expected @ off, rtol=1e-3, atol=1e-2)
    assert found.freedom == 6 * COUNT - 6
