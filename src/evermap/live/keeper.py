"""Parallel work of an engine: readings to the disk, sessions into the map, threads and processes."""

from __future__ import annotations

import json
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from evermap.compiled import single_threaded
from evermap.config import Config
from evermap.errors import EvermapError, InputError
from evermap.live.inbox import Inbox
from evermap.live.spool import Brought, Spool, enter_waiting
from evermap.maps.living import LivingMap
from evermap.maps.store import open_store
from evermap.runs.sessions import Entered
from evermap.types import Clock, MapChange


@dataclass
class News:
    """Outputs of the next step, and changes reported since the newest revision."""

    changes: list[MapChange] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    known: set[tuple[Any, ...]] = field(default_factory=set)

    def add(self, changes: Sequence[MapChange]) -> None:
        """Add unreported changes."""
        for change in changes:
            if (key := (change.kind, change.landmark_ids)) not in self.known:
                self.known.add(key)
                self.changes.append(change)

    def taken(self) -> tuple[tuple[MapChange, ...], tuple[str, ...]]:
        """Return changes and warnings, once."""
        changes, warnings = tuple(self.changes), tuple(self.warnings)
        self.changes, self.warnings = [], []
        return changes, warnings


class Keeper:
    """The sessions of a map file, including the current one.

    Of a map in memory, without a path, nothing is kept; without `threads` everything is done at once.
    """

    def __init__(self, path: Path | None, config: Config, inbox: Inbox, told: News, *, threads: bool) -> None:
        self._path, self._config, self._inbox, self._told = path, config, inbox, told
        self._pool = ThreadPoolExecutor(2, "evermap-live") if threads else None
        self._jobs: dict[str, Future[None]] = {}
        self._spool: Spool | None = None
        self._child: subprocess.Popen[str] | None = None
        self._waits = False
        self._written_s = time.monotonic()
        self._name, self.n_sessions = inbox.name, 1
        self.revision = 0
        """Newest revision that was read."""

    @property
    def file(self) -> Path:
        """The map.

        Raises:
            InputError: it is in memory.
        """
        if self._path is None:
            raise InputError("a map in memory cannot be changed", field="map", hint="a file, or mapping=False")
        return self._path

    def begin(self, living: LivingMap | None, clock: Clock, *, dim: int, mapping: bool) -> LivingMap:
        """Return the map, of the file where it is not in memory, and feed it where that is wanted.

        Raises:
            InputError: no map, or one that cannot be driven in.
            ConfigError: another process feeds it.
        """
        if mapping:
            if living is None and self.file.exists():
                open_store(self.file, create=True).close()  # what is no map gets nothing beside it
            self.feed()
        try:
            living = self.load(create=mapping)[0] if living is None else living
            _check_fits(living, clock, dim)
        except EvermapError:
            self.close()
            raise
        return living

    def feed(self) -> None:
        """Feed the map from here on; what a process that was killed has left is entered first."""
        if self._spool is not None:
            return
        self._spool = Spool(self.file)
        for brought in enter_waiting(self.file, self._config):
            if not brought.problem:
                self._told.warnings.append(f"recovered from {brought.name}, whose process ended before it was entered")
            self._take(brought)
        self._spool.settle(self._config)

    def load(self, *, create: bool) -> tuple[LivingMap, list[MapChange]]:
        """Read the newest map, and what has changed since the revision that was read before."""
        with open_store(self.file, create=create) as store:
            head, before = store.head(), self.revision
            changes = [change for number in range(before + 1, head + 1) for change in store.changes(number)]
            self.revision = head
            return store.load(head), changes

    def beside(self, name: str, job: Callable[[], None]) -> None:
        """Run a job in parallel to the steps, unless it still runs."""
        before = self._jobs.get(name)
        if self._pool is None:
            job()
        elif before is None or before.done():
            self._jobs[name] = self._pool.submit(single_threaded()(job))

    def collect(self) -> bool:
        """Collect the results of parallel jobs; returns whether sessions were entered."""
        for name, job in list(self._jobs.items()):
            if not job.done():
                continue
            del self._jobs[name]
            if (error := job.exception()) is not None:
                known = isinstance(error, EvermapError | OSError)
                defect = "" if known else f"a bug in evermap: {type(error).__name__}: "
                self._told.warnings.append(f"{name}: {defect}{error}")
        if self._child is None or self._child.poll() is None:
            return False
        child, self._child = self._child, None
        for line in child.communicate()[0].splitlines():
            self._take(Brought(**json.loads(line)))
        if child.returncode:
            self._told.warnings.append(f"entering a session ended with code {child.returncode}; its readings are kept")
        return True

    def write_if_due(self) -> None:
        """Put readings on the disk if it is time."""
        if self._spool is not None and time.monotonic() >= self._written_s + self._config.live.checkpoint_s:
            self._written_s = time.monotonic()
            self.beside("write", self._write)

    def end_session(self) -> None:
        """End the session of the readings so far: it waits to be entered."""
        if self._spool is None or not len(self._inbox):
            return
        if "write" in self._jobs:
            self._jobs.pop("write").result()
        self._write(last=True)
        self._spool.finish()
        self.n_sessions, self._waits = self.n_sessions + 1, True
        self._inbox.cut(f"{self._name} {self.n_sessions}")

    def enter_if_waiting(self) -> bool:
        """Enter waiting sessions in parallel; returns whether that is done already."""
        if not self._waits or self._spool is None or self._child is not None:
            return False
        self._waits = False
        if self._pool is None:
            self.enter(self.file)
            return True
        self._child = self._spool.enter_beside()
        return False

    def enter(self, file: Path) -> Entered | None:
        """Enter sessions that wait, now; returns what the last of them made of the map."""
        entered = None
        for brought in enter_waiting(file, self._config):
            self._take(brought)
            entered = brought.entered or entered
        return entered

    def wait(self, lock: threading.RLock) -> None:
        """Wait for parallel jobs, which may need the lock."""
        while self._child is not None or self._jobs:
            if self._child is not None:
                self._child.wait()
            lock.release()
            try:
                for job in list(self._jobs.values()):
                    job.exception()
            finally:
                lock.acquire()
            self.collect()

    def close(self) -> None:
        """Let others feed the map; the readings that wait are entered by the next that does."""
        if self._pool is not None:
            self._pool.shutdown()
        if self._spool is not None:
            if len(self._inbox):
                self._write(last=True)
            self._spool.close()
            self._spool = None

    def _write(self, *, last: bool = False) -> None:
        if self._spool is not None:
            part = self._inbox.written(last=last)
            if len(part.odometry) or len(part.frames):
                self._spool.write(part)

    def _take(self, brought: Brought) -> None:
        if brought.problem:
            self._told.warnings.append(f"{brought.name}: not entered: {brought.problem}")
        if brought.damage:
            self._told.warnings.append(f"{brought.name}: {brought.damage}")


def _check_fits(living: LivingMap, clock: Clock, dim: int) -> None:
    """Raise `InputError` for a map of another clock, or in space where the sensor is in the plane, or the reverse."""
    if living.dim != dim and (len(living.places) or dim == 2):
        of = {2: "in the plane", 3: "in space"}
        instead = {2: "evermap.types.SpatialSensor", 3: "evermap.Sensor"}[dim]
        raise InputError(f"a map {of[5 - dim]}, the sensor is {of[dim]}", field="map", hint=instead)
    if len(living.places) and living.clock != clock:
        problem = f"stamps are on the clock '{clock}', those of the map on '{living.clock}'"
        hint = f"clock = '{living.clock}' in sensor.toml, or evermap.Engine(..., clock='{living.clock}')"
        raise InputError(problem, field="clock", hint=hint)
