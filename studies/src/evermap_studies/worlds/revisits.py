"""One feature, revisited now and then by a robot with a fallible detector (Rosen 2016, section VII-A)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class RevisitConfig:
    """The generative model; the paper's letters in brackets, its settings as defaults.

    Attributes:
        horizon_s: length of a sequence (L); the feature's lifetime is uniform on it.
        revisit_rate_hz: rate at which the robot comes back once it has left (lambda_R).
        look_rate_hz: rate of the looks during a visit (lambda_O).
        p_leave: probability that a look is the last of its visit (P_N).
        p_miss: probability of no detection while the feature is there (P_M).
        p_false: probability of a detection when it is gone (P_F).
    """

    horizon_s: float = 1000.0
    revisit_rate_hz: float = 1.0 / 50.0
    look_rate_hz: float = 1.0
    p_leave: float = 0.2
    p_miss: float = 0.1
    p_false: float = 0.1

    def __post_init__(self) -> None:
        for name in ("horizon_s", "revisit_rate_hz", "look_rate_hz", "p_leave"):
            value = getattr(self, name)
            if not 0.0 < value < np.inf:
                raise ConfigError(f"must be positive and finite, not {value!r}", field=name)
        for name in ("p_leave", "p_miss", "p_false"):
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:
                raise ConfigError(f"a probability must lie in [0, 1], not {value!r}", field=name)


@dataclass(frozen=True, slots=True)
class Revisits:
    """N independent sequences of looks, one after the other in flat columns.

    Attributes:
        survival_s: (N,) until when each feature is there (inclusive).
        first: (N + 1,) looks `first[k]` to `first[k + 1]` are those of sequence k.
        stamp_s: (M,) times of the looks, increasing within a sequence, at most the horizon.
        detected: (M,) whether the detector fired.
        visit: (M,) number of the visit within its sequence, from 0.
    """

    survival_s: FloatArray
    first: IntArray
    stamp_s: FloatArray
    detected: BoolArray
    visit: IntArray

    def __len__(self) -> int:
        return len(self.survival_s)

    @property
    def looks(self) -> IntArray:
        """(N,) number of looks of each sequence."""
        return np.diff(self.first)

    @property
    def sequence(self) -> IntArray:
        """(M,) which sequence each look is of."""
        return np.repeat(np.arange(len(self)), self.looks)


def simulate_revisits(n: int, config: RevisitConfig, seed: int | np.random.SeedSequence) -> Revisits:
    """Draw `n` sequences.

    The first visit begins at 0. A look comes an exponential time (`look_rate_hz`) after the one before or after the
    begin of the visit; after each look the robot leaves with `p_leave`, and the next visit begins an exponential time
    (`revisit_rate_hz`) later. The number of looks a visit is thereby geometric.

    Args:
        n: how many sequences.
        config: of the model.
        seed: same seed, same sequences.

    Raises:
        ConfigError: `n` is not positive.
    """
    if n < 1:
        raise ConfigError(f"{n} sequences cannot be drawn", field="n", hint="a number from 1")
    rng = np.random.default_rng(seed)
    survival_s = config.horizon_s * rng.random(n)
    columns: list[tuple[IntArray, FloatArray, IntArray]] = []
    row, clock_s, visit = np.arange(n), np.zeros(n), np.zeros(n, dtype=np.int64)
    away = np.zeros(n, dtype=np.bool_)  # whether each robot has left after its last look
    while len(row):
        shape = (len(row), _block(config))
        leaves = rng.random(shape) < config.p_leave
        left = np.column_stack([away, leaves[:, :-1]])
        gaps = rng.exponential(1.0 / config.look_rate_hz, shape)
        gaps += np.where(left, rng.exponential(1.0 / config.revisit_rate_hz, shape), 0.0)
        stamps = clock_s[:, None] + np.cumsum(gaps, axis=1)
        visits = visit[:, None] + np.cumsum(left, axis=1)
        within = stamps <= config.horizon_s
        columns.append((np.broadcast_to(row[:, None], shape)[within], stamps[within], visits[within]))
        going_on = within[:, -1]
        row, clock_s, visit, away = row[going_on], stamps[going_on, -1], visits[going_on, -1], leaves[going_on, -1]

    sequence, stamp_s, visits = (np.concatenate(column) for column in zip(*columns, strict=True))
    order = np.argsort(sequence, kind="stable")  # later blocks follow earlier ones of the same sequence
    sequence, stamp_s = sequence[order], stamp_s[order]
    there = stamp_s <= survival_s[sequence]
    chance = np.where(there, 1.0 - config.p_miss, config.p_false)
    return Revisits(
        survival_s=survival_s,
        first=np.concatenate([[0], np.cumsum(np.bincount(sequence, minlength=n))]),
        stamp_s=stamp_s,
        detected=rng.random(len(stamp_s)) < chance,
        visit=visits[order],
    )


def _block(config: RevisitConfig) -> int:
    """Looks to draw at a time: about as many as half of the sequences need."""
    mean_gap_s = 1.0 / config.look_rate_hz + config.p_leave / config.revisit_rate_hz
    return 8 + int(config.horizon_s / mean_gap_s)
