"""SLAM among traffic: KITTI's tracking sequences with their odometry, and with an odometry that is made worse.

There is no truth of the car's way: the odometry as it is (stereo, ORB-SLAM3) is the reference. Its metre is 3 % longer
than that of boxes and labels, in every sequence alike, which nobody can tell from one recording of a worse odometry.
So the worse one is solved twice: as it is, and with the factor that the first sequences say.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evermap.cli.warmup import warm_up
from evermap.config import Config, TrackConfig
from evermap.geometry import se3
from evermap.geometry.rigid import rigid
from evermap.io import read_recording
from evermap.pipeline import run_slam
from evermap.slam.space.moving import has_traffic
from evermap.tracking.detections import read_input
from evermap.tracking.run import run_track
from evermap.types import UNKNOWN, FloatArray, SlamResult, SpatialOdometry, SpatialRecording

CALIBRATED_ON = ("0000", "0003", "0005", "0009", "0017")
"""Sequences that the factor on ranges is taken from, with the odometry as it is."""
SCALE, BEND_RADPM, WHITE_M, WHITE_RAD = 1.02, np.radians(0.02), 0.01, 0.001
"""By which the odometry is made worse: its way, its turn by the metre, and noise of every step."""
MOVES_MPS, LEAST_S, NEAR_M = 0.5, 2.0, 1.5


def worse(odometry: SpatialOdometry, seed: int = 1) -> SpatialOdometry:
    """Return an odometry that drifts."""
    rng = np.random.default_rng(seed)
    step = se3.between(odometry.pose_world_robot[:-1], odometry.pose_world_robot[1:])
    step[:, :3] *= SCALE
    off = np.column_stack(
        [rng.normal(0.0, sigma, (len(step), 3)) for sigma in (WHITE_M, WHITE_RAD)]
    )  # fmt: skip
    off[:, 5] += BEND_RADPM * np.linalg.norm(step[:, :3], axis=1)
    found = [se3.identity()]
    for one in se3.retract(step, off):
        found.append(se3.compose(found[-1], one))
    return replace(odometry, pose_world_robot=np.array(found))


def off_m(recording: SpatialRecording, stamp_s: FloatArray, pose: FloatArray) -> float:
    """Position error [m] after alignment, from the odometry as it is."""
    assert recording.odometry is not None
    rows = np.searchsorted(recording.odometry.stamp_s, stamp_s - 1e-4)
    there = recording.odometry.pose_world_robot[rows, :3]
    gap = se3.transform(rigid(pose[:, :3], there), pose[:, :3]) - there
    return float(np.sqrt((gap**2).sum(axis=1).mean()))


def solved(recording: SpatialRecording, range_scale: float | None) -> tuple[SlamResult, float]:
    """The result, and CPU milliseconds a frame."""
    began = time.process_time()
    result = run_slam(recording, Config(slam={"space": {"range_scale": range_scale}}))
    return result, 1e3 * (time.process_time() - began) / len(result.trajectory)


def all_stand(folder: Path, recording: SpatialRecording, range_scale: float) -> SpatialRecording:
    """The recording with every track as a landmark."""
    ids = run_track(read_input(folder), TrackConfig()).track_of_detection
    given = recording.detections
    return replace(
        recording,
        detections=replace(
            given,
            landmark_id=ids,
            position_sensor_m=range_scale * given.position_sensor_m,
            rotation=np.full_like(given.rotation, np.nan),
        ),
    )


def parked_or_moving(recording: SpatialRecording, result: SlamResult, labels: Any, range_scale: float) -> list[int]:
    """Labelled tracks longer than two seconds that are followed: how many are decided right, all, and not followed.

    A label moves if its way from first to last is faster than half a metre a second, in the world of the odometry as
    it is, with ranges by a factor.
    """
    followed, given = result.followed, recording.detections
    p_static = dict(zip(followed.tracks.track_id.tolist(), followed.p_static.tolist(), strict=True))
    stamp_s = recording.frames.stamp_s[given.frame]
    c = labels.columns
    at = np.stack([c["x_m"], c["y_m"], c["z_m"]], axis=1)
    assert recording.odometry is not None
    pose = se3.interpolate(recording.odometry.stamp_s, recording.odometry.pose_world_robot, c["stamp_s"])
    world = se3.transform(pose, range_scale * at)
    right = everything = lost = 0
    for one in np.unique(c["track_id"][c["track_id"] >= 0]):
        mine = np.flatnonzero(c["track_id"] == one)
        lasted_s = c["stamp_s"][mine[-1]] - c["stamp_s"][mine[0]]
        if lasted_s <= LEAST_S:
            continue
        near = (np.abs(stamp_s[None] - c["stamp_s"][mine, None]) < 0.05) & (
            np.linalg.norm(given.position_sensor_m[None, :, :2] - at[mine, None, :2], axis=2) < NEAR_M
        )
        votes = followed.track_of_detection[np.nonzero(near)[1]]
        votes = votes[votes != UNKNOWN]
        p = p_static.get(int(np.bincount(votes).argmax()), np.nan) if len(votes) else np.nan
        if np.isnan(p):
            lost += 1
            continue
        moves = np.linalg.norm(world[mine[-1], :2] - world[mine[0], :2]) / lasted_s > MOVES_MPS
        right, everything = right + int((p < 0.5) == moves), everything + 1
    return [right, everything, lost]


def run(folder: Path, read_labels: Any, only: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Return a row a sequence.

    Args:
        folder: with a folder for each.
        read_labels: reads a table of labels.
        only: names of some.
    """
    places = [place for place in sorted(folder.glob("[0-9]*")) if only is None or place.name in only]
    rows: list[dict[str, Any]] = []
    warm_up(in_space=True, traffic=True)
    recordings = {place.name: read_recording(place) for place in places}
    recordings = {name: one for name, one in recordings.items() if has_traffic(one)}
    for name, one in recordings.items():
        result, cpu_ms = solved(one, None)
        scale = next((p for p in result.parameters if p.name == "range_scale"), None)
        stamp_s = result.trajectory.stamp_s
        rows.append(
            {
                "sequence": name,
                "as_is_m": off_m(one, stamp_s, result.trajectory.pose_world_robot),
                "range_scale": None if scale is None else scale.value,
                "range_scale_sigma": None if scale is None else scale.sigma,
                "landmarks": len(result.landmarks),
                "cpu_ms": cpu_ms,
                "labels": read_labels(folder / name / "labels.csv.gz"),
                "result": result,
            }
        )
    factor = _factor(rows)
    for row in rows:
        one, labels, result = recordings[row["sequence"]], row.pop("labels"), row.pop("result")
        row["parked_or_moving"] = {
            "reference": parked_or_moving(one, result, labels, 1.0),
            "ranges": parked_or_moving(one, result, labels, factor),
        }
        drifting = replace(one, odometry=worse(one.odometry))  # type: ignore[arg-type]
        stamp_s = result.trajectory.stamp_s
        alone = se3.interpolate(drifting.odometry.stamp_s, drifting.odometry.pose_world_robot, stamp_s)
        row |= {"factor": factor, "odometry_m": off_m(one, stamp_s, alone)}
        for key, known in (("ours_m", None), ("calibrated_m", factor)):
            found = solved(drifting, known)[0].trajectory
            row[key] = off_m(one, found.stamp_s, found.pose_world_robot)
        found = run_slam(all_stand(folder / row["sequence"], drifting, factor)).trajectory
        row["all_stand_m"] = off_m(one, found.stamp_s, found.pose_world_robot)
    return rows


