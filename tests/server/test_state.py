"""What all requests share: the rate of each token, and the queue of sessions."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="a server needs evermap[server]")

import sqlalchemy as sa

from evermap.server import database as tables
from evermap.server import state
from evermap.server.database import Database, JobState
from evermap.server.state import Server
from evermap.server.worker import _remark
from evermap.types import VerdictKind


def a_server(rate_hz: float) -> Server:
    nothing: Any = None
    return Server(nothing, nothing, rate_hz=rate_hz)


def test_a_token_has_a_burst_and_then_its_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two hundred at once, then ten a second; of others the rate is another."""
    now, server = [100.0], a_server(10.0)
    monkeypatch.setattr(state.time, "monotonic", lambda: now[0])

    def admitted(count: int, who: str = "robot") -> int:
        return sum(server.admits("token", who) for _ in range(count))

    assert admitted(300) == 200
    assert admitted(5, "other") == 5
    now[0] += 0.5
    assert admitted(20) == 5
    now[0] += 0.11
    assert admitted(2) == 1
    now[0] += 1e4  # no more is saved up than the burst
    assert admitted(300) == 200


def test_who_asks_twice_as_often_as_allowed_is_admitted_every_other_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A refused request costs nothing: with the fraction of a token that it took nobody got in again before a pause."""
    now = [0.0]
    monkeypatch.setattr(state.time, "monotonic", lambda: now[0])
    server = a_server(10.0)
    for _ in range(200):
        assert server.admits("token", "steady")
    admitted = 0
    for _ in range(40):
        now[0] += 0.05
        admitted += server.admits("token", "steady")
    assert admitted == 20


def test_who_asked_least_recently_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state, "_MOST_COUNTED", 2)
    server = a_server(0.0)
    for _ in range(200):
        assert server.admits("token", "first")
    assert not server.admits("token", "first")
    assert server.admits("address", "first")  # tokens and addresses are counted apart
    assert not server.admits("token", "first")  # which is the more recent one now
    assert server.admits("token", "third")
    assert not server.admits("token", "first")
    assert server.admits("token", "fourth")
    assert server.admits("token", "fifth")
    assert server.admits("token", "first")  # forgotten, so it begins again


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    opened = Database(tmp_path)
    yield opened
    opened.close()


def work_off(database: Database, name: str, end: JobState, revision: int | None = None) -> None:
    """Queue a session of a site, and end it."""
    job, fresh = database.enqueue("ward", name, b"zip", "robot")
    assert fresh
    claimed = database.claim("worker", 60.0)
    assert claimed is not None
    assert claimed[0].id == job.id
    database.finish(job.id, "worker", end, revision=revision)


@pytest.mark.parametrize(("newest", "is_due"), [(9, False), (10, False), (11, True)])
def test_what_was_set_aside_is_tried_again_when_the_map_has_grown_by_a_quarter(
    database: Database, newest: int, is_due: bool
) -> None:
    """Set aside at revision 8: at 11, not at 10, which is just a quarter more."""
    work_off(database, "lost", JobState.ASIDE, revision=8)
    assert database.depth() == 0
    work_off(database, "found", JobState.ENTERED, revision=newest)
    assert database.depth() == is_due
    claimed = database.claim("worker", 60.0)
    assert (claimed is not None) == is_due
    if claimed is not None:
        assert claimed[0].digest == "lost"


def test_the_queue_says_how_long_the_oldest_waits_and_what_is_worked_on(database: Database) -> None:
    assert database.queue() == ({}, 0.0, 0)
    for name in ("one", "two", "three", "four"):
        database.enqueue("ward", name, b"zip", "robot")
    ago = [(datetime.now(UTC) - timedelta(seconds=s)).isoformat(timespec="seconds") for s in (9000, 500, 3600, 60)]
    with database._writer.begin() as connection:
        for number, at in enumerate(ago, start=1):
            connection.execute(sa.update(tables._job).where(tables._job.c.id == number).values(changed_at=at))
    assert database.claim("worker", 60.0) is not None  # the first of all: it waits no more
    by_state, waits_s, working = database.queue()
    assert by_state == {"queued": 3, "working": 1}
    assert waits_s == pytest.approx(3600.0, abs=30.0)
    assert working == 1
    assert database.claim("other", 60.0) is None  # its site has a worker
    database.renew(1, "worker", -1.0)  # whose lease has ended
    assert database.queue()[2] == 0
    again = database.claim("other", 60.0)
    assert again is not None
    assert (again[0].id, again[0].tries) == (1, 1)


@pytest.mark.parametrize(
    ("end", "tries"), [(JobState.QUEUED, 0), (JobState.ASIDE, 0), (JobState.REJECTED, 1), (JobState.ENTERED, 1)]
)
def test_what_is_given_back_was_no_try(database: Database, end: JobState, tries: int) -> None:
    work_off(database, "one", end)
    job = database.job(1)
    assert job is not None
    assert (job.state, job.tries) == (end, tries)
    assert (database.payload(1) is None) == (end is JobState.ENTERED)
    assert database.retry(1) == (end in (JobState.ASIDE, JobState.REJECTED))


def test_the_remark_on_a_session_has_its_verdict_and_three_warnings() -> None:
    warnings = ("a", "b", "c", "d")
    for kind, said in ((VerdictKind.SOUND, "a, b, c"), (VerdictKind.WEAK, "too few, a, b, c")):
        slam: Any = SimpleNamespace(verdict=SimpleNamespace(kind=kind, message="too few"), warnings=warnings)
        assert _remark(slam) == said
    assert _remark(SimpleNamespace(verdict=None, warnings=())) == ""  # type: ignore[arg-type]
