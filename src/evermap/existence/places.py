"""Objects that go from place to place: where each will be, learned from their stays.

    log h(age, hour, place) = age(a) + week(w) + own_place(hour)

is the hazard of leaving a place: a smooth function of the age of the stay and one of the time of the week, which all
places share (`rhythm.fit`), and what a place has of its own over the day, a Gaussian whose variance is learned over all
places: a place that was seen little is like the others. Where an object goes to is as smooth:

    log P(to | from, hour) = pair(from, to) + flow_to(hour) + constant

with the same kind of pooling. An unseen end lies between two sightings and is distributed there by the model
(expectation maximisation). A forecast is the forward equation of this semi-Markov chain in steps of ten minutes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import DataError
from evermap.existence.rhythm import (
    BIN_S,
    BINS,
    BINS_OF_DAY,
    SmoothRates,
    age_basis,
    bin_of_week,
    cyclic_spline,
    fit,
    week_basis,
)
from evermap.show import Shown
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray

AGE_EDGES_S = np.concatenate([[0.0], np.geomspace(BIN_S, 60.0 * 86400.0, 31)])
"""Ages of a stay between which the hazard is constant."""
_AGE_KNOTS = 10
_DAY_BLOCKS = 24
_OWN_KNOTS = 6
_ROUNDS, _POOLING_ROUNDS, _NEWTON = 4, 12, 8
_STRONGEST, _WEAKEST = 1e4, 1e-2
"""Range of the precisions that are learned."""


@dataclass(frozen=True, slots=True)
class PlaceStays(Shown):
    """N stays of objects at P places.

    Attributes:
        place: (N,) index of the place.
        from_s: (N,) when it came, in local wall time; nan where that is not known: it tells only where it went.
        until_s: (N,) when it was last there.
        gone_s: (N,) when it was first elsewhere: `until_s` where it was seen to leave, inf where it is still there.
        next_place: (N,) where it was then, `UNKNOWN` where it is still there.
        n_places: P.
    """

    place: IntArray
    from_s: FloatArray
    until_s: FloatArray
    gone_s: FloatArray
    next_place: IntArray
    n_places: int

    def __post_init__(self) -> None:
        if not len(self.place):
            raise DataError("there is no stay to learn from")
        if np.any(self.gone_s < self.until_s) or np.any(self.until_s < self.from_s):
            raise DataError("a stay ends before it began", field="until_s")

    def __len__(self) -> int:
        return len(self.place)


@dataclass(frozen=True)
class PlaceChain(Shown):
    """How long objects stay at P places, and where they go.

    Attributes:
        hazard_hz: (P, A, 48) hazard of leaving a place, by age (`AGE_EDGES_S`) and by hour of a working day (0 to 23)
            and of the weekend (24 to 47).
        destinations: (48, P, P) probability of each next place, by hour and place.
    """

    hazard_hz: FloatArray
    destinations: FloatArray

    @classmethod
    def learn(cls, stays: PlaceStays) -> PlaceChain:
        """Learn from stays; unseen ends are placed by what the others tell.

        Raises:
            DataError: no stay whose beginning is known, or none that ended.
        """
        from scipy.special import softmax

        timed = np.isfinite(stays.from_s)
        if not timed.any() or not np.any(stays.next_place != UNKNOWN):
            raise DataError("no stay was seen from its beginning, or none ended", hint="longer records")
        cells = _Cells.of(stays, timed)
        own = np.zeros((stays.n_places, 2 * _DAY_BLOCKS))
        rates: SmoothRates | None = None
        basis = age_basis(np.log(0.5 * (AGE_EDGES_S[:-1] + AGE_EDGES_S[1:])), _AGE_KNOTS)
        for _ in range(_ROUNDS):
            events, exposure = cells.tables(rates, own)
            rates = fit(events, exposure, basis, week_basis(), rates)
            own = _pool(*cells.by_place(rates, own))
        assert rates is not None
        went = stays.next_place != UNKNOWN
        when = np.where(np.isfinite(stays.gone_s), 0.5 * (stays.until_s + stays.gone_s), stays.until_s)[went]
        counts = np.zeros((stays.n_places, stays.n_places, 2 * _DAY_BLOCKS))
        np.add.at(counts, (stays.place[went], stays.next_place[went], _block(bin_of_week(when))), 1.0)
        week = np.array([rates.log_week[np.equal(_HOURS, block)].mean() for block in range(2 * _DAY_BLOCKS)])
        log_hazard = rates.log_age[None, :, None] + (week + own)[:, None, :]
        pair, flow = _fit_destinations(counts)
        return cls(np.exp(log_hazard), softmax(pair[None] + flow.T[:, None, :], axis=-1))

    @property
    def n_places(self) -> int:
        """P."""
        return len(self.hazard_hz)

    def forecast(self, place: ArrayLike, age_s: ArrayLike, now_s: float, horizons_s: ArrayLike) -> FloatArray:
        """Return (N, H, P) probabilities of where N objects will be after H times.

        Args:
            place: (N,) where each is at `now_s`.
            age_s: (N,) since when.
            now_s: local wall time.
            horizons_s: (H,) in ascending order.
        """
        at, age, horizons = np.asarray(place), np.asarray(age_s, dtype=np.float64), np.asarray(horizons_s)
        n, a = len(at), len(AGE_EDGES_S) - 1
        mass = np.zeros((n, self.n_places, a))
        mass[np.arange(n), at, age_bins(age)] = 1.0
        older = np.minimum(BIN_S / np.diff(AGE_EDGES_S), 1.0)
        older[-1] = 0.0
        out = np.empty((n, len(horizons), self.n_places))
        steps = np.maximum(np.rint(horizons / BIN_S).astype(np.int64), 1)
        done = 0
        for h, until in enumerate(steps.tolist()):
            for step in range(done, until):
                block = int(_block(bin_of_week(now_s + (step + 0.5) * BIN_S)))
                stay = np.exp(-self.hazard_hz[:, :, block] * BIN_S)
                left = mass - mass * stay
                arrived = left.sum(axis=2) @ self.destinations[block]
                mass *= stay
                on = mass * older
                mass -= on
                mass[:, :, 1:] += on[:, :, :-1]
                mass[:, :, 0] += arrived
            done = until
            out[:, h] = mass.sum(axis=2)
        return out

    def log_leaving(self, place: int, age_s: float, now_s: float, leaves_s: float, goes_to: int | None) -> float:
        """Return the log probability that an object leaves within ten minutes of an instant, and for where.

        Args:
            place: where it is at `now_s`.
            age_s: since when.
            now_s: local wall time.
            leaves_s: when it leaves, or until when it does not.
            goes_to: its next place; None where it did not leave.
        """
        times = np.arange(now_s, leaves_s, BIN_S)
        lasts = np.minimum(leaves_s - times, BIN_S)
        hazards = self.hazard_hz[place, age_bins(times - now_s + age_s), _block(bin_of_week(times + 0.5 * lasts))]
        log_p = -float(np.sum(hazards * lasts))
        if goes_to is None:
            return log_p
        block = int(_block(bin_of_week(leaves_s)))
        rate = self.hazard_hz[place, int(age_bins(np.array(leaves_s - now_s + age_s))), block]
        return log_p + float(np.log(rate * BIN_S) + np.log(self.destinations[block, place, goes_to]))


_HOURS = np.where(
    np.arange(BINS) // BINS_OF_DAY >= 5, _DAY_BLOCKS, 0
) + (np.arange(BINS) % BINS_OF_DAY) * _DAY_BLOCKS // BINS_OF_DAY  # fmt: skip


def _block(week_bin: IntArray) -> IntArray:
    """Return the hour of a working day (0 to 23) or of the weekend (24 to 47)."""
    return np.asarray(_HOURS[week_bin])


def age_bins(age_s: FloatArray) -> IntArray:
    """Return which stretch of `AGE_EDGES_S` ages are in."""
    return np.clip(np.searchsorted(AGE_EDGES_S, age_s, side="right") - 1, 0, len(AGE_EDGES_S) - 2)


@dataclass(frozen=True, slots=True)
class _Cells:
    """PlaceStays cut into ten minutes each: M cells in the order of N stays.

    Attributes:
        stay, place, age, week: (M,) of each cell.
        spent_s: (M,) how much of it was stayed for sure, if the stay lasts to it.
        end: (M,) 1 where a seen end lies, 0 else.
        may_end: (M,) whether the end may lie in it, unseen.
        n_places: number of places.
    """

    stay: IntArray
    place: IntArray
    age: IntArray
    week: IntArray
    spent_s: FloatArray
    end: FloatArray
    may_end: BoolArray
    n_places: int

    @classmethod
    def of(cls, stays: PlaceStays, timed: BoolArray) -> _Cells:
        """Cut stays, of which some (N,) are `timed`: seen from their beginning on."""
        rows = np.flatnonzero(timed)
        begin, until = stays.from_s[rows], stays.until_s[rows]
        last = np.where(np.isfinite(stays.gone_s[rows]), stays.gone_s[rows], until)
        count = np.maximum(np.ceil((last - begin) / BIN_S).astype(np.int64), 1)
        stay = np.repeat(np.arange(len(rows)), count)
        k = np.arange(len(stay)) - np.repeat(np.cumsum(count) - count, count)
        start = begin[stay] + k * BIN_S
        end_s = np.minimum(start + BIN_S, last[stay])
        seen = (stays.next_place[rows] != UNKNOWN) & (stays.gone_s[rows] <= until)
        unseen = np.isfinite(stays.gone_s[rows]) & ~seen
        is_last = k == count[stay] - 1
        return cls(
            stay, stays.place[rows][stay], age_bins(start - begin[stay]), bin_of_week(0.5 * (start + end_s)),
            end_s - start, (is_last & seen[stay]).astype(np.float64),
            unseen[stay] & (end_s > until[stay]), stays.n_places,
        )  # fmt: skip

    def _expect(self, rates: SmoothRates | None, own: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (M,) expected ends in each cell, and (M,) expected time spent there."""
        hazard = np.full(len(self.stay), 1e-5)
        if rates is not None:
            log_rate = rates.log_age[self.age] + rates.log_week[self.week] + own[self.place, _block(self.week)]
            hazard = np.exp(log_rate)
        ends = np.where(self.may_end, hazard * self.spent_s, 0.0)
        through = np.cumsum(ends)
        first = np.searchsorted(self.stay, np.arange(self.stay[-1] + 1))
        before = through - ends - (through - ends)[first][self.stay]
        density = np.where(self.may_end, -np.expm1(-ends) * np.exp(-before), 0.0)
        total = np.bincount(self.stay, density)
        share = density / np.where(total > 0.0, total, 1.0)[self.stay]
        passed = np.cumsum(share)
        passed -= (passed - share)[first][self.stay]
        left = np.where(self.may_end, np.maximum(1.0 - passed + 0.5 * share, 0.0), 1.0)
        return self.end + share, self.spent_s * left

    def tables(self, rates: SmoothRates | None, own: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (A, 1008) expected ends, and exposure times the factors of the places."""
        ends, spent = self._expect(rates, own)
        shape = (len(AGE_EDGES_S) - 1, BINS)
        flat = self.age * BINS + self.week
        factor = np.exp(own[self.place, _block(self.week)])
        size = shape[0] * shape[1]
        found = np.bincount(flat, ends, size), np.bincount(flat, spent * factor, size)
        return np.asarray(found[0].reshape(shape), dtype=np.float64), np.asarray(
            found[1].reshape(shape), dtype=np.float64
        )

    def by_place(self, rates: SmoothRates, own: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (P, 48) ends by place and hour, and how many the shared hazard expects."""
        ends, spent = self._expect(rates, own)
        shape = (self.n_places, 2 * _DAY_BLOCKS)
        flat = self.place * shape[1] + _block(self.week)
        expected = spent * np.exp(rates.log_age[self.age] + rates.log_week[self.week])
        size = shape[0] * shape[1]
        found = np.bincount(flat, ends, size), np.bincount(flat, expected, size)
        return np.asarray(found[0].reshape(shape), dtype=np.float64), np.asarray(
            found[1].reshape(shape), dtype=np.float64
        )


def _own_columns() -> tuple[FloatArray, tuple[slice, ...]]:
    """Return (48, K) columns of what is a place's own: a level, a curve of the day, another at the weekend."""
    curve = cyclic_spline((np.arange(_DAY_BLOCKS) + 0.5) / _DAY_BLOCKS, _OWN_KNOTS)
    none = np.zeros_like(curve)
    columns = np.hstack([np.ones((2 * _DAY_BLOCKS, 1)), np.vstack([curve, curve]), np.vstack([none, curve])])
    return columns, (slice(0, 1), slice(1, 1 + _OWN_KNOTS), slice(1 + _OWN_KNOTS, 1 + 2 * _OWN_KNOTS))


def _pool(events: FloatArray, expected: FloatArray) -> FloatArray:
    """Return (P, 48) log factors of most probable counts, Gaussian with variances that are learned over all places."""
    columns, parts = _own_columns()
    theta = np.zeros((len(events), columns.shape[1]))
    precision = np.ones(len(parts))
    for _ in range(_POOLING_ROUNDS):
        penalty = np.zeros(columns.shape[1])
        for part, w in zip(parts, precision, strict=True):
            penalty[part] = w
        spread = np.zeros_like(theta)
        for p in range(len(events)):
            for _ in range(_NEWTON):
                rate = expected[p] * np.exp(np.clip(columns @ theta[p], -8.0, 8.0))
                information = (columns.T * rate) @ columns + np.diag(penalty)
                step = np.linalg.solve(information, columns.T @ (events[p] - rate) - penalty * theta[p])
                theta[p] += np.clip(step, -2.0, 2.0)
            spread[p] = np.diag(np.linalg.inv(information))
        squares = theta**2 + spread
        precision = np.array([np.clip(1.0 / squares[:, part].mean(), _WEAKEST, _STRONGEST) for part in parts])
    return np.asarray(theta @ columns.T)


def _fit_destinations(counts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (P, P) log preferences of pairs and (P, 48) log factors of destinations over the hours.

    Args:
        counts: (P, P, 48) moves by place, destination and hour.
    """
    from scipy.optimize import minimize
    from scipy.special import softmax

    n = len(counts)
    columns, _ = _own_columns()
    columns = columns[:, 1:]
    k = columns.shape[1]
    overall = counts.sum(axis=(0, 2)) + 0.5
    base = np.log(overall / overall.sum())
    of_pair, of_flow = counts.sum(axis=2), counts.sum(axis=0)
    trips = counts.sum(axis=1)
    pair, flow = np.zeros((n, n)), np.zeros((n, k))
    sigma2, tau2 = 1.0, 0.3

    def loss(x: FloatArray) -> tuple[float, FloatArray]:
        a, c = x[: n * n].reshape(n, n), x[n * n :].reshape(n, k)
        hours = c @ columns.T
        logits = (base + a)[:, :, None] + hours[None]
        top = logits.max(axis=1, keepdims=True)
        weight = np.exp(logits - top)
        total = weight.sum(axis=1, keepdims=True)
        expected = weight / total * trips[:, None, :]
        value = -float((of_pair * (base + a)).sum() + (of_flow * hours).sum())
        value += float((trips * (np.log(total) + top)[:, 0]).sum())
        value += 0.5 * float((a**2).sum() / sigma2 + (c**2).sum() / tau2)
        gradient_a = expected.sum(axis=2) - of_pair + a / sigma2
        gradient_c = (expected.sum(axis=0) - of_flow) @ columns + c / tau2
        return value, np.concatenate([gradient_a.ravel(), gradient_c.ravel()])

    for _ in range(_ROUNDS):
        start = np.concatenate([pair.ravel(), flow.ravel()])
        found = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 200})
        pair, flow = found.x[: n * n].reshape(n, n), found.x[n * n :].reshape(n, k)
        share = softmax((base + pair)[None] + (columns @ flow.T)[:, None, :], axis=-1)  # (48, P, P)
        spread = share * (1.0 - share) * trips.T[:, :, None]
        of_a = 1.0 / (spread.sum(axis=0) + 1.0 / sigma2)
        of_c = 1.0 / (np.einsum("bd,bk->dk", spread.sum(axis=1), columns**2) + 1.0 / tau2)
        sigma2 = float(np.clip((pair**2 + of_a).mean(), 1.0 / _STRONGEST, 1.0 / _WEAKEST))
        tau2 = float(np.clip((flow**2 + of_c).mean(), 1.0 / _STRONGEST, 1.0 / _WEAKEST))
    return base + pair, np.asarray(flow @ columns.T)
