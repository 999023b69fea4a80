"""What a robot with two cameras records of the building on one day: pixels of tags, poses of objects, odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from evermap.types import (
    BoolArray,
    Clock,
    FloatArray,
    Frames,
    IntArray,
    Landmarks,
    Recording,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
)
from evermap_studies.building.world import CORRIDOR_M, KINDS, LENGTH_M, ROOM_CENTRES, World

DAY_S = 86_400.0
FOCAL, CENTRE = 420.0, (400.0, 300.0)
SIZE_M, SIGMA_PX = 0.16, 0.4
SQUARE = 0.5 * SIZE_M * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
RANGE_M, MOST_P = 6.5, 0.95
"""Nothing is detected from farther away; where it is seen best it is detected this often."""
FLATTEST, FULL = 0.2, 0.6
"""Cosines of incidence at which a tag is never detected, and from which on as well as from before."""
P_WRONG = 0.003
"""Share of detections with the identity of another landmark."""
SPEED, STEP_S = 0.9, 0.3
AHEAD = Rotation.from_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
MOUNTS = ((0.2, 0.0, 0.0, AHEAD), (0.0, 0.1, 0.0, Rotation.from_euler("z", np.pi / 2.0) * AHEAD))
"""One camera looks ahead, one to the left."""
DRIFT_M, DRIFT_RAD, SCALE = 0.01, 0.004, 1.01
"""Noise of the odometry by the square root of a second, and its wrong metre."""
OBJECT_M, OBJECT_RAD = (0.01, 0.01), 0.04
"""Noise of objects: constant, by metre of range, and of their orientation."""
N_PEOPLE, GIRTH_M, TALL_M = 6, 0.3, 1.75
LOOKED = 5.0
"""Detections to expect of what was looked at."""


@dataclass(frozen=True, slots=True)
class Patrol:
    """One session.

    Attributes:
        recording: of the robot.
        looked: (P,) places which the robot looked at, whether something stood there or not.
        rooms: that it went through.
    """

    recording: SpatialRecording
    looked: BoolArray
    rooms: tuple[int, ...]


def patrolled(world: World, day: int, seed: int, place: IntArray, at_day: IntArray, by_hand: bool) -> Patrol:
    """Record one day.

    Args:
        world: what stands where.
        day: row of the session.
        seed: of everything random in it.
        place: (P,) landmarks of the places that are asked for.
        at_day: (P,) days on which they stood there.
        by_hand: the cameras are carried, nothing is known of how they moved.
    """
    random = np.random.default_rng([seed, 2, day])
    rooms = _visited(world.door_open[day], random, first=day == 0)
    at, turn = _driven(rooms, random, by_hand)
    stamp_s = np.arange(len(at), dtype=np.float64) * STEP_S
    position, rotation = world.landmarks(day)
    present = np.flatnonzero(np.isfinite(position[:, 0]))
    people = _people(at, random)
    where = [world.landmarks(d) for d in range(len(world.stamp_days))]
    asked_at = np.array([where[d][0][k] for k, d in zip(place, at_day, strict=True)])
    asked_turn = Rotation.concatenate([where[d][1][k] for k, d in zip(place, at_day, strict=True)])
    looked = np.zeros(len(place))
    columns: list[tuple[IntArray, IntArray, IntArray, FloatArray, FloatArray, FloatArray]] = []
    for sensor, (x, y, z, mount) in enumerate(MOUNTS):
        eye, view = at + turn.apply((x, y, z)), turn * mount
        sight = _Sight(eye, view, world, day, people)
        looked += sight.p_detect(asked_at, asked_turn, place).sum(axis=0)
        p = sight.p_detect(position[present], rotation[present], present)
        frame, row = np.nonzero(random.random(p.shape) < p)
        columns.append(_detected(sensor, frame, present[row], position, rotation, eye, view, world.is_tag, random))
    detections = _table(columns, world, random)
    names = tuple(kind.name for kind in KINDS)
    sensors = tuple(
        SpatialSensor(name, (x, y, z, *mount.as_quat().tolist()), (FOCAL, FOCAL, *CENTRE), resolution_px=(800, 600))
        for name, (x, y, z, mount) in zip(("ahead", "left"), MOUNTS, strict=True)
    )
    start_s = float(world.stamp_days[day]) * DAY_S
    pose = np.hstack([at, turn.as_quat()])
    recording = Recording(
        f"day {day + 1}",
        None if by_hand else _odometry(pose, stamp_s, start_s, random),
        Frames(stamp_s + start_s),
        detections,
        sensors=sensors,
        truth=Trajectory(stamp_s + start_s, pose, np.zeros((len(pose), 6, 6)), frame="truth"),
        true_landmarks=Landmarks.in_space(
            present, position[present], rotation=rotation[present].as_quat(), class_id=world.class_id[present],
            class_names=names,
        ),
        class_names=names,
        clock=Clock.UNIX,
    )  # fmt: skip
    return Patrol(recording, looked >= LOOKED, rooms)


def _visited(door_open: BoolArray, random: np.random.Generator, first: bool) -> tuple[int, ...]:
    """Three rooms whose doors are open, in the order of the corridor; the first session sees all."""
    rooms = np.flatnonzero(door_open)
    some = rooms if first else random.permutation(rooms)[:3]
    order = some[np.argsort(ROOM_CENTRES[some, 0], kind="stable")]
    return tuple((order if random.random() < 0.5 else order[::-1]).tolist())


def _driven(rooms: tuple[int, ...], random: np.random.Generator, by_hand: bool) -> tuple[FloatArray, Rotation]:
    """(N, 3) positions and orientations along the corridor and once clockwise around each room."""
    middle = sum(CORRIDOR_M) / 2.0
    xs = [ROOM_CENTRES[room, 0] for room in rooms]
    back = xs[0] > xs[-1]
    way = [(np.clip(xs[0] + (3.5 if back else -3.5), 1.0, LENGTH_M - 1.0), middle)] if xs else []
    for room in rooms:
        x, y = ROOM_CENTRES[room]
        door = 1.0 if y < middle else -1.0
        loop = [(0.0, 1.45), (2.2, 1.45), (2.2, -1.3), (-2.2, -1.3), (-2.2, 1.45), (0.0, 1.45)]
        # from the door, clockwise from above
        turned = [(x + dx * door, y + dy * door) for dx, dy in loop]
        way += [(x, middle), *turned, (x, middle)]
    way.append((np.clip(xs[-1] + (-3.5 if back else 3.5), 1.0, LENGTH_M - 1.0), middle))
    corner = np.array(way) + random.normal(0.0, 0.05, (len(way), 2))
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corner, axis=0), axis=1)))
    s = np.arange(0.0, along[-1], SPEED * STEP_S)
    at = np.column_stack([np.interp(s, along, corner[:, k]) for k in range(2)])
    step = np.gradient(at, axis=0)
    heading = gaussian_filter1d(np.unwrap(np.arctan2(step[:, 1], step[:, 0])), 3.0)
    at = gaussian_filter1d(at, 1.5, axis=0)
    sway = 0.06 if by_hand else 0.01
    wobble = gaussian_filter1d(random.normal(0.0, 1.0, (len(s), 5)), 4.0, axis=0) * 3.5
    height = (1.3 if by_hand else 0.9) + sway * wobble[:, 0]
    turn = Rotation.from_euler("ZYX", np.column_stack([heading + sway * wobble[:, 1], sway * wobble[:, 2:4]]))
    return np.column_stack([at, height]), turn


def _people(at: FloatArray, random: np.random.Generator) -> FloatArray:
    """(N, Q, 2) where people stand and walk, near where the robot comes by."""
    near = at[random.integers(0, len(at), N_PEOPLE), :2] + random.normal(0.0, 1.0, (N_PEOPLE, 2))
    walk = random.normal(0.0, 0.15, (N_PEOPLE, 2)) * (random.random((N_PEOPLE, 1)) < 0.5)
    swing = np.sin(np.arange(len(at))[:, None] * STEP_S / 3.0 + random.uniform(0.0, 6.0, N_PEOPLE))
    return np.asarray(near + 10.0 * walk * swing[..., None])


@dataclass(frozen=True, slots=True)
class _Sight:
    """What one camera can see: (N, 3) positions and orientations, and what stands in the way."""

    eye: FloatArray
    view: Rotation
    world: World
    day: int
    people: FloatArray

    def p_detect(self, at: FloatArray, turn: Rotation, landmark: IntArray) -> FloatArray:
        """(N, P) probability that each would be detected, if it stood there."""
        away = at[None] - self.eye[:, None]
        range_m = np.linalg.norm(away, axis=2)
        own = np.einsum("nji,npj->npi", self.view.as_matrix(), away)
        tag = self.world.is_tag[landmark]
        pixel = FOCAL * own[..., :2] / np.maximum(own[..., 2:], 1e-3) + CENTRE
        margin = np.where(tag, FOCAL * 0.7 * SIZE_M / np.maximum(own[..., 2], 0.1), 0.0)[..., None]
        inside = ((pixel > margin) & (pixel < 2.0 * np.array(CENTRE) - margin)).all(axis=2) & (own[..., 2] > 0.4)
        incidence = np.einsum("npi,pi->np", away, turn.as_matrix()[:, :, 2]) / np.maximum(range_m, 1e-6)
        faced = np.where(tag, np.clip((incidence - FLATTEST) / (FULL - FLATTEST), 0.0, 1.0), 0.9)
        p = MOST_P * np.clip(1.0 - (range_m / RANGE_M) ** 4, 0.0, 1.0) * faced * inside
        frame, row = np.nonzero(p)
        p[frame, row] *= ~self._blocked(frame, at[row], self.world.of[landmark[row]])
        return np.asarray(p)

    def _blocked(self, frame: IntArray, at: FloatArray, thing: IntArray) -> BoolArray:
        """(R,) rays from the camera that meet a wall, a thing other than what they go to, or a person."""
        ends, height, whose = self.world.blocking(self.day)
        eye, ray = self.eye[frame], at - self.eye[frame]
        side, first = ends[:, 1] - ends[:, 0], ends[:, 0][None] - eye[:, None, :2]
        cross = ray[:, None, 0] * side[:, 1] - ray[:, None, 1] * side[:, 0]
        cross = np.where(np.abs(cross) < 1e-9, 1e-9, cross)
        t = (first[..., 0] * side[:, 1] - first[..., 1] * side[:, 0]) / cross
        u = (first[..., 0] * ray[:, None, 1] - first[..., 1] * ray[:, None, 0]) / cross
        low = eye[:, None, 2] + t * ray[:, None, 2] < height
        blocked = (t > 0.0) & (t < 0.999) & (u >= 0.0) & (u <= 1.0) & low & (whose[None] != thing[:, None])
        to = self.people[frame] - eye[:, None, :2]
        flat = np.maximum((ray[:, :2] ** 2).sum(axis=1), 1e-9)
        share = np.clip((to * ray[:, None, :2]).sum(axis=2) / flat[:, None], 0.0, 1.0)
        gap = np.linalg.norm(to - share[..., None] * ray[:, None, :2], axis=2)
        body = (gap < GIRTH_M) & (eye[:, None, 2] + share * ray[:, None, 2] < TALL_M) & (share < 1.0) & (share > 0.0)
        return np.asarray(blocked.any(axis=1) | body.any(axis=1))


def _detected(
    sensor: int,
    frame: IntArray,
    name: IntArray,
    position: FloatArray,
    rotation: Rotation,
    eye: FloatArray,
    view: Rotation,
    is_tag: BoolArray,
    random: np.random.Generator,
) -> tuple[IntArray, IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
    """Frames, sensors, landmarks, corners [px], positions and quaternions by the camera, with noise."""
    back = view[frame].inv()
    corner = np.stack(
        [back.apply(position[name] + rotation[name].apply(np.tile(q, (len(name), 1))) - eye[frame]) for q in SQUARE],
        axis=1,
    )
    pixel = FOCAL * corner[..., :2] / corner[..., 2:] + CENTRE + random.normal(0.0, SIGMA_PX, (len(name), 4, 2))
    at = back.apply(position[name] - eye[frame])
    sigma = OBJECT_M[0] + OBJECT_M[1] * np.linalg.norm(at, axis=1)
    at += sigma[:, None] * random.normal(size=at.shape)
    turn = (back * rotation[name] * Rotation.from_rotvec(random.normal(0.0, OBJECT_RAD, at.shape))).as_quat()
    tag = is_tag[name][:, None]
    return (
        frame, np.full(len(frame), sensor), name, np.where(tag[..., None], pixel, np.nan), np.where(tag, np.nan, at),
        np.where(tag, np.nan, turn),
    )  # fmt: skip


def _table(
    columns: list[tuple[IntArray, IntArray, IntArray, FloatArray, FloatArray, FloatArray]],
    world: World,
    random: np.random.Generator,
) -> SpatialDetections:
    """All detections by time, some with a wrong identity; forklifts state their noise, signs do not."""
    frame, sensor, name, pixel, at, turn = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    order = np.argsort(frame, kind="stable")
    frame, sensor, name, pixel, at, turn = (column[order] for column in (frame, sensor, name, pixel, at, turn))
    said = name.copy()
    wrong = world.is_tag[name] & (random.random(len(name)) < P_WRONG)
    said[wrong] = random.choice(np.flatnonzero(world.is_tag), int(wrong.sum()))
    states = np.array([kind.name == "forklift" for kind in KINDS])[world.class_id[name]]
    sigma = OBJECT_M[0] + OBJECT_M[1] * np.linalg.norm(at, axis=1)
    covariance = np.where(states[:, None, None], sigma[:, None, None] ** 2 * np.eye(3), np.nan)
    count = len(name)
    return SpatialDetections(
        frame=frame,
        sensor=sensor,
        landmark_id=said,
        position_sensor_m=at,
        rotation=turn,
        covariance_sensor_m2=covariance,
        sigma_rad=np.where(states, OBJECT_RAD, np.nan),
        corner_px=pixel,
        tag_size_m=np.where(world.is_tag[name], SIZE_M, np.nan),
        size_m=np.full((count, 3), np.nan),
        class_id=world.class_id[said],
        score=np.full(count, np.nan),
        source_line=np.zeros(count, dtype=np.int64),
    )


def _odometry(pose: FloatArray, stamp_s: FloatArray, start_s: float, random: np.random.Generator) -> SpatialOdometry:
    """Poses in a frame of their own, which drift."""
    at, turn = pose[:, :3], Rotation.from_quat(pose[:, 3:])
    root = np.sqrt(np.diff(stamp_s))[:, None]
    step = SCALE * turn[:-1].inv().apply(np.diff(at, axis=0)) + DRIFT_M * root * random.normal(size=(len(root), 3))
    bend = (turn[:-1].inv() * turn[1:]) * Rotation.from_rotvec(DRIFT_RAD * root * random.normal(size=(len(root), 3)))
    found_at, found = [np.zeros(3)], [Rotation.from_euler("z", random.uniform(-3.0, 3.0))]
    for k in range(len(root)):
        found_at.append(found_at[-1] + found[-1].apply(step[k]))
        found.append(found[-1] * bend[k])
    whole = np.hstack([np.array(found_at), Rotation.concatenate(found).as_quat()])
    return SpatialOdometry(stamp_s + start_s, whole, np.full((len(pose), 6), np.nan))
