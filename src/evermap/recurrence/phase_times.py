"""How long until it leaves, and until it is back: mean times of a chain of phases, exact with a rhythm too."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import ConfigError
from evermap.recurrence.phase_type import PhaseType
from evermap.recurrence.rhythm import BIN_S, BINS, WEEK_S, bin_of_week
from evermap.types import BoolArray, FloatArray

_MONDAY_S = 4.0 * 86400.0


def expected_time_to_return(model: PhaseType, belief: ArrayLike, stamp_s: float | None = None) -> float:
    """Mean time in seconds until a feature that is away now is there again; inf where it may stay away for ever.

    Args:
        model: how it comes and goes.
        belief: (n,) probability of each phase; only those of absence count, in proportion.
        stamp_s: now, in local wall time; needed where the model has a rhythm.

    Raises:
        ConfigError: a belief in no absence at all, or a rhythm without a time.
    """
    return _mean_time_in(model, ~model.present, belief, stamp_s)


def expected_time_to_leave(model: PhaseType, belief: ArrayLike, stamp_s: float | None = None) -> float:
    """Mean time in seconds until a feature that is there now leaves; as `expected_time_to_return`."""
    return _mean_time_in(model, model.present, belief, stamp_s)


def _mean_time_in(model: PhaseType, inside: BoolArray, belief: ArrayLike, stamp_s: float | None) -> float:
    """Mean time until some phases are left, from a belief within them."""
    values = np.asarray(belief, dtype=np.float64)
    if values.shape != model.present.shape or not (values >= 0.0).all():
        raise ConfigError(f"{model.n_phases} probabilities are needed", field="belief")
    weights = values[inside]
    if not weights.sum() > 0.0:
        raise ConfigError("it is certainly in the other state", field="belief")
    rates = model.rates_by_bin
    if len(rates) > 1 and stamp_s is None:
        raise ConfigError("with a rhythm it depends on the time of the week", field="stamp_s")
    if not _always_left(model, inside, weights > 0.0):
        return float("inf")
    generators = rates[:, inside][:, :, inside] - np.eye(int(inside.sum())) * rates[:, inside].sum(2)[:, :, None]
    if len(rates) == 1:
        times = np.linalg.solve(-generators[0], np.ones(len(weights)))
    else:
        times = _with_rhythm(generators, float(stamp_s or 0.0))
    return float(weights @ times / weights.sum())


def _with_rhythm(generators: FloatArray, stamp_s: float) -> FloatArray:
    """Mean time from each phase: `m(bin) = c(bin) + P(bin) m(next bin)`, closed after a week.

    Args:
        generators: (1008, k, k) of the phases that are to be left, rows of sum <= 0.
        stamp_s: now.
    """
    k = generators.shape[1]
    survive, spent = _bin_terms(generators, BIN_S)
    week, total = np.eye(k), np.zeros(k)
    for b in range(BINS):
        total += week @ spent[b]
        week = week @ survive[b]
    later = np.linalg.solve(np.eye(k) - week, total)  # at the begin of the week
    here = int(bin_of_week(stamp_s))
    for b in range(BINS - 1, here, -1):
        later = spent[b] + survive[b] @ later
    rest_s = (here + 1) * BIN_S - (stamp_s - _MONDAY_S) % WEEK_S
    survive, spent = _bin_terms(generators[here : here + 1], rest_s)
    return np.asarray(spent[0] + survive[0] @ later)


def _bin_terms(generators: FloatArray, span_s: float) -> tuple[FloatArray, FloatArray]:
    """`exp(G t)` and `int_0^t exp(G s) 1 ds`, both from one exponential (Van Loan 1978)."""
    from scipy.linalg import expm

    k = generators.shape[1]
    block = np.zeros((len(generators), k + 1, k + 1))
    block[:, :k, :k] = generators
    block[:, :k, k] = 1.0 / span_s
    whole = expm(block * span_s)
    return whole[:, :k, :k], whole[:, :k, k] * span_s


def _always_left(model: PhaseType, inside: BoolArray, reached: BoolArray) -> bool:
    """Whether every phase that can be reached from the given ones has a way out."""
    changes = model.rates_hz > 0.0
    within = changes[np.ix_(inside, inside)]
    for _ in range(len(reached)):
        reached = reached | (reached @ within)
    leaves = changes[np.ix_(inside, ~inside)].any(1)
    for _ in range(len(reached)):
        leaves = leaves | (within @ leaves)
    return bool(leaves[reached].all())
