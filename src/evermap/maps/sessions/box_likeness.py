"""How much alike are boxes that are the same, and boxes that took the place of another one? Learned in each session.

A box where one stood is that one, or another that came when it had left. How well a detector repeats sizes, how sizes
differ within a class, how often a place that was left is taken again and how near to the former middle: all are learned
by expectation and maximisation over the boxes of a session that stand where the map has one, and over the places beside
them where nothing stands, from the settings as priors. How many boxes are seen with an odd size is not: in one session
that looks like others that took their places.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from evermap.config import BoxesConfig
from evermap.maps.bodies import square_lengths
from evermap.maps.sessions.box_search import MapBoxes, half_turn
from evermap.maps.sessions.box_visit import SeenBoxes
from evermap.types import BoolArray, FloatArray, IntArray

ROUNDS = 30
NATS = 1.0
"""Standard deviation of the logarithm of a spread around that of the settings."""
TAKEN_STAYS = 5.0
"""Boxes that left that the usual probability of `p_taken` is worth."""
ALIGNED = 0.8
"""Share of boxes that stand along the one whose place they took."""
LEAST_P = 1e-6
"""No box is believed to stand less, or its logarithm would be infinite."""


@dataclass(frozen=True, slots=True)
class BoxPairs:
    """Boxes of a session (K,) beside those of the map (M,).

    Attributes:
        away_m: (K, M) between their middles.
        off_m: (K, M, 2); spread_m2: (K, M, 2, 2) covariance of it for a box that is the same.
        size_m: (K, M, 3) differences of sizes, nan where one is not known.
        turn_rad: (K, M) differences of headings.
        over: (K, M) there is no room for both.
        alike: (K, M) they are of one class.
        p: (K, M) probability that the map's box stands there still.
    """

    away_m: FloatArray
    off_m: FloatArray
    spread_m2: FloatArray
    size_m: FloatArray
    turn_rad: FloatArray
    over: BoolArray
    alike: BoolArray
    p: FloatArray

    @classmethod
    def of(cls, seen: SeenBoxes, known: MapBoxes, loose_m: FloatArray) -> BoxPairs:
        """Return all; boxes of the session may be off by `loose_m` (K,) beside what is known."""
        settings, off = known.settings, seen.position_m[:, None, :2] - known.position_m[None, :, :2]
        spread = (
            seen.covariance_m2[:, None, :2, :2] + known.covariance_m2[None, :, :2, :2] + settings.drift_m**2 * np.eye(2)
        )
        spread = spread + (loose_m**2)[:, None, None, None] * np.eye(2)
        width = np.nan_to_num(0.5 * (seen.size_m[:, None, 1] + known.size_m[None, :, 1]), nan=0.5)
        away = np.linalg.norm(off, axis=2)
        # what was seen to come did not stand there, but may have come back
        came = np.isfinite(seen.since_s)[:, None]
        p = np.clip(np.where(came, settings.returns * (1.0 - known.p), known.p), LEAST_P, 1.0)
        return cls(
            away, off, spread, seen.size_m[:, None] - known.size_m[None],
            half_turn(seen.heading_rad[:, None] - known.heading_rad[None]), away < settings.same_share * width,
            seen.class_id[:, None] == known.class_id, p,
        )  # fmt: skip

    def at(self, mine: IntArray, theirs: IntArray) -> BoxPairs:
        """Return some pairs (N,), as columns (N, 1)."""
        return BoxPairs(*(getattr(self, item.name)[mine, theirs][:, None] for item in fields(self)))


@dataclass(frozen=True, slots=True)
class BoxLikeness:
    """What boxes have in common.

    Attributes:
        same_size_m, other_size_m: (3,) standard deviations of differences of sizes, of one box and of two of a class.
        p_taken: probability that a place that was left is taken by another one.
        beside_m: standard deviation of where that stands, each axis.
        haste: factor on the hazards by which boxes left since the map saw them.
        settings: the rest.
    """

    same_size_m: FloatArray
    other_size_m: FloatArray
    p_taken: float
    beside_m: float
    haste: float
    settings: BoxesConfig

    @classmethod
    def usual(cls, settings: BoxesConfig) -> BoxLikeness:
        """Return what is known before anything was seen."""
        return cls(
            np.array(settings.sigma_size_m), np.array(settings.sigma_class_m),
            settings.p_taken, settings.beside_m, 1.0, settings,
        )  # fmt: skip

    def log_odds(self, pairs: BoxPairs) -> FloatArray:
        """Return (K, M) log odds that a box of the session is one of the map, against being another one."""
        same, other = self.log_likelihoods(pairs)
        return same - other

    def log_likelihoods(self, pairs: BoxPairs) -> tuple[FloatArray, FloatArray]:
        """Return (K, M) log likelihoods that a box of the session is one of the map, and that it is another one."""
        settings, spread = self.settings, pairs.spread_m2
        squared = square_lengths(pairs.off_m, spread)
        tails = (1.0 - settings.far_share, 1.0), (settings.far_share, settings.far_factor)
        near, far = (math.log(share) - 0.5 * squared / wide**2 - 2.0 * math.log(wide) for share, wide in tails)
        same = np.logaddexp(near, far) - 0.5 * np.linalg.slogdet(spread)[1] - math.log(2.0 * math.pi)
        same += np.maximum(self.size_nats(pairs), -settings.size_nats)
        sigma_rad = settings.heading_rad
        turn = -0.5 * (pairs.turn_rad / sigma_rad) ** 2 - math.log(math.sqrt(2.0 * math.pi) * sigma_rad / math.pi)
        turn = np.maximum(np.nan_to_num(turn), -settings.size_nats)
        same += turn
        # where a box stands there is no room for another one: it must have left, and its place be taken again
        beside_m2 = self.beside_m**2 + 0.5 * np.trace(spread, axis1=2, axis2=3)
        taken = self.p_taken * np.exp(-0.5 * pairs.away_m**2 / beside_m2) / (2.0 * math.pi * beside_m2)
        taken *= ALIGNED * np.exp(turn) + 1.0 - ALIGNED
        p = pairs.p**self.haste
        left = np.log(np.clip(1.0 - p, settings.least_gone, 1.0))
        other = np.where(pairs.over, left + np.log(settings.density + taken), math.log(settings.density))
        return same + np.log(p), other

    def size_nats(self, pairs: BoxPairs) -> FloatArray:
        """Return (K, M) how much sizes speak for one box; one in `odd_share` is seen with any size of its class."""
        size = pairs.size_m
        like, unlike = (-0.5 * (size / s) ** 2 - np.log(s) for s in (self.same_size_m, self.other_size_m))
        nats = np.nan_to_num((like - unlike).sum(axis=2))
        share = self.settings.odd_share
        return np.asarray(np.logaddexp(math.log1p(-share) + nats, math.log(share)))


def learn_likeness(seen: SeenBoxes, known: MapBoxes, loose_m: FloatArray) -> BoxLikeness:
    """Return what boxes have in common, by those of a session that stand where the map has one.

    Args:
        seen: boxes of the session, in the map's frame.
        known: of the map.
        loose_m: (K,) by how much they may be off beside what is known.
    """
    settings = known.settings
    usual = BoxLikeness.usual(settings)
    if not len(seen.place) or not len(known.place):
        return usual
    pairs = BoxPairs.of(seen, known, loose_m)
    other_size_m = np.array([_spread(*_within(seen, known, axis), usual.other_size_m[axis]) for axis in range(3)])
    away_m = np.where(pairs.over & pairs.alike, pairs.away_m, np.inf)
    mine = np.flatnonzero(np.isfinite(away_m.min(axis=1)))
    paired, p_empty = pairs.at(mine, away_m.argmin(axis=1)[mine]), known.p[_find_empty(pairs, known)]
    starts = (
        replace(usual, other_size_m=other_size_m),
        replace(usual, other_size_m=other_size_m, p_taken=0.7, beside_m=0.3 * usual.beside_m, haste=3.0),
    )
    found = [_maximise(start, paired, usual, p_empty) for start in starts]
    return max(found, key=lambda one: _log_posterior(one, paired, usual, p_empty))


def _find_empty(pairs: BoxPairs, known: MapBoxes) -> IntArray:
    """Rows of the map's boxes that a session does not see, though it sees others near; of several that stood at one
    place the one that most probably does.
    """
    missed = np.flatnonzero(~pairs.over.any(axis=0) & (pairs.away_m.min(axis=0) < known.settings.among_m))
    missed = missed[np.argsort(-known.p[missed], kind="stable")]
    width = np.nan_to_num(known.size_m[missed, 1], nan=0.5)
    near_m = known.settings.same_share * 0.5 * (width[:, None] + width)
    away_m = np.linalg.norm(known.position_m[missed, None, :2] - known.position_m[missed, :2], axis=2)
    first = ~np.tril(away_m < near_m, -1).any(axis=1)
    return np.asarray(missed[first], dtype=np.int64)


def _maximise(found: BoxLikeness, paired: BoxPairs, usual: BoxLikeness, p_empty: FloatArray) -> BoxLikeness:
    """The most probable one near to where it begins, by pairs (K, 1) of boxes that stand over each other, and beliefs
    (E,) in what stood where nothing is seen.
    """
    settings, size_m, away_m = usual.settings, paired.size_m[:, 0], paired.away_m[:, 0]
    sized = np.isfinite(size_m).all(axis=1)
    for _ in range(ROUNDS):
        p_same = 1.0 / (1.0 + np.exp(-found.log_odds(paired)[:, 0]))
        p_odd = settings.odd_share / np.exp(found.size_nats(paired)[:, 0])
        weight = (p_same * (1.0 - np.clip(p_odd, 0.0, 1.0)))[sized]
        same_size_m = np.array([
            _spread(float(weight.sum()), float(weight @ size_m[sized, axis] ** 2), usual.same_size_m[axis])
            for axis in range(3)
        ])  # fmt: skip
        beside_m = _spread(2.0 * float((1.0 - p_same).sum()), float((1.0 - p_same) @ away_m**2), usual.beside_m)
        haste, p_taken = _turnover(paired.p[:, 0], p_same, p_empty, settings)
        found = BoxLikeness(
            np.minimum(same_size_m, found.other_size_m), found.other_size_m, p_taken, beside_m, haste, settings
        )
    return found


def _turnover(p: FloatArray, p_same: FloatArray, p_empty: FloatArray, settings: BoxesConfig) -> tuple[float, float]:
    """The most probable factor on hazards, of which little may be known when the first boxes have left, and the
    probability that a place is taken again.

    Args:
        p: (K,) beliefs in boxes where one stands.
        p_same: (K,) that it is the same.
        p_empty: (E,) in boxes where nothing is seen: they left and nothing came, or they are missed.
        settings: priors, and how often a box is missed.
    """
    haste, p_taken = np.exp(np.linspace(-3.0, 3.0, 49)), np.linspace(0.02, 0.98, 33)
    stays, gone = (_belief(one[:, None], haste, settings)[..., None] for one in (p, p_empty))
    fit = np.tensordot(p_same, np.log(stays), 1) + np.tensordot(1.0 - p_same, np.log((1.0 - stays) * p_taken), 1)
    fit = fit + _log_empty(gone, p_taken, settings).sum(axis=0) + _log_prior(haste[:, None], p_taken, settings)
    row, column = np.unravel_index(np.argmax(fit), fit.shape)
    return float(haste[row]), float(p_taken[column])


def _belief(p: FloatArray, haste: FloatArray | float, settings: BoxesConfig) -> FloatArray:
    """Probabilities that boxes stand, if hazards are `haste` times what is believed."""
    return np.asarray(np.clip(p**haste, LEAST_P, 1.0 - settings.least_gone))


def _log_empty(stays: FloatArray, p_taken: FloatArray | float, settings: BoxesConfig) -> FloatArray:
    """Log probability that nothing is seen where boxes stood that stand still with probability `stays`."""
    return np.asarray(np.log(stays * (1.0 - settings.p_stands) + (1.0 - stays) * (1.0 - p_taken)))


def _log_prior(haste: FloatArray, p_taken: FloatArray, settings: BoxesConfig) -> FloatArray:
    """Log density of a factor on hazards and of the probability that a place is taken again."""
    often = settings.p_taken * np.log(p_taken) + (1.0 - settings.p_taken) * np.log1p(-p_taken)
    return np.asarray(TAKEN_STAYS * often - 0.5 * (np.log(haste) / settings.haste_nats) ** 2)


def _log_posterior(found: BoxLikeness, paired: BoxPairs, usual: BoxLikeness, p_empty: FloatArray) -> float:
    """Log posterior density of what pairs (K, 1) and empty places (E,) have in common, but for a constant."""
    settings = found.settings
    fit = np.logaddexp(*found.log_likelihoods(paired))[:, 0].sum()
    fit += _log_empty(_belief(p_empty, found.haste, settings), found.p_taken, settings).sum()
    spreads = np.append(found.same_size_m, found.beside_m) / np.append(usual.same_size_m, usual.beside_m)
    prior = float(_log_prior(np.array(found.haste), np.array(found.p_taken), settings))
    return float(fit) + prior - 0.5 * float((np.log(spreads) ** 2).sum()) / NATS**2


def _within(seen: SeenBoxes, known: MapBoxes, axis: int) -> tuple[float, float]:
    """How many boxes differ from the middle of their class along an axis, and twice their squared deviations."""
    class_id: IntArray = np.append(seen.class_id, known.class_id)
    size = np.append(seen.size_m[:, axis], known.size_m[:, axis])
    count, squared = 0.0, 0.0
    for one in np.unique(class_id):
        mine = size[(class_id == one) & np.isfinite(size)]
        if len(mine) > 1:
            count, squared = count + len(mine) - 1.0, squared + 2.0 * float(((mine - mine.mean()) ** 2).sum())
    return 0.5 * count, 0.5 * squared  # most boxes are there twice


def _spread(count: float, squared: float, usual: float) -> float:
    """The most probable standard deviation of `count` numbers with a sum of squares, log-normal about `usual`."""
    at = math.log(usual) if count <= 0.0 or squared <= 0.0 else 0.5 * math.log(squared / count)
    at = max(at, math.log(usual) - 4.0 * NATS)
    for _ in range(20):
        pull = squared * math.exp(-2.0 * at)
        slope, bend = count - pull + (at - math.log(usual)) / NATS**2, 2.0 * pull + 1.0 / NATS**2
        at -= max(min(slope / bend, 1.0), -1.0)
    return math.exp(at)
