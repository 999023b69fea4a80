"""The solution of a recording in space, from initial values to the optimum, optionally with a map.

Initial values come frame by frame, each pose from the odometry and the tags known by then. Without odometry the robot
is assumed static until its tags show otherwise. A tag puts the robot in one of two places, where its view has two
explanations; the one that agrees with the other tags and with the motion is taken.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from evermap.align.candidates import Matches, find_consensus
from evermap.config import ChangesConfig
from evermap.estimate.measurement import Tied
from evermap.estimate.sparse.system import exhaust
from evermap.geometry import se3
from evermap.geometry.group import accumulate
from evermap.geometry.rigid import rigid
from evermap.geometry.symmetry import Symmetries
from evermap.geometry.upright import is_level
from evermap.slam.calibration import price
from evermap.slam.space.against_map import MapComparison, cost_in_map, has_contradictions
from evermap.slam.space.bodies import BodyMove, has_left, join_rests, mistrust_bodies, number_moved
from evermap.slam.space.delays import Delays, with_delays
from evermap.slam.space.drift import Drift, drift_of
from evermap.slam.space.estimate import (
    SpatialOptimum,
    converge,
    correlation,
    first_places,
    locate_unseen,
    oriented,
    with_worth,
)
from evermap.slam.space.explanation import explain_places
from evermap.slam.space.intake import SpatialIntake, start_noise
from evermap.slam.space.linearise import CORNERS, POINT, STATES
from evermap.slam.space.map_consensus import spread_loosely, start_by_consensus
from evermap.slam.space.marginal import log_marginal_likelihood
from evermap.slam.space.moved_within import MovedWithin, find_superseded, list_movers
from evermap.slam.space.problem import ANY_RAD, PlacePrior, SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.slam.space.range_noise import with_range_noise
from evermap.slam.space.repair import repaired
from evermap.slam.space.smoother import SpatialSmoother
from evermap.slam.space.starts import by_constellations, find_lost_frames
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray, Landmarks, Progress

FREE = np.repeat([1e3, ANY_RAD], 3)
"""Deviation by which the first pose is held where a map says where it is [m, rad]. Two points of a map leave it a turn
about the line between them; one by a thousand radians would drown what the odometry knows in rounding."""
HELD = np.full(6, 1e-4)
"""And without a map."""
MOST_TRIED = 200
GROSS_M = 1.0
"""Poses tried for a start, and the scale of its loss [m]."""
SLACK_M, SLACK_RAD = 0.15, 0.15
"""What places of a map in the making are off by."""
STILL_M, STILL_RAD = 0.03, 0.03
"""What a robot is off by that was there a moment ago."""
OUTLIER, LOST = 10.0, 15.0
"""Nats that a detection, and a motion, cost at most: a wrong identity, a robot that was carried."""
MOST_DRIFT, INDEPENDENT = 3.0, 0.2
"""Drift over that which landmarks show along the odometry, where two levers of two make up for the odometry's shape;
and correlation of consecutive residuals of a landmark, up to which these are independent."""
STRIDES, SAME_METRE = 20, 0.03
"""Shares of a drive whose ways are compared, the longer half, and by which these differ at most, in the median."""
SEEDS, STEPS_OF_START = 3, 10
"""Frames from which constellations are begun, and Gauss-Newton steps by which starts are compared."""
LOOSE = 1.5
"""Numbers measured for each that is sought, up to which views are loosely tied."""
WIDER, STEPS_OF_WIDER = (30.0, 10.0, 3.0), 20
"""Times that the noise of detections is wider, in turn, and steps at each, at most."""
NEEDED = 0.75
"""Probability that the odometry's scale is not as stated, from which it is free in a map."""
WORTH = 3.0
"""Nats by which a candidate must beat the predicted pose."""


