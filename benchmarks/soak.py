"""A day of driving with everything going wrong: does one map live through it?

A robot patrols a changing building for `hours` of driving, session after session into one living map, twice: with all
faults of `evermap_studies.worlds.faults`, and with none. After every session all arrays of map and result are looked
through, and
the memory of the process is read.

    python -m benchmarks.soak              # 24 h, as in docs/results/soak.md
    python -m benchmarks.soak --hours 1
"""

from __future__ import annotations

import argparse
import gc
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evermap.config import Config
from evermap.errors import DataError, EvermapError, NumericalError
from evermap.geometry import se2
from evermap.maps.living import LivingMap
from evermap.maps.sessions.session import Session
from evermap.metrics.trajectory import align_points, interpolate, scored_stamps
from evermap.pipeline import run_session
from evermap.types import FloatArray, Landmarks, Recording
from evermap_studies.sim import BuildingConfig, DriveConfig, OdometryConfig, SimulatedSensor, simulate_building
from evermap_studies.worlds.faults import FAULTLESS, FaultConfig, with_faults

SESSION_S = 180.0
SESSIONS_A_DAY = 48
NEAR_M = 0.25
"""A landmark is where the map has it, up to this."""
ROUGHLY_M = 0.5
"""The same where only existence is scored."""
SURE = 1e-3
"""Beliefs are scored as if they were at least so far from 0 and 1."""
FIXED = "fixture"
"""Class of what never moves in the simulated building."""
UNKNOWABLE = (
    "elsewhere_s", "gone_s", "first_seen_s", "last_seen_s", "sigma_range_m", "sigma_bearing_rad", "p_next", "direction",
)  # fmt: skip
"""Columns in which nan or inf mean 'not known'."""


