"""All measurements of one recording together: the optimum, its noise levels, and which states are needed.

The optimum and the noise levels are sought in turns, first with the kernel that never lets go of an outlier, then with
that which explains them; parts that went astray are laid over the rest; a method says what moved; and the calibration
states that hardly need to be free are held as stated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from evermap.align.acceptance import SIGMA_M, Acceptance, accept_alignment
from evermap.align.candidates import Matches, find_consensus
from evermap.config import LocalizeConfig, SlamConfig
from evermap.errors import NumericalError
from evermap.estimate.measurement import Tied
from evermap.estimate.noise import Turns, alternate
from evermap.estimate.sparse.system import Slices, exhaust
from evermap.geometry import se2, se3
from evermap.slam.bridge import dead_reckoned
from evermap.slam.calibration import FORWARD, SLOPE, CalibrationPrior, needed, seat_sensor
from evermap.slam.method import Explanation, Method
from evermap.slam.noise import Extrapolation, NoiseFit, learn_noise_by_range, refine_noise
from evermap.slam.problem import Estimate, Marginals, Noise, Problem, independent
from evermap.slam.smoother import COST_SLACK, DETECTIONS, Smoother
from evermap.types import BoolArray, FloatArray, IntArray

USUAL = SlamConfig()
ALIGNED_INFORMATION = 1e-2
"""Once in a prior map the first pose is free: held to 10 m only, so that the linear system stays well conditioned."""
FINAL_ROUNDS, FINAL_STEPS = 12, 10
MOST_BREAKS = 8
"""Silences of the odometry after which the parts are laid over each other."""
ELSEWHERE = 0.1
"""Motion (m or rad) of a part that the optimum near it does not take back."""
STEPS_A_ROUND = 4
"""Gauss-Newton steps of a relinearisation, or between two estimates of the noise, at most."""
NEAR, NEAR_NOISE = 0.02, 1e-4
"""Step (m, rad or 1) after which the stream goes on, or learns noise: the next step would be far smaller."""
FINAL_TOLERANCE, FINAL_GAIN = 1e-5, 1e-2
"""Step (m, rad or 1), or what it gains (nats), at which the final optimum is reached."""
SAME_FRAME = 1e-4
"""Motion of the frame (m or rad) up to which covariances in it are the same: they change by no larger share."""
NEAR_NOISE_GAIN = 1e-4
"""Or what a step gains (nats) for each detection: by so little do noise levels change with it."""
FEWEST_POSES, LEARNED_SHARE = 40, 0.3
"""Poses that are solved first, and the share of all up to which noise is learned on the way."""
STEPS_A_PART, NEAR_GAIN = 10, 0.01
"""Gauss-Newton steps of a part at most; it ends with one that gains so little (nats) for each detection."""
MOST_WORSE = 1.5
"""Cost of a part for each number that was measured, relative to that of the part before it, up to which it fits."""
OTHER_METRE = 4.0
"""Standard deviations of range slope and odometer scale by which the metre of a map is another, at most."""
NOISE_NEAR, NOISE_CONVERGED = 0.05, 0.02
"""Change of the noise (`NoiseFit.change`) below which it is decided what is needed, and the last rounds stop."""
NOISE_BY_RANGE_ROUNDS = 3
"""Times that noise by range and values are sought in turns, at most."""
FINAL_REVISIONS = 3
"""Times that the method thinks again at the end, at most: other places mean other noise, and that other gates."""


@dataclass(frozen=True, slots=True)
class PriorMap:
    """A map to localise in, by rows of the problem: mean (L, 2), information (L, 2, 2), given (L,)."""

    mean: FloatArray
    information: FloatArray
    given: BoolArray


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a finished session, in the scale and the frame of the map.

    Attributes:
        estimate: smoothed values.
        states_covariance: (11, 11) of its calibration states, what cannot be divided included.
        prior: of the states, free those that are needed, as the user means it.
        p_needed: (11,) probability of each state to be another than stated; nan where it was not asked.
        askew: direction in which the robot drives, from its front, and its standard deviation [rad].
        smoother: that the optimum was found with; its problem has the start and priors of that, in the graph's metres.
        graph_estimate, graph_marginals: values and covariances as the graph holds them, before the scale was divided.
        fit_marginals: the covariances of the fit, with errors that last as if they were independent.
        noise: levels and how well they are known.
        inlier: (M,) probability of every detection to be no outlier.
        scale: factor from the graph's metres to metres; log_scale_sigma: its uncertainty.
        aligned: True if the frame is that of the prior map.
        revision: the method's last word: the places where landmarks are, what moved, what may have moved instead.
    """

    estimate: Estimate
    states_covariance: FloatArray
    prior: CalibrationPrior
    p_needed: FloatArray
    askew: tuple[float, float]
    smoother: Smoother
    graph_estimate: Estimate
    graph_marginals: Marginals
    fit_marginals: Marginals
    noise: NoiseFit
    inlier: FloatArray
    scale: float
    log_scale_sigma: float
    aligned: bool
    revision: Explanation

    @property
    def problem(self) -> Problem:
        """All measurements, with the priors that the optimum belongs to."""
        return self.smoother.problem


