"""The log evidence of a solved session, and what one more number would add to it.

**Evidence.** All unknowns are integrated out around the optimum (Laplace's method; MacKay 1992, *Bayesian
interpolation*): what the measurements and the priors are worth there, and half the log determinant of what is known of
the unknowns, which is the price of every state that was needed (Occam). A detection is an inlier of the noise that was
learned or an outlier whose density is that of the *nominal* noise at the squared residual at which both are alike, so
that neither a wider noise nor fewer detections come for nothing. Landmarks of which no map says anything are somewhere
within a room (`slam.room`). Odometry says where the robot goes, given what was driven: its density is that of motions,
whatever its scale, as one of velocities would be the larger the longer the drive is said to be. Solutions of the same
measurements can be compared, also where the measurements were transformed, if the volume of the transformation is
counted (`causes.suspect.Inputs`).

**Score.** A further number changes all residuals by a known direction `d`. With everything else marginalised, the
information on it is `h = d'd - b'H^-1 b`, `b = J'd`, and the cost falls by `g^2 / 2 h` at `-g / h`, with
`g = d'r - b'H^-1 J'r` (Rao's score test).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from evermap.estimate.graph import Graph, Linear
from evermap.estimate.sparse.system import Factorised, exhaust
from evermap.explain.causes.odometry import TURN
from evermap.explain.causes.suspect import SCALE, USUAL_P
from evermap.slam import intake
from evermap.slam.calibration import FORWARD, SLOPE
from evermap.slam.changes.gain import PLANE, log_onset, log_prior
from evermap.slam.correlation import Lasting
from evermap.slam.estimate import Solved
from evermap.slam.linearise import PlacePriors, detection_residuals
from evermap.slam.noise import gain_without_start
from evermap.slam.room import ROOM_M, hold_in_room
from evermap.slam.smoother import Smoother
from evermap.slam.space.against_map import log_map_density
from evermap.slam.space.intake import SpatialIntake, start_noise
from evermap.slam.space.linearise import ACROSS, ALONG, CORNERS, ORIENTATION, PIXEL, POSE, ROWS
from evermap.slam.space.problem import SpatialProblem
from evermap.slam.space.solve import SpatialSolved
from evermap.types import BoolArray, ChangeKind, FloatArray, IntArray, MapChange

LOG_2PI = math.log(2.0 * math.pi)
LEAST_INFORMATION = 1e-6
"""Information of the border's priors, at least: that on delays may be less than none."""
LEAST_EXTENT_M = 1e-3
"""Extent of a session, at least."""
LEAST_TOLD = 1e-6
"""Share of what is known of a scale that data say, from which they say anything."""
TINY = 1e-3
"""Share of a step in which all is linear."""
ODOMETRY, DETECTIONS, START, REST = 0, 1, 2, 3
"""Blocks of a graph, the same in the plane and in space."""
TURN_STATE = 9
"""The scale of turns among calibration states in the plane."""
AS_USUAL = 0.5
"""Probability beforehand that the odometry's scale in space is not as stated."""


@dataclass(frozen=True, slots=True)
class SpatialSession:
    """A session in space, solved: its input, and its values."""

    intake: SpatialIntake
    solved: SpatialSolved


AnySession: TypeAlias = Solved | SpatialSession
"""A session that is solved, in the plane or in space."""


class DetectionTerms(NamedTuple):
    """What M detections are worth.

    Attributes:
        squared: (M,) squared normalised residuals.
        log_peak: (M,) logarithms of the densities at no residual, by the noise that was learned.
        log_nominal: (M,) the same by the noise that is stated, or usual.
        log_odds: (M,) half the squared residual at which an outlier is as likely, by nominal noise; infinite for none.
        share: (M,) of their information that is new.
    """

    squared: FloatArray
    log_peak: FloatArray
    log_nominal: FloatArray
    log_odds: FloatArray
    share: FloatArray

    @property
    def log_density(self) -> FloatArray:
        """Return (M,) logarithms of the densities of the mixtures of inlier and outlier."""
        inlier = self.log_peak - 0.5 * self.squared
        return np.asarray(np.logaddexp(inlier, self.log_nominal - self.log_odds) - np.log1p(np.exp(-self.log_odds)))

    @property
    def cost(self) -> float:
        """Return what they are worth to the estimator: their negative log likelihood, 0 at no residual."""
        loss = -np.logaddexp(-0.5 * self.squared, -self.log_odds) + np.log1p(np.exp(-self.log_odds))
        return float(self.share @ loss)


