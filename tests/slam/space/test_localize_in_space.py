"""In a map in space that is not estimated: where the robot is, how sure it is, and what it does when it is lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

import evermap as em
from evermap.config import Config
from evermap.errors import DataError
from evermap.geometry import se3
from evermap.slam.localize_recording import localize_in_space
from evermap.slam.space.estimate import first_places
from evermap.slam.space.intake import frames_of, path_of, prepare_space
from evermap.slam.space.local_filter import SpatialFilter
from evermap.slam.space.localize import SpatialLocalizer, SpatialPlaces
from evermap.slam.space.problem import PlacePrior, SpatialNoise
from evermap.slam.space.smoother import SpatialSmoother
from evermap.types import Landmarks, SlamResult, SpatialRecording, rows_of

from .corridors import Site, tagged_corridor
from .halls import hall, part_of_hall, tilt

HALL = Config(slam={"space": {"drift_m": 0.03, "drift_rad": 0.01}})
CORRIDOR = Config(slam={"space": {"drift_m": 0.01, "drift_rad": 0.0033, "sigma_px": 0.3}})


def surveyed(true: Landmarks, sigma_m: float, seed: int) -> Landmarks:
    """A map of it with independent errors."""
    random, count = np.random.default_rng(seed), len(true)
    position = true.position_m + random.normal(0.0, sigma_m, (count, 3))
    known = Landmarks.in_space(true.landmark_id, position, rotation=true.rotation)
    return replace(known, covariance_m2=np.tile(sigma_m**2 * np.eye(3), (count, 1, 1)), p_exists=np.ones(count))


def errors(result: SlamResult, recording: SpatialRecording) -> np.ndarray:
    """(F, 6) of the frames with a pose, in the robot's frame."""
    truth, path = recording.truth, result.trajectory
    assert truth is not None
    at = np.searchsorted(truth.stamp_s, path.stamp_s)
    return se3.local(path.pose_world_robot, truth.pose_world_robot[at])


def nees(result: SlamResult, recording: SpatialRecording) -> np.ndarray:
    error = errors(result, recording)
    return np.einsum("ni,ni->n", error, np.linalg.solve(result.trajectory.covariance, error[..., None])[..., 0])


def within_chance(total: float, degrees: int) -> bool:
    low, high = scipy.stats.chi2.ppf([0.5e-4, 1.0 - 0.5e-4], degrees)
    return bool(low < total < high)


@pytest.mark.parametrize(
    ("sigma_m", "runs"), [(0.005, 2), *(pytest.param(sigma_m, 12, marks=pytest.mark.slow) for sigma_m in (0.005, 0.1))]
)
def test_the_pose_is_as_uncertain_as_the_filter_says(sigma_m: float, runs: int) -> None:
    """Also where the map is three times worse than the sensor, and wrong in the same way in every frame."""
    total = 0.0
    for seed in range(runs):
        recording = hall(seed, n_frames=80)
        assert recording.true_landmarks is not None
        result = localize_in_space(recording, surveyed(recording.true_landmarks, sigma_m, seed), HALL)
        assert len(result.trajectory) > 70
        total += nees(result, recording)[-1]
    assert within_chance(total, 6 * runs)


