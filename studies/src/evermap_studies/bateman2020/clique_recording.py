"""A rerun recording of a sensor that passes objects in space: what it sees, and what is believed of them.

Needs rerun-sdk (extra `evermap[rerun]`). The timeline is `step`; whole columns are sent at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evermap.types import BoolArray, FloatArray, IntArray
from evermap.viz.rerun_scene import require_rerun, rgb
from evermap.viz.style import ALERT, ESTIMATE, MUTED, PAPER

TIMELINE = "step"


def log_clique_run(
    path: str | Path,
    *,
    position_m: FloatArray,
    rotation: FloatArray,
    landmark_m: FloatArray,
    clique: IntArray,
    detected: BoolArray,
    belief: FloatArray,
    there: BoolArray,
    field_outline_m: FloatArray,
) -> Path:
    """Writes `path` (.rrd): sensor with its field, landmarks coloured by belief, rays of detections, true objects.

    A landmark is blue where its clique is believed to be there, pale where that is undecided, orange where it is
    believed to be gone, and grey before its clique's birth. The box around a clique is there as long as the object is.

    Args:
        path: of the file.
        position_m: (F, 3) of the sensor, true.
        rotation: (F, 3, 3) from the sensor's frame to the world's, true.
        landmark_m: (K, 3).
        clique: (K,) which clique each landmark belongs to, 0 to C - 1.
        detected: (F, K).
        belief: (F, C) posterior of persistence; nan before the birth.
        there: (F, C) whether each object truly exists.
        field_outline_m: (N, P, 3) lines in the sensor's frame, as of `worlds.sensors.outline`.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """
    require_rerun()
    import rerun as rr

    path = Path(path)
    stream = rr.RecordingStream("evermap", recording_id=path.stem, send_properties=False)
    stream.save(path, default_blueprint=_blueprint(belief.shape[1]))
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    steps = rr.TimeColumn(TIMELINE, sequence=range(len(position_m)))
    _send_sensor(stream, steps, position_m, rotation, field_outline_m)
    _send_landmarks(stream, steps, landmark_m, belief[:, clique])
    _send_rays(stream, steps, position_m, landmark_m, detected)
    _send_objects(stream, landmark_m, clique, there)
    _send_beliefs(stream, steps, belief, there)
    stream.flush()
    stream.disconnect()
    return path


def belief_colours(belief: FloatArray) -> NDArray[np.uint8]:
    """(..., 3) from orange (0) over pale (0.5) to blue (1); grey for nan."""
    gone, unsure, there = (np.array(rgb(colour), dtype=np.float64) for colour in (ALERT, PAPER, ESTIMATE))
    share = np.nan_to_num(2.0 * belief[..., None] - 1.0)
    mixed = unsure + np.maximum(share, 0.0) * (there - unsure) + np.maximum(-share, 0.0) * (gone - unsure)
    return np.where(np.isnan(belief)[..., None], rgb(MUTED), np.round(mixed)).astype(np.uint8)


def _blueprint(cliques: int) -> Any:
    import rerun.blueprint as rrb

    plots = [rrb.TimeSeriesView(name=f"clique {c}: belief and truth", origin=f"clique/{c}") for c in range(cliques)]
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Spatial3DView(name="world", origin="world"), rrb.Vertical(*plots), column_shares=[5, 3]),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _send_sensor(
    stream: Any, steps: Any, position_m: FloatArray, rotation: FloatArray, field_outline_m: FloatArray
) -> None:
    import rerun as rr

    stream.log(
        "world/path", rr.LineStrips3D([position_m.astype(np.float32)], colors=rgb(MUTED), radii=0.015), static=True
    )
    places = rr.Transform3D.columns(translation=position_m, mat3x3=rotation)
    stream.send_columns("world/sensor", [steps], places)
    outline = rr.LineStrips3D(field_outline_m.astype(np.float32), colors=rgb(MUTED), radii=0.01)
    stream.log("world/sensor/field", outline, static=True)
    forward = rr.Arrows3D(vectors=[[1.0, 0.0, 0.0]], colors=rgb(ESTIMATE), radii=0.04)
    stream.log("world/sensor/forward", forward, static=True)


def _send_landmarks(stream: Any, steps: Any, landmark_m: FloatArray, belief: FloatArray) -> None:
    import rerun as rr

    stream.log("world/landmarks", rr.Points3D(landmark_m, radii=0.1), static=True)
    colours = rr.Points3D.columns(colors=belief_colours(belief).reshape(-1, 3))
    stream.send_columns("world/landmarks", [steps], colours.partition(lengths=np.full(len(belief), len(landmark_m))))


def _send_rays(stream: Any, steps: Any, position_m: FloatArray, landmark_m: FloatArray, detected: BoolArray) -> None:
    """A line from the sensor to each landmark that was detected; in a step without any the old ones go."""
    import rerun as rr

    step, landmark = np.nonzero(detected)
    rays = np.stack([position_m[step], landmark_m[landmark]], axis=1).astype(np.float32)
    columns = rr.LineStrips3D.columns(strips=rays).partition(lengths=detected.sum(axis=1))
    stream.send_columns("world/detections", [steps], columns)
    stream.log("world/detections", rr.LineStrips3D.from_fields(colors=rgb(ALERT), radii=0.012), static=True)


def _send_objects(stream: Any, landmark_m: FloatArray, clique: IntArray, there: BoolArray) -> None:
    """The box around a clique's landmarks, until the first step in which the object is gone."""
    import rerun as rr

    for c in range(there.shape[1]):
        low, high = landmark_m[clique == c].min(axis=0), landmark_m[clique == c].max(axis=0)
        box = rr.Boxes3D(centers=[0.5 * (low + high)], half_sizes=[0.5 * (high - low)], colors=rgb(MUTED))
        stream.set_time(TIMELINE, sequence=0)
        stream.log(f"world/objects/{c}", box)
        gone = np.flatnonzero(~there[:, c])
        if len(gone):
            stream.set_time(TIMELINE, sequence=int(gone[0]))
            stream.log(f"world/objects/{c}", rr.Clear(recursive=False))
    stream.reset_time()


def _send_beliefs(stream: Any, steps: Any, belief: FloatArray, there: BoolArray) -> None:
    import rerun as rr

    for c in range(belief.shape[1]):
        for name, values, colour in (("truth", there[:, c], MUTED), ("belief", belief[:, c], ESTIMATE)):
            entity = f"clique/{c}/{name}"
            stream.log(entity, rr.SeriesLines(colors=rgb(colour), widths=1.5), static=True)
            stream.send_columns(entity, [steps], rr.Scalars.columns(scalars=values.astype(np.float64)))
