"""How long the distribution of censored lifetimes takes, beside the EM-ICM of surpyval: CPU time on one core."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from evermap.survival.censored import CensoredLifetimes
from evermap.survival.nonparametric import npmle
from evermap.types import FloatArray

N_LIFETIMES = 100_000
TURNS = 3

METRICS: dict[str, tuple[str, float, str]] = {
    "npmle_exact_speed_ratio": ("higher", 0.5, "censored lifetimes, 30 % exact: speed over surpyval"),
    "npmle_intervals_speed_ratio": ("higher", 0.5, "censored lifetimes, intervals only: speed over surpyval"),
    "npmle_tied_speed_ratio": ("higher", 0.5, "censored lifetimes on a grid of visits: speed over surpyval"),
}
"""Metric: which direction is better, relative tolerance, meaning."""


def exact(n: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Two Weibull lifetimes mixed; 30 % exact, 40 % intervals, 20 % right and 10 % left censored."""
    lifetime = np.where(rng.random(n) < 0.4, 0.6 * rng.weibull(0.8, n), 1.5 * rng.weibull(3.0, n))
    kind = rng.choice(4, n, p=(0.3, 0.4, 0.2, 0.1))
    left, right = lifetime.copy(), lifetime.copy()
    gap, share = rng.exponential(0.5, n), rng.random(n)
    left[kind == 1] = np.maximum(lifetime - share * gap, 0.0)[kind == 1]
    right[kind == 1] = (lifetime + (1.0 - share) * gap)[kind == 1]
    left[kind == 2] = np.minimum(rng.exponential(1.0, n), lifetime * rng.random(n))[kind == 2]
    right[kind == 2] = np.inf
    left[kind == 3] = 0.0
    right[kind == 3] = (lifetime + rng.exponential(0.5, n))[kind == 3]
    return left, right


def intervals(n: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """A gamma and a normal mixed, seen between two looks; a tenth never seen gone, a tenth never seen there."""
    lifetime = np.where(rng.random(n) < 0.5, rng.gamma(4.0, 0.1, n), rng.normal(1.5, 0.3, n).clip(0.01))
    gap, share = rng.exponential(0.4, n), rng.random(n)
    left, right = np.maximum(lifetime - share * gap, 0.0), lifetime + (1.0 - share) * gap
    right[rng.random(n) < 0.1] = np.inf
    left[(rng.random(n) < 0.1) & np.isfinite(right)] = 0.0
    return left, right


def tied(n: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Log-normal lifetimes seen at visits on a grid, so that bounds are shared; some exact, some never seen gone."""
    step = 0.05
    cell = np.floor(rng.lognormal(0.0, 0.6, n) / step)
    width = rng.integers(1, 12, n)
    below = rng.integers(0, 12, n) % width
    left = np.round(np.maximum(cell - below, 0.0) * step, 10)
    right = np.round((cell - below + width) * step, 10)
    at_end = rng.random(n) < 0.15
    left[at_end] = right[at_end] = np.round((cell + 1.0) * step, 10)[at_end]
    right[(rng.random(n) < 0.15) & (left < right)] = np.inf
    return left, right


DATA: dict[str, Callable[[int, np.random.Generator], tuple[FloatArray, FloatArray]]] = {
    "exact": exact,
    "intervals": intervals,
    "tied": tied,
}


def by_surpyval(left: FloatArray, right: FloatArray) -> Any:
    """The same estimate by the peer, by its fastest algorithm and to the tolerance that ours reaches."""
    import surpyval

    return surpyval.Turnbull.fit(
        xl=left, xr=right, turnbull_estimator="Kaplan-Meier", turnbull_algorithm="EMICM", tol=1e-10
    )


def run(n_lifetimes: int = N_LIFETIMES, turns: int = TURNS) -> tuple[dict[str, float], dict[str, Any]]:
    """The metrics, and what each took [s of CPU], with how far from optimal ours ended; they take turns."""
    rng = np.random.default_rng(0)
    npmle(CensoredLifetimes.of(*exact(1000, rng)))  # compiles
    ratios, shown = {}, {}
    for name, draw in DATA.items():
        left, right = draw(n_lifetimes, rng)
        ours, theirs = [], []
        for _ in range(turns):
            began = time.process_time()
            found = npmle(CensoredLifetimes.of(left, right))
            ours.append(time.process_time() - began)
            began = time.process_time()
            by_surpyval(left, right)
            theirs.append(time.process_time() - began)
        shown[name] = {
            "evermap_s": min(ours),
            "surpyval_s": min(theirs),
            "kkt_violation": found.kkt_violation,
        }
        ratios[f"npmle_{name}_speed_ratio"] = min(theirs) / min(ours)
    return ratios, {"n_lifetimes": n_lifetimes, "data": shown}


def as_text(shown: dict[str, Any]) -> str:
    """What each took, a line for each kind of data."""
    lines = [f"distribution of {shown['n_lifetimes']:,} censored lifetimes, CPU time:"]
    for name, row in shown["data"].items():
        times = f"evermap {1e3 * row['evermap_s']:7.1f} ms  surpyval {1e3 * row['surpyval_s']:7.1f} ms"
        lines.append(f"  {name:<10} {times}  optimal to {row['kkt_violation']:.0e}")
    return "\n".join(lines)
