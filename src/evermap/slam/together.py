"""Several robots that drove at the same time, as one problem: a concatenation of their blocks, in plane and space.

Each is solved alone first. Then their frames are aligned by landmarks with the same id (`align_frames`), a landmark
that several saw becomes one place (`share_places`), and all is one graph (`Together`), solved in turns with the noise
levels of each (`settle`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import numpy as np

from evermap.align.acceptance import SIGMA_M, accept_alignment
from evermap.align.candidates import Matches
from evermap.config import LocalizeConfig
from evermap.errors import DataError
from evermap.estimate.gauss_newton import Minimum, Steps
from evermap.estimate.graph import (
    Border,
    FactorBlock,
    Graph,
    GraphStructure,
    Layout,
    State,
    build_structure,
    concatenate_blocks,
    concatenate_groups,
)
from evermap.estimate.solver import Solver
from evermap.estimate.sparse.system import Slices, exhaust
from evermap.slam.smoother import HELD
from evermap.types import BoolArray, FloatArray, IntArray

MEASURED = 2
"""Blocks of a robot of which all robots' come first, kind by kind: odometry and detections."""


class SharedPoints(NamedTuple):
    """What a robot has in common with others whose frames are known.

    Attributes:
        matches: its points, or poses, and where the others have them in the frame of all.
        source_m2: (D K, D K) covariance of the former, in its own frame.
        covariance_m2: (D K, D K) of the latter, in the frame of all.
    """

    matches: Matches
    source_m2: FloatArray
    covariance_m2: FloatArray


class Together(Solver[State]):
    """Several problems that share places, as one graph.

    Its variables are the poses, one robot after the other; the places that are known; and, in the border, the
    calibration of all. A subclass says what depends on the dimension: the blocks of each robot, its values among those
    of all, and what a step does.

    Args:
        n_poses: of each robot.
        places: (P_r,) of each robot, which of all places its own are.
        calibration: of each robot, which variables of the border its own are.
        poses_a_leaf: consecutive poses that are eliminated together.
    """

    def __init__(
        self, n_poses: Sequence[int], places: Sequence[IntArray], calibration: Sequence[IntArray], *, poses_a_leaf: int
    ) -> None:
        super().__init__()
        self.places, self.calibration = tuple(places), tuple(calibration)
        self.first = np.cumsum([0, *n_poses])
        """(R + 1,) first pose of each robot, and how many there are."""
        self._leaf = concatenate_groups(list(n_poses), poses_a_leaf)
        self._structure: tuple[BoolArray, GraphStructure] | None = None

    def variables(self, known: BoolArray) -> list[IntArray]:
        """Return of each robot which of all variables its own are, where places (P,) are `known`."""
        n, rank = int(self.first[-1]), np.cumsum(known) - 1
        border = n + int(np.count_nonzero(known))
        return [
            np.concatenate([np.arange(begin, end), n + rank[places[known[places]]], border + calibration])
            for (begin, end), places, calibration in zip(
                pairwise(self.first.tolist()), self.places, self.calibration, strict=True
            )
        ]

    def graph_in_slices(self, state: State) -> Slices[Graph[State]]:
        """Return all robots as one graph: odometry of each, detections of each, what ties robots, and all else."""
        known, n = self._find_known(state), int(self.first[-1])
        variable = self.variables(known)
        blocks = concatenate_blocks(
            self._blocks(state),
            variable,
            self.first.tolist(),
            [partial(self.own, robot=r) for r in range(len(self.places))],
            measured=MEASURED,
            between=self._between(variable),
        )
        if self._structure is None or not np.array_equal(self._structure[0], known):
            pose, place, border = self._dims()
            dim = np.concatenate([np.full(n, pose), place[known], border])
            last = np.arange(len(dim) - len(border), len(dim))
            structure = yield from build_structure(Layout(dim, last, self._leaf, self._coordinate(state)), blocks)
            self._structure = known, structure
        structure = self._structure[1]
        begin = structure.system.tree.begin
        held = np.zeros(begin[-1])
        held[begin[n] : begin[n + int(np.count_nonzero(known))]] = HELD
        self._hold(held, begin, variable)
        return Graph(blocks, structure, self._border(), held, self._retract)

    @abstractmethod
    def own(self, state: State, robot: int) -> Any:
        """Return the values of a robot."""

    @abstractmethod
    def _find_known(self, state: State) -> BoolArray:
        """Return which of all places (P,) have values."""

    @abstractmethod
    def _dims(self) -> tuple[int, IntArray, IntArray]:
        """Return how many numbers a pose has, each place (P,), and each variable of the border."""

    @abstractmethod
    def _coordinate(self, state: State) -> FloatArray:
        """Return (N, c) coordinates of the poses, the first an order in time."""

    @abstractmethod
    def _blocks(self, state: State) -> Sequence[Sequence[FactorBlock[Any]]]:
        """Return the blocks of each robot."""

    def _between(self, variable: Sequence[IntArray]) -> Sequence[FactorBlock[State]]:  # noqa: ARG002
        """Return blocks that tie robots, whose variables are among all."""
        return ()

    def _hold(self, held: FloatArray, begin: IntArray, variable: Sequence[IntArray]) -> None:
        """Write what else is held to the numbers of all variables, which begin there (V,)."""

    @abstractmethod
    def _border(self) -> Border[State]:
        """Return the prior of the calibration of all."""

    @abstractmethod
    def _retract(self, state: State, step: FloatArray) -> tuple[State, float]:
        """Return the values after a step, and how far it went."""


