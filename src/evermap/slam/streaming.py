"""Landmark SLAM of one recording, frame after frame.

Every frame is predicted from odometry, compared with the map (innovations), and added to the filter.
Whenever the number of poses has doubled, the batch smoother relinearises: it finds the optimum of all so far,
re-estimates the noise levels and hands both back, so the whole costs a constant factor more than the increments. A
method decides which places detections belong to: of a frame before it is used, and of all at relinearisations.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import count as counted

import numpy as np

from evermap.config import SlamConfig
from evermap.estimate.measurement import Tied
from evermap.estimate.sparse.system import Slices
from evermap.geometry import se2
from evermap.slam.batch import (
    NEAR,
    NEAR_NOISE,
    STEPS_A_ROUND,
    USUAL,
    Batch,
    Outcome,
    PriorMap,
    SolvedPart,
    entered,
    lay_over,
    sight_at,
    voted,
)
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.kernels import N_STATES
from evermap.slam.method import Method, Static
from evermap.slam.nearby_places import grown
from evermap.slam.noise import refine_noise
from evermap.slam.planar_filter import PlanarMotion, SessionFilter, told
from evermap.slam.problem import Drive, Estimate, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.types import FloatArray, IntArray

FIRST_RELINEARISATION = 40
"""Poses before the batch smoother relinearises for the first time."""
SHORTEST_SPELL = 5
LONGEST_SPELL = 1 / 8
"""Poses between two relinearisations: a share of all poses, so that the whole costs a constant factor, but some."""
SETTLED_AT, SETTLED_SPELL = 2000, 1 / 2
"""Poses from which most of what is new lies where nothing was before, and the share from then on."""
DISPUTED_AT = (2, 4, 8, 16)
"""Comparisons of a landmark after which it is asked whether most of them were surprising."""
SLICES_A_FRAME = 3.0
"""Work on a relinearisation in every frame, in milliseconds of a usual core."""
CAUGHT_UP_MS, OF_PAIR_MS = 0.15, 5e-4
"""What a frame takes that is processed again, and each pair of its detections, as far as two of them fit in a frame."""


class StreamingSlam:
    """Feed poses in order with `step`, then `finish`.

    Nothing of the problem beyond the current row is looked at, but odometry up to the delay. `noise` is where the noise
    levels start, `prior` are calibration priors as the user means them. Without a `prior_map` it maps from scratch,
    without a `method` it takes the world to be static. Where it is not `paced`, as nobody waits for a frame, the stream
    goes on from the relinearisation in the frame in which that begins: then no constant of the pace changes a result.
    """

    def __init__(
        self,
        problem: Problem,
        noise: Noise,
        prior: CalibrationPrior,
        *,
        prior_map: PriorMap | None = None,
        framed: tuple[Tied, ...] = (),
        settings: SlamConfig = USUAL,
        method: Method | None = None,
        paced: bool = True,
    ) -> None:
        self._prior, self._paced = prior, paced
        self._prior_map, self._framed = prior_map, framed
        self._problem = replace(problem, prior=prior.without_scale())
        self._start_noise = self._noise = noise
        self._settings, self._robust, self._estimate_noise = settings, settings.robust, settings.estimate_noise
        self._method = Static(len(problem.landmark_mean)) if method is None else method
        self._named = problem.landmark_row
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
        if self._prior_map is not None and not self._aligned:
            self._lay_over_map()
        self.online_pose[row], self.online_covariance[row] = self._report_pose(
            self._filter.pose, self._filter.covariance
        )

    def _report_pose(self, pose: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
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
        motion = PlanarMotion.over(drive, last_s, stamp_s, states, free, self._noise)
        return self._report_pose(*self._filter.ahead(motion))

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
        poses = len(self.online_pose)
        if len(problem.stamp_s) > poses:  # room for as many again: a frame must not cost what was before it
            room = max(len(problem.stamp_s), 2 * poses)
            self.online_pose = grown(self.online_pose, room)
            self.online_covariance = grown(self.online_covariance, room)
        landmark = grown(self._landmark, len(problem.landmark_mean))
        self._adopt(replace(problem, prior=self._problem.prior), landmark)
        self._named = problem.landmark_row
        self._filter.problem = self._problem

    def _plan(self, detections: IntArray) -> None:
        """Begin to relinearise if it is time."""
        self._disputed |= self._robust and self._is_disputed(detections)
        since = self._n_poses - self._relinearised_at
        share = LONGEST_SPELL if self._n_poses < SETTLED_AT else SETTLED_SPELL
        if self._n_poses == self._next_relinearisation:
            self._job = self._relinearise(learn=True)
            self._next_relinearisation *= 2
        elif self._disputed and self._job is None:
            self._job, self._disputed = self._relinearise(learn=True), False
        elif self._job is None and since >= max(SHORTEST_SPELL, int(share * self._relinearised_at)):
            self._job = self._relinearise(learn=False)

    def _a_frame_ms(self) -> float:
        """Work on a relinearisation in a frame: a few slices; all if not paced, or if no place may change meanwhile."""
        if self._job is None:
            return SLICES_A_FRAME
        waits = self._method.revises(self._problem) and self._method.beside() is None
        return SLICES_A_FRAME if self._paced and not waits else np.inf

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
        if self._prior_map is not None and not self._aligned:
            self._lay_over_map(final=True)
        self._job = None
        problem, estimate = self._problem.until(self._n_poses), self._filter.estimate()
        batch = Batch(self._prior, self._start_noise, self._method, self._settings)
        if self._framed and not self._aligned:
            return batch.solved(SolvedPart(problem, estimate, self._noise, fits=True), None, self._framed)
        return batch.finished(problem, estimate, self._noise, aligned=self._aligned)

    def _assign(self, row: int, detections: IntArray) -> None:
        """Ask the method for the places of the coming pose's detections."""
        problem = self._assign_places(self._problem, self._method, self._filter, self._landmark, row, detections)
        if problem is not self._problem:
            self._adopt(problem, grown(self._landmark, len(problem.landmark_mean)))
            self._filter.problem = self._problem

    @staticmethod
    def _assign_places(
        problem: Problem, method: Method, running: SessionFilter, landmark: FloatArray, row: int, detections: IntArray
    ) -> Problem:
        """Return the problem with the places that a method has for the detections of the pose after a filter's."""

        def distances(of: IntArray, places: IntArray) -> tuple[FloatArray, FloatArray]:
            squared, log_volume = np.full((2, len(of)), np.nan)
            known = np.isfinite(landmark[places, 0])
            if row > 0 and known.any():
                squared[known], log_volume[known] = running.distances(of[known], places[known])
            return squared, log_volume

        before = problem.landmark_row[detections]
        places = method.assign(problem, row, detections, distances)
        if not np.count_nonzero(places != before):
            return problem
        landmark_row = problem.landmark_row.copy()
        landmark_row[detections] = places
        return replace(problem, landmark_row=landmark_row).with_places(max(len(landmark), int(places.max()) + 1))

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
        problem = running.problem
        new = np.isnan(landmark[problem.landmark_row[detections], 0])
        for m in detections[new] if np.count_nonzero(new) else ():
            j = problem.landmark_row[m]
            if np.isfinite(landmark[j, 0]):  # twice in this frame
                continue
            if problem.mapped[j]:
                prior = problem.conditional_prior(j, np.isfinite(landmark[:, 0]))
                landmark[j] = prior.place(landmark, problem.landmark_mean)
            else:
                reading, mount = problem.reading[m], problem.mount
                landmark[j] = sight_at(running.pose, reading, running.states, mount)

    def _relinearise(self, *, learn: bool) -> Slices[None]:
        """Relinearise all poses so far in parallel to the stream, catch up with it, and take over.

        With `learn`, also vote on places, ask the method, and learn the noise.
        """
        self._relinearised_at = n = self._n_poses
        method, revised = self._method, None
        problem, estimate = self._problem.until(n), self._filter.estimate()
        smoother = Smoother(problem, self._noise, heavy=True, robust=self._robust)
        if learn and self._robust:
            estimate = yield from voted(smoother, estimate, self._settings.fewest_sightings)
        estimate, marginals = yield from smoother.solve_in_slices(
            estimate, iterations=STEPS_A_ROUND, tolerance=NEAR_NOISE if learn else NEAR
        )
        if learn and method.revises(problem):
            method = method.beside() or method  # frames that come meanwhile are assigned as before
            revision = yield from method.revise_in_slices(problem, estimate, self._noise, heavy=True, final=False)
            if revision.problem is not problem:
                problem, estimate = revision.problem, revision.estimate
                smoother = Smoother(problem, self._noise, heavy=True, robust=self._robust)
                marginals = yield from smoother.marginals_in_slices(estimate)
                coming = self._named[len(problem.landmark_row) :]
                revised = replace(
                    self._problem,
                    landmark_row=np.append(problem.landmark_row, coming),
                    landmark_mean=problem.landmark_mean,
                    landmark_information=problem.landmark_information,
                )
        if learn and self._estimate_noise:
            yield from marginals.in_slices()
            weights = smoother.inlier_probability(estimate)
            fit = refine_noise(problem, estimate, marginals, weights, self._noise, self._start_noise, scoring=True)
            self._noise = fit.noise
            smoother = smoother.under(self._noise, heavy=True)
        marginals = yield from smoother.marginals_in_slices(estimate)
        if learn:
            unknown = np.zeros((N_STATES, N_STATES))
            self._scale = 1.0 if self._aligned else self._prior.split_scale(estimate.states, unknown)[2]
        following = SessionFilter(self._problem if revised is None else revised, self._noise, robust=self._robust)
        following.restart(estimate, self._noise, following.problem, marginals)
        yield 1.0
        landmark = estimate.landmark.copy()
        for row in counted(n):
            following.problem = self._problem if revised is None else revised
            landmark = grown(landmark, len(following.problem.landmark_mean))
            if row == self._n_poses:
                break
            detections = following.problem.detections_of(row)
            following.drive(following.motion(row))
            if revised is not None:
                revised = self._assign_places(revised, method, following, landmark, row, detections)
                following.problem, landmark = revised, grown(landmark, len(revised.landmark_mean))
            self._meet_new_landmarks(following, landmark, detections)
            following.add(row, landmark)
            yield min(CAUGHT_UP_MS + OF_PAIR_MS * len(detections) ** 2, 0.5 * SLICES_A_FRAME)
        if revised is not None:
            self._adopt(revised, landmark)
        self._method, self._filter, self._landmark = method, following, landmark

    def _lay_over_map(self, *, final: bool = False) -> None:
        """Enter the map where the landmarks of the map seen so far lie over it; two are enough at the end."""
        assert self._prior_map is not None
        given, settings = self._prior_map.given, self._settings.localize
        count = int(np.count_nonzero(given & np.isfinite(self._landmark[: len(given), 0])))
        fewest, spread_m = (2, 0.0) if final else (settings.fewest, settings.spread_m)
        if count < fewest or (count == self._align_tried and not final):  # nothing new has been seen since
            return
        self._align_tried = count
        estimate = self._filter.estimate()
        laid = lay_over(self._prior_map, estimate.landmark, settings, fewest=fewest, spread_m=spread_m)
        if laid:
            self._enter_map(estimate, laid.motion)

    def _enter_map(self, estimate: Estimate, pose_map_world: FloatArray) -> None:
        """Move the estimate from the first pose's frame into the prior map's, then constrain it by the map."""
        assert self._prior_map is not None
        self._problem, moved = entered(self._problem, estimate, self._prior_map, self._prior, pose_map_world)
        self._aligned, self._scale = True, 1.0
        done = self._n_poses
        self.online_pose[:done] = se2.compose(pose_map_world, self.online_pose[:done])
        self._landmark = moved.landmark.copy()
        self._filter.restart(moved, self._noise, self._problem)
        self._job = self._relinearise(learn=True)
        self._owed_ms = self._a_frame_ms()
        self.work()
