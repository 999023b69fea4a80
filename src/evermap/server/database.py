"""The server's tables: tokens, uploaded sessions, approvals, maps on robots, and the audit.

In SQLite it is one file, `server.db` in the folder of the maps; in PostgreSQL a schema `evermap_server` in their
database. A job is never lost: a worker leases it for a while and renews the lease as long as it lives; what a killed
worker had goes back to the queue when its lease ends. A session that does not fit its map is set aside, and tried again
as the map grows, the less often the larger that is; a refused one stays, with the reason and its bytes.
"""

from __future__ import annotations

import hashlib
import json
import secrets
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError, InterfaceError, OperationalError
from sqlalchemy.schema import CreateIndex, CreateSchema

from evermap.errors import ConfigError, InputError, printable
from evermap.maps.store import is_address
from evermap.maps.store.anchor import announce, now_utc
from evermap.maps.store.postgres import PREFIX, Announcements, split_address
from evermap.maps.store.postgres import engine_of as postgres_engine
from evermap.maps.store.sqlite import engine_of as sqlite_engine
from evermap.server.sites import store_place
from evermap.types import VerdictKind

VERSION = 2
"""Schema version of the tables; older ones are migrated (`_migrate`)."""
SCHEMA = "evermap_server"
AWAY = (OperationalError, InterfaceError)
"""Errors raised by a database that does not answer."""
MOST_TRIES = 10
"""Number of workers that may crash on a session before it is refused."""
SHOWN = 20
"""Newest sessions of a site whose state is sent to followers."""

_GROWTH = 4
"""Growth of the map between retries, so that their number is logarithmic in its revisions."""

metadata = sa.MetaData()


def _columns_of(**kinds: Any) -> list[sa.Column[Any]]:
    """Return columns that no row may leave empty."""
    return [sa.Column(name, kind, nullable=False) for name, kind in kinds.items()]


def _number_rows() -> sa.Column[int]:
    return sa.Column("id", sa.Integer, primary_key=True)


_server = sa.Table("server", metadata, *_columns_of(version=sa.Integer))
_token = sa.Table(
    "token",
    metadata,
    sa.Column("digest", sa.LargeBinary, primary_key=True),
    sa.Column("name", sa.Text, nullable=False, unique=True),
    *_columns_of(role=sa.Text, created_at=sa.Text),
)
_job = sa.Table(
    "job",
    metadata,
    _number_rows(),
    *_columns_of(site=sa.Text, digest=sa.Text, n_bytes=sa.Integer, robot=sa.Text),
    sa.Column("state", sa.Text, nullable=False, index=True),
    sa.Column("reason", sa.Text, nullable=False, default=""),
    sa.Column("verdict", sa.Text, nullable=False, server_default=""),
    sa.Column("revision", sa.Integer),
    sa.Column("tries", sa.Integer, nullable=False, default=0),
    sa.Column("worker", sa.Text, nullable=False, default=""),
    sa.Column("lease_s", sa.Float, nullable=False, default=0.0),
    *_columns_of(created_at=sa.Text, changed_at=sa.Text),
    sa.UniqueConstraint("site", "digest"),
)
_open_job = _job.c.state.in_(["queued", "working", "aside"])
_open_jobs = sa.Index("ix_job_open", _job.c.id, postgresql_where=_open_job, sqlite_where=_open_job)
"""Those that may be leased: of a million sessions that are entered, no lease looks at one."""
_payload = sa.Table(
    "payload", metadata, sa.Column("job", sa.Integer, primary_key=True), *_columns_of(data=sa.LargeBinary)
)
_approval = sa.Table(
    "approval", metadata, _number_rows(), *_columns_of(site=sa.Text, revision=sa.Integer, who=sa.Text, at=sa.Text)
)
_robot = sa.Table(
    "robot",
    metadata,
    sa.Column("name", sa.Text, primary_key=True),
    *_columns_of(maps=sa.Text, told=sa.Integer, at=sa.Text),
)
_audit = sa.Table(
    "audit", metadata, _number_rows(), *_columns_of(at=sa.Text, who=sa.Text, what=sa.Text, status=sa.Integer)
)


