"""`evermap serve` and `evermap work`: the maps of a fleet behind HTTP, and the workers that enter its sessions."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import urlsplit

import typer

from evermap.cli.options import AsJson, ConfigFile, Settings, argument, configured, option
from evermap.cli.terminal import print_json, print_table, say, warm_up
from evermap.errors import ConfigError, EvermapError, MissingExtraError, printable

if TYPE_CHECKING:
    from evermap.server.database import Database, Job
    from evermap.server.worker import JobOutcome

app = typer.Typer(
    name="serve",
    help="Serve the maps of a fleet.",
    rich_markup_mode=None,
    invoke_without_command=True,
)

Store = Annotated[
    str,
    option(
        "--store", "Folder of the maps, or postgresql://user@host/database.", metavar="WHERE", envvar="EVERMAP_STORE"
    ),
]
_DEFAULT = "evermap-maps"
_PATIENCE_S = 600.0
"""Waiting time of a session that indicates too few workers."""
_MOST_UPLOADS = 10
"""Number of the largest uploads that must fit on the disk."""
_ASK_S = 5.0


@app.callback()
def serve(
    ctx: typer.Context,
    store: Store = _DEFAULT,
    host: Annotated[str, option("Address to listen on; 0.0.0.0 for all.")] = "127.0.0.1",
    port: Annotated[int, option("Port to listen on.", min=0, max=65535)] = 8080,
    workers: Annotated[int, option("Worker processes that enter sessions, see evermap work.", min=0, max=64)] = 1,
    certificate: Annotated[
        Path | None, option("--tls-cert", "TLS certificate chain.", metavar="FILE", default="no TLS")
    ] = None,
    key: Annotated[Path | None, option("--tls-key", "Key of the certificate.", metavar="FILE", default=False)] = None,
) -> None:
    """Serve the maps of a fleet: sessions are uploaded, queued, and entered by workers.

    Without any token, that of an administrator is created and printed.

    \b
    Examples:
      evermap serve --store maps
      evermap serve --store postgresql://evermap@db/fleet --host 0.0.0.0 --workers 2
      evermap serve token robot-7 --role upload --store maps
    """
    if ctx.invoked_subcommand is not None:
        return
    if (certificate is None) != (key is None):
        raise ConfigError("TLS needs both", field="tls-cert", hint="--tls-cert FILE --tls-key FILE")
    for path in (certificate, key):
        if path is not None and not path.is_file():
            raise ConfigError("no such file", path=path, field="tls-cert", hint="files in PEM format")
    database = _database(store)
    uvicorn = _uvicorn()
    from evermap.server.app import Server, create_app, prepare
    from evermap.server.database import Role
    from evermap.server.sites import SiteStores

    if not database.tokens():
        typer.echo(database.add_token("admin", Role.ADMIN))
        say("this administrator token is shown once; more tokens: evermap serve token NAME --role ROLE")
    server = Server(database, SiteStores(store))
    prepare(server)
    scheme = "http" if certificate is None else "https"
    say(f"serving {scheme}://{host}:{port}; Ctrl-C ends it")
    tls = {} if certificate is None else {"ssl_certfile": str(certificate), "ssl_keyfile": str(key)}
    with _working(store, workers):
        uvicorn.run(
            create_app(server),
            host=host,
            port=port,
            log_level="warning",
            server_header=False,
            timeout_graceful_shutdown=5,
            **tls,
        )


@app.command("token")
def token(
    name: Annotated[str | None, argument("Name of the robot or person.", metavar="NAME", default=False)] = None,
    role: Annotated[str, option("Its permissions.", metavar="read|upload|approve|admin")] = "upload",
    revoke: Annotated[bool, option("--revoke", "Revoke the token of this name.")] = False,
    store: Store = _DEFAULT,
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
    if not name.strip() or len(name) > 100:
        raise ConfigError("a token needs a name of up to 100 characters", field="name", hint="robot-7")
    if revoke:
        if not database.revoke_token(name):
            known = [row["name"] for row in database.tokens()]
            raise ConfigError(f"no token '{name}'", field="name", hint=suggestion(name, known))
        say(f"the token of {name} is revoked")
        return
    roles = {item.name.lower(): item for item in Role}
    if role not in roles:
        raise ConfigError(f"unknown role '{role}'", field="role", hint=suggestion(role, roles))
    text = database.add_token(name, roles[role])
    if as_json:
        print_json({"name": name, "role": role, "token": text})
        return
    typer.echo(text)
    say(f"the token of {name}, role {role}; it is shown once")


@app.command("doctor")
def doctor(
    store: Store = _DEFAULT,
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
    from evermap.server.sites import SiteStores
    from evermap.server.uploads import UploadLimits
    from evermap.server.worker import LEASE_S

    try:
        if not is_address(store) and not Path(store, "server.db").is_file():
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
        with urlopen(f"{url.rstrip('/')}/healthz", timeout=_ASK_S) as answer:  # nosec  # B310: http or https, see above
            told = json.load(answer)["evermap"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        return "address", False, f"no server answers at {url}: {printable(str(error), 100)}"
    if scheme != "https" and not local:
        return "address", False, f"{url} does not use TLS, so tokens can be read in transit: --tls-cert, or a proxy"
    return "address", True, f"evermap {told} answers at {url}{'' if not local else ', seen from this machine'}"


def work(
    store: Store = _DEFAULT,
    config: ConfigFile = None,
    settings: Settings = None,
    drain: Annotated[bool, option("--drain", "Exit as soon as no session waits.")] = False,
    lease_s: Annotated[
        float, option("Time after which another worker takes over a session [s].", min=1.0, max=3600.0)
    ] = 60.0,
    as_json: Annotated[bool, option("--json", "Print the result of each, one JSON object per line.")] = False,
) -> None:
    """Enter the sessions that were uploaded to a server.

    By the code of `evermap slam --map`; as many workers as you like, on any machine that reaches the database.

    \b
    Examples:
      evermap work --store maps --drain
      evermap work --store postgresql://evermap@db/fleet --set living.search=gate
    """
    with suppress(OSError):
        os.nice(10)  # who asks the server goes first, also while this one loads its code
    chosen = configured(config, settings)
    database = _database(store)
    from evermap.server.sites import SiteStores
    from evermap.server.worker import Worker

    def told(job: Job, outcome: JobOutcome) -> None:
        became = outcome.state.value if outcome.revision is None else f"revision {outcome.revision}"
        if as_json:
            of = {"job": job.id, "site": job.site, "robot": job.robot, "state": outcome.state.value}
            typer.echo(json.dumps({**of, "revision": outcome.revision, "reason": outcome.reason}))
        say(
            f"session {job.id} of {job.robot} for {job.site}: {became}"
            + (f" ({outcome.reason})" if outcome.reason else "")
        )

    warm_up()
    Worker(database, SiteStores(store), chosen, lease_s).run(told, drain=drain)


def _database(store: str) -> Database:
    from sqlalchemy.exc import DBAPIError

    from evermap.server.database import Database

    try:
        return Database(store)
    except DBAPIError as error:
        hint = "check the address, the rights of the user, and that the server runs"
        raise ConfigError(f"the database cannot be used: {error.orig}", field="store", hint=hint) from None


def _uvicorn() -> Any:
    try:
        import fastapi  # noqa: F401
        import uvicorn
    except ImportError as error:
        problem = f"a server needs the package {error.name}, which is not installed"
        raise MissingExtraError(problem, hint="pip install 'evermap[server]'") from None
    return uvicorn


@contextmanager
def _working(store: str, count: int) -> Iterator[None]:
    """Run worker processes, and end them with this one; their sessions return to the queue."""
    command = [sys.executable, "-m", "evermap", "work", "--store", store]
    processes = [subprocess.Popen(command, stdin=subprocess.DEVNULL) for _ in range(count)]  # nosec  # B603: ourselves
    try:
        yield
    finally:
        for process in processes:
            process.send_signal(signal.SIGTERM)
        for process in processes:
            process.wait()
