"""Which detections a mode can explain, and new modes for those that none explains (Nielsen 2024 section 7.1).

A detection gates with a mode when its squared Mahalanobis distance, with the covariance of pose and mode together and
the sensor's noise, is below the chi-square quantile of two degrees of freedom.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from evermap.slam.batch import sight_at
from evermap.slam.kernels import N_SENSOR, N_STATES, detection_residual, kernel
from evermap.slam.planar_filter import WIDTH
from evermap.slam.problem import Estimate, Marginals, Noise, Problem, between_rows
from evermap.types import BoolArray, FloatArray, IntArray
from evermap_studies.nielsen2024.modes.places import FREE, Modes, at_places, grown, moved_to

MOST_MODES = 4
"""Of a landmark; the paper needs no more than three, and the cost of a solution grows with the square of all."""
MOST_SURPRISE = 7.0
"""Nats that a single detection can say against all modes: it may be an outlier."""
MOST_GROUPS = 16
"""Groups of detections that are looked at before the largest are chosen."""


def gate_threshold(gate_probability: float) -> float:
    """Squared Mahalanobis distance that range and bearing of a true detection stay below with this probability."""
    return math.inf if gate_probability >= 1.0 else -2.0 * math.log1p(-gate_probability)


def distances(
    problem: Problem, estimate: Estimate, marginals: Marginals, noise: Noise, detections: IntArray, places: IntArray
) -> FloatArray:
    """(k,) squared Mahalanobis distance of detections (k,), were they of these places (k,), with `S = H P H' + R`.

    For a detection that the estimate already used, `S` is larger than its residual's covariance: the gate is wider.
    """
    found: FloatArray = _distances(
        estimate.pose,
        estimate.landmark,
        estimate.states,
        problem.pose_row[detections],
        places,
        problem.reading[detections],
        noise.of_detections(problem.sigma_given[detections]),
        problem.mount,
        problem.prior.free,
        marginals.pose,
        marginals.pose_shared,
        marginals.shared,
    )
    return found


def distances_to_modes(
    problem: Problem, estimate: Estimate, marginals: Marginals, noise: Noise, modes: Modes
) -> FloatArray:
    """(M, K) squared distance of every detection to each of its landmark's modes (`Modes.table`); inf for no mode."""
    places = modes.table(estimate)[modes.landmark[problem.landmark_row]]
    detections, columns = np.nonzero(places != FREE)
    squared = np.full(places.shape, np.inf)
    squared[detections, columns] = distances(
        problem, estimate, marginals, noise, detections, places[detections, columns]
    )
    return squared


def surprised(before: float, squared_distance: float, threshold: float) -> float:
    """Nats by which the detections of a landmark up to this one speak against all its modes (Page 1954).

    The sum of what each says, never below zero: what lies within the gate counts against a move.
    """
    return max(0.0, before + 0.5 * min(squared_distance - threshold, 2.0 * MOST_SURPRISE))


def with_map_restored(
    problem: Problem, estimate: Estimate, marginals: Marginals, modes: Modes, switch_cost: float
) -> tuple[Problem, Estimate, Modes]:
    """The prior map's modes back where the map has them, where detections have dragged them away.

    Least squares settles between the map and detections that contradict it. Where it settled farther from the map than
    chance explains, that place becomes a mode of its own with all the detections, and the map's own mode is what the
    map says. (A gate at arrival prevents it; it cannot while the robot has not found its place in the map.)

    With the prior's covariance `P` and what is left of it, `C`, the way from the prior mean to the optimum has
    covariance `P - C`; its squared distance is that of the map from what the detections alone say.
    """
    dragged = []
    seen = np.bincount(problem.landmark_row, minlength=len(problem.landmark_mean)) > 0
    for row in np.flatnonzero(problem.mapped & estimate.known & seen):
        own = between_rows(problem.landmark_information, np.arange(2 * row, 2 * row + 2)).toarray()
        scatter = np.linalg.inv(own) - marginals.landmark[row]
        away = estimate.landmark[row] - problem.landmark_mean[row]
        if away @ np.linalg.solve(scatter, away) > 2.0 * switch_cost:
            dragged.append(row)
    if not dragged:
        return problem, estimate, modes
    place = modes.rows_for(len(dragged))
    problem, estimate = grown(problem, estimate, int(place.max()) + 1)
    estimate = at_places(estimate, place, estimate.landmark[dragged])
    estimate = at_places(estimate, np.array(dragged), problem.landmark_mean[dragged])
    return (
        moved_to(problem, np.array(dragged), place),
        estimate,
        modes.with_owner(place, modes.landmark[dragged]),
    )


