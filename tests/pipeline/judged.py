"""Runs of the pipeline over simulated recordings, and their errors by the simulator's truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import Any

import numpy as np
from recordings import building
from scipy import stats

from evermap.config import Config, load_config
from evermap.geometry import se2
from evermap.pipeline import run_slam
from evermap.types import FloatArray, Landmarks, ParameterEstimate, Recording, SlamResult

SEEDS = (0, 1, 2)


def recording_of(seed: int, patrol_s: float = 40.0, faults: float = 0.01) -> Recording:
    return building(seed, patrol_s=patrol_s, faults=faults).sessions[0]


def true_pose_at(recording: Recording, stamp_s: FloatArray) -> FloatArray:
    """Interpolated between the 50 Hz of the truth."""
    assert recording.truth is not None
    pose = recording.truth.pose_world_robot
    columns = pose[:, 0], pose[:, 1], np.unwrap(pose[:, 2])
    return np.column_stack([np.interp(stamp_s, recording.truth.stamp_s, column) for column in columns])


@dataclass
class Judged:
    """A run and its errors in its own frame, nothing aligned: the first pose of the truth is known."""

    recording: Recording
    result: SlamResult
    wrong: np.ndarray

    @property
    def true_origin(self) -> FloatArray:
        """The pose that is the origin of the estimate's frame, in the world."""
        if self.result.trajectory.frame == "prior_map":
            return np.zeros(3)
        first = self.recording.frames.stamp_s[self.recording.detections.frame[:1]]
        return true_pose_at(self.recording, first)[0]

    @property
    def pose_error(self) -> FloatArray:
        trajectory = self.result.trajectory
        true = se2.between(self.true_origin, true_pose_at(self.recording, trajectory.stamp_s))
        return se2.log(se2.between(trajectory.pose_world_robot, true))

    @property
    def pose_nees(self) -> FloatArray:
        error = self.pose_error
        return np.einsum("ni,nij,nj->n", error, np.linalg.inv(self.result.trajectory.covariance), error)

    @property
    def landmark_error(self) -> FloatArray:
        true = self.recording.true_landmarks
        assert true is not None
        rows = np.searchsorted(true.landmark_id, self.result.landmarks.landmark_id)
        position = se2.transform(se2.inverse(self.true_origin), true.position_m[rows])
        return self.result.landmarks.position_m - position

    @property
    def landmark_nees(self) -> FloatArray:
        error = self.landmark_error
        return np.einsum("ni,nij,nj->n", error, np.linalg.inv(self.result.landmarks.covariance_m2), error)

    @property
    def seen_well(self) -> np.ndarray:
        """Often enough that a wrong identity cannot be all that is known of it."""
        return self.result.landmarks.n_hits >= 5

    def landmark_rmse(self) -> float:
        return float(np.sqrt((self.landmark_error[self.seen_well] ** 2).sum(axis=1).mean()))

    def parameter(self, name: str) -> ParameterEstimate:
        return next(p for p in self.result.parameters if p.name == name)


AS_READ = "slam.vote_ids=false"
"""Wrong identities stay."""


def judge(recording: Recording, wrong: np.ndarray, config: Config | None = None, **options: Any) -> Judged:
    return Judged(recording, run_slam(recording, config, **options), wrong)


def surveyed(recording: Recording, seed: int) -> Landmarks:
    """The true landmarks as somebody measured them, to 2 cm."""
    true = recording.true_landmarks
    assert true is not None
    error = 0.02 * np.random.default_rng(seed).normal(size=true.position_m.shape)
    return Landmarks.at(true.landmark_id, true.position_m + error, sigma_m=0.02)


@cache
def judged(seed: int, *overrides: str, with_map: bool = False, faults: float = 0.01) -> Judged:
    """One run a seed and setting, shared by the tests."""
    simulation = building(seed, patrol_s=40.0, faults=faults)
    recording = simulation.sessions[0]
    wrong = simulation.truths[0].detection_landmark_id != recording.detections.landmark_id
    prior_map = surveyed(recording, seed) if with_map else None
    return judge(recording, wrong, load_config(None, overrides), prior_map=prior_map)


def consistent(judged_runs: list[Judged]) -> None:
    """One pose and one landmark a run, which are independent between runs, have chi-square errors."""
    last = [run.pose_nees[-1] for run in judged_runs]
    low, high = stats.chi2(3 * len(last)).ppf([1e-3, 1 - 1e-3])
    assert low < sum(last) < high
    often = [run.landmark_nees[np.argmax(run.result.landmarks.n_hits)] for run in judged_runs]
    low, high = stats.chi2(2 * len(often)).ppf([1e-3, 1 - 1e-3])
    assert low < sum(often) < high


def assert_same(a: SlamResult, b: SlamResult) -> None:
    for (name, x), (_, y) in zip(arrays_of(a), arrays_of(b), strict=True):
        if isinstance(x, np.ndarray):
            assert x.tobytes() == y.tobytes(), name
        else:
            assert repr(x) == repr(y), name


def arrays_of(thing: Any, path: str = "result") -> Iterator[tuple[str, Any]]:
    """All numbers of nested dataclasses but the timings, by name."""
    if is_dataclass(thing):
        for field in fields(thing):
            if field.name != "step_s":
                yield from arrays_of(getattr(thing, field.name), f"{path}.{field.name}")
    elif isinstance(thing, tuple):
        for k, item in enumerate(thing):
            yield from arrays_of(item, f"{path}[{k}]")
    else:
        yield path, thing
