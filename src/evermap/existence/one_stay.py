"""Features that stay once (Rosen 2016): the filter of one feature, and the model of presence of any number of them.

`PersistenceFilter` calls the formulas of `recursion` on plain floats, without an array in sight.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import expm1, inf, isfinite, log
from typing import Any, Self

import numpy as np

from evermap.errors import InputError
from evermap.existence.lifetimes import WIDE, Lifetimes, log_death_odds
from evermap.existence.protocol import Instants, Looks, Track, as_prior, feature_of, impossible, likelihoods
from evermap.existence.recursion import LARGEST, LOG_LARGEST, aged, observed, odds_of
from evermap.show import Shown
from evermap.survival import Exponential, GeneralPurpose, LifetimePrior, never_leaves, parse_prior
from evermap.survival.text import prior_text
from evermap.types import DEFAULT_P_FALSE, DEFAULT_P_MISS, DEFAULT_PRIOR, BoolArray, FloatArray, IntArray

_ANSWERS = (0, 1)


class PersistenceFilter(Shown):
    """Rosen's persistence filter of one feature (2016, Algorithm 1; MATH.md section 2).

    Times count from the feature's birth, in seconds; it is certainly there at 0.

    Args:
        prior: how long such features stay; a text such as `exponential:half-life=30d` is read as one. The default is
            that of what nothing is known of.

    Raises:
        ConfigError, InputError: `prior` is not a lifetime prior.
    """

    __slots__ = ("_death_odds", "_evidence", "_inverse_odds", "_stamp")

    def __init__(self, prior: LifetimePrior | str = DEFAULT_PRIOR) -> None:
        self._death_odds = _death_odds_under(as_prior(prior))
        self._inverse_odds = 0.0
        self._stamp = 0.0
        self._evidence = 0.0

    def _facts(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("probability", "stamp_s", "log_evidence")}

    @property
    def probability(self) -> float:
        """Probability that the feature existed at the last observation."""
        return 1.0 / (1.0 + self._inverse_odds)

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
        """Return the probability that the feature exists at `stamp_s`, which must not lie before the last observation.

        Raises:
            InputError: a time that is not finite or lies before the last observation.
        """
        if not self._stamp <= stamp_s < inf:
            raise self._refusal(stamp_s, 0.0, 0.0)
        return float(1.0 / (1.0 + aged(self._inverse_odds, self._death_odds(self._stamp, stamp_s))))

    def update(
        self, stamp_s: float, detected: bool, p_miss: float = DEFAULT_P_MISS, p_false: float = DEFAULT_P_FALSE
    ) -> float:
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
            raise impossible(f"time {stamp_s} s")
        self._inverse_odds = after
        self._stamp = stamp_s
        self._evidence += log(likelihood)
        return float(1.0 / (1.0 + after))

    def _refusal(self, stamp_s: float, p_miss: float, p_false: float) -> InputError:
        """Return the reason why an update is refused."""
        for value, field in ((p_miss, "p_miss"), (p_false, "p_false")):
            if not 0.0 <= value <= 1.0:
                return InputError(f"{value} is not a probability", field=field, hint="a number between 0 and 1")
        if not isfinite(stamp_s):
            return InputError(f"time {stamp_s} is not finite", field="stamp_s", hint="a finite time")
        past = f"the last observation at {self._stamp} s" if self._stamp else "the feature's birth at 0"
        return InputError(f"time {stamp_s} s lies before {past}", field="stamp_s", hint="sort by time")


def _death_odds_under(prior: LifetimePrior) -> Callable[[float, float], float]:
    """Return a function for `(1 - q) / q` of a gap from its begin and end, by the cheapest formula of the prior."""
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


_HALVINGS = 60
"""Bisections of a logarithmic range of 24 decades: more than float64 can tell apart."""
_SHORTEST_S, _LONGEST_S = 1e-9, 1e15


@dataclass(frozen=True, slots=True)
class OneStay(Shown):
    """A feature is born with its first detection, stays for one lifetime, and never returns (Rosen 2016).

    Before its birth nothing is believed. The detection of the birth itself is taken as true, as in Rosen's
    initial condition; it is not an observation and adds nothing to the evidence.

    Attributes:
        prior: how long such features stay.
        text: how the user wrote the prior (`survival.text`); '' for one made in Python.
    """

    prior: LifetimePrior
    text: str = ""

    @classmethod
    def of_text(cls, text: str) -> Self:
        """Return the model of a prior as people write it; ConfigError for other text."""
        return cls(parse_prior(text), text)

    @property
    def lifetimes(self) -> Lifetimes:
        """The prior; an absence never ends."""
        return Lifetimes(self.prior, never_leaves())

    def track(self, looks: Looks, instants: Instants | None = None) -> Track:
        """Filter every feature's looks in one compiled pass; see `PresenceModel.track`.

        Requested instants pass through the filter as looks without information, so that one pass answers all.

        Raises:
            NumericalError: a look that is impossible, whether the feature is there or gone.
        """
        from evermap.existence.kernels import Stream, stream

        asked = Instants.of_looks(looks) if instants is None else instants
        birth_row = _birth_rows(looks)
        birth_s = births(looks)
        feature, time, look, instant = _merge_looks(looks, asked)
        born = time >= birth_s[feature]  # false where there never is a birth
        feature, time, look, instant = feature[born], time[born], look[born], instant[born]

        there, gone = np.ones(len(time)), np.ones(len(time))
        says = look > birth_row[feature]
        row = look[says]
        there[says], gone[says] = likelihoods(looks.detected[row], looks.p_miss[row], looks.p_false[row])

        age_s = time - birth_s[feature]
        before_s = np.zeros(len(time))
        same = np.flatnonzero(feature[1:] == feature[:-1]) + 1
        before_s[same] = age_s[same - 1]
        odds = np.full(len(time), -np.inf)
        gap = np.flatnonzero(age_s > before_s)  # nothing leaves in no time, and some priors take long to say so
        odds[gap] = log_death_odds((self.prior,), np.zeros(len(gap), dtype=np.int64), before_s[gap], age_s[gap])
        evidence, belief = np.zeros(looks.n_features), np.empty(len(time))
        bad = int(stream(Stream(feature, odds, there, gone), np.zeros(looks.n_features), evidence, belief))
        if bad >= 0:
            raise looks.impossible(int(look[bad]))
        p_present = np.full(len(asked.stamp_s), np.nan)
        answer = instant >= 0
        p_present[instant[answer]] = belief[answer]
        return Track(p_present, evidence, np.zeros(looks.n_features))

    def to_dict(self) -> dict[str, Any]:
        """Return the prior as text, for JSON.

        Raises:
            ConfigError: this prior cannot be written as text, as a hazard that is a function.
        """
        return {"kind": "one-stay", "prior": self.text or prior_text(self.prior)}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Return the model that `to_dict` wrote."""
        return cls.of_text(str(data["prior"]))

    def median_remaining_s(self, age_s: Any) -> FloatArray:
        """Return the time by which half of the features that are there at an age have left; inf where half never do.

        Args:
            age_s: (N,) time since birth.
        """
        age = np.asarray(age_s, dtype=np.float64)
        which = np.zeros(len(age), dtype=np.int64)

        def lasts(stay_s: FloatArray) -> BoolArray:
            return np.asarray(log_death_odds((self.prior,), which, age, age + stay_s) < 0.0, dtype=np.bool_)

        low, high = np.full(len(age), np.log(_SHORTEST_S)), np.full(len(age), np.log(_LONGEST_S))
        forever = lasts(np.exp(high))
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            longer = lasts(np.exp(middle))
            low, high = np.where(longer, middle, low), np.where(longer, high, middle)
        return np.where(forever, np.inf, np.exp(high))


