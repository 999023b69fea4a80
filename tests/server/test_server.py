"""Sessions by HTTP: who may, what is refused, and that nothing is lost or entered twice."""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import os
import re
import secrets
import signal
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="a server needs evermap[server]")
pytest.importorskip("httpx", reason="needs httpx: pip install 'evermap[dev]'")

import httpx
import uvicorn
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import text
from typer.testing import CliRunner

from evermap.cli.main import app as command
from evermap.config import Config
from evermap.errors import ConfigError, InputError
from evermap.io import read_native, write_native
from evermap.io.bag import bag_settings, read_bag
from evermap.io.native_write import write_session
from evermap.maps.living import LivingMap
from evermap.maps.store import open_store, verify_store
from evermap.runs.sessions import enter_session
from evermap.server import uploads
from evermap.server.app import Gate, Server, _lines, create_app
from evermap.server.database import MOST_TRIES, Database, JobState, Role
from evermap.server.sites import SiteStores
from evermap.server.uploads import UploadLimits, checked_digest, recording_of
from evermap.server.worker import Worker
from evermap.slam.cleaning import clean
from evermap.types import SpatialRecording
from evermap_studies.sim import BuildingConfig, simulate_building

COUNT = 6


def zipped(files: Mapping[str, bytes], **how: Any) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", **{"compression": zipfile.ZIP_DEFLATED, **how}) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Sessions of one building, in order of time."""
    folder = tmp_path_factory.mktemp("sessions")
    sessions = simulate_building(BuildingConfig(days=COUNT, patrol_s=35.0), 3).sessions
    for number, recording in enumerate(sessions):
        write_native(recording, folder / f"day{number}")
    return [folder / f"day{number}" for number in range(COUNT)]


@pytest.fixture(scope="module")
def zips(folders: list[Path]) -> list[bytes]:
    return [
        zipped({f"{folder.name}/{path.name}": path.read_bytes() for path in sorted(folder.iterdir())})
        for folder in folders
    ]


@dataclass
class Fleet:
    """A server with a token for every role."""

    where: str
    server: Server
    client: TestClient
    tokens: dict[str, str]

    def __call__(self, method: str, path: str, role: str = "admin", **what: Any) -> httpx.Response:
        headers = {"Authorization": f"Bearer {self.tokens[role]}"}
        if "content" in what:
            headers["Content-Type"] = "application/json"
        return self.client.request(method, path, headers=headers, **what)

    def upload(self, data: bytes, site: str = "ward", role: str = "upload") -> httpx.Response:
        return self("POST", f"/maps/{site}/sessions", role, content=data)

    def worker(self, lease_s: float = 60.0) -> Worker:
        return Worker(self.server.database, self.server.sites, Config(), lease_s)


