"""The solution of a recording in space, from initial values to the optimum, optionally with a map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.geometry import se3
from evermap.slam.calibration import narrowed
from evermap.slam.space.against_map import MapComparison, compared
from evermap.slam.space.drift import drift_of
from evermap.slam.space.estimate import SpatialOptimum, converged, first_places, oriented
from evermap.slam.space.intake import SpatialIntake
from evermap.slam.space.linearise import CORNERS, POINT
from evermap.slam.space.problem import ANY_RAD, PlacePrior, SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.slam.space.repair import rejoined, repaired, split, unjumped
from evermap.slam.space.smoother import SpatialSmoother
from evermap.slam.space.start import incremental
from evermap.types import BoolArray, FloatArray, IntArray, Landmarks, Progress

FREE = np.repeat([1e3, ANY_RAD], 3)
"""Deviation by which the first pose is held where a map says where it is [m, rad]. Two points of a map leave it a turn
about the line between them; one by a thousand radians would drown what the odometry knows in rounding."""
MOST_TRIED = 200
GROSS_M = 1.0
SPLITS = 2
"""Poses tried for a start, the scale of its loss [m], and times that landmarks are split."""
STRIDE_S, FINE, DELAYS = 0.05, 4.0, 2
"""Delays are tried so far apart at first, at last by no more than the square root of so many deviations; and rounds."""


@dataclass(frozen=True, slots=True)
class SpatialSolved:
    """Solution of a session in space.

    Attributes:
        optimum: values, noise and covariances of the last problem.
        identity: (P,) rows of `SpatialIntake.landmark_id` that the places are of.
        number: (P,) which of the landmarks with that identity each is, from 1.
        from_map: what of the given map stands; None without a map.
        delay_sigma_s: (S,) standard deviation of the delay of each sensor's stamps; nan where they are trusted.
        online_pose: (N, 7) poses as each frame had them.
        online_spread: (N, 2) roughly how far off these may be [m, rad].
        step_s: (N,) seconds that each frame took.
    """

    optimum: SpatialOptimum
    identity: IntArray
    number: IntArray
    from_map: MapComparison | None
    delay_sigma_s: FloatArray
    online_pose: FloatArray
    online_spread: FloatArray
    step_s: FloatArray


def solve_space(intake: SpatialIntake, prior_map: Landmarks | None, progress: Progress | None = None) -> SpatialSolved:
    """Estimate poses, places and noise of a recording in space.

    Args:
        intake: the recording as input of the estimator.
        prior_map: landmarks to localise in; None maps from scratch, in the frame of the first pose.
        progress: told after every frame.

    Raises:
        NumericalError: no finite optimum.
    """
    problem, stated = _with_map(intake, prior_map)
    identity = np.arange(len(intake.landmark_id))
    settings = problem.settings
    goes = (settings.drift_m, settings.drift_rad) if problem.driven else (settings.hand_mps, settings.hand_radps)
    noise = SpatialNoise(*goes, pixel=settings.sigma_px)
    by_corners = (problem.kind == CORNERS) | problem.ray
    # pixels err by themselves, detectors of objects by the view
    if problem.driven and 2 * np.sum(~by_corners) > len(by_corners):
        drift = drift_of(problem, intake.driven_pose)
        problem = replace(problem, share=np.where(by_corners, 1.0, drift.share))
        if problem.steady:
            noise = replace(noise, translation=settings.steady_m, rotation=settings.steady_rad)
        elif drift.translation is not None and drift.rotation is not None:
            noise = replace(noise, translation=drift.translation, rotation=drift.rotation)
    known, place = np.zeros(len(problem.oriented), dtype=np.bool_), se3.identity(len(problem.oriented))
    known[problem.prior.place], place[problem.prior.place] = True, problem.prior.pose
    stepwise, spread, step_s = incremental(problem, noise, known, place, progress)
    estimate = stepwise
    if problem.driven:
        whole = _along(problem, intake.driven_pose, known, place)
        points = converged(problem.as_points(), _likelier(problem, noise, stepwise, whole), noise)
        estimate, noise = points.estimate, replace(points.noise, pixel=noise.pixel)
        voted = oriented(problem, estimate, points.now.weight)
        estimate = replace(estimate, place=voted)
    optimum, delay_sigma_s = _with_delays(converged(problem, estimate, noise))
    optimum = repaired(optimum)
    problem = optimum.smoother.problem
    if problem.scale_sigma > 0.0:
        optimum = _with_averaged_scale(optimum)
        if problem.ranges_share > 0.0 and not len(problem.prior.place):
            optimum = _in_shared_metre(optimum)
        problem = optimum.smoother.problem
    if problem.driven and len(problem.prior.place):
        optimum = unjumped(optimum)
        problem = optimum.smoother.problem
    for _ in range(SPLITS):
        found = split(optimum, identity, intake.boxes)
        if found is None:
            break
        problem, estimate, identity = found
        optimum = repaired(converged(problem, estimate, optimum.noise, heavy_rounds=0))
    if (together := rejoined(optimum, identity)) is not None:
        optimum = converged(*together, optimum.noise, heavy_rounds=0)
    number = np.array([np.count_nonzero(identity[: k + 1] == one) for k, one in enumerate(identity)], dtype=np.int64)
    from_map = None
    if len(stated):
        optimum, from_map = compared(optimum, stated)
    return SpatialSolved(optimum, identity, number, from_map, delay_sigma_s, stepwise.pose, spread, step_s)


def _with_delays(optimum: SpatialOptimum) -> tuple[SpatialOptimum, FloatArray]:
    """Return the optimum with the delays of the sensors' stamps, and their (S,) standard deviations."""
    problem = optimum.smoother.problem
    sigma_s = np.full(len(problem.mount), np.nan)
    if problem.path is None or problem.settings.delay_sigma_s == 0.0:
        return optimum, sigma_s
    for row in [*range(len(sigma_s))] * DELAYS:
        delay_s, sigma_s[row] = _delay_of(optimum, row)
        problem = optimum.smoother.problem
        late = np.where(np.arange(len(sigma_s)) == row, delay_s, problem.delay_s)
        optimum = converged(replace(problem, delay_s=late), optimum.estimate, optimum.noise, heavy_rounds=0)
    return optimum, sigma_s


