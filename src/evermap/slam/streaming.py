"""Landmark SLAM of one recording, frame after frame.

Every frame is predicted from odometry, compared with the map (innovations), and added to the filter.
Whenever the number of poses has doubled, the batch smoother relinearises: it finds the optimum of all so far,
re-estimates the noise levels and hands both back, so the whole costs a constant factor more than the increments. A
method decides which places detections belong to: of a frame before it is used, and of all at relinearisations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count as counted
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from evermap.config import SlamConfig
from evermap.errors import NumericalError
from evermap.estimate.sparse.system import Slices, exhausted
from evermap.geometry import se2
from evermap.geometry.rigid import consensus
from evermap.slam.calibration import CalibrationPrior, needed, seated
from evermap.slam.filter_kernels import told
from evermap.slam.kernels import N_STATES
from evermap.slam.local_filter import Motion, SessionFilter, grown
from evermap.slam.method import Explanation, Method, Static
from evermap.slam.noise import Extrapolation, NoiseFit, refine_noise
from evermap.slam.problem import Drive, Estimate, Marginals, Noise, Problem, independent
from evermap.slam.smoother import COST_SLACK, DETECTIONS, Smoother
from evermap.types import BoolArray, FloatArray, IntArray

USUAL = SlamConfig()
FIRST_RELINEARISATION = 40
"""Poses before the batch smoother relinearises for the first time."""
SHORTEST_SPELL = 5
LONGEST_SPELL = 1 / 8
"""Poses between two relinearisations: a share of all poses, so that the whole costs a constant factor, but some."""
SETTLED_AT, SETTLED_SPELL = 2000, 1 / 2
"""Poses from which most of what is new lies where nothing was before, and the share from then on."""
DISPUTED_AT = (2, 4, 8, 16)
"""Comparisons of a landmark after which it is asked whether most of them were surprising."""
ALIGNED_INFORMATION = 1e-2
"""Once in a prior map the first pose is free: held to 10 m only, so that the linear system stays well conditioned."""
FINAL_ROUNDS = 12
MOST_BREAKS = 8
"""Silences of the odometry after which the parts are laid over each other."""
ELSEWHERE = 0.1
"""Motion (m or rad) of a part that the optimum near it does not take back."""
SLICES_A_FRAME = 3.0
"""Work on a relinearisation in every frame, in milliseconds of a usual core."""
CAUGHT_UP_MS, OF_PAIR_MS = 0.15, 5e-4
"""What a frame takes that is processed again, and each pair of its detections, as far as two of them fit in a frame."""
STEPS_A_ROUND = 4
"""Gauss-Newton steps of a relinearisation, or between two estimates of the noise, at most."""
NEAR, NEAR_NOISE = 0.02, 1e-4
"""Step (m, rad or 1) after which the stream goes on, or learns noise: the next step would be far smaller."""
FINAL_TOLERANCE, FINAL_GAIN = 1e-5, 1e-3
"""Step (m, rad or 1), or what it gains (nats), at which the final optimum is reached."""
NEAR_NOISE_GAIN = 1e-4
"""Or what a step gains (nats) for each detection: by so little do noise levels change with it."""
NOISE_NEAR, NOISE_CONVERGED = 0.05, 0.01
"""Relative change of every noise level below which it is decided what is an outlier, and the final rounds stop."""
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
        problem: with the start and priors that the optimum belongs to, in the graph's metres.
        graph_estimate, graph_marginals: values and covariances as the graph holds them, before the scale was divided.
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
    problem: Problem
    graph_estimate: Estimate
    graph_marginals: Marginals
    noise: NoiseFit
    inlier: FloatArray
    scale: float
    log_scale_sigma: float
    aligned: bool
    revision: Explanation


class StreamingSlam:
    """Feed poses in order with `step`, then `finish`.

    Nothing of the problem beyond the current row is looked at, but odometry up to the delay. `noise` is where the noise
    levels start, `prior` are calibration priors as the user means them. Without a `prior_map` it maps from scratch,
    without a `method` it takes the world to be static.
    """

    def __init__(
        self,
        problem: Problem,
        noise: Noise,
        prior: CalibrationPrior,
        *,
        prior_map: PriorMap | None = None,
        settings: SlamConfig = USUAL,
        method: Method | None = None,
    ) -> None:
        self._prior = prior
        self._prior_map = prior_map
        self._problem = replace(problem, prior=prior.without_scale())
        self._start_noise = self._noise = noise
        self._settings, self._robust, self._estimate_noise = settings, settings.robust, settings.estimate_noise
        self._method = Static(len(problem.landmark_mean)) if method is None else method
        self._filter = SessionFilter(self._problem, noise, robust=settings.robust)
        self._job: Slices[None] | None = None
        self._owed_ms = 0.0
        self._disputed = False
        self._landmark = np.full((len(problem.landmark_mean), 2), np.nan)
        self._n_compared = np.zeros(len(problem.landmark_mean), dtype=np.int64)
        self._n_surprising = np.zeros(len(problem.landmark_mean), dtype=np.int64)
        self._n_poses = 0
        self._next_relinearisation = FIRST_RELINEARISATION
        self._relinearised_at = 0
        self._align_tried = 0
        self._scale = 1.0
        self._aligned = False
        self.online_pose = np.full((len(problem.stamp_s), 3), np.nan)
        """(N, 3) causal poses, as soon as each frame was processed."""
        self.online_covariance = np.full((len(problem.stamp_s), 3, 3), np.nan)
        """(N, 3, 3) covariance of each, at the time."""
        self.nis = np.full(len(problem.pose_row), np.nan)
        """(M,) squared Mahalanobis distance of every innovation; nan where the landmark was new."""

    def step(self, *, later: bool = False) -> None:
        """Process the next pose: predict, compare, add, and relinearise when it is time.

        Args:
            later: leave what the frame owes to a relinearisation to `work`, or to the next step: the frames that follow
                are the same, while the pose of this one is told before the stream may go on at another optimum.
        """
        self.work()
        row = self._n_poses
        detections = self._problem.detections_of(row)
        if row > 0:
            self._filter.drive(self._filter.motion(row))
        self._assign(row, detections)
        if row > 0:
            self._compare(detections)
        self._meet_new_landmarks(self._filter, self._landmark, detections)
        self._filter.add(row, self._landmark)
        self._n_poses += 1
        self._plan(detections)
        self._owed_ms = self._a_frame_ms()
        if not later:
            self.work()
        if self._prior_map is not None and not self._aligned and self._can_align():
            self._enter_map()
        self.online_pose[row], self.online_covariance[row] = self._told(self._filter.pose, self._filter.covariance)

    def _told(self, pose: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A pose and its covariance in metres, of the robot's front, in the frame of the first one or of the map."""
        front = self._prior.front(self._filter.states, self._problem.mount)
        return told(pose, covariance, front, self._scale, self._aligned)

    @property
    def states(self) -> FloatArray:
        """(11,) present calibration states."""
        return self._filter.states.copy()

    def ahead(self, stamp_s: float, drive: Drive) -> tuple[FloatArray, FloatArray]:
        """Return the pose (3,) at a later instant by odometry alone, as `online_pose`, and its covariance (3, 3)."""
        problem, states = self._problem, self._filter.states
        last_s, free = problem.stamp_s[self._n_poses - 1], problem.prior.free
        motion = Motion.over(drive, last_s, stamp_s, states, free, self._noise)
        return self._told(*self._filter.ahead(motion))

    def places(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return (k, 2) where landmarks of the newest pose are, in the frame of `online_pose`, and (k, 2, 2)."""
        front = self._prior.front(self._filter.states, self._problem.mount)
        back = np.zeros(3) if self._aligned else se2.inverse(front)
        turn = se2.rotation(float(back[2]))
        covariance = turn @ self._filter.spread(rows) @ turn.T
        return se2.transform(back, self._filter.position[rows]) * self._scale, covariance * self._scale**2

    def grow(self, problem: Problem) -> None:
        """Take measurements of further poses: of a robot that drives, in a static world and without a prior map.

        Args:
            problem: all so far; rows that were there stay, new landmarks come last.
        """
        poses, detections = len(self.online_pose), len(self.nis)
        if len(problem.stamp_s) > poses:  # room for as many again: a frame must not cost what was before it
            room = max(len(problem.stamp_s), 2 * poses)
            self.online_pose = grown(self.online_pose, room)
            self.online_covariance = grown(self.online_covariance, room)
        if len(problem.pose_row) > detections:
            self.nis = grown(self.nis, max(len(problem.pose_row), 2 * detections))
        landmark = grown(self._landmark, len(problem.landmark_mean))
        self._adopt(replace(problem, prior=self._problem.prior), landmark)
        self._filter.problem = self._problem

    def _plan(self, detections: IntArray) -> None:
        """Begin to relinearise if it is time."""
        self._disputed |= self._robust and self._is_disputed(detections)
        since = self._n_poses - self._relinearised_at
        share = LONGEST_SPELL if self._n_poses < SETTLED_AT else SETTLED_SPELL
        if self._n_poses == self._next_relinearisation:
            self._job = self._relinearised(learn=True)
            self._next_relinearisation *= 2
        elif self._disputed and self._job is None:
            self._job, self._disputed = self._relinearised(learn=True), False
        elif self._job is None and since >= max(SHORTEST_SPELL, int(share * self._relinearised_at)):
            self._job = self._relinearised(learn=False)

    def _a_frame_ms(self) -> float:
        """Work on a relinearisation in a frame: a few slices, or all of it where it may change places."""
        return np.inf if self._job is not None and self._method.revises(self._problem) else SLICES_A_FRAME

    def work(self, most_ms: float = np.inf) -> None:
        """Advance a relinearisation by what the last frame owes to it, up to the slice that reaches `most_ms`."""
        done_ms = 0.0
        while self._job is not None and done_ms < min(self._owed_ms, most_ms):
            try:
                done_ms += next(self._job)
            except StopIteration:
                self._job = None
        self._owed_ms -= done_ms

    def finish(self) -> Outcome:
        """Smooth everything processed so far, with noise levels iterated to convergence, and divide the scale."""
        self.work()
        if self._prior_map is not None and not self._aligned and self._can_align(final=True):
            self._enter_map()
        self._job = None
        problem, estimate = self._method.unprejudiced(self._problem.until(self._n_poses), self._filter.estimate())
        if self._robust:  # a landmark whose first sighting was misread may be disputed since the last relinearisation
            smoother = Smoother(problem, self._noise, heavy=True)
            estimate = exhausted(_voted(smoother, estimate, self._settings.fewest_sightings))
        smoother, estimate, fit = self._converged(problem, estimate, self._noise)
        if self._robust:
            better = _readmitted(smoother, _rejoined(smoother, estimate, self._settings), self._settings)
            if better is not estimate:
                smoother, estimate, fit = self._converged(problem, better, fit.noise)
        problem, estimate = self._ahead(problem, estimate)
        for _ in range(FINAL_REVISIONS):
            revision = self._method.revise(problem, estimate, fit.noise, heavy=False, final=True)
            if revision.problem is problem:
                break
            problem = revision.problem
            smoother, estimate, fit = self._converged(problem, revision.estimate, fit.noise)
        # near enough to tell which states are needed; then all of them are sought together
        smoother, estimate, marginals = self._optimum(smoother, problem, estimate, fit, most=1)
        problem, worth = smoother.problem, smoother.worth(estimate, marginals)
        p_needed = needed(problem.prior, estimate.states, marginals.states, worth)
        if not np.all(np.isnan(p_needed)):
            prior, states = problem.prior.averaged(p_needed, estimate.states, np.diag(marginals.states), worth)
            problem, estimate = replace(problem, prior=prior), replace(estimate, states=states)
            smoother, estimate, fit = self._converged(problem, estimate, fit.noise, near=smoother)
            if self._robust:  # means may lie so far from the estimate that true sightings are rejected on the way
                better = _readmitted(smoother, estimate, self._settings)
                if better is not estimate:
                    smoother, estimate, fit = self._converged(problem, better, fit.noise, near=smoother)
        solved = self._optimum(smoother, problem, estimate, fit)
        return divided(solved, self._prior, p_needed, fit, revision, aligned=self._aligned)

    def _ahead(self, problem: Problem, estimate: Estimate) -> tuple[Problem, Estimate]:
        """Return the same, rotated so that the first pose has the robot's front ahead, unless it is in a map."""
        front = self._prior.front(estimate.states, problem.mount)
        start = problem.start_pose if self._aligned else se2.inverse(front)
        if np.array_equal(start, problem.start_pose):
            return problem, estimate
        turn = se2.compose(start, se2.inverse(problem.start_pose))
        return replace(problem, start_pose=start), estimate.moved(turn)

    def _optimum(
        self, smoother: Smoother, problem: Problem, estimate: Estimate, fit: NoiseFit, *, most: int = 30
    ) -> tuple[Smoother, Estimate, Marginals]:
        """The final optimum at the noise that was found, after so many steps at most, and its covariances."""
        problem, estimate = self._ahead(problem, estimate)
        smoother = smoother.under(fit.noise, heavy=False, problem=problem)
        solved = smoother.solved_in_slices(estimate, iterations=most, tolerance=FINAL_TOLERANCE, settled=FINAL_GAIN)
        return smoother, *exhausted(solved)

    def _converged(
        self, problem: Problem, estimate: Estimate, noise: Noise, near: Smoother | None = None
    ) -> tuple[Smoother, Estimate, NoiseFit]:
        """The optimum and its noise levels from these values, in turns until neither changes.

        Where the smoother `near`, of the same problem but for its prior, found them, it is known what is an outlier.
        """
        fit, ahead = None, Extrapolation()
        smoother = Smoother(problem, noise, robust=self._robust) if near is None else near
        heavy = near is None  # come close with the kernel that never lets go, then decide what is an outlier
        steps, settled = STEPS_A_ROUND, NEAR_NOISE_GAIN * len(problem.pose_row)
        for round_ in range(FINAL_ROUNDS):
            smoother = smoother.under(noise, heavy=heavy, problem=problem)
            # values and noise levels settle together: no need for the optimum of levels that will not stay
            solved = smoother.solved_in_slices(estimate, iterations=steps, tolerance=NEAR_NOISE, settled=settled)
            estimate, marginals = exhausted(solved)
            weights = smoother.inlier_probability(estimate)
            fit = refine_noise(problem, estimate, marginals, weights, noise, self._start_noise)
            before, steps = noise, 1
            if self._estimate_noise:
                noise = fit.noise if heavy else ahead.ahead(noise, fit.noise)
            if heavy:
                heavy = round_ == 0 and not levels_settled(before, noise, NOISE_NEAR)
                steps = 1 if heavy else STEPS_A_ROUND
            elif levels_settled(before, fit.noise, NOISE_CONVERGED) or not self._estimate_noise:
                noise = fit.noise if self._estimate_noise else noise
                break
        assert fit is not None
        return smoother, estimate, replace(fit, noise=noise)

    def _assign(self, row: int, detections: IntArray) -> None:
        """Ask the method for the places of the coming pose's detections."""

        def distances(of: IntArray, places: IntArray) -> tuple[FloatArray, FloatArray]:
            squared, log_volume = np.full((2, len(of)), np.nan)
            known = np.isfinite(self._landmark[places, 0])
            if row > 0 and known.any():
                squared[known], log_volume[known] = self._filter.distances(of[known], places[known])
            return squared, log_volume

        before = self._problem.landmark_row[detections]
        places = self._method.assign(self._problem, row, detections, distances)
        if not np.count_nonzero(places != before):
            return
        landmark_row = self._problem.landmark_row.copy()
        landmark_row[detections] = places
        count = max(len(self._landmark), int(places.max()) + 1)
        problem = replace(self._problem, landmark_row=landmark_row).with_places(count)
        self._adopt(problem, grown(self._landmark, count))
        self._filter.problem = self._problem

    def _adopt(self, problem: Problem, landmark: FloatArray) -> None:
        """Other places from here on, perhaps more of them or fewer; the first are the landmarks as before."""
        count = len(landmark)
        self._problem, self._landmark = problem, landmark
        self._n_compared = grown(self._n_compared, count, 0)[:count]
        self._n_surprising = grown(self._n_surprising, count, 0)[:count]

    def _compare(self, detections: IntArray) -> None:
        landmark = self._problem.landmark_row[detections]
        known = np.isfinite(self._landmark[landmark, 0])
        if np.count_nonzero(known) < len(known):
            detections, landmark = detections[known], landmark[known]
        if not len(detections):
            return
        nis, _ = self._filter.distances(detections, landmark)
        self.nis[detections] = nis
        np.add.at(self._n_compared, landmark, 1)
        surprising = nis > self._settings.votes.surprising
        if np.count_nonzero(surprising):
            np.add.at(self._n_surprising, landmark[surprising], 1)

    def _is_disputed(self, detections: IntArray) -> bool:
        """True where a young landmark surprises at most of its sightings: its first may have been another's."""
        seen = self._problem.landmark_row[detections]
        if not np.count_nonzero(self._n_surprising[seen]):
            return False
        doubted = seen[2 * self._n_surprising[seen] > self._n_compared[seen]]
        mapped = self._problem.mapped  # the map is believed: no vote moves its landmarks
        return any(not mapped[j] and self._n_compared[j] in DISPUTED_AT for j in doubted)

    def _meet_new_landmarks(self, running: SessionFilter, landmark: FloatArray, detections: IntArray) -> None:
        """Initialise landmarks that are seen for the first time: from the map, or from this sighting."""
        new = np.isnan(landmark[self._problem.landmark_row[detections], 0])
        for m in detections[new] if np.count_nonzero(new) else ():
            j = self._problem.landmark_row[m]
            if np.isfinite(landmark[j, 0]):  # twice in this frame
                continue
            if self._problem.mapped[j]:
                prior = self._problem.conditional_prior(j, np.isfinite(landmark[:, 0]))
                landmark[j] = prior.place(landmark, self._problem.landmark_mean)
            else:
                reading, mount = self._problem.reading[m], self._problem.mount
                landmark[j] = sighted_at(running.pose, reading, running.states, mount)

    def _relinearised(self, *, learn: bool) -> Slices[None]:
        """Relinearise all poses so far in parallel to the stream, catch up with it, and take over.

        With `learn`, also vote on places, ask the method, and learn the noise.
        """
        self._relinearised_at = n = self._n_poses
        problem, estimate = self._problem.until(n), self._filter.estimate()
        smoother = Smoother(problem, self._noise, heavy=True, robust=self._robust)
        if learn and self._robust:
            voted = yield from _voted(smoother, estimate, self._settings.fewest_sightings)
            # what was compared with a place that was never the landmark's own says nothing about consistency
            misplaced = np.any(voted.landmark != estimate.landmark, axis=1) & estimate.known
            self.nis[: len(problem.pose_row)][misplaced[problem.landmark_row]] = np.nan
            estimate = voted
        estimate, marginals = yield from smoother.solved_in_slices(
            estimate, iterations=STEPS_A_ROUND, tolerance=NEAR_NOISE if learn else NEAR
        )
        if learn and self._method.revises(problem):
            revision = self._method.revise(problem, estimate, self._noise, heavy=True, final=False)
            if revision.problem is not problem:
                problem, estimate = revision.problem, revision.estimate
                smoother = Smoother(problem, self._noise, heavy=True, robust=self._robust)
                marginals = yield from smoother.marginals_in_slices(estimate)
                coming = self._problem.landmark_row[len(problem.landmark_row) :]
                whole = replace(
                    self._problem,
                    landmark_row=np.append(problem.landmark_row, coming),
                    landmark_mean=problem.landmark_mean,
                    landmark_information=problem.landmark_information,
                )
                self._adopt(whole, estimate.landmark)
        if learn and self._estimate_noise:
            yield from marginals.in_slices()
            weights = smoother.inlier_probability(estimate)
            fit = refine_noise(problem, estimate, marginals, weights, self._noise, self._start_noise)
            self._noise = fit.noise
            smoother = smoother.under(self._noise, heavy=True)
        marginals = yield from smoother.marginals_in_slices(estimate)
        if learn:
            unknown = np.zeros((N_STATES, N_STATES))
            self._scale = 1.0 if self._aligned else self._prior.split_scale(estimate.states, unknown)[2]
        following = SessionFilter(self._problem, self._noise, robust=self._robust)
        following.restart(estimate, self._noise, self._problem, marginals)
        yield 1.0
        landmark = estimate.landmark.copy()
        for row in counted(n):
            following.problem = self._problem
            landmark = grown(landmark, len(self._problem.landmark_mean))
            if row == self._n_poses:
                break
            following.drive(following.motion(row))
            detections = self._problem.detections_of(row)
            self._meet_new_landmarks(following, landmark, detections)
            following.add(row, landmark)
            yield min(CAUGHT_UP_MS + OF_PAIR_MS * len(detections) ** 2, 0.5 * SLICES_A_FRAME)
        self._filter, self._landmark = following, landmark

    def _can_align(self, *, final: bool = False) -> bool:
        """Return whether most landmarks of the map seen so far have its relative positions; two at the end."""
        assert self._prior_map is not None
        both = self._prior_map.given & np.isfinite(self._landmark[: len(self._prior_map.given), 0])
        count = int(both.sum())
        settings = self._settings.localize
        if count < (2 if final else settings.fewest):
            return False
        if count == self._align_tried and not final:  # nothing new has been seen since
            return False
        self._align_tried = count
        at = self._prior_map.mean[both]
        _, agree = consensus(self._filter.estimate().landmark[: len(both)][both], at)
        if final:
            return bool(agree.sum() >= 2)
        enough = agree.sum() >= settings.fewest and 2 * agree.sum() > count
        return bool(enough and np.ptp(at[agree], axis=0).max() >= settings.spread_m)

    def _enter_map(self) -> None:
        """Move the estimate from the first pose's frame into the prior map's, then constrain it by the map."""
        prior_map = self._prior_map
        assert prior_map is not None
        estimate = self._filter.estimate()
        new = len(estimate.landmark) - len(prior_map.given)  # places that landmarks have besides their own
        mean, given = np.pad(prior_map.mean, ((0, new), (0, 0))), np.pad(prior_map.given, (0, new))
        both = given & estimate.known
        pose_map_world, _ = consensus(estimate.landmark[both], mean[both])
        moved = estimate.moved(pose_map_world)
        moved = replace(moved, landmark=np.where(both[:, None], mean, moved.landmark))
        self._aligned, self._scale = True, 1.0
        self._problem = replace(
            self._problem,
            prior=self._prior,
            start_pose=moved.pose[0],
            start_information=ALIGNED_INFORMATION,
            landmark_mean=np.where(given[:, None], mean, 0.0),
            landmark_information=independent(np.pad(prior_map.information, ((0, new), (0, 0), (0, 0)))),
        )
        done = self._n_poses
        self.online_pose[:done] = se2.compose(pose_map_world, self.online_pose[:done])
        self._landmark = moved.landmark.copy()
        self._filter.restart(moved, self._noise, self._problem)
        self._job = self._relinearised(learn=True)
        self._owed_ms = self._a_frame_ms()
        self.work()


def divided(
    solved: tuple[Smoother, Estimate, Marginals],
    prior: CalibrationPrior,
    p_needed: FloatArray,
    noise: NoiseFit,
    revision: Explanation,
    *,
    aligned: bool,
    others: tuple[tuple[float, float, float], ...] = (),
) -> Outcome:
    """Return what a session knows at its optimum, with what only shows together divided as its sensor states it.

    `solved` is the final optimum in the graph's metres, `prior` as the user means it, the rest as in `Outcome`;
    `others` is what other robots say of its lengths (`CalibrationPrior.metre`).
    """
    smoother, estimate, marginals = solved
    believed, worth = prior, smoother.worth(estimate, marginals)
    prior = prior.spared(p_needed)
    covariance = marginals.states * np.sqrt(np.outer(worth, worth))
    covariance += np.diag(prior.doubt(p_needed, estimate.states))
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
        problem=smoother.problem,
        graph_estimate=estimate,
        graph_marginals=marginals if others else smoother.counted(estimate, marginals),
        noise=noise,
        inlier=smoother.inlier_probability(estimate),
        scale=scale,
        log_scale_sigma=log_sigma,
        aligned=aligned,
        revision=revision,
    )


