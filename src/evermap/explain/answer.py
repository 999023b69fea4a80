"""The answer of the competition: causes with probabilities, and the result in the units that were given."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from evermap.explain.trial import Taken, Trial, VisitT
from evermap.explain.triggers import OF_LANDMARKS
from evermap.types import Cause, ChangeKind, MapChange, ParameterEstimate, SlamResult, is_in_space

CLOCK = "clock"
"""Cause of stamps that are late."""
LIKELIEST = 50.0
"""Log odds beyond which no probability changes [nats]."""


def find_ratio(state: ParameterEstimate) -> float:
    """Return a scale as a ratio: the slope of ranges is less one."""
    return state.value + (1.0 if state.name == "range_slope" else 0.0)


OWN_STATES = {
    "odometry-scale": (("odometry_forward_scale", 1.0), ("odometry_scale", 1.0)),
    "turn-scale": (("odometry_turn_scale", 1.0),),
    "range-scale": (("range_scale", -1.0), ("range_slope", -1.0)),
}
"""Calibration states that are the same number as a cause's, and the sign with which their logarithms add to it."""


def in_given_units(trial: Trial[VisitT]) -> SlamResult:
    """Return the result of a trial, its calibration states as they are of the recording that was given."""
    late = [one for one in trial.taken if one.suspect.code == CLOCK and not is_in_space(trial.inputs.recording)]
    factor = {
        name: math.exp(sign * one.state) for one in trial.taken for name, sign in OWN_STATES.get(one.suspect.code, ())
    }
    states = [
        replace(
            state, value=state.value + (factor[state.name] - 1.0) * find_ratio(state),
            sigma=state.sigma * factor[state.name],
        )
        if state.name in factor
        else _with_delay(state, late) if late and state.name == "odometry_delay_s" else state
        for state in trial.solution.result.parameters
    ]  # fmt: skip
    return replace(trial.solution.result, parameters=tuple(states))


def _with_delay(delay: ParameterEstimate, late: Sequence[Taken]) -> ParameterEstimate:
    """Return the delay of the odometry's stamps against those that were given of the sensor, which were late."""
    by_s, variance = sum(one.state for one in late), sum(1.0 / one.information for one in late)
    return replace(delay, value=delay.value - by_s, sigma=max(delay.sigma, math.sqrt(variance)), p_needed=1.0)


def _with_own_state(taken: Taken, result: SlamResult) -> tuple[float, float]:
    """Return the state of a cause and its standard deviation, with what the estimator's own state adds to it."""
    state, sigma = taken.state, taken.information**-0.5 if taken.information > 0.0 else math.nan
    own = {one.name: one for one in result.parameters}
    for name, sign in OWN_STATES.get(taken.suspect.code, ()):
        if name in own and not own[name].fixed and (ratio := find_ratio(own[name])) > 0.0:
            state += sign * math.log(ratio)
            sigma = min(sigma, own[name].sigma / ratio) if own[name].sigma > 0.0 else sigma
    return state, sigma


def list_changes_of(one: Taken, result: SlamResult) -> list[MapChange]:
    """Return the changes of a result that are of the landmark of a cause."""
    rows = one.suspect.rows
    if rows is None or not one.suspect.is_of_landmark:
        return []
    return [change for change in result.changes if change.kind in OF_LANDMARKS and rows[1] in change.landmark_ids]


def _say_change(change: MapChange) -> str:
    """Return a change in words, as what a cause may be instead."""
    how = f"moved {math.hypot(*change.displacement_m):.2f} m"
    if change.kind is ChangeKind.SWAPPED:
        how = "exchanged their identities"
    elif change.kind is ChangeKind.ROTATED:
        how = "turned, or " + how
    return f"landmark{'s' if len(change.labels) > 1 else ''} {', '.join(change.labels)} {how}"


