"""The kind of model is chosen by what it foretells, and nothing held out is seen before."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.errors import ConfigError, DataError
from evermap.existence import models
from evermap.existence.models import KINDS, choose
from evermap.existence.protocol import Looks

P_ERROR = 0.1


def looks_of(durations: list[float], step_s: float, seed: int) -> Looks:
    """Looks at a feature whose stays and absences last these times in turn."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, float(np.sum(durations)), step_s)
    present = (np.searchsorted(np.cumsum([0.0, *durations]), time_s, side="right") % 2 == 1).astype(int)
    seen = np.where(rng.random(len(time_s)) < P_ERROR, 1 - present, present)
    return Looks.from_rows(np.zeros(len(time_s), dtype=int), time_s, seen, P_ERROR, P_ERROR)


@pytest.mark.slow
def test_a_clockwork_is_told_from_chance() -> None:
    rng = np.random.default_rng(1)
    clockwork = looks_of(list(np.tile([60.0, 300.0], 20) * rng.normal(1.0, 0.01, 40)), 6.0, 2)
    choice = choose(clockwork, ["two-state", "run-length"])
    assert choice.kind == "run-length"
    assert choice.scores["run-length"] > choice.scores["two-state"] + 10.0


@pytest.mark.slow
def test_chance_is_not_taken_for_a_clockwork() -> None:
    rng = np.random.default_rng(1)
    rng.normal(size=40)
    chance = looks_of(list(rng.exponential(np.tile([60.0, 300.0], 20))), 6.0, 3)
    scores = choose(chance, ["two-state", "run-length"]).scores
    assert scores["run-length"] < scores["two-state"] + 3.0


def test_score_is_the_density_of_the_last_fifth_given_the_rest() -> None:
    looks = looks_of([200.0, 100.0] * 5, 10.0, 4)
    choice = choose(looks, ["two-state", "phase-type"])
    cut = looks.stamp_s[-1] - choice.held_out_s
    assert choice.held_out_s == pytest.approx(0.2 * np.ptp(looks.stamp_s))
    rows = slice(0, int(np.searchsorted(looks.stamp_s, cut)))
    before = Looks(
        np.array([0, rows.stop]), looks.stamp_s[rows], looks.detected[rows], looks.p_miss[rows], looks.p_false[rows]
    )
    model = KINDS["two-state"](before)
    expected = model.track(looks).log_evidence[0] - model.track(before).log_evidence[0]
    assert choice.scores["two-state"] == pytest.approx(expected, abs=1e-9)


def test_the_chosen_kind_is_learned_on_from_what_was_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[object] = []

    def learned(looks: Looks, start: object = None) -> object:
        begun.append(start)
        return KINDS["two-state"](looks)

    monkeypatch.setattr(models, "KINDS", {"two-state": KINDS["two-state"], "run-length": learned})
    choice = choose(looks_of([200.0, 100.0] * 5, 10.0, 4), ["run-length", "two-state"])
    assert choice.kind == "run-length"
    assert begun[0] is None
    assert begun[1] is not None


def test_looks_before_an_instant_keep_their_features() -> None:
    looks = Looks.from_rows([0, 0, 2, 2, 2, 4], [0.0, 9.0, 1.0, 2.0, 8.0, 9.0], 1, 0.1, 0.1, n_features=6)
    before = looks.taken(looks.stamp_s < 5.0)
    np.testing.assert_array_equal(np.diff(before.first), [1, 0, 2, 0, 0, 0])
    np.testing.assert_array_equal(before.stamp_s, [0.0, 1.0, 2.0])


def test_refusals() -> None:
    looks = looks_of([10.0, 10.0], 1.0, 5)
    with pytest.raises(ConfigError, match="unknown kind of model"):
        choose(looks, ["oracle"])
    nothing = np.zeros(0)
    with pytest.raises(DataError, match="no look"):
        choose(Looks(np.zeros(2, dtype=np.int64), nothing, nothing, nothing, nothing))


@pytest.mark.parametrize(("gap_d", "rhythm"), [(1.0, True), (20.0, False)])
def test_visits_weeks_apart_show_no_hours(gap_d: float, rhythm: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is held out that would decide nothing, and no habit of the week is looked for between visits of weeks."""
    monkeypatch.setattr(models, "KINDS", dict.fromkeys(KINDS, KINDS["two-state"]))
    n_features, n = 40, 30
    rng = np.random.default_rng(5)
    stamp_s = 86400.0 * gap_d * np.arange(n) + np.zeros((n_features, 1))
    feature = np.repeat(np.arange(n_features), n)
    looks = Looks.from_rows(feature, stamp_s.ravel(), rng.integers(0, 2, n_features * n), P_ERROR, P_ERROR)
    choice = choose(looks)
    assert ("run-length-rhythm" in choice.scores) == rhythm
    span_s = float(np.ptp(looks.stamp_s))
    assert choice.held_out_s == pytest.approx(7.0 * 86400.0 if rhythm else 0.2 * span_s)
