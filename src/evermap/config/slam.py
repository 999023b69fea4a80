"""Settings of the estimator, corrections of the sensor, and what a run writes."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from pydantic import Field

from evermap.config.section import Positive, Probability, Section
from evermap.errors import ConfigError
from evermap.types import Sensor


class CalibrationConfig(Section):
    """Which calibration states are estimated."""

    fix: dict[str, float] = Field(
        default_factory=dict,
        description="calibration states held at a value instead of estimated, by name, e.g. odometry_delay_s = 0.0",
    )


class ModesConfig(Section):
    """Landmarks with several positions (Nielsen and Hendeby 2024): gates, switching, selectors."""

    gate_probability: Probability = Field(
        default=0.95, description="a detection outside this confidence region of all modes starts a new mode"
    )
    switch_probability: Probability = Field(
        default=1e-4, description="of a landmark to be in another mode at the next look; ignored with a lifetime"
    )
    births: Literal["evidence", "gate"] = Field(
        default="evidence",
        description="'evidence' keeps a new mode that explains more than it costs, 'gate' every one, as the paper does",
    )
    lifetime: str | None = Field(
        default=None, description="prior of how long a mode lasts, e.g. 'exponential:half-life=30d'; unset: constant"
    )
    rounds: int = Field(default=10, ge=1, le=100, description="of selecting modes and relinearising, at most")
    mcts_budget: int = Field(default=200, ge=1, description="iterations of the tree search for every decision")
    mcts_window_s: Positive | None = Field(
        default=40.0, description="the tree search looks back this far [s]; unset: to the start"
    )


class ChangesConfig(Section):
    """The joint search over changes."""

    p_moved: float = Field(default=0.01, gt=0, lt=1, description="prior probability that anything moved at all")
    move_sigma_m: Positive = Field(default=0.7, description="standard deviation of a displacement, each axis [m]")
    p_rotated: Probability = Field(default=0.1, description="share of moves that also turn the group")


class SlamConfig(Section):
    """The estimator."""

    method: Literal["nohyp", "max-mixture", "nn", "em", "mcts", "viterbi", "joint"] = Field(
        default="joint", description="how landmarks that moved are explained; 'nohyp' takes the world to be static"
    )

    sensor_model: Literal["calibrated", "plain"] = Field(
        default="calibrated",
        description="'calibrated' estimates sensor and odometry errors with the map, 'plain' believes all readings",
    )
    unknown_ids: bool = Field(
        default=False, description="ignore the identities that detections carry; associate by geometry"
    )
    solver: Literal["arrow", "gtsam"] = Field(
        default="arrow",
        description="of the steps between two batch solutions: 'arrow' is our own, 'gtsam' its iSAM2, to compare with",
    )
    robust: bool = Field(default=True, description="down-weight detections of wrong identity; off only for comparison")
    outlier_log_odds: float = Field(
        default=7.0,
        gt=0,
        le=50,
        description="an outlier is as likely as an inlier at a squared normalised residual of twice this",
    )
    estimate_noise: bool = Field(
        default=True, description="learn noise levels from the recording; off: keep the nominal ones"
    )
    odometry_noise_factor: Positive = Field(
        default=1.0,
        description="factor on the odometry noise that a run starts from, and keeps where estimate_noise is off",
    )
    seed: int = Field(default=0, ge=0, description="seed of everything random")
    calibration: CalibrationConfig = Field(
        default_factory=CalibrationConfig, description="which calibration states are estimated"
    )
    modes: ModesConfig = Field(
        default_factory=ModesConfig, description="methods 'max-mixture' to 'viterbi': landmarks with several positions"
    )
    changes: ChangesConfig = Field(
        default_factory=ChangesConfig, description="method 'joint': which landmarks moved together"
    )


class SensorConfig(Section):
    """Corrections of what the recording says about its sensor; unset fields keep the recording's value."""

    range_min_m: float | None = Field(default=None, ge=0, description="smallest range that is reported [m]")
    range_max_m: Positive | None = Field(default=None, description="largest range that is reported [m]")
    bearing_min_rad: float | None = Field(
        default=None, ge=-3.2, le=3.2, description="right edge of the field of view [rad]"
    )
    bearing_max_rad: float | None = Field(
        default=None, ge=-3.2, le=3.2, description="left edge of the field of view [rad]"
    )
    sigma_range_m: Positive | None = Field(default=None, description="nominal range noise [m]; a starting value")
    sigma_bearing_rad: Positive | None = Field(
        default=None, description="nominal bearing noise [rad]; a starting value"
    )
    p_detect: Probability | None = Field(default=None, description="probability of detecting a landmark in view")
    p_false: Probability | None = Field(default=None, description="probability of a false detection in a frame")
    mount_robot_sensor: tuple[float, float, float] | None = Field(
        default=None, description="pose of the sensor on the robot: x [m], y [m], theta [rad]"
    )

    def applied_to(self, sensor: Sensor) -> Sensor:
        """The recording's sensor with the fields that are set here; ConfigError if then nothing can be in view."""
        merged = replace(sensor, **self.model_dump(exclude_none=True))
        for low, high in (("range_min_m", "range_max_m"), ("bearing_min_rad", "bearing_max_rad")):
            if getattr(merged, low) >= getattr(merged, high):
                problem = f"{getattr(merged, low):g} is not below {high} = {getattr(merged, high):g}"
                raise ConfigError(problem, field=f"sensor.{low}")
        return merged


class OutputConfig(Section):
    """What is written beside the numbers."""

    figures: bool = Field(default=True, description="draw the figures")
    report: bool = Field(default=True, description="write report.html")
    rerun: bool = Field(default=True, description="write scene.rrd where rerun-sdk is installed")
    score_rate_hz: float = Field(
        default=2.0, gt=0, le=1000, description="rate at which a trajectory is compared with truth"
    )
