"""Records of the tracker: events, objects over time, and static spells.

A static spell is a time in which an object stayed in one place, with bounds of its end. The object was seen in a
place from `first_s` to `last_s`. It came after `elsewhere_s`, when it was elsewhere or its place was empty, and was
found moved or gone at `gone_s`. What that says of lifetimes is in `survival.censored`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from evermap.errors import DataError
from evermap.tracking.tracklets import EventKind, SpellTable, Tracklets, TrackState
from evermap.tracking.working_set import Stored, WorkingSet
from evermap.types import BoolArray, FloatArray, IntArray, Tabular

BOX_COLUMNS = ("length_m", "width_m", "height_m", "yaw_rad")


class InSpace(Tabular):
    """Mixin of tables of objects: positions and velocities are three columns each, states are words."""

    __slots__ = ()
    track_id: IntArray

    def __len__(self) -> int:
        return len(self.track_id)

    def _columns(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name in self.__dataclass_fields__:
            values: Any = getattr(self, name)
            if not isinstance(values, np.ndarray) or values.ndim > 2:
                continue  # covariances are for programs
            if name == "state":
                words = np.array([state.name.lower() for state in TrackState])
                found[name] = words[values]
            elif name == "class_p":
                found["class_id"] = values.argmax(axis=1)
            elif name.startswith("box"):
                if name == "box" and values.shape[1]:
                    found |= {column: values[:, k] for k, column in enumerate(BOX_COLUMNS)}
            elif values.ndim == 2:
                prefix, unit = {"position_m": ("", "m"), "velocity_mps": ("v", "mps")}[name]
                found |= {f"{prefix}{axis}_{unit}": values[:, k] for k, axis in enumerate("xyz")}
            else:
                found[name] = values
        return found

    def _facts(self) -> dict[str, Any]:
        return {"rows": len(self), "objects": len(np.unique(self.track_id))}


@dataclass(frozen=True, slots=True)
class Event:
    """An event of a tracklet with its stamp."""

    stamp_s: float
    kind: EventKind
    track_id: int


@dataclass(frozen=True, slots=True, repr=False)
class _Objects(InSpace):
    """Objects, one row each: what `Followed` and `Tracks` have in common."""

    stamp_s: Any
    track_id: IntArray
    state: IntArray
    position_m: FloatArray
    velocity_mps: FloatArray
    position_covariance_m2: FloatArray
    velocity_covariance_m2ps2: FloatArray
    class_p: FloatArray
    p_exists: FloatArray
    box: FloatArray
    box_variance: FloatArray
    static: BoolArray


@dataclass(frozen=True, slots=True, repr=False)
class Followed(_Objects):
    """The active tracklets at one instant, one row each, in no order. Copies.

    Attributes:
        stamp_s: when.
        track_id: (N,).
        state: (N,) a `TrackState`.
        position_m, velocity_mps: (N, 3) in the world.
        position_covariance_m2, velocity_covariance_m2ps2: (N, 3, 3).
        class_p: (N, C) posterior over classes.
        p_exists: (N,) probability of being a real object that is there.
        box: (N, 4) length, width, height and heading; (N, 0) of points. box_variance: the same shape.
        static: (N,) whether it has been where it is for long enough to be static.
        n_missed: (N,) frames in a row without a detection.
    """

    n_missed: IntArray


@dataclass(frozen=True, slots=True, repr=False)
class Tracks(_Objects):
    """Objects over time, one row an object and frame, sorted by track and time; columns as of `Followed`, filtered.

    Attributes:
        stamp_s: (R,) frames.
    """


class Recorder:
    """Collects what a tracker says, frame after frame."""

    def __init__(self) -> None:
        self._frames: list[Followed] = []
        self.events: list[Event] = []

    def add(self, followed: Followed, events: list[Event]) -> None:
        """Add the tracks after a frame, and the events of that frame."""
        self._frames.append(followed)
        self.events.extend(events)

    def tracks(self) -> Tracks:
        """Return everything about tracklets that were confirmed sooner or later, their first frames too.

        Rows after the last detection before a tracklet was given up are left out: they were guesses. DataError if no
        frame was recorded.
        """
        frame, columns = self._rows()
        ids = columns["track_id"]
        confirmed = np.isin(ids, np.unique(ids[columns["state"] != TrackState.BIRTH]))
        order = np.lexsort((frame, ids))
        order = order[confirmed[order]]
        keep = order[~_find_given_up(ids[order], frame[order], columns["n_missed"][order], len(self._frames))]
        return self._of(keep, frame, columns)

    def at_once(self, least_p: float) -> Tracks:
        """Return the output frame by frame: tracklets with a belief of at least `least_p`; DataError without frames."""
        frame, columns = self._rows()
        order = np.lexsort((frame, columns["track_id"]))
        return self._of(order[columns["p_exists"][order] >= least_p], frame, columns)

    def _rows(self) -> tuple[IntArray, dict[str, Any]]:
        """(R,) frame of each row, and all columns; DataError if no frame was recorded."""
        frames = self._frames
        if not frames:
            raise DataError("no frame was tracked")
        frame = np.repeat(np.arange(len(frames)), [len(f) for f in frames])
        return frame, {n.name: np.concatenate([getattr(f, n.name) for f in frames]) for n in fields(Followed)[1:]}

    def _of(self, keep: IntArray, frame: IntArray, columns: dict[str, Any]) -> Tracks:
        stamps = np.array([f.stamp_s for f in self._frames])
        return Tracks(stamp_s=stamps[frame[keep]], **{n: c[keep] for n, c in columns.items() if n != "n_missed"})


def _find_given_up(ids: IntArray, frame: IntArray, n_missed: IntArray, n_frames: int) -> BoolArray:
    """(R,) rows without a detection at the end of a stretch of frames, unless the recording ends there too."""
    guess = np.zeros(len(ids), dtype=np.bool_)
    if not len(ids):
        return guess
    last = np.ones(len(ids), dtype=np.bool_)
    last[:-1] = (ids[1:] != ids[:-1]) | (frame[1:] != frame[:-1] + 1)
    for row in np.flatnonzero(last & (frame < n_frames - 1)):
        guess[row - n_missed[row] + 1 : row + 1] = True
    return guess


@dataclass(frozen=True, slots=True, repr=False)
class StaticSpells(InSpace):
    """Times at which objects stayed in place, one row per spell, sorted by track and time.

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

    def covers(self, track_id: int, first_s: float, last_s: float) -> BoolArray:
        """Return (K,) which spells are of an object and overlap a time."""
        return np.asarray((self.track_id == track_id) & (self.first_s <= last_s) & (self.last_s >= first_s))


