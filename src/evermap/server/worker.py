"""Workers that enter waiting sessions by the same code as `evermap map enter`, and the processes they run in."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Self

from evermap.config import Config
from evermap.errors import EvermapError
from evermap.maps.store import StaleRevisionError, StoreUnavailableError
from evermap.runs.replay import UnbridgedError
from evermap.runs.sessions import TwiceError, enter_session
from evermap.server.database import AWAY, MOST_TRIES, Database, Job, JobState
from evermap.server.sites import SiteStores
from evermap.server.uploads import recording_of
from evermap.types import SlamResult, VerdictKind

LEASE_S = 60.0
_PAUSE_S = 0.5
_OUTAGE_S = 2.0
_LONGEST_PAUSE_S = 60.0
"""Before a process is replaced that ends again and again within this time."""
_GRACE_S = 10.0
"""For a process to end before it is killed."""


@dataclass(frozen=True, slots=True)
class JobOutcome:
    """Result of a session.

    Attributes:
        state: entered, a repeat of one that is, rejected, set aside where it does not fit the map, or queued where the
            store did not answer.
        reason: why, or a remark.
        revision: that it is, or that it was tried with.
        verdict: how far its estimate can be trusted, '' without an estimate.
    """

    state: JobState
    reason: str = ""
    revision: int | None = None
    verdict: str = ""

    @property
    def text(self) -> str:
        """Verdict and reason in one line; '' without both."""
        return ": ".join(filter(None, (self.verdict, self.reason)))


class Worker:
    """Takes sessions from the queue, one after the other.

    Args:
        database: with the queue.
        sites: the maps.
        config: settings of the sessions.
        lease_s: time after which a session of a worker that was killed is taken by another.
    """

    def __init__(self, database: Database, sites: SiteStores, config: Config, lease_s: float = LEASE_S) -> None:
        self._database, self._sites, self._config, self._lease_s = database, sites, config, lease_s
        self.name = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(3)}"

    def run(self, told: Callable[[Job, JobOutcome], None], *, drain: bool = False) -> None:
        """Work until the process ends.

        Args:
            told: called after every session.
            drain: end as soon as nothing waits.
        """
        while True:
            try:
                job = self.step(told)
                if job is None and drain and not self._database.depth():
                    return
            except (*AWAY, StoreUnavailableError):  # a database that restarts
                time.sleep(_OUTAGE_S)
                continue
            if job is None:
                time.sleep(_PAUSE_S)

    def step(self, told: Callable[[Job, JobOutcome], None] = lambda *_: None) -> Job | None:
        """Work on one session; returns None where none waits."""
        claimed = self._database.claim(self.name, self._lease_s)
        if claimed is None:
            return None
        job, data = claimed
        with self._keep_lease(job):
            if job.tries >= MOST_TRIES:
                outcome = JobOutcome(JobState.REJECTED, f"{job.tries} workers crashed on it")
            else:
                outcome = self._enter(job, data)
        self._database.finish(
            job.id, self.name, outcome.state, outcome.reason, outcome.revision, verdict=outcome.verdict
        )
        told(job, outcome)
        if outcome.state is JobState.QUEUED:
            time.sleep(_OUTAGE_S)
        return job

    def _enter(self, job: Job, data: bytes) -> JobOutcome:
        try:
            recording = replace(recording_of(data, job.digest), robot=job.robot)
            while True:
                start = time.perf_counter()
                try:
                    with self._sites.store(job.site, create=True) as store:
                        head = store.head()
                        entered = enter_session(store, recording, self._config)
                        verdict = entered.session.slam.verdict
                        kind = "" if verdict is None else verdict.kind.value
                        if refusal := entered.refusal(self._config):
                            reason = verdict.message if verdict is not None and refusal == verdict.text else refusal
                            return JobOutcome(JobState.ASIDE, reason, entered.parent, kind)
                        took_s = time.perf_counter() - start
                        number = entered.commit(store, self._config, command="evermap work", wall_s=took_s)
                        return JobOutcome(JobState.ENTERED, _remark(entered.session.slam), number, kind)
                except StaleRevisionError:  # another process committed meanwhile: again, from the newest
                    continue
        except TwiceError as error:  # a worker died between the commit and saying so, or it came another way
            state = JobState.REPEAT if error.is_copy else JobState.ENTERED
            return JobOutcome(state, error.problem, error.revision)
        except UnbridgedError as error:
            return JobOutcome(JobState.ASIDE, error.problem, head)
        except StoreUnavailableError as error:
            return JobOutcome(JobState.QUEUED, error.problem)
        except EvermapError as error:
            return JobOutcome(JobState.REJECTED, error.one_line())
        except Exception as error:  # a bug must not stop the sessions behind it
            return JobOutcome(JobState.REJECTED, f"a bug in evermap: {type(error).__name__}: {error}")

    @contextmanager
    def _keep_lease(self, job: Job) -> Iterator[None]:
        """Renew the lease as long as the block runs."""
        done = threading.Event()

        def renew() -> None:
            while not done.wait(self._lease_s / 3.0):
                try:
                    self._database.renew(job.id, self.name, self._lease_s)
                except AWAY:  # it may be back the next time
                    continue

        thread = threading.Thread(target=renew, daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()


def _remark(entered: SlamResult) -> str:
    """Return what to say of a session that entered: why its verdict is not sound, and warnings."""
    verdict = entered.verdict
    said = [] if verdict is None or verdict.kind is VerdictKind.SOUND else [verdict.message]
    return ", ".join([*said, *entered.warnings[:3]])


class Crew:
    """Worker processes, each of which is replaced when it ends, as long as a `with` block runs.

    Args:
        command: starts one.
        count: how many.
        told: called with a line when one has ended.
    """

    def __init__(self, command: Sequence[str], count: int, told: Callable[[str], None] = lambda _: None) -> None:
        self._command, self._told = command, told
        self._processes: dict[int, subprocess.Popen[bytes]] = {}
        self._over, self._lock = threading.Event(), threading.Lock()
        self._threads = [threading.Thread(target=self._replace, args=(place,), daemon=True) for place in range(count)]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:  # no thread starts another from now on
            self._over.set()
            processes = list(self._processes.values())
        for process in processes:
            process.terminate()
        end = time.monotonic() + _GRACE_S
        for process in processes:
            try:
                process.wait(max(end - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                process.kill()
        for thread in self._threads:
            thread.join()

    def alive(self) -> int:
        """Return the number of processes that run."""
        with self._lock:
            return sum(process.poll() is None for process in self._processes.values())

    def _replace(self, place: int) -> None:
        """Start a process, and again whenever it has ended; the later the more often it ended soon."""
        pause_s = _PAUSE_S
        while True:
            with self._lock:
                if self._over.is_set():
                    return
                # in a session of its own: Ctrl-C is for the server, which ends its workers
                process = subprocess.Popen(  # noqa: S603  (ourselves)
                    self._command, stdin=subprocess.DEVNULL, start_new_session=True
                )
                self._processes[place] = process
            start = time.monotonic()
            code = process.wait()
            lasted_s = time.monotonic() - start
            pause_s = _PAUSE_S if lasted_s > _LONGEST_PAUSE_S else min(2.0 * pause_s, _LONGEST_PAUSE_S)
            if not self._over.is_set():
                self._told(f"a worker ended with code {code}; another starts in {pause_s:.0f} s")
            self._over.wait(pause_s)


def end_without(parent: int) -> None:
    """End this process, by SIGTERM, as soon as its parent is another than it was."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PAUSE_S)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
