"""Figures 1 and 2 of Rosen 2016: one feature's belief over time, and hazards that shape a belief.

The paper gives the text of both figures, but neither the looks of figure 1 nor the numbers behind figure 2. What is
not stated is chosen here, and named in the figure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from evermap.existence.one_stay import PersistenceFilter
from evermap.survival import Exponential, GeneralPurpose, LifetimePrior, PeriodicHazard
from evermap.types import BoolArray, FloatArray
from evermap.viz.lifetime_figures import plot_lifetimes
from evermap.viz.presence_figures import plot_belief
from evermap_studies.rosen2016.callable_hazard import CallableHazard

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evermap_studies.rosen2016.study import Settings

GONE_S, QUIET_S, END_S = 115.0, (25.0, 75.0), 160.0
"""Stated under figure 1 (the end is not): when the feature vanishes, and between when nobody looks."""
P_ERROR = 0.2
"""P_M and P_F of figure 1."""
HIGH_UNTIL_S = 3.0
"""Stated under figure 2: until when the red hazard is high."""
_MEAN_GAP_S = 2.0
_FALLS_WITHIN_S = 0.25


def example_looks(seed: int) -> tuple[FloatArray, BoolArray]:
    """Times and outcomes of the looks of figure 1, at exponential gaps outside the quiet stretch."""
    rng = np.random.default_rng(seed)
    stamp_s = np.cumsum(rng.exponential(_MEAN_GAP_S, 400))
    awake_s = END_S - (QUIET_S[1] - QUIET_S[0])
    stamp_s = stamp_s[stamp_s < awake_s]
    stamp_s = np.where(stamp_s < QUIET_S[0], stamp_s, stamp_s + QUIET_S[1] - QUIET_S[0])
    chance = np.where(stamp_s <= GONE_S, 1.0 - P_ERROR, P_ERROR)
    return stamp_s, rng.random(len(stamp_s)) < chance


def draw_belief_example(settings: Settings) -> Figure:
    """Figure 1: decay without looks, and fast response to new ones and to the change."""
    looks_s, detected = example_looks(settings.seed)
    belief = PersistenceFilter(GeneralPurpose(settings.low_hz, settings.high_hz))
    times_s, curve = [0.0], [1.0]
    for stamp_s, hit in zip(looks_s.tolist(), detected.tolist(), strict=True):
        between = np.linspace(times_s[-1], stamp_s, 50).tolist()
        times_s += [*between, stamp_s]
        curve += [*(belief.predict(time_s) for time_s in between), belief.update(stamp_s, hit, P_ERROR, P_ERROR)]
    after = np.linspace(times_s[-1], END_S, 50).tolist()
    return plot_belief(
        [*times_s, *after],
        [*curve, *(belief.predict(time_s) for time_s in after)],
        looks=(looks_s, detected),
        truth_s=[(0.0, GONE_S)],
        title=f"P_M = P_F = {P_ERROR:g}, general-purpose prior {settings.low_hz:g} to {settings.high_hz:g} per second",
    )


def example_priors() -> dict[str, LifetimePrior]:
    """The hazards of figure 2: high and then falling off (red), by turns (blue), and constant (cyan)."""

    def falling(t: FloatArray) -> FloatArray:
        return np.exp(-np.maximum(t - HIGH_UNTIL_S, 0.0) / _FALLS_WITHIN_S)

    static = CallableHazard(falling, horizon_s=HIGH_UNTIL_S + 60 * _FALLS_WITHIN_S, rate_after=0.0, breaks_s=(3.0,))
    return {
        "high for 3 s, then static": static,
        "every other half second": PeriodicHazard(1.0, (0.0, 0.5), (2.0, 0.0)),
        "constant": Exponential(0.8),
    }


def draw_prior_example() -> Figure:
    """Figure 2: densities that look alike may come from very different hazards."""
    return plot_lifetimes(example_priors(), until_s=6.0, log_time=False)
