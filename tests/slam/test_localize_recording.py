"""A recording in a map that stays as it is: causal, nearly as good as hindsight, in spite of what has changed."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from recordings import building, first_seconds, some_rows, with_ids, with_odometry

from evermap.config import Config
from evermap.errors import DataError
from evermap.geometry import se2
from evermap.io.mrclam import read_mrclam
from evermap.pipeline import run_slam
from evermap.sensing.visibility import USUAL
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.known_places import KnownPlaces
from evermap.slam.localize import FrameSightings, Localizer
from evermap.slam.localize_recording import localize
from evermap.slam.noise import START
from evermap.slam.problem import Drive, Noise
from evermap.types import Landmarks, Recording, SlamResult, Trajectory
from evermap_studies.sim import BuildingConfig, simulate_building

SIGMA_M = 0.03


def prior() -> CalibrationPrior:
    return CalibrationPrior.from_settings(calibrated=True)


def noise(recording: Recording) -> Noise:
    sensor = recording.sensor
    assert sensor.sigma_range_m is not None
    assert sensor.sigma_bearing_rad is not None
    return replace(START, detection=np.array([sensor.sigma_range_m, sensor.sigma_bearing_rad]))


def surveyed(landmarks: Landmarks, sigma_m: float = SIGMA_M, seed: int = 0) -> Landmarks:
    off = np.random.default_rng(seed).normal(0.0, sigma_m, landmarks.position_m.shape)
    return Landmarks.at(landmarks.landmark_id, landmarks.position_m + off, sigma_m=sigma_m)


def located(recording: Recording, landmarks: Landmarks | None = None) -> SlamResult:
    assert recording.true_landmarks is not None
    landmarks = surveyed(recording.true_landmarks) if landmarks is None else landmarks
    return localize(recording, landmarks, prior(), noise(recording))


def error(recording: Recording, trajectory: Trajectory, from_s: float = -np.inf) -> np.ndarray:
    """(N, 3) in the robot's frame, where the truth is known."""
    assert recording.truth is not None
    stamp_s, pose = recording.truth.stamp_s, recording.truth.pose_world_robot
    known = (trajectory.stamp_s >= max(stamp_s[0], from_s)) & (trajectory.stamp_s <= stamp_s[-1])
    columns = pose[:, 0], pose[:, 1], np.unwrap(pose[:, 2])
    true = np.column_stack([np.interp(trajectory.stamp_s[known], stamp_s, column) for column in columns])
    return se2.log(se2.between(trajectory.pose_world_robot[known], true))


