"""One run of the experiment on a recording: what has moved, how it is looked for, and what came out of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.errors import DataError, NumericalError
from evermap.io.shifts import Shift, shifted
from evermap.metrics.trajectory import interpolate
from evermap.types import FloatArray, Landmarks, MapChange, Recording, SlamResult, Trajectory
from evermap_studies.mrclam.study import PRIOR_SIGMA_M, find_dataset
from evermap_studies.nielsen2024.scores import change_scores, run_scores
from evermap_studies.rows import commit_of_code
from evermap_studies.worlds.edited import edited, limited

if TYPE_CHECKING:
    from evermap.config import Config

Row = dict[str, Any]

BUILDING = 0
"""'Data set' of the simulated building; its 'robots' are seeds."""
PLACE_DECIMALS = 3
PAPER_RANGE_M, PAPER_BEARING_RAD = 5.0, 0.4
"""Detections beyond these were disregarded by the paper."""
_PAPER = (
    "slam.modes.births=gate",
    "slam.sensor_model=plain",
    "slam.robust=false",
    "slam.estimate_noise=false",
    "slam.odometry_noise_factor=3",
    "sensor.sigma_range_m=0.2",
    "sensor.sigma_bearing_rad=0.11",
    "sensor.p_detect=0.6",
    f"sensor.range_max_m={PAPER_RANGE_M}",
    f"sensor.bearing_min_rad={-PAPER_BEARING_RAD}",
    f"sensor.bearing_max_rad={PAPER_BEARING_RAD}",
)
_PAPER_MODES = ("slam.modes.gate_probability=0.95", "slam.modes.switch_probability=0.0001")
SENSORS: dict[str, tuple[str, ...]] = {
    "ours": (),
    "paper": (*_PAPER, *_PAPER_MODES),
    "many-modes": (*_PAPER, "slam.modes.gate_probability=0.8", "slam.modes.switch_probability=0.1"),
    "paper-no-window": (*_PAPER, *_PAPER_MODES, "slam.modes.mcts_window_s=1e6"),
}
"""Settings by name: our defaults, the paper's of section 8.2.2, those of 8.2.4 that make many modes, and the paper's
with a tree search that decides from the start of the recording on (8.3), instead of over the last 40 s.

