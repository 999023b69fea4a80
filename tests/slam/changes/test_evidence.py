"""WindowEvidence about the landmarks against dense linear algebra, and its comparison with a map against scipy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from dense import DensePosterior
from problems import World, default_prior, make_world, slow_detection
from references import log_group_prior, log_normal, random_covariance, static_evidence
from test_gain import gain_of

from evermap.config import ChangesConfig, RangesConfig
from evermap.estimate.sparse.system import exhaust
from evermap.slam.calibration import AHEAD, ASIDE, FORWARD, SKEW, SLIP, SLOPE
from evermap.slam.changes.evidence import WindowEvidence, compare, in_sensor_metres, landmark_evidence
from evermap.slam.problem import Estimate, Problem, independent
from evermap.types import ANY_BEARING_RAD

KNOWN_SIZE = default_prior(range_slope=0.0)
"""With the range slope given, lengths are what the sensor says: nothing to divide."""
RANGES = RangesConfig()


def evidence_of(world: World, bounds: list[int], estimate: Estimate | None = None) -> WindowEvidence:
    estimate = world.truth if estimate is None else estimate
    problem = world.problem
    return exhaust(landmark_evidence(problem, estimate, world.noise, problem.prior, np.array(bounds), 3, RANGES))


def with_move(world: World, name: int, shift_m: tuple[float, float], since: int) -> World:
    """The world where a landmark is elsewhere from a pose on, and is read there without noise."""
    problem, truth = world.problem, world.truth
    gone = (problem.landmark_row == name) & (problem.pose_row >= since)
    place, reading = truth.landmark[name] + shift_m, problem.reading.copy()
    poses = truth.pose[problem.pose_row[gone]]
    reading[gone] = slow_detection(poses, np.tile(place, (len(poses), 1)), truth.states, problem.mount)
    return replace(world, problem=replace(problem, reading=reading))


def problem_of_copies(problem: Problem, evidence: WindowEvidence, bounds: list[int]) -> Problem:
    """Every copy as a landmark of its own; what became no copy is not measured; no priors of start and landmarks."""
    window = np.searchsorted(bounds, problem.pose_row, side="right") - 1
    copy = {(int(j), int(w)): k for k, (j, w) in enumerate(zip(evidence.landmark, evidence.window, strict=True))}
    row = np.array([copy.get((int(j), int(w)), -1) for j, w in zip(problem.landmark_row, window, strict=True)])
    used, count = row >= 0, len(evidence.landmark)
    return replace(
        problem,
        pose_row=problem.pose_row[used],
        landmark_row=row[used],
        reading=problem.reading[used],
        sigma_given=problem.sigma_given[used],
        start_information=0.0,
        landmark_mean=np.zeros((count, 2)),
        landmark_information=np.zeros((2 * count, 2 * count)),
    )


def dense_evidence(problem: Problem, world: World, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Information and pull of the landmarks at `position`: the Schur complement of the dense normal equations."""
    posterior = DensePosterior(problem, world.noise, replace(world.truth, landmark=position))
    jacobian, residual = posterior.jacobian()
    information, pull = jacobian.T @ jacobian, -jacobian.T @ residual
    mine = np.zeros(posterior.size, bool)
    mine[3 * posterior.n_poses : 3 * posterior.n_poses + 2 * len(position)] = True
    others = information[np.ix_(~mine, ~mine)]
    gain = np.linalg.solve(others, information[np.ix_(~mine, mine)]).T
    return information[np.ix_(mine, mine)] - gain @ information[np.ix_(~mine, mine)], pull[mine] - gain @ pull[~mine]


