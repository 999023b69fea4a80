"""From 'these moved together' to a problem that least squares can solve: priors loosened, places added.

A group that moved before the session keeps its places; their prior gains the covariance of the group's motion. A group
that moved within the session gets a second place for every member, tied to the first by that motion, and its later
detections go there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse

from evermap.config import ChangesConfig
from evermap.estimate.robust import weigh
from evermap.estimate.sparse.system import Slices
from evermap.geometry import se2
from evermap.slam.changes.gain import spread_of
from evermap.slam.kernels import N_SENSOR, detection_residual, kernel
from evermap.slam.problem import Estimate, Noise, Problem, between_rows, embed, independent, padded
from evermap.slam.smoother import Smoother
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class GivenMap:
    """Prior of the landmarks before the session.

    Attributes:
        mean: (L, 2) positions.
        covariance: (L, 2, 2) of each.
        given: (L,) landmarks that it contains.
    """

    mean: FloatArray
    covariance: FloatArray
    given: BoolArray

    @classmethod
    def empty(cls, count: int) -> GivenMap:
        """Return an empty map of `count` landmarks."""
        return cls(np.zeros((count, 2)), np.zeros((count, 2, 2)), np.zeros(count, dtype=np.bool_))


@dataclass(frozen=True, slots=True)
class MovedGroup:
    """Landmarks that moved together.

    Attributes:
        members: (k,) their rows, sorted.
        turns: whether they also turned.
        motion: (3,) displacement of the centroid [m], and angle [rad], as far as known.
        window: from which window of the session on; 0 = before it.
        since_s: first stamp at the new places, on the problem's clock; None before the session.
        between_s: the change happened between these two stamps; None before the session.
    """

    members: IntArray
    turns: bool
    motion: FloatArray
    window: int
    since_s: float | None = None
    between_s: tuple[float, float] | None = None

    def same_as(self, other: MovedGroup) -> bool:
        """Return whether landmarks, kind of motion and time are the same."""
        return (
            np.array_equal(self.members, other.members)
            and self.turns == other.turns
            and (self.since_s is None) == (other.since_s is None)
            and (self.since_s is None or other.since_s is None or abs(self.since_s - other.since_s) < 1.0)
        )

    def moved(self, position: FloatArray) -> FloatArray:
        """Return (k, 2) the members' positions after the motion."""
        return se2.move_together(position[self.members], self.motion[:2], float(self.motion[2]))

    def motion_prior(self, position: FloatArray, prior: ChangesConfig) -> tuple[FloatArray, FloatArray]:
        """Return mean (k, 2) and covariance (2 k, 2 k) of the members' displacements, linearised at the angle found."""
        own = position[self.members] - position[self.members].mean(axis=0)
        columns = np.tile(np.eye(2), (len(own), 1))
        mean = np.zeros_like(own)
        if self.turns:
            angle = float(self.motion[2])
            turned = own @ se2.rotation(angle).T
            tangent = np.column_stack([-turned[:, 1], turned[:, 0]])
            columns = np.column_stack([columns, tangent.ravel()])
            mean = turned - own - angle * tangent
        variance = spread_of(self.motion, prior)[: columns.shape[1]] ** 2
        return mean, (columns * variance) @ columns.T


def explained(
    problem: Problem, estimate: Estimate, given: GivenMap, groups: tuple[MovedGroup, ...], prior: ChangesConfig
) -> tuple[Problem, Estimate, IntArray]:
    """Return the problem in a world where `groups` moved.

    Before, `landmark_row` says which landmark was seen, and the estimate has one row a landmark; the covariance of the
    `given` map is as it shall be believed.

    Returns:
        Problem, start values, and (L',) the landmark of every place.
    """
    count = len(given.mean)
    covariance = np.where(given.given[:, None, None], given.covariance, np.eye(2))
    mean = np.where(given.given[:, None], given.mean, np.nan_to_num(estimate.landmark))
    information = independent(np.where(given.given[:, None, None], np.linalg.inv(covariance), 0.0))
    landmark, landmark_row = estimate.landmark.copy(), problem.landmark_row.copy()
    places: list[int] = list(range(count))
    stamp_s = problem.seen_s
    for group in groups:
        offset, motion_covariance = group.motion_prior(mean, prior)
        members = group.members
        if group.since_s is None:
            rows = se2.xy_rows(members)
            own = independent(covariance[members]).toarray()
            landmark[members] = group.moved(mean)
            mean[members] += offset
            tied = np.linalg.inv(own + motion_covariance) - between_rows(information, rows).toarray()
            information = sparse.csr_array(information + embed(tied, rows, 2 * len(places)))
            continue
        new = len(places) + np.arange(len(members))
        places.extend(int(j) for j in members)
        tie = np.linalg.inv(motion_covariance + prior.rigid_m**2 * np.eye(2 * len(members)))
        both = se2.xy_rows(np.append(members, new))
        information = padded(information, len(new))
        parted = embed(np.kron([[1.0, -1.0], [-1.0, 1.0]], tie), both, 2 * len(places))
        information = sparse.csr_array(information + parted)
        mean = np.vstack([mean, mean[members] + offset])
        landmark = np.vstack([landmark, group.moved(landmark[:count])])
        for k, j in enumerate(members):
            landmark_row[(problem.landmark_row == j) & (stamp_s >= group.since_s)] = new[k]
    return (
        replace(problem, landmark_row=landmark_row, landmark_mean=mean, landmark_information=information),
        Estimate(estimate.pose, landmark, estimate.states),
        np.array(places, dtype=np.int64),
    )