@dataclass(frozen=True, slots=True)
class SpatialSolved:
    """Solution of a session in space.

    Attributes:
        optimum: values, noise and covariances of the last problem.
        identity: (P,) rows of `SpatialIntake.landmark_id` that the places are of.
        number: (P,) which of the landmarks with that identity each is, from 1.
        from_map: what of the given map stands; None without a map.
        delays: how well it is known how late each sensor's stamps are; None where they are trusted.
        online_pose: (F, 7) poses as each frame had them, also of frames without a pose in the problem.
        online_spread: (F, 2) roughly how far off these may be [m, rad].
        step_s: (F,) seconds that each frame took.
        moves: landmarks that moved during the session.
        bodies: bodies that did, with all landmarks on them.
    """

    optimum: SpatialOptimum
    identity: IntArray
    number: IntArray
    from_map: MapComparison | None
    delays: Delays | None
    online_pose: FloatArray
    online_spread: FloatArray
    step_s: FloatArray
    moves: tuple[MovedWithin, ...] = ()
    bodies: tuple[BodyMove, ...] = ()

    @property
    def left(self) -> BoolArray:
        """(P,) places that their landmarks have left."""
        return find_superseded(self.moves, len(self.identity)) | has_left(self.bodies, len(self.identity))


def solve_space(
    intake: SpatialIntake,
    prior_map: Landmarks | None,
    progress: Progress | None = None,
    changes: ChangesConfig | None = None,
) -> SpatialSolved:
    """Estimate poses, places and noise of a recording in space.

    Args:
        intake: the recording as input of the estimator.
        prior_map: landmarks to localise in; None maps from scratch, in the frame of the first pose.
        progress: told after every frame.
        changes: settings of the search for landmarks of the map that moved together; None asks each by itself.

    Raises:
        NumericalError: no finite optimum.
    """
    problem, stated = _with_map(intake, prior_map)
    problem, framed = _without_frames(mistrust_bodies(problem, intake.bodies))
    settings = problem.settings
    noise = start_noise(settings, driven=problem.driven)
    known, place = np.zeros(len(problem.oriented), dtype=np.bool_), se3.identity(len(problem.oriented))
    trusted = problem.prior.weight >= 0.5
    known[problem.prior.place[trusted]], place[problem.prior.place] = True, problem.prior.pose
    scale_in_map = intake.scale_in_map if len(stated) and problem.scale_sigma == 0.0 else 0.0
    problem, noise, drift, counted = _with_drift(problem, noise, intake.driven_pose, in_map=scale_in_map > 0.0)
    stepwise, unsure_s, step_s = incremental(problem, noise, known, place, progress)
    stepwise = locate_unseen(problem, stepwise, known)
    frames = intake.frames
    online = frames.lead_on(stepwise.pose), _rough_spread(frames.since(unsure_s), noise), frames.share_out(step_s)
    estimate, of_points = stepwise, 2 * np.count_nonzero(problem.kind == POINT) > len(problem.kind)
    if problem.driven:
        whole = _along(problem, intake.driven_pose, known, place)
        _, estimate = _likeliest(problem.as_points(), noise, [stepwise, whole])
        points = converge(problem.as_points(), estimate, noise)
        if of_points and not problem.steady and _is_doubtful(points):
            points = _or_better(points, by_constellations(problem.as_points(), points.noise, SEEDS))
        estimate, noise = points.estimate, replace(points.noise, pixel=noise.pixel)
        voted = oriented(problem, estimate, points.now.weight)
        estimate = replace(estimate, place=voted)
    elif of_points:
        estimate, _ = _likeliest(problem, noise, [stepwise, *by_constellations(problem, noise, SEEDS)])
        if _is_loosely_tied(problem):
            begun = converge(problem, estimate, noise)
            estimate = _or_better(begun, [_graduate(problem, noise, estimate)]).estimate
    else:
        begun = converge(problem, stepwise, noise)
        if _is_doubtful(begun) or _has_movers(begun):
            begun = _or_best(begun, by_constellations(problem, noise, SEEDS))
        estimate, noise = begun.estimate, begun.noise
    problem, estimate = _in_measured_frame(problem, estimate, framed)
    optimum, delays = with_delays(with_range_noise(converge(problem, estimate, noise)))
    if drift is not None and counted is None and optimum.estimate.delay_s.any():
        optimum, drift = _without_lasting(optimum, drift, intake.driven_pose, in_map=scale_in_map > 0.0)
    if len(stated) and of_points and not problem.driven and (_is_doubtful(optimum) or has_contradictions(optimum)):
        optimum = _or_by_consensus(optimum, stated)
    optimum = with_range_noise(repaired(optimum))
    if scale_in_map > 0.0:
        optimum = _with_scale_of_map(optimum, scale_in_map)
    problem = optimum.smoother.problem
    if problem.scale_sigma > 0.0:
        optimum = _with_averaged_scale(optimum)
        metric = len(problem.prior.place) or problem.measurements
        if problem.ranges_share > 0.0 and not metric:
            optimum = _in_shared_metre(optimum)
        problem = optimum.smoother.problem
    identity, followed, bodies = np.arange(len(problem.oriented)), intake.boxes, tuple[BodyMove, ...]()
    if intake.rests is not None:
        optimum, identity, bodies = join_rests(optimum, intake.rests)
    if len(intake.bodies):
        followed = followed | (intake.bodies != UNKNOWN)
    explanation = explain_places(optimum, identity, followed, stated, changes)
    optimum, identity, problem = explanation.optimum, explanation.identity, explanation.optimum.smoother.problem
    sober = optimum.noise
    if drift is not None and counted is None and not problem.steady:
        goes = (drift.translation or 0.0) * drift.doubt, (drift.rotation or 0.0) * drift.doubt
        sober = replace(sober, translation=max(sober.translation, goes[0]), rotation=max(sober.rotation, goes[1]))
    optimum = with_worth(optimum, counted, sober)  # covariances are no better than all this
    number, from_map = times_of(identity), explanation.from_map
    for move in reversed(explanation.moves):  # the landmark is where it was last
        number[[move.before, move.after]] = min(number[move.before], number[move.after])
    number = number_moved(number, bodies)
    return SpatialSolved(optimum, identity, number, from_map, delays, *online, explanation.moves, bodies)


