"""What a number in an input file may be: its column name, its limits, and what a violation usually means.

The limits are far beyond any robot. They catch wrong units (degrees, milliseconds, millimetres) and damaged files.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi
from pathlib import Path

import numpy as np

from evermap.errors import InputError
from evermap.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Quantity:
    """A numeric column.

    Attributes:
        name: column name, with its unit.
        low, high: inclusive limits, unless `positive`, which excludes zero and below.
        positive: whether values must be greater than zero.
        optional: whether a cell may be empty (nan then).
        hint: what to try when a value is out of its limits.
    """

    name: str
    low: float = -inf
    high: float = inf
    positive: bool = False
    optional: bool = False
    hint: str = ""

    def check(self, values: FloatArray, *, path: Path, line: IntArray) -> None:
        """Raises InputError at the first value that is not finite (or not given, if needed) or out of limits."""
        absent = np.isnan(values) if self.optional else np.zeros(len(values), dtype=bool)
        with np.errstate(invalid="ignore"):
            fine = np.isfinite(values) & (values >= self.low) & (values <= self.high)
            if self.positive:
                fine &= values > 0
        bad = np.flatnonzero(~fine & ~absent)
        if len(bad):
            row = int(bad[0])
            problem = self._complaint(float(values[row]))
            raise InputError(problem, path=path, line=int(line[row]), field=self.name, hint=self.hint or None)

    def _complaint(self, value: float) -> str:
        if not np.isfinite(value):
            return f"{value} where a finite number is needed"
        if self.positive and value <= 0:
            return f"{value:g} where a number greater than zero is needed"
        return f"{value:g} is outside [{self.low:g}, {self.high:g}]"


STAMP_S = Quantity("stamp_s", -1e11, 1e11, hint="stamps in seconds, not in milli- or nanoseconds")
FORWARD_MPS = Quantity("forward_mps", -1e3, 1e3, hint="metres per second")
LATERAL_MPS = Quantity("lateral_mps", -1e3, 1e3, hint="metres per second")
ANGULAR_RADPS = Quantity("angular_radps", -1e3, 1e3, hint="radians per second")
DX_M = Quantity("dx_m", -1e5, 1e5, hint="metres since the previous row")
DY_M = Quantity("dy_m", -1e5, 1e5, hint="metres since the previous row")
DTHETA_RAD = Quantity("dtheta_rad", -pi, pi, hint="radians since the previous row, at most half a turn")
RANGE_M = Quantity("range_m", 0.0, 1e6, positive=True, hint="metres; leave out readings that mean 'no return'")
BEARING_RAD = Quantity("bearing_rad", -2 * pi, 2 * pi, hint="radians, not degrees")
X_M = Quantity("x_m", -1e8, 1e8, hint="metres")
Y_M = Quantity("y_m", -1e8, 1e8, hint="metres")
THETA_RAD = Quantity("theta_rad", -1e6, 1e6, hint="radians")
SIGMA_RANGE_M = Quantity("sigma_range_m", 0.0, 1e6, positive=True, optional=True, hint="leave empty where unknown")
SIGMA_BEARING_RAD = Quantity(
    "sigma_bearing_rad", 0.0, 1e6, positive=True, optional=True, hint="leave empty where unknown"
)
