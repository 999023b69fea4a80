"""Learning of phases: expectations against scipy and brute force, rates against truth and closed forms."""

from __future__ import annotations

import gzip
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from evermap.errors import ConfigError, DataError
from evermap.existence.learn_phases import AUTO, Limits, learn
from evermap.existence.phase_kernels import Expectations, PhaseChain, expect_feature, piece_integral
from evermap.existence.phase_type import PhaseType
from evermap.existence.protocol import Instants, LookColumns, Looks
from evermap.existence.rhythm import BIN_S, BINS, WEEK_S

LEAVE_HZ, RETURN_HZ = 1 / 300.0, 1 / 120.0


def generator(rates: Any) -> Any:
    return rates - np.diag(rates.sum(1))


def random_rates(seed: int, n: int) -> Any:
    rng = np.random.default_rng(seed)
    rates = rng.random((n, n)) * 10 ** rng.uniform(-3, 0, (n, n))
    np.fill_diagonal(rates, 0.0)
    return rates / rates.sum(1).max()


def simulated(
    seed: int,
    span_s: float,
    every_s: float,
    *,
    p_miss: float = 0.1,
    p_false: float = 0.1,
    n_features: int = 1,
    rates: Any = ((0.0, RETURN_HZ), (LEAVE_HZ, 0.0)),
    present: Any = (False, True),
) -> tuple[Looks, Any]:
    """Looks at features that follow a chain, and their true presence."""  # fmt: skip
    rng = np.random.default_rng(seed)
    rates = np.array(rates)
    rows, truth = [], []
    for f in range(n_features):
        time = np.arange(0.0, span_s, every_s)
        phase, now, changes, phases = int(rng.integers(len(rates))), 0.0, [0.0], []
        while now < span_s:
            phases.append(phase)
            now += rng.exponential(1.0 / rates[phase].sum())
            changes.append(now)
            phase = int(rng.choice(len(rates), p=rates[phase] / rates[phase].sum()))
        there = np.array(present)[np.array(phases)[np.searchsorted(changes, time, side="right") - 1]]
        hit = np.where(there, rng.random(len(time)) >= p_miss, rng.random(len(time)) < p_false)
        rows.append((np.full(len(time), f), time, hit))
        truth.append(there)
    feature, time, hit = (np.concatenate(column) for column in zip(*rows, strict=True))
    return Looks.from_rows(feature, time, hit, p_miss, p_false), np.array(truth)


@pytest.mark.parametrize("n", [2, 3, 5])
@pytest.mark.parametrize("span_s", [1e-6, 0.01, 1.0, 14.0])
def test_integrals_are_van_loans(n: int, span_s: float) -> None:
    rng = np.random.default_rng(n)
    rates, forward, backward = random_rates(n, n), rng.dirichlet(np.ones(n)), rng.random(n)
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n] = block[n:, n:] = generator(rates)
    block[:n, n:] = np.outer(backward, forward)
    exact = expm(block * span_s)[:n, n:].T
    probability = forward @ expm(generator(rates) * span_s) @ backward
    begin, found = backward.copy(), np.empty((n, n))
    work = (np.empty((129, n)), np.empty(130), np.empty((2, n)))
    assert piece_integral(forward, begin, rates, rates.sum(1), span_s, work, found) == pytest.approx(probability)
    np.testing.assert_allclose(found, exact / probability, rtol=1e-12)
    np.testing.assert_allclose(begin, expm(generator(rates) * span_s) @ backward / probability, rtol=1e-12)