HELD_M = 0.005
"""To this the other landmarks are held meanwhile."""


def unsway(problem: Problem, estimate: Estimate, noise: Noise, members: IntArray) -> Slices[Estimate]:
    """Return the estimate with poses that are not distorted by sightings of the members, in slices.

    Sightings that were given to the wrong places have drawn the poses towards these, and would be right again there.
    """
    rest = replace(
        problem.seeing(~np.isin(problem.landmark_row, members)),
        # the other landmarks stay where they are, or the whole might turn away from the members' places
        landmark_mean=np.nan_to_num(estimate.landmark[: len(problem.landmark_mean)]),
        landmark_information=independent(np.tile(np.eye(2) / HELD_M**2, (len(problem.landmark_mean), 1, 1))),
    )
    start = Estimate(estimate.pose, estimate.landmark[: len(problem.landmark_mean)], estimate.states)
    free, _ = yield from Smoother(rest, noise, heavy=True).solve_in_slices(start, iterations=5, tolerance=1e-4)
    return Estimate(free.pose, estimate.landmark, free.states)


def parting_time(
    problem: Problem,
    estimate: Estimate,
    noise: Noise,
    members: IntArray,
    old: FloatArray,
    new: FloatArray,
    within_s: tuple[float, float],
    interval: float,
) -> tuple[float, tuple[float, float]]:
    """Return the first stamp [s] at the new places, and two stamps between which the change happened.

    Landmarks `members` (k,) of a group changed from `old` (k, 2) to `new` places, between two stamps `within_s`; with
    probability `interval` it was between the stamps returned.
    """
    stamp_s = problem.seen_s
    inside = (stamp_s >= within_s[0]) & (stamp_s <= within_s[1])
    mine = np.flatnonzero(np.isin(problem.landmark_row, members) & inside)
    if len(mine) < 2:
        return within_s[1], within_s
    column = np.searchsorted(members, problem.landmark_row[mine])
    sigma = problem.find_sigma(noise)[mine]
    loss = np.empty((2, len(mine)))
    for k, place in enumerate((old, new)):
        _losses(
            estimate.pose[problem.pose_row[mine]], place[column], estimate.states, problem.mount,
            problem.reading[mine], sigma, noise.outlier_log_odds, loss[k],
        )  # fmt: skip
    stamp_s = stamp_s[mine]
    first, (low, high) = find_instant(loss[0] - loss[1], stamp_s, interval)
    return float(stamp_s[first]), (float(stamp_s[low]), float(stamp_s[high]))


def find_instant(gain: FloatArray, stamp_s: FloatArray, interval: float) -> tuple[int, tuple[int, int]]:
    """Return the first reading at a new place, and two between which the change happened with probability `interval`.

    Args:
        gain: (n,) nats that each reading gains at the new place, in order of time; n is at least 2.
        stamp_s: (n,) their stamps.
        interval: probability that the change was between the two.
    """
    # log likelihood of the change just before reading k, for k = 1 .. n - 1: both places were seen
    log_likelihood = -np.cumsum(gain)[:-1]
    weight = np.exp(log_likelihood - log_likelihood.max())
    # between two readings every instant is as likely as another
    weight *= np.maximum(np.diff(stamp_s), 1e-9)
    cumulated = np.cumsum(weight) / weight.sum()
    low = int(np.searchsorted(cumulated, 0.5 * (1.0 - interval)))
    high = min(int(np.searchsorted(cumulated, 0.5 * (1.0 + interval))), len(weight) - 1)
    return int(np.argmax(weight)) + 1, (low, high + 1)


@kernel
def _losses(
    pose: FloatArray, place: FloatArray, states: FloatArray, mount: FloatArray, reading: FloatArray, sigma: FloatArray,
    log_odds: float, out: Any,
) -> None:  # fmt: skip
    """Negative log likelihood of every reading of a landmark at `place`, outliers included."""
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    for m in range(len(reading)):
        detection_residual(pose[m], place[m], states, mount, reading[m, 0], reading[m, 1], e, jx, jl, jc)
        squared = (e[0] / sigma[m, 0]) ** 2 + (e[1] / sigma[m, 1]) ** 2
        out[m] = weigh(squared, log_odds, 0.0, 0.0)[1]