@pytest.mark.parametrize("corners", [False, True])
def test_the_last_pose_is_that_of_the_batch(corners: bool) -> None:
    """Of a map that is known to a millimetre: smoothing tells the last pose no more."""
    if corners:
        world = tagged_corridor(2, n_frames=100)
        recording, true, noise = world.recording, world.tags, SpatialNoise(0.01, 0.0033, pixel=0.3)
    else:
        recording, noise = hall(2, n_frames=60, p_false=0.0), SpatialNoise(0.03, 0.01)
        assert recording.true_landmarks is not None
        true = recording.true_landmarks
    known = surveyed(true, 0.001, 0)
    exact = Config(slam={"space": {"map": {"sigma": 0.001, "drift_rad": 0.001}}}).slam.space
    places = SpatialPlaces.in_space(known, known.covariance_m2, exact)
    problem = prepare_space(recording, Config().slam.space).problem
    at = np.searchsorted(places.landmark_id, np.unique(recording.detections.landmark_id))
    covariance = np.array([places.joint_of(one) for one in at[:, None]])
    sigma = np.sqrt(np.maximum(np.einsum("kii->ki", covariance), 1e-12))
    place = np.where(np.isfinite(places.value[at]), places.value[at], np.append(np.zeros(3), se3.NO_TURN))
    prior = PlacePrior(np.arange(len(at)), place, sigma, np.ones(len(at)))
    start, sure = recording.truth.pose_world_robot, np.full(6, 0.05)  # type: ignore[union-attr]
    problem = replace(problem, prior=prior, start_sigma=sure, scale_sigma=0.0)
    estimate = replace(first_places(problem, start), place=place)
    smoother = SpatialSmoother(problem, start)
    batch, now = smoother.optimum(estimate, noise, heavy=False)
    spread = smoother.spread(now).own[36 * (len(start) - 1) : 36 * len(start)].reshape(6, 6)

    seen, _ = frames_of(recording)
    localizer = SpatialLocalizer(places, problem.mount, np.zeros(6 * len(problem.mount) + 1), noise, driven=True)
    stamps = recording.frames.stamp_s
    path, frame = path_of(recording, 0.0), recording.detections.frame
    localizer.place_at(float(stamps[0]), start[0], np.diag(sure**2))
    for k, stamp_s in enumerate(stamps.tolist()):
        located = localizer.step(stamp_s, path, seen.rows(np.flatnonzero(frame == k)))
    off = se3.local(batch.pose[-1], located.pose) / np.sqrt(np.diag(spread))
    assert np.abs(off).max() < 0.25
    np.testing.assert_allclose(np.diag(located.covariance), np.diag(spread), rtol=0.15)


def test_it_finds_its_pose_in_a_map_of_points_from_any_start() -> None:
    recording = hall(4, n_frames=60)
    assert recording.true_landmarks is not None
    known = surveyed(recording.true_landmarks, 0.02, 4)
    begun = part_of_hall(recording, 0, 60, tilt(1))
    result = localize_in_space(begun, known, HALL)
    error = errors(result, recording)
    assert len(error) > 50
    assert np.abs(error[:, :3]).max() < 0.3


def test_a_single_tag_with_odometry_waits_for_another_and_two_tell_the_pose_at_once() -> None:
    world = tagged_corridor(3)
    recording, frame = world.recording, world.recording.detections.frame
    two = int(np.flatnonzero(np.bincount(frame, minlength=160) >= 2)[0])
    result = localize_in_space(recording, surveyed(world.tags, 0.005, 1), CORRIDOR)
    assert result.trajectory.stamp_s[0] == recording.frames.stamp_s[two]
    assert np.linalg.norm(errors(result, recording)[:, :3], axis=1).max() < 0.2


def test_a_camera_without_odometry_is_located_by_each_view() -> None:
    world = tagged_corridor(3, odometry=False)
    result = localize_in_space(world.recording, surveyed(world.tags, 0.005, 1), CORRIDOR)
    away = np.linalg.norm(errors(result, world.recording)[:, :3], axis=1)
    assert len(away) > 130
    assert np.median(away) < 0.1
    assert np.sqrt(np.mean(away**2)) < 0.3


def test_a_camera_that_was_off_for_a_night_is_located_again() -> None:
    world = tagged_corridor(3, odometry=False)
    recording = world.recording
    truth = recording.truth
    assert truth is not None
    night_s = np.where(np.arange(160) < 80, 0.0, 36_000.0)
    later = replace(
        recording,
        frames=replace(recording.frames, stamp_s=recording.frames.stamp_s + night_s),
        truth=replace(truth, stamp_s=truth.stamp_s + night_s),
    )
    result = localize_in_space(later, surveyed(world.tags, 0.005, 1), CORRIDOR)
    away = np.linalg.norm(errors(result, later)[:, :3], axis=1)[result.trajectory.stamp_s > 36_000.0]
    assert len(away) > 70
    assert np.median(away) < 0.1


