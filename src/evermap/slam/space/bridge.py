"""Poses between poses in space: where the robot was in frames that saw nothing, of which only the odometry tells.

The chain of the odometry is conditioned on the poses before and after as in the plane (`slam.bridge`); what differs is
its noise, and its scale, with which poses between others move.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.estimate.sparse.elimination import Spread
from evermap.geometry import se3
from evermap.slam.bridge import condition_on_ends, joint_of_ends
from evermap.slam.space.problem import SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.types import FloatArray, IntArray


class PathFrames(NamedTuple):
    """All frames of a recording that a trajectory has, of which some have a pose in the problem.

    Attributes:
        row: (F,) rows of `SpatialRecording.frames`; the first and the last have a pose.
        stamp_s: (F,) since the first pose.
        lasted_s: (F - 1,) what the variance of each step grows with, as of `SpatialProblem`.
        driven: (F, 7) poses by the odometry, from the identity; all identity without.
        posed: (N,) which of the F have a pose.
    """

    row: IntArray
    stamp_s: FloatArray
    lasted_s: FloatArray
    driven: FloatArray
    posed: IntArray

    @property
    def pose_frame(self) -> IntArray:
        """Return (N,) rows of the frames that have a pose."""
        return self.row[self.posed]

    @property
    def blind(self) -> IntArray:
        """Return (B,) which of the F have none."""
        return np.setdiff1d(np.arange(len(self.row)), self.posed)

    @property
    def before(self) -> IntArray:
        """Return (F,) the last pose, for each frame."""
        return np.searchsorted(self.posed, np.arange(len(self.row)), side="right") - 1

    def lead_on(self, pose: FloatArray, scale: float = 1.0) -> FloatArray:
        """Return poses (F, 7) of all frames by the odometry from the last of some (N, 7), its lengths times a scale."""
        if len(pose) == len(self.row):
            return pose.copy()
        driven = se3.scaled(self.driven, scale)
        return se3.compose(pose[self.before], se3.between(driven[self.posed][self.before], driven))

    def since(self, unsure_s: FloatArray) -> FloatArray:
        """Return seconds (F,) since poses were known, from those (N,) of poses; without odometry they are these."""
        return np.asarray(unsure_s[self.before] + self.stamp_s - self.stamp_s[self.posed][self.before])

    def share_out(self, amount: FloatArray) -> FloatArray:
        """Return amounts (F,) whose sums up to each pose are those of amounts (N,) of poses."""
        after = np.searchsorted(self.posed, np.arange(len(self.row)))
        return np.asarray((amount / np.bincount(after, minlength=len(self.posed)))[after])


def bridge(frames: PathFrames, problem: SpatialProblem, estimate: SpatialEstimate, noise: SpatialNoise) -> FloatArray:
    """Return poses (F, 7) of all frames: those of the problem, and between them the most probable path of the odometry
    with levels of noise.
    """
    pose = frames.lead_on(estimate.pose)
    if len(frames.blind):
        pose[frames.blind] = _Chain(frames, problem, estimate, noise).pose
    return pose


def bridge_covariance(
    frames: PathFrames,
    problem: SpatialProblem,
    estimate: SpatialEstimate,
    noise: SpatialNoise,
    weight: FloatArray,
    spread: Spread,
) -> FloatArray:
    """Return covariances (F, 6, 6) of the poses of all frames.

    Args:
        frames: all of them.
        problem: the measurements.
        estimate: the values.
        noise: of the odometry.
        weight: (N - 1,) of the odometry between poses.
        spread: covariances, with those of consecutive poses.
    """
    n, blind = len(estimate.pose), frames.blind
    own = spread.own[: 36 * n].reshape(n, 6, 6)
    found = own[frames.before]
    if not len(blind):
        return found
    chain, of = _Chain(frames, problem, estimate, noise), frames.before[blind]
    joint, with_scale = np.zeros((len(of), 13, 13)), spread.with_border[: 6 * n, -1].reshape(n, 6)
    joint[:, :12, :12] = joint_of_ends(own[of], own[of + 1], spread.pairs[of])
    joint[:, :12, 12] = joint[:, 12, :12] = np.hstack([with_scale[of], with_scale[of + 1]])
    joint[:, 12, 12] = spread.with_border[-1, -1]
    by, collected = chain.by_ends(), chain.held.lost / np.maximum(weight, 1e-12)[of, None, None]
    collected[:, :3] *= chain.unit
    collected[:, :, :3] *= chain.unit
    found[blind] = by @ joint @ np.swapaxes(by, 1, 2) + collected
    return found


class _Chain:
    """Frames without a pose, of the odometry between the poses before and after; lengths are those of the odometry.

    Attributes:
        pose: (B, 7) where the robot was, in true lengths.
        held: the chain given both ends.
        unit: true lengths over those of the odometry.
    """

    def __init__(
        self, frames: PathFrames, problem: SpatialProblem, estimate: SpatialEstimate, noise: SpatialNoise
    ) -> None:
        self.unit = float(np.exp(estimate.log_scale))
        driven = se3.scaled(frames.driven, float(np.exp(problem.odometry_log)))
        since = se3.between(driven[frames.posed][frames.before], driven)  # from the last pose on
        lasted_s = np.maximum(frames.lasted_s, 1e-9)
        variance = np.repeat([noise.translation**2, noise.rotation**2], 3)
        begin = np.maximum(np.searchsorted(frames.posed, np.arange(1, len(frames.row))) - 1, 0)
        carried = se3.adjoint(se3.between(driven[frames.posed][begin], driven[1:]))  # from a step's end to its begin
        by_step = lasted_s[:, None, None] * (carried * variance) @ np.swapaxes(carried, 1, 2)
        total = np.concatenate([np.zeros((1, 6, 6)), np.cumsum(by_step, axis=0)])
        total = total - total[frames.posed][np.append(0, begin)]
        blind, of = frames.blind, frames.before[frames.blind]
        after = frames.posed[of + 1]
        ahead = se3.adjoint(se3.inverse(se3.between(driven[blind], driven[after])))
        way = se3.between(driven[frames.posed][of], driven[after])
        carry, over = se3.adjoint(se3.inverse(since[blind])), se3.adjoint(se3.inverse(way))
        at = carry @ total[blind] @ np.swapaxes(carry, 1, 2)
        self.held = condition_on_ends(carry, ahead, at, over @ total[after] @ np.swapaxes(over, 1, 2))
        own = se3.scaled(estimate.pose, 1.0 / self.unit)
        closing = se3.local(se3.compose(own[of], way), own[of + 1])
        here = se3.compose(own[of], since[blind])
        here = se3.retract(here, np.einsum("bij,bj->bi", self.held.gain, closing))
        self.pose, self._ends = se3.scaled(here, self.unit), (estimate.pose[of], estimate.pose[of + 1])

    def by_ends(self) -> FloatArray:
        """Return derivatives (B, 6, 13) by the poses before and after and by the logarithm of the scale."""
        shrunk = np.repeat([1.0 / self.unit, 1.0], 3)
        found = np.zeros((len(self.pose), 6, 13))
        for at, (by, end) in enumerate(zip(np.split(self.held.by_ends, 2, axis=2), self._ends, strict=True)):
            at_origin = -se3.inverse(end)[:, :3]  # seen from the pose, so it moves as all lengths grow
            found[:, :, 6 * at : 6 * at + 6] = by * shrunk
            found[:, :, 12] -= np.einsum("bij,bj->bi", by[:, :, :3], at_origin) / self.unit
        found[:, :3] *= self.unit
        found[:, :3, 12] -= se3.inverse(self.pose)[:, :3]
        return found
