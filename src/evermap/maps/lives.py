"""How long things stay, how long they stay away, and where they turn up again: by class and place."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from evermap.survival.base import LifetimePrior
from evermap.survival.general_purpose import GeneralPurpose
from evermap.types import UNKNOWN, FloatArray, IntArray

DAY_S = 86_400.0


def general_purpose() -> LifetimePrior:
    """Of a class of which nothing is known: anything from an hour to ten years (Rosen 2016, eq. 26)."""
    return GeneralPurpose(1.0 / (3650.0 * DAY_S), 1.0 / 3600.0)


@dataclass(frozen=True, slots=True)
class Life:
    """Of one kind of thing.

    Attributes:
        stay: prior of the time at one site.
        absence: prior of the time away; its `p_never_leaves` is the share that never returns.
        p_hop: probability that who leaves a site stands at another one at once, instead of being away.
        p_known: probability that who turns up again does so at a site that the map knows.
        n_stays, n_ended: stays that this was learned from, and how many of them were seen to end.
    """

    stay: LifetimePrior = field(default_factory=general_purpose)
    absence: LifetimePrior = field(default_factory=general_purpose)
    p_hop: float = 0.5
    p_known: float = 0.5
    n_stays: int = 0
    n_ended: int = 0


@dataclass(frozen=True, slots=True)
class Lives:
    """`Life` by class and chunk of the floor; where nothing was learned, of the class, then of everything.

    Attributes:
        class_id: (E,) class of every entry, `UNKNOWN` for all classes together.
        chunk: (E, 2) column and row of the chunk it holds for; `EVERYWHERE` in both for the whole floor.
        life: (E,) what was learned.
        chunk_m: side of a chunk.
        looks_s: (M,) ends of the sessions that were learned from: between two of them things come back unseen.
    """

    class_id: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    chunk: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    life: tuple[Life, ...] = ()
    chunk_m: float = 10.0
    looks_s: FloatArray = field(default_factory=lambda: np.zeros(0))

    def of(self, class_id: int, position_m: FloatArray) -> Life:
        """What is known of a class (or `UNKNOWN`) at a position (2,)."""
        here = np.floor(np.asarray(position_m) / self.chunk_m).astype(np.int64)
        for kind, chunk in ((class_id, here), (class_id, _ANYWHERE), (UNKNOWN, _ANYWHERE)):
            found = np.flatnonzero((self.class_id == kind) & np.all(self.chunk == chunk, axis=1))
            if len(found):
                return self.life[int(found[0])]
        return Life()


EVERYWHERE = np.iinfo(np.int64).min
"""Chunk number of an entry that holds for the whole floor."""
_ANYWHERE = np.array([EVERYWHERE, EVERYWHERE])
