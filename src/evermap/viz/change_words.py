"""Changes in words, for the terminal, the report and the legends."""

from __future__ import annotations

import math
from collections.abc import Sequence

from evermap.types import Alternative, ChangeKind, MapChange, SlamResult

SAME_SPOT_M, SAME_TURN_RAD = 0.1, 0.3
"""Below these a body that turned has not moved, and one that moved is not said to have turned, as in a living map."""

NATS = 5.0
"""Maximum difference in log probability of a reported alternative from the best explanation."""
_MAX_IDS = 12


def explanations(result: SlamResult) -> list[str]:
    """Return one line for each change, then 'or: ...' for each relevant alternative; [] if there is none."""
    start_s = float(result.trajectory.stamp_s[0]) if len(result.trajectory) else 0.0
    near = near_alternatives(result)
    lines = [f"{describe(change, start_s)}, {probability(change.probability)}" for change in result.changes]
    if near and not lines:
        lines = ["most probably nothing moved"]
    return lines + [
        f"or: {describe_all(alternative.changes, start_s)}, {probability(alternative.probability)}"
        for alternative in near
    ]


def near_alternatives(result: SlamResult) -> tuple[Alternative, ...]:
    """Return alternatives within `NATS` of the best explanation, which has at most the probability of each of its
    changes, but for what vanished: that is believed apart.
    """
    rest = 1.0 - sum(alternative.probability for alternative in result.alternatives)
    own = (change.probability for change in result.changes if change.kind is not ChangeKind.VANISHED)
    best = min(own, default=rest)
    return tuple(other for other in result.alternatives if other.probability >= math.exp(-NATS) * best)


def describe_all(changes: Sequence[MapChange], start_s: float) -> str:
    """Return all changes of one explanation in one line."""
    return "; ".join(describe(change, start_s) for change in changes) or "nothing moved"


def describe(change: MapChange, start_s: float) -> str:
    """Return 'landmarks 11, 12, 13 moved by (+1.00, 0.00) m before the session'; times count from `start_s`."""
    return f"{what(change)} {_when(change, start_s)}"


def what(change: MapChange) -> str:
    """Return the change without its time."""
    if change.kind is ChangeKind.SWAPPED:
        return f"{_group(change)} exchanged their identities"
    if change.kind is ChangeKind.VANISHED:
        return f"{_group(change)} vanished"
    if change.kind is ChangeKind.REPLACED:
        half, beside = len(change.labels) // 2, math.hypot(*change.displacement_m)
        left, came = (_join_labels(names) for names in (change.labels[:half], change.labels[half:]))
        return f"{came} stands {beside:.2f} m from where {left} stood, which was replaced or is the same"
    if change.kind is ChangeKind.APPEARED:
        return f"{_group(change)} appeared"
    if change.kind is ChangeKind.RETURNED:
        far = math.hypot(*change.displacement_m)
        return f"{_group(change)} returned" + (f", {far:.2f} m from where it was" if far > 0.0 else "")
    return f"{_group(change)} {_motion(change)}"


def _motion(change: MapChange) -> str:
    """Return 'moved by (+1.00, 0.00) m', 'turned by +20.0° and moved by ...' or 'turned by +90.0° in place'.

    Of a move that was found without its turn being searched for, the turn is told where it is beyond the limit of the
    living map.
    """
    turn, shift_m = math.degrees(change.rotation_rad), math.hypot(*change.displacement_m)
    sigma_m = change.displacement_sigma_m
    known = "" if math.isnan(sigma_m) else f" +- {sigma_m:.2f}"
    moved = f"moved by ({', '.join(map(_format_signed, change.displacement_m))}){known} m"
    far = abs(change.rotation_rad) >= SAME_TURN_RAD
    nowhere = all(round(metres, 2) == 0.0 for metres in change.displacement_m)
    sign = _format_signed(turn, 1) if len(change.displacement_m) == 2 else f"{turn:.1f}"  # in space about some axis
    if round(turn, 1) and (nowhere or (far and shift_m < SAME_SPOT_M)):
        return f"turned by {sign}° in place"
    return f"turned by {sign}° and {moved}" if far or change.kind is ChangeKind.ROTATED else moved


def probability(value: float) -> str:
    """Return 'probability 97 %'; never certain."""
    percent = f"{100 * value:.0f} %"
    return "probability " + ("> 99 %" if value > 0.99 else "< 1 %" if value < 0.01 else percent)


def grew(count: int | None, labels: Sequence[str] = ()) -> list[str]:
    """Return 'the map grew by 2 landmarks: 17, 18': what was found, but not seen to appear; [] where that is
    nothing.
    """
    if not count:
        return []
    return [
        f"the map grew by {count} landmark{'s' if count != 1 else ''}" + (f": {_join_labels(labels)}" if labels else "")
    ]


def _group(change: MapChange) -> str:
    return f"landmark{'s' if len(change.labels) != 1 else ''} {_join_labels(change.labels)}"


def _join_labels(labels: Sequence[str]) -> str:
    return ", ".join(labels[:_MAX_IDS]) + (f" and {len(labels) - _MAX_IDS} more" if len(labels) > _MAX_IDS else "")


def _when(change: MapChange, start_s: float) -> str:
    if math.isnan(change.stamp_from_s):
        return "before the session"
    early, late = change.stamp_from_s - start_s, change.stamp_to_s - start_s
    if early < 0.0:
        return f"since the last session, noticed {late:.0f} s after the start" if late >= 0.0 else "before the session"
    if round(early) == round(late):
        return f"{late:.0f} s after the start"
    return f"between {early:.0f} s and {late:.0f} s after the start"


def _format_signed(value: float, digits: int = 2) -> str:
    """'+1.00', '-0.50', and '0.00' without a sign."""
    rounded = round(value, digits)
    return f"{rounded:+.{digits}f}" if rounded else f"{0.0:.{digits}f}"
