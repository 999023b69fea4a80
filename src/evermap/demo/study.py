"""The experiment: map a building once, live with that map for days, and compare with two ways that do not age.

Three series over the same patrols:

* `changed`: the map of the first session is believed in all later ones, while the building changes;
* `unchanged`: the same, in a building where nothing changes: same robot, same drive, same noise;
* `from_scratch`: the changing building again, mapped anew in every session: no memory, so nothing to be wrong about.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from evermap.demo.scenario import Scenario
from evermap.sim import BuildingSimulation
from evermap.types import Landmarks, Recording, SlamResult

if TYPE_CHECKING:
    from evermap.config import Config
    from evermap.metrics.summary import Evaluation

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
SERIES = ("changed", "unchanged", "from_scratch")
Progress = Callable[[float, float], None]
"""Called with seconds of recordings that are done, and seconds in all."""


@dataclass(frozen=True, slots=True)
class Visit:
    """One session, estimated and compared with the truth."""

    recording: Recording
    result: SlamResult
    evaluation: Evaluation


@dataclass(frozen=True, slots=True)
class Study:
    """Both buildings and what was estimated in them: by series, one visit a session."""

    scenario: Scenario
    changed: BuildingSimulation
    unchanged: BuildingSimulation
    visits: dict[str, tuple[Visit, ...]]


@dataclass(frozen=True, slots=True)
class _Job:
    """One run of the estimator: which series and session, and with which map."""

    series: str
    session: int
    recording: Recording
    prior_map: Landmarks | None = None


def run_study(
    scenario: Scenario, seed: int, config: Config, *, processes: int = 1, progress: Progress | None = None
) -> Study:
    """Simulate, estimate, compare.

    Args:
        scenario: how much.
        seed: of the simulation.
        config: of the estimator.
        processes: how many runs at a time; above 1 a script that calls this needs its `__main__` guard.
        progress: told after every run.

    Raises:
        KeyboardInterrupt: nothing is kept of a comparison that is not finished.
    """
    changed, unchanged = scenario.simulate(seed)
    buildings = {"changed": changed, "unchanged": unchanged}
    last = range(1, scenario.sessions)
    results: dict[tuple[str, int], SlamResult] = {}
    total_s = scenario.patrol_s * (3 * scenario.sessions - 1)

    def run_all(jobs: list[_Job], executor: Executor | None) -> None:
        for job, result in _run(jobs, config, executor):
            results[job.series, job.session] = result
            if progress is not None:
                progress(len(results) * scenario.patrol_s, total_s)

    with _workers(processes) as executor:
        run_all([_Job(name, 0, world.sessions[0]) for name, world in buildings.items()], executor)
        jobs = [_Job("from_scratch", k, changed.sessions[k]) for k in last]
        jobs += [
            _Job(name, k, world.sessions[k], results[name, 0].landmarks)
            for k in last
            for name, world in buildings.items()
        ]
        run_all(jobs, executor)
    results["from_scratch", 0] = results["changed", 0]  # the first session has no memory in any case
    buildings["from_scratch"] = changed
    visits = {
        name: tuple(_visit(recording, results[name, k]) for k, recording in enumerate(buildings[name].sessions))
        for name in SERIES
    }
    return Study(scenario, changed, unchanged, visits)


def _visit(recording: Recording, result: SlamResult) -> Visit:
    from evermap.metrics.summary import compare_with_truth

    return Visit(recording, result, compare_with_truth(recording, result))


def _run(jobs: list[_Job], config: Config, executor: Executor | None) -> Iterator[tuple[_Job, SlamResult]]:
    """Jobs with their results, in the order in which they finish."""
    blind = [replace(job, recording=replace(job.recording, truth=None, true_landmarks=None)) for job in jobs]
    if executor is None:
        for job in blind:
            yield job, _estimate(job, config)
        return
    pending: dict[Future[SlamResult], _Job] = {executor.submit(_estimate, job, config): job for job in blind}
    for done in as_completed(pending):
        yield pending[done], done.result()


def _estimate(job: _Job, config: Config) -> SlamResult:
    from evermap.pipeline import run_slam

    result = run_slam(job.recording, config, prior_map=job.prior_map)
    if result.interrupted:
        raise KeyboardInterrupt
    return result


@contextmanager
def _workers(processes: int) -> Iterator[Executor | None]:
    """Processes to run in, or None for this one. An interrupt drops what waits and lets what runs end."""
    if processes <= 1:
        yield None
        return
    import multiprocessing
    import os

    # one thread each: the linear algebra of two processes would fight over two cores. Read when a worker starts.
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    context = multiprocessing.get_context("spawn")  # a fork would copy locks of threads that it does not copy
    with ProcessPoolExecutor(processes, mp_context=context, initializer=_ignore_interrupts) as executor:
        try:
            yield executor
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _ignore_interrupts() -> None:
    """Ctrl-C reaches every process of a terminal; the parent decides."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
