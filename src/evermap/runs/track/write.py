"""The folder of a run of `evermap track`: tables, summary, figure and scene."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from evermap.errors import MissingExtraError
from evermap.io.columns import csv_bytes, named
from evermap.io.table import parquet_bytes
from evermap.runs.folder import RunFolder
from evermap.runs.summary import RunInfo, summary_head
from evermap.runs.track.detections import COVARIANCE, ENTRIES
from evermap.runs.track.lifetimes import LIFETIME_COLUMNS, lifetimes_csv
from evermap.tracking.record import BOX_COLUMNS
from evermap.tracking.run import TrackResult
from evermap.tracking.tracklets import EventKind, TrackState
from evermap.types import UNKNOWN, FloatArray, IntArray
from evermap.viz.plots import plot_track_run
from evermap.viz.style import save_png


def write_track(
    out: str | Path,
    result: TrackResult,
    *,
    info: RunInfo | None = None,
    scene: bool = False,
    force: bool = False,
    inputs: Iterable[str | Path | None] = (),
    progress: Callable[[float, float], None] | None = None,
) -> dict[str, Any]:
    """Write the folder of a run. Returns the content of `summary.json`.

    Args:
        out: the folder; an older run there is replaced at the end.
        result: of `run_track`.
        info: command and measured times.
        scene: whether to write a recording for rerun; left out with a warning where rerun-sdk is missing.
        force: write into a folder that holds other files, too; they stay.
        inputs: files that were read, beside the table.
        progress: told after each file.

    Raises:
        ConfigError: `out` must not or cannot be written.
    """
    start = perf_counter()
    files = track_files(result)
    with RunFolder(out, force=force, inputs=(result.table.source, *inputs)) as folder:
        for k, (name, content) in enumerate(files.items()):
            folder.path(name).write_bytes(content())
            if progress:
                progress(k + 1, len(files) + 1)
        written = perf_counter()
        save_png(plot_track_run(result), folder.path("figures/objects.png"))
        remarks = _scene(result, folder) if scene else []
        timing: dict[str, float] = {
            "track_s": result.seconds,
            "write_s": written - start,
            "draw_s": perf_counter() - written,
        }
        summary = track_summary(result, info=info or RunInfo(), timing=timing)
        summary["warnings"] += remarks
        return folder.finish(summary)


def track_files(result: TrackResult) -> dict[str, Callable[[], bytes]]:
    """Return the tables of a run by their names, made when they are asked for."""
    return {
        "tracks.csv": lambda: csv_bytes(_with_names(_tracks(result))),
        "tracks.parquet": lambda: parquet_bytes(_with_lists(_tracks(result))),
        "detections.csv": lambda: csv_bytes(_detections(result)),
        "events.jsonl": lambda: _events(result).encode(),
        "spells.csv": lambda: csv_bytes(_with_names(_spells(result))),
        "lifetimes.csv": lambda: _lifetimes_csv(result),
    }


def track_summary(result: TrackResult, *, info: RunInfo, timing: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of `summary.json`; outside of `timing` and `versions` a function of the input and the
    choices.
    """
    table, spells = result.table, result.spells
    happened = np.array([event.kind for event in result.events], dtype=np.int64)
    class_of_track = result.class_of_track()
    config = {"track": result.config.to_dict()}
    pace = {"frames_per_second": table.n_frames / result.seconds if result.seconds > 0.0 else None}
    return {
        **summary_head(info, config=config, source=table.source, timing={**timing, **pace}, warnings=result.warnings),
        "counts": {
            "frames": table.n_frames,
            "empty_frames": int((np.diff(table.first) == 0).sum()),
            "gaps": result.n_gaps,
            "detections": len(table),
            "detections_of_objects": int((result.track_of_detection != UNKNOWN).sum()),
            "detections_of_low_score": table.n_weak,
            "objects": len(class_of_track),
            "events": {kind.name.lower(): int((happened == kind).sum()) for kind in EventKind},
            "spells": len(spells),
            "duration_s": float(table.stamp_s[-1] - table.stamp_s[0]),
        },
        "classes": {name or "all": _of_class(result, k, class_of_track) for k, name in enumerate(table.class_names)},
    }


def _scene(result: TrackResult, folder: RunFolder) -> list[str]:
    """Writes the recording; a remark where it cannot be."""
    try:
        write_recording(result, folder.path("scene.rrd"))
    except MissingExtraError as error:
        return [f"scene.rrd was left out: {error.one_line()}"]
    return []


def _of_class(result: TrackResult, class_id: int, class_of_track: IntArray) -> dict[str, Any]:
    """What there is to say about one class."""
    spells = result.spells
    mine = spells.class_id == class_id
    bounded = np.isfinite(spells.elsewhere_s)
    of_lifetime = np.unique(result.spell_of_lifetime)
    stays_s = (spells.last_s - spells.first_s)[mine]
    return {
        "objects": int((class_of_track == class_id).sum()),
        "spells": int(mine.sum()),
        "spells_that_ended": int((mine & np.isfinite(spells.gone_s)).sum()),
        "spells_of_known_beginning": int((mine & bounded).sum()),
        "spells_with_lifetimes": int((spells.class_id[of_lifetime] == class_id).sum()),
        "seen_to_stay_s": {"median": float(np.median(stays_s)), "most": float(stays_s.max())} if len(stays_s) else None,
    }


