"""`summary.json`: inputs, results and cost of a run, as plain values with stable keys.

Everything outside of `timing` and `versions` is a function of the inputs and the seed alone.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from evermap import __version__
from evermap.io.landmarks import up_dict
from evermap.types import (
    AnyRecording,
    ChangeKind,
    MapChange,
    ParameterEstimate,
    SlamResult,
    Verdict,
    json_number,
    or_nan,
)

SUMMARY_SCHEMA_VERSION = "3"
"""Of `summary.json` of all verbs and studies. 2: `config` holds sections; `version` and `input` for all. 3: a run has
its `verdict`."""

_FRAME_MEANING = {
    "first_pose": "the robot's first pose: origin at its position, {axes}; metres",
    "first_robot": "the first robot's first pose: origin at its position, {axes}; metres",
    "prior_map": "the frame of the given map; metres",
    "gnss": "the frame of the GNSS fixes; metres",
    "truth": "the frame of the recording's own reference; metres",
}
_AXES = {3: "x ahead of it, y to its left", 7: "axes as at that pose"}
_ROBOT = {
    3: "x forward, y left, angles counter-clockwise; pose covariances are in this frame",
    7: "the frame of the odometry and of the sensors' mounts; pose covariances are in this frame: translation along "
    "x, y, z, then rotation about them",
}
"""Texts in the plane and in space, by how many numbers a pose has."""


@dataclass(frozen=True, slots=True)
class RunInfo:
    """Facts on a run that its result lacks.

    Attributes:
        command: the command line, '' if there was none.
        seeds: every seed by name.
        read_s: wall time of reading the input; None if not measured.
        processing_s: wall time spent on estimating, without waiting for a live recording and without writing the
            outputs; None takes the sum of the steps.
        total_s: wall time of everything so far; None if not measured.
        grown: number of landmarks that a living map grew by; None without a map.
        accepted: whether the session was entered into the map; None without one.
    """

    command: str = ""
    seeds: Mapping[str, int] = field(default_factory=dict)
    read_s: float | None = None
    processing_s: float | None = None
    total_s: float | None = None
    grown: int | None = None
    accepted: bool | None = None


def summary_head(
    info: RunInfo,
    *,
    config: Mapping[str, Any],
    source: str,
    timing: Mapping[str, Any],
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the keys that every `summary.json` has; `RunFolder.finish` adds `outputs`. Pure, timing aside.

    Args:
        info: command and seeds.
        config: the sections of the configuration in effect, as JSON values.
        source: what was read, '' for what was made in memory.
        timing: seconds by step; peak memory and date are added, and the total where it is missing.
        warnings: remarks.
    """
    times = {**({} if info.read_s is None else {"read_s": info.read_s}), **timing}
    if "total_s" not in times:
        times["total_s"] = sum(seconds for name, seconds in times.items() if name.endswith("_s") and seconds)
    times["peak_memory_mb"] = json_number(peak_memory_mb())
    times["written_at"] = datetime.now(UTC).isoformat(timespec="seconds")
    return {
        "schema_version": SUMMARY_SCHEMA_VERSION,
        "evermap": __version__,
        "version": __version__,
        "versions": versions(),
        "command": info.command,
        "config": dict(config),
        "seeds": dict(info.seeds),
        "input": source,
        "source": source,
        "warnings": list(warnings),
        "timing": times,
    }


