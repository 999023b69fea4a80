"""Noise of ranges and bearings that nothing is stated of, by the range, in the plane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from evermap.config import SlamConfig
from evermap.estimate.noise import fit_variances, gain_by_variances, raise_ranges
from evermap.geometry import se2
from evermap.metrics.summary import compare_with_truth
from evermap.pipeline import run_slam
from evermap.slam.batch import Outcome
from evermap.slam.estimate import solve
from evermap.types import FloatArray, Recording, VerdictKind
from evermap_studies.worlds.lasers import LaserWorld, simulate_laser

Law = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Standard deviations of range and bearing, by range."""
LAWS: dict[str, Law] = {
    "constant": lambda r: (np.full_like(r, 0.03), np.full_like(r, 0.01)),
    "stereo": lambda r: (0.006 * r**2, np.full_like(r, 0.002)),
    "share": lambda r: (0.04 * r, np.full_like(r, 0.01)),
    "positions": lambda r: (np.full_like(r, 0.04), 0.04 / r),
}
WORLD = LaserWorld(n_landmarks=40, range_max_m=12.0, sigma_range_m=1e-6, sigma_bearing_rad=1e-6, duration_s=180.0)


def recorded(seed: int, law: Law | None, inverse_m: float = 0.0, world: LaserWorld = WORLD) -> Recording:
    """Readings with noise by range that they do not state.

    Args:
        seed: of everything.
        law: of the noise.
        inverse_m: or the standard deviation of inverse ranges [1/m], as a stereo pair's are.
        world: driven through.
    """
    recording, random = simulate_laser(world, seed), np.random.default_rng(seed)
    seen, unknown = recording.detections, np.full(len(recording.detections), np.nan)
    range_m, bearing = seen.range_m, seen.bearing_rad
    noise = random.normal(size=(2, len(seen)))
    if law is not None:
        of_range, of_bearing = law(range_m)
        read_m = range_m + of_range * noise[0]
    else:
        of_bearing = np.full_like(range_m, 0.002)
        read_m = 1.0 / np.maximum(1.0 / range_m + inverse_m * noise[0], 0.02)
    bearing = se2.wrap(bearing + of_bearing * noise[1])
    detections = replace(
        seen, range_m=np.maximum(read_m, 0.05), bearing_rad=bearing, sigma_range_m=unknown, sigma_bearing_rad=unknown
    )
    sensor = replace(recording.sensor, measures_positions=True)
    return replace(recording, detections=detections, sensor=sensor)


def solved(recording: Recording) -> Outcome:
    return solve(recording, SlamConfig()).outcome


@pytest.mark.parametrize("law", LAWS)
def test_noise_is_that_of_the_range(law: str) -> None:
    outcome = solved(recorded(1, LAWS[law]))
    problem = outcome.problem
    range_m, sigma = problem.reading[:, 0], problem.find_sigma(outcome.noise.noise)
    for low, high in ((2.0, 4.0), (5.0, 7.0), (9.0, 11.5)):
        some = (range_m > low) & (range_m < high)
        true = np.median(np.column_stack(LAWS[law](range_m[some])), axis=0)
        assert np.median(sigma[some], axis=0) == pytest.approx(true, rel=0.15)


def test_noise_that_is_alike_everywhere_keeps_one_level() -> None:
    """Two numbers more for ranges and one for bearings gain nothing."""
    assert solved(recorded(2, LAWS["constant"])).problem.noise_shape is None


def test_levels_are_worth_as_much_as_all_detections() -> None:
    outcome = solved(recorded(3, LAWS["stereo"]))
    problem, level = outcome.problem, outcome.noise.noise.detection
    assert problem.noise_shape is not None
    assert np.mean(problem.noise_shape**-2, axis=0) == pytest.approx(1.0, rel=1e-6)
    assert np.mean(problem.find_sigma(outcome.noise.noise) ** -2, axis=0) == pytest.approx(level**-2)


