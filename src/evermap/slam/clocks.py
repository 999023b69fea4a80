"""Stamps in the order of their arrival: late ones, ones that are no stamps, and clocks that were set.

Of two streams of messages, odometry and looks, only the stamps say what belongs together. A clock that is set *back*
shows in its own stream: stamps run back and stay there. One that is set *forward* looks like a pause; that it was none
shows only in that its stream seems to end later than the other one, by just this pause.
"""

from __future__ import annotations

import numpy as np

from evermap.types import FloatArray
from evermap.valid import LATEST_S

STRAY_S = 10.0
"""A stamp farther than this from those that arrive around it is none."""
STEP_S = 1.0
"""Smallest step of a clock that is noticed; less is taken for messages that come late."""
AROUND = 9
"""Messages that a stamp is compared with: fewer than half of them may be late or wrong."""


def restored(stamp_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The stamps as a clock that is never set back would have shown them.

    Args:
        stamp_s: (N,) in the order of arrival, anything.

    Returns:
        (N,) stamps, nan where one is none; late ones still stand where they arrived. And (K,) by how much the clock was
        set back, each time.
    """
    stamps = np.where(np.abs(stamp_s) <= LATEST_S, stamp_s, np.nan)  # nan fails the comparison
    if np.all(np.diff(stamps) > 0.0):
        return stamps, np.zeros(0)
    found = np.flatnonzero(np.isfinite(stamps))
    told = stamps[found]
    kept = np.abs(told - running_median(told)) <= STRAY_S
    stamps[found[~kept]] = np.nan
    found, told = found[kept], told[kept]
    forward = np.diff(told)
    forward = forward[forward > 0.0]
    # against a clock that ticks once a message, a loss is a step up, and only a clock that is set back a step down
    ahead = running_median(told - np.arange(len(told)) * (np.median(forward) if len(forward) else 0.0))
    fall = np.diff(ahead, prepend=ahead[:1])
    set_back = fall < -STEP_S
    stamps[found] = told - np.cumsum(np.where(set_back, fall, 0.0))
    return stamps, -fall[set_back]


def running_median(values: FloatArray) -> FloatArray:
    """(N,) median of the `AROUND` values centred on each; the first and last are repeated beyond the ends."""
    if len(values) == 0:
        return values
    padded = np.pad(values, AROUND // 2, mode="edge")
    middle: FloatArray = np.median(np.lib.stride_tricks.sliding_window_view(padded, AROUND), axis=1)
    return middle


def set_forward(stamp_s: FloatArray, other_s: FloatArray) -> tuple[int, float] | None:
    """Whether a clock was set forward, judged by another stream of the same robot.

    It was, if this stream seems to end later than the other, and has a pause of just that length in which the other
    goes on.

    Args:
        stamp_s: (N,) increasing.
        other_s: (M,) increasing.

    Returns:
        First row after the step and the step's size [s]; None if it was not.
    """
    if len(stamp_s) < AROUND or len(other_s) < AROUND:
        return None
    later_s = stamp_s[-1] - other_s[-1]
    if later_s < 2.0 * STEP_S:
        return None
    pause = np.diff(stamp_s)
    step_s = pause - np.median(pause)
    row = int(np.argmin(np.abs(step_s - later_s)))
    if abs(step_s[row] - later_s) > STEP_S:
        return None
    between = other_s[(other_s > stamp_s[row]) & (other_s < stamp_s[row + 1])]
    longest_s = np.max(np.diff(between, prepend=stamp_s[row], append=min(stamp_s[row + 1], other_s[-1])))
    return None if longest_s > 0.5 * step_s[row] else (row + 1, float(step_s[row]))
