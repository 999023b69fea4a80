"""What the estimator has put right by itself: clocks that are late, scales that it estimated, a map of elsewhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from evermap.config import SlamConfig
from evermap.errors import EvermapError
from evermap.explain.answer import CLOCK, OWN_STATES, find_ratio
from evermap.explain.causes import list_suspects
from evermap.explain.causes.suspect import Inputs
from evermap.explain.motions import SURELY, find_odometry_delay
from evermap.explain.scores import is_unusual, score_odometry
from evermap.explain.trial import Explained, SessionSolution, Solve, Taken, VisitT
from evermap.explain.triggers import LENGTH_OFF
from evermap.slam.estimate import Solved
from evermap.slam.ranges import with_bearings_anew
from evermap.types import UNKNOWN, Cause, ParameterEstimate, SlamResult, is_in_space

SHAPE = 5
"""Landmarks in common from which a map that what was seen lies nowhere on is of another site."""
SURE = 0.99
"""Probability from which a delay is told as a cause."""
LEAST_LATE_S, LONGEST_LEAD_S = 0.02, 1.0
"""Delay of the sensor's stamps from which poses are put where the robot was when detections were taken; and by how much
commands are stamped before the robot follows them, at most."""


def find_late_sensor(result: SlamResult, inputs: Inputs) -> Taken | None:
    """Return by how much stamps of the sensor are late, where measured motions in the plane seem early.

    Nothing stamps a motion before it was, so what is late are the detections: at their stamps the robot is not where
    it was when they were taken. Commands are stamped before, but no robot follows them so late as `LONGEST_LEAD_S`. In
    space delays are those of the sensors.
    """
    if is_in_space(inputs.recording):
        return None
    delay = find_odometry_delay(result)
    least_s = LEAST_LATE_S if inputs.recording.odometry.is_measured else LONGEST_LEAD_S
    if delay is None or not (delay.p_needed > SURE and -delay.value > max(least_s, SURELY * delay.sigma)):
        return None
    suspect = next(one for one in list_suspects(inputs, calibrations=True) if one.code == CLOCK)
    return Taken(suspect, -delay.value, delay.sigma**-2)


def solve_at_true_stamps(
    inputs: Inputs, solution: SessionSolution[VisitT], late: Taken, solve_under: Solve[VisitT]
) -> tuple[Inputs, SessionSolution[VisitT]] | None:
    """Return inputs with frames at the stamps that they should have had, and their solution; None where the sensor is
    late all the same.

    Where the same motions are between the same frames, it is the solution that is there.
    """
    given = late.suspect.undo(inputs, late.state)
    session, recording = solution.session, given.recording
    known = None
    if isinstance(session, Solved) and not is_in_space(recording):
        known = session.with_earlier_frames(recording, late.state)
    try:
        now = solve_under(given, known)
    except EvermapError:  # nothing can be estimated then
        return None
    return None if find_late_sensor(now.result, given) is not None else (given, now)


def find_turns_off(solution: SessionSolution[VisitT]) -> tuple[Taken, ...]:
    """Return by how much turns of the odometry are off where that is more than is usual of robots, and no state of the
    solution: the zero of its gyroscope, in space also the scale. Poses are right for all that, as far as detections
    hold them; noise levels, and states, have taken it in.
    """
    found = score_odometry(solution.asked)
    return tuple(Taken(one.suspect, one.value, one.sigma**-2) for one in found if is_unusual(one))


def solve_with_right_turns(
    inputs: Inputs, off: Sequence[Taken], solve_under: Solve[VisitT], config: SlamConfig
) -> tuple[Inputs, SessionSolution[VisitT], tuple[Taken, ...]] | None:
    """Return inputs without what turns are off by, their solution, and by how much they are off by that as well; None
    where they are unusual all the same.
    """
    for one in off:
        inputs = one.suspect.undo(inputs, one.state)
    try:
        if not is_in_space(inputs.recording):
            inputs = replace(inputs, recording=with_bearings_anew(inputs.recording, config))
        now = solve_under(inputs)
    except EvermapError:  # nothing can be estimated then
        return None
    left = {one.suspect.code: one for one in score_odometry(now.asked)}
    if any(is_unusual(one) for one in left.values()):
        return None
    taken = list[Taken]()
    for one in off:
        more = left.get(one.suspect.code)
        taken.append(one if more is None else Taken(one.suspect, one.state + more.value, more.sigma**-2))
    return inputs, now, tuple(taken)


def add_late_sensor(explained: Explained[VisitT], late: Taken, result: SlamResult) -> Explained[VisitT]:
    """Return what explains a session at its true stamps, with how late those that were given are: by what was taken off
    them, and by what `result` has left of it.
    """
    left = find_odometry_delay(result)
    return add_put_right(explained, replace(late, state=late.state - (0.0 if left is None else left.value)))


def add_put_right(explained: Explained[VisitT], *taken: Taken) -> Explained[VisitT]:
    """Return what explains a session, with causes that were undone before it was solved."""
    causes = tuple(
        Cause(
            one.suspect.code, one.suspect.subject, one.suspect.say(one.state), one.suspect.shown(one.state),
            one.information**-0.5, 1.0, one.suspect.fix(one.state),
        )
        for one in taken
    )  # fmt: skip
    best = replace(explained.best, taken=(*taken, *explained.best.taken))
    return replace(explained, best=best, causes=(*causes, *explained.causes))


def find_put_right(result: SlamResult, inputs: Inputs, config: SlamConfig) -> tuple[Cause, ...]:
    """Return what the estimator itself found, and has put right in its solution: late clocks, and scales that are
    farther from what is stated than is usual, where a map or a data sheet says which of the two that show together it
    is.
    """
    return (
        *_find_other_map(result, inputs, are_named=config.unknown_ids is not True),
        *_find_delays(result, config.explain.late_s),
        *find_own_scales(result, inputs, config.explain.states),
    )


def _find_other_map(result: SlamResult, inputs: Inputs, *, are_named: bool) -> list[Cause]:
    """Return that the given map is not of what was seen, where no cause lays the one over the other; `are_named`:
    whether landmarks were identified before.
    """
    given, seen = inputs.prior_map, inputs.recording.detections.landmark_id
    if given is None or result.trajectory.frame == "prior_map" or not len(given) or not (seen != UNKNOWN).any():
        return []
    if are_named and not inputs.n_common:
        message = "no identity that was seen is in the given map: its identities are others, or it is of another site"
        return [
            Cause("map-identities", "map", message, probability=1.0, fix="--prior-map: the map of these identities")
        ]
    if (inputs.n_common if are_named else len(result.landmarks)) < SHAPE:
        return []
    message = "what was seen lies nowhere on the given map, in no scale, unit or mirror that was tried: another site"
    return [Cause("map-site", "map", message, probability=1.0, fix="--prior-map: the map of this site")]


def find_own_scales(result: SlamResult, inputs: Inputs, farthest: float) -> list[Cause]:
    """Return scales that are calibration states, so many of their prior's standard deviations from what is stated."""
    far = {state.name: state for state in result.parameters if _is_far_off(state, farthest)}
    if not any(name in far for own in OWN_STATES.values() for name, _ in own):
        return []  # as of nearly all runs: what else may be wrong is not looked for
    found = list[Cause]()
    for code, suspect in {one.code: one for one in list_suspects(inputs) if one.code in OWN_STATES}.items():
        for name, sign in OWN_STATES[code]:
            if name not in far:
                continue
            state = far[name]
            ratio = find_ratio(state)
            if not ratio > 0.0:  # a sign, and no scale
                continue
            log, sigma = sign * math.log(ratio), state.sigma / ratio
            value, p = suspect.shown(log), min(state.p_needed, 1.0)
            found.append(Cause(code, suspect.subject, suspect.say(log), value, sigma * value, p, suspect.fix(log)))
    return found