def with_births(
    problem: Problem,
    estimate: Estimate,
    marginals: Marginals,
    noise: Noise,
    modes: Modes,
    threshold: float,
    *,
    surprise: float = 0.0,
) -> tuple[Problem, Estimate, Modes, BoolArray]:
    """New modes for detections that gate with none of their landmark's, in order of time.

    The first of them starts a mode, and those that gate with it need no other; it begins in their midst. All detections
    stay where they are, for a selector to decide. A landmark has at most `MOST_MODES`: those count that most detections
    speak for.

    Args:
        problem: the measurements.
        estimate: poses and positions.
        marginals: of it.
        noise: of the sensor.
        modes: whose mode each place is.
        threshold: of the squared distance, from `gate_threshold`.
        surprise: nats of Page's sum (`surprised`) that it takes; at 0 every single detection starts a mode.

    Returns:
        Problem, estimate and modes, with the new ones; and (M,) which detections were looked at for them.
    """
    nearest = distances_to_modes(problem, estimate, marginals, noise, modes).min(axis=1)
    lost = np.zeros(len(nearest), dtype=np.bool_)
    owner = modes.landmark[problem.landmark_row]
    room = MOST_MODES - (modes.table(estimate) != FREE).sum(axis=1)
    at: list[FloatArray] = []
    whose: list[int] = []
    for landmark in np.unique(owner[nearest >= threshold]):
        mine = np.flatnonzero(owner == landmark)
        mine = mine[_in_excursion(nearest[mine], threshold, surprise) & (nearest[mine] >= threshold)]
        lost[mine] = True
        groups = _groups(problem, estimate, marginals, noise, mine, threshold)
        for group in sorted(groups, key=len, reverse=True)[: max(0, room[landmark])]:
            pose, reading = estimate.pose[problem.pose_row[group]], problem.reading[group]
            at.append(np.median(sight_at(pose, reading, estimate.states, problem.mount), axis=0))
            whose.append(int(landmark))
    if not at:
        return problem, estimate, modes, lost
    place = modes.rows_for(len(at))
    problem, estimate = grown(problem, estimate, int(place.max()) + 1)
    return problem, at_places(estimate, place, np.array(at)), modes.with_owner(place, np.array(whose)), lost


def _in_excursion(squared: FloatArray, threshold: float, surprise: float) -> BoolArray:
    """(n,) detections of one landmark during which Page's sum, once above zero, comes to exceed `surprise`."""
    level = np.zeros(len(squared))
    before = 0.0
    for k, value in enumerate(squared.tolist()):
        level[k] = before = surprised(before, value, threshold)
    excursion = np.cumsum(level == 0.0)
    highest = np.zeros(int(excursion[-1]) + 1)
    np.maximum.at(highest, excursion, level)
    above: BoolArray = (level > 0.0) & (highest[excursion] > surprise)
    return above


def _groups(
    problem: Problem, estimate: Estimate, marginals: Marginals, noise: Noise, lost: IntArray, threshold: float
) -> list[IntArray]:
    """Lost detections of one landmark, each with the first before it whose mode it gates with."""
    groups: list[IntArray] = []
    while len(lost) and len(groups) < MOST_GROUPS:
        at, by_pose, of_sensor = _at_sighting(problem, estimate, noise, int(lost[0]))
        cov = by_pose @ marginals.pose[problem.pose_row[lost[0]]] @ by_pose.T + of_sensor
        cov_pose = marginals.pose[problem.pose_row[lost]]
        squared = [_distance_to(problem, estimate, noise, m, cov_pose[k], at, cov) for k, m in enumerate(lost.tolist())]
        near = np.array(squared) < threshold
        near[0] = True
        groups.append(lost[near])
        lost = lost[~near]
    return groups


