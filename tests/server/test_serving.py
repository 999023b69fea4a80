"""`evermap serve` as a process: how it starts, what it says, and what is left of it when it ends."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

import pytest
from typer.testing import CliRunner, Result

pytest.importorskip("fastapi", reason="a server needs evermap[server]")

from evermap.cli.main import app
from evermap.cli.serve import listening_at
from evermap.server.database import Database, Role
from evermap.server.worker import Crew

PATIENCE_S = 120.0


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def wait_until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


def runs(process: int) -> bool:
    """Return whether a process exists that is no zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def nice(process: int) -> int:
    try:
        return os.getpriority(os.PRIO_PROCESS, process)
    except OSError:
        return 0


def workers_of(store: Path) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0") if entry.name.isdecimal() else []
            told = (entry / "environ").read_bytes().split(b"\0") if b"work" in words else []
        except OSError:
            continue
        if f"EVERMAP_STORE={store}".encode() in told:
            assert str(store).encode() not in words, "a command line would show a password"
            found.append(int(entry.name))
    return [number for number in found if runs(number)]


@contextmanager
def serving(store: Path, *more: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Yield a server, and its address."""
    command = [sys.executable, "-m", "evermap", "serve", "--store", str(store), "--port", "0", *more]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        line = next(line for line in process.stderr if "serving" in line)
        yield process, line.split()[2].rstrip(";")
    finally:
        process.kill()
        process.wait()
        for worker in workers_of(store):
            os.kill(worker, signal.SIGKILL)


def health(url: str) -> dict[str, int]:
    with urlopen(f"{url}/healthz", timeout=10.0) as answer:
        told: dict[str, int] = json.load(answer)
    return told


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="needs /proc")
@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGKILL]
)
def test_workers_are_replaced_and_end_with_their_server(tmp_path: Path, number: signal.Signals) -> None:
    store = tmp_path / "maps"
    with serving(store, "--workers", "1") as (process, url):
        wait_until(lambda: health(url)["workers"] == 1)
        (first,) = workers_of(store)
        os.kill(first, signal.SIGKILL)
        wait_until(lambda: workers_of(store) not in ([], [first]))
        wait_until(lambda: health(url)["workers"] == 1)
        wait_until(lambda: any(nice(worker) >= 10 for worker in workers_of(store)))  # it has begun
        process.send_signal(number)
        process.wait(timeout=PATIENCE_S)
        wait_until(lambda: not workers_of(store))
        assert process.stderr is not None
        told = process.stderr.read()
    assert "a worker ended with code -9; another starts in" in told
    assert "no result was written" not in told
    if number is not signal.SIGKILL:
        assert process.returncode == 0
        assert told.endswith("evermap: the server has stopped\n")


def test_small_answers_on_one_connection_wait_for_no_acknowledgement() -> None:
    with listening_at("127.0.0.1", 0) as listening, socket.create_connection(listening.getsockname()):
        accepted, _ = listening.accept()
        with accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == 1


def test_what_dies_at_once_is_started_again_after_growing_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evermap.server.worker._PAUSE_S", 0.05)
    told: list[str] = []
    with Crew([sys.executable, "-S", "-c", "raise SystemExit(3)"], 1, told.append) as crew:
        wait_until(lambda: len(told) == 3)
        start = time.monotonic()
        wait_until(lambda: len(told) == 5)
        assert time.monotonic() - start > 0.4 + 0.8
        wait_until(lambda: not crew.alive())
    assert {line.partition(";")[0] for line in told} == {"a worker ended with code 3"}


def assert_refused(result: Result, *words: str) -> None:
    assert result.exit_code == 2, result.stderr
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    for word in words:
        assert word in line


def test_a_port_in_use_is_one_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        result = run("serve", "--store", tmp_path, "--port", port, "--workers", 0)
    assert_refused(result, f"port {port} of 127.0.0.1 is in use", f"--port {port + 1}")
    assert Database(tmp_path).tokens() == []
    assert_refused(run("serve", "--store", tmp_path, "--host", "no-such-host.invalid"), "cannot listen")


def test_files_for_tls_that_cannot_be_used_are_one_line(tmp_path: Path) -> None:
    certificate, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    made = subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=x",
         "-keyout", key, "-out", certificate],
        capture_output=True, check=False,
    )  # fmt: skip
    if made.returncode:
        pytest.skip("needs openssl")
    broken = tmp_path / "broken.pem"
    broken.write_text("-----BEGIN PRIVATE KEY-----\nbm90IGEga2V5\n-----END PRIVATE KEY-----\n")
    store = tmp_path / "maps"
    asked = ("serve", "--store", store, "--workers", 0)
    assert_refused(run(*asked, "--tls-cert", certificate, "--tls-key", broken), "broken.pem", "--tls-key")
    assert_refused(run(*asked, "--tls-cert", broken, "--tls-key", key), "broken.pem", "--tls-cert")
    assert_refused(run(*asked, "--tls-cert", certificate, "--tls-key", tmp_path / "none.pem"), "none.pem")
    assert_refused(run(*asked, "--tls-cert", certificate), "--tls-cert")
    assert not store.exists()
    with serving(store, "--workers", "0", "--tls-cert", str(certificate), "--tls-key", str(key)) as (_, url):
        assert url.startswith("https://")


def test_a_token_of_an_administrator_is_printed_while_there_is_none(tmp_path: Path) -> None:
    assert run("serve", "token", "admin", "--role", "upload", "--store", tmp_path).exit_code == 0
    printed = []
    for _ in range(2):
        with serving(tmp_path, "--workers", "0") as (process, _url):
            process.send_signal(signal.SIGTERM)
            printed.append(process.communicate(timeout=PATIENCE_S)[0].split())
    (first,), later = printed
    assert later == []
    database = Database(tmp_path)
    assert database.who(first) == ("admin-2", Role.ADMIN)
    assert len(database.tokens()) == 2
    assert database.audit()[0]["what"] == "first token admin-2, role admin"


@pytest.mark.parametrize("name", ["", " ", "x" * 101, "a\nb", "\x1b[2J"])
def test_names_of_tokens_are_short_and_printable(tmp_path: Path, name: str) -> None:
    assert_refused(run("serve", "token", name, "--store", tmp_path), "up to 100 printable characters")


def test_tokens_are_in_the_audit(tmp_path: Path) -> None:
    run("serve", "token", "robot-7", "--store", tmp_path)
    run("serve", "token", "robot-7", "--revoke", "--store", tmp_path)
    notes = Database(tmp_path).audit()
    assert [note["what"] for note in notes] == ["token robot-7 revoked", "token robot-7, role upload"]
    assert all("@" in note["who"] for note in notes)


@pytest.mark.parametrize("store", ["mysql://u@h/fleet", "redis://h", "sqlite:///maps"])
def test_a_store_of_another_scheme_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, store: str) -> None:
    monkeypatch.chdir(tmp_path)
    for verb in (("serve",), ("serve", "token", "x"), ("work", "--drain"), ("learn",), ("map", "gc")):
        assert_refused(run(*verb, "--store", store), f"field '--store': no store for '{store.partition(':')[0]}://'")
    result = run("serve", "doctor", "--url", "", "--store", store)
    assert (result.exit_code, "no store for" in result.stdout) == (1, True)
    assert list(tmp_path.iterdir()) == []


def test_the_short_name_of_postgresql_is_known() -> None:
    from evermap.server.sites import SiteStores, store_place

    assert store_place("postgres://u@h/fleet") == "postgresql://u@h/fleet"
    assert SiteStores("postgres://u@h/fleet").address("ward") == "postgresql://u@h/fleet/ward"


def test_the_store_of_the_environment_is_that_of_every_verb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from evermap.cli.learn import sites_of
    from evermap.maps.store import open_store

    monkeypatch.chdir(tmp_path)
    for folder, site in (("evermap-maps", "a"), ("other", "b")):
        (tmp_path / folder).mkdir()
        open_store(tmp_path / folder / f"{site}.evermap", create=True).close()
    assert list(sites_of([], None)) == ["a"]
    monkeypatch.setenv("EVERMAP_STORE", str(tmp_path / "other"))
    assert list(sites_of([], None)) == ["b"]
    assert list(sites_of(["evermap-maps/a.evermap"], None)) == ["a"]
    assert list(sites_of([], "evermap-maps")) == ["a"]
    assert_refused(run("map", "gc"), "nothing to prune")


def test_all_versions_of_a_server_are_pinned() -> None:
    """`examples/compose.yaml` and the README install by the lock file."""
    root = Path(__file__).resolve().parents[2]
    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    locked = {line.partition("==")[0] for line in (root / "requirements.lock").read_text().splitlines()}
    missing = {re.split(r"[\[>=]", name)[0] for name in (*extras["server"], *extras["ros"])} - locked
    assert not missing
