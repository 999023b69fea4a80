"""Stays in the rooms of a flat, known to the minute, and what is learned of them from a look now and then.

With a look every 15 minutes a stay is known by bounds only; stays between two looks are not seen; and who leaves and is
back at the next look has never left. Of the first any estimator of censored lifetimes knows; of the second one that is
told when a stay was first seen; of the third none can. And where stays are shorter than the time between looks, most
ages are never looked at: whatever an estimate says there, it is not the data that say so.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evermap.errors import InputError, NumericalError
from evermap.io.columns import read_columns
from evermap.survival import LifetimePrior
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.nonparametric import KaplanMeier, Npmle, kaplan_meier, npmle
from evermap.types import BoolArray, FloatArray
from evermap.valid import STAMP_S
from evermap_studies.lifetimes.sightings import settled_samples, weighted_sightings
from evermap_studies.lifetimes.truth import Value
from evermap_studies.presence.tasks import HOME

EVERY = (2, 5, 15)
"""Minutes between two looks."""
FEWEST = 30
"""Stays with a bounded beginning that an estimate wants."""


@dataclass(frozen=True, slots=True)
class RoomStays:
    """Stays in one room, as all minutes and as rarer looks tell them.

    Attributes:
        room: its name.
        every_s: time between two looks.
        full: Kaplan and Meier's estimate from all minutes.
        looks: Turnbull's from the looks, by name: `bounds` takes bounds for plain intervals, `entered` allows for stays
            that no look has seen; None where its likelihood has no maximum.
        n_full, n_seen: stays with a bounded beginning, of all minutes and of the looks.
    """

    room: str
    every_s: float
    full: KaplanMeier
    looks: dict[str, Npmle | None]
    n_full: int
    n_seen: int

    def distance(self, estimate: Npmle, beyond_s: float = 0.0) -> float:
        """Largest vertical distance of Kaplan and Meier's curve from the estimate, or where it is not determined from
        its bounds; of both given that a stay is longer than `beyond_s`, if that is positive.
        """
        steps = np.concatenate([self.full.time_s, np.nextafter(self.full.time_s, 0.0), [beyond_s]])
        t = np.unique(steps[steps >= beyond_s])
        curve = self.full.survival(t) / self.full.survival(beyond_s)
        lower, upper = estimate.survival(t)
        if beyond_s > 0.0:
            lower = upper = np.exp(estimate.prior().log_conditional_survival(np.full(t.shape, beyond_s), t))
        return float(np.maximum(np.maximum(lower - curve, curve - upper), 0.0).max())


def study_rooms(folder: Path) -> list[RoomStays]:
    """All rooms in which enough stays are seen, with looks as rare as `EVERY` says.

    Raises:
        InputError: the recording is missing or malformed.
    """
    path = folder / HOME
    if not path.is_file():
        raise InputError("no such file", path=path, hint=f"--data FOLDER with {HOME}")
    table = read_columns(path, [])
    table.expect(("stamp_s", "room"))
    stamp_s, (names, room) = table.numbers(STAMP_S), table.labels("room")
    if len(stamp_s) < 2 or (np.diff(stamp_s) <= 0.0).any():
        raise InputError("needs rows in order of time", path=path, field="stamp_s")
    found = []
    for index, name in enumerate(names):
        full = _stays(stamp_s, room == index)
        known = full[:, np.isfinite(full[0])]
        ended = np.isfinite(known[3])
        stay_s = np.where(ended, known[3] - known[1], known[2] - known[1])
        for every in EVERY:
            seen = _begun(_stays(stamp_s[::every], (room == index)[::every]))
            if seen.shape[1] < FEWEST:
                continue
            found.append(
                RoomStays(
                    room=name.replace("_", " ").lower(),
                    every_s=every * float(np.median(np.diff(stamp_s))),
                    full=kaplan_meier(CensoredLifetimes.of(stay_s, np.where(ended, stay_s, np.inf))),
                    looks={
                        "bounds": npmle(CensoredLifetimes.of(seen[2] - seen[1], seen[3] - seen[0])),
                        "entered": _allowing_for_the_unseen(seen),
                    },
                    n_full=known.shape[1],
                    n_seen=seen.shape[1],
                )
            )
    return found


def as_values(rooms: list[RoomStays]) -> list[Value]:
    """One row for each room and time between looks."""
    return [
        {
            "room": one.room,
            "every_s": one.every_s,
            "stays": one.n_full,
            "stays_seen": one.n_seen,
            "distance": {name: _maybe(one, estimate, 0.0) for name, estimate in one.looks.items()},
            "distance_beyond": {name: _maybe(one, estimate, one.every_s) for name, estimate in one.looks.items()},
        }
        for one in rooms
    ]


def _maybe(one: RoomStays, estimate: Npmle | None, beyond_s: float) -> float | None:
    return None if estimate is None else one.distance(estimate, beyond_s)


def _stays(stamp_s: FloatArray, here: BoolArray) -> FloatArray:
    """(4, K) look before, first and last sighting, look after of each stay; infinite where there is none."""
    change = np.diff(np.concatenate([[0], here.astype(np.int64), [0]]))
    begin, end = np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1
    around = np.concatenate([[-np.inf], stamp_s, [np.inf]])
    return np.array([around[begin], stamp_s[begin], stamp_s[end], around[end + 2]])


def _begun(stays: FloatArray) -> FloatArray:
    """Those whose beginning is bounded."""
    return np.asarray(stays[:, np.isfinite(stays[0])])


def _allowing_for_the_unseen(stays: FloatArray) -> Npmle | None:
    """Turnbull's estimate of samples that know when each stay was first seen."""

    def samples(given: LifetimePrior | None) -> CensoredLifetimes:
        return weighted_sightings(stays, given)

    try:
        return npmle(settled_samples(lambda known: npmle(known).prior(), samples, rounds=3))
    except NumericalError:
        return None