class SolvedPart(NamedTuple):
    """The first measurements of a recording, values near their optimum, noise levels, and whether they fit so far."""

    problem: Problem
    estimate: Estimate
    noise: Noise
    fits: bool


class _Solution(NamedTuple):
    """Values near the optimum of some noise levels, with the smoother at these and the covariances."""

    smoother: Smoother
    estimate: Estimate
    marginals: Marginals


class FoundOptimum(NamedTuple):
    """An optimum: its smoother, its values, their covariances, its noise levels, and how these were sought."""

    smoother: Smoother
    estimate: Estimate
    marginals: Marginals
    noise: NoiseFit
    ahead: Extrapolation


class Batch:
    """What finishes a session from values near its optimum.

    `noise` is where the noise levels start, `prior` are calibration priors as the user means them, `method` says what
    moved.
    """

    def __init__(self, prior: CalibrationPrior, noise: Noise, method: Method, settings: SlamConfig = USUAL) -> None:
        self._prior, self._start_noise, self._method = prior, noise, method
        self._settings, self._robust, self._estimate_noise = settings, settings.robust, settings.estimate_noise

    def is_driven(self, problem: Problem) -> bool:
        """Return whether the odometry is nowhere silent for so long that a heading is unknown: then it leads on."""
        floor = problem.drive.between(problem.stamp_s, self._prior.mean).floor
        return not np.any(floor[:, 2, 2] > self._settings.odometry.loose_rad**2)

    def parts(self, problem: Problem) -> Iterator[SolvedPart]:
        """Solve the first poses from the odometry alone, then twice as many, until all are; each yields its values.

        Each time the odometry leads on from what was found, with the calibration that was found. Where it leads so far
        away that the optimum is not found again, fewer poses are added.
        """
        problem, noise = replace(problem, prior=self._prior.without_scale()), self._start_noise
        nowhere = np.full((len(problem.landmark_mean), 2), np.nan)
        estimate = Estimate(problem.start_pose[None], nowhere, problem.prior.mean)
        whole, done, share = len(problem.stamp_s), 0, 1.0
        more, fits = _first_part(whole), True
        while done < whole:
            count = min(done + more, whole)
            some = problem.until(count)
            smoother, found, marginals = self._lead_on(some, estimate, noise)
            # half a nat for each number that was measured, or what it was before
            cost = smoother.cost(found) / (len(some.pose_row) + 1.5 * count)
            good = cost < max(1.0, MOST_WORSE * share)
            if not good and more > FEWEST_POSES:
                more //= 2
                continue
            estimate, done, share, more = found, count, cost, min(count, 2 * more)
            fits &= good
            if self._estimate_noise and (count < LEARNED_SHARE * whole or count == whole):
                weights = smoother.inlier_probability(estimate)
                if count == whole:  # outliers as from here on
                    weights = smoother.under(noise, heavy=False).inlier_probability(estimate)
                noise = refine_noise(some, estimate, marginals, weights, noise, self._start_noise, scoring=True).noise
            yield SolvedPart(some, estimate, noise, fits)

    def _lead_on(self, problem: Problem, before: Estimate, noise: Noise) -> tuple[Smoother, Estimate, Marginals]:
        """The optimum of more poses than those of the values before."""
        smoother, start = Smoother(problem, noise, heavy=True, robust=self._robust), _lead_on(problem, before, noise)
        steps, settled = STEPS_A_PART, NEAR_GAIN * len(problem.pose_row)
        estimate, marginals = exhaust(
            smoother.solve_in_slices(start, iterations=steps, tolerance=NEAR, settled=settled)
        )
        if self._robust:
            moved = exhaust(voted(smoother, estimate, self._settings.fewest_sightings))
            if moved is not estimate:
                estimate, marginals = exhaust(
                    smoother.solve_in_slices(moved, iterations=steps, tolerance=NEAR, settled=settled)
                )
        return smoother, estimate, marginals

    def solved(self, part: SolvedPart, prior_map: PriorMap | None, framed: tuple[Tied, ...] = ()) -> Outcome:
        """Return the optimum near the values of a part, in a prior map where two of its landmarks fit.

        Else in the frame of measurements that have one of their own, `framed`.
        """
        problem, estimate, noise, _ = part
        estimate = _with_measured_places(problem, estimate)
        if prior_map is not None:
            estimate, prior, laid = lay_over_in_metre(prior_map, estimate, self._prior, self._settings.localize)
            if laid:
                problem, estimate = entered(problem, estimate, prior_map, prior, laid.motion)
                return self.finished(problem, estimate, noise, aligned=True)
        if framed:
            problem, estimate = _in_measured_frame(problem, estimate, framed, self._prior)
            return self.finished(problem, estimate, noise, aligned=True)
        return self.finished(problem, estimate, noise, aligned=False, near=True)

    def finished(
        self, problem: Problem, estimate: Estimate, noise: Noise, *, aligned: bool, near: bool = False
    ) -> Outcome:
        """Return the optimum near these values, with noise levels iterated to convergence, and divide the scale.

        Args:
            problem: all measurements, with the calibration priors of the graph.
            estimate: where to start.
            noise: the levels there.
            aligned: whether the frame is that of a prior map.
            near: whether the values are so near that it shows what is an outlier.
        """
        free, start = self._method.unprejudice(problem, estimate)
        near, problem, estimate = near and free is problem, free, start
        if self._robust and not near:  # a landmark whose first sighting was misread may be disputed since
            smoother = Smoother(problem, noise, heavy=True)
            estimate = exhaust(voted(smoother, estimate, self._settings.fewest_sightings))
        found = self._settle(Smoother(problem, noise, robust=self._robust), problem, estimate, noise, heavy=not near)
        if self._robust:
            rejoined = _rejoin(found.smoother, found.estimate, self._settings)
            found = self._readmit(found, rejoined)
        found = self._with_noise_by_range(found)
        problem = found.smoother.problem
        if self._robust:
            tried = found.smoother.inlier_probability(found.estimate) < 0.5
        problem, estimate = self._ahead(problem, found.estimate, aligned=aligned)
        for _ in range(FINAL_REVISIONS):
            revision = self._method.revise(problem, estimate, found.noise.noise, heavy=False, final=True)
            if revision.problem is problem:
                break
            problem, levels = revision.problem, found.noise.noise
            smoother = Smoother(problem, levels, robust=self._robust)
            found = self._settle(smoother, problem, revision.estimate, levels, heavy=True)
            estimate = found.estimate
        # near enough to tell which states are needed; then all of them are sought together
        worth = found.smoother.worth(found.estimate, found.marginals)
        p_needed = needed(problem.prior, estimate.states, found.marginals.states, worth)
        if not np.all(np.isnan(p_needed)):
            prior, states = problem.prior.averaged(p_needed, estimate.states, np.diag(found.marginals.states), worth)
            problem, estimate = replace(problem, prior=prior), _at_states(estimate, found.marginals, states)
        problem, estimate = self._ahead(problem, estimate, aligned=aligned)
        found = self._settle(found.smoother, problem, estimate, found.noise.noise, ahead=found.ahead, final=True)
        if self._robust:  # means may lie so far from the estimate that true sightings are rejected on the way
            found = self._readmit(found, found.estimate, tried, final=True)
        solved = found.smoother, found.estimate, found.marginals
        ahead, estimate = self._ahead(found.smoother.problem, found.estimate, aligned=aligned)
        if ahead is not found.smoother.problem:
            smoother = found.smoother.under(found.noise.noise, heavy=False, problem=ahead)
            turn = float(np.abs(se2.local(found.estimate.pose[0], estimate.pose[0])).max())
            marginals = found.marginals if turn < SAME_FRAME else smoother.marginals(estimate)
            solved = smoother, estimate, marginals
        return divided(solved, self._prior, p_needed, found.noise, revision, aligned=aligned)

    def _with_noise_by_range(self, found: FoundOptimum) -> FoundOptimum:
        """Return what was found with noise by range of detections that state none."""
        asked = self._estimate_noise and found.smoother.problem.noise_by_range
        for _ in range(NOISE_BY_RANGE_ROUNDS if asked else 0):
            smoother, estimate = found.smoother, found.estimate
            weights, before = smoother.inlier_probability(estimate), smoother.problem
            share = float(before.new_information(smoother.lasting(estimate)).mean())
            problem, noise = learn_noise_by_range(before, estimate, found.marginals, weights, smoother.noise, share)
            if problem is before:
                break
            found = self._settle(smoother, problem, estimate, noise, ahead=found.ahead)
        return found

    def _readmit(
        self, found: FoundOptimum, estimate: Estimate, tried: BoolArray | None = None, *, final: bool = False
    ) -> FoundOptimum:
        """What was found, or what is from these values or where sightings that were rejected lead (`_readmit`)."""
        better = _readmit(found.smoother, estimate, self._settings, tried)
        if better is found.estimate:
            return found
        smoother = found.smoother
        return self._settle(smoother, smoother.problem, better, found.noise.noise, heavy=not final, final=final)

    def _ahead(self, problem: Problem, estimate: Estimate, *, aligned: bool) -> tuple[Problem, Estimate]:
        """Return the same, rotated so that the first pose has the robot's front ahead, unless it is in a map."""
        front = self._prior.front(estimate.states, problem.mount)
        start = problem.start_pose if aligned else se2.inverse(front)
        if np.array_equal(start, problem.start_pose):
            return problem, estimate
        turn = se2.compose(start, se2.inverse(problem.start_pose))
        return replace(problem, start_pose=start), estimate.moved(turn)

    def _settle(
        self,
        smoother: Smoother,
        problem: Problem,
        estimate: Estimate,
        noise: Noise,
        *,
        ahead: Extrapolation | None = None,
        heavy: bool = False,
        final: bool = False,
    ) -> FoundOptimum:
        """Return the optimum from these values and its noise levels, in turns until neither changes.

        Args:
            smoother: one of the same problem but for its prior and its start.
            problem: what is solved.
            estimate: where to start.
            noise: levels to start from.
            ahead: how they were sought at a problem nearby.
            heavy: begin with the kernel that never lets go, for values from which it does not show what is an outlier.
            final: to within what rounding leaves; else near enough to decide what comes next.
        """
        learner, learns = Extrapolation() if ahead is None else ahead, self._estimate_noise
        learner.elsewhere()
        steps, tolerance, settled = STEPS_A_ROUND, NEAR_NOISE, NEAR_NOISE_GAIN * len(problem.pose_row)
        if final:
            steps, tolerance, settled = FINAL_STEPS, FINAL_TOLERANCE, FINAL_GAIN

        def optimise(before: _Solution | None, levels: Noise, heavy: bool) -> _Solution:
            last, start = (smoother, estimate) if before is None else before[:2]
            at = last.under(levels, heavy=heavy, problem=problem)
            # values and noise levels settle together: no need for the optimum of levels that will not stay
            solved = at.solve_in_slices(start, iterations=steps, tolerance=tolerance, settled=settled)
            return _Solution(at, *exhaust(solved))

        def learn(found: _Solution, levels: Noise) -> tuple[NoiseFit, float]:
            weights = found.smoother.inlier_probability(found.estimate)
            fit = refine_noise(
                problem, found.estimate, found.marginals, weights, levels, self._start_noise, scoring=True
            )
            return fit, fit.change if learns else 0.0

        def follow(levels: Noise, fit: NoiseFit, heavy: bool) -> Noise:
            if not learns:
                return levels
            return fit.noise if heavy else learner.ahead(levels, fit.noise)

        turns = Turns(FINAL_ROUNDS, int(heavy), NOISE_CONVERGED if final else NOISE_NEAR)
        found, fit = alternate(noise, optimise, learn, follow, turns)
        if final or not learns:  # those that the values are an optimum of
            fit = replace(fit, noise=found.smoother.noise)
        return FoundOptimum(*found, fit, learner)


