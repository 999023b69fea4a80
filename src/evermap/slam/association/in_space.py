"""Landmarks without identity in space: what `--unknown-ids` does there before the estimator runs.

The estimator in space reads all frames and solves them together, and so does this. First the frames, one by one: what
was seen in the last seconds lies around the robot (in its frame: Castellanos, Martinez-Cantin, Tardos and Neira,
Robocentric Map Joining, RAS 55(1), 2007), and detections are paired with it under joint compatibility. What was not
seen for longer starts a new landmark: no frame closes a loop by itself. Then everything is solved, landmarks that are
one are merged by their joint covariances (`merging`), and each detection is compared with the whole map once more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from evermap.config import SpaceConfig
from evermap.errors import ConfigError, DataError
from evermap.geometry import se2, se3
from evermap.slam.association.assignment import (
    FEWEST_SIGHTINGS,
    FORGET_S,
    NAMED_NATS,
    NOBODY,
    SHARED_M,
    SHARED_SHARE,
    alike,
    labels_of,
    names_of,
    same_name,
    seen_together,
)
from evermap.slam.association.associator import (
    CAUTION,
    INFLATION,
    LAST_ROUNDS,
    MERGE_ROUNDS,
    P_MERGE,
    P_NEW,
    RISE_MOST,
    RISE_NATS,
    RISE_SHARE,
    SLIP,
    SLIP_NATS,
    SMALLEST_M2,
    TIGHT_M2,
    UNMET,
    effective_number,
)
from evermap.slam.association.identify import numbered
from evermap.slam.association.jcbb import CONFIDENCE, Pairings, gates, pairing_probability
from evermap.slam.association.merging import Differences, Solution, in_reach, propose_merges
from evermap.slam.association.revise import lying_together, may_be_of, most_probable
from evermap.slam.space.estimate import as_seen, converged, first_places, oriented
from evermap.slam.space.intake import SpatialIntake, prepare_space, without_range
from evermap.slam.space.linearise import POINT, POSE
from evermap.slam.space.problem import SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.slam.space.smoother import SpatialLinear, SpatialSmoother
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray, Landmarks, SpatialRecording

FOLLOWED = 3.0 * math.log(4.0)
"""A landmark is followed as long as its place beside the robot at most doubles the standard deviations of readings."""
LEAST_M = 1.0
"""Landmarks spread over this much of every axis, at least: those on a wall fill no volume."""
SHARED_RAD = 0.05
"""Error that no landmark's orientations average out."""
ALIKE_RAD = 0.2
"""Landmarks on one wall are turned alike to within this."""
TURN_SIGMAS, TURN_FLOOR_RAD = 4.0, 0.1
"""Orientations of one landmark differ by no more than so many standard deviations, with an error of this at least."""
SLIPS = 3
"""Motions three, nine and 27 times as wrong as most: each is as much more seldom as the one before."""
FAR_M = 1e3
"""Standard deviation of the place of a landmark before its first detection."""
TAIL, TAIL_SHARE = 5.0, 0.1
"""Share of detections that are so many times as wrong as others: nearer to their landmark than to be of a new one."""
LEFT = 1.5
"""Factor on the variance of a detection given all poses, for what is not known of these."""
ROUNDS = 2
"""Rounds in which noise is learned with tails that never let go."""
OF_DETECTIONS = (
    "pose_row", "sensor", "kind", "measured", "measured_root", "sigma_rad", "corner", "corner_root", "half_m", "other",
    "other_log_odds", "share", "ray",
)  # fmt: skip
"""Columns of `SpatialProblem` with one row a detection."""