def fit_to_map(intake: SpatialIntake, prior_map: Landmarks | None, *, surveyed: bool = False) -> SpatialIntake:
    """Return a recording for a solution in a map: without measurements that hold in another frame, with a warning each.

    Fixes have a frame of their own. What says where up is holds in a map whose z axis is known to be up. A map that was
    `surveyed`, not made by odometry, tells the scale of the odometry.
    """
    if prior_map is None or not np.isin(intake.landmark_id, prior_map.landmark_id).any():
        return intake
    kept, told = list[Tied](), list[str]()
    for tied in intake.problem.measurements:
        why = "" if tied.kind.frame is None else "it has a frame of its own"
        if tied.kind.is_upright and not is_level(prior_map.up):
            why = "the z axis of the map is not known to be up"
        if why:
            told.append(f"measurements '{tied.kind.name}' left out in the map: {why}")
        else:
            kept.append(tied)
    problem = replace(intake.problem, measurements=tuple(kept))
    scale_in_map = intake.scale_in_map if surveyed else 0.0
    return replace(intake, problem=problem, scale_in_map=scale_in_map, warnings=(*intake.warnings, *told))


def _without_frames(problem: SpatialProblem) -> tuple[SpatialProblem, tuple[Tied, ...]]:
    """Return the problem without measurements that have a frame of their own, such as GNSS fixes, and these."""
    framed = tuple(tied for tied in problem.measurements if tied.kind.frame is not None)
    if not framed:
        return problem, ()
    rest = tuple(tied for tied in problem.measurements if tied.kind.frame is None)
    return replace(problem, measurements=rest, start_sigma=np.full(6, 1e-4)), framed


def _in_measured_frame(
    problem: SpatialProblem, estimate: SpatialEstimate, framed: tuple[Tied, ...]
) -> tuple[SpatialProblem, SpatialEstimate]:
    """Return problem and values in the frame of measurements that have one."""
    for tied in framed:
        motion = tied.find_frame(estimate.pose)
        assert motion is not None
        estimate = estimate.moved(motion, problem.oriented)
        loose = np.maximum(problem.start_sigma, tied.kind.first_sigma)
        problem = replace(problem, measurements=(*problem.measurements, tied), start_sigma=loose)
    return problem, estimate


