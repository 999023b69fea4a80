"""What all estimators share: a problem is linearised once at the same values."""

from __future__ import annotations

from evermap.estimate.solver import Solver
from evermap.estimate.sparse.system import exhaust


class Counted:
    """A graph that counts how often it is linearised."""

    def __init__(self) -> None:
        self.asked: list[object] = []

    def linearised(self, state: object):
        self.asked.append(state)
        yield 1.0
        return ("linear", state)


class Estimator(Solver):
    def __init__(self) -> None:
        super().__init__()
        self.one = Counted()

    def graph_in_slices(self, state: object):
        yield 0.5
        return self.one


def test_the_last_values_are_linearised_once() -> None:
    """The same object, not an equal one: values are arrays."""
    estimator, state, other = Estimator(), [1.0], [1.0]
    assert estimator.graph(state) is estimator.one
    first = estimator.linearised(state)
    assert first == ("linear", state)
    assert estimator.linearised(state) is first
    assert list(estimator.linearise_in_slices(state)) == []
    assert len(estimator.one.asked) == 1
    assert estimator.linearised(other)[1] is other
    assert list(estimator.linearise_in_slices(state)) == [0.5, 1.0]
    assert [one is state for one in estimator.one.asked] == [True, False, True]
    assert exhaust(estimator.linearise_in_slices(state))[1] is state
