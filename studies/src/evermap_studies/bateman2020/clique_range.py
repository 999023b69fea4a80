"""How far a clique is from the sensor, and how often its landmarks are missed from there (Bateman 2020 section 3.2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import ConfigError, InputError
from evermap.types import FloatArray, IntArray


def nearest_per_clique(range_m: FloatArray, clique: IntArray, n_cliques: int) -> FloatArray:
    """Distance of the nearest landmark of each clique.

    Args:
        range_m: (K,) distance of each landmark from the sensor.
        clique: (K,) which clique each is of.
        n_cliques: number of cliques C.

    Returns:
        (C,) metres; inf for a clique without landmarks.

    Raises:
        InputError: arrays of different lengths, a clique that does not exist, or a range that is no distance.
    """
    if np.shape(range_m) != np.shape(clique) or np.ndim(clique) != 1:
        raise InputError(f"shape {np.shape(clique)} for ranges of shape {np.shape(range_m)}", field="clique")
    wrong = np.flatnonzero((clique < 0) | (clique >= n_cliques))
    if wrong.size:
        raise InputError(f"row {wrong[0]}: clique {clique[wrong[0]]} of {n_cliques} does not exist", field="clique")
    wrong = np.flatnonzero(~(range_m >= 0.0))
    if wrong.size:
        raise InputError(f"row {wrong[0]}: {range_m[wrong[0]]} m is no distance", field="range_m")
    nearest = np.full(n_cliques, np.inf)
    np.minimum.at(nearest, clique, range_m)
    return nearest


def range_degraded_miss(nearest_m: ArrayLike, length_m: float, *, least: float = 0.0, most: float = 1.0) -> FloatArray:
    """`P_M(s) = 1 - exp(-s / length)`, cut to [least, most]: the miss rate of the range-degraded clique filter, JCFR.

    Bateman 2020 eq. 3.12, whose exponent `s s_max / s_obs` has a dimension; read as a length scale (MATH.md section 3).

    Args:
        nearest_m: distance of the clique's nearest landmark, of any shape.
        length_m: distance at which about two landmarks of three are missed.
        least: smallest miss rate; 0 would make a miss at no distance a proof of absence.
        most: largest miss rate; 1 would make a detection from afar a proof of absence.

    Raises:
        ConfigError: a length that is not positive, or bounds that are no probabilities in order.
    """
    if not 0.0 < length_m < np.inf:
        raise ConfigError(f"must be positive and finite, not {length_m!r}", field="length_m")
    if not 0.0 <= least <= most <= 1.0:
        raise ConfigError(f"{least!r} and {most!r} are no probabilities in order", field="least")
    return np.clip(-np.expm1(-np.asarray(nearest_m, dtype=np.float64) / length_m), least, most)
