"""What a map knows of the comings and goings of its cliques, and what may have happened while nobody looked.

What is between two looks is not seen. Of comings the likelihood of lifetimes takes care. Goings can be missed, too: who
leaves a site and is back at it by the next look has one long stay instead of two, as a door that was opened and closed
again. With a rate `l` of leaving, and `n` of coming back to this very site, who is there is there again at the next
look, after `dt`, with probability

    P(dt) = (n + l exp(-(l + n) dt)) / (l + n)          instead of exp(-l dt)

where hazards are constant. `n` follows from how often what was seen to go next turned up where it had come from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from evermap.maps.living import Stays
from evermap.survival.class_lifetimes import Sightings
from evermap.types import BoolArray, FloatArray, IntArray

NEWEST = 300
"""Stays of a class that are learned from: the last that began, whatever became of them, so that none is preferred."""
STRENGTH = 2.0
"""Events that the average over classes counts for in the probabilities of one."""


@dataclass(frozen=True, slots=True)
class History:
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
        chances, events = (self.counts(self.recent & rows, self.stays.p_gone) for rows in (chance, event & chance))
        # classes differ: every one counts for one event at most, however often it was seen
        weight = 1.0 / (chances[:-1] + STRENGTH)
        average = (0.5 + events[:-1] @ weight) / (1.0 + chances[:-1] @ weight)
        of_classes = (events[:-1] + STRENGTH * average) / (chances[:-1] + STRENGTH)
        return np.append(of_classes, average)

    def counts(self, rows: BoolArray, weight: FloatArray | None = None) -> FloatArray:
        """(C + 1,) how many of some rows (K,), or what they weigh, are of each class, and of all together."""
        each = np.ones(len(rows)) if weight is None else weight
        return np.append(np.bincount(self.kind[rows], each[rows], minlength=len(self.class_ids)), each[rows].sum())

    @property
    def gap_s(self) -> float:
        """Between two looks, as a rule; a day as long as there was one look."""
        return float(np.median(np.diff(self.looks_s))) if len(self.looks_s) > 1 else 86_400.0

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


def _newest(kind: IntArray, first_s: FloatArray) -> BoolArray:
    """(K,) the last `NEWEST` stays of every class, by their beginning."""
    order = np.lexsort((-first_s, kind))
    start = np.searchsorted(kind[order], kind[order])
    newest = np.zeros(len(kind), dtype=np.bool_)
    newest[order] = np.arange(len(kind)) - start < NEWEST
    return newest
