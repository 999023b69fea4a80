"""Problem, estimate and noise: the three nouns that the estimators of this package exchange."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from evermap.config import CleaningConfig, OdometryConfig
from evermap.errors import DataError
from evermap.estimate.sparse.elimination import Spread
from evermap.estimate.sparse.system import Factorised, Slices, exhaust
from evermap.geometry import se2, se3
from evermap.slam.base_problem import BaseProblem
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.gaps import find_spikes
from evermap.slam.kernels import N_STATES, kernel
from evermap.slam.preintegration import Intervals, Preintegration
from evermap.types import ANY_BEARING_RAD, BoolArray, FloatArray, IntArray, Recording

USUAL = OdometryConfig()
FEWEST_ROWS = 20
"""Rows of odometry from which its jitter is estimated, of all and around each."""
TURN_ROWS = 5
"""Rows of odometry in a span from which its jitter is told."""
SPANS = 2
"""Spans `turn_s` until a row, of which the calmest tells the jitter: a turn that begins or ends is none."""
LIMITS = CleaningConfig()
"""What no robot drives."""
TRIMMED = 0.6234
"""Mean of a squared standard normal below its 90 % quantile."""


@dataclass(frozen=True, slots=True)
class Drive:
    """Odometry prepared for integration.

    Attributes:
        stamp_s: (n,) strictly increasing.
        velocity: (n, 4) forward, lateral, turn; row i holds until stamp i + 1. The fourth is as much of the turn rate
            as is no jitter (`beyond_jitter`): what its scale acts on.
        unknown: (n,) extra variance per second, where the odometry was silent.
    """

    stamp_s: FloatArray
    velocity: FloatArray
    unknown: FloatArray
    _preintegration: Preintegration = field(init=False, repr=False, compare=False, default_factory=Preintegration)

    @property
    def jitter(self) -> FloatArray:
        """(n, 3) variance of what in the velocities is another from row to row: noise of the report, not of the motion.

        By second differences of the rows around each, the largest tenth of all left out: a robot that starts or stops
        does not jitter, nor does one that stands, where the odometry is exact.
        """
        if len(self.velocity) < FEWEST_ROWS:
            return np.zeros((len(self.velocity), 3))
        square = np.diff(self.velocity[:, :3], n=2, axis=0) ** 2
        kept = square <= np.quantile(square, 0.9, axis=0)
        totals = np.zeros((2, len(square) + 1, 3))
        totals[:, 1:] = np.cumsum([np.where(kept, square, 0.0), kept], axis=1)
        middle = np.arange(len(self.velocity)) - 1  # of the second difference that is centred at a row
        first = np.clip(middle - FEWEST_ROWS // 2, 0, len(square))
        last = np.clip(middle + FEWEST_ROWS // 2 + 1, 0, len(square))
        around, count = totals[:, last] - totals[:, first]
        return np.asarray(around / np.maximum(count, 1.0) / (6.0 * TRIMMED))

    def rows_at(self, stamp_s: FloatArray) -> IntArray:
        """Return (N,) rows of the velocities that hold at stamps (N,), on the odometry's clock."""
        return np.clip(np.searchsorted(self.stamp_s, stamp_s, side="right") - 1, 0, len(self.stamp_s) - 1)

    def is_alike(self, other: Drive) -> bool:
        """Return whether another has the same rows."""
        return all(np.array_equal(getattr(self, of), getattr(other, of)) for of in ("stamp_s", "velocity", "unknown"))

    def between(self, stamp_s: FloatArray, states: FloatArray) -> Intervals:
        """Return motion between each two consecutive of the (N,) stamps, for (11,) calibration states."""
        return exhaust(self.in_slices(stamp_s, states))

    def in_slices(self, stamp_s: FloatArray, states: FloatArray) -> Slices[Intervals]:
        """Return what `between` does, in slices."""
        return self._preintegration.between(stamp_s, states, (self.stamp_s, self.velocity, self.unknown))

    @classmethod
    def of(cls, recording: Recording, settings: OdometryConfig = USUAL) -> Drive:
        """Return the odometry of a recording, as `from_rows`; stamps count from its first row.

        Raises:
            DataError: there is none.
        """
        odometry = recording.odometry
        if len(odometry) == 0:
            raise DataError(f"{recording.name}: no odometry", hint="velocities or increments in odometry.csv")
        velocity = np.column_stack([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps])
        return cls.from_rows(odometry.stamp_s - odometry.stamp_s[0], velocity, settings)

    @classmethod
    def from_rows(cls, stamp_s: FloatArray, velocity: FloatArray, settings: OdometryConfig = USUAL) -> Drive:
        """Return velocities as reported; silences longer than `silence_s` become 'standing still, but who knows'.

        What is not known grows over a silence of length T to the way that the last speed would have led, `(v T)^2`, up
        to that of `longest_silence_s`. Stamps (n,) strictly increase; velocities are (n, 3) forward, lateral, turn, or
        (n, 4) with what is known of the turn's jitter. A step that no robot drives, as of an estimate that is corrected
        or of a robot that is carried, may be what the odometry says, or none: its standard deviation is itself.
        """
        if velocity.shape[1] == 3:
            velocity = np.column_stack([velocity, beyond_jitter(stamp_s, velocity[:, 2], settings)])
        silence, jumps = np.diff(stamp_s), find_spikes(stamp_s, velocity[:, :3].T, LIMITS)
        usual_s = np.minimum(silence, np.median(silence)) if len(silence) else silence
        unknown = np.where(jumps, (velocity[:, :3] ** 2).sum(axis=1) * np.append(usual_s, 0.0), 0.0)
        if len(silent := np.flatnonzero(silence > settings.silence_s)):
            at = silent + 1
            counted = np.minimum(silence[silent], settings.longest_silence_s)
            last = np.maximum(silent - jumps[silent], 0)
            rate = settings.silent_variance + (velocity[last, :3] ** 2).sum(axis=1) * counted
            rate = rate * counted / silence[silent]
            unknown = np.insert(unknown, at, rate)
            held_s = np.where(jumps[silent], usual_s[silent], 0.5 * settings.silence_s)
            stamp_s = np.insert(stamp_s, at, stamp_s[silent] + held_s)
            velocity = np.insert(velocity, at, 0.0, axis=0)
        # after the last row nothing is known either
        stamps = np.append(stamp_s, stamp_s[-1] + 0.5 * settings.silence_s)
        return cls(stamps, np.vstack([velocity, np.zeros(4)]), np.append(unknown, settings.silent_variance))


