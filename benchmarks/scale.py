"""What a session costs as the world grows, beside plain gtsam in one process: time, memory, frames, objectives.

Warehouses of different size (`evermap_studies.sim.warehouse`) are driven through once. evermap gets the recording and
estimates calibration, noise, outliers and all covariances, through its public functions only; gtsam gets factors with
the true noise and solves them by Levenberg-Marquardt from two starts, with the marginals of all landmarks. Because the
two then minimise different things, evermap also solves the plain problem (`plain_config`), and an objective in numpy
(`evermap_studies.peers.factors`) is evaluated under its estimate and at the optimum that gtsam finds of the same.

Seconds are CPU time: what else runs on the machine costs no contender anything. Frames of a stream are in CPU time of
the thread that waits for them.

`python -m benchmarks.scale [LANDMARKS ...]` measures a whole session beside the peer's optimum alone, in turns, the
least of several: what else runs on the machine changes caches and clock rates, too.
"""

from __future__ import annotations

import argparse
import gzip
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import evermap as em
from benchmarks import memory
from evermap.config import NoiseConfig, SlamConfig
from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.types import FloatArray, Recording, SlamResult
from evermap_studies.peers import factors as plain
from evermap_studies.peers.factors import Factors, PlainEstimate, PlainNoise
from evermap_studies.sim import WarehouseConfig, simulate_warehouse

SIZES = (100, 200)
"""Landmarks by default: seconds of work. The baseline belongs to them."""
FULL_SIZES = (400, 1_000, 4_000)
"""What claims are made for."""
BESIDE_SIZES, BESIDE_TURNS = (100, 400, 800), 5
"""Landmarks of sessions beside the peer's optimum alone, and how often each is run."""
WARM_UP = 30
"""Landmarks of a session that is run before, so that nothing is compiled while the clock runs."""
STREAM_SIZE = 1_000
"""Landmarks in the session whose frames are timed, at most."""
STREAM_RANGE_M = 13.5
"""With it about ten landmarks are detected in a frame."""
STREAM_FROM = 50
"""Frames before the first that is timed: in these, estimators are still small."""
ISAM_UP_TO = 1_000
"""Landmarks up to which iSAM2 is run on the sessions too, which takes it far longer than the batch."""
MAPPED_UP_TO = 1_000
"""Landmarks up to which a session is entered into a map, too."""
BEST = 1e-10
"""Tolerance of the peer's optimum that objectives are compared with; not timed."""
DLR = Path(__file__).resolve().parents[2] / "shared" / "data" / "dlr"

METRICS: dict[str, tuple[str, float, str]] = {
    "scale_time_ratio": (
        "lower",
        0.3,
        f"CPU time of a session of {SIZES[-1]} landmarks, calibration and noise included, over gtsam LM and Marginals",
    ),
    "scale_exponent": ("lower", 0.3, f"exponent of its CPU time over landmarks, {SIZES[0]} to {SIZES[-1]}"),
    "scale_memory_ratio": ("lower", 0.3, f"memory that a session of {SIZES[-1]} landmarks adds, over gtsam"),
    "scale_objective_ratio": ("lower", 1e-4, "objective of the plain problem under evermap's estimate, over gtsam's"),
    "scale_frame_ratio": ("higher", 0.4, "speed of a frame in the stream, ten landmarks in view, over gtsam ISAM2"),
}
"""Metric: which direction is better, relative tolerance, meaning."""


@dataclass(frozen=True, slots=True)
class Drive:
    """A recording, its plain factors with their noise, and where solvers of those start."""

    recording: Recording
    noise: PlainNoise
    factors: Factors
    starts: dict[str, PlainEstimate]


@dataclass(frozen=True, slots=True)
class Spent:
    """What a call returned, and its seconds of wall and CPU time."""

    result: Any
    wall_s: float
    cpu_s: float


