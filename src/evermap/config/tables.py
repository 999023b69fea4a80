"""Settings of the verbs that read tables: `persist` (looks), `track` (detections) and `survival fit` (lifetimes)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from evermap.config.section import Count, NotNegative, Positive, Probability, Section, Share
from evermap.errors import ConfigError
from evermap.types import FloatArray

DEFAULT_PRIOR = "unknown:1min..10y"
"""From a cup that is put down to a wall: every order of magnitude of the mean stay is equally likely."""
NO_RECURRENCE = "none"


class PersistConfig(Section):
    """Beliefs, changes and forecasts of a table of looks."""

    prior: str = Field(default=DEFAULT_PRIOR, description="lifetime of features that stay once")
    class_priors: dict[str, str] = Field(default_factory=dict, description="the same for single classes, by name")
    recurrent: str = Field(
        default=NO_RECURRENCE,
        description="how features return: 'none' for one stay, a kind of model to learn, or 'auto'",
    )
    per: Literal["auto", "all", "class", "feature"] = Field(
        default="auto", description="which features share a learned model"
    )
    model: str = Field(default="", description="file of a learned model; '' learns it from the table")
    learn_from: int = Field(
        default=100_000,
        ge=2,
        description="maximum number of looks to learn from: all looks at a random subset of features",
    )
    most_features_alone: Count = Field(default=32, description="with more features, 'auto' learns one model for all")
    fewest_looks_alone: Count = Field(
        default=200, description="looks per feature above which 'auto' learns a model for each"
    )
    query: Literal["times", "grid"] = Field(
        default="times", description="'times' asks for the belief at the time of every row, 'grid' at regular times"
    )
    step_s: Positive | None = Field(default=None, description="step of grid and forecasts [s]; unset: chosen")
    horizon_s: Positive | None = Field(
        default=None, description="how far to forecast beyond the latest look [s]; unset: a share of the looks' span"
    )
    forecast_steps: Count = Field(default=10, description="steps of a forecast, where step_s is unset")
    grid_steps: Count = Field(default=200, description="about so many steps of the grid, where step_s is unset")
    horizon_share: Positive = Field(default=0.25, description="horizon as a share of the span, where none is given")
    confidence: float = Field(default=0.9, gt=0.5, lt=1.0, description="belief above which a change is reported")
    tail: float = Field(
        default=0.025,
        gt=0.0,
        lt=0.5,
        description="probability that a change lies before the interval given for it, and as much after it",
    )
    p_miss: Probability = Field(default=0.1, description="P(no detection | there) if the table has no p_miss")
    p_false: Probability = Field(default=0.1, description="P(detection | not there) if the table has no p_false")
    figures: int = Field(default=12, ge=0, description="number of features with an individual figure")
    rows_at_once: int = Field(
        default=5_000_000, ge=1, description="rows that are held in memory; a larger Parquet table is done in parts"
    )

    @property
    def stays_once(self) -> bool:
        """Whether features have one lifetime and never return."""
        return self.recurrent == NO_RECURRENCE and not self.model

    @property
    def learns(self) -> bool:
        """Whether a model is learned from the looks."""
        return self.recurrent != NO_RECURRENCE and not self.model


class StillConfig(Section):
    """Which tracks of boxes stand and which move, by all of their detections."""

    sigma_m: Positive = Field(default=0.1, description="error of where a box is detected, at no range [m] ...")
    sigma_share: NotNegative = Field(default=0.01, description="... and as a share of its range")
    alike_s: NotNegative = Field(default=0.5, description="for how long such errors are alike [s]")
    still: Positive = Field(
        default=0.25,
        description="standard deviation of a static object's velocity, over its class's speed limit",
    )
    moving: Positive = Field(default=4.8, description="the same of what moves; at the limit both are as probable")
    window_s: Positive = Field(default=2.0, description="time over which a velocity is estimated [s]")
    least_s: Positive = Field(default=0.4, description="time that a track or a stay must last [s] ...")
    fewest: Count = Field(default=4, description="... and detections that it takes")
    p_stands: Share = Field(default=0.8, description="probability from which an object is taken to be static")
    same_m: Positive = Field(default=0.5, description="stays this close are one [m]")
    elsewhere_m: Positive = Field(default=2.0, description="what left was farther away than this [m]")
    when_s: NotNegative = Field(
        default=0.5, description="when a thing came to rest, or left, is known to within this to both sides [s]"
    )


class ShapeConfig(Section):
    """Sizes and headings of boxes, and what a detector makes of them."""

    misplaced: float = Field(
        default=16.0, ge=1.0, description="times the variance of its noise, of a box that is found beside its place ..."
    )
    p_misplaced: Share = Field(default=0.02, description="... and how often that is")
    other_size: Positive = Field(default=0.25, description="sizes of other objects differ by this share")
    p_misshapen: Share = Field(default=0.05, description="share of detections with an arbitrary size or heading")
    turning: NotNegative = Field(
        default=0.5, description="random walk of a heading: the end of a box moves sideways by this [m/sqrt(s)]"
    )
    resizing: NotNegative = Field(default=0.01, description="random walk of a size, as a share of it [1/sqrt(s)]")
    forward_nats: Positive = Field(
        default=3.0, description="log odds that the heading of a detection is not reversed: one in 20 is"
    )
    most_forward_nats: Positive = Field(
        default=7.0, description="log odds that this may be sure by: three opposite detections turn it, two do not"
    )
    sure_of_way: Positive = Field(
        default=9.0, description="squared forward speed over its variance from which the motion decides the heading"
    )


class TrackerConfig(Section):
    """What the tracker assumes about objects and their detector."""

    motion: Literal["acceleration", "velocity"] = Field(
        default="acceleration", description="constant quantity of the motion model: nine states, or six"
    )
    motion_density: Positive = Field(
        default=0.1, description="spectral density, each axis, of white jerk [m^2/s^5] or white acceleration [m^2/s^3]"
    )
    sigma_velocity_mps: Positive = Field(
        default=1.0, description="standard deviation of a new object's velocity, each axis [m/s]"
    )
    sigma_acceleration_mps2: Positive = Field(default=0.5, description="the same for its acceleration [m/s^2]")
    sigma_position_m: Positive = Field(
        default=0.3, description="noise of a detection without a covariance, each axis [m]"
    )
    gate_probability: Share = Field(default=0.9999, description="share of an object's own detections within its gate")
    p_detect: Share = Field(
        default=0.9, description="probability to detect an object in view, without a detection model"
    )
    clutter_per_m3: Positive = Field(
        default=1e-4, description="false detections and first sightings per frame and cubic metre"
    )
    p_real: Share = Field(
        default=0.5, description="probability that an unassigned detection is an object, not a false alarm"
    )
    sigma_face_m: NotNegative = Field(
        default=0.05, description="noise of the position of a face of a detected box [m] ..."
    )
    sigma_face_share: NotNegative = Field(default=0.035, description="... and as a share of the box's size")
    speed_per_length_hz: NotNegative = Field(
        default=3.0,
        description="standard deviation of a new box's speed along its heading, in its lengths per second [Hz]",
    )
    score_midpoint: float = Field(
        default=3.7, description="score at which a first detection is as likely real as false, unless all are in [0, 1]"
    )
    score_scale: Positive = Field(
        default=1.2, description="increase of the score that adds one to the log odds of that"
    )
    score_memory: float = Field(
        default=0.85, gt=0.0, le=1.0, description="weight of an object's older scores after each newer one"
    )
    seen_nats: NotNegative = Field(
        default=0.4, description="factor on the log of the number of detections in the log odds of being real"
    )
    missed_nats: NotNegative = Field(
        default=1.0, description="reduction of the log odds of being real by every frame without a detection"
    )
    p_believed: Share = Field(
        default=0.5, description="belief by scores above which a tracklet is ALIVE, for detections with scores"
    )
    p_confirm: Share = Field(default=0.999, description="belief above which a tracklet is ALIVE")
    p_dead: Share = Field(default=0.01, description="belief below which a tracklet is DEAD")
    warm_up: Count = Field(default=3, description="detections that a tracklet needs to be ALIVE")
    lost_after: Count = Field(default=3, description="consecutive frames without a detection until a tracklet is LOST")
    max_missed: Count = Field(
        default=10, description="consecutive frames without a detection until it is deleted, or stored if it is at rest"
    )
    vanish_rate_hz: NotNegative = Field(default=1e-3, description="rate at which objects in view cease to exist [1/s]")
    class_speed_mps: Positive | tuple[Positive, ...] = Field(
        default=0.5, description="speed above which an object is dynamic [m/s]: one for all, or one per class"
    )
    rest_for_s: NotNegative = Field(default=2.0, description="time without motion before an object is static [s]")
    p_off_class: Share = Field(default=0.05, description="probability of a wrong class, without a confusion matrix")
    appearance_nats: NotNegative = Field(
        default=20.0, description="log likelihood ratio between equal appearances and unrelated ones"
    )
    appearance_neutral: float = Field(
        default=0.7, ge=-1.0, lt=1.0, description="cosine of two appearances that is no evidence"
    )
    appearance_memory: float = Field(
        default=0.9, ge=0.0, lt=1.0, description="weight of the old appearance after a new detection"
    )
    place_sigma_m: Positive = Field(
        default=0.2, description="position tolerance of re-identification at rest, in addition to the noise [m]"
    )
    moved_reach_m: NotNegative = Field(
        default=0.0, description="how far objects may be moved while out of view, 0 if never; needs appearances [m]"
    )
    p_moved: Share = Field(default=0.01, description="probability of that")
    chunk_m: Positive = Field(default=10.0, description="side of the working set's square chunks [m]")
    judge_every_s: NotNegative = Field(
        default=1.0, description="time between two looks that are independent evidence about the working set [s]"
    )

    least_p_detect: Share = Field(
        default=1e-3, description="least probability to detect an object: a model of the view is not exact"
    )
    fast_sigmas: Positive = Field(
        default=2.33, description="standard deviations above its class's speed from which an object is dynamic"
    )
    displaced: Positive = Field(
        default=30.66, description="squared normalised distance at which a position is another place: one in a million"
    )
    most_counted: Count = Field(default=50, description="largest number of detections that counts as evidence")
    p_empty: Share = Field(
        default=1e-3, description="probability of misses in a row at which a place has been seen to be empty"
    )
    leave_rates_hz: tuple[Positive, Positive] = Field(
        default=(1e-8, 1e-2), description="rates of leaving a place, where nothing is known: from, to [1/s]"
    )
    slow_step_s: Positive = Field(
        default=2.0, description="frame interval beyond which a warning says that motion is poorly observed [s]"
    )
    shape: ShapeConfig = Field(default_factory=ShapeConfig, description="sizes and headings of boxes")
    still: StillConfig = Field(default_factory=StillConfig, description="static objects beside a moving robot")

    @property
    def order(self) -> int:
        """Derivatives of the position that are estimated, itself included: 3 or 2."""
        return 3 if self.motion == "acceleration" else 2

    def confusion_matrix(self, n_classes: int, given: FloatArray | None) -> FloatArray:
        """Return (C, C) `P(detected class | true class)`, a row a true class: the given one, or one of equal mistakes.

        Raises:
            ConfigError: a matrix of another shape, or rows that are not distributions.
        """
        if given is None:
            if n_classes == 1:
                return np.ones((1, 1))
            matrix = np.full((n_classes, n_classes), self.p_off_class / (n_classes - 1))
            np.fill_diagonal(matrix, 1.0 - self.p_off_class)
            return matrix
        matrix = np.ascontiguousarray(given, dtype=np.float64)
        if matrix.shape != (n_classes, n_classes):
            raise ConfigError(f"shape {matrix.shape} instead of ({n_classes}, {n_classes})", field="confusion")
        sums = matrix.sum(axis=1)
        for row in range(n_classes):
            if not (np.all(matrix[row] >= 0.0) and abs(sums[row] - 1.0) < 1e-6):
                raise ConfigError(
                    f"row {row} is not a distribution over detected classes (sum {sums[row]:g})",
                    field="confusion",
                    hint="rows are true classes and sum to 1",
                )
        return matrix

    def class_speeds(self, n_classes: int) -> FloatArray:
        """Return (C,) the speed above which an object of each class is dynamic.

        Raises:
            ConfigError: another number of speeds than of classes.
        """
        speeds = np.atleast_1d(np.asarray(self.class_speed_mps, dtype=np.float64))
        if len(speeds) not in {1, n_classes}:
            raise ConfigError(f"{len(speeds)} speeds for {n_classes} classes", field="class_speed_mps")
        return np.ascontiguousarray(np.broadcast_to(speeds, (n_classes,)))


class TrackConfig(TrackerConfig):
    """Objects over time from a table of detections, and how long they stay."""

    speeds_mps: dict[str, Positive] = Field(
        default_factory=dict, description="speed above which objects of single classes are dynamic, by name [m/s]"
    )
    prior: str = Field(default=DEFAULT_PRIOR, description="lifetime of objects at rest")
    class_priors: dict[str, str] = Field(default_factory=dict, description="the same for single classes, by name")
    range_m: Positive | None = Field(default=None, description="range of the sensor [m]; unset: misses are no evidence")
    fov_deg: float | None = Field(
        default=None,
        gt=0.0,
        le=360.0,
        description="horizontal field of view, ahead of the sensor [deg], with `range_m` and poses; unset: all around",
    )
    min_score: float | None = Field(default=None, description="minimum score of detections; unset: none")
    gap_s: Positive | None = Field(
        default=None, description="a longer time between two frames counts as a gap without looks [s]; unset: chosen"
    )
    gap_steps: float = Field(default=10.0, gt=1.0, description="that time in usual steps, if gap_s is unset")


class SurvivalConfig(Section):
    """Lifetimes estimated from a table of which only bounds are known."""

    estimator: str = Field(default="npmle", description="estimator, as listed by `evermap survival fit --help`")
    by: str = Field(
        default="", description="groups that are estimated separately: '', 'class', 'chunk', or 'class,chunk'"
    )
    chunk_m: Positive = Field(default=10.0, description="side of the square chunks [m]")