def _at_states(estimate: Estimate, marginals: Marginals, states: FloatArray) -> Estimate:
    """Return values with other calibration states (11,), and all else where it is expected then."""
    away = np.linalg.pinv(marginals.states, hermitian=True) @ (states - estimate.states)
    step = marginals.with_states @ away
    n, landmark = len(estimate.pose), estimate.landmark.copy()
    landmark[estimate.known] += step[3 * n : -len(states)].reshape(-1, 2)
    return Estimate(se2.compose(estimate.pose, step[: 3 * n].reshape(n, 3)), landmark, states)


def _first_part(count: int) -> int:
    """Return how many poses are solved first: of all of them a half, of that a half, as long as there are enough."""
    while count >= 2 * FEWEST_POSES:
        count = (count + 1) // 2
    return count


def _lead_on(problem: Problem, estimate: Estimate, noise: Noise) -> Estimate:
    """Return values of all poses, those beyond the estimate's by odometry, and of all landmarks they saw.

    A new landmark is where its prior or the median of its sightings puts it.
    """
    done = len(estimate.pose)
    reckoned, _ = dead_reckoned(problem.stamp_s[done - 1 :], problem.drive, estimate.states, noise)
    pose = np.concatenate([estimate.pose, se2.compose(estimate.pose[-1], reckoned[1:])])
    landmark = estimate.landmark.copy()
    new = np.isnan(landmark[problem.landmark_row, 0])
    theirs = problem.seeing(new)
    at = sight_at(pose[theirs.pose_row], theirs.reading, estimate.states, problem.mount)
    middle = middles(theirs.landmark_row, at, len(landmark))
    return Estimate(pose, np.where(np.isnan(landmark), middle, landmark), estimate.states)


