"""Boxes without identity around a robot that drives: a made street, of which everything is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from streets import SIZE_M, Street, parks, street

from evermap.config import Config
from evermap.errors import ConfigError, DataError
from evermap.geometry import se3
from evermap.geometry.rigid import rigid
from evermap.pipeline import run_slam
from evermap.slam.space.drift import bent, gauge_of
from evermap.types import ChangeKind, FloatArray, Landmarks, SlamResult
from evermap.viz.rerun_scene import write_scene

BEND = np.radians(0.03)


def off(poses: FloatArray, truth: FloatArray) -> float:
    """Position error [m] after alignment."""
    onto = rigid(poses[:, :3], truth[:, :3])
    return float(np.sqrt(((se3.transform(onto, poses[:, :3]) - truth[:, :3]) ** 2).sum(axis=1).mean()))


def errors(made: Street, result: SlamResult) -> tuple[float, float]:
    """Position errors of the odometry and of the result."""
    assert made.recording.odometry is not None
    return off(made.recording.odometry.pose_world_robot, made.pose), off(result.trajectory.pose_world_robot, made.pose)


def nearest(landmarks: Landmarks, place: FloatArray) -> FloatArray:
    """Distance of each place (P, 2) to the nearest landmark."""
    return np.linalg.norm(place[:, None] - landmarks.position_m[None, :, :2], axis=2).min(axis=1)


@pytest.fixture(scope="module")
def usual() -> tuple[Street, SlamResult]:
    """A street with odometry that does not err."""
    made = street(1)
    return made, run_slam(made.recording)


def test_what_stands_is_a_landmark_and_what_moves_is_followed(usual: tuple[Street, SlamResult]) -> None:
    made, result = usual
    assert errors(made, result)[1] < 0.05
    assert len(result.landmarks) == len(made.parked)
    assert nearest(result.landmarks, made.parked[:, :2]).max() < 0.3
    assert result.landmarks.size_m is not None
    np.testing.assert_allclose(result.landmarks.size_m, np.tile(SIZE_M, (len(made.parked), 1)), rtol=0.05)
    assert result.landmarks.p_exists.min() > 0.8
    # the ids of landmarks are those of their tracks, and a detection has the id of what it is of
    followed = result.followed
    track, stands = followed.track_of_detection, made.of < len(made.parked)
    assert np.mean(np.isin(track[stands], result.landmarks.landmark_id)) > 0.95
    assert not np.isin(track[~stands], result.landmarks.landmark_id).any()
    p_static = {int(one): p for one, p in zip(followed.tracks.track_id, followed.p_static, strict=True)}
    assert min(p_static[one] for one in result.landmarks.landmark_id.tolist()) > 0.9
    assert max(p_static[one] for one in np.unique(track[~stands]).tolist() if one >= 0) < 0.1
    used = result.innovations
    assert (made.of[used.detection] < len(made.parked)).all()
    assert np.mean(track[used.detection] == used.landmark_id) > 0.95


def test_the_scene_shows_what_moves_frame_by_frame(usual: tuple[Street, SlamResult], tmp_path: Path) -> None:
    reader = pytest.importorskip("rerun.chunk")
    made, result = usual
    path = write_scene(made.recording, result, tmp_path / "scene.rrd")
    parts = [
        part.to_record_batch() for part in reader.RrdReader(str(path)).stream()
        if part.entity_path == "/world/moving" and not part.is_static
    ]  # fmt: skip
    centres, half = (
        [np.array(boxes or []).reshape(-1, 3) for part in parts for boxes in part.column(f"Boxes3D:{name}").to_pylist()]
        for name in ("centers", "half_sizes")
    )
    assert len(centres) == len(made.recording.frames)
    off_m = np.concatenate(
        [
            np.nanmin(np.linalg.norm(boxes[:, None, :2] - made.way[None, :, frame, :2], axis=2), axis=1)
            for frame, boxes in enumerate(centres)
        ]
    )
    assert len(off_m) > 0.6 * np.isfinite(made.way[..., 0]).sum()
    assert np.mean(off_m < 0.5) > 0.97  # a car that is out of view is predicted for a moment
    np.testing.assert_allclose(np.median(np.concatenate(half), axis=0), 0.5 * np.array(SIZE_M), rtol=0.05)


@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_bend_of_the_odometry_is_taken_off(seed: int) -> None:
    made = street(seed, bend=BEND)
    result = run_slam(made.recording)
    before, after = errors(made, result)
    assert after < 0.5 * before
    bend = next(one for one in result.parameters if one.name == "odometry_bend_radpm")
    assert abs(bend.value + BEND) < 4.0 * bend.sigma
    np.testing.assert_allclose(
        result.dead_reckoning.pose_world_robot[:, :3], made.recording.odometry.pose_world_robot[:, :3], atol=0.05
    )


def test_the_metre_is_that_of_the_odometry_unless_the_ranges_are_known() -> None:
    made = street(4, scale=1.05)
    result = run_slam(made.recording)
    parameters = {one.name: one for one in result.parameters}
    assert abs(parameters["range_scale"].value - 1.05) < 0.005
    before, after = errors(made, result)
    assert after == pytest.approx(before, 0.02)
    result = run_slam(made.recording, Config(slam={"space": {"range_scale": 1.0}}))
    before, after = errors(made, result)
    assert after < 0.2 * before
    parameters = {one.name: one for one in result.parameters}
    assert abs(parameters["odometry_scale"].value * 1.05 - 1.0) < 0.005


@pytest.mark.parametrize("seed", [5, pytest.param(6, marks=pytest.mark.slow)])
def test_good_odometry_stays_as_it_is(seed: int) -> None:
    made = street(seed, range_scale=0.97)
    assert errors(made, run_slam(made.recording))[1] < 0.05


def test_where_all_move_the_odometry_is_all_there_is() -> None:
    made = street(7, n_parked=0)
    result = run_slam(made.recording)
    assert len(result.landmarks) == 0
    assert errors(made, result)[1] < 1e-6
    assert len(result.followed.first_rows()) >= 3


def test_a_car_that_parks_in_view_is_a_change() -> None:
    at_s = 3.0
    made = street(8, seconds=12.0, n_parked=10, way=parks(120, at_s))
    result = run_slam(made.recording)
    appeared = [one for one in result.changes if one.kind is ChangeKind.APPEARED]
    assert len(result.changes) == len(appeared) == 1
    assert appeared[0].stamp_from_s - 0.5 < at_s < appeared[0].stamp_to_s + 1.0
    row = result.landmarks.landmark_id.tolist().index(appeared[0].landmark_ids[0])
    assert np.linalg.norm(result.landmarks.position_m[row, :2] - [60.0, 3.5]) < 0.3


def test_landmarks_with_identity_keep_it() -> None:
    made = street(9)
    given = made.recording.detections
    named = np.where(made.of == 0, 77, given.landmark_id)
    result = run_slam(replace(made.recording, detections=replace(given, landmark_id=named)))
    assert len(result.landmarks) == len(made.parked)
    row = result.landmarks.landmark_id.tolist().index(77)
    assert np.linalg.norm(result.landmarks.position_m[row, :2] - made.parked[0, :2]) < 0.3


def test_refused() -> None:
    made = street(10, seconds=5.0)
    with pytest.raises(ConfigError, match="cannot be found in a map"):
        run_slam(made.recording, prior_map=Landmarks.in_space([1], np.zeros((1, 3))))
    with pytest.raises(DataError, match="need `odometry`"):
        run_slam(replace(made.recording, odometry=None))


def test_the_gauge_is_the_optimum_of_least_squares() -> None:
    rng = np.random.default_rng(11)
    made = street(11, bend=BEND)
    pose = made.recording.odometry.pose_world_robot  # type: ignore[union-attr]
    stands = made.of < len(made.parked)
    given, thing = made.recording.detections, made.of[stands]
    frame = given.frame[stands]
    seen = given.position_sensor_m[stands] + rng.normal(0.0, 1e-3, (int(stands.sum()), 3))
    found = gauge_of(pose, 0.1 * frame, frame, seen, np.zeros_like(seen), thing)

    def residual(numbers: FloatArray) -> FloatArray:
        """Distances from the mean of each thing, along the bent path."""
        at = se3.transform(bent(pose, numbers[1])[frame], (1.0 + numbers[0]) * seen)[:, :2]
        sigma = 0.1 + 0.01 * np.linalg.norm(seen, axis=1)
        rows = []
        for one in np.unique(thing):
            mine = thing == one
            mean = np.average(at[mine], axis=0, weights=sigma[mine] ** -2.0)
            rows.append((at[mine] - mean) / sigma[mine, None])
        return np.concatenate(rows).ravel()

    best = least_squares(residual, np.zeros(2), x_scale=[0.01, 1e-4])
    assert abs(found.scale - best.x[0]) < 0.5 * found.scale_sigma + 1e-3
    assert abs(found.bend - best.x[1]) < 0.5 * found.bend_sigma + 2e-5
    assert abs(found.bend + BEND) < 4.0 * found.bend_sigma
