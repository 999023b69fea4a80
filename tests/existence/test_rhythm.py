"""Ten minutes of the week, against the calendar of the standard library."""

from __future__ import annotations

from datetime import datetime, timedelta

import numpy as np
import pytest

from evermap.errors import ConfigError
from evermap.existence.rhythm import BIN_S, BINS, WEEK_S, Rhythm, bin_of_week

EPOCH = datetime(1970, 1, 1)  # noqa: DTZ001 - wall time, which has no zone


def test_bins_are_those_of_the_calendar() -> None:
    rng = np.random.default_rng(1)
    for seconds in rng.uniform(-2e9, 4e9, 500).round(3):
        when = EPOCH + timedelta(seconds=float(seconds))
        of_day = (when.hour * 60 + when.minute) // 10
        assert bin_of_week(seconds) == when.weekday() * 144 + of_day


def test_a_week_begins_on_monday_at_midnight() -> None:
    monday = (datetime(2026, 11, 16) - EPOCH).total_seconds()  # noqa: DTZ001
    assert bin_of_week(monday) == 0
    assert bin_of_week(np.nextafter(monday, 0.0)) == BINS - 1
    np.testing.assert_array_equal(bin_of_week(monday + BIN_S * np.arange(BINS)), np.arange(BINS))
    np.testing.assert_array_equal(bin_of_week(monday + WEEK_S * np.arange(-5, 5)), 0)


def test_the_kernels_count_as_this_module_does() -> None:
    from evermap.existence.run_length_kernels import _week_bin

    stamp = np.random.default_rng(2).uniform(-1e9, 3e9, 1000)
    np.testing.assert_array_equal([_week_bin(t, BINS) for t in stamp], bin_of_week(stamp))
    assert _week_bin(stamp[0], 1) == 0


def test_it_is_kept_as_plain_numbers() -> None:
    rhythm = Rhythm(np.sin(np.arange(BINS)))
    np.testing.assert_allclose(Rhythm.from_dict(rhythm.to_dict()).log_factor, rhythm.log_factor, atol=5e-6)


@pytest.mark.parametrize("wrong", [np.zeros(7), np.zeros((BINS, 1)), np.full(BINS, np.nan)])
def test_anything_else_is_refused(wrong: np.ndarray) -> None:
    with pytest.raises(ConfigError, match="1008 finite numbers"):
        Rhythm(wrong)