def _with_drift(
    problem: SpatialProblem, noise: SpatialNoise, driven: FloatArray, *, in_map: bool
) -> tuple[SpatialProblem, SpatialNoise, Drift | None, FloatArray | None]:
    """Return the problem with what each detection is worth, and the noise levels with the drift of the odometry.

    And the drift where it was used, or what detections are worth (M,) where that is for covariances only.

    Pixels err by themselves, detectors of objects by the view. That errors persist follows from the odometry alone,
    of which a fast turn or a drift of other than usual form may be wrong, and few sightings of each landmark show no
    drift at all. So independent errors beside the drift that the solution finds are asked as well: they hold where they
    show no correlation beside a drift that landmarks share, or where they are the more probable.

    Args:
        problem: the measurements.
        noise: levels to start from.
        driven: (N, 7) poses by the odometry.
        in_map: whether a map tells what a metre is.
    """
    by_corners = (problem.kind == CORNERS) | problem.ray
    if not problem.driven:
        return problem, noise, None, None
    drift, settings = drift_of(problem, driven), problem.settings
    if 2 * np.sum(~by_corners) <= len(by_corners):  # places of tags by their corners err alike all the same
        return problem, noise, drift, np.where(problem.ray, 1.0, drift.share)  # ranges of rays were triangulated
    share = np.where(by_corners, 1.0, drift.share)
    if problem.steady:
        noise = replace(noise, translation=settings.steady_m, rotation=settings.steady_rad)
    elif drift.translation is not None and drift.rotation is not None:
        free = replace(problem.as_points(), prior=PlacePrior.none(), start_sigma=HELD)
        start = first_places(free, driven)
        alone = with_range_noise(converge(free, start, noise))
        free = alone.smoother.problem
        problem = problem.with_sigma_position(free.sigma_position_m)
        of_metre = in_map or _is_of_one_metre(alone.estimate, driven)
        if of_metre and _are_independent(alone, drift.translation):
            return problem, replace(alone.noise, pixel=noise.pixel), None, None
        lasting, drift = _likeliest_lasting(replace(free, share=share), start, noise, drift)
        if of_metre and log_marginal_likelihood(alone, noise) > lasting:
            return problem, replace(alone.noise, pixel=noise.pixel), None, None
        noise = _with_drift_of(noise, drift)
    return replace(problem, share=share), noise, drift, None


def _without_lasting(
    optimum: SpatialOptimum, drift: Drift, driven: FloatArray, *, in_map: bool
) -> tuple[SpatialOptimum, Drift | None]:
    """Return the optimum at independent errors, without a drift, where these hold at its delays; else both as they are.

    What is late errs for as long as the robot moves on, and an odometry that is held for exact leaves it so: whether
    errors last shows once delays are known.
    """
    problem, noise = optimum.smoother.problem, start_noise(optimum.smoother.problem.settings, driven=True)
    if problem.steady or drift.translation is None or (problem.share == 1.0).all():
        return optimum, drift
    alone = with_range_noise(converge(replace(problem, share=np.ones(len(problem.share))), optimum.estimate, noise))
    if not (in_map or _is_of_one_metre(alone.estimate, driven)):
        return optimum, drift
    if not _are_independent(alone, drift.translation):
        lasts = replace(alone.smoother.problem, share=problem.share)
        lasting, _ = _likeliest_lasting(lasts, optimum.estimate, noise, drift)
        if log_marginal_likelihood(alone, noise) <= lasting:
            return optimum, drift
    return alone, None


def _with_drift_of(noise: SpatialNoise, drift: Drift) -> SpatialNoise:
    """Return levels with those of a drift, where it was told apart."""
    if drift.translation is None or drift.rotation is None:
        return noise
    return replace(noise, translation=drift.translation, rotation=drift.rotation)


