"""Edits of landmarks by operators, as revisions of a stored map: pinned, deleted, renamed, and all that taken back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from evermap.errors import InputError, printable
from evermap.maps.diff import edits
from evermap.maps.living import LivingMap
from evermap.maps.store import MapStore, Provenance, RevisionKind

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
