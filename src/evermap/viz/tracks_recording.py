"""A rerun recording of a tracker at work: active tracklets, the working set, the sensor and what it can see.

Needs rerun-sdk (extra `evermap[rerun]`). The timeline is `time`; whole columns are sent at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evermap.types import BoolArray, FloatArray, IntArray
from evermap.viz.rerun_stream import require_rerun, rgb
from evermap.viz.style import INK, MUTED
from evermap.viz.tracks_figure import DYNAMIC, STATIC

TIMELINE = "time"
RADIUS_M = 0.3
ROUND = 64
"""Corners of the circle around the sensor."""


def log_tracks(
    path: str | Path,
    *,
    stamp_s: FloatArray,
    track_id: Sequence[IntArray],
    position_m: Sequence[FloatArray],
    static: Sequence[BoolArray],
    resting_m: Sequence[FloatArray],
    sensor_m: FloatArray | None = None,
    reach_m: float | None = None,
) -> Path:
    """Writes `path` (.rrd): tracklets with their ids, static ones blue and dynamic ones purple, and who rests, smaller.

    Args:
        path: of the file.
        stamp_s: (F,).
        track_id: (F) of (N,) active tracklets.
        position_m: (F) of (N, 3).
        static: (F) of (N,) whether each is static.
        resting_m: (F) of (K, 3) places of the objects in the working set.
        sensor_m: (F, 3), if it is known.
        reach_m: radius in which it sees, if there is one.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """
    require_rerun()
    import rerun as rr

    path = Path(path)
    stream = rr.RecordingStream("evermap", recording_id=path.stem, send_properties=False)
    stream.save(path, default_blueprint=_blueprint())
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    times = rr.TimeColumn(TIMELINE, duration=stamp_s)
    colours = [np.where(rest[:, None], rgb(STATIC), rgb(DYNAMIC)).astype(np.uint8) for rest in static]
    labels = [str(one) for ids in track_id for one in ids.tolist()]
    _send_points(stream, times, "world/active", position_m, colors=np.concatenate(colours), labels=labels)
    stream.log("world/active", rr.Points3D.from_fields(radii=RADIUS_M, show_labels=False), static=True)
    _send_points(stream, times, "world/working_set", resting_m)
    stream.log("world/working_set", rr.Points3D.from_fields(colors=rgb(STATIC), radii=0.4 * RADIUS_M), static=True)
    if sensor_m is not None:
        _send_sensor(stream, times, sensor_m, reach_m)
    counts = {
        "static": [int(rest.sum()) for rest in static],
        "dynamic": [int((~rest).sum()) for rest in static],
        "working set": [len(places) for places in resting_m],
    }
    for (name, values), colour in zip(counts.items(), (STATIC, DYNAMIC, MUTED), strict=True):
        entity = f"count/{name.replace(' ', '_')}"
        stream.log(entity, rr.SeriesLines(colors=rgb(colour), names=name, widths=1.5), static=True)
        stream.send_columns(entity, [times], rr.Scalars.columns(scalars=np.array(values, dtype=np.float64)))
    stream.flush()
    stream.disconnect()
    return path


def _send_points(stream: Any, times: Any, entity: str, position_m: Sequence[FloatArray], **more: Any) -> None:
    """A cloud for every instant; an empty one too, or the last would stay."""
    import rerun as rr

    points = np.concatenate([np.reshape(p, (-1, 3)) for p in position_m]).astype(np.float32)
    columns = rr.Points3D.columns(positions=points, **more)
    stream.send_columns(entity, [times], columns.partition(lengths=np.array([len(p) for p in position_m])))


def _send_sensor(stream: Any, times: Any, sensor_m: FloatArray, reach_m: float | None) -> None:
    import rerun as rr

    stream.send_columns("world/sensor", [times], rr.Transform3D.columns(translation=sensor_m))
    stream.log("world/sensor", rr.Points3D([[0.0, 0.0, 0.0]], colors=rgb(INK), radii=0.5), static=True)
    if reach_m is not None:
        angle = np.linspace(0.0, 2.0 * np.pi, ROUND + 1)
        circle = reach_m * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(ROUND + 1)])
        stream.log("world/sensor/reach", rr.LineStrips3D([circle], colors=rgb(MUTED), radii=0.05), static=True)


def _blueprint() -> Any:
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Spatial3DView(name="world", origin="world"),
            rrb.TimeSeriesView(name="objects", origin="count"),
            row_shares=[4, 1],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