class SpellLog:
    """Static spells that have ended, in the order in which they did."""

    def __init__(self) -> None:
        self._parts: list[StaticSpells] = []

    def add(self, table: SpellTable, n: int) -> None:
        """Note the first `n` rows of a kernel's table."""
        if n:
            times = table.times[:n].copy()
            self._parts.append(
                StaticSpells(table.track_id[:n].copy(), table.class_id[:n].copy(), table.position[:n].copy(), *times.T)
            )

    def add_stored(self, stored: Stored, rows: IntArray, gone_s: float) -> None:
        """Note rows of the working set whose objects are gone."""
        if len(rows):
            self._parts.append(_spells(stored, rows, stored.class_id, stored.position, gone_s))

    def confirm(self, stays: StaticSpells, since_s: float, least_s: float) -> BoolArray:
        """Return (K,) which stays overlap a spell that ended from `since_s` on, which begins with them; others that are
        shorter than `least_s` are forgotten.
        """
        ended, known = self._join_ended(), np.zeros(len(stays), dtype=np.bool_)
        kept = (ended.last_s < since_s) | (ended.last_s - ended.first_s >= least_s)
        for k in np.flatnonzero(ended.last_s >= since_s).tolist():
            mine = stays.covers(ended.track_id[k], ended.first_s[k], ended.last_s[k])
            known |= mine
            kept[k] |= mine.any()
            first = stays.first_s[mine].min(initial=ended.first_s[k])
            if first > ended.elsewhere_s[k]:
                ended.first_s[k] = first
        self._parts = [ended[kept]]
        return known

    def add_ended(self, spells: StaticSpells) -> None:
        """Note spells."""
        self._parts.append(spells)

    def columns(self) -> dict[str, Any]:
        """Return what `restore` takes."""
        ended = self._join_ended()
        return {item.name: getattr(ended, item.name) for item in fields(StaticSpells)}

    def restore(self, columns: Mapping[str, Any]) -> None:
        """Take over the spells that `columns` gave."""
        self._parts = [StaticSpells(**{item.name: columns[item.name] for item in fields(StaticSpells)})]

    def _join_ended(self) -> StaticSpells:
        whole, real = np.zeros(0, dtype=np.int64), np.zeros(0)
        return StaticSpells(whole, whole, np.zeros((0, 3)), real, real, real, real).joined(*self._parts)

    def with_open(self, t: Tracklets, n: int, working_set: WorkingSet) -> StaticSpells:
        """Return ended tracklets, and those that go on: of the first `n` tracklets, and of the working set."""
        rows = np.flatnonzero((t.static[:n] == 1) & (t.state[:n] != TrackState.BIRTH))
        going_on = _spells(t, rows, t.class_p[:n].argmax(axis=1), t.rest_mean, np.inf)
        w = working_set.stored
        stored = working_set.rows[w.static[working_set.rows] == 1]
        every = going_on.joined(_spells(w, stored, w.class_id, w.position, np.inf), *self._parts)
        return every[np.lexsort((every.first_s, every.track_id))]


def _spells(
    of: Tracklets | Stored, rows: IntArray, class_id: Any, position_m: FloatArray, gone_s: float
) -> StaticSpells:
    """The spells of some rows."""
    names = of.track_id[rows], class_id[rows].astype(np.int64), position_m[rows]
    times = of.elsewhere_s[rows], of.rest_since_s[rows], of.rest_seen_s[rows], np.full(len(rows), gone_s)
    return StaticSpells(*names, *times)
