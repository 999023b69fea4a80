"""Association in the plane: readings of range and bearing, a filter that leads, and a batch solution at intervals.

What is decided by which rule is in `associator`; here is how landmarks are predicted and solved, and what only the
plane has: names that close loops, contradictory visits, displaced stretches, and loose parts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincc

from evermap.config import AssociationConfig, SlamConfig
from evermap.estimate.sparse.system import exhaust
from evermap.geometry import se2
from evermap.slam.association.assignment import (
    NOBODY,
    Assignment,
    alike,
    count_together,
    density_of_unmet,
    landmark_density,
    same_name,
)
from evermap.slam.association.associator import Associator
from evermap.slam.association.constellation import LoosePart, list_agreed_pairs, overlays
from evermap.slam.association.features import Traits
from evermap.slam.association.jcbb import Pairings, gates
from evermap.slam.association.merging import (
    Differences,
    Solution,
    try_by_halves,
)
from evermap.slam.association.revise import likely_real, reassign, unseen_nats, with_overlooked
from evermap.slam.association.wrong_associations import find_displaced, laid, weigh_visits
from evermap.slam.batch import USUAL, sight_at
from evermap.slam.bridge import dead_reckoned
from evermap.slam.filter_kernels import spread_of_frame
from evermap.slam.linearise import detection_residuals
from evermap.slam.local_filter import GATED
from evermap.slam.nearby_places import NO_PLACES
from evermap.slam.noise import Extrapolation, refine_noise
from evermap.slam.planar_filter import FrameReadings, PlanarFilter, PlanarMotion
from evermap.slam.problem import Estimate, Marginals, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray

FIRST_BATCH, BATCH_SHARE = 40, 0.05
"""Poses before the first batch solution; then as many, or this share of all, before the next: bounds the work."""
RECENT = 48
"""Number of landmarks, those seen last, whose duplicates are searched at a batch solution: bounds the work."""
MOST_COMPARED = 96
"""Number of nearest landmarks that a frame is compared with: bounds the work."""
REALIGNED, STRETCHES = 8, 2
"""Maximum number of realigned stretches, also of ways to align a loose part, and of those that are tried each time, the
longest first: bound the work."""
BEFORE = (8.0, 2.0, 0.0)
"""Grid of the time before a stretch in which revisits may be wrong, relative to its length; tried in this order."""
SPLIT_ROUNDS = 5
"""Maximum number of rounds of splitting."""
NOISE_ROUNDS = 6
"""Rounds of learning the odometry noise; extrapolated, they converge within these."""
ALONE_ROUNDS = 2
"""Times that detections are compared with the landmarks by odometry alone: the second finds next to nothing more."""
SAME_NATS = 0.5
"""Least fall of the cost for as many landmarks: the tolerance of the optimum."""


@dataclass(frozen=True, slots=True)
class PlanarSolution:
    """An assignment at its optimum, with covariances, cost and smoother: a trial, until something goes on from it.

    Attributes:
        sigma: (M, 2) standard deviations of all detections of the recording, learned from its residuals: those of the
            solution that follows, if this one is accepted.
    """

    assignment: Assignment
    marginals: Marginals
    cost: float
    smoother: Smoother
    sigma: FloatArray

    @property
    def landmark_row(self) -> IntArray:
        """(M,) landmark of every detection, `NOBODY` for none."""
        return self.assignment.landmark_row

    @property
    def traits(self) -> Traits:
        """Readings of the landmarks themselves."""
        return self.assignment.traits

    @property
    def n_landmarks(self) -> int:
        """Number of landmarks."""
        return self.assignment.n_landmarks

    @property
    def sightings(self) -> IntArray:
        """(L,) number of detections of each landmark."""
        return self.assignment.sightings

    @property
    def numbers(self) -> IntArray:
        """(L,) numbers of each landmark: two."""
        return np.full(self.n_landmarks, 2)

    @property
    def density_m2(self) -> float:
        """Density of the landmarks [1/m^2]."""
        now = self.assignment
        return landmark_density(now.estimate.landmark, now.sightings, now.settings)


class Closures(NamedTuple):
    """What it costs that landmarks which were seen again, after `slam.association.forget_s`, are the same.

    Attributes:
        visits: visits of landmarks that had been visited before.
        nats: rise of the cost of the optimum by them; of each one on average, if all are right.
    """

    visits: int
    nats: float

    @property
    def p_by_chance(self) -> float:
        """Probability of such a rise if all are right: each is half the square of two standard normal numbers."""
        return float(gammaincc(self.visits, max(self.nats, 0.0))) if self.visits else 1.0


class PlanarAssociator(Associator[Assignment, Assignment, PlanarSolution, PlanarFilter]):
    """The associator in the plane.

    Args:
        problem: the measurements; its `landmark_row` is ignored.
        noise: initial noise levels.
        kind: (M, 2) class and name of every detection, `UNKNOWN` for none; None if there are none.
        odometry: (5,) noise levels of the odometry, if known; None for a multiple of those of `noise`
            (`slam.association.odometry_caution`).
        traits: readings of the landmarks themselves; None if they give no evidence.
        settings: of the estimator.
    """

    has_own_noise = False

    def __init__(
        self,
        problem: Problem,
        noise: Noise,
        kind: IntArray | None = None,
        odometry: FloatArray | None = None,
        traits: Traits | None = None,
        settings: SlamConfig = USUAL,
    ) -> None:
        local = PlanarFilter(problem.mount, problem.prior, most=MOST_COMPARED)
        covariance = local.covariance.copy()
        covariance[:3, :3] = np.eye(3) / problem.start_information
        local.hold(problem.start_pose, local.states, covariance, NO_PLACES, local.position)
        labels = np.full((len(problem.pose_row), 2), UNKNOWN) if kind is None else kind
        density = density_of_unmet(np.zeros((0, 2)), settings)
        super().__init__(problem.stamp_s, problem.pose_row, labels, local, density, traits, settings)
        self._problem, self._start_noise = problem, noise
        if odometry is None:
            odometry = self._rules.odometry_caution * noise.odometry
        self.noise = replace(noise, odometry=odometry)
        """Noise levels of all solutions; detections have their own."""
        self._pose = np.zeros((len(problem.stamp_s), 3))
        self._sigma = self._rules.noise_caution * noise.of_detections(problem.sigma_given)
        self.worth = 1.0
        """Detections whose residuals count as one; learned by the first `finish`."""
        self._next_batch, self._is_finished = FIRST_BATCH, False

    def step(self) -> None:
        """Associate the next frame; at intervals solve everything so far, merge duplicates, and continue from there."""
        super().step()
        self._pose[self._done - 1] = self._near.pose
        if self._done == self._next_batch:
            self._go_on_from(self._settle(self._without_chance(self._assignment()), self._sigma, RECENT))
            self._next_batch = self._done + max(FIRST_BATCH, int(BATCH_SHARE * self._done))

    def _drive(self, near: PlanarFilter, times: float) -> PlanarFilter:
        local, noise = near.copied(), replace(self.noise, odometry=times * self.noise.odometry)
        motion = PlanarMotion.between(self._problem, noise, self._done, local.states)
        away = np.hypot(*(local.position - se2.compose(local.pose, motion.increment)[:2]).T)
        local.bring(np.argsort(away, kind="stable")[:MOST_COMPARED])
        local.drive(motion)
        return local

    def heed_names(self, pose: Callable[[], FloatArray]) -> None:
        """Restart from poses estimated from names alone, if several landmarks have one name and the result is better.

        Wrong matches between two named detections distort the map until the loop between these stays open.

        Args:
            pose: returns these poses (N, 3); called only if needed.
        """
        solved = self._settle(self._assignment(), self._sigma)
        self._go_on_from(solved)
        now = solved.assignment
        if not len(_twice(now)):
            return
        begun = replace(now, estimate=replace(now.estimate, pose=pose()))
        again, first = self._solve_assignment(begun.split_visits()), 0
        while (later := again.assignment.n_landmarks - first) > 0:
            again = self._merge_duplicates(again, within=(first, later - RECENT))
            first = again.assignment.n_landmarks - (later - RECENT)
        # each landmark not yet merged has two more parameters, a nat on average
        gained = solved.cost - again.cost - (again.assignment.n_landmarks - now.n_landmarks)
        if gained + _twice(now).sum() > _twice(again.assignment).sum():
            self._go_on_from(again)

    def _begun(self, begun: Assignment | None) -> PlanarSolution:
        if begun is None:
            return self._solve_assignment(_with_sigma(self._assignment(), self._sigma))
        return self._solve_assignment(begun)

    def _reassign(self, solved: PlanarSolution) -> Assignment:
        now, explained = solved.assignment, solved.marginals.explained_detections
        again = with_overlooked(reassign(now, explained, density=solved.density_m2))
        return _with_sigma(again.without(_seldom(again)), solved.sigma)

    def _learned(self, assignment: Assignment) -> PlanarSolution:
        return self._solve_assignment(assignment)

    def _result(self, solved: PlanarSolution) -> Assignment:
        if not self._is_finished:
            self._is_finished, self.worth = True, correlated(solved.assignment)
        return without_ghosts(self._attach_part(solved).assignment)

    def closures(self, found: Assignment) -> Closures:
        """Return what the loops cost that an association closes; `found` as `finish` returns it."""
        if not found.n_landmarks:
            return Closures(0, 0.0)
        solved = self._judge(found)
        apart = self._solve_assignment(solved.assignment.split_visits())
        return Closures(apart.n_landmarks - solved.n_landmarks, solved.cost - apart.cost)

    def lead_by_odometry(self) -> Assignment:
        """Return landmarks where detections lie together by odometry alone, each visit by itself, near their optimum.

        It depends on no association so far.
        """
        problem, count = self._problem, len(self._kind)
        sigma = self._rules.noise_caution * self._start_noise.of_detections(problem.sigma_given)
        pose = dead_reckoned(problem.stamp_s, problem.drive, problem.prior.mean, self._start_noise)[0]
        estimate = Estimate(pose, np.zeros((0, 2)), problem.prior.mean.copy())
        nobody = np.full(count, NOBODY)
        found = Assignment(problem, nobody, estimate, self._kind, self._traits, self._settings)
        found = with_overlooked(_with_sigma(found, sigma))
        for _ in range(ALONE_ROUNDS):
            if not found.n_landmarks:
                break
            solved = self._solve_assignment(found.split_visits())
            again = reassign(solved.assignment, solved.marginals.explained_detections, density=solved.density_m2)
            found = _with_sigma(with_overlooked(again).split_visits(), solved.sigma)
            found = found.without(_seldom(found))
        return found

    def learn_odometry(self, assignment: Assignment) -> FloatArray:
        """Return (5,) noise levels of the odometry by restricted likelihood, given all associations.

        Args:
            assignment: as `finish` returns it.
        """
        noise, ahead = self.noise, Extrapolation()
        for _ in range(NOISE_ROUNDS):
            solved = self._solve_assignment(assignment, noise)
            assignment, smoother = solved.assignment, solved.smoother
            inlier = smoother.inlier_probability(assignment.estimate)
            fit = refine_noise(
                assignment.problem(), assignment.estimate, solved.marginals, inlier, noise, self._start_noise
            )
            noise = replace(noise, odometry=ahead.ahead(noise, fit.noise).odometry)
        return noise.odometry

    def _judge(self, found: Assignment) -> PlanarSolution:
        solved = self._solve_assignment(found)
        return self._solve_assignment(_with_sigma(solved.assignment, solved.sigma))  # its own noise

    def _total(self, solved: PlanarSolution) -> float:
        """Of an unassigned detection as of an outlier; residuals are correlated: `worth` of them count as one."""
        assignment = solved.assignment
        nobody = np.count_nonzero(assignment.landmark_row == NOBODY)
        fit = solved.cost + float(np.log(assignment.measured.sigma_given).sum())
        landmarks = float(_twice(assignment).sum()) + self._rules.landmark_nats * assignment.n_landmarks
        explained = fit + self.noise.outlier_log_odds * nobody
        return explained / self.worth + landmarks + unseen_nats(assignment)

    def _gate(self, near: PlanarFilter, view: IntArray) -> tuple[Pairings, BoolArray]:
        labels = self._kind[view], self._of_kind
        return pairings_of_frame(
            near, self._problem, self._sigma, view, density=self._density, kind=labels, settings=self._rules
        )

    def _certain(
        self, near: PlanarFilter, pairings: Pairings, followed: BoolArray, probability: FloatArray, known: FloatArray
    ) -> BoolArray:
        away = self._problem.stamp_s[self._done] - self._seen_s[pairings.target] > self._rules.forget_s
        least = np.where(away & ~followed, self._rules.p_return, self._rules.p_match)
        return np.asarray((probability >= least) | self._harmless(near, pairings, probability, known, least))

    def _harmless(
        self, local: PlanarFilter, pairings: Pairings, probability: FloatArray, known: FloatArray, least: FloatArray
    ) -> BoolArray:
        """(K,) the best pairing of a detection if a wrong choice does no harm, and is corrected later.

        That is so if the gate is small, or if the rivals are probably the same landmark.
        """
        p_match = self._rules.p_match
        best = np.zeros(len(probability), dtype=bool)
        for s in np.flatnonzero(known >= p_match):
            rows = np.flatnonzero(pairings.source == s)
            first = rows[probability[rows].argmax()]
            if probability[first] >= least[first]:
                continue  # taken anyway
            rivals = rows[(probability[rows] > 1.0 - p_match) & (rows != first)]
            own = pairings.covariance[2 * first : 2 * first + 2, 2 * first : 2 * first + 2]
            area_m2 = math.sqrt(np.linalg.det(own)) * math.exp(pairings.log_density_new[first]) / self._density
            if area_m2 < self._rules.tight_m2:
                best[first] = True
            elif known[s] >= least[first]:
                best[first] = all(self._may_be_one(local, pairings.target[first], pairings.target[k]) for k in rivals)
        return best

    def _may_be_one(self, local: PlanarFilter, a: int, b: int) -> bool:
        """True if the difference of two landmarks is insignificant."""
        at = local.columns(local.bring(np.array([a, b])))
        by = np.hstack([np.eye(2), -np.eye(2)])
        spread = by @ local.covariance[np.ix_(at, at)] @ by.T + 1e-12 * np.eye(2)
        gap = local.position[a] - local.position[b]
        return bool(gap @ np.linalg.solve(spread, gap) < gates(1, self._rules.gate_confidence)[1])

    def _update(self, known: IntArray, new: IntArray) -> None:
        problem, local = self._problem, self._near
        local.update(self._row[known], FrameReadings(problem.reading[known], self._sigma[known]), weighing=GATED)
        if not len(new):
            return
        at = sight_at(local.pose, problem.reading[new], local.states, problem.mount)
        for row, place in zip(self._row[new].tolist(), at, strict=True):
            local.meet(row, place)
        local.update(self._row[new], FrameReadings(problem.reading[new], self._sigma[new]), weighing=GATED)

    def _go_on_from(self, solved: PlanarSolution) -> None:
        """Accept a solution: all that was learned with it is that of the frames to come."""
        assignment = solved.assignment
        self._sigma, self._density = solved.sigma, solved.density_m2
        self._row[: len(assignment.landmark_row)] = assignment.landmark_row
        self._pose[: self._done] = assignment.estimate.pose
        self._of_kind, self._seen_s, self._like = assignment.of_kind, assignment.last_seen_s, assignment.like()
        place = assignment.estimate.landmark
        near = np.argsort(np.hypot(*(place - assignment.estimate.pose[-1, :2]).T), kind="stable")[:MOST_COMPARED]
        self._near.begin(assignment.estimate, solved.marginals, self._done - 1, near)

    def _assignment(self) -> Assignment:
        measured = self._problem.until(self._done)
        estimate = Estimate(self._pose[: self._done].copy(), self._near.position.copy(), self._near.states.copy())
        count = len(measured.pose_row)
        row, kind = self._row[:count].copy(), self._kind[:count]
        return Assignment(measured, row, estimate, kind, self._traits.until(count), self._settings)

    def _without_chance(self, assignment: Assignment) -> Assignment:
        """The assignment without landmarks with too few sightings, long ago."""
        age = assignment.measured.stamp_s[-1] - assignment.last_seen_s
        return assignment.without(_seldom(assignment) & (age > self._rules.forget_s))

    def _settle(self, assignment: Assignment, sigma: FloatArray, recent: int | None = None) -> PlanarSolution:
        """Solve the batch with the noise (M, 2) of detections, and merge duplicates of all landmarks or of those seen
        last.
        """
        return self._merge_duplicates(self._solve_assignment(_with_sigma(assignment, sigma)), recent)

    def _solve_merged(self, solved: PlanarSolution, pairs: list[tuple[int, int]]) -> PlanarSolution:
        return self._solve_assignment(solved.assignment.merged(pairs))

    def _compared(self, solved: PlanarSolution) -> Solution:
        return compared(solved.assignment, solved.marginals, solved.density_m2)

    def _loose(self, solved: PlanarSolution, refused: set[tuple[int, int]]) -> list[tuple[int, int]]:
        part = LoosePart.of(solved.assignment, solved.marginals, refused)
        if part is None:
            return []
        sure = list_agreed_pairs(
            part.source, part.target, part.allowed,
            density=solved.density_m2, probability=self._rules.p_merge, settings=self._settings,
        )  # fmt: skip
        return part.rows(sure)

    def _attach_part(self, solved: PlanarSolution) -> PlanarSolution:
        """Align a loose part with the rest in the best of its ways, if that explains detections of removed ghosts.

        No way is certain. But copies of landmarks, removed as ghosts, leave detections that this alignment explains;
        fewer landmarks alone are no reason.
        """
        part = LoosePart.of(solved.assignment, solved.marginals)
        if part is None or not len(part.root):
            return solved
        rules, best = self._rules, solved
        every = overlays(part.source, part.target, part.allowed, density=solved.density_m2, settings=self._settings)
        least = self._total(self._real(solved)) - rules.constellation.certain_nats
        for overlay in every[:REALIGNED]:
            trial = self._merge_duplicates(self._solve_assignment(solved.assignment.merged(part.rows(overlay.pairs))))
            fewer = max(0, solved.assignment.n_landmarks - trial.assignment.n_landmarks)
            against = self._total(self._real(trial)) + rules.landmark_nats * fewer
            if against < least:
                best, least = trial, against
        return best

    def _real(self, solved: PlanarSolution) -> PlanarSolution:
        """The same without ghosts, at its optimum."""
        real = without_ghosts(solved.assignment)
        return solved if real.n_landmarks == solved.assignment.n_landmarks else self._solve_assignment(real)

    def _correct_visits(self, solved: PlanarSolution, refused: set[tuple[int, int]]) -> PlanarSolution:
        """Split contradictory visits from their landmarks, and merge again, if the result is better.

        Visits that were tried without gain are in `refused`, by first detection and number.
        """
        rules = self._rules

        def split(parts: list[IntArray]) -> PlanarSolution | None:
            trial = self._merge_duplicates(self._solve_assignment(now.split(parts)))
            return trial if _is_better(trial, solved) else None

        for _ in range(SPLIT_ROUNDS):
            now = solved.assignment
            linear = solved.smoother.detections(now.estimate)
            visits = weigh_visits(now, solved.marginals, linear, density=solved.density_m2)
            doubtful = visits.evidence < math.log(rules.p_merge / (1.0 - rules.p_merge))
            by_traits = visits.by_traits < -rules.readings.misread_nats
            doubtful &= (visits.squared > gates(1, rules.contradiction)[1]) | by_traits
            order = np.flatnonzero(doubtful)[np.argsort(visits.evidence[doubtful], kind="stable")]
            _, first = np.unique(visits.landmark[order], return_index=True)  # one of each landmark
            parts = [visits.rows[k] for k in order[np.sort(first)] if _key(visits.rows[k]) not in refused]
            better = try_by_halves(parts, split, lambda part: refused.add(_key(part)))
            if better is None:
                break
            solved = better
        return solved

    def _realign(self, solved: PlanarSolution) -> PlanarSolution:
        """Realign displaced stretches, if the result is better."""
        for _ in range(REALIGNED):
            now = solved.assignment
            trusted = now.sightings >= self._settings.fewest_sightings
            stretches = find_displaced(
                now, solved.marginals, trusted, density=solved.density_m2, probability=self._rules.p_merge
            )
            starts = (laid(now, stretch, before) for stretch in stretches[:STRETCHES] for before in BEFORE)
            trials = (self._merge_duplicates(self._solve_assignment(start)) for start in starts)
            better = next((trial for trial in trials if _is_better(trial, solved)), None)
            if better is None:
                break
            solved = self._correct_visits(better, set())
        return solved

    def _solve_assignment(self, assignment: Assignment, noise: Noise | None = None) -> PlanarSolution:
        """Optimum, covariances and cost, and the noise of sightings that its residuals show."""
        problem = assignment.problem()
        noise = self.noise if noise is None else noise
        smoother = Smoother(problem, noise, heavy=True)
        slices = smoother.solve_in_slices(assignment.estimate, iterations=8, tolerance=1e-3, settled=0.1)
        estimate, marginals = exhaust(slices)
        measured = assignment.measured
        given = self._problem.sigma_given[: len(measured.pose_row)]
        unknown = replace(problem, sigma_given=given[assignment.landmark_row >= 0])
        left = 1.0 - np.diagonal(marginals.explained_detections, axis1=1, axis2=2)
        start = self._rules.noise_floor * self._start_noise.detection
        noise_of = fit_sighting_noise(unknown, estimate, start, left, self._rules)
        sigma = self._rules.noise_caution * noise_of.of_detections(self._problem)
        cost = smoother.under(noise, heavy=False).cost(estimate) - assignment.traits.evidence(*assignment.of_visits())
        return PlanarSolution(replace(assignment, estimate=estimate), marginals, cost, smoother, sigma)


def compared(assignment: Assignment, marginals: Marginals, density: float) -> Solution:
    """Return the landmarks of an assignment at its optimum, for `propose_merges`."""
    place, kind, named = assignment.estimate.landmark, assignment.of_kind, assignment.n_named
    like, settings = assignment.like(), assignment.settings.association

    def differences(younger: IntArray, older: IntArray) -> Differences:
        rows, both = np.unique(np.concatenate([younger, older]), return_inverse=True)
        u, o = both[: len(younger)], both[len(younger) :]
        joint = marginals.joint(rows)
        at = np.arange(len(joint))
        joint[at, at] += np.repeat(assignment.shared_variance[rows], 2)
        blocks = joint.reshape(len(rows), 2, len(rows), 2)
        cross = blocks[u, :, o, :]
        own = blocks[u, :, u, :] + blocks[o, :, o, :] - cross - cross.transpose(0, 2, 1)

        def together(some: IntArray) -> FloatArray:
            difference = joint[:, se2.xy_rows(u[some])] - joint[:, se2.xy_rows(o[some])]
            return difference[se2.xy_rows(u[some])] - difference[se2.xy_rows(o[some])]

        readings = np.minimum(named[younger], named[older])
        new = math.log(density) - by_name(kind[younger], kind[older], readings, settings)
        new -= assignment.traits.same(like.part(younger), like.part(older))
        return Differences(place[younger] - place[older], own, new, together)

    frame, row = assignment.measured.pose_row, assignment.landmark_row
    n_frames, around = len(assignment.measured.stamp_s), settings.around_frames
    return Solution(
        place, marginals.landmark, differences, assignment.sightings, assignment.last_seen_s,
        *count_together(frame, row, n_frames, len(place), around), kind, settings,
    )  # fmt: skip


def _with_sigma(assignment: Assignment, sigma: FloatArray) -> Assignment:
    """The assignment with other standard deviations of detections, the first of (M, 2)."""
    measured = replace(assignment.measured, sigma_given=sigma[: len(assignment.measured.pose_row)])
    return replace(assignment, measured=measured)


def _twice(assignment: Assignment) -> FloatArray:
    """(K,) evidence against several landmarks with one name [nats]."""
    kind, named = assignment.of_kind, assignment.n_named
    one, other = np.nonzero(np.triu(same_name(kind[:, None], kind[None]), 1))
    return by_name(kind[one], kind[other], np.minimum(named[one], named[other]), assignment.settings.association)


def by_name(one: IntArray, other: IntArray, readings: IntArray, settings: AssociationConfig) -> FloatArray:
    """Return the evidence of names that pairs are the same [nats], by labels (K, P) of both.

    Args:
        one: labels of the first of each pair.
        other: labels of the second.
        readings: (K,) number of times that the name was read, of the lesser one.
        settings: of the association.
    """
    return np.asarray(settings.name_nats * np.minimum(readings, settings.most_names) * same_name(one, other))


def correlated(assignment: Assignment) -> float:
    """Return the variance of sums of residuals over visits, relative to that of independent ones; at least 1."""
    seen = assignment.landmark_row >= 0
    sigma = assignment.measured.sigma_given[seen]
    residual = np.clip(detection_residuals(assignment.problem(), assignment.estimate) / sigma, -3.0, 3.0)
    visit = assignment.of_visits()[0][seen]
    if not len(visit):
        return 1.0
    together = np.column_stack([np.bincount(visit, of) for of in residual.T])
    return max(1.0, float((together**2).sum() / max((residual**2).sum(), 1e-300)))


def without_ghosts(assignment: Assignment) -> Assignment:
    """Return the assignment without landmarks that have too few sightings, or fewer than a real one would have."""
    assignment = assignment.without(_seldom(assignment))
    return assignment.without(~likely_real(assignment) & (assignment.n_named == 0))


def _seldom(assignment: Assignment) -> BoolArray:
    """(L,) landmarks without a name and with too few sightings."""
    return np.asarray((assignment.sightings < assignment.settings.fewest_sightings) & (assignment.n_named == 0))


def _is_better(trial: PlanarSolution, solved: PlanarSolution) -> bool:
    """Whether the gain of a trial exceeds the cost of its additional landmarks."""
    more = trial.assignment.n_landmarks - solved.assignment.n_landmarks
    gained = solved.cost - trial.cost + _twice(solved.assignment).sum() - _twice(trial.assignment).sum()
    return bool(gained - solved.assignment.settings.association.landmark_nats * more > (0.0 if more else SAME_NATS))


def _key(rows: IntArray) -> tuple[int, int]:
    return int(rows[0]), len(rows)


def pairings_of_frame(
    local: PlanarFilter,
    problem: Problem,
    sigma: FloatArray,
    detections: IntArray,
    *,
    density: float,
    kind: tuple[IntArray, IntArray],
    settings: AssociationConfig,
) -> tuple[Pairings, BoolArray]:
    """Return detections of a frame paired with the landmarks whose gates they pass, K of them; and (K,) whether these
    are tracked: known relative to the robot as well as they are measured.

    Args:
        local: the pose of the frame, with the landmarks that are compared.
        problem: the readings.
        sigma: (M, 2) standard deviations of all detections.
        detections: (n,) rows of those of the frame.
        density: expected landmarks per square metre in an unmapped area.
        kind: (n, 2) classes and names of the detections and (L, 2) of the landmarks.
        settings: of the association.
    """
    target = np.sort(local.active)
    source, target = np.repeat(np.arange(len(detections)), len(target)), np.tile(target, len(detections))
    same = alike(kind[0][source], kind[1][target])
    source, target = source[same], target[same]
    seen = detections[source]
    nis, log_det, frame = local.compare(target, FrameReadings(problem.reading[seen], sigma[seen]))
    inside = np.flatnonzero(nis <= gates(1, settings.gate_confidence)[1])
    # the neighbourhood of a tracked landmark is mapped; other gates may contain an unmapped landmark by chance
    wider = 2.0 * math.log(settings.followed**2)
    followed = log_det[inside] <= wider
    source, target, seen, count = source[inside], target[inside], seen[inside], len(inside)
    at, joint = frame.column[inside], np.empty((2 * count, 2 * count))
    at[:, -2:] = local.columns(local.bring(target)).reshape(-1, 2)
    if count:
        scratch = np.empty((2 * count, len(local.covariance)))
        spread_of_frame(local.covariance, frame.jacobian[inside], at, scratch, joint)
    joint[np.diag_indices(2 * count)] += 1.0
    unit = sigma[seen].ravel()
    joint *= unit[:, None] * unit
    # area element r dr db
    new = np.log(np.where(followed, settings.unmet_share, 1.0) * density * np.maximum(problem.reading[seen, 0], 0.1))
    least = 2.0 * np.log(sigma[seen]).sum(axis=1)
    return Pairings(source, target, frame.residual[inside] * sigma[seen], joint, new, len(detections), least), followed


LEAST_LEFT = 0.1
"""Least share of the variance of a residual that the fit leaves: a bound against division by small numbers."""
ROUNDS = 10
"""Rounds of Fisher scoring; they converge within these."""


@dataclass(frozen=True, slots=True)
class SightingNoise:
    """Variances: of range at no distance [m^2], its growth with r^4 [1/m^2], of bearing [rad^2]."""

    range_variance: float
    range_growth: float
    bearing_variance: float

    def of_detections(self, problem: Problem) -> FloatArray:
        """Return (M, 2) standard deviation of every detection: its own if it states one."""
        fourth = problem.reading[:, 0] ** 4
        modelled = np.column_stack(
            [self.range_variance + self.range_growth * fourth, np.full(len(fourth), self.bearing_variance)]
        )
        return np.where(np.isfinite(problem.sigma_given), problem.sigma_given, np.sqrt(modelled))


def fit_sighting_noise(
    problem: Problem, estimate: Estimate, start: FloatArray, left: FloatArray, settings: AssociationConfig
) -> SightingNoise:
    """Estimate noise from the residuals of assigned detections that state none.

    Args:
        problem: detections with their landmarks.
        estimate: the optimum.
        start: (2,) standard deviations of the prior.
        left: (M, 2) share of the variance that the fit leaves in the residuals (restricted likelihood, see
            `slam.noise`).
        settings: of the association.
    """
    pseudo, clipped_at = settings.pseudo_sightings, settings.clipped_at
    free = ~np.isfinite(problem.sigma_given)
    left = np.maximum(left, LEAST_LEFT)
    squared = detection_residuals(problem, estimate) ** 2 / left
    fourth = problem.reading[free[:, 0], 0] ** 4
    middle = float(np.median(fourth)) if len(fourth) else 1.0
    in_range, in_bearing = squared[free[:, 0], 0], squared[free[:, 1], 1]
    own = left[free[:, 1], 1]
    variance, growth, bearing = start[0] ** 2, 0.0, start[1] ** 2
    for _ in range(ROUNDS):
        expected = variance + growth * fourth
        clipped = np.minimum(in_range, clipped_at * expected)
        # Fisher scoring of a Gaussian whose variance is linear in two non-negative numbers
        weight = np.append((left[free[:, 0], 0] / expected) ** 2, pseudo / (variance + growth * middle) ** 2)
        column = np.append(fourth, middle)
        value = np.append(clipped, start[0] ** 2)
        variance, growth = _line_not_negative(column, value, weight)
        total = own @ np.minimum(in_bearing, clipped_at * bearing) + pseudo * start[1] ** 2
        bearing = total / (own.sum() + pseudo)
    return SightingNoise(variance, growth, float(bearing))


def _line_not_negative(x: FloatArray, y: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Weighted least squares of `y = a + b x` with `a` at least a thousandth of the mean, `b` not negative."""
    total = weight.sum()
    mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
    spread = (weight * (x - mean_x) ** 2).sum()
    slope = (weight * (x - mean_x) * (y - mean_y)).sum() / spread if spread > 0.0 else 0.0
    slope = float(np.clip(slope, 0.0, 0.999 * mean_y / mean_x))
    return float(mean_y - slope * mean_x), slope