def identified_in_space(
    recording: SpatialRecording, settings: SpaceConfig, prior_map: Landmarks | None = None, *, keep_ids: bool = False
) -> SpatialRecording:
    """Return the recording with landmark ids by geometry.

    Boxes (of a detector of things that may move) and detections without a range get none.

    Args:
        recording: as read, with odometry.
        settings: of the estimator.
        prior_map: must be None: landmarks have no identities in a map.
        keep_ids: detections with an id keep it, those without may be of the same landmarks; else ids are ignored.

    Returns:
        The same detections. Landmarks without an id are numbered from 1, in the order in which they were met, leaving
        out ids that there are; `UNKNOWN` where a detection without an id belongs to none that was seen often enough.

    Raises:
        ConfigError: a map is given.
        DataError: no odometry, or too few frames.
    """
    if prior_map is not None:
        problem = "landmarks without identity in space cannot be found in a fixed map"
        raise ConfigError(problem, field="slam.unknown_ids", hint="omit the map, or --unknown-ids")
    if recording.odometry is None or len(recording.odometry) < 2:
        problem = f"{recording.name}: landmarks without identity need odometry"
        raise DataError(problem, hint="record poses or velocities of the robot, or identities")
    given = recording.detections
    asked = ~np.isfinite(given.size_m).all(axis=1) & ~without_range(recording)
    # symmetries are those of classes, so each class is one landmark until it is known which there are
    by_class = np.where(asked, given.class_id - UNKNOWN, UNKNOWN)
    intake = prepare_space(replace(recording, detections=replace(given, landmark_id=by_class)), settings)
    found = given.landmark_id.copy() if keep_ids else np.full(len(given), UNKNOWN)
    kind = np.column_stack([given.class_id, found])[intake.used]
    row = SpatialAssociator(intake, kind).finish()
    of = names_of(kind[:, 1], row, int(row.max(initial=-1)) + 1)
    met = np.append(numbered(of, found), UNKNOWN)[row]
    found[intake.used] = np.where(kind[:, 1] == UNKNOWN, met, kind[:, 1])
    names = recording.landmark_names if keep_ids else {}
    return replace(recording, detections=replace(given, landmark_id=found), landmark_names=names)


