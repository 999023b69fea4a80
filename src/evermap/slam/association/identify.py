"""A recording whose detections get their landmarks from geometry: what `--unknown-ids` does before the estimator runs.

A detection's landmark may be decided by what is seen minutes later; the estimator then runs as on any recording.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from scipy.linalg import block_diag

from evermap.config import OdometryConfig
from evermap.slam.association.assignment import NOBODY, Assignment, alike
from evermap.slam.association.associator import P_MERGE, Associator, density_of_unmet
from evermap.slam.association.constellation import LocalMap, agreed_pairs
from evermap.slam.association.features import Traits, learned
from evermap.slam.association.particles import WIDER, drawn
from evermap.slam.association.place_index import PlaceIndex
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.intake import prepare
from evermap.slam.problem import USUAL, Estimate, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.slam.streaming import StreamingSlam
from evermap.types import UNKNOWN, FloatArray, IntArray, Landmarks, Recording

ALL_TRIED = 100
"""Landmarks of a prior map up to which every pair of them is tried; beyond, an index over constellations is asked."""
MOST_NAMED = 100
"""Landmarks known by name that a session is laid over a map by."""
FEW_DOUBTFUL = 0.02
"""Share of doubtful detections up to which who is who is not drawn by particles."""
RUNS, MOST_ROUNDS, MOST_IN_VAIN = 4, 6, 2
"""Draws of which some are settled, how often, and how often in a row without gain."""
SETTLED = 120
"""Landmarks of the draws that are settled in a round, at most, or one draw: then that takes no longer than to draw."""
LITTLE_NATS = 0.035
"""A 200th of what a detection of no landmark costs: by which all detections are explained better, for each of them,
before it is worth while to draw again."""
MOST_LEARNED = 3
"""Times that it is learned what landmarks are like, from who is who by what was known of that before."""
MAP_FLOOR_M = 1e-3
"""A prior map without uncertainty is taken to be known to a millimetre."""


@dataclass(frozen=True)
class Associated:
    """A recording whose detections got their landmarks from geometry.

    Attributes:
        landmark_row: (M,) landmark of every detection of the recording, in the order in which they were met; `NOBODY`
            where it belongs to none that was seen often enough.
        name: (M,) identity that every detection came with, `UNKNOWN` where it has none or it was not looked at.
        assignment: of the detections that were used.
        noise: that it was solved with.
        prior: of the calibration states.
    """

    landmark_row: IntArray
    name: IntArray
    assignment: Assignment
    noise: Noise
    prior: CalibrationPrior

    @functools.cached_property
    def in_metres(self) -> LocalMap:
        """Return the landmarks in the frame of the first pose, scale divided, what is unknown of it in the
        covariance.
        """
        assignment, prior = self.assignment, self.prior
        marginals = Smoother(assignment.problem(), self.noise, heavy=True).marginals(assignment.estimate)
        _, _, scale, log_sigma = prior.split_scale(assignment.estimate.states, marginals.states)
        place = assignment.estimate.landmark * scale
        covariance: FloatArray = assignment.with_shared_errors(marginals.shared)[:-9, :-9] * scale**2
        return LocalMap(place, covariance + log_sigma**2 * np.outer(place.ravel(), place.ravel()))

    def named(self, recording: Recording, landmark_id: IntArray) -> Recording:
        """Return the recording with ids (L,) of its landmarks where detections came without; `UNKNOWN` for none's."""
        found = np.append(landmark_id, UNKNOWN)[self.landmark_row]
        given = np.where(self.name == UNKNOWN, found, self.name)
        return replace(recording, detections=replace(recording.detections, landmark_id=given))