def beyond_jitter(stamp_s: FloatArray, turn_radps: FloatArray, settings: OdometryConfig = USUAL) -> FloatArray:
    """Return (n,) turn rates [rad/s] without what may be jitter of their report, each by rows until itself.

    A scale that acts on jitter explains it by a scale of zero: where a robot drives straight on, poses do not jitter as
    its gyroscope does, and every row says so (attenuation by errors in variables: Fuller 1987, section 1.1). So a turn
    counts by the share of its square, on average over `turn_s`, that stands out of the jitter.
    """
    turn = np.ascontiguousarray(turn_radps, dtype=np.float64)
    return _beyond(np.ascontiguousarray(stamp_s, dtype=np.float64), turn, settings.turn_s, settings.stands_out)


@kernel
def _beyond(stamp: FloatArray, turn: FloatArray, turn_s: float, stands_out: float) -> FloatArray:
    """`beyond_jitter` of contiguous arrays."""
    count = len(stamp)
    beyond, turned, changed = np.empty(count), np.zeros(count + 1), np.zeros(count + 1)
    spans = np.zeros(SPANS + 1, np.int64)
    for row in range(count):
        turned[row + 1] = turned[row] + turn[row]
        if row > 1:
            changed[row + 1] = changed[row] + ((turn[row] - turn[row - 1]) - (turn[row - 1] - turn[row - 2])) ** 2
        spans[0], jitter = row + 1, np.inf
        for k in range(1, SPANS + 1):
            while stamp[spans[k]] <= stamp[row] - k * turn_s:
                spans[k] += 1
            rows = spans[k - 1] - max(spans[k], 2)
            if rows >= TURN_ROWS:
                jitter = min(jitter, (changed[spans[k - 1]] - changed[spans[k]]) / (6.0 * rows))
        rows = row + 1 - spans[1]
        mean, doubt = (turned[row + 1] - turned[spans[1]]) / rows, 0.0
        if jitter < np.inf:
            doubt = stands_out**2 * jitter / rows
        beyond[row] = turn[row] * max(1.0 - doubt / max(mean**2, 1e-300), 0.0)
    return beyond


