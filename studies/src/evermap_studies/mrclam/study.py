"""All robots of the UTIAS MRCLAM recordings, from an unknown map and in a given one, compared with the truth.

Leung, Halpern, Barfoot, Liu: The UTIAS Multi-Robot Cooperative Localization and Mapping Dataset, IJRR 30(8), 2011.
Every robot is run on its own, one run after the other in this process, so that nothing disturbs the timings.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap import __version__
from evermap.errors import EvermapError, InputError
from evermap.types import Landmarks, Progress, Recording, rows_of
from evermap_studies.frame import machine
from evermap_studies.mrclam.figure import Drawn, draw_robots
from evermap_studies.mrclam.scores import bound_scores, odometry_scores, run_scores
from evermap_studies.mrclam.table import as_markdown, means, verdicts

if TYPE_CHECKING:
    from evermap.config import Config
    from evermap.runs.folder import RunFolder


SCHEMA_VERSION = "1"
PRIOR_SIGMA_M = 0.02
MAIN, OTHERS = 6, (3, 1, 2)
"""Dataset 6 has the whole truth. Of 3 the last part is known, of 1 and 2 the landmarks only."""
SCORING = (
    "SE(2) alignment of each trajectory on its own positions, then RMSE at 2 Hz over all stamps that have truth; "
    "landmarks with at least ten sightings, after the alignment of the trajectory where poses are known"
)
_WARM_UP_FRAMES = 60


@dataclass(frozen=True, slots=True)
class Setting:
    """One way to run a recording."""

    name: str
    sensor_model: str
    given_map: bool = False

    def config(self) -> Config:
        """Defaults but for the sensor model."""
        from evermap.config import load_config

        return load_config(None, [f"slam.sensor_model={self.sensor_model}", "slam.online=true"])


SETTINGS = (
    Setting("calibrated", "calibrated"),
    Setting("plain", "plain"),
    Setting("true_map", "calibrated", given_map=True),
)


@dataclass(frozen=True, slots=True)
class Job:
    """One robot of one data set."""

    dataset: int
    robot: int
    recording: Recording

    @property
    def settings(self) -> tuple[Setting, ...]:
        """Without true poses a run in the true map has nothing to be compared with."""
        return tuple(setting for setting in SETTINGS if self.recording.truth is not None or not setting.given_map)

    @property
    def duration_s(self) -> float:
        """How long the sensor looked [s]."""
        return float(np.ptp(self.recording.frames.stamp_s))


def reproduce(
    data: str | Path,
    out: str | Path,
    *,
    progress: Progress | None = None,
    everything: bool = False,
    force: bool = False,
) -> dict[str, Any]:
    """Run all robots in all settings, write the runs, the table and a figure, and return the table.

    Args:
        data: folder with `MRCLAM_Dataset6` (zip or folder), and the others where `everything` is wanted.
        out: folder for `summary.json` (the table), `table.md`, `mrclam.png` and `runs/`; replaced if it holds an
            older reproduction, untouched if this one fails.
        progress: told as the runs advance.
        everything: also the data sets 3, 1 and 2, of which less truth is known.
        force: write into a folder that holds other files, too; they stay.

    Returns:
        `rows` (a dictionary a robot and setting), `means` (the same over robots), `expected` (what was promised, what
        came out), `machine` and `scoring`; plain JSON values, None where something is unknown.

    Raises:
        InputError: a recording is missing or malformed.
        ConfigError: `out` must not be replaced.
        DataError: nothing can be estimated from a recording.
    """
    from evermap.runs.folder import RunFolder

    jobs = list(_jobs(Path(data), (MAIN, *OTHERS) if everything else (MAIN,)))
    with RunFolder(out, force=force, inputs=[data]) as folder:
        _warm_up(jobs[0].recording)
        ledger = _run_all(jobs, folder, progress)
        table: dict[str, Any] = {
            "schema_version": SCHEMA_VERSION,
            "evermap": __version__,
            "experiment": "mrclam",
            "scoring": SCORING,
            "machine": machine(ledger.cpu_s / ledger.wall_s),
            "processing_s": ledger.wall_s,
            "expected": verdicts(ledger.rows, MAIN),
            "means": means(ledger.rows),
            "rows": ledger.rows,
        }
        draw_robots(ledger.drawn, folder.path("mrclam.png"))
        folder.path("table.md").write_text(as_markdown(table) + "\n", encoding="utf-8")
        return folder.finish(table)


def _jobs(data: Path, datasets: tuple[int, ...]) -> Iterator[Job]:
    from evermap.io import list_robots, read_planar

    for dataset in datasets:
        path = find_dataset(data, dataset)
        for robot in list_robots(path):
            recording = read_planar(path, robot=robot)
            yield Job(dataset, robot, recording)


def find_dataset(data: Path, dataset: int) -> Path:
    """Zip or unpacked folder of a data set.

    Raises:
        InputError: neither is in `data`.
    """
    name = f"MRCLAM_Dataset{dataset}"
    for path in (data / f"{name}.zip", data / name):
        if path.exists():
            return path
    problem = f"no {name}.zip and no folder {name} here"
    raise InputError(problem, path=data, hint="--data FOLDER with the recordings as their authors distribute them")


@dataclass
class _Ledger:
    """What the runs leave behind: rows of the table, the default runs of the main data set, time spent [s]."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    drawn: list[Drawn] = field(default_factory=list)
    wall_s: float = 0.0
    cpu_s: float = 0.0
    done_s: float = 0.0


