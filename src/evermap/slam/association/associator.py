"""Frame after frame, which detection is which landmark, and from time to time which landmarks are one.

A detection is given to a landmark only if no other explanation is nearly as good; in doubt it starts a landmark of its
own, which can be merged later, when a batch solution knows more. Nothing is decided that cannot be mended: at the end
every detection is compared once more with the whole map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from evermap.geometry import se2
from evermap.slam.association.assignment import NOBODY, Assignment
from evermap.slam.association.constellation import RISE_NATS, propose_constellation, propose_merges
from evermap.slam.association.jcbb import Pairings, gates, pairing_probability
from evermap.slam.filter_kernels import GATED
from evermap.slam.linearise import detection_residuals
from evermap.slam.local_filter import NO_PLACES, LocalFilter, columns
from evermap.slam.motion import Motion
from evermap.slam.problem import Estimate, Marginals, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.slam.streaming import sighted_at
from evermap.types import BoolArray, FloatArray, IntArray

CAUTION = 2.0
"""Odometry is taken to be this much worse than where learning would start. It is not learned here: what was associated
is what agreed with it."""
SLIP = 3.0
"""And this much worse in a step after which no landmark is where it should be."""


GATE = 0.999
"""Confidence of the gates of single detections and of whole frames."""
P_MATCH = 0.95
"""Probability from which a detection is given to a landmark."""
TIGHT_M2 = 0.04
"""Product of a gate's standard deviations, (0.2 m)^2, within which a wrong choice is harmless for a while."""
P_NEW = 0.1
"""Probability of being none of the known from which it starts a landmark."""
P_MERGE = 0.97
"""Probability from which two landmarks are one."""
UNMET, SMALLEST_M2 = 2.0, 20.0
"""Landmarks not met yet that one expects in the area that the known ones span, which is at least this large."""
MIN_SIGHTINGS = 3
"""Detections that make a landmark."""
FORGET_S = 20.0
"""What has less by then is forgotten."""
FIRST_STOCK = 40
"""Poses before the first batch solution; the next come whenever their number grew by a tenth, or by as many."""
NOISE_FLOOR = 0.5
"""Share of the start's noise of sightings that imaginary ones vouch for."""
INFLATION = 1.3
"""Of the noise of sightings: what was associated is what agreed."""
MOST_COMPARED = 256
"""Landmarks, the nearest, that a frame is compared with."""
MERGE_ROUNDS = 20
"""Merges that are tried whenever stock is taken, at most."""
LAST_ROUNDS = 5
"""Comparisons of every detection with the whole map at the end, at most."""


@dataclass(frozen=True, slots=True)
class _Frame:
    """A frame compared with the map: rows of `pairings` that are certain, and p (n,) of each to be new."""

    pairings: Pairings
    taken: IntArray
    p_new: FloatArray
    sigma: FloatArray


