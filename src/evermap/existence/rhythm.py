"""Daily and weekly rhythms: by what a hazard is multiplied at each local time of the week."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import ConfigError
from evermap.types import FloatArray, IntArray

DAY_S = 86400.0
WEEK_S = 7.0 * DAY_S
BIN_S = 600.0
"""A rhythm is constant for ten minutes at a time."""
BINS_OF_DAY = round(DAY_S / BIN_S)
BINS = 7 * BINS_OF_DAY
MONDAY_S = 4.0 * DAY_S
"""1970-01-05 was a Monday."""


@dataclass(frozen=True, slots=True)
class Rhythm:
    """A factor on a hazard for every ten minutes of the week, Monday 00:00 first.

    Stamps are seconds since 1970-01-01 as the clocks on the wall show them (`Clock.LOCAL_WALL`).

    Attributes:
        log_factor: (1008,) natural logarithm of the factor.

    Raises:
        ConfigError: another shape, or numbers that are not finite.
    """

    log_factor: FloatArray

    def __post_init__(self) -> None:
        if self.log_factor.shape != (BINS,) or not np.isfinite(self.log_factor).all():
            raise ConfigError(f"a rhythm is {BINS} finite numbers, one for every ten minutes of the week")

    @property
    def factor(self) -> FloatArray:
        """(1008,) by what the hazard is multiplied."""
        return np.asarray(np.exp(self.log_factor), dtype=np.float64)

    def at(self, stamp_s: ArrayLike) -> FloatArray:
        """The factor at some instants."""
        return np.asarray(self.factor[bin_of_week(stamp_s)], dtype=np.float64)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON."""
        return {"log_factor": [round(float(value), 5) for value in self.log_factor]}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Rhythm:
        """What `to_dict` wrote."""
        return cls(np.array(data["log_factor"], dtype=np.float64))


def bin_of_week(stamp_s: ArrayLike) -> IntArray:
    """Which ten minutes of the week an instant lies in, 0 from Monday 00:00, stamps in local wall time."""
    phase = np.mod(np.asarray(stamp_s, dtype=np.float64) - MONDAY_S, WEEK_S)
    return np.minimum((phase / BIN_S).astype(np.int64), BINS - 1)