def _with_measured_places(problem: Problem, estimate: Estimate) -> Estimate:
    """Return values with the places of landmarks that further kinds of measurements alone have seen."""
    landmark, pose = estimate.landmark.copy(), se3.from_plane(estimate.pose)
    for tied in problem.measurements:
        for row, at in tied.locate(pose, np.flatnonzero(~estimate.known)).items():
            landmark[row] = at[:2]
    return replace(estimate, landmark=landmark)


def _in_measured_frame(
    problem: Problem, estimate: Estimate, framed: tuple[Tied, ...], prior: CalibrationPrior
) -> tuple[Problem, Estimate]:
    """Return problem and values in the frame of measurements that have one, which say what a metre is, too."""
    framed = tuple(tied.until(len(estimate.pose)) for tied in framed)
    for tied in framed:
        motion = tied.find_frame(se3.from_plane(estimate.pose))
        assert motion is not None
        estimate = estimate.moved(np.append(motion[:2], 2.0 * np.arctan2(motion[5], motion[6])))
    held = replace(problem, start_pose=estimate.pose[0], start_information=ALIGNED_INFORMATION, prior=prior)
    return replace(held, measurements=(*problem.measurements, *framed)), estimate


def lay_over(
    prior_map: PriorMap, landmark: FloatArray, rules: LocalizeConfig, *, fewest: int = 2, spread_m: float = 0.0
) -> Acceptance:
    """Return how the landmarks that were seen lie over a prior map, and whether that is accepted.

    Args:
        prior_map: the map.
        landmark: (L, 2) positions of the landmarks, nan where never seen; those of further places are not asked.
        rules: when an alignment is accepted.
        fewest: landmarks that must agree.
        spread_m: how far apart these must be.
    """
    landmark = landmark[: len(prior_map.given)]
    both = prior_map.given & np.isfinite(landmark[:, 0])
    matches = Matches.of(landmark[both], prior_map.mean[both])
    spread = np.linalg.inv(prior_map.information[both]) + SIGMA_M**2 * np.eye(2)
    return accept_alignment(matches, rules, fewest=fewest, spread_m=spread_m, covariance_m2=spread)