def levels_settled(before: Noise, after: Noise, within: float) -> bool:
    """Return whether no noise level changed by more than this share of itself."""
    return bool(np.all(np.abs(after.levels / before.levels - 1.0) < within))


def sighted_at(pose: FloatArray, reading: FloatArray, states: FloatArray, mount: FloatArray) -> FloatArray:
    """Return positions (..., 2) that readings (..., 2) of range and bearing from poses (..., 3) point to.

    The range law is inverted at the corrected bearing.
    """
    bearing = reading[..., 1] - states[4]
    gain = 1.0 + states[1] + states[2] * bearing + states[3] * bearing**2
    range_m = (reading[..., 0] - states[0]) / gain
    in_sensor = np.stack([range_m * np.cos(bearing), range_m * np.sin(bearing)], axis=-1)
    return se2.transform(se2.compose(pose, seated(mount, states)), in_sensor)


def _voted(smoother: Smoother, estimate: Estimate, fewest: int) -> Slices[Estimate]:
    """Return what `outvoted` does, by the weights that the detections have there."""
    now = yield from smoother.linearised_in_slices(estimate)
    return outvoted(smoother.problem, estimate, now.weights[DETECTIONS], fewest)


def _rejoined(smoother: Smoother, estimate: Estimate, settings: SlamConfig) -> Estimate:
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
        at = sighted_at(estimate.pose[problem.pose_row], problem.reading, estimate.states, problem.mount)
        mine, theirs = (
            middles(problem.landmark_row[some], at[some], len(estimate.landmark)) for some in (piece, ~piece)
        )
        both = np.flatnonzero(np.isfinite(mine[:, 0]) & np.isfinite(theirs[:, 0]))
        motion, agree = consensus(mine[both], theirs[both])
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