def warehouse_drive(config: WarehouseConfig | int) -> Drive:
    """Return the drive through a warehouse, with both starts."""
    if isinstance(config, int):
        config = WarehouseConfig(n_landmarks=config)
    recording = simulate_warehouse(config)
    detection = np.array([config.sigma_range_m, config.sigma_bearing_rad])
    noise = PlainNoise(detection, np.array(config.odometry_sigma))
    factors = plain.factors_of(recording, noise)
    starts = {"near": plain.near_start(factors, recording), "odometry": plain.dead_reckoned_start(factors)}
    return Drive(recording, noise, factors, starts)


def dlr_recording(folder: Path = DLR) -> Recording:
    """Read the DLR recording from its gzipped tables."""
    with tempfile.TemporaryDirectory() as temporary:
        for path in folder.iterdir():
            target = Path(temporary) / path.name.removesuffix(".gz")
            with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as packed, target.open("wb") as file:
                shutil.copyfileobj(packed, file)
        return em.read_recording(temporary)


def plain_config(noise: PlainNoise) -> em.Config:
    """Return settings under which evermap minimises the objective of the plain factors: every reading is believed as
    reported, with these noise levels.
    """
    names = ("forward_by_distance", "forward_by_turn", "sideways_by_distance", "turn_by_time", "turn_by_turn")
    levels = dict(zip(names, noise.odometry.tolist(), strict=True))
    sigma_range_m, sigma_bearing_rad = noise.detection.tolist()
    return em.Config(
        slam=SlamConfig(
            method="nohyp",
            sensor_model="plain",
            vote_ids=False,
            robust=False,
            estimate_noise=False,
            noise=NoiseConfig(sigma_range_m=sigma_range_m, sigma_bearing_rad=sigma_bearing_rad, **levels),
        )
    )


def spent(work: Callable[[], Any]) -> Spent:
    """Return what a call returns and takes."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return Spent(result, time.perf_counter() - wall, time.process_time() - cpu)


def estimate_of(slam: SlamResult, factors: Factors) -> PlainEstimate:
    """Return a result as an estimate of the factors' poses and landmarks, in the frame of the first pose."""
    row = np.searchsorted(slam.trajectory.stamp_s, factors.stamp_s - 1e-6)
    pose = slam.trajectory.pose_world_robot[row]
    landmark = slam.landmarks.position_m[np.searchsorted(slam.landmarks.landmark_id, factors.landmark_id)]
    return PlainEstimate(se2.between(pose[0], pose), se2.transform(se2.inverse(pose[0]), landmark))


def learned_noise(slam: SlamResult) -> PlainNoise:
    """Return the noise levels that a run has learned."""
    level = {item.name: item.value for item in slam.parameters}
    detection = [level["sigma_range_m"], level["sigma_bearing_rad"]]
    by = ("forward_per_sqrt_m", "forward_per_sqrt_rad", "lateral_per_sqrt_m", "turn_per_sqrt_s", "turn_per_sqrt_rad")
    return PlainNoise(np.array(detection), np.array([level[f"sigma_{name}"] for name in by]))


def exponent(size: Sequence[float], seconds: Sequence[float]) -> float:
    """Return `b` of `seconds = a size^b` by least squares of the logarithms."""
    return float(np.polyfit(np.log(size), np.log(seconds), 1)[0])


class Ticks:
    """Told after every frame, it notes the CPU time of the thread."""

    def __init__(self) -> None:
        self._at_s: list[float] = []

    def __call__(self, _done: float, _total: float) -> None:
        """Note the time; a `types.Progress`."""
        self._at_s.append(time.thread_time())

    @property
    def frame_s(self) -> FloatArray:
        """Return the seconds of every frame but the first."""
        return np.diff(self._at_s)


def by_evermap(drive: Drive) -> dict[str, Any]:
    """Measure one session by itself: calibration, noise, outliers, covariances and beliefs included."""
    done = spent(lambda: em.run_slam(drive.recording))
    landmarks = done.result.landmarks
    return {
        "wall_s": done.wall_s,
        "cpu_s": done.cpu_s,
        **_accuracy(landmarks.landmark_id, landmarks.position_m, drive.recording),
    }


