"""A sorted table of many rows, cut into shelves that are read and kept by themselves."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields, replace
from typing import Any, Generic, Self, TypeVar

import numpy as np

from evermap.geometry.chunked import Part
from evermap.maps.lives import Lives
from evermap.sensing.sightlines import SightLines, Views
from evermap.types import IntArray

Table = TypeVar("Table", bound=Any)

ROWS = 2048
"""Of a shelf, about."""
_COLUMNS = {
    Lives: ("class_id", "chunk", "life"),
    SightLines: ("site_id", "landmark_id", "cell", "hits", "looks"),
    Views: ("cell", "heading", "stamp_s", "frames"),
}
"""Fields with a row for each of the table's, of tables that have others."""


@dataclass(frozen=True, eq=False)
class Shelves(Generic[Table]):
    """A table sorted by its first column that is read in parts on demand.

    Attributes:
        like: the table without rows.
        first: (B,) key of the first row of each shelf: its first column, or the first of several in it.
        count: (B,) rows of each.
        parts: the values of each shelf, column after column, as their bits.
    """

    like: Table
    first: IntArray
    count: IntArray
    parts: tuple[Part, ...]

    @classmethod
    def of(cls, table: Table) -> Self:
        """Put a table on shelves."""
        return cls._of(table, _shelve(table))

    def __len__(self) -> int:
        return int(self.count.sum())

    @property
    def last(self) -> int:
        """Return the largest key; -1 if there is none."""
        return int(key_of(self._read(np.array([len(self.parts) - 1])))[-1]) if self.parts else -1

    def table(self) -> Table:
        """Return all of it."""
        return self._read(np.arange(len(self.parts)))

    def near(self, keys: IntArray) -> Table:
        """Return the rows of the shelves that may have some keys (sorted)."""
        return self._read(self._with(keys))

    def replaced(self, keys: IntArray, new: Table) -> Self:
        """Return the shelves without the rows of some keys (sorted), and with those of another table, which keeps its
        other fields.
        """
        if not self.parts:
            return type(self).of(new)
        own, shelves = key_of(new), list(zip(self.first.tolist(), self.count.tolist(), self.parts, strict=True))
        touched = self._with(np.union1d(keys, own))
        made: list[tuple[int, int, Part]] = []
        at, begin = 0, 0
        for run in np.split(touched, np.flatnonzero(np.diff(touched) != 1) + 1) if len(touched) else ():
            made += shelves[at : run[0]]
            at = int(run[-1]) + 1
            end = int(np.searchsorted(own, self.first[at])) if at < len(shelves) else len(own)
            made += _shelve(splice(self._read(run), keys, rows(new, np.arange(begin, end))))
            begin = end
        return type(self)._of(new, made + shelves[at:])

    @classmethod
    def _of(cls, table: Table, shelves: list[tuple[int, int, Part]]) -> Self:
        first, count, parts = zip(*shelves, strict=True) if shelves else ((), (), ())
        like = rows(table, np.zeros(0, dtype=np.int64))
        return cls(like, np.array(first, dtype=np.int64), np.array(count, dtype=np.int64), parts)

    def _with(self, keys: IntArray) -> IntArray:
        """Shelves that may have some keys, or between which these would be."""
        if not len(self.parts):
            return np.zeros(0, dtype=np.int64)
        low = np.searchsorted(self.first, keys, side="left") - 1
        high = np.searchsorted(self.first, keys, side="right") - 1
        some = np.zeros(len(self.parts) + 1, dtype=np.int64)
        np.add.at(some, np.maximum(low, 0), 1)
        np.add.at(some, np.maximum(high, 0) + 1, -1)
        return np.flatnonzero(np.cumsum(some[:-1]))

    def _read(self, shelves: IntArray) -> Table:
        """The rows of some shelves."""
        found: dict[str, list[Any]] = {name: [] for name in columns(self.like)}
        for k in shelves.tolist():
            values, at = self.parts[k].values.view(np.int64), 0
            for name, listed in found.items():
                like = getattr(self.like, name)
                size = int(self.count[k]) * (like.shape[1] if like.ndim == 2 else 1)
                listed.append(values[at : at + size].view(like.dtype).reshape(-1, *like.shape[1:]))
                at += size
        told = {name: np.concatenate([getattr(self.like, name), *listed]) for name, listed in found.items()}
        return replace(self.like, **told)


@dataclass(frozen=True, slots=True)
class Sight:
    """Lines of sight and views of a large map.

    Attributes:
        lines: by site.
        views: by column of the floor.
    """

    lines: Shelves[SightLines]
    views: Shelves[Views]

    @classmethod
    def of(cls, lines: SightLines, views: Views) -> Self:
        """Put both on shelves."""
        return cls(Shelves.of(lines), Shelves.of(views))

    def flaw(self) -> str:
        """Return a description of an inconsistency; '' if it is consistent."""
        for shelves in (self.lines, self.views):
            n = len(shelves.parts)
            if not len(shelves.first) == len(shelves.count) == n or (np.diff(shelves.first) < 0).any():
                return "shelves of lines of sight or of views that do not fit together"
        return ""


def columns(table: Any) -> tuple[str, ...]:
    """Return the fields of a table with a row for each of its rows."""
    return _COLUMNS.get(type(table)) or tuple(item.name for item in fields(table))


def key_of(table: Any) -> IntArray:
    """Return (N,) what a table is sorted by."""
    first = getattr(table, columns(table)[0])
    return np.asarray(first if first.ndim == 1 else first[:, 0])


def rows(table: Table, some: Any) -> Table:
    """Return some rows of a table, by number or by a mask."""
    return replace(table, **{name: getattr(table, name)[some] for name in columns(table)})


def splice(table: Table, gone: IntArray, new: Table) -> Table:
    """Return a sorted table without the rows of some keys and with those of another one, which keeps its other
    fields. Of one key there are rows of one of them only.
    """
    kept = np.flatnonzero(~np.isin(key_of(table), gone))
    at = np.searchsorted(key_of(table)[kept], key_of(new))
    told = {name: np.insert(getattr(table, name)[kept], at, getattr(new, name), axis=0) for name in columns(table)}
    return replace(new, **told)


def _shelve(table: Any) -> list[tuple[int, int, Part]]:
    """First key, number of rows, and values of each shelf of a table."""
    key = key_of(table)
    total, shelves = len(key), max(round(len(key) / ROWS), 1)
    bounds = np.arange(shelves + 1) * total // shelves
    made = []
    for begin, end in itertools.pairwise(bounds.tolist() if total else ()):
        raw = [np.ascontiguousarray(getattr(table, name)[begin:end]).ravel() for name in columns(table)]
        part = Part(np.concatenate([values.view(np.int64) for values in raw]).view(np.float64))
        made.append((int(key[begin]), end - begin, part))
    return made