def _delay_of(optimum: SpatialOptimum, row: int) -> tuple[float, float]:
    """Return the delay of a sensor's stamps and its standard deviation, by the parabola through the best of the delays
    that were tried.

    These differ by whole steps of the odometry. Half a step off it is interpolated, so less noisy, and fits better.
    """
    problem, estimate = optimum.smoother.problem, optimum.estimate
    assert problem.path is not None
    step_s, begun_s = float(np.median(np.diff(problem.path.stamp_s))), float(problem.delay_s[row])
    stride, before, found = max(1, round(STRIDE_S / step_s)), problem.settings.delay_sigma_s, dict[int, float]()
    eye = se3.retract(estimate.pose, problem.earlier()[row])

    def cost(steps: int) -> float:
        if steps not in found:
            delay_s = problem.delay_s.copy()
            delay_s[row] += steps * step_s
            tried = replace(problem, delay_s=delay_s)
            start = replace(estimate, pose=se3.retract(eye, -tried.earlier()[row]))
            fit = SpatialSmoother(tried, start.pose).optimum(start, optimum.noise, heavy=True)[1].cost
            found[steps] = fit + 0.5 * (delay_s[row] / before) ** 2
        return found[steps]

    best = 0
    while True:
        below, above = cost(best - stride), cost(best + stride)
        if min(below, above) < cost(best):
            best += stride if above < below else -stride
            continue
        information = max((below - 2.0 * cost(best) + above) / (stride * step_s) ** 2, before**-2)
        if stride == 1 or information * (stride * step_s) ** 2 < FINE:
            break
        stride = max(1, stride // 2)
    off_s = 0.5 * (below - above) / (information * stride * step_s)
    return begun_s + best * step_s + off_s, float(information**-0.5)


def _with_averaged_scale(optimum: SpatialOptimum) -> SpatialOptimum:
    """Return the optimum at the mean over an exact odometer and one whose scale is drawn from its prior.

    Both are as probable beforehand; see `slam.calibration.narrowed`.
    """
    problem, before = optimum.smoother.problem, optimum.smoother.problem.scale_sigma**-2
    variance, worth = optimum.smoother.scale_by_stretches(optimum.now)
    data = max(1.0 / variance - before, 1e-9 * before)
    told, best = data / worth, optimum.estimate.log_scale / (data * variance)
    log_odds = 0.5 * (told * best) ** 2 / (told + before) - 0.5 * np.log1p(told / before)
    information = narrowed(1.0 / (1.0 + np.exp(-log_odds)), before, data, told)
    sober = replace(problem, scale_sigma=float(information**-0.5))
    return converged(sober, optimum.estimate, optimum.noise, heavy_rounds=0)


def _in_shared_metre(optimum: SpatialOptimum) -> SpatialOptimum:
    """Return the optimum with the scale between ranges and odometer divided by what is stated of both."""
    estimate, whole = optimum.estimate, optimum.smoother.problem
    problem = whole.in_shared_metre(estimate.log_scale)
    pose, place = (se3.scaled(of, np.exp(-problem.ranges_log)) for of in (estimate.pose, estimate.place))
    scaled = replace(estimate, pose=pose, place=place, log_scale=0.0)
    return converged(problem, scaled, optimum.noise, heavy_rounds=0)


def _with_map(intake: SpatialIntake, prior_map: Landmarks | None) -> tuple[SpatialProblem, FloatArray]:
    """The problem with the landmarks of a map, and their standard deviations (K, 6) as stated."""
    problem, settings = intake.problem, intake.problem.settings.map
    shared, place, rows = np.intersect1d(
        intake.landmark_id, [] if prior_map is None else prior_map.landmark_id, return_indices=True
    )
    if prior_map is None or not len(shared):
        return problem, np.zeros((0, 6))
    pose = se3.identity(len(rows))
    pose[:, :3] = prior_map.position_m[rows]
    stated = np.full((len(rows), 6), settings.sigma)
    own = np.sqrt(np.einsum("kii->ki", prior_map.covariance_m2[rows]))
    stated[:, :3] = np.where(own > 0.0, own, settings.sigma)
    turned = np.zeros(len(rows), dtype=np.bool_)
    if prior_map.rotation is not None:
        turned = np.isfinite(prior_map.rotation[rows, 0])
        pose[turned, 3:] = prior_map.rotation[rows][turned]
        if prior_map.rotation_covariance is not None:
            own = np.sqrt(np.einsum("kii->ki", np.nan_to_num(prior_map.rotation_covariance[rows])))
            stated[:, 3:] = np.where(own > 0.0, own, settings.sigma)
    stated[problem.oriented[place] & ~turned, 3:] = ANY_RAD  # a map of points knows no orientation
    stated[:, 3:][problem.symmetries[place].unseen > 0.0] = ANY_RAD
    # positions of a map are in its axes, those of tags in their own: all alike
    stated[:, :3] = stated[:, :3].max(axis=1, keepdims=True)
    prior = PlacePrior(place.astype(np.int64), pose, np.maximum(stated, settings.loose_m), np.ones(len(rows)))
    return replace(problem, prior=prior, start_sigma=FREE), stated


def _likelier(
    problem: SpatialProblem, noise: SpatialNoise, stepwise: SpatialEstimate, whole: SpatialEstimate
) -> SpatialEstimate:
    """Return initial values: frame by frame, or along the whole odometry; the more probable ones."""
    points = problem.as_points()
    cost = []
    for start in (stepwise, whole):
        smoother = SpatialSmoother(points, start.pose)
        cost.append(smoother.optimum(start, noise, heavy=True, iterations=10)[1].cost)
    return whole if cost[1] <= cost[0] else stepwise


def _along(problem: SpatialProblem, driven: FloatArray, known: BoolArray, place: FloatArray) -> SpatialEstimate:
    """Poses along the odometry, from where the known places put it as a whole."""
    if known.any():
        driven = se3.compose(_whole(problem, driven, known, place), driven)
    estimate = first_places(problem, driven)
    estimate.place[known] = place[known]
    return estimate


def _whole(problem: SpatialProblem, driven: FloatArray, known: BoolArray, place: FloatArray) -> FloatArray:
    """The pose (7,) of the odometry's frame in the map on which most sightings of known places agree."""
    met = np.flatnonzero(known[problem.place] & problem.oriented[problem.place] & (problem.kind != POINT))
    if not len(met):
        return se3.identity()
    some = met[:: max(1, len(met) // MOST_TRIED)]
    mount = problem.mount[problem.sensor]
    seen = se3.compose(driven[problem.pose_row], se3.compose(mount, problem.explanations))
    trial = se3.compose(place[problem.place[some]], se3.inverse(seen[:, some])).reshape(-1, 7)
    at = se3.transform(trial[:, None], seen[0, some, :3])
    gap = np.linalg.norm(at - place[problem.place[some], :3], axis=2)
    best = int(np.argmin(np.minimum((gap / GROSS_M) ** 2, 1.0).sum(axis=1)))
    return np.asarray(trial[best])
