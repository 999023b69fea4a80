"""One Gaussian of the newest pose, the calibration states and the nearby places, frame by frame, in plane and space.

Given the newest pose the older ones say nothing more about the next detection. So a step predicts the newest pose by
its odometry, marginalises the one before, and updates with the detections of the frame: an iterated extended Kalman
filter (Bell and Cathey 1993) whose measurement noise is re-weighted like the smoother's.

Errors are twists of the pose, and of places with an orientation, each in its own frame, and shifts of points in the
world. Steps are invariant (Barrau and Bonnabel 2015, "An EKF-SLAM algorithm with consistency properties"): a step of
the heading carries whatever stands in the world, and the covariance is re-expressed at the new state, so that a heading
that no detection shows stays as uncertain as it was.

Only the places that were used last stand in the covariance (`nearby_places`). In a fixed map places are only considered
(Schmidt 1966): they are wrong, by what their covariance says, and wrong in the same way in every frame. A filter that
takes that for fresh noise of each detection believes after a hundred frames in its pose to a tenth of the map's error.

What depends on the dimension is in two specialisations, `planar_filter.PlanarFilter` and
`space.local_filter.SpatialFilter`: how detections are linearised, and how a step moves what stands in the world.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from evermap.slam.filter_kernels import (
    add_across,
    compare_each,
    condition,
    consider,
    drive_on,
    part_of,
    solve_frame,
    spread_of_frame,
    weigh_alone,
    weigh_by_surprise,
    weigh_by_the_others,
)
from evermap.slam.nearby_places import NearbyPlaces
from evermap.types import FloatArray, IntArray

ITERATIONS = 10
SMALL_STEP = 1e-4
"""Iterations of an update at most, and the step (m, rad or 1) that ends them."""
CONSIDERED_STEP = 1e-2
"""The same where places are only considered, and none can be led astray: less bends no measurement equation."""
SETTLED_WEIGHT = 0.02
"""Change of a weight below which the iterations end."""
BELIEVED, HEAVY, BY_OTHERS, GATED = 0, 1, 2, 3
"""How detections are weighed: not at all; by the Cauchy's tails, as in the smoother's first rounds; as inliers or
outliers, where the pose is uncertain by what the others of the frame say; not at all, but as linear as the joint gates
that they passed: iterated, a wrong pairing leads farther astray (MRCLAM 6, robot 4: 0.7 m for 0.12 m)."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Odometry between two poses of D degrees of freedom.

    Attributes:
        increment: (3,), in space (7,), the second pose seen from the first.
        by_states: (D, C) its derivative, at its end, by the last C calibration states: those of the odometry.
        covariance: (D, D) its noise.
    """

    increment: FloatArray
    by_states: FloatArray
    covariance: FloatArray


class SightedFrame(Protocol):
    """Detections (M,) with a place each, linearised where a step from the pose and the places of a filter leads to.

    Attributes:
        residual: (M, R) whitened; zero behind those that a detection has.
        jacobian: (M, R, W) derivatives by the errors before the step.
        column: (M, W) which numbers these are by, of pose, calibration and the M places one after the other; the last
            ones are of its place.
        n_rows: (M,) residuals of each.
        tail: (M,) where the Cauchy's tails begin (`robust.weigh`).
    """

    residual: FloatArray
    jacobian: FloatArray
    column: IntArray
    n_rows: IntArray
    tail: FloatArray

    def linearise(self, step: FloatArray) -> None:
        """Fill in residuals and derivatives at a step (own + D M,) of pose, calibration and places."""


class FrameInnovations(NamedTuple):
    """Detections (M,) before a filter used them.

    Attributes:
        spread: (M R, M R) covariance of the innovations but for the noise, which is 1.
        residual: (M, R).
        by_pose: (M, R, D) derivatives.
        n_rows: (M,) residuals of each.
    """

    spread: FloatArray
    residual: FloatArray
    by_pose: FloatArray
    n_rows: IntArray


class Updated(NamedTuple):
    """What an update by detections (M,) says of them.

    Attributes:
        nis: (M,) squared distance of each innovation by itself, before the frame was used; only if it was weighed
            `BY_OTHERS`, else 0.
        weight: (M,) of each.
        before: the innovations; None without detections.
    """

    nis: FloatArray
    weight: FloatArray
    before: FrameInnovations | None


class LocalFilter(NearbyPlaces, ABC):
    """The newest pose, the calibration states and the places around: drive, compare, update.

    A subclass says how a motion moves the pose (`_move_pose`), how detections are linearised (`_sight_frame`), and how
    a step moves all that stands in the world (`_carry`).
    """

    def drive(self, motion: Motion) -> None:
        """Advance the newest pose."""
        self._now += 1
        self.pose, carry = self._move_pose(motion)
        drive_on(self.covariance, self.own, carry, motion.by_states, motion.covariance)

    def ahead(self, motion: Motion) -> tuple[FloatArray, FloatArray]:
        """Return the pose after a motion, and its covariance; the filter stays where it is."""
        covariance = self.covariance[: self.own, : self.own].copy()
        pose, carry = self._move_pose(motion)
        drive_on(covariance, self.own, carry, motion.by_states, motion.covariance)
        return pose, covariance[: self.group.dim, : self.group.dim].copy()

    def compare(
        self, rows: IntArray, seen: Any, spread: FloatArray | None = None, *, is_apart: bool = False
    ) -> tuple[FloatArray, FloatArray, SightedFrame]:
        """Compare detections (M,) with a place each, each pair separately.

        Args:
            rows: (M,) places.
            seen: detections, as the subclass has them.
            spread: (M, D, D) covariances of places that do not stand in that of the filter.
            is_apart: take these for all places, as if they were not correlated with the pose.

        Returns:
            (M,) squared Mahalanobis distances with `S = H P H' + 1` of whitened residuals, (M,) `log |S|`, and the
            detections, linearised.
        """
        frame = self._sight_frame(rows, seen)
        frame.linearise(np.zeros(self.own + self.dim * len(rows)))
        slots = np.full(len(rows), -1) if is_apart else self._slot[rows]
        places = np.zeros((0, self.dim, self.dim)) if spread is None else spread
        nis, log_det = compare_each(
            self.covariance, self.own, frame.residual, frame.jacobian, frame.column, slots, places
        )
        return nis, log_det, frame

    def update(
        self, rows: IntArray, seen: Any, *, weighing: int = BELIEVED, log_odds: FloatArray | None = None
    ) -> Updated:
        """Update by all detections of a frame at once, relinearised and re-weighted until nothing moves.

        Only pose, calibration and the places that are seen take part in that; the other places follow at last. Places
        that are only considered (Schmidt 1966) stand in the covariance with the correlations that detections make, but
        stay where they are: pose and calibration get the gain that is best for them, the places none.

        Args:
            rows: (M,) places in the covariance.
            seen: detections (M,), as the subclass has them.
            weighing: how detections are weighed.
            log_odds: (M,) for 'no outlier' where a detection is exactly where it is expected, for `BY_OTHERS`.
        """
        count, own = len(rows), self.own
        nis, weight = np.zeros(count), np.ones(count)
        if count == 0:
            return Updated(nis, weight, None)
        odds = np.zeros(count) if log_odds is None else log_odds
        where, part = part_of(self.covariance, own, self.dim, self._slot[rows])
        frame = self._sight_frame(rows, seen)
        residual, jacobian, column = frame.residual, frame.jacobian, frame.column
        n, moving, small = residual.size, len(where), SMALL_STEP
        if self._considered:
            moving, small = own, CONSIDERED_STEP
        step, innovation, pull = np.zeros(len(where)), np.zeros(n), np.zeros(n)
        gain, spread, root = np.zeros((n, len(where))), np.zeros((n, n)), np.zeros((n, n))
        is_unsure, credible = False, weight
        for iteration in range(1 if weighing == GATED else ITERATIONS):
            frame.linearise(step)
            spread_of_frame(part, jacobian, column, gain, spread)
            if iteration == 0:
                by_pose = jacobian[..., : self.group.dim].copy()
                before = FrameInnovations(spread.copy(), residual.copy(), by_pose, frame.n_rows)
                if weighing == BY_OTHERS:
                    is_unsure = weigh_alone(
                        part, spread, residual, jacobian, column, self.dim, frame.n_rows, odds, nis, weight
                    )
                    credible = weight.copy()
            if weighing == HEAVY:
                weigh_by_surprise(spread, residual, frame.tail, iteration > 0, weight)
            moved = solve_frame(
                spread, gain, residual, jacobian, column, weight, root, innovation, pull, step, moving
            )  # fmt: skip
            changed = 0.0
            if is_unsure:
                changed = weigh_by_the_others(spread, pull, odds, frame.tail, iteration == 0, credible, weight)
            if moved < small and changed < SETTLED_WEIGHT:
                break
        white = np.zeros((n, len(self.covariance) + 1))
        add_across(self.covariance, jacobian, where[column], white)
        white[:, -1] = innovation
        if self._considered:
            consider(self.covariance, own, root, np.ascontiguousarray(white[:, :-1]))
            step = step[:own]
        else:
            condition(self.covariance, root, white)
            step = -(white[:, -1] @ white[:, :-1])
        self.states = self.states + step[self.group.dim : own]
        self._carry(step)
        return Updated(nis, weight, before)

    @abstractmethod
    def _move_pose(self, motion: Motion) -> tuple[FloatArray, FloatArray]:
        """Return the pose after a motion, and the derivatives (D, D) of its error by that of the pose before."""

    @abstractmethod
    def _sight_frame(self, rows: IntArray, seen: Any) -> SightedFrame:
        """Return detections (M,) of places (M,), to be linearised around where pose and places are now."""

    @abstractmethod
    def _carry(self, step: FloatArray) -> None:
        """Move the pose and all places in the covariance by a step of all its numbers, or, if places are considered, of
        pose and calibration alone; re-express the covariance there.
        """
