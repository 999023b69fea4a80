"""The experiment: the same recordings through every method, session after session into one map each."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evermap.types import IntArray, MapChange, Progress, Recording, SlamResult, Trajectory
from evermap_studies.demo.methods import METHODS, Method
from evermap_studies.demo.scenario import Scenario
from evermap_studies.demo.scores import Snapshot
from evermap_studies.demo.truth import Truth, truth_of
from evermap_studies.sim import BuildingSimulation
from evermap_studies.workers import sheltered

if TYPE_CHECKING:
    from evermap.config import Config, LivingConfig
    from evermap.maps.living import LivingMap
    from evermap.maps.sessions.session import Session


@dataclass(frozen=True, slots=True)
class Visit:
    """One session of one method.

    Attributes:
        path: where the robot was, in the frame of the method's map.
        found: whether the session was found in the map; else the path is in a frame of its own.
        snapshot: what the map said afterwards.
        changes: what it says has changed.
        cpu_s: time of the processor.
    """

    path: Trajectory
    found: bool
    snapshot: Snapshot
    changes: tuple[MapChange, ...]
    cpu_s: float


@dataclass(frozen=True, slots=True)
class Study:
    """All that was simulated and estimated.

    Attributes:
        scenario, building, truth: the world.
        visits: by name of the method, one a session.
        living: evermap's map in the end.
        result: evermap's last session.
    """

    scenario: Scenario
    building: BuildingSimulation
    truth: Truth
    visits: dict[str, tuple[Visit, ...]]
    living: LivingMap
    result: SlamResult


@dataclass(frozen=True, slots=True)
class _Day:
    """A day's sessions of some methods: what a worker is asked to do.

    Attributes:
        recordings: the day's, without truth.
        changed: for each, landmarks that changed since the session before; only the oracle looks at it.
        until_s: for each, when the next session begins; nan where there is none.
        methods: which.
        living: the map of each on the evening before, None on the first day.
        store: file that gets evermap's map, a revision a session; None for none.
    """

    recordings: tuple[Recording, ...]
    changed: tuple[IntArray, ...]
    until_s: tuple[float, ...]
    methods: tuple[Method, ...]
    living: tuple[LivingMap | None, ...]
    store: Path | None


@dataclass(frozen=True, slots=True)
class _Evening:
    """What a worker answers for one method: the day's visits, the map, and the last session."""

    visits: tuple[Visit, ...]
    living: LivingMap
    result: SlamResult


def run_study(
    scenario: Scenario,
    seed: int,
    *,
    methods: tuple[Method, ...] = METHODS,
    store: Path | None = None,
    processes: int = 1,
    progress: Progress | None = None,
) -> Study:
    """Simulate, and estimate in every way.

    Args:
        scenario: how much.
        seed: of the simulation.
        methods: which; evermap among them.
        store: file that gets evermap's map, a revision a session.
        processes: between how many the methods are divided; above 1 a script that calls this needs its `__main__`
            guard.
        progress: told after every day of some methods.

    Raises:
        KeyboardInterrupt: nothing is kept of a comparison that is not finished.
    """
    building = scenario.simulate(seed)
    truth = truth_of(building)
    visits: dict[str, list[Visit]] = {method.name: [] for method in methods}
    evening: dict[str, _Evening] = {}
    length_s = [float(np.ptp(session.frames.stamp_s)) for session in building.sessions]
    total_s = sum(length_s) * len(methods)
    done_s = 0.0

    def next_day(some: tuple[Method, ...]) -> _Day:
        first = len(visits[some[0].name])
        rows = range(first, first + scenario.sessions_per_day)
        return _Day(
            # the estimator sees no truth
            recordings=tuple(replace(building.sessions[k], truth=None, true_landmarks=None) for k in rows),
            changed=tuple(np.flatnonzero(truth.changed[k]) for k in rows),
            until_s=tuple(building.truths[k + 1].start_s if k + 1 < len(truth) else np.nan for k in rows),
            methods=some,
            living=tuple(evening[method.name].living if first else None for method in some),
            store=store,
        )

    parts = min(processes, len(methods))
    with _workers(parts) as submit:
        running = {submit(next_day(methods[part::parts])): methods[part::parts] for part in range(parts)}
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                some = running.pop(future)
                for method, answer in zip(some, future.result(), strict=True):
                    evening[method.name] = answer
                    visits[method.name] += answer.visits
                now = len(visits[some[0].name])
                done_s += sum(length_s[now - scenario.sessions_per_day : now]) * len(some)
                if progress is not None:
                    progress(done_s, total_s)
                if len(visits[some[0].name]) < scenario.sessions:
                    running[submit(next_day(some))] = some
    return Study(
        scenario=scenario,
        building=building,
        truth=truth,
        visits={name: tuple(series) for name, series in visits.items()},
        living=evening["evermap"].living,
        result=evening["evermap"].result,
    )


