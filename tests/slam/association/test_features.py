"""What landmarks are like: the ratio of Gaussians against scipy, what is learned against what was drawn, and harm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from evermap.slam.association.features import (
    MISREAD_NATS,
    MOST_READINGS,
    Group,
    Spread,
    Traits,
    learned,
    medians,
)


def brute_force(a: float, va: float, b: float, vb: float, between: float) -> float:
    """Log likelihood ratio of two values of one landmark, and of two."""
    together = multivariate_normal([0.0, 0.0], [[between + va, between], [between, between + vb]])
    alone = norm(0.0, np.sqrt(between + va)).logpdf(a) + norm(0.0, np.sqrt(between + vb)).logpdf(b)
    return float(together.logpdf([a, b]) - alone)


def drawn(
    rng: np.random.Generator, spread: Spread, *, landmarks: int = 40, visits: int = 4, readings: int = 6
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Readings, their visits, and the landmarks of visits."""
    landmark = np.repeat(np.arange(landmarks), visits)
    visit = np.repeat(np.arange(len(landmark)), readings)
    size = len(spread.reading)
    value = 7.0 + rng.normal(size=(landmarks, size))[landmark][visit] * np.sqrt(spread.landmark)
    value += rng.normal(size=(len(landmark), size))[visit] * np.sqrt(spread.visit)
    return value + rng.normal(size=value.shape) * np.sqrt(spread.reading), visit, landmark


def test_the_ratio_is_that_of_gaussians() -> None:
    rng = np.random.default_rng(0)
    spread = Spread(np.ones(3), np.ones(3), np.array([4.0, 0.5, 25.0]), 0.7)
    one, other = rng.normal(size=(2, 20, 3)) * np.sqrt(spread.landmark + 1.0)
    va, vb = rng.uniform(0.1, 2.0, (2, 20, 3))
    one[3, 1] = other[4] = np.nan
    many = np.full(20, 1e9)  # no limit
    found = Traits(one, spread).same(Group(one, va, many), Group(other, vb, many))
    for k in range(20):
        each = [brute_force(one[k, c], va[k, c], other[k, c], vb[k, c], spread.landmark[c]) for c in range(3)]
        assert found[k] == pytest.approx(0.7 * np.nansum(each), abs=1e-9)
    assert found[4] == 0.0


def test_readings_of_visits_and_landmarks_are_those_of_a_joint_gaussian() -> None:
    """Two visits with a reading each, against a third: as the Gaussian of all three readings has it."""
    spread = Spread(np.array([0.3]), np.array([0.2]), np.array([5.0]), 1.0)
    value = np.array([[1.0], [1.8], [0.4]])
    traits = Traits(value, spread)
    visits = traits.of_visits(np.arange(3), 3)
    known = traits.of_landmarks(visits.part([0, 1]), np.zeros(2, dtype=np.int64), 1)
    own = 0.5 * np.eye(3)
    same = multivariate_normal(np.zeros(3), own + 5.0).logpdf(value[:, 0])
    apart = multivariate_normal(np.zeros(2), own[:2, :2] + 5.0).logpdf(value[:2, 0]) + norm(0, np.sqrt(5.5)).logpdf(0.4)
    assert traits.same(visits.part([2]), known)[0] == pytest.approx(same - apart)
    first = brute_force(1.0, 0.5, 1.8, 0.5, 5.0)
    assert traits.told(np.arange(3), np.zeros(3, dtype=np.int64)) == pytest.approx(first + same - apart)


def test_a_misread_one_tells_little_and_moves_no_median() -> None:
    spread = Spread(np.full(1, 0.01), np.full(1, 0.01), np.ones(1), 1.0)
    value = np.zeros((12, 1))
    value[3] = 1e6
    traits, visit = Traits(value, spread), np.repeat([0, 1], 6)
    assert traits.told(visit, np.zeros(2, dtype=np.int64)) > 0.0
    visits = traits.of_visits(visit, 2)
    one = traits.same(traits.singly(np.array([3])), visits.part([1]))
    assert one[0] == -MISREAD_NATS
    other = Traits(value + np.where(visit == 0, 1e3, 0.0)[:, None], spread).of_visits(visit, 2)
    assert traits.same(other.part([0]), other.part([1]))[0] == -MOST_READINGS * MISREAD_NATS