class Associator:
    """Feed frames in order with `step`, then `finish`.

    Args:
        problem: the measurements; its `landmark_row` is not looked at.
        noise: where the noise levels start.
    """

    def __init__(self, problem: Problem, noise: Noise) -> None:
        self._problem = problem
        self._start_noise = noise
        self.noise = replace(noise, odometry=CAUTION * noise.odometry)
        """Noise levels that everything is solved with; detections carry their own."""
        self._slipping = replace(noise, odometry=SLIP * self.noise.odometry)
        self._first = np.searchsorted(problem.pose_row, np.arange(len(problem.stamp_s) + 1))
        self._pose = np.zeros((len(problem.stamp_s), 3))
        self._row: IntArray = np.full(len(problem.pose_row), NOBODY, dtype=np.int64)
        self._sighting_noise = SightingNoise.constant(noise.detection)
        self._filter = LocalFilter(problem.mount, problem.prior, most=MOST_COMPARED)
        self._done = 0
        self._next_stock = FIRST_STOCK

    def step(self) -> None:
        """Associate the next frame."""
        row, local = self._done, self._filter
        detections = np.arange(self._first[row], self._first[row + 1])
        if row == 0:
            covariance = local.covariance.copy()
            covariance[:3, :3] = np.eye(3) / self._problem.start_information
            local.hold(self._problem.start_pose, local.states, covariance, NO_PLACES, local.position)
            frame = self._match(detections)
        else:
            frame = self._after_driving(row, detections)
        self._use(frame, detections)
        self._pose[row] = local.pose
        self._done += 1
        if self._done == self._next_stock:
            self._take_stock()
            self._next_stock = self._done + max(FIRST_STOCK, self._done // 10)

    def _after_driving(self, row: int, detections: IntArray) -> _Frame:
        """The next frame compared with the map; if nothing is where it should be, as after wheels that slipped."""
        local, problem = self._filter, self._problem
        motion = Motion.between(problem, self.noise, row, local.states)
        self._have_near(se2.compose(local.pose, motion.increment))
        before = local.pose.copy(), local.covariance.copy()
        local.drive(motion)
        frame = self._match(detections)
        if len(frame.taken):
            return frame
        after = local.pose, local.covariance  # the wheels slipped, or stamps jittered in a turn?
        local.pose, local.covariance = before
        local.drive(Motion.between(problem, self._slipping, row, local.states))
        slipped = self._match(detections)
        if len(slipped.taken):
            return slipped
        local.pose, local.covariance = after
        return frame

    def _have_near(self, pose: FloatArray) -> None:
        """Have the landmarks around a pose in the filter: all, if they are few."""
        away = np.hypot(*(self._filter.position - pose[:2]).T)
        self._filter.bring(np.argsort(away, kind="stable")[:MOST_COMPARED])

    def finish(self) -> Assignment:
        """Settle everything processed so far."""
        assignment, marginals = self._settled(self._assignment())
        for _ in range(LAST_ROUNDS):
            again = self._reconsidered(assignment, marginals)
            if np.array_equal(again.landmark_row, assignment.landmark_row):
                break
            assignment, marginals = self._settled(again)
        return assignment.without(assignment.sightings < MIN_SIGHTINGS)

    @property
    def _density(self) -> float:
        """Landmarks a square metre that one may still meet."""
        return density_of_unmet(self._filter.position)

    def _match(self, detections: IntArray) -> _Frame:
        """The frame's detections weighed against the landmarks known so far."""
        sigma = INFLATION * self._sighting_noise.of_detections(self._problem)
        pairings = pairings_of_frame(self._filter, self._problem, sigma, detections, density=self._density)
        probability, _ = pairing_probability(pairings, confidence=GATE)
        known = np.zeros(len(detections))
        np.add.at(known, pairings.source, probability)
        taken = np.flatnonzero((probability >= P_MATCH) | self._harmless(pairings, probability, known))
        return _Frame(pairings, taken, 1.0 - known, sigma)

    def _harmless(self, pairings: Pairings, probability: FloatArray, known: FloatArray) -> BoolArray:
        """(K,) the best pairing of a detection where a wrong choice bends nothing, and the end or a merge will tell.

        That is where the gate is small, or where its rivals may well be the same landmark.
        """
        best = np.zeros(len(probability), dtype=bool)
        for s in np.flatnonzero(known >= P_MATCH):
            rows = np.flatnonzero(pairings.source == s)
            first = rows[probability[rows].argmax()]
            rivals = rows[(probability[rows] > 1.0 - P_MATCH) & (rows != first)]
            own = pairings.covariance[2 * first : 2 * first + 2, 2 * first : 2 * first + 2]
            area_m2 = math.sqrt(np.linalg.det(own)) * math.exp(pairings.log_density_new[first]) / self._density
            tight = area_m2 < TIGHT_M2
            best[first] = tight or all(self._may_be_one(pairings.target[first], pairings.target[k]) for k in rivals)
        return best

    def _may_be_one(self, a: int, b: int) -> bool:
        """True where the difference of two landmarks is insignificant."""
        local = self._filter
        at = columns(local.bring(np.array([a, b])))
        by = np.hstack([np.eye(2), -np.eye(2)])
        spread = by @ local.covariance[np.ix_(at, at)] @ by.T + 1e-12 * np.eye(2)
        gap = local.position[a] - local.position[b]
        return bool(gap @ np.linalg.solve(spread, gap) < gates(1, GATE)[1])

    def _use(self, frame: _Frame, detections: IntArray) -> None:
        """Update with the certain pairings, and start landmarks where none is near enough."""
        problem, local, pairings = self._problem, self._filter, frame.pairings
        known, target = detections[pairings.source[frame.taken]], pairings.target[frame.taken]
        self._row[known] = target
        local.update(target, problem.reading[known], frame.sigma[known], weighing=GATED)
        new = detections[frame.p_new >= P_NEW]
        self._row[new] = len(local.position) + np.arange(len(new))
        at = sighted_at(local.pose, problem.reading[new], local.states, problem.mount)
        for row, place in zip(self._row[new].tolist(), at, strict=True):
            local.meet(row, place)
        local.update(self._row[new], problem.reading[new], frame.sigma[new], weighing=GATED)

    def _take_stock(self) -> None:
        """Solve everything so far, merge what is one, and go on from there."""
        assignment, marginals = self._settled(self._without_chance(self._assignment()))
        self._row[: len(assignment.landmark_row)] = assignment.landmark_row
        self._pose[: self._done] = assignment.estimate.pose
        place = assignment.estimate.landmark
        near = np.argsort(np.hypot(*(place - assignment.estimate.pose[-1, :2]).T), kind="stable")[:MOST_COMPARED]
        self._filter.begin(assignment.estimate, marginals, self._done - 1, near)

    def _assignment(self) -> Assignment:
        measured = self._problem.until(self._done)
        sigma = INFLATION * self._sighting_noise.of_detections(measured)
        measured = replace(measured, sigma_given=sigma)
        estimate = Estimate(self._pose[: self._done].copy(), self._filter.position.copy(), self._filter.states.copy())
        return Assignment(measured, self._row[: len(measured.pose_row)].copy(), estimate)

    def _without_chance(self, assignment: Assignment) -> Assignment:
        """Landmarks that were seen once or twice, long ago, were none."""
        age = assignment.measured.stamp_s[-1] - assignment.last_seen_s
        few = assignment.sightings < MIN_SIGHTINGS
        return assignment.without(few & (age > FORGET_S))

    def _settled(self, assignment: Assignment) -> tuple[Assignment, Marginals]:
        """The batch solution, merged as long as there is something to merge."""
        assignment, marginals = self._solved(assignment)
        refused: set[tuple[int, int]] = set()
        for _ in range(MERGE_ROUNDS):
            honest = assignment.with_shared_errors(marginals.shared)
            pairs = propose_merges(assignment, honest, density=self._density, probability=P_MERGE)
            pairs = [pair for pair in pairs if pair not in refused]
            if not pairs:
                pairs = propose_constellation(
                    assignment, honest, density=self._density, probability=P_MERGE, refused=refused
                )
            if not pairs:
                break
            limit = self._cost(assignment)[0] + RISE_NATS
            merged = self._merged(assignment, pairs, limit + RISE_NATS * (len(pairs) - 1))
            if merged is None:  # not all of them; perhaps some
                singles = (self._merged(assignment, [pair], limit) for pair in pairs if len(pairs) > 1)
                merged = next((single for single in singles if single is not None), None)
            if merged is None:
                refused.update(pairs)
            else:
                refused.clear()
                assignment, marginals = self._solved(merged)
        return assignment, marginals

    def _merged(self, assignment: Assignment, pairs: list[tuple[int, int]], limit: float) -> Assignment | None:
        """At its optimum with pairs merged; None where a cost above `limit` says that they are two."""
        trial = assignment.merged(pairs)
        cost, estimate = self._cost(trial)
        if cost > limit:
            return None
        return Assignment(trial.measured, trial.landmark_row, estimate)

    def _solved(self, assignment: Assignment) -> tuple[Assignment, Marginals]:
        """Optimum and covariances; learns the noise on the way."""
        problem = assignment.problem()
        smoother = Smoother(problem, self.noise, heavy=True)
        estimate = smoother.optimum(assignment.estimate, iterations=10, tolerance=1e-4)
        marginals = smoother.marginals(estimate)
        measured = assignment.measured
        given = self._problem.sigma_given[: len(measured.pose_row)]
        unknown = replace(problem, sigma_given=given[assignment.landmark_row >= 0])
        self._sighting_noise = fit_sighting_noise(unknown, estimate, NOISE_FLOOR * self._start_noise.detection)
        return Assignment(assignment.measured, assignment.landmark_row, estimate), marginals

    def _cost(self, assignment: Assignment) -> tuple[float, Estimate]:
        """Cost at the optimum, outliers decided."""
        problem = assignment.problem()
        near = Smoother(problem, self.noise, heavy=True)
        estimate = near.optimum(assignment.estimate, iterations=10, tolerance=1e-3)
        smoother = near.under(self.noise, heavy=False)
        estimate = smoother.optimum(estimate, iterations=10, tolerance=1e-3)
        return smoother.cost(estimate), estimate

    def _reconsidered(self, assignment: Assignment, marginals: Marginals) -> Assignment:
        """Every detection compared with the whole map once more, and given to whom it most probably belongs."""
        problem = assignment.measured
        sigma = problem.sigma_given
        row, everything = np.full_like(assignment.landmark_row, NOBODY), np.arange(assignment.n_landmarks)
        smoothed, local = assignment.estimate, LocalFilter(problem.mount, problem.prior)
        n = 2 * len(everything)
        order = np.append(n + np.arange(9), np.arange(n))
        covariance = np.zeros((3 + len(order), 3 + len(order)))
        covariance[3:, 3:] = marginals.shared[np.ix_(order, order)]
        for i in range(self._done):
            detections = np.arange(self._first[i], self._first[i + 1])
            covariance[:3, :3], covariance[:3, 3:] = marginals.pose[i], marginals.pose_shared[i][:, order]
            covariance[3:, :3] = covariance[:3, 3:].T
            local.hold(smoothed.pose[i], smoothed.states, covariance, everything, smoothed.landmark)
            pairings = pairings_of_frame(local, problem, sigma, detections, density=self._density)
            probability, _ = pairing_probability(pairings, confidence=GATE)
            taken = np.flatnonzero(probability > 0.5)
            row[detections[pairings.source[taken]]] = pairings.target[taken]
        again = Assignment(problem, row, assignment.estimate)
        return again.without(again.sightings == 0)


def pairings_of_frame(
    local: LocalFilter, problem: Problem, sigma: FloatArray, detections: IntArray, *, density: float
) -> Pairings:
    """Return detections of a frame with the landmarks whose gates they pass.

    Args:
        local: the pose that made the detections, with the landmarks that are compared.
        problem: the readings.
        sigma: (M, 2) standard deviations of all detections.
        detections: (n,) rows of those of the frame.
        density: landmarks a square metre that one expects where none was met before.
    """
    target = np.sort(local.active)
    source, target = np.repeat(np.arange(len(detections)), len(target)), np.tile(target, len(detections))
    seen = detections[source]
    nis, _, innovation, by = local.compare(target, problem.reading[seen], sigma[seen])
    inside = np.flatnonzero(nis <= gates(1, GATE)[1])
    source, target, seen, count = source[inside], target[inside], seen[inside], len(inside)
    rows = np.zeros((count, 2, len(local.covariance)))
    rows[:, :, :8] = by[inside, :, :8]
    at = columns(local.bring(target)).reshape(-1, 1, 2)
    np.put_along_axis(rows, np.repeat(at, 2, axis=1), by[inside, :, 8:], axis=2)
    h = rows.reshape(2 * count, rows.shape[2])
    joint = h @ local.covariance @ h.T + np.diag((sigma[seen] ** 2).ravel())
    # a square metre has r dr db
    new = np.log(density * np.maximum(problem.reading[seen, 0], 0.1))
    return Pairings(source, target, innovation[inside], joint, new, len(detections))


def density_of_unmet(place: FloatArray) -> float:
    """Return landmarks a square metre that one may still meet, by the area that those at `place` (L, 2) span."""
    area_m2 = float(np.prod(np.ptp(place, axis=0))) if len(place) else 0.0
    return UNMET / max(area_m2, SMALLEST_M2)


PSEUDO_SIGHTINGS = 100.0
"""Imaginary sightings with the start's noise: what was associated first is little, and only what agreed."""
CLIPPED_AT = 9.0
"""Squared normalised residual beyond which a sighting tells nothing more about the noise."""
ROUNDS = 10


@dataclass(frozen=True, slots=True)
class SightingNoise:
    """Variances: of range at no distance [m^2], its growth with r^4 [1/m^2], of bearing [rad^2]."""

    range_variance: float
    range_growth: float
    bearing_variance: float

    @classmethod
    def constant(cls, sigma: FloatArray) -> SightingNoise:
        """Return noise that is the same at all ranges: sigma (2,) of range [m] and bearing [rad]."""
        return cls(float(sigma[0] ** 2), 0.0, float(sigma[1] ** 2))

    def of_detections(self, problem: Problem) -> FloatArray:
        """Return (M, 2) standard deviation of every detection: its own where it came with one."""
        fourth = problem.reading[:, 0] ** 4
        modelled = np.column_stack(
            [self.range_variance + self.range_growth * fourth, np.full(len(fourth), self.bearing_variance)]
        )
        return np.where(np.isfinite(problem.sigma_given), problem.sigma_given, np.sqrt(modelled))


def fit_sighting_noise(problem: Problem, estimate: Estimate, start: FloatArray) -> SightingNoise:
    """Estimate noise from the residuals of associated detections, which came without their own.

    Args:
        problem: detections with their landmarks.
        estimate: the optimum.
        start: (2,) standard deviations that `PSEUDO_SIGHTINGS` imaginary sightings vouch for.
    """
    free = ~np.isfinite(problem.sigma_given)
    squared = detection_residuals(problem, estimate) ** 2
    fourth = problem.reading[free[:, 0], 0] ** 4
    middle = float(np.median(fourth)) if len(fourth) else 1.0
    in_range, in_bearing = squared[free[:, 0], 0], squared[free[:, 1], 1]
    variance, growth, bearing = start[0] ** 2, 0.0, start[1] ** 2
    for _ in range(ROUNDS):
        expected = variance + growth * fourth
        clipped = np.minimum(in_range, CLIPPED_AT * expected)
        # Fisher scoring of a Gaussian whose variance is linear in two numbers, neither negative
        weight = np.append(1.0 / expected**2, PSEUDO_SIGHTINGS / (variance + growth * middle) ** 2)
        column = np.append(fourth, middle)
        value = np.append(clipped, start[0] ** 2)
        variance, growth = _line_not_negative(column, value, weight)
        total = np.minimum(in_bearing, CLIPPED_AT * bearing).sum() + PSEUDO_SIGHTINGS * start[1] ** 2
        bearing = total / (len(in_bearing) + PSEUDO_SIGHTINGS)
    return SightingNoise(variance, growth, float(bearing))


def _line_not_negative(x: FloatArray, y: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Weighted least squares of `y = a + b x` with `a` at least a thousandth of the mean, `b` not negative."""
    total = weight.sum()
    mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
    spread = (weight * (x - mean_x) ** 2).sum()
    slope = (weight * (x - mean_x) * (y - mean_y)).sum() / spread if spread > 0.0 else 0.0
    slope = float(np.clip(slope, 0.0, 0.999 * mean_y / mean_x))
    return float(mean_y - slope * mean_x), slope
