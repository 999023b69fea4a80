"""A room with objects of known classes, seen by a camera that walks around; turns of what looks the same by scipy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from evermap.io.spatial import spatial_detections
from evermap.types import Frames, Landmarks, SpatialOdometry, SpatialRecording, SpatialSensor, Trajectory

from .corridors import poses

SYMMETRIES = {
    "brick": ("180:z", "180:x"),
    "cube": ("90:z", "90:x"),
    "can": ("axis:z",),
    "drum": ("axis:x", "180:y"),
    "ball": ("any",),
}
CLASSES = ("mug", *SYMMETRIES)
MOUNT = Rotation.from_euler("xyz", [-np.pi / 2, 0.0, -np.pi / 2])
"""A camera that looks ahead."""
SIGMA_M, SIGMA_RAD = 0.02, 0.06


def same_looking(kind: str, count: int, random: np.random.Generator) -> Rotation:
    """Random turns of an object of a class after which it looks the same."""
    if kind == "ball":
        return Rotation.random(count, rng=int(random.integers(2**31)))
    about = random.uniform(-np.pi, np.pi, count)
    flip = Rotation.from_rotvec(np.outer(random.integers(0, 2, count), [0.0, np.pi, 0.0]))
    if kind == "can":
        return Rotation.from_euler("z", about[:, None])
    if kind == "drum":
        return Rotation.from_euler("x", about[:, None]) * flip
    group = {"mug": "C1", "brick": "D2", "cube": "O"}[kind]
    elements = Rotation.create_group(group)
    return elements[random.integers(0, len(elements), count)]


@dataclass
class Room:
    """Objects, and how they stand now."""

    place: np.ndarray
    turn: Rotation
    kind: np.ndarray

    @classmethod
    def of(cls, seed: int, kinds: tuple[str, ...] = CLASSES, a_kind: int = 3) -> Room:
        random = np.random.default_rng(seed)
        count = a_kind * len(kinds)
        angle = 2.0 * np.pi * np.arange(count) / count
        place = np.column_stack([3.0 * np.cos(angle), 3.0 * np.sin(angle), random.uniform(-0.5, 0.5, count)])
        turn = Rotation.random(count, rng=seed)
        return cls(place, turn, np.array([CLASSES.index(kinds[k % len(kinds)]) for k in range(count)]))

    def turned(self, name: int, by: Rotation) -> None:
        """Turn an object in its own frame."""
        each = [one * by if k == name else one for k, one in enumerate(self.turn)]
        self.turn = Rotation.concatenate(each)

    def walk(
        self, seed: int, *, day: int = 0, drift: float = 0.02, odometry: bool = True, ambiguous: bool = True,
        stated: bool = True, n_frames: int = 240,
    ) -> SpatialRecording:  # fmt: skip
        """Two rounds through the room, with the same noise whether detections are ambiguous or not.

        Args:
            seed: of everything that is drawn.
            day: when.
            drift: of the odometry, metres for the square root of a second; a third of it in radians.
            odometry: whether there is any.
            ambiguous: whether detections come in any orientation that looks the same.
            stated: whether the recording states the symmetries.
            n_frames: in 40 seconds.
        """
        random = np.random.default_rng([seed, day])
        stamp_s = np.linspace(0.0, 40.0, n_frames)
        angle = 4.0 * np.pi * stamp_s / stamp_s[-1] + 0.5 * day
        at = np.column_stack([np.cos(angle), np.sin(angle), 0.1 * np.sin(3.0 * angle)])
        sway = np.column_stack([0.1 * np.sin(stamp_s), 0.1 * np.cos(stamp_s), np.zeros(n_frames)])
        turn = Rotation.from_euler("z", angle[:, None]) * Rotation.from_euler("xyz", sway)
        eye = turn * MOUNT
        frames, things, seen_at, seen = [], [], [], []
        for row in range(n_frames):
            ahead = eye[row].inv().apply(self.place - at[row])
            inside = (ahead[:, 2] > 0.5) & (np.abs(ahead[:, :2]) < ahead[:, 2:]).all(axis=1)
            for k in np.flatnonzero(inside & (random.random(len(inside)) < 0.9)):
                noise = Rotation.from_rotvec(random.normal(0.0, SIGMA_RAD, 3))
                frames.append(row)
                things.append(k)
                seen_at.append(ahead[k] + random.normal(0.0, SIGMA_M, 3))
                seen.append(noise * eye[row].inv() * self.turn[k])
        pose, frame, thing = poses(at, turn), np.array(frames), np.array(things)
        driven = _drifting(pose, stamp_s, drift, random)
        orientation = Rotation.concatenate(seen)
        if ambiguous:
            turns = [same_looking(CLASSES[self.kind[k]], 1, random)[0] for k in thing]
            orientation = orientation * Rotation.concatenate(turns)
        count = len(frame)
        detections = spatial_detections(
            frame, landmark_id=thing, class_id=self.kind[thing], position_sensor_m=np.array(seen_at),
            rotation=orientation.as_quat(), sigma_rad=np.full(count, SIGMA_RAD),
            covariance_sensor_m2=np.tile(SIGMA_M**2 * np.eye(3), (count, 1, 1)),
        )  # fmt: skip
        then = stamp_s + 86_400.0 * day
        camera = SpatialSensor("camera", (0.0, 0.0, 0.0, *MOUNT.as_quat().tolist()))
        return SpatialRecording(
            f"room, day {day}", replace(driven, stamp_s=then) if odometry else None, Frames(then), detections,
            (camera,), Trajectory(then, pose, np.zeros((n_frames, 6, 6)), frame="truth"), self.map(),
            class_names=CLASSES, symmetries=SYMMETRIES if stated else {},
        )  # fmt: skip

    def map(self) -> Landmarks:
        """Where everything is."""
        names = np.arange(len(self.place))
        return Landmarks.in_space(
            names, self.place.copy(), rotation=self.turn.as_quat(), class_id=self.kind, class_names=CLASSES
        )


def _drifting(pose: np.ndarray, stamp_s: np.ndarray, drift: float, random: np.random.Generator) -> SpatialOdometry:
    turn, found_at, found = Rotation.from_quat(pose[:, 3:]), [np.zeros(3)], [Rotation.identity()]
    for k in range(len(pose) - 1):
        root = np.sqrt(stamp_s[k + 1] - stamp_s[k])
        step = turn[k].inv().apply(pose[k + 1, :3] - pose[k, :3]) + random.normal(0.0, drift * root, 3)
        bend = turn[k].inv() * turn[k + 1] * Rotation.from_rotvec(random.normal(0.0, drift / 3.0 * root, 3))
        found_at.append(found_at[-1] + found[-1].apply(step))
        found.append(found[-1] * bend)
    whole = poses(np.array(found_at), Rotation.concatenate(found))
    return SpatialOdometry(stamp_s, whole, np.full((len(pose), 6), np.nan))
