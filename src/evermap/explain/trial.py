"""A trial of the competition: a session solved under some causes, its evidence, and the best state of the last one."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Generic, Protocol, TypeAlias, TypeVar

import numpy as np

from evermap.errors import EvermapError
from evermap.explain.causes.suspect import Inputs, Suspect
from evermap.explain.evidence import (
    LOG_2PI,
    AnySession,
    Score,
    evidence_at,
    list_used_rows,
    price_changes,
    price_scales,
    weigh_levels,
)
from evermap.explain.linearise import change_by
from evermap.explain.scores import ScreenedSession, score_session, weigh_usual
from evermap.slam.estimate import Solved
from evermap.slam.room import ROOM_M
from evermap.types import Cause, SlamResult

VisitT = TypeVar("VisitT")
NEAR = 2.0
"""Standard deviations within which a state is refined no further."""
SHORTER = 0.5
"""Share of the step before from which a step towards the best state is no shorter: as those of Newton are nearby."""
INLIER, FEWER = 0.5, 0.7
"""Probability from which a detection is no outlier, and share of the outliers that a cause must leave at most."""
OF_NOISE = "_noise_factor", "sigma_corner_px"
"""Ends of the names of noise levels."""
ROUNDING = 1e-6
"""Difference of log evidences that is rounding [nats]."""
IGNORED, HEARD, IGNORED_NATS = 10.0, 3.0, 100.0
"""Noise over what is stated from which a sensor is ignored, up to which it is not, and what that is worth [nats]."""


@dataclass(frozen=True)
class SessionSolution(Generic[VisitT]):
    """What a solution of some inputs consists of."""

    visit: VisitT
    asked: ScreenedSession
    result: SlamResult

    @property
    def session(self) -> AnySession:
        """Return what was solved."""
        return self.asked.session

    @property
    def inputs(self) -> Inputs:
        """Return what it is the solution of."""
        return self.asked.inputs


@dataclass(frozen=True)
class Taken:
    """A cause that was taken, with its state, and the information on that where it was asked."""

    suspect: Suspect
    state: float
    information: float = math.nan


@dataclass(frozen=True)
class Trial(Generic[VisitT]):
    """A solution under some causes.

    Attributes:
        solution: of the inputs without what the causes did.
        taken: the causes.
        evidence: log evidence of the measurements as given, with the prices of all causes and changes.
        worth: share of what the measurements say that is new.
        noise: largest level of the noise of detections, over what is stated of it.
        log_scales: log prior density of the scales that it found by itself, which no errors that last make less.
    """

    solution: SessionSolution[VisitT]
    taken: tuple[Taken, ...]
    evidence: float
    worth: float
    noise: float = 1.0
    log_scales: float = 0.0

    @property
    def inputs(self) -> Inputs:
        """Return the inputs without what the causes did."""
        return self.solution.inputs

    def beats(self, other: Trial[VisitT]) -> float:
        """Return by how much the evidence is larger, as far as measurements are independent [nats].

        A solution that ignores a sensor explains nothing of it: one that does not wins.
        """
        own, others = (sum(one.suspect.log_p for one in trial.taken) + trial.log_scales for trial in (self, other))
        price = own - others
        if max(self.noise, other.noise) > IGNORED and min(self.noise, other.noise) < HEARD:
            return (IGNORED_NATS if self.noise < other.noise else -IGNORED_NATS) + price
        return (self.evidence - other.evidence - price) * min(self.worth, other.worth) + price

    def is_better(self, other: Trial[VisitT]) -> bool:
        """Return whether the evidence is larger. Of two that explain all readings alike, as a map that is mirrored and
        angles that are clockwise do, the one of the map counts: without it the session contradicts nothing.
        """
        lead = self.beats(other)
        if abs(lead) > ROUNDING:
            return lead > 0.0
        return any(one.suspect.of_map for one in self.taken) and not any(one.suspect.of_map for one in other.taken)

    @cached_property
    def gain_left(self) -> float:
        """What the calibration that earns most would gain yet, of those that move the poses [nats]."""
        return find_score(self.solution)


@dataclass(frozen=True)
class Explained(Generic[VisitT]):
    """The end of a competition.

    Attributes:
        best: the trial that won.
        causes: of it, the most probable first.
        weighed: trials that were solved.
    """

    best: Trial[VisitT]
    causes: tuple[Cause, ...]
    weighed: tuple[Trial[VisitT], ...] = field(default=())


class Solve(Protocol[VisitT]):
    """Solves inputs; `known` is their solution in the plane, where there is one."""

    def __call__(self, inputs: Inputs, known: Solved | None = None, /) -> SessionSolution[VisitT]: ...


Asked: TypeAlias = list[tuple[float, Suspect, float]]
"""Causes with what they gain [nats] and the state that is tried first."""


def find_score(solution: SessionSolution[VisitT]) -> float:
    """Return what the calibration that earns most would gain, of those that move the poses [nats]; 0 without."""
    scores = score_session(solution.asked, solution.result.trajectory)
    return max((one.gain for one in scores.harmful), default=0.0)


@dataclass
class Budget:
    """Solutions that may still be made."""

    left: int


def share_rejected(result: SlamResult) -> float:
    """Return the share of the detections that are outliers."""
    outlier = result.innovations.p_inlier < INLIER
    return float(np.mean(outlier)) if len(outlier) else 0.0


def count_changed(result: SlamResult) -> int:
    """Return the number of landmarks that are told to have changed."""
    return len({one for change in result.changes for one in change.landmark_ids})


def solve_trial(
    inputs: Inputs,
    taken: tuple[Taken, ...],
    suspect: Suspect,
    state: float,
    solve_under: Solve[VisitT],
    budget: Budget,
) -> Trial[VisitT] | None:
    """Return the solution without what one more cause did; None if nothing can be estimated, or none may be made."""
    if budget.left <= 0:
        return None
    budget.left -= 1
    try:
        return weigh_solution(solve_under(suspect.undo(inputs, state)), (*taken, Taken(suspect, state)))
    except EvermapError:  # nothing can be estimated under it
        return None


def refine(
    trial: Trial[VisitT],
    before: Inputs,
    taken: tuple[Taken, ...],
    solve_under: Solve[VisitT],
    budget: Budget,
) -> Trial[VisitT]:
    """Return the trial with the state of its last cause at its optimum, and the information on it.

    A step is asked with the map as given, and with what the solution let go of it: what is off by much is an outlier of
    the one, and what changes explain does not show in the other. That which knows more of the state is tried.
    """
    asked, stretch = 0.0, 1.0
    while trial.taken[-1].suspect.is_continuous:
        step = _find_step(trial, before)
        if step is None:
            break
        last = replace(trial.taken[-1], information=step.information)
        trial = _with_last(trial, last)
        # a step that is no shorter than the one before says that what is rejected yet hides how far it is
        longer = step.value * asked > SHORTER * asked**2
        suspect, nearer = last.suspect, None
        for length in (2.0 * stretch, 1.0) if longer else (1.0,):
            by = float(np.clip(length * step.value, -suspect.sigma, suspect.sigma))
            if abs(by) * math.sqrt(step.information) < NEAR * 0.5:
                continue
            there = solve_trial(before, taken, suspect, last.state + by, solve_under, budget)
            if there is None:
                continue
            there = _with_last(there, replace(there.taken[-1], information=step.information))
            if there.evidence > trial.evidence:
                nearer, asked, stretch = there, step.value, length
                break
        if nearer is None:
            break
        trial = nearer
    return trial


def with_information(trial: Trial[VisitT], before: Inputs) -> Trial[VisitT]:
    """Return the trial with the information on the state of its last cause, which is the price of that; as it is where
    it was asked, or can't be.
    """
    last = trial.taken[-1]
    if not last.suspect.is_continuous or math.isfinite(last.information):
        return trial
    step = _find_step(trial, before)
    return trial if step is None else _with_last(trial, replace(last, information=step.information))


def _find_step(trial: Trial[VisitT], before: Inputs) -> Score | None:
    """Return what the state of the last cause of a trial does with the map as given, or with what was let go of it:
    of either, what knows more of it; None if it changes what is used.
    """
    last, own = trial.taken[-1], trial.solution.asked
    known, found = last.suspect.sigma**-2, list[Score]()
    for asked in (own,) if own.held is own else (own.held, own):
        screen = asked.screen
        direction = change_by(asked.session, screen, trial.inputs, last.suspect, given=before, state=last.state)
        if direction is not None:
            score = screen.score(direction, known, last.state)
            found.append(score._replace(information=known + (score.information - known) * screen.optimum.worth))
    return max(found, key=lambda score: score.information, default=None)


def _with_last(trial: Trial[VisitT], last: Taken) -> Trial[VisitT]:
    """Return the trial with its last cause known better, and the evidence with the state integrated out."""
    before = trial.taken[-1]
    change = _state_evidence(last) - _state_evidence(before)
    return replace(trial, taken=(*trial.taken[:-1], last), evidence=trial.evidence + change)


def _state_evidence(taken: Taken) -> float:
    """Log prior density of a state, times the volume that it is left; its price alone where it is discrete."""
    suspect = taken.suspect
    if not suspect.is_continuous:
        return suspect.log_p
    information = taken.information if math.isfinite(taken.information) else suspect.sigma**-2
    return (
        suspect.log_p
        - 0.5 * (taken.state / suspect.sigma) ** 2
        - 0.5 * math.log(max(information * suspect.sigma**2, 1.0))
    )


def weigh_solution(solution: SessionSolution[VisitT], taken: tuple[Taken, ...]) -> Trial[VisitT]:
    """Return the trial of a solution: the log evidence of what was measured, as given, with the prices of causes."""
    session, inputs, optimum = solution.session, solution.inputs, solution.asked.screen.optimum
    used = list_used_rows(session)
    if isinstance(session, Solved):
        places = 0
        if session.outcome.aligned and session.prepared.prior_map is not None:
            places = int(session.prepared.prior_map.given.sum())
    else:
        places = len(session.solved.optimum.smoother.problem.prior.place)
    volume = float(inputs.stretched[used].sum()) + inputs.stretched_place * places
    left_out = len(inputs.stretched) - len(used)
    seen = optimum.detections
    outlier = float(np.mean(np.where(np.isfinite(seen.log_odds), seen.log_nominal - seen.log_odds, 0.0)))
    prices = price_changes(session, solution.result.changes)
    evidence = evidence_at(optimum, prices) + volume + left_out * outlier
    # a map that what was seen lies nowhere on has its places anywhere
    anywhere = inputs.left_out if solution.result.trajectory.frame == "prior_map" else inputs.left_out + inputs.n_common
    evidence -= anywhere * inputs.recording.dim * (math.log(ROOM_M) + 0.5 * LOG_2PI)
    noise = max((one.value for one in solution.result.parameters if one.name.endswith(OF_NOISE[0])), default=1.0)
    meant, found = price_scales(optimum)
    evidence += meant - found + weigh_usual(solution.asked) + weigh_levels(session) + sum(map(_state_evidence, taken))
    return Trial(solution, taken, evidence, optimum.worth, noise, meant)
