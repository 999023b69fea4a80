"""The robust rule against its definition: a mixture of inlier and outlier, or a Cauchy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.estimate.robust import weigh


@given(
    squared=st.floats(0.0, 300.0),
    log_odds=st.one_of(st.floats(0.5, 50.0), st.just(7.0)),
    tail=st.one_of(st.just(0.0), st.floats(1.0, 60.0)),
    share=st.one_of(st.just(0.0), st.floats(0.0, 0.5)),
)
def test_weight_is_twice_the_derivative_of_the_loss(squared, log_odds, tail, share):
    h = 1e-4 * (1.0 + squared)
    low = max(squared - h, 0.0)
    high, at_low = (weigh(at, log_odds, tail, share)[1] for at in (squared + h, low))
    middle = 0.5 * (squared + h + low)
    assert weigh(middle, log_odds, tail, share)[0] == pytest.approx(
        2 * (high - at_low) / (squared + h - low), rel=1e-3, abs=1e-6
    )


@pytest.mark.parametrize("share", [0.0, 1e-4, 0.1])
def test_loss_is_minus_log_of_a_mixture_of_inlier_and_outlier(share):
    for squared in (0.0, 1.0, 13.9, 14.1, 80.0, 1e4):
        inlier, outlier = -squared / 2, -7.0 - share * squared / 2
        density = np.logaddexp(inlier, outlier) - np.logaddexp(0.0, -7.0)
        weight, loss = weigh(squared, 7.0, 0.0, share)
        assert loss == pytest.approx(-density, abs=1e-9)
        p_inlier = np.exp(inlier - np.logaddexp(inlier, outlier))
        assert weight == pytest.approx(p_inlier + (1.0 - p_inlier) * share, rel=1e-9)


def test_a_cauchy_has_half_the_weight_where_it_begins():
    assert weigh(9.0, 7.0, 9.0, 0.0)[0] == pytest.approx(0.5)
    assert weigh(1e6, 7.0, 9.0, 0.0)[0] > 0.0


def test_without_outliers_the_loss_is_quadratic():
    for squared in (0.0, 3.0, 1e6):
        assert weigh(squared, np.inf, 0.0, 0.0) == (1.0, pytest.approx(squared / 2))