def weigh_changes(best: Trial[VisitT], weighed: list[Trial[VisitT]], least: float) -> tuple[Trial[VisitT], list[Cause]]:
    """Return the best trial with its changes as probable as they are beside causes of the same landmarks, and those of
    these causes that have a probability of `least`.

    A landmark that moved, and one of which all ranges are too long, look alike from one side.
    """
    result, changes, causes = best.solution.result, list[MapChange](), list[Cause]()
    for change in result.changes:
        rivals = dict[tuple[str, str], tuple[Taken, Trial[VisitT]]]()
        for trial in weighed:
            for one in trial.taken:
                if change not in list_changes_of(one, result) or list_changes_of(one, trial.solution.result):
                    continue
                name = one.suspect.code, one.suspect.subject
                if name not in rivals or trial.beats(rivals[name][1]) > 0.0:
                    rivals[name] = one, trial
        odds = [math.exp(min(trial.beats(best), LIKELIEST)) for _, trial in rivals.values()]
        share = 1.0 / (1.0 + sum(odds))
        changes.append(replace(change, probability=share * change.probability) if odds else change)
        for (one, trial), by in zip(rivals.values(), odds, strict=True):
            if by * share >= least:
                causes.append(_as_cause(one, trial, by * share, trial.beats(best), _say_change(change)))
    if all(one is other for one, other in zip(changes, result.changes, strict=True)):
        return best, causes
    return replace(best, solution=replace(best.solution, result=replace(result, changes=tuple(changes)))), causes


def _as_cause(one: Taken, trial: Trial[VisitT], p: float, nats: float, instead: str) -> Cause:
    """Return a cause of a trial as it is told, with its probability, what it gains, and what may be instead."""
    suspect = one.suspect
    state, sigma = _with_own_state(one, trial.solution.result)
    value = suspect.shown(state) if suspect.is_continuous else math.nan
    scale = abs(suspect.shown(state + 1e-6) - suspect.shown(state)) / 1e-6
    return Cause(
        suspect.code, suspect.subject, suspect.say(state), value, sigma * scale, p, suspect.fix(state), nats, instead
    )


def _say(trial: Trial[VisitT], own: Sequence[Cause]) -> str:
    """Return the causes of a trial in words: those that it was solved under, and its own scales."""
    taken = [one.suspect.say(_with_own_state(one, trial.solution.result)[0]) for one in trial.taken]
    undone = {one.suspect.code for one in trial.taken}
    return "; ".join([*taken, *(one.message for one in own if one.code not in undone)])


def list_causes(
    best: Trial[VisitT],
    weighed: list[Trial[VisitT]],
    base: Trial[VisitT] | None,
    find_own: Callable[[Trial[VisitT]], Sequence[Cause]] = lambda _: (),
) -> tuple[Cause, ...]:
    """Return the causes of the best trial, with their probabilities among all that was weighed.

    Args:
        best: the trial that won.
        weighed: all.
        base: that of the inputs as given; None without.
        find_own: causes of a trial that are calibration states of it, as scales are: they are of the best, too.
    """
    if not weighed:
        return ()
    own = [find_own(trial) for trial in weighed]
    relative = np.array([trial.beats(best) for trial in weighed])
    named = [
        frozenset((one.suspect.code, one.suspect.subject) for one in trial.taken)
        | {(one.code, one.subject) for one in scales}
        for trial, scales in zip(weighed, own, strict=True)
    ]
    # the same causes are one explanation, however they were found: what has a scale as a state, or was undone
    likeliest = dict[frozenset[tuple[str, str]], int]()
    for row in np.argsort(relative, kind="stable").tolist():
        likeliest[named[row]] = row
    share = np.where(np.isin(np.arange(len(weighed)), [*likeliest.values()]), np.exp(np.minimum(relative, 0.0)), 0.0)
    share /= max(float(share.sum()), 1e-300)

    def weigh(name: tuple[str, str], taken: Taken | None = None) -> tuple[float, str]:
        """Return the probability of a cause, and the words for the best trial without it, with changes of the landmark
        that the cause is of (`taken`), if it is of one.
        """
        holds = np.array([name in names for names in named])
        if holds.all():
            return float(share[holds].sum()), ""
        other = int(np.argmax(np.where(holds, -math.inf, relative)))
        changes = [] if taken is None else list_changes_of(taken, weighed[other].solution.result)
        words = (_say(weighed[other], own[other]), *map(_say_change, changes))
        return float(share[holds].sum()), "; ".join(filter(None, words))

    found = []
    gained = math.nan if base is None else best.beats(base)
    for one in best.taken:
        p, instead = weigh((one.suspect.code, one.suspect.subject), one)
        found.append(_as_cause(one, best, p, gained, instead))
    taken = {one.suspect.code for one in best.taken}
    for cause in find_own(best):
        if cause.code not in taken:
            p, instead = weigh((cause.code, cause.subject))
            found.append(replace(cause, probability=min(cause.probability, p), instead=instead))
    return tuple(sorted(found, key=lambda cause: -cause.probability))
