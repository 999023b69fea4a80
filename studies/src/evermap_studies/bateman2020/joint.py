"""Filters of landmarks on rigid bodies (Bateman 2020 chapter 3): each alone (`iff`), a clique as one (`jcf`).

A clique is the landmarks of one body; as long as the body is there, so are they. K landmarks, C cliques; `clique` says
which one each landmark is of, in any order. Times count from the birth of the clique, and all else is as in `single`:
`init` and `predict` come from there. Looks to be left out are not `expected`; what the sensor's range does to them is
in `sensing.clique_range` and `sensing.suppression`, the Joint Feature Filter in `jff`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.existence import protocol as checks
from evermap.existence.single import Belief
from evermap.types import BoolArray, FloatArray, IntArray


def iff(state: Belief, stamp_s: Any, detected: Any, p_miss: Any, p_false: Any, expected: Any) -> Belief:
    """Return the independent feature filter: `Belief.update` of expected landmarks (Rosen 2016, Algorithm 1).

    Args:
        state: beliefs of K landmarks.
        stamp_s: scalar or (K,) time of the look since each landmark's birth; NaN where there was none.
        detected: (K,) 1 or 0; ignored where nothing was expected, like `p_miss` and `p_false`.
        p_miss: scalar or (K,), `P(no detection | there)`.
        p_false: scalar or (K,), `P(detection | gone)`.
        expected: scalar or (K,) bool.

    Raises:
        InputError, NumericalError: as `Belief.update`; messages name the landmark's row.
    """
    time = checks.as_rows(stamp_s, len(state), "stamp_s")
    looked = as_mask(expected, len(state))
    return state.update(np.where(looked, time, np.nan), detected, p_miss, p_false)


def jcf(
    state: Belief, stamp_s: Any, detected: Any, p_miss: Any, p_false: Any, expected: Any, clique: IntArray
) -> Belief:
    """Return the joint clique filter: all landmarks of a clique share one survival time (Bateman 2020, Algorithm 1).

    Given that time detections are independent, so a look at a clique weighs as the product of the likelihoods of its
    expected landmarks (eqs. 3.9 and 3.10). A clique of which none was expected stays as it is. With
    `p_miss = range_degraded_miss(...)[clique]` this is JCFR.

    Args:
        state: beliefs of C cliques.
        stamp_s: scalar or (C,) time of the look since each clique's birth; NaN where there was none.
        detected: (K,) 1 or 0; ignored where nothing was expected, like `p_miss` and `p_false`.
        p_miss: scalar or (K,), `P(no detection | there)`.
        p_false: scalar or (K,), `P(detection | gone)`.
        expected: scalar or (K,) bool.
        clique: (K,) row of `state` that each landmark is of.

    Raises:
        InputError: a probability outside [0, 1], time running back, or a clique that does not exist; the row is named.
        NumericalError: detections that are impossible whether the clique is there or gone.
    """
    n = len(state)
    member = checks.check_rows(clique, n, twice=True, field="clique")
    time = checks.as_rows(stamp_s, n, "stamp_s")
    looked = np.flatnonzero(as_mask(expected, len(member)) & ~np.isnan(time)[member])
    hit, miss, false = (
        checks.as_rows(column, len(member), field)[looked]
        for column, field in ((detected, "detected"), (p_miss, "p_miss"), (p_false, "p_false"))
    )
    checks.check_detected(hit, looked, "landmark")
    checks.check_probability(miss, "p_miss", looked, "landmark")
    checks.check_probability(false, "p_false", looked, "landmark")

    member = member[looked]
    seen = np.bincount(member, minlength=n) > 0
    log_there, log_gone = (_sum(likelihood, member, n) for likelihood in checks.likelihoods(hit, miss, false))
    return state.observe(np.where(seen, time, np.nan), log_there, log_gone)


def as_mask(values: Any, n: int) -> BoolArray:
    """Return `expected` as booleans of shape (n,).

    Raises:
        InputError: not booleans, or a shape that does not fit.
    """
    mask = np.asarray(values)
    if mask.dtype != np.bool_ or mask.shape not in ((), (n,)):
        raise InputError(f"{mask.dtype} of shape {mask.shape} instead of bool of ({n},)", field="expected")
    return np.broadcast_to(mask, (n,))


def _sum(likelihood: FloatArray, member: IntArray, n: int) -> FloatArray:
    """(n,) logarithm of the product over the members of each clique; -inf where any is 0."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.bincount(member, weights=np.log(likelihood), minlength=n), dtype=np.float64)
