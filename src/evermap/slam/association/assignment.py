"""Who is who so far: detections with their landmarks, and where everything is. Values that are never changed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from evermap.slam.association.features import Likeness, Traits
from evermap.slam.problem import Estimate, Problem
from evermap.slam.streaming import sighted_at
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray

NOBODY = -1
"""Landmark row of a detection that belongs to none."""

FEWEST_SIGHTINGS, FEWEST_TO_PAIR = 3, 2
"""Sightings of a landmark that is believed in; and of one that may be paired with another, which counts both."""
NAMED_NATS = math.log(100.0)
"""Log odds by which two of one name are rather one, for each detection with a name."""
FORGET_S = 20.0
"""Time without a detection that ends a visit; what has too few detections by then is forgotten."""
SHARED_M, SHARED_SHARE = 0.02, 0.5
"""Error [m] that no landmark's sightings average out, and the share of a typical sighting's range noise beside it."""


def alike(one: IntArray, other: IntArray) -> BoolArray:
    """Return which labels (..., P) may be of one landmark: equal in every column, as class and name, or unknown."""
    same: BoolArray = ((one == other) | (one == UNKNOWN) | (other == UNKNOWN)).all(axis=-1)
    return same


def same_name(one: IntArray, other: IntArray) -> BoolArray:
    """Return which labels (..., P) have the same name, the last column, which is known."""
    same: BoolArray = (one[..., -1] == other[..., -1]) & (one[..., -1] != UNKNOWN)
    return same


def labels_of(kind: IntArray, landmark_row: IntArray, n_landmarks: int) -> IntArray:
    """Return (L, P) labels of landmarks by those (M, P) of their detections, `UNKNOWN` where none has any."""
    found = np.full((n_landmarks, kind.shape[1]), UNKNOWN)
    seen = landmark_row >= 0
    np.maximum.at(found, landmark_row[seen], kind[seen])
    return found


def names_of(name: IntArray, landmark_row: IntArray, n_landmarks: int) -> IntArray:
    """Return (L,) names of landmarks, `UNKNOWN` for none: each of the one that most detections with it are of.

    Args:
        name: (M,) of detections, `UNKNOWN` for none.
        landmark_row: (M,) their landmarks, `NOBODY` for none.
        n_landmarks: how many there are.
    """
    said = (name != UNKNOWN) & (landmark_row >= 0)
    pairs, count = np.unique(np.column_stack([name, landmark_row])[said], axis=0, return_counts=True)
    found, used = np.full(n_landmarks, UNKNOWN), set[int]()
    for k in np.argsort(-count, kind="stable").tolist():
        one, row = pairs[k].tolist()
        if found[row] == UNKNOWN and one not in used:
            found[row] = one
            used.add(one)
    return found


ABOUT = 3
"""Frames before and after one in which a landmark was seen, in which it should have been seen, too."""


def seen_together(
    frame: IntArray, landmark_row: IntArray, n_frames: int, n_landmarks: int
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Return (L, L) frames in which two landmarks were both seen, and those in which one of them was, and the other one
    some frames before or after.

    Args:
        frame: (M,) of detections, in the order of time.
        landmark_row: (M,) their landmarks, `NOBODY` for none.
        n_frames: how many there are.
        n_landmarks: how many there are.
    """
    shape = n_frames, n_landmarks
    around = frame + np.arange(-ABOUT, ABOUT + 1)[:, None]
    each = _seen_in(frame, landmark_row, shape)
    about = _seen_in(around.ravel(), np.tile(landmark_row, len(around)), shape)
    together, once = sparse.csr_array(each.T @ each), sparse.csr_array(each.T @ about)
    return together, sparse.csr_array(once + once.T - 2.0 * together)


def _seen_in(frame: IntArray, landmark_row: IntArray, shape: tuple[int, int]) -> sparse.csr_array:
    """(N, L) which landmarks were seen in each frame, from frames (M,) and landmarks (M,) of detections."""
    inside = (landmark_row >= 0) & (frame >= 0) & (frame < shape[0])
    found = sparse.csr_array((np.ones(int(inside.sum())), (frame[inside], landmark_row[inside])), shape=shape)
    found.data[:] = 1.0
    return found


