"""Static spells: times at which objects stayed where they were, and what is known of their ends.

An object was seen in a place from `first_s` to `last_s`. It came after `elsewhere_s`, when it was elsewhere or its
place was empty, and was found moved or gone at `gone_s`. What that says of lifetimes is in `survival.censored`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from evermap.tracking.frame import SpellTable
from evermap.tracking.tracklets import Tracklets, TrackState
from evermap.tracking.working_set import Stored, WorkingSet
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class StaticSpells:
    """Times at which objects stayed where they were, one row a spell, sorted by track and time.

    Attributes:
        track_id: (K,) whose.
        class_id: (K,) most probable class.
        position_m: (K, 3) where.
        elsewhere_s: (K,) last stamp before at which it was known not to be there; -inf where unknown.
        first_s, last_s: (K,) first and last detection beyond doubt there.
        gone_s: (K,) first stamp after at which it was known not to be there; inf where it never was.
    """

    track_id: IntArray
    class_id: IntArray
    position_m: FloatArray
    elsewhere_s: FloatArray
    first_s: FloatArray
    last_s: FloatArray
    gone_s: FloatArray

    def __len__(self) -> int:
        return len(self.track_id)

    def __getitem__(self, rows: IntArray | BoolArray) -> Self:
        """Some of them, by number or by a mask."""
        return type(self)(*(getattr(self, name)[rows] for name in self.__slots__))


class SpellLog:
    """Static spells that have ended, in the order in which they did."""

    def __init__(self) -> None:
        self._parts: list[StaticSpells] = []

    def add(self, table: SpellTable, n: int) -> None:
        """The first `n` rows of a kernel's table."""
        if n:
            times = table.times[:n].copy()
            self._parts.append(
                StaticSpells(table.track_id[:n].copy(), table.class_id[:n].copy(), table.position[:n].copy(), *times.T)
            )

    def add_stored(self, stored: Stored, rows: IntArray, gone_s: float) -> None:
        """Rows of the working set, whose objects are gone."""
        if len(rows):
            self._parts.append(_of_stored(stored, rows, gone_s))

    def with_open(self, t: Tracklets, n: int, working_set: WorkingSet) -> StaticSpells:
        """These, and those that go on: of the first `n` tracklets, and of the working set."""
        rows = np.flatnonzero((t.static[:n] == 1) & (t.state[:n] != TrackState.BIRTH))
        going_on = StaticSpells(
            track_id=t.track_id[rows],
            class_id=t.class_p[rows].argmax(axis=1),
            position_m=t.rest_mean[rows],
            elsewhere_s=t.elsewhere_s[rows],
            first_s=t.rest_since_s[rows],
            last_s=t.rest_seen_s[rows],
            gone_s=np.full(len(rows), np.inf),
        )
        stored = working_set.rows[working_set.stored.static[working_set.rows] == 1]
        parts = [*self._parts, going_on, _of_stored(working_set.stored, stored, np.inf)]
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in StaticSpells.__slots__}
        order = np.lexsort((columns["first_s"], columns["track_id"]))
        return StaticSpells(**columns)[order]


def _of_stored(stored: Stored, rows: IntArray, gone_s: float) -> StaticSpells:
    return StaticSpells(
        track_id=stored.track_id[rows],
        class_id=stored.class_id[rows].astype(np.int64),
        position_m=stored.position[rows],
        elsewhere_s=stored.elsewhere_s[rows],
        first_s=stored.rest_since_s[rows],
        last_s=stored.rest_seen_s[rows],
        gone_s=np.full(len(rows), gone_s),
    )