def lay_over_in_metre(
    prior_map: PriorMap, estimate: Estimate, prior: CalibrationPrior, rules: LocalizeConfig
) -> tuple[Estimate, CalibrationPrior, Acceptance]:
    """Return values whose landmarks lie over a prior map (`lay_over`), the prior in the map, and how they lie.

    Where only the product of range slope and odometer scale shows, the metre of the values is a guess, and the map says
    what it is: by the distances between its landmarks, of which one more must agree then. A sensor whose ranges are so
    much longer than the map's is no better than that, whatever is usual of its kind.

    Args:
        prior_map: the map.
        estimate: values, in the metre of `prior`.
        prior: of the calibration states, as the user means it.
        rules: when an alignment is accepted.
    """
    laid = lay_over(prior_map, estimate.landmark, rules)
    if not prior.shares_scale or laid.agree.all():
        return estimate, prior, laid
    count = len(prior_map.given)
    both = np.flatnonzero(prior_map.given & estimate.known[:count])
    one, other = np.triu_indices(len(both), 1)
    apart = [np.linalg.norm(at[both[one]] - at[both[other]], axis=1) for at in (prior_map.mean, estimate.landmark)]
    if len(both) < max(rules.fewest, 2) or min(apart[0].min(), apart[1].min()) <= 0.0:
        return estimate, prior, laid
    log_scale = float(np.median(np.log(apart[0] / apart[1])))
    if abs(log_scale) > OTHER_METRE * float(np.hypot(prior.sigma[SLOPE], prior.sigma[FORWARD])):
        return estimate, prior, laid
    scale = float(np.exp(log_scale))
    pose, landmark = estimate.pose * [scale, scale, 1.0], estimate.landmark * scale
    scaled = Estimate(pose, landmark, prior.resize(estimate.states, scale))
    again = lay_over(prior_map, scaled.landmark, rules, fewest=rules.fewest)
    if not again or (laid and np.count_nonzero(again.agree) <= np.count_nonzero(laid.agree)):
        return estimate, prior, laid
    sigma = prior.sigma.copy()
    sigma[SLOPE] = max(sigma[SLOPE], abs(scaled.states[SLOPE] - prior.mean[SLOPE]))
    return scaled, replace(prior, sigma=sigma), again