def test_what_is_stated_stays() -> None:
    recording = recorded(3, LAWS["stereo"])
    seen = recording.detections
    stated = np.where(np.arange(len(seen)) % 2 == 0, 0.3, np.nan)
    outcome = solved(replace(recording, detections=replace(seen, sigma_range_m=stated)))
    problem = outcome.problem
    sigma, given = problem.find_sigma(outcome.noise.noise), np.isfinite(problem.sigma_given[:, 0])
    assert np.all(sigma[given, 0] == 0.3)
    assert np.ptp(sigma[~given, 0]) > 0.2


def test_noise_that_is_not_to_be_learned_is_not() -> None:
    recording = recorded(3, LAWS["positions"])
    assert solved(recording).problem.noise_shape is not None
    assert solve(recording, SlamConfig(estimate_noise=False)).outcome.problem.noise_shape is None
    for own in ({"sigma_range_m": 0.1}, {"measures_positions": False}):  # stated, or ranges and bearings as such
        other = replace(recording, sensor=replace(recording.sensor, **own))
        assert solved(other).problem.noise_shape is None


@pytest.mark.parametrize("seed", [4, pytest.param(5, marks=pytest.mark.slow)])
def test_lengths_of_inverse_ranges_have_no_bias(seed: int) -> None:
    """A stereo pair measures these: by expected ranges alone lengths are too long, by measured ones too short."""
    recording = recorded(seed, None, inverse_m=0.015)
    result = run_slam(recording)
    true, found = recording.true_landmarks, result.landmarks
    assert true is not None
    row = np.searchsorted(true.landmark_id, found.landmark_id)
    away = [at - at.mean(axis=0) for at in (found.position_m, true.position_m[row])]
    scale = np.linalg.svd(away[0].T @ away[1], compute_uv=False).sum() / (away[0] ** 2).sum()
    assert scale == pytest.approx(1.0, abs=0.003)


@pytest.mark.parametrize("seed", [4, pytest.param(5, marks=pytest.mark.slow)])
def test_a_stereo_pair_without_a_data_sheet_is_no_suspect(seed: int) -> None:
    """By one level its ranges are eight times as noisy as sensors usually are, though the nearest are good."""
    recording = recorded(seed, None, inverse_m=0.01)
    result = run_slam(recording)
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SOUND, result.verdict.message
    found = compare_with_truth(recording, result)
    assert found.poses is not None
    assert found.poses.rmse_m < 0.03


def test_variances_are_the_most_probable_ones() -> None:
    random = np.random.default_rng(0)
    columns = random.uniform(0.1, 2.0, (5000, 1)) ** np.array([0.0, 2.0, 4.0])
    true = columns @ [0.3, 0.0, 0.5]
    squares, counts = true * random.normal(size=5000) ** 2, np.ones(5000)
    found = fit_variances(columns, squares, counts)
    assert np.all(np.abs(np.log(found / true)) < 0.15)
    for by in ([0.05, 0.0, 0.0], [-0.05, 0.0, 0.0], [0.0, 0.05, 0.0], [0.0, 0.0, 0.05], [0.0, 0.0, -0.05]):
        assert gain_by_variances(squares, counts, found, found + columns @ by, 1.0) < 0.05
    assert gain_by_variances(squares, counts, np.full(5000, true.mean()), found, 1.0) > 100.0
    assert gain_by_variances(squares, counts, found, 1.1 * found, 0.5) == pytest.approx(
        0.5 * gain_by_variances(squares, counts, found, 1.1 * found, 1.0)
    )


def test_powers_of_ranges_weigh_inverse_ones_without_bias() -> None:
    """At the true range e the mean of `(m - e) / (e^3 m)` is zero for measured m with normal 1 / m."""
    random, expected_m = np.random.default_rng(1), np.full(200_000, 8.0)
    measured_m = 1.0 / (1.0 / expected_m + 0.01 * random.normal(size=200_000))
    constant, square, fourth = raise_ranges((0, 2, 4), expected_m, measured_m).T
    assert np.all(constant == 1.0)
    assert np.all(square == 64.0)
    pull = (measured_m - expected_m) / fourth
    assert abs(pull.mean()) < 3.0 * pull.std() / np.sqrt(len(pull))
    biased = (measured_m - expected_m) / expected_m**4
    assert biased.mean() > 10.0 * biased.std() / np.sqrt(len(pull))
