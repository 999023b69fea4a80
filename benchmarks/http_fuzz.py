"""Random requests to every path of the server: `python -m benchmarks.http_fuzz --requests 100000 --seed 0`.

schemathesis makes requests by the server's own OpenAPI description, half of them as it allows and half not. Most are
sent to a site with a map, by each role in turn; every fourth has no token, or a wrong one, and must be refused.
An answer 5xx is a defect, so is an exception, and so is any other answer without a token. The stream of events, which
does not end, is asked without a token only. Exit code 1 if anything of that kind was found; the same seed makes the
same requests.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.errors import Unsatisfiable

from evermap.maps.store import open_store
from evermap.runs.sessions import enter_session
from evermap.server.app import create_app
from evermap.server.database import Database, Role
from evermap.server.sites import SiteStores
from evermap.server.state import Server
from evermap_studies.sim import BuildingConfig, simulate_building

SITE = "ward"
OPEN = ("/healthz", "/openapi.json")
"""Paths that need no token."""
ENDLESS = "/maps/{site}/events"
ROUND = 40
"""Requests of one kind to one path in a row."""
REFUSED = (400, 401, 422)
"""Answers without a token: none is there, or the request cannot be read at all."""
STRANGERS: tuple[dict[str, str], ...] = ({}, {"Authorization": "Bearer nobody"}, {"Authorization": "Basic YTpi"})


@dataclass
class Found:
    """What came back.

    Attributes:
        status: answers by path and status.
        defects: what must not be, with the request that shows it.
    """

    status: Counter[tuple[str, int]] = field(default_factory=Counter)
    defects: list[str] = field(default_factory=list)

    @property
    def n_requests(self) -> int:
        """Return how many were answered."""
        return self.status.total()


@contextmanager
def served(sessions: int = 3) -> Iterator[tuple[Any, dict[str, str]]]:
    """Yield an application with a site of some sessions, and a token for every role."""
    with tempfile.TemporaryDirectory() as folder:
        with open_store(Path(folder, f"{SITE}.evermap"), create=True) as store:
            for recording in simulate_building(BuildingConfig(days=sessions, patrol_s=35.0), 3).sessions:
                enter_session(store, recording)
        database = Database(folder)
        tokens = {role.name.lower(): database.add_token(role.name.lower(), role) for role in Role}
        yield create_app(Server(database, SiteStores(folder), rate_hz=1e9)), tokens
        database.close()


def fuzz(
    app: Any, tokens: dict[str, str], requests: int, number: int, *, each: int = ROUND, progress: bool = False
) -> Found:
    """Send about so many requests, in rounds over all paths.

    Args:
        app: the application.
        tokens: of every role.
        requests: how many, at least.
        number: seed.
        each: requests of one kind to one path in a row.
        progress: tell how many were sent.
    """
    import schemathesis

    described = schemathesis.openapi.from_asgi("/openapi.json", app)
    paths = [item.ok() for item in described.get_all_operations()]
    found, began = Found(), time.monotonic()
    while found.n_requests < requests:
        for path in paths:
            for mode in schemathesis.GenerationMode:
                _round(path.as_strategy(generation_mode=mode), path, tokens, number, each, found)
                number += 1
        if progress:
            rate_hz = found.n_requests / (time.monotonic() - began)
            print(f"{found.n_requests} requests, {rate_hz:.0f} a second, {len(found.defects)} defects", file=sys.stderr)
    return found


def _round(cases: Any, path: Any, tokens: dict[str, str], number: int, each: int, found: Found) -> None:
    count = 0

    @seed(number)
    @settings(
        max_examples=each,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=cases)
    def ask(case: Any) -> None:
        nonlocal count
        count += 1
        if "site" in (case.path_parameters or {}) and count % 5:
            case.path_parameters["site"] = SITE
        roles = list(tokens)
        stranger = count % 4 == 0 or path.path == ENDLESS
        role = roles[count % len(roles)]
        headers = STRANGERS[count % len(STRANGERS)] if stranger else {"Authorization": f"Bearer {tokens[role]}"}
        case.headers = {key: value for key, value in (case.headers or {}).items() if key.lower() != "authorization"}
        try:
            status = case.call(headers=headers).status_code
        except Exception as error:  # whatever it is, the server should have answered
            found.defects.append(f"{error!r:.200} by {case.as_curl_command()}")
            return
        found.status[path.label, status] += 1
        if status >= 500 or (stranger and path.path not in OPEN and status not in REFUSED):
            found.defects.append(f"{status} by {case.as_curl_command()}")

    with suppress(Unsatisfiable):  # a path without parameters has no wrong ones
        ask()


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    with served() as (app, tokens):
        found = fuzz(app, tokens, chosen.requests, chosen.seed, progress=True)
    by_status: Counter[int] = Counter()
    for (_, status), count in found.status.items():
        by_status[status] += count
    print(f"{found.n_requests} requests; " + ", ".join(f"{status}: {n}" for status, n in sorted(by_status.items())))
    print(*found.defects[:20], sep="\n")
    print(f"{len(found.defects)} defects")
    return 1 if found.defects else 0


if __name__ == "__main__":
    sys.exit(main())
