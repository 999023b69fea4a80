"""The competition of causes: a session solved as given, and under the causes that explain it better.

It is entered where there are symptoms, so a sound run costs nothing. Continuous causes are screened by a score test at
the optimum at which the map stands as given, discrete ones by pairs of sightings. The session is solved again under the
best few, and what wins by log evidence, prices paid, is kept: the cause's state is refined there, and a second cause
may be added. Trials are pure functions of the inputs, so one that loses leaves no trace.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Generic, Protocol, TypeAlias, TypeVar

import numpy as np

from evermap.config import ExplainConfig, SlamConfig
from evermap.errors import EvermapError
from evermap.explain.causes import LITTLE, MOUNT_M, Inputs, Suspect, has_scale, list_suspects, rows_of_kind
from evermap.explain.evidence import (
    LOG_2PI,
    AnySession,
    Score,
    Screen,
    SpatialSession,
    evidence_at,
    optimum_of,
    used_rows,
)
from evermap.explain.linearise import change_by, cost_nearby, gain_by, held_by_map, solve_nearby
from evermap.explain.scores import score_session
from evermap.explain.seeds import find_mount, find_scales, find_sensor_scales, find_shape, find_single_scales
from evermap.explain.shape import FEWEST, compare_shapes
from evermap.explain.symptoms import SURELY, compare_odometry, find_odometry_delay
from evermap.slam.check import find_misreadings
from evermap.slam.clocks import FALLS, find_delay, find_pair_loss, late_by
from evermap.slam.estimate import Solved, solve
from evermap.slam.mistakes import pairs_of
from evermap.slam.room import ROOM_M
from evermap.types import (
    UNKNOWN,
    BoolArray,
    Cause,
    ChangeKind,
    FloatArray,
    IntArray,
    ParameterEstimate,
    SlamResult,
    is_in_space,
)

VisitT = TypeVar("VisitT")
NEAR = 2.0
"""Standard deviations within which a state is refined no further."""
SHORTER = 0.5
"""Share of the step before from which a step towards the best state is no shorter: as those of Newton are nearby."""
FAR = 2.5
"""Standard deviations beforehand beyond which no state is tried at once."""
LEAST_SCALE, LEAST_SINGLE = 0.015, 0.05
"""Logarithm of a scale, of all or of one landmark, from which its first value is tried: smaller ones the linear test
finds."""
REFINED = 2
"""Trials whose states are refined: the best ones."""
LINEAR = 4.0
"""Times that a cause may gain what the linear test says."""
STRETCHES = frozenset({"tag-size", "range-scale", "sensor-scale"})
"""Causes that stretch detections: of some landmarks, or by some sensors, as of all."""
AGREE = 0.25
"""Share of what one of ranges, odometry and map is off by, up to which the other two agree with each other."""
ODOMETRY_OFF = 0.3
"""Share of the motion by which odometry is off from which it is asked why, as by the verdict."""
LENGTH_OFF, ODOMETRY_NOISY = 0.13, 2.5
"""Logarithm of the length of the trajectory over that of the odometry, and its noise over what is usual, from which the
same is asked: a run that is sound has less."""
SHAPE = 5
"""Landmarks in common from which a map that what was seen lies nowhere on is of another site."""
SURE = 0.99
"""Probability from which a delay is told as a cause."""
INLIER, FEWER = 0.5, 0.7
"""Probability from which a detection is no outlier, and share of the outliers that a cause must leave at most."""
PLACED, BETTER, ELSEWHERE = 0.6, 0.2, 0.3
"""Share of a map in its place from which it is of what was seen; by how much more that must be without a fault of it;
and share below which it is of another site."""
FEWEST_CHANGED, CHANGED = 3, 0.2
"""Landmarks, and share of those in common with a map, that changed from which the map itself is in doubt."""
AXES_OF_TAGS = frozenset({"map-axes", "corner-order"})
"""Causes of a map by which only the orientations of its tags are others: its shape says which may be."""
LEAST_LATE_S, LONGEST_LEAD_S = 0.02, 1.0
"""Delay of the sensor's stamps from which poses are put where the robot was when detections were taken; and by how much
commands are stamped before the robot follows them, at most."""
CLOCK = "clock"
"""Cause of stamps that are late."""
CHANGES, INNOVATIONS = "changes", "innovations"
"""Symptoms of a session in which landmarks changed, and of one whose detections scatter wider than they should."""
OF_NOISE = "_noise_factor", "sigma_corner_px"
"""Ends of the names of noise levels."""
PLANAR_MOUNT = "sensor x_m", "sensor y_m"
"""Subjects of causes of where a sensor sits in the plane."""
SIDEWAYS, SLIPS = "sigma_lateral_per_sqrt_m", 1.5
"""Name of the level of lateral slip, and times its usual value from which it is asked where the sensor sits."""
IGNORED, HEARD, IGNORED_NATS = 10.0, 3.0, 100.0
"""Noise over what is stated from which a sensor is ignored, up to which it is not, and what that is worth [nats]."""
OF_LANDMARKS = frozenset({ChangeKind.MOVED, ChangeKind.ROTATED, ChangeKind.SWAPPED})


@dataclass(frozen=True)
class SessionSolution(Generic[VisitT]):
    """What a solution of some inputs consists of."""

    visit: VisitT
    session: AnySession
    result: SlamResult


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
        inputs: without what the causes did.
        solution: of them.
        taken: the causes.
        evidence: log evidence of the measurements as given, with the prices of all causes and changes.
        worth: share of what the measurements say that is new.
        noise: largest level of the noise of detections, over what is stated of it.
    """

    inputs: Inputs
    solution: SessionSolution[VisitT]
    taken: tuple[Taken, ...]
    evidence: float
    worth: float
    noise: float = 1.0

    def beats(self, other: Trial[VisitT]) -> float:
        """Return by how much the evidence is larger, as far as measurements are independent [nats].

        A solution that ignores a sensor explains nothing of it: one that does not wins.
        """
        own, others = (sum(one.suspect.log_p for one in trial.taken) for trial in (self, other))
        price = own - others
        if max(self.noise, other.noise) > IGNORED and min(self.noise, other.noise) < HEARD:
            return (IGNORED_NATS if self.noise < other.noise else -IGNORED_NATS) + price
        return (self.evidence - other.evidence - price) * min(self.worth, other.worth) + price

    @cached_property
    def gain_left(self) -> float:
        """What the calibration that earns most would gain yet, of those that move the poses [nats]."""
        return _find_score(self.solution, self.inputs)


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