@pytest.fixture(params=["sqlite", "postgresql"])
def where(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "sqlite":
        return str(tmp_path / "maps")
    address: str = request.getfixturevalue("postgres")
    import psycopg

    name = f"fleet_{secrets.token_hex(4)}"
    with psycopg.connect(address, autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}".encode())
    return address.replace("/postgres?", f"/{name}?")


@pytest.fixture
def fleet(where: str) -> Iterator[Fleet]:
    database = Database(where)
    server = Server(database, SiteStores(where))
    tokens = {role.name.lower(): database.add_token(role.name.lower(), role) for role in Role}
    with TestClient(create_app(server)) as client:
        yield Fleet(where, server, client, tokens)
    database.close()


def assert_same(a: LivingMap, b: LivingMap) -> None:
    one, other = a.landmarks(), b.landmarks()
    np.testing.assert_array_equal(one.landmark_id, other.landmark_id)
    for name in ("position_m", "covariance_m2", "p_exists", "n_hits", "n_misses", "last_seen_s"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0.0, atol=1e-12, err_msg=name)


def test_nobody_is_answered_without_a_token(fleet: Fleet) -> None:
    assert fleet.client.get("/healthz").json()["waiting"] == 0
    assert "Content-Security-Policy" in fleet.client.get("/healthz").headers
    asked = 0
    for path, methods in fleet.client.get("/openapi.json").json()["paths"].items():
        for method in methods:
            if path != "/healthz":
                filled = path.replace("{site}", "ward").replace("{number}", "1").replace("{landmark}", "1")
                filled = filled.replace("{robot}", "upload")
                for headers in (
                    {},
                    {"Authorization": "Bearer nobody"},
                    {"Authorization": f"Basic {fleet.tokens['admin']}"},
                ):
                    assert fleet.client.request(method.upper(), filled, headers=headers).status_code == 401, path
                    asked += 1
    assert asked > 50


@pytest.mark.parametrize(
    ("method", "path", "least"),
    [
        ("GET", "/sites", Role.READ),
        ("GET", "/maps", Role.READ),
        ("GET", "/jobs", Role.READ),
        ("POST", "/maps/ward/sessions", Role.UPLOAD),
        ("POST", "/maps/ward/approve", Role.APPROVE),
        ("POST", "/maps/ward/delete", Role.APPROVE),
        ("POST", "/jobs/1/retry", Role.APPROVE),
        ("GET", "/jobs/1/payload", Role.APPROVE),
        ("GET", "/robots", Role.READ),
        ("PUT", "/robots/upload/maps", Role.UPLOAD),
        ("GET", "/audit", Role.ADMIN),
    ],
)
def test_a_role_may_what_those_below_it_may(fleet: Fleet, method: str, path: str, least: Role) -> None:
    for role in Role:
        assert (fleet(method, path, role.name.lower()).status_code == 403) == (role < least), role


def test_tokens_are_kept_as_digests_and_can_be_revoked(fleet: Fleet) -> None:
    database = fleet.server.database
    with pytest.raises(ConfigError, match="a token named"):
        database.add_token("read", Role.ADMIN)
    assert database.revoke_token("read")
    assert not database.revoke_token("read")
    assert fleet("GET", "/maps", "read").status_code == 401
    if not fleet.where.startswith("postgresql"):
        kept = (Path(fleet.where) / "server.db").read_bytes()
        assert not any(token.encode() in kept for token in fleet.tokens.values())


def test_a_session_is_uploaded_entered_and_asked_about(fleet: Fleet, zips: list[bytes], tmp_path: Path) -> None:
    answer = fleet.upload(zips[0])
    assert answer.status_code == 202
    job = answer.json()
    assert (job["state"], job["robot"], job["site"]) == ("queued", "upload", "ward")
    again = fleet.upload(zips[0])
    assert (again.status_code, again.json()["id"]) == (200, job["id"])
    fleet.upload(zips[2])
    worker = fleet.worker()
    while worker.step():
        pass
    assert fleet("GET", f"/jobs/{job['id']}").json()["state"] == "entered"
    assert fleet("GET", f"/jobs/{job['id']}").json()["revision"] == 1
    assert fleet("GET", f"/jobs/{job['id']}/payload").status_code == 404
    assert fleet.upload(zips[0]).json()["state"] == "entered"
    assert fleet("GET", "/maps").json() == [{"site": "ward", "head": 2, "approved": None}]
    revisions = fleet("GET", "/maps/ward/revisions", "read").json()
    assert [item["kind"] for item in revisions] == ["session", "session"]
    assert (revisions[0]["command"], revisions[0]["robot"]) == ("evermap work", "upload")
    told = fleet("GET", "/maps/ward/changes?since=1").json()
    assert sum(revisions[1]["changes"].values()) == len(told)
    assert fleet("GET", "/maps/ward/diff?a=1&b=2").json()["b"] == 2
    everything = fleet("GET", "/maps/ward/landmarks").json()["landmarks"]
    some = fleet("GET", "/maps/ward/landmarks?x_max=5&p_least=0.5&at_s=1e12").json()["landmarks"]
    assert 0 < len(some) < len(everything)
    assert all(item["x_m"] <= 5.0 for item in some)
    told = fleet("GET", f"/maps/ward/landmarks/{some[0]['label']}/why").json()
    assert told["landmark"] == some[0]["landmark"]
    assert {visit["robot"] for visit in told["sessions"]} == {"upload"}
    assert fleet("GET", "/maps/ward/lifetimes").json()["lifetimes"]
    for path in ("/maps/other/revisions", "/maps/ward/landmarks?revision=9", "/maps/ward/landmarks/nothing/why"):
        assert fleet("GET", path).status_code == 404, path
    file = fleet("GET", "/maps/ward/file?revision=1")
    described = fleet("GET", "/openapi.json").json()["paths"]["/maps/{site}/file"]["get"]["responses"]["200"]
    assert list(described["content"]) == [file.headers["Content-Type"]]
    (tmp_path / "first.evermap").write_bytes(file.content)
    assert verify_store(tmp_path / "first.evermap").sound
    with open_store(tmp_path / "first.evermap") as store, fleet.server.sites.store("ward") as served:
        assert (store.head(), store.log()[0]) == (1, served.log()[0])
        assert_same(store.load(), served.load(1))
    unchanged = {"Authorization": f"Bearer {fleet.tokens['read']}", "If-None-Match": file.headers["ETag"]}
    assert fleet.client.get("/maps/ward/file?revision=1", headers=unchanged).status_code == 304
    assert fleet.client.get("/maps/ward/file", headers=unchanged).status_code == 200
    fresh = SiteStores(fleet.where).file("ward", 1)  # another process makes the same file
    assert (fresh.sha256, f'"{fresh.tag}"') == (file.headers["X-Checksum-Sha256"], file.headers["ETag"])


def test_the_doctor_tells_what_is_wrong(fleet: Fleet, zips: list[bytes]) -> None:
    command = [sys.executable, "-m", "evermap", "serve", "doctor", "--store", fleet.where, "--json"]

    def looked(*more: str) -> tuple[int, dict[str, bool]]:
        done = subprocess.run([*command, *more], capture_output=True, text=True, check=False)
        assert not done.stderr
        return done.returncode, {item["what"]: item["fine"] for item in json.loads(done.stdout)["checks"]}

    fleet.upload(zips[0])
    fleet.worker().step()
    code, fine = looked("--url", "")
    assert (code, set(fine.values())) == (0, {True})
    fleet.upload(zips[1])
    database = fleet.server.database
    with database._writer.begin() as connection:
        connection.execute(text("UPDATE job SET changed_at = '2020-01-01T00:00:00+00:00' WHERE state = 'queued'"))
    database.revoke_token("admin")
    code, fine = looked("--url", "ftp://maps")
    assert code == 1
    assert {what for what, well in fine.items() if not well} == {"tokens", "queue", "workers", "address"}


def test_the_doctor_makes_nothing_where_there_is_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "evermap", "serve", "doctor", "--url", "", "--store", str(tmp_path / "maps")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.startswith("WRONG  database: ")) == (1, True)
    assert not (tmp_path / "maps").exists()


def test_an_answer_is_sent_again_only_once_the_map_is_newer(fleet: Fleet, zips: list[bytes]) -> None:
    fleet.upload(zips[0])
    fleet.worker().step()
    first = fleet("GET", "/maps/ward/landmarks")
    known = {"Authorization": f"Bearer {fleet.tokens['read']}", "If-None-Match": first.headers["ETag"]}
    for path in ("landmarks", "changes", "revisions", "lifetimes", "landmarks/1/why", "diff"):
        assert fleet.client.get(f"/maps/ward/{path}", headers=known).status_code == 304, path
    assert fleet("GET", "/maps/ward/landmarks").json() == first.json()
    fleet("POST", "/maps/ward/pin", json={"landmarks": ["1"]})
    newer = fleet.client.get("/maps/ward/landmarks", headers=known)
    assert (newer.status_code, newer.json()["revision"]) == (200, 2)
    assert fleet.client.get("/maps/ward/landmarks", headers={**known, "Authorization": ""}).status_code == 401