def by_evermap_stream(drive: Drive) -> dict[str, Any]:
    """Measure the same, frame after frame."""
    ticks, config = Ticks(), em.Config(slam=SlamConfig(online=True))
    done = spent(lambda: em.run_slam(drive.recording, config, progress=ticks))
    landmarks = done.result.landmarks
    return {
        "wall_s": done.wall_s,
        "cpu_s": done.cpu_s,
        **_frames(ticks.frame_s),
        **_accuracy(landmarks.landmark_id, landmarks.position_m, drive.recording),
    }


def by_evermap_mapped(drive: Drive) -> dict[str, Any]:
    """Measure the same into a map that begins with it."""
    done = spent(lambda: em.run_session(drive.recording))
    return {"wall_s": done.wall_s, "cpu_s": done.cpu_s}


def by_evermap_plain(drive: Drive) -> dict[str, Any]:
    """Measure the plain problem, and its objective under what evermap finds."""
    done = spent(lambda: em.run_slam(drive.recording, plain_config(drive.noise)))
    estimate = estimate_of(done.result, drive.factors)
    return {
        "wall_s": done.wall_s,
        "cpu_s": done.cpu_s,
        "objective": _objective(drive, estimate),
        **_accuracy(drive.factors.landmark_id, estimate.landmark, drive.recording),
    }


def by_gtsam(drive: Drive, start: str) -> dict[str, Any]:
    """Measure Levenberg-Marquardt and all marginals of landmarks, without the time that the graph takes to build."""
    from evermap_studies.peers.plain_gtsam import levenberg_marquardt

    found = levenberg_marquardt(drive.factors, drive.starts[start])
    return {
        "build_s": found.build.wall_s,
        "solve_s": found.solve.wall_s,
        "marginals_s": found.marginals.wall_s,
        "wall_s": found.solve.wall_s + found.marginals.wall_s,
        "cpu_s": found.solve.cpu_s + found.marginals.cpu_s,
        "marginals_cpu_s": found.marginals.cpu_s,
        "iterations": found.n_iterations,
        "objective": _objective(drive, found.estimate),
        **_accuracy(drive.factors.landmark_id, found.estimate.landmark, drive.recording),
    }


def beside_optimum(n_landmarks: int, turns: int = BESIDE_TURNS) -> dict[str, float]:
    """Return the least CPU seconds of a session, and of the peer's optimum alone from each start, in turns."""
    from evermap_studies.peers.plain_gtsam import levenberg_marquardt

    drive, found = warehouse_drive(n_landmarks), dict[str, float]()
    for _ in range(turns):
        took = {"evermap": spent(lambda: em.run_slam(drive.recording)).cpu_s}
        for start, values in drive.starts.items():
            took[start] = levenberg_marquardt(drive.factors, values, marginals=False).solve.cpu_s
        found = {who: min(cpu_s, found.get(who, cpu_s)) for who, cpu_s in took.items()}
    return found


def by_isam2(drive: Drive) -> dict[str, Any]:
    """Measure iSAM2, frame after frame."""
    from evermap_studies.peers.plain_gtsam import isam2

    done = spent(lambda: isam2(drive.factors))
    return {
        "wall_s": done.wall_s,
        "cpu_s": done.cpu_s,
        "objective": _objective(drive, done.result.estimate),
        **_frames(done.result.step_s),
    }


def best_objective(drive: Drive, start: str = "near") -> float:
    """Return the objective at gtsam's optimum, to many digits."""
    from evermap_studies.peers.plain_gtsam import levenberg_marquardt

    near = levenberg_marquardt(drive.factors, drive.starts[start], marginals=False).estimate
    found = levenberg_marquardt(drive.factors, near, tolerance=BEST, marginals=False, logarithm=False)
    return _objective(drive, found.estimate)


