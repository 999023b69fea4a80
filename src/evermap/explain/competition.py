"""The competition of causes: a session solved as given, and under the causes that explain it better.

It is entered where there are symptoms, so a sound run costs nothing. Continuous causes are screened by a score test at
the optimum at which the map stands as given, discrete ones by pairs of sightings. The session is solved again under the
best few, and what wins by log evidence, prices paid, is kept: the cause's state is refined there, and a second cause
may be added. Trials are pure functions of the inputs, so one that loses leaves no trace.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial

from evermap.config import SlamConfig
from evermap.errors import EvermapError
from evermap.explain.answer import list_causes, list_changes_of, weigh_changes
from evermap.explain.causes import list_suspects
from evermap.explain.causes.suspect import Inputs, Suspect
from evermap.explain.put_right import (
    add_late_sensor,
    add_put_right,
    find_late_sensor,
    find_own_scales,
    find_put_right,
    find_turns_off,
    solve_at_true_stamps,
    solve_with_right_turns,
)
from evermap.explain.screens import LINEAR, is_near, screen_continuous, screen_plain
from evermap.explain.trial import (
    FEWER,
    OF_NOISE,
    Asked,
    Budget,
    Explained,
    SessionSolution,
    Solve,
    Trial,
    VisitT,
    count_changed,
    find_score,
    refine,
    share_rejected,
    solve_trial,
    weigh_solution,
    with_information,
)
from evermap.explain.triggers import CHANGES, SINGLE, contradicts_odometry, find_symptoms
from evermap.types import Cause, SlamResult, is_in_space

REFINED = 2
"""Trials whose states are refined: the best ones."""
FEWEST_CHANGED, CHANGED = 3, 0.2
"""Landmarks, and share of those in common with a map, that changed from which the map itself is in doubt."""


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
    late = None if solution is None else find_late_sensor(solution.result, inputs)
    punctual = None if solution is None or late is None else solve_at_true_stamps(inputs, solution, late, solve_under)
    if late is not None and punctual is not None:
        given, now = punctual
        since = explain(given, now, solve_under, config, say, is_read_well=is_read_well, is_suspected=is_suspected)
        return None if since is None else add_late_sensor(since, late, now.result)
    screens: tuple[Callable[..., Asked], ...] = (screen_plain, screen_continuous)  # what costs nothing first
    if solution is not None:
        symptoms = find_symptoms(solution.result, inputs, config, is_read_well=is_read_well)
        off = () if symptoms else find_turns_off(solution)
        right = solve_with_right_turns(inputs, off, solve_under, config) if off else None
        if right is not None:
            given, now, off = right
            since = explain(given, now, solve_under, config, say, is_read_well=is_read_well, is_suspected=is_suspected)
            return None if since is None else add_put_right(since, *off)
        if not (symptoms or is_suspected):
            sound = Trial(solution, (), math.nan, 1.0)
            return Explained(sound, find_put_right(solution.result, inputs, config))
        few = count_changed(solution.result) <= rules.map_changed * len(solution.result.landmarks)
        if symptoms in ((CHANGES,), (SINGLE,)) and few and not (is_suspected or find_score(solution) > 0.0):
            # of a landmark or two, and no calibration earns anything: what is of all has other symptoms
            screens = (partial(screen_plain, of_some=symptoms == (SINGLE,)),)
    base = None if solution is None else weigh_solution(solution, ())
    say("the session contradicts what was stated: other causes are asked, which takes a few times as long")
    budget = Budget(rules.most_solutions)
    weighed = [] if base is None else [base]
    best = base
    for _ in range(rules.most_causes):
        given = inputs if best is None else best.inputs  # what is wrong with the drive bends its shape
        alone = _solve_alone(best, given, solve_under, rules.rejected, budget)
        shown: tuple[Callable[..., Asked], ...] = (partial(screens[0], alone=alone), *screens[1:])
        found = _next_cause(best, inputs, solve_under, config, budget, weighed, shown)
        if found is None:
            break
        found = _ask_rivals(found, solve_under, rules.lead_nats, budget, weighed)
        best = _without_needless(found, inputs, solve_under, budget, weighed)
        if not find_symptoms(best.solution.result, best.inputs, config):
            break
    if best is None:
        return None
    causes = list_causes(best, weighed, base, partial(_find_own, config=config))
    best, rivals = weigh_changes(best, weighed, rules.rival)
    causes = (*causes, *rivals)
    named = {cause.code for cause in causes}
    others = find_put_right(best.solution.result, best.inputs, config)
    return Explained(best, (*causes, *(one for one in others if one.code not in named)), tuple(weighed))


def _find_own(trial: Trial[VisitT], config: SlamConfig) -> Sequence[Cause]:
    """Return causes of a trial that it was not solved under: scales that are calibration states of it."""
    return find_own_scales(trial.solution.result, trial.inputs, config.explain.states)


def _next_cause(
    best: Trial[VisitT] | None,
    given: Inputs,
    solve_under: Solve[VisitT],
    config: SlamConfig,
    budget: Budget,
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

    own = set[str]() if best is None else {one.code for one in _find_own(best, config)}

    def lead(trial: Trial[VisitT]) -> float:
        """Return by how much a trial must lead: what is as stated is not left for a little, another cause is, and so is
        a change of a landmark that a cause of the same landmark explains.
        """
        last = trial.taken[-1]
        if best is not None and len(list_changes_of(last, trial.solution.result)) < len(
            list_changes_of(last, best.solution.result)
        ):
            return 0.0
        return 0.0 if own and last.suspect.code not in own else rules.lead_nats

    for ranked in _rank(best, inputs, suspects, config, screens):
        asked = _diverse(ranked, rules.most_tried, tried)
        made = (solve_trial(inputs, taken, suspect, state, solve_under, budget) for suspect, state in asked)
        trials = sorted((trial for trial in made if trial is not None), key=ahead, reverse=True)
        for row, trial in enumerate(trials[:REFINED]):
            if best is None or ahead(trial) > 0.0:
                trials[row] = refine(trial, inputs, taken, solve_under, budget)
        trials = [with_information(trial, inputs) for trial in trials]
        weighed += trials
        for trial in trials:
            if best is not None and not (ahead(trial) > lead(trial) and _relieves(trial, best, config)):
                continue  # it fits better, as with any further state, but nothing that was asked is explained
            if winner is None or trial.is_better(winner):
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
    solution, and before that the one that leads; there is no need for the next turn where one explains all. Before all
    else a map that lies nowhere on what was seen is left out: the session alone is solved in no time, while every other
    cause is asked in a map that contradicts it.
    """
    shown, *others = (partial(screen, best, inputs, suspects, config) for screen in screens)
    plain = shown()
    if nowhere := [each for each in plain if each[1].of_map and not each[1].is_continuous and each[0] == math.inf]:
        yield nowhere
    if best is None or not others or not all(is_near(one, state) for _, one, state in plain):
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
    return [(gain, one, state) for gain, one, state in first if gain > LINEAR * others and is_near(one, state)]


