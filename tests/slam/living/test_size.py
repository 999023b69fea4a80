"""How long a map's metre is: the filter against dense conditioning, the similarity against an optimiser."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from evermap import se2
from evermap.slam.living.size import WALK, log_ratio, settled


@settings(max_examples=50)
@given(
    ratio=st.floats(-0.2, 0.2),
    shown=st.floats(1e-4, 0.05),
    own=st.floats(-0.1, 0.1),
    sigma=st.floats(1e-3, 0.1),
    before=st.floats(1e-4, 0.1),
)
def test_both_sizes_are_the_conditional_gaussian(
    ratio: float, shown: float, own: float, sigma: float, before: float
) -> None:
    found = settled(ratio, shown**2, (own, sigma), before**2)
    # unknowns: (log map metre over true, log true metre over session's); seen: their sum
    mean, covariance = np.array([0.0, own]), np.diag([before**2 + WALK**2, sigma**2])
    seen = np.array([[1.0, 1.0]])
    gain = covariance @ seen.T / (seen @ covariance @ seen.T + shown**2)
    after = mean + gain[:, 0] * (ratio - own)
    assert found.map_factor == pytest.approx(np.exp(-after[0]), rel=1e-12)
    assert found.session_factor == pytest.approx(np.exp(after[1]), rel=1e-12)
    assert found.variance == pytest.approx(((np.eye(2) - gain @ seen) @ covariance)[0, 0], rel=1e-9, abs=1e-15)


def test_a_hundred_sessions_settle_on_the_mean_of_what_they_know() -> None:
    """Every session knows the metre to 2 %, by itself: a map knows it better, and does not wander off."""
    rng = np.random.default_rng(3)
    size, variance, sigma = 1.0 + 0.02 * rng.standard_normal(), 0.02**2, 0.02
    errors = []
    for _ in range(300):
        own = 0.02 * rng.standard_normal()  # of a session whose metre is longer by as much than it says
        found = settled(np.log(size) + own + 0.001 * rng.standard_normal(), 1e-6, (0.0, sigma), variance)
        size, variance = size * found.map_factor, found.variance
        errors.append(np.log(size))
    late = np.array(errors[50:])
    assert np.sqrt(variance) < 0.007
    assert np.sqrt(np.mean(late**2)) < 0.01


@pytest.mark.parametrize("seed", range(4))
def test_the_similarity_is_that_of_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 8
    session = rng.uniform(-5.0, 5.0, (count, 2))
    root = 0.03 * rng.standard_normal((2 * count, 2 * count))
    spread, of_map = root @ root.T + 1e-4 * np.eye(2 * count), 1e-4 * np.eye(2 * count)
    true = np.array([3.0, -2.0, 2.5])
    mapped = se2.transform(true, 1.07 * session) + 0.02 * rng.standard_normal((count, 2))

    def cost(x: np.ndarray) -> float:
        gap = (mapped - se2.transform(x[:3], np.exp(x[3]) * session)).ravel()
        return float(gap @ np.linalg.solve(fixed, gap))

    ratio, variance = log_ratio(session, spread, mapped, of_map)
    turn = np.exp(ratio) * np.kron(np.eye(count), se2.rotation(true[2]))
    best = None
    for _ in range(3):  # the weights are those of the estimate, as of Gauss-Newton
        fixed = turn @ spread @ turn.T + of_map
        best = minimize(cost, np.append(true, ratio), method="BFGS", options={"gtol": 1e-10})
        turn = np.exp(best.x[3]) * np.kron(np.eye(count), se2.rotation(best.x[2]))
    assert best is not None
    assert ratio == pytest.approx(best.x[3], abs=1e-4)
    step, unit = 1e-4, np.eye(4)
    hessian = np.array(
        [
            [
                (cost(best.x + step * (a + b)) - cost(best.x + step * (a - b))
                 - cost(best.x - step * (a - b)) + cost(best.x - step * (a + b))) / (4 * step**2)
                for b in unit
            ]
            for a in unit
        ]
    )  # fmt: skip
    assert variance == pytest.approx(np.linalg.inv(0.5 * hessian)[3, 3], rel=0.05)
