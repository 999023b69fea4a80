"""What was really so, session by session, and what of it could be known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray, Landmarks
from evermap_studies.sim import BuildingSimulation, LookedAt, looked_at
from evermap_studies.sim.world import positions_at
from evermap_studies.worlds.scores import NEAR_M


@dataclass(frozen=True, slots=True)
class Truth:
    """S sessions and the L landmarks that were ever there; row of a landmark = its id.

    The building stands still while the robot patrols, so that a session has one truth.

    Attributes:
        position_m: (S, L, 2) where it stands, nan while it is away.
        seen_m: (S, L, 2) where it was last detected, in this session or before; nan before that.
        detected: (S, L) whether it was detected under its own name in this session.
        changed: (S, L) whether it came, left or moved since the session before; in the first session nothing did.
        known: (S, L) whether it stands where it was really looked at since it came there.
        knowable: (N, 4) changes that can be known, one row each: landmark; the first session after the one in which
            the old state was last seen; the session in which the new one was really looked at; the session before
            which it has to be told, because the next change of this landmark can be known then.
    """

    position_m: FloatArray
    seen_m: FloatArray
    detected: BoolArray
    changed: BoolArray
    known: BoolArray
    knowable: IntArray

    def __len__(self) -> int:
        return len(self.position_m)

    @property
    def there(self) -> BoolArray:
        """(S, L) whether it stands somewhere."""
        return np.isfinite(self.position_m[:, :, 0])

    def landmarks(self, session: int, *, known: bool = False) -> Landmarks:
        """All that stands in the building during a session; or only what stands where it was really looked at."""
        name = np.flatnonzero(self.there[session] & (self.known[session] | (not known)))
        return Landmarks.at(name, self.position_m[session, name])

    def asked(self, session: int) -> Landmarks:
        """All that was ever detected until then, where that was last."""
        name = np.flatnonzero(np.isfinite(self.seen_m[session, :, 0]))
        return Landmarks.at(name, self.seen_m[session, name])


def truth_of(building: BuildingSimulation) -> Truth:
    """The truth of every session of a building."""
    position_m = np.stack([positions_at(building.objects, building.stays, truth.start_s) for truth in building.truths])
    detected = np.stack([_hits(building, session) > 0 for session in range(len(building.sessions))])
    seen_m, changed = np.where(detected[:, :, None], position_m, np.nan), np.zeros(detected.shape, dtype=np.bool_)
    for k in range(1, len(position_m)):
        unseen = ~detected[k]
        seen_m[k, unseen] = seen_m[k - 1, unseen]
        away = np.isnan(position_m[k, :, 0])
        stays = np.all(position_m[k] == position_m[k - 1], axis=-1) | (away & np.isnan(position_m[k - 1, :, 0]))
        changed[k] = ~stays
    known, knowable = observed(looked_at(building), building.n_landmarks)
    return Truth(position_m, seen_m, detected, changed, known, knowable)


def _hits(building: BuildingSimulation, session: int) -> IntArray:
    """(L,) detections of every landmark that carry its own name."""
    really = building.truths[session].detection_landmark_id
    named = building.sessions[session].detections.landmark_id
    return np.bincount(named[(really == named) & (named >= 0)], minlength=building.n_landmarks)


def observed(looks: LookedAt, n_landmarks: int) -> tuple[BoolArray, IntArray]:
    """What an observer knows who sees whatever is really looked at, and nothing else.

    Returns:
        (S, L) whether it knows where the landmark stands, and `Truth.knowable`.
    """
    known = np.zeros((len(looks.present), n_landmarks), dtype=np.bool_)
    knowable: list[list[int]] = []
    for name in np.unique(looks.landmark_id).tolist():
        rows = np.flatnonzero(looks.landmark_id == name)
        mine = looks.present[:, rows], looks.looked_at[:, rows], looks.position_m[rows]
        known[:, name], changes = _observed_one(*mine)
        until = [*(session for _, session in changes[1:]), len(known)][: len(changes)]
        knowable += [[name, *change, end] for change, end in zip(changes, until, strict=True)]
    return known, np.array(knowable, dtype=np.int64).reshape(-1, 4)


def _observed_one(
    present: BoolArray, looked: BoolArray, position_m: FloatArray
) -> tuple[BoolArray, list[tuple[int, int]]]:
    """One landmark with P places: (S,) whether it is known where it stands; and (first session, session) of changes.

    A change is known where the old state was seen and then the new one: at another place, gone, or come to a place
    that had been seen empty.
    """
    near = np.linalg.norm(position_m[:, None] - position_m[None], axis=-1) <= NEAR_M
    known = np.zeros(len(present), dtype=np.bool_)
    changes: list[tuple[int, int]] = []
    at, ever, since = UNKNOWN, False, 0  # where it was seen last; whether it ever was; when its state was seen last
    empty = np.full(present.shape[1], UNKNOWN, dtype=np.int64)  # session in which the place was last seen empty
    for k in range(len(present)):
        here = np.flatnonzero(present[k] & looked[k])
        if len(here):
            place = int(here[0])
            if at == UNKNOWN and (ever or empty[place] != UNKNOWN):
                changes.append((since + 1 if ever else int(empty[place]) + 1, k))
            elif at != UNKNOWN and not near[at, place]:
                changes.append((since + 1, k))
            at, ever, since = place, True, k
        elif at != UNKNOWN and looked[k, at] and not (present[k] & near[at]).any():
            changes.append((since + 1, k))
            at, since = UNKNOWN, k
        empty[looked[k] & ~present[k]] = k
        known[k] = at != UNKNOWN and bool((present[k] & near[at]).any())
    return known, changes
