"""Workers: nothing is lost or entered twice, whoever dies, in whatever order sessions come."""

from __future__ import annotations

import itertools
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="a server needs evermap[server]")
pytest.importorskip("httpx", reason="needs httpx: pip install 'evermap[dev]'")

from fleets import BOTH_DATABASES, Fleet, assert_same
from sqlalchemy import text

from evermap.io import read_native
from evermap.io.native_write import write_session
from evermap.maps.living import LivingMap
from evermap.maps.store import open_store
from evermap.runs.sessions import enter_session
from evermap.server.database import MOST_TRIES, Database, JobState
from evermap.server.uploads import UploadLimits, check_digest, recording_of
from evermap.slam.cleaning import clean


def test_no_lease_looks_at_sessions_that_are_entered(fleet: Fleet, zips: list[bytes]) -> None:
    """Also where the tables are older than their index."""
    with fleet.server.database._writer.begin() as connection:
        connection.execute(text("DROP INDEX ix_job_open"))
    database = Database(fleet.where)
    for k in range(3):
        database.enqueue(f"site-{k}", "same", zips[0], "r")
    claimed = database.claim("w", 60.0)
    assert claimed is not None
    assert claimed[0].site == "site-0"
    asked = "SELECT id FROM job WHERE state IN ('queued', 'working', 'aside') ORDER BY id LIMIT 1"
    with database._writer.begin() as connection:
        lite = connection.dialect.name == "sqlite"
        if not lite:
            connection.execute(text("SET LOCAL enable_seqscan = off"))
        plan = connection.execute(text(f"EXPLAIN {'QUERY PLAN ' if lite else ''}{asked}")).all()
    assert ("SEARCH job USING" if lite else "ix_job_open") in str(plan)
    database.close()


def work(where: str, *more: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "evermap", "work", "--store", where, "--drain", *more]
    return subprocess.Popen(command, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})


@pytest.fixture(scope="module")
def in_order(zips: list[bytes], tmp_path_factory: pytest.TempPathFactory) -> LivingMap:
    with open_store(tmp_path_factory.mktemp("order") / "m.evermap", create=True) as store:
        for data in zips[:3]:
            entered = enter_session(store, recording_of(data, check_digest(data, UploadLimits())))
            entered.commit(store)
        return store.load()


def test_two_workers_lose_nothing_in_any_order(fleet: Fleet, zips: list[bytes], in_order: LivingMap) -> None:
    for number in (2, 0, 1, 2, 0):
        assert fleet.upload(zips[number]).status_code in (200, 202)
    workers = [work(fleet.where) for _ in range(2)]
    assert [worker.wait(timeout=300) for worker in workers] == [0, 0]
    jobs = fleet("GET", "/jobs").json()
    assert [job["state"] for job in jobs] == [JobState.ENTERED] * 3
    assert sorted(job["revision"] for job in jobs) == [1, 2, 3]
    with fleet.server.sites.store("ward") as store:
        assert_same(store.load(), in_order)


def test_a_session_of_a_worker_that_is_killed_goes_back(fleet: Fleet, zips: list[bytes]) -> None:
    job = fleet.upload(zips[0]).json()["id"]
    worker = work(fleet.where, "--lease-s", "1")
    while fleet("GET", f"/jobs/{job}").json()["state"] == "queued":
        time.sleep(0.01)
    worker.send_signal(signal.SIGKILL)
    worker.wait()
    told = fleet("GET", f"/jobs/{job}").json()
    assert (told["state"], told["tries"]) == ("working", 1)
    other = fleet.worker(lease_s=1.0)
    end = time.monotonic() + 30.0
    while other.step() is None:
        assert time.monotonic() < end
        time.sleep(0.1)
    assert fleet("GET", f"/jobs/{job}").json()["state"] == "entered"
    assert fleet("GET", "/maps").json()[0]["head"] == 1


@BOTH_DATABASES
def test_a_worker_killed_after_the_commit_enters_nothing_twice(fleet: Fleet, zips: list[bytes]) -> None:
    number = fleet.upload(zips[0]).json()["id"]
    claimed = fleet.server.database.claim("killed", 0.0)
    assert claimed is not None
    fleet.worker()._enter(*claimed)
    fleet.worker().step()
    told = fleet("GET", f"/jobs/{number}").json()
    assert (told["state"], told["revision"], told["tries"]) == ("entered", 1, 2)
    assert "is in the map already" in told["reason"]
    assert fleet("GET", "/maps").json()[0]["head"] == 1
    fleet.server.database.finish(number, "killed", JobState.REJECTED, "too late")
    assert fleet("GET", f"/jobs/{number}").json()["state"] == "entered"


