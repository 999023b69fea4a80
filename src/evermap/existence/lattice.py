"""Looks laid out on the time steps of a filter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.existence.protocol import Looks
from evermap.types import FloatArray


class Lattice(NamedTuple):
    """Instants at most a step apart, the looks among them.

    Attributes:
        stamp_s: (T + 1,) in order, all different.
        absent: (T + 1,) likelihood of the looks there if the feature is absent; 1 where there was none.
        present: (T + 1,) the same if it is present.
    """

    stamp_s: FloatArray
    absent: FloatArray
    present: FloatArray


def lattice(looks: Looks, step_s: float) -> Lattice:
    """One feature's looks, with whole steps after each and a shorter one before the next, as the filter takes them."""
    stamp, first = np.unique(looks.stamp_s, return_index=True)
    present, absent = (np.multiply.reduceat(values, first) for values in looks.likelihoods())
    steps = np.maximum(np.ceil(np.diff(stamp) / step_s * (1.0 - 1e-12)).astype(np.int64), 1)
    place = np.concatenate([[0], np.cumsum(steps)])
    times = np.repeat(stamp[:-1], steps) + step_s * (np.arange(place[-1]) - np.repeat(place[:-1], steps))
    whole = [np.ones(place[-1] + 1), np.ones(place[-1] + 1)]
    for column, values in zip(whole, (absent, present), strict=True):
        column[place] = values
    return Lattice(np.append(times, stamp[-1]), whole[0], whole[1])
