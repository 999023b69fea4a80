"""Scores of removing things from a map: cases worked out by hand, and plain loops over random ones."""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.errors import InputError
from evermap_studies.bateman2020.removal import RemovalTally, bootstrap, removal_scores, removal_tally, standard_errors


def one(belief: list[float], in_view: str, first: int, survival: float) -> RemovalTally:
    """Tally of one column; `in_view` has a `v` where it is in view."""
    seen = np.array([letter == "v" for letter in in_view])
    return removal_tally(np.array(belief)[:, None], seen[:, None], np.array([first]), np.array([survival]))


def test_a_column_by_hand() -> None:
    """Born in step 1, there up to step 4; possible detections in steps 1, 2, 4, 5, 7 and 8."""
    tally = one([1.0, 1.0, 0.95, 0.5, 0.8, 0.92, 0.3, 0.4, 0.1, 0.05], "vvv.vv.vv.", first=1, survival=3.5)
    counts = tally.true_positive, tally.false_negative, tally.false_positive, tally.true_negative
    assert [int(count[0]) for count in counts] == [2, 1, 1, 2]
    assert tally.squared_error[0] == pytest.approx(0.05**2 + 0.2**2 + 0.92**2 + 0.4**2 + 0.1**2)
    assert tally.survival_ratio[0] == 1.0  # removed at 7 steps of age, later than it left
    assert tally.delay_looks[0] == 3.0  # steps 5, 7 and 8
    scores = removal_scores(tally)
    assert (scores.accuracy, scores.precision, scores.recall) == pytest.approx((4 / 6, 2 / 3, 2 / 3))


def test_what_is_removed_too_early_has_its_share_of_the_survival_and_no_delay() -> None:
    tally = one([1.0, 0.9, 0.1, 0.95, 0.99, 0.1], "vvvvvv", first=0, survival=4.0)
    assert tally.survival_ratio[0] == pytest.approx(2.0 / 4.0)  # back in step 3, but it was removed
    assert math.isnan(tally.delay_looks[0])


def test_the_true_survival_is_cut_at_the_end_of_the_run() -> None:
    tally = one([1.0, 0.1, 1.0, 1.0, 1.0], "vvvvv", first=0, survival=1000.0)
    assert tally.survival_ratio[0] == pytest.approx(1.0 / 4.0)


def test_removal_out_of_view_counts_and_takes_no_look() -> None:
    tally = one([1.0, 1.0, 0.5, 0.15, 0.1], "vv..v", first=0, survival=1.5)
    assert tally.delay_looks[0] == 0.0
    early = one([1.0, 0.15, 0.5, 0.5, 0.5], "v...v", first=0, survival=2.0)
    assert early.survival_ratio[0] == pytest.approx(0.5)


def test_what_is_never_removed_counts_one_and_is_counted_apart() -> None:
    tally = one([1.0, 1.0, 0.9, 0.5], "vvvv", first=0, survival=1.0)
    assert (tally.survival_ratio[0], tally.delay_looks[0]) == (1.0, math.inf)
    scores = removal_scores(tally)
    assert (scores.vanished, scores.never_removed) == (1.0, 1.0)
    assert math.isnan(scores.delay_mean)
    assert math.isnan(scores.delay_p95)
    assert math.isnan(one([1.0, 1.0, 0.9, 0.5], "vv..", first=0, survival=1.0).delay_looks[0]), "never in view again"


def test_a_birth_in_the_last_step_divides_by_nothing() -> None:
    assert one([1.0, 1.0, 0.1], "vvv", first=2, survival=50.0).survival_ratio[0] == 1.0


@given(st.integers(0, 2**32 - 1))
def test_random_columns_equal_plain_loops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps, columns = 30, 4
    belief, in_view = rng.random((steps, columns)) ** 0.3, rng.random((steps, columns)) < 0.6
    first, survival = rng.integers(0, 10, columns), rng.exponential(12.0, columns)
    tally = removal_tally(belief, in_view, first, survival, rho_high=0.7, rho_low=0.4)
    for n in range(columns):
        counts, error, looks, removed = {}, 0.0, 0, None
        had, gone_in_view = True, False
        for step in range(int(first[n]), steps):
            there = step - first[n] <= survival[n]
            if in_view[step, n]:
                kind = bool(belief[step, n] >= 0.7), bool(there)
                counts[kind] = counts.get(kind, 0) + 1
                error += (belief[step, n] - there) ** 2
                gone_in_view |= not there
                looks += not there and removed is None
            if belief[step, n] < 0.4 and removed is None:
                removed, had = step, not there
        assert tally.true_positive[n] == counts.get((True, True), 0)
        assert tally.false_positive[n] == counts.get((True, False), 0)
        assert tally.true_negative[n] == counts.get((False, False), 0)
        assert tally.false_negative[n] == counts.get((False, True), 0)
        assert tally.squared_error[n] == pytest.approx(error)
        true_steps = min(survival[n], steps - 1 - first[n])
        assert tally.survival_ratio[n] == pytest.approx(
            1.0 if removed is None else min((removed - first[n]) / true_steps, 1.0)
        )
        if not had or not gone_in_view:
            assert math.isnan(tally.delay_looks[n])
        else:
            assert tally.delay_looks[n] == (math.inf if removed is None else looks)


