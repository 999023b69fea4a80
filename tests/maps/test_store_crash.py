"""A store survives being killed: at every statement of a commit or of pruning, and at random instants of many."""

from __future__ import annotations

import os
import select
import signal
import sqlite3
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from random_maps import assert_same, random_changes, random_evidence, random_map
from sqlalchemy import Engine, event

from evermap.maps.store import MapStore, Provenance, PrunedRevisionError, open_store, verify_store

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")


@cache
def the_map(number: int):
    """What revision `number` holds in these tests."""
    return random_map(number, cliques=6 + number % 5, stamp_s=1000.0 * number)


@cache
def the_evidence(number: int):
    """What was looked at in its session."""
    return random_evidence(number, the_map(number))


def commit_next(store: MapStore) -> None:
    number = store.head() + 1
    living = the_map(number)
    changes, evidence = random_changes(number, living), the_evidence(number)
    store.commit(living, Provenance(recording=f"session {number}"), changes, evidence, parent=number - 1)


def killed(work: Callable[[], None], signal_fd: int | None = None, after_s: float = 0.0) -> bool:
    """Whether a child process that did some work was killed before it was through.

    With `signal_fd` it is killed from outside: a while after it has written its first byte there.
    """
    child = os.fork()
    if child == 0:
        try:
            work()
        finally:
            os._exit(0)
    if signal_fd is not None:
        assert os.read(signal_fd, 1)
        time.sleep(after_s)
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)


def check_all(path: Path) -> int:
    """The number of revisions, every one of which is whole."""
    with open_store(path, create=True) as store:
        head = store.head()
        for number in range(1, head + 1):
            living = the_map(number)
            assert_same(store.load(number), living)
            assert len(store.changes(number)) == 2
        looks = [len(the_evidence(number)) for number in range(1, head + 1)]
        assert len(store.evidence()) == sum(looks)
        assert [r.provenance.recording for r in store.log()] == [f"session {k}" for k in range(1, head + 1)]
    with sqlite3.connect(path) as database:
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert database.execute("PRAGMA foreign_key_check").fetchall() == []
        # nothing is left of what was not committed
        listed = {row[0] for row in database.execute("SELECT number FROM revision")}
    database.close()
    assert listed == set(range(1, head + 1))
    return head


def die_at(fatal: int) -> None:
    """Have this process killed before the statement or the commit of this number, whichever comes."""
    count = 0

    def step(*_: object) -> None:
        nonlocal count
        if count == fatal:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1

    event.listen(Engine, "before_cursor_execute", step)
    event.listen(Engine, "commit", step)


def test_killed_at_every_statement_of_a_commit(tmp_path: Path) -> None:
    """Before each statement and each commit in turn, the first opening of the file included."""
    path = tmp_path / "m.evermap"

    def work(fatal: int) -> None:
        die_at(fatal)
        with open_store(path, create=True) as store:
            commit_next(store)

    fatal, heads = 0, []
    while killed(partial(work, fatal)):
        heads.append(check_all(path))
        fatal += 1
    assert fatal > 15  # statements there are, and each of them was the last one once
    assert set(heads) <= {0}
    assert check_all(path) == 1


@pytest.mark.parametrize("times", [8, pytest.param(30, marks=pytest.mark.slow)])
def test_killed_at_random_instants(tmp_path: Path, times: int) -> None:
    """Many times while it commits as fast as it can: nothing is lost that was there, nothing is there by half."""
    path = tmp_path / "m.evermap"
    random = np.random.default_rng(5)
    heard, told = os.pipe()

    def work() -> None:
        with open_store(path, create=True) as store:
            while True:
                commit_next(store)
                os.write(told, b".")

    head = 0
    for _ in range(times):
        assert killed(work, heard, after_s=float(random.uniform(0.0, 0.04)))
        more = len(os.read(heard, 1000)) if select.select([heard], [], [], 0)[0] else 0
        with open_store(path) as store:
            now = store.head()
            assert_same(store.load(), the_map(now))
        # what it said was committed is there; the last one it may not have got to say
        assert head + 1 + more <= now <= head + 2 + more
        head = now
    assert check_all(path) == head


def test_what_was_committed_is_seen_by_others_at_once(tmp_path: Path) -> None:
    """The child is killed right after `commit` returned: its revision is there."""
    path = tmp_path / "m.evermap"

    def work() -> None:
        with open_store(path, create=True) as store:
            commit_next(store)
            os.kill(os.getpid(), signal.SIGKILL)

    for number in range(1, 6):
        assert killed(work)
        assert check_all(path) == number


