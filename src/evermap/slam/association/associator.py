"""Frame after frame, which detection is which landmark, and from time to time which landmarks are one.

A detection is given to a landmark only if no other explanation is nearly as good; in doubt it starts a landmark of its
own, which can be merged later, when a batch solution knows more (`merging`). Nothing is decided that cannot be mended:
at the end every detection is compared once more with the whole map (`revise`).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from evermap.geometry import se2
from evermap.slam.association.assignment import (
    FEWEST_SIGHTINGS,
    FORGET_S,
    NAMED_NATS,
    NOBODY,
    Assignment,
    alike,
    same_name,
)
from evermap.slam.association.constellation import MOST_LAID, propose_constellation
from evermap.slam.association.features import MISREAD_NATS, Likeness, Traits
from evermap.slam.association.jcbb import CONFIDENCE, Pairings, gates, pairing_probability
from evermap.slam.association.merging import FEW_NATS, Differences, Solution, propose_merges
from evermap.slam.association.relaying import displaced_stretches, laid
from evermap.slam.association.revise import likely_real, reassigned, with_overlooked
from evermap.slam.association.splitting import weighed_visits
from evermap.slam.filter_kernels import GATED, spread_of_frame
from evermap.slam.linearise import detection_residuals
from evermap.slam.local_filter import NO_PLACES, LocalFilter, columns
from evermap.slam.motion import Motion
from evermap.slam.noise import Extrapolation, refine_noise
from evermap.slam.problem import Estimate, Marginals, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.slam.sparse.system import exhausted
from evermap.slam.streaming import sighted_at
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray

CAUTION = 2.0
"""Odometry is taken to be this much worse than where learning would start. It is not learned here: what was associated
is what agreed with it."""
SLIP, SLIP_NATS = 3.0, math.log(20.0)
"""And this much worse in a step after which no landmark is where it should be; a priori one step in twenty slips, so
that the wide gate alone does not make a landmark's detection of that of a ghost."""

P_MATCH, P_RETURN = 0.95, 0.99
"""Probability from which a detection is given to a landmark; and to one not seen for `FORGET_S`, which closes a
loop by itself: wrong, it bends the map for good; in doubt `merging` weighs several landmarks together later."""
TIGHT_M2 = 0.04
"""Product of a gate's standard deviations, (0.2 m)^2, within which a wrong choice is harmless for a while."""
FOLLOWED = math.log(16.0)
"""A landmark is followed as long as its place beside the robot at most doubles the standard deviations of readings."""
P_NEW = 0.1
"""Probability of being none of the known from which it starts a landmark."""
P_MERGE = 0.97
"""Probability from which two landmarks are one."""
MOST_TOLD = 10
"""at most so many times: what was read wrongly once is likely to be so again."""
UNMET = 0.1
"""Share of landmarks that one has not met yet around those that are followed."""
FEWEST, SMALLEST_M2 = 2.0, 20.0
"""Landmarks, and the area that they span, at least, where their density is measured."""
FIRST_STOCK = 40
"""Poses before the first batch solution; the next come after as many, or as their number grew by this share."""
STOCK_SHARE = 0.05
RECENT = 48
"""Landmarks, those seen last, that are looked up in the map then."""
NOISE_FLOOR = 0.5
"""Share of the start's noise of sightings that imaginary ones vouch for."""
INFLATION = 1.3
"""Of the noise of sightings: what was associated is what agreed."""
MOST_COMPARED = 96
"""Landmarks, the nearest, that a frame is compared with."""
MERGE_ROUNDS = 8
"""Merges that are tried whenever everything is relinearised, at most: each makes the map stiffer."""
RISE_NATS, RISE_SHARE, RISE_MOST = 7.0, 1.75, 100.0
"""By how much the cost may rise for a pair that is merged: for the difference of the two, and for the detections of the
lesser of them, of which a quarter may become outliers; at most. Errors of sightings from one place are alike, which the
cost does not know."""
RELAID, STRETCHES = 8, 2
"""Stretches that are laid where they belong, at most, and those that are tried each time, the longest first."""
BEFORE = (8.0, 2.0, 0.0)
"""How long before a stretch revisits may be wrong already, relative to its length; tried in this order."""
SPLIT_ROUNDS = 5
"""Times that contradictory visits are split off, at most."""
CONTRADICTS = gates(1, 0.95)[1]
"""Squared distance of a visit from what is known without it, from which it is tried by itself."""
NOISE_ROUNDS = 6
"""Steps towards the noise of the odometry that the associated detections tell."""
SAME_NATS = 0.5
"""By how much the cost must fall for as many landmarks: less is how far the optimum was iterated."""
LAST_ROUNDS = 5
"""Comparisons of every detection with the whole map at the end, at most."""
SAME_SHARE = 0.002
"""Share of detections that change their landmark in the last of these."""