def test_sites_are_listed_by_name_and_maps_by_pages(fleet: Fleet) -> None:
    sites = fleet.server.sites
    for name in ("b", "c", "a"):
        with sites.store(name, create=True):
            pass
    assert fleet("GET", "/sites").json() == ["a", "b", "c"]
    for query, found in (("most=2", ["a", "b"]), ("most=2&after=b", ["c"]), ("after=c", []), ("site=b", ["b"])):
        assert [one["site"] for one in fleet("GET", f"/maps?{query}").json()] == found, query
    assert fleet("GET", "/maps?site=d").status_code == 404
    assert fleet("GET", "/maps?most=0").status_code == 422


@pytest.mark.parametrize("where", ["postgresql"], indirect=True)
def test_connections_that_the_database_closed_are_opened_again(fleet: Fleet, where: str) -> None:
    import psycopg

    fleet("GET", "/maps")
    with psycopg.connect(where, autocommit=True) as connection:
        connection.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
            "WHERE datname = current_database() AND pid != pg_backend_pid()"
        )
    assert fleet("GET", "/maps").status_code == 503  # it was in use a moment ago, and nobody asked whether it still is
    assert fleet("GET", "/maps").status_code == 200
    with psycopg.connect(where, autocommit=True) as connection:
        connection.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
            "WHERE datname = current_database() AND pid != pg_backend_pid()"
        )
    time.sleep(1.1)
    assert fleet("GET", "/maps").status_code == 200


def test_an_operator_edits_reverts_and_approves(fleet: Fleet, zips: list[bytes]) -> None:
    fleet.upload(zips[0])
    fleet.worker().step()
    name = fleet("GET", "/maps/ward/landmarks").json()["landmarks"][0]["label"]
    said = {"landmarks": [name], "note": "<script>alert(1)</script>'; DROP TABLE job; --"}
    deleted = fleet("POST", "/maps/ward/delete", "approve", json=said)
    assert (deleted.status_code, deleted.json()["revision"]) == (200, 2)
    assert said["note"] in fleet("GET", "/maps/ward/revisions").json()[1]["note"]
    assert fleet("POST", "/maps/ward/delete", json={**said, "landmarks": ["nothing"]}).status_code == 422
    assert fleet("POST", "/maps/ward/revert", json={"revision": 1}).json()["revision"] == 3
    assert fleet("GET", "/maps/ward/file?approved=true").status_code == 404
    for wrong in (4, False, "2"):
        assert fleet("POST", "/maps/ward/approve", json={"revision": wrong}).status_code == 422
    assert fleet("POST", "/maps/ward/approve", "approve", json={"revision": 2}).status_code == 200
    assert fleet("GET", "/maps").json()[0]["approved"]["who"] == "approve"
    assert (
        fleet("GET", "/maps/ward/file?approved=true").headers["ETag"]
        == fleet("GET", "/maps/ward/file?revision=2").headers["ETag"]
    )
    notes = fleet("GET", "/audit").json()
    assert [(note["who"], note["status"]) for note in notes[:2]] == [("approve", 200), ("admin", 422)]
    assert any("/maps/ward/delete" in note["what"] for note in notes)


def held(version: int | str, status: str = "ENABLED", site: str = "ward") -> dict[str, str]:
    return {"mapId": site, "mapVersion": str(version), "mapStatus": status}


def test_a_robot_is_led_to_the_approved_revision(fleet: Fleet, zips: list[bytes]) -> None:
    fleet.upload(zips[0])
    fleet.worker().step()
    name = fleet("GET", "/maps/ward/landmarks").json()["landmarks"][0]["label"]
    fleet("POST", "/maps/ward/pin", json={"landmarks": [name]})
    assert fleet("GET", "/whoami", "upload").json() == {"name": "upload", "role": "upload"}
    assert fleet("GET", "/maps/ward/actions").status_code == 404
    fleet("POST", "/maps/ward/approve", json={"revision": 1})

    def wanted(robot: str = "upload") -> dict[str, dict[str, str]]:
        listed = fleet("GET", f"/maps/ward/actions?robot={robot}", "upload").json()["actions"]
        assert {one["blockingType"] for one in listed} <= {"NONE"}
        assert len({one["actionId"] for one in listed}) == len(listed)
        return {one["actionType"]: {p["key"]: p["value"] for p in one["actionParameters"]} for one in listed}

    assert list(wanted()) == ["downloadMap", "enableMap"]
    asked = wanted()["downloadMap"]
    assert (asked["mapId"], asked["mapVersion"]) == ("ward", "1")
    file = fleet("GET", asked["mapDownloadLink"], "upload").content
    assert hashlib.sha256(file).hexdigest() == asked["mapHash"]

    def reports(*maps: dict[str, str], robot: str = "upload", role: str = "upload") -> int:
        return fleet("PUT", f"/robots/{robot}/maps", role, json=[*maps]).status_code

    assert reports(held(1, "DISABLED"), held("2.1", site="another")) == 200
    assert wanted() == {"enableMap": {"mapId": "ward", "mapVersion": "1"}}
    assert list(wanted("nobody")) == ["downloadMap", "enableMap"]
    assert reports(held(1)) == 200
    assert wanted() == {}
    assert fleet("GET", "/robots", "read").json()[0]["maps"] == [held(1)]
    fleet("POST", "/maps/ward/approve", json={"revision": 2})
    assert wanted()["downloadMap"]["mapVersion"] == "2"
    assert reports(held(1, "DISABLED"), held(2)) == 200
    assert wanted() == {}
    assert reports(held(1), robot="robot-8") == 403
    assert reports(held(1), robot="robot-8", role="approve") == 200
    assert [one["robot"] for one in fleet("GET", "/robots").json()] == ["robot-8", "upload"]
    for wrong in ([held(1), held(2)], [held(1, "SOMEHOW")], [{}], {}, [held(1)] * 101):
        assert fleet("PUT", "/robots/upload/maps", "upload", json=wrong).status_code == 422
    assert fleet("GET", "/robots").json()[1]["maps"] == [held(1, "DISABLED"), held(2)]


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


