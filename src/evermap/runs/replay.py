"""What a map has had before, once more: its sessions, from the recordings that it keeps, and the edits between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from evermap.config import Config, parse_config
from evermap.errors import DataError, InputError
from evermap.maps.diff import edits
from evermap.maps.living import LivingMap
from evermap.maps.store import Attachment, MapStore, Revision, RevisionKind
from evermap.maps.store.content import DamagedError
from evermap.maps.store.measured import RECORDING, unpack_recording
from evermap.runs.edits import WORDS
from evermap.types import is_in_space

if TYPE_CHECKING:
    from evermap.maps.sessions.session import Session
    from evermap.types import AnyRecording, Clock


class UnbridgedError(DataError):
    """A late session after which a later one can no longer be localised; others may connect them."""


@dataclass(frozen=True, slots=True)
class Step:
    """A session (with its recording), or an edit, of a map's history."""

    start_s: float
    revision: Revision
    recording: Attachment | None


def read_recording_of(store: MapStore, kept: Attachment, number: int) -> AnyRecording:
    """Return the recording that a revision keeps.

    Raises:
        InputError: this evermap cannot read it.
    """
    try:
        return unpack_recording(store.attached(kept))
    except DamagedError as error:
        hint = "the evermap that wrote it, or a newer one"
        raise InputError(f"revision {number}: {error}", path=store.where, hint=hint) from None


def list_recordings(store: MapStore, head: int) -> dict[int, Attachment]:
    """Stored recordings of a revision and those before it."""
    return {item.revision: item for item in store.attachments(store.lineage(head)) if item.name == RECORDING}


def list_steps(store: MapStore, head: int) -> list[Step]:
    """Sessions and edits of the map at a revision, in the order in which they were committed; what comes in meanwhile
    is no part of it.
    """
    kept, lineage = list_recordings(store, head), set(store.lineage(head))
    steps: list[Step] = []
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
            steps.append(Step(revision.provenance.stamp_from_s, revision, kept[revision.number]))
            start_s = max(start_s, revision.provenance.stamp_from_s)
        else:  # an operator's word holds from the newest session on that he knew
            steps.append(Step(start_s, revision, None))
    return steps


def edit_again(store: MapStore, step: Step, living: LivingMap) -> LivingMap:
    """Return the map after an edit that it has had before."""
    for landmark, word in edits(store.members(step.revision.parent), store.members(step.revision.number)):
        if landmark in living.members.landmark_id:
            living = living.edited(landmark, **WORDS[word])
    return living


def enter_again(store: MapStore, step: Step, living: LivingMap, config: Config | None = None) -> Session:
    """A session that a map has had before, with its own settings unless there are others."""
    from evermap.pipeline import run_session

    assert step.recording is not None
    number, robot = step.revision.number, step.revision.provenance.robot
    recording = replace(read_recording_of(store, step.recording, number), robot=robot)
    problem = f"revision {number} cannot be brought in again"
    try:
        config = settle_space(recording, config or parse_config(step.revision.provenance.config)) or Config()
        accepted = config.living.model_copy(update={"accept": "any"})  # it is in the map: it is not judged again
        session = run_session(recording, living, config.model_copy(update={"living": accepted}))
    except DataError as error:
        raise UnbridgedError(f"{problem}: {error}") from None
    if session.slam.interrupted:  # half of a session must not take the place of the whole
        raise KeyboardInterrupt("the map is unchanged")
    if not session.found:  # what is in the map is not dropped
        problem = f"{problem}: {session.set_aside[0]}"
        raise UnbridgedError(problem, path=store.where, hint="sessions that overlap with both, then this one again")
    return session


def settle_space(recording: AnyRecording, config: Config | None) -> Config | None:
    """Return settings by which a recording in space stays there, and one in the plane is no contradiction."""
    stays = False if is_in_space(recording) else None
    if config is None and stays is None:
        return None
    config = config or Config()
    return config.model_copy(update={"slam": config.slam.model_copy(update={"plane": stays})})


def with_words_of(living: LivingMap, newest: LivingMap, clock: Clock) -> LivingMap:
    """An earlier map with what users said of lifetimes, and what they call landmarks, which are of no time; one without
    places gets a clock.
    """
    living = replace(living, renamed=newest.renamed)
    lives = replace(living.lives, prior_class_id=newest.lives.prior_class_id, prior=newest.lives.prior)
    living = replace(living, class_names=newest.class_names, lives=lives) if len(lives.prior) else living
    return living if len(living.places) else replace(living, clock=clock)
