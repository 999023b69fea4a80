"""A landmark that jumps between a few places, watched by a robot that stands still (Nielsen 2024, section 8.1).

What the paper states: the robot is at the origin, one landmark has three modes, its x and y are measured with white
noise `R = diag(r, r)` in 30 timesteps, and with complete SLAM the state `(x, y, heading)` walks with
`Q = diag(0.01^2, 0.01^2, 0.001^2)`. What it shows only in a plot, or not at all, is chosen here: where the modes are,
how often the landmark moves, and how well the map knows them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError
from evermap.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class ModeConfig:
    """The scenario; the defaults of the first block are the paper's, those of the second are ours.

    Attributes:
        steps: measurements a run.
        walk_sigma: standard deviation of each step of the state: x [m], y [m], heading [rad].
        mode_m: where the landmark can be: corners of an equilateral triangle, 1 m apart, 2 to 3 m from the robot.
        switch_probability: of the landmark to be elsewhere at the next step, each of the other modes equally likely.
        map_sigma_m: error of the map's modes, each axis.
    """

    steps: int = 30
    walk_sigma: tuple[float, float, float] = (0.01, 0.01, 0.001)

    mode_m: tuple[tuple[float, float], ...] = ((2.0, 0.0), (3.0, 0.0), (2.5, 0.75**0.5))
    switch_probability: float = 0.1
    map_sigma_m: float = 0.1

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ConfigError(f"must be positive, not {self.steps}", field="steps")
        if len(self.mode_m) < 2:
            raise ConfigError("a landmark that moves has at least two modes", field="mode_m")
        if not 0.0 <= self.switch_probability <= 1.0:
            raise ConfigError(f"not in [0, 1]: {self.switch_probability!r}", field="switch_probability")

    @property
    def transition(self) -> FloatArray:
        """(K, K) probability of the mode in the column after that in the row."""
        count = len(self.mode_m)
        away = self.switch_probability / (count - 1)
        return np.full((count, count), away) + (1.0 - self.switch_probability - away) * np.eye(count)


@dataclass(frozen=True, slots=True)
class ModeRuns:
    """N runs of T steps.

    Attributes:
        pose: (N, T, 3) where the robot is.
        mode: (N, T) which mode the landmark is in.
        measured_m: (N, T, 2) the landmark in the robot's frame, with noise.
        map_m: (N, K, 2) the modes as the map has them.
    """

    pose: FloatArray
    mode: IntArray
    measured_m: FloatArray
    map_m: FloatArray

    def __len__(self) -> int:
        return len(self.mode)


def simulate_modes(
    n: int, variance_m2: float, config: ModeConfig, seed: int | np.random.SeedSequence, *, walks: bool = False
) -> ModeRuns:
    """Draw `n` runs. Runs of the same seed differ by the size of their noise only, whatever the variance.

    Args:
        n: how many.
        variance_m2: of the noise of x and of y, the paper's r.
        config: the scenario.
        seed: same seed, same runs.
        walks: whether the robot walks and the map has errors; else it stands at the origin and the map is exact.

    Raises:
        ConfigError: `n` or the variance is not positive.
    """
    if n < 1:
        raise ConfigError(f"{n} runs cannot be drawn", field="n", hint="a number from 1")
    if not 0.0 < variance_m2 < np.inf:
        raise ConfigError(f"must be positive, not {variance_m2!r}", field="variance_m2")
    rng = np.random.default_rng(seed)
    place = np.array(config.mode_m)
    mode = _draw_modes(n, config, rng)
    walk = rng.standard_normal((n, config.steps, 3)) * config.walk_sigma
    walk[:, 0] = 0.0
    noise = rng.standard_normal((n, config.steps, 2)) * np.sqrt(variance_m2)
    error = rng.standard_normal((n, *place.shape)) * config.map_sigma_m
    pose = np.cumsum(walk, axis=1) if walks else np.zeros((n, config.steps, 3))
    return ModeRuns(pose, mode, in_robot(pose, place[mode]) + noise, place + (error if walks else np.zeros_like(error)))


def in_robot(pose: FloatArray, point_m: FloatArray) -> FloatArray:
    """Points (..., 2) of the world in the robot's frame, poses (..., 3)."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    dx, dy = point_m[..., 0] - pose[..., 0], point_m[..., 1] - pose[..., 1]
    return np.stack([c * dx + s * dy, c * dy - s * dx], axis=-1)


def log_likelihoods(pose: FloatArray, mode_m: FloatArray, measured_m: FloatArray, variance_m2: float) -> FloatArray:
    """(N, T, K) log density of every measurement (N, T, 2) from poses (N, T, 3), were the landmark in each mode."""
    expected = in_robot(pose[:, :, None, :], mode_m[:, None, :, :])
    squared = ((measured_m[:, :, None, :] - expected) ** 2).sum(axis=-1)
    return np.asarray(-0.5 * squared / variance_m2 - np.log(2.0 * np.pi * variance_m2))


def _draw_modes(n: int, config: ModeConfig, rng: np.random.Generator) -> IntArray:
    """(N, T) chains, the first mode any with the same probability."""
    count = len(config.mode_m)
    mode = np.zeros((n, config.steps), dtype=np.int64)
    mode[:, 0] = rng.integers(count, size=n)
    moves = rng.random((n, config.steps)) < config.switch_probability
    by = rng.integers(1, count, size=(n, config.steps))
    for step in range(1, config.steps):
        mode[:, step] = (mode[:, step - 1] + moves[:, step] * by[:, step]) % count
    return mode
