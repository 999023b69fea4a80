"""What was written, to be looked at: a run folder or a living map as a scene for rerun or messages for Foxglove."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import ConfigError, EvermapError
from evermap.io.spatial import spatial_detections
from evermap.maps.sessions.admission import as_estimated
from evermap.runs.folder import SUMMARY
from evermap.runs.summary import change_of
from evermap.types import (
    AnyRecording,
    Clock,
    Frames,
    Innovations,
    Landmarks,
    Misses,
    Recording,
    SlamResult,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
)

WRITTEN = {".rrd": "scene.rrd", ".mcap": "run.mcap"}
"""Output formats by file ending, with the name of the same file in a run folder."""


def write_view(path: str | Path, out: str | Path) -> tuple[str, ...]:
    """Write what rerun (`.rrd`) or Foxglove (`.mcap`) shows of a run folder or a living map; return remarks.

    Of a run it is the file that the run wrote, where it did; else path, landmarks and changes are read from the folder,
    and detections and truth from its recording, if that is still there. Of a map it is every landmark from its first
    sighting on, as faint as it is doubtful, and all changes of all revisions.

    Args:
        path: folder of a run of `slam`, or a living map.
        out: file to write.

    Raises:
        ConfigError: an ending that nothing shows, or the run is not one of `slam`.
        InputError: nothing is there, or it is damaged.
        MissingExtraError: `rerun-sdk`, or `rosbags` for MCAP, is not installed.
    """
    path, out = Path(path), Path(out)
    ending = out.suffix.lower()
    if ending not in WRITTEN:
        raise ConfigError(f"cannot write a '{out.suffix}' file", path=out, field="save", hint="scene.rrd or scene.mcap")
    if (path / WRITTEN[ending]).is_file():
        shutil.copyfile(path / WRITTEN[ending], out)
        return ()
    recording, result = _of_run(path) if path.is_dir() else _of_map(path)
    if ending == ".rrd":
        from evermap.viz.rerun_scene import write_scene

        write_scene(recording, result, out)
    else:
        from evermap.runs.mcap import write_mcap

        write_mcap(recording, result, out)
    return result.warnings


def _of_map(path: Path) -> tuple[AnyRecording, SlamResult]:
    """The newest revision of a map, with the changes of all."""
    from evermap.maps.diff import story_of
    from evermap.maps.store import open_store

    with open_store(path) as store:
        living, told = store.load(), [change for one in story_of(store) for change in one.changes]
    poses = np.zeros((0, 7 if living.dim == 3 else 3))
    nowhere = Trajectory(np.zeros(0), poses, np.zeros((0, 6, 6)), frame="prior_map", clock=living.clock)
    changes = tuple(change.named(living.landmark_names) for change in told)
    return _nothing(path.stem, living.clock), _result(nowhere, nowhere, living.landmarks(), changes=changes)


def _of_run(folder: Path) -> tuple[AnyRecording, SlamResult]:
    """A run as its files have it.

    Raises:
        ConfigError: it is not a run of `slam`.
    """
    from evermap.io import read_landmarks, read_tum

    try:
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
        about, clock = summary["recording"], Clock(summary["recording"]["clock"])
        changes = tuple(map(change_of, summary["changes"]))
        files = ("trajectory.tum", "map.parquet", "innovations.parquet")
        missing = [name for name in files if not (folder / name).is_file()]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise ConfigError("is not a run of `slam`", path=folder, hint="a folder with its summary.json") from error
    if missing:
        raise ConfigError(f"contains no {missing[0]}", path=folder, hint="a complete folder written by `slam`")
    landmarks = read_landmarks(folder / "map.parquet")
    in_space = landmarks.position_m.shape[1] == 3
    path = read_tum(folder / "trajectory.tum", clock=clock, in_space=in_space)
    if (folder / "online.tum").is_file():
        online = read_tum(folder / "online.tum", clock=clock, in_space=in_space)
    else:
        online = path[np.zeros(0, dtype=np.int64)]
    recording, remarks = _recording(about, clock)
    result = _result(path, online, landmarks, changes=changes, warnings=remarks)
    recording = as_estimated(recording, result)
    return recording, replace(result, innovations=_innovations(folder / "innovations.parquet"))


def _recording(about: Mapping[str, Any], clock: Clock) -> tuple[AnyRecording, tuple[str, ...]]:
    """The recording of a run, or nothing and a remark where it is not there any more."""
    from evermap.io import list_robots, read_recording

    source, name = str(about["source"]), str(about["name"])
    try:
        for robot in (None, *list_robots(source)):
            recording = read_recording(source, robot=robot)
            if recording.name == name:
                return recording, ()
    except EvermapError:
        pass
    return _nothing(name, clock), (f"{source} is missing, or is another recording: shown without detections and truth",)


def _innovations(path: Path) -> Innovations:
    from evermap.io.table import parse_parquet

    table = parse_parquet(path.read_bytes(), path)
    columns: dict[str, Any] = {name: table.columns[name] for name in Innovations.__dataclass_fields__ if name in table}
    if "dof" in columns:
        columns["dof"] = np.asarray(columns["dof"], dtype=np.int64)
    return Innovations(**columns)


def _nothing(name: str, clock: Clock) -> SpatialRecording:
    """A recording in which nothing was seen."""
    frames = Frames(np.zeros(0), clock=clock)
    nobody = spatial_detections(np.zeros(0, dtype=np.int64))
    return Recording(name, None, frames, nobody, sensors=(SpatialSensor(),), clock=clock)


def _result(path: Trajectory, online: Trajectory, landmarks: Landmarks, **more: Any) -> SlamResult:
    none = np.zeros(0)
    return SlamResult(
        trajectory=path,
        online=online,
        landmarks=landmarks,
        parameters=(),
        innovations=Innovations(none, none.astype(np.int64), none.astype(np.int64), none, none),
        misses=Misses.empty(),
        step_s=none,
        dead_reckoning=path[np.zeros(0, dtype=np.int64)],
        **more,
    )
