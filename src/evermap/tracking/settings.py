"""Everything that can be set about tracking, with default and meaning."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from evermap.errors import ConfigError
from evermap.types import FloatArray


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """What the tracker assumes about objects and their detector.

    Attributes:
        motion: constant acceleration (nine states, the thesis') or constant velocity (six).
        motion_density: power spectral density, each axis, of the white jerk [m^2/s^5] or white acceleration [m^2/s^3].
        sigma_velocity_mps: standard deviation of a new object's velocity, each axis.
        sigma_acceleration_mps2: the same of its acceleration.
        sigma_position_m: noise of a detection, each axis, where none is given with it.
        gate_probability: share of an object's own detections that its gate lets through.
        p_detect: probability to detect an object in view, where no view says better.
        clutter_per_m3: density of detections a frame that are no known object: false ones and first sightings.
        p_real: probability that a detection which is no known object is an object, and not a false alarm.
        p_confirm: belief from which a tracklet is ALIVE.
        p_dead: belief below which it is DEAD.
        warm_up: detections that a tracklet needs to be ALIVE.
        lost_after: frames without a detection in a row from which a tracklet is LOST.
        max_missed: frames without a detection in a row after which it is given up: static to the working set.
        vanish_rate_hz: rate at which objects in view cease to exist.
        class_speed_mps: speed above which an object is dynamic: one for all, or one a class.
        rest_for_s: time for which an object must have stayed where it is, to be static.
        p_off_class: probability of a wrong class, where no confusion matrix is given.
        appearance_nats: log-likelihood ratio between the same look (cosine 1) and one of no relation (`..._neutral`).
        appearance_neutral: cosine of two appearances that says nothing.
        appearance_memory: share of the old appearance that a new detection leaves.
        place_sigma_m: how exactly a static object is found again in its place, each axis, beside the noise.
        moved_reach_m: objects may have been moved this far while out of view, 0 if never: wants appearances.
        p_moved: probability of that.
        chunk_m: side of the working set's square chunks.
        judge_every_s: time between two looks that are taken as independent evidence about the working set.
    """

    motion: Literal["acceleration", "velocity"] = "acceleration"
    motion_density: float = 0.1
    sigma_velocity_mps: float = 1.0
    sigma_acceleration_mps2: float = 0.5
    sigma_position_m: float = 0.3
    gate_probability: float = 0.9999
    p_detect: float = 0.9
    clutter_per_m3: float = 1e-4
    p_real: float = 0.5
    p_confirm: float = 0.999
    p_dead: float = 0.01
    warm_up: int = 3
    lost_after: int = 3
    max_missed: int = 10
    vanish_rate_hz: float = 1e-3
    class_speed_mps: float | tuple[float, ...] = 0.5
    rest_for_s: float = 2.0
    p_off_class: float = 0.05
    appearance_nats: float = 20.0
    appearance_neutral: float = 0.7
    appearance_memory: float = 0.9
    place_sigma_m: float = 0.2
    moved_reach_m: float = 0.0
    p_moved: float = 0.01
    chunk_m: float = 10.0
    judge_every_s: float = 1.0

    def __post_init__(self) -> None:
        shares = {"gate_probability", "p_detect", "p_real", "p_confirm", "p_dead", "p_off_class", "p_moved"}
        whole = {"warm_up", "lost_after", "max_missed"}
        maybe_zero = {"appearance_nats", "vanish_rate_hz", "rest_for_s", "judge_every_s", "moved_reach_m"}
        for name in (field.name for field in fields(self)):
            value = getattr(self, name)
            if name in shares:
                wrong = not 0.0 < value < 1.0
                hint = "a number between 0 and 1"
            elif name in whole:
                wrong, hint = value != int(value) or value < 1, "a whole number from 1"
            elif name in maybe_zero:
                wrong, hint = not 0.0 <= value < np.inf, "a number from 0"
            elif name == "appearance_memory":
                wrong, hint = not 0.0 <= value < 1.0, "a number from 0, below 1"
            elif name == "appearance_neutral":
                wrong, hint = not -1.0 <= value < 1.0, "a cosine below 1"
            elif name == "motion":
                wrong, hint = value not in {"acceleration", "velocity"}, "acceleration, velocity"
            else:
                numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
                wrong, hint = not np.all((numbers > 0.0) & np.isfinite(numbers)), "a number above 0"
            if wrong:
                raise ConfigError(f"{value!r} is out of range", field=name, hint=hint)

    @property
    def order(self) -> int:
        """Derivatives of the position that are estimated, itself included: 3 or 2."""
        return 3 if self.motion == "acceleration" else 2

    def confusion_matrix(self, n_classes: int, given: FloatArray | None) -> FloatArray:
        """(C, C) `P(detected class | true class)`, a row a true class: the given one, or one of equal mistakes.

        Raises:
            ConfigError: a matrix of another shape, or rows that are no probabilities.
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
                    f"row {row} is no distribution over detected classes (sum {sums[row]:g})",
                    field="confusion",
                    hint="rows are true classes and sum to 1",
                )
        return matrix

    def class_speeds(self, n_classes: int) -> FloatArray:
        """(C,) speed above which an object of each class is dynamic.

        Raises:
            ConfigError: another number of speeds than of classes.
        """
        speeds = np.atleast_1d(np.asarray(self.class_speed_mps, dtype=np.float64))
        if len(speeds) not in {1, n_classes}:
            raise ConfigError(f"{len(speeds)} speeds for {n_classes} classes", field="class_speed_mps")
        return np.ascontiguousarray(np.broadcast_to(speeds, (n_classes,)))
