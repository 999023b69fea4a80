"""Events: new revisions are announced as they happen, and to nobody whose token is revoked."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("fastapi", reason="a server needs evermap[server]")
pytest.importorskip("httpx", reason="needs httpx: pip install 'evermap[dev]'")

import httpx
from fleets import BOTH_DATABASES, SQLITE_ONLY, Fleet, held, served, wait_until


@BOTH_DATABASES
def test_new_revisions_are_events(fleet: Fleet, zips: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """In PostgreSQL because they are announced, from other processes and after an outage too, else by asking."""
    announced = "postgresql" in fleet.where
    monkeypatch.setattr("evermap.server.events._ALIVE_S", 1e9)  # else it asks now and then
    fleet.upload(zips[0])
    fleet.worker().step()
    headers = {"Authorization": f"Bearer {fleet.tokens['read']}"}
    with (
        served(fleet) as url,
        httpx.stream("GET", f"{url}/maps/ward/events?since=0", headers=headers, timeout=30.0) as answer,
    ):
        assert answer.headers["Content-Type"].startswith("text/event-stream")
        lines = answer.iter_lines()
        assert next(line for line in lines if line.startswith("id:")) == "id: 1"
        fleet("POST", "/maps/ward/pin", json={"landmarks": ["1"]})
        assert next(line for line in lines if line.startswith("id:")) == "id: 2"
        wait_until(lambda: fleet.server.database.announcements.arrive == announced)
        if announced:
            end_listener(fleet.where)
        code = "import sys; from evermap.maps.store import open_store; open_store(sys.argv[1]).revert(1)"
        subprocess.run([sys.executable, "-c", code, fleet.server.sites.address("ward")], check=True)
        assert next(line for line in lines if line.startswith("id:")) == "id: 3"
        wait_until(lambda: fleet.server.database.announcements.arrive == announced)
        for method, path, what in (
            ("PUT", "/robots/upload/maps", []),
            ("PUT", "/robots/upload/maps", [held(1)]),
            ("POST", "/maps/ward/approve", {"revision": 1}),
        ):
            fleet(method, path, json=what)
            assert next(line for line in lines if line == "event: beside")
    wait_until(lambda: not fleet.server.database.announcements.arrive)


def end_listener(where: str) -> None:
    import psycopg

    with psycopg.connect(where, autocommit=True) as connection:
        mine = "datname = current_database() AND query LIKE 'LISTEN%'"
        ended = f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE {mine}"
        assert connection.execute(ended.encode()).fetchall() == [(True,)]


@SQLITE_ONLY
def test_a_revoked_token_is_told_no_more_events(
    fleet: Fleet, zips: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("evermap.server.events._CHECKED_S", 0.5)
    fleet.upload(zips[0])
    fleet.worker().step()
    with served(fleet) as url:
        headers = {"Authorization": f"Bearer {fleet.tokens['read']}"}
        with httpx.stream("GET", f"{url}/maps/ward/events?since=0", headers=headers, timeout=30.0) as answer:
            assert "Content-Encoding" not in answer.headers
            lines = answer.iter_lines()
            assert next(line for line in lines if line.startswith("id:")) == "id: 1"
            fleet.server.database.revoke_token("read")
            assert not any(line.startswith("id:") for line in lines)  # it ends