def test_a_camera_without_odometry_finds_itself_in_the_very_frame_that_does_not_fit() -> None:
    recording = replace(hall(6, n_frames=200), odometry=None)
    assert recording.true_landmarks is not None
    truth = recording.truth
    assert truth is not None
    kept = np.append(np.arange(60), np.arange(100, 140))  # to another end of the hall within half a second
    seen = recording.detections
    seen = rows_of(seen, np.isin(seen.frame, kept))
    stamps = recording.frames.stamp_s[: len(kept)]
    jumped = replace(
        recording,
        frames=replace(recording.frames, stamp_s=stamps),
        detections=replace(seen, frame=np.searchsorted(kept, seen.frame)),
        truth=replace(truth[kept], stamp_s=stamps),
    )
    result = localize_in_space(jumped, surveyed(recording.true_landmarks, 0.02, 6), HALL)
    at = np.searchsorted(result.trajectory.stamp_s, stamps[60])
    away = np.linalg.norm(errors(result, jumped)[:, :3], axis=1)
    assert np.linalg.norm(np.diff(truth.pose_world_robot[[59, 100], :3], axis=0)) > 4.0
    assert away[at] < 0.3


def test_a_robot_that_was_carried_away_finds_itself_again() -> None:
    recording = hall(6, n_frames=160)
    assert recording.true_landmarks is not None
    odometry = recording.odometry
    assert odometry is not None
    carried = odometry.pose_world_robot.copy()  # frames 80 to 119 are left out, and the odometry does not notice
    jump = se3.compose(carried[79], se3.inverse(carried[120]))
    carried[120:] = se3.compose(jump, carried[120:])
    kept = np.flatnonzero((np.arange(160) < 80) | (np.arange(160) >= 120))
    seen = recording.detections
    seen = rows_of(seen, np.isin(seen.frame, kept))
    stamps = recording.frames.stamp_s[kept]
    away = replace(
        recording,
        odometry=replace(rows_of(odometry, kept), pose_world_robot=carried[kept]),
        frames=replace(recording.frames, stamp_s=stamps),
        detections=replace(seen, frame=np.searchsorted(kept, seen.frame)),
    )
    result = localize_in_space(away, surveyed(recording.true_landmarks, 0.02, 6), HALL)
    error = np.linalg.norm(errors(result, recording)[:, :3], axis=1)
    lost = stamps[np.isin(stamps, result.trajectory.stamp_s)] >= recording.frames.stamp_s[120]
    assert np.median(error[~lost]) < 0.1
    assert error[lost][0] > 1.0
    assert error[lost][20:].max() < 0.3
    assert any("searched for" in text for text in result.warnings)


@pytest.mark.parametrize(
    ("sigma_m", "stated_m", "drift"),
    [
        (0.1, 0.02, 0.03),
        (0.03, 0.03, 0.15),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in ((0.03, 0.03, 0.03), (0.03, 0.15, 0.03))),
    ],
)
def test_noise_that_is_other_than_stated_is_learned_on_the_way(sigma_m: float, stated_m: float, drift: float) -> None:
    """Else a detector that is five times as bad as it says has most of its detections taken for outliers."""
    recording = hall(1, n_frames=200, sigma_m=sigma_m, drift=drift)
    assert recording.true_landmarks is not None
    seen = recording.detections
    stated = np.tile(stated_m**2 * np.eye(3), (len(seen), 1, 1))
    recording = replace(recording, detections=replace(seen, covariance_sensor_m2=stated))
    result = localize_in_space(recording, surveyed(recording.true_landmarks, 0.02, 0))
    learned = {one.name: one.value for one in result.parameters}
    assert learned["direction_noise_factor"] == pytest.approx(sigma_m / stated_m, rel=0.15)
    assert learned["range_noise_factor"] == pytest.approx(sigma_m / stated_m, rel=0.15)
    assert learned["sigma_odometry_m"] == pytest.approx(drift, rel=0.2)
    assert learned["sigma_odometry_rad"] == pytest.approx(drift / 3.0, rel=0.25)
    assert (result.innovations.p_inlier > 0.5).mean() > 0.95
    assert 3.0 < np.median(nees(result, recording)) < 9.0


