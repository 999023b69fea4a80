"""Servers and sessions for the tests of a server; bags are written by the tests of their reader."""

from __future__ import annotations

import secrets
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

sys.path[:0] = [str(Path(__file__).parents[1] / "io"), str(Path(__file__).parent)]

if TYPE_CHECKING:
    from fleets import Fleet

COUNT = 6


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Sessions of one building, in order of time."""
    from evermap.io import write_native
    from evermap_studies.sim import BuildingConfig, simulate_building

    folder = tmp_path_factory.mktemp("sessions")
    sessions = simulate_building(BuildingConfig(days=COUNT, patrol_s=35.0), 3).sessions
    for number, recording in enumerate(sessions):
        write_native(recording, folder / f"day{number}")
    return [folder / f"day{number}" for number in range(COUNT)]


@pytest.fixture(scope="session")
def zips(folders: list[Path]) -> list[bytes]:
    from fleets import zipped

    return [
        zipped({f"{folder.name}/{path.name}": path.read_bytes() for path in sorted(folder.iterdir())})
        for folder in folders
    ]


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.slow)])
def where(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Where a server keeps its maps; what the databases do differently asks for `BOTH_DATABASES`."""
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
    from fastapi.testclient import TestClient
    from fleets import Fleet

    from evermap.server.app import create_app
    from evermap.server.database import Database, Role
    from evermap.server.sites import SiteStores
    from evermap.server.state import Server

    database = Database(where)
    server = Server(database, SiteStores(where))
    tokens = {role.name.lower(): database.add_token(role.name.lower(), role) for role in Role}
    with TestClient(create_app(server)) as client:
        yield Fleet(where, server, client, tokens)
    database.close()
