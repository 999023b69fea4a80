"""How long things stay, learned from the history of this very map, after every session (MATH.md sections 5 and 6).

What is between two looks is not seen. Of comings the likelihood takes care (`survival.class_lifetimes`). Goings can be
missed, too: who leaves a site and is back at it by the next look has one long stay instead of two, as a door that was
opened and closed again. With a rate `l` of leaving, and `n` of coming back to this very site, who is there is there
again at the next look, after `dt`, with probability

    P(dt) = (n + l exp(-(l + n) dt)) / (l + n)          instead of exp(-l dt)

where hazards are constant. `n` follows from how often what was seen to go next turned up where it had come from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from evermap.maps.lives import EVERYWHERE, Life, Lives
from evermap.maps.living import Stays
from evermap.survival.class_lifetimes import (
    ClassPosterior,
    Sightings,
    absence_log_likelihood,
    absence_posterior,
    stay_log_likelihood,
    stay_posterior,
)
from evermap.survival.piecewise import PiecewiseConstantHazard
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray

NEWEST = 300
"""Stays of a class that are learned from: the last that began, whatever became of them, so that none is preferred."""
STRENGTH = 2.0
"""Events that the average over classes counts for in the probabilities of one."""
LEAST_ENDED = 5
"""Ends in a chunk before it has lifetimes of its own."""
_FIRMNESS = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0])
"""Ends that the lifetimes of a class may count for in those of a chunk; how many is learned."""


def learned_lives(stays: Stays, before: Lives, now_s: float) -> Lives:
    """Lifetimes by class and place from all stays of a map until now.

    Args:
        stays: of all cliques, also those that go on.
        before: what was learned after the session before; its chunks and looks are kept.
        now_s: end of the session.
    """
    looks_s = np.append(before.looks_s[before.looks_s < now_s], now_s)
    if not len(stays):
        return replace(before, looks_s=looks_s)
    history = _History.of(stays, looks_s)
    learned = _learned(history)
    entries: list[tuple[int, tuple[int, int], Life]] = []
    for row, class_id in enumerate(history.class_ids.tolist()):
        life = learned.life(row)
        entries.append((class_id, (EVERYWHERE, EVERYWHERE), life))
        entries += [(class_id, chunk, own) for chunk, own in _of_chunks(history, row, life, before.chunk_m)]
    if UNKNOWN not in history.class_ids:
        entries.append((UNKNOWN, (EVERYWHERE, EVERYWHERE), learned.life(-1)))
    return Lives(
        class_id=np.array([class_id for class_id, _, _ in entries], dtype=np.int64),
        chunk=np.array([chunk for _, chunk, _ in entries], dtype=np.int64),
        life=tuple(life for _, _, life in entries),
        chunk_m=before.chunk_m,
        looks_s=looks_s,
    )


def class_survival(
    stays: Stays, lives: Lives, class_id: int, ages_s: ArrayLike, confidence: float = 0.95
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What the stays of a map say about one class: `P(stay > age)`, and the bounds of its credible interval.

    Args:
        stays: of all cliques; the classes learn from each other.
        lives: learned from them.
        class_id: of the class; any that was never seen for a new one.
        ages_s: (N,) in seconds.
        confidence: probability that the truth lies between the bounds, at each age by itself.

    Returns:
        (N,) posterior mean, lower and upper bound.
    """
    history = _History.of(stays, lives.looks_s)
    found = np.flatnonzero(history.class_ids == class_id)
    return _learned(history).stay.band(int(found[0]) if len(found) else -1, ages_s, confidence)