class ScalePrior(NamedTuple):
    """What is meant of a scale that is a calibration state: it is as stated, or as is usual, or a cause has changed it.

    The prior that a solution was found with says less: its mean and width are chosen so that the estimate is the mean
    over the first two (`slam.calibration.narrow`), and wide enough for a map in another metre.

    Attributes:
        row: number of the border.
        off: its value, from what is stated.
        sigma: standard deviation where it is as is usual; 0 of a scale that is held as stated.
        p_needed: probability beforehand that it is not as stated.
        of_cause: standard deviation where a cause has changed it.
    """

    row: int
    off: float
    sigma: float
    p_needed: float
    of_cause: float


@dataclass(frozen=True)
class Optimum:
    """The graph of a session at its optimum, and what its evidence needs beside it.

    Attributes:
        graph: the problem, with a prior for everything of which nothing is known.
        now: the same, linearised.
        state: the values.
        detections: what these are worth.
        log_priors: logarithms of the densities of all priors but the border's where they are highest, and of the
            odometry's.
        log_prices: log prior probability of all changes that the solution has, but of those that `price_changes` asks.
        worth: share of what detections say that is new, given that errors last.
        scales: numbers of the border that causes are of, too, and what is meant of them.
    """

    graph: Graph[Any]
    now: Linear
    state: Any
    detections: DetectionTerms
    log_priors: float
    log_prices: float
    worth: float
    scales: tuple[ScalePrior, ...] = ()

    @cached_property
    def solved(self) -> Factorised:
        """The normal equations there, factorised once for all that is asked of them."""
        return exhaust(self.graph.factorised(self.now))


def log_evidence(session: AnySession, changes: tuple[MapChange, ...] = ()) -> float:
    """Return the log evidence of a solved session, with the prices of the changes that it was told to have [nats]."""
    return evidence_at(optimum_of(session), price_changes(session, changes))


def evidence_at(optimum: Optimum, log_prices: float = 0.0) -> float:
    """Return the log evidence at an optimum [nats]; `log_prices` is as `price_changes` returns it."""
    seen = optimum.detections
    fit = float(seen.share @ seen.log_density) - (optimum.now.cost - seen.cost)
    return fit + optimum.log_priors + (optimum.log_prices + log_prices) + log_volume(optimum)


def log_volume(optimum: Optimum) -> float:
    """Return the logarithm of the volume that the unknowns are left, times the density of the border's prior."""
    graph = optimum.graph
    information = np.maximum(graph.border.information, LEAST_INFORMATION)  # what jitter seems to say was taken off
    border = 0.5 * float(np.log(information).sum()) - 0.5 * len(information) * LOG_2PI
    count = int(graph.structure.layout.dim.sum())
    return border + 0.5 * count * LOG_2PI - 0.5 * optimum.solved.log_determinant


