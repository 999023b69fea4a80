"""What was really so, session by session."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.sim import BuildingSimulation
from evermap.sim.world import positions_at
from evermap.types import BoolArray, FloatArray, IntArray, Landmarks


@dataclass(frozen=True, slots=True)
class Truth:
    """S sessions and the L landmarks that were ever there; row of a landmark = its id.

    The building stands still while the robot patrols, so that a session has one truth.

    Attributes:
        position_m: (S, L, 2) where it stands, nan while it is away.
        last_m: (S, L, 2) where it stands, or stood in the last session in which it was there; nan before that.
        met: (S, L) whether it was ever detected, in this session or before.
        changed: (S, L) whether it came, left or moved since the session before; in the first session nothing did.
    """

    position_m: FloatArray
    last_m: FloatArray
    met: BoolArray
    changed: BoolArray

    def __len__(self) -> int:
        return len(self.position_m)

    @property
    def there(self) -> BoolArray:
        """(S, L) whether it stands somewhere."""
        return np.isfinite(self.position_m[:, :, 0])

    def landmarks(self, session: int) -> Landmarks:
        """All that stands in the building during a session."""
        name = np.flatnonzero(self.there[session])
        return Landmarks.at(name, self.position_m[session, name])

    def asked(self, session: int) -> Landmarks:
        """All that was ever detected until then, where it stands or stood last."""
        name = np.flatnonzero(self.met[session] & np.isfinite(self.last_m[session, :, 0]))
        return Landmarks.at(name, self.last_m[session, name])


def truth_of(building: BuildingSimulation) -> Truth:
    """The truth of every session of a building."""
    position_m = np.stack([positions_at(building.objects, building.stays, truth.start_s) for truth in building.truths])
    hits = np.stack([_hits(building, session) for session in range(len(building.sessions))])
    last_m, changed = position_m.copy(), np.zeros(hits.shape, dtype=np.bool_)
    for k in range(1, len(position_m)):
        away = np.isnan(position_m[k, :, 0])
        last_m[k, away] = last_m[k - 1, away]
        stays = np.all(position_m[k] == position_m[k - 1], axis=-1) | (away & np.isnan(position_m[k - 1, :, 0]))
        changed[k] = ~stays
    return Truth(position_m, last_m, met=np.cumsum(hits, axis=0) > 0, changed=changed)


def _hits(building: BuildingSimulation, session: int) -> IntArray:
    """(L,) detections of every landmark that carry its own name."""
    really = building.truths[session].detection_landmark_id
    named = building.sessions[session].detections.landmark_id
    return np.bincount(named[(really == named) & (named >= 0)], minlength=building.n_landmarks)