def entered(
    problem: Problem, estimate: Estimate, prior_map: PriorMap, prior: CalibrationPrior, pose_map_world: FloatArray
) -> tuple[Problem, Estimate]:
    """Move an estimate from the first pose's frame, at a pose (3,) in a prior map, into that map, constrained by it.

    Returns the problem with the map, with calibration priors as the user means them, and values in its frame.
    """
    new = len(estimate.landmark) - len(prior_map.given)  # places that landmarks have besides their own
    mean, given = np.pad(prior_map.mean, ((0, new), (0, 0))), np.pad(prior_map.given, (0, new))
    both = given & estimate.known
    moved = estimate.moved(pose_map_world)
    moved = replace(moved, landmark=np.where(both[:, None], mean, moved.landmark))
    problem = replace(
        problem,
        prior=prior,
        start_pose=moved.pose[0],
        start_information=ALIGNED_INFORMATION,
        landmark_mean=np.where(given[:, None], mean, 0.0),
        landmark_information=independent(np.pad(prior_map.information, ((0, new), (0, 0), (0, 0)))),
    )
    return problem, moved


def divided(
    solved: tuple[Smoother, Estimate, Marginals],
    prior: CalibrationPrior,
    p_needed: FloatArray,
    noise: NoiseFit,
    revision: Explanation,
    *,
    aligned: bool,
    averaged: bool = True,
    others: tuple[tuple[float, float, float], ...] = (),
) -> Outcome:
    """Return what a session knows at its optimum, with what only shows together divided as its sensor states it.

    `solved` is the final optimum in the graph's metres, `prior` as the user means it, the rest as in `Outcome`;
    `others` is what other robots say of its lengths (`CalibrationPrior.metre`). States that were not `averaged` at this
    optimum are asked here whether they are needed, `p_needed` (11,) holds for the others.
    """
    smoother, estimate, marginals = solved
    believed, worth = prior, smoother.worth(estimate, marginals)
    prior = prior.spared(p_needed)
    if not averaged:
        asked = needed(smoother.problem.prior, estimate.states, marginals.states, worth)
        p_needed = np.where(np.isnan(asked), p_needed, asked)
    covariance = marginals.states * np.sqrt(np.outer(worth, worth))
    covariance += np.diag(prior.doubt(p_needed, estimate.states, averaged=averaged))
    states, scale, log_sigma = estimate.states, 1.0, 0.0
    if others or not aligned:
        divides = believed if others else prior
        states, covariance, scale, log_sigma = divides.split_scale(states, covariance, others)
    front = prior.front(states, smoother.problem.mount)
    states, covariance, *askew = prior.split_angle(states, covariance)
    pose = se2.compose(estimate.pose * [scale, scale, 1.0], front)
    return Outcome(
        estimate=Estimate(pose, estimate.landmark * scale, states),
        states_covariance=covariance,
        prior=prior,
        p_needed=p_needed,
        askew=(askew[0], askew[1]),
        smoother=smoother,
        graph_estimate=estimate,
        graph_marginals=marginals if others else smoother.counted(estimate, marginals),
        fit_marginals=marginals,
        noise=noise,
        inlier=smoother.inlier_probability(estimate),
        scale=scale,
        log_scale_sigma=log_sigma,
        aligned=aligned,
        revision=revision,
    )