def _tracks(result: TrackResult) -> dict[str, tuple[tuple[str, ...], IntArray] | FloatArray | IntArray]:
    """One row an object and frame; columns of names are the names and which of them each row has."""
    tracks = result.tracks
    return {
        "stamp_s": tracks.stamp_s,
        "track_id": tracks.track_id,
        "class_id": (result.table.class_names, tracks.class_p.argmax(axis=1)),
        "state": (tuple(state.name.lower() for state in TrackState), tracks.state),
        **_axes("", "_m", tracks.position_m),
        **_axes("v", "_mps", tracks.velocity_mps),
        "p_exists": tracks.p_exists,
        "static": tracks.static.astype(np.int64),
        **_beliefs(result),
    }


def _beliefs(result: TrackResult) -> dict[str, FloatArray]:
    """Boxes, covariances and scores, where detections have boxes or scores."""
    tracks, found = result.tracks, {}
    if result.table.score is not None:
        p = np.clip(tracks.p_exists, 1e-12, 1.0 - 1e-12)
        found["score"] = np.log(p / (1.0 - p))
    if result.table.box is not None:
        found |= {name: tracks.box[:, k] for k, name in enumerate(BOX_COLUMNS)}
        sigma = np.sqrt(tracks.box_variance)
        found |= {f"sigma_{name}": sigma[:, k] for k, name in enumerate(BOX_COLUMNS)}
        entries = zip(COVARIANCE, ENTRIES, strict=True)
        found |= {name: tracks.position_covariance_m2[:, i, j] for name, (i, j) in entries}
    return found


def _spells(result: TrackResult) -> dict[str, tuple[tuple[str, ...], IntArray] | FloatArray | IntArray]:
    """One row a spell; empty where it is not known when it began or that it ended."""
    spells = result.spells
    return {
        "track_id": spells.track_id,
        "class_id": (result.table.class_names, spells.class_id),
        **_axes("", "_m", spells.position_m),
        "elsewhere_s": np.where(np.isfinite(spells.elsewhere_s), spells.elsewhere_s, np.nan),
        "first_s": spells.first_s,
        "last_s": spells.last_s,
        "gone_s": np.where(np.isfinite(spells.gone_s), spells.gone_s, np.nan),
    }


def _detections(result: TrackResult) -> dict[str, Any]:
    """Which object each detection is of; empty for those of none."""
    table = result.table
    frame = np.repeat(np.arange(table.n_frames), np.diff(table.first))
    found = result.track_of_detection
    return {
        "line": table.line,
        "stamp_s": table.stamp_s[frame],
        "track_id": np.where(found == UNKNOWN, np.nan, found) if (found == UNKNOWN).any() else found,
    }


def _events(result: TrackResult) -> str:
    """One JSON object a line, of objects that were confirmed."""
    known = set(np.unique(result.objects().track_id).tolist())
    return "".join(
        json.dumps({"stamp_s": event.stamp_s, "event": event.kind.name.lower(), "track_id": event.track_id}) + "\n"
        for event in result.events
        if event.track_id in known
    )


def _lifetimes_csv(result: TrackResult) -> bytes:
    if result.lifetimes is None:
        return (",".join(LIFETIME_COLUMNS) + "\n").encode()
    spell = result.spell_of_lifetime
    spells = result.spells
    return lifetimes_csv(
        result.lifetimes, result.table.class_names, spells.class_id[spell], spells.position_m[spell, :2]
    )


def _axes(prefix: str, unit: str, vectors: FloatArray) -> dict[str, FloatArray]:
    return {f"{prefix}{axis}{unit}": vectors[:, k] for k, axis in enumerate("xyz")}


def _with_names(columns: dict[str, Any]) -> dict[str, Any]:
    """For `csv_bytes`."""
    return {name: named(*cells) if isinstance(cells, tuple) else cells for name, cells in columns.items()}


def _with_lists(columns: dict[str, Any]) -> dict[str, Any]:
    """For `parquet_bytes`."""
    return {
        name: np.array(cells[0], dtype=object)[cells[1]].tolist() if isinstance(cells, tuple) else cells
        for name, cells in columns.items()
    }


def write_recording(result: TrackResult, path: Path) -> None:
    """Record objects, frame after frame, with those that rest out of view.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """
    from evermap.viz.rerun_scene import log_tracks

    table, tracks = result.table, result.objects()
    rows = np.argsort(tracks.stamp_s, kind="stable")
    parts = np.searchsorted(tracks.stamp_s[rows], table.stamp_s[1:])
    log_tracks(
        path,
        stamp_s=table.stamp_s - table.stamp_s[0],
        track_id=np.split(tracks.track_id[rows], parts),
        position_m=np.split(tracks.position_m[rows], parts),
        static=np.split(tracks.static[rows], parts),
        resting_m=_resting(result),
        sensor_m=table.sensor_m,
        reach_m=result.config.range_m,
    )


def _resting(result: TrackResult) -> list[FloatArray]:
    """(F) of (K, 3) places of the objects in the working set at each frame, where they were last seen."""
    tracks = result.objects()
    place = dict(zip(tracks.track_id.tolist(), tracks.position_m, strict=True))  # the last row of each
    events = iter(sorted(result.events, key=lambda event: event.stamp_s))
    event = next(events, None)
    there: set[int] = set()
    resting = []
    for stamp_s in result.table.stamp_s.tolist():
        while event is not None and event.stamp_s <= stamp_s:
            if event.kind == EventKind.STORED:
                there.add(event.track_id)
            else:
                there.discard(event.track_id)
            event = next(events, None)
        resting.append(np.array([place[track] for track in sorted(there) if track in place]).reshape(-1, 3))
    return resting