def _at_sighting(
    problem: Problem, estimate: Estimate, noise: Noise, m: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where a detection points to, the derivative (2, 3) of that by its pose, and the covariance that is the sensor's.

    By the implicit function: the residual stays zero when pose, landmark and reading move together.
    """
    pose = estimate.pose[problem.pose_row[m]]
    at = sight_at(pose, problem.reading[m], estimate.states, problem.mount)
    _, by_pose, by_place = _residual(problem, estimate, m, at)
    back = np.linalg.inv(by_place)
    sigma = noise.of_detections(problem.sigma_given[m])
    return at, -back @ by_pose, back @ np.diag(sigma**2) @ back.T


def _distance_to(
    problem: Problem, estimate: Estimate, noise: Noise, m: int, cov_pose: FloatArray, at: FloatArray, cov: FloatArray
) -> float:
    """Squared distance of a detection to a mode that was just born, as independent of the pose."""
    e, by_pose, by_place = _residual(problem, estimate, m, at)
    sigma = noise.of_detections(problem.sigma_given[m])
    s = by_pose @ cov_pose @ by_pose.T + by_place @ cov @ by_place.T + np.diag(sigma**2)
    return float(e @ np.linalg.solve(s, e))


def _residual(
    problem: Problem, estimate: Estimate, m: int, at: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    pose = estimate.pose[problem.pose_row[m]]
    range_m, bearing_rad = problem.reading[m]
    detection_residual(pose, at, estimate.states, problem.mount, range_m, bearing_rad, e, jx, jl, jc)
    return e, jx, jl


@kernel
def _distances(
    pose: FloatArray,
    landmark: FloatArray,
    states: FloatArray,
    pose_row: Any,
    place: Any,
    reading: FloatArray,
    sigma: FloatArray,
    mount: FloatArray,
    free: Any,
    cov_pose: FloatArray,
    cov_cross: FloatArray,
    cov_shared: FloatArray,
) -> FloatArray:
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    j, cov = np.zeros((2, WIDTH)), np.zeros((WIDTH, WIDTH))
    out = np.zeros(len(place))
    for m in range(len(place)):
        i = pose_row[m]
        detection_residual(pose[i], landmark[place[m]], states, mount, reading[m, 0], reading[m, 1], e, jx, jl, jc)
        for k in range(N_SENSOR):
            if not free[k]:
                jc[:, k] = 0.0
        j[:, :3], j[:, 3:5], j[:, 5:] = jx, jl, jc
        _joint_covariance(i, place[m], cov_pose, cov_cross, cov_shared, cov)
        s = j @ cov @ j.T
        s00, s01, s11 = s[0, 0] + sigma[m, 0] ** 2, s[0, 1], s[1, 1] + sigma[m, 1] ** 2
        out[m] = (s11 * e[0] ** 2 - 2.0 * s01 * e[0] * e[1] + s00 * e[1] ** 2) / (s00 * s11 - s01 * s01)
    return out


@kernel
def _joint_covariance(
    pose: int, place: int, cov_pose: FloatArray, cov_cross: FloatArray, cov_shared: FloatArray, out: FloatArray
) -> None:
    """Compute the covariance (12, 12) of one pose, one place and the seven sensor states, from `Marginals`."""
    at_states = len(cov_shared) - N_STATES
    out[:3, :3] = cov_pose[pose]
    for a in range(2 + N_SENSOR):
        row = 2 * place + a if a < 2 else at_states + a - 2
        for b in range(3):
            out[3 + a, b] = out[b, 3 + a] = cov_cross[pose, b, row]
        for b in range(2 + N_SENSOR):
            out[3 + a, 3 + b] = cov_shared[row, 2 * place + b if b < 2 else at_states + b - 2]
