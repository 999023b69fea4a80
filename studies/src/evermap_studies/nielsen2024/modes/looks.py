"""What the whole recording says about the modes: every detection and every expected one that did not come.

Negative information is for the selection only, never for the least squares (Nielsen 2024 section 7.2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from evermap.sensing.visibility import NominalField
from evermap.slam.problem import Estimate, Noise, Problem
from evermap.types import BoolArray, FloatArray, IntArray, Sensor
from evermap_studies.nielsen2024.modes.places import FREE, Modes
from evermap_studies.nielsen2024.selectors.chain import ModeLooks
from evermap_studies.nielsen2024.selectors.likelihood import Readings, log_psi, miss_weight_from

LONGEST_SEQUENCE_GAP_S = 5.0
"""Looks at a landmark further apart than this say nothing about how consecutive misses depend on each other."""
IN_VIEW = 0.5
"""Share of the sensor's detection probability from which on a mode is in view: inside of the limits."""
MISS = -1
"""Detection of a look that missed."""


@dataclass(frozen=True, slots=True)
class Looks:
    """Looks at the landmarks that have several modes, sorted by landmark and time.

    Attributes:
        table: (L, K) places of every landmark (`Modes.table`).
        landmark: (R,) row of the landmark looked at.
        pose_row: (R,) from which pose.
        detection: (R,) row of the problem's detections, or `MISS`.
        evidence: the same looks as selectors want them; its landmarks are those of `several`, in order.
        several: (S,) rows of the landmarks with several modes.
    """

    table: IntArray
    landmark: IntArray
    pose_row: IntArray
    detection: IntArray
    evidence: ModeLooks
    several: IntArray

    def __len__(self) -> int:
        return len(self.landmark)

    @property
    def hit(self) -> BoolArray:
        """(R,) which looks are detections."""
        hit: BoolArray = self.detection != MISS
        return hit

    def assigned(self, problem: Problem, indicator: IntArray) -> Problem:
        """The problem with every detection at the mode that was selected for it."""
        place = self.table[self.landmark, indicator]
        row = problem.landmark_row.copy()
        row[self.detection[self.hit]] = place[self.hit]
        return replace(problem, landmark_row=row)

    def columns_of(self, landmark_row: IntArray) -> IntArray:
        """(R,) columns that hold by the places of detections; -1 where a detection's place has no position.

        A miss takes that of the detection before it, or of the first one.
        """
        hits = np.flatnonzero(self.hit)
        at = self.table[self.landmark[hits]] == landmark_row[self.detection[hits], None]
        column = np.where(at.any(axis=1), at.argmax(axis=1), -1)
        last = np.searchsorted(hits, np.arange(len(self)), side="right") - 1
        before = (last >= 0) & (self.landmark[hits[last]] == self.landmark)
        return column[np.where(before, last, last + 1)]

    def prior_score(self, indicator: IntArray, log_joint: FloatArray) -> float:
        """What the chain and the misses say about a selection: all of its log probability but the detections'."""
        rows = np.flatnonzero(self.hit)
        return float(log_joint.sum() - self.evidence.log_likelihood[rows, indicator[rows]].sum())


