"""The joint search as a method of the estimator: relinearise, compare with the map, search, solve again.

One landmark at a time cannot distinguish 'these four moved' from 'the robot is elsewhere'. So the changes are searched
with the trajectory marginalised (`evidence`, `weigh`), the best hypothesis becomes a problem of its own (`explain`),
and its solution is where everything is linearised next, until the groups stay.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import sparse

from evermap.align.candidates import Matches, find_consensus
from evermap.config import SlamConfig
from evermap.estimate.sparse.system import Slices, exhaust
from evermap.slam.batch import outvote
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.changes.evidence import (
    Comparison,
    WindowEvidence,
    compare,
    dense_ms,
    in_sensor_metres,
    landmark_evidence,
)
from evermap.slam.changes.explain import GivenMap, MovedGroup, explained, parting_time, unsway
from evermap.slam.changes.search import item_columns
from evermap.slam.changes.weigh import ChangePosterior, weigh
from evermap.slam.method import Compare, Explanation, Method, Rival
from evermap.slam.noise import START
from evermap.slam.problem import Estimate, Noise, Problem, independent
from evermap.slam.smoother import Smoother
from evermap.types import BoolArray, ChangeKind, FloatArray, IntArray, MapChange

VISIT_MARGIN, MOST_VISITS = 0.5, 8
"""Visits that get windows of their own: this share of the interval around it, and this many."""
DISAGREES = "the prior map disagrees with the detections, and no change explains it: cannot localise in it"
WINDOWS_AROUND = 2
"""Windows with its sightings on either side of a change in which its instant is sought, at most."""
ROUNDS = 6
"""Searches at the end of a session, at most."""
POSES_A_WINDOW, MOST_WINDOWS, MOST_ITEMS = 60, 12, 400
"""Size of a search: poses a window, windows, and landmarks times windows, so that it takes milliseconds."""


Groups = tuple[MovedGroup, ...]


def may_search(n_frames: int, *, in_map: bool) -> bool:
    """Return whether a session of this many frames is ever searched for changes: one window alone has no before."""
    return in_map or n_frames >= 2 * POSES_A_WINDOW


class Joint(Method):
    """Method that finds groups of moved landmarks, before the session or within it.

    `calibration` are the priors of the calibration states as the user means them, `given` is the map to compare with.
    """

    def __init__(
        self, n_landmarks: int, calibration: CalibrationPrior, given: GivenMap | None, settings: SlamConfig
    ) -> None:
        self._count, self._calibration, self._given = n_landmarks, calibration, given
        self._prior, self._robust, self._fewest = settings.changes, settings.robust, settings.fewest_sightings
        self._ranges = settings.ranges
        self._loosened: _Loosened | None = None
        self._concluded: Explanation | None = None
        self._landmark = np.arange(n_landmarks)
        self._groups: Groups = ()
        self._swaps: tuple[tuple[int, int, float], ...] = ()
        self.posterior: ChangePosterior | None = None

    def assign(self, problem: Problem, row: int, detections: IntArray, compare: Compare) -> IntArray:
        """Return the place where the landmark is by now."""
        del row, compare
        mine: IntArray = problem.landmark_row[detections]
        return mine if len(self._landmark) == self._count else self._current()[mine]

    def revises(self, problem: Problem) -> bool:
        """Return False where there is neither a map nor, for so many landmarks, more than one window."""
        return self._in_map(problem) or self._count <= MOST_ITEMS // 2

    def unprejudice(self, problem: Problem, estimate: Estimate) -> tuple[Problem, Estimate]:
        """Return the problem with the map believed to 1 m: a wrong one bends the solution or looks noisy."""
        if self._given is None or not self._in_map(problem):
            return problem, estimate
        # what the map says of the metre is no change
        sigma = np.maximum(self._calibration.sigma, problem.prior.sigma)
        self._calibration = replace(self._calibration, sigma=sigma)
        free = replace(
            self._base(problem),
            prior=self._calibration.without_scale(),
            landmark_mean=self._given.mean,
            landmark_information=independent(self._given.given[:, None, None] * np.eye(2) / self._prior.loose_map_m**2),
        )
        start = in_sensor_metres(self._where_most_agree(self._first_places(estimate)), self._calibration)
        # what the map puts in the wrong place is where most of its sightings say, whatever the map
        weights = Smoother(free, START, heavy=True, robust=self._robust).inlier_probability(start)
        unmapped = replace(free, landmark_information=sparse.csr_array(free.landmark_information.shape))
        self._loosened = _Loosened(problem, free, outvote(unmapped, start, weights, self._fewest))
        return free, self._loosened.start

    def _where_most_agree(self, estimate: Estimate) -> Estimate:
        """The whole moved to where most landmarks are at their places: those seen first may have been the others."""
        assert self._given is not None
        first = self._first_places(estimate)  # what moved within the session has more, which no map knows
        both = self._given.given & first.known
        motion, agree = find_consensus(Matches.of(first.landmark[both], self._given.mean[both]))
        if np.count_nonzero(agree) < 2:
            return estimate
        return estimate.moved(motion)

    def beside(self) -> Joint:
        """Return a copy that searches while this one assigns by what was found before."""
        return copy(self)

    def revise(self, problem: Problem, estimate: Estimate, noise: Noise, *, heavy: bool, final: bool) -> Explanation:
        """Return what `revise_in_slices` does."""
        return exhaust(self.revise_in_slices(problem, estimate, noise, heavy=heavy, final=final))

    def revise_in_slices(
        self, problem: Problem, estimate: Estimate, noise: Noise, *, heavy: bool, final: bool
    ) -> Slices[Explanation]:
        """Search at the present estimate, and at the end of the session again at the resulting one."""
        if final and self._concluded is not None:
            return replace(self._concluded, problem=problem, estimate=estimate)
        if final:
            self.posterior = None  # hypotheses found on the way are not assumed
            if self._loosened is not None:
                # what has not been explained yet may look like outliers on the wrong side: none is ruled out here
                problem, free, start = self._loosened
                smoother = Smoother(free, noise, heavy=True, robust=self._robust)
                estimate = smoother.optimum(start, iterations=10, tolerance=1e-4)
                # what moved has turned the whole, too: linear evidence of ranges would not turn it back
                estimate = self._where_most_agree(estimate)
        in_map = self._in_map(problem)
        given = self._given if in_map and self._given is not None else GivenMap.empty(self._count)
        base = self._base(problem)
        if not in_map and len(self._bounds(base)) == 2:  # one window and no map: nothing to compare with
            return Explanation(problem, estimate, self._current())
        for _ in range(ROUNDS if final else 1):
            bounds = self._bounds(base)
            row = self._rows_by_window(estimate, base.stamp_s[bounds[:-1]])
            evidence = yield from landmark_evidence(
                base, estimate, noise, self._calibration, bounds, self._fewest, self._ranges, sized=in_map, row=row
            )
            if len(evidence.landmark) == 0:
                return Explanation(problem, estimate, self._current())
            before = self.posterior
            posterior, given = yield from self._weigh_worlds(evidence, given, len(bounds) - 1, thorough=final)
            told = without_common_motion(posterior.groups, evidence.landmark, given)
            groups = yield from self._all_timed(told, base, estimate, noise, evidence, bounds)
            if len(told) < len(posterior.groups):
                estimate = self._where_most_agree(estimate)
            settled = before is not None and before.map_factor == posterior.map_factor and _same(groups, self._groups)
            self.posterior, self._groups = posterior, groups
            if not in_map and not groups and len(self._landmark) == self._count:
                return Explanation(problem, estimate, self._current())
            # the search may find the map better than it says; the solution does not build on that
            believed = replace(given, covariance=given.covariance * max(posterior.map_factor, 1.0) ** 2)
            problem, start, self._landmark = self._explain_moves(base, estimate, evidence, believed, groups)
            # with the kernel that never lets go: as long as places are wrong, right detections look like outliers
            smoother = Smoother(problem, noise, heavy=True, robust=self._robust)
            estimate, _ = yield from smoother.solve_in_slices(start, iterations=5, tolerance=1e-4)
            if settled:
                break
        if in_map:
            self._given = given
        if not heavy:
            lighter = smoother.under(noise, heavy=False)
            estimate, _ = yield from lighter.solve_in_slices(estimate, iterations=5, tolerance=1e-4)
        light = smoother.under(noise, heavy=False)
        changes = self._changes(self._groups, posterior.probability, base, light, estimate)
        revision = Explanation(problem, estimate, self._current(), changes)
        if final:
            lost = in_map and not self._groups and posterior.misfit > self._prior.disagreement
            rivals = self._rivals(base, evidence, believed, estimate, noise, bounds)
            revision = replace(revision, rivals=rivals, warnings=(DISAGREES,) if lost else ())
            self._concluded = revision
        return revision

    def _in_map(self, problem: Problem) -> bool:
        return self._given is not None and bool(problem.mapped[: self._count][self._given.given].any())

    def _base(self, problem: Problem) -> Problem:
        """The measurements with one place a landmark."""
        return replace(problem, landmark_row=self._landmark[problem.landmark_row])

    def _first_places(self, estimate: Estimate) -> Estimate:
        """Return one place per landmark: the first."""
        return replace(estimate, landmark=estimate.landmark[: self._count])

    def _rows_by_window(self, estimate: Estimate, start_s: FloatArray) -> IntArray:
        """Return (W, L) places of landmarks in every window, by where it starts (W,) [s]: of what moved the later one.

        Evidence of ranges is linear only near where a landmark is by then.
        """
        row = np.tile(np.arange(self._count), (len(start_s), 1))
        if len(estimate.landmark) == len(self._landmark):
            current = self._current()
            for group in self._groups:
                if group.since_s is not None:
                    row[np.ix_(start_s >= group.since_s, group.members)] = current[group.members]
        return row

    def _explain_moves(
        self, base: Problem, estimate: Estimate, evidence: WindowEvidence, believed: GivenMap, groups: Groups
    ) -> tuple[Problem, Estimate, IntArray]:
        """The problem in a world where these groups moved, a start, and the landmark of every place."""
        landmark = self._first_places(estimate).landmark.copy()
        first = evidence.first_seen(landmark)
        for group in groups:
            if group.window > 0:  # within the session: from where it was first
                landmark[group.members] = first[group.members]
        return explained(base, replace(estimate, landmark=landmark), believed, groups, self._prior)

    def _rivals(
        self,
        base: Problem,
        evidence: WindowEvidence,
        believed: GivenMap,
        estimate: Estimate,
        noise: Noise,
        bounds: IntArray,
    ) -> tuple[Rival, ...]:
        """Explanations nearly as probable as the best, each solved on its own."""
        assert self.posterior is not None
        rivals = []
        for found, probability in self.posterior.alternatives[: self._prior.most_rivals]:
            if probability < self.posterior.probability * math.exp(-self._prior.rival_nats):
                break
            groups = exhaust(self._all_timed(found, base, estimate, noise, evidence, bounds))
            problem, start, landmark = self._explain_moves(base, estimate, evidence, believed, groups)
            smoother = Smoother(problem, noise, robust=self._robust)
            solved = smoother.optimum(start, iterations=5, tolerance=1e-4)
            current = _current(landmark, self._count)
            rivals.append(
                Rival(
                    self._changes(groups, probability, base, smoother, solved),
                    probability,
                    solved.landmark[current],
                    smoother.marginals(solved).landmark[current],
                )
            )
        return tuple(rivals)

    def _weigh_worlds(
        self, evidence: WindowEvidence, given: GivenMap, n_windows: int, *, thorough: bool
    ) -> Slices[tuple[ChangePosterior, GivenMap]]:
        """The posterior, and the map with the landmarks that carry each other's identity at each other's place."""
        posterior = yield from weigh(evidence, given, self._prior, n_windows, before=self.posterior, thorough=thorough)
        if not given.given.any():
            return posterior, given
        soft = evidence.soften(self._prior.usual_softness_m)
        yield dense_ms(len(soft.pull))
        while True:
            comparison = compare(soft, given.mean, given.covariance, given.given)
            yield dense_ms(len(soft.pull))
            swap = likeliest_swap(soft, comparison, given, self._prior.p_swapped)
            yield dense_ms(len(soft.pull))
            if swap is None:
                break
            other = with_swap(given, swap.first, swap.second)
            # the same copies for both: what is left out costs nothing, and must not be what decides
            rival = yield from weigh(
                posterior.evidence, other, self._prior, n_windows, before=posterior, thorough=thorough, spared=True
            )
            log_odds = rival.score + swap.log_prior - posterior.score
            if log_odds <= 0.0:  # moves explain it better
                break
            posterior, given = rival, other
            self._swaps = (*self._swaps, (swap.first, swap.second, float(1.0 / (1.0 + np.exp(-log_odds)))))
        return posterior, given

    def _bounds(self, problem: Problem) -> IntArray:
        """First pose of every window; a group that moved has windows of its own, visit by visit."""
        n_poses = len(problem.stamp_s)
        n_seen = len(np.unique(self._landmark[problem.landmark_row]))
        windows = max(min(n_poses // POSES_A_WINDOW, MOST_WINDOWS, MOST_ITEMS // max(n_seen, 1)), 1)
        bounds = np.linspace(0, n_poses, windows + 1).astype(np.int64)
        cuts = [cut for group in self._groups for cut in _visits(problem, group, self._prior.visit_gap_s)]
        return np.unique(np.append(bounds, np.searchsorted(problem.stamp_s, cuts)))

    def _current(self) -> IntArray:
        """(L,) the last place of every landmark."""
        return _current(self._landmark, self._count)

    def _all_timed(
        self,
        groups: Groups,
        base: Problem,
        estimate: Estimate,
        noise: Noise,
        evidence: WindowEvidence,
        bounds: IntArray,
    ) -> Slices[Groups]:
        """Return the groups, each `_timed`."""
        timed: Groups = ()
        for group in groups:
            one = yield from self._timed(group, base, estimate, noise, evidence, bounds)
            timed = (*timed, one)
        return timed

    def _timed(
        self,
        group: MovedGroup,
        base: Problem,
        estimate: Estimate,
        noise: Noise,
        evidence: WindowEvidence,
        bounds: IntArray,
    ) -> Slices[MovedGroup]:
        """Return the group with the time of its change, if that was within the session.

        The search, for which no pose is certain, says between which windows. Within those every detection tells, once
        the poses are those of a world where it happened then.
        """
        if group.window == 0:
            return group
        seen = np.unique(evidence.window[np.isin(evidence.landmark, group.members)])
        # a window more on both sides: of a few ranges, one may say nothing of which place they are of
        first = seen[seen < group.window][-WINDOWS_AROUND:][0]
        later = seen[seen >= group.window][:WINDOWS_AROUND]
        last = later[-1] if len(later) else len(bounds) - 2
        stamps = base.stamp_s[np.minimum(bounds[[first, group.window, last + 1]], len(base.stamp_s) - 1)]
        within_s = (float(stamps[0]), float(stamps[2]))
        begun = replace(group, since_s=float(stamps[1]), between_s=within_s)
        if not any(begun.same_as(solved) for solved in self._groups):  # poses of another time would vote for it
            return begun
        old = estimate.landmark[: self._count]
        free = yield from unsway(base, estimate, noise, group.members)
        since_s, between_s = parting_time(
            base,
            free,
            noise,
            group.members,
            old[group.members],
            group.moved(old),
            within_s,
            self._prior.interval,
        )
        return replace(group, since_s=since_s, between_s=between_s)

    def _changes(
        self, groups: Groups, probability: float, base: Problem, smoother: Smoother, estimate: Estimate
    ) -> tuple[MapChange, ...]:
        first_s, stamp_s = float(base.stamp_s[0]), base.seen_s
        used = smoother.inlier_probability(estimate) > 0.5
        moved = tuple(
            replace(_change(group, probability, first_s), n_hits=_count_hits(group, base, used, stamp_s))
            for group in groups
        )
        return (*(self._swap_change(swap, first_s) for swap in self._swaps), *moved)

    def _swap_change(self, swap: tuple[int, int, float], first_s: float) -> MapChange:
        """Two landmarks at each other's place; the displacement is the first one's."""
        assert self._given is not None
        first, second, probability = swap
        step = self._given.mean[first] - self._given.mean[second]
        return MapChange(
            landmark_ids=(first, second),
            kind=ChangeKind.SWAPPED,
            stamp_from_s=float("nan"),
            stamp_to_s=first_s,
            displacement_m=(float(step[0]), float(step[1])),
            rotation_rad=0.0,
            probability=probability,
        )


class _Loosened(NamedTuple):
    """The problem with its map, the same with the map loosened to a metre, and initial values for that."""

    held: Problem
    free: Problem
    start: Estimate


def _visits(problem: Problem, group: MovedGroup, gap_s: float) -> FloatArray:
    """When a group was met again [s], around the time when it is thought to have moved."""
    if group.between_s is None or group.since_s is None:
        return np.zeros(0)
    stamps = problem.stamp_s[problem.pose_row[np.isin(problem.landmark_row, group.members)]]
    starts = stamps[1:][np.diff(stamps) > gap_s]
    margin = VISIT_MARGIN * (group.between_s[1] - group.between_s[0])
    near = (starts >= group.between_s[0] - margin) & (starts <= group.between_s[1] + margin)
    return np.append(starts[near][:MOST_VISITS], group.since_s)


def _change(group: MovedGroup, probability: float, first_s: float) -> MapChange:
    between = (float("nan"), first_s) if group.between_s is None else group.between_s
    return MapChange(
        landmark_ids=tuple(int(j) for j in group.members),
        kind=ChangeKind.ROTATED if group.turns else ChangeKind.MOVED,
        stamp_from_s=between[0],
        stamp_to_s=between[1],
        displacement_m=(float(group.motion[0]), float(group.motion[1])),
        rotation_rad=float(group.motion[2]),
        probability=probability,
    )


def _count_hits(group: MovedGroup, base: Problem, used: BoolArray, stamp_s: FloatArray) -> int:
    """Detections of the members that are no outliers, since they are at their new places."""
    since_s = -math.inf if group.since_s is None else group.since_s
    return int(np.count_nonzero(used & (stamp_s >= since_s) & np.isin(base.landmark_row, group.members)))


def without_common_motion(groups: Groups, seen: IntArray, given: GivenMap) -> Groups:
    """Return the groups without the largest one where nothing of the map that was seen stayed, and most of it moved
    together before the session.

    Then that is the frame: a shift or a rotation of everything is no change. What moved within the session, and was
    alone at its place until then, gives none.

    Args:
        groups: that are thought to have moved.
        seen: landmarks that were seen.
        given: the map.
    """
    mapped = np.unique(seen)
    mapped = mapped[given.given[mapped]]
    before = [group for group in groups if group.window == 0]
    if not (before and len(mapped)) or not np.isin(mapped, np.concatenate([group.members for group in groups])).all():
        return groups
    largest = max(before, key=lambda group: len(group.members))
    stayed = np.setdiff1d(mapped, np.concatenate([group.members for group in before]))
    if len(stayed) >= len(largest.members):
        return groups
    return tuple(group for group in groups if group is not largest)


def _same(groups: Groups, others: Groups) -> bool:
    return len(groups) == len(others) and all(a.same_as(b) for a, b in zip(groups, others, strict=True))


def _current(landmark: IntArray, count: int) -> IntArray:
    """(L,) the last place of every landmark, from the landmark of every place."""
    current = np.zeros(count, dtype=np.int64)
    current[landmark] = np.arange(len(landmark))  # later places overwrite earlier ones
    return current


class Swap(NamedTuple):
    """Two landmarks, and the log prior of their being mixed up."""

    first: int
    second: int
    log_prior: float


def likeliest_swap(evidence: WindowEvidence, comparison: Comparison, given: GivenMap, p_swapped: float) -> Swap | None:
    """Return the two landmarks that gain most by taking each other's place; None if that gains less than it costs.

    `p_swapped` is the prior probability that any two landmarks were mixed up.
    """
    candidates = np.intersect1d(np.unique(evidence.landmark), np.flatnonzero(given.given))
    count = len(candidates)
    if count < 2:
        return None
    quadratic, linear = exhaust(item_columns(evidence, comparison, given.mean, 1, candidates))
    precision = quadratic.reshape(count, 4, count, 4)[:, :2, :, :2]
    pull = linear.reshape(count, 4)[:, :2]
    place = given.mean[candidates]
    first, second = np.triu_indices(count, 1)
    step = place[second] - place[first]
    rows = np.arange(count)
    own = precision[rows, :, rows, :]
    stiff = own[first] + own[second] - precision[first, :, second, :] - precision[second, :, first, :]
    gain: FloatArray = (step * (pull[first] - pull[second])).sum(axis=1)
    gain -= 0.5 * np.einsum("ka,kab,kb->k", step, stiff, step)
    best = int(np.argmax(gain))
    log_prior = float(np.log(p_swapped) - np.log(len(gain)))
    if gain[best] + log_prior <= 0.0:
        return None
    return Swap(int(candidates[first[best]]), int(candidates[second[best]]), log_prior)


def with_swap(given: GivenMap, first: int, second: int) -> GivenMap:
    """Return the map with two landmarks at each other's place."""
    order = np.arange(len(given.mean))
    order[[first, second]] = second, first
    return replace(given, mean=given.mean[order], covariance=given.covariance[order])
