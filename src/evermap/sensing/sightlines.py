"""From where to where the sensor sees: detection rates between cells of the floor, learned from hits and misses.

Nobody gives a map of the walls, but whoever has looked from here to there a few times knows whether one is between.
A *line of sight* is a pair of cells, the sensor's and the landmark's. It is free or blocked; each kind has a Beta
distribution of the detection probability, that of the free ones depends on their length. How many are free and how
often one detects along either kind is learned from all lines together (empirical Bayes), so that something is known of
a line that nobody has looked along before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evermap.errors import InputError
from evermap.types import BoolArray, FloatArray, IntArray

MOST_LOOKS = 200.0
"""Along one line: with more, old ones fade. So a wall that is moved is learned, and misses by chance are not."""
STRENGTH = 8.0
"""Looks along one line that the rate of its kind is worth."""
NOMINAL_LOOKS = 20.0
"""Looks that the nominal rate is worth against those along all lines of a length; one line counts no more than that."""
BLOCKED = 0.03
"""Rate along blocked lines to begin with: round corners, through glass, and because places are not quite known."""
RATES = (0.002, 0.98)
"""No kind of line has a rate outside: nothing is certain."""
LONGEST = 40
"""Cells; lines longer than this are taken together."""
ROUNDS = 10
KNOWN = 1e9
"""Looks that are worth certainty."""
_SENSOR_CELLS = 1 << 20
_REACH = 1 << 10


class Lines(NamedTuple):
    """What is known of N lines of sight.

    Attributes:
        p_free: (N,) probability that they are free.
        hits, misses: (N,) parameters of the Beta distribution of the detection probability along them if they are.
        p_blocked: detection probability along them if they are not.
    """

    p_free: FloatArray
    hits: FloatArray
    misses: FloatArray
    p_blocked: float

    @property
    def p_detect(self) -> FloatArray:
        """(N,) mean detection probability."""
        return self.p_free * self.hits / (self.hits + self.misses) + (1.0 - self.p_free) * self.p_blocked


class _Kinds(NamedTuple):
    """The two kinds of lines.

    Attributes:
        p_free: (LONGEST + 1,) share of the free ones, by length.
        free: (LONGEST + 1,) rate along these.
        blocked: rate along the others.
    """

    p_free: FloatArray
    free: FloatArray
    blocked: float


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
            InputError: a place that is not finite, or out of reach: 500,000 cells from the origin, 1,000 from the
                sensor.
        """
        sensor, landmark = np.asarray(sensor_m, dtype=np.float64), np.asarray(landmark_m, dtype=np.float64)
        own = np.floor(sensor / self.cell_m)
        away = np.floor(landmark / self.cell_m) - own
        fine = ((np.abs(own) < _SENSOR_CELLS / 2) & (np.abs(away) < _REACH)).all(axis=1)  # False for nan
        if not fine.all():
            row = int(np.argmin(fine))
            problem = f"row {row}: nobody sees from {sensor[row]} to {landmark[row]}"
            raise InputError(problem, field="landmark_m", hint="finite metres, both in one frame")
        x, y = (own.astype(np.int64) + _SENSOR_CELLS // 2).T
        dx, dy = (away.astype(np.int64) + _REACH).T
        return np.asarray(((x * _SENSOR_CELLS + y) * (2 * _REACH) + dx) * (2 * _REACH) + dy, dtype=np.int64)

    def lines(self, keys: IntArray, p_detect: FloatArray) -> Lines:
        """What is known of lines of sight.

        Args:
            keys: (N,) which.
            p_detect: (N,) what the nominal field of view says (`visibility.detection_probability`): the rate along free
                lines that is started from, and by how much it is less at the field's edge.
        """
        nominal = np.asarray(p_detect, dtype=np.float64)
        middle = float(np.max(nominal, initial=0.0)) or 1.0
        kinds, length, (hits, looks) = self._kinds(middle), _length(keys), self._counts(keys)
        free, blocked = np.clip(kinds.free[length] * nominal / middle, *RATES), np.full(len(length), kinds.blocked)
        p_free = _p_free(hits, looks, kinds.p_free[length], free, blocked)
        misses = np.maximum(looks - hits, 0.0)
        return Lines(p_free, hits + STRENGTH * free, misses + STRENGTH * (1.0 - free), kinds.blocked)

    def learned(self, keys: IntArray, hit: BoolArray, weight: FloatArray) -> SightLines:
        """The table after looks at what was there with some probability.

        Args:
            keys: (N,) lines of sight, in any order.
            hit: (N,) whether it was detected.
            weight: (N,) probability that it was there.
        """
        every, row = np.unique(np.append(self.key, keys), return_inverse=True)
        old, new, n = row[: len(self.key)], row[len(self.key) :], len(every)
        looks = np.bincount(old, self.looks, n) + np.bincount(new, weight, n)
        hits = np.bincount(old, self.hits, n) + np.bincount(new, weight * hit, n)
        kept = looks > 0.0
        scale = MOST_LOOKS / np.maximum(looks[kept], MOST_LOOKS)
        return SightLines(every[kept], hits[kept] * scale, looks[kept] * scale, self.cell_m)

    def _counts(self, keys: IntArray) -> tuple[FloatArray, FloatArray]:
        """(N,) hits and looks along lines, 0 along unknown ones."""
        if not len(self.key):
            return np.zeros(len(keys)), np.zeros(len(keys))
        at = np.minimum(np.searchsorted(self.key, keys), len(self.key) - 1)
        known = self.key[at] == keys
        return np.where(known, self.hits[at], 0.0), np.where(known, self.looks[at], 0.0)

    def _kinds(self, nominal: float) -> _Kinds:
        """The two kinds of lines, by expectation maximisation; what few lines say gives way to what is nominal."""
        length, n = _length(self.key), LONGEST + 1
        lines = np.bincount(length, minlength=n)
        voice = np.minimum(1.0, NOMINAL_LOOKS / np.maximum(self.looks, 1.0))
        hits, looks = voice * self.hits, voice * self.looks
        kinds = _Kinds(np.full(n, 0.5), np.full(n, np.clip(nominal, *RATES)), BLOCKED)
        for _ in range(ROUNDS if len(self.key) else 0):
            blocked = np.full(len(length), kinds.blocked)
            p_free = _p_free(self.hits, self.looks, kinds.p_free[length], kinds.free[length], blocked)
            own = np.bincount(length, p_free * hits, n), np.bincount(length, p_free * looks, n)
            rest = np.sum((1.0 - p_free) * hits), np.sum((1.0 - p_free) * looks)
            kinds = _Kinds(
                (np.bincount(length, p_free, n) + 2.0) / (lines + 4.0),
                np.clip((own[0] + NOMINAL_LOOKS * nominal) / (own[1] + NOMINAL_LOOKS), *RATES),
                float(np.clip((rest[0] + NOMINAL_LOOKS * BLOCKED) / (rest[1] + NOMINAL_LOOKS), *RATES)),
            )
        return kinds


def nominal_lines(p_detect: FloatArray) -> Lines:
    """For who takes the sensor's nominal field of view (N,) for the truth, whatever is looked at."""
    nominal = np.clip(np.asarray(p_detect, dtype=np.float64), *RATES)
    return Lines(np.ones(len(nominal)), KNOWN * nominal, KNOWN * (1.0 - nominal), BLOCKED)


def _p_free(
    hits: FloatArray, looks: FloatArray, prior: FloatArray, free: FloatArray, blocked: FloatArray
) -> FloatArray:
    """(N,) probability that lines are free, given hits and looks along them (beta-binomial)."""
    from scipy.special import expit, gammaln

    def log_likelihood(rate: FloatArray) -> FloatArray:
        a, b = STRENGTH * rate, STRENGTH * (1.0 - rate)
        return np.asarray(gammaln(a + hits) - gammaln(a) + gammaln(b + np.maximum(looks - hits, 0.0)) - gammaln(b))

    return np.asarray(expit(np.log(prior / (1.0 - prior)) + log_likelihood(free) - log_likelihood(blocked)))


def _length(key: IntArray) -> IntArray:
    """(N,) lengths of lines of sight in cells, at most `LONGEST`."""
    dx, dy = key // (2 * _REACH) % (2 * _REACH) - _REACH, key % (2 * _REACH) - _REACH
    return np.minimum(np.rint(np.hypot(dx, dy)).astype(np.int64), LONGEST)
