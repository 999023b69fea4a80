"""The evidence for and against the existence of a landmark: its looks, their times and their weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evermap.errors import InputError, similar
from evermap.existence.sites import Evidence
from evermap.maps.diff import edits, renames, story_of
from evermap.maps.living import EXISTS, LivingMap, Stays
from evermap.maps.store.content import DamagedError
from evermap.maps.store.measured import LOOKS, read_looks
from evermap.maps.store.protocol import DamagedMapError, MapStore, Revision, RevisionKind
from evermap.show import Shown
from evermap.survival.durations import duration_text
from evermap.types import UNKNOWN, Clock, MapChange, stamp_text


@dataclass(frozen=True, slots=True)
class Visit:
    """Evidence of one session on a landmark's clique.

    Attributes:
        revision, recording, robot: which session, and whose.
        from_s, to_s: first and last look.
        n_looks: frames in which a place of it was looked at.
        n_hits, n_misses, expected: detections, misses, and the hits that were to be expected had it stood there.
        log_odds: what the looks said for 'it stands there' [nats].
        p_exists: after the last of them.
    """

    revision: int
    recording: str
    robot: str
    from_s: float
    to_s: float
    n_looks: int
    n_hits: int
    n_misses: int
    expected: float
    log_odds: float
    p_exists: float


@dataclass(frozen=True, slots=True)
class Answer(Shown):
    """Belief in one landmark, with all its evidence.

    Attributes:
        landmark_id, label, class_name: which, and what it is called; '' where the class is not known.
        clique_id, companions: the body it belongs to, and the other landmarks on that.
        clock, stamp_s: of all stamps, and until when the map has seen anything.
        p_exists: now.
        pinned, deleted: what an operator said.
        visits: by time.
        stays: of its clique, as the map has them now.
        changes: that its sessions tell of it, in the order of the world: revision and change.
        edits: of operators: revision, when, and what.
        evidence: every look at it.
        headline: the answer in a line.
        reasons: what that rests on, a sentence each.
    """

    landmark_id: int
    label: str
    class_name: str
    clique_id: int
    companions: tuple[int, ...]
    clock: Clock
    stamp_s: float
    p_exists: float
    pinned: bool
    deleted: bool
    visits: tuple[Visit, ...]
    stays: Stays
    changes: tuple[tuple[int, MapChange], ...]
    edits: tuple[tuple[int, str, str], ...]
    evidence: Evidence
    headline: str
    reasons: tuple[str, ...]

    def _facts(self) -> dict[str, Any]:
        reasons = {f"reason {k}": reason for k, reason in enumerate(self.reasons, start=1)}
        return {"landmark": self.label, "p_exists": self.p_exists, "headline": self.headline, **reasons}


def why(store: MapStore, landmark: int | str, revision: int | None = None) -> Answer:
    """Return the answer for a landmark, in the newest revision or in another.

    Args:
        store: the map.
        landmark: its id, or what it is called.
        revision: None for the newest.

    Raises:
        InputError: the map does not know the landmark, or there is no such revision.
    """
    living = store.load(revision)
    landmark_id = living.landmark_called(str(landmark))
    found = np.flatnonzero(living.members.landmark_id == landmark_id)
    if not len(found):
        raise InputError(_unknown(living, str(landmark)), path=store.where, hint=f"evermap map show {store.where}")
    row = int(found[0])
    clique = int(living.members.clique_id[row])
    on_it = living.members.landmark_id[living.members.clique_id == clique]
    line = store.lineage(revision)
    log = {item.number: item for item in store.log()}
    parts = [part for part in _looks_by_session(store, line, landmark_id).items() if len(part[1])]
    parts.sort(key=lambda part: float(part[1].stamp_s[0]))
    evidence = Evidence.empty().joined(*(part for _, part in parts))
    evidence = evidence[np.argsort(evidence.stamp_s, kind="stable")]
    visits = tuple(_visit(log[number], part) for number, part in parts)
    changes = tuple(
        (one.revision, change.named(living.landmark_names))
        for one in story_of(store, revision)
        for change in one.changes
        if landmark_id in change.landmark_ids
    )
    class_id = int(living.members.class_id[row])
    answer = Answer(
        landmark_id=landmark_id,
        label=living.label(landmark_id),
        class_name=living.class_names[class_id] if 0 <= class_id < len(living.class_names) else "",
        clique_id=clique,
        companions=tuple(int(name) for name in on_it if name != landmark_id),
        clock=living.clock,
        stamp_s=living.stamp_s,
        p_exists=float(living.p_exists()[row]),
        pinned=bool(living.members.pinned[row]),
        deleted=bool(living.members.deleted[row]),
        visits=visits,
        stays=living.stays[living.stays.clique_id == clique],
        changes=changes,
        edits=_edits(store, [log[number] for number in line], landmark_id),
        evidence=evidence,
        headline="",
        reasons=(),
    )
    return _with_words(answer, living)


def _looks_by_session(store: MapStore, line: Sequence[int], landmark_id: int) -> dict[int, Evidence]:
    """Return the looks at a landmark's clique by the revisions of their sessions, as the newest revision counts them:
    where a late session came in, those of it and of all after it are weighed with it in the map.

    Raises:
        DamagedMapError: they are not what was written.
    """
    late = {item.revision: item for item in store.attachments(line) if item.name == LOOKS}
    found = store.evidence_by_revision(landmark_id=landmark_id, revisions=[*line])
    for number in sorted(late):
        try:
            found |= read_looks(store.attached(late[number]), number, landmark_id)
        except DamagedError as error:
            raise DamagedMapError(str(error), path=store.where) from None
    return found


def _visit(revision: Revision, seen: Evidence) -> Visit:
    return Visit(
        revision=revision.number,
        recording=revision.provenance.recording,
        robot=revision.provenance.robot,
        from_s=float(seen.stamp_s[0]),
        to_s=float(seen.stamp_s[-1]),
        n_looks=len(seen),
        n_hits=int(seen.n_hits.sum()),
        n_misses=int(seen.n_misses.sum()),
        expected=float(seen.expected.sum()),
        log_odds=float(seen.log_odds.sum()),
        p_exists=float(seen.p_exists[-1]),
    )


def _edits(store: MapStore, line: list[Revision], landmark_id: int) -> tuple[tuple[int, str, str], ...]:
    """Return the operators' edits of a landmark: revision, time, edit."""
    found = []
    for item in line:
        if item.provenance.kind is RevisionKind.EDIT:
            words = edits(store.members(item.parent), store.members(item.number))
            if not words:  # only then it may be a name, for which both maps are read
                words = renames(store.load(item.parent), store.load(item.number))
            found += [(item.number, item.created_at, word) for name, word in words if name == landmark_id]
    return tuple(found)


