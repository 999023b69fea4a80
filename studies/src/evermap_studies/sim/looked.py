"""What was really looked at: for every place at which a landmark ever stood, and every session, could it be seen there.

A place is looked at where it lies within range, field of view and a clear line of the sensor in some frame: the same
geometry that made the detections, with the walls, shut doors and the closed wing of that session.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.types import BoolArray, FloatArray, IntArray
from evermap_studies.sim.detect import Scene, in_view
from evermap_studies.sim.world import BuildingSimulation

LOOKED_AT: float = 0.95
"""A place was really looked at where a landmark would have been seen with at least this probability."""


@dataclass(frozen=True, slots=True)
class LookedAt:
    """P places, by object, then in order of first use; S sessions.

    Attributes:
        landmark_id: (P,) whose place it is.
        position_m: (P, 2) where.
        present: (S, P) whether the landmark stood there.
        p_seen: (S, P) probability that it was detected at least once, had it stood there; a lower bound where
            `stickiness` makes misses come in a row.
    """

    landmark_id: IntArray
    position_m: FloatArray
    present: BoolArray
    p_seen: FloatArray

    @property
    def looked_at(self) -> BoolArray:
        """Return (S, P) whether the place was really looked at."""
        return np.asarray(self.p_seen >= LOOKED_AT)


def looked_at(building: BuildingSimulation) -> LookedAt:
    """Return the truth about looks at every place of every landmark of a simulated building."""
    landmark_id, position_m, spans = _places(building)
    start_s = np.array([truth.start_s for truth in building.truths])
    present = np.zeros((len(start_s), len(landmark_id)), dtype=np.bool_)
    for row, from_s, until_s in spans:
        present[:, row] |= (start_s >= from_s) & (start_s < until_s)
    scene = Scene(position_m, np.zeros(len(landmark_id), dtype=np.int64), 0)
    p_seen = np.stack([_p_seen(building, session, scene) for session in range(len(start_s))])
    return LookedAt(landmark_id, position_m, present, p_seen)


def _places(building: BuildingSimulation) -> tuple[IntArray, FloatArray, list[tuple[int, float, float]]]:
    """Landmark and position of every place; and (place, from, until) of every stay of a landmark."""
    row_of: dict[tuple[int, tuple[float, float, float]], int] = {}
    names: list[int] = []
    position_m: list[FloatArray] = []
    spans: list[tuple[int, float, float]] = []
    for stay in building.stays:
        item = building.objects[stay.object_id]
        at_m = item.landmarks_at(stay.pose)
        for name, at in zip(item.landmark_ids, at_m, strict=True):
            row = row_of.setdefault((name, stay.pose), len(names))
            if row == len(names):
                names.append(name)
                position_m.append(at)
            spans.append((row, stay.start_s, stay.end_s))
    return np.array(names, dtype=np.int64), np.array(position_m, dtype=np.float64).reshape(-1, 2), spans


def _p_seen(building: BuildingSimulation, session: int, places: Scene) -> FloatArray:
    """(P,) of one session.

    A frame repeats the draw of the frame before with probability `stickiness`; after a miss it is therefore a hit with
    at least `(1 - stickiness) p`.
    """
    sensor = building.config.sensor
    visible, range_m, _ = in_view(building.truths[session].pose_world_sensor, places, building.plan_in(session), sensor)
    p_hit = np.where(visible, (1.0 - sensor.stickiness) * sensor.detection_probability(range_m), 0.0)
    return np.asarray(1.0 - np.prod(1.0 - p_hit, axis=1))
