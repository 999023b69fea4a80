"""The answer of the competition: causes with probabilities, and the result in the units that were given."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from evermap.explain.trial import Taken, Trial, VisitT
from evermap.types import Cause, ParameterEstimate, SlamResult, is_in_space

CLOCK = "clock"
"""Cause of stamps that are late."""


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

    def weigh(name: tuple[str, str]) -> tuple[float, str]:
        """Return the probability of a cause, and the words for the best trial without it."""
        holds = np.array([name in names for names in named])
        other = None if holds.all() else int(np.argmax(np.where(holds, -math.inf, relative)))
        return float(share[holds].sum()), "" if other is None else _say(weighed[other], own[other])

    found = []
    gained = math.nan if base is None else best.beats(base)
    for one in best.taken:
        suspect = one.suspect
        p, instead = weigh((suspect.code, suspect.subject))
        state, sigma = _with_own_state(one, best.solution.result)
        value = suspect.shown(state) if suspect.is_continuous else math.nan
        scale = abs(suspect.shown(state + 1e-6) - suspect.shown(state)) / 1e-6
        found.append(
            Cause(
                suspect.code, suspect.subject, suspect.say(state), value, sigma * scale,
                p, suspect.fix(state), gained, instead,
            )
        )  # fmt: skip
    taken = {one.suspect.code for one in best.taken}
    for cause in find_own(best):
        if cause.code not in taken:
            p, instead = weigh((cause.code, cause.subject))
            found.append(replace(cause, probability=min(cause.probability, p), instead=instead))
    return tuple(sorted(found, key=lambda cause: -cause.probability))