def sight_at(pose: FloatArray, reading: FloatArray, states: FloatArray, mount: FloatArray) -> FloatArray:
    """Return positions (..., 2) that readings (..., 2) of range and bearing from poses (..., 3) point to.

    The range law is inverted at the corrected bearing.
    """
    bearing = reading[..., 1] - states[4]
    gain = 1.0 + states[1] + states[2] * bearing + states[3] * bearing**2
    range_m = (reading[..., 0] - states[0]) / gain
    in_sensor = np.stack([range_m * np.cos(bearing), range_m * np.sin(bearing)], axis=-1)
    return se2.transform(se2.compose(pose, seat_sensor(mount, states)), in_sensor)


def voted(smoother: Smoother, estimate: Estimate, fewest: int) -> Slices[Estimate]:
    """Return what `outvote` does, by the weights that the detections have there."""
    now = yield from smoother.linearise_in_slices(estimate)
    return outvote(smoother.problem, estimate, now.weights[DETECTIONS], fewest)


def _rejoin(smoother: Smoother, estimate: Estimate, settings: SlamConfig) -> Estimate:
    """Return a better optimum where the odometry was silent, if the landmarks that both sides saw lead to one.

    After a silence the robot may be anywhere: sightings that disagree with where it was taken to go on look like
    outliers. Each piece is laid over the rest, and all that follows over all before, as most landmarks have it.
    """
    problem = smoother.problem
    loose = silent_links(problem, estimate, settings.odometry.loose_rad)
    breaks = np.flatnonzero(loose & ~np.append(loose[1:], False))[:MOST_BREAKS] + 1
    ends = [*breaks.tolist(), len(estimate.pose)]
    tried = {(first, last) for first, end in pairwise(ends) for last in (end, len(estimate.pose))}
    cost = smoother.cost(estimate)
    for first, last in sorted(tried):
        piece = (problem.pose_row >= first) & (problem.pose_row < last)
        at = sight_at(estimate.pose[problem.pose_row], problem.reading, estimate.states, problem.mount)
        mine, theirs = (
            middles(problem.landmark_row[some], at[some], len(estimate.landmark)) for some in (piece, ~piece)
        )
        both = np.flatnonzero(np.isfinite(mine[:, 0]) & np.isfinite(theirs[:, 0]))
        motion, agree = find_consensus(Matches.of(mine[both], theirs[both]))
        if np.count_nonzero(agree) < settings.localize.fewest or not np.any(np.abs(motion) > ELSEWHERE):
            continue
        pose, landmark = estimate.pose.copy(), estimate.landmark.copy()
        pose[first:last] = se2.compose(motion, pose[first:last])
        alone = np.isfinite(mine[:, 0]) & ~np.isfinite(theirs[:, 0])
        landmark[alone] = se2.transform(motion, mine[alone])
        landmark[both] = theirs[both]
        try:
            other = smoother.optimum(Estimate(pose, landmark, estimate.states), tolerance=NEAR)
        except NumericalError:
            continue
        if smoother.cost(other) < cost - COST_SLACK:
            estimate, cost = other, smoother.cost(other)
    return estimate