def _put(word: str) -> str:
    """An edit with its landmark: 'pinned it', 'renamed it from chair 5'."""
    verb, *rest = word.split(" ", 1)
    return " ".join([verb, "it", *rest])


def _with_words(answer: Answer, living: LivingMap) -> Answer:
    """Return the same with its headline and reasons."""
    said = answer.label.startswith(answer.class_name)
    kind = "" if said else f" ({answer.class_name})"
    what = f"landmark {answer.label}{kind}"
    belief = f"P(exists) {_belief(answer.p_exists)}"
    if answer.deleted:
        headline = f"{what} is not used: an operator deleted it; by its looks, {belief}"
    elif answer.p_exists >= EXISTS:
        headline = f"{what} is believed to be there: {belief}"
    else:
        headline = f"{what} is believed gone: {belief}"
    reasons = [f"an operator {_put(word)} in revision {number} ({when})" for number, when, word in answer.edits]
    reasons += _on_sightings(answer, living)
    if answer.companions:
        others = ", ".join(map(living.label, answer.companions))
        word = "landmarks" if len(answer.companions) > 1 else "landmark"
        reasons.append(f"it shares a body with {word} {others}: hits and misses of all of them count")
    if answer.pinned:
        reasons.append("it is pinned: it is never removed from the map")
    reasons += _on_learning(answer, living)
    return replace(answer, headline=headline, reasons=tuple(reasons))


def _on_sightings(answer: Answer, living: LivingMap) -> list[str]:
    """When it was seen last, and what the looks since then and the passing of time say."""
    seen, clock = answer.evidence, answer.clock
    if not len(seen):
        return ["no session in this map's history looked at it"]
    hits = np.flatnonzero(seen.n_hits > 0)
    if not len(hits):
        return [f"it was never detected at its expected place, in {_looks(seen)}"]
    last = int(hits[-1])
    last_s, p_then = float(seen.stamp_s[last]), float(seen.p_exists[last])
    reasons = [f"it was last detected {_when(last_s, clock)}; then P(exists) {_belief(p_then)}"]
    after = seen[np.arange(len(seen)) > last]
    newest = answer.visits[-1]
    if newest.n_hits and (answer.p_exists >= EXISTS or not len(after)):
        reasons.append(
            f"in its newest session it was detected {newest.n_hits} times, where {newest.expected:.1f} detections were "
            f"expected; {newest.n_misses} misses are explained by range, field of view and occlusions"
        )
        if answer.p_exists >= EXISTS:
            return reasons
    if len(after):
        said = float(after.log_odds.sum())
        reasons.append(
            f"since then it was looked for in {_looks(after)}: {int(after.n_misses.sum())} misses and no detection, "
            f"where {after.expected.sum():.1f} detections would be expected if it were there; that is {abs(said):.1f} "
            f"nats {'against' if said < 0 else 'for'} it"
        )
    else:
        reasons.append("there were no looks since; its age has made it improbable")
    return [*reasons, *_on_time(answer, living, last_s)]


