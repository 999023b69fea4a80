"""Measurements beside odometry and detections as factors, in the plane and in space.

The residual of a `MeasurementKind` is written once, on poses in space. In the plane it is seen through a `PoseView`: of
a twist in space only three numbers are free there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic, Protocol

import numpy as np

from evermap.estimate.graph import Room, State, State_contra
from evermap.estimate.kind import Columns, MeasurementKind, stack_columns
from evermap.estimate.robust import HEAVY_TAIL, weigh
from evermap.estimate.sparse.system import Slices
from evermap.geometry import se3
from evermap.types import BoolArray, FloatArray, IntArray


class PoseView(Protocol[State_contra]):
    """How the variables of a problem are seen as poses and places in space."""

    def poses(self, state: State_contra) -> FloatArray:
        """Return (N, 7) poses."""
        ...

    def places(self, state: State_contra) -> FloatArray:
        """Return (P, 3) positions of places."""
        ...

    def by_pose(self, by_twist: FloatArray) -> FloatArray:
        """Return derivatives (K, r, d) by steps of poses, given those by twists (K, r, 6)."""
        ...

    def by_place(self, state: State_contra, place: IntArray, by_position: FloatArray) -> list[FloatArray]:
        """Return the derivative (r, d) of each of some places (K,) by its own step, given those by positions."""
        ...


@dataclass(frozen=True, slots=True)
class Tied:
    """Measurements of one kind, tied to poses and places of a problem.

    Attributes:
        kind: what they are.
        columns: their numbers (K,), those that were left out too.
        row: (K,) poses, at or before the instants of the measurements.
        after: (K, 7) motion by the odometry from each to the instant itself.
        other: (K,) other poses, or places; (0,) of measurements of a pose alone.
        other_after: (K, 7) as `after`, of other poses.
    """

    kind: MeasurementKind
    columns: Columns
    row: IntArray
    after: FloatArray
    other: IntArray
    other_after: FloatArray

    @property
    def others(self) -> IntArray:
        """Return (K, 1) other poses or places; (K, 0) of measurements of a pose alone."""
        return self.other[:, None] if self.kind.ties != "pose" else np.zeros((len(self.row), 0), dtype=np.int64)

    def renumbered(self, row: IntArray) -> Tied:
        """Return the same for other numbers (N,) of the poses."""
        other = row[self.other] if self.kind.ties == "pose_pose" else self.other
        return replace(self, row=row[self.row], other=other)

    def until(self, n_poses: int) -> Tied:
        """Return those that tie none but the first so many poses."""
        return self.among(0, n_poses)

    def among(self, first: int, end: int) -> Tied:
        """Return those that tie none but the poses from `first` to `end - 1`, which are counted from the former."""
        pose = np.column_stack([self.row, self.other]) if self.kind.ties == "pose_pose" else self.row[:, None]
        some = self[np.all((pose >= first) & (pose < end), axis=1)]
        other = some.other - first if self.kind.ties == "pose_pose" else some.other
        return replace(some, row=some.row - first, other=other)

    def __getitem__(self, some: BoolArray) -> Tied:
        """Return some of them, by a mask (K,)."""
        columns = {name: column[some] for name, column in self.columns.items()}
        other = self.other[some] if len(self.other) else self.other
        return Tied(self.kind, columns, self.row[some], self.after[some], other, self.other_after[some])

    def find_frame(self, pose: FloatArray) -> FloatArray | None:
        """Return the motion (7,) of poses (N, 7) into the frame of the measurements; None where these have none."""
        if self.kind.frame is None:
            return None
        return self.kind.frame(se3.compose(pose[self.row], self.after), self.columns)

    def locate(self, pose: FloatArray, unknown: IntArray) -> dict[int, FloatArray]:
        """Return where (3,) `unknown` places are, by poses (N, 7); those that cannot be told are left out."""
        found: dict[int, FloatArray] = {}
        if self.kind.place is None:
            return found
        at = se3.compose(pose[self.row], self.after)
        for place in np.intersect1d(self.other, unknown).tolist():
            mine = np.flatnonzero(self.other == place)
            where = self.kind.place(at[mine], {name: column[mine] for name, column in self.columns.items()})
            if where is not None and np.all(np.isfinite(where)):
                found[place] = where
        return found


@dataclass(frozen=True, slots=True)
class MeasurementFactors(Generic[State]):
    """Measurements of one kind as factors.

    Attributes:
        tied: the measurements.
        view: of the problem's variables.
        other_variable: (K, 0 or 1) variables of other poses or of places.
        log_odds: beyond which half of the squared residual makes an outlier.
        heavy: tails that never let go, while the estimate may be far off.
    """

    tied: Tied
    view: PoseView[State]
    other_variable: IntArray
    log_odds: float
    heavy: bool

    @classmethod
    def of(
        cls, tied: Tied, view: PoseView[State], place_variable: IntArray, log_odds: float, *, heavy: bool
    ) -> MeasurementFactors[State]:
        """Return measurements of places that are variables, `place_variable` (P,), -1 of others; and all else."""
        other = tied.others
        if tied.kind.ties == "pose_place":
            tied = tied[place_variable[tied.other] >= 0]
            other = place_variable[tied.others]
        return cls(tied, view, other, log_odds, heavy)

    @property
    def ties(self) -> IntArray:
        """Return (K, 1 or 2) the pose, and the other pose or the place."""
        return np.column_stack([self.tied.row, self.other_variable])

    @property
    def rows(self) -> IntArray:
        """Return (K,) numbers of a residual."""
        return np.full(len(self.tied.row), len(self.tied.kind.sigma))

    @property
    def pose(self) -> IntArray:
        """Return (K,) the poses."""
        return self.tied.row

    def residuals(self, state: State) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
        """Return whitened residuals (K, r); derivatives by the pose (K, r, d), and by the other (r, d).

        A number that no variable moves, as a height where poses are in the plane, is 0: it is no measurement there, and
        would make an outlier of what is measured beside it.
        """
        tied, poses, view = self.tied, self.view.poses(state), self.view
        pose, other = se3.compose(poses[tied.row], tied.after), np.zeros((len(tied.row), 0))
        if tied.kind.ties == "pose_pose":
            other = se3.compose(poses[tied.other], tied.other_after)
        elif tied.kind.ties == "pose_place":
            other = view.places(state)[tied.other]
        found = tied.kind.linearise(pose, other, tied.columns)
        weight = 1.0 / stack_columns(tied.columns, *tied.kind.sigma)
        measured = np.isfinite(found.residual) & np.isfinite(weight)
        weight = np.where(measured, weight, 0.0)[..., None]
        residual = np.where(measured, found.residual, 0.0) * weight[..., 0]
        by_pose = view.by_pose(weight * found.by_pose @ se3.adjoint(se3.inverse(tied.after)))
        by_others = list[FloatArray]()
        if found.by_other is not None and tied.kind.ties == "pose_pose":
            by_others = list(view.by_pose(weight * found.by_other @ se3.adjoint(se3.inverse(tied.other_after))))
        elif found.by_other is not None:
            by_others = view.by_place(state, tied.other, weight * found.by_other)
        moved = np.any(by_pose != 0.0, axis=2)
        if by_others:
            moved |= np.array([np.any(by_other != 0.0, axis=1) for by_other in by_others])
        return np.where(moved, residual, 0.0), by_pose, by_others

    def linearise(self, state: State, out: Room) -> Slices[float]:
        """Fill in the factors; each is an outlier or not as a whole."""
        residual, by_pose, by_other = self.residuals(state)
        cost, at = 0.0, 0
        tail = HEAVY_TAIL * residual.shape[1] if self.heavy else 0.0
        for k, own in enumerate(residual):
            out.weights[k], loss = weigh(float(own @ own), self.log_odds, tail, 0.0)
            cost += loss
            block = np.sqrt(out.weights[k]) * np.hstack([by_pose[k], *by_other[k : k + 1], -own[:, None]])
            out.values[at : at + block.size] = block.ravel()
            at += block.size
        yield from ()
        return cost


def frame_of(measured: Sequence[Tied], scratch: str = "first_pose") -> str:
    """Return what the frame of a solution is: that of measurements that have one, or `scratch`."""
    return next((tied.kind.name for tied in measured if tied.kind.frame is not None), scratch)