def associated(
    recording: Recording,
    prior: CalibrationPrior,
    noise: Noise,
    *,
    keep_ids: bool = False,
    odometry: OdometryConfig = USUAL,
) -> Associated:
    """Associate the detections of a recording by geometry.

    Args:
        recording: what a reader returned.
        prior: of the calibration states.
        noise: where noise levels start.
        keep_ids: detections with an id keep it, those without may be of the same landmarks; else ids are ignored.
        odometry: what is believed of it.

    Raises:
        DataError: too few frames with detections, or too many for the memory.
    """
    given = recording.detections
    prepared = prepare(
        replace(recording, detections=replace(given, landmark_id=np.zeros_like(given.landmark_id))), settings=odometry
    )
    problem = replace(prepared.problem, prior=prior.without_scale())
    name = given.landmark_id if keep_ids else np.full_like(given.landmark_id, UNKNOWN)
    kind = np.column_stack([given.class_id, name])[prepared.used]

    def finished(associator: Associator) -> Assignment:
        for _ in problem.stamp_s:
            associator.step()
        if (name != UNKNOWN).any():
            associator.heed_names(lambda: _by_names(problem, name[prepared.used], noise, prior))
        return associator.finish()

    def found(traits: Traits | None) -> tuple[Associator, Assignment]:
        first = Associator(problem, noise, kind, traits=traits)
        assignment = finished(first)
        if first.doubtful > FEW_DOUBTFUL:
            again = lambda odometry: finished(Associator(problem, noise, kind, odometry, traits))  # noqa: E731
            assignment = searched(first, assignment, again)
        return first, assignment

    cautious, assignment = found(None)
    if given.features is not None:
        assignment, cautious = _told_apart(assignment, cautious, given.features[prepared.used], found)
    row = np.full(len(given), NOBODY, dtype=np.int64)
    row[prepared.used] = assignment.landmark_row
    return Associated(row, name, assignment, cautious.noise, prior)


def _told_apart(
    plain: Assignment,
    associator: Associator,
    features: FloatArray,
    found: Callable[[Traits], tuple[Associator, Assignment]],
) -> tuple[Assignment, Associator]:
    """Return the assignment that explains all detections best by what landmarks are like, too, and what solved it.

    How much that tells is learned from who is who without it, where that may be wrong: first as much as readings within
    visits say, then what revisits do. Each is only a proposal; what explains most is kept, by its own spreads.

    Args:
        plain: who is who without.
        associator: which found it.
        features: (M, D) of the detections.
        found: returns what another one finds with given traits.
    """

    def explained(assignment: Assignment) -> tuple[float, Assignment]:
        own = replace(assignment, traits=learned(features, *assignment.of_visits()))
        return associator.against(own), own

    traits = learned(features, *plain.of_visits(), revisits=False)
    if traits is None:
        return plain, associator
    cost, best = explained(plain)
    for _ in range(MOST_LEARNED):
        known = replace(best, traits=traits)
        if traits.told(*known.of_visits()) > 0.0:
            cautious = associator.having(traits)
            trial = cautious.finish(known)
        else:  # most of it is wrong
            cautious, trial = found(traits)
        against, trial = explained(trial)
        if against >= cost and best.traits is None:
            break
        if against < cost:
            cost, best, associator = against, trial, cautious
        if best.traits is None or best.traits.close_to(traits):
            break
        traits = best.traits
    return replace(best, traits=None), associator


