"""The record of a revision: everything about it except its content, as one text.

Records, contents, configurations, evidence and attachments are all chunks, named by the SHA-256 of what is in them. A
record holds the names of its parts and that of its parent's record, so its own name is a checksum over the revision and
over all revisions before it.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import chain, islice
from typing import Any

from evermap.maps.store.content import Chunk, DamagedError, Fetch, json_object, name_of, parts_of, text_chunk, text_of
from evermap.maps.store.measured import CliqueLooks, read_index
from evermap.maps.store.protocol import Attachment, Provenance, Revision, RevisionKind
from evermap.types import ChangeKind, MapChange, or_nan

FORMAT, IN_SPACE = 1, 2
"""Of records; those with changes in space an older evermap cannot read."""
STORY = "story"
"""Name of the attachment of a late session: what it and the later ones tell with it in the map."""
_COUNT, _NUMBER = (int, type(None)), (float, int, type(None))
_TYPES: Mapping[str, type | tuple[type, ...]] = {
    "number": int, "parent": int, "restores": _COUNT, "created_at": str, "evermap_version": str,
    "kind": str, "recording": str, "source": str, "command": str, "seed": _COUNT,
    "stamp_from_s": _NUMBER, "stamp_to_s": _NUMBER, "wall_s": _NUMBER, "note": str, "robot": str,
    "n_landmarks": int, "n_existing": int, "n_grown": _COUNT, "n_cliques_ever": int, "n_sites_ever": int,
    "changes": list, "attachments": dict, "lost": dict,
}  # fmt: skip
"""Values of a record, and their types in JSON; null for nan."""
_SHOWN = 5
_OF_PROVENANCE, _OF_REVISION = ([item.name for item in fields(kind)] for kind in (Provenance, Revision))
_MAY_BE_NAN = ("stamp_from_s", "stamp_to_s", "wall_s")


@dataclass(frozen=True, slots=True)
class Chapter:
    """What a session tells in the order of the world.

    Attributes:
        revision: that its recording was committed with.
        start_s: when it began.
        changes: since the session before it.
        new: landmarks that the map did not know before it; None if nobody counted them.
        n_grown: those of them that stand, and that nobody saw appear; None as in `Revision`.
    """

    revision: int
    start_s: float
    changes: tuple[MapChange, ...]
    new: frozenset[int] | None = None
    n_grown: int | None = None


def pack_story(base: int, chapters: Sequence[Chapter]) -> bytes:
    """Return the bytes of the sessions after revision `base`; 0 is the revision of the one that they belong to."""
    rows = [
        [one.revision, one.start_s, [_change_to_list(change) for change in one.changes], sorted(one.new or ()),
         one.n_grown]
        for one in chapters
    ]  # fmt: skip
    every = [change for one in chapters for change in one.changes]
    return json.dumps({"base": base, "sessions": rows, **_spreads_of(every)}).encode()


def read_story(data: bytes, revision: int) -> tuple[int, tuple[Chapter, ...]]:
    """Read what `pack_story` wrote for a revision; `DamagedError` if it is anything else."""
    try:
        row = json_object(data.decode())
        read = [[*map(_change_from_list, told)] for _, _, told, _, _ in row["sessions"]]
        every = iter(_with_spreads([*chain(*read)], row))
        chapters = tuple(
            Chapter(number or revision, float(start_s), tuple(islice(every, len(told))), frozenset(new), n_grown)
            for number, start_s, told, new, n_grown in row["sessions"]
        )
        return int(row["base"]), chapters
    except (ValueError, TypeError, LookupError) as error:
        raise DamagedError(f"the story of revision {revision} is not valid: {error}") from None


@dataclass(frozen=True, slots=True)
class Record:
    """A revision as it is stored.

    Attributes:
        about: provenance and counts, as `Revision` tells them.
        parent: name of the record of the revision before; None for the first, and where that one was lost.
        content, config, evidence: names of chunks; `evidence` is None where nothing was looked at.
        changes: that the revision told.
        attachments: name of the chunk and number of bytes, by name of the attachment.
        next_ids: the next free ids of cliques and sites.
        lost: revisions that damage has destroyed before this one was made, with the name of the record before each.
    """

    about: Mapping[str, Any]
    parent: bytes | None
    content: bytes
    config: bytes
    evidence: bytes | None = None
    changes: tuple[MapChange, ...] = ()
    attachments: Mapping[str, tuple[bytes, int]] = field(default_factory=dict)
    next_ids: tuple[int, int] = (0, 0)
    lost: Mapping[int, bytes | None] = field(default_factory=dict)

    @property
    def number(self) -> int:
        """Of the revision."""
        return int(self.about["number"])

    @property
    def origin(self) -> int:
        """The revision whose map this one started from: its parent, or what it restored."""
        restores = self.about["restores"]
        return self.number - 1 if restores is None else int(restores)

    def looks(self, fetch: Fetch) -> list[CliqueLooks]:
        """Return where its looks are stored, by clique."""
        return [] if self.evidence is None else read_index(text_of(self.evidence, fetch))

    def chunks(self, fetch: Fetch, table: str = "") -> set[bytes]:
        """Return the names of all its chunks but its own; of its content, those of one table if that is named."""
        return {name for names in self.parts(fetch, table).values() for name in names}

    def parts(self, fetch: Fetch, table: str = "") -> dict[tuple[str, str | int], list[bytes]]:
        """Return the same by what they hold, which is alike in successive revisions."""
        found: dict[tuple[str, str | int], list[bytes]] = {
            ("content", column): names for column, names in parts_of(self.content, fetch, table).items()
        }
        found[("config", "")] = [self.config]
        for attachment, (name, _) in self.attachments.items():
            found[("attachment", attachment)] = [name]
        if self.evidence is not None:
            found[("evidence", "")] = [self.evidence]
            for row in self.looks(fetch):
                found.setdefault(("looks", row.clique_id), []).append(row.name)
        return found

    def attached(self) -> list[Attachment]:
        """Return its attachments."""
        return [
            Attachment(self.number, name, chunk.hex(), size) for name, (chunk, size) in sorted(self.attachments.items())
        ]

    def revision(self, config: str) -> Revision:
        """Return it as a `Revision` of the history."""
        row = {**self.about, "kind": RevisionKind(self.about["kind"]), "config": config}
        row |= {name: or_nan(row[name]) for name in _MAY_BE_NAN}
        provenance = Provenance(**{name: row[name] for name in _OF_PROVENANCE})
        told = {name: row[name] for name in _OF_REVISION if name in row}
        counts = dict(Counter(change.kind for change in self.changes))
        return Revision(provenance=provenance, n_changes=counts, **told)

    def chunk(self) -> Chunk:
        """Return as bytes."""
        return text_chunk(
            json.dumps(
                {
                    "evermap": "revision",
                    "format": IN_SPACE if any(len(one.displacement_m) > 2 for one in self.changes) else FORMAT,
                    **self.about,
                    "parent_record": _hex(self.parent),
                    "content": self.content.hex(),
                    "config": self.config.hex(),
                    "evidence": _hex(self.evidence),
                    "changes": [_change_to_list(change) for change in self.changes],
                    "attachments": {name: [chunk.hex(), size] for name, (chunk, size) in self.attachments.items()},
                    "n_cliques_ever": self.next_ids[0],
                    "n_sites_ever": self.next_ids[1],
                    "lost": {str(number): _hex(before) for number, before in self.lost.items()},
                    **_spreads_of(self.changes),
                }
            )
        )

    @classmethod
    def of_text(cls, text: str) -> Record:
        """Read what `chunk` wrote; `DamagedError` if it is anything else."""
        row = json_object(text)
        if row.get("evermap") != "revision":
            raise DamagedError("a part is not the record of a revision")
        if row.get("format") not in (FORMAT, IN_SPACE):
            raise DamagedError(f"a record of format {row.get('format')!r}, this evermap reads {FORMAT} and {IN_SPACE}")
        row = {"n_grown": None, "robot": "", **row}  # an older evermap did not tell them
        for name, kind in _TYPES.items():
            if name not in row or not isinstance(row[name], kind) or isinstance(row[name], bool):
                raise DamagedError(f"'{name}' of a revision is missing or of another type")
        number, restores = row["number"], row["restores"]
        if number < 1 or row["parent"] != number - 1 or (restores is not None and not 0 <= restores < number):
            raise DamagedError(
                f"revision {number} comes from revision {row['parent'] if restores is None else restores}"
            )
        try:
            RevisionKind(row["kind"])
            return cls(
                about={name: row[name] for name in _TYPES if name not in _PARTS},
                parent=_name_or_none(row.get("parent_record")),
                content=name_of(row.get("content")),
                config=name_of(row.get("config")),
                evidence=_name_or_none(row.get("evidence")),
                changes=_with_spreads([_change_from_list(change) for change in row["changes"]], row),
                attachments={name: (name_of(chunk), int(size)) for name, (chunk, size) in row["attachments"].items()},
                next_ids=(row["n_cliques_ever"], row["n_sites_ever"]),
                lost={int(number): _name_or_none(before) for number, before in row["lost"].items()},
            )
        except (ValueError, TypeError, OverflowError) as error:
            raise DamagedError(f"the record of revision {number} is not valid: {error}") from None


_PARTS = {"changes", "attachments", "lost", "n_cliques_ever", "n_sites_ever"}
"""Values of a record that are attributes of their own."""


def lineage(origin: Mapping[int, int], number: int) -> tuple[int, ...]:
    """Return the ancestors of a revision and itself, oldest first, without lost ones; 0 has none. The origin of each is
    the revision whose map it started from: its parent, or what it restored.
    """
    line = []
    while number > 0:
        if number in origin:
            line.append(number)
        number = origin.get(number, number - 1)
    return tuple(reversed(line))


def pruned_to_text(pruned: Mapping[int, str]) -> str | None:
    """Return which revisions are pruned, since when, as the row of `store` has it; None for none."""
    numbers: dict[str, list[int]] = {}
    for number, since in sorted(pruned.items()):
        numbers.setdefault(since, []).append(number)
    return json.dumps(numbers) if numbers else None


def read_pruned(text: str | None) -> dict[int, str]:
    """Read what `pruned_to_text` wrote; `DamagedError` if it is anything else."""
    try:
        numbers = {} if text is None else json_object(text)
        return {int(number): since for since, listed in numbers.items() for number in listed}
    except (ValueError, TypeError) as error:
        raise DamagedError(f"the list of pruned revisions is not valid: {error}") from None


def ranges(numbers: Iterable[int]) -> str:
    """Return '1 to 4, 6 and 9 to 12'; the middle of many is left out."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    words = [str(a) if a == b else f"{a} to {b}" if b > a + 1 else f"{a}, {b}" for a, b in runs]
    if len(words) > _SHOWN:
        words = [*words[:2], "...", *words[-2:]]
    return ", ".join(words[:-1]) + (" and " if len(words) > 1 else "") + "".join(words[-1:])