def test_a_store_of_before_there_were_robots_is_read(tmp_path: Path) -> None:
    import sqlite3

    Database(tmp_path).close()
    with sqlite3.connect(tmp_path / "server.db") as connection:
        connection.execute("DROP TABLE robot")
    assert Database(tmp_path).robots() == []


def renamed(data: bytes, change: Callable[[dict[str, bytes]], Mapping[str, bytes]], **how: Any) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    return zipped(change(files), **how)


def bomb(data: bytes) -> bytes:
    return renamed(data, lambda files: {**files, "day0/more.csv": bytes(3_000_000)})


def link(data: bytes) -> bytes:
    buffer = io.BytesIO(data)
    with zipfile.ZipFile(buffer, "a") as archive:
        info = zipfile.ZipInfo("day0/frames.toml")
        info.external_attr = 0o120777 << 16
        archive.writestr(info, "/etc/passwd")
    return buffer.getvalue()


HOSTILE: dict[str, Callable[[bytes], bytes]] = {
    "nothing": lambda _: b"",
    "no zip": lambda _: b"PK\x03\x04 not really",
    "cut off": lambda data: data[: len(data) // 2],
    "parent": lambda data: renamed(data, lambda files: {**files, "../up.csv": b"x"}),
    "absolute": lambda data: renamed(data, lambda files: {**files, "/etc/cron.csv": b"x"}),
    "backslash": lambda data: renamed(data, lambda files: {**files, "..\\up.csv": b"x"}),
    "deep": lambda data: renamed(data, lambda files: {**files, "a/b/c.csv": b"x"}),
    "hidden": lambda data: renamed(data, lambda files: {**files, "day0/.csv": b"x"}),
    "control": lambda data: renamed(data, lambda files: {**files, "day0/a\x1b[1m.csv": b"x"}),
    "twice": lambda data: renamed(data, lambda files: {**files, "day1/detections.csv": b"x"}),
    "bomb": bomb,
    "many": lambda data: renamed(data, lambda files: {**files, **{f"day0/{k}.csv": b"" for k in range(200)}}),
    "thousands": lambda data: zipped({f"{k}": b"" for k in range(5000)}),
    "link": link,
    "gzip": lambda data: renamed(data, lambda files: {**files, "day0/frames.csv": b"\x1f\x8b" + bytes(9)}),
    "parquet": lambda data: renamed(data, lambda files: {**files, "day0/frames.parquet": b"PAR1"}),
    "rows": lambda data: renamed(data, lambda files: {**files, "day0/objects.parquet": many_rows()}),
    "empty": lambda _: zipped({"a/readme.csv": b""}),
    "two bags": lambda _: zipped({"a.db3": SQLITE, "b.db3": SQLITE}),
    "two settings": lambda _: zipped({"a.db3": SQLITE, "b.toml": b"", "c.toml": b""}),
    "no bag": lambda _: zipped({"a.mcap": SQLITE}),
    "bag outside": lambda _: zipped({"../a.db3": SQLITE}),
    "settings only": lambda _: zipped({"metadata.yaml": b"", "a.toml": b""}),
}
SQLITE = b"SQLite format 3\0"


def many_rows() -> bytes:
    import pyarrow as pa
    from pyarrow import parquet

    buffer = io.BytesIO()
    parquet.write_table(pa.table({"x": pa.array(np.zeros(400_000))}), buffer)
    assert len(buffer.getvalue()) < 20_000
    return buffer.getvalue()


@pytest.mark.parametrize("where", ["sqlite"], indirect=True)
@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_zips_are_refused(fleet: Fleet, zips: list[bytes], kind: str) -> None:
    fleet.server.limits = UploadLimits(n_bytes=2_000_000, unpacked_bytes=2_500_000)
    assert fleet.upload(zips[0]).status_code == 202
    answer = fleet.upload(HOSTILE[kind](zips[0]))
    assert answer.status_code == 422, answer.text
    assert "\x1b" not in answer.json()["detail"]
    assert len(fleet("GET", "/jobs").json()) == 1
    assert not list(Path(fleet.where).parent.rglob("up.csv"))


@pytest.mark.parametrize("where", ["sqlite"], indirect=True)
def test_what_is_too_large_or_has_no_site_is_refused(fleet: Fleet, zips: list[bytes]) -> None:
    fleet.server.limits = UploadLimits(n_bytes=1000)
    assert fleet.upload(zips[0]).status_code == 413
    fleet.server.limits = UploadLimits()
    for site in ("..", "%2e%2e%2fx", "a b", "x" * 49, "a;b", "%00", "server.db", 'a"b'):
        assert fleet.upload(zips[0], site=site).status_code in (404, 405, 422), site
        assert fleet("GET", f"/maps/{site}/revisions").status_code in (404, 405), site
    assert {path.name for path in Path(fleet.where).iterdir()} == {"server.db"}


@pytest.mark.parametrize("where", ["sqlite"], indirect=True)
def test_too_many_requests_are_told_to_wait(fleet: Fleet) -> None:
    fleet.server.rate_hz = 0.0
    answers = [fleet("GET", "/jobs", "read").status_code for _ in range(210)]
    assert (answers.count(200), answers.count(429)) == (200, 10)
    assert fleet("GET", "/jobs", "upload").status_code == 200


def test_the_digest_is_of_the_session_and_not_of_the_zip(zips: list[bytes]) -> None:
    def moved(files: dict[str, bytes]) -> dict[str, bytes]:
        return {f"elsewhere/{name.rpartition('/')[2]}": files[name] for name in sorted(files, reverse=True)}

    other = renamed(zips[0], moved, compression=zipfile.ZIP_STORED)
    assert other != zips[0]
    assert (
        checked_digest(other, UploadLimits())
        == checked_digest(zips[0], UploadLimits())
        != checked_digest(zips[1], UploadLimits())
    )


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files of ROS 1, ROS 2 as MCAP and in SQLite, and one of tags, whose size it does not tell."""
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    from bags import write

    folder = tmp_path_factory.mktemp("bags")
    written = [write(folder / name, "objects") for name in ("ros1.bag", "mcap", "sqlite_sqlite")]
    written.append(write(folder / "tags", "tags"))
    ros1, mcap, sqlite, tags = (next(p for p in (one, *one.glob("*")) if p.suffix in ENDINGS) for one in written)
    return {"ros1": ros1, "mcap": mcap, "sqlite": sqlite, "tags": tags}


ENDINGS = (".bag", ".mcap", ".db3")


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite"])
def test_a_bag_is_read_as_it_is_and_in_a_zip(bags: dict[str, Path], kind: str) -> None:
    path, limits = bags[kind], UploadLimits()
    data, wanted = path.read_bytes(), read_bag(path)
    digest = checked_digest(data, limits)
    packed = zipped({f"monday/{path.name}": data, "monday/readme.txt": b"x"})
    assert checked_digest(packed, limits) == digest
    for one in (data, packed):
        found = recording_of(one, digest)
        assert isinstance(found, SpatialRecording)
        assert found.name == f"session-{digest[:12]}"
        assert found.source == f"upload:{digest}"
        assert found.warnings == wanted.warnings
        assert found.odometry is not None
        assert wanted.odometry is not None
        assert found.clock is wanted.clock
        for name in ("landmark_id", "position_sensor_m", "rotation", "covariance_sensor_m2"):
            a, b = (getattr(item.detections, name) for item in (found, wanted))
            np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(found.odometry.pose_world_robot, wanted.odometry.pose_world_robot, atol=1e-9)
        np.testing.assert_allclose(found.frames.stamp_s, wanted.frames.stamp_s, rtol=0.0, atol=1e-6)


def test_a_bag_of_several_files_is_read_by_its_metadata(bags: dict[str, Path]) -> None:
    folder = bags["mcap"].parent
    data = zipped({f"{folder.name}/{path.name}": path.read_bytes() for path in folder.iterdir()})
    found = recording_of(data, checked_digest(data, UploadLimits()))
    assert len(found.detections) == len(read_bag(folder).detections)


def test_a_bag_is_uploaded_with_the_settings_of_its_robot(fleet: Fleet, bags: dict[str, Path]) -> None:
    data = bags["tags"].read_bytes()
    alone = fleet.upload(data).json()["id"]
    settings = bag_settings(bags["tags"]).replace("# [tags]\n# size_m = 0.16", "") + "[tags]\nsize_m = 0.2\n"
    whole = fleet.upload(zipped({"drive.mcap": data, "robot.toml": settings.encode()})).json()["id"]
    worker = fleet.worker()
    while worker.step():
        pass
    told = fleet("GET", f"/jobs/{alone}").json()
    assert told["state"] == "rejected"
    assert "does not state the size of its tags" in told["reason"]
    assert "evermap-upload" not in told["reason"]
    assert fleet("GET", f"/jobs/{whole}").json()["state"] == "entered", fleet("GET", f"/jobs/{whole}").text
    assert {one["label"] for one in fleet("GET", "/maps/ward/landmarks").json()["landmarks"]} == {"3", "7"}


def test_a_bag_takes_no_more_than_its_share(
    bags: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sqlite3

    def refused(data: bytes, convert: str) -> str:
        with monkeypatch.context() as patched:
            patched.setattr(uploads, "_CONVERT", convert)
            with pytest.raises(InputError) as told:
                recording_of(data, checked_digest(data, UploadLimits()))
        return told.value.problem

    usual = uploads._CONVERT
    endless = (
        "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x, 'a', 'ros2msg', 'b', 'c' FROM c"
    )
    with sqlite3.connect(tmp_path / "endless.db3") as database:
        database.executescript(f"""
            CREATE TABLE messages (id, topic_id, timestamp, data); CREATE TABLE topics (id, name, type);
            CREATE TABLE schema (schema_version); INSERT INTO schema VALUES (4);
            CREATE VIEW message_definitions (id, topic_type, encoding, encoded_message_definition,
            type_description_hash) AS {endless}
        """)
    told = refused((tmp_path / "endless.db3").read_bytes(), usual.replace(f"({uploads._BAG_CPU_S},", "(4,"))
    assert told.startswith("cannot be read as a bag")
    little = usual.replace(str(uploads._BAG_BYTES), "60000000")
    assert refused(bags["ros1"].read_bytes(), little)
    with pytest.raises(InputError, match="cannot be read as a bag"):
        recording_of(SQLITE, checked_digest(SQLITE, UploadLimits()))


def test_a_refused_session_is_kept_with_its_reason(fleet: Fleet, zips: list[bytes]) -> None:
    broken = renamed(zips[0], lambda files: {**files, "day0/detections.csv": b"stamp_s,range_m\n1,x\n"})
    job = fleet.upload(broken).json()["id"]
    fleet.worker().step()
    told = fleet("GET", f"/jobs/{job}").json()
    assert told["state"] == "rejected"
    assert "detections.csv" in told["reason"]
    assert "/tmp" not in told["reason"]
    assert fleet("GET", f"/jobs/{job}/payload").content == broken
    assert fleet.upload(broken).json()["state"] == "rejected"
    assert fleet("POST", f"/jobs/{job}/retry").json()["state"] == "queued"
    assert fleet("POST", f"/jobs/{job}/retry").status_code == 409
    fleet.worker().step()
    assert fleet("GET", "/jobs?state=rejected").json()[0]["id"] == job


def work(where: str, *more: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "evermap", "work", "--store", where, "--drain", *more]
    return subprocess.Popen(command, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})


@pytest.fixture(scope="module")
def in_order(zips: list[bytes], tmp_path_factory: pytest.TempPathFactory) -> LivingMap:
    with open_store(tmp_path_factory.mktemp("order") / "m.evermap", create=True) as store:
        for data in zips[:4]:
            entered = enter_session(store, recording_of(data, checked_digest(data, UploadLimits())))
            entered.commit(store)
        return store.load()


def test_two_workers_lose_nothing_in_any_order(fleet: Fleet, zips: list[bytes], in_order: LivingMap) -> None:
    for number in (2, 0, 3, 1, 2, 0):
        assert fleet.upload(zips[number]).status_code in (200, 202)
    workers = [work(fleet.where) for _ in range(2)]
    assert [worker.wait(timeout=300) for worker in workers] == [0, 0]
    jobs = fleet("GET", "/jobs").json()
    assert [job["state"] for job in jobs] == [JobState.ENTERED] * 4
    assert sorted(job["revision"] for job in jobs) == [1, 2, 3, 4]
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
    assert sorted(got)[:4] == sorted(job["id"] for job in fleet("GET", "/jobs").json())[:4]


def test_new_revisions_are_events(fleet: Fleet, zips: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """In PostgreSQL because they are announced, from other processes and after an outage too, else by asking."""
    announced = "postgresql" in fleet.where
    monkeypatch.setattr("evermap.server.app._ALIVE_S", 1e9)  # else it asks now and then
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


@contextmanager
def served(fleet: Fleet) -> Iterator[str]:
    """Yield the address at which a thread serves the application."""
    server = uvicorn.Server(uvicorn.Config(create_app(fleet.server), port=0, log_level="warning"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()


def wait_until(holds: Callable[[], bool]) -> None:
    while not holds():
        time.sleep(0.01)


def end_listener(where: str) -> None:
    import psycopg

    with psycopg.connect(where, autocommit=True) as connection:
        mine = "datname = current_database() AND query LIKE 'LISTEN%'"
        ended = f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE {mine}"
        assert connection.execute(ended.encode()).fetchall() == [(True,)]


@pytest.mark.parametrize("where", ["sqlite"], indirect=True)
def test_the_page_is_served_without_text_that_becomes_html(fleet: Fleet) -> None:
    served = {name: fleet.client.get(f"/{name}") for name in ("", "page.js", "page.css")}
    assert {answer.status_code for answer in served.values()} == {200}
    assert "script-src 'self'" in served[""].headers["Content-Security-Policy"]
    assert not any(
        word in served["page.js"].text for word in ("innerHTML", "insertAdjacentHTML", "eval(", "document.write")
    )
    for asked in set(re.findall(r'\$\("([a-z]+)"\)', served["page.js"].text)):
        assert f'id="{asked}"' in served[""].text
    assert "<script>" not in served[""].text
    assert fleet.client.get("/app.py").status_code == 401
    assert fleet("GET", "/app.py").status_code == 404


def test_tables_of_another_version_are_one_line(tmp_path: Path) -> None:
    import sqlite3

    Database(tmp_path).close()
    with sqlite3.connect(tmp_path / "server.db") as connection:
        connection.execute("UPDATE server SET version = 9")
    with pytest.raises(InputError, match="of version 9, this evermap has 1"):
        Database(tmp_path)


ODD = st.one_of(
    st.text(max_size=12),
    st.integers(-(2**70), 2**70).map(str),
    st.floats().map(str),
    st.sampled_from(
        ["", "ward", "1", "true", "queued", "\0", "%00", "' OR 1=1 --", "<b>", "\ud800", "۱", "٣", "1e999"]
    ),
)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def fuzzed(fleet: Fleet, asked: list[tuple[str, str, dict[str, Any]]], data: st.DataObject) -> None:
    method, path, operation = data.draw(st.sampled_from(asked))
    for name in re.findall(r"\{(\w+)\}", path):
        value = data.draw(st.one_of(st.just("ward"), ODD) if name == "site" else st.one_of(st.just("1"), ODD))
        path = path.replace(f"{{{name}}}", quote(value, safe="", errors="surrogatepass"))
    listed = [item["name"] for item in operation.get("parameters", ()) if item["in"] == "query"]
    query = {name: data.draw(ODD) for name in listed if data.draw(st.booleans())}
    text = urlencode(query, errors="surrogatepass")
    body = st.fixed_dictionaries(
        {},
        optional={
            "landmarks": st.lists(st.one_of(st.just("1"), ODD), max_size=3),
            "note": ODD,
            "revision": st.one_of(st.integers(), ODD),
        },
    )
    maps = st.lists(st.builds(held, ODD, st.sampled_from(["ENABLED", "DISABLED", ""]), ODD), max_size=3)
    content = data.draw(st.one_of(st.binary(max_size=40), st.one_of(body, maps).map(json.dumps).map(str.encode)))
    answer = fleet(method, f"{path}?{text}", content=None if method == "GET" else content)
    assert answer.status_code < 500, (method, path, text, content, answer.text)


def test_no_question_is_a_defect(fleet: Fleet, zips: list[bytes]) -> None:
    fleet.server.rate_hz = 1e6
    fleet.upload(zips[0])
    fleet.worker().step()
    for note, status in (("\ud800", 422), ("\0\x1b\u202e", 200)):
        said = json.dumps({"landmarks": ["1"], "note": note}).encode()
        assert fleet("POST", "/maps/ward/pin", content=said).status_code == status
        fleet("POST", "/maps/ward/unpin", content=said)
    fleet("POST", "/maps/ward/approve", json={"revision": 1})
    paths = ("/audit", "/jobs", "/maps", "/maps/ward/revisions", "/maps/ward/landmarks/1/why")
    assert {fleet("GET", path).status_code for path in paths} == {200}
    assert fleet("GET", "/jobs?site=%00").status_code == 422
    for path in ("revisions", "actions", "file?approved=true", "events"):
        assert fleet("GET", f"/maps/%00/{path}").status_code == 404
    assert fleet("PUT", "/robots/%00/maps", json=[]).status_code == 422
    assert fleet("PUT", "/robots/1/maps", json=[held("\0", site="\0\u202e")]).status_code == 200
    assert fleet("GET", "/maps/ward/actions?robot=%00").status_code in (404, 422)
    asked = [
        (method.upper(), path, operation)
        for path, methods in fleet.client.get("/openapi.json").json()["paths"].items()
        for method, operation in methods.items()
        if not path.endswith("/events")
    ]
    fuzzed(fleet, asked)


SQLITE_ONLY = pytest.mark.parametrize("where", ["sqlite"], indirect=True)


@pytest.fixture
def reading(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of the parts of bodies that the server has read."""
    parts: list[int] = []
    usual = Gate.__call__

    async def counted(self: Gate, scope: Any, receive: Any, send: Any) -> None:
        async def heard() -> Any:
            message = await receive()
            parts.append(len(message.get("body", b"")))
            return message

        await usual(self, scope, heard, send)

    monkeypatch.setattr(Gate, "__call__", counted)
    return parts


@SQLITE_ONLY
def test_no_body_is_read_without_a_token_nor_a_long_one_with_it(
    reading: list[int], fleet: Fleet, zips: list[bytes]
) -> None:
    fleet.server.limits = UploadLimits(n_bytes=400_000, body_bytes=20_000)

    def pieces(size: int) -> Iterator[bytes]:  # without a Content-Length
        yield b"["
        for _ in range(size // 1000):
            yield b" " * 1000

    def sent(path: str, role: str | None, content: Any, method: str = "POST") -> tuple[int, int]:
        reading.clear()
        headers = {} if role is None else {"Authorization": f"Bearer {fleet.tokens[role]}"}
        answer = httpx.request(method, f"{url}{path}", headers=headers, content=content)
        assert "detail" in answer.json()
        return answer.status_code, sum(reading)

    with served(fleet) as url:
        for path, method in (("/maps/ward/pin", "POST"), ("/maps/ward/sessions", "POST"), ("/robots/x/maps", "PUT")):
            assert sent(path, None, pieces(100_000), method) == (401, 0)
            assert sent(path, None, b"{broken", method) == (401, 0)
        assert sent("/maps/ward/pin", "admin", b" " * 100_000) == (413, 0)
        for path, most in (("/maps/ward/pin", 20_000), ("/maps/ward/sessions", 400_000)):
            status, n_bytes = sent(path, "admin", pieces(2_000_000))
            assert (status, n_bytes < most + 300_000) == (413, True), n_bytes
        assert sent("/maps/ward/sessions", "read", b" " * 1000) == (403, 0)
        assert sent("/maps/ward/pin", "admin", b"{broken")[0] == 422
    assert fleet.upload(zips[0]).status_code == 202


@SQLITE_ONLY
def test_strangers_are_limited_by_address_and_fill_no_audit(fleet: Fleet) -> None:
    fleet.server.rate_hz = 0.0
    answers = [fleet.client.post("/maps/ward/pin", headers={"Authorization": "Bearer no"}) for _ in range(210)]
    told = [answer.status_code for answer in answers]
    assert (told[:200], told[200:]) == ([401] * 200, [429] * 10)
    assert fleet("GET", "/jobs", "read").status_code == 200
    assert fleet("GET", "/audit").json() == []
    for k in range(11_000):
        fleet.server.admits("address", str(k))
    assert len(fleet.server._budget) == 10_000


@SQLITE_ONLY
def test_what_robots_report_is_in_the_audit_when_it_changes(fleet: Fleet) -> None:
    for version in (1, 1, 2, 2):
        assert fleet("PUT", "/robots/upload/maps", "upload", json=[held(version)]).status_code == 200
    assert fleet("PUT", "/robots/robot-8/maps", "upload", json=[]).status_code == 403
    notes = fleet("GET", "/audit").json()
    assert [(note["who"], note["status"]) for note in notes] == [("upload", 403), ("upload", 200), ("upload", 200)]
    assert notes[1]["what"].startswith("PUT /robots/upload/maps")


def test_tables_that_no_recording_has_are_not_unpacked(zips: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    usual = zipfile.ZipFile.open

    def opened(self: zipfile.ZipFile, name: Any, *how: Any, **more: Any) -> Any:
        read.append(name.filename)
        return usual(self, name, *how, **more)

    more = renamed(zips[0], lambda files: {**files, "day0/foreign.csv": bytes(3_000_000), "day0/x.toml": b"a"})
    monkeypatch.setattr(zipfile.ZipFile, "open", opened)
    assert checked_digest(more, UploadLimits()) == checked_digest(zips[0], UploadLimits())
    assert read
    assert not any("foreign" in name or "x.toml" in name for name in read)


def test_a_session_is_unpacked_in_pieces(zips: list[bytes]) -> None:
    import tracemalloc

    large = renamed(zips[0], lambda files: {**files, "day0/frames.csv": bytes(200_000_000)})
    tracemalloc.start()
    checked_digest(large, UploadLimits())
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 20_000_000


@SQLITE_ONLY
def test_few_uploads_are_unpacked_at_once(fleet: Fleet, zips: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    now, most, lock = 0, 0, threading.Lock()

    def slowly(data: bytes, limits: UploadLimits) -> str:
        nonlocal now, most
        with lock:
            now += 1
            most = max(most, now)
        time.sleep(0.2)
        with lock:
            now -= 1
        return checked_digest(data, limits)

    monkeypatch.setattr("evermap.server.app.checked_digest", slowly)
    threads = [threading.Thread(target=fleet.upload, args=(zips[0], f"site-{k}")) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 2
    assert len(fleet("GET", "/jobs").json()) == 6


@SQLITE_ONLY
def test_revisions_are_short_paged_and_compressed(fleet: Fleet, zips: list[bytes]) -> None:
    fleet.upload(zips[0])
    fleet.worker().step()
    for _ in range(3):
        fleet("POST", "/maps/ward/pin", json={"landmarks": ["1"]})
        fleet("POST", "/maps/ward/unpin", json={"landmarks": ["1"]})

    def listed(query: str) -> list[int]:
        return [item["revision"] for item in fleet("GET", f"/maps/ward/revisions?{query}").json()]

    assert listed("") == [1, 2, 3, 4, 5, 6, 7]
    assert listed("since=2&most=3") == [3, 4, 5]
    assert listed("since=7") == []
    assert fleet("GET", "/maps/ward/revisions?most=0").status_code == 422
    short, whole = (fleet("GET", f"/maps/ward/revisions{query}").json() for query in ("", "?config=true"))
    assert "[living]" in whole[0]["config"]
    assert [{key: value for key, value in item.items() if key != "config"} for item in whole] == short
    assert all("config" not in item for _, item in _lines_of(fleet))
    path = "/maps/ward/revisions?config=true"
    headers = {"Authorization": f"Bearer {fleet.tokens['read']}"}
    packed = fleet.client.get(path, headers=headers)
    plain = fleet.client.get(path, headers={**headers, "Accept-Encoding": "identity"})
    assert packed.headers["Content-Encoding"] == "gzip"
    assert "Content-Encoding" not in plain.headers
    assert int(packed.headers["Content-Length"]) < len(plain.content) / 2
    assert (packed.content, packed.headers["ETag"]) == (plain.content, plain.headers["ETag"])
    again = fleet.client.get(path, headers={**headers, "If-None-Match": packed.headers["ETag"]})
    assert (again.status_code, again.content) == (304, b"")


def _lines_of(fleet: Fleet) -> list[tuple[int, Any]]:
    with fleet.server.sites.store("ward") as store:
        return [(number, json.loads(line)) for number, line in _lines(store, 0)]


@SQLITE_ONLY
def test_links_have_the_address_that_robots_know(fleet: Fleet, zips: list[bytes]) -> None:
    fleet.upload(zips[0])
    fleet.worker().step()
    fleet("POST", "/maps/ward/approve", json={"revision": 1})

    def link() -> str:
        told = fleet("GET", "/maps/ward/actions").json()["actions"][0]["actionParameters"]
        return next(one["value"] for one in told if one["key"] == "mapDownloadLink")

    assert link() == "http://testserver/maps/ward/file?revision=1"
    for url in ("https://maps.example.com/fleet", "https://maps.example.com/fleet/"):
        fleet.server.public_url = url
        assert link() == "https://maps.example.com/fleet/maps/ward/file?revision=1"


@SQLITE_ONLY
def test_a_revoked_token_is_told_no_more_events(
    fleet: Fleet, zips: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("evermap.server.app._CHECKED_S", 0.5)
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


def test_pruning_keeps_the_approved_revision(fleet: Fleet, zips: list[bytes]) -> None:
    fleet.upload(zips[0])
    fleet.worker().step()
    for _ in range(3):
        fleet("POST", "/maps/ward/pin", json={"landmarks": ["1"]})
        fleet("POST", "/maps/ward/unpin", json={"landmarks": ["1"]})
    with fleet.server.sites.store("other", create=True):
        pass
    fleet("POST", "/maps/ward/approve", json={"revision": 2})

    def pruned(*arguments: str) -> Any:
        done = CliRunner().invoke(command, ["map", "gc", "--keep", "2", "--json", *arguments])
        assert done.exit_code == 0, done.stderr
        return json.loads(done.stdout)

    planned = pruned(fleet.server.sites.address("ward"), "--dry-run")
    assert (planned["pruned"], planned["kept"], planned["approved"]) == ([1, 3, 4, 5], [2, 6, 7], 2)
    assert [item["pruned"] for item in pruned("--store", fleet.where)["maps"]] == [[], [1, 3, 4, 5]]
    fresh = SiteStores(fleet.where)
    fleet.server.sites = fresh
    for path in ("actions", "file?approved=true", "landmarks?revision=2"):
        assert fleet("GET", f"/maps/ward/{path}").status_code == 200, path
    refused = fleet("POST", "/maps/ward/approve", json={"revision": 3})
    assert (refused.status_code, "is pruned" in refused.json()["detail"]) == (422, True)
    fleet("POST", "/maps/ward/approve", json={"revision": 7})
    assert pruned(fleet.server.sites.address("ward"))["kept"] == [6, 7]
