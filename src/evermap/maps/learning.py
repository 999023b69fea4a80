"""How long things stay, learned from the history of this very map, after every session (MATH.md sections 5 and 6).

Classes learn from each other (`survival.class_lifetimes`), places lean on their class. Of what happened between two
looks only the outcome is known; `history` says what could have been.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from evermap.maps.history import History
from evermap.maps.lives import EVERYWHERE, Life, Lives
from evermap.maps.living import Stays
from evermap.survival.class_lifetimes import (
    ClassPosterior,
    absence_log_likelihood,
    absence_posterior,
    stay_log_likelihood,
    stay_posterior,
)
from evermap.survival.hazards import PiecewiseConstantHazard
from evermap.types import UNKNOWN, FloatArray, IntArray, rows_of

LEAST_ENDED = 5
"""Ends in a chunk before it has lifetimes of its own."""
SURE = 0.999
"""Ends of stays that are more probable than this count as ends."""
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
    history = History.of(stays, looks_s)
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
    history = History.of(stays, lives.looks_s)
    found = np.flatnonzero(history.class_ids == class_id)
    return _learned(history).stay.band(int(found[0]) if len(found) else -1, ages_s, confidence)


@dataclass(frozen=True, slots=True)
class LongestLives:
    """The longest lifetimes that are credible: upper bounds of the survival functions of classes."""

    class_ids: IntArray
    stay: ClassPosterior
    confidence: float

    @classmethod
    def of(cls, stays: Stays, looks_s: FloatArray, confidence: float) -> Self:
        """From all stays of a map, with the ends (M,) of its sessions."""
        history = History.of(stays, looks_s)
        return cls(history.class_ids, _learned(history).stay, confidence)

    def survival(self, class_id: IntArray, age_s: FloatArray) -> FloatArray:
        """(N,) upper bounds of `P(stay > age)`, of classes (N,) at ages (N,)."""
        upper = np.empty(len(class_id))
        for kind in np.unique(class_id):
            mine, row = class_id == kind, np.flatnonzero(self.class_ids == kind)
            upper[mine] = self.stay.band(int(row[0]) if len(row) else -1, age_s[mine], self.confidence)[2]
        return upper


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


def _learned(history: History) -> _Learned:
    stays, n_classes = history.stays, len(history.class_ids)
    ended = np.isfinite(stays.gone_s)
    away = np.flatnonzero(history.recent & history.away)
    log_likelihood = absence_log_likelihood(
        stays.last_s[away], stays.gone_s[away], history.seen_away_s[away], history.back_s[away]
    )
    log_likelihood *= stays.p_gone[away, None, None]
    absence = absence_posterior(_by_class(log_likelihood, history.kind[away], n_classes))
    p_hop = history.shares(history.hopped, ended)
    back_by_hop = p_hop * history.shares(history.there_again, history.hopped_twice)
    here_again = history.shares(history.back_here, history.away & np.isfinite(history.back_s))
    # of those that a look missed: who is back before nobody can miss, and counts as one who never left
    gap_s = history.gap_s
    back = [-absence.curve(row).log_conditional_survival(gap_s, 2.0 * gap_s) / gap_s for row in range(n_classes + 1)]
    back_rate = (1.0 - p_hop) * here_again * np.array(back)
    kind = history.kind[history.recent]
    seen = history.sightings(back_by_hop[kind], back_rate[kind])
    log_likelihood = stay_log_likelihood(seen)
    doubted = ended[history.recent] & (stays.p_gone[history.recent] < SURE)
    if doubted.any():  # expected log likelihood: perhaps it goes on
        p_gone = stays.p_gone[history.recent][doubted, None, None]
        going_on = rows_of(seen, doubted)
        going_on = replace(going_on, gone_s=np.full(len(going_on.gone_s), np.inf))
        log_likelihood[doubted] = p_gone * log_likelihood[doubted] + (1.0 - p_gone) * stay_log_likelihood(going_on)
    log_likelihood = _by_class(log_likelihood, kind, n_classes)
    p_known = history.shares(history.to_known, history.had_choice)
    counts = (history.counts(mask).astype(np.int64) for mask in (history.recent, history.recent & ended))
    return _Learned(stay_posterior(log_likelihood), absence, p_hop, p_known, *counts)


def _of_chunks(history: History, row: int, life: Life, chunk_m: float) -> list[tuple[tuple[int, int], Life]]:
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
    n_ended = np.bincount(which.ravel(), ended * stays.p_gone)
    n_expected = np.bincount(which.ravel(), expected)
    n_expected *= max(n_ended.sum(), 1.0) / n_expected.sum()  # ends that nobody saw are missing everywhere
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
        here = replace(life, stay=stay, n_stays=n_stays, n_ended=round(n_ended[k]))
        own.append(((int(chunks[k, 0]), int(chunks[k, 1])), here))
    return own


def _by_class(values: FloatArray, kind: IntArray, n_classes: int) -> FloatArray:
    """(C, ...) sums over the rows of each class."""
    member = (kind == np.arange(n_classes)[:, None]).astype(np.float64)
    return np.asarray(np.tensordot(member, values, axes=1))