def _run_all(jobs: list[Job], folder: RunFolder, progress: Progress | None) -> _Ledger:
    """One run after the other; every run also leaves its own folder in `runs/`."""
    ledger = _Ledger()
    total_s = sum(job.duration_s * len(job.settings) for job in jobs)
    for job in jobs:
        for setting in job.settings:
            report = _shifted(progress, ledger.done_s, total_s)
            _run_one(job, setting, folder, ledger, report)
            ledger.done_s += job.duration_s
    return ledger


def _run_one(job: Job, setting: Setting, folder: RunFolder, ledger: _Ledger, progress: Progress | None) -> None:
    from evermap.metrics.summary import compare_with_truth
    from evermap.pipeline import run_slam
    from evermap.runs.folder import write_run
    from evermap.runs.summary import RunInfo

    recording, config = job.recording, setting.config()
    prior = _survey(recording) if setting.given_map else None
    wall, cpu = time.perf_counter(), time.process_time()
    result = run_slam(recording, config, prior_map=prior, progress=progress)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    if result.interrupted:
        raise KeyboardInterrupt("nothing was written; a reproduction is whole or not at all")
    ledger.wall_s += wall
    ledger.cpu_s += cpu
    evaluation = compare_with_truth(recording, result)
    key = {"dataset": job.dataset, "robot": job.robot}
    ledger.rows.append({**key, "setting": setting.name, **run_scores(recording, result, evaluation, wall)})
    if setting is SETTINGS[0]:
        ledger.rows[-1] |= bound_scores(recording, result)
        if recording.truth is not None:
            ledger.rows.append({**key, "setting": "odometry", **odometry_scores(recording, evaluation)})
        if job.dataset == MAIN:
            ledger.drawn.append(Drawn(job.robot, recording, result, evaluation))
    name = f"runs/dataset{job.dataset}-robot{job.robot}-{setting.name}"
    info = RunInfo(command="evermap reproduce mrclam", seeds={"slam": config.slam.seed}, processing_s=wall)
    write_run(folder.path(name), recording, result, config, info=info, figures=False, report=False, scene=False)


def _shifted(progress: Progress | None, done_s: float, total_s: float) -> Progress | None:
    """Progress of one run as a part of all."""
    return None if progress is None else lambda now_s, _: progress(done_s + now_s, total_s)


def _survey(recording: Recording) -> Landmarks:
    """The surveyed landmarks as a map to localise in."""
    survey = recording.true_landmarks
    assert survey is not None
    return Landmarks.at(survey.landmark_id, survey.position_m, sigma_m=PRIOR_SIGMA_M, frame="prior_map")


def _warm_up(recording: Recording) -> None:
    """The beginning of a recording in every setting: compiles what is compiled once, so that no timing contains it."""
    from evermap.pipeline import run_slam

    short = first_frames(recording, _WARM_UP_FRAMES)
    for setting in SETTINGS:
        with suppress(EvermapError):  # too little to say anything; what is wrong with all of it will show
            run_slam(short, setting.config(), prior_map=_survey(recording) if setting.given_map else None)


def first_frames(recording: Recording, count: int) -> Recording:
    """The beginning of a recording."""
    frames, detections = recording.frames, recording.detections
    return replace(
        recording,
        frames=replace(frames, stamp_s=frames.stamp_s[:count]),
        detections=rows_of(detections, detections.frame < count),
    )


__all__ = ["SETTINGS", "Setting", "as_markdown", "find_dataset", "first_frames", "reproduce"]
