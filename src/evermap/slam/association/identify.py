"""A recording whose detections get their landmarks from geometry: what `--unknown-ids` does before the estimator runs.

A detection's landmark may be decided by what is seen minutes later; the estimator then runs as on any recording.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from evermap.slam.association.assignment import NOBODY, Assignment
from evermap.slam.association.associator import P_MERGE, Associator, density_of_unmet
from evermap.slam.association.constellation import LocalMap, agreed_pairs
from evermap.slam.association.place_index import PlaceIndex
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.intake import prepare
from evermap.slam.problem import Noise
from evermap.slam.smoother import Smoother
from evermap.types import UNKNOWN, FloatArray, IntArray, Landmarks, Recording

ALL_TRIED = 100
"""Landmarks of a prior map up to which every pair of them is tried; beyond, an index over constellations is asked."""
MAP_FLOOR_M = 1e-3
"""A prior map without uncertainty is taken to be known to a millimetre."""


@dataclass(frozen=True)
class Associated:
    """A recording whose detections got their landmarks from geometry.

    Attributes:
        landmark_row: (M,) landmark of every detection of the recording, in the order in which they were met; `NOBODY`
            where it belongs to none that was seen often enough.
        assignment: of the detections that were used.
        noise: that it was solved with.
        prior: of the calibration states.
    """

    landmark_row: IntArray
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
        """Return the recording with ids (L,) of its landmarks; `UNKNOWN` for detections of none."""
        given = np.append(landmark_id, UNKNOWN)[self.landmark_row]
        return replace(recording, detections=replace(recording.detections, landmark_id=given))


def associated(recording: Recording, prior: CalibrationPrior, noise: Noise) -> Associated:
    """Associate the detections of a recording by geometry; its own ids are not looked at.

    Args:
        recording: what a reader returned.
        prior: of the calibration states.
        noise: where noise levels start.

    Raises:
        DataError: too few frames with detections, or too many for the memory.
    """
    anonymous = replace(recording.detections, landmark_id=np.zeros_like(recording.detections.landmark_id))
    prepared = prepare(replace(recording, detections=anonymous))
    problem = replace(prepared.problem, prior=prior.without_scale())
    associator = Associator(problem, noise, recording.detections.class_id[prepared.used])
    for _ in problem.stamp_s:
        associator.step()
    assignment = associator.finish()
    row = np.full(len(recording.detections), NOBODY, dtype=np.int64)
    row[prepared.used] = assignment.landmark_row
    return Associated(row, assignment, associator.noise, prior)


def identified(
    recording: Recording, prior: CalibrationPrior, noise: Noise, *, prior_map: Landmarks | None = None
) -> Recording:
    """Return the recording with landmark ids by geometry; its own are not looked at.

    Args:
        recording: what a reader returned.
        prior: of the calibration states.
        noise: where noise levels start.
        prior_map: landmarks that keep their ids where they are met again, from whatever place the robot starts in.

    Returns:
        The same detections. Landmarks that are not in the prior map are numbered from 1, in the order in which they
        were met, leaving out the map's ids; `UNKNOWN` where a detection belongs to none that was seen often enough.

    Raises:
        DataError: too few frames with detections, or too many for the memory.
    """
    found = associated(recording, prior, noise)
    return found.named(recording, _ids(found, prior_map))


def _ids(found: Associated, prior_map: Landmarks | None) -> IntArray:
    """(L,) the prior map's ids where its landmarks were met, numbers that are free for the others."""
    known, count = np.zeros(0, dtype=np.int64), found.assignment.n_landmarks
    met = np.full(count, UNKNOWN, dtype=np.int64)
    if prior_map is not None:
        known = prior_map.landmark_id
        for mine, theirs in _found_in(prior_map, found):
            met[mine] = known[theirs]
    free = np.setdiff1d(np.arange(1, count + len(known) + 1), known)
    new = met == UNKNOWN
    met[new] = free[: int(new.sum())]
    return met


def _found_in(prior_map: Landmarks, found: Associated) -> list[tuple[int, int]]:
    """Landmarks of the session with rows of the prior map, by the shape of both maps alone."""
    trusted = np.argsort(-found.assignment.sightings, kind="stable")
    source = found.in_metres.part(trusted)
    known, density = prior_map.covariance_m2 + MAP_FLOOR_M**2 * np.eye(2), density_of_unmet(source.place)
    if len(prior_map) > ALL_TRIED:
        pairs = PlaceIndex(prior_map.position_m, known).pairs(source, density=density, probability=P_MERGE)
    else:
        target = LocalMap(prior_map.position_m, block_diag(*known))
        allowed = np.ones((len(trusted), len(prior_map)), dtype=bool)
        pairs = agreed_pairs(source, target, allowed, density=density, probability=P_MERGE)
    return [(int(trusted[k]), m) for k, m in pairs]