def _migrate(connection: sa.Connection) -> int | None:
    """Bring the tables of an older evermap to those of this one, and return the version that they have then."""
    version = connection.execute(sa.select(_server.c.version).with_for_update()).scalar()
    if version == 1:  # the verdict of a session was the beginning of its reason
        job = f"{SCHEMA}.job" if connection.dialect.name == "postgresql" else "job"
        connection.execute(sa.text(f"ALTER TABLE {job} ADD COLUMN verdict TEXT NOT NULL DEFAULT ''"))
        for kind in VerdictKind:
            mine = _job.c.reason.startswith(kind.value)
            rest = sa.func.ltrim(sa.func.substr(_job.c.reason, len(kind.value) + 1), ":, ")
            connection.execute(sa.update(_job).where(mine).values(verdict=kind.value, reason=rest))
        connection.execute(sa.update(_server).values(version=VERSION))
        return VERSION
    return version


class Role(IntEnum):
    """Role of a token; each includes the permissions of those before it."""

    READ = 1
    UPLOAD = 2
    APPROVE = 3
    ADMIN = 4


class JobState(StrEnum):
    """State of an uploaded session."""

    QUEUED = "queued"
    WORKING = "working"
    ENTERED = "entered"
    REPEAT = "repeat"
    """Another copy of a drive that is entered."""
    ASIDE = "aside"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True)
class Job:
    """An uploaded session.

    Attributes:
        id: its number.
        site: the map that it is for.
        digest: SHA-256 of what is in it, by which a second upload is known.
        n_bytes: of the upload.
        robot: name of the token that sent it.
        state: where it is.
        reason: why it was refused, or a remark.
        verdict: how far its estimate can be trusted (`VerdictKind`), '' before it has one.
        revision: that it became, or of the map that it did not fit; None before.
        tries: workers that have begun it since it was queued.
        created_at, changed_at: ISO 8601, UTC.
    """

    id: int
    site: str
    digest: str
    n_bytes: int
    robot: str
    state: JobState
    reason: str
    verdict: str
    revision: int | None
    tries: int
    created_at: str
    changed_at: str


_SHOWN = [_job.c[name] for name in Job.__slots__]