@dataclass(frozen=True, slots=True)
class _History:
    """Stays by clique, then by time, with what came after each.

    Attributes:
        stays: K of them.
        looks_s: (M,) ends of sessions.
        class_ids: (C,) classes there are.
        kind: (K,) row of the class.
        recent: whether it is one of the newest of its class.
        hopped: the next stay may have begun when this one ended.
        away: it was looked for and not found, before it turned up again or until now.
        seen_away_s, back_s: last look at which it was away, and next sighting, `inf` if it did not return.
        to_known: whether the next stay is at a site that had been known; `had_choice` whether there was one.
        back_here: whether the next stay is at this very site.
        there_again: hopped twice and was where it had been; `hopped_twice` whether it did.
    """

    stays: Stays
    looks_s: FloatArray
    class_ids: IntArray
    kind: IntArray
    recent: BoolArray
    hopped: BoolArray
    away: BoolArray
    seen_away_s: FloatArray
    back_s: FloatArray
    to_known: BoolArray
    had_choice: BoolArray
    back_here: BoolArray
    there_again: BoolArray
    hopped_twice: BoolArray

    @classmethod
    def of(cls, stays: Stays, looks_s: FloatArray) -> Self:
        """From the stays of a map in any order."""
        stays = stays[np.lexsort((stays.first_s, stays.clique_id))]
        class_ids, kind = np.unique(stays.class_id, return_inverse=True)
        n = len(stays)
        after = np.minimum(np.arange(n) + 1, n - 1)
        has_next = np.append(stays.clique_id[1:] == stays.clique_id[:-1], False)
        site, site_after = stays.site_id, stays.site_id[after]

        # numbers of sessions: the first in which it may have stood at the next site, and the one that missed it here
        elsewhere_s, first_s = stays.elsewhere_s[after], stays.first_s[after]
        looked = np.searchsorted(looks_s, np.where(np.isfinite(elsewhere_s), elsewhere_s, 0.0))
        came = np.where(np.isfinite(elsewhere_s), looked + 1, np.searchsorted(looks_s, first_s))
        ended = np.isfinite(stays.gone_s)
        gone = np.searchsorted(looks_s, stays.gone_s)
        hopped = has_next & ended & (came <= gone)
        back_s = np.where(has_next, stays.first_s[after], np.inf)
        seen_away_s = np.maximum(np.where(has_next, elsewhere_s, looks_s[-1]), stays.gone_s)
        away = ended & ~hopped & (seen_away_s < back_s)

        # what was known of a clique when it turned up again
        pair = np.stack([stays.clique_id, site], axis=1)
        is_new = np.zeros(n, dtype=np.bool_)
        is_new[np.unique(pair, axis=0, return_index=True)[1]] = True
        known = np.cumsum(is_new)
        begin = np.flatnonzero(np.append(True, ~has_next[:-1]))
        known = known - np.repeat(known[begin] - 1, np.diff(np.append(begin, n)))  # sites of the clique until then
        hopped_twice = hopped & hopped[after] & has_next
        return cls(
            stays=stays,
            looks_s=looks_s,
            class_ids=class_ids,
            kind=kind.ravel(),
            recent=_newest(kind.ravel(), stays.first_s),
            hopped=hopped,
            away=away,
            seen_away_s=seen_away_s,
            back_s=back_s,
            to_known=~is_new[after],
            had_choice=has_next & ((hopped & (known > 1)) | away),
            back_here=site_after == site,
            there_again=site[after[after]] == site,
            hopped_twice=hopped_twice,
        )

    def shares(self, event: BoolArray, chance: BoolArray) -> FloatArray:
        """(C + 1,) probability of an event for each class, and for one never seen; classes lean on their average."""
        chances, events = (
            np.bincount(self.kind[self.recent & rows], minlength=len(self.class_ids))
            for rows in (chance, event & chance)
        )
        average = (events.sum() + 0.5 * STRENGTH) / (chances.sum() + STRENGTH)
        return np.append((events + STRENGTH * average) / (chances + STRENGTH), average)

    def sightings(self, back_by_stay: FloatArray, back_rate: FloatArray) -> Sightings:
        """Of the recent stays, with what may have been missed between the looks at them."""
        stays, looks_s = self.stays[self.recent], self.looks_s
        first, last = (np.minimum(np.searchsorted(looks_s, t), len(looks_s) - 1) for t in (stays.first_s, stays.last_s))
        n_gaps = np.maximum(last - first, 1)
        squares = np.append(0.0, np.cumsum(np.square(np.diff(looks_s))))
        mean_s = np.where(last > first, looks_s[last] - looks_s[first], stays.last_s - stays.first_s) / n_gaps
        mean_s = np.maximum(mean_s, 1.0)  # seen once: no gap, no matter how long
        spread_s = np.sqrt(np.maximum((squares[last] - squares[first]) / n_gaps - np.square(mean_s), 0.0))
        spread_s = np.minimum(spread_s, 0.9 * mean_s)
        gap_s = np.stack([mean_s - spread_s, mean_s + spread_s], axis=1)
        return Sightings(stays.elsewhere_s, stays.first_s, stays.last_s, stays.gone_s, gap_s, back_by_stay, back_rate)


@dataclass(frozen=True, slots=True)
class _Learned:
    """Posteriors and probabilities of all classes, the last row of one that was never seen."""

    stay: ClassPosterior
    absence: ClassPosterior
    p_hop: FloatArray
    p_known: FloatArray
    n_stays: IntArray
    n_ended: IntArray

    def life(self, row: int) -> Life:
        return Life(
            stay=self.stay.curve(row),
            absence=self.absence.curve(row),
            p_hop=float(self.p_hop[row]),
            p_known=float(self.p_known[row]),
            n_stays=int(self.n_stays[row]),
            n_ended=int(self.n_ended[row]),
        )


