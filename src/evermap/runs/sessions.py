"""Sessions of a stored map, in order of time, whenever they arrive.

A session that begins before the newest one of the map is late: it is entered where it belongs. The map is taken back to
the last revision before it, and it and all later sessions and edits are brought in again, from the recordings that are
kept with their revisions. So the map is the one that the right order would have given.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evermap import __version__
from evermap.config import Config, parse_config, to_toml
from evermap.errors import ConfigError, DataError, EvermapError, InputError, printable
from evermap.maps.diff import edits, grown
from evermap.maps.living import LivingMap
from evermap.maps.store import (
    Attachment,
    MapStore,
    Provenance,
    PrunedRevisionError,
    Revision,
    RevisionKind,
    StaleRevisionError,
    open_store,
)
from evermap.maps.store.content import DamagedError
from evermap.maps.store.history import STORY, Chapter, pack_story
from evermap.maps.store.measured import (
    LOOKS,
    RECORDING,
    TRAJECTORY,
    pack_looks,
    pack_recording,
    pack_trajectory,
    unpack_recording,
)
from evermap.runs.session_clock import place_session
from evermap.show import Shown
from evermap.types import Progress, VerdictKind, is_in_space
from evermap.valid import check_type

if TYPE_CHECKING:
    from evermap.existence.lifetimes import Lifetimes
    from evermap.existence.sites import Evidence
    from evermap.maps.lives import Life
    from evermap.maps.living import Members
    from evermap.maps.sessions.session import Session
    from evermap.maps.store.sql import SqlStore
    from evermap.types import AnyRecording, Clock, FloatArray, IntArray, Landmarks, MapChange


ACCEPT = "mend it, or `living.accept = 'any'` to enter it as it is"
"""What to try with a session that does not enter a map by itself."""


class TwiceError(InputError):
    """A session that is in the map already.

    Attributes:
        revision: that it is.
        is_copy: whether that revision was made from another copy of the drive.
    """

    revision: int = 0
    is_copy: bool = False


class UnbridgedError(DataError):
    """A late session after which a later one can no longer be localised; others may connect them."""


@dataclass(frozen=True, slots=True)
class Entered(Shown):
    """Result of a session in a stored map, before its commit.

    Attributes:
        session: the session itself, in the map as it was at its time.
        newest: the newest revision of the map.
        living: the map after the session, and after all later sessions.
        changes: that the session tells, at its time: the same whether it is late or not.
        replayed: names of the later sessions that were brought in again.
        parent: revision that it was made from.
        attachments: to commit with it.
    """

    session: Session
    newest: LivingMap
    living: LivingMap
    changes: tuple[MapChange, ...]
    replayed: tuple[str, ...]
    parent: int
    attachments: dict[str, bytes]

    def refusal(self, config: Config | None = None) -> str:
        """Return why the session does not enter the map by itself (`living.accept`), in a line; '' where it does."""
        if not self.session.found:
            return self.session.set_aside[0]
        verdict, accept = self.session.slam.verdict, (config or Config()).living.accept
        if verdict is None or accept == "any" or verdict.kind is VerdictKind.SOUND:
            return ""
        if accept == "weak" and verdict.kind.is_trustworthy:
            return ""
        return verdict.text

    @property
    def grown(self) -> IntArray:
        """New landmarks whose appearance was not observed."""
        return grown(self.newest.members.landmark_id, self.living, self.changes)

    def commit(
        self,
        store: MapStore,
        config: Config | None = None,
        *,
        command: str = "",
        wall_s: float = np.nan,
    ) -> int:
        """Commit the map as the next revision of the store that the session was entered into; returns its number.

        Args:
            store: the map.
            config: settings of the session, as `enter_session` was given them.
            command: the command line.
            wall_s: what estimating took.

        Raises:
            DataError: the session is not to enter the map by itself, see `refusal`.
            StaleRevisionError: another commit came in between.
        """
        config, recording = config or Config(), self.session.recording
        if refusal := self.refusal(config):
            raise DataError(f"{recording.name}: does not enter the map: {refusal}", hint=ACCEPT)
        stamps = recording.frames.stamp_s
        provenance = Provenance(
            kind=RevisionKind.SESSION,
            recording=recording.name,
            source=recording.source,
            command=command,
            config=to_toml(config),
            seed=config.slam.seed,
            stamp_from_s=float(stamps[0]),
            stamp_to_s=float(stamps[-1]),
            wall_s=wall_s,
            robot=recording.robot,
        )
        return store.commit(
            self.living,
            provenance,
            self.changes,
            self.session.evidence,
            parent=self.parent,
            attachments={**self.attachments, TRAJECTORY: pack_trajectory(self.session.slam.trajectory)},
        )


@dataclass(frozen=True, slots=True)
class _Step:
    """A session (with its recording), or an edit, of a map's history."""

    start_s: float
    revision: Revision
    recording: Attachment | None


