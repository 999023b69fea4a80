"""From where to where the sensor sees: detection rates between cells of the floor, learned from hits and misses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class SightLines:
    """Hits and looks between cells, sorted by key.

    Attributes:
        key: (K,) of a pair of cells: the sensor's and the landmark's.
        hits, looks: (K,) detections, and looks at what was there, both weighted by the belief that it was.
        cell_m: side of a cell.
    """

    key: IntArray
    hits: FloatArray
    looks: FloatArray
    cell_m: float = 1.0

    @classmethod
    def empty(cls) -> SightLines:
        """Nothing learned yet."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))