def _likeliest_lasting(
    problem: SpatialProblem, start: SpatialEstimate, noise: SpatialNoise, drift: Drift
) -> tuple[float, Drift]:
    """Return the log marginal likelihood of errors that last, and the drift that goes with them: as it was estimated,
    or the least that any odometry has.

    Args:
        problem: with what each detection is worth.
        start: values to start from.
        noise: levels that it is compared at.
        drift: as it was estimated.
    """
    settings = problem.settings
    best, found = -np.inf, drift
    tried = [drift, drift._replace(translation=settings.steady_m, rotation=settings.steady_rad)]
    for one in tried if drift.translation != settings.steady_m else tried[:1]:
        optimum = converge(problem, start, _with_drift_of(noise, one))
        likelihood = log_marginal_likelihood(optimum, noise, optimum.smoother.lasting(optimum.now))
        if likelihood > best:
            best, found = likelihood, one
    return best, found


def _are_independent(optimum: SpatialOptimum, drift_m: float) -> bool:
    """Tell whether errors of detections are independent: their residuals are, at an optimum that takes them for that.

    And the odometry drifts there not much more than landmarks that are seen together show, by `drift_m`. Else what
    persists was put into the poses.
    """
    problem, noise = optimum.smoother.problem, optimum.noise
    range_m = float(np.median(np.linalg.norm(problem.measured[:, :3], axis=1)))
    drifts = np.hypot(noise.translation, noise.rotation * range_m) < MOST_DRIFT * drift_m
    return drifts and correlation(optimum) < INDEPENDENT