def _factor(rows: list[dict[str, Any]]) -> float:
    """The factor on ranges that the first sequences say, by their deviations."""
    known = [row for row in rows if row["sequence"] in CALIBRATED_ON and row["range_scale"] is not None]
    weight = np.array([row["range_scale_sigma"] ** -2.0 for row in known])
    return float(weight @ np.array([row["range_scale"] for row in known]) / weight.sum()) if known else 1.0


def decided(rows: list[dict[str, Any]], by: str) -> tuple[int, int]:
    """Tracks decided right, and all that are followed."""
    counts = np.array([row["parked_or_moving"][by] for row in rows])
    return int(counts[:, 0].sum()), int(counts[:, 1].sum())


def as_markdown(rows: list[dict[str, Any]]) -> str:
    """A row a sequence, then parked or moving."""
    columns = ("odometry_m", "ours_m", "calibrated_m", "all_stand_m", "as_is_m")
    head = (
        "sequence", "worse odometry alone [m]", "evermap", "evermap, factor on ranges known", "all tracks as landmarks",
        "odometry as it is: evermap", "factor on ranges", "landmarks", "ms a frame",
    )  # fmt: skip
    lines = [
        f"| {' | '.join(head)} |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        cells = [f"{row[key]:.2f}" for key in columns]
        scale = "–" if row["range_scale"] is None else f"{row['range_scale']:.4f} ± {row['range_scale_sigma']:.4f}"
        name = row["sequence"] + (" \\*" if row["sequence"] in CALIBRATED_ON else "")
        lines.append(f"| {name} | {' | '.join(cells)} | {scale} | {row['landmarks']} | {row['cpu_ms']:.1f} |")
    told = {by: decided(rows, by) for by in ("ranges", "reference")}
    share = {by: f"{100.0 * right / max(n, 1):.1f} % ({right} of {n})" for by, (right, n) in told.items()}
    lost = sum(row["parked_or_moving"]["ranges"][2] for row in rows)
    factor = f"Factor on ranges by the sequences with an asterisk: {rows[0]['factor']:.4f}."
    parked = f"Parked or moving right: {share['ranges']} with labels in the odometry's metre, {share['reference']} with"
    return "\n".join(
        [*lines, "", factor, f"{parked} labels as they are; {lost} labelled tracks without a track."]
    )  # fmt: skip


def claims(rows: list[dict[str, Any]]) -> list[tuple[str, str, str, bool]]:
    """Return what was expected: name, expectation, what was measured, whether that is met."""
    found = []
    for key, name in (("ours_m", "sequences where a worse odometry's error is halved"),
                      ("calibrated_m", "the same, with the factor on ranges known")):  # fmt: skip
        halved = sum(row[key] <= 0.5 * row["odometry_m"] for row in rows)
        found.append((name, f"≥ {len(rows)}", str(halved), halved == len(rows)))
    kept = max(row["as_is_m"] for row in rows)
    found.append(("odometry as it is, most that is changed [m]", "≤ 0.15", f"{kept:.2f}", kept <= 0.15))
    for by, name in (("reference", "parked or moving right, share of labelled tracks"),
                     ("ranges", "the same, with labels in the odometry's metre")):  # fmt: skip
        right, n = decided(rows, by)
        found.append((name, "≥ 0.97", f"{right / n:.3f}", right >= 0.97 * n))
    spent = max(row["cpu_ms"] for row in rows)
    found.append(("CPU time of a frame of SLAM, the slowest sequence [ms]", "≤ 10", f"{spent:.1f}", spent <= 10.0))
    return found
