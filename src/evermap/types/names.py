"""Ids of landmarks, and the words that a person says for them."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from functools import lru_cache
from hashlib import blake2b


@lru_cache(maxsize=2**14)
def landmark_id_of(name: str) -> int:
    """Return the identity of a landmark that is called by a text, the same on every machine and in every session.

    52 bits of a hash (BLAKE2b of the text in UTF-8, normal form C), above all ids that people count with and below
    2^53, so that it passes through float64 and JSON unharmed. Two of 100,000 names meet with probability 1e-6.
    """
    text = unicodedata.normalize("NFC", name.strip()).encode()
    return _TEXT_IDS + int.from_bytes(blake2b(text, digest_size=8).digest(), "big") % _TEXT_IDS


_TEXT_IDS = 2**52
_LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ"  # no I and O, which are read as 1 and 0
CODE_DIGITS = 12
"""Of a whole `landmark_code`."""


def landmark_code(landmark_id: int, digits: int = 3) -> str:
    """Return a letter and digits, as 'K381', for an identity that nobody can say; the same wherever it is asked.

    More digits, up to `CODE_DIGITS`, go on from fewer. Multiplicative hashing (Knuth 1973, 6.4) of 64 bits.
    """
    number = (landmark_id * 0x9E3779B97F4A7C15) % 2**64 >> 16
    rest, letter = divmod(number, len(_LETTERS))
    return _LETTERS[letter] + f"{rest:0{CODE_DIGITS}d}"[-CODE_DIGITS:][:digits]


def landmark_label(landmark_id: int, names: Mapping[int, str]) -> str:
    """Return what a person calls a landmark: its name, else the number that its user gave it, else its code."""
    name = names.get(landmark_id)
    if name is not None:
        return name
    return str(landmark_id) if is_number(landmark_id) else landmark_code(landmark_id)


def is_number(landmark_id: int) -> bool:
    """Return whether an identity is a number that people count with, rather than that of a text."""
    return landmark_id < _TEXT_IDS


def is_text_of(name: str, landmark_id: int) -> bool:
    """Return whether the identity of a landmark is this text (`landmark_id_of`), which then names it in tables."""
    return not is_number(landmark_id) and landmark_id_of(name) == landmark_id


def identity_text(landmark_id: int, names: Mapping[int, str]) -> str:
    """Return an identity as tables have it, by which it is read again: its text if it is one, else its number."""
    name = names.get(landmark_id)
    return name if name is not None and is_text_of(name, landmark_id) else str(landmark_id)