class Database:
    """The tables of a server, made where there are none.

    Args:
        where: folder of the maps, or address of a database without a site, `postgresql://user@host/fleet`.

    Raises:
        ConfigError: the address is not valid.
        InputError: the tables are of another evermap.
    """

    def __init__(self, where: str | Path) -> None:
        where = store_place(where)
        if is_address(where):
            self._engine = postgres_engine(str(where), SCHEMA)
        else:
            folder = Path(where)
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ConfigError(f"no folder for maps: {error.strerror}", path=folder, field="store") from None
            self._engine = sqlite_engine(folder / "server.db", writable=True)
        on_server = self._engine.dialect.name == "postgresql"
        with self._engine.execution_options(writes=True).begin() as connection:
            if on_server:
                connection.execute(CreateSchema(SCHEMA, if_not_exists=True))
            begun = sa.inspect(connection).has_table("server")
            metadata.create_all(connection)  # an older evermap does without the tables that it does not know
            connection.execute(CreateIndex(_open_jobs, if_not_exists=True))
            if not begun:
                connection.execute(sa.insert(_server).values(version=VERSION))
            version = _migrate(connection)
        if version != VERSION:
            problem = f"the server's tables are of version {version}, this evermap has {VERSION}"
            raise InputError(problem, hint="the evermap version that wrote them, or an empty store")
        # SQLite has one writer at a time; PostgreSQL locks the rows that are written
        self._writer = self._engine.execution_options(writes=not on_server, shared=True)
        self.announcements = Announcements(str(where) if on_server else None)

    def add_token(self, name: str, role: Role) -> str:
        """Return a new token; only its digest is kept.

        Raises:
            ConfigError: there is one of that name.
        """
        text = f"evermap_{secrets.token_urlsafe(32)}"
        row = {"digest": _digest(text), "name": name, "role": role.name.lower(), "created_at": now_utc()}
        try:
            with self._writer.begin() as connection:
                connection.execute(sa.insert(_token).values(row))
        except IntegrityError:
            hint = "another name, or revoke that one first"
            raise ConfigError(f"a token named '{name}' exists", field="name", hint=hint) from None
        return text

    def revoke_token(self, name: str) -> bool:
        """Delete a token; returns whether there was one."""
        with self._writer.begin() as connection:
            return connection.execute(sa.delete(_token).where(_token.c.name == name)).rowcount > 0

    def tokens(self) -> list[dict[str, Any]]:
        """Return names and roles of all tokens."""
        question = sa.select(_token.c.name, _token.c.role, _token.c.created_at).order_by(_token.c.name)
        return self._read(question)

    def _read(self, question: Any) -> list[dict[str, Any]]:
        with self._engine.begin() as connection:
            return [dict(row) for row in connection.execute(question).mappings()]

    def who(self, text: str) -> tuple[str, Role] | None:
        """Return the name and role of a token; None for an unknown one."""
        with self._engine.begin() as connection:
            row = connection.execute(
                sa.select(_token.c.name, _token.c.role).where(_token.c.digest == _digest(text))
            ).one_or_none()
        return None if row is None else (row.name, Role[row.role.upper()])

    def enqueue(self, site: str, digest: str, data: bytes, robot: str) -> tuple[Job, bool]:
        """Queue a session; returns its job, and whether it is a new one."""
        now = now_utc()
        told = {"site": site, "digest": digest, "n_bytes": len(data), "robot": robot, "state": JobState.QUEUED.value}
        try:
            with self._writer.begin() as connection:
                known = self._find_known(connection, site, digest)
                if known is not None:
                    return known, False
                row = sa.insert(_job).values(**told, created_at=now, changed_at=now).returning(*_SHOWN)
                job = _job_of(connection.execute(row).mappings().one())
                connection.execute(sa.insert(_payload).values(job=job.id, data=data))
                announce(connection, PREFIX + site)
                return job, True
        except IntegrityError:  # sent twice at the same time
            with self._engine.begin() as connection:
                known = self._find_known(connection, site, digest)
            assert known is not None
            return known, False

    def _find_known(self, connection: sa.Connection, site: str, digest: str) -> Job | None:
        known = sa.select(*_SHOWN).where(_job.c.site == site, _job.c.digest == digest)
        return next(map(_job_of, connection.execute(known).mappings()), None)

    def claim(self, worker: str, lease_s: float) -> tuple[Job, bytes] | None:
        """Lease the oldest waiting session of a site without a worker; None if there is none."""
        now, other = time.time(), _job.alias()
        busy = sa.exists().where(
            other.c.site == _job.c.site, other.c.state == JobState.WORKING.value, other.c.lease_s >= now
        )
        lapsed = sa.and_(_job.c.state == JobState.WORKING.value, _job.c.lease_s < now)
        waiting = sa.or_(_job.c.state == JobState.QUEUED.value, lapsed, _grown())
        oldest = sa.select(*_SHOWN).where(_open_job, waiting, sa.not_(busy)).order_by(_job.c.id).limit(1)
        with self._writer.begin() as connection:
            row = connection.execute(oldest.with_for_update(skip_locked=True, of=_job)).mappings().one_or_none()
            if row is None:
                return None
            values = {"state": JobState.WORKING.value, "worker": worker, "lease_s": now + lease_s}
            values |= {"tries": row["tries"] + 1, "changed_at": now_utc()}
            connection.execute(sa.update(_job).where(_job.c.id == row["id"]).values(values))
            data = connection.execute(sa.select(_payload.c.data).where(_payload.c.job == row["id"])).scalar_one()
            announce(connection, PREFIX + row["site"])
        return _job_of(row), data

    def renew(self, job: int, worker: str, lease_s: float) -> None:
        """Keep a session for another while."""
        with self._writer.begin() as connection:
            connection.execute(sa.update(_job).where(_mine(job, worker)).values(lease_s=time.time() + lease_s))

    def finish(
        self,
        job: int,
        worker: str,
        state: JobState,
        reason: str = "",
        revision: int | None = None,
        *,
        verdict: str = "",
    ) -> None:
        """Record the result of a session, unless another worker has its lease by now."""
        values: dict[str, Any] = {"state": state.value, "revision": revision, "worker": "", "verdict": verdict}
        values["reason"] = printable(reason, 2000)
        if state is JobState.QUEUED:  # given back: that was no try
            values["tries"] = _job.c.tries - 1
        if state is JobState.ASIDE:
            values["tries"] = 0
        with self._writer.begin() as connection:
            mine = sa.update(_job).where(_mine(job, worker)).values(**values, lease_s=0.0, changed_at=now_utc())
            site = connection.execute(mine.returning(_job.c.site)).scalar()
            if site is not None:
                announce(connection, PREFIX + site)
            if site is not None and state in (JobState.ENTERED, JobState.REPEAT):  # the map keeps the recording
                connection.execute(sa.delete(_payload).where(_payload.c.job == job))

    def retry(self, job: int) -> bool:
        """Queue a session once more that was refused or set aside; returns whether it was one."""
        refused = sa.and_(_job.c.id == job, _job.c.state.in_([JobState.REJECTED.value, JobState.ASIDE.value]))
        values = {"state": JobState.QUEUED.value, "reason": "", "verdict": "", "tries": 0, "changed_at": now_utc()}
        with self._writer.begin() as connection:
            site = connection.execute(sa.update(_job).where(refused).values(values).returning(_job.c.site)).scalar()
            if site is not None:
                announce(connection, PREFIX + site)
        return site is not None

    def jobs(self, site: str | None = None, state: JobState | None = None, most: int = 100) -> list[Job]:
        """Return the newest sessions that were uploaded."""
        question = sa.select(*_SHOWN).order_by(_job.c.id.desc()).limit(most)
        question = question if site is None else question.where(_job.c.site == site)
        question = question if state is None else question.where(_job.c.state == state.value)
        return [_job_of(row) for row in self._read(question)]

    def job(self, number: int) -> Job | None:
        """Return one session that was uploaded; None of an unknown number."""
        return next(map(_job_of, self._read(sa.select(*_SHOWN).where(_job.c.id == number))), None)

    def payload(self, job: int) -> bytes | None:
        """Return the bytes of a session that is not entered; None where they are not kept."""
        with self._engine.begin() as connection:
            return connection.execute(sa.select(_payload.c.data).where(_payload.c.job == job)).scalar()

    def approve(self, site: str, revision: int, who: str) -> None:
        """Make a revision the one that robots are to use."""
        with self._writer.begin() as connection:
            connection.execute(sa.insert(_approval).values(site=site, revision=revision, who=who, at=now_utc()))
            announce(connection, PREFIX + site)

    def approved(self, site: str) -> dict[str, Any] | None:
        """Return the revision approved last, its operator and time; None if there is none."""
        question = sa.select(_approval.c.revision, _approval.c.who, _approval.c.at).where(_approval.c.site == site)
        return next(iter(self._read(question.order_by(_approval.c.id.desc()).limit(1))), None)

    def hold(self, robot: str, maps: list[dict[str, str]]) -> bool:
        """Store the maps that a robot reports, in place of its earlier report; returns whether they are others."""
        values = {"maps": json.dumps(maps), "at": now_utc()}
        news = sa.case((_robot.c.maps == values["maps"], 0), else_=1)
        for _ in range(2):  # again where it says so the first time, and twice at once
            try:
                with self._writer.begin() as connection:
                    before = connection.execute(sa.select(_robot.c.maps).where(_robot.c.name == robot)).scalar()
                    changed = (
                        sa.update(_robot).where(_robot.c.name == robot).values(**values, told=_robot.c.told + news)
                    )
                    if not connection.execute(changed).rowcount:
                        connection.execute(sa.insert(_robot).values(name=robot, **values, told=1))
                    announce(connection, "")
                return before != values["maps"]
            except IntegrityError:
                continue
        return True

    def robots(self) -> list[dict[str, Any]]:
        """Return the robots that said which maps they hold, and when."""
        question = sa.select(_robot.c.name, _robot.c.maps, _robot.c.at).order_by(_robot.c.name)
        told = self._read(question)
        return [{"robot": row["name"], "maps": json.loads(row["maps"]), "at": row["at"]} for row in told]

    def pulse(self, site: str) -> tuple[Any, ...]:
        """Return values of which one differs once anything beside the map of a site has changed: its approval, what
        robots hold, or one of the newest sessions.
        """
        newest = sa.select(_job.c.id, _job.c.state, _job.c.tries).where(_job.c.site == site)
        with self._engine.begin() as connection:
            approved = connection.execute(
                sa.select(sa.func.max(_approval.c.id)).where(_approval.c.site == site)
            ).scalar()
            told = connection.execute(sa.select(sa.func.count(), sa.func.sum(_robot.c.told))).one()
            jobs = connection.execute(newest.order_by(_job.c.id.desc()).limit(SHOWN)).all()
        return approved, *told, *map(tuple, jobs)

    def note(self, who: str, what: str, status: int) -> None:
        """Note who requested a change, and its result."""
        with self._writer.begin() as connection:
            row = {"at": now_utc(), "who": who, "what": printable(what, 500), "status": status}
            connection.execute(sa.insert(_audit).values(row))

    def audit(self, most: int = 100) -> list[dict[str, Any]]:
        """Return the newest notes."""
        question = sa.select(_audit.c.at, _audit.c.who, _audit.c.what, _audit.c.status)
        return self._read(question.order_by(_audit.c.id.desc()).limit(most))

    def depth(self) -> int:
        """Return how many sessions wait or are worked on; proves that the database answers."""
        waiting = sa.or_(_job.c.state.in_([JobState.QUEUED.value, JobState.WORKING.value]), _grown())
        with self._engine.begin() as connection:
            return connection.execute(sa.select(sa.func.count()).select_from(_job).where(waiting)).scalar_one()

    def queue(self) -> tuple[dict[str, int], float, int]:
        """Return sessions by state, the longest waiting time [s], and the number in work."""
        counts = sa.select(_job.c.state, sa.func.count()).group_by(_job.c.state)
        oldest = sa.select(sa.func.min(_job.c.changed_at)).where(_job.c.state == JobState.QUEUED.value)
        leased = sa.and_(_job.c.state == JobState.WORKING.value, _job.c.lease_s >= time.time())
        with self._engine.begin() as connection:
            by_state = {str(state): int(count) for state, count in connection.execute(counts)}
            since = connection.execute(oldest).scalar()
            working = connection.execute(sa.select(sa.func.count()).select_from(_job).where(leased)).scalar_one()
        waits_s = 0.0 if since is None else (datetime.now(UTC) - datetime.fromisoformat(since)).total_seconds()
        return by_state, waits_s, working

    def n_bytes(self) -> int | None:
        """Return the size of the whole PostgreSQL database; None of SQLite, whose files lie open."""
        if self._engine.dialect.name != "postgresql":
            return None
        with self._engine.begin() as connection:
            return int(connection.execute(sa.select(sa.func.pg_database_size(sa.func.current_database()))).scalar_one())

    def close(self) -> None:
        """Let go of all connections."""
        self._engine.dispose()


