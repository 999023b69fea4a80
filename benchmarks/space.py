"""SLAM in space on recordings of tags and objects, beside gtsam and beside the odometry alone.

gtsam gets the same odometry and the tags' centres as ranges and bearings, with Huber's loss, and no more: no corners,
no orientations. The references of the recordings are used for scores only.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import evermap as em
from evermap.errors import InputError
from evermap.geometry import se3
from evermap.geometry.rigid import rigid
from evermap.io import read_recording
from evermap.maps.living import LivingMap
from evermap.metrics.summary import compare_with_truth
from evermap.types import ChangeKind, FloatArray, Landmarks, SlamResult, SpatialRecording, Trajectory

FOLDER = Path(__file__).resolve().parents[1].parent / "shared" / "data"
TAGS = ("test_9", "test_10", "test_11")
METRICS: dict[str, tuple[str, float, str]] = {
    "space_tags_error_ratio": ("lower", 0.1, "position error on tagslam test_11 over gtsam with the tags' centres"),
    "space_objects_error_ratio": ("lower", 0.1, "median over ycbv of the camera's error over that of its odometry"),
    "space_places_error_ratio": ("lower", 0.2, "median over ycbv of the worst object's error over single detections'"),
}
RATE_HZ = 20.0
SIGMA_STEP, SIGMA_TURN = 0.05, 0.02
SIGMA_RAD, SIGMA_RANGE = 0.02, 0.1
SIGMA_SURVEY = 0.02


def run(folder: Path = FOLDER) -> tuple[dict[str, float], dict[str, Any]]:
    """Estimate and score all recordings.

    Raises:
        InputError: the recordings are not there.
    """
    if not (folder / "tagslam").is_dir():
        raise InputError("has no recordings of tags", path=folder, hint="tagslam/test_11 and others")
    shown: dict[str, Any] = {"tags": [], "changes": {}, "days": _days(folder), "objects": []}
    shown["tags"].append(_tags(folder, "test_11", mapped=False))
    for name in TAGS:
        shown["tags"].append(_tags(folder, name, mapped=True, changes=shown["changes"]))
    for place in sorted((folder / "ycbv").glob("0*")):
        shown["objects"].append(_objects(place))
    first = shown["tags"][0]
    ratios = {
        "space_tags_error_ratio": first["rmse_m"] / first["gtsam_m"],
        "space_objects_error_ratio": _typical(shown["objects"], "rmse_m", "odometry_m"),
        "space_places_error_ratio": _typical(shown["objects"], "object_m", "single_m"),
    }
    return ratios, shown


def _typical(rows: list[dict[str, Any]], name: str, over: str) -> float:
    """Median of a ratio."""
    return float(np.median([row[name] / row[over] for row in rows]))


def _tags(folder: Path, name: str, *, mapped: bool, changes: dict[str, Any] | None = None) -> dict[str, Any]:
    recording = read_recording(folder / "tagslam" / name)
    assert isinstance(recording, SpatialRecording)
    survey = recording.true_landmarks
    assert survey is not None
    known = survey.as_prior(SIGMA_SURVEY) if mapped else None
    em.run_slam(recording, prior_map=known)  # kernels are compiled, files are in memory
    began = time.process_time()
    result = em.run_slam(recording, prior_map=known)
    cpu_s = time.process_time() - began
    if changes is not None:
        changes[name] = [
            [result.landmarks.names.get(c.landmark_ids[0], str(c.landmark_ids[0])), [*c.displacement_m], c.probability]
            for c in result.changes
        ]
    found = compare_with_truth(recording, result, rate_hz=RATE_HZ)
    assert found.poses is not None
    alone = found.dead_reckoning
    return {
        "name": f"{name}, {'beside its survey' if mapped else 'unknown map'}",
        "rmse_m": _rms(found.poses.position_error_m),
        "median_m": float(np.median(found.poses.position_error_m)),
        "odometry_m": None if alone is None else _rms(alone.position_error_m),
        "gtsam_m": None if mapped or recording.odometry is None else _by_gtsam(recording),
        "tags_m": _to_survey(result.landmarks, survey),
        "cpu_s": cpu_s,
        "lasted_s": float(np.ptp(recording.frames.stamp_s)),
    }


def _days(folder: Path) -> list[dict[str, Any]]:
    """The three days as sessions of one living map, which begins with the survey of the first."""
    living, surveys, rows = None, [], []
    for name in TAGS:
        recording = read_recording(folder / "tagslam" / name)
        assert isinstance(recording, SpatialRecording)
        assert recording.true_landmarks is not None
        surveys.append(recording.true_landmarks)
        if living is None:
            living = replace(LivingMap.begun(surveys[0].as_prior(SIGMA_SURVEY)), clock=recording.clock)
        began = time.process_time()
        session = em.run_session(recording, living, em.Config(living={"accept": "any"}))
        cpu_s = time.process_time() - began
        found = compare_with_truth(recording, session.slam, rate_hz=RATE_HZ)
        assert found.poses is not None
        told = []
        for change in session.changes:
            tag = change.landmark_ids[0]
            at = [
                survey.position_m[survey.landmark_id == tag] for survey in (surveys[max(len(rows) - 1, 0)], surveys[-1])
            ]
            by = float(np.linalg.norm(at[1][0] - at[0][0])) if all(map(len, at)) else None
            away = float(np.linalg.norm(change.displacement_m)) if change.kind is ChangeKind.MOVED else None
            told.append([session.living.label(tag), change.kind.value, away, change.probability, by])
        rows.append(
            {
                "name": name,
                "found": session.found,
                "rmse_m": _rms(found.poses.position_error_m),
                "median_m": float(np.median(found.poses.position_error_m)),
                "tags": [len(living.members), len(session.living.members)],
                "changes": told,
                "cpu_s": cpu_s,
            }
        )
        living = session.living
    return rows


def _rms(error: FloatArray) -> float:
    return float(np.sqrt(np.mean(error**2)))


def _to_survey(found: Landmarks, survey: Landmarks) -> float:
    """Median distance of tags to where they were surveyed, aligned to what most agree on."""
    _, ours, theirs = np.intersect1d(found.landmark_id, survey.landmark_id, return_indices=True)
    a, b = found.position_m[ours], survey.position_m[theirs]
    weight = np.ones(len(a))
    for _ in range(30):  # least absolute distances: tags that were moved do not count for more
        gap = np.linalg.norm(se3.transform(rigid(a, b, weight), a) - b, axis=1)
        weight = 1.0 / np.maximum(gap, 0.01)
    return float(np.median(gap))


def _objects(place: Path) -> dict[str, Any]:
    recording = read_recording(place)
    assert isinstance(recording, SpatialRecording)
    began = time.process_time()
    result = em.run_slam(recording)
    cpu_s = time.process_time() - began
    found = compare_with_truth(recording, result, rate_hz=RATE_HZ)
    assert found.poses is not None
    assert found.dead_reckoning is not None
    ours, single = _object_errors(recording, result)
    return {
        "name": place.name,
        "rmse_m": _rms(found.poses.position_error_m),
        "odometry_m": _rms(found.dead_reckoning.position_error_m),
        "object_m": ours,
        "single_m": single,
        "cpu_s": cpu_s,
    }


def _object_errors(recording: SpatialRecording, result: SlamResult) -> tuple[float, float]:
    """Median error of objects in the camera, by the map and of single detections, worst object."""
    truth, survey, seen = recording.truth, recording.true_landmarks, recording.detections
    assert truth is not None
    assert survey is not None
    rows = np.clip(np.searchsorted(truth.stamp_s, result.trajectory.stamp_s - 1e-3), 0, len(truth) - 1)
    ours, single = [], []
    for k, identity in enumerate(survey.landmark_id):
        inside = _inside(truth, survey.position_m[k])
        place = np.flatnonzero(result.landmarks.landmark_id == identity)
        if len(place):
            at = result.landmarks.position_m[place[0]]
            gap = se3.transform(se3.inverse(result.trajectory.pose_world_robot), at) - inside[rows]
            ours.append(float(np.median(np.linalg.norm(gap, axis=1))))
        mine = np.flatnonzero(seen.landmark_id == identity)
        stamps = recording.frames.stamp_s[seen.frame[mine]]
        at_truth = np.clip(np.searchsorted(truth.stamp_s, stamps - 1e-3), 0, len(truth) - 1)
        gap = seen.position_sensor_m[mine] - inside[at_truth]
        single.append(float(np.nanmedian(np.linalg.norm(gap, axis=1))))
    return max(ours), max(single)


def _inside(truth: Trajectory, at: FloatArray) -> FloatArray:
    """A point of the world in the camera, by the true poses."""
    return se3.transform(se3.inverse(truth.pose_world_robot), at)


def _by_gtsam(recording: SpatialRecording) -> float:
    """Position error of gtsam's optimum with the odometry and the tags' centres."""
    import gtsam

    odometry, seen = recording.odometry, recording.detections
    assert odometry is not None
    stamps = recording.frames.stamp_s
    rows = np.clip(np.searchsorted(odometry.stamp_s, stamps), 0, len(odometry) - 1)
    pose = se3.between(odometry.pose_world_robot[rows[0]], odometry.pose_world_robot[rows])
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, _pose3(pose[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    steps = se3.between(pose[:-1], pose[1:])
    for k, step in enumerate(steps):
        root = np.sqrt(max(stamps[k + 1] - stamps[k], 1e-3))
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([SIGMA_TURN * root, SIGMA_STEP * root], 3))
        graph.add(gtsam.BetweenFactorPose3(k, k + 1, _pose3(step), noise))
    plain = gtsam.noiseModel.Diagonal.Sigmas(np.array([SIGMA_RAD, SIGMA_RAD, SIGMA_RANGE]))
    huber = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(1.345), plain)
    mount = np.array([sensor.mount_robot_sensor for sensor in recording.sensors])
    local = se3.transform(mount[seen.sensor], seen.position_sensor_m)
    known: set[int] = set()
    for m in range(len(seen)):
        key = 10**6 + int(seen.landmark_id[m])
        if key not in known:
            known.add(key)
            start.insert(key, se3.transform(pose[seen.frame[m]], local[m]))
        bearing = gtsam.Unit3(local[m])
        graph.add(gtsam.BearingRangeFactor3D(int(seen.frame[m]), key, bearing, float(np.linalg.norm(local[m])), huber))
    for k in range(len(pose)):
        start.insert(k, _pose3(pose[k]))
    found = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    at = np.array([found.atPose3(k).translation() for k in range(len(pose))])
    truth = recording.truth
    assert truth is not None
    near = np.clip(np.searchsorted(truth.stamp_s, stamps - 1e-3), 0, len(truth) - 1)
    some = np.abs(truth.stamp_s[near] - stamps) < 0.01
    target = truth.pose_world_robot[near[some], :3]
    return _rms(np.linalg.norm(se3.transform(rigid(at[some], target), at[some]) - target, axis=1))


def _pose3(pose: FloatArray) -> Any:
    import gtsam

    x, y, z, w = pose[3:]
    return gtsam.Pose3(gtsam.Rot3(w, x, y, z), pose[:3])


def claims(shown: dict[str, Any]) -> list[str]:
    """What was expected of the recordings."""
    first, objects = shown["tags"][0], shown["objects"]
    camera, thing = _typical(objects, "rmse_m", "odometry_m"), _typical(objects, "object_m", "single_m")
    rows = [
        ("position error on tagslam test_11, unknown map [m]", 0.10, first["rmse_m"]),
        ("median distance of its tags to the survey [m]", 0.04, first["tags_m"]),
        ("ycbv: camera error over that of its odometry, median of sequences", 0.7, camera),
        ("ycbv: error of the worst object over that of a single detection, median", 0.5, thing),
    ]
    lines = ["|  | expected | measured | met |", "| --- | ---: | ---: | ---: |"]
    for name, bound, value in rows:
        lines.append(f"| {name} | ≤ {bound:g} | {value:.3f} | {'yes' if value <= bound else '**no**'} |")
    return lines


def as_markdown(shown: dict[str, Any]) -> str:
    """Tables of tags, of what is told to have moved, and of objects."""
    lines = [
        "| recording | error, RMSE | median | odometry alone | gtsam, centres | tags to the survey | CPU of its time |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for row in shown["tags"]:
        cells = [row[key] for key in ("rmse_m", "median_m", "odometry_m", "gtsam_m", "tags_m")]
        text = " | ".join("–" if v is None else f"{v:.3f} m" for v in cells)
        lines.append(f"| {row['name']} | {text} | {100.0 * row['cpu_s'] / row['lasted_s']:.1f} % |")
    lines += ["", "| session | tags told to stand elsewhere than surveyed, by how much, and how surely |", "|---|---|"]
    for name, changes in shown["changes"].items():
        told = "; ".join(f"{tag} by {np.linalg.norm(by):.2f} m ({100.0 * p:.0f} %)" for tag, by, p in changes)
        lines.append(f"| {name} | {told or 'none'} |")
    lines += ["", "| day of one living map | error, RMSE | median | tags before, after | told | CPU |"]
    lines += ["|---|---:|---:|---:|---|---:|"]
    for row in shown["days"]:
        told = "; ".join(
            f"{tag} {kind}{'' if by is None else f' by {by:.2f} m'} ({100.0 * p:.0f} %"
            + (f", by the surveys {was:.2f} m)" if was else ")")
            for tag, kind, by, p, was in row["changes"]
        )
        sizes = "{}, {}".format(*row["tags"])
        error = f"{row['rmse_m']:.3f} m | {row['median_m']:.3f} m" if row["found"] else "**not located** | –"
        lines.append(f"| {row['name']} | {error} | {sizes} | {told or 'none'} | {row['cpu_s']:.0f} s |")
    lines += [
        "",
        "| objects | camera, RMSE | odometry alone | worst object, median | single detection, median | CPU |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for row in shown["objects"]:
        text = " | ".join(f"{row[key]:.4f} m" for key in ("rmse_m", "odometry_m", "object_m", "single_m"))
        lines.append(f"| {row['name']} | {text} | {row['cpu_s']:.1f} s |")
    return "\n".join(lines)


def write(shown: dict[str, Any], folder: Path) -> None:
    """Write `table.md` into a folder, from which `docs/gen/results.py` takes it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "table.md").write_text("\n".join(claims(shown)) + "\n\n" + as_markdown(shown) + "\n", encoding="utf-8")