def drawn(seed: int, columns: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    belief, in_view = np.sort(rng.random((50, columns)) ** 0.5, axis=0)[::-1], rng.random((50, columns)) < 0.6
    return belief, in_view, rng.integers(0, 20, columns), rng.exponential(20.0, columns)


def test_landmarks_with_shares_of_a_clique_score_as_the_clique() -> None:
    """Each column split in three that share its weight; and a weight of two is the column twice."""
    belief, in_view, first, survival = drawn(1)
    whole = removal_scores(removal_tally(belief, in_view, first, survival))
    thirds = [np.repeat(values, 3, axis=-1) for values in (belief, in_view, first, survival)]
    split = removal_scores(removal_tally(*thirds), np.full(120, 1.0 / 3.0))
    assert asdict(split) == pytest.approx(asdict(whole))
    twice = [np.concatenate([values, values[..., :7]], axis=-1) for values in (belief, in_view, first, survival)]
    weight = np.where(np.arange(40) < 7, 2.0, 1.0)
    heavy = removal_scores(removal_tally(belief, in_view, first, survival), weight)
    assert asdict(heavy) == pytest.approx(asdict(removal_scores(removal_tally(*twice))))


def test_percentile_of_the_delay() -> None:
    """Nineteen are removed at the first look after they have gone, one at the fourth."""
    belief = np.full((8, 20), 0.1)
    belief[:3] = 1.0
    belief[:6, 19] = 1.0
    nobody = np.zeros(20, dtype=np.int64)
    tally = removal_tally(belief, np.ones((8, 20), dtype=np.bool_), nobody, np.full(20, 2.0))
    scores = removal_scores(tally)
    assert (scores.delay_mean, scores.delay_p95) == (pytest.approx(23 / 20), 1.0)
    heavier = removal_scores(tally, np.where(np.arange(20) == 19, 3.0, 1.0))
    assert heavier.delay_p95 == 4.0


def test_bootstrap_of_independent_runs_is_their_standard_error_of_the_mean() -> None:
    """MES/S of one column a run is a plain mean: the bootstrap's limit is known. Runs of equal columns are one draw."""
    belief, in_view, first, survival = drawn(3, columns=60)
    tally = removal_tally(belief, in_view, first, survival)
    errors = standard_errors(bootstrap(tally, np.arange(60), draws=4000))
    expected = np.std(tally.survival_ratio) / math.sqrt(60)
    assert errors.survival_ratio == pytest.approx(expected, rel=0.05)

    copies = [np.repeat(values, 5, axis=-1) for values in (belief, in_view, first, survival)]
    correlated = standard_errors(bootstrap(removal_tally(*copies), np.repeat(np.arange(60), 5), draws=4000))
    assert correlated.survival_ratio == pytest.approx(expected, rel=0.05)


def test_bootstrap_has_a_seed_that_draws_the_same_runs_for_every_filter() -> None:
    belief, in_view, first, survival = drawn(4)
    tally, run = removal_tally(belief, in_view, first, survival), np.arange(40) // 4
    one_, two, other = (bootstrap(tally, run, draws=20, seed=seed) for seed in (1, 1, 2))
    assert one_ == two
    assert one_ != other
    landmarks = removal_tally(*(np.repeat(values, 2, axis=-1) for values in (belief, in_view, first, survival)))
    split = bootstrap(landmarks, np.repeat(run, 2), weight=np.full(80, 0.5), draws=20, seed=1)
    assert [scores.accuracy for scores in split] == pytest.approx([scores.accuracy for scores in one_])


def test_an_unknown_score_has_no_standard_error() -> None:
    tally = one([1.0, 1.0, 0.9, 0.5], "vvvv", first=0, survival=1.0)
    errors = standard_errors(bootstrap(tally, np.array([0]), draws=5))
    assert math.isnan(errors.delay_mean)
    assert errors.accuracy == 0.0


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"belief": np.full((5, 2), 1.5)}, "field 'belief': not all are probabilities"),
        ({"belief": np.full((5, 2), np.nan)}, "field 'belief': not all are probabilities"),
        ({"in_view": np.ones((5, 3), dtype=np.bool_)}, "field 'in_view': shape"),
        ({"first": np.zeros(3, dtype=np.int64)}, "field 'first': shape"),
        ({"survival_steps": np.zeros(1)}, "field 'survival_steps': shape"),
    ],
)
def test_what_does_not_fit_is_one_line(change: dict[str, np.ndarray], named: str) -> None:
    fits = {
        "belief": np.ones((5, 2)),
        "in_view": np.ones((5, 2), dtype=np.bool_),
        "first": np.zeros(2, dtype=np.int64),
        "survival_steps": np.ones(2),
    }
    with pytest.raises(InputError, match=named):
        removal_tally(**(fits | change))
