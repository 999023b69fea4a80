"""Random requests by the server's own description: none is answered with an error of the server, or to a stranger."""

from __future__ import annotations

import pytest

pytest.importorskip("fastapi", reason="a server needs evermap[server]")
pytest.importorskip("schemathesis", reason="needs schemathesis: pip install 'evermap[dev]'")

from benchmarks.http_fuzz import fuzz, served


@pytest.mark.slow
def test_random_requests_are_answered_or_refused() -> None:
    with served(sessions=1) as (app, tokens):
        found = fuzz(app, tokens, 100, 7, each=2)
    assert found.defects == []
    assert found.n_requests >= 100
    assert {200, 401, 403, 404, 422} <= {status for _, status in found.status}