@dataclass
class Soak:
    """What came of it, one number a session.

    Attributes:
        rmse_m: position error of the poses, in the map's frame; nan where the session was refused.
        off_m: position error that 95 % of the frames are within, at the times when they were truly taken (a clock that
            was set is no error of a pose); nan where the session was refused or set aside.
        set_aside: numbers of the sessions that were not entered.
        precision, recall: of the landmarks that the map believes in, against what stands in the building.
        log_loss: of the existence of the landmarks of the map, each where the map has it; nan before it is aligned.
        memory_mb: resident memory of the process after the session.
        map_kb: size of all arrays of the map.
        n_landmarks, n_places: of the map.
        step_p99_ms: 99th percentile of the time a frame.
        refused: one line for every session that was refused, with its number.
        defects: what must not be, one line each.
        driven_s: sum of the recordings' lengths.
    """

    rmse_m: list[float] = field(default_factory=list)
    off_m: list[float] = field(default_factory=list)
    set_aside: list[int] = field(default_factory=list)
    precision: list[float] = field(default_factory=list)
    recall: list[float] = field(default_factory=list)
    log_loss: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    map_kb: list[float] = field(default_factory=list)
    n_landmarks: list[int] = field(default_factory=list)
    n_places: list[int] = field(default_factory=list)
    step_p99_ms: list[float] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    defects: list[str] = field(default_factory=list)
    driven_s: float = 0.0

    def growth_mb(self) -> float:
        """Resident memory of the last quarter over that of the second: medians, so that one large session is none."""
        quarter = max(1, len(self.memory_mb) // 4)
        return float(np.median(self.memory_mb[-quarter:]) - np.median(self.memory_mb[quarter : 2 * quarter]))

    def summary(self) -> dict[str, float]:
        """Medians over the sessions of the second half, when everything has been seen, and what grew."""
        half = len(self.rmse_m) // 2
        return {
            "hours": self.driven_s / 3600.0,
            "sessions": len(self.rmse_m),
            "refused": len(self.refused),
            "set_aside": len(self.set_aside),
            "defects": len(self.defects),
            "rmse_median_m": float(np.nanmedian(self.rmse_m[half:])),
            "off_worst_m": float(np.nanmax(self.off_m)),
            "off_more_than_half_a_metre": float(np.sum(np.array(self.off_m) > 0.5)),
            "precision": float(np.median(self.precision[half:])),
            "recall": float(np.median(self.recall[half:])),
            "precision_worst": float(np.min(self.precision[half:])),
            "recall_worst": float(np.min(self.recall[half:])),
            "memory_mb": self.memory_mb[-1],
            "memory_growth_mb": self.growth_mb(),
            "map_kb": self.map_kb[-1],
            "map_growth_kb": self.map_kb[-1] - self.map_kb[half],
            "landmarks": self.n_landmarks[-1],
            "places": self.n_places[-1],
            "step_p99_ms": float(np.nanmedian(self.step_p99_ms[half:])),
        }


def world(
    hours: float, seed: int, *, session_s: float = SESSION_S, a_day: int = SESSIONS_A_DAY
) -> tuple[Recording, ...]:
    """Sessions of a robot that drives for so many hours in all, by day, at low rates of its sensors."""
    sessions = max(2, round(hours * 3600.0 / session_s))
    config = BuildingConfig(
        days=-(-sessions // a_day),
        sessions_per_day=min(sessions, a_day),
        patrol_s=session_s,
        drive=DriveConfig(truth_hz=20.0),
        odometry=OdometryConfig(rate_hz=10.0),
        sensor=SimulatedSensor(rate_hz=2.0),
    )
    return simulate_building(config, seed).sessions[:sessions]


def soak(recordings: tuple[Recording, ...], faults: FaultConfig = FAULTLESS, *, seed: int = 0) -> Soak:
    """Session after session into one map, with faults."""
    faulty = (with_faults(recording, faults, seed=1000 * seed + row) for row, recording in enumerate(recordings))
    return entered(faulty, recordings)


def entered(told: Iterable[Recording], recordings: tuple[Recording, ...], config: Config | None = None) -> Soak:
    """Session after session into one map, as they are `told`, scored by the recordings as they truly were.

    Sessions that are refused with an `EvermapError` leave the map as it is; anything else that is raised goes through.
    """
    found, living, pose_truth_map = Soak(), LivingMap(), None
    for row, (given, recording) in enumerate(zip(told, recordings, strict=True)):
        found.driven_s += float(np.ptp(recording.odometry.stamp_s))
        session: Session | None = None
        try:
            session = run_session(given, living, config)
            living = session.living
        except (DataError, NumericalError) as refusal:
            found.refused.append(f"session {row}: {refusal}")
            if isinstance(refusal, NumericalError):
                found.defects.append(found.refused[-1])
        except EvermapError as error:
            found.defects.append(f"session {row}: {error}")
        if session is not None:
            found.defects += [f"session {row}: {problem}" for problem in problems(session)]
            if pose_truth_map is None:
                pose_truth_map = _frame(living.landmarks(), recording)
        _enter(found, session, living, recording, pose_truth_map)
    return found


def problems(session: Session) -> Iterator[str]:
    """What must not be in the outcome of any session, one line each."""
    for part, value in (("living", session.living), ("slam", session.slam), ("evidence", session.evidence)):
        for name, column in _arrays(value, part):
            if name.rsplit(".", maxsplit=1)[-1] not in UNKNOWABLE and not np.isfinite(column).all():
                yield f"{name} is not finite"
            if name.rsplit(".", maxsplit=1)[-1].startswith("p_") and np.any((column < 0.0) | (column > 1.0 + 1e-9)):
                yield f"{name} is not a probability"
    for name, covariance in (
        ("living.covariance_m2", session.living.covariance_m2[None]),
        ("trajectory.covariance", session.slam.trajectory.covariance),
        ("landmarks.covariance_m2", session.slam.landmarks.covariance_m2),
    ):
        yield from _no_covariance(name, covariance)
    total = session.living.p_exists()
    if np.any((total < 0.0) | (total > 1.0 + 1e-9)):
        yield "p_exists is not a probability"
    if not np.all(np.diff(session.slam.trajectory.stamp_s) > 0.0):
        yield "stamps of the trajectory do not increase"


def _no_covariance(name: str, covariance: FloatArray) -> Iterator[str]:
    """(N, K, K) matrices that are not symmetric or have negative eigenvalues, beyond rounding."""
    if covariance.size == 0 or not np.isfinite(covariance).all():
        return
    scale = np.abs(covariance).max(axis=(1, 2)) + 1e-300
    skew = np.abs(covariance - covariance.swapaxes(1, 2)).max(axis=(1, 2)) / scale
    if np.any(skew > 1e-9):
        yield f"{name} is not symmetric, by {skew.max():.1e}"
    least = np.linalg.eigvalsh(covariance)[:, 0] / scale
    if np.any(least < -1e-9):
        yield f"{name} is not positive semidefinite, by {least.min():.1e}"


def _arrays(value: Any, name: str) -> Iterator[tuple[str, FloatArray]]:
    """All arrays of numbers in nested dataclasses and tuples, with their names."""
    if isinstance(value, np.ndarray):
        if value.dtype.kind == "f":
            yield name, value
    elif isinstance(value, tuple):
        for row, item in enumerate(value):
            yield from _arrays(item, f"{name}[{row}]")
    elif is_dataclass(value):
        for item in fields(value):
            yield from _arrays(getattr(value, item.name), f"{name}.{item.name}")


def _enter(
    found: Soak, session: Session | None, living: LivingMap, recording: Recording, pose_truth_map: FloatArray | None
) -> None:
    """The numbers of a session."""
    rmse, off, log_loss, right, claims, there = np.nan, np.nan, np.nan, 0, 0, 1
    if session is not None and not session.found:
        found.set_aside.append(len(found.rmse_m))
    if pose_truth_map is not None:
        if session is not None:
            rmse = _rmse(session, recording, pose_truth_map)
            off = _off(session, recording, pose_truth_map) if session.found else np.nan
        known, truth = living.landmarks(p_least=0.0), recording.true_landmarks
        assert truth is not None
        row = np.clip(np.searchsorted(truth.landmark_id, known.landmark_id), 0, len(truth) - 1)
        away = np.linalg.norm(se2.transform(pose_truth_map, known.position_m) - truth.position_m[row], axis=1)
        same = truth.landmark_id[row] == known.landmark_id
        stands = same & (away < NEAR_M)
        claimed, p = known.p_exists >= 0.5, np.clip(known.p_exists, SURE, 1.0 - SURE)
        right, claims, there = int(np.sum(claimed & stands)), int(np.sum(claimed)), len(truth)
        log_loss = -float(np.mean(np.log(np.where(same & (away < ROUGHLY_M), p, 1.0 - p))))
    found.rmse_m.append(rmse)
    found.off_m.append(off)
    found.precision.append(right / max(claims, 1))
    found.recall.append(right / there)
    found.log_loss.append(log_loss)
    found.step_p99_ms.append(1e3 * float(np.quantile(session.slam.step_s, 0.99)) if session is not None else np.nan)
    found.map_kb.append(sum(column.nbytes for _, column in _arrays(living, "living")) / 1e3)
    found.n_landmarks.append(len(living.members))
    found.n_places.append(len(living.places))
    gc.collect()
    found.memory_mb.append(resident_mb())


def _frame(landmarks: Landmarks, recording: Recording) -> FloatArray | None:
    """(3,) pose of the map in the truth, by what never moves; None where too little of it was seen."""
    truth = recording.true_landmarks
    assert truth is not None
    both = np.intersect1d(
        landmarks.landmark_id, truth.landmark_id[truth.class_id == recording.class_names.index(FIXED)]
    )
    if len(both) < 5:
        return None
    mine = landmarks.position_m[np.searchsorted(landmarks.landmark_id, both)]
    return align_points(mine, truth.position_m[np.searchsorted(truth.landmark_id, both)])


def _rmse(session: Session, recording: Recording, pose_truth_map: FloatArray) -> float:
    truth, path = recording.truth, session.slam.trajectory
    assert truth is not None
    rows = scored_stamps(truth, path.stamp_s[0], path.stamp_s[-1], 2.0)
    if len(rows) == 0:
        return float("nan")
    poses = interpolate(path, truth.stamp_s[rows])[0]
    error = se2.transform(pose_truth_map, poses[:, :2]) - truth.pose_world_robot[rows, :2]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def _off(session: Session, recording: Recording, pose_truth_map: FloatArray) -> float:
    """Frames are recognised by their readings, which no two share, whatever is stamped on them; nan where none is."""
    truth, path, used, told = recording.truth, session.slam.trajectory, session.recording, recording.detections
    assert truth is not None
    assert used.dim == 2
    order = np.argsort(told.range_m)
    at = np.minimum(np.searchsorted(told.range_m[order], used.detections.range_m), len(order) - 1)
    same = told.range_m[order][at] == used.detections.range_m
    if not same.any():
        return float("nan")
    frame, row = np.unique(used.detections.frame[same], return_index=True)
    stamp_s, taken_s = used.frames.stamp_s[frame], recording.frames.stamp_s[told.frame[order[at[same][row]]]]
    inside = (stamp_s >= path.stamp_s[0]) & (stamp_s <= path.stamp_s[-1])
    poses, true = interpolate(path, stamp_s[inside])[0], interpolate(truth, taken_s[inside])[0]
    error = se2.transform(pose_truth_map, poses[:, :2]) - true[:, :2]
    return float(np.quantile(np.hypot(*error.T), 0.95))


def resident_mb() -> float:
    """Resident memory of this process now [MB]; nan where the system does not say (only Linux does)."""
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text(encoding="utf-8").splitlines():
            if line.startswith("VmRSS:"):
                return float(line.split()[1]) / 1e3
    return float("nan")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run from the command line, with its arguments if none are given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0, help="of driving")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    drives = world(chosen.hours, chosen.seed)
    with_all = soak(drives, FaultConfig(), seed=chosen.seed)
    without = soak(drives)
    print(json.dumps({"faults": with_all.summary(), "none": without.summary()}, indent=2))
    for line in [*with_all.refused, *with_all.defects, *without.defects]:
        print(line)


if __name__ == "__main__":
    main()