def about(provenance: Provenance, **counts: Any) -> dict[str, Any]:
    """Return the values of `Record.about`."""
    values = {item.name: getattr(provenance, item.name) for item in fields(Provenance) if item.name != "config"}
    values |= {name: _no_nan(values[name]) for name in _MAY_BE_NAN}
    return {**values, "kind": provenance.kind.value, **counts}


def _change_to_list(change: MapChange) -> list[Any]:
    numbers = (change.stamp_from_s, change.stamp_to_s, *change.displacement_m, change.rotation_rad, change.probability)
    counts = [int(change.n_hits), int(change.n_misses)]
    return [change.kind.value, [int(name) for name in change.landmark_ids], *map(_no_nan, numbers), *counts]


def _change_from_list(values: Iterable[Any]) -> MapChange:
    kind, names, *numbers = values
    from_s, to_s, *step_m, rotation_rad, probability, n_hits, n_misses = map(or_nan, numbers)
    if len(step_m) not in (2, 3):
        raise ValueError(f"a displacement of {len(step_m)} numbers")
    return MapChange(
        landmark_ids=tuple(int(name) for name in names),
        kind=ChangeKind(kind),
        stamp_from_s=from_s,
        stamp_to_s=to_s,
        displacement_m=tuple(step_m),
        rotation_rad=rotation_rad,
        probability=probability,
        n_hits=int(n_hits),
        n_misses=int(n_misses),
    )


def _spreads_of(changes: Sequence[MapChange]) -> dict[str, Any]:
    """Covariances of displacements beside the changes, where an older evermap does not look; {} without any."""
    spreads = [one.displacement_covariance_m2 for one in changes]
    return {"spreads": spreads} if any(spreads) else {}


def _with_spreads(changes: Sequence[MapChange], row: Mapping[str, Any]) -> tuple[MapChange, ...]:
    """Changes with what `_spreads_of` wrote of them."""
    spreads = row.get("spreads", [()] * len(changes))
    read = [tuple(tuple(float(number) for number in line) for line in spread) for spread in spreads]
    return tuple(replace(one, displacement_covariance_m2=spread) for one, spread in zip(changes, read, strict=True))


def _name_or_none(text: Any) -> bytes | None:
    return None if text is None else name_of(text)


def _hex(name: bytes | None) -> str | None:
    return None if name is None else name.hex()


def _no_nan(value: float) -> float | None:
    """Of JSON, which has no nan."""
    return None if math.isnan(value) else float(value)
