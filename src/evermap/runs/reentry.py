"""All sessions of a map entered again in order of time, as with new settings: in a copy, or appended to the map."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evermap import __version__
from evermap.config import Config, to_toml
from evermap.errors import EvermapError
from evermap.maps.living import LivingMap
from evermap.maps.store import Attachment, MapStore, Provenance, RevisionKind, StaleRevisionError, open_store
from evermap.maps.store.measured import RECORDING, TRAJECTORY, pack_trajectory
from evermap.runs.replay import Step, edit_again, enter_again, list_steps, with_words_of
from evermap.show import Shown

if TYPE_CHECKING:
    from evermap.maps.lives import Life
    from evermap.maps.store.sql import SqlStore


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
            found = _reenter(store, work, config)
            if not adopt or found.revision == found.parent:
                return found
            try:
                with open_store(work) as entered:
                    assert isinstance(entered, SqlStore)
                    store.extend(entered)
                return replace(found, adopted=True)
            except StaleRevisionError:  # another process committed meanwhile
                continue


def _reenter(store: SqlStore, work: Path, config: Config | None) -> Reentered:
    from evermap.maps.store.sql import SqlStore
    from evermap.maps.store.sqlite import snapshot

    head = store.head()
    steps = list_steps(store, head)
    sessions = [step for step in steps if step.recording is not None]
    if not sessions:
        return Reentered(0, 0, head, head, adopted=False)
    base = min(step.revision.parent for step in sessions)
    steps = sorted((step for step in steps if step.revision.number > base), key=lambda step: step.start_s)
    part, before = (work.with_name(f".{work.name}.{kind}") for kind in ("part", "before"))
    earlier = max((path for path in (part, before, work) if path.exists()), key=_count_written, default=None)
    if earlier == part:
        earlier = part.replace(before)
    part.unlink(missing_ok=True)
    snapshot(store, part, head)
    with open_store(part) as fresh:
        assert isinstance(fresh, SqlStore)
        fresh.revert(base, Provenance(note=f"all sessions of revision {head} again"))
        kept = _take_over(earlier, fresh, base, steps, config)
        living = fresh.load()
        if not kept:
            newest = store.load(head)
            living = with_words_of(living, newest, newest.clock)
        for step in steps[kept:]:
            living = _enter_again(store, fresh, step, living, config)
        revision = fresh.head()
    part.replace(work)
    before.unlink(missing_ok=True)
    return Reentered(len(sessions), sum(s.recording is not None for s in steps[:kept]), head, revision, adopted=False)


def _enter_again(store: MapStore, fresh: MapStore, step: Step, living: LivingMap, config: Config | None) -> LivingMap:
    """Commit a session or an edit to the copy of a map; returns the map after it."""
    said = step.revision.provenance
    if step.recording is None:
        living = edit_again(store, step, living)
        fresh.commit(living, said, parent=fresh.head())
        return living
    start = time.perf_counter()
    session = enter_again(store, step, living, config)
    if config is not None:
        said = replace(said, config=to_toml(config), seed=config.slam.seed)
    said = replace(said, wall_s=time.perf_counter() - start)
    attached: dict[str, bytes | Attachment] = {RECORDING: step.recording}
    attached[TRAJECTORY] = pack_trajectory(session.slam.trajectory)
    parent = fresh.head()
    fresh.commit(session.living, said, session.changes, session.evidence, parent=parent, attachments=attached)
    return session.living


def _count_written(earlier: Path) -> int:
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


def _take_over(earlier: Path | None, fresh: SqlStore, base: int, steps: Sequence[Step], config: Config | None) -> int:
    """Copy what an earlier attempt has entered alike, from its first step on; returns the number of steps."""
    from evermap.maps.store.sql import SqlStore

    if earlier is None or not _count_written(earlier):
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
