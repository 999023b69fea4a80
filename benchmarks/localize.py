"""How long a step takes in a map that is not changed, whatever its size, and beside gtsam's iSAM2: CPU time, one core.

A robot drives in circles among landmarks of one density, of which a hundred are always in view; maps of different size
reach differently far. The peer is given the map as priors on the landmarks, and knows the calibration that evermap
estimates; it gets every detection without doubts and keeps all poses, as iSAM2 does.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from evermap.geometry import se2
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.known_places import KnownPlaces
from evermap.slam.localize import FrameSightings, Localizer
from evermap.slam.planar_filter import PlanarMotion
from evermap.slam.problem import Drive, Noise
from evermap.types import FloatArray, Sensor

SIZES = (100, 1_000, 10_000)
RACE = 1_000
IN_VIEW = 100
RANGE_M = 6.0
P_DETECT = 0.9
SIGMA_MAP_M = 0.03
CIRCLE_M = {100: 0.3, 1_000: 10.0, 10_000: 10.0}
"""Radius of the drive: a map of what is in view leaves no room for more."""
SPEED_MPS = 1.0
FRAME_S = 0.2
N_FRAMES = 250
WARM_UP = 20
"""Frames at the beginning that are not timed: the start pose is searched for."""
NOISE = Noise(detection=np.array([0.05, 0.02]), odometry=np.array([0.03, 0.02, 0.02, 0.01, 0.03]), outlier_log_odds=7.0)
SENSOR = Sensor(range_max_m=RANGE_M, p_detect=P_DETECT)
REPORTED = CalibrationPrior.from_settings(calibrated=False)

METRICS: dict[str, tuple[str, float, str]] = {
    "localize_speed_ratio": (
        "higher",
        0.4,
        f"steps a second in a map of {RACE:,} landmarks, {IN_VIEW} in view, over gtsam ISAM2",
    ),
    "localize_size_ratio": ("lower", 0.4, "time of a step in a map of 10,000 landmarks over that in one of 100"),
}
"""Metric: which direction is better, relative tolerance, meaning."""


@dataclass(frozen=True, slots=True)
class Drives:
    """A drive: F frames.

    Attributes:
        places: the map.
        pose: (F, 3) true poses.
        drive: odometry.
        stamp_s: (F,).
        sightings: one a frame.
    """

    places: KnownPlaces
    pose: FloatArray
    drive: Drive
    stamp_s: FloatArray
    sightings: list[FrameSightings]


@dataclass(frozen=True, slots=True)
class Answer:
    """(F, 3) causal poses, nan where there is none, and (F,) CPU seconds of each step."""

    pose: FloatArray
    cpu_s: FloatArray


def draw(n_landmarks: int, n_frames: int = N_FRAMES, seed: int = 0) -> Drives:
    """`n_landmarks` in a disc around the drive's middle; the inner ones are the same for all sizes."""
    where, rng = np.random.default_rng(seed), np.random.default_rng(seed + 1)
    away = RANGE_M * np.sqrt((np.arange(n_landmarks) + 0.5) / IN_VIEW)
    turn = where.uniform(-np.pi, np.pi, n_landmarks)
    landmark = np.column_stack([away * np.cos(turn), away * np.sin(turn)])
    radius = CIRCLE_M.get(n_landmarks, CIRCLE_M[RACE])
    velocity = np.array([SPEED_MPS, 0.0, SPEED_MPS / radius])
    stamp_s = FRAME_S * np.arange(n_frames)
    drive = Drive.from_rows(np.append(stamp_s, stamp_s[-1] + FRAME_S), np.tile(velocity, (n_frames + 1, 1)))
    pose, poses, sightings = np.array([radius, 0.0, 0.5 * np.pi]), [], []
    for k in range(n_frames):
        if k > 0:
            motion = PlanarMotion.over(drive, stamp_s[k - 1], stamp_s[k], REPORTED.mean, REPORTED.free, NOISE)
            slip = se2.exp(rng.multivariate_normal(np.zeros(3), motion.covariance))
            pose = se2.compose(se2.compose(pose, motion.increment), slip)
        poses.append(pose)
        seen = se2.transform(se2.inverse(pose), landmark)
        reading = np.column_stack([np.hypot(*seen.T), np.arctan2(seen[:, 1], seen[:, 0])])
        rows = np.flatnonzero((reading[:, 0] < RANGE_M) & (rng.random(n_landmarks) < P_DETECT))
        reading = reading[rows] + NOISE.detection * rng.normal(size=(len(rows), 2))
        sightings.append(FrameSightings(rows, reading, np.full((len(rows), 2), np.nan)))
    places = KnownPlaces.of(
        np.arange(n_landmarks),
        landmark + where.normal(0.0, SIGMA_MAP_M, landmark.shape),
        np.tile(SIGMA_MAP_M**2 * np.eye(2), (n_landmarks, 1, 1)),
        np.ones(n_landmarks),
    )
    return Drives(places, np.array(poses), drive, stamp_s, sightings)


