"""Learning of lifetimes from the history of a map, after every session (MATH.md sections 5, 6 and 9).

Classes learn from each other, and what a user says of a class counts as a number of stays and keeps its form
(`survival.pooled_hazards`); places lean on their class. Where stamps are dates, ages of stays are counted by the hours
of the week at which stays end, if they end at some rather than at others (`existence.hours`). Absences of which nothing
was said have a constant hazard and a share that never returns (`survival.class_lifetimes`). `History` is what a map
knows of the comings and goings of its cliques. What happened between two looks is not seen. The likelihood of lifetimes
takes care of arrivals. Departures can be missed, too: a clique that leaves a site and is back at it by the next look
has one long stay instead of two, like a door that was opened and closed again. With a rate `l` of leaving, and `n` of
coming back to this very site, a clique that is there is there again at the next look, after `dt`, with probability

    P(dt) = (n + l exp(-(l + n) dt)) / (l + n)          instead of exp(-l dt)

where hazards are constant. `n` follows from how often what was seen to go next turned up where it had come from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from evermap.config import LifetimeConfig
from evermap.errors import ConfigError, suggestion
from evermap.existence.hours import DatedStays, HourFit, learn_hours_and_hazards
from evermap.existence.lifetimes import Lifetimes
from evermap.maps.lives import DAY_S, EVERYWHERE, Life, Lives, general_purpose
from evermap.maps.living import LivingMap, Stays
from evermap.survival.base import LifetimePrior
from evermap.survival.class_lifetimes import (
    INSTANTS,
    LOG_MEAN,
    LOG_SHAPE,
    LOGIT_RETURN,
    ClassPosterior,
    Sightings,
    absence_log_likelihood,
    stay_log_likelihood,
)
from evermap.survival.hazard_posterior import HazardPosterior
from evermap.survival.hazards import scale_hazard
from evermap.survival.pooled_hazards import Statement, learn_hazards
from evermap.survival.stay_likelihood import StayAges
from evermap.types import UNKNOWN, BoolArray, Clock, FloatArray, IntArray, rows_of

USUAL = LifetimeConfig()
BELIEVED = 2
"""Digits of the belief in an end that are learned from: less is no other evidence."""
EM_STEPS = 30
"""Of which each at least halves the error of a share."""
AGES_AT_ONCE = 50
"""Of which the longest credible lifetimes are asked together."""


class History:
    """Stays by clique, then by time, with the event after each.

    Args:
        stays: of a map, in any order.
        looks_s: (M,) ends of sessions.
        settings: which stays are recent, and how firmly classes lean on each other.

    Attributes:
        stays: K of them, in order.
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

    def __init__(self, stays: Stays, looks_s: FloatArray, settings: LifetimeConfig) -> None:
        self.stays = stays = stays[np.lexsort((stays.first_s, stays.clique_id))]
        self.looks_s, self._strength = looks_s, settings.strength
        self.class_ids, kind = np.unique(stays.class_id, return_inverse=True)
        self.kind = kind.ravel()
        self.recent = _newest(self.kind, stays.first_s, settings.newest)
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
        self.hopped = has_next & ended & (came <= gone)
        self.back_s = np.where(has_next, stays.first_s[after], np.inf)
        self.seen_away_s = np.maximum(np.where(has_next, elsewhere_s, looks_s[-1]), stays.gone_s)
        self.away = ended & ~self.hopped & (self.seen_away_s < self.back_s)

        # what was known of a clique when it turned up again
        pair = np.stack([stays.clique_id, site], axis=1)
        is_new = np.zeros(n, dtype=np.bool_)
        is_new[np.unique(pair, axis=0, return_index=True)[1]] = True
        known = np.cumsum(is_new)
        begin = np.flatnonzero(np.append(True, ~has_next[:-1]))
        known = known - np.repeat(known[begin] - 1, np.diff(np.append(begin, n)))  # sites of the clique until then
        self.to_known = ~is_new[after]
        self.had_choice = has_next & ((self.hopped & (known > 1)) | self.away)
        self.back_here = site_after == site
        self.there_again = site[after[after]] == site
        self.hopped_twice = self.hopped & self.hopped[after] & has_next

    def shares(self, event: BoolArray, chance: BoolArray) -> FloatArray:
        """Return (C + 1,) probability of an event for each class, and for one never seen; classes lean on their
        average.
        """
        chances, events = (self.counts(self.recent & rows, self.stays.p_gone) for rows in (chance, event & chance))
        return self._lean(events, chances)

    def share_known(self) -> FloatArray:
        """Return (C + 1,) probability that who turns up again does so at a known site, as `believe.dynamics_of` takes
        it: of known sites the one that was left has half. A hop is a draw that is repeated until it is another one, so
        `p / (2 - p)` draws of its own site a hop do not show; they are counted by expectation (EM, Dempster 1977).
        """
        n_hops, chances, events = (
            self.counts(self.recent & self.had_choice & rows, self.stays.p_gone)
            for rows in (self.hopped, np.ones(len(self.hopped), dtype=np.bool_), self.to_known)
        )
        p = np.full(len(chances), 0.5)
        for _ in range(EM_STEPS):
            unseen = n_hops * p / (2.0 - p)
            p = self._lean(events + unseen, chances + unseen)
        return p

    def _lean(self, events: FloatArray, chances: FloatArray) -> FloatArray:
        """Return (C + 1,) shares of events in chances (C + 1,), which lean on their average."""
        # classes differ: every one counts for one event at most, however often it was seen
        weight = 1.0 / (chances[:-1] + self._strength)
        average = (0.5 + events[:-1] @ weight) / (1.0 + chances[:-1] @ weight)
        of_classes = (events[:-1] + self._strength * average) / (chances[:-1] + self._strength)
        return np.append(of_classes, average)

    def counts(self, rows: BoolArray, weight: FloatArray | None = None) -> FloatArray:
        """Return (C + 1,) counts, or weights, of rows (K,) per class, and in total."""
        each = np.ones(len(rows)) if weight is None else weight
        return np.append(np.bincount(self.kind[rows], each[rows], minlength=len(self.class_ids)), each[rows].sum())

    def sightings(self, back_by_stay: FloatArray, back_rate: FloatArray) -> Sightings:
        """Return the recent stays as samples, with events that may have been missed between looks."""
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


