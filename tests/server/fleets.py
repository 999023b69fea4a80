"""A server with a token for every role, and sessions to upload, for the tests of a server."""

from __future__ import annotations

import io
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

pytest.importorskip("fastapi", reason="a server needs evermap[server]")
pytest.importorskip("httpx", reason="needs httpx: pip install 'evermap[dev]'")

import httpx
import uvicorn
from fastapi.testclient import TestClient

from evermap.config import Config
from evermap.maps.living import LivingMap
from evermap.server.app import create_app
from evermap.server.state import Server
from evermap.server.worker import Worker


def zipped(files: Mapping[str, bytes], **how: Any) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", **{"compression": zipfile.ZIP_DEFLATED, **how}) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


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

    def worker(self, lease_s: float = 60.0, config: Config | None = None) -> Worker:
        return Worker(self.server.database, self.server.sites, config or Config(), lease_s)


def assert_same(a: LivingMap, b: LivingMap) -> None:
    one, other = a.landmarks(), b.landmarks()
    np.testing.assert_array_equal(one.landmark_id, other.landmark_id)
    for name in ("position_m", "covariance_m2", "p_exists", "n_hits", "n_misses", "last_seen_s"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0.0, atol=1e-12, err_msg=name)


def held(version: int | str, status: str = "ENABLED", site: str = "ward") -> dict[str, str]:
    return {"mapId": site, "mapVersion": str(version), "mapStatus": status}


def renamed(data: bytes, change: Callable[[dict[str, bytes]], Mapping[str, bytes]], **how: Any) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    return zipped(change(files), **how)


SQLITE = b"SQLite format 3\0"


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


SQLITE_ONLY = pytest.mark.parametrize("where", ["sqlite"], indirect=True)
BOTH_DATABASES = pytest.mark.parametrize("where", ["sqlite", "postgresql"], indirect=True)
