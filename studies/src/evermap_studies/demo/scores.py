"""Accuracy of a map after a session: poses, claims of what is there, their probabilities, and the forecast.

Poses are compared with the true path in the map's frame, which one SE(2) alignment on the path of the first session
ties to the truth for good; a map that creeps away is wrong. A second number aligns every path by itself. The rest is
counted as in `worlds.scores`: claims, and the statements 'the landmark stands where it was last detected', about
now, and as a forecast about the next session.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from evermap.geometry import se2
from evermap.metrics.trajectory import align_poses, interpolate, scored_stamps
from evermap.types import FloatArray, IntArray, Landmarks, Trajectory
from evermap_studies.demo.truth import Truth
from evermap_studies.worlds.scores import Existence, existence_score, stands_at, statement_score

SCORED_HZ = 2.0
SURE = 0.9
"""Claims from this probability on are counted a second time, by themselves."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What a map said after a session, in its own frame.

    Attributes:
        landmarks: every landmark at its most probable place.
        place_id: (P,) landmark of every place that it knew.
        place_m: (P, 2) where that is.
        p_now, p_next: (P,) probability that the landmark stands there, and that it will when the next session begins.
        n_sites: ways in which bodies stand or stood.
    """

    landmarks: Landmarks
    place_id: IntArray
    place_m: FloatArray
    p_now: FloatArray
    p_next: FloatArray
    n_sites: int


@dataclass(frozen=True, slots=True)
class Counts:
    """Counts of one session, or sums of many.

    Attributes:
        n_poses, pose_error2_m2, own_error2_m2: scored poses, sum of their squared errors in the map's frame, and after
            an alignment of their own.
        n_lost: sessions that were not found in the map; their poses are not counted.
        existence: what the map says is there now.
        sure: its claims with a probability of at least `SURE`.
        known: the same claims against what stands where it was really looked at.
        forecast: what it says of the next session.
        as_is: the same of the forecast that all stays as it truly is.
        n_come_true: statements that are so in the next session.
    """

    n_poses: int = 0
    pose_error2_m2: float = 0.0
    own_error2_m2: float = 0.0
    n_lost: int = 0
    existence: Existence = field(default_factory=Existence)
    sure: Existence = field(default_factory=Existence)
    known: Existence = field(default_factory=Existence)
    forecast: Existence = field(default_factory=Existence)
    as_is: Existence = field(default_factory=Existence)
    n_come_true: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(getattr(self, item.name) + getattr(other, item.name) for item in fields(self)))


def alignment_of(path: Trajectory, truth: Trajectory) -> FloatArray:
    """(3,) pose of the map in the frame of the truth, by the path of one session."""
    poses, real = _at_same_stamps(path, truth)
    return align_poses(poses, real)[0]


def pose_errors(path: Trajectory, truth: Trajectory, pose_truth_map: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(K,) position errors in the map's frame, and after an alignment of their own."""
    poses, real = _at_same_stamps(path, truth)
    fixed, own = (
        np.linalg.norm(se2.transform(pose, poses[:, :2]) - real[:, :2], axis=1)
        for pose in (pose_truth_map, align_poses(poses, real)[0])
    )
    return fixed, own


def _at_same_stamps(path: Trajectory, truth: Trajectory) -> tuple[FloatArray, FloatArray]:
    rows = scored_stamps(truth, path.stamp_s[0], path.stamp_s[-1], SCORED_HZ)
    poses, _, _ = interpolate(path, truth.stamp_s[rows])
    return poses, truth.pose_world_robot[rows]


def pose_counts(path: Trajectory, truth: Trajectory, pose_truth_map: FloatArray, *, found: bool = True) -> Counts:
    """Where the map had the robot during a session; `found` is False where the session was not found in the map."""
    if not found:
        return Counts(n_lost=1)
    fixed, own = pose_errors(path, truth, pose_truth_map)
    return Counts(len(fixed), float(fixed @ fixed), float(own @ own))


def map_counts(snapshot: Snapshot, truth: Truth, session: int, pose_truth_map: FloatArray) -> Counts:
    """What the map said after a session, against the truth of that session and of the next."""
    now, asked = truth.landmarks(session), truth.asked(session)

    def said(p_here: FloatArray, when: Landmarks) -> Existence:
        places = (snapshot.place_id, snapshot.place_m, p_here)
        return statement_score(asked, when, *places, pose_truth_map=pose_truth_map)

    claims = existence_score(snapshot.landmarks, now, pose_truth_map=pose_truth_map)
    counts = Counts(
        existence=claims + said(snapshot.p_now, now),
        sure=existence_score(snapshot.landmarks, now, pose_truth_map=pose_truth_map, p_least=SURE),
        known=existence_score(snapshot.landmarks, truth.landmarks(session, known=True), pose_truth_map=pose_truth_map),
    )
    if session + 1 == len(truth):
        return counts
    then = truth.landmarks(session + 1)
    return counts + Counts(
        forecast=said(snapshot.p_next, then),
        as_is=statement_score(asked, then, now.landmark_id, now.position_m, np.ones(len(now))),
        n_come_true=int(stands_at(asked, then).sum()),
    )
