"""Noise of positions that nothing is stated of, by their ranges: worlds with a lidar, a stereo pair, and others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap.config import Config
from evermap.io.spatial import spatial_detections
from evermap.metrics.summary import compare_with_truth
from evermap.pipeline import run_slam
from evermap.slam.space.estimate import converge, first_places
from evermap.slam.space.intake import prepare_space, start_noise
from evermap.slam.space.linearise import ACROSS, ALONG
from evermap.slam.space.range_noise import learn_range_noise, with_range_noise
from evermap.slam.space.solve import solve_space
from evermap.types import FloatArray, Frames, Landmarks, SpatialRecording, SpatialSensor, Trajectory, VerdictKind

from .corridors import _drifting, poses

Noise = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Standard deviations across and along the line of sight, by range."""
LAWS: dict[str, Noise] = {
    "lidar": lambda r: (0.001 * r, np.full_like(r, 0.02)),
    "constant": lambda r: (np.full_like(r, 0.02), np.full_like(r, 0.02)),
    "stereo": lambda r: (0.001 * r, 0.003 * r**2),
    "sizes": lambda r: (0.002 * r, 0.03 * r),
}
FARTHEST_M = 24.0


def field(
    seed: int,
    *laws: Noise,
    n_frames: int = 300,
    n_points: int = 40,
    outliers: float = 0.02,
    stated_m: float | None = None,
    drift: float = 0.02,
    late_s: float = 0.0,
) -> SpatialRecording:
    """Drive through a field of points; each sensor looks ahead of the robot, the second one to its left.

    Args:
        seed: of everything.
        laws: of each sensor's noise.
        n_frames: five in two seconds.
        n_points: in the field.
        outliers: share of detections that are a metre off.
        stated_m: standard deviation that detections state; None where they state none.
        drift: of the odometry.
        late_s: by how much what the last sensor sees is stamped late.
    """
    random = np.random.default_rng(seed)
    stamp_s, place = 0.4 * np.arange(n_frames), random.uniform((-5.0, -5.0, 0.0), (25.0, 20.0, 4.0), (n_points, 3))

    def drive(stamp_s: FloatArray) -> tuple[FloatArray, Rotation]:
        angle = 5.0 * np.pi * stamp_s / (0.4 * n_frames)
        at = np.column_stack([10.0 + 7.0 * np.cos(angle), 7.0 + 4.5 * np.sin(angle), 1.0 + 0.3 * np.sin(3.0 * angle)])
        heading = np.unwrap(np.arctan2(4.5 * np.cos(angle), -7.0 * np.sin(angle)))
        turn = Rotation.from_euler("ZYX", np.column_stack([heading, 0.05 * np.sin(np.outer(stamp_s, [0.9, 0.7]))]))
        return at, turn

    at, turn = drive(stamp_s)
    from_where = [drive(stamp_s - (late_s if sensor == len(laws) - 1 else 0.0)) for sensor in range(len(laws))]
    pose, rows = poses(at, turn), []
    for row in range(n_frames):
        for sensor, law in enumerate(laws):
            eye, turned = from_where[sensor]
            looks = turned[row] * Rotation.from_euler("z", 0.5 * np.pi * sensor)
            ahead = looks.inv().apply(place - eye[row])
            range_m = np.linalg.norm(ahead, axis=1)
            seen = (range_m < FARTHEST_M) & (ahead[:, 0] > 0.8) & (random.random(n_points) < 0.6)
            for k in np.flatnonzero(seen):
                ray, (across, along) = ahead[k] / range_m[k], law(range_m[k : k + 1])
                noise = random.normal(size=3)
                noise = across[0] * (noise - ray * (noise @ ray)) + along[0] * (noise @ ray) * ray
                if random.random() < outliers:
                    noise = random.normal(size=3)
                rows.append((row, sensor, k, *(ahead[k] + noise)))
    table = np.array(rows)
    covariance = {}
    if stated_m is not None:
        covariance["covariance_sensor_m2"] = np.tile(stated_m**2 * np.eye(3), (len(table), 1, 1))
    detections = spatial_detections(
        table[:, 0].astype(int), sensor=table[:, 1].astype(int), landmark_id=table[:, 2].astype(int),
        position_sensor_m=table[:, 3:], **covariance,
    )  # fmt: skip
    mount = [np.append(np.zeros(3), Rotation.from_euler("z", 0.5 * np.pi * k).as_quat()) for k in range(len(laws))]
    sensors = tuple(SpatialSensor(name=f"sensor{k}", mount_robot_sensor=mount[k]) for k in range(len(laws)))
    return SpatialRecording(
        f"field {seed}", _drifting(pose, stamp_s, drift, random), Frames(stamp_s), detections, sensors,
        Trajectory(stamp_s, pose, np.zeros((n_frames, 6, 6)), frame="truth"),
        Landmarks.in_space(np.arange(n_points), place),
    )  # fmt: skip


