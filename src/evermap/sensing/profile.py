"""Detection profile of a sensor: detection by range and by incidence, false alarms, occlusions.

Everything is a ratio of two running sums, *hits over expected hits*, so that a prior is a few hits that were never
seen, learning is addition, and what two robots learned is added up. Factors multiply; the sums of each are collected
with the other factors given (the mean-field posterior of a product of gamma rates under Poisson counts).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from enum import StrEnum

import numpy as np

from evermap.errors import ConfigError
from evermap.types import FloatArray

RANGE_BINS = 16
FACING_BINS = 16
SMALLEST_RATE = 1e-3
"""Assumed detection of a landmark from behind: impossible for a solid body, but bodies have holes."""


class Projection(StrEnum):
    """How a sensor measures its vertical angle."""

    SPHERICAL = "spherical"
    """From the horizontal plane, as a spinning lidar: the field is an annulus."""
    PINHOLE = "pinhole"
    """In the plane of x and z, as a camera: the field is a pyramid."""


@dataclass(frozen=True, slots=True)
class Field:
    """Field of view of a sensor with x ahead and z up (Bateman 2020 section 5.1.1).

    Attributes:
        range_max_m: nothing farther is detected.
        half_azimuth_rad: to the left and to the right; pi is all around.
        half_elevation_rad: up and down.
        projection: what the vertical angle is measured from.
    """

    range_max_m: float
    half_azimuth_rad: float
    half_elevation_rad: float
    projection: Projection

    def __post_init__(self) -> None:
        if not 0.0 < self.range_max_m < math.inf:
            raise ConfigError(f"must be positive and finite, not {self.range_max_m!r}", field="range_max_m")
        widest = math.pi if self.projection is Projection.SPHERICAL else math.pi / 2
        for name, most in (("half_azimuth_rad", widest), ("half_elevation_rad", math.pi / 2)):
            value = getattr(self, name)
            if not 0.0 < value <= most:
                raise ConfigError(f"must be above 0 and at most {most:.4f}, not {value!r}", field=name)


@dataclass(frozen=True, slots=True)
class Assumed:
    """Prior of a sensor's profile, and its weight.

    Attributes:
        field: its limits.
        fading_m: length over which detection fades with range; 0.7 of the largest range where None.
        viewing_angle_rad: angle of incidence up to which landmarks are detected.
        p_false: probability of a detection of a landmark that is not there, or cannot be seen.
        p_false_looks: number of looks that this is worth.
        hits: expected hits that detection by range, by incidence, and of each landmark by direction are worth.
        facing_edge: scale of the logistic edge of detection by incidence, in units of the cosine.
        sigma_position_m, sigma_attitude_rad: of the poses.
        p_never_occluded: that nobody ever stands in the way, here.
        occlusion_rates_hz: otherwise, how often somebody comes (one of these, equally likely) ...
        occlusion_lengths_s: ... and for how long he stays on the mean (one of these).
    """

    field: Field
    fading_m: float | None = None
    viewing_angle_rad: float = math.radians(85.0)
    p_false: float = 0.005
    p_false_looks: float = 400.0
    hits: float = 3.0
    facing_edge: float = 0.1
    sigma_position_m: float = 0.05
    sigma_attitude_rad: float = math.radians(1.0)
    p_never_occluded: float = 0.5
    occlusion_rates_hz: tuple[float, ...] = (0.003, 0.01, 0.03, 0.1)
    occlusion_lengths_s: tuple[float, ...] = (2.0, 5.0, 12.0)

    def __post_init__(self) -> None:
        if not 0.0 < self.p_false < 1.0:
            raise ConfigError(f"must lie between 0 and 1, not {self.p_false!r}", field="p_false", hint="0.005")
        if not 0.0 < self.p_never_occluded < 1.0:
            raise ConfigError(f"must lie between 0 and 1, not {self.p_never_occluded!r}", field="p_never_occluded")
        for name in ("p_false_looks", "hits"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ConfigError(f"must be positive and finite, not {getattr(self, name)!r}", field=name)
        for name in ("occlusion_rates_hz", "occlusion_lengths_s"):
            values = getattr(self, name)
            if not values or not all(0.0 < value < math.inf for value in values):
                raise ConfigError(f"must be positive numbers, not {values!r}", field=name)
        if self.fading_m is not None and not 0.0 < self.fading_m <= math.inf:
            raise ConfigError(f"must be positive, not {self.fading_m!r}", field="fading_m", hint="0.7 of the range")
        if not 0.0 < self.viewing_angle_rad <= math.pi:
            problem = f"must be above 0 and at most pi, not {self.viewing_angle_rad!r}"
            raise ConfigError(problem, field="viewing_angle_rad")
        if not 0.0 < self.sigma_position_m < math.inf:
            problem = f"must be positive and finite, not {self.sigma_position_m!r}: no edge is infinitely sharp"
            raise ConfigError(problem, field="sigma_position_m", hint="0.001")
        if not 0.0 <= self.sigma_attitude_rad < math.inf:
            raise ConfigError(
                f"must be finite and not negative, not {self.sigma_attitude_rad!r}", field="sigma_attitude_rad"
            )

    @property
    def range_rate(self) -> FloatArray:
        """(16,) detection by range: `exp(-r / length)`."""
        length_m = 0.7 * self.field.range_max_m if self.fading_m is None else self.fading_m
        return np.exp(-range_middles(self.field.range_max_m) / length_m)

    @property
    def facing_rate(self) -> FloatArray:
        """(16,) detection by incidence: a logistic edge at the viewing angle."""
        beyond = (facing_middles() - math.cos(self.viewing_angle_rad)) / self.facing_edge
        return np.maximum(1.0 / (1.0 + np.exp(-beyond)), SMALLEST_RATE)


@dataclass(frozen=True, slots=True)
class Profile:
    """Learned profile of a sensor; add two with the same assumptions by `+`.

    Attributes:
        assumed: where it started.
        range_hits, range_expected: (16,) at the middles of equal bins up to the largest range.
        facing_hits, facing_expected: (16,) at the middles of equal bins of the cosine of incidence, from -1 to 1.
        false_hits, false_looks: detections of landmarks that were not to be seen, and looks at such.
        log_weight: (J,) log posterior of the occlusion chains, up to a constant.
    """

    assumed: Assumed
    range_hits: FloatArray
    range_expected: FloatArray
    facing_hits: FloatArray
    facing_expected: FloatArray
    false_hits: float
    false_looks: float
    log_weight: FloatArray

    @classmethod
    def of(cls, assumed: Assumed) -> Profile:
        """Return the profile before anything was seen."""
        chains = len(assumed.occlusion_rates_hz) * len(assumed.occlusion_lengths_s)
        weight = np.append(assumed.p_never_occluded, np.full(chains, (1.0 - assumed.p_never_occluded) / chains))
        expected = np.full(RANGE_BINS, assumed.hits), np.full(FACING_BINS, assumed.hits)
        return cls(
            assumed=assumed,
            range_hits=assumed.range_rate * expected[0],
            range_expected=expected[0],
            facing_hits=assumed.facing_rate * expected[1],
            facing_expected=expected[1],
            false_hits=assumed.p_false * assumed.p_false_looks,
            false_looks=assumed.p_false_looks,
            log_weight=np.log(weight),
        )

    def __add__(self, other: Profile) -> Profile:
        """Return the sum of both profiles, with the assumptions counted once.

        Raises:
            ConfigError: they started from different assumptions.
        """
        if self.assumed != other.assumed:
            raise ConfigError("profiles of different assumptions cannot be added", field="assumed")
        start = Profile.of(self.assumed)
        learned = {
            item.name: getattr(self, item.name) + getattr(other, item.name) - getattr(start, item.name)
            for item in fields(self)
            if item.name != "assumed"
        }
        return replace(self, **learned)

    @property
    def range_rate(self) -> FloatArray:
        """(16,) detection by range."""
        return self.range_hits / self.range_expected

    @property
    def facing_rate(self) -> FloatArray:
        """(16,) detection by incidence."""
        return self.facing_hits / self.facing_expected

    @property
    def p_false(self) -> float:
        """Probability of a false alarm of a landmark in the field."""
        return self.false_hits / self.false_looks

    @property
    def occlusion(self) -> Occlusion:
        """The chains that may govern occlusions, with their posterior probabilities."""
        weight = np.exp(self.log_weight - self.log_weight.max())
        rates, lengths = self.assumed.occlusion_rates_hz, self.assumed.occlusion_lengths_s
        return Occlusion(
            come_hz=np.append(0.0, np.repeat(rates, len(lengths))),
            go_hz=np.append(1.0, np.tile(1.0 / np.array(lengths), len(rates))),
            weight=weight / weight.sum(),
        )


@dataclass(frozen=True, slots=True)
class Occlusion:
    """J two-state Markov chains in continuous time, one of which governs the occlusion of a clique.

    Attributes:
        come_hz: (J,) rate from free to occluded; the first is 0.
        go_hz: (J,) rate from occluded to free.
        weight: (J,) probability of each chain.
    """

    come_hz: FloatArray
    go_hz: FloatArray
    weight: FloatArray

    @property
    def share(self) -> float:
        """Expected share of the time for which a clique is occluded."""
        return float(self.weight @ (self.come_hz / (self.come_hz + self.go_hz)))


def range_middles(range_max_m: float) -> FloatArray:
    """Return (16,) middles of the range bins [m]."""
    return np.asarray((np.arange(RANGE_BINS) + 0.5) * (range_max_m / RANGE_BINS))


def facing_middles() -> FloatArray:
    """Return (16,) middles of the bins of the cosine of incidence."""
    return np.asarray((np.arange(FACING_BINS) + 0.5) * (2.0 / FACING_BINS) - 1.0)
