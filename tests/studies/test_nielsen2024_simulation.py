"""Figures 6 and 7 against scipy's least squares and the selectors' own promises."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from evermap.geometry import se2
from evermap_studies.nielsen2024.simulation import _solve, selector_rows, slam_rows
from evermap_studies.worlds.moved import ModeConfig, simulate_modes

CONFIG = ModeConfig(steps=8)


def test_slam_is_the_least_squares_optimum() -> None:
    data = simulate_modes(3, 0.05, CONFIG, 2, walks=True)
    mode = (data.mode + np.eye(8, dtype=np.int64)[3]) % 3  # one wrong label changes nothing of the task
    pose, place = _solve(data, mode, 0.05, CONFIG, np.zeros_like(data.pose), data.map_m)
    for run in range(3):

        def residuals(x: np.ndarray, run: int = run) -> np.ndarray:
            poses, modes = x[:24].reshape(8, 3), x[24:].reshape(3, 2)
            seen = se2.transform(se2.inverse(poses), modes[mode[run]])
            return np.concatenate(
                [
                    1e5 * poses[0],
                    (np.diff(poses, axis=0) / CONFIG.walk_sigma).ravel(),
                    (seen - data.measured_m[run]).ravel() / np.sqrt(0.05),
                    (modes - data.map_m[run]).ravel() / CONFIG.map_sigma_m,
                ]
            )

        best = least_squares(residuals, np.zeros(30), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        mine = np.concatenate([pose[run].ravel(), place[run].ravel()])
        assert 0.5 * np.sum(residuals(mine) ** 2) <= best.cost * (1.0 + 1e-9)
        np.testing.assert_allclose(mine, best.x, atol=1e-6)


@pytest.mark.slow
def test_selectors_keep_their_promises() -> None:
    rows = {row["selector"]: row for row in selector_rows((0.2,), 60, ModeConfig(), 3)}
    assert all(row["above_viterbi"] == 0 for row in rows.values())
    assert rows["viterbi"]["same_as_viterbi"] == 60
    assert rows["em"]["wrong_share"] <= min(row["wrong_share"] for row in rows.values()) + 1e-12
    assert rows["nn"]["wrong_share"] > 1.5 * rows["viterbi"]["wrong_share"]


@pytest.mark.slow
def test_wrong_modes_cost_accuracy() -> None:
    rows = {row["selector"]: row for row in slam_rows((0.2,), 60, ModeConfig(), 3)}
    assert rows["nn"]["rmse_m"] > rows["viterbi"]["rmse_m"] + rows["viterbi"]["rmse_m_se"]
    again = {row["selector"]: row for row in slam_rows((0.2,), 60, ModeConfig(), 3)}
    assert again == rows