def look_at_modes(
    problem: Problem,
    estimate: Estimate,
    noise: Noise,
    modes: Modes,
    sensor: Sensor,
    *,
    miss_weight: float,
    robust: bool,
) -> Looks:
    """All looks at landmarks with several modes, given poses and modes.

    Args:
        problem: the measurements.
        estimate: poses and positions.
        noise: of the sensor; with its `outlier_log_odds` a single detection says no more than an outlier would.
        modes: whose mode each place is.
        sensor: field of view and detection probability.
        miss_weight: share of a miss that is news; 0 leaves misses out.
        robust: whether outliers are explained as such.
    """
    table = modes.table(estimate)
    several = np.flatnonzero((table != FREE).sum(axis=1) > 1)
    owner = modes.landmark[problem.landmark_row]
    detection = np.flatnonzero(np.isin(owner, several))
    landmark, pose_row = owner[detection], problem.pose_row[detection]
    if miss_weight > 0.0 and len(several):
        in_view = _in_view(estimate, table[several], sensor)
        in_view[pose_row, np.searchsorted(several, landmark)] = False
        missed_pose, missed = np.nonzero(in_view)
        detection = np.append(detection, np.full(len(missed), MISS))
        landmark, pose_row = np.append(landmark, several[missed]), np.append(pose_row, missed_pose)
    order = np.lexsort((detection, pose_row, landmark))
    detection, landmark, pose_row = detection[order], landmark[order], pose_row[order]
    hit = detection != MISS
    reading, sigma = np.full((len(order), 2), np.nan), np.tile(noise.detection, (len(order), 1))
    reading[hit] = problem.reading[detection[hit]]
    sigma[hit] = noise.of_detections(problem.sigma_given[detection[hit]])
    position = np.where((table[several] != FREE)[:, :, None], estimate.landmark[table[several]], np.nan)
    log_likelihood = log_psi(
        Readings(
            estimate.pose[pose_row],
            np.searchsorted(several, landmark),
            position,
            reading,
            sigma,
            states=estimate.states,
        ),
        sensor,
        miss_weight=miss_weight,
        outlier_density=_outlier_density(noise) if robust else 0.0,
    )
    first = np.searchsorted(landmark, np.append(several, modes.n_landmarks))
    evidence = ModeLooks(first, problem.stamp_s[pose_row], log_likelihood)
    return Looks(table, landmark, pose_row, detection, evidence, several)


def news_in_a_miss(problem: Problem, estimate: Estimate, modes: Modes, sensor: Sensor) -> float:
    """Share of a miss that is news, from this session: misses follow each other more often than chance has it.

    A landmark counts as looked at while it is in view of the place that it was last seen at.
    """
    owner = modes.landmark[problem.landmark_row]
    rows = np.arange(len(problem.stamp_s))
    places = np.flatnonzero(estimate.known)
    in_view = _in_view(estimate, places[:, None], sensor)
    detected, starts = [np.zeros(0)], [np.ones(0, dtype=np.bool_)]
    for landmark in np.unique(owner):
        mine = np.flatnonzero(owner == landmark)
        hit = np.isin(rows, problem.pose_row[mine])
        last = np.maximum(np.searchsorted(problem.pose_row[mine], rows, side="right") - 1, 0)
        place = np.searchsorted(places, problem.landmark_row[mine[last]])
        look = np.flatnonzero(hit | in_view[rows, place])
        pause = (np.diff(look) > 1) | (np.diff(problem.stamp_s[look]) > LONGEST_SEQUENCE_GAP_S)
        detected.append(hit[look].astype(np.float64))
        starts.append(np.append(True, pause))
    first = np.append(np.flatnonzero(np.concatenate(starts)), sum(map(len, starts)))
    return miss_weight_from(np.concatenate(detected), first.astype(np.int64), sensor.p_detect)


def _in_view(estimate: Estimate, places: IntArray, sensor: Sensor) -> BoolArray:
    """(N, S) from which poses one of the places (S, K) of each landmark should have been detected."""
    expected, field = np.zeros((len(estimate.pose), len(places)), dtype=np.bool_), NominalField(sensor)
    for column in places.T:
        there = np.flatnonzero(column != FREE)
        p = field.p_detect(estimate.pose, estimate.landmark[column[there]])
        expected[:, there] |= p >= IN_VIEW * sensor.p_detect
    return expected


def _outlier_density(noise: Noise) -> float:
    """Density [1 / (m rad)] of outliers, as the least squares' kernel has it."""
    return math.exp(-noise.outlier_log_odds) / (2.0 * math.pi * float(np.prod(noise.detection)))
