"""The tables of a run of the tracker, for the folder of `evermap track` and for that of `evermap slam`."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from evermap.existence.rhythm import DAY_S
from evermap.io.arrow import parquet_bytes
from evermap.io.columns import csv_bytes, named
from evermap.io.spatial import COVARIANCE, upper_triangle
from evermap.runs.track.lifetimes import LIFETIME_COLUMNS, lifetimes_csv
from evermap.tracking.record import BOX_COLUMNS
from evermap.tracking.run import TrackResult
from evermap.tracking.tracklets import TrackState
from evermap.types import UNKNOWN, Clock, FloatArray, IntArray

_Columns = Mapping[str, tuple[tuple[str, ...], IntArray] | FloatArray | IntArray]
"""By name; columns of names hold the names and their indices."""


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


def _tracks(result: TrackResult) -> _Columns:
    """Return one row per object and frame."""
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
    """P(static) where it was asked; boxes, covariances and scores, where detections have boxes or scores."""
    tracks = result.tracks
    found = {} if result.p_static is None else {"p_static": result.p_static}
    if result.table.score is not None:
        p = np.clip(tracks.p_exists, 1e-12, 1.0 - 1e-12)
        found["score"] = np.log(p / (1.0 - p))
    if result.table.box is not None:
        found |= {name: tracks.box[:, k] for k, name in enumerate(BOX_COLUMNS)}
        sigma = np.sqrt(tracks.box_variance)
        found |= {f"sigma_{name}": sigma[:, k] for k, name in enumerate(BOX_COLUMNS)}
        found |= upper_triangle(tracks.position_covariance_m2, COVARIANCE)
    return found


def _spells(result: TrackResult) -> _Columns:
    """Return one row per spell, with empty cells for unknown begins and ends."""
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
    """Return the object of each detection; empty for unassigned ones."""
    table = result.table
    frame = np.repeat(np.arange(table.n_frames), np.diff(table.first))
    found = result.track_of_detection
    return {
        "line": table.line,
        "stamp_s": table.stamp_s[frame],
        "track_id": np.where(found == UNKNOWN, np.nan, found) if (found == UNKNOWN).any() else found,
    }


def _events(result: TrackResult) -> str:
    """Return the events of confirmed objects, one JSON object per line."""
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
    began_s = None
    if result.table.clock is not Clock.RECORDING and np.ptp([*spells.first_s, *spells.last_s]) > DAY_S:
        began_s = spells.last_s[spell] - result.lifetimes.left_s
    xy_m = spells.position_m[spell, :2]
    names, clock = result.table.class_names, result.table.clock
    return lifetimes_csv(result.lifetimes, names, spells.class_id[spell], xy_m, began_s, clock)


def _axes(prefix: str, unit: str, vectors: FloatArray) -> dict[str, FloatArray]:
    return {f"{prefix}{axis}{unit}": vectors[:, k] for k, axis in enumerate("xyz")}


def _with_names(columns: _Columns) -> dict[str, Any]:
    """Return the columns for `csv_bytes`."""
    return {name: named(*cells) if isinstance(cells, tuple) else cells for name, cells in columns.items()}


def _with_lists(columns: _Columns) -> dict[str, Any]:
    """Return the columns for `parquet_bytes`."""
    return {
        name: np.array(cells[0], dtype=object)[cells[1]].tolist() if isinstance(cells, tuple) else cells
        for name, cells in columns.items()
    }
