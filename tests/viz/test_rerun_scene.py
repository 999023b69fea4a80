"""The rerun scene, read back with rerun's own reader."""

import dataclasses
import sys

import numpy as np
import pytest

from evermap.errors import MissingExtraError
from evermap.geometry import se2
from evermap.types import Clock, Landmarks, Trajectory
from evermap.viz.rerun_scene import write_scene
from evermap.viz.style import class_looks

NANOSECONDS = 1e-9


@pytest.fixture(scope="module")
def chunks(run, evaluation, tmp_path_factory):
    reader = pytest.importorskip("rerun.chunk")
    path = write_scene(*run, tmp_path_factory.mktemp("scene") / "scene.rrd", evaluation=evaluation)
    out = {}
    for chunk in reader.RrdReader(str(path)).stream():
        out.setdefault(chunk.entity_path, []).append(chunk)
    return out


def column(chunks, entity, name):
    """(stamps, values) of one component, in order of time."""
    stamps, values = [], []
    for chunk in chunks[entity]:
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        if name not in batch.schema.names:
            continue
        stamps += batch.column("stamp_s").cast("int64").to_pylist()
        values += batch.column(name).to_pylist()
    order = np.argsort(stamps, kind="stable")
    return np.array(stamps)[order] * NANOSECONDS, [values[i] for i in order]


def test_the_robot_drives_the_aligned_trajectory(chunks, run, evaluation):
    stamps, places = column(chunks, "/world/robot", "Transform3D:translation")
    trajectory = run[1].trajectory
    assert stamps[[0, -1]] == pytest.approx(trajectory.stamp_s[[0, -1]], abs=1e-6)
    rows = np.searchsorted(trajectory.stamp_s, stamps - 1e-6)
    expected = se2.compose(evaluation.poses.pose_truth_estimate, trajectory.pose_world_robot[rows])
    np.testing.assert_allclose(np.array(places)[:, 0, :2], expected[:, :2], atol=1e-5)


def test_every_frame_has_its_own_rays_and_empty_frames_none(chunks, run):
    recording, _ = run
    stamps, rays = column(chunks, "/world/detections", "LineStrips3D:strips")
    counts = np.bincount(recording.detections.frame, minlength=len(recording.frames))
    rows = np.searchsorted(recording.frames.stamp_s, stamps - 1e-6)
    np.testing.assert_array_equal([len(ray) for ray in rays], counts[rows])
    assert min(counts) == 0


def test_rays_end_where_the_detection_puts_its_landmark(chunks, run):
    recording, _ = run
    stamps, rays = column(chunks, "/world/detections", "LineStrips3D:strips")
    rows = np.searchsorted(recording.frames.stamp_s, stamps - 1e-6)
    survey = dict(zip(recording.true_landmarks.landmark_id, recording.true_landmarks.position_m, strict=True))
    misses = []
    for row, strips in zip(rows, rays, strict=True):
        ids = recording.detections.landmark_id[recording.detections.frame == row]
        misses += [np.linalg.norm(np.array(s)[-1, :2] - survey[i]) for s, i in zip(strips, ids, strict=True)]
    assert np.median(misses) < 0.12


def test_landmarks_appear_when_first_seen(chunks, run):
    landmarks = run[1].landmarks
    for name, first_s in zip(landmarks.landmark_id, landmarks.first_seen_s, strict=True):
        stamps, _ = column(chunks, f"/world/landmarks/{name}", "Points3D:positions")
        assert stamps == pytest.approx([first_s], abs=1e-6)


def test_numbers_are_those_of_the_run(chunks, run):
    stamps, values = column(chunks, "/latency/step_ms", "Scalars:scalars")
    rows = np.searchsorted(run[0].frames.stamp_s, stamps - 1e-6)
    np.testing.assert_allclose(np.ravel(values), 1e3 * run[1].step_s[rows])
    assert "/nis/detection" in chunks
    assert "/error/position_m" in chunks


def test_large_maps_and_empty_runs_are_written(run, tmp_path):
    pytest.importorskip("rerun")
    recording, result = run
    rng = np.random.default_rng(0)
    large = Landmarks.at(np.arange(2000), rng.uniform(-9, 9, (2000, 2)), sigma_m=0.1)
    path = write_scene(recording, dataclasses.replace(result, landmarks=large), tmp_path / "large.rrd")
    assert path.stat().st_size < 6e6
    empty = Trajectory(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    nothing = dataclasses.replace(
        result,
        trajectory=empty,
        dead_reckoning=empty,
        online=empty,
        step_s=np.zeros(0),
        landmarks=Landmarks.at([], np.zeros((0, 2))),
    )
    write_scene(recording, nothing, tmp_path / "empty.rrd")


def test_missing_rerun_is_said_in_one_line(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"evermap\[rerun\]"):
        write_scene(*run, tmp_path / "scene.rrd")
    assert not (tmp_path / "scene.rrd").exists()


def test_landmarks_have_the_colour_of_their_class_and_unix_stamps_are_dates(run, tmp_path):
    reader = pytest.importorskip("rerun.chunk")
    recording, result = run
    count = len(result.landmarks)
    classed = dataclasses.replace(
        result.landmarks,
        class_names=("post", "door"),
        class_id=np.arange(count) % 2,
        first_seen_s=np.full(count, 1.7e9),
    )
    path = write_scene(
        dataclasses.replace(recording, clock=Clock.UNIX), dataclasses.replace(result, landmarks=classed),
        tmp_path / "scene.rrd",
    )  # fmt: skip
    looks = class_looks(("post", "door"))
    entity = f"/world/landmarks/{int(classed.landmark_id[1])}"
    (chunk,) = [chunk for chunk in reader.RrdReader(str(path)).stream() if chunk.entity_path == entity]
    batch = chunk.to_record_batch()
    assert batch.column("Points3D:colors")[0].as_py() == [int(looks["door"].colour[1:] + "ff", 16)]
    assert batch.column("Points3D:labels")[0].as_py() == [f"{int(classed.landmark_id[1])} (door)"]
    assert "timestamp" in str(batch.schema.field("stamp_s").type)
    assert batch.column("stamp_s").cast("int64")[0].as_py() * NANOSECONDS == pytest.approx(1.7e9)
