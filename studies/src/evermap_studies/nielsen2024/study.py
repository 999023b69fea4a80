"""Section 8 of Nielsen and Hendeby: Hypothesis selection with Monte Carlo tree search (2024), and what it lacks.

That is the joint search, changes during a run, changes of other kinds, and probabilities that mean what they say.
Four parts, each of which can be run alone: what an older run left in the folder of the other parts, data sets and
methods stays in the tables. Every run is kept at once in a file beside the folder (`evermap_studies.rows`), from which
a study that was ended goes on; each row says of which commit its code is.
"""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from evermap.compiled import find_place
from evermap.errors import EvermapError
from evermap.interrupts import watched
from evermap.types import Progress, SlamResult
from evermap_studies.frame import Stopwatch
from evermap_studies.nielsen2024.figures import draw_all
from evermap_studies.nielsen2024.plan import METHODS, PARTS, QUICK, Settings, jobs
from evermap_studies.nielsen2024.runs import (
    NOTHING,
    Job,
    Reference,
    recording_of,
    reference_of,
    run_job,
    survey_of,
    warm_up,
)
from evermap_studies.nielsen2024.simulation import BUDGET_NOISE_M2, budget_rows, selector_rows, slam_rows
from evermap_studies.nielsen2024.table import as_markdown, verdicts
from evermap_studies.rows import RowsFile, commit_of_code
from evermap_studies.workers import sheltered

Row = dict[str, Any]

SCHEMA_VERSION = "1"
EXPERIMENT = "nielsen2024"
SCORING = (
    "no alignment: the map gives the frame; poses at 2 Hz against the truth (data set 6) or against a trajectory "
    "smoothed with the true landmarks (1, 2, 3; of 3 the last 466 s also against the truth); landmarks seen ten times "
    "or more"
)
PATHS = "paths.json"
_DRAWN_DELTA_M = {6: 1.0, 1: 1.0, 2: 2.1, 3: 1.0}
_PATH_STEP_S = 0.5


