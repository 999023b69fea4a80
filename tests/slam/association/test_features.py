"""What landmarks are like: the ratio of Gaussians against scipy, what is learned against what was drawn, and harm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identity_scores import identity_scores
from problems import make_world
from recordings import building, first_seconds
from scipy.stats import multivariate_normal, norm

from evermap.config import Config, SlamConfig
from evermap.slam.association import with_identities
from evermap.slam.association.assignment import NOBODY, Assignment
from evermap.slam.association.features import Likeness, Traits, Variances, learned, medians
from evermap.slam.association.in_plane import PlanarAssociator
from evermap.slam.association.particles import drawn as drawn_anew
from evermap.slam.association.wrong_associations import traits_against_others
from evermap.slam.calibration import CalibrationPrior
from evermap.types import UNKNOWN

NAMELESS = SlamConfig(unknown_ids=True)
READINGS = Config().slam.association.readings


def brute_force(a: float, va: float, b: float, vb: float, between: float) -> float:
    """Log likelihood ratio of two values of one landmark, and of two."""
    together = multivariate_normal([0.0, 0.0], [[between + va, between], [between, between + vb]])
    alone = norm(0.0, np.sqrt(between + va)).logpdf(a) + norm(0.0, np.sqrt(between + vb)).logpdf(b)
    return float(together.logpdf([a, b]) - alone)


def drawn(
    rng: np.random.Generator, spread: Variances, *, landmarks: int = 40, visits: int = 4, readings: int = 6
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
    spread = Variances(np.ones(3), np.ones(3), np.array([4.0, 0.5, 25.0]), 0.7)
    one, other = rng.normal(size=(2, 20, 3)) * np.sqrt(spread.landmark + 1.0)
    va, vb = rng.uniform(0.1, 2.0, (2, 20, 3))
    one[3, 1] = other[4] = np.nan
    many = np.full(20, 1e9)  # no limit
    found = Traits(one, spread).same(Likeness(one, va, many), Likeness(other, vb, many))
    for k in range(20):
        each = [brute_force(one[k, c], va[k, c], other[k, c], vb[k, c], spread.landmark[c]) for c in range(3)]
        assert found[k] == pytest.approx(0.7 * np.nansum(each), abs=1e-9)
    assert found[4] == 0.0


def test_readings_of_visits_and_landmarks_are_those_of_a_joint_gaussian() -> None:
    """Two visits with a reading each, against a third: as the Gaussian of all three readings has it."""
    spread = Variances(np.array([0.3]), np.array([0.2]), np.array([5.0]), 1.0)
    value = np.array([[1.0], [1.8], [0.4]])
    traits = Traits(value, spread)
    visits = traits.of_visits(np.arange(3), 3)
    known = traits.of_landmarks(visits.part([0, 1]), np.zeros(2, dtype=np.int64), 1)
    own = 0.5 * np.eye(3)
    same = multivariate_normal(np.zeros(3), own + 5.0).logpdf(value[:, 0])
    apart = multivariate_normal(np.zeros(2), own[:2, :2] + 5.0).logpdf(value[:2, 0]) + norm(0, np.sqrt(5.5)).logpdf(0.4)
    assert traits.same(visits.part([2]), known)[0] == pytest.approx(same - apart)
    first = brute_force(1.0, 0.5, 1.8, 0.5, 5.0)
    assert traits.evidence(np.arange(3), np.zeros(3, dtype=np.int64)) == pytest.approx(first + same - apart)


def test_a_misread_one_tells_little_and_moves_no_median() -> None:
    spread = Variances(np.full(1, 0.01), np.full(1, 0.01), np.ones(1), 1.0)
    value = np.zeros((12, 1))
    value[3] = 1e6
    traits, visit = Traits(value, spread), np.repeat([0, 1], 6)
    assert traits.evidence(visit, np.zeros(2, dtype=np.int64)) > 0.0
    visits = traits.of_visits(visit, 2)
    one = traits.same(traits.singly(np.array([3])), visits.part([1]))
    assert one[0] == -READINGS.misread_nats
    other = Traits(value + np.where(visit == 0, 1e3, 0.0)[:, None], spread).of_visits(visit, 2)
    assert traits.same(other.part([0]), other.part([1]))[0] == -READINGS.most_readings * READINGS.misread_nats


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
    true = Variances(np.array([0.04, 0.01]), np.array([0.02, 0.09]), np.array([1.0, 0.8]), 1.0)
    value, visit, landmark = drawn(np.random.default_rng(2), true, landmarks=100)
    wrong = np.random.default_rng(3).random(len(value)) < 0.05
    value[wrong] += 30.0
    found = learned(unit * value, visit, landmark)
    assert found is not None
    np.testing.assert_allclose(found.spread.reading, unit**2 * true.reading, rtol=0.25)
    np.testing.assert_allclose(found.spread.landmark, unit**2 * true.landmark, rtol=0.35)
    errors = found.spread.visit + found.spread.reading / READINGS.most_readings
    assert np.all((errors > 0.5 * unit**2 * true.visit) & (errors < 2.5 * unit**2 * (true.visit + 0.25 * true.reading)))


def test_what_tells_nothing_is_not_used() -> None:
    rng = np.random.default_rng(4)
    noise = Variances(np.ones(20), np.zeros(20), np.zeros(20), 1.0)
    assert learned(*drawn(rng, noise)) is None
    fickle = Variances(np.array([0.01]), np.array([1.0]), np.zeros(1), 1.0)  # another value in every visit
    assert learned(*drawn(rng, fickle)) is None
    value, visit, landmark = drawn(rng, Variances(np.array([0.01]), np.array([0.01]), np.ones(1), 1.0))
    for none in (np.full_like(value, np.nan), np.full_like(value, 3.0)):
        assert learned(none, visit, landmark) is None
    both = np.hstack([rng.normal(size=value.shape), value])
    found = learned(both, visit, landmark)
    assert found is not None
    np.testing.assert_allclose(found.value[:, 0] - value[:, 0], found.value[0, 0] - value[0, 0])


def test_visits_given_to_wrong_landmarks_do_not_hide_what_tells() -> None:
    rng = np.random.default_rng(5)
    true = Variances(np.full(4, 0.04), np.full(4, 0.02), np.ones(4), 1.0)
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
    value, visit, landmark = drawn(rng, Variances(np.array([0.01]), np.array([0.01]), np.ones(1), 1.0))
    one, four = learned(value, visit, landmark), learned(np.tile(value, 4), visit, landmark)
    assert one is not None
    assert four is not None
    assert four.evidence(visit, landmark) == pytest.approx(one.evidence(visit, landmark), rel=0.01)


def test_nothing_read_is_no_evidence() -> None:
    traits = replace(Traits.none(5), value=np.zeros((5, 0)))
    visits = traits.of_visits(np.array([0, 0, 1, -1, 1]), 2)
    np.testing.assert_array_equal(traits.same(visits, visits), [0.0, 0.0])


def radii(rng: np.random.Generator, row: np.ndarray) -> Traits:
    """Radii of landmarks (M,), one in twenty misread."""
    value = np.linspace(-0.2, 0.2, int(row.max()) + 1)[row] + rng.normal(0.0, 0.01, len(row))
    value = np.where(rng.random(len(row)) < 0.05, rng.uniform(-5.0, 5.0, len(row)), value)
    return Traits(value[:, None], Variances(np.full(1, 1e-4), np.full(1, 1e-4), np.full(1, 0.02), 1.0))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
def test_misread_radii_split_nothing(seed: int) -> None:
    made = make_world(seed, n_poses=60, n_landmarks=8, prior=CalibrationPrior.from_settings(calibrated=False))
    true = made.problem.landmark_row
    associator = PlanarAssociator(made.problem, made.noise, traits=radii(np.random.default_rng(seed), true))
    for _ in made.problem.stamp_s:
        associator.step()
    found = associator.finish()
    scores = identity_scores(found.landmark_row, true)
    assert (scores.n_landmarks, scores.purity) == (8, 1.0)
    assert np.mean(found.landmark_row == NOBODY) < 0.02
    again = identity_scores(drawn_anew(found, np.full(5, 0.1), 0)[0].landmark_row, true)
    assert again.purity > 0.98


def test_an_exchange_of_two_landmarks_is_seen() -> None:
    """Landmarks 0 and 1 are exchanged when the robot comes back; positions give no evidence."""
    made = make_world(1, n_poses=60, n_landmarks=8, prior=CalibrationPrior.from_settings(calibrated=False))
    place, back = made.problem.landmark_row, made.problem.pose_row >= 30
    is_there = np.where(back & (place < 2), 1 - place, place)
    traits = radii(np.random.default_rng(1), 7 * is_there % 8)
    later = replace(made.problem, stamp_s=made.problem.stamp_s + 100.0 * (np.arange(60) >= 30))
    found = Assignment(later, place, made.truth, np.full((len(place), 2), UNKNOWN), traits)
    nats, landmark = traits_against_others(found), np.repeat(np.arange(8), 2)
    assert np.all(nats[landmark < 2] < -2.0 * READINGS.misread_nats)
    assert np.all(nats[landmark >= 2] > 0.0)
    gained = traits.evidence(*replace(found, landmark_row=is_there).of_visits()) - traits.evidence(*found.of_visits())
    assert gained > 2.0 * READINGS.most_readings * READINGS.misread_nats


@pytest.mark.slow
def test_a_useless_column_changes_nothing_and_a_good_one_no_identity() -> None:
    recording = first_seconds(building(3).sessions[0], 45.0)
    seen, rng = recording.detections, np.random.default_rng(7)
    plain = with_identities(recording, NAMELESS).detections.landmark_id
    noise = rng.normal(size=(len(seen), 2))
    good = 0.1 * rng.normal(size=int(seen.landmark_id.max()) + 1)[seen.landmark_id, None] + 0.02 * noise[:, :1]
    for features, same in ((noise, True), (good, False)):
        names = tuple(f"descriptor_{k}" for k in range(features.shape[1]))
        given = replace(recording, detections=replace(seen, features=features, feature_names=names))
        found = with_identities(given, NAMELESS).detections.landmark_id
        if same:
            np.testing.assert_array_equal(found, plain)
        else:
            before, after = (identity_scores(one, seen.landmark_id) for one in (plain, found))
            assert after.purity >= before.purity - 0.002
            assert after.completeness >= before.completeness - 0.002
