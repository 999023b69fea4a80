"""A verdict in words, the same on a terminal and on a page."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from evermap.types import Cause, Verdict

ABOUT_RIGHT = 1.4, 2.6
"""Mean innovations, of 2 numbers each, within which standard deviations are right to 15 %."""
FAR_OFF = 4.0
"""The same beyond which they are too small by more than 40 %."""


def further_causes(verdict: Verdict) -> Sequence[Cause]:
    """Return the causes that the line of the verdict does not have: not sure, or put right by the estimator."""
    return [cause for cause in verdict.causes if cause.message not in verdict.message]


def cause_text(cause: Cause) -> str:
    """Return a cause in one line: 'stamps of front are 0.12 s late (p = 0.98); detections.csv of front: ...'."""
    sure = f" (p = {cause.probability:.2f})" if isfinite(cause.probability) else ""
    return f"{cause.message}{sure}{f'; {cause.fix}' if cause.fix else ''}"


def innovations_text(mean: float) -> str:
    """Return what a mean innovation says, where 2 is expected."""
    low, high = ABOUT_RIGHT
    if low <= mean <= high:
        return "the uncertainties are about right"
    if mean > FAR_OFF:
        return "errors are far larger than estimated: readings contradict the solution"
    return f"errors are {'larger' if mean > high else 'smaller'} than estimated"
