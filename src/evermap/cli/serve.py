"""`evermap serve` and `evermap work`: the maps of a fleet behind HTTP, and the workers that enter its sessions."""

from __future__ import annotations

import errno
import getpass
import itertools
import json
import os
import shutil
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import urlsplit

import typer

from evermap.cli.options import (
    DEFAULT_STORE,
    STORE_VARIABLE,
    AsJson,
    ConfigFile,
    Settings,
    VerbGroup,
    argument,
    configure,
    database_errors,
    option,
)
from evermap.cli.terminal import print_json, print_table, say, warm_up, warn
from evermap.errors import ConfigError, EvermapError, MissingExtraError, printable
from evermap.interrupts import kept

if TYPE_CHECKING:
    from evermap.server.database import Database, Job
    from evermap.server.worker import JobOutcome

app = typer.Typer(
    name="serve", cls=VerbGroup, help="Serve the maps of a fleet.", rich_markup_mode=None, invoke_without_command=True
)

Store = Annotated[
    str,
    option(
        "--store", "Folder of the maps, or postgresql://user@host/database.", metavar="WHERE", envvar=STORE_VARIABLE
    ),
]
_PATIENCE_S = 600.0
"""Waiting time of a session that indicates too few workers."""
_MOST_UPLOADS = 10
"""Number of the largest uploads that must fit on the disk."""
_ASK_S = 5.0


@app.callback()
def serve(
    ctx: typer.Context,
    store: Store = DEFAULT_STORE,
    host: Annotated[str, option("Address to listen on; 0.0.0.0 for all.")] = "127.0.0.1",
    port: Annotated[int, option("Port to listen on.", min=0, max=65535)] = 8080,
    workers: Annotated[int, option("Worker processes that enter sessions, see evermap work.", min=0, max=64)] = 1,
    certificate: Annotated[
        Path | None, option("--tls-cert", "TLS certificate chain.", metavar="FILE", default="no TLS")
    ] = None,
    key: Annotated[Path | None, option("--tls-key", "Key of the certificate.", metavar="FILE", default=False)] = None,
    public_url: Annotated[
        str | None,
        option("Address at which robots reach the server, used in links.", metavar="URL", default="of each request"),
    ] = None,
) -> None:
    """Serve the maps of a fleet: sessions are uploaded, queued, and entered by workers.

    Without an administrator's token, one is created and printed.

    \b
    Examples:
      evermap serve --store maps
      evermap serve --store postgresql://evermap@db/fleet --host 0.0.0.0 --workers 2
      evermap serve token robot-7 --role upload --store maps
    """
    if ctx.invoked_subcommand is not None:
        return
    tls = _tls(certificate, key)
    if public_url is not None and urlsplit(public_url).scheme not in ("http", "https"):
        raise ConfigError("is not an address", field="--public-url", hint="https://maps.example.com")
    database = _database(store)
    uvicorn = _uvicorn()
    from evermap.server.app import create_app
    from evermap.server.sites import SiteStores
    from evermap.server.state import Server, prepare
    from evermap.server.worker import Crew

    listener = listening_at(host, port)
    _print_first_token(database)
    os.environ[STORE_VARIABLE] = store  # of the workers: command lines, which all users see, show no password
    crew = Crew([sys.executable, "-m", "evermap", "work", "--under", str(os.getpid())], workers, warn)
    server = Server(database, SiteStores(store), public_url=public_url, workers=crew.alive)
    how = {"log_level": "warning", "server_header": False, "timeout_graceful_shutdown": 5}
    served = uvicorn.Server(uvicorn.Config(create_app(server), **how, **tls))
    for number in (signal.SIGINT, signal.SIGTERM):  # its own until it runs: no signal is lost before
        signal.signal(number, served.handle_exit)
    prepare(server)
    scheme, at = "https" if tls else "http", f"[{host}]" if ":" in host else host
    say(f"serving {scheme}://{at}:{listener.getsockname()[1]}; Ctrl-C ends it")
    with crew:
        served.run(sockets=[listener])
    say("the server has stopped")


def _tls(certificate: Path | None, key: Path | None) -> dict[str, str]:
    """Return the options of uvicorn for TLS; none without a certificate.

    Raises:
        ConfigError: one of the files is missing or cannot be used.
    """
    import ssl

    if certificate is None and key is None:
        return {}
    if certificate is None or key is None:
        raise ConfigError("TLS needs both", field="--tls-cert", hint="--tls-cert FILE --tls-key FILE")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    hint = "files in PEM format, the key without a password"
    for path, option_name in ((certificate, "--tls-cert"), (key, "--tls-key")):
        if not path.is_file():
            raise ConfigError("no such file", path=path, field=option_name, hint=hint)
        try:
            if path is certificate:
                context.load_verify_locations(path)
            else:
                context.load_cert_chain(certificate, key, password="")  # rather than to ask for one
        except OSError as error:
            problem = f"cannot be used: {printable(str(error.strerror or error), 100)}"
            raise ConfigError(problem, path=path, field=option_name, hint=hint) from None
    return {"ssl_certfile": str(certificate), "ssl_keyfile": str(key)}