@functools.cache
def _compile() -> None:
    """Live through a few short patrols with every method, so that no session that is timed compiles kernels.

    Once in a process; afterwards all that sessions call is compiled or loaded.
    """
    building = Scenario(days=3, patrol_lengths_s=(30.0,), change_rate=8.0, wing_opens_day=1).simulate(0)
    _live(_Day(building.sessions, (np.zeros(0, np.int64),) * 6, (np.nan,) * 6, METHODS, (None,) * len(METHODS), None))


def _live_through(day: _Day) -> tuple[_Evening, ...]:
    """A day of some methods; the same in a worker and here."""
    _compile()
    return _live(day)


def _live(day: _Day) -> tuple[_Evening, ...]:
    from evermap.maps.living import LivingMap
    from evermap.pipeline import bring_in, solve_alone

    config = [method.config() for method in day.methods]
    living = [LivingMap() if one is None else one for one in day.living]
    visits: list[list[Visit]] = [[] for _ in day.methods]
    results: dict[int, SlamResult] = {}
    for recording, changed, until_s in zip(day.recordings, day.changed, day.until_s, strict=True):
        begin_s = time.process_time()
        alone = solve_alone(recording, living[0], config[0])  # the same for all: they differ in what they do with it
        alone_s = time.process_time() - begin_s
        if alone.interrupted:
            raise KeyboardInterrupt
        for row, method in enumerate(day.methods):
            before = living[row].without(changed) if method.is_told else living[row]
            begin_s = time.process_time()
            session = bring_in(alone, before, config[row])
            cpu_s = alone_s + time.process_time() - begin_s
            living[row], results[row] = session.living, session.slam
            said = snapshot_of(session.living, config[row].living, until_s)
            visits[row].append(Visit(session.slam.trajectory, session.found, said, session.changes, cpu_s))
            if day.store is not None and method.name == "evermap":
                _keep(day.store, recording, session, config[row], cpu_s)
    return tuple(_Evening(tuple(visits[row]), living[row], results[row]) for row in range(len(day.methods)))


def snapshot_of(living: LivingMap, config: LivingConfig, until_s: float) -> Snapshot:
    """What a map says now and expects at `until_s`, nan for no forecast."""
    from evermap.maps.sessions.believe import aged

    site = np.searchsorted(living.sites.site_id, living.places.site_id)
    later = living.sites.p_here if np.isnan(until_s) else aged(living, config, until_s).p_here
    return Snapshot(
        landmarks=living.landmarks(),
        place_id=living.places.landmark_id,
        place_m=living.places.position_m,
        p_now=living.sites.p_here[site],
        p_next=later[site],
        n_sites=len(living.sites),
    )


def _keep(where: Path, recording: Recording, session: Session, config: Config, wall_s: float) -> None:
    """One more revision of the map's file."""
    from evermap.config import to_toml
    from evermap.maps.store import Provenance, open_store

    store = open_store(where, create=True)
    stamps = recording.frames.stamp_s
    provenance = Provenance(
        recording=recording.name,
        source=recording.source,
        config=to_toml(config),
        stamp_from_s=float(stamps[0]),
        stamp_to_s=float(stamps[-1]),
        wall_s=wall_s,
    )
    store.commit(session.living, provenance, session.changes, session.evidence, parent=store.head())


@contextmanager
def _workers(processes: int) -> Iterator[Callable[[_Day], Future[tuple[_Evening, ...]]]]:
    """Who lives through days: processes, or this one. An interrupt drops what waits and lets what runs end."""
    if processes <= 1:
        yield _at_once
        return
    import multiprocessing
    import os

    from evermap.compiled import THREAD_LIMITS, find_place

    # one thread each: the linear algebra of two processes would fight over two cores. Read when a worker starts.
    before = {name: os.environ.get(name) for name in THREAD_LIMITS}
    os.environ.update(dict.fromkeys(THREAD_LIMITS, "1"))
    find_place()
    context = multiprocessing.get_context("spawn")  # a fork would copy locks of threads that it does not copy
    with ProcessPoolExecutor(processes, mp_context=context) as executor:

        def submit(day: _Day) -> Future[tuple[_Evening, ...]]:
            with sheltered():
                return executor.submit(_live_through, day)

        try:
            yield submit
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


def _at_once(day: _Day) -> Future[tuple[_Evening, ...]]:
    done: Future[tuple[_Evening, ...]] = Future()
    done.set_result(_live_through(day))
    return done