class _Nearby:
    """L landmarks seen lately, in the frame of the robot.

    Attributes:
        row: (L,) which.
        place, covariance: (L, 3), and (3 L, 3 L) of all together.
        ways: (2, L, 7) two ways in which each may be turned, by its last detection; sigma_rad: (L,) of these, 0 for
            points.
        seen_s: (L,) stamp of that.
    """

    def __init__(self) -> None:
        self.row: IntArray = np.zeros(0, dtype=np.int64)
        self.place, self.covariance = np.zeros((0, 3)), np.zeros((0, 0))
        self.ways, self.sigma_rad, self.seen_s = np.zeros((2, 0, 7)), np.zeros(0), np.zeros(0)

    def driven(self, motion: FloatArray, variance: FloatArray) -> _Nearby:
        """Return what is near after a motion (7,); variances (2,) of each axis and angle."""
        turn, count, after = se3.rotation_of(motion), len(self.row), _Nearby()
        after.row, after.sigma_rad, after.seen_s = self.row, self.sigma_rad.copy(), self.seen_s.copy()
        after.place = (self.place - motion[:3]) @ turn
        after.ways = se3.compose(se3.inverse(motion), self.ways)
        blocks = self.covariance.reshape(count, 3, count, 3)
        blocks = np.einsum("ai,kalb->kilb", turn, blocks)
        blocks = np.einsum("kilb,bj->kilj", blocks, turn)
        by = se3.rigid_directions(after.place)
        after.covariance = blocks.reshape(3 * count, 3 * count) + (by * np.repeat(variance, 3)) @ by.T
        return after

    def keep(self, some: BoolArray) -> None:
        """Forget all but some."""
        at = se2.xy_rows(np.flatnonzero(some), 3)
        self.row, self.place, self.covariance = self.row[some], self.place[some], self.covariance[np.ix_(at, at)]
        self.ways, self.sigma_rad, self.seen_s = self.ways[:, some], self.sigma_rad[some], self.seen_s[some]

    def meet(self, row: IntArray) -> None:
        """Add landmarks of which nothing is known yet: within `FAR_M` of the robot."""
        before, count = len(self.covariance), len(row)
        self.row = np.append(self.row, row)
        self.place = np.vstack([self.place, np.zeros((count, 3))])
        covariance = np.diag(np.full(before + 3 * count, FAR_M**2))
        covariance[:before, :before] = self.covariance
        self.covariance = covariance
        self.ways = np.concatenate([self.ways, se3.identity(2, count)], axis=1)
        self.sigma_rad, self.seen_s = (np.append(each, np.zeros(count)) for each in (self.sigma_rad, self.seen_s))

    def update(self, at: IntArray, place: FloatArray, covariance: FloatArray) -> None:
        """Use detections of landmarks in rows `at` (n,)."""
        rows = se2.xy_rows(at, 3)
        spread = self.covariance[np.ix_(rows, rows)]
        for k in range(len(at)):
            spread[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += covariance[k]
        gain = np.linalg.solve(spread, self.covariance[rows]).T
        self.place = self.place + (gain @ (place - self.place[at]).ravel()).reshape(-1, 3)
        after = self.covariance - gain @ self.covariance[rows]
        self.covariance = 0.5 * (after + after.T)


class _Match(NamedTuple):
    """Pairings that are certain: rows of a view with rows of what is near; p (n,) of each detection to be new; and
    the evidence over all being new [nats].
    """

    source: IntArray
    target: IntArray
    p_new: FloatArray
    evidence: float


@dataclass(frozen=True, slots=True)
class _Solved:
    """Landmarks (M,) of detections at the optimum, and what was linearised there."""

    row: IntArray
    estimate: SpatialEstimate
    smoother: SpatialSmoother
    now: SpatialLinear


class SpatialAssociator:
    """Associate all detections of a recording in space.

    Args:
        intake: the recording, in which every class is one landmark.
        kind: (M, 2) class and name of every detection that it uses, `UNKNOWN` for none: different ones are never one
            landmark's.
    """

    def __init__(self, intake: SpatialIntake, kind: IntArray) -> None:
        problem = self._problem = _thinned(intake)
        self._kind = kind
        settings = problem.settings
        goes = CAUTION * settings.drift_m, CAUTION * settings.drift_rad
        self._noise = SpatialNoise(*goes, pixel=settings.sigma_px)
        mount = problem.mount[problem.sensor]
        self._at = se3.transform(mount, problem.measured[:, :3])
        self._root = INFLATION * se3.rotation_of(mount) @ np.linalg.inv(problem.measured_root)
        self._ways = se3.compose(mount, problem.either)
        self._turned = problem.kind != POINT
        self._view = np.unique(problem.pose_row * len(problem.mount) + problem.sensor, return_inverse=True)[1]
        self._row: IntArray = np.full(len(self._view), NOBODY)
        self._of = np.zeros((0, 2), dtype=np.int64)  # class and name of each landmark
        self._density = _density(np.zeros((0, 3)), np.zeros(0, dtype=np.int64))

    def finish(self) -> IntArray:
        """Return (M,) the landmark of every detection, numbered as they were met; `NOBODY` for none."""
        self._follow()
        row = _without(self._row, np.zeros(len(self._of), dtype=np.bool_))
        solved = self._merged(self._learned(row, _driven(self._problem)))
        for _ in range(LAST_ROUNDS):
            again = self._with_overlooked(self._reassigned(solved), solved.estimate.pose)
            again = _without(again, np.bincount(again[again >= 0]) < FEWEST_SIGHTINGS)
            if np.array_equal(again, solved.row):
                break
            solved = self._merged(self._learned(again, solved.estimate.pose))
        return _without(solved.row, np.bincount(solved.row[solved.row >= 0]) < FEWEST_SIGHTINGS)

    def _follow(self) -> None:
        """Pair the detections of every view with what was seen in the last seconds."""
        problem, near = self._problem, _Nearby()
        begin = np.searchsorted(problem.pose_row, np.arange(len(problem.stamp_s) + 1))
        for frame, now_s in enumerate(problem.stamp_s.tolist()):
            near.keep(now_s - near.seen_s <= FORGET_S)
            rows = np.arange(begin[frame], begin[frame + 1])
            views = [rows[self._view[rows] == one] for one in np.unique(self._view[rows])]
            if frame:
                near = self._after_driving(near, frame, views[0])
            for view in views:
                self._use(near, view, self._match(near, view), now_s)

    def _after_driving(self, before: _Nearby, frame: int, view: IntArray) -> _Nearby:
        """What is near after the motion to a frame; if nothing is where it should be, after one that slipped."""
        motion, lasted_s = self._problem.increment[frame - 1], self._problem.lasted_s[frame - 1]
        variance = lasted_s * np.array([self._noise.translation, self._noise.rotation]) ** 2
        near = before.driven(motion, variance)
        match = self._match(near, view)
        if len(match.source) or not len(near.row):
            return near
        for times in range(1, SLIPS + 1):
            slipped = before.driven(motion, SLIP ** (2 * times) * variance)
            other = self._match(slipped, view)
            if len(other.source) and other.evidence >= match.evidence + times * SLIP_NATS:
                return slipped
        return near

    def _match(self, near: _Nearby, view: IntArray) -> _Match:
        """A view's detections weighed against what is near."""
        source, target = (each.ravel() for each in np.indices((len(view), len(near.row))))
        kept = alike(self._kind[view[source]], self._of[near.row[target]])
        source, target = source[kept], target[kept]
        own = self._covariance(view)
        innovation = self._at[view[source]] - near.place[target]
        at = 3 * target[:, None] + np.arange(3)
        spread = near.covariance[at[:, :, None], at[:, None, :]] + own[source]
        squared = np.einsum("ki,ki->k", innovation, np.linalg.solve(spread, innovation[..., None])[..., 0])
        inside = squared <= gates(1, CONFIDENCE, 3)[1]
        inside[inside] = self._turned_alike(view[source[inside]], near, target[inside])
        source, target, innovation, spread = source[inside], target[inside], innovation[inside], spread[inside]
        rows = se2.xy_rows(target, 3)
        joint = near.covariance[np.ix_(rows, rows)].reshape(len(source), 3, len(source), 3)
        joint = joint + (source[:, None] == source)[:, None, :, None] * own[source][:, :, None, :]
        log_det, least = np.linalg.slogdet(spread)[1], np.linalg.slogdet(own[source])[1]
        # what is followed has a neighbourhood that is known; elsewhere the gate may hold another landmark by chance
        followed = log_det <= least + FOLLOWED
        new = np.log(np.where(followed, UNMET, 1.0) * self._density)
        new -= NAMED_NATS * same_name(self._kind[view[source]], self._of[near.row[target]])
        pairs = Pairings(
            source, target, innovation, joint.reshape(3 * len(source), 3 * len(source)), new, len(view), None, least
        )
        probability, evidence, _ = pairing_probability(pairs, confidence=CONFIDENCE)
        known = np.zeros(len(view))
        np.add.at(known, source, probability)
        best = np.zeros(len(source), dtype=np.bool_)
        if len(source):
            order = np.lexsort((-probability, source))
            best[order[np.diff(source[order], prepend=-1) > 0]] = True
        tight = best & (known[source] > 1.0 - P_NEW) & (log_det < 3.0 * math.log(TIGHT_M2))
        taken = np.flatnonzero((probability > 1.0 - P_NEW) | tight)
        return _Match(source[taken], target[taken], 1.0 - known, evidence)

    def _turned_alike(self, detection: IntArray, near: _Nearby, target: IntArray) -> BoolArray:
        """(K,) which detections are turned as landmarks are, in one of the two ways in which either was seen."""
        away_s = self._problem.stamp_s[self._problem.pose_row[detection]] - near.seen_s[target]
        sigma = np.hypot(self._noise.rotation * np.sqrt(away_s), near.sigma_rad[target])
        return self._within(detection, near.ways[:, target], near.sigma_rad[target] > 0.0, sigma)

    def _within(self, detection: IntArray, ways: FloatArray, turned: BoolArray, sigma: FloatArray) -> BoolArray:
        """(K,) which detections have the orientation of ways (2, K, 7), known to within sigma (K,), or either none."""
        symmetries = self._problem.symmetries[self._problem.place[detection]]
        mine = np.repeat(self._ways[:, detection], 2, axis=0)
        angle = symmetries.angle_between(mine, np.concatenate([ways, ways])).min(axis=0)
        sigma = np.hypot(np.hypot(sigma, self._problem.sigma_rad[detection]), TURN_FLOOR_RAD)
        return np.asarray(~turned | ~self._turned[detection] | (angle <= TURN_SIGMAS * sigma))

    def _use(self, near: _Nearby, view: IntArray, match: _Match, now_s: float) -> None:
        """Update with the certain pairings, and start landmarks where none is near enough."""
        known = view[match.source]
        self._row[known] = near.row[match.target]
        self._of[self._row[known]] = np.maximum(self._of[self._row[known]], self._kind[known])
        new = view[match.p_new >= P_NEW]
        self._row[new] = len(self._of) + np.arange(len(new))
        self._of = np.vstack([self._of, self._kind[new]])
        near.meet(self._row[new])
        seen = np.append(known, new)
        at = np.append(match.target, len(near.row) - len(new) + np.arange(len(new)))
        near.update(at, self._at[seen], self._covariance(seen))
        sigma = np.where(self._turned[seen], self._problem.sigma_rad[seen], 0.0)
        near.ways[:, at], near.sigma_rad[at], near.seen_s[at] = self._ways[:, seen], sigma, now_s

    def _learned(self, row: IntArray, pose: FloatArray) -> _Solved:
        """Landmarks (M,) at the optimum, and the noise there, from poses that may be far off."""
        problem = self._problem_of(row)
        points = converged(problem.as_points(), first_places(problem, pose), self._noise, heavy_rounds=ROUNDS)
        noise = points.noise
        if problem.oriented.any():
            problem, start = _one_way(problem, points.estimate, points.now.weight)
            noise = converged(problem, start, noise, heavy_rounds=ROUNDS).noise
        self._noise = replace(noise, translation=CAUTION * noise.translation, rotation=CAUTION * noise.rotation)
        return self._solved(row, points.estimate.pose)

    def _problem_of(self, row: IntArray) -> SpatialProblem:
        """The measurements of landmarks (M,)."""
        problem, used = self._problem, np.flatnonzero(row >= 0)
        some = {name: getattr(problem, name)[used] for name in OF_DETECTIONS}
        first = np.unique(row[used], return_index=True)[1]
        turned = np.zeros(len(first), dtype=np.bool_)
        turned[row[used][self._turned[used]]] = True
        symmetries = problem.symmetries[problem.place[used[first]]]
        return replace(problem, **some, place=row[used], oriented=turned, symmetries=symmetries)

    def _solved(self, row: IntArray, pose: FloatArray) -> _Solved:
        """The optimum of landmarks (M,), from poses that may be far off: positions first, then orientations, too."""
        problem = self._problem_of(row)
        points = SpatialSmoother(problem.as_points(), pose)
        estimate, _ = points.optimum(first_places(problem, pose), self._noise, heavy=True)
        estimate, now = points.optimum(estimate, self._noise, heavy=False)
        smoother = points
        if problem.oriented.any():
            problem, estimate = _one_way(problem, estimate, now.weight)
            smoother = SpatialSmoother(problem, pose)
            estimate, _ = smoother.optimum(estimate, self._noise, heavy=True)
            estimate, now = smoother.optimum(estimate, self._noise, heavy=False)
        self._density = _density(estimate.place[:, :3], np.bincount(problem.place))
        return _Solved(row, estimate, smoother, now)

    def _merged(self, solved: _Solved) -> _Solved:
        """All landmarks that are one merged, while there are any."""
        refused: set[tuple[int, int]] = set()
        for _ in range(MERGE_ROUNDS):
            among = np.ones(len(solved.estimate.place), dtype=np.bool_)
            solution = self._compared(solved)
            pairs = propose_merges(solution, probability=P_MERGE, among=among, last=True, refused=refused)
            following = self._trial(solved, solution.sightings, pairs, refused)
            if following is None:
                break
            solved = following
            refused.clear()
        return solved

    def _trial(
        self, solved: _Solved, sightings: IntArray, pairs: list[tuple[int, int]], refused: set[tuple[int, int]]
    ) -> _Solved | None:
        """All pairs merged, or half of them, and so on, until the cost agrees; one alone may be refused."""
        while pairs:
            becomes = np.arange(len(sightings))
            for younger, older in pairs:  # in the order of the younger ones
                becomes[younger] = becomes[older]
            row = np.where(solved.row >= 0, becomes[solved.row], NOBODY)
            trial = self._solved(_without(row, np.zeros(len(sightings), dtype=np.bool_)), solved.estimate.pose)
            lesser = np.array([min(sightings[u], sightings[o]) for u, o in pairs])
            numbers = np.where(solved.smoother.problem.oriented[[u for u, _ in pairs]], 6, 3)
            rise = 0.5 * numbers * np.minimum(RISE_NATS + RISE_SHARE * lesser, RISE_MOST)  # stated for two numbers
            if trial.now.cost - solved.now.cost <= rise.sum():
                return trial
            if len(pairs) == 1:
                refused.update(pairs)
            pairs = pairs[: len(pairs) // 2]
        return None

    def _compared(self, solved: _Solved) -> Solution:
        """The landmarks as `propose_merges` wants them."""
        used, count = np.flatnonzero(solved.row >= 0), len(solved.estimate.place)
        row, of, n = solved.row[used], labels_of(self._kind, solved.row, count), len(self._problem.stamp_s)
        spread, turned = solved.smoother.spread(solved.now), solved.smoother.problem.oriented
        at = spread.own_first[n : n + count, None, None] + np.arange(3)
        own = spread.own[at + np.where(turned, 6, 3)[:, None, None] * np.arange(3)[:, None]]
        wide = self._wide_m()[used]
        order, sightings = np.lexsort((wide, row)), np.bincount(row, minlength=count)
        middle = wide[order[np.cumsum(sightings) - sightings + sightings // 2]]
        last_s = np.zeros(count)
        np.maximum.at(last_s, row, self._problem.stamp_s[self._problem.pose_row[used]])
        like = np.array([alike(each, of).mean() for each in of])
        differences = _Differing(solved, SHARED_M**2 + (SHARED_SHARE * middle) ** 2, np.log(self._density * like), of)
        return Solution(
            solved.estimate.place[:, :3], own, differences, sightings, last_s,
            *seen_together(self._view[used], row, int(self._view.max()) + 1, count), of,
        )  # fmt: skip

    def _covariance(self, rows: IntArray | slice) -> FloatArray:
        """(K, 3, 3) of positions on the robot, at the noise levels as they are."""
        root = self._root[rows] * np.array([self._noise.across, self._noise.across, self._noise.along])
        return np.asarray(root @ np.swapaxes(root, 1, 2))

    def _wide_m(self) -> FloatArray:
        """(M,) standard deviation of a position, along its widest axis."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self._covariance(slice(None)))[:, 2]))

    def _reassigned(self, solved: _Solved) -> IntArray:
        """(M,) the landmark that every detection most probably is of, given all poses; see `revise.reassigned`."""
        pose, place = solved.estimate.pose[self._problem.pose_row], solved.estimate.place
        at, gate = se3.transform(pose, self._at), gates(1, CONFIDENCE, 3)[1]
        reach = TAIL * math.sqrt(LEFT * gate) * float(np.quantile(self._wide_m(), 0.99))
        seen, row = in_reach(place[:, :3], at, reach)
        kept = may_be_of(self._kind[seen], labels_of(self._kind, solved.row, len(place))[row])
        seen, row = seen[kept], row[kept]
        turned = se3.compose(se3.inverse(pose[seen]), place[row])
        oriented = solved.smoother.problem.oriented[row]
        kept = self._within(seen, np.stack([turned, turned]), oriented, np.zeros(len(seen)))
        seen, row = seen[kept], row[kept]
        axes = se3.rotation_of(pose[seen])
        spread = LEFT * axes @ self._covariance(seen) @ np.swapaxes(axes, 1, 2)
        off = at[seen] - place[row, :3]
        squared = np.einsum("ki,ki->k", off, np.linalg.solve(spread, off[..., None])[..., 0])
        score = -0.5 * (np.linalg.slogdet(spread)[1] + 3.0 * math.log(2.0 * math.pi)) - math.log(self._density)
        tail = math.log(TAIL_SHARE) - 3.0 * math.log(TAIL) - 0.5 * squared / TAIL**2
        score += np.logaddexp(math.log(1.0 - TAIL_SHARE) - 0.5 * squared, tail)
        inside = (squared < TAIL**2 * gate) & (score > 0.0)
        return most_probable(seen[inside], row[inside], score[inside], self._view, len(place))

    def _with_overlooked(self, row: IntArray, pose: FloatArray) -> IntArray:
        """(M,) landmarks, with new ones where detections of none lie together in views enough."""
        left = np.flatnonzero(row == NOBODY)
        at = se3.transform(pose[self._problem.pose_row[left]], self._at[left])
        found = lying_together(at, self._wide_m()[left], self._kind[left], self._view[left])
        after = row.copy()
        for k, mine in enumerate(found):
            after[left[mine]] = int(row.max(initial=-1)) + 1 + k
        return after


class _Differing:
    """Differences of pairs of landmarks: of points in three numbers, of poses in six.

    Args:
        solved: the landmarks.
        shared: (L,) variance [m^2] of what sightings from one place have in common.
        log_density: (L,) of landmarks like each, a cubic metre.
        kind: (L, 2) class and name of each.
    """

    def __init__(self, solved: _Solved, shared: FloatArray, log_density: FloatArray, kind: IntArray) -> None:
        problem, self._kind = solved.smoother.problem, kind
        self._place, self._turned = solved.estimate.place, problem.oriented
        self._symmetries, self._first = problem.symmetries, len(problem.stamp_s)
        self._shared, self._log_density = shared, log_density
        self._factorised = solved.smoother.factorised(solved.now)

    def __call__(self, younger: IntArray, older: IntArray) -> Differences:
        """Return those of pairs."""
        both = self._turned[younger] & self._turned[older]
        dim = 6 if both.any() else 3
        gap, by = self._linearised(younger, older, both)
        rows, at = np.unique(np.concatenate([younger, older]), return_inverse=True)
        width = np.where(self._turned[rows], 6, 3)
        first = np.cumsum(width) - width
        joint = np.zeros((int(width.sum()) + 1, int(width.sum()) + 1))  # the last: what has no orientation
        joint[:-1, :-1] = self._factorised.joint(self._first + rows)
        position = (first[:, None] + np.arange(3)).ravel()
        joint[position, position] += np.repeat(self._shared[rows], 3)
        turn = (first[width == 6, None] + np.arange(3, 6)).ravel()
        joint[turn, turn] += SHARED_RAD**2
        columns = np.where(np.arange(6) < width[:, None], first[:, None] + np.arange(6), len(joint) - 1)
        at = columns[at.reshape(2, -1)].transpose(1, 0, 2).reshape(len(younger), 12)
        own = by @ joint[at[:, :, None], at[:, None, :]] @ by.transpose(0, 2, 1)
        # a pair without orientations has none to differ by: three numbers that are 0 in any case
        idle = np.where(both[:, None], 0.0, np.arange(6) >= 3)
        own += idle[:, :, None] * np.eye(6)
        new = self._log_density[younger] - NAMED_NATS * same_name(self._kind[younger], self._kind[older])
        new += np.where(both, self._turns(younger, older), -1.5 * math.log(2.0 * math.pi))

        def together(some: IntArray) -> FloatArray:
            used, column = np.unique(at[some], return_inverse=True)
            onto = np.zeros((len(some), 6, len(used)))
            np.put_along_axis(onto, np.repeat(column.reshape(len(some), 1, 12), 6, axis=1), by[some], axis=2)
            rows = onto[:, :dim].reshape(len(some) * dim, -1)
            return np.asarray(rows @ joint[np.ix_(used, used)] @ rows.T + np.diag(idle[some, :dim].ravel()))

        new += 0.0 if dim == 6 else 1.5 * math.log(2.0 * math.pi)
        return Differences(gap[:, :dim], own[:, :dim, :dim], new, together)

    def _linearised(self, younger: IntArray, older: IntArray, both: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Gaps (K, 6), and their derivatives (K, 6, 12) by the two."""
        gap, by = np.zeros((len(younger), 6)), np.zeros((len(younger), 6, 12))
        one, other = self._place[younger], self._place[older]
        one = self._symmetries[younger].nearest(one, other)
        gap[both] = se3.local(other[both], one[both])
        by[both, :, :6] = se3.right_jacobian_inverse(gap[both])
        by[both, :, 6:] = -se3.right_jacobian_inverse(-gap[both])
        gap[~both, :3] = one[~both, :3] - other[~both, :3]
        for some, columns, sign in ((younger, slice(0, 3), 1.0), (older, slice(6, 9), -1.0)):
            axes = np.where(self._turned[some, None, None], se3.rotation_of(self._place[some]), np.eye(3))
            by[~both, :3, columns] = sign * axes[~both]
        return gap, by

    def _turns(self, younger: IntArray, older: IntArray) -> FloatArray:
        """(K,) log density of the orientation of another landmark [1/rad^3]: any, or like one of those there are."""
        count, found = len(self._place), np.zeros(len(younger))
        names, row = np.unique(younger, return_inverse=True)
        angle = np.stack([self._symmetries.angle_between(self._place[k], self._place) for k in names])
        like = np.where(self._turned, np.exp(-0.5 * (angle / ALIKE_RAD) ** 2), 0.0)
        like /= (2.0 * math.pi) ** 1.5 * ALIKE_RAD**3
        found = like.sum(axis=1)[row] - like[row, younger] - like[row, older]
        return np.asarray(np.log(0.5 / (8.0 * math.pi**2) + 0.5 * np.maximum(found, 0.0) / max(count, 1)))


def _one_way(
    problem: SpatialProblem, estimate: SpatialEstimate, weight: FloatArray
) -> tuple[SpatialProblem, SpatialEstimate]:
    """The problem with the one orientation of each tag seen by its corners that fits, and places turned."""
    estimate = replace(estimate, place=oriented(problem, estimate, weight))
    seen = np.stack([as_seen(problem, estimate, measured) for measured in problem.either])
    angle = problem.symmetries[problem.place].angle_between(seen, estimate.place[problem.place])
    measured = np.where((angle[0] <= angle[1])[:, None], problem.either[0], problem.either[1])
    kind = np.where(problem.kind == POINT, POINT, POSE)
    return replace(problem, kind=kind, measured=measured), estimate


def _thinned(intake: SpatialIntake) -> SpatialProblem:
    """The problem with only the poses that saw something, after the first."""
    problem = intake.problem
    kept = np.unique(problem.pose_row)
    pose = intake.driven_pose[kept]
    stamp_s = problem.stamp_s[kept]
    return replace(
        problem, stamp_s=stamp_s - stamp_s[0], increment=se3.between(pose[:-1], pose[1:]), lasted_s=np.diff(stamp_s),
        pose_row=np.searchsorted(kept, problem.pose_row),
    )  # fmt: skip


def _driven(problem: SpatialProblem) -> FloatArray:
    """(N, 7) poses along the odometry."""
    pose = se3.identity(len(problem.stamp_s))
    for k, motion in enumerate(problem.increment):
        pose[k + 1] = se3.compose(pose[k], motion)
    return pose


def _density(place: FloatArray, sightings: IntArray) -> float:
    """Landmarks a cubic metre, as `landmark_density` counts them."""
    volume = float(np.prod(np.maximum(np.ptp(place, axis=0), LEAST_M))) if len(place) else 0.0
    return effective_number(sightings) / max(volume, SMALLEST_M2)


def _without(row: IntArray, gone: BoolArray) -> IntArray:
    """(M,) landmarks without some (L,), numbered in the order in which they were met."""
    kept = (row >= 0) & ~gone[row]
    names, first, rank = np.unique(row[kept], return_index=True, return_inverse=True)
    order = np.empty(len(names), dtype=np.int64)
    order[np.argsort(first, kind="stable")] = np.arange(len(names))
    found = np.full(len(row), NOBODY)
    found[kept] = order[rank]
    return found