def price_scales(optimum: Optimum) -> tuple[float, float]:
    """Return log densities of what is found of scales, by what is meant of them, and by the solution's prior [nats].

    What data say of a scale is its posterior without that prior, all else marginalised: `off` from what is stated, with
    a standard deviation that is added to each prior's. A scale that is far from what is usual has the density, and pays
    the prior odds, of the cause that it is: as an alternative does that undoes the cause.
    """
    graph, meant, found = optimum.graph, 0.0, 0.0
    if not optimum.scales:
        return meant, found
    variance = np.diag(np.linalg.inv(optimum.solved.information))
    offset, prior = graph.border.offset(optimum.state), graph.border.information
    for row, off, sigma, p_needed, of_cause in optimum.scales:
        free = 1.0 - variance[row] * prior[row]  # share of what is known that is no prior's
        if sigma == 0.0 or not 1.0 >= free > LEAST_TOLD:
            meant += math.log(max(1.0 - p_needed, LEAST_TOLD))
            continue
        own = variance[row] / free
        told, stated = own / max(optimum.worth, LEAST_TOLD), (off - offset[row]) + offset[row] / free
        parts = [
            math.log(p) + _log_normal(stated, told + width**2)
            for p, width in ((1.0 - p_needed, 0.0), (p_needed, sigma), (USUAL_P, max(of_cause, sigma)))
            if p > 0.0
        ]
        meant += float(np.logaddexp.reduce(parts))
        found += _log_normal(offset[row] / free, own + 1.0 / prior[row])
    return meant, found


def _log_normal(off: float, variance: float) -> float:
    return -0.5 * (off**2 / variance + math.log(variance) + LOG_2PI)


def weigh_levels(session: AnySession) -> float:
    """Return by how much the log evidence of a solution is larger at noise levels that no start has pulled [nats].

    In the plane, where few steps of odometry say what a level is (`slam.noise.gain_without_start`).
    """
    if not isinstance(session, Solved) or not session.settings.estimate_noise:
        return 0.0
    outcome, values = session.outcome, session.outcome.graph_estimate
    inlier = outcome.smoother.inlier_probability(values)
    start = intake.beliefs(session.recording.sensor, session.settings)[1]
    return gain_without_start(outcome.problem, values, outcome.fit_marginals, inlier, outcome.noise.noise, start)


def list_used_rows(session: AnySession) -> IntArray:
    """Return (M,) rows of the recording's detections that a session used, in the order of its problem."""
    return session.prepared.used if isinstance(session, Solved) else session.intake.used


def optimum_of(session: AnySession) -> Optimum:
    """Return the graph of a session at its optimum."""
    return _in_plane(session) if isinstance(session, Solved) else _in_space(session)


def price_changes(session: AnySession, changes: tuple[MapChange, ...]) -> float:
    """Return the log prior probability of changes that a solution in the plane has; one in space prices its own."""
    if not isinstance(session, Solved):
        return 0.0
    size, table = len(session.outcome.problem.landmark_mean), session.settings.changes
    return sum(_price(change, size, PLANE, log_prior, table) for change in changes)


def _in_plane(solved: Solved) -> Optimum:
    outcome, problem, noise = solved.outcome, solved.outcome.problem, solved.outcome.noise.noise
    state = outcome.graph_estimate
    smoother = outcome.smoother
    if smoother.heavy or smoother.robust != solved.settings.robust or smoother.noise is not noise:
        smoother = Smoother(problem, noise, robust=solved.settings.robust)
    graph, now = smoother.graph(state), smoother.linearised(state)
    sigma = problem.find_sigma(noise)
    nominal = intake.beliefs(solved.recording.sensor, solved.settings)[1].of_detections(problem.sigma_given)
    residual = detection_residuals(problem, state) / sigma
    odds = noise.outlier_log_odds if solved.settings.robust else np.inf
    seen = DetectionTerms(
        (residual**2).sum(axis=1), -np.log(sigma).sum(axis=1) - LOG_2PI, -np.log(nominal).sum(axis=1) - LOG_2PI,
        np.full(len(sigma), odds), np.ones(len(sigma)),
    )  # fmt: skip
    n, known = len(problem.stamp_s), int(state.known.sum())
    log_priors = 1.5 * (math.log(problem.start_information) - LOG_2PI)
    free = np.ones(known, dtype=np.bool_)
    for block in graph.blocks[REST:]:
        if isinstance(block, PlacePriors):
            free[block.ties.ravel() - n] = False
            size = np.linalg.svd(block.root, compute_uv=False)
            size = size[size > 1e-9 * size.max(initial=0.0)]
            log_priors += float(np.log(size).sum()) - 0.5 * len(size) * LOG_2PI
    held, count, in_room = hold_in_room(graph, n + np.flatnonzero(free))
    log_priors += in_room - 0.5 * count * LOG_2PI
    log_priors -= _in_own_room(state.pose[:, :2], state.landmark[state.known])
    log_priors += _odometry_peak(graph, now, 3, slice(3, 6))
    worth = _worth(smoother.lasting(state), problem.stamp_s[problem.pose_row], problem.landmark_row)
    return Optimum(held, now, state, seen, log_priors, 0.0, worth, _scales_in_plane(solved))


