"""Association of a whole recording by geometry: the step of `--unknown-ids` before the estimator.

The landmark of a detection may depend on detections minutes later; the estimator then runs as on any recording.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import TypeAlias

import numpy as np
from scipy import sparse

from evermap.config import SlamConfig
from evermap.slam.association.assignment import NOBODY, Assignment, LooseDetections, density_of_unmet, names_of
from evermap.slam.association.associator import with_traits
from evermap.slam.association.constellation import LocalMap
from evermap.slam.association.features import Traits
from evermap.slam.association.in_plane import PlanarAssociator, without_ghosts
from evermap.slam.association.particles import drawn
from evermap.slam.batch import USUAL, Batch
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.intake import prepare
from evermap.slam.kernels import N_STATES
from evermap.slam.method import Static
from evermap.slam.problem import Estimate, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.slam.streaming import StreamingSlam
from evermap.types import UNKNOWN, AssociationEvidence, FloatArray, IntArray, Recording, traits_of

_Found: TypeAlias = tuple[PlanarAssociator, Assignment]

ALL_TRIED = 100
"""Number of landmarks of a prior map up to which every pair is tried; above, an index of constellations is used."""
RUNS, MOST_ROUNDS, MOST_IN_VAIN = 4, 6, 2
"""Draws per round, maximum number of rounds, and of rounds in a row without gain: bound the work."""
SETTLED = 120
"""Maximum number of landmarks of all draws that are solved per round, or one draw: as long as the draws take."""
MOST_LED = 120
"""Number of landmarks up to which the search begins from odometry alone, too; above, where loops bend it: bounds the
work, which grows with all visits."""
LITTLE = 200.0
"""Gain per detection below which the search ends, as a fraction 1/`LITTLE` of the cost of an outlier: a tolerance."""


@dataclass(frozen=True)
class Associated:
    """A recording, in the plane or in space, whose detections were associated by geometry.

    Attributes:
        landmark_row: (M,) landmark of every detection of the recording, by first detection; `NOBODY` if it is of no
            landmark with enough sightings.
        name: (M,) given identity of every detection, `UNKNOWN` if there is none or it was ignored.
        of_kind: (L, 2) class and name of each landmark, `UNKNOWN` for none.
        together: (L, L) number of frames, in space of views, that show both of two landmarks.
        loose: detections of no landmark, without a name.
        settings: of the estimator.
        locate: returns `in_metres`.
        evidence: what speaks for it.
    """

    landmark_row: IntArray
    name: IntArray
    of_kind: IntArray
    together: sparse.csr_array
    loose: LooseDetections
    settings: SlamConfig
    locate: Callable[[], LocalMap]
    evidence: AssociationEvidence

    @property
    def names(self) -> IntArray:
        """(L,) name of each landmark, `UNKNOWN` for none; no two have the same."""
        return names_of(self.name, self.landmark_row, len(self.of_kind))

    @property
    def sightings(self) -> IntArray:
        """(L,) number of detections of each landmark."""
        return np.bincount(self.landmark_row[self.landmark_row >= 0], minlength=len(self.of_kind))

    @functools.cached_property
    def in_metres(self) -> LocalMap:
        """The landmarks in the frame of the first pose."""
        return self.locate()

    @property
    def density_of_unmet(self) -> float:
        """Density of unmapped landmarks in the area [1/m^2], in space in the volume [1/m^3], of the session."""
        return density_of_unmet(self.in_metres.place, self.settings)


def associated(
    recording: Recording, prior: CalibrationPrior, noise: Noise, *, keep_ids: bool = False, settings: SlamConfig = USUAL
) -> Associated:
    """Associate a recording in the plane; as `associate`, by priors of calibration states and initial noise levels."""
    given = recording.detections
    nameless = replace(recording, detections=replace(given, landmark_id=np.zeros_like(given.landmark_id)))
    prepared = prepare(nameless, settings=settings.odometry)
    # a few centimetres of the mount confuse nothing; a doubt about them would widen the gates
    problem = replace(prepared.problem, prior=prior.mount_as_stated().without_scale())
    name = given.landmark_id if keep_ids else np.full_like(given.landmark_id, UNKNOWN)
    kind = np.column_stack([given.class_id, name])[prepared.used]

    def finished(associator: PlanarAssociator) -> Assignment:
        for _ in problem.stamp_s:
            associator.step()
        if (name != UNKNOWN).any():
            associator.heed_names(lambda: _by_names(problem, name[prepared.used], noise, prior, settings))
        return associator.finish()

    def found(traits: Traits | None) -> _Found:
        first = PlanarAssociator(problem, noise, kind, traits=traits, settings=settings)
        assignment = finished(first)
        rules, is_bent = settings.association, _is_bent(first, assignment)
        if is_bent or assignment.n_landmarks <= MOST_LED:
            assignment = _best_of(first, assignment, first.lead_by_odometry())
            is_bent = is_bent and _is_bent(first, assignment)
        if is_bent or first.doubtful > rules.doubtful_share:
            again = functools.partial(PlanarAssociator, problem, noise, kind, traits=traits, settings=settings)
            assignment = search_assignment(first, assignment, lambda odometry: finished(again(odometry=odometry)))
        return first, assignment

    best = found(None)
    features, _ = traits_of(given)
    if features is not None:
        best = with_traits(best, features[prepared.used], settings, found)
    associator, assignment = best
    assignment, evidence = weigh_against_odometry(associator, assignment)
    row = np.full(len(given), NOBODY, dtype=np.int64)
    row[prepared.used] = assignment.landmark_row
    scale = prior.split_scale(assignment.estimate.states, np.eye(N_STATES))[2]
    some = np.flatnonzero((assignment.landmark_row == NOBODY) & (kind[:, 1] == UNKNOWN))
    at, wide = assignment.points()[some] * scale, assignment.wide_m[some]
    loose = LooseDetections(prepared.used[some], at, wide, kind[some, 0])
    locate = functools.partial(_in_metres, assignment, associator.noise, prior)
    return Associated(row, name, assignment.of_kind, assignment.together, loose, settings, locate, evidence)


def _is_bent(associator: PlanarAssociator, assignment: Assignment) -> bool:
    """Whether the loops that an association closes bend the odometry more than right ones would."""
    return associator.closures(assignment).p_by_chance < assignment.settings.association.p_closed


def _best_of(associator: PlanarAssociator, assignment: Assignment, start: Assignment) -> Assignment:
    """The better one of an association and what another start leads to."""
    cost = associator.against(assignment)
    trial = associator.finish(start, goal=cost)
    return trial if associator.against(trial) < cost else assignment


def weigh_against_odometry(
    associator: PlanarAssociator, assignment: Assignment
) -> tuple[Assignment, AssociationEvidence]:
    """Return an association, or that by odometry alone if it explains the detections better; and what speaks for it."""
    alone = without_ghosts(associator.lead_by_odometry())
    lead_nats = associator.against(alone) - associator.against(assignment) if alone.n_landmarks else math.nan
    closures = associator.closures(assignment)
    if lead_nats < -assignment.settings.association.landmark_nats:  # without loops both are the same but for rounding
        assignment = alone
    dropped = float(np.mean(assignment.landmark_row == NOBODY))
    facts = dropped, assignment.n_landmarks, alone.n_landmarks, closures.visits, closures.nats, lead_nats
    return assignment, AssociationEvidence(*facts)


def _in_metres(assignment: Assignment, noise: Noise, prior: CalibrationPrior) -> LocalMap:
    """The landmarks with the scale divided by the priors, and its uncertainty in the covariance."""
    marginals = Smoother(assignment.problem(), noise, heavy=True).marginals(assignment.estimate)
    _, _, scale, log_sigma = prior.split_scale(assignment.estimate.states, marginals.states)
    place = assignment.estimate.landmark * scale
    covariance: FloatArray = assignment.with_shared_errors(marginals.shared) * scale**2
    return LocalMap(place, covariance + log_sigma**2 * np.outer(place.ravel(), place.ravel()))


def search_assignment(
    associator: PlanarAssociator, assignment: Assignment, again: Callable[[FloatArray], Assignment]
) -> Assignment:
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
    odometry = at_first = associator.learn_odometry(assignment)
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
            odometry = associator.learn_odometry(trial)
    return assignment


def _by_names(
    problem: Problem, name: IntArray, noise: Noise, prior: CalibrationPrior, settings: SlamConfig
) -> FloatArray:
    """(N, 3) poses estimated from the detections with a name (M,) alone, as a whole where the odometry leads."""
    named = name != UNKNOWN
    names, row = np.unique(name[named], return_inverse=True)
    landmark = np.full(len(name), NOBODY)
    landmark[named] = row
    start = Estimate(np.zeros((len(problem.stamp_s), 3)), np.zeros((len(names), 2)), prior.mean)
    some = Assignment(problem, landmark, start, name[:, None], Traits.none(len(name))).problem()
    batch = Batch(prior.without_scale(), noise, Static(len(names)), settings)
    if batch.is_driven(some):
        *_, part = batch.parts(some)
        if part.fits:
            return batch.solved(part, None).estimate.pose
    slam = StreamingSlam(some, noise, prior.without_scale(), settings=settings, paced=False)
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
