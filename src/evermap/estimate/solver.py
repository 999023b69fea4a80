"""One problem at one set of noise levels: linearised, solved, and with its covariances."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Generic

from evermap.estimate.gauss_newton import Minimum, Steps, minimise
from evermap.estimate.graph import Graph, Linear, State
from evermap.estimate.sparse.system import Factorised, Slices, exhaust


class Solver(ABC, Generic[State]):
    """What all estimators share; a subclass says which graph a problem is at given values."""

    def __init__(self) -> None:
        self._last: tuple[State, Linear] | None = None

    @abstractmethod
    def graph_in_slices(self, state: State) -> Slices[Graph[State]]:
        """Return the graph of the problem, of which all values in `state` that are finite are variables."""

    def graph(self, state: State) -> Graph[State]:
        """Return what `graph_in_slices` does."""
        return exhaust(self.graph_in_slices(state))

    def linearise_in_slices(self, state: State) -> Slices[Linear]:
        """Return the problem linearised at `state`; the last one is kept."""
        if self._last is not None and self._last[0] is state:
            return self._last[1]
        graph = yield from self.graph_in_slices(state)
        now = yield from graph.linearised(state)
        self._last = (state, now)
        return now

    def linearised(self, state: State) -> Linear:
        """Return what `linearise_in_slices` does."""
        return exhaust(self.linearise_in_slices(state))

    def minimise_in_slices(self, start: State, steps: Steps) -> Slices[Minimum[State]]:
        """Run damped Gauss-Newton from `start`, in slices: `gauss_newton.minimise`.

        Raises:
            NumericalError: no finite optimum.
        """
        graph = yield from self.graph_in_slices(start)
        now = yield from self.linearise_in_slices(start)
        solution = yield from minimise(graph, start, steps, now)
        self._last = (solution.state, solution.now)
        return solution

    def factorise_in_slices(self, state: State) -> Slices[Factorised]:
        """Return the normal equations at `state` with all but the border eliminated.

        Raises:
            NumericalError: the measurements do not determine a solution.
        """
        now = yield from self.linearise_in_slices(state)
        graph = yield from self.graph_in_slices(state)
        return (yield from graph.factorised(now))

    def cost(self, state: State) -> float:
        """Return the negative log posterior up to a constant."""
        return self.linearised(state).cost