def reproduce(
    data: str | Path,
    out: str | Path,
    settings: Settings | None = None,
    *,
    progress: Progress | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Run what is asked for, and write `summary.json`, `table.md` and the figures of all that is known by then.

    Args:
        data: folder with the MRCLAM recordings.
        out: folder; rows of an older run that were not asked for are kept, all else is replaced. Untouched if this
            run fails; an interrupt keeps what was done.
        settings: everything where None. What the file beside the folder has is not run again.
        progress: told after every run.
        force: write into a folder that holds other files, too; they stay.

    Returns:
        `simulation` and `runs` (a dictionary each), `expected`, `settings`, `machine`; plain JSON values.

    Raises:
        InputError: a recording is missing or malformed.
        ConfigError: `out` must not be replaced.
    """
    from evermap.runs.folder import RunFolder

    settings = settings or Settings()
    earlier, paths = _earlier(Path(out))
    kept = RowsFile.beside(out)
    done: dict[tuple[Any, ...], Row] = {}
    for line in kept.read():
        done[_key(line["row"])] = line["row"]
        paths |= line["paths"]
    planned = [job for job in jobs(settings, Path(data)) if _key(job.key) not in done]
    with RunFolder(out, force=force, inputs=[data]) as folder:
        stopwatch = Stopwatch()
        simulation = earlier["simulation"]
        if "simulation" in settings.parts:
            asked = (settings.noises_m2, settings.runs, settings.modes, settings.seed)
            simulation = [*selector_rows(*asked), *slam_rows(*asked), *budget_rows(BUDGET_NOISE_M2, *asked[1:])]
            simulation = [{**row, "commit": commit_of_code()} for row in simulation]
        interrupted = False
        try:
            with watched() as watch:
                for job, row, path in _run_all(planned, Path(data), settings.processes, progress):
                    done[_key(row)] = row
                    drawn = {} if path is None else {_path_key(job): path}
                    paths |= drawn
                    kept.add({"row": row, "paths": drawn})
                    watch.stop_if_asked()
        except KeyboardInterrupt:
            if not done:
                raise
            interrupted = True
        runs = _merged(earlier["runs"], done.values())
        table: dict[str, Any] = {
            **stopwatch.head(EXPERIMENT, SCHEMA_VERSION, SCORING, settings),
            "expected": verdicts(simulation, runs),
            "simulation": simulation,
            "runs": runs,
        }
        draw_all(simulation, runs, paths, folder.path)
        folder.path("table.md").write_text(as_markdown(table) + "\n", encoding="utf-8")
        folder.path(PATHS).write_text(json.dumps(paths, sort_keys=True) + "\n", encoding="utf-8")
        table = folder.finish(table)
    if interrupted:
        raise KeyboardInterrupt(f"{len(done)} runs were done; they are in {out}, and go on from {kept.path}")
    kept.remove()
    return table


def _run_all(
    planned: list[Job], data: Path, processes: int, progress: Progress | None
) -> Iterator[tuple[Job, Row, Row | None]]:
    """All runs, recording by recording; references first."""
    total_s = sum(job.duration_s for job in planned)
    done_s = 0.0
    for job, row, path in _serial(planned, data) if processes == 1 else _parallel(planned, data, processes):
        done_s += job.duration_s
        if progress is not None:
            progress(done_s, total_s)
        yield job, row, path


def _serial(planned: list[Job], data: Path) -> Iterator[tuple[Job, Row, Row | None]]:
    if planned:
        with suppress(EvermapError):  # what is wrong with all of it will show
            warm_up(planned, data)
    references: dict[tuple[int, int], Reference] = {}
    for job in planned:
        source = job.dataset, job.robot
        if source not in references:
            references = {source: reference_of(data, *source)}  # runs of a recording follow each other: keep one
        yield job, *_run(job, data, references[source])


def _parallel(planned: list[Job], data: Path, processes: int) -> Iterator[tuple[Job, Row, Row | None]]:
    """In processes that are started afresh: what was compiled is read from disk, nothing is shared."""
    find_place()
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool, watched() as watch:
        try:
            sources = list(dict.fromkeys((job.dataset, job.robot) for job in planned))
            with sheltered():
                found = {source: pool.submit(reference_of, data, *source) for source in sources}
            references = {source: future.result() for source, future in found.items()}
            waiting = {pool.submit(_run, job, data, references[job.dataset, job.robot]): job for job in planned}
            while waiting:
                for future in wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED).done:
                    yield waiting.pop(future), *future.result()
                watch.stop_if_asked()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _run(job: Job, data: Path, reference: Reference) -> tuple[Row, Row | None]:
    """A row, and what a figure of trajectories needs where the run is in one."""
    row, result = run_job(job, data, reference)
    drawn = job.part == "recordings" and job.delta_m == _DRAWN_DELTA_M[job.dataset]
    return row, _path(result, reference, job, data) if drawn and result is not None else None


def _path(result: SlamResult, reference: Reference, job: Job, data: Path) -> Row:
    """Estimate and reference, thinned out, with the landmarks: what is drawn."""
    truth = survey_of(recording_of(data, job.dataset, job.robot))
    stamps = result.trajectory.stamp_s
    rows = np.unique(np.searchsorted(stamps, np.arange(stamps[0], stamps[-1], _PATH_STEP_S)))
    known = np.searchsorted(reference.trajectory.stamp_s, stamps[rows])
    known = np.unique(np.clip(known, 0, len(reference.trajectory) - 1))
    return {
        "estimate_m": np.round(result.trajectory.pose_world_robot[rows, :2], 3).tolist(),
        "reference_m": np.round(reference.trajectory.pose_world_robot[known, :2], 3).tolist(),
        "delta_m": job.delta_m,
        "landmarks_m": np.round(result.landmarks.position_m, 3).tolist(),
        "true_landmarks": dict(
            zip(map(str, truth.landmark_id.tolist()), np.round(truth.position_m, 3).tolist(), strict=True)
        ),
    }


def _path_key(job: Job) -> str:
    return f"{job.scenario} {job.sensor} {job.method} dataset {job.dataset} robot {job.robot}"


def _earlier(out: Path) -> tuple[dict[str, list[Row]], dict[str, Row]]:
    """Rows and paths that an older run left; nothing where there is none of this schema."""
    nothing: dict[str, list[Row]] = {"simulation": [], "runs": []}
    try:
        table = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        paths = json.loads((out / PATHS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return nothing, {}
    if table.get("experiment") != EXPERIMENT or table.get("schema_version") != SCHEMA_VERSION:
        return nothing, {}
    known = [row for row in table["runs"] if NOTHING.keys() <= row.keys()]  # others are of an older evermap
    return {"simulation": table["simulation"], "runs": known}, paths


def _merged(earlier: Iterable[Row], done: Iterable[Row]) -> list[Row]:
    """The rows done, and those of earlier runs that were not done again; in a fixed order."""
    rows = {_key(row): row for row in (*earlier, *done)}
    return [rows[key] for key in sorted(rows)]


def _key(row: Row) -> tuple[Any, ...]:
    return (
        PARTS.index(row["part"]), row["scenario"], row["dataset"], row["sensor"], METHODS.index(row["method"]),
        row["delta_m"], row["robot"],
    )  # fmt: skip


__all__ = ["QUICK", "Settings", "as_markdown", "reproduce"]
