"""Paths and landmarks, of estimates and of the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.show import Shown, ShownTable, draw, extent, span
from evermap.types.arrays import UNKNOWN, ArrayTable, FloatArray, IntArray
from evermap.types.clock import Clock
from evermap.types.names import landmark_label

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class Trajectory(ArrayTable):
    """Stamped poses, in the plane or in space.

    Attributes:
        stamp_s: (N,) strictly increasing.
        pose_world_robot: (N, 3) x [m], y [m], theta [rad, wrapped to (-pi, pi]]; in space (N, 7) x, y, z [m] and a unit
            quaternion qx, qy, qz, qw.
        covariance: (N, 3, 3) or (N, 6, 6) in the robot's frame (right perturbation); zeros where the poses are exact.
        frame: what 'world' is: 'first_pose', of robots solved together 'first_robot' (its first pose), 'prior_map' or
            'truth'.
    """

    stamp_s: FloatArray
    pose_world_robot: FloatArray
    covariance: FloatArray
    frame: str = "first_pose"
    clock: Clock = Clock.RECORDING

    @property
    def length_m(self) -> float:
        """Return the length of the path between the poses [m]."""
        at = self.pose_world_robot[:, : 3 if self.pose_world_robot.shape[1] == 7 else 2]
        return float(np.linalg.norm(np.diff(at, axis=0), axis=1).sum())

    def _facts(self) -> dict[str, Any]:
        stamps = span(self.stamp_s)
        return {"poses": len(self), **stamps, "length_m": round(self.length_m, 3), "frame": self.frame}

    def plot(self) -> Figure:
        """Draw the path; returns a matplotlib figure."""
        return draw("plot_trajectory", self)


MOST_TILT_RAD = math.radians(10.0)
"""Greatest standard deviation of an up that is known. At 10 degrees what is 3 m high is half a metre off in a figure
from above or a mask of a floor, about the radius of a robot; beyond it such a figure is a section."""
PLANE = "plane"
"""Source of up in the plane: by definition."""


@dataclass(frozen=True, slots=True)
class Up(Shown):
    """Where up is in the frame of a map.

    Attributes:
        direction: (3,) unit vector, nan where nothing tells.
        sigma_rad: standard deviation of its tilt, about each of two horizontal axes; infinite where nothing tells.
        source: what tells: 'imu', 'tf', 'odometry', 'plane of motion', 'stated', or several of them with commas;
            'plane' of a map in the plane; '' where nothing does.
    """

    direction: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    sigma_rad: float = math.inf
    source: str = ""

    @classmethod
    def of_plane(cls) -> Up:
        """Return that of a map in the plane."""
        return cls(np.array([0.0, 0.0, 1.0]), 0.0, PLANE)

    @property
    def is_known(self) -> bool:
        """Whether it is known well enough to say what is above what."""
        return bool(np.isfinite(self.direction).all()) and self.sigma_rad <= MOST_TILT_RAD

    @property
    def text(self) -> str:
        """One line: the direction, its uncertainty and its source; or that it is unknown."""
        if self.source == PLANE:
            return "z, in the plane"
        axes = ", ".join(f"{part:.3f}" for part in (self.direction + 0.0).tolist())
        within = f"({axes}) within {math.degrees(self.sigma_rad):.1f} deg (1 sigma), by {self.source}"
        if self.is_known:
            return within
        return f"unknown: only {within}" if np.isfinite(self.direction).all() else "unknown"


@dataclass(frozen=True, slots=True)
class Landmarks(ArrayTable):
    """Map records, one row a landmark, sorted by id. Estimates, a prior map and surveyed truth share this form.

    Attributes:
        landmark_id: (L,) unique.
        position_m: (L, 2) in the map's frame, in space (L, 3).
        covariance_m2: (L, 2, 2) or (L, 3, 3); zeros where exact.
        class_id: (L,) row of `class_names`, or `UNKNOWN`.
        p_exists: (L,) probability that it is there now.
        n_hits, n_misses: (L,) detections used, and expected detections that did not come.
        first_seen_s, last_seen_s: (L,) stamps, nan where never seen.
        frame: what the coordinates refer to, as in `Trajectory.frame`.
        names: texts behind ids that were given as such (`landmark_id_of`), perhaps of other landmarks too.
        rotation: (L, 4) in space, quaternions of landmarks that have an orientation, nan of points; None of points.
        rotation_covariance: (L, 3, 3) [rad^2] in the landmark's own frame; None of points.
        size_m: (L, 3) length, width and height of boxes, nan of others; None where nothing has a size.
        up: where up is in the map's frame; in the plane it is known.
    """

    landmark_id: IntArray
    position_m: FloatArray
    covariance_m2: FloatArray
    class_id: IntArray
    p_exists: FloatArray
    n_hits: IntArray
    n_misses: IntArray
    first_seen_s: FloatArray
    last_seen_s: FloatArray
    class_names: tuple[str, ...] = ()
    frame: str = "first_pose"
    clock: Clock = Clock.RECORDING
    names: Mapping[int, str] = field(default_factory=dict)
    rotation: FloatArray | None = None
    rotation_covariance: FloatArray | None = None
    size_m: FloatArray | None = None
    up: Up = field(default_factory=Up)

    def __post_init__(self) -> None:
        ArrayTable.__post_init__(self)
        flat = self.position_m.shape[1:] == (2,)
        if flat != (self.up.source == PLANE):
            object.__setattr__(self, "up", Up.of_plane() if flat else Up())

    def _facts(self) -> dict[str, Any]:
        return {
            "rows": len(self),
            **{f"{axis}_m": extent(place) for axis, place in zip("xyz", self.position_m.T, strict=False)},
            "p_exists": extent(self.p_exists),
            "classes": self.class_names,
            "frame": self.frame,
            **({} if self.up.source == PLANE else {"up": self.up.text}),
        }

    def _columns(self) -> dict[str, Any]:
        """Return the columns, with names and classes in words where there are any."""
        found = ShownTable._columns(self)
        if self.names:
            found["name"] = [self.names.get(identity, "") for identity in self.landmark_id.tolist()]
        if self.class_names:
            found["class"] = [self.class_names[k] if k >= 0 else "" for k in self.class_id.tolist()]
        return found

    @property
    def labels(self) -> list[str]:
        """What each landmark is called, (L,)."""
        return [landmark_label(identity, self.names) for identity in self.landmark_id.tolist()]

    def plot(self) -> Figure:
        """Draw the map with 2-sigma ellipses; returns a matplotlib figure."""
        return draw("plot_landmarks", self)

    @classmethod
    def at(
        cls,
        landmark_id: Any,
        position_m: Any,
        *,
        sigma_m: Any = 0.0,
        class_id: Any = None,
        class_names: tuple[str, ...] = (),
        frame: str = "truth",
    ) -> Landmarks:
        """Return known positions with one standard deviation each (scalar, (L,) or (L, 2) metres), e.g. a surveyed
        map.
        """
        ids = np.asarray(landmark_id, dtype=np.int64)
        order = np.argsort(ids, kind="stable")
        count = len(ids)
        sigma = np.asarray(sigma_m, dtype=np.float64)
        sigma = np.broadcast_to(sigma[:, None] if sigma.ndim == 1 else sigma, (count, 2))[order]
        covariance = np.zeros((count, 2, 2))
        covariance[:, [0, 1], [0, 1]] = sigma**2
        classes = np.full(count, UNKNOWN) if class_id is None else np.asarray(class_id, dtype=np.int64)
        return cls(
            landmark_id=ids[order],
            position_m=np.asarray(position_m, dtype=np.float64).reshape(count, 2)[order],
            covariance_m2=covariance,
            class_id=classes[order],
            p_exists=np.ones(count),
            n_hits=np.zeros(count, dtype=np.int64),
            n_misses=np.zeros(count, dtype=np.int64),
            first_seen_s=np.full(count, np.nan),
            last_seen_s=np.full(count, np.nan),
            class_names=class_names,
            frame=frame,
        )

    def as_prior(self, sigma_m: float) -> Landmarks:
        """Return landmarks in space as a map to localise in, with one standard deviation in all directions [m, rad]."""
        known = np.broadcast_to(sigma_m**2 * np.eye(3), (len(self), 3, 3)).copy()
        turned = None if self.rotation is None else known.copy()
        return replace(self, covariance_m2=known, rotation_covariance=turned, frame="prior_map")

    @classmethod
    def in_space(
        cls,
        landmark_id: Any,
        position_m: Any,
        *,
        rotation: Any = None,
        size_m: Any = None,
        class_id: Any = None,
        class_names: tuple[str, ...] = (),
        names: Mapping[int, str] | None = None,
        clock: Clock = Clock.RECORDING,
    ) -> Landmarks:
        """Return landmarks that are known exactly, at (L, 3) metres, perhaps with orientations (L, 4) and sizes
        (L, 3).
        """
        ids = np.asarray(landmark_id, dtype=np.int64)
        order, count = np.argsort(ids, kind="stable"), len(ids)
        flat = cls.at(ids, np.zeros((count, 2)), class_id=class_id, class_names=class_names)
        return replace(
            flat,
            position_m=np.asarray(position_m, dtype=np.float64).reshape(count, 3)[order],
            covariance_m2=np.zeros((count, 3, 3)),
            rotation=None if rotation is None else np.asarray(rotation, dtype=np.float64)[order],
            rotation_covariance=None if rotation is None else np.zeros((count, 3, 3)),
            size_m=None if size_m is None else np.asarray(size_m, dtype=np.float64)[order],
            names=names or {},
            clock=clock,
        )
