"""Answers of a server: who may ask what, and what operators and robots are told."""

from __future__ import annotations

import hashlib
import json
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="a server needs evermap[server]")
pytest.importorskip("httpx", reason="needs httpx: pip install 'evermap[dev]'")

from fleets import BOTH_DATABASES, SQLITE_ONLY, Fleet, assert_same, held
from sqlalchemy import text
from typer.testing import CliRunner

from evermap.cli.main import app as command
from evermap.errors import ConfigError, InputError
from evermap.io import read_native
from evermap.maps.store import Provenance, open_store, verify_store
from evermap.runs.sessions import enter_session
from evermap.server.database import Database, Role
from evermap.server.events import _since
from evermap.server.sites import SiteStores


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


@BOTH_DATABASES
def test_a_session_is_uploaded_entered_and_asked_about(fleet: Fleet, zips: list[bytes], tmp_path: Path) -> None:
    answer = fleet.upload(zips[0])
    assert answer.status_code == 202
    job = answer.json()
    assert (job["state"], job["robot"], job["site"], job["verdict"]) == ("queued", "upload", "ward", "")
    again = fleet.upload(zips[0])
    assert (again.status_code, again.json()["id"]) == (200, job["id"])
    fleet.upload(zips[2])
    worker = fleet.worker()
    while worker.step():
        pass
    entered = fleet("GET", f"/jobs/{job['id']}").json()
    assert (entered["state"], entered["verdict"]) == ("entered", "sound")
    assert "sound" not in entered["reason"]
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


@SQLITE_ONLY
def test_robots_are_where_their_newest_sessions_ended(fleet: Fleet, folders: list[Path]) -> None:
    parts = [replace(read_native(folders[k]), robot=f"robot-{k % 2}") for k in range(3)]
    with fleet.server.sites.store("ward", create=True) as store:
        entered = [enter_session(store, part) for part in parts[:1]]
        entered[0].commit(store)
        for part in parts[1:]:
            entered.append(enter_session(store, part))
            entered[-1].commit(store)
        store.commit(store.load(), Provenance(robot="old", stamp_from_s=1.0, stamp_to_s=2.0), parent=store.head())
    told = fleet("GET", "/maps/ward/poses").json()["robots"]
    assert [(one["robot"], one["revision"]) for one in told] == [("old", 4), ("robot-0", 3), ("robot-1", 2)]
    assert (told[0]["x_m"], told[0]["stamp_s"], told[0]["path_m"]) == (None, None, [])  # an older evermap kept none
    path = entered[2].session.slam.trajectory
    last = [told[1][name] for name in ("stamp_s", "x_m", "y_m", "heading_rad")]
    np.testing.assert_allclose(last, [path.stamp_s[-1], *path.pose_world_robot[-1]], rtol=1e-6, atol=1e-6)
    assert 2 < len(told[1]["path_m"]) <= 200
    earlier = fleet("GET", "/maps/ward/poses?revision=1").json()["robots"]
    assert [(one["robot"], one["revision"]) for one in earlier] == [("robot-0", 1)]
    middle_s = float(path.stamp_s[len(path) // 2])
    (then,) = (
        one for one in fleet("GET", f"/maps/ward/poses?at_s={middle_s}").json()["robots"] if one["revision"] == 3
    )
    assert 0.0 <= middle_s - then["stamp_s"] < 1.0
    assert fleet("GET", "/maps/ward/poses?at_s=nan").status_code == 422
    assert fleet("GET", "/maps/ward/poses?revision=9").status_code == 404


def test_the_doctor_tells_what_is_wrong(fleet: Fleet, zips: list[bytes]) -> None:
    def looked(*more: str) -> tuple[int, dict[str, bool]]:
        done = CliRunner().invoke(command, ["serve", "doctor", "--store", fleet.where, "--json", *more])
        assert not done.stderr
        return done.exit_code, {item["what"]: item["fine"] for item in json.loads(done.stdout)["checks"]}

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
    done = CliRunner().invoke(command, ["serve", "doctor", "--url", "", "--store", str(tmp_path / "maps")])
    assert (done.exit_code, done.stdout.startswith("WRONG  database: ")) == (1, True)
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


def test_an_operator_calls_a_landmark_otherwise(fleet: Fleet, zips: list[bytes]) -> None:
    fleet.upload(zips[0])
    fleet.worker().step()
    one, other = fleet("GET", "/maps/ward/landmarks").json()["landmarks"][:2]
    said = {"landmark": one["label"], "name": "by the door", "note": "as we do"}
    assert fleet("POST", "/maps/ward/rename", "upload", json=said).status_code == 403
    told = fleet("POST", "/maps/ward/rename", json=said).json()
    note = f"renamed landmark {one['label']} to by the door: as we do"
    assert told == {"site": "ward", "revision": 2, "label": "by the door", "note": note}
    again = fleet("GET", "/maps/ward/landmarks").json()["landmarks"][0]
    assert (again["landmark"], again["label"]) == (one["landmark"], "by the door")
    assert fleet("GET", "/maps/ward/landmarks/by the door/why").json()["landmark"] == one["landmark"]
    assert fleet("POST", "/maps/ward/rename", json={**said, "landmark": other["label"]}).status_code in (400, 404, 422)
    assert [item["what"] for item in fleet("GET", "/maps/ward/diff?a=1&b=2").json()["edits"]] == [
        f"renamed from {one['label']}"
    ]


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


def test_a_store_of_before_there_were_robots_is_read(tmp_path: Path) -> None:
    import sqlite3

    Database(tmp_path).close()
    with sqlite3.connect(tmp_path / "server.db") as connection:
        connection.execute("DROP TABLE robot")
    assert Database(tmp_path).robots() == []


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
    with pytest.raises(InputError, match="of version 9, this evermap has 2"):
        Database(tmp_path)


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
    return [(number, json.loads(line)) for number, line in _since(fleet.server, "ward", 0)]


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


@BOTH_DATABASES
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