def pruned(path: Path, head: int) -> bool:
    """Whether all but the newest revision is pruned; the file is whole, before it is opened for writing again."""
    checked = verify_store(path)
    assert checked.sound
    assert len(checked.intact) + len(checked.pruned) == head
    with open_store(path) as store:
        assert [r.provenance.recording for r in store.log()] == [f"session {k}" for k in range(1, head + 1)]
        assert len(store.evidence()) == sum(len(the_evidence(k)) for k in range(1, head + 1))
        assert_same(store.load(), the_map(head))
        for number in range(1, head):
            if checked.pruned:
                with pytest.raises(PrunedRevisionError):
                    store.load(number)
            else:
                assert_same(store.load(number), the_map(number))
    assert checked.intact == ((head,) if checked.pruned else tuple(range(1, head + 1)))
    return bool(checked.pruned)


@pytest.mark.slow
def test_killed_at_every_statement_of_pruning(tmp_path: Path) -> None:
    """Before each statement and each commit in turn: all of it is there, or only the newest revision."""
    path, head = tmp_path / "m.evermap", 4
    with open_store(path, create=True) as store:
        for _ in range(head):
            commit_next(store)
    data = path.read_bytes()

    def work(fatal: int) -> None:
        die_at(fatal)
        with open_store(path) as store:
            store.prune(1)

    fatal = 0
    while killed(partial(work, fatal)):
        assert not pruned(path, head)
        assert path.read_bytes() == data
        fatal += 1
    assert fatal > 10
    assert pruned(path, head)


@pytest.mark.slow
def test_killed_inside_of_statements_of_pruning(tmp_path: Path) -> None:
    """At forty steps of the database engine, evenly over all: those that make the file smaller are among them."""
    path, head, every = tmp_path / "m.evermap", 4, 25
    with open_store(path, create=True) as store:
        for _ in range(head):
            commit_next(store)
    data = path.read_bytes()

    def work(fatal: float, told: int | None = None) -> None:
        count = 0

        def step() -> int:
            nonlocal count
            count += 1
            if count >= fatal:
                os.kill(os.getpid(), signal.SIGKILL)
            return 0

        def connected(connection: sqlite3.Connection, _: object) -> None:
            connection.set_progress_handler(step, every)

        event.listen(Engine, "connect", connected)
        with open_store(path) as store:
            store.prune(1)
        if told is not None:
            os.write(told, str(count).encode())

    heard, told = os.pipe()
    assert not killed(partial(work, np.inf, told))
    steps = int(os.read(heard, 100))
    small = path.stat().st_size
    done, sizes = [], []
    for fatal in np.unique(np.linspace(1, steps, 40).astype(int)):
        path.write_bytes(data)
        assert killed(partial(work, int(fatal)))
        done.append(pruned(path, head))
        sizes.append(path.stat().st_size)
        with open_store(path) as store:  # what was left is done by the next call
            store.prune(1)
        assert pruned(path, head)
        assert path.stat().st_size == small
    assert done == sorted(done)
    assert 0 < sum(done) < len(done)
    assert {size for size, was in zip(sizes, done, strict=True) if was} >= {len(data)}


@pytest.mark.slow
def test_killed_at_random_instants_of_pruning(tmp_path: Path) -> None:
    """Also while the smaller file is written over the larger one."""
    path, head, count = tmp_path / "m.evermap", 3, 60
    with open_store(path, create=True) as store:
        for number in range(1, head + 1):
            living = random_map(number, cliques=count, stamp_s=1000.0 * number)
            store.commit(living, Provenance(recording=f"session {number}"), parent=number - 1)
    data, random = path.read_bytes(), np.random.default_rng(8)
    heard, told = os.pipe()

    def work() -> None:
        with open_store(path) as store:
            os.write(told, b".")
            store.prune(1)
            time.sleep(10.0)

    begin = time.perf_counter()
    with open_store(path) as store:
        store.prune(1)
    took_s = time.perf_counter() - begin
    small = path.stat().st_size
    assert small < 0.6 * len(data)
    for _ in range(25):
        path.write_bytes(data)
        assert killed(work, heard, after_s=float(random.uniform(0.0, took_s)))
        checked = verify_store(path)
        assert checked.sound
        assert (checked.intact, checked.pruned) in (((1, 2, 3), ()), ((3,), (1, 2)))
        with open_store(path) as store:
            for number in checked.intact:
                assert_same(store.load(number), random_map(number, cliques=count, stamp_s=1000.0 * number))
            store.prune(1)
        assert path.stat().st_size == small