def session_row(config: WarehouseConfig | int, *, evermap: bool = True, isam: bool = False) -> dict[str, Any]:
    """Measure all contenders on one drive.

    Args:
        config: the warehouse.
        evermap: False for the peers alone.
        isam: whether iSAM2 takes part.
    """
    drive = warehouse_drive(config)
    row = described(drive)
    if evermap:
        row["evermap"] = by_evermap(drive)
        row["plain"] = by_evermap_plain(drive)
        if len(drive.factors.landmark_id) <= MAPPED_UP_TO:
            row["mapped"] = by_evermap_mapped(drive)
    row |= {"lm": by_gtsam(drive, "near"), "lm_odometry": by_gtsam(drive, "odometry"), "best": best_objective(drive)}
    if isam:
        row["isam2"] = by_isam2(drive)
    return row


def stream_row(n_landmarks: int, *, evermap: bool = True) -> dict[str, Any]:
    """Measure the frames of a session with ten landmarks in view, beside iSAM2."""
    drive = warehouse_drive(WarehouseConfig(n_landmarks=n_landmarks, range_m=STREAM_RANGE_M))
    row = described(drive)
    if evermap:
        row["evermap"] = by_evermap_stream(drive)
    return row | {"isam2": by_isam2(drive)}


def dlr_row(folder: Path = DLR) -> dict[str, Any] | None:
    """Measure DLR with its identities; None where the recording is not here.

    The noise of the plain problem is what the first run learned; the peer starts from odometry, and, because it may
    stay in a wrong optimum there, from evermap's estimate too, untimed.
    """
    if not folder.is_dir():
        return None
    recording = dlr_recording(folder)
    done = spent(lambda: em.run_slam(recording))
    noise = learned_noise(done.result)
    factors = plain.factors_of(recording, noise)
    drive = Drive(recording, noise, factors, {"odometry": plain.dead_reckoned_start(factors)})
    alone = spent(lambda: em.run_slam(recording, plain_config(noise)))
    estimate = estimate_of(alone.result, factors)
    drive.starts["evermap"] = estimate
    row = described(drive)
    row["evermap"] = {"wall_s": done.wall_s, "cpu_s": done.cpu_s}
    row["plain"] = {"wall_s": alone.wall_s, "cpu_s": alone.cpu_s, "objective": _objective(drive, estimate)}
    row["lm_odometry"] = by_gtsam(drive, "odometry")
    row["best"] = min(best_objective(drive, start) for start in drive.starts)
    return row


def described(drive: Drive) -> dict[str, Any]:
    """Return the size of a drive."""
    factors = drive.factors
    return {
        "landmarks": len(factors.landmark_id),
        "minutes": float(np.ptp(drive.recording.frames.stamp_s)) / 60.0,
        "poses": len(factors.stamp_s),
        "sightings": len(factors.pose_row),
    }


def once(contender: str, n_landmarks: int) -> None:
    """Run one contender once: what `benchmarks.memory` measures in a process of its own."""
    if contender == "evermap":
        em.run_slam(simulate_warehouse(n_landmarks))
    else:
        by_gtsam(warehouse_drive(n_landmarks), "near")


def memory_row(n_landmarks: int, contender: str) -> dict[str, float]:
    """Return the peak of a contender's process [MB], and what it grew by over a small session."""
    found = memory.measure("scale", contender, n_landmarks)
    return {"peak_mb": found["peak_mb"], "grown_mb": max(found["peak_mb"] - found["before_mb"], 0.1)}


def warm_up() -> None:
    """Run everything once on a small drive."""
    drive = warehouse_drive(WARM_UP)
    by_evermap(drive)
    by_evermap_stream(drive)
    by_evermap_mapped(drive)
    by_evermap_plain(drive)
    by_gtsam(drive, "near")
    by_isam2(drive)


