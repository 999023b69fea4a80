"""Differences between revisions of a map: the changes reported by its sessions, composed to their net effect.

Only sessions report changes (`sessions.decide`), and every revision stores its own. Between neighbouring revisions the
difference is the session's report. Over several of them the changes of each landmark are composed: what left and came
back to its place is no difference, what moved twice moved once. Where the way from one revision to the other leads back
in history, through a revert or because that was asked for, changes are undone.

A landmark that the earlier map did not know, and that nobody saw appear, has not changed: the map grew by it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from evermap.config import DecisionConfig
from evermap.geometry import se3
from evermap.geometry.rigid import rigid
from evermap.maps.living import TURNS, LivingMap, Members
from evermap.maps.store.protocol import MapStore
from evermap.show import Shown, data_frame
from evermap.types import UNKNOWN, ChangeKind, FloatArray, IntArray, Landmarks, MapChange

USUAL = DecisionConfig()
ToldBySession = tuple[Sequence[MapChange], bool]
"""Changes reported by a session, and whether they are inverted."""
COMES = frozenset({ChangeKind.APPEARED, ChangeKind.RETURNED})


@dataclass(frozen=True, slots=True)
class Told:
    """A reported change on the way from one map to another.

    Attributes:
        change: as reported.
        undone: whether it is inverted on that way.
        session: number of the session on that way.
    """

    change: MapChange
    undone: bool
    session: int

    @property
    def comes(self) -> bool:
        """Whether its landmarks are present after it, and were absent before."""
        return self.change.kind is ChangeKind.VANISHED if self.undone else self.change.kind in COMES

    @property
    def goes(self) -> bool:
        """Whether its landmarks are absent after it, and were present before."""
        return self.change.kind in COMES if self.undone else self.change.kind is ChangeKind.VANISHED


@dataclass(frozen=True, slots=True)
class Difference(Shown):
    """Difference between two revisions of a map.

    Attributes:
        a, b: the revisions.
        changes: net effect of the changes reported between them.
        grown: (N,) landmarks that are present in `b` and unknown in `a`, without having appeared.
        edits: by operators: landmark and 'pinned', 'unpinned', 'deleted' or 'undeleted'.
    """

    a: int
    b: int
    changes: tuple[MapChange, ...]
    grown: IntArray
    edits: tuple[tuple[int, str], ...]

    def _facts(self) -> dict[str, Any]:
        kinds = Counter(change.kind.value for change in self.changes)
        return {"a": self.a, "b": self.b, **kinds, "grown": len(self.grown), "edits": len(self.edits)}

    def to_pandas(self) -> Any:
        """Return a data frame with a row a change, with the fields of `MapChange`.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        names = [item.name for item in fields(MapChange)]
        return data_frame({name: [getattr(change, name) for change in self.changes] for name in names})


def diff(store: MapStore, a: int, b: int | None = None) -> Difference:
    """Return what changed from one revision of a map to another.

    Args:
        store: the map.
        a: a revision; 0 is the empty map.
        b: another, as a rule a later one; None for the newest.

    Raises:
        InputError: there is no such revision.
    """
    b = store.head() if b is None else b
    before, after = store.load(a), store.load(b)
    names = after.landmark_names | before.landmark_names
    changes = tuple(change.named(names) for change in net(told_between(store, a, b), before, after))
    new = grown(before.members.landmark_id, after, changes)
    return Difference(a, b, changes, new, edits(before.members, after.members))


def told_between(store: MapStore, a: int, b: int) -> list[ToldBySession]:
    """Return the changes reported between two revisions, inverted from `a` back to the common ancestor."""
    old, new = store.lineage(a), store.lineage(b)
    common = sum(1 for one, other in zip(old, new, strict=False) if one == other)
    back = [(store.changes(number)[::-1], True) for number in reversed(old[common:])]
    return [*back, *((store.changes(number), False) for number in new[common:])]