def by_evermap(drives: Drives) -> Answer:
    """`Localizer`, calibration estimated too, from an unknown start."""
    localizer = Localizer(drives.places, SENSOR, CalibrationPrior.from_settings(calibrated=True), NOISE)
    pose, cpu_s = [], []
    for stamp_s, seen in zip(drives.stamp_s, drives.sightings, strict=True):
        began = time.process_time()
        pose.append(localizer.step(stamp_s, drives.drive, seen).pose)
        cpu_s.append(time.process_time() - began)
    return Answer(np.array(pose), np.array(cpu_s))


def by_gtsam(drives: Drives) -> Answer:
    """`gtsam.ISAM2` with a prior on every landmark that comes into view; told where it starts."""
    isam, known = gtsam.ISAM2(gtsam.ISAM2Params()), set[int]()
    sigmas = gtsam.noiseModel.Diagonal.Sigmas(NOISE.detection[::-1])
    held = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    survey = gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_MAP_M)
    pose, poses, cpu_s = gtsam.Pose2(*drives.pose[0]), [], []
    for k, seen in enumerate(drives.sightings):
        began = time.process_time()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if k == 0:
            graph.add(gtsam.PriorFactorPose2(_x(0), pose, held))
        else:
            motion = PlanarMotion.over(
                drives.drive, drives.stamp_s[k - 1], drives.stamp_s[k], REPORTED.mean, REPORTED.free, NOISE
            )
            step = gtsam.Pose2(*motion.increment)
            noise = gtsam.noiseModel.Gaussian.Covariance(motion.covariance)
            graph.add(gtsam.BetweenFactorPose2(_x(k - 1), _x(k), step, noise))
            pose = pose.compose(step)
        values.insert(_x(k), pose)
        for j, (range_m, bearing_rad) in zip(seen.landmark_id.tolist(), seen.reading.tolist(), strict=True):
            if j not in known:
                known.add(j)
                values.insert(_l(j), drives.places.position_m[j])
                graph.add(gtsam.PriorFactorPoint2(_l(j), drives.places.position_m[j], survey))
            graph.add(gtsam.BearingRangeFactor2D(_x(k), _l(j), gtsam.Rot2(bearing_rad), range_m, sigmas))
        isam.update(graph, values)
        pose = isam.calculateEstimatePose2(_x(k))
        cpu_s.append(time.process_time() - began)
        poses.append([pose.x(), pose.y(), pose.theta()])
    return Answer(np.array(poses), np.array(cpu_s))


def run(n_frames: int = N_FRAMES) -> tuple[dict[str, float], dict[str, Any]]:
    """The metrics; times [ms] and errors [m] of each map, and of the peer."""
    by_evermap(draw(IN_VIEW, WARM_UP))  # compiles
    by_gtsam(draw(IN_VIEW, WARM_UP))
    rows = []
    for size in SIZES:
        drives = draw(size, n_frames)
        rows.append(_row("evermap", drives, by_evermap(drives)))
        if size == RACE:
            rows.append(_row("gtsam ISAM2", drives, by_gtsam(drives)))
    ours = {row["size"]: row["median_ms"] for row in rows if row["who"] == "evermap"}
    theirs = next(row["median_ms"] for row in rows if row["who"] != "evermap")
    ratios = {"localize_speed_ratio": theirs / ours[RACE], "localize_size_ratio": ours[SIZES[-1]] / ours[SIZES[0]]}
    return ratios, {"rows": rows, "n_frames": n_frames}


def _row(who: str, drives: Drives, answer: Answer) -> dict[str, Any]:
    """Of the frames after the start."""
    ms = 1e3 * answer.cpu_s[WARM_UP:]
    off = np.linalg.norm((answer.pose - drives.pose)[WARM_UP:, :2], axis=1)
    return {
        "who": who,
        "size": len(drives.places),
        "seen": statistics.fmean(len(seen.landmark_id) for seen in drives.sightings),
        "median_ms": float(np.median(ms)),
        "p99_ms": float(np.quantile(ms, 0.99)),
        "start_ms": float(1e3 * answer.cpu_s[:WARM_UP].max()),
        "rmse_m": float(np.sqrt((off**2).mean())),
    }


def as_markdown(shown: dict[str, Any]) -> str:
    """A row for each map."""
    lines = [
        "| landmarks in the map | detected in a frame | estimator | step, median | 99 % below | at the start | RMSE |",
        "|---:|---:|---|---:|---:|---:|---:|",
    ]
    for row in shown["rows"]:
        times = " | ".join(f"{row[name]:.2f} ms" for name in ("median_ms", "p99_ms", "start_ms"))
        lines.append(f"| {row['size']:,} | {row['seen']:.0f} | {row['who']} | {times} | {100 * row['rmse_m']:.1f} cm |")
    return "\n".join(lines)


def _x(row: int) -> int:
    return int(gtsam.symbol("x", row))


def _l(row: int) -> int:
    return int(gtsam.symbol("l", row))