def find_symptoms(
    result: SlamResult, inputs: Inputs, config: SlamConfig, *, is_read_well: bool = False
) -> tuple[str, ...]:
    """Return why causes other than changes are asked: short names; none where all is well.

    Args:
        result: of the session as given.
        inputs: of it.
        config: thresholds are those of `slam.explain` and `slam.check`.
        is_read_well: whether pairs of sightings are known to show no mistake.
    """
    rules, found = config.explain, list[str]()
    seen = result.innovations
    inlier = seen.p_inlier >= INLIER
    if share_rejected(result) > rules.rejected:
        found.append("detections rejected")
    if inlier.any():
        dof = np.full(len(inlier), 2) if seen.dof is None else seen.dof
        if _mean_square(seen.nis, dof, inlier) > rules.innovations:
            found.append(INNOVATIONS)
    if any(change.kind in OF_LANDMARKS for change in result.changes):
        found.append(CHANGES)
    twice = [one for one, name in result.landmarks.names.items() if "#" in str(name)]
    hits = result.landmarks.n_hits
    if twice and hits[np.isin(result.landmarks.landmark_id, twice)].sum() > rules.rejected * hits.sum():
        found.append("identities at several places")
    for state in result.parameters:
        if not state.fixed and state.prior_sigma > 0.0:
            if abs(state.value - state.prior_mean) > rules.states * state.prior_sigma:
                found.append(state.name)
        elif (state.name.endswith(OF_NOISE[0]) and state.value > rules.noise) or (
            state.name == OF_NOISE[1] and state.value > rules.noise * config.space.sigma_px
        ):
            found.append(state.name)
    if inputs.prior_map is not None:
        own = np.unique(inputs.recording.detections.landmark_id)
        common = np.isin(inputs.prior_map.landmark_id, own)
        if result.trajectory.frame != "prior_map" or not common.any():
            found.append("map")
    if not (found or is_read_well) and any(
        not finding.usable for finding in find_misreadings(inputs.recording, config)
    ):
        found.append("readings")
    if not found and _is_off_mount(result, inputs, config):
        found.append("mount")
    if not found and (np.abs(_compare_sensors(inputs)) > LEAST_SCALE).any():
        found.append("sensors")
    if not found:
        apart, _, longer = compare_odometry(result, inputs.recording.odometry)
        if apart > ODOMETRY_OFF or abs(math.log(max(longer, 1e-9))) > LENGTH_OFF or _is_odometry_noisy(result):
            found.append("odometry")
    return tuple(found)


def _compare_sensors(inputs: Inputs) -> FloatArray:
    """Return (S,) logarithms of true distances over those by each sensor in space, by the other sensors; else none."""
    recording = inputs.recording
    return find_sensor_scales(recording, has_scale(recording)) if is_in_space(recording) else np.zeros(0)


def _is_odometry_noisy(result: SlamResult) -> bool:
    """Return whether the odometry in space seems far noisier than is usual."""
    noise = next((one for one in result.parameters if one.name == "sigma_odometry_m"), None)
    return noise is not None and noise.prior_mean > 0.0 and noise.value > ODOMETRY_NOISY * noise.prior_mean


