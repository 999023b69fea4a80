"""Scores of one session: the map and the path against the truth, in the frame that the first session gave the map.

The map's frame is tied to the truth once: by the SE(2) motion that brings the landmarks of the first session's map onto
the true ones. A map that creeps away later is wrong. The pose error after an alignment of its own tells how much of an
error is that.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.geometry import se2
from evermap.metrics.summary import RATE_HZ
from evermap.metrics.trajectory import align_points, evaluate_trajectory
from evermap.types import ChangeKind, FloatArray, Landmarks
from evermap_studies.changes import ChangeCounts, count_changes
from evermap_studies.demo.study import snapshot_of
from evermap_studies.lifelong.world import World
from evermap_studies.worlds.scores import existence_score, statement_score

if TYPE_CHECKING:
    from evermap.config import LivingConfig
    from evermap.maps.living import LivingMap
    from evermap.maps.sessions.session import Session

Row = dict[str, Any]

KINDS = (ChangeKind.MOVED, ChangeKind.VANISHED, ChangeKind.RETURNED, ChangeKind.APPEARED)
NOTHING: Row = {
    "failure": None,
    "placed": False,
    **dict.fromkeys(
        (
            "pose_rmse_m", "pose_own_rmse_m", "landmark_rmse_m", "existence", "forecast", "changes", "landmarks",
            "places", "sites", "cpu_s", "step_p50_ms", "step_p99_ms",
        )
    ),
}  # fmt: skip
"""All scores of a session, none of them known."""


def alignment_of(living: LivingMap, world: World) -> FloatArray:
    """(3,) pose of the map in the frame of the truth, by the landmarks of the first session.

    Raises:
        DataError: fewer than two of them are in the map.
    """
    mine, true = _common(living.landmarks(), world.landmarks(0))
    return align_points(mine, true)


def session_scores(
    session: Session, world: World, number: int, pose_truth_map: FloatArray, config: LivingConfig, p_least: float
) -> Row:
    """Plain JSON values.

    Args:
        session: what came out.
        world: what was so.
        number: of the session, from 0.
        pose_truth_map: (3,) of `alignment_of`.
        config: with which the map lives.
        p_least: a landmark is claimed from this probability on.
    """
    living, slam = session.living, session.slam
    placed = session.found
    return {
        **NOTHING,
        "placed": placed,
        "pose_rmse_m": _fixed(session, world, number, pose_truth_map) if placed else None,
        "pose_own_rmse_m": _own(session, world, number),
        "landmark_rmse_m": landmark_rmse_m(living.landmarks(p_least=p_least), world.landmarks(number), pose_truth_map),
        **_existence(living, world, number, pose_truth_map, config, p_least),
        "changes": changes_found(session, world, number) if number else None,
        "landmarks": len(living.members),
        "places": len(living.places),
        "sites": len(living.sites),
        "step_p50_ms": float(np.percentile(1e3 * slam.step_s, 50)),
        "step_p99_ms": float(np.percentile(1e3 * slam.step_s, 99)),
    }


def changes_found(session: Session, world: World, number: int) -> dict[str, list[int]]:
    """Landmarks (found, true, right) by kind of change, and of all kinds together."""
    true = world.changes(number)
    wanted = [("all", None), *((kind.value, kind) for kind in KINDS)]
    return {name: list(asdict(count_changes(session.changes, true, kind)).values()) for name, kind in wanted}


def change_counts(rows: list[Row], kind: str = "all") -> ChangeCounts:
    """Counts of many sessions together."""
    counts = (ChangeCounts(*row["changes"][kind]) for row in rows if row["changes"] is not None)
    return sum(counts, start=ChangeCounts())


def landmark_rmse_m(claimed: Landmarks, truth: Landmarks, pose_truth_map: FloatArray) -> float | None:
    """Over the landmarks that are there and that the map believes in, however far off; None if there is none."""
    mine, true = _common(claimed, truth)
    if len(mine) == 0:
        return None
    error = se2.transform(pose_truth_map, mine) - true
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def _common(estimate: Landmarks, truth: Landmarks) -> tuple[FloatArray, FloatArray]:
    """(C, 2) positions of the landmarks that are in both."""
    _, mine, theirs = np.intersect1d(estimate.landmark_id, truth.landmark_id, return_indices=True)
    return estimate.position_m[mine], truth.position_m[theirs]


def _fixed(session: Session, world: World, number: int, pose_truth_map: FloatArray) -> float | None:
    """Pose RMSE in the map's frame."""
    truth = world.recordings[number].truth
    assert truth is not None
    path = session.slam.trajectory
    placed = replace(path, pose_world_robot=se2.compose(pose_truth_map, path.pose_world_robot), frame="truth")
    errors = evaluate_trajectory(placed, truth, rate_hz=RATE_HZ, align=False)
    return None if errors is None else errors.rmse_m


def _own(session: Session, world: World, number: int) -> float | None:
    truth = world.recordings[number].truth
    assert truth is not None
    errors = evaluate_trajectory(session.slam.trajectory, truth, rate_hz=RATE_HZ)
    return None if errors is None else errors.rmse_m


def _existence(
    living: LivingMap, world: World, number: int, pose_truth_map: FloatArray, config: LivingConfig, p_least: float
) -> Row:
    """What the map says of now, and of the beginning of the next session; no forecast after the last."""
    is_last = number + 1 == len(world)
    until_s = np.nan if is_last else float(world.recordings[number + 1].frames.stamp_s[0])
    said = snapshot_of(living, config, until_s)
    asked, place = world.asked(number), (said.place_id, said.place_m)
    claims = existence_score(said.landmarks, world.landmarks(number), pose_truth_map=pose_truth_map, p_least=p_least)
    now = statement_score(asked, world.landmarks(number), *place, said.p_now, pose_truth_map=pose_truth_map)
    if is_last:
        return {"existence": asdict(claims + now), "forecast": None}
    then = statement_score(asked, world.landmarks(number + 1), *place, said.p_next, pose_truth_map=pose_truth_map)
    return {"existence": asdict(claims + now), "forecast": asdict(then)}
