"""The HTTP interface of a server: JSON, the map as a file, and events; every answer needs a token.

A path names a site; what comes from outside reaches SQL as bound values only, the disk by `SiteStores.address` only,
and is answered as JSON.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from importlib import resources
from typing import Annotated, Any, Literal
from uuid import uuid4

import numpy as np
from fastapi import APIRouter, Body, Depends, FastAPI, Header, HTTPException, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.middleware.gzip import GZipMiddleware
from fastapi.responses import HTMLResponse, StreamingResponse
from pydantic import BaseModel, Field

from evermap import __version__
from evermap.errors import EvermapError
from evermap.maps.diff import diff as between
from evermap.maps.diff import read_log, story_of
from evermap.maps.store import Provenance
from evermap.maps.store.postgres import SITE
from evermap.maps.store.sql import SqlStore
from evermap.maps.why import why as of_landmark
from evermap.runs import map_dicts
from evermap.runs.edits import WORDS, edit_landmarks, rename_landmark
from evermap.runs.summary import change_dict
from evermap.server.database import AWAY, Job, JobState, Role
from evermap.server.events import describe_revision, find_head, follow_map
from evermap.server.gate import PAGE, Gate, PlainJSON, answer_mistake, answer_outage, answer_unread, server_of
from evermap.server.state import Server
from evermap.server.uploads import check_digest
from evermap.types import json_number

_LEAST_COMPRESSED = 1000
"""Answers of fewer bytes are sent as they are."""
_EFFORT = 4
"""Of compression, 1 to 9: a tenth more bytes than at 9, in a sixth of the time."""


def create_app(server: Server) -> FastAPI:
    """Return the application."""
    about: dict[str, Any] = {"title": "evermap", "version": __version__, "docs_url": None, "redoc_url": None}
    app = FastAPI(**about, default_response_class=PlainJSON)
    app.state.server = server
    app.include_router(router)
    app.add_middleware(GZipMiddleware, minimum_size=_LEAST_COMPRESSED, compresslevel=_EFFORT)
    app.add_middleware(Gate)
    app.exception_handler(EvermapError)(answer_mistake)
    app.exception_handler(RequestValidationError)(answer_unread)
    for away in AWAY:
        app.exception_handler(away)(answer_outage)
    return app


def _answer_from(request: Request, site: str, make: Callable[[SqlStore], Any]) -> Response:
    """Answer from a map alone, unchanged until there is a newer revision."""
    asked = f"{request.url.path}?{request.url.query}"
    tag, found = server_of(request).sites.answer(site, asked, lambda store: bytes(PlainJSON(make(store)).body))
    return _tag_answer(request, found, tag, "application/json")


def _tag_answer(request: Request, data: bytes, tag: str, media_type: str, **headers: str) -> Response:
    """Return an answer with its ETag, or 304 if the client has it."""
    told = {"ETag": f'"{tag}"', **headers}
    if told["ETag"] in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=told)
    return Response(data, media_type=media_type, headers=told)


def _may(role: Role) -> Any:
    """A dependency: the token's name, if it has this role."""

    async def check(request: Request, authorization: Annotated[str, Header()] = "") -> str:  # noqa: ARG001 (described)
        who, has = request.state.who, request.state.role
        if has < role:
            raise HTTPException(403, f"this needs the role {role.name.lower()}, the token has {has.name.lower()}")
        return str(who)

    return Depends(check)


async def _answering(request: Request) -> Server:
    """An asynchronous dependency that needs no thread, since it never waits."""
    return server_of(request)


Answering = Annotated[Server, Depends(_answering)]
Reader = Annotated[str, _may(Role.READ)]
Uploader = Annotated[str, _may(Role.UPLOAD)]
Approver = Annotated[str, _may(Role.APPROVE)]
Administrator = Annotated[str, _may(Role.ADMIN)]
RobotName = Annotated[str, Field(pattern=r"^[^\x00-\x1f]{1,100}$")]
Site = Annotated[str, Path(json_schema_extra={"pattern": f"^{SITE.pattern}$"})]
"""A name that is none is told like a site that is not there, so the pattern only describes it."""
OfSite = Annotated[str | None, Query(pattern=f"^{SITE.pattern}$")]
AtRevision = Annotated[int | None, Query(ge=0, le=2**31 - 1)]
Number = Annotated[float | None, Query(allow_inf_nan=False)]
JobNumber = Annotated[int, Field(ge=0, le=2**31 - 1)]
Most = Annotated[int, Query(ge=1, le=1000)]


