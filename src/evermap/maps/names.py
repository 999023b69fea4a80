"""What the landmarks of a map are called: the one place that gives names to people.

A landmark that was given an identity, a number or a text, is called by that. One that the map named by itself has a
text of its class, its number in its first session, and when that began: 'chair-53@1704105328.074' is the same whoever
enters first, and nobody can say it. Its name is its class and a code of this text, 'chair K381': it depends neither on
the order of entry nor on what else is in the map, but that of two with one code the younger has a digit more. An
operator may call a landmark otherwise; what it was called before still finds it.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import count

import numpy as np

from evermap.errors import InputError, printable
from evermap.types import CODE_DIGITS, IntArray, landmark_code, landmark_id_of

NAMELESS = "landmark"
"""Class in the texts of landmarks of which nothing is known."""
MOST = 60
"""Characters of a name that an operator gives."""
_ANONYMOUS = re.compile(r"(?P<kind>.+)-(?P<number>\d+)@(?P<start>-?\d+(?:\.\d+)?)(?:#\d+)?")


@dataclass(frozen=True, slots=True)
class Renamed:
    """Names that operators gave: (R,) rows, sorted by `landmark_id`.

    Attributes:
        landmark_id: which landmark.
        name: what it is called.
    """

    landmark_id: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    name: tuple[str, ...] = ()

    @classmethod
    def of(cls, names: Mapping[int, str]) -> Renamed:
        """Return those of a mapping."""
        ids = sorted(names)
        return cls(np.array(ids, dtype=np.int64), tuple(names[one] for one in ids))

    @classmethod
    def of_file(cls, names: Mapping[int, str]) -> Renamed:
        """Return those of a file's landmarks that an operator could have given: of no two, and no number."""
        times = Counter(names.values())
        return cls.of({one: name for one, name in names.items() if times[name] == 1 and not _flaw(name)})

    def items(self) -> Iterator[tuple[int, str]]:
        """Iterate over ids and names."""
        return zip(self.landmark_id.tolist(), self.name, strict=True)


def anonymous_text(kind: str, number: int, start_s: float) -> str:
    """Return the identity of a landmark that nobody named: its class, its number in its session, when that began."""
    start = f"{start_s:.3f}".rstrip("0").rstrip(".")
    return f"{kind or NAMELESS}-{number}@{start}"


def is_anonymous(text: str) -> bool:
    """Return whether a landmark's identity is one of `anonymous_text`."""
    return _ANONYMOUS.fullmatch(text) is not None


def distinct_text(text: str, taken: Collection[str]) -> str:
    """Return a text, or with '#2', '#3' ... the first that is not taken: two robots may begin in one instant."""
    every = (f"{text}#{number}" for number in count(2))
    return text if text not in taken else next(one for one in every if one not in taken)


def name_landmarks(texts: tuple[str, ...], renamed: Renamed) -> Mapping[int, str]:
    """Return what landmarks are called that have a name, by their ids.

    Args:
        texts: identities of landmarks that are no numbers.
        renamed: by operators.
    """
    return _names(texts, tuple(renamed.items()))


@lru_cache(maxsize=16)
def _names(texts: tuple[str, ...], renamed: tuple[tuple[int, str], ...]) -> Mapping[int, str]:
    return {**_short_names(texts), **dict(renamed)}


@lru_cache(maxsize=16)
def _short_names(texts: tuple[str, ...]) -> Mapping[int, str]:
    found, anonymous = dict[int, str](), list[tuple[float, str, str]]()
    for text in texts:
        if match := _ANONYMOUS.fullmatch(text):
            anonymous.append((float(match["start"]), text, match["kind"]))
        else:
            found[landmark_id_of(text)] = text
    taken = set(found.values())
    for _, text, kind in sorted(anonymous):
        identity, before = landmark_id_of(text), "" if kind == NAMELESS else f"{kind} "
        codes = (before + landmark_code(identity, digits) for digits in range(3, CODE_DIGITS + 1))
        name = next((code for code in codes if code not in taken), text)
        taken.add(name)
        found[identity] = name
    return found


def landmark_with(name: str, texts: tuple[str, ...], renamed: Renamed) -> int | None:
    """Return the id of the landmark that has, or had, this name or text; None for none."""
    for names in (dict(renamed.items()), _short_names(texts)):
        found = next((one for one, other in names.items() if other == name), None)
        if found is not None:
            return found
    return landmark_id_of(name) if name in texts else None


def rename(renamed: Renamed, landmark_id: int, name: str, texts: tuple[str, ...], numbers: Iterable[int]) -> Renamed:
    """Return the names after an operator calls a landmark otherwise; '' takes his name back.

    Args:
        renamed: the names until then.
        landmark_id: which landmark.
        name: the new name.
        texts: identities of landmarks that are no numbers.
        numbers: all identities.

    Raises:
        InputError: not a name: too long, not printable, a number, or that of another landmark.
    """
    name = " ".join(name.split())
    kept = {one: other for one, other in renamed.items() if one != landmark_id}
    if not name or name == _short_names(texts).get(landmark_id, str(landmark_id)):
        return Renamed.of(kept)
    hint = "another name"
    if problem := _flaw(name):
        raise InputError(problem, field="name", hint=hint)
    owner = landmark_with(name, texts, Renamed.of(kept))
    if owner is None:
        owner = next((one for one in numbers if landmark_code(one) == name), None)
    if owner not in (None, landmark_id):
        raise InputError(f"another landmark is called '{name}' already", field="name", hint=hint)
    return Renamed.of({**kept, landmark_id: name})


def _flaw(name: str) -> str:
    """Return why a text is not a name; '' if it is one."""
    if not name.strip() or len(name) > MOST or printable(name) != name:
        return f"'{printable(name, MOST)}' is not a name: up to {MOST} characters that can be printed"
    return f"'{name}' would be taken for the number of a landmark" if name.isdecimal() else ""
