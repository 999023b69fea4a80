"""Differences between revisions of a map: the changes reported by its sessions, composed to their net effect.

Only sessions report changes (`sessions.decide`). A revision stands for an instant of the world: the beginning of the
newest session in it. What changed between two is what the sessions between these instants tell, by the revision that
knows more (`story_of`): with a late session in the map the later ones tell what they would have told had it come in
time, so the story does not depend on the order of uploads. From one session to the next the difference is the session's
report. Over several of them the changes of each landmark are composed: what left and came back to its place is no
difference, what moved twice moved once. Where the way leads back, through a revert or because that was asked for,
changes are undone.

A landmark that the earlier map did not know, and that nobody saw appear, has not changed: the map grew by it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain, takewhile
from typing import Any

import numpy as np

from evermap.config import DecisionConfig
from evermap.geometry import se3
from evermap.geometry.rigid import rigid
from evermap.maps.living import TURNS, LivingMap, Members
from evermap.maps.store.content import DamagedError
from evermap.maps.store.history import STORY, Chapter, read_story
from evermap.maps.store.protocol import Attachment, DamagedMapError, MapStore, Revision, RevisionKind
from evermap.show import Shown, data_frame
from evermap.types import UNKNOWN, ChangeKind, FloatArray, IntArray, MapChange

USUAL = DecisionConfig()
ToldBySession = tuple[Sequence[MapChange], bool]
"""Changes reported by a session, and whether they are inverted."""
COMES = frozenset({ChangeKind.APPEARED, ChangeKind.RETURNED})
MUTUAL = frozenset({ChangeKind.SWAPPED, ChangeKind.REPLACED})
"""Of two bodies, with the displacement of one."""


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
        edits: by operators: landmark and 'pinned', 'unpinned', 'deleted', 'undeleted' or 'renamed from ...'.
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
    told, new = collect_changes(store, a, b)
    changes = tuple(change.named(names) for change in net(told, before, after, new=new))
    more = grown(before.members.landmark_id, after, changes)
    said = sorted([*edits(before.members, after.members), *renames(before, after)])
    return Difference(a, b, changes, more, tuple(said))


def story_of(store: MapStore, revision: int | None = None) -> tuple[Chapter, ...]:
    """Return what each session of a revision tells, in the order of the world, with all of them in the map.

    Raises:
        DamagedMapError: a part is not what was written.
    """
    return _read_stories(store, [store.lineage(revision)])[0]


def _read_stories(store: MapStore, lines: Sequence[Sequence[int]]) -> list[tuple[Chapter, ...]]:
    """Return the stories of some lines of revisions, of all of which the log is read once."""
    late = {item.revision: item for item in store.attachments(sorted({*chain(*lines)})) if item.name == STORY}
    log = {item.number: item for item in store.log()}
    told: dict[int, list[MapChange]] = {}
    for number, change in store.changes_of():
        told.setdefault(number, []).append(change)
    return [_read_story(store, line, late, log, told) for line in lines]


def _read_story(
    store: MapStore,
    line: Sequence[int],
    late: Mapping[int, Attachment],
    log: Mapping[int, Revision],
    told: Mapping[int, Sequence[MapChange]],
) -> tuple[Chapter, ...]:
    chapters: list[Chapter] = []
    for number in line:
        if number in late:
            try:
                base, again = read_story(store.attached(late[number]), number)
            except DamagedError as error:
                raise DamagedMapError(str(error), path=store.where) from None
            kept = set(store.lineage(base))
            chapters = [*(one for one in chapters if one.revision in kept), *again]
        elif (item := log[number]).provenance.kind is RevisionKind.SESSION:
            changes = tuple(told.get(number, ()))
            chapters.append(Chapter(number, item.provenance.stamp_from_s, changes, n_grown=item.n_grown))
    return tuple(chapters)


def read_log(store: MapStore) -> tuple[Revision, ...]:
    """Return the revisions, with as many changes as their sessions tell by the newest one (`story_of`)."""
    log = store.log()
    if not any(item.name == STORY for item in store.attachments()):
        return log
    told = {one.revision: one for one in story_of(store)}
    return tuple(
        replace(
            item,
            n_changes=dict(Counter(change.kind for change in told[item.number].changes)),
            n_grown=told[item.number].n_grown,
        )
        if item.number in told
        else item
        for item in log
    )


def collect_changes(store: MapStore, a: int, b: int) -> tuple[list[ToldBySession], frozenset[int] | None]:
    """Return the changes between two revisions, and the landmarks that are new since the first, None where these are
    all that it does not know.

    Of two revisions of which one has all sessions of the other that one tells, between their instants. Where each has
    its own, those of `a` are undone back to what they have in common.
    """
    old, new = _read_stories(store, [store.lineage(a), store.lineage(b)])
    had, has = ({one.revision for one in story} for story in (old, new))
    if had <= has:
        since = _after(new, had)
        if all(one.new is None for one in new):  # no late session: the map of `a` is that of its instant
            return [(one.changes, False) for one in since], None
        found = [_new_in(store, one) if one.new is None else one.new for one in since]
        return [(one.changes, False) for one in since], frozenset[int]().union(*found)
    if has <= had:
        return [(one.changes[::-1], True) for one in reversed(_after(old, has))], None
    common = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(old, new, strict=False)))
    back = [(one.changes[::-1], True) for one in reversed(old[common:])]
    return [*back, *((one.changes, False) for one in new[common:])], None


def _after(story: Sequence[Chapter], had: Collection[int]) -> Sequence[Chapter]:
    """The sessions of a story after the instant of a revision that has some of them."""
    return story[max((k for k, one in enumerate(story, start=1) if one.revision in had), default=0) :]


def _new_in(store: MapStore, session: Chapter) -> frozenset[int]:
    """Landmarks that a session which was not late brought into the map."""
    number = session.revision
    after, before = store.members(number).landmark_id, store.members(number - 1).landmark_id
    return frozenset(np.setdiff1d(after, before).tolist())


def net(
    sessions: Sequence[ToldBySession],
    a: LivingMap,
    b: LivingMap,
    settings: DecisionConfig = USUAL,
    *,
    new: frozenset[int] | None = None,
) -> tuple[MapChange, ...]:
    """Return the net effect of successive reported changes.

    What one session told is returned as it is, and so is a change of landmarks of which no other is told. Of several
    the interval, the hits and the misses are those of all changes that the net effect rests on, and the probability is
    the product of theirs: of what vanished the last one, of what came the last coming and what followed, of what moved
    all. It moved by the sum of its moves, each of which is between two places in one map: two maps may differ in their
    frames.

    Args:
        sessions: the changes that each told, and whether they are undone.
        a: the map before them; its ids mean the same as those of `b`.
        b: the map after them.
        settings: what is the same place.
        new: landmarks that came into the map on the way; None for all that `a` does not know.
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
        is_known = name in known if new is None else name not in new
        groups.setdefault((tuple(numbers), is_known, *ends), []).append(name)
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
        change = _compose_changes(path, tuple(names), (a, b), settings)
        if change is not None and (forth or _possible(change.kind, before, after)):
            found.append(change)
    for change in (change for changes, _ in sessions for change in changes if change.kind is ChangeKind.REPLACED):
        both = parts[id(change)]
        if all(any(part is other for other in found) for part in both):  # nothing else is told of either
            found = [other for other in found if not any(other is part for part in both)] + [change]
    return with_swaps(found, b, settings) if len({one.session for one in told}) > 1 else tuple(found)


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
    stands = b.members.landmark_id[(b.find_current_site() != UNKNOWN) & ~b.members.deleted]
    return np.setdiff1d(stands, np.concatenate([known, np.array(told, dtype=np.int64)]))


