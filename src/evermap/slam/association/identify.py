"""Association of a whole recording by geometry: the step of `--unknown-ids` before the estimator.

The landmark of a detection may depend on detections minutes later; the estimator then runs as on any recording.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from scipy import sparse

from evermap.config import SlamConfig
from evermap.slam.association.assignment import NOBODY, Assignment, LooseDetections
from evermap.slam.association.associator import Associator, density_of_unmet
from evermap.slam.association.constellation import LocalMap
from evermap.slam.association.features import MOST_LEARNED, Traits, learned
from evermap.slam.association.particles import drawn
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.intake import prepare
from evermap.slam.kernels import N_STATES
from evermap.slam.problem import Estimate, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.slam.streaming import USUAL, StreamingSlam
from evermap.types import UNKNOWN, FloatArray, IntArray, Recording

ALL_TRIED = 100
"""Number of landmarks of a prior map up to which every pair is tried; above, an index of constellations is used."""
RUNS, MOST_ROUNDS, MOST_IN_VAIN = 4, 6, 2
"""Draws per round, maximum number of rounds, and of rounds in a row without gain: bound the work."""
SETTLED = 120
"""Maximum number of landmarks of all draws that are solved per round, or one draw: as long as the draws take."""
LITTLE = 200.0
"""Gain per detection below which the search ends, as a fraction 1/`LITTLE` of the cost of an outlier: a tolerance."""


@dataclass(frozen=True)
class Associated:
    """A recording whose detections were associated by geometry.

    Attributes:
        landmark_row: (M,) landmark of every detection of the recording, by first detection; `NOBODY` if it is of no
            landmark with enough sightings.
        name: (M,) given identity of every detection, `UNKNOWN` if there is none or it was ignored.
        used: rows of the recording's detections that are used.
        assignment: of these.
        noise: of its solution.
        prior: of the calibration states.
    """

    landmark_row: IntArray
    name: IntArray
    used: IntArray
    assignment: Assignment
    noise: Noise
    prior: CalibrationPrior

    @property
    def names(self) -> IntArray:
        """(L,) name of each landmark, `UNKNOWN` for none; no two have the same."""
        return self.assignment.name

    @property
    def of_kind(self) -> IntArray:
        """(L, 2) class and name of each landmark, `UNKNOWN` for none."""
        return self.assignment.of_kind

    @property
    def sightings(self) -> IntArray:
        """(L,) number of detections of each landmark."""
        return self.assignment.sightings

    @property
    def together(self) -> sparse.csr_array:
        """(L, L) number of frames that show both of two landmarks."""
        return self.assignment.together

    @property
    def density_of_unmet(self) -> float:
        """Density of unmapped landmarks [1/m^2] in the area of the session."""
        return density_of_unmet(self.in_metres.place, self.assignment.settings)

    @functools.cached_property
    def in_metres(self) -> LocalMap:
        """Return the landmarks in the frame of the first pose, with the scale divided by the priors and its uncertainty
        in the covariance.
        """
        assignment, prior = self.assignment, self.prior
        marginals = Smoother(assignment.problem(), self.noise, heavy=True).marginals(assignment.estimate)
        _, _, scale, log_sigma = prior.split_scale(assignment.estimate.states, marginals.states)
        place = assignment.estimate.landmark * scale
        covariance: FloatArray = assignment.with_shared_errors(marginals.shared)[:-N_STATES, :-N_STATES] * scale**2
        return LocalMap(place, covariance + log_sigma**2 * np.outer(place.ravel(), place.ravel()))

    @property
    def loose(self) -> LooseDetections:
        """Detections of no landmark, without a name."""
        assignment = self.assignment
        some = np.flatnonzero((assignment.landmark_row == NOBODY) & (self.name[self.used] == UNKNOWN))
        scale = self.prior.split_scale(assignment.estimate.states, np.eye(N_STATES))[2]
        at = assignment.points()[some] * scale
        return LooseDetections(self.used[some], at, assignment.wide_m[some], assignment.kind[some, 0])


def associated(
    recording: Recording,
    prior: CalibrationPrior,
    noise: Noise,
    *,
    keep_ids: bool = False,
    settings: SlamConfig = USUAL,
) -> Associated:
    """Associate the detections of a recording by geometry.

    Args:
        recording: as read.
        prior: of the calibration states.
        noise: initial noise levels.
        keep_ids: detections with an id keep it, those without may be of the same landmarks; else ids are ignored.
        settings: of the estimator.

    Raises:
        DataError: too few frames with detections, or too many for the memory.
    """
    given = recording.detections
    nameless = replace(recording, detections=replace(given, landmark_id=np.zeros_like(given.landmark_id)))
    prepared = prepare(nameless, settings=settings.odometry)
    # a few centimetres of the mount confuse nothing; a doubt about them would widen the gates
    problem = replace(prepared.problem, prior=prior.mounted_as_stated().without_scale())
    name = given.landmark_id if keep_ids else np.full_like(given.landmark_id, UNKNOWN)
    kind = np.column_stack([given.class_id, name])[prepared.used]

    def finished(associator: Associator) -> Assignment:
        for _ in problem.stamp_s:
            associator.step()
        if (name != UNKNOWN).any():
            associator.heed_names(lambda: _by_names(problem, name[prepared.used], noise, prior, settings))
        return associator.finish()

    def found(traits: Traits | None) -> tuple[Associator, Assignment]:
        first = Associator(problem, noise, kind, traits=traits, settings=settings)
        assignment = finished(first)
        if first.doubtful > settings.association.doubtful_share:
            again = lambda odometry: finished(  # noqa: E731
                Associator(problem, noise, kind, odometry, traits, settings)
            )
            assignment = searched(first, assignment, again)
        return first, assignment

    cautious, assignment = found(None)
    if given.features is not None:
        assignment, cautious = _with_traits(assignment, cautious, given.features[prepared.used], found)
    row = np.full(len(given), NOBODY, dtype=np.int64)
    row[prepared.used] = assignment.landmark_row
    return Associated(row, name, prepared.used, assignment, cautious.noise, prior)


def _with_traits(
    plain: Assignment,
    associator: Associator,
    features: FloatArray,
    found: Callable[[Traits], tuple[Associator, Assignment]],
) -> tuple[Assignment, Associator]:
    """Return the assignment that explains all detections and their traits best, and its associator.

    The variances of the traits are learned from the assignment without them, which may be wrong: first from readings
    within visits, then from revisits. Each result is a proposal; the one with most evidence, by its own variances, is
    kept.

    Args:
        plain: the assignment without traits.
        associator: of this assignment.
        features: (M, D) of the detections.
        found: returns another associator and its assignment, with given traits.
    """

    def explained(assignment: Assignment) -> tuple[float, Assignment]:
        own = replace(assignment, traits=learned(features, *assignment.of_visits(), settings=plain.settings))
        return associator.against(own), own

    traits = learned(features, *plain.of_visits(), revisits=False, settings=plain.settings)
    if traits is None:
        return plain, associator
    cost, best = explained(plain)
    for _ in range(MOST_LEARNED):
        known = replace(best, traits=traits)
        if traits.evidence(*known.of_visits()) > 0.0:
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
    """Return the best assignment of repeated rounds of particles, each started from the best assignment so far.

    Of `RUNS` draws per round those with most evidence are solved (one of many landmarks, all of few), and the best is
    kept if it is better than before. If none is, the detections are associated frame by frame once more, with the
    odometry noise from the first pass. The search ends when it gains little, or repeatedly nothing.

    Args:
        associator: with all frames processed.
        assignment: its result.
        again: returns the result of another associator under (5,) noise levels of the odometry.
    """
    outlier_nats, factors = assignment.settings.outlier_log_odds, assignment.settings.association.particles.wider
    cost, little = (
        associator.against(assignment),
        outlier_nats / LITTLE * len(assignment.landmark_row) / associator.worth,
    )
    odometry = at_first = associator.learned_odometry(assignment)
    in_vain, asked = 0, False
    for k, seeds in enumerate(np.arange(MOST_ROUNDS * RUNS).reshape(-1, RUNS).tolist()):
        draw = functools.partial(drawn, assignment, odometry, wider=factors[k % len(factors)])
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


def _by_names(
    problem: Problem, name: IntArray, noise: Noise, prior: CalibrationPrior, settings: SlamConfig
) -> FloatArray:
    """(N, 3) poses estimated from the detections with a name (M,) alone."""
    named = name != UNKNOWN
    names, row = np.unique(name[named], return_inverse=True)
    landmark = np.full(len(name), NOBODY)
    landmark[named] = row
    start = Estimate(np.zeros((len(problem.stamp_s), 3)), np.zeros((len(names), 2)), prior.mean)
    some = Assignment(problem, landmark, start, name[:, None]).problem()
    slam = StreamingSlam(some, noise, prior.without_scale(), settings=settings)
    for _ in some.stamp_s:
        slam.step()
    return slam.finish().estimate.pose


def numbered(landmark_id: IntArray, taken: IntArray) -> IntArray:
    """Return ids (L,) in which missing ones are numbers from 1 that are not taken (K,)."""
    new, there = landmark_id == UNKNOWN, np.unique(taken)
    free = np.setdiff1d(np.arange(1, len(landmark_id) + len(there) + 1), there)
    after = landmark_id.copy()
    after[new] = free[: int(new.sum())]
    return after