def summary_dict(
    recording: AnyRecording,
    result: SlamResult,
    metrics: Mapping[str, Any],
    *,
    config: Any,
    info: RunInfo,
    timing: Mapping[str, Any],
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the content of `summary.json` but for `outputs`, which `RunFolder.finish` adds. Pure.

    `metrics` are of `metrics_dict`, `timing` is of `timing_dict`; `warnings` are beyond those of recording and result.
    """
    size = result.trajectory.pose_world_robot.shape[1]
    remarks = [*recording.warnings, *result.warnings, *warnings]
    return {
        **summary_head(info, config=config, source=recording.source, timing=timing, warnings=remarks),
        "recording": {"name": recording.name, "source": recording.source, "clock": recording.clock.value},
        "frames": {
            "world": _frame_text(result.trajectory.frame, size),
            "robot": _ROBOT[size],
            "map": _frame_text(result.landmarks.frame, size),
            "clock": f"{recording.clock.value}; seconds",
        },
        "up": up_dict(result.landmarks.up),
        "metrics": dict(metrics),
        "accepted": info.accepted,
        "verdict": None if result.verdict is None else verdict_dict(result.verdict),
        "counts": {**_counts(recording, result), "landmarks_grown": info.grown},
        "changes": [*map(change_dict, result.changes)],
        "alternatives": [
            {"changes": [*map(change_dict, other.changes)], "probability": json_number(other.probability)}
            for other in result.alternatives
        ],
        "parameters": [_parameter(parameter) for parameter in result.parameters],
        "undecided": [
            {"parameters": [one.name for one in pair], "decided_by": list(pair.one.decided_by), "text": pair.text}
            for pair in result.undecided
        ],
        "interrupted": bool(result.interrupted),
    }


def _frame_text(frame: str, size: int) -> str:
    return f"{frame}: {_FRAME_MEANING.get(frame, 'as named; metres').format(axes=_AXES[size])}"


def verdict_dict(verdict: Verdict) -> dict[str, Any]:
    """Return a verdict as plain values with stable keys; null for what is infinite or unknown."""
    numbers = ("value", "least", "most")
    symptoms = [
        {**asdict(one), **{name: json_number(getattr(one, name)) for name in numbers}} for one in verdict.symptoms
    ]
    of_cause = ("value", "sigma", "probability", "nats")
    causes = [{**asdict(one), **{name: json_number(getattr(one, name)) for name in of_cause}} for one in verdict.causes]
    return {
        "kind": verdict.kind.value,
        "message": verdict.message,
        "trustworthy": verdict.kind.is_trustworthy,
        "symptoms": [
            {**symptom, "alarming": one.is_alarming} for symptom, one in zip(symptoms, verdict.symptoms, strict=True)
        ],
        "causes": causes,
    }


def change_dict(change: MapChange, *, stamp_s: float | None = None, decided_s: float | None = None) -> dict[str, Any]:
    """Return a change as every verb writes and prints it: the same keys in the same order, null where nothing is known.

    `stamp_s` is when it most probably happened, `decided_s` the look at which it became clear, where that is told.
    """
    return {
        "landmarks": [int(identity) for identity in change.landmark_ids],
        "kind": change.kind.value,
        "stamp_from_s": json_number(change.stamp_from_s),
        "stamp_to_s": json_number(change.stamp_to_s),
        "displacement_m": [json_number(metres) for metres in change.displacement_m],
        "displacement_covariance_m2": [*map(list, change.displacement_covariance_m2)] or None,
        "rotation_rad": json_number(change.rotation_rad),
        "probability": json_number(change.probability),
        "hits": change.n_hits,
        "misses": change.n_misses,
        "names": list(change.names) or None,
        "stamp_s": json_number(stamp_s),
        "decided_s": json_number(decided_s),
    }


def change_of(content: Mapping[str, Any]) -> MapChange:
    """Return the change of which `change_dict` gave these keys.

    Raises:
        LookupError, ValueError, TypeError: they are others.
    """
    return MapChange(
        landmark_ids=tuple(map(int, content["landmarks"])),
        kind=ChangeKind(content["kind"]),
        stamp_from_s=or_nan(content["stamp_from_s"]),
        stamp_to_s=or_nan(content["stamp_to_s"]),
        displacement_m=tuple(map(or_nan, content["displacement_m"])),
        rotation_rad=or_nan(content["rotation_rad"]),
        probability=or_nan(content["probability"]),
        n_hits=int(content["hits"]),
        n_misses=int(content["misses"]),
        names=tuple(content["names"] or ()),
        displacement_covariance_m2=tuple(map(tuple, content.get("displacement_covariance_m2") or ())),
    )


def changes_text(changes: Iterable[Mapping[str, Any]]) -> str:
    """Return the content of `changes.jsonl`: a change of `change_dict` a line."""
    return "".join(json.dumps(change, allow_nan=False, ensure_ascii=False) + "\n" for change in changes)


def timing_dict(recording: AnyRecording, result: SlamResult, info: RunInfo) -> dict[str, Any]:
    """Return what the run cost: real-time factor, step latencies [ms] and total [s]. Not reproducible."""
    step_ms = 1e3 * result.step_s
    p50, p99 = np.percentile(step_ms, [50, 99]) if len(step_ms) else (None, None)
    processing_s = float(np.sum(result.step_s)) if info.processing_s is None else info.processing_s
    lasted_s = _find_processed_s(recording, result)
    return {
        "real_time_factor": lasted_s / processing_s if processing_s > 0 and lasted_s > 0 else None,
        "processing_s": processing_s,
        "total_s": info.total_s,
        "step_p50_ms": json_number(p50),
        "step_p99_ms": json_number(p99),
        "step_max_ms": json_number(step_ms.max()) if len(step_ms) else None,
    }


def versions() -> dict[str, str]:
    """Return versions of what the numbers depend on."""
    found = {"python": platform.python_version()}
    for name in ("numpy", "scipy", "gtsam", "numba", "pyarrow", "matplotlib"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "missing"
    return found


def peak_memory_mb() -> float | None:
    """Return the largest resident size of this process so far [MB]; None if the system does not report it.

    Linux counts the parent's size at the fork into `ru_maxrss`; the high-water mark of the address space does not.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        marks = [line.split()[1] for line in status.read_text().splitlines() if line.startswith("VmHWM:")]
        if marks:
            return int(marks[0]) / 1e3
    try:
        import resource
        import sys
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3


def _find_processed_s(recording: AnyRecording, result: SlamResult) -> float:
    """Duration of the part that was processed."""
    done = result.online if len(result.online) else result.trajectory
    stamps = done.stamp_s if result.interrupted else recording.frames.stamp_s
    return float(stamps[-1] - stamps[0]) if len(stamps) > 1 else 0.0


def _counts(recording: AnyRecording, result: SlamResult) -> dict[str, Any]:
    sightings = recording.robot_sightings
    return {
        "duration_s": _find_processed_s(recording, result),
        "odometry_rows": 0 if recording.odometry is None else len(recording.odometry),
        "frames": len(recording.frames),
        "frames_processed": len(result.step_s),
        "detections": len(recording.detections),
        "detections_with_prediction": len(result.innovations),
        "misses": len(result.misses),
        "poses": len(result.trajectory),
        "landmarks": len(result.landmarks),
        "true_landmarks": None if recording.true_landmarks is None else len(recording.true_landmarks),
        "truth_poses": None if recording.truth is None else len(recording.truth),
        "robot_sightings": 0 if sightings is None else len(sightings),
    }


def _parameter(parameter: ParameterEstimate) -> dict[str, Any]:
    names = ("value", "sigma", "prior_mean", "prior_sigma", "p_needed", "alone")
    numbers = {name: json_number(getattr(parameter, name)) for name in names}
    return {**asdict(parameter), **numbers, "fixed": bool(parameter.fixed)}
