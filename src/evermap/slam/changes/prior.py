"""How changes are distributed before anything is seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from evermap.types import FloatArray


@dataclass(frozen=True, slots=True)
class ChangePrior:
    """How changes are distributed before anything is seen.

    Attributes:
        p_moved: probability that a group moved at all.
        move_sigma_m: standard deviation of a displacement, each axis.
        p_rotated: share of groups that also turned.
        turn_sigma_rad: standard deviation of a turn.
    """

    p_moved: float = 0.01
    move_sigma_m: float = 0.7
    p_rotated: float = 0.1
    turn_sigma_rad: float = 0.5

    @property
    def spread(self) -> FloatArray:
        """(3,) standard deviations of x [m], y [m] and angle [rad]."""
        return np.array([self.move_sigma_m, self.move_sigma_m, self.turn_sigma_rad])

    def log_prior(self, n_landmarks: int, largest: int) -> FloatArray:
        """(largest + 1, 2) of a group by its size, if it only moves and if it also turns: `eps 2^-n / C(N, n)`."""
        size = np.arange(largest + 1)
        choices = gammaln(n_landmarks + 1) - gammaln(size + 1) - gammaln(n_landmarks - size + 1)
        group = np.log(self.p_moved) - np.log1p(-self.p_moved) - size * np.log(2.0) - choices
        with np.errstate(divide="ignore"):
            table: FloatArray = group[:, None] + np.log([1.0 - self.p_rotated, self.p_rotated])
        table[:2, 1] = -np.inf  # one landmark alone has nothing to turn
        table[0] = 0.0
        return table

    def log_onset(self, n_windows: int) -> FloatArray:
        """(W,) of the window from which on a group has moved: before the session as likely as within it."""
        if n_windows == 1:
            return np.zeros(1)
        log_prior: FloatArray = np.log(np.append(0.5, np.full(n_windows - 1, 0.5 / (n_windows - 1))))
        return log_prior
