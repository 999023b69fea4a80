"""What is believed of sensors and odometry: priors of their errors by kind, and what a run says of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from pydantic import ValidationInfo, field_validator

from evermap.config.section import NotNegative, Positive, Probability, Section, Share, key, rule
from evermap.errors import ConfigError
from evermap.types import NOT_IN_SPACE, Sensor, SensorKind, SpatialSensor

SIGMAS = {
    "range_bias_m": 0.1,
    "range_slope": 0.02,
    "range_skew_per_rad": 0.1,
    "range_curvature_per_rad2": 0.5,
    "bearing_bias_rad": 0.05,
    "mount_forward_m": 0.03,
    "mount_left_m": 0.03,
    "odometry_delay_s": 0.3,
    "odometry_forward_scale": 0.05,
    "odometry_turn_scale": 0.1,
    "odometry_turn_slip_m": 0.05,
}
OfSensor = tuple[Positive, Positive, Positive, Positive, Positive]
KINDS: dict[SensorKind, OfSensor] = {
    SensorKind.LASER: (0.05, 0.002, 0.002, 0.002, 0.01),
    SensorKind.CAMERA: (0.1, 0.02, 0.1, 0.5, 0.05),
    SensorKind.TAG: (0.05, 0.02, 0.05, 0.1, 0.05),
    SensorKind.STEREO: (0.05, 0.02, 0.05, 0.1, 0.03),
    SensorKind.UWB: (0.3, 0.005, 0.02, 0.02, 0.05),
}
InSpace = tuple[Positive, Positive, NotNegative, NotNegative]
KINDS_IN_SPACE: dict[SensorKind, InSpace] = {
    SensorKind.LASER: (0.001, 0.02, 0.001, 0.003),
    SensorKind.CAMERA: (0.02, 0.02, 0.1, 0.005),
    SensorKind.TAG: (0.005, 0.005, 0.02, 0.005),
    SensorKind.STEREO: (0.01, 0.01, 0.03, 0.003),
    SensorKind.UWB: (0.003, 0.1, 0.002, 0.05),
}


class CalibrationConfig(Section):
    """Which calibration states are estimated, and what is believed of them before."""

    fix: dict[str, float] = key(
        {}, "calibration states held at a value instead of estimated, by name, e.g. odometry_delay_s = 0.0"
    )
    sigma: dict[str, Positive] = key(SIGMAS, "standard deviations of their priors, each in its own unit")
    kinds: dict[SensorKind, OfSensor] = key(
        KINDS, "those of the first five, which depend on the kind of sensor, where it is stated"
    )
    sigma_askew_rad: Positive = key(0.03, "of the direction in which a robot drives, from its front, if unstated [rad]")
    p_needed: Share = rule(0.5, "prior probability that a state is not as stated")
    p_needed_sensor: Share = rule(0.1, "the same of errors of ranges, for a laser or a sensor of no stated kind")
    p_needed_known: Share = rule(0.9, "the same of a sensor that is stated to be of another kind than a laser")
    p_spare: Share = rule(0.01, "probability to be needed below which a state is held as stated")

    @field_validator("sigma", "kinds")
    @classmethod
    def _all(cls, given: dict[Any, Any], info: ValidationInfo) -> dict[Any, Any]:
        usual: dict[Any, Any] = SIGMAS if info.field_name == "sigma" else KINDS
        if unknown := given.keys() - usual.keys():
            raise ValueError(f"no calibration state is called '{min(unknown)}': {', '.join(usual)}")
        return usual | given


class OdometryConfig(Section):
    """What is believed of the odometry, beside its noise."""

    silence_s: Positive = key(1.0, "gap of the odometry beyond which the last velocity is not continued [s]")
    silent_variance: Positive = rule(0.25, "variance that such a silence adds every second, at least [m^2/s, rad^2/s]")
    longest_silence_s: Positive = rule(60.0, "after a longer silence no more is unknown than after this [s]")
    turn_s: Positive = rule(2.0, "span over which turns stand out from jitter [s]")
    stands_out: Positive = rule(3.0, "standard deviations of the jitter by which it does")
    loose_rad: Positive = rule(0.3, "heading that a silence leaves unknown, from which a recording is in parts [rad]")


class SensorConfig(Section):
    """Corrections of what the recording says about its sensor; unset fields keep the recording's value."""

    range_min_m: float | None = key(None, "minimum range [m]", ge=0)
    range_max_m: Positive | None = key(None, "maximum range [m]")
    bearing_min_rad: float | None = key(None, "right edge of the field of view [rad]", ge=-3.2, le=3.2)
    bearing_max_rad: float | None = key(None, "left edge of the field of view [rad]", ge=-3.2, le=3.2)
    sigma_range_m: Positive | None = key(None, "nominal range noise [m]; a starting value")
    sigma_bearing_rad: Positive | None = key(None, "nominal bearing noise [rad]; a starting value")
    p_detect: Probability | None = key(None, "probability of detecting a landmark in view")
    p_false: Probability | None = key(None, "probability of a false detection in a frame")
    mount_robot_sensor: tuple[float, float, float] | None = key(
        None, "pose of the sensor on the robot: x [m], y [m], theta [rad]"
    )
    kind: SensorKind | None = key(None, "kind of sensor, which sets the priors of its errors")
    sigma_scale: float | None = key(None, "relative standard deviation of the scale of its ranges", ge=0, le=1)
    sigma_offset_m: float | None = key(None, "standard deviation of the offset of its ranges [m]", ge=0)
    sigma_angle_rad: float | None = key(None, "standard deviation of its mounting angle [rad]", ge=0, le=6.3)
    sigma_position_m: float | None = key(
        None, "standard deviation of its position on the robot, along each axis [m]", ge=0, le=1e3
    )
    sigma_odometer_scale: float | None = key(
        None, "relative standard deviation of the scale of the odometer", ge=0, le=1
    )
    sigma_askew_rad: float | None = key(
        None, "standard deviation of the driving direction relative to the front [rad]", ge=0, le=6.3
    )

    def apply_to(self, sensor: Sensor) -> Sensor:
        """Return the recording's sensor with the fields that are set here; ConfigError if then nothing can be in
        view.
        """
        merged = replace(sensor, **self.model_dump(exclude_none=True))
        for low, high in (("range_min_m", "range_max_m"), ("bearing_min_rad", "bearing_max_rad")):
            if getattr(merged, low) >= getattr(merged, high):
                problem = f"{getattr(merged, low):g} is not below {high} = {getattr(merged, high):g}"
                raise ConfigError(problem, field=f"sensor.{low}")
        return merged

    def apply_in_space(self, sensors: Sequence[SpatialSensor]) -> tuple[SpatialSensor, ...]:
        """Return the sensors of a recording in space with the fields that are set here, each the same.

        Raises:
            ConfigError: a field that means nothing in space, or nothing can be in range.
        """
        given = self.model_dump(exclude_none=True)
        for name, hint in NOT_IN_SPACE.items():
            if name in given:
                raise ConfigError("is not used for a recording in space", field=f"sensor.{name}", hint=hint)
        merged = tuple(replace(sensor, **given) for sensor in sensors)
        for one in merged:
            if one.range_min_m >= one.range_max_m:
                problem = f"{one.range_min_m:g} is not below range_max_m = {one.range_max_m:g}"
                raise ConfigError(problem, field="sensor.range_min_m")
        return merged