def rmse(error_m: np.ndarray) -> float:
    return float(np.sqrt((error_m[:, :2] ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_what_is_known_at_the_time_is_nearly_as_good_as_with_a_map_that_is_learned(seed):
    """The whole session's estimator, with the same map, has learned the noise and relinearised all poses by then."""
    recording = building(seed, patrol_s=90.0, faults=0.01).sessions[0]
    assert recording.true_landmarks is not None
    landmarks = surveyed(recording.true_landmarks, 0.005)
    result = located(recording, landmarks)
    whole = run_slam(recording, Config(slam={"method": "nohyp", "online": True}), prior_map=landmarks)
    assert result.trajectory.frame == "prior_map"
    settled_s = result.online.stamp_s[0] + 20.0
    both = np.intersect1d(result.online.stamp_s, whole.online.stamp_s)  # it has no poses where nothing was seen
    ours, theirs = (at_stamps(online, both) for online in (result.online, whole.online))
    assert rmse(error(recording, ours, settled_s)) < 1.7 * rmse(error(recording, theirs, settled_s))
    assert rmse(error(recording, result.online)) < 0.06


def at_stamps(trajectory: Trajectory, stamp_s: np.ndarray) -> Trajectory:
    return some_rows(trajectory, np.isin(trajectory.stamp_s, stamp_s))


def test_only_the_past_is_looked_at():
    """But for odometry up to its delay."""
    recording = building(0, patrol_s=60.0).sessions[0]
    whole, part = located(recording), located(first_seconds(recording, 30.0))
    done = len(part.online) - 5
    assert done > 50
    assert part.online.stamp_s[:done].tolist() == whole.online.stamp_s[:done].tolist()
    assert part.online.pose_world_robot[:done] == pytest.approx(whole.online.pose_world_robot[:done], abs=1e-9)


def test_the_same_twice_and_in_any_order():
    recording = building(1, patrol_s=40.0).sessions[0]
    assert recording.true_landmarks is not None
    landmarks = surveyed(recording.true_landmarks)
    one, other = located(recording, landmarks), located(recording, landmarks)
    assert (one.online.pose_world_robot == other.online.pose_world_robot).all()
    shuffled = some_rows(landmarks, np.random.default_rng(0).permutation(len(landmarks)))
    again = located(recording, shuffled)
    assert again.online.pose_world_robot == pytest.approx(one.online.pose_world_robot, abs=1e-4)
    assert again.landmarks.landmark_id.tolist() == landmarks.landmark_id.tolist()


def test_every_detection_and_every_miss_is_accounted_for():
    recording = building(2, patrol_s=60.0, faults=0.02).sessions[0]
    result = located(recording)
    detections, innovations, misses = recording.detections, result.innovations, result.misses
    assert (np.diff(innovations.detection) > 0).all()
    assert (detections.landmark_id[innovations.detection] == innovations.landmark_id).all()
    assert result.landmarks.n_hits.sum() == (innovations.p_inlier > 0.5).sum()
    assert result.landmarks.n_misses.sum() == len(misses)
    seen = set(zip(detections.frame.tolist(), detections.landmark_id.tolist(), strict=True))
    assert not seen & set(zip(misses.frame.tolist(), misses.landmark_id.tolist(), strict=True))
    assert len(result.step_s) == len(result.online)
    placed = innovations.stamp_s[0]
    used = recording.frames.stamp_s[detections.frame] >= placed
    in_map = np.isin(detections.landmark_id, result.landmarks.landmark_id)
    assert len(innovations) == (used & in_map).sum()
    # where nothing is hidden by walls, the sensor's own probability of detection says how many misses to expect
    assert misses.p_detect.min() >= USUAL.worth_a_look * recording.sensor.p_detect


@pytest.mark.slow
def test_weeks_later_the_old_map_still_serves():
    """Doors, chairs and pallets have moved since: of what is seen, a fifth to two fifths is elsewhere."""
    off = []
    for seed, change_rate in itertools.product(range(8), (0.3, 1.0)):
        config = BuildingConfig(days=15, sessions_per_day=1, patrol_s=60.0, change_rate=change_rate)
        sessions = simulate_building(config, seed=seed).sessions
        first, last = sessions[0], sessions[-1]
        was, now = first.true_landmarks, last.true_landmarks
        assert was is not None
        assert now is not None
        both = np.intersect1d(was.landmark_id, now.landmark_id)
        shift = (m.position_m[np.searchsorted(m.landmark_id, both)] for m in (was, now))
        moved = both[np.linalg.norm(np.subtract(*shift), axis=1) > 0.1]
        known = np.isin(last.detections.landmark_id, was.landmark_id)
        if 0.2 < np.isin(last.detections.landmark_id[known], moved).mean() < 0.4:
            off.append(rmse(error(last, located(last, surveyed(was)).online)))
    assert len(off) >= 6
    assert np.median(off) < 0.1
    assert max(off) < 0.25


def test_a_landmark_of_several_places_has_several_rows():
    recording = building(0, patrol_s=60.0).sessions[0]
    assert recording.true_landmarks is not None
    landmarks = surveyed(recording.true_landmarks)
    rng = np.random.default_rng(1)
    other = replace(
        landmarks,
        position_m=landmarks.position_m + rng.uniform(0.5, 2.0, (len(landmarks), 2)),
        p_exists=np.full(len(landmarks), 0.3),
    )
    both = Landmarks(
        *(
            np.concatenate([getattr(other, name), getattr(landmarks, name)])
            for name in ("landmark_id", "position_m", "covariance_m2", "class_id", "p_exists", "n_hits", "n_misses",
                         "first_seen_s", "last_seen_s")
        )
    )  # fmt: skip
    result = located(recording, replace(both, p_exists=np.where(both.p_exists != 0.3, 0.7, 0.3)))
    alone = located(recording, landmarks)
    gone = located(recording, replace(both, p_exists=np.where(both.p_exists != 0.3, 1.0, 0.0)))
    assert (gone.online.pose_world_robot == alone.online.pose_world_robot).all()
    assert result.landmarks.landmark_id.tolist() == landmarks.landmark_id.tolist()
    assert result.landmarks.position_m == pytest.approx(landmarks.position_m)
    assert rmse(error(recording, result.online)) < 1.2 * rmse(error(recording, alone.online))


def test_what_cannot_be_localised_is_one_line():
    recording = building(0, patrol_s=20.0).sessions[0]
    landmarks = surveyed(recording.true_landmarks)
    elsewhere = replace(landmarks, position_m=np.random.default_rng(0).uniform(-50, 50, landmarks.position_m.shape))
    with pytest.raises(DataError, match="cannot localise in the map"):
        located(recording, elsewhere)
    with pytest.raises(DataError, match="cannot localise in the map"):
        located(with_ids(recording, lambda ids: ids + 100_000), landmarks)
    with pytest.raises(DataError, match="cannot localise in the map"):
        located(recording, replace(landmarks, p_exists=np.zeros(len(landmarks))))
    with pytest.raises(DataError, match="no odometry"):
        located(with_odometry(recording, np.zeros(len(recording.odometry), dtype=bool)), landmarks)


def test_an_interrupt_keeps_what_was_done():
    recording = building(0, patrol_s=40.0).sessions[0]

    def stop(done_s: float, all_s: float) -> None:
        assert 0.0 <= done_s <= all_s
        if done_s > 20.0:
            raise KeyboardInterrupt

    result = localize(recording, surveyed(recording.true_landmarks), prior(), noise(recording), progress=stop)
    assert result.interrupted
    assert 19.0 < result.online.stamp_s[-1] - recording.frames.stamp_s[0] < 21.0


@pytest.mark.slow
@pytest.mark.parametrize("robot", range(1, 6))
def test_real_robots_among_surveyed_barrels(robot, shared_data):
    path = shared_data / "mrclam" / "MRCLAM_Dataset6.zip"
    if not path.is_file():
        pytest.skip(f"no recording {path}")
    recording = read_mrclam(path, robot)
    true = recording.true_landmarks
    assert true is not None
    landmarks = Landmarks.at(true.landmark_id, true.position_m, sigma_m=0.005)
    result = localize(recording, landmarks, prior(), START)
    wrong = error(recording, result.online)
    assert rmse(wrong) < 0.1
    assert np.degrees(np.sqrt((wrong[:, 2] ** 2).mean())) < 3.0
    nees = np.einsum("ni,ni->n", wrong, np.linalg.solve(result.online.covariance, wrong[..., None])[..., 0])
    assert 1.0 < nees.mean() < 6.0


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_landmarks_that_the_map_lacks_hold_the_pose_where_they_were_seen_first(seed):
    """In a map of half a building; in a map of all of it they change nothing."""
    recording = building(seed, patrol_s=120.0, faults=0.01).sessions[0]
    assert recording.true_landmarks is not None
    every = surveyed(recording.true_landmarks)
    half = some_rows(every, every.position_m[:, 0] < np.median(every.position_m[:, 0]))
    off, nees = {}, {}
    for name, landmarks in (("all", every), ("half", half)):
        for learn in (False, True):
            run = stepped(recording, landmarks, learn=learn)
            gap = error(recording, run)
            off[name, learn] = rmse(gap)
            nees[name, learn] = np.median(np.einsum("ni,nij,nj->n", gap, np.linalg.inv(run.covariance), gap))
    assert off["all", True] == off["all", False]
    assert off["half", True] < 0.5 * off["half", False]
    assert nees["half", True] < 2.37  # the median of three degrees of freedom


def stepped(recording: Recording, landmarks: Landmarks, *, learn: bool) -> Trajectory:
    """The localiser's poses."""
    places = KnownPlaces.of(
        landmarks.landmark_id, landmarks.position_m, landmarks.covariance_m2, np.full(len(landmarks), 0.95)
    )
    localizer = Localizer(places, recording.sensor, prior(), noise(recording), learn=learn)
    odometry, frames, seen = recording.odometry, recording.frames, recording.detections
    start_s = odometry.stamp_s[0]
    velocity = np.column_stack([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps])
    drive = Drive.from_rows(odometry.stamp_s - start_s, velocity)
    found = []
    for frame, stamp_s in enumerate(frames.stamp_s):
        rows = seen.frame == frame
        reading, unsaid = np.column_stack([seen.range_m, seen.bearing_rad])[rows], np.full((rows.sum(), 2), np.nan)
        located = localizer.step(stamp_s - start_s, drive, FrameSightings(seen.landmark_id[rows], reading, unsaid))
        if np.isfinite(located.pose[0]):
            found.append((stamp_s, located.pose, located.covariance))
    stamps, pose, covariance = zip(*found, strict=True)
    run = Trajectory(np.array(stamps), np.array(pose), np.array(covariance), "prior_map")
    assert recording.truth is not None
    known = (run.stamp_s >= recording.truth.stamp_s[0]) & (run.stamp_s <= recording.truth.stamp_s[-1])
    return some_rows(run, known)
