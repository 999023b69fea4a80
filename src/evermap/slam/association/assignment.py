"""Assignments of detections to landmarks, with the estimate of everything: immutable values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import sparse

from evermap.config import AssociationConfig, SlamConfig
from evermap.slam.association.features import Likeness, Traits
from evermap.slam.batch import USUAL, sight_at
from evermap.slam.problem import Estimate, Problem
from evermap.types import UNKNOWN, AnyRecordingT, BoolArray, FloatArray, IntArray

NOBODY = -1
"""Landmark row of an unassigned detection."""


class LooseDetections(NamedTuple):
    """Detections of no landmark: (U,) rows.

    Attributes:
        row: of the recording's detections.
        position_m: (U, D) in the frame of the first pose.
        wide_m: standard deviation of each.
        class_id: `UNKNOWN` for none.
    """

    row: IntArray
    position_m: FloatArray
    wide_m: FloatArray
    class_id: IntArray


def alike(one: IntArray, other: IntArray) -> BoolArray:
    """Return which labels (..., P) are compatible: equal in every column, such as class and name, or unknown."""
    return np.asarray(((one == other) | (one == UNKNOWN) | (other == UNKNOWN)).all(axis=-1))


def same_name(one: IntArray, other: IntArray) -> BoolArray:
    """Return which labels (..., P) have the same known name, the last column."""
    return np.asarray((one[..., -1] == other[..., -1]) & (one[..., -1] != UNKNOWN))


def labels_of(kind: IntArray, landmark_row: IntArray, n_landmarks: int) -> IntArray:
    """Return (L, P) labels of landmarks from those (M, P) of their detections, `UNKNOWN` where there is none."""
    found = np.full((n_landmarks, kind.shape[1]), UNKNOWN)
    seen = landmark_row >= 0
    np.maximum.at(found, landmark_row[seen], kind[seen])
    return found


def names_of(name: IntArray, landmark_row: IntArray, n_landmarks: int) -> IntArray:
    """Return (L,) names of landmarks, `UNKNOWN` for none; a name goes to the landmark with most of its detections.

    Args:
        name: (M,) of detections, `UNKNOWN` for none.
        landmark_row: (M,) their landmarks, `NOBODY` for none.
        n_landmarks: number of landmarks.
    """
    read = (name != UNKNOWN) & (landmark_row >= 0)
    pairs, count = np.unique(np.column_stack([name, landmark_row])[read], axis=0, return_counts=True)
    found, used = np.full(n_landmarks, UNKNOWN), set[int]()
    for k in np.argsort(-count, kind="stable").tolist():
        one, row = pairs[k].tolist()
        if found[row] == UNKNOWN and one not in used:
            found[row] = one
            used.add(one)
    return found


def with_ids(recording: AnyRecordingT, landmark_row: IntArray, name: IntArray, landmark_id: IntArray) -> AnyRecordingT:
    """Return a recording with ids (L,) of landmarks for detections without a name.

    Args:
        recording: as it was associated.
        landmark_row: (M,) the landmark of each detection, `NOBODY` for none.
        name: (M,) given id of each, `UNKNOWN` for none.
        landmark_id: (L,) ids of the landmarks.
    """
    found = np.append(landmark_id, UNKNOWN)[landmark_row]
    detections = replace(recording.detections, landmark_id=np.where(name == UNKNOWN, found, name))
    return replace(recording, detections=detections)


def visits_of(stamp_s: FloatArray, landmark_row: IntArray, pause_s: float) -> tuple[IntArray, IntArray]:
    """Return (M,) the visit of each detection, numbered by landmark and then by time, `NOBODY` if unassigned; and (V,)
    the landmark of each visit.

    Args:
        stamp_s: (M,) of detections.
        landmark_row: (M,) their landmarks, `NOBODY` for none.
        pause_s: time without a detection that ends a visit.
    """
    found, order = np.full_like(landmark_row, NOBODY), np.lexsort((stamp_s, landmark_row))
    order = order[landmark_row[order] >= 0]
    again = (np.diff(landmark_row[order]) == 0) & (np.diff(stamp_s[order]) <= pause_s)
    first = np.append(True, ~again)[: len(order)]
    found[order] = np.cumsum(first) - 1
    return found, landmark_row[order[first]]


def shared_variance(
    wide: FloatArray, landmark_row: IntArray, n_landmarks: int, settings: AssociationConfig
) -> FloatArray:
    """Return (L,) variance [m^2] of the error that all sightings of a landmark have in common.

    A robot at rest repeats the same error a hundred times, which the smoother takes for independent errors.

    Args:
        wide: (M,) standard deviations of detections [m].
        landmark_row: (M,) their landmarks, `NOBODY` for none.
        n_landmarks: number of landmarks.
        settings: of the association.
    """
    seen = np.flatnonzero(landmark_row >= 0)
    order = seen[np.lexsort((wide[seen], landmark_row[seen]))]
    count = np.bincount(landmark_row[seen], minlength=n_landmarks)
    middle, met = np.cumsum(count) - count + count // 2, count > 0
    variance = np.full(n_landmarks, settings.shared_m**2)
    variance[met] += (settings.shared_share * wide[order[middle[met]]]) ** 2
    return variance


def count_together(
    frame: IntArray, landmark_row: IntArray, n_frames: int, n_landmarks: int, around_frames: int
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Return (L, L) numbers of frames that show both of two landmarks, and of those that show one, while the other one
    was seen some frames before or after.

    Args:
        frame: (M,) of detections, in the order of time.
        landmark_row: (M,) their landmarks, `NOBODY` for none.
        n_frames: number of frames.
        n_landmarks: number of landmarks.
        around_frames: number of frames before and after.
    """
    shape = n_frames, n_landmarks
    around = frame + np.arange(-around_frames, around_frames + 1)[:, None]
    each = _list_shown(frame, landmark_row, shape)
    about = _list_shown(around.ravel(), np.tile(landmark_row, len(around)), shape)
    together, once = sparse.csr_array(each.T @ each), sparse.csr_array(each.T @ about)
    return together, sparse.csr_array(once + once.T - 2.0 * together)