class Detail(BaseModel):
    """The error, in one line."""

    detail: str


_MISTAKES = {
    400: "the body cannot be read",
    401: "a token is needed",
    403: "the token does not have the role",
    404: "not found",
    409: "conflict with the present state",
    413: "the upload is too large",
    422: "a value is invalid",
    429: "too many requests",
    503: "the database does not answer",
}


def _as(media_type: str) -> dict[str, Any]:
    """Return the description of an answer that is not JSON."""
    return {"response_class": Response, "responses": {200: {"content": {media_type: {}}}}}


router = APIRouter(responses={code: {"model": Detail, "description": what} for code, what in _MISTAKES.items()})


class Said(BaseModel):
    """An operator's word on landmarks, ids or names."""

    landmarks: list[Annotated[str, Field(min_length=1, max_length=200)]] = Field(min_length=1, max_length=1000)
    note: str = Field("", max_length=500)


class Called(BaseModel):
    """What an operator calls a landmark: its id or name, and the new name, '' for its own again."""

    landmark: str = Field(min_length=1, max_length=200)
    name: str = Field(max_length=200)
    note: str = Field("", max_length=500)


class HeldMap(BaseModel):
    """A map on a robot, as an entry of `maps` in the state of VDA 5050."""

    map_id: str = Field(alias="mapId", min_length=1, max_length=100)
    map_version: str = Field(alias="mapVersion", min_length=1, max_length=100)
    status: Literal["ENABLED", "DISABLED"] = Field(alias="mapStatus")


class Chosen(BaseModel):
    """A revision that an operator chose."""

    revision: int = Field(ge=0, le=2**31 - 1, strict=True)
    note: str = Field("", max_length=500)


@router.get("/whoami")
def show_token(request: Request, who: Reader) -> dict[str, str]:
    """Return the name and the role of the token."""
    return {"name": who, "role": request.state.role.name.lower()}


@router.get("/healthz")
def health(server: Answering) -> dict[str, Any]:
    """Report that the server and its database answer; needs no token."""
    return {"evermap": __version__, "waiting": server.database.depth(), "workers": server.workers()}


@router.get("/", include_in_schema=False)
@router.get("/page.js", include_in_schema=False)
@router.get("/page.css", include_in_schema=False)
def page(request: Request) -> Response:
    """Serve the page, which asks for a token and shows the maps."""
    name = request.url.path.strip("/")
    text = resources.files("evermap.server").joinpath(name or "page.html").read_text(encoding="utf-8")
    return HTMLResponse(text, media_type=PAGE[name])


@router.get("/sites")
def list_sites(server: Answering, _: Reader) -> list[str]:
    """List the names of all sites."""
    return server.sites.names()


@router.get("/maps")
def list_maps(
    server: Answering, _: Reader, site: OfSite = None, after: OfSite = None, most: Most = 100
) -> list[dict[str, Any]]:
    """List one site, or the first `most` of those after a name, with the newest revision and the approved one."""
    names = [site] if site is not None else [name for name in server.sites.names() if name > (after or "")]
    told = []
    for name in names[:most]:
        with server.sites.store(name) as store:
            told.append({"site": name, "head": store.head(), "approved": server.database.approved(name)})
    return told


@router.post("/maps/{site}/sessions", status_code=202)
async def upload(request: Request, response: Response, site: Site, server: Answering, who: Uploader) -> dict[str, Any]:
    """Queue a session: the body is a zip of a native folder or of a bag, or a bag. Sent twice, it is entered once."""
    server.sites.address(site)
    data = await request.body()
    async with server.unpacking:
        digest = await run_in_threadpool(check_digest, data, server.limits)
    job, fresh = await run_in_threadpool(server.database.enqueue, site, digest, data, who)
    response.status_code = 202 if fresh else 200
    return asdict(job)