def _scales_in_plane(solved: Solved) -> tuple[ScalePrior, ...]:
    """Return what is meant of scales in the plane; without a map that of the odometry is of the ranges, too."""
    outcome = solved.outcome
    meant = outcome.prior if outcome.aligned else outcome.prior.without_scale()
    free, off = outcome.problem.prior.free & meant.free, outcome.graph_estimate.states - meant.mean
    return tuple(
        ScalePrior(row, float(off[row]), float(meant.sigma[row]) * free[row], float(meant.p_needed[row]), of_cause)
        for row, of_cause in ((SLOPE, SCALE), (FORWARD, SCALE), (TURN_STATE, TURN))
    )


def _scales_in_space(session: SpatialSession, count: int) -> tuple[ScalePrior, ...]:
    """Return what is meant of the scale of odometry, in space, which is the last of the border's numbers (`count`)."""
    problem, given = session.solved.optimum.smoother.problem, session.intake
    sigma = given.problem.scale_sigma or given.scale_in_map
    if not sigma > 0.0:
        return ()
    off = session.solved.optimum.estimate.log_scale + problem.odometry_log + problem.ranges_log
    return (ScalePrior(count - 1, float(off), sigma * (problem.scale_sigma > 0.0), AS_USUAL, SCALE),)


def _in_space(session: SpatialSession) -> Optimum:
    optimum = session.solved.optimum
    smoother, linear = optimum.last
    problem, state, noise = smoother.problem, optimum.estimate, optimum.noise
    graph, now = smoother.graph(noise, heavy=False), linear.now
    nominal = start_noise(problem.settings, driven=problem.driven)
    odds = np.array(problem.settings.outlier_log_odds) if problem.robust else np.full(3, np.inf)
    seen = DetectionTerms(
        (linear.residual**2).sum(axis=1), _log_peaks(problem, noise.levels),
        _log_peaks(problem.with_sigma_position(problem.usual_m), nominal.levels),
        odds[problem.kind], problem.share,
    )  # fmt: skip
    n, count, sigma = len(problem.stamp_s), len(problem.oriented), problem.start_sigma
    log_priors = -float(np.log(sigma).sum()) - 3.0 * LOG_2PI
    extra, prices = log_map_density(problem, session.solved.from_map, state.place)
    free = np.ones(count, dtype=np.bool_)
    free[problem.prior.place] = False
    held, count, in_room = hold_in_room(graph, n + np.flatnonzero(free))
    log_priors += in_room - 0.5 * count * LOG_2PI
    log_priors -= _in_own_room(state.pose[:, :3], state.place[:, :3])
    if problem.driven:
        log_priors += _odometry_peak(graph, now, 6, slice(6, 12))
    twice = int((session.solved.number > 1).sum())  # one identity at two places
    prices += twice * math.log(problem.settings.map.p_moved)
    worth = _worth(smoother.lasting(linear), problem.stamp_s[problem.pose_row], problem.place)
    scales = _scales_in_space(session, len(held.border.information))
    return Optimum(held, now, state, seen, log_priors + extra, prices, worth, scales)


def _in_own_room(pose: FloatArray, place: FloatArray) -> float:
    """Return the log volume of the room in which places (L, D) are seen from poses (N, D), over that of `ROOM_M`, once
    for each place.

    Nothing but what is stated says what a metre is. In a room of so many metres there would be more room for places the
    longer all lengths are said to be, and of causes that make them so the longest would win.
    """
    at = np.concatenate([pose, place])
    extent_m = float(np.median(np.linalg.norm(at - np.median(at, axis=0), axis=1)))
    return place.size * math.log(max(extent_m, LEAST_EXTENT_M) / ROOM_M)