@pytest.mark.parametrize("bounds", [[0, 24], [0, 8, 16, 24], [0, 1, 12, 24]])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_evidence_is_the_schur_complement(bounds: list[int], seed: int) -> None:
    """With noise and outliers, at a place that is not the optimum: information and pull, copies and all."""
    world = make_world(seed, n_poses=24, n_landmarks=5, prior=KNOWN_SIZE, p_outlier=0.1, turn_radps=0.2)
    evidence = evidence_of(world, bounds)
    assert np.all(np.diff(evidence.window) >= 0)
    problem = problem_of_copies(world.problem, evidence, bounds)
    information, pull = dense_evidence(problem, world, evidence.position)
    # the borders of windows are held to a kilometre, nothing else may differ
    np.testing.assert_allclose(evidence.information, information, atol=2e-5 * np.abs(information).max())
    np.testing.assert_allclose(evidence.pull, pull, atol=2e-5 * np.abs(pull).max() + 1e-3)


def test_ranges_alone_are_linear_where_the_estimate_is_whatever_the_first_bearing() -> None:
    """The one bearing of a landmark that is seen by ranges is a guess, which may be far across the line of sight."""
    world = make_world(4, n_poses=24, n_landmarks=5, prior=KNOWN_SIZE, p_seen=1.0, turn_radps=0.2)
    problem, guess = world.problem, 0.4
    sigma, reading = np.full((len(problem.reading), 2), np.nan), problem.reading.copy()
    sigma[:, 1] = ANY_BEARING_RAD
    first = np.unique(problem.landmark_row, return_index=True)[1]
    sigma[first, 1] = 0.1
    reading[:, 1] += guess
    ranged = replace(world, problem=replace(problem, reading=reading, sigma_given=sigma))
    evidence = evidence_of(ranged, [0, 8, 16, 24])
    np.testing.assert_allclose(evidence.position, world.truth.landmark[evidence.landmark], atol=1e-12)
    sigma[first + 5, 1] = 0.1  # with more of them it is where they say, by the poses of its window
    evidence = evidence_of(replace(ranged, problem=replace(ranged.problem, sigma_given=sigma)), [0, 8, 16, 24])
    off_m = np.linalg.norm(evidence.position - world.truth.landmark[evidence.landmark], axis=1)
    assert (off_m[evidence.window == 0] > 0.1).all()
    assert (off_m[evidence.window > 0] < 1e-12).all()


def test_ranges_of_what_moved_are_linear_where_it_is_by_then() -> None:
    world = make_world(4, n_poses=24, n_landmarks=5, p_seen=1.0, turn_radps=0.2)
    sigma = np.full((len(world.problem.reading), 2), np.nan)
    sigma[:, 1] = ANY_BEARING_RAD
    problem, bounds = with_move(world, 2, (0.7, -0.4), 8).problem, np.array([0, 8, 16, 24])
    problem = replace(problem, sigma_given=sigma)
    moved = replace(world.truth, landmark=np.vstack([world.truth.landmark, world.truth.landmark[2] + [0.7, -0.4]]))
    row = np.array([[0, 1, 2, 3, 4], [0, 1, 5, 3, 4], [0, 1, 5, 3, 4]])
    evidence = exhaust(landmark_evidence(problem, moved, world.noise, problem.prior, bounds, 3, RANGES, row=row))
    at = evidence.position - evidence.position[0]
    expected = moved.landmark[row[evidence.window, evidence.landmark]]
    scale = np.linalg.norm(at[1]) / np.linalg.norm(expected[1] - expected[0])  # of all by the prior of the metre
    np.testing.assert_allclose(at, scale * (expected - expected[0]), atol=1e-9)