def searched(associator: Associator, assignment: Assignment, again: Callable[[FloatArray], Assignment]) -> Assignment:
    """Return what explains all detections best, by particles that start from the best so far, again and again.

    Of `RUNS` draws those that predicted the detections best are settled, of many landmarks one, of few all; what then
    explains them best is kept if it is better than before. Where it is not, frame by frame is tried once more, with the
    noise of the odometry that the first pass tells. The search ends where it gains little, or several times nothing.

    Args:
        associator: which has seen all frames.
        assignment: what it finished with.
        again: returns what another one finishes with under (5,) noise levels of the odometry.
    """
    cost, little = associator.against(assignment), LITTLE_NATS * len(assignment.landmark_row)
    odometry = at_first = associator.learned_odometry(assignment)
    in_vain, asked = 0, False
    for k, seeds in enumerate(np.arange(MOST_ROUNDS * RUNS).reshape(-1, RUNS).tolist()):
        draw = functools.partial(drawn, assignment, odometry, wider=WIDER[k % len(WIDER)])
        with ThreadPoolExecutor(len(seeds)) as pool:
            draws = [each for each, _ in sorted(pool.map(draw, seeds), key=itemgetter(1), reverse=True)]
        settled = max(1, SETTLED // max(draws[0].n_landmarks, 1))
        trials = [associator.finish(each, goal=cost) for each in draws[:settled]]
        against, trial = min(((associator.against(each), each) for each in trials), key=itemgetter(0))
        if against >= cost and not asked:
            trial, asked = again(at_first), True
            against = associator.against(trial)
        gained = cost - against
        if gained > 0.0:
            assignment, cost = trial, against
        in_vain = 0 if gained > little else in_vain + 1
        if in_vain == MOST_IN_VAIN or 0.0 < gained <= little:
            break
        if gained > 0.0 and k + 1 < MOST_ROUNDS:
            odometry = associator.learned_odometry(trial)
    return assignment


def _by_names(problem: Problem, name: IntArray, noise: Noise, prior: CalibrationPrior) -> FloatArray:
    """(N, 3) poses by the detections with a name (M,) alone."""
    named = name != UNKNOWN
    names, row = np.unique(name[named], return_inverse=True)
    landmark = np.full(len(name), NOBODY)
    landmark[named] = row
    start = Estimate(np.zeros((len(problem.stamp_s), 3)), np.zeros((len(names), 2)), prior.mean)
    some = Assignment(problem, landmark, start, name[:, None]).problem()
    slam = StreamingSlam(some, noise, prior.without_scale())
    for _ in some.stamp_s:
        slam.step()
    return slam.finish().estimate.pose


def identified(
    recording: Recording,
    prior: CalibrationPrior,
    noise: Noise,
    *,
    prior_map: Landmarks | None = None,
    keep_ids: bool = False,
    odometry: OdometryConfig = USUAL,
) -> Recording:
    """Return the recording with landmark ids by geometry.

    Args:
        recording: what a reader returned.
        prior: of the calibration states.
        noise: where noise levels start.
        prior_map: landmarks that keep their ids where they are met again, from whatever place the robot starts in.
        keep_ids: as of `associated`.
        odometry: what is believed of it.

    Returns:
        The same detections. Landmarks without an id that are not in the prior map are numbered from 1, in the order in
        which they were met, leaving out ids that there are; `UNKNOWN` where a detection without an id belongs to none
        that was seen often enough.

    Raises:
        DataError: too few frames with detections, or too many for the memory.
    """
    found = associated(recording, prior, noise, keep_ids=keep_ids, odometry=odometry)
    met, known = found.assignment.name, np.zeros(0, dtype=np.int64)
    if prior_map is not None:
        known = prior_map.landmark_id
        mine, theirs = np.array(_found_in(prior_map, found), dtype=np.int64).reshape(-1, 2).T
        fresh = (met[mine] == UNKNOWN) & ~np.isin(known[theirs], met)
        met[mine[fresh]] = known[theirs[fresh]]
    return found.named(recording, numbered(met, np.append(known, found.name)))


def numbered(landmark_id: IntArray, taken: IntArray) -> IntArray:
    """Return ids (L,) with numbers from 1 that are not taken (K,) where there is none."""
    new, there = landmark_id == UNKNOWN, np.unique(taken)
    free = np.setdiff1d(np.arange(1, len(landmark_id) + len(there) + 1), there)
    after = landmark_id.copy()
    after[new] = free[: int(new.sum())]
    return after


def _found_in(prior_map: Landmarks, found: Associated) -> list[tuple[int, int]]:
    """Landmarks of the session with rows of the prior map, by names where two are in both, and by the shape of both."""
    trusted = np.argsort(-found.assignment.sightings, kind="stable")
    source = found.in_metres.part(trusted)
    known, density = prior_map.covariance_m2 + MAP_FLOOR_M**2 * np.eye(2), density_of_unmet(source.place)
    name = found.assignment.name[trusted]
    named, of = (each[:MOST_NAMED] for each in np.intersect1d(name, prior_map.landmark_id, return_indices=True)[1:])
    sure = agreed_pairs(
        source.part(named), LocalMap(prior_map.position_m[of], block_diag(*known[of])), np.eye(len(of), dtype=bool),
        density=density, probability=P_MERGE,
    ) if len(of) > 1 else []  # fmt: skip
    if sure or len(prior_map) > ALL_TRIED:
        given = [(int(named[k]), int(of[m])) for k, m in sure]
        pairs = PlaceIndex(prior_map.position_m, known).pairs(source, density=density, probability=P_MERGE, given=given)
    else:
        target = LocalMap(prior_map.position_m, block_diag(*known))
        allowed = alike(name[:, None, None], prior_map.landmark_id[None, :, None])
        pairs = agreed_pairs(source, target, allowed, density=density, probability=P_MERGE)
    return [(int(trusted[k]), m) for k, m in pairs]
