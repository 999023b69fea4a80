"""Small simulated buildings, and recordings of them that are tampered with."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from evermap.config import CalibrationConfig, Config, LivingConfig, SlamConfig
from evermap.geometry import se2
from evermap.maps.living import LivingMap
from evermap.maps.sessions.session import Session
from evermap.pipeline import run_session
from evermap.types import FloatArray, IntArray, Recording, rows_of
from evermap_studies.sim import (
    BuildingConfig,
    BuildingSimulation,
    Duration,
    ObjectClass,
    SimulatedSensor,
    simulate_building,
)
from evermap_studies.sim.world import positions_at

CLASSES = (
    ObjectClass("marker", "wall", count=6, landmarks=(1, 1)),
    ObjectClass(
        "pallet", count=5, landmarks=(2, 3), size_m=(1.2, 0.8), stay=Duration(2.5), absence=Duration(1.0),
        p_vanish=0.5, p_return=0.8, p_same_place=0.6, arrivals_per_day=0.4,
    ),
    ObjectClass(
        "chair", count=5, landmarks=(1, 2), size_m=(0.5, 0.5), stay=Duration(2.0), absence=Duration(1.0),
        p_vanish=0.3, p_return=0.9, p_nudge=0.6, p_other_room=0.1,
    ),
)  # fmt: skip
FIXED = SlamConfig(calibration=CalibrationConfig(fix={"range_slope": 0.0}))
"""Two rooms tell no metre: the simulated sensor's is true."""


def building(seed: int, *, days: int = 4, change_rate: float = 1.0) -> BuildingSimulation:
    """Two rooms and a corridor, one patrol of a minute a day."""
    config = BuildingConfig(
        days=days,
        patrol_s=60.0,
        change_rate=change_rate,
        length_m=14.0,
        depth_m=13.0,
        rooms_per_side=1,
        classes=CLASSES,
        sensor=SimulatedSensor(range_slope=0.0, rate_hz=2.0),
    )
    return simulate_building(config, seed=seed)


def settings(**living: object) -> Config:
    """The defaults, but for some switches of the living map."""
    return Config(slam=FIXED, living=LivingConfig.model_validate(living))


def lived_through(
    recordings: Iterable[Recording], config: Config | None = None, living: LivingMap | None = None
) -> list[Session]:
    """Session after session into one map."""
    sessions = []
    for recording in recordings:
        sessions.append(run_session(recording, living, config or settings()))
        living = sessions[-1].living
    return sessions


def unseen(recording: Recording, landmark_id: Sequence[int] | IntArray) -> Recording:
    """As if these landmarks had not been there."""
    kept = ~np.isin(recording.detections.landmark_id, landmark_id)
    return replace(recording, detections=rows_of(recording.detections, kept))


def p_exists(living: LivingMap, landmark_id: int) -> float:
    return float(living.p_exists()[living.members.landmark_id == landmark_id][0])


def place_of(living: LivingMap, landmark_id: int) -> tuple[int, FloatArray, FloatArray]:
    """Site, position and covariance of a landmark's most probable place."""
    site = living.site_of()[living.members.landmark_id == landmark_id]
    row = int(living.place_row(np.array([landmark_id]), site)[0])
    return (
        int(site[0]),
        living.places.position_m[row],
        living.covariance_m2[2 * row : 2 * row + 2, 2 * row : 2 * row + 2],
    )


def body_of(living: LivingMap, landmark_id: int) -> list[int]:
    """All landmarks of the body that a landmark belongs to."""
    members = living.members
    mine = members.clique_id == members.clique_id[members.landmark_id == landmark_id]
    return [int(name) for name in members.landmark_id[mine]]


@dataclass(frozen=True, slots=True)
class Truth:
    """Where everything is in every session, in the frame of the first session's first pose.

    Attributes:
        position_m: (S, L, 2), nan where it is not.
        seen: (S, L) whether it was detected, by its name.
    """

    position_m: FloatArray
    seen: np.ndarray

    def since(self, session: int) -> IntArray:
        """(L,) the newest session before this one in which each landmark was detected, -1 for none."""
        before = self.seen[:session]
        return np.where(before.any(axis=0), session - 1 - before[::-1].argmax(axis=0), -1) if session else np.full(
            self.seen.shape[1], -1
        )  # fmt: skip


def truth_of(one: BuildingSimulation) -> Truth:
    first = one.sessions[0].truth
    assert first is not None
    start = se2.inverse(first.pose_world_robot[np.searchsorted(first.stamp_s, one.sessions[0].frames.stamp_s[0])])
    at = [se2.transform(start, positions_at(one.objects, one.stays, told.start_s)) for told in one.truths]
    seen = np.zeros((len(at), one.n_landmarks), dtype=np.bool_)
    for k, (recording, told) in enumerate(zip(one.sessions, one.truths, strict=True)):
        named = recording.detections.landmark_id
        right = named[(named == told.detection_landmark_id) & (named >= 0)]
        seen[k] = np.bincount(right, minlength=one.n_landmarks) >= 2
    return Truth(np.array(at), seen)
