"""Association by geometry in space: the step of `--unknown-ids` there before the estimator.

The estimator in space solves all frames together, and so does this module. First, frame by frame, detections are paired
with the landmarks of the last seconds under joint compatibility, in the frame of the robot (Castellanos,
Martinez-Cantin, Tardos and Neira, Robocentric Map Joining, RAS 55(1), 2007). A landmark that was not seen for longer is
started again: no frame closes a loop by itself. Then everything is solved, duplicates are merged by their joint
covariances (`merging`), and each detection is compared with the whole map once more.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import block_diag

from evermap.config import AssociationConfig, SlamConfig
from evermap.errors import DataError
from evermap.estimate.sparse.system import Factorised
from evermap.geometry import se2, se3
from evermap.geometry.chunked import blocks
from evermap.geometry.group import accumulate
from evermap.slam.association.assignment import (
    NOBODY,
    LooseDetections,
    alike,
    count_together,
    density_of_unmet,
    labels_of,
    landmark_density,
    merge_rows,
    same_name,
    shared_variance,
)
from evermap.slam.association.associator import Associator, with_traits
from evermap.slam.association.constellation import LocalMap
from evermap.slam.association.features import Likeness, Traits
from evermap.slam.association.identify import Associated
from evermap.slam.association.jcbb import Pairings, gates
from evermap.slam.association.merging import (
    Differences,
    Solution,
    in_reach,
)
from evermap.slam.association.revise import lying_together, may_be_of, most_probable
from evermap.slam.space.estimate import as_seen, converge, first_places, oriented
from evermap.slam.space.intake import SpatialIntake, prepare_space, without_range
from evermap.slam.space.linearise import POINT, POSE
from evermap.slam.space.problem import SpatialEstimate, SpatialNoise, SpatialProblem, Swing
from evermap.slam.space.smoother import SpatialLinear, SpatialSmoother
from evermap.types import UNKNOWN, AssociationEvidence, BoolArray, FloatArray, IntArray, SpatialRecording, traits_of

FAR_M = 1e3
"""Standard deviation of the position of a landmark before its first detection: uninformative."""
ROUNDS = 2
"""Rounds of learning the noise with a kernel whose influence never vanishes, as far from convergence."""


def associate_in_space(recording: SpatialRecording, settings: SlamConfig, *, keep_ids: bool = False) -> Associated:
    """Associate a recording in space; as `associate`.

    Boxes (of a detector of movable objects) and detections without a range are of no landmark.
    """
    if recording.odometry is None or len(recording.odometry) < 2:
        problem = f"{recording.name}: landmarks without identity need odometry"
        raise DataError(problem, hint="record poses or velocities of the robot, or identities")
    given = recording.detections
    asked = ~np.isfinite(given.size_m).all(axis=1) & ~without_range(recording)
    name = given.landmark_id if keep_ids else np.full_like(given.landmark_id, UNKNOWN)
    row = np.full(len(given), NOBODY)
    if not asked.any():  # a recording of boxes alone
        none, local = np.zeros(0, dtype=np.int64), LocalMap(np.zeros((0, 3)), np.zeros((0, 0)))
        loose = LooseDetections(none, local.place, np.zeros(0), none)
        evidence = AssociationEvidence(0.0, 0)
        kinds, apart = none.reshape(0, 2), sparse.csr_array((0, 0))
        return Associated(row, name, kinds, apart, loose, settings, lambda: local, evidence)
    # symmetries are those of classes, so each class is one landmark until landmarks are known
    by_class = np.where(asked, given.class_id - UNKNOWN, UNKNOWN)
    intake = prepare_space(replace(recording, detections=replace(given, landmark_id=by_class)), settings.space)
    kind = np.column_stack([given.class_id, name])[intake.used]

    def found(traits: Traits | None, known: SpatialSolution | None = None) -> tuple[SpatialAssociator, SpatialSolution]:
        associator = SpatialAssociator(intake, kind, settings, traits, known)
        for _ in associator.stamp_s:
            associator.step()
        return associator, associator.finish()

    associator, solved = found(None)
    features, _ = traits_of(given)
    if features is not None:  # all are judged by the noise and the density of the first one
        first = SpatialAssociator(intake, kind, settings, known=solved), solved
        again = functools.partial(found, known=solved)
        associator, solved = with_traits(first, features[intake.used], settings, again)
    row[intake.used], local, together, loose = associator.concluded(solved)
    of_kind = labels_of(kind, row[intake.used], len(local.place))
    loose = loose._replace(row=intake.used[loose.row])
    evidence = AssociationEvidence(float(np.mean(row[intake.used] == NOBODY)), len(local.place))
    return Associated(row, name, of_kind, together, loose, settings, lambda: local, evidence)


class _Nearby:
    """L landmarks seen recently, in the frame of the robot.

    Attributes:
        row: (L,) of the landmarks.
        place, covariance: (L, 3), and (3 L, 3 L) of all together.
        ways: (2, L, 7) the two possible poses of each, from its last detection; sigma_rad: (L,) of their orientations,
            0 for points.
    """

    def __init__(self) -> None:
        self.row: IntArray = np.zeros(0, dtype=np.int64)
        self.place, self.covariance = np.zeros((0, 3)), np.zeros((0, 0))
        self.ways, self.sigma_rad = np.zeros((2, 0, 7)), np.zeros(0)

    def driven(self, motion: FloatArray, variance: FloatArray) -> _Nearby:
        """Return the landmarks after a motion (7,), with its variances (2,) of each axis and angle."""
        turn, count, after = se3.rotation_of(motion), len(self.row), _Nearby()
        after.row, after.sigma_rad = self.row, self.sigma_rad.copy()
        after.place = (self.place - motion[:3]) @ turn
        after.ways = se3.compose(se3.inverse(motion), self.ways)
        blocks = self.covariance.reshape(count, 3, count, 3)
        blocks = np.einsum("ai,kalb->kilb", turn, blocks)
        blocks = np.einsum("kilb,bj->kilj", blocks, turn)
        by = se3.rigid_directions(after.place)
        after.covariance = blocks.reshape(3 * count, 3 * count) + (by * np.repeat(variance, 3)) @ by.T
        return after

    def part(self, some: BoolArray) -> _Nearby:
        """Return some of the landmarks (L,)."""
        at, found = se2.xy_rows(np.flatnonzero(some), 3), _Nearby()
        found.row, found.place, found.covariance = self.row[some], self.place[some], self.covariance[np.ix_(at, at)]
        found.ways, found.sigma_rad = self.ways[:, some], self.sigma_rad[some]
        return found

    def meet(self, row: IntArray) -> None:
        """Add landmarks without any information."""
        before, count = len(self.covariance), len(row)
        self.row = np.append(self.row, row)
        self.place = np.vstack([self.place, np.zeros((count, 3))])
        covariance = np.diag(np.full(before + 3 * count, FAR_M**2))
        covariance[:before, :before] = self.covariance
        self.covariance = covariance
        self.ways = np.concatenate([self.ways, se3.identity(2, count)], axis=1)
        self.sigma_rad = np.append(self.sigma_rad, np.zeros(count))

    def update(self, at: IntArray, place: FloatArray, covariance: FloatArray) -> None:
        """Update landmarks in rows `at` (n,) with a detection each."""
        rows = se2.xy_rows(at, 3)
        spread = self.covariance[np.ix_(rows, rows)]
        for k in range(len(at)):
            spread[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += covariance[k]
        gain = np.linalg.solve(spread, self.covariance[rows]).T
        self.place = self.place + (gain @ (place - self.place[at]).ravel()).reshape(-1, 3)
        after = self.covariance - gain @ self.covariance[rows]
        self.covariance = 0.5 * (after + after.T)


class SpatialAssignment(NamedTuple):
    """Landmarks (M,) of detections, poses (N, 7) and noise levels to begin a solution with, and traits."""

    landmark_row: IntArray
    pose: FloatArray
    noise: SpatialNoise
    traits: Traits

    @property
    def n_landmarks(self) -> int:
        """Number of landmarks."""
        return int(self.landmark_row.max(initial=-1)) + 1

    def rows(self, landmark_row: IntArray) -> SpatialAssignment:
        """Return the same with other landmarks (M,), numbered by first detection."""
        return self._replace(
            landmark_row=_without(landmark_row, np.zeros(int(landmark_row.max(initial=-1)) + 1, dtype=np.bool_))
        )


@dataclass(frozen=True, slots=True)
class SpatialSolution:
    """Landmarks (M,) of detections at the optimum, the linearisation there, its noise levels, the density of landmarks
    [1/m^3], traits, and its cost [nats]: a trial, until something goes on from it.
    """

    landmark_row: IntArray
    estimate: SpatialEstimate
    smoother: SpatialSmoother
    now: SpatialLinear
    noise: SpatialNoise
    density: float
    traits: Traits
    cost: float

    @property
    def n_landmarks(self) -> int:
        """Number of landmarks."""
        return len(self.estimate.place)

    @property
    def sightings(self) -> IntArray:
        """(L,) number of detections of each landmark."""
        return np.bincount(self.landmark_row[self.landmark_row >= 0], minlength=self.n_landmarks)

    @property
    def numbers(self) -> IntArray:
        """(L,) numbers of each landmark: three of a point, six of a pose."""
        return np.where(self.smoother.problem.oriented, 6, 3)


class SpatialAssociator(Associator[SpatialAssignment, SpatialSolution, SpatialSolution, _Nearby]):
    """The associator in space.

    Args:
        intake: the recording, in which every class is one landmark.
        kind: (M, 2) class and name of every detection that it uses, `UNKNOWN` for none: different ones exclude each
            other.
        settings: of the estimator.
        traits: readings of the landmarks themselves; None if they give no evidence.
        known: a solution of the same recording, to begin with its noise and its density.
    """

    has_own_noise = True

    def __init__(
        self,
        intake: SpatialIntake,
        kind: IntArray,
        settings: SlamConfig,
        traits: Traits | None = None,
        known: SpatialSolution | None = None,
    ) -> None:
        problem = self._problem = _thin_poses(intake)
        density = density_of_unmet(np.zeros((0, 3)), settings) if known is None else known.density
        super().__init__(problem.stamp_s, problem.pose_row, kind, _Nearby(), density, traits, settings)
        caution, space = self._rules.odometry_caution, problem.settings
        noise = SpatialNoise(caution * space.drift_m, caution * space.drift_rad, pixel=space.sigma_px)
        self._noise = noise if known is None else known.noise
        mount = problem.mount[problem.sensor]
        self._at = se3.transform(mount, problem.measured[:, :3])
        self._root = self._rules.noise_caution * se3.rotation_of(mount) @ np.linalg.inv(problem.measured_root)
        self._ways = se3.compose(mount, problem.either)
        self._turned = problem.kind != POINT
        self._view = np.unique(problem.pose_row * len(problem.mount) + problem.sensor, return_inverse=True)[1]

    def _begun(self, begun: SpatialSolution | None) -> SpatialSolution:
        if begun is not None:
            return self._solve_assignment(
                SpatialAssignment(begun.landmark_row, begun.estimate.pose, self._noise, begun.traits)
            )
        start = SpatialAssignment(self._row, accumulate(self._problem.increment), self._noise, self._traits)
        return self._with_noise(start.rows(self._row))

    def _reassign(self, solved: SpatialSolution) -> SpatialAssignment:
        again = self._with_overlooked(self._most_probable(solved), solved)
        again = _without(again, np.bincount(again[again >= 0]) < self._settings.fewest_sightings)
        return SpatialAssignment(again, solved.estimate.pose, solved.noise, solved.traits)

    def _learned(self, assignment: SpatialAssignment) -> SpatialSolution:
        return self._with_noise(assignment)

    def _result(self, solved: SpatialSolution) -> SpatialSolution:
        return solved

    def _judge(self, found: SpatialSolution) -> SpatialSolution:
        return self._solve_assignment(
            SpatialAssignment(found.landmark_row, found.estimate.pose, self._noise, found.traits)
        )

    def _total(self, solved: SpatialSolution) -> float:
        """An unassigned detection is of one of the landmarks that there are elsewhere, as in `_most_probable`."""
        spread = self._covariance(solved.landmark_row == NOBODY, solved.noise)
        nobody = -0.5 * (np.linalg.slogdet(spread)[1] + 3.0 * math.log(2.0 * math.pi)) - math.log(self._density)
        cost = solved.now.cost + np.maximum(nobody, 0.0).sum()
        cost += 0.5 * self._rules.landmark_nats * solved.numbers.sum()  # stated for two numbers
        return float(cost - solved.traits.evidence(*self.of_visits(solved)))

    def concluded(self, solved: SpatialSolution) -> tuple[IntArray, LocalMap, sparse.csr_array, LooseDetections]:
        """Return (M,) the landmark of every detection, numbered by first detection, `NOBODY` for none; the landmarks;
        (L, L) the number of views that show both of two; and the detections of none, rows of those of the recording.
        """
        kept = np.flatnonzero(
            np.bincount(solved.landmark_row[solved.landmark_row >= 0]) >= self._settings.fewest_sightings
        )
        row = np.where(np.isin(solved.landmark_row, kept), np.searchsorted(kept, solved.landmark_row), NOBODY)
        views = int(self._view.max(initial=-1)) + 1
        together, _ = count_together(self._view, row, views, len(kept), 0)
        some = np.flatnonzero((row == NOBODY) & (self._kind[:, -1] == UNKNOWN))
        at = se3.transform(solved.estimate.pose[self._problem.pose_row[some]], self._at[some])
        loose = LooseDetections(some, at, self._wide_m(solved.noise)[some], self._kind[some, 0])
        return row, self._local(solved, kept), together, loose

    def _local(self, solved: SpatialSolution, rows: IntArray) -> LocalMap:
        """Return some landmarks, with the errors that all sightings of one have in common."""
        problem = solved.smoother.problem
        place, turned = solved.estimate.place[rows], problem.oriented[rows]
        if not len(rows):
            return LocalMap(place[:, :3], np.zeros((0, 0)))
        joint = solved.smoother.factorised(solved.now).joint(len(problem.stamp_s) + rows)
        width = np.where(turned, 6, 3)
        own = block_diag(*np.where(turned[:, None, None], se3.rotation_of(place), np.eye(3)))
        at = ((np.cumsum(width) - width)[:, None] + np.arange(3)).ravel()
        covariance = own @ joint[np.ix_(at, at)] @ own.T + np.diag(np.repeat(self._find_shared_m2(solved)[rows], 3))
        told = turned & (problem.symmetries.of[rows] == 0)  # what looks the same in several has none
        return LocalMap(place[:, :3], covariance, np.where(told[:, None], place[:, 3:], np.nan))

    def _views(self, detections: IntArray) -> list[IntArray]:
        return [detections[self._view[detections] == one] for one in np.unique(self._view[detections])]

    def _drive(self, near: _Nearby, times: float) -> _Nearby:
        problem, row = self._problem, self._done - 1
        variance = problem.lasted_s[row] * np.array([self._noise.translation, self._noise.rotation]) ** 2
        away_s = problem.stamp_s[self._done] - self._seen_s[near.row]
        return near.part(away_s <= self._rules.forget_s).driven(problem.increment[row], times**2 * variance)

    def _gate(self, near: _Nearby, view: IntArray) -> tuple[Pairings, BoolArray]:
        rules = self._rules
        source, target = (each.ravel() for each in np.indices((len(view), len(near.row))))
        kept = alike(self._kind[view[source]], self._of_kind[near.row[target]])
        source, target = source[kept], target[kept]
        own = self._covariance(view, self._noise)
        innovation = self._at[view[source]] - near.place[target]
        at = 3 * target[:, None] + np.arange(3)
        spread = near.covariance[at[:, :, None], at[:, None, :]] + own[source]
        squared = np.einsum("ki,ki->k", innovation, np.linalg.solve(spread, innovation[..., None])[..., 0])
        inside = squared <= gates(1, rules.gate_confidence, 3)[1]
        inside[inside] = self._turn_alike(view[source[inside]], near, target[inside])
        source, target, innovation, spread = source[inside], target[inside], innovation[inside], spread[inside]
        rows = se2.xy_rows(target, 3)
        joint = near.covariance[np.ix_(rows, rows)].reshape(len(source), 3, len(source), 3)
        joint = joint + (source[:, None] == source)[:, None, :, None] * own[source][:, :, None, :]
        log_det, least = np.linalg.slogdet(spread)[1], np.linalg.slogdet(own[source])[1]
        # the neighbourhood of a tracked landmark is mapped; other gates may contain an unmapped one by chance
        followed = log_det <= least + 3.0 * math.log(rules.followed**2)
        new = np.log(np.where(followed, rules.unmet_share, 1.0) * self._density)
        joint = joint.reshape(3 * len(source), 3 * len(source))
        return Pairings(source, near.row[target], innovation, joint, new, len(view), least), followed

    def _certain(
        self, _near: _Nearby, pairings: Pairings, _followed: BoolArray, probability: FloatArray, known: FloatArray
    ) -> BoolArray:
        rules, source = self._rules, pairings.source
        best = np.zeros(len(source), dtype=np.bool_)
        if len(source):
            order = np.lexsort((-probability, source))
            best[order[np.diff(source[order], prepend=-1) > 0]] = True
        log_det = np.linalg.slogdet(blocks(pairings.covariance, 3))[1]
        tight = best & (known[source] > 1.0 - rules.p_new) & (log_det < 3.0 * math.log(rules.tight_m2))
        return np.asarray((probability > 1.0 - rules.p_new) | tight)

    def _loose(self, solved: SpatialSolution, refused: set[tuple[int, int]]) -> list[tuple[int, int]]:  # noqa: ARG002
        return []

    def _correct_visits(self, solved: SpatialSolution, refused: set[tuple[int, int]]) -> SpatialSolution:  # noqa: ARG002
        return solved

    def _realign(self, solved: SpatialSolution) -> SpatialSolution:
        return solved

    def _turn_alike(self, detection: IntArray, near: _Nearby, target: IntArray) -> BoolArray:
        """(K,) detections with the orientation of landmarks, in one of the two possible poses of either."""
        away_s = self._problem.stamp_s[self._problem.pose_row[detection]] - self._seen_s[near.row[target]]
        sigma = np.hypot(self._noise.rotation * np.sqrt(away_s), near.sigma_rad[target])
        return self._within(detection, near.ways[:, target], near.sigma_rad[target] > 0.0, sigma)

    def _within(self, detection: IntArray, ways: FloatArray, turned: BoolArray, sigma: FloatArray) -> BoolArray:
        """(K,) detections with the orientation of ways (2, K, 7), of errors sigma (K,), or if either has none."""
        rules = self._rules.space
        symmetries = self._problem.symmetries[self._problem.place[detection]]
        mine = np.repeat(self._ways[:, detection], 2, axis=0)
        angle = symmetries.angle_between(mine, np.concatenate([ways, ways])).min(axis=0)
        sigma = np.hypot(np.hypot(sigma, self._problem.sigma_rad[detection]), rules.turn_floor_rad)
        return np.asarray(~turned | ~self._turned[detection] | (angle <= rules.turn_sigmas * sigma))

    def _update(self, known: IntArray, new: IntArray) -> None:
        near, seen = self._near, np.append(known, new)
        near.meet(self._row[new])
        at = np.searchsorted(near.row, self._row[seen])
        near.update(at, self._at[seen], self._covariance(seen, self._noise))
        sigma = np.where(self._turned[seen], self._problem.sigma_rad[seen], 0.0)
        near.ways[:, at], near.sigma_rad[at] = self._ways[:, seen], sigma

    def _with_noise(self, start: SpatialAssignment) -> SpatialSolution:
        """Solve for landmarks and noise, from poses that may be far off and noise levels."""
        problem = self._problem_of(start.landmark_row)
        places = first_places(problem, start.pose)
        points = converge(problem.as_points(), places, start.noise, heavy_rounds=ROUNDS)
        noise = points.noise
        if problem.oriented.any():
            problem, turned = _one_way(problem, points.estimate, points.now.weight)
            noise = converge(problem, turned, noise, heavy_rounds=ROUNDS).noise
        caution = self._rules.odometry_caution
        noise = replace(noise, translation=caution * noise.translation, rotation=caution * noise.rotation)
        return self._solve_assignment(start._replace(pose=points.estimate.pose, noise=noise))

    def _problem_of(self, row: IntArray) -> SpatialProblem:
        """The measurements of landmarks (M,)."""
        problem, used = self._problem, np.flatnonzero(row >= 0)
        first = np.unique(row[used], return_index=True)[1]
        turned = np.zeros(len(first), dtype=np.bool_)
        turned[row[used][self._turned[used]]] = True
        symmetries = problem.symmetries[problem.place[used[first]]]
        return replace(problem.seeing(used), place=row[used], oriented=turned, symmetries=symmetries)

    def _solve_assignment(self, start: SpatialAssignment) -> SpatialSolution:
        """Solve for landmarks, from poses that may be far off: positions first, then orientations, too."""
        row, pose, noise, traits = start
        problem = self._problem_of(row)
        points = SpatialSmoother(problem.as_points(), pose)
        estimate, _ = points.optimum(first_places(problem, pose), noise, heavy=True)
        estimate, now = points.optimum(estimate, noise, heavy=False)
        smoother = points
        if problem.oriented.any():
            problem, estimate = _one_way(problem, estimate, now.weight)
            smoother = SpatialSmoother(problem, pose)
            estimate, _ = smoother.optimum(estimate, noise, heavy=True)
            estimate, now = smoother.optimum(estimate, noise, heavy=False)
        density = landmark_density(estimate.place[:, :3], np.bincount(problem.place), self._settings)
        cost = now.cost - traits.evidence(*self.of_visits(start))
        return SpatialSolution(row, estimate, smoother, now, noise, density, traits, cost)

    def _solve_merged(self, solved: SpatialSolution, pairs: list[tuple[int, int]]) -> SpatialSolution:
        row = np.append(merge_rows(pairs, solved.n_landmarks), NOBODY)[solved.landmark_row]
        start = SpatialAssignment(row, solved.estimate.pose, solved.noise, solved.traits)
        return self._solve_assignment(start.rows(row))

    def _compared(self, solved: SpatialSolution) -> Solution:
        rules = self._rules
        used, count = np.flatnonzero(solved.landmark_row >= 0), len(solved.estimate.place)
        row, of, n = (
            solved.landmark_row[used],
            labels_of(self._kind, solved.landmark_row, count),
            len(self._problem.stamp_s),
        )
        spread, turned = solved.smoother.spread(solved.now), solved.smoother.problem.oriented
        at = spread.own_first[n : n + count, None, None] + np.arange(3)
        own = spread.own[at + np.where(turned, 6, 3)[:, None, None] * np.arange(3)[:, None]]
        sightings, last_s = np.bincount(row, minlength=count), np.zeros(count)
        np.maximum.at(last_s, row, self._problem.stamp_s[self._problem.pose_row[used]])
        like = np.array([alike(each, of).mean() for each in of])
        log_density = np.log(solved.density * like)
        factorised = solved.smoother.factorised(solved.now)
        known = solved.traits, self._likeness(solved)
        differences = _Differing(solved, factorised, self._find_shared_m2(solved), log_density, of, *known, rules)
        n_views = int(self._view.max()) + 1
        return Solution(
            solved.estimate.place[:, :3], own, differences, sightings, last_s,
            *count_together(self._view[used], row, n_views, count, rules.around_frames), of, rules,
        )  # fmt: skip

    def _find_shared_m2(self, solved: SpatialSolution) -> FloatArray:
        """(L,) `shared_variance` of the landmarks."""
        return shared_variance(self._wide_m(solved.noise), solved.landmark_row, len(solved.estimate.place), self._rules)

    def _covariance(self, rows: IntArray | BoolArray | slice, noise: SpatialNoise) -> FloatArray:
        """(K, 3, 3) covariances of positions in the frame of the robot."""
        root = self._root[rows] * np.array([noise.across, noise.across, noise.along])
        return np.asarray(root @ np.swapaxes(root, 1, 2))

    def _wide_m(self, noise: SpatialNoise) -> FloatArray:
        """(M,) standard deviation of a position, along its widest axis."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self._covariance(slice(None), noise))[:, 2]))

    def _most_probable(self, solved: SpatialSolution) -> IntArray:
        """(M,) the most probable landmark of every detection, given all poses; see `revise.reassign`."""
        rules, of_space = self._rules, self._rules.space
        tail_by, tail_share, widened = of_space.tail, of_space.tail_share, of_space.widened
        pose, place = solved.estimate.pose[self._problem.pose_row], solved.estimate.place
        at, gate = se3.transform(pose, self._at), gates(1, rules.gate_confidence, 3)[1]
        reach = tail_by * math.sqrt(widened * gate) * float(np.quantile(self._wide_m(solved.noise), 0.99))
        seen, row = in_reach(place[:, :3], at, reach)
        kept = may_be_of(self._kind[seen], labels_of(self._kind, solved.landmark_row, len(place))[row])
        seen, row = seen[kept], row[kept]
        turned = se3.compose(se3.inverse(pose[seen]), place[row])
        oriented = solved.smoother.problem.oriented[row]
        kept = self._within(seen, np.stack([turned, turned]), oriented, np.zeros(len(seen)))
        seen, row = seen[kept], row[kept]
        axes = se3.rotation_of(pose[seen])
        spread = widened * axes @ self._covariance(seen, solved.noise) @ np.swapaxes(axes, 1, 2)
        off = at[seen] - place[row, :3]
        squared = np.einsum("ki,ki->k", off, np.linalg.solve(spread, off[..., None])[..., 0])
        score = -0.5 * (np.linalg.slogdet(spread)[1] + 3.0 * math.log(2.0 * math.pi)) - math.log(solved.density)
        tail = math.log(tail_share) - 3.0 * math.log(tail_by) - 0.5 * squared / tail_by**2
        score += np.logaddexp(math.log(1.0 - tail_share) - 0.5 * squared, tail)
        score += solved.traits.same(solved.traits.singly(seen), self._likeness(solved).part(row))
        inside = (squared < tail_by**2 * gate) & (score > 0.0)
        return most_probable(seen[inside], row[inside], score[inside], self._view, len(place), rules.p_own)

    def _likeness(self, solved: SpatialSolution) -> Likeness:
        """What each landmark is like, by its visits."""
        visit, landmark = self.of_visits(solved)
        visits = solved.traits.of_visits(visit, len(landmark))
        return solved.traits.of_landmarks(visits, landmark, len(solved.estimate.place))

    def _with_overlooked(self, row: IntArray, solved: SpatialSolution) -> IntArray:
        """(M,) landmarks, with a new one per cluster of unassigned detections from enough views, by a solution."""
        fewest = self._settings.fewest_sightings
        left = np.flatnonzero(row == NOBODY)
        at = se3.transform(solved.estimate.pose[self._problem.pose_row[left]], self._at[left])
        found = lying_together(at, self._wide_m(solved.noise)[left], self._kind[left], self._view[left], fewest)
        after = row.copy()
        for k, mine in enumerate(found):
            after[left[mine]] = int(row.max(initial=-1)) + 1 + k
        return after