def _list_shown(frame: IntArray, landmark_row: IntArray, shape: tuple[int, int]) -> sparse.csr_array:
    """(N, L) whether a frame shows a landmark, from frames (M,) and landmarks (M,) of detections."""
    inside = (landmark_row >= 0) & (frame >= 0) & (frame < shape[0])
    found = sparse.csr_array((np.ones(int(inside.sum())), (frame[inside], landmark_row[inside])), shape=shape)
    found.data[:] = 1.0
    return found


def density_of_unmet(place: FloatArray, settings: SlamConfig = USUAL) -> float:
    """Return the density of unmapped landmarks in what those at `place` span; units as of `landmark_density`."""
    return settings.association.least_landmarks / _extent(place, settings)


def landmark_density(place: FloatArray, sightings: IntArray, settings: SlamConfig = USUAL) -> float:
    """Return the density of landmarks: their effective number over the area, in space the volume, that they span.

    The effective number is `(sum s)^2 / sum s^2`, so that a duplicate with few sightings counts little; landmarks with
    equal sightings count one each.

    Args:
        place: (L, 2), or (L, 3) in space.
        sightings: (L,) numbers `s` of detections.
        settings: of the estimator.

    Returns:
        [1/m^2], in space [1/m^3].
    """
    squares = float((sightings.astype(float) ** 2).sum())
    number = float(sightings.sum()) ** 2 / max(squares, 1.0)
    return max(number, settings.association.least_landmarks) / _extent(place, settings)


def _extent(place: FloatArray, settings: SlamConfig) -> float:
    """Area [m^2], in space volume [m^3], of the box around places; those on a wall span none, hence a least extent."""
    rules = settings.association
    side_m, least = 0.0, rules.least_area_m2
    if place.shape[1] == 3:
        side_m, least = rules.space.least_extent_m, rules.space.least_volume_m3
    return max(float(np.prod(np.maximum(np.ptp(place, axis=0), side_m))) if len(place) else 0.0, least)


def merge_rows(pairs: list[tuple[int, int]], n_landmarks: int) -> IntArray:
    """Return (L,) the landmark that each becomes if pairs (younger, older) are merged."""
    becomes = np.arange(n_landmarks)
    for younger, older in sorted(pairs, key=lambda pair: pair[0]):
        becomes[younger] = becomes[older]  # the older one may itself be merged with a still older one
    return becomes