@dataclass(frozen=True, slots=True)
class ConditionalPrior:
    """A landmark is at `mean + gain (landmark[given] - landmark_mean[given])`, to within `information`.

    Attributes:
        mean: (2,) prior position.
        information: (2, 2) inverse covariance once the others are known; zeros where the prior says nothing.
        given: (k,) rows of the landmarks it depends on.
        gain: (2, 2 k) how far it goes with them.
    """

    mean: FloatArray
    information: FloatArray
    given: IntArray
    gain: FloatArray

    def place(self, landmark: FloatArray, landmark_mean: FloatArray) -> FloatArray:
        """Return (2,) where the landmark is expected with the others at `landmark` (L, 2)."""
        return np.asarray(self.mean + self.gain @ (landmark[self.given] - landmark_mean[self.given]).ravel())


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem(BaseProblem):
    """All measurements and priors in the plane; stamps are on the clock of `drive`.

    Attributes:
        drive: the odometry.
        landmark_row: (M,) which landmark each detection is of.
        reading: (M, 2) range [m] and bearing [rad] as reported.
        sigma_given: (M, 2) standard deviations that came with a detection, nan where none did.
        mount: (3,) pose of the sensor on the robot.
        prior: of the calibration states, as the graph shall use it.
        start_pose: (3,) where the first pose is held.
        start_information: how firmly, [1/m^2] and [1/rad^2].
        landmark_mean: (L, 2) prior positions, zeros where there is none.
        landmark_information: (2 L, 2 L) sparse inverse of their joint prior covariance, empty where there is none.
            Blocks off the diagonal tie landmarks to each other, for example those that may have moved together. A dense
            array is taken, too.
        share: (M,) of the information of each detection that is new; None where all of it is.
        noise_shape: (M, 2) standard deviations over the noise levels, by the range, where none came with a detection;
            None where these are all alike.
        noise_by_range: whether that is sought.
    """

    COLUMNS = ("pose_row", "landmark_row", "reading", "sigma_given", "share", "noise_shape")

    drive: Drive
    landmark_row: IntArray
    reading: FloatArray
    sigma_given: FloatArray
    mount: FloatArray
    prior: CalibrationPrior
    start_pose: FloatArray
    start_information: float
    landmark_mean: FloatArray
    landmark_information: sparse.csr_array
    share: FloatArray | None = None
    noise_shape: FloatArray | None = None
    noise_by_range: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "landmark_information", sparse.csr_array(self.landmark_information))

    @property
    def seen_place(self) -> IntArray:
        """(M,) which landmark each detection is of."""
        return self.landmark_row

    @property
    def mapped(self) -> BoolArray:
        """(L,) landmarks that a prior map holds."""
        return np.asarray(self.landmark_information.diagonal()[::2] > 0.0)

    @property
    def has_bearing(self) -> BoolArray:
        """(M,) detections whose bearing was measured; of the others it says nothing of where the landmark is."""
        return np.asarray(~(self.sigma_given[:, 1] >= ANY_BEARING_RAD))

    def find_sigma(self, noise: Noise) -> FloatArray:
        """Return (M, 2) standard deviations of the detections: their own where they came with one."""
        learned = noise.detection if self.noise_shape is None else noise.detection * self.noise_shape
        return np.where(np.isfinite(self.sigma_given), self.sigma_given, learned)

    def with_places(self, count: int) -> Problem:
        """Return the problem with room for so many places; new ones have no prior."""
        new = max(0, count - len(self.landmark_mean))
        return replace(
            self,
            landmark_mean=np.pad(self.landmark_mean, ((0, new), (0, 0))),
            landmark_information=padded(self.landmark_information, new),
        )

    def prior_information(self, known: BoolArray) -> sparse.csr_array:
        """Return (2 K, 2 K) what the prior says about the K `known` landmarks alone, the others marginalised out.

        Leaving rows out of an information matrix would hold the others at their means; out of a covariance it is exact,
        which in terms of information is the Schur complement.
        """
        rows = np.flatnonzero(np.repeat(known, 2))
        kept = between_rows(self.landmark_information, rows)
        others = np.flatnonzero(np.repeat(~known, 2))
        ties = self.landmark_information[others][:, rows]
        others = others[np.diff(ties.indptr) > 0]
        if not len(others):
            return kept
        # all that is tied to what is tied, else it would be held at its mean
        _, group = connected_components(self.landmark_information, directed=False)
        others = np.flatnonzero(np.isin(group, group[others]) & ~np.repeat(known, 2))
        ties = self.landmark_information[others][:, rows]
        # pseudo-inverse: landmarks may be tied to each other but to no place
        rest = np.linalg.pinv(between_rows(self.landmark_information, others).toarray(), hermitian=True)
        return sparse.csr_array(kept - ties.T @ sparse.csr_array(rest) @ ties)

    def conditional_prior(self, row: int, known: BoolArray) -> ConditionalPrior:
        """Return the prior of landmark `row`, given the `known` ones (without it)."""
        first = self.landmark_information.indptr
        if first[2 * row] == first[2 * row + 2]:
            return ConditionalPrior(self.landmark_mean[row], np.zeros((2, 2)), np.zeros(0, np.int64), np.zeros((2, 0)))
        column = slice(2 * row, 2 * row + 2)
        mine = self.landmark_information[column]
        own = mine[:, column].toarray()
        if np.count_nonzero(mine.data) == np.count_nonzero(own):
            return ConditionalPrior(self.landmark_mean[row], own, np.zeros(0, dtype=np.int64), np.zeros((2, 0)))
        among = known.copy()
        among[row] = True
        information = self.prior_information(among).toarray()
        at = 2 * int(known[:row].sum())
        own = information[at : at + 2, at : at + 2]
        gain = -np.linalg.pinv(own, hermitian=True) @ np.delete(information[at : at + 2], [at, at + 1], axis=1)
        tied = gain.reshape(2, -1, 2).any(axis=(0, 2))
        given: IntArray = np.flatnonzero(known)[tied]
        return ConditionalPrior(self.landmark_mean[row], own, given, gain[:, np.repeat(tied, 2)])

    def until(self, n_poses: int, *, last_is_blind: bool = False) -> Problem:
        """Return the problem after `n_poses` poses; landmarks keep their rows.

        With `last_is_blind`, before the detections of the last of them.
        """
        stop = int(np.searchsorted(self.pose_row, n_poses - last_is_blind))
        measurements = tuple(tied.until(n_poses) for tied in self.measurements)
        return replace(self.seeing(slice(stop)), stamp_s=self.stamp_s[:n_poses], measurements=measurements)