@router.get("/jobs")
def list_jobs(
    server: Answering, _: Reader, site: OfSite = None, state: JobState | None = None, most: Most = 100
) -> list[dict[str, Any]]:
    """List uploaded sessions, the newest first."""
    return [asdict(job) for job in server.database.jobs(site, state, most)]


@router.get("/jobs/{number}")
def show_job(number: JobNumber, server: Answering, _: Reader) -> dict[str, Any]:
    """Return the state of an uploaded session."""
    return asdict(_job(server, number))


@router.get("/jobs/{number}/payload", **_as("application/octet-stream"))
def show_payload(number: JobNumber, server: Answering, _: Approver) -> Response:
    """Return the uploaded bytes of a waiting or refused session."""
    data = server.database.payload(_job(server, number).id)
    if data is None:
        raise HTTPException(404, "its recording is in the map")
    return Response(data, media_type="application/octet-stream")


@router.post("/jobs/{number}/retry")
def retry(number: JobNumber, server: Answering, _: Approver) -> dict[str, Any]:
    """Queue a refused session once more."""
    if not server.database.retry(_job(server, number).id):
        raise HTTPException(409, "only a refused session can be queued again")
    return asdict(_job(server, number))


def _job(server: Server, number: int) -> Job:
    job = server.database.job(number)
    if job is None:
        raise HTTPException(404, "there is no such session")
    return job


@router.get("/maps/{site}/revisions")
def list_revisions(
    request: Request, site: Site, _: Reader, since: AtRevision = 0,
    most: Annotated[int | None, Query(ge=1, le=2**31 - 1)] = None, config: bool = False,
) -> Response:  # fmt: skip
    """List the first `most` revisions after `since`, the oldest first; with `config` also the settings of each."""

    def listed(store: SqlStore) -> list[dict[str, Any]]:
        return [describe_revision(item, config=config) for item in read_log(store) if item.number > (since or 0)][:most]

    return _answer_from(request, site, listed)


@router.get("/maps/{site}/diff")
def diff(request: Request, site: Site, _: Reader, a: AtRevision = 0, b: AtRevision = None) -> Response:
    """Return the changes between two revisions."""
    return _answer_from(request, site, lambda store: map_dicts.diff_dict(between(store, a or 0, b)))


@router.get("/maps/{site}/changes")
def changes(request: Request, site: Site, _: Reader, since: AtRevision = 0) -> Response:
    """List the changes reported by revisions after `since`."""

    def listed(store: SqlStore) -> list[dict[str, Any]]:
        told = [one for one in story_of(store) if one.revision > (since or 0)]
        return [{"revision": one.revision, **change_dict(change)} for one in told for change in one.changes]

    return _answer_from(request, site, listed)


class LandmarkQuery(BaseModel):
    """Query of landmarks: revision, region, minimum probability, and stamp of the forecast."""

    revision: int | None = Field(None, ge=0, le=2**31 - 1)
    at_s: float | None = Field(None, allow_inf_nan=False)
    p_least: float = Field(0.0, ge=0.0, le=1.0)
    x_min: float = Field(-np.inf)
    x_max: float = Field(np.inf)
    y_min: float = Field(-np.inf)
    y_max: float = Field(np.inf)

    def holds(self, item: dict[str, Any]) -> bool:
        """Return whether a landmark is among them; one without a place is in the whole plane only."""
        x, y = (-np.inf if item[axis] is None else item[axis] for axis in ("x_m", "y_m"))
        inside = self.x_min <= x <= self.x_max and self.y_min <= y <= self.y_max
        return bool(inside and item["p_exists"] >= self.p_least)


