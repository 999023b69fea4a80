"""Damped Gauss-Newton on a graph, whole or in slices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, NamedTuple

import numpy as np

from evermap.errors import NumericalError
from evermap.estimate.graph import Graph, Linear, State
from evermap.estimate.sparse.system import Factorised, Slices

MOST_DAMPED = 1e6
"""Damping at which no step is short enough."""


class Steps(NamedTuple):
    """Rules of the iteration.

    Attributes:
        most: steps, at most.
        tolerance: a step that moves nothing by so much (m, rad, or a calibration state's unit) is the last.
        settled: an undamped step that gains less is the last [nats].
        slack: rise of the cost that a step may bring [nats], since weights change with the residuals.
        relative_slack: the same as a share of the cost.
        first_damping: damping with which a step is tried again.
        wanted: cost that is of use: it ends where no more steps, each as good as the last, would come below.
    """

    most: int = 30
    tolerance: float = 1e-6
    settled: float = 0.0
    slack: float = 0.5
    relative_slack: float = 0.0
    first_damping: float = 1e-6
    wanted: float = np.inf


@dataclass(frozen=True, slots=True)
class Minimum(Generic[State]):
    """The end of an iteration.

    Attributes:
        state: values of all variables.
        now: the graph, linearised there.
        factorised: the normal equations of the last step, undamped; None where that was damped.
    """

    state: State
    now: Linear
    factorised: Factorised | None


def minimise(graph: Graph[State], start: State, steps: Steps, now: Linear | None = None) -> Slices[Minimum[State]]:
    """Run damped Gauss-Newton from `start`, in slices.

    Args:
        graph: what is minimised.
        start: values to start from.
        steps: rules.
        now: the graph linearised at the start, where that is known.

    Raises:
        NumericalError: no finite optimum.
    """
    state, damping = start, 0.0
    undamped: Factorised | None = None
    if now is None:
        now = yield from graph.linearised(state)
    for left in reversed(range(steps.most)):
        solved = yield from graph.factorised(now, damping)
        step = yield from solved.solution()
        trial, size = graph.retract(state, step)
        following = yield from graph.linearised(trial)
        if damping == 0.0:
            undamped = solved
        slack = steps.slack + steps.relative_slack * (1.0 + abs(now.cost))
        if np.isfinite(following.cost) and following.cost <= now.cost + slack:
            gain = now.cost - following.cost
            state, now = trial, following
            if damping > 0.0:
                undamped = None
            if size < steps.tolerance or (damping == 0.0 and abs(gain) < steps.settled):
                break
            if now.cost - left * gain > steps.wanted:
                break
            damping = 0.0 if damping < steps.first_damping else damping / 10.0
        else:
            damping = max(steps.first_damping, 10.0 * damping)
            if damping > MOST_DAMPED:
                break
    if not np.isfinite(now.cost):
        raise NumericalError("the smoother found no finite optimum", hint="check units and time stamps")
    return Minimum(state, now, undamped)
