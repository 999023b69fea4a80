"""Calibration, worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from evermap_score.calibration import bin_by_mass, calibration_error

from .test_changes import join
from .worlds import looks_at, table, values


def test_scores_of_a_few_statements() -> None:
    # one instant, at which a, b, c are there, and d is not. Stated: a .9, b .6, d .3; of c nothing, that is 0.
    truth = table(("a", None, None, 0, 0), ("b", None, None, 4, 0), ("c", None, None, 0, 4))
    estimate = table(("a", None, None, 0, 0, 0.9), ("b", None, None, 4, 0, 0.6), ("d", None, None, 8, 8, 0.3))
    found = values(truth, estimate)
    assert found["calibration/brier"] == pytest.approx((0.1**2 + 0.4**2 + 0.3**2 + 1.0) / 4)
    loss = -(math.log(0.9) + math.log(0.6) + math.log(0.7) + math.log(1e-6)) / 4
    assert found["calibration/log_loss"] == pytest.approx(loss)
    # four bins of one: |0 - 1|, |.3 - 0|, |.6 - 1|, |.9 - 1|
    assert found["calibration/ece"] == pytest.approx((1.0 + 0.3 + 0.4 + 0.1) / 4)
    assert math.isnan(found["calibration/false_above_99"])


def test_a_place_that_is_wrong_makes_a_statement_false_and_another_missing() -> None:
    truth, estimate = table(("a", None, None, 0, 0)), table(("a", None, None, 0.6, 0, 0.995))
    found = values(truth, estimate)
    assert found["calibration/brier"] == pytest.approx((0.995**2 + 1.0) / 2)
    assert found["calibration/false_above_99"] == 1.0
    assert values(truth, table(("a", None, None, 0.4, 0, 0.995)))["calibration/false_above_99"] == 0.0


def test_of_what_was_never_looked_at_silence_is_no_statement() -> None:
    truth = table(("a", None, None, 0, 0), ("b", None, None, 4, 0))
    estimate = table(("a", None, None, 0, 0, 0.9))
    assert values(truth, estimate, looks_at([1.0, 2.0], {"a": [0.5]}))["calibration/brier"] == pytest.approx(0.01)
    # b is looked at in the second session: (.01 + .01 + 1) / 3
    seen = looks_at([1.0, 2.0], {"a": [0.5], "b": [1.5]})
    assert values(truth, estimate, seen)["calibration/brier"] == pytest.approx(1.02 / 3)


def test_a_forecast_is_what_a_map_states_of_the_next_session() -> None:
    # a leaves between 10 and 20; the map of 10 says .8 for ever, that of 20 says .1
    truth = table(("a", None, 15, 0, 0), ("b", None, None, 5, 5))
    estimate = join(
        table(("a", None, None, 0, 0, 0.8), ("b", None, None, 5, 5, 1.0), robot_time_s=10.0),
        table(("a", None, None, 0, 0, 0.1), ("b", None, None, 5, 5, 1.0), robot_time_s=20.0),
    )
    found = values(truth, estimate)
    assert found["calibration/brier"] == pytest.approx((0.2**2 + 0.1**2) / 4)
    assert found["calibration_forecast/brier"] == pytest.approx(0.8**2 / 2)


def test_bins_have_equal_mass() -> None:
    p = np.linspace(0.0, 1.0, 100) ** 4  # most of them are small
    bins = bin_by_mass(p, (p > 0.5**4).astype(float), np.ones(100))
    assert bins.mass.tolist() == [10.0] * 10
    assert bins.mean_p[0] == pytest.approx(p[:10].mean())
    assert bins.share_true.tolist() == [0.0] * 5 + [1.0] * 5


def test_equal_probabilities_are_in_one_bin_and_weights_are_copies() -> None:
    columns = np.array([[0.5, 1.0], [0.5, 0.0], [0.5, 0.0], [0.9, 1.0]])
    assert calibration_error(columns, np.ones(4)) == pytest.approx((3 * (0.5 - 1 / 3) + 0.1) / 4)
    doubled = np.concatenate([columns, columns[:2]])
    assert calibration_error(columns, np.array([2.0, 2.0, 1.0, 1.0])) == pytest.approx(
        calibration_error(doubled, np.ones(6))
    )


def test_a_calibrated_estimate_has_a_small_error() -> None:
    rng = np.random.default_rng(1)
    p = rng.uniform(size=20_000)
    columns = np.stack([p, rng.random(20_000) < p], axis=1).astype(float)
    assert calibration_error(columns, np.ones(20_000)) < 0.015  # three times the sampling error of a bin
    columns[:, 0] = p**2
    assert calibration_error(columns, np.ones(20_000)) == pytest.approx(1 / 6, abs=0.01)  # mean of p - p^2