TogetherT = TypeVar("TogetherT", bound=Together[Any])


def settle(
    joint: TogetherT,
    state: State,
    learn: Callable[[TogetherT, Minimum[State], int], tuple[TogetherT, bool]],
    steps: Sequence[Steps],
) -> tuple[TogetherT, State]:
    """Return robots with their noise levels, and their values, in turns until neither changes.

    Args:
        joint: robots with the levels to start from.
        state: values to start from.
        learn: returns the robots with levels by a solution, of a round, and whether these are the last.
        steps: of each round, as many as there are at most.

    Raises:
        NumericalError: no finite optimum.
    """
    for round_, rules in enumerate(steps):
        solution = exhaust(joint.minimise_in_slices(state, rules))
        state = solution.state
        joint, is_settled = learn(joint, solution, round_)
        if is_settled:
            break
    return joint, state


def align_frames(
    motion: FloatArray,
    tie: Callable[[int, Sequence[int], FloatArray], SharedPoints],
    names: Sequence[str],
    hint: str,
    rules: LocalizeConfig,
) -> FloatArray:
    """Return the motions (R, 3), in space (R, 7), of each robot's frame into that of the first one.

    One after the other is laid over all that are, the surest one first.

    Args:
        motion: identities, as many as robots.
        tie: what a robot has in common with others that are placed, by these motions.
        names: what robots are called in messages.
        hint: what would tie them, in words.
        rules: when an alignment is certain.

    Raises:
        DataError: nothing ties one of them to the others.
    """
    motion, placed = motion.copy(), {0}
    while len(placed) < len(motion):
        best, found, reason = -np.inf, None, "no common landmarks"
        for b in set(range(len(motion))) - placed:
            ties = tie(b, sorted(placed), motion)
            known = ties.covariance_m2 + SIGMA_M**2 * np.eye(len(ties.covariance_m2))
            laid = accept_alignment(ties.matches, rules, covariance_m2=known, source_m2=ties.source_m2)
            if laid and laid.log_odds > best:
                best, found = laid.log_odds, (b, laid.motion)
            reason = laid.reason if len(laid.agree) else reason
        if found is None:
            lost = ", ".join(names[b] for b in range(len(motion)) if b not in placed)
            raise DataError(f"nothing connects {lost} to {names[0]}: {reason}", hint=hint)
        motion[found[0]] = found[1]
        placed.add(found[0])
    return motion


def share_places(identity: Sequence[IntArray]) -> tuple[list[IntArray], int]:
    """Return the common place (P_r,) of each place of each robot, and how many there are.

    Args:
        identity: (P_r,) of each robot, the ids of its places: one place for all that have it; -1 of those that are its
            own, which come after these.
    """
    stay = np.unique(np.concatenate([own[own >= 0] for own in identity]))
    places, count = [], len(stay)
    for own in identity:
        rows = np.searchsorted(stay, own)
        alone = np.flatnonzero(own < 0)
        rows[alone] = count + np.arange(len(alone))
        count += len(alone)
        places.append(rows)
    return places, count