@pytest.mark.parametrize("bins", [1, BINS])
def test_expectations_are_sums_over_all_paths(bins: int) -> None:
    """Expected time and changes by enumerating the phase at every instant of a grid, each cell by its own integral."""
    n, rng = 3, np.random.default_rng(3)
    rates = np.array([random_rates(k, n) * 2e-3 for k in range(bins)])
    exits, present = rates.sum(2), np.array([0.0, 1.0, 1.0])
    look_s = np.array([200.0, 1000.0, 1000.0, 2600.0])
    there, gone, begin = rng.random(4), rng.random(4), rng.dirichlet(np.ones(n))
    integrals, smoothed, last = np.zeros_like(rates), np.empty(n), np.empty(n)
    evidence, bad = expect_feature(
        PhaseChain(rates, exits, rates, rates[0], present), 0.0, begin, LookColumns(look_s, there, gone),
        (2600.0, np.inf), Expectations(integrals, smoothed, last),
    )  # fmt: skip
    assert bad == -1

    monday = (3 * BINS // 7) if bins > 1 else 0  # 1970-01-01 was a Thursday
    edges = np.unique(np.concatenate([[0.0], np.arange(BIN_S, 2600.0, BIN_S), look_s]))
    cells = [(a, b, monday + int(a / BIN_S) if bins > 1 else 0) for a, b in itertools.pairwise(edges)]
    expected, total, first, final = np.zeros_like(rates), 0.0, np.zeros(n), np.zeros(n)
    moves = [expm(generator(rates[k]) * (b - a)) for a, b, k in cells]
    inside = []
    for a, b, k in cells:
        inside.append(np.empty((n, n, n, n)))
        for i, j in itertools.product(range(n), repeat=2):
            block = np.kron(np.eye(2), generator(rates[k]))
            block[i, n + j] = 1.0
            inside[-1][i, j] = expm(block * (b - a))[:n, n:]
    for path in itertools.product(range(n), repeat=len(edges)):
        weight = begin[path[0]]
        for c, (_, b, _) in enumerate(cells):
            weight *= moves[c][path[c], path[c + 1]]
            for look in np.flatnonzero(look_s == b):
                weight *= there[look] if present[path[c + 1]] else gone[look]
        total += weight
        first[path[0]] += weight
        final[path[-1]] += weight
        for c, (_, _, k) in enumerate(cells):
            expected[k] += weight * inside[c][:, :, path[c], path[c + 1]] / moves[c][path[c], path[c + 1]]
    assert evidence == pytest.approx(np.log(total), rel=1e-12)
    np.testing.assert_allclose(integrals, expected / total, rtol=1e-10)
    np.testing.assert_allclose(smoothed, first / total, rtol=1e-12)
    np.testing.assert_allclose(last, final / total, rtol=1e-12)


def test_rates_are_recovered() -> None:
    """Within three standard errors of each of ten replicates' scatter, and their mean within three of its own."""
    logs = []
    for seed in range(10):
        looks, _ = simulated(seed, 40000.0, 7.0)
        model = learn(looks, phases="two-state", restarts=2).model
        logs.append(np.log([model.rates_hz[1, 0] / LEAVE_HZ, model.rates_hz[0, 1] / RETURN_HZ]))
    scatter = np.std(logs, axis=0, ddof=1)
    assert (scatter < 0.25).all()  # about 95 stays and absences each: 0.1 were they seen without error
    assert (np.abs(np.mean(logs, axis=0)) < 3.0 * scatter / np.sqrt(10.0)).all()


def test_three_phases_are_recovered() -> None:
    """Away for long, away briefly, there: at once the structure is chosen and its rates are found."""
    rates = np.array([[0.0, 0.0, 1 / 4000.0], [0.0, 0.0, 1 / 40.0], [1 / 2000.0, 1 / 300.0, 0.0]])
    looks, _ = simulated(1, 400000.0, 10.0, p_miss=0.02, p_false=0.02, rates=rates, present=(False, False, True))
    learned = learn(looks, rhythm=False)
    assert learned.candidates[0].name == "three-phase"
    assert [candidate.name for candidate in learned.candidates[1:]] == [AUTO[0]]
    found = learned.model.rates_hz[learned.structure.changes]  # away kinds in any order, then leaving to each
    order = [0, 1] if found[0] < found[1] else [1, 0]
    slow, brief, to_slow, to_brief = found[order[0]], found[order[1]], found[2 + order[0]], found[2 + order[1]]
    for value, truth, events in (
        (slow, 1 / 4000, 60),
        (brief, 1 / 40, 300),
        (to_slow, 1 / 2000, 60),
        (to_brief, 1 / 300, 300),
    ):
        assert abs(np.log(value / truth)) < 4.0 / np.sqrt(events)


def test_evidence_never_falls() -> None:
    for seed, phases in ((0, "two-state"), (1, "three-phase"), (2, "2+2")):
        looks, _ = simulated(seed, 8000.0, 5.0, n_features=2)
        history = np.array(learn(looks, phases=phases, rhythm=False).candidates[0].history)
        assert len(history) > 3
        assert (np.diff(history) > -1e-9 * np.abs(history[1:])).all()


def test_on_a_fine_grid_without_errors_it_counts() -> None:
    looks, truth = simulated(5, 60000.0, 1.0, p_miss=0.0, p_false=0.0)
    there = truth[0]
    leaves, returns = np.sum(there[:-1] & ~there[1:]), np.sum(~there[:-1] & there[1:])
    limits = Limits.of(looks)
    leave = (leaves + 0.5) / (there.sum() + limits.prior_s)
    back = (returns + 0.5) / ((~there).sum() + limits.prior_s)
    model = learn(looks, phases="two-state", restarts=1).model
    # what the grid misses: changes there and back within a second, of order rate times step
    assert model.rates_hz[1, 0] == pytest.approx(leave, rel=0.02)
    assert model.rates_hz[0, 1] == pytest.approx(back, rel=0.02)


def test_time_may_be_shifted_and_scaled() -> None:
    looks, _ = simulated(6, 9000.0, 4.0)
    found = learn(looks, phases="two-state", rhythm=False)
    moved = Looks(looks.first, looks.stamp_s * 64.0 + 1e6, looks.detected, looks.p_miss, looks.p_false)
    again = learn(moved, phases="two-state", rhythm=False)
    np.testing.assert_allclose(again.model.rates_hz * 64.0, found.model.rates_hz, rtol=1e-6)
    assert again.log_evidence == pytest.approx(found.log_evidence, rel=1e-9)


def test_what_never_leaves_may_still_leave() -> None:
    looks, _ = simulated(7, 5000.0, 1.0, rates=((0.0, 1.0), (1e-12, 0.0)))
    late = looks.stamp_s > 100.0
    looks = Looks.from_rows(np.zeros(late.sum(), dtype=int), looks.stamp_s[late], looks.detected[late], 0.1, 0.1)
    model = learn(looks, phases="two-state").model
    assert 1e-6 < model.rates_hz[1, 0] < 2.0 / 4900.0  # fewer than two changes in all that time
    believed = model.track(looks).p_present
    assert believed.min() > 0.5  # four misses in a row do not end it
    assert believed.mean() > 0.999


def test_a_rhythm_is_found_where_there_is_one() -> None:
    """There by day, gone by night, four weeks of looks: the forecast of the next week knows the hours."""
    rng = np.random.default_rng(8)
    time = np.arange(0.0, 4 * WEEK_S, 600.0) + 5 * WEEK_S + 4.0 * 86400.0
    hours = (time / 3600.0) % 24.0
    there = (hours > 8.0 + 0.01 * rng.random(len(time))) & (hours < 18.0)
    hit = np.where(there, rng.random(len(time)) > 0.1, rng.random(len(time)) < 0.1)
    learned = learn(
        Looks.from_rows(np.zeros(len(time), dtype=int), time, hit, 0.1, 0.1), phases="two-state", restarts=1
    )
    assert learned.candidates[0].name == "two-state + rhythm"
    ahead = time[-1] + np.arange(3600.0, WEEK_S, 3600.0)
    none = Looks.from_rows(np.zeros(0, dtype=int), [], [], 0.1, 0.1, n_features=1)
    forecast = learned.model.track(none, Instants.same_for_all(1, ahead)).p_present
    hour = (ahead / 3600.0) % 24.0
    assert forecast[(hour > 9.5) & (hour < 17.5)].min() > 0.8
    assert forecast[(hour > 20.0) | (hour < 7.0)].max() < 0.2


def test_going_on_equals_learning_at_once() -> None:
    """Statistics of two halves, with enough rounds over the second, lead to nearly the rates of the whole."""
    looks, _ = simulated(9, 60000.0, 5.0, n_features=2)
    early = looks.stamp_s < 40000.0
    feature = np.repeat([0, 1], np.diff(looks.first))

    def part(rows: Any) -> Looks:
        return Looks.from_rows(feature[rows], looks.stamp_s[rows], looks.detected[rows], 0.1, 0.1)

    first = learn(part(early), phases="two-state", rhythm=False)
    both = first.updated(part(~early))
    whole = learn(looks, phases="two-state", rhythm=False)
    np.testing.assert_allclose(both.model.rates_hz[[0, 1], [1, 0]], whole.model.rates_hz[[0, 1], [1, 0]], rtol=0.03)
    np.testing.assert_allclose(both.statistics.exposure_s.sum(), 2 * looks.stamp_s.max(), rtol=1e-9)
    with pytest.raises(DataError, match="before the last one"):
        both.updated(part(early))


def test_forgetting_follows_a_change_of_habits() -> None:
    slow, _ = simulated(10, 50000.0, 10.0)
    fast, _ = simulated(11, 50000.0, 10.0, rates=((0.0, 4 * RETURN_HZ), (4 * LEAVE_HZ, 0.0)))
    n = len(slow.stamp_s) + len(fast.stamp_s)
    time, hit = np.append(slow.stamp_s, fast.stamp_s + 50000.0), np.append(slow.detected, fast.detected)
    looks = Looks.from_rows(np.zeros(n, dtype=int), time, hit, 0.1, 0.1)
    forgetful = learn(looks, phases="two-state", half_life_s=8000.0).model.rates_hz[1, 0]
    all_alike = learn(looks, phases="two-state").model.rates_hz[1, 0]
    assert forgetful > 3.0 * LEAVE_HZ > all_alike


def test_refusals() -> None:
    looks, _ = simulated(0, 100.0, 1.0)
    with pytest.raises(ConfigError, match="unknown structure"):
        learn(looks, phases="four-state")
    with pytest.raises(ConfigError, match="invalid half life"):
        learn(looks, half_life_s=0.0)
    with pytest.raises(DataError, match="two instants"):
        learn(Looks.from_rows([0, 1], [0.0, 0.0], [1, 1], 0.1, 0.1))


@pytest.mark.data
def test_the_room(repository: Path) -> None:
    """Two states for each feature, from noisy looks alone, do as well as rates counted from the truth."""
    folder = repository.parent / "shared" / "data" / "presence"
    if not (folder / "room_train.csv.gz").is_file():
        pytest.skip(f"recordings are not on this machine: no folder {folder}")

    def rows(name: str) -> Any:
        with gzip.open(folder / name, "rt") as stream:
            return np.genfromtxt(stream, delimiter=",", skip_header=1)

    def looks_at(table: Any) -> Looks:
        seen = table[np.isfinite(table[:, 2])]
        return Looks.from_rows(np.zeros(len(seen), dtype=int), seen[:, 0], seen[:, 2], 0.1, 0.1)

    train, test = rows("room_train.csv.gz"), rows("room_test.csv.gz")
    squares = {"learned": [], "counted": []}
    for feature in (0, 2, 4, 6):
        mine, later = train[train[:, 1] == feature], test[test[:, 1] == feature]
        change, there = np.diff(mine[:, 3]), mine[:, 3] == 1.0
        counted = PhaseType.two_state(
            (change < 0).sum() / (there.sum() * 0.5), (change > 0).sum() / ((~there).sum() * 0.5)
        )
        learned = learn(looks_at(mine), phases="two-state", restarts=2).model
        for name, model in (("learned", learned), ("counted", counted)):
            p = model.track(looks_at(later), Instants.same_for_all(1, later[:, 0])).p_present
            squares[name].append(np.mean((p - later[:, 3]) ** 2))
    assert np.mean(squares["learned"]) < np.mean(squares["counted"]) + 0.0003
    assert np.mean(squares["learned"]) < 0.0150
