"""Trees in rows, at equal distances: by geometry alone one is as good as its neighbour."""

from __future__ import annotations

import numpy as np

from evermap.geometry import se2
from evermap.types import UNKNOWN, Detections, Frames, Landmarks, Odometry, Recording, Sensor, SensorKind, Trajectory

APART_M, LONG_M, REACH_M, AHEAD_RAD = 2.0, 40.0, 6.0, 1.22
SIGMA, P_SEEN = (0.03, 0.01), 0.9
SPEED_MPS, ODOMETRY_S, PER_FRAME = 0.7, 0.1, 5
SPEED_SCALE, SIGMA_MPS, SIGMA_RADPS = 1.03, 0.03, 0.005
TURN_RADPS, HALF_TURN_RAD = 0.5, 3.1


def orchard(seed: int, *, until_s: float = 240.0) -> Recording:
    """A laser goes down a lane between two rows of twenty trees, comes back along the third, and leaves."""
    rng = np.random.default_rng([seed, 60])
    along, row = np.meshgrid(np.arange(APART_M, LONG_M + 1.0, APART_M), [-2.0, 2.0, 6.0])
    tree = np.column_stack([along.ravel(), row.ravel()]) + rng.normal(0.0, 0.05, (along.size, 2))
    stamp_s = np.arange(0.0, until_s, ODOMETRY_S)
    lane_s = (LONG_M + 3.4) / SPEED_MPS
    turning = (stamp_s >= lane_s) & (stamp_s < lane_s + HALF_TURN_RAD / TURN_RADPS)
    turn = np.where(turning, TURN_RADPS, 0.0)
    step = np.column_stack([np.full(len(stamp_s), SPEED_MPS), np.zeros(len(stamp_s)), turn]) * ODOMETRY_S
    pose = [np.zeros(3)]
    for one in step[:-1]:
        pose.append(se2.compose(pose[-1], se2.exp(one)))
    frame = np.arange(0, len(stamp_s), PER_FRAME)
    true = np.array(pose)[frame]
    seen = se2.transform(se2.inverse(true)[:, None], tree)
    reach, bearing = np.hypot(seen[..., 0], seen[..., 1]), np.arctan2(seen[..., 1], seen[..., 0])
    inside = (reach < REACH_M) & (np.abs(bearing) < AHEAD_RAD) & (rng.random(reach.shape) < P_SEEN)
    of, which = np.nonzero(inside)
    reading = np.column_stack([reach[inside], bearing[inside]]) + rng.normal(0.0, SIGMA, (len(of), 2))
    none, unknown = np.zeros(len(of), dtype=np.int64), np.full(len(of), np.nan)
    detections = Detections(of, which, *reading.T, none + UNKNOWN, unknown, unknown, none)
    odometry = Odometry(
        stamp_s,
        SPEED_SCALE * SPEED_MPS + rng.normal(0.0, SIGMA_MPS, len(stamp_s)),
        np.zeros(len(stamp_s)),
        turn + rng.normal(0.0, SIGMA_RADPS, len(stamp_s)),
    )
    return Recording(
        name=f"orchard, seed {seed}",
        odometry=odometry,
        frames=Frames(stamp_s[frame]),
        detections=detections,
        sensor=Sensor(
            range_max_m=REACH_M, bearing_min_rad=-AHEAD_RAD, bearing_max_rad=AHEAD_RAD, kind=SensorKind.LASER
        ),
        truth=Trajectory(stamp_s[frame], true, np.zeros((len(true), 3, 3)), frame="truth"),
        true_landmarks=Landmarks.at(np.arange(len(tree)), tree),
        source="tests",
    )
