"""Figures 6 and 7 of Nielsen 2024: how often each selector picks the wrong mode, and what that does to complete SLAM.

All selectors get the same runs, and runs of different noise differ by its size only.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from evermap.types import FloatArray, IntArray
from evermap_studies.nielsen2024.selectors.chain import ModeChain, ModeLooks
from evermap_studies.nielsen2024.selectors.protocol import Selection, Selector, selector_by_name
from evermap_studies.worlds.moved import ModeConfig, ModeRuns, in_robot, log_likelihoods, simulate_modes

Row = dict[str, Any]

SELECTORS = ("nn", "em", "mcts", "viterbi")
BUDGET_NOISE_M2 = 0.2
"""The noise that the paper shows a run of."""
BUDGETS = (20, 200, 2000, 20000)
"""Iterations of the tree search for every decision; 200 are the default."""
ROUNDS = 10
"""Of selecting and solving, at most (section 8.2.2)."""
GAUSS_NEWTON_STEPS = 4
"""Only the headings are nonlinear, and they are known to a degree: it converges in two."""
_HELD = 1e10
"""Information that holds the first pose at the origin."""


def selector_rows(noises_m2: tuple[float, ...], runs: int, config: ModeConfig, seed: int) -> list[Row]:
    """Figure 6: share of wrong modes over the noise, poses and modes known; and what the selectors cost.

    Args:
        noises_m2: values of r.
        runs: Monte Carlo runs a value.
        config: the scenario.
        seed: of the runs and of the selectors.
    """
    rows: list[Row] = []
    for noise in noises_m2:
        data = simulate_modes(runs, noise, config, seed)
        looks = _looks(data, data.pose, data.map_m, noise)
        found = {name: _timed(_selector(name), looks, config, seed) for name in SELECTORS}
        best = found["viterbi"][0].log_joint
        wrong = {name: _wrong_share(selection, data) for name, (selection, _) in found.items()}
        for name, (selection, seconds) in found.items():
            rows.append(
                {
                    "figure": "6",
                    "noise_m2": noise,
                    "selector": name,
                    "runs": runs,
                    **_mean("wrong_share", wrong[name]),
                    **_mean("wrong_more_than_em", wrong[name] - wrong["em"]),
                    "above_viterbi": int(np.sum(selection.log_joint > best + 1e-9 * np.abs(best))),
                    "same_as_viterbi": int(np.sum(selection.log_joint > best - 1e-9 * np.abs(best))),
                    "us_a_sequence": 1e6 * seconds / runs,
                }
            )
    return rows


def budget_rows(noise_m2: float, runs: int, config: ModeConfig, seed: int) -> list[Row]:
    """What the tree search finds with which budget, poses and modes known; the last row is the optimum."""
    data = simulate_modes(runs, noise_m2, config, seed)
    looks = _looks(data, data.pose, data.map_m, noise_m2)
    contenders = {budget: selector_by_name("mcts", mcts_budget=budget, mcts_window_s=None) for budget in BUDGETS}
    best, seconds = _timed(_selector("viterbi"), looks, config, seed)
    found = {budget: _timed(selector, looks, config, seed, repeat=1) for budget, selector in contenders.items()}
    return [
        {
            "figure": "budget",
            "noise_m2": noise_m2,
            "selector": "mcts" if budget else "viterbi",
            "budget": budget,
            "runs": runs,
            **_mean("wrong_share", _wrong_share(selection, data)),
            **_mean("below_viterbi", best.log_joint - selection.log_joint),
            "same_as_viterbi": int(np.sum(selection.log_joint > best.log_joint - 1e-9 * np.abs(best.log_joint))),
            "us_a_sequence": 1e6 * time_s / runs,
        }
        for budget, (selection, time_s) in (*found.items(), (None, (best, seconds)))
    ]


def slam_rows(noises_m2: tuple[float, ...], runs: int, config: ModeConfig, seed: int) -> list[Row]:
    """Figure 7: error of the last pose and of the landmark's last place together, after complete SLAM."""
    rows: list[Row] = []
    for noise in noises_m2:
        data = simulate_modes(runs, noise, config, seed, walks=True)
        place = np.array(config.mode_m)[data.mode[:, -1]]
        for name in SELECTORS:
            pose, mode_m, mode = _alternate(data, noise, config, _selector(name), seed)
            last = mode_m[np.arange(runs), mode[:, -1]]
            squared = ((pose[:, -1, :2] - data.pose[:, -1, :2]) ** 2).sum(axis=1) + ((last - place) ** 2).sum(axis=1)
            rmse = float(np.sqrt(squared.mean()))
            rows.append(
                {
                    "figure": "7",
                    "noise_m2": noise,
                    "selector": name,
                    "runs": runs,
                    "rmse_m": rmse,
                    "rmse_m_se": float(squared.std(ddof=1) / np.sqrt(runs) / (2.0 * rmse)),
                    **_mean("wrong_share", np.mean(mode != data.mode, axis=1)),
                }
            )
    return rows


def _selector(name: str) -> Selector:
    return selector_by_name(name, mcts_window_s=None)