def net(
    sessions: Sequence[ToldBySession], a: LivingMap, b: LivingMap, settings: DecisionConfig = USUAL
) -> tuple[MapChange, ...]:
    """Return the net effect of successive reported changes.

    What one session told is returned as it is, and so is a change of landmarks of which no other is told. Of several
    the interval, the hits and the misses are those of all changes that the net effect rests on, and the probability is
    the product of theirs: of what vanished the last one, of what came the last coming and what followed, of what moved
    all. It moved from its place in `a` to that in `b`.

    Args:
        sessions: the changes that each told, and whether they are undone.
        a: the map before them; its ids mean the same as those of `b`.
        b: the map after them.
        settings: what is the same place.
    """
    if len(sessions) == 1 and not sessions[0][1]:
        return tuple(sessions[0][0])
    parts = {id(one): _split_replacement(one) for changes, _ in sessions for one in changes}
    told = [
        Told(part, undone, k)
        for k, (changes, undone) in enumerate(sessions)
        for one in changes
        for part in parts[id(one)]
    ]
    steps: dict[int, list[int]] = {}
    for number, one in enumerate(told):
        for name in one.change.landmark_ids:
            steps.setdefault(name, []).append(number)
    forth = not any(one.undone for one in told)  # a way back may pass what the map grew by
    known, stood, stands = set(a.members.landmark_id.tolist()), _standing(a), _standing(b)
    groups: dict[tuple[tuple[int, ...], bool, bool, bool], list[int]] = {}
    for name, numbers in sorted(steps.items(), key=lambda item: (item[1], item[0])):
        ends = (True, not (told[numbers[-1]].goes and name in stands)) if forth else (name in stood, name in stands)
        groups.setdefault((tuple(numbers), name in known, *ends), []).append(name)
    found: list[MapChange] = []
    for (row, was_known, before, after), names in groups.items():
        path = [told[number] for number in row]
        only = path[0].change
        if forth and not was_known and only.kind is not ChangeKind.APPEARED:
            continue  # the map grew by it
        if forth and not after:
            continue  # it had never left, as a later session saw
        if forth and len(path) == 1 and len(names) == len(only.landmark_ids):
            found.append(only)
            continue
        change = _composed(path, tuple(names), (a, b), settings)
        if change is not None and (forth or _possible(change.kind, before, after)):
            found.append(change)
    for change in (change for changes, _ in sessions for change in changes if change.kind is ChangeKind.REPLACED):
        both = parts[id(change)]
        if all(any(part is other for other in found) for part in both):  # nothing else is told of either
            found = [other for other in found if not any(other is part for part in both)] + [change]
    return with_swaps(found, a, b, settings) if len({one.session for one in told}) > 1 else tuple(found)


def _split_replacement(change: MapChange) -> tuple[MapChange, ...]:
    """A replacement as what left and what came; any other change as it is."""
    if change.kind is not ChangeKind.REPLACED:
        return (change,)
    half = len(change.landmark_ids) // 2
    nowhere = tuple([math.nan] * len(change.displacement_m))
    left, came = change.landmark_ids[:half], change.landmark_ids[half:]
    return (
        replace(change, kind=ChangeKind.VANISHED, landmark_ids=left, displacement_m=nowhere, n_hits=0),
        replace(change, kind=ChangeKind.APPEARED, landmark_ids=came, displacement_m=nowhere, n_misses=0),
    )


def grown(known: IntArray, b: LivingMap, changes: Iterable[MapChange]) -> IntArray:
    """Return (N,) ids of landmarks that are present in `b`, unknown before, and without a reported change."""
    told = [name for change in changes for name in change.landmark_ids]
    stands = b.members.landmark_id[(b.told_site() != UNKNOWN) & ~b.members.deleted]
    return np.setdiff1d(stands, np.concatenate([known, np.array(told, dtype=np.int64)]))


def edits(a: Members, b: Members) -> tuple[tuple[int, str], ...]:
    """Return what operators said between two maps: landmark and 'pinned', 'unpinned', 'deleted' or 'undeleted'."""
    ids, row_a, row_b = np.intersect1d(a.landmark_id, b.landmark_id, return_indices=True)
    words = []
    for name, yes, no in (("pinned", "pinned", "unpinned"), ("deleted", "deleted", "undeleted")):
        before, after = getattr(a, name)[row_a], getattr(b, name)[row_b]
        words += [(int(ids[k]), yes if after[k] else no) for k in np.flatnonzero(before != after)]
    return tuple(sorted(words))


def motion_of(
    was_m: FloatArray, now_m: FloatArray, turns: tuple[FloatArray, FloatArray] | None = None
) -> tuple[FloatArray, float]:
    """Return shift and rotation of a body by its landmarks (K, 2) before and after; 0 is the rotation of one.

    In space (K, 3), with quaternions `turns` (K, 4) before and after, the rotation is an angle without a sign: the
    median one of the landmarks that have an orientation, else by the positions of three and more.
    """
    shift = now_m.mean(axis=0) - was_m.mean(axis=0)
    if turns is None:
        return shift, float(rigid(was_m, now_m)[2]) if len(was_m) > 1 else 0.0
    known = np.isfinite(turns[0][:, 0]) & np.isfinite(turns[1][:, 0])
    if known.any():
        was, now = (np.hstack([at[known], turn[known]]) for at, turn in zip((was_m, now_m), turns, strict=True))
        return shift, float(np.median(se3.angle_between(was, now)))
    return shift, float(se3.angle_between(se3.identity(), rigid(was_m, now_m))) if len(was_m) > 2 else 0.0


def elsewhere(shift: FloatArray, turn: float, settings: DecisionConfig) -> bool:
    """Return whether a body is at another place after a motion, or in space turned at its own."""
    turned = len(shift) > 2 and abs(turn) >= settings.same_turn_rad
    return bool(turned or math.hypot(*shift) >= settings.same_spot_m)


