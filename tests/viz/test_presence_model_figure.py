"""The figure of a model shows its forecasts."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.existence.phase_type import PhaseType
from evermap.existence.rhythm import BINS, Rhythm
from evermap.existence.run_length import RunLength
from evermap.survival import Exponential
from evermap.viz.presence_figures import has_rhythm, plot_presence_models, week_of_presence

LEAVE_HZ, RETURN_HZ = 1 / 600.0, 1 / 1800.0


def test_curves_are_the_closed_form_of_two_states() -> None:
    figure = plot_presence_models({"door": PhaseType.two_state(LEAVE_HZ, RETURN_HZ)})
    (axes,) = figure.axes
    share = RETURN_HZ / (LEAVE_HZ + RETURN_HZ)
    for line, start in zip(axes.lines, (1.0, 0.0), strict=True):
        time_s, drawn = line.get_data()
        expected = share + (start - share) * np.exp(-(LEAVE_HZ + RETURN_HZ) * np.asarray(time_s))
        np.testing.assert_allclose(drawn, expected, atol=1e-9)
    assert axes.get_title(loc="left") == "door"


def test_a_week_has_its_night_and_its_weekend() -> None:
    factor = np.full(BINS, -12.0)
    open_hours = (np.arange(BINS) % 144 >= 48) & (np.arange(BINS) % 144 < 108) & (np.arange(BINS) < 5 * 144)
    factor[open_hours] = 0.0
    model = RunLength(Exponential(LEAVE_HZ), Exponential(RETURN_HZ), 60.0, absence_rhythm=Rhythm(factor))
    time_s, presence = week_of_presence(model)
    hour = time_s / 3600.0 % 24.0
    weekend = time_s >= 5 * 86400.0
    noon, night = (hour > 10.0) & (hour < 17.0) & ~weekend, (hour > 1.0) & (hour < 7.0)
    assert presence[noon].min() > 0.2
    assert presence[night].max() < 1e-3
    assert presence[weekend].max() < 1e-3
    assert len(plot_presence_models({"": model}).axes) == 2


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        (PhaseType.two_state(LEAVE_HZ, RETURN_HZ), False),
        (RunLength(Exponential(LEAVE_HZ), Exponential(RETURN_HZ), 60.0), False),
        (RunLength(Exponential(LEAVE_HZ), Exponential(RETURN_HZ), 60.0, stay_rhythm=Rhythm(np.zeros(BINS))), True),
    ],
)
def test_only_models_that_know_the_week_get_one(model: PhaseType | RunLength, expected: bool) -> None:
    assert has_rhythm(model) is expected
