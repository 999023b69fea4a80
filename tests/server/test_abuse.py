"""Random, long and strange requests: refused in a line, at little cost."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any
from urllib.parse import quote, urlencode

import pytest

pytest.importorskip("fastapi", reason="a server needs evermap[server]")
pytest.importorskip("httpx", reason="needs httpx: pip install 'evermap[dev]'")

import httpx
from fleets import SQLITE_ONLY, Fleet, held, served
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from evermap.server.gate import Gate
from evermap.server.uploads import UploadLimits


@pytest.mark.parametrize("where", ["sqlite"], indirect=True)
def test_too_many_requests_are_told_to_wait(fleet: Fleet) -> None:
    fleet.server.rate_hz = 0.0
    answers = [fleet("GET", "/jobs", "read").status_code for _ in range(210)]
    assert (answers.count(200), answers.count(429)) == (200, 10)
    assert fleet("GET", "/jobs", "upload").status_code == 200


ODD = st.one_of(
    st.text(max_size=12),
    st.integers(-(2**70), 2**70).map(str),
    st.floats().map(str),
    st.sampled_from(
        ["", "ward", "1", "true", "queued", "\0", "%00", "' OR 1=1 --", "<b>", "\ud800", "۱", "٣", "1e999"]
    ),
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
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