def run(sizes: Sequence[int] | None = None) -> tuple[dict[str, float], dict[str, Any]]:
    """Measure sessions of some sizes, the stream and memory, and, where sizes are given, DLR and maps.

    Args:
        sizes: landmarks; None for `SIZES`, for which alone there are metrics.
    """
    from benchmarks import scale_maps

    quick = sizes is None
    sizes = SIZES if sizes is None else tuple(sizes)
    warm_up()
    rows = [session_row(n, isam=n <= ISAM_UP_TO and not quick) for n in sizes]
    for n, row in zip(sizes, rows, strict=True):
        row["memory"] = {who: memory_row(n, who) for who in ("evermap", "gtsam")}
    shown: dict[str, Any] = {
        "sizes": list(sizes),
        "sessions": rows,
        "exponents": exponents(rows),
        "stream": stream_row(min(STREAM_SIZE, max(sizes))),
    }
    if quick:
        return ratios(shown), shown
    return {}, shown | {"dlr": dlr_row(), "maps": scale_maps.run()}


def exponents(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Return the exponents of CPU time over landmarks, and over landmarks times time driven, of every contender.

    The second is half the first where the drive grows with the world.
    """
    found: dict[str, dict[str, float]] = {}
    for who in ("evermap", "mapped", "plain", "lm", "lm_odometry", "isam2"):
        measured = [row for row in rows if who in row]
        if len({row["landmarks"] for row in measured}) > 1:
            cpu_s = [row[who]["cpu_s"] for row in measured]
            found[who] = {
                "landmarks": exponent([row["landmarks"] for row in measured], cpu_s),
                "landmarks_times_time": exponent([row["landmarks"] * row["minutes"] for row in measured], cpu_s),
            }
    return found


def ratios(shown: dict[str, Any]) -> dict[str, float]:
    """Return the metrics of the default sizes."""
    last, stream = shown["sessions"][-1], shown["stream"]
    grown = last["memory"]
    found = {
        "scale_time_ratio": last["evermap"]["cpu_s"] / last["lm"]["cpu_s"],
        "scale_exponent": shown["exponents"]["evermap"]["landmarks"],
        "scale_memory_ratio": grown["evermap"]["grown_mb"] / grown["gtsam"]["grown_mb"],
        "scale_objective_ratio": max(row["plain"]["objective"] / row["best"] for row in shown["sessions"]),
        "scale_frame_ratio": stream["isam2"]["median_ms"] / stream["evermap"]["median_ms"],
    }
    return {name: float(value) for name, value in found.items()}


def _objective(drive: Drive, estimate: PlainEstimate) -> float:
    """With the residuals of evermap."""
    return plain.objective(drive.factors, estimate, logarithm=False)


def _frames(step_s: FloatArray) -> dict[str, float]:
    """Median, 99th percentile and longest frame [ms], after the first ones."""
    ms = 1e3 * step_s[min(STREAM_FROM, len(step_s) // 2) :]
    return {
        "median_ms": statistics.median(ms.tolist()),
        "p99_ms": float(np.quantile(ms, 0.99)),
        "longest_ms": float(ms.max()),
    }


def _accuracy(landmark_id: Any, position_m: FloatArray, recording: Recording) -> dict[str, float]:
    """Root mean square error of landmarks [m] once moved onto the truth, where there is one."""
    if recording.true_landmarks is None:
        return {}
    truth = recording.true_landmarks.position_m[np.searchsorted(recording.true_landmarks.landmark_id, landmark_id)]
    moved = se2.transform(rigid(position_m, truth), position_m)
    return {"rmse_m": float(np.sqrt(np.square(moved - truth).sum(axis=1).mean()))}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("landmarks", nargs="*", type=int, default=BESIDE_SIZES)
    parser.add_argument("--turns", type=int, default=BESIDE_TURNS)
    arguments = parser.parse_args()
    em.run_slam(simulate_warehouse(WARM_UP))
    heads = ("landmarks", "run_slam [CPU s]", "gtsam's LM from 0.5 m off", "from odometry", "ratios")
    print(f"| {' | '.join(heads)} |\n|{'---:|' * len(heads)}")
    for size in arguments.landmarks:
        least = beside_optimum(size, arguments.turns)
        own, near, odometry = least["evermap"], least["near"], least["odometry"]
        times = f"{own / near:.2f}, {own / odometry:.2f}"
        print(f"| {size} | {own:.3f} | {near:.3f} | {odometry:.3f} | {times} |", flush=True)
