"""Both groups with what the tests need of each: random members, gtsam's class of the same motions, matrices."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from hypothesis import strategies as st

from evermap.geometry.group import PLANE, SPACE, Group

# the places where rotations go wrong: none, hardly any, half a turn, just short of it and just beyond
TINY = [0.0, -0.0, *(s * d for s in (1, -1) for d in (5e-324, 1e-300, 1e-160, 1e-16, 1e-9, 9.9e-7, 1.1e-6, 2e-6, 1e-4))]
HALF = [s * (np.pi + d) for s in (1, -1) for d in (0.0, 1e-15, -1e-15, 1e-9, -1e-9, 1e-6, -1e-6)]

lengths = st.floats(-1e3, 1e3)
# half a turn, where the log jumps, has a test of its own
short_of_half = st.one_of(st.sampled_from(TINY), st.floats(-3.1, 3.1))
any_angle = st.one_of(st.sampled_from(TINY + HALF), st.floats(-np.pi, np.pi), st.floats(-50.0, 50.0))
axes = st.one_of(
    st.sampled_from([np.eye(3)[k] * s for k in range(3) for s in (1, -1)]),
    st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 1e-3),
).map(lambda v: v / np.linalg.norm(v))


@dataclass(frozen=True)
class Case:
    """One group beside gtsam's."""

    name: str
    group: Group
    peer: type

    def points(self, length: float = 1e3) -> st.SearchStrategy[np.ndarray]:
        return st.tuples(*[st.floats(-length, length)] * self.group.point_dim).map(np.array)

    def twists(
        self, angle: st.SearchStrategy[float] = short_of_half, length: float = 1e3
    ) -> st.SearchStrategy[np.ndarray]:
        turn = st.builds(lambda a, v: a * v, angle, axes) if self.name == "space" else angle.map(lambda a: [a])
        return st.builds(lambda shift, turn: np.concatenate([shift, turn]), self.points(length), turn)

    def poses(self, angle: st.SearchStrategy[float] = any_angle, length: float = 1e3) -> st.SearchStrategy[np.ndarray]:
        """Built by half angles, not by the group's own functions; of either sign."""
        if self.name == "plane":
            return self.twists(angle, length)
        turn = st.builds(lambda a, v: [*np.sin(a / 2) * v, np.cos(a / 2)], angle, axes)
        return st.builds(lambda shift, turn: np.concatenate([shift, turn]), self.points(length), turn)

    def as_peer(self, pose: np.ndarray):
        """gtsam's pose of the same motion."""
        if self.name == "plane":
            return gtsam.Pose2(*pose)
        x, y, z, w = pose[3:]
        return gtsam.Pose3(gtsam.Rot3(w, x, y, z), pose[:3])

    @property
    def order(self) -> list[int]:
        """Rows of gtsam's twist by ours: in space, its rotation comes first."""
        return [0, 1, 2] if self.name == "plane" else [3, 4, 5, 0, 1, 2]

    def matrix(self, pose: np.ndarray) -> np.ndarray:
        return self.as_peer(pose).matrix()

    def hat(self, twist: np.ndarray) -> np.ndarray:
        """The matrix whose exponential is the motion."""
        out = np.zeros((self.group.point_dim + 1,) * 2)
        out[:-1, -1] = twist[: self.group.point_dim]
        if self.name == "plane":
            out[0, 1], out[1, 0] = -twist[2], twist[2]
        else:
            x, y, z = twist[3:]
            out[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
        return out


PLANE_CASE, SPACE_CASE = Case("plane", PLANE, gtsam.Pose2), Case("space", SPACE, gtsam.Pose3)
CASES = [PLANE_CASE, SPACE_CASE]


def central(function, at, step=1e-6):
    """Derivatives of a vector function by central differences, one column an argument."""
    columns = []
    for k in range(len(at)):
        d = np.zeros(len(at))
        d[k] = step
        columns.append((np.asarray(function(at + d)) - np.asarray(function(at - d))) / (2 * step))
    return np.stack(columns, axis=-1)