def _readmitted(smoother: Smoother, estimate: Estimate, settings: SlamConfig) -> Estimate:
    """Return a better optimum where a landmark was rejected several times in a row, if narrowing noise leads to one.

    Where odometry alone led astray, the sightings that contradict it are rejected together, and none of them can pull
    back. To noise that is many times wider few of them are outliers; it narrows to what it is (graduated
    non-convexity: Yang et al. 2020, "Graduated Non-Convexity for Robust Spatial Perception").
    """
    problem = smoother.problem
    if not _in_a_row(problem, smoother.inlier_probability(estimate) < 0.5, settings.rejected_in_a_row):
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
    middle = np.full((count, 2), np.nan)
    for j in np.unique(row):
        middle[j] = np.median(at[row == j], axis=0)
    return middle


def outvoted(problem: Problem, estimate: Estimate, weights: FloatArray, fewest: int) -> Estimate:
    """Move landmarks to the median of their sightings where most sightings disagree with them.

    A landmark whose first sighting carried the wrong identity starts in the wrong place, from where all right
    sightings look like outliers. At least `fewest` vote, by inlier weights (M,).
    """
    sightings = np.bincount(problem.landmark_row, minlength=len(estimate.landmark))
    agreeing = np.bincount(problem.landmark_row, weights=weights > 0.5, minlength=len(estimate.landmark))
    # a vote would only set a landmark of a prior map against that map
    disputed: BoolArray = (sightings >= fewest) & (agreeing < 0.5 * sightings) & ~problem.mapped
    if not disputed.any():
        return estimate
    theirs = problem.seeing(disputed[problem.landmark_row])
    at = sighted_at(estimate.pose[theirs.pose_row], theirs.reading, estimate.states, problem.mount)
    middle = middles(theirs.landmark_row, at, len(disputed))
    return replace(estimate, landmark=np.where(disputed[:, None], middle, estimate.landmark))
