"""One associator, in the plane and in space.

Frame by frame, a detection is assigned to a landmark only if no other explanation is nearly as probable; otherwise it
starts its own landmark, which can be merged later, after a solution of everything (`merging`). No decision is final: at
the end every detection is compared again with the whole map (`revise`), and duplicates are merged once more.

What depends on the group are the abstract methods, in `in_plane` and `in_space`: how landmarks are predicted, which
detections pass their gates, how an assignment is solved, and how far its landmarks differ. A solution is a value: a
trial, until something goes on from it.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

import numpy as np

from evermap.config import SlamConfig
from evermap.slam.association.assignment import NOBODY, same_name, visits_of
from evermap.slam.association.features import Traits, best_with_traits, learned
from evermap.slam.association.jcbb import Pairings, pairing_probability
from evermap.slam.association.merging import Solution, find_accepted_rise, merge_while_any, propose_merges
from evermap.slam.association.revise import LAST_ROUNDS
from evermap.types import BoolArray, FloatArray, IntArray

SLIPS = 3
"""Number of powers of `slam.association.slip` that are tried as the factor on the odometry noise: bounds the work."""
SAME_SHARE = 0.002
"""Share of detections that change their landmark in the last comparison with the whole map: a tolerance."""


class AnyAssignment(Protocol):
    """Detections, each of at most one landmark."""

    @property
    def landmark_row(self) -> IntArray:
        """(M,) landmark of each, `NOBODY` for none."""

    @property
    def traits(self) -> Traits:
        """Readings of the landmarks themselves."""

    @property
    def n_landmarks(self) -> int:
        """Number of landmarks."""


class AnySolution(AnyAssignment, Protocol):
    """The same at their optimum."""

    @property
    def cost(self) -> float:
        """Cost of the optimum [nats], with the evidence of traits."""

    @property
    def sightings(self) -> IntArray:
        """(L,) number of detections of each landmark."""

    @property
    def numbers(self) -> IntArray:
        """(L,) numbers that each landmark has: of a point as many as coordinates, of a pose six."""


AssignmentT = TypeVar("AssignmentT", bound=AnyAssignment)
FoundT = TypeVar("FoundT", bound=AnyAssignment)
SolvedT = TypeVar("SolvedT", bound=AnySolution)
NearT = TypeVar("NearT")


@dataclass(frozen=True, slots=True)
class FrameMatch:
    """Detections compared with the map: rows of `pairings` that are certain, p (n,) of each detection to be new, and
    the evidence over only new landmarks [nats].
    """

    pairings: Pairings
    certain: IntArray
    p_new: FloatArray
    evidence: float


class Associator(ABC, Generic[AssignmentT, FoundT, SolvedT, NearT]):
    """Feed frames in order with `step`, then `finish`.

    Args:
        stamp_s: (N,) of frames.
        pose_row: (M,) frame of every detection.
        kind: (M, 2) class and name of every detection, `UNKNOWN` for none: different ones exclude each other.
        near: landmarks near the robot before the first frame.
        density: of unmapped landmarks.
        traits: readings of the landmarks themselves; None if they give no evidence.
        settings: of the estimator.
    """

    has_own_noise: ClassVar[bool]
    """Whether a solution has the noise of its own residuals, not of the one before: then the same detections of the
    same landmarks have the same solution."""

    def __init__(
        self,
        stamp_s: FloatArray,
        pose_row: IntArray,
        kind: IntArray,
        near: NearT,
        density: float,
        traits: Traits | None,
        settings: SlamConfig,
    ) -> None:
        self._kind, self._settings, self._rules = kind, settings, settings.association
        self._traits = Traits.none(len(pose_row), settings) if traits is None else traits
        self.stamp_s, self._detected_s = stamp_s, stamp_s[pose_row]
        self._first = np.searchsorted(pose_row, np.arange(len(stamp_s) + 1))
        self._near, self._density = near, density
        self._done, self._doubted = 0, 0
        self._row: IntArray = np.full(len(pose_row), NOBODY, dtype=np.int64)
        self._of_kind: IntArray = np.zeros((0, 2), dtype=np.int64)
        self._seen_s = np.zeros(0)
        self._like = self._traits.nothing(0)

    def step(self) -> None:
        """Associate the next frame."""
        detections = np.arange(self._first[self._done], self._first[self._done + 1])
        for k, view in enumerate(self._views(detections)):
            match = self._match(self._near, view) if k or not self._done else self._after_driving(view)
            self._use(match, view)
        self._done += 1

    def _after_driving(self, view: IntArray) -> FrameMatch:
        """Compare the next frame with the map; if no landmark matches, again with the noise of slipping wheels."""
        before = self._near
        self._near = self._drive(before, 1.0)
        match = self._match(self._near, view)
        if len(match.certain):
            return match
        # did the wheels slip, or stamps jitter in a turn?
        for times in range(1, SLIPS + 1):
            slipped = self._drive(before, self._rules.slip**times)
            other = self._match(slipped, view)
            if len(other.certain) and other.evidence >= match.evidence + times * self._rules.slip_nats:
                self._near = slipped
                return other
        return match

    def _match(self, near: NearT, view: IntArray) -> FrameMatch:
        """Weigh the detections of a view against the landmarks nearby."""
        pairings, followed = self._gate(near, view)
        source, target = view[pairings.source], pairings.target
        new = pairings.log_density_new - self._rules.name_nats * same_name(self._kind[source], self._of_kind[target])
        new -= self._traits.same(self._traits.singly(source), self._like.part(target))
        pairings = replace(pairings, log_density_new=new)
        probability, evidence = pairing_probability(pairings, confidence=self._rules.gate_confidence)
        known = np.zeros(len(view))
        np.add.at(known, pairings.source, probability)
        certain = np.flatnonzero(self._certain(near, pairings, followed, probability, known))
        return FrameMatch(pairings, certain, 1.0 - known, evidence)

    def _use(self, match: FrameMatch, view: IntArray) -> None:
        """Update with the certain pairings, and start landmarks from detections without candidates."""
        now_s = self.stamp_s[self._done]
        known, target = view[match.pairings.source[match.certain]], match.pairings.target[match.certain]
        new = view[match.p_new >= self._rules.p_new]
        self._doubted += len(view) - len(known) - len(new)
        self._row[known], self._row[new] = target, len(self._of_kind) + np.arange(len(new))
        self._of_kind[target] = np.maximum(self._of_kind[target], self._kind[known])
        self._of_kind = np.vstack([self._of_kind, self._kind[new]])
        self._seen_s[target] = now_s
        self._seen_s = np.append(self._seen_s, np.full(len(new), now_s))
        seen = np.append(known, new)
        self._like = self._traits.followed(self._like, self._row[seen], seen)
        self._update(known, new)

    def finish(self, begun: FoundT | None = None, *, goal: float = math.inf) -> FoundT:
        """Solve and merge everything processed so far, and correct wrong associations.

        Args:
            begun: initial association of the same detections; None for that of `step`.
            goal: a cost, as of `against`; the search ends early if it cannot be reached.
        """
        refused: set[tuple[int, int]] = set()
        total = math.inf
        solved = self._realign(self._correct_visits(self._merge_duplicates(self._begun(begun)), refused))
        for left in reversed(range(LAST_ROUNDS)):
            before = solved
            again = self._reassign(before)
            if self.has_own_noise and np.array_equal(again.landmark_row, before.landmark_row):
                break
            solved = self._correct_visits(self._merge_duplicates(self._learned(again)), refused)
            if _are_same(before, again, solved):
                break
            if goal < math.inf:
                total, last = self._total(solved), total
                if total - left * (last - total) > goal:  # hopeless
                    break
        return self._result(solved)

    def against(self, found: FoundT) -> float:
        """Return the negative log likelihood [nats] of all detections under an association, up to a constant.

        Comparable between associations of one recording; `FoundT` as `finish` returns it, of this associator or another
        one of the same recording.
        """
        return self._total(self._judge(found))

    def of_visits(self, found: AnyAssignment) -> tuple[IntArray, IntArray]:
        """Return `visits_of` these landmarks."""
        row = found.landmark_row
        return visits_of(self._detected_s[: len(row)], row, self._rules.forget_s)

    def having(self, traits: Traits) -> Self:
        """Return a copy, with the same frames processed, that also uses traits."""
        other = copy.copy(self)
        other._traits = traits
        other._row, other._of_kind, other._seen_s = self._row.copy(), self._of_kind.copy(), self._seen_s.copy()
        return other

    @property
    def doubtful(self) -> float:
        """Share of the detections so far that were ambiguous between landmarks in their frame."""
        return self._doubted / max(int(self._first[self._done]), 1)

    def _merge_duplicates(
        self, solved: SolvedT, recent: int | None = None, *, within: tuple[int, int] | None = None
    ) -> SolvedT:
        """Merge duplicates while there are any.

        Args:
            solved: to begin with.
            recent: number of landmarks, those seen last, whose duplicates are searched; None for all.
            within: only landmarks from the first number on, except the second number of youngest ones.
        """

        def propose(solved: SolvedT, refused: set[tuple[int, int]]) -> list[tuple[int, int]]:
            solution = self._compared(solved)
            count = len(solution.place)
            among, known = _latest(solution, recent), np.ones(count, dtype=np.bool_)
            if within is not None:
                known = np.arange(count) < count - within[1]
                among = known & (np.arange(count) >= within[0])
            pairs = propose_merges(
                solution, probability=self._rules.p_merge, among=among, known=known, last=recent is None,
                refused=refused,
            )  # fmt: skip
            return pairs if pairs or within is not None else self._loose(solved, refused)

        def merge(solved: SolvedT, pairs: list[tuple[int, int]]) -> SolvedT | None:
            trial = self._solve_merged(solved, pairs)
            numbers = solved.numbers[[u for u, _ in pairs]]
            rise = find_accepted_rise(pairs, solved.sightings, numbers, self._rules)
            return trial if trial.cost - solved.cost <= rise else None

        return merge_while_any(solved, propose, merge)

    def _views(self, detections: IntArray) -> list[IntArray]:
        """Detections of a frame, those of each sensor by themselves."""
        return [detections]

    @abstractmethod
    def _drive(self, near: NearT, times: float) -> NearT:
        """The landmarks nearby after the motion to the next frame, with a multiple of the odometry noise."""

    @abstractmethod
    def _gate(self, near: NearT, view: IntArray) -> tuple[Pairings, BoolArray]:
        """The detections of a view, paired with the landmarks whose gates they pass, by place; and (K,) whether these
        are tracked: known relative to the robot as well as they are measured.
        """

    @abstractmethod
    def _certain(
        self, near: NearT, pairings: Pairings, followed: BoolArray, probability: FloatArray, known: FloatArray
    ) -> BoolArray:
        """(K,) pairings to be used, by their probability and (n,) that of any pairing of each detection."""

    @abstractmethod
    def _update(self, known: IntArray, new: IntArray) -> None:
        """Update the landmarks nearby with detections of known landmarks, and of new ones."""

    @abstractmethod
    def _begun(self, begun: FoundT | None) -> SolvedT:
        """The optimum of an association; None for that of `step`."""

    @abstractmethod
    def _reassign(self, solved: SolvedT) -> AssignmentT:
        """Every detection with its most probable landmark, with overlooked landmarks, without those seen too seldom."""

    @abstractmethod
    def _learned(self, assignment: AssignmentT) -> SolvedT:
        """The optimum of an assignment as `_reassign` returns it, and the noise there."""

    @abstractmethod
    def _solve_merged(self, solved: SolvedT, pairs: list[tuple[int, int]]) -> SolvedT:
        """The optimum with pairs (younger, older) of landmarks merged."""

    @abstractmethod
    def _compared(self, solved: SolvedT) -> Solution:
        """The landmarks, for `propose_merges`."""

    @abstractmethod
    def _result(self, solved: SolvedT) -> FoundT:
        """The result of a search."""

    @abstractmethod
    def _judge(self, found: FoundT) -> SolvedT:
        """The optimum of an association by the noise with which all of this associator are judged."""

    @abstractmethod
    def _total(self, solved: SolvedT) -> float:
        """`against` under the noise of the solution."""

    @abstractmethod
    def _loose(self, solved: SolvedT, refused: set[tuple[int, int]]) -> list[tuple[int, int]]:
        """Pairs (younger, older) by which a loose part of the map certainly fits to the rest."""

    @abstractmethod
    def _correct_visits(self, solved: SolvedT, refused: set[tuple[int, int]]) -> SolvedT:
        """Separate landmarks that are two, where this is better; what was tried without gain is in `refused`."""

    @abstractmethod
    def _realign(self, solved: SolvedT) -> SolvedT:
        """Move what is displaced, where this is better."""


_AnyAssociator = TypeVar("_AnyAssociator", bound=Associator[Any, Any, Any, Any])


def with_traits(
    first: tuple[_AnyAssociator, FoundT],
    features: FloatArray,
    settings: SlamConfig,
    found: Callable[[Traits], tuple[_AnyAssociator, FoundT]],
) -> tuple[_AnyAssociator, FoundT]:
    """Return `best_with_traits` of detections with features (M, D).

    Args:
        first: an associator with its result, without traits.
        features: (M, D) readings, nan for none.
        settings: of the estimator.
        found: returns another associator with its result, from the first frame on with given traits.
    """
    nothing = first[1].traits

    def explain(
        best: tuple[_AnyAssociator, FoundT], trial: tuple[_AnyAssociator, FoundT]
    ) -> tuple[float, Traits | None]:
        own = learned(features, *trial[0].of_visits(trial[1]), settings=settings)
        return best[0].against(replace(trial[1], traits=own or nothing)), own  # type: ignore[type-var]

    def again(best: tuple[_AnyAssociator, FoundT], traits: Traits) -> tuple[_AnyAssociator, FoundT]:
        known = replace(best[1], traits=traits)  # type: ignore[type-var]
        if traits.evidence(*best[0].of_visits(known)) > 0.0:
            other = best[0].having(traits)
            return other, other.finish(known)
        return found(traits)  # most of it is wrong

    within_visits = learned(features, *first[0].of_visits(first[1]), revisits=False, settings=settings)
    return best_with_traits(first, within_visits, explain, again)


def _latest(solution: Solution, count: int | None) -> BoolArray:
    """(L,) the landmarks with sightings enough to pair that were seen last; None for all."""
    last = np.where(solution.sightings >= solution.settings.fewest_to_pair, solution.last_seen_s, -np.inf)
    if count is None or count >= len(last):
        return np.ones(len(last), dtype=np.bool_)
    return np.asarray(last >= np.partition(last, -count)[-count])


def _are_same(before: AnyAssignment, again: AnyAssignment, solved: AnyAssignment) -> bool:
    """Whether a comparison with the whole map left the landmarks, and nearly all detections, as they were before."""
    changed = np.mean(_partners(before.landmark_row) != _partners(again.landmark_row))
    least = min(before.n_landmarks, again.n_landmarks)
    return bool(changed <= SAME_SHARE and solved.n_landmarks == before.n_landmarks == least)


def _partners(row: IntArray) -> IntArray:
    """(M,) the first detection of the same landmark; -1 if unassigned."""
    first = np.full(len(row), -1)
    seen = np.flatnonzero(row >= 0)
    _, at, of = np.unique(row[seen], return_index=True, return_inverse=True)
    first[seen] = seen[at][of]
    return first
