"""Settings of the verbs that read tables: `persist` (looks), `track` (detections) and `survival fit` (lifetimes)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from evermap.config.section import Count, NotNegative, Positive, Probability, Section, Share, key, part
from evermap.errors import ConfigError
from evermap.types import FloatArray

DEFAULT_PRIOR = "unknown:1min..10y"
"""From a cup that is put down to a wall: every order of magnitude of the mean stay is equally likely."""
NO_RECURRENCE = "none"


class PersistConfig(Section):
    """Beliefs, changes and forecasts of a table of looks."""

    prior: str = key(DEFAULT_PRIOR, "lifetime of features that stay once")
    class_priors: dict[str, str] = key({}, "the same for single classes, by name")
    recurrent: str = key(NO_RECURRENCE, "how features return: 'none' for one stay, a kind of model to learn, or 'auto'")
    per: Literal["auto", "all", "class", "feature"] = key("auto", "which features share a learned model")
    model: str = key("", "file of a learned model; '' learns it from the table")
    learn_from: int = key(
        100_000, "maximum number of looks to learn from: all looks at a random subset of features", ge=2
    )
    most_features_alone: Count = key(32, "with more features, 'auto' learns one model for all")
    fewest_looks_alone: Count = key(200, "looks per feature above which 'auto' learns a model for each")
    query: Literal["times", "grid"] = key(
        "times", "'times' asks for the belief at the time of every row, 'grid' at regular times"
    )
    step_s: Positive | None = key(None, "step of grid and forecasts [s]; unset: chosen")
    horizon_s: Positive | None = key(
        None, "how far to forecast beyond the latest look [s]; unset: a share of the looks' span"
    )
    forecast_steps: Count = key(10, "steps of a forecast, where step_s is unset")
    grid_steps: Count = key(200, "about so many steps of the grid, where step_s is unset")
    horizon_share: Positive = key(0.25, "horizon as a share of the span, where none is given")
    confidence: float = key(0.9, "belief above which a change is reported", gt=0.5, lt=1.0)
    tail: float = key(
        0.025, "probability that a change lies before the interval given for it, and as much after it", gt=0.0, lt=0.5
    )
    p_miss: Probability = key(0.1, "P(no detection | there) if the table has no p_miss")
    p_false: Probability = key(0.1, "P(detection | not there) if the table has no p_false")
    figures: int = key(12, "number of features with an individual figure", ge=0)
    rows_at_once: int = key(5_000_000, "rows that are held in memory; a larger Parquet table is done in parts", ge=1)

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

    sigma_m: Positive = key(0.1, "error of where a box is detected, at no range [m] ...")
    sigma_share: NotNegative = key(0.01, "... and as a share of its range")
    alike_s: NotNegative = key(0.5, "for how long such errors are alike [s]")
    still: Positive = key(0.25, "standard deviation of a static object's velocity, over its class's speed limit")
    moving: Positive = key(4.8, "the same of what moves; at the limit both are as probable")
    window_s: Positive = key(2.0, "time over which a velocity is estimated [s]")
    least_s: Positive = key(0.4, "time that a track or a stay must last [s] ...")
    fewest: Count = key(4, "... and detections that it takes")
    p_stands: Share = key(0.8, "probability from which an object is taken to be static")
    same_m: Positive = key(0.5, "stays this close are one [m]")
    elsewhere_m: Positive = key(2.0, "what left was farther away than this [m]")
    when_s: NotNegative = key(0.5, "when a thing came to rest, or left, is known to within this to both sides [s]")


class ShapeConfig(Section):
    """Sizes and headings of boxes, and what a detector makes of them."""

    misplaced: float = key(16.0, "times the variance of its noise, of a box that is found beside its place ...", ge=1.0)
    p_misplaced: Share = key(0.02, "... and how often that is")
    other_size: Positive = key(0.25, "sizes of other objects differ by this share")
    p_misshapen: Share = key(0.05, "share of detections with an arbitrary size or heading")
    turning: NotNegative = key(0.5, "random walk of a heading: the end of a box moves sideways by this [m/sqrt(s)]")
    resizing: NotNegative = key(0.01, "random walk of a size, as a share of it [1/sqrt(s)]")
    forward_nats: Positive = key(3.0, "log odds that the heading of a detection is not reversed: one in 20 is")
    most_forward_nats: Positive = key(
        7.0, "log odds that this may be sure by: three opposite detections turn it, two do not"
    )
    sure_of_way: Positive = key(
        9.0, "squared forward speed over its variance from which the motion decides the heading"
    )


class TrackerConfig(Section):
    """What the tracker assumes about objects and their detector."""

    motion: Literal["acceleration", "velocity"] = key(
        "acceleration", "constant quantity of the motion model: nine states, or six"
    )
    motion_density: Positive = key(
        0.1, "spectral density, each axis, of white jerk [m^2/s^5] or white acceleration [m^2/s^3]"
    )
    sigma_velocity_mps: Positive = key(1.0, "standard deviation of a new object's velocity, each axis [m/s]")
    sigma_acceleration_mps2: Positive = key(0.5, "the same for its acceleration [m/s^2]")
    sigma_position_m: Positive = key(0.3, "noise of a detection without a covariance, each axis [m]")
    gate_probability: Share = key(0.9999, "share of an object's own detections within its gate")
    p_detect: Share = key(0.9, "probability to detect an object in view, without a detection model")
    clutter_per_m3: Positive = key(1e-4, "false detections and first sightings per frame and cubic metre")
    p_real: Share = key(0.5, "probability that an unassigned detection is an object, not a false alarm")
    sigma_face_m: NotNegative = key(0.05, "noise of the position of a face of a detected box [m] ...")
    sigma_face_share: NotNegative = key(0.035, "... and as a share of the box's size")
    speed_per_length_hz: NotNegative = key(
        3.0, "standard deviation of a new box's speed along its heading, in its lengths per second [Hz]"
    )
    score_midpoint: float = key(
        3.7, "score at which a first detection is as likely real as false, unless all are in [0, 1]"
    )
    score_scale: Positive = key(1.2, "increase of the score that adds one to the log odds of that")
    score_memory: float = key(0.85, "weight of an object's older scores after each newer one", gt=0.0, le=1.0)
    seen_nats: NotNegative = key(0.4, "factor on the log of the number of detections in the log odds of being real")
    missed_nats: NotNegative = key(1.0, "reduction of the log odds of being real by every frame without a detection")
    p_believed: Share = key(0.5, "belief by scores above which a tracklet is ALIVE, for detections with scores")
    p_confirm: Share = key(0.999, "belief above which a tracklet is ALIVE")
    p_dead: Share = key(0.01, "belief below which a tracklet is DEAD")
    warm_up: Count = key(3, "detections that a tracklet needs to be ALIVE")
    lost_after: Count = key(3, "consecutive frames without a detection until a tracklet is LOST")
    max_missed: Count = key(
        10, "consecutive frames without a detection until it is deleted, or stored if it is at rest"
    )
    vanish_rate_hz: NotNegative = key(1e-3, "rate at which objects in view cease to exist [1/s]")
    class_speed_mps: Positive | tuple[Positive, ...] = key(
        0.5, "speed above which an object is dynamic [m/s]: one for all, or one per class"
    )
    rest_for_s: NotNegative = key(2.0, "time without motion before an object is static [s]")
    p_off_class: Share = key(0.05, "probability of a wrong class, without a confusion matrix")
    appearance_nats: NotNegative = key(20.0, "log likelihood ratio between equal appearances and unrelated ones")
    appearance_neutral: float = key(0.7, "cosine of two appearances that is no evidence", ge=-1.0, lt=1.0)
    appearance_memory: float = key(0.9, "weight of the old appearance after a new detection", ge=0.0, lt=1.0)
    place_sigma_m: Positive = key(0.2, "position tolerance of re-identification at rest, in addition to the noise [m]")
    moved_reach_m: NotNegative = key(
        0.0, "how far objects may be moved while out of view, 0 if never; needs appearances [m]"
    )
    p_moved: Share = key(0.01, "probability of that")
    chunk_m: Positive = key(10.0, "side of the working set's square chunks [m]")
    judge_every_s: NotNegative = key(
        1.0, "time between two looks that are independent evidence about the working set [s]"
    )

    least_p_detect: Share = key(1e-3, "least probability to detect an object: a model of the view is not exact")
    fast_sigmas: Positive = key(2.33, "standard deviations above its class's speed from which an object is dynamic")
    displaced: Positive = key(
        30.66, "squared normalised distance at which a position is another place: one in a million"
    )
    most_counted: Count = key(50, "largest number of detections that counts as evidence")
    p_empty: Share = key(1e-3, "probability of misses in a row at which a place has been seen to be empty")
    leave_rates_hz: tuple[Positive, Positive] = key(
        (1e-8, 1e-2), "rates of leaving a place, where nothing is known: from, to [1/s]"
    )
    slow_step_s: Positive = key(2.0, "frame interval beyond which a warning says that motion is poorly observed [s]")
    shape: ShapeConfig = part(ShapeConfig, "sizes and headings of boxes")
    still: StillConfig = part(StillConfig, "static objects beside a moving robot")

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

    speeds_mps: dict[str, Positive] = key({}, "speed above which objects of single classes are dynamic, by name [m/s]")
    prior: str = key(DEFAULT_PRIOR, "lifetime of objects at rest")
    class_priors: dict[str, str] = key({}, "the same for single classes, by name")
    range_m: Positive | None = key(None, "range of the sensor [m]; unset: misses are no evidence")
    fov_deg: float | None = key(
        None,
        "horizontal field of view, ahead of the sensor [deg], with `range_m` and poses; unset: all around",
        gt=0.0,
        le=360.0,
    )
    min_score: float | None = key(None, "minimum score of detections; unset: none")
    gap_s: Positive | None = key(
        None, "a longer time between two frames counts as a gap without looks [s]; unset: chosen"
    )
    gap_steps: float = key(10.0, "that time in usual steps, if gap_s is unset", gt=1.0)


class SurvivalConfig(Section):
    """Lifetimes estimated from a table of which only bounds are known."""

    estimator: str = key("npmle", "estimator, as listed by `evermap survival fit --help`")
    by: str = key("", "groups that are estimated separately: '', 'class', 'chunk', or 'class,chunk'")
    chunk_m: Positive = key(10.0, "side of the square chunks [m]")