The paper's odometry noise is not in its text. Three times what a run starts from is about what a static run with the
paper's sensor model learns from the recordings (0.15 rad for every square root of a radian turned); with less, the
robot that comes back from a blind stretch is surprised by every landmark.
"""


NOTHING: Row = {
    "failure": None,
    "placed": False,
    "exact": False,
    "changes": [],
    "alternatives": [],
    "places": [],
    "commit": None,
    **dict.fromkeys(
        (
            "pose_rmse_m", "pose_seen_rmse_m", "pose_max_m", "heading_rmse_deg", "pose_true_rmse_m",
            "landmark_rmse_m", "landmark_max_m", "truth_rank", "precision", "recall", "displacement_error_m",
            "time_off_interval_s", "time_off_window_s", "recording_s", "frames", "wall_s", "cpu_s", "step_p99_ms",
        )
    ),
}  # fmt: skip
"""All scores of a run, none of them known."""


@dataclass(frozen=True, slots=True)
class Job:
    """One run.

    Attributes:
        part, scenario: where it belongs in the tables.
        dataset, robot: which recording; `BUILDING` and a seed for a simulated one.
        sensor: key of `SENSORS`.
        method: `slam.method`.
        shifts: of the given map against the world; with `during`, of the world against the map at half time.
        delta_m: size of the displacement, for the tables.
        during: whether the world changes during the recording.
        seed: of the estimator.
        duration_s: of the recording, for the progress.
    """

    part: str
    scenario: str
    dataset: int
    robot: int
    sensor: str
    method: str
    shifts: tuple[Shift, ...] = ()
    delta_m: float = 0.0
    during: bool = False
    seed: int = 0
    duration_s: float = 0.0

    @property
    def key(self) -> Row:
        """What tells its row from the others."""
        names = ("part", "scenario", "dataset", "robot", "sensor", "method", "delta_m")
        return {name: getattr(self, name) for name in names}

    def config(self) -> Config:
        """Configuration of the run."""
        from evermap.config import load_config

        return load_config(None, [*SENSORS[self.sensor], f"slam.method={self.method}", f"slam.seed={self.seed}"])


@dataclass(frozen=True, slots=True)
class Reference:
    """The trajectory to compare with.

    Attributes:
        trajectory: true, or smoothed with the true landmarks.
        range_law: slope, skew and curvature of the recording's ranges, as found on the way.
    """

    trajectory: Trajectory
    range_law: tuple[float, float, float]


@lru_cache(maxsize=4)
def recording_of(data: Path, dataset: int, robot: int) -> Recording:
    """A recording with its survey."""
    if dataset == BUILDING:
        from evermap_studies.sim import BuildingConfig, simulate_building

        return simulate_building(BuildingConfig(days=1, change_rate=0.0), seed=robot).sessions[0]
    from evermap.io import read_planar

    return read_planar(find_dataset(data, dataset), robot=robot)


def survey_of(recording: Recording) -> Landmarks:
    """True landmarks, as a map to localise in."""
    survey = recording.true_landmarks
    if survey is None:
        raise DataError(f"{recording.name}: no surveyed landmarks")
    return Landmarks.at(survey.landmark_id, survey.position_m, sigma_m=PRIOR_SIGMA_M, frame="prior_map")


def reference_of(data: Path, dataset: int, robot: int) -> Reference:
    """The truth where it covers the recording, else a trajectory smoothed with the true landmarks fixed."""
    from evermap.config import load_config
    from evermap.pipeline import run_slam

    recording = recording_of(data, dataset, robot)
    result = run_slam(
        recording,
        load_config(None, ["slam.method=nohyp"]),
        prior_map=survey_of(recording),
    )
    value = {parameter.name: parameter.value for parameter in result.parameters}
    law = (value["range_slope"], value["range_skew_per_rad"], value["range_curvature_per_rad2"])
    truth = recording.truth
    return Reference(truth if truth is not None and covers(truth, recording) else result.trajectory, law)


def covers(truth: Trajectory, recording: Recording) -> bool:
    """Whether the truth spans nearly all frames."""
    frames_s = recording.frames.stamp_s
    known = (frames_s >= truth.stamp_s[0]) & (frames_s <= truth.stamp_s[-1])
    return bool(known.mean() > 0.95)


def half_time_s(recording: Recording) -> float:
    """When a change during the recording happens."""
    return float(recording.frames.stamp_s[[0, -1]].mean())


def inputs_of(job: Job, recording: Recording, reference: Reference) -> tuple[Recording, Landmarks, Landmarks]:
    """What the estimator is given (recording and map), and where the landmarks truly are at the end."""
    truth = survey_of(recording)
    if job.sensor != "ours":
        recording = limited(recording, PAPER_RANGE_M, PAPER_BEARING_RAD)
    if not job.during:
        return recording, shifted(truth, job.shifts), truth
    after = shifted(truth, job.shifts)
    poses = poses_at(reference.trajectory, recording.frames.stamp_s)
    changed = edited(recording, poses, truth, after, half_time_s(recording), reference.range_law)
    return changed, truth, after


def true_changes(job: Job, recording: Recording) -> list[MapChange]:
    """What the run should find."""
    before = [shift.undone(float(recording.frames.stamp_s[0])) for shift in job.shifts]
    if not job.during:
        return before
    at_s = half_time_s(recording)
    return [
        replace(
            change,
            stamp_from_s=at_s,
            stamp_to_s=at_s,
            displacement_m=shift.displacement_m,
            rotation_rad=shift.rotation_rad,
        )
        for change, shift in zip(before, job.shifts, strict=True)
    ]


def run_job(job: Job, data: Path, reference: Reference) -> tuple[Row, SlamResult | None]:
    """Run, and score; the row holds plain JSON values only.

    A method that finds no optimum is a row without scores and with the `failure`, and no result.
    """
    from evermap.pipeline import run_slam

    original = recording_of(data, job.dataset, job.robot)
    recording, prior, landmarks = inputs_of(job, original, reference)
    config = job.config()
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        result = run_slam(replace(recording, truth=None, true_landmarks=None), config, prior_map=prior)
    except (DataError, NumericalError) as error:
        return {**job.key, **NOTHING, "failure": error.one_line(), "commit": commit_of_code()}, None
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    if result.interrupted:
        raise KeyboardInterrupt
    at = Landmarks.at(landmarks.landmark_id, landmarks.position_m)
    row = {
        **job.key,
        **NOTHING,
        **run_scores(recording, result, reference.trajectory, original.truth, at),
        **change_scores(true_changes(job, original), result, original, job.during),
        "places": places_of(result),
        "commit": commit_of_code(),
        "recording_s": float(np.ptp(recording.frames.stamp_s)),
        "frames": len(result.step_s),
        "wall_s": wall,
        "cpu_s": cpu,
        "step_p99_ms": float(np.percentile(1e3 * result.step_s, 99)),
    }
    return row, result


def places_of(result: SlamResult) -> list[Row]:
    """Return where each landmark was by the run, a row a place: the last one, and those that its changes led from.

    Nothing of a landmark that is at one place all the time.
    """
    found: list[Row] = []
    for identity, position_m in zip(
        result.landmarks.landmark_id.tolist(), result.landmarks.position_m.tolist(), strict=True
    ):
        trail = [position_m]
        for change in reversed(result.changes):
            if identity in change.landmark_ids:
                trail.append([at - by for at, by in zip(trail[-1], change.displacement_m, strict=True)])
        distinct = {tuple(round(float(at), PLACE_DECIMALS) for at in place) for place in trail}
        found += [{"landmark": identity, "at_m": list(place)} for place in sorted(distinct)] if len(trail) > 1 else []
    return found


def warm_up(jobs: Sequence[Job], data: Path) -> None:
    """Compile what is compiled once, so that no timing contains it: the start of a recording by every method."""
    from evermap.pipeline import run_slam
    from evermap_studies.mrclam.study import first_frames

    for job in {(job.sensor, job.method): job for job in jobs}.values():
        recording = recording_of(data, job.dataset, job.robot)
        run_slam(first_frames(recording, 60), job.config(), prior_map=survey_of(recording))


def poses_at(trajectory: Trajectory, stamp_s: FloatArray) -> FloatArray:
    """(F, 3) poses at the frames; those before the first and after the last are held."""
    inside = np.clip(stamp_s, trajectory.stamp_s[0], trajectory.stamp_s[-1])
    return interpolate(trajectory, inside)[0]
