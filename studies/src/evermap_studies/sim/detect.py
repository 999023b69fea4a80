"""What the sensor reports along a drive: hits, misses and faults of a range-bearing sensor.

All noise is drawn for every pair of landmark and frame, seen or not, landmark by landmark. So neither a change of the
world nor a newcomer (whose id is larger) shifts the noise of anything else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.geometry import se2
from evermap.types import UNKNOWN, BoolArray, Detections, FloatArray, IntArray
from evermap_studies.sim.building import FloorPlan
from evermap_studies.sim.config import SimulatedSensor


@dataclass(frozen=True, slots=True)
class Scene:
    """The landmarks of a building during one session.

    Attributes:
        position_m: (L, 2) row = landmark id; nan where a landmark is not there.
        class_id: (L,).
        n_known: identities below this are the ones that the front end confuses and imagines (those of day 0).
    """

    position_m: FloatArray
    class_id: IntArray
    n_known: int


def in_view(
    pose_world_sensor: FloatArray, scene: Scene, plan: FloorPlan, config: SimulatedSensor
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return which landmarks (rows) are in view of which sensor poses (columns).

    Args:
        pose_world_sensor: (F, 3).
        scene: landmarks that are there.
        plan: walls.
        config: limits.

    Returns:
        (L, F) within range, field of view and line of sight; true ranges (L, F); true bearings (L, F).
    """
    away = scene.position_m[:, None, :] - pose_world_sensor[None, :, :2]
    range_m = np.hypot(away[..., 0], away[..., 1])
    bearing_rad = se2.wrap(np.arctan2(away[..., 1], away[..., 0]) - pose_world_sensor[:, 2])
    visible = (range_m >= config.range_min_m) & (range_m <= config.range_max_m)  # False for nan
    visible &= np.abs(bearing_rad) <= config.field_of_view_rad / 2
    landmark, frame = np.nonzero(visible)
    visible[landmark, frame] = plan.line_of_sight(pose_world_sensor[frame, :2], scene.position_m[landmark])
    return visible, range_m, bearing_rad


def sticky_uniform(rng: np.random.Generator, rows: int, columns: int, stickiness: float) -> FloatArray:
    """Draw (rows, columns) uniform numbers, each equal to its left neighbour with the given probability, else fresh."""
    fresh = rng.random((rows, columns, 2))
    renewed = fresh[..., 1] >= stickiness
    renewed[:, 0] = True
    origin = np.maximum.accumulate(np.where(renewed, np.arange(columns), 0), axis=1)
    return np.asarray(np.take_along_axis(fresh[..., 0], origin, axis=1))


def detect(
    pose_world_robot: FloatArray, scene: Scene, plan: FloorPlan, config: SimulatedSensor, seed: np.random.SeedSequence
) -> tuple[Detections, IntArray]:
    """Simulate detections, one frame a robot pose (F, 3), sorted by frame, then by true landmark.

    Returns:
        The detections, and (M,) the landmark that each truly came from, `UNKNOWN` for one of nothing.
    """
    hit_rng, noise_rng, identity_rng, false_rng = (np.random.default_rng(child) for child in seed.spawn(4))
    shape = (len(scene.position_m), len(pose_world_robot))
    pose = se2.compose(pose_world_robot, np.array(config.mount_robot_sensor))
    visible, range_m, bearing_rad = in_view(pose, scene, plan, config)
    fate = sticky_uniform(hit_rng, *shape, config.stickiness)
    noise = noise_rng.standard_normal((*shape, 2))
    identity = identity_rng.random((*shape, 3))
    with np.errstate(invalid="ignore"):  # nan ranges of absent landmarks
        hit = visible & (fate < config.detection_probability(range_m))

    frame, truth = np.nonzero(hit.T)
    pick = truth, frame
    ranges = config.reported_range(range_m[pick], bearing_rad[pick]) + config.sigma_range_m * noise[pick][:, 0]
    bearings = bearing_rad[pick] + config.bearing_bias_rad + config.sigma_bearing_rad * noise[pick][:, 1]
    swap, blank, which = identity[pick].T
    other = (which * (scene.n_known - 1)).astype(np.int64)
    other += other >= truth  # any identity but its own
    wrong = (swap < config.p_wrong_identity) & (other < scene.n_known) & (scene.n_known > 1)
    landmark = np.where(wrong, other, truth)
    landmark[blank < config.p_no_identity] = UNKNOWN

    # detections of nothing
    u = false_rng.random((shape[1], 4))
    ghost = np.flatnonzero(u[:, 0] < config.p_false)
    ghost_range = config.range_min_m + u[ghost, 1] * (config.range_max_m - config.range_min_m)
    ghost_bearing = (u[ghost, 2] - 0.5) * config.field_of_view_rad
    ghost_landmark = (u[ghost, 3] * scene.n_known).astype(np.int64)

    frame, truth = np.append(frame, ghost), np.append(truth, np.full(len(ghost), UNKNOWN))
    ranges, bearings = np.append(ranges, ghost_range), np.append(bearings, ghost_bearing)
    landmark = np.append(landmark, ghost_landmark)
    # a range of zero or less is no detection (only where the noise is as large as the smallest range)
    keep = np.flatnonzero(ranges > 0.0)
    rows = keep[np.argsort(frame[keep], kind="stable")]
    count = len(rows)
    detections = Detections(
        frame=frame[rows],
        landmark_id=landmark[rows],
        range_m=ranges[rows],
        bearing_rad=np.asarray(se2.wrap(bearings[rows])),
        class_id=np.where(landmark[rows] == UNKNOWN, UNKNOWN, scene.class_id[landmark[rows]]),
        sigma_range_m=np.full(count, np.nan),
        sigma_bearing_rad=np.full(count, np.nan),
        source_line=np.zeros(count, dtype=np.int64),
    )
    return detections, truth[rows]
