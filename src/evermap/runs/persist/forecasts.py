"""Presence after the latest look, and how long what is there will stay, or what is away stay away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.config import PersistConfig
from evermap.errors import ConfigError
from evermap.existence.one_stay import OneStay, births
from evermap.existence.protocol import Looks, PresenceModel
from evermap.existence.run_length import RunLength
from evermap.runs.persist.models import ModelOfEach, looks_at
from evermap.types import FloatArray

STEPS = 10
MOST_STEPS = 10_000


@dataclass(frozen=True, slots=True)
class Forecasts:
    """Presence of F features at N instants from the latest look on.

    Attributes:
        stamp_s: (N,) when; the first is the time of the latest look in the table.
        p_exists: (F, N) probability of presence then; nan for features that nothing is believed of.
        median_stay_s: (F,) if it is there now: time until it is as likely as not to have left; inf where it will
            rather stay for ever, nan where the model is not of one stay.
        mean_stay_s: (F,) if it is there now: expected time until it leaves; nan where the model does not say.
        mean_absence_s: (F,) if it is away now: expected time until it returns; nan where the model does not say.
    """

    stamp_s: FloatArray
    p_exists: FloatArray
    median_stay_s: FloatArray
    mean_stay_s: FloatArray
    mean_absence_s: FloatArray


def forecast_stamps(looks: Looks, now_s: float, config: PersistConfig) -> FloatArray:
    """Return (N,) instants from the latest look on, `horizon_s` far.

    Raises:
        ConfigError: so many steps that one of them must be wrong.
    """
    horizon_s = config.horizon_s or config.horizon_share * (now_s - float(looks.stamp_s.min())) or 1.0
    step_s = config.step_s or horizon_s / STEPS
    count = int(np.floor(horizon_s / step_s * (1.0 + 1e-12)))
    if count > MOST_STEPS:
        raise ConfigError(f"{horizon_s:g} s in steps of {step_s:g} s", field="horizon_s", hint="a longer `step_s`")
    return now_s + step_s * np.arange(count + 1, dtype=np.float64)


def forecasts_of(models: ModelOfEach, looks: Looks, stamp_s: FloatArray, p_exists: FloatArray) -> Forecasts:
    """Return forecasts with what each model expects from their first instant on.

    Args:
        models: the model of every feature.
        looks: by feature and time.
        stamp_s: (N,) instants of the forecast.
        p_exists: (F, N) presence then.
    """
    outlook = np.full((3, looks.n_features), np.nan)
    for k, model in enumerate(models.models):
        mine = np.flatnonzero(models.of_feature == k)
        if mine.size:
            outlook[:, mine] = _outlook(model, looks_at(looks, mine)[0], float(stamp_s[0]))
    return Forecasts(stamp_s, p_exists, *outlook)


def _outlook(model: PresenceModel, looks: Looks, now_s: float) -> FloatArray:
    """(3, F) median stay, mean stay and mean absence from now on; nan for what the model does not say."""
    answer = np.full((3, looks.n_features), np.nan)
    if isinstance(model, OneStay):
        birth_s = births(looks)
        born = ~np.isnan(birth_s)
        answer[0, born] = model.median_remaining_s(now_s - birth_s[born])
    elif isinstance(model, RunLength):
        from evermap.existence.run_length import RunLengthBelief

        state = RunLengthBelief.after(model, _heard_of(looks, now_s))
        answer[1:] = state.time_to_leave(), state.time_to_return()
    return answer


def _heard_of(looks: Looks, now_s: float) -> Looks:
    """The same looks and one at every feature now, which says nothing: it takes the filter there."""
    features = np.arange(looks.n_features)
    old = (np.repeat(features, np.diff(looks.first)), looks.stamp_s, looks.detected, looks.p_miss, looks.p_false)
    nothing = np.full(looks.n_features, 0.5)
    new = (features, np.full(looks.n_features, now_s), np.ones(looks.n_features), nothing, nothing)
    return Looks.from_rows(*(np.concatenate(pair) for pair in zip(old, new, strict=True)))