def _looks(data: ModeRuns, pose: FloatArray, mode_m: FloatArray, noise_m2: float) -> ModeLooks:
    """All runs at once: each is a landmark of its own, looked at once a second."""
    runs, steps = data.mode.shape
    log_likelihood = log_likelihoods(pose, mode_m, data.measured_m, noise_m2)
    return ModeLooks(
        first=np.arange(runs + 1) * steps,
        stamp_s=np.tile(np.arange(steps, dtype=np.float64), runs),
        log_likelihood=log_likelihood.reshape(runs * steps, -1),
    )


def _select(selector: Selector, looks: ModeLooks, config: ModeConfig, seed: int) -> Selection:
    return selector.select(looks, ModeChain(config.switch_probability), np.random.default_rng(seed))


def _timed(
    selector: Selector, looks: ModeLooks, config: ModeConfig, seed: int, repeat: int = 5
) -> tuple[Selection, float]:
    """A selection and its time [s]: the median of several, after one that may compile."""
    selection = _select(selector, looks, config, seed)
    seconds = []
    for _ in range(repeat):
        start = time.perf_counter()
        _select(selector, looks, config, seed)
        seconds.append(time.perf_counter() - start)
    return selection, float(np.median(seconds))


def _wrong_share(selection: Selection, data: ModeRuns) -> FloatArray:
    """(N,) share of the steps of each run with the wrong mode."""
    return np.asarray(np.mean(selection.indicator.reshape(data.mode.shape) != data.mode, axis=1))


def _mean(name: str, samples: FloatArray) -> Row:
    return {name: float(samples.mean()), f"{name}_se": float(samples.std(ddof=1) / np.sqrt(len(samples)))}


def _alternate(
    data: ModeRuns, noise_m2: float, config: ModeConfig, selector: Selector, seed: int
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Select and solve until no mode changes: poses (N, T, 3), modes (N, K, 2) and which of them held (N, T)."""
    pose, mode_m = np.zeros_like(data.pose), data.map_m.copy()
    mode = np.full(data.mode.shape, -1)
    for _ in range(ROUNDS):
        before = mode
        mode = _select(selector, _looks(data, pose, mode_m, noise_m2), config, seed).indicator.reshape(mode.shape)
        if np.array_equal(mode, before):
            break
        pose, mode_m = _solve(data, mode, noise_m2, config, pose, mode_m)
    return pose, mode_m, mode


def _solve(
    data: ModeRuns, mode: IntArray, noise_m2: float, config: ModeConfig, pose: FloatArray, mode_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Least squares of all runs at once, the modes chosen: a walk, measurements of x and y, and the map's modes.

    The package's own smoother takes ranges and bearings with isotropic odometry noise; this scenario has neither.
    """
    (runs, steps), count = mode.shape, mode_m.shape[1]
    size, every = 3 * steps + 2 * count, np.arange(runs)
    fixed = np.zeros((size, size))
    walk = np.diag(1.0 / np.square(config.walk_sigma))
    for step in range(steps - 1):
        at = np.arange(3 * step, 3 * step + 6)
        fixed[np.ix_(at, at)] += np.kron([[1.0, -1.0], [-1.0, 1.0]], walk)
    fixed[np.arange(3), np.arange(3)] += _HELD
    own = np.arange(3 * steps, size)
    fixed[own, own] += 1.0 / config.map_sigma_m**2
    prior = np.concatenate([np.zeros((runs, 3 * steps)), data.map_m.reshape(runs, -1)], axis=1)

    value = np.concatenate([pose.reshape(runs, -1), mode_m.reshape(runs, -1)], axis=1)
    for _ in range(GAUSS_NEWTON_STEPS):
        information = np.broadcast_to(fixed, (runs, size, size)).copy()
        gradient = (value - prior) @ fixed
        for step in range(steps):
            at_mode = 3 * steps + 2 * mode[:, step, None] + np.arange(2)
            at = np.concatenate([np.broadcast_to(3 * step + np.arange(3), (runs, 3)), at_mode], axis=1)
            here, there = value[:, 3 * step : 3 * step + 3], np.take_along_axis(value, at_mode, axis=1)
            residual = in_robot(here, there) - data.measured_m[:, step]
            jacobian = _jacobian(here, there)
            information[every[:, None, None], at[:, :, None], at[:, None, :]] += (
                jacobian.transpose(0, 2, 1) @ jacobian / noise_m2
            )
            gradient[every[:, None], at] += np.einsum("nij,ni->nj", jacobian, residual) / noise_m2
        value = value - np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
    return value[:, : 3 * steps].reshape(pose.shape), value[:, 3 * steps :].reshape(mode_m.shape)


def _jacobian(pose: FloatArray, point_m: FloatArray) -> FloatArray:
    """(N, 2, 5) derivative of `in_robot` by x, y, heading of the pose and x, y of the point."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    seen = in_robot(pose, point_m)
    return np.stack(
        [np.stack([-c, -s, seen[:, 1], c, s], axis=-1), np.stack([s, -c, -seen[:, 0], -s, c], axis=-1)], axis=1
    )
