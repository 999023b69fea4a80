"""Detections of objects over time."""

from __future__ import annotations

from typing import Literal

import numpy as np

from evermap.config.section import Count, NotNegative, Positive, Section, Share, key, part, rule
from evermap.errors import ConfigError
from evermap.types import DEFAULT_PRIOR, FloatArray


class StillConfig(Section):
    """Which tracks of boxes stand and which move, by all of their detections."""

    sigma_m: Positive = rule(0.1, "error of where a box is detected, at no range [m] ...")
    sigma_share: NotNegative = rule(0.01, "... and as a share of its range")
    alike_s: NotNegative = rule(0.5, "for how long such errors are alike [s]")
    still: Positive = rule(0.25, "standard deviation of a static object's velocity, over its class's speed limit")
    moving: Positive = rule(4.8, "the same of what moves; at the limit both are as probable")
    window_s: Positive = rule(2.0, "time over which a velocity is estimated [s]")
    least_s: Positive = rule(0.4, "time that a track or a stay must last [s] ...")
    fewest: Count = rule(4, "... and detections that it takes")
    p_stands: Share = rule(0.9, "probability from which an object is taken to be static")
    same_m: Positive = rule(0.5, "stays this close are one [m]")
    elsewhere_m: Positive = rule(2.0, "what left was farther away than this [m] ...")
    sure_sigmas: Positive = rule(3.0, "... or moves where it is farther off its place than so many standard deviations")
    hidden_s: NotNegative = rule(5.0, "what leaves while it is hidden is seen again within this time [s]")
    when_s: NotNegative = rule(0.5, "when a thing came to rest, or left, is known to within this to both sides [s]")