def enter_session(
    store: MapStore,
    recording: AnyRecording,
    config: Config | None = None,
    *,
    priors: Mapping[str, Lifetimes] | None = None,
    later: Sequence[str] = (),
    progress: Progress | None = None,
) -> Entered:
    """Enter a session into the newest map of a store, at its time.

    Args:
        store: the map.
        recording: in space where the sessions of the map are.
        config: settings of this session; the others are brought in again with their own.
        priors: how long things of a class stay, and stay away, as `maps.learning.with_priors` takes them; they stay in
            the map.
        later: classes with a prior that neither the map nor the recording needs to have yet.
        progress: told after every frame of this session.

    Raises:
        InputError: it is in the map already, or it is late and a later session kept no recording, or the revision
            before that is pruned.
        ConfigError: a prior of a class that neither the map nor the recording has.
        UnbridgedError: it is late, and with it a later session of the map is not found any more.
        DataError, NumericalError: as `pipeline.run_session`.
    """
    from evermap.maps.learning import with_priors
    from evermap.maps.sessions.session import check_fits, in_its_space
    from evermap.pipeline import run_session

    check_type(recording)
    head = store.head()
    newest = store.load(head)
    recording = in_its_space(recording, newest, config or Config())
    if len(newest.places):
        check_fits(recording, newest)
    config = _of_its_space(recording, config)
    gap_s, kept = (config or Config()).living.clock_gap_s, _recordings(store, head)
    _refuse_twice(store, kept, pack_recording(recording), recording, anew=gap_s is not None)
    lineage = set(store.lineage(head))
    recording = place_session(recording, [item for item in store.log() if item.number in lineage], gap_s)
    data = pack_recording(recording)
    stamps = recording.frames.stamp_s
    start_s = float(stamps[0]) if len(stamps) else np.inf
    worth = (config or Config()).living.prior_stays
    said = newest if not priors else with_priors(newest, priors, (*recording.class_names, *later), worth)
    if not start_s < newest.session_start_s:
        session = run_session(recording, said, config, progress=progress)
        return Entered(session, newest, session.living, session.changes, (), head, {RECORDING: data})
    return _enter_late(store, head, recording, said, config, data, progress)


def begin_map(store: MapStore, landmarks: Landmarks, recording: AnyRecording, source: str) -> int:
    """Commit surveyed landmarks with covariances as the first revision of an empty map; returns its number.

    The map has the clock of the first session's recording; `source` says where the landmarks come from.

    Raises:
        ConfigError: the map has landmarks already.
    """
    if len(store.load().places):
        hint = "only a new map can begin with a prior map"
        raise ConfigError("this map has landmarks already", field="prior_map", path=store.where, hint=hint)
    living = replace(LivingMap.begun(landmarks), clock=recording.clock)
    said = Provenance(kind=RevisionKind.EDIT, source=source, note=f"{len(landmarks)} surveyed landmarks")
    return store.commit(living, said, parent=store.head())


WORDS: Mapping[str, Mapping[str, bool]] = {
    "pinned": {"pinned": True}, "unpinned": {"pinned": False},
    "deleted": {"deleted": True}, "undeleted": {"deleted": False},
}  # fmt: skip
"""Edits of landmarks by operators."""