def test_moved_landmarks_are_doubted_and_carry_nobody_away() -> None:
    recording = hall(8, n_frames=120)
    assert recording.true_landmarks is not None
    known = surveyed(recording.true_landmarks, 0.02, 8)
    moved = known.position_m.copy()
    moved[:6] += [0.6, -0.5, 0.4]
    result = localize_in_space(recording, replace(known, position_m=moved), HALL)
    error = np.linalg.norm(errors(result, recording)[:, :3], axis=1)
    gated = result.innovations.p_inlier < 0.5
    of_moved = result.innovations.landmark_id < 6
    assert gated[of_moved].mean() > 0.9
    assert gated[~of_moved].mean() < 0.05
    assert np.median(error) < 0.1


def test_a_map_of_another_place_is_refused() -> None:
    recording, other = hall(1, n_frames=40), hall(2, n_frames=40)
    assert other.true_landmarks is not None
    with pytest.raises(DataError, match="cannot localise in the map"):
        localize_in_space(recording, surveyed(other.true_landmarks, 0.02, 0), HALL)


def test_the_covariance_of_a_large_map_is_as_large_as_of_a_small_one() -> None:
    """What a step costs is bounded by the places in it."""
    sizes = []
    for count in (400, 4000):
        recording = hall(3, n_points=400, n_frames=30)
        assert recording.true_landmarks is not None
        known = surveyed(recording.true_landmarks, 0.02, 0)
        if count > 400:
            far = 100.0 + np.random.default_rng(0).uniform(0.0, 100.0, (count - 400, 3))
            ids = np.append(known.landmark_id, np.arange(400, count))
            known = surveyed(Landmarks.in_space(ids, np.vstack([known.position_m, far])), 0.02, 0)
        places = SpatialPlaces.in_space(known, known.covariance_m2)
        localizer = SpatialLocalizer(places, np.array([se3.identity()]), np.zeros(7), SpatialNoise(), driven=True)
        seen, _ = frames_of(recording)
        path, frame = path_of(recording, 0.0), recording.detections.frame
        for k, stamp_s in enumerate(recording.frames.stamp_s.tolist()):
            localizer.step(stamp_s, path, seen.rows(np.flatnonzero(frame == k)))
        assert isinstance(localizer._filter, SpatialFilter)
        sizes.append(localizer._filter.covariance.shape)
    assert sizes[0] == sizes[1]


@pytest.mark.slow
def test_a_living_map_of_tags_is_localised_in_and_stays_as_it_is() -> None:
    site = Site.of(1)
    first, second = site.patrol(1, 0, 1.0, 14.0), site.patrol(1, 1, 2.0, 13.0)
    living = em.run_session(first, None).living
    result = em.run_localization(second, living)
    assert result.trajectory.frame == "prior_map"
    np.testing.assert_array_equal(result.online.pose_world_robot, result.trajectory.pose_world_robot)
    batch = em.run_slam(second, prior_map=living.landmarks())
    ours, at, there = np.intersect1d(result.trajectory.stamp_s, batch.trajectory.stamp_s, return_indices=True)
    assert len(ours) > 140
    path, whole = result.trajectory.pose_world_robot[at], batch.trajectory.pose_world_robot[there]
    assert np.sqrt(np.mean(np.sum((path - whole)[:, :3] ** 2, axis=1))) < 0.08