def _log_peaks(problem: SpatialProblem, level: FloatArray) -> FloatArray:
    """(M,) logarithms of the densities of detections at no residual, of the numbers that were measured."""
    kind = problem.kind
    with np.errstate(divide="ignore", invalid="ignore"):
        position = np.linalg.slogdet(problem.measured_root)[1] - 2.0 * math.log(level[ACROSS]) - math.log(level[ALONG])
        turn = -3.0 * np.log(level[ORIENTATION] * problem.sigma_rad)
        corners = np.linalg.slogdet(problem.corner_root)[1].sum(axis=1)
    # of corners the pixels were measured: the slope between these and the plane at depth 1 is no density
    corners = np.full_like(corners, -8.0 * math.log(level[PIXEL]))
    log = np.where(kind == CORNERS, corners, position + np.where(kind == POSE, turn, 0.0))
    return np.asarray(log - 0.5 * ROWS[kind] * LOG_2PI)


def _odometry_peak(graph: Graph[Any], now: Linear, dim: int, by_second: slice) -> float:
    """Log density of all odometry at no residual: the step to the second pose, whitened, is what was measured."""
    values = now.values[graph.structure.values_of(ODOMETRY)]
    count = len(now.weights[ODOMETRY])
    if not count:
        return 0.0
    rows = values.reshape(count, dim, -1)[..., by_second]
    size = np.linalg.slogdet(rows)[1] - 0.5 * dim * np.log(now.weights[ODOMETRY])
    return float(size.sum()) - 0.5 * count * dim * LOG_2PI


def _price(change: MapChange, n_landmarks: int, numbers: int, table: Any, settings: Any) -> float:
    """Log prior probability of a change that a solution in the plane has."""
    size = len(change.landmark_ids)
    turned = 1 if change.kind is ChangeKind.ROTATED else 0
    rows = table(settings, max(n_landmarks, size), size, numbers=numbers)
    own = float(rows[size, turned])
    own = own if math.isfinite(own) else float(rows[size, 0])
    return own + float(log_onset(2)[0 if math.isnan(change.stamp_from_s) else 1])


def _worth(lasting: Lasting, stamp_s: FloatArray, place: Any) -> float:
    return float(lasting.information(stamp_s, place).mean()) if len(place) else 1.0


def residuals_of(graph: Graph[Any], now: Linear) -> tuple[FloatArray, FloatArray]:
    """Return (R,) whitened residuals of all rows that are not weighted, and (R,) roots of the weights."""
    system = graph.structure.system
    root = np.repeat(np.sqrt(np.maximum(np.concatenate(now.weights), 1e-12)), system.factors.rows)
    return -now.values[system.right_at] / root, root


class Score(NamedTuple):
    """What one more number would do.

    Attributes:
        value: its optimum, by what is linear in it.
        information: on it, with all else marginalised.
        gain: by which the cost falls there [nats].
    """

    value: float
    information: float
    gain: float


class Column(NamedTuple):
    """A further number at an optimum.

    Attributes:
        told: (R,) by how much weighted residuals change for a unit.
        solved: the normal equations with what it asks of all others.
        border: (B,) the border's step by it.
    """

    told: FloatArray
    solved: Factorised
    border: FloatArray

    def information_with(self, other: Column) -> float:
        """Return the information that two numbers share, all else marginalised: of a number with itself, on it."""
        taken = self.solved.own_right @ other.solved.own_right + self.solved.right @ other.border
        return float(self.told @ other.told - taken)

    def step(self) -> FloatArray:
        """Return (numbers,) by which a unit of it moves all others."""
        return exhaust(self.solved.solution())


