"""What an audit found: entries of a map with their states, the drives, and what is to be corrected."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from evermap.io.map_entries import Correction
from evermap.show import Shown
from evermap.types import Clock, FloatArray, Landmarks


class EntryState(StrEnum):
    """What is known of an entry of a map."""

    WRONG = "wrong"
    """Elsewhere ever since the first drive that saw it."""
    STALE = "stale"
    """Where the map has it at first, and elsewhere since."""
    EXCHANGED = "exchanged"
    """It stands where the map has another one, and so on around to it."""
    GONE = "gone"
    """Looked for where the map has it, and seen nowhere."""
    MISSING = "missing"
    """Seen, and not in the map."""
    UNDECIDED = "undecided"
    """Seen, but the drives do not say."""
    UNSEEN = "unseen"
    """Never seen, and never looked for so that it would have been."""
    RIGHT = "right"
    """Where the map has it."""

    @property
    def is_fault(self) -> bool:
        """Whether the map is wrong there."""
        return self in (EntryState.WRONG, EntryState.STALE, EntryState.EXCHANGED, EntryState.GONE, EntryState.MISSING)


ORDER = tuple(EntryState)


@dataclass(frozen=True, slots=True)
class AuditEntry(Shown):
    """What the drives say of an entry of a map.

    Attributes:
        landmark_id, label: which.
        state: what it is.
        probability: that it is not where the map has it, of one that is missing that it is there; nan where nothing
            can be said.
        displacement_m: (D,) from where the map has it to where it is; nan where it was not seen.
        sigma_m: standard deviation of that, the mean of all directions.
        turn_rad, turn_sigma_rad: angle by which it is turned, and its standard deviation; nan of points.
        from_s, to_s: it changed between these; nan and the first sighting where no drive saw it as the map has it.
        n_hits, n_misses: detections, and looks without one that should have seen it.
        n_drives: that saw it.
        position_m, covariance_m2: (D,), (D, D) where it is; nan where it was not seen.
        rotation, rotation_covariance: (4,), (3, 3) how it is turned; None of points.
        like_id: the entry at whose place it stands, -1 for none.
        reason: one line: why it cannot be decided and what would decide it, or what else is to be known.
        moved, turned: whether the position, the rotation is to be corrected.
    """

    landmark_id: int
    label: str
    state: EntryState
    probability: float
    displacement_m: FloatArray
    sigma_m: float
    turn_rad: float
    turn_sigma_rad: float
    from_s: float
    to_s: float
    n_hits: int
    n_misses: int
    n_drives: int
    position_m: FloatArray
    covariance_m2: FloatArray
    rotation: FloatArray | None = None
    rotation_covariance: FloatArray | None = None
    like_id: int = -1
    reason: str = ""
    moved: bool = False
    turned: bool = False

    @property
    def distance_m(self) -> float:
        """Return how far it is from where the map has it."""
        return float(np.linalg.norm(self.displacement_m))


@dataclass(frozen=True, slots=True)
class AuditDrive(Shown):
    """What is known of a drive.

    Attributes:
        name, source: of the recording.
        from_s, to_s: its first and last frame.
        n_detections: that it has.
        is_heard: whether its word counts.
        reason: why it does not; the verdict's line where it does.
        of_map: what is wrong with the map as a whole (scale, unit, mirror), and what mends it; '' of none.
        sensor: what the sensor is off by, one line each, with what mends it.
        warnings: of reader and estimator.
        path_m: (N, D) where it drove, in the map.
    """

    name: str
    source: str
    from_s: float
    to_s: float
    n_detections: int
    is_heard: bool
    reason: str
    of_map: str
    sensor: tuple[str, ...]
    warnings: tuple[str, ...]
    path_m: FloatArray


@dataclass(frozen=True, slots=True)
class Audit(Shown):
    """A map as drives found it.

    Attributes:
        given: the map.
        entries: all of it and what is missing, faults first.
        drives: in order of time.
        clock: of all stamps.
    """

    given: Landmarks
    entries: tuple[AuditEntry, ...]
    drives: tuple[AuditDrive, ...]
    clock: Clock

    @property
    def faults(self) -> tuple[AuditEntry, ...]:
        """Return entries that are wrong, stale, exchanged, gone or missing."""
        return tuple(entry for entry in self.entries if entry.state.is_fault)

    @property
    def is_heard(self) -> bool:
        """Whether any drive could be trusted."""
        return any(drive.is_heard for drive in self.drives)

    @property
    def of_map(self) -> str:
        """Return what is wrong with the map as a whole, and what mends it; '' if single entries are judged."""
        return next((drive.of_map for drive in self.drives if drive.is_heard and drive.of_map), "")

    def corrections(self) -> list[Correction]:
        """Return what is to be written into the map's file: of entries that moved, turned or were exchanged."""
        found = []
        for entry in self.entries:
            if entry.state is EntryState.EXCHANGED:
                found.append(Correction(entry.landmark_id, like_id=entry.like_id))
            elif entry.state in (EntryState.WRONG, EntryState.STALE):
                found.append(
                    Correction(
                        entry.landmark_id,
                        entry.position_m if entry.moved else None,
                        entry.covariance_m2 if entry.moved else None,
                        entry.rotation if entry.turned else None,
                        entry.rotation_covariance if entry.turned else None,
                    )
                )
        return found

    def _facts(self) -> dict[str, Any]:
        counts = {state.value: sum(entry.state is state for entry in self.entries) for state in ORDER}
        return {**{name: count for name, count in counts.items() if count}, "drives": len(self.drives)}


def format_percent(value: float) -> str:
    """Return a probability as text, never as certain."""
    return "> 99 %" if value > 0.99 else "< 1 %" if value < 0.01 else f"{100 * value:.0f} %"


def count_states(entries: Iterable[AuditEntry]) -> dict[str, int]:
    """Return how many entries are in which state, all states in their order."""
    every = list(entries)
    return {state.value: sum(entry.state is state for entry in every) for state in ORDER}