def _newest(kind: IntArray, first_s: FloatArray, most: int) -> BoolArray:
    """(K,) the last `most` stays of every class, by their beginning."""
    order = np.lexsort((-first_s, kind))
    start = np.searchsorted(kind[order], kind[order])
    newest = np.zeros(len(kind), dtype=np.bool_)
    newest[order] = np.arange(len(kind)) - start < most
    return newest


@dataclass(frozen=True, slots=True)
class ClassLives:
    """Posterior of the lifetimes of a map's classes; the last row is a class never seen.

    Attributes:
        lives: the same as lifetimes by class and place.
        class_ids: (C,) classes there are.
        stay: (C + 1,) posteriors of the stays of each.
    """

    lives: Lives
    class_ids: IntArray
    stay: tuple[HazardPosterior, ...]

    @classmethod
    def of(
        cls,
        stays: Stays,
        before: Lives,
        now_s: float | None = None,
        settings: LifetimeConfig = USUAL,
        clock: Clock = Clock.RECORDING,
    ) -> Self:
        """Learn lifetimes by class and place from all stays of a map until now.

        Args:
            stays: of all cliques, also those that go on; the classes learn from each other.
            before: what was learned after the session before; its chunks, looks and priors are kept.
            now_s: end of the newest session; None where `before` tells of it, too.
            settings: what is learned from, and how firmly.
            clock: of all stamps; a recording's own has no hours of the week.
        """
        looks_s = before.looks_s if now_s is None else np.append(before.looks_s[before.looks_s < now_s], now_s)
        if not len(stays):
            nothing = learn_hazards(StayAges.empty(), [], general_purpose())
            lives = _with_hours(replace(before, looks_s=looks_s), None, np.zeros(0, dtype=np.int64))
            return cls(lives, np.zeros(0, dtype=np.int64), tuple(nothing))
        history = History(stays, looks_s, settings)
        learned = _Learned(history, before, clock)
        before = _with_hours(before, learned.hours, history.class_ids)
        entries: list[tuple[int, tuple[int, int], Life]] = []
        for row, class_id in enumerate(history.class_ids.tolist()):
            life = learned.life(row)
            entries.append((class_id, (EVERYWHERE, EVERYWHERE), life))
            own_lives = _of_chunks(history, row, life, before.chunk_m, settings, learned.hours)
            entries += [(class_id, chunk, own) for chunk, own in own_lives]
        if UNKNOWN not in history.class_ids:
            said, of_all = before.prior_of(UNKNOWN), learned.life(-1)
            entries.append((UNKNOWN, (EVERYWHERE, EVERYWHERE), of_all if said is None else of_all.as_said(said)))
        kinds, chunks, found = zip(*entries, strict=True)
        lives = replace(before, class_id=np.array(kinds), chunk=np.array(chunks), life=found, looks_s=looks_s)
        return cls(lives, history.class_ids, learned.stay)

    def band(
        self, class_id: int, ages_s: ArrayLike, confidence: float = 0.95
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return `P(stay > age)` of a class at ages (N,) [s]: (N,) posterior mean, and lower and upper bound of the
        credible interval at each age by itself. All classes that were never seen are alike.
        """
        found = np.flatnonzero(self.class_ids == class_id)
        return self.stay[int(found[0]) if len(found) else -1].survival(ages_s, confidence)

    def longest(self, class_id: IntArray, age_s: FloatArray, confidence: float) -> FloatArray:
        """Return (N,) upper bounds of `P(stay > age)`, of classes (N,) at ages (N,): the longest credible lifetimes."""
        upper = np.empty(len(class_id))
        for kind in np.unique(class_id):
            mine = class_id == kind
            ages, of = np.unique(age_s[mine], return_inverse=True)  # of what one look saw last they are the same
            parts = np.array_split(ages, len(ages) // AGES_AT_ONCE + 1)
            upper[mine] = np.concatenate([self.band(int(kind), some, confidence)[2] for some in parts])[of.ravel()]
        return upper


class _Learned:
    """Posteriors and probabilities of all classes, the last row of one that was never seen.

    Attributes:
        stay, absence: posteriors; stated_absence: those of absences of which a user says something, by row.
        of_absences: (C, M, A) log likelihoods of absences.
        p_hop, p_known: (C + 1,) as of `Life`.
        n_stays, n_ended: (C + 1,) recent stays, and those of them that ended.
        hours: what the stays say of the hours of the week; None where they cannot say anything.
    """

    def __init__(self, history: History, before: Lives, clock: Clock = Clock.RECORDING) -> None:
        stays, n_classes = history.stays, len(history.class_ids)
        said = [before.prior_of(class_id) for class_id in history.class_ids.tolist()]
        away = np.flatnonzero(history.recent & history.away)
        times = stays.last_s[away], stays.gone_s[away], history.seen_away_s[away], history.back_s[away]
        log_likelihood = absence_log_likelihood(*times)
        log_likelihood *= stays.p_gone[away, None, None]
        self.of_absences = _by_class(log_likelihood, history.kind[away], n_classes)
        self.absence = ClassPosterior.of(self.of_absences, improper=True)
        self.stated_absence: dict[int, HazardPosterior] = {}
        absences = absence_ages(*times, stays.p_gone[away], history.kind[away])
        for row, life in enumerate(said):
            if life and life.tells_absence:
                mine, statement = absences.of_group(row), Statement(life.absence, life.n_stays)
                mine = replace(mine, group=np.zeros_like(mine.group))
                self.stated_absence[row] = learn_hazards(mine, [statement], general_purpose())[0]
        self.p_hop = history.shares(history.hopped, np.isfinite(stays.gone_s))
        self.seen = self.sightings(history)
        statements = [Statement(life.stay, life.n_stays) if life else None for life in said]

        def learn(hours: HourFit | None = None) -> list[HazardPosterior]:
            return learn_hazards(stay_ages(history, self.seen, hours), statements, general_purpose())

        found: tuple[HourFit | None, Sequence[HazardPosterior]] = None, learn()
        if clock is not Clock.RECORDING:
            stated = np.array([one is not None for one in statements])
            found = learn_hours_and_hazards(date_stays(history, self.seen), found[1], stated, learn)
        self.hours, self.stay = found[0], tuple(found[1])
        self.p_known = history.share_known()
        self.n_stays = history.counts(history.recent).astype(np.int64)
        self.n_ended = history.counts(history.recent & np.isfinite(stays.gone_s)).astype(np.int64)

    def sightings(self, history: History) -> Sightings:
        """Return the recent stays, with how fast what a look missed is back: who is back before nobody can miss."""
        back_by_hop = self.p_hop * history.shares(history.there_again, history.hopped_twice)
        here_again = history.shares(history.back_here, history.away & np.isfinite(history.back_s))
        looks_s = history.looks_s
        gap_s = float(np.median(np.diff(looks_s))) if len(looks_s) > 1 else DAY_S  # between two looks, as a rule
        back = [
            -float(self.absence_of(row).log_conditional_survival(gap_s, 2.0 * gap_s)) / gap_s
            for row in [*range(len(history.class_ids)), -1]
        ]
        back_rate = (1.0 - self.p_hop) * here_again * np.array(back)
        kind = history.kind[history.recent]
        return history.sightings(back_by_hop[kind], back_rate[kind])

    def absence_of(self, row: int) -> LifetimePrior:
        """Return the lifetime of the absences of a class."""
        return self.stated_absence[row].prior() if row in self.stated_absence else self.absence.curve(row)

    def life(self, row: int) -> Life:
        """Return the lifetimes of a class."""
        return Life(
            stay=self.stay[row].prior(),
            absence=self.absence_of(row),
            p_hop=float(self.p_hop[row]),
            p_known=float(self.p_known[row]),
            n_stays=int(self.n_stays[row]),
            n_ended=int(self.n_ended[row]),
        )


@dataclass(frozen=True, slots=True)
class ClassEvidence:
    """Log likelihoods of the stays of a map for each of its C classes, without priors of a user.

    Attributes:
        class_names: of each; '' for landmarks without a class.
        stay: (C, M, A) log likelihoods on `LOG_MEAN` and `LOG_SHAPE`.
        absence: (C, M, A) on `LOG_MEAN` and `LOGIT_RETURN`.
        n_stays, n_ended: (C,) stays, and how many of them were seen to end.
    """

    class_names: tuple[str, ...]
    stay: FloatArray
    absence: FloatArray
    n_stays: IntArray
    n_ended: IntArray

    @classmethod
    def of(cls, living: LivingMap, settings: LifetimeConfig = USUAL) -> Self:
        """Collect it from the history of a map; of no class where no session has ended."""
        if not (len(living.stays) and len(living.lives.looks_s)):
            stay, absence = (np.zeros((0, len(LOG_MEAN), len(second))) for second in (LOG_SHAPE, LOGIT_RETURN))
            none = np.zeros(0, dtype=np.int64)
            return cls((), stay, absence, none, none)
        history = History(living.stays, living.lives.looks_s, settings)
        untold = replace(living.lives, prior_class_id=np.zeros(0, dtype=np.int64), prior=())
        learned, names = _Learned(history, untold), dict(enumerate(living.class_names))
        class_names = tuple(names.get(class_id, "") for class_id in history.class_ids.tolist())
        stay = stays_by_class(history, learned.seen, settings)
        return cls(class_names, stay, learned.of_absences, learned.n_stays[:-1], learned.n_ended[:-1])


def stays_by_class(history: History, seen: Sightings, settings: LifetimeConfig) -> FloatArray:
    """Return the (C, M, A) log likelihoods of the recent stays on the grid of `ClassEvidence`."""
    log_likelihood = stay_log_likelihood(seen)
    p_gone = history.stays.p_gone[history.recent]
    doubted = np.isfinite(seen.gone_s) & (p_gone < settings.sure)
    if doubted.any():  # expected log likelihood: perhaps it goes on
        share = p_gone[doubted, None, None]
        going_on = rows_of(seen, doubted)
        going_on = replace(going_on, gone_s=np.full(len(going_on.gone_s), np.inf))
        log_likelihood[doubted] = share * log_likelihood[doubted] + (1.0 - share) * stay_log_likelihood(going_on)
    return _by_class(log_likelihood, history.kind[history.recent], len(history.class_ids))


def date_stays(history: History, seen: Sightings) -> DatedStays:
    """Return the recent stays by their stamps, with instants of arrival between two looks."""
    came = np.isfinite(seen.elsewhere_s)
    since_s = np.where(came, seen.elsewhere_s, seen.first_s)
    begin_s = since_s[:, None] + INSTANTS * (seen.first_s - since_s)[:, None]
    gone_s = np.where(np.isfinite(seen.gone_s), seen.gone_s, np.maximum(history.looks_s[-1], seen.last_s))
    p_gone = np.round(history.stays.p_gone[history.recent], BELIEVED)
    kind = history.kind[history.recent]
    return DatedStays(begin_s, seen.first_s, seen.last_s, gone_s, p_gone, np.ones(len(kind)), kind)


def stay_ages(history: History, seen: Sightings, hours: HourFit | None = None) -> StayAges:
    """Return the recent stays by their ages, on the clock of the hours of the week where there is one; an end that is
    believed in part is one, and none, in proportion.

    What was there at the first look is as old as it was seen: forecasts ask for no other age of it. What was missed and
    is not told to be gone has gone in part, too, at any time until now: who learns of those alone that were seen again
    takes all for lasting.
    """
    dated, gap_s = date_stays(history, seen), seen.gap_s
    stamps_s = dated.begin_s, dated.first_s, dated.last_s, dated.gone_s
    if hours is not None:
        counted = tuple(hours.count_s(dated.group, stamp_s) for stamp_s in stamps_s)
        with np.errstate(invalid="ignore", divide="ignore"):  # as many gaps as there were
            ratio = (counted[2] - counted[1]) / (dated.last_s - dated.first_s)
        gap_s = gap_s * np.where(np.isfinite(ratio) & (ratio > 0.0), ratio, 1.0)[:, None]
        stamps_s = counted[0], counted[1], counted[2], counted[3]
    begin_s = stamps_s[0]
    first, last, gone = (stamp_s[:, None] - begin_s for stamp_s in stamps_s[1:])
    never = np.full_like(gone, np.inf)
    both = [
        StayAges(first, last, gone, dated.p_gone, dated.group, gap_s, seen.back_by_stay, seen.back_rate),
        StayAges(first, last, never, 1.0 - dated.p_gone, dated.group, gap_s, seen.back_by_stay, seen.back_rate),
    ]
    return StayAges.concatenate(both)


def _with_hours(lives: Lives, hours: HourFit | None, class_ids: IntArray) -> Lives:
    """Return lifetimes with what was learned of the hours of the week."""
    known = np.zeros(0) if hours is None else np.array([hours.n_dated, hours.log_evidence])
    if hours is None or hours.rhythm is None:
        none = np.zeros(0)
        return replace(lives, log_factor=none, hourly_class_id=none.astype(np.int64), hours_known=known)
    unseen = [] if lives.prior_of(UNKNOWN) is not None or UNKNOWN in class_ids else [UNKNOWN]
    follow = np.union1d(class_ids[hours.follows], np.array(unseen, dtype=np.int64))
    return replace(lives, log_factor=hours.rhythm.log_factor, hourly_class_id=follow, hours_known=known)


def absence_ages(
    there_s: FloatArray, first_s: FloatArray, last_s: FloatArray, back_s: FloatArray, p_gone: FloatArray, kind: IntArray
) -> StayAges:
    """Return K absences by their ages at looks, with the arguments of `absence_log_likelihood`."""
    begin_s = there_s[:, None] + INSTANTS * (first_s - there_s)[:, None]
    first, last, back = (stamp_s[:, None] - begin_s for stamp_s in (first_s, last_s, back_s))
    n = len(kind)
    return StayAges(first, last, back, p_gone, kind, np.ones((n, 2)), np.zeros(n), np.zeros(n))


def with_priors(living: LivingMap, said: Mapping[str, Lifetimes], class_names: Sequence[str], worth: int) -> LivingMap:
    """Return a map with a user's priors for the lifetimes of some classes, to be updated by its own stays.

    Args:
        living: the map; what it was told of the same classes before is replaced.
        said: by the name of a class; '' is for all that have no entry of their own. An absence that never ends says
            nothing: things return as the map learns.
        class_names: classes of the recording that is to come, beside those of the map.
        worth: number of stays that each is worth.

    Raises:
        ConfigError: neither the map nor the recording has such a class.
    """
    names = tuple(dict.fromkeys((*living.class_names, *class_names)))
    known = dict(zip(living.lives.prior_class_id.tolist(), living.lives.prior, strict=True))
    for name, lifetimes in said.items():
        if name and name not in names:
            raise ConfigError(
                f"no landmark is of class '{name}'", field="prior", hint=suggestion(name, names) if names else None
            )
        absence = lifetimes.absence if lifetimes.absence.p_never_leaves < 1.0 else general_purpose()
        life = Life(stay=lifetimes.stay, absence=absence, n_stays=worth)
        known[names.index(name) if name else UNKNOWN] = life
    class_id = np.array(sorted(known), dtype=np.int64)
    lives = replace(living.lives, prior_class_id=class_id, prior=tuple(known[k] for k in class_id.tolist()))
    return replace(living, class_names=names, lives=lives)


def lifetimes_by_class(living: LivingMap) -> dict[str, Lifetimes]:
    """Return the learned or given lifetimes of a map, by class; '' for an unknown class."""
    lives, names = living.lives, dict(enumerate(living.class_names))
    kinds = np.union1d(lives.class_id, lives.prior_class_id).tolist()
    found = {}
    for kind in [*(k for k in kinds if k != UNKNOWN), UNKNOWN]:
        life = lives.of(kind)
        found[names.get(kind, "")] = Lifetimes(life.stay, life.absence)
    return found


def _of_chunks(
    history: History, row: int, life: Life, chunk_m: float, settings: LifetimeConfig, hours: HourFit | None
) -> list[tuple[tuple[int, int], Life]]:
    """Return lifetimes of chunks in which stays of a class end sooner or later than elsewhere, as far as supported.

    Rates of a chunk are those of the class times a factor with a gamma prior of mean 1 (Clayton and Kaldor 1987): with
    O ends where E were to be expected, `(f + O) / (f + E)`; the firmness f is weighed by what all chunks say.
    """
    from scipy.special import gammaln

    mine = np.flatnonzero(history.recent & (history.kind == row))
    chunks, which = np.unique(
        np.floor(history.stays.position_m[mine, :2] / chunk_m).astype(np.int64), axis=0, return_inverse=True
    )
    if len(chunks) < 2:
        return []
    stays = history.stays[mine]
    ended = np.isfinite(stays.gone_s)
    came_s = np.where(np.isfinite(stays.elsewhere_s), 0.5 * (stays.elsewhere_s + stays.first_s), stays.first_s)
    left_s = np.where(ended, 0.5 * (stays.last_s + stays.gone_s), stays.last_s)
    first_s, kind = stays.first_s, np.full(len(stays), row)
    if hours is not None:
        came_s, first_s, left_s = (hours.count_s(kind, stamp_s) for stamp_s in (came_s, first_s, left_s))
    expected = -life.stay.log_conditional_survival(first_s - came_s, left_s - came_s)
    n_ended = np.bincount(which.ravel(), ended * stays.p_gone)
    n_expected = np.bincount(which.ravel(), expected)
    if not 0.0 < n_expected.sum() < np.inf:  # what never leaves, or is not there any more, has no rates to compare
        return []
    n_expected *= max(n_ended.sum(), 1.0) / n_expected.sum()  # ends that nobody saw are missing everywhere
    firm = np.array(settings.firmness)[:, None]
    log_weight = np.sum(
        gammaln(firm + n_ended) - gammaln(firm) + firm * np.log(firm) - (firm + n_ended) * np.log(firm + n_expected),
        axis=1,
    )
    weight = np.exp(log_weight - log_weight.max())
    factor = (weight / weight.sum()) @ ((firm + n_ended) / (firm + n_expected))
    own: list[tuple[tuple[int, int], Life]] = []
    for k in np.flatnonzero(n_ended >= settings.least_ended):
        stay = scale_hazard(life.stay, (0.0,), (float(factor[k]),))
        n_stays = int(np.sum(which.ravel() == k))
        here = replace(life, stay=stay, n_stays=n_stays, n_ended=round(n_ended[k]))
        own.append(((int(chunks[k, 0]), int(chunks[k, 1])), here))
    return own


def _by_class(values: FloatArray, kind: IntArray, n_classes: int) -> FloatArray:
    """(C, ...) sums over the rows of each class."""
    member = (kind == np.arange(n_classes)[:, None]).astype(np.float64)
    return np.asarray(np.tensordot(member, values, axes=1))
