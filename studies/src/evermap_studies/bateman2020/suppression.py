"""False negative suppression: looks at the border of what the sensor sees are left out (Bateman 2020 section 3.4)."""

from __future__ import annotations

import numpy as np

from evermap.errors import ConfigError, InputError
from evermap.types import BoolArray, FloatArray, IntArray
from evermap_studies.bateman2020.clique_range import nearest_per_clique


def suppressed(
    range_m: FloatArray,
    detected: BoolArray,
    expected: BoolArray,
    clique: IntArray,
    n_cliques: int,
    *,
    observed_m: float,
    range_max_m: float,
    share: float,
) -> BoolArray:
    """Which cliques are not to be updated in this step, detections included.

    Those of which every landmark is farther than `observed_m`, one is nearer than `range_max_m`, and less than `share`
    of the expected landmarks were detected. All landmarks count for the distances, expected or not. A filter of single
    landmarks leaves out a landmark with its clique: `expected & ~suppressed(...)[clique]`.

    Args:
        range_m: (K,) distance of each landmark from the sensor.
        detected: (K,) whether it was detected; counts where it was expected.
        expected: (K,) whether it was expected.
        clique: (K,) which clique it is of.
        n_cliques: number of cliques C.
        observed_m: within this range the sensor is trusted (s_obs).
        range_max_m: nothing farther is detected (s_max).
        share: of detections among the expected that is enough to trust a look from afar (delta).

    Returns:
        (C,) True for cliques to be left out; False for those of which nothing was expected.

    Raises:
        InputError: arrays of different lengths, a clique that does not exist, or a range that is no distance.
        ConfigError: a share outside [0, 1], or a limit of range that is not positive.
    """
    if not 0.0 <= share <= 1.0:
        raise ConfigError(f"must lie in [0, 1], not {share!r}", field="share")
    for field, limit in (("observed_m", observed_m), ("range_max_m", range_max_m)):
        if not limit > 0.0:
            raise ConfigError(f"must be positive, not {limit!r}", field=field)
    for field, mask in (("detected", detected), ("expected", expected)):
        if mask.shape != np.shape(clique) or mask.dtype != np.bool_:
            raise InputError(f"{mask.dtype} of shape {mask.shape}, not bool of shape {np.shape(clique)}", field=field)
    nearest_m = nearest_per_clique(range_m, clique, n_cliques)
    expectations = np.bincount(clique[expected], minlength=n_cliques)
    detections = np.bincount(clique[expected & detected], minlength=n_cliques)
    return (nearest_m > observed_m) & (nearest_m < range_max_m) & (detections < share * expectations)
