"""A lifetime whose hazard is any function of time (Rosen 2016, section V-B, belief shaping)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from evermap.errors import ConfigError
from evermap.survival.base import Lifetime, check_positive, check_rates, check_times
from evermap.survival.logmath import gauss_legendre
from evermap.types import FloatArray

_NODES = 16
_PANELS_PER_DECADE = 8
_MOST_PANELS = 50_000
_TOLERANCE = 1e-12
_FIRST_PANEL = 1e-9
"""End of the first panel: in seconds, or as a share of the horizon if that is less."""
_NEAR_ZERO = 1e-20
"""Width, relative to the first panel, of a panel from 0 that is not halved again (powers of t never converge)."""
_NEGLIGIBLE = 1e-9
"""Largest share of the first panel's integral that such a panel may hold."""
_JUMP_WIDTH = 1e-13
"""Relative width at which a panel that still does not converge is taken to hold a jump."""


@dataclass(frozen=True, slots=True)
class CallableHazard(Lifetime):
    """`h(t) = function(t)` up to `horizon_s`, and the constant `rate_after` from then on.

    The hazard is integrated once, by Gauss-Legendre quadrature on panels that grow with t and are halved until the
    integral of each is known to a relative 1e-12. Jumps are found by halving; a peak that is much narrower than a
    tenth of its own time may be missed: name its ends in `breaks_s`.

    Attributes:
        function: hazard in 1/s for an array of seconds (or one value for all), none negative, finite near 0.
        horizon_s: the function is evaluated up to here, in seconds, positive.
        rate_after: hazard beyond, in 1/s; None for the function's value at the horizon. 0: the rest never leave.
        breaks_s: times at which the function jumps or kinks, in any order.
    """

    function: Callable[[FloatArray], FloatArray | float]
    horizon_s: float
    rate_after: float | None = None
    breaks_s: tuple[float, ...] = ()
    _edges: FloatArray = field(init=False, repr=False, compare=False)
    _before: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_positive(self.horizon_s, "horizon_s")
        check_times(self.breaks_s, "breaks_s")
        if self.rate_after is None:
            object.__setattr__(self, "rate_after", float(self._evaluate(np.array([self.horizon_s]))[0]))
        check_rates((self._rate_after,), "rate_after")
        edges, integrals = self._refine(self._first_edges())
        object.__setattr__(self, "_edges", edges)
        # Differences of this running sum are taken later: its extra digits are what they keep.
        running = np.concatenate(([0.0], np.cumsum(integrals.astype(np.longdouble))))
        object.__setattr__(self, "_before", running)

    @property
    def p_never_leaves(self) -> float:
        return math.exp(-float(self._before[-1])) if self._rate_after == 0.0 else 0.0

    def mean(self) -> float:
        survival = math.exp(-float(self._before[-1]))
        if survival > 0.0 and self._rate_after == 0.0:
            return math.inf
        nodes, weights = gauss_legendre(24)
        left, width = self._edges[:-1], np.diff(self._edges)
        t = left[:, None] + width[:, None] * nodes
        within = float(np.sum(width * (np.exp(-self._integrated_hazard(np.zeros_like(t), t)) @ weights)))
        return within + (survival / self._rate_after if survival > 0.0 else 0.0)

    @property
    def _rate_after(self) -> float:
        return math.nan if self.rate_after is None else self.rate_after

    def _evaluate(self, t: FloatArray) -> FloatArray:
        """Evaluate the user's function on an array, and check its values."""
        values = np.asarray(self.function(t), dtype=np.float64)
        if values.shape not in {(), t.shape}:
            raise ConfigError(
                f"gives shape {values.shape} for times of shape {t.shape}",
                field="hazard",
                hint="numpy.vectorize(function)",
            )
        values = np.broadcast_to(values, t.shape)
        good = np.isfinite(values) & (values >= 0.0)
        if not good.all():
            where = tuple(np.argwhere(~good)[0])
            raise ConfigError(
                f"a hazard must be finite and not negative: h({float(t[where])!r}) = {float(values[where])!r}",
                field="hazard",
            )
        return values

    def _first_edges(self) -> FloatArray:
        first = _FIRST_PANEL * min(1.0, self.horizon_s)
        count = math.ceil(_PANELS_PER_DECADE * math.log10(self.horizon_s / first)) + 1
        inner = [t for t in self.breaks_s if 0.0 < t < self.horizon_s]
        return np.unique(
            np.concatenate(([0.0], np.geomspace(first, self.horizon_s, count)[:-1], inner, [self.horizon_s]))
        )

    def _refine(self, edges: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Halve panels until each integral equals that of its halves; return edges (P + 1,) and integrals (P,)."""
        open_left, open_right = edges[:-1], edges[1:]
        done_left: list[FloatArray] = []
        done_integral: list[FloatArray] = []
        panels = 0
        for _ in range(100):
            middle = 0.5 * (open_left + open_right)
            halves = self._quadrature(open_left, middle) + self._quadrature(middle, open_right)
            error = np.abs(self._quadrature(open_left, open_right) - halves)
            width = open_right - open_left
            smallest = (open_left == 0.0) & (width <= _NEAR_ZERO * edges[1])
            good = (error <= _TOLERANCE * halves) | (width <= _JUMP_WIDTH * open_right) | smallest
            done_left.append(open_left[good])
            done_integral.append(halves[good])
            panels += int(good.sum())
            if good.all():
                left = np.concatenate(done_left)
                order = np.argsort(left)
                refined, integral = np.append(left[order], self.horizon_s), np.concatenate(done_integral)[order]
                if smallest.any() and integral[0] > _NEGLIGIBLE * integral[refined[:-1] < edges[1]].sum():
                    break  # like 1/t: the integral diverges at 0
                return refined, integral
            bad = ~good
            open_left, open_right = (
                np.concatenate((open_left[bad], middle[bad])),
                np.concatenate((middle[bad], open_right[bad])),
            )
            if panels + len(open_left) > _MOST_PANELS:
                break
        raise ConfigError(
            f"its integral does not converge near t = {float(open_right[0])!r} s",
            field="hazard",
            hint="a shorter horizon, a hazard that is finite near 0, or PeriodicHazard for one that repeats",
        )

    def _quadrature(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Integrate the hazard over intervals that lie within one panel each."""
        nodes, weights = gauss_legendre(_NODES)
        width = b - a
        return np.asarray(width * (self._evaluate(a[..., None] + width[..., None] * nodes) @ weights))

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        x, y = np.minimum(a, self.horizon_s), np.minimum(b, self.horizon_s)
        last = len(self._edges) - 2
        in_x = np.clip(np.searchsorted(self._edges, x, side="right") - 1, 0, last)
        in_y = np.clip(np.searchsorted(self._edges, y, side="right") - 1, 0, last)
        same = in_x == in_y
        head = self._quadrature(x, np.where(same, y, self._edges[in_x + 1]))
        between = (self._before[in_y] - self._before[np.minimum(in_x + 1, in_y)]).astype(np.float64)
        tail = self._quadrature(np.where(same, y, self._edges[in_y]), y)
        beyond = self._rate_after * (np.maximum(b, self.horizon_s) - np.maximum(a, self.horizon_s))
        return np.asarray(head + between + tail + beyond)

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        inside = self._evaluate(np.minimum(t, self.horizon_s))
        return np.asarray(np.log(np.where(t < self.horizon_s, inside, self._rate_after)))
