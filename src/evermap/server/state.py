"""State of a server: the maps, the database, and what all requests share."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from evermap.errors import EvermapError
from evermap.maps.living import LivingMap
from evermap.runs import map_dicts
from evermap.server.database import Database
from evermap.server.sites import SiteStores
from evermap.server.uploads import UploadLimits
from evermap.types import Landmarks

_RATE_HZ, _BURST = 50.0, 200.0
"""Rate and burst of requests per token, and per address of requests without a valid one."""
_MOST_COUNTED = 10_000
"""Tokens and addresses whose requests are counted; the one that has asked least recently is forgotten."""
_UNPACKED_AT_ONCE = 2
"""Uploads that are unpacked at the same time."""
_WARM = 16
"""Maps that are loaded before the first request."""


@dataclass(slots=True)
class Server:
    """State of a server.

    Attributes:
        database: tokens and the queue.
        sites: the maps.
        limits: of uploads.
        rate_hz: requests of one token over time.
        public_url: address at which robots reach the server; None for that of each request.
        workers: counts the living worker processes that this server has started.
    """

    database: Database
    sites: SiteStores
    limits: UploadLimits = field(default_factory=UploadLimits)
    rate_hz: float = _RATE_HZ
    public_url: str | None = None
    workers: Callable[[], int] = lambda: 0
    unpacking: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(_UNPACKED_AT_ONCE))
    _budget: dict[tuple[str, str], tuple[float, float]] = field(default_factory=dict)

    def admits(self, kind: str, who: str) -> bool:
        """Count a request of a token or an address; returns whether it is within the rate (a token bucket)."""
        now = time.monotonic()
        left, since = self._budget.pop((kind, who), (_BURST, now))
        left = min(_BURST, left + (now - since) * self.rate_hz)
        self._budget[kind, who] = (left - 1.0 if left >= 1.0 else left, now)
        if len(self._budget) > _MOST_COUNTED:
            self._budget.pop(next(iter(self._budget)))
        return left >= 1.0


def prepare(server: Server) -> None:
    """Load the code for reading, and some of the maps, so that no request waits for that."""
    row, number = np.zeros(1), np.zeros(1, dtype=np.int64)
    one = Landmarks(number, np.zeros((1, 2)), np.zeros((1, 2, 2)), number, row + 1.0, number, number, row, row)
    living = LivingMap.begun(one).from_now_on(0.0)
    map_dicts.landmark_dicts(living, living.p_exists(0.0))
    for site in server.sites.names()[:_WARM]:
        with suppress(EvermapError), server.sites.store(site) as store:
            server.sites.living(store)