def edit_landmarks(
    store: MapStore, landmarks: Sequence[str], word: str, *, note: str = "", command: str = ""
) -> tuple[int, tuple[int, ...], str]:
    """Commit an operator's edit of landmarks (ids or names) by one of `WORDS`, unless it changes nothing.

    The log gets the `note`, and the `command` that was typed.

    Returns:
        The newest revision, the landmarks that changed, and what the log says.

    Raises:
        InputError: a landmark is not in the map.
        StaleRevisionError: another commit came in between.
    """
    parent = store.head()
    before = after = store.load(parent)
    for name in landmarks:
        after = after.edited(_landmark_of(store, before, parent, name), **WORDS[word])
    changed = tuple(name for name, _ in edits(before.members, after.members))
    if not changed:
        return parent, (), f"already {word}"
    listed = ", ".join(map(after.label, changed))
    said = f"{word} landmark{'s' if len(changed) > 1 else ''} {listed}" + (f": {note}" if note else "")
    origin = Provenance(kind=RevisionKind.EDIT, command=command, note=said)
    return store.commit(after, origin, parent=parent), changed, said


def rename_landmark(
    store: MapStore, landmark: str, name: str, *, note: str = "", command: str = ""
) -> tuple[int, str, str]:
    """Commit what an operator calls a landmark from now on, in all sessions, unless it is called so; '' takes his name
    back. Its identity, by which it is found in recordings, stays.

    Returns:
        The newest revision, what the landmark is called in it, and what the log says.

    Raises:
        InputError: the landmark is not in the map, or it cannot be called so.
        StaleRevisionError: another commit came in between.
    """
    parent = store.head()
    before = store.load(parent)
    identity = _landmark_of(store, before, parent, landmark)
    after = before.with_name(identity, name)
    was, called = before.label(identity), after.label(identity)
    if was == called:
        return parent, called, "it is called so already"
    said = f"renamed landmark {was} to {called}" + (f": {note}" if note else "")
    origin = Provenance(kind=RevisionKind.EDIT, command=command, note=said)
    return store.commit(after, origin, parent=parent), called, said


def _landmark_of(store: MapStore, living: LivingMap, number: int, name: str) -> int:
    """Return the id of a landmark of a revision by what it is called.

    Raises:
        InputError: it has none.
    """
    identity = living.landmark_called(name)
    if identity not in living.members.landmark_id:
        problem = f"no landmark {printable(name, 80)} in revision {number}"
        raise InputError(problem, path=store.where, hint=f"evermap map show {store.where} --all")
    return identity


def _enter_late(
    store: MapStore,
    head: int,
    recording: AnyRecording,
    newest: LivingMap,
    config: Config | None,
    data: bytes,
    progress: Progress | None,
) -> Entered:
    """A session that belongs before some of the steps of the history: these are taken once more, after it.

    Whatever came in since `head` was read makes the commit stale.
    """
    from evermap.pipeline import run_session

    steps, start_s = _history(store, head), float(recording.frames.stamp_s[0])
    first = _first_again(steps, start_s)
    parent = steps[first].revision.parent
    try:
        base = store.load(parent)
    except PrunedRevisionError as error:
        problem = f"{recording.name}: begins before the session of revision {parent + 1}, but {error.problem}"
        hint = "an older copy of the file; otherwise continue the map without that session"
        raise InputError(problem, path=store.where, hint=hint) from None
    later = sorted(steps[first:], key=lambda step: step.start_s)
    # ids that were given since are not given again
    living = replace(base, n_cliques_ever=newest.n_cliques_ever, n_sites_ever=newest.n_sites_ever)
    living = _with_words(living, newest, recording.clock)
    story: list[Chapter] = []
    looks: dict[int, tuple[Evidence, Members]] = {}
    for step in (step for step in later if step.start_s <= start_s):
        living = _retold(store, step, living, story, looks)
    session = run_session(recording, living, config, progress=progress)
    if not session.found:
        return Entered(session, newest, newest, (), (), head, {})
    story.append(_chapter(0, start_s, session.changes, living, session.living))
    living = session.living
    looks[0] = session.evidence, living.members
    replayed = [step for step in later if step.start_s > start_s]
    for step in replayed:
        living = _retold(store, step, living, story, looks)
    names = tuple(step.revision.provenance.recording for step in replayed if step.recording is not None)
    attached = {RECORDING: data, STORY: pack_story(parent, story), LOOKS: pack_looks(looks)}
    return Entered(session, newest, living, session.changes, names, head, attached)