def test_the_verdicts_of_an_older_server_get_their_column(tmp_path: Path) -> None:
    """They were the beginnings of reasons; what is no verdict stays whole, and another opening changes nothing."""
    Database(tmp_path)
    reasons = {"sound": ("sound", ""), "sound, 2 rows left out": ("sound", "2 rows left out"),
               "sensor suspect: the camera is late": ("sensor suspect", "the camera is late"),
               "3 workers crashed on it": ("", "3 workers crashed on it"), "": ("", "")}  # fmt: skip
    with sqlite3.connect(tmp_path / "server.db") as older:
        older.execute("ALTER TABLE job DROP COLUMN verdict")
        older.execute("UPDATE server SET version = 1")
        for number, reason in enumerate(reasons):
            row = ("ward", str(number), 1, "cart", "entered", reason, 0, "", 0.0, "", "")
            names = "site, digest, n_bytes, robot, state, reason, tries, worker, lease_s, created_at, changed_at"
            older.execute(f"INSERT INTO job ({names}) VALUES ({', '.join('?' * len(row))})", row)
    for _ in range(2):
        jobs = Database(tmp_path).jobs()[::-1]
        assert [(job.verdict, job.reason) for job in jobs] == list(reasons.values())


@pytest.mark.parametrize("where", ["sqlite"], indirect=True)
@pytest.mark.parametrize("condensed_first", [False, True])
def test_a_drive_that_is_sent_condensed_and_whole_counts_once(
    fleet: Fleet, zips: list[bytes], folders: list[Path], tmp_path: Path, condensed_first: bool
) -> None:
    condensed = write_session(clean(read_native(folders[0])), tmp_path / "condensed.zip").read_bytes()
    other = write_session(clean(read_native(folders[1])), tmp_path / "other.zip").read_bytes()
    both = [condensed, zips[0]] if condensed_first else [zips[0], condensed]
    first, second, third = (fleet.upload(data).json()["id"] for data in (*both, other))
    worker = fleet.worker()
    while worker.step():
        pass
    assert fleet("GET", "/maps").json()[0]["head"] == 2
    told = [fleet("GET", f"/jobs/{number}").json() for number in (first, second, third)]
    assert [(job["state"], job["revision"]) for job in told] == [("entered", 1), ("repeat", 1), ("entered", 2)]
    assert "its drive is in the map already, as revision 1" in told[1]["reason"]
    again = fleet.upload(both[1])
    assert (again.status_code, again.json()["state"]) == (200, "repeat")
    assert fleet("GET", f"/jobs/{second}/payload").status_code == 404


def test_a_session_that_kills_its_workers_is_refused_in_the_end(fleet: Fleet, zips: list[bytes]) -> None:
    number = fleet.upload(zips[0]).json()["id"]
    for _ in range(MOST_TRIES):
        assert fleet.server.database.claim("killed", 0.0) is not None
    fleet.worker().step()
    told = fleet("GET", f"/jobs/{number}").json()
    assert (told["state"], told["reason"]) == ("rejected", f"{MOST_TRIES} workers crashed on it")


def test_what_does_not_fit_is_tried_again_as_the_map_grows(fleet: Fleet, zips: list[bytes]) -> None:
    database = fleet.server.database

    def settle(job: int, state: JobState, revision: int) -> None:
        claimed = database.claim("w", 60.0)
        assert claimed is not None
        assert claimed[0].id == job
        database.finish(job, "w", state, "why", revision)

    first, aside, other, third = (fleet.upload(data).json()["id"] for data in zips[:4])
    settle(first, JobState.ENTERED, 1)
    settle(aside, JobState.ASIDE, 1)
    assert fleet("GET", f"/jobs/{aside}/payload").content == zips[1]
    settle(other, JobState.ENTERED, 4)
    settle(aside, JobState.ASIDE, 4)
    settle(third, JobState.ENTERED, 5)  # a quarter more is one that is more than 5
    assert database.claim("w", 60.0) is None
    assert database.depth() == 0
    last = fleet.upload(zips[4]).json()["id"]
    settle(last, JobState.ENTERED, 6)
    assert database.depth() == 1
    settle(aside, JobState.ENTERED, 7)
    assert fleet.upload(zips[5], site="other").status_code == 202
    assert fleet("GET", f"/jobs/{aside}").json()["revision"] == 7


@BOTH_DATABASES
def test_many_who_claim_at_once_get_different_sessions(fleet: Fleet, zips: list[bytes]) -> None:
    for site, data in itertools.product(("a", "b", "c", "d"), zips[:1]):
        fleet.upload(data, site=site)
    fleet.upload(zips[1], site="a")  # waits for the other one of its site
    got: list[int] = []

    def claim() -> None:
        database = Database(fleet.where)
        while claimed := database.claim(threading.current_thread().name, 60.0):
            got.append(claimed[0].id)

    threads = [threading.Thread(target=claim) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(got) == len(set(got))
    for _ in range(5):  # what was skipped while another looked at it
        claim()
    assert sorted(got) == sorted(job["id"] for job in fleet("GET", "/jobs").json())[:4]
