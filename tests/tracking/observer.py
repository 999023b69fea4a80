"""A patient observer of a few objects."""

from __future__ import annotations

from typing import Any

from evermap.tracking.record import Event
from evermap.tracking.tracker import Tracker
from evermap.tracking.tracklets import EventKind
from evermap.types import FloatArray


def look(tracker: Tracker, start_s: float, n: int, position: FloatArray, **given: Any) -> list[Event]:
    """`n` frames at 10 Hz of the same detections, and all that happened."""
    events: list[Event] = []
    for k in range(n):
        events += tracker.step(start_s + 0.1 * k, position, **given)[1]
    return events


def kinds(events: list[Event]) -> list[EventKind]:
    """What happened, in order."""
    return [event.kind for event in events]