def find_approved(where: str | Path) -> int | None:
    """Return the approved revision of a map in the store of a server; None if there is none, or no server.

    Args:
        where: its file, or its address with the name of the site.
    """
    if is_address(where):
        url, site = split_address(str(where))
        home = url.render_as_string(hide_password=False)
        with postgres_engine(home, "public").connect() as connection:
            served = sa.inspect(connection).has_schema(SCHEMA)
    else:
        home, site = str(Path(where).parent), Path(where).stem
        served = Path(home, "server.db").is_file()
    if not served:
        return None
    database = Database(home)
    try:
        chosen = database.approved(site)
    finally:
        database.close()
    return None if chosen is None else int(chosen["revision"])


def _mine(job: int, worker: str) -> Any:
    return sa.and_(_job.c.id == job, _job.c.worker == worker, _job.c.state == JobState.WORKING.value)


def _grown() -> Any:
    """Sessions set aside whose map has a quarter more revisions than when they were tried last."""
    other = _job.alias()
    newest = sa.select(sa.func.max(other.c.revision)).where(
        other.c.site == _job.c.site, other.c.state == JobState.ENTERED.value
    )
    due = newest.correlate(_job).scalar_subquery() > _job.c.revision + _job.c.revision // _GROWTH
    return sa.and_(_job.c.state == JobState.ASIDE.value, due)


def _job_of(row: Any) -> Job:
    return Job(**{**row, "state": JobState(row["state"])})


def _digest(token: str) -> bytes:
    """A token is 256 random bits: no salt and no slow hash makes it harder to guess."""
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).digest()