def _retold(
    store: MapStore,
    step: _Step,
    living: LivingMap,
    story: list[Chapter],
    looks: dict[int, tuple[Evidence, Members]],
) -> LivingMap:
    """The map after a session or an edit that it has had before; what a session tells and saw is added to both."""
    if step.recording is None:
        return _edited_again(store, step, living)
    session = _session_again(store, step, living)
    story.append(_chapter(step.revision.number, step.start_s, session.changes, living, session.living))
    looks[step.revision.number] = session.evidence, session.living.members
    return session.living


def _chapter(
    revision: int, start_s: float, changes: tuple[MapChange, ...], before: LivingMap, after: LivingMap
) -> Chapter:
    known = before.members.landmark_id
    new = frozenset(np.setdiff1d(after.members.landmark_id, known).tolist())
    return Chapter(revision, start_s, changes, new, len(grown(known, after, changes)))


def _first_again(steps: Sequence[_Step], start_s: float) -> int:
    """The first step that is taken back: before it the map has no session that begins after one that is entered."""
    first = len(steps)
    while True:
        earliest = min([start_s, *(step.start_s for step in steps[first:] if step.recording is not None)])
        later = next(k for k, step in enumerate(steps) if step.recording is not None and step.start_s > earliest)
        if later == first:
            return first
        first = later


def at_time(store: MapStore, stamp_s: float) -> LivingMap:
    """Return the map of a store as it was at a time [s]: of the last revision whose sessions had all begun; the first
    for earlier.
    """
    living = store.load()
    if not stamp_s < living.session_start_s:
        return living
    for number in reversed(store.lineage()):
        older = store.load(number)
        if len(older.places):
            living = older
            if not stamp_s < older.session_start_s:
                break
    return living


def _refuse_twice(
    store: MapStore, kept: dict[int, Attachment], data: bytes, recording: AnyRecording, *, anew: bool
) -> None:
    """Refuse a recording that is in the map, or another copy of its drive: condensed, converted, or packed otherwise.

    `anew`: its clock starts anew, so that only stamps since the start of a drive are compared.

    Raises:
        TwiceError: it is.
    """
    from evermap.maps.sessions.session import drive_of, repaired, same_drive

    for number, item in kept.items():
        if item.n_bytes == len(data) and store.attached(item) == data:
            raise _twice(store, number, f"{recording.name}: is in the map already, as revision {number}", is_copy=False)
    near = _spans(store, kept) if anew else _overlapping(store, kept, recording)
    if not near:
        return
    fixed = repaired(recording)
    ends = {_ends(recording), _ends(fixed)}
    alike = [number for number, span in near.items() if span in ends]  # others cannot be of its drive
    if anew:
        lasting = [last_s - first_s for first_s, last_s in ends]
        alike = [k for k, (first_s, last_s) in near.items() if np.isclose(last_s - first_s, lasting, atol=1e-6).any()]
    since_start = _since_start if anew else tuple
    mine = since_start(drive_of(fixed)) if alike else ()
    for number in alike:
        other = _kept_recording(store, kept[number], number)
        if type(other) is type(recording) and same_drive(mine, since_start(drive_of(repaired(other)))):
            same = f"'{printable(other.name, 80)}' has the same frames and readings"
            problem = f"{recording.name}: its drive is in the map already, as revision {number}: {same}"
            raise _twice(store, number, problem, is_copy=True)


