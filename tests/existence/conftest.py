"""Reference numbers of other implementations, and priors of every kind."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture(scope="session")
def rosen_traces(repository: Path) -> list[dict[str, Any]]:
    """Observation sequences with posteriors by another implementation; skips where they are missing."""
    path = repository.parent / "shared" / "golden" / "rosen_traces.json"
    if not path.is_file():
        pytest.skip(f"reference numbers are not on this machine: no file {path}")
    sequences: list[dict[str, Any]] = json.loads(path.read_text())["sequences"]
    return sequences
