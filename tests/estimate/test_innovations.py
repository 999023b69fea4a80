"""Innovations of any kind on the scale of two degrees of freedom, against scipy's tails."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, special, stats

from evermap.estimate.innovations import comparable_nis
from evermap.types import Innovations


def innovations(nis: list[float], dof: list[int] | None) -> Innovations:
    count = len(nis)
    number = np.arange(count)
    return Innovations(
        np.zeros(count), number, number, np.array(nis), np.ones(count), None if dof is None else np.array(dof)
    )


@pytest.mark.parametrize("dof", [1, 2, 3, 6])
def test_a_value_is_the_one_with_the_same_tail_probability(dof: int) -> None:
    nis = [0.0, 1e-3, 0.5, 1.0, 2.0, 5.99, 30.0, 500.0, 1200.0]
    found = comparable_nis(innovations([*nis, 1.0], [dof] * len(nis) + [3]))[:-1]
    np.testing.assert_allclose(found, -2.0 * stats.chi2.logsf(nis, dof), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("dof", [1, 3, 6])
def test_where_tails_underflow_values_go_on(dof: int) -> None:
    """Against the integral of what is left of the density, without its factor that underflows."""
    for nis in (1300.0, 1500.0, 5000.0):
        half, shape = 0.5 * nis, 0.5 * dof
        rest = integrate.quad(lambda u, h=half, s=shape: (1.0 + u / h) ** (s - 1.0) * np.exp(-u), 0.0, 100.0)[0]
        log_tail = (shape - 1.0) * np.log(half) - half + np.log(rest) - special.gammaln(shape)
        assert comparable_nis(innovations([nis], [dof]))[0] == pytest.approx(-2.0 * log_tail, abs=2e-3)


def test_values_of_two_degrees_and_missing_ones_stay() -> None:
    one = innovations([1.0, np.nan, 7.0], None)
    assert comparable_nis(one) is one.nis
    found = comparable_nis(innovations([1.0, np.nan, 7.0], [2, 3, 2]))
    np.testing.assert_allclose(found, [1.0, np.nan, 7.0])