def _kept_recording(store: MapStore, kept: Attachment, number: int) -> AnyRecording:
    """Return the recording that a revision keeps.

    Raises:
        InputError: this evermap cannot read it.
    """
    try:
        return unpack_recording(store.attached(kept))
    except DamagedError as error:
        hint = "the evermap that wrote it, or a newer one"
        raise InputError(f"revision {number}: {error}", path=store.where, hint=hint) from None


def _twice(store: MapStore, number: int, problem: str, *, is_copy: bool) -> TwiceError:
    twice = TwiceError(problem, path=store.where, hint="a session counts once; the map is unchanged")
    twice.revision, twice.is_copy = number, is_copy
    return twice


def _overlapping(
    store: MapStore, kept: Mapping[int, Attachment], recording: AnyRecording
) -> dict[int, tuple[float, float]]:
    """First and last stamp of the sessions that overlap a recording in time, by revision."""
    first_s, last_s = _ends(recording)
    spans = _spans(store, kept)
    return {number: span for number, span in spans.items() if span[0] <= last_s and span[1] >= first_s}


def _spans(store: MapStore, kept: Mapping[int, Attachment]) -> dict[int, tuple[float, float]]:
    """First and last stamp of sessions, by revision."""
    log = {item.number: item.provenance for item in store.log() if item.number in kept}
    return {number: (origin.stamp_from_s, origin.stamp_to_s) for number, origin in log.items()}