def listening_at(host: str, port: int) -> socket.socket:
    """Return a socket that listens, and whose connections send small answers at once.

    asyncio asks for that only of sockets that say that they are TCP, which this one does not: the second answer on a
    connection would wait 40 ms for the other side to acknowledge the head of it.

    Raises:
        ConfigError: the port is in use, or the address is not of this machine.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        listener = socket.create_server((host, port), family=family)
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return listener
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            problem, hint = f"port {port} of {host} is in use", f"--port {port + 1}, or end what listens there"
        else:
            problem = f"cannot listen on port {port} of {printable(host, 60)}: {error.strerror}"
            hint = "an address of this machine, and a port from 1024 on"
        raise ConfigError(problem, field="--port", hint=hint) from None


def _print_first_token(database: Database) -> None:
    """Make and print the token of an administrator where there is none."""
    from evermap.server.database import Role

    known = database.tokens()
    if any(row["role"] == Role.ADMIN.name.lower() for row in known):
        return
    taken = {row["name"] for row in known}
    name = next(name for k in itertools.count(1) if (name := "admin" if k == 1 else f"admin-{k}") not in taken)
    typer.echo(database.add_token(name, Role.ADMIN))
    database.note(_operator(), f"first token {name}, role admin", 200)
    say("this administrator token is shown once; more tokens: evermap serve token NAME --role ROLE")


def _operator() -> str:
    """Return who is at this machine, for the audit."""
    try:
        name = getpass.getuser()
    except (OSError, KeyError):  # a user without a name, as in a container
        name = str(os.getuid())
    return f"{name}@{socket.gethostname()}"


@app.command("token")
def token(
    name: Annotated[str | None, argument("Name of the robot or person.", metavar="NAME", default=False)] = None,
    role: Annotated[str, option("Its permissions.", metavar="read|upload|approve|admin")] = "upload",
    revoke: Annotated[bool, option("--revoke", "Revoke the token of this name.")] = False,
    store: Store = DEFAULT_STORE,
    as_json: AsJson = False,
) -> None:
    """Make a token and print it, once; without a name, list them.

    \b
    Examples:
      evermap serve token robot-7 --role upload --store maps
      evermap serve token robot-7 --revoke --store maps
    """
    from evermap.errors import suggestion

    database = _database(store)
    from evermap.server.database import Role

    if name is None:
        rows = database.tokens()
        if as_json:
            print_json({"tokens": rows})
        else:
            print_table("tokens", [[*row.values()] for row in rows], ("name", "role", "made (UTC)"))
        return
    if not name.strip() or len(name) > 100 or not name.isprintable():
        raise ConfigError("a token needs a name of up to 100 printable characters", field="name", hint="robot-7")
    if revoke:
        if not database.revoke_token(name):
            known = [row["name"] for row in database.tokens()]
            raise ConfigError(f"no token '{name}'", field="name", hint=suggestion(name, known))
        database.note(_operator(), f"token {name} revoked", 200)
        say(f"the token of {name} is revoked")
        return
    roles = {item.name.lower(): item for item in Role}
    if role not in roles:
        raise ConfigError(f"unknown role '{role}'", field="role", hint=suggestion(role, roles))
    text = database.add_token(name, roles[role])
    database.note(_operator(), f"token {name}, role {role}", 200)
    if as_json:
        print_json({"name": name, "role": role, "token": text})
        return
    typer.echo(text)
    say(f"the token of {name}, role {role}; it is shown once")


@app.command("doctor")
def doctor(
    store: Store = DEFAULT_STORE,
    url: Annotated[
        str, option("Address at which robots reach the server; '' to skip this check.", metavar="URL")
    ] = "http://127.0.0.1:8080",
    as_json: AsJson = False,
) -> None:
    """Look whether a server has all that it needs.

    Database, tokens, maps, queue, workers, disk and TLS: a line each, exit code 1 where something is wrong.

    \b
    Examples:
      evermap serve doctor --store maps
      evermap serve doctor --store postgresql://evermap@db/fleet --url https://maps.example.com
    """
    found = [*_of_database(store), *([_of_address(url)] if url else [])]
    if as_json:
        print_json({"checks": [{"what": what, "fine": fine, "told": told} for what, fine, told in found]})
    else:
        for what, fine, told in found:
            typer.echo(f"{'fine ' if fine else 'WRONG'}  {what}: {told}")
    if not all(fine for _, fine, _ in found):
        raise typer.Exit(1)


def _of_database(store: str) -> Iterator[tuple[str, bool, str]]:
    """Yield the checks of a server's store: name, result, and a line."""
    from evermap.maps.store import is_address
    from evermap.server.database import VERSION, Role
    from evermap.server.sites import SiteStores, store_place
    from evermap.server.uploads import UploadLimits
    from evermap.server.worker import LEASE_S

    try:
        if not is_address(store_place(store)) and not Path(store, "server.db").is_file():
            raise ConfigError("contains no server yet", field="store", hint=f"evermap serve --store {store}")
        database = _database(store)
    except EvermapError as error:
        yield "database", False, error.one_line()
        return
    yield "database", True, f"answers; tables of version {VERSION}"
    roles = [row["role"] for row in database.tokens()]
    told = ", ".join(f"{roles.count(role.name.lower())} {role.name.lower()}" for role in Role)
    yield "tokens", "admin" in roles, told + ("" if "admin" in roles else "; evermap serve token NAME --role admin")
    broken, sites = [], SiteStores(store)
    names = sites.names()
    for site in names:
        try:
            with sites.store(site) as one:
                one.named()
        except EvermapError as error:
            broken.append(f"{site}: {error.one_line()}")
    yield "maps", not broken, "; ".join(broken) or f"{len(names)}, each with a newest revision"
    by_state, waits_s, working = database.queue()
    told = ", ".join(f"{count} {state}" for state, count in sorted(by_state.items())) or "no session yet"
    yield "queue", waits_s < _PATIENCE_S, f"{told}; the oldest has waited for {waits_s:.0f} s"
    idle = waits_s > LEASE_S and not working
    yield "workers", not idle, "sessions wait, and no worker runs: evermap work" if idle else f"{working} busy"
    limits, size = UploadLimits(), database.n_bytes()
    yield "limits", True, f"{limits.n_bytes / 1e6:.0f} MB per upload, {limits.unpacked_bytes / 1e6:.0f} MB unpacked"
    if size is None:
        free = shutil.disk_usage(store).free
        yield "disk", free > _MOST_UPLOADS * limits.n_bytes, f"{free / 1e9:.1f} GB free"
    else:
        yield "disk", True, f"the database has {size / 1e9:.2f} GB; check the free space on its machine"


