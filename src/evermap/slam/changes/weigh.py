"""Weights of all hypotheses under all credibilities of map and sightings.

How far the map is to be believed, and how large the error is that all sightings of one window share, are chosen by
evidence together with the changes: an unexplained change makes both look bad.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from evermap.config import ChangesConfig
from evermap.estimate.sparse.system import Slices
from evermap.geometry import se2, se3
from evermap.slam.changes.evidence import Comparison, WindowEvidence, compare, dense_ms
from evermap.slam.changes.explain import GivenMap, MovedGroup
from evermap.slam.changes.gain import PLANE, POINTS, motion_spread, spread_of
from evermap.slam.changes.search import Hypotheses, find_changes
from evermap.types import BoolArray, FloatArray, IntArray

MAP_FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""By which the standard deviations of the map may be wrong: the grid on which that is weighed."""


@dataclass(frozen=True, slots=True)
class ChangePosterior:
    """Result of the search.

    Attributes:
        groups: the most probable changes.
        probability: of exactly these, among all weighed.
        alternatives: other sets of changes with their probabilities, the most probable first.
        map_factor: how much wider the map's standard deviations have to be.
        softness_m: error shared by the sightings of a window.
        score: log posterior of the best hypothesis under the best degree of belief, for comparing maps [nats].
        misfit: chi-square of what the best hypothesis leaves, over its degrees of freedom.
        evidence: what was weighed: without the copies that are displaced alone.
    """

    groups: tuple[MovedGroup, ...]
    probability: float
    alternatives: tuple[tuple[tuple[MovedGroup, ...], float], ...]
    map_factor: float
    softness_m: float
    score: float
    misfit: float
    evidence: WindowEvidence


