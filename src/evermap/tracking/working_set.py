"""The working set: static objects out of view, by the million, to be found again by place, class and appearance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evermap.existence.lifetimes import log_death_odds
from evermap.survival import LifetimePrior
from evermap.tracking.tracklets import Tracklets
from evermap.types import FloatArray, IntArray

SMALLEST_ROOM = 64
UPPER = (np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2]))
"""Entries of a symmetric (3, 3) that are kept."""


class Stored(NamedTuple):
    """Stored objects, one row each: 125 bytes, and two per number of the appearance.

    Attributes:
        track_id: (N,).
        position: (N, 3) place of rest; covariance: (N, 6) its covariance, upper triangle.
        class_id: (N,) the most probable class, and class_p: (N,) its probability; the others share the rest.
        appearance: (N, A) unit vectors.
        box: (N, 9) size and heading; level: (N, 3) belief by scores; as in `Tracklets`.
        inverse_odds: (N,) of being there still, at `judged_s`.
        n_hits: (N,) detections.
        first_s, rest_seen_s, rest_since_s, elsewhere_s, static: (N,) as in `Tracklets`.
        judged_s: (N,) when its place was last looked at.
        following: (N,) the next row of its chunk.
    """

    track_id: IntArray
    position: FloatArray
    covariance: NDArray[np.float32]
    class_id: NDArray[np.int16]
    class_p: NDArray[np.float32]
    appearance: NDArray[np.float16]
    box: NDArray[np.float32]
    level: NDArray[np.float32]
    inverse_odds: FloatArray
    n_hits: NDArray[np.int32]
    first_s: FloatArray
    rest_seen_s: FloatArray
    rest_since_s: FloatArray
    elsewhere_s: FloatArray
    static: NDArray[np.int8]
    judged_s: FloatArray
    following: NDArray[np.int32]


def empty_rows(n: int, n_appearance: int, n_box: int = 0, n_level: int = 0) -> Stored:
    """Return room for `n` objects with appearances of a length, and with boxes and scores or without."""
    sizes: dict[str, tuple[Any, ...]] = {
        "track_id": (np.int64,), "position": (np.float64, 3), "covariance": (np.float32, 6), "class_id": (np.int16,),
        "class_p": (np.float32,), "appearance": (np.float16, n_appearance), "box": (np.float32, n_box),
        "level": (np.float32, n_level), "n_hits": (np.int32,), "static": (np.int8,),
        "following": (np.int32,),
    }  # fmt: skip
    columns = {name: sizes.get(name, (np.float64,)) for name in Stored._fields}
    rows = Stored(**{name: np.zeros((n, *shape), dtype) for name, (dtype, *shape) in columns.items()})
    rows.following[:] = -1
    return rows


KEPT = (
    "track_id", "appearance", "box", "level", "n_hits", "first_s", "rest_seen_s", "rest_since_s", "elsewhere_s",
    "static",
)  # fmt: skip
"""Columns that an object keeps as it goes into the working set and comes back."""


class WorkingSet:
    """Objects at rest, in square chunks of the ground; rows are given out, and used again when they are free.

    Args:
        chunk_m: side of a chunk.
        priors: lifetimes at rest, one for all classes or one a class.
        n_classes: number of classes.
        n_appearance: length of appearance vectors.

    Attributes:
        stored: all rows, including free ones; read only.
        widest_m2: no place has been known less well than this: largest variance of a coordinate.
    """

    def __init__(
        self,
        chunk_m: float,
        priors: tuple[LifetimePrior, ...],
        n_classes: int,
        n_appearance: int,
        *,
        n_box: int = 0,
        n_level: int = 0,
    ) -> None:
        from evermap.tracking import grid as chunks

        self._chunks = chunks
        self._chunk_m = chunk_m
        self._priors = priors
        self._n_classes = n_classes
        self.stored = empty_rows(SMALLEST_ROOM, n_appearance, n_box, n_level)
        self._head = np.full(SMALLEST_ROOM, chunks.END, dtype=np.int32)
        self._free: list[int] = []
        self._n_used = 0
        self.widest_m2 = 0.0

    def __len__(self) -> int:
        return self._n_used - len(self._free)

    @property
    def rows(self) -> IntArray:
        """(len(self),) rows in use."""
        used = np.ones(self._n_used, dtype=np.bool_)
        used[self._free] = False
        return np.flatnonzero(used)

    def insert(self, t: Tracklets, rows: IntArray, stamp_s: float) -> None:
        """Keep the places of rest of some tracklets."""
        top = t.class_p[rows].argmax(axis=1)
        self.insert_arrays(
            empty_rows(0, 0)._replace(
                **{name: getattr(t, name)[rows] for name in KEPT},
                position=t.rest_mean[rows],
                covariance=t.rest_covariance[rows][:, UPPER[0], UPPER[1]].astype(np.float32),
                class_id=top,
                class_p=t.class_p[rows, top],
                inverse_odds=t.inverse_odds[rows],
                judged_s=np.full(len(rows), stamp_s),
            )
        )

    def insert_arrays(self, objects: Stored) -> IntArray:
        """Keep objects given as arrays (`following` is not read), and return the rows they have."""
        count = len(objects.track_id)
        n_again = min(count, len(self._free))
        n_new = count - n_again
        if self._n_used + n_new > len(self._head):
            self._grow(self._n_used + n_new)
        again = [self._free.pop() for _ in range(n_again)]
        rows = np.concatenate([np.array(again, dtype=np.int64), self._n_used + np.arange(n_new)])
        self._n_used += n_new
        for name in Stored._fields[:-1]:
            getattr(self.stored, name)[rows] = getattr(objects, name)
        self._chunks.link(rows, self.stored.position, self._chunk_m, self._head, self.stored.following)
        self.widest_m2 = max(self.widest_m2, float(objects.covariance[:, [0, 3, 5]].max(initial=0.0)))
        return rows

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return what `restore` takes: all rows, those that are free, and the widest place."""
        used = {name: getattr(self.stored, name)[: self._n_used] for name in Stored._fields[:-1]}
        return used | {"free": np.array(self._free, dtype=np.int64), "widest_m2": np.array(self.widest_m2)}

    def restore(self, columns: Mapping[str, NDArray[Any]]) -> None:
        """Take over, in an empty set, the objects that `columns` gave, in the same rows."""
        self.insert_arrays(empty_rows(0, 0)._replace(**{name: columns[name] for name in Stored._fields[:-1]}))
        self.remove(columns["free"])
        self.widest_m2 = float(columns["widest_m2"])

    def remove(self, rows: IntArray) -> None:
        """Forget rows, each once."""
        self._chunks.unlink(rows, self.stored.position, self._chunk_m, self._head, self.stored.following)
        self._free.extend(rows.tolist())

    def near(self, centre_m: FloatArray, reach_m: FloatArray) -> IntArray:
        """Return rows within `reach_m` (K,) of any of the points `centre_m` (K, 3), each once, in order."""
        s = self.stored
        return self._chunks.rows_near(centre_m, reach_m, s.position, self._chunk_m, self._head, s.following)

    def inverse_odds(self, rows: IntArray, stamp_s: float) -> FloatArray:
        """Return (K,) inverse odds that objects are there still at `stamp_s`: less what lifetimes took."""
        from evermap.existence.kernels import predict_rows

        s = self.stored
        prior = s.class_id[rows].astype(np.int64) if len(self._priors) > 1 else np.zeros(len(rows), dtype=np.int64)
        since = s.rest_since_s[rows]
        log_odds = log_death_odds(self._priors, prior, s.judged_s[rows] - since, stamp_s - since)
        predicted = np.empty(len(rows))
        predict_rows(s.inverse_odds[rows], log_odds, predicted)
        return predicted

    def missed(self, rows: IntArray, stamp_s: float, p_detect: FloatArray) -> FloatArray:
        """Return (K,) inverse odds after the places of these objects were looked at, and nothing was seen there."""
        after = np.minimum(self.inverse_odds(rows, stamp_s) / np.maximum(1.0 - p_detect, 1e-12), 1e300)
        self.stored.inverse_odds[rows] = after
        self.stored.judged_s[rows] = stamp_s
        return np.asarray(after, dtype=np.float64)

    def covariance(self, rows: IntArray) -> FloatArray:
        """Return (K, 3, 3) of places."""
        full = np.empty((len(rows), 3, 3))
        full[:, UPPER[0], UPPER[1]] = self.stored.covariance[rows]
        full[:, UPPER[1], UPPER[0]] = self.stored.covariance[rows]
        return full

    def class_p(self, rows: IntArray) -> FloatArray:
        """Return (K, C) posterior over classes, as far as it is kept."""
        top = self.stored.class_p[rows].astype(np.float64)
        others = max(self._n_classes - 1, 1)
        out = np.repeat((1.0 - top)[:, None] / others, self._n_classes, axis=1)
        out[np.arange(len(rows)), self.stored.class_id[rows]] = top
        return out

    def _grow(self, n: int) -> None:
        size = before = len(self._head)
        while size < n:
            size *= 2
        s = self.stored
        room = empty_rows(size, s.appearance.shape[1], s.box.shape[1], s.level.shape[1])
        for name in Stored._fields[:-1]:
            getattr(room, name)[:before] = getattr(s, name)
        self.stored = room
        self._head = np.full(size, self._chunks.END, dtype=np.int32)
        self._chunks.link(self.rows, room.position, self._chunk_m, self._head, room.following)
