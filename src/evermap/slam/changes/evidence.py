"""The Gaussian of the landmarks from the measurements alone, and its comparison with a map.

Poses and calibration states are eliminated from the linearised problem. What is left is a Gaussian over the landmarks
whose freedom to be moved, turned and (within the calibration's prior) stretched as a whole is part of it, so that no
alignment is ever chosen. So that things may move during the session too, time is cut into windows and every landmark
has a copy in every window it was seen in; a static landmark is one whose copies coincide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from evermap.config import RangesConfig
from evermap.estimate.sparse.system import Slices
from evermap.geometry import se2
from evermap.slam.batch import middles, sight_at
from evermap.slam.calibration import SLOPE, CalibrationPrior, seat_sensor
from evermap.slam.kernels import N_STATES
from evermap.slam.problem import Estimate, Noise, Problem
from evermap.slam.ranges import Ranged, locate_by_ranges
from evermap.slam.smoother import Smoother
from evermap.types import BoolArray, FloatArray, IntArray

MS_OF_DETECTION, MS_OF_CUBE = 1e-3, 1e-7
"""Milliseconds of a usual core for each detection that is sorted, and each cubed number of a dense system."""
TINY_INFORMATION = 1e-6
"""Of poses at the borders of windows that nothing holds [1/m^2]: a kilometre."""


@dataclass(frozen=True, slots=True)
class WindowEvidence:
    """Quadratic log likelihood of the copies: `pull' x - x' information x / 2`, `x` the step from `position`.

    Attributes:
        landmark: (R,) landmark of every copy.
        window: (R,) its window.
        position: (R, 2) where it was linearised [m], sizes as the calibration's prior has them; in space (R, 3), or
            (R, 6) with the rotation vector from the given orientation, in the axes of the map.
        information: (2 R, 2 R) with poses and calibration eliminated; lets the whole move and turn.
        pull: (2 R,) gradient.
        log_scale_sigma: how well the size of the whole is known.
        log_constant: of the likelihood, for comparing degrees of softness.
    """

    landmark: IntArray
    window: IntArray
    position: FloatArray
    information: FloatArray
    pull: FloatArray
    log_scale_sigma: float
    log_constant: float = 0.0

    @property
    def numbers(self) -> int:
        """Numbers of a landmark: 2 in the plane, 3 of points in space, 6 with orientations."""
        return int(self.position.shape[1])

    def first_seen(self, otherwise: FloatArray) -> FloatArray:
        """Return (L, numbers) the first copy of every landmark; `otherwise` (L, numbers) for those that have none."""
        position = otherwise.copy()
        landmark, first = np.unique(self.landmark, return_index=True)
        position[landmark] = self.position[first]
        return position

    def without(self, copies: BoolArray) -> WindowEvidence:
        """Return the evidence with some copies (R,) left out, as if their sightings had not been made."""
        kept = ~copies
        rows = np.repeat(kept, self.numbers)
        out = np.repeat(copies, self.numbers)
        cross = self.information[np.ix_(rows, out)]
        inner = self.information[np.ix_(out, out)]
        solved = np.linalg.solve(inner, np.column_stack([cross.T, self.pull[out]]))
        return replace(
            self,
            landmark=self.landmark[kept],
            window=self.window[kept],
            position=self.position[kept],
            information=self.information[np.ix_(rows, rows)] - cross @ solved[:, :-1],
            pull=self.pull[rows] - cross @ solved[:, -1],
        )

    def soften(self, sigma_m: float) -> WindowEvidence:
        """Return the evidence with an error of its own in every copy: errors of sightings are correlated."""
        if sigma_m == 0.0:
            return self
        factor = cho_factor(self.information + np.eye(len(self.pull)) / sigma_m**2)
        solved = cho_solve(factor, np.column_stack([self.information, self.pull]))
        log_determinant = 2.0 * float(np.log(np.diag(factor[0])).sum()) + 2.0 * len(self.pull) * np.log(sigma_m)
        return replace(
            self,
            information=self.information - self.information @ solved[:, :-1],
            pull=self.pull - self.information @ solved[:, -1],
            log_constant=self.log_constant + 0.5 * (float(self.pull @ solved[:, -1]) - log_determinant),
        )


class Comparison(NamedTuple):
    """The evidence seen from a map: `log p(x) = b' x - x' A x / 2` of the copies' displacements from their places.

    The landmarks' places, with the map's uncertainty, and the size of the whole are integrated out.

    Attributes:
        precision: (2 R, 2 R) `A`.
        pull: (2 R,) `b`.
        log_evidence: that nothing moved, up to a constant that is the same for all maps.
        freedom: degrees of freedom of the misfit.
        information, drawn: (2 R, 2 R), (2 R,) of the session alone, about the places in the map.
    """

    precision: FloatArray
    pull: FloatArray
    log_evidence: float
    freedom: float
    information: FloatArray
    drawn: FloatArray

    @property
    def misfit(self) -> float:
        """Return `e' A e` of the displacements `e` if all were free: chi-square if nothing moved."""
        held = self.information + TINY_INFORMATION * np.eye(len(self.drawn))
        return float(np.linalg.solve(held, self.drawn) @ self.pull)


def dense_ms(numbers: int) -> float:
    """Return the milliseconds that a dense system of so many numbers takes."""
    return MS_OF_CUBE * numbers**3


def landmark_evidence(
    problem: Problem,
    estimate: Estimate,
    noise: Noise,
    prior: CalibrationPrior,
    bounds: IntArray,
    fewest: int,
    ranges: RangesConfig,
    *,
    sized: bool = True,
    row: IntArray | None = None,
) -> Slices[WindowEvidence]:
    """Eliminate poses and calibration of a linearised problem, window by window, in slices.

    The problem's priors of start and landmarks are left out; every landmark that was seen has a position in the
    estimate, and `prior` is of the calibration as the user means it. Windows begin at the poses `bounds` (W + 1,), of
    which the last is the number of poses. A copy takes the `fewest` sightings at least: one or two may be wrong
    identities. What is seen by `ranges` alone, most of which disagree with its place, is where those of the window
    locate it. If `sized`, range slope and size are divided by their priors; else positions stay in the metres of the
    sensor, which is enough where there is no map to compare with. If some have moved, `row` (W, L) are the places of
    the estimate at which landmarks are in each window.
    """
    held = prior.without_scale()
    n_windows = len(bounds) - 1
    estimate = in_sensor_metres(estimate, prior)
    pieces: list[_Piece] = []
    for w in range(n_windows):
        here = estimate if row is None else replace(estimate, landmark=estimate.landmark[row[w]])
        piece = yield from _piece(problem, here, noise, held, (bounds[w], bounds[w + 1], fewest), ranges, sized=sized)
        pieces.append(piece)
    information, right, at_pose = _join_windows(pieces)
    yield dense_ms(len(right))
    states = np.arange(len(right) - N_STATES, len(right))
    information[states, states] += 1.0 / held.sigma**2
    right[states] += (held.mean - estimate.states) / held.sigma**2
    others = np.arange(at_pose, len(right))
    information[others, others] += TINY_INFORMATION
    mine = np.arange(at_pose)
    solved = cho_solve(
        cho_factor(information[np.ix_(others, others)]),
        np.column_stack([information[np.ix_(others, mine)], right[others]]),
    )
    cross = information[np.ix_(mine, others)]
    scale, log_sigma = 1.0, 0.0
    if sized:
        yield dense_ms(len(right))
        held_somewhere = information + TINY_INFORMATION * np.eye(len(right))
        covariance: FloatArray = np.asarray(np.linalg.solve(held_somewhere, np.eye(len(right))[:, states])[states])
        _, _, scale, log_sigma = prior.split_scale(estimate.states, covariance)
    yield dense_ms(len(right))
    centre = estimate.landmark[estimate.known].mean(axis=0)
    position = np.concatenate([piece.position for piece in pieces])
    return WindowEvidence(
        landmark=np.concatenate([piece.landmark for piece in pieces]),
        window=np.repeat(np.arange(n_windows), [len(piece.landmark) for piece in pieces]),
        position=centre + scale * (position - centre),
        information=(information[np.ix_(mine, mine)] - cross @ solved[:, :-1]) / scale**2,
        pull=(right[mine] - cross @ solved[:, -1]) / scale,
        log_scale_sigma=log_sigma,
    )


def _join_windows(pieces: Sequence[_Piece]) -> tuple[FloatArray, FloatArray, int]:
    """Return the normal equations of all windows, and the first row of a pose.

    Unknowns are copies of landmarks, poses between windows and calibration states, in this order.
    """
    count = sum(len(piece.landmark) for piece in pieces)
    at_pose, at_states = 2 * count, 2 * count + 3 * (len(pieces) + 1)
    information = np.zeros((at_states + N_STATES, at_states + N_STATES))
    right = np.zeros(at_states + N_STATES)
    first = 0
    for w, piece in enumerate(pieces):
        copies = np.arange(2 * first, 2 * (first + len(piece.landmark)))
        poses = at_pose + 3 * w + np.arange(3)
        rows = np.concatenate([poses + 3, poses, copies, at_states + np.arange(N_STATES)])
        information[np.ix_(rows, rows)] += piece.information
        right[rows] += piece.right
        first += len(piece.landmark)
    return information, right, at_pose


def compare(evidence: WindowEvidence, mean: FloatArray, covariance: FloatArray, mapped: BoolArray) -> Comparison:
    """Set the evidence against a map of means (L, n) with covariances (L, n, n), of n numbers a landmark.

    Of landmarks that it does not hold, not `mapped` (L,), only what happens during the session shows.
    """
    seen = np.unique(evidence.landmark)
    column = np.searchsorted(seen, evidence.landmark)
    count, n_seen, n = len(evidence.landmark), len(seen), evidence.numbers
    freedom = {2: 3, 3: 6, 6: 6}[n]  # of a motion of the whole
    anchor = np.where(mapped[:, None], mean, evidence.first_seen(mean))[seen]
    # unknowns behind all copies: places and size
    offset = evidence.position - anchor[column]
    size = evidence.log_scale_sigma * (evidence.position - evidence.position.mean(axis=0))
    size[:, 3:] = 0.0
    places = sparse.csr_array(
        (np.ones(n * count), (np.arange(n * count), se2.xy_rows(column, n))), shape=(n * count, n * n_seen)
    )
    spread = sparse.csr_array(sparse.hstack([places, size.reshape(-1, 1)]))
    prior = np.zeros((n * n_seen + 1, n * n_seen + 1))
    log_prior_determinant = 0.0
    for k in np.flatnonzero(mapped[seen]):
        information = np.linalg.inv(covariance[seen[k]])
        prior[n * k : n * k + n, n * k : n * k + n] = information
        log_prior_determinant += float(np.linalg.slogdet(information)[1])
    prior[-1, -1] = 1.0
    # without a map the whole is free to be anywhere
    prior[np.diag_indices(n * n_seen)] += TINY_INFORMATION
    pull = evidence.pull + evidence.information @ offset.ravel()
    weighted = np.asarray((spread.T @ evidence.information).T)
    root = cholesky(spread.T @ weighted + prior, lower=True)
    half = solve_triangular(root, np.column_stack([weighted.T, spread.T @ pull]), lower=True)
    lost = half[:, :-1].T @ half[:, :-1]  # a matrix times itself, of which one half is computed
    log_determinant = 2.0 * float(np.log(np.diag(root)).sum()) - log_prior_determinant
    gained = float(half[:, -1] @ half[:, -1])
    moved = offset.ravel()
    offset_term = -float(moved @ evidence.pull + 0.5 * moved @ evidence.information @ moved)
    precision = evidence.information - lost
    return Comparison(
        precision=0.5 * (precision + precision.T),
        pull=pull - half[:, :-1].T @ half[:, -1],
        log_evidence=0.5 * (gained - log_determinant) + evidence.log_constant + offset_term,
        freedom=float(n * (count - np.count_nonzero(~mapped[seen])) - freedom),
        information=evidence.information,
        drawn=pull,
    )


class _Piece(NamedTuple):
    """The information of one window on the pose after it, its first pose, its copies and the states."""

    landmark: IntArray
    position: FloatArray
    information: FloatArray
    right: FloatArray


def _piece(
    problem: Problem,
    estimate: Estimate,
    noise: Noise,
    prior: CalibrationPrior,
    window: tuple[int, int, int],
    ranges: RangesConfig,
    *,
    sized: bool,
) -> Slices[_Piece]:
    start, stop, fewest = window
    last = min(stop + 1, len(problem.stamp_s))
    low, high = np.searchsorted(problem.pose_row, [start, stop])
    enough = np.bincount(problem.landmark_row[low:high], minlength=len(problem.landmark_mean)) >= fewest
    used = low + np.flatnonzero(enough[problem.landmark_row[low:high]])
    landmark, row = np.unique(problem.landmark_row[used], return_inverse=True)
    pose_row = problem.pose_row[used]
    count = len(landmark)
    part = replace(
        problem.seeing(used),
        stamp_s=problem.stamp_s[start:last],
        pose_row=pose_row - start,
        landmark_row=row.astype(np.int64),
        prior=CalibrationPrior(prior.mean, np.full(N_STATES, np.inf), prior.free),
        start_information=0.0,
        landmark_mean=np.zeros((count, 2)),
        landmark_information=sparse.csr_array((2 * count, 2 * count)),
        measurements=tuple(tied.among(start, last) for tied in problem.measurements if tied.kind.ties != "pose_place"),
    )
    sighted = sight_at(estimate.pose[pose_row], part.reading, estimate.states, part.mount)
    position = middles(part.landmark_row, sighted, count)  # of the landmarks by the poses of this window alone
    # ranges alone are linear near where it is only. One bearing of a landmark is a first value (`slam.ranges`), which a
    # map knows better; without one the estimate is no better than that
    ranged = np.bincount(part.landmark_row, part.has_bearing, minlength=count) <= (1 if sized else 0)
    position[ranged] = estimate.landmark[landmark[ranged]]
    local = Estimate(estimate.pose[start:last], position, estimate.states)
    ends = np.unique([0, last - start - 1])
    yield MS_OF_DETECTION * len(used)
    smoother = Smoother(part, noise)
    if ranged.any():
        local = _move_to_ranges(smoother, local, ranged, sighted, ranges)
        position = local.landmark
    information, right = yield from smoother.information_in_slices(local, ends[::-1])
    if len(ends) == 1:  # a window of one pose: it is the first and there is no other
        information, right = np.pad(information, ((3, 0), (3, 0))), np.pad(right, (3, 0))
    return _Piece(landmark, position, information, right)


def _move_to_ranges(
    smoother: Smoother, estimate: Estimate, ranged: BoolArray, sighted: FloatArray, ranges: RangesConfig
) -> Estimate:
    """Move what is `ranged` (L,) to where its ranges locate it, if most of them are outliers where it is.

    Outliers have no information, so that evidence there would not show that it moved. Detections point to `sighted`
    (M, 2), of which the distance from the sensor counts.
    """
    part, position = smoother.problem, estimate.landmark.copy()
    weights = smoother.inlier_probability(estimate)
    eye = se2.compose(estimate.pose, seat_sensor(part.mount, estimate.states))[part.pose_row, :2]
    range_m, sigma_m = np.linalg.norm(sighted - eye, axis=1), part.find_sigma(smoother.noise)[:, 0]
    for k in np.flatnonzero(ranged):
        mine = np.flatnonzero(part.landmark_row == k)
        if np.count_nonzero(weights[mine] > 0.5) >= 0.5 * len(mine):
            continue
        noise_m = float(np.median(sigma_m[mine]))
        still = np.zeros(len(mine))  # poses are known better than odometry alone knows them
        fix = locate_by_ranges(Ranged(eye[mine], still, still, range_m[mine]), noise_m, noise_m, ranges)
        if fix is not None:
            position[k] = fix.place
    return replace(estimate, landmark=position)


def in_sensor_metres(estimate: Estimate, prior: CalibrationPrior) -> Estimate:
    """Return the same explanation with the range slope at its mean, compensated by the scale of everything.

    Only their product is measured; where the odometry's noise is fixed in metres, a likelihood that may choose the size
    prefers a small world (see `CalibrationPrior.without_scale`).
    """
    if prior.without_scale() is prior:
        return estimate
    grow = (1.0 + estimate.states[SLOPE]) / (1.0 + prior.mean[SLOPE])
    states = prior.resize(estimate.states, grow)
    centre = estimate.landmark[estimate.known].mean(axis=0)
    pose = estimate.pose.copy()
    pose[:, :2] = centre + grow * (pose[:, :2] - centre)
    return Estimate(pose, centre + grow * (estimate.landmark - centre), states)