@dataclass(frozen=True, slots=True)
class Assignment:
    """Detections, each of one landmark or of nobody, and an estimate of poses, landmarks and states.

    Attributes:
        measured: the measurements so far, each with its sigma; its landmark rows and landmark priors mean nothing.
        landmark_row: (M,) landmark of every detection, `NOBODY` for none; landmarks in the order they were met.
        estimate: where everything is; every landmark has a position.
        kind: (M, 2) class and name of every detection, `UNKNOWN` where it has none; different ones are never one
            landmark's.
        traits: what was read of the landmarks themselves; None for nothing that tells.
    """

    measured: Problem
    landmark_row: IntArray
    estimate: Estimate
    kind: IntArray
    traits: Traits | None = None

    @property
    def n_landmarks(self) -> int:
        """How many landmarks there are."""
        return len(self.estimate.landmark)

    @property
    def sightings(self) -> IntArray:
        """(L,) detections of every landmark."""
        return np.bincount(self.landmark_row[self.landmark_row >= 0], minlength=self.n_landmarks)

    @property
    def last_seen_s(self) -> FloatArray:
        """(L,) stamp of the last detection; -inf where there is none."""
        last = np.full(self.n_landmarks, -np.inf)
        seen = self.landmark_row >= 0
        np.maximum.at(last, self.landmark_row[seen], self.measured.stamp_s[self.measured.pose_row[seen]])
        return last

    @property
    def first_seen_s(self) -> FloatArray:
        """(L,) stamp of the first detection; inf where there is none."""
        first = np.full(self.n_landmarks, np.inf)
        seen = self.landmark_row >= 0
        np.minimum.at(first, self.landmark_row[seen], self.measured.stamp_s[self.measured.pose_row[seen]])
        return first

    @property
    def of_kind(self) -> IntArray:
        """(L, 2) class and name of each landmark."""
        return labels_of(self.kind, self.landmark_row, self.n_landmarks)

    @property
    def together(self) -> sparse.csr_array:
        """(L, L) frames in which two landmarks were both seen."""
        shape = len(self.measured.stamp_s), self.n_landmarks
        each = _seen_in(self.measured.pose_row, self.landmark_row, shape)
        return sparse.csr_array(each.T @ each)

    @property
    def told(self) -> IntArray:
        """(L,) detections of each landmark that have a name."""
        named = (self.kind[:, -1] != UNKNOWN) & (self.landmark_row >= 0)
        return np.bincount(self.landmark_row[named], minlength=self.n_landmarks)

    @property
    def name(self) -> IntArray:
        """(L,) name of each landmark, `UNKNOWN` for none; no two have the same."""
        return names_of(self.kind[:, -1], self.landmark_row, self.n_landmarks)

    def seen_together(self) -> tuple[sparse.csr_array, sparse.csr_array]:
        """Return `seen_together` of these."""
        return seen_together(self.measured.pose_row, self.landmark_row, len(self.measured.stamp_s), self.n_landmarks)

    @property
    def shared_variance(self) -> FloatArray:
        """(L,) variance [m^2] of what the sightings of a landmark have in common.

        A robot that stands still makes the same error a hundred times, and the smoother believes it was a hundredth.
        """
        seen = np.flatnonzero(self.landmark_row >= 0)
        order = seen[np.lexsort((self.measured.sigma_given[seen, 0], self.landmark_row[seen]))]
        count = self.sightings
        middle = np.cumsum(count) - count + count // 2
        variance = np.full(self.n_landmarks, SHARED_M**2)
        met = count > 0
        variance[met] += (SHARED_SHARE * self.measured.sigma_given[order[middle[met]], 0]) ** 2
        return variance

    def with_shared_errors(self, joint: FloatArray) -> FloatArray:
        """Return the covariance (G, G) of all landmarks and states with what sightings from one place share."""
        out = joint.copy()
        rows = np.arange(2 * self.n_landmarks)
        out[rows, rows] += np.repeat(self.shared_variance, 2)
        return out

    def points(self) -> FloatArray:
        """Return (M, 2) where the detections point to from their poses."""
        pose = self.estimate.pose[self.measured.pose_row]
        return sighted_at(pose, self.measured.reading, self.estimate.states, self.measured.mount)

    def problem(self) -> Problem:
        """Return the least-squares problem of the detections that belong to a landmark."""
        used = np.flatnonzero(self.landmark_row >= 0)
        count = self.n_landmarks
        return replace(
            self.measured,
            pose_row=self.measured.pose_row[used],
            landmark_row=self.landmark_row[used],
            reading=self.measured.reading[used],
            sigma_given=self.measured.sigma_given[used],
            landmark_mean=np.zeros((count, 2)),
            landmark_information=sparse.csr_array((2 * count, 2 * count)),
        )

    def without(self, landmarks: BoolArray) -> Assignment:
        """Return the assignment without some landmarks (L,), their detections unassigned."""
        rank = np.where(landmarks, NOBODY, np.cumsum(~landmarks) - 1)
        return self._renumbered(rank, ~landmarks)

    def split(self, parts: list[IntArray]) -> Assignment:
        """Return the assignment with a new landmark for each of some rows of detections."""
        row, points = self.landmark_row.copy(), self.points()
        places = [np.median(points[part], axis=0) for part in parts]
        for number, part in enumerate(parts, self.n_landmarks):
            row[part] = number
        estimate = replace(self.estimate, landmark=np.vstack([self.estimate.landmark, *places]))
        return replace(self, landmark_row=row, estimate=estimate)

    def merged(self, pairs: list[tuple[int, int]]) -> Assignment:
        """Return the assignment with pairs (younger, older) merged: the older's place, the detections of both."""
        becomes = np.arange(self.n_landmarks)
        for younger, older in sorted(pairs, key=lambda pair: pair[0]):
            becomes[younger] = becomes[older]  # the older one may have been merged itself, with a still older
        kept = becomes == np.arange(self.n_landmarks)
        rank = np.cumsum(kept) - 1
        return self._renumbered(rank[becomes], kept)

    def visits(self, pause_s: float) -> IntArray:
        """Return (M,) the visit of each detection, numbered by landmark and then by time, `NOBODY` for none.

        Args:
            pause_s: time without a detection that ends a visit.
        """
        stamp_s, found = self.measured.stamp_s[self.measured.pose_row], np.full_like(self.landmark_row, NOBODY)
        order = np.lexsort((stamp_s, self.landmark_row))
        order = order[self.landmark_row[order] >= 0]
        again = (np.diff(self.landmark_row[order]) == 0) & (np.diff(stamp_s[order]) <= pause_s)
        found[order] = np.cumsum(np.append(0, ~again)[: len(order)])
        return found

    def of_visits(self, pause_s: float = FORGET_S) -> tuple[IntArray, IntArray]:
        """Return `visits`, and (V,) the landmark of each."""
        visit = self.visits(pause_s)
        first = np.flatnonzero(visit >= 0)
        _, at = np.unique(visit[first], return_index=True)
        return visit, self.landmark_row[first[at]]

    def like(self) -> Likeness | None:
        """Return what each landmark (L,) is like; None where nothing tells."""
        if self.traits is None:
            return None
        visit, landmark = self.of_visits()
        return self.traits.of_landmarks(self.traits.of_visits(visit, len(landmark)), landmark, self.n_landmarks)

    def in_visits(self, pause_s: float) -> IntArray:
        """Return (M,) landmarks as if each were another one in every visit, but for those with a name; see `visits`."""
        found = self.visits(pause_s)
        name = labels_of(self.kind, found, int(found.max(initial=NOBODY)) + 1)[:, -1]
        named = name != UNKNOWN
        one = np.arange(len(name))
        one[named] = len(name) + np.unique(name[named], return_inverse=True)[1]
        seen = found >= 0
        found[seen] = one[found[seen]]
        _, first, rank = np.unique(found[seen], return_index=True, return_inverse=True)
        found[seen] = np.argsort(np.argsort(first))[rank]  # in the order in which they were met
        return found

    def _renumbered(self, rank: IntArray, kept: BoolArray) -> Assignment:
        row = np.full_like(self.landmark_row, NOBODY)
        seen = self.landmark_row >= 0
        row[seen] = rank[self.landmark_row[seen]]
        estimate = Estimate(self.estimate.pose, self.estimate.landmark[kept], self.estimate.states)
        return replace(self, landmark_row=row, estimate=estimate)
