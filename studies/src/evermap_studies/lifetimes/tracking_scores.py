"""How well tracks follow objects: CLEAR MOT (Bernardin and Stiefelhagen 2008) and IDF1 (Ristani et al. 2016)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evermap.errors import DataError
from evermap.types import BoolArray, FloatArray, IntArray

Points = tuple[IntArray, FloatArray]
"""What is there in a frame: (N,) ids, none twice, and (N, 3) positions in metres."""


@dataclass(frozen=True, slots=True)
class TrackingScores:
    """Counts over all frames, and what is made of them.

    Attributes:
        n_true: true positions, over all frames.
        n_reported: reported positions.
        n_matched: true positions that have a reported one.
        switches: times that an object is matched with another track than when it was matched before.
        fragmentations: times that an object which is matched ceases to be, and is matched again later.
        distance_m: mean distance of the matched, nan without any.
        n_identified: true positions whose object and track belong together in the best one-to-one assignment of objects
            to tracks over the whole run (IDTP).
    """

    n_true: int
    n_reported: int
    n_matched: int
    switches: int
    fragmentations: int
    distance_m: float
    n_identified: int

    @property
    def n_missed(self) -> int:
        """True positions without a reported one."""
        return self.n_true - self.n_matched

    @property
    def n_false(self) -> int:
        """Reported positions without a true one."""
        return self.n_reported - self.n_matched

    @property
    def mota(self) -> float:
        """Accuracy, `1 - (missed + false + switches) / true`; at most 1, possibly negative, nan without truth."""
        return 1.0 - _ratio(self.n_missed + self.n_false + self.switches, self.n_true)

    @property
    def motp_m(self) -> float:
        """Precision: mean distance of the matched [m], the smaller the better."""
        return self.distance_m

    @property
    def idf1(self) -> float:
        """`2 IDTP / (true + reported)`: how much of everything was given one and the right identity."""
        return _ratio(2 * self.n_identified, self.n_true + self.n_reported)


def score_tracks(truth: Sequence[Points], tracks: Sequence[Points], gate_m: float) -> TrackingScores:
    """Compare reported with true positions, frame by frame.

    An object and a track can be matched within `gate_m`. In every frame an object keeps the track that it was last
    matched with, as long as that is possible; the others are assigned so that as many as possible are matched and,
    of all such assignments, at the smallest sum of distances.

    Args:
        truth: F frames of objects.
        tracks: F frames of tracks; their ids have nothing to do with those of the objects.
        gate_m: largest distance of a match.

    Raises:
        DataError: different numbers of frames, shapes that do not fit, or an id twice in a frame.
    """
    if len(truth) != len(tracks):
        raise DataError(f"{len(tracks)} frames of tracks for {len(truth)} of truth", field="tracks")
    last_track: dict[int, int] = {}
    matched_before: dict[int, bool] = {}  # of objects that were matched once: in their last frame too?
    together: dict[tuple[int, int], int] = {}
    n_true = n_reported = n_matched = switches = fragmentations = 0
    total_m = 0.0
    for frame, (objects, reports) in enumerate(zip(truth, tracks, strict=True)):
        (object_id, there), (track_id, reported) = _checked(objects, frame, "truth"), _checked(reports, frame, "tracks")
        distance = np.linalg.norm(there[:, None] - reported[None], axis=2)
        possible = distance <= gate_m
        for i, k in zip(*np.nonzero(possible), strict=True):
            pair = int(object_id[i]), int(track_id[k])
            together[pair] = together.get(pair, 0) + 1
        match = _match(object_id, track_id, distance, possible, last_track)
        for i, one in enumerate(object_id.tolist()):
            if i in match:
                track = int(track_id[match[i]])
                switches += last_track.get(one, track) != track
                fragmentations += not matched_before.get(one, True)
                last_track[one] = track
                total_m += float(distance[i, match[i]])
                matched_before[one] = True
            elif one in matched_before:
                matched_before[one] = False
        n_true, n_reported, n_matched = n_true + len(there), n_reported + len(reported), n_matched + len(match)
    return TrackingScores(
        n_true=n_true,
        n_reported=n_reported,
        n_matched=n_matched,
        switches=switches,
        fragmentations=fragmentations,
        distance_m=_ratio(total_m, n_matched),
        n_identified=_identified(together),
    )


def _checked(points: Points, frame: int, field: str) -> Points:
    ids, position = np.asarray(points[0], dtype=np.int64), np.asarray(points[1], dtype=np.float64)
    if ids.ndim != 1 or position.shape != (len(ids), 3):
        raise DataError(f"frame {frame}: shapes {ids.shape} and {position.shape}, not (N,) and (N, 3)", field=field)
    if len(np.unique(ids)) < len(ids):
        raise DataError(f"frame {frame}: an id twice", field=field)
    return ids, position


def _match(
    object_id: IntArray, track_id: IntArray, distance: FloatArray, possible: BoolArray, last_track: dict[int, int]
) -> dict[int, int]:
    """Column of each row that is matched: first those that stay together, then the best assignment of the others."""
    from scipy.optimize import linear_sum_assignment

    column = {int(track): k for k, track in enumerate(track_id)}
    match: dict[int, int] = {}
    taken: set[int] = set()
    for i, one in enumerate(object_id.tolist()):
        k = column.get(last_track[one]) if one in last_track else None
        if k is not None and possible[i, k] and k not in taken:
            match[i] = k
            taken.add(k)
    rows = [i for i in range(len(object_id)) if i not in match and possible[i].any()]
    columns = [k for k in range(len(track_id)) if k not in taken and possible[:, k].any()]
    if rows and columns:
        block, allowed = distance[np.ix_(rows, columns)], possible[np.ix_(rows, columns)]
        impossible = 1.0 + 2.0 * block[allowed].sum()  # one more match is worth more than all distances
        chosen = linear_sum_assignment(np.where(allowed, block, impossible))
        match.update({rows[i]: columns[k] for i, k in zip(*chosen, strict=True) if allowed[i, k]})
    return match


def _identified(together: dict[tuple[int, int], int]) -> int:
    """Largest number of frames in which objects and tracks, assigned one to one, were near each other."""
    from scipy.optimize import linear_sum_assignment
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not together:
        return 0
    pairs = np.array(list(together))
    frames = np.array(list(together.values()))
    objects, row = np.unique(pairs[:, 0], return_inverse=True)
    tracks, column = np.unique(pairs[:, 1], return_inverse=True)
    n = len(objects) + len(tracks)
    _, part = connected_components(coo_array((frames, (row, len(objects) + column)), shape=(n, n)), directed=False)
    total = 0
    for which in np.unique(part):
        mine = part[row] == which
        rows, i = np.unique(row[mine], return_inverse=True)
        columns, k = np.unique(column[mine], return_inverse=True)
        table = np.zeros((len(rows), len(columns)))
        table[i, k] = frames[mine]
        total += int(table[linear_sum_assignment(table, maximize=True)].sum())
    return total


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