def _is_off_mount(result: SlamResult, inputs: Inputs, config: SlamConfig) -> bool:
    """Return whether a robot in the plane seems to slip to the side, as it does if its sensor sits elsewhere."""
    slip = next((one for one in result.parameters if one.name == SIDEWAYS), None)
    if is_in_space(inputs.recording) or slip is None or not slip.value > SLIPS * slip.prior_mean:
        return False
    return bool(np.abs(find_mount(inputs.recording, config.check)[:2]).max() > MOUNT_M)


def explain(
    inputs: Inputs,
    solution: SessionSolution[VisitT] | None,
    solve_under: Solve[VisitT],
    config: SlamConfig,
    say: Callable[[str], None] = lambda _: None,
    *,
    is_read_well: bool = False,
    is_suspected: bool = False,
) -> Explained[VisitT] | None:
    """Return the solution under the causes that explain a session best; None where nothing can be solved.

    Args:
        inputs: as given.
        solution: of them; None where there was none (the estimator failed).
        solve_under: solves other inputs.
        config: settings of the estimator.
        say: told what is done.
        is_read_well: as of `find_symptoms`, of the inputs as given.
        is_suspected: whether scores say that a calibration is not as stated (`scores`), which is a symptom, too.

    Without symptoms the solution is returned as it is.
    """
    rules = config.explain
    late = None if solution is None else _find_late_sensor(solution.result, inputs)
    punctual = None if solution is None or late is None else _solve_at_true_stamps(inputs, solution, late, solve_under)
    if late is not None and punctual is not None:
        given, now = punctual
        since = explain(given, now, solve_under, config, say, is_read_well=is_read_well, is_suspected=is_suspected)
        return None if since is None else _with_late_sensor(since, late, now.result)
    screens: tuple[Callable[..., Asked], ...] = (_plain, _screen_continuous)  # what costs nothing first
    if solution is not None:
        symptoms = find_symptoms(solution.result, inputs, config, is_read_well=is_read_well)
        if not (symptoms or is_suspected):
            sound = Trial(inputs, solution, (), math.nan, 1.0)
            return Explained(sound, find_put_right(solution.result, inputs, config))
        few = count_changed(solution.result) <= rules.map_changed * len(solution.result.landmarks)
        if symptoms == (CHANGES,) and few and not (is_suspected or _find_score(solution, inputs) > 0.0):
            screens = screens[:1]  # a landmark or two moved, and no calibration earns anything
    base = None if solution is None else _trial(inputs, solution, ())
    say("the session contradicts what was stated: other causes are asked, which takes a few times as long")
    budget = _Budget(rules.most_solutions)
    alone = _solve_alone(base, inputs, solve_under, rules.rejected, budget)
    screens = (partial(_plain, alone=alone), *screens[1:])
    weighed = [] if base is None else [base]
    best = base
    for _ in range(rules.most_causes):
        found = _next_cause(best, inputs, solve_under, config, budget, weighed, screens)
        if found is None:
            break
        best = _without_needless(found, inputs, solve_under, budget, weighed)
        if not find_symptoms(best.solution.result, best.inputs, config):
            break
    if best is None:
        return None
    causes = _causes(best, weighed, base)
    named = {cause.code for cause in causes}
    others = find_put_right(best.solution.result, best.inputs, config)
    return Explained(best, (*causes, *(one for one in others if one.code not in named)), tuple(weighed))


def _find_late_sensor(result: SlamResult, inputs: Inputs) -> Taken | None:
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


