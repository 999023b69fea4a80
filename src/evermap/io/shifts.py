"""Maps that are wrong on purpose: `--shift "11,12,13:+1.0,-0.5,15"` moves landmarks of a prior map, for experiments."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from evermap.errors import ConfigError
from evermap.geometry import se2
from evermap.types import ChangeKind, Landmarks, MapChange

_EXAMPLE = '"11,12,13:+1.0,-0.5" moves three landmarks 1 m in x and -0.5 m in y; a third number turns them [deg]'
_FIELD = "shift"


@dataclass(frozen=True, slots=True)
class Shift:
    """Landmarks of a map, moved together: turned about their centroid, which itself moves by `displacement_m`."""

    landmark_ids: tuple[int, ...]
    displacement_m: tuple[float, float]
    rotation_rad: float = 0.0

    def undone(self, first_stamp_s: float) -> MapChange:
        """Return the change that a recording from a stamp on shows against the shifted map: the other way."""
        x, y = self.displacement_m
        return MapChange(
            landmark_ids=tuple(sorted(self.landmark_ids)),
            kind=ChangeKind.ROTATED if self.rotation_rad else ChangeKind.MOVED,
            stamp_from_s=math.nan,
            stamp_to_s=first_stamp_s,
            displacement_m=(-x, -y),
            rotation_rad=-self.rotation_rad,
            probability=1.0,
        )


def parse_shift(text: str) -> Shift:
    """Return `IDS:DX[,DY[,TURN]]`: ids separated by commas, metres, degrees counter-clockwise about the centroid.

    Raises:
        ConfigError: the text is not of this form, lists an id twice, or has a number that is not finite.
    """
    left, colon, right = text.partition(":")
    if not colon:
        raise _wrong(text, "has no ':' between landmarks and metres")
    ids = [_whole(word, text) for word in _words(left)]
    numbers = [_finite(word, text) for word in _words(right)]
    if not ids:
        raise _wrong(text, "lists no landmark")
    again = next((identity for identity in ids if ids.count(identity) > 1), None)
    if again is not None:
        raise _wrong(text, f"lists landmark {again} twice")
    if not 1 <= len(numbers) <= 3:
        raise _wrong(text, f"needs one to three numbers after ':', not {len(numbers)}")
    x, y, turn_deg = [*numbers, 0.0, 0.0][:3]
    if turn_deg and len(ids) == 1:
        raise _wrong(text, "rotates a single landmark about itself, which has no effect")
    return Shift(tuple(ids), (x, y), math.radians(turn_deg))


def shifted(landmarks: Landmarks, shifts: Iterable[Shift]) -> Landmarks:
    """Return the map after all shifts, one after the other; covariances turn with their landmarks.

    Raises:
        ConfigError: a landmark is not in the map.
    """
    for shift in shifts:
        landmarks = _shifted(landmarks, shift)
    return landmarks


def _shifted(landmarks: Landmarks, shift: Shift) -> Landmarks:
    row_of = {identity: row for row, identity in enumerate(landmarks.landmark_id.tolist())}
    missing = next((identity for identity in shift.landmark_ids if identity not in row_of), None)
    if missing is not None:
        known = ", ".join(map(str, list(row_of)[:20])) + (" ..." if len(row_of) > 20 else "")
        raise ConfigError(f"no landmark {missing} in the prior map", field=_FIELD, hint=f"one of {known}")
    rows = [row_of[identity] for identity in shift.landmark_ids]
    position, covariance = landmarks.position_m.copy(), landmarks.covariance_m2.copy()
    position[rows] = se2.move_together(position[rows], np.array(shift.displacement_m), shift.rotation_rad)
    turn = se2.rotation(shift.rotation_rad)
    covariance[rows] = turn @ covariance[rows] @ turn.T
    return replace(landmarks, position_m=position, covariance_m2=covariance)


def _words(text: str) -> list[str]:
    """Words between commas; nothing at all is not a word, but an empty place between commas is one."""
    return [word.strip() for word in text.split(",")] if text.strip() else []


def _whole(word: str, text: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise _wrong(text, f"'{word}' is not a landmark id") from None


def _finite(word: str, text: str) -> float:
    try:
        number = float(word)
    except ValueError:
        raise _wrong(text, f"'{word}' is not a number") from None
    if not math.isfinite(number):
        raise _wrong(text, f"'{word}' is not finite")
    return number


def _wrong(text: str, problem: str) -> ConfigError:
    return ConfigError(f"'{text}': {problem}", field=_FIELD, hint=_EXAMPLE)
