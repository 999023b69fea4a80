"""The run-length filter and its smoothing, against summation over every way in which a feature can have changed.

Within a step a feature changes at most once, in the middle. So `T` steps have `2^T` patterns of changes, and for each
the lifetimes' own conditional survival gives the probability.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from evermap.errors import ConfigError, DataError, InputError, NumericalError
from evermap.existence.lifetimes import edges
from evermap.existence.protocol import Instants, LookColumns, Looks, PresenceModel
from evermap.existence.rhythm import BINS, DayShares, Rhythm, bin_of_week
from evermap.existence.run_length import RunLength, RunLengthBelief
from evermap.existence.run_length_smoothing import lattice
from evermap.survival import Exponential, LifetimePrior, LogNormal, PiecewiseConstantHazard, Uniform, never_leaves
from evermap.types import FloatArray

if TYPE_CHECKING:
    from evermap.existence.run_length_kernels import First

# Steps of hazard whose edges are edges of the filter's bins: the table is exact.
STAY = PiecewiseConstantHazard((0.0, 1.0, 2.0, 5.0, 12.0), (0.02, 0.3, 0.9, 0.05, 0.2))
ABSENCE = PiecewiseConstantHazard((0.0, 0.5, 3.0, 8.0), (0.4, 0.0, 0.7, 0.1))
STEP_S = 1.0
MONDAY_S = 4 * 86400.0
BEGIN = ((0, 0.3, 0.25), (0, 2.6, 0.2), (1, 0.0, 0.4), (1, 4.2, 0.15))
"""State, age and probability of the hypotheses to begin with."""


@dataclass(frozen=True)
class Summed:
    """What summation finds at every instant of a lattice of T steps."""

    filtered: FloatArray  # (T + 1,) presence given the looks so far
    ahead: FloatArray  # (T,) presence at the end of each step before the look there
    smoothed: FloatArray  # (T + 1,) presence given all
    log_evidence: float
    events: dict[tuple[int, int, int], float]  # by state, bin of age, ten minutes of the week
    exposure_s: dict[tuple[int, int, int], float]
    of_period: FloatArray
    expected_of_period: FloatArray


def summed(
    model: RunLength, grid: LookColumns, begin: Any = BEGIN, period: Any = None, level: FloatArray | None = None
) -> Summed:
    """Go through every pattern of changes."""
    steps = len(grid.stamp_s) - 1
    pattern = (np.arange(2**steps)[:, None] >> np.arange(steps)) & 1 == 1
    changes = np.tile(pattern, (len(begin), 1))
    first, ages, weights = (np.repeat([row[k] for row in begin], len(pattern)) for k in range(3))
    state, since, weight = first.astype(int), grid.stamp_s[0] - ages, weights.astype(float)
    period = np.zeros(steps, dtype=int) if period is None else period
    level = np.ones((2, period.max() + 1)) if level is None else level

    def look(k: int) -> FloatArray:
        return np.asarray(np.where(state == 1, grid.there[k], grid.gone[k]))

    def presence(mass: FloatArray, where: Any) -> float:
        return float(mass[where == 1].sum() / mass.sum())

    weight = weight * look(0)
    filtered, ahead, states, was = [presence(weight, state)], [], [state], []
    for k in range(steps):
        now, then = grid.stamp_s[k], grid.stamp_s[k + 1]
        middle, gap = 0.5 * (now + then), then - now
        usual = np.empty(len(state))
        for s, prior, rhythm in ((0, model.absence, model.absence_rhythm), (1, model.stay, model.stay_rhythm)):
            mine = state == s
            factor = np.exp(rhythm.log_factor[bin_of_week(middle)]) if rhythm else 1.0
            usual[mine] = -factor * prior.log_conditional_survival(now - since[mine], then - since[mine])
        x = usual * level[state, period[k]]
        part = np.where(x > 1e-9, 1.0 / np.maximum(x, 1e-300) - 1.0 / np.expm1(np.maximum(x, 1e-300)), 0.5)
        was.append((state, middle - since, np.where(changes[:, k], part, 1.0), usual))
        weight = weight * np.where(changes[:, k], -np.expm1(-x), np.exp(-x))
        since = np.where(changes[:, k], middle, since)
        state = np.where(changes[:, k], 1 - state, state)
        ahead.append(presence(weight, state))
        weight = weight * look(k + 1)
        filtered.append(presence(weight, state))
        states.append(state)
    posterior = weight / weight.sum()

    _, edge = edges(model.step_s)
    events: dict[tuple[int, int, int], float] = {}
    exposure: dict[tuple[int, int, int], float] = {}
    of_period, expected = np.zeros(level.shape), np.zeros(level.shape)
    for k, (of_state, age, part, usual) in enumerate(was):
        gap, now = grid.stamp_s[k + 1] - grid.stamp_s[k], grid.stamp_s[k]
        row, column = np.searchsorted(edge, age, side="right") - 1, int(bin_of_week(now + 0.5 * gap))
        for i in np.flatnonzero(posterior > 0.0):
            key = (int(of_state[i]), int(row[i]), column)
            events[key] = events.get(key, 0.0) + posterior[i] * changes[i, k]
            exposure[key] = exposure.get(key, 0.0) + posterior[i] * part[i] * gap * level[of_state[i], period[k]]
        for z in (0, 1):
            of_period[z, period[k]] += (posterior * changes[:, k])[of_state == z].sum()
            expected[z, period[k]] += (posterior * usual * part)[of_state == z].sum()
    smoothed = np.array([presence(posterior, z) for z in states])
    # a prefix of a pattern stands for all that begin with it, but the whole for itself alone
    evidence = float(np.log(weight.sum()))
    return Summed(np.array(filtered), np.array(ahead), smoothed, evidence, events, exposure, of_period, expected)


def beginning(model: RunLength, begin: Any = BEGIN) -> RunLength:
    """The same model with these hypotheses at the first look."""
    from evermap.existence.run_length_kernels import First

    share = model.law.share
    age, weight = np.zeros((1, 2, model.slots)), np.zeros((1, len(share), 2, model.slots))
    number = np.zeros((1, 2), dtype=np.int64)
    for s, old, mass in sorted(begin, key=lambda row: -row[1]):
        age[0, s, number[0, s]], weight[0, :, s, number[0, s]] = old, mass * share
        number[0, s] += 1
    first = First(age, weight, number)
    model = replace(model)
    model.__dict__["first"] = for_all_week(first) if model.law.factor.shape[2] > 1 else first
    return model


def for_all_week(first: First) -> First:
    """The same hypotheses at every ten minutes of the week."""
    return type(first)(*(np.repeat(values, BINS, axis=0) for values in first))  # type: ignore[arg-type]


def looks_at(stamp_s: Any, seed: int) -> Looks:
    """Looks at one feature, each with error probabilities of its own."""
    rng = np.random.default_rng(seed)
    n = len(stamp_s)
    return Looks.from_rows(
        np.zeros(n, dtype=int), stamp_s, rng.random(n) < 0.5, rng.uniform(0.02, 0.6, n), rng.uniform(0.02, 0.6, n)
    )


def stamps(seed: int, longest: float = 3.4) -> FloatArray:
    """Some looks over eleven steps or less, two of them at the same time."""
    rng = np.random.default_rng(seed)
    time = MONDAY_S - 3.0 + np.cumsum(np.append(0.0, rng.uniform(0.05, longest, 4)))
    return np.sort(np.append(time, time[2]))


def rhythm(seed: int) -> Rhythm:
    return Rhythm(np.random.default_rng(seed).normal(0.0, 1.0, BINS))


MODELS = {
    "no rhythm": RunLength(STAY, ABSENCE, STEP_S),
    "both rhythms": RunLength(STAY, ABSENCE, STEP_S, rhythm(1), rhythm(2)),
    "a rhythm of returns": RunLength(STAY, ABSENCE, STEP_S, None, rhythm(3)),
}


def as_tabulated(prior: LifetimePrior, step_s: float) -> PiecewiseConstantHazard:
    """A lifetime of the hazards of its table, up to ages that these tests reach."""
    _, edge = edges(step_s)
    edge = edge[edge <= 64.0 * step_s]
    rates = -prior.log_conditional_survival(edge[:-1], edge[1:]) / np.diff(edge)
    return PiecewiseConstantHazard(tuple(edge), (*rates, 0.0))


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 4))])
@pytest.mark.parametrize("name", MODELS)
def test_the_filter_is_the_sum_over_all_patterns(name: str, seed: int) -> None:
    model, looks = beginning(MODELS[name]), looks_at(stamps(seed), seed)
    grid = lattice(looks, STEP_S)
    expected = summed(model, grid)
    track = model.track(looks)
    at_looks = np.searchsorted(grid.stamp_s, looks.stamp_s)
    last_of_time = np.append(np.diff(looks.stamp_s) > 0.0, True)
    np.testing.assert_allclose(
        track.p_present[last_of_time], expected.filtered[at_looks][last_of_time], rtol=1e-10, atol=1e-12
    )
    assert track.log_evidence[0] == pytest.approx(expected.log_evidence, abs=1e-10)
    assert track.merged_mass[0] == 0.0


@pytest.mark.parametrize("name", MODELS)
def test_between_looks_it_is_a_step_without_a_look(name: str) -> None:
    model, looks = beginning(MODELS[name]), looks_at(stamps(5, 2.5)[:4], 5)
    for asked in np.random.default_rng(6).uniform(looks.stamp_s[0], looks.stamp_s[-1] + 4.0, 20):
        before = looks.stamp_s <= asked
        seen = Looks(
            np.array([0, before.sum()]), looks.stamp_s[before], looks.detected[before], looks.p_miss[before],
            looks.p_false[before],
        )  # fmt: skip
        # whole steps from the last look on, and the rest of the way: a look that tells nothing
        nothing = Looks.from_rows(
            np.zeros(before.sum() + 1, dtype=int), np.append(seen.stamp_s, asked), np.append(seen.detected, 1.0),
            np.append(seen.p_miss, 0.5), np.append(seen.p_false, 0.5),
        )  # fmt: skip
        expected = summed(model, lattice(nothing, STEP_S)).ahead[-1]
        found = model.track(looks, Instants(np.array([0, 1]), np.array([asked]))).p_present[0]
        assert found == pytest.approx(expected, rel=1e-10)


def test_smooth_lifetimes_are_those_of_their_tables() -> None:
    stay, absence = LogNormal(1.0, 0.6), LogNormal(0.5, 1.1)
    model = RunLength(as_tabulated(stay, 1.0), as_tabulated(absence, 1.0), 1.0)
    looks = looks_at(stamps(8), 8)
    expected = summed(model, lattice(looks, 1.0))
    track = beginning(RunLength(stay, absence, 1.0)).track(looks)
    assert track.p_present[-1] == pytest.approx(expected.filtered[-1], rel=1e-10)
    assert track.log_evidence[0] == pytest.approx(expected.log_evidence, abs=1e-10)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
@pytest.mark.parametrize("name", MODELS)
def test_smoothing_is_the_sum_over_all_patterns(name: str, seed: int) -> None:
    from evermap.existence.run_length_smoothing import Calendar, SojournCounts, expectations

    model, looks = beginning(MODELS[name]), looks_at(stamps(seed, 3.0), seed)
    grid = lattice(looks, STEP_S)
    steps = len(grid.stamp_s) - 1
    rng = np.random.default_rng(seed)
    period, level = np.sort(rng.integers(0, 3, steps)), rng.uniform(0.3, 2.0, (2, 3))
    expected = summed(model, grid, period=period, level=level)

    n_bins = model.law.hazard_hz.shape[1]
    shape = (2, n_bins, BINS)
    counts = SojournCounts(np.zeros(shape), np.zeros(shape), np.zeros(shape[:2]), np.zeros((2, 3)), np.zeros((2, 3)))
    smoothed = np.empty(steps + 1)
    law = model.law
    if law.factor.shape[2] == 1:  # so that columns are counted here too
        law = law._replace(factor=np.ones((1, 2, BINS)))
        first = for_all_week(model.first)
    else:
        first = model.first
    evidence, at_first = expectations(
        grid, Calendar(np.ones(steps), period, level), model.slots, law, first, counts, smoothed
    )
    assert evidence == pytest.approx(expected.log_evidence, abs=1e-10)
    np.testing.assert_allclose(smoothed, expected.smoothed, rtol=1e-10, atol=1e-12)
    assert at_first == smoothed[0]
    for table, sums in ((counts.events, expected.events), (counts.exposure_s, expected.exposure_s)):
        whole = np.zeros(shape)
        for key, value in sums.items():
            whole[key] = value
        np.testing.assert_allclose(table, whole, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(counts.of_period, expected.of_period, rtol=1e-9)
    np.testing.assert_allclose(counts.expected_of_period, expected.expected_of_period, rtol=1e-9)
    assert counts.open_ended.sum() == pytest.approx(1.0, rel=1e-12)


def test_smoothing_weighs_steps_by_their_importance() -> None:
    from evermap.existence.run_length_smoothing import Calendar, SojournCounts, expectations

    model, looks = beginning(MODELS["no rhythm"]), looks_at(stamps(3), 3)
    grid = lattice(looks, STEP_S)
    steps = len(grid.stamp_s) - 1

    def count(importance: FloatArray) -> SojournCounts:
        shape = (2, model.law.hazard_hz.shape[1], 1)
        zeros = SojournCounts(np.zeros(shape), np.zeros(shape), np.zeros(shape[:2]), np.zeros((2, 1)), np.zeros((2, 1)))
        expectations(
            grid, Calendar(importance, np.zeros(steps, dtype=np.int64), np.ones((2, 1))), model.slots, model.law,
            model.first, zeros, np.empty(steps + 1),
        )  # fmt: skip
        return zeros

    single = [count(np.eye(steps)[k]) for k in range(steps)]
    weights = np.random.default_rng(1).random(steps)
    whole = count(weights)
    np.testing.assert_allclose(
        whole.events, sum(w * c.events for w, c in zip(weights, single, strict=True)), atol=1e-13
    )
    np.testing.assert_allclose(
        whole.exposure_s, sum(w * c.exposure_s for w, c in zip(weights, single, strict=True)), atol=1e-13
    )


@pytest.mark.parametrize("name", ["no rhythm", "both rhythms"])
def test_a_long_recording_is_smoothed_as_a_hidden_markov_chain(name: str) -> None:
    """Exponential lifetimes forget their age: two states, and merging does no harm. Several stretches of steps."""
    from evermap.existence.learn_sojourns import Data
    from evermap.existence.run_length_smoothing import STRETCH

    n = 2 * STRETCH + 500
    rng = np.random.default_rng(4)
    there = np.cumsum(rng.random(n) < 0.05) % 2 == 1
    hits = np.where(there, 0.8, 0.2) > rng.random(n)
    looks = Looks.from_rows(np.zeros(n, int), MONDAY_S + np.cumsum(rng.choice([0.7, 1.0], n)), hits, 0.2, 0.2)
    chosen = MODELS[name]
    model = RunLength(Exponential(0.06), Exponential(0.04), STEP_S, chosen.stay_rhythm, chosen.absence_rhythm)
    found = Data.of(looks, STEP_S, np.inf, rhythm=name != "no rhythm").expect(model)

    grid = lattice(looks, STEP_S)
    gap, middle = np.diff(grid.stamp_s), 0.5 * (grid.stamp_s[1:] + grid.stamp_s[:-1])
    factors = [
        np.ones(n - 1) if one is None else one.factor[bin_of_week(middle)]
        for one in (model.absence_rhythm, model.stay_rhythm)
    ]
    x = np.stack([0.04 * factors[0] * gap, 0.06 * factors[1] * gap], axis=1)
    stays_so, ends = np.exp(-x), -np.expm1(-x)
    likelihood = np.stack([grid.gone, grid.there], axis=1)
    mass = model.first.weight.sum(axis=(1, 3))[0 if name == "no rhythm" else bin_of_week(grid.stamp_s[0])]
    forward, scale = np.empty((n, 2)), np.empty(n)
    for k in range(n):
        before = mass if k == 0 else forward[k - 1] * stays_so[k - 1] + (forward[k - 1] * ends[k - 1])[::-1]
        joint = before * likelihood[k]
        scale[k], forward[k] = joint.sum(), joint / joint.sum()
    backward = np.ones((n, 2))
    for k in range(n - 2, -1, -1):
        onward = likelihood[k + 1] * backward[k + 1] / scale[k + 1]
        backward[k] = stays_so[k] * onward + ends[k] * onward[::-1]
    onward = likelihood[1:] * backward[1:] / scale[1:, None]
    lived, ended = forward[:-1] * stays_so * onward, forward[:-1] * ends * onward[:, ::-1]
    assert found.log_evidence == pytest.approx(np.log(scale).sum(), rel=1e-11)
    np.testing.assert_allclose(found.presence[0], (forward * backward)[:, 1], rtol=1e-8, atol=1e-12)
    part = 1.0 / x - 1.0 / np.expm1(x)
    for s in (0, 1):
        assert found.counts[s].n_events == pytest.approx(ended[:, s].sum(), rel=1e-9)
        spent = (gap * (lived[:, s] + part[:, s] * ended[:, s])).sum()
        assert found.counts[s].exposure_s.sum() == pytest.approx(spent, rel=1e-9)


def test_it_is_a_model_of_presence_and_is_kept_as_plain_values() -> None:
    model = MODELS["a rhythm of returns"]
    assert isinstance(model, PresenceModel)
    looks = looks_at(stamps(1), 1)
    again = RunLength.from_dict(model.to_dict())
    assert again.to_dict() == model.to_dict()
    fresh = RunLength(STAY, ABSENCE, STEP_S, None, rhythm(3))
    np.testing.assert_allclose(again.track(looks).p_present, fresh.track(looks).p_present, atol=1e-5)


@pytest.mark.parametrize("step_s", [0.0, -1.0, np.inf, np.nan])
def test_a_step_that_is_none_is_refused(step_s: float) -> None:
    with pytest.raises(ConfigError, match="is not a step of time"):
        RunLength(STAY, ABSENCE, step_s)


def test_too_few_hypotheses_are_refused() -> None:
    with pytest.raises(ConfigError, match="7 hypotheses are too few"):
        RunLength(STAY, ABSENCE, 1.0, hypotheses=7)


def test_an_impossible_look_is_named() -> None:
    gone = RunLength(Uniform(10.0), never_leaves(), 1.0, newborn=True)
    looks = Looks.from_rows([0, 1, 1], [0.0, 0.0, 50.0], [1, 1, 1], 0.1, 0.0)
    with pytest.raises(NumericalError, match=r"feature 1 at 50\.0 s: this observation is impossible"):
        gone.track(looks)
    state = RunLengthBelief.first(gone, [0.0, 0.0, 0.0])
    with pytest.raises(NumericalError, match="row 2: this observation is impossible"):
        state.update(50.0, 1, 0.1, 0.0, rows=[2])


BAD_LOOKS: dict[str, tuple[tuple[Any, ...], str]] = {
    "p_miss": ((1.0, 1, [0.1, 1.1], 0.1), "p_miss.*row 1: 1.1 is not a probability"),
    "p_false": ((1.0, 1, 0.1, [np.nan, 0.1]), "p_false.*row 0: nan is not a probability"),
    "detected": ((1.0, [1, 2], 0.1, 0.1), "detected.*row 1: 2.0 is neither a detection nor a miss"),
    "back in time": (([1.0, -1.0], 1, 0.1, 0.1), "stamp_s.*row 1: time -1.0 s lies before"),
    "no time": (([np.nan, 1.0], 1, 0.1, 0.1), "stamp_s.*row 0: time nan is not finite"),
    "shape": ((1.0, [1, 1, 1], 0.1, 0.1), r"detected.*shape \(3,\) instead of \(2,\)"),
}


@pytest.mark.parametrize("name", BAD_LOOKS)
def test_bad_looks_are_refused_and_change_nothing(name: str) -> None:
    arguments, message = BAD_LOOKS[name]
    state = RunLengthBelief.first(RunLength(STAY, ABSENCE, 1.0), [0.0, 0.0])
    before = state.weight.copy()
    with pytest.raises(InputError, match=message):
        state.update(*arguments)
    np.testing.assert_array_equal(state.weight, before)


def test_rows_that_do_not_exist_or_come_twice_are_refused() -> None:
    state = RunLengthBelief.first(RunLength(STAY, ABSENCE, 1.0), [0.0, 0.0])
    with pytest.raises(InputError, match="row 2 of 2 does not exist"):
        state.update(1.0, 1, 0.1, 0.1, rows=[0, 2])
    with pytest.raises(DataError, match="row 1 is observed twice"):
        state.update(1.0, 1, 0.1, 0.1, rows=[1, 1])
    with pytest.raises(InputError, match="lies before its"):
        state.update(5.0, 1, 0.1, 0.1).predict(4.0)


def test_the_first_instant_must_be_finite() -> None:
    with pytest.raises(InputError, match="row 1: time nan is not finite"):
        RunLengthBelief.first(RunLength(Exponential(1.0), ABSENCE, 1.0), [0.0, np.nan])


# --- days that do not follow the rhythm -------------------------------------------------------------------------------

SHARES = DayShares(still=0.2, other=0.15, timeless=0.1)
UNUSUAL = replace(MODELS["both rhythms"], unusual=SHARES)


def on_days_of(kinds: tuple[int, int]) -> RunLength:
    """The model of a Sunday of one kind and a Monday of another, written as a rhythm of its own: the reference."""
    factors = []
    for own in (UNUSUAL.absence_rhythm, UNUSUAL.stay_rhythm):
        assert own is not None
        days = own.factor.reshape(7, -1)
        by_kind = (days, 0.0 * days, np.tile(days.mean(axis=0), (7, 1)), np.full_like(days, days.mean()))
        days = days.copy()
        days[6], days[0] = by_kind[kinds[0]][6], by_kind[kinds[1]][0]
        with np.errstate(divide="ignore"):
            factors.append(Rhythm(np.maximum(np.log(days).ravel(), -1000.0)))  # e^-1000 is 0
    return beginning(RunLength(STAY, ABSENCE, STEP_S, factors[1], factors[0]))


def share_of(kinds: tuple[int, int]) -> float:
    shares = (1.0 - sum(SHARES), *SHARES)
    return shares[kinds[0]] * shares[kinds[1]]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
def test_unusual_days_are_the_sum_over_all_their_kinds(seed: int) -> None:
    """From Sunday to Monday, over midnight: every pattern of changes on days of every two kinds."""
    looks = looks_at(stamps(seed), seed)
    model = beginning(UNUSUAL)
    track = model.track(looks)
    last_of_time = np.flatnonzero(np.append(np.diff(looks.stamp_s) > 0.0, True))
    for n in last_of_time[1:]:
        grid = lattice(looks.taken(np.arange(n + 1)), STEP_S)
        rows = [(share_of(k), summed(on_days_of(k), grid)) for k in np.ndindex(4, 4)]  # type: ignore[arg-type]
        mass = np.array([share * np.exp(one.log_evidence) for share, one in rows])
        there = np.array([one.filtered[-1] for _, one in rows])
        assert track.p_present[n] == pytest.approx(mass @ there / mass.sum(), rel=1e-10)
    assert track.log_evidence[0] == pytest.approx(np.log(mass.sum()), abs=1e-10)


@pytest.mark.parametrize("ahead_s", [0.4, 0.8, 1.7])
def test_a_forecast_over_midnight_is_the_sum_over_all_kinds_of_days(ahead_s: float) -> None:
    """A step whose middle is past midnight is one of the new day."""
    looks = looks_at(MONDAY_S + np.array([-3.0, -2.1, -1.3, -0.5]), 4)
    nothing = looks_at(np.append(looks.stamp_s, looks.stamp_s[-1] + ahead_s), 4)
    asked = nothing.stamp_s[-1:]
    grid = lattice(looks, STEP_S)
    steps = lattice(nothing, STEP_S)
    whole = LookColumns(steps.stamp_s, np.ones(len(steps.stamp_s)), np.ones(len(steps.stamp_s)))
    for column, values in ((whole.gone, grid.gone), (whole.there, grid.there)):
        column[np.searchsorted(whole.stamp_s, grid.stamp_s)] = values
    rows = [(share_of(k), summed(on_days_of(k), whole)) for k in np.ndindex(4, 4)]  # type: ignore[arg-type]
    mass = np.array([share * np.exp(one.log_evidence) for share, one in rows])
    expected = mass @ np.array([one.ahead[-1] for _, one in rows]) / mass.sum()
    model = beginning(UNUSUAL)
    assert model.track(looks, Instants(np.array([0, 1]), asked)).p_present[0] == pytest.approx(expected, rel=1e-10)
    state = RunLengthBelief.after(model, looks)
    assert state.predict(asked)[0] == pytest.approx(expected, rel=1e-10)


def test_each_day_is_told_by_its_own_looks() -> None:
    from evermap.existence.run_length_kernels import kinds_of_days

    looks = looks_at(stamps(1), 1)
    grid, model = lattice(looks, STEP_S), beginning(UNUSUAL)
    sunday, monday = kinds_of_days(grid, model.slots, model.law, model.first)
    mass = np.array(
        [[share_of((j, k)) * np.exp(summed(on_days_of((j, k)), grid).log_evidence) for k in range(4)] for j in range(4)]
    )
    shares = np.array([1.0 - sum(SHARES), *SHARES])
    posterior = mass.sum(axis=0) / mass.sum()  # of Monday, the last day: that of Sunday does not know Monday's looks
    np.testing.assert_allclose(monday * shares, posterior, rtol=1e-9)
    early = lattice(looks.taken(looks.stamp_s < MONDAY_S), STEP_S)
    mass = np.array([shares[j] * np.exp(summed(on_days_of((j, 0)), early).log_evidence) for j in range(4)])
    np.testing.assert_allclose(sunday * shares, mass / mass.sum(), rtol=1e-9)


def test_few_looks_tell_a_still_day_and_midnight_forgets_it() -> None:
    """Hazards of one change in ten minutes by day: an hour of misses on a Monday is unlike a working day."""
    busy = np.full((7, 144), -20.0)
    busy[:5, 48:108] = 0.0
    rhythm = Rhythm(busy.ravel())
    model = RunLength(
        Exponential(1 / 600), Exponential(1 / 600), 60.0, rhythm, rhythm, unusual=DayShares(0.02, 0.0, 0.0)
    )
    nine, time = MONDAY_S + 9 * 3600.0, np.arange(0.0, 3 * 3600.0, 600.0)

    def p_busy(detected: FloatArray, at: float) -> float:
        looks = Looks.from_rows(np.zeros(len(time), int), nine + time, detected, 0.1, 0.1)
        return float(model.track(looks, Instants(np.array([0, 1]), np.array([at]))).p_present[0])

    none, some = np.zeros(len(time)), np.arange(len(time)) % 3 == 0
    assert p_busy(none, nine + 8 * 3600.0) < 0.05
    assert p_busy(some, nine + 8 * 3600.0) > 0.45
    assert p_busy(none, nine + 24 * 3600.0) == pytest.approx(0.5 * (1.0 - 0.02), abs=1e-3)  # closed, if still again


def test_unusual_days_are_kept_as_plain_values_and_need_a_rhythm() -> None:
    again = RunLength.from_dict(UNUSUAL.to_dict())
    assert again.unusual == SHARES
    old = {key: value for key, value in UNUSUAL.to_dict().items() if key != "unusual"}
    assert RunLength.from_dict(old).unusual is None  # written before there were any
    with pytest.raises(ConfigError, match=r"unusual.*without a rhythm"):
        RunLength(STAY, ABSENCE, STEP_S, unusual=SHARES)
    for wrong in (DayShares(-0.1, 0.1, 0.1), DayShares(0.5, 0.3, 0.2), DayShares(np.nan, 0.1, 0.1)):
        with pytest.raises(ConfigError, match="are not shares of days"):
            replace(UNUSUAL, unusual=wrong)
