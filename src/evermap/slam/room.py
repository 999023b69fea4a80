"""Where a place is of which no map says anything: somewhere in a room, so that solutions with other places compare."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from evermap.estimate.graph import Graph, State
from evermap.estimate.sparse.elimination import numbers_of
from evermap.types import IntArray

ROOM_M, ROOM_RAD = 20.0, math.pi
"""Standard deviations of where it is, and of its turn."""
WITH_TURN = 6
"""Numbers of a place with an orientation: of its position, then of its turn; others have a position only."""


def hold_in_room(graph: Graph[State], place: IntArray) -> tuple[Graph[State], int, float]:
    """Return a graph with a prior of some places, in the plane or in space.

    Args:
        graph: the problem.
        place: which variables these are.

    Returns:
        The graph, how many numbers are held, and the log density of that at its peak, but for `log(2 pi) / 2` each.
    """
    begin, dim, held = graph.structure.system.tree.begin, graph.structure.layout.dim[place], graph.held.copy()
    turned = dim == WITH_TURN
    position = numbers_of(begin[place], np.where(turned, WITH_TURN // 2, dim))
    turn = numbers_of(begin[place[turned]] + WITH_TURN // 2, np.full(int(turned.sum()), WITH_TURN // 2))
    for at, sigma in ((position, ROOM_M), (turn, ROOM_RAD)):
        held[at] = np.maximum(held[at], sigma**-2)
    log_density = -len(position) * math.log(ROOM_M) - len(turn) * math.log(ROOM_RAD)
    return replace(graph, held=held), len(position) + len(turn), log_density
