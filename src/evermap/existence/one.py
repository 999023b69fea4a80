"""One feature at a time: the formulas of `recursion` on plain floats, without an array in sight."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import expm1, inf, isfinite, log

from evermap.errors import InputError, NumericalError
from evermap.existence.checks import as_prior, impossible
from evermap.existence.lifetimes import WIDE
from evermap.existence.recursion import LARGEST, LOG_LARGEST, aged, observed, odds_of
from evermap.survival import Exponential, GeneralPurpose, LifetimePrior

_ANSWERS = (0, 1)


class PersistenceFilter:
    """Rosen's persistence filter of one feature (2016, Algorithm 1; MATH.md section 2).

    Times count from the feature's birth, in seconds; it is certainly there at 0.

    Args:
        prior: how long such features stay; a text such as `exponential:half-life=30d` is read as one.

    Raises:
        ConfigError, InputError: `prior` is not a lifetime prior.
    """

    __slots__ = ("_death_odds", "_evidence", "_inverse_odds", "_stamp")

    def __init__(self, prior: LifetimePrior | str) -> None:
        self._death_odds = _death_odds_under(as_prior(prior))
        self._inverse_odds = 0.0
        self._stamp = 0.0
        self._evidence = 0.0

    @property
    def stamp_s(self) -> float:
        """Time of the last observation, 0 before the first."""
        return self._stamp

    @property
    def inverse_odds(self) -> float:
        """`(1 - p) / p` right after the last observation: keeps its digits where `p` is close to 1."""
        return self._inverse_odds

    @property
    def log_evidence(self) -> float:
        """`log p(y_1:n)` of all observations so far."""
        return self._evidence

    def predict(self, stamp_s: float) -> float:
        """Probability that the feature exists at `stamp_s`, which must not lie before the last observation.

        Raises:
            InputError: a time that is not finite or lies before the last observation.
        """
        if not self._stamp <= stamp_s < inf:
            raise self._refusal(stamp_s, 0.0, 0.0)
        return float(1.0 / (1.0 + aged(self._inverse_odds, self._death_odds(self._stamp, stamp_s))))

    def update(self, stamp_s: float, detected: bool, p_miss: float, p_false: float) -> float:
        """Take in one look at the feature, and return the probability that it exists then.

        Args:
            stamp_s: time since birth, not before the last look.
            detected: whether the detector fired.
            p_miss: `P(no detection | there)`.
            p_false: `P(detection | gone)`.

        Raises:
            InputError: a probability outside [0, 1], or time running back.
            NumericalError: an observation that is impossible whether the feature is there or gone.
        """
        if not (self._stamp <= stamp_s < inf and 0.0 <= p_miss <= 1.0 and 0.0 <= p_false <= 1.0):
            raise self._refusal(stamp_s, p_miss, p_false)
        if detected not in _ANSWERS:
            raise InputError(f"{detected} is neither a detection nor a miss", field="detected", hint="True or False")
        predicted = aged(self._inverse_odds, self._death_odds(self._stamp, stamp_s))
        there, gone = (1.0 - p_miss, p_false) if detected else (p_miss, 1.0 - p_false)
        after, likelihood = observed(predicted, there, gone)
        if likelihood <= 0.0:
            raise NumericalError(impossible(f"time {stamp_s} s"), hint="P_M and P_F strictly between 0 and 1")
        self._inverse_odds = after
        self._stamp = stamp_s
        self._evidence += log(likelihood)
        return float(1.0 / (1.0 + after))

    def _refusal(self, stamp_s: float, p_miss: float, p_false: float) -> InputError:
        """What was wrong with an update that is refused."""
        for value, field in ((p_miss, "p_miss"), (p_false, "p_false")):
            if not 0.0 <= value <= 1.0:
                return InputError(f"{value} is no probability", field=field, hint="a number between 0 and 1")
        if not isfinite(stamp_s):
            return InputError(f"time {stamp_s} is no instant", field="stamp_s", hint="a finite time")
        past = f"the last observation at {self._stamp} s" if self._stamp else "the feature's birth at 0"
        return InputError(f"time {stamp_s} s lies before {past}", field="stamp_s", hint="sort by time")


def _death_odds_under(prior: LifetimePrior) -> Callable[[float, float], float]:
    """What gives `(1 - q) / q` of a gap from its begin and its end, by the shortest road that the prior allows."""
    if isinstance(prior, Exponential):
        return partial(_of_constant_hazard, float(prior.rate))
    if isinstance(prior, GeneralPurpose) and prior.high > WIDE * prior.low:
        from evermap.existence.kernels import general_purpose_gap

        return partial(general_purpose_gap, float(prior.low), float(prior.high))
    return partial(_of_any_prior, prior)


def _of_constant_hazard(rate_hz: float, start_s: float, stop_s: float) -> float:
    hazard = rate_hz * (stop_s - start_s)
    return expm1(hazard) if hazard < LOG_LARGEST else LARGEST


def _of_any_prior(prior: LifetimePrior, start_s: float, stop_s: float) -> float:
    survival = float(prior.log_conditional_survival(start_s, stop_s))
    death = float(prior.log_conditional_death(start_s, stop_s))
    if survival == -inf:
        return inf
    return float(odds_of(death - survival))