@router.get("/maps/{site}/landmarks")
def landmarks(request: Request, site: Site, _: Reader, asked: Annotated[LandmarkQuery, Query()]) -> Response:
    """List landmarks within a region; `p_ahead` is the probability that each is there at `at_s`."""

    def listed(store: SqlStore) -> dict[str, Any]:
        number, living = server_of(request).sites.living(store, asked.revision)
        found = map_dicts.landmark_dicts(living, None if asked.at_s is None else living.p_exists(asked.at_s))
        return {
            "site": site,
            "revision": number,
            "stamp_s": json_number(living.stamp_s),
            "clock": living.clock.value,
            "landmarks": [item for item in found if asked.holds(item)],
        }

    return _answer_from(request, site, listed)


@router.get("/maps/{site}/landmarks/{landmark}/why")
def why(request: Request, site: Site, landmark: str, _: Reader, revision: AtRevision = None) -> Response:
    """Return why a landmark is believed to exist or gone."""
    return _answer_from(request, site, lambda store: map_dicts.answer_dict(of_landmark(store, landmark, revision)))


@router.get("/maps/{site}/poses")
def poses(request: Request, site: Site, _: Reader, revision: AtRevision = None, at_s: Number = None) -> Response:
    """Return where each robot was in its newest session up to `at_s`, and its path in it."""
    until_s = math.inf if at_s is None else at_s
    return _answer_from(request, site, lambda store: {"robots": map_dicts.pose_dicts(store, revision, until_s)})


@router.get("/maps/{site}/lifetimes")
def lifetimes(request: Request, site: Site, _: Reader, revision: AtRevision = None) -> Response:
    """Return the lifetimes by class and place."""

    def told(store: SqlStore) -> dict[str, Any]:
        living = server_of(request).sites.living(store, revision)[1]
        known = {"priors": map_dicts.prior_dicts(living), "lifetimes": map_dicts.life_dicts(living)}
        return known | map_dicts.hours_dict(living)

    return _answer_from(request, site, told)


@router.get("/maps/{site}/file", **_as("application/vnd.sqlite3"))
def map_file(
    request: Request, site: Site, server: Answering, _: Reader, revision: AtRevision = None, approved: bool = False,
) -> Response:  # fmt: skip
    """Return the map as one file, of a revision, of the approved one, or of the newest."""
    if approved:
        revision = _find_approved(server, site)
    found = server.sites.file(site, revision)
    told = {"X-Checksum-Sha256": found.sha256, "Content-Disposition": f'attachment; filename="{site}.evermap"'}
    return _tag_answer(request, found.data, found.tag, "application/vnd.sqlite3", **told)


def _find_approved(server: Server, site: str) -> int:
    server.sites.address(site)  # PostgreSQL takes no zero bytes, as what is no name may hold
    chosen = server.database.approved(site)
    if chosen is None:
        raise HTTPException(404, "none of its revisions is approved")
    return int(chosen["revision"])


@router.post("/maps/{site}/approve")
def approve(request: Request, site: Site, chosen: Chosen, server: Answering, who: Approver) -> dict[str, Any]:
    """Approve a revision for the robots of this site."""
    with server.sites.store(site) as store:
        if not 1 <= chosen.revision <= store.head():
            raise HTTPException(422, "there is no such revision")
        server.sites.living(store, chosen.revision)  # refuses one whose content is pruned
    request.state.said = f"revision {chosen.revision}: {chosen.note}"
    server.database.approve(site, chosen.revision, who)
    return {"site": site, "approved": server.database.approved(site)}


@router.get("/maps/{site}/actions")
def actions(request: Request, site: Site, server: Answering, _: Reader, robot: RobotName | None = None) -> Response:
    """List the instant actions of VDA 5050 that install the approved revision on a robot, in their order.

    For a named robot, only the missing ones, by the maps that it reported.
    """
    number = _find_approved(server, site)
    told = [one for item in server.database.robots() if item["robot"] == robot for one in item["maps"]]
    held = {one["mapStatus"] for one in told if (one["mapId"], one["mapVersion"]) == (site, str(number))}
    which = {"mapId": site, "mapVersion": str(number)}
    wanted = []
    if not held:
        link = f"{server.public_url or request.base_url}".rstrip("/") + f"/maps/{site}/file?revision={number}"
        file = {"mapDownloadLink": link, "mapHash": server.sites.file(site, number).sha256}
        wanted.append(_instant("downloadMap", {**which, **file}))
    if "ENABLED" not in held:
        wanted.append(_instant("enableMap", which))
    return PlainJSON({"actions": wanted})


