"""Features that stay once: Rosen's persistence filter behind the interface of the models of presence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from evermap.existence.checks import likelihoods
from evermap.existence.lifetimes import Lifetimes, log_death_odds
from evermap.existence.protocol import Instants, Looks, Track
from evermap.survival import LifetimePrior, never_leaves, parse_prior
from evermap.survival.text import prior_text
from evermap.types import BoolArray, FloatArray, IntArray

_HALVINGS = 60
"""Bisections of a logarithmic range of 24 decades: more than float64 can tell apart."""
_SHORTEST_S, _LONGEST_S = 1e-9, 1e15


@dataclass(frozen=True, slots=True)
class OneStay:
    """A feature is born with its first detection, stays for one lifetime, and never returns (Rosen 2016).

    Before its birth nothing is believed. The detection of the birth itself is taken as true, as in Rosen's
    initial condition; it is no observation and adds nothing to the evidence.

    Attributes:
        prior: how long such features stay.
        text: how the user wrote the prior (`survival.text`); '' for one made in Python.
    """

    prior: LifetimePrior
    text: str = ""

    @classmethod
    def of_text(cls, text: str) -> Self:
        """The model of a prior as people write it.

        Raises:
            ConfigError: no prior is written like this.
        """
        return cls(parse_prior(text), text)

    @property
    def lifetimes(self) -> Lifetimes:
        """The prior; an absence never ends."""
        return Lifetimes(self.prior, never_leaves())

    def track(self, looks: Looks, instants: Instants | None = None) -> Track:
        """Filter every feature's looks in one compiled pass; see `PresenceModel.track`.

        Instants asked for go through the filter as looks that say nothing, so that one pass answers all.

        Raises:
            NumericalError: a look that is impossible, whether the feature is there or gone.
        """
        from evermap.existence.kernels import Stream, stream

        asked = Instants.of_looks(looks) if instants is None else instants
        birth_row = _birth_rows(looks)
        birth_s = births(looks)
        feature, time, look, instant = _merged(looks, asked)
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
        gap = np.flatnonzero(age_s > before_s)  # nobody dies in no time, and some priors take long to say so
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
        """What `to_dict` wrote."""
        return cls.of_text(str(data["prior"]))

    def median_remaining_s(self, age_s: Any) -> FloatArray:
        """Time by which half of the features that are there at an age have left; inf where half never do.

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
    """(F,) time of every feature's first detection; nan where it never was detected."""
    return np.append(looks.stamp_s, np.nan)[_birth_rows(looks)]


def _birth_rows(looks: Looks) -> IntArray:
    """(F,) row of each feature's first detection, M where it has none.

    The detection of a detector that cannot see (`P_M = 1`) is false and proves no birth.
    """
    seen = np.flatnonzero((looks.detected == 1.0) & (looks.p_miss < 1.0))
    feature = _feature_of(looks.first)[seen]
    row = np.full(looks.n_features, len(looks.stamp_s), dtype=np.int64)
    row[feature[::-1]] = seen[::-1]  # of several assignments the last one holds: the first detection
    return row


def _feature_of(first: IntArray) -> IntArray:
    """(M,) feature of every row."""
    return np.repeat(np.arange(len(first) - 1), np.diff(first))


def _merged(looks: Looks, asked: Instants) -> tuple[IntArray, FloatArray, IntArray, IntArray]:
    """Looks and instants as one list by feature and time, looks first: feature, time, row in each table or -1."""
    n_looks, n_asked = len(looks.stamp_s), len(asked.stamp_s)
    feature = np.concatenate([_feature_of(looks.first), _feature_of(asked.first)])
    time = np.concatenate([looks.stamp_s, asked.stamp_s])
    order = np.lexsort((time, feature))  # stable: of equal times the looks stay in front
    look = np.concatenate([np.arange(n_looks), np.full(n_asked, -1)])
    instant = np.concatenate([np.full(n_looks, -1), np.arange(n_asked)])
    return feature[order], time[order], look[order], instant[order]
