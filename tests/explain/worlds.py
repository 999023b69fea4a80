"""A robot on a field of 12 by 8 m, in the plane and in space, and what is stated wrongly of it; rotations by scipy."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from evermap.io.spatial import spatial_detections
from evermap.types import (
    UNKNOWN,
    Detections,
    Frames,
    Landmarks,
    Odometry,
    Recording,
    Sensor,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
)

LENGTH_M, WIDTH_M = 12.0, 8.0
SIZE_M = 0.16
CORNERS = np.array([(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)]) * 0.5
EYES = ((0.3, 0.2, 0.5, 20.0), (-0.3, -0.2, 0.5, 200.0))
"""Position and yaw [degrees] of two cameras; both look 10 degrees up."""
FOCAL = (700.0, 660.0, 640.0, 400.0)


@dataclass(frozen=True)
class World:
    """A drive of 20 s, and the truth of what is stated of it.

    Attributes:
        seed: of the noise.
        seconds: how long.
        drift: of the odometry, metres for the root of a metre and radians for the root of a radian.
        wheels, turns: true over reported speeds, and turns.
        bias_radps: by which reported turns are too fast.
        late_s: by which stamps of the detections are late.
        longer: true over reported ranges, or over the stated size of all tags.
        sizes: the same of some landmarks.
        bent: k1 of the lenses, of which nothing is stated.
        moved: landmarks that are elsewhere than the map has them, by (x, y).
    """

    seed: int = 0
    seconds: float = 20.0
    drift: float = 0.01
    wheels: float = 1.0
    turns: float = 1.0
    bias_radps: float = 0.0
    late_s: float = 0.0
    longer: float = 1.0
    bent: float = 0.0
    sizes: dict[int, float] = field(default_factory=dict)
    moved: dict[int, tuple[float, float]] = field(default_factory=dict)

    def path(self, stamp_s: np.ndarray) -> np.ndarray:
        """(N, 3) poses: an eight, at changing speed."""
        phase = 2.0 * np.pi * (stamp_s / 20.0) + 0.35 * np.sin(2.0 * np.pi * stamp_s / 7.0)
        x, y = 6.0 + 3.5 * np.cos(phase), 4.0 + 2.0 * np.sin(2.0 * phase)
        dx, dy = -3.5 * np.sin(phase), 4.0 * np.cos(2.0 * phase)
        return np.column_stack([x, y, np.unwrap(np.arctan2(dy, dx))])

    def driven(self, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Stamps (K,) and reported velocities (K, 3), forward, to the left, and turning."""
        stamp_s = np.arange(-1.0, self.seconds + 1.0, 0.02)
        pose = self.path(stamp_s)
        step, turn = np.diff(pose[:, :2], axis=0), np.diff(pose[:, 2])
        mid = pose[:-1, 2] + 0.5 * turn
        ahead = step[:, 0] * np.cos(mid) + step[:, 1] * np.sin(mid)
        left = -step[:, 0] * np.sin(mid) + step[:, 1] * np.cos(mid)
        noise = random.normal(size=(len(turn), 3)) * np.sqrt(np.abs(ahead))[:, None] * self.drift
        moved = np.column_stack([ahead + noise[:, 0], left + 0.3 * noise[:, 1], turn + noise[:, 2]])
        return stamp_s[:-1], moved / 0.02 / [self.wheels, self.wheels, self.turns] + [0.0, 0.0, self.bias_radps]

    @property
    def place(self) -> np.ndarray:
        """(16, 3) landmarks along the walls."""
        random = np.random.default_rng(99)
        along = np.linspace(1.0, 11.0, 5)
        side = np.linspace(2.0, 6.0, 3)
        walls = [
            *((x, 0.0) for x in along), *((x, WIDTH_M) for x in along),
            *((0.0, y) for y in side), *((LENGTH_M, y) for y in side),
        ]  # fmt: skip
        at = np.array(walls) + random.uniform(-0.4, 0.4, (16, 2)) * (np.array(walls) % [LENGTH_M, WIDTH_M] > 0)
        return np.column_stack([at, random.uniform(0.6, 1.6, 16)])

    @property
    def where(self) -> np.ndarray:
        """(16, 3) where they are during the drive."""
        at = self.place.copy()
        for row, by in self.moved.items():
            at[row, :2] += by
        return at

    def factors(self) -> np.ndarray:
        """(16,) true over stated sizes."""
        found = np.full(16, self.longer)
        for row, factor in self.sizes.items():
            found[row] *= factor
        return found

    def plane(self) -> Recording:
        """Ranges and bearings, all around, up to 6 m."""
        random = np.random.default_rng(self.seed)
        stamp_s, velocity = self.driven(random)
        frame_s = np.arange(0.0, self.seconds, 0.2)
        pose = self.path(frame_s - self.late_s)
        eye = pose.copy()
        eye[:, :2] += 0.2 * np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
        away = self.where[None, :, :2] - eye[:, None, :2]
        range_m = np.hypot(*np.moveaxis(away, -1, 0))
        bearing = np.arctan2(away[..., 1], away[..., 0]) - eye[:, 2:]
        frame, row = np.nonzero((range_m < 6.0) & (random.random(range_m.shape) < 0.9))
        read = range_m[frame, row] * (1.0 + 0.004 * random.normal(size=len(frame))) / self.factors()[row]
        at = bearing[frame, row] + 0.004 * random.normal(size=len(frame))
        nan, none = np.full(len(frame), np.nan), np.full(len(frame), UNKNOWN)
        detections = Detections(
            frame, row, read, (at + np.pi) % (2.0 * np.pi) - np.pi, none, nan, nan, np.zeros(len(frame), dtype=int)
        )
        truth = self.path(frame_s)
        return Recording(
            "field", Odometry(stamp_s, *velocity.T), Frames(frame_s), detections,
            Sensor(mount_robot_sensor=(0.2, 0.0, 0.0), range_max_m=8.0),
            Trajectory(frame_s, truth, np.zeros((len(truth), 3, 3)), frame="truth"), self.map_in_plane(),
        )  # fmt: skip

    def map_in_plane(self) -> Landmarks:
        """The survey."""
        return Landmarks.at(np.arange(16), self.place[:, :2])

    def space(self, *, corners: bool = True) -> SpatialRecording:
        """Tags in two cameras, by their corners or as poses, up to 6 m; wheels as poses in a frame that drifts."""
        random = np.random.default_rng(self.seed)
        stamp_s, velocity = self.driven(random)
        frame_s = np.arange(0.0, self.seconds, 0.2)
        robot = self.path(frame_s - self.late_s)
        turn = Rotation.from_euler("z", robot[:, 2:])
        at = np.column_stack([robot[:, :2], np.zeros(len(robot))])
        sensors, parts = [], []
        for number, (x, y, z, yaw) in enumerate(EYES):
            mount = Rotation.from_euler("ZYX", [yaw, -10.0, 0.0], degrees=True) * Rotation.from_matrix(
                [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
            )
            sensors.append(
                SpatialSensor(
                    ("front", "back")[number], (x, y, z, *mount.as_quat().tolist()),
                    FOCAL if corners else None, resolution_px=(1280, 800) if corners else None, range_max_m=8.0,
                )
            )  # fmt: skip
            eye, eye_at = turn * mount, at + turn.apply([x, y, z])
            parts += self._seen(random, number, eye, eye_at, corners=corners)
        order = sorted((part for part in parts if len(part[2])), key=lambda part: part[1])
        frame = np.concatenate([np.full(len(part[2]), part[1]) for part in order])
        sensor = np.concatenate([np.full(len(part[2]), part[0]) for part in order])
        names = np.concatenate([part[2] for part in order])
        read = np.concatenate([part[3] for part in order])
        if corners:
            detections = spatial_detections(
                frame, sensor=sensor, landmark_id=names, corner_px=read, tag_size_m=np.full(len(frame), SIZE_M)
            )
        else:
            detections = spatial_detections(
                frame, sensor=sensor, landmark_id=names, position_sensor_m=read[:, :3], rotation=read[:, 3:]
            )
        truth = self.path(frame_s)
        return SpatialRecording(
            "field in space", self._odometry(stamp_s, velocity), Frames(frame_s), detections, tuple(sensors),
            Trajectory(
                frame_s,
                np.column_stack(
                    [truth[:, :2], np.zeros(len(truth)), Rotation.from_euler("z", truth[:, 2:]).as_quat()]
                ),
                np.zeros((len(truth), 6, 6)), frame="truth",
            ),
            self.map_in_space(),
        )  # fmt: skip

    def _seen(
        self, random: np.random.Generator, number: int, eye: Rotation, at: np.ndarray, *, corners: bool
    ) -> list[tuple[int, int, np.ndarray, np.ndarray]]:
        """What one camera reads in each frame: its number, the frame, names, and what is read of each."""
        place, tag, factor, away = self.where, self.turned(), self.factors(), eye.inv()
        corner_m = place[:, None] + np.stack([one.apply(CORNERS * SIZE_M) for one in tag]) * factor[:, None, None]
        out, turn = tag.apply([0.0, 0.0, 1.0]), away.as_matrix()
        own = np.einsum("fij,ftj->fti", turn, place - at[:, None])
        facing = np.einsum("fij,tj->fti", turn, out)
        corner = np.einsum("fij,ftcj->ftci", turn, corner_m - at[:, None, None])
        far_m = np.linalg.norm(own, axis=2)
        fx, fy, cx, cy = FOCAL
        flat = corner[..., :2] / corner[..., 2:]
        far2 = (flat**2).sum(axis=-1, keepdims=True)
        pixel = flat * (1.0 + self.bent * far2 + 0.8 * self.bent**2 * far2**2) * [fx, fy] + [cx, cy]
        inside = ((pixel >= 0.0) & (pixel <= [1280.0, 800.0])).all(axis=(2, 3))
        shown = inside & (own[..., 2] >= 0.5) & (far_m <= 6.0) & ((facing * own).sum(axis=2) <= -0.3 * far_m)
        parts = []
        for row, visible in enumerate(shown):
            names, read = [], []
            for name in np.flatnonzero(visible):
                if random.random() > 0.9:
                    continue
                names.append(name)
                if corners:
                    read.append(pixel[row, name] + random.normal(0.0, 0.5, (4, 2)))
                else:
                    noisy = own[row, name] / factor[name] + random.normal(size=3) * 0.006 * far_m[row, name]
                    rough = (away[row] * tag[name]) * Rotation.from_rotvec(random.normal(0.0, 0.03, 3))
                    read.append(np.concatenate([noisy, rough.as_quat()]))
            parts.append((number, row, np.array(names, dtype=np.int64), np.array(read)))
        return parts

    def turned(self) -> Rotation:
        """Tags that hang upright and look into the field: z out of the wall, y down."""
        turns = []
        for x, y in self.place[:, :2]:
            nearest = np.argmin([x, LENGTH_M - x, y, WIDTH_M - y])
            out = np.array([(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)][nearest])
            down = np.array([0.0, 0.0, -1.0])
            turns.append(Rotation.from_matrix(np.column_stack([np.cross(down, out), down, out])))
        return Rotation.concatenate(turns)

    def _odometry(self, stamp_s: np.ndarray, velocity: np.ndarray) -> SpatialOdometry:
        heading = np.append(0.0, np.cumsum(0.02 * velocity[:, 2]))
        mid = heading[:-1] + 0.01 * velocity[:, 2]
        c, s = np.cos(mid), np.sin(mid)
        x = np.append(0.0, np.cumsum(0.02 * (c * velocity[:, 0] - s * velocity[:, 1])))
        y = np.append(0.0, np.cumsum(0.02 * (s * velocity[:, 0] + c * velocity[:, 1])))
        turn = Rotation.from_euler("z", heading[:, None]).as_quat()
        stamp = np.append(stamp_s, stamp_s[-1] + 0.02)
        return SpatialOdometry(stamp, np.column_stack([x, y, np.zeros(len(x)), turn]), np.full((len(x), 6), np.nan))

    def map_in_space(self) -> Landmarks:
        """The survey."""
        return Landmarks.in_space(np.arange(16), self.place, rotation=self.turned().as_quat())
