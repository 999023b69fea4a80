"""The Joint Feature Filter of Nobre et al. (ICRA 2018), in two reconstructions; Bateman 2020 compares with it.

The paper is not at hand, so neither form claims to be its authors' code.

* **Mixture** (MATH.md section 3; `init`, `update`, `predict`): with a prior probability the landmarks of a clique share
  one survival time, otherwise each has its own. This is a proper Bayesian model, and exact: the belief in a landmark is
  that of the joint clique filter and that of the independent filter, weighted by how well each foretold the
  detections. With weight 1 it is `joint.jcf`, with weight 0 `joint.iff`.
* **Pairwise** (`pairwise_weights`): each landmark's belief is its own independent one, averaged with those of its
  neighbours, which are averaged likewise: `p_i = w_ii q_i + sum_j w_ij p_j`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.errors import ConfigError, InputError
from evermap.existence import protocol as checks
from evermap.existence import single
from evermap.existence.single import Belief
from evermap.survival import LifetimePrior
from evermap.types import FloatArray, IntArray
from evermap_studies.bateman2020 import joint

if TYPE_CHECKING:
    from scipy.sparse import csr_array

TOUCHING_M = 1e-3
"""Distance that neighbours are taken to have at least: landmarks at one point would share nothing with the others."""


@dataclass(frozen=True, slots=True)
class MixtureBelief:
    """Persistence of K landmarks on C cliques under both hypotheses.

    Attributes:
        shared: C rows, each clique with one survival time; with log evidence.
        alone: K rows, each landmark with its own; with log evidence.
        clique: (K,) row of `shared` that each landmark is of.
        weight: (C,) prior probability that a clique's landmarks share their survival time.
    """

    shared: Belief
    alone: Belief
    clique: IntArray
    weight: FloatArray

    @property
    def p_shared(self) -> FloatArray:
        """(C,) posterior probability that the landmarks of each clique share their survival time."""
        assert self.shared.log_evidence is not None
        assert self.alone.log_evidence is not None
        each_alone = np.bincount(self.clique, weights=self.alone.log_evidence, minlength=len(self.shared))
        with np.errstate(divide="ignore", over="ignore"):
            log_odds = np.log(self.weight) - np.log1p(-self.weight) + self.shared.log_evidence - each_alone
            return np.asarray(1.0 / (1.0 + np.exp(-log_odds)), dtype=np.float64)


def init(
    clique: IntArray,
    n_cliques: int,
    prior: LifetimePrior | Sequence[LifetimePrior],
    *,
    weight: float | FloatArray,
    prior_of_clique: IntArray | None = None,
) -> MixtureBelief:
    """Beliefs at the birth of the cliques: all landmarks are there.

    Args:
        clique: (K,) which clique each landmark is of.
        n_cliques: number of cliques C.
        prior: one lifetime prior for all, or several.
        weight: scalar or (C,), prior probability that the landmarks of a clique share their survival time.
        prior_of_clique: (C,) index into `prior`, needed as soon as there is more than one.

    Raises:
        ConfigError: as `single.init`.
        InputError: a clique that does not exist, or a weight that is not a probability.
    """
    member = checks.check_rows(clique, n_cliques, twice=True, field="clique")
    share = checks.as_rows(weight, n_cliques, "weight")
    checks.check_probability(share, "weight", noun="clique")
    shared = single.init(n_cliques, prior, prior_of_row=prior_of_clique, evidence=True)
    alone = single.init(len(member), shared.priors, prior_of_row=shared.prior_of_row[member], evidence=True)
    return MixtureBelief(shared, alone, member, share)


def update(
    state: MixtureBelief, stamp_s: Any, detected: Any, p_miss: Any, p_false: Any, expected: Any
) -> MixtureBelief:
    """Beliefs after one look; arguments and errors as `joint.jcf`, which is one of the two filters inside."""
    clique = state.clique
    shared = joint.jcf(state.shared, stamp_s, detected, p_miss, p_false, expected, clique)
    time = checks.as_rows(stamp_s, len(shared), "stamp_s")[clique]
    return replace(state, shared=shared, alone=joint.iff(state.alone, time, detected, p_miss, p_false, expected))


def predict(state: MixtureBelief, stamp_s: Any) -> FloatArray:
    """Probability that each landmark exists at `stamp_s`; the state stays as it is.

    Args:
        state: beliefs of K landmarks on C cliques.
        stamp_s: scalar or (C,) times since each clique's birth, none before its last look.

    Returns:
        (K,) probabilities.

    Raises:
        InputError: a time that is not finite or lies before the last look.
    """
    time = checks.as_rows(stamp_s, len(state.shared), "stamp_s")
    together = state.shared.predict(time)[state.clique]
    alone = state.alone.predict(time[state.clique])
    p_shared = state.p_shared[state.clique]
    return np.asarray(p_shared * together + (1.0 - p_shared) * alone, dtype=np.float64)


def pairwise_weights(
    landmark_m: FloatArray, clique: IntArray, *, own: float = 0.7, neighbours: int = 5, reach_m: float = 2.0
) -> csr_array:
    """Matrix `A` that turns independent beliefs `q` (of `joint.iff`) into pairwise ones, `p = A @ q`.

    `p_i = w_ii q_i + sum_j w_ij p_j` over the nearest neighbours `j` of landmark `i` in its clique. Solved once:
    `A = (I - W)^-1 diag(w_ii)`. Its rows are weights: none is negative, and they sum to 1. (Reconstruction.)

    Args:
        landmark_m: (K, 3) positions.
        clique: (K,) which clique each landmark is of.
        own: weight `w_ii` of a landmark's own belief; 1 for a landmark without neighbours.
        neighbours: how many at most share the rest, in proportion to 1 / distance.
        reach_m: how far away they may be.

    Returns:
        (K, K) sparse matrix.

    Raises:
        ConfigError: an own weight outside (0, 1], a negative number of neighbours, or a reach that is not positive.
        InputError: arrays of different lengths, or a position that is not finite.
    """
    from scipy.sparse import csr_array

    if not 0.0 < own <= 1.0:
        raise ConfigError(f"must be above 0 and at most 1, not {own!r}", field="own")
    if neighbours < 0:
        raise ConfigError(f"must not be negative, not {neighbours!r}", field="neighbours")
    if not reach_m > 0.0:
        raise ConfigError(f"must be positive, not {reach_m!r}", field="reach_m")
    if np.ndim(landmark_m) != 2 or np.shape(clique) != np.shape(landmark_m)[:1]:
        raise InputError(f"shape {np.shape(clique)} for positions of {np.shape(landmark_m)}", field="clique")
    wrong = np.flatnonzero(~np.isfinite(landmark_m).all(axis=1))
    if wrong.size:
        raise InputError(f"row {wrong[0]}: a position that is not finite", field="landmark_m")

    order = np.argsort(clique, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(clique[order])) + 1)
    blocks = [_pairwise_block(landmark_m[rows], own, neighbours, reach_m) for rows in members]
    if not blocks:
        return csr_array((0, 0))
    value = np.concatenate([block.ravel() for block in blocks])
    row = np.concatenate([np.repeat(rows, len(rows)) for rows in members])
    column = np.concatenate([np.tile(rows, len(rows)) for rows in members])
    linked = value != 0.0
    return csr_array((value[linked], (row[linked], column[linked])), shape=(len(order), len(order)))


def _pairwise_block(point_m: FloatArray, own: float, neighbours: int, reach_m: float) -> FloatArray:
    """(M, M) the matrix of one clique."""
    distance = np.linalg.norm(point_m[:, None, :] - point_m[None, :, :], axis=2)
    np.fill_diagonal(distance, np.inf)
    rank = np.argsort(np.argsort(distance, axis=1, kind="stable"), axis=1)
    linked = (rank < neighbours) & (distance <= reach_m)
    closeness = np.where(linked, 1.0 / np.maximum(distance, TOUCHING_M), 0.0)
    total = closeness.sum(axis=1)
    own_weight = np.where(total > 0.0, own, 1.0)
    others = closeness * np.divide(1.0 - own_weight, total, where=total > 0.0, out=np.zeros_like(total))[:, None]
    solved = np.linalg.solve(np.eye(len(point_m)) - others, np.diag(own_weight))
    return np.maximum(solved, 0.0)  # elimination with pivots leaves -1e-17 where the answer is 0
