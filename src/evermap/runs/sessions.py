"""Sessions of a stored map, in order of time, whenever they arrive.

A session that begins before the newest one of the map is late: it is entered where it belongs. The map is taken back to
the last revision before it, and it and all later sessions and edits are brought in again, from the recordings that are
kept with their revisions. So the map is the one that the right order would have given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from evermap.config import Config, to_toml
from evermap.errors import ConfigError, DataError, InputError, printable
from evermap.maps.diff import grown
from evermap.maps.living import LivingMap
from evermap.maps.store import Attachment, MapStore, Provenance, PrunedRevisionError, RevisionKind
from evermap.maps.store.history import STORY, Chapter, pack_story
from evermap.maps.store.measured import LOOKS, RECORDING, TRAJECTORY, pack_looks, pack_recording, pack_trajectory
from evermap.runs.replay import (
    Step,
    edit_again,
    enter_again,
    list_recordings,
    list_steps,
    read_recording_of,
    settle_space,
    with_words_of,
)
from evermap.runs.session_clock import place_session
from evermap.show import Shown
from evermap.types import Progress
from evermap.valid import check_type

if TYPE_CHECKING:
    from evermap.existence.lifetimes import Lifetimes
    from evermap.existence.sites import Evidence
    from evermap.maps.living import Members
    from evermap.maps.sessions.session import Session
    from evermap.types import AnyRecording, FloatArray, IntArray, Landmarks, MapChange


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
        span_s: first and last stamp of its recording as it was given, by which copies of it are known.
    """

    session: Session
    newest: LivingMap
    living: LivingMap
    changes: tuple[MapChange, ...]
    replayed: tuple[str, ...]
    parent: int
    attachments: dict[str, bytes]
    span_s: tuple[float, float]

    def refusal(self, config: Config | None = None) -> str:
        """Return why the session does not enter the map by itself (`living.accept`), in a line; '' where it does."""
        return self.session.refusal((config or Config()).living)

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
        provenance = Provenance(
            kind=RevisionKind.SESSION,
            recording=recording.name,
            source=recording.source,
            command=command,
            config=to_toml(config),
            seed=config.slam.seed,
            stamp_from_s=self.span_s[0],
            stamp_to_s=self.span_s[1],
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
    from evermap.maps.sessions.admission import check_fits, in_its_space
    from evermap.pipeline import run_session

    check_type(recording)
    head = store.head()
    newest = store.load(head)
    recording = in_its_space(recording, newest, config or Config())
    if len(newest.places):
        check_fits(recording, newest)
    config = settle_space(recording, config)
    gap_s, kept = (config or Config()).living.clock_gap_s, list_recordings(store, head)
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
        return Entered(session, newest, session.living, session.changes, (), head, {RECORDING: data}, _ends(recording))
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

    steps, start_s = list_steps(store, head), float(recording.frames.stamp_s[0])
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
    living = with_words_of(living, newest, recording.clock)
    story: list[Chapter] = []
    looks: dict[int, tuple[Evidence, Members]] = {}
    for step in (step for step in later if step.start_s <= start_s):
        living = _retold(store, step, living, story, looks)
    session = run_session(recording, living, config, progress=progress)
    if not session.found:
        return Entered(session, newest, newest, (), (), head, {}, _ends(recording))
    story.append(_chapter(0, start_s, session.changes, living, session.living))
    living = session.living
    looks[0] = session.evidence, living.members
    replayed = [step for step in later if step.start_s > start_s]
    for step in replayed:
        living = _retold(store, step, living, story, looks)
    names = tuple(step.revision.provenance.recording for step in replayed if step.recording is not None)
    attached = {RECORDING: data, STORY: pack_story(parent, story), LOOKS: pack_looks(looks)}
    return Entered(session, newest, living, session.changes, names, head, attached, _ends(recording))


def _retold(
    store: MapStore,
    step: Step,
    living: LivingMap,
    story: list[Chapter],
    looks: dict[int, tuple[Evidence, Members]],
) -> LivingMap:
    """The map after a session or an edit that it has had before; what a session tells and saw is added to both."""
    if step.recording is None:
        return edit_again(store, step, living)
    session = enter_again(store, step, living)
    story.append(_chapter(step.revision.number, step.start_s, session.changes, living, session.living))
    looks[step.revision.number] = session.evidence, session.living.members
    return session.living


def _chapter(
    revision: int, start_s: float, changes: tuple[MapChange, ...], before: LivingMap, after: LivingMap
) -> Chapter:
    known = before.members.landmark_id
    new = frozenset(np.setdiff1d(after.members.landmark_id, known).tolist())
    return Chapter(revision, start_s, changes, new, len(grown(known, after, changes)))


def _first_again(steps: Sequence[Step], start_s: float) -> int:
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
    from evermap.maps.sessions.admission import drive_of, is_same_drive, repair

    for number, item in kept.items():
        if item.n_bytes == len(data) and store.attached(item) == data:
            raise _twice(store, number, f"{recording.name}: is in the map already, as revision {number}", is_copy=False)
    near = _spans(store, kept) if anew else _overlapping(store, kept, recording)
    if not near:
        return
    fixed = repair(recording)
    ends = {_ends(recording), _ends(fixed)}
    alike = [number for number, span in near.items() if span in ends]  # others cannot be of its drive
    if anew:
        lasting = [last_s - first_s for first_s, last_s in ends]
        alike = [k for k, (first_s, last_s) in near.items() if np.isclose(last_s - first_s, lasting, atol=1e-6).any()]
    since_start = _since_start if anew else tuple
    mine = since_start(drive_of(fixed)) if alike else ()
    for number in alike:
        other = read_recording_of(store, kept[number], number)
        if type(other) is type(recording) and is_same_drive(mine, since_start(drive_of(repair(other)))):
            same = f"'{printable(other.name, 80)}' has the same frames and readings"
            problem = f"{recording.name}: its drive is in the map already, as revision {number}: {same}"
            raise _twice(store, number, problem, is_copy=True)


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