def _is_of_one_metre(estimate: SpatialEstimate, driven: FloatArray) -> bool:
    """Tell whether ways are as long as by the odometry, whose metre holds where nothing is stated of the ranges.

    Where its scale is a state, in the metre that was found: a wrong one is no error that persists.
    """
    pose, driven = estimate.pose, se3.scaled(driven, float(np.exp(estimate.log_scale)))
    stride = max(1, len(pose) // STRIDES)
    way, by_odometry = (np.linalg.norm(of[stride:, :3] - of[:-stride, :3], axis=1) for of in (pose, driven))
    ratio = way / np.maximum(by_odometry, 1e-9)
    return bool(abs(np.median(ratio[by_odometry > np.median(by_odometry)]) - 1.0) < SAME_METRE)


def times_of(identity: IntArray) -> IntArray:
    """Return (P,) which of those with its identity (P,) each is, from 1."""
    return np.array([np.count_nonzero(identity[: k + 1] == one) for k, one in enumerate(identity)], dtype=np.int64)


def _with_scale_of_map(optimum: SpatialOptimum, sigma: float) -> SpatialOptimum:
    """Return the optimum with the scale of the odometry free, where a step towards it shows in a map that it is wrong.

    Args:
        optimum: of an exact odometer.
        sigma: standard deviation of the scale.
    """
    free = replace(optimum.smoother.problem, scale_sigma=sigma)
    smoother = SpatialSmoother(free, optimum.estimate.pose)
    now = smoother.linearised(optimum.estimate, optimum.noise, heavy=False)
    step = exhaust(smoother.factorised(now).solution())
    variance, worth = smoother.worth_by_stretches(smoother.after(now, step), -1)
    if price(float(step[-1]), variance, worth, sigma)[0] < NEEDED:
        return optimum
    return converge(free, optimum.estimate, optimum.noise, heavy_rounds=0)


def _with_averaged_scale(optimum: SpatialOptimum) -> SpatialOptimum:
    """Return the optimum at the mean over an exact odometer and one whose scale is drawn from its prior.

    Both are as probable beforehand; see `slam.calibration.narrow`.
    """
    problem, smoother = optimum.smoother.problem, optimum.smoother
    variance, worth = smoother.worth_by_stretches(optimum.now, -1)
    _, information = price(optimum.estimate.log_scale, variance, worth, problem.scale_sigma)
    sober = replace(problem, scale_sigma=float(information**-0.5))
    return converge(sober, optimum.estimate, optimum.noise, heavy_rounds=0)


def _in_shared_metre(optimum: SpatialOptimum) -> SpatialOptimum:
    """Return the optimum with the scale between ranges and odometer divided by what is stated of both."""
    estimate, whole = optimum.estimate, optimum.smoother.problem
    problem = whole.in_shared_metre(estimate.log_scale)
    pose, place = (se3.scaled(of, np.exp(-problem.ranges_log)) for of in (estimate.pose, estimate.place))
    scaled = replace(estimate, pose=pose, place=place, log_scale=0.0)
    return converge(problem, scaled, optimum.noise, heavy_rounds=0)


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


def _or_by_consensus(optimum: SpatialOptimum, stated: FloatArray) -> SpatialOptimum:
    """Return the optimum, or a more probable one from the session by itself laid over the map."""
    problem = optimum.smoother.problem
    free = replace(problem, prior=PlacePrior.none(), start_sigma=HELD)
    noise = start_noise(problem.settings, driven=problem.driven)
    estimate, _ = _likeliest(free, noise, by_constellations(free, noise, 1))
    alone = converge(free, estimate, noise)
    found = start_by_consensus(problem, alone, stated)
    gain_nats = problem.settings.repair.gain_nats
    if found is None or found[1] > cost_in_map(optimum, spread_loosely(problem, stated), alone.noise) - gain_nats:
        return optimum
    return found[0]


def _is_doubtful(optimum: SpatialOptimum) -> bool:
    """Tell whether the odometry jumps, or there are frames in which most is taken for outliers."""
    jumps = (optimum.now.odometry_weight < optimum.smoother.problem.settings.inlier).any()
    return bool(jumps or find_lost_frames(optimum.smoother.problem, optimum.now.weight).any())


def _has_movers(optimum: SpatialOptimum) -> bool:
    """Tell whether landmarks have outliers in a row: they moved during the session, or the start led nowhere."""
    count = len(optimum.smoother.problem.oriented)
    everyone, none = np.ones(count, dtype=np.bool_), np.zeros(0, dtype=np.int64)
    return len(list_movers(optimum, np.arange(count), everyone, none)) > 0


def _or_better(optimum: SpatialOptimum, starts: list[SpatialEstimate]) -> SpatialOptimum:
    """Return the optimum, or a more probable one from another start, at the same noise."""
    smoother, noise, gain = optimum.smoother, optimum.noise, optimum.smoother.problem.settings.repair.gain_nats
    cost = optimum.now.cost
    for start in starts:
        found = converge(smoother.problem, start, noise)
        there = smoother.linearised(found.estimate, noise, heavy=False).cost
        if there < cost - gain:
            optimum, cost = found, there
    return optimum


def _or_best(optimum: SpatialOptimum, starts: list[SpatialEstimate]) -> SpatialOptimum:
    """Return the optimum, or that from the start which leads to the most probable values at the same noise.

    As `_or_better`, but the noise is learned for the best only: of many frames with corners that takes half the time.
    """
    smoother, noise, gain = optimum.smoother, optimum.noise, optimum.smoother.problem.settings.repair.gain_nats
    best, wanted = None, optimum.now.cost - gain
    for start in starts:
        found, _ = smoother.optimum(start, noise, heavy=True, iterations=STEPS_OF_START)
        found, there = smoother.optimum(found, noise, heavy=False, iterations=STEPS_OF_START, wanted=wanted)
        if there.cost < wanted:
            best, wanted = found, there.cost
    return optimum if best is None else converge(smoother.problem, best, noise)


def _likeliest(
    problem: SpatialProblem, noise: SpatialNoise, starts: list[SpatialEstimate]
) -> tuple[SpatialEstimate, SpatialEstimate]:
    """Return the initial values that lead to the most probable ones, and these."""
    found = [
        SpatialSmoother(problem, start.pose).optimum(start, noise, heavy=True, iterations=STEPS_OF_START)
        for start in starts
    ]
    cost = [now.cost for _, now in found]
    best = len(starts) - 1 - int(np.argmin(cost[::-1]))  # of equal ones the last
    return starts[best], found[best][0]


def _is_loosely_tied(problem: SpatialProblem) -> bool:
    """Tell whether hardly more numbers were measured than are sought, of points without odometry."""
    return 3 * len(problem.kind) < LOOSE * (6 * len(problem.stamp_s) + 3 * len(problem.oriented))


def _graduate(problem: SpatialProblem, noise: SpatialNoise, start: SpatialEstimate) -> SpatialEstimate:
    """Return values that are led from a start to the optimum by detections with less and less noise.

    Where views are loosely tied, each fits what the start has of the others, and none can move without the rest. Under
    noise that is many times wider they move together (graduated non-convexity: Yang et al. 2020).
    """
    estimate = start
    for times in WIDER:
        wider = replace(noise, across=times * noise.across, along=times * noise.along, pixel=times * noise.pixel)
        smoother = SpatialSmoother(problem, estimate.pose)
        estimate, _ = smoother.optimum(estimate, wider, heavy=True, iterations=STEPS_OF_WIDER)
    return estimate


def _along(problem: SpatialProblem, driven: FloatArray, known: BoolArray, place: FloatArray) -> SpatialEstimate:
    """Poses along the odometry, from where the known places put it as a whole."""
    if known.any():
        driven = se3.compose(_whole(problem, driven, known, place), driven)
    estimate = first_places(problem, driven)
    estimate.place[known] = place[known]
    return estimate


def _whole(problem: SpatialProblem, driven: FloatArray, known: BoolArray, place: FloatArray) -> FloatArray:
    """The pose (7,) of the odometry's frame in the map on which most sightings of known places agree."""
    met = np.flatnonzero(known[problem.place])
    met = met[:: max(1, len(met) // MOST_TRIED)]
    ways = se3.compose(problem.mount[problem.sensor[met]], problem.explanations[:, met])
    seen, there = se3.compose(driven[problem.pose_row[met]], ways), place[problem.place[met]].copy()
    about_axis = (problem.symmetries[problem.place[met]].unseen > 0.0).any(axis=-1)
    there[~problem.oriented[problem.place[met]] | (problem.kind[met] == POINT) | about_axis, 3:] = np.nan
    other = np.isfinite(there[:, 3]) & (ways != ways[0]).any(axis=2)
    way, row = np.nonzero(np.concatenate([np.ones_like(other[:1]), other[1:]]))
    return find_consensus(Matches.of(seen[way, row], there[row], landmark=row), agree_m=GROSS_M)[0]


def incremental(
    problem: SpatialProblem, noise: SpatialNoise, known: BoolArray, place: FloatArray, progress: Progress | None = None
) -> tuple[SpatialEstimate, FloatArray, FloatArray]:
    """Return poses and places, one frame after the other; seconds (N,) since poses were known; seconds (N,) that each
    frame took.

    Args:
        problem: the measurements.
        noise: how far the robot may be from where the odometry puts it.
        known: (P,) places of a map that is given.
        place: (P, 7) where they are.
        progress: told after every frame that saw something, and the last.
    """
    n, mount = len(problem.stamp_s), problem.mount[problem.sensor]
    place, known = place.copy(), known.copy()
    either, ways = se3.compose(mount, problem.either), se3.compose(mount, problem.explanations)
    share = np.exp(-np.clip(problem.other_log_odds / noise.pixel**2, 0.0, 30.0))
    log_share = np.stack([-np.log1p(share), np.log(share + 1e-12) - np.log1p(share)])
    sigma_m = np.hypot(_sigma_m(problem.measured_root) * noise.position, SLACK_M)
    sigma_rad = np.hypot(problem.sigma_rad * noise.pixel, SLACK_RAD)
    turned = problem.oriented[problem.place]
    first = np.searchsorted(problem.pose_row, np.arange(n + 1))
    pose, unsure_s = np.empty((n, 7)), np.zeros(n)
    driven, lasted_s = accumulate(problem.increment), np.append(0.0, np.cumsum(problem.lasted_s))
    pose[0], unsure_s[0] = se3.identity(), 1e6 if known.any() else 0.0
    step_s, last = np.zeros(n), 0
    for row in np.union1d(np.flatnonzero(np.diff(first)), [0, n - 1]).tolist():
        began = time.perf_counter()
        if row:
            since = slice(last + 1, row + 1)  # frames up to this one that saw nothing
            pose[since] = se3.compose(pose[last], se3.between(driven[last], driven[since]))
            unsure_s[since] = unsure_s[last] + lasted_s[since] - lasted_s[last]
        mine = np.arange(first[row], first[row + 1])
        met = mine[known[problem.place[mine]]]
        if len(met):
            where, alike = place[problem.place[met]], problem.symmetries[problem.place[met]]
            seen = partial(
                _price_sightings, either=either[:, met], place=where, log_share=log_share[:, met], sigma_m=sigma_m[met],
                sigma_rad=sigma_rad[met], turned=turned[met], alike=alike,
            )  # fmt: skip
            # no candidate costs less than if it were where all is as seen
            best, least = 0, float(-log_share[:, met].max(axis=0).sum())
            if float(seen(pose[row : row + 1]).sum()) - WORTH > least:
                went_s = np.sqrt(unsure_s[row])
                within = STILL_M + noise.translation * went_s, STILL_RAD + noise.rotation * went_s
                candidate = _candidates(pose[row], ways[:, met], where, turned[met], alike)
                cost = _price_motion(candidate, within) + seen(candidate).sum(axis=1)
                cost[0] -= WORTH
                best = int(np.argmin(cost))
                pose[row] = candidate[best]
            unsure_s[row] = 0.0 if best else unsure_s[row]
        new = mine[~known[problem.place[mine]]]
        if len(new):
            place[problem.place[new]] = se3.compose(pose[row], either[0, new])
            known[problem.place[new]] = True
        step_s[last + 1 if row else 0 : row + 1] = (time.perf_counter() - began) / max(row - last, 1)
        last = row
        if progress is not None:
            progress(float(problem.stamp_s[row]), float(problem.stamp_s[-1]))
    place[~problem.oriented, 3:] = se3.NO_TURN
    return SpatialEstimate(pose, place, np.zeros((len(problem.mount), STATES))), unsure_s, step_s


def _rough_spread(unsure_s: FloatArray, noise: SpatialNoise) -> FloatArray:
    """Return roughly how far off poses may be (F, 2) [m, rad], so long after they were known (F,)."""
    went_s = np.sqrt(unsure_s)
    return np.column_stack([SLACK_M + noise.translation * went_s, SLACK_RAD + noise.rotation * went_s])


def _sigma_m(root: FloatArray) -> FloatArray:
    """(M,) of positions, all axes alike."""
    inverse = np.linalg.inv(root)
    return np.asarray(np.sqrt((inverse**2).sum(axis=(1, 2)) / 3.0))


def _candidates(
    predicted: FloatArray, ways: FloatArray, place: FloatArray, turned: BoolArray, alike: Symmetries
) -> FloatArray:
    """(C, 7) the predicted pose, then where each detection (E, K, 7) of a place with an orientation puts the robot, and
    where the positions of three or more put it.
    """
    seen, known = ways[:, turned], place[turned]
    known = alike[turned].twisted(known, se3.compose(predicted, seen))
    by_places = se3.compose(known, se3.inverse(seen)).reshape(-1, 7)
    by_all = rigid(ways[0, :, :3], place[:, :3])[None] if len(place) >= 3 else np.zeros((0, 7))
    return np.vstack([predicted[None], by_places, by_all])


def _price_motion(candidate: FloatArray, spread: tuple[float, float]) -> FloatArray:
    """(C,) nats that it costs to be there rather than where the odometry says, the first."""
    off = se3.local(candidate[:1], candidate)
    squared = (off[:, :3] ** 2).sum(axis=1) / spread[0] ** 2 + (off[:, 3:] ** 2).sum(axis=1) / spread[1] ** 2
    return np.asarray(np.minimum(0.5 * squared, LOST))


def _price_sightings(
    candidate: FloatArray, either: FloatArray, place: FloatArray, log_share: FloatArray, sigma_m: FloatArray,
    sigma_rad: FloatArray, turned: BoolArray, alike: Symmetries,
) -> FloatArray:  # fmt: skip
    """(C, K) nats that the detections cost."""
    at = se3.compose(candidate[:, None, None, :], either[None])
    away = np.linalg.norm(at[..., :3] - place[:, :3], axis=-1) / sigma_m
    angle = np.where(turned, alike.angle_between(at, place), 0.0) / sigma_rad
    cost = 0.5 * away**2 + 0.5 * angle**2 - log_share[None]
    return np.asarray(np.minimum(cost.min(axis=1), OUTLIER))
