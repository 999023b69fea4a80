"""Whether landmarks lie over a map: the joint Gaussian evidence of a motion, against chance and against another one.

Two things may be true of landmarks whose identities a map knows. Either the session is there, some landmarks moved, and
the differences of those that stand are jointly Gaussian by the errors of both maps, with the motion unknown; or it
is from another place, where each stands anywhere. A motion is accepted where the first is far more probable than the
second, and than the first with another motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from evermap.align.candidates import AGREE_M, AGREE_RAD, Matches, rank_motions
from evermap.config import LocalizeConfig, RoomConfig
from evermap.geometry import se2, se3
from evermap.geometry.group import SPACE, Group
from evermap.types import BoolArray, FloatArray, IntArray

SIGMA_M, SIGMA_RAD = 0.5 * AGREE_M, 0.4 * AGREE_RAD
"""Standard deviations of a landmark laid over a map, where nothing better is known."""
LOG_TURNS = {2: math.log(2.0 * math.pi), 3: math.log(8.0 * math.pi**2)}
"""Logarithm of the volume of all rotations, of the plane and of space."""
MOST_JOINT = 300
"""Landmarks that agree whose joint covariance is used; of more, that of each: their evidence is beyond doubt."""
LEAST = 1e-9
"""Information on a motion that rounding may take for less than none."""
CLEARLY = 0.75
"""Share of landmarks that agree, from which the mirrored map need not be asked."""
NOTHING = "no two landmarks stand to each other as in the map"
TWO_PLACES = "two places in the map fit about as well, with {} and {} of {} landmarks"
"""Reasons against an alignment."""


@dataclass(frozen=True, slots=True)
class Acceptance:
    """A motion that lays landmarks over a map, and whether it may be believed.

    Attributes:
        motion: (3,) of the landmarks' frame in that of the map, in space (7,).
        agree: (K,) matches that agree with it; none where no motion is accepted.
        log_odds: of that place against any other one [nats].
        lead_nats: of the motion over the next best different one.
        reason: why it isn't accepted, empty where it is.
    """

    motion: FloatArray
    agree: BoolArray
    log_odds: float
    lead_nats: float
    reason: str = ""

    @property
    def is_accepted(self) -> bool:
        """Whether the landmarks lie there."""
        return not self.reason

    def __bool__(self) -> bool:
        return self.is_accepted


def accept_alignment(
    matches: Matches,
    rules: LocalizeConfig,
    *,
    fewest: int | None = None,
    spread_m: float = 0.0,
    covariance_m2: FloatArray | None = None,
    source_m2: FloatArray | None = None,
) -> Acceptance:
    """Return the most probable motion that lays landmarks over their places, and whether it is accepted.

    Args:
        matches: the landmarks, the places at which they may be, and the probabilities of that as weights.
        rules: what is believed of landmarks, and when an alignment is certain.
        fewest: landmarks that must agree, unless it is those of the rules; one with an orientation counts as three.
        spread_m: how far apart these must be, at least.
        covariance_m2: (D K, D K) of the places, and of what landmarks that stand may be off, in the frame of the map;
            (K, D, D) where they are independent. None for errors of `SIGMA_M`.
        source_m2: the same of the landmarks, in their own frame; None where it is counted in the former.
    """
    count = len(np.unique(matches.landmark))
    ranked = rank_motions(matches)
    if not ranked:
        return Acceptance(matches.group.identity(), np.zeros(len(matches), dtype=np.bool_), -math.inf, 0.0, NOTHING)
    odds = [log_odds_of(motion, matches, agree, rules, covariance_m2, source_m2) for motion, agree in ranked]
    order = np.argsort(-np.array(odds), kind="stable")
    (motion, agree), most = ranked[order[0]], odds[order[0]]
    rival = odds[order[1]] if len(order) > 1 else -math.inf
    standing = int(np.count_nonzero(agree))
    worth = standing + 2 * int(np.count_nonzero(agree & matches.oriented))
    at = matches.points[0][agree]
    reason = ""
    if worth < (rules.fewest if fewest is None else fewest):
        reason = f"only {standing} of {count} landmarks stand to each other as in the map"
    elif spread_m > 0.0 and np.ptp(at, axis=0).max() < spread_m:
        reason = f"the {standing} landmarks that agree with the map lie within {spread_m:g} m"
    elif most < rules.certain_nats:
        reason = f"{standing} of {count} landmarks agree with the map, which may be by chance"
    elif most - rival < rules.lead_nats:
        other = int(np.count_nonzero(ranked[order[1]][1]))
        reason = TWO_PLACES.format(standing, other, count)
    elif (other := _count_mirrored(matches, standing, most + rules.lead_nats, rules, covariance_m2, source_m2)) > 0:
        reason = (
            f"{other} of {count} landmarks fit the mirrored map, {standing} this one: bearings or an axis are reversed"
        )
    return Acceptance(motion, agree, most, most - rival, reason)


def _count_mirrored(
    matches: Matches,
    standing: int,
    least: float,
    rules: LocalizeConfig,
    covariance_m2: FloatArray | None,
    source_m2: FloatArray | None,
) -> int:
    """How many landmarks agree with a mirrored map, where that has at least these log odds; else 0.

    It is not asked where nearly all are `standing`. What lies near a line, or a plane, fits either way; what has an
    orientation is asked for that.
    """
    if matches.oriented.any() or standing >= CLEARLY * len(np.unique(matches.landmark)):
        return 0
    sign = np.append(-1.0, np.ones(matches.group.point_dim - 1))
    mirrored = replace(matches, source=matches.points[0] * sign)
    if source_m2 is not None:
        every = sign if source_m2.ndim == 3 else np.tile(sign, len(matches))
        source_m2 = source_m2 * every * every[:, None]
    for motion, agree in rank_motions(mirrored, most=1):
        if log_odds_of(motion, mirrored, agree, rules, covariance_m2, source_m2) > least:
            return int(np.count_nonzero(agree))
    return 0


def log_odds_of(
    motion: FloatArray,
    matches: Matches,
    agree: BoolArray,
    rules: LocalizeConfig,
    covariance_m2: FloatArray | None = None,
    source_m2: FloatArray | None = None,
) -> float:
    """Return the log odds that landmarks are where a motion lays them, over being anywhere [nats]; as of
    `accept_alignment`.

    A motion is as probable anywhere in the room, and so is a landmark that was moved.
    """
    some = np.flatnonzero(agree)
    source, target = matches.points
    group, moved = matches.group, matches.group.transform(motion, source)
    dim = source.shape[1]
    error, freedom = [(moved[some] - target[some]).ravel()], [group.rigid_directions(moved[some] - moved.mean(axis=0))]
    factor = np.full(dim * len(some), SIGMA_M)
    if covariance_m2 is not None or source_m2 is not None:
        factor = _factor_of(motion, some, group, covariance_m2, source_m2)
    log_chance = len(some) * log_room(moved, target, rules)
    turned = some[matches.oriented[some]]
    if len(turned):
        placed = matches.target[turned]
        off = se3.local(placed, se3.compose(motion, matches.source[turned]))[:, 3:]
        error.append((se3.rotation_of(placed) @ off[..., None]).ravel())
        freedom.append(np.tile(np.hstack([np.zeros((3, 3)), np.eye(3)]), (len(turned), 1)))
        sigma_rad = np.full(3 * len(turned), SIGMA_RAD)
        factor = np.append(factor, sigma_rad) if factor.ndim == 1 else block_diag(factor, np.diag(sigma_rad))
        log_chance += len(turned) * LOG_TURNS[SPACE.point_dim]
    log_motion = -log_room(moved, target, rules) - LOG_TURNS[dim]
    log_density = log_density_of(np.concatenate(error), factor, np.vstack(freedom), log_motion)
    log_prior = _log_prior_of(matches, agree, rules) + float(matches.log_prior[some].sum())
    return log_density + log_chance + log_prior - math.log(rules.p_another_place)


def _factor_of(
    motion: FloatArray, some: IntArray, group: Group, covariance_m2: FloatArray | None, source_m2: FloatArray | None
) -> FloatArray:
    """Lower Cholesky factor of the covariance of the differences of `some` landmarks; of more than `MOST_JOINT` the
    standard deviations of each.
    """
    dim, turn = group.point_dim, group.rotation_of(motion)
    if len(some) > MOST_JOINT:
        each = SIGMA_M**2 * np.ones((len(some), 1)) * np.ones(dim)
        if covariance_m2 is not None:
            each = np.diagonal(_blocks(covariance_m2, some, dim), axis1=1, axis2=2)
        if source_m2 is not None:
            own = turn @ _blocks(source_m2, some, dim) @ turn.T
            each = each + np.diagonal(own, axis1=1, axis2=2)
        return np.asarray(np.sqrt(each).ravel())
    total = SIGMA_M**2 * np.eye(dim * len(some)) if covariance_m2 is None else _joint(covariance_m2, some, dim)
    if source_m2 is not None:
        own = _joint(source_m2, some, dim).reshape(len(some), dim, len(some), dim)
        total = total + np.einsum("ab,ibjc,dc->iajd", turn, own, turn, optimize=True).reshape(total.shape)
    return np.asarray(np.linalg.cholesky(total), dtype=np.float64)


def _joint(covariance_m2: FloatArray, some: IntArray, dim: int) -> FloatArray:
    """(D N, D N) joint covariance of some landmarks."""
    if covariance_m2.ndim == 3:
        return np.asarray(block_diag(*covariance_m2[some]), dtype=np.float64)
    rows = se2.xy_rows(some, dim)
    return np.asarray(covariance_m2[np.ix_(rows, rows)])


def _blocks(covariance_m2: FloatArray, some: IntArray, dim: int) -> FloatArray:
    """(N, D, D) covariances of some landmarks, each by itself."""
    if covariance_m2.ndim == 3:
        return covariance_m2[some]
    at = dim * some[:, None] + np.arange(dim)
    return np.asarray(covariance_m2[at[:, :, None], at[:, None, :]])


def log_density_of(error: FloatArray, factor: FloatArray, freedom: FloatArray, log_motion: float | None) -> float:
    """Return the log density of differences whose motion is unknown.

    Args:
        error: (M,) the differences.
        factor: (M, M) lower Cholesky factor of their covariance for a known motion, or (M,) standard deviations.
        freedom: (M, F) how they change with the motion.
        log_motion: log density of the motion, which is the same for all; None where `freedom` is in its standard
            deviations, and it is Gaussian.
    """
    both, scale = np.column_stack([error, freedom]), factor if factor.ndim == 1 else np.diagonal(factor)
    white = both / factor[:, None] if factor.ndim == 1 else solve_triangular(factor, both, lower=True)
    error, freedom = white[:, 0], white[:, 1:]
    prior = 0.0 if log_motion is not None else 1.0
    root = np.linalg.cholesky(freedom.T @ freedom + max(prior, LEAST) * np.eye(freedom.shape[1]))
    pulled = solve_triangular(root, freedom.T @ error, lower=True)
    squared = float(error @ error - pulled @ pulled)
    if prior:  # the difference of two numbers that are nearly equal has no digits left
        by = solve_triangular(root, pulled, lower=True, trans="T")
        squared = float(((error - freedom @ by) ** 2).sum() + by @ by)
    log_volume = 2.0 * float(np.log(scale).sum() + np.log(np.diagonal(root)).sum())
    of_motion = 0.0 if log_motion is None else log_motion + 0.5 * freedom.shape[1] * math.log(2.0 * math.pi)
    return -0.5 * (log_volume + squared + len(error) * math.log(2.0 * math.pi)) + of_motion


def log_room(landmark_m: FloatArray, place_m: FloatArray, rules: RoomConfig) -> float:
    """Return the logarithm of the area, in space the volume, in which landmarks (K, D) and places (P, D) lie."""
    spread = np.ptp(np.vstack([landmark_m, place_m]), axis=0)
    height_m = float(np.prod(np.maximum(spread[2:], rules.lowest_room_m)))
    return math.log(max(float(np.prod(spread[:2])), rules.smallest_room_m2) * height_m)


def is_this_place(log_standing: float, count: int, log_room_m: float, p_another_place: float) -> bool:
    """Tell whether `count` landmarks that stand outweigh the improbability that all others were moved.

    In another place where the map's identities are used again, all landmarks stand anywhere: some agree by chance.
    """
    return log_standing + count * log_room_m > math.log(p_another_place)


def _log_prior_of(matches: Matches, agree: BoolArray, rules: LocalizeConfig) -> float:
    """Log probability that just those stand that agree. That hardly any does is believed of no landmark: what moves
    moves together.
    """
    _, name = np.unique(matches.landmark, return_inverse=True)
    p = np.minimum(matches.weight, rules.p_stands)
    p_any = np.minimum(np.bincount(name, p), rules.p_stands)
    stands = np.bincount(name[agree], minlength=len(p_any)) > 0
    return float(np.log(np.maximum(p[agree], 1e-12)).sum() + np.log1p(-p_any[~stands]).sum())