def _is_far_off(state: ParameterEstimate, farthest: float) -> bool:
    """Return whether a state is needed for certain, known which of two it is, and so far from what is stated."""
    if state.fixed or (state.shown_with and state.evident) or not state.p_needed > SURE:
        return False
    off = abs(state.value - state.prior_mean)
    of_length = any(state.name == name for name, _ in OWN_STATES["odometry-scale"])
    if of_length and abs(math.log(max(find_ratio(state), 1e-9))) > LENGTH_OFF:
        return off > SURELY * state.sigma  # the run is told not to be sound for it
    return off > farthest * max(state.prior_sigma, state.sigma)


def _find_delays(result: SlamResult, late_s: float) -> tuple[Cause, ...]:
    """Return clocks that are late by so much."""
    found = list[Cause]()
    for state in result.parameters:
        name = state.name.removesuffix("_delay_s")
        if name == state.name or state.fixed or abs(state.value) < late_s or not state.p_needed > SURE:
            continue
        table = "odometry.csv" if name == "odometry" else f"detections.csv of {name}"
        how = f"stamps of {name} are {abs(state.value):.3g} s {'late' if state.value > 0.0 else 'early'}"
        fix = f"{table}: stamp_s {'-' if state.value > 0.0 else '+'} {abs(state.value):.3g}"
        found.append(Cause(CLOCK, name, how, state.value, state.sigma, min(state.p_needed, 1.0), fix))
    return tuple(found)
