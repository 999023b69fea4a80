"""Every model against mpmath with 60 digits, from 1e-9 s to 1e12 s and for nearly equal times."""

from __future__ import annotations

from collections.abc import Callable

import mpmath as mp
import numpy as np
import pytest

from evermap import survival
from evermap_studies.rosen2016.callable_hazard import CallableHazard

TOLERANCE = 1e-9
Reference = Callable[["mp.mpf"], tuple["mp.mpf", "mp.mpf"]]
"""Time -> (F, S), each with full relative precision."""


def exponential(rate: float) -> Reference:
    return lambda t: (-mp.expm1(-mp.mpf(rate) * t), mp.exp(-mp.mpf(rate) * t))


def weibull(scale: float, shape: float) -> Reference:
    def both(t: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
        hazard = (t / mp.mpf(scale)) ** mp.mpf(shape)
        return -mp.expm1(-hazard), mp.exp(-hazard)

    return both


def lognormal(mu: float, sigma: float) -> Reference:
    def both(t: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
        z = (mp.log(t) - mp.mpf(mu)) / (mp.mpf(sigma) * mp.sqrt(2)) if t > 0 else mp.mpf("-1e9")
        return mp.erfc(-z) / 2, mp.erfc(z) / 2

    return both


def gamma(scale: float, shape: float) -> Reference:
    def both(t: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
        k, x = mp.mpf(shape), t / mp.mpf(scale)
        # Kummer's series for the lower function: mpmath's own takes a difference.
        below = x**k * mp.exp(-x) * mp.hyp1f1(1, k + 1, x) / mp.gamma(k + 1)
        above = mp.gammainc(k, x, regularized=True) if x > 0 else mp.mpf(1)
        return (1 - above if x > 200 + 2 * k else below), above

    return both


def general_purpose(low: float, high: float) -> Reference:
    def both(t: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
        if t == 0:
            return mp.mpf(0), mp.mpf(1)
        s = (mp.e1(mp.mpf(low) * t) - mp.e1(mp.mpf(high) * t)) / mp.log(mp.mpf(high) / mp.mpf(low))
        return 1 - s, s

    return both


def uniform(limit: float) -> Reference:
    return lambda t: (min(t / mp.mpf(limit), mp.mpf(1)), max(1 - t / mp.mpf(limit), mp.mpf(0)))


def stretch(start: float, end: float) -> Reference:
    def both(t: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
        f = min(max(t - mp.mpf(start), 0) / (mp.mpf(end) - mp.mpf(start)), mp.mpf(1))
        return f, 1 - f

    return both


def point(at: float) -> Reference:
    return lambda t: (mp.mpf(1), mp.mpf(0)) if t >= at else (mp.mpf(0), mp.mpf(1))


def mixture(parts: list[tuple[float, Reference]]) -> Reference:
    def both(t: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
        values = [(mp.mpf(w), *part(t)) for w, part in parts]
        return sum((w * f for w, f, _ in values), mp.mpf(0)), sum((w * s for w, _, s in values), mp.mpf(0))

    return both


def hazard_of(integral: Callable[[mp.mpf], mp.mpf]) -> Reference:
    return lambda t: (-mp.expm1(-integral(t)), mp.exp(-integral(t)))


def steps(edges: list[float], rates: list[float]) -> Callable[[mp.mpf], mp.mpf]:
    def integral(t: mp.mpf) -> mp.mpf:
        ends = [mp.mpf(e) for e in edges[1:]] + [mp.inf]
        return sum(
            (mp.mpf(r) * max(min(t, e) - mp.mpf(s), 0) for s, e, r in zip(edges, ends, rates, strict=True)), mp.mpf(0)
        )

    return integral


def periodic(period: float, edges: list[float], rates: list[float]) -> Callable[[mp.mpf], mp.mpf]:
    one = steps(edges, rates)

    def integral(t: mp.mpf) -> mp.mpf:
        turns = mp.floor(t / mp.mpf(period))
        return turns * one(mp.mpf(period)) + one(t - turns * mp.mpf(period))

    return integral


CASES: dict[str, tuple[survival.LifetimePrior, Reference]] = {
    "exponential": (survival.Exponential(1e-4), exponential(1e-4)),
    "weibull, falling": (survival.Weibull(1e3, 0.4), weibull(1e3, 0.4)),
    "weibull, growing": (survival.Weibull(86400.0, 3.5), weibull(86400.0, 3.5)),
    "log-normal": (survival.LogNormal(8.0, 1.5), lognormal(8.0, 1.5)),
    "log-normal, narrow": (survival.LogNormal(5.0, 0.1), lognormal(5.0, 0.1)),
    "log-normal, wide": (survival.LogNormal(-3.0, 8.0), lognormal(-3.0, 8.0)),
    "gamma, falling": (survival.Gamma(3600.0, 0.3), gamma(3600.0, 0.3)),
    "gamma, growing": (survival.Gamma(100.0, 4.5), gamma(100.0, 4.5)),
    "gamma, many stages": (survival.Gamma(10.0, 150.0), gamma(10.0, 150.0)),
    "general purpose, Rosen": (survival.GeneralPurpose(1e-3, 1.0), general_purpose(1e-3, 1.0)),
    "general purpose, seconds to decades": (survival.GeneralPurpose(1e-9, 1.0), general_purpose(1e-9, 1.0)),
    "general purpose, narrow": (survival.GeneralPurpose(1e-3, 1.0001e-3), general_purpose(1e-3, 1.0001e-3)),
    "general purpose, threefold": (survival.GeneralPurpose(1e-5, 3e-5), general_purpose(1e-5, 3e-5)),
    "general purpose, tenfold": (survival.GeneralPurpose(1e-5, 1e-4), general_purpose(1e-5, 1e-4)),
    "uniform": (survival.Uniform(1e3), uniform(1e3)),
    "uniform, long": (survival.Uniform(1e13), uniform(1e13)),
    "mixture": (
        survival.Mixture((survival.Exponential(0.1), survival.LogNormal(12.0, 1.0)), (0.75, 0.25)),
        mixture([(0.75, exponential(0.1)), (0.25, lognormal(12.0, 1.0))]),
    ),
    "mixture with a limit": (
        survival.Mixture((survival.Uniform(50.0), survival.Weibull(1e6, 0.5)), (0.5, 0.5)),
        mixture([(0.5, uniform(50.0)), (0.5, weibull(1e6, 0.5))]),
    ),
    "piecewise": (
        survival.PiecewiseConstantHazard((0.0, 3.0, 1e5), (1.5, 1e-7, 1e-10)),
        hazard_of(steps([0.0, 3.0, 1e5], [1.5, 1e-7, 1e-10])),
    ),
    "periodic, seen at noon": (
        survival.PeriodicHazard(86400.0, (0.0, 28800.0, 64800.0), (3e-8, 1e-6, 1e-8), start_s=43200.0),
        hazard_of(periodic(86400.0, [0.0, 21600.0, 43200.0, 72000.0], [1e-6, 1e-8, 3e-8, 1e-6])),
    ),
    "step, overlapping intervals": (
        survival.StepLifetime((0.0, 10.0, 5e5), (1e3, 1e13, 1e6), (0.5, 0.25, 0.25)),
        mixture([(0.5, stretch(0.0, 1e3)), (0.25, stretch(10.0, 1e13)), (0.25, stretch(5e5, 1e6))]),
    ),
    "step, points and some that stay": (
        survival.StepLifetime((1.0, 1e-3, 7.0), (1.0, 1e4, np.inf), (0.5, 0.25, 0.25)),
        mixture([(0.5, point(1.0)), (0.25, stretch(1e-3, 1e4)), (0.25, point(np.inf))]),
    ),
    "callable, infinite at 0": (
        CallableHazard(lambda t: 1e-3 / np.sqrt(t), horizon_s=2e12),
        hazard_of(lambda t: mp.mpf(2e-3) * mp.sqrt(t)),
    ),
    "callable, falling": (
        CallableHazard(lambda t: 1.0 / (100.0 + t), horizon_s=2e12),
        hazard_of(lambda t: mp.log1p(t / 100)),
    ),
    "callable, growing": (
        CallableHazard(lambda t: 1e-9 * t**1.5, horizon_s=2e12),
        hazard_of(lambda t: mp.mpf(1e-9) * t ** mp.mpf("2.5") / mp.mpf("2.5")),
    ),
    "callable, finite integral": (
        CallableHazard(lambda t: 1e-2 / (1.0 + 1e-3 * t) ** 2, horizon_s=2e12),
        hazard_of(lambda t: mp.mpf(1e-2) * t / (1 + mp.mpf(1e-3) * t)),
    ),
    "periodic": (
        survival.PeriodicHazard(86400.0, (0.0, 28800.0, 64800.0), (0.0, 1e-6, 1e-8)),
        hazard_of(periodic(86400.0, [0.0, 28800.0, 64800.0], [0.0, 1e-6, 1e-8])),
    ),
}


def time_pairs() -> tuple[np.ndarray, np.ndarray]:
    """Pairs a <= b over the whole range: from the start, far apart, close, and closer."""
    grid = np.geomspace(1e-9, 1e12, 43)
    pairs = [(0.0, b) for b in grid]
    pairs += [(a, b) for i, a in enumerate(grid) for b in grid[i + 1 :: 6]]
    pairs += [(a, a * (1.0 + gap)) for a in grid for gap in (1e-12, 1e-9, 1e-6, 1e-3, 0.03, 0.1, 0.3, 0.9)]
    a, b = np.array(pairs).T
    return a, b


def references(both: Reference, a: float, b: float) -> tuple[mp.mpf, mp.mpf]:
    """(log q, log(1 - q)) with full relative precision; the first is -inf where nobody is left."""
    f_a, s_a = both(mp.mpf(a))
    f_b, s_b = both(mp.mpf(b))
    if s_a == 0 or s_b == 0:
        return -mp.inf, mp.mpf(0)
    q = s_b / s_a
    died = (f_b - f_a) / s_a if f_a < 0.5 else 1 - q
    return (mp.log1p(-died) if died < 0.5 else mp.log(q)), (mp.log(died) if died < 0.5 else mp.log1p(-q))


def relative_errors(got: np.ndarray, want: list[mp.mpf]) -> np.ndarray:
    """Relative errors; what is too small or too large for a double counts as right if it is 0 or inf."""
    errors = []
    for value, truth in zip(got, want, strict=True):
        if abs(truth) < 1e-300:
            errors.append(float(abs(value)) if abs(value) > 1e-299 else 0.0)
        elif mp.isinf(truth) or mp.isinf(value):
            errors.append(0.0 if float(truth) == value else np.inf)
        else:
            errors.append(float(abs(mp.mpf(float(value)) / truth - 1)))
    return np.array(errors)


@pytest.mark.parametrize("name", CASES)
def test_logarithms_agree_with_mpmath(name: str) -> None:
    prior, both = CASES[name]
    a, b = time_pairs()
    with mp.workdps(60):
        want = [references(both, x, y) for x, y in zip(a, b, strict=True)]
        alive = relative_errors(prior.log_conditional_survival(a, b), [w[0] for w in want])
        died = relative_errors(prior.log_conditional_death(a, b), [w[1] for w in want])
        first = a == 0.0
        marginal = relative_errors(prior.log_survival(b[first]), [w[0] for w, f in zip(want, first, strict=True) if f])
    worst = max(int(np.argmax(alive)), int(np.argmax(died)), key=lambda i: max(alive[i], died[i]))
    message = f"worst at a={a[worst]!r}, b={b[worst]!r}: {alive[worst]:.1e} (q), {died[worst]:.1e} (1-q)"
    assert max(alive.max(), died.max(), marginal.max()) < TOLERANCE, message


@pytest.mark.parametrize("seed", range(12))
def test_any_parameters_will_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low = 10.0 ** rng.uniform(-12, 2)
    high = low * (1.0 + 10.0 ** rng.uniform(-4, 10))
    scale, shape = 10.0 ** rng.uniform(-3, 8), 10.0 ** rng.uniform(-1.5, 2.5)
    mu, sigma = rng.uniform(-10, 20), 10.0 ** rng.uniform(-1.3, 1)
    a = 10.0 ** rng.uniform(-9, 12, 30)
    b = np.minimum(a * (1.0 + 10.0 ** rng.uniform(-12, 3, 30)), 1e12)
    for prior, both in (
        (survival.GeneralPurpose(low, high), general_purpose(low, high)),
        (survival.Gamma(scale, shape), gamma(scale, shape)),
        (survival.LogNormal(mu, sigma), lognormal(mu, sigma)),
    ):
        with mp.workdps(60):
            want = [references(both, x, y) for x, y in zip(a, b, strict=True)]
            alive = relative_errors(prior.log_conditional_survival(a, b), [w[0] for w in want])
            died = relative_errors(prior.log_conditional_death(a, b), [w[1] for w in want])
        assert max(alive.max(), died.max()) < TOLERANCE, prior
