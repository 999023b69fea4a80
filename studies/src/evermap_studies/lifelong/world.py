"""Sessions in a world that changes between them, and what was really so: recorded ones with a script, or simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from evermap.io import list_robots
from evermap.types import BoolArray, ChangeKind, FloatArray, IntArray, Landmarks, MapChange, Recording
from evermap_studies.lifelong.script import Script, draw_script
from evermap_studies.mrclam.study import find_dataset
from evermap_studies.nielsen2024.runs import Reference, poses_at, recording_of, reference_of, survey_of
from evermap_studies.worlds.edited import edited, later

DAY_S = 86_400.0
DATASET = 6
"""Of MRCLAM: the one with true poses of all robots."""


@dataclass(frozen=True, slots=True)
class World:
    """S sessions, and the L landmarks that were ever there; it stands still during a session.

    Attributes:
        recordings: one a session, in order of time, with true paths.
        landmark_id: (L,) sorted.
        position_m: (S, L, 2) where it stands, nan while it is away.
        hits: (S, L) detections that carry its name and are of it.
    """

    recordings: tuple[Recording, ...]
    landmark_id: IntArray
    position_m: FloatArray
    hits: IntArray

    def __len__(self) -> int:
        return len(self.recordings)

    @property
    def there(self) -> BoolArray:
        """(S, L) whether it stands somewhere."""
        return np.isfinite(self.position_m[:, :, 0])

    @property
    def last_m(self) -> FloatArray:
        """(S, L, 2) where it stands, or stood in the last session in which it was there; nan before that."""
        last_m = self.position_m.copy()
        for k in range(1, len(last_m)):
            away = np.isnan(last_m[k, :, 0])
            last_m[k, away] = last_m[k - 1, away]
        return last_m

    def landmarks(self, session: int) -> Landmarks:
        """What is there during a session."""
        there = self.there[session]
        return Landmarks.at(self.landmark_id[there], self.position_m[session, there])

    def asked(self, session: int) -> Landmarks:
        """Every landmark that was ever detected until then, where it stands or stood last."""
        met = np.any(self.hits[: session + 1] > 0, axis=0)
        return Landmarks.at(self.landmark_id[met], self.last_m[session, met])

    def changes(self, session: int) -> tuple[MapChange, ...]:
        """What happened since the session before, a landmark each; nothing before the first."""
        if session == 0:
            return ()
        was, is_ = self.there[session - 1], self.there[session]
        ever = self.there[:session].any(axis=0)
        step_m = self.last_m[session] - self.last_m[session - 1]
        kinds = {
            ChangeKind.MOVED: was & is_ & np.any(step_m != 0.0, axis=1),
            ChangeKind.VANISHED: was & ~is_,
            ChangeKind.RETURNED: ~was & is_ & ever,
            ChangeKind.APPEARED: is_ & ~ever,
        }
        stamp_s = float(self.recordings[session].frames.stamp_s[0])
        return tuple(
            MapChange(
                landmark_ids=(int(self.landmark_id[row]),),
                kind=kind,
                stamp_from_s=np.nan,
                stamp_to_s=stamp_s,
                displacement_m=(float(step_m[row, 0]), float(step_m[row, 1])) if is_[row] else (np.nan, np.nan),
                rotation_rad=0.0,
                probability=1.0,
            )
            for kind, rows in kinds.items()
            for row in np.flatnonzero(rows)
        )

    def changed(self, session: int) -> IntArray:
        """Landmarks of `changes`, sorted."""
        return np.array(sorted(change.landmark_ids[0] for change in self.changes(session)), dtype=np.int64)


def recorded_world(data: Path, sessions: int, seed: int) -> World:
    """The robots of MRCLAM 6, again and again, a session a day, landmarks moved between sessions by a seeded script.

    Args:
        data: folder with the MRCLAM recordings.
        sessions: how many.
        seed: of the script.

    Raises:
        InputError: a recording is missing or malformed.
    """
    recordings, references = _recorded(data)
    return scripted(draw_script(survey_of(recordings[0]), sessions, seed), recordings, references)


@lru_cache(maxsize=1)
def _recorded(data: Path) -> tuple[tuple[Recording, ...], tuple[Reference, ...]]:
    """The recordings, and what is needed to edit them."""
    robots = list_robots(find_dataset(data, DATASET))
    recordings = tuple(recording_of(data, DATASET, robot) for robot in robots)
    return recordings, tuple(reference_of(data, DATASET, robot) for robot in robots)


def scripted(script: Script, recordings: Sequence[Recording], references: Sequence[Reference]) -> World:
    """Recordings of a world that stood still, in turn, as if it had been what the script says.

    Args:
        script: what happens.
        recordings: of the same surveyed landmarks.
        references: true path and range law of each.
    """
    sessions = []
    for k in range(len(script)):
        recording, reference = recordings[k % len(recordings)], references[k % len(recordings)]
        # all begin at about the same time of day
        start_s = recordings[0].frames.stamp_s[0] - recording.frames.stamp_s[0]
        poses = poses_at(reference.trajectory, recording.frames.stamp_s)
        changed = edited(recording, poses, survey_of(recording), script.landmarks(k), -np.inf, reference.range_law)
        sessions.append(later(changed, k * DAY_S + float(start_s)))
    hits = np.stack([_hits(session.detections.landmark_id, script.landmark_id) for session in sessions])
    return World(tuple(sessions), script.landmark_id, script.position_m, hits)


def simulated_world(days: int, seed: int) -> World:
    """Four rooms with the furniture of the demonstration, patrolled twice a day in full laps."""
    from evermap_studies.demo.scenario import FURNITURE
    from evermap_studies.sim import BuildingConfig, SimulatedSensor, simulate_building
    from evermap_studies.sim.world import positions_at

    config = BuildingConfig(
        days=days, sessions_per_day=2, patrol_s=110.0, length_m=20.0, depth_m=14.5, rooms_per_side=2,
        classes=FURNITURE, sensor=SimulatedSensor(range_slope=0.0, rate_hz=2.0),
    )  # fmt: skip
    building = simulate_building(config, seed=seed)
    starts = [truth.start_s for truth in building.truths]
    position_m = np.stack([positions_at(building.objects, building.stays, start_s) for start_s in starts])
    ids = np.arange(building.n_landmarks)
    named = [recording.detections.landmark_id for recording in building.sessions]
    really = [truth.detection_landmark_id for truth in building.truths]
    hits = np.stack([_hits(one[one == other], ids) for one, other in zip(named, really, strict=True)])
    return World(building.sessions, ids, position_m, hits)


def _hits(named: IntArray, landmark_id: IntArray) -> IntArray:
    """(L,) how often each is named."""
    return np.array([np.count_nonzero(named == one) for one in landmark_id], dtype=np.int64)
