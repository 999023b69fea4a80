"""A stereo pair that is carried through a room of points, which it turns fast in; rotations by scipy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from evermap.io.spatial import spatial_detections
from evermap.types import Frames, Landmarks, SpatialOdometry, SpatialRecording, SpatialSensor, Trajectory

from .corridors import poses

FOCAL, BASELINE_M = 500.0, 0.15
AHEAD = Rotation.from_euler("xyz", [-np.pi / 2, 0.0, -np.pi / 2])
"""Of a camera: its z is the rig's x."""
TURN_S = 0.8


@dataclass(frozen=True)
class Rig:
    """A walk through the room.

    Attributes:
        seed: of everything.
        points: on a ring of 3 to 4 m.
        seconds, rate_hz: how long, and frames in a second.
        noise_px: of each of the three pixels; `bias_px` of the disparity; `point_px` of each point, for all of its
            detections.
        turns: of 2.5 rad in 0.8 s each.
        gaps: of 2 s in which nothing is seen.
        detected: share of the points in view.
        p_wrong: share of detections with the identity of another point.
        drift: of the velocities, metres, and half of that in radians, by the square root of a second; None without any.
        missed: share of each fast turn that they do not show.
    """

    seed: int
    points: int = 24
    seconds: float = 60.0
    rate_hz: float = 8.0
    noise_px: float = 0.5
    bias_px: float = 0.0
    point_px: float = 0.0
    turns: int = 4
    gaps: int = 2
    detected: float = 0.7
    p_wrong: float = 0.0
    drift: float | None = None
    missed: float = 0.0

    def walk(self) -> SpatialRecording:
        """Record it."""
        random = np.random.default_rng(self.seed)
        stamp_s = np.arange(0.0, self.seconds, 1.0 / self.rate_hz)
        begin, phase = np.sort(random.uniform(5.0, self.seconds - 5.0, self.turns)), random.uniform(0.0, 6.28, 6)
        by = 2.5 * random.choice([-1.0, 1.0], self.turns)
        far = np.clip((stamp_s[:, None] - begin) / TURN_S, 0.0, 1.0)
        yaw = phase[3] + 2.5 * np.sin(0.15 * stamp_s + phase[4]) + far @ by
        at = np.column_stack([np.sin(0.35 * stamp_s + phase[0]), np.sin(0.27 * stamp_s + phase[1]), 0.2 * np.sin(yaw)])
        at = at * [1.6, 1.6, 1.0]
        sway = np.column_stack([yaw, 0.15 * np.sin(0.5 * stamp_s + phase[5]), 0.1 * np.sin(0.4 * stamp_s)])
        turn = Rotation.from_euler("ZYX", sway) * AHEAD
        pose = poses(at, turn)
        angle, radius = random.uniform(0.0, 6.28, self.points), random.uniform(2.8, 4.2, self.points)
        height = random.uniform(-1.2, 1.2, self.points)
        place = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
        frame, name, position, covariance = self._seen(random, stamp_s, at, turn, place)
        detections = spatial_detections(
            frame, landmark_id=name, position_sensor_m=position, covariance_sensor_m2=covariance
        )
        return SpatialRecording(
            f"rig {self.seed}", self._driven(random, stamp_s, turn, at, far), Frames(stamp_s), detections,
            (SpatialSensor(),), Trajectory(stamp_s, pose, np.zeros((len(pose), 6, 6)), frame="truth"),
            Landmarks.in_space(np.arange(self.points), place),
        )  # fmt: skip

    def _seen(
        self, random: np.random.Generator, stamp_s: np.ndarray, at: np.ndarray, turn: Rotation, place: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        inside = np.einsum("nij,nkj->nki", turn.inv().as_matrix(), place[None] - at[:, None])
        depth = inside[..., 2]
        visible = (depth > 0.6) & (np.abs(inside[..., 0]) < 0.6 * depth) & (np.abs(inside[..., 1]) < 0.45 * depth)
        visible &= random.random(visible.shape) < self.detected
        for begin in random.uniform(5.0, self.seconds - 5.0, self.gaps):
            visible[(stamp_s > begin) & (stamp_s < begin + 2.0)] = False
        frame, name = np.nonzero(visible)
        plane = inside[frame, name, :2] / depth[frame, name, None] * FOCAL
        pixels = np.column_stack([plane, plane[:, 0]]) + random.normal(0.0, self.noise_px, (len(frame), 3))
        if self.point_px:
            pixels += random.normal(0.0, self.point_px, (self.points, 3))[name]
        u, v, right = pixels.T
        disparity = np.maximum(BASELINE_M * FOCAL / depth[frame, name] + u - right + self.bias_px, 2.0)
        z = BASELINE_M * FOCAL / disparity
        slope = np.zeros((len(frame), 3, 3))  # by u, v and the disparity
        slope[:, 0, 0] = slope[:, 1, 1] = z / FOCAL
        slope[:, :, 2] = -np.column_stack([u, v, np.full(len(u), FOCAL)]) * (z / FOCAL / disparity)[:, None]
        root = slope * self.noise_px * [1.0, 1.0, np.sqrt(2.0)]
        wrong = random.random(len(name)) < self.p_wrong
        said = np.where(wrong, random.integers(0, self.points, len(name)), name)
        position = np.column_stack([u * z / FOCAL, v * z / FOCAL, z])
        return frame, said, position, root @ np.swapaxes(root, 1, 2)

    def _driven(
        self, random: np.random.Generator, stamp_s: np.ndarray, turn: Rotation, at: np.ndarray, far: np.ndarray
    ) -> SpatialOdometry | None:
        if self.drift is None:
            return None
        count, root = len(stamp_s) - 1, np.sqrt(np.diff(stamp_s))[:, None]
        steps = (turn[:-1].inv() * turn[1:]).as_rotvec()
        steps *= 1.0 - self.missed * (np.diff(far, axis=0) > 0.0).any(axis=1, keepdims=True)
        steps += 0.5 * self.drift * root * random.normal(size=(count, 3))
        shift = turn[:-1].inv().apply(np.diff(at, axis=0)) + self.drift * root * random.normal(size=(count, 3))
        turned, moved = [Rotation.identity()], [np.zeros(3)]
        for step, by in zip(steps, shift, strict=True):
            moved.append(moved[-1] + turned[-1].apply(by))
            turned.append(turned[-1] * Rotation.from_rotvec(step))
        at_each = poses(np.array(moved), Rotation.concatenate(turned))
        return SpatialOdometry(stamp_s, at_each, np.full((len(stamp_s), 6), np.nan))
