"""What every request passes: its token, its rate and the bounds of its body; and errors as answers of one line."""

from __future__ import annotations

import json
from contextlib import suppress
from typing import Any

from fastapi import HTTPException, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from evermap.errors import EvermapError, printable
from evermap.maps.store import DamagedMapError, StaleRevisionError, StoreUnavailableError
from evermap.server.database import AWAY, Role
from evermap.server.sites import NoSuchSiteError
from evermap.server.state import Server

_HEADERS = {
    "Content-Security-Policy":
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
}  # fmt: skip
_STATUS: dict[type[Exception], int] = {NoSuchSiteError: 404, StaleRevisionError: 409, DamagedMapError: 500}
PAGE = {"": "text/html", "page.js": "text/javascript", "page.css": "text/css"}
"""Files of the page by path, and their types."""
_OPEN = {"/healthz", "/openapi.json", *(f"/{name}" for name in PAGE)}
"""Paths that need no token."""


class PlainJSON(JSONResponse):
    """JSON in ASCII, so that any text of a map can be sent."""

    def render(self, content: Any) -> bytes:
        """Encode the answer."""
        return json.dumps(content, allow_nan=False).encode("ascii")


class Gate:
    """Middleware that looks at the token before anything reads the body, bounds the body, sends the security headers
    of pages, and notes changes in the audit.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or let the application do it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        limits = server_of(request).limits
        most = left = limits.n_bytes if request.url.path.endswith("/sessions") else limits.body_bytes
        refusal = await self._refusal(request, most)

        async def bounded() -> Message:
            nonlocal left
            message = await receive()
            left -= len(message.get("body", b""))
            if left < 0:
                raise HTTPException(413, f"more than {most} bytes")
            return message

        async def finished(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
                await self._note(request, message["status"])
            await send(message)

        await (self._app if refusal is None else refusal)(scope, bounded, finished)

    async def _refusal(self, request: Request, most: int) -> Response | None:
        """Return what is answered without a look at the body; None for what the application answers."""
        length = request.headers.get("content-length", "")
        try:
            if request.url.path not in _OPEN:
                await run_in_threadpool(_identify, request)
            if length.isdecimal() and int(length[:20]) > most:
                raise HTTPException(413, f"more than {most} bytes")
        except HTTPException as error:
            return PlainJSON({"detail": error.detail}, error.status_code, error.headers)
        except AWAY as error:
            return await answer_outage(request, error)
        return None

    async def _note(self, request: Request, status: int) -> None:
        """Note a change that somebody with a token has asked for."""
        state = request.state
        if request.method not in ("POST", "PUT") or not hasattr(state, "who") or getattr(state, "unchanged", False):
            return
        what = f"{request.method} {request.url.path} {getattr(state, 'said', '')}"
        with suppress(*AWAY):  # the answer reports it
            await run_in_threadpool(server_of(request).database.note, state.who, what, status)


def _identify(request: Request) -> None:
    """Keep the name and the role of a request's token.

    Raises:
        HTTPException: there is none, or too many requests came with it, or without one from its address.
    """
    server, known = server_of(request), find_holder(request)
    address = "" if request.client is None else request.client.host
    if not (server.admits("address", address) if known is None else server.admits("token", known[0])):
        raise HTTPException(429, "too many requests", {"Retry-After": "1"})
    if known is None:
        raise HTTPException(401, "a token is needed", {"WWW-Authenticate": "Bearer"})
    request.state.who, request.state.role = known


def find_holder(request: Request) -> tuple[str, Role] | None:
    """Return the name and the role of a request's token; None if it has no valid one."""
    scheme, _, text = request.headers.get("authorization", "").partition(" ")
    return server_of(request).database.who(text.strip()) if scheme.lower() == "bearer" else None


async def answer_mistake(request: Request, error: Exception) -> Response:
    """Return one line, without paths of this machine."""
    assert isinstance(error, EvermapError)
    if isinstance(error, StoreUnavailableError):
        return await answer_outage(request, error)
    status = _STATUS.get(type(error), 404 if request.method == "GET" else 422)
    what = f"{error.field}: {error.problem}" if error.field else error.problem
    return PlainJSON({"detail": printable(what, 400)}, status)


async def answer_unread(_: Request, error: Exception) -> Response:
    """Return the error of a request, without repeating its content."""
    assert isinstance(error, RequestValidationError)
    told = [f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors()]
    return PlainJSON({"detail": printable("; ".join(told), 400)}, 422)


async def answer_outage(_: Request, __: Exception) -> Response:
    """Return that the database is away, and when to ask again."""
    return PlainJSON({"detail": "the database does not answer"}, 503, {"Retry-After": "5"})


def server_of(request: Request) -> Server:
    """Return the server that a request came to."""
    server = request.app.state.server
    assert isinstance(server, Server)
    return server
