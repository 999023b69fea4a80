"""A room with objects of known classes, seen by a camera that walks around; turns of what looks the same by scipy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from evermap.io.spatial import spatial_detections
from evermap.types import Frames, Landmarks, SpatialRecording, SpatialSensor, Trajectory

from .corridors import drifting, poses

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
        ahead = np.einsum("fij,fkj->fki", eye.inv().as_matrix(), self.place[None] - at[:, None])
        inside = (ahead[..., 2] > 0.5) & (np.abs(ahead[..., :2]) < ahead[..., 2:]).all(axis=2)
        things, noises = [], []
        for row in range(n_frames):
            things.append(np.flatnonzero(inside[row] & (random.random(len(self.place)) < 0.9)))
            noises.append(random.normal(size=(len(things[-1]), 2, 3)))
        frame = np.repeat(np.arange(n_frames), [len(each) for each in things])
        thing, noise = np.concatenate(things), np.concatenate(noises)
        pose = poses(at, turn)
        driven = drifting(pose, stamp_s, drift, random, np.zeros(3), Rotation.identity())
        orientation = Rotation.from_rotvec(SIGMA_RAD * noise[:, 0]) * eye[frame].inv() * self.turn[thing]
        if ambiguous:
            turns = np.empty((len(thing), 4))
            for kind in np.unique(self.kind[thing]):
                rows = np.flatnonzero(self.kind[thing] == kind)
                turns[rows] = same_looking(CLASSES[kind], len(rows), random).as_quat()
            orientation = orientation * Rotation.from_quat(turns)
        count = len(frame)
        detections = spatial_detections(
            frame, landmark_id=thing, class_id=self.kind[thing],
            position_sensor_m=ahead[frame, thing] + SIGMA_M * noise[:, 1],
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
