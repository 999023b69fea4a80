"""A recording whose detections get their landmarks from geometry: what `--unknown-ids` does before the estimator runs.

A detection's landmark may be decided by what is seen minutes later; the estimator then runs as on any recording.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from evermap.slam.association.assignment import Assignment
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
    anonymous = replace(recording.detections, landmark_id=np.zeros_like(recording.detections.landmark_id))
    prepared = prepare(replace(recording, detections=anonymous))
    problem = replace(prepared.problem, prior=prior.without_scale())
    associator = Associator(problem, noise, recording.detections.class_id[prepared.used])
    for _ in problem.stamp_s:
        associator.step()
    assignment = associator.finish()
    ids = _ids(assignment, associator.noise, prior, prior_map)
    landmark_id = np.full(len(recording.detections), UNKNOWN, dtype=np.int64)
    seen = assignment.landmark_row >= 0
    landmark_id[prepared.used[seen]] = ids[assignment.landmark_row[seen]]
    return replace(recording, detections=replace(recording.detections, landmark_id=landmark_id))


def _ids(assignment: Assignment, noise: Noise, prior: CalibrationPrior, prior_map: Landmarks | None) -> IntArray:
    """(L,) the prior map's ids where its landmarks were met, numbers that are free for the others."""
    known = np.zeros(0, dtype=np.int64) if prior_map is None else prior_map.landmark_id
    free = np.setdiff1d(np.arange(1, assignment.n_landmarks + len(known) + 1), known)
    met = np.full(assignment.n_landmarks, UNKNOWN, dtype=np.int64)
    if prior_map is not None:
        for mine, theirs in _found_in(prior_map, assignment, noise, prior):
            met[mine] = prior_map.landmark_id[theirs]
    new = met == UNKNOWN
    met[new] = free[: int(new.sum())]
    return met


def _found_in(
    prior_map: Landmarks, assignment: Assignment, noise: Noise, prior: CalibrationPrior
) -> list[tuple[int, int]]:
    """Landmarks of the session with rows of the prior map, by the shape of both maps alone."""
    trusted = np.argsort(-assignment.sightings, kind="stable")
    mine = _in_metres(assignment, noise, prior)
    columns = np.column_stack([2 * trusted, 2 * trusted + 1]).ravel()
    source = LocalMap(mine.place[trusted], mine.covariance[np.ix_(columns, columns)])
    known, density = prior_map.covariance_m2 + MAP_FLOOR_M**2 * np.eye(2), density_of_unmet(source.place)
    if len(prior_map) > ALL_TRIED:
        pairs = PlaceIndex(prior_map.position_m, known).pairs(source, density=density, probability=P_MERGE)
    else:
        target = LocalMap(prior_map.position_m, block_diag(*known))
        allowed = np.ones((len(trusted), len(prior_map)), dtype=bool)
        pairs = agreed_pairs(source, target, allowed, density=density, probability=P_MERGE)
    return [(int(trusted[k]), m) for k, m in pairs]


def _in_metres(assignment: Assignment, noise: Noise, prior: CalibrationPrior) -> LocalMap:
    """The session's map with its scale divided, and what is unknown of the scale in its covariance."""
    marginals = Smoother(assignment.problem(), noise, heavy=True).marginals(assignment.estimate)
    _, _, scale, log_sigma = prior.split_scale(assignment.estimate.states, marginals.states)
    place = assignment.estimate.landmark * scale
    covariance: FloatArray = assignment.with_shared_errors(marginals.shared)[:-9, :-9] * scale**2
    return LocalMap(place, covariance + log_sigma**2 * np.outer(place.ravel(), place.ravel()))