@dataclass(frozen=True, slots=True)
class _Solved:
    """An assignment at its optimum: with covariances, its cost, outliers decided, and what solved it."""

    assignment: Assignment
    marginals: Marginals
    cost: float
    smoother: Smoother


@dataclass(frozen=True, slots=True)
class _Frame:
    """A frame compared with the map.

    Rows of `pairings` that are certain, p (n,) of each detection to be new, and evidence [nats] over all being new.
    """

    pairings: Pairings
    taken: IntArray
    p_new: FloatArray
    evidence: float


class Associator:
    """Feed frames in order with `step`, then `finish`.

    Args:
        problem: the measurements; its `landmark_row` is not looked at.
        noise: where the noise levels start.
        kind: (M, 2) class and name of every detection, `UNKNOWN` for none; None where there are none.
        odometry: (5,) noise levels of the odometry, where they are known; None for `CAUTION` times those of `noise`.
        traits: what was read of the landmarks themselves; None for nothing that tells.
    """

    def __init__(
        self,
        problem: Problem,
        noise: Noise,
        kind: IntArray | None = None,
        odometry: FloatArray | None = None,
        traits: Traits | None = None,
    ) -> None:
        self._problem = problem
        self._kind = np.full((len(problem.pose_row), 2), UNKNOWN) if kind is None else kind
        self._of_kind: IntArray = np.zeros((0, 2), dtype=np.int64)
        self._traits = traits
        self._like = None if traits is None else traits.nothing(0)
        self._seen_s = np.zeros(0)
        self._start_noise = noise
        self.noise = replace(noise, odometry=CAUTION * noise.odometry if odometry is None else odometry)
        """Noise levels that everything is solved with; detections carry their own."""
        self._slipping = replace(noise, odometry=SLIP * self.noise.odometry)
        self._first = np.searchsorted(problem.pose_row, np.arange(len(problem.stamp_s) + 1))
        self._pose = np.zeros((len(problem.stamp_s), 3))
        self._row: IntArray = np.full(len(problem.pose_row), NOBODY, dtype=np.int64)
        self._sigma = INFLATION * SightingNoise.constant(noise.detection).of_detections(problem)
        self._filter = LocalFilter(problem.mount, problem.prior, most=MOST_COMPARED)
        self._done, self._doubted = 0, 0
        self._next_stock = FIRST_STOCK
        self._density_m2 = landmark_density(np.zeros((0, 2)), np.zeros(0, dtype=np.int64))

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
            self._next_stock = self._done + max(FIRST_STOCK, int(STOCK_SHARE * self._done))

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
        if len(slipped.taken) and slipped.evidence >= frame.evidence + SLIP_NATS:
            return slipped
        local.pose, local.covariance = after
        return frame

    def _have_near(self, pose: FloatArray) -> None:
        """Have the landmarks around a pose in the filter: all, if they are few."""
        away = np.hypot(*(self._filter.position - pose[:2]).T)
        self._filter.bring(np.argsort(away, kind="stable")[:MOST_COMPARED])

    def having(self, traits: Traits) -> Associator:
        """Return one that has seen the same frames and knows what was read of the landmarks, too."""
        other = copy.copy(self)
        other._traits = traits
        return other

    def heed_names(self, pose: Callable[[], FloatArray]) -> None:
        """Begin again from poses that names alone lead to, if landmarks with one name lie apart and it is better so.

        Wrong matches between two that were seen by name bend the map, until those do not meet any more.

        Args:
            pose: returns (N, 3) those poses; called where they are asked for.
        """
        solved = self._settled(self._assignment())
        self._go_on_from(solved)
        now = solved.assignment
        if not len(_twice(now)):
            return
        begun = replace(now, estimate=replace(now.estimate, pose=pose()))
        row, points = begun.in_visits(FORGET_S), begun.points()
        seen = row >= 0
        each = np.bincount(row[seen])
        place: FloatArray = np.column_stack([np.bincount(row[seen], x) / each for x in points[seen].T])
        begun = replace(begun, landmark_row=row, estimate=replace(begun.estimate, landmark=place))
        again, first = self._solved(begun), 0
        while (later := again.assignment.n_landmarks - first) > 0:
            again = self._all_merged(again, within=(first, later - RECENT))
            first = again.assignment.n_landmarks - (later - RECENT)
        # what is not merged yet has two numbers more to fit, a nat on average
        gained = solved.cost - again.cost - (again.assignment.n_landmarks - now.n_landmarks)
        if gained + _twice(now).sum() > _twice(again.assignment).sum():
            self._go_on_from(again)

    def finish(self, begun: Assignment | None = None, *, goal: float = math.inf) -> Assignment:
        """Settle everything processed so far, and mend what was associated wrongly.

        Args:
            begun: who is who to begin with, of the same detections; None for what `step` found.
            goal: a cost, as of `against`; what will not reach it is given up.
        """
        refused: set[tuple[int, int]] = set()
        total = math.inf
        if begun is None:
            begun = self._assignment()
        else:
            self._sigma = begun.measured.sigma_given
        solved = self._relaid(self._contradictions_split(self._settled(begun), refused))
        for left in reversed(range(LAST_ROUNDS)):
            before = solved.assignment
            again = reassigned(before, solved.marginals.explained_detections, density=self._density_m2)
            again = with_overlooked(again)
            again = again.without(_seldom(again))
            count = min(before.n_landmarks, again.n_landmarks)
            changed = np.mean(_partners(before.landmark_row) != _partners(again.landmark_row))
            solved = self._contradictions_split(self._settled(again), refused)
            total, last = self._total(solved), total
            hopeless = total - left * (last - total) > goal
            same = changed <= SAME_SHARE and solved.assignment.n_landmarks == before.n_landmarks == count
            if hopeless or same:
                break
        assignment = solved.assignment
        assignment = assignment.without(_seldom(assignment))
        return assignment.without(~likely_real(assignment) & (assignment.told == 0))

    @property
    def doubtful(self) -> float:
        """Share of the detections so far that might have been of several landmarks when they were made."""
        return self._doubted / max(int(self._first[self._done]), 1)

    def learned_odometry(self, assignment: Assignment) -> FloatArray:
        """Return (5,) noise levels of the odometry by restricted likelihood, were all associations right.

        Args:
            assignment: what `finish` returned.
        """
        noise, ahead = self.noise, Extrapolation()
        for _ in range(NOISE_ROUNDS):
            solved = self._solved(assignment, noise)
            assignment, smoother = solved.assignment, solved.smoother
            inlier = smoother.inlier_probability(assignment.estimate)
            fit = refine_noise(
                assignment.problem(), assignment.estimate, solved.marginals, inlier, noise, self._start_noise
            )
            noise = replace(noise, odometry=ahead.ahead(noise, fit.noise).odometry)
        return noise.odometry

    def against(self, assignment: Assignment) -> float:
        """Return the negative log likelihood [nats] of all detections under an assignment, up to a constant.

        A detection of no landmark is as likely as an outlier of one. Comparable between assignments of one recording.

        Args:
            assignment: what `finish` returned, of this associator or another one of the same recording.
        """
        assignment = self._solved(assignment).assignment
        measured = self._with_sigma(assignment.measured)  # its own noise
        return self._total(self._solved(replace(assignment, measured=measured)))

    def _total(self, solved: _Solved) -> float:
        """`against` under the noise that it was solved with."""
        assignment = solved.assignment
        nobody = np.count_nonzero(assignment.landmark_row == NOBODY)
        fit = solved.cost + float(np.log(assignment.measured.sigma_given).sum())
        told = float(_twice(assignment).sum()) + FEW_NATS * assignment.n_landmarks
        return fit + self.noise.outlier_log_odds * nobody + told

    def _match(self, detections: IntArray) -> _Frame:
        """The frame's detections weighed against the landmarks known so far."""
        kind = self._kind[detections], self._of_kind
        pairings = pairings_of_frame(
            self._filter, self._problem, self._sigma, detections, density=self._density_m2, kind=kind
        )
        if self._traits is not None and self._like is not None:
            read = self._traits.singly(detections[pairings.source])
            told = self._traits.same(read, self._like.part(pairings.target))
            pairings = replace(pairings, log_density_new=pairings.log_density_new - told)
        probability, evidence, _ = pairing_probability(pairings, confidence=CONFIDENCE)
        known = np.zeros(len(detections))
        np.add.at(known, pairings.source, probability)
        assert pairings.followed is not None
        away = self._problem.stamp_s[self._done] - self._seen_s[pairings.target] > FORGET_S
        least = np.where(away & ~pairings.followed, P_RETURN, P_MATCH)
        taken = np.flatnonzero((probability >= least) | self._harmless(pairings, probability, known, least))
        return _Frame(pairings, taken, 1.0 - known, evidence)

    def _harmless(self, pairings: Pairings, probability: FloatArray, known: FloatArray, least: FloatArray) -> BoolArray:
        """(K,) the best pairing of a detection where a wrong choice bends nothing, and the end or a merge will tell.

        That is where the gate is small, or where its rivals may well be the same landmark.
        """
        best = np.zeros(len(probability), dtype=bool)
        for s in np.flatnonzero(known >= P_MATCH):
            rows = np.flatnonzero(pairings.source == s)
            first = rows[probability[rows].argmax()]
            if probability[first] >= least[first]:
                continue  # it is taken anyway
            rivals = rows[(probability[rows] > 1.0 - P_MATCH) & (rows != first)]
            own = pairings.covariance[2 * first : 2 * first + 2, 2 * first : 2 * first + 2]
            area_m2 = math.sqrt(np.linalg.det(own)) * math.exp(pairings.log_density_new[first]) / self._density_m2
            if area_m2 < TIGHT_M2:
                best[first] = True
            elif known[s] >= least[first]:
                best[first] = all(self._may_be_one(pairings.target[first], pairings.target[k]) for k in rivals)
        return best

    def _may_be_one(self, a: int, b: int) -> bool:
        """True where the difference of two landmarks is insignificant."""
        local = self._filter
        at = columns(local.bring(np.array([a, b])))
        by = np.hstack([np.eye(2), -np.eye(2)])
        spread = by @ local.covariance[np.ix_(at, at)] @ by.T + 1e-12 * np.eye(2)
        gap = local.position[a] - local.position[b]
        return bool(gap @ np.linalg.solve(spread, gap) < gates(1, CONFIDENCE)[1])

    def _use(self, frame: _Frame, detections: IntArray) -> None:
        """Update with the certain pairings, and start landmarks where none is near enough."""
        problem, local, pairings = self._problem, self._filter, frame.pairings
        known, target = detections[pairings.source[frame.taken]], pairings.target[frame.taken]
        self._row[known] = target
        local.update(target, problem.reading[known], self._sigma[known], weighing=GATED)
        new = detections[frame.p_new >= P_NEW]
        self._doubted += len(detections) - len(known) - len(new)
        self._of_kind[target] = np.maximum(self._of_kind[target], self._kind[known])
        self._seen_s[target] = problem.stamp_s[self._done]
        if self._traits is not None and self._like is not None:
            self._like = self._traits.followed(self._like, target, known)
        if not len(new):
            return
        self._row[new] = len(local.position) + np.arange(len(new))
        self._of_kind = np.vstack([self._of_kind, self._kind[new]])
        if self._traits is not None and self._like is not None:
            more = Likeness(*map(np.concatenate, zip(self._like, self._traits.nothing(len(new)), strict=True)))
            self._like = self._traits.followed(more, self._row[new], new)
        self._seen_s = np.append(self._seen_s, np.full(len(new), problem.stamp_s[self._done]))
        at = sighted_at(local.pose, problem.reading[new], local.states, problem.mount)
        for row, place in zip(self._row[new].tolist(), at, strict=True):
            local.meet(row, place)
        local.update(self._row[new], problem.reading[new], self._sigma[new], weighing=GATED)

    def _take_stock(self) -> None:
        """Solve everything so far, merge what is one, and go on from there."""
        self._go_on_from(self._settled(self._without_chance(self._assignment()), RECENT))

    def _go_on_from(self, solved: _Solved) -> None:
        assignment = solved.assignment
        self._row[: len(assignment.landmark_row)] = assignment.landmark_row
        self._pose[: self._done] = assignment.estimate.pose
        self._of_kind, self._seen_s, self._like = assignment.of_kind, assignment.last_seen_s, assignment.like()
        place = assignment.estimate.landmark
        near = np.argsort(np.hypot(*(place - assignment.estimate.pose[-1, :2]).T), kind="stable")[:MOST_COMPARED]
        self._filter.begin(assignment.estimate, solved.marginals, self._done - 1, near)

    def _assignment(self) -> Assignment:
        measured = self._problem.until(self._done)
        estimate = Estimate(self._pose[: self._done].copy(), self._filter.position.copy(), self._filter.states.copy())
        count = len(measured.pose_row)
        traits = None if self._traits is None else self._traits.until(count)
        return Assignment(measured, self._row[:count].copy(), estimate, self._kind[:count], traits)

    def _with_sigma(self, measured: Problem) -> Problem:
        """Detections with the noise that has been learned."""
        count = len(measured.pose_row)
        return replace(measured, sigma_given=self._sigma[:count])

    def _without_chance(self, assignment: Assignment) -> Assignment:
        """Landmarks that were seen once or twice, long ago, were none."""
        age = assignment.measured.stamp_s[-1] - assignment.last_seen_s
        return assignment.without(_seldom(assignment) & (age > FORGET_S))

    def _settled(self, assignment: Assignment, recent: int | None = None) -> _Solved:
        """The batch solution, all landmarks or those seen last merged with others while there is something to merge."""
        assignment = replace(assignment, measured=self._with_sigma(assignment.measured))
        return self._all_merged(self._solved(assignment), recent)

    def _all_merged(
        self, solved: _Solved, recent: int | None = None, *, within: tuple[int, int] | None = None
    ) -> _Solved:
        """All landmarks merged, or those seen last, or those from a row on but for so many later ones, with others that
        are no later.
        """
        refused: set[tuple[int, int]] = set()
        for _ in range(MERGE_ROUNDS):
            now = solved.assignment
            self._density_m2 = density = landmark_density(now.estimate.landmark, now.sightings)
            among, known = _latest(now, recent), np.ones(now.n_landmarks, dtype=bool)
            if within is not None:
                known = np.arange(now.n_landmarks) < now.n_landmarks - within[1]
                among = known & (np.arange(now.n_landmarks) >= within[0])
            pairs = propose_merges(
                compared(now, solved.marginals, density), probability=P_MERGE,
                among=among, known=known, last=recent is None, refused=refused,
            )  # fmt: skip
            if not pairs and within is None and now.n_landmarks <= MOST_LAID:
                honest = now.with_shared_errors(solved.marginals.shared)[: 2 * now.n_landmarks, : 2 * now.n_landmarks]
                pairs = propose_constellation(now, honest, density=density, probability=P_MERGE, refused=refused)
            if not pairs:
                break
            merged = self._merged(solved, pairs, refused)
            if merged is not None:
                refused.clear()
                solved = merged
        return solved

    def _contradictions_split(
        self, solved: _Solved, refused: set[tuple[int, int]], recent: int | None = None
    ) -> _Solved:
        """What was given to a landmark wrongly gets one of its own, and is merged again, if the map is better for it.

        Visits that were tried without gain are in `refused`, by first detection and number.
        """
        for _ in range(SPLIT_ROUNDS):
            now = solved.assignment
            linear = solved.smoother.detections(now.estimate)
            visits = weighed_visits(
                now, solved.marginals, linear, density=self._density_m2, pause_s=FORGET_S,
                among=_latest(now, recent),
            )  # fmt: skip
            doubtful = visits.evidence < math.log(P_MERGE / (1.0 - P_MERGE))
            doubtful &= (visits.squared > CONTRADICTS) | (visits.told < -MISREAD_NATS)
            order = np.flatnonzero(doubtful)[np.argsort(visits.evidence[doubtful], kind="stable")]
            _, first = np.unique(visits.landmark[order], return_index=True)  # one of each landmark
            parts = [visits.rows[k] for k in order[np.sort(first)] if _key(visits.rows[k]) not in refused]
            better = self._better_split(solved, parts, refused, recent)
            if better is None:
                break
            solved = better
        return solved

    def _better_split(
        self, solved: _Solved, parts: list[IntArray], refused: set[tuple[int, int]], recent: int | None
    ) -> _Solved | None:
        """With all parts split off, or with half of them, and so on, if that is better."""
        while parts:
            trial = self._all_merged(self._solved(solved.assignment.split(parts)), recent)
            if _is_better(trial, solved):
                return trial
            if len(parts) == 1:
                refused.add(_key(parts[0]))
            parts = parts[: len(parts) // 2]
        return None

    def _relaid(self, solved: _Solved) -> _Solved:
        """Stretches that lie beside where they belong laid there, if the map is better for it."""
        for _ in range(RELAID):
            now = solved.assignment
            stretches = displaced_stretches(
                now, solved.marginals, now.sightings >= FEWEST_SIGHTINGS, density=self._density_m2, probability=P_MERGE
            )
            starts = (laid(now, stretch, before) for stretch in stretches[:STRETCHES] for before in BEFORE)
            trials = (self._all_merged(self._solved(start)) for start in starts)
            better = next((trial for trial in trials if _is_better(trial, solved)), None)
            if better is None:
                break
            solved = self._contradictions_split(better, set())
        return solved

    def _merged(self, solved: _Solved, pairs: list[tuple[int, int]], refused: set[tuple[int, int]]) -> _Solved | None:
        """With all pairs merged, or with half of them, and so on, until the cost agrees; one alone may be refused."""
        sightings = solved.assignment.sightings
        while pairs:
            trial = self._solved(solved.assignment.merged(pairs))
            lesser = np.array([min(sightings[u], sightings[o]) for u, o in pairs])
            if trial.cost - solved.cost <= np.minimum(RISE_NATS + RISE_SHARE * lesser, RISE_MOST).sum():
                return trial
            if len(pairs) == 1:
                refused.update(pairs)
            pairs = pairs[: len(pairs) // 2]
        return None

    def _solved(self, assignment: Assignment, noise: Noise | None = None) -> _Solved:
        """Optimum, covariances and cost; learns the noise of sightings on the way."""
        problem = assignment.problem()
        noise = self.noise if noise is None else noise
        smoother = Smoother(problem, noise, heavy=True)
        slices = smoother.solved_in_slices(assignment.estimate, iterations=8, tolerance=1e-3, settled=0.1)
        estimate, marginals = exhausted(slices)
        measured = assignment.measured
        given = self._problem.sigma_given[: len(measured.pose_row)]
        unknown = replace(problem, sigma_given=given[assignment.landmark_row >= 0])
        left = 1.0 - np.diagonal(marginals.explained_detections, axis1=1, axis2=2)
        noise_of = fit_sighting_noise(unknown, estimate, NOISE_FLOOR * self._start_noise.detection, left)
        self._sigma = INFLATION * noise_of.of_detections(self._problem)
        cost = smoother.under(noise, heavy=False).cost(estimate)
        if assignment.traits is not None:
            cost -= assignment.traits.told(*assignment.of_visits())
        return _Solved(replace(assignment, estimate=estimate), marginals, cost, smoother)


def compared(assignment: Assignment, marginals: Marginals, density: float) -> Solution:
    """Return the landmarks of an assignment at its optimum, as `propose_merges` wants them."""
    place, kind, told = assignment.estimate.landmark, assignment.of_kind, assignment.told
    like = assignment.like()

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

        new = math.log(density) - by_name(kind[younger], kind[older], np.minimum(told[younger], told[older]))
        if assignment.traits is not None and like is not None:
            new -= assignment.traits.same(like.part(younger), like.part(older))
        return Differences(place[younger] - place[older], own, new, together)

    return Solution(
        place, marginals.landmark, differences, assignment.sightings, assignment.last_seen_s,
        *assignment.seen_together(), kind,
    )  # fmt: skip


def _twice(assignment: Assignment) -> FloatArray:
    """(K,) evidence [nats] against landmarks with a name that another one has, too."""
    kind, told = assignment.of_kind, assignment.told
    one, other = np.nonzero(np.triu(same_name(kind[:, None], kind[None]), 1))
    return by_name(kind[one], kind[other], np.minimum(told[one], told[other]))


def by_name(one: IntArray, other: IntArray, told: IntArray) -> FloatArray:
    """Return evidence [nats] that two are one: labels (K, P) of both, and how often the name of the lesser was read."""
    return np.asarray(NAMED_NATS * np.minimum(told, MOST_TOLD) * same_name(one, other))


def _seldom(assignment: Assignment) -> BoolArray:
    """(L,) what was seen too seldom to be a landmark, and has no name."""
    return np.asarray((assignment.sightings < FEWEST_SIGHTINGS) & (assignment.told == 0))


def _latest(assignment: Assignment, count: int | None) -> BoolArray:
    """(L,) the landmarks with two sightings that were seen last; None for all."""
    last = np.where(assignment.sightings > 1, assignment.last_seen_s, -np.inf)
    if count is None or count >= len(last):
        return np.ones(len(last), dtype=bool)
    return np.asarray(last >= np.partition(last, -count)[-count])


def _is_better(trial: _Solved, solved: _Solved) -> bool:
    """Whether an assignment explains the detections better, by more than landmarks that it needs beside."""
    more = trial.assignment.n_landmarks - solved.assignment.n_landmarks
    gained = solved.cost - trial.cost + _twice(solved.assignment).sum() - _twice(trial.assignment).sum()
    return bool(gained - FEW_NATS * more > (0.0 if more else SAME_NATS))


def _key(rows: IntArray) -> tuple[int, int]:
    return int(rows[0]), len(rows)


def _partners(row: IntArray) -> IntArray:
    """(M,) the first detection of the same landmark; -1 where there is none."""
    first = np.full(len(row), -1)
    seen = np.flatnonzero(row >= 0)
    _, at, of = np.unique(row[seen], return_index=True, return_inverse=True)
    first[seen] = seen[at][of]
    return first


def pairings_of_frame(
    local: LocalFilter,
    problem: Problem,
    sigma: FloatArray,
    detections: IntArray,
    *,
    density: float,
    kind: tuple[IntArray, IntArray],
) -> Pairings:
    """Return detections of a frame with the landmarks whose gates they pass.

    Args:
        local: the pose that made the detections, with the landmarks that are compared.
        problem: the readings.
        sigma: (M, 2) standard deviations of all detections.
        detections: (n,) rows of those of the frame.
        density: landmarks a square metre that one expects where none was met before.
        kind: (n, 2) classes and names of the detections and (L, 2) of the landmarks.
    """
    target = np.sort(local.active)
    source, target = np.repeat(np.arange(len(detections)), len(target)), np.tile(target, len(detections))
    same = alike(kind[0][source], kind[1][target])
    source, target = source[same], target[same]
    seen = detections[source]
    nis, log_det, innovation, by = local.compare(target, problem.reading[seen], sigma[seen])
    inside = np.flatnonzero(nis <= gates(1, CONFIDENCE)[1])
    # what is followed has a neighbourhood that is known; elsewhere the gate may hold another landmark by chance
    followed = log_det[inside] <= 2.0 * np.log(sigma[seen[inside]]).sum(axis=1) + FOLLOWED
    source, target, seen, count = source[inside], target[inside], seen[inside], len(inside)
    at, joint = np.empty((count, 10), dtype=np.int64), np.empty((2 * count, 2 * count))
    at[:, :8], at[:, 8:] = np.arange(8), columns(local.bring(target)).reshape(-1, 2)
    if count:
        scratch = np.empty((2 * count, len(local.covariance)))
        spread_of_frame(local.covariance, by[inside].reshape(2 * count, 10), at, scratch, joint)
    joint[np.diag_indices(2 * count)] += (sigma[seen] ** 2).ravel()
    # a square metre has r dr db
    new = np.log(np.where(followed, UNMET, 1.0) * density * np.maximum(problem.reading[seen, 0], 0.1))
    new -= NAMED_NATS * same_name(kind[0][source], kind[1][target])
    return Pairings(source, target, innovation[inside], joint, new, len(detections), followed)


def density_of_unmet(place: FloatArray) -> float:
    """Return landmarks a square metre that one may still meet in the area that those at `place` (L, 2) span."""
    return FEWEST / _area_m2(place)


def _area_m2(place: FloatArray) -> float:
    return max(float(np.prod(np.ptp(place, axis=0))) if len(place) else 0.0, SMALLEST_M2)


def landmark_density(place: FloatArray, sightings: IntArray) -> float:
    """Return landmarks a square metre in the area that those at `place` (L, 2) span, as many as one expects anywhere.

    Those that are seen twice under two numbers are not counted twice: the number is `(sum s)^2 / sum s^2` of the
    `sightings` (L,), where all are seen alike that of the landmarks.
    """
    return effective_number(sightings) / _area_m2(place)


def effective_number(sightings: IntArray) -> float:
    """Return how many landmarks there are, by their sightings (L,): `(sum s)^2 / sum s^2`, at least `FEWEST`."""
    squares = float((sightings.astype(float) ** 2).sum())
    return max(float(sightings.sum()) ** 2 / max(squares, 1.0), FEWEST)


PSEUDO_SIGHTINGS = 100.0
"""Imaginary sightings with the start's noise: what was associated first is little, and only what agreed."""
CLIPPED_AT = 9.0
"""Squared normalised residual beyond which a sighting tells nothing more about the noise."""
LEAST_LEFT = 0.1
"""Share of a residual's variance that the fit leaves, at least: where it leaves less, the residual tells nothing."""
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


def fit_sighting_noise(
    problem: Problem, estimate: Estimate, start: FloatArray, left: FloatArray | None = None
) -> SightingNoise:
    """Estimate noise from the residuals of associated detections, which came without their own.

    Args:
        problem: detections with their landmarks.
        estimate: the optimum.
        left: (M, 2) share of the noise's variance that the fit leaves in the residuals (restricted likelihood, see
            `slam.noise`); None for all of it.
        start: (2,) standard deviations that `PSEUDO_SIGHTINGS` imaginary sightings vouch for.
    """
    free = ~np.isfinite(problem.sigma_given)
    left = np.ones(free.shape) if left is None else np.maximum(left, LEAST_LEFT)
    squared = detection_residuals(problem, estimate) ** 2 / left
    fourth = problem.reading[free[:, 0], 0] ** 4
    middle = float(np.median(fourth)) if len(fourth) else 1.0
    in_range, in_bearing = squared[free[:, 0], 0], squared[free[:, 1], 1]
    own = left[free[:, 1], 1]
    variance, growth, bearing = start[0] ** 2, 0.0, start[1] ** 2
    for _ in range(ROUNDS):
        expected = variance + growth * fourth
        clipped = np.minimum(in_range, CLIPPED_AT * expected)
        # Fisher scoring of a Gaussian whose variance is linear in two numbers, neither negative
        weight = np.append((left[free[:, 0], 0] / expected) ** 2, PSEUDO_SIGHTINGS / (variance + growth * middle) ** 2)
        column = np.append(fourth, middle)
        value = np.append(clipped, start[0] ** 2)
        variance, growth = _line_not_negative(column, value, weight)
        total = own @ np.minimum(in_bearing, CLIPPED_AT * bearing) + PSEUDO_SIGHTINGS * start[1] ** 2
        bearing = total / (own.sum() + PSEUDO_SIGHTINGS)
    return SightingNoise(variance, growth, float(bearing))


def _line_not_negative(x: FloatArray, y: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Weighted least squares of `y = a + b x` with `a` at least a thousandth of the mean, `b` not negative."""
    total = weight.sum()
    mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
    spread = (weight * (x - mean_x) ** 2).sum()
    slope = (weight * (x - mean_x) * (y - mean_y)).sum() / spread if spread > 0.0 else 0.0
    slope = float(np.clip(slope, 0.0, 0.999 * mean_y / mean_x))
    return float(mean_y - slope * mean_x), slope