@pytest.mark.parametrize("shift_m", [(0.9, 0.0), (-0.5, 0.6)])
def test_ranges_locate_what_moved_though_nothing_says_that_it_did(shift_m: tuple[float, float]) -> None:
    """Where it was, its later ranges are outliers: evidence from there would know nothing of it."""
    world = make_world(4, n_poses=30, n_landmarks=5, prior=KNOWN_SIZE, noisy=0.0, p_seen=1.0, turn_radps=0.2)
    sigma = np.full((len(world.problem.reading), 2), np.nan)
    sigma[:, 1] = ANY_BEARING_RAD
    moves = with_move(replace(world, problem=replace(world.problem, sigma_given=sigma)), 2, shift_m, 15)
    evidence = evidence_of(moves, [0, 15, 30])
    (row,) = np.flatnonzero((evidence.landmark == 2) & (evidence.window == 1))
    np.testing.assert_allclose(evidence.position[row], world.truth.landmark[2] + shift_m, atol=0.02)
    own = evidence.information[2 * row : 2 * row + 2, 2 * row : 2 * row + 2]
    assert np.linalg.eigvalsh(own)[0] > 1.0 / 0.1**2
    others = np.arange(len(evidence.landmark)) != row  # whose ranges agree with where they are
    np.testing.assert_array_equal(evidence.position[others], world.truth.landmark[evidence.landmark[others]])


def test_windows_with_tied_copies_are_one_window() -> None:
    """Measured exactly, so that copies are where the landmark is."""
    world = make_world(3, n_poses=24, n_landmarks=5, prior=KNOWN_SIZE, noisy=0.0, p_seen=1.0, turn_radps=0.2)
    one, many = evidence_of(world, [0, 24]), evidence_of(world, [0, 7, 15, 24])
    assert len(many.landmark) == 15
    tied = np.kron(np.eye(5)[many.landmark], np.eye(2))
    np.testing.assert_allclose(many.position, one.position[many.landmark], atol=1e-9)
    np.testing.assert_allclose(tied.T @ many.information @ tied, one.information, atol=1e-3, rtol=1e-6)
    np.testing.assert_allclose(tied.T @ many.pull, one.pull, atol=1e-4)


def test_priors_of_start_and_landmarks_do_not_matter() -> None:
    world = make_world(4, n_poses=24, n_landmarks=5, n_mapped=5)
    rng = np.random.default_rng(0)
    other = replace(
        world.problem,
        start_pose=rng.normal(size=3),
        start_information=1.0,
        landmark_mean=rng.normal(size=(5, 2)),
        landmark_information=independent(np.tile(np.eye(2), (5, 1, 1))),
    )
    ours, theirs = evidence_of(world, [0, 12, 24]), evidence_of(replace(world, problem=other), [0, 12, 24])
    np.testing.assert_array_equal(ours.information, theirs.information)
    np.testing.assert_array_equal(ours.pull, theirs.pull)


def test_landmarks_that_were_hardly_seen_have_no_copy() -> None:
    world = make_world(5, n_poses=24, n_landmarks=5, p_seen=0.2)
    window = (world.problem.pose_row >= 12).astype(int)
    for size in (1, 2):
        bounds = np.linspace(0, 24, size + 1).astype(int)
        evidence = evidence_of(world, bounds.tolist())
        seen = np.zeros((5, size), int)
        np.add.at(seen, (world.problem.landmark_row, window if size == 2 else 0), 1)
        copies = {(int(j), int(w)) for j, w in zip(evidence.landmark, evidence.window, strict=True)}
        assert copies == {(int(j), int(w)) for j, w in zip(*np.nonzero(seen >= 3), strict=True)}