@dataclass(frozen=True, slots=True)
class _Differing:
    """Differences of pairs of landmarks: of points in three numbers, of poses in six.

    Attributes:
        solved: the landmarks; factorised: at their optimum.
        shared: (L,) variance [m^2] of the shared errors of sightings.
        log_density: (L,) of landmarks with compatible labels [1/m^3].
        kind: (L, 2) class and name of each.
        traits, like: of columns beside the position, and what each landmark is like by them.
        settings: of the association.
    """

    solved: SpatialSolution
    factorised: Factorised
    shared: FloatArray
    log_density: FloatArray
    kind: IntArray
    traits: Traits
    like: Likeness
    settings: AssociationConfig

    def __call__(self, younger: IntArray, older: IntArray) -> Differences:
        """Return the differences of pairs."""
        problem = self.solved.smoother.problem
        both = problem.oriented[younger] & problem.oriented[older]
        dim = 6 if both.any() else 3
        gap, by = self._linearise_gaps(younger, older, both)
        rows, at = np.unique(np.concatenate([younger, older]), return_inverse=True)
        width = np.where(problem.oriented[rows], 6, 3)
        first = np.cumsum(width) - width
        joint = np.zeros((int(width.sum()) + 1, int(width.sum()) + 1))  # the last row: no orientation
        joint[:-1, :-1] = self.factorised.joint(len(problem.stamp_s) + rows)
        position = (first[:, None] + np.arange(3)).ravel()
        joint[position, position] += np.repeat(self.shared[rows], 3)
        turn = (first[width == 6, None] + np.arange(3, 6)).ravel()
        joint[turn, turn] += self.settings.space.shared_rad**2
        columns = np.where(np.arange(6) < width[:, None], first[:, None] + np.arange(6), len(joint) - 1)
        at = columns[at.reshape(2, -1)].transpose(1, 0, 2).reshape(len(younger), 12)
        own = by @ joint[at[:, :, None], at[:, None, :]] @ by.transpose(0, 2, 1)
        # a pair without orientations: three differences that are 0
        idle = np.where(both[:, None], 0.0, np.arange(6) >= 3)
        own += idle[:, :, None] * np.eye(6)
        names = same_name(self.kind[younger], self.kind[older])
        new = self.log_density[younger] - self.settings.name_nats * names
        new -= self.traits.same(self.like.part(younger), self.like.part(older))
        new += np.where(both, self._turns(younger, older), -1.5 * math.log(2.0 * math.pi))

        def together(some: IntArray) -> FloatArray:
            used, column = np.unique(at[some], return_inverse=True)
            onto = np.zeros((len(some), 6, len(used)))
            np.put_along_axis(onto, np.repeat(column.reshape(len(some), 1, 12), 6, axis=1), by[some], axis=2)
            rows = onto[:, :dim].reshape(len(some) * dim, -1)
            return np.asarray(rows @ joint[np.ix_(used, used)] @ rows.T + np.diag(idle[some, :dim].ravel()))

        new += 0.0 if dim == 6 else 1.5 * math.log(2.0 * math.pi)
        return Differences(gap[:, :dim], own[:, :dim, :dim], new, together)

    def _linearise_gaps(self, younger: IntArray, older: IntArray, both: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Gaps (K, 6), and their derivatives (K, 6, 12) by the two."""
        gap, by = np.zeros((len(younger), 6)), np.zeros((len(younger), 6, 12))
        problem, place = self.solved.smoother.problem, self.solved.estimate.place
        one, other = place[younger], place[older]
        one = problem.symmetries[younger].nearest(one, other)
        gap[both] = se3.local(other[both], one[both])
        by[both, :, :6] = se3.right_jacobian_inverse(gap[both])
        by[both, :, 6:] = -se3.right_jacobian_inverse(-gap[both])
        gap[~both, :3] = one[~both, :3] - other[~both, :3]
        for some, columns, sign in ((younger, slice(0, 3), 1.0), (older, slice(6, 9), -1.0)):
            axes = np.where(problem.oriented[some, None, None], se3.rotation_of(place[some]), np.eye(3))
            by[~both, :3, columns] = sign * axes[~both]
        return gap, by

    def _turns(self, younger: IntArray, older: IntArray) -> FloatArray:
        """(K,) log density of the orientation of another landmark [1/rad^3]: uniform, or similar to one of the map."""
        problem, place = self.solved.smoother.problem, self.solved.estimate.place
        alike_rad, (names, row) = self.settings.space.alike_rad, np.unique(younger, return_inverse=True)
        angle = np.stack([problem.symmetries.angle_between(place[k], place) for k in names])
        like = np.where(problem.oriented, np.exp(-0.5 * (angle / alike_rad) ** 2), 0.0)
        like /= (2.0 * math.pi) ** 1.5 * alike_rad**3
        found = like.sum(axis=1)[row] - like[row, younger] - like[row, older]
        return np.asarray(np.log(0.5 / (8.0 * math.pi**2) + 0.5 * np.maximum(found, 0.0) / max(len(place), 1)))


def _one_way(
    problem: SpatialProblem, estimate: SpatialEstimate, weight: FloatArray
) -> tuple[SpatialProblem, SpatialEstimate]:
    """The problem with the better of the two orientations of each tag seen by its corners, and oriented places."""
    estimate = replace(estimate, place=oriented(problem, estimate, weight))
    seen = np.stack([as_seen(problem, estimate, measured) for measured in problem.either])
    angle = problem.symmetries[problem.place].angle_between(seen, estimate.place[problem.place])
    measured = np.where((angle[0] <= angle[1])[:, None], problem.either[0], problem.either[1])
    kind = np.where(problem.kind == POINT, POINT, POSE)
    return replace(problem, kind=kind, measured=measured), estimate


def _thin_poses(intake: SpatialIntake) -> SpatialProblem:
    """The problem with only the poses that have detections."""
    problem = intake.problem
    kept = np.unique(problem.pose_row)
    pose = intake.driven_pose[kept]
    stamp_s = problem.stamp_s[kept]
    return replace(
        problem, stamp_s=stamp_s - stamp_s[0], increment=se3.between(pose[:-1], pose[1:]), lasted_s=np.diff(stamp_s),
        swing=Swing.none(len(pose) - 1), pose_row=np.searchsorted(kept, problem.pose_row), path=None,
    )  # fmt: skip


def _without(row: IntArray, gone: BoolArray) -> IntArray:
    """(M,) landmarks without some (L,), numbered by first detection."""
    kept = (row >= 0) & ~gone[row]
    names, first, rank = np.unique(row[kept], return_index=True, return_inverse=True)
    order = np.empty(len(names), dtype=np.int64)
    order[np.argsort(first, kind="stable")] = np.arange(len(names))
    found = np.full(len(row), NOBODY)
    found[kept] = order[rank]
    return found
