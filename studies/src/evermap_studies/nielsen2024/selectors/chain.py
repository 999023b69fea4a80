"""The Markov chain of modes over the looks at a landmark: the nouns, and the joint probability of a sequence.

A landmark has modes (positions, and perhaps 'gone') of which one is true at a time. Landmarks are independent of each
other, so everything here is ragged: the looks at landmark `l` are rows `first[l]` to `first[l + 1]`, in order of time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError, InputError, NumericalError
from evermap.existence.lifetimes import log_death_odds
from evermap.survival import Exponential
from evermap.survival.base import LifetimePrior
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class ModeLooks:
    """What every look at L landmarks says about their modes; K columns, as many as the landmark with most modes has.

    A landmark has the modes whose column is finite at one of its looks at least.

    Attributes:
        first: (L + 1,) the looks at landmark `l` are rows `first[l]` to `first[l + 1]`.
        stamp_s: (R,) when, never decreasing within a landmark.
        log_likelihood: (R, K) `log psi` of every mode; -inf where the mode does not exist (yet, or any more).
    """

    first: IntArray
    stamp_s: FloatArray
    log_likelihood: FloatArray

    def __post_init__(self) -> None:
        rows = len(self.stamp_s)
        if self.log_likelihood.ndim != 2 or len(self.log_likelihood) != rows:
            raise InputError(f"shape {self.log_likelihood.shape} instead of ({rows}, K)", field="log_likelihood")
        if self.first[0] != 0 or self.first[-1] != rows or (np.diff(self.first) < 0).any():
            raise InputError(f"bounds from {self.first[0]} to {self.first[-1]} of {rows} rows", field="first")
        wrong = np.flatnonzero(np.isnan(self.log_likelihood).any(axis=1) | np.isposinf(self.log_likelihood).any(axis=1))
        if wrong.size:
            raise InputError(f"row {wrong[0]}: not a log likelihood", field="log_likelihood", hint="finite, or -inf")
        backwards = np.flatnonzero(np.diff(self.stamp_s) < 0.0) + 1
        backwards = backwards[~np.isin(backwards, self.first)]
        if backwards.size or not np.isfinite(self.stamp_s).all():
            where = f"row {backwards[0]}: earlier than the row before" if backwards.size else "not finite"
            raise InputError(where, field="stamp_s", hint="sort by landmark, then time")

    @property
    def n_landmarks(self) -> int:
        """L."""
        return len(self.first) - 1

    @property
    def landmark(self) -> IntArray:
        """(R,) the landmark that each row looks at."""
        return np.repeat(np.arange(self.n_landmarks), np.diff(self.first))

    @property
    def exists(self) -> BoolArray:
        """(L, K) which columns are modes of which landmark."""
        found = np.zeros((self.n_landmarks, self.log_likelihood.shape[1]), dtype=np.bool_)
        looked_at = np.flatnonzero(np.diff(self.first))
        if looked_at.size:
            found[looked_at] = np.logical_or.reduceat(np.isfinite(self.log_likelihood), self.first[looked_at])
        return found


@dataclass(frozen=True, slots=True)
class ModeChain:
    """How landmarks change their mode between looks (MATH.md section 5).

    At the first look every mode is equally probable. A mode that is left is left for each of the landmark's others
    with the same probability; who has a single mode stays. With a lifetime, a mode that has held for `tau` since its
    first look is left within a gap `dt` with probability `1 - q(tau, tau + dt)`; then a landmark never changes
    between looks of the same instant.

    Attributes:
        switch_probability: of leaving a mode between two looks (Nielsen's constant epsilon); not used with a lifetime.
        lifetime: how long a mode lasts, or None for the constant.
        gone: the last column is 'gone': never at the first look, never left.
    """

    switch_probability: float = 1e-4
    lifetime: LifetimePrior | None = None
    gone: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.switch_probability <= 1.0:
            problem = f"{self.switch_probability} is not a probability"
            raise ConfigError(problem, field="switch_probability", hint="a number between 0 and 1")

    @property
    def memoryless(self) -> bool:
        """Leaving does not depend on how long a mode has held: a Markov chain over the looks."""
        return self.lifetime is None or isinstance(self.lifetime, Exponential)

    def log_transitions(self, held_s: FloatArray, until_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log probabilities that a mode that has held for `held_s` holds until `until_s`, and that it does not.

        Args:
            held_s: (N,) age of the mode at one look, seconds since its first.
            until_s: (N,) its age at the next, `held_s <= until_s`.
        """
        if self.lifetime is None:
            with np.errstate(divide="ignore"):
                stay, leave = np.log1p(-self.switch_probability), np.log(self.switch_probability)
            return np.full(len(held_s), stay), np.full(len(held_s), leave)
        odds = log_death_odds((self.lifetime,), np.zeros(len(held_s), dtype=np.int64), held_s, until_s)
        return 0.0 - np.logaddexp(0.0, odds), 0.0 - np.logaddexp(0.0, -odds)

    def log_gaps(self, stamp_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The same for the gap before each of (N,) looks, of a memoryless chain; nothing is before the first."""
        gap_s = np.diff(stamp_s, prepend=stamp_s[:1])
        return self.log_transitions(np.zeros(len(gap_s)), gap_s)

    def log_start(self, exists: BoolArray) -> FloatArray:
        """(..., K) log probabilities of the modes at the first look; `exists`: (..., K) as `ModeLooks.exists`."""
        possible = exists.copy()
        if self.gone:
            possible[..., -1] = False
        with np.errstate(divide="ignore"):
            return np.where(possible, -np.log(possible.sum(axis=-1, keepdims=True)), -np.inf)

    def gone_column(self, modes: int) -> int:
        """Which of so many columns is 'gone', or -1."""
        return modes - 1 if self.gone else -1


def log_joint(looks: ModeLooks, chain: ModeChain, indicator: IntArray) -> FloatArray:
    """(L,) log of the chain's prior times the likelihoods of one sequence of modes for every landmark.

    Args:
        looks: what every look says.
        chain: how modes change.
        indicator: (R,) the mode at every look.
    """
    rows = np.arange(len(indicator))
    landmark, exists = looks.landmark, looks.exists
    begins = np.zeros(len(rows), dtype=np.bool_)
    begins[looks.first[:-1][np.diff(looks.first) > 0]] = True
    before = np.maximum(rows - 1, 0)
    changed = ~begins & (indicator != indicator[before])
    stay_row = np.maximum.accumulate(np.where(begins | changed, rows, 0))[before]
    stay_row[begins] = rows[begins]
    before[begins] = rows[begins]
    since_s = looks.stamp_s[before if chain.memoryless else stay_row]
    stay, leave = chain.log_transitions(looks.stamp_s[before] - since_s, looks.stamp_s - since_s)
    others = exists.sum(axis=1)[landmark] - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        prior = np.where(changed, leave - np.log(others), np.where(others > 0, stay, 0.0))
    if chain.gone:
        was_gone = indicator[before] == exists.shape[1] - 1
        prior = np.where(was_gone, np.where(changed, -np.inf, 0.0), prior)
    prior = np.where(begins, chain.log_start(exists)[landmark, indicator], prior)
    prior = np.where(exists[landmark, indicator], prior, -np.inf)
    each = prior + looks.log_likelihood[rows, indicator]
    return np.bincount(landmark, each, minlength=looks.n_landmarks).astype(np.float64)


def impossible(landmark: int) -> NumericalError:
    """The error of a landmark whose looks no sequence of modes can explain."""
    problem = f"landmark {landmark}: no sequence of modes is possible"
    return NumericalError(problem, field="log_likelihood", hint="a finite value for one mode at every look")