@pytest.mark.parametrize("grow", [0.97, 1.04])
def test_range_slope_is_a_choice_of_metres(grow: float) -> None:
    """The same explanation with another slope and size is the same evidence."""
    world = make_world(6, n_poses=24, n_landmarks=5, turn_radps=0.2)
    truth = world.truth
    centre = truth.landmark.mean(axis=0)
    pose, states = truth.pose.copy(), truth.states.copy()
    pose[:, :2] = centre + grow * (pose[:, :2] - centre)
    states[SLOPE] = (1.0 + states[SLOPE]) / grow - 1.0
    states[FORWARD] *= grow
    states[[AHEAD, ASIDE, SLIP]] *= grow
    states[SKEW : SKEW + 2] /= grow
    other = Estimate(pose, centre + grow * (truth.landmark - centre), states)
    ours, theirs = evidence_of(world, [0, 12, 24]), evidence_of(world, [0, 12, 24], other)
    np.testing.assert_allclose(theirs.position, ours.position, atol=1e-9)
    np.testing.assert_allclose(theirs.information, ours.information, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(theirs.pull, ours.pull, rtol=1e-6, atol=1e-4)
    assert theirs.log_scale_sigma == pytest.approx(ours.log_scale_sigma)
    # how much the size is uncertain: what neither prior excludes
    sigma_slope, sigma_forward = default_prior().sigma[[SLOPE, FORWARD]]
    assert ours.log_scale_sigma == pytest.approx(
        sigma_slope * sigma_forward / np.hypot(sigma_slope, sigma_forward), rel=0.1
    )
    assert in_sensor_metres(truth, default_prior()).states[SLOPE] == 0.0
    assert in_sensor_metres(truth, KNOWN_SIZE) is truth


def well_conditioned(seed: int, *, n_windows: int = 2, log_scale_sigma: float = 0.0) -> WindowEvidence:
    rng = np.random.default_rng(seed)
    plain = static_evidence(rng.uniform(-4.0, 4.0, (5, 2)), n_windows)
    size = len(plain.pull)
    information = np.linalg.inv(random_covariance(rng, size))
    return replace(
        plain,
        position=plain.position + 0.1 * rng.normal(size=plain.position.shape),
        information=0.5 * (information + information.T),
        pull=information @ (0.05 * rng.normal(size=size)),
        log_scale_sigma=log_scale_sigma,
    )


def test_softened_adds_an_error_to_every_copy() -> None:
    for seed in range(4):
        evidence = well_conditioned(seed)
        size = len(evidence.pull)
        covariance = np.linalg.inv(evidence.information)
        optimum = covariance @ evidence.pull
        differences = []
        for sigma in (0.01, 0.05, 0.3):
            soft = evidence.soften(sigma)
            expected = covariance + sigma**2 * np.eye(size)
            np.testing.assert_allclose(soft.information, np.linalg.inv(expected), rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(np.linalg.solve(soft.information, soft.pull), optimum, atol=1e-9)
            x = np.random.default_rng(seed).normal(0.0, 0.1, size)
            log_likelihood = soft.pull @ x - 0.5 * x @ soft.information @ x + soft.log_constant
            differences.append(log_likelihood - log_normal(optimum - x, expected))
        np.testing.assert_allclose(differences, differences[0], atol=1e-6)
        # as from no error at all
        off, volume = optimum - x, np.linalg.slogdet(evidence.information)[1]  # an inverse would cost seven digits
        density = 0.5 * (volume - off @ evidence.information @ off - size * np.log(2.0 * np.pi))
        plain = evidence.pull @ x - 0.5 * x @ evidence.information @ x - density
        assert differences[0] == pytest.approx(plain, abs=1e-6)
        assert evidence.soften(0.0) is evidence


def test_without_is_marginalisation() -> None:
    evidence = well_conditioned(1)
    out = np.zeros(10, bool)
    out[[2, 7]] = True
    kept = np.repeat(~out, 2)
    rest = evidence.without(out)
    covariance = np.linalg.inv(evidence.information)
    np.testing.assert_allclose(np.linalg.inv(rest.information), covariance[np.ix_(kept, kept)], atol=1e-9)
    np.testing.assert_allclose(
        np.linalg.solve(rest.information, rest.pull), (covariance @ evidence.pull)[kept], atol=1e-9
    )
    np.testing.assert_array_equal(rest.landmark, evidence.landmark[~out])
    np.testing.assert_array_equal(rest.window, evidence.window[~out])


@pytest.mark.parametrize("n_windows", [1, 2])
@pytest.mark.parametrize("log_scale_sigma", [0.0, 0.02])
def test_comparison_is_a_gaussian_marginal_likelihood(n_windows: int, log_scale_sigma: float) -> None:
    """Places as uncertain as the map says, the size, and the measurements' errors: all of it adds up to `V`."""
    rng = np.random.default_rng(0)
    for seed in range(3):
        evidence = well_conditioned(seed, n_windows=n_windows, log_scale_sigma=log_scale_sigma)
        mean = evidence.position[:5] + 0.05 * rng.normal(size=(5, 2))
        root = 0.03 * (np.eye(2) + 0.3 * rng.normal(size=(5, 2, 2)))
        own = root @ root.transpose(0, 2, 1)
        tied = np.kron(np.eye(5)[evidence.landmark], np.eye(2))
        away = (evidence.position - evidence.position.mean(axis=0)).ravel()
        e = (evidence.position - mean[evidence.landmark]).ravel() + np.linalg.solve(evidence.information, evidence.pull)
        measured = np.linalg.inv(evidence.information) + log_scale_sigma**2 * np.outer(away, away)
        differences = []
        for factor in (0.5, 1.0, 4.0):
            comparison = compare(evidence, mean, own * factor**2, np.ones(5, bool))
            covariance = measured + tied @ independent(own * factor**2) @ tied.T
            np.testing.assert_allclose(comparison.precision, np.linalg.inv(covariance), rtol=1e-5, atol=1e-2)
            np.testing.assert_allclose(comparison.pull, np.linalg.solve(covariance, e), rtol=1e-5, atol=1e-2)
            assert comparison.misfit == pytest.approx(e @ np.linalg.solve(covariance, e), rel=1e-4)
            differences.append(comparison.log_evidence - log_normal(e, covariance))
        np.testing.assert_allclose(differences, differences[0], atol=1e-3)


def test_landmarks_that_no_map_holds_say_only_what_changes() -> None:
    """A landmark without a map has a place that is unknown: only differences of its copies count."""
    evidence = well_conditioned(2)
    mapped = np.array([True, True, True, True, False])
    mean = evidence.position[:5].copy()
    covariance = np.tile(0.02**2 * np.eye(2), (5, 1, 1))
    comparison = compare(evidence, mean, covariance, mapped)
    all_of_it = np.kron((evidence.landmark == 4)[:, None].astype(float), np.eye(2))
    np.testing.assert_allclose(comparison.precision @ all_of_it, 0.0, atol=1e-2)
    np.testing.assert_allclose(all_of_it.T @ comparison.pull, 0.0, atol=1e-2)
    elsewhere = mean.copy()
    elsewhere[4] += 5.0
    other = compare(evidence, elsewhere, covariance, mapped)
    np.testing.assert_array_equal(other.precision, comparison.precision)
    np.testing.assert_array_equal(other.pull, comparison.pull)


def test_complement_differs_by_the_size_prior_alone() -> None:
    """Seen from an unknown start, half of the landmarks moved one way, or the other half the other way."""
    prior = ChangesConfig()
    for seed in range(3):
        world = make_world(seed, n_poses=40, n_landmarks=7, start_information=1e-6, turn_radps=0.2)
        evidence = evidence_of(world, [0, 40])
        mean = world.truth.landmark.copy()
        members = np.array([1, 2, 5])
        mean[members] += [0.4, -0.3]
        comparison = compare(evidence, mean, np.tile(0.02**2 * np.eye(2), (7, 1, 1)), np.ones(7, bool))
        label = np.isin(np.arange(7), members).astype(int)
        gains = []
        for labels in (label, 1 - label):
            gain, motion = gain_of(evidence, comparison, mean, 1, labels.tolist(), [0], [False])
            gains.append((gain - log_group_prior(prior, 7, int(labels.sum())), motion[0, :2]))
        assert gains[0][0] > 50.0
        assert gains[0][0] == pytest.approx(gains[1][0], abs=1e-3)
        np.testing.assert_allclose(gains[0][1], -gains[1][1], atol=1e-5)