def weigh(
    evidence: WindowEvidence,
    given: GivenMap,
    prior: ChangesConfig,
    n_windows: int,
    *,
    before: ChangePosterior | None = None,
    thorough: bool = True,
    spared: bool = False,
    factors: tuple[float, ...] = MAP_FACTORS,
) -> Slices[ChangePosterior]:
    """Search for changes, and compute their probabilities, in slices.

    What was found `before` is one start of the search; if not `thorough`, its degree of belief is the only one that is
    tried. If `spared`, no copy of this evidence is displaced alone. The standard deviations of the map may be wrong by
    `factors`, among them 1.
    """
    factor = 1.0 if before is None else before.map_factor
    usual = prior.softness_m[(len(prior.softness_m) - 1) // 2]
    softness = 0.0 if n_windows == 1 else (usual if before is None else before.softness_m)
    position = np.where(given.given[:, None], given.mean, evidence.first_seen(given.mean))
    from_nothing: dict[tuple[float, float], tuple[WindowEvidence, Comparison, Hypotheses]] = {}

    def search(
        evidence: WindowEvidence,
        start: Hypotheses | None,
        factor: float = factor,
        softness: float = prior.usual_softness_m,
    ) -> Slices[tuple[Comparison, Hypotheses]]:
        same = from_nothing.get((factor, softness))
        if start is None and same is not None and same[0] is evidence:  # no copy was left out since
            return same[1:]
        soft = evidence.soften(softness)
        yield dense_ms(len(soft.pull))
        comparison = compare(soft, given.mean, given.covariance * factor**2, given.given)
        yield dense_ms(len(soft.pull))
        found = yield from find_changes(soft, comparison, position, n_windows, prior, start=start)
        if start is None:
            from_nothing[factor, softness] = evidence, comparison, found
        return comparison, found

    if n_windows > 1 and not spared:
        evidence = yield from without_transients(evidence, position, given, prior, search)
    trials: dict[tuple[float, float], _Trial] = {}

    def best_of(beliefs: list[tuple[float, float]]) -> Slices[tuple[float, float]]:
        for factor, softness in beliefs:
            if (factor, softness) in trials:
                continue
            best = max(trials.values(), key=lambda t: t.score, default=None)
            start = None if best is None else best.hypotheses
            comparison, found = yield from search(evidence, start, factor, softness)
            base = comparison.log_evidence - 0.5 * (np.log(factor) / prior.map_factor_spread) ** 2
            trials[factor, softness] = _Trial(factor, softness, comparison, found, base)
        return max(beliefs, key=lambda belief: trials[belief].score)

    yield from best_of([(factor, softness)])
    if thorough and before is None and given.given.any():
        # a map that is believed little explains everything: the other end must have been looked at
        factor, _ = yield from best_of([(f, softness) for f in factors])
    improved = thorough
    while improved:  # one step up or down in either, as long as that gains
        neighbours = [(factor, s) for s in _beside(prior.softness_m, softness)] if n_windows > 1 else []
        if given.given.any():
            neighbours += [(f, softness) for f in _beside(factors, factor)]
        best = yield from best_of(neighbours)
        improved = trials[best].score > trials[factor, softness].score
        if improved:
            factor, softness = best
    seen = SeenWithin.of(evidence, given, position)
    return _posterior(evidence, list(trials.values()), trials[factor, softness], seen)


@dataclass(frozen=True, slots=True)
class _Trial:
    """Hypotheses under one degree of belief; `base` is the log posterior of 'nothing moved' there."""

    factor: float
    softness: float
    comparison: Comparison
    hypotheses: Hypotheses
    base: float

    @property
    def score(self) -> float:
        """Log posterior of the best hypothesis."""
        return self.base + float(self.hypotheses.gain[0])


def _beside(values: tuple[float, ...], value: float) -> tuple[float, ...]:
    """The neighbours of a value."""
    at = values.index(value)
    return values[max(at - 1, 0) : at] + values[at + 1 : at + 2]


class SeenWithin(NamedTuple):
    """First and last window (L,) in which every landmark was seen, whether the map holds it, where it was (L, D)."""

    first: IntArray
    last: IntArray
    given: BoolArray
    position: FloatArray

    @classmethod
    def of(cls, evidence: WindowEvidence, given: GivenMap, position: FloatArray) -> SeenWithin:
        first = np.full(len(given.mean), np.iinfo(np.int64).max)
        last = np.full(len(given.mean), -1)
        np.minimum.at(first, evidence.landmark, evidence.window)
        np.maximum.at(last, evidence.landmark, evidence.window)
        return cls(first, last, given.given, position)

    def shows(self, members: IntArray, window: int) -> BoolArray:
        """Return whether each would show that it has moved from a window on: known from before, and seen since."""
        return (self.given[members] | (self.first[members] < window)) & (self.last[members] >= window)

    def find_motion(self, group: MovedGroup, shown: BoolArray) -> MovedGroup:
        """Return the members of a group of which anything can be said, with the motion of their own centroid.

        A point alone has nothing to turn.
        """
        members, motion = group.members[shown], group.motion
        if shown.all() or not len(members) or not group.turns:
            return replace(group, members=members)
        space, point_dim = (se2, PLANE) if len(motion) == PLANE + 1 else (se3, POINTS)
        turn = np.append(np.zeros(point_dim), motion[point_dim:])
        arm = self.position[members, :point_dim].mean(axis=0) - self.position[group.members, :point_dim].mean(axis=0)
        motion = motion + np.append(space.transform(space.exp(turn), arm) - arm, 0.0 * motion[point_dim:])
        if len(members) > 1 or self.position.shape[1] > point_dim:
            return replace(group, members=members, motion=motion)
        return replace(group, members=members, turns=False, motion=motion - turn)


def _posterior(evidence: WindowEvidence, trials: list[_Trial], best: _Trial, seen: SeenWithin) -> ChangePosterior:
    """Sum the weights of equal hypotheses over windows, kinds of motion and degrees of belief."""
    top = max(trial.score for trial in trials)
    weight: dict[_Key, float] = {}
    leader: dict[_Key, tuple[float, tuple[MovedGroup, ...]]] = {}
    for trial in trials:
        for row, gain in enumerate(trial.hypotheses.gain):
            key, groups = _groups(trial.hypotheses, row, seen)
            log_weight = trial.base + float(gain) - top
            weight[key] = weight.get(key, 0.0) + float(np.exp(log_weight))
            if key not in leader or log_weight > leader[key][0]:
                leader[key] = (log_weight, groups)
    total = sum(weight.values())
    order = sorted(weight, key=lambda key: -weight[key])
    ranked = [(leader[key][1], weight[key] / total) for key in order]
    gained = best.comparison.misfit - 2.0 * float(best.hypotheses.gain[0])
    return ChangePosterior(
        groups=ranked[0][0],
        probability=ranked[0][1],
        alternatives=tuple(ranked[1:]),
        map_factor=best.factor,
        softness_m=best.softness,
        score=best.score,
        evidence=evidence,
        misfit=gained / max(best.comparison.freedom, 1.0),
    )


_Key = tuple[tuple[tuple[int, ...], bool], ...]


def _groups(hypotheses: Hypotheses, row: int, seen: SeenWithin) -> tuple[_Key, tuple[MovedGroup, ...]]:
    """Return a key of a hypothesis that ignores windows and kinds of motion, and its groups."""
    label = hypotheses.label[row]
    groups = []
    for g in range(1, int(label.max()) + 1):
        members, window = np.flatnonzero(label == g), int(hypotheses.onset[row, g])
        whole = MovedGroup(members, bool(hypotheses.turns[row, g]), hypotheses.motion[row, g - 1], window)
        group = seen.find_motion(whole, seen.shows(members, window))
        if len(group.members) == 0:
            continue
        if np.all(seen.first[group.members] >= window):  # nobody saw them before: as well before the session
            group = replace(group, window=0)
        groups.append(group)
    key = tuple((tuple(int(j) for j in group.members), group.window > 0) for group in groups)
    return key, tuple(groups)


Search = Callable[[WindowEvidence, Hypotheses | None], Slices[tuple[Comparison, Hypotheses]]]
"""Compares an evidence with the map and finds changes, from a start."""


def without_transients(
    evidence: WindowEvidence, position: FloatArray, given: GivenMap, prior: ChangesConfig, search: Search
) -> Slices[WindowEvidence]:
    """Return the evidence without copies that are displaced alone, from mapped positions (L, 2), in slices.

    Such a landmark was elsewhere for a while: it was where it is before, as a map has it (`given`) or other
    copies, and after it. Or its first sightings were, if not far off: what a drive begins with is the least certain.
    One that was not seen again has moved.
    """
    comparison, found = yield from search(evidence, None)
    spread = motion_spread(prior, evidence.numbers)[: evidence.numbers]
    for _ in range(len(evidence.landmark)):
        copy = np.arange(len(evidence.landmark))
        seen = SeenWithin.of(evidence, given, position)
        spared = evidence.window >= seen.last[evidence.landmark]  # not seen again
        is_first = ~given.given[evidence.landmark] & (evidence.window <= seen.first[evidence.landmark])
        alone = np.where(spared, 0.0, _gains(comparison, spread, prior, near=is_first))
        after = _integrate_moves(evidence, comparison, found, position, prior)
        yield dense_ms(len(comparison.pull))
        still = np.where(spared, 0.0, _gains(after, spread, prior, near=is_first))
        candidates: list[tuple[int, float]] = []  # a copy, and what leaving it out gains over keeping it
        worst = int(np.argmax(still))
        if still[worst] > prior.displaced_log_odds:
            candidates.append((worst, still[worst] - prior.displaced_log_odds))
        worst = int(np.argmax(alone))
        if alone[worst] > prior.displaced_log_odds and all(worst != other for other, _ in candidates):
            _, others = yield from search(evidence.without(copy == worst), found)
            candidates.append((worst, alone[worst] - prior.displaced_log_odds + float(others.gain[0] - found.gain[0])))
        best, gain = max(candidates, key=lambda candidate: candidate[1], default=(0, 0.0))
        if gain <= 0.0:
            break
        evidence = evidence.without(copy == best)
        comparison, found = yield from search(evidence, found)
    return evidence


def _gains(comparison: Comparison, spread: FloatArray, prior: ChangesConfig, near: BoolArray) -> FloatArray:
    """(R,) what every copy gains by a displacement of its own [nats], as far as `spread` (n,), or far; not those that
    are `near` (R,).
    """
    usual = _gains_within(comparison, spread)
    far = _gains_within(comparison, prior.far * spread) + np.log(prior.p_far)
    return np.where(near, usual, np.maximum(usual, far))


def _gains_within(comparison: Comparison, spread: FloatArray) -> FloatArray:
    n = len(spread)
    count = len(comparison.pull) // n
    rows = np.arange(count)
    precision = comparison.precision.reshape(count, n, count, n)[rows, :, rows, :]
    pull = comparison.pull.reshape(count, n)
    inner = precision + np.diag(spread**-2)
    solved = np.linalg.solve(inner, pull[:, :, None])[:, :, 0]
    return np.asarray(0.5 * (pull * solved).sum(axis=1) - 0.5 * np.linalg.slogdet(np.outer(spread, spread) * inner)[1])


def _integrate_moves(
    evidence: WindowEvidence, comparison: Comparison, found: Hypotheses, position: FloatArray, prior: ChangesConfig
) -> Comparison:
    """The comparison with the motions of the best hypothesis integrated out."""
    columns: list[FloatArray] = []
    shift = np.zeros_like(evidence.position)
    label = found.label[0]
    for g in range(1, int(label.max()) + 1):
        members: IntArray = np.flatnonzero(label == g)
        moved = np.isin(evidence.landmark, members) & (evidence.window >= found.onset[0, g])
        angle = found.motion[0, g - 1, 2] if found.turns[0, g] else 0.0
        arm = position[evidence.landmark] - position[members].mean(axis=0)
        turned = se2.transform([0.0, 0.0, angle], arm)
        tangent = np.column_stack([-turned[:, 1], turned[:, 0]])
        shift += moved[:, None] * (turned - arm - angle * tangent)
        parts = [np.tile([1.0, 0.0], (len(moved), 1)), np.tile([0.0, 1.0], (len(moved), 1)), tangent]
        spread = spread_of(found.motion[0, g - 1], prior)
        for column, sigma in zip(parts[: 3 if found.turns[0, g] else 2], spread, strict=False):
            columns.append((sigma * moved[:, None] * column).ravel())
    if not columns:
        return comparison
    matrix = np.column_stack(columns)
    pull = comparison.pull - comparison.precision @ shift.ravel()
    weighted = comparison.precision @ matrix
    inner = np.eye(matrix.shape[1]) + matrix.T @ weighted
    return comparison._replace(
        precision=comparison.precision - weighted @ np.linalg.solve(inner, weighted.T),
        pull=pull - weighted @ np.linalg.solve(inner, matrix.T @ pull),
    )
