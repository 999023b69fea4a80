"""Events of a map (Server-Sent Events): new revisions, and changes of the state beside them."""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Any

from fastapi import Request
from fastapi.concurrency import run_in_threadpool

from evermap.errors import InputError
from evermap.maps.store import Revision
from evermap.maps.store.postgres import PREFIX
from evermap.runs import map_dicts
from evermap.server.database import AWAY
from evermap.server.gate import find_holder
from evermap.server.state import Server

_EVERY_S = 1.0
"""Between two looks for new revisions, where none are announced."""
_ALIVE_S = 15.0
"""Interval between two keep-alive lines."""
_CHECKED_S = 5.0
"""Longest use of a token by a follower before it is looked up again."""


def describe_revision(item: Revision, *, config: bool = False) -> dict[str, Any]:
    """A line of the history, without the whole configuration unless it is asked for."""
    told = map_dicts.revision_dict(item)
    return {key: value for key, value in told.items() if config or key != "config"}


async def follow_map(request: Request, server: Server, site: str, told: int) -> AsyncIterator[str]:
    """Ask for news whenever some are announced, and where nothing arrives, every second."""
    alive = checked = time.monotonic()
    beat = await run_in_threadpool(_beat, server, site)
    yield ": following\n\n"
    news, loop, asked = asyncio.Event(), asyncio.get_running_loop(), -math.inf

    def hear(what: str) -> None:
        if what in ("", PREFIX + site):
            with suppress(RuntimeError):  # the server has ended
                loop.call_soon_threadsafe(news.set)

    announced = server.database.announcements
    with announced.followed(hear):
        while not await request.is_disconnected():
            if news.is_set() or time.monotonic() - checked > _CHECKED_S:
                checked = time.monotonic()
                if not await run_in_threadpool(_still_valid, request):
                    return
            if news.is_set() or not announced.arrive or time.monotonic() - asked > _ALIVE_S:
                news.clear()
                asked = time.monotonic()
                if (now := await run_in_threadpool(_beat, server, site)) not in (None, beat):
                    beat = now
                    yield "event: beside\ndata: {}\n\n"
                for number, text in await run_in_threadpool(_since, server, site, told):
                    yield f"id: {number}\nevent: revision\ndata: {text}\n\n"
                    told = number
            if time.monotonic() - alive > _ALIVE_S:
                alive = time.monotonic()
                yield ": alive\n\n"
            with suppress(TimeoutError):
                await asyncio.wait_for(news.wait(), _EVERY_S)


def _still_valid(request: Request) -> bool:
    """Return whether a follower's token is not revoked, as far as the database answers."""
    try:
        return find_holder(request) is not None
    except AWAY:
        return True


def find_head(server: Server, site: str) -> int:
    """Return the newest revision of a site."""
    with server.sites.store(site) as store:
        return store.head()


def _beat(server: Server, site: str) -> tuple[Any, ...] | None:
    """Return a value that changes with the state beyond the map; None while the database does not answer."""
    try:
        return server.database.pulse(site)
    except AWAY:
        return None


def _since(server: Server, site: str, told: int) -> list[tuple[int, str]]:
    """Revisions after one, as events; none while the database does not answer."""
    try:
        with server.sites.store(site) as store:
            new = store.log() if store.head() > told else ()
            return [(item.number, json.dumps(describe_revision(item))) for item in new if item.number > told]
    except (InputError, *AWAY):
        return []