def solve(recording: SpatialRecording):
    config = Config().slam
    return solve_space(prepare_space(recording, config.space), None, changes=config.changes).optimum


def sigmas_of(optimum) -> tuple[FloatArray, FloatArray]:
    """Ranges (M,) as measured, and standard deviations (M, 2) of positions there."""
    problem = optimum.smoother.problem
    return (
        np.linalg.norm(problem.measured[:, :3], axis=1),
        problem.sigma_position_m * optimum.noise.levels[[ACROSS, ALONG]],
    )


@pytest.mark.parametrize("outliers", [0.0, 0.02])
def test_exact_positions_are_solved(outliers: float) -> None:
    """As a simulator makes them: noise has a bound below, and does not vanish round by round."""
    recording = field(1, lambda r: (0.0 * r, 0.0 * r), n_frames=60, outliers=outliers)
    result = run_slam(recording)
    assert compare_with_truth(recording, result).poses.rmse_m < 3e-3
    assert result.verdict is not None
    assert result.verdict.kind.is_trustworthy


@pytest.mark.parametrize(
    "law", ["lidar", "sizes", *(pytest.param(law, marks=pytest.mark.slow) for law in ("constant", "stereo"))]
)
def test_noise_is_that_of_the_range(law: str) -> None:
    """One level has a lidar's noise wrong by a factor of five between the nearest and the farthest points."""
    optimum = solve(field(1, LAWS[law]))
    if law != "sizes":  # which are a level times what is usual
        assert optimum.noise.levels[[ACROSS, ALONG]] == pytest.approx(1.0, abs=0.15)
    range_m, found = sigmas_of(optimum)
    for low, high in ((3.0, 6.0), (8.0, 12.0), (16.0, 22.0)):
        some = (range_m > low) & (range_m < high)
        true = np.median(np.column_stack(LAWS[law](range_m[some])), axis=0)
        assert np.median(found[some], axis=0) == pytest.approx(true, rel=0.12)


@pytest.mark.slow
def test_each_sensor_has_its_own() -> None:
    optimum = solve(field(2, LAWS["constant"], LAWS["stereo"]))
    range_m, found = sigmas_of(optimum)
    for sensor, law in enumerate(("constant", "stereo")):
        some = (optimum.smoother.problem.sensor == sensor) & (range_m > 8.0) & (range_m < 12.0)
        true = np.median(np.column_stack(LAWS[law](range_m[some])), axis=0)
        assert np.median(found[some], axis=0) == pytest.approx(true, rel=0.15)


def test_what_is_stated_stays_but_for_a_factor() -> None:
    recording = field(3, LAWS["lidar"], stated_m=0.05)
    optimum = solve(recording)
    before = prepare_space(recording, Config().slam.space).problem
    assert np.array_equal(optimum.smoother.problem.measured_root, before.measured_root)
    recording = replace(field(3, LAWS["lidar"]), sensors=(SpatialSensor(sigma_m=0.05),))
    optimum = solve(recording)
    assert optimum.smoother.problem.sigma_position_m == pytest.approx(0.05)


