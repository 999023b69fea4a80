"""Probability mass on points and intervals, the form of nonparametric estimates (MATH.md section 6)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import ConfigError
from evermap.survival.base import Lifetime, Seed, check_times
from evermap.types import FloatArray

_CHUNK = 1_000_000
"""Rows times steps that are computed at once, at most."""


@dataclass(frozen=True, slots=True)
class StepLifetime(Lifetime):
    """`P(starts_s[i] < T <= ends_s[i]) = masses[i]`, spread evenly; a point where start and end agree.

    An end of `inf` means that this mass never leaves, whatever its start. `S(t) = P(T > t)` has already dropped at a
    point of mass. Intervals may overlap and come in any order.

    Attributes:
        starts_s: in seconds, finite or not, none negative; points lie above 0.
        ends_s: in seconds, `>= starts_s`, possibly `inf`.
        masses: probabilities, none negative, of sum 1.
    """

    starts_s: tuple[float, ...]
    ends_s: tuple[float, ...]
    masses: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("starts_s", "ends_s", "masses"):
            object.__setattr__(self, name, tuple(float(value) for value in getattr(self, name)))
        if not len(self.starts_s) == len(self.ends_s) == len(self.masses) > 0:
            raise ConfigError("starts, ends and masses must be equally many, at least one", field="masses")
        for row, (start, end, mass) in enumerate(zip(self.starts_s, self.ends_s, self.masses, strict=True)):
            if not (0.0 <= start <= end and end > 0.0):
                raise ConfigError(
                    f"0 <= start <= end and end > 0 must hold, row {row} is ({start}, {end}]", field="ends_s"
                )
            if not (math.isfinite(mass) and mass >= 0.0):
                raise ConfigError(f"a mass must be finite and not negative, row {row} is {mass!r}", field="masses")
        if abs(math.fsum(self.masses) - 1.0) > 1e-9:
            raise ConfigError(f"masses must sum to 1, not {math.fsum(self.masses)!r}", field="masses")

    @classmethod
    def at_points(cls, times_s: Sequence[float], masses: Sequence[float]) -> Self:
        """Put all mass on points; `inf` is the point of what never leaves."""
        return cls(tuple(times_s), tuple(times_s), tuple(masses))

    @property
    def p_never_leaves(self) -> float:
        return math.fsum(mass for end, mass in zip(self.ends_s, self.masses, strict=True) if math.isinf(end))

    def mean(self) -> float:
        if self.p_never_leaves > 0.0:
            return math.inf
        rows = zip(self.starts_s, self.ends_s, self.masses, strict=True)
        return math.fsum(m * 0.5 * (s + e) for s, e, m in rows if m > 0.0)

    def sample(self, rng: Seed, size: int | tuple[int, ...] | None = None) -> FloatArray:
        generator = np.random.default_rng(rng)
        starts, ends, masses = np.array((self.starts_s, self.ends_s, self.masses))
        row = np.asarray(generator.choice(len(masses), size=size, p=masses / masses.sum()))
        share = 1.0 - np.asarray(generator.random(size))  # in (0, 1], as the intervals are
        finite = np.isfinite(ends)
        starts, widths = np.where(finite, starts, np.inf), np.where(finite, ends - np.where(finite, starts, 0.0), 0.0)
        return np.asarray(starts[row] + widths[row] * share)[()]

    def log_density(self, t: ArrayLike) -> FloatArray:
        values = check_times(t)
        with np.errstate(all="ignore"):
            return np.asarray(np.log(self._density(values)))[()]

    def _density(self, t: FloatArray) -> FloatArray:
        starts, ends, masses = np.array((self.starts_s, self.ends_s, self.masses))
        at = t[..., None]
        inside = (at >= starts) & (at < ends) & np.isfinite(ends)
        even = np.where(inside, masses / np.where(inside, ends - starts, 1.0), 0.0)
        return np.asarray(np.where((at == starts) & (at == ends) & (masses > 0.0), np.inf, even).sum(axis=-1))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        survival = self._alive_and_dying(t, t)[0]
        return np.where(survival > 0.0, np.log(self._density(t) / survival), np.inf)

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        alive, dying = self._alive_and_dying(a, b)
        later = self._alive_and_dying(b, b)[0]
        died = dying / alive
        value = np.where(died < 0.5, -np.log1p(-died), np.log(alive) - np.log(later))
        value = np.where((alive > 0.0) & (later > 0.0), value, np.inf)
        return np.where(a == b, 0.0, value)

    def _alive_and_dying(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return `S(a)` and `P(a < T <= b)`, each as a sum of parts of the masses, so that nothing cancels."""
        starts, ends, masses = np.array((self.starts_s, self.ends_s, self.masses))
        starts = np.where(np.isfinite(ends), starts, np.inf)
        point = starts == ends
        width = np.where(point, 1.0, ends - starts)
        rows = max(1, _CHUNK // len(masses))
        alive, dying = np.empty(a.size), np.empty(a.size)
        for at in range(0, a.size, rows):
            x, y = a.reshape(-1, 1)[at : at + rows], b.reshape(-1, 1)[at : at + rows]
            left = np.where(point, x < ends, np.clip(ends - np.maximum(x, starts), 0.0, None) / width)
            within = np.clip(np.minimum(y, ends) - np.maximum(x, starts), 0.0, None) / width
            alive[at : at + rows] = left @ masses
            dying[at : at + rows] = np.where(point, (x < ends) & (ends <= y), within) @ masses
        return alive.reshape(a.shape), dying.reshape(a.shape)

    def _time_of_log_hazard(self, log_target: FloatArray) -> FloatArray:
        # A probability that equals a sum of masses up to its last digit belongs to that point, not to the next one.
        rough = Lifetime._time_of_log_hazard(self, log_target - 1e-13)
        corners = np.unique([t for t in (*self.starts_s, *self.ends_s) if math.isfinite(t)] or [0.0])
        nearest = corners[np.argmin(np.abs(rough[..., None] - corners), axis=-1)]
        # Bisection ends a few last digits away from a point of mass; the quantile is the point itself.
        return np.where(np.abs(rough - nearest) <= 1e-12 * nearest, nearest, rough)


def never_leaves() -> StepLifetime:
    """Return the prior of objects that never leave, such as walls."""
    return StepLifetime.at_points((math.inf,), (1.0,))
