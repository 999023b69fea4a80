"""Presence after the latest look, and when half of what is there will have left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError
from evermap.presence.config import PersistConfig
from evermap.presence.models import ModelOfEach, looks_at
from evermap.presence.table import LookTable
from evermap.recurrence.one_stay import OneStay, births
from evermap.recurrence.protocol import Instants, Looks
from evermap.types import FloatArray

SHARE = 0.25
"""Horizon where none is given: this share of the time that the looks span."""
STEPS = 10
MOST_STEPS = 10_000


@dataclass(frozen=True, slots=True)
class Forecasts:
    """Presence of F features at N instants from the latest look on.

    Attributes:
        stamp_s: (N,) when; the first is the time of the latest look in the table.
        p_exists: (F, N) probability of presence then; nan for features that nothing is believed of.
        median_stay_s: (F,) if it is there now: time until it is as likely as not to have left; inf where it will
            rather stay forever, nan where the model does not say.
    """

    stamp_s: FloatArray
    p_exists: FloatArray
    median_stay_s: FloatArray


def forecast(models: ModelOfEach, looks: Looks, table: LookTable, config: PersistConfig) -> Forecasts:
    """Presence from the latest look of the table on, `--horizon` far.

    Raises:
        ConfigError: so many steps that one of them must be wrong.
    """
    now_s = table.now_s
    span_s = now_s - float(looks.stamp_s.min())
    horizon_s = config.horizon_s or SHARE * span_s or 1.0
    step_s = config.step_s or horizon_s / STEPS
    count = int(np.floor(horizon_s / step_s * (1.0 + 1e-12)))
    if count > MOST_STEPS:
        raise ConfigError(f"{horizon_s:g} s in steps of {step_s:g} s", field="--horizon", hint="a longer --step-s")
    stamp_s = now_s + step_s * np.arange(count + 1, dtype=np.float64)
    track = models.track(looks, Instants.same_for_all(looks.n_features, stamp_s))
    median_s = _median_stay(models, looks, now_s)
    return Forecasts(stamp_s, track.p_present.reshape(looks.n_features, count + 1), median_s)


def _median_stay(models: ModelOfEach, looks: Looks, now_s: float) -> FloatArray:
    median_s = np.full(looks.n_features, np.nan)
    for k, model in enumerate(models.models):
        if not isinstance(model, OneStay):
            continue
        mine = np.flatnonzero(models.of_feature == k)
        birth_s = births(looks_at(looks, mine)[0])
        born = ~np.isnan(birth_s)
        median_s[mine[born]] = model.median_remaining_s(now_s - birth_s[born])
    return median_s