def independent(blocks: FloatArray) -> sparse.csr_array:
    """Return the joint information (2 L, 2 L) of independent landmarks with blocks (L, 2, 2)."""
    given = np.flatnonzero(blocks.any(axis=(1, 2)))
    row = (2 * given[:, None, None] + np.array([[0, 0], [1, 1]])).ravel()
    column = (2 * given[:, None, None] + np.array([[0, 1], [0, 1]])).ravel()
    return sparse.csr_array((blocks[given].ravel(), (row, column)), shape=(2 * len(blocks), 2 * len(blocks)))


def padded(information: sparse.csr_array, new: int) -> sparse.csr_array:
    """Return the joint information with room for new landmarks behind the others, of which nothing is known."""
    size = information.shape[0] + 2 * new
    first = np.append(information.indptr, np.full(2 * new, information.indptr[-1]))
    return sparse.csr_array((information.data, information.indices, first), shape=(size, size))


def embed(matrix: FloatArray, rows: IntArray, size: int) -> sparse.csr_array:
    """Return a matrix (k, k) as rows and columns `rows` of one that is zero elsewhere."""
    at, to = np.repeat(rows, len(rows)), np.tile(rows, len(rows))
    return sparse.csr_array((matrix.ravel(), (at, to)), shape=(size, size))


def between_rows(information: sparse.csr_array, rows: IntArray) -> sparse.csr_array:
    """Return some rows and the same columns of a joint information."""
    picked: sparse.csr_array = information[rows][:, rows]
    return picked


@dataclass(frozen=True, slots=True)
class Estimate:
    """Values of everything sought.

    Attributes:
        pose: (N, 3) poses in the world.
        landmark: (L, 2) positions; nan where never seen.
        states: (11,) calibration states.
    """

    pose: FloatArray
    landmark: FloatArray
    states: FloatArray

    def moved(self, by: FloatArray) -> Estimate:
        """Return everything moved together by a motion (3,)."""
        return Estimate(se2.compose(by, self.pose), se2.transform(by, self.landmark), self.states)

    @property
    def known(self) -> BoolArray:
        """(L,) landmarks that have a position."""
        return np.asarray(np.isfinite(self.landmark[:, 0]))