def _on_time(answer: Answer, living: LivingMap, last_s: float) -> list[str]:
    """Return a line on the lifetimes of its class."""
    row = np.flatnonzero(living.members.landmark_id == answer.landmark_id)
    place = living.place_row(living.members.landmark_id[row], living.site_of()[row])
    waited_s = living.stamp_s - last_s
    if place[0] < 0 or not (np.isfinite(waited_s) and waited_s > 0.0):
        return []
    life = living.lives.of(int(living.members.class_id[row[0]]), living.places.position_m[place[0]])
    at = answer.stays[answer.stays.first_s <= last_s]
    age_s = last_s - float(at.first_s[-1]) if len(at) else 0.0
    kind, seen_s = living.members.class_id[row[:1]], np.array([last_s])
    counted_s = float(living.lives.ages_s(kind, seen_s - age_s, seen_s)[0]) if living.lives.rhythm else age_s
    passed_s = float(living.lives.ages_s(kind, seen_s, np.array([living.stamp_s]))[0])
    stay = float(np.exp(life.stay.log_conditional_survival(counted_s, counted_s + passed_s)))
    known = f"learned from {life.n_stays} stays" if life.n_stays else "nothing was learned for its class yet"
    like = f"of its class, {stay:.0%} of those that have stayed for {duration_text(age_s)}"
    return [f"{like} stay for another {duration_text(waited_s)} ({known})"]


def _on_learning(answer: Answer, living: LivingMap) -> list[str]:
    """Return a line on which stays, and which statement of a user, taught how long it stays."""
    row = np.flatnonzero(living.members.landmark_id == answer.landmark_id)
    place = living.place_row(living.members.landmark_id[row], living.site_of()[row])
    class_id, lives = int(living.members.class_id[row[0]]), living.lives
    life = lives.of(class_id, living.places.position_m[place[0]] if place[0] >= 0 else None)
    taught = []
    if life.n_stays:
        name = f"class {answer.class_name}" if answer.class_name else "landmarks without a class"
        whole = lives.of(class_id)
        of = f"{life.n_stays} stays of {name}, {life.n_ended} of which ended"
        if life != whole:
            of += f", in its {lives.chunk_m:g} m of the floor, and {whole.n_stays}, {whole.n_ended}, on all of it"
        taught.append(of)
        others = np.setdiff1d(lives.class_id, [class_id, UNKNOWN])
        if len(others):
            taught.append(f"{len(others)} other class{'es' if len(others) > 1 else ''}, as far as classes are alike")
    said = lives.prior_of(class_id)
    if said is not None:
        taught.append(f"what a user stated, which is worth {said.n_stays} stays")
    lines = [f"how long it stays is known from {'; '.join(taught)}"] if taught else []
    return [*lines, *lives.describe_hours(living.clock, class_id)] if life.n_stays else lines


def _looks(seen: Evidence) -> str:
    return f"{len(seen)} frame{'s' if len(seen) != 1 else ''}"


def _when(stamp_s: float, clock: Clock) -> str:
    text = stamp_text(stamp_s, clock)
    return f"on {text}" if text.startswith(("day", "1", "2")) and " " in text else f"at {text}"


def _belief(p: float) -> str:
    """'= 0.97' or '> 0.9999'."""
    text = probability_text(p)
    return text if text[0] in "<>" else f"= {text}"


def probability_text(p: float) -> str:
    """Return '0.97', and more digits near 0 and 1, where they matter; never certain."""
    if 0.01 <= p <= 0.99:
        return f"{p:.2f}"
    low = min(p, 1.0 - p)
    return ("< 0.0001" if p < 0.5 else "> 0.9999") if low < 5e-5 else f"{p:.4f}"


def _unknown(living: LivingMap, name: str) -> str:
    names = living.members.landmark_id
    if not len(names):
        return f"no landmark {name}: the map is empty"
    number = living.landmark_called(name)
    if number >= 0:
        near = sorted(names[np.argsort(np.abs(names - number), kind="stable")[:3]].tolist())
        return f"no landmark {name}; the nearest ids are {', '.join(map(living.label, near))}"
    meant = similar(name, [*living.landmark_names.values()], cutoff=0.0)
    return f"no landmark {name!r}" + (f"; there is {meant}" if meant else "; all have numbers")
