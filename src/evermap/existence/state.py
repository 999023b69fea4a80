"""What a persistence filter remembers: one number and one stamp a feature (MATH.md section 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError
from evermap.existence.checks import as_prior
from evermap.survival.base import LifetimePrior
from evermap.types import FloatArray, IntArray

SMALLEST = 1e-300
"""Inverse odds of a feature that is present beyond every finite doubt; exactly 0 is certainty."""
LARGEST = 1e300
"""Inverse odds of a feature that is gone beyond every finite doubt; infinity is certainty."""
LOG_LARGEST = float(np.log(LARGEST))


@dataclass(frozen=True, slots=True)
class Belief:
    """Persistence of `N` features, one row each.

    Attributes:
        inverse_odds: (N,) `(1 - p) / p` right after the last observation; 0 is certainly there, inf gone.
        stamp_s: (N,) time of the last observation, seconds since the feature's birth; 0 before the first.
        priors: the lifetimes in use.
        prior_of_row: (N,) which of `priors` each row has.
        log_evidence: (N,) `log p(y_1:n)` summed so far, or None where nobody asked for it.
    """

    inverse_odds: FloatArray
    stamp_s: FloatArray
    priors: tuple[LifetimePrior, ...]
    prior_of_row: IntArray
    log_evidence: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.inverse_odds)

    @property
    def probability(self) -> FloatArray:
        """(N,) probability that each feature existed at its own last observation."""
        return np.asarray(1.0 / (1.0 + self.inverse_odds), dtype=np.float64)

    @property
    def log_odds(self) -> FloatArray:
        """(N,) the same as log-odds, with infinities for the two certainties."""
        with np.errstate(divide="ignore"):
            return np.asarray(-np.log(self.inverse_odds), dtype=np.float64)


def init(
    n: int,
    prior: LifetimePrior | str | Sequence[LifetimePrior | str],
    *,
    prior_of_row: IntArray | Sequence[int] | None = None,
    evidence: bool = False,
) -> Belief:
    """Beliefs at birth: `n` features that are certainly there, at time 0 of their own clocks.

    Args:
        n: number of features.
        prior: one lifetime prior for all rows, or several; each may be a text, as `exponential:half-life=30d`.
        prior_of_row: (n,) index into `prior`, needed as soon as there is more than one.
        evidence: keep the running log evidence too (for model choice and for learning priors).

    Raises:
        ConfigError: a negative `n`, no prior, a text that describes none, or an index that points at none.
        InputError: something else in place of a prior.
    """
    if n < 0:
        raise ConfigError(f"{n} features cannot be filtered", field="n", hint="a number of rows >= 0")
    given: Sequence[LifetimePrior | str]
    given = (prior,) if isinstance(prior, str) or not isinstance(prior, Sequence) else prior
    priors = tuple(as_prior(one) for one in given)
    if not priors:
        raise ConfigError("no lifetime prior was given", field="prior")
    if prior_of_row is None:
        if len(priors) > 1:
            raise ConfigError(
                f"{len(priors)} priors but nothing says which row has which",
                field="prior_of_row",
                hint="an index per row",
            )
        index = np.zeros(n, dtype=np.int64)
    else:
        index = np.array(prior_of_row, dtype=np.int64)
        if index.shape != (n,):
            raise ConfigError(f"shape {index.shape} instead of ({n},)", field="prior_of_row")
        wrong = np.flatnonzero((index < 0) | (index >= len(priors)))
        if wrong.size:
            row = int(wrong[0])
            raise ConfigError(f"row {row} asks for prior {index[row]} of {len(priors)}", field="prior_of_row")
    return Belief(np.zeros(n), np.zeros(n), priors, index, np.zeros(n) if evidence else None)
