"""The product-limit estimate of right censored lifetimes (Kaplan and Meier 1958), with delayed entry.

It equals the nonparametric maximum likelihood estimate where every end was either observed or never seen, and its
uncertainty has closed forms.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import DataError
from evermap.show import ShownTable
from evermap.survival.base import SurvivalEstimate, check_open_share, check_times
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.step import StepLifetime
from evermap.types import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class KaplanMeier(SurvivalEstimate, ShownTable):
    """A survival function with D steps.

    Attributes:
        time_s: (D,) in seconds, increasing; empty where no end was observed.
        at_risk: (D,) weight of the samples known to be present just before, and entered by then.
        deaths: (D,) weight of the samples that ended.
        survives: (D,) `P(T > time)`.
        log_variance: (D,) Greenwood's variance of `log P(T > time)`; `inf` where none is left.
    """

    time_s: FloatArray
    at_risk: FloatArray
    deaths: FloatArray
    survives: FloatArray
    log_variance: FloatArray

    def survival(self, t: ArrayLike) -> FloatArray:
        """Return `P(T > t)` for times in seconds."""
        return np.asarray(self._at(t, self.survives, 1.0))[()]

    def variance(self, t: ArrayLike) -> FloatArray:
        """Return Greenwood's variance of `P(T > t)`; 0 before the first death and where none is left."""
        values = np.where(self.survives > 0.0, np.square(self.survives), 0.0)
        spread = np.where(values > 0.0, self.log_variance, 0.0)
        return np.asarray(self._at(t, values * spread, 0.0))[()]

    def band(self, t: ArrayLike, confidence: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Return pointwise lower and upper bounds of `P(T > t)`, on the scale of `log(-log S)`.

        Both are 1 before the first death, and both 0 where none is left: this scale has no width there.

        Raises:
            ConfigError: `confidence` is not in (0, 1).
        """
        check_open_share(confidence)
        some = (self.survives > 0.0) & (self.survives < 1.0)
        log_survival = np.log(np.where(some, self.survives, 0.5))
        half_width = NormalDist().inv_cdf(0.5 + 0.5 * confidence) * np.sqrt(np.where(some, self.log_variance, 0.0))
        bounds = (np.exp(log_survival * np.exp(sign * half_width / -log_survival)) for sign in (1.0, -1.0))
        lower, upper = (self._at(t, np.where(some, bound, self.survives), 1.0) for bound in bounds)
        return lower[()], upper[()]

    def prior(self) -> StepLifetime:
        """Return it as a lifetime prior; what is left after the last death never leaves."""
        left = np.append(self.survives, 0.0)
        masses = -np.diff(np.concatenate(([1.0], left)))
        return StepLifetime.at_points((*self.time_s.tolist(), np.inf), masses.tolist())

    def _at(self, t: ArrayLike, values: FloatArray, first: float) -> FloatArray:
        rows = np.searchsorted(self.time_s, check_times(t), side="right")
        return np.asarray(np.concatenate(([first], values))[rows])


def kaplan_meier(data: CensoredLifetimes) -> KaplanMeier:
    """Compute the product-limit estimate; samples censored or entering at the time of a death count as after it.

    Raises:
        DataError: a lifetime is neither exact nor right censored; names the row (from 0).
    """
    exact, counted = data.exact, data.weight > 0.0
    bad = counted & ~exact & np.isfinite(data.right_s)
    if bad.any():
        row = int(np.argmax(bad))
        raise DataError(
            f"neither exact nor right censored: ({data.left_s[row]:g}, {data.right_s[row]:g}], row {row}",
            field="right_s",
            hint="the Turnbull estimate, which takes intervals",
        )
    # A right censored sample that entered after its last sighting was seen at the entry.
    seen_until = np.maximum(data.left_s, data.entry_s)
    died = exact & counted
    time_s, which = np.unique(data.right_s[died], return_inverse=True)
    deaths = np.bincount(which, data.weight[died], time_s.size).astype(np.float64)
    at_risk = _weight_at_least(seen_until, data.weight, time_s) - _weight_at_least(data.entry_s, data.weight, time_s)
    at_risk = np.asarray(np.maximum(at_risk, deaths))
    left = at_risk - deaths
    left = np.where(left > 1e-12 * at_risk, left, 0.0)  # where all end, what is left is rounding
    with np.errstate(divide="ignore"):
        log_variance = np.asarray(np.cumsum(deaths / (at_risk * left)), np.float64)
    return KaplanMeier(time_s, at_risk, deaths, np.asarray(np.cumprod(left / at_risk), np.float64), log_variance)


def _weight_at_least(values: FloatArray, weight: FloatArray, times: FloatArray) -> FloatArray:
    """Return, for each time, the weight of all values that are not smaller."""
    order = np.argsort(values)
    total = np.append(np.cumsum(weight[order][::-1])[::-1], 0.0)
    return np.asarray(total[np.searchsorted(values[order], times, side="left")])