@dataclass(frozen=True, slots=True)
class Assignment:
    """Detections, each of at most one landmark, and an estimate of poses, landmarks and calibration states.

    Attributes:
        measured: the measurements so far, each with its sigma; its landmark rows and landmark priors are ignored.
        landmark_row: (M,) landmark of every detection, `NOBODY` for none; landmarks by first detection.
        estimate: of everything; every landmark has a position.
        kind: (M, 2) class and name of every detection, `UNKNOWN` for none; different ones exclude each other.
        traits: readings of the landmarks themselves; `Traits.none` if they give no evidence.
        settings: of the estimator.
    """

    measured: Problem
    landmark_row: IntArray
    estimate: Estimate
    kind: IntArray
    traits: Traits
    settings: SlamConfig = USUAL

    @property
    def n_landmarks(self) -> int:
        """Number of landmarks."""
        return len(self.estimate.landmark)

    @property
    def sightings(self) -> IntArray:
        """(L,) number of detections of every landmark."""
        return np.bincount(self.landmark_row[self.landmark_row >= 0], minlength=self.n_landmarks)

    @property
    def last_seen_s(self) -> FloatArray:
        """(L,) stamp of the last detection; -inf for none."""
        return self._stamp_s(np.maximum, -np.inf)

    @property
    def first_seen_s(self) -> FloatArray:
        """(L,) stamp of the first detection; inf for none."""
        return self._stamp_s(np.minimum, np.inf)

    def _stamp_s(self, choose: np.ufunc, none_s: float) -> FloatArray:
        found, seen = np.full(self.n_landmarks, none_s), self.landmark_row >= 0
        choose.at(found, self.landmark_row[seen], self.measured.stamp_s[self.measured.pose_row[seen]])
        return found

    @property
    def of_kind(self) -> IntArray:
        """(L, 2) class and name of each landmark."""
        return labels_of(self.kind, self.landmark_row, self.n_landmarks)

    @property
    def together(self) -> sparse.csr_array:
        """(L, L) number of frames that show both of two landmarks."""
        shape = len(self.measured.stamp_s), self.n_landmarks
        each = _list_shown(self.measured.pose_row, self.landmark_row, shape)
        return sparse.csr_array(each.T @ each)

    @property
    def n_named(self) -> IntArray:
        """(L,) number of detections of each landmark that have a name."""
        named = (self.kind[:, -1] != UNKNOWN) & (self.landmark_row >= 0)
        return np.bincount(self.landmark_row[named], minlength=self.n_landmarks)

    @property
    def shared_variance(self) -> FloatArray:
        """(L,) `shared_variance` of these landmarks."""
        return shared_variance(
            self.measured.sigma_given[:, 0], self.landmark_row, self.n_landmarks, self.settings.association
        )

    def with_shared_errors(self, joint: FloatArray) -> FloatArray:
        """Return the covariance (2 L, 2 L) of landmarks, the first of `joint`, with the shared errors of sightings."""
        out = joint[: 2 * self.n_landmarks, : 2 * self.n_landmarks].copy()
        out[np.diag_indices(len(out))] += np.repeat(self.shared_variance, 2)
        return out

    def points(self) -> FloatArray:
        """Return (M, 2) positions of the detections, as seen from their poses."""
        pose = self.estimate.pose[self.measured.pose_row]
        return sight_at(pose, self.measured.reading, self.estimate.states, self.measured.mount)

    @property
    def wide_m(self) -> FloatArray:
        """(M,) standard deviation of the position of each detection, the larger of along and across."""
        sigma = self.measured.sigma_given
        return np.asarray(np.hypot(sigma[:, 0], self.measured.reading[:, 0] * sigma[:, 1]))

    def problem(self) -> Problem:
        """Return the least-squares problem of the assigned detections."""
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
        return self._renumber(rank, ~landmarks)

    def split(self, parts: list[IntArray]) -> Assignment:
        """Return the assignment with a new landmark for each of some rows of detections."""
        row, points = self.landmark_row.copy(), self.points()
        places = [np.median(points[part], axis=0) for part in parts]
        for number, part in enumerate(parts, self.n_landmarks):
            row[part] = number
        estimate = replace(self.estimate, landmark=np.vstack([self.estimate.landmark, *places]))
        return replace(self, landmark_row=row, estimate=estimate)

    def merged(self, pairs: list[tuple[int, int]]) -> Assignment:
        """Return the assignment with pairs (younger, older) merged: the place of the older, the detections of both."""
        becomes = merge_rows(pairs, self.n_landmarks)
        kept = becomes == np.arange(self.n_landmarks)
        rank = np.cumsum(kept) - 1
        return self._renumber(rank[becomes], kept)

    def of_visits(self) -> tuple[IntArray, IntArray]:
        """Return `visits_of` these landmarks."""
        stamp_s = self.measured.seen_s
        return visits_of(stamp_s, self.landmark_row, self.settings.association.forget_s)

    def like(self) -> Likeness:
        """Return the traits of each landmark (L,)."""
        visit, landmark = self.of_visits()
        return self.traits.of_landmarks(self.traits.of_visits(visit, len(landmark)), landmark, self.n_landmarks)

    def in_visits(self) -> IntArray:
        """Return (M,) landmarks with a new one per visit, except that those with a name stay one; see `visits_of`."""
        found = self.of_visits()[0]
        name = labels_of(self.kind, found, int(found.max(initial=NOBODY)) + 1)[:, -1]
        named = name != UNKNOWN
        one = np.arange(len(name))
        one[named] = len(name) + np.unique(name[named], return_inverse=True)[1]
        seen = found >= 0
        found[seen] = one[found[seen]]
        _, first, rank = np.unique(found[seen], return_index=True, return_inverse=True)
        found[seen] = np.argsort(np.argsort(first))[rank]  # by first detection
        return found

    def split_visits(self) -> Assignment:
        """Return the assignment with a landmark per visit, in the middle of its detections; see `in_visits`."""
        row, points = self.in_visits(), self.points()
        seen = row >= 0
        each = np.bincount(row[seen])
        place: FloatArray = np.column_stack([np.bincount(row[seen], x) / each for x in points[seen].T])
        return replace(self, landmark_row=row, estimate=replace(self.estimate, landmark=place))

    def _renumber(self, rank: IntArray, kept: BoolArray) -> Assignment:
        row = np.full_like(self.landmark_row, NOBODY)
        seen = self.landmark_row >= 0
        row[seen] = rank[self.landmark_row[seen]]
        estimate = Estimate(self.estimate.pose, self.estimate.landmark[kept], self.estimate.states)
        return replace(self, landmark_row=row, estimate=estimate)