def _since_start(drive: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """A result of `drive_of` with stamps since its first one, to a microsecond."""
    stamp_s, rows = drive
    rows = np.column_stack([np.round(rows[:, 0] - stamp_s[0], 6), rows[:, 1:]])
    return np.round(stamp_s - stamp_s[0], 6), rows[np.lexsort(rows.T[::-1])]


def _ends(recording: AnyRecording) -> tuple[float, float]:
    """First and last stamp of a recording; nan without any."""
    stamp_s = recording.frames.stamp_s
    return (float(np.nanmin(stamp_s)), float(np.nanmax(stamp_s))) if len(stamp_s) else (np.nan, np.nan)


def _recordings(store: MapStore, head: int) -> dict[int, Attachment]:
    """Stored recordings of a revision and those before it."""
    return {item.revision: item for item in store.attachments(store.lineage(head)) if item.name == RECORDING}


def _history(store: MapStore, head: int) -> list[_Step]:
    """Sessions and edits of the map at a revision, in the order in which they were committed; what comes in meanwhile
    is no part of it.
    """
    kept, lineage = _recordings(store, head), set(store.lineage(head))
    steps: list[_Step] = []
    start_s = -np.inf
    for revision in store.log():
        if revision.number not in lineage or revision.provenance.kind is RevisionKind.REVERT:
            continue
        if revision.provenance.kind is RevisionKind.SESSION:
            if revision.number not in kept:
                raise InputError(
                    f"revision {revision.number} has no stored recording, so that no session can be entered before it",
                    path=store.where,
                    hint=f"evermap map revert {store.where} {revision.parent}, then the sessions in order of time",
                )
            steps.append(_Step(revision.provenance.stamp_from_s, revision, kept[revision.number]))
            start_s = max(start_s, revision.provenance.stamp_from_s)
        else:  # an operator's word holds from the newest session on that he knew
            steps.append(_Step(start_s, revision, None))
    return steps


def _edited_again(store: MapStore, step: _Step, living: LivingMap) -> LivingMap:
    for landmark, word in edits(store.members(step.revision.parent), store.members(step.revision.number)):
        if landmark in living.members.landmark_id:
            living = living.edited(landmark, **WORDS[word])
    return living


def _session_again(store: MapStore, step: _Step, living: LivingMap, config: Config | None = None) -> Session:
    """A session that a map has had before, with its own settings unless there are others."""
    from evermap.pipeline import run_session

    assert step.recording is not None
    number, robot = step.revision.number, step.revision.provenance.robot
    recording = replace(_kept_recording(store, step.recording, number), robot=robot)
    problem = f"revision {number} cannot be brought in again"
    try:
        config = _of_its_space(recording, config or parse_config(step.revision.provenance.config))
        session = run_session(recording, living, config)
    except DataError as error:
        raise UnbridgedError(f"{problem}: {error}") from None
    if session.slam.interrupted:  # half of a session must not take the place of the whole
        raise KeyboardInterrupt("the map is unchanged")
    if not session.found:  # what is in the map is not dropped
        problem = f"{problem}: {session.set_aside[0]}"
        raise UnbridgedError(problem, path=store.where, hint="sessions that overlap with both, then this one again")
    return session


def _of_its_space(recording: AnyRecording, config: Config | None) -> Config | None:
    """Return settings by which a recording in space stays there, and one in the plane is no contradiction."""
    stays = False if is_in_space(recording) else None
    if config is None and stays is None:
        return None
    config = config or Config()
    return config.model_copy(update={"slam": config.slam.model_copy(update={"plane": stays})})


@dataclass(frozen=True, slots=True)
class Reentered(Shown):
    """Result of entering all sessions of a map again.

    Attributes:
        sessions: how many it has.
        kept: how many of them an earlier attempt had entered already.
        parent: the newest revision of the map, which they follow.
        revision: the newest after them; `parent` where there are none.
        adopted: whether the map has them.
    """

    sessions: int
    kept: int
    parent: int
    revision: int
    adopted: bool


def reenter(where: str, work: Path, config: Config | None = None, *, adopt: bool = False) -> Reentered:
    """Enter all sessions of a map again, in order of time, and the edits at their time, as revisions after its newest.

    They are written to a copy of the map, the first as a revert to what there was before all sessions. An attempt that
    was stopped is continued: what an earlier one entered alike, of the same recordings with the same settings by the
    same evermap, is taken over. What reads the map sees the last of them or none.

    Args:
        where: the map, as `open_store` takes it.
        work: file of the copy, which is there when all are entered.
        config: settings of all sessions; None for those of each.
        adopt: append them to the map itself, in one transaction; what came in meanwhile is entered, too.

    Raises:
        InputError: a session of the map keeps no recording, or what was before the first is pruned.
        UnbridgedError: a session is not found any more; the map stays as it was.
        DataError, NumericalError: as `pipeline.run_session`.
    """
    from evermap.maps.store.sql import SqlStore

    with open_store(where) as store:
        assert isinstance(store, SqlStore)
        while True:
            found = _reentered(store, work, config)
            if not adopt or found.revision == found.parent:
                return found
            try:
                with open_store(work) as entered:
                    assert isinstance(entered, SqlStore)
                    store.extend(entered)
                return replace(found, adopted=True)
            except StaleRevisionError:  # another process committed meanwhile
                continue


def _reentered(store: SqlStore, work: Path, config: Config | None) -> Reentered:
    from evermap.maps.store.sql import SqlStore
    from evermap.maps.store.sqlite import snapshot

    head = store.head()
    steps = _history(store, head)
    sessions = [step for step in steps if step.recording is not None]
    if not sessions:
        return Reentered(0, 0, head, head, adopted=False)
    base = min(step.revision.parent for step in sessions)
    steps = sorted((step for step in steps if step.revision.number > base), key=lambda step: step.start_s)
    part, before = (work.with_name(f".{work.name}.{kind}") for kind in ("part", "before"))
    earlier = max((path for path in (part, before, work) if path.exists()), key=_written_by, default=None)
    if earlier == part:
        earlier = part.replace(before)
    part.unlink(missing_ok=True)
    snapshot(store, part, head)
    with open_store(part) as fresh:
        assert isinstance(fresh, SqlStore)
        fresh.revert(base, Provenance(note=f"all sessions of revision {head} again"))
        kept = _taken_over(earlier, fresh, base, steps, config)
        living = fresh.load()
        if not kept:
            newest = store.load(head)
            living = _with_words(living, newest, newest.clock)
        for step in steps[kept:]:
            living = _entered_again(store, fresh, step, living, config)
        revision = fresh.head()
    part.replace(work)
    before.unlink(missing_ok=True)
    return Reentered(len(sessions), sum(s.recording is not None for s in steps[:kept]), head, revision, adopted=False)


def _with_words(living: LivingMap, newest: LivingMap, clock: Clock) -> LivingMap:
    """An earlier map with what users said of lifetimes, and what they call landmarks, which are of no time; one without
    places gets a clock.
    """
    living = replace(living, renamed=newest.renamed)
    lives = replace(living.lives, prior_class_id=newest.lives.prior_class_id, prior=newest.lives.prior)
    living = replace(living, class_names=newest.class_names, lives=lives) if len(lives.prior) else living
    return living if len(living.places) else replace(living, clock=clock)


def _entered_again(
    store: MapStore, fresh: MapStore, step: _Step, living: LivingMap, config: Config | None
) -> LivingMap:
    """Commit a session or an edit to the copy of a map; returns the map after it."""
    said = step.revision.provenance
    if step.recording is None:
        living = _edited_again(store, step, living)
        fresh.commit(living, said, parent=fresh.head())
        return living
    start = time.perf_counter()
    session = _session_again(store, step, living, config)
    if config is not None:
        said = replace(said, config=to_toml(config), seed=config.slam.seed)
    said = replace(said, wall_s=time.perf_counter() - start)
    attached: dict[str, bytes | Attachment] = {RECORDING: step.recording}
    attached[TRAJECTORY] = pack_trajectory(session.slam.trajectory)
    parent = fresh.head()
    fresh.commit(session.living, said, session.changes, session.evidence, parent=parent, attachments=attached)
    return session.living


def _written_by(earlier: Path) -> int:
    """How many revisions an earlier attempt has written after its revert; 0 of a file that cannot be read."""
    try:
        with open_store(earlier) as store:
            return store.head() - _last_revert(store)
    except (EvermapError, ValueError):
        return 0


def _last_revert(store: MapStore) -> int:
    return max(item.number for item in store.log() if item.provenance.kind is RevisionKind.REVERT)


def _said(living: LivingMap) -> dict[str, Life]:
    """Return the users' lifetime priors, by class; '' for all others."""
    named = (*living.class_names, "")
    return {named[kind]: prior for kind, prior in zip(living.lives.prior_class_id, living.lives.prior, strict=True)}


def _taken_over(earlier: Path | None, fresh: SqlStore, base: int, steps: Sequence[_Step], config: Config | None) -> int:
    """Copy what an earlier attempt has entered alike, from its first step on; returns the number of steps."""
    from evermap.maps.store.sql import SqlStore

    if earlier is None or not _written_by(earlier):
        return 0
    with open_store(earlier) as old:
        assert isinstance(old, SqlStore)
        log, start = {item.number: item for item in old.log()}, _last_revert(old)
        same = old.named(log[start].restores)[1] == fresh.named(base)[1]
        was, newest = old.load(), fresh.load(fresh.head() - 1)
        if not same or _said(was) != _said(newest) or [*was.renamed.items()] != [*newest.renamed.items()]:
            return 0
        kept: dict[str, dict[int, Attachment]] = {RECORDING: {}, TRAJECTORY: {}}
        for item in old.attachments():
            kept.setdefault(item.name, {})[item.revision] = item
        for count, step in enumerate(steps):
            number = start + count + 1
            wanted = replace(step.revision.provenance, wall_s=np.nan)
            if step.recording is not None and config is not None:
                wanted = replace(wanted, config=to_toml(config), seed=config.slam.seed)
            digest = None if step.recording is None else step.recording.digest
            if number not in log or log[number].evermap_version != __version__:
                return count
            if getattr(kept[RECORDING].get(number), "digest", None) != digest:
                return count
            said = log[number].provenance
            if repr(replace(said, wall_s=np.nan)) != repr(wanted):  # nan is not equal to itself
                return count
            seen = old.evidence(revisions=[number])
            attached: dict[str, bytes | Attachment] = {} if step.recording is None else {RECORDING: step.recording}
            if number in kept[TRAJECTORY]:
                attached[TRAJECTORY] = old.attached(kept[TRAJECTORY][number])
            parent = fresh.head()
            fresh.commit(old.load(number), said, old.changes(number), seen, parent=parent, attachments=attached)
    return len(steps)
