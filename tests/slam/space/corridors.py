"""A corridor with square tags on its walls, driven along twice by a robot with a pinhole camera; rotations by scipy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from evermap.config import SpaceConfig
from evermap.geometry import se3
from evermap.slam.space.intake import prepare_space
from evermap.types import (
    Frames,
    Landmarks,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
    rows_of,
)

FOCAL, CENTRE, SIZE_M = 500.0, (320.0, 240.0), 0.2
INTRINSICS = (FOCAL, FOCAL, *CENTRE)
SQUARE = 0.5 * SIZE_M * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
# the camera looks along the robot's left: z ahead is the robot's y, x right its x, y down its -z
MOUNT = Rotation.from_matrix(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]))
MOUNT_AT = np.array([0.1, 0.05, 0.3])
CAMERA = SpatialSensor("left", tuple(np.hstack([MOUNT_AT, MOUNT.as_quat()]).tolist()), INTRINSICS)


@dataclass
class World:
    """What there is, and what a robot records of it."""

    recording: SpatialRecording
    true_pose: np.ndarray
    """(N, 7) in the frame of the tags."""
    tags: Landmarks
    """Where the tags are."""


class Move(NamedTuple):
    """A tag that is moved by `by_m`, and turned about its own vertical axis, at an instant of a drive."""

    tag: int
    at_s: float
    by_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_rad: float = 0.0


def poses(at: np.ndarray, turn: Rotation) -> np.ndarray:
    return np.hstack([at, turn.as_quat()])


def tagged_corridor(
    seed: int,
    *,
    n_tags: int = 12,
    n_frames: int = 160,
    sigma_px: float = 0.3,
    drift: float = 0.01,
    p_wrong: float = 0.0,
    odometry: bool = True,
    rename: dict[int, int] | None = None,
    moves: tuple[Move, ...] = (),
    there_and_back: bool = True,
) -> World:
    """Make a world and a drive through it.

    Args:
        seed: of everything.
        n_tags: along 15 m of wall.
        n_frames: of the drive there and back.
        sigma_px: noise of corners.
        drift: noise of the odometry, metres and a third of that in radians, for each square root of a second.
        p_wrong: share of detections with the identity of another tag.
        odometry: whether there is any.
        rename: identities that tags carry instead of their own.
        moves: tags that are moved during the drive; `World.tags` is where they are before.
        there_and_back: whether the robot returns.
    """
    random = np.random.default_rng(seed)
    place = np.column_stack([np.linspace(0.0, 15.0, n_tags), np.full(n_tags, 2.0), random.uniform(0.0, 0.8, n_tags)])
    # a tag's z points into the wall, away from who looks at it; some are tilted
    facing = MOUNT * Rotation.from_rotvec(random.normal(0.0, 0.25, (n_tags, 3)))
    stamp_s = np.linspace(0.0, 40.0, n_frames)
    along = 7.5 - 8.0 * np.cos((2.0 if there_and_back else 1.0) * np.pi * stamp_s / stamp_s[-1])
    at = np.column_stack([along, 0.3 * np.sin(stamp_s), 0.1 * np.sin(0.7 * stamp_s)])
    turn = Rotation.from_euler(
        "xyz", np.column_stack([0.05 * np.sin(stamp_s), 0.05 * np.cos(stamp_s), 0.2 * np.sin(0.5 * stamp_s)])
    )
    frame, tag, corner = see_corners(at, turn, place, facing)
    for move in moves:
        of = np.arange(n_tags) == move.tag
        turned = facing * Rotation.from_rotvec(of[:, None] * [0.0, move.turn_rad, 0.0])
        there = see_corners(at, turn, place + of[:, None] * np.array(move.by_m), turned)
        old = (tag != move.tag) | (stamp_s[frame] < move.at_s)
        new = (there[1] == move.tag) & (stamp_s[there[0]] >= move.at_s)
        parts = [np.concatenate([a[old], b[new]]) for a, b in zip((frame, tag, corner), there, strict=True)]
        order = np.lexsort((parts[1], parts[0]))
        frame, tag, corner = (part[order] for part in parts)
    corner = corner + random.normal(0.0, sigma_px, corner.shape)
    identity = np.arange(n_tags) if rename is None else np.array([rename.get(k, k) for k in range(n_tags)])
    said = identity[tag]
    wrong = random.random(len(tag)) < p_wrong
    said = np.where(wrong, identity[random.integers(0, n_tags, len(tag))], said)
    detections = corner_detections(frame, said, corner)
    pose = poses(at, turn)
    driven = _drifting(pose, stamp_s, drift, random) if odometry else None
    truth = Trajectory(stamp_s, pose, np.zeros((n_frames, 6, 6)), frame="truth")
    tags = Landmarks.in_space(np.arange(n_tags), place, rotation=facing.as_quat())
    return World(SpatialRecording("corridor", driven, Frames(stamp_s), detections, (CAMERA,), truth, tags), pose, tags)


@dataclass
class Site:
    """A corridor that changes from day to day.

    Attributes:
        place, facing: where each tag is now.
        present: which of them are there.
    """

    place: np.ndarray
    facing: Rotation
    present: np.ndarray

    @classmethod
    def of(cls, seed: int, n_tags: int = 24) -> Site:
        random = np.random.default_rng(seed)
        place = np.column_stack([np.linspace(0.0, 15.0, n_tags), np.full(n_tags, 2.0), random.uniform(0, 0.8, n_tags)])
        facing = MOUNT * Rotation.from_rotvec(random.normal(0.0, 0.25, (n_tags, 3)))
        return cls(place, facing, np.ones(n_tags, dtype=np.bool_))

    def turn(self, tag: int, angle: float) -> None:
        turned = [one * Rotation.from_rotvec([0.0, 0.0, angle * (k == tag)]) for k, one in enumerate(self.facing)]
        self.facing = Rotation.concatenate(turned)

    def patrol(
        self,
        seed: int,
        day: int,
        low_m: float,
        high_m: float,
        *,
        odometry: bool = True,
        p_wrong: float = 0.0,
        rename: dict[int, int] | None = None,
    ) -> SpatialRecording:
        """A drive there and back along a part of the wall; nine of ten tags in view are detected."""
        random, n_frames = np.random.default_rng([seed, day]), 160
        stamp_s = np.linspace(0.0, 40.0, n_frames)
        along = 0.5 * (low_m + high_m) - 0.5 * (high_m - low_m) * np.cos(2.0 * np.pi * stamp_s / 40.0)
        at = np.column_stack([along, 0.3 * np.sin(stamp_s), 0.1 * np.sin(0.7 * stamp_s)])
        sway = np.column_stack([0.05 * np.sin(stamp_s), 0.05 * np.cos(stamp_s), 0.2 * np.sin(0.5 * stamp_s)])
        turn = Rotation.from_euler("xyz", sway)
        there = np.flatnonzero(self.present)
        frame, tag, corner = see_corners(at, turn, self.place[there], self.facing[there])
        kept = random.random(len(frame)) < 0.9
        frame, tag, corner = frame[kept], there[tag[kept]], corner[kept] + random.normal(0, 0.3, corner[kept].shape)
        wrong = random.random(len(tag)) < p_wrong
        said = np.where(wrong, random.integers(0, len(self.place), len(tag)), tag)
        said = np.array([(rename or {}).get(one, one) for one in said.tolist()])
        pose, then = poses(at, turn), stamp_s + 86_400.0 * day
        driven = _drifting(pose, stamp_s, 0.01, random) if odometry else None
        return SpatialRecording(
            f"day {day}",
            None if driven is None else replace(driven, stamp_s=then),
            Frames(then),
            corner_detections(frame, said, corner),
            (CAMERA,),
            Trajectory(then, pose, np.zeros((n_frames, 6, 6)), frame="truth"),
        )


def corner_detections(frame: np.ndarray, said: np.ndarray, corner: np.ndarray) -> SpatialDetections:
    count = len(frame)
    return SpatialDetections(
        frame=frame,
        sensor=np.zeros(count, dtype=np.int64),
        landmark_id=said,
        position_sensor_m=np.full((count, 3), np.nan),
        rotation=np.full((count, 4), np.nan),
        covariance_sensor_m2=np.full((count, 3, 3), np.nan),
        sigma_rad=np.full(count, np.nan),
        corner_px=corner,
        tag_size_m=np.full(count, SIZE_M),
        size_m=np.full((count, 3), np.nan),
        class_id=np.full(count, -1),
        score=np.full(count, np.nan),
        source_line=np.zeros(count, dtype=np.int64),
    )


def as_directions(world: World, seed: int, sigma_px: float = 0.5) -> SpatialRecording:
    """The same drive, of every tag only the direction of its centre."""
    recording, random = world.recording, np.random.default_rng(seed)
    seen = recording.detections
    robot = Rotation.from_quat(world.true_pose[seen.frame, 3:])
    eye = world.true_pose[seen.frame, :3] + robot.apply(MOUNT_AT)
    ahead = (robot * MOUNT).inv().apply(world.tags.position_m[seen.landmark_id] - eye)
    plane = ahead[:, :2] / ahead[:, 2:] + random.normal(0.0, sigma_px / FOCAL, (len(ahead), 2))
    ray = np.column_stack([plane, np.ones(len(plane))])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    along = ray[:, :, None] * ray[:, None, :]
    directions = replace(
        seen,
        position_sensor_m=ray,
        covariance_sensor_m2=(sigma_px / FOCAL) ** 2 * (np.eye(3) - along) + 1e9 * along,
        corner_px=np.full((len(seen), 4, 2), np.nan),
        tag_size_m=np.full(len(seen), np.nan),
    )
    return replace(recording, detections=directions)


def as_poses(world: World, seed: int, sigma_m: float = 0.01, sigma_rad: float = 0.02) -> SpatialRecording:
    """The same drive, of every tag its pose as it follows from the corners, with errors beside."""
    recording, random, intake = (
        world.recording,
        np.random.default_rng(seed),
        prepare_space(world.recording, SpaceConfig()),
    )
    some, count = intake.used, len(intake.used)
    error = np.repeat([sigma_m, sigma_rad], 3) * random.normal(size=(count, 6))
    measured = se3.retract(intake.problem.measured, error)
    detections = replace(
        rows_of(recording.detections, some),
        position_sensor_m=measured[:, :3],
        rotation=measured[:, 3:],
        covariance_sensor_m2=np.tile(sigma_m**2 * np.eye(3), (count, 1, 1)),
        sigma_rad=np.full(count, sigma_rad),
        corner_px=np.full((count, 4, 2), np.nan),
    )
    return replace(recording, detections=detections)


def see_corners(
    at: np.ndarray,
    turn: Rotation,
    place: np.ndarray,
    facing: Rotation,
    mount: Rotation = MOUNT,
    mount_at: np.ndarray = MOUNT_AT,
    nearest_m: float = 0.3,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames, tags and exact corners of all sightings, by the pinhole formula."""
    camera = (turn * mount).inv().as_matrix()
    origin = at + turn.apply(mount_at)
    edge = place[:, None] + np.stack([facing.apply(corner) for corner in SQUARE], axis=1)
    ahead = np.einsum("fij,ftcj->ftci", camera, edge[None] - origin[:, None, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = FOCAL * ahead[..., :2] / ahead[..., 2:] + CENTRE
    inside = ((pixel > 0.0) & (pixel < 2.0 * np.array(CENTRE))).all(axis=(2, 3))
    frame, tag = np.nonzero(inside & (ahead[..., 2].min(axis=2) >= nearest_m))
    return frame, tag, pixel[frame, tag]


def _drifting(pose: np.ndarray, stamp_s: np.ndarray, drift: float, random: np.random.Generator) -> SpatialOdometry:
    return drifting(
        pose, stamp_s, drift, random, np.array([5.0, -3.0, 1.0]), Rotation.from_euler("xyz", [0.1, -0.2, 1.0])
    )


def drifting(
    pose: np.ndarray,
    stamp_s: np.ndarray,
    drift: float,
    random: np.random.Generator,
    start: np.ndarray,
    facing: Rotation,
) -> SpatialOdometry:
    """Odometry of a drive: each step with noise of `drift` metres, and a third in radians, for the root of a second."""
    at, turn = pose[:, :3], Rotation.from_quat(pose[:, 3:])
    noise = drift * np.sqrt(np.diff(stamp_s))[:, None, None] * random.normal(size=(len(at) - 1, 2, 3))
    back = turn[:-1].inv()
    step = back.apply(np.diff(at, axis=0)) + noise[:, 0]
    bend = (back * turn[1:] * Rotation.from_rotvec(noise[:, 1] / 3.0)).as_matrix()
    found_at, found = np.tile(start, (len(at), 1)), np.tile(facing.as_matrix(), (len(at), 1, 1))
    for k in range(len(at) - 1):
        found_at[k + 1] = found_at[k] + found[k] @ step[k]
        found[k + 1] = found[k] @ bend[k]
    return SpatialOdometry(stamp_s, poses(found_at, Rotation.from_matrix(found)), np.full((len(at), 6), np.nan))