def _readmit(smoother: Smoother, estimate: Estimate, settings: SlamConfig, tried: BoolArray | None = None) -> Estimate:
    """Return a better optimum where a landmark was rejected several times in a row, if narrowing noise leads to one.

    Where odometry alone led astray, the sightings that contradict it are rejected together, and none of them can pull
    back. To noise that is many times wider few of them are outliers; it narrows to what it is (graduated
    non-convexity: Yang et al. 2020, "Graduated Non-Convexity for Robust Spatial Perception"). Those (M,) that were
    `tried` before, and are rejected all the same, are no reason to try again.
    """
    problem = smoother.problem
    rejected = smoother.inlier_probability(estimate) < 0.5
    if tried is not None:
        rejected &= ~tried
    if not _in_a_row(problem, rejected, settings.rejected_in_a_row):
        return estimate
    cost, other = smoother.cost(estimate), estimate
    try:
        for times in settings.narrowing:
            noise = replace(smoother.noise, detection=times * smoother.noise.detection)
            wider = replace(problem, sigma_given=times * problem.sigma_given)
            other = smoother.under(noise, heavy=False, problem=wider).optimum(other, tolerance=NEAR)
        other = smoother.optimum(other, tolerance=NEAR)
    except NumericalError:
        return estimate
    return other if smoother.cost(other) < cost - COST_SLACK else estimate


def _in_a_row(problem: Problem, rejected: BoolArray, count: int) -> bool:
    """Return whether so many sightings of one landmark in a row are rejected; those of a pose in any order."""
    order = np.lexsort((problem.pose_row, problem.landmark_row))
    row, out = problem.landmark_row[order], rejected[order]
    if len(out) < count:
        return False
    together: BoolArray = np.all(sliding_window_view(out, count), axis=1)
    return bool(np.any(together & (row[count - 1 :] == row[: len(together)])))


def silent_links(problem: Problem, estimate: Estimate, loose_rad: float) -> BoolArray:
    """Return (N - 1,) intervals between poses in which the odometry was silent, and leaves a heading unknown."""
    floor = problem.drive.between(problem.stamp_s, estimate.states).floor
    return np.asarray(floor[:, 2, 2] > loose_rad**2)


def middles(row: IntArray, at: FloatArray, count: int) -> FloatArray:
    """Return (L, 2) medians of positions (M, 2) of landmarks (M,); nan of those with none."""
    middle, many = np.full((count, 2), np.nan), np.bincount(row, minlength=count)
    seen = np.flatnonzero(many)
    first = np.cumsum(many)[seen] - many[seen]
    for axis in range(at.shape[1]):
        ordered = at[np.lexsort((at[:, axis], row)), axis]
        middle[seen, axis] = 0.5 * (ordered[first + (many[seen] - 1) // 2] + ordered[first + many[seen] // 2])
    return middle


def outvote(problem: Problem, estimate: Estimate, weights: FloatArray, fewest: int) -> Estimate:
    """Move landmarks to the median of their sightings where most sightings disagree with them.

    A landmark whose first sighting carried the wrong identity starts in the wrong place, from where all right
    sightings look like outliers. At least `fewest` vote, by inlier weights (M,); ranges without a bearing have no vote.
    """
    votes = problem.has_bearing
    sightings = np.bincount(problem.landmark_row, weights=votes, minlength=len(estimate.landmark))
    agreeing = np.bincount(problem.landmark_row, weights=votes & (weights > 0.5), minlength=len(estimate.landmark))
    # a vote would only set a landmark of a prior map against that map
    disputed: BoolArray = (sightings >= fewest) & (agreeing < 0.5 * sightings) & ~problem.mapped
    if not disputed.any():
        return estimate
    theirs = problem.seeing(disputed[problem.landmark_row] & votes)
    at = sight_at(estimate.pose[theirs.pose_row], theirs.reading, estimate.states, problem.mount)
    middle = middles(theirs.landmark_row, at, len(disputed))
    return replace(estimate, landmark=np.where(disputed[:, None], middle, estimate.landmark))
