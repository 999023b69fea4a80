"""The peer of the persistence filter: Rosen 2016, Algorithm 1, as the paper has it, in logarithms.

Likelihood, partial evidence and evidence of each feature are carried along; the belief is formed from them and the
prior. Written plainly: whole arrays in numpy and scipy, a loop compiled by numba, and Python for a single feature.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from evermap.types import BoolArray, FloatArray


class State(NamedTuple):
    """(N,) logarithms of the three quantities of the paper, and the time of the last look."""

    likelihood: FloatArray
    partial_evidence: FloatArray
    evidence: FloatArray
    stamp_s: FloatArray


class Looks(NamedTuple):
    """(N,) one look at each feature."""

    time_s: FloatArray
    detected: BoolArray
    p_miss: FloatArray
    p_false: FloatArray


def start(n: int) -> State:
    """Line 1 of the algorithm."""
    return State(np.zeros(n), np.full(n, -np.inf), np.zeros(n), np.zeros(n))


def step_numpy(
    state: State, looks: Looks, log_survival: Callable[[FloatArray], FloatArray], horizon_s: float
) -> tuple[State, FloatArray]:
    """Lines 3 to 7 on arrays: the state after the looks, and the belief `horizon_s` later."""
    with np.errstate(divide="ignore"):
        there = np.log(np.where(looks.detected, 1.0 - looks.p_miss, looks.p_miss))
        gone = np.log(np.where(looks.detected, looks.p_false, 1.0 - looks.p_false))
        before, now = log_survival(state.stamp_s), log_survival(looks.time_s)
        died = before + np.log(-np.expm1(now - before))  # log(F(t_N+1) - F(t_N))
        partial = gone + np.logaddexp(state.partial_evidence, state.likelihood + died)
        likelihood = state.likelihood + there
        evidence = np.logaddexp(partial, likelihood + now)
        belief = np.exp(likelihood - evidence + log_survival(looks.time_s + horizon_s))
    return State(likelihood, partial, evidence, looks.time_s), belief


def log_survival_exponential(rate_hz: FloatArray) -> Callable[[FloatArray], FloatArray]:
    return lambda time_s: -rate_hz * time_s


def log_survival_general_purpose(low_hz: FloatArray, high_hz: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Equation 28."""
    from scipy.special import exp1

    span = np.log(high_hz / low_hz)
    return lambda time_s: np.log((exp1(low_hz * time_s) - exp1(high_hz * time_s)) / span)


@njit(cache=True, error_model="numpy")
def _e1(x: float) -> float:
    """Power series below 1, continued fraction from there on, both until the digits are exhausted."""
    if x <= 0.0:
        return np.inf
    if x < 1.0:
        total, term = -0.5772156649015329 - math.log(x), 1.0
        for n in range(1, 40):
            term *= -x / n
            total -= term / n
            if abs(term) < 1e-17 * abs(total):
                break
        return total
    b, d = x + 1.0, 1.0 / (x + 1.0)
    c, h = 1e300, d
    for n in range(1, 200):
        b += 2.0
        d = 1.0 / (b - n * n * d)
        c = b - n * n / c
        h *= c * d
        if abs(c * d - 1.0) < 1e-15:
            break
    return h * math.exp(-x)


@njit(cache=True, error_model="numpy")
def _log_survival(low: float, high: float, time: float) -> float:
    """Equation 28; an exponential lifetime of rate `low` where `high` is 0."""
    if high == 0.0:
        return -low * time
    if time == 0.0:
        return 0.0
    return math.log((_e1(low * time) - _e1(high * time)) / math.log(high / low))


@njit(cache=True, error_model="numpy")
def _log_add(a: float, b: float) -> float:
    top, other = max(a, b), min(a, b)
    return top + math.log1p(math.exp(other - top)) if other > -np.inf else top


@njit(cache=True, error_model="numpy")
def step_numba(
    state: Any, looks: Any, low_hz: FloatArray, high_hz: FloatArray, horizon_s: float, after: Any, belief: FloatArray
) -> None:
    """Lines 3 to 7, feature after feature; `after` and `belief` are filled."""
    for i in range(belief.size):
        low, high, time = low_hz[i], high_hz[i], looks.time_s[i]
        there = math.log(1.0 - looks.p_miss[i] if looks.detected[i] else looks.p_miss[i])
        gone = math.log(looks.p_false[i] if looks.detected[i] else 1.0 - looks.p_false[i])
        before, now = _log_survival(low, high, state.stamp_s[i]), _log_survival(low, high, time)
        died = before + math.log(-math.expm1(now - before))
        partial = gone + _log_add(state.partial_evidence[i], state.likelihood[i] + died)
        likelihood = state.likelihood[i] + there
        evidence = _log_add(partial, likelihood + now)
        after.likelihood[i] = likelihood
        after.partial_evidence[i] = partial
        after.evidence[i] = evidence
        belief[i] = math.exp(likelihood - evidence + _log_survival(low, high, time + horizon_s))


class OneFeature:
    """The algorithm for a single feature, in Python's own floats."""

    def __init__(self, log_survival: Callable[[float], float]) -> None:
        self._log_survival = log_survival
        self._likelihood, self._partial_evidence, self._stamp = 0.0, -math.inf, 0.0

    def update(self, stamp_s: float, detected: bool, p_miss: float, p_false: float) -> float:
        """Belief right after a look."""
        there = math.log(1.0 - p_miss if detected else p_miss)
        gone = math.log(p_false if detected else 1.0 - p_false)
        before, now = self._log_survival(self._stamp), self._log_survival(stamp_s)
        died = before + math.log(-math.expm1(now - before)) if now < before else -math.inf
        self._partial_evidence = gone + self._log_sum(self._partial_evidence, self._likelihood + died)
        self._likelihood += there
        self._stamp = stamp_s
        evidence = self._log_sum(self._partial_evidence, self._likelihood + now)
        return math.exp(self._likelihood + now - evidence)

    @staticmethod
    def _log_sum(a: float, b: float) -> float:
        top, other = max(a, b), min(a, b)
        return top + math.log1p(math.exp(other - top)) if other > -math.inf else top


def log_survival_of_one(low_hz: float, high_hz: float) -> Callable[[float], float]:
    """Equation 28 for Python's own floats."""
    from scipy.special import exp1

    span = math.log(high_hz / low_hz)
    return lambda t: math.log(float(exp1(low_hz * t) - exp1(high_hz * t)) / span) if t > 0.0 else 0.0
