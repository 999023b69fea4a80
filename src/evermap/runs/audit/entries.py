"""What all drives together say of an entry: where it stood, where it is, and whether that is decided."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from evermap.geometry import se3
from evermap.runs.audit.drives import NEAR_M, SAME_PLACE, UNREPORTED, HeardDrive, Word
from evermap.runs.audit.result import AuditEntry, EntryState
from evermap.types import FloatArray, Landmarks, landmark_label

DECIDED = 0.9
"""Probability from which an entry is called wrong, and its complement below which it is called right."""
P_MOVED = 0.03
"""Prior probability that an entry is wrong, or moves between two drives; that of `slam.space.map.p_moved`."""
MOST = 0.999
"""Greatest probability: drives by one robot share errors that no chain of independent ones knows."""
FEWEST = 3
"""Sightings from which it is said of an entry that it is right."""
ELSEWHERE = 0.3
"""Share of the readings of a number that fit no place of its landmark, from which this is told: it may be on two."""
SIGNIFICANT = 11.3
"""Squared distance, in sigmas, from which a position or a turn is corrected: 99 % of three coordinates."""
NEAR_RAD = 0.03
"""Least tolerance of 'turned as another entry'; that of its place is `NEAR_M`."""
UNHEARD = "no drive judges single entries"
"""Reason of entries where no drive can be trusted, or the map as a whole is wrong."""


def judge_entry(given: Landmarks, row: int, heard: Sequence[HeardDrive]) -> AuditEntry:
    """Return what all drives say of an entry."""
    name, dim = int(given.landmark_id[row]), given.position_m.shape[1]
    nothing = np.full(dim, np.nan)
    sighted = [one for one in heard if name in one.words]
    blank = AuditEntry(
        name, landmark_label(name, given.names), EntryState.UNSEEN, math.nan, nothing, math.nan, math.nan, math.nan,
        math.nan, math.nan, 0, sum(one.missed.get(name, 0) for one in heard), len(sighted),
        nothing, np.full((dim, dim), np.nan),
    )  # fmt: skip
    if not sighted:
        return _never_seen(blank, given, row, heard)
    words = [one.words[name] for one in sighted]
    p_wrong, since = join_drives([word.p_moved for word in words])
    late = words[since:]
    used = late if p_wrong > 0.5 else words[-1:]
    place = _place(used)
    entry = _with_place(blank, given, row, place)
    entry = replace(entry, probability=p_wrong, n_hits=sum(word.n_hits for word in words))
    change = words[since].change
    within = change is not None and math.isfinite(change.stamp_from_s)
    if p_wrong <= 1.0 - DECIDED:
        few = entry.n_hits < FEWEST
        reason = f"seen {entry.n_hits} time{'s' if entry.n_hits > 1 else ''}; {FEWEST} sightings decide" if few else ""
        read = sum(one.read.get(name, 0) for one in sighted)
        if not few and read - entry.n_hits >= max(FEWEST, ELSEWHERE * read):
            reason = f"{read - entry.n_hits} of {read} readings of its number are of something elsewhere"
        return replace(entry, state=EntryState.UNDECIDED if few else EntryState.RIGHT, reason=reason)
    if within and change is not None:
        entry = replace(entry, from_s=change.stamp_from_s, to_s=change.stamp_to_s)
    else:
        entry = replace(entry, from_s=words[since - 1].last_s if since else math.nan, to_s=words[since].first_s)
    if p_wrong < DECIDED:
        return replace(entry, state=EntryState.UNDECIDED, reason=_doubt(name, words, sighted))
    disagree = [one.drive.name for one, word in zip(sighted[since:], late, strict=True) if word.p_moved < 0.5]
    if disagree:
        where = ", ".join(disagree)
        reason = f"elsewhere in one drive, and where the map has it in {where}; another drive decides"
        return replace(entry, state=EntryState.UNDECIDED, reason=reason)
    hits, read = sum(word.n_hits for word in late), sum(one.read.get(name, 0) for one in sighted[since:])
    if hits < FEWEST or (not within and 2 * hits < read):  # the one that fits may be the wrong one
        reason = f"seen {hits} times at its place, of {read} readings of its number; more sightings decide"
        return replace(entry, state=EntryState.UNDECIDED, reason=reason)
    state = EntryState.STALE if since or within else EntryState.WRONG
    moved, turned = _what_to_correct(entry, given, row)
    return replace(entry, state=state, moved=moved, turned=turned)


def join_drives(p_moved: Sequence[float]) -> tuple[float, int]:
    """Return the probability that an entry is elsewhere at the last of some drives, and the first of them in which it
    most probably was, by what each says alone with the prior `P_MOVED`.

    An entry stands until some drive, with the same prior before each, and is elsewhere from then on.
    """
    p = np.clip(np.asarray(p_moved, dtype=np.float64), UNREPORTED / 10.0, 1.0 - 1e-6)
    odds = np.log(p / (1.0 - p)) - math.log(P_MOVED / (1.0 - P_MOVED))
    since = np.cumsum(odds[::-1])[::-1] + math.log(P_MOVED / (1.0 - P_MOVED))
    weight = np.exp(since - np.logaddexp(0.0, np.logaddexp.reduce(since)))
    return float(np.clip(weight.sum(), 1.0 - MOST, MOST)), int(np.argmax(weight))


def _doubt(name: int, words: Sequence[Word], sighted: Sequence[HeardDrive]) -> str:
    """Why a move is neither certain nor ruled out, and what decides it."""
    word = max(words, key=lambda one: one.p_moved)
    change = word.change
    if change is not None and len(change.landmark_ids) > 1:
        others = ", ".join(label for label, one in zip(change.labels, change.landmark_ids, strict=True) if one != name)
        why = f"it, with {others}, may have moved, or the others have"
        return f"{word.instead or why}; a drive that sees both from one place decides"
    if word.n_hits < FEWEST:
        return f"seen {word.n_hits} times only; more sightings, from another side, decide"
    if len(sighted) == 1:
        return "one drive does not tell; another one, past it from another side, decides"
    return "the drives differ; another one, past it from another side, decides"


def _place(words: Sequence[Word]) -> Word:
    """The last place of a landmark: the mean of the drives from the last one back that saw it at one place."""
    last = words[-1]
    same = [last]
    for word in words[-2::-1]:
        off = word.position_m - last.position_m
        if (
            off @ np.linalg.solve(word.covariance_m2 + last.covariance_m2 + NEAR_M**2 * np.eye(len(off)), off)
            > SAME_PLACE
        ):
            break
        same.append(word)
    if len(same) == 1:
        return last
    weights = [np.linalg.inv(word.covariance_m2 + 1e-8 * np.eye(len(last.position_m))) for word in same]
    covariance = np.linalg.inv(np.sum(weights, axis=0))
    position = covariance @ np.sum([w @ word.position_m for w, word in zip(weights, same, strict=True)], axis=0)
    apart = sum(float((o := word.position_m - position) @ w @ o) for w, word in zip(weights, same, strict=True))
    scale = max(1.0, apart / (len(position) * (len(same) - 1)))
    best = min(
        same, key=lambda word: math.inf if word.rotation_covariance is None else np.trace(word.rotation_covariance)
    )
    return replace(best, position_m=position, covariance_m2=scale * covariance)


def _with_place(entry: AuditEntry, given: Landmarks, row: int, place: Word) -> AuditEntry:
    """The entry with where it is, and how far that is from where the map has it."""
    dim = given.position_m.shape[1]
    at, spread = place.position_m[:dim], place.covariance_m2[:dim, :dim]
    turn = turn_sigma = math.nan
    known = None if given.rotation is None else given.rotation[row]
    if known is not None and np.isfinite(known).all() and place.rotation is not None:
        turn = float(np.linalg.norm(_turn(known, place.rotation)))
        if place.rotation_covariance is not None:
            turn_sigma = math.sqrt(max(float(np.trace(place.rotation_covariance)) / 3.0, 0.0))
    return replace(
        entry,
        displacement_m=at - given.position_m[row],
        sigma_m=math.sqrt(max(float(np.trace(spread)) / dim, 0.0)),
        turn_rad=turn,
        turn_sigma_rad=turn_sigma,
        position_m=at,
        covariance_m2=spread,
        rotation=place.rotation,
        rotation_covariance=place.rotation_covariance,
    )


def _turn(before: FloatArray, after: FloatArray) -> FloatArray:
    """(3,) rotation vector between two quaternions."""
    poses = [np.concatenate([np.zeros(3), one]) for one in (before, after)]
    return np.asarray(se3.log(se3.between(*poses))[3:])


def _what_to_correct(entry: AuditEntry, given: Landmarks, row: int) -> tuple[bool, bool]:
    """Whether position and rotation differ from the map by more than both are uncertain; at least one does."""
    dim = given.position_m.shape[1]
    off = entry.displacement_m
    far = float(off @ np.linalg.solve(entry.covariance_m2 + given.covariance_m2[row] + 1e-8 * np.eye(dim), off))
    turned = _is_turned(entry, given, row, 1e-4, SIGNIFICANT)
    return far > SIGNIFICANT or not turned, turned


def _is_turned(entry: AuditEntry, given: Landmarks, row: int, least_rad: float, most: float) -> bool:
    """Whether an entry is turned otherwise than a row of the map by more than `most` squared sigmas."""
    if entry.rotation is None or entry.rotation_covariance is None or given.rotation is None:
        return False
    turn = _turn(given.rotation[row], entry.rotation)
    said = np.zeros((3, 3)) if given.rotation_covariance is None else given.rotation_covariance[row]
    spread = entry.rotation_covariance + said + least_rad**2 * np.eye(3)
    return bool(turn @ np.linalg.solve(spread, turn) > most)


def _never_seen(entry: AuditEntry, given: Landmarks, row: int, heard: Sequence[HeardDrive]) -> AuditEntry:
    """An entry that no drive that counts has seen: gone, or not looked for."""
    name = entry.landmark_id
    if not heard:
        return replace(entry, state=EntryState.UNDECIDED, reason=UNHEARD)
    missed = [one for one in heard if one.missed.get(name, 0)]
    p_gone = [one.p_gone.get(name, math.nan) for one in missed]
    sure = [p for p in p_gone if p >= DECIDED]
    stamp, read = missed[0].drive if missed else None, sum(one.read.get(name, 0) for one in heard)
    if read >= max(FEWEST, ELSEWHERE * entry.n_misses):  # it is there, wherever; fewer readings may be misread
        reason = f"its number was read {read} times, but at no one place: it may be on two landmarks"
        return replace(entry, state=EntryState.UNDECIDED, reason=reason)
    if sure and stamp is not None:
        p = min(float(1.0 - np.prod([1.0 - value for value in sure])), MOST)
        reason = f"{entry.n_misses} looks at its place found nothing; remove it, or look where it went"
        return replace(entry, state=EntryState.GONE, probability=p, to_s=stamp.from_s, reason=reason)
    if read:
        reason = "its number was read, but no reading fits a place; more sightings decide"
        return replace(entry, state=EntryState.UNDECIDED, reason=reason)
    if missed:
        p = max((value for value in p_gone if math.isfinite(value)), default=math.nan)
        state = EntryState.UNDECIDED if p > 0.5 else EntryState.UNSEEN
        reason = f"{entry.n_misses} looks found nothing, but it may be hidden; looks from more sides decide"
        return replace(entry, state=state, probability=p, reason=reason)
    paths = [one.drive.path_m for one in heard if len(one.drive.path_m)]
    if not paths:
        return entry
    nearest = min(float(np.linalg.norm(path - given.position_m[row], axis=1).min()) for path in paths)
    return replace(entry, reason=f"nobody looked at it: no drive came nearer than {nearest:.1f} m, or faced it")


def with_exchanges(entries: Sequence[AuditEntry], given: Landmarks) -> list[AuditEntry]:
    """Return the entries, those of which each stands where the map has the next, around to the first, as exchanged.

    One of them is wrong for certain. Of another, few of whose readings fit its place, that decides: at the place that
    the map has of it something else stands.
    """
    sure = {entry.landmark_id for entry in entries if entry.state in (EntryState.WRONG, EntryState.STALE)}
    few = {entry.landmark_id for entry in entries if _is_elsewhere(entry)}
    wrong = {entry.landmark_id: entry for entry in entries if entry.landmark_id in sure | few}
    at = {name: k for k, name in enumerate(given.landmark_id.tolist())}
    stands_at = {name: _whose_place(entry, [at[other] for other in wrong if other != name], given)
                 for name, entry in wrong.items()}  # fmt: skip
    like = dict[int, int]()
    for name in wrong:
        ring = [name]
        while (after := stands_at[ring[-1]]) not in (-1, name) and after not in ring:
            ring.append(after)
        if stands_at[ring[-1]] == name and len(ring) > 1 and not sure.isdisjoint(ring):
            like[name] = stands_at[name]
    labels = {entry.landmark_id: entry.label for entry in entries}
    return [
        replace(
            entry,
            state=EntryState.EXCHANGED,
            like_id=like[entry.landmark_id],
            reason=f"it stands where the map has {labels[like[entry.landmark_id]]}",
        )
        if entry.landmark_id in like
        else entry
        for entry in entries
    ]


def _is_elsewhere(entry: AuditEntry) -> bool:
    """Return whether an entry that is not decided was seen somewhere else, often enough to say where."""
    return entry.state is EntryState.UNDECIDED and entry.probability >= DECIDED and entry.n_hits >= FEWEST


def _whose_place(entry: AuditEntry, rows: Sequence[int], given: Landmarks) -> int:
    """The entry at whose place in the map another one stands, -1 for none."""
    dim, best, found = given.position_m.shape[1], SAME_PLACE, -1
    for row in rows:
        off = entry.position_m - given.position_m[row]
        spread = entry.covariance_m2 + given.covariance_m2[row] + NEAR_M**2 * np.eye(dim)
        far = float(off @ np.linalg.solve(spread, off))
        if far < best and not _is_turned(entry, given, row, NEAR_RAD, SAME_PLACE):
            best, found = far, int(given.landmark_id[row])
    return found


def find_missing(given: Landmarks, heard: Sequence[HeardDrive]) -> list[AuditEntry]:
    """Return landmarks that were seen often enough and are not in the map."""
    known, dim = set(given.landmark_id.tolist()), given.position_m.shape[1]
    names = {**given.names, **{key: label for one in heard for key, label in one.names.items()}}
    words = dict[int, list[Word]]()
    for one in heard:
        for name, word in one.words.items():
            if name not in known:
                words.setdefault(name, []).append(word)
    found = []
    for name, said in words.items():
        hits = sum(word.n_hits for word in said)
        p_there = min(1.0 - math.prod(1.0 - word.p_exists for word in said), MOST)
        if hits < FEWEST or p_there < DECIDED:
            continue
        place, label = _place(said), landmark_label(name, names)
        spread = place.covariance_m2[:dim, :dim]
        twin = label.partition("#")[0] if "#" in label else ""
        reason = f"a second landmark with the number {twin}" if twin else "not in the map"
        found.append(
            AuditEntry(
                name, label, EntryState.MISSING, p_there, np.full(dim, np.nan),
                math.sqrt(max(float(np.trace(spread)) / dim, 0.0)), math.nan, math.nan, math.nan, said[0].first_s,
                hits, 0, len(said), place.position_m[:dim], spread, place.rotation, place.rotation_covariance,
                reason=reason,
            )
        )  # fmt: skip
    return found