def test_medians_are_those_of_numpy() -> None:
    rng = np.random.default_rng(1)
    value, number = rng.normal(size=(200, 3)), rng.integers(-1, 25, 200)
    value[rng.random((200, 3)) < 0.3] = np.nan
    found, read = medians(value, number, 26)
    for k in range(26):
        mine = value[number == k]
        for c in range(3):
            some = mine[np.isfinite(mine[:, c]), c]
            assert read[k, c] == len(some)
            np.testing.assert_equal(found[k, c], np.median(some) if len(some) else np.nan)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 255.0])
def test_spreads_are_learned_in_any_unit(unit: float) -> None:
    true = Spread(np.array([0.04, 0.01]), np.array([0.02, 0.09]), np.array([1.0, 0.8]), 1.0)
    value, visit, landmark = drawn(np.random.default_rng(2), true, landmarks=100)
    wrong = np.random.default_rng(3).random(len(value)) < 0.05
    value[wrong] += 30.0
    found = learned(unit * value, visit, landmark)
    assert found is not None
    np.testing.assert_allclose(found.spread.reading, unit**2 * true.reading, rtol=0.25)
    np.testing.assert_allclose(found.spread.landmark, unit**2 * true.landmark, rtol=0.35)
    errors = found.spread.visit + found.spread.reading / MOST_READINGS
    assert np.all((errors > 0.5 * unit**2 * true.visit) & (errors < 2.5 * unit**2 * (true.visit + 0.25 * true.reading)))


def test_what_tells_nothing_is_not_used() -> None:
    rng = np.random.default_rng(4)
    noise = Spread(np.ones(20), np.zeros(20), np.zeros(20), 1.0)
    assert learned(*drawn(rng, noise)) is None
    fickle = Spread(np.array([0.01]), np.array([1.0]), np.zeros(1), 1.0)  # another value in every visit
    assert learned(*drawn(rng, fickle)) is None
    value, visit, landmark = drawn(rng, Spread(np.array([0.01]), np.array([0.01]), np.ones(1), 1.0))
    for none in (np.full_like(value, np.nan), np.full_like(value, 3.0)):
        assert learned(none, visit, landmark) is None
    both = np.hstack([rng.normal(size=value.shape), value])
    found = learned(both, visit, landmark)
    assert found is not None
    np.testing.assert_allclose(found.value[:, 0] - value[:, 0], found.value[0, 0] - value[0, 0])


def test_visits_given_to_wrong_landmarks_do_not_hide_what_tells() -> None:
    rng = np.random.default_rng(5)
    true = Spread(np.full(4, 0.04), np.full(4, 0.02), np.ones(4), 1.0)
    value, visit, landmark = drawn(rng, true, landmarks=100)
    some = rng.random(len(landmark)) < 0.3
    wrong = landmark.copy()
    wrong[some] = rng.permutation(landmark[some])
    order = np.argsort(wrong, kind="stable")
    found = learned(value, np.argsort(order)[visit], wrong[order])
    assert found is not None
    assert np.all(found.spread.visit < 0.2)


def test_columns_that_say_the_same_count_once() -> None:
    rng = np.random.default_rng(6)
    value, visit, landmark = drawn(rng, Spread(np.array([0.01]), np.array([0.01]), np.ones(1), 1.0))
    one, four = learned(value, visit, landmark), learned(np.tile(value, 4), visit, landmark)
    assert one is not None
    assert four is not None
    assert four.told(visit, landmark) == pytest.approx(one.told(visit, landmark), rel=0.01)


def test_nothing_read_is_no_evidence() -> None:
    traits = replace(Traits.none(5), value=np.zeros((5, 0)))
    visits = traits.of_visits(np.array([0, 0, 1, -1, 1]), 2)
    np.testing.assert_array_equal(traits.same(visits, visits), [0.0, 0.0])