def _solve_at_true_stamps(
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
    return None if _find_late_sensor(now.result, given) is not None else (given, now)


def _with_late_sensor(explained: Explained[VisitT], late: Taken, result: SlamResult) -> Explained[VisitT]:
    """Return what explains a session at its true stamps, with how late those that were given are: by what was taken off
    them, and by what `result` has left of it.
    """
    left = find_odometry_delay(result)
    suspect, state = late.suspect, late.state - (0.0 if left is None else left.value)
    cause = Cause(
        suspect.code, suspect.subject, suspect.say(state), state, late.information**-0.5, 1.0, suspect.fix(state)
    )
    best = replace(explained.best, taken=(late, *explained.best.taken))
    return replace(explained, best=best, causes=(cause, *explained.causes))


def _find_score(solution: SessionSolution[VisitT], inputs: Inputs) -> float:
    """Return what the calibration that earns most would gain, of those that move the poses [nats]; 0 without."""
    scores = score_session(solution.session, inputs, solution.result.trajectory)
    return max((one.gain for one in scores.harmful), default=0.0)


def find_put_right(result: SlamResult, inputs: Inputs, config: SlamConfig) -> tuple[Cause, ...]:
    """Return what the estimator itself found, and has put right in its solution: late clocks, and scales that are
    farther from what is stated than is usual, where a map or a data sheet says which of the two that show together it
    is.
    """
    return (
        *_find_other_map(result, inputs, are_named=config.unknown_ids is not True),
        *_find_delays(result, config.explain.late_s),
        *_find_own_scales(result, inputs, config.explain.states),
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


def _find_own_scales(result: SlamResult, inputs: Inputs, farthest: float) -> list[Cause]:
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
            ratio = _ratio_of(state)
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
    if of_length and abs(math.log(max(_ratio_of(state), 1e-9))) > LENGTH_OFF:
        return off > SURELY * state.sigma  # the run is told not to be sound for it
    return off > farthest * max(state.prior_sigma, state.sigma)


def _ratio_of(state: ParameterEstimate) -> float:
    """Return a scale as a ratio: the slope of ranges is less one."""
    return state.value + (1.0 if state.name == "range_slope" else 0.0)


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


@dataclass
class _Budget:
    """Solutions that may still be made."""

    left: int


def _next_cause(
    best: Trial[VisitT] | None,
    given: Inputs,
    solve_under: Solve[VisitT],
    config: SlamConfig,
    budget: _Budget,
    weighed: list[Trial[VisitT]],
    screens: Sequence[Callable[..., Asked]],
) -> Trial[VisitT] | None:
    """Return the best trial with one more cause that a screen lets through; None if none is better."""
    rules, inputs = config.explain, given if best is None else best.inputs
    taken = () if best is None else best.taken
    known = {(one.suspect.code, one.suspect.subject) for one in taken}
    suspects = [one for one in list_suspects(inputs) if (one.code, one.subject) not in known]
    if not _is_metre_known(inputs):
        suspects = [one for one in suspects if one.code != "range-scale"]
    tried, winner = set[tuple[str, str]](), None

    def ahead(trial: Trial[VisitT]) -> float:
        return trial.evidence if best is None else trial.beats(best)

    for ranked in _rank(best, inputs, suspects, config, screens):
        asked = _diverse(ranked, rules.most_tried, tried)
        made = (_solve_trial(inputs, taken, suspect, state, solve_under, budget) for suspect, state in asked)
        trials = sorted((trial for trial in made if trial is not None), key=ahead, reverse=True)
        for row, trial in enumerate(trials[:REFINED]):
            if best is None or ahead(trial) > 0.0:
                trials[row] = _refined(trial, inputs, taken, solve_under, budget)
        weighed += trials
        for trial in trials:
            if best is not None and not (ahead(trial) > rules.lead_nats and _relieves(trial, best, config)):
                continue  # it fits better, as with any further state, but nothing that was asked is explained
            if winner is None or trial.beats(winner) > 0.0:
                winner = trial
        if winner is not None and not find_symptoms(winner.solution.result, winner.inputs, config):
            return winner
    return winner


def _rank(
    best: Trial[VisitT] | None,
    inputs: Inputs,
    suspects: list[Suspect],
    config: SlamConfig,
    screens: Sequence[Callable[..., Asked]],
) -> Iterable[Asked]:
    """Yield causes to solve for in turns, as each of the `screens` lets them through, the first what shows without a
    solution, and before that the one that leads; there is no need for the next turn where one explains all.
    """
    shown, *others = (partial(screen, best, inputs, suspects, config) for screen in screens)
    plain = shown()
    if best is None or not others or not all(_is_near(one, state) for _, one, state in plain):
        yield plain
        for screen in others:
            yield screen()
        return
    linear = others[0]()
    yield _find_leader(plain, linear, config.explain.lead_nats)
    yield plain
    yield linear


def _find_leader(shown: Asked, found: Asked, least: float) -> Asked:
    """Return the cause by whose linear gain no other can win, if there is one and the linear test reaches it.

    Args:
        shown: causes that show without a solution, none of which are discrete: of these the state that shows is tried.
        found: causes by their linear gain, the largest first.
        least: gain from which a cause is among them [nats].
    """
    known = {(one.code, one.subject) for _, one, _ in shown}
    first = [(gain, one, state) for gain, one, state in found[:1] if (one.code, one.subject) not in known]
    others = max([least, *(gain for gain, _, _ in found[1:])])
    return [(gain, one, state) for gain, one, state in first if gain > LINEAR * others and _is_near(one, state)]


def _is_near(suspect: Suspect, state: float) -> bool:
    """Return whether a state is within what is tried of a cause at once; False of discrete ones, which have none."""
    return abs(state) < FAR * suspect.sigma


def _is_metre_known(inputs: Inputs) -> bool:
    """Return whether a map or a data sheet says which of ranges and odometry measure true metres.

    Where neither does, in the plane, the metre is that of the ranges, and the scale of the odometry holds what the two
    differ by: that it is the ranges which are off explains as much, and would move all poses.
    """
    recording = inputs.recording
    return is_in_space(recording) or inputs.prior_map is not None or recording.sensor.states_scale


def share_rejected(result: SlamResult) -> float:
    """Return the share of the detections that are outliers."""
    outlier = result.innovations.p_inlier < INLIER
    return float(np.mean(outlier)) if len(outlier) else 0.0


def count_changed(result: SlamResult) -> int:
    """Return the number of landmarks that are told to have changed."""
    return len({one for change in result.changes for one in change.landmark_ids})


def _relieves(trial: Trial[VisitT], best: Trial[VisitT], config: SlamConfig) -> bool:
    """Return whether a trial has fewer symptoms, fewer landmarks that are told to have changed, or rejects far less; or
    leaves far less for scores to say, where these were all that was asked.
    """
    was, now = best.solution.result, trial.solution.result
    before, after = find_symptoms(was, best.inputs, config), find_symptoms(now, trial.inputs, config)
    if any(symptom.endswith(OF_NOISE) for symptom in after if symptom not in before):
        return False  # under a sensor that measures hardly anything all else fits
    changed = [count_changed(result) for result in (was, now)]
    rejected = [share_rejected(result) for result in (was, now)]
    if len(after) < len(before) or changed[1] < changed[0] or rejected[1] < FEWER * rejected[0]:
        return True
    if not {*before, *after} <= {CHANGES}:
        return False
    return trial.gain_left < FEWER * best.gain_left


def _solve_alone(
    base: Trial[VisitT] | None, inputs: Inputs, solve_under: Solve[VisitT], most_rejected: float, budget: _Budget
) -> SlamResult | None:
    """Return the session without the given map, which a wrong one bends; None where the map is not in doubt: few of its
    landmarks are told to have changed, and detections fit.
    """
    given = inputs.prior_map
    if given is None:
        return None
    if base is not None:
        result = base.solution.result
        if result.trajectory.frame != "prior_map":
            return result
        few_changed = count_changed(result) < max(FEWEST_CHANGED, CHANGED * inputs.n_common)
        if few_changed and share_rejected(result) <= most_rejected:
            return None
    budget.left -= 1
    try:
        return solve_under(replace(inputs, prior_map=None)).result
    except EvermapError:
        return None


def _plain(
    best: Trial[VisitT] | None,
    inputs: Inputs,
    suspects: list[Suspect],
    config: SlamConfig,
    alone: SlamResult | None = None,
) -> list[tuple[float, Suspect, float]]:
    """Return causes that show without a solution, in one that fails, or in one without the map, `alone`."""
    of_map = _by_shape(alone, inputs, suspects)
    if of_map is None:
        of_map = [(0.0, one, 0.0) for one in suspects if _is_of_map(one, best, config)]
    seeds = _by_seeds(best, inputs, suspects, config)
    shown = [(math.inf, one, 0.0) for one in suspects if one.shows]
    return [*shown, *_screen_pairs(inputs, suspects, config), *seeds, *of_map]


def _by_shape(alone: SlamResult | None, inputs: Inputs, suspects: Iterable[Suspect]) -> Asked | None:
    """Return discrete causes of the map after which more of it is in its place; None where its shape says nothing."""
    if alone is None or inputs.prior_map is None:
        return None
    as_given = compare_shapes(alone.landmarks, inputs.prior_map)
    if as_given.n_common < FEWEST:
        return None
    found, elsewhere, placed = Asked(), Asked(), as_given.placed
    for suspect in suspects:
        if not suspect.of_map or suspect.is_continuous:
            continue
        undone = suspect.undo(inputs, 0.0).prior_map
        if undone is None:
            elsewhere.append((0.0, suspect, 0.0))
            continue
        now = compare_shapes(alone.landmarks, undone)
        placed = max(placed, now.placed)
        if now.placed >= PLACED and now.share > as_given.share + BETTER:
            found.append((now.share + suspect.p, suspect, 0.0))
    found.sort(key=lambda each: -each[0])
    return found if placed > ELSEWHERE else elsewhere


def _without_needless(
    best: Trial[VisitT], given: Inputs, solve_under: Solve[VisitT], budget: _Budget, weighed: list[Trial[VisitT]]
) -> Trial[VisitT]:
    """Return the trial without causes that were taken before the one that explains what they did, too."""
    for one in best.taken[:-1]:
        rest = tuple(other for other in best.taken if other is not one)
        if budget.left <= 0:
            break
        budget.left -= 1
        try:
            undone = given
            for other in rest:
                undone = other.suspect.undo(undone, other.state)
            trial = _trial(undone, solve_under(undone), rest)
        except EvermapError:
            continue
        weighed.append(trial)
        if trial.beats(best) > 0.0:
            best = trial
    return best


def _is_of_map(suspect: Suspect, best: Trial[VisitT] | None, config: SlamConfig) -> bool:
    """Return whether a discrete cause of the map is asked: where most of the map does not hold, or it was not found."""
    if not suspect.of_map or suspect.is_continuous or suspect.code in AXES_OF_TAGS:
        return False
    if best is None:
        return True
    result, given = best.solution.result, best.inputs.prior_map
    common = best.inputs.n_common
    if given is None or not common:  # nothing says where it is
        return False
    if result.trajectory.frame != "prior_map":
        return True
    changed = sum(len(change.landmark_ids) for change in result.changes if change.kind in OF_LANDMARKS)
    return bool(changed > config.explain.map_changed * common)


def _by_seeds(
    best: Trial[VisitT] | None, inputs: Inputs, suspects: Iterable[Suspect], config: SlamConfig
) -> list[tuple[float, Suspect, float]]:
    """Return scales with first values that need no solution (`seeds`), where these are another than stated."""
    scales = find_scales(inputs.recording, inputs.prior_map, config.check)
    ranges, driven, of_map = scales.ranges, scales.odometry, scales.map
    apart = {  # of ranges, odometry and map, how far the other two are apart
        "ranges": abs(scales.by_map - scales.by_odometry),
        "odometry": abs(scales.by_map),
        "map": abs(scales.by_odometry),
    }
    odd = min(apart, key=lambda one: apart[one])
    if apart[odd] < AGREE * max(apart.values()):  # two against one
        ranges, driven, of_map = (
            state if odd == one else math.nan
            for one, state in (("ranges", ranges), ("odometry", driven), ("map", of_map))
        )
    single: dict[int, float] = {}
    if best is not None:
        result = best.solution.result
        if inputs.prior_map is not None and result.trajectory.frame != "prior_map" and not math.isfinite(scales.by_map):
            ratio = find_shape(result, inputs.prior_map)
            states = {state.name: state.value for state in result.parameters}
            ranges = ratio - math.log(states.get("range_scale", 1.0 + states.get("range_slope", 0.0)))
            driven = ratio + math.log(states.get("odometry_forward_scale", states.get("odometry_scale", 1.0)))
            of_map = -ratio
        single = find_single_scales(inputs.recording, result)
    slips = best is not None and _is_off_mount(best.solution.result, inputs, config)
    mount = find_mount(inputs.recording, config.check) if slips else np.zeros(3)  # type: ignore[arg-type]
    by_sensor = _compare_sensors(inputs)
    found = list[tuple[float, Suspect, float]]()
    for suspect in suspects:
        if suspect.code == "mount" and suspect.subject in PLANAR_MOUNT and slips:
            moved = float(mount[PLANAR_MOUNT.index(suspect.subject)])
            found += [(math.inf, suspect, moved)] if abs(moved) > MOUNT_M else []
            continue
        if suspect.rows is not None and suspect.rows[0] == "sensor":
            state = float(by_sensor[int(suspect.rows[1])])
        elif suspect.rows is not None and suspect.rows[0] == "id":
            state = single.get(int(suspect.rows[1]), math.nan)
        elif suspect.rows is not None:
            of_kind = np.unique(inputs.recording.detections.landmark_id[rows_of_kind(inputs.recording, suspect.rows)])
            own = [single[one] for one in of_kind.tolist() if one in single]
            state = float(np.median(own)) if len(own) > 1 and 2 * len(own) > len(of_kind) else math.nan
        else:
            seeds = {"range-scale": ranges, "tag-size": ranges, "odometry-scale": driven, "map-scale": of_map}
            state = seeds.get(suspect.code, math.nan)
        of_all = suspect.rows is None or suspect.rows[0] == "sensor"
        if abs(state) > (LEAST_SCALE if of_all else LEAST_SINGLE):
            found.append((math.inf, suspect, state))
    # what was rejected stands out; of all lengths that which is off least is likelier
    return sorted(found, key=lambda each: (each[1].rows is not None and each[1].rows[0] != "sensor", abs(each[2])))


def _diverse(
    ranked: list[tuple[float, Suspect, float]], most: int, tried: set[tuple[str, str]]
) -> list[tuple[Suspect, float]]:
    """Return the best few that were not `tried`, which are added: of each kind of cause two at most, so that one kind
    does not crowd out the others.
    """
    found, count = list[tuple[Suspect, float]](), dict[str, int]()
    for _, suspect, state in ranked:
        name = suspect.code, suspect.subject
        if count.get(suspect.code, 0) < 2 and name not in tried and len(found) < most:
            tried.add(name)
            count[suspect.code] = count.get(suspect.code, 0) + 1
            found.append((suspect, state))
    return found


def _screen_pairs(
    inputs: Inputs, suspects: Iterable[Suspect], config: SlamConfig
) -> list[tuple[float, Suspect, float]]:
    """Return discrete causes, and long delays, that bring pairs of sightings nearer, with what they gain [nats]."""
    rules = config.check
    before = pairs_of(inputs.recording, rules)
    if before is None or before.still:
        return []
    loss, found = find_pair_loss(before, rules), list[tuple[float, Suspect, float]]()
    least = max(rules.gain, FALLS * loss)
    for suspect in suspects:
        if suspect.code == CLOCK:
            state = find_delay(before, rules)
            gain = loss - find_pair_loss(before, rules, late_by(state))
            found += [(gain, suspect, state)] if gain > least and abs(state) > FAR * suspect.sigma else []
            continue
        if suspect.is_continuous or suspect.of_map or not suspect.pairs:
            continue
        try:
            pairs = pairs_of(suspect.undo(inputs, 0.0).recording, rules)
        except (EvermapError, ValueError):
            continue
        if pairs is None:
            continue
        gain = loss - find_pair_loss(pairs, rules)
        if gain > least:
            found.append((gain, suspect, 0.0))
    return sorted(found, key=lambda each: -each[0])


def _screen_continuous(
    best: Trial[VisitT] | None,
    inputs: Inputs,
    suspects: list[Suspect],
    config: SlamConfig,
) -> list[tuple[float, Suspect, float]]:
    """Return continuous causes with what they gain by the score test [nats], price paid, and their states.

    And discrete ones of a lens, which do not show in pairs, by a few steps.
    """
    if best is None:
        return []
    session = _without_changes(best)
    screen = Screen.of(optimum_of(session))
    found, of_all = list[tuple[float, Suspect, float]](), None
    # what changes explain, a cause must explain, too
    with_changes = optimum_of(best.solution.session, best.solution.result.changes)
    deficit = evidence_at(with_changes) - evidence_at(screen.optimum)
    cost = cost_nearby(session)
    symptoms = find_symptoms(best.solution.result, inputs, config)
    of_noise = symptoms == (INNOVATIONS,) and not count_changed(best.solution.result)
    for suspect in suspects:
        if not suspect.is_continuous:
            if not (suspect.pairs or suspect.of_map):
                gain = gain_by(session, cost, inputs, suspect) * screen.optimum.worth + suspect.log_p
                found += [(gain, suspect, 0.0)] if gain > 0.0 else []
            continue
        if suspect.rows is None or of_all is None:
            direction = change_by(session, screen, inputs, suspect)
            of_all = direction if suspect.code in STRETCHES and suspect.rows is None else of_all
        else:  # each detection stretches by itself
            direction = of_all * screen.of_detections(rows_of_kind(inputs.recording, suspect.rows)[used_rows(session)])
        if direction is None:
            continue
        score = screen.score(direction, suspect.sigma**-2)
        state = float(np.clip(score.value, -FAR * suspect.sigma, FAR * suspect.sigma))
        if abs(state) < LITTLE * suspect.sigma:  # as sensors are; a fit improves with any further number
            continue
        gain = score.gain * screen.optimum.worth - 0.5 * math.log(max(score.information, 1e-12) * suspect.sigma**2)
        earns = gain + suspect.log_p > config.explain.lead_nats and LINEAR * score.gain > deficit
        if earns and (not of_noise or _may_relieve(session, inputs, suspect, state, config.explain)):
            found.append((gain + suspect.log_p, suspect, state))
    return sorted(found, key=lambda each: -each[0])


def _may_relieve(session: AnySession, inputs: Inputs, suspect: Suspect, state: float, rules: ExplainConfig) -> bool:
    """Return whether a continuous cause may mend innovations that are wider than they should be.

    It won't where they are as wide at the optimum nearby, at the same noise, of which the cause's state is the best
    (else another state is tried by whole solutions): what noise would be learned under it only widens them.
    """
    undone = suspect.undo(inputs, state)
    near = solve_nearby(session, inputs, undone)
    if near is None or isinstance(session, Solved):
        return True
    usual, rejected = _find_fit(near)
    if usual <= rules.innovations or rejected < FEWER * _find_fit(session)[1]:
        return True
    screen = Screen.of(optimum_of(near))
    direction = change_by(near, screen, undone, suspect, given=inputs, state=state)
    if direction is None:
        return True
    score, known = screen.score(direction, suspect.sigma**-2, state), suspect.sigma**-2
    information = known + (score.information - known) * screen.optimum.worth
    return abs(score.value) * math.sqrt(information) >= NEAR * 0.5


def _find_fit(session: SpatialSession) -> tuple[float, float]:
    """Return the mean squared innovation of a session in space, a number, and the share of detections rejected."""
    optimum = session.solved.optimum
    smoother, now = optimum.last
    inlier = now.weight >= INLIER
    nis = smoother.find_nis(now, smoother.spread(now))
    return _mean_square(nis, smoother.problem.dof, inlier), float(np.mean(~inlier))


def _mean_square(nis: FloatArray, dof: IntArray, inlier: BoolArray) -> float:
    """Return the mean squared normalised innovation, a number, of detections that are no outliers."""
    return float(nis[inlier].sum()) / max(float(dof[inlier].sum()), 1.0)


def _without_changes(best: Trial[VisitT]) -> AnySession:
    """Return the session with all landmarks of the map where it has them, which is what causes are asked of."""
    session, inputs = best.solution.session, best.inputs
    if not isinstance(session, Solved):
        return held_by_map(session)
    assert not is_in_space(inputs.recording)
    if not best.solution.result.changes:
        return session
    static = session.settings.model_copy(update={"method": "nohyp"})
    try:
        return solve(inputs.recording, static, prior_map=inputs.prior_map)
    except EvermapError:
        return session


def _solve_trial(
    inputs: Inputs,
    taken: tuple[Taken, ...],
    suspect: Suspect,
    state: float,
    solve_under: Solve[VisitT],
    budget: _Budget,
) -> Trial[VisitT] | None:
    if budget.left <= 0:
        return None
    budget.left -= 1
    try:
        undone = suspect.undo(inputs, state)
        return _trial(undone, solve_under(undone), (*taken, Taken(suspect, state)))
    except EvermapError:  # nothing can be estimated under it
        return None


def _refined(
    trial: Trial[VisitT],
    before: Inputs,
    taken: tuple[Taken, ...],
    solve_under: Solve[VisitT],
    budget: _Budget,
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
            there = _solve_trial(before, taken, suspect, last.state + by, solve_under, budget)
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


def _find_step(trial: Trial[VisitT], before: Inputs) -> Score | None:
    """Return what the state of the last cause of a trial does with the map as given, or with what was let go of it:
    of either, what knows more of it; None if it changes what is used.
    """
    last, session = trial.taken[-1], trial.solution.session
    held, known, found = held_by_map(session), last.suspect.sigma**-2, list[Score]()
    for asked in (session,) if held is session else (held, session):
        screen = Screen.of(optimum_of(asked))
        direction = change_by(asked, screen, trial.inputs, last.suspect, given=before, state=last.state)
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


def _trial(inputs: Inputs, solution: SessionSolution[VisitT], taken: tuple[Taken, ...]) -> Trial[VisitT]:
    session = solution.session
    optimum = optimum_of(session, solution.result.changes)
    used = used_rows(session)
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
    evidence = evidence_at(optimum) + volume + left_out * outlier
    # a map that what was seen lies nowhere on has its places anywhere
    anywhere = inputs.left_out if solution.result.trajectory.frame == "prior_map" else inputs.left_out + inputs.n_common
    evidence -= anywhere * inputs.recording.dim * (math.log(ROOM_M) + 0.5 * LOG_2PI)
    noise = max((one.value for one in solution.result.parameters if one.name.endswith(OF_NOISE[0])), default=1.0)
    return Trial(inputs, solution, taken, evidence + sum(map(_state_evidence, taken)), optimum.worth, noise)


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
            state, value=state.value + (factor[state.name] - 1.0) * _ratio_of(state),
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
        if name in own and not own[name].fixed and (ratio := _ratio_of(own[name])) > 0.0:
            state += sign * math.log(ratio)
            sigma = min(sigma, own[name].sigma / ratio) if own[name].sigma > 0.0 else sigma
    return state, sigma


def _say(trial: Trial[VisitT]) -> str:
    """Return the causes of a trial in words."""
    return "; ".join(one.suspect.say(_with_own_state(one, trial.solution.result)[0]) for one in trial.taken)


def _causes(best: Trial[VisitT], weighed: list[Trial[VisitT]], base: Trial[VisitT] | None) -> tuple[Cause, ...]:
    """Return the causes of the best trial, with their probabilities among all that was weighed."""
    if not best.taken:
        return ()
    relative = np.array([trial.beats(best) for trial in weighed])
    share = np.exp(np.minimum(relative, 0.0))
    share /= max(float(share.sum()), 1e-300)
    found = []
    gained = math.nan if base is None else best.beats(base)
    for one in best.taken:
        name = one.suspect.code, one.suspect.subject
        holds = np.array([any((t.suspect.code, t.suspect.subject) == name for t in trial.taken) for trial in weighed])
        other = None if holds.all() else weighed[int(np.argmax(np.where(holds, -math.inf, relative)))]
        suspect = one.suspect
        state, sigma = _with_own_state(one, best.solution.result)
        value = suspect.shown(state) if suspect.is_continuous else math.nan
        scale = abs(suspect.shown(state + 1e-6) - suspect.shown(state)) / 1e-6
        found.append(
            Cause(
                suspect.code, suspect.subject, suspect.say(state), value, sigma * scale,
                float(share[holds].sum()), suspect.fix(state), gained, "" if other is None else _say(other),
            )
        )  # fmt: skip
    return tuple(sorted(found, key=lambda cause: -cause.probability))