def with_swaps(
    found: Sequence[MapChange], before: LivingMap, after: LivingMap, settings: DecisionConfig = USUAL
) -> tuple[MapChange, ...]:
    """Return changes in which two moves to each other's place are one exchange, or of identities."""
    moved = [k for k, change in enumerate(found) if change.kind is ChangeKind.MOVED]
    if len(moved) < 2:
        return tuple(found)
    then, now = before.landmarks(), after.landmarks()

    def at(records: Landmarks, names: tuple[int, ...]) -> FloatArray:
        rows = np.isin(records.landmark_id, names)
        return np.asarray(records.position_m[rows].mean(axis=0)) if rows.any() else np.full(_dim(before, after), np.nan)

    was = {k: at(then, found[k].landmark_ids) for k in moved}
    is_at = {k: at(now, found[k].landmark_ids) for k in moved}
    swapped: dict[int, int] = {}
    for a in moved:
        for b in moved:
            if a < b and a not in swapped and b not in swapped:
                across = max(np.linalg.norm(is_at[a] - was[b]), np.linalg.norm(is_at[b] - was[a]))
                if across < settings.same_place_m:
                    swapped[a] = b
    partners = set(swapped.values())
    return tuple(
        _exchanged(change, found[swapped[k]]) if k in swapped else change
        for k, change in enumerate(found)
        if k not in partners
    )


def _exchanged(change: MapChange, other: MapChange) -> MapChange:
    """Combine two moves into one exchange; the displacement is that of the first."""
    return replace(
        change,
        kind=ChangeKind.SWAPPED,
        landmark_ids=tuple(sorted((*change.landmark_ids, *other.landmark_ids))),
        probability=min(change.probability, other.probability),
        n_hits=change.n_hits + other.n_hits,
        n_misses=change.n_misses + other.n_misses,
    )


def _composed(
    path: Sequence[Told], names: tuple[int, ...], maps: tuple[LivingMap, LivingMap], settings: DecisionConfig
) -> MapChange | None:
    """The net effect of changes of the same landmarks; None for none."""
    first, last = path[0], path[-1]
    came, goes = [k for k, one in enumerate(path) if one.comes], last.goes
    nowhere = np.full(_dim(*maps), np.nan)
    shift, turn = nowhere, 0.0
    if first.comes and goes:
        return None
    if goes:
        kind, rests_on = ChangeKind.VANISHED, path[-1:]
    else:
        shift, turn = _shift(path, names, *maps)
        if first.comes:
            new = first.change.kind is ChangeKind.APPEARED
            kind = ChangeKind.APPEARED if new else ChangeKind.RETURNED
            shift, turn = (nowhere, 0.0) if new else (shift, turn)
            rests_on = path[came[-1] :]
        elif not elsewhere(shift, turn, settings):
            return None
        else:
            kind, rests_on = ChangeKind.MOVED, path
    from_s, to_s = zip(*((one.change.stamp_from_s, one.change.stamp_to_s) for one in rests_on), strict=True)
    return MapChange(
        landmark_ids=names,
        kind=kind,
        stamp_from_s=float(np.min(from_s)),
        stamp_to_s=float(np.max(to_s)),
        displacement_m=tuple(shift.tolist()),
        rotation_rad=turn,
        probability=float(np.prod([one.change.probability for one in rests_on])),
        n_hits=sum(one.change.n_hits for one in rests_on),
        n_misses=sum(one.change.n_misses for one in rests_on),
    )


def _shift(path: Sequence[Told], names: tuple[int, ...], a: LivingMap, b: LivingMap) -> tuple[FloatArray, float]:
    """Return translation and rotation between the places in two maps; as reported where these are unknown."""
    was, now = (_poses(living, np.array(names), _dim(a, b)) for living in (a, b))
    both = np.isfinite(was[:, 0]) & np.isfinite(now[:, 0])
    if both.any():
        (was_m, was_turned), (now_m, now_turned) = (np.split(at[both], [_dim(a, b)], axis=1) for at in (was, now))
        return motion_of(was_m, now_m, (was_turned, now_turned) if was_turned.size else None)
    told = [np.multiply(one.change.displacement_m, -1.0 if one.undone else 1.0) for one in path if not one.goes]
    return np.asarray(np.sum(told, axis=0)), sum(one.change.rotation_rad for one in path)


def _poses(living: LivingMap, names: IntArray, dim: int) -> FloatArray:
    """(K, 2) where landmarks are said to stand, else where they were most probably; in space (K, 7), with orientations.

    What the map does not know is nan.
    """
    pose = np.full((len(names), dim + TURNS[dim]), np.nan)
    _, row, at = np.intersect1d(names, living.members.landmark_id, return_indices=True)
    told, best = living.told_site()[at], living.site_of()[at]
    place = living.place_row(names[row], np.where(told == UNKNOWN, best, told))
    row, place = row[place >= 0], place[place >= 0]
    if len(row):
        pose[row] = np.hstack([living.places.position_m[place], living.places.rotation[place]])
    return pose


def _dim(a: LivingMap, b: LivingMap) -> int:
    """Coordinates of a position in two maps of one place; an empty one does not know."""
    return max(a.dim, b.dim)


def _standing(living: LivingMap) -> set[int]:
    return set(living.members.landmark_id[living.told_site() != UNKNOWN].tolist())


def _possible(kind: ChangeKind, before: bool, after: bool) -> bool:
    """Return whether a change is consistent with presence in the maps before and after it."""
    return (before, after) == (kind not in COMES, kind is not ChangeKind.VANISHED)
