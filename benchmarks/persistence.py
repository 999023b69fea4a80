"""How long the persistence filter takes, beside the paper's algorithm and beside what the memory alone would take.

`evermap bench --only persistence` measures; each filter is one function in `CASES`. Everyone counts with the best turn:
on a machine that others use too, everything that goes wrong makes a turn longer.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks import rosen
from evermap.existence import single
from evermap.existence.batch import ConstantRate, LeaveAndReturn, Looked, RowLooks, RowState, UnknownRate, look
from evermap.existence.one_stay import PersistenceFilter
from evermap.existence.run_length import RunLength, RunLengthBelief
from evermap.survival import Exponential, GeneralPurpose, LogNormal
from evermap.types import FloatArray

N_FEATURES = 1_000_000
SECONDS = 4.0
"""How long contenders take turns, at least twice."""
HORIZON_S = 3600.0
"""How long after the look the belief is asked for: later costs more than at the look."""
CORES = len(os.sched_getaffinity(0))

METRICS: dict[str, tuple[str, float, str]] = {
    "exponential_speed_ratio": (
        "higher",
        0.35,
        "speed of a look at a million features over Rosen's algorithm in numba",
    ),
    "general_purpose_speed_ratio": ("higher", 0.35, "the same with lifetimes of unknown rate"),
    "one_exponential_speed_ratio": ("higher", 0.35, "speed of one feature's update over Rosen's algorithm in Python"),
    "one_general_purpose_speed_ratio": ("higher", 0.35, "the same with a lifetime of unknown rate"),
    "exponential_floor_ratio": ("lower", 0.5, "time of a look over the time that its bytes need in a plain copy"),
}
"""Metric: which direction is better, relative tolerance, meaning."""


@dataclass(frozen=True, slots=True)
class Case:
    """One filter at work.

    Attributes:
        name: what it is called in the table.
        n: updates of one call.
        limit_ns: what an update may take on one thread.
        work: does them on one thread.
        spread: does them on all, where it can.
        moved_bytes: read and written for an update where the memory may be what limits.
        peers: others that do the same.
    """

    name: str
    n: int
    limit_ns: float
    work: Callable[[], Any]
    spread: Callable[[], Any] | None = None
    moved_bytes: int = 0
    peers: dict[str, Callable[[], Any]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Fleet:
    """Features in the midst of their lives, and one look at each: everything differs from row to row."""

    low_hz: FloatArray
    high_hz: FloatArray
    before: rosen.State
    looks: rosen.Looks

    @property
    def inverse_odds(self) -> FloatArray:
        """(N,) what `before` says, as evermap keeps it."""
        state = self.before
        present = state.likelihood + self.log_survival(state.stamp_s)
        return np.asarray(np.exp(state.partial_evidence - present), dtype=np.float64)

    @property
    def log_survival(self) -> Callable[[FloatArray], FloatArray]:
        if self.high_hz.any():
            return rosen.log_survival_general_purpose(self.low_hz, self.high_hz)
        return rosen.log_survival_exponential(self.low_hz)


def fleet(n: int, *, exponential: bool, seed: int = 0) -> Fleet:
    """`n` features after one look each at ages up to a day, looked at again a second to a day later."""
    random = np.random.default_rng(seed)
    low = 10 ** random.uniform(-6, -4, n) if exponential else 10 ** random.uniform(-8, -6, n)
    high = np.zeros(n) if exponential else 10 ** random.uniform(-3, 0, n)
    first = random.uniform(1.0, 86400.0, n)

    def looks(stamp_s: FloatArray) -> rosen.Looks:
        rates = (random.uniform(0.05, 0.5, n), random.uniform(0.01, 0.3, n))
        return rosen.Looks(stamp_s, random.random(n) < 0.5, *rates)

    start = Fleet(low, high, rosen.start(n), looks(first))
    if exponential:
        before, _ = rosen.step_numpy(start.before, start.looks, start.log_survival, 0.0)
    else:
        before = rosen.State(*(np.empty(n) for _ in range(3)), first)
        rosen.step_numba(start.before, start.looks, low, high, 0.0, before, np.empty(n))
    return Fleet(low, high, before, looks(first + 10 ** random.uniform(0.0, 4.9, n)))


def exponential(n: int) -> Case:
    features = fleet(n, exponential=True)
    return _batch_case("exponential", 10.0, features, ConstantRate(features.low_hz))


def general_purpose(n: int) -> Case:
    features = fleet(n, exponential=False)
    return _batch_case("general purpose", 30.0, features, UnknownRate(features.low_hz, features.high_hz))


def general_purpose_now(n: int) -> Case:
    """The belief at the look itself, where the update has it already."""
    features = fleet(n, exponential=False)
    rates = UnknownRate(features.low_hz, features.high_hz)
    return _batch_case("general purpose, belief at the look", 30.0, features, rates, 0.0)


def one_exponential(n: int) -> Case:
    rate = 1e-5
    return _one_case("one exponential feature", n, Exponential(rate), lambda t: -rate * t)


def one_general_purpose(n: int) -> Case:
    low, high = 1e-7, 1e-2
    return _one_case("one general-purpose feature", n, GeneralPurpose(low, high), rosen.log_survival_of_one(low, high))


def stream(n: int) -> Case:
    """`run` on looks at a hundredth as many features in no order, each with one of two priors."""
    random = np.random.default_rng(1)
    features = max(n // 100, 1)
    which = random.integers(0, 2, features)
    state = single.init(features, (Exponential(1e-5), GeneralPurpose(1e-7, 1e-2)), prior_of_row=which)
    feature, stamp = random.integers(0, features, n), random.uniform(0.0, 86400.0, n)
    looks = (random.random(n) < 0.5, random.uniform(0.05, 0.5, n), random.uniform(0.01, 0.3, n))
    return Case("`run` on a stream", n, np.inf, lambda: state.run(feature, stamp, *looks))


def two_state(n: int) -> Case:
    """Features that come and go, stays and absences exponential."""
    features = fleet(n, exponential=True)
    random = np.random.default_rng(2)
    rates = LeaveAndReturn(features.low_hz, 10 ** random.uniform(-6, -4, n))
    before, sight = RowState(features.inverse_odds, features.before.stamp_s), RowLooks(*features.looks)
    out = Looked(np.empty(n), np.empty(n))

    def ours(threads: bool) -> FloatArray:
        return look(before, rates, sight, horizon_s=HORIZON_S, out=out, threads=threads).probability

    moved = sum(column.itemsize for column in (*before, *rates, *sight, *out))
    return Case("leaves and returns, exponential", n, 40.0, lambda: ours(False), lambda: ours(True), moved)


def run_length(n: int) -> Case:
    """Features that come and go, stays and absences log-normal, 64 hypotheses each, looked at every ten seconds."""
    model = RunLength(LogNormal(6.0, 0.5), LogNormal(7.0, 0.5), step_s=10.0, hypotheses=64)
    count = max(n // 100, 1)
    random = np.random.default_rng(3)
    rates = (random.uniform(0.05, 0.5, count), random.uniform(0.01, 0.3, count))
    state = RunLengthBelief.first(model, random.uniform(0.0, 10.0, count))
    for _ in range(100):  # until the lists are full
        state = state.update(state.stamp_s + 10.0, random.random(count) < 0.5, *rates)
    seen = random.random(count) < 0.5
    work = lambda: state.update(state.stamp_s + 10.0, seen, *rates).probability  # noqa: E731
    return Case("leaves and returns, 64 hypotheses of run length", count, 1000.0, work)


CASES: tuple[Callable[[int], Case], ...] = (
    exponential,
    general_purpose,
    general_purpose_now,
    one_exponential,
    one_general_purpose,
    stream,
    two_state,
    run_length,
)
"""Each makes its case for a number of features."""


def run(n_features: int = N_FEATURES, seconds: float = SECONDS) -> tuple[dict[str, float], dict[str, Any]]:
    """The metrics, and all times as they were: a row for each case, the memory, and what the machine was busy with."""
    busy_before = os.getloadavg()[0]
    bandwidth = {"one": _copy_bandwidth(n_features, seconds, 1), "all": _copy_bandwidth(n_features, seconds, CORES)}
    rows: dict[str, dict[str, Any]] = {}
    for make in CASES:
        rows[make.__name__] = _row(make(n_features), seconds, bandwidth)
    shown = {
        "n_features": n_features,
        "seconds": seconds,
        "cores": CORES,
        "load": [busy_before, os.getloadavg()[0]],
        "copy_gb_per_s": bandwidth,
        "cases": rows,
        "torch": _torch(n_features, seconds),
    }
    measured = {f"{name}_speed_ratio": rows[name]["peers_ns"]["numba"] / rows[name]["ns"] for name in _BATCH}
    for name in ("one_exponential", "one_general_purpose"):
        measured[f"{name}_speed_ratio"] = rows[name]["peers_ns"]["Python"] / rows[name]["ns"]
    measured["exponential_floor_ratio"] = rows["exponential"]["ns"] / rows["exponential"]["floor_ns"]
    return measured, shown


_BATCH = ("exponential", "general_purpose")


def as_markdown(shown: dict[str, Any]) -> str:
    """The table of docs/results/persistence-speed.md."""
    threads = shown["cores"]
    head = ["one update and belief", "expected [ns]", "1 thread [ns]", "floor [ns]", "time / floor"]
    head += [f"{threads} threads [ns]", "[millions a second]", "floor [ns]", "time / floor", "Rosen's algorithm [ns]"]
    lines = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * 8 + " --- |"]
    for row in shown["cases"].values():
        peers = ", ".join(f"{name} {_number(ns)} ({ns / row['ns']:.1f} ×)" for name, ns in row["peers_ns"].items())
        limit = f"≤ {row['limit_ns']:.0f}" if row["limit_ns"] else "–"
        cells = [row["name"], limit, *map(_number, (row["ns"], row["floor_ns"], row["over_floor"]))]
        spread = row["spread_ns"]
        cells += [_number(spread), f"{1e3 / spread:.0f}" if spread else "–"]
        cells += [*map(_number, (row["spread_floor_ns"], row["spread_over_floor"])), peers or "–"]
        lines.append("| " + " | ".join(cells) + " |")
    copy, load = shown["copy_gb_per_s"], shown["load"]
    said = (
        f"{shown['n_features']} features, best turn in {shown['seconds']:.3g} s; load of the machine (1 minute) "
        f"{load[0]:.1f} before and {load[1]:.1f} after. Floor: bytes read and written over the bandwidth of a plain "
        f"copy in the same run, {copy['one']:.1f} GB/s on one thread and {copy['all']:.1f} GB/s on {threads}."
    )
    lines += ["", said]
    for device, times in shown["torch"].items():
        text = ", ".join(f"{name.replace('_', ' ')} {_number(ns)} ns" for name, ns in times.items())
        lines.append(f"Tensors on {device}: {text}.")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"


def _batch_case(
    name: str,
    limit_ns: float,
    features: Fleet,
    rates: ConstantRate | UnknownRate,
    horizon_s: float = HORIZON_S,
) -> Case:
    n = len(features.low_hz)
    state, looks, out = features.before, features.looks, Looked(np.empty(n), np.empty(n))
    before, sight = RowState(features.inverse_odds, state.stamp_s), RowLooks(*looks)
    after, belief = rosen.State(*(np.empty(n) for _ in range(3)), looks.time_s), np.empty(n)

    def by_numba() -> FloatArray:
        rosen.step_numba(state, looks, features.low_hz, features.high_hz, horizon_s, after, belief)
        return belief

    def ours(threads: bool) -> FloatArray:
        return look(before, rates, sight, horizon_s=horizon_s, out=out, threads=threads).probability

    return Case(
        name,
        n,
        limit_ns,
        lambda: ours(False),
        lambda: ours(True),
        moved_bytes=sum(column.itemsize for column in (*before, *rates, *sight, *out)),
        peers={
            "numba": by_numba,
            "numpy": lambda: rosen.step_numpy(state, looks, features.log_survival, horizon_s)[1],
        },
    )


def _one_case(name: str, n: int, prior: Exponential | GeneralPurpose, log_survival: Callable[[float], float]) -> Case:
    count = max(n // 50, 1)
    times = [float(k) for k in range(1, count + 1)]

    def drive(feature: Any) -> float:
        update = feature.update
        for stamp_s in times:
            probability = update(stamp_s, True, 0.2, 0.1)
        return probability

    peers = {"Python": lambda: drive(rosen.OneFeature(log_survival))}
    return Case(name, count, 1000.0, lambda: drive(PersistenceFilter(prior)), peers=peers)


def _row(case: Case, seconds: float, bandwidth: dict[str, float]) -> dict[str, Any]:
    """Nanoseconds an update of everyone in a case, and what the memory needs."""
    best = best_ns({"one": case.work}, seconds)
    best |= best_ns({"all": case.spread}, seconds) if case.spread else {}  # apart: sleeping cores wake up slowly
    best |= best_ns({f"peer {name}": work for name, work in case.peers.items()}, seconds / 2)
    best = {name: ns / case.n for name, ns in best.items()}
    floors = [case.moved_bytes / rate if case.moved_bytes else None for rate in bandwidth.values()]
    spread = best.get("all")
    return {
        "name": case.name,
        "limit_ns": case.limit_ns if np.isfinite(case.limit_ns) else None,
        "ns": best["one"],
        "floor_ns": floors[0],
        "over_floor": best["one"] / floors[0] if floors[0] else None,
        "spread_ns": spread,
        "spread_floor_ns": floors[1],
        "spread_over_floor": spread / floors[1] if spread and floors[1] else None,
        "peers_ns": {name: best[f"peer {name}"] for name in case.peers},
    }


def best_ns(contenders: dict[str, Callable[[], Any]], seconds: float) -> dict[str, float]:
    """Shortest time of each [ns], taking turns; the first call of all compiles and does not count."""
    best = dict.fromkeys(contenders, np.inf)
    for work in contenders.values():
        work()
    end, turns = time.perf_counter() + seconds, 0
    while turns < 2 or (contenders and time.perf_counter() < end):
        turns += 1
        for name, work in contenders.items():
            begin = time.perf_counter()
            work()
            best[name] = min(best[name], 1e9 * (time.perf_counter() - begin))
    return best


def _copy_bandwidth(n: int, seconds: float, threads: int) -> float:
    """Bytes read and written a second by copying as much as a look moves [GB/s]."""
    source, target = np.ones(5 * n), np.empty(5 * n)
    parts = [slice(5 * n * k // threads, 5 * n * (k + 1) // threads) for k in range(threads)]
    with ThreadPoolExecutor(threads) as pool:
        copy = lambda: list(pool.map(lambda part: np.copyto(target[part], source[part]), parts))  # noqa: E731
        ns = best_ns({"copy": copy}, seconds)["copy"]
    return 2 * source.nbytes / ns


def _torch(n: int, seconds: float) -> dict[str, dict[str, float]]:
    """Nanoseconds an update on a GPU by device name; empty where torch or a GPU is missing."""
    try:
        import torch
    except ImportError:
        return {}
    if not torch.cuda.is_available():
        return {}
    times = {}
    for name, rates_of in (("exponential", ConstantRate), ("general_purpose", UnknownRate)):
        features = fleet(n, exponential=rates_of is ConstantRate)
        parameters = [getattr(features, "low_hz" if column == "rate_hz" else column) for column in rates_of._fields]
        for kind in (torch.float32, torch.float64):
            columns: list[Any] = [
                torch.tensor(column, dtype=None if column.dtype == np.bool_ else kind, device="cuda")
                for column in (features.inverse_odds, features.before.stamp_s, *parameters, *features.looks)
            ]

            def work(rates_of: Any = rates_of, columns: list[Any] = columns) -> None:
                look(RowState(*columns[:2]), rates_of(*columns[2:-4]), RowLooks(*columns[-4:]), horizon_s=HORIZON_S)
                torch.cuda.synchronize()

            times[f"{name}_{str(kind).removeprefix('torch.')}"] = best_ns({"": work}, seconds)[""] / n
    return {torch.cuda.get_device_name(): times}