@dataclass(frozen=True)
class Screen:
    """An optimum, ready to ask what further numbers would do to it.

    Attributes:
        optimum: the optimum.
        residual, root: as `residuals_of`.
    """

    optimum: Optimum
    residual: FloatArray
    root: FloatArray

    @classmethod
    def of(cls, optimum: Optimum) -> Screen:
        """Return the screen of an optimum."""
        return cls(optimum, *residuals_of(optimum.graph, optimum.now))

    @property
    def solved(self) -> Factorised:
        """Return the normal equations of the optimum."""
        return self.optimum.solved

    def of_detections(self, some: BoolArray) -> BoolArray:
        """Return (R,) which rows are of some of the detections (M,)."""
        structure = self.optimum.graph.structure
        first, rows = structure.first, structure.system.factors.rows
        mine = np.zeros(len(rows), dtype=np.bool_)
        mine[first[DETECTIONS] : first[DETECTIONS + 1]] = some[: first[DETECTIONS + 1] - first[DETECTIONS]]
        return np.repeat(mine, rows)

    def column(self, direction: FloatArray) -> Column:
        """Return a further number by which residuals (R,), not weighted, change so for a unit."""
        told = direction * self.root
        solved = self.solved.with_right(-told)
        return Column(told, solved, np.asarray(np.linalg.solve(solved.information, solved.right), dtype=np.float64))

    def pull(self, column: Column) -> float:
        """Return the slope of the cost along a further number, with all else at its optimum."""
        crossed = column.solved.own_right @ self.solved.own_right + self.solved.right @ column.border
        return float(column.told @ (self.residual * self.root) - crossed)

    def follow(self, column: Column, value: float) -> FloatArray:
        """Return (R,) by how much weighted residuals change for a unit of a further number, all else at its optimum, in
        what is linear of a step to `value`.
        """
        graph, state = self.optimum.graph, self.optimum.state
        there, _ = graph.retract(state, TINY * value * column.step())
        residual = residuals_of(graph, exhaust(graph.linearised(there)))[0]
        return np.asarray(column.told + (residual - self.residual) * self.root / (TINY * value))

    def variance(
        self, column: Column, value: float, step: FloatArray | None = None, group: IntArray | None = None
    ) -> float:
        """Return the variance of the slope along a further number, as residuals are, not as they are said to be.

        White's (1980), of rows that are independent: some parts of a motion are less certain than others of which the
        same noise was learned. Residuals are those at the optimum, or that its step to `value` leaves: where that is
        long, what is linear goes too far for few rows, and where it is right the first are too large.

        Args:
            column: the number.
            value: of it.
            step: (R,) by which weighted residuals change with the step of this and of others; None: of this alone.
            group: (R,) rows of which are independent, as groups, from 0 on; None: of all.
        """
        with_all, before = self.follow(column, value), self.residual * self.root
        slopes = (with_all * left for left in (before, before + (value * with_all if step is None else step)))
        return min(float(np.sum((slope if group is None else np.bincount(group, slope)) ** 2)) for slope in slopes)

    def find_stretches(self, pose_row: IntArray, count: int) -> IntArray:
        """Return (R,) groups for `variance`: the odometry and detections of each of some stretches of the drive.

        Args:
            pose_row: (M,) pose of each detection.
            count: of stretches, alike in their number of steps.
        """
        structure = self.optimum.graph.structure
        first, rows = structure.first, structure.system.factors.rows
        group = count + np.arange(len(rows))
        steps, seen = (slice(first[block], first[block + 1]) for block in (ODOMETRY, DETECTIONS))
        poses = first[ODOMETRY + 1] - first[ODOMETRY] + 1
        group[steps] = count * np.arange(poses - 1) // poses
        group[seen] = count * pose_row[: seen.stop - seen.start] // poses
        return np.repeat(group, rows)

    def score(self, direction: FloatArray, information: float, off: float = 0.0) -> Score:
        """Return what a number does by which residuals (R,), not weighted, change so.

        Args:
            direction: (R,) by how much for a unit.
            information: of its prior.
            off: where it is, from the mean of that.
        """
        column = self.column(direction)
        known = max(column.information_with(column), 0.0) + information
        pull = self.pull(column) + information * off
        return Score(-pull / known, known, 0.5 * pull**2 / known)
