"""Lines of sight to places, learned from hits and misses.

Nobody gives a map of the walls. A *line of sight* leads from a cell of the floor to one place; cells are counted from
the place, so that a map whose landmarks move by centimetres keeps its lines. A line is unknown until something was
seen along it or along its neighbours; then it is clear, with a detection rate of its own (Beta distribution), or it is
blocked. Misses along lines that are not known to be clear say nothing: nobody has looked at that place.

`Views` remember the cells and headings from which the robot looked, and when: where a landmark turns up that the map
did not know, they say whether its place had been seen empty. `Glimpses` remember where something was seen that did not
become a landmark: such a place was not empty.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from evermap.config import SightConfig
from evermap.errors import InputError
from evermap.types import BoolArray, FloatArray, IntArray

USUAL = SightConfig()
LONGEST = 80
"""Cells; lines longer than this are taken together."""
ROUNDS = 10
KNOWN = 1e9
"""Looks that are worth certainty."""
HEADINGS = 24
"""Headings that views distinguish."""
_FACTORS = np.exp(np.linspace(-4.0, 0.0, 401))
"""Rates of a session that are compared."""
_REACH = 1 << 12
_SPAN = 1 << 24
_AROUND = tuple((dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1))
"""Cells that a key holds, and those around one."""


class Lines(NamedTuple):
    """State of N lines of sight.

    Attributes:
        p_free: (N,) probability that they are not blocked.
        hits, misses: (N,) parameters of the Beta distribution of the detection probability along them if so.
        p_blocked: detection probability along them if not.
    """

    p_free: FloatArray
    hits: FloatArray
    misses: FloatArray
    p_blocked: float

    @property
    def p_detect(self) -> FloatArray:
        """(N,) mean detection probability."""
        return self.p_seen + (1.0 - self.p_free) * self.p_blocked

    @property
    def p_seen(self) -> FloatArray:
        """(N,) probability of a detection along them that something stands for: they are clear, and it is detected."""
        return self.p_free * self.hits / (self.hits + self.misses)

    def at(self, rate: float, highest: float) -> Lines:
        """Return lines along which a session detects `rate` times as often, with a probability of `highest` at most."""
        worth = self.hits + self.misses
        hits = np.minimum(rate * self.hits, highest * worth) if rate != 1.0 else self.hits
        return self._replace(hits=hits, misses=worth - hits)


@dataclass(frozen=True, slots=True)
class SightLines:
    """Hits and looks along lines of sight: (K,) rows sorted by site, landmark and cell.

    Attributes:
        site_id, landmark_id: (K,) the place that was looked at.
        cell: (K,) the sensor's cell, counted from the place.
        hits, looks: (K,) detections, and looks at what was there, both weighted by the belief that it was.
        hidden, shown: (3,) sessions of cliques that were looked at and stood there: how many could not be seen, and
            were; by what was known of the lines, see `SightConfig.p_hidden`.
        cell_m: side of a cell.
        rules: what is believed of lines of sight, and how it is learned.
        open_space: (4,) what sessions learned of lines that were new: walls, as shape and rate [m] of their number a
            metre, and the share of places that are hidden all the same, by both parameters; empty before the first.
    """

    site_id: IntArray
    landmark_id: IntArray
    cell: IntArray
    hits: FloatArray
    looks: FloatArray
    hidden: FloatArray = field(default_factory=lambda: np.zeros(3))
    shown: FloatArray = field(default_factory=lambda: np.zeros(3))
    cell_m: float = 0.5
    rules: SightConfig = USUAL
    open_space: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.cell)

    @property
    def reach_m(self) -> float:
        """Return how far from a place lines of sight are told apart on each axis."""
        return (_REACH // 2 - 1) * self.cell_m

    @property
    def p_hidden(self) -> FloatArray:
        """(3,) probability that a place is hidden for a whole session, by the state of the lines to it."""
        hidden, shown = self.closed
        return np.asarray(hidden / (hidden + shown))

    @property
    def closed(self) -> tuple[FloatArray, FloatArray]:
        """(3,) and (3,) parameters of the beta distribution of the share of places that are hidden, by the same."""
        at_first, worth = np.array(self.rules.p_hidden), self.rules.hidden_looks
        return at_first * worth + self.hidden, (1.0 - at_first) * worth + self.shown

    def after_session(self, hidden: FloatArray, shown: FloatArray) -> SightLines:
        """Return the profile with expected numbers (3,) of cliques that were hidden, or shown, along clear lines."""
        hidden, shown = self.hidden + hidden, self.shown + shown
        fade = np.minimum(1.0, self.rules.most_sessions / np.maximum(hidden + shown, 1.0))
        return replace(self, hidden=fade * hidden, shown=fade * shown)

    @classmethod
    def empty(cls, cell_m: float = 0.5) -> SightLines:
        """Return a table in which nothing is learned yet."""
        none = np.zeros(0, dtype=np.int64)
        return cls(none, none, none, np.zeros(0), np.zeros(0), cell_m=cell_m)

    def cells(
        self, sensor_m: FloatArray, place_m: FloatArray, pairs: tuple[IntArray, IntArray] | None = None
    ) -> IntArray:
        """Return (N,) cells of sensors (N, 2), counted from places (N, 2); or for N pairs of rows of both.

        Raises:
            InputError: a position that is not finite, or 1,000 m and more from the sensor.
        """
        from evermap.sensing.kernels import cells

        sensor, place = (np.ascontiguousarray(one, dtype=np.float64) for one in (sensor_m, place_m))
        one, other = (np.arange(len(sensor)),) * 2 if pairs is None else pairs
        cell, row = cells(sensor, one, place, other, self.cell_m, _REACH)
        if row >= 0:
            problem = f"row {row}: no line of sight from {sensor[one[row]]} to {place[other[row]]}"
            raise InputError(problem, field="place_m", hint="finite metres, both in one frame")
        return cell

    def lines(
        self, places: tuple[IntArray, IntArray], place: IntArray, cell: IntArray, p_detect: FloatArray
    ) -> tuple[Lines, FloatArray, BoolArray]:
        """Return the state of lines of sight.

        Args:
            places: (P,) sites and (P,) landmarks of the places of the map, sorted by both.
            place: (N,) row of the place of each line.
            cell: (N,) cell of the sensor.
            p_detect: (N,) what the nominal field of view says (`visibility.NominalField`): the rate along
                clear lines that is started from, and by how much it is less at the field's edge.

        Returns:
            The lines, with nothing hidden; (N,) probability that they are clear; and (N,) whether something was ever
            seen along them.
        """
        nominal = np.asarray(p_detect, dtype=np.float64)
        middle = float(np.max(nominal, initial=0.0)) or 1.0
        rate, share = self._kinds(middle)
        length = _length(cell)
        hits, looks = self._around(places, place, cell)
        strength = self.rules.strength
        free = np.clip(rate[length] * nominal / middle, *self.rules.rates)
        known = looks > 0.0  # of others the share is all that is known
        p_clear = np.full(len(known), share)
        p_clear[known] = _Seen.of(hits[known], looks[known], self.rules).p_clear(share, free[known])
        misses = np.maximum(looks - hits, 0.0)
        lines = Lines(np.ones(len(length)), hits + strength * free, misses + strength * (1.0 - free), 0.0)
        return lines, p_clear, hits > 0.0

    def learned(
        self,
        places: tuple[IntArray, IntArray],
        place: IntArray,
        cell: IntArray,
        hit: BoolArray,
        weight: FloatArray,
        rate: float = 1.0,
    ) -> SightLines:
        """Return the table after looks at landmarks of known P(exists), without lines to removed places.

        Args:
            places: (P,) sites and (P,) landmarks of the places of the map, sorted by both.
            place: (N,) row of the place of each line, in any order.
            cell: (N,) cell of the sensor.
            hit: (N,) whether it was detected.
            weight: (N,) probability that it was there.
            rate: of the session, see `session_rate`: with half the detections, a look is worth half.
        """
        mine = pair_rows(places, (self.site_id, self.landmark_id))
        kept = mine >= 0  # of others the map has the place no more
        key = np.append(mine[kept] * _SPAN + self.cell[kept], place * _SPAN + cell)
        every, row = np.unique(key, return_inverse=True)
        n_old, n = int(kept.sum()), len(every)
        old, new = row.ravel()[:n_old], row.ravel()[n_old:]
        looks = np.bincount(old, self.looks[kept], n) + np.bincount(new, rate * weight, n)
        hits = np.bincount(old, self.hits[kept], n) + np.bincount(new, weight * hit, n)
        used = looks > 1e-3
        every, looks, hits = every[used], looks[used], hits[used]
        scale = self.rules.most_looks / np.maximum(looks, self.rules.most_looks)
        at = every // _SPAN
        rows = places[0][at], places[1][at], every % _SPAN
        return replace(
            self,
            site_id=rows[0],
            landmark_id=rows[1],
            cell=rows[2],
            hits=hits * scale,
            looks=looks * scale,
        )

    def _around(
        self, places: tuple[IntArray, IntArray], place: IntArray, cell: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """(N,) hits and looks along lines, and along those from the cells around as far as they count."""
        from evermap.sensing.kernels import add_around

        found = np.zeros((len(cell), 2))
        mine = pair_rows(places, (self.site_id, self.landmark_id))
        order = np.argsort(mine * _SPAN + self.cell, kind="stable")
        order = order[mine[order] >= 0]
        key, counted = mine[order] * _SPAN + self.cell[order], np.column_stack([self.hits[order], self.looks[order]])
        shift = np.array([dx * _REACH + dy for dx, dy in _AROUND])
        weight = np.where(shift == 0, 1.0, self.rules.neighbour)
        add_around(key, counted, np.ascontiguousarray(place * _SPAN + cell), shift, weight, found)
        return found[:, 0], found[:, 1]

    def _kinds(self, nominal: float) -> tuple[FloatArray, float]:
        """Rates along clear lines by length, and the share of clear ones, by expectation maximisation.

        What few lines say gives way to what is nominal.
        """
        length, n = _length(self.cell), LONGEST + 1
        worth, rates = self.rules.nominal_looks, self.rules.rates
        voice = np.minimum(1.0, worth / np.maximum(self.looks, 1.0))
        hits, looks = voice * self.hits, voice * self.looks
        free: FloatArray = np.full(n, np.clip(nominal, *rates), dtype=np.float64)
        share, seen = 0.5, _Seen.of(self.hits, self.looks, self.rules)
        for _ in range(ROUNDS if len(self) else 0):
            p_clear = seen.p_clear(share, free, length)
            own = np.bincount(length, p_clear * hits, n), np.bincount(length, p_clear * looks, n)
            share = float((np.sum(p_clear) + 2.0) / (len(p_clear) + 4.0))
            free = np.clip((own[0] + worth * nominal) / (own[1] + worth), *rates)
        return np.asarray(free, dtype=np.float64), share


def pair_rows(known: tuple[IntArray, IntArray], asked: tuple[IntArray, IntArray]) -> IntArray:
    """Return (N,) rows of pairs among (P,) known ones, all different; -1 if there is none."""
    if not len(known[0]):
        return np.full(len(asked[0]), -1, dtype=np.int64)
    number, there = np.zeros(len(known[0]), dtype=np.int64), np.ones(len(asked[0]), dtype=np.bool_)
    wanted = np.zeros(len(asked[0]), dtype=np.int64)
    for one, other in zip(known, asked, strict=True):
        ids, rank = np.unique(one, return_inverse=True)
        at = np.minimum(np.searchsorted(ids, other), len(ids) - 1)
        there &= ids[at] == other
        number, wanted = number * len(ids) + rank.ravel(), wanted * len(ids) + at
    order = np.argsort(number, kind="stable")
    at = np.minimum(np.searchsorted(number[order], wanted), len(order) - 1)
    return np.asarray(np.where(there & (number[order][at] == wanted), order[at], -1))


def offsets(cell: IntArray, cell_m: float) -> FloatArray:
    """Return (N, 2) middles of cells (`SightLines.cells`), counted from the place."""
    middle = np.column_stack([cell // _REACH, cell % _REACH]) - _REACH // 2 + 0.5
    return np.asarray(middle * cell_m, dtype=np.float64)


def nominal_lines(p_detect: FloatArray, rules: SightConfig = USUAL) -> Lines:
    """Return lines of a sensor with its nominal field of view (N,)."""
    nominal = np.clip(np.asarray(p_detect, dtype=np.float64), *rules.rates)
    return Lines(np.ones(len(nominal)), KNOWN * nominal, KNOWN * (1.0 - nominal), rules.p_blocked_detect)


@dataclass(frozen=True, slots=True)
class Views:
    """Last views of the robot: (V,) rows sorted by cell and heading.

    Attributes:
        cell: (V, 2) cell of the sensor on the floor.
        heading: (V,) number of the heading, of `HEADINGS`.
        stamp_s: (V,) end of the last session with a frame from there.
        frames: (V,) frames in that session.
        cell_m: side of a cell.
    """

    cell: IntArray
    heading: IntArray
    stamp_s: FloatArray
    frames: FloatArray
    cell_m: float = 0.5

    def __len__(self) -> int:
        return len(self.heading)

    @classmethod
    def empty(cls, cell_m: float = 0.5) -> Views:
        """Return a table before any look."""
        none = np.zeros(0, dtype=np.int64)
        return cls(np.zeros((0, 2), dtype=np.int64), none, np.zeros(0), np.zeros(0), cell_m)

    @property
    def pose(self) -> FloatArray:
        """(V, 3) middles of the cells, and of the headings."""
        return np.column_stack([(self.cell + 0.5) * self.cell_m, (self.heading + 0.5) * (2.0 * np.pi / HEADINGS)])

    def after(self, stamp_s: float) -> Views:
        """Return the views of sessions that ended after `stamp_s`."""
        newer = self.stamp_s > stamp_s
        if newer.all():
            return self
        columns = self.cell[newer], self.heading[newer], self.stamp_s[newer], self.frames[newer]
        return Views(*columns, self.cell_m)

    def seen_from(self, pose_map_sensor: FloatArray, stamp_s: float, rate: float = 1.0) -> Views:
        """Return the table after a session that ended at `stamp_s`, with sensor poses (F, 3).

        A frame of a session with half the `rate` of detections is worth half.
        """
        cell = np.floor(pose_map_sensor[:, :2] / self.cell_m).astype(np.int64)
        turn = np.floor(np.mod(pose_map_sensor[:, 2], 2.0 * np.pi) * (HEADINGS / (2.0 * np.pi))).astype(np.int64)
        own, counts = np.unique(np.column_stack([cell, turn % HEADINGS]), axis=0, return_counts=True)
        frames = np.append(rate * counts, self.frames)
        both = np.concatenate([own, np.column_stack([self.cell, self.heading])])
        every, first = np.unique(both, axis=0, return_index=True)  # the first of equal rows: those of this session
        stamps = np.append(np.full(len(own), stamp_s), self.stamp_s)[first]
        return Views(every[:, :2], every[:, 2], stamps, frames[first], self.cell_m)


@dataclass(frozen=True, slots=True)
class Glimpses:
    """Where sessions detected something that no landmark has: (K,) rows sorted by cell, one each.

    Attributes:
        position_m: (K, 2) on the floor.
        stamp_s: (K,) end of the last session that detected something there.
    """

    position_m: FloatArray
    stamp_s: FloatArray

    def __len__(self) -> int:
        return len(self.stamp_s)

    @classmethod
    def empty(cls) -> Glimpses:
        """Return a table before any."""
        return cls(np.zeros((0, 2)), np.zeros(0))

    def joined(self, position_m: FloatArray, stamp_s: float, cell_m: float = 0.5) -> Glimpses:
        """Return the table after a session that ended at `stamp_s` and detected something at positions (N, 2); one row
        is kept for each cell of the floor.
        """
        position = np.concatenate([position_m, self.position_m])
        cell = np.floor(position / cell_m).astype(np.int64)
        first = np.unique(cell, axis=0, return_index=True)[1]  # of equal rows, which are those of this session
        return Glimpses(position[first], np.append(np.full(len(position_m), stamp_s), self.stamp_s)[first])

    def last_near(self, position_m: FloatArray, within_m: float) -> float:
        """Return the end of the last session that detected something near a position (2,); -inf if none did."""
        gap = np.linalg.norm(self.position_m - position_m, axis=1)
        return float(self.stamp_s[gap <= within_m].max(initial=-np.inf))


def session_rate(hit: BoolArray, p_detect: FloatArray, weight: FloatArray, rules: SightConfig = USUAL) -> float:
    """Return how often a session detects, over what lines of sight lead to expect.

    Sensors differ between robots, and lenses get dirty. The posterior mean of a factor common to all lines on a grid;
    a priori it is 1 or, as probably, smaller: half of a log-normal distribution. It is not larger, so that a miss never
    says more than the lines of the map tell.

    Args:
        hit: (N,) detections of what was there for certain.
        p_detect: (N,) how probable they were, by what earlier sessions saw along the same lines.
        weight: (N,) of each look, as consecutive ones are not independent.
        rules: `rate_sigma`; 0 gives a factor of 1.
    """
    if rules.rate_sigma == 0.0 or not len(hit):
        return 1.0
    percent = np.minimum((100.0 * p_detect).astype(np.int64), 99)
    hits, misses = (np.bincount(percent[some], weight[some], 100) for some in (hit, ~hit))
    factor = np.append(1.0, _FACTORS)
    p = np.minimum(factor[:, None] * (np.arange(100) + 0.5) / 100.0, rules.highest_rate)
    slab = np.exp(-0.5 * (np.log(_FACTORS) / rules.rate_sigma) ** 2)
    log_p = np.log(p) @ hits + np.log1p(-p) @ misses + np.log(np.append(1.0, slab / slab.sum()))
    likely = np.exp(log_p - log_p.max())
    return float(factor @ likely / likely.sum())


class _Seen(NamedTuple):
    """What was seen along N lines, for the probability that they are clear (beta-binomial).

    Attributes:
        hits, misses: (N,) weighted detections and misses.
        strength: looks that the rate of a clear line is worth.
        log_blocked: (N,) log likelihood if they are blocked.
    """

    hits: FloatArray
    misses: FloatArray
    strength: float
    log_blocked: FloatArray

    @classmethod
    def of(cls, hits: FloatArray, looks: FloatArray, rules: SightConfig) -> _Seen:
        """Return what hits (N,) and looks (N,) say."""
        seen = cls(hits, np.maximum(looks - hits, 0.0), rules.strength, hits)
        return seen._replace(log_blocked=seen._log_likelihood(np.array([rules.p_blocked_detect]), slice(None)))

    def p_clear(self, prior: float, rate: FloatArray, kind: IntArray | slice = slice(None)) -> FloatArray:
        """Return the (N,) probability of being clear, by rates (K,) and the kind (N,) of each line, else one each."""
        from scipy.special import expit

        odds = self._log_likelihood(rate, kind) - self.log_blocked
        return np.asarray(expit(np.log(prior / (1.0 - prior)) + odds))

    def _log_likelihood(self, rate: FloatArray, kind: IntArray | slice) -> FloatArray:
        from scipy.special import gammaln

        a, b = self.strength * rate, self.strength * (1.0 - rate)
        of_hits = gammaln(a[kind] + self.hits) - gammaln(a)[kind]
        return np.asarray(of_hits + gammaln(b[kind] + self.misses) - gammaln(b)[kind])


def _length(cell: IntArray) -> IntArray:
    """(N,) lengths of lines of sight in cells, at most `LONGEST`."""
    dx, dy = cell // _REACH - _REACH // 2, cell % _REACH - _REACH // 2
    return np.asarray(np.minimum(np.rint(np.hypot(dx + 0.5, dy + 0.5)).astype(np.int64), LONGEST))
