"""Lifetimes of stays and absences, and sites of returns, by class and place; and the hours of the week."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from evermap.existence.hours import describe_hours
from evermap.existence.rhythm import Rhythm
from evermap.survival.base import LifetimePrior
from evermap.survival.families import GeneralPurpose
from evermap.types import UNKNOWN, BoolArray, Clock, FloatArray, IntArray

DAY_S = 86_400.0


def general_purpose() -> LifetimePrior:
    """Return the lifetime of an unknown class: anything from an hour to ten years (Rosen 2016, eq. 26)."""
    return GeneralPurpose(1.0 / (3650.0 * DAY_S), 1.0 / 3600.0)


@dataclass(frozen=True, slots=True)
class Life:
    """Lifetimes of one class in one place.

    Attributes:
        stay: prior of the time at one site.
        absence: prior of the time away; its `p_never_leaves` is the share that never returns.
        p_hop: probability that a clique that leaves a site stands at another one at once, instead of being away.
        p_known: probability that who turns up again does so at a site that the map knows.
        n_stays, n_ended: stays that this was learned from, and how many of them were seen to end.
    """

    stay: LifetimePrior = field(default_factory=general_purpose)
    absence: LifetimePrior = field(default_factory=general_purpose)
    p_hop: float = 0.5
    p_known: float = 0.5
    n_stays: int = 0
    n_ended: int = 0

    @property
    def tells_absence(self) -> bool:
        """Whether absences are known beyond the default prior."""
        return self.absence != general_purpose()

    def as_said(self, said: Life) -> Life:
        """Return the same with a user's prior of the stay, and of the absence if it has one."""
        absence = said.absence if said.tells_absence else self.absence
        return replace(self, stay=said.stay, absence=absence, n_stays=0, n_ended=0)


@dataclass(frozen=True, slots=True)
class Lives:
    """`Life` by class and chunk of the floor, with the class and then the average as fallback.

    Attributes:
        class_id: (E,) class of every entry, `UNKNOWN` for all classes together.
        chunk: (E, 2) column and row of the chunk it holds for; `EVERYWHERE` in both for the whole floor.
        life: (E,) what was learned.
        chunk_m: side of a chunk.
        looks_s: (M,) ends of the sessions that were learned from: between two of them things come back unseen.
        prior_class_id: (R,) classes of which a user said how long they stay; `UNKNOWN` for all that have no own entry.
        prior: (R,) what he said; `n_stays` is the number of stays that it is worth. `with_priors` of
            `maps.learning` makes them.
        log_factor: (1008,) common factor on hazards of stays (`Rhythm`), by whose clock the ages of `hourly_class_id`
            are counted; (0,) where ages are those on the wall.
        hourly_class_id: (H,) classes that follow it; `UNKNOWN` for all that were never seen.
        hours_known: ends of a known hour of the day that the looks are worth, and log evidence for a common factor
            against none [nats]; (0,) where nobody could ask.
    """

    class_id: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    chunk: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    life: tuple[Life, ...] = ()
    chunk_m: float = 10.0
    looks_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    prior_class_id: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    prior: tuple[Life, ...] = ()
    log_factor: FloatArray = field(default_factory=lambda: np.zeros(0))
    hourly_class_id: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    hours_known: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def rhythm(self) -> Rhythm | None:
        """Return the common factor; None where there is none."""
        return Rhythm(self.log_factor) if len(self.log_factor) else None

    def follows(self, class_id: IntArray) -> BoolArray:
        """Return (N,) whether ages of the stays of classes (N,) are counted by the clock of the common factor."""
        known = np.isin(class_id, self.class_id) | np.isin(class_id, self.prior_class_id)
        unseen = ~known & (UNKNOWN in self.hourly_class_id)
        return np.asarray(np.isin(class_id, self.hourly_class_id) | unseen)

    def ages_s(self, class_id: IntArray, since_s: FloatArray, until_s: FloatArray) -> FloatArray:
        """Return the ages (N,) of stays of classes (N,), or of one class (1,), by the clock that counts them."""
        age, rhythm = until_s - since_s, self.rhythm
        if rhythm is None:
            return age
        return np.where(self.follows(class_id), rhythm.count_s(until_s) - rhythm.count_s(since_s), age)

    def describe_hours(self, clock: Clock, class_id: int | None = None) -> list[str]:
        """Return a line on the hours of the week at which stays of a class end, or of all; none where nobody could
        ask.
        """
        if not len(self.hours_known):
            return []
        n_dated, nats = self.hours_known.tolist()
        follows = class_id is None or bool(self.follows(np.array([class_id]))[0])
        return describe_hours(n_dated, nats, self.rhythm, clock, follows=follows)

    def of(self, class_id: int, position_m: FloatArray | None = None) -> Life:
        """Return the life of a class (or `UNKNOWN`), at a position (2,), in space (3,), or on the whole floor: learned,
        else given, else learned over all classes.
        """
        if position_m is not None:
            here = np.floor(np.asarray(position_m)[:2] / self.chunk_m).astype(np.int64)
            if (learned := self._learned(class_id, here)) is not None:
                return learned
        if (learned := self._learned(class_id, _ANYWHERE)) is not None:
            return learned
        of_all, said = self._learned(UNKNOWN, _ANYWHERE) or Life(), self.prior_of(class_id)
        return of_all if said is None else of_all.as_said(said)

    def said(self, class_id: int) -> Life:
        """Return what a user said of a class, else that anything is possible: what holds where nothing is learned."""
        prior = self.prior_of(class_id)
        return Life() if prior is None else Life().as_said(prior)

    def prior_of(self, class_id: int) -> Life | None:
        """Return what a user said of a class, or of all that he said nothing of; None for nothing."""
        for kind in (class_id, UNKNOWN):
            found = np.flatnonzero(self.prior_class_id == kind)
            if len(found):
                return self.prior[int(found[0])]
        return None

    def _learned(self, class_id: int, chunk: IntArray) -> Life | None:
        found = np.flatnonzero((self.class_id == class_id) & np.all(self.chunk == chunk, axis=1))
        return self.life[int(found[0])] if len(found) else None


EVERYWHERE = np.iinfo(np.int64).min
"""Chunk number of an entry that holds for the whole floor."""
_ANYWHERE = np.array([EVERYWHERE, EVERYWHERE])