def edits(a: Members, b: Members) -> tuple[tuple[int, str], ...]:
    """Return what operators said between two maps: landmark and 'pinned', 'unpinned', 'deleted' or 'undeleted'."""
    ids, row_a, row_b = np.intersect1d(a.landmark_id, b.landmark_id, return_indices=True)
    words = []
    for name, yes, no in (("pinned", "pinned", "unpinned"), ("deleted", "deleted", "undeleted")):
        before, after = getattr(a, name)[row_a], getattr(b, name)[row_b]
        words += [(int(ids[k]), yes if after[k] else no) for k in np.flatnonzero(before != after)]
    return tuple(sorted(words))


def renames(a: LivingMap, b: LivingMap) -> tuple[tuple[int, str], ...]:
    """Return which landmarks operators have renamed between two maps, and what they were called before."""
    named = dict(a.renamed.items()).items() ^ dict(b.renamed.items()).items()
    both = np.intersect1d(np.intersect1d(a.members.landmark_id, b.members.landmark_id), [one for one, _ in named])
    return tuple((int(one), f"renamed from {a.label(int(one))}") for one in both)


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


def with_swaps(found: Sequence[MapChange], after: LivingMap, settings: DecisionConfig = USUAL) -> tuple[MapChange, ...]:
    """Return changes in which two moves to each other's place are one exchange, or of identities.

    What moved was its displacement away from where it is in the map `after`.
    """
    moved = [k for k, change in enumerate(found) if change.kind is ChangeKind.MOVED]
    if len(moved) < 2:
        return tuple(found)
    now = after.landmarks()

    def at(names: tuple[int, ...]) -> FloatArray:
        rows = np.isin(now.landmark_id, names)
        return np.asarray(now.position_m[rows].mean(axis=0)) if rows.any() else np.full(after.dim, np.nan)

    is_at = {k: at(found[k].landmark_ids) for k in moved}
    was = {k: is_at[k] - np.asarray(found[k].displacement_m) for k in moved}
    swapped: dict[int, int] = {}
    for a in moved:
        for b in moved:
            if a < b and a not in swapped and b not in swapped:
                across = max(np.linalg.norm(is_at[a] - was[b]), np.linalg.norm(is_at[b] - was[a]))
                if across < settings.same_place_m:
                    swapped[a] = b
    partners = set(swapped.values())
    return tuple(
        _join_exchange(change, found[swapped[k]]) if k in swapped else change
        for k, change in enumerate(found)
        if k not in partners
    )