def births(looks: Looks) -> FloatArray:
    """Return (F,) time of every feature's first detection; nan where it never was detected."""
    return np.append(looks.stamp_s, np.nan)[_birth_rows(looks)]


def _birth_rows(looks: Looks) -> IntArray:
    """(F,) row of each feature's first detection, M where it has none.

    The detection of a detector that cannot see (`P_M = 1`) is false and proves no birth.
    """
    seen = np.flatnonzero((looks.detected == 1.0) & (looks.p_miss < 1.0))
    feature = looks.feature[seen]
    row = np.full(looks.n_features, len(looks.stamp_s), dtype=np.int64)
    row[feature[::-1]] = seen[::-1]  # of several assignments the last one holds: the first detection
    return row


def _merge_looks(looks: Looks, asked: Instants) -> tuple[IntArray, FloatArray, IntArray, IntArray]:
    """Looks and instants as one list by feature and time, looks first: feature, time, row in each table or -1."""
    n_looks, n_asked = len(looks.stamp_s), len(asked.stamp_s)
    feature = np.concatenate([looks.feature, feature_of(asked.first)])
    time = np.concatenate([looks.stamp_s, asked.stamp_s])
    order = np.lexsort((time, feature))  # stable: of equal times the looks stay in front
    look = np.concatenate([np.arange(n_looks), np.full(n_asked, -1)])
    instant = np.concatenate([np.full(n_looks, -1), np.arange(n_asked)])
    return feature[order], time[order], look[order], instant[order]
