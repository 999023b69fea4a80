"""Mixtures of lifetimes: some chairs move every hour, some never."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from evermap.errors import ConfigError
from evermap.survival.base import Lifetime, LifetimePrior, Seed
from evermap.survival.logmath import log_sum_exp
from evermap.types import FloatArray


@dataclass(frozen=True, slots=True)
class Mixture(Lifetime):
    """`S(t) = sum_i weights[i] S_i(t)`; every sum below is of positive terms, so nothing cancels.

    Attributes:
        components: the priors, at least one.
        weights: their probabilities, positive, of sum 1.
    """

    components: tuple[LifetimePrior, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.components) == 0 or len(self.components) != len(self.weights):
            raise ConfigError(f"{len(self.components)} components need as many weights (at least one)", field="weights")
        if not all(math.isfinite(w) and w > 0.0 for w in self.weights):
            raise ConfigError(f"weights must be finite and positive, not {self.weights}", field="weights")
        if abs(math.fsum(self.weights) - 1.0) > 1e-9:
            raise ConfigError(f"weights must sum to 1, not {math.fsum(self.weights)!r}", field="weights")

    @classmethod
    def of(cls, components: Sequence[LifetimePrior], shares: Sequence[float]) -> Self:
        """Mix priors in proportion to `shares`, which need not sum to 1."""
        total = math.fsum(shares)
        if not (math.isfinite(total) and total > 0.0):
            raise ConfigError(f"shares must be positive, not {tuple(shares)}", field="shares")
        return cls(tuple(components), tuple(share / total for share in shares))

    @property
    def p_never_leaves(self) -> float:
        return math.fsum(w * c.p_never_leaves for w, c in zip(self.weights, self.components, strict=True))

    def mean(self) -> float:
        return sum(w * c.mean() for w, c in zip(self.weights, self.components, strict=True))

    def sample(self, rng: Seed, size: int | tuple[int, ...] | None = None) -> FloatArray:
        generator = np.random.default_rng(rng)
        chosen = np.asarray(
            generator.choice(len(self.weights), size=size, p=np.divide(self.weights, sum(self.weights)))
        )
        lifetime = np.empty(chosen.shape)
        for index, component in enumerate(self.components):
            mine = chosen == index
            lifetime[mine] = component.sample(generator, int(mine.sum()))
        return lifetime[()]

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        weights = self._log_weights_at(a)
        died = self._log_died(weights, a, b)
        survival = [c.log_conditional_survival(a, b) for c in self.components]
        lived = log_sum_exp(weights + np.stack(survival, axis=-1))
        return np.where(died < math.log(0.5), -np.log1p(-np.exp(died)), np.maximum(-lived, 0.0))

    def _log_integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        died = self._log_died(self._log_weights_at(a), a, b)
        # Where 1 - q is tiny, H = 1 - q to the last digit, and only its logarithm may be representable.
        return np.where(died < -40.0, died, np.log(self._integrated_hazard(a, b)))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        hazards = np.stack([np.log(c.hazard(t)) for c in self.components], axis=-1)
        weights = self._log_weights_at(t)
        # A component with S(t) = 0 has an infinite hazard, and weight 0.
        alive = np.where(np.isneginf(weights), -np.inf, weights + hazards)
        return np.where(np.isneginf(weights).all(axis=-1), np.inf, log_sum_exp(alive))

    def _log_weights_at(self, t: FloatArray) -> FloatArray:
        """Return log probabilities (..., components) given survival until `t`; all -inf if `S(t) = 0`."""
        joint = np.stack([np.asarray(c.log_survival(t)) for c in self.components], axis=-1) + np.log(self.weights)
        total = log_sum_exp(joint)
        return np.where(np.isneginf(total)[..., None], -np.inf, joint - total[..., None])

    def _log_died(self, weights: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
        died = log_sum_exp(weights + np.stack([c.log_conditional_death(a, b) for c in self.components], axis=-1))
        void = np.isneginf(weights).all(axis=-1)
        return np.where(void, np.where(a == b, -np.inf, 0.0), died)