class PlanarView:
    """The variables of a problem in the plane, as measurements see them: on the floor, which is level."""

    def poses(self, state: Estimate) -> FloatArray:
        """Return (N, 7) poses."""
        return se3.from_plane(state.pose)

    def places(self, state: Estimate) -> FloatArray:
        """Return (L, 3) positions of landmarks."""
        return np.column_stack([state.landmark, np.zeros(len(state.landmark))])

    def by_pose(self, by_twist: FloatArray) -> FloatArray:
        """Return derivatives (K, r, 3) by forward and lateral translation and by rotation."""
        return by_twist[..., [0, 1, 5]]

    def by_place(self, state: Estimate, place: IntArray, by_position: FloatArray) -> list[FloatArray]:  # noqa: ARG002
        """Return derivatives (r, 2) by positions on the floor."""
        return list(by_position[..., :2])


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations.

    Attributes:
        detection: (2,) range [m] and bearing [rad].
        odometry: (5,) in the order of `kernels.NOISE_NAMES`.
        outlier_log_odds: half the squared normalised residual at which an outlier is as likely as an inlier.
        pseudo_count: residuals that these levels count for where others are learned from them: keeps levels finite that
            a recording says nothing about.
    """

    detection: FloatArray
    odometry: FloatArray
    outlier_log_odds: float
    pseudo_count: float = 1.0

    @property
    def levels(self) -> FloatArray:
        """(7,) of detections, then of odometry."""
        return np.concatenate([self.detection, self.odometry])

    def of_detections(self, sigma_given: FloatArray) -> FloatArray:
        """Return (M, 2) standard deviation of every detection: its own where it came with one."""
        return np.where(np.isfinite(sigma_given), sigma_given, self.detection)


class Block(NamedTuple):
    """Position of a problem in a system of equations, which may contain several.

    Attributes:
        first: row of its first pose among the variables; the others follow.
        landmarks: (K,) variables of its known landmarks.
        border: first of its two variables of calibration states.
        odometry, detections: rows of its first factors of these kinds; the others follow.
        n_pairs: factors of odometry of the whole system, which are its first.
    """

    first: int
    landmarks: IntArray
    border: int
    odometry: int
    detections: int
    n_pairs: int


class Marginals:
    """Covariances at an optimum, worked out when they are asked for.

    Args:
        solved: the factorised normal equations, calibration states in their border.
        n_poses: N of them.
        n_detections: M.
        known: (L,) landmarks that have a position; what is asked of others is zero.
        block: where in the equations these are; None where they are all of it: poses, known landmarks, sensor and
            motion states, and their factors begin with odometry and detections.
    """

    def __init__(
        self, solved: Factorised, n_poses: int, n_detections: int, known: BoolArray, *, block: Block | None = None
    ) -> None:
        self._solved, self._n, self._m, self.known = solved, n_poses, n_detections, known
        n_known = int(known.sum())
        alone = Block(0, n_poses + np.arange(n_known), n_poses + n_known, 0, n_poses - 1, n_poses - 1)
        self._block = alone if block is None else block

    def of(self, block: Block, n_poses: int, n_detections: int, known: BoolArray) -> Marginals:
        """Return those of another block of the same equations."""
        other = Marginals(self._solved, n_poses, n_detections, known, block=block)
        other._held = self._held
        return other

    def in_slices(self) -> Slices[None]:
        """Compute all that the factorised equations hold, in slices."""
        self._held = yield from self._solved.spread(self._block.n_pairs)

    @cached_property
    def _held(self) -> Spread:
        return exhaust(self._solved.spread(self._block.n_pairs))

    @property
    def pose(self) -> FloatArray:
        """(N, 3, 3) covariance of every pose, in its own frame."""
        return self._held.of(self._block.first + np.arange(self._n), 3)

    @cached_property
    def consecutive(self) -> FloatArray:
        """(N, 3, 3) of pose i with pose i + 1; the last is zero."""
        first = self._block.odometry
        pairs = self._held.pairs[first : first + self._n - 1] if self._n > 1 else np.zeros((0, 3, 3))
        return np.concatenate([pairs, np.zeros((1, 3, 3))])

    @cached_property
    def landmark(self) -> FloatArray:
        """(L, 2, 2) covariance of every landmark."""
        landmark = np.zeros((len(self.known), 2, 2))
        landmark[self.known] = self._held.of(self._block.landmarks, 2)
        return landmark

    @cached_property
    def states(self) -> FloatArray:
        """(11, 11) covariance of the calibration states."""
        tree = self._solved.system.tree
        at = tree.in_border[self._block.border] + np.arange(N_STATES)
        return self._solved.border_covariance()[np.ix_(at, at)]

    @cached_property
    def with_states(self) -> FloatArray:
        """(G, 11) covariance of everything with the calibration states: poses, known landmarks, states."""
        tree, part = self._solved.system.tree, self._block
        begin = tree.begin
        first, states = begin[part.first], begin[part.border]
        rows = [
            np.arange(first, first + 3 * self._n),
            (begin[part.landmarks][:, None] + np.arange(2)).ravel(),
            np.arange(states, states + N_STATES),
        ]
        if not self._solved.system.has_border_throughout:
            found: FloatArray = self._solved.columns(part.border + np.arange(2))[np.concatenate(rows)]
            return found
        at = int(tree.in_border[part.border])
        return self._held.with_border[np.concatenate(rows), at : at + N_STATES]

    @property
    def explained_odometry(self) -> FloatArray:
        """(N - 1, 3, 3) `A S A'`: part of whitened odometry residuals that the estimate's own uncertainty explains."""
        return self._held.explained(self._block.odometry + np.arange(self._n - 1), 3)

    @property
    def explained_detections(self) -> FloatArray:
        """(M, 2, 2) the same of the detections, weighted as inliers."""
        return self._held.explained(self._block.detections + np.arange(self._m), 2)

    def joint(self, landmarks: IntArray, *, poses: IntArray | None = None, states: bool = False) -> FloatArray:
        """Return the joint covariance of some poses, some landmarks and, if wanted, the states, in this order."""
        part, rows = self._block, np.asarray(landmarks, dtype=np.int64)
        known, n_poses = self.known[rows], 0 if poses is None else len(poses)
        every = [self._variables(rows[known])]
        if poses is not None:
            every.insert(0, part.first + poses)
        if states:
            every.append(part.border + np.arange(2))
        found = self._solved.joint(np.concatenate(every))
        if known.all():
            return found
        before, after = np.ones(3 * n_poses, bool), np.ones(N_STATES if states else 0, bool)
        kept = np.concatenate([before, np.repeat(known, 2), after])
        joint = np.zeros((len(kept), len(kept)))
        joint[np.ix_(kept, kept)] = found
        return joint

    def each(self, landmarks: IntArray, poses: IntArray, by: FloatArray) -> FloatArray:
        """Return (V, R, R) the covariances of what each of V matrices makes of some poses, known landmarks and states.

        The matrices `by` are (V, R, 3 P + 2 L + 11).
        """
        every = [self._block.first + poses, self._variables(landmarks), self._block.border + np.arange(2)]
        return self._solved.each(np.concatenate(every), by)

    def product(self, landmarks: IntArray, matrix: FloatArray) -> FloatArray:
        """Return (2 L, K) the joint covariance of known landmarks (L,) times a matrix (2 L, K), without the former."""
        return self._solved.product(self._variables(landmarks), matrix)

    def _variables(self, landmarks: IntArray) -> IntArray:
        """Variables of known landmarks (K,)."""
        rank = np.cumsum(self.known) - 1
        return np.asarray(self._block.landmarks[rank[np.asarray(landmarks, dtype=np.int64)]])

    @cached_property
    def shared(self) -> FloatArray:
        """(G, G) of all landmarks and the states: dense, for few landmarks."""
        return self.joint(np.arange(len(self.known)), states=True)

    @cached_property
    def pose_shared(self) -> FloatArray:
        """(N, 3, G) of all poses with all landmarks and the states: dense, for few landmarks."""
        n = self._n
        kept = np.append(np.repeat(self.known, 2), np.ones(N_STATES, dtype=bool))
        cross = np.zeros((n, 3, len(kept)))
        found = self._solved.columns(np.append(self._block.landmarks, self._block.border + np.arange(2)))
        first = self._solved.system.tree.begin[self._block.first]
        cross[:, :, kept] = found[first : first + 3 * n].reshape(n, 3, -1)
        return cross
