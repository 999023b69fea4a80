"""Settings of the estimator, corrections of the sensor, and what a run writes."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field, field_validator

from evermap.config.section import Count, NotNegative, Positive, Probability, Section, Share
from evermap.errors import ConfigError
from evermap.types import FloatArray, Sensor, SensorKind


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
    turn_sigma_rad: Positive = Field(default=0.5, description="standard deviation of such a turn [rad]")
    rigid_m: Positive = Field(default=0.005, description="members of a group keep their distances to within this [m]")
    p_swapped: Share = Field(default=1e-5, description="probability that any two landmarks of a map were mixed up")
    displaced_log_odds: float = Field(
        default=7.0, description="prior log odds against a landmark being elsewhere for a part of the session [nats]"
    )
    map_factor_spread: Positive = Field(
        default=0.35, description="by how much the sigmas of a map may be wrong: standard deviation of their logarithm"
    )
    softness_m: tuple[Positive, ...] = Field(
        default=(0.005, 0.01, 0.02, 0.04),
        min_length=1,
        description="errors that the sightings of a landmark in a part of the session may share; evidence chooses [m]",
    )
    usual_softness_m: Positive = Field(
        default=0.02, description="the same while it is decided what was swapped or elsewhere for a while [m]"
    )
    fewest_sightings: Count = Field(
        default=3, description="sightings in a part of the session that tell where a landmark was then, at least"
    )
    most_groups: Count = Field(default=4, description="groups that may have moved, at most")
    most_candidates: Count = Field(default=40, description="landmarks that may have moved, at most: the likeliest")
    visit_gap_s: Positive = Field(
        default=10.0, description="a landmark that was not seen for longer than this is visited anew [s]"
    )
    interval: Share = Field(default=0.95, description="probability of the interval in which a change is told to be")
    rival_nats: NotNegative = Field(
        default=5.0, description="explanations less probable than the best by up to this are reported beside it [nats]"
    )
    most_rivals: int = Field(default=2, ge=0, description="explanations reported beside the best, at most")
    disagreement: Positive = Field(
        default=4.0, description="chi-square a degree of freedom above which a map without changes explains nothing"
    )
    loose_map_m: Positive = Field(
        default=1.0, description="standard deviation of a map that must not bend what is seen [m]"
    )

    @property
    def spread(self) -> FloatArray:
        """(3,) standard deviations of a displacement in x [m] and y [m], and of its angle [rad]."""
        return np.array([self.move_sigma_m, self.move_sigma_m, self.turn_sigma_rad])


class CheckConfig(Section):
    """What makes a recording odd; see `slam.check`."""

    lags_s: tuple[Positive, ...] = Field(
        default=(1.0, 4.0),
        min_length=1,
        description="sightings that are compared are at least so far apart, and at most twice as far [s]",
    )
    most_pairs: Count = Field(default=1000, description="pairs of sightings compared for each lag, at most")
    fits: Positive = Field(
        default=0.03, description="difference between two readings that is usual: share of the range, and rad"
    )
    apart: Positive = Field(
        default=3.0, description="a pair distinguishes two explanations that differ by so many median residuals"
    )
    agreed: Share = Field(
        default=0.8, description="share of those pairs that a mistake has to explain before it is reported"
    )
    fewest: Count = Field(default=20, description="pairs that decide, at least")
    gain: Positive = Field(default=20.0, description="log likelihood of all pairs that a mistake must raise by")
    off: Positive = Field(
        default=0.3, description="median residual beyond which readings and odometry have nothing to do with each other"
    )
    own_ids: Count = Field(
        default=50, description="landmarks, hardly any seen twice, from which on it is no recording of landmarks"
    )
    far_off: Positive = Field(
        default=5.0, description="standard deviations of its prior beyond which a calibration state is reported"
    )


class CleaningConfig(Section):
    """What is left out of the recording of a session as impossible; see `slam.cleaning`."""

    fastest: Positive = Field(default=100.0, description="speed beyond which odometry is left out [m/s, rad/s]")
    hardest: Positive = Field(default=20.0, description="acceleration that makes a spike of odometry [m/s^2, rad/s^2]")
    sharpest: Positive = Field(default=2.0, description="change of speed that is never a spike [m/s, rad/s]")
    too_far: float = Field(
        default=2.0, ge=1.0, description="factor on the largest range beyond which a reading is left out"
    )
    far_from_median: float = Field(
        default=100.0, ge=1.0, description="the same on the median range, for a sensor without a largest range"
    )
    moved: Positive = Field(
        default=0.1, description="motion after which no sensor gives the very same readings again [m, rad]"
    )
    stray_s: Positive = Field(
        default=10.0, description="stamps farther from those around, and frames from odometry, are left out [s]"
    )
    step_s: Positive = Field(default=1.0, description="smallest step of a clock that is repaired [s]")
    around: int = Field(default=9, ge=3, le=999, description="messages that a stamp is compared with; an odd number")

    @field_validator("around")
    @classmethod
    def _odd(cls, around: int) -> int:
        if around % 2 == 0:
            raise ValueError(f"must be an odd number, not {around}")
        return around


class SpaceConfig(Section):
    """What is estimated of sensors in space, beside poses and landmarks."""

    mount_sigma_m: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="how far sensors may be from their mounts as stated [m]; 0: exactly there",
    )
    mount_sigma_rad: float = Field(
        default=0.0, ge=0, le=3, description="how far they may be turned from there [rad]; 0: not at all"
    )
    delay_sigma_s: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="how late the stamps of sensors may be [s]; 0: not at all",
    )
    range_scale: float | None = Field(
        default=None,
        gt=0.5,
        lt=2.0,
        description="factor on the ranges of boxes without identity; unset: by what stands, the odometry's metre holds",
    )


class NoiseConfig(Section):
    """Noise levels that a run starts from, where the sensor states none."""

    sigma_range_m: Positive = Field(default=0.1, description="standard deviation of ranges [m]")
    sigma_bearing_rad: Positive = Field(default=0.02, description="standard deviation of bearings [rad]")
    forward_by_distance: Positive = Field(default=0.05, description="of forward motion, by distance [m/sqrt(m)]")
    forward_by_turn: Positive = Field(default=0.05, description="of forward motion, by angle turned [m/sqrt(rad)]")
    sideways_by_distance: Positive = Field(default=0.03, description="of sideways motion, by distance [m/sqrt(m)]")
    turn_by_time: Positive = Field(default=0.01, description="of turning, by time [rad/sqrt(s)]")
    turn_by_turn: Positive = Field(default=0.05, description="of turning, by angle turned [rad/sqrt(rad)]")
    pseudo_count: Positive = Field(default=1.0, description="residuals that these levels count for in what is learned")


class SlamConfig(Section):
    """The estimator."""

    method: Literal["nohyp", "max-mixture", "nn", "em", "mcts", "viterbi", "joint"] = Field(
        default="joint", description="how landmarks that moved are explained; 'nohyp' takes the world to be static"
    )

    sensor_model: Literal["calibrated", "plain"] = Field(
        default="calibrated",
        description="'calibrated' estimates sensor and odometry errors with the map, 'plain' believes all readings",
    )
    unknown_ids: bool | Literal["empty"] = Field(
        default=False,
        description="associate by geometry: true ignores the identities that detections carry, 'empty' is for those "
        "without one only",
    )
    vote_ids: bool = Field(
        default=True,
        description="leave out identities that other detections at the same place within seconds contradict, and those "
        "that are on two landmarks",
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
    noise: NoiseConfig = Field(default_factory=NoiseConfig, description="noise levels to start from")
    space: SpaceConfig = Field(default_factory=SpaceConfig, description="sensors in space")
    check: CheckConfig = Field(default_factory=CheckConfig, description="what makes a recording odd")
    cleaning: CleaningConfig = Field(
        default_factory=CleaningConfig, description="what is impossible in the recording of a session"
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
    kind: SensorKind | None = Field(
        default=None, description="kind of sensor, by which its errors are as usual, not larger"
    )
    sigma_scale: float | None = Field(
        default=None, ge=0, le=1, description="standard deviation of the scale of its ranges, a share"
    )
    sigma_offset_m: float | None = Field(
        default=None, ge=0, description="standard deviation of what is added to all its ranges [m]"
    )
    sigma_angle_rad: float | None = Field(
        default=None, ge=0, le=6.3, description="standard deviation of its angle in the mount [rad]"
    )
    sigma_odometer_scale: float | None = Field(
        default=None, ge=0, le=1, description="standard deviation of the scale of the odometer, a share"
    )
    sigma_askew_rad: float | None = Field(
        default=None, ge=0, le=6.3, description="standard deviation of the direction of driving, from the front [rad]"
    )

    def applied_to(self, sensor: Sensor) -> Sensor:
        """Return the recording's sensor with the fields that are set here; ConfigError if then nothing can be in
        view.
        """
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
    rerun: bool = Field(default=False, description="write scene.rrd for the rerun viewer, where rerun-sdk is installed")
    mcap: bool = Field(default=False, description="write run.mcap for Foxglove and ROS 2, which needs rosbags")
    score_rate_hz: float = Field(
        default=2.0, gt=0, le=1000, description="rate at which a trajectory is compared with truth"
    )
