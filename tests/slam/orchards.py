"""Trees in rows, at equal distances: by geometry alone one is as good as its neighbour."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.geometry import se2
from evermap.types import (
    UNKNOWN,
    Detections,
    FloatArray,
    Frames,
    Landmarks,
    Odometry,
    Recording,
    Sensor,
    SensorKind,
    Trajectory,
)

LONG_M, REACH_M = 40.0, 6.0
SIGMA = 0.03, 0.01
SPEED_MPS, ODOMETRY_S, PER_FRAME = 0.7, 0.1, 5
TURN_RADPS, HALF_TURN_RAD, ROUND_RAD = 0.5, 3.1, np.pi


@dataclass(frozen=True, slots=True)
class Orchard:
    """What an orchard and its robot are like.

    Attributes:
        apart_m: from a tree to the next in its row; rows are at `row_m`.
        sigma_tree_m: of the places of trees; 0 for a perfect lattice.
        ahead_rad: half the field of view.
        p_seen: probability of a tree in view to be detected.
        no_third: whether every third detection is lost.
        false_share: false detections in view, as a share of true ones.
        speed_scale: of the odometry; sigma_mps, sigma_radps: its noise.
        turn_mps: speed in a turn.
        laps: of a loop around the row in the middle; 0 for one lane and back in the next one, then away.
        radius_m: of the trunks, in turn; none if they are not measured.
        start_m: where the robot begins in its lane; until_s: when it ends, if there is no loop.
    """

    apart_m: float = 2.0
    row_m: tuple[float, ...] = (-2.0, 2.0, 6.0)
    sigma_tree_m: float = 0.05
    ahead_rad: float = 1.22
    p_seen: float = 0.9
    no_third: bool = False
    false_share: float = 0.0
    speed_scale: float = 1.03
    sigma_mps: float = 0.03
    sigma_radps: float = 0.005
    turn_mps: float = SPEED_MPS
    laps: int = 0
    radius_m: tuple[float, ...] = ()
    start_m: float = 0.0
    until_s: float = 240.0


CASE = Orchard(speed_scale=1.02, sigma_mps=0.02, sigma_radps=0.01, turn_mps=1.0)
KINDS = {
    "plain": Orchard(),
    "case": CASE,
    "dense": replace(CASE, apart_m=1.0),
    "false": replace(CASE, false_share=0.15),
    "odometry": replace(CASE, speed_scale=1.03, sigma_mps=0.1, sigma_radps=0.03),
    "third": replace(CASE, no_third=True),
    "narrow": replace(CASE, ahead_rad=0.6),
    "sizes": replace(CASE, radius_m=(0.08, 0.16, 0.08)),
    "lane": replace(CASE, until_s=63.0),
    "loop": replace(CASE, laps=2),
    "worst": replace(CASE, laps=2, apart_m=1.2, false_share=0.1, no_third=True, speed_scale=0.97, sigma_radps=0.03),
}
"""Orchards in which one thing is harder than in the first."""


def orchard(seed: int, kind: Orchard = KINDS["plain"]) -> Recording:
    """A laser goes down a lane between two rows of trees, comes back along the third, and leaves; or goes round."""
    rng = np.random.default_rng([seed, 60])
    along, row = np.meshgrid(np.arange(kind.apart_m, LONG_M + kind.apart_m / 2.0, kind.apart_m), kind.row_m)
    tree = np.column_stack([along.ravel(), row.ravel()]) + rng.normal(0.0, kind.sigma_tree_m, (along.size, 2))
    step = _steps(kind)
    stamp_s = np.arange(len(step)) * ODOMETRY_S
    pose = [np.array([kind.start_m, 0.0, 0.0])]
    for one in step[:-1]:
        pose.append(se2.compose(pose[-1], se2.exp(one * ODOMETRY_S)))
    frame = np.arange(0, len(stamp_s), PER_FRAME)
    true = np.array(pose)[frame]
    seen = se2.transform(se2.inverse(true)[:, None], tree)
    reach, bearing = np.hypot(seen[..., 0], seen[..., 1]), np.arctan2(seen[..., 1], seen[..., 0])
    inside = (reach < REACH_M) & (np.abs(bearing) < kind.ahead_rad) & (rng.random(reach.shape) < kind.p_seen)
    of, which = np.nonzero(inside)
    reading = np.column_stack([reach[inside], bearing[inside]]) + rng.normal(0.0, SIGMA, (len(of), 2))
    odometry = Odometry(
        stamp_s,
        kind.speed_scale * step[:, 0] + rng.normal(0.0, kind.sigma_mps, len(stamp_s)),
        np.zeros(len(stamp_s)),
        step[:, 2] + rng.normal(0.0, kind.sigma_radps, len(stamp_s)),
    )
    if kind.false_share:
        count = int(kind.false_share * len(of))
        of = np.append(of, rng.choice(of, count))
        which = np.append(which, np.full(count, UNKNOWN))
        anywhere = REACH_M * np.sqrt(rng.random(count)), kind.ahead_rad * rng.uniform(-1.0, 1.0, count)
        reading = np.vstack([reading, np.column_stack(anywhere)])
        order = np.argsort(of, kind="stable")
        of, which, reading = of[order], which[order], reading[order]
    if kind.no_third:
        kept = np.arange(len(of)) % 3 != 2
        of, which, reading = of[kept], which[kept], reading[kept]
    none, unknown = np.zeros(len(of), dtype=np.int64), np.full(len(of), np.nan)
    features = None
    if kind.radius_m:
        radius = np.append(np.resize(kind.radius_m, len(tree)), np.mean(kind.radius_m))[which]
        features = radius[:, None] + rng.normal(0.0, 0.015, (len(of), 1))
    detections = Detections(
        of, which, *reading.T, none + UNKNOWN, unknown, unknown, none, features, ("radius_m",) * bool(kind.radius_m)
    )
    return Recording(
        name=f"orchard, seed {seed}",
        odometry=odometry,
        frames=Frames(stamp_s[frame]),
        detections=detections,
        sensor=Sensor(
            range_max_m=REACH_M, bearing_min_rad=-kind.ahead_rad, bearing_max_rad=kind.ahead_rad, kind=SensorKind.LASER
        ),
        truth=Trajectory(stamp_s[frame], true, np.zeros((len(true), 3, 3)), frame="truth"),
        true_landmarks=Landmarks.at(np.arange(len(tree)), tree),
        source="tests",
    )


def _steps(kind: Orchard) -> FloatArray:
    """(T, 3) velocities."""
    ahead, lane_s = np.array([SPEED_MPS, 0.0, 0.0]), (LONG_M + 3.4) / SPEED_MPS
    if kind.laps:
        turning = np.array([2.0 * TURN_RADPS, 0.0, TURN_RADPS])  # into the next lane, 4 m beside
        half = [(ahead, lane_s), (turning, ROUND_RAD / TURN_RADPS)]
        every = [np.tile(step, (round(for_s / ODOMETRY_S), 1)) for step, for_s in half]
        return np.concatenate(every * 2 * kind.laps)
    stamp_s = np.arange(0.0, kind.until_s, ODOMETRY_S)
    turning_now = (stamp_s >= lane_s) & (stamp_s < lane_s + HALF_TURN_RAD / TURN_RADPS)
    return np.where(turning_now[:, None], [kind.turn_mps, 0.0, TURN_RADPS], ahead)
