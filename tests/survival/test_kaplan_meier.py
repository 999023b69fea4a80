"""The product-limit estimate against lifelines."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lifelines import KaplanMeierFitter

from evermap.errors import ConfigError, DataError
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.nonparametric import kaplan_meier


@given(
    st.lists(st.tuples(st.integers(1, 20), st.booleans(), st.integers(1, 3)), min_size=1, max_size=40),
    st.sampled_from((0.5, 0.9, 0.95)),
)
def test_equals_lifelines(rows: list[tuple[int, bool, int]], confidence: float) -> None:
    time, gone, weight = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    ours = kaplan_meier(CensoredLifetimes.of(time, np.where(gone > 0, time, np.inf), weight=weight))
    theirs = KaplanMeierFitter(alpha=1.0 - confidence).fit(time, gone, weights=weight)
    at = np.arange(0.0, 22.0, 0.5)
    survival = theirs.survival_function_at_times(at).to_numpy()
    np.testing.assert_allclose(ours.survival(at), survival, atol=1e-12)
    inner = (survival > 1e-9) & (survival < 1.0)
    band = theirs.confidence_interval_.to_numpy()[np.searchsorted(theirs.confidence_interval_.index, at, "right") - 1]
    for mine, reference in zip(ours.band(at, confidence), band.T, strict=True):
        np.testing.assert_allclose(mine[inner], reference[inner], atol=1e-9)


def test_delayed_entry_equals_lifelines() -> None:
    rng = np.random.default_rng(1)
    t = rng.weibull(1.5, 400) * 2.0
    entry = rng.random(400) * 0.5
    t, entry = t[t > entry], entry[t > entry]
    end = np.minimum(t, entry + rng.exponential(2.0, t.size))
    gone = end == t
    ours = kaplan_meier(CensoredLifetimes.of(end, np.where(gone, end, np.inf), entry))
    theirs = KaplanMeierFitter().fit(end, gone, entry=entry)
    np.testing.assert_allclose(ours.survives, theirs.survival_function_at_times(ours.time_s).to_numpy(), atol=1e-12)


def test_greenwood_by_hand() -> None:
    """Four, of which one leaves at 1 and one at 3, another being lost at 2."""
    found = kaplan_meier(CensoredLifetimes.of([1.0, 2.0, 3.0, 3.0], [1.0, np.inf, 3.0, np.inf]))
    np.testing.assert_allclose(found.survives, [3 / 4, 3 / 8])
    np.testing.assert_allclose(found.variance([0.5, 1.0, 3.0]), [0.0, 9 / 16 / 12, 9 / 64 * (1 / 12 + 1 / 2)])
    assert found.prior().p_never_leaves == pytest.approx(3 / 8)


def test_nobody_was_seen_to_go() -> None:
    found = kaplan_meier(CensoredLifetimes.of([1.0, 2.0], [np.inf, np.inf]))
    assert found.survival(10.0) == 1.0
    assert found.variance(10.0) == 0.0
    assert found.band(10.0) == (1.0, 1.0)


def test_nobody_is_left() -> None:
    found = kaplan_meier(CensoredLifetimes.of([1.0, 2.0], [1.0, 2.0], weight=[0.1, 0.2]))
    assert found.survival(2.0) == 0.0
    assert found.variance(2.0) == 0.0
    assert found.band(2.0) == (0.0, 0.0)


def test_mistakes() -> None:
    with pytest.raises(DataError, match=r"right_s.*\(1, 2\], row 1"):
        kaplan_meier(CensoredLifetimes.of([1.0, 1.0], [1.0, 2.0]))
    with pytest.raises(ConfigError, match="confidence"):
        kaplan_meier(CensoredLifetimes.of([1.0], [1.0])).band(1.0, 1.5)
