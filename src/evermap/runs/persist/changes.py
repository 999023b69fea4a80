"""Changes and forecasts from beliefs: when features vanished and returned, and presence after the latest look.

A change is decided at the first look after which the belief in the other state reaches a confidence. When it happened
is another question, and the looks answer it: between two decisions there was one change, and its place has a
posterior distribution over the gaps between the looks (uniform over time before, weighed by the looks' likelihoods).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.config import PersistConfig
from evermap.errors import ConfigError
from evermap.existence.one_stay import OneStay, births
from evermap.existence.protocol import Looks, PresenceModel
from evermap.existence.run_length import RunLength
from evermap.runs.persist.models import ModelOfEach
from evermap.runs.persist.table import Span
from evermap.show import Shown, ShownTable
from evermap.types import BoolArray, FloatArray, IntArray

_SHORTEST_GAP_S = 1e-9
"""Minimum time between two looks: a change between looks at one stamp can be the only explanation."""
_CERTAIN = 700.0
"""Log odds that a double still tells from certainty."""


@dataclass(frozen=True, slots=True, repr=False)
class Changes(ShownTable):
    """C changes in the order in which they were decided.

    Attributes:
        feature: (C,) index of the feature.
        returned: (C,) True where it came, False where it went.
        stamp_s: (C,) when: median of the posterior.
        earliest_s, latest_s: (C,) the looks between which it happened, with 95 % probability.
        decided_s: (C,) the look at which it became clear.
        confidence: (C,) belief in the new state then.
    """

    feature: IntArray
    returned: BoolArray
    stamp_s: FloatArray
    earliest_s: FloatArray
    latest_s: FloatArray
    decided_s: FloatArray
    confidence: FloatArray

    def __len__(self) -> int:
        return len(self.feature)

    def per_feature(self, n_features: int) -> IntArray:
        """Return (F,) number of changes of each feature."""
        return np.bincount(self.feature, minlength=n_features)


MOST_FEATURES = 60
"""Rows of a figure of all features, at most."""


def most_changed(changes: IntArray, looks: IntArray, n: int) -> IntArray:
    """Return the `n` features that changed most, of equals those looked at more often; in natural order.

    Args:
        changes: (F,) number of changes of each.
        looks: (F,) number of looks at each.
        n: how many.
    """
    return np.sort(np.lexsort((-looks, -changes))[:n])


def find_changes(looks: Looks, p_present: FloatArray, confidence: float, tail: float = 0.025) -> Changes:
    """Return changes of all features.

    Args:
        looks: by feature and time.
        p_present: (M,) belief right after each look, nan where there is none.
        confidence: belief in a state from which on it is taken to be so, above 0.5.
        tail: probability that a change lies before the interval given for it, and as much after it.
    """
    feature = looks.feature
    state = np.where(p_present >= confidence, 1, np.where(p_present <= 1.0 - confidence, -1, 0))
    sure = np.flatnonzero(state)
    same = feature[sure[1:]] == feature[sure[:-1]]
    flip = np.flatnonzero(same & (state[sure[1:]] != state[sure[:-1]])) + 1
    decided = sure[flip]
    entered = _since(sure, feature, flip)
    returned = state[decided] == 1
    stamp_s, before, after = _when(looks, entered, decided, returned, tail)
    belief = p_present[decided]
    found = Changes(
        feature=feature[decided],
        returned=returned,
        stamp_s=stamp_s,
        earliest_s=looks.stamp_s[before],
        latest_s=looks.stamp_s[after],
        decided_s=looks.stamp_s[decided],
        confidence=np.where(returned, belief, 1.0 - belief),
    )
    order = np.lexsort((found.feature, found.stamp_s, found.decided_s))
    return Changes(*(getattr(found, name)[order] for name in Changes.__slots__))


def _since(sure: IntArray, feature: IntArray, flip: IntArray) -> IntArray:
    """The look at which the state that ends at each flip began to be sure: the flip before, or the first sure look."""
    begins = np.ones(len(sure), dtype=np.bool_)
    begins[1:] = feature[sure[1:]] != feature[sure[:-1]]
    begins[flip] = True
    latest = np.maximum.accumulate(np.where(begins, np.arange(len(sure)), 0))
    return sure[latest[flip - 1]]


def _when(
    looks: Looks, entered: IntArray, decided: IntArray, returned: BoolArray, tail: float
) -> tuple[FloatArray, IntArray, IntArray]:
    """Return the median of one change within each window of looks `entered` to `decided`, and the looks around it.

    If the change lies in the gap after look `k`, the looks up to `k` speak about the old state and later ones about
    the new. All windows are laid one behind the other, so that no loop over them is needed.
    """
    if len(decided) == 0:
        return np.zeros(0), decided, decided
    length = decided - entered
    begin = np.concatenate([[0], np.cumsum(length)])[:-1]
    window = np.repeat(np.arange(len(length)), length)
    gap = np.arange(length.sum()) - begin[window] + entered[window]  # the gap after this look

    evidence = np.where(returned[window], -1.0, 1.0) * _log_ratio(looks)[gap]  # for the old state
    evidence[begin] = 0.0  # the window opens after this look
    running = np.cumsum(evidence)
    duration_s = np.maximum(looks.stamp_s[gap + 1] - looks.stamp_s[gap], _SHORTEST_GAP_S)
    log_weight = running + np.log(duration_s)
    weight = np.exp(log_weight - np.maximum.reduceat(log_weight, begin)[window])
    weight /= np.add.reduceat(weight, begin)[window]
    total = np.cumsum(weight)  # grows by one from window to window

    def entry(share: float) -> IntArray:
        found = np.searchsorted(total, np.arange(len(length)) + share)
        return np.clip(found, begin, begin + length - 1)

    middle = entry(0.5)
    left = total[middle] - np.arange(len(length)) - weight[middle]
    inside = np.clip((0.5 - left) / weight[middle], 0.0, 1.0)
    start_s, stop_s = looks.stamp_s[gap[middle]], looks.stamp_s[gap[middle] + 1]
    return start_s + inside * (stop_s - start_s), gap[entry(tail)], gap[entry(1.0 - tail)] + 1


def _log_ratio(looks: Looks) -> FloatArray:
    """(M,) log likelihood of each look if there, minus that if not; certainties are cut to 700 nats."""
    _, there, gone = looks.columns()
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(there) - np.log(gone)
    return np.where(np.isnan(ratio), 0.0, np.clip(ratio, -_CERTAIN, _CERTAIN))


MOST_STEPS = 10_000
"""More steps of a forecast than this are a mistake."""


@dataclass(frozen=True, slots=True, repr=False)
class Forecasts(Shown):
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


def forecast_stamps(span: Span, config: PersistConfig) -> FloatArray:
    """Return (N,) instants from the latest look on, `horizon_s` far.

    Raises:
        ConfigError: so many steps that one of them must be wrong.
    """
    now_s = span.last_look_s
    horizon_s = config.horizon_s or config.horizon_share * (now_s - span.first_look_s) or 1.0
    step_s = config.step_s or horizon_s / config.forecast_steps
    count = int(np.floor(horizon_s / step_s * (1.0 + 1e-12)))
    if count > MOST_STEPS:
        raise ConfigError(f"{horizon_s:g} s in steps of {step_s:g} s", field="horizon_s", hint="a longer `step_s`")
    return now_s + step_s * np.arange(count + 1, dtype=np.float64)


def forecasts_of(models: ModelOfEach, looks: Looks, stamp_s: FloatArray, p_exists: FloatArray) -> Forecasts:
    """Return forecasts `p_exists` (F, N) at instants (N,), with what each model expects from the first of these on."""
    outlook = np.full((3, looks.n_features), np.nan)
    for k, model in enumerate(models.models):
        mine = np.flatnonzero(models.of_feature == k)
        if mine.size:
            outlook[:, mine] = _outlook(model, looks.at(mine)[0], float(stamp_s[0]))
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
    old = (looks.feature, looks.stamp_s, looks.detected, looks.p_miss, looks.p_false)
    nothing = np.full(looks.n_features, 0.5)
    new = (features, np.full(looks.n_features, now_s), np.ones(looks.n_features), nothing, nothing)
    return Looks.from_rows(*(np.concatenate(pair) for pair in zip(old, new, strict=True)))