def _join_exchange(change: MapChange, other: MapChange) -> MapChange:
    """Combine two moves into one exchange; the displacement is that of the first."""
    return replace(
        change,
        kind=ChangeKind.SWAPPED,
        landmark_ids=tuple(sorted((*change.landmark_ids, *other.landmark_ids))),
        probability=min(change.probability, other.probability),
        n_hits=change.n_hits + other.n_hits,
        n_misses=change.n_misses + other.n_misses,
    )


def _compose_changes(
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
    moved = () if goes or kind is ChangeKind.APPEARED else _spread(path, shift, maps[1].log_size_variance)
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
        displacement_covariance_m2=moved,
    )


def _spread(path: Sequence[Told], shift: FloatArray, log_size_variance: float) -> tuple[tuple[float, ...], ...]:
    """Covariance of what the steps add up to: the sum of theirs, but that the map's metre is one for all; () where one
    of them is not known.
    """
    steps = [one.change for one in path if np.isfinite(one.change.displacement_m).all()]
    if not steps or not all(one.displacement_covariance_m2 for one in steps):
        return ()
    each = sum(
        np.array(one.displacement_covariance_m2) - log_size_variance * np.outer(one.displacement_m, one.displacement_m)
        for one in steps
    )
    return tuple(map(tuple, (each + log_size_variance * np.outer(shift, shift)).tolist()))


def _shift(path: Sequence[Told], names: tuple[int, ...], a: LivingMap, b: LivingMap) -> tuple[FloatArray, float]:
    """Return translation and rotation over all steps as reported; where one of them is an exchange, or is undone,
    between the places in the two maps.
    """
    steps = [one for one in path if not one.goes and one.change.kind is not ChangeKind.APPEARED]
    if not any(one.undone or one.change.kind in MUTUAL for one in path):
        shift = np.sum([one.change.displacement_m for one in steps], axis=0)
        if np.shape(shift) and np.isfinite(shift).all() and _dim(a, b) < 3:  # turns in space do not add
            return np.asarray(shift), sum(one.change.rotation_rad for one in steps)
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
    told, best = living.find_current_site()[at], living.site_of()[at]
    place = living.place_row(names[row], np.where(told == UNKNOWN, best, told))
    row, place = row[place >= 0], place[place >= 0]
    if len(row):
        pose[row] = np.hstack([living.places.position_m[place], living.places.rotation[place]])
    return pose


def _dim(a: LivingMap, b: LivingMap) -> int:
    """Coordinates of a position in two maps of one place; an empty one does not know."""
    return max(a.dim, b.dim)


def _standing(living: LivingMap) -> set[int]:
    return set(living.members.landmark_id[living.find_current_site() != UNKNOWN].tolist())


def _possible(kind: ChangeKind, before: bool, after: bool) -> bool:
    """Return whether a change is consistent with presence in the maps before and after it."""
    return (before, after) == (kind not in COMES, kind is not ChangeKind.VANISHED)
