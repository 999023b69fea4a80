"""From where to where the sensor sees: detection rates between cells of the floor, learned from hits and misses.

Nobody gives a map of the walls, but whoever has looked from here to there a few times knows whether one is between.
A *line of sight* is a pair of cells, the sensor's and the landmark's; the probability of a detection along it has a
Beta distribution. What is expected of a line that nobody has looked along is learned too: from all lines as long as it
is, and how far they differ from each other (most of them are either free or blocked).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.types import BoolArray, FloatArray, IntArray

MOST_LOOKS = 200.0
"""Along one line: with more, old ones fade. So a wall that is moved is learned, and misses by chance are not."""
NOMINAL_LOOKS = 20.0
"""Along lines of one length, that the sensor's nominal detection probability is worth."""
RATES = (0.02, 0.98)
"""No rate is expected outside: nothing is certain of a line that nobody has looked along."""
STRENGTHS = np.geomspace(0.25, 16.0, 13)
"""Looks that what all lines have in common may be worth for one of them."""
STRENGTH = 2.0
"""The same, of a table from which it cannot be told yet."""
_SENSOR_CELLS = 1 << 20
_LONGEST = 1 << 10


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

    def __len__(self) -> int:
        return len(self.key)

    @classmethod
    def empty(cls, cell_m: float = 1.0) -> SightLines:
        """Nothing learned yet."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), cell_m)

    def rows(self, sensor_m: FloatArray, landmark_m: FloatArray) -> IntArray:
        """(N,) keys of the lines of sight from sensors (N, 2) to landmarks (N, 2).

        Raises:
            InputError: a place that is not finite, or farther away than keys reach: 500,000 cells from the origin,
                1,000 from the sensor.
        """
        own, other = (np.floor(np.asarray(place) / self.cell_m) for place in (sensor_m, landmark_m))
        away = other - own
        reach = (np.abs(own) < _SENSOR_CELLS / 2) & (np.abs(away) < _LONGEST)  # False for nan
        if not reach.all():
            row = int(np.argmin(reach.all(axis=1)))
            problem = f"row {row}: nobody sees from {np.asarray(sensor_m)[row]} to {np.asarray(landmark_m)[row]}"
            raise InputError(problem, field="sensor_m", hint="finite metres, in one frame")
        x, y = (own.astype(np.int64) + _SENSOR_CELLS // 2).T
        dx, dy = (away.astype(np.int64) + _LONGEST).T
        return np.asarray(((x * _SENSOR_CELLS + y) * (2 * _LONGEST) + dx) * (2 * _LONGEST) + dy, dtype=np.int64)

    def prior_counts(self, keys: IntArray, p_detect: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Beta distributions of the detection probability along lines of sight: pseudo counts (N,) of hits and misses.

        Args:
            keys: (N,) lines of sight.
            p_detect: (N,) what the sensor's nominal field of view says (`visibility.detection_probability`).
        """
        mean = self._expected(keys, p_detect)
        strength = self._strength()
        hits, looks = self._counts(keys)
        return hits + strength * mean, looks - hits + strength * (1.0 - mean)

    def learned(self, keys: IntArray, hit: BoolArray, weight: FloatArray) -> SightLines:
        """The table after looks at what was there with some probability.

        Args:
            keys: (N,) lines of sight, in any order.
            hit: (N,) whether it was detected.
            weight: (N,) probability that it was there.
        """
        every, row = np.unique(np.append(self.key, keys), return_inverse=True)
        old, new = row[: len(self.key)], row[len(self.key) :]
        n = len(every)
        looks = np.bincount(old, self.looks, n) + np.bincount(new, weight, n)
        hits = np.bincount(old, self.hits, n) + np.bincount(new, weight * hit, n)
        scale = np.minimum(1.0, MOST_LOOKS / np.maximum(looks, 1e-300))
        kept = looks > 0.0
        return SightLines(every[kept], (hits * scale)[kept], (looks * scale)[kept], self.cell_m)

    def _counts(self, keys: IntArray) -> tuple[FloatArray, FloatArray]:
        """(N,) hits and looks along lines, 0 along unknown ones."""
        if not len(self.key):
            return np.zeros(len(keys)), np.zeros(len(keys))
        at = np.minimum(np.searchsorted(self.key, keys), len(self.key) - 1)
        known = self.key[at] == keys
        return np.where(known, self.hits[at], 0.0), np.where(known, self.looks[at], 0.0)

    def _expected(self, keys: IntArray, p_detect: Any) -> FloatArray:
        """(N,) rate along lines as long as these, one line one voice, starting from the nominal one."""
        length, wanted = _length(self.key), _length(keys)
        n = int(max(length.max(initial=0), wanted.max(initial=0))) + 1
        voice = np.minimum(1.0, NOMINAL_LOOKS / np.maximum(self.looks, 1.0))  # often used lines do not outvote others
        hits, looks = np.bincount(length, voice * self.hits, n), np.bincount(length, voice * self.looks, n)
        rate = (hits[wanted] + NOMINAL_LOOKS * np.asarray(p_detect)) / (looks[wanted] + NOMINAL_LOOKS)
        return np.clip(rate, *RATES)

    def _strength(self) -> float:
        """Looks that the rate of all lines is worth for one: of the largest likelihood of the table (beta-binomial)."""
        from scipy.special import betaln

        if len(self.key) < 50:
            return STRENGTH
        mean = self._expected(self.key, 0.5)
        a, b = STRENGTHS[:, None] * mean, STRENGTHS[:, None] * (1.0 - mean)
        likelihood = betaln(a + self.hits, b + self.looks - self.hits) - betaln(a, b)
        return float(STRENGTHS[np.argmax(likelihood.sum(axis=1))])


def _length(key: IntArray) -> IntArray:
    """(N,) lengths of lines of sight, in cells."""
    dx, dy = key // (2 * _LONGEST) % (2 * _LONGEST) - _LONGEST, key % (2 * _LONGEST) - _LONGEST
    return np.rint(np.hypot(dx, dy)).astype(np.int64)