def _instant(kind: str, parameters: dict[str, str]) -> dict[str, Any]:
    listed = [{"key": key, "value": value} for key, value in parameters.items()]
    return {"actionType": kind, "actionId": str(uuid4()), "blockingType": "NONE", "actionParameters": listed}


@router.get("/robots")
def list_robots(server: Answering, _: Reader) -> list[dict[str, Any]]:
    """List the maps that robots hold, as they said."""
    return server.database.robots()


@router.put("/robots/{robot}/maps")
def hold(
    request: Request, robot: RobotName, server: Answering, who: Uploader,
    maps: Annotated[list[HeldMap], Body(max_length=100)],
) -> dict[str, Any]:  # fmt: skip
    """Say which maps a robot holds, the `maps` of its state in VDA 5050: by the robot itself, or by an approver."""
    if robot != who and request.state.role < Role.APPROVE:
        raise HTTPException(403, f"the token belongs to {who}: reporting for another robot needs the role approve")
    enabled = [one.map_id for one in maps if one.status == "ENABLED"]
    if len(set(enabled)) < len(enabled):
        raise HTTPException(422, "two versions of one map are enabled")
    held = [one.model_dump(by_alias=True) for one in maps]
    request.state.unchanged = not server.database.hold(robot, held)
    return {"robot": robot, "maps": held}


@router.post("/maps/{site}/revert")
def revert(request: Request, site: Site, chosen: Chosen, server: Answering, who: Approver) -> dict[str, Any]:
    """Go back to an older revision, by a new one."""
    request.state.said = f"to revision {chosen.revision}"
    with server.sites.store(site) as store:
        number = store.revert(chosen.revision, Provenance(command=f"evermap serve ({who})", note=chosen.note))
    return {"site": site, "revision": number, "restores": chosen.revision}


def _word(action: str, word: str) -> None:
    """Return the answer to an operator's edit of landmarks."""

    def say(request: Request, site: Site, said: Said, server: Answering, who: Approver) -> dict[str, Any]:
        request.state.said = ", ".join(said.landmarks)
        with server.sites.store(site) as store:
            number, changed, told = edit_landmarks(
                store, said.landmarks, word, note=said.note, command=f"evermap serve ({who})"
            )
        return {"site": site, "revision": number, word: changed, "note": told}

    router.add_api_route(f"/maps/{{site}}/{action}", say, methods=["POST"], summary=f"Make landmarks {word}")


for _action, _said in zip(("pin", "unpin", "delete", "undelete"), WORDS, strict=True):
    _word(_action, _said)


@router.post("/maps/{site}/rename")
def rename(request: Request, site: Site, called: Called, server: Answering, who: Approver) -> dict[str, Any]:
    """Call a landmark by another name."""
    request.state.said = f"{called.landmark} as {called.name}"
    with server.sites.store(site) as store:
        number, label, told = rename_landmark(
            store, called.landmark, called.name, note=called.note, command=f"evermap serve ({who})"
        )
    return {"site": site, "revision": number, "label": label, "note": told}


@router.get("/audit")
def audit(server: Answering, _: Administrator, most: Most = 100) -> list[dict[str, Any]]:
    """List who asked for changes, the newest first."""
    return server.database.audit(most)


@router.get("/maps/{site}/events", **_as("text/event-stream"))
async def events(
    request: Request, site: Site, server: Answering, _: Reader, since: AtRevision = None,
    last_event_id: Annotated[str, Header()] = "",
) -> StreamingResponse:  # fmt: skip
    """Send events (Server-Sent Events): `revision` for every new one, after `Last-Event-ID` or `since`, and `beside`
    whenever the approval, the robots' maps or the newest sessions have changed.
    """
    told = int(last_event_id) if last_event_id.isdecimal() and len(last_event_id) < 10 else since
    head = await run_in_threadpool(find_head, server, site)
    told = head if told is None else min(told, head)
    return StreamingResponse(follow_map(request, server, site, told), media_type="text/event-stream")
