"""How long will it stay, when will it be back? What the run-length filter's hypotheses say about the present state.

Presence at an instant ahead, after any number of comings and goings, is `run_length.predict`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.existence import checks
from evermap.existence.hazard_table import HazardTable, bins_of
from evermap.existence.protocol import Looks
from evermap.existence.run_length import ABSENT, PRESENT, RunLength, RunLengthBelief, init
from evermap.types import FloatArray

WEEKS = 8
"""How far ahead a rhythm is followed; what lasts longer goes on as in the last of these weeks."""


def after(model: RunLength, looks: Looks) -> RunLengthBelief:
    """Beliefs after all looks, one row a feature; what was never looked at is heard of at the last look of all.

    Args:
        model: how features come and go.
        looks: at F features.

    Raises:
        InputError: no look at all.
        NumericalError: a look that is impossible under both states.
    """
    from evermap.existence.run_length_kernels import look_rows

    if not len(looks.stamp_s):
        raise InputError("there is no look", field="looks", hint="init(), which needs none")
    number = np.diff(looks.first)
    looked = number > 0
    began = np.full(looks.n_features, looks.stamp_s.max())
    began[looked] = looks.stamp_s[looks.first[:-1][looked]]
    state = init(model, began)
    rows = np.repeat(np.arange(looks.n_features), number)
    there, gone = looks.likelihoods()
    bad = look_rows(
        rows, state.start_s, state.weight, state.count, state.stamp_s, looks.stamp_s, gone, there, model.law,
        state.log_evidence, state.merged_mass, np.empty(len(rows)),
    )  # fmt: skip
    if bad >= 0:
        raise looks.impossible(bad)
    return state


def time_to_leave(state: RunLengthBelief) -> FloatArray:
    """Expected time until each feature leaves, if it is there.

    Returns:
        (N,) seconds from `state.stamp_s` on: the mean residual life `int S(a + t) dt / S(a)` over what is believed of
        the age `a`; `inf` where some stay for ever, NaN where the feature is certainly away. With a rhythm, a numerical
        integral over the coming weeks.
    """
    return _time_to_change(state, PRESENT)


def time_to_return(state: RunLengthBelief) -> FloatArray:
    """Expected time until each feature returns, if it is away; as `time_to_leave`.

    Returns:
        (N,) seconds from `state.stamp_s` on; `inf` where some never return, NaN where the feature is certainly there.
    """
    return _time_to_change(state, ABSENT)


def p_stays(state: RunLengthBelief, stamp_s: Any) -> FloatArray:
    """Probability that a feature which is there now is still there, without a break, at instants ahead.

    Args:
        state: beliefs about N features.
        stamp_s: (T,) instants in order, none before any row's last.

    Returns:
        (N, T) probabilities; NaN where the feature is certainly away.

    Raises:
        InputError: an instant that is not finite, out of order, or before a row's last.
    """
    return _lasts(state, stamp_s, PRESENT)


def p_stays_away(state: RunLengthBelief, stamp_s: Any) -> FloatArray:
    """Probability that a feature which is away now has not returned at instants ahead; as `p_stays`.

    Args:
        state: beliefs about N features.
        stamp_s: (T,) instants in order, none before any row's last.

    Returns:
        (N, T) probabilities; NaN where the feature is certainly there.

    Raises:
        InputError: an instant that is not finite, out of order, or before a row's last.
    """
    return _lasts(state, stamp_s, ABSENT)


def residual_life(table: HazardTable, age_s: FloatArray) -> FloatArray:
    """Expected time that is left at an age: closed in every bin of the table, an exponential tail after the last.

    Args:
        table: a lifetime.
        age_s: ages of any shape.

    Returns:
        Seconds, of the same shape; `inf` where the last hazard is 0 and can be reached.
    """
    hazard, edge = table.hazard_hz, table.edge_s
    left = np.empty(len(edge) + 1)
    endless = hazard[-1] == 0.0
    left[-2:] = 0.0 if endless else 1.0 / hazard[-1]
    for k in range(len(edge) - 2, -1, -1):
        left[k] = _through_bin(hazard[k], edge[k + 1] - edge[k], left[k + 1])
    i = bins_of(age_s, table.offset, len(edge))
    width = np.append(edge[1:], np.inf)[i] - age_s
    last = i == len(edge) - 1
    inside = np.where(last, left[-1], _through_bin(hazard[i], np.where(last, 0.0, width), left[i + 1]))
    to_go = table.cumulative[-1] - (table.cumulative[i] + hazard[i] * np.where(last, 0.0, age_s - edge[i]))
    return np.asarray(np.where(endless & (np.exp(-to_go) > 0.0), np.inf, inside), dtype=np.float64)


def _through_bin(hazard: Any, width: Any, beyond: Any) -> Any:
    """Expected time left, from inside a bin of constant hazard with `width` to go to one where `beyond` is left."""
    x = hazard * width
    spent = width * np.where(x > 1e-9, -np.expm1(-x) / np.maximum(x, 1e-300), 1.0)
    return spent + np.exp(-x) * beyond


def _time_to_change(state: RunLengthBelief, which: int) -> FloatArray:
    """Expected time that the present state lasts, given that it is `which`."""
    law = state.model.law
    if law.factor.shape[1] > 1:
        from evermap.existence.run_length_forecast_kernels import remaining_rows

        left = np.empty(len(state))
        remaining_rows(state.start_s, state.weight, state.count, state.stamp_s, which, law, WEEKS, left)
        return left
    held = np.arange(state.weight.shape[2]) < state.count[:, which, None]
    weight = np.where(held, state.weight[:, which], 0.0)
    age = np.where(held, state.stamp_s[:, None] - state.start_s[:, which], 0.0)
    life = residual_life(state.model.tables[which], age)
    total = weight.sum(axis=1)
    mean = (weight * np.where(weight > 0.0, life, 0.0)).sum(axis=1) / np.where(total > 0.0, total, 1.0)
    return np.where(total > 0.0, mean, np.nan)


def _lasts(state: RunLengthBelief, stamp_s: Any, which: int) -> FloatArray:
    """Probability that nothing changes before instants ahead, given that the present state is `which`."""
    from evermap.existence.run_length_forecast_kernels import lasting_rows

    time = np.array(stamp_s, dtype=np.float64).reshape(-1)
    if (np.diff(time) < 0.0).any():
        raise InputError("the instants asked for are not in order of time", field="stamp_s", hint="sort them")
    checks.check_times(time, np.full(len(time), state.stamp_s.max(initial=-np.inf)), noun="instant")
    out = np.empty((len(state), len(time)))
    lasting_rows(state.start_s, state.weight, state.count, state.stamp_s, which, time, state.model.law, out)
    return out