def _is_metre_known(inputs: Inputs) -> bool:
    """Return whether a map or a data sheet says which of ranges and odometry measure true metres.

    Where neither does, in the plane, the metre is that of the ranges, and the scale of the odometry holds what the two
    differ by: that it is the ranges which are off explains as much, and would move all poses.
    """
    recording = inputs.recording
    return is_in_space(recording) or inputs.prior_map is not None or recording.sensor.states_scale


def _relieves(trial: Trial[VisitT], best: Trial[VisitT], config: SlamConfig) -> bool:
    """Return whether a trial has fewer symptoms, fewer landmarks that are told to have changed, or rejects far less; or
    agrees with its odometry, which the other contradicts; or leaves far less for scores to say, where these were all
    that was asked.
    """
    was, now = best.solution.result, trial.solution.result
    before, after = find_symptoms(was, best.inputs, config), find_symptoms(now, trial.inputs, config)
    if any(symptom.endswith(OF_NOISE) for symptom in after if symptom not in before):
        return False  # under a sensor that measures hardly anything all else fits
    changed = [count_changed(result) for result in (was, now)]
    rejected = [share_rejected(result) for result in (was, now)]
    if len(after) < len(before) or changed[1] < changed[0] or rejected[1] < FEWER * rejected[0]:
        return True
    if contradicts_odometry(was, best.inputs) and not contradicts_odometry(now, trial.inputs):
        return True
    if not {*before, *after} <= {CHANGES}:
        return False
    return trial.gain_left < FEWER * best.gain_left


def _solve_alone(
    base: Trial[VisitT] | None, inputs: Inputs, solve_under: Solve[VisitT], most_rejected: float, budget: Budget
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


def _ask_rivals(
    best: Trial[VisitT], solve_under: Solve[VisitT], lead_nats: float, budget: Budget, weighed: list[Trial[VisitT]]
) -> Trial[VisitT]:
    """Return the best of a trial and of those with its last cause beside others that explained as much before it."""
    *others, last = best.taken
    before = next((trial for trial in weighed if trial.taken == tuple(others)), None)
    if before is None or not others:
        return best
    for rival in [one for one in weighed if len(one.taken) == len(others) and one.taken != before.taken]:
        known = {(one.suspect.code, one.suspect.subject) for one in rival.taken}
        if (last.suspect.code, last.suspect.subject) in known or not abs(rival.beats(before)) < lead_nats:
            continue
        trial = solve_trial(rival.inputs, rival.taken, last.suspect, last.state, solve_under, budget)
        if trial is not None:
            weighed.append(trial)
            best = trial if trial.is_better(best) else best
    return best


def _without_needless(
    best: Trial[VisitT], given: Inputs, solve_under: Solve[VisitT], budget: Budget, weighed: list[Trial[VisitT]]
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
            trial = weigh_solution(solve_under(undone), rest)
        except EvermapError:
            continue
        weighed.append(trial)
        if trial.is_better(best):
            best = trial
    return best


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
