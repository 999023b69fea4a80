"""What the tests of Bateman 2020 share: the experiment, small."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from evermap_studies.bateman2020.settings import READINGS, Settings, default_settings

P_MISS = 0.8


def small(**changes: Any) -> Settings:
    """A run of 80 steps, two laps, with a sweep of three points."""
    settings = default_settings(
        sweep={"world": {"viewing_angle_deg": [60.0, 85.0]}, "filters": {"rho_low": [0.05]}},
        runs=3,
        tuning_runs=1,
        sweep_runs=2,
        bootstrap_draws=10,
        worlds=(*READINGS, "occlusion"),
    )
    world = settings.world | {"steps": 80, "period": 40, "mean_survival_steps": 40.0}
    return replace(settings, world=world, **changes)
