"""Evidence of one clique in one session as bytes: some ten a look."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from evermap.maps.living import Evidence
from evermap.maps.store.content import DamagedError

_COLUMNS = {
    "stamp_s": "<f8",
    "n_hits": "<i4",
    "n_misses": "<i4",
    "expected": "<f4",
    "log_odds": "<f4",
    "p_exists": "<f4",
}
"""Evidence explains what was decided and decides nothing: 7 digits of it are enough."""


def looks_to_bytes(evidence: Evidence) -> bytes:
    """All columns but the clique's id, each with the first bytes of its values in front: neighbours are alike there."""
    planes = []
    for name, dtype in _COLUMNS.items():
        column = np.ascontiguousarray(getattr(evidence, name), dtype=dtype)
        planes.append(column.view(np.uint8).reshape(len(column), column.itemsize).T.tobytes())
    return zlib.compress(b"".join(planes), level=6)


def looks_from_bytes(clique_id: int, stored: bytes) -> Evidence:
    """What `looks_to_bytes` was given.

    Raises:
        DamagedError: it was anything else.
    """
    try:
        planes = np.frombuffer(zlib.decompress(stored), np.uint8)
    except zlib.error as error:
        raise DamagedError(f"a part cannot be unpacked: {error}") from None
    sizes = [np.dtype(dtype).itemsize for dtype in _COLUMNS.values()]
    count = len(planes) // sum(sizes)
    parts = np.split(planes, np.cumsum(np.multiply(sizes, count))[:-1])
    columns: dict[str, Any] = {
        name: part.reshape(size, count).T.copy().view(dtype)[:, 0].astype(np.float64 if "f" in dtype else np.int64)
        for (name, dtype), part, size in zip(_COLUMNS.items(), parts, sizes, strict=True)
    }
    return Evidence(clique_id=np.full(count, clique_id, dtype=np.int64), **columns)
