"""A chain of phases in a robot: `init`, `predict`, `update`, pure functions on many features at once.

As `evermap.existence.single`, with a row of phase probabilities for every feature in the place of one number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.existence import checks
from evermap.existence.phase_type import PhaseType
from evermap.existence.protocol import Instants, Looks
from evermap.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class PhaseBelief:
    """Presence of N features, one row each.

    Attributes:
        model: how they come and go.
        phases: (N, n) probability of each phase at `stamp_s`.
        stamp_s: (N,) time of the last look, or of `init`.
        log_evidence: (N,) `log p(looks)` so far.
    """

    model: PhaseType
    phases: FloatArray
    stamp_s: FloatArray
    log_evidence: FloatArray

    def __len__(self) -> int:
        return len(self.stamp_s)

    @property
    def probability(self) -> FloatArray:
        """(N,) probability of presence at `stamp_s`."""
        return _presence(self.model, self.phases)


def init(n: int, model: PhaseType, stamp_s: Any) -> PhaseBelief:
    """Beliefs in `n` features before their first look: the model's start, or its long run at this time.

    Args:
        n: number of features.
        model: how they come and go.
        stamp_s: scalar or (n,), when.

    Raises:
        InputError: a time that is not finite.
    """
    time = checks.as_rows(stamp_s, n, "stamp_s")
    checks.check_times(time, np.full(n, -np.inf))
    if model.start is not None:
        phases = np.tile(model.start, (n, 1))
    else:
        instants, which = np.unique(time, return_inverse=True)
        phases = np.array([model.stationary(float(t)) for t in instants]).reshape(-1, model.n_phases)[which]
    return PhaseBelief(model, phases, time, np.zeros(n))


def after(model: PhaseType, looks: Looks) -> PhaseBelief:
    """Beliefs after all looks, one row a feature; what was never looked at is heard of at the last look of all.

    Args:
        model: how features come and go.
        looks: at F features.

    Raises:
        InputError: no look at all.
        NumericalError: a look that is impossible, whether the feature is there or not.
    """
    if not len(looks.stamp_s):
        raise InputError("there is no look", field="looks", hint="init(), which needs none")
    # asked at the last look: presence is not wanted, but it is where a feature without looks begins
    stamp_s = np.full(looks.n_features, looks.stamp_s.max())
    looked = np.diff(looks.first) > 0
    stamp_s[looked] = looks.stamp_s[looks.first[1:][looked] - 1]
    _, evidence, phases = model.filtered(looks, Instants(np.arange(looks.n_features + 1), stamp_s))
    return PhaseBelief(model, phases, stamp_s, evidence)


def predict(state: PhaseBelief, stamp_s: Any, *, rows: Any = None) -> FloatArray:
    """Probability that each feature is there at `stamp_s`; the state stays as it is.

    Args:
        state: beliefs in N features.
        stamp_s: scalar or (N,) or (len(rows),), not before the row's last look.
        rows: row numbers asked about; all where None.

    Raises:
        InputError: a time that is not finite or lies before the last look.
    """
    index = np.arange(len(state)) if rows is None else checks.check_rows(rows, len(state), twice=True)
    return _presence(state.model, _at(state, index, checks.as_rows(stamp_s, len(index), "stamp_s")))


def update(
    state: PhaseBelief, stamp_s: Any, detected: Any, p_miss: Any, p_false: Any, *, rows: Any = None
) -> PhaseBelief:
    """Beliefs after one look at each feature.

    Args:
        state: beliefs in N features.
        stamp_s: scalar, (N,) or (len(rows),) times of the looks.
        detected: 1 or 0, of the same shape.
        p_miss: `P(no detection | there)`, of the same shape.
        p_false: `P(detection | not there)`, of the same shape.
        rows: the rows looked at, each once; all where None.

    Raises:
        InputError: a probability outside [0, 1], time running back, or a row that does not exist.
        DataError: a row twice.
        NumericalError: a look that is impossible, whether the feature is there or not.
    """
    index = np.arange(len(state)) if rows is None else checks.check_rows(rows, len(state))
    time, there, gone = checks.as_looks(stamp_s, detected, p_miss, p_false, state.stamp_s[index], index)
    weighed = _at(state, index, time) * np.where(state.model.present, there[:, None], gone[:, None])
    likelihood = weighed.sum(1)
    checks.check_possible(np.where(likelihood > 0.0, likelihood, np.nan), index)

    phases, stamps, evidence = state.phases.copy(), state.stamp_s.copy(), state.log_evidence.copy()
    phases[index] = weighed / likelihood[:, None]
    stamps[index] = time
    evidence[index] += np.log(likelihood)
    return replace(state, phases=phases, stamp_s=stamps, log_evidence=evidence)


def _at(state: PhaseBelief, index: IntArray, time: FloatArray) -> FloatArray:
    """(K, n) phases of some rows at a later time."""
    from evermap.existence.phase_kernels import travel_rows

    checks.check_times(time, state.stamp_s[index], index)
    phases = state.phases[index]
    travel_rows(phases, state.model.chain, state.stamp_s[index], time)
    return phases


def _presence(model: PhaseType, phases: FloatArray) -> FloatArray:
    """Probability of presence of (K, n) phases."""
    return np.asarray(np.minimum(phases[:, model.present].sum(1), 1.0), dtype=np.float64)
