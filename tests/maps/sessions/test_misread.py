"""Detections with a wrong identity that agree on a place."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

import evermap as em
from evermap.types import IntArray, Recording, rows_of
from evermap_studies.sim import WarehouseConfig, simulate_warehouse

FAR = 59
"""A landmark of the last aisle, which nobody drives along."""


@functools.cache
def drive() -> Recording:
    config = WarehouseConfig(n_landmarks=60, landmarks_per_aisle=20, aisles_driven=1)
    return replace(simulate_warehouse(config, seed=3), truth=None)


def rows_of_landmark(recording: Recording, name: int) -> IntArray:
    return np.flatnonzero(recording.detections.landmark_id == name)


def test_a_landmark_that_was_misread_twice_is_not_elsewhere() -> None:
    recording = drive()
    assert not len(rows_of_landmark(recording, FAR))
    mine = rows_of_landmark(recording, 5)
    assert len(mine) > 30
    name = recording.detections.landmark_id.copy()
    name[mine[[8, 20]]] = FAR
    misread = replace(recording, detections=replace(recording.detections, landmark_id=name))
    living = em.run_session(misread).living
    assert FAR not in living.members.landmark_id
    assert 5 in living.members.landmark_id


def test_two_landmarks_that_are_seen_together_are_two() -> None:
    recording = drive()
    mine = rows_of_landmark(recording, 5)[::8]
    second = rows_of(recording.detections, mine)
    second = replace(second, landmark_id=np.full(len(mine), FAR), bearing_rad=second.bearing_rad + 0.02)
    rows = np.concatenate([np.arange(len(recording.detections)), mine])
    both = rows_of(recording.detections, rows)
    new = np.arange(len(rows)) >= len(recording.detections)
    both.landmark_id[new], both.bearing_rad[new] = second.landmark_id, second.bearing_rad
    detections = rows_of(both, np.argsort(both.frame, kind="stable"))
    living = em.run_session(replace(recording, detections=detections)).living
    assert FAR in living.members.landmark_id
