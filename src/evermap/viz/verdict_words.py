"""A verdict in words, the same on a terminal and on a page."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evermap.types import Verdict

ABOUT_RIGHT = 1.4, 2.6
"""Mean innovations, of 2 numbers each, within which standard deviations are right to 15 %."""
FAR_OFF = 4.0
"""The same beyond which they are too small by more than 40 %."""


def verdict_text(verdict: Verdict) -> str:
    """Return a verdict in one line: 'lost: ...'."""
    return f"{verdict.kind}: {verdict.message}"


def innovations_text(mean: float) -> str:
    """Return what a mean innovation says, where 2 is expected."""
    low, high = ABOUT_RIGHT
    if low <= mean <= high:
        return "the uncertainties are about right"
    if mean > FAR_OFF:
        return "errors are far larger than estimated: readings contradict the solution"
    return f"errors are {'larger' if mean > high else 'smaller'} than estimated"
