"""The joint search as a method of the estimator: relinearise, compare with the map, search, solve again.

One landmark at a time cannot tell 'these four moved' from 'the robot is elsewhere'. So the changes are searched with
the trajectory marginalised (`evidence`, `weigh`), the best hypothesis becomes a problem of its own (`explain`), and
its solution is where everything is linearised next, until the groups stay.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.slam.arrow import Smoother
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.changes.evidence import Evidence, compare, in_sensor_metres, landmark_evidence
from evermap.slam.changes.explain import GivenMap, Group, explained
from evermap.slam.changes.prior import ChangePrior
from evermap.slam.changes.swaps import likeliest_swap, with_swap
from evermap.slam.changes.timing import parting_time
from evermap.slam.changes.weigh import Verdict, weigh
from evermap.slam.method import Compare, Revision
from evermap.slam.problem import Estimate, Noise, Problem
from evermap.slam.triangulate import outvoted
from evermap.types import ChangeKind, FloatArray, IntArray, MapChange

FREE_INFORMATION = 1e-4
"""Holds the first pose of a free solution to 100 m, so that the linear system stays well conditioned."""
SWAP_SOFTNESS_M = 0.02
"""Error that the sightings of a window share, while it is decided which identities are swapped."""
ROUNDS = 6
"""Searches at the end of a session, at most."""
POSES_A_WINDOW = 60
MOST_WINDOWS = 12
MOST_ITEMS = 400
"""Landmarks times windows, so that a search stays a matter of milliseconds."""


class Joint:
    """Which landmarks moved together, before the session or within it.

    Args:
        n_landmarks: landmarks of the session.
        calibration: priors of the calibration states as the user means them.
        given: the map to compare with; None where there is none.
        prior: how changes are distributed.
    """

    def __init__(
        self, n_landmarks: int, calibration: CalibrationPrior, given: GivenMap | None, prior: ChangePrior
    ) -> None:
        self._count = n_landmarks
        self._calibration = calibration
        self._given = given
        self._prior = prior
        self._landmark = np.arange(n_landmarks)
        self._groups: tuple[Group, ...] = ()
        self._swaps: tuple[tuple[int, int, float], ...] = ()
        self.verdict: Verdict | None = None

    def assign(self, problem: Problem, row: int, detections: IntArray, compare: Compare) -> IntArray:
        """The place where the landmark is by now."""
        del row, compare
        current: IntArray = self._current()[problem.landmark_row[detections]]
        return current

    def revise(self, problem: Problem, estimate: Estimate, noise: Noise, *, heavy: bool, final: bool) -> Revision:
        """Search at the present estimate, and again at what it leads to where the session ends."""
        base = replace(problem, landmark_row=self._landmark[problem.landmark_row])
        bounds = self._bounds(problem)
        n_windows = len(bounds) - 1
        in_map = bool(problem.mapped[: self._count].any()) and self._given is not None
        if not in_map and n_windows == 1:
            return Revision(problem, estimate, self._current())
        given = self._given if in_map and self._given is not None else GivenMap.empty(self._count)
        if final:
            self.verdict = None  # nothing of what was thought on the way is taken for granted
            estimate = self._without_map(base, estimate, noise)
        for _ in range(ROUNDS if final else 1):
            bounds = self._bounds(problem)
            n_windows = len(bounds) - 1
            evidence = landmark_evidence(base, _one_place(estimate, self._count), noise, self._calibration, bounds)
            verdict, given = self._weighed(evidence, given, n_windows, thorough=final)
            groups = tuple(self._timed(group, base, estimate, noise, bounds) for group in verdict.groups)
            believed = replace(given, covariance=given.covariance * verdict.map_factor**2)
            before = self.verdict
            settled = before is not None and before.map_factor == verdict.map_factor and _same(groups, self._groups)
            self.verdict, self._groups = verdict, groups
            start = _with_copies(_one_place(estimate, self._count), evidence, groups)
            problem, start, self._landmark = explained(base, start, believed, groups, self._prior.spread)
            # with the kernel that never lets go: as long as places are wrong, right detections look like outliers
            estimate = Smoother(problem, noise, heavy=True).optimum(start, iterations=10, tolerance=1e-4)
            if settled:
                break
        if not heavy:
            estimate = Smoother(problem, noise).optimum(estimate, iterations=10, tolerance=1e-4)
        return Revision(problem, estimate, self._current(), self._changes(base))

    def _without_map(self, base: Problem, estimate: Estimate, noise: Noise) -> Estimate:
        """The solution that no prior map has bent, about where it was."""
        free = replace(
            base,
            prior=self._calibration.without_scale(),
            start_pose=estimate.pose[0],
            start_information=FREE_INFORMATION,
            landmark_mean=np.zeros((self._count, 2)),
            landmark_information=np.zeros((2 * self._count, 2 * self._count)),
        )
        start = in_sensor_metres(_one_place(estimate, self._count), self._calibration)
        smoother = Smoother(free, noise, heavy=True)
        # what the map puts in the wrong place is where most of its sightings say
        start = outvoted(free, start, smoother.inlier_probability(start))
        return smoother.optimum(start, iterations=10, tolerance=1e-4)

    def _weighed(
        self, evidence: Evidence, given: GivenMap, n_windows: int, *, thorough: bool
    ) -> tuple[Verdict, GivenMap]:
        """The verdict, and the map with the landmarks that carry each other's identity at each other's place."""
        verdict = weigh(evidence, given, self._prior, n_windows, before=self.verdict, thorough=thorough)
        soft = evidence.softened(SWAP_SOFTNESS_M)
        while given.given.any():
            swap = likeliest_swap(soft, compare(soft, given.mean, given.covariance, given.given), given)
            if swap is None:
                break
            other = with_swap(given, swap.first, swap.second)
            rival = weigh(evidence, other, self._prior, n_windows, before=verdict, thorough=thorough)
            log_odds = rival.score + swap.log_prior - verdict.score
            if log_odds <= 0.0:  # moves explain it better
                break
            verdict, given = rival, other
            self._swaps = (*self._swaps, (swap.first, swap.second, float(1.0 / (1.0 + np.exp(-log_odds)))))
        if given.given.any():
            self._given = given
        return verdict, given

    def _bounds(self, problem: Problem) -> IntArray:
        """First pose of every window; where something is thought to have moved a new window begins."""
        n_poses = len(problem.stamp_s)
        n_seen = len(np.unique(self._landmark[problem.landmark_row]))
        windows = max(min(n_poses // POSES_A_WINDOW, MOST_WINDOWS, MOST_ITEMS // max(n_seen, 1)), 1)
        bounds = np.linspace(0, n_poses, windows + 1).astype(np.int64)
        since = [group.since_s for group in self._groups if group.since_s is not None]
        return np.unique(np.append(bounds, np.searchsorted(problem.stamp_s, since)))

    def _current(self) -> IntArray:
        """(L,) the last place of every landmark."""
        current = np.zeros(self._count, dtype=np.int64)
        current[self._landmark] = np.arange(len(self._landmark))  # later places overwrite earlier ones
        return current

    def _timed(self, group: Group, base: Problem, estimate: Estimate, noise: Noise, bounds: IntArray) -> Group:
        """The group with the time of its change, where that was within the session.

        At first only the window is known; once the group has places of its own, every detection tells.
        """
        if group.window == 0:
            return group
        known = [g for g in self._groups if g.since_s is not None and np.array_equal(g.members, group.members)]
        if not known:
            stamps = base.stamp_s[[bounds[group.window - 1], bounds[group.window]]]
            return replace(group, since_s=float(stamps[1]), between_s=(float(stamps[0]), float(stamps[1])))
        old = estimate.landmark[: self._count]
        since_s, between_s = parting_time(base, estimate, noise, group.members, old[group.members], group.moved(old))
        return replace(group, since_s=since_s, between_s=between_s)

    def _changes(self, base: Problem) -> tuple[MapChange, ...]:
        assert self.verdict is not None
        first_s = float(base.stamp_s[0])
        moved = tuple(_change(group, self.verdict.probability, first_s) for group in self._groups)
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


def _change(group: Group, probability: float, first_s: float) -> MapChange:
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


def _same(groups: tuple[Group, ...], others: tuple[Group, ...]) -> bool:
    return len(groups) == len(others) and all(a.same_as(b) for a, b in zip(groups, others, strict=True))


def _one_place(estimate: Estimate, count: int) -> Estimate:
    """One place a landmark: the first."""
    return Estimate(estimate.pose, estimate.landmark[:count], estimate.states)


def _first_seen(evidence: Evidence, fallback: FloatArray) -> FloatArray:
    """(L, 2) every landmark's first copy."""
    position = fallback.copy()
    landmark, first = np.unique(evidence.landmark, return_index=True)
    position[landmark] = evidence.position[first]
    return position


def _with_copies(estimate: Estimate, evidence: Evidence, groups: tuple[Group, ...]) -> Estimate:
    """Where members of groups that moved within the session were seen first."""
    landmark = estimate.landmark.copy()
    first = _first_seen(evidence, landmark)
    for group in groups:
        if group.window > 0:
            landmark[group.members] = first[group.members]
    return Estimate(estimate.pose, landmark, estimate.states)
