"""Random requests by the server's own description: none is answered with an error of the server, or to a stranger."""

from __future__ import annotations

import pytest

pytest.importorskip("fastapi", reason="a server needs evermap[server]")
pytest.importorskip("schemathesis", reason="needs schemathesis: pip install 'evermap[dev]'")

from benchmarks.http_fuzz import fuzz, served


@pytest.mark.slow
@pytest.mark.parametrize("count", [100])
def test_random_requests_are_answered_or_refused(count: int) -> None:
    with served(sessions=1) as (app, tokens):
        found = fuzz(app, tokens, count, 7, each=2)
    assert found.defects == []
    assert found.n_requests >= count
    assert {200, 401, 403, 404, 422} <= {status for _, status in found.status}