def _learned(history: _History) -> _Learned:
    stays, n_classes = history.stays, len(history.class_ids)
    gone_away = history.recent & history.away
    absence = absence_posterior(
        _by_class(
            absence_log_likelihood(
                stays.last_s[gone_away],
                stays.gone_s[gone_away],
                history.seen_away_s[gone_away],
                history.back_s[gone_away],
            ),
            history.kind[gone_away],
            n_classes,
        )
    )
    ended = np.isfinite(stays.gone_s)
    p_hop = history.shares(history.hopped, ended)
    back_by_hop = p_hop * history.shares(history.there_again, history.hopped_twice)
    here_again = history.shares(history.back_here, history.away & np.isfinite(history.back_s))
    back_rate = (1.0 - p_hop) * here_again * np.array([absence.rate(row) for row in range(n_classes + 1)])
    back = history.kind[history.recent]
    log_likelihood = stay_log_likelihood(history.sightings(back_by_hop[back], back_rate[back]))
    log_likelihood = _by_class(log_likelihood, back, n_classes)
    return _Learned(
        stay_posterior(log_likelihood),
        absence,
        p_hop,
        history.shares(history.to_known, history.had_choice),
        *(
            np.append(np.bincount(history.kind[mask], minlength=n_classes), mask.sum())
            for mask in (history.recent, history.recent & ended)
        ),
    )


def _of_chunks(history: _History, row: int, life: Life, chunk_m: float) -> list[tuple[tuple[int, int], Life]]:
    """Chunks in which stays of a class end sooner or later than everywhere, as far as they say so.

    Rates of a chunk are those of the class times a factor with a gamma prior of mean 1 (Clayton and Kaldor 1987): with
    O ends where E were to be expected, `(f + O) / (f + E)`; the firmness f is weighed by what all chunks say.
    """
    from scipy.special import gammaln

    mine = np.flatnonzero(history.recent & (history.kind == row))
    chunks, which = np.unique(
        np.floor(history.stays.position_m[mine] / chunk_m).astype(np.int64), axis=0, return_inverse=True
    )
    if len(chunks) < 2:
        return []
    stays = history.stays[mine]
    ended = np.isfinite(stays.gone_s)
    came_s = np.where(np.isfinite(stays.elsewhere_s), 0.5 * (stays.elsewhere_s + stays.first_s), stays.first_s)
    left_s = np.where(ended, 0.5 * (stays.last_s + stays.gone_s), stays.last_s)
    expected = -life.stay.log_conditional_survival(stays.first_s - came_s, left_s - came_s)
    n_ended = np.bincount(which.ravel(), ended)
    n_expected = np.bincount(which.ravel(), expected)
    firm = _FIRMNESS[:, None]
    log_weight = np.sum(
        gammaln(firm + n_ended) - gammaln(firm) + firm * np.log(firm) - (firm + n_ended) * np.log(firm + n_expected),
        axis=1,
    )
    weight = np.exp(log_weight - log_weight.max())
    factor = (weight / weight.sum()) @ ((firm + n_ended) / (firm + n_expected))
    own: list[tuple[tuple[int, int], Life]] = []
    for k in np.flatnonzero(n_ended >= LEAST_ENDED):
        assert isinstance(life.stay, PiecewiseConstantHazard)
        rates = tuple(float(factor[k]) * rate for rate in life.stay.rates)
        stay = PiecewiseConstantHazard(life.stay.edges_s, rates)
        n_stays = int(np.sum(which.ravel() == k))
        here = replace(life, stay=stay, n_stays=n_stays, n_ended=int(n_ended[k]))
        own.append(((int(chunks[k, 0]), int(chunks[k, 1])), here))
    return own


def _newest(kind: IntArray, first_s: FloatArray) -> BoolArray:
    """(K,) the last `NEWEST` stays of every class, by their beginning."""
    order = np.lexsort((-first_s, kind))
    start = np.searchsorted(kind[order], kind[order])
    newest = np.zeros(len(kind), dtype=np.bool_)
    newest[order] = np.arange(len(kind)) - start < NEWEST
    return newest


def _by_class(values: FloatArray, kind: IntArray, n_classes: int) -> FloatArray:
    """(C, ...) sums over the rows of each class."""
    member = (kind == np.arange(n_classes)[:, None]).astype(np.float64)
    return np.asarray(np.tensordot(member, values, axes=1))