class ShapeConfig(Section):
    """Sizes and headings of boxes, and what a detector makes of them."""

    misplaced: float = rule(
        16.0, "times the variance of its noise, of a box that is found beside its place ...", ge=1.0
    )
    p_misplaced: Share = rule(0.02, "... and how often that is")
    other_size: Positive = rule(0.25, "sizes of other objects differ by this share")
    p_misshapen: Share = rule(0.05, "share of detections with an arbitrary size or heading")
    turning: NotNegative = rule(0.5, "random walk of a heading: the end of a box moves sideways by this [m/sqrt(s)]")
    resizing: NotNegative = rule(0.01, "random walk of a size, as a share of it [1/sqrt(s)]")
    forward_nats: Positive = rule(3.0, "log odds that the heading of a detection is not reversed: one in 20 is")
    most_forward_nats: Positive = rule(
        7.0, "log odds that this may be sure by: three opposite detections turn it, two do not"
    )
    sure_of_way: Positive = rule(
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
    sigma_velocity_mps: Positive = rule(1.0, "standard deviation of a new object's velocity, each axis [m/s]")
    sigma_acceleration_mps2: Positive = rule(0.5, "the same for its acceleration [m/s^2]")
    sigma_position_m: Positive = key(0.3, "noise of a detection without a covariance, each axis [m]")
    gate_probability: Share = rule(0.9999, "share of an object's own detections within its gate")
    p_detect: Share = key(0.9, "probability to detect an object in view, without a detection model")
    clutter_per_m3: Positive = key(1e-4, "false detections and first sightings per frame and cubic metre")
    p_real: Share = rule(0.5, "probability that an unassigned detection is an object, not a false alarm")
    sigma_face_m: NotNegative = rule(0.05, "noise of the position of a face of a detected box [m] ...")
    sigma_face_share: NotNegative = rule(0.035, "... and as a share of the box's size")
    speed_per_length_hz: NotNegative = rule(
        3.0, "standard deviation of a new box's speed along its heading, in its lengths per second [Hz]"
    )
    score_midpoint: float = rule(
        3.7, "score at which a first detection is as likely real as false, unless all are in [0, 1]"
    )
    score_scale: Positive = rule(1.2, "increase of the score that adds one to the log odds of that")
    score_memory: float = rule(0.85, "weight of an object's older scores after each newer one", gt=0.0, le=1.0)
    seen_nats: NotNegative = rule(0.4, "factor on the log of the number of detections in the log odds of being real")
    missed_nats: NotNegative = rule(1.0, "reduction of the log odds of being real by every frame without a detection")
    p_believed: Share = rule(0.5, "belief by scores above which a tracklet is ALIVE, for detections with scores")
    p_confirm: Share = key(0.999, "belief above which a tracklet is ALIVE")
    p_dead: Share = key(0.01, "belief below which a tracklet is DEAD")
    warm_up: Count = key(3, "detections that a tracklet needs to be ALIVE")
    lost_after: Count = rule(3, "consecutive frames without a detection until a tracklet is LOST")
    max_missed: Count = key(
        10, "consecutive frames without a detection until it is deleted, or stored if it is at rest"
    )
    vanish_rate_hz: NotNegative = rule(1e-3, "rate at which objects in view cease to exist [1/s]")
    class_speed_mps: Positive | tuple[Positive, ...] = key(
        0.5, "speed above which an object is dynamic [m/s]: one for all, or one per class"
    )
    rest_for_s: NotNegative = key(2.0, "time without motion before an object is static [s]")
    p_off_class: Share = key(0.05, "probability of a wrong class, without a confusion matrix")
    appearance_nats: NotNegative = rule(20.0, "log likelihood ratio between equal appearances and unrelated ones")
    appearance_neutral: float = rule(0.7, "cosine of two appearances that is no evidence", ge=-1.0, lt=1.0)
    appearance_memory: float = rule(0.9, "weight of the old appearance after a new detection", ge=0.0, lt=1.0)
    place_sigma_m: Positive = key(0.2, "position tolerance of re-identification at rest, in addition to the noise [m]")
    moved_reach_m: NotNegative = key(
        0.0, "how far objects may be moved while out of view, 0 if never; needs appearances [m]"
    )
    p_moved: Share = rule(0.01, "probability of that")
    chunk_m: Positive = key(10.0, "side of the working set's square chunks [m]")
    judge_every_s: NotNegative = rule(
        1.0, "time between two looks that are independent evidence about the working set [s]"
    )

    least_p_detect: Share = rule(1e-3, "least probability to detect an object: a model of the view is not exact")
    fast_sigmas: Positive = rule(2.33, "standard deviations above its class's speed from which an object is dynamic")
    displaced: Positive = rule(
        30.66, "squared normalised distance at which a position is another place: one in a million"
    )
    most_counted: Count = rule(50, "largest number of detections that counts as evidence")
    p_empty: Share = rule(1e-3, "probability of misses in a row at which a place has been seen to be empty")
    leave_rates_hz: tuple[Positive, Positive] = rule(
        (1e-8, 1e-2), "rates of leaving a place, where nothing is known: from, to [1/s]"
    )
    slow_step_s: Positive = rule(2.0, "frame interval beyond which a warning says that motion is poorly observed [s]")
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
        fine = (matrix >= 0.0).all(axis=1) & (np.abs(sums - 1.0) < 1e-6)
        if not fine.all():
            row = int(np.argmin(fine))
            problem = f"row {row} is not a distribution over detected classes (sum {sums[row]:g})"
            raise ConfigError(problem, field="confusion", hint="rows are true classes and sum to 1")
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
        "horizontal field of view, ahead of the sensor [deg], with `range_m` and poses; unset: from the detections",
        gt=0.0,
        le=360.0,
    )
    all_around_deg: float = rule(
        225.0, "field of view from which on detections are of a sensor that sees all around [deg]", gt=0.0, le=360.0
    )
    p_all_around: Share = rule(
        1e-4, "chance that a sensor that sees all around shows all that close together, below which the view is narrow"
    )
    min_score: float | None = key(None, "minimum score of detections; unset: none")
    gap_s: Positive | None = key(
        None, "a longer time between two frames counts as a gap without looks [s]; unset: chosen"
    )
    gap_steps: float = rule(10.0, "that time in usual steps, if gap_s is unset", gt=1.0)
