"""Posterior probabilities of modes, and the most probable sequence, of every landmark: exact for every chain.

Without memory a chain is filtered and decoded in one pass (`markov`). With a lifetime the age of a stay matters; then
the state is (mode, first look of its stay), `O(T^2 K)` (`stays`), in blocks of looks so that no table grows with T^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.types import FloatArray, IntArray
from evermap_studies.nielsen2024.selectors.chain import ModeChain, ModeLooks, impossible, log_joint

BLOCK = 64
"""Looks whose transitions are asked of the lifetime in one call."""
SLACK = 1e-6
"""Nats by which rounding may lift a sequence above the bound that it is pruned by."""


@dataclass(frozen=True, slots=True)
class ModeBeliefs:
    """Posterior of the modes.

    Attributes:
        log_filtered: (R, K) log probability of every mode given the looks at that landmark so far.
        log_smoothed: (R, K) given all looks.
        log_evidence: (L,) log probability of the looks at each landmark.
    """

    log_filtered: FloatArray
    log_smoothed: FloatArray
    log_evidence: FloatArray


@dataclass(frozen=True, slots=True)
class Stretch:
    """The looks at one landmark, with its chain.

    Attributes:
        number: which landmark.
        rows: its looks.
        stamp_s, log_likelihood, log_start: (T,), (T, K) and (K,).
        log_others: log of the number of modes that one that is left may be left for; -inf for a single mode.
    """

    number: int
    rows: slice
    stamp_s: FloatArray
    log_likelihood: FloatArray
    log_start: FloatArray
    log_others: float
    gone: int
    chain: ModeChain

    @property
    def memoryless(self) -> bool:
        return self.chain.memoryless or self.log_others == -np.inf

    def gaps(self) -> tuple[FloatArray, FloatArray]:
        """(T,) log probabilities of staying, and of leaving for one particular other, of a chain without memory."""
        if self.log_others == -np.inf:
            return np.zeros(len(self.stamp_s)), np.full(len(self.stamp_s), -np.inf)
        stay, leave = self.chain.log_gaps(self.stamp_s)
        return stay, leave - self.log_others

    def block(self, low: int, high: int, began: IntArray) -> tuple[FloatArray, FloatArray]:
        """(high - low, S) the same before the looks `low` to `high`, of stays that began at the looks `began`."""
        before = self.stamp_s[np.maximum(np.arange(low, high) - 1, 0)][:, None] - self.stamp_s[began]
        until = self.stamp_s[low:high, None] - self.stamp_s[began]
        held = before >= 0.0
        shape = held.shape
        stay, leave = self.chain.log_transitions(
            np.where(held, before, 0.0).ravel(), np.where(held, until, 0.0).ravel()
        )
        return stay.reshape(shape), leave.reshape(shape) - self.log_others


def landmarks(looks: ModeLooks, chain: ModeChain) -> list[Stretch]:
    """The landmarks that were looked at, one after another."""
    exists = looks.exists
    start = chain.log_start(exists)
    with np.errstate(divide="ignore"):
        log_others = np.log(exists.sum(axis=1) - 1.0, where=exists.any(axis=1), out=np.full(len(exists), -np.inf))
    gone = chain.gone_column(exists.shape[1])
    return [
        Stretch(
            number,
            slice(low, high),
            looks.stamp_s[low:high],
            looks.log_likelihood[low:high],
            start[number],
            float(log_others[number]),
            gone,
            chain,
        )
        for number, (low, high) in enumerate(zip(looks.first[:-1], looks.first[1:], strict=True))
        if high > low
    ]


def smoothed(looks: ModeLooks, chain: ModeChain) -> ModeBeliefs:
    """Posterior probabilities of every mode at every look, by forward-backward in log space.

    Of a chain with memory they are exact to about 1e-12 each; smaller ones may come out as 0.

    Raises:
        NumericalError: a landmark for which no sequence of modes is possible.
    """
    from evermap_studies.nielsen2024.selectors.markov import smooth

    filtered, after = np.empty_like(looks.log_likelihood), np.empty_like(looks.log_likelihood)
    evidence = np.zeros(looks.n_landmarks)
    for one in landmarks(looks, chain):
        rows = one.rows
        if one.memoryless:
            value = smooth(one.log_likelihood, one.log_start, *one.gaps(), one.gone, filtered[rows], after[rows])
        else:
            value = _smooth_stays(one, filtered[rows], after[rows])
        if value == -np.inf:
            raise impossible(one.number)
        evidence[one.number] = value
    return ModeBeliefs(filtered, after, evidence)


def most_probable(looks: ModeLooks, chain: ModeChain) -> IntArray:
    """(R,) the sequence of modes with the largest joint probability, of every landmark (Viterbi, exact).

    Raises:
        NumericalError: a landmark for which no sequence of modes is possible.
    """
    from evermap_studies.nielsen2024.selectors.markov import decode

    indicator = np.zeros(len(looks.stamp_s), dtype=np.int64)
    for one in landmarks(looks, chain):
        found = indicator[one.rows]
        if one.memoryless:
            value = decode(one.log_likelihood, one.log_start, *one.gaps(), one.gone, found)
        else:
            value = _decode_stays(one, found)
        if value == -np.inf:
            raise impossible(one.number)
    return indicator


def _smooth_stays(one: Stretch, filtered: FloatArray, after: FloatArray) -> float:
    """`markov.smooth` for a chain with memory."""
    from evermap_studies.nielsen2024.selectors import stays
    from evermap_studies.nielsen2024.selectors.markov import total

    count, modes = one.log_likelihood.shape
    every = np.arange(count)
    weight, left = np.empty((modes, count)), np.empty((count, modes))
    blocks = [(low, min(low + BLOCK, count)) for low in range(0, count, BLOCK)]
    for low, high in blocks:
        stay, leave = one.block(low, high, every[:high])
        stays.filter_rows(low, one.log_likelihood, one.log_start, stay, leave, one.gone, weight, filtered, left)
    evidence = float(total(filtered[-1]))
    if evidence == -np.inf:
        return evidence
    later, follow = np.zeros((modes, count)), np.empty((count, modes))
    for low, high in reversed(blocks):
        stay, leave = one.block(low, high, every[:high])
        stays.smooth_rows(low, one.log_likelihood, stay, leave, one.gone, later, follow)
    stays.marginals(one.log_start, left, follow, evidence, after)
    with np.errstate(divide="ignore"):
        after[:] = np.log(after)
    filtered -= np.logaddexp.reduce(filtered, axis=1, keepdims=True)
    return evidence


def _decode_stays(one: Stretch, indicator: IntArray) -> float:
    """`markov.decode` for a chain with memory.

    After every block the stays are dropped that cannot be part of the optimum any more: those that fall short of a
    sequence that is known, even if all looks to come were explained best and for nothing.
    """
    from evermap_studies.nielsen2024.selectors import stays

    count, modes = one.log_likelihood.shape
    known = _without_memory(one)
    best_to_come = np.append(np.cumsum(one.log_likelihood.max(axis=1)[::-1])[::-1], 0.0)
    back_mode, back_began = np.empty((count, modes), dtype=np.int64), np.empty((count, modes), dtype=np.int64)
    began, value = np.empty(0, dtype=np.int64), np.empty((modes, 0))
    for low in range(0, count, BLOCK):
        high = min(low + BLOCK, count)
        older = len(began)
        began = np.concatenate([began, np.arange(low, high)])
        value = np.concatenate([value, np.full((modes, high - low), -np.inf)], axis=1)
        stay, leave = one.block(low, high, began)
        stays.decode_rows(
            low, one.log_likelihood, one.log_start, stay, leave, one.gone, older, value, back_mode, back_began, began
        )
        value[value + best_to_come[high] < known - SLACK] = -np.inf
        kept = np.isfinite(value).any(axis=0)
        if not kept.any():
            return -np.inf
        began, value = began[kept], np.ascontiguousarray(value[:, kept])
    mode, stay_at = np.unravel_index(int(np.argmax(value)), value.shape)
    stays.trace_back(int(mode), int(began[stay_at]), count, back_mode, back_began, indicator)
    return float(value[mode, stay_at])


def _without_memory(one: Stretch) -> float:
    """Log joint probability of a good sequence: the best one if every mode left as if it were new at every look."""
    from evermap_studies.nielsen2024.selectors.markov import decode

    indicator = np.zeros(len(one.stamp_s), dtype=np.int64)
    decode(one.log_likelihood, one.log_start, *one.gaps(), one.gone, indicator)
    looks = ModeLooks(np.array([0, len(indicator)]), one.stamp_s, one.log_likelihood)
    return float(log_joint(looks, one.chain, indicator)[0])