def _of_address(url: str) -> tuple[str, bool, str]:
    """Return whether a server answers there over TLS."""
    from urllib.request import urlopen

    host, scheme = urlsplit(url).hostname or "", urlsplit(url).scheme
    if scheme not in ("http", "https"):
        return "address", False, f"'{printable(url, 100)}' is not the address of a server: https://maps.example.com"
    local = host in ("localhost", "127.0.0.1", "::1")
    try:
        with urlopen(f"{url.rstrip('/')}/healthz", timeout=_ASK_S) as answer:  # noqa: S310  (http or https, see above)
            said = json.load(answer)
            told, workers = said["evermap"], said.get("workers", 0)
    except (OSError, ValueError, KeyError, TypeError) as error:
        return "address", False, f"no server answers at {url}: {printable(str(error), 100)}"
    if scheme != "https" and not local:
        return "address", False, f"{url} does not use TLS, so tokens can be read in transit: --tls-cert, or a proxy"
    seen = ", seen from this machine" if local else ""
    return "address", True, f"evermap {told} answers at {url}{seen}, with {workers} workers of its own"


def work(
    store: Store = DEFAULT_STORE,
    config: ConfigFile = None,
    settings: Settings = None,
    drain: Annotated[bool, option("--drain", "Exit as soon as no session waits.")] = False,
    lease_s: Annotated[
        float, option("Time after which another worker takes over a session [s].", min=1.0, max=3600.0)
    ] = 60.0,
    as_json: Annotated[bool, option("--json", "Print the result of each, one JSON object per line.")] = False,
    under: Annotated[int | None, option("End with this parent process.", hidden=True, default=False)] = None,
) -> None:
    """Enter the sessions that were uploaded to a server.

    By the code of `evermap map enter`; as many workers as you like, on any machine that reaches the database.

    \b
    Examples:
      evermap work --store maps --drain
      evermap work --store postgresql://evermap@db/fleet --set living.search=gate
    """
    kept(os.curdir, "a session in work returns to the queue")
    with suppress(OSError):
        os.nice(10)  # who asks the server goes first, also while this one loads its code
    chosen = configure(config, settings)
    database = _database(store)
    from evermap.server.sites import SiteStores
    from evermap.server.worker import Worker, end_without

    if under is not None:
        end_without(under)

    def told(job: Job, outcome: JobOutcome) -> None:
        became = outcome.state.value if outcome.revision is None else f"revision {outcome.revision}"
        if as_json:
            of = {"job": job.id, "site": job.site, "robot": job.robot, "state": outcome.state.value}
            said = {"revision": outcome.revision, "verdict": outcome.verdict, "reason": outcome.reason}
            typer.echo(json.dumps({**of, **said}))
        why = f" ({outcome.text})" if outcome.text else ""
        say(f"session {job.id} of {job.robot} for {job.site}: {became}{why}")

    warm_up()
    Worker(database, SiteStores(store), chosen, lease_s).run(told, drain=drain)


def _database(store: str) -> Database:
    from evermap.server.database import Database

    with database_errors():
        return Database(store)


def _uvicorn() -> Any:
    try:
        import fastapi  # noqa: F401
        import uvicorn
    except ImportError as error:
        problem = f"a server needs the package {error.name}, which is not installed"
        raise MissingExtraError(problem, hint="pip install 'evermap[server]'") from None
    return uvicorn