def test_beside_a_sensor_that_states_its_noise_another_is_learned() -> None:
    """Levels are those of what is stated, and of noise that is learned nothing is left for them."""
    recording = field(4, LAWS["constant"], LAWS["stereo"])
    seen = recording.detections
    stated = np.where((seen.sensor == 0)[:, None, None], 0.04**2 * np.eye(3), np.nan)
    optimum = solve(replace(recording, detections=replace(seen, covariance_sensor_m2=stated)))
    range_m, found = sigmas_of(optimum)
    for sensor, law in enumerate(("constant", "stereo")):
        some = (optimum.smoother.problem.sensor == sensor) & (range_m > 8.0) & (range_m < 12.0)
        true = np.median(np.column_stack(LAWS[law](range_m[some])), axis=0)
        assert np.median(found[some], axis=0) == pytest.approx(true, rel=0.15)


def test_usual_noise_stays_where_it_is_as_probable() -> None:
    space = Config().slam.space
    usual = lambda r: (space.sigma_m + space.sigma_across * r, space.sigma_m + space.sigma_along * r)  # noqa: E731
    recording = field(5, usual, n_frames=60, n_points=12, outliers=0.0)
    before = prepare_space(recording, space).problem
    assert np.array_equal(solve(recording).smoother.problem.measured_root, before.measured_root)


def test_noise_that_is_not_to_be_learned_is_not() -> None:
    recording = field(6, LAWS["constant"], n_frames=60)
    intake = prepare_space(recording, Config().slam.space, estimate_noise=False)
    start = first_places(intake.problem, intake.driven_pose)
    optimum = converge(intake.problem, start, start_noise(intake.problem.settings, driven=True))
    assert with_range_noise(optimum) is optimum


def test_few_detections_keep_the_shape_of_usual_noise() -> None:
    """Four detections of one range say how noisy it is, not how noise grows."""
    recording = field(7, LAWS["constant"], n_frames=150)
    intake = prepare_space(recording, Config().slam.space)
    start = first_places(intake.problem, intake.driven_pose)
    optimum = converge(intake.problem, start, start_noise(intake.problem.settings, driven=True))
    found = learn_range_noise(optimum)
    range_m = np.linalg.norm(intake.problem.measured[:, :3], axis=1)
    many = found[np.argmax(range_m), 1] / found[np.argmin(range_m), 1]
    assert many < 2.0  # 0.4 m over 0.02 m by usual noise


@pytest.mark.slow
def test_lengths_are_not_too_short_by_noise_that_grows() -> None:
    """By measured ranges, what is measured too short counts for more: 3 % of all lengths in this world."""
    recording = field(8, lambda r: (0.002 * r, 0.008 * r**2), outliers=0.0, drift=0.05)
    result = run_slam(recording, prior_map=None)
    true, found = recording.true_landmarks, result.landmarks
    assert true is not None
    near = np.linalg.norm(true.position_m - (10.0, 7.0, 1.0), axis=1) < 12.0
    both = np.intersect1d(true.landmark_id[near], found.landmark_id)
    way = [of.position_m[np.searchsorted(of.landmark_id, both)] for of in (found, true)]
    spread = [np.linalg.norm(one - one.mean(axis=0), axis=1).sum() for one in way]
    assert spread[0] / spread[1] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("law", "in_map"),
    [
        *(
            pytest.param(law, in_map, marks=pytest.mark.slow)
            for law in ("constant", "stereo")
            for in_map in (False, True)
        ),
    ],
)
def test_a_sensor_without_a_data_sheet_is_no_suspect(law: str, in_map: bool) -> None:
    """With one level: errors of odometry alternate, or detections are noisier than sensors are."""
    recording = field(9, LAWS[law], n_frames=400)
    assert recording.true_landmarks is not None
    prior = recording.true_landmarks.as_prior(0.01) if in_map else None
    result = run_slam(recording, prior_map=prior)
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SOUND, result.verdict.message
    found = compare_with_truth(recording, result)
    assert found.poses is not None
    assert found.poses.rmse_m < 0.02
